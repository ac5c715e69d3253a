"""Guards checker/arithmetic/balls: floats beside a ball are on the side that their name says, and next to it."""

from __future__ import annotations

from fractions import Fraction

import numpy as np
from flint import arb, ctx, fmpq

from sparserob_core.checker.arithmetic.balls import above, balls, below, difference, rational


def ends(ball):
    """The exact ends of a ball."""
    middle, radius = (Fraction(*map(int, (q.p, q.q))) for q in (part.fmpq() for part in (ball.mid(), ball.rad())))
    return middle - radius, middle + radius


def test_floats_are_outside_of_a_ball_by_no_more_than_rounding():
    rng = np.random.default_rng(0)
    for precision in (53, 96, 200):
        with ctx.workprec(precision):
            for _ in range(60):
                ball = arb(fmpq(int(rng.integers(-(10**12), 10**12)), int(rng.integers(1, 10**9))))
                ball = ball + arb(0, float(10.0 ** rng.uniform(-40, 1)) if rng.uniform() < 0.7 else 0.0)
                low, high = ends(ball)
                assert Fraction(below(ball)) <= low <= high <= Fraction(above(ball))
                near = Fraction(2.0**-50) * max(abs(low), abs(high))
                assert low - near <= Fraction(below(ball)) and Fraction(above(ball)) <= high + near


def test_an_exact_number_that_is_a_float_is_not_rounded_down():
    assert below(arb(0.1)) == 0.1
    assert above(arb(0.1)) == np.nextafter(0.1, 1.0)
    third = rational(Fraction(1, 3))
    assert below(third) < Fraction(1, 3) < above(third)
    with ctx.workprec(96):
        assert Fraction(below(arb(0.1) + arb(2) ** -70)) < Fraction(0.1) + Fraction(1, 2**70)
    assert balls([0.1, -2.0]) == [arb(0.1), arb(-2)]


def test_a_difference_of_two_numbers_is_told_exactly():
    rng = np.random.default_rng(6)
    for a, b in rng.normal(size=(200, 2)) * 10.0 ** rng.integers(-12, 12, size=(200, 2)):
        nearest, rest = difference(float(a), float(b))
        assert Fraction(nearest) + Fraction(rest) == Fraction(float(a)) - Fraction(float(b))
        assert nearest == float(a) - float(b)
