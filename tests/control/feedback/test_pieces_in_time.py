"""Guards control/feedback/measurable, of plants that change with time: what a piece makes of the state at its end, and
until then, against Gauss' rule on closed transitions; bounds of cells, and of what an expansion leaves out."""

from __future__ import annotations

import dataclasses
from functools import cache
from itertools import pairwise

import numpy as np
import pytest
from flint import arb_mat, ctx
from scipy.integrate import solve_ivp

import sparserob_core as sr
import sparserob_core.control.response.varying.expansion as expansion
from sparserob_core.checker.flow.flow import VerifiedFlow
from sparserob_core.checker.flow.plant import Plant
from sparserob_core.checker.reach.measurable import MeasurableLoop
from sparserob_core.checker.sets.polynomials import Enclosed
from sparserob_core.control.feedback.closed_loop import ClosedLoop
from sparserob_core.control.feedback.measurable import VaryingPieces
from sparserob_core.control.feedback.zonoid import KernelPolynomial
from sparserob_core.control.problem.system import VaryingSystem
from sparserob_core.control.transcription.transcribe import prepare
from tests.support.closed_loops import CHANGING, Changing, exponentials

H = np.array([[1.0, 0.0], [-1.0, 0.0], [0.6, 0.8]])
IN_TIME = ["measurable in t", "measurable in a triangle in t"]


@cache
def made(name: str) -> tuple[Changing, ClosedLoop, VaryingPieces]:
    case = CHANGING[name]
    loop = prepare(case.problem, *case.grids, policy=sr.AffinePolicy()).answering.loop
    assert isinstance(loop.measurable, VaryingPieces)
    return case, loop, loop.measurable


def pushed(case: Changing, low: float, high: float, rows: np.ndarray, parts: int = 400) -> np.ndarray:
    """The integral from ``low`` to ``high`` of the support function of the disturbance less its middle, by Gauss' rule
    with two nodes on each part."""
    cuts, node = np.linspace(low, high, parts + 1), np.array([-1.0, 1.0]) / np.sqrt(3.0)
    half = np.diff(cuts)[:, None] / 2
    s = (cuts[:-1, None] + half * (1.0 + node)).ravel()
    grown = case._of(case.grown, np.array(high)) - case._of(case.grown, s)
    K = exponentials(case.A * grown[:, None, None]) @ case.E * case._of(case.factor, s)[:, None, None]
    along = rows @ K  # (s, r, mw)
    assert case.bound is not None
    heights = case.bound.support(along.reshape(-1, K.shape[2])).reshape(along.shape[:2]) - along @ case.bound.middle()
    return np.asarray(np.repeat(half.ravel(), 2) @ heights)


@pytest.mark.slow
@pytest.mark.parametrize("name", IN_TIME)
def test_what_a_piece_does_is_the_integral_of_the_support_function(name: str) -> None:
    """Of its end along coordinates of its set, and of states carried on; of times in it along rows, 0 where it
    begins."""
    case, _, pieces = made(name)
    for piece, (low, high) in list(enumerate(pairwise(case.grid.tolist())))[:2]:
        _, outward = pieces.at(piece)
        assert pieces.zonoids[piece].support(H @ outward) == pytest.approx(pushed(case, low, high, H), rel=1e-4)
        within = (low + 0.37 * (high - low), high)
        found = pieces.within(np.array([low, *within]), H, np.full(3, piece))
        assert not found[0].any()
        for time, value in zip(within, found[1:], strict=True):
            assert value == pytest.approx(pushed(case, low, time, H), rel=1e-4)
        onward = exponentials(
            case.A * float(case._of(case.grown, np.array(2.0)) - case._of(case.grown, np.array(high)))
        )
        assert pieces.compute_transitions(np.array([piece]), np.array([2.0]))[0] == pytest.approx(onward, rel=1e-9)


@pytest.mark.slow
@pytest.mark.parametrize("name", IN_TIME)
def test_what_it_is_at_least_and_at_most_is_as_near_as_rounding(name: str) -> None:
    case, loop, pieces = made(name)
    times = np.linspace(0.0, 2.0, 9)[1:]
    every = loop.functionals.response.grid.locate(times)
    bounds = pieces.enclosed(times, H, every)
    assert (bounds[..., 0] <= bounds[..., 1]).all()
    assert np.ptp(bounds, axis=2).max() < 1e-11
    sharp = [pushed(case, float(case.grid[p]), float(t), H, 4000) for t, p in zip(times, every, strict=True)]
    assert bounds.mean(axis=2) == pytest.approx(np.array(sharp), abs=1e-7)


