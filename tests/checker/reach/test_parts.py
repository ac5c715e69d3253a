"""Guards checker: the parts of the checker bound what they say they bound: against dense samples, and against the wing
that solves."""

from __future__ import annotations

import itertools
from dataclasses import replace
from time import sleep

import numpy as np
import pytest
import scipy.linalg
from flint import arb, ctx

import sparserob_core as sr
from sparserob_core.checker.arithmetic.bernstein import highest
from sparserob_core.checker.arithmetic.series import stacked
from sparserob_core.checker.claims.cells import _is_smaller_box_better
from sparserob_core.checker.cost.duality import Duality
from sparserob_core.checker.flow.flow import VerifiedFlow
from sparserob_core.checker.flow.flows import VerifiedFlows
from sparserob_core.checker.flow.law import ParameterBox
from sparserob_core.checker.flow.plant import Plant
from sparserob_core.checker.outcome import LOOKED, Broken, Clock, Unchecked
from sparserob_core.checker.reach.kernels import compute_kernel
from sparserob_core.checker.reach.states import Scene, States
from sparserob_core.checker.reach.tube import Polynomial, ProjectedStates, VerifiedTube
from sparserob_core.checker.sets.known import known
from sparserob_core.checker.sets.shape import excess, find_inner_support_point
from sparserob_core.control.problem.problem import OptimalControlProblem
from sparserob_core.control.problem.system import LinearSystem
from sparserob_core.control.problem.terms.windows import PathConstraint
from sparserob_core.control.response.time_grid import merge_grids
from sparserob_core.control.sets.sets import Box, ConvexSet, Cylinder, Ellipsoid, NormBall, Polytope
from sparserob_core.control.transcription.transcribe import prepare
from sparserob_core.sip.expressions.expression import parse_matrix
from tests.support.plants import indicators, random_system, uniform, worst_case

TRIANGLE = Polytope(np.array([[1.0, 1.0], [-1.0, 0.0], [0.0, -1.0]]), np.array([1.0, 0.5, 0.25]))
TILTED = Ellipsoid(np.array([0.1, -0.2]), np.array([[0.5, 0.2], [0.2, 0.3]]))
SETS: dict[str, ConvexSet] = {
    "box": Box(np.array([-1.0, 0.2]), np.array([0.5, 0.7])),
    "polytope": TRIANGLE,
    "ellipsoid": TILTED,
    "zonotope": sr.Zonotope(np.array([0.1, 0.2]), np.array([[0.5, 0.1], [-0.2, 0.3], [0.1, 0.1]])),
    **{f"{p}-norm": NormBall(p=p, radius=0.7, centre=np.array([0.3, -0.1])) for p in (1.0, 1.5, 2.0, 3.0, np.inf)},
}


def exact(values):
    return [arb(float(v)) for v in values]


@pytest.mark.parametrize("shape", [(9,), (5, 4), (4, 3, 3)])
def test_bernstein_bounds_are_above_every_sample_and_close_to_the_highest(shape):
    rng = np.random.default_rng(1)
    coefficients = rng.normal(size=(20, *shape))
    symmetric = [False] + [True] * (len(shape) - 1)
    axes = [np.linspace(-1.0 if both else 0.0, 1.0, 41) for both in symmetric]
    sampled = coefficients
    for axis, points in zip(range(len(shape)), axes, strict=True):
        sampled = np.moveaxis(
            np.tensordot(sampled, np.vander(points, shape[axis], increasing=True), axes=(axis + 1, 1)), -1, axis + 1
        )
    top = sampled.reshape(20, -1).max(axis=1)
    for offset in (-1.0, 0.1):
        limits = top + offset
        found = np.array(
            [highest(c[None], symmetric, np.zeros(1), limit)[0] for c, limit in zip(coefficients, limits, strict=True)]
        )
        assert (found >= top).all()
        assert ((found <= limits) == (offset > 0)).all()


def test_bernstein_bounds_add_the_errors_and_never_prove_what_is_not_finite():
    one = np.array([[1.0, -1.0], [1.0, -1.0], [np.inf, -np.inf], [1e308, 1e308]])
    found = highest(one, [False], np.array([0.0, 0.5, 0.0, 0.0]), 2.0)
    assert found[0] == pytest.approx(1.0)
    assert found[1] == pytest.approx(1.5)
    assert not (found[2:] <= 2.0).any()
    assert (highest(one[:1], [False], np.array([np.nan]), 2.0) > 2.0).all()


