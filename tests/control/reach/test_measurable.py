"""Guards control/reach/measurable: measurable disturbances: the limit from above of ever finer piecewise constant
ones."""

from __future__ import annotations

import itertools
from unittest.mock import patch

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.integrate import quad
from scipy.linalg import expm
from scipy.optimize import brentq

from sparserob_core.control.problem.system import LinearSystem, SwitchedSystem, System
from sparserob_core.control.reach import measurable
from sparserob_core.control.response.response import Response
from sparserob_core.control.response.time_grid import merge_grids
from sparserob_core.control.sets.sets import Ellipsoid, NormBall, Polytope
from sparserob_core.sip.convex_set import Box
from tests.support.plants import indicators, random_system, uniform, worst_case

EPSILON = float(np.finfo(float).eps)
HORIZON = 2.0
UNEVEN = indicators([0.0, 0.3, 1.4, HORIZON])
BOUNDS = {
    "box": Box([-0.1, 0.05], [0.3, 0.2]),
    "ellipsoid": Ellipsoid([0.1, 0.0], [[0.04, 0.01], [0.01, 0.09]]),
    "triangle": Polytope([[1.0, 1.0], [-1.0, 0.2], [0.0, -1.0]], [0.3, 0.2, 0.1]),
    "1-norm": NormBall(p=1.0, radius=0.3, dimension=2),
}


def by_quadrature(system, bound, direction, time, parameter=None):
    """A midpoint sum of the support function, error about ``1e-7``."""
    A, _, E = (
        matrix[0] for matrix in system.phases[0].matrices(np.zeros((1, 0)) if parameter is None else parameter[None])
    )
    count = 20000
    step = time / count
    row, flow = direction @ expm(A * step / 2), expm(A * step)
    rows = np.empty((count, row.size))
    for k in range(count):
        rows[k] = row
        row = row @ flow
    return float(bound.support(rows @ E).sum() * step)


@settings(max_examples=12, deadline=None)
@given(seed=st.integers(0, 10**6), speed=st.sampled_from([1.0, 3.0]))
def test_the_support_of_a_box_is_an_integral_of_moduli(seed, speed):
    rng = np.random.default_rng(seed)
    system, direction, time = random_system(rng, speed=speed), rng.normal(size=2), rng.uniform(0.1, HORIZON)
    found = worst_case(system, uniform(40, HORIZON), bound=BOUNDS["box"], kind="measurable").offsets(
        np.array([time]), direction[None], np.zeros((1, 0))
    )
    truth = by_quadrature(system, BOUNDS["box"], direction, time)
    assert abs(found[0] - truth) <= 1e-6 * max(1.0, truth)


@pytest.mark.first(1)
@pytest.mark.parametrize("name", ["ellipsoid", "triangle", "1-norm"])
def test_the_support_of_other_sets_is_an_integral_of_their_support(name):
    rng = np.random.default_rng(2)
    for _ in range(4):
        system, direction, time = random_system(rng), rng.normal(size=2), rng.uniform(0.1, HORIZON)
        functionals = worst_case(system, uniform(40, HORIZON), bound=BOUNDS[name], kind="measurable")
        truth = by_quadrature(system, BOUNDS[name], direction, time)
        assert abs(functionals.offsets(np.array([time]), direction[None], np.zeros((1, 0)))[0] - truth) <= 1e-5 * max(
            1.0, truth
        )


@pytest.mark.parametrize("name", ["ellipsoid", "triangle"])
def test_one_channel_that_changes_sign_inside_a_piece_is_integrated_across_its_kink(name):
    """With one column of E the integrand is a modulus with a kink, whatever the set."""
    system = LinearSystem([[0, 1], [-1, 0]], [[0.0], [1.0]], [[0.0], [1.0]])
    bound = Ellipsoid([0.0], [[1.0]]) if name == "ellipsoid" else Polytope([[1.0], [-1.0]], [1.0, 1.0])
    functionals = worst_case(system, uniform(3, 5.0), bound=bound, kind="measurable")
    truth = quad(lambda s: abs(np.sin(s)), 0, 5.0, points=[np.pi])[0]
    assert abs(functionals.offsets(np.array([5.0]), np.array([[1.0, 0.0]]), np.zeros((1, 0)))[0] - truth) <= 1e-8


