"""Guards control/response/varying/expansion: transitions of systems that change with time, against closed forms and an
integrator in fifty digits, and the bound of their error where the series are cut short."""

from __future__ import annotations

from dataclasses import replace
from decimal import Decimal

import numpy as np
import pytest
from scipy.integrate import solve_ivp

import sparserob_core.control.response.varying.expansion as varying
from sparserob_core.control.problem.system import VaryingSystem
from sparserob_core.control.response.response import Response
from sparserob_core.control.response.time_grid import merge_grids
from sparserob_core.control.response.varying.expansion import Expansion, Flow, balanced, steadied
from sparserob_core.control.response.varying.spread import law_of
from sparserob_core.control.sets.sets import Box
from sparserob_core.errors import InputError
from sparserob_core.sip.convex_set import Array
from tests.support.integration import mathieu

FADING = VaryingSystem.of([["-1/(1 + t)"]], [["t", 1]], 3.0, [["exp(-t)"]])
TURNING = VaryingSystem.of([[0, "1 + t"], ["-(1 + t)", 0]], [[0], [1]], 4.0)
BESIDE = VaryingSystem.of(
    [["-1/(1 + t)", 0], [0, "0*t"]], [["t*2^-20", "2^-20"], [1, 1]], 3.0, E=[["2^-20*exp(-t)"], [1]]
)
SHARP = 1e-12  # the error of a flow that nothing was left out of
STARTS, STOPS = np.array([0.0, 0.5, 1.9, 0.0, 2.0]), np.array([0.1, 1.75, 2.0, 3.0, 2.0])


def fading(starts: Array, stops: Array) -> Flow:
    """The exact flow of ``FADING``: ``(1 + t) x`` is the integral of ``(1 + t)`` times what drives it."""
    left, right = 1 + starts, 1 + stops
    control = np.stack([(right**3 - left**3) / 3 - (right**2 - left**2) / 2, (right**2 - left**2) / 2], axis=1)
    pushed = -np.exp(-stops) * (2 + stops) + np.exp(-starts) * (2 + starts)
    exact = (left / right)[:, None, None], control[:, None] / right[:, None, None], (pushed / right)[:, None, None]
    return Flow(*exact, np.zeros_like(left), np.zeros((left.size, 1, 2)))


def test_a_flow_is_the_closed_form() -> None:
    found, exact = Expansion.of(FADING).flow(STARTS, STOPS), fading(STARTS, STOPS)
    for mine, other in zip(found[:3], exact[:3], strict=True):
        np.testing.assert_allclose(mine, other, rtol=1e-13, atol=1e-15)
    assert (found.error < SHARP).all() and found.error[4] == 0.0


def test_parameters_of_inputs_alone_share_one_series(monkeypatch: pytest.MonkeyPatch) -> None:
    system = VaryingSystem.of(
        [[0, "1 + t"], ["-(1 + t)", 0]], [["p^2", "q*t"], [1, "2 - p"]], 4.0, [["q"], ["p*q"]],
        parameters=Box([-0.5, 1.0], [0.5, 3.0]), names=["p", "q"],
    )  # fmt: skip
    law, summed = law_of(system), list[int]()
    points = np.random.default_rng(1).uniform([-0.5, 1.0], [0.5, 3.0], (7, 2))
    known = [Expansion.of(system.at(point)).flow(STARTS, STOPS) for point in points]
    sum_series = Expansion._sum_series
    monkeypatch.setattr(
        Expansion, "_sum_series", lambda self, A, *rest: summed.append(len(A)) or sum_series(self, A, *rest)
    )
    state, inputs = law.over(STARTS, STOPS, points)
    np.testing.assert_allclose(state, [flow.state for flow in known], atol=2e-14)
    np.testing.assert_allclose(
        inputs, [np.concatenate([flow.control, flow.disturbance], axis=2) for flow in known], rtol=0, atol=2e-13
    )
    solved = sum(summed)
    assert solved <= STARTS.size * (law.expansions[0].ends.size - 1)  # as for one parameter
    rows = np.array([2, 0, 1])
    along = law.along(STARTS[rows], STOPS[rows], points[rows])
    for mine, every in zip(along, (state, inputs), strict=True):
        np.testing.assert_allclose(mine, every[rows, rows], atol=1e-14)
    assert sum(summed) - solved <= rows.size * (law.expansions[0].ends.size - 1)
    law.over(STARTS, STOPS, points[:2] + 0.01)
    assert sum(summed) - solved <= rows.size * (law.expansions[0].ends.size - 1)  # nothing more


