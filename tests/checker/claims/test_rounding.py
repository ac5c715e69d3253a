"""Guards checker/claims, what rounding loses: added up anew in rational numbers, it is in the error that is told."""

from __future__ import annotations

from dataclasses import dataclass
from fractions import Fraction
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from flint import arb, ctx

from sparserob_core.checker.arithmetic.monomials import Monomials
from sparserob_core.checker.claims import activity, cells, window
from sparserob_core.checker.claims.window import _add_terms
from sparserob_core.checker.reach.kernels import BoundedInputHere
from sparserob_core.checker.reach.tube import Polynomial
from tests.support.worst_cases import kind, walls


@pytest.fixture(autouse=True)
def precision() -> Any:
    with ctx.workprec(96):
        yield


def polynomial(coefficients: Any, error: float = 0.0) -> Polynomial:
    table = np.asarray(coefficients, dtype=float).reshape(-1, 1)
    return Polynomial(table, error, 0.0, 0.0, 0.0)


@dataclass(frozen=True, eq=False)
class Told(BoundedInputHere):
    """What is told of errors up to a ``start``, and after it."""

    low: np.ndarray
    high: np.ndarray
    start: float

    def added_at(self, c: np.ndarray, times: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        places = (times > self.start).astype(int)
        return self.low[places], self.high[places]

    def least(self, c: np.ndarray, time: float) -> np.ndarray:
        raise NotImplementedError

    def bound_chord_errors(self, c: np.ndarray, start: np.ndarray, stop: np.ndarray) -> np.ndarray:
        return np.zeros(start.size)


def exact(values: Any) -> list[Fraction]:
    return [Fraction(float(v)) for v in np.ravel(values)]


def test_a_sum_of_polynomials_is_off_by_no_more_than_it_says() -> None:
    rng = np.random.default_rng(1)
    for _ in range(200):
        own = rng.normal(size=rng.integers(1, 4))
        more = rng.normal(size=rng.integers(1, 4)) * 2.0 ** rng.integers(-60, 4)
        error, lost = rng.choice([0.0, 1.0, 1e-3]), rng.choice([0.0, 2.0**-54, 2.0**-70])
        found = _add_terms(polynomial(own, error), more[:, None], lost)
        assert found.coefficients.shape == (max(own.size, more.size), 1)
        missed = Fraction(0)
        for i, value in enumerate(exact(found.coefficients)):
            truth = sum((exact(part)[i] for part in (own, more) if i < part.size), Fraction(0))
            missed += abs(value - truth)
        assert Fraction(found.error) >= missed + Fraction(error) + Fraction(lost)
        assert found.error <= (error + lost) * (1.0 + 1e-11) + 1e-15 * (np.abs(own).sum() + np.abs(more).sum())


@pytest.mark.parametrize("lost", ["conversion", "products"])
def test_each_allowance_beside_a_row_covers_its_own_loss_alone(lost: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Of numbers that are converted and not multiplied, and of products and sums of exact ones."""
    made, rng = kind("known"), np.random.default_rng(3)
    case = made.case(path=[walls("known", "moving" if lost == "conversion" else "mixed", made)[0](np.full(4, 9.0))])
    basis, gains = (np.eye(2), np.zeros((2, 0))) if lost == "conversion" else (np.zeros((2, 2)), np.eye(2))
    beside = case.build_added_terms(case.windows[0], basis, gains)
    assert beside is not None
    monkeypatch.setattr(window, "HALF_ULP", 0.0)
    monkeypatch.setattr(window, "OUTWARD", 1.0)
    if lost == "conversion":
        monkeypatch.setattr(window, "rounding", lambda count: 0.0)
    for _ in range(25):
        start = float(rng.uniform(0.3, 0.45))
        z = np.array([[1.0, 0.0], [0.0, -1.0]]) if lost == "conversion" else rng.normal(size=(2, 2))
        (offset, _), u = case.windows[0].evaluate_reference(start, start), [arb(float(v)) for v in made.u[:, 0]]
        beside_it = [-x for x in offset] if lost == "conversion" else u
        for poly, row in zip(beside.added([polynomial([0.0])] * 2, start, start, z), z, strict=True):
            truth = sum((arb(float(a)) * x for a, x in zip(row, beside_it, strict=True)), arb(0))
            assert abs(truth - arb(float(poly.coefficients[0, 0]))) <= arb(poly.error)


@pytest.mark.parametrize("which", ["moving", "mixed"])
def test_what_stands_beside_a_row_is_off_by_no_more_than_it_says(which: str) -> None:
    """Rows that nearly cancel, at times that are no numbers of few bits."""
    made, rng = kind("known"), np.random.default_rng(2)
    wall, _, heights = walls("known", which, made)
    case = made.case(path=[wall(heights.max(axis=0) + 1.0)])
    held = case.windows[0]
    basis = np.array([[1.0 / 3.0, 0.7], [1.0 / 3.0 + 1e-12, 0.7]])
    gains = np.array([[0.1, 0.3], [0.1, 0.3 + 1e-12]])
    beside = case.build_added_terms(held, basis, gains)
    assert beside is not None
    for _ in range(15):
        start = float(rng.uniform(0.3, 0.35))
        z = rng.normal(size=(3, 1)) * np.array([1.0, -1.0])
        for poly, row in zip(beside.added([polynomial([0.0])] * 3, start, start, z), z, strict=True):
            (offset, _), u = held.evaluate_reference(start, start), made.u[:, 0]
            truth = -sum(
                (
                    arb(a) * arb(c) * r
                    for a, one in zip(row, basis, strict=True)
                    for c, r in zip(one, offset, strict=True)
                ),
                arb(0),
            )
            if which == "mixed":
                truth = sum(
                    (arb(a) * arb(g) * arb(v) for a, one in zip(row, gains, strict=True)
                     for g, v in zip(one, u, strict=True)), truth,
                )  # fmt: skip
            assert abs(truth - arb(float(poly.coefficients[0, 0]))) <= arb(poly.error)
            assert poly.error < 1e-14


def test_what_is_taken_off_a_bound_rounds_upwards(monkeypatch: pytest.MonkeyPatch) -> None:
    """By the error that is handed on with it alone, whatever is added to that later."""
    tube: Any = SimpleNamespace(flow=SimpleNamespace(monomials=Monomials(0, 1)))
    given = []

    def highest(dense: np.ndarray, _: object, errors: np.ndarray, nothing: float) -> np.ndarray:
        given.append((exact(dense)[0], exact(errors)[0]))
        return errors

    monkeypatch.setattr(cells, "highest", highest)
    rng = np.random.default_rng(6)
    for level, allowed in ((2.0**-54, 1.0), (-(2.0**-54), 1.0), *rng.uniform(0.0, 1.0, size=(20, 2))):
        for error in (0.0, 1.0):
            cells._bound_polynomials(tube, [(polynomial([level], error), max(level, allowed))])
            value, off = given[-1]
            assert value + off >= Fraction(float(level)) - Fraction(float(max(level, allowed))) + Fraction(error)
            assert off <= error * (1.0 + 1e-11) + 1e-15


def test_a_bound_of_a_time_rounds_down(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(activity, "_sum_counts", lambda case: np.array([0.25, 0.75]))
    monkeypatch.setattr(activity, "_enclose_lengths", lambda case: [])
    low = arb(1) + arb(2) ** -52 - arb(2) ** -80
    duality = SimpleNamespace(summed=lambda rows, pieces: (low, []), charged=lambda rows, costs: costs)
    case: Any = SimpleNamespace(duality=duality, problem=SimpleNamespace(system=SimpleNamespace(controls=1)))
    for found in (activity._bound_active_share(case, low), activity._bound_leaf(case, True, {}, [])):
        assert arb(found) <= low
        assert found > 1.0 - 1e-12


def test_a_chord_of_what_errors_of_execution_add_is_as_near_to_both_ends_as_it_says() -> None:
    made, rng = kind("alone"), np.random.default_rng(8)
    case = made.case(path=[walls("alone", "fixed", made)[0](np.full(4, 9.0))], execution=np.array([0.1, 0.25]))
    beside = case.build_added_terms(case.windows[0], np.eye(2), np.zeros((2, 2)))
    assert beside is not None
    for _ in range(40):
        low = rng.normal(size=2) * 10.0 ** rng.uniform(-3, 0, size=2)
        high = low + rng.choice([0.0, 1e-16, 1.0], size=2) * rng.uniform(size=2)
        start, stop = sorted((rng.choice(np.arange(513, 767), size=2, replace=False) / 1024.0).tolist())
        told = Told(low, high, start)
        found = beside._add_bounded_input(
            polynomial(np.zeros(1), 0.0), told, np.array([1.0, 0.0]), np.zeros(2), [start, stop], None
        )
        (level, slope), off = found.coefficients[:, 0], found.error
        for share, a, b in ((Fraction(0), low[0], high[0]), (Fraction(1), low[1], high[1])):
            at = Fraction(float(level)) + share * Fraction(float(slope))
            assert at - Fraction(float(off)) <= Fraction(float(a))
            assert at + Fraction(float(off)) >= Fraction(float(b))
        assert off <= max(high - low) * (1.0 + 2e-12) + 1e-13  # the error of a polynomial is rounded outwards
