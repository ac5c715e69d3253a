"""Guards control/sets: what each kind of set says in closed form, against values by hand, samples and lists of corners;
soundness and sharpness."""

from __future__ import annotations

from itertools import product

import numpy as np
import pytest

from sparserob_core.control.sets.curved import norm_curvature
from sparserob_core.control.sets.directions import across, faces, on_surface, sampled, shares, unit
from sparserob_core.control.sets.sets import (
    Box,
    Cylinder,
    Ellipsoid,
    Equality,
    NormBall,
    Polytope,
    Zonotope,
    cylinder,
    intersection,
    oblique,
)
from sparserob_core.errors import InputError

OBLONG = Ellipsoid(np.array([0.3, -1.0]), np.array([[4.0, 1.0], [1.0, 0.5]]))
CURVED = [OBLONG, *(NormBall(p, 0.7, centre=np.array([0.2, -0.4])) for p in (1.5, 2.0, 4.0))]
SEGMENTS = Zonotope(np.array([0.1, 0.2, -0.3]), np.array([[1.0, 0, 0], [0.5, 0.5, 0], [0, -1.0, 2.0], [0.3, 0.3, 0.3]]))


@pytest.mark.first(2)
@pytest.mark.parametrize("ball", CURVED)
def test_a_curved_set_knows_its_rim_its_normals_and_its_gauge(ball):
    turns = np.linspace(0.0, 2.0 * np.pi, 37)[:-1] + 0.01
    directions = np.stack([np.cos(turns), np.sin(turns)], axis=1)
    rim, middle = ball.support_point(directions), ball.middle()
    for factor in (0.25, 1.0, 3.0):
        points = middle + factor * (rim - middle)
        np.testing.assert_allclose(ball.gauge(points), factor, rtol=1e-10)
        assert (ball.contains(points) == (factor <= 1.0)).all()
        assert np.allclose(
            ball.scaled(factor).support(directions),
            directions @ middle + factor * (ball.support(directions) - directions @ middle),
        )
    normals = ball.normal(rim)
    np.testing.assert_allclose(normals / np.linalg.norm(normals, axis=1)[:, None], directions, atol=1e-6)
    # how far along a normal a point outside is, and never deeper inside than a ball about it shows
    np.testing.assert_allclose(ball.violation(rim + 0.3 * directions), 0.3, rtol=1e-6)
    dense = ball.support_point(np.stack([np.cos(s := np.linspace(0, 2 * np.pi, 1001)), np.sin(s)], axis=1))
    for share in (0.0, 0.5, 0.9):
        inside = middle + share * (rim - middle)
        depth = np.linalg.norm(inside[:, None] - dense, axis=2).min(axis=1)
        found = ball.violation(inside)
        assert (-depth - 1e-4 <= found).all() and (found < 0.0).all()
        assert (found <= (share - 1.0) * np.linalg.norm(dense - middle, axis=1).min() + 1e-3).all()
    for units in (np.array([2.0, 2.0]), np.array([0.5, 8.0])):
        other = ball.in_units(units)
        np.testing.assert_allclose(other.support(directions * units), ball.support(directions), rtol=1e-12)
        assert other.contains(rim / units, 1e-9).all()
        assert not other.contains((middle + 1.01 * (rim - middle)) / units, 1e-9).any()
    drawn = ball.sample(400, np.random.default_rng(1))
    assert ball.contains(drawn, 1e-12).all()
    # uniform: a half of the area is within 1 / sqrt(2) of the way to the rim
    assert (ball.gauge(drawn) ** 2).mean() == pytest.approx(0.5, abs=0.06)
    assert np.abs(drawn.mean(axis=0) - middle).max() < 0.1 * np.abs(rim - middle).max()
    if ball.unit_ball_image() is not None:
        m, L = ball.unit_ball_image()
        np.testing.assert_allclose(directions @ m + np.linalg.norm(directions @ L, axis=1), ball.support(directions))
    reach = ball.support(ball.frame) - ball.frame @ middle
    assert (reach >= 0.5).all() and (reach <= 2.0).all()


