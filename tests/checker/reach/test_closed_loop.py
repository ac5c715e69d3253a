"""Guards checker/reach, closed loops: heights hold the worst case of a loop that is stepped and measured elsewhere, and
what a cell adds to its chord is what its curvature owes, in balls."""

from __future__ import annotations

import itertools
from fractions import Fraction
from functools import cache
from types import SimpleNamespace

import numpy as np
import pytest
from flint import arb_mat, ctx

import sparserob_core.checker.reach.closed_loop as loops
from sparserob_core.checker.arithmetic.series import exactly
from sparserob_core.checker.claims.cells import prove
from sparserob_core.checker.outcome import Broken, Clock
from sparserob_core.checker.reach.closed_loop import VerifiedLoop
from sparserob_core.checker.reach.tube import LoopTube, TimelessTube
from sparserob_core.checker.sets.known import known
from sparserob_core.checker.sets.parameters import Parameters
from sparserob_core.checker.sets.polynomials import Enclosed, rounding
from sparserob_core.checker.sets.sides import Curved, Sides
from sparserob_core.control.problem.system import LinearSystem
from sparserob_core.control.sets.sets import Box, Ellipsoid
from tests.support.closed_loops import EXACT, LOOPS, STILL, gains

H = np.array([[1.0, 0.0], [0.0, -1.0], [0.6, 0.8], [-1.0, 0.3]])


@cache
def made(name):
    """The loop in balls, and the one that is stepped, with its control and gains."""
    case = LOOPS[name]
    v, M = gains(np.random.default_rng(3), case)
    loop = VerifiedLoop(
        case.system,
        case.start.tolist(),
        [arb_mat(column[:, None].tolist()) for column in v.T],
        M,
        case.grid.tolist(),
        case.breakpoints.tolist(),
        case.changes[:-1].tolist(),
        case.bound,
        case.begun,
        measured=case.problem.measurements,
        observer=case.observer,
    )
    return case, loop, v, M


def table(matrix):
    return np.array([[float(x.mid()) for x in row] for row in matrix.tolist()])


def places(case):
    """Times with the pieces that they are in: ends, and within."""
    for piece, (a, b) in enumerate(zip(case.grid[:-1], case.grid[1:], strict=True)):
        for share in (0.0, 0.3, 0.85, 1.0):
            yield piece, float(b) if share == 1.0 else float(a + share * (b - a))


def parts(loop):
    """The pieces of the grid, cut where a system in t becomes another power series of it."""
    cuts = loop.flow.marks(loop.grid)
    for a, b in itertools.pairwise(cuts):
        yield int(np.searchsorted(loop.grid, a, side="right")) - 1, a, b


@pytest.mark.parametrize("name", EXACT)
def test_the_state_in_balls_is_that_of_a_loop_that_measures(name):
    case, loop, v, M = made(name)
    times = np.array([time for _, time in places(case)])
    states, _, controls = case.states(v, M, times)
    with ctx.workprec(192):
        for (piece, time), truth in zip(places(case), states, strict=True):
            found = loop.state(piece, time)
            assert table(found) == pytest.approx(truth, abs=1e-10)
            assert max(float(x.rad()) for x in found.entries()) < 1e-22
            heights = loop.highest(piece, time, H)
            assert [float(h.mid()) for h in heights] == pytest.approx(case.height(H @ truth).tolist(), abs=1e-10)
        for k, truth in enumerate(controls):
            assert table(loop.inputs(k)) == pytest.approx(truth, abs=1e-10)
        assert (loop.deviations.radii >= case.radii).all()
        assert loop.deviations.radii == pytest.approx(
            np.concatenate([np.zeros(0), *(np.array(known(s).radius) + np.abs(m) for s, m in case.sets)]), rel=1e-9
        )
        assert [loop.on(piece) for piece in range(case.grid.size - 1)] == [
            int(np.searchsorted(case.breakpoints, t)) - 1 for t in (case.grid[:-1] + case.grid[1:]) / 2
        ]