@pytest.mark.parametrize("pieces", [1, 2, 3, 5, 50])
def test_a_fast_oscillator_on_coarse_pieces_is_integrated_across_every_root(pieces):
    """``int_0^t |sin(omega s)| / omega ds``, with many roots and extrema inside one piece."""
    omega = 7.0
    system = LinearSystem([[0, 1], [-(omega**2), 0]], [[0.0], [1.0]], [[0.0], [1.0]])
    functionals = worst_case(system, uniform(pieces, 4.0), bound=Box([-1.0], [1.0]), kind="measurable")
    times = np.array([0.3, 1.0, 2.9, 4.0])
    found = functionals.offsets(times, np.tile([1.0, 0.0], (4, 1)), np.zeros((4, 0)))
    halves = np.floor(times * omega / np.pi)
    truth = (2 * halves + 1 - np.cos(omega * times - np.pi * halves)) / omega**2
    assert np.allclose(found, truth, rtol=0, atol=1e-10)


@settings(max_examples=8, deadline=None)
@given(seed=st.integers(0, 10**6), name=st.sampled_from(["box", "ellipsoid"]))
def test_finer_piecewise_constant_disturbances_approach_the_measurable_ones_from_below(seed, name):
    rng = np.random.default_rng(seed)
    system, time, direction = random_system(rng), np.array([HORIZON]), rng.normal(size=(1, 2))
    limit = worst_case(system, uniform(64, HORIZON), bound=BOUNDS[name], kind="measurable").offsets(
        time, direction, np.zeros((1, 0))
    )[0]
    sigmas = [
        worst_case(system, UNEVEN, uniform(4**k, HORIZON), BOUNDS[name]).offsets(time, direction, np.zeros((1, 0)))[0]
        for k in range(6)
    ]
    assert (np.diff(sigmas) >= -1e-12).all()
    assert sigmas[-1] <= limit + 1e-8
    assert limit - sigmas[-1] <= 1e-3 * max(1.0, limit)
    assert limit - sigmas[-1] <= 0.3 * (limit - sigmas[-3]) + 1e-9


def test_times_and_parameters_may_be_mixed_freely():
    rng = np.random.default_rng(4)
    A0, A1 = rng.normal(size=(2, 2)), rng.normal(size=(2, 2))
    system = LinearSystem(lambda p: A0 + p[0] * A1, np.ones((2, 1)), parameters=Box([-1.0], [1.0]))
    functionals = worst_case(system, uniform(40, HORIZON), bound=BOUNDS["box"], kind="measurable")
    times, directions, parameters = (
        np.array([0.0, HORIZON, 1.3, 1.3, 0.7]),
        rng.normal(size=(5, 2)),
        rng.uniform(-1, 1, (5, 1)),
    )
    found = functionals.offsets(times, directions, parameters)
    for k in range(1, 5):
        truth = by_quadrature(system, BOUNDS["box"], directions[k], times[k], parameters[k])
        assert abs(found[k] - truth) <= 1e-6 * max(1.0, truth)
    assert found[0] == 0.0


FLAT = [name for name in BOUNDS if name != "ellipsoid"]


