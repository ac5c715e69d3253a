"""Guards plugins/sparserob_direct: DIRECT as it was published, whole iterations at once, no worse than scipy's."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.optimize import Bounds, direct

import sparserob_core as sr
import sparserob_direct
from sparserob_core.sip.search.search import CountedObjective, Target
from sparserob_direct import Direct, Division, best_for_some_slope

BOX = sr.Box(np.zeros(2), np.array([2.0, 1.0]))


def hills(points):
    return np.sin(5 * points[:, 0]) * np.cos(4 * points[:, 1] + 0.3) - 0.1 * (points**2).sum(axis=1)


def searched(function, box=BOX, budget=151, **options):
    calls = []

    def counted(points):
        calls.append(len(points))
        return function(points)

    return sr.maximise(counted, box, Direct(**options), budget=budget, polish=0), calls


def test_a_rectangle_is_divided_where_some_slope_makes_it_the_best():
    rng = np.random.default_rng(0)
    slopes = np.concatenate([np.geomspace(1e-6, 1e6, 200_001), [1e12]])
    for _ in range(30):
        widths, losses = 3.0 ** -np.arange(6.0), rng.normal(size=6)
        bounds = losses[:, None] - slopes * widths[:, None]
        best = set(bounds.argmin(axis=0).tolist())
        assert set(best_for_some_slope(widths, losses, 0.0)) == best
        least = losses.min()
        promising = bounds.min(axis=0) <= least - 0.3 * abs(least)
        assert set(best_for_some_slope(widths, losses, 0.3)) == set(bounds.argmin(axis=0)[promising].tolist())


@pytest.mark.parametrize("biased", [True, False])
def test_the_rectangles_fill_the_box_without_overlap_and_each_has_its_point(biased):
    objective = CountedObjective(Target(hills, BOX), 10_000)
    division = Division(objective, biased)
    while division.count < 150:
        division.divide(division.promising(1e-8))
    lower, upper = division.boxes()
    assert len(lower) == min(division.count, sparserob_direct.MAX_SHOWN) >= 150
    middles = (lower + upper) / 2
    assert (upper - lower).prod(axis=1).sum() == pytest.approx(2.0) or division.count > len(lower)
    inside = ((middles[:, None] > lower[None] + 1e-9) & (middles[:, None] < upper[None] - 1e-9)).all(axis=2)
    assert (inside.sum(axis=1) == 1).all()
    points = objective.seen()[0]
    assert len(points) == division.count
    assert np.abs(middles[:, None] - points[None]).max(axis=2).min(axis=1).max() < 1e-9


@pytest.mark.parametrize("biased", [True, False])
def test_every_side_of_a_rectangle_was_cut_as_often_as_another_or_once_more(biased):
    division = Division(CountedObjective(Target(hills, BOX), 10_000), biased)
    while division.count < 300:
        division.divide(division.promising(1e-8))
    levels = division.levels[: division.count]
    assert (levels.max(axis=1) - levels.min(axis=1) <= 1).all()


def test_whole_iterations_are_evaluated_at_once_and_the_memory_that_they_take_changes_nothing(monkeypatch):
    report, calls = searched(hills, sr.Box(np.full(5, -1.0), np.full(5, 1.7)), 600)
    assert calls[:2] == [1, 10] and len(calls) < 60
    monkeypatch.setattr(sparserob_direct, "NUMBERS_AT_ONCE", 15)
    again, small = searched(hills, sr.Box(np.full(5, -1.0), np.full(5, 1.7)), 600)
    assert max(small) == 3
    assert again.trace.points.tolist() == report.trace.points.tolist()


def test_where_the_function_has_no_value_a_rectangle_counts_as_the_worst():
    report, _ = searched(lambda points: np.where(points[:, 0] < 1.0, -np.inf, hills(points)), budget=300)
    assert report.best_value > 0.55
    nowhere, _ = searched(lambda points: np.full(len(points), -np.inf), budget=300)
    assert nowhere.evaluations == 300


def test_no_point_is_asked_for_twice_however_small_the_rectangles():
    report, _ = searched(lambda points: -np.abs(points[:, 0] - 0.3), sr.Box([0.0], [1.0]), 3000)
    assert len(np.unique(report.trace.points)) == 3000 and report.best_value >= -1e-15


@pytest.mark.parametrize("dimension", [2, pytest.param(5, marks=pytest.mark.slow)])
def test_it_is_no_worse_than_scipy_s_on_shifted_functions(dimension):
    functions = (
        lambda z: -(z**2).sum(axis=1),
        lambda z: -(z**2 - 10 * np.cos(2 * np.pi * z) + 10).sum(axis=1),
        lambda z: -np.abs(z).sum(axis=1),
        lambda z: -(z**2 * 10.0 ** np.arange(dimension)).sum(axis=1),
    )
    better, worse, half = 0, 0, 4.0
    for function in functions:
        for seed in range(5):
            shift = half * np.random.default_rng(seed).uniform(-0.6, 0.6, dimension)
            theirs = []

            def one(point, function=function, shift=shift, theirs=theirs):
                theirs.append(-float(function(point[None] - shift)[0]))
                return theirs[-1]

            box = sr.Box(np.full(dimension, -half), np.full(dimension, half))
            bounds = Bounds(box.lower, box.upper)
            direct(one, bounds, eps=1e-8, maxfun=300, maxiter=301, vol_tol=0.0, len_tol=0.0)
            report, _ = searched(lambda x, function=function, shift=shift: function(x - shift), box, 300)
            best, other = -report.best_value, min(theirs[:300])
            better, worse = better + (best < other * (1 - 1e-6)), worse + (best > other * (1 + 1e-6))
    assert better >= 2 * worse
