"""Guards sparserob_core.testing as a whole: a component of any kind that prints is caught by the contract of its kind,
and every kind has its table of components that are wrong on purpose."""

from __future__ import annotations

from contextlib import redirect_stdout
from io import StringIO

import numpy as np
import pytest

import sparserob_core as sr
import sparserob_core.testing as contracts
from sparserob_core.experiment.plugins.records import RECORDS
from sparserob_core.experiment.scaffold.new_plugin import kinds
from tests.contracts import (
    test_commands,
    test_dictionaries,
    test_executors,
    test_maximisers,
    test_methods,
    test_observers,
    test_policies,
    test_problems,
    test_regularisers,
    test_rules,
    test_sets,
    test_solvers,
)
from tests.support.faults import fails


def loud(honest, method):
    """A component as honest as another that prints whenever it is asked."""

    def printing(self, *arguments):
        print("here I am")
        return getattr(honest, method)(self, *arguments)

    return type("Loud", (honest,), {method: printing})


def loud_command():
    print("here I am")
    return test_commands.honest()


class LoudPolicy(test_policies.Measured):
    @property
    def knows(self):
        print("here I am")
        return super().knows


class Honest(test_solvers.Distorted):
    def distort(self, program, claim):
        return claim


class Half(sr.Schedule):
    def __call__(self, epsilon, j):
        return epsilon / 2


class Settled(sr.OuterStop):
    def __call__(self, steps):
        return test_rules.settled(steps)


class Stale(sr.InnerStop):
    def __call__(self, progress):
        return test_rules.stale(progress)


class Metropolis(sr.Selection):
    def __call__(self, now, then, heat, rng):
        return test_rules.metropolis(now, then, heat, rng)


PRINTING = {
    "problem": (loud(test_problems.Square, "build"), test_problems.SHAPES),
    "set": (loud(test_sets.Disc, "support"), "test_the_support_function_is_sublinear"),
    "policy": (LoudPolicy, test_policies.PAST),
    "method": (loud(test_methods.Exchanging, "solve"), "test_the_program_is_left_as_it_was"),
    "dictionary": (loud(test_dictionaries.Thirds, "build"), test_dictionaries.END),
    "regulariser": (loud(test_regularisers.Energy, "quadratic"), test_regularisers.CONVEX),
    "solver": (loud(Honest, "solve"), "test_the_program_is_left_as_it_was"),
    "maximiser": (loud(test_maximisers.Uniform, "search"), "test_the_box_is_left_as_it_was"),
    "schedule": (loud(Half, "__call__"), test_rules.POSITIVE),
    "outer_stop": (loud(Settled, "__call__"), test_rules.STEPS),
    "inner_stop": (loud(Stale, "__call__"), test_rules.ANSWER),
    "selection": (loud(Metropolis, "__call__"), test_rules.ODD),
    "executor": (loud(test_executors.Bad, "open"), test_executors.ORDER),
    "command": (loud_command, test_commands.HELP),
    "observer": (loud(test_observers.Counting, "receive"), "test_a_study_is_watched_or_ignored"),
}
FAULTS = {
    "problem": test_problems.FAULTS,
    "set": test_sets.FAULTS,
    "policy": test_policies.FAULTS,
    "method": test_methods.FAULTS,
    "dictionary": test_dictionaries.FAULTS,
    "regulariser": test_regularisers.FAULTS,
    "solver": test_solvers.FAULTS,
    "maximiser": test_maximisers.FAULTS,
    "schedule": test_rules.SCHEDULES,
    "outer_stop": test_rules.OUTER_STOPS,
    "inner_stop": test_rules.INNER_STOPS,
    "selection": test_rules.SELECTIONS,
    "executor": test_executors.FAULTS,
    "command": test_commands.FAULTS,
    "observer": test_observers.FAULTS,
}
"""What the tests beside this one put before each contract, with the test that has to fail."""


def contract_of(kind):
    return getattr(contracts, "".join(part.capitalize() for part in kind.split("_")) + "Contract")


def test_every_kind_has_its_table_of_faults():
    assert set(FAULTS) == set(PRINTING) == set(kinds())
    assert {contract_of(kind).kind for kind in kinds()} == set(RECORDS)
    assert all(len(faults) >= 10 for faults in FAULTS.values())


@pytest.mark.parametrize("kind", PRINTING)
def test_a_component_that_prints_breaks_its_contract(kind):
    component, test = PRINTING[kind]
    attributes = {"isolated": False} if kind == "executor" else {}
    error = fails(contract_of(kind), component, test, **attributes)
    assert "it prints to the standard output, which belongs to the result: 'here I am" in str(error)


@pytest.mark.parametrize("kind", ["set", "regulariser", "selection", "dictionary"])
def test_the_same_component_without_a_word_keeps_it(kind):
    component, test = PRINTING[kind]
    silent = type("Silent", component.__bases__, {})
    getattr(type("Trial", (contract_of(kind),), {"component": silent})(), test)()


def test_what_an_author_prints_in_a_test_of_his_own_is_his():
    class Own(contracts.SetContract):
        component = test_sets.Disc

        def test_mine(self):
            print("a number that I want to see", self.create().support(np.array([[1.0, 0.0]])))

    with redirect_stdout(StringIO()) as output:
        Own().test_mine()
    assert output.getvalue().startswith("a number")