def across_kinks(system, bound, direction, time):
    """The integral of the support function over parts between which one corner of the set takes over from another, each
    by Gauss and Legendre: to about ``1e-14``."""
    A, _, E = (matrix[0] for matrix in system.phases[0].matrices(np.zeros((1, 0))))
    corners = np.unique(
        bound.support_point(np.array([[np.cos(a), np.sin(a)] for a in np.linspace(0, 7, 4001)])), axis=0
    )
    nodes, weights = np.polynomial.legendre.leggauss(20)

    def row(s):
        return direction @ expm(A * s) @ E

    grid = np.linspace(0.0, time, 201)
    best = [int((corners @ row(s)).argmax()) for s in grid]
    ends = [0.0]
    for a, b, i, j in zip(grid[:-1], grid[1:], best[:-1], best[1:], strict=True):
        if i != j:
            ends.append(brentq(lambda s, i=i, j=j: (corners[i] - corners[j]) @ row(s), a, b, xtol=1e-15))
    total = 0.0
    for a, b in itertools.pairwise([*ends, time]):
        middles = a + (b - a) * (nodes + 1) / 2
        total += (b - a) / 2 * sum(w * (corners @ row(s)).max() for s, w in zip(middles, weights, strict=True))
    return total


@pytest.mark.first(3)
@pytest.mark.parametrize("name", FLAT)
@pytest.mark.parametrize("short", [0.5, 4.0])
def test_bounds_of_the_support_of_a_flat_set_hold_it_and_are_close(name, short):
    """On longer intervals what is left of the expansion is large, and the bounds must say so."""
    for seed, speed in enumerate([1.0, 3.0, 12.0]):
        rng = np.random.default_rng(seed)
        system, direction, time = random_system(rng, speed=speed), rng.normal(size=2), rng.uniform(0.5, HORIZON)
        functionals = worst_case(system, uniform(4, HORIZON), bound=BOUNDS[name], kind="measurable")
        with patch.object(measurable, "SHORT", short):
            ((low, high),) = functionals.measurable.enclosed(np.array([time]), direction[None])
        truth = across_kinks(system, BOUNDS[name], direction, time)
        assert low <= truth + 1e-14 * abs(truth)
        assert truth <= high + 1e-14 * abs(truth)
        if short < 1.0:
            assert high - low <= 3e-11 * abs(truth)
            assert functionals.offsets(np.array([time]), direction[None], np.zeros((1, 0)))[0] == (low + high) / 2
        elif speed > 3.0:
            assert high - low > 1e-9 * abs(truth)


@pytest.mark.first(3)
@pytest.mark.parametrize("name", FLAT)
@pytest.mark.parametrize("short", [0.5, 4.0])
def test_bounds_over_turns_hold_what_both_systems_add_and_are_close(name, short):
    """Of the first one all of its turn is integrated for rows that are others at every time."""
    rng = np.random.default_rng(1)
    first, second, direction = (*(random_system(rng, speed=6.0) for _ in range(2)), rng.normal(size=2))
    turn, grid = 0.9, merge_grids(uniform(4, HORIZON).breakpoints, np.array([0.0, HORIZON]), switches=[0.9])
    response = Response(SwitchedSystem([(turn, first), (HORIZON, second)]), grid, np.zeros(2))
    support, A = measurable.MeasurableSupport(response, BOUNDS[name]), second.phases[0].matrices(np.zeros((1, 0)))[0][0]
    for time in (0.4, HORIZON):
        with patch.object(measurable, "SHORT", short):
            ((low, high),) = support.enclosed(np.array([time]), direction[None])
        early, late = min(time, turn), max(time - turn, 0.0)
        truth = across_kinks(first, BOUNDS[name], direction @ expm(A * late), early)
        truth += across_kinks(second, BOUNDS[name], direction, late) if late else 0.0
        assert low <= truth + 1e-13 * abs(truth)
        assert truth <= high + 1e-13 * abs(truth)
        if short < 1.0:
            assert high - low <= 1e-10 * abs(truth)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["box", "triangle"])
