"""Guards blocks eliminated from Newton systems: what they leave is that of fifty digits, whatever the weights."""

from __future__ import annotations

from decimal import Decimal, localcontext

import numpy as np
import pytest

from sparserob_core.sip.convex_set import Array
from sparserob_core.sip.inner.central import elimination
from sparserob_core.sip.inner.central.elimination import Lean, Left, Whole, eliminate
from sparserob_core.sip.inner.central.layout import Block

N, ROWS, PARTS = 30, 4, 36


def block(rng: np.random.Generator, twice: int) -> Block:
    """Single absolute values of all variables, of the first ``twice`` ones two, and rows of several."""
    of = np.concatenate([np.arange(N), np.arange(twice)])
    single, at = np.arange(of.size), of.size + np.arange(ROWS)
    columns, mixed = rng.permutation(PARTS)[: of.size], rng.permutation(PARTS)[:ROWS]
    alone = np.bincount(of, minlength=N) <= 1
    A, value = rng.standard_normal((ROWS, N)), rng.standard_normal(of.size)
    return Block(0, N, single, at, A, of, value, columns, mixed, True, alone)


def exact(one: Block, D: Array, weight: Array, lean: Array, r: Array, parts: Array) -> tuple[Array, Array, Array]:
    """``B' M^-1 B``, ``B' M^-1 r`` and ``M^-1 (r - B parts)`` by Gaussian elimination in fifty digits."""
    number = np.vectorize(Decimal, otypes=[object])
    A, S = number(one.A), np.zeros((N, PARTS))
    S[one.of, one.columns] = one.value
    with localcontext() as context:
        context.prec = 50
        scale = number(np.zeros(PARTS))
        scale[one.columns] = number(lean[one.single])
        B = number(S) * scale
        B[:, one.mixed] += A.T * number(lean[one.at])
        M = np.diag(number(D)) + (A.T * number(weight[one.at])) @ A
        table = np.hstack([M, B, number(r)[:, None], (number(r) - B @ number(parts))[:, None]])
        for i in range(N):
            table[i] = table[i] / table[i, i]
            others = np.arange(N) != i
            table[others] -= np.outer(table[others, i], table[i])
        X = table[:, N:]
        return (B.T @ X[:, :PARTS]).astype(float), (B.T @ X[:, PARTS]).astype(float), X[:, -1].astype(float)


@pytest.mark.parametrize(("small", "twice"), [(0, 0), (5, 0), (0, 3), (5, 3)])
def test_what_a_block_leaves_is_that_of_fifty_digits(monkeypatch: pytest.MonkeyPatch, small: int, twice: int) -> None:
    rng = np.random.default_rng(small + twice)
    one = block(rng, twice)
    J = one.single.size + ROWS
    weight, lean = 10.0 ** rng.uniform(0, 4, J), rng.uniform(-1, 1, J)
    weight[one.at[::2]], lean[one.at[::2]] = 1e-4, 1.0  # rows whose absolute values are far from 0
    weight[:small] = 1e-6  # gains that only rows hold
    D = 1e-9 + np.bincount(one.of, one.value**2 * weight[one.single], N)
    r, given = np.linspace(-1.0, 1.0, N), np.linspace(0.0, 1.0, PARTS)
    wanted = exact(one, D, weight, lean, r, given)
    size = np.sqrt(np.diag(wanted[0])) + (np.diag(wanted[0]) == 0.0)
    errors = []
    for large, kind in ((N, Whole), (0, Lean)):
        monkeypatch.setattr(elimination, "LARGE", large)
        left = Left(PARTS)
        eliminated = eliminate(one, D, weight, lean, left)
        assert isinstance(eliminated, kind)
        if isinstance(eliminated, Lean):
            assert max(small, twice) <= eliminated.others.size < N / 2 - ROWS
        state, parts = eliminated.forward(r)
        whole = np.abs(left.total() - wanted[0]) / np.outer(size, size)
        rest = zip((parts, eliminated.back(state, given)), wanted[1:], strict=True)
        errors.append([float(whole.max()), *(float(np.abs(a - b).max() / np.abs(b).max()) for a, b in rest)])
    assert max(errors[0]) < 1e-4  # five gains that two rows hold have a matrix whose condition is 1e12
    assert max(errors[1]) < 1e-8
    assert max(errors[1]) < 0.1 * max(errors[0])  # the rows as pivots lose fewer digits than their squares


def test_a_block_with_many_rows_stays_whole(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(elimination, "LARGE", 0)
    monkeypatch.setattr(elimination, "SPARE", ROWS / N / 2)
    one = block(np.random.default_rng(0), 0)
    J = one.single.size + ROWS
    assert isinstance(eliminate(one, np.ones(N), np.ones(J), np.zeros(J), Left(PARTS)), Whole)
