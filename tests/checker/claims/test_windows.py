"""Guards checker/claims of constraints on the state, of costs and of whole certificates, by plants whose worst is known
by hand.

``x' = u + w``, ``x(0) = 1``, two pieces of length 1, ``u = (0.5, -0.5)``, ``|w| <= 0.25``: at most 1.75, at 1.
"""

from __future__ import annotations

import math
from dataclasses import replace
from fractions import Fraction
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from flint import arb, ctx

import sparserob_core as sr
from sparserob_core.checker.arithmetic.balls import balls, is_semidefinite, rationals
from sparserob_core.checker.arithmetic.monomials import Monomials
from sparserob_core.checker.arithmetic.series import stacked
from sparserob_core.checker.claims import claims, constraints, multipliers, replay
from sparserob_core.checker.claims.case import Case, numbers
from sparserob_core.checker.claims.causal import _share_peak_price, causal_bound
from sparserob_core.checker.claims.cells import BoxOfStates, _bound_by_halfspaces
from sparserob_core.checker.claims.units import units_of
from sparserob_core.checker.outcome import RESOLVED, Broken, Clock, Finding, Unchecked
from sparserob_core.checker.reach import followed as followed_rows
from sparserob_core.checker.reach.tube import Polynomial
from sparserob_core.checker.sets.known import known
from sparserob_core.checker.sets.parameters import Parameters
from sparserob_core.checker.sets.sides import Bounded
from sparserob_core.control.policies.affine import AffinePolicy
from sparserob_core.control.problem.system import LinearSystem
from sparserob_core.control.sets.polytope import Polytope
from sparserob_core.control.sets.sets import Box, Ellipsoid, NormBall
from sparserob_core.sip.expressions.expression import parse_matrix

TOO_MUCH, NOTHING = 5e-9, 3e-10
ONE = np.ones((1, 1))


def proof(*cells):
    lower, upper = zip(*cells, strict=True)
    return {"tolerance": 1e-9, "lower": list(lower), "upper": list(upper)}


WHOLE, END = proof(([0.0], [2.0])), proof(([2.0], [2.0]))


def case_of(wall=None, decision=((0.5, -0.5),), certificate=None, policy=None, **more):
    problem = sr.OptimalControlProblem(
        **{
            "system": LinearSystem(np.zeros((1, 1)), ONE, E=ONE),
            "horizon": 2.0,
            "initial_state": [1.0],
            "control": Box([-1.0], [1.0]),
            "disturbance": Box([-0.25], [0.25]),
            "path": [] if wall is None else [wall if isinstance(wall, sr.PathConstraint) else sr.PathConstraint(wall)],
            **more,
        }
    )
    grid = sr.Dictionary.indicators([0.0, 1.0, 2.0])
    said = {
        "decision": np.array(decision).tolist(),
        "status": "verified",
        "proof": {"path": WHOLE, "terminal": END},
        **(certificate or {}),
    }
    return Case(problem, grid, grid, said, policy=policy)


def test_measurable_disturbances_in_time_stray_from_their_middle_by_half_their_widths():
    """A side that is a point strays by nothing; of 0.1 and 0.3 neither the middle nor the half is a number."""
    plant = sr.VaryingSystem.of([["-t"]], [[1]], 2.0, [[1, "t"]])
    bound = Box([-0.1, 0.05], [0.3, 0.05])
    case = case_of(system=plant, disturbance=bound, disturbance_class="measurable")
    held, strayed = case.disturbances.held, case.sources.measurable_input
    assert isinstance(held, Box)
    np.testing.assert_array_equal(held.lower, held.upper)
    np.testing.assert_allclose(held.lower, [0.1, 0.05], rtol=1e-15)
    wide, point = strayed.input.summands
    assert not point.corners.any() and not point.rad.any()
    assert (wide.rad[:, 0] > 0.0).all() and (wide.rad[:, 0] < 1e-15).all() and not wide.corners[:, 1].any()
    for end, corner, off in zip((bound.upper[0], bound.lower[0]), wide.corners[:, 0], wide.rad[:, 0], strict=True):
        far = Fraction(float(end)) - Fraction(float(held.lower[0]))
        assert abs(far - Fraction(float(corner))) <= Fraction(float(off))


@pytest.fixture(autouse=True)
def precision():
    with ctx.workprec(96):
        yield


def kept(case):
    return constraints.bounded(case, case.windows[0])


def below(size):
    return Box([-9.0], [size])


def test_a_wall_holds_up_to_where_the_worst_disturbance_takes_the_state():
    assert "margin" in kept(case_of(below(1.8)))
    assert "kept to" in kept(case_of(below(1.75 / (1 + NOTHING))))
    for size in (1.75 / (1 + TOO_MUCH), 1.7):
        with pytest.raises(Broken, match="exceeded"):
            kept(case_of(below(size)))
    # the same below, and at the end
    assert kept(case_of(Box([-0.5], [9.0]), decision=((-0.5, -0.5),)))
    with pytest.raises(Broken):
        kept(case_of(Box([-0.5 * (1 - 3 * TOO_MUCH)], [9.0]), decision=((-0.5, -0.5),)))
    assert kept(case_of(terminal=[below(1.5 / (1 + NOTHING))]))
    with pytest.raises(Broken, match="t = 2"):
        kept(case_of(terminal=[below(1.5 / (1 + TOO_MUCH))]))
    # only within its window
    assert kept(
        case_of(sr.PathConstraint(below(1.3), 0.0, 0.4), certificate={"proof": {"path": proof(([0.0], [0.4]))}})
    )
    with pytest.raises(Broken):
        kept(case_of(sr.PathConstraint(below(1.29), 0.0, 0.4), certificate={"proof": {"path": proof(([0.0], [0.4]))}}))


@pytest.mark.parametrize(
    "said",
    [
        {},
        {"path": {**WHOLE, "tolerance": 1.1e-9}},
        {"path": {**WHOLE, "tolerance": 0.0}},
        {"path": {**WHOLE, "tolerance": -1e-9}},
        {"path": proof(([0.0], [1.999999]))},
        {"path": proof(([1e-9], [2.0]))},
        {"path": proof(([0.0], [1.0]), ([1.1], [2.0]))},
        {"path": proof(([0.0, 0.0], [2.0, 1.0]))},
        {"path": proof(([0.0], [2.0]), ([0.0], [2.0]))},
        {"terminal": WHOLE},
        "nothing",
    ],
)
def test_cells_that_leave_a_time_out_prove_nothing(said):
    with pytest.raises(Broken):
        kept(case_of(below(9.0), certificate={"proof": said}))
    assert kept(case_of(below(9.0), certificate={"proof": {"path": proof(([1.0], [2.0]), ([0.0], [1.0]))}}))
    with pytest.raises(Unchecked):
        kept(case_of(below(9.0), certificate={"proof": {}, "status": "undecided"}))


