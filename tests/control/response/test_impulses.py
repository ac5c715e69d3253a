"""Guards control/response/response: rows by baby steps and giant steps, and outputs in blocks, against the plain
recursion over all pieces and against the closed form of symmetric systems: stiff, unstable, long, tiny pieces."""

from __future__ import annotations

from unittest.mock import patch

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sparserob_core.control.problem.system import LinearSystem
from sparserob_core.control.response.response import OutputResponse, Propagator, Response
from sparserob_core.control.response.time_grid import merge_grids
from sparserob_core.sip.convex_set import Box
from tests.support.plants import random_system, uniform, worst_case

HOME = "sparserob_core.control.response.response"
NONE = np.zeros((1, 0))
# what the eigenvalues times the horizon are: slow, stiff, unstable, all of these
RATES = {
    "slow": [-1.0, -0.3, 0.0, -2.0],
    "stiff": [-1e5, -1e3, -1.0, 0.0],
    "unstable": [20.0, 5.0, -1.0, -3.0],
    "mixed": [12.0, -1e4, 0.0, -1e-9],
}


def symmetric(rng, rates, horizon):
    """A symmetric system with these eigenvalues, and its eigenvectors."""
    V = np.linalg.qr(rng.normal(size=(len(rates), len(rates))))[0]
    A = (V * (np.array(rates) / horizon)) @ V.T
    return LinearSystem(A, rng.normal(size=(len(rates), 2)), rng.normal(size=(len(rates), 1))), V


def exact(system, V, rates, grid, times, directions):
    """The weights in closed form, and the sums of absolute values that they are made of."""
    rates, (_, B, E) = np.array(rates) / grid.breakpoints[-1], (part[0] for part in system.phases[0].matrices(NONE))
    M, along, pieces = V.T @ np.hstack([B, E]), directions @ V, grid.locate(times)
    sums = np.zeros((2, times.size, grid.pieces, 3))
    for number, piece in enumerate(pieces):
        stop = np.minimum(grid.breakpoints[1 : piece + 2], times[number])
        length = stop - grid.breakpoints[: piece + 1]
        with np.errstate(invalid="ignore", divide="ignore"):
            driven = np.where(rates == 0.0, length[:, None], np.expm1(rates * length[:, None]) / rates)
        gain = np.exp(rates * (times[number] - stop)[:, None]) * driven
        for place, change in enumerate((np.asarray, np.abs)):
            sums[place, number, : piece + 1] = (gain * change(along[number])) @ change(M)
    return sums


@pytest.mark.parametrize("kind", sorted(RATES))
@pytest.mark.parametrize(("pieces", "horizon"), [(1, 2.0), (2, 1e-6), (37, 3.0), (1024, 1e4), (3000, 5.0)])
def test_rows_by_baby_and_giant_steps_are_the_closed_form(kind, pieces, horizon):
    rng, rates = np.random.default_rng(pieces), RATES[kind]
    system, V = symmetric(rng, rates, horizon)
    ends = np.linspace(0, horizon, pieces + 1)
    grid = merge_grids(ends, ends)
    times = np.concatenate([[0.0, horizon], rng.choice(ends, 4), rng.uniform(0, horizon, 6)])
    directions = rng.normal(size=(times.size, 4))
    directions[3:6] = directions[2]  # one impulse response at several times
    value, size = exact(system, V, rates, grid, times, directions)
    # what one unit of rounding in a rate, a time or a squaring does: growth is bounded by that of the exponentials
    allowed = 1e-13 * (10.0 + np.abs(rates).max()) * size.max(axis=(1, 2), keepdims=True)
    found = Response(system, grid, np.zeros(4)).weights(times, directions, np.zeros((times.size, 0)))
    assert (np.abs(np.concatenate([found.control, found.disturbance], axis=2) - value) <= allowed).all()


@pytest.mark.parametrize("kind", sorted(RATES))
@pytest.mark.parametrize(("pieces", "lengths"), [(2, 2), (37, 37), (300, 3), (600, 600)])
def test_rows_over_stretches_are_the_closed_form(kind, pieces, lengths):
    """With pieces that all differ, and with few lengths in any order, where not all stretches may be kept."""
    rng, rates = np.random.default_rng(pieces), RATES[kind]
    system, V = symmetric(rng, rates, 3.0)
    ends = np.append(0.0, np.cumsum(rng.choice(rng.uniform(0.5, 1.5, lengths), pieces, replace=lengths < pieces)))
    ends = 3.0 * ends / ends[-1]
    grid = merge_grids(ends, ends)
    times = np.concatenate([[0.0, 3.0], rng.choice(ends, 4), rng.uniform(0, 3.0, 6)])
    directions = rng.normal(size=(times.size, 4))
    value, size = exact(system, V, rates, grid, times, directions)
    allowed = 1e-13 * (10.0 + np.abs(rates).max()) * size.max(axis=(1, 2), keepdims=True)
    for kept in (0, 3000, 2_000_000):
        with patch(f"{HOME}.STRETCHED", kept):
            found = Response(system, grid, np.zeros(4)).weights(times, directions, np.zeros((times.size, 0)))
        assert (np.abs(np.concatenate([found.control, found.disturbance], axis=2) - value) <= allowed).all()


