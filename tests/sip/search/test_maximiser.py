"""Guards sip/search: the objective keeps the accounts, whatever a maximiser does; the report says how the search
ended."""

from __future__ import annotations

import time

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import sparserob_core as sr
from sparserob_core.sip.search.search import CountedObjective, Target, maximise

SQUARE = sr.Box([-1.0, -1.0], [1.0, 1.0])


def hill(points):
    return -((points - 0.25) ** 2).sum(axis=1)


class Asking(sr.Maximiser):
    """Asks for batches of the given sizes."""

    def __init__(self, *sizes):
        self.sizes = sizes

    def search(self, objective, rng):
        for size in self.sizes:
            objective.note(size=size)
            objective.evaluate(rng.uniform(-1, 1, (size, 2)))
        return np.inf


def search(maximiser, function=hill, budget=100):
    return maximise(Target(function, SQUARE), maximiser, budget, np.random.default_rng(0))


@given(budget=st.integers(1, 40), sizes=st.lists(st.integers(0, 30), min_size=1, max_size=6))
def test_exactly_the_allowed_prefix_of_a_batch_is_evaluated(budget, sizes):
    calls = []
    report = search(Asking(*sizes), lambda points: calls.append(len(points)) or hill(points), budget)
    assert report.evaluations == sum(calls) == min(budget, sum(sizes))
    assert (report.stopped == "the budget is spent") == (sum(sizes) >= budget)


def test_the_best_point_and_the_running_best_belong_to_the_evaluated_values():
    report = search(Asking(3, 1, 5))
    assert report.best_value == report.trace.values.max() == report.trace.best[-1]
    assert hill(report.best_point[np.newaxis])[0] == report.best_value
    np.testing.assert_array_equal(report.trace.best, np.maximum.accumulate(hill(report.trace.points)))


def test_notes_are_columns_against_the_number_of_evaluations():
    np.testing.assert_array_equal(search(Asking(3, 1, 5)).trace.notes["size"], [[0, 3], [3, 1], [4, 5]])


@pytest.mark.parametrize("point", [[1.0000001, 0.0], [np.nan, 0.0], [0.0, -np.inf]])
def test_a_point_outside_the_domain_is_refused_and_not_counted(point):
    objective = CountedObjective(Target(hill, SQUARE), 10)
    with pytest.raises(sr.PluginError, match="outside the domain"):
        objective.evaluate(np.array([[0.0, 0.0], point]))
    assert objective.evaluations == 0


@pytest.mark.parametrize("points", [np.zeros(2), np.zeros((1, 3))])
def test_points_of_the_wrong_shape_are_refused(points):
    with pytest.raises(sr.PluginError, match=r"expected shape \(k, 2\)"):
        CountedObjective(Target(hill, SQUARE), 10).evaluate(points)


def test_no_number_counts_as_minus_infinity():
    objective = CountedObjective(Target(lambda points: np.where(points[:, 0] < 0, np.nan, 1.0), SQUARE), 10)
    np.testing.assert_array_equal(objective.evaluate(np.array([[-0.5, 0.0], [0.5, 0.0]])), [-np.inf, 1.0])
    assert objective.best_value == 1.0


def test_plus_infinity_ends_the_search_at_its_point():
    report = search(Asking(50, 50), lambda points: np.where(points[:, 0] > 0.5, np.inf, 0.0))
    assert report.best_value == np.inf
    assert report.best_point[0] > 0.5
    assert report.evaluations == 50
    assert "+inf" in report.stopped


def test_a_function_may_scribble_on_its_points_without_harm():
    def scribbling(points):
        values = hill(points)
        points[:] = np.nan
        return values

    assert np.isfinite(search(Asking(5), scribbling).trace.points).all()


@pytest.mark.parametrize(
    "answer",
    [
        lambda points: 1.0,
        lambda points: np.zeros((len(points), 1)),
        lambda points: ["a"] * len(points),
        lambda points: None,
    ],
)
def test_a_function_that_does_not_return_one_number_per_point_is_named_as_the_fault(answer):
    with pytest.raises(sr.EvaluationError, match="the function failed after 0 evaluations"):
        search(Asking(2), answer)