def test_a_constraint_that_was_not_proven_on_cells_is_left_open():
    """As it is written for a family without an enclosure."""
    none = {"tolerance": 1e-9, "lower": np.zeros((0, 0)).tolist(), "upper": np.zeros((0, 0)).tolist()}
    with pytest.raises(Unchecked, match="no cells"):
        kept(case_of(below(9.0), certificate={"proof": {"path": none}}))


def test_a_wall_that_moves_is_where_it_is_at_every_time():
    """Above a reference that rises from 0 to 1 until 1 and falls to 0.5: the state is at most 1, 0.75 and 1 above."""
    moving = np.array([[0.0, 0.0], [1.0, 1.0], [2.0, 0.5]])
    for size, met in ((1.0 + 1e-8, True), (1.0 - 1e-8, False)):
        case = case_of(sr.PathConstraint(below(size), relative_to=moving))
        if met:
            assert kept(case)
        else:
            with pytest.raises(Broken):
                kept(case)
    window = case_of(sr.PathConstraint(below(1.0), relative_to=moving)).windows[0]
    offset, slope = window.evaluate_reference(0.5, 0.75)
    assert (float(offset[0].mid()), float(slope[0].mid())) == (0.5, 1.0)
    offset, slope = window.evaluate_reference(1.5, 1.5)
    assert (float(offset[0].mid()), float(slope[0].mid())) == (0.75, -0.5)
    assert float(window.limit(np.ones(1), 1.5).mid()) == 1.75
    assert float(window.limit(-np.ones(1), 1.5).mid()) == 9.0 - 0.75
    assert window.cuts([0.0, 1.0]) == [0.0, 1.0, 2.0]
    assert not window.is_mixed
    for time, value in ((-1.0, 0.0), (2.0, 0.5), (3.0, 0.5)):
        assert float(window.evaluate_reference(time, time)[0][0].mid()) == value


def mixed(size, start=0.0, stop=None):
    """``x + u <= size``: at most 1.75 + 0.5 at the end of the first piece."""
    return sr.MixedConstraint(ONE, ONE, [size], start, stop)


def test_a_constraint_on_state_and_control_sees_both_values_where_the_control_jumps():
    for size, met in ((2.25 + 1e-8, True), (2.25 - 2e-8, False), (1.8, False)):
        case = case_of(path=[mixed(size)])
        if met:
            assert kept(case)
        else:
            with pytest.raises(Broken):
                kept(case)
    case = case_of(path=[mixed(2.0)])
    window = case.windows[0]
    assert window.is_mixed and window.cuts([0.0, 1.0]) == [0.0, 1.0]
    over, slack = replay.exceeded(case, {"constraint": "path", "time": 1.0, "parameter": [], "violation": 0.0})
    assert sorted(over) == pytest.approx([1.75 - 0.5 - 2.0, 0.25])
    assert 1e-9 <= slack <= 1e-8
    for piece, time in ((0, 0.0), (0, 1.0), (1, 1.0), (1, 2.0)):
        window.meets([0.0, 1.0, 2.0], piece, time)
    for piece, time in ((0, 1.1), (1, 0.9), (2, 2.0), (-1, 0.0)):
        with pytest.raises(Broken):
            window.meets([0.0, 1.0, 2.0], piece, time)
    # a window that begins where a piece ends has nothing of it
    late = case_of(path=[mixed(2.0, 1.0, 2.0)], certificate={"proof": {"path": proof(([1.0], [2.0]))}}).windows[0]
    late.meets([0.0, 1.0, 2.0], 1, 1.0)
    with pytest.raises(Broken):
        late.meets([0.0, 1.0, 2.0], 0, 1.0)


def uncertain(parameters, text="p1", names=("p1",), **more):
    system = LinearSystem(parse_matrix("A", [[text]], names), ONE, parameters=parameters, names=names)
    return {"system": system, "disturbance": None, "decision": ((0.0, 0.0),), **more}


def test_the_worst_parameter_of_a_box_is_at_its_corner():
    """``x' = p x`` with ``|p| <= 1/2``: at most ``e`` at 2."""
    cells = {"proof": {"path": proof(([0.0, -0.5], [2.0, 0.5]))}}
    plant = uncertain(Box([-0.5], [0.5]))
    assert kept(case_of(below(math.e * (1 + 1e-9)), certificate=cells, **plant))
    for size in (math.e * (1 - 1e-3), 2.0):
        with pytest.raises((Broken, Unchecked)):
            kept(replace(case_of(below(size), certificate=cells, **plant), clock=Clock(0.3)))
    for wrong in (
        proof(([0.0, -0.5], [2.0, 0.4])),
        proof(([0.0, -0.4], [2.0, 0.5])),
        proof(([0.0, -0.5], [2.0, 0.0]), ([0.0, 0.1], [2.0, 0.5])),
        WHOLE,
    ):
        with pytest.raises(Broken):
            kept(case_of(below(99.0), certificate={"proof": {"path": wrong}}, **plant))


def test_a_set_of_parameters_that_is_no_box_is_filled_and_its_corners_are_not_in_it():
    """``x' = (p1 + p2) x`` on a disc of radius 1/2: at most ``e^sqrt(2)``, in the corners of the square ``e^2``."""
    plant = uncertain(NormBall(2.0, 0.5, dimension=2), "p1 + p2", ("p1", "p2"))
    square = {"proof": {"path": proof(([0.0, -0.5, -0.5], [2.0, 0.5, 0.5]))}}
    worst = math.exp(math.sqrt(2.0))
    assert kept(case_of(below(worst * 1.01), certificate=square, **plant))
    with pytest.raises((Broken, Unchecked)):  # what would be proven wrongly would be within the time
        kept(replace(case_of(below(0.9 * worst), certificate=square, **plant), clock=Clock(0.4)))
    halves = proof(([0.0, -0.5, -0.5], [2.0, 0.0, 0.5]), ([0.0, 0.0, -0.5], [2.0, 0.5, 0.5]))
    for order in (1, -1):
        cells = {name: ends if name == "tolerance" else ends[::order] for name, ends in halves.items()}
        assert kept(case_of(below(worst * 1.1), certificate={"proof": {"path": cells}}, **plant))
    for low, high in (([-0.49, -0.5], [0.5, 0.5]), ([-0.5, -0.5], [0.5, 0.499])):
        with pytest.raises(Broken, match="leave out"):
            cells = {"proof": {"path": proof(([0.0, *low], [2.0, *high]))}}
            kept(case_of(below(99.0), certificate=cells, **plant))


