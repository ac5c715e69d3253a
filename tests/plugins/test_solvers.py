"""Guards the solver plugins: the shipped solvers: their options, what they import, and the paper's instance, on which
all agree."""

from __future__ import annotations

import subprocess
import sys
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest

from sparserob_clarabel import Clarabel
from sparserob_core.sip.inner.solve import solve_finite
from sparserob_core.testing.solvers import regularised, robust_terminal
from sparserob_dictionaries import PiecewiseConstant, Walsh
from sparserob_piqp import Piqp
from sparserob_proxqp import ProxQp
from tests.support.relaxed import experiment_one

SOLVERS = [Piqp(), ProxQp(), Clarabel()]
EPSILONS = (1.0, 1e-2, 1e-4, 1e-6, 0.0)


@pytest.mark.first(1)
@pytest.mark.parametrize("pieces", [50, 250])
def test_all_solvers_agree_on_the_paper_s_instance_whatever_epsilon(pieces):
    plain = experiment_one(PiecewiseConstant(pieces=pieces))
    costs = []
    for epsilon in EPSILONS:
        solutions = [solve_finite(regularised(plain, epsilon), solver) for solver in SOLVERS]
        assert [solution.status for solution in solutions] == ["optimal"] * 3
        found = [float(plain.weights @ np.abs(solution.x)) for solution in solutions]
        assert np.ptp(found) <= 1e-6
        costs.append(found[0])
    assert all(larger >= smaller - 1e-9 for larger, smaller in pairwise(costs))
    assert costs[0] > costs[-1] + 1e-3


def test_a_walsh_dictionary_changes_nothing_in_the_linear_program():
    indicators, walsh = experiment_one(PiecewiseConstant(pieces=64)), experiment_one(Walsh(pieces=64))
    values = [solve_finite(program, solver).value for program in (indicators, walsh) for solver in SOLVERS]
    assert np.ptp(values) <= 1e-8


@pytest.mark.first(1)
@pytest.mark.parametrize("solver", SOLVERS, ids=lambda solver: type(solver).__name__)
def test_a_solver_with_no_iterations_to_spare_fails_and_says_so(solver):
    claim_limit = type(solver)(max_iterations=1)
    solution = solve_finite(replace(robust_terminal(), S=sheared()), claim_limit)
    assert solution.status in {"failed", "optimal"}
    assert solution.status == "optimal" or any("not believed" in attempt for attempt in solution.attempts)


def sheared():
    from scipy.sparse import csc_array

    return csc_array(np.eye(50) + np.eye(50, k=1) * 1.5)


@pytest.mark.parametrize("solver", SOLVERS, ids=lambda solver: type(solver).__name__)
@pytest.mark.parametrize("options", [{"max_iterations": 0}, {"max_iteration": 10}, {"max_iterations": "many"}])
def test_an_option_out_of_range_or_misspelt_is_refused(solver, options):
    with pytest.raises(ValueError, match="max_iteration"):
        type(solver)(**options)


def test_the_sparse_and_the_dense_proxqp_agree():
    program = regularised(robust_terminal(), 1e-2)
    dense, sparse = (solve_finite(program, ProxQp(backend=backend)) for backend in ("dense", "sparse"))
    assert dense.status == sparse.status == "optimal"
    assert dense.value == pytest.approx(sparse.value, abs=1e-10)


def test_capabilities_are_declared():
    for solver in SOLVERS:
        assert all(isinstance(getattr(solver, name), bool) for name in ("warm_start", "sparse", "conic"))
    assert Clarabel.conic
    assert not Piqp.conic


@pytest.mark.first(1)
@pytest.mark.parametrize("package", ["piqp", "proxsuite", "clarabel"])
def test_a_solver_is_imported_only_when_it_solves(package):
    adapters = "sparserob_piqp, sparserob_proxqp, sparserob_clarabel, sparserob_core.sip.inner.solve"
    script = f"import sys, {adapters}; sys.exit({package!r} in sys.modules or 'scipy' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", script], check=False).returncode == 0
