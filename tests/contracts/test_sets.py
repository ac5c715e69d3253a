"""Guards sparserob_core/testing/sets and every registered set: each keeps the contract of convex sets, with nothing but
its support function too, and sets that are wrong on purpose fail it."""

from __future__ import annotations

import numpy as np
import pytest

import sparserob_core as sr
from sparserob_core.control.sets.sets import Product, product
from sparserob_core.testing import SetContract
from tests.support.faults import fails

REGISTRY = sr.load_registry()
EXAMPLES = {
    "box": [(2, {"half_widths": [0.5, 2.0]}), (3, {"lower": [-1.0, 0.0, -3.0], "upper": [1.0, 4.0, -1.0]})],
    "polytope": [
        (1, {"H": [[2.0], [-1.0]], "h": [1.0, 3.0]}),
        (2, {"H": [[1, 0], [-1, 0], [0, 1], [0, -1], [1, 1]], "h": [1.0, 1.0, 2.0, 1.0, 1.5]}),
    ],
    "ellipsoid": [(2, {"centre": [1.0, -2.0], "shape": [[2.0, 0.6], [0.6, 0.5]]}), (3, {"shape": 4.0})],
    "norm": [
        (1, {"p": 2.0, "radius": 0.7}),
        *[(2, {"p": p, "radius": 1.5, "centre": [0.5, -1.0]}) for p in (1.0, 1.4, 2.0, 5.0, "inf")],
        (3, {"p": 3.0, "radius": 0.5}),
        (4, {"p": 1.0, "radius": 1.0}),
    ],
    "zonotope": [
        (1, {"generators": [[0.5], [0.25]], "centre": 3.0}),
        (2, {"generators": [[1.0, 0.2], [0.3, 1.0], [0.0, -0.4]], "centre": [1.0, 2.0]}),
        (3, {"generators": [[1, 0, 0], [0, 1, 0], [0, 0, 1], [1, 1, 1]]}),
    ],
}
CASES = [(kind, *case) for kind, cases in EXAMPLES.items() for case in cases if kind in REGISTRY.names("set")]


def test_every_registered_set_has_an_example():
    own = {record.name for record in REGISTRY.records() if record.kind == "set"}
    assert {"box", "polytope", "ellipsoid", "norm"} <= own <= set(EXAMPLES)


class Bare(sr.ConvexSet):
    """A set with the three abstract members and nothing else, as a new kind begins."""

    def __init__(self, base):
        self.base = base

    @property
    def dimension(self):
        return self.base.dimension

    def support(self, directions):
        return self.base.support(directions)

    def support_point(self, directions):
        return self.base.support_point(directions)


@pytest.mark.parametrize(("kind", "dimension", "options"), CASES)
class TestRegisteredSet(SetContract):
    @pytest.fixture(autouse=True)
    def chosen(self, kind, dimension, options):
        self.convex = REGISTRY.build("set", kind, options).build(dimension)

    def create(self):
        return self.convex


@pytest.mark.parametrize(("kind", "dimension", "options"), CASES)
class TestSetOfThreeMembers(SetContract):
    @pytest.fixture(autouse=True)
    def chosen(self, kind, dimension, options):
        self.convex = Bare(REGISTRY.build("set", kind, options).build(dimension))

    def create(self):
        return self.convex

    def test_its_defaults_agree_with_what_the_set_knows_better(self):
        bare, known, points = self.convex, self.convex.base, self.around(self.convex)
        if np.allclose(bare.interior_point(), known.interior_point()):
            np.testing.assert_allclose(bare.gauge(points), known.gauge(points), rtol=1e-9)
        outside = known.violation(points) > 0
        np.testing.assert_array_equal(bare.violation(points) > 0, outside)


class Scaled(SetContract):
    def create(self):
        return sr.NormBall(3.0, 1.0, centre=[2.0, 1.0]).in_units(np.array([2.0, 0.5])).scaled(1.5)


class TestScaledSet(Scaled):
    pass


class TestProductOfABallABoxAndAnEllipsoid(SetContract):
    def create(self):
        ellipsoid = sr.Ellipsoid([1.0, 0.5], [[2.0, 0.3], [0.3, 0.5]])
        return Product((sr.NormBall(2.0, 0.5, centre=[2.0, 1.0]), sr.Box([-1.0], [3.0]), ellipsoid))


@pytest.mark.parametrize("seed", range(4))
def test_a_product_is_its_parts(seed):
    """As a box or a polytope where it is one, by value in every direction; its support function is their sum."""
    rng = np.random.default_rng(seed)
    directions = rng.normal(size=(50, 4))
    box, rhombus = sr.Box([-1.0, 0.0], [0.5, 2.0]), sr.NormBall(1.0, 1.5, dimension=2)
    ball = sr.NormBall(2.0, 0.7, dimension=2)
    for parts, kind in (([box, box], sr.Box), ([box, rhombus], sr.Polytope), ([box, ball], Product)):
        made = product(parts)
        assert isinstance(made, kind)
        known = parts[0].support(directions[:, :2]) + parts[1].support(directions[:, 2:])
        np.testing.assert_allclose(made.support(directions), known, rtol=1e-9)
        points = made.support_point(directions)
        np.testing.assert_allclose((points * directions).sum(axis=1), known, rtol=1e-9)
        assert made.contains(made.sample(20, rng)).all()
        assert not made.contains(points + 1e-3 * directions).any()
    assert product([ball]) is ball


