"""Guards control/reach/varying_motion: bounds of the violation on cells of time of systems that change
with time: never below a dense maximum, close to it on small cells, and holding what transitions are off by."""

from __future__ import annotations

from dataclasses import replace
from fractions import Fraction

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import sparserob_core.control.response.varying.expansion as expansion
from sparserob_core.control.constraints.curved import CurvedConstraint
from sparserob_core.control.constraints.flat import FlatConstraint
from sparserob_core.control.constraints.sensitivity import Sensitivity
from sparserob_core.control.problem.dictionary import Dictionary
from sparserob_core.control.problem.system import VaryingSystem
from sparserob_core.control.reach import varying_motion
from sparserob_core.control.reach.functional import WorstFunctionals
from sparserob_core.control.reach.varying_motion import VaryingMotion
from sparserob_core.control.response.disturbance import disturbance_model
from sparserob_core.control.response.parameters import ParameterIndex
from sparserob_core.control.response.reference import STILL, Reference
from sparserob_core.control.response.response import Response
from sparserob_core.control.response.time_grid import merge_grids
from sparserob_core.control.response.varying.expansion import Expansion, Flow
from sparserob_core.control.sets.sets import Ellipsoid
from sparserob_core.sip.convex_set import Array, Box, ConvexSet
from tests.support.plants import indicators, uniform, walsh

HORIZON = 3.0
PLANTS = {
    "mathieu": VaryingSystem.of([[0, 1], ["-(1.5 - 0.8*cos(2*t))", -0.1]], [[0], [1]], HORIZON, [[1, 0], ["t", 1]]),
    "rocket": VaryingSystem.of([[0, 1], [0, 0]], [[0], ["1/(4 - t)"]], HORIZON, [[0, 0], [1, "sin(t)"]], c=[0, -1]),
    "turning": VaryingSystem.of([[0, "1 + t"], ["-(1 + t)", 0]], [["cos(t)"], [1]], HORIZON, [[1, 0], [0, "exp(-t)"]]),
    "fading": VaryingSystem.of([["-4/(0.5 + t)", 1], [0, "-1/(1 + t)"]], [["t"], [1]], HORIZON),
}
SETS: dict[str, ConvexSet | None] = {
    "none": None,
    "box": Box([-0.1, -0.3], [0.2, 0.1]),
    "ellipsoid": Ellipsoid([0.0, 0.1], [[0.04, 0.01], [0.01, 0.02]]),
}
GRIDS = {"uniform": uniform(6, HORIZON), "uneven": indicators([0.0, 0.4, 0.5, 1.6, HORIZON])}
NOISES = {"own": None, "others": uniform(5, HORIZON), "walsh": walsh(4, HORIZON, 2)}


def functionals(
    plant: str, dictionary: Dictionary, noise: Dictionary | None, bound: str, begun: str
) -> WorstFunctionals:
    system = PLANTS[plant].forced
    noise, w, x0 = dictionary if noise is None else noise, SETS[bound], SETS[begun]
    constants = system.controls - 1
    grid = merge_grids(dictionary.breakpoints, noise.breakpoints, constants=constants, varying=True)
    model = None if w is None else disturbance_model("piecewise_constant", w, noise, grid)
    return WorstFunctionals(Response(system, grid, np.array([1.0, -0.5])), dictionary, model, initial=x0)


def sampled(constraint: FlatConstraint | CurvedConstraint, x: Array, low: Array, high: Array, count: int) -> Array:
    """The largest violation at some indices of every cell, ``(k,)``."""
    shares = np.random.default_rng(1).uniform(size=(count, *low.shape))
    shares[:, :, 0] = np.linspace(0.0, 1.0, count)[:, None]
    found = constraint.at(x, (low + shares * (high - low)).reshape(-1, low.shape[1])).max(axis=1)
    return np.asarray(found.reshape(count, -1).max(axis=0))


