"""Guards control/response/response: state responses and worst-case functionals, against augmented exponentials of
single trajectories."""

from __future__ import annotations

from dataclasses import replace
from unittest.mock import patch

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.integrate import solve_ivp
from scipy.linalg import expm

from sparserob_core.control.enclosures.matrix_exponential import exponential, transitions
from sparserob_core.control.problem.dictionary import Dictionary
from sparserob_core.control.problem.system import LinearSystem
from sparserob_core.control.reach import functional, many_directions
from sparserob_core.control.reach.disturbance_support import DisturbanceSupport
from sparserob_core.control.reach.many_directions import ManyDirections
from sparserob_core.control.response.lifted import lift
from sparserob_core.control.response.response import Propagator, Response, unique_rows
from sparserob_core.control.response.time_grid import merge_grids
from sparserob_core.sip.convex_set import Box
from tests.support.plants import indicators, random_system, simulated, uniform, walsh, worst_case

HORIZON = 3.0
UNEVEN = indicators([0.0, 0.2, 0.25, 1.1, 2.9, HORIZON])
DICTIONARIES = {
    "uniform": uniform(6, HORIZON),
    "uneven": UNEVEN,
    "walsh": walsh(4, HORIZON),
    "three walsh": walsh(4, HORIZON, 3),
    "dense": Dictionary(np.linspace(0, HORIZON, 5), np.array([[1.0, 0.5, -2.0, 3.0], [0.0, 1.0, 1.0, 7.0]])),
}


def uncertain(rng, states=3, controls=2):
    """Random matrices that depend on two parameters."""
    A0, A1, B0, B1, E0, E1 = (
        rng.normal(size=shape) for shape in [(states, states)] * 2 + [(states, controls)] * 2 + [(states, 2)] * 2
    )
    return LinearSystem(
        lambda p: A0 + p[0] * A1,
        lambda p: B0 + p[1] * p[0] * B1,
        lambda p: E0 + p[1] * E1,
        parameters=Box([-1, -1], [1, 1]),
    )


@settings(max_examples=25, deadline=None)
@given(
    seed=st.integers(0, 10**6),
    control=st.sampled_from(sorted(DICTIONARIES)),
    disturbance=st.sampled_from(sorted(DICTIONARIES)),
)
def test_rows_times_the_decision_are_the_simulated_worst_case(seed, control, disturbance):
    rng = np.random.default_rng(seed)
    control, disturbance = DICTIONARIES[control], DICTIONARIES[disturbance]
    system, start = uncertain(rng), rng.normal(size=3)
    functionals = worst_case(system, control, disturbance, Box([-0.1, 0.0], [0.3, 0.2]), initial_state=start)
    theta = rng.normal(size=functionals.variables)
    grid = functionals.response.grid
    times = np.concatenate([[0.0, HORIZON], rng.choice(grid.breakpoints, 2), rng.uniform(0, HORIZON, 2)])
    directions, parameters = rng.normal(size=(6, 3)), rng.uniform(-1, 1, (6, 2))
    parameters[3] = parameters[2]
    G, offset = functionals.rows(times, directions, parameters)
    values = functionals.values(theta, times, directions, parameters)
    signal = theta.reshape(2, -1) @ control.values
    for k, time in enumerate(times):
        A, B, E = (matrix[0] for matrix in system.phases[0].matrices(parameters[k][None]))
        worst = functionals.parts(time, directions[k], parameters[k]).disturbance
        state = simulated(
            A, [(B, control.breakpoints, signal), (E, grid.breakpoints, worst)], start, time, grid.breakpoints
        )
        truth = directions[k] @ state
        scale = 1e-10 * max(1.0, abs(truth), np.abs(G[k]).max())
        assert abs(G[k] @ theta + offset[k] - truth) <= scale
        assert abs(values[k] - truth) <= scale


def test_the_rows_agree_with_an_integrator_of_tight_tolerance():
    rng = np.random.default_rng(3)
    system = random_system(rng)
    functionals = worst_case(system, UNEVEN, initial_state=[1.0, -1.0])
    theta = rng.normal(size=functionals.variables)
    A, B, _ = (matrix[0] for matrix in system.phases[0].matrices(np.zeros((1, 0))))
    state, time = np.array([1.0, -1.0]), 0.0
    for piece, stop in enumerate(UNEVEN.breakpoints[1:]):
        state = solve_ivp(
            lambda t, x, u: A @ x + B @ u, (time, stop), state, args=(theta[piece : piece + 1],), rtol=1e-12, atol=1e-13
        ).y[:, -1]
        time = stop
        for direction in np.eye(2):
            G, offset = functionals.rows(np.array([stop]), direction[None], np.zeros((1, 0)))
            assert abs(G[0] @ theta + offset[0] - direction @ state) <= 1e-9 * max(1.0, np.abs(state).max())


