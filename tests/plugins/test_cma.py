"""Guards plugins/sparserob_cma: ridges however they are turned, restarts, generations in one batch."""

from __future__ import annotations

import numpy as np
import pytest

import sparserob_core as sr
from sparserob_cma import CMA

pytest.importorskip("cma")


def ridge(dimension, seed=1):
    """An ellipsoid of condition 10^4 whose axes are turned against the coordinates, and its top."""
    rng = np.random.default_rng(seed)
    axes, top = np.linalg.qr(rng.normal(size=(dimension, dimension)))[0], rng.uniform(-0.5, 0.5, dimension)
    lengths = np.geomspace(1.0, 1e4, dimension)
    return lambda x: -(((x - top) @ axes) ** 2 @ lengths)


def search(function, dimension, budget, seed=0, maximiser=None, **more):
    box = sr.Box(np.full(dimension, -1.0), np.full(dimension, 1.0))
    return sr.maximise(function, box, maximiser or CMA(), budget=budget, seed=seed, polish=0, **more)


def test_a_turned_ridge_is_followed_to_its_top_where_a_walk_along_the_coordinates_is_lost():
    function = ridge(6)
    assert search(function, 6, 2500).best_value > -1e-6
    assert search(function, 6, 2500, maximiser="simulated_annealing").best_value < -1e-2


def test_generations_are_evaluated_at_once_and_grow_at_a_restart():
    sizes = []

    def counted(points):
        sizes.append(len(points))
        return -(points**2).sum(axis=1)

    search(counted, 2, 3000, maximiser=CMA(population=5, growth=3.0))
    assert {5, 15} <= set(sizes)
    assert sizes == sorted(sizes[:-1]) + sizes[-1:]


def test_it_begins_at_the_best_point_that_is_known():
    known = np.array([[0.9, 0.9], [0.1, 0.2]]), np.array([-5.0, -1.0])
    trace = search(ridge(2), 2, 6, known=known, maximiser=CMA(sigma=1e-6)).trace
    assert np.abs(trace.points - known[0][1]).max() < 1e-4


@pytest.mark.slow
def test_beyond_a_hundred_coordinates_it_still_climbs():
    report = search(lambda x: -((x - 0.3) ** 2).sum(axis=1), 300, 4000)
    assert report.trace.best[0] < 4.0 * report.best_value
