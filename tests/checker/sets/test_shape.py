"""Guards checker/sets: what a set says of costs, facets, points far out and half-spaces, against programs and
samples."""

from __future__ import annotations

import math
import operator
from fractions import Fraction

import numpy as np
import pytest
from flint import arb, ctx
from scipy.optimize import linprog, minimize

import sparserob_core as sr
from sparserob_core.checker.arithmetic.balls import balls
from sparserob_core.checker.outcome import RESOLVED, TOLERANCE, Broken, Unchecked
from sparserob_core.checker.sets.known import known
from sparserob_core.checker.sets.parameters import Parameters, halfspaces
from sparserob_core.checker.sets.shape import basis_of, excess, facet, find_inner_support_point, widths
from sparserob_core.checker.sets.sides import Bounded, Curved, Sides
from sparserob_core.control.sets.sets import Box, Cylinder, Ellipsoid, NormBall, Polytope, Product

SETS = {
    "box": Box(np.array([-1.0, 0.2]), np.array([0.5, 0.7])),
    "triangle": Polytope(np.array([[1.0, 1.0], [-1.0, 0.0], [0.0, -1.0]]), np.array([1.0, 0.5, 0.25])),
    "ellipsoid": Ellipsoid(np.array([0.1, -0.2]), np.array([[0.5, 0.2], [0.2, 0.3]])),
    "zonotope": sr.Zonotope(np.array([0.1, 0.2]), np.array([[0.5, 0.1], [-0.2, 0.3], [0.1, 0.1]])),
    **{f"{p}-norm": NormBall(p=p, radius=0.7, centre=np.array([0.3, -0.1])) for p in (1.0, 1.5, 2.0, 3.0, np.inf)},
}
ROUND = [name for name in SETS if name in ("ellipsoid", "1.5-norm", "2.0-norm", "3.0-norm")]
FLAT = [name for name in SETS if name not in ROUND]


def points_of(name, count=400):
    """Points on the boundary of a set, and within."""
    angles = np.linspace(0.0, 2.0 * np.pi, count, endpoint=False)
    edge = SETS[name].support_point(np.stack([np.cos(angles), np.sin(angles)], axis=1))
    middle = SETS[name].interior_point()
    return np.concatenate([edge, middle + 0.5 * (edge - middle), [middle]])


@pytest.mark.parametrize("name", SETS)
def test_the_least_cost_over_a_set_is_below_every_point_of_it_and_reached_in_flat_ones(name):
    rng = np.random.default_rng(1)
    for _ in range(8):
        ups, downs, slope = rng.uniform(0, 2, size=2), rng.uniform(0, 2, size=2), rng.normal(size=2)
        with ctx.workprec(96):
            bound = float(known(SETS[name]).least(balls(ups), balls(downs), balls(slope)).mid())
        u = points_of(name)
        costs = np.maximum(u, 0.0) @ ups + np.maximum(-u, 0.0) @ downs + u @ slope
        assert bound <= costs.min() + 1e-12
        if name in FLAT:
            H, h = SETS[name].halfspaces()
            parts = np.concatenate([ups + slope, downs - slope])  # what is above 0 and what is below
            lowest = linprog(parts, A_ub=np.hstack([H, -H]), b_ub=h, bounds=[(0, None)] * 4).fun
            assert bound == pytest.approx(lowest, abs=1e-9)


@pytest.mark.parametrize("name", FLAT)
def test_facets_are_those_of_the_set_and_know_their_widths_and_units(name):
    shape = known(SETS[name])
    with ctx.workprec(96):
        normals = np.array([c for c, _ in shape.facets])
        heights = np.array([float(b.mid()) for _, b in shape.facets])
        assert heights == pytest.approx(SETS[name].support(normals), abs=1e-14)
        across = [SETS[name].support(-c[None])[0] + b for c, b in zip(normals, heights, strict=True)]
        turned = normals / np.linalg.norm(normals, axis=1)[:, None]
        for i, width in enumerate(widths(shape.facets)):
            opposite = np.abs(turned + turned[i]).max(axis=1) < 1e-9
            assert width == (pytest.approx(across[i]) if opposite.any() else math.inf)
        reach = np.maximum(np.abs(SETS[name].support(normals)), np.abs(SETS[name].support(-normals)))
        assert (np.array(shape.units) <= reach * (1 + 1e-12)).all()
        assert (np.array(shape.units) > 0.0).all()
        basis, z = basis_of(shape)
        assert (z @ basis == normals).all()
        assert len(basis) <= len(normals)
        for c in normals:
            y = shape.shares(np.asarray(2.5 * c))
            assert (y >= 0).all()
            assert y @ normals == pytest.approx(2.5 * c, abs=1e-12)


