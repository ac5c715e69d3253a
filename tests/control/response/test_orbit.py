"""Guards states that are followed in balls: they hold the truth, their errors are rounding, and controls land."""

from __future__ import annotations

from dataclasses import replace
from decimal import Decimal, localcontext
from fractions import Fraction

import numpy as np
import pytest
from scipy.linalg import expm

from sparserob_core.control.problem.system import LinearSystem, SwitchedSystem, System
from sparserob_core.control.response.lifted import lift_legs
from sparserob_core.control.response.orbit import NOTABLE, Measure, Orbit, growth
from sparserob_core.control.response.response import Response
from sparserob_core.control.response.time_grid import TimeGrid, merge_grids
from sparserob_core.sip.convex_set import Box

RATE, DIGITS = 5, 80
SADDLE = np.array([[0.0, 1.0], [float(RATE**2), 0.0]])  # x'' = 25 x + u, which grows by e^{5 T}
PUSH = np.array([[0.0], [1.0]])
WIDE = np.full(1, -1e3), np.full(1, 1e3)


def grid_of(horizon: float, pieces: int = 40) -> TimeGrid:
    times = np.linspace(0.0, horizon, pieces + 1)
    return merge_grids(times, times)


def orbit_of(horizon: float, start: tuple[float, float] = (0.2, -0.1)) -> Orbit:
    orbit = Orbit.of(LinearSystem(SADDLE, PUSH), grid_of(horizon))
    assert orbit is not None
    return orbit.from_state(np.array(start))


def exact(orbit: Orbit, control: np.ndarray, rates: tuple[int, ...] = (RATE,)) -> list[tuple[Decimal, Decimal]]:
    """The states by ``cosh`` and ``sinh`` in eighty digits, from the very doubles of the control and its times."""
    with localcontext() as context:
        context.prec = DIGITS
        x, v = (Decimal(entry) for entry in orbit.initial_state.tolist())
        states, times = [(x, v)], [Decimal(time) for time in orbit.grid.breakpoints.tolist()]
        pieces = zip(times[:-1], times[1:], orbit.grid.modes.tolist(), control[0].tolist(), strict=True)
        for begin, end, mode, u in pieces:
            rate = rates[mode]
            up, down = ((rate * (end - begin) * sign).exp() for sign in (1, -1))
            c, s, rest = (up + down) / 2, (up - down) / 2, Decimal(u) / rate**2
            x, v = c * (x + rest) + s * v / rate - rest, rate * s * (x + rest) + c * v
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


@pytest.mark.parametrize("idle", [(), (0, 3, 7, 30)])
def test_a_control_lands_to_its_last_digits_and_what_is_0_stays_0(idle: tuple[int, ...]) -> None:
    orbit = orbit_of(5.0)
    near = _rest(orbit, idle)
    before = max(abs(float(entry)) for entry in exact(orbit, near)[-1])
    landed = orbit.landed(near, np.eye(2), np.zeros(2), WIDE)
    after = max(abs(float(entry)) for entry in exact(orbit, landed)[-1])
    assert after < 1e-14 < before and np.abs(landed - near).max() < 1e-9
    assert not landed[0, list(idle)].any() and np.count_nonzero(landed) == 40 - len(idle)


def test_a_control_without_an_entry_that_may_move_is_returned() -> None:
    orbit, nothing = orbit_of(5.0), np.zeros((1, 40))
    assert orbit.landed(nothing, np.eye(2), np.zeros(2), WIDE) is nothing


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
    orbit = Orbit.of(LinearSystem(A, B), grid_of(5.0))
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
    ],
)
def test_plants_that_do_not_grow_or_are_not_known_have_no_orbit(system: System) -> None:
    assert Orbit.of(system, grid_of(4.0)) is None


def test_growth_is_the_largest_rate_times_the_horizon() -> None:
    assert growth(LinearSystem(SADDLE, PUSH), 3.0) == pytest.approx(15.0)
    assert growth(LinearSystem(-np.eye(2), PUSH), 3.0) == 0.0
    assert Orbit.of(LinearSystem(SADDLE, PUSH), grid_of(NOTABLE / RATE * 0.99)) is None


def _rest(orbit: Orbit, idle: tuple[int, ...] = ()) -> np.ndarray:
    """A control in doubles that ends at rest but for rounding: pieces with the least sum of squares, found through the
    backward flow, in which nothing grows."""
    times = orbit.grid.breakpoints
    rows = []
    for rate in (RATE, -RATE):  # (v + rate x) e^{-rate t} changes by the integral of e^{-rate s} u
        weight = (np.exp(-rate * times[:-1]) - np.exp(-rate * times[1:])) / rate
        shift = 1.0 if rate > 0 else np.exp(rate * times[-1])
        rows.append((weight * shift, -(orbit.initial_state[1] + rate * orbit.initial_state[0]) * shift))
    matrix, wanted = np.array([row for row, _ in rows]), np.array([value for _, value in rows])
    matrix[:, list(idle)] = 0.0
    return np.asarray(np.linalg.lstsq(matrix, wanted, rcond=None)[0])[None]


