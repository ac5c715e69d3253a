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
from tests.support.faults import fails

REGISTRY = sr.load_registry()
ALL = [
    name for name in REGISTRY.names("solver") if REGISTRY.get("solver", name).plugin != "qpsolvers"
]  # tests/plugins/test_qpsolvers.py has those
NAMES = [name for name in ALL if name != "dual_newton"]  # which is for separable programs


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


class TestDualNewton(SolverContract):
    """Six of its programs have a cost that couples variables; tests/sip/inner/test_dual_newton.py allows no other
    failure."""

    may_fail = 6

    def create(self):
        return REGISTRY.build("solver", "dual_newton")


@pytest.mark.slow
def test_all_solvers_find_the_same_value():
    for instance in [*linear_instances(), *regularised_instances()]:
        values = [
            s.value
            for name in ALL
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


@pytest.mark.first(3)
@pytest.mark.parametrize("stride", [4, pytest.param(1, marks=pytest.mark.slow)])
@pytest.mark.parametrize("liar", LIARS)
def test_a_solver_that_lies_is_never_believed(liar, stride):
    for instance in [*linear_instances(), *regularised_instances(), *infeasible_instances()][::stride]:
        compare(instance, solve_finite(instance.program, liar()))


@pytest.mark.parametrize("liar", [Numberless, Misshapen, Broken])
def test_what_went_wrong_is_told(liar):
    solution = solve_finite(robust_terminal(), liar())
    assert solution.status == "failed"
    assert len(solution.attempts) >= 4
    assert any(words in solution.attempts[0] for words in ("not finite", "licence expired"))


class DualsUpsideDown(Distorted):
    def distort(self, program, claim):
        return replace(claim, z=-claim.z)


class EqualityDualsUpsideDown(Distorted):
    def distort(self, program, claim):
        return replace(claim, y=-claim.y)


class BoundDualsUpsideDown(Distorted):
    def distort(self, program, claim):
        return replace(claim, z_box=-claim.z_box)


class NoDuals(Distorted):
    def distort(self, program, claim):
        return replace(claim, z=0 * claim.z, y=0 * claim.y, z_box=0 * claim.z_box)


class GivingUp(Distorted):
    def distort(self, program, claim):
        return replace(claim, status="failed")


class Blurred(Distorted):
    """Stops three digits early."""

    def distort(self, program, claim):
        return replace(claim, x=np.round(claim.x, 4))


class Renamed(Distorted):
    """Calls every end of its iterations an optimum."""

    def distort(self, program, claim):
        size = program.q.size
        filled = np.nan_to_num(claim.x) if np.shape(claim.x) == (size,) else np.zeros(size)
        return sr.Claim("solved", filled, np.zeros(len(program.h)), np.zeros(len(program.b)), np.zeros(size))


class Worded(Distorted):
    def distort(self, program, claim):
        return replace(claim, status="optimal")


class DualInfeasible(Distorted):
    """Takes the solver's "dual infeasible" for its "primal infeasible"."""

    def distort(self, program, claim):
        return claim if claim.status == "solved" else replace(claim, status="infeasible")


class Asking(Distorted):
    """Solves another program than it was given."""

    def other(self, program):
        return program

    def solve(self, program, accuracy):
        claim = self.honest.solve(self.other(program), accuracy)
        box = np.zeros(program.q.size)
        return sr.Claim(claim.status, claim.x, np.zeros(len(program.h)), np.zeros(len(program.b)), box)


class WithoutEqualities(Asking):
    def other(self, program):
        return replace(program, A=program.A[:0], b=program.b[:0])


class WithoutRows(Asking):
    def other(self, program):
        return replace(program, G=program.G[:0], h=program.h[:0])


class WithoutBounds(Asking):
    def other(self, program):
        return replace(program, lower=np.full_like(program.lower, -1e3), upper=np.full_like(program.upper, 1e3))


class WithoutTheHalf(Distorted):
    """Takes ``x'P x`` for ``1/2 x'P x``."""

    def solve(self, program, accuracy):
        return self.honest.solve(replace(program, P=2 * program.P), accuracy)


class Diagonal(Distorted):
    """Knows separable costs only."""

    def solve(self, program, accuracy):
        from scipy.sparse import csc_array, diags_array

        return self.honest.solve(replace(program, P=csc_array(diags_array(program.P.diagonal()))), accuracy)


class Scribbling(Distorted):
    """Has no infinite bounds, and puts large ones in the program itself."""

    def solve(self, program, accuracy):
        np.clip(program.lower, -1e9, 1e9, out=program.lower)
        return self.honest.solve(program, accuracy)


class WarmStarted(Distorted):
    """Keeps the curvature of the first program of each size."""

    def __init__(self):
        super().__init__()
        self.known = {}

    def solve(self, program, accuracy):
        first = self.known.setdefault("first", program)
        if first is not program and first.q.size != program.q.size:
            return replace(self.honest.solve(program, accuracy), status="failed", message="set up for another size")
        return self.honest.solve(program, accuracy)


SIGNS = "test_a_claim_satisfies_the_conditions_of_optimality"
NO_SOLUTION = "test_a_program_without_a_solution_is_not_claimed_to_be_solved"
FAULTS = {
    Optimist: SIGNS,
    Pessimist: SIGNS,
    Inflated: SIGNS,
    Numberless: SIGNS,
    Misshapen: SIGNS,
    Broken: SIGNS,
    DualsUpsideDown: SIGNS,
    EqualityDualsUpsideDown: SIGNS,
    BoundDualsUpsideDown: SIGNS,
    NoDuals: SIGNS,
    GivingUp: SIGNS,
    Blurred: SIGNS,
    Worded: SIGNS,
    WithoutEqualities: SIGNS,
    WithoutRows: SIGNS,
    WithoutBounds: SIGNS,
    WithoutTheHalf: SIGNS,
    Diagonal: SIGNS,
    Renamed: NO_SOLUTION,
    DualInfeasible: NO_SOLUTION,
    Scribbling: "test_the_program_is_left_as_it_was",
    WarmStarted: "test_a_second_program_is_not_solved_by_the_answer_to_the_first",
}


@pytest.mark.parametrize(("flawed", "test"), FAULTS.items(), ids=[one.__name__ for one in FAULTS])
def test_the_contract_catches_a_solver_that_is_bad_on_purpose(flawed, test):
    fails(SolverContract, flawed, test)


@pytest.mark.first(1)
@pytest.mark.parametrize("flawed", [Optimist, Pessimist, Inflated, NoDuals, Diagonal])
def test_behind_the_check_too_a_bad_solver_fails_on_programs_that_need_a_solver(flawed):
    """Separable programs are put right by the check itself, and say nothing of a solver."""
    fails(SolverContract, flawed, "test_programs_that_need_a_solver_are_solved")


def test_the_contract_catches_a_check_that_believes_everything(monkeypatch):
    monkeypatch.setattr("sparserob_core.sip.inner.solve._Case.believes", lambda case, solution: True)
    fails(SolverContract, Optimist, "test_linear_programs_are_solved_or_given_up")