def test_a_rotation_of_growing_speed_turns_by_its_integral() -> None:
    found = Expansion.of(TURNING).flow(np.array([0.0, 1.0]), np.array([4.0, 2.5]))
    for state, angle in zip(found.state, (4 + 8, 1.5 + (2.5**2 - 1) / 2), strict=True):
        exact = [[np.cos(angle), np.sin(angle)], [-np.sin(angle), np.cos(angle)]]
        np.testing.assert_allclose(state, exact, atol=2e-14)


def test_mathieus_equation_agrees_with_fifty_digits() -> None:
    system = VaryingSystem.of([[0, 1], ["-(a - 2*q*cos(2*t))", 0]], [[0], [1]], 3.0, define={"a": 1.5, "q": 0.4})
    found = Expansion.of(system).flow(np.zeros(1), np.array([3.0])).state[0]
    np.testing.assert_allclose(found, mathieu("1.5", "0.4", Decimal(3)), rtol=0, atol=4e-15)


@pytest.mark.parametrize(
    ("name", "value"),
    [("TERMS", 3), ("TERMS", 6), ("DEGREE", 2), ("DEGREE", 4), ("IDLE", 1e-4)],
    ids=["3", "6", "degree 2", "degree 4", "idle"],
)
def test_the_error_holds_what_is_left_out(name: str, value: int, monkeypatch: pytest.MonkeyPatch) -> None:
    # coarse on purpose: the solution or the system is cut short, and the bound must say by how much
    for rough in ("SHARPEST", "BLUNTEST"):
        monkeypatch.setattr(varying, rough, 1.0)
    monkeypatch.setattr(varying, name, value)
    expansion = Expansion._expand_system(FADING)
    starts = np.repeat(np.linspace(0.0, 2.9, 30), 30)
    stops = starts + np.tile(np.linspace(0.0, 1.0, 30), 30) * (3.0 - starts)
    found, exact = expansion.flow(starts, stops), fading(starts, stops)
    off = np.abs(found.state - exact.state)[:, 0, 0]
    assert off.max() > 1e-9, "nothing was left out"
    assert (off <= found.error + 1e-15).all()
    driven = np.abs(np.concatenate([found.control - exact.control, found.disturbance - exact.disturbance], axis=2))[
        :, 0
    ]
    assert (driven <= found.error[:, None] * found.sizes[:, 0] + 1e-15).all()


def test_what_nothing_couples_is_bounded_apart(monkeypatch: pytest.MonkeyPatch) -> None:
    """The error of a state is a share of what drives it, not of what drives one that is a million times larger."""
    monkeypatch.setattr(varying, "TERMS", 6)
    small, one, both = 2.0**-20, Expansion._expand_system(FADING), Expansion._expand_system(BESIDE)
    assert [part.tolist() for part in both.together] == [[0], [1]]
    alone, found, exact = one.flow(STARTS, STOPS), both.flow(STARTS, STOPS), fading(STARTS, STOPS)
    sizes = found.sizes * both.units[:, None]
    np.testing.assert_allclose(sizes[:, 0], small * alone.sizes[:, 0] * one.units, rtol=1e-12)
    np.testing.assert_allclose(sizes[:, 1], np.tile((STOPS - STARTS)[:, None], 3), rtol=1e-12)
    off = np.abs(found.control[:, 0] - small * exact.control[:, 0])
    assert off.max() > 1e-7 * small, "nothing was left out"
    assert (off <= found.error[:, None] * sizes[:, 0, :2] + 1e-15 * small).all()


def test_a_remainder_of_what_drives_nothing_is_held_too() -> None:
    """``sin(t) - sin(t)`` beside 1: no coefficient is left of it, only what they may be off by."""
    expansion = Expansion._expand_system(VaryingSystem.of([[0, 0], [0, 0]], [["sin(t) - sin(t)"], [1]], 2.0))
    flow = expansion.flow(np.zeros(1), np.array([2.0]))
    lost = float((expansion.remainder[:, 0, 2] * np.diff(expansion.ends)).sum())
    assert 0.0 < lost <= flow.error[0] * flow.sizes[0, 0, 0] * expansion.units[0]
    assert flow.error[0] <= 1e-9


@pytest.mark.first(2)
@pytest.mark.parametrize(
    ("entry", "said"),
    [
        ("1/(t - 1.3)", r"near t = 1\.(29999|30000)"),
        ("sqrt(abs1 * (1.7 - t))", "near t = 1.[67]|A is not finite at t = 2"),
        ("tan(t)", r"near t = 1\.570[78]"),
        ("log(t - 0.5)", "A is not finite at t = 0"),
    ],
)
def test_a_pole_within_the_horizon_is_told_with_its_time(entry: str, said: str) -> None:
    with pytest.raises(InputError, match=said):
        Expansion.of(VaryingSystem.of([[entry]], [[1]], 2.0, define={"abs1": 1}))


