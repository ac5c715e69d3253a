"""Guards checker.reach.followed_inputs: errors of execution: integrals of absolute values, and their bends."""

from __future__ import annotations

import math
from collections.abc import Sequence
from itertools import pairwise
from types import SimpleNamespace
from typing import cast

import numpy as np
import pytest
from flint import arb, arb_mat, ctx
from scipy.integrate import quad
from scipy.linalg import expm
from scipy.optimize import brentq

from sparserob_core.checker.arithmetic.series import stacked
from sparserob_core.checker.outcome import Clock
from sparserob_core.checker.reach import adjoint, followed_inputs
from sparserob_core.checker.reach.adjoint import ORDER, AdjointFlow, AdjointRow
from sparserob_core.checker.reach.bounded_inputs import SizedInput
from sparserob_core.checker.reach.followed_inputs import FollowedInput, SupportIntegrals
from sparserob_core.checker.sets import polynomials, summands
from sparserob_core.checker.sets.known import summands_of
from sparserob_core.checker.sets.polynomials import Enclosed
from sparserob_core.checker.sets.summands import Summand, channels
from sparserob_core.control.sets.sets import Box, NormBall
from sparserob_core.sip.convex_set import ConvexSet

A = np.array([[0.0, 1.0], [-4.0, -0.3]])
B = np.array([[0.2, 0.0], [1.0, -0.7]])
SHARES = np.array([0.1, 0.03])
CONTROL = np.array([[0.0, 0.8, -0.8, 0.0, 0.3, 0.0], [0.5, 0.0, 0.0, -0.2, 0.0, 1.0]])
POINTS = np.linspace(0.0, 3.0, 7)
C = np.array([1.0, -0.4])


def followed(A: Sequence[Sequence[float]], B: Sequence[Sequence[float]], entering: SizedInput) -> FollowedInput:
    flow = AdjointFlow.of(arb_mat(A), arb_mat(B), float(entering.breakpoints[-1]), Clock())
    return FollowedInput(lambda c: AdjointRow.of(flow, c), entering)


def single(share: float, horizon: float) -> SizedInput:
    """A share of a command of 1/4 all the time."""
    return SizedInput(np.array([share]), np.array([0.0, horizon]), [stacked([[arb(0.25)]])], channels(1))


@pytest.fixture(scope="module")
def execution() -> FollowedInput:
    with ctx.workprec(128):
        pieces = [stacked([[arb(float(v))] for v in u]) for u in CONTROL.T]
        return followed(A.tolist(), B.tolist(), SizedInput(SHARES, POINTS, pieces, channels(2)))


def weight(j: int, begin: float, end: float) -> float:
    """``int |c'e^{A s} B_j| ds`` from one age to another."""
    if end <= begin:
        return 0.0
    ages = np.linspace(begin, end, 200)
    heights = [_height(age, j) for age in ages]
    crossed = [i for i in range(199) if heights[i] * heights[i + 1] < 0.0]
    turns = [float(brentq(_height, ages[i], ages[i + 1], args=(j,), xtol=1e-15)) for i in crossed]
    parts = pairwise([begin, *turns, end])
    return sum(abs(float(quad(_height, low, high, args=(j,), epsabs=1e-13)[0])) for low, high in parts)


def _height(age: float, j: int) -> float:
    return float(C @ expm(A * age) @ B[:, j])


@pytest.mark.parametrize("age", [0.0, 1e-9, 0.41, 1.5])
def test_integrals_are_enclosed_closely(execution: FollowedInput, age: float) -> None:
    ((low,),), ((high,),) = execution.integrals(C, np.array([age]), np.zeros(1))
    for j in range(2):
        assert low[j] - 1e-12 <= weight(j, 0.0, age) <= high[j] + 1e-12  # what quadrature is worth
        assert 0.0 <= high[j] - low[j] <= 2e-13 * max(high[j], 1e-3)


