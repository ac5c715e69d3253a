"""Guards sip/search/separable: of a separable function the fit finds the highest hill in every coordinate, and a polish
that begins on another one goes there."""

from __future__ import annotations

from contextlib import suppress

import numpy as np
import pytest

import sparserob_core as sr
from sparserob_core.sip.search.local_search import polish
from sparserob_core.sip.search.search import CountedObjective, Target
from sparserob_core.sip.search.separable import KNOTS, POINTS_PER_UNKNOWN, separable_maxima

HIGHEST = np.array([0.9, 0.15, 0.65])


def hills(points):
    """Five hills in each coordinate, of which the one at `HIGHEST` is the highest."""
    away = points - HIGHEST
    return (np.cos(10 * np.pi * away) - 4.0 * away**2).sum(axis=1)


def uniform(count, dimension=3, seed=0):
    return np.random.default_rng(seed).random((count, dimension))


@pytest.mark.parametrize("seed", range(5))
def test_the_highest_hill_of_a_separable_function_is_found_in_every_coordinate(seed):
    points = uniform(600, seed=seed)
    guesses = list(separable_maxima(points, hills(points)))
    assert len(guesses) == len(KNOTS)
    assert np.abs(guesses[0] - HIGHEST).max() <= 1.0 / (KNOTS[0] - 1)


@pytest.mark.parametrize("unit", [2.0**-900, 1.0, 2.0**900])
def test_units_of_the_values_change_nothing(unit):
    points = uniform(200)
    assert np.array_equal(
        list(separable_maxima(points, unit * hills(points))), list(separable_maxima(points, hills(points)))
    )


def test_there_is_no_fit_of_too_few_points_of_one_coordinate_or_of_a_constant():
    few = uniform(int(POINTS_PER_UNKNOWN * 3 * KNOTS[-1]) - 1)
    assert not list(separable_maxima(few, hills(few)))
    assert not list(separable_maxima(uniform(500, 1), uniform(500, 1)[:, 0]))
    assert not list(separable_maxima(uniform(500), np.ones(500)))
    points, values = uniform(500), hills(uniform(500))
    values[::2] = -np.inf
    assert len(list(separable_maxima(points, values))) == len(KNOTS)


@pytest.mark.parametrize("seed", range(5))
def test_a_polish_goes_to_the_highest_hill_of_a_separable_function(seed):
    points = uniform(500, seed=seed)
    points = points[np.abs(points - HIGHEST).max(axis=1) > 0.1]  # none is on the highest hill
    objective = CountedObjective(Target(hills, sr.Box(np.zeros(3), np.ones(3))), 150)
    with suppress(sr.SearchEnded):
        polish(objective, points, hills(points))
    assert objective.best_value == pytest.approx(3.0, abs=1e-3)