@settings(max_examples=30, deadline=None)
@given(seed=st.integers(0, 10**6), pieces=st.integers(1, 400), states=st.integers(1, 6), fast=st.floats(0.01, 30.0))
def test_rows_by_baby_and_giant_steps_are_those_of_the_plain_recursion(seed, pieces, states, fast):
    rng, ends = np.random.default_rng(seed), np.linspace(0, 2, pieces + 1)
    plain, grid = random_system(rng, states), merge_grids(ends, ends)
    A, B, E = (part[0] for part in plain.phases[0].matrices(NONE))
    response = Response(LinearSystem(fast * A / np.linalg.norm(A, 2), B, E), grid, np.zeros(states))
    times = np.concatenate([[0.0, 2.0], rng.choice(ends, 5), rng.uniform(0, 2, 13)])
    given = times, rng.normal(size=(20, states)), np.zeros((20, 0))
    found = response.weights(*given)
    with patch.object(Propagator, "aged", lambda *_: False):
        free, gains, B, E = response.adjoint(*given)
    for one, other in zip(found, (free, gains @ B, gains @ E), strict=True):
        # backward stable: in units of how large the exponential of the norms is, not of what cancels
        scale = np.abs(other).reshape(20, -1).max(axis=1, initial=1e-30)
        error = np.abs(one - other).reshape(20, -1).max(axis=1)
        assert (
            (error <= 1e-12 * np.exp(min(fast, 30.0)) * (1.0 + scale)).all()
            if fast > 10
            else (error <= 1e-10 * np.maximum(scale, 1.0)).all()
        )


