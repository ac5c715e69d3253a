"""Guards control/feedback/closed_loop, loop_bounds and loop_rows: the state and its responses are those of the loop as
it is defined, and their enclosures over cells of time are above every time in them, by no more than a curvature
owes."""

from __future__ import annotations

import dataclasses
from functools import cache
from itertools import pairwise

import numpy as np
import pytest

import sparserob_core as sr
import sparserob_core.control.response.varying.expansion as expansion
from sparserob_core.control.feedback.loop_bounds import LoopBounds
from sparserob_core.control.feedback.loop_rows import LoopRows, shared
from sparserob_core.control.response.varying.expansion import Expansion
from sparserob_core.control.transcription.transcribe import prepare
from tests.support.closed_loops import EXACT, LOOPS, STILL, Loop

H = np.array([[1.0, 0.0], [0.0, -1.0], [0.6, 0.8], [-1.0, 0.3]])


@cache
def made(name):
    """The loop of the package, a decision, and the loop that is stepped here with the gains of that decision."""
    case = LOOPS[name]
    model = prepare(case.problem, *case.grids, policy=sr.AffinePolicy())
    loop = model.feedback.loop
    rng = np.random.default_rng(1)
    x = np.zeros(model.program.n)
    x[: loop.nominal_size] = rng.uniform(-1, 1, size=loop.nominal_size)
    if loop.observer is not None:
        case = dataclasses.replace(case, observer=loop.observer.L)
    answers = loop.answers.variables
    x[loop.nominal_size : loop.nominal_size + answers] = 0.2 * rng.normal(size=answers)
    return case, loop, x


@cache
def stepped(name):
    """Dense times, the state with its responses and their rates there, and the controls."""
    case, loop, x = made(name)
    times = np.unique(np.concatenate([np.linspace(0.0, 2.0, 401), case.grid]))
    return times, *case.states(loop.nominal(x), loop.gains(x), times)


def cells(case: Loop, widths=(1.0, 0.3, 0.01)):
    """Cells of several widths, each within a piece of the grid, and of what a system in t is one polynomial on."""
    rng, found, ends = np.random.default_rng(2), [], case.grid
    if case.system.varies:
        ends = np.unique(np.append(ends, Expansion.of(case.system).ends))
    for start, stop in pairwise(ends.tolist()):
        for share in widths:
            low = start + rng.uniform(0.0, 1.0 - share) * (stop - start)
            found.append((low, low + share * (stop - start)))
    return np.array(found).T


@pytest.mark.first(3)
@pytest.mark.parametrize("name", EXACT)
def test_the_state_and_every_response_are_those_of_a_loop_that_measures(name):
    case, loop, x = made(name)
    times, states, _, controls = stepped(name)
    assert loop.states(x, times) == pytest.approx(states, abs=1e-9)
    assert loop.controls(x) == pytest.approx(controls, abs=1e-9)
    assert loop.values(x, times, H) == pytest.approx(case.height(H @ states), abs=1e-9)
    deviation = loop.worst(x, float(times[250]), H[2])
    along = H[2] @ states[250]
    assert along[0] + along[1:] @ deviation == pytest.approx(case.height(along), abs=1e-9)
    assert loop.spread.radii == pytest.approx(case.radii, rel=1e-12)


@pytest.mark.parametrize("name", EXACT)
def test_bounds_over_cells_are_above_every_time_in_them(name):
    case, loop, x = made(name)
    lower, upper = cells(case)
    bounds, _ = LoopBounds(loop).over_cells(x, lower, upper, H)
    times = lower[:, None] + np.linspace(0.0, 1.0 - 1e-12, 41) * (upper - lower)[:, None]
    states = case.states(loop.nominal(x), loop.gains(x), times.ravel())[0]
    heights = case.height(H @ states).reshape(*times.shape, -1)
    assert (heights.max(axis=1) <= bounds + 1e-12).all()
    narrow = (upper - lower) <= 0.0101
    assert (bounds - heights.max(axis=1))[narrow].max() < 0.02
    # at a point nothing is added but rounding
    inside = (case.grid[:-1] + case.grid[1:]) / 2
    points = LoopBounds(loop).over_cells(x, inside, inside, H)[0]
    states = case.states(loop.nominal(x), loop.gains(x), inside)[0]
    assert points == pytest.approx(case.height(H @ states), abs=1e-10)
    assert (points >= case.height(H @ states) - 1e-12).all()