def test_a_ball_of_other_norms_becomes_what_its_units_make_of_it():
    units = np.array([1.0, 4.0])
    assert isinstance(NormBall(2.0, 1.0, dimension=2).in_units(units), Ellipsoid)
    assert isinstance(NormBall(2.0, 1.0, dimension=2).in_units(4.0 * np.ones(2)), NormBall)
    box = NormBall(np.inf, 2.0, centre=[1.0, 2.0]).in_units(units)
    assert isinstance(box, Box)
    assert (box.lower == [-1.0, 0.0]).all() and (box.upper == [3.0, 1.0]).all()
    assert NormBall(2.0, 0.0, dimension=2).unit_ball_image() is None
    assert NormBall(3.0, 1.0, dimension=2).unit_ball_image() is None


@pytest.mark.parametrize("p", [1.0, 1.5, 2.0, 3.0, np.inf])
def test_what_a_support_loses_around_a_direction_is_bounded_and_not_by_much(p):
    rng = np.random.default_rng(2)
    for member in (NormBall(p, 0.7, centre=rng.normal(size=2)), OBLONG):
        centre = rng.normal(size=(60, 2))
        centre /= np.linalg.norm(centre, axis=1)[:, None]
        for width, sharp in ((1e-3, 8.0), (0.1, 8.0), (2.0, 4.0)):
            spread = width * rng.normal(size=(60, 2, 2))
            ends = centre[:, None] + np.einsum(
                "sj,kjd->ksd", np.array(list(product(np.linspace(-1, 1, 9), repeat=2))), spread
            )
            gap = (member.support(ends) - np.einsum("ksd,kd->ks", ends, member.support_point(centre))).max(axis=1)
            excess = member.linearisation_excess(centre, spread)
            assert (gap <= excess + 1e-13).all()
            assert np.median(excess / np.maximum(gap, 1e-12)) <= sharp


def test_the_excess_of_a_round_set_is_the_length_that_it_is_by_hand():
    """``|(1, b)| - 1`` where the direction moves across; ``0`` along; twice the length beyond, where it turns over."""
    ball = NormBall(2.0, 3.0, dimension=2)
    centre = np.array([[2.0, 0.0]])
    for spread, excess in (
        ([[0.0, 0.5]], 3.0 * (np.hypot(2.0, 0.5) - 2.0)),
        ([[0.5, 0.0]], 0.0),
        ([[0.5, 0.0], [0.0, 0.5]], 3.0 * (np.hypot(1.5, 0.5) - 1.5)),
        ([[5.0, 0.0]], 3.0 * 6.0),
    ):
        assert ball.linearisation_excess(centre, np.array([spread]))[0] == pytest.approx(excess, abs=1e-14)
    assert ball.linearisation_excess(np.zeros((1, 2)), np.array([[[3.0, 4.0]]]))[0] == pytest.approx(3.0 * 5.0)


def test_a_box_has_the_chord_of_its_support_function_where_a_coordinate_turns():
    """By hand: ``|y| <= y / 2 + 3 / 2`` from -1 to 3, ``|y| <= 1`` from -1 to 1, ``y`` itself from 1 to 3; in units, as
    a zonotope, and about another middle."""
    box = Box([-1.0], [1.0])
    for centre, spread, share, excess in ((1.0, 2.0, 0.5, 1.5), (0.0, 1.0, 0.0, 1.0), (2.0, 1.0, 1.0, 0.0)):
        asked = np.array([[centre]]), np.array([[[spread / 2], [-spread / 2]]])
        for member in (box, Zonotope(np.zeros(1), np.eye(1)), NormBall(np.inf, 1.0, dimension=1)):
            point, added = member.support_majorant(*asked)
            assert point[0, 0] == pytest.approx(share) and added[0] == pytest.approx(excess)
        point, added = Box([1.0], [5.0]).support_majorant(*asked)
        assert point[0, 0] == pytest.approx(3.0 + 2.0 * share) and added[0] == pytest.approx(2.0 * excess)
    assert Box([2.0], [2.0]).support_majorant(*asked)[0][0, 0] == 2.0