def test_the_unit_of_a_facet_is_the_smallest_of_its_width_its_reach_and_its_limit():
    thin = Polytope(np.array([[1.0, 0.0], [-1.0, 0.0], [0.0, 1.0], [0.0, -1.0]]), np.array([5.0, -4.5, 3.0, 1.0]))
    assert known(thin).units == pytest.approx([0.5, 0.5, 3.0, 1.0])
    far = Box(np.array([4.5, -1.0]), np.array([5.0, 3.0]))
    assert known(far).units == pytest.approx([0.5, 3.0, 0.5, 3.0])


def test_a_facet_is_found_by_any_multiple_of_its_normal_and_the_nearest_of_parallel_ones_wins():
    rows = [(np.array([1.0, 2.0]), arb(4)), (np.array([2.0, 4.0]), arb(7)), (np.array([-1.0, -2.0]), arb(0.5))]
    assert facet(rows, np.array([0.5, 1.0])) == (1, Fraction(1, 4))
    assert facet(rows, np.array([-3.0, -6.0])) == (2, Fraction(3))
    for wrong in ([1.0, 2.0 + 1e-15], [1.0, 0.0], [2.0, -1.0]):
        with pytest.raises(Broken):
            facet(rows, np.array(wrong))


@pytest.mark.parametrize("name", ROUND)
def test_a_point_far_out_is_in_the_set_and_at_its_edge(name):
    shape, rng = known(SETS[name]), np.random.default_rng(2)
    for direction in [*rng.normal(size=(20, 2)), np.array([0.0, -1.0]), np.array([1.0, 0.0])]:
        with ctx.workprec(96):
            point = find_inner_support_point(shape, direction)
            assert shape.holds(point)
            reached = sum((a * x for a, x in zip(balls(direction), point, strict=True)), arb(0))
            height = shape.support(balls(direction))
            assert float((height - reached).upper()) < 1e-18
            offsets = [x - m for x, m in zip(point, balls(shape.centre), strict=True)]
            assert abs(float(shape.gauge(offsets).mid()) - 1.0) < 1e-18
            assert float(shape.gauge([3 * v for v in offsets]).mid()) == pytest.approx(3.0)


@pytest.mark.parametrize("name", SETS)
def test_half_spaces_hold_the_set_and_leave_a_point_outside_out(name):
    rng, inside = np.random.default_rng(3), points_of(name)
    middle = SETS[name].interior_point()
    for direction in rng.normal(size=(10, 2)):
        outside = middle + 1.5 * (SETS[name].support_point(direction[None])[0] - middle)
        with ctx.workprec(96):
            spaces = [(c, float(b.mid())) for c, b in halfspaces(known(SETS[name]), outside)]
        assert all((inside @ c <= b + 1e-12).all() for c, b in spaces)
        assert any(outside @ c > b for c, b in spaces)


@pytest.mark.parametrize("name", SETS)
def test_radii_are_those_of_the_coordinates(name):
    far = np.abs(points_of(name, 4000)).max(axis=0)
    with ctx.workprec(96):
        radius = np.array(known(SETS[name]).radius)
    assert (radius >= far - 1e-15).all()
    assert radius == pytest.approx(far, rel=1e-5)


