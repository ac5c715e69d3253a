"""Guards sip/expressions/elementary: coefficients and Lagrange's bounds of series about any point of an interval,
against the series of a library of ball arithmetic at many places of it."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np
import pytest
from flint import arb, arb_series, ctx

from sparserob_core.errors import NotEnclosable
from sparserob_core.sip.expressions import elementary

# the function in double precision, that of the library, where intervals may lie, and how far above the largest of the
# next coefficients on the interval its bound may be
FUNCTIONS: dict[str, tuple[Callable[..., Any], Callable[[Any], Any], tuple[float, float], float]] = {
    "exp": (elementary.exp_series, lambda x: x.exp(), (-3.0, 3.0), 1.0),
    "sin": (elementary.sin_series, lambda x: x.sin(), (-9.0, 9.0), np.inf),
    "log": (elementary.log_series, lambda x: x.log(), (0.1, 5.0), 1.0),
    "tanh": (elementary.tanh_series, lambda x: ((2 * x).exp() - 1) / ((2 * x).exp() + 1), (-2.0, 2.0), np.inf),
    **{
        f"power {p}": (partial(elementary.power_series, p), lambda x, p=p: (x.log() * arb(p)).exp(), (0.1, 5.0), 1.0)
        for p in (0.5, -1.0, -2.5, 3.7)
    },
}


def coefficient(function: Callable[[Any], Any], x: float, n: int) -> float:
    """That of ``y^n`` at a point, beyond double precision."""
    with ctx.workprec(200):
        before, ctx.cap = ctx.cap, n + 1
        try:
            return float((function(arb_series([arb(x), arb(1)]))[n]).mid())
        finally:
            ctx.cap = before


@pytest.mark.parametrize("name", FUNCTIONS)
def test_series_about_any_point_have_the_coefficients_and_bound_the_next_one_everywhere(name: str) -> None:
    series, function, (least, most), sharp = FUNCTIONS[name]
    rng = np.random.default_rng(3)
    for number in range(24):
        low, high = np.sort(rng.uniform(least, most, 2)).tolist()
        centre = (low, high, low + rng.uniform() * (high - low))[number % 3]
        degree = number % 7
        found, bound = series(degree, centre, low, high)
        truth = [coefficient(function, centre, k) for k in range(degree + 1)]
        assert found == pytest.approx(truth, rel=1e-12, abs=1e-14)
        nexts = [abs(coefficient(function, x, degree + 1)) for x in np.linspace(low, high, 15)]
        assert max(nexts) * (1.0 - 1e-12) <= bound <= sharp * max(nexts) * (1.0 + 1e-12) + 1e-300


def test_the_sine_and_the_hyperbolic_tangent_are_bounded_by_their_closed_forms() -> None:
    assert elementary.sin_series(3, 0.2, 0.1, 0.3)[1] == 1.0 / 24.0
    for degree in range(8):
        bound = elementary.tanh_series(degree, 0.0, -0.1, 0.1)[1]
        assert bound >= max(1.0, np.tan(1.5)) / 1.6 ** (degree + 1) / 20.0
        # on a circle of pi / 4 it is at most 1
        assert bound <= (4.0 / np.pi) ** (degree + 1) * (1.0 + 1e-12)


def test_intervals_that_leave_where_a_function_is_defined_are_refused() -> None:
    for refused in (
        lambda: elementary.log_series(2, 1.0, 0.0, 2.0),
        lambda: elementary.log_series(2, 1.0, -0.1, 2.0),
        lambda: elementary.power_series(0.5, 2, 1.0, 0.0, 2.0),
        lambda: elementary.exp_series(2, 0.0, 0.0, 700.1),
    ):
        with pytest.raises(NotEnclosable):
            refused()
    assert elementary.exp_series(0, 0.0, 0.0, 700.0)[1] == np.exp(700.0)


@pytest.mark.parametrize("e", [0.3, 0.9])
def test_keplers_equation_is_enclosed_as_far_as_the_farther_end_allows(e: float) -> None:
    """An interval is as wide as its farther end, on whichever side of the centre that is."""
    for centre in (0.0, 0.5, 2.0):
        near, far = centre - 1e-3, centre + 1e-3
        narrow = elementary.kepler_series(e, 4, centre, near, far)[1]
        reach = next(h for h in np.geomspace(1e-3, 4.0, 60) if _refused(e, centre, centre - h, centre + h))
        for low, high in ((near, centre + reach), (centre - reach, far)):
            assert _refused(e, centre, low, high)
        within = 0.8 * reach
        for low, high in ((near, centre + within), (centre - within, far)):
            terms, bound = elementary.kepler_series(e, 4, centre, low, high)
            both = elementary.kepler_series(e, 4, centre, centre - within, centre + within)[1]
            assert bound > narrow and bound == pytest.approx(both, rel=1e-12)
            y = np.linspace(low, high, 101) - centre
            missed = np.abs(elementary.eccentric_anomaly(centre + y, e) - y[:, None] ** np.arange(5) @ terms)
            assert (missed <= bound * np.abs(y) ** 5 + 1e-13).all()


def _refused(e: float, centre: float, low: float, high: float) -> bool:
    try:
        elementary.kepler_series(e, 4, centre, low, high)
    except NotEnclosable:
        return True
    return False
