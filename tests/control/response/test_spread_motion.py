"""Guards the expansion of a state in parameters beside the time: what is beyond its degree is bounded by what is said,
and bounds over cells of times and parameters hold what closed forms give there."""

from __future__ import annotations

from dataclasses import replace
from math import factorial

import numpy as np
import pytest

import sparserob_core as sr
from sparserob_core.control.enclosures.dependence import Spread
from sparserob_core.control.enclosures.taylor import TaylorSpace
from sparserob_core.control.response.response import Propagator, merge_grids
from sparserob_core.control.response.varying.discs import cauchy
from sparserob_core.control.response.varying.spread import tails
from sparserob_core.control.response.varying_motion import Truncation, VaryingMotion
from sparserob_core.control.transcription.transcribe import prepare

BOX = sr.Box([-0.3], [0.6])
SYSTEM = sr.VaryingSystem.of([["-0.5 - p*sin(2*t)"]], [["1 + p^2"]], 3.0, [[1]], parameters=BOX, names=["p"])


def decay(t: np.ndarray, p: np.ndarray) -> np.ndarray:
    """What an initial state of 1 becomes."""
    return np.asarray(np.exp(-t / 2 - p * (1 - np.cos(2 * t)) / 2))


@pytest.mark.slow
@pytest.mark.parametrize("degree", [2, 3, 5])
def test_what_is_beyond_a_degree_is_bounded_and_not_by_far_more_than_it_is(degree: int) -> None:
    spread = Spread(1, TaylorSpace(1, degree), *SYSTEM.deviations, powers=2)
    breaks = np.linspace(0.0, 3.0, 7)
    every = Propagator(SYSTEM.superposed(spread), merge_grids(breaks, breaks, varying=True))
    motion = VaryingMotion(every, np.eye(spread.states)[0])
    marks, points = motion.grid.breakpoints, np.linspace(-0.3, 0.6, 31)
    states = motion.nodes(np.zeros((1, 6)))[:, 0]
    seen = spread.seen(np.broadcast_to(states, (31, *states.shape)), points[:, None])[:, :, 0]
    off = np.abs(seen - decay(marks[None], points[:, None])).max(axis=0)
    lost = Truncation(motion, spread).lost(np.abs(states[:-1]), np.zeros((marks.size - 1, 2)))[:, 0]
    assert (off[1:] <= lost * (1.0 + 1e-9) + 1e-14).all()
    assert lost[-1] <= 1e3 * off.max()


@pytest.mark.slow
def test_bounds_on_cells_hold_what_the_closed_form_gives_there() -> None:
    problem = sr.OptimalControlProblem(
        system=SYSTEM, horizon=3.0, initial_state=[1.0], control=sr.Box([-1.0], [1.0]), path=[sr.Box([-0.5], [0.5])]
    )
    pieces = sr.Dictionary.indicators(np.linspace(0.0, 3.0, 7))
    (constraint,) = prepare(problem, pieces, pieces).constraints
    rng, nothing = np.random.default_rng(30), np.zeros(6)
    cuts = constraint.functionals.response.propagator.marks
    starts = rng.choice(cuts[:-1], 40)
    stops = cuts[np.searchsorted(cuts, starts, side="right")]
    begun = starts + rng.uniform(0.0, 0.9, 40) * (stops - starts)
    ended = begun + rng.uniform(0.0, 1.0, 40) * (stops - begun)
    low = rng.uniform(-0.3, 0.6, 40)
    high = low + rng.uniform(0.0, 1.0, 40) * (0.6 - low)
    found = constraint.enclosure(nothing, np.stack([begun, low], axis=1), np.stack([ended, high], axis=1)).bounds
    t, p = (a + rng.uniform(0.0, 1.0, (200, 40)) * (b - a) for a, b in ((begun, ended), (low, high)))
    t[0], p[0], p[1] = begun, low, high
    truth = np.maximum(decay(t, p), -decay(t, p)).max(axis=0) - 0.5
    assert (truth <= found + 1e-14).all()
    assert np.median(found - truth) < 0.05


