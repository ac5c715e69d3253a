"""Guards plugins/sparserob_sequool: sequOOL opens the cells that it promises to open, wherever the box lies, with any
budget and in any dimension."""

from __future__ import annotations

import tracemalloc

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import sparserob_core as sr

SQUARE = sr.Box([-1.0, -2.0], [2.0, 1.5])


def bumps(points):
    """Kinks, so that values differ at every depth, and no symmetry, so that none are equal."""
    weights = 1 + 0.3 * np.arange(points.shape[1])
    return np.cos(3 * points) @ weights - 2 * np.abs(points - 0.37) @ weights**2


def reference(function, box, hmax):
    """The rule, one cell at a time, cells as lists of intervals; opens its way down and returns the points in order."""
    sides = list(zip(box.lower, box.upper, strict=True))
    points = [[0.5 * (a + b) for a, b in sides]]
    cells = [(sides, float(function(np.array(points))[0]))]
    moving = [j for j, (a, b) in enumerate(sides) if a < b]
    for depth in range(hmax + 1):
        across = moving[depth % len(moving)]
        cells.sort(key=lambda cell: -cell[1])
        children = []
        for sides, value in cells[: hmax // depth if depth else 1]:
            a, b = sides[across]
            cuts = [(a, a + (b - a) / 3), (b - (b - a) / 3, b), (a + (b - a) / 3, b - (b - a) / 3)]
            thirds = [[*sides[:across], cut, *sides[across + 1 :]] for cut in cuts]
            centres = [[0.5 * (low + high) for low, high in third] for third in thirds[:2]]
            points += centres
            values = [float(function(np.array([centre]))[0]) for centre in centres]
            children += list(zip(thirds, [*values, value], strict=True))
        cells = children
    return np.array(points)


@pytest.mark.parametrize("box", [SQUARE, sr.Box([0.1], [0.7]), sr.Box([-1.0, 0.5, 3.0], [2.0, 0.5, 9.0])])
@pytest.mark.parametrize(("budget", "hmax"), [(9, 2), (99, 20), (300, 51)])
def test_the_points_are_those_of_the_rule_written_cell_by_cell(box, budget, hmax):
    report = sr.maximise(bumps, box, "sequool", budget=budget, polish=0.0)
    expected = reference(bumps, box, hmax)
    np.testing.assert_allclose(report.trace.points, expected, atol=1e-12)


@pytest.mark.slow
@settings(deadline=None)
@given(budget=st.integers(1, 3000))
def test_the_budget_is_filled_with_the_largest_depth_that_fits(budget):
    def cost(hmax):
        opened, total = 1, 1
        for depth in range(1, hmax + 1):
            opened = min(hmax // depth, 3 * opened)
            total += opened
        return 1 + 2 * total

    report = sr.maximise(bumps, SQUARE, "sequool", budget=budget, polish=0.0)
    if budget < 3:
        assert report.evaluations == budget
        return
    hmax = int(report.trace.notes["hmax"][-1, 1])
    assert report.evaluations == cost(hmax) <= budget < cost(hmax + 1)
    assert report.trace.notes["depth"][:, 1].tolist() == list(range(hmax + 1))
    assert report.evaluations == 1 + 2 * report.trace.notes["openings"][-1, 1]


@pytest.mark.parametrize("budget", range(1, 7))
def test_a_tiny_budget_buys_the_centre_and_then_the_outer_thirds(budget):
    box = sr.Box([0.0], [3.0])
    report = sr.maximise(bumps, box, "sequool", budget=budget, polish=0.0)
    np.testing.assert_allclose(report.trace.points[:3, 0], [1.5, 0.5, 2.5][:budget])


def test_openings_beyond_the_budget_are_ended_by_it():
    report = sr.maximise(bumps, SQUARE, "sequool", budget=100, openings=1000, polish=0.0)
    assert report.evaluations == 100
    longer = sr.maximise(bumps, SQUARE, "sequool", budget=2000, openings=1000, polish=0.0)
    np.testing.assert_array_equal(report.trace.points, longer.trace.points[:100])


def test_the_generator_is_not_used():
    first, second = (sr.maximise(bumps, SQUARE, "sequool", budget=200, seed=seed, polish=0.0) for seed in (0, 1))
    np.testing.assert_array_equal(first.trace.points, second.trace.points)


def test_scaling_and_shifting_box_and_value_changes_nothing():
    lower, sides = np.array([-1e6, 1e-7]), np.array([4e6, 2e-7])
    scaled = sr.maximise(
        lambda x: 1e9 * bumps((x - lower) / sides) - 1e7,
        sr.Box(lower, lower + sides),
        "sequool",
        budget=200,
        polish=0.0,
    )
    plain = sr.maximise(bumps, sr.Box([0.0, 0.0], [1.0, 1.0]), "sequool", budget=200, polish=0.0)
    np.testing.assert_allclose((scaled.trace.points - lower) / sides, plain.trace.points, atol=1e-8)


def test_equal_values_are_opened_left_first():
    report = sr.maximise(lambda points: np.zeros(len(points)), sr.Box([0.0], [27.0]), "sequool", budget=9, polish=0.0)
    np.testing.assert_allclose(report.trace.points[:, 0], [13.5, 4.5, 22.5, 1.5, 7.5, 19.5, 25.5, 0.5, 2.5])


def test_values_that_are_not_defined_are_opened_last():
    report = sr.maximise(
        lambda x: np.where(x[:, 0] > 1.0, -np.inf, x[:, 0]), sr.Box([0.0], [3.0]), "sequool", budget=300, polish=0.0
    )
    assert 1 - 1e-6 < report.best_value <= 1.0


def test_each_depth_is_one_batch():
    batches = []

    def recorded(points):
        batches.append(len(points))
        return bumps(points)

    report = sr.maximise(recorded, SQUARE, "sequool", budget=1000, polish=0.0)
    assert len(batches) == report.trace.notes["hmax"][-1, 1] + 2 == 141
    assert sum(batches) == report.evaluations == 987


def test_memory_is_that_of_a_batch_in_a_hundred_thousand_dimensions():
    d = 100_000
    tracemalloc.start()
    report = sr.maximise(
        lambda points: -np.abs(points[:, :50] - 0.3).sum(axis=1),
        sr.Box(np.zeros(d), np.ones(d)),
        "sequool",
        budget=500,
        polish=0.0,
    )
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert report.evaluations > 480
    assert np.unique(report.best_point[200:]).tolist() == [0.5]
    assert peak < 400e6  # all of the points would take as much, and the cells of their boxes twice that