@pytest.mark.parametrize("name", STILL)
def test_what_a_short_cell_adds_is_an_eighth_of_its_square_times_the_curvature_of_all_that_deviates(name):
    """Hardly more than sampled second derivatives say; that it is enough is held beside."""
    case, loop, v, M = made(name)
    rng = np.random.default_rng(2)
    sizes = np.concatenate([[1.0], loop.deviations.radii])
    with ctx.workprec(192):
        for piece, a, b in parts(loop):
            length = min(b - a, 0.05 / np.linalg.norm(case.A, 2))
            low = float(a + rng.uniform(0.0, b - a - length))
            bent = loop.bound_chord_error(piece, low, low + length, H)
            _, rates, _ = case.states(v, M, low + np.linspace(0.0, 1.0 - 1e-12, 31) * length)
            owed = length**2 / 8.0 * (np.abs(H @ case.A @ rates).max(axis=0) @ sizes)
            assert (bent <= 1.1 * owed + 1e-12).all()
            assert (bent >= 0.8 * owed).all()  # the curvature changes on the way


@pytest.mark.parametrize("name", EXACT)
def test_no_time_of_a_cell_is_above_its_chord_by_more_than_that(name):
    case, loop, v, M = made(name)
    rng = np.random.default_rng(5)
    with ctx.workprec(192):
        for piece, a, b in parts(loop):
            low, high = sorted(rng.uniform(a, b, size=2).tolist())
            ends = np.array([[float(h.upper()) for h in loop.highest(piece, t, H)] for t in (low, high)])
            share = np.linspace(0.0, 1.0 - 1e-12, 31)
            states, _, _ = case.states(v, M, low + share * (high - low))
            over = case.height(H @ states) - ((1.0 - share)[:, None] * ends[0] + share[:, None] * ends[1])
            assert (over.max(axis=0) <= loop.bound_chord_error(piece, low, high, H) + 1e-12).all()


def test_a_parabola_is_an_eighth_of_its_acceleration_above_its_chord_and_no_more_in_a_system_in_t():
    """The double integrator, written as one that changes with time."""
    loop = made("level")[1]
    with ctx.workprec(192):
        for piece, (low, high) in ((0, (0.25, 0.5)), (1, (0.75, 1.0))):
            (bent,) = loop.bound_chord_error(piece, low, high, np.array([[1.0, 0.0]]))
            answers = np.array([[float(x.mid()) for x in row] for row in loop.inputs(piece).tolist()])[0]
            owed = 0.0625 / 8.0 * (np.abs(answers) @ np.concatenate([[1.0], loop.deviations.radii]))
            assert bent == pytest.approx(owed, rel=1e-9)
            assert bent >= owed


def test_what_a_power_series_on_a_cell_leaves_out_is_added(monkeypatch):
    monkeypatch.setattr(loops, "ORDER", 2)
    case, loop, v, M = made("turning")
    share, most = np.linspace(0.0, 1.0 - 1e-12, 31), 0.0
    with ctx.workprec(192):
        for piece, low, high in parts(loop):
            ends = np.array([[float(h.upper()) for h in loop.highest(piece, t, H)] for t in (low, high)])
            states, _, _ = case.states(v, M, low + share * (high - low))
            over = case.height(H @ states) - ((1.0 - share)[:, None] * ends[0] + share[:, None] * ends[1])
            assert (over.max(axis=0) <= loop.bound_chord_error(piece, low, high, H) + 1e-12).all()
            # of a term of the third power, which is left out, a chord leaves this much at most
            terms, _ = loop.flow.within(low, high, low, high, 4)
            both = arb_mat([*loop.state(piece, low).tolist(), *loop.drives[piece].tolist()])
            third = np.abs(H @ table(terms[3].matrix * both)) @ np.concatenate([[1.0], loop.deviations.radii])
            second = np.abs(H @ table(terms[2].matrix * both)) @ np.concatenate([[1.0], loop.deviations.radii])
            bent = loop.bound_chord_error(piece, low, high, H)
            assert (bent >= second / 4.0 + third * 2.0 / 3.0**1.5).all()
            most = max(most, float(third.max()))
    assert most > 1e-3, "nothing was left out"


