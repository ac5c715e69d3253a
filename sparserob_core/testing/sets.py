"""The contract of convex sets: what the support function says, every other answer must agree with."""

from __future__ import annotations

from abc import ABC, abstractmethod

import numpy as np

from sparserob_core.sip.convex_set import Array, ConvexSet

DIRECTIONS = 400
CLOSE = 1e-7  # relative to the set's extent


class SetContract(ABC):
    """What every convex set must keep: subclass it in a test module as ``class TestMine(SetContract)`` and give
    ``create``.

    The support function is taken as the definition of the set, and is itself tested to be one; a linear program says
    what the half-spaces of a flat set allow, and sampled directions what any set does.
    """

    @abstractmethod
    def create(self) -> ConvexSet:
        """A bounded set with an interior, in one to four dimensions."""

    def directions(self, convex: ConvexSet) -> Array:
        """Random directions ``(k, d)``, not normalised, and the axes both ways."""
        axes = np.eye(convex.dimension)
        return np.vstack([np.random.default_rng(7).normal(size=(DIRECTIONS, convex.dimension)), axes, -axes])

    def extent(self, convex: ConvexSet) -> float:
        """The longest side of the bounding box."""
        axes = np.eye(convex.dimension)
        return float((convex.support(axes) + convex.support(-axes)).max())

    def excess(self, convex: ConvexSet, points: Array) -> Array:
        """``max c'x - h(c)`` of points ``(k, d)`` over unit directions: positive for points that are outside."""
        c = self.directions(convex)
        c = c / np.linalg.norm(c, axis=1, keepdims=True)
        outside: Array = (points @ c.T - convex.support(c)).max(axis=1)
        return outside

    def around(self, convex: ConvexSet) -> Array:
        """Points ``(k, d)`` inside and outside."""
        rng = np.random.default_rng(8)
        return convex.interior_point() + self.extent(convex) * rng.normal(size=(60, convex.dimension))

    def test_a_support_point_attains_the_support_function_and_is_in_the_set(self) -> None:
        convex = self.create()
        c = self.directions(convex)
        points, tolerance = convex.support_point(c), CLOSE * self.extent(convex)
        assert (np.abs((c * points).sum(axis=1) - convex.support(c)) <= tolerance * np.linalg.norm(c, axis=1)).all()
        assert (self.excess(convex, points) <= tolerance).all(), "a support point is outside of the set"

    def test_the_support_function_is_sublinear(self) -> None:
        convex = self.create()
        c = self.directions(convex)
        e = c[::-1]
        tolerance = CLOSE * self.extent(convex) * (1.0 + np.abs(c).max())
        assert (convex.support(c + e) <= convex.support(c) + convex.support(e) + tolerance).all()
        assert (np.abs(convex.support(2.5 * c) - 2.5 * convex.support(c)) <= tolerance).all()
        assert (convex.support(c) + convex.support(-c) >= -tolerance).all()
        assert np.abs(convex.support(np.zeros((1, convex.dimension)))).max() <= tolerance

    def test_leading_axes_are_kept(self) -> None:
        convex = self.create()
        block = self.directions(convex)[:6].reshape(2, 3, -1)
        for answer in (convex.support, convex.gauge, convex.violation):
            assert answer(block).shape == (2, 3)
            assert np.allclose(answer(block)[1, 2], answer(block[1, 2][None])[0], rtol=1e-9, atol=1e-12)
        assert convex.support_point(block).shape == convex.normal(block).shape == block.shape
        assert convex.linearisation_excess(block, np.zeros((2, 3, 1, convex.dimension))).shape == (2, 3)

    def test_half_spaces_allow_what_the_support_function_says(self) -> None:
        from scipy.optimize import linprog

        convex = self.create()
        flat = convex.halfspaces()
        if flat is None:
            return
        for c in self.directions(convex)[-6:]:
            best = linprog(-c, flat[0], flat[1], bounds=(None, None))
            assert best.status == 0, "the half-spaces leave a direction open, the support function does not"
            assert abs(-best.fun - convex.support(c[None])[0]) <= 10 * CLOSE * self.extent(convex)

    def test_the_bounding_box_touches_the_set_on_every_side(self) -> None:
        convex = self.create()
        box, axes, tolerance = convex.bounding_box(), np.eye(convex.dimension), CLOSE * self.extent(convex)
        assert np.abs(box.upper - convex.support(axes)).max() <= tolerance
        assert np.abs(box.lower + convex.support(-axes)).max() <= tolerance
        assert convex.is_bounded
        if convex.is_box:
            c = self.directions(convex)
            assert np.allclose(box.support(c), convex.support(c)), "it is no box"

    def test_the_interior_point_is_strictly_inside(self) -> None:
        convex = self.create()
        c = self.directions(convex)
        assert (c @ convex.interior_point() < convex.support(c)).all()
        assert convex.gauge(convex.interior_point()) <= 1e-12

    def test_the_gauge_is_1_on_the_boundary_and_grows_in_proportion(self) -> None:
        convex = self.create()
        middle, boundary = convex.interior_point(), convex.support_point(self.directions(convex))
        assert np.abs(convex.gauge(boundary) - 1.0).max() <= 1e-6
        for factor in (0.3, 1.0, 4.0):
            points = middle + factor * (self.around(convex) - middle)
            sizes = convex.gauge(points)
            assert np.allclose(sizes, factor * convex.gauge(self.around(convex)), rtol=1e-6)
            drawn = middle + (points - middle) / np.maximum(sizes, 1e-9)[:, None]
            assert (self.excess(convex, drawn) <= 1e-6 * self.extent(convex)).all(), "a drawn point is outside"
            c = self.directions(convex)
            least = ((points - middle) @ c.T / (convex.support(c) - c @ middle)).max(axis=1)
            assert (sizes >= least * (1.0 - 1e-6)).all(), "the gauge says inside where a half-space says outside"

    def test_a_normal_supports_the_set_where_it_stands(self) -> None:
        convex = self.create()
        middle, around = convex.interior_point(), self.around(convex)
        boundary = middle + (around - middle) / convex.gauge(around)[:, None]
        normals = convex.normal(boundary)
        lengths = np.linalg.norm(normals, axis=1)
        assert (lengths > 0).all()
        height = (normals * boundary).sum(axis=1)
        assert (np.abs(height - convex.support(normals)) <= 1e-4 * self.extent(convex) * lengths).all()

    def test_violation_is_positive_outside_only_and_never_below_the_excess(self) -> None:
        convex = self.create()
        points = np.vstack([self.around(convex), convex.support_point(self.directions(convex)[:20])])
        found, least, size = convex.violation(points), self.excess(convex, points), self.extent(convex)
        if convex.halfspaces() is None:
            assert (found >= least - 1e-6 * size).all()
        sizes = convex.gauge(points)
        clear = np.abs(sizes - 1.0) > 1e-5
        assert ((found > 0) == (sizes > 1))[clear].all()
        assert (convex.contains(points, 1e-6 * size) == (sizes <= 1.0))[clear & (np.abs(found) > 1e-5 * size)].all()

    def test_samples_are_in_the_set_on_all_sides_and_the_same_for_the_same_seed(self) -> None:
        convex = self.create()
        points = convex.sample(300, np.random.default_rng(1))
        assert points.shape == (300, convex.dimension)
        assert points.tolist() == convex.sample(300, np.random.default_rng(1)).tolist()
        assert (self.excess(convex, points) <= CLOSE * self.extent(convex)).all(), "a sample is outside"
        sides = (points - points.mean(axis=0)) @ self.directions(convex).T
        assert (sides.max(axis=0) > 0).all() and np.unique(points, axis=0).shape[0] > 250

    def test_extreme_samples_are_on_the_boundary(self) -> None:
        convex = self.create()
        points = convex.sample_extreme(50, np.random.default_rng(2))
        assert points.shape == (50, convex.dimension)
        assert np.abs(convex.gauge(points) - 1.0).max() <= 1e-6
        assert np.unique(np.round(points, 9), axis=0).shape[0] > 1

    def test_scaled_about_its_middle_it_is_larger_in_proportion(self) -> None:
        convex = self.create()
        c, middle = self.directions(convex), convex.middle()
        assert self.excess(convex, middle[None])[0] <= CLOSE * self.extent(convex)
        for factor in (0.25, 1.0, 3.0):
            expected = factor * convex.support(c) + (1.0 - factor) * (c @ middle)
            assert np.allclose(convex.scaled(factor).support(c), expected, rtol=1e-9, atol=1e-9 * self.extent(convex))

    def test_in_other_units_it_is_the_same_set(self) -> None:
        convex = self.create()
        units = np.ldexp(1.0, np.arange(convex.dimension) - 1)
        other, c = convex.in_units(units), self.directions(convex)
        assert np.allclose(other.support(c), convex.support(c / units), rtol=1e-12)
        points = self.around(convex)
        sizes = convex.gauge(points)
        clear = np.abs(sizes - 1.0) > 1e-5  # about another interior point, perhaps
        assert ((other.gauge(points / units) > 1) == (sizes > 1))[clear].all()

    def test_the_support_function_stays_between_its_bounds_around_a_direction(self) -> None:
        convex, rng = self.create(), np.random.default_rng(3)
        tolerance = CLOSE * self.extent(convex)
        shifts = np.vstack([rng.uniform(-1.0, 1.0, (60, 2)), [[1, 1], [1, -1], [-1, 1], [-1, -1], [0, 0]]])
        for centre in self.directions(convex)[:12]:
            spread = rng.uniform(0.01, 1.0) * rng.normal(size=(2, convex.dimension))
            truth = convex.support(centre + shifts @ spread)
            tangent = (centre + shifts @ spread) @ convex.support_point(centre[None])[0]
            assert (truth - tangent).max() <= convex.linearisation_excess(centre, spread) + tolerance
            value, gradient, hessian = convex.support_minorant(centre, spread)
            below = value + shifts @ gradient + np.einsum("si,ij,sj->s", shifts, hessian, shifts) / 2
            assert (below <= truth + tolerance).all(), "the quadratic is above the support function"

    def test_an_image_of_the_ball_has_the_support_function_of_one(self) -> None:
        convex = self.create()
        image, c = convex.unit_ball_image(), self.directions(convex)
        if image is not None:
            height = c @ image[0] + np.linalg.norm(c @ image[1], axis=1)
            assert np.allclose(height, convex.support(c), rtol=1e-9, atol=CLOSE * self.extent(convex))
