"""Guards sparserob_core.testing and every registered component: every registered solver keeps the contract, and solvers
that lie are caught."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

import sparserob_core as sr
from sparserob_core.sip.inner.solve import solve_finite
from sparserob_core.testing import SolverContract
from sparserob_core.testing.solvers import (
    compare,
    infeasible_instances,
    linear_instances,
    regularised_instances,
    robust_terminal,
)

REGISTRY = sr.load_registry()
NAMES = REGISTRY.names("solver")


def test_there_are_solvers_to_be_tested():
    assert {"piqp", "proxqp", "clarabel"} <= set(NAMES)


@pytest.mark.parametrize("name", NAMES)
class TestRegisteredSolver(SolverContract):
    may_fail = 2

    @pytest.fixture(autouse=True)
    def named(self, name):
        self.name = name

    def create(self):
        return REGISTRY.build("solver", self.name)


def test_all_solvers_find_the_same_value():
    for instance in [*linear_instances(), *regularised_instances()]:
        values = [
            s.value
            for name in NAMES
            if (s := solve_finite(instance.program, REGISTRY.build("solver", name))).status == "optimal"
        ]
        assert values, instance.name
        assert np.ptp(values) <= 1e-8 * max(1.0, abs(values[0])), instance.name


class Distorted(sr.Solver):
    """Passes a distorted claim on."""

    def __init__(self):
        self.honest = REGISTRY.build("solver", "piqp")

    def solve(self, program, accuracy):
        return self.distort(program, self.honest.solve(program, accuracy))


class Optimist(Distorted):
    """Says 0 solves everything."""

    def distort(self, program, claim):
        return replace(claim, status="solved", x=0 * claim.x)


class Pessimist(Distorted):
    """Finds nothing feasible, and offers a ray at random."""

    def distort(self, program, claim):
        rng = np.random.default_rng(0)
        return sr.Claim(
            "infeasible", claim.x + 1, rng.random(claim.z.size), rng.standard_normal(claim.y.size), claim.z_box
        )


class Inflated(Distorted):
    """The right decision with multipliers that prove too much."""

    def distort(self, program, claim):
        return replace(claim, z=100 * claim.z + 1, y=-100 * claim.y)


class Numberless(Distorted):
    def distort(self, program, claim):
        return replace(claim, status="solved", x=np.full_like(claim.x, np.nan))


class Misshapen(Distorted):
    def distort(self, program, claim):
        return replace(claim, status="solved", x=claim.x[:-1])


class Broken(Distorted):
    def distort(self, program, claim):
        raise RuntimeError("licence expired")


LIARS = (Optimist, Pessimist, Inflated, Numberless, Misshapen, Broken)


@pytest.mark.parametrize("liar", LIARS)
def test_a_solver_that_lies_is_never_believed(liar):
    for instance in [*linear_instances(), *regularised_instances(), *infeasible_instances()]:
        compare(instance, solve_finite(instance.program, liar()))


@pytest.mark.parametrize("liar", [Numberless, Misshapen, Broken])
def test_what_went_wrong_is_told(liar):
    solution = solve_finite(robust_terminal(), liar())
    assert solution.status == "failed"
    assert len(solution.attempts) >= 4
    assert any(words in solution.attempts[0] for words in ("not finite", "licence expired"))


def test_the_contract_catches_a_check_that_believes_everything(monkeypatch):
    class Trial(SolverContract):
        def create(self):
            return Optimist()

    monkeypatch.setattr("sparserob_core.sip.inner.solve._Case.believes", lambda case, solution: True)
    with pytest.raises(AssertionError):
        Trial().test_linear_programs_are_solved_or_given_up()
