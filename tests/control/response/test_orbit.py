"""Guards states that are followed in balls: they hold the truth, their errors are rounding, and controls land."""

from __future__ import annotations

from decimal import Decimal, localcontext

import numpy as np
import pytest

from sparserob_core.control.problem.system import LinearSystem, SwitchedSystem, System
from sparserob_core.control.response.orbit import NOTABLE, Orbit, growth
from sparserob_core.control.response.response import Response, TimeGrid, merge_grids
from sparserob_core.sip.convex_set import Box

RATE, DIGITS = 5, 80
SADDLE = np.array([[0.0, 1.0], [float(RATE**2), 0.0]])  # x'' = 25 x + u, which grows by e^{5 T}
PUSH = np.array([[0.0], [1.0]])
WIDE = np.full(1, -1e3), np.full(1, 1e3)


def grid_of(horizon: float, pieces: int = 40) -> TimeGrid:
    times = np.linspace(0.0, horizon, pieces + 1)
    return merge_grids(times, times)


def orbit_of(horizon: float, start: tuple[float, float] = (0.2, -0.1)) -> Orbit:
    orbit = Orbit.of(LinearSystem(SADDLE, PUSH), grid_of(horizon), np.array(start))
    assert orbit is not None
    return orbit


def exact(orbit: Orbit, control: np.ndarray) -> list[tuple[Decimal, Decimal]]:
    """The states by ``cosh`` and ``sinh`` in eighty digits, from the very doubles of the control and its times."""
    with localcontext() as context:
        context.prec = DIGITS
        x, v = (Decimal(entry) for entry in orbit.initial_state.tolist())
        states, times = [(x, v)], [Decimal(time) for time in orbit.grid.breakpoints.tolist()]
        for begin, end, u in zip(times[:-1], times[1:], control[0].tolist(), strict=True):
            up, down = ((RATE * (end - begin) * sign).exp() for sign in (1, -1))
            c, s, rest = (up + down) / 2, (up - down) / 2, Decimal(u) / RATE**2
            x, v = c * (x + rest) + s * v / RATE - rest, RATE * s * (x + rest) + c * v
            states.append((x, v))
        return states


@pytest.mark.parametrize("horizon", [4.0, 6.0, 12.0])
def test_states_are_within_their_errors_which_are_rounding(horizon: float) -> None:
    orbit, control = orbit_of(horizon), np.random.default_rng(0).uniform(-5.0, 5.0, (1, 40))
    states, errors = orbit.states(control)
    off = [
        [abs(Decimal(float(found)) - truth) for found, truth in zip(row, pair, strict=True)]
        for row, pair in zip(states, exact(orbit, control), strict=True)
    ]
    assert all(
        far <= Decimal(float(most))
        for row, mosts in zip(off, errors, strict=True)
        for far, most in zip(row, mosts, strict=True)
    )
    assert max(float(far) for row in off for far in row) > 0.1 * float(errors.max())  # no larger than they need be
    assert (errors <= 2.0**-52 * np.abs(states).max()).all()


def test_doubles_alone_lose_what_the_plant_amplifies() -> None:
    """The reason for more digits: the recursion in doubles ends where the control does not."""
    orbit, control = orbit_of(6.0), np.random.default_rng(0).uniform(-5.0, 5.0, (1, 40))
    landed = orbit.landed(control * 0.0 + _rest(orbit), np.eye(2), np.zeros(2), WIDE)
    x, v = (float(entry) for entry in exact(orbit, landed)[-1])
    response = Response(LinearSystem(SADDLE, PUSH), orbit.grid, orbit.initial_state)
    in_doubles = response.states(landed, np.zeros((1, 0)))[0, -1]
    assert max(abs(x), abs(v)) < 1e-14 < 1e-6 < np.abs(in_doubles).max()
    assert response.nodes(landed, np.zeros((1, 0)))[0, -1] == pytest.approx([x, v], abs=1e-16)


