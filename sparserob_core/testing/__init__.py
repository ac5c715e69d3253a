"""The contracts of the plugin kinds, for plugin authors to subclass in their tests; nothing else imports this
module."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable

import numpy as np

from sparserob_core.sip.convex_set import Array, Box
from sparserob_core.sip.maximiser import EvaluationError, Maximiser, Report
from sparserob_core.sip.search.search import Target, maximise
from sparserob_core.testing.executors import ExecutorContract
from sparserob_core.testing.observers import ObserverContract
from sparserob_core.testing.sets import SetContract
from sparserob_core.testing.solvers import SolverContract

__all__ = ["ExecutorContract", "MaximiserContract", "ObserverContract", "SetContract", "SolverContract"]

PLANE = Box(np.array([-3.0, -2.0]), np.array([2.0, 4.0]))
ODD_BOXES = (
    ([0.1], [0.3]),
    ([-1e6, 0.1, 3.0], [1e6, 0.3, 3.0]),
    ([0.7, 0.7], [0.7, 0.7]),
    ([1.0], [1.0 + 1e-12]),
    ([-1e-9] * 3, [1e-9] * 3),
)


def ripples(points: Array) -> Array:
    """Many maxima; smooth."""
    return np.asarray(
        (np.sin(3 * points) * np.cos(points + 0.4)).sum(axis=1) - 0.01 * (points**2).sum(axis=1), dtype=float
    )


def bowl(points: Array) -> Array:
    """One maximum, 0 at 0.3 in every coordinate."""
    return np.asarray(-((points - 0.3) ** 2).sum(axis=1), dtype=float)


def level(points: Array) -> Array:
    """2 everywhere."""
    return np.full(len(points), 2.0)


def spike(points: Array) -> Array:
    """1 in a tiny ball around 0.3, which hardly any search finds, and 0 elsewhere."""
    return np.asarray(np.abs(points - 0.3).max(axis=1) < 1e-3, dtype=float)


def nowhere(points: Array) -> Array:
    """Not a number, anywhere."""
    return np.full(len(points), np.nan)


def half_undefined(points: Array) -> Array:
    """`bowl` where the first coordinate is not negative, ``-inf`` where it is."""
    return np.where(points[:, 0] < 0, -np.inf, bowl(points))


def unbounded(points: Array) -> Array:
    """``+inf`` in a large part of the box."""
    return np.where(points[:, 0] > 0.2, np.inf, bowl(points))


class _Counted:
    """A function that counts the points it is asked for, keeps its best value, and fails in the call after
    ``fails_after`` points."""

    def __init__(
        self, function: Callable[[Array], Array], fails_after: float = np.inf, failure: BaseException | None = None
    ) -> None:
        self.function, self.fails_after, self.failure = function, fails_after, failure
        self.calls, self.failures, self.best = 0, 0, -np.inf

    def __call__(self, points: Array) -> Array:
        if self.failure is not None and (self.failures or self.calls + len(points) > self.fails_after):
            self.failures += 1
            raise self.failure
        self.calls += len(points)
        values = self.function(points)
        self.best = max(self.best, float(values.max()))
        return values


class MaximiserContract(ABC):
    """What every maximiser must keep: subclass it in a test module as ``class TestMine(MaximiserContract)`` and give
    ``create``.

    The core keeps the accounts (domain, budget, best point); the contract checks that a maximiser works with them:
    reproducible in a fresh process, at home in any box, unharmed by values that are no numbers, and honest in its upper
    bound. The largest box has 1200 coordinates (400 indices of 3), the budget there is 50 evaluations.
    """

    @abstractmethod
    def create(self) -> Maximiser:
        """A new maximiser."""

    def search(
        self, function: Callable[[Array], object], domain: Box = PLANE, budget: int = 60, seed: int = 0
    ) -> Report:
        """Run a new maximiser."""
        return maximise(Target(function, domain), self.create(), budget, np.random.default_rng(seed))

    def test_the_same_seed_gives_the_same_points(self) -> None:
        maximiser = self.create()
        first, second = (maximise(Target(ripples, PLANE), maximiser, 60, np.random.default_rng(3)) for _ in range(2))
        assert first.trace.points.tolist() == second.trace.points.tolist(), (
            "one maximiser used twice remembers its first search"
        )
        assert first.trace.points.tolist() == self.search(ripples, seed=3).trace.points.tolist()

    def test_the_same_seed_gives_the_same_points_in_a_fresh_process(self) -> None:
        from concurrent.futures import ProcessPoolExecutor
        from multiprocessing import get_context

        with ProcessPoolExecutor(1, mp_context=get_context("spawn")) as fresh:
            there = fresh.submit(maximise, Target(ripples, PLANE), self.create(), 60, np.random.default_rng(3)).result()
        assert there.trace.points.tolist() == self.search(ripples, seed=3).trace.points.tolist()

    def test_every_point_lies_in_the_box_however_odd_the_box(self) -> None:
        for lower, upper in ODD_BOXES:
            report = self.search(ripples, Box(np.array(lower), np.array(upper)))
            assert report.evaluations >= 1
            assert (report.trace.points >= lower).all()
            assert (report.trace.points <= upper).all()

    def test_a_coordinate_with_a_single_value_changes_nothing(self) -> None:
        box = Box(np.insert(PLANE.lower, 1, 7.0), np.insert(PLANE.upper, 1, 7.0))
        wide, plain = self.search(lambda points: ripples(points[:, [0, 2]]), box), self.search(ripples)
        assert wide.trace.points[:, [0, 2]].tolist() == plain.trace.points.tolist()

    def test_the_box_is_left_as_it_was(self) -> None:
        domain = Box(PLANE.lower.copy(), PLANE.upper.copy())
        self.search(ripples, domain)
        assert domain.lower.tolist() == PLANE.lower.tolist()
        assert domain.upper.tolist() == PLANE.upper.tolist()

    def test_the_budget_is_never_exceeded(self) -> None:
        for budget in (1, 2, 7, 100):
            for function in (ripples, nowhere, half_undefined):
                counted = _Counted(function)
                assert self.search(counted, budget=budget).evaluations == counted.calls <= budget

    def test_a_function_without_any_value_is_survived(self) -> None:
        report = self.search(nowhere)
        assert report.best_value == -np.inf
        assert report.evaluations >= 1

    def test_a_function_undefined_on_half_of_the_box_is_still_maximised(self) -> None:
        report = self.search(half_undefined, budget=400)
        assert -0.5 <= report.best_value <= 0.0

    def test_a_function_that_raises_ends_the_search_and_keeps_what_was_found(self) -> None:
        counted = _Counted(bowl, fails_after=20, failure=ArithmeticError("no value here"))
        try:
            self.search(counted)
        except EvaluationError as error:
            assert "no value here" in str(error)
            assert error.report.best_value == counted.best
            assert counted.failures == 1, "the function was called again after it had failed"
        else:
            raise AssertionError("the failure of the function was swallowed")

    def test_an_interrupt_ends_the_search_and_keeps_what_was_found(self) -> None:
        counted = _Counted(bowl, fails_after=20, failure=KeyboardInterrupt())
        report = self.search(counted)
        assert report.interrupted
        assert report.best_value == counted.best
        assert counted.failures == 1, "the search went on after the interrupt"

    def test_an_infinite_value_ends_the_search(self) -> None:
        """One call may find it among many points; it is the last call."""
        found: list[bool] = []

        def watched(points: Array) -> Array:
            values = unbounded(points)
            found.append(bool(np.isposinf(values).any()))
            return values

        assert self.search(watched, budget=400).best_value == np.inf
        assert found.index(True) == len(found) - 1, "the search went on after +inf"

    def test_an_upper_bound_is_never_below_the_maximum(self) -> None:
        for function, maximum in ((bowl, 0.0), (level, 2.0), (spike, 1.0)):
            for budget in (1, 10, 200):
                assert self.search(function, budget=budget).upper_bound >= maximum

    def test_a_function_evaluated_in_batches_or_point_by_point_gives_the_same_search(self) -> None:
        singly = self.search(lambda points: np.concatenate([ripples(point[np.newaxis]) for point in points]))
        together = self.search(ripples)
        np.testing.assert_array_equal(singly.trace.points, together.trace.points)
        np.testing.assert_array_equal(singly.trace.values, together.trace.values)

    def test_a_gradient_may_be_used_and_costs_what_it_says(self) -> None:
        counted = _Counted(bowl)
        target = Target(counted, PLANE, gradient=lambda point: -2.0 * (point - 0.3))
        report = maximise(target, self.create(), 60, np.random.default_rng(0))
        assert report.evaluations == counted.calls <= 60
        assert report.best_value >= -10.0

    def test_a_tuple_of_many_indices_is_searched_within_the_budget(self) -> None:
        count, width = 400, 3
        domain = Box(np.tile(PLANE.lower[:1], count * width), np.tile(PLANE.upper[1:], count * width))
        report = maximise(Target(bowl, domain, block=width), self.create(), 50, np.random.default_rng(0))
        assert 1 <= report.evaluations <= 50
        assert report.best_value > -np.inf

    def test_a_smooth_hill_is_climbed_at_least_part_of_the_way(self) -> None:
        assert self.search(bowl, budget=500).best_value >= -0.5