@settings(max_examples=8, deadline=None)
@given(
    seed=st.integers(0, 10**6),
    plant=st.sampled_from(sorted(PLANTS)),
    bound=st.sampled_from(sorted(SETS)),
    begun=st.sampled_from(sorted(SETS)),
    grid=st.sampled_from(sorted(GRIDS)),
    noise=st.sampled_from(sorted(NOISES)),
)
def test_no_violation_in_a_cell_is_above_its_bound(seed, plant, bound, begun, grid, noise):
    bound = "box" if noise == "walsh" and bound == "ellipsoid" else bound
    rng = np.random.default_rng(seed)
    worst = functionals(plant, GRIDS[grid], NOISES[noise], bound, begun)
    moved = Reference(np.array([0.0, 1.1, HORIZON]), rng.normal(size=(3, 2))) if seed % 2 else STILL
    sides = rng.normal(size=(3, 2)), rng.normal(size=3)
    constraint = FlatConstraint("path", worst, *sides, 0.2, HORIZON, ParameterIndex(None), reference=moved)
    x = rng.normal(size=worst.variables)
    lower, upper = constraint.cells
    inner = np.sort(rng.uniform(size=(2, *lower.shape)), axis=0)
    for low, high in ((lower, upper), (lower + inner[0] * (upper - lower), lower + inner[1] * (upper - lower))):
        bounds = constraint.enclosure(x, low, high).bounds
        truths = sampled(constraint, x, low, high, 30)
        assert (truths <= bounds + 1e-12).all()
    short = lower + 1e-2 * (upper - lower)  # on which a bound is above a maximum inside by little
    truths, bounds = sampled(constraint, x, lower, short, 5), constraint.enclosure(x, lower, short).bounds
    assert (truths <= bounds + 1e-13).all()
    np.testing.assert_allclose(bounds, truths, atol=1e-3)


@settings(max_examples=3, deadline=None)
@given(seed=st.integers(0, 10**6), plant=st.sampled_from(sorted(PLANTS)), bound=st.sampled_from(sorted(SETS)))
def test_a_curved_set_is_enclosed_over_cells_of_directions(seed, plant, bound):
    rng = np.random.default_rng(seed)
    worst = functionals(plant, GRIDS["uniform"], None, bound, "box")
    shape = Ellipsoid([0.1, 0.0], [[1.5, 0.2], [0.2, 0.8]])
    constraint = CurvedConstraint("path", worst, shape, 0.2, HORIZON, ParameterIndex(None))
    lower, upper = constraint.cells
    x = rng.normal(size=worst.variables)
    bounds = constraint.enclosure(x, lower, upper).bounds
    truths = sampled(constraint, x, lower, upper, 10)
    # where nothing is violated, bounds are in the length of the directions, so that only their sign is told
    assert (truths <= np.maximum(bounds, 0.0) + 1e-12).all()
    assert (bounds < 0.0).any() or truths.max() > 0.0


@pytest.mark.first(3)
@pytest.mark.parametrize("name", ["TERMS", "DEGREE"])
@pytest.mark.parametrize("part", ["control", "disturbance", "initial"])
def test_bounds_hold_what_coarse_transitions_are_off_by(name, part, monkeypatch):
    # the system is cut short on purpose: bounds must be above the violation of the sharp one
    x = np.array([1.0, -1.0, 0.5, 1.0, -0.5, 1.0])
    sharp = functionals("mathieu", GRIDS["uniform"], None, "box" if part == "disturbance" else "none",
                        "box" if part == "initial" else "none")  # fmt: skip
    if part != "control":
        x, sharp = 0.0 * x, replace(sharp, response=sharp.response.from_state(np.zeros(2)))
    H = np.array([[1.0, 0.3], [-1.0, -0.3], [-0.2, 1.0], [0.2, -1.0]])

    def path(worst: WorstFunctionals) -> FlatConstraint:
        return FlatConstraint("path", worst, H, np.zeros(4), 0.0, HORIZON, ParameterIndex(None))

    times = np.linspace(0.0, HORIZON, 301)[:, None]
    truths = path(sharp).at(x, times).max(axis=1)
    for rough in ("SHARPEST", "BLUNTEST"):
        monkeypatch.setattr(expansion, rough, 1.0)
    monkeypatch.setattr(expansion, name, 3)
    rough = VaryingSystem.of([[0, 1], ["-(1.5 - 0.8*cos(2*t))", -0.1]], [[0], [1]], HORIZON, [[1, 0], ["t", 1]])
    coarse = path(replace(sharp, response=Response(rough, sharp.response.grid, sharp.response.initial_state)))
    off = np.abs(coarse.at(x, times).max(axis=1) - truths).max()
    assert off > 1e-6, "nothing was left out"
    assert (truths <= coarse.enclosure(x, times, times).bounds).all()


