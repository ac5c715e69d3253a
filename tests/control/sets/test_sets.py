"""Guards control/sets/sets: sets: support functions, support points and half-spaces agree with one another and with a
linear program."""

from __future__ import annotations

from fractions import Fraction

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.optimize import linprog

from sparserob_core.control.sets.curved import _bound_power_excess
from sparserob_core.control.sets.sets import (
    Box,
    Cylinder,
    Ellipsoid,
    Equality,
    NormBall,
    Polytope,
    cylinder,
    intersection,
)
from sparserob_core.errors import InputError
from sparserob_core.sip.convex_set import ConvexSet

seeds = st.integers(0, 2**32 - 1)


def random_polytope(rng: np.random.Generator, d: int) -> Polytope:
    """A bounded polytope: a box cut by random half-spaces through its inside."""
    box = Box(-rng.uniform(0.5, 2, d), rng.uniform(0.5, 2, d))
    H, h = box.halfspaces()
    cuts = rng.normal(size=(4, d))
    return Polytope(np.vstack([H, cuts]), np.append(h, rng.uniform(0.1, 2, 4)))


def every_set(rng: np.random.Generator, d: int) -> list:
    root = rng.normal(size=(d, d))
    shape = root @ root.T + 0.1 * np.eye(d)
    balls = [NormBall(p, rng.uniform(0.1, 2), centre=rng.normal(size=d)) for p in (1.0, 1.5, 2.0, 4.0, np.inf)]
    return [
        Box(-rng.uniform(0, 2, d), rng.uniform(0, 2, d)),
        random_polytope(rng, d),
        Ellipsoid(rng.normal(size=d), shape),
        *balls,
    ]


@settings(max_examples=25, deadline=None)
@given(seeds, st.integers(1, 4))
def test_support_function_support_point_and_half_spaces_agree_with_a_linear_program(seed: int, d: int) -> None:
    rng = np.random.default_rng(seed)
    for member in every_set(rng, d):
        directions = rng.normal(size=(3, d))
        heights, points = member.support(directions), member.support_point(directions)
        np.testing.assert_allclose((directions * points).sum(axis=1), heights, rtol=1e-9, atol=1e-9)
        assert member.contains(points, 1e-8).all()
        flat = member.halfspaces()
        if flat is not None:
            programs = [-linprog(-c, flat[0], flat[1], bounds=(None, None)).fun for c in directions]
            np.testing.assert_allclose(heights, programs, rtol=1e-7, atol=1e-7)


@settings(max_examples=25, deadline=None)
@given(seeds, st.integers(1, 4))
def test_a_support_function_is_sublinear(seed: int, d: int) -> None:
    rng = np.random.default_rng(seed)
    for member in every_set(rng, d):
        c, e = rng.normal(size=(2, 5, d))
        assert (member.support(c + e) <= member.support(c) + member.support(e) + 1e-9).all()
        np.testing.assert_allclose(member.support(2.5 * c), 2.5 * member.support(c), rtol=1e-9, atol=1e-9)


@settings(max_examples=25, deadline=None)
@given(seeds, st.integers(1, 4))
def test_violation_is_the_largest_excess_over_unit_normals(seed: int, d: int) -> None:
    rng = np.random.default_rng(seed)
    normals = rng.normal(size=(2000, d))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    for member in every_set(rng, d):
        points = 3 * rng.normal(size=(6, d))
        excess = (points @ normals.T - member.support(normals)).max(axis=1)
        violation = member.violation(points)
        if member.halfspaces() is None:
            assert (violation >= excess - 1e-9).all()
            if d <= 2:
                np.testing.assert_allclose(violation[excess > 0], excess[excess > 0], rtol=1e-3, atol=1e-3)
        assert (np.sign(violation[np.abs(excess) > 1e-3]) >= np.sign(excess[np.abs(excess) > 1e-3])).all()
        assert member.contains(member.interior_point(), 1e-9)


@pytest.mark.first(4)
@pytest.mark.parametrize("p", [1.2, 2.0, 3.0, 7.0])
@pytest.mark.parametrize("radius", [0.0, 0.5])
def test_a_ball_contains_what_violates_it_by_no_more_than_the_tolerance(p: float, radius: float) -> None:
    ball = NormBall(p, radius, centre=[1.0, -2.0, 0.5])
    points = ball.centre + np.random.default_rng(7).normal(scale=0.5, size=(10, 5, 3))
    for tolerance in (-0.1, 0.0, 0.1, 0.3):
        inside = ball.contains(points, tolerance)
        assert (inside == (ball.violation(points) <= tolerance)).all()
        assert inside.any() != (radius == 0.0 and tolerance <= 0.0)
        assert bool(ball.contains(points[0, 0], tolerance)) == inside[0, 0]


