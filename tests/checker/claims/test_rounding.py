"""Guards checker/claims, what rounding loses: added up anew in rational numbers, it is in the error that is told."""

from __future__ import annotations

from fractions import Fraction
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from flint import arb, ctx

from sparserob_core.checker.arithmetic.jets import Monomials
from sparserob_core.checker.claims import activity
from sparserob_core.checker.claims.cells import _tops
from sparserob_core.checker.claims.window import _plus
from sparserob_core.checker.reach.tube import Polynomial
from tests.support.worst_cases import kind, walls


@pytest.fixture(autouse=True)
def precision() -> Any:
    with ctx.workprec(96):
        yield


def polynomial(coefficients: Any, error: float = 0.0) -> Polynomial:
    table = np.asarray(coefficients, dtype=float).reshape(-1, 1)
    return Polynomial(table, error, 0.0, 0.0, 0.0)


def exact(values: Any) -> list[Fraction]:
    return [Fraction(float(v)) for v in np.ravel(values)]


def test_a_sum_of_polynomials_is_off_by_no_more_than_it_says() -> None:
    rng = np.random.default_rng(1)
    for _ in range(200):
        own = rng.normal(size=rng.integers(1, 4))
        more = rng.normal(size=rng.integers(1, 4)) * 2.0 ** rng.integers(-60, 4)
        error, lost = rng.choice([0.0, 1.0, 1e-3]), rng.choice([0.0, 2.0**-54, 2.0**-70])
        found = _plus(polynomial(own, error), more, lost)
        assert found.coefficients.shape == (max(own.size, more.size), 1)
        missed = Fraction(0)
        for i, value in enumerate(exact(found.coefficients)):
            truth = sum((exact(part)[i] for part in (own, more) if i < part.size), Fraction(0))
            missed += abs(value - truth)
        assert Fraction(found.error) >= missed + Fraction(error) + Fraction(lost)
        assert found.error <= (error + lost) * (1.0 + 1e-11) + 1e-15 * (np.abs(own).sum() + np.abs(more).sum())


@pytest.mark.parametrize("which", ["moving", "mixed"])
def test_what_stands_beside_a_row_is_off_by_no_more_than_it_says(which: str) -> None:
    """Rows that nearly cancel, at times that are no numbers of few bits."""
    made, rng = kind("known"), np.random.default_rng(2)
    wall, _, heights = walls("known", which, made)
    case = made.case(path=[wall(heights.max(axis=0) + 1.0)])
    window = case.windows[0]
    basis = np.array([[1.0 / 3.0, 0.7], [1.0 / 3.0 + 1e-12, 0.7]])
    gains = np.array([[0.1, 0.3], [0.1, 0.3 + 1e-12]])
    beside = case.beside(window, basis, gains)
    assert beside is not None
    for _ in range(40):
        start = float(rng.uniform(0.3, 0.35))
        z = rng.normal(size=(3, 1)) * np.array([1.0, -1.0])
        for poly, row in zip(beside.added([polynomial([0.0])] * 3, start, start, z), z, strict=True):
            (offset, _), u = window.moved(start, start), made.u[:, 0]
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


def test_what_is_taken_off_a_bound_rounds_upwards() -> None:
    tube: Any = SimpleNamespace(flow=SimpleNamespace(monomials=Monomials(0, 1)))
    for level, allowed in ((2.0**-54, 1.0), (-(2.0**-54), 1.0), (1.0 / 3.0, 1.0 + 2.0**-52), (-0.1, -0.3)):
        for error in (0.0, 2.0**-55):
            (top,) = _tops(tube, [(polynomial([level], error), allowed)])
            assert Fraction(float(top)) >= Fraction(level) - Fraction(allowed) + Fraction(error)
            assert float(top) <= level - allowed + error + 1e-12


def test_a_bound_of_a_time_rounds_down(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(activity, "_vectors", lambda case: np.array([0.25, 0.75]))
    monkeypatch.setattr(activity, "_lengths", lambda case: [])
    low = arb(1) + arb(2) ** -52 - arb(2) ** -80
    case: Any = SimpleNamespace(duality=SimpleNamespace(summed=lambda rows, pieces: (low, [])))
    for found in (activity._whole(case, low), activity._leaf(case, True, {}, [])):
        assert arb(found) <= low
        assert found > 1.0 - 1e-12