@pytest.mark.parametrize("name", STILL)
def test_what_a_cell_adds_to_its_chord_is_an_eighth_of_its_square_times_the_curvature(name):
    """At least the largest second derivative of everything that deviates, sampled; at most little more on short
    cells, and no less on cells on which the expansion does not converge at once."""
    case, loop, x = made(name)
    lower, upper = cells(case, (1.0, 0.6, 0.1, 0.005))
    _, late = LoopBounds(loop).over_cells(x, lower, upper, H)
    h = upper - lower
    times = lower[:, None] + np.linspace(0.0, 1.0 - 1e-12, 41) * h[:, None]
    rates = case.states(loop.nominal(x), loop.gains(x), times.ravel())[1]
    second = np.abs(H @ case.A @ rates).reshape(*times.shape, len(H), -1).max(axis=1)
    owed = (h**2 / 8.0)[:, None] * (second @ np.concatenate([[1.0], case.radii]))
    assert (late >= owed * (1.0 - 1e-9)).all()
    short = np.linalg.norm(case.A, 2) * h < 0.05
    assert short.any()
    assert (late[short] <= 1.1 * owed[short] + 1e-12).all()


@pytest.mark.first(1)
@pytest.mark.parametrize("name", ["begun", "level"])
def test_a_bound_is_reached_where_the_curvature_is_constant(name):
    """The double integrator between two breakpoints, in the direction in which both ends of a cell are level: a
    parabola, whose peak is its chord and ``h^2/8`` of its acceleration."""
    _, loop, x = made(name)
    x = x.copy()
    x[loop.nominal_size :] = 0.0
    x[: loop.nominal_size] = [-3.0, -2.0, -1.0]
    for low, high in ((0.26, 0.49), (0.76, 0.99), (1.51, 1.74)):
        times = np.linspace(low, high, 1001)
        states = loop.states(x, times)[..., 0]
        fall = (states[-1, 0] - states[0, 0]) / (states[-1, 1] - states[0, 1])
        row = np.array([[1.0, -fall]])
        still = loop.scaled(1e-12) if loop.scales else loop
        (bound,) = LoopBounds(still).over_cells(x, np.array([low]), np.array([high]), row)[0][0]
        assert states[0] @ row[0] == pytest.approx(states[-1] @ row[0])
        assert bound == pytest.approx((states @ row[0]).max(), abs=1e-6)
        assert bound >= (states @ row[0]).max() - 1e-13


@pytest.mark.parametrize("name", EXACT)
def test_what_stands_beside_the_state_is_added_at_both_ends(name):
    case, loop, x = made(name)
    lower, upper = cells(case, (0.7, 0.05))
    rng, size = np.random.default_rng(4), 1 + loop.spread.size
    whole = rng.normal(size=(2, lower.size, len(H), size))
    for beside in (whole, whole[..., :1]):
        bounds, late = LoopBounds(loop).over_cells(x, lower, upper, H, (beside[0], beside[1]))
        share = np.linspace(0.0, 1.0 - 1e-12, 21)
        times = lower[:, None] + share * (upper - lower)[:, None]
        along = H @ case.states(loop.nominal(x), loop.gains(x), times.ravel())[0]
        along = along.reshape(*times.shape, len(H), size)
        more = beside[0][:, None] + share[:, None, None] * (beside[1] - beside[0])[:, None]
        along[..., : more.shape[-1]] += more
        heights = case.height(along)
        assert (heights.max(axis=1) <= bounds + 1e-12).all()
        lost = 1e-9 if name in STILL else 1e-7  # what the expansion of a system in t leaves out
        assert (bounds <= np.maximum(heights[:, 0], heights[:, -1]) + late + lost).all()
        assert (late == LoopBounds(loop).over_cells(x, lower, upper, H)[1]).all()


def test_a_loop_whose_deviations_are_larger_is_that_loop_with_larger_sets():
    _, loop, x = made("box")
    times = np.linspace(0.0, 2.0, 9)
    twice = loop.scaled(2.0)
    assert loop.scales and not made("ball and begun")[1].scales
    along = H @ loop.states(x, times)
    assert twice.spread.radii == pytest.approx(2.0 * loop.spread.radii)
    middle = along[..., 1:] @ loop.spread.middle
    assert twice.spread.support(along[..., 1:]) == pytest.approx(
        2.0 * loop.spread.support(along[..., 1:]) + 0.0 * middle
    )


