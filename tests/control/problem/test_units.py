"""Guards control/problem/units.py and `in_units` of sets and systems: other units, the same thing in other numbers."""

from __future__ import annotations

import numpy as np
import pytest

from sparserob_core.control.enclosures.taylor import TaylorSpace
from sparserob_core.control.problem.expression import parse_matrix
from sparserob_core.control.problem.system import LinearSystem
from sparserob_core.control.problem.units import power_of_two
from sparserob_core.control.sets.sets import Box, Cylinder, Ellipsoid, NormBall, Polytope

SETS = [
    Box(np.array([-1.0, 0.5]), np.array([2.0, 0.75])),
    Polytope(np.array([[1.0, 1.0], [-1.0, 2.0], [0.0, -3.0]]), np.array([1.0, 2.0, 3.0])),
    Ellipsoid(np.array([0.5, -1.0]), np.array([[2.0, 0.3], [0.3, 0.1]])),
    NormBall(2.0, 0.7, np.array([0.1, 0.2])),
    NormBall(3.0, 0.7, np.array([0.1, 0.2])),
    NormBall(1.0, 0.7, np.array([0.1, 0.2])),
    NormBall(np.inf, 0.7, np.array([0.1, 0.2])),
]


@pytest.mark.parametrize("convex", SETS, ids=lambda convex: type(convex).__name__)
def test_a_set_in_other_units_holds_the_same_points(convex):
    rng, units = np.random.default_rng(3), np.array([2.0**-40, 2.0**17])
    other, c = convex.in_units(units), rng.normal(size=(30, 2))
    points = rng.normal(size=(200, 2)) * 1.5
    np.testing.assert_allclose(other.support(c * units), convex.support(c), rtol=1e-12)
    np.testing.assert_allclose(other.support_point(c * units) * units, convex.support_point(c), rtol=1e-9, atol=1e-12)
    inside = convex.contains(points, 0.0)
    np.testing.assert_array_equal(other.contains(points / units, 0.0), inside)
    np.testing.assert_allclose(convex.in_units(units).in_units(1 / units).support(c), convex.support(c), rtol=1e-12)


@pytest.mark.parametrize("convex", SETS[2:5], ids=lambda convex: type(convex).__name__)
def test_the_frame_of_a_curved_set_is_round_and_follows_its_units_exactly(convex):
    rng, units = np.random.default_rng(4), np.array([2.0**-30, 2.0**9])
    z = rng.normal(size=(100, 2))
    z /= np.linalg.norm(z, axis=1)[:, None]
    c = z @ convex.frame
    room = convex.support(c) - c @ convex.interior_point()
    assert room.max() <= 2.0 * room.min()
    np.testing.assert_array_equal(convex.in_units(units).frame, convex.frame * units)
    tall = Cylinder(convex, 3)
    np.testing.assert_array_equal(tall.frame[:, :2], convex.frame)
    np.testing.assert_array_equal(tall.frame[:, 2], 0.0)


def test_an_ellipsoid_that_is_thin_beyond_the_eps_is_one_still():
    thin = Ellipsoid(np.zeros(2), np.array([[1e-24, 0.5e-12], [0.5e-12, 1.0]]))
    np.testing.assert_allclose(thin.in_units(np.array([2.0**-40, 1.0])).shape[0, 0], 1e-24 * 2.0**80)


@pytest.mark.parametrize("size", [1e-300, 3e-12, 0.6, 1.0, 1.2, 1.3, 7e11])
def test_the_power_of_two_follows_its_size_exactly(size):
    unit = float(power_of_two(np.array(size)))
    assert 0.6 <= size / unit <= 1.21 and np.log2(unit) == round(np.log2(unit))
    assert power_of_two(np.array(size * 2.0**50)) == unit * 2.0**50
    assert power_of_two(np.array([0.0, np.inf])).tolist() == [1.0, 1.0]


def test_an_uncertain_system_in_other_units_is_the_same_in_values_and_taylor_models():
    names = ("p1", "p2")
    matrices = [
        parse_matrix("A", [["-1 + p1", "p2**2"], [0.0, "sin(p1)"]], names),
        parse_matrix("B", [[1.0], ["p2"]], names),
    ]
    plain = LinearSystem(*matrices, parameters=Box(np.array([1.0, 2.0]), np.array([1.5, 4.0])), names=names)
    d, m, w, p = np.array([4.0, 0.5]), np.array([8.0]), np.array([0.25, 2.0]), np.array([0.5, 1024.0])
    rate = 16.0 / d[:, None]
    factors = (rate * d, rate * m, rate * w)
    other = plain.in_units(*factors, p)
    points = np.array([[1.0, 2.0], [1.5, 3.0]])
    for ours, theirs, factor in zip(other.matrices(points / p), plain.matrices(points), factors, strict=True):
        np.testing.assert_array_equal(ours, theirs * factor)
    middle, radius = np.array([1.25, 3.0]), np.array([0.25, 1.0])
    space = TaylorSpace(2, 3)
    found, wanted = other.taylor(space, middle / p, radius / p), plain.taylor(space, middle, radius)
    for ours, theirs, name in zip(found, wanted, "AABBEE", strict=True):
        np.testing.assert_array_equal(ours, theirs * factors["ABE".index(name)])
    assert other.describe(points[0] / p) == plain.describe(points[0])
