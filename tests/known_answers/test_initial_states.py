"""Guards known answers: sets of feasible initial states with closed forms: reachable sets backwards in time, segments,
rectangles."""

from __future__ import annotations

import copy
from typing import Any

import numpy as np
import pytest

import sparserob_core as sr

T, SIDE = 3.0, np.array([0.5, 0.4])
CART: dict[str, Any] = {
    "title": "A cart",
    "problem": {
        "name": "linear",
        "system": {"A": [[0, 1], [0, 0]], "B": [[0], [1]]},
        "horizon": T,
        "initial_state": [1.0, 0.0],
        "control": {"box": 1.0},
        "terminal": [{"box": SIDE.tolist()}],
    },
    "dictionaries": {"control": {"name": "piecewise_constant", "pieces": 30}},
    "observers": [],
}
NOISY = {"problem.disturbance": {"box": [0.0, 0.1]}}


def support(direction: np.ndarray, pieces: int) -> float:
    """Of the null-controllable set: that of the terminal box, moved back, and ``int |B'e^{-A's} d| ds``, piece by
    piece."""
    ends = np.linspace(0.0, T, pieces + 1)
    whole = direction[1] * ends - direction[0] * ends**2 / 2
    back = np.array([direction[0], direction[1] - T * direction[0]])
    return float(SIDE @ np.abs(back) + np.abs(np.diff(whole)).sum())


def feasible(x0: np.ndarray, disturbance: sr.Box | None = None) -> str:
    problem = sr.OptimalControlProblem(
        system=sr.LinearSystem(A=[[0, 1], [0, 0]], B=[[0], [1]]),
        horizon=T,
        initial_state=x0,
        control=sr.Box([-1], [1]),
        disturbance=disturbance,
        terminal=[sr.Box(-SIDE, SIDE)],
    )
    return sr.solve(problem, control={"name": "piecewise_constant", "pieces": 30}).status


@pytest.fixture(scope="module")
def cart() -> sr.InitialStates:
    return sr.initial_states(CART, directions=24, values=6)


@pytest.mark.slow
def test_every_half_plane_is_the_support_function_of_the_null_controllable_set(cart: sr.InitialStates) -> None:
    exact = np.array([support(direction, 30) for direction in cart.directions])
    assert len(exact) == 24
    assert (cart.bounds >= exact - 1e-9).all()
    assert (cart.reached <= exact + 1e-6).all()
    np.testing.assert_allclose(cart.bounds, exact, atol=2e-6)
    np.testing.assert_allclose(cart.reached, exact, atol=2e-6)


@pytest.mark.slow
def test_the_piecewise_constant_set_approaches_the_integral_from_within(cart: sr.InitialStates) -> None:
    integral = np.array([support(direction, 200_000) for direction in cart.directions])
    assert (cart.reached <= integral + 1e-8).all()
    np.testing.assert_allclose(cart.bounds, integral, atol=3e-3)


@pytest.mark.slow
def test_the_area_between_the_polygons_is_small_and_the_polygons_enclose(cart: sr.InitialStates) -> None:
    assert 0.0 <= cart.gap < 0.02
    assert (cart.inner @ cart.directions.T <= cart.bounds + 1e-8).all()
    assert (cart.outer @ cart.directions.T <= cart.bounds + 1e-8).all()


@pytest.mark.slow
def test_just_inside_is_certified_and_just_outside_has_a_farkas_certificate(cart: sr.InitialStates) -> None:
    for vertex in cart.inner[::8]:
        assert cart.where(0.999 * vertex) == "inside"
        assert feasible(0.999 * vertex) == "certified"
    for direction in np.array([[1.0, 0.0], [0.6, 0.8], [-0.8, 0.6]]):
        vertex = cart.inner[int((cart.inner @ direction).argmax())]
        normal = cart.directions[int((cart.directions @ vertex - cart.bounds).argmax())]
        beyond = vertex + 1e-3 * normal
        assert cart.where(beyond) == "outside"
        assert feasible(beyond) == "infeasible"