def test_directions_of_a_curved_wall_must_span_and_fill_the_faces():
    faces = [([0.0, s], [2.0, s]) for s in (-1.0, 1.0)]
    assert kept(case_of(Ellipsoid([0.0], [[1.76**2]]), certificate={"proof": {"path": proof(*faces)}}))
    wall = Ellipsoid([0.0], [[9.0]])
    with pytest.raises(Broken):
        kept(case_of(wall, certificate={"proof": {"path": proof(faces[0])}}))
    window = case_of(wall).windows[0]
    assert (constraints.normals_of(window, None) == [[1.0]]).all()
    assert (constraints.normals_of(window, [[2.0]]) == [[2.0]]).all()
    for wrong in ([[0.0]], [[1.0, 0.0]], [1.0]):
        with pytest.raises(Broken):
            constraints.normals_of(window, wrong)


def test_a_state_that_leaves_a_curved_wall_on_a_line_is_refuted_at_once():
    """The two directions of a line cannot be halved; the state leaves 1.7 at 0.95."""
    faces = {"proof": {"path": proof(*(([0.0, s], [2.0, s]) for s in (-1.0, 1.0)))}}
    for size, met in ((1.75 / (1 + NOTHING), True), (1.75 / (1 + TOO_MUCH), False), (1.7, False)):
        case = replace(case_of(Ellipsoid([0.0], [[size**2]]), certificate=faces), clock=Clock(5.0))
        if met:
            assert kept(case)
        else:
            with pytest.raises(Broken, match="exceeded"):
                kept(case)


@pytest.mark.parametrize("seed", range(6))
def test_a_bound_with_the_set_of_parameters_is_above_every_parameter_in_it(seed):
    """Of ``a'p + b t`` on a part of a disc around a point that is not 0, by the set: hardly above the largest."""
    rng = np.random.default_rng(seed)
    middle, radius = rng.uniform(-1.0, 1.0, 2), 0.5
    parameters = Parameters(known(NormBall(p=2.0, radius=radius, centre=middle)))
    low = middle + rng.uniform(-0.1, 0.1, 2)
    high = low + rng.uniform(0.4, 0.6, 2)  # its far corner is outside
    box, monomials = (tuple(low.tolist()), tuple(high.tolist())), Monomials(2, 1)
    flow = SimpleNamespace(centre=((low + high) / 2).tolist(), radius=((high - low) / 2).tolist(), monomials=monomials)
    slope, offset = rng.uniform(0.5, 1.0, 2), rng.normal()
    coefficients = np.zeros((2, 3))
    coefficients[0, 0], coefficients[1, 0] = offset, -0.3
    for i in range(2):
        coefficients[0, monomials.number[tuple(int(i == j) for j in range(2))]] = slope[i] * flow.radius[i]
    poly = Polynomial(coefficients, 1e-3, 0.0, 0.0)
    angle = np.linspace(0.0, 2 * np.pi, 40_001)
    edge = middle + radius * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    inside = edge[((edge >= low) & (edge <= high)).all(axis=1)]
    truth = offset + ((inside - flow.centre) @ slope).max() + 1e-3
    place = BoxOfStates(SimpleNamespace(flow=flow), parameters, box, Clock(9.0))
    for limit in (0.0, 0.7):
        row = Bounded(np.ones(1), limit, 1.0)
        found = _bound_by_halfspaces(place, row, poly)
        assert truth - row.allowed - 1e-9 <= found <= truth - row.allowed + 0.02


def test_a_cost_that_is_not_convex_is_refused_by_the_term():
    """A record takes no other than a convex one: the matrix is changed afterwards, as a forger would."""
    for name, letter in (("state", "Q"), ("control", "R"), ("final", "Q")):
        cost = sr.Cost(**{name: {letter: [[1.0]]}})
        case = case_of(disturbance=None, system=LinearSystem(np.zeros((1, 1)), ONE), cost=cost)
        case.price.convex()
        term = dict(zip(("state", "control", "final"), case.problem.cost.terms, strict=True))[name]
        object.__setattr__(term, "Q", -np.ones((1, 1)))
        with pytest.raises(Broken, match=name):
            case.price.convex()


def test_times_are_cut_where_the_grid_is():
    grid, cuts = np.array([0.0, 1.0, 2.0]), np.array([0.0, 0.5, 1.0, 2.0])
    assert constraints.cut(grid, cuts, 0.25, 1.5) == [(0, 0.25, 0.5), (0, 0.5, 1.0), (1, 1.0, 1.5)]
    assert constraints.cut(grid, cuts, 1.0, 2.0) == [(1, 1.0, 2.0)]
    assert constraints.cut(grid, cuts, 2.0, 2.0) == [(1, 2.0, 2.0)]
    assert constraints.cut(grid, cuts, 0.5, 0.5) == [(0, 0.5, 0.5)]


def test_a_witness_leads_to_what_it_says():
    wall = below(1.5)
    data = {
        "constraint": "path", "time": 1.0, "direction": [1.0], "parameter": [], "disturbance": [[0.25, 0.0]],
        "violation": 0.25,
    }  # fmt: skip
    assert "exceeded by 0.25 at t = 1" in claims._verify_witness(case_of(wall, certificate={"witness": data}))
    for time, signal, state in ((2.0, [[0.25, -0.1]], 1.15), (0.5, [[0.2, -0.1]], 1.35)):
        value = replay.compute_value(case_of(wall), np.ones(1), time, np.zeros(0), None, np.array(signal))
        assert float(value.mid()) == pytest.approx(state)
    for wrong in (
        {"violation": 0.25 + 1e-6},
        {"violation": 0.25 - 1e-6},
        {"disturbance": [[0.25 + 1e-15, 0.0]]},
        {"disturbance": [[0.25]]},
        {"disturbance": [[0.0, 0.0], [0.0, 0.0]]},
        {"disturbance": [[0.0, 0.0]], "violation": 0.0},
        {"disturbance": [[1.2e-9, 0.0]], "violation": 1.2e-9},
        {"time": 2.1},
        {"time": -0.1},
        {"direction": [1.0, 0.0]},
        {"parameter": [0.0]},
        {"constraint": "nobody"},
    ):
        with pytest.raises((Broken, Unchecked)):
            claims._verify_witness(case_of(wall, certificate={"witness": {**data, **wrong}}))
    little = {**data, "disturbance": [[1e-8, 0.0]], "violation": 1e-8}
    assert claims._verify_witness(case_of(wall, certificate={"witness": little}))
    with pytest.raises(Unchecked):
        claims._verify_witness(case_of(wall))
    begun = case_of(
        wall, certificate={"witness": {**data, "deviation": [0.1], "violation": 0.35}}, initial_set=Box([-0.1], [0.1])
    )
    assert claims._verify_witness(begun)
    for wrong in ([0.1 + 1e-15], [0.0, 0.0], None):
        with pytest.raises(Broken):
            said = {"witness": {**data, "deviation": wrong, "violation": 0.35}}
            claims._verify_witness(case_of(wall, certificate=said, initial_set=Box([-0.1], [0.1])))