@pytest.mark.parametrize("name", ["box", "ball and begun"])
def test_no_deviation_comes_beyond_the_chords_of_a_cell_and_what_they_may_miss(name):
    """In any direction, at any time of a cell, with what is answered beside the state; at its ends they are exact."""
    case, loop, v, M = made(name)
    rng = np.random.default_rng(8)
    normals, weights = np.array([[1.0, 0.2], [-0.3, 1.0]]), rng.uniform(-1.0, 1.0, (2, M.shape[2]))
    with ctx.workprec(192):
        alone, both = LoopTube(loop, normals, np.zeros((2, 0))), LoopTube(loop, normals, weights)
        for piece, (a, b) in enumerate(zip(case.grid[:-1].tolist(), case.grid[1:].tolist(), strict=True)):
            for width in (0.5, 0.02):
                z = np.vstack([np.eye(2), rng.uniform(-1.0, 1.0, (3, 2))])
                start = float(a + rng.uniform(0, 0.5) * (b - a))
                stop = start + width * (b - start)
                times = start + np.linspace(0.0, 1.0 - 1e-12, 15) * (stop - start)
                states, _, controls = case.states(v, M, times)
                answered = controls[loop.on(piece)] * (np.arange(controls.shape[2]) > 0)
                along = np.einsum("rd,tdq->rtq", z @ normals, states)
                beside = (z @ weights @ answered)[:, None]
                for tube, truth in ((alone, along), (both, along + beside)):
                    heights = case.height(truth.reshape(-1, truth.shape[2])).reshape(truth.shape[:2])
                    for poly, height in zip(tube.cells(piece, start, stop, z), heights, strict=True):
                        level, slope = poly.coefficients[:, 0]
                        assert (height <= level + slope * np.linspace(0.0, 1.0, 15) + poly.error + 1e-12).all()
                        assert height[[0, -1]] == pytest.approx([level, level + slope], abs=1e-9)
                        assert 0.0 <= poly.expansion <= poly.error <= poly.expansion + 1e-12
                        assert poly.expansion <= 30.0 * (stop - start) ** 2
                    for poly, height in zip(tube.cells(piece, start, start, z), heights, strict=True):
                        assert poly.coefficients.shape == (1, 1)
                        assert poly.coefficients[0, 0] == pytest.approx(height[0], abs=1e-12)
                        assert poly.error < 1e-12


def shown(loop, radius, z, start, stop, piece=0):
    """By how much of its unit a disc is left on a cell of times in one direction, as it is proven."""
    tube = LoopTube(loop, np.eye(2), np.zeros((2, 0)))
    sides = Sides.cell(
        Curved(known(Ellipsoid(np.zeros(2), radius**2 * np.eye(2))), np.eye(2), lambda c, width: 0.0), z, z
    )
    return prove(lambda _: tube, Parameters(None), [(((), ()), sides, [(piece, start, stop)])], Clock()).share


def test_an_excess_of_a_set_is_judged_in_the_unit_of_how_far_it_reaches():
    """A disc that the state leaves by ``5e-9`` of its radius is left for certain, one by ``5e-10`` is not."""
    case, loop, v, M = made("box")
    state = case.states(v, M, np.array([0.25]))[0]
    height = case.height(np.array([[-1.0, 0.0]]) @ state)[0, 0]
    z = np.array([-1.0, 0.0])
    with ctx.workprec(192):
        for excess, left in ((5e-9, True), (2e-9, True), (5e-10, False), (-1e-9, False)):
            radius = float(height) / (1.0 + excess)
            if left:
                with pytest.raises(Broken):
                    shown(loop, radius, z, 0.25, 0.25)
            else:
                assert shown(loop, radius, z, 0.25, 0.25) == pytest.approx(excess, abs=1e-11)
        with pytest.raises(Broken):  # at the beginning of a cell it is left for certain, however long that is
            shown(loop, 0.1 * float(height), z, 0.25, 0.3)