@settings(max_examples=25, deadline=None)
@given(seeds, st.integers(1, 4))
def test_the_linearisation_excess_bounds_the_support_function_around_a_direction(seed: int, d: int) -> None:
    rng = np.random.default_rng(seed)
    for member in every_set(rng, d):
        centre, spread = rng.normal(size=(3, d)), rng.uniform(0.01, 1.0) * rng.normal(size=(3, 2, d))
        shifts = np.vstack([rng.uniform(-1, 1, (50, 2)), [[1, 1], [1, -1], [-1, 1], [-1, -1]]])
        around = centre + np.einsum("sj,kjd->skd", shifts, spread)
        truth = member.support(around) - (around * member.support_point(centre)).sum(axis=-1)
        assert (truth.max(axis=0) <= member.linearisation_excess(centre, spread) + 1e-9).all()


def test_the_linearisation_excess_of_a_round_set_is_of_second_order() -> None:
    for member in (Ellipsoid(np.ones(2), np.diag([1.0, 4.0])), NormBall(2.0, 3.0, dimension=2)):
        centre, spread = np.array([[1.0, 1.0]]), np.array([[[0.1, -0.3]]])
        assert member.linearisation_excess(centre, spread / 10)[0] < member.linearisation_excess(centre, spread)[0] / 80


class ByItsSupport(ConvexSet):
    """A set of which no more is known than its support function: what a stranger writes."""

    def __init__(self, base: ConvexSet) -> None:
        self.base = base

    @property
    def dimension(self) -> int:
        return self.base.dimension

    def support(self, directions: np.ndarray) -> np.ndarray:
        return self.base.support(directions)

    def support_point(self, directions: np.ndarray) -> np.ndarray:
        return self.base.support_point(directions)


@settings(max_examples=25, deadline=None)
@given(seeds, st.integers(1, 4), st.integers(1, 5))
def test_the_excess_of_a_set_that_is_known_by_its_support_function_is_a_bound(seed: int, d: int, count: int) -> None:
    rng = np.random.default_rng(seed)
    for base in every_set(rng, d):
        member = ByItsSupport(base)
        centre = rng.normal(size=(3, d)) * rng.integers(0, 2, size=(3, 1))  # 0 among them: every point is its best
        spread = rng.uniform(0.01, 1.0) * rng.normal(size=(3, count, d)) * rng.integers(0, 2, size=(1, count, 1))
        shifts = np.vstack([rng.uniform(-1, 1, (50, count)), rng.choice([-1.0, 1.0], (50, count))])
        around = centre + np.einsum("sj,kjd->skd", shifts, spread)
        truth = member.support(around) - (around * member.support_point(centre)).sum(axis=-1)
        excess = member.linearisation_excess(centre, spread)
        along = np.einsum("kd,kjd->kj", member.support_point(centre), spread)
        first = np.maximum(member.support(spread) - along, member.support(-spread) + along).sum(axis=-1)
        assert (truth.max(axis=0) <= excess + 1e-9).all()
        assert (excess <= first + 1e-12).all()


def test_the_excess_of_a_smooth_set_that_is_known_by_its_support_function_is_of_second_order() -> None:
    ball = NormBall(3.0, 2.0, dimension=3)
    member, centre = ByItsSupport(ball), np.array([1.0, -0.7, 0.4])
    spread = np.array([[0.1, -0.3, 0.2], [0.05, 0.1, 0.1], [0.0, 0.0, 0.0]])
    wide, narrow = (member.linearisation_excess(centre, scale * spread) for scale in (0.1, 0.01))
    assert narrow < wide / 80
    assert wide < 4.0 * ball.linearisation_excess(centre, 0.1 * spread)  # twice the closed form of two steps, each


@pytest.mark.first(1)
@pytest.mark.parametrize("d", [1, 2, 3])
def test_leading_axes_are_kept(d: int) -> None:
    rng = np.random.default_rng(d)
    directions = rng.normal(size=(4, 5, d))
    for member in every_set(rng, d):
        assert member.support(directions).shape == (4, 5)
        assert member.support_point(directions).shape == (4, 5, d)
        assert member.violation(directions).shape == (4, 5)
        np.testing.assert_allclose(
            member.support(directions)[2, 3], member.support(directions[2, 3][None])[0], rtol=1e-12
        )