def test_what_is_about_beyond_a_degree_is_the_rest_of_an_exponential() -> None:
    found = tails(np.array([0.3, 0.5]), 4, 40)
    assert found[0] == pytest.approx(np.exp(0.8) - 1)
    assert found[2] == pytest.approx(np.exp(0.8) - 1 - 0.3 - 0.3**2 / 2 - 0.5)


RELAXING = sr.VaryingSystem.of(
    [["-1/(1 + p) + 0*t"]], [["1/(1 + p)"]], 2.0, [[1]], parameters=sr.Box([-0.2], [0.3]), names=["p"]
)
FILLING = sr.VaryingSystem.of(
    [["0*t"]], [["1/(1 + p)"]], 2.0, [["exp(p)"]], parameters=sr.Box([-0.2], [0.3]), names=["p"]
)


def relaxed(t: np.ndarray, p: np.ndarray) -> np.ndarray:
    """What an initial state of 1 becomes under a control of -2."""
    return np.asarray(3.0 * np.exp(-t / (1.0 + p)) - 2.0)


@pytest.mark.parametrize("degree", [2, 3, 5])
@pytest.mark.parametrize("name", ["relaxing", "filling"])
def test_what_power_series_leave_of_entries_is_in_what_is_beyond(name: str, degree: int) -> None:
    system = RELAXING if name == "relaxing" else FILLING
    left = cauchy(system).left(degree)
    spread = Spread(1, TaylorSpace(1, degree), *system.deviations, powers=1, left=left)
    breaks = np.linspace(0.0, 2.0, 5)
    every = Propagator(system.superposed(spread), merge_grids(breaks, breaks, varying=True))
    motion = VaryingMotion(every, np.eye(spread.states)[0])
    marks, points = motion.grid.breakpoints, np.linspace(-0.2, 0.3, 31)
    states = motion.nodes(np.full((1, 4), -2.0))[:, 0]
    seen = spread.seen(np.broadcast_to(states, (31, *states.shape)), points[:, None])[:, :, 0]
    t, p = marks[None], points[:, None]
    off = np.abs(seen - (relaxed(t, p) if name == "relaxing" else 1.0 - 2.0 * t / (1.0 + p))).max(axis=0)
    truncation, inputs = Truncation(motion, spread), np.tile([2.0, 0.0], (marks.size - 1, 1))
    lost = truncation.lost(np.abs(states[:-1]), inputs)[:, 0]
    assert (off[1:] <= lost * (1.0 + 1e-9) + 1e-14).all()
    assert lost[-1] <= 1e4 * off.max()
    assert off.max() <= truncation.at_most(np.ones(1), inputs[0])[0] <= 1e4 * off.max()
    rest = 1.0 / (1.0 + points)  # the series of 1 / (1 + p) in shares of a quarter
    rest = rest - sum((-0.25) ** n / 1.05 ** (n + 1) * ((points - 0.05) / 0.25) ** n for n in range(degree + 1))
    without = Truncation(motion, replace(spread, left=None)).lost(np.abs(states[:-1]), inputs)[:, 0]
    entering = np.exp(-2.0 / 0.8) if name == "relaxing" else 2.0  # the least that multiplies what is beyond
    assert (lost - without)[-1] >= 2.0 * np.abs(rest).max() * entering
    others = np.tile([0.0, 1.0], (marks.size - 1, 1))
    if name == "filling":  # a disturbance of 1, whose effect is t exp(p)
        exact = [float(np.exp(0.05 + 0.25 * e)) for e in np.linspace(-1.0, 1.0, 31)]
        series = sum(np.exp(0.05) * (0.25 * np.linspace(-1.0, 1.0, 31)) ** n / factorial(n) for n in range(degree + 1))
        true = 2.0 * float(np.abs(exact - series).max())
        assert true <= truncation.lost(0.0 * np.abs(states[:-1]), others)[-1, 0] <= 1e2 * true
