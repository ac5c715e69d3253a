"""Guards plugins/sparserob_dual_annealing: scipy's dual annealing behind the contract: its budget, its boxes, and
values that are no numbers."""

from __future__ import annotations

import numpy as np
import pytest

import sparserob_core as sr
from sparserob_core.sip.search.search import CountedObjective, Target, maximise
from sparserob_dual_annealing import DualAnnealing

BOX = sr.Box(np.array([-5.0, -4.0]), np.array([5.0, 6.0]))


def himmelblau(points):
    x, y = points.T
    return -((x**2 + y - 11) ** 2 + (x + y**2 - 7) ** 2)


def search(function, domain=BOX, budget=300, seed=0, **options):
    return maximise(Target(function, domain), DualAnnealing(**options), budget, np.random.default_rng(seed))


def test_a_smooth_function_of_two_variables_is_maximised_to_high_accuracy():
    assert np.median([search(himmelblau, budget=600, seed=seed).best_value for seed in range(5)]) > -1e-8


@pytest.mark.parametrize("dimension", [1, 2, 10, 30])
@pytest.mark.parametrize("budget", [1, 50, 201])
def test_the_budget_holds_within_the_local_searches_too(dimension, budget):
    box = sr.Box(np.full(dimension, -2.0), np.full(dimension, 3.0))
    assert search(lambda points: -((points - 0.3) ** 2).sum(axis=1), box, budget).evaluations == budget


def test_without_local_search_no_finite_differences_are_taken():
    points = search(himmelblau, no_local_search=True).trace.points
    assert np.linalg.norm(np.diff(points, axis=0), axis=1).min() > 1e-6
    points = search(himmelblau).trace.points
    assert np.linalg.norm(np.diff(points, axis=0), axis=1).min() < 1e-6


def test_the_generator_alone_decides_the_search():
    np.random.seed(1)  # noqa: NPY002
    first = search(himmelblau, seed=4).trace.points
    np.random.seed(2)  # noqa: NPY002
    assert first.tolist() == search(himmelblau, seed=4).trace.points.tolist()
    assert first.tolist() != search(himmelblau, seed=5).trace.points.tolist()


def test_where_the_function_has_no_value_the_worst_one_seen_takes_its_place():
    report = search(lambda points: np.where(points[:, 0] < 0, -np.inf, himmelblau(points)), budget=600)
    assert report.evaluations == 600
    assert report.best_value > -1e-3


def test_sides_of_length_zero_stay_where_they_are():
    box = sr.Box(np.array([-5.0, 2.0, -4.0]), np.array([5.0, 2.0, 6.0]))
    report = search(lambda points: himmelblau(points[:, [0, 2]]), box, 600)
    assert (report.trace.points[:, 1] == 2.0).all()
    assert report.best_value > -1e-6
    still = search(lambda points: points.sum(axis=1), sr.Box(np.ones(2), np.ones(2)))
    assert (still.evaluations, still.best_value, still.upper_bound) == (1, 2.0, 2.0)


def test_a_search_that_is_continued_starts_from_the_best_point():
    objective = CountedObjective(Target(himmelblau, BOX), 20)
    objective.evaluate(np.array([[2.9, 2.1]]))
    with pytest.raises(sr.SearchEnded):
        DualAnnealing().search(objective, np.random.default_rng(0))
    assert objective.report("").trace.points[1].tolist() == [2.9, 2.1]


@pytest.mark.parametrize(
    "options", [{"visit": 2.0, "accept": -50.0}, {"initial_temp": 10.0, "restart_temp_ratio": 0.5}]
)
def test_scipys_parameters_are_passed_on(options):
    assert search(himmelblau, **options).trace.points.tolist() != search(himmelblau).trace.points.tolist()