def test_the_expansion_in_other_units_is_the_same_system() -> None:
    d, m = 2, 1
    states, time = np.array([4.0, 0.25]), 8.0
    rate = time / states[:, None]
    moved = TURNING.in_units(rate * states, np.full((d, m), 2.0) * rate, rate * np.ones(d), np.zeros(0), 1.0, time)
    found = Expansion.of(moved).flow(np.array([0.0]), np.array([0.5]))
    plain = Expansion.of(TURNING).flow(np.array([0.0]), np.array([4.0]))
    np.testing.assert_allclose(found.state[0] * states[:, None] / states, plain.state[0], rtol=1e-14, atol=1e-15)
    np.testing.assert_allclose(found.control[0] * states[:, None] / 2.0, plain.control[0], rtol=1e-14, atol=1e-15)


def test_rows_at_any_time_are_those_of_the_states() -> None:
    control = np.array([0.0, 0.7, 1.5, 3.0])
    grid = merge_grids(control, np.array([0.0, 1.0, 3.0]), varying=True)
    response = Response(FADING, grid, np.array([2.0]))
    u = np.array([[1.0, -0.5, 0.25], [0.5, 2.0, -1.0]])
    times = np.array([0.3, 0.7, 1.9, 3.0])
    rows = response.weights(times, np.ones((4, 1)), np.zeros((4, 0)))
    found = rows.free @ response.initial_state + np.einsum("klm,ml->k", rows.control, grid.inputs(u))
    exact = []
    for t in times:
        x = 2.0
        for k in range(3):
            if control[k] < t:
                step = fading(control[k : k + 1], np.minimum(control[k + 1 : k + 2], t))
                x = float((step.state[0] * x + step.control[0] @ u[:, k])[0, 0])
        exact.append(x)
    np.testing.assert_allclose(found, exact, rtol=1e-13)
    fine = Response(FADING, grid.refined(np.union1d(grid.breakpoints, times)), np.array([2.0]))
    states = fine.states(u[:, grid.control_piece], np.zeros((1, 0)))[0, :, 0]
    np.testing.assert_allclose(states[np.searchsorted(fine.grid.breakpoints, times)], exact, rtol=1e-13)


@pytest.mark.parametrize("seed", range(3))
def test_units_are_those_in_which_rows_and_columns_are_of_like_size(seed: int) -> None:
    """Whatever units a matrix is written in; the same up to a common factor where one state is written in others."""
    rng = np.random.default_rng(seed)
    plain = rng.uniform(0.5, 2.0, size=(4, 4)) * rng.choice([-1.0, 1.0], size=(4, 4))
    written = np.exp2(rng.integers(-12, 12, size=4))
    A = plain * written[:, None] / written
    units = balanced(A, 1.0)
    assert (np.log2(units) % 1.0 == 0.0).all()
    moved = np.abs(A) * units / units[:, None]
    np.fill_diagonal(moved, 0.0)
    assert (moved.max(axis=1) <= 4.0 * moved.max(axis=0)).all() and (moved.max(axis=0) <= 4.0 * moved.max(axis=1)).all()
    assert np.abs(np.log2(units / written) - np.log2(units / written).mean()).max() <= 2.0
    # a state that reaches others, and that no other one reaches, is no state of infinite or no size
    one_way = np.triu(A)
    assert np.isfinite(balanced(one_way, 1.0)).all() and (balanced(np.zeros((2, 2)), 1.0) == 1.0).all()


def eccentric(e: float) -> VaryingSystem:
    """A pendulum whose stiffness is that of an orbit of this eccentricity, from one apocentre to the next."""
    return VaryingSystem.of(
        [[0, 1], [f"-1 / (1 - {e} * cos(kepler(t, {e})))^3", 0]], [[0], [1]], 2 * np.pi - 0.01, [["exp(-t)"], [0]]
    )