def test_a_control_lands_to_its_last_digits_and_what_is_0_stays_0() -> None:
    orbit = orbit_of(5.0)
    control = _rest(orbit)
    control[0, [3, 7, 30]] = 0.0
    control = orbit.landed(control, np.eye(2), np.array([0.0, 0.0]), WIDE)  # too far off: returned as it is
    assert (control == np.where(control == 0.0, 0.0, control)).all() and not control[0, [3, 7, 30]].any()
    near = _rest(orbit)
    before = max(abs(float(entry)) for entry in exact(orbit, near)[-1])
    landed = orbit.landed(near, np.eye(2), np.zeros(2), WIDE)
    after = max(abs(float(entry)) for entry in exact(orbit, landed)[-1])
    assert after < 1e-14 < before and np.abs(landed - near).max() < 1e-9


def test_a_control_that_misses_by_more_than_rounding_is_returned() -> None:
    orbit, control = orbit_of(5.0), np.ones((1, 40))
    assert orbit.landed(control, np.eye(2), np.zeros(2), WIDE) is control


def test_entries_at_their_limits_do_not_move() -> None:
    orbit, near = orbit_of(5.0), _rest(orbit_of(5.0))
    limits = np.full(1, near.min()), np.full(1, near.max())
    landed = orbit.landed(near, np.eye(2), np.zeros(2), limits)
    ends = (near == near.min()) | (near == near.max())
    assert (landed[ends] == near[ends]).all() and (landed >= limits[0]).all() and (landed <= limits[1]).all()
    assert max(abs(float(entry)) for entry in exact(orbit, landed)[-1]) < 1e-14


def test_entries_that_no_control_reaches_are_left_alone() -> None:
    """Of two plants side by side the second has no input: its rows are 0, and no control can land it."""
    A, B = np.kron(np.eye(2), SADDLE), np.vstack([PUSH, 0.0 * PUSH])
    orbit = Orbit.of(LinearSystem(A, B), grid_of(5.0), np.zeros(4))
    assert orbit is not None
    control = np.zeros((1, 40))
    control[0, :3] = 1e-3
    landed = orbit.landed(control, np.eye(4)[2:], np.zeros(2), WIDE)
    assert (landed == control).all()


@pytest.mark.parametrize(
    "system",
    [
        LinearSystem([[-1.0]], [[1.0]]),
        LinearSystem([[0.0, 1.0], [0.0, 0.0]], [[0.0], [1.0]]),
        LinearSystem(lambda p: np.array([[5.0 + p[0]]]), [[1.0]], parameters=Box([-0.1], [0.1])),
        SwitchedSystem([(2.0, LinearSystem([[5.0]], [[1.0]])), (4.0, LinearSystem([[4.0]], [[1.0]]))]),
    ],
)
def test_plants_that_do_not_grow_or_are_not_one_known_plant_have_no_orbit(system: System) -> None:
    assert Orbit.of(system, grid_of(4.0), np.zeros(system.states)) is None


def test_growth_is_the_largest_rate_times_the_horizon() -> None:
    assert growth(LinearSystem(SADDLE, PUSH), 3.0) == pytest.approx(15.0)
    assert growth(LinearSystem(-np.eye(2), PUSH), 3.0) == 0.0
    assert Orbit.of(LinearSystem(SADDLE, PUSH), grid_of(NOTABLE / RATE * 0.99), np.zeros(2)) is None


def _rest(orbit: Orbit) -> np.ndarray:
    """A control in doubles that ends at rest but for rounding: pieces with the least sum of squares, found through the
    backward flow, in which nothing grows."""
    times = orbit.grid.breakpoints
    rows = []
    for rate in (RATE, -RATE):  # (v + rate x) e^{-rate t} changes by the integral of e^{-rate s} u
        weight = (np.exp(-rate * times[:-1]) - np.exp(-rate * times[1:])) / rate
        shift = 1.0 if rate > 0 else np.exp(rate * times[-1])
        rows.append((weight * shift, -(orbit.initial_state[1] + rate * orbit.initial_state[0]) * shift))
    matrix, wanted = np.array([row for row, _ in rows]), np.array([value for _, value in rows])
    return np.asarray(np.linalg.lstsq(matrix, wanted, rcond=None)[0])[None]