def test_the_curvature_of_a_length_is_below_it_and_near_the_true_one_where_the_spread_is_small():
    rng = np.random.default_rng(3)
    for width in (1e-4, 0.03, 0.1, 0.3, 2.0):
        for _ in range(20):
            a, B = rng.normal(size=3), width * rng.normal(size=(2, 3))
            size, H = np.linalg.norm(a), norm_curvature(a, B)
            s = np.array(list(product(np.linspace(-1, 1, 9), repeat=2)))
            truth = np.linalg.norm(a + s @ B, axis=1) - size - s @ B @ a / size
            assert (0.5 * np.einsum("si,ij,sj->s", s, H, s) <= truth + 1e-14).all()
            assert (np.linalg.eigvalsh(H) >= -1e-15).all()
            if width == 1e-4:
                flat = B - np.outer(B @ a, a) / size**2
                np.testing.assert_allclose(H, flat @ flat.T / size, rtol=0.02, atol=1e-14)
    assert (norm_curvature(np.zeros(2), np.eye(2)) == 0.0).all()
    assert norm_curvature(np.ones(1), np.zeros((0, 1))).shape == (0, 0)
    # by hand: U = 4 + 1/2, and 1 across
    H = norm_curvature(np.array([4.0, 0.0]), np.array([[0.5, 0.0], [0.0, 1.0]]))
    assert np.diag([0.0, 2.0 / (4.5 + np.sqrt(4.5**2 + 1.0))]) == pytest.approx(H)


def test_the_curvature_of_a_length_is_below_it_in_many_dimensions_and_what_is_wide_leaves_the_narrow_as_curved():
    rng = np.random.default_rng(5)
    corners = np.array(list(product((-1.0, 1.0), repeat=5)))
    s = np.vstack([corners, rng.uniform(-1.0, 1.0, (300, 5)), np.eye(5), -np.eye(5), np.zeros((1, 5))])
    for _ in range(60):
        a, B = rng.normal(size=4), rng.normal(size=(5, 4)) * 10.0 ** rng.uniform(-3, 1, (5, 1))
        size, H = np.linalg.norm(a), norm_curvature(a, B)
        truth = np.linalg.norm(a + s @ B, axis=1) - size - s @ B @ a / size
        assert (0.5 * np.einsum("si,ij,sj->s", s, H, s) <= truth + 1e-13 * (1.0 + truth)).all()
        assert (np.linalg.eigvalsh(H) >= -1e-13 * np.abs(H).max()).all()
    # by hand, beside (1, 0, 0): 1/10 and 1 across, slopes g(0.01) / 0.01 and (g(1.01) - g(0.01)) / 1
    H = norm_curvature(np.eye(3)[0], np.array([[0.0, 0.1, 0.0], [0.0, 0.0, 1.0]]))
    narrow, wide = np.sqrt(1.01) - 1.0, np.sqrt(2.01) - np.sqrt(1.01)
    np.testing.assert_allclose(H, 2.0 * np.diag([narrow, wide]), rtol=1e-12)
    # and three as wide as each other have the chord to the corner
    np.testing.assert_allclose(norm_curvature(np.eye(4)[0], np.eye(4)[1:]), 2.0 / 3.0 * np.eye(3), rtol=1e-12)


def test_a_sum_of_segments_is_the_hull_of_its_corners():
    rng = np.random.default_rng(4)
    corners = SEGMENTS.centre + np.array(list(product((-1.0, 1.0), repeat=4))) @ SEGMENTS.generators
    c = rng.normal(size=(50, 3))
    np.testing.assert_allclose(SEGMENTS.support(c), (c @ corners.T).max(axis=1))
    np.testing.assert_allclose((SEGMENTS.support_point(c) * c).sum(axis=1), SEGMENTS.support(c))
    H, h = SEGMENTS.halfspaces()
    assert len(H) == 2 * 6  # one pair for every two segments, none of them parallel
    assert (corners @ H.T <= h + 1e-12).all()
    # every facet touches at four corners or more, and a point is outside where some facet says so
    assert ((corners @ H.T >= h - 1e-9).sum(axis=0) >= 4).all()
    hull = Polytope(H, h)
    np.testing.assert_allclose(hull.support(c), SEGMENTS.support(c), rtol=1e-9)
    assert SEGMENTS.contains(SEGMENTS.interior_point())
    for centre in c[:10]:
        spread = 0.3 * rng.normal(size=(1, 2, 3))
        ends = centre + np.array(list(product((-1.0, 1.0), repeat=2))) @ spread[0]
        gap = (SEGMENTS.support(ends) - ends @ SEGMENTS.support_point(centre)).max()
        excess = SEGMENTS.linearisation_excess(centre[None], spread)[0]
        assert gap <= excess + 1e-13
        assert (
            excess
            <= 2.0
            * np.maximum(
                np.abs(spread[0] @ SEGMENTS.generators.T).sum(axis=0) - np.abs(SEGMENTS.generators @ centre), 0.0
            ).sum()
            + 1e-13
        )
    plane = Zonotope(np.zeros(2), np.array([[1.0, 1.0], [-2.0, -2.0], [0.0, 0.0]]))
    H, h = plane.halfspaces()
    assert H[:, 0] ** 2 == pytest.approx([0.5] * 4) and np.abs(np.diff(H @ np.array([1.0, 1.0]))).max() < 3.0
    assert np.where(np.abs(H @ [1.0, 1.0]) > 1.0, h - 3.0 * np.sqrt(2.0), h) == pytest.approx([0.0] * 4, abs=1e-13)
    assert (h >= plane.support(H)).all()
    assert plane.linearisation_excess(np.array([[1.0, -1.0]]), np.array([[[0.0, 0.25]]]))[0] == 0.75
    line = Zonotope(np.ones(1), np.array([[2.0], [0.5]]))
    H, h = line.halfspaces()
    assert sorted((float(b / a)) for (a,), b in zip(H, h, strict=True)) == [-1.5, 3.5]
    assert Zonotope(np.zeros(2), np.random.default_rng(5).normal(size=(501, 2))).halfspaces() is None


