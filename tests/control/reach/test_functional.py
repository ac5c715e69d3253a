"""Guards control/reach/functional, many_directions, disturbance, response: what one functional is asked in several ways
is the same, and what it says of worst disturbances is found by going through all of their corners."""

from __future__ import annotations

from itertools import product

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.linalg import expm

from sparserob_core.control.problem.cost import nominal_point
from sparserob_core.control.problem.system import LinearSystem, SwitchedSystem, VaryingSystem
from sparserob_core.control.reach.functional import WorstFunctionals
from sparserob_core.control.reach.many_directions import ManyDirections
from sparserob_core.control.response.disturbance import disturbance_model
from sparserob_core.control.response.response import OutputResponse, Response
from sparserob_core.control.response.time_grid import TimeGrid, merge_grids
from sparserob_core.control.sets.sets import Box, Ellipsoid, NormBall, Product
from sparserob_core.errors import InputError
from tests.support.plants import indicators, random_system, simulated, uniform, walsh

HORIZON = 3.0
GRID = uniform(6, HORIZON)
BOX = Box([-0.1, 0.05], [0.3, 0.2])
ROUND = Ellipsoid([0.0, 0.1], [[0.04, 0.01], [0.01, 0.02]])
LINE = NormBall(p=2.0, radius=0.3, dimension=1)
TWO = Product((LINE, Box([-0.1], [0.2])))
OWN = (np.array([0.0, 1.0, HORIZON]), np.array([0.0, 0.5, 1.5, 2.0, HORIZON]))
JOINT = indicators([0.0, 0.5, 1.0, 1.5, 2.0, HORIZON])
MODELS = {
    "none": None,
    "box": ("piecewise_constant", BOX, GRID, None),
    "coarse": ("piecewise_constant", ROUND, uniform(2, HORIZON), None),
    "walsh": ("piecewise_constant", BOX, walsh(4, HORIZON, 3), None),
    "l1_ball": ("l1_ball", Box([-0.1, -0.3], [0.1, 0.3]), walsh(4, HORIZON), None),
    "on own pieces": ("piecewise_constant", TWO, JOINT, OWN),
    "of two classes": (("piecewise_constant", "measurable"), TWO, GRID, None),
    "measurable": ("measurable", BOX, GRID, None),
}
BEGUN = Ellipsoid([0.02, 0.0], [[0.01, 0.002], [0.002, 0.03]])


def functionals(name: str, begun: bool = False, delay: float = 0.0, seed: int = 1) -> WorstFunctionals:
    rng = np.random.default_rng(seed)
    chosen = MODELS[name]
    noise = GRID if chosen is None else chosen[2]
    grid = merge_grids(GRID.breakpoints, noise.breakpoints, delay, np.array([0.4]) if delay else None)
    model = None if chosen is None else disturbance_model(chosen[0], chosen[1], noise, grid, chosen[3])
    system = random_system(rng)
    system = LinearSystem(system.phases[0].A, rng.normal(size=(2, 1)), rng.normal(size=(2, 2)), delay=delay)
    response = Response(system, grid, np.array([0.7, -0.4]))
    return WorstFunctionals(response, GRID, model, initial=BEGUN if begun else None)


def indices(seed: int, count: int = 5) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    return np.append(rng.uniform(0.0, HORIZON, count - 1), HORIZON), rng.normal(size=(count, 2)), np.zeros((count, 0))