def test_coordinates_of_states_are_within_their_bounds_which_no_growth_widens() -> None:
    """In the coordinates of the modes a state is rounded once: bounds at the end are as narrow as at the beginning."""
    orbit, control = orbit_of(5.0), np.random.default_rng(3).uniform(-5.0, 5.0, (1, 40))
    response = Response(LinearSystem(SADDLE, PUSH), orbit.grid, orbit.initial_state)
    (lifted,) = lift_legs(response, np.zeros(0), np.zeros(0))
    found = lifted.nodes(control)[:, 0]
    _, bounds = lifted._transform_orbit(orbit, control)
    (a, b), (c, d) = ([Fraction(entry) for entry in row] for row in lifted.transform.tolist())
    determinant = a * d - b * c
    off = []
    for (x, v), coordinates in zip(exact(orbit, control), found.tolist(), strict=True):
        truth = ((d * Fraction(x) - b * Fraction(v)) / determinant, (a * Fraction(v) - c * Fraction(x)) / determinant)
        off.append([float(abs(Fraction(got) - true)) for got, true in zip(coordinates, truth, strict=True)])
    assert lifted.starts.tolist() == [0, 1] and (np.array(off) <= bounds).all()
    assert (bounds <= 64 * 2.0**-52 * np.abs(found).max(axis=1, keepdims=True) + 1e-300).all() and np.array(off).any()


def test_bounds_on_pieces_begin_with_those_of_their_states(monkeypatch: pytest.MonkeyPatch) -> None:
    orbit = orbit_of(5.0)
    control = orbit.landed(_rest(orbit), np.eye(2), np.zeros(2), WIDE)
    response = Response(LinearSystem(SADDLE, PUSH), orbit.grid, orbit.initial_state)
    (lifted,) = lift_legs(response, np.zeros(0), np.zeros(0))
    none = np.zeros((2, lifted.starts.size))
    remainders = lifted.along(control, np.eye(2), none)
    assert remainders.max() < 1e-9
    blind = replace(lifted, orbit=None)
    assert remainders[0].max() < 1e-6 * blind.along(control, np.eye(2), none)[0].max()  # what amplifies is gone
    wide = replace(lifted)
    monkeypatch.setattr(type(wide), "_transform_orbit", lambda *_: (np.zeros((41, 2)), np.full((41, 2), 0.125)))
    assert (wide.along(control, np.eye(2), none) >= 0.125).all()


@pytest.mark.parametrize("seed", range(6))
def test_errors_grow_by_no_more_than_their_norm_says(seed: int) -> None:
    rng = np.random.default_rng(seed)
    A = rng.standard_normal((4, 4)) * np.array([1.0, 30.0, 0.1, 5.0])
    measure, scale = Measure.of(A), 1.0 + np.abs(np.linalg.eigvals(A)).max()
    inverse = np.linalg.inv(measure.transform)
    assert (np.abs(inverse) <= measure.size).all()
    for share, x in zip(rng.uniform(0.0, 3.0, 40), rng.standard_normal((40, 4)), strict=True):
        t, before = share / scale, float(np.linalg.norm(inverse @ x))
        after = expm(A * t) @ x
        bound = measure.pass_by(before, t, np.zeros(4))
        assert np.linalg.norm(inverse @ after) <= bound * (1.0 + 1e-12)
        assert (np.abs(after) <= measure.entries(bound) * (1.0 + 1e-12)).all()
        assert measure.pass_by(before, t, np.abs(x)) >= bound + float(np.linalg.norm(inverse @ x))
    fastest = max(0.0, float(np.linalg.eigvals(A).real.max()))
    assert fastest * (1.0 - 1e-9) <= measure.rate <= fastest + 1e-6 * scale


@pytest.mark.parametrize("coupling", [1.0, 100.0, 1e4])
def test_modes_that_drive_each_other_one_way_grow_no_faster(coupling: float) -> None:
    assert Measure.of(np.array([[3.0, coupling], [0.0, 3.0]])).rate <= 3.2
    assert Measure.of(np.array([[3.0, coupling, 0.0], [0.0, 3.0, coupling], [0.0, 0.0, 3.0]])).rate <= 3.5


def test_what_is_missed_counts_however_small_it_is() -> None:
    assert Measure.of(SADDLE).pass_by(0.0, 1.0, np.full(2, 1e-170)) > 0.0


