"""Guards control/loop/retuning: with gains that stay, a nominal control chosen anew is as good as it can be, and holds
against every future disturbance."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.linalg import expm
from scipy.optimize import linprog

import sparserob_core as sr
from sparserob_core.control.loop.retuning import Retuning
from tests.control.loop.test_controller import EXACT, GAINS, PEAK, Plant, drives

KINDS = {"nominal": GAINS, "peak": PEAK}
LENGTH, PIECES, FINE = 0.25, 12, 8


@pytest.fixture(scope="module", params=["nominal", "peak"])
def outcome(request, tmp_path_factory) -> sr.Outcome:
    out = tmp_path_factory.mktemp("runs") / "run"
    return sr.run(KINDS[request.param], out=out, quiet=True, figures=False)


def tuning(outcome: sr.Outcome) -> sr.Controller:
    """A controller that has time for the nominal control, and none for a whole program."""
    controller = sr.controller(outcome, True, seconds=1e6)
    controller._resolver._solve_seconds = np.inf
    return controller


def responses(outcome, first):
    """Of the spring, from the beginning of piece ``first``, at times within its pieces: the times, the flow, what the
    nominal control adds, and what every future disturbance adds under the gains, by the recursion of the loop itself:
    innovations seen, controls that answer them."""
    stored = np.load(outcome.directory / "solution.npz")
    gains, system = stored["gains"], outcome.problem.system
    A, B, E = (np.asarray(one, dtype=float) for one in (system.phases[0].A, system.phases[0].B, system.phases[0].E))
    part = LENGTH / FINE
    block = expm(np.block([[A, np.eye(2)], [np.zeros((2, 4))]]) * part)
    Phi, Gamma = block[:2, :2], block[:2, 2:]
    whole = expm(np.block([[A, np.eye(2)], [np.zeros((2, 4))]]) * LENGTH)[:2, 2:]
    left = PIECES - first
    count = 2 * left
    state = np.zeros((2, 2 + left + count))  # columns: the state, the nominal control, the future disturbances
    state[:, :2] = np.eye(2)
    times, found, effects, innovations = [], [], np.zeros((left, count)), np.zeros((left + 1, 2, count))
    for k in range(left):
        for j in range(1, k + 1):
            effects[k] += (gains[first + k, first + j] @ innovations[j])[0]
        drive = np.zeros_like(state)
        drive[:, 2 + k] = B[:, 0]
        drive[:, 2 + left :] += B @ effects[k][None]
        drive[:, 2 + left + 2 * k : 2 + left + 2 * k + 2] += E
        innovations[k + 1][:, 2 * k : 2 * k + 2] = whole @ E
        for step in range(FINE):
            state = Phi @ state + Gamma @ drive
            times.append((first + k) * LENGTH + (step + 1) * part)
            found.append(state)
    return np.array(times), np.array(found), effects


def rows(outcome, first):
    """``G v <= h - F x`` at those times, for every future disturbance; and the bounds of the nominal control."""
    times, states, effects = responses(outcome, first)
    left, radius = PIECES - first, 0.06
    pushed = radius * np.abs(states[:, :, 2 + left :]).sum(axis=2)
    kept, sides = [], np.array([0.3, 0.6])
    for t, at, push in zip(times, states, pushed, strict=True):
        for sign in (1.0, -1.0):
            if t >= 0.5:
                kept.append((sign * at[0, 2 : 2 + left], 0.7 - push[0], sign * at[0, :2]))
            if t > 3.0 - 1e-9:
                kept += [(sign * at[i, 2 : 2 + left], sides[i] - push[i], sign * at[i, :2]) for i in range(2)]
    G, h, F = (np.array(one) for one in zip(*kept, strict=True))
    return G, h, F, 1.0 - radius * np.abs(effects).sum(axis=1)


@pytest.mark.first(4)
@pytest.mark.parametrize("first", [0, 3, 7, 11])
def test_it_finds_and_proves_the_best_nominal_control_for_the_gains(outcome, first) -> None:
    controller, rng = sr.controller(outcome), np.random.default_rng(first)
    retuning, state = Retuning(controller.plan.model, controller.plan.decision), np.array([-1.0, 1.0])
    plant = Plant(outcome)
    for k in range(first):
        u = controller.step(k * LENGTH, state)
        state = plant.moved(state, u, 0.06 * rng.uniform(-1, 1, 2), LENGTH)[-1]
    found = retuning.solve(first, state)
    G, h, F, room = rows(outcome, first)
    free = h - F @ state
    assert (G @ found.decision - free).max() <= EXACT
    assert (np.abs(found.decision) - room).max() <= EXACT
    left = room.size
    best = linprog(
        np.full(2 * left, LENGTH), np.hstack([G, -G]), free, bounds=[(0.0, float(r)) for r in [*room, *room]]
    )
    assert best.status == 0
    assert found.cost >= best.fun - 1e-8  # of fewer times
    assert found.cost <= best.fun + 5e-3 * max(1.0, best.fun)
    assert found.lower <= found.cost <= found.lower + 1e-6


@pytest.mark.first(1)
def test_no_loop_violates_a_constraint_when_nominal_controls_are_chosen_anew(outcome) -> None:
    plant, controller, taken = Plant(outcome), tuning(outcome), 0
    for drive in drives(outcome, np.random.default_rng(5)):
        worst, _ = plant.loop(controller, drive)
        assert worst <= EXACT
        assert controller.covered
        taken += sum(one.resolved for one in controller.steps)
    assert taken > 0


def test_the_same_loop_costs_less_than_the_plan_applied(outcome) -> None:
    plant, paid = Plant(outcome), []
    for controller in (sr.controller(outcome), tuning(outcome)):
        rng = np.random.default_rng(6)
        loops = [plant.loop(controller, lambda k, x, c, rng=rng: 0.06 * rng.uniform(-1, 1, 2))[1] for _ in range(5)]
        paid.append(LENGTH * sum(float(np.abs(one).sum()) for one in loops))
    assert paid[1] < paid[0]


@pytest.mark.slow
def test_gains_that_were_chosen_for_an_ellipsoid_are_left_to_the_whole_program() -> None:
    round_set = {"ellipsoid": {"shape": [[1e-3, 0], [0, 1e-3]]}}
    ellipsoid = {**GAINS, "problem": {**GAINS["problem"], "disturbance": round_set}}
    plan = sr.controller({**ellipsoid, "dictionaries": {"control": {"name": "piecewise_constant", "pieces": 6}}}).plan
    assert Retuning(plan.model, plan.decision).solve(0, np.array([-1.0, 1.0])) is None
