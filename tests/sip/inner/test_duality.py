"""Guards sip/inner/duality: bounds against the dual function in rational numbers, at the multipliers that are said to
prove them: never above it, and below it by no more than rounding."""

from __future__ import annotations

from dataclasses import replace
from fractions import Fraction

import numpy as np
import pytest
from scipy.sparse import csc_array, diags_array

from sparserob_core.sip.finite import Blocks, FiniteProgram
from sparserob_core.sip.inner.duality import (
    ROUND_OFF,
    _clip_multipliers,
    _compute_terms,
    bound_with_multipliers,
    dual_bound,
    farkas_margin,
    farkas_proof,
    measure,
    minimisers,
    remove_cost,
    repair_multipliers,
    replace_norms,
    vertex_multipliers,
)


def whole(values: np.ndarray) -> np.ndarray:
    return np.vectorize(Fraction, otypes=[object])(np.asarray(values, dtype=float))


def dual(program: FiniteProgram, y: np.ndarray, mu: np.ndarray, at: np.ndarray | None = None) -> Fraction:
    """The least of the Lagrangian over the bounds, where ``S`` is the identity, in rational numbers; a ``P`` that is
    not diagonal is replaced by its tangent at a point."""
    y, mu, G, A = whole(y), whole(mu), whole(program.G), whole(program.A)
    finite = np.isfinite(program.h)
    slope = whole(program.q) + y[finite] @ G[finite] + (mu @ A if mu.size else 0)
    total = Fraction(program.constant) - sum(y[finite] * whole(program.h[finite])) - sum(mu * whole(program.b))
    P = np.zeros((program.n, program.n)) if program.P is None else program.P.toarray()
    bent = whole(np.diagonal(P))
    if (np.diag(np.diagonal(P)) != P).any():
        point = whole(np.zeros(program.n) if at is None else at)
        pushed, bent = whole(P) @ point, bent * 0
        slope, total = slope + pushed, total - point @ pushed / 2
    for k in range(program.n):
        low, high, w = (Fraction(float(part[k])) for part in (program.lower, program.upper, program.weights))
        ends = [low, high, min(max(Fraction(0), low), high)]
        if bent[k] > 0:
            ends += [min(max(-(slope[k] + side * w) / bent[k], low), high) for side in (-1, 1)]
        total += min(w * abs(s) + bent[k] * s * s / 2 + slope[k] * s for s in ends)
    return total


def drawn(rng: np.random.Generator, kind: str, apart: float = 1.0) -> tuple[FiniteProgram, np.ndarray, np.ndarray]:
    """A program with pairs of rows that are opposite but for a share ``apart``, with multipliers that cancel."""
    n, pairs = int(rng.integers(2, 8)), 2
    one = rng.normal(size=(pairs, n))
    G = np.vstack([one, -one * (1.0 + apart * rng.normal(size=(pairs, 1)))])
    h = rng.normal(size=2 * pairs)
    if kind == "open rows":
        h[1] = np.inf
    P = None
    if kind == "diagonal":
        P = csc_array(diags_array(rng.choice([0.0, 1e-3, 2.0], size=n)))
    if kind == "bent":
        root = rng.normal(size=(2, n))
        P = csc_array(root.T @ root)
    lower, upper = -rng.uniform(0.1, 2.0, n), rng.uniform(0.1, 2.0, n)
    lower[0], upper[-1] = rng.uniform(0.01, 0.09), -0.001 if n > 1 else upper[-1]  # 0 is not in every interval
    program = FiniteProgram(
        rng.normal(size=n), rng.uniform(0.0, 1.0, n), lower, upper, G, h, rng.normal(size=(1, n)), rng.normal(size=1),
        P=P, constant=float(rng.normal()),
    )  # fmt: skip
    y = np.abs(rng.normal(size=pairs))
    return program, np.concatenate([y, y]) * rng.choice([1.0, 1e3]), rng.normal(size=1)


