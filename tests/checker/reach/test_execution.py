"""Guards checker/reach/execution: errors of execution: integrals of absolute values, and their bends."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest
from scipy.integrate import quad
from scipy.linalg import expm
from scipy.optimize import brentq

import sparserob_core as sr
from sparserob_core.checker.arithmetic.series import stacked
from sparserob_core.checker.reach.execution import FollowedExecution

A = np.array([[0.0, 1.0], [-4.0, -0.3]])
B = np.array([[0.2, 0.0], [1.0, -0.7]])
SHARES = np.array([0.1, 0.03])
CONTROL = np.array([[0.0, 0.8, -0.8, 0.0, 0.3, 0.0], [0.5, 0.0, 0.0, -0.2, 0.0, 1.0]])
POINTS = np.linspace(0.0, 3.0, 7)
C = np.array([1.0, -0.4])


@pytest.fixture(scope="module")
def execution() -> FollowedExecution:
    from flint import arb, ctx

    problem = sr.OptimalControlProblem(
        system=sr.LinearSystem(A, B), horizon=3.0, initial_state=[0.0, 0.0], control=sr.Box([-1.0, -1.0], [1.0, 1.0])
    )
    with ctx.workprec(128):
        pieces = [stacked([[arb(float(v))] for v in u]) for u in CONTROL.T]
        found = FollowedExecution(problem, SHARES, POINTS, pieces)
        _ = found.motion
    return found


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
def test_integrals_are_enclosed_closely(execution: FollowedExecution, age: float) -> None:
    ((low,),), ((high,),) = execution.integrals(C, np.array([age]), np.zeros(1))
    for j in range(2):
        assert low[j] - 1e-12 <= weight(j, 0.0, age) <= high[j] + 1e-12  # what quadrature is worth
        assert 0.0 <= high[j] - low[j] <= 2e-13 * max(high[j], 1e-3)


def test_what_a_command_adds_at_least_is_hardly_less_than_it_adds(execution: FollowedExecution) -> None:
    least = execution.least(C, 1.7)
    for k in range(6):
        for j in range(2):
            true = SHARES[j] * weight(j, max(1.7 - POINTS[k + 1], 0.0), max(1.7 - POINTS[k], 0.0))
            assert true - 1e-9 <= least[k, j] <= true + 1e-9
    assert not least[4:].any()


@pytest.mark.parametrize("time", [0.0, 0.5, 1.7, 3.0])
def test_the_errors_of_a_control_add_up(execution: FollowedExecution, time: float) -> None:
    low, high = execution.added(C, time)
    true = sum(
        SHARES[j] * abs(CONTROL[j, k]) * weight(j, max(time - POINTS[k + 1], 0.0), max(time - POINTS[k], 0.0))
        for k in range(6) for j in range(2)
    )  # fmt: skip
    assert low <= high <= low + 1e-12
    assert low - 1e-9 <= true <= high + 1e-9


def test_a_chord_is_missed_by_no_more_than_is_said_and_hardly_less(execution: FollowedExecution) -> None:
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
    from flint import arb, ctx

    problem = sr.OptimalControlProblem(
        system=sr.LinearSystem([[rate]], [[1.0]]), horizon=3.0, initial_state=[0.0], control=sr.Box([-1.0], [1.0])
    )
    with ctx.workprec(128):
        one = FollowedExecution(problem, np.array([0.5]), np.array([0.0, 3.0]), [stacked([[arb(0.25)]])])
        part, length = one.motion.step, one.motion.step / 64
        for number in range(1, one.motion.count - 1):
            for begin in (number * part + 1e-9, (number + 1) * part - length - 1e-9):
                heights = [(np.exp(rate * (begin + s * length)) - 1.0) / rate / 8.0 for s in (0.0, 0.5, 1.0)]
                missed = abs(heights[1] - (heights[0] + heights[2]) / 2)
                bound = one.bound_chord_error(np.array([1.0]), begin, begin + length)
                assert missed * (1.0 - 1e-6) - 1e-15 * max(heights) <= bound
                assert bound <= missed * np.exp(3.0 * 6.0 * part) + 1e-15 * max(heights)


@pytest.mark.parametrize("rate", [10.0, 300.0, 1e4])
def test_integrals_of_fast_modes_are_enclosed_closely(rate: float) -> None:
    """``|c'e^{A s} B| = rate e^{-rate s}``: the integral is ``1 - e^{-rate age}``, at ages that are no floats too."""
    from flint import arb, ctx

    problem = sr.OptimalControlProblem(
        system=sr.LinearSystem([[0.0, 1.0], [0.0, -rate]], [[0.0], [rate]]),
        horizon=2.0,
        initial_state=[0.0, 0.0],
        control=sr.Box([-1.0], [1.0]),
    )
    times, points = np.array([0.3, 1.1, 2.0]), np.array([0.0, 0.1, 0.3 - 1e-3 / rate, 0.7, 1.1 - 0.2 / rate])
    with ctx.workprec(128):
        one = FollowedExecution(problem, np.array([0.5]), np.array([0.0, 2.0]), [stacked([[arb(0.25)]])])
        low, high = one.integrals(np.array([0.0, 1.0]), times, points)
        for i, time in enumerate(times.tolist()):
            for k, point in enumerate(points.tolist()):
                age = arb(time) - arb(point)
                true = 1 - (-arb(rate) * age).exp() if age > 0 else arb(0)
                assert arb(low[i, k, 0]) <= true <= arb(high[i, k, 0])
                assert high[i, k, 0] - low[i, k, 0] <= 1e-13


def test_rows_and_their_opposites_are_made_once(execution: FollowedExecution) -> None:
    assert execution.absolute(C) is execution.absolute(-C)


def test_many_intervals_are_bounded_as_each_alone(execution: FollowedExecution) -> None:
    start, stop = np.array([0.0, 0.6, 2.05]), np.array([0.5, 0.8, 2.45])
    each = [execution.bound_chord_error(C, a, b) for a, b in zip(start, stop, strict=True)]
    np.testing.assert_array_equal(execution.bound_chord_errors(C, start, stop), each)
    low, high = execution.added_at(C, stop)
    assert [(a, b) for a, b in zip(low, high, strict=True)] == [execution.added(C, t) for t in stop]


def test_what_is_added_at_least_counts_only_what_is_sure(execution: FollowedExecution) -> None:
    (low,), (high,) = execution.integrals(C, np.array([1.7]), POINTS)
    assert (execution.least(C, 1.7) <= np.maximum(SHARES * (low[:-1] - high[1:]), 0.0)).all()


def test_sums_and_jumps_are_off_by_what_is_rounded(execution: FollowedExecution) -> None:
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
    execution: FollowedExecution, monkeypatch: pytest.MonkeyPatch
) -> None:
    plain = execution.integrals(C, np.array([2.0]), np.zeros(1))
    coarse = lambda times, points: (times - points, np.full((times - points).shape, 1e-3))  # noqa: E731
    monkeypatch.setattr("sparserob_core.checker.reach.execution.subtract_times", coarse)
    low, high = execution.integrals(C, np.array([2.0]), np.zeros(1))
    speeds = np.array([abs(_height(2.0, j)) for j in range(2)])
    assert (high[0, 0] - plain[1][0, 0] >= 1e-3 * speeds).all() and (plain[0][0, 0] - low[0, 0] >= 1e-3 * speeds).all()