@pytest.mark.parametrize("name", SETS)
def test_a_linear_bound_is_above_the_support_on_its_range_and_sharp_at_a_point(name):
    rng, shape = np.random.default_rng(2), SETS[name]
    value = rng.normal(size=(200, 2))
    for spread in (np.zeros((200, 2)), 10.0 ** rng.uniform(-9, 0.5, size=(200, 2))):
        w, excess_ = known(shape).bound(value, spread)
        for corner in [*itertools.product((-1, 0, 1), repeat=2), *rng.uniform(-1, 1, size=(20, 2))]:
            f = value + spread * np.array(corner)
            assert (shape.support(f) <= np.einsum("kw,kw->k", w, f) + excess_ + 1e-15 * np.abs(f).sum(axis=1)).all()
        if not spread.any():
            assert np.abs(np.einsum("kw,kw->k", w, value) + excess_ - shape.support(value)).max() < 1e-12


@pytest.mark.parametrize("thin", [1e-4, 1e-8, 1e-12, 1e-15])
def test_a_linear_bound_of_a_thin_ellipsoid_loses_nothing_to_cancellation(thin):
    rng, short = np.random.default_rng(0), 0.0
    for _ in range(100):
        turn, _ = np.linalg.qr(rng.normal(size=(3, 3)))
        S = (turn * np.array([1.0, 1e-2, thin])) @ turn.T
        try:
            shape = Ellipsoid(np.zeros(3), (S + S.T) / 2)
        except sr.InputError:
            continue
        value = turn[:, 2]
        w, over = known(shape).bound(value[None], np.zeros((1, 3)))
        with ctx.workprec(200):
            bound = sum((a * b for a, b in zip(exact(w[0]), exact(value), strict=True)), arb(float(over[0])))
            short = max(short, float((known(shape).support(exact(value)) - bound).upper()))
    assert short <= 0.0


@pytest.mark.parametrize("thin", [1e-4, 1e-8, 1e-12])
def test_a_point_far_out_in_a_thin_ellipsoid_is_at_its_edge(thin):
    """Rounded to floats it would be outside by 1e-16 of the longest axis, or far inside."""
    turn, _ = np.linalg.qr(np.random.default_rng(0).normal(size=(3, 3)))
    S = (turn * np.array([1.0, 1e-2, thin])) @ turn.T
    shape, direction = known(Ellipsoid(np.zeros(3), (S + S.T) / 2)), turn[:, 2]
    with ctx.workprec(96):
        point = find_inner_support_point(shape, direction)
        reached = sum((a * x for a, x in zip(exact(direction), point, strict=True)), arb(0))
        assert shape.holds(point)
        assert 1.0 - reached / shape.support(exact(direction)) < 1e-15


def test_a_linear_bound_of_a_polytope_loses_nothing_to_the_units_of_its_coordinates():
    units = np.array([1e6, 1e-6])
    plain = Polytope(np.vstack([np.eye(2), -np.eye(2)]), np.ones(4))
    other = Polytope(np.vstack([np.eye(2), -np.eye(2)]) / units, np.ones(4))
    value = np.array([[1.0, 1.0], [0.3, -2.0]])
    for shape, seen in ((plain, value), (other, value / units)):
        w, over = known(shape).bound(seen, np.zeros((2, 2)))
        assert np.einsum("kw,kw->k", w, seen) == pytest.approx([2.0, 2.3])
        assert (over < 1e-14).all()


@pytest.mark.parametrize("name", SETS)
def test_support_balls_hold_the_support_of_the_set(name):
    rng, shape = np.random.default_rng(3), SETS[name]
    for direction in [*rng.normal(size=(30, 2)), np.array([1.0, 0.0]), np.array([0.0, -1.0])]:
        with ctx.workprec(96):
            ball = known(shape).support(exact(direction))
            cylinder = known(Cylinder(shape, 3)).support(exact([*direction, 0.0]))
        assert float(ball.rad()) < 1e-20
        assert float(ball.mid()) == pytest.approx(float(shape.support(direction)), rel=1e-13, abs=1e-14)
        assert cylinder.overlaps(ball)
    with pytest.raises(Broken):
        known(Cylinder(shape, 3)).support(exact([1.0, 0.0, 1e-300]))


