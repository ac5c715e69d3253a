"""Guards checker/claims of controls that answer: a plant so small that every figure of a policy is known by hand.

``x' = u + w``, ``x(0) = 0.5``, two pieces of length 1, ``|w| <= 0.25``; ``u_0 = 0.3`` and ``u_1 = -0.2 - w_0 / 2``,
since what is measured at 1 beyond what was predicted is ``w_0``. So ``x(1) = 0.8 + w_0`` and
``x(2) = 0.6 + w_0 / 2 + w_1``.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from flint import arb, ctx, fmpq

import sparserob_core as sr
from sparserob_core.checker.arithmetic.balls import balls
from sparserob_core.checker.arithmetic.series import exactly
from sparserob_core.checker.claims import claims, constraints, replay
from sparserob_core.checker.claims import multipliers as bounds
from sparserob_core.checker.claims.answers import VerifiedFeedback, feedback_of
from sparserob_core.checker.claims.case import Case
from sparserob_core.checker.outcome import Broken, Unchecked
from sparserob_core.checker.sets.known import known
from sparserob_core.checker.sets.shape import find_range, width
from sparserob_core.control.policies.affine import AffinePolicy
from sparserob_core.control.problem.system import LinearSystem
from sparserob_core.control.sets.sets import Box, Ellipsoid, Equality, NormBall, Polytope, Product

REACH = 0.25
TOO_MUCH, NOTHING = 5e-9, 3e-10  # of a unit: more and less than what counts as none
WALL = {"tolerance": 1e-9, "lower": [[0.0]], "upper": [[2.0]]}
END = {"tolerance": 1e-9, "lower": [[2.0]], "upper": [[2.0]]}


def box(size):
    return Box([-size], [size])


def gains_of(pieces=2, **entries):
    gains = np.zeros((pieces, pieces, 1, 1))
    for name, value in entries.items():
        gains[int(name[1]), int(name[2]), 0, 0] = value
    return gains


def case_of(control=1.0, wall=None, gains=None, cost="nominal", policy=None, certificate=None, pieces=2, **more):
    problem = sr.OptimalControlProblem(
        **{
            "system": LinearSystem(np.zeros((1, 1)), np.ones((1, 1)), E=np.ones((1, 1))),
            "horizon": 2.0,
            "initial_state": [0.5],
            "control": box(control) if isinstance(control, float) else control,
            "disturbance": box(REACH),
            "path": [] if wall is None else [sr.PathConstraint(wall)],
            **more,
        }
    )
    grid = sr.Dictionary.indicators(np.linspace(0.0, 2.0, pieces + 1))
    decision = np.array([[0.3, -0.2, 0.0][:pieces]])
    said = {
        "decision": decision.tolist(),
        "gains": (gains_of(m11=-0.5) if gains is None else gains).tolist(),
        "status": "verified",
        "proof": {"path": WALL, "terminal": END},
        **(certificate or {}),
    }
    return Case(problem, grid, grid, said, policy=policy or AffinePolicy(cost=cost))


def multiplied(case, rows, priced):
    """The bound of rows that are written as the multipliers of a certificate."""
    said = {**case.certificate, "multipliers": {"constraints": list(rows), "equalities": []}}
    return bounds.multiplied(replace(case, certificate=said), priced)


@pytest.fixture(autouse=True)
def precision():
    with ctx.workprec(96):
        yield


def test_a_peak_is_charged_to_its_own_channel_and_piece():
    plant = LinearSystem(np.zeros((1, 1)), np.ones((1, 2)), E=np.ones((1, 1)))
    said = {"decision": [[0.3, -0.2], [0.1, 0.0]]}
    two = case_of(
        Box([-1.0, -1.0], [1.0, 1.0]), gains=np.zeros((2, 2, 2, 1)), cost="peak", certificate=said, system=plant
    )
    for channel, piece in ((0, 0), (1, 0), (0, 1), (1, 1)):
        for sign in (1.0, -1.0):
            row = bounds._derive_control_row(two, "peak", sign * np.eye(2)[channel], float(piece), None)
            assert row.charged == (piece, channel)
    for other in ([1.0, 1.0], [0.5, 0.0]):
        with pytest.raises(Broken, match="not that of a peak"):
            bounds._derive_control_row(two, "peak", np.array(other), 0.0, None)


def test_a_control_is_as_large_as_its_answers_make_it():
    assert "2 pieces" in claims._verify_control(case_of(0.325 / (1 + NOTHING)))
    for size in (0.325 / (1 + TOO_MUCH), 0.31):
        with pytest.raises(Broken, match="from t = 1"):
            claims._verify_control(case_of(size))
    with pytest.raises(Broken, match="from t = 0"):
        claims._verify_control(case_of(0.35, gains=gains_of(m11=0.0), certificate={"decision": [[0.4, 0.0]]}))
    # one side only, and a set that is curved where it is larger than a segment
    assert claims._verify_control(case_of(Box([-0.325], [9.0])))
    with pytest.raises(Broken):
        claims._verify_control(case_of(Box([-9.0], [0.299])))


def test_a_control_in_a_curved_set_is_as_large_as_its_answers_make_it():
    """``u_1`` is between -0.325 and -0.075; of a segment around 0.1 it is the lower end that counts."""
    for radius, kept in ((0.425 / (1 + NOTHING), True), (0.425 / (1 + TOO_MUCH), False), (0.3, False)):
        judged = case_of(NormBall(p=2.0, radius=radius, centre=[0.1]))
        if kept:
            assert "2 pieces in their set" in claims._verify_control(judged)
        else:
            with pytest.raises(Broken):
                claims._verify_control(judged)
    for radius, kept in ((0.3 * (1 + 1e-8), True), (0.3 * (1 - 1e-8), False)):  # u_0 is 0.3, whatever happens
        judged = case_of(Ellipsoid([0.0], [[radius**2]]), gains=gains_of(m11=0.0))
        if kept:
            assert claims._verify_control(judged)
        else:
            with pytest.raises(Broken):
                claims._verify_control(judged)


def test_a_control_in_an_ellipse_is_as_far_along_every_direction_as_its_answers_take_it():
    for radius, kept in ((0.425 / (1 + NOTHING), True), (0.425 / (1 + TOO_MUCH), False), (0.3, False)):
        judged = case_of(Ellipsoid([0.1], [[radius**2]]))
        if kept:
            assert "2 pieces in their set" in claims._verify_control(judged)
        else:
            with pytest.raises(Broken):
                claims._verify_control(judged)


def test_across_the_seam_the_controls_of_two_periods_answer_apart():
    """``u = (0.3, -0.2) - e / 2`` with ``|e| <= 0.2``, one of each period: from one to the next at most 0.7."""
    answers = feedback_of(case_of(gains=gains_of(m00=-0.5, m10=-0.5), initial_set=box(0.2), disturbance=None))
    (within,) = answers.heights(answers.changes(1), exactly(np.ones((1, 1))))
    (across,) = answers.heights(answers.changes(2), exactly(np.ones((1, 1))))
    assert float(within.mid()) == pytest.approx(-0.5)
    assert float(across.mid()) == pytest.approx(0.5 + 2 * 0.5 * 0.2)


def test_a_step_is_as_large_as_the_answers_of_both_pieces_make_it():
    """``u_1 - u_0 = -0.5 - w_0 / 2``."""
    for size, kept in ((0.625 / (1 + NOTHING), True), (0.625 / (1 + TOO_MUCH), False), (0.55, False)):
        judged = case_of(control_step=box(size))
        if kept:
            assert "steps in their set" in claims._verify_steps(judged)
        else:
            with pytest.raises(Broken, match="t = 1"):
                claims._verify_steps(judged)
    assert float(feedback_of(case_of(control_step=box(1.0))).changes(1)[0][0, 1].mid()) == pytest.approx(-0.5)
    assert feedback_of(case_of(control_step=box(1.0))).changes(1)[0][0, 0].mid() == pytest.approx(-0.5)


def test_the_costs_of_a_policy_are_by_hand():
    assert float(feedback_of(case_of(cost="nominal")).cost().mid()) == pytest.approx(0.5)
    assert float(feedback_of(case_of(cost="peak")).cost().mid()) == pytest.approx(0.3 + 0.325)
    assert float(feedback_of(case_of(cost="peak", weights=[2.0])).cost().mid()) == pytest.approx(2 * 0.625)
    peaks = case_of(cost="peak")
    ends = replace(peaks.problem, cost=sr.Cost(final={"Q": [[2.0]]}))  # at 0.6, nominally
    assert float(feedback_of(replace(peaks, problem=ends)).cost().mid()) == pytest.approx(0.625 + 2 * 0.36)
    assert float(feedback_of(case_of(cost="worst", certificate={"cost": 0.625 + 1e-10})).cost().mid()) == pytest.approx(
        0.625
    )
    for short in (1e-9, 0.125):
        with pytest.raises(Broken):
            feedback_of(case_of(cost="worst", certificate={"cost": 0.625 - short})).cost()


def test_answers_to_what_is_not_measured_or_is_forgotten_are_refused():
    for wrong in (gains_of(m01=0.1), gains_of(m00=0.1), gains_of(m10=1e-300)):
        with pytest.raises(Broken, match="not measured"):
            feedback_of(case_of(gains=wrong)).gains  # noqa: B018
    with pytest.raises(Broken, match="shape"):
        feedback_of(case_of(gains=gains_of(3))).gains  # noqa: B018
    begun = case_of(gains=gains_of(m10=-0.5), initial_set=box(0.1))
    assert (feedback_of(begun).gains == gains_of(m10=-0.5)).all()
    for memory, kept in ((1.0, True), (1.0 - 1e-9, False)):
        judged = case_of(gains=gains_of(m10=-0.5), initial_set=box(0.1), policy=AffinePolicy(memory=memory))
        if kept:
            assert feedback_of(judged).gains.any()
        else:
            with pytest.raises(Broken, match="measured at 0, which its policy does not"):
                feedback_of(judged).gains  # noqa: B018


def test_a_state_is_as_far_as_its_worst_disturbance_takes_it():
    """The largest ``x`` is 1.05, at 1; ``x(2)`` is 0.975 at most."""
    for size, kept in ((1.05 / (1 + NOTHING), True), (1.05 / (1 + TOO_MUCH), False), (1.0, False)):
        judged = case_of(wall=box(size))
        window = judged.windows[0]
        if kept:
            assert "kept" in constraints.bounded(judged, window)
        else:
            with pytest.raises(Broken, match="t = 1"):
                constraints.bounded(judged, window)
    for size, kept in ((0.975 / (1 + NOTHING), True), (0.975 / (1 + TOO_MUCH), False)):
        judged = case_of(terminal=[box(size)])
        window = judged.windows[0]
        if kept:
            assert constraints.bounded(judged, window)
        else:
            with pytest.raises(Broken, match="t = 2"):
                constraints.bounded(judged, window)


@pytest.mark.parametrize(
    ("proof", "match"),
    [
        ({"path": {**WALL, "tolerance": 1e-8}}, "count as none"),
        ({"path": {**WALL, "tolerance": 0.0}}, "count as none"),
        ({"path": {**WALL, "upper": [[1.5]]}}, None),
        ({"path": {**WALL, "lower": [[0.1]]}}, None),
        ({}, "no proof"),
        ("nothing", "no proof"),
    ],
)
def test_a_proof_that_leaves_something_out_is_none(proof, match):
    judged = case_of(wall=box(9.0), certificate={"proof": proof})
    with pytest.raises(Broken, match=match):
        constraints.bounded(judged, judged.windows[0])
    undecided = case_of(wall=box(9.0), certificate={"proof": {}, "status": "undecided"})
    with pytest.raises(Unchecked):
        constraints.bounded(undecided, undecided.windows[0])


def test_a_curved_wall_is_kept_and_left_like_the_segment_that_it_is():
    for square, kept in ((1.06**2, True), (1.04**2, False)):
        faces = [[0.0, -1.0], [0.0, 1.0]], [[2.0, -1.0], [2.0, 1.0]]
        proof = {"path": {"tolerance": 1e-9, "lower": faces[0], "upper": faces[1]}}
        judged = case_of(wall=Ellipsoid([0.0], [[square]]), certificate={"proof": proof})
        if kept:
            assert "cells" in constraints.bounded(judged, judged.windows[0])
        else:
            with pytest.raises(Broken):
                constraints.bounded(judged, judged.windows[0])


def test_what_the_worst_disturbance_exceeds_is_told_row_by_row():
    judged = case_of(0.3, wall=box(1.0), control_step=box(0.6))
    said = {"violation": 0.0}
    over, close = replay.exceeded(judged, {"constraint": "path", "time": 1.0, **said})
    assert over == pytest.approx([0.05, -1.55] if len(over) == 2 else [0.05, -1.55] * 2)
    assert close == pytest.approx(1e-9, rel=1e-6)
    assert replay.exceeded(judged, {"constraint": "path", "time": 0.5, **said})[0][:2] == pytest.approx(
        [-0.225, -1.525]
    )
    assert replay.exceeded(judged, {"constraint": "path", "time": 2.0, **said})[0][:2] == pytest.approx(
        [-0.025, -1.225]
    )
    over, close = replay.exceeded(judged, {"constraint": "control", "time": 1.0, **said})
    assert over == pytest.approx([-0.375, 0.025])
    assert close == pytest.approx(1e-9 * 0.3)
    assert replay.exceeded(judged, {"constraint": "control", "time": 0.99, **said})[0] == pytest.approx([0.0, -0.6])
    over, close = replay.exceeded(judged, {"constraint": "control_step", "time": 1.0, **said})
    assert over == pytest.approx([-0.975, 0.025])
    assert close == pytest.approx(1e-9 * 0.6)
    for name, time in (("control_step", 0.5), ("control_step", 2.0), ("path", 2.1), ("path", -0.1), ("nobody", 1.0)):
        with pytest.raises(Broken):
            replay.exceeded(judged, {"constraint": name, "time": time, **said})


def test_a_witness_is_driven_by_its_own_disturbance():
    judged = case_of(0.3, wall=box(1.0), control_step=box(0.6))
    data = {"constraint": "path", "time": 2.0, "direction": [1.0], "disturbance": [[0.25, -0.2]], "violation": 0.0}
    over, slack = replay.witnessed(judged, data)
    assert float(over.mid()) == pytest.approx(0.6 + 0.125 - 0.2 - 1.0)
    assert slack == pytest.approx(1e-9, rel=1e-6)
    assert float(replay.witnessed(judged, {**data, "time": 1.0, "direction": [-1.0]})[0].mid()) == pytest.approx(
        -1.05 - 1.0
    )
    over, slack = replay.witnessed(judged, {**data, "constraint": "control", "time": 1.0, "direction": [-1.0]})
    assert (float(over.mid()), slack) == (pytest.approx(0.325 - 0.3), pytest.approx(3e-10))
    over, slack = replay.witnessed(judged, {**data, "constraint": "control_step", "time": 1.0, "direction": [-1.0]})
    assert (float(over.mid()), slack) == (pytest.approx(0.625 - 0.6), pytest.approx(6e-10))
    for wrong in (
        {"disturbance": [[0.25 + 1e-15, 0.0]]},
        {"disturbance": [[0.25]]},
        {"direction": [1.0, 0.0]},
        {"direction": [2.0, 0.0], "constraint": "control"},
        {"time": 2.0 + 1e-12},
        {"constraint": "nobody"},
    ):
        with pytest.raises(Broken):
            replay.witnessed(judged, {**data, **wrong})
    with pytest.raises(Unchecked):
        replay.witnessed(judged, {**data, "disturbance": None})


def test_fixed_states_are_met_where_every_deviation_is_answered():
    """``x(2) = 0.6 + (1 + 2 g) delta`` with the gain ``g`` on both pieces: 0.6 for ``g = -1/2`` only."""
    plant = LinearSystem(np.zeros((1, 1)), np.ones((1, 1)))
    for g, goal, met in (
        (-0.5, 0.6, True),
        (-0.5, 0.6 + 1e-7, False),
        (-0.5, 0.6 - 1e-7, False),
        (-0.49, 0.6, False),
        (-0.51, 0.6, False),
    ):
        judged = case_of(
            gains=gains_of(m00=g, m10=g),
            system=plant,
            disturbance=None,
            initial_set=box(0.2),
            terminal=[Equality([goal])],
        )
        if met:
            assert "kept" in constraints.equalities(judged)
        else:
            with pytest.raises(Broken, match="x1 is missed"):
                constraints.equalities(judged)
        missed = abs(0.6 - goal) + abs(1 + 2 * g) * 0.2
        over, close = replay.exceeded(judged, {"constraint": "equals", "time": 2.0, "violation": 0.0})
        assert over == pytest.approx([missed], abs=1e-15)
        assert 2.5e-9 <= close <= 1e-8  # at least the start 0.5 and what the control can add, 2, are added up


def row(w, y, **more):
    return {
        "constraint": "terminal", "time": 2.0, "direction": [1.0], "disturbance": [list(w)], "multiplier": y, **more
    }  # fmt: skip


UP, DOWN = (REACH, REACH), (-REACH, REACH)


def test_multipliers_at_two_disturbances_prove_the_least_nominal_cost():
    """``x(2) <= 0.2`` asks ``v_0 + v_1 <= -0.3 - (1 + g) w_0 - w_1``: 0.55 at least, whatever the gain ``g``."""
    judged = case_of(terminal=[box(0.2)])

    def bound(*rows, priced=True):
        return float(multiplied(judged, rows, priced).mid())

    assert bound(row(UP, 0.5), row(DOWN, 0.5)) == pytest.approx(0.55)
    # what the gains could still lower is taken off: the width of the control 2 for the chord 0.5 of the disturbance
    assert bound(row(UP, 0.6), row(DOWN, 0.4)) == pytest.approx(0.6 - 0.2 * REACH * 2 / 0.5)
    assert bound(row(UP, 1.0)) == pytest.approx(0.8 - REACH * 2 / 0.5)
    # a slope beyond the weight costs how far the control reaches
    assert bound(row(UP, 1.0), row(DOWN, 1.0)) == pytest.approx(1.1 - 2 * 1.0)
    assert bound(row(UP, 0.5), row(DOWN, 0.5), priced=False) == pytest.approx(0.55 - 2.0)
    assert bound() == 0.0
    for wrong in (
        {"multiplier": 0.0},
        {"multiplier": -1.0},
        {"time": 1.0},
        {"direction": [1.0, 0.0]},
        {"direction": [0.5, 0.1]},
        {"parameter": [0.0]},
        {"constraint": "nobody"},
        {"disturbance": [[0.26, 0.0]]},
    ):
        with pytest.raises(Broken):
            bound(row(UP, 0.5), {**row(DOWN, 0.5), **wrong})
    with pytest.raises(Broken):
        bound("nothing")


def test_multipliers_of_peaks_and_of_the_effort_prove_their_least_costs_too():
    peaks = case_of(terminal=[box(0.2)], cost="peak")

    def peak(w, y, time):
        return row(w, y, constraint="peak", time=time, direction=[-1.0])

    def bound(first):
        rows = [row(UP, 0.5), row(DOWN, 0.5), peak(UP, first, 0.0), peak(UP, 0.5, 1.0), peak(DOWN, 0.5, 1.0)]
        return float(multiplied(peaks, rows, True).mid())

    assert bound(1.0) == pytest.approx(0.55)
    assert bound(0.9) == pytest.approx(0.55 - 0.1)
    assert bound(1.1) == pytest.approx(0.55 - 0.1 - 0.1)
    for wrong in ([1.0, 0.0], [0.5], [0.0]):
        with pytest.raises(Broken):
            multiplied(peaks, [{**peak(UP, 1.0, 0.0), "direction": wrong}], True)

    effort = case_of(terminal=[box(0.2)], cost="worst")

    def of_effort(w, y, shares):
        return row(w, y, constraint="effort", time=0.0, direction=shares)

    def least(y, share=-1.0):
        shares = [share, -1.0]
        rows = [row(UP, 0.5), row(DOWN, 0.5), of_effort(UP, y / 2, shares), of_effort(DOWN, y / 2, shares)]
        return float(multiplied(effort, rows, True).mid())

    assert least(1.0) == pytest.approx(0.55)
    assert least(0.9) == pytest.approx(0.55 - 2 * 0.1)
    assert least(1.1) == pytest.approx(0.55 - 2 * 0.1 - 0.1 * 2)
    assert least(1.0, -0.5) == pytest.approx(0.55 - 0.5)
    for wrong in ([-1.0], [-1.0 - 1e-15, 0.0], [1.0, 1.0, 1.0]):
        with pytest.raises(Broken):
            multiplied(effort, [of_effort(UP, 1.0, wrong)], True)


def test_multipliers_of_the_control_and_of_its_steps_are_rows_too():
    """A control of at most 0.1 a piece cannot bring down what asks for 0.55: the sum of rows is above 0."""
    judged = case_of(0.1, terminal=[box(0.2)])
    rows = [
        row(UP, 0.5),
        row(DOWN, 0.5),
        *(row(w, 0.5, constraint="control", time=t, direction=[-1.0]) for w in (UP, DOWN) for t in (0.0, 1.0)),
    ]
    assert float(multiplied(judged, rows, False).mid()) == pytest.approx(0.55 - 0.2)
    with pytest.raises(Broken):
        multiplied(judged, [row(UP, 0.5, constraint="control", time=0.0, direction=[-1.0, 0.0])], False)
    stepped = case_of(terminal=[box(0.2)], control_step=box(0.1), certificate={})
    # u_1 - u_0 <= 0.1 with the weight 1/2: slopes become 1 - 1/2 and 1 + 1/2
    steps = [row(w, 0.25, constraint="control_step", time=1.0, direction=[1.0]) for w in (UP, DOWN)]
    proven = float(multiplied(stepped, [row(UP, 0.5), row(DOWN, 0.5), *steps], True).mid())
    assert proven == pytest.approx(0.55 - 0.5 * 0.1 - 0.5 * 1.0)
    with pytest.raises(Broken):
        multiplied(stepped, [{**steps[0], "direction": [1.0, 0.0]}], True)


@pytest.mark.parametrize(
    ("shape", "chords"),
    [
        (Box([-1.0, 0.0], [2.0, 0.5]), [3.0, 0.5]),
        (NormBall(3.0, 0.7, centre=[1.0, 2.0]), [1.4, 1.4]),
        (NormBall(1.0, 0.7, centre=[1.0, 2.0]), [1.4, 1.4]),
        (Ellipsoid([0.0, 1.0], [[4.0, 1.0], [1.0, 0.5]]), [2 * np.sqrt(4.0 - 1 / 0.5), 2 * np.sqrt(0.5 - 1 / 4.0)]),
        (sr.Polytope(np.array([[2.0, 1.0], [-1.0, 0.0], [0.0, -1.0]]), np.array([2.0, 0.0, 0.0])), None),
        (Product((NormBall(2.0, 0.7, dimension=2), box(0.3))), [1.4, 1.4, 0.6]),
    ],
)
def test_chords_are_how_long_a_set_is_through_its_middle(shape, chords):
    middle = shape.interior_point()
    if chords is None:  # the triangle (0, 0), (1, 0), (0, 2)
        x, y = middle
        chords = [1.0 - y / 2, 2.0 - 2 * x]
    assert [float(c.mid()) for _, c in known(shape).spans(middle)] == pytest.approx(chords)


def test_a_policy_is_refused_where_the_checker_does_not_know_the_system():
    judged = case_of()
    bound = Product([Box([-0.1], [0.1]), Box([-0.1], [0.1])])
    both = {"system": LinearSystem(np.zeros((1, 1)), np.ones((1, 1)), E=np.ones((1, 2))), "disturbance": bound}
    for more in (
        {"disturbance_class": "measurable"},
        {**both, "disturbance_class": ("measurable", "piecewise_constant")},
    ):
        with pytest.raises(Unchecked, match="on the pieces of one dictionary"):
            VerifiedFeedback(replace(judged, problem=replace(judged.problem, **more))).loop  # noqa: B018
    one = LinearSystem(lambda p: p[0] * np.ones((1, 1)), np.ones((1, 1)), E=np.ones((1, 1)), parameters=box(0.1))
    with pytest.raises(Unchecked, match="known systems only"):
        VerifiedFeedback(replace(judged, problem=replace(judged.problem, system=one))).loop  # noqa: B018


def test_how_far_and_how_wide_a_set_is_along_a_channel():
    for shape, wide, ends in (
        (Box([-1.0, 2.0], [3.0, 5.0]), (4.0, 3.0), ((-1.0, 3.0), (2.0, 5.0))),
        (Box([-3.0, -5.0], [1.0, -2.0]), (4.0, 3.0), ((-3.0, 1.0), (-5.0, -2.0))),
        (NormBall(p=2.0, radius=2.0, centre=[0.5, -1.0]), (4.0, 4.0), ((-1.5, 2.5), (-3.0, 1.0))),
    ):
        assert [float(width(known(shape), c).mid()) for c in (0, 1)] == pytest.approx(wide)
        for channel, expected in enumerate(ends):
            assert [float(end) for end in find_range(known(shape), channel)] == pytest.approx(expected)


def test_a_direction_of_a_fixed_state_is_that_state_alone_at_the_end():
    case = case_of(terminal=[Equality([0.6])])
    assert [float(bounds.fixed_limit(case, np.array([c]), 2.0).mid()) for c in (1.0, -2.0)] == [0.6, -1.2]
    for direction, time in (([0.0], 2.0), ([1.0], 1.9), ([1.0], 0.0)):
        with pytest.raises(Broken, match="fixed final state"):
            bounds.fixed_limit(case, np.array(direction), time)


def test_the_effort_is_looked_for_where_deviations_go(monkeypatch):
    """How far every entry goes, from the middle of its set, is handed on."""
    told = []
    monkeypatch.setattr(
        "sparserob_core.checker.claims.answers.prove_effort_limit", lambda *given: told.append(given) or 1
    )
    feedback_of(case_of(cost="worst", disturbance=Box([-0.1], [0.3])))._verify_effort(arb(9.0))
    a, A, _, reach, limit, _ = told[0]
    assert reach == pytest.approx([0.2, 0.2]) and float(limit) == 9.0
    assert [float(x.mid()) for x in a] == pytest.approx([0.3, -0.2])
    assert [[float(x.mid()) for x in row] for row in A] == [pytest.approx([0.0, 0.0]), pytest.approx([-0.5, 0.0])]


def test_an_effort_is_bounded_where_its_parts_are_not_largest_together():
    """``|z_1 + z_2| + |z_1 - z_2|`` is twice the larger of both, and half of what its parts can be each."""
    gains = np.zeros((3, 3, 2, 1))
    gains[2, 1], gains[2, 2] = [[1.0], [1.0]], [[1.0], [-1.0]]
    two = {
        "system": LinearSystem(np.zeros((1, 1)), np.ones((1, 2)), E=np.ones((1, 1))),
        "control": Box([-9.0] * 2, [9.0] * 2),
    }
    said = {"decision": np.zeros((2, 3)).tolist(), "gains": gains.tolist()}
    judged = case_of(pieces=3, gains=gains, cost="worst", certificate=said, **two)
    most = (2.0 / 3.0) * 2.0 * (2.0 / 3.0) * REACH
    feedback_of(judged)._verify_effort(arb(most * (1.0 + 1e-9)))
    with pytest.raises((Broken, Unchecked)):
        feedback_of(judged)._verify_effort(arb(most * (1.0 - 1e-6)))


def test_innovations_of_a_flat_set_are_those_of_differences_of_its_points():
    """Its middle was rounded out of it: what no gain has a bound across is no part of what is seen."""
    line, normal = np.array([0.3, 0.7]), np.array([0.7, -0.3])
    H = np.array([normal, -normal, line, -line])
    flat = Polytope(H, np.array([0.1, -0.1, 0.9, -0.2]))
    plane = {
        "system": LinearSystem(np.zeros((2, 2)), np.ones((2, 1)), E=np.eye(2)), "initial_state": [0.5, 0.0],
        "gains": np.zeros((2, 2, 1, 2)), "disturbance": flat,
    }  # fmt: skip
    case = case_of(**plane)
    loop, (shape, about) = feedback_of(case).loop_at_rest, feedback_of(case).loop_at_rest.deviations.sets[0]
    named = feedback_of(case).named({"disturbance": np.tile(flat.support_point(line), (2, 1)).T.tolist()}, "row")
    exact = [arb(fmpq(*float(v).as_integer_ratio())) for v in normal]
    with ctx.workprec(96):
        limit = arb(0.1)
        for point in (
            [arb(float(m)) + r for m, r in zip(about, loop.deviations.rests[0], strict=True)],
            [arb(float(m)) + z for m, z in zip(about, named.z[0], strict=True)],
        ):
            assert float(abs(sum(a * x for a, x in zip(exact, point, strict=True)) - limit).upper()) < 1e-26
        assert known(shape).member(about) is not None and not known(shape).holds(balls(about))
        seen = replace(named, z=named.answered).entering[
            1
        ]  # a piece of length 1 after which the state is what the disturbance was
        assert [float(x.mid()) for x in seen] == pytest.approx(flat.support_point(line) - about)
        assert float(abs(sum(a * x for a, x in zip(exact, seen, strict=True))).upper()) < 1e-26
        calm = feedback_of(case).following(named, {}, "row")
        assert all(x.is_zero() for block in calm.answered for x in block)


def test_chords_of_a_thin_set_are_those_of_its_segments_and_else_along_the_axes():
    line = np.array([0.3, 0.7])
    ((vector, length),) = known(sr.Zonotope(np.zeros(2), line[None])).spans(np.zeros(2))
    assert [float(v) for v in vector] == line.tolist() and float(length.mid()) == 2.0
    every = known(Box([-1.0, 0.0], [1.0, 0.0])).spans(np.zeros(2))
    assert [([float(v) for v in vector], float(length.mid())) for vector, length in every] == [([1.0, 0.0], 2.0)]
    both = known(Product((sr.Zonotope(np.zeros(2), line[None]), Box([-1.0], [2.0])))).spans(np.zeros(3))
    assert [[float(v) for v in vector] for vector, _ in both] == [[0.3, 0.7, 0.0], [0.0, 0.0, 1.0]]
    assert known(NormBall(2.0, 0.0, [0.0, 0.0])).spans(np.zeros(2)) == []
    H = np.array([[1.0, 1.0, 1.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
    plate = Polytope(
        np.vstack([H, -H]), np.array([1e-10, 1.0, 1.0] * 2)
    )  # next to a plane, of which no corner is known
    with pytest.raises(Unchecked, match="how long the polytope is along the axes"):
        known(plate).spans(np.zeros(3))
