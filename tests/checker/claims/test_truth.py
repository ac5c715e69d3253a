"""Guards checker/claims: rows, bounds on constraints, replayed states and units of systems that turn, change, answer
late and drift, against a walk of our own through their pieces."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise, product
from typing import Any

import numpy as np
import pytest
from flint import arb, ctx

import sparserob_core as sr
from sparserob_core.checker.claims import cells, claims, constraints, replay, units
from sparserob_core.checker.claims.case import Case
from sparserob_core.checker.cost.duality import ConstraintRow, Duality
from sparserob_core.checker.flow.flows import VerifiedFlows
from sparserob_core.checker.outcome import Broken
from sparserob_core.checker.reach import followed as followed_rows
from sparserob_core.checker.reach.bounded_inputs import BoundedInputAt
from sparserob_core.checker.reach.followed_inputs import FollowedInput
from sparserob_core.checker.reach.tube import Polynomial
from sparserob_core.control.problem.system import VaryingSystem
from sparserob_core.control.sets.sets import Box
from tests.support.worst_cases import (
    BEFORE,
    CHANGES,
    CONTROL,
    DIRECTIONS,
    ENDS,
    HORIZON,
    KINDS,
    START,
    kind,
    walls,
)  # fmt: skip


@pytest.fixture(autouse=True)
def precision() -> Any:
    with ctx.workprec(96):
        yield


@pytest.mark.parametrize("name", KINDS)
def test_a_row_is_the_worst_case_of_every_control(name: str) -> None:
    made = kind(name)
    duality = made.case().duality
    for time in (0.0, 0.25, 0.5, 0.625, 0.7, 1.25, 1.3, 1.6, 2.0):
        row, limit = DIRECTIONS[2], 0.375
        exact = made.motion.weights(row[None], time)
        for disturbed in (True, False):
            found = duality.row(row, time, [], arb(limit), disturbed)
            slope = np.array([[float(x.mid()) for x in piece] for piece in found.slope])
            assert slope == pytest.approx(exact.control[0], abs=1e-13), (name, time)
            idle = replace(made, u=np.zeros((2, 3)), **({} if disturbed else {"bound": None, "begun": None}))
            assert float(found.constant.mid()) == pytest.approx(idle.heights(time, row[None])[0] - limit, abs=1e-13)
        pushed = (
            [[float(x.mid()) for x in block] for block in duality.compute_disturbance_weights(row, time)]
            if made.bound
            else []
        )
        assert np.array(pushed).reshape(-1, 2) == pytest.approx(exact.blocks[0], abs=1e-13)
        assert [float(x.mid()) for x in duality.compute_initial_weights(row, time)] == pytest.approx(
            exact.free[0], abs=1e-13
        )


@pytest.mark.parametrize("name", KINDS)
def test_a_row_along_its_adjoint_is_the_one_that_exponentials_give(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(followed_rows, "FOLLOWED", 1)
    case = kind(name).case()
    if not case.followed.are_best:
        return
    cases, problem = [case], case.problem
    if problem.disturbance is not None and problem.system.delay == 0.0:
        cases.append(replace(case, problem=replace(problem, disturbance_class="measurable")))
    for time in (0.0, 0.25, 0.7, 1.25, 1.3, 2.0):
        for one in cases:
            row, pairs = DIRECTIONS[2], list[tuple[arb, arb]]()
            for along in one.sources.entering_at([]):
                assert isinstance(along, FollowedInput)
                ends = [x.added(row, time) for x in (along, BoundedInputAt(one.flows.at(()), along.input))]
                pairs.append(tuple(arb(low).union(arb(high)) for low, high in ends))
            grid = [0.0, *(t for t in one.timing.grid[1:] if t < time), time]
            weights = [rows.weigh(row, [], grid) for rows in (one.duality.flows, one.flows)]
            assert one.duality.flows is one.followed
            disturbed = problem.disturbance is not None
            matrices = [[part.free, *part.control, *part.disturbance * disturbed] for part in weights]
            pairs += [
                pair
                for mine, its in zip(*matrices, strict=True)
                for pair in zip(mine.entries(), its.entries(), strict=True)
            ]
            assert all(a.overlaps(b) and float(a.rad()) < 1e-12 for a, b in pairs), (time, one.measurable)


@pytest.mark.parametrize("name", KINDS)
def test_a_replayed_state_is_that_of_its_disturbance(name: str) -> None:
    made = kind(name)
    case = made.case()
    signal = np.array([[0.2, -0.1, 0.05], [-0.3, 0.1, 0.0]])
    deviation = np.array([0.05, -0.1])
    at_blocks = np.searchsorted(CHANGES, case.timing.grid[:-1], side="right") - 1
    for time in (0.0, 0.3, 1.0, 1.75, 2.0):
        on_grid = None if made.bound is None else signal[:, at_blocks]
        start = None if made.begun is None else deviation
        found = [replay.compute_value(case, c, time, np.zeros(0), start, on_grid) for c in np.eye(2)]
        w = made.motion.weights(np.eye(2), time)
        exact = w.free @ START + (w.control * made.u.T).sum(axis=(1, 2)) + w.before @ BEFORE + w.drift
        if made.bound is not None:
            exact = exact + (w.blocks * signal.T).sum(axis=(1, 2)) + w.free @ deviation
        assert [float(x.mid()) for x in found] == pytest.approx(exact, abs=1e-13)


@pytest.mark.parametrize("which", ["fixed", "moving", "mixed"])
@pytest.mark.parametrize("name", [*KINDS[:-1], pytest.param(KINDS[-1], marks=pytest.mark.slow)])
def test_a_wall_may_be_where_the_worst_case_is_and_no_nearer(
    name: str, which: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    made, told = kind(name), []

    def prove(*given: Any) -> cells.Proven:
        told.append(cells.prove(*given))
        return told[-1]

    monkeypatch.setattr(constraints, "prove", prove)
    wall, times, heights = walls(name, which, made)
    highest, i = heights.max(axis=0), (KINDS.index(name) + len(which)) % len(DIRECTIONS)
    proof = {"proof": {"path": {"tolerance": 1e-9, "lower": [[times[0]]], "upper": [[times[-1]]]}}}
    room = 5e-3 * np.roll([1.0, 2.0, 4.0, 3.0], i)
    case = made.case(proof, path=[wall(highest + room)])
    assert "margin" in constraints.bounded(case, case.windows[0])
    # no more room is told than there is
    order = [int(np.abs(DIRECTIONS - c[:2]).sum(axis=1).argmin()) for c, _ in case.windows[0].enclosed_set.facets]
    assert -room.min() - 1e-12 <= told[0].bound <= 0.0
    assert (-room[order] / units.units_of(case, case.windows[0]).rows).max() - 1e-12 <= told[0].share <= 0.0
    near = highest + 5e-3
    near[i] = highest[i] - 1e-3
    case = made.case(proof, path=[wall(near)])
    with pytest.raises(Broken, match="exceeded"):
        constraints.bounded(case, case.windows[0])


@pytest.mark.parametrize("which", ["moving", "mixed"])
def test_a_wall_is_no_nearer_where_rows_are_followed(which: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """With curved sets it is not told how sharp a bound is."""
    monkeypatch.setattr(followed_rows, "FOLLOWED", 2)
    made = replace(kind("known"), begun=Box([-0.1, -0.05], [0.15, 0.1]))
    wall, times, heights = walls("known", which, made)
    highest, i = heights.max(axis=0), len(which) % len(DIRECTIONS)
    proof = {"proof": {"path": {"tolerance": 1e-9, "lower": [[times[0]]], "upper": [[times[-1]]]}}}
    case = made.case(proof, path=[wall(highest + 5e-3)])
    assert case.followed.are_best
    assert "margin" in constraints.bounded(case, case.windows[0])
    case = made.case(proof, path=[wall(highest + np.where(np.arange(4) == i, -1e-3, 5e-3))])
    with pytest.raises(Broken, match="exceeded"):
        constraints.bounded(case, case.windows[0])
    if which == "mixed":
        return
    at, top = {"start": 0.5, "stop": 0.5}, heights[list(times).index(0.5)]
    proof = {"proof": {"path": {"tolerance": 1e-9, "lower": [[0.5]], "upper": [[0.5]]}}}
    for off in (1e-7, -1e-7):
        case = made.case(proof, path=[replace(wall(top + np.where(np.arange(4) == i, off, 1e-7)), **at)])
        if off > 0.0:
            assert "margin" in constraints.bounded(case, case.windows[0])
        else:
            with pytest.raises(Broken, match="exceeded"):
                constraints.bounded(case, case.windows[0])


@pytest.mark.parametrize("which", ["fixed", "moving", "mixed"])
def test_a_violation_along_rows_is_the_one_of_the_tube(which: str, monkeypatch: pytest.MonkeyPatch) -> None:
    made = replace(kind("known"), begun=Box([-0.1, -0.05], [0.15, 0.1]))
    wall, _, heights = walls("known", which, made)
    case = made.case(path=[wall(heights.max(axis=0))])
    for time in (0.5, 1.3):
        said = {"constraint": case.windows[0].name, "time": time, "violation": 0.0}
        for begun in (None, np.array(START) + np.array([0.1, -0.05])):
            found = list[list[float]]()
            for followed in (100, 1):
                monkeypatch.setattr(followed_rows, "FOLLOWED", followed)
                over, slack = replay.exceeded(case, said, begun)
                found.append(over)
                assert slack < 1e-7
            assert found[1] == pytest.approx(found[0], abs=1e-12)


def test_a_quadratic_cost_of_a_system_in_time_is_an_integral_by_hand() -> None:
    """``x' = t u`` from 1 in two pieces of length 1: of the fourth degree in the time."""
    system = VaryingSystem.of([["0*t"]], [["t"]], HORIZON)
    cost = sr.Cost(state={"Q": [[2.0]]}, final={"Q": [[3.0]], "reference": [0.5]})
    problem = sr.OptimalControlProblem(
        system=system, horizon=HORIZON, initial_state=[1.0], control=Box([-1.0], [1.0]), cost=cost
    )
    grid, (u, v) = sr.Dictionary.indicators([0.0, 1.0, 2.0]), (-0.5, 0.75)
    case = Case(problem, grid, grid, {"decision": [[u, v]], "status": "verified"})
    half, last = 1.0 + u / 2.0, 1.0 + u / 2.0 + 1.5 * v
    # the integrals of (1 + u t^2 / 2)^2 up to 1, and of (half + v (t^2 - 1) / 2)^2 from 1 on
    first = 1.0 + u / 3.0 + u**2 / 20.0
    second = half**2 + half * v * 4.0 / 3.0 + v**2 / 4.0 * (31.0 / 5.0 - 14.0 / 3.0 + 1.0)
    tangent = case.price.tangent(case.pieces)
    value = 2.0 * (first + second) + 3.0 * (last - 0.5) ** 2
    assert float(case.price.squares(case.pieces).mid()) == pytest.approx(value, rel=1e-12)
    slope = 2.0 * (2.0 * half + (31.0 / 5.0 - 14.0 / 3.0 + 1.0) * v / 2.0 - 2.0 * half + half * 4.0 / 3.0)
    assert float(tangent.slope[1][0].mid()) == pytest.approx(slope + 6.0 * (last - 0.5) * 1.5, rel=1e-12)


