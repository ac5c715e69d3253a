"""Guards checker/cost/effort: the largest effort is shown where it is that, and nowhere below."""

from __future__ import annotations

from itertools import product

import numpy as np
import pytest
from flint import arb, ctx

from sparserob_core.checker.cost import effort
from sparserob_core.checker.cost.effort import _compute_chord_slope, prove_effort_limit
from sparserob_core.checker.outcome import Broken, Clock, Unchecked
from sparserob_core.checker.sets.known import known
from sparserob_core.control.sets.sets import Box, NormBall


def largest(a, A, convex):
    """By all vertices of a box, or densely."""
    if isinstance(convex, Box):
        points = np.array(list(product(*zip(convex.lower, convex.upper, strict=True))))
    else:
        angles = np.linspace(0, 2 * np.pi, 20001)
        points = convex.radius * np.stack([np.cos(angles), np.sin(angles)], axis=1) + convex.centre
    return np.abs(a + points @ A.T).sum(axis=1).max()


def judged(a, A, convex, limit, clock=None):
    rows = [[arb(float(v)) for v in row] for row in A]
    return prove_effort_limit(
        [arb(float(v)) for v in a], rows, lambda b: known(convex).support(b), np.array(known(convex).radius),
        arb(float(limit)), clock or Clock(),
    )  # fmt: skip


@pytest.mark.parametrize(
    "convex", [Box([-0.5, -1.0, 0.1], [0.4, 0.7, 0.8]), NormBall(p=2.0, radius=0.8, centre=np.zeros(2))]
)
def test_the_largest_effort_is_shown_just_above_what_it_is_and_never_below(convex):
    rng = np.random.default_rng(0)
    with ctx.workprec(96):
        for n in (1, 3, 6):
            for _ in range(4):
                a, A = rng.normal(size=n), rng.normal(size=(n, convex.dimension))
                A[rng.integers(0, n)] *= 0.01
                top = largest(a, A, convex)
                assert judged(a, A, convex, top * (1 + 1e-6)) >= 1
                for share in (1e-6, 0.05, 0.5):
                    with pytest.raises((Broken, Unchecked)):
                        judged(a, A, convex, top * (1 - share))
        with pytest.raises(Broken):
            judged(np.ones(2), np.zeros((2, 2)), Box(-np.ones(2), np.ones(2)), 2.0 - 1e-9)
        assert judged(np.ones(2), np.zeros((2, 2)), Box(-np.ones(2), np.ones(2)), 2.0) == 1


def test_the_slope_of_a_chord_of_an_absolute_value():
    assert _compute_chord_slope(2.0, 0.5) == _compute_chord_slope(2.0, 0.0) == 1.0
    assert _compute_chord_slope(-0.5, -2.0) == _compute_chord_slope(0.0, -2.0) == -1.0
    assert _compute_chord_slope(3.0, -1.0) == pytest.approx((3.0 - 1.0) / 4.0)
    assert _compute_chord_slope(1.0, -3.0) == pytest.approx(-0.5)


def test_too_many_parts_and_no_time_are_no_verdict(monkeypatch):
    rng = np.random.default_rng(1)
    a, A, box = 0.1 * rng.normal(size=8), rng.normal(size=(8, 3)), Box(-np.ones(3), np.ones(3))
    with ctx.workprec(96):
        top = largest(a, A, box)
        monkeypatch.setattr(effort, "MAX_PARTS", 3)
        with pytest.raises(Unchecked):
            judged(a, A, box, top * (1 + 1e-9))
        with pytest.raises(Unchecked):
            judged(a, A, box, top * (1 + 1e-9), Clock(-1.0))
