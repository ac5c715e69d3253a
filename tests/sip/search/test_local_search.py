"""Guards sip/search/local_search: a polish brings what a search has found to the digits that the landscape allows,
within the budget, whatever it is handed."""

from __future__ import annotations

from contextlib import suppress

import numpy as np
import pytest

import sparserob_core as sr
from sparserob_core.sip.search.local_search import polish
from sparserob_core.sip.search.search import CountedObjective, Target

SQUARE = sr.Box([-2.0, -1.0], [2.0, 3.0])


def valley(x):
    return -(100 * (x[:, 1:] - x[:, :-1] ** 2) ** 2 + (x[:, :-1] - 1) ** 2).sum(axis=1)


def slope_of_valley(x):
    rise = x[1:] - x[:-1] ** 2
    slope = np.zeros_like(x)
    slope[:-1] = 400 * x[:-1] * rise - 2 * (x[:-1] - 1)
    slope[1:] -= 200 * rise
    return slope


def cone(x):
    return -np.linalg.norm(x - 0.31, axis=1)


def roof(x):
    return -np.abs(x - 0.31).sum(axis=1)


def ackley(x):
    z = 16 * (x - 0.31)
    return 20 * np.exp(-0.2 * np.sqrt((z**2).mean(axis=1))) + np.exp(np.cos(2 * np.pi * z).mean(axis=1)) - 20 - np.e


def garland(x):
    return (x * (1 - x) * (4 - np.sqrt(np.abs(np.sin(60 * x))))).sum(axis=1) - 4 * (np.pi / 6) * (1 - np.pi / 6)


def eggs(x):
    z = 5 * (x - 0.13)
    return -(z**2 - 10 * np.cos(2 * np.pi * z) + 10).sum(axis=1)


def cube(dimension):
    return sr.Box(np.full(dimension, -1.0), np.full(dimension, 1.5))


def polished(function, box, found=200, budget=200, seed=0, gradient=None, block=1):
    """The report of a polish after ``found`` random points."""
    points = np.random.default_rng(seed).uniform(box.lower, box.upper, (found, box.dimension))
    objective = CountedObjective(Target(function, box, gradient, block), budget)
    with suppress(sr.SearchEnded):
        polish(objective, points, function(points) if found else np.empty(0))
    return objective.report("")


@pytest.mark.first(1)
@pytest.mark.parametrize(
    ("function", "box", "regret"),
    [
        (valley, SQUARE, 1e-20),
        (valley, sr.Box([-2.0] * 3, [2.0] * 3), 1e-20),
        (cone, cube(2), 1e-9),
        (cone, cube(4), 1e-9),
        (ackley, cube(2), 1e-9),
        (roof, cube(1), 1e-9),
        (roof, cube(2), 1e-9),
        (garland, sr.Box([0.0], [1.0]), 1e-4),
    ],
)
def test_the_digits_that_the_landscape_allows_are_reached(function, box, regret):
    for seed in range(3):
        assert polished(function, box, found=800, budget=200, seed=seed).best_value >= -regret


def test_a_second_hill_is_climbed_when_the_first_was_not_the_highest():
    def two_hills(x):
        return np.maximum(1.0 - 400 * ((x - 0.8) ** 2).sum(axis=1), 0.95 - ((x + 0.5) ** 2).sum(axis=1))

    points = np.array([[-0.49, -0.5], [0.83, 0.8], [0.84, 0.78], [0.0, 0.0]])
    assert np.argmax(two_hills(points)) == 0
    objective = CountedObjective(Target(two_hills, cube(2)), 120)
    polish(objective, points, two_hills(points))
    assert objective.best_value == pytest.approx(1.0, abs=1e-9)


def test_local_maxima_of_a_separable_landscape_are_crossed():
    solved = [polished(eggs, cube(3), found=800, budget=200, seed=seed).best_value > -1e-9 for seed in range(10)]
    assert sum(solved) >= 5


@pytest.mark.parametrize("dimension", [2, 10, 40])
def test_gradients_are_used_where_there_are_any(dimension):
    counted = []
    report = polished(
        valley,
        sr.Box([-2.0] * dimension, [2.0] * dimension),
        budget=400,
        found=50,
        gradient=lambda x: counted.append(1) or slope_of_valley(x),
    )
    assert len(counted) > 10
    assert report.best_value > (-1e-9 if dimension == 2 else -4.0)


HILLS = np.array([[0.3, 0.4, 0.6], [0.9, 1.0, 1.0]])  # a low one within the square, a high one in its corner
HEIGHTS, WIDTHS = np.array([1.0, 2.0]), np.array([0.6, 0.15])