def test_how_much_a_row_is_exceeded_is_told_at_its_time():
    case = case_of(Box([-1.0], [1.5]))
    over, slack = replay.exceeded(case, {"constraint": "path", "time": 1.0, "parameter": [], "violation": 0.0})
    assert sorted(over) == pytest.approx([-1.25 - 1.0, 0.25])
    assert slack == pytest.approx(1.5e-9, rel=0.7)
    assert max(replay.exceeded(case, {"constraint": "path", "time": 2.0, "parameter": [], "violation": 0})[0]) == (
        pytest.approx(0.0)
    )
    begun = case_of(Box([-1.0], [1.5]), initial_set=Box([-0.1], [0.1]))
    said = {"constraint": "path", "time": 1.0, "parameter": [], "violation": 0.0}
    assert max(replay.exceeded(begun, said)[0]) == pytest.approx(0.35)
    assert max(replay.exceeded(begun, said, np.array([1.05]))[0]) == pytest.approx(0.3)
    for wrong in ({"time": 2.1}, {"parameter": [1.0]}, {"constraint": "nobody"}, {"violation": "much"}):
        with pytest.raises(Broken):
            replay.exceeded(case, {**said, **wrong})


def finding(name, verdict):
    return Finding(name, verdict, "")


def test_a_status_follows_from_the_claims_under_it():
    every = [finding(name, "holds") for name in ("control", "cost", "lower bound", "path", "causal")]

    def status(said, tolerance=1e-6, lower=1.0 - 1e-7, gap_tolerance: Any = 1e-6, found=every):
        written = {"cost": 1.0, "lower_bound": lower, "gap_tolerance": gap_tolerance}
        return claims._verify_status(case_of(certificate=written), said, tolerance, found)

    assert "bounds meet" in status("certified")
    assert "gap" in status("verified", lower=0.0)
    assert status("undecided", found=[finding("path", "fails")])
    for more in ({"lower": 1.0 - 2e-6}, {"tolerance": 1e-5}, {"gap_tolerance": None}, {"tolerance": None}):
        with pytest.raises(Broken):
            status("certified", **more)
    for name, certified, verified in (
        ("path", False, False),
        ("control", False, False),
        ("cost", False, True),
        ("lower bound", False, True),
        ("causal", True, True),
    ):
        for verdict in ("fails", "not checked"):
            changed = [finding(one.name, verdict if one.name == name else one.verdict) for one in every]
            for said, follows in (("certified", certified), ("verified", verified)):
                if follows or (verdict == "fails" and name in ("cost", "lower bound")):
                    assert status(said, found=changed)
                else:
                    with pytest.raises(Broken if verdict == "fails" else Unchecked):
                        status(said, found=changed)
    case = case_of(certificate={"cost": 2.0})
    assert claims.relative_gap(case, 2.0, 1.0) == 0.5
    assert claims.relative_gap(case, 1.0, 2.0) == 0.0
    assert claims.relative_gap(case, 0.0, 0.0) == 0.0
    assert claims.relative_gap(case_of(certificate={"cost": -1.0}), -1.0, -4.0) == 0.75


@pytest.mark.parametrize("followed", [1, followed_rows.FOLLOWED])
def test_infeasibility_needs_a_sum_that_is_positive(followed, monkeypatch):
    """``x(2) <= -1.1`` and ``|u| <= 1``: at best -1 + 0.5. No decision is written then, also where rows are
    followed."""
    monkeypatch.setattr(followed_rows, "FOLLOWED", followed)
    entry = {"constraint": "terminal", "time": 2.0, "direction": [1.0], "parameter": [], "multiplier": 1.0}

    def judged(goal, **more):
        said = {"multipliers": {"constraints": [entry], "equalities": [], "pieces": None}, "status": "infeasible"}
        said["decision"] = None
        return claims._verify_infeasibility(case_of(certificate={**said, **more}, terminal=[Box([-9.0], [goal])]))

    assert "at least 0.1" in judged(-0.6)
    for goal in (-0.5, -0.4):
        with pytest.raises(Broken):
            judged(goal)
    with pytest.raises(Broken):
        judged(-0.6, multipliers=None, tree={"nodes": [], "constraints": []})


def causal(cost="nominal", lower=None, priced=True, signals=((UP := (0.25, 0.25)),), rows=((0, 1.0),), **more):
    """``x(2) <= 0.7`` asks ``u_0 + u_1 <= -0.3 - w_0 - w_1``."""
    said = {
        "lower_bound": lower,
        "signals": [[list(signal)] for signal in signals],
        "multipliers": [
            {"constraint": "terminal", "time": 2.0, "direction": [1.0], "signal": which, "multiplier": y}
            for which, y in rows
        ],
        **more,
    }
    case = case_of(certificate={"causal": said}, policy=AffinePolicy(cost=cost), terminal=[Box([-9.0], [0.7])])
    return case, float(causal_bound(case, said, priced).mid())


