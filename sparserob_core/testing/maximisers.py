"""The contract of a maximiser: reproducible, at home in any box, unharmed by values that are no numbers, honest."""

from __future__ import annotations

import random
import time
from collections.abc import Callable

import numpy as np

from sparserob_core.sip.convex_set import Array, Box
from sparserob_core.sip.maximiser import EvaluationError, Maximiser, Report
from sparserob_core.sip.search.search import Target, maximise
from sparserob_core.testing.contract import Contract, broken, demand

PLANE = Box(np.array([-3.0, -2.0]), np.array([2.0, 4.0]))
ODD_BOXES = (
    ([0.1], [0.3]),
    ([-1e6, 0.1, 3.0], [1e6, 0.3, 3.0]),
    ([0.7, 0.7], [0.7, 0.7]),
    ([1.0], [1.0 + 1e-12]),
    ([-1e-9] * 3, [1e-9] * 3),
)
FIRST_POINT = 0.25
"""Seconds until a search has to ask for its first value, the best of `MEASURED_STARTS`, for a method begins one in
every iteration: ten times as long would let a second pass, and a tenth is what a loaded machine takes now and then."""

MEASURED_STARTS = 3  # whose best counts, since a loaded machine delays one


def slope(points: Array) -> Array:
    """Rises with every coordinate; the maximum is a corner."""
    return np.asarray(points.sum(axis=1), dtype=float)


def ripples(points: Array) -> Array:
    """Many maxima; smooth."""
    return np.asarray(
        (np.sin(3 * points) * np.cos(points + 0.4)).sum(axis=1) - 0.01 * (points**2).sum(axis=1), dtype=float
    )


def bowl(points: Array) -> Array:
    """Evaluate a concave function with a single maximum, 0 where every coordinate is 0.3."""
    return np.asarray(-((points - 0.3) ** 2).sum(axis=1), dtype=float)


def level(points: Array) -> Array:
    """2 everywhere."""
    return np.full(len(points), 2.0)


def spike(points: Array) -> Array:
    """1 in a tiny ball around 0.3, which hardly any search finds, and 0 elsewhere."""
    return np.asarray(np.abs(points - 0.3).max(axis=1) < 1e-3, dtype=float)


def nowhere(points: Array) -> Array:
    """Return NaN at every point."""
    return np.full(len(points), np.nan)


def half_undefined(points: Array) -> Array:
    """`bowl` where the first coordinate is not negative, ``-inf`` where it is."""
    return np.where(points[:, 0] < 0, -np.inf, bowl(points))


def unbounded(points: Array) -> Array:
    """``+inf`` in a large part of the box."""
    return np.where(points[:, 0] > 0.2, np.inf, bowl(points))


class _CountedFunction:
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