class Disc(sr.ConvexSet):
    """A right set, for wrong ones to inherit from: the disc of radius 2 about (1, 0)."""

    dimension = 2
    centre = np.array([1.0, 0.0])

    def support(self, directions):
        return directions @ self.centre + 2.0 * np.linalg.norm(directions, axis=-1)

    def support_point(self, directions):
        lengths = np.linalg.norm(directions, axis=-1, keepdims=True)
        return self.centre + 2.0 * directions / np.where(lengths > 0, lengths, 1.0)


class TestDisc(SetContract):
    def create(self):
        return Disc()


class PointTooFar(Disc):
    def support_point(self, directions):
        return 1.05 * super().support_point(directions)


class NotConvex(Disc):
    def support(self, directions):
        return directions @ self.centre + 2.0 * np.sqrt(np.abs(directions)).sum(axis=-1) ** 2


class NotHomogeneous(Disc):
    def support(self, directions):
        return super().support(directions) + (directions**2).sum(axis=-1)


class Flattening(Disc):
    def support(self, directions):
        return super().support(directions).reshape(-1)


class TooFewSides(Disc):
    def halfspaces(self):
        H = np.vstack([np.eye(2), -np.eye(2)])
        return H, self.support(H)


class WrongBox(Disc):
    is_box = True


class WideBox(Disc):
    def bounding_box(self):
        return sr.Box(-4.0 * np.ones(2), 4.0 * np.ones(2))


class EdgeAsInside(Disc):
    def interior_point(self):
        return np.array([3.0, 0.0])


class SmallGauge(Disc):
    def gauge(self, points):
        return 0.9 * super().gauge(points)


class SkewNormal(Disc):
    def normal(self, points):
        return super().normal(points) @ np.array([[1.0, 0.3], [-0.3, 1.0]])


class Lenient(Disc):
    def violation(self, points):
        return super().violation(points) - 0.5


class SamplesTheBox(Disc):
    def sample(self, count, rng):
        return self.bounding_box().sample(count, rng)


class Unseeded(Disc):
    def sample(self, count, rng):
        return super().sample(count, np.random.default_rng())


class SameSample(Disc):
    def sample(self, count, rng):
        return np.tile(self.interior_point(), (count, 1))


class InnerExtremes(Disc):
    def sample_extreme(self, count, rng):
        return self.sample(count, rng)


class ScaledAboutTheOrigin(Disc):
    def scaled(self, factor):
        larger = Disc()
        larger.support = lambda directions: factor * Disc().support(directions)
        return larger


class UnitsUpsideDown(Disc):
    def in_units(self, units):
        return super().in_units(1.0 / units)


class ExcessTooSmall(Disc):
    def linearisation_excess(self, centre, spread):
        return 0.1 * super().linearisation_excess(centre, spread)


class MajorantTooLow(Disc):
    def support_majorant(self, centre, spread):
        point, excess = super().support_majorant(centre, spread)
        return point, 0.1 * excess


class MinorantTooHigh(Disc):
    def support_minorant(self, centre, spread):
        value, gradient, hessian = super().support_minorant(centre, spread)
        return value, gradient, hessian + 0.5 * spread @ spread.T + np.eye(len(spread))


class AnotherBall(Disc):
    def unit_ball_image(self):
        return self.centre, np.eye(2)


FAULTS = {
    PointTooFar: "test_a_support_point_attains_the_support_function_and_is_in_the_set",
    NotConvex: "test_the_support_function_is_sublinear",
    NotHomogeneous: "test_the_support_function_is_sublinear",
    Flattening: "test_leading_axes_are_kept",
    TooFewSides: "test_half_spaces_allow_what_the_support_function_says",
    WrongBox: "test_the_bounding_box_touches_the_set_on_every_side",
    WideBox: "test_the_bounding_box_touches_the_set_on_every_side",
    EdgeAsInside: "test_the_interior_point_is_strictly_inside",
    SmallGauge: "test_the_gauge_is_1_on_the_boundary_and_grows_in_proportion",
    SkewNormal: "test_a_normal_supports_the_set_where_it_stands",
    Lenient: "test_violation_is_positive_outside_only_and_never_below_the_excess",
    SamplesTheBox: "test_samples_are_in_the_set_on_all_sides_and_the_same_for_the_same_seed",
    Unseeded: "test_samples_are_in_the_set_on_all_sides_and_the_same_for_the_same_seed",
    SameSample: "test_samples_are_in_the_set_on_all_sides_and_the_same_for_the_same_seed",
    InnerExtremes: "test_extreme_samples_are_on_the_boundary",
    ScaledAboutTheOrigin: "test_scaled_about_its_middle_it_is_larger_in_proportion",
    UnitsUpsideDown: "test_in_other_units_it_is_the_same_set",
    ExcessTooSmall: "test_the_support_function_stays_between_its_bounds_around_a_direction",
    MajorantTooLow: "test_the_support_function_stays_between_its_bounds_around_a_direction",
    MinorantTooHigh: "test_the_support_function_stays_between_its_bounds_around_a_direction",
    AnotherBall: "test_an_image_of_the_ball_has_the_support_function_of_one",
}


@pytest.mark.parametrize(("flawed", "test"), FAULTS.items(), ids=[one.__name__ for one in FAULTS])
def test_the_contract_catches_a_set_that_is_wrong_on_purpose(flawed, test):
    fails(SetContract, flawed, test)