@pytest.mark.first(5)
@pytest.mark.parametrize("name", LOOPS)
def test_uncertain_rows_are_violated_by_the_worst_case_of_the_state_and_of_the_control_beside_it(name):
    """Rows that look the same way or opposite ways share their answers."""
    case, loop, x = made(name)
    rng, rows = np.random.default_rng(5), np.vstack([H, 2.0 * H[:1], -H[:2]])
    h = rng.normal(size=len(rows))
    part, factor = shared(rows, loop.spread)
    assert part[4] == part[0] and factor[4] == 2.0
    assert (part[5] == part[0]) == loop.spread.is_symmetric
    for p in range(part.max() + 1):
        first = int(np.flatnonzero(part == p)[0])
        assert (rows[part == p] == factor[part == p][:, None] * rows[first]).all()
    for time in (0.0, 0.3, float(case.breakpoints[1]), 1.7, 2.0):
        told = LoopRows(loop).of_state(time, rows, h, part, factor).excess(x, loop.spread)
        assert told == pytest.approx(loop.values(x, np.array([time]), rows)[0] - h, abs=1e-9)
    m = case.B.shape[1]
    G = rng.normal(size=(len(H), m))
    every = loop.controls(x)
    for k in range(case.breakpoints.size - 1):
        u = LoopRows(loop).of_control(k, G, h[: len(H)], None).excess(x, loop.spread)
        assert u == pytest.approx(loop.height(G @ every[k]) - h[: len(H)], abs=1e-9)
        time = float(case.breakpoints[k : k + 2].mean())
        own = np.arange(len(H))
        plain = LoopRows(loop).of_state(time, H, h[: len(H)], own, np.ones(len(H)))
        both = LoopRows(loop).with_control(plain, G, np.full(len(H), k)).excess(x, loop.spread)
        along = H @ loop.states(x, np.array([time]))[0] + G @ every[k]
        assert both == pytest.approx(loop.height(along) - h[: len(H)], abs=1e-9)


@pytest.mark.first(5)
@pytest.mark.parametrize("name", LOOPS)
def test_the_signal_of_the_worst_deviation_takes_the_state_there(name):
    """Stepped with the gains of the decision, from where the deviation begins, under the signal that has it."""
    case, loop, x = made(name)
    if case.bound is None:
        return
    for time, c in ((1.7, H[2]), (2.0, H[3])):
        deviation = loop.worst(x, time, c)
        ends, values = loop.functionals.response.grid.breakpoints, loop.signal(deviation)
        assert values.shape == (case.E.shape[1], ends.size - 1)
        assert all(case.bound.contains(w[None], 1e-9)[0] for w in values.T)
        begun = loop.compute_initial_state(deviation)
        if case.begun is None:
            assert (begun == case.start).all()
        else:
            assert case.begun.contains((begun - case.start)[None], 1e-9)[0]
        if case.C is not None:
            z = np.concatenate(
                [
                    (values.T[np.searchsorted(ends, case.changes[:-1])] - case.bound.middle()).ravel(),
                    loop.noises(deviation).ravel() - case.noise.middle(),
                    begun - case.start - case.begun.middle(),
                ]
            )
            states = case.states(loop.nominal(x), loop.gains(x), np.array([time - 1e-13]))[0][0]
            assert c @ (states[:, 0] + states[:, 1:] @ z) == pytest.approx(case.height(c @ states), abs=1e-9)
            continue
        driven = dataclasses.replace(case, changes=ends, start=begun, begun=None)
        # innovations are counted from the middle of the initial states
        gains, v = loop.gains(x), loop.nominal(x)
        if case.begun is not None:
            off = begun - loop.start
            v = v + np.einsum("kmd,d->mk", gains[:, 0], off)
        states = driven.states(v, gains, np.array([time - 1e-13]))[0][0]
        w = np.concatenate([value - case.bound.middle() for value in values.T])
        reached = c @ (states[:, 0] + states[:, 1:] @ w)
        assert reached == pytest.approx(loop.values(x, np.array([time]), c[None])[0, 0], abs=1e-6)


def test_what_transitions_in_time_leave_out_is_in_the_bounds(monkeypatch):
    """An expansion of three terms, and bounds at single times above what loops do that are stepped here."""
    case, sharp, x = made("turning")
    for name, value in (("SHARPEST", 1.0), ("BLUNTEST", 1.0), ("DEGREE", 3)):
        monkeypatch.setattr(expansion, name, value)
    rough = prepare(case.problem, *case.grids, policy=sr.AffinePolicy()).feedback.loop
    times = np.linspace(0.05, 2.0, 40)
    # the same effects of every deviation: what the gains were made for is not what these innovations are
    states = case.states(sharp.nominal(x), sharp.gains(x), times)[0]
    truths = case.height(H @ states)
    assert np.abs(rough.values(x, times, H) - truths).max() > 1e-7, "nothing was left out"
    assert (truths <= LoopBounds(rough).over_cells(x, times, times, H)[0]).all()
