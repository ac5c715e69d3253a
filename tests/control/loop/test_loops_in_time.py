"""Guards control/loop where the system changes with time: what is left, plans that are applied, and solved anew."""

from __future__ import annotations

import copy
from typing import Any

import numpy as np
import pytest

import sparserob_core as sr

CONFIG: dict[str, Any] = {
    "problem": {
        "name": "linear",
        "system": {"A": [[0, 1], [-1, -0.4]], "B": [[0], [1]], "E": [[0], [1]], "c": [0, 0.05]},
        "horizon": 3.0,
        "initial_state": [-0.5, 0.5],
        "control": {"box": 1.0},
        "disturbance": {"box": [0.05]},
        "path": [{"box": [0.6, None], "from": 0.2}],
        "terminal": [{"box": [0.25, 0.25]}],
    },
    "dictionaries": {"control": {"name": "piecewise_constant", "pieces": 6}},
    "observers": [],
}


def config(**system: Any) -> dict[str, Any]:
    made = copy.deepcopy(CONFIG)
    made["problem"]["system"].update(system)
    return made


def test_what_is_left_of_laws_that_take_turns_is_what_they_are_later() -> None:
    turns = [(1.0, ([["sin(t)"]], [["t"]], None, ["1"])), (3.0, ([["cos(t)"]], [["2"]], None, ["t^2"]))]
    system = sr.VaryingSystem.taking_turns(turns)
    for begin, laws in ((0.4, 2), (1.0, 1), (2.0, 1)):
        left = system.remaining(begin, 3.0 - begin)
        assert left.horizon == 3.0 - begin and len(left.phases) == laws
        for law in left.phases:
            start, stop = law.begin, law.until
            for time in (start, (start + stop) / 2, stop):
                then = system.phases[0 if begin + time <= 1.0 and laws == 2 and stop < left.horizon else 1]
                both = (law.forced.matrices(np.array([[time]])), then.forced.matrices(np.array([[begin + time]])))
                for ours, theirs in zip(*both, strict=True):
                    np.testing.assert_allclose(ours, theirs, rtol=1e-15)


@pytest.mark.slow
def test_a_controller_goes_through_more_pieces_than_times_at_which_a_system_is_looked_at() -> None:
    made = config(A=[[0, 1], ["-1 + 0*t", -0.4]])
    made["problem"].update(disturbance=None, path=[])
    made["dictionaries"]["control"]["pieces"] = 70
    controller = sr.controller(made)
    for time in controller.breakpoints[:-1]:
        controller.step(time, None)
    assert len(controller.steps) == 70


@pytest.mark.slow
@pytest.mark.parametrize("policy", ["open_loop", "affine"])
def test_loops_that_solve_anew_are_those_of_the_system_that_does_not_change(policy: str) -> None:
    costs, covered = [], []
    for entry in (-1, "-1 + 0*t"):
        made = config(A=[[0, 1], [entry, -0.4]])
        made["policy"] = {"name": policy}
        controller = sr.controller(made, resolve=True)
        state, rng, used = np.array([-0.5, 0.5]), np.random.default_rng(1), 0.0
        for begin, end in zip(controller.breakpoints[:-1], controller.breakpoints[1:], strict=True):
            u, w = controller.step(begin, state), rng.uniform(-0.05, 0.05)
            used += float(np.abs(u).sum() * (end - begin))
            A, drive = np.array([[0, 1], [-1, -0.4]]), np.array([0, u[0] + w + 0.05])
            for _ in range(200):  # the midpoint rule, far below the tolerance of a step
                h = (end - begin) / 200
                state = state + h * (A @ (state + h / 2 * (A @ state + drive)) + drive)
        assert (np.abs(state) <= 0.25).all()
        costs.append(used)
        covered.append([step.covered for step in controller.steps])
        assert any(step.resolved for step in controller.steps)
    assert costs[0] == pytest.approx(costs[1], rel=1e-5)
    assert covered[0] == covered[1] == [True] * 6


@pytest.mark.slow
def test_a_state_that_no_disturbance_leads_to_is_seen_beside_entries_in_the_time() -> None:
    controller = sr.controller(config(A=[[0, 1], ["-1 - 0.1*sin(t)", -0.4]]))
    controller.step(0.0, [-0.5, 0.5])
    assert controller.covered
    controller.step(0.5, [0.3, 0.5])
    assert not controller.covered


@pytest.mark.slow
def test_parameters_beside_the_time_are_those_of_a_system_that_does_not_change_where_a_plan_is_solved_anew() -> None:
    used: list[list[np.ndarray]] = []
    for entry in ("1 + p", "1 + p + 0*t"):
        made = config(B=[[0], [entry]], c=[0, "0.05 + q"], parameters={"p": [-0.02, 0.04], "q": [-0.01, 0.01]})
        controller = sr.controller(made, resolve=True)
        state, rng = np.array([-0.5, 0.5]), np.random.default_rng(2)
        p, q = 0.03, -0.01  # which the controller is not told
        controls = []
        for begin, end in zip(controller.breakpoints[:-1], controller.breakpoints[1:], strict=True):
            u, w = controller.step(begin, state), rng.uniform(-0.05, 0.05)
            controls.append(u)
            A, drive = np.array([[0, 1], [-1, -0.4]]), np.array([0, (1 + p) * u[0] + w + 0.05 + q])
            for _ in range(200):
                h = (end - begin) / 200
                state = state + h * (A @ (state + h / 2 * (A @ state + drive)) + drive)
        assert (np.abs(state) <= 0.25).all()
        assert any(step.resolved for step in controller.steps) and controller.covered
        used.append(controls)
    np.testing.assert_allclose(used[1], used[0], atol=1e-4)


@pytest.mark.slow
def test_integrals_of_controls_go_on_where_parameters_beside_the_time_begin_anew() -> None:
    made = config(B=[[0], ["1 + p*sin(t)"]], parameters={"p": [-0.05, 0.05]})
    made["problem"]["integral"] = [{"G": [[1.0]], "upper": 0.6, "lower": -0.6}]
    controller = sr.controller(made, resolve=True)
    states = controller.plan.known.problem.system.states
    spent = 0.0
    for begin, end in zip(controller.breakpoints[:-1], controller.breakpoints[1:], strict=True):
        # whatever is told, what was spent is known
        u = controller.step(begin, controller._read_measurement([-0.5, 0.5])[:2])
        spent += float(u[0] * (end - begin))
        unseen = controller._read_measurement([-0.5, 0.5])[2:]
        assert unseen.size == states - 2 and unseen[-1] == pytest.approx(spent) and not unseen[:-1].any()