@pytest.mark.parametrize("name", SETS)
def test_the_excess_of_a_point_is_measured_in_the_unit_of_its_row_or_along_the_gauge(name):
    shape, rng = known(SETS[name]), np.random.default_rng(4)
    middle = SETS[name].interior_point() if name in FLAT else np.asarray(shape.centre)
    for direction in rng.normal(size=(12, 2)):
        edge = SETS[name].support_point(direction[None])[0]
        for share in (1e-6, 5e-9, 0.3):
            with ctx.workprec(96):
                over, _ = excess(shape, balls(middle + (1 + share) * (edge - middle)))
            if name in FLAT:
                H, h = (np.array([c for c, _ in shape.facets]), np.array([float(b.mid()) for _, b in shape.facets]))
                truth = ((H @ (middle + (1 + share) * (edge - middle)) - h) / shape.units).max()
                assert over == pytest.approx(truth, rel=1e-6)
            else:
                assert over == pytest.approx(share, rel=1e-6)
            assert over > TOLERANCE


def test_a_unit_is_never_smaller_than_what_double_precision_resolves():
    tiny = Box(np.array([1.0]), np.array([1.0 + 1e-12]))
    over, where = excess(known(tiny), [arb(1.0 + 2e-12)])
    assert where == "u1"
    assert over == pytest.approx(1e-12 / (RESOLVED * 2.0), rel=1e-3)


@pytest.mark.parametrize("name", [*ROUND, "high"])
def test_rows_at_the_corners_of_a_cell_of_directions_stand_for_all_of_it(name):
    rng = np.random.default_rng(5)
    source = SETS[name] if name != "high" else Ellipsoid(np.zeros(3), np.diag([1.0, 0.5, 2.0]) + 0.2)
    d = source.dimension
    with ctx.workprec(96):
        curved = Curved(
            known(source), rng.normal(size=(d, d)) + 2.0 * np.eye(d), lambda c, width: RESOLVED * np.abs(c).sum()
        )
        low, high = np.full(d, -0.4), np.full(d, 0.3)
        low[0] = high[0] = 1.0
        for depth in range(3):
            cell = Sides.cell(curved, low, high)
            assert len(cell.rows) == 2 ** (d - 1)
            corners = np.array([row.z for row in cell.rows])
            limits = np.array([row.limit for row in cell.rows])
            assert {tuple(z) for z in corners} == {
                tuple(np.where(ends, high, low)) for ends in np.ndindex(*(2,) * d) for ends in [np.array(ends)]
            }
            z = low + rng.uniform(size=(200, d)) * (high - low)
            states = rng.normal(size=(3000, d)) * 2.0
            kept = states[((states @ (corners @ curved.normals).T) <= limits).all(axis=1)]
            assert kept.size
            reach = source.support(z @ curved.normals)
            assert (kept @ (z @ curved.normals).T <= reach + 1e-12).all()
            assert (limits <= source.support(corners @ curved.normals)).all()
            centre = cell.centre
            assert centre is not None
            assert (centre.z == (low + high) / 2).all()
            true = source.support(((low + high) / 2 @ curved.normals)[None])[0]
            assert true - 1e-14 <= centre.limit <= true + 1e-15
            middle = float((low + high) / 2 @ curved.normals @ np.asarray(known(source).centre))
            assert centre.unit == pytest.approx(true - middle)
            # of bounds that are linear in the direction the slopes are the coefficients times the widths
            steep = rng.normal(size=d)
            slopes = cell.slopes([float(row.z @ steep) for row in cell.rows])
            np.testing.assert_allclose(slopes, np.abs(steep) * (high - low), rtol=1e-9, atol=1e-14)
            halves = cell.halves(high - low)
            axis = int((high - low).argmax())
            assert halves[0].high[axis] == halves[1].low[axis] == (low[axis] + high[axis]) / 2
            assert (halves[0].low == low).all() and (halves[1].high == high).all()
            low, high = halves[depth % 2].low, halves[depth % 2].high
        # a point of directions is a row with its true limit, nearly, and its own middle
        point = Sides.cell(curved, high, high)
        assert cell.is_wide and not point.is_wide and len(point.rows) == 1
        assert point.centre is not None and (point.centre.z == high).all()
        true = source.support((high @ curved.normals)[None])[0]
        assert true - 1e-14 * (1 + abs(true)) <= point.centre.limit <= true + 1e-15
        assert true - 1e-14 * (1 + abs(true)) <= point.rows[0].limit <= true
        with pytest.raises(Unchecked):
            Sides.cell(curved, high, np.where(np.arange(d) == 1, np.nextafter(high, np.inf), high)).halves(np.ones(d))