def test_a_zero_direction_has_support_zero_and_a_point_of_the_set() -> None:
    for member in every_set(np.random.default_rng(0), 2):
        zero = np.zeros((1, 2))
        assert member.support(zero) == pytest.approx(0.0)
        assert member.contains(member.support_point(zero), 1e-9).all()


def test_an_unbounded_polytope_has_infinite_support_where_it_is_unbounded() -> None:
    wedge = Polytope(np.array([[-1.0, 0.0], [0.0, -1.0]]), np.array([1.0, 2.0]))
    assert not wedge.is_bounded
    np.testing.assert_array_equal(wedge.support(np.array([[1.0, 0.0], [-1.0, 0.0], [-1.0, -1.0]])), [np.inf, 1.0, 3.0])
    assert np.isfinite(wedge.support_point(np.array([[1.0, 0.0]]))).all()


@pytest.mark.parametrize("tilt", [0.0, 1e-3, 1e-9, 1e-12])
def test_a_polytope_that_contains_a_line_is_bounded_across_it_only_and_almost_a_line_is_none(tilt: float) -> None:
    """``|x1 - x2| <= 1/2``, and ``|x1 + x2| <= 1`` told in rows that are ``tilt`` long, if there are any."""
    rows = np.array([[1.0, -1.0], [-1.0, 1.0], [tilt, tilt], [-tilt, -tilt]])
    strip = Polytope(rows, np.array([0.5, 0.5, tilt, tilt]))
    directions = np.array([[1.0, -1.0], [1.0, 1.0], [1.0, 0.0]])
    expected = [0.5, 1.0, 0.75] if tilt else [0.5, np.inf, np.inf]
    np.testing.assert_allclose(strip.support(directions), expected, rtol=1e-9)
    np.testing.assert_allclose(strip.in_units(np.array([8.0, 8.0])).support(directions) * 8.0, expected, rtol=1e-9)


def test_a_polytope_without_interior_still_has_its_support_function() -> None:
    segment = Polytope(np.array([[1.0, 1.0], [-1.0, -1.0], [1.0, 0.0], [-1.0, 0.0]]), np.array([1.0, -1.0, 1.0, 0.0]))
    assert segment.vertices is not None and segment.vertices.tolist() == [[0.0, 1.0], [1.0, 0.0]]
    np.testing.assert_allclose(segment.support(np.array([[0.0, 1.0], [1.0, 0.0]])), [1.0, 1.0], atol=1e-9)


@pytest.mark.parametrize("d", [2, 3])
def test_a_polytope_that_is_flat_in_some_direction_has_the_corners_of_its_shadow(d: int) -> None:
    rng = np.random.default_rng(d)
    normal = rng.integers(-3, 4, d).astype(float)
    normal[-1] = 2.0  # the last entry follows from the others, exactly
    H = np.vstack([normal, -normal, np.eye(d)[:-1], -np.eye(d)[:-1], np.ones(d), -rng.random(d)])
    thin = Polytope(H, np.concatenate([[0.5, -0.5], np.full(2 * d - 2, 1.0), [0.75, 0.75]]))
    shadow, ends = H[2:, :-1] - H[2:, -1:] * normal[:-1] / 2.0, thin.h[2:] - H[2:, -1] * 0.25
    flat = Polytope(shadow, ends)
    assert thin.vertices is not None and flat.vertices is not None
    c = rng.normal(size=(50, d))
    beside = flat.support(c[:, :-1] - c[:, -1:] * normal[:-1] / 2.0) + 0.25 * c[:, -1]
    np.testing.assert_allclose(thin.support(c), beside, rtol=1e-12, atol=1e-12)
    apart = np.concatenate([[0.5, -0.5 - 1e-10], thin.h[2:]])
    assert Polytope(H, apart).vertices is None  # no point, but for what is a tolerance: nothing is known of its corners


def test_a_point_where_many_rows_meet_is_its_own_corner() -> None:
    H = np.array([[1.0, 0.0], [-1.0, 0.0], [0.0, 1.0], [0.0, -1.0], [1.0, 1.0], [-3.0, 1.0]])
    point = Polytope(H, H @ [0.25, -0.5])
    assert point.vertices is not None and point.vertices.tolist() == [[0.25, -0.5]]


