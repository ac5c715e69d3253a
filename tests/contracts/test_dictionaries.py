"""Guards sparserob_core/testing/dictionaries and every registered dictionary: each keeps the contract, and dictionaries
that are wrong on purpose fail it."""

from __future__ import annotations

import itertools
import time

import numpy as np
import pytest

import sparserob_core as sr
from sparserob_core.testing import DictionaryContract
from tests.support.faults import fails

REGISTRY = sr.load_registry()
NAMES = REGISTRY.names("dictionary")


def test_there_are_dictionaries_to_be_tested():
    assert {"piecewise_constant", "haar", "walsh"} <= set(NAMES)


@pytest.mark.parametrize("name", NAMES)
class TestRegisteredDictionary(DictionaryContract):
    @pytest.fixture(autouse=True)
    def named(self, name):
        self.name = name

    def create(self):
        return REGISTRY.build("dictionary", self.name)


class Thirds(sr.DictionaryFactory):
    """A right dictionary, for wrong ones to inherit from: three pieces, a constant and two steps."""

    values = np.array([[1.0, 1.0, 1.0], [1.0, -1.0, 0.0], [0.0, 1.0, -1.0]])

    def times(self, horizon):
        return horizon * np.array([0.0, 0.4, 0.7, 1.0])

    def build(self, horizon):
        return sr.Dictionary(self.times(horizon), self.values)


class TestThirds(DictionaryContract):
    component = Thirds


def unchecked(breakpoints, values):
    """A dictionary that was never checked."""
    made = object.__new__(sr.Dictionary)
    object.__setattr__(made, "breakpoints", np.asarray(breakpoints, dtype=float))
    object.__setattr__(made, "values", np.asarray(values, dtype=float))
    return made


class UnitHorizon(Thirds):
    def times(self, horizon):
        return super().times(1.0)


class TooShort(Thirds):
    def times(self, horizon):
        return 0.9 * super().times(horizon)


class Rounded(Thirds):
    """Adds up its pieces, and misses the end by rounding."""

    def times(self, horizon):
        return np.concatenate([[0.0], np.cumsum(np.full(3, horizon / 3.0 * (1 + 1e-15)))])


class Late(Thirds):
    def build(self, horizon):
        return unchecked(np.maximum(self.times(horizon), 0.1 * horizon), self.values)


class Dependent(Thirds):
    values = np.array([[1.0, 1.0, 1.0], [1.0, -1.0, 0.0], [2.0, 0.0, 1.0]])


class DependentUnchecked(Dependent):
    def build(self, horizon):
        return unchecked(self.times(horizon), self.values)


class NearlyDependent(Thirds):
    values = np.array([[1.0, 1.0, 1.0], [1.0, -1.0, 0.0], [2.0, 0.0, 1.0 + 1e-8]])


class WithZero(Thirds):
    def build(self, horizon):
        return unchecked(self.times(horizon), self.values * [[1], [1], [0]])


class Huge(Thirds):
    values = 1e9 * Thirds.values


class Uneven(Thirds):
    """Functions of very different sizes."""

    values = Thirds.values * [[1.0], [1.0], [1e-8]]


class Sliver(Thirds):
    def times(self, horizon):
        return horizon * np.array([0.0, 0.4, 0.4 + 1e-13, 1.0])


class Remembering(Thirds):
    first = None

    def times(self, horizon):
        self.first = self.first or horizon
        return super().times(horizon) * [0, self.first / max(self.first, horizon), 1, 1]


class Clocked(Thirds):
    def times(self, horizon):
        return horizon * np.array([0.0, 0.1 + 0.2 * (time.perf_counter_ns() % 997) / 997, 0.7, 1.0])


class Growing(Thirds):
    counter = itertools.count(2)

    def build(self, horizon):
        pieces = next(self.counter)
        return sr.Dictionary(np.linspace(0.0, horizon, pieces + 1), np.eye(pieces))


class Sharing(Thirds):
    """Hands out the same arrays again and again."""

    made: dict = {}  # noqa: RUF012

    def build(self, horizon):
        return self.made.setdefault(horizon, super().build(horizon))


class Pair(Thirds):
    def build(self, horizon):
        return self.times(horizon), self.values


class Choosy(Thirds):
    def build(self, horizon):
        if horizon < 0.5:
            raise ValueError("too short for me")
        return super().build(horizon)


class Overflowing(Thirds):
    def build(self, horizon):
        return [1, 2, 3][int(horizon > 1e8) * 5] and super().build(horizon)


END = "test_it_covers_the_horizon_from_end_to_end"
INDEPENDENT = "test_its_functions_are_linearly_independent"
SAME = "test_the_same_horizon_gives_the_same_dictionary_whatever_was_built_before"
FAULTS = {
    UnitHorizon: END,
    TooShort: END,
    Rounded: END,
    Late: END,
    Pair: END,
    Choosy: END,
    Dependent: INDEPENDENT,
    DependentUnchecked: INDEPENDENT,
    NearlyDependent: INDEPENDENT,
    WithZero: INDEPENDENT,
    Huge: "test_its_values_are_numbers_of_ordinary_size",
    Uneven: "test_its_values_are_numbers_of_ordinary_size",
    Sliver: "test_breakpoints_increase_by_lengths_that_count",
    Remembering: SAME,
    Clocked: SAME,
    Growing: SAME,
    Sharing: "test_one_dictionary_may_be_changed_without_changing_the_next",
    Overflowing: "test_a_horizon_that_makes_no_sense_is_an_input_error_or_is_built",
}


@pytest.mark.parametrize(("flawed", "test"), FAULTS.items(), ids=[one.__name__ for one in FAULTS])
def test_the_contract_catches_a_dictionary_that_is_wrong_on_purpose(flawed, test):
    fails(DictionaryContract, flawed, test)


def test_a_control_that_is_written_wrongly_is_caught():
    class Mirrored(Thirds):
        def build(self, horizon):
            made = super().build(horizon)
            object.__setattr__(made, "values", -made.values)
            made.__dict__["is_indicators"] = True
            return made

    fails(DictionaryContract, Mirrored, "test_a_control_can_be_written_in_it")
