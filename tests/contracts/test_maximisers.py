"""Guards sparserob_core.testing and every registered component: every registered maximiser keeps the contract, and the
contract is worth keeping: maximisers that are bad on purpose fail it."""

from __future__ import annotations

import time
from typing import ClassVar

import numpy as np
import pytest

import sparserob_core as sr
from sparserob_core.testing import MaximiserContract
from tests.support.faults import fails

REGISTRY = sr.load_registry()
NAMES = REGISTRY.names("maximiser")


def test_there_are_maximisers_to_be_tested():
    assert {"random_search", "direct"} <= set(NAMES)


@pytest.mark.parametrize("name", NAMES)
class TestRegisteredMaximiser(MaximiserContract):
    @pytest.fixture(autouse=True)
    def named(self, name):
        self.name = name

    def create(self):
        return REGISTRY.build("maximiser", self.name)

    @pytest.mark.slow  # a process each; that the contract looks is tested below, on one that fails it
    def test_the_same_seed_gives_the_same_points_in_a_fresh_process(self):
        super().test_the_same_seed_gives_the_same_points_in_a_fresh_process()


class Uniform(sr.Maximiser):
    """An honest maximiser, for its flawed relatives to inherit from."""

    def points(self, objective, rng):
        domain = objective.domain
        return np.clip(
            domain.lower + rng.random((1, domain.dimension)) * (domain.upper - domain.lower), domain.lower, domain.upper
        )

    def search(self, objective, rng):
        while objective.remaining:
            objective.evaluate(self.points(objective, rng))
        return np.inf


@pytest.mark.slow
class TestAnHonestMaximiser(MaximiserContract):
    component = Uniform


class Unseeded(Uniform):
    def search(self, objective, rng):
        return super().search(objective, np.random.default_rng(time.perf_counter_ns()))


class Remembering(Uniform):
    def __init__(self):
        self.rng = np.random.default_rng(0)

    def search(self, objective, rng):
        return super().search(objective, self.rng)


class SeededByHash(Uniform):
    def search(self, objective, rng):
        return super().search(objective, np.random.default_rng(abs(hash("a string's hash differs in every process"))))


class Leaving(Uniform):
    def points(self, objective, rng):
        domain = objective.domain
        return domain.lower + 1.05 * rng.random((1, domain.dimension)) * (domain.upper - domain.lower)


class Overclaiming(Uniform):
    def search(self, objective, rng):
        super().search(objective, rng)
        return objective.best_value


class Fragile(Uniform):
    def search(self, objective, rng):
        while objective.remaining:
            if not np.isfinite(objective.evaluate(self.points(objective, rng))).all():
                raise ZeroDivisionError("cannot rank what is no number")
        return np.inf


class Deaf(Uniform):
    """Swallows everything, and goes on."""

    def search(self, objective, rng):
        for _ in range(objective.budget + 5):
            try:
                objective.evaluate(self.points(objective, rng))
            except BaseException:  # noqa: BLE001
                continue
        return np.inf


class Widening(Uniform):
    def search(self, objective, rng):
        objective.domain.lower[:] -= 1.0
        return super().search(objective, rng)


class Idle(Uniform):
    def search(self, objective, rng):
        objective.evaluate(objective.domain.lower[np.newaxis])
        return np.inf


class Seeding(Uniform):
    """Makes itself reproducible at the cost of everybody else's random numbers."""

    def search(self, objective, rng):
        np.random.seed(1)  # noqa: NPY002
        return super().search(objective, rng)


class LowerHalf(Uniform):
    def points(self, objective, rng):
        return (super().points(objective, rng) + objective.domain.lower) / 2


class LeftHalf(Uniform):
    def points(self, objective, rng):
        points = super().points(objective, rng)
        points[:, 0] = np.minimum(points[:, 0], 0.0)
        return np.maximum(points, objective.domain.lower)


class Refusing(Uniform):
    """Builds a model of all coordinates, and cannot where they are many."""

    def search(self, objective, rng):
        if objective.domain.dimension > 500:
            return np.inf
        return super().search(objective, rng)


class Hopeful(Uniform):
    """Claims that nothing is much better than the best point so far."""

    def search(self, objective, rng):
        for _ in range(objective.remaining):
            objective.evaluate(self.points(objective, rng))
        return objective.best_value + 0.1


class Wordless(Uniform):
    def search(self, objective, rng):
        super().search(objective, rng)


class Lazy(Uniform):
    """Sees nothing to do in a thin box."""

    def search(self, objective, rng):
        if (objective.domain.upper - objective.domain.lower).max() < 1e-6:
            return np.inf
        return super().search(objective, rng)


class Steepest(Uniform):
    """Takes it for granted that there is a gradient."""

    def search(self, objective, rng):
        while objective.remaining:
            objective.value_and_gradient(self.points(objective, rng)[0])
        return np.inf


class Swallowing(Uniform):
    """Takes the end of the search for a bad point."""

    def search(self, objective, rng):
        while objective.remaining:
            try:
                objective.evaluate(self.points(objective, rng))
            except Exception:  # noqa: BLE001
                continue
        return np.inf


