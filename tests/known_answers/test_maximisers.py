"""Guards known answers: maximisers against published results and exact expectations, on functions whose maxima are
known.

The target at level ``t`` is ``f* - (f* - mean f)(1 - t)``, the mean over the box, as in Malherbe and Vayatis (ICML
2017); a search counts the evaluations until it is reached, 1000 at most. Means of two samples agree if they differ by
less than two standard errors of the difference.
"""

from __future__ import annotations

import math
from functools import cache

import numpy as np
import pytest

import sparserob_core as sr
from tests.support.functions import GARLAND_FLOOR, LANDSCAPES

CAP = 1000
LEVELS = (0.90, 0.95, 0.99)
SAMPLE = 2_000_000


def test_every_landscape_attains_its_maximum_where_it_says_and_exceeds_it_nowhere():
    rng = np.random.default_rng(0)
    for landscape in LANDSCAPES.values():
        box, scale = landscape.box, max(1.0, abs(landscape.maximum))
        floor = GARLAND_FLOOR if landscape.name == "garland1" else 1e-12 * scale
        assert landscape.function(landscape.maximiser[np.newaxis])[0] == pytest.approx(landscape.maximum, abs=floor)
        everywhere = rng.uniform(box.lower, box.upper, (50_000, box.dimension))
        nearby = np.clip(
            landscape.maximiser + 1e-3 * (box.upper - box.lower) * rng.standard_normal(everywhere.shape),
            box.lower,
            box.upper,
        )
        assert landscape.function(np.concatenate([everywhere, nearby])).max() <= landscape.maximum + floor


# SequOOL. The paper (Bartlett, Gabillon and Valko 2019) shows curves only. These regrets come from two independent
# implementations of its
# rule with three children, the centre's value inherited, and splits that go round the coordinates; "floor": what is
# left is rounding.

OPENINGS = {25: (6, 25), 50: (11, 45), 100: (19, 91), 250: (40, 223), 500: (73, 465)}
REGRETS = {
    "garland1": (3.492e-2, 2.177e-3, 1.966e-5, "floor", "floor"),
    "inverse_e": (2.393e-5, 5.305e-7, 1.219e-10, "floor", "floor"),
    "double_sine": (1.577e-1, 1.472e-2, 1.472e-2, 1.330e-3, 1.330e-3),
    "holder2": (9.798e-2, 1.707e-3, 5.898e-8, "floor", "floor"),
    "rastrigin3s": (10.63, 7.105, 5.975, 4.975, 1.990),
}
FLOORS = {"garland1": GARLAND_FLOOR, "inverse_e": 0.0, "holder2": 2e-14}


@pytest.mark.parametrize("name", REGRETS)
def test_sequool_has_the_known_regret_after_n_openings(name):
    landscape = LANDSCAPES[name]
    for (openings, (hmax, evaluations)), expected in zip(OPENINGS.items(), REGRETS[name], strict=True):
        report = sr.maximise(landscape.function, landscape.box, "sequool", budget=2000, openings=openings, polish=0.0)
        assert report.evaluations == evaluations
        assert (report.trace.notes["hmax"][:, 1] == hmax).all()
        regret = landscape.regret(report.best_value)
        if expected == "floor":
            assert regret <= FLOORS[name]
        else:
            assert regret == pytest.approx(expected, rel=5e-4)


@pytest.mark.parametrize(
    ("budget", "hmax", "evaluations"), [(100, 20, 99), (300, 51, 297), (1000, 139, 987), (10_000, 983, 9993)]
)
def test_sequool_fills_the_budget_with_the_largest_depth_that_fits(budget, hmax, evaluations):
    landscape = LANDSCAPES["holder2"]
    report = sr.maximise(landscape.function, landscape.box, "sequool", budget=budget, polish=0.0)
    assert report.evaluations == evaluations
    assert report.trace.notes["hmax"][-1, 1] == hmax


@pytest.mark.parametrize(("openings", "hmax", "evaluations"), [(499, 73, 465), (1000, 133, 945), (5000, 549, 5055)])
def test_sequool_under_the_paper_s_rule_evaluates_as_often_as_is_known(openings, hmax, evaluations):
    landscape = LANDSCAPES["rosenbrock2"]
    report = sr.maximise(landscape.function, landscape.box, "sequool", budget=6000, openings=openings, polish=0.0)
    assert (report.evaluations, report.trace.notes["hmax"][-1, 1]) == (evaluations, hmax)


# After 1000 evaluations: no worse than the best implementation of SequOOL that was measured before this one (PyXAB
# 0.3.0, binary or ternary).
PEER = {
    "garland1": 1.3e-8,
    "holder2": 1.8e-12,
    "himmelblau2": 3.2e-8,
    "ackley2s": 1.8e-4,
    "rastrigin3s": 2.0,
    "rosenbrock2": 2.1e-3,
}


@pytest.mark.parametrize("name", PEER)
def test_sequool_is_no_worse_than_its_peer_after_1000_evaluations(name):
    landscape = LANDSCAPES[name]
    assert (
        landscape.regret(sr.maximise(landscape.function, landscape.box, "sequool", budget=CAP, polish=0.0).best_value)
        <= PEER[name]
    )


# Random search. With the probability P of a point at the target, the expected number of evaluations is 1 / P, and (1 -
# (1 - P)^n) / P when it
# is cut at n.