def test_what_a_command_adds_at_least_is_hardly_less_than_it_adds(execution: FollowedInput) -> None:
    least = execution.least(C, 1.7)
    for k in range(6):
        for j in range(2):
            true = SHARES[j] * weight(j, max(1.7 - POINTS[k + 1], 0.0), max(1.7 - POINTS[k], 0.0))
            assert true - 1e-9 <= least[k, j] <= true + 1e-9
    assert not least[4:].any()


@pytest.mark.parametrize("time", [0.0, 0.5, 1.7, 3.0])
def test_the_errors_of_a_control_add_up(execution: FollowedInput, time: float) -> None:
    low, high = execution.added(C, time)
    true = sum(
        SHARES[j] * abs(CONTROL[j, k]) * weight(j, max(time - POINTS[k + 1], 0.0), max(time - POINTS[k], 0.0))
        for k in range(6) for j in range(2)
    )  # fmt: skip
    assert low <= high <= low + 1e-12
    assert low - 1e-9 <= true <= high + 1e-9


def test_a_chord_is_missed_by_no_more_than_is_said_and_hardly_less(execution: FollowedInput) -> None:
    ratios = []
    for start, stop in [(0.0, 0.5), (0.6, 0.8), (1.0, 1.1), (2.05, 2.45), (2.5, 2.51)]:
        share = np.linspace(0.0, 1.0, 41)
        path = np.array([execution.added(C, start + (stop - start) * s)[0] for s in share])
        off = (path - (1 - share) * path[0] - share * path[-1]).max()
        ratios.append(off / execution.bound_chord_error(C, start, stop))
    assert 0.5 < max(ratios) <= 1.0


@pytest.mark.parametrize("rate", [-6.0, 6.0])
def test_a_chord_is_missed_by_no_more_wherever_it_begins_among_the_parts(rate: float) -> None:
    """The weight falls, or grows, by a tenth from one part to the next, so that the bound of a neighbour is seen."""
    with ctx.workprec(128):
        one = followed([[rate]], [[1.0]], single(0.5, 3.0))
        row = one.adjoints(np.ones(1))
        part, length = row.step, row.step / 64
        for number in range(1, row.count - 1):
            for begin in (number * part + 1e-9, (number + 1) * part - length - 1e-9):
                heights = [(np.exp(rate * (begin + s * length)) - 1.0) / rate / 8.0 for s in (0.0, 0.5, 1.0)]
                missed = abs(heights[1] - (heights[0] + heights[2]) / 2)
                bound = one.bound_chord_error(np.array([1.0]), begin, begin + length)
                assert missed * (1.0 - 1e-6) - 1e-15 * max(heights) <= bound
                assert bound <= missed * np.exp(3.0 * 6.0 * part) + 1e-15 * max(heights)


@pytest.mark.parametrize("rate", [10.0, 300.0, 1e4])
def test_integrals_of_fast_modes_are_enclosed_closely(rate: float) -> None:
    """``|c'e^{A s} B| = rate e^{-rate s}``: the integral is ``1 - e^{-rate age}``, at ages that are no floats too."""
    times, points = np.array([0.3, 1.1, 2.0]), np.array([0.0, 0.1, 0.3 - 1e-3 / rate, 0.7, 1.1 - 0.2 / rate])
    with ctx.workprec(128):
        one = followed([[0.0, 1.0], [0.0, -rate]], [[0.0], [rate]], single(0.5, 2.0))
        low, high = one.integrals(np.array([0.0, 1.0]), times, points)
        for i, time in enumerate(times.tolist()):
            for k, point in enumerate(points.tolist()):
                age = arb(time) - arb(point)
                true = 1 - (-arb(rate) * age).exp() if age > 0 else arb(0)
                assert arb(low[i, k, 0]) <= true <= arb(high[i, k, 0])
                assert high[i, k, 0] - low[i, k, 0] <= 1e-13


def test_rows_and_their_opposites_are_made_once(execution: FollowedInput) -> None:
    assert execution._integrate_along(C) is execution._integrate_along(-C)