@pytest.mark.parametrize("answer", [lambda points: points[:, 0] + 0j, lambda points: [1j] * len(points)])
def test_complex_values_are_refused_with_what_was_expected(answer):
    with pytest.raises(sr.EvaluationError, match="expected real numbers, got complex ones"):
        search(Asking(2), answer)


def test_a_function_that_is_nowhere_a_number_is_refused_and_one_that_is_once_is_not():
    def found(function):
        return sr.maximise(function, SQUARE, Asking(3, 3), budget=6, polish=0.0)

    with pytest.raises(sr.EvaluationError, match="NaN at each of the 6 points that were asked for; expected") as caught:
        found(lambda points: points[:, 0] * np.nan)
    assert caught.value.report.evaluations == caught.value.report.missing == 6
    once = found(lambda points: [np.nan, 7.0, np.nan])
    assert (once.best_value, once.missing) == (7.0, 4)
    nowhere = found(lambda points: np.full(3, -np.inf))
    assert (nowhere.best_value, nowhere.missing) == (-np.inf, 0)


def test_the_error_of_a_failing_function_carries_the_best_point_so_far():
    def failing(points):
        if len(points) == 3:
            raise KeyError("gone")
        return hill(points)

    with pytest.raises(
        sr.EvaluationError, match=r"after 5 evaluations \(the best of them .* KeyError: 'gone'"
    ) as caught:
        search(Asking(5, 3), failing)
    assert caught.value.report.evaluations == 5
    assert caught.value.report.best_value == hill(caught.value.report.best_point[np.newaxis])[0]


def test_an_upper_bound_below_an_evaluated_value_is_refused():
    class Lying(Asking):
        def search(self, objective, rng):
            super().search(objective, rng)
            return objective.best_value - 1e-9

    with pytest.raises(sr.PluginError, match="Lying: claims the upper bound"):
        search(Lying(4))


@pytest.mark.parametrize("budget", [0, -3, 2.5])
def test_a_budget_that_is_no_positive_whole_number_is_refused(budget):
    with pytest.raises(sr.InputError, match="budget"):
        search(Asking(1), budget=budget)


def test_an_unbounded_domain_is_refused():
    with pytest.raises(sr.InputError, match="bounded box"):
        CountedObjective(Target(hill, sr.Box([0.0], [np.inf])), 10)


def test_observers_hear_of_every_evaluation_once():
    events = []
    maximise(Target(hill, SQUARE), Asking(3, 4), 100, np.random.default_rng(0), notify=events.append)
    assert sum(event.count for event in events) == events[-1].total == 7
    assert events[-1].notes == {"size": 4.0}


def test_a_search_that_used_its_budget_to_the_last_says_so_and_one_that_did_not_does_not():
    assert search(Asking(5), hill, 5).stopped == "the budget is spent"
    assert search(Asking(4), hill, 5).stopped == "the maximiser found nothing left to gain"


def test_no_evaluation_begins_after_the_time_limit_not_even_of_the_polish():
    calls = []

    def slow(points):
        time.sleep(0.02)
        calls.append(len(points))
        return hill(points)

    report = sr.maximise(slow, sr.Box([0.0], [1.0]), "simulated_annealing", budget=1000, polish=0.2, seconds=0.3)
    assert report.stopped == "the time limit of the search is reached"
    assert report.trace.seconds[:-1].max() < 0.3
    assert report.evaluations == sum(calls) < 100
    with pytest.raises(sr.InputError, match="seconds: expected a positive number"):
        sr.maximise(slow, sr.Box([0.0], [1.0]), "direct", seconds=-1.0)


def test_initial_points_come_first_and_a_walk_begins_at_the_best_of_them():
    box = sr.Box([-4.0, -4.0], [4.0, 4.0])
    first = [[3.0, 3.0], [0.5, 0.4], [-3.0, 1.0]]
    for name in ("simulated_annealing", "sequool", "random_search"):
        report = sr.maximise(lambda p: -(p**2).sum(axis=1), box, name, budget=30, start=first)
        assert report.trace.points[:3].tolist() == first
        assert report.best_value >= -0.41 - 1e-12
    assert sr.maximise(lambda p: p[:, 0], box, "direct", budget=1, start=[1.0, 2.0]).best_point.tolist() == [1.0, 2.0]
    for wrong in ([1.0], [[9.0, 0.0]], [[np.nan, 0.0]], [], "here", [[0.0], [1.0, 2.0]]):
        with pytest.raises(sr.InputError, match="start: expected"):
            sr.maximise(lambda p: p[:, 0], box, "direct", budget=10, start=wrong)