@pytest.mark.parametrize("name", [*KINDS[:-1], pytest.param(KINDS[-1], marks=pytest.mark.slow)])
def test_quadratic_costs_are_integrals_along_the_nominal_motion(name: str) -> None:
    """By Gauss' rule between all breakpoints; the slopes are differences, which are exact for a square."""
    made, rng = kind(name), np.random.default_rng(4)
    Q, P, R = (m @ m.T for m in rng.normal(size=(3, 2, 2)))
    about, end = np.array([0.3, -0.2]), np.array([-0.5, 0.1])
    cost = sr.Cost(state={"Q": Q, "reference": about}, control={"R": R}, final={"Q": P, "reference": end})
    case = made.case(cost=cost, **({"initial_control": BEFORE} if made.motion.delay else {}))
    middle = np.zeros(2) if made.bound is None else made.bound.middle()
    begun = np.zeros(2) if made.begun is None else made.begun.middle()
    points, weights = np.polynomial.legendre.leggauss(6)
    cuts = np.unique([*made.motion.acting, *ENDS, *CHANGES, *made.motion.ends])
    every = [(a + b) / 2 + points * (b - a) / 2 for a, b in pairwise(cuts[cuts <= HORIZON].tolist())]
    shares = np.concatenate([weights * (b - a) / 2 for a, b in pairwise(cuts[cuts <= HORIZON].tolist())])
    parts = [made.motion.weights(np.eye(2), float(t)) for t in [*np.concatenate(every), HORIZON]]

    def value(u: np.ndarray) -> float:
        x = np.array(
            [w.free @ (START + begun) + (w.control * u.T).sum(axis=(1, 2)) + w.before @ BEFORE + w.drift
             + w.blocks.sum(axis=1) @ middle for w in parts]
        )  # fmt: skip
        state = np.einsum("ti,ij,tj->t", x[:-1] - about, Q, x[:-1] - about) @ shares
        return float(state + np.diff(ENDS) @ np.einsum("ik,ij,jk->k", u, R, u) + (x[-1] - end) @ P @ (x[-1] - end))

    assert float(case.price.squares(case.pieces).mid()) == pytest.approx(value(made.u), rel=1e-9)
    tangent = case.price.tangent(case.pieces)
    slope = np.array([[float(g.mid()) for g in piece] for piece in tangent.slope])
    line = float(tangent.constant.mid()) + (slope * made.u.T).sum()
    assert line == pytest.approx(value(made.u), rel=1e-9)
    for i, k in ((0, 0), (1, 2)):
        step = np.zeros_like(made.u)
        step[i, k] = 1.0
        assert slope[k, i] == pytest.approx((value(made.u + step) - value(made.u - step)) / 2.0, rel=1e-8, abs=1e-9)