@pytest.mark.slow
def test_a_slow_part_is_looked_at_in_units_of_its_own() -> None:
    system = eccentric(0.9)
    expansion = Expansion._expand_system(system)
    assert expansion.ratios.max() >= 8.0 and expansion.ends.size < 140  # 146 in the units of the pericentre
    slow = np.flatnonzero(expansion.ratios.max(axis=1) > 1.0)[::8]
    starts = np.append(expansion.ends[slow], np.linspace(0.0, 4.0, 3))
    stops = np.append(expansion.ends[slow + 1], np.linspace(2.0, system.horizon, 3))
    found, units = expansion.flow(starts, stops), expansion.units
    inputs = np.concatenate([found.control, found.disturbance], axis=2)
    for k, ends in enumerate(zip(starts, stops, strict=True)):
        off = np.abs(np.column_stack([found.state[k], inputs[k]]) - integrated(system, *ends)) / units[:, None]
        off = np.maximum(off - 1e-12, 0.0)  # which is the integrator's
        assert (off[:, :2] * units).sum(axis=1).max() <= found.error[k]
        assert (off[:, 2:] <= found.error[k] * found.sizes[k]).all()


def test_what_a_slow_part_misses_is_counted_in_the_units_of_all(monkeypatch: pytest.MonkeyPatch) -> None:
    fast, A = 1024.0, np.array([[0.0, 1024.0], [-0.05 / 1024.0, 0.0]])
    law = np.zeros((1, varying.DEGREE + 1, 2, 4))
    law[0, 0] = np.column_stack([A, [0.0, 1.0], [1.0, 0.0]]) / 2
    ratios = steadied(A / 2, 1.0)
    assert ratios is not None and ratios[0] > fast
    expansion = Expansion(np.array([0.0, 1.0]), law, np.zeros((1, 2, 4)), np.ones(2), ratios[None], (1, 1))
    monkeypatch.setattr(varying, "TERMS", 1)
    found = expansion.flow(np.zeros(1), np.ones(1))
    state, driven = np.eye(2), np.zeros((2, 2))
    for n in range(20, 0, -1):  # Horner's scheme of the exponential and of its integral
        state, driven = np.eye(2) + A / 2 @ state / n, (law[0, 0, :, 2:] + A / 2 @ driven) / n if n > 1 else driven
    off = np.abs(found.state[0] - state).sum(axis=1).max() / found.error[0]
    assert off <= 1.0 < off * ratios.max()  # without the ratio the bound would not hold


def test_units_of_a_slow_part_make_it_small() -> None:
    A = np.array([[0.0, 8.0], [1e-3, 0.0]])
    units = steadied(A, 1.0)
    assert units is not None and units.min() >= 1.0 and (A @ units <= 2 * varying.SLOW * units).all()
    assert steadied(A, 10.0) is None and steadied(np.array([[0.0, 1.0], [1.0, 0.0]]), 1.0) is None


def integrated(system: VaryingSystem, start: float, stop: float) -> Array:
    """What an interval makes of a state and of inputs, by an integrator."""

    def rates(t: float, values: Array) -> Array:
        A, B, E = (part[0] for part in system.phases[0].matrices(np.array([[t]])))
        return np.asarray(A @ values.reshape(2, -1) + np.column_stack([np.zeros((2, 2)), B, E])).ravel()

    first = np.column_stack([np.eye(2), np.zeros((2, 2))]).ravel()
    found = solve_ivp(rates, (start, stop), first, method="DOP853", rtol=1e-13, atol=1e-13)
    return np.asarray(found.y[:, -1].reshape(2, -1))


def test_orders_of_time_that_no_entry_has_are_left_out_and_change_nothing() -> None:
    squared = VaryingSystem.of([["-1", "t^2"], [0, "0*t"]], [[1], ["t"]], 3.0)
    expansion, constant = Expansion.of(squared), Expansion.of(VaryingSystem.of([["0*t - 1"]], [[1]], 3.0))
    assert (constant.orders, expansion.orders, Expansion.of(FADING).orders) == (1, 3, varying.DEGREE + 1)
    padding = [(0, 0), (0, varying.DEGREE + 1 - expansion.orders), (0, 0), (0, 0)]
    padded = replace(expansion, coefficients=np.pad(expansion.coefficients, padding))
    starts, stops = expansion.ends[:-1], expansion.ends[1:]
    for short, long in (
        (expansion.flow(starts, stops), padded.flow(starts, stops)),
        (expansion.kernel(starts, stops), padded.kernel(starts, stops)),
    ):
        assert (short.error <= long.error).all()  # fewer operations round less
        for mine, other in zip(short._replace(error=0.0), long._replace(error=0.0), strict=True):
            np.testing.assert_allclose(mine, other, rtol=1e-12, atol=1e-14)
    for mine, other in zip(expansion.at(starts), padded.at(starts), strict=True):
        np.testing.assert_allclose(mine, other, atol=1e-15)