@pytest.mark.parametrize("apart", [1.0, 1e-9])
@pytest.mark.parametrize("kind", ["plain", "open rows", "diagonal", "bent"])
def test_a_bound_is_the_dual_function_less_its_own_rounding(kind: str, apart: float) -> None:
    rng = np.random.default_rng(1)
    for _ in range(6):
        program, y, mu = drawn(rng, kind, apart)
        at = rng.normal(size=program.n) if kind == "bent" else None
        bound, better, moved, _ = bound_with_multipliers(program, y, mu, None, at)
        truth = dual(program, _clip_multipliers(program, better), moved, at)
        size = 10.0 * (1.0 + np.abs(y).sum() * (2.0 + 2.0 * program.n) + program.n * 10.0)
        assert Fraction(bound) <= truth
        assert float(truth - Fraction(bound)) <= ROUND_OFF * size
        # entries below 0 count as none
        less = np.where(np.arange(y.size) == 0, -y, y)
        assert dual_bound(program, less, mu, None, at) == dual_bound(program, np.maximum(less, 0.0), mu, None, at)


@pytest.mark.parametrize("along", ["rows", "equalities", "curvature"])
def test_a_bound_by_many_terms_allows_for_what_their_sum_loses(along: str) -> None:
    """A slope of 1 and of 50 000 terms, each too small to change a sum of 1: together they are 1.4e-13 of it."""
    count, small = 50_000, 2.0**-53 / 40.0
    terms = np.append(1.0, np.full(count, small))
    n = terms.size if along == "curvature" else 3
    q, none, box, tall = np.zeros(n), np.zeros((0, n)), np.ones(n), np.tile(terms[:, None], (1, 3))
    program = FiniteProgram(q, q, -box, box, none, np.zeros(0), none, np.zeros(0))
    y, mu, at, truth = np.zeros(0), np.zeros(0), None, 3 * (1 + count * Fraction(small))
    if along == "rows":
        program, y = replace(program, G=tall, h=np.zeros(terms.size)), np.ones(terms.size)
    elif along == "equalities":
        program, mu = replace(program, A=tall, b=np.zeros(terms.size)), np.ones(terms.size)
    else:  # the tangent at (1, ..., 1) of a square whose first row has all these terms, and so its first column
        first = csc_array((terms, (np.arange(n), np.zeros(n, dtype=int))), shape=(n, n))
        P = csc_array(first + first.T - csc_array(([1.0], ([0], [0])), shape=(n, n)))
        program, at, truth = replace(program, P=P), np.ones(n), Fraction(3, 2) + 3 * count * Fraction(small)
    bound = dual_bound(program, y, mu, None, at)
    assert Fraction(bound) <= -truth
    assert bound >= -float(truth) - 1e-10


def test_the_rounding_of_a_square_is_counted_where_nothing_else_is() -> None:
    """``min p x^2 / 2`` over ``[l, 2]``, without a slope and a weight: the bound is a product of three floats."""
    rng = np.random.default_rng(5)
    for p, low in rng.uniform(0.1, 1.9, size=(100, 2)):
        zero, none = np.zeros(1), np.zeros((0, 1))
        P = csc_array([[p]])
        program = FiniteProgram(zero, zero, np.array([low]), np.array([2.0]), none, zero[:0], none, zero[:0], P=P)
        assert Fraction(dual_bound(program, zero[:0], zero[:0])) <= Fraction(p) * Fraction(low) ** 2 / 2


@pytest.mark.parametrize("apart", [2e-12, 1.5e-11])
def test_rows_that_have_no_entry_of_a_variable_do_not_excuse_its_slope(apart: float) -> None:
    """``x1 - (1 - d) x2`` with ``x1 = x2`` has no least value, however many multipliers other rows have."""
    n, rows = 3, 4000
    G, A = np.zeros((rows, n)), np.array([[1.0, -1.0, 0.0]])
    G[:, 2] = -1.0
    low, high = np.array([-np.inf, -np.inf, 0.0]), np.array([np.inf, np.inf, 1.0])
    q = np.array([1.0, -(1.0 - apart), 0.0])
    program = FiniteProgram(q, np.zeros(n), low, high, G, np.zeros(rows), A, np.zeros(1))
    assert dual_bound(program, np.full(rows, 1e-9), np.array([-1.0])) == -np.inf


