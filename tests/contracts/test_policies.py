"""Guards sparserob_core/testing/policies and every registered policy: each keeps the contract, and policies that are
wrong on purpose fail it."""

from __future__ import annotations

import itertools

import numpy as np
import pytest

import sparserob_core as sr
from sparserob_core.testing import PolicyContract
from tests.support.faults import fails

REGISTRY = sr.load_registry()
NAMES = REGISTRY.names("policy")


def test_there_are_policies_to_be_tested():
    assert "open_loop" in NAMES


@pytest.mark.parametrize("name", NAMES)
class TestRegisteredPolicy(PolicyContract):
    @pytest.fixture(autouse=True)
    def named(self, name):
        self.name = name

    def create(self):
        return REGISTRY.build("policy", self.name)


class Measured(sr.Policy, sr.Options):
    """A right policy, for wrong ones to inherit from: the state is measured, and answered at once."""

    @property
    def knows(self):
        return frozenset({"state"})

    def answers(self, breakpoints):
        return np.eye(len(breakpoints) - 1, dtype=bool)


class TestMeasured(PolicyContract):
    component = Measured


class Clairvoyant(Measured):
    @property
    def knows(self):
        return frozenset({"state", "future disturbance"})


class Misspelt(Measured):
    @property
    def knows(self):
        return frozenset({"states"})


class OpenSet(Measured):
    @property
    def knows(self):
        return {"state"}


class Listed(Measured):
    @property
    def knows(self):
        return ["state"]


class Text(Measured):
    @property
    def knows(self):
        return "state"


class Nothing(Measured):
    @property
    def knows(self):
        return None


class Failing(Measured):
    @property
    def knows(self):
        return self.measured


class Asked(Measured):
    """Forgets that it is a property."""

    def knows(self):
        return frozenset()


class Learning(Measured):
    """Knows more the longer it lives."""

    @property
    def knows(self):
        COUNT.append(1)
        return frozenset({"state"} if len(COUNT) % 3 else {"state", "parameters"})


COUNT: list[int] = []


class Fickle(Measured):
    @property
    def knows(self):
        return frozenset({"state"} if next(TURN) else {"disturbance"})


TURN = itertools.cycle([True, True, False])


class Surrounded(Measured):
    """A copy of it elsewhere knows something else."""

    def __reduce__(self):
        return OtherProcess, ()

    @property
    def knows(self):
        return frozenset({"state"})


class OtherProcess(Measured):
    @property
    def knows(self):
        return frozenset({"parameters"})


class Counting(sr.Policy):
    def __init__(self):
        self.asked = 0

    @property
    def knows(self):
        self.asked += 1
        return frozenset()


class Unique(sr.Policy):
    """Has no options, and is equal to nobody."""

    @property
    def knows(self):
        return frozenset()


class Unpicklable(sr.Policy):
    def __init__(self):
        self.sensor = lambda: frozenset({"state"})

    @property
    def knows(self):
        return self.sensor()


class Silent(sr.Policy, sr.Options):
    """Knows the state, and does not say what it answers."""

    @property
    def knows(self):
        return frozenset({"state"})


class Prophetic(Measured):
    def answers(self, breakpoints):
        return np.eye(len(breakpoints) - 1, k=1, dtype=bool) | super().answers(breakpoints)


class Counted(Measured):
    """Numbers where truth values belong."""

    def answers(self, breakpoints):
        return np.eye(len(breakpoints) - 1)


class TooLarge(Measured):
    """A row for every breakpoint, the last one too."""

    def answers(self, breakpoints):
        return np.eye(len(breakpoints), dtype=bool)


class Unknowing(Measured):
    """Answers a state that it does not know."""

    @property
    def knows(self):
        return frozenset({"parameters"})


class Nameless(Measured):
    """Fails on one piece."""

    def answers(self, breakpoints):
        return super().answers(breakpoints)[breakpoints[:-1] <= breakpoints[2]]


class Changing(Measured):
    def answers(self, breakpoints):
        return super().answers(breakpoints) & bool(next(ANSWERED))


ANSWERED = itertools.cycle([True, True, True, False])


class Free(Measured):
    """Is charged nothing that there is."""

    @property
    def charge(self):
        return "peak"


class Cheap(Measured):
    @property
    def charge(self):
        return sr.Charge(cost="cheap")


ANSWERS = "test_it_answers_what_is_measured_by_then_and_nothing_else"
PAST = "test_it_knows_past_values_of_named_quantities_only"
CONSTANT = "test_what_it_knows_never_changes"
FAULTS = {
    Clairvoyant: PAST,
    Misspelt: PAST,
    OpenSet: PAST,
    Listed: PAST,
    Text: PAST,
    Nothing: PAST,
    Failing: PAST,
    Asked: PAST,
    Learning: CONSTANT,
    Fickle: CONSTANT,
    Counting: "test_reading_what_it_knows_changes_nothing_about_it",
    Surrounded: "test_a_copy_in_another_process_knows_the_same",
    Unpicklable: "test_a_copy_in_another_process_knows_the_same",
    Silent: ANSWERS,
    Prophetic: ANSWERS,
    Counted: ANSWERS,
    TooLarge: ANSWERS,
    Unknowing: ANSWERS,
    Nameless: ANSWERS,
    Changing: "test_what_it_answers_depends_on_its_options_and_the_breakpoints_alone",
    Free: "test_its_charge_is_a_cost_that_is_known",
    Cheap: "test_its_charge_is_a_cost_that_is_known",
    Unique: "test_its_options_are_what_it_depends_on",
}


@pytest.mark.parametrize(("flawed", "test"), FAULTS.items(), ids=[one.__name__ for one in FAULTS])
def test_the_contract_catches_a_policy_that_is_wrong_on_purpose(flawed, test):
    error = fails(PolicyContract, flawed, test)
    if flawed is Clairvoyant:
        assert "future disturbance, which no control can know" in str(error)