def test_the_vertices_of_a_cross_polytope_are_its_unit_vectors() -> None:
    H, h = NormBall(1.0, 1.0, dimension=3).halfspaces() or (None, None)
    vertices = Polytope(H, h).vertices
    assert vertices is not None and vertices.shape == (6, 3)
    np.testing.assert_allclose(np.sort(np.abs(vertices), axis=1), np.tile([0.0, 0.0, 1.0], (6, 1)), atol=1e-12)


def test_boxes_intersect_in_a_box_flat_sets_in_a_polytope_and_curved_ones_stay_apart() -> None:
    box, diamond, disc = Box(-np.ones(2), np.ones(2)), NormBall(1.0, 1.2, dimension=2), NormBall(2.0, 1.0, dimension=2)
    smaller = intersection([box, Box(np.array([-2.0, 0.0]), np.array([0.5, 2.0]))])
    assert isinstance(smaller, Box)
    np.testing.assert_array_equal(smaller.upper, [0.5, 1.0])
    both = intersection([box, diamond])
    assert isinstance(both, Polytope)
    assert both.support(np.array([[1.0, 1.0]]))[0] == pytest.approx(1.2)
    assert intersection([box, disc]) == (box, disc)


def test_a_cylinder_frees_the_other_coordinates() -> None:
    rng = np.random.default_rng(5)
    for base in every_set(rng, 2):
        tall = cylinder(base, 3)
        inside = np.append(base.interior_point(), 1e6)
        assert tall.dimension == 3 and tall.contains(inside, 1e-9)
        directions = rng.normal(size=(4, 2))
        lifted = np.hstack([directions, np.zeros((4, 1))])
        np.testing.assert_allclose(tall.support(lifted), base.support(directions), rtol=1e-7)
        assert tall.support(np.array([[0.0, 0.0, 1.0]]))[0] == np.inf
        if isinstance(tall, Cylinder):
            np.testing.assert_array_equal(directions @ tall.normals, lifted)
            np.testing.assert_allclose(tall.violation(lifted), base.violation(directions))


def test_an_equality_measures_the_fixed_coordinates_only() -> None:
    end = Equality(np.array([np.nan, 1.0]))
    np.testing.assert_array_equal(end.fixed, [1])
    np.testing.assert_allclose(end.violation(np.array([[9.0, 1.5], [0.0, 1.0]])), [0.5, 0.0])


@pytest.mark.parametrize(
    ("build", "message"),
    [
        (lambda: Polytope(np.array([[1.0], [-1.0]]), np.array([-1.0, -1.0])), "polytope: empty"),
        (lambda: Polytope(np.ones(2), np.ones(2)), "one row per half-space"),
        (lambda: Polytope(np.ones((2, 2)), np.ones(3)), "polytope.h: expected 2 numbers, got 3"),
        (lambda: Ellipsoid(np.zeros(2), np.array([[1.0, 2.0], [2.0, 1.0]])), "symmetric positive definite"),
        (lambda: Ellipsoid(np.zeros(3), np.eye(2)), "ellipsoid.centre: expected 2 numbers, got 3"),
        (lambda: NormBall(0.5, 1.0, dimension=2), "norm.p: expected a number of at least 1"),
        (lambda: NormBall(2.0, -1.0, dimension=2), "radius"),
        (lambda: NormBall(2.0, 1.0), "expected a centre, or a dimension"),
        (lambda: Box(np.array([1.0]), np.array([0.0])), "box: empty"),
        (lambda: Equality(np.array([np.inf])), "finite numbers"),
        (lambda: intersection([]), "at least one set"),
        (lambda: intersection([Box(np.zeros(1), np.ones(1)), Box(np.full(1, 2.0), np.full(1, 3.0))]), "empty"),
    ],
)
def test_a_set_that_is_none_says_what_was_expected(build, message: str) -> None:
    with pytest.raises(InputError, match=message):
        build()


