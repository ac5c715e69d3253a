"""Guards sip/search/trust_region: the trust region reaches the digits that doubles hold, on hills, valleys, cones and
kinks, from a handful of points."""

from __future__ import annotations

import time

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import sparserob_core as sr
from sparserob_core.sip.search.trust_region import highest_in_ball, highest_in_ball_and_box

TOP = np.array([0.31, 0.62, 0.47, 0.55, 0.38])


def bowl(x):
    return -((x - TOP[: x.size]) ** 2 * np.arange(1, x.size + 1)).sum()


def valley(x):
    y = 4.0 * x - 2.0
    return -(100.0 * (y[1:] - y[:-1] ** 2) ** 2 + (y[:-1] - 1.0) ** 2).sum()


def cone(x):
    return -np.linalg.norm(x - TOP[: x.size])


def roof(x):
    return -np.abs(x - TOP[: x.size]).sum()


def climb(function, dimension, steps, seed=0, first=10):
    points = np.random.default_rng(seed).random((first, dimension))
    values = np.array([function(point) for point in points])
    region = sr.TrustRegion()
    while len(values) < first + steps and (point := region.propose(points, values)) is not None:
        value = function(point)
        region.tell(value)
        points, values = np.vstack([points, point]), np.append(values, value)
    return points, values


@pytest.mark.first(4)
@pytest.mark.parametrize(
    ("function", "dimension", "steps", "regret"),
    [
        (bowl, 1, 25, 1e-20),
        (bowl, 3, 60, 1e-15),
        (bowl, 5, 150, 1e-15),
        (valley, 2, 150, 1e-15),
        (valley, 3, 250, 1e-15),
        (cone, 2, 100, 1e-9),
        (cone, 4, 220, 1e-9),
        (roof, 1, 60, 1e-9),
        (roof, 2, 120, 1e-9),
    ],
)
def test_a_local_maximum_is_reached_to_the_digits_that_doubles_hold(function, dimension, steps, regret):
    for seed in range(5):
        assert climb(function, dimension, steps, seed)[1].max() >= -regret


def test_a_maximum_in_a_corner_is_found_exactly_and_left_alone():
    points, values = climb(lambda x: x @ [1.0, -2.0, 3.0], 3, 100)
    assert points[values.argmax()].tolist() == [1.0, 0.0, 1.0]
    assert len(values) < 60


def test_nothing_is_proposed_on_a_plain():
    assert len(climb(lambda x: 2.0, 2, 100)[1]) < 30


@given(seed=st.integers(0, 10_000), dimension=st.integers(1, 6), first=st.integers(1, 30))
def test_proposals_lie_in_the_box_and_are_never_repeated(seed, dimension, first):
    points, _ = climb(lambda x: np.sin(9.0 * x).sum(), dimension, 15, seed, first)
    assert ((points >= 0) & (points <= 1)).all()
    assert len(np.unique(points, axis=0)) == len(points)


def test_a_single_point_is_enough_to_begin():
    assert climb(bowl, 3, 80, first=1)[1].max() >= -1e-12


@pytest.mark.parametrize("factor", [1e-200, 1e200])
def test_the_unit_of_the_values_does_not_matter(factor):
    assert climb(lambda x: factor * bowl(x), 2, 60)[1].max() >= -1e-12 * factor


def test_undefined_neighbours_are_kept_away_from():
    _, values = climb(lambda x: bowl(x) if x[0] < 0.35 else -np.inf, 2, 60, first=20)
    assert values.max() >= -1e-9


@given(seed=st.integers(0, 10_000), dimension=st.integers(1, 6), radius=st.floats(1e-6, 10.0))
def test_the_step_in_a_ball_meets_the_conditions_of_more_and_sorensen(seed, dimension, radius):
    rng = np.random.default_rng(seed)
    gradient, hessian = rng.normal(size=dimension), rng.normal(size=(dimension, dimension))
    hessian = hessian + hessian.T
    step = highest_in_ball(gradient, hessian, radius)
    assert np.linalg.norm(step) <= radius * (1 + 1e-9)
    others = rng.normal(size=(500, dimension))
    others *= radius * rng.random((500, 1)) ** (1 / dimension) / np.linalg.norm(others, axis=1, keepdims=True)
    heights = others @ gradient + 0.5 * np.einsum("ki,ij,kj->k", others, hessian, others)
    assert gradient @ step + 0.5 * step @ hessian @ step >= heights.max() * (1 - 1e-5) - 1e-12


def test_the_hard_case_leaves_along_the_flattest_direction():
    step = highest_in_ball(np.array([0.0, 1.0]), np.diag([2.0, -1.0]), 2.0)
    assert np.linalg.norm(step) == pytest.approx(2.0)
    assert step[1] == pytest.approx(1.0 / 3.0)


@given(seed=st.integers(0, 10_000), dimension=st.integers(1, 5))
def test_the_step_keeps_to_ball_and_box_and_never_descends(seed, dimension):
    rng = np.random.default_rng(seed)
    gradient, hessian = rng.normal(size=dimension), rng.normal(size=(dimension, dimension))
    lower, upper = (
        -rng.random(dimension) * rng.integers(0, 2, dimension),
        rng.random(dimension) * rng.integers(0, 2, dimension),
    )
    hessian = -hessian @ hessian.T
    step = highest_in_ball_and_box(gradient, hessian, 0.5, lower, upper)
    assert ((step >= lower) & (step <= upper)).all()
    assert np.linalg.norm(step) <= 0.5 * (1 + 1e-9)


def test_a_step_costs_far_less_than_a_millisecond_in_five_coordinates():
    rng = np.random.default_rng(0)
    points = rng.random((200, 5))
    values = np.array([bowl(point) for point in points])
    fastest = np.inf
    for _ in range(30):
        started = time.perf_counter()
        sr.TrustRegion().propose(points, values)
        fastest = min(fastest, time.perf_counter() - started)
    assert fastest < 1e-3
