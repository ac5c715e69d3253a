"""The contract of convex sets: what the support function says, every other answer must agree with."""

from __future__ import annotations

from typing import cast

import numpy as np

from sparserob_core.control.sets.sets import SetFactory
from sparserob_core.sip.convex_set import Array, ConvexSet
from sparserob_core.testing.contract import Contract, demand

DRAWN_DIRECTIONS = 400  # in which a set is measured, beside the axes
EXTENT_ACCURACY = 1e-7  # relative to the set's extent


class SetContract(Contract[ConvexSet], kind="set"):
    """Contract of a convex set: subclass it in a test module as ``class TestMine(SetContract)`` and give ``component``.

    The component is a `ConvexSet`, or a `SetFactory`, which then builds a set in ``dimension`` coordinates (2). The
    support function is taken as the definition of the set, and is itself tested to be a support function. A linear
    program gives the points that the half-spaces of a flat set allow; sampled directions serve for every set.
    """

    dimension = 2

    def create(self) -> ConvexSet:
        """A bounded set with an interior, in one to four dimensions."""
        component: object = super().create()
        return component.build(self.dimension) if isinstance(component, SetFactory) else cast(ConvexSet, component)

    def expected(self) -> tuple[type, ...]:
        """A set, or what builds one."""
        return (ConvexSet, SetFactory)

    def directions(self, convex: ConvexSet) -> Array:
        """Random directions ``(k, d)``, not normalised, and the axes both ways."""
        axes = np.eye(convex.dimension)
        return np.vstack([np.random.default_rng(7).normal(size=(DRAWN_DIRECTIONS, convex.dimension)), axes, -axes])

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
        points, tolerance = convex.support_point(c), EXTENT_ACCURACY * self.extent(convex)
        errors = np.abs((c * points).sum(axis=1) - convex.support(c)) / np.linalg.norm(c, axis=1)
        demand(
            (errors <= tolerance).all(),
            f"at its support point `c'x` is not the support function, but off by {errors.max():.2g} |c|",
            "return the point of the set that goes furthest in the direction c, which need not have length 1",
        )
        excess = float(self.excess(convex, points).max())
        demand(
            excess <= tolerance,
            f"a support point is outside of the set, by {excess:.2g}",
            "see that `support` and `support_point` are about the same set",
        )

    def test_the_support_function_is_sublinear(self) -> None:
        convex = self.create()
        c = self.directions(convex)
        e = c[::-1]
        tolerance = EXTENT_ACCURACY * self.extent(convex) * (1.0 + np.abs(c).max())
        demand(
            (convex.support(c + e) <= convex.support(c) + convex.support(e) + tolerance).all(),
            "h(c + e) is above h(c) + h(e) somewhere: this is the support function of no set",
            "take `max {c'x}` over a convex set; a gauge, or a square, is something else",
        )
        demand(
            (np.abs(convex.support(2.5 * c) - 2.5 * convex.support(c)) <= tolerance).all(),
            "h(2.5 c) is not 2.5 h(c): this is the support function of no set",
            "directions have any length: divide by none, and square none",
        )
        demand(
            (convex.support(c) + convex.support(-c) >= -tolerance).all(),
            "h(c) + h(-c) is negative somewhere: the set would be empty",
            "see that bounds are not exchanged, and radii not negative",
        )
        demand(
            np.abs(convex.support(np.zeros((1, convex.dimension)))).max() <= tolerance,
            "h(0) is not 0",
            "the direction 0 is allowed: divide by no length without asking whether it is 0",
        )

    def test_leading_axes_are_kept(self) -> None:
        convex = self.create()
        block = self.directions(convex)[:6].reshape(2, 3, -1)
        for answer in (convex.support, convex.gauge, convex.violation):
            name = answer.__name__
            demand(
                answer(block).shape == (2, 3),
                f"{name} returned the shape {answer(block).shape} for an array of shape {block.shape}",
                f"work along the last axis only (`axis=-1`, `x @ M.T`): (..., d) becomes (...,) in {name}",
            )
            demand(
                np.allclose(answer(block)[1, 2], answer(block[1, 2][None])[0], rtol=1e-9, atol=1e-12),
                f"{name} has another answer for one of many than for the same alone",
                "compute each answer from its own row: no mean, maximum or order over the others",
            )
        demand(
            convex.support_point(block).shape == convex.normal(block).shape == block.shape,
            f"support_point returned the shape {convex.support_point(block).shape}, normal "
            f"{convex.normal(block).shape}, for an array of shape {block.shape}",
            "work along the last axis only: (..., d) stays (..., d)",
        )
        demand(
            convex.linearisation_excess(block, np.zeros((2, 3, 1, convex.dimension))).shape == (2, 3),
            "linearisation_excess does not return one number for each centre",
            "centres (..., d) and spreads (..., k, d) become (...,)",
        )

    def test_half_spaces_allow_what_the_support_function_says(self) -> None:
        from scipy.optimize import linprog

        convex = self.create()
        flat = convex.halfspaces()
        if flat is None:
            return
        for c in self.directions(convex)[-6:]:
            best = linprog(-c, flat[0], flat[1], bounds=(None, None))
            demand(
                best.status == 0,
                "the half-spaces leave a direction open, the support function does not",
                "return every side of the set, or None for a set that is not flat",
            )
            demand(
                abs(-best.fun - convex.support(c[None])[0]) <= 10 * EXTENT_ACCURACY * self.extent(convex),
                f"in the direction {c} the half-spaces allow {-best.fun:.9g}, the support function "
                f"{convex.support(c[None])[0]:.9g}",
                "`halfspaces` returns H (r, d) and h (r,) of `H x <= h`, with all sides of the set and no others",
            )

    def test_the_bounding_box_touches_the_set_on_every_side(self) -> None:
        convex = self.create()
        box, axes, tolerance = convex.bounding_box(), np.eye(convex.dimension), EXTENT_ACCURACY * self.extent(convex)
        demand(
            np.abs(box.upper - convex.support(axes)).max() <= tolerance
            and np.abs(box.lower + convex.support(-axes)).max() <= tolerance,
            f"the bounding box from {box.lower} to {box.upper} does not touch the set on every side",
            "leave `bounding_box` out: the default asks the support function",
        )
        demand(convex.is_bounded, "it says that it is not bounded", "the contract is for bounded sets")
        if convex.is_box:
            c = self.directions(convex)
            demand(
                np.allclose(box.support(c), convex.support(c)),
                "it says that it is a box, and is none",
                "leave `is_box` out unless the set is its bounding box",
            )

    def test_the_interior_point_is_strictly_inside(self) -> None:
        convex = self.create()
        c = self.directions(convex)
        demand(
            (c @ convex.interior_point() < convex.support(c)).all(),
            f"the interior point {convex.interior_point()} is on the boundary, or outside",
            "return a point around which there is room in every direction; a set without interior is no set here",
        )
        demand(
            convex.gauge(convex.interior_point()) <= 1e-12,
            f"the gauge of the interior point is {float(convex.gauge(convex.interior_point())):.3g}",
            "the gauge is measured from the interior point: 0 there, and 1 on the boundary",
        )

    def test_the_gauge_is_1_on_the_boundary_and_grows_in_proportion(self) -> None:
        convex = self.create()
        middle, boundary = convex.interior_point(), convex.support_point(self.directions(convex))
        demand(
            np.abs(convex.gauge(boundary) - 1.0).max() <= 1e-6,
            f"the gauge of points of the boundary lies between {convex.gauge(boundary).min():.6g} and "
            f"{convex.gauge(boundary).max():.6g}",
            "the gauge is measured from `interior_point`: 1 on the boundary; or leave `gauge` out",
        )
        for factor in (0.3, 1.0, 4.0):
            points = middle + factor * (self.around(convex) - middle)
            sizes = convex.gauge(points)
            demand(
                np.allclose(sizes, factor * convex.gauge(self.around(convex)), rtol=1e-6),
                f"the gauge of a point {factor:g} times as far from the interior point is not {factor:g} times it",
                "the gauge is measured from `interior_point`, and grows in proportion",
            )
            drawn = middle + (points - middle) / np.maximum(sizes, 1e-9)[:, None]
            demand(
                (self.excess(convex, drawn) <= 1e-6 * self.extent(convex)).all(),
                "a point that is drawn towards the interior point by its gauge is outside: the gauge is too small",
                "1 on the boundary, for every direction; or leave `gauge` out",
            )
            c = self.directions(convex)
            least = ((points - middle) @ c.T / (convex.support(c) - c @ middle)).max(axis=1)
            demand(
                (sizes >= least * (1.0 - 1e-6)).all(),
                "the gauge says inside where the support function says outside",
                "1 on the boundary, for every direction; or leave `gauge` out",
            )

    def test_a_normal_supports_the_set_where_it_stands(self) -> None:
        convex = self.create()
        middle, around = convex.interior_point(), self.around(convex)
        boundary = middle + (around - middle) / convex.gauge(around)[:, None]
        normals = convex.normal(boundary)
        lengths = np.linalg.norm(normals, axis=1)
        demand((lengths > 0).all(), "a normal is 0", "a normal of any length but 0, for points outside as well")
        height = (normals * boundary).sum(axis=1)
        demand(
            (np.abs(height - convex.support(normals)) <= 1e-4 * self.extent(convex) * lengths).all(),
            "a normal c at a point x of the boundary has `c'x` below the support function of c",
            "return the direction in which the set goes no further than x, outwards; or leave `normal` out",
        )

    def test_violation_is_positive_outside_only_and_never_below_the_excess(self) -> None:
        convex = self.create()
        points = np.vstack([self.around(convex), convex.support_point(self.directions(convex)[:20])])
        violations, least, size = convex.violation(points), self.excess(convex, points), self.extent(convex)
        if convex.halfspaces() is None:
            demand(
                (violations >= least - 1e-6 * size).all(),
                "a violation is smaller than what the point sticks out in some direction",
                "`violation` is at least `max c'x - h(c)` over directions of length 1; or leave it out",
            )
        sizes = convex.gauge(points)
        is_clear = np.abs(sizes - 1.0) > 1e-5
        demand(
            ((violations > 0) == (sizes > 1))[is_clear].all(),
            "the violation is positive for a point inside, or not for one outside",
            "positive outside, at most 0 inside; or leave `violation` out",
        )
        demand(
            (convex.contains(points, 1e-6 * size) == (sizes <= 1.0))[
                is_clear & (np.abs(violations) > 1e-5 * size)
            ].all(),
            "contains does not say the same as the gauge",
            "leave `contains` out: the default asks `violation`",
        )

    def test_samples_are_in_the_set_on_all_sides_and_the_same_for_the_same_seed(self) -> None:
        convex = self.create()
        points = convex.sample(300, np.random.default_rng(1))
        demand(
            points.shape == (300, convex.dimension),
            f"sample(300, rng) returned the shape {points.shape}",
            f"one point of {convex.dimension} coordinates for each of the count",
        )
        demand(
            points.tolist() == convex.sample(300, np.random.default_rng(1)).tolist(),
            "the same seed gives other samples",
            "draw from the `rng` that is given only",
        )
        demand(
            (self.excess(convex, points) <= EXTENT_ACCURACY * self.extent(convex)).all(),
            "a sample is outside of the set",
            "draw points of the set, not of its box; or leave `sample` out",
        )
        sides = (points - points.mean(axis=0)) @ self.directions(convex).T
        demand(
            (sides.max(axis=0) > 0).all() and np.unique(points, axis=0).shape[0] > 250,
            "samples do not lie on all sides of their mean, or are the same point again and again",
            "draw from the whole set; or leave `sample` out",
        )

    def test_extreme_samples_are_on_the_boundary(self) -> None:
        convex = self.create()
        points = convex.sample_extreme(50, np.random.default_rng(2))
        demand(
            points.shape == (50, convex.dimension) and np.abs(convex.gauge(points) - 1.0).max() <= 1e-6,
            "an extreme sample is not on the boundary",
            "return support points of drawn directions; or leave `sample_extreme` out",
        )
        demand(
            np.unique(np.round(points, 9), axis=0).shape[0] > 1,
            "all extreme samples are the same point",
            "draw a direction for each; or leave `sample_extreme` out",
        )

    def test_scaled_about_its_middle_it_is_larger_in_proportion(self) -> None:
        convex = self.create()
        c, middle = self.directions(convex), convex.middle()
        demand(
            self.excess(convex, middle[None])[0] <= EXTENT_ACCURACY * self.extent(convex),
            f"the middle {middle} is outside of the set",
            "leave `middle` out",
        )
        for factor in (0.25, 1.0, 3.0):
            expected = factor * convex.support(c) + (1.0 - factor) * (c @ middle)
            demand(
                np.allclose(convex.scaled(factor).support(c), expected, rtol=1e-9, atol=1e-9 * self.extent(convex)),
                f"scaled({factor:g}) is not the set that is {factor:g} times as large about its middle",
                "scale about `middle`, not about the origin; or leave `scaled` out",
            )

    def test_in_other_units_it_is_the_same_set(self) -> None:
        convex = self.create()
        units = np.ldexp(1.0, np.arange(convex.dimension) - 1)
        scaled, c = convex.in_units(units), self.directions(convex)
        demand(
            np.allclose(scaled.support(c), convex.support(c / units), rtol=1e-12),
            f"in_units({units}) is not the set of all x / units",
            "h(c) becomes h(c / units); or leave `in_units` out",
        )
        points = self.around(convex)
        sizes = convex.gauge(points)
        is_clear = np.abs(sizes - 1.0) > 1e-5  # about another interior point, perhaps
        demand(
            ((scaled.gauge(points / units) > 1) == (sizes > 1))[is_clear].all(),
            "in other units another point is inside",
            "points become x / units; or leave `in_units` out",
        )

    def test_the_support_function_stays_between_its_bounds_around_a_direction(self) -> None:
        convex, rng = self.create(), np.random.default_rng(3)
        tolerance = EXTENT_ACCURACY * self.extent(convex)
        shifts = np.vstack([rng.uniform(-1.0, 1.0, (60, 2)), [[1, 1], [1, -1], [-1, 1], [-1, -1], [0, 0]]])
        for centre in self.directions(convex)[:12]:
            spread = rng.uniform(0.01, 1.0) * rng.normal(size=(2, convex.dimension))
            truth = convex.support(centre + shifts @ spread)
            tangent = (centre + shifts @ spread) @ convex.support_point(centre[None])[0]
            demand(
                (truth - tangent).max() <= convex.linearisation_excess(centre, spread) + tolerance,
                "around a direction the support function is further above its linearisation than "
                "linearisation_excess says: what it proves is not true",
                "bound `h(c + s'D) - (c + s'D)'x(c)` for all s in [-1, 1]^k, from above; or leave it out",
            )
            point, offset = convex.support_majorant(centre, spread)
            demand(
                (truth - (centre + shifts @ spread) @ point).max() <= offset + tolerance,
                "around a direction the support function is above what support_majorant says",
                "bound `h(c + s'D) - (c + s'D)'x` for all s in [-1, 1]^k, from above, by the x that you return; or "
                "leave it out",
            )
            value, gradient, hessian = convex.support_minorant(centre, spread)
            below = value + shifts @ gradient + np.einsum("si,ij,sj->s", shifts, hessian, shifts) / 2
            demand(
                (below <= truth + tolerance).all(),
                "around a direction the quadratic of support_minorant is above the support function",
                "a minorant lies below for all s in [-1, 1]^k; or leave it out",
            )

    def test_an_image_of_the_ball_has_the_support_function_of_one(self) -> None:
        convex = self.create()
        image, c = convex.unit_ball_image(), self.directions(convex)
        if image is not None:
            height = c @ image[0] + np.linalg.norm(c @ image[1], axis=1)
            demand(
                np.allclose(height, convex.support(c), rtol=1e-9, atol=EXTENT_ACCURACY * self.extent(convex)),
                "the image of the ball has another support function than the set",
                "return the centre (d,) and M (d, k) of the set `centre + M ball`, or None for what is no such image",
            )