@pytest.mark.parametrize(("name", "which"), [*product(KINDS[:-1], ["fixed", "moving", "mixed"]), (KINDS[-1], "mixed")])
def test_a_row_at_one_time_is_exceeded_by_what_the_worst_case_does_then(name: str, which: str) -> None:
    made = kind(name)
    wall, times, heights = walls(name, which, made)
    highest = heights.max(axis=0)
    case = made.case(path=[wall(highest)])
    for k in (0, len(times) // 2, len(times) - 1):
        said = {"constraint": "path", "time": float(times[k]), "parameter": [], "violation": 0.0}
        found = np.array(replay.exceeded(case, said)[0]).reshape(-1, len(DIRECTIONS))
        order = [int(np.abs(DIRECTIONS - c[:2]).sum(axis=1).argmin()) for c, _ in case.windows[0].enclosed_set.facets]
        assert found.max(axis=0) == pytest.approx((heights[k] - highest)[order], abs=1e-12)


@pytest.mark.parametrize("name", KINDS)
def test_a_unit_is_no_more_than_a_row_reaches_however_few_numbers_are_held(
    name: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The reach: the largest absolute value at the breakpoints within the window, of controls that jump at each."""
    made = kind(name)
    case = made.case(path=[sr.PathConstraint(sr.Polytope(DIRECTIONS, np.full(4, 1e6)), 0.5, 1.75)])
    nodes = np.array(sorted({*(t for t in case.timing.grid if t < 1.75), 0.5, 1.75}))
    fine, waits = replace(made.motion, breakpoints=nodes, delay=0.0), nodes[:-1] < made.motion.delay
    reach = np.zeros(4)
    for t in nodes[nodes >= 0.5]:
        w = fine.weights(DIRECTIONS, float(t))
        known = w.free @ START + (w.control[:, waits] @ BEFORE).sum(axis=1) + w.drift
        for s in (1.0, -1.0):
            most = s * known + CONTROL.support(s * w.control[:, ~waits]).sum(axis=1)
            if made.bound is not None and made.begun is not None:
                most = most + made.bound.support(s * w.blocks).sum(axis=1) + made.begun.support(s * w.free)
            reach = np.maximum(reach, np.abs(most))
    facets = case.windows[0].enclosed_set.facets
    order = [int(np.abs(DIRECTIONS - c).sum(axis=1).argmin()) for c, _ in facets]
    found = units.units_of(case, case.windows[0])
    assert found.rows == pytest.approx(reach[order], rel=1e-12)
    sums = found.sums
    monkeypatch.setattr(units, "MAX_WEIGHTS", 1)
    again = units.units_of(made.case(path=case.problem.path), case.windows[0])
    assert again.rows == pytest.approx(found.rows, rel=1e-12)
    assert again.sums == pytest.approx(sums, rel=1e-12)
    assert claims.precision_of(case) >= claims.PRECISION


def test_slopes_on_pieces_may_be_moved_as_far_as_every_control_of_few_functions_is_alike() -> None:
    """Of one function the coefficient is the control itself, so that no more than its far end is given away."""
    rng, K = np.random.default_rng(7), 4
    problem = replace(kind("alone").case().problem, control=Box([-1.0, -0.25], [0.5, 0.5]))
    for values in (np.ones((1, K)), np.array([[1.0, 1.0, 1.0, 1.0], [1.0, 1.0, -1.0, -1.0]])):
        few, flows = sr.Dictionary(np.linspace(0.0, HORIZON, K + 1), values), VerifiedFlows.of(problem.system, HORIZON)
        duality = Duality(problem, few, None, flows)
        slope, moved = rng.normal(size=(K, 2)), rng.normal(size=(K, 2))
        row = ConstraintRow(arb(0.25), [[arb(v) for v in piece] for piece in slope])
        constant, slopes = duality.summed([(2.0, row)], (-moved.T).tolist())
        assert np.array([[float(x.mid()) for x in piece] for piece in slopes]) == pytest.approx(moved)
        low, high = (end[:, None] for end in (problem.control.lower, problem.control.upper))
        halves = rng.uniform(low, high, size=(300, 2, len(values)))
        halves[:100] = np.where(halves[:100] > (low + high) / 2, high, low)
        u = np.repeat(halves, K // len(values), axis=2)
        truth = 2.0 * (0.25 + (u * slope.T).sum(axis=(1, 2)))
        told = float(constant.mid()) + (u * moved.T).sum(axis=(1, 2))
        assert (told <= truth + 1e-12).all()
        if len(values) == 1:
            off, ends = (2.0 * slope - moved).sum(axis=0), np.hstack([low, high])
            least = (np.abs(off) * np.abs(ends).max(axis=1) + (off[:, None] * ends).min(axis=1)).sum()
            assert (truth - told).min() == pytest.approx(least, abs=1e-12)
        # what acts alike on every control costs nothing
        null = np.array([1.0, -1.0, 1.0, -1.0])[:, None] * rng.normal(size=2)
        same, _ = duality.summed([(2.0, row)], (-(2.0 * slope + null).T).tolist())
        assert float(same.mid()) == pytest.approx(0.5, abs=1e-12)


def test_a_bound_is_the_least_of_the_cost_and_of_what_rows_say_of_sizes() -> None:
    """In a box, entry by entry: at an end, or at 0."""
    rng = np.random.default_rng(8)
    case = kind("alone").case(weights=[1.0, 0.25])
    lengths = np.diff(case.control.breakpoints)[:, None]
    low, high = CONTROL.lower, CONTROL.upper
    for count in (1, 2, 3):
        rows, constant, slope, sizes = [], 0.0, np.zeros((3, 2)), np.zeros((3, 2))
        for _ in range(count):
            y, c, g, s = rng.uniform(0.2, 1.0), rng.normal(), rng.normal(size=(3, 2)), rng.uniform(size=(3, 2))
            rows.append((y, ConstraintRow(arb(c), [[arb(v) for v in piece] for piece in g], s)))
            constant, slope, sizes = constant + y * c, slope + y * g, sizes + y * s
        for price, costs in ((case.price, lengths * np.array([1.0, 0.25])), (None, 0.0 * lengths)):
            ends = [slope * u + (costs + sizes) * np.abs(u) for u in (low, high)]
            least = constant + np.minimum(np.minimum(*ends), 0.0).sum()
            found = case.duality.bound(rows, None, price)
            assert float(found.mid()) == pytest.approx(least, abs=1e-12)
            assert float(found.rad()) < 1e-20


def test_what_errors_of_execution_add_beside_a_row_is_near_its_chord() -> None:
    made, shares = kind("alone"), np.array([0.1, 0.25])
    fine = replace(made.motion, breakpoints=np.linspace(0.0, HORIZON, 129), _steps={})
    size = np.abs(made.u).T[np.searchsorted(ENDS, fine.breakpoints[:-1], side="right") - 1] * shares
    case = made.case(path=[walls("alone", "fixed", made)[0](np.full(4, 9.0))], execution=shares)
    c = np.array([0.5, -1.25])
    beside = case.build_added_terms(case.windows[0], c[None], np.zeros((1, 2)))
    assert beside is not None and case.sources.execution is not None
    for a, b in ((0.125, 0.1875), (0.25, 0.5), (0.75, 1.0), (1.5, 2.0), (1.25, 1.25)):
        none, times = Polynomial(np.zeros((1, 1)), 0.0, 0.0, 0.0), [a] if a == b else [a, b]
        found = beside._add_bounded_input(none, case.sources.execution, c, np.zeros(2), times, None)
        terms, off = found.coefficients[:, 0], found.error
        truth = []
        for share in (0.0, 0.25, 0.5, 0.75, 1.0):
            at = fine.weights(c[None], a + share * (b - a)).control
            truth.append(float((np.abs(at) * size).sum()))
            told = float(np.polyval(terms[::-1], share))
            assert -off - 1e-12 <= told - truth[-1] <= off + 3e-4
        assert terms.size == 1 + (a < b)
        assert np.polyval(terms[::-1], 0.0) == pytest.approx(truth[0], abs=3e-4)
        assert np.polyval(terms[::-1], 1.0) == pytest.approx(truth[-1], abs=3e-4)
        assert off <= 2.0 * (b - a) ** 2 + 1e-12
        assert (
            off
            >= max(
                abs(t - (truth[0] * (1 - s) + truth[-1] * s))
                for s, t in zip((0.25, 0.5, 0.75), truth[1:4], strict=True)
            )
            - 3e-4
        )


@pytest.mark.slow
@pytest.mark.parametrize("name", ["alone", "known"])
def test_errors_of_execution_push_as_much_as_fine_pieces_of_either_sign(name: str) -> None:
    made, shares = kind(name), np.array([0.1, 0.25])
    wall, times, heights = walls(name, "fixed", made)
    fine = replace(made.motion, breakpoints=np.linspace(0.0, HORIZON, 129), _steps={})
    size = np.abs(made.u).T[np.searchsorted(ENDS, fine.breakpoints[:-1], side="right") - 1] * shares
    heights = heights + [(np.abs(fine.weights(DIRECTIONS, float(t)).control) * size).sum(axis=(1, 2)) for t in times]
    proof = {"proof": {"path": {"tolerance": 1e-9, "lower": [[times[0]]], "upper": [[times[-1]]]}}}
    highest = heights.max(axis=0) + 5e-3
    case = made.case(proof, path=[wall(highest)], execution=shares)
    assert "margin" in constraints.bounded(case, case.windows[0])
    for i in (0, 2):
        near = highest.copy()
        near[i] -= 6e-3
        case = made.case(proof, path=[wall(near)], execution=shares)
        with pytest.raises(Broken, match="exceeded"):
            constraints.bounded(case, case.windows[0])