def test_an_excess_of_a_billionth_of_the_unit_counts_as_none_and_no_more():
    row = Bounded(np.ones(1), 2.0, 3.0)
    assert row.slack == TOLERANCE * 3.0 == pytest.approx(3e-9)
    assert Fraction(row.allowed) < Fraction(2.0) + Fraction(row.slack)
    assert row.allowed == pytest.approx(2.0 + 3e-9, rel=1e-15)


@pytest.mark.parametrize("name", [name for name in SETS if name != "box"])
def test_boxes_of_parameters_are_left_out_only_where_no_parameter_is(name):
    rng, inside = np.random.default_rng(6), points_of(name, 2000)
    left_out = 0
    with ctx.workprec(96):
        parameters = Parameters(known(SETS[name]))
        assert not parameters.is_box or name == "inf-norm"
        for _ in range(60):
            low = rng.uniform(-1.5, 1.5, size=2)
            high = low + rng.uniform(0, 0.6, size=2)
            holds = ((inside >= low) & (inside <= high)).all(axis=1)
            met = parameters.meets((tuple(low), tuple(high)))
            assert met or not holds.any()
            left_out += not met
            slope = rng.normal(size=2)
            for normals, limits, weights in parameters.bounds((tuple(low), tuple(high)), slope):
                assert (inside @ normals.T <= limits + 1e-15).all()
                assert (weights >= 0.0).all()
                assert np.linalg.norm(slope - weights @ normals) <= np.linalg.norm(slope) * (1 + 1e-12)
            ways = parameters.bounds((tuple(low), tuple(high)), slope)
            assert (ways[0][0] == slope).all() and ways[0][1][0] == pytest.approx(SETS[name].support(slope[None])[0])
    assert left_out > 10


def test_a_box_of_parameters_is_its_own_subdivision():
    for parameters in (Parameters(None), Parameters(known(SETS["box"]))):
        assert parameters.is_box
        assert parameters.meets(((5.0, 5.0), (6.0, 6.0)))
        assert parameters.bounds(((5.0, 5.0), (6.0, 6.0)), np.ones(2)) == []
    assert Parameters(None).holds(np.array([7.0]))
    assert not Parameters(known(SETS["box"])).holds(np.array([7.0, 0.0]))
    assert Parameters(known(SETS["ellipsoid"])).bounds(((0.0, 0.0), (1.0, 1.0)), np.zeros(2)) == []


@pytest.mark.parametrize("name", SETS)
def test_what_a_linear_bound_of_the_support_loses_on_a_range_is_little(name):
    """At most a few times what any linear bound must lose there: half of the largest gap on the range."""
    rng, shape = np.random.default_rng(7), SETS[name]
    value = rng.normal(size=(200, 2))
    value /= np.linalg.norm(value, axis=1)[:, None]
    for width in (1e-3, 0.05, 0.2):
        spread = np.full((200, 2), width)
        w, excess = known(shape).bound(value, spread)
        ends = value[:, None] + spread[:, None] * rng.uniform(-1, 1, size=(1, 200, 2))
        ends[:, :4] = value[:, None] + spread[:, None] * np.array([[1, 1], [1, -1], [-1, 1], [-1, -1]])
        reach = shape.support(ends.reshape(-1, 2)).reshape(200, -1)
        gap = (reach - np.einsum("kw,kew->ke", w, ends)).max(axis=1)
        assert (gap <= excess + 1e-15).all()
        assert (excess <= 8.0 * np.maximum(gap, 0.0) + (0.0 if name in FLAT else 8.0 * width**2) + 1e-12).all()


