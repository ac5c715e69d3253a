"""Guards plugins/sparserob_lipo: lIPO evaluates only what can still be the best, AdaLIPO learns the constant; both stay
bounded, and only what is proven is called a bound."""

from __future__ import annotations

import time

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import sparserob_core as sr
from sparserob_lipo import AdaLipo, Lipo
from sparserob_lipo.walk import Walk

UNIT = sr.Box([0.0, 0.0], [1.0, 1.0])


def cones(centres, heights, constant):
    """The largest of some cones: its Lipschitz constant is exact."""
    centres, heights = np.asarray(centres, dtype=float), np.asarray(heights, dtype=float)

    def value(points):
        return (heights - constant * np.linalg.norm(points[:, np.newaxis] - centres, axis=2)).max(axis=1)

    return value


TWO = cones([[0.2, 0.71], [0.83, 0.3]], [1.0, 0.9], 2.0)


def excluded(trace, constant):
    """Which points were excluded, by the definition, when they were evaluated."""
    out = []
    for t in range(1, len(trace.values)):
        bounds = trace.values[:t] + constant * np.linalg.norm(trace.points[:t] - trace.points[t], axis=1)
        out.append(bounds.min() < trace.values[:t].max() - 1e-12)
    return np.array(out)


def test_lipo_evaluates_no_point_that_is_excluded_by_an_earlier_one():
    report = sr.maximise(TWO, UNIT, "lipo", budget=150, constant=4.0, polish=0.0)
    assert not excluded(report.trace, 4.0).any()
    assert report.trace.notes["rejected"][-1, 1] > 0.5


@pytest.mark.slow
def test_adalipo_evaluates_excluded_points_only_when_it_explores():
    report = sr.maximise(TWO, UNIT, "adalipo", budget=300, growth=0.01, polish=0.0)
    constants = report.trace.notes["constant"][1:, 1]
    shares = [
        excluded(sr.Trace(report.trace.points[: t + 2], report.trace.values[: t + 2], report.trace.best, {}), k)[-1]
        for t, k in enumerate(constants)
    ]
    assert 0.02 < np.mean(shares) < 0.2


def test_the_estimated_constant_is_the_next_on_the_grid_above_the_steepest_slope():
    report = sr.maximise(TWO, UNIT, "adalipo", budget=60, growth=0.5, polish=0.0)
    grid = report.trace.notes["constant"][2, 1]
    for evaluations, constant in report.trace.notes["constant"][2:]:
        points, values = report.trace.points[: int(evaluations) - 1], report.trace.values[: int(evaluations) - 1]
        far = np.linalg.norm(points[:, np.newaxis] - points, axis=2) + np.eye(len(points))
        slope = (np.abs(values[:, np.newaxis] - values) / far).max()
        assert slope * (1 - 1e-9) <= constant <= slope * 1.5
        power = np.log(constant / grid) / np.log(1.5)
        assert power == pytest.approx(round(power), abs=1e-9)


@pytest.mark.first(5)
@pytest.mark.parametrize("seed", range(20))
def test_with_the_right_constant_lipo_is_never_worse_than_its_own_uniform_candidates(seed, monkeypatch):
    """Every evaluation draws a uniform candidate first: with these alone, the search would be pure random search."""
    uniform = []
    draw = Walk._candidates

    def recorded(walk, drawn, count):
        points = draw(walk, drawn, count)
        uniform.extend(points[:1] if drawn == 0 else [])
        return points

    monkeypatch.setattr(Walk, "_candidates", recorded)
    report = sr.maximise(TWO, UNIT, "lipo", budget=40, seed=seed, constant=2.0, polish=0.0)
    chance = np.maximum.accumulate([report.trace.values[0], *TWO(np.array(uniform))])
    assert len(chance) == 40
    assert (report.trace.best >= chance - 1e-12).all()
    assert abs(np.mean(uniform) - 0.5) < 0.15


def test_without_a_constant_lipo_is_pure_random_search_and_proves_nothing():
    report = sr.maximise(TWO, UNIT, "lipo", budget=200, polish=0.0)
    assert report.upper_bound == np.inf
    assert report.evaluations == 200
    assert np.abs(report.trace.points.mean(axis=0) - 0.5).max() < 0.07


@pytest.mark.slow
@settings(max_examples=30, deadline=None)
@given(
    seed=st.integers(0, 10_000),
    budget=st.sampled_from([1, 2, 5, 30, 120]),
    slack=st.sampled_from([1.0, 1.5]),
    d=st.integers(1, 4),
)
def test_the_bound_of_lipo_is_never_below_the_maximum(seed, budget, slack, d):
    rng = np.random.default_rng(seed)
    sides = 10.0 ** rng.integers(-3, 4, d)
    lower = rng.normal(size=d) * sides
    centres, heights = lower + rng.random((4, d)) * sides, rng.normal(size=4)
    steepness = float(10.0 ** rng.integers(-2, 3))
    function = cones(centres, heights, steepness)
    report = sr.maximise(
        function, sr.Box(lower, lower + sides), "lipo", budget=budget, seed=seed, constant=slack * steepness, polish=0.0
    )
    assert np.isfinite(report.upper_bound)
    assert report.upper_bound >= function(centres).max()