@pytest.mark.first(6)
@pytest.mark.parametrize("kind", sorted(RATES))
@pytest.mark.parametrize("pieces", [1000, 1531, 16384])
def test_outputs_in_blocks_are_rows_times_the_inputs(kind, pieces):
    """The two ways share no product: one carries states forward in blocks, the other functionals back by age."""
    rng = np.random.default_rng(pieces)
    system, _ = symmetric(rng, RATES[kind], 4.0)
    ends = np.linspace(0, 4, pieces + 1)
    grid, H = merge_grids(ends, ends), rng.normal(size=(2, 4))
    response = Response(system, grid, rng.normal(size=4))
    assert response.uniform
    chosen = [np.sort(rng.choice(ends[pieces // 3 :], 8, replace=False)), np.sort(rng.uniform(1.0, 4.0, 9)), ends[-1:]]
    control = rng.uniform(-1, 1, size=(2, pieces))
    for times in chosen:
        found = OutputResponse(response.propagator, H, times, NONE).at(response, control)[0]
        every = response.weights(np.repeat(times, 2), np.tile(H, (times.size, 1)), np.zeros((2 * times.size, 0)))
        value = every.free @ response.initial_state + np.einsum("klm,ml->k", every.control, control)
        size = np.abs(every.free).sum(axis=1) + np.abs(every.control).sum(axis=(1, 2)) + 1.0
        assert (np.abs(found.T.ravel() - value) <= 1e-13 * np.abs(RATES[kind]).max() * size).all()


@pytest.mark.parametrize("pieces", [999, 1000, 1003])
def test_outputs_are_the_same_in_blocks_and_from_all_states(pieces):
    rng, ends = np.random.default_rng(pieces), np.linspace(0, 3, pieces + 1)
    system, grid, H = random_system(rng, 3), merge_grids(ends, ends), rng.normal(size=(4, 3))
    response, control = Response(system, grid, rng.normal(size=3)), rng.uniform(-1, 1, size=(system.controls, pieces))
    times = np.unique(np.concatenate([ends[400:], ends[400:-1] + 0.4 * 3 / pieces, [3.0]]))
    found = []
    for fewest in (64, 10**9):
        with patch(f"{HOME}.FEWEST", fewest):
            found.append(OutputResponse(response.propagator, H, times, NONE).at(response, control))
    assert found[0].shape == (1, 4, times.size)
    assert np.allclose(*found, rtol=1e-10, atol=1e-11)


def test_what_few_pieces_reach_is_about_what_many_do():
    """Units are taken from it: to within a few per cent, and never more."""
    rng = np.random.default_rng(3)
    functionals = worst_case(random_system(rng), uniform(600, 2.0), uniform(600, 2.0), Box([-1.0, -1.0], [1.0, 1.0]))
    coarse = functionals.coarser(50)
    assert coarse.response.grid.pieces == 50
    times, directions, none = np.array([0.4, 1.0, 2.0]), rng.normal(size=(3, 2)), np.zeros((3, 0))
    many, few = (
        np.abs(one.response.weights(times, directions, none).control).sum(axis=(1, 2)) for one in (functionals, coarse)
    )
    assert (few <= many * (1 + 1e-9)).all()
    assert (few >= 0.95 * many).all()
    assert (coarse.offsets(times, directions, none) <= functionals.offsets(times, directions, none) + 1e-9).all()
    uneven = worst_case(random_system(rng), uniform(30, 2.0))
    assert uneven.coarser(50) is uneven


@pytest.mark.parametrize("horizon", [0.3, 1.0, 3.7])
def test_equal_pieces_are_equal_whatever_their_number(horizon):
    """The share of one piece in 16 384 ends halfway between two numbers of 13 digits."""
    for pieces in (10, 16384, 81920, 100_000):
        ends = np.linspace(0, horizon, pieces + 1)
        assert Response(LinearSystem([[0.0]], [[1.0]]), merge_grids(ends, ends), np.zeros(1)).uniform


@pytest.mark.parametrize("together", [True, False])
def test_rows_of_many_instants_are_those_of_each_alone(together):
    rng = np.random.default_rng(11)
    system, _ = symmetric(rng, RATES["slow"], 3.0)
    ends = np.linspace(0, 3.0, 38)
    response = Response(system, merge_grids(ends, ends), np.zeros(4))
    times = np.full(9, 1.7) if together else rng.uniform(0, 3.0, 9)
    directions, none = rng.normal(size=(9, 4)), np.zeros((9, 0))
    with patch("sparserob_core.control.enclosures.flows.NEAR", 8):  # two rows of the series at once
        found = response.weights(times, directions, none)
    for i in range(9):
        alone = response.weights(times[[i]], directions[[i]], none[[i]])
        for one, other in zip(found, alone, strict=True):
            np.testing.assert_allclose(one[i], other[0], rtol=1e-14, atol=1e-15)


@pytest.mark.first(8)
@pytest.mark.parametrize("kind", sorted(RATES))
@pytest.mark.parametrize("pieces", [1000, 1023, 4999, 20_000])
def test_states_in_blocks_are_the_closed_form(kind, pieces):
    """Of a tree of parts no state goes through more products than are counted, and each of them rounds once."""
    rng, rates, horizon = np.random.default_rng(pieces), RATES[kind], 4.0
    system, V = symmetric(rng, rates, horizon)
    ends = np.linspace(0, horizon, pieces + 1)
    response = Response(system, merge_grids(ends, ends), rng.normal(size=4))
    control = rng.choice([-1.0, 0.0, 1.0], size=(2, pieces))
    steps = response.steps(NONE)
    block = response.propagator.block(steps)
    assert block & (block - 1) == 0
    assert (kind == "slow") <= (block > 1)
    found = response.states(control, NONE)[0]
    value, size = exact(system, V, rates, response.grid, ends[[1, pieces // 3, -1]], np.repeat(V.T[:1], 3, axis=0))
    # along the first eigenvector, which no other disturbs
    rate = rates[0] / horizon
    for place, k in enumerate((1, pieces // 3, pieces)):
        begun = np.exp(rate * ends[k]) * (V[:, 0] @ response.initial_state)
        true = begun + np.einsum("lm,ml->", value[place][:, :2], control)
        scale = abs(begun) + size[place][:, :2].sum()
        others = np.abs(np.exp(np.minimum(np.array(rates), 20.0))).max()
        allowed = 1e-15 * response.propagator.products(pieces, block) * (10.0 + np.abs(rates).max())
        assert abs(V[:, 0] @ found[k] - true) <= allowed * max(scale, 1.0) * others


def test_states_at_many_parameters_are_those_at_each():
    system = LinearSystem(lambda p: np.array([[0.0, 1.0], [p[0], -0.3]]), [[0.0], [1.0]], parameters=Box([-4.0], [0.0]))
    ends, points = np.linspace(0, 3, 2049), np.array([[-4.0], [-1.0], [0.0]])
    response = Response(system, merge_grids(ends, ends), np.array([1.0, 0.0]))
    control = np.random.default_rng(2).uniform(-1, 1, size=(1, 2048))
    every = response.states(control, points)
    assert response.propagator.block(response.steps(points)) > 1
    for one, path in zip(points, every, strict=True):
        np.testing.assert_allclose(response.states(control, one[None])[0], path, atol=1e-13)
        with patch(f"{HOME}.FEWEST", 10**9):
            np.testing.assert_allclose(
                Response(system, response.grid, path[0]).states(control, one[None])[0], path, atol=1e-11
            )