def test_a_bound_against_every_causal_policy_is_by_hand():
    """What is asked at 1 may depend on ``w_0``: under ``(1/4, 1/4)`` the second piece has no price of the nominal
    cost."""
    assert causal(signals=((0.0, 0.25),))[1] == pytest.approx(0.55)
    assert causal()[1] == pytest.approx(0.8 - 1.0)
    assert causal("peak")[1] == pytest.approx(0.8, abs=1e-9)
    assert causal("worst", shares=[1.0])[1] == pytest.approx(0.8)
    assert causal("worst", shares=[0.5])[1] == pytest.approx(0.8 - 0.5 - 0.5)
    assert causal(priced=False)[1] == pytest.approx(0.8 - 2.0)
    # two signals that part at 1: the first piece is the same for both
    two = {"signals": ((0.25, 0.25), (-0.25, 0.25)), "rows": ((0, 0.5), (1, 0.5))}
    assert causal("peak", **two)[1] == pytest.approx(0.55, abs=1e-9)
    assert causal("worst", shares=[0.5, 0.5], **two)[1] == pytest.approx(0.55)
    assert causal("worst", shares=[1.0, 0.0], **two)[1] == pytest.approx(0.55 - 0.5)
    assert causal(**two)[1] == pytest.approx(0.55 - 0.5 - 0.5)
    for wrong in ([1.5], [-0.1], [0.4, 0.4]):
        with pytest.raises(Broken):
            causal("worst", shares=wrong)
    with pytest.raises(Broken):
        causal("worst", shares=[0.5, 0.5 + 1e-12], **two)
    for wrong in ({"signals": ((0.26, 0.0),)}, {"signals": ((0.1,),)}, {"rows": ((1, 1.0),)}, {"rows": ((-1, 1.0),)},
                  {"rows": ((0, 0.0),)}, {"rows": ((0, -1.0),)}, {"rows": ((True, 1.0),)}):  # fmt: skip
        with pytest.raises(Broken):
            causal(**wrong)
    case, _ = causal()
    entry = case.certificate["causal"]["multipliers"][0]
    for wrong in ({"direction": [1.0, 0.0]}, {"time": 1.0}, {"time": 2.1}, {"constraint": "nobody"}, {"signal": None}):
        said = {**case.certificate["causal"], "multipliers": [{**entry, **wrong}]}
        with pytest.raises(Broken):
            causal_bound(case, said, priced=True)
    late = replace(case, problem=replace(case.problem, system=case.problem.system.with_delay(0.5)))
    # of the second piece only half is over by then
    assert float(causal_bound(late, case.certificate["causal"], priced=True).mid()) == pytest.approx(0.8 - 0.5)
    for change in (
        {"system": uncertain(Box([-0.1], [0.1]))["system"]},
        {"cost": sr.Cost(control={"R": [[1.0]]})},
    ):
        with pytest.raises(Unchecked):
            causal_bound(
                replace(case, problem=replace(case.problem, **change)), case.certificate["causal"], priced=True
            )
    with pytest.raises(Unchecked):
        causal_bound(replace(case, policy=None), case.certificate["causal"], priced=True)
    case, _ = causal("peak", lower=0.79)
    assert "0.79" in claims._verify_causal_bound(case)
    for lower, cost in ((0.8 + 1e-9, "peak"), (None, "peak"), (1.0, "nominal")):
        with pytest.raises(Broken):
            claims._verify_causal_bound(causal(cost, lower=lower)[0])
    hopeless = causal("peak", rows=((0, 1.0),), priced=False)[0]
    weak = replace(hopeless, problem=replace(hopeless.problem, control=Box([-0.3], [0.3])))
    assert "no causal policy exists" in claims._verify_causal_bound(weak)


def test_a_bound_behind_a_noise_is_by_hand():
    """``y_1`` beside the nominal one is ``w_0 + v_1``: with nothing seen and ``|v| <= 0.125`` both pieces are what they
    are nominally."""
    measured = sr.Measurements(np.ones((1, 1)), Box([-0.125], [0.125]))

    def bound(w=(0.1, 0.25), outputs=((0.0,), (0.0,)), start=(0.0,), **change):
        case, _ = causal(signals=(w,))
        changed = {"measurements": measured, **change}
        said = {
            **case.certificate["causal"],
            "outputs": [[list(one) for one in outputs]],
            "initial_states": [list(start)],
        }
        return float(causal_bound(replace(case, problem=replace(case.problem, **changed)), said, True).mid())

    assert bound() == pytest.approx(0.3 + 0.35)
    assert bound(w=(0.125, 0.25)) == pytest.approx(0.3 + 0.375)
    assert bound(w=(0.25, 0.25), outputs=((0.0,), (0.125,))) == pytest.approx(0.8 - 1.0)  # is seen
    for w, seen in ((0.1251, 0.0), (0.2, 0.0749), (-0.2, 0.0)):
        with pytest.raises(Broken):
            bound(w=(w, 0.25), outputs=((0.0,), (seen,)))
    with pytest.raises(Broken):  # at first nothing but the noise is seen, and that late is known in time
        bound(outputs=((0.1251,), (0.0,)))
    late = replace(measured, latency=1.0)
    assert bound(w=(0.25, 0.25), measurements=late) == pytest.approx(0.8)  # what nobody knows in time hides all
    begun = Box([-0.05], [0.05])
    assert bound(w=(0.1, 0.25), start=(0.02,), initial_set=begun) == pytest.approx(0.3 + 0.37)
    for wrong in ({"w": (0.1, 0.25), "start": (0.03,)}, {"start": (0.051,)}, {"start": (0.0, 0.0)}):
        with pytest.raises(Broken):  # what is hidden is both, and the initial state is in its set
            bound(**wrong, initial_set=begun)
    with pytest.raises(Broken):
        bound(measurements=sr.Measurements(np.ones((1, 1))))


def test_quadratic_costs_are_integrals_by_hand():
    """``x' = u`` from 1 under ``(-1, 0.5)``: ``1 - t``, then ``s / 2``."""
    cost = sr.Cost(l1=0.5, state={"Q": [[2.0]]}, control={"R": [[3.0]]}, final={"Q": [[4.0]], "reference": [1.0]})
    case = case_of(decision=((-1.0, 0.5),), disturbance=None, system=LinearSystem(np.zeros((1, 1)), ONE), cost=cost)
    state, control, final = 2.0 * (1 / 3 + 1 / 12), 3.0 * 1.25, 4.0 * 0.25
    value = case.price.of(case.pieces)
    assert float(value.mid()) == pytest.approx(0.5 * 1.5 + state + control + final)
    assert float(value.rad()) < 1e-18
    # the tangent touches at its control and lies below elsewhere, with the slopes of differences
    tangent = case.price.tangent(case.pieces)

    def quadratic(u):
        pieces = [stacked([[x] for x in balls([v])]) for v in u]
        return float((case.price.of(pieces) - balls([0.5])[0] * sum(abs(v) for v in u)).mid())

    def line(u):
        parts = (g[0] * arb(v) for g, v in zip(tangent.slope, u, strict=True))
        return float(sum(parts, tangent.constant).mid())

    assert line((-1.0, 0.5)) == pytest.approx(state + control + final)
    for u in np.random.default_rng(1).uniform(-2, 2, size=(20, 2)):
        assert line(u) <= quadratic(u) + 1e-12
    h = 1e-4
    for i, slope in enumerate(tangent.slope):
        ahead, behind = ([(-1.0, 0.5)[j] + s * h * (i == j) for j in range(2)] for s in (1, -1))
        assert float(slope[0].mid()) == pytest.approx((quadratic(ahead) - quadratic(behind)) / (2 * h), rel=1e-7)
    # what is added up: u'P u / 2 of the control, the linear part beside it, and what stays without any
    constant = 2.0 * 2.0
    bent = 3.0 * 1.25 + 2.0 * (1 / 3 + (1 - 0.5 + 1 / 12)) + 4.0 * 0.25
    linear = (state + control + final) - constant - bent
    assert case.price.added(case.pieces) == pytest.approx(0.75 + constant + bent + abs(linear))
    with pytest.raises(Broken, match="tangent"):
        multipliers.touched_by(case, {"tangent": [[0.0]]})
    assert len(multipliers.touched_by(case, {"tangent": [[0.0, 0.0]]})) == 2
    assert multipliers.touched_by(case_of(), {}) is None