class MaximiserContract(Contract[Maximiser], kind="maximiser"):
    """Contract of a maximiser: subclass it in a test module as ``class TestMine(MaximiserContract)`` and give
    ``component``.

    The core keeps the accounts (domain, budget, best point). The contract checks that a maximiser works with them:
    reproducible in a fresh process, at home in any box, unharmed by values that are no numbers, and honest in its upper
    bound. It may spend its whole budget in one call. The largest box has 1200 coordinates (400 indices of 3); the
    budget there is 50 evaluations.
    """

    def search(
        self, function: Callable[[Array], object], domain: Box = PLANE, budget: int = 60, seed: int = 0
    ) -> Report:
        """Run a new maximiser."""
        return maximise(Target(function, domain), self.create(), budget, np.random.default_rng(seed))

    def test_the_same_seed_gives_the_same_points(self) -> None:
        maximiser = self.create()
        first, second = (maximise(Target(ripples, PLANE), maximiser, 60, np.random.default_rng(3)) for _ in range(2))
        demand(
            first.trace.points.tolist() == second.trace.points.tolist(),
            "one maximiser used twice with the same seed evaluates other points the second time",
            "keep nothing of a search in `self`, and draw random numbers from the `rng` of `search` only",
        )
        demand(
            first.trace.points.tolist() == self.search(ripples, seed=3).trace.points.tolist(),
            "two new maximisers with the same seed evaluate other points",
            "draw random numbers from the `rng` of `search` only, and let no clock decide what is evaluated",
        )

    def test_the_same_seed_gives_the_same_points_in_a_fresh_process(self) -> None:
        from concurrent.futures import ProcessPoolExecutor
        from multiprocessing import get_context

        with ProcessPoolExecutor(1, mp_context=get_context("spawn")) as fresh:
            result = fresh.submit(
                maximise, Target(ripples, PLANE), self.create(), 60, np.random.default_rng(3)
            ).result()
        demand(
            result.trace.points.tolist() == self.search(ripples, seed=3).trace.points.tolist(),
            "the same seed gives other points in another process",
            "let nothing depend on `hash` of a text, on `id`, or on the order of a set",
        )

    def test_random_numbers_of_others_are_left_alone(self) -> None:
        shared, own = np.random.get_state(legacy=False), random.getstate()  # noqa: NPY002
        self.search(ripples)
        after = np.random.get_state(legacy=False)  # noqa: NPY002
        demand(
            str(shared) == str(after) and own == random.getstate(),
            "the search draws from, or seeds, the random numbers of the whole process (np.random or random)",
            "use the `rng` of `search`; a library that wants a seed of its own gets `int(rng.integers(2**31))`",
        )

    def test_every_point_lies_in_the_box_however_odd_the_box(self) -> None:
        for lower, upper in ODD_BOXES:
            report = self.search(ripples, Box(np.array(lower), np.array(upper)))
            demand(
                report.evaluations >= 1,
                f"nothing is evaluated in the box from {lower} to {upper}",
                "evaluate at least one point of any box, however thin",
            )
            demand(
                (report.trace.points >= lower).all() and (report.trace.points <= upper).all(),
                f"a point lies outside of the box from {lower} to {upper}",
                "end with `np.clip(points, domain.lower, domain.upper)`: rounding alone may leave a box",
            )

    def test_a_coordinate_with_a_single_value_changes_nothing(self) -> None:
        box = Box(np.insert(PLANE.lower, 1, 7.0), np.insert(PLANE.upper, 1, 7.0))
        wide, plain = self.search(lambda points: ripples(points[:, [0, 2]]), box), self.search(ripples)
        demand(
            wide.trace.points[:, [0, 2]].tolist() == plain.trace.points.tolist(),
            "a coordinate that cannot move, which the maximiser is not even shown, changes the search",
            "take everything from `objective.domain` and `rng`; look at nothing else",
        )

    def test_the_box_is_left_as_it_was(self) -> None:
        domain = Box(PLANE.lower.copy(), PLANE.upper.copy())
        self.search(ripples, domain)
        demand(
            domain.lower.tolist() == PLANE.lower.tolist() and domain.upper.tolist() == PLANE.upper.tolist(),
            "the maximiser has written into `objective.domain`",
            "copy `domain.lower` and `domain.upper` before changing them",
        )

    def test_the_budget_is_never_exceeded(self) -> None:
        for budget in (1, 2, 7, 100):
            for function in (ripples, nowhere, half_undefined):
                counted = _CountedFunction(function)
                report = self.search(counted, budget=budget)
                demand(
                    report.evaluations == counted.calls <= budget,
                    f"{counted.calls} evaluations were made with a budget of {budget}",
                    "call nothing but `objective.evaluate` and `objective.value_and_gradient`",
                )

    def test_a_function_without_any_value_is_survived(self) -> None:
        report = self.search(nowhere)
        demand(
            report.best_value == -np.inf and report.evaluations >= 1,
            f"a function that is nowhere defined gives the best value {report.best_value}",
            "values may be -inf everywhere: then search on, or return",
        )

    def test_a_function_undefined_on_half_of_the_box_is_still_maximised(self) -> None:
        report = self.search(half_undefined, budget=400)
        demand(
            -0.5 <= report.best_value <= 0.0,
            f"where half of the values are -inf, 400 evaluations reach {report.best_value:.3g}; the maximum is 0",
            "treat -inf as a value worse than all others: no mean, slope or model may be made of it",
        )

    def test_a_function_that_raises_ends_the_search_and_keeps_what_was_found(self) -> None:
        counted = _CountedFunction(bowl, fails_after=20, failure=ArithmeticError("no value here"))
        try:
            self.search(counted)
        except EvaluationError as error:
            demand(
                "no value here" in str(error) and error.report.best_value == counted.best,
                "what was found before the function failed is lost",
                "let every exception of `objective.evaluate` pass through `search`",
            )
            demand(
                counted.failures == 1,
                f"the function was called again after it had failed ({counted.failures} times)",
                "let every exception of `objective.evaluate` pass through `search`; catch none of them",
            )
        else:
            broken("the failure of the function was swallowed", "catch no exception of `objective.evaluate`")

    def test_an_interrupt_ends_the_search_and_keeps_what_was_found(self) -> None:
        counted = _CountedFunction(bowl, fails_after=20, failure=KeyboardInterrupt())
        report = self.search(counted)
        demand(
            report.interrupted and counted.failures == 1,
            "Ctrl-C does not end the search",
            "catch neither KeyboardInterrupt nor BaseException around `objective.evaluate`",
        )
        demand(
            report.best_value == counted.best,
            "what was found before Ctrl-C is lost",
            "let the interrupt pass through `search`",
        )

    def test_an_infinite_value_ends_the_search(self) -> None:
        """Check that the call which meets the infinite value, perhaps among many points, is the last call."""
        has_infinity: list[bool] = []

        def watched(points: Array) -> Array:
            values = unbounded(points)
            has_infinity.append(bool(np.isposinf(values).any()))
            return values

        best = self.search(watched, budget=400).best_value
        demand(
            best == np.inf,
            f"the value is +inf on a third of the box, and 400 evaluations find {best:.3g}",
            "spread some of the points over the whole box",
        )
        demand(
            has_infinity.index(True) == len(has_infinity) - 1,
            "the search went on after +inf",
            "let `SearchEnded` pass: `objective.evaluate` raises it once nothing is left to gain",
        )

    def test_an_upper_bound_is_never_below_the_maximum(self) -> None:
        for function, maximum in ((bowl, 0.0), (level, 2.0), (spike, 1.0)):
            for budget in (1, 10, 200):
                bound = self.search(function, budget=budget).upper_bound
                demand(
                    bound >= maximum,
                    f"after {budget} evaluations the maximiser claims that {function.__name__} is at most {bound:.6g} "
                    f"in the whole box; its maximum is {maximum:g}",
                    "return `float('inf')` unless the bound is proven for every function that takes these values",
                )

    def test_a_function_evaluated_in_batches_or_point_by_point_gives_the_same_search(self) -> None:
        pointwise_result = self.search(lambda points: np.concatenate([ripples(point[np.newaxis]) for point in points]))
        batch_result = self.search(ripples)
        demand(
            pointwise_result.trace.points.tolist() == batch_result.trace.points.tolist()
            and pointwise_result.trace.values.tolist() == batch_result.trace.values.tolist(),
            "the search depends on how its function computes a batch",
            "take the values of `objective.evaluate` as they are; let no clock decide what is evaluated",
        )

    def test_a_gradient_may_be_used_and_costs_what_it_says(self) -> None:
        counted = _CountedFunction(bowl)
        target = Target(counted, PLANE, gradient=lambda point: -2.0 * (point - 0.3))
        report = maximise(target, self.create(), 60, np.random.default_rng(0))
        demand(
            report.evaluations == counted.calls <= 60,
            f"{counted.calls} evaluations were made with a budget of 60 where a gradient is offered",
            "take gradients from `objective.value_and_gradient` only",
        )
        demand(
            report.best_value >= -10.0,
            f"with a gradient the search is worse than without one: {report.best_value:.3g} of a maximum of 0",
            "the gradient points uphill: go along it, not against it, and stay in the box",
        )

    def test_it_goes_up_rather_than_down(self) -> None:
        up = self.search(slope, budget=200).trace.values
        down = -self.search(lambda points: -slope(points), budget=200).trace.values
        demand(
            up.mean() >= down.mean(),
            f"on a slope it looks at lower points, of mean {up.mean():.3g}, than on the slope turned round, of mean "
            f"{down.mean():.3g}: it minimises",
            "values are maximised: a larger one is the better one; a library that minimises gets `-values`",
        )

    def test_the_first_point_comes_at_once(self) -> None:
        delays: list[float] = []
        while len(delays) < MEASURED_STARTS and min(delays, default=np.inf) > FIRST_POINT:
            delays.append(self.delay())
        demand(
            min(delays) <= FIRST_POINT,
            f"{min(delays):.2f} s go by before the first value is asked for",
            "a search is begun anew in every iteration of a method: load what is slow once, and model nothing before "
            "there are values",
        )

    def delay(self) -> float:
        """Seconds of one search until the first value is asked for."""
        first: list[float] = []

        def timed(points: Array) -> Array:
            first.append(time.perf_counter())
            return bowl(points)

        maximiser, start = self.create(), time.perf_counter()
        maximise(Target(timed, PLANE), maximiser, 1, np.random.default_rng(0))
        return first[0] - start

    def test_a_tuple_of_many_indices_is_searched_within_the_budget(self) -> None:
        count, width = 400, 3
        domain = Box(np.tile(PLANE.lower[:1], count * width), np.tile(PLANE.upper[1:], count * width))
        report = maximise(Target(bowl, domain, block=width), self.create(), 50, np.random.default_rng(0))
        demand(
            1 <= report.evaluations <= 50 and report.best_value > -np.inf,
            f"in a box of {count * width} coordinates {report.evaluations} of 50 evaluations were made",
            "a tuple of 400 indices has 1200 coordinates: use a cheaper model, or none, in so large a box",
        )

    def test_a_smooth_hill_is_climbed_at_least_part_of_the_way(self) -> None:
        best = self.search(bowl, budget=500).best_value
        demand(
            best >= -0.5,
            f"500 evaluations of a smooth hill in the plane reach {best:.3g}; its top is 0, random points reach -0.1",
            "look at the whole box, and near the best point",
        )
