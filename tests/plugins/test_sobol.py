"""Guards plugins/sparserob_random_search: sobol's sequence: evenly spread, seeded, and clear about the number of
dimensions for which it is known."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.stats import qmc

import sparserob_core as sr
from sparserob_core.sip.search.search import Target, maximise
from sparserob_random_search import Sobol

BOX = sr.Box(np.array([-1.0, 0.0, 10.0]), np.array([1.0, 0.5, 30.0]))


def points(domain=BOX, budget=512, seed=0, **options):
    report = maximise(
        Target(lambda at: np.zeros(len(at)), domain), Sobol(**options), budget, np.random.default_rng(seed)
    )
    assert report.evaluations == budget
    return report.trace.points


def unit(at, domain=BOX):
    return (at - domain.lower) / (domain.upper - domain.lower)


@pytest.mark.parametrize("seed", range(5))
def test_every_run_of_a_power_of_two_fills_every_interval_of_each_coordinate_once(seed):
    columns = np.sort(np.floor(unit(points(seed=seed)) * 512).astype(int), axis=0)
    np.testing.assert_array_equal(columns, np.tile(np.arange(512)[:, np.newaxis], 3))


def test_the_box_is_filled_more_evenly_than_by_independent_points():
    independent = np.random.default_rng(0).random((500, 3))
    assert qmc.discrepancy(unit(points(budget=500))) < qmc.discrepancy(independent) / 10


def test_the_generator_decides_the_scrambling_and_without_it_the_sequence_is_always_the_same():
    assert points(seed=1).tolist() == points(seed=1).tolist()
    assert points(seed=1).tolist() != points(seed=2).tolist()
    assert points(seed=1, scramble=False).tolist() == points(seed=2, scramble=False).tolist()
    assert points(scramble=False)[0].tolist() == BOX.lower.tolist()


@pytest.mark.parametrize("budget", [1, 3, 255, 257, 700])
def test_a_budget_that_is_no_power_of_two_is_spent_without_a_warning_on_the_same_points(budget):
    assert points(budget=budget).tolist() == points(budget=1024)[:budget].tolist()


def test_beyond_the_known_dimensions_one_sentence_says_so():
    box = sr.Box(np.zeros(21202), np.ones(21202))
    with pytest.raises(
        sr.InputError,
        match=r"sobol: the sequence is known up to 21201 dimensions, this domain has 21202; random_search has no",
    ):
        points(box, 1)


def test_sides_of_length_zero_stay_where_they_are():
    assert (points(sr.Box(np.array([0.0, 0.7]), np.array([1.0, 0.7])))[:, 1] == 0.7).all()