def test_what_refutes_is_the_dual_function_of_the_rows_alone_per_size_of_the_multipliers() -> None:
    rng = np.random.default_rng(2)
    for kind in ("plain", "open rows", "diagonal"):
        for _ in range(8):
            program, y, mu = drawn(rng, kind)
            bound, magnitude = farkas_margin(program, y, mu)
            y = _clip_multipliers(program, y)
            total = y @ np.linalg.norm(program.G, axis=1) + np.abs(mu) @ np.linalg.norm(program.A, axis=1)
            truth = float(dual(remove_cost(program), y / total, mu / total))
            assert truth - 1e-12 <= bound <= truth + 1e-15
            finite = np.isfinite(program.h)
            sizes = (y @ np.abs(np.where(finite, program.h, 0.0)) + np.abs(mu) @ np.abs(program.b)) / total
            assert magnitude == pytest.approx(sizes)
    assert farkas_margin(program, 0.0 * y, 0.0 * mu) == (-np.inf, 0.0)


def test_what_refutes_is_a_proof_where_it_is_more_than_a_share_of_what_cancelled() -> None:
    rng, told = np.random.default_rng(5), set[bool]()
    for _ in range(40):
        program, y, mu = drawn(rng, "plain")
        bound, magnitude = farkas_margin(program, y, mu)
        for tolerance in (0.0, 1e-9, abs(bound) / max(1.0, magnitude) * (1.0 - 1e-9), abs(bound) / max(1.0, magnitude)):
            expected = bound if bound > tolerance * max(1.0, magnitude) else None
            assert farkas_proof(program, y, mu, None, tolerance) == expected
            told.add(expected is None)
    assert told == {True, False}
    assert farkas_proof(program, 0.0 * y, 0.0 * mu, None, 1e-9) is None


def test_norms_of_blocks_are_replaced_by_what_lies_below_them_and_meets_them() -> None:
    rng = np.random.default_rng(3)
    for _ in range(30):
        program, y, mu = drawn(rng, "plain")
        n = program.n
        number = np.array([0, 0] + [-1] * (n - 2))
        weights = program.weights.copy()
        weights[:2] = weights[0]
        program = replace(program, blocks=Blocks(number), weights=weights, lower=-np.ones(n), upper=np.ones(n))
        at = rng.normal(size=n)
        terms = _compute_terms(program, _clip_multipliers(program, y), mu, None, at)
        plain = replace_norms(terms, program)
        assert (plain.weights[:2] == 0.0).all() and (plain.weights[2:] == terms.weights[2:]).all()
        offered = (plain.slope - terms.slope)[:2]
        assert np.linalg.norm(offered) <= weights[0] + 1e-15 * np.abs(terms.slope[:2]).sum()
        assert (plain.noise[:2] >= terms.noise[:2] + terms.weights[:2]).all()
        # the better of the two that are offered
        own, tangent = -terms.slope[:2], at[:2] / np.linalg.norm(at[:2]) * weights[0]
        own = own * min(1.0, weights[0] / np.linalg.norm(own))
        best = max(-np.abs(terms.slope[:2] + d).sum() for d in (own, tangent))
        assert -np.abs(plain.slope[:2]).sum() == pytest.approx(best, rel=1e-12)
        bound = dual_bound(program, y, mu, None, at)
        s = rng.uniform(-1.0, 1.0, size=(200, n))
        costs = weights[0] * np.linalg.norm(s[:, :2], axis=1) + np.abs(s[:, 2:]) @ weights[2:]
        assert (bound <= terms.constant + costs + s @ terms.slope + 1e-10).all()