@pytest.mark.first(5)
@pytest.mark.parametrize(("name", "begun"), [("none", False), ("box", False), *((name, True) for name in MODELS)])
def test_rows_values_parts_and_turning_directions_agree(name: str, begun: bool) -> None:
    one = functionals(name, begun)
    theta, at = np.random.default_rng(2).normal(size=one.variables), indices(3)
    G, offset = one.rows(*at)
    values = one.values(theta, *at)
    assert values == pytest.approx(G @ theta + offset, abs=1e-12)
    free = functionals("none")
    assert offset - one.offsets(*at) == pytest.approx(free.rows(*at)[1], abs=1e-12)
    every = np.repeat(at[1], 2, axis=0) * np.tile([1.0, -0.7], 5)[:, None]
    turned = ManyDirections(one).turning(theta, at[0], at[2])(every, np.repeat(np.arange(5), 2))
    near = 0.05 if name in ("measurable", "of two classes") else 1e-11
    assert turned[::2] == pytest.approx(values, abs=near)
    rows = one.values(theta, at[0], -0.7 * at[1], at[2])
    assert turned[1::2] == pytest.approx(rows, abs=near)
    for k in range(5):
        told = one.parts(float(at[0][k]), at[1][k], at[2][k])
        assert told.free + told.sigma == pytest.approx(offset[k], abs=1e-12)
    profile = ManyDirections(one).profile(at[0], at[1], np.zeros(0))
    assert np.diag(profile) == pytest.approx(one.offsets(*at), abs=1e-10)
    assert profile[3, 1] == pytest.approx(one.offsets(at[0][3:4], at[1][1:2], at[2][:1])[0], abs=1e-10)
    again = one.from_state(np.array([0.2, 0.1]))
    assert again.rows(*at)[1] - again.offsets(*at) == pytest.approx(
        np.array(
            [c @ expm(one.response.system.phases[0].A * t) @ [0.2, 0.1] for t, c in zip(at[0], at[1], strict=True)]
        )
    )
    assert again.measurable is one.measurable


@pytest.mark.first(2)
@pytest.mark.parametrize("name", [name for name in MODELS if name not in ("none", "measurable", "of two classes")])
def test_the_worst_disturbance_attains_what_is_said_and_no_other_exceeds_it(name: str) -> None:
    one, rng = functionals(name, begun=True), np.random.default_rng(4)
    at, model = indices(5, 3), one.disturbance
    assert model is not None
    points = one.worst_blocks(*at)
    assert points.shape[1] == model.block_count
    signals, begun = model.signals(points), one.worst_deviations(*at)
    sigma = one.offsets(*at)
    under = one.rows_under(*at, signals, begun)
    assert under[1] - functionals("none").rows(*at)[1] == pytest.approx(sigma, abs=1e-11)
    assert one.rows_under(*at, signals)[1] == pytest.approx(under[1], abs=1e-11)
    assert one.rows_under(*at, None)[1] == pytest.approx(functionals("none", begun=True).rows(*at)[1], abs=1e-11)
    assert BEGUN.contains(begun, 1e-9).all()
    for _ in range(40):
        drawn = model.signals(model.set.sample(3 * model.block_count, rng).reshape(3, model.block_count, -1))
        more = one.rows_under(*at, drawn, BEGUN.sample(3, rng))[1]
        assert (more <= under[1] + 1e-12).all()
        if name != "l1_ball":
            assert model.bound.contains(drawn.swapaxes(1, 2).reshape(-1, 2), 1e-9).all()


def test_a_disturbance_on_own_pieces_keeps_its_value_there_and_pushes_as_its_corners_do() -> None:
    one = functionals("on own pieces")
    model, breaks = one.disturbance, one.response.grid.breakpoints
    middles = (breaks[:-1] + breaks[1:]) / 2
    at = indices(6, 4)
    weights = one.response.weights(*at).disturbance
    which = [np.searchsorted(own, middles) - 1 for own in OWN]
    corners = np.array(list(product([-0.3, 0.3], [-0.3, 0.3], *[[-0.1, 0.2]] * 4)))
    signals = np.stack([corners[:, :2][:, which[0]], corners[:, 2:][:, which[1]]], axis=2)
    assert one.offsets(*at) == pytest.approx(np.einsum("kli,cli->kc", weights, signals).max(axis=1), abs=1e-13)
    worst = model.worst(weights)
    for channel, pieces in enumerate(which):
        for piece in range(pieces.max() + 1):
            assert np.ptp(worst[:, channel, pieces == piece], axis=1).max() == 0.0
    assert not model.by_piece
    assert model.block_count == 5
    held = model.held(np.array([0.1, 0.0]))
    assert held.support(weights) == pytest.approx(0.1 * weights[:, :, 0].sum(axis=1))
    assert model.held(np.zeros(2)) is None