def test_many_intervals_are_bounded_as_each_alone(execution: FollowedInput) -> None:
    start, stop = np.array([0.0, 0.6, 2.05]), np.array([0.5, 0.8, 2.45])
    each = [execution.bound_chord_error(C, a, b) for a, b in zip(start, stop, strict=True)]
    np.testing.assert_array_equal(execution.bound_chord_errors(C, start, stop), each)
    low, high = execution.added_at(C, stop)
    assert [(a, b) for a, b in zip(low, high, strict=True)] == [execution.added(C, t) for t in stop]


def test_what_is_added_at_least_counts_only_what_is_sure(execution: FollowedInput) -> None:
    (low,), (high,) = execution.integrals(C, np.array([1.7]), POINTS)
    assert (execution.least(C, 1.7) <= np.maximum(SHARES * (low[:-1] - high[1:]), 0.0)).all()


def test_sums_and_jumps_are_off_by_what_is_rounded(execution: FollowedInput) -> None:
    which, change, off = execution.jumps
    (low,), (high,) = execution.integrals(C, np.array([2.9]), POINTS[which])
    up, down = np.maximum(change, 0.0), np.minimum(change, 0.0)
    size, found = float((np.abs(change) * high).sum()), execution.added(C, 2.9)
    assert found[0] <= (up * low + down * high).sum() - 1e-15 * size
    assert found[1] >= (up * high + down * low).sum() + 1e-15 * size
    assert (off >= 1e-16 * np.abs(change)).all()
    assert (
        off[np.abs(CONTROL.T[which]) > 0.0]
        >= 2e-16 * (SHARES * np.abs(CONTROL.T[which]))[np.abs(CONTROL.T[which]) > 0.0]
    ).all()


def test_an_age_that_is_rounded_is_so_in_its_integral(
    execution: FollowedInput, monkeypatch: pytest.MonkeyPatch
) -> None:
    plain = execution.integrals(C, np.array([2.0]), np.zeros(1))
    coarse = lambda times, points: (times - points, np.full((times - points).shape, 1e-3))  # noqa: E731
    monkeypatch.setattr("sparserob_core.checker.reach.followed_inputs.difference", coarse)
    low, high = execution.integrals(C, np.array([2.0]), np.zeros(1))
    speeds = np.array([abs(_height(2.0, j)) for j in range(2)])
    assert (high[0, 0] - plain[1][0, 0] >= 1e-3 * speeds).all() and (plain[0][0, 0] - low[0, 0] >= 1e-3 * speeds).all()


STIRRED = {"box": Box([-0.2, 0.0], [0.5, 0.3]), "ball": NormBall(2.0, 0.3, dimension=2)}


def stirred(bound: ConvexSet) -> FollowedInput:
    """The measurable disturbances of a set, about its middle."""
    summands = summands_of(bound)
    whole = stacked([[arb(1)]] * len(summands))
    return followed(A.tolist(), B.tolist(), SizedInput(np.ones(len(summands)), np.array([0.0, 3.0]), [whole], summands))


@pytest.mark.parametrize("name", STIRRED)
def test_a_measurable_disturbance_adds_what_its_support_function_does_over_time(name: str) -> None:
    bound = STIRRED[name]
    one, centre = stirred(bound), bound.middle()

    def support(age: float) -> float:
        y = np.array([_height(age, 0), _height(age, 1)])
        return float(bound.support(y[None])[0] - y @ centre)

    for time in (0.0, 0.4, 2.9):
        low, high = one.added(C, time)
        true = quad(support, 0.0, time, epsabs=1e-12, limit=400)[0]
        assert low - 1e-9 <= true <= high + 1e-9 and high - low <= 1e-12
    start, stop = np.linspace(0.0, 2.9, 30), np.linspace(0.1, 3.0, 30)
    heights = [one.added_at(C, start + (stop - start) * share)[0] for share in np.linspace(0.0, 1.0, 9)]
    missed = [h - (1.0 - k / 8) * heights[0] - k / 8 * heights[-1] for k, h in enumerate(heights)]
    ratios = np.max(missed, axis=0) / one.bound_chord_errors(C, start, stop)
    assert 0.3 < ratios.max() <= 1.0