@pytest.mark.slow
def test_the_bound_closes_on_the_maximum():
    gaps = [
        sr.maximise(TWO, UNIT, "lipo", budget=budget, constant=3.0, polish=0.0).upper_bound - 1.0
        for budget in (10, 80, 600)
    ]
    assert gaps[0] > gaps[1] > gaps[2] >= 0
    assert gaps[2] < 0.05


def test_a_constant_that_the_values_refute_proves_nothing():
    assert sr.maximise(TWO, UNIT, "lipo", budget=50, constant=0.5, polish=0.0).upper_bound == np.inf
    undefined = sr.maximise(
        lambda x: np.where(x[:, 0] < 0.5, -np.inf, TWO(x)), UNIT, "lipo", budget=50, constant=2.0, polish=0.0
    )
    assert undefined.upper_bound == np.inf


@pytest.mark.first(2)
@pytest.mark.parametrize("factor", [1e-200, 1e-9, 1e9, 1e200])
def test_adalipo_does_not_depend_on_the_unit_of_the_value(factor):
    plain = sr.maximise(TWO, UNIT, "adalipo", budget=80, growth=1e-9, polish=0.0)
    scaled = sr.maximise(lambda x: factor * TWO(x), UNIT, "adalipo", budget=80, growth=1e-9, polish=0.0)
    np.testing.assert_allclose(scaled.trace.points, plain.trace.points, atol=1e-6)


def test_adalipo_does_not_depend_on_the_units_of_the_coordinates():
    lower, sides = np.array([3e5, -1e-3]), np.array([1e6, 1e-3])
    plain = sr.maximise(TWO, UNIT, "adalipo", budget=80, polish=0.0)
    scaled = sr.maximise(
        lambda x: TWO((x - lower) / sides), sr.Box(lower, lower + sides), "adalipo", budget=80, polish=0.0
    )
    np.testing.assert_allclose((scaled.trace.points - lower) / sides, plain.trace.points, atol=1e-6)


@pytest.mark.first(7)
@pytest.mark.parametrize("maximiser", [AdaLipo(), Lipo(constant=1e-12), Lipo(constant=1e12)])
@pytest.mark.parametrize(
    "function",
    [
        lambda x: np.zeros(len(x)),
        lambda x: np.sign(x[:, 0] - 0.37),
        lambda x: -1e300 * (x[:, 0] - 0.4) ** 2,
        lambda x: 1.7e308 * np.cos(40 * x[:, 0]),
        lambda x: np.where(x[:, 0] < 0.9, -np.inf, x[:, 0]),
    ],
)
def test_no_function_hangs_or_breaks_the_search(maximiser, function):
    started = time.process_time()
    report = sr.maximise(function, sr.Box([0.0, 5.0, 0.0], [1.0, 5.0, 1e-3]), maximiser, budget=100, polish=0.0)
    assert report.evaluations == 100
    assert time.process_time() - started < 5.0


def test_where_everything_that_is_drawn_is_excluded_the_search_goes_on():
    report = sr.maximise(cones([[0.3, 0.3]], [0.0], 100.0), UNIT, "lipo", budget=60, constant=1e-3, polish=0.0)
    assert report.evaluations == 60
    assert report.trace.notes["rejected"][-1, 1] > 0.99


def test_a_hundred_thousand_dimensions_are_survived():
    d = 100_000
    report = sr.maximise(
        lambda x: -np.abs(x[:, :3]).sum(axis=1), sr.Box(np.zeros(d), np.ones(d)), "adalipo", budget=12, polish=0.0
    )
    assert report.evaluations == 12


def test_forgotten_points_only_make_the_search_less_selective(monkeypatch):
    import sparserob_lipo.evaluated as evaluated

    monkeypatch.setattr(evaluated, "KEPT_NUMBERS", 40)  # 20 points in the plane
    report = sr.maximise(TWO, UNIT, "lipo", budget=150, constant=2.0, polish=0.0)
    assert report.best_value > 0.95
    assert 1.0 <= report.upper_bound < np.inf


def test_a_search_that_goes_on_starts_from_the_best_point_so_far():
    class Continued(sr.Maximiser):
        def search(self, objective, rng):
            objective.evaluate(np.array([[0.2, 0.71]]))
            return AdaLipo(exploration=0.05).search(objective, rng)

    report = sr.maximise(TWO, UNIT, Continued(), budget=60, polish=0.0)
    near = np.linalg.norm(report.trace.points[30:] - [0.2, 0.71], axis=1)
    assert np.median(near) < 0.2