@pytest.mark.parametrize(
    "source", [SETS["ellipsoid"], SETS["2.0-norm"], Ellipsoid(np.ones(3), np.diag([1e4, 1.0, 1e-4]) + 1e-5)]
)
def test_the_factor_of_a_round_set_is_outside_of_it_and_next_to_it(source):
    with ctx.workprec(160):
        centre, norm = source.centre, known(source).norm
        L = norm.L * (1.0 + norm.share) * (1.0 + 1e-12)
        for direction in np.random.default_rng(8).normal(size=(100, source.dimension)):
            c, m = balls(direction), balls(centre)
            length = [sum((arb(float(x)) * a for x, a in zip(column, c, strict=True)), arb(0)) for column in L.T]
            outer = (
                sum((x * a for x, a in zip(m, c, strict=True)), arb(0)) + sum((v * v for v in length), arb(0)).sqrt()
            )
            reach = known(source).support(c)
            assert not outer < reach
            assert float((outer - reach).mid()) < 1e-9 * np.linalg.norm(L) * np.linalg.norm(direction)


def test_a_cylinder_is_its_base_and_free_beyond_it():
    base = SETS["ellipsoid"]
    shape = known(Cylinder(base, 4))
    with ctx.workprec(96):
        assert shape.spanned == 2
        assert (shape.centre == [0.1, -0.2, 0.0, 0.0]).all()
        assert shape.holds(balls([0.1, -0.2, 1e9, -1e9]))
        assert not shape.holds(balls([3.0, 0.0, 0.0, 0.0]))
        assert [float(v.mid()) for v in shape.compute_support_offset(balls([1.0, 0.5, 0.0, 0.0]))][2:] == [0.0, 0.0]
        assert shape.gauge(balls([0.3, 0.1, 5.0, 5.0])).overlaps(known(base).gauge(balls([0.3, 0.1])))
        with pytest.raises(Broken):
            shape.support(balls([1.0, 0.0, 0.0, 1e-300]))
        with pytest.raises(Broken):
            shape.bound(np.ones((1, 4)), np.zeros((1, 4)))


def test_an_oblique_cylinder_is_its_base_of_sums_of_coordinates():
    base, slopes = SETS["ellipsoid"], np.array([[1.0, 0.0], [0.0, -1.0]])
    shape = known(Cylinder(base, 4, slopes))
    with ctx.workprec(96):
        assert shape.spanned == 2
        assert shape.gauge(balls([0.125, 0.5, 0.25, 0.25])).overlaps(known(base).gauge(balls([0.375, 0.25])))
        assert shape.holds(balls([5.0, 7.0, 0.1 - 5.0, 7.0 + 0.2]))
        assert not shape.holds(balls([0.1, -0.2, 3.0, 0.0]))
        assert shape.support(balls([1.0, 0.3, 1.0, -0.3])).overlaps(known(base).support(balls([1.0, 0.3])))
        for beside in ([1.0, 0.3], [1.0, np.nextafter(-0.3, 0.0)], [0.0, 0.0]):
            with pytest.raises(Broken):
                shape.support(balls([1.0, 0.3, *beside]))
        assert shape.lifted(np.eye(2)).tolist() == [[1.0, 0.0, 1.0, 0.0], [0.0, 1.0, 0.0, -1.0]]
        for unknown in (0.5 * slopes, np.ones((2, 2)), np.full((2, 2), np.nan), slopes[:1]):
            with pytest.raises(Unchecked):
                known(Cylinder(base, 4, unknown))


def test_a_set_that_is_not_known_is_not_believed():
    class Flattering(Box):
        def support(self, direction):
            return 0.0 * super().support(direction)

    with pytest.raises(Unchecked):
        known(Flattering(-np.ones(2), np.ones(2)))


def test_the_support_function_of_balls_of_norms_is_that_of_the_dual_norm():
    rng = np.random.default_rng(9)
    for p in (1.0, 1.25, 2.0, 4.0):
        ball = NormBall(p=p, radius=1.3, centre=np.array([0.2, 0.1, -0.5]))
        for c in rng.normal(size=(5, 3)):
            truth = -minimize(
                lambda s, c=c, p=p: -(c @ s) / max(np.linalg.norm(s, ord=p), 1e-9),
                np.sign(c) + 0.1 * c,
                method="Nelder-Mead",
                options={"xatol": 1e-10, "fatol": 1e-13, "maxiter": 4000},
            ).fun
            with ctx.workprec(96):
                found = float(known(ball).support(balls(c)).mid())
            assert found == pytest.approx(c @ ball.centre + 1.3 * truth, rel=1e-6)