@settings(max_examples=20, deadline=None)
@given(
    seed=st.integers(0, 10**6),
    control=st.sampled_from(sorted(DICTIONARIES)),
    disturbance=st.sampled_from(sorted(DICTIONARIES)),
)
def test_states_at_the_breakpoints_agree_with_the_rows(seed, control, disturbance):
    rng = np.random.default_rng(seed)
    control, disturbance = DICTIONARIES[control], DICTIONARIES[disturbance]
    functionals = worst_case(uncertain(rng), control, disturbance, initial_state=rng.normal(size=3))
    theta, points = rng.normal(size=functionals.variables), rng.uniform(-1, 1, (4, 2))
    response = functionals.response
    states = response.states(theta.reshape(2, -1) @ control.values, points)
    times = response.grid.breakpoints
    for v, parameter in enumerate(points):
        for i, direction in enumerate(np.eye(3)):
            shape = (times.size, 1)
            G, offset = functionals.rows(times, np.tile(direction, shape), np.tile(parameter, shape))
            assert np.allclose(G @ theta + offset, states[v, :, i], rtol=1e-10, atol=1e-10)


def test_states_under_disturbances_agree_with_single_simulations():
    rng = np.random.default_rng(0)
    system, signal = random_system(rng), rng.normal(size=(3, 2, 5))
    response = Response(system, merge_grids(np.linspace(0, HORIZON, 4), UNEVEN.breakpoints), np.array([1.0, 2.0]))
    control = rng.normal(size=(1, 3))
    states = response.states(control, np.zeros((1, 0)), signal)
    A, B, E = (matrix[0] for matrix in system.phases[0].matrices(np.zeros((1, 0))))
    for v in range(3):
        drives = [(B, np.linspace(0, HORIZON, 4), control), (E, UNEVEN.breakpoints, signal[v])]
        assert np.allclose(
            states[v, -1], simulated(A, drives, [1.0, 2.0], HORIZON, response.grid.breakpoints), rtol=1e-11, atol=1e-11
        )


@settings(max_examples=20, deadline=None)
@given(seed=st.integers(0, 10**6), pieces=st.sampled_from([1, 2, 3, 7, 16]), nu=st.sampled_from([0, 1]))
def test_the_push_by_age_equals_the_push_by_adjoints(seed, pieces, nu):
    rng = np.random.default_rng(seed)
    A0, A1, E = rng.normal(size=(2, 2)), rng.normal(size=(2, 2)), rng.normal(size=(2, 2))
    known = LinearSystem(A0, np.ones((2, 1)), E)
    system = LinearSystem(lambda p: A0 + p[0] * A1, np.ones((2, 1)), E, parameters=Box([-0.1], [0.1])) if nu else known
    functionals = worst_case(system, uniform(pieces, HORIZON), bound=Box([-0.1, -0.2], [0.3, 0.1]))
    lifted = lift(system.phases[0], functionals.response.grid, np.zeros(2), np.zeros(nu), np.full(nu, 0.1))
    rows = rng.normal(size=(3, 2))
    times = np.concatenate([functionals.response.grid.breakpoints, rng.uniform(0, HORIZON, 5)])
    ends = rng.integers(-1, 2, (times.size, 3, nu)).astype(float)
    sigma = DisturbanceSupport(lifted, functionals.disturbance, rows)
    widths = rng.uniform(0, 1, times.size) * HORIZON / pieces
    fast, steep, bent = sigma.at(times, ends), sigma.steepness(times), sigma.deviation(times, widths)
    with patch.object(DisturbanceSupport, "_has_uniform_blocks", new=False):
        sigma = DisturbanceSupport(lifted, functionals.disturbance, rows)
        slow = sigma.at(times, ends)
        assert np.allclose(fast[0], slow[0], rtol=1e-9, atol=1e-11)
        assert np.allclose(fast[1], slow[1], rtol=1e-9, atol=1e-11)
        assert np.allclose(steep, sigma.steepness(times), rtol=1e-9, atol=1e-11)
        assert np.allclose(bent, sigma.deviation(times, widths), rtol=1e-9, atol=1e-11)