def test_the_length_of_a_group_counts_once():
    two = {
        "system": LinearSystem(np.zeros((2, 2)), np.eye(2)), "initial_state": [0.0, 0.0], "disturbance": None,
        "control": Box([-5.0] * 2, [5.0] * 2), "decision": ((3.0, 0.0), (4.0, 1.0)), "weights": [2.0, 2.0],
    }  # fmt: skip
    for group, value in ((None, 2.0 * 8.0), ("all", 2.0 * 6.0), ([[1, 2]], 2.0 * 6.0), ([[2]], 2.0 * 8.0)):
        case = case_of(cost=sr.Cost(group=group), **two)
        assert float(case.price.of(case.pieces).mid()) == pytest.approx(value)
    assert float(case_of(cost=sr.Cost(l1=0.5), **two).price.costs[0][0].mid()) == 1.0
    # weights that change within a piece are integrated over it: 1 until 1/2, then 3
    stepped = case_of(cost=sr.Cost(l1=0.5), **{**two, "weights": [[0.0, 1.0, 1.0], [0.5, 3.0, 2.0]]})
    assert [[float(x.mid()) for x in row] for row in stepped.price.costs] == [[1.0, 0.75], [1.5, 1.0]]
    assert stepped.price.highest.tolist() == [3.0, 2.0]
    assert stepped.price.counts.tolist() == [1.0, 1.0]


def test_a_matrix_is_positive_semidefinite_in_rational_numbers():
    for Q, well in (
        ([[1.0, 1.0], [1.0, 1.0]], True),
        ([[1.0, 1.0], [1.0, 1.0 - 2e-16]], False),
        ([[0.0, 0.0], [0.0, 1.0]], True),
        ([[0.0, 1e-300], [1e-300, 1.0]], False),
        ([[1.0, 0.0], [1e-300, 1.0]], False),
        ([[-1e-300]], False),
        ([[4.0, 2.0, 0.0], [2.0, 1.0, 0.0], [0.0, 0.0, 0.0]], True),
        ([[4.0, 2.0, 1.0], [2.0, 1.0, 0.0], [1.0, 0.0, 9.0]], False),
    ):
        assert is_semidefinite(rationals(Q)) is well


def test_the_unit_of_a_row_is_the_smallest_of_its_width_its_limit_and_how_far_it_can_reach():
    """With ``|u| <= 1`` and ``|w| <= 0.25`` the state reaches from -1.5 to 3.5 by 2."""
    for wall, unit in (
        (Box([-9.0], [2.0]), [2.0, 3.5]),
        (Box([-9.0], [9.0]), [3.5, 3.5]),
        (Box([1.9], [2.0]), [0.1, 0.1]),
        (Box([-np.inf], [0.5]), [0.5]),
    ):
        case = case_of(wall)
        assert units_of(case, case.windows[0]).rows == pytest.approx(unit)
    early = case_of(sr.PathConstraint(Box([-9.0], [9.0]), 0.0, 1.0))
    assert units_of(early, early.windows[0]).rows == pytest.approx([2.25, 2.25])
    assert units_of(early, early.windows[0]).sums == pytest.approx([2.25])
    late = case_of(sr.PathConstraint(Box([-9.0], [9.0]), 0.5, 2.0))
    assert units_of(late, late.windows[0]).rows == pytest.approx([3.5, 3.5])
    moving = case_of(sr.PathConstraint(Box([-9.0], [9.0]), relative_to=np.array([[0.0, 1.0], [2.0, 1.0]])))
    assert units_of(moving, moving.windows[0]).rows == pytest.approx([2.5, 2.5])
    assert units_of(moving, moving.windows[0]).sums == pytest.approx([4.5])
    ball = case_of(NormBall(2.0, 3.0, centre=[0.5]))
    window = ball.windows[0]
    assert units_of(ball, window).slack(np.array([2.0]), window.limit(np.array([2.0]), 0.0)) == pytest.approx(
        6e-9 if window.enclosed_set.facets is None else 2e-9 * 2.5, rel=0.5
    )
    flat = case_of(Box([-9.0], [2.0]))
    slack = units_of(flat, flat.windows[0]).slack
    assert slack(np.array([1.0]), arb(2)) == pytest.approx(2e-9)
    assert slack(np.array([-2.0]), arb(18)) == pytest.approx(7e-9)


def test_a_bound_with_groups_uses_the_length_of_the_slope():
    """Both states go down by 0.6 and 0.8 together, at the least cost 1 of lengths."""
    plane = {
        "system": LinearSystem(np.zeros((2, 2)), np.eye(2)), "initial_state": [0.6, 0.8], "disturbance": None,
        "decision": ((-0.3, -0.3), (-0.4, -0.4)), "terminal": [Box([-9.0, -9.0], [0.0, 0.0])],
        "cost": sr.Cost(group="all"),
    }  # fmt: skip
    entries = [
        {"constraint": "terminal", "time": 2.0, "direction": axis, "parameter": [], "multiplier": y}
        for axis, y in (([1.0, 0.0], 0.6), ([0.0, 1.0], 0.8))
    ]
    for control in (Box([-1.0] * 2, [1.0] * 2), NormBall(2.0, 1.0, dimension=2)):
        for at, value in (((-0.3, -0.4), 1.0), ((0.0, 0.0), 1.0)):
            tangent = [[at[0]] * 2, [at[1]] * 2]
            said = {"multipliers": {"constraints": entries, "equalities": [], "pieces": None, "tangent": tangent}}
            case = case_of(certificate=said, control=control, **plane)
            assert float(multipliers.multiplied(case, priced=True).mid()) == pytest.approx(value)
        # a slope that is longer than the weight by a tenth costs that, as far as the control reaches
        longer = [{**entry, "multiplier": 1.1 * entry["multiplier"]} for entry in entries]
        said["multipliers"] = {**said["multipliers"], "constraints": longer}
        found = float(multipliers.multiplied(case_of(certificate=said, control=control, **plane), priced=True).mid())
        assert found <= 1.1 - 2 * 0.1 * 1.0 + 1e-12
        assert found >= 1.1 - 2 * 0.1 * 1.5