@pytest.mark.parametrize("name", SETS)
def test_membership_is_proven_inside_and_never_outside(name):
    shape, rng = SETS[name], np.random.default_rng(4)
    middle = shape.interior_point()
    for direction in rng.normal(size=(30, 2)):
        edge = shape.support_point(direction[None])[0]
        inside, outside = middle + (1 - 1e-9) * (edge - middle), middle + (1 + 1e-9) * (edge - middle)
        assert known(shape).contains(inside)
        assert not known(shape).contains(outside)
        assert excess(known(shape), exact(inside))[0] == 0.0
        assert 0.0 < excess(known(shape), exact(outside))[0] < 1e-8


def test_a_point_that_cancels_is_not_said_to_be_inside():
    blurred = arb(0, 1e-30)
    for p in (1.5, 2.0, 3.0):
        ball = NormBall(p=p, radius=1.0, centre=np.zeros(2))
        assert excess(known(ball), [arb(5), blurred])[0] == pytest.approx(4.0)
        assert excess(known(ball), [arb(0.5), blurred])[0] == 0.0


def test_of_parallel_rows_the_nearest_one_limits():
    rows = sr.Polytope(np.array([[1.0], [-1.0], [2.0], [-4.0]]), np.array([0.5, 0.5, 0.4, 0.8]))
    assert abs(float(known(rows).limit(np.array([1.0])).mid()) - 0.2) < 1e-15
    assert abs(float(known(rows).limit(np.array([-4.0])).mid()) - 0.8) < 1e-15
    assert abs(float(known(rows).limit(np.array([-3.0])).mid()) - 0.6) < 1e-15


def test_limits_of_flat_sets_are_what_their_facets_say():
    for normal, height in known(TRIANGLE).facets or []:
        assert known(TRIANGLE).limit(normal) == height
    with pytest.raises(Broken, match="not the normal of a facet"):
        known(TRIANGLE).limit(np.array([1.0, 0.9]))
    with pytest.raises(Broken, match="unbounded"):
        known(Box(np.array([-1.0, -np.inf]), np.array([1.0, np.inf]))).limit(np.array([1.0, 1e-300]))


def plant(nu, spread):
    """A damped oscillator, a parameter in ``A`` and one in ``B``, both also in ``E``."""
    if not nu:
        return random_system(np.random.default_rng(5), states=2, disturbances=2)
    names = ("p1", "p2")[:nu]
    entries = ["-2 + p1*cos(p1)", "-0.5"], ["1 + sin(p2)" if nu > 1 else "1"], ["1", "0.3*exp(p1)"]
    A, B, E = (
        parse_matrix(name, rows, names)
        for name, rows in (("A", [["0", "1"], entries[0]]), ("B", [["0"], entries[1]]), ("E", [["1", "0"], entries[2]]))
    )
    return LinearSystem(A, B, E, parameters=Box(np.full(nu, -spread), np.full(nu, spread)), names=names)


def tube_of(system, control, disturbance, bound, degree, theta, start, initial_set=None):
    grid = merge_grids(control.breakpoints, disturbance.breakpoints)
    held = theta[
        np.clip(np.searchsorted(control.breakpoints, grid.breakpoints[:-1], side="right") - 1, 0, control.pieces - 1)
    ]
    box, until = system.parameters, float(grid.breakpoints[-1])
    around = ParameterBox() if box is None else ParameterBox.between(box.lower.tolist(), box.upper.tolist())
    scene = Scene(
        grid.breakpoints.tolist(),
        [stacked([[arb(float(u))]]) for u in held],
        start.tolist(),
        bound,
        disturbance.breakpoints[:-1].tolist(),
        initial_set,
    )
    flow = VerifiedFlow(Plant.of(system, until), until, around, degree if around.middle else 0)
    tube = VerifiedTube(ProjectedStates(States(flow, scene), np.eye(system.states)), flow.box)
    return tube, np.array(around.middle), np.array(around.halves)


def until(tube, start, stop):
    """The end of a cell from ``start`` on across which the flow is one polynomial."""
    return min([stop, *(mark for mark in tube.rows.states.marks if mark > start)])