@pytest.mark.parametrize("size", [1e-6, 1.0, 1e6])
def test_a_row_of_a_curved_set_has_the_unit_of_its_width_and_never_less_than_those_of_the_states(size):
    source = Ellipsoid(np.zeros(2), size**2 * np.eye(2))
    z = np.array([1.0, 0.0])
    with ctx.workprec(96):
        for floors in (np.zeros(2), np.array([1e3 * size, 0.0])):
            row = Curved(known(source), np.eye(2), lambda c, _, floors=floors: float(np.abs(c) @ floors)).true(z)
            assert row.unit == pytest.approx(max(size, floors[0]))


def test_what_is_allowed_is_rounded_down_whatever_is_added():
    rng = np.random.default_rng(10)
    for limit, unit in rng.normal(size=(300, 2)) * 10.0 ** rng.uniform(-3, 3, size=(300, 2)):
        row = Bounded(np.ones(1), float(limit), abs(float(unit)))
        assert Fraction(row.allowed) <= Fraction(row.limit) + Fraction(row.slack)


def test_the_height_of_a_direction_is_told_from_below_in_balls():
    """Where the least cost is bounded by a tilt of the slope, the tilt stays between what rising and falling cost."""
    shape, rng = known(SETS["ellipsoid"]), np.random.default_rng(11)
    u = points_of("ellipsoid", 2000)
    with ctx.workprec(96):
        for _ in range(30):
            ups, downs, slope = rng.uniform(0, 2, size=2), rng.uniform(0, 2, size=2), 3.0 * rng.normal(size=2)
            bound = shape.least(*([arb(v, 0.01) for v in vector] for vector in (ups, downs, slope)))
            costs = np.maximum(u, 0.0) @ (ups - 0.01) + np.maximum(-u, 0.0) @ (downs - 0.01) + u @ slope
            costs -= 0.01 * np.abs(u).sum(axis=1)
            assert float(bound.lower()) <= costs.min() + 1e-12
            assert float(bound.upper()) >= costs.min() - 4.0


def test_a_ball_of_one_norm_in_many_dimensions_is_above_its_support_with_little_to_spare():
    """Beyond a few dimensions corners of a range are not gone through: the triangle inequality stands for them."""
    rng = np.random.default_rng(12)
    for p, d in ((3.0, 9), (1.5, 12), (1.0, 11), (3.0, 8)):
        source = NormBall(p=p, radius=1.3, centre=rng.normal(size=d))
        value, spread = rng.normal(size=(30, d)), 0.02 * rng.uniform(size=(30, d))
        with ctx.workprec(96):
            w, excess = known(source).bound(value, spread)
        for _ in range(20):
            f = value + spread * rng.choice([-1.0, 1.0], size=(30, d))
            assert (source.support(f) <= np.einsum("kd,kd->k", w, f) + excess + 1e-13).all()
        assert (excess <= 2.0 * 1.3 * np.abs(spread).sum(axis=1) * 2.0 + 1e-10).all()
        sharp = known(source).bound(value, np.zeros((30, d)))
        assert (np.abs(np.einsum("kd,kd->k", sharp[0], value) + sharp[1] - source.support(value)) < 1e-11).all()
        # seen from where the direction is nearly 0, the opposite corner of the range is the worst
        w, excess = known(source).bound(1e-9 * value, spread)
        f = 1e-9 * value + np.where(w >= source.centre, -spread, spread)
        gap = source.support(f) - np.einsum("kd,kd->k", w, f)
        assert (gap <= excess + 1e-15).all()
        assert d <= 8 or (excess <= gap + 1e-6).all()


def test_corners_of_a_zonotope_and_a_polytope_hold_in_exact_arithmetic():
    """A facet's limit is drawn inwards by what its rounded normal is off, twice as far as the set reaches: no point
    that it lets through is outside of the sum of segments."""
    source = SETS["zonotope"]
    with ctx.workprec(160):
        shape = known(source)
        for c, b in shape.facets:
            assert b <= shape.support(balls(c))
            assert float((shape.support(balls(c)) - b).upper()) < 1e-15
        for k in range(1, 60):
            turn = 2.0 * np.pi * k / 60
            direction = np.array([np.cos(turn), np.sin(turn)])
            edge = source.support_point(direction[None])[0]
            inside = source.centre + (1 - 1e-15 * 64) * (edge - source.centre)
            assert shape.holds(balls(inside))