def test_few_functions_are_not_proven_beside_measurable_disturbances() -> None:
    few = walsh(4, HORIZON, 2)
    with pytest.raises(InputError, match="fewer functions than pieces are not proven beside measurable"):
        disturbance_model(("piecewise_constant", "measurable"), TWO, few, merge_grids(few.breakpoints, few.breakpoints))


def test_of_two_classes_one_is_on_blocks_and_the_other_is_measurable() -> None:
    model = functionals("of two classes").disturbance
    assert (model.on_blocks.kind, model.on_blocks.set.dimension) == ("piecewise_constant", 2)
    c = np.array([[1.0, 0.0], [0.0, 1.0], [0.6, -2.0]])
    assert model.on_blocks.set.support(c) == pytest.approx(LINE.support(c[:, :1]))
    assert model.measurable.support(c) == pytest.approx(Box([-0.1], [0.2]).support(c[:, 1:]))
    assert functionals("box").disturbance.measurable is None and functionals("measurable").disturbance.on_blocks is None
    assert functionals("l1_ball").disturbance.radius == pytest.approx(np.hypot(0.1, 0.3))


def test_what_is_central_is_at_the_point_of_the_sets_that_is_nominal() -> None:
    one, at = functionals("box", begun=True), indices(7)
    middle, weights = one.central(), one.response.weights(*at)
    expected = weights.disturbance.sum(axis=1) @ nominal_point(BOX) + weights.free @ nominal_point(BEGUN)
    assert middle.rows(*at)[1] - functionals("none").rows(*at)[1] == pytest.approx(expected, abs=1e-12)
    assert middle.initial is None and not middle.worst_deviations(*at).any() and one.worst_deviations(*at).any()
    assert not functionals("none").offsets(*at).any() and not functionals("none").disturbed and one.disturbed


def test_a_control_that_acts_later_is_what_it_is_without_delay_on_later_times() -> None:
    """``u(t - 0.8)``, and what was commanded before until then; the last piece acts after the horizon."""
    one, at = functionals("none", delay=0.8), indices(8)
    theta = np.random.default_rng(9).normal(size=6)
    system = one.response.system
    for time, c, value in zip(at[0], at[1], one.values(theta, *at), strict=True):
        ends = np.concatenate([[0.0], GRID.breakpoints[:-1] + 0.8, [HORIZON + 0.8]])
        state = simulated(
            system.phases[0].A, [(system.phases[0].B, ends, np.append(0.4, theta)[None])], [0.7, -0.4], time, ends
        )
        assert value == pytest.approx(c @ state, abs=1e-10)
    G = one.rows(*at)[0]
    assert (G[:, 5] == 0.0).all() and G[-1, 4] != 0.0