@pytest.mark.slow
def test_a_disturbance_shrinks_the_set(cart: sr.InitialStates) -> None:
    noisy = sr.initial_states(CART, NOISY, directions=16, values=0)
    assert noisy.outer_area < cart.inner_area
    assert all((cart.directions @ vertex <= cart.bounds + 1e-8).all() for vertex in noisy.inner)
    box = sr.Box([0.0, -0.1], [0.0, 0.1])
    assert feasible(0.99 * noisy.inner[0], box) == "certified"
    assert feasible(1.01 * cart.inner[0], box) == "infeasible"


def test_measured_costs_are_convex_and_their_interpolation_lies_above_the_optimum(cart: sr.InitialStates) -> None:
    assert len(cart.costs) > 30
    assert (cart.lower_bounds <= cart.costs + 1e-7).all()
    np.testing.assert_allclose(cart.lower_bounds, cart.costs, atol=1e-5)
    assert all(cart.cost(point) >= cost - 1e-5 for point, cost in zip(cart.points, cart.costs, strict=True))
    rng = np.random.default_rng(5)
    inside = [weights @ cart.points for weights in rng.dirichlet(np.full(len(cart.points), 0.1), size=4)]
    for point in inside:
        problem = sr.OptimalControlProblem(
            system=sr.LinearSystem(A=[[0, 1], [0, 0]], B=[[0], [1]]),
            horizon=T,
            initial_state=point,
            control=sr.Box([-1], [1]),
            terminal=[sr.Box(-SIDE, SIDE)],
        )
        assert (
            cart.cost(point)
            >= sr.solve(problem, control={"name": "piecewise_constant", "pieces": 30}).lower_bound - 1e-7
        )


def test_combined_controls_of_the_vertices_drive_any_point_of_the_inner_polygon_home(cart: sr.InitialStates) -> None:
    lengths, ends = np.full(30, T / 30), np.linspace(0.0, T, 31)
    for point in np.array([[0.0, 0.0], [2.0, -1.0], [-1.5, 0.7]]):
        assert cart.where(point) == "inside"
        u = cart.control(point)[0]
        assert np.abs(u).max() <= 1.0 + 1e-9
        velocity = point[1] + u @ lengths
        position = point[0] + T * point[1] + u @ (lengths * (T - (ends[:-1] + ends[1:]) / 2))
        assert abs(position) <= SIDE[0] + 1e-7
        assert abs(velocity) <= SIDE[1] + 1e-7


@pytest.mark.slow
def test_uncertain_rates_give_the_rectangle_of_the_worst_rate() -> None:
    config = {
        **CART,
        "problem": {
            **CART["problem"],
            "system": {"A": [["-a", 0], [0, -1]], "B": [[1], [0]], "parameters": {"a": [0.5, 1.0]}},
            "horizon": 1.0,
            "terminal": [{"box": [0.5, 1.0]}],
        },
        "dictionaries": {"control": {"name": "piecewise_constant", "pieces": 8}},
    }
    found = sr.initial_states(config, directions=8, values=0)
    rates = np.linspace(0.5, 1.0, 2001)
    width = float((np.exp(rates) * (0.5 + (1.0 - np.exp(-rates)) / rates)).min())
    assert found.status == "certified"
    np.testing.assert_allclose(found.outer.max(axis=0), [width, np.e], atol=1e-5)
    np.testing.assert_allclose(found.inner.max(axis=0), [width, np.e], atol=1e-5)
    assert found.inner_area == pytest.approx(4 * width * np.e, rel=1e-4)


