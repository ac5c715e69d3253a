"""Guards checker/reach/bounded_inputs: what enters at any time: integrals of absolute
values between closed forms, and their bends."""

from __future__ import annotations

from fractions import Fraction
from itertools import pairwise
from types import ModuleType

import numpy as np
import pytest

pytest.importorskip("flint")
from flint import arb, arb_mat, ctx

import sparserob_core as sr
import sparserob_core.checker.arithmetic.models as models
import sparserob_core.checker.flow.flow as flows
import sparserob_core.checker.flow.law as laws
import sparserob_core.checker.flow.segment as segments
from sparserob_core.checker.arithmetic.series import stacked
from sparserob_core.checker.flow.flow import VerifiedFlow
from sparserob_core.checker.flow.plant import Plant
from sparserob_core.checker.outcome import Clock
from sparserob_core.checker.reach.adjoint import AdjointFlow, AdjointRow
from sparserob_core.checker.reach.bounded_inputs import BoundedInputAt, SizedInput
from sparserob_core.checker.reach.followed_inputs import FollowedInput
from sparserob_core.checker.sets.known import middle, summands_of
from sparserob_core.checker.sets.summands import Summand, channels
from sparserob_core.control.problem.system import VaryingSystem
from sparserob_core.sip.convex_set import Array

SHARES = np.array([0.1, 0.03])
CONTROL = np.array([[0.0, 0.8, -0.8, 0.0, 0.3, 0.0], [0.5, 0.0, 0.0, -0.2, 0.0, 1.0]])
POINTS = np.linspace(0.0, 3.0, 7)
A, B = np.array([[0.0, 1.0], [-4.0, -0.3]]), np.array([[0.2, 0.0], [1.0, -0.7]])
ROCKET = VaryingSystem.of([[0, 1], [0, 0]], [[0, 0], ["1/(4 - t)", 0]], 3.0)
FADING = VaryingSystem.of([["-1/(1 + t)"]], [["t", 1]], 3.0, [["exp(-t)"]])
WILD = VaryingSystem.of([["-t", 2], [-1, "t"]], [["t^2", 0], ["cos(9*t)", 1]], 3.0)
C = np.array([1.0, -0.4])


def made(system: VaryingSystem, control: Array = CONTROL) -> BoundedInputAt:
    pieces = [stacked([[arb(float(v))] for v in u]) for u in control.T]
    return BoundedInputAt(VerifiedFlow(Plant.of(system, 3.0), 3.0), SizedInput(SHARES, POINTS, pieces, channels(2)))


def test_a_constant_that_is_dressed_is_the_constant() -> None:
    with ctx.workprec(192):
        system = VaryingSystem.of(*([[f"{x} + 0*t" for x in row] for row in part] for part in (A, B)), 3.0)
        found = made(system)
        flow = AdjointFlow.of(arb_mat(A.tolist()), arb_mat(B.tolist()), 3.0, Clock())
        plain = FollowedInput(lambda c: AdjointRow.of(flow, c), found.input)
        for time in (0.0, 0.3, 1.7, 3.0):
            one, other = found.added(C, time), plain.added(C, time)
            assert one[0] <= other[1] and other[0] <= one[1] <= one[0] + 1e-12
            np.testing.assert_allclose(found.least(C, time), plain.least(C, time), atol=1e-12)


def primitive(time: float, s: float) -> float:
    """That of ``(time - s - 0.4) / (4 - s)``."""
    return s + (4.4 - time) * float(np.log(4.0 - s))


@pytest.mark.parametrize("time", [0.5, 1.7, 3.0])
def test_a_falling_mass_is_between_the_bounds_of_the_closed_form(time: float) -> None:
    with ctx.workprec(192):
        found = made(ROCKET)
        least, (low, high) = found.least(C, time), found.added(C, time)
    truth = np.zeros(6)
    for k, begin in enumerate(POINTS[:-1]):
        a, b = min(begin, time), min(begin + 0.5, time)
        turn = float(np.clip(time - 0.4, a, b))
        ends = [primitive(time, float(one)) for one in (a, turn, b)]
        truth[k] = abs(ends[1] - ends[0]) + abs(ends[2] - ends[1])
    assert (least[:, 0] <= 0.1 * truth + 1e-15).all() and not least[:, 1].any()
    np.testing.assert_allclose(least[:, 0], 0.1 * truth, atol=1e-12)
    whole = float(0.1 * np.abs(CONTROL[0]) @ truth)
    assert low <= whole + 1e-15 and whole - 1e-15 <= high <= low + 1e-12