@settings(max_examples=20, deadline=None)
@given(seed=st.integers(0, 10**6), pieces=st.sampled_from([1, 2, 5, 13]))
def test_the_profile_of_a_uniform_grid_equals_the_offsets(seed, pieces):
    rng = np.random.default_rng(seed)
    functionals = worst_case(uncertain(rng), uniform(pieces, HORIZON), bound=Box([-0.1, -0.2], [0.3, 0.1]))
    times, directions, parameter = (
        np.append(rng.uniform(0, HORIZON, 5), [0.0, HORIZON]),
        rng.normal(size=(3, 3)),
        rng.uniform(-1, 1, 2),
    )
    fast = ManyDirections(functionals).profile(times, directions, parameter)
    slow = functionals.offsets(np.repeat(times, 3), np.tile(directions, (7, 1)), np.tile(parameter, (21, 1)))
    assert np.allclose(fast.ravel(), slow, rtol=1e-10, atol=1e-11)


@pytest.mark.first(4)
@pytest.mark.parametrize("disturbance", ["uneven", "three walsh"])
@pytest.mark.parametrize("bound", [Box([-0.1, -0.2], [0.3, 0.1]), Box([-0.3, -0.2], [0.3, 0.2])])
@pytest.mark.parametrize("begun", [None, Box([-0.2, 0.0, -0.1], [0.1, 0.4, 0.1])])
def test_the_profile_of_many_directions_equals_the_offsets(disturbance, bound, begun, monkeypatch):
    """Few numbers at once, so that there are several parts of times and of those."""
    monkeypatch.setattr(functional, "CHUNK", 200)
    monkeypatch.setattr(many_directions, "CHUNK", 200)
    monkeypatch.setattr(many_directions, "NEAR", 200)
    rng = np.random.default_rng(6)
    functionals = worst_case(uncertain(rng), UNEVEN, DICTIONARIES[disturbance], bound)
    functionals = replace(functionals, initial=begun)
    times, directions = np.append(rng.uniform(0, HORIZON, 9), [0.0, 1.1, HORIZON]), rng.normal(size=(7, 3))
    parameter = rng.uniform(-1, 1, 2)
    fast = ManyDirections(functionals).profile(times, directions, parameter)
    slow = functionals.offsets(np.repeat(times, 7), np.tile(directions, (12, 1)), np.tile(parameter, (84, 1)))
    np.testing.assert_allclose(fast.ravel(), slow, rtol=1e-12, atol=1e-13)


def test_ages_are_powers_of_the_transition():
    response = Response(
        random_system(np.random.default_rng(1)), merge_grids(np.linspace(0, 2, 12), np.linspace(0, 2, 12)), np.zeros(2)
    )
    A = response.system.phases[0].matrices(np.zeros((1, 0)))[0][0]
    _, F = transitions(A[None], np.array([2 / 11]))
    for age in range(11):
        assert np.allclose(response.propagator.kernel[:, age], expm(A * age * 2 / 11) @ F[0], rtol=1e-11, atol=1e-12)


@pytest.mark.parametrize("states", [1, 2, 4])
def test_functionals_asked_for_one_by_one_are_those_asked_for_all_at_once(states):
    """At breakpoints and ends too."""
    rng, breaks = np.random.default_rng(states), np.linspace(0, 2, 12)
    response = Response(random_system(rng, states), merge_grids(breaks, breaks), np.zeros(states))
    times = np.concatenate([breaks, rng.uniform(0, 2, 128)])
    given = (times, rng.normal(size=(times.size, states)), np.zeros((times.size, 0)))
    every = response.adjoint(*given)
    for one in range(times.size):
        for alone, among in zip(response.adjoint(*(part[one : one + 1] for part in given)), every, strict=True):
            assert np.allclose(alone[0], among[one], rtol=1e-11, atol=1e-12)


@pytest.mark.parametrize("states", [1, 4])
def test_what_pieces_give_by_their_age_is_what_rows_give_from_piece_to_piece(states):
    rng, breaks = np.random.default_rng(states), np.linspace(0, 2, 54)
    times, directions = rng.uniform(0, 2, 20), rng.normal(size=(20, states))
    times[:3] = 0.0, breaks[32], 2.0
    system, found = random_system(rng, states), []
    given = times, directions, np.zeros((20, 0))
    for aged in (True, False):
        with patch.object(Propagator, "aged", lambda *_, aged=aged: aged):
            response = Response(system, merge_grids(breaks, breaks), np.zeros(states))
            found.append([*response.adjoint(*given), *response.weights(*given)])
    for one, other in zip(*found, strict=True):
        assert np.allclose(one, other, rtol=1e-12, atol=1e-13)