def test_an_entry_that_is_0_moves_where_the_others_do_not_land() -> None:
    """One entry stops what grows, and what decays is left: a few late ones, of the size of rounding, make up for it."""
    orbit = orbit_of(4.0)
    near = _rest(orbit, tuple(range(1, 40)))
    before = max(abs(float(entry)) for entry in exact(orbit, near)[-1])
    landed = orbit.landed(near, np.eye(2), np.zeros(2), WIDE)
    after = max(abs(float(entry)) for entry in exact(orbit, landed)[-1])
    assert after < 1e-15 < 1e-10 < before < 1e-7
    assert np.flatnonzero(landed).tolist() == [0, 38, 39] and np.abs(landed[0, 1:]).max() < 1e-6


def test_a_rotated_stiff_plant_has_errors_that_do_not_grow_with_its_steps() -> None:
    """In balls every step would multiply errors by the norm of its absolute values."""
    turned = np.linalg.qr(np.random.default_rng(6).standard_normal((4, 4)))[0]
    A = (turned * [3.0, 0.0, -1.0, -2500.0]) @ turned.T
    grid = grid_of(4.0, 1531)
    orbit = Orbit.of(LinearSystem(A, turned[:, :1]), grid)
    assert orbit is not None
    control = np.random.default_rng(7).uniform(-1.0, 1.0, (1, 1531))
    states, errors = orbit.states(control)
    assert (errors <= 2.0**-51 * np.abs(states).max()).all()
    in_doubles = Response(LinearSystem(A, turned[:, :1]), grid, np.zeros(4)).states(control, np.zeros((1, 0)))[0]
    assert states == pytest.approx(in_doubles, rel=1e-9, abs=1e-9 * np.abs(states).max())


def test_phases_follow_each_other(monkeypatch: pytest.MonkeyPatch) -> None:
    slower = np.array([[0.0, 1.0], [9.0, 0.0]])
    system = SwitchedSystem([(2.0, LinearSystem(SADDLE, PUSH)), (5.0, LinearSystem(slower, PUSH))])
    times = np.linspace(0.0, 5.0, 41)
    grid, control = merge_grids(times, times, switches=(2.0,)), np.random.default_rng(5).uniform(-5.0, 5.0, (1, 40))
    response = Response(system, grid, np.array([0.2, -0.1]))
    assert response.orbit is not None
    states, errors = response.orbit.states(control)
    truth = exact(response.orbit, control, (RATE, 3))
    off = [
        [abs(Decimal(entry) - true) for entry, true in zip(*pair, strict=True)]
        for pair in zip(states.tolist(), truth, strict=True)
    ]
    assert (np.array(off, dtype=float) <= errors).all() and (errors <= 2.0**-52 * np.abs(states).max()).all()
    first, second = lift_legs(response, np.zeros(0), np.zeros(0))
    for leg, part in ((first, slice(0, 17)), (second, slice(16, 41))):
        found = leg.nodes(control)[:, 0] @ leg.transform.T
        assert found == pytest.approx(states[part], rel=1e-12)
    wide = lambda leg, *_: (np.zeros((leg.grid.pieces + 1, 2)), np.full((leg.grid.pieces + 1, 2), 0.125))  # noqa: E731
    monkeypatch.setattr(type(first), "_transform_orbit", wide)
    assert (second.along(control, np.eye(2), np.zeros((2, 2))) >= 0.125).all()


def test_every_piece_begins_anew_however_many_there_are() -> None:
    grid = grid_of(5.0, 1100)
    (lifted,) = lift_legs(Response(LinearSystem(SADDLE, PUSH), grid, np.zeros(2)), np.zeros(0), np.zeros(0))
    assert lifted.spans.size == 1100


def test_errors_count_the_radii_of_balls_with_few_bits() -> None:
    orbit, control = orbit_of(5.0), np.random.default_rng(4).uniform(-5.0, 5.0, (1, 40))
    orbit = replace(orbit, bits=60, _steps={}, _weights={})
    states, errors = orbit.states(control)
    off = np.array(
        [
            [float(abs(Decimal(found) - truth)) for found, truth in zip(row, pair, strict=True)]
            for row, pair in zip(states.tolist(), exact(orbit, control), strict=True)
        ]
    )
    assert (off <= errors).all() and (off > 0.0).any() and errors.max() > 0.5 * 2.0**-52 * np.abs(states).max()


def test_numbers_have_as_many_bits_as_the_growth_takes() -> None:
    orbit = orbit_of(40.0)  # e^200: the late pieces of a control move the end by as little as those of a short one
    landed = orbit.landed(_rest(orbit), np.eye(2), np.zeros(2), WIDE)
    _, errors = orbit.states(landed)
    assert orbit.bits > 700 and (errors <= 2.0**-52).all()
    assert (replace(orbit, bits=192, _steps={}, _weights={}, _states={}).states(landed)[1] > 1.0).any()