@cache
def sampled(name):
    """Values at uniform points, sorted: the distribution of the function."""
    landscape = LANDSCAPES[name]
    rng, box = np.random.default_rng(1), landscape.box
    parts = [landscape.function(rng.uniform(box.lower, box.upper, (SAMPLE // 10, box.dimension))) for _ in range(10)]
    return np.sort(np.concatenate(parts))


def targets(name):
    landscape = LANDSCAPES[name]
    return [landscape.maximum - (landscape.maximum - sampled(name).mean()) * (1 - level) for level in LEVELS]


def probability(name, target):
    """Of a uniform point to reach the target; in closed form where it is too rare for a sample."""
    if name == "sphere4":
        radius = -target
        assert radius <= math.pi / 16, "the ball is to lie in the box"
        return math.pi**2 / 2 * radius**4
    return 1.0 - np.searchsorted(sampled(name), target) / SAMPLE


def first_reached(trace, target, cap=CAP):
    return int(np.argmax(trace.best >= target)) + 1 if trace.best[-1] >= target else cap


def counts(maximiser, name, goals, seeds, cap=CAP):
    """Evaluations until each of the ascending goals ``(seeds, goals)``; a value at the last one is turned into ``inf``,
    which ends the search."""
    landscape = LANDSCAPES[name]

    def until_the_last(points):
        values = landscape.function(points)
        return np.where(values >= goals[-1], np.inf, values)

    traces = [
        sr.maximise(until_the_last, landscape.box, maximiser, budget=cap, seed=seed, polish=0.0).trace
        for seed in range(seeds)
    ]
    return np.array([[first_reached(trace, goal, cap) for goal in goals] for trace in traces])


EXPECTED = {
    "holder2": (191, 350, 781),
    "sphere4": (903, 993, 1000),
    "deb5": (956, 993, 1000),
    "rosenbrock3": (9.7, 19.5, 116),
    "linear_slope4": (932, 996, 1000),
}


@pytest.mark.first(1)
@pytest.mark.parametrize(
    "name", [pytest.param(name, marks=pytest.mark.slow if name == "deb5" else ()) for name in EXPECTED]
)
def test_random_search_needs_as_many_evaluations_as_is_expected_exactly(name):
    goals = targets(name)
    chances = np.array([probability(name, goal) for goal in goals])
    expected = np.array([CAP if chance == 0 else (1 - (1 - chance) ** CAP) / chance for chance in chances])
    np.testing.assert_allclose(expected, EXPECTED[name], rtol=0.025)  # those were rounded, and estimated from samples
    found = counts("random_search", name, goals, 300)
    error = found.std(axis=0, ddof=1) / math.sqrt(len(found))
    assert (np.abs(found.mean(axis=0) - expected) <= 2 * error + 0.5).all()


# Rows of the results table in dlib's documentation for pure random search, mean and standard deviation; its number of
# runs is not said there,
# and taken to be 100.
DLIB_RANDOM = {("holder2", 0.1): (3043, 2901), ("sphere4", 0.1): (1929, 2034), ("deb5", 0.1): (3933, 3869)}


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "accuracy"),
    [pytest.param(*key, marks=() if key[0] == "sphere4" else pytest.mark.slow) for key in DLIB_RANDOM],
)
def test_random_search_needs_as_many_evaluations_as_dlib_s(name, accuracy):
    goal = LANDSCAPES[name].maximum - accuracy
    mean, deviation = DLIB_RANDOM[name, accuracy]
    chance = probability(name, goal)
    unsure = 0.0 if name == "sphere4" else 1 / math.sqrt(chance * SAMPLE)  # relative error of the sampled probability
    assert abs(1 / chance - mean) <= 2 * math.hypot(deviation / 10, unsure / chance)
    found = counts("random_search", name, [goal], 1000, cap=100_000)
    assert abs(found.mean() - 1 / chance) <= 2 * math.hypot(found.std(ddof=1) / math.sqrt(1000), unsure / chance)


# AdaLIPO, p = 0.1 and alpha = 0.01 / d: mean and standard deviation over 100 runs as in Malherbe and Vayatis (2017).
# Their Rosenbrock and LinearSlope
# columns are not here: random search, whose expectation is exact, does not give their figures either with the functions
# as they are stated.
# For Sphere at 99 % only the range 45 to 50 is known, without a deviation.
PUBLISHED = {
    "holder2": ((77, 58), (102, 65), (212, 129)),
    "sphere4": ((36, 12), (41, 12), None),
    "deb5": ((916, 225), (986, 81), (1000, 0)),
}


@pytest.mark.slow
@pytest.mark.parametrize(
    "name", ["sphere4", *(pytest.param(name, marks=pytest.mark.slow) for name in ("holder2", "deb5"))]
)
def test_adalipo_needs_as_many_evaluations_as_published(name):
    found = counts("adalipo", name, targets(name), 100)
    for column, published in zip(found.T, PUBLISHED[name], strict=True):
        if published is None:
            error = column.std(ddof=1) / 10
            assert 45 - 2 * error <= column.mean() <= 50 + 2 * error
        else:
            mean, deviation = published
            assert abs(column.mean() - mean) <= 2 * math.hypot(column.std(ddof=1), deviation) / 10