@pytest.mark.parametrize("side", [None, sr.NormBall(1.0, 1.0, dimension=2), sr.NormBall(2.0, 1.0, dimension=2)])
def test_what_is_large_is_not_enclosed_more_coarsely_than_rounding_does(side: sr.ConvexSet | None) -> None:
    """A lower bound is written with what rounding may do to the numbers that are added up to it: bounds that are 1e-12
    of an integral apart would refute honest runs."""
    with ctx.workprec(192):
        found = made(ROCKET)
        if side is not None:
            form, one = summands_of(side), [stacked([[arb(1)]])] * 6
            found = BoundedInputAt(VerifiedFlow(Plant.of(ROCKET, 3.0), 3.0), SizedInput(np.ones(1), POINTS, one, form))
        low, high = found.added(np.array([1.0, 0.0]), 3.0)
    assert 0.0 < high - low <= 3e-13 * high


@pytest.mark.parametrize(
    ("module", "name", "value"),
    [
        (None, "", 0),
        (segments, "TERMS", 4),
        (flows, "ENOUGH", 1e-3),
        (models, "ENOUGH", 1e-9),
    ],
)
def test_balls_of_a_kernel_hold_the_closed_form(
    module: ModuleType | None, name: str, value: object, monkeypatch: pytest.MonkeyPatch
) -> None:
    with ctx.workprec(192):
        flow, widest = VerifiedFlow(Plant.of(FADING, 3.0), 3.0), 0.0
        stretches = flow.law.stretches
        if module is models:
            monkeypatch.setattr(laws, "SHARP", 1e-6)
            flow = VerifiedFlow(Plant.of(FADING, 3.0), 3.0)
        if module is not None:
            monkeypatch.setattr(module, name, value)
        for part in stretches:
            (terms, off), h = flow.kernel(part.start, part.stop), arb(part.stop) - arb(part.start)
            for left in (arb(0), arb(3) / 10, arb(1)):
                s = arb(part.stop) - left * h
                exact = [h * one * (1 + s) / (1 + arb(part.stop)) for one in (s, arb(1), (-s).exp())]
                for j, truth in enumerate(exact):
                    ball = sum((one.matrix[0, j] * left**n for n, one in enumerate(terms)), arb(0, float(off[0, j])))
                    assert ball.overlaps(truth)
                    widest = max(widest, float(ball.rad()))
    assert widest > 1e-12 if name else widest < 1e-17


def test_what_the_system_is_at_most_and_how_fast_it_changes_is_not_exceeded() -> None:
    with ctx.workprec(192):
        flow = VerifiedFlow(Plant.of(WILD, 3.0), 3.0)
        for part in flow.law.stretches:
            most, slope, _ = flow.sizes(part.start, part.stop)
            t = np.linspace(part.start, part.stop, 9)
            for found, inside in ((most[:, :2], np.array([[t, 2 + 0 * t], [1 + 0 * t, t]])),
                                  (most[:, 2:4], np.array([[t**2, 0 * t], [np.cos(9 * t), 1 + 0 * t]])),
                                  (slope[:, :2], np.array([[1 + 0 * t, 0 * t], [0 * t, 1 + 0 * t]])),
                                  (slope[:, 2:4], np.array([[2 * t, 0 * t], [9 * np.sin(9 * t), 0 * t]]))):  # fmt: skip
                highest = np.abs(inside).max(axis=2)
                assert (highest <= found * (1 + 1e-12)).all()
                assert (found <= 3.0 * highest + 2.0).all()


@pytest.mark.parametrize("system", [ROCKET, pytest.param(WILD, marks=pytest.mark.slow)], ids=["rocket", "wild"])
def test_a_chord_is_missed_by_no_more_than_is_said_and_hardly_less(system: VaryingSystem) -> None:
    ratios, share = [], np.linspace(0.0, 1.0, 5)
    with ctx.workprec(192):
        found = made(system)
        for begin, end in list(pairwise(found.marks))[1::4]:
            for start, stop in ((begin, end), (begin + 0.3 * (end - begin), begin + 0.4 * (end - begin))):
                path = np.array([found.added(C, float(start + (stop - start) * s))[0] for s in share[:-1]])
                path = np.append(path, found.added(C, stop)[0])
                above = (path - (1 - share) * path[0] - share * path[-1]).max()
                said = found.bound_chord_error(C, start, stop)
                assert above <= said * (1 + 1e-9) + 1e-13
                ratios.append(above / max(said, 1e-12))
    assert max(ratios) > (0.4 if system is ROCKET else 0.2)


def test_what_begins_within_a_cell_bends_it_too() -> None:
    share, control = np.linspace(0.0, 1.0, 7), np.zeros((2, 6))
    control[0, 2] = 1.0
    with ctx.workprec(192):
        found = made(ROCKET, control)
        stop = min(1.5, *(one for one in found.marks if one > 1.0))
        path = np.array([found.added(C, float(t))[0] for t in 1.0 + share * (stop - 1.0)])
        above = (path - (1 - share) * path[0] - share * path[-1]).max()
        assert above <= found.bound_chord_error(C, 1.0, stop) and above > 0.0