def test_a_coordinate_that_nothing_moves_and_an_equality_pins_makes_a_segment() -> None:
    config = {
        **CART,
        "problem": {
            **CART["problem"],
            "system": {"A": [[0, 1], [0, 0]], "B": [[1], [0]]},
            "horizon": 1.0,
            "terminal": [{"box": [0.5, None]}, {"equals": [None, 0.25]}],
        },
    }
    found = sr.initial_states(config, directions=8, values=5)
    np.testing.assert_allclose(found.outer.max(axis=0), [1.25, 0.25], atol=1e-5)
    np.testing.assert_allclose(found.outer.min(axis=0), [-1.75, 0.25], atol=1e-5)
    np.testing.assert_allclose([found.inner[:, 0].min(), found.inner[:, 0].max()], [-1.75, 1.25], atol=1e-4)
    assert "no interior" in found.message
    assert len(found.costs) == 5
    assert np.abs(found.costs - np.maximum(np.abs(found.points[:, 0] + 0.25) - 0.5, 0.0)).max() < 1e-4


@pytest.mark.slow
def test_a_path_set_at_time_0_bounds_the_set() -> None:
    found = sr.initial_states(CART, {"problem.path": [{"box": [2.0, 1.5]}]}, directions=12, values=0)
    np.testing.assert_allclose(found.outer.max(axis=0), [2.0, 1.5], atol=1e-6)
    np.testing.assert_allclose(found.inner.min(axis=0), [-2.0, -1.5], atol=1e-6)
    np.testing.assert_allclose(found.path[0].max(axis=0), [2.0, 1.5], atol=1e-9)


IN_TIME: dict[str, Any] = {
    "problem": {
        "name": "linear",
        "system": {
            "A": [[0, 0], [0, "-t / 2"]],
            "B": [["(1 + p) * (2 - t)", 0], [0, 1]],
            "E": [[1, 0], [0, 1]],
            "parameters": {"p": [-0.1, 0.1]},
        },
        "horizon": 2.0,
        "initial_state": [0.0, 0.0],
        "control": {"box": 1.0},
        "terminal": [{"box": [0.2, 0.3]}],
    },
    "dictionaries": {"control": {"name": "piecewise_constant", "pieces": 8}},
    "observers": [],
}


@pytest.mark.slow
def test_of_a_plant_in_time_with_a_parameter_the_set_is_a_rectangle_in_closed_form() -> None:
    """What the first channel gives is between 0.9 and 1.1 of U, at most 2: with all of it -2 comes to between -0.2 and
    0.2. The second state keeps a share 1/e, and the channel adds the integral of ``e^(t^2/4 - 1)``."""
    found = sr.initial_states(IN_TIME, directions=12, values=3)
    fine = np.linspace(0.0, 2.0, 20001)
    wide = np.array([2.0, np.e * (0.3 + float(np.trapezoid(np.exp(fine**2 / 4 - 1), fine)))])
    assert found.status == "certified"
    assert (np.abs(found.inner).max(axis=0) <= wide * (1 + 1e-9)).all()
    assert (np.abs(found.outer).max(axis=0) >= wide * (1 - 1e-9)).all()
    np.testing.assert_allclose(np.abs(found.outer).max(axis=0), wide, rtol=1e-6)
    gains = np.array([2 - (k + 0.5) / 4 for k in range(8)]) / 4
    for (first, second), cost, lower in zip(found.points, found.costs, found.lower_bounds, strict=True):
        if second != 0.0 or abs(first) < 0.2:
            continue
        needed, least = (abs(first) - 0.2) / 0.9, 0.0
        for gain in gains:
            share = min(1.0, needed / gain)
            needed, least = needed - share * gain, least + share / 4
        assert lower <= least * (1 + 1e-9)
        assert cost == pytest.approx(least, rel=1e-6)


def test_of_a_plant_in_time_whose_end_is_out_of_reach_no_state_is_feasible() -> None:
    config = copy.deepcopy(IN_TIME)
    config["problem"]["disturbance"] = {"box": [0.11, 0.0]}
    found = sr.initial_states(config, values=0, within=5)
    assert found.status == "infeasible"