@pytest.mark.first(16)
@pytest.mark.parametrize("name", ["box", "polytope", "ellipsoid", "zonotope", "1.5-norm", "2.0-norm"])
@pytest.mark.parametrize(
    ("nu", "spread", "degree", "near"), [(0, 0.0, 0, 1e-8), (1, 0.05, 8, 1e-8), (2, 0.05, 6, 1e-8), (1, 0.8, 6, np.inf)]
)
def test_tubes_are_above_the_worst_case_and_not_far_above(nu, spread, degree, near, name):
    rng, bound = np.random.default_rng(6), SETS[name]
    system, start = plant(nu, spread), np.array([-1.0, 0.5])
    control, disturbance = indicators([0.0, 0.3, 0.45, 1.1, 2.0]), uniform(5, 2.0)
    theta = rng.uniform(-1, 1, size=control.pieces)
    true = worst_case(system, control, disturbance, bound, initial_state=start)
    with ctx.workprec(96):
        tube, centre, radius = tube_of(system, control, disturbance, bound, degree, theta, start)
        for piece, (a, b) in enumerate(itertools.pairwise(tube.rows.states.scene.grid)):
            a, b = a + 0.1 * (b - a), b - 0.75 * (b - a)
            b = until(tube, a, b)
            directions = rng.normal(size=(3, 2))
            for direction, poly in zip(directions, tube.cells(piece, a, b, directions), strict=True):
                share, delta = rng.uniform(size=50), rng.uniform(-1, 1, size=(50, nu))
                share[:2], delta[:8] = (0.0, 1.0), np.sign(delta[:8])
                exponents = np.array(tube.flow.monomials.exponents, dtype=float).reshape(
                    1, tube.flow.monomials.size, nu
                )
                powers = np.prod(delta[:, None, :] ** exponents, axis=2)
                value = np.einsum(
                    "kj,jm,km->k",
                    np.vander(share, poly.coefficients.shape[0], increasing=True),
                    poly.coefficients,
                    powers,
                )
                where = a + share * (b - a), np.tile(direction, (50, 1)), centre + radius * delta
                truth = true.values(theta, *where)
                assert (truth <= value + poly.error + 1e-13).all()
                assert poly.error - poly.kinks <= near
                assert (value - poly.error - poly.kinks <= truth + 1e-13).all()


def test_what_initial_states_lose_while_they_switch_is_laid_to_what_it_depends_on():
    """The worst corner of a 1-norm ball changes with the time; with a parameter only where ``A`` has one."""
    start, control = np.array([1.0, -0.5]), uniform(2, 1.0)
    for entry, because in (("-2", False), ("-2 + 3*p1", True)):
        A, B = (
            parse_matrix(name, rows, ("p1",))
            for name, rows in (("A", [["0", "1"], [entry, "-0.5"]]), ("B", [["0"], ["1 + p1"]]))
        )
        system = LinearSystem(A, B, parameters=Box(np.array([-0.2]), np.array([0.2])))
        with ctx.workprec(96):
            corners = NormBall(p=1.0, radius=0.1, centre=np.zeros(2))
            tube, *_ = tube_of(system, control, control, None, 6, np.array([1.0, -1.0]), start, corners)
            (poly,) = tube.cells(0, 0.0, 0.5, np.array([[1.0, 0.3]]))
        assert poly.kinks > 1e-3
        assert (poly.turning > 0.2 * poly.kinks) if because else poly.turning == 0.0
        assert _is_smaller_box_better(poly, 0.0, (0, 0.0, 0.5)) == because
        assert _is_smaller_box_better(poly, 0.0, (0, 0.5, 0.5))


def test_a_clock_looks_at_the_time_while_items_are_taken() -> None:
    taken = []
    with pytest.raises(Unchecked):
        for item in Clock(0.02).each(itertools.count()):
            taken.append(item)
            sleep(1e-5)
    assert taken
    assert len(taken) % LOOKED == 0
    assert [*Clock(60.0).each("abc")] == ["a", "b", "c"]


def test_a_row_that_is_certainly_exceeded_is_looked_for_where_it_changes():
    flat = Polynomial(np.array([[0.0, 0.5], [0.1, 0.0]]), 1e-3, 0.0, 1e-3)
    for top, blamed in ((1e-3, False), (1.0, True)):
        assert _is_smaller_box_better(flat, top, (0, 0.0, 1.0)) == blamed
    turned = replace(flat, coefficients=np.array([[0.0, 0.1], [0.5, 0.0]]))
    assert not _is_smaller_box_better(turned, 1.0, (0, 0.0, 1.0))