def test_pushes_on_parts_of_an_interval_are_the_polynomials_of_the_whole() -> None:
    rng = np.random.default_rng(0)
    kernels, ends = [rng.normal(size=(5, 2, 1)), rng.normal(size=(3, 2, 1))], np.array([0.0, 0.5, 2.0])
    found = KernelPolynomial.joined(kernels, ends, [3, 2])
    assert found.ends == pytest.approx([0.0, 0.5 / 3, 1.0 / 3, 0.5, 1.25, 2.0])
    assert found.halves == pytest.approx(np.diff(found.ends) / 2)
    for part, (low, high) in enumerate(pairwise(found.ends.tolist())):
        which = int(part >= 3)
        begin, length = (0.0, 0.5) if not which else (0.5, 1.5)
        for u in (-1.0, -0.3, 1.0):
            share = (low + (1.0 + u) / 2 * (high - low) - begin) / length
            truth = sum(one * share**k for k, one in enumerate(kernels[which])) / length
            assert np.tensordot(u ** np.arange(found.terms.shape[1]), found.terms[part], 1) == pytest.approx(truth)
    none = KernelPolynomial.joined(
        [np.concatenate([kernels[0], 1e-18 * np.ones((4, 2, 1))])], np.array([0.0, 1.0]), [1]
    )
    assert none.terms.shape[1] == 5


@pytest.mark.slow
def test_what_an_expansion_leaves_out_of_what_a_piece_does_is_in_the_bounds(monkeypatch: pytest.MonkeyPatch) -> None:
    """From 0, without a control, so that nothing moves but what is pushed: on the first piece what is under way, and
    what pieces that are over have done after it."""
    case = dataclasses.replace(
        CHANGING["measurable in t"], start=np.zeros(2), begun=None, c=None, bound=sr.Box([-0.1, -0.1], [0.1, 0.1])
    )
    times = np.array([0.2, 0.45, 0.6, 1.3])
    truths = None
    for rough in (False, True):
        if rough:
            for name, value in (("SHARPEST", 1.0), ("BLUNTEST", 1.0), ("DEGREE", 3)):
                monkeypatch.setattr(expansion, name, value)
        model = prepare(case.problem, *case.grids, policy=sr.AffinePolicy())
        loop, none = model.answering.loop, np.zeros(model.program.n)
        if truths is None:
            truths = loop.values(none, times, H)
            continue
        assert np.abs(loop.values(none, times, H) - truths).max(axis=1).min() > 1e-8, "nothing was left out"
        assert (truths <= loop.bounds(none, times, times, H)).all()
        pieces, every = loop.measurable, loop.functionals.response.grid.locate(times)
        assert isinstance(pieces, VaryingPieces)
        off = np.ptp(pieces.enclosed(times, H, every), axis=2) / 2.0
        assert off.max() > 1e-7 and (pieces.allowance(times, times, H, every) >= off).all()
        assert loop.motion is not None
        left, under_way = (
            loop._bound_transition_errors(none, loop.motion),
            loop.motion.bound_state_errors(*pieces.effect_sizes),
        )
        assert under_way[0].min() > 1e-12 and (left >= under_way * (1.0 - 1e-12)).all()


@pytest.mark.slow
@pytest.mark.parametrize("name", IN_TIME)
def test_what_transitions_are_counted_by_is_what_the_piece_under_way_has_made_of_the_states(name: str) -> None:
    """At marks within a piece, either way; nothing where a piece begins. What drives them counts with what kernels are
    off by, in the measure of what flows are."""
    case, _, pieces = made(name)
    marks, far = pieces.motion.grid.breakpoints, pieces.errors.error_radii
    begun, driven = pieces.effect_sizes
    for k, (mark, piece) in enumerate(zip(marks[:-1].tolist(), pieces.motion.origin.tolist(), strict=True)):
        start = float(case.grid[piece])
        truth = pushed(case, start, mark, np.vstack([np.eye(2), -np.eye(2)])).reshape(2, 2).max(axis=0)
        assert begun[k] == pytest.approx(truth, abs=1e-5) and (mark > start or not begun[k].any())
        assert (begun[k] >= truth - 1e-5).all()
    flow, kernel = pieces.motion.flow, pieces.errors.kernel
    columns = pieces.errors.columns
    both = (flow.error[:, None, None] * driven) / far
    alone = (
        flow.error[:, None, None] * flow.sizes[..., columns] + kernel.error[:, None, None] * kernel.sizes[..., columns]
    )
    assert (both >= alone).all() and both == pytest.approx(alone, rel=1e-9)