@pytest.mark.parametrize("name", SETS)
def test_a_linear_bound_holds_where_a_range_is_many_times_as_wide_as_its_middle_is_far(name):
    rng, shape = np.random.default_rng(13), SETS[name]
    value, spread = 0.02 * rng.normal(size=(100, 2)), rng.uniform(0.5, 3.0, size=(100, 2))
    value[:5] = 0.0
    w, excess = known(shape).bound(value, spread)
    for corner in [(1, 1), (1, -1), (-1, 1), (-1, -1), (1, 0), (0, 1), (-1, 0), (0, -1), (0, 0)]:
        f = value + spread * np.array(corner)
        assert (shape.support(f) <= np.einsum("kw,kw->k", w, f) + excess + 1e-14).all()
    far = np.abs(points_of(name)).max()
    assert (excess <= 8.0 * far * spread.sum(axis=1)).all()


@pytest.mark.parametrize("scale", [1e-200, 1.0, 1e200])
@pytest.mark.parametrize("name", SETS)
def test_a_linear_bound_holds_along_axes_and_at_numbers_of_any_size(name, scale):
    """Entries that are exactly 0 beside others, in what is asked and in how far it may be off."""
    shape, axes = SETS[name], np.array([[1.0, 0.0], [0.0, 1.0], [-1.0, 0.0], [0.0, -1.0], [1.0, 0.0], [0.0, 0.0]])
    spreads = np.array([[0.0, 0.0], [0.0, 0.3], [0.2, 0.0], [0.4, 0.1], [3.0, 0.0], [0.0, 1.0]])
    for value, spread in ((scale * axes, scale * spreads), (scale * axes[::-1], scale * spreads)):
        w, excess = known(shape).bound(value, spread)
        for corner in ((1, 1), (1, -1), (-1, 1), (-1, -1), (0, 0)):
            f = value + spread * np.array(corner)
            owed = scale * shape.support(f / scale) - np.einsum("kw,kw->k", w, f)
            assert (owed <= excess + 1e-14 * scale).all()
        assert (excess <= 8.0 * (spread.sum(axis=1) + 1e-13 * scale)).all()


def exactly(shape, value, w):
    """``h(f) - w'f`` for rows of numbers, from below, beyond double precision."""
    with ctx.workprec(200):
        return np.array(
            [
                float((shape.support(balls(f)) - sum(map(operator.mul, balls(x), balls(f)), arb(0))).lower())
                for f, x in zip(value, w, strict=True)
            ]
        )


@pytest.mark.parametrize("name", SETS)
def test_at_a_point_a_linear_bound_is_sharp_and_rounding_does_not_put_it_below_the_support(name):
    """Compared beyond double precision, with numbers of any size beside each other: what is lost is rounding."""
    rng, shape = np.random.default_rng(14), known(SETS[name])
    value = rng.normal(size=(250, 2)) * 10.0 ** rng.uniform(-5, 5, size=(250, 2))
    for spread in (np.zeros_like(value), 1e-17 * np.abs(value)):
        w, excess = shape.bound(value, spread)
        above = exactly(shape, value, w)
        assert (above <= excess).all()
        assert (excess <= 5e-13 * np.abs(value).sum(axis=1)).all()


@pytest.mark.parametrize("name", SETS)
def test_corners_of_a_range_stay_below_a_linear_bound_to_the_last_bit(name):
    rng, shape = np.random.default_rng(15), known(SETS[name])
    value = rng.normal(size=(60, 2)) * 10.0 ** rng.uniform(-3, 3, size=(60, 2))
    spread = np.abs(value) * 10.0 ** rng.uniform(-16, 0.5, size=(60, 2))
    w, excess = shape.bound(value, spread)
    for corner in ((1, 1), (1, -1), (-1, 1), (-1, -1)):
        with np.errstate(invalid="ignore"):
            f = value + np.array(corner) * spread
        within = (
            np.abs(
                [[Fraction(a) - Fraction(b) for a, b in zip(*pair, strict=True)] for pair in zip(f, value, strict=True)]
            )
            <= spread
        ).all(axis=1)
        above = exactly(shape, f, w)
        assert (above <= excess)[within].all()