@pytest.mark.parametrize("turns", [False, True])
def test_rows_and_flows_at_times_are_exponentials(turns: bool) -> None:
    A, B = np.array([[0.0, 1.0], [-2.0, -0.3]]), np.array([[0.3], [1.0]])
    one = LinearSystem(A, B)
    system = SwitchedSystem([(1.0, one), (HORIZON, LinearSystem(A.T, 2.0 * B))]) if turns else one
    grid = merge_grids(GRID.breakpoints, GRID.breakpoints, switches=[1.0] if turns else [])
    response = Response(system, grid, np.array([0.7, -0.4]))
    pieces, durations = np.array([0, 1, 2, 5]), np.array([0.1, 0.5, 0.0, 0.3])
    flow, driven = response.propagator.flows_in(pieces, durations)
    for piece, duration, F, D in zip(pieces, durations, flow, driven, strict=True):
        M = np.zeros((4, 4))
        M[:2, :2], M[:2, 2:] = A.T if turns and piece >= 2 else A, np.eye(2)
        M = expm(M * duration)
        assert pytest.approx(M[:2, :2], abs=1e-13) == F and pytest.approx(M[:2, 2:], abs=1e-13) == D
    assert grid.modes.tolist() == ([0, 0, 1, 1, 1, 1] if turns else [0] * 6)
    assert grid.commanded(GRID.breakpoints).tolist() == [0, 1, 2, 3, 4, 5]
    assert grid.commanded(np.array([0.0, 1.2, HORIZON])).tolist() == [0, 0, 1, 1, 1, 1]
    control, times = np.random.default_rng(10).normal(size=(1, 6)), np.array([0.0, 0.3, 1.0, 1.7, HORIZON])
    H = np.array([[1.0, 0.0], [0.5, -2.0]])
    found = OutputResponse(response.propagator, H, times, np.zeros((1, 0))).at(response, control)[0]
    for time, values in zip(times, found.T, strict=True):
        state = simulated(
            A, [(B, GRID.breakpoints, control)], [0.7, -0.4], min(time, 1.0) if turns else time, GRID.breakpoints
        )
        if turns and time > 1.0:
            state = simulated(
                A.T,
                [(2.0 * B, GRID.breakpoints[2:] - 1.0, control[:, 2:])],
                state,
                time - 1.0,
                GRID.breakpoints[2:] - 1.0,
            )
        assert values == pytest.approx(H @ state, abs=1e-11)
    if not turns:
        times, c = np.array([0.0, 0.2, 0.75, HORIZON]), np.array([[1.0, 0.5], [0.0, -2.0]])
        for grid in (response.grid, merge_grids(np.array([0.0, 0.4, HORIZON]), np.array([0.0, HORIZON]))):
            rows = Response(one, grid, np.zeros(2)).propagator.backwards(times, c, np.zeros(0))
            assert rows == pytest.approx(np.array([c @ expm(A * t) for t in times]), abs=1e-12)


def test_outputs_of_a_system_in_time_are_those_of_an_integrator() -> None:
    system = VaryingSystem.of([[0, 1], ["-(2 - 0.5*cos(3*t))", "-0.3"]], [["0.3"], ["1/(4 - t)"]], HORIZON)
    grid = merge_grids(GRID.breakpoints, GRID.breakpoints, varying=True)
    response, H = Response(system, grid, np.array([0.7, -0.4])), np.array([[1.0, 0.0], [0.5, -2.0]])
    control, times = np.random.default_rng(11).normal(size=(1, 6)), np.array([0.0, 0.3, 1.0, 1.7, 2.9])

    def rate(t, x, u):
        return [x[1] + 0.3 * u, -(2 - 0.5 * np.cos(3 * t)) * x[0] - 0.3 * x[1] + u / (4 - t)]

    states, state = {0.0: np.array([0.7, -0.4])}, np.array([0.7, -0.4])
    for begin, end, u in zip(GRID.breakpoints[:-1], GRID.breakpoints[1:], control[0], strict=True):
        inside = [time for time in times if begin < time < end]
        run = solve_ivp(rate, (begin, end), state, t_eval=[*inside, end], args=(u,), rtol=1e-11, atol=1e-12)
        states.update(zip(inside, run.y.T, strict=False))
        state = states[end] = run.y[:, -1]
    found = OutputResponse(response.propagator, H, times, np.zeros((1, 0))).at(response, control)[0]
    assert pytest.approx(np.array([H @ states[time] for time in times]), abs=1e-8) == found.T


def test_a_finer_grid_has_the_inputs_of_the_pieces_that_it_cuts() -> None:
    grid = merge_grids(np.array([0.0, 1.0, HORIZON]), np.array([0.0, HORIZON]), switches=[2.0])
    fine = grid.refined(np.array([0.0, 0.4, 1.0, 1.5, 2.0, HORIZON]))
    assert fine.control_piece.tolist() == fine.disturbance_piece.tolist() == [0, 0, 1, 1, 2]
    assert fine.mode.tolist() == [0, 0, 0, 0, 1] and grid.turns == [slice(0, 2), slice(2, 3)]
    assert merge_grids(np.array([0.0, 1.0, HORIZON]), np.array([0.0, HORIZON])).turns == [slice(0, 2)]
    leg = grid.leg(1)
    assert leg.breakpoints.tolist() == [0.0, 1.0] and leg.elapsed == 2.0 and leg.control_piece.tolist() == [1]
    assert isinstance(fine, TimeGrid)