def test_the_worst_signals_of_a_plant_whose_matrices_do_not_commute_attain_what_both_sides_say() -> None:
    """Driven by an integrator, from 0, to the end of a piece and to a time in it, through three segments and more: what
    the set of the piece, what the piece under way, and what `check` says of both."""
    system = VaryingSystem.of(
        [["0", "1"], ["-2 - 3*sin(4*t)", "-0.5*t"]], [[0.0], [1.0]], 2.0, [["0.3*cos(t)", "0"], ["0.2*t", "1"]]
    )
    bound = sr.Polytope([[-1.0, 0.0], [0.0, -1.0], [1.0, 1.0]], [0.1, 0.15, 0.2])
    problem = sr.OptimalControlProblem(
        system=system,
        horizon=2.0,
        initial_state=[0.0, 0.0],
        control=sr.Box([-1.0], [1.0]),
        disturbance=bound,
        disturbance_class="measurable",
        terminal=[sr.Box([-9.0, -9.0], [9.0, 9.0])],
    )
    grid = [0.0, 1.1, 2.0]
    grids = sr.Dictionary.indicators(np.array(grid)), sr.Dictionary.indicators(np.array([0.0, 2.0]))
    loop = prepare(problem, *grids, policy=sr.AffinePolicy()).answering.loop
    pieces = loop.measurable
    assert pieces is not None

    def driven(low: float, ends: np.ndarray, values: np.ndarray) -> np.ndarray:
        state = np.zeros(2)
        for end, w in zip(ends, values, strict=True):

            def slope(t: float, x: np.ndarray, w: np.ndarray = w) -> list[float]:
                A = -(2.0 + 3.0 * np.sin(4.0 * t)) * x[0] - 0.5 * t * x[1]
                return [x[1] + 0.3 * np.cos(t) * w[0], A + 0.2 * t * w[0] + w[1]]

            state, low = solve_ivp(slope, (low, end), state, rtol=1e-11, atol=1e-13).y[:, -1], end
        return state

    with ctx.workprec(192):
        still, none = [arb_mat(1, 1)] * 2, np.zeros((2, 2, 1, 2))
        law = VerifiedFlow(Plant.of(system, 2.0), 2.0)
        both = MeasurableLoop(system, [0.0, 0.0], still, none, grid, grid, [], bound, law=law)
        assert len(law.marks([0.0, 1.1])) > 4
        for piece, (low, high) in enumerate(pairwise(grid)):
            zonoid, (_, outward) = pieces.zonoids[piece], pieces.at(piece)
            for a in np.array([[1.0, 0.2], [-0.7, 1.0]]):
                arc = zonoid.best(a @ outward)
                state = driven(low, low + arc.ends * (high - low), arc.values * pieces.disturbances)
                reached = float(a @ state)
                np.testing.assert_allclose(outward @ zonoid.evaluate_signal(arc), state, atol=1e-9)
                assert float(zonoid.support(a @ outward)) == pytest.approx(reached, abs=1e-9)
                pushed = both.deviations
                told = pushed.kernel(piece).integrate_support(Enclosed(a[None], np.zeros((1, 2))), pushed.summands)
                assert told.mid[0] == pytest.approx(reached, abs=1e-9) and told.rad[0] < 1e-12
                time = 0.3 * low + 0.7 * high
                ends, signal = pieces.signal(np.zeros(pieces.size), time, a, piece)
                mine = (ends[:-1] >= low) & (ends[:-1] < time)
                reached = float(a @ driven(low, ends[1:][mine], signal.T[mine] - bound.middle()))
                assert pieces.within(np.array([time]), a[None], np.array([piece]))[0, 0] == pytest.approx(
                    reached, abs=1e-9
                )
                told = both.compute_partial_effect(piece, time, a[None])
                assert told.mid[0] == pytest.approx(reached, abs=1e-9) and told.rad[0] < 1e-12