@pytest.mark.parametrize("factor", [1.0, 2.0**-30, 2.0**40, 3e5])
def test_the_kernel_of_a_measurable_disturbance_is_as_sharp_in_any_units(factor):
    turn = np.diag([1.0, factor])
    A, E = turn @ [[0.0, 1.0], [-2.0, -0.5]] @ np.linalg.inv(turn), turn @ [[0.3], [1.0]]
    size, plant = np.array([1.0, factor]), LinearSystem(A, np.zeros((2, 1)), E=E)
    with ctx.workprec(160):
        found = compute_kernel(VerifiedFlow(Plant.of(plant, 5.0), 5.0), 1.0, 1.25, slice(1, 2))
    value, off = found.mid[:, 0], found.rad[:, 0].sum(axis=0)
    assert (off <= 1e-14 * size[:, None]).all()
    for at in (-1.0, -0.3, 0.5, 1.0):
        truth = 0.25 * scipy.linalg.expm(A * 0.125 * (1.0 + at)) @ E
        got = np.einsum("p,pdw->dw", at ** np.arange(len(value)), value)
        assert (np.abs(got - truth) <= off + 1e-13 * size[:, None]).all()


def test_what_a_row_is_made_of_is_known_as_well_on_many_pieces_as_on_one() -> None:
    """Of what oscillates, on pieces of many lengths and over many of them, blocks add up to what a few large ones give,
    and the balls stay small."""
    ends = np.concatenate([np.linspace(0.0, 1.0, 150), 1.0 + np.sort(np.random.default_rng(5).uniform(0.0, 2.0, 40))])
    stiff = LinearSystem(np.array([[0.0, 40.0], [-40.0, -0.1]]), np.eye(2), E=np.eye(2))
    problem = sr.OptimalControlProblem(
        system=stiff, horizon=float(ends[-1]), initial_state=[1.0, 0.0], control=Box(-np.ones(2), np.ones(2))
    )
    with ctx.workprec(96):
        flows, c, time = VerifiedFlows.of(stiff, float(ends[-1])), np.array([1.0, 2.0]), float(ends[-3])
        duality = Duality(problem, sr.Dictionary.indicators(ends), ends[:-1].tolist(), flows)
        row = duality.row(c, time, (), arb(0), disturbed=False)
        pushed = duality.compute_disturbance_weights(c, time)
        carried = duality.compute_initial_weights(c, time)
    inverse = np.linalg.inv(stiff.phases[0].A.T)
    lags = np.array([scipy.linalg.expm(stiff.phases[0].A.T * max(0.0, time - s)) @ c for s in ends])
    assert [float(x.mid()) for x in carried] == pytest.approx(lags[0].tolist(), abs=1e-11)
    for found in (row.slope, pushed):
        assert np.array([[float(x.mid()) for x in one] for one in found]) == pytest.approx(
            -np.diff(lags, axis=0) @ inverse.T, abs=1e-11
        )
        assert max(float(x.rad()) for one in found for x in one) < 1e-15


def test_the_remainder_is_needed_and_enough_on_a_wide_box():
    """``x' = p x``, so ``x(1) = e^p``: what degree 2 leaves out on ``|p| <= 1`` is ``e - 2.5`` at most, and at least
    that."""
    system = LinearSystem(
        parse_matrix("A", [["p1"]], ("p1",)), np.array([[1.0]]), parameters=Box(np.array([-1.0]), np.array([1.0]))
    )
    control = uniform(2, 1.0)
    with ctx.workprec(96):
        tube, _, _ = tube_of(system, control, control, None, 2, np.zeros(2), np.array([1.0]))
        (poly,) = tube.cells(1, 1.0, 1.0, np.eye(1))
    assert poly.coefficients[0] == pytest.approx([1.0, 1.0, 0.5])
    assert np.e - 2.5 <= poly.error < 2.0  # Gronwall's factor is e


def test_the_remainder_is_enough_for_initial_states_in_a_set():
    """The same with ``|x(0)| <= 1``: the centre stays at 0, deviations do not."""
    system = LinearSystem(
        parse_matrix("A", [["p1"]], ("p1",)), np.array([[1.0]]), parameters=Box(np.array([-1.0]), np.array([1.0]))
    )
    control = uniform(2, 1.0)
    with ctx.workprec(96):
        anywhere = Box(-np.ones(1), np.ones(1))
        tube, _, _ = tube_of(system, control, control, None, 2, np.zeros(2), np.array([0.0]), anywhere)
        (poly,) = tube.cells(1, 1.0, 1.0, np.eye(1))
    assert poly.coefficients[0] == pytest.approx([1.0, 1.0, 0.5])
    assert np.e - 2.5 <= poly.error - poly.kinks < 2.0