def test_transitions_that_are_not_resolved_give_no_bound(monkeypatch):
    worst = functionals("mathieu", GRIDS["uniform"], None, "none", "none")
    constraint = FlatConstraint("path", worst, np.eye(2), np.ones(2), 0.0, HORIZON, ParameterIndex(None))
    flow = Expansion.flow
    monkeypatch.setattr(Expansion, "flow", lambda self, *ends: (f := flow(self, *ends))._replace(error=f.error + 1.0))
    lower, upper = constraint.cells
    assert not np.isfinite(constraint.enclosure(np.zeros(6), lower, upper).bounds[-1])


@pytest.mark.first(2)
@pytest.mark.parametrize("plant", sorted(PLANTS))
def test_derivatives_in_time_are_differences(plant):
    worst = functionals(plant, GRIDS["uneven"], None, "box", "ellipsoid")
    moved = Reference(np.array([0.0, 1.1, HORIZON]), np.random.default_rng(3).normal(size=(3, 2)))
    sides = np.array([[1.0, 0.3], [-0.2, 1.0]]), np.zeros(2)
    constraint = FlatConstraint("path", worst, *sides, 0.0, HORIZON, ParameterIndex(None), reference=moved)
    x, times = np.array([1.0, -1.0, 0.5, 2.0]), np.array([0.21, 0.45, 1.3, 2.1, 2.9])[:, None]
    rows, h = np.array([0, 1, 0, 1, 0]), 1e-5
    found = Sensitivity(constraint).gradient(x, times, rows)[:, 0]
    ahead, behind = (constraint.violations(x, times + step, rows) for step in (h, -h))
    np.testing.assert_allclose(found, (ahead - behind) / (2 * h), rtol=1e-6, atol=1e-7)


@pytest.mark.first(3)
@pytest.mark.parametrize(("start", "width"), [(1.0, 0.2), (2.0, 0.01)], ids=["third", "second"])
@pytest.mark.parametrize("part", ["state", "disturbance", "initial"])
def test_what_bends_within_a_cell_is_counted(part, start, width):
    # the second derivative is 1 - t times what bends: 0 where a cell begins, or all that there is on a short one
    A = [[0, 1], ["1 - t" if part == "initial" else 0, 0]]
    drift = ["t - t^2/2", 0] if part == "state" else None  # of a speed whose slope is all that bends
    system = VaryingSystem.of(A, [[0], [0]], HORIZON, [["t - t^2/2"], [0]], drift).forced
    whole = uniform(1, HORIZON)
    grid = merge_grids(whole.breakpoints, whole.breakpoints, constants=system.controls - 1, varying=True)
    noise = disturbance_model("piecewise_constant", Box([-1.0], [1.0]), whole, grid) if part == "disturbance" else None
    begun = Box([-1.0, 0.0], [1.0, 0.0]) if part == "initial" else None
    worst = WorstFunctionals(Response(system, grid, np.zeros(2)), whole, noise, initial=begun)
    constraint = FlatConstraint("path", worst, np.eye(2)[:1], np.zeros(1), 0.0, HORIZON, ParameterIndex(None))
    times, x = np.array([[start], [start + width]]), np.zeros(worst.variables)
    inside = sampled(constraint, x, times[:1], times[1:], 9)
    chord = np.interp(np.linspace(0.0, 1.0, 9), [0.0, 1.0], constraint.at(x, times)[:, 0])
    above = constraint.at(x, np.linspace(start, start + width, 9)[:, None])[:, 0] - chord
    bounds = constraint.enclosure(x, times[:1], times[1:]).bounds
    assert above.max() > 1e-6 and (inside <= bounds).all()
    assert bounds[0] - chord.max() >= above.max()