def test_a_callback_hears_every_batch_and_what_it_raises_costs_a_warning_and_no_result():
    box, heard = sr.Box([0.0], [1.0]), []
    report = sr.maximise(
        lambda p: p[:, 0],
        box,
        "simulated_annealing",
        budget=40,
        callback=lambda points, values: heard.append((points, values)),
    )
    assert np.concatenate([points for points, _ in heard]).tolist() == report.trace.points.tolist()
    assert np.concatenate([values for _, values in heard]).tolist() == report.trace.values.tolist()

    def failing(*anything):
        heard.clear()
        raise RuntimeError("no disk")

    for name in ("callback", "notify"):
        with pytest.warns(UserWarning, match=f"{name} raised RuntimeError: no disk; it is not called again") as caught:
            survived = sr.maximise(lambda p: p[:, 0], box, "simulated_annealing", budget=40, **{name: failing})
        assert len(caught) == 1
        assert survived.trace.points.tolist() == report.trace.points.tolist()


def test_a_quick_search_is_told_of_regularly():
    heard = []
    sr.maximise(
        lambda p: p[:, 0], sr.Box([0.0], [1.0]), "simulated_annealing", budget=500, notify=heard.append, polish=0.0
    )
    assert 20 <= len(heard) <= 40
    assert sum(event.count for event in heard) == heard[-1].total == 500
    assert max(event.count for event in heard) <= 50


@pytest.mark.parametrize("name", ["sequool", "simulated_annealing", "direct"])
def test_a_fifth_of_the_budget_polishes_unless_told_otherwise(name):
    box = sr.Box([-2.0, -1.0], [1.5, 3.0])

    def valley(points):
        return -((1.0 - points[:, 0]) ** 2) - 30.0 * (points[:, 1] - points[:, 0] ** 2) ** 2

    by_default, given, none = (
        sr.maximise(valley, box, name, budget=200, **kind) for kind in ({}, {"polish": 0.2}, {"polish": 0.0})
    )
    assert by_default.trace.points.tolist() == given.trace.points.tolist()
    assert by_default.best_value > none.best_value
    assert by_default.stopped.endswith("; then polished")
    assert by_default.evaluations <= 200


def test_sobol_polishes_unless_told_otherwise():
    box = sr.Box([-2.0, -1.0], [1.5, 3.0])
    by_default, none = (
        sr.maximise(lambda p: -(p**2).sum(axis=1), box, "sobol", budget=100, **kind) for kind in ({}, {"polish": 0})
    )
    assert by_default.stopped.endswith("; then polished") and "polished" not in none.stopped
    assert by_default.best_value > 1e-3 * none.best_value


def test_a_yardstick_and_a_proof_are_not_polished_unless_asked():
    box = sr.Box([0.0], [1.0])
    for name, options in (("random_search", {}), ("lipo", {"constant": 1.0})):
        report = sr.maximise(lambda p: p[:, 0], box, name, budget=30, **options)
        assert "polished" not in report.stopped
        assert "polished" in sr.maximise(lambda p: p[:, 0], box, name, budget=30, polish=0.5, **options).stopped


SLOPE = sr.Box([0.0, 0.0], [1.0, 1.0])


@pytest.mark.parametrize("name", ["random_search", "simulated_annealing", "direct", "maxlipo", "sobol"])
def test_a_target_ends_the_search_where_it_is_reached(name):
    calls = []

    def rising(points):
        calls.append(len(points))
        return points.sum(axis=1)

    report = sr.maximise(rising, SLOPE, name, budget=5000, target=1.2)
    assert report.best_value >= 1.2
    assert report.stopped == "the target 1.2 is reached"
    assert (report.trace.best[: -calls[-1]] < 1.2).all(), "in the last batch, and without a polish"
    assert report.evaluations < 5000


