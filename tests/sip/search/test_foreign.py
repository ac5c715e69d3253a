"""Guards sip/search/foreign.py: other people's optimisers as maximisers, behind the contract of every maximiser."""

from __future__ import annotations

import warnings

import numpy as np
import pytest
from scipy.optimize import minimize

import sparserob_core as sr
from sparserob_core.testing import MaximiserContract

BOX = sr.Box([-2.0, -1.0], [1.0, 3.0])


def bowl(points):
    return -((points - 0.3) ** 2).sum(axis=1)


class Halving:
    """Asks for points around the best one, told one after the other, ever nearer."""

    def __init__(self, dimension, budget, rng):
        self.best, self.loss, self.radius, self.rng = np.full(dimension, 0.5), np.inf, 1.0, rng

    def ask(self):
        return self.best + self.radius * (self.rng.random(self.best.size) - 0.5)

    def tell(self, point, loss):
        assert isinstance(loss, float)
        self.radius *= 0.98
        if loss < self.loss:
            self.best, self.loss = point, loss


def nelder_mead(f, start):
    minimize(f, start, method="Nelder-Mead", options={"maxfev": 200})


@pytest.mark.slow
class TestAskedAndTold(MaximiserContract):
    def create(self):
        return sr.from_ask_tell(Halving)


@pytest.mark.slow
class TestMinimiser(MaximiserContract):
    def create(self):
        return sr.from_minimiser(nelder_mead)


def evolution(dimension, budget, rng):
    import cma

    options = {"seed": int(rng.integers(1, 2**31)), "verbose": -9, "bounds": [0, 1]}
    return cma.CMAEvolutionStrategy([0.5] * dimension, 0.3, options)


def test_populations_are_told_as_lists_and_made_anew_when_they_stop():
    pytest.importorskip("cma")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        report = sr.maximise(bowl, BOX, sr.from_ask_tell(evolution), budget=1500, polish=0.0)
    assert report.evaluations == 1500
    assert report.best_value > -1e-12


def test_a_point_may_be_read_from_what_was_asked():
    ng = pytest.importorskip("nevergrad")

    def portfolio(dimension, budget, rng):
        box = ng.p.Array(shape=(dimension,), lower=0.0, upper=1.0)
        box.random_state = np.random.RandomState(rng.integers(2**31))
        return ng.optimizers.OnePlusOne(box, budget=budget)

    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        report = sr.maximise(bowl, BOX, sr.from_ask_tell(portfolio, read=lambda asked: asked.value), budget=200)
    assert report.best_value > -1e-3


def test_points_outside_are_moved_to_the_box_and_no_value_is_a_large_loss():
    told = []

    class Wild(Halving):
        def ask(self):
            return np.array([np.nan, 7.0]) if len(told) % 2 else np.array([0.1, -3.0])

        def tell(self, point, loss):
            told.append(loss)

    report = sr.maximise(
        lambda points: np.where(points[:, 0] < -1.0, -np.inf, 1.0), BOX, sr.from_ask_tell(Wild), budget=10, polish=0.0
    )
    assert set(told) == {1e20, -1.0}
    assert np.unique(report.trace.points, axis=0).tolist() == [[-1.7, -1.0], [-0.5, 3.0]]


def test_a_minimiser_that_asks_for_nothing_ends_the_search():
    with pytest.raises(sr.PluginError, match="asked for no value"):
        sr.maximise(bowl, BOX, sr.from_minimiser(lambda f, start: None), budget=10)
    first = sr.maximise(bowl, BOX, sr.from_minimiser(lambda f, start: f(start)), budget=3, start=[0.25, 0.25])
    assert first.trace.points[:2].tolist() == [[0.25, 0.25]] * 2, "it begins at the best point so far"