def test_the_support_of_a_polytope_without_known_vertices_is_bounded_from_the_dual_side(monkeypatch) -> None:
    """A linear program that stops early must not make the set smaller."""
    import scipy.optimize

    rng = np.random.default_rng(4)
    d = 7  # too many dimensions for vertices
    H = np.vstack([np.eye(d), -np.eye(d), rng.normal(size=(9, d))])
    polytope, directions = Polytope(H, np.ones(len(H))), rng.normal(size=(5, d))
    true = polytope.support(directions)
    honest = scipy.optimize.linprog

    def early(*arguments, **options):
        answer = honest(*arguments, **options)
        answer.x = 0.999 * answer.x
        return answer

    monkeypatch.setattr(scipy.optimize, "linprog", early)
    assert (polytope.support(directions) >= true * (1.0 - 1e-12)).all()
    assert polytope.support(directions) == pytest.approx(true, rel=1e-6)


def test_an_ellipsoid_in_units_far_apart_still_tells_inside_from_outside() -> None:
    """Of its matrix rounding leaves an eigenvalue below 0, of its factor nothing."""
    turned = np.array([[1.0, 0.9], [0.9, 1.0]])
    for unit in 10.0 ** np.arange(-6, 7, 2):
        units = np.diag([1.0 / unit, unit])
        ellipsoid = Ellipsoid([0.0, 0.0], units @ turned @ units)
        rim = ellipsoid.factor @ np.array([[1.0, 0.0, 0.6], [0.0, 1.0, -0.8]])
        assert np.isfinite(ellipsoid.violation(rim.T)).all()
        assert (ellipsoid.violation(0.5 * rim.T) < 0.0).all()
        assert (ellipsoid.violation(2.0 * rim.T) > 0.0).all()


@pytest.mark.first(4)
@pytest.mark.parametrize("seed", range(8))
def test_a_middle_on_the_boundary_is_drawn_inwards_whatever_rounding_says(seed):
    """Of a triangle with a right angle the middle of the bounding box is halfway along the third side."""
    rng = np.random.default_rng(seed)
    a, b, corner = *rng.uniform(0.1, 10.0, 2), rng.uniform(-1.0, 1.0, 2)
    H = np.array([[1.0, 0.0], [0.0, 1.0], [-1.0 / a, -1.0 / b]])
    # with the corners c, c - (a, 0) and c - (0, b)
    h = np.array([corner[0], corner[1], 1.0 - corner[0] / a - corner[1] / b])
    triangle = Polytope(H, h)
    expected = corner - np.array([a, b]) / 2
    found = triangle.middle()
    assert found == pytest.approx(expected, abs=1e-11 * max(a, b))
    exact = [sum((Fraction(x) * Fraction(y) for x, y in zip(row, found, strict=True)), Fraction(0)) for row in H]
    assert all(value < Fraction(limit) for value, limit in zip(exact, h, strict=True))
    units = np.array([2.0**7, 2.0**-5])
    assert triangle.in_units(units).middle() * units == pytest.approx(found, rel=1e-13, abs=1e-13 * max(a, b))


def test_a_point_amid_a_simplex_is_the_same_in_other_units():
    simplex = Polytope(np.vstack([-np.eye(3), np.ones((1, 3))]), np.array([0.0, 0.0, 0.0, 1.0]))
    units = np.array([2.0**-6, 1.0, 2.0**9])
    assert simplex.middle() == pytest.approx([0.25] * 3, rel=1e-12)  # that of the bounding box is outside
    assert simplex.in_units(units).middle() * units == pytest.approx(simplex.middle(), rel=1e-12)


@pytest.mark.parametrize("p", [1.01, 1.5, 3.0, 50.0])
def test_a_ball_is_the_same_in_any_units(p: float) -> None:
    rows, spread = np.array([[1.0, 0.2], [-0.3, 2.0]]), np.array([[0.1, 0.1], [0.05, 0.3]])
    one = NormBall(p, 2.0, dimension=2)
    for unit in (1e-9, 1e9):
        with np.errstate(over="raise", invalid="raise"):
            other = NormBall(p, 2.0 * unit, dimension=2)
            np.testing.assert_allclose(one.support(rows * unit), unit * one.support(rows), rtol=1e-12)
            np.testing.assert_allclose(other.gauge(rows * unit), one.gauge(rows), rtol=1e-12)
            np.testing.assert_allclose(
                other.violation(rows * unit), unit * one.violation(rows), rtol=1e-6, atol=unit * 1e-9
            )
            np.testing.assert_array_equal(other.contains(rows * unit, 1e-9 * unit), one.contains(rows))
            found = [_bound_power_excess(rows * u, spread * u, one.dual) for u in (1.0, unit)]
            np.testing.assert_allclose(found[1], unit * found[0], rtol=1e-9)
