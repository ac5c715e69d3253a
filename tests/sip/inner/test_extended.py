"""Guards sip/inner/extended: the bound is below the exact dual value, and near it, however large the multipliers."""

from __future__ import annotations

from fractions import Fraction

import numpy as np
import pytest
from scipy.sparse import csc_array, diags_array

from sparserob_core.sip.finite import FiniteProgram
from sparserob_core.sip.inner.duality import dual_bound
from sparserob_core.sip.inner.extended import extended_bound


def exact(program: FiniteProgram, y: np.ndarray, mu: np.ndarray) -> Fraction:
    """The dual value in rational numbers."""

    def whole(values: np.ndarray) -> list[Fraction]:
        return [Fraction(float(v)) for v in values]

    v = whole(np.concatenate([y, mu]))
    rows = [whole(row) for row in np.vstack([program.G, program.A])]
    rhs = whole(np.concatenate([program.h, program.b]))
    total = -sum((a * b for a, b in zip(v, rhs, strict=True)), Fraction(0))
    bent = np.zeros(program.n) if program.P is None else program.P.diagonal()
    for k in range(program.n):
        slope = Fraction(float(program.q[k])) + sum((a * row[k] for a, row in zip(v, rows, strict=True)), Fraction(0))
        low, high, w, p = (Fraction(float(part[k])) for part in (program.lower, program.upper, program.weights, bent))
        ends = [low, high, min(max(Fraction(0), low), high)]
        if p > 0:
            ends += [min(max(-(slope + side * w) / p, low), high) for side in (-1, 1)]
        total += min(w * abs(s) + p * s * s / 2 + slope * s for s in ends)
    return total


def drawn(seed: int, size: float, curved: bool) -> tuple[FiniteProgram, np.ndarray, np.ndarray]:
    """Pairs of nearly opposite rows with multipliers of ``size``, which cancel."""
    rng = np.random.default_rng(seed)
    n, pairs = 20, 3
    one = rng.normal(size=(pairs, n))
    G = np.vstack([one, -one * (1.0 + 1e-9 * rng.normal(size=(pairs, 1)))])
    y = size * np.abs(rng.normal(size=pairs))
    P = csc_array(diags_array(np.where(np.arange(n) % 2, 1e-4, 0.0))) if curved else None
    program = FiniteProgram(
        rng.normal(size=n), np.full(n, 0.3), -np.ones(n), rng.uniform(0.1, 2.0, n), G, rng.normal(size=2 * pairs),
        rng.normal(size=(1, n)), rng.normal(size=1), P=P,
    )  # fmt: skip
    return program, np.concatenate([y, y]), rng.normal(size=1)


@pytest.mark.parametrize("curved", [False, True])
@pytest.mark.parametrize("size", [1.0, 1e4, 1e8])
@pytest.mark.parametrize("seed", range(4))
def test_the_bound_is_below_the_exact_value_and_near_it(seed, size, curved):
    program, y, mu = drawn(seed, size, curved)
    bound, value = extended_bound(program, y, mu), exact(program, y, mu)
    assert Fraction(bound) <= value
    eps = float(np.finfo(np.longdouble).eps)
    assert float(value - Fraction(bound)) <= 1e4 * eps * size + 1e-15 * abs(float(value)) + 1e-15
    assert Fraction(dual_bound(program, y, mu)) <= value


def test_multipliers_that_cancel_cost_the_bound_no_digits():
    program, y, mu = drawn(0, 1e8, curved=False)
    value = exact(program, y, mu)
    assert float(value - Fraction(dual_bound(program, y, mu))) <= 1e-6 * max(1.0, abs(float(value)))


def test_where_a_bound_is_missing_nothing_is_claimed():
    program, y, mu = drawn(0, 1.0, curved=False)
    free = FiniteProgram(**{**vars(program), "upper": np.full(program.n, np.inf)})
    assert extended_bound(free, y, mu) == -np.inf
