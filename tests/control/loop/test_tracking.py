"""Guards control/loop/tracking: the quick way from one initial state to the next proves what
the long way proves, and claims no more."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest

import sparserob_core as sr
from sparserob_core.control.loop.tracking import KEPT, MIN_LEVEL, PARTS, Tracking, is_trackable
from sparserob_core.control.problem.dictionary import Dictionary
from sparserob_core.control.transcription.transcribe import from_state, in_own_units, prepare
from sparserob_core.sip.program import TOLERANCE
from sparserob_core.sip.proof.branch_and_bound import prove


def spring(pieces=40, disturbance=None, **more) -> object:
    problem = sr.OptimalControlProblem(
        system=sr.LinearSystem([[0, 1], [-2, -0.5]], [[0], [1]], **more.pop("matrices", {})),
        horizon=4.0,
        initial_state=[-1, 1],
        control=sr.Box([-1], [1]),
        disturbance=disturbance or sr.Box([-0.05, -0.03], [0.05, 0.06]),
        path=[sr.PathConstraint(sr.Box([-0.7, -np.inf], [0.7, np.inf]), 0.5)],
        terminal=[sr.Box([-0.3, -0.4], [0.3, 0.4])],
        **more,
    )
    indicators = Dictionary(np.linspace(0.0, 4.0, pieces + 1), np.eye(pieces))
    return in_own_units(prepare(problem, indicators, indicators))


VARIANTS = {
    "a box": {},
    "an ellipsoid": {"disturbance": sr.Ellipsoid([0.0, 0.0], [[0.003, 0.001], [0.001, 0.002]])},
    "a drift": {"matrices": {"c": [0.05, -0.1]}},
    "weights": {"weights": [3.0]},
}


@pytest.mark.first(1)
@pytest.mark.parametrize("name", VARIANTS)
def test_it_proves_and_finds_what_the_exchange_does(name) -> None:
    own, units = spring(**VARIANTS[name])
    assert is_trackable(own)
    tracking, rng = Tracking(own), np.random.default_rng(0)
    for _ in range(6):
        state = (np.array([-1, 1]) + 0.05 * rng.standard_normal(2)) / units.states
        found, program = tracking.solve(state), from_state(own, state).program
        assert found is not None
        assert all(proof.verdict == "proven" for proof in prove(program, found.decision))
        known = sr.solve(program, "exchange", "piqp", regulariser=None)
        assert known.status == "certified"
        assert found.cost == pytest.approx(program.cost(found.decision), rel=1e-12)
        assert found.lower <= known.upper_bound + 1e-12
        assert known.lower_bound <= found.cost + 1e-12
        assert found.cost - found.lower <= 1e-7 * found.cost


def test_what_it_leaves_open_is_violated_or_not_told() -> None:
    own, units = spring()
    tracking, rng = Tracking(own), np.random.default_rng(1)
    state = np.array([-1, 1]) / units.states
    low, high = own.program.finite.lower, own.program.finite.upper
    best = tracking.solve(state).decision
    for share in (0.0, 1e-9, 1e-7, 1e-4, 0.1):
        x = np.clip(best + share * rng.uniform(-1, 1, best.size), low, high)
        verdicts = [proof.verdict for proof in prove(from_state(own, state).program, x)]
        open_ = tracking._find_unproven_instants(x, *tracking._propagate_uncontrolled(state))
        if open_ == []:
            assert "refuted" not in verdicts
        if verdicts == ["proven", "proven"]:
            assert not open_


def test_new_rows_lie_at_the_peaks_of_what_is_violated() -> None:
    own, units = spring()
    tracking, state = Tracking(own), np.array([-1, 1]) / units.states
    best, moved, seen = tracking.solve(state).decision, from_state(own, state), 0
    for share in (1e-6, 1e-4, 0.1):
        x, finest = (1.0 - share) * best, PARTS**MIN_LEVEL
        open_ = tracking._find_unproven_instants(x, *tracking._propagate_uncontrolled(state))
        assert open_
        for row, piece, level, number in open_:
            if piece == tracking.stop[row] == tracking.start[row]:
                continue  # a time alone
            assert level == MIN_LEVEL
            seen += 1
            begin, end = tracking.start[row] * tracking.length, tracking.stop[row] * tracking.length
            times = np.clip((piece + (number + np.array([-1, 0, 1])) / finest) * tracking.length, begin, end)
            before, here, after = moved.functionals.values(
                x, times, np.tile(tracking.H[row], (3, 1)), np.zeros((3, 0))
            )  # fmt: skip
            assert here > tracking.h[row] + TOLERANCE
            assert here >= max(before, after) - 1e-12
    assert seen


def test_its_bounds_lie_above_the_worst_case_between_the_instants() -> None:
    own, units = spring(pieces=8)
    tracking, rng = Tracking(own), np.random.default_rng(2)
    state = np.array([-1, 1]) / units.states
    x = rng.uniform(-1, 1, 8)
    moved = from_state(own, state)
    nodes = (tracking.nodes @ x).reshape(9, 2) + tracking.powers @ state + tracking.fixed
    drives = x.reshape(1, 8).T @ tracking.B.T + tracking.drift
    heights = nodes @ tracking.H.T + tracking._support_values
    bent = tracking._bound_curvature(nodes[:-1] @ tracking.A.T + drives, tracking.length) + tracking._curvature_bounds
    above = np.maximum(heights[:-1], heights[1:]) + bent * tracking.length**2 / 8
    for piece in range(8):
        times = (piece + np.linspace(0, 1, 41)) * tracking.length
        for row, c in enumerate(tracking.H):
            values = moved.functionals.values(x, times, np.tile(c, (41, 1)), np.zeros((41, 0)))
            assert values.max() <= above[piece, row] + TOLERANCE
            assert values[0] == pytest.approx(heights[piece, row], abs=1e-12)


def test_from_where_nothing_is_feasible_it_says_nothing() -> None:
    own, units = spring()
    tracking = Tracking(own)
    assert tracking.solve(np.array([-9.0, 1.0]) / units.states) is None
    assert tracking.solve(np.array([-1.0, 1.0]) / units.states) is not None


def test_all_rounds_together_have_the_time_of_a_step(monkeypatch: pytest.MonkeyPatch) -> None:
    own, units = spring()
    tracking, asked = Tracking(own), list[float]()
    solve = tracking._program.solve
    monkeypatch.setattr(tracking._program, "solve", lambda seconds: asked.append(seconds) or solve(seconds))
    assert tracking.solve(np.array([-1.0, 1.0]) / units.states, 60.0) is not None
    assert len(asked) > 1 and asked[0] <= 60.0 and all(a > b > 0.0 for a, b in pairwise(asked))


def test_many_states_do_not_let_it_grow() -> None:
    own, units = spring(pieces=12)
    tracking, rng, largest = Tracking(own), np.random.default_rng(3), 0
    for _ in range(60):
        state = (np.array([-1, 1]) + 0.1 * rng.uniform(-1, 1, 2)) / units.states
        found, began = tracking.solve(state), Tracking(own).solve(state)
        assert found is not None and began is not None
        assert found.lower <= began.cost + 1e-12 and began.lower <= found.cost + 1e-12
        largest = max(largest, len(tracking._row_instants))
    assert KEPT < largest < 100
    assert len(tracking._row_instants) == tracking._program.count


def test_without_a_row_that_mattered_it_begins_with_none() -> None:
    tracking = Tracking(spring()[0])
    tracking._impose_rows([(0, piece, 0, 0) for piece in range(1, 40)])
    tracking._drop_idle_rows()
    assert not tracking._row_instants and not tracking._program.count and not tracking._state_rows.size


def test_what_it_does_not_know_it_leaves_to_the_exchange() -> None:
    assert not is_trackable(spring(control_step=sr.Box([-0.2], [0.2]))[0])
    assert not is_trackable(spring(initial_set=sr.Box([-0.1, -0.1], [0.1, 0.1]))[0])
