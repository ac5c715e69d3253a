"""Guards control/feedback/prestabilised: gains of the regulator stabilise, and what they add to the control is bounded
for every control that keeps the constraints; states, rows and rounding errors of a closed loop with them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.linalg import expm, solve_discrete_are
from scipy.optimize import linprog

from sparserob_core.control.feedback.closed_loop import ROUND_OFF, ClosedLoop
from sparserob_core.control.feedback.loop_bounds import LoopBounds
from sparserob_core.control.feedback.loop_rows import LoopRows
from sparserob_core.control.feedback.prestabilised import SampledPlant, StateRows, part_modes
from sparserob_core.control.policies.affine import AffinePolicy
from sparserob_core.control.policies.measurements import Measurements
from sparserob_core.control.problem.dictionary import Dictionary
from sparserob_core.control.problem.problem import OptimalControlProblem
from sparserob_core.control.problem.system import LinearSystem
from sparserob_core.control.transcription.record import Transcription
from sparserob_core.control.transcription.transcribe import from_state, prepare
from sparserob_core.sip.convex_set import Box

PENDULUM = np.array([[0.0, 1.0, 0.0, 0.0], [0.0, -0.2, 2.7, 0.0], [0.0, 0.0, 0.0, 1.0], [0.0, -0.5, 31.0, 0.0]])
INPUT, PUSH = np.array([[0.0], [1.8], [0.0], [4.5]]), 0.1
STEP = 0.1


def sampled(K: int) -> SampledPlant:
    """The plant of a cart and its pendulum, with a push through its input that is constant on every piece."""
    whole = np.zeros((5, 5))
    whole[:4, :4], whole[:4, 4:] = PENDULUM, INPUT
    flow = expm(whole * STEP)
    Phi, Gamma = np.tile(flow[:4, :4], (K, 1, 1)), np.tile(flow[:4, 4:], (K, 1, 1))
    radius = PUSH * np.abs(Gamma[:, :, 0])
    return SampledPlant(Phi, Gamma, -radius, radius)


def test_the_regulator_of_a_long_horizon_begins_as_the_stationary_one() -> None:
    K, rows, controls = 400, np.diag([2.0, 0.0, 5.0, 0.0]), np.array([5.0])
    plant = sampled(K)
    gains = plant.regulator(rows, controls, np.full(K, 1.0 / K))
    Phi, Gamma = plant.Phi[0], plant.Gamma[0]
    P = solve_discrete_are(Phi, Gamma, rows.T @ rows / K, np.eye(1) / 25.0 / K)
    expected = -np.linalg.solve(np.eye(1) / 25.0 / K + Gamma.T @ P @ Gamma, Gamma.T @ P @ Phi)
    assert gains[0] == pytest.approx(expected, rel=1e-6)
    assert np.abs(np.linalg.eigvals(Phi + Gamma @ gains[0])).max() < 0.95 < np.abs(np.linalg.eigvals(Phi)).max()


def test_modes_are_parted() -> None:
    Phi = expm(PENDULUM - np.diag([0.1, 0.0, 0.0, 0.0]))
    W = part_modes(Phi)
    modal = W @ Phi @ np.linalg.inv(W)
    decaying = int((np.abs(np.linalg.eigvals(Phi)) < 1.0).sum())
    assert 0 < decaying < 4
    off = np.abs(modal[:decaying, decaying:]).max(), np.abs(modal[decaying:, :decaying]).max()
    assert max(off) < 1e-9 * np.abs(modal).max()


@pytest.mark.parametrize("kept", ["path", "end"])
@pytest.mark.parametrize("K", [5, 60])
def test_what_the_loop_adds_is_bounded_by_little_more_than_a_program_finds(K: int, kept: str) -> None:
    """The largest ``K_k x_k`` by linear programs over states at nodes, controls and pushes, in which nothing grows. The
    bound is never below it, and over 60 pieces, where the plant grows by 1e14, it is of the same size."""
    plant = sampled(K)
    gains = plant.regulator(np.diag([2.0, 0.0, 5.0, 0.0]), np.array([5.0]), np.full(K, 1.0 / K))
    axes, times = np.eye(4), np.arange(K + 1)
    rows, wall = (axes[[0, 2]], np.array([0.5, 0.2])) if kept == "path" else (axes, np.full(4, 0.3))
    holds = np.ones(K + 1, dtype=bool) if kept == "path" else times == K
    initial = np.full(4, 0.02)
    bound = plant.bound(
        gains, (-initial, initial), (np.array([-5.0]), np.array([5.0])), [StateRows(rows, -wall, wall, holds)]
    )
    largest = max(abs(most_added(plant, gains, k, initial, rows, wall, holds)) for k in {0, 1, K // 2, K - 1})
    assert largest <= bound[0] <= (4.0 if K == 5 else 40.0) * largest


def most_added(
    plant: SampledPlant,
    gains: np.ndarray,
    k: int,
    initial: np.ndarray,
    rows: np.ndarray,
    wall: np.ndarray,
    holds: np.ndarray,
) -> float:
    """The largest ``K_k x_k``: states ``x (K + 1, 4)``, controls ``u (K,)`` and pushes ``w (K,)`` are variables."""
    K = len(gains)
    n = 4 * (K + 1) + 2 * K
    equations, walls, limits = np.zeros((4 * K, n)), [], []
    for j in range(K):
        at = slice(4 * j, 4 * j + 4)
        equations[at, 4 * j : 4 * j + 4], equations[at, 4 * j + 4 : 4 * j + 8] = plant.Phi[j], -np.eye(4)
        equations[at, 4 * (K + 1) + j] = equations[at, 4 * (K + 1) + K + j] = plant.Gamma[j, :, 0]
    for j in np.flatnonzero(holds).tolist():
        row = np.zeros((len(rows), n))
        row[:, 4 * j : 4 * j + 4] = rows
        walls += [row, -row]
        limits += [wall, wall]
    cost = np.zeros(n)
    cost[4 * k : 4 * k + 4] = -gains[k, 0]
    bounds = [(-r, r) for r in initial] + [(None, None)] * (4 * K) + [(-5.0, 5.0)] * K + [(-PUSH, PUSH)] * K
    found = linprog(cost, np.vstack(walls), np.concatenate(limits), equations, np.zeros(4 * K), bounds)
    assert found.status == 0
    return float(-found.fun)


SENSED = Measurements([[1.0, 0.0]], Box([-0.02], [0.03]), latency=0.5)  # of pieces of 0.4: known two pieces later


def looped(measured: Measurements | None = None) -> tuple[ClosedLoop, np.ndarray]:
    """The loop of a pendulum whose disturbance changes within pieces of the control, and a random decision."""
    model = _prepared(measured)
    assert model.feedback is not None and model.feedback.loop.inner.acts
    return model.feedback.loop, np.random.default_rng(3).normal(size=model.program.n)


def _prepared(measured: Measurements | None) -> Transcription:
    problem = OptimalControlProblem(
        system=LinearSystem([[0.0, 1.0], [9.0, 0.0]], [[0.0], [1.0]], [[0.0], [1.0]]),
        horizon=2.0,
        initial_state=np.array([0.1, 0.0]),
        control=Box([-8.0], [8.0]),
        disturbance=Box([-0.3], [0.3]),
        path=[Box([-0.5, -np.inf], [0.5, np.inf])],
        measurements=measured,
    )
    control, pushes = (Dictionary.indicators(np.linspace(0.0, 2.0, count)) for count in (6, 8))
    return prepare(problem, control, pushes, policy=AffinePolicy(cost="peak", prestabilise="auto"))


def test_rounding_of_every_step_is_amplified_as_the_loop_amplifies_it() -> None:
    """What an error of the state after a piece makes of the last state, by a force that causes this error alone."""
    loop, x = looped()
    response, grid = loop.functionals.response, loop.grid
    propagator, d = response.propagator, 2
    steps, which = propagator.steps(np.zeros((1, 0))), propagator.which
    sizes, drives, errors, in_drives = loop.bound_rounding_errors(x)
    expected = np.zeros(d)
    for piece in range(grid.pieces):
        Phi, Gamma = steps.Phi[0, which[piece]], steps.Gamma[0, which[piece]]
        error = ROUND_OFF * (np.abs(Phi) @ sizes[piece] + np.abs(Gamma) @ drives[piece])
        forces = np.zeros((d, grid.pieces, d))
        forces[:, piece] = np.linalg.inv(Gamma).T
        expected += np.abs(loop.inner.states(propagator, np.zeros((d, d)), forces)[:, -1].T) @ error
    assert errors[-1] == pytest.approx(expected, rel=1e-6, abs=0.0)
    begins = errors[loop.firsts[grid.control_piece]]
    assert in_drives[:, 1] == pytest.approx(
        (np.abs(loop.inner.gains[grid.control_piece]) @ begins[:, :, None])[:, 0, 0]
    )
    assert (in_drives[loop.firsts[1:], 1] > 0.0).all()


def test_states_and_controls_of_the_loop_are_those_that_it_measures() -> None:
    """Stepped with the state of every breakpoint, for the nominal disturbance and each deviation from it."""
    loop, x = looped()
    nodes, drives = loop.path(x)
    controls, decided = loop.controls(x), loop.decided(x)
    assert controls == pytest.approx(decided + loop.inner.gains @ nodes[loop.firsts], rel=1e-12)
    assert loop.nominal(x) == pytest.approx(controls[:, :, 0].T) and loop.effects(x) == pytest.approx(
        controls[:, :, 1:]
    )
    last, k = loop.states(x, np.array([2.0]))[0], loop.grid.control_piece[-1]
    assert last == pytest.approx(nodes[-1], rel=1e-9) and drives[-1][1, 0] == pytest.approx(controls[k, 0, 0])


def test_a_loop_of_outputs_acts_on_what_is_known_of_the_state() -> None:
    """Stepped by hand: each control comes from predictions that stop at the last measurement that is known by then."""
    loop, x = looped(SENSED)
    assert loop.observer is not None and loop.observer.known.tolist() == [0, 0, 1, 2, 3]
    whole = np.zeros((3, 3))
    whole[:2, :2], whole[1, 2] = [[0.0, 1.0], [9.0, 0.0]], 1.0
    loop_controls, nodes = loop.controls(x), loop.path(x)[0]
    K, M, L, decided = loop.inner.gains, loop.gains(x), loop.observer.L, x[:5]
    step = expm(0.4 * whole)[:2]
    for deviation in 0.02 * np.random.default_rng(6).normal(size=(3, loop.spread.size)):
        z = np.append(1.0, deviation)
        states = nodes[loop.firsts] @ z
        noise = deviation[loop.noise]  # from its middle
        predicted, innovations, applied = [loop.start], list[float](), list[float]()
        for k in range(5):
            innovations.append(float(states[k, 0] + noise[k] - predicted[k][0]))
            known = max(0, k - 1)  # measurements that are known; from there on predictions alone
            estimate = predicted[known]
            for j in range(known, k):
                estimate = step[:, :2] @ estimate + step[:, 2] * applied[j]
            u = float(K[k, 0] @ estimate + decided[k] + sum(M[k, j, 0, 0] * e for j, e in enumerate(innovations)))
            applied.append(u)
            onward = step[:, :2] @ predicted[k] + step[:, 2] * u + L[k][:, 0] * innovations[k]
            predicted.append(onward)
        assert (loop_controls @ z)[:, 0] == pytest.approx(applied, rel=1e-9, abs=1e-11)


def test_what_a_loop_of_outputs_does_not_know_is_bounded_by_what_a_deviation_attains() -> None:
    loop, _ = looped(SENSED)
    rng, largest = np.random.default_rng(7), 0.0
    vertices = [np.sign(row) * loop.spread.radii for row in loop.missing[:, 0]]
    for deviation in (*vertices, *(rng.choice([-1.0, 1.0], loop.spread.size) * loop.spread.radii for _ in range(50))):
        largest = max(largest, float(np.abs(loop.missing[:, 0] @ deviation).max()))
    assert largest == pytest.approx(loop.widest[0], rel=1e-9)
    assert not looped()[0].missing.any() and not looped()[0].widest.any()


def test_what_is_decided_has_the_range_of_its_initial_state_and_of_those_around_it() -> None:
    """That of a problem that begins there, or in a set of initial states."""
    model, policy = _prepared(None), AffinePolicy(cost="peak", prestabilise=[[-12.0, -4.0]])
    state, around = np.array([-0.3, 1.0]), np.array([0.1, 0.5])
    first = prepare(model.problem, model.control, model.disturbance, policy=policy)
    there = replace(model.problem, initial_state=state)
    within = replace(there, initial_set=Box(-around, around))
    expected = [prepare(each, model.control, model.disturbance, policy=policy) for each in (there, within)]
    found = [from_state(first, state), from_state(first, state, around)]
    ranges = [each.held.control.bounding_box().upper[0] for each in (first, *expected, *found)]
    assert ranges[3:] == pytest.approx(ranges[1:3], rel=1e-6)
    assert np.diff(np.sort(ranges[:3])).min() > 1e-3


def test_what_is_left_of_the_control_answers_the_innovations_so_far() -> None:
    """Stepped from breakpoint to breakpoint with two innovations, and none after them."""
    (loop, x), none = looped(), np.zeros(1)
    plant = SampledPlant.of(loop.functionals.response, loop.functionals.dictionary, none, none)
    innovations, state = [np.zeros(2), np.array([0.03, -0.2]), np.array([-0.01, 0.1])], np.array([0.1, 0.0])
    decided, M, controls = loop.decided(x)[:, :, 0], loop.gains(x), list[np.ndarray]()
    for k in range(5):
        known = innovations[: k + 1]
        state = state + known[k] if k < len(known) else state
        answered = sum((M[k, j] @ e for j, e in enumerate(known)), np.zeros(1))
        controls.append(decided[k] + loop.inner.gains[k] @ state + answered)
        state = plant.Phi[k] @ state + plant.Gamma[k] @ controls[-1]
    assert loop.nominal(x) + loop.respond(x, innovations) == pytest.approx(np.array(controls).T, rel=1e-9)


def test_gains_are_bounded_by_the_control_and_all_that_the_loop_adds() -> None:
    """A gain is as large as the range of the decided part lets it be: the control, and what acts on the estimate."""
    loop, _ = looped(SENSED)
    answers, size = loop.answers, loop.nominal_size
    program = _prepared(SENSED).program
    reach = 8.0 + loop.inner.reach[0] + loop.widest[0]
    expected = 2.0 * reach * answers.share / loop.spread.chords[answers.entry]
    assert program.finite.upper[size : size + answers.variables] == pytest.approx(expected, rel=1e-12)
    assert loop.widest[0] > 0.1


@pytest.mark.parametrize("measured", [None, SENSED])
def test_rows_at_any_time_are_those_of_the_state_and_of_the_control(measured: Measurements | None) -> None:
    loop, x = looped(measured)
    H, none = np.array([[1.0, 0.0], [0.0, 1.0]]), np.zeros(2)
    rows = LoopRows(loop).of_state(1.234, H, none, np.arange(2), np.ones(2))
    state = loop.states(x, np.array([1.234]))[0]
    G = np.array([[2.0], [-1.0]])
    both = LoopRows(loop).with_control(rows, G, np.array([3, 3]))
    for found, values in ((rows, H @ state), (both, H @ state + G @ loop.controls(x)[3])):
        nominal = found.g @ x - found.h
        responses = np.stack([C @ x + d for C, d in zip(found.C, found.d, strict=True)])
        assert nominal == pytest.approx(values[:, 0], rel=1e-9, abs=1e-11)
        assert responses == pytest.approx(values[:, 1:], rel=1e-9, abs=1e-11)


def test_rounding_within_a_piece_counts_what_the_loop_holds() -> None:
    loop, x = looped()
    times = np.array([0.5, 1.5])
    pieces = loop.grid.locate(times)
    flow, input_flow = loop.compute_flows(pieces, times - loop.grid.breakpoints[pieces])
    sizes, drives, errors, in_drives = loop.bound_rounding_errors(x)
    found = LoopBounds(loop)._enclose_states(x, times, pieces)[1]
    expected = np.abs(flow) @ (ROUND_OFF * sizes + errors[: len(sizes)])[pieces, :, None]
    expected += np.abs(input_flow) @ (ROUND_OFF * drives + in_drives)[pieces, :, None]
    assert found == pytest.approx(expected[:, :, 0], rel=1e-12, abs=0.0)


@pytest.mark.parametrize("span", [1, 3])
def test_values_of_constraints_that_are_read_back_hold_of_every_trajectory(span: int) -> None:
    """Constraints that hold with equality along a trajectory of the largest controls and pushes leave its state."""
    plant, rng = sampled(6), np.random.default_rng(5)
    for sign in (1.0, -1.0, *rng.choice([1.0, -1.0], size=8)):
        u, w = sign * 5.0 * np.ones(6), sign * PUSH * rng.choice([1.0, -1.0], size=6)
        states = [rng.normal(size=4)]
        for k in range(5):
            states.append(plant.Phi[k] @ states[-1] + plant.Gamma[k, :, 0] * (u[k] + w[k]))
        constraints = [StateRows(np.eye(4), states[j], states[j], np.arange(7) == j) for j in range(2, 2 + span)]
        rows, lower, upper = plant._read_constraints(1, span, (np.array([-5.0]), np.array([5.0])), constraints)
        assert len(rows) == 4 * span
        assert (rows @ states[1] >= lower - 1e-9).all() and (rows @ states[1] <= upper + 1e-9).all()