def test_bounds_allow_for_what_is_rounded_and_for_the_size_of_the_control() -> None:
    with ctx.workprec(192):
        found = made(ROCKET)
        low, high = found.added(C, 2.9)
        assert high - low >= 1e-15 * high
        ball = arb(0.5, 1e-3)
        wide = BoundedInputAt(found.law, SizedInput(SHARES, POINTS, [stacked([[ball], [arb(0)]])] * 6, channels(2)))
        fixed = made(ROCKET, np.tile([[0.501], [0.0]], (1, 6)))
        thin = made(ROCKET, np.tile([[0.499], [0.0]], (1, 6)))
        assert wide.added(C, 2.9)[1] >= fixed.added(C, 2.9)[0]
        assert wide.added(C, 2.9)[0] <= thin.added(C, 2.9)[1]


def entering(system: VaryingSystem, off: float = 0.0) -> BoundedInputAt:
    """A command of 1 through ``E`` that is missed by 0.25."""
    one, ends = [stacked([[arb(1)]])], np.array([0.0, 3.0])
    summand = Summand(np.array([[1.0], [-1.0]]), np.full((2, 1), 4.0 * off))
    entering = SizedInput(np.array([0.25]), ends, one, [summand], system.controls)
    return BoundedInputAt(VerifiedFlow(Plant.of(system, 3.0), 3.0), entering)


@pytest.mark.parametrize("time", [0.0, 0.7, 3.0])
def test_what_enters_by_the_last_columns_is_between_the_bounds_of_the_closed_form(time: float) -> None:
    # (1 + t) x adds up (1 + s) e^-s
    truth = 0.25 * (2.0 - (2.0 + time) * np.exp(-time)) / (1.0 + time)
    with ctx.workprec(192):
        low, high = entering(FADING).added(np.array([-1.0]), time)
        assert low <= truth * (1 + 1e-15) and truth * (1 - 1e-15) <= high <= low + 1e-12
        low, high = entering(FADING, 1e-3).added(np.array([-1.0]), time)
        assert low <= truth * 0.249 / 0.25 and truth * 0.251 / 0.25 <= high <= low + 1.7e-2 * truth


def test_what_enters_by_the_last_columns_bends_as_it_does() -> None:
    # of the columns, the first one is 0 and would not bend
    system = VaryingSystem.of([[0, 1], [0, 0]], [[0], [0]], 3.0, [["0*t"], ["1/(4 - t)"]])
    share, ratios = np.linspace(0.0, 1.0, 7), []
    with ctx.workprec(192):
        found = entering(system)
        for start, stop in pairwise(found.marks):
            path = np.array([found.added(C, float(t))[1] for t in start + share[:-1] * (stop - start)])
            path = np.append(path, found.added(C, stop)[1])
            above = (path - (1 - share) * path[0] - share * path[-1]).max()
            said = found.bound_chord_error(C, start, stop)
            assert above <= said * (1 + 1e-9) + 1e-13
            ratios.append(above / max(said, 1e-12))
    assert max(ratios) > 0.1


def test_sizes_are_those_of_absolute_values() -> None:
    pieces = [arb_mat([[arb(-1.5, 1e-3)], [arb(0.5, 1e-3)]]), arb_mat([[arb(2.0, 1e-3)], [arb(-4.0, 1e-3)]])]
    shares, values = np.array([0.1, 0.25]), np.array([[1.5, 0.5], [2.0, 4.0]])
    found = SizedInput(shares, np.array([0.0, 1.0, 2.0]), pieces, channels(2)).sizes
    assert found.mid == pytest.approx(shares * values, rel=1e-14)
    assert found.rad == pytest.approx(np.broadcast_to(shares * 1e-3, (2, 2)), rel=1e-8)
    assert (shares * 1e-3 <= found.rad).all()


def test_a_thin_set_whose_middle_is_rounded_adds_no_less_than_nothing() -> None:
    """Of the segment from (0, 0) to (1, 1/3) across its own direction: the middle is a rounding away from it."""
    thin = sr.Polytope(np.array([[-1.0, 3.0], [1.0, -3.0], [1.0, 0.0], [-1.0, 0.0]]), np.array([0.0, 0.0, 1.0, 0.0]))
    still = sr.LinearSystem(np.zeros((2, 2)), np.array([[0.0], [1.0]]), np.eye(2))
    with ctx.workprec(192):
        one, ends = [stacked([[arb(1)]])], np.array([0.0, 1.0])
        entering = SizedInput(np.ones(1), ends, one, summands_of(thin), 1)
        found = BoundedInputAt(VerifiedFlow(Plant.of(still, 1.0), 1.0), entering)
        about = middle(thin)
        for c in (np.array([-1.0, 3.0]), np.array([1.0, -3.0])):
            exact = sum(Fraction(float(a)) * Fraction(float(m)) for a, m in zip(c, about, strict=True))
            low, high = found.added(c, 1.0)
            assert Fraction(low) + exact <= 0 <= Fraction(high) + exact
            assert high - low < 1e-12