def test_what_every_step_is_off_by_is_carried_on(monkeypatch):
    # a state that stays, by steps that each make a little more of it, and say so
    flow, off = Expansion.flow, 1e-6

    def more(self: Expansion, starts: Array, stops: Array) -> Flow:
        found, lasts = flow(self, starts, stops), stops > starts
        state = found.state * (1.0 + off * lasts)[:, None, None]
        return found._replace(state=state, error=found.error + off * lasts)

    monkeypatch.setattr(Expansion, "flow", more)
    system, many = VaryingSystem.of([["0*t"]], [[0]], HORIZON), uniform(50, HORIZON)
    grid = merge_grids(many.breakpoints, many.breakpoints, varying=True)
    for begun in (None, Box([-1.0], [1.0])):
        start = np.array([1.0 if begun is None else 0.0])
        worst = WorstFunctionals(Response(system, grid, start), many, None, initial=begun)
        sides = np.array([[-1.0], [1.0]]), np.zeros(2)
        path = FlatConstraint("path", worst, *sides, 0.0, HORIZON, ParameterIndex(None))
        legs = path.functionals.over_cells.legs(np.zeros(0), np.zeros(0))
        support = path.samples.support_over(legs, np.zeros(0), np.zeros(0))[0]
        lost = legs[0].along(np.zeros((1, 50)), np.ones((1, 1)), np.zeros((1, 1)))[0, -1]
        lost = lost if support is None else support.neglected[0, -1]
        assert (1.0 + off) ** 50 - 1.0 <= lost <= 500 * off


FAST_AND_SLOW = VaryingSystem.of([[0, 1], ["-1 / (0.002 + (t - 3)^2)", 0]], [[0], [1]], 8.0)  # twenty times as fast


def orbiting(monkeypatch: pytest.MonkeyPatch, off: float) -> VaryingMotion:
    """A motion whose every step may be off by a share ``off`` in the units of its segment."""
    flow = Expansion.flow

    def rough(self: Expansion, starts: Array, stops: Array) -> Flow:
        ratios = self.ratios[self.segment_of((starts + stops) / 2)]
        return flow(self, starts, stops)._replace(error=off * ratios.max(axis=1) * (stops > starts))

    monkeypatch.setattr(Expansion, "flow", rough)
    times = uniform(12, 8.0).breakpoints
    grid = merge_grids(times, times, varying=True)
    return VaryingMotion(Response(FAST_AND_SLOW, grid, np.array([1.0, 0.5])).propagator, np.array([1.0, 0.5]))