@pytest.mark.parametrize("member", [*CURVED, Cylinder(OBLONG, 3), oblique(OBLONG, np.array([[0.0], [-1.0]]))])
def test_directions_are_measured_by_how_far_the_set_reaches_along_them(member):
    b, rng = member.frame.shape[0], np.random.default_rng(6)
    z = rng.uniform(-1, 1, size=(40, b))
    c = z @ member.frame
    room = member.support(c) - c @ member.interior_point()
    np.testing.assert_allclose(shares(member, z), z / room[:, None])
    scaled = unit(member, z)
    np.testing.assert_allclose(member.support(scaled) - scaled @ member.interior_point(), 1.0)
    assert (shares(member, np.zeros((1, b))) == 0.0).all()
    # the chain rule, against differences
    weights = rng.normal(size=b)
    slopes = np.tile(weights, (40, 1))
    step = 1e-6
    for axis in np.eye(b):
        change = (shares(member, z + step * axis) - shares(member, z - step * axis)) @ weights / (2 * step)
        np.testing.assert_allclose(across(member, z, slopes) @ axis, change, rtol=1e-5, atol=1e-7)
    assert (across(member, np.zeros((1, b)), slopes[:1]) == 0.0).all()


def test_a_set_of_one_point_measures_directions_by_their_length():
    point = NormBall(2.0, 0.0, centre=[1.0, 2.0])
    assert shares(point, np.array([[3.0, 4.0]])) == pytest.approx(np.array([[0.6, 0.8]]))
    z, slopes, step = np.array([[0.3, -0.8]]), np.array([[1.0, 0.5]]), 1e-6
    change = [
        ((shares(point, z + step * axis) - shares(point, z - step * axis)) @ slopes[0] / (2 * step))[0]
        for axis in np.eye(2)
    ]
    assert across(point, z, slopes)[0] == pytest.approx(change, abs=1e-6)


@pytest.mark.parametrize(
    ("dimension", "count"), [(1, 2), (2, 4 * 32), (3, 6 * 8**2 + 2), (4, 5**4 - 3**4), (5, 3**5 - 1)]
)
def test_samples_are_a_lattice_on_the_surface_of_the_cube(dimension, count):
    points = sampled(dimension)
    assert len(points) == len(np.unique(points, axis=0)) == count
    assert (np.abs(points).max(axis=1) == 1.0).all()
    assert (on_surface(0.3 * points) == pytest.approx(points)) and (on_surface(np.zeros((1, dimension))) == 0.0).all()
    lower, upper = faces(dimension)
    assert len(lower) == 2 * dimension == len(np.unique(np.hstack([lower, upper]), axis=0))
    for low, high in zip(lower, upper, strict=True):
        (fixed,) = np.flatnonzero(low == high)
        assert abs(low[fixed]) == 1.0
        assert (np.delete(low, fixed) == -1.0).all() and (np.delete(high, fixed) == 1.0).all()