def test_what_is_added_is_off_by_what_its_integrals_are(execution: FollowedInput) -> None:
    """Also where a support function is negative."""
    low, high = np.array([[-3.0, 1.0]]), np.array([[2.0, 1.5]])
    stub = SimpleNamespace(at=lambda ages, rounded: (low.repeat(len(ages), 0), high.repeat(len(ages), 0)))
    one = FollowedInput(execution.adjoints, SizedInput(np.ones(2), np.array([0.0, 3.0]), [stacked([[arb(1)]] * 2)], []))
    one.__dict__["_integrate_along"] = lambda c: stub
    least, most = one.added(C, 1.0)
    assert -2.0 - 1e-13 <= least <= -2.0 - 1e-15
    assert 3.5 + 1e-15 <= most <= 3.5 + 1e-13
    assert one.added(C, 0.0) == (0.0, 0.0)


def told(monkeypatch: pytest.MonkeyPatch, unit: float, half: float, outward: float) -> None:
    """Let the modules believe that their arithmetic is as coarse as they are told."""
    for module in (adjoint, followed_inputs, polynomials, summands):
        monkeypatch.setattr(module, "rounding", lambda count: count * unit)
        monkeypatch.setattr(module, "HALF_ULP", half, raising=False)
        monkeypatch.setattr(module, "OUTWARD", outward)


COARSE = 1e-6


def test_what_rounding_may_lose_is_in_every_radius_of_integrals(monkeypatch: pytest.MonkeyPatch) -> None:
    steps, shares, times = np.array([3, 9]), np.array([0.25, 0.75]), np.array([0.3, 2.2, 2.99])

    def radii(unit: float, outward: float) -> dict[str, np.ndarray]:
        with monkeypatch.context() as patched, ctx.workprec(128):
            told(patched, unit, 0.0, outward)
            one = stirred(STIRRED["box"])
            known = one._integrate_along(C)
            found = {"swept": np.subtract(*known.at(times)[::-1]), "added": np.subtract(*one.added_at(C, times)[::-1])}
            ends, parts = known._end_integrals[:, 1:], known._integrate_steps(steps, shares)
            return found | {"ends": ends[1] - ends[0], "parts": parts[1] - parts[0]}

    plain, rough, outward = radii(0.0, 1.0), radii(COARSE, 1.0), radii(COARSE, 2.0)
    for name in plain:
        assert (rough[name] - plain[name] > 0.0).all(), name
        assert (outward[name] >= 1.8 * rough[name]).all(), name


def swept(mid: list[list[float]], rad: float, sides: list[list[float]], step: float = 0.5) -> SupportIntegrals:
    """Of a row of which ``l'F`` on every step has these first terms in each of two columns, of which the second is the
    one that counts."""
    table = np.zeros((len(mid), ORDER + 1, 2))
    table[:, : len(mid[0]), 1] = mid
    off = np.zeros_like(table)
    off[:, 0, 1] = rad
    row = SimpleNamespace(driven=Enclosed(table, off), count=len(mid), step=step)
    row.placed = lambda times: AdjointRow.placed(cast(AdjointRow, row), times)
    every = [Summand(np.array(side)[:, None], np.zeros((len(side), 1))) for side in sides]
    return SupportIntegrals(cast(AdjointRow, row), slice(1, None), every)


TERMS = [[-1.0, 3.0, 0.5], [2.0, -0.5, -4.0], [0.3, 1.0, 0.0]]


def height(time: float, corners: list[float], moved: float) -> float:
    step = min(int(time / 0.5), 2)
    value = np.polynomial.polynomial.polyval(time / 0.5 - step, TERMS[step])
    return float(max(corner * (value + moved * np.sign(corner)) for corner in corners))