class Clocked(Uniform):
    """Spends a time, not a budget."""

    def search(self, objective, rng):
        rng = np.random.default_rng(int(1e6 * time.perf_counter()) % 1000)
        return super().search(objective, rng)


class Minimising(Uniform):
    """Walks downhill from the middle: on a small box even that comes near to a top."""

    def search(self, objective, rng):
        lower, upper = objective.domain.lower, objective.domain.upper
        point, value = (lower + upper) / 2, np.inf
        while objective.remaining:
            step = np.clip(point + 0.3 * rng.normal(size=len(lower)) * (upper - lower), lower, upper)
            reached = float(objective.evaluate(step[np.newaxis])[0])
            if reached <= value:
                point, value = step, reached
        return np.inf


class Late(Uniform):
    """Thinks for a while before its first point."""

    def search(self, objective, rng):
        time.sleep(0.3)
        return super().search(objective, rng)


FAULTS = {
    Minimising: "test_it_goes_up_rather_than_down",
    Late: "test_the_first_point_comes_at_once",
    Unseeded: "test_the_same_seed_gives_the_same_points",
    Remembering: "test_the_same_seed_gives_the_same_points",
    Clocked: "test_the_same_seed_gives_the_same_points",
    SeededByHash: "test_the_same_seed_gives_the_same_points_in_a_fresh_process",
    Seeding: "test_random_numbers_of_others_are_left_alone",
    Leaving: "test_every_point_lies_in_the_box_however_odd_the_box",
    Lazy: "test_every_point_lies_in_the_box_however_odd_the_box",
    Overclaiming: "test_an_upper_bound_is_never_below_the_maximum",
    Hopeful: "test_an_upper_bound_is_never_below_the_maximum",
    Wordless: "test_a_smooth_hill_is_climbed_at_least_part_of_the_way",
    Fragile: "test_a_function_undefined_on_half_of_the_box_is_still_maximised",
    Steepest: "test_a_function_without_any_value_is_survived",
    Deaf: "test_an_interrupt_ends_the_search_and_keeps_what_was_found",
    Widening: "test_the_box_is_left_as_it_was",
    Idle: "test_a_smooth_hill_is_climbed_at_least_part_of_the_way",
    LeftHalf: "test_an_infinite_value_ends_the_search",
    LowerHalf: "test_a_smooth_hill_is_climbed_at_least_part_of_the_way",
    Refusing: "test_a_tuple_of_many_indices_is_searched_within_the_budget",
}


class TestAMaximiserThatTakesTheEndForABadPoint(MaximiserContract):
    """It cannot do any harm, for after the end there is nothing left to evaluate."""

    component = Swallowing
    test_the_same_seed_gives_the_same_points_in_a_fresh_process = None  # seconds, for what is tested above


@pytest.mark.parametrize(("flawed", "test"), FAULTS.items(), ids=[one.__name__ for one in FAULTS])
def test_the_contract_catches_a_maximiser_that_is_bad_on_purpose(flawed, test):
    fails(MaximiserContract, flawed, test)


def test_no_maximiser_can_exceed_the_budget_even_if_it_swallows_every_exception():
    class Trial(MaximiserContract):
        component = Deaf

    Trial().test_the_budget_is_never_exceeded()


class OnePass(sr.Maximiser):
    """An honest maximiser that spends its budget in one call."""

    def search(self, objective, rng):
        box = objective.domain
        spread = rng.random((objective.remaining, box.dimension)) * (box.upper - box.lower)
        objective.evaluate(np.clip(box.lower + spread, box.lower, box.upper))
        return np.inf


class TestAMaximiserThatSpendsItsBudgetInOneCall(MaximiserContract):
    component = OnePass
    test_the_same_seed_gives_the_same_points_in_a_fresh_process = None  # seconds, for what is tested above


@pytest.mark.parametrize(
    ("component", "words"),
    [
        (None, "expected the attribute `component`: the class of the maximiser"),
        (Uniform(), "expected the attribute `component`"),
        (lambda self: Uniform(), r"\(a method is called `create`\)"),
        (pytest.fixture(lambda: None), "expected the attribute `component`"),
        (dict, "gave {}, expected a Maximiser"),
        ("no_such", "no maximiser is named 'no_such'"),
    ],
)
def test_a_contract_without_a_component_says_what_it_needs(component, words):
    trial = type("Trial", (MaximiserContract,), {"component": component})
    with pytest.raises((TypeError, sr.UnknownPluginError), match=words):
        trial().create()


def test_a_component_may_be_named_as_in_a_config():
    class Trial(MaximiserContract):
        component: ClassVar = {"name": "nevergrad", "optimiser": "OnePlusOne"}

    assert Trial().create().optimiser == "OnePlusOne"


class Mute(sr.Maximiser, sr.Options):
    tries: int = 3

    def search(self, objective, rng):
        return np.inf


def test_options_without_documentation_are_named():
    error = fails(MaximiserContract, Mute, "test_every_option_is_documented")
    assert "options of Mute have no documentation: tries" in str(error)