def test_a_vector_that_is_offered_for_a_norm_closes_the_bound_in_a_corner_and_never_passes_the_least_cost():
    """Slopes that drive a control of two channels into slanted sides, from where its length is worth the corner."""
    rng, corners = np.random.default_rng(3), np.array([[1.0, 0.2], [0.1, 0.9], [-1.0, 0.3], [-0.4, -0.8], [0.7, -0.9]])
    sides = np.roll(corners, -1, axis=0) - corners
    normals = np.stack([sides[:, 1], -sides[:, 0]], axis=1)
    plane = {"system": LinearSystem(np.zeros((2, 2)), np.eye(2)), "initial_state": [0.6, 0.8], "disturbance": None}
    case = case_of(
        decision=((0.0, 0.0), (0.0, 0.0)), control=Polytope(normals, (normals * corners).sum(axis=1)),
        cost=sr.Cost(group="all"), **plane,
    )  # fmt: skip
    shares = np.linspace(0.0, 1.0, 1601)[:, None]
    ends = np.roll(corners, -1, axis=0)
    edges = np.concatenate([(1.0 - shares) * a + shares * b for a, b in zip(corners, ends, strict=True)])
    for number in range(30):
        slope, weight = rng.normal(size=2) * 3.0, rng.uniform(0.2, 1.5)
        sizes = rng.uniform(0.1, 0.8, size=2) * (number >= 20)  # that absolute values cost beside the norm
        values = weight * np.linalg.norm(edges, axis=1) + np.abs(edges) @ sizes + edges @ slope
        least, best = min(0.0, float(values.min())), edges[values.argmin()]
        told, beside = ([arb(float(v)) for v in part] for part in (slope, sizes))
        given = ([arb(weight)] * 2, beside, told, [[0, 1]], [arb(0.3), arb(0.1)])
        bounds = [
            float(case.duality._bound_least_cost(*given, None if one is None else [arb(float(v)) for v in one]).mid())
            for one in (
                None,
                weight * best / np.linalg.norm(best) + sizes * np.sign(best),
                9.0 * rng.normal(size=2),
                -slope,
            )
        ]
        assert all(bound <= least + 1e-12 for bound in bounds)
        assert bounds[1] == max(bounds) and (least == 0.0 or bounds[1] >= least - 1e-3 * weight)


def test_numbers_that_are_far_apart_are_computed_with_more_bits():
    assert claims.precision_of(case_of()) == claims.PRECISION + 1  # 2 is the horizon times 1
    for A, apart in (([[2.0**-10, 2.0**19]], 20 + 9), ([[0.25, 0.5]], 1 + 1), ([[1e-300, 1e300]], None)):
        plant = LinearSystem(np.array([*A, [0.0, 0.0]]), np.array([[0.5], [0.5]]))
        case = case_of(system=plant, initial_state=[0.0, 0.0], disturbance=None)
        assert claims.precision_of(case) == (claims.MAX_PRECISION if apart is None else claims.PRECISION + apart)


def test_the_price_of_a_peak_is_parted_and_no_more_of_it_is():
    """Random slopes of groups of signals: what they are given together is at most the price, and nearly all of it."""
    rng = np.random.default_rng(2)
    for _ in range(30):
        case = case_of(control=Box([-1.0], [0.5]))
        groups = {bytes([g]): [arb(float(v))] for g, v in enumerate(rng.normal(size=rng.integers(1, 5)))}
        price = float(rng.uniform(0.1, 2.0))
        parts = [row[0] for row in _share_peak_price(case, [arb(price)], groups).values()]
        assert all(part >= 0 for part in parts)
        assert sum(parts, arb(0)) <= arb(price)
        assert float(sum(parts, arb(0)).mid()) >= price * (1.0 - 1e-9)
        # no group is given more than it can use, but for the first, which has what is left
        most = [abs(float(slope[0].mid())) for slope in groups.values()]
        assert all(float(part.mid()) <= one for part, one in list(zip(parts, most, strict=True))[1:])


@pytest.mark.parametrize("uncertain", [False, True])
def test_cells_of_a_curved_wall_fill_every_face_for_all_times_and_parameters(uncertain):
    """Each of the four faces of a square of directions, one cell each, and nothing may be missing of any."""
    more = {"parameters": Box([-0.5], [0.25])} if uncertain else {}
    matrix = (lambda p: np.array([[p[0], 0.0 * p[0]], [0.0 * p[0], p[0]]])) if uncertain else np.eye(2)
    case = case_of(
        wall=Ellipsoid([0.0, 0.0], [[4.0, 0.0], [0.0, 9.0]]),
        system=LinearSystem(matrix, np.eye(2), **more),
        initial_state=[0.0, 0.0],
        control=Box([-1.0, -1.0], [1.0, 1.0]),
        disturbance=None,
        decision=((0.0, 0.0), (0.0, 0.0)),
    )
    window, early, late = case.windows[0], [0.0, *([-0.5] * uncertain)], [2.0, *([0.25] * uncertain)]
    faces = [
        ((-1.0 if i else s, s if i else -1.0), (1.0 if i else s, s if i else 1.0)) for i in (0, 1) for s in (-1.0, 1.0)
    ]
    lower = np.array([[*early, *low] for low, _ in faces])
    upper = np.array([[*late, *high] for _, high in faces])
    constraints.covered(case, window, lower, upper)
    for face in range(4):
        others = np.arange(4) != face
        with pytest.raises(Broken):
            constraints.covered(case, window, lower[others], upper[others])
        for place in range(lower.shape[1]):
            less = upper.copy()
            less[face, place] -= 1e-9 if less[face, place] > lower[face, place] else 0.0
            if (less != upper).any():
                with pytest.raises(Broken):
                    constraints.covered(case, window, lower, less)
    for wrong in (lower[:, 1:], lower[:, :, None], lower[:1]):
        with pytest.raises(Broken, match="corners"):
            constraints.covered(case, window, wrong, upper[:, 1:] if wrong.shape[1] < lower.shape[1] else upper)


@pytest.mark.parametrize(
    ("said", "text"),
    [
        ([0.5, float("nan")], "expected finite numbers"),
        ([[1.0], [float("-inf")]], "expected finite numbers"),
        ([1.0, "2"], "expected numbers"),
        ([True], "expected numbers"),
        (None, "expected numbers"),
        ([[1.0, 2.0], [3.0]], "expected numbers"),
        ([1.0, [2.0]], "expected numbers"),
        ({"a": 1.0}, "expected numbers"),
    ],
)
def test_what_is_no_table_of_finite_numbers_is_refused_with_its_name(said, text):
    with pytest.raises(Broken, match=f"^of it: {text}$"):
        numbers(said, "of it")


def test_numbers_are_looked_at_whatever_they_are_nested_in():
    assert numbers([[1, 2.5], [3, 4]], "of it").tolist() == [[1.0, 2.5], [3.0, 4.0]]
    assert numbers([], "of it").shape == (0,) and numbers(3, "of it") == 3.0