def highest(points, count):
    """The best of ``count`` points of the cube in three coordinates, which alone decides; and which it is."""
    blocks = points.reshape(-1, count, 3)
    away = ((blocks[:, :, np.newaxis] - HILLS) ** 2).sum(axis=3)
    heights = (HEIGHTS * np.exp(-away / WIDTHS**2)).max(axis=2)
    return heights.max(axis=1), heights.argmax(axis=1)


@pytest.mark.parametrize("seed", range(5))
def test_blocks_that_do_not_act_find_the_hill_to_which_no_slope_leads(seed):
    count, last = 40, np.zeros(40, dtype=bool)

    def value(points):
        values, owner = highest(points, count)
        last[:] = np.arange(count) == owner[-1]
        return values

    def slope(point):
        away = point.reshape(count, 3)[last][0] - HILLS
        heights = HEIGHTS * np.exp(-(away**2).sum(axis=1) / WIDTHS**2)
        hill, gradient = heights.argmax(), np.zeros((count, 3))
        gradient[last] = -2.0 * heights[hill] * away[hill] / WIDTHS[hill] ** 2
        return gradient.ravel()

    box = sr.Box(np.zeros(3 * count), np.ones(3 * count))
    start = np.tile(HILLS[0] + 0.05, count) + np.random.default_rng(seed).uniform(-0.01, 0.01, 3 * count)
    reached = {}
    for acting in (None, last.copy):
        objective = CountedObjective(Target(value, box, slope, 3, acting=acting), 60)
        with suppress(sr.SearchEnded):
            polish(objective, start[np.newaxis], value(start[np.newaxis]))
        reached[acting is None] = objective.best_value
        assert objective.evaluations <= 60
    assert reached[True] == pytest.approx(HEIGHTS[0]) and reached[False] == pytest.approx(HEIGHTS[1])


def test_a_gradient_that_is_zero_where_nothing_is_defined_does_no_harm():
    def half(x):
        return np.where(x[:, 0] > 0.4, -np.inf, cone(x))

    report = polished(half, cube(2), gradient=lambda x: -(x - 0.31) / np.linalg.norm(x - 0.31))
    assert report.best_value > -1e-6


def test_in_high_dimension_moves_change_one_coordinate_and_climb():
    seen = []
    report = polished(lambda x: seen.append(x.copy()) or roof(x), cube(60), found=5, budget=2000)
    start = roof(np.random.default_rng(0).uniform(-1, 1.5, (5, 60))).max()
    moves = np.vstack(seen[1:])
    assert (np.abs(np.diff(moves, axis=0)) > 1e-12).sum(axis=1).max() <= 2
    assert report.best_value > 0.05 * start


@pytest.mark.parametrize("budget", [1, 2, 7, 100])
@pytest.mark.parametrize("dimension", [1, 3, 40])
def test_the_budget_is_never_exceeded_and_nothing_leaves_the_box(budget, dimension):
    counted = []
    box = cube(dimension)
    for gradient in (None, lambda x: -np.sign(x - 0.31)):
        counted.clear()
        report = polished(lambda x: counted.append(len(x)) or roof(x), box, found=0, budget=budget)
        assert not counted and report.evaluations == 0
        points = box.lower[np.newaxis] + 0.1
        objective = CountedObjective(Target(lambda x: counted.append(len(x)) or roof(x), box, gradient), budget)
        with suppress(sr.SearchEnded):
            polish(objective, points, roof(points))
        assert sum(counted) <= budget


def test_a_side_without_length_stays_where_it_is():
    box = sr.Box([-1.0, 0.7, -1.0], [1.0, 0.7, 1.0])
    report = sr.maximise(cone, box, "random_search", budget=400, polish=0.5)
    assert report.best_point == pytest.approx([0.31, 0.7, 0.31], abs=1e-6)
    assert sr.maximise(cone, sr.Box([0.7, 0.7], [0.7, 0.7]), budget=9, polish=0.5).evaluations == 1


def test_without_a_finite_value_there_is_nothing_to_polish():
    assert polished(lambda x: np.full(len(x), -np.inf), cube(2)).evaluations == 0


def test_infinite_values_nearby_are_survived():
    report = polished(lambda x: np.where(x[:, 0] > 0.3, -np.inf, cone(x)), cube(2))
    assert report.best_value > -0.011


def test_a_share_of_the_budget_is_polish():
    plain = sr.maximise(cone, cube(2), "random_search", budget=500)
    shared = sr.maximise(cone, cube(2), "random_search", budget=500, polish=0.4)
    assert plain.evaluations == 500 >= shared.evaluations
    assert shared.best_value > -1e-9 > plain.best_value
    np.testing.assert_array_equal(shared.trace.points[:300], plain.trace.points[:300])