def test_minimisers_are_no_worse_than_any_other_point() -> None:
    rng = np.random.default_rng(4)
    n = 400
    w, c, g = rng.uniform(0.0, 1.0, n), rng.choice([0.0, 0.5, 3.0], size=n), rng.normal(size=n)
    low = rng.uniform(-2.0, 1.0, n)
    high = low + rng.uniform(0.0, 2.0, n)
    found = minimisers(w, c, g, low, high)
    assert ((low <= found) & (found <= high)).all()
    others = low + np.linspace(0.0, 1.0, 101)[:, None] * (high - low)
    values = w * np.abs(others) + c * others**2 / 2 + g * others
    assert (w * np.abs(found) + c * found**2 / 2 + g * found <= values.min(axis=0) + 1e-12).all()
    assert (minimisers(w, None, g, low, high) == minimisers(w, 0.0 * c, g, low, high)).all()
    assert np.isinf(minimisers(np.zeros(1), None, np.ones(1), np.full(1, -np.inf), np.ones(1))).all()


@pytest.mark.parametrize("bent", [False, True])
def test_unbounded_entries_get_the_slopes_that_they_ask_for(bent: bool) -> None:
    rng = np.random.default_rng(5)
    for _ in range(10):
        n, root = 4, rng.normal(size=(2, 4))
        program = FiniteProgram(
            rng.normal(size=n), np.array([0.0, 0.0, 0.5, 0.5]), np.append(np.full(2, -np.inf), -np.ones(2)),
            np.append(np.full(2, np.inf), np.ones(2)), rng.normal(size=(5, n)), rng.normal(size=5),
            rng.normal(size=(1, n)), rng.normal(size=1), P=csc_array(root.T @ root) if bent else None,
        )  # fmt: skip
        y = np.abs(rng.normal(size=5)) + 0.5
        at = rng.normal(size=n) if bent else None
        # near enough: multipliers that are right but for a little
        rows = np.vstack([program.G, program.A])[:, :2]
        y0 = np.concatenate([y, rng.normal(size=1)])
        pull = program.q[:2] + (0.0 if at is None else (program.P @ at)[:2])
        off = np.linalg.lstsq(rows.T, -(pull + y0 @ rows), rcond=None)[0]
        y0 = y0 + off * (1.0 + 1e-4 * rng.normal(size=6))
        if (y0[:5] <= 0.01).any():
            continue
        better = repair_multipliers(program, y0[:5], y0[5:], None, at)
        assert better is not None
        slope = program.q + better[0] @ program.G + better[1] @ program.A
        slope = slope if better[3] is None else slope + program.P @ better[3]
        assert np.abs(slope[:2]).max() < 1e-12
        assert dual_bound(program, *better[:2], None, better[3]) > -np.inf
        told = bound_with_multipliers(program, y0[:5], y0[5:], None, at)
        assert told[0] > -np.inf


def test_multipliers_of_a_vertex_make_its_cost_stationary() -> None:
    """Of a linear program whose optimum is known, from those of a regularised one."""
    n = 3
    program = FiniteProgram(
        np.array([-1.0, -2.0, 0.0]), np.zeros(n), np.full(n, -5.0), np.full(n, 5.0),
        np.array([[1.0, 1.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]]), np.array([2.0, 1.5, 100.0]),
        np.array([[0.0, 0.0, 1.0]]), np.array([1.0]),
    )  # fmt: skip
    x = np.array([0.5, 1.5, 1.0])
    y, mu = vertex_multipliers(program, x, np.array([0.9, 1.2, 0.0]), np.array([0.3]))
    assert y == pytest.approx([1.0, 1.0, 0.0], abs=1e-12)
    assert mu == pytest.approx([0.0], abs=1e-12)
    assert dual_bound(program, y, mu) == pytest.approx(program.objective(x), abs=1e-9)
    found = measure(program, x, y, mu)
    assert (found.value, found.lower_bound) == pytest.approx((-3.5, -3.5), abs=1e-9)
    assert found.gap == found.value - found.lower_bound
    bent = replace(program, P=csc_array(np.eye(n)))
    assert vertex_multipliers(bent, x, y, mu)[0] is y