def test_units_know_how_far_each_channel_of_the_decision_goes_at_any_time():
    two = {"system": LinearSystem(np.zeros((1, 1)), np.ones((1, 2)), E=ONE), "control": Box([-9.0] * 2, [9.0] * 2)}
    case = case_of(Box([-9.0], [9.0]), decision=((0.5, -2.0), (-3.0, 1.0)), **two)
    acting = units_of(case, case.windows[0]).acting
    assert acting is not None and acting.tolist() == [2.0, 3.0]


@pytest.mark.first(3)
@pytest.mark.parametrize("size", [1.0, 1e-150, 1e-200, 1e-250])
@pytest.mark.parametrize("kind", ["ball", "ellipsoid"])
def test_a_round_set_of_disturbances_takes_the_state_as_far_in_units_of_any_size(kind, size):
    """Squares of such numbers are 0 in double precision, and the set would be a point."""
    shape = NormBall(2.0, 0.25 * size, dimension=2) if kind == "ball" else Ellipsoid(np.zeros(2), 0.0625 * np.eye(2))
    plane = {
        "system": LinearSystem(np.zeros((2, 2)), size * np.eye(2), E=np.eye(2) * (1.0 if kind == "ball" else size)),
        "initial_state": [size, 0.0], "control": Box([-1.0] * 2, [1.0] * 2), "disturbance": shape,
        "decision": ((0.5, -0.5), (0.0, 0.0)),
    }  # fmt: skip
    # 1 after no time, 1.5 and 0.25 of the disturbance after 1, and 1 and twice that in the end
    assert kept(case_of(Box([-9.0 * size] * 2, [1.7501 * size, 9.0 * size]), **plane))
    with pytest.raises((Broken, Unchecked)):
        kept(case_of(Box([-9.0 * size] * 2, [1.7499 * size, 9.0 * size]), **plane))


@pytest.mark.parametrize("share", [0.99, 1.01])
def test_a_wall_is_judged_as_a_point_where_it_is_thinner_than_doubles_resolve(share):
    """Beside numbers of 3 and 2.5 that are added up, a slab of 2^-34 of these; what is excused of a point is a
    billionth of what its row does, or of its bound."""
    plane = {
        "system": LinearSystem(np.zeros((2, 2)), np.eye(2)), "initial_state": [1.0, 0.5], "disturbance": None,
        "control": Box([-1.0] * 2, [1.0] * 2), "decision": ((0.5, -0.5), (0.0, 0.0)),
    }  # fmt: skip
    half = 0.5 * share * 2.0**-34 * np.array([3.0, 2.5])
    case = case_of(Box(np.array([1.0, 0.5]) - half, np.array([1.0, 0.5]) + half), **plane)
    told = units_of(case, case.windows[0])
    reach, floor = np.tile([3.0, 2.5], 2), RESOLVED * np.tile([3.0, 2.5], 2)
    assert told.resolved == pytest.approx(reach if share < 1.0 else floor, rel=1e-6)
    assert told.rows == pytest.approx([1.5, 0.5, 1.5, 0.5] if share < 1.0 else floor, rel=1e-6)
    single = case_of(Polytope(np.array([[1.0, 0.0]]), np.array([share * 2.0**-34 * 3.0])), **plane)
    bound = units_of(single, single.windows[0]).resolved  # of a wall by itself the same, next to 0
    assert bound == pytest.approx([3.0 if share < 1.0 else RESOLVED * 3.0], rel=1e-6)


def test_a_direction_of_a_curved_wall_is_allowed_a_billionth_of_its_width_or_of_what_double_precision_resolves():
    plane = {
        "system": LinearSystem(np.zeros((2, 2)), np.eye(2)), "initial_state": [1.0, 0.5], "disturbance": None,
        "control": Box([-1.0] * 2, [1.0] * 2), "decision": ((0.5, -0.5), (0.0, 0.0)),
    }  # fmt: skip
    direction = np.array([0.6, -2.0])
    wide = case_of(NormBall(2.0, 3.0, centre=[0.5, 0.1]), **plane)
    (window,) = wide.windows
    length = float(np.linalg.norm(direction))
    assert units_of(wide, window).slack(direction, window.limit(direction, 0.0)) == pytest.approx(
        3e-9 * length, rel=1e-12
    )
    thin = case_of(NormBall(2.0, 1e-12, centre=[1.0, 0.5]), **plane)
    (window,) = thin.windows
    told = units_of(thin, window)
    # the initial state, and the range of the control on each of two pieces
    assert told.sums == pytest.approx([3.0, 2.5])
    # beside these a set of 1e-12 is a point, and what is excused of one is a billionth of what the states do
    assert told.slack(direction, window.limit(direction, 0.0)) == pytest.approx(
        1e-9 * (0.6 * 1.5 + 2.0 * 0.5), rel=1e-9
    )
    axis = np.array([0.0, 1.0])
    for width, unit in ((2.0**-34 * 0.99, 0.5), (2.0**-34 * 1.01, RESOLVED * 2.5)):
        near = case_of(NormBall(2.0, 2.5 * width, centre=[1.0, 0.5]), **plane)
        (window,) = near.windows
        slack = units_of(near, window).slack(axis, window.limit(axis, 0.0))
        assert slack == pytest.approx(1e-9 * unit, rel=1e-9)


@pytest.mark.slow
def test_a_box_of_parameters_is_looked_at_once_for_all_directions(monkeypatch):
    """``x' = ((p, q), (-q, p)) x`` with ``|p| <= 0.1`` and ``|q| <= 1``: at most ``e^0.2`` from the origin, from 1."""
    names, made, cells = ("p", "q"), list[Any](), []
    system = LinearSystem(
        parse_matrix("A", [["p", "q"], ["-q", "p"]], names),
        np.zeros((2, 1)),
        parameters=Box([-0.1, -1.0], [0.1, 1.0]),
        names=names,
    )
    for axis in range(2):
        for sign in (-1.0, 1.0):
            for low, high in ((-1.0, 0.0), (0.0, 1.0)):
                a, b = np.array([low, low]), np.array([high, high])
                a[axis] = b[axis] = sign
                cells.append(([2.0, -0.1, -1.0, *a], [2.0, 0.1, 1.0, *b]))
    known_tube = constraints.VerifiedTube
    monkeypatch.setattr(constraints, "VerifiedTube", lambda *given: made.append(given[1].middle) or known_tube(*given))

    def shown(radius):
        made.clear()
        return kept(
            case_of(
                system=system,
                initial_state=[1.0, 0.0],
                disturbance=None,
                decision=((0.0, 0.0),),
                terminal=[NormBall(2.0, radius, dimension=2)],
                certificate={"proof": {"terminal": proof(*cells)}},
            )
        )

    assert "boxes" in shown(math.exp(0.2) * 1.03)
    assert len(made) == len(set(made)) > 2
    with pytest.raises(Broken, match="exceeded"):
        shown(math.exp(0.2) * 0.95)