def test_rows_of_no_integral_see_one_system_where_turns_integrate(name):
    plain, times = random_system(np.random.default_rng(4), 3), np.array([0.0, 0.2, 0.9, 1.3, HORIZON])
    plain = LinearSystem(*(part[0] for part in plain.phases[0].matrices(np.zeros((1, 0)))))
    rates = [(share * np.array([[1.0, 0.5, 0.0]]), np.zeros((1, 1))) for share in (0.0, 1.0)]
    first, second = (System((plain.phases[0].accumulating(*one),)) for one in rates)
    grid = merge_grids(UNEVEN.breakpoints, UNEVEN.breakpoints, switches=(0.9,))
    turning = Response(SwitchedSystem([(0.9, first), (HORIZON, second)]), grid, np.zeros(4))
    alone = Response(plain, merge_grids(UNEVEN.breakpoints, UNEVEN.breakpoints), np.zeros(3))
    found, known = (measurable.MeasurableSupport(one, BOUNDS[name]) for one in (turning, alone))
    rows, none = np.random.default_rng(5).normal(size=(times.size, 3)), np.zeros((times.size, 0))
    wide = np.hstack([rows, np.zeros((times.size, 1))])
    assert found(times, wide, none) == pytest.approx(known(times, rows, none), rel=1e-9, abs=1e-12)
    assert found.enclosed(times[3:] - 0.9, wide[3:], 1) == pytest.approx(known.enclosed(times, rows)[3:], rel=1e-7)
    wide[:, 3] = 1.0  # what is integrated goes through both systems
    with patch.object(measurable.MeasurableSupport, "_differing_states", None):
        through = measurable.MeasurableSupport(turning, BOUNDS[name])(times, wide, none)
    assert found(times, wide, none) == pytest.approx(through, rel=1e-9, abs=1e-12)


def test_bounds_across_a_root_are_those_of_the_modulus_of_a_sine():
    system = LinearSystem([[0, 1], [-1, 0]], [[0.0], [1.0]], [[0.0], [1.0]])
    support = worst_case(system, uniform(3, 5.0), bound=Box([-1.0], [1.0]), kind="measurable").measurable
    bounds = support.enclosed(np.array([0.0, 2.0, 5.0]), np.tile([1.0, 0.0], (3, 1)))
    truth = np.array([0.0, 1.0 - np.cos(2.0), 3.0 + np.cos(5.0)])
    assert (bounds[:, 0] <= truth).all()
    assert (truth <= bounds[:, 1]).all()
    assert (bounds[:, 1] - bounds[:, 0] <= 4e-13).all()
    assert bounds[0].tolist() == [0.0, 0.0]


@pytest.mark.first(2)
@pytest.mark.parametrize("name", sorted(BOUNDS))
def test_a_rough_support_is_near_the_support(name):
    """It says where to climb to; what is found there is measured anew."""
    rng = np.random.default_rng(4)
    system = random_system(rng, speed=2.0)
    times, directions, none = rng.uniform(0.0, HORIZON, 40), rng.normal(size=(40, 2)), np.zeros((40, 0))
    for pieces, share in ((6, 2e-3), (24, 2e-4)):
        support = worst_case(system, uniform(pieces, HORIZON), bound=BOUNDS[name], kind="measurable").measurable
        exact, rough = support(times, directions, none), support.roughly(times, directions, none)
        assert np.abs(rough - exact).max() <= share * np.abs(exact).max()
        assert (rough != exact).any()


def test_sums_of_a_table_count_the_rounding_of_all_its_intervals():
    system = LinearSystem([[0.0]], [[1.0]], [[1.0]])
    ends = np.array([0.0, HORIZON])
    grid = merge_grids(ends, ends)
    support = measurable.MeasurableSupport(Response(system, grid, np.zeros(1)), Box([-0.1], [0.1]))
    with patch.object(measurable, "SHORT", 1e-3), patch.object(measurable._BalancedMatrix, "fastest", 1.0):
        (table,) = support._make_tables(np.zeros((1, 1)), np.eye(1), ends, np.ones((1, 1)))
    count, (low, high) = table.starts.size - 1, table.sums[-1]
    assert count == 2000 and low <= 0.1 * HORIZON <= high
    assert 2.0 * count * EPSILON / 2.0 * 0.1 * HORIZON <= high - low <= 1e-12