def test_a_fixed_value_is_met_within_the_tolerance_and_no_further():
    end = Equality([1.0, np.nan, -2.0])
    assert end.contains(np.array([1.0 + 5e-7, 9.0, -2.0]), 1e-6)
    assert not end.contains(np.array([1.0 + 5e-6, 9.0, -2.0]), 1e-6)
    assert end.contains(np.array([1.0 + 5e-10, 9.0, -2.0]))
    assert not end.contains(np.array([1.0, 9.0, -2.0 - 5e-9]))
    np.testing.assert_array_equal(end.in_units(np.array([2.0, 3.0, 4.0])).values, [0.5, np.nan, -0.5])
    assert Equality([np.nan]).violation(np.ones((3, 1))).tolist() == [0.0] * 3
    for wrong in ("a", np.ones((2, 2)), [], [np.inf]):
        with pytest.raises(InputError, match="equality"):
            Equality(wrong)


def test_an_intersection_is_what_all_of_its_members_hold():
    low, high = Box([-1.0, -4.0], [2.0, 3.0]), Box([-3.0, -2.0], [1.0, 5.0])
    both = intersection([low, high])
    assert (both.lower == [-1.0, -2.0]).all() and (both.upper == [1.0, 3.0]).all()
    assert intersection([OBLONG]) is OBLONG
    with pytest.raises(InputError, match="dimensions differ"):
        intersection([OBLONG, Box([0.0], [1.0])])
    with pytest.raises(InputError, match="cylinder"):
        cylinder(OBLONG, 1)
    assert cylinder(OBLONG, 2).support(np.array([[1.0, 0.0]])) == OBLONG.support(np.array([[1.0, 0.0]]))


def test_a_cylinder_is_its_base_in_the_first_coordinates():
    tall, rng = Cylinder(OBLONG, 4), np.random.default_rng(7)
    x = rng.normal(size=(20, 4))
    np.testing.assert_allclose(tall.gauge(x), OBLONG.gauge(x[:, :2]))
    np.testing.assert_allclose(tall.violation(x), OBLONG.violation(x[:, :2]))
    c = np.array([1.0, -0.5, 0.0, 0.0])
    assert tall.support_point(c) == pytest.approx([*OBLONG.support_point(c[:2]), 0.0, 0.0])
    assert tall.support(np.array([1.0, 0.0, 0.0, 1e-300])) == np.inf
    assert tall.interior_point() == pytest.approx([0.3, -1.0, 0.0, 0.0])
    assert tall.scaled(2.0).gauge(x) == pytest.approx(OBLONG.gauge(x[:, :2]) / 2.0)
    units = np.array([2.0, 0.5, 3.0, 7.0])
    assert tall.in_units(units).gauge(x / units) == pytest.approx(tall.gauge(x))
    assert tall.frame.shape == (2, 4) and not tall.frame[:, 2:].any()


LEANING = np.array([[1.0, 0.0, -1.0], [0.0, -1.0, 0.0]])


@pytest.mark.first(2)
@pytest.mark.parametrize("base", CURVED)
def test_an_oblique_cylinder_holds_what_is_seen_in_its_base(base):
    leaning, rng = oblique(base, LEANING), np.random.default_rng(8)
    x = rng.normal(size=(200, 5))
    seen = x[:, :2] + x[:, 2:] @ LEANING.T
    np.testing.assert_array_equal(leaning.gauge(x), base.gauge(seen))
    np.testing.assert_array_equal(leaning.violation(x), base.violation(seen))
    z = rng.normal(size=(30, 2))
    c = leaning.along(z)
    np.testing.assert_array_equal(c[:, 2:], c[:, :2] @ LEANING)
    np.testing.assert_allclose(c, z @ leaning.frame, rtol=1e-14)
    heights = (c @ x.T)[:, base.contains(seen)]
    assert heights.shape[1] > 10
    assert (heights <= leaning.support(c)[:, None] + 1e-12).all()
    points = leaning.support_point(c)
    np.testing.assert_allclose((points * c).sum(axis=1), leaning.support(c))
    assert leaning.contains(points, 1e-9).all()
    assert np.isinf(leaning.support(c + 1e-9 * np.eye(5)[3])).all()  # not by more than rounding
    units = np.array([2.0, 0.5, 4.0, 8.0, 0.25])
    np.testing.assert_allclose(leaning.in_units(units).gauge(x / units), leaning.gauge(x))
    np.testing.assert_array_equal(leaning.in_units(units).frame, leaning.frame * units)
    assert leaning.scaled(2.0).gauge(x) == pytest.approx(base.scaled(2.0).gauge(seen))
    assert leaning.kind == base.kind