def test_what_has_no_times_is_as_far_out_as_at_its_place():
    with ctx.workprec(192):
        still = TimelessTube(
            lambda place, rows: [x * (place + 1) for x in (rows * exactly(np.ones((2, 1)))).entries()], np.eye(2)
        )
        polynomials = still.cells(2, 0.0, 0.0, np.array([[1.0, 0.0], [1.0, -0.25]]))
    assert [float(poly.coefficients[0, 0]) for poly in polynomials] == [3.0, 2.25]
    assert all(0.0 <= poly.error < 1e-15 for poly in polynomials)


def test_an_innovation_adds_up_what_a_disturbance_did_on_every_part_of_its_piece():
    """``x' = w`` on a grid that divides the pieces of the control: 1 after the first, nothing of it later."""
    plant = LinearSystem(np.zeros((1, 1)), np.ones((1, 1)), E=np.ones((1, 1)))
    grid, pieces = [0.0, 0.25, 0.5, 1.0, 1.5, 2.0, 3.0], [0.0, 1.0, 2.0, 3.0]
    with ctx.workprec(192):
        for changes, seen in (
            ([0.0, 1.0, 2.0], [{}, {0: 1.0}, {1: 1.0}]),
            ([0.0, 0.5, 1.5], [{}, {0: 0.5, 1: 0.5}, {1: 0.5, 2: 0.5}]),
            ([0.0], [{}, {0: 1.0}, {0: 1.0}]),
        ):
            loop = VerifiedLoop(
                plant,
                [0.0],
                [arb_mat(1, 1)] * 3,
                np.zeros((3, 3, 1, 1)),
                grid,
                pieces,
                changes,
                Box([-1.0], [1.0]),
                None,
            )
            found = [{b: float(push[0, 0].mid()) for b, push in one.items()} for one in loop.innovations.matrices]
            assert found == seen


def test_the_error_of_a_chord_holds_all_that_is_lost_in_rational_numbers(monkeypatch):
    """Heights, their radii and what a chord may miss are told; the sum is to be no less than the exact one."""
    rng = np.random.default_rng(11)
    ends = {time: Enclosed(rng.normal(size=200), 1e-3 * rng.uniform(size=200)) for time in (0.25, 0.5)}
    missed = 1e-2 * rng.uniform(size=200)
    monkeypatch.setattr(LoopTube, "_enclose_heights", lambda self, piece, time, z: ends[time])
    tube = LoopTube(SimpleNamespace(bound_chord_error=lambda *given: missed), np.eye(2), np.zeros((2, 0)))
    found = tube.cells(0, 0.25, 0.5, np.zeros((200, 2)))
    for i, poly in enumerate(found):
        radius = max(Fraction(part.rad[i]) for part in ends.values())
        unit = Fraction(rounding(2))
        lost = radius + Fraction(missed[i]) + unit * sum(Fraction(abs(part.mid[i])) for part in ends.values())
        assert lost <= Fraction(poly.error) <= lost * (1 + Fraction(1, 10**9))
        assert poly.expansion == missed[i]
        assert poly.coefficients[0, 0] == ends[0.25].mid[i]
        assert poly.coefficients[:, 0].sum() == pytest.approx(ends[0.5].mid[i], rel=1e-14)
    (still,) = tube.cells(0, 0.25, 0.25, np.zeros((200, 2)))[:1]
    assert still.expansion == 0.0 and still.coefficients.shape[0] == 1