@pytest.mark.first(2)
@pytest.mark.parametrize("control", [0.0, 3.0])
@pytest.mark.parametrize("stretches", [1000, 7])
def test_the_worst_that_steps_may_miss_is_held_and_hardly_more(control, stretches, monkeypatch):
    monkeypatch.setattr(varying_motion, "STRETCHES", stretches)
    off = 1e-11
    motion = orbiting(monkeypatch, off)
    flow, ratios = motion.flow, motion.expansion.ratios[motion._segments]
    assert ratios.max() >= 8.0 and ratios.min() == 1.0, "nothing is slow"
    pushes = control * flow.control[:, :, 0]
    driven = control * flow.sizes[:, :, 0]
    path = motion.nodes(np.full((1, 12), control))[:, 0]
    units = motion.expansion.units * ratios
    missed = off * ((np.abs(path[:-1]) / units).max(axis=1) + driven.max(axis=1))[:, None] * units
    lost = motion._propagate_step_errors(np.abs(path[:-1]), driven[:, :, None].sum(axis=2))
    for mark in (1, 2, len(path) // 3, len(path) // 2, len(path) - 2):
        deviation = np.empty(2)
        for state in range(2):
            back, signs = np.eye(2)[state], []
            for step in flow.state[:mark][::-1]:
                signs.append(np.sign(back))
                back = back @ step
            worst = path[0]
            for k, sign in enumerate(signs[::-1]):  # each step misses what it may, where it counts
                worst = flow.state[k] @ worst + pushes[k] + sign * missed[k]
            deviation[state] = worst[state] - path[mark, state]
        on_it = motion.grown(np.array([mark]), motion.grid.lengths[[mark]], deviation[None])[0] + missed[mark]
        assert (on_it * (1.0 - 1e-6) <= lost[mark]).all()
        if stretches > len(lost):
            np.testing.assert_allclose(lost[mark], on_it, rtol=1e-3)
    assert (lost <= 100.0 * on_it.max() * motion.expansion.units).all()


def test_transitions_count_in_the_units_of_what_they_begin_with(monkeypatch):
    # P e is nearly one half, from a slow part to a fast one
    motion = orbiting(monkeypatch, 0.0)
    units = motion.expansion.units * motion.expansion.ratios[motion._segments]
    ends, steps = np.concatenate([units[:1], units]), motion.flow.state
    norms, changed = [1.0], [1.0]
    for k in range(len(steps)):
        changed.append((ends[k] / units[k]).max())
        product = np.eye(2)
        for j in range(k + 1, len(steps)):  # what a step misses is there when it ends
            product = steps[j] @ product
            norms.append((np.abs(product) * ends[k + 1] / ends[j + 1, :, None]).sum(axis=1).max())
    share = 0.49 / (max(norms) * sum(changed[1:]))
    for off, finite in ((share, True), (share / 0.9, False)):
        assert np.isfinite(orbiting(monkeypatch, off).transition_bounds).all() == finite
    rough, P = orbiting(monkeypatch, share), max(norms)
    more = (rough.transition_bounds - motion.transition_bounds)[motion.transition_bounds > 0.0]
    ends = np.broadcast_to(ends[:, None], motion.transition_bounds.shape)[motion.transition_bounds > 0.0]
    np.testing.assert_allclose(more, P * 0.49 / 0.51 * ends, rtol=1e-6)


def test_what_products_of_steps_round_is_lost_too(monkeypatch):
    motion = orbiting(monkeypatch, 0.0)
    path, exact, off = motion.nodes(np.zeros((1, 12)))[:, 0], [Fraction(1), Fraction(1, 2)], 0.0
    lost = motion._propagate_step_errors(np.abs(path[:-1]), np.zeros((len(path) - 1, 2)))
    for k, step in enumerate(motion.flow.state[:-1]):
        exact = [sum(Fraction(a) * x for a, x in zip(row, exact, strict=True)) for row in step]
        miss = np.array([abs(float(x - Fraction(one))) for x, one in zip(exact, path[k + 1], strict=True)])
        assert (miss <= lost[k + 1]).all()
        off = max(off, float((miss / motion.expansion.units).max()))
    assert off > 0.0


def test_a_piece_in_two_segments_counts_in_the_units_of_all(monkeypatch):
    # a breakpoint that is the end of a slow segment but for rounding is that end, and what is beyond is in the next one
    first = orbiting(monkeypatch, 1e-9)
    slow = first.expansion.ratios.max(axis=1) > 1.0
    ends = first.expansion.ends[1:-1][slow[:-1] & slow[1:]][:2]
    times = np.unique([0.0, *(end * (1.0 + 4.0 * np.finfo(float).eps) for end in ends), 8.0])
    motion = replace(
        first, propagator=Response(FAST_AND_SLOW, merge_grids(times, times, varying=True), np.ones(2)).propagator
    )
    units, off = motion._step_errors
    apart = np.flatnonzero(np.isin(motion.propagator.marks[1:], times[1:-1]))
    assert apart.size == 2
    np.testing.assert_array_equal(units[apart], np.tile(motion.expansion.units, (2, 1)))
    assert (off[apart] >= motion.flow.error[apart]).all()