def test_an_oblique_cylinder_over_a_cylinder_and_beside_more_coordinates():
    over = oblique(Cylinder(OBLONG, 3), np.array([[1.0, 0.0], [0.0, 1.0], [0.0, -1.0]]))
    x = np.random.default_rng(9).normal(size=(20, 6))
    seen = x[:, :2] + x[:, 3:5]
    np.testing.assert_allclose(over.gauge(x[:, :5]), OBLONG.gauge(seen))
    np.testing.assert_allclose(cylinder(over, 6).gauge(x), OBLONG.gauge(seen))
    assert cylinder(over, 6).frame.shape == (2, 6)


@pytest.mark.parametrize(
    ("build", "key"),
    [
        (lambda: Polytope(np.ones((0, 2)), np.ones(0)), "polytope"),
        (lambda: Polytope(np.array([[np.nan, 1.0]]), np.ones(1)), "polytope"),
        (lambda: Polytope(np.ones(2), np.ones(1)), "polytope"),
        (lambda: Polytope([["a", 1.0]], np.ones(1)), "polytope"),
        (lambda: Polytope(np.eye(2), np.array([1.0, -np.inf])), "h must not be -inf"),
        (lambda: Polytope(np.array([[0.0, 0.0], [1.0, 0.0]]), np.array([-1.0, 1.0])), "row 0 of H is zero"),
        (lambda: Polytope(np.array([[1.0, 0.0], [0.0, 0.0]]), np.array([1.0, -1e-300])), "row 1 of H is zero"),
        (lambda: NormBall(2.0, 1.0, centre=[0.0, np.nan]), "norm.centre"),
        (lambda: NormBall(2.0, 1.0, centre=[np.inf]), "finite numbers"),
        (lambda: NormBall(2.0, np.inf, dimension=2), "norm.radius"),
        (lambda: NormBall(2.0, 1.0, dimension=0), "norm.dimension"),
        (lambda: NormBall(np.nan, 1.0, dimension=1), "norm.p"),
        (lambda: Ellipsoid([0.0], [[np.inf]]), "ellipsoid"),
        (lambda: Ellipsoid([0.0, 0.0], [[1.0, 0.5], [0.4, 1.0]]), "symmetric"),
        (lambda: Ellipsoid([0.0, 0.0], [[1.0, 0.0], [0.0, 0.0]]), "positive definite"),
    ],
)
def test_numbers_that_describe_no_set_are_refused_with_the_key(build, key):
    with pytest.raises(InputError, match=key):
        build()


def test_rows_that_say_nothing_are_left_out_and_a_tiny_excess_makes_no_set_empty():
    kept = Polytope(np.array([[0.0, 0.0], [1.0, 0.0], [0.0, 1.0]]), np.array([0.0, 1.0, np.inf]))
    assert kept.H.tolist() == [[1.0, 0.0]] and kept.h.tolist() == [1.0]
    assert Polytope(np.array([[1.0], [-1.0]]), np.array([1.0, -1.0])).support(np.ones((1, 1)))[0] == pytest.approx(1.0)
    for gap, empty in ((1e-10, False), (1e-8, True)):
        rows = np.array([[1.0], [-1.0]]), np.array([1.0, -1.0 - 2.0 * gap])
        if empty:
            with pytest.raises(InputError, match="empty"):
                Polytope(*rows)
        else:
            Polytope(*rows)


def test_the_largest_ball_of_a_polytope_is_by_hand():
    """The incircle of the triangle (0, 0), (3, 0), (0, 4) has the radius 1."""
    triangle = Polytope(np.array([[-1.0, 0.0], [0.0, -1.0], [4.0, 3.0]]), np.array([0.0, 0.0, 12.0]))
    centre, radius = triangle.chebyshev
    assert (centre, radius) == (pytest.approx([1.0, 1.0]), pytest.approx(1.0))
    assert sorted(triangle.vertices.round(12).tolist()) == [[0.0, 0.0], [0.0, 4.0], [3.0, 0.0]]
    doubled = triangle.scaled(2.0)
    middle = triangle.middle()
    c = np.random.default_rng(8).normal(size=(20, 2))
    np.testing.assert_allclose(doubled.support(c), c @ middle + 2.0 * (triangle.support(c) - c @ middle))
    np.testing.assert_allclose(triangle.support(c), (c @ triangle.vertices.T).max(axis=1))
    drawn = triangle.sample_extreme(60, np.random.default_rng(9))
    assert {tuple(point) for point in drawn.round(9).tolist()} == {(0.0, 0.0), (0.0, 4.0), (3.0, 0.0)}
    assert Polytope(np.zeros((1, 2)), np.zeros(1)).chebyshev[1] == np.inf