@pytest.mark.parametrize("rad", [0.0, 1e-3])
def test_integrals_of_support_functions_hold_the_least_and_the_most_and_hardly_more(rad: float) -> None:
    sides = [[1.0, -1.0], [0.5, -2.0]]
    known, times = swept(TERMS, rad, sides), np.array([0.0, 0.2, 0.5, 0.8, 1.3, 1.5])
    low, high = known.at(times)
    for j, corners in enumerate(sides):
        for i, time in enumerate(times.tolist()):
            ends = [0.0, *(t for t in (0.5, 1.0) if t < time), time]
            most, least = (
                sum(quad(height, a, b, (corners, moved), epsabs=1e-13, limit=200)[0] for a, b in pairwise(ends))
                for moved in (rad, -rad)
            )
            assert low[i, j] <= least + 1e-9 and most <= high[i, j] + 1e-9
            assert high[i, j] <= most + 6.0 * rad * time + 1e-9 and low[i, j] >= least - 6.0 * rad * time - 1e-9
            assert rad or high[i, j] - low[i, j] <= 1e-12


def test_a_time_that_is_rounded_counts_as_much_as_the_support_function_is_high_near_it() -> None:
    """Also where the step beside is the higher one."""
    times, off = np.arange(5) / 2 + 0.1, 1e-3
    known = swept([[1.0], [4.0], [1.0], [1.0], [0.5]], 0.25, [[1.0, -1.0], [2.0]])
    plain, rough = known.at(times), known.at(times, np.full(5, off))
    heights = np.array([4.25, 4.25, 4.25, 1.25, 1.25])[:, None] * [1.0, 2.0]
    np.testing.assert_allclose(rough[1] - plain[1], off * heights, rtol=1e-8)
    np.testing.assert_allclose(plain[0] - rough[0], off * heights, rtol=1e-8)


def test_every_term_of_a_polynomial_counts_in_what_it_is_off_by_and_what_rounding_makes_of_it(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    def errors(unit: float, outward: float) -> np.ndarray:
        known = swept(TERMS, 0.0, [[1.0]])
        known.row.driven.rad[:, 1:4, 1] = 1e-3
        with monkeypatch.context() as patched:
            told(patched, unit, 0.0, outward)
            return known._polynomials[1][:, 0]

    np.testing.assert_allclose(errors(0.0, 1.0), 3e-3)
    np.testing.assert_allclose(errors(COARSE, 1.0), 3e-3 + COARSE * 2 * ORDER * np.abs(TERMS).sum(axis=1))
    np.testing.assert_allclose(errors(0.0, 2.0), 6e-3)


def test_integrals_are_off_by_what_all_steps_are_and_by_what_their_sum_is_rounded(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """The integrals of all steps are given, with bounds; of a part of a step too."""
    each, outward, half = np.array([2.0**40, 1.0, -(2.0**40), 1.0]), 1.5, 1e-7

    def found(_: object, P: np.ndarray, *__: object) -> tuple[np.ndarray, np.ndarray]:
        values = (each if len(P) == each.size else np.ones(len(P)))[:, None]
        return values - 0.2, values + 0.1

    known = swept([[1.0]] * 4, 0.0, [[1.0]])
    with monkeypatch.context() as patched, ctx.workprec(128):
        told(patched, 0.0, half, outward)
        patched.setattr(followed_inputs, "integrate", found)
        ends, ((low,), (high,)) = known._end_integrals[:, :, 0], known.at(np.array([1.75]))[:, :, 0]
    for bounds, off, bound, sign in zip(ends, (-0.2, 0.1), (low, high), (-1.0, 1.0), strict=True):
        truth = [math.fsum(0.5 * (each[:k] + off)) for k in range(5)]
        assert bounds.tolist() == truth
        total = truth[3] + 0.5 * (1.0 + off)
        assert bound == pytest.approx(total + sign * 4.0 * half * (abs(truth[3]) + abs(total)) * outward, rel=1e-14)
