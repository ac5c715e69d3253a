"""Guards sparserob_core/testing/methods and every registered method: each keeps the contract, and methods that claim
too much on purpose fail it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

import sparserob_core as sr
from sparserob_core.sip.evidence import NO_BOUND
from sparserob_core.sip.limits.deadline import Deadline
from sparserob_core.testing import MethodContract
from sparserob_core.testing.methods import dipping
from tests.support.faults import fails

REGISTRY = sr.load_registry()
NAMES = REGISTRY.names("method")


def test_there_are_methods_to_be_tested():
    assert {"exchange", "sparserob", "scenario", "nominal"} <= set(NAMES)


@pytest.mark.parametrize(
    "name", [pytest.param(name, marks=pytest.mark.slow if name == "sparserob" else ()) for name in NAMES]
)  # a search takes seconds, and a dozen programs are searched in each test
class TestRegisteredMethod(MethodContract):
    @pytest.fixture(autouse=True)
    def named(self, name):
        self.name = name

    def create(self):
        return REGISTRY.build("method", self.name)


class Exchanging(sr.Method):
    """A right method, for wrong ones to inherit from."""

    def __init__(self):
        self.honest = REGISTRY.build("method", "exchange")

    def solve(self, program, tools):
        return self.distort(program, self.honest.solve(program, tools))

    def distort(self, program, result):
        return result


def gridded(family, count):
    """The family at ``count`` indices a side only."""
    box = family.index_set
    sides = [np.linspace(low, high, count) for low, high in zip(box.lower, box.upper, strict=True)]
    grid = np.stack(np.meshgrid(*sides), axis=-1).reshape(-1, box.dimension)
    numbers = sr.Box(np.zeros(1), np.array([len(grid) - 1.0]))
    return sr.ConstraintFamily(
        name=family.name, index_set=numbers, rows=lambda k: family.rows(grid[np.rint(k[:, 0]).astype(int)])
    )


class Gridding(Exchanging):
    """Takes a grid for the continuum."""

    def solve(self, program, tools):
        result = self.honest.solve(replace(program, families=[gridded(one, 33) for one in program.families]), tools)
        if result.decision is None:
            return result
        return replace(result, status="certified", upper_bound=result.cost, dual=NO_BOUND)


class Certifying(Exchanging):
    """Takes what looks good for proven."""

    def distort(self, program, result):
        found = result.decision is not None
        return replace(result, status="certified", upper_bound=result.cost) if found else result


class Leaving(Exchanging):
    """Leaves out a family."""

    def solve(self, program, tools):
        return self.honest.solve(replace(program, families=program.families[:-1]), tools)


class BoundFromTheCost(Exchanging):
    def distort(self, program, result):
        return result if result.decision is None else replace(result, lower_bound=result.cost + 1e-3)


class BoundOutOfNothing(Exchanging):
    def distort(self, program, result):
        return replace(result, dual=NO_BOUND)


class UnprovenUpperBound(Exchanging):
    def distort(self, program, result):
        return result if result.decision is None else replace(result, upper_bound=result.cost)


class NeverFeasible(Exchanging):
    def distort(self, program, result):
        return sr.Result(status="infeasible", message="it cannot be done", lower_bound=np.inf, dual=result.dual)


class Losing(Exchanging):
    def distort(self, program, result):
        return replace(result, decision=None)


class RegularisedCost(Exchanging):
    """Says that the cost is one with the regulariser."""

    def distort(self, program, result):
        return result if result.decision is None else replace(result, cost=result.cost + 1e-3, upper_bound=np.inf)


class Careless(Exchanging):
    """Goes over the bounds."""

    def distort(self, program, result):
        if result.decision is None:
            return result
        x = result.decision * 1.01
        return replace(result, decision=x, cost=program.cost(x), upper_bound=program.cost(x))


class Silent(Exchanging):
    def distort(self, program, result):
        return replace(result, message="")


class Worded(Exchanging):
    def distort(self, program, result):
        return replace(result, status="optimal")


class Fragile(Exchanging):
    """Takes it for granted that there is a decision."""

    def distort(self, program, result):
        result.decision.sum()
        return result


class NoWitness(Exchanging):
    """Refutes every decision."""

    def distort(self, program, result):
        if result.decision is None:
            return result
        return replace(result, status="refuted", upper_bound=np.inf, worst=None)


class FalseWitness(Exchanging):
    """Refutes every decision, by a constraint that it satisfies."""

    def distort(self, program, result):
        if result.worst is None or result.decision is None:
            return result
        return replace(result, status="refuted", upper_bound=np.inf, worst=replace(result.worst, violation=0.5))


class Changing(Exchanging):
    def solve(self, program, tools):
        result = self.honest.solve(program, tools)
        program.finite.upper[:] += 1.0
        return result


class Remembering(Exchanging):
    known = None

    def solve(self, program, tools):
        self.known = self.known or {}
        return self.known.setdefault(program.n, self.honest.solve(program, tools))


class Unseeded(Exchanging):
    def distort(self, program, result):
        return replace(result, message=f"{result.message} ({np.random.default_rng().random()})")


class Seeding(Exchanging):
    def solve(self, program, tools):
        np.random.seed(0)  # noqa: NPY002
        return self.honest.solve(program, tools)


class Endless(Exchanging):
    """Does not know that time is limited."""

    def solve(self, program, tools):
        return self.honest.solve(program, replace(tools, deadline=Deadline()))


class Deaf(Exchanging):
    """Begins anew after an interrupt."""

    def solve(self, program, tools):
        for _ in range(5):
            result = self.honest.solve(program, replace(tools, deadline=Deadline()))
        return replace(result, stopped="")


class Interrupted(Exchanging):
    """Lets an interrupt go through."""

    def solve(self, program, tools):
        result = self.honest.solve(program, replace(tools, deadline=Deadline()))
        if result.stopped:
            raise KeyboardInterrupt
        return result


class Telling(Exchanging):
    """Tells of a lower bound that is not proven."""

    def solve(self, program, tools):
        def louder(event):
            told = isinstance(event, sr.RoundFinished)
            tools.notify(replace(event, lower_bound=event.lower_bound + 10.0) if told else event)

        return self.honest.solve(program, replace(tools, notify=louder))


class Trusting(Exchanging):
    """Believes what the solver says."""

    def solve(self, program, tools):
        from scipy.sparse import csc_array

        n, none = program.n, np.zeros((0, program.n))
        asked = sr.QuadraticProgram(
            csc_array((n, n)), np.ones(n), csc_array(none), np.zeros(0), csc_array(none), np.zeros(0), -np.ones(n),
            np.ones(n),
        )  # fmt: skip
        claim = tools.solver.solve(asked, 1e-9)
        result = self.honest.solve(program, tools)
        if claim.status == "solved" and not np.allclose(claim.x, -1.0):
            return replace(
                result, status="certified", decision=claim.x[:n], cost=program.cost(claim.x), lower_bound=-np.inf,
                upper_bound=program.cost(claim.x),
            )  # fmt: skip
        return result


class Demanding(Exchanging):
    """Takes it for granted that there is a maximiser."""

    def solve(self, program, tools):
        assert tools.maximiser.search
        return self.honest.solve(program, tools)


class Refusing(Exchanging):
    def solve(self, program, tools):
        raise sr.InputError("method: expected another program")


TRUE, TOLD = "test_what_it_claims_is_true", "test_the_rounds_that_it_tells_are_true"
FAULTS = {
    Gridding: TRUE,
    Certifying: TRUE,
    Leaving: TRUE,
    BoundFromTheCost: TRUE,
    BoundOutOfNothing: TRUE,
    UnprovenUpperBound: TRUE,
    NeverFeasible: TRUE,
    Losing: TRUE,
    RegularisedCost: TRUE,
    Careless: TRUE,
    Silent: TRUE,
    Worded: TRUE,
    Fragile: TRUE,
    NoWitness: TRUE,
    FalseWitness: TRUE,
    Refusing: TRUE,
    Telling: TOLD,
    Trusting: "test_a_solver_that_lies_misleads_nobody",
    Changing: "test_the_program_is_left_as_it_was",
    Remembering: "test_one_method_may_solve_many_programs",
    Unseeded: "test_the_same_seed_gives_the_same_result",
    Seeding: "test_the_same_seed_gives_the_same_result",
    Endless: "test_it_ends_when_its_time_is_over",
    Deaf: "test_an_interrupt_ends_it_with_what_is_known",
    Interrupted: "test_an_interrupt_ends_it_with_what_is_known",
    Demanding: "test_without_a_maximiser_it_works_or_says_what_it_needs",
}


@pytest.mark.first(6)
@pytest.mark.parametrize(("flawed", "test"), FAULTS.items(), ids=[one.__name__ for one in FAULTS])
def test_the_contract_catches_a_method_that_claims_too_much_on_purpose(flawed, test):
    fails(MethodContract, flawed, test)


def test_a_grid_is_refuted_where_nobody_looked():
    error = fails(MethodContract, Gridding, TRUE)
    assert "a narrow dip: " in str(error) and "violates below by" in str(error)
    result = Gridding().solve(dipping(), MethodContract().tools())
    assert result.decision is not None and dipping().families[0].violations(
        result.decision, np.array([[0.73713]])
    ).max() > 0.1  # fmt: skip