def test_no_point_is_farther_than_a_polytope_reaches_and_bounds_from_the_dual_side_hold():
    rng, d = np.random.default_rng(10), 7
    H = np.vstack([np.eye(d), -np.eye(d), rng.normal(size=(5, d))])
    h = np.concatenate([np.arange(1.0, d + 1), np.ones(d), np.ones(5)])
    polytope = Polytope(H, h)
    farthest = np.abs(np.stack([polytope.support(np.eye(d)), polytope.support(-np.eye(d))])).max()
    assert farthest <= polytope._coordinate_bound <= 2.0 * farthest * (1 + 1e-9)
    c = rng.normal(size=(4, d))
    for y in (np.zeros((4, H.shape[0])), rng.uniform(size=(4, H.shape[0]))):
        left = np.abs(c - y @ H).sum(axis=1)
        bound = polytope._bound_by_duality(c, y)
        assert bound == pytest.approx(y @ h + left * polytope._coordinate_bound)
        assert (polytope.support(c) <= bound).all()
    negative = polytope._bound_by_duality(c, -np.ones((4, H.shape[0])))
    assert negative == pytest.approx(np.abs(c).sum(axis=1) * polytope._coordinate_bound)
    for direction in c:
        height, point = polytope._maximise(direction)
        assert height == pytest.approx(polytope.support(direction[None])[0])
        assert direction @ point == pytest.approx(height)
        assert polytope.contains(point, 1e-7)
    assert polytope._maximise(np.zeros(d))[0] == 0.0


@pytest.mark.parametrize("width", [1, 3, 7, 8])
@pytest.mark.parametrize("centred", [True, False])
def test_few_sides_of_a_box_add_up_to_what_all_at_once_do(width, centred):
    """To the last bit, whatever the axes of the directions are."""
    rng = np.random.default_rng(width)
    upper = rng.uniform(0.1, 2.0, width)
    box = Box(-upper if centred else upper - rng.uniform(0.0, 3.0, width), upper)
    for directions in (rng.normal(size=(5, 4, width)), rng.normal(size=(width, 6)).T, rng.normal(size=width)):
        plain = np.maximum(directions * box.upper, directions * box.lower).sum(axis=-1)
        np.testing.assert_array_equal(box.support(directions), plain)
        np.testing.assert_array_equal(box.reach(directions), np.maximum(plain, box.support(-directions)))


def test_whether_points_of_many_coordinates_are_inside_does_not_ask_how_deep() -> None:
    """How deep a zonotope is takes a linear program for each of them."""
    bound = Zonotope(np.zeros(12), np.random.default_rng(3).normal(size=(20, 12))).in_units(np.full(12, 2.0))
    assert bound.contains(np.zeros(12)) and not bound.contains(np.full(12, 1e3))
    assert bound.contains(np.stack([np.zeros(12), bound.support_point(np.ones(12))])).all()
    assert "_inner_radius" not in vars(bound)
    assert bound.violation(np.zeros(12)) < 0.0 and "_inner_radius" in vars(bound)


@pytest.mark.parametrize("p", [1.02, 1.3, 3.0, 40.0])
def test_the_distance_from_a_ball_is_what_its_own_direction_proves(p: float) -> None:
    """Weak duality: no point of the ball is nearer to ``x`` than ``c'x - |c|_q`` for a unit ``c``, and the one from the
    nearest point to ``x`` attains it, near the ball and far from it."""
    rng, q = np.random.default_rng(0), p / (p - 1.0)
    points = rng.normal(size=(200, 3))
    points *= ((1.0 + 10.0 ** rng.uniform(-6.0, 6.0, 200)) / np.linalg.norm(points, ord=p, axis=1))[:, None]
    ball = NormBall(p, 1.0, np.zeros(3))
    away = points - np.sign(points) * ball._project_onto_unit_ball(np.abs(points))
    units = away / np.linalg.norm(away, axis=1, keepdims=True)
    proven = (units * points).sum(axis=1) - np.linalg.norm(units, ord=q, axis=1)
    np.testing.assert_allclose(ball.violation(points), proven, rtol=1e-7, atol=1e-11)
    inside = 0.5 * points / np.linalg.norm(points, ord=p, axis=1, keepdims=True)
    assert (ball.violation(inside) < 0.0).all()
