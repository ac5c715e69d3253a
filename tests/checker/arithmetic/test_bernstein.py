"""Guards checker/arithmetic/bernstein: bounds hold in exact arithmetic, are reached, and know what rounding may do."""

from __future__ import annotations

from fractions import Fraction

import numpy as np
import pytest

from sparserob_core.checker.arithmetic.bernstein import ROUNDING, bernstein, highest


def valued(coefficients, point):
    """A polynomial at a point, exactly."""
    total = Fraction(0)
    for powers, c in np.ndenumerate(coefficients):
        term = Fraction(float(c))
        for x, power in zip(point, powers, strict=True):
            term *= x**power
        total += term
    return total


@pytest.mark.parametrize("symmetric", [(False,), (True,), (False, True)])
def test_corner_coefficients_are_values_and_averages_are_those_of_a_degree_more(symmetric):
    rng = np.random.default_rng(1)
    p = rng.normal(size=(5,) * len(symmetric))
    b = bernstein(p[None], symmetric)[0]
    for corner in np.ndindex(*(2,) * len(symmetric)):
        point = [Fraction(2 * c - 1 if both else c) for c, both in zip(corner, symmetric, strict=True)]
        assert b[tuple(-c for c in corner)] == pytest.approx(float(valued(p, point)), abs=1e-13)
    raised = np.zeros(tuple(n + 1 for n in p.shape))
    raised[tuple(slice(0, n) for n in p.shape)] = p
    one, grid = bernstein(raised[None], symmetric)[0], b
    for axis in range(b.ndim):  # elevation by one degree: Farouki 2012, section 3.2
        n = grid.shape[axis]
        i = np.arange(n + 1).reshape([-1 if k == axis else 1 for k in range(b.ndim)])
        pad = [(1, 0) if k == axis else (0, 0) for k in range(b.ndim)]
        turned = [(0, 1) if k == axis else (0, 0) for k in range(b.ndim)]
        grid = (i * np.pad(grid, pad) + (n - i) * np.pad(grid, turned)) / n
    assert one == pytest.approx(grid, abs=1e-12)
    assert (bernstein(p[None], symmetric, absolute=True)[0] >= np.abs(b) - 1e-15).all()


def test_no_value_is_above_a_bound_not_even_by_rounding():
    """At corners, where bounds are values: sums of large numbers that cancel, compared exactly."""
    rng = np.random.default_rng(2)
    p = rng.normal(size=(300, 9)) * 10.0 ** rng.uniform(-3, 3, size=(300, 9))
    p[:, 8] -= p.sum(axis=1)
    for symmetric, ends in (([False], (0, 1)), ([True], (-1, 1))):
        bounds = highest(p, symmetric, np.zeros(300), np.inf)
        values = [max(valued(c, [Fraction(end)]) for end in ends) for c in p]
        assert all(Fraction(float(u)) >= v for u, v in zip(bounds, values, strict=True))


def test_rounding_is_allowed_for_as_a_share_of_the_largest_sum():
    p = np.array([[1.0, -2.0, 1.0]])
    (bound,) = highest(p, [False], np.array([0.25]), np.inf)
    assert bound == 1.0 + (0.25 + ROUNDING * bernstein(p, [False], absolute=True).max())
    assert 0.0 < ROUNDING * 1e3 < 1e-9


def test_a_limit_just_above_the_highest_value_is_shown_and_one_just_below_never():
    """``1 - (t - 1/3)^2`` and its like on two axes: highest inside, where only halving finds it."""
    one = np.array([[1.0 - 1.0 / 9.0, 2.0 / 3.0, -1.0]])
    two = np.zeros((1, 3, 3))
    two[0, :, 0] = one[0]
    two[0, 0, 2] = -1.0
    for p, symmetric in ((one, [False]), (two, [False, True])):
        for limit in (1.0 + 1e-9, 1.0 + 1e-4):
            assert highest(p, symmetric, np.zeros(1), limit)[0] <= limit
        for limit in (1.0 - 1e-9, 1.0 - 1e-4):
            assert highest(p, symmetric, np.zeros(1), limit)[0] >= 1.0
        assert highest(p, symmetric, np.array([0.1]), 1.1 + 1e-6)[0] <= 1.1 + 1e-6
        assert highest(p, symmetric, np.array([0.1]), 1.1 - 1e-6)[0] >= 1.1
    both = np.concatenate([one, one + np.array([[0.5, 0.0, 0.0]])])
    assert (highest(both, [False], np.zeros(2), 1.0 + 1e-6) <= 1.0 + 1e-6).tolist() == [True, False]