@pytest.mark.parametrize("second", [1.0, 100.0, 2.0**20])
@pytest.mark.parametrize("metre", [1.0, 1e-6])
def test_the_remainder_is_a_small_share_of_the_states_in_any_units(second, metre):
    """Rendezvous (Clohessy and Wiltshire 1960): speeds are a thousandth of distances per unit of time, and a double
    eigenvalue 0 has no modal coordinates."""
    rows = [["0", "0", "1", "0"], ["0", "0", "0", "1"], ["3*p1**2", "0", "0", "2*p1"], ["0", "0", "-2*p1", "0"]]
    n, horizon = np.array([0.00112, 0.00114]) / second, 3000.0 * second
    system = LinearSystem(
        parse_matrix("A", rows, ("p1",)),
        metre / second**2 * np.array([[0.0], [0.0], [0.0], [1.0]]),
        parameters=Box(n[:1], n[1:]),
    )
    control, start = uniform(10, horizon), metre * np.array([0.0, -1000.0, 0.0, 0.0])
    with ctx.workprec(96):
        tube, _, _ = tube_of(system, control, control, None, 8, np.full(10, 1e-3), start)
        found = tube.cells(9, horizon, horizon, np.eye(4))
    sizes = metre * np.array([1e3, 1e3, 1.0 / second, 1.0 / second])
    assert (np.array([poly.error for poly in found]) < 1e-9 * sizes).all()


@pytest.mark.parametrize("nu", [0, 1, 2])
def test_rows_of_the_dual_are_those_of_the_transcription(nu):
    rng = np.random.default_rng(7)
    control, disturbance = indicators([0.0, 0.3, 0.45, 1.1, 2.0]), uniform(5, 2.0)
    problem = OptimalControlProblem(
        system=plant(nu, 0.1),
        horizon=2.0,
        initial_state=np.array([-1.0, 0.5]),
        control=Box(-np.ones(1), np.ones(1)),
        disturbance=TRIANGLE,
        path=[PathConstraint(Ellipsoid(np.zeros(2), np.eye(2)), 0.1, 1.9), PathConstraint(SETS["box"], 0.0, 2.0)],
    )
    family = prepare(problem, control, disturbance).program.families[1]
    dual = Duality(
        problem, control, disturbance.breakpoints[:-1].tolist(), VerifiedFlows.of(problem.system, 2.0), TRIANGLE
    )
    for time in (0.0, 0.3, 0.7, 2.0):
        parameter = rng.uniform(-0.1, 0.1, size=nu)
        G, h = family.rows(np.concatenate([[time], parameter])[None])
        for row, (normal, height) in enumerate(known(SETS["box"]).facets or []):
            with ctx.workprec(96):
                found = dual.row(normal, time, parameter.tolist(), height)
            mine = next(
                r
                for r in range(G.shape[1])
                if np.allclose(
                    [float(s[0].mid()) for s in found.slope] + [-float(found.constant.mid())],
                    [*G[0, r], h[0, r]],
                    rtol=0,
                    atol=1e-12,
                )
            )
            assert 0 <= mine < 4, row


def test_the_remainder_is_as_small_as_the_last_coefficients_of_the_state():
    """A control that changes its sign faster than the oscillation moves it little: a bound by the control's size alone
    leaves 1.4e-4 here."""
    system = LinearSystem(
        parse_matrix("A", [["0", "1"], ["-1 - p1", "-0.1"]], ("p1",)),
        np.array([[0.0], [1.0]]),
        parameters=Box(np.array([-0.02]), np.array([0.02])),
    )
    control, none = uniform(80, 10.0), np.zeros(2)
    with ctx.workprec(96):
        tube, _, _ = tube_of(system, control, control, None, 3, (-1.0) ** np.arange(80), none)
        found = tube.cells(79, 10.0, 10.0, np.eye(2))
        coefficients = np.abs(np.array([poly.coefficients[0] for poly in found]))
    assert max(poly.error for poly in found) < 0.2 * coefficients[:, 3].max()
