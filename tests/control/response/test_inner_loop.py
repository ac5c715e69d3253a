"""Guards control/response/inner_loop: weights and states with a feedback beside the decision are those of a plant that
is stepped with it."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest
from scipy.linalg import expm

from sparserob_core.control.problem.system import LinearSystem
from sparserob_core.control.response.inner_loop import NO_INNER_LOOP, InnerLoop
from sparserob_core.control.response.response import Response
from sparserob_core.control.response.time_grid import merge_grids

PLANTS = {
    "pendulum": (np.array([[0.0, 1.0], [9.0, 0.0]]), np.array([[0.0], [1.0]])),
    "two controls": (np.array([[1.0, 2.0, 0.0], [0.0, 0.5, 1.0], [0.0, 0.0, -1.0]]), np.eye(3)[:, 1:]),
}
HORIZON, PIECES = 2.0, 6


def made(name: str) -> Response:
    A, B = PLANTS[name]
    d, m = B.shape
    control = np.linspace(0.0, HORIZON, PIECES + 1)
    grid = merge_grids(control, np.linspace(0.0, HORIZON, 5), constants=1)
    gains = np.random.default_rng(3).normal(size=(PIECES, m, d))
    system = LinearSystem(A, B, np.eye(d), c=np.arange(d) - 0.5).forced
    return Response(system, grid, np.arange(1.0, d + 1.0), inner=InnerLoop(gains, np.ones(m)))


def stepped(response: Response, decided: np.ndarray, disturbance: np.ndarray, time: float) -> np.ndarray:
    """The state at a time, and what the feedback added to every control until then, by exponentials of one piece."""
    grid, inner, system = response.grid, response.inner, response.system
    A, B, E = (matrix[0] for matrix in system.modes[0].matrices(np.zeros((1, 0))))
    state, added, last = response.initial_state.copy(), np.zeros_like(decided), -1
    for piece in range(grid.pieces):
        begin = grid.breakpoints[piece]
        k = grid.control_piece[piece]
        if k != last:
            added[:, k], last = inner.gains[k] @ state, k
        length = min(grid.breakpoints[piece + 1], time) - begin
        if length <= 0.0:
            break
        inputs = np.append(decided[:, k] + added[:, k], 1.0)
        whole = np.zeros((len(A) + 1,) * 2)
        whole[:-1, :-1], whole[:-1, -1] = A, B @ inputs + E @ disturbance[:, grid.disturbance_piece[piece]]
        state = (expm(whole * length) @ np.append(state, 1.0))[:-1]
    return np.append(state, added.ravel())


@pytest.mark.parametrize("name", PLANTS)
@pytest.mark.parametrize("time", [0.0, 0.2, 1.0 / 3.0, 0.9, HORIZON])
def test_weights_are_those_of_the_plant_with_its_feedback(name: str, time: float) -> None:
    response, rng = made(name), np.random.default_rng(4)
    A, B = PLANTS[name]
    decided, noise = rng.normal(size=(B.shape[1], PIECES)), rng.normal(size=(len(A), 4))
    free, on_control, on_noise = response.weights(np.full(len(A), time), np.eye(len(A)), np.zeros((len(A), 0)))
    inputs = response.grid.inputs(decided)
    found = free @ response.initial_state + np.einsum("klm,ml->k", on_control, inputs)
    found += np.einsum("kli,il->k", on_noise, noise[:, response.grid.disturbance_piece])
    assert found == pytest.approx(stepped(response, decided, noise, time)[: len(A)], rel=1e-10, abs=1e-10)


@pytest.mark.parametrize("name", PLANTS)
def test_what_the_feedback_adds_is_weighed_as_it_acts(name: str) -> None:
    response, rng = made(name), np.random.default_rng(5)
    A, B = PLANTS[name]
    decided, noise = rng.normal(size=(B.shape[1], PIECES)), rng.normal(size=(len(A), 4))
    weights = rng.normal(size=(2, PIECES, B.shape[1]))
    free, on_control, on_noise = response.weigh_controls(weights)
    found = free @ response.initial_state + np.einsum("klm,ml->k", on_control, response.grid.inputs(decided))
    found += np.einsum("kli,il->k", on_noise, noise[:, response.grid.disturbance_piece])
    added = stepped(response, decided, noise, HORIZON)[len(A) :].reshape(B.shape[1], PIECES)
    assert found == pytest.approx(np.einsum("rkm,mk->r", weights, added), rel=1e-10, abs=1e-10)


@pytest.mark.parametrize("name", PLANTS)
def test_states_are_those_of_the_plant_with_its_feedback(name: str) -> None:
    response, rng = made(name), np.random.default_rng(6)
    A, B = PLANTS[name]
    decided, noise = rng.normal(size=(B.shape[1], PIECES)), rng.normal(size=(len(A), 4))
    path = response.states(decided, np.zeros((1, 0)), noise[None])[0]
    for time, state in zip(response.grid.breakpoints, path, strict=True):
        assert state == pytest.approx(stepped(response, decided, noise, time)[: len(A)], rel=1e-10, abs=1e-10)


def test_units_change_gains_and_bounds_as_they_change_states_and_controls() -> None:
    inner = InnerLoop(np.ones((3, 1, 2)), np.array([5.0]))
    units = SimpleNamespace(states=np.array([2.0, 8.0]), controls=np.array([4.0]))
    scaled = inner.in_units(units)
    assert scaled.gains[0].tolist() == [[0.5, 2.0]] and scaled.reach.tolist() == [1.25]
    assert NO_INNER_LOOP.in_units(units) is NO_INNER_LOOP and not NO_INNER_LOOP.acts


def test_a_response_without_its_inner_loop_is_that_of_the_plant() -> None:
    response = made("pendulum")
    index = np.array([1.3]), np.array([[1.0, 0.5]]), np.zeros((1, 0))
    bare = Response(response.system, response.grid, response.initial_state)
    for found, expected in zip(response.bare.weights(*index), bare.weights(*index), strict=True):
        assert np.array_equal(found, expected)


def test_figures_name_what_acts_before_anything_is_answered() -> None:
    assert InnerLoop().noun == "the nominal control"
    assert InnerLoop(np.zeros((1, 1, 1)), np.zeros(1)).noun == "the inner loop"
