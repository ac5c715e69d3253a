"""Guards sparserob_core.testing and every registered component: every registered maximiser keeps the contract, and the
contract is worth keeping: maximisers that are bad on purpose fail it."""

from __future__ import annotations

import time

import numpy as np
import pytest

import sparserob_core as sr
from sparserob_core.testing import MaximiserContract

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


class TestAnHonestMaximiser(MaximiserContract):
    def create(self):
        return Uniform()


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


CAUGHT = {
    Unseeded: "test_the_same_seed_gives_the_same_points",
    Remembering: "test_the_same_seed_gives_the_same_points",
    SeededByHash: "test_the_same_seed_gives_the_same_points_in_a_fresh_process",
    Leaving: "test_every_point_lies_in_the_box_however_odd_the_box",
    Overclaiming: "test_an_upper_bound_is_never_below_the_maximum",
    Fragile: "test_a_function_undefined_on_half_of_the_box_is_still_maximised",
    Deaf: "test_an_interrupt_ends_the_search_and_keeps_what_was_found",
    Widening: "test_the_box_is_left_as_it_was",
    Idle: "test_a_smooth_hill_is_climbed_at_least_part_of_the_way",
}


@pytest.mark.parametrize(("flawed", "test"), CAUGHT.items(), ids=lambda value: getattr(value, "__name__", ""))
def test_the_contract_catches_a_maximiser_that_is_bad_on_purpose(flawed, test):
    class Trial(MaximiserContract):
        def create(self):
            return flawed()

    with pytest.raises((AssertionError, sr.PluginError)):
        getattr(Trial(), test)()


def test_no_maximiser_can_exceed_the_budget_even_if_it_swallows_every_exception():
    class Trial(MaximiserContract):
        def create(self):
            return Deaf()

    Trial().test_the_budget_is_never_exceeded()