def test_half_a_line_has_a_support_on_one_side_only():
    shape = known(Box(np.array([-np.inf, 0.25]), np.array([1.0, np.inf])))
    assert shape.support(balls([2.0, -3.0])) == 2 * 1 - 3 * arb(0.25)
    assert shape.support(balls([0.0, 0.0])) == 0
    for direction in ([-1.0, 0.0], [0.0, 1.0], [2.0, 1e-300]):
        with pytest.raises(Broken):
            shape.support(balls(direction))


def test_a_point_that_is_known_to_a_ball_is_as_far_out_as_the_ball_may_be():
    shape = known(NormBall(p=2.0, radius=2.0, centre=np.zeros(2)))
    with ctx.workprec(96):
        over, where = excess(shape, [arb(2.0, 0.5), arb(0.0)])
        assert (over, where) == (pytest.approx(0.25), "it")
        assert excess(shape, [arb(1.0, 0.5), arb(0.0)])[0] == 0.0
        with pytest.raises(Unchecked):
            excess(shape, [arb(0.0, np.inf), arb(0.0)])
        over, where = excess(known(Box(-np.ones(2), np.ones(2))), [arb(0.0), arb(1.0, 0.5)])
        assert (over, where) == (pytest.approx(0.5), "u2")


def test_a_kind_of_set_without_an_answer_says_so():
    many = known(sr.Zonotope(np.zeros(2), np.random.default_rng(5).normal(size=(501, 2))))
    flat, round_ = known(SETS["triangle"]), known(SETS["ellipsoid"])
    for question in (
        lambda: flat.centre,
        lambda: flat.gauge(balls([1.0, 0.0])),
        lambda: flat.compute_support_offset(balls([1.0, 0.0])),
        lambda: known(SETS["ellipsoid"]).shares(np.ones(2)),
        lambda: many.holds(balls([0.0, 0.0])),
    ):
        with pytest.raises(Unchecked):
            question()
    assert flat.norm is None and round_.nearest(np.zeros(2)) is None


def test_a_product_is_bounded_and_holds_points_part_by_part():
    parts = (SETS["ellipsoid"], Box(np.array([-0.3]), np.array([0.5])), SETS["1.5-norm"])
    source, rng = Product(parts), np.random.default_rng(16)
    value, spread = rng.normal(size=(60, 5)), 0.3 * rng.uniform(size=(60, 5))
    with ctx.workprec(96):
        shape = known(source)
        w, excess = shape.bound(value, spread)
        for _ in range(20):
            f = value + spread * rng.choice([-1.0, 1.0], size=(60, 5))
            assert (source.support(f) <= np.einsum("kd,kd->k", w, f) + excess + 1e-13).all()
        sharp = shape.bound(value, np.zeros((60, 5)))
        assert (np.abs(np.einsum("kd,kd->k", sharp[0], value) + sharp[1] - source.support(value)) < 1e-11).all()
        for c, height in zip(value, source.support(value), strict=True):
            assert float(shape.support(balls(c)).mid()) == pytest.approx(height, rel=1e-12)
        inside = source.middle() + 0.99 * (source.support_point(value) - source.middle())
        assert all(shape.contains(point) for point in inside)
        for place in range(5):  # one coordinate too far, whatever the others are
            assert not shape.contains(source.middle() + 3.0 * np.eye(5)[place])


def test_opposite_normals_share_a_row_of_the_basis_whatever_the_sign_of_their_zeros():
    rows = np.array([[1.0, -0.0], [-1.0, 0.0], [-0.0, 2.0], [0.0, -2.0], [1.0, 1.0]])
    basis, z = basis_of(known(Polytope(rows, np.ones(5))))
    assert basis.shape == (3, 2) and (z @ basis == rows).all()
    assert sorted(np.abs(z).sum(axis=1).tolist()) == [1.0] * 5
