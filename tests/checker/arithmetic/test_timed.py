"""Guards checker/arithmetic/timed: series in time of every function are those of calculus, and what has none is refused
by name."""

from __future__ import annotations

import math

import pytest
from flint import arb, ctx

from sparserob_core.checker.arithmetic.timed import Timed
from sparserob_core.checker.outcome import Unchecked

CENTRE = 0.7
# values and three derivatives at 0.7, divided by factorials, by hand
T, C, S = math.tan(CENTRE), math.cos(CENTRE), math.sin(CENTRE)
H = math.tanh(CENTRE)
BY_HAND = {
    "tan": (lambda t: t.tan(), [T, 1 + T**2, T * (1 + T**2), (1 + T**2) * (1 + 3 * T**2) / 3]),
    "sin": (lambda t: t.sin(), [S, C, -S / 2, -C / 6]),
    "cos": (lambda t: t.cos(), [C, -S, -C / 2, S / 6]),
    "exp": (lambda t: t.exp(), [math.exp(CENTRE) / math.factorial(k) for k in range(4)]),
    "log": (lambda t: t.log(), [math.log(CENTRE), 1 / CENTRE, -1 / (2 * CENTRE**2), 1 / (3 * CENTRE**3)]),
    "sqrt": (lambda t: t.sqrt(), [CENTRE**0.5, CENTRE**-0.5 / 2, -(CENTRE**-1.5) / 8, CENTRE**-2.5 / 16]),
    "tanh": (lambda t: t.tanh(), [H, 1 - H**2, -H * (1 - H**2), (1 - H**2) * (3 * H**2 - 1) / 3]),
    "cube": (lambda t: t**3, [CENTRE**3, 3 * CENTRE**2, 3 * CENTRE, 1.0]),
    "inverse square": (lambda t: t**-2, [CENTRE**-2, -2 * CENTRE**-3, 3 * CENTRE**-4, -4 * CENTRE**-5]),
    "root by power": (lambda t: t**0.5, [CENTRE**0.5, CENTRE**-0.5 / 2, -(CENTRE**-1.5) / 8, CENTRE**-2.5 / 16]),
    "power of two": (lambda t: 2.0**t, [2**CENTRE * math.log(2) ** k / math.factorial(k) for k in range(4)]),
    "nothing": (lambda t: t**0, [1.0, 0.0, 0.0, 0.0]),
    "itself": (lambda t: +t, [CENTRE, 1.0, 0.0, 0.0]),
    "signs": (lambda t: 3 - -t + (2 - t) * t - 1, [2 + 3 * CENTRE - CENTRE**2, 3 - 2 * CENTRE, -1.0, 0.0]),
    "quotients": (
        lambda t: 1 / (1 + t) + t / 2,
        [1 / (1 + CENTRE) + CENTRE / 2, 0.5 - (1 + CENTRE) ** -2, (1 + CENTRE) ** -3, -((1 + CENTRE) ** -4)],
    ),
    "of what is negative": (lambda t: (t - 2) ** 64, [math.comb(64, k) * (CENTRE - 2) ** (64 - k) for k in range(4)]),
    "high power": (lambda t: t**70, [math.comb(70, k) * CENTRE ** (70 - k) for k in range(4)]),
}


@pytest.mark.parametrize("name", BY_HAND)
def test_series_in_time_are_those_of_calculus(name):
    function, expected = BY_HAND[name]
    with ctx.workprec(120):
        found = function(Timed.time(arb(CENTRE), 4)).coefficients(4)
        assert [float(one.mid()) for one in found] == pytest.approx(expected, rel=1e-13, abs=1e-15)
        assert all(one.rad() < 1e-25 * (1 + abs(one)) for one in found)


def test_the_anomaly_solves_the_equation_of_kepler():
    """``e sin(E)`` subtracted from ``E`` is the time, as series."""
    with ctx.workprec(120):
        e, anomaly = 0.3, Timed.time(arb(CENTRE), 6).kepler(0.3)
        found = (anomaly - anomaly.sin() * e).coefficients(6)
    assert float(found[0]) == pytest.approx(CENTRE, rel=1e-15)
    assert float(found[1]) == pytest.approx(1.0, rel=1e-15)
    assert [float(one.mid()) for one in found[2:]] == pytest.approx([0.0] * 4, abs=1e-15)


def test_what_has_no_series_is_refused_by_name():
    t = Timed.time(arb(0.0), 4)
    for function in (t.log, lambda: 1.0 / t, lambda: t / 0.0, lambda: t**-1):
        with pytest.raises(Unchecked, match=r"not finite|no expansion"):
            function().coefficients(4)
    with pytest.raises(Unchecked, match="holds a str, expected a number"):
        t + "1"
    with pytest.raises(Unchecked, match="no expansion in time"):
        t.coefficients(5)