@pytest.mark.first(1)
@pytest.mark.parametrize("pieces", [7, 999, 3001])
def test_many_pieces_add_up_to_the_horizon(pieces):
    """An integrator driven by 1 ends at the horizon; the rounded length of a piece may not accumulate."""
    system = LinearSystem([[0.0]], [[1.0]])
    functionals = worst_case(system, uniform(pieces, 10.0), initial_state=[0.0])
    states = functionals.response.states(np.ones((1, pieces)), np.zeros((1, 0)))
    assert abs(states[0, -1, 0] - 10.0) <= 2e-12


def test_breakpoints_closer_than_rounding_are_one_in_the_merged_grid():
    grid = merge_grids(np.array([0.0, 1.0, 2.0]), np.array([0.0, 1.0 + 1e-15, 1.5, 2.0]))
    assert grid.pieces == 3
    assert grid.control_piece.tolist() == [0, 1, 1]
    assert grid.disturbance_piece.tolist() == [0, 1, 2]


def test_breakpoints_of_one_set_are_never_taken_for_one():
    """Half a rounding from each of two breakpoints of the control, one of the disturbance joined the three."""
    control, apart = np.array([0.0, 0.5, 0.5 + 1.6e-12, 1.0]), np.array([0.0, 0.5 - 4e-13, 0.5 + 4e-13, 1.0])
    grid = merge_grids(control, np.array([0.0, 0.5 + 8e-13, 1.0]))
    assert grid.control_piece.tolist() == [0, 1, 2]
    assert grid.disturbance_piece.tolist() == [0, 0, 1]
    grid = merge_grids(np.array([0.0, 0.5, 1.0]), apart)
    assert set(grid.control_piece) == {0, 1}
    assert set(grid.disturbance_piece) == {0, 1, 2}
    grid = merge_grids(apart, np.array([0.0, 0.5, 1.0]))
    assert set(grid.control_piece) == {0, 1, 2}
    assert set(grid.disturbance_piece) == {0, 1}


def test_no_times_give_no_rows():
    functionals = worst_case(random_system(np.random.default_rng(1)), uniform(3, 1.0), bound=Box([-1, -1], [1, 1]))
    G, offset = functionals.rows(np.zeros(0), np.zeros((0, 2)), np.zeros((0, 0)))
    assert G.shape == (0, 3)
    assert offset.shape == (0,)


@pytest.mark.parametrize("rate", [-200.0, -30.0])
def test_a_stiff_system_keeps_its_accuracy(rate):
    system = LinearSystem([[rate, 1.0], [0.0, -1.0]], [[1.0], [1.0]])
    functionals = worst_case(system, uniform(3, HORIZON), initial_state=[1.0, 1.0])
    A, B, _ = (matrix[0] for matrix in system.phases[0].matrices(np.zeros((1, 0))))
    control = np.array([[1.0, -2.0, 0.5]])
    for time in (1e-3, 0.7, 2.0, HORIZON):
        truth = simulated(A, [(B, np.linspace(0, HORIZON, 4), control)], [1.0, 1.0], time, np.array([0.0]))
        G, offset = functionals.rows(np.full(2, time), np.eye(2), np.zeros((2, 0)))
        assert np.allclose(G @ control[0] + offset, truth, rtol=1e-11, atol=1e-12)


@settings(max_examples=30, deadline=None)
@given(seed=st.integers(0, 10**6), size=st.integers(1, 8), magnitude=st.sampled_from([0.0, 1e-8, 0.3, 1.0, 5.0, 30.0]))
def test_the_exponential_of_many_matrices_agrees_with_scipy(seed, size, magnitude):
    rng = np.random.default_rng(seed)
    matrices = magnitude * rng.normal(size=(4, 3, size, size)) / size
    matrices[0] *= 1e-3
    matrices[1] = np.triu(matrices[1])
    found, truth = exponential(matrices), expm(matrices)
    assert (np.abs(found - truth).max(axis=(-2, -1)) <= 1e-11 * np.abs(truth).max(axis=(-2, -1))).all()