@pytest.mark.parametrize("name", ["random_search", "simulated_annealing", "sequool", "gradient_ascent"])
@pytest.mark.parametrize("patience", [1, 7, 40])
def test_patience_ends_it_after_exactly_so_many_evaluations_without_a_gain(name, patience):
    report = sr.maximise(lambda x: np.minimum(x.sum(axis=1), 0.9), SLOPE, name, budget=2000, patience=patience, seed=1)
    best = report.trace.best
    last = int(np.argmax(best == best[-1]))
    assert report.evaluations == last + 1 + patience
    assert "gained nothing" in report.stopped
    gains = np.flatnonzero(np.diff(best, prepend=-np.inf) > 0)
    assert np.diff(gains).max(initial=0) <= patience


@pytest.mark.parametrize("answer", [True, np.True_])
def test_a_callback_that_returns_true_ends_it(answer):
    heard = []

    def callback(points, values):
        heard.append(len(points))
        return answer if len(heard) == 3 else None

    report = sr.maximise(lambda x: x.sum(axis=1), SLOPE, "simulated_annealing", budget=500, callback=callback)
    assert len(heard) == 3
    assert report.evaluations == sum(heard)
    assert report.stopped == "the callback says so"
    unheard = sr.maximise(lambda x: x.sum(axis=1), SLOPE, "sobol", budget=50, callback=lambda *given: len(given))
    assert unheard.evaluations == 50, "only the answer True is one"


@pytest.mark.parametrize("name", ["simulated_annealing", "maxlipo", "adalipo", "dual_annealing", "gradient_ascent"])
def test_points_known_from_before_are_not_evaluated_and_the_search_goes_on_from_them(name):
    points = np.array([[0.1, 0.9], [0.7, 0.25], [0.4, 0.4]])
    asked = []

    def bowl(x):
        asked.extend(x.tolist())
        return -((x - [0.7, 0.2]) ** 2).sum(axis=1)

    values = -((points - [0.7, 0.2]) ** 2).sum(axis=1)
    report = sr.maximise(bowl, SLOPE, name, budget=40, known=(points, values), polish=0.2)
    assert len(asked) == report.evaluations == len(report.trace.points) <= 40
    assert not [point for point in points.tolist() if point in asked]
    assert report.best_value >= values.max()
    only = sr.maximise(lambda x: -1e9 + 0 * x[:, 0], SLOPE, name, budget=20, known=(points, values))
    assert only.best_point.tolist() == [0.7, 0.25]
    assert only.evaluations <= 20
    done = sr.maximise(bowl, SLOPE, name, budget=40, known=(points, values), target=values.max())
    assert done.evaluations == 0


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"target": float("nan")}, "target: expected a number"),
        ({"target": "1"}, "target: expected a number"),
        ({"patience": 0}, "patience"),
        ({"known": ([[0.5, 0.5]], [1.0, 2.0])}, "known: expected a value for each point"),
        ({"known": ([[0.5, 2.0]], [1.0])}, "known: expected points of the box"),
        ({"known": 3}, "known: expected points and their values"),
        ({"callback": 3}, "callback: expected a function of points and values, got 3"),
        ({"integer": [0]}, "integer: expected an argument of maximise, got one of ask_tell, which takes it"),
    ],
)
def test_ends_and_known_points_that_make_no_sense_are_refused(options, words):
    with pytest.raises(sr.InputError, match=words):
        sr.maximise(lambda x: x.sum(axis=1), SLOPE, "sobol", budget=10, **options)


def test_no_points_known_from_before_are_none():
    nothing = np.empty((0, 2)), []
    reports = [
        sr.maximise(lambda x: x.sum(axis=1), SLOPE, "sequool", budget=30, known=known) for known in (None, nothing)
    ]
    assert np.array_equal(reports[0].trace.points, reports[1].trace.points)


def test_sides_whose_length_is_no_finite_number_are_refused():
    with pytest.raises(sr.InputError, match=r"sides whose length is a finite number, got -1e\+308 to 1e\+308"):
        sr.maximise(lambda x: x[:, 0], sr.Box([0.0, -1e308], [1.0, 1e308]), "direct", budget=10)