def test_the_exponential_of_a_stiff_matrix_keeps_its_slow_part():
    A = np.array([[-2000.0, 1.0, 0.0], [0.0, -0.3, 1.0], [0.0, 0.0, 0.0]])
    assert np.allclose(exponential(A[None])[0], expm(A), rtol=1e-10, atol=1e-13)
    assert np.array_equal(exponential(np.zeros((2, 3, 3))), np.tile(np.eye(3), (2, 1, 1)))


def test_a_known_system_takes_any_number_of_rows_without_parameters_one_after_the_other():
    response = Response(
        LinearSystem([[0.0, 1.0], [-2.0, -0.5]], [[0.0], [1.0]]),
        merge_grids(np.linspace(0, 1, 4), np.linspace(0, 1, 4)),
        np.array([1.0, 0.0]),
    )
    control, disturbances = np.ones((1, 3)), np.ones((5, 2, 3))
    many = response.states(control, np.zeros((5, 0)), disturbances)
    one = response.states(control, np.zeros((1, 0)), disturbances[:1])
    np.testing.assert_allclose(many, np.repeat(one, 5, axis=0), atol=1e-14)


@pytest.mark.parametrize(("states", "pieces", "many"), [(2, 4003, 1), (6, 2500, 1), (3, 1009, 4)])
def test_states_in_blocks_are_those_of_the_recursion(states: int, pieces: int, many: int) -> None:
    rng = np.random.default_rng(pieces)
    system = LinearSystem(rng.normal(size=(states, states)), rng.normal(size=(states, 2)), np.eye(states)[:, :1])
    breakpoints = np.linspace(0.0, HORIZON, pieces + 1)
    response = Response(system, merge_grids(breakpoints, breakpoints), rng.normal(size=states))
    control, disturbance = rng.normal(size=(2, pieces)), rng.normal(size=(many, 1, pieces))
    none = np.zeros((1, 0))
    assert response.propagator.block(response.steps(none)) > 1
    fast = response.states(control, none, disturbance)
    with patch("sparserob_core.control.response.response.FEWEST", 10**9):
        plain = response.states(control, none, disturbance)
    np.testing.assert_allclose(fast, plain, rtol=0.0, atol=1e-12 * np.abs(plain).max())


@settings(max_examples=20, deadline=None)
@given(seed=st.integers(0, 10**6), states=st.integers(1, 8), pieces=st.integers(1, 60))
def test_what_an_initial_state_gives_is_the_exponential(seed, states, pieces):
    rng = np.random.default_rng(seed)
    A, horizon = rng.normal(size=(states, states)) / np.sqrt(states), 3.0
    times, directions = rng.uniform(0.0, horizon, 5), rng.normal(size=(5, states))
    grid = np.linspace(0.0, horizon, pieces + 1)

    response = Response(LinearSystem(A, np.eye(states)), merge_grids(grid, grid), np.zeros(states))
    free = response.weights(times, directions, np.zeros((5, 0))).free
    exact = np.stack([expm(A.T * t) @ c for t, c in zip(times, directions, strict=True)])
    assert np.abs(free - exact).max() <= 1e-12 * np.abs(exact).max()


def test_a_known_system_at_a_parameter_keeps_all_that_is_remembered_of_it():
    """An uncertain one becomes the known one there; nothing is propagated anew where there is nothing to choose."""
    grid, start = merge_grids(np.array([0.0, 0.5, 1.0]), np.array([0.0, 1.0])), np.array([1.0])
    uncertain = LinearSystem(lambda p: np.array([[-p[0]]]), [[1.0]], parameters=Box([1.0], [3.0]))
    there = Response(uncertain, grid, start).at(np.array([2.0]))
    times, rows, none = np.array([0.75]), np.ones((1, 1)), np.zeros((1, 0))
    assert there.weights(times, rows, none).free[0, 0] == pytest.approx(np.exp(-1.5), rel=1e-14)
    assert there.at(np.zeros(0)) is there


def test_rows_are_told_apart_wherever_their_copies_stand():
    rows = np.array([[0.0, 1.0], [-0.0, 1.0], [2.0, 1.0], [0.0, 1.0], [2.0, 1.0], [2.0, 1.0], [-1.0, 0.0]])
    distinct, indices = unique_rows(rows)
    np.testing.assert_array_equal(distinct, [[-1.0, 0.0], [0.0, 1.0], [2.0, 1.0]])
    np.testing.assert_array_equal(indices, [1, 1, 2, 1, 2, 2, 0])
