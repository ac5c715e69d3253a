"""Guards plugins/sparserob_qpsolvers: every solver of qpsolvers by its own name: listed without an import, its settings
checked against its own, its multipliers with the signs of `Claim`, and believed no more than any other."""

from __future__ import annotations

import pickle
import subprocess
import sys
from dataclasses import replace

import numpy as np
import pytest
from scipy.sparse import csc_array

import sparserob_core as sr
from sparserob_core.sip.inner.solve import solve_finite
from sparserob_core.testing import SolverContract
from sparserob_core.testing.solvers import regularised, robust_terminal
from sparserob_qpsolvers.catalogue import NATIVE, SOLVERS
from tests.support.stub import Command

REGISTRY = sr.load_registry()
ALL = [name for name in SOLVERS if name in NATIVE or not REGISTRY.get("solver", name).missing]
QUICK = {"daqp", "quadprog"}
NEEDS_CURVATURE = {"ecos", "pyqpmad", "quadprog"}
COARSE = {"ecos": 1e-5, "highs": 1e-6}  # what they reach when they are asked for 1e-10

INSTALLED = [name if name in QUICK else pytest.param(name, marks=pytest.mark.slow) for name in ALL]


def solver(name, **settings):
    if name in NATIVE:
        return REGISTRY.build("solver", "qpsolvers", {"solver": name, **settings})
    return REGISTRY.build("solver", name, settings)


def quadratic(lower, upper, rows=True, equal=True):
    """minimise ``|x|^2/2 - 3 x1 + 3 x2 - x4`` with one row, one equality and bounds, of which several hold it."""
    G = csc_array(np.array([[0.0, 0, 1, 1]] if rows else np.zeros((0, 4))))
    A = csc_array(np.array([[0.0, 1, 1, 0]] if equal else np.zeros((0, 4))))
    h, b = np.full(G.shape[0], 0.5), np.full(A.shape[0], -0.8)
    q = np.array([-3.0, 3.0, 0.0, -1.0])
    return sr.QuadraticProgram(csc_array(np.eye(4)), q, G, h, A, b, np.array(lower, float), np.array(upper, float))


INFINITE = np.inf
PROGRAMS = {
    "bounded": quadratic([-1] * 4, [1] * 4),
    "half bounded": quadratic([-1, -1, -INFINITE, -INFINITE], [1, INFINITE, INFINITE, INFINITE]),
    "one variable fixed": quadratic([-1, -1, -1, 0.2], [1, 1, 1, 0.2]),
    "bounds only": quadratic([-1] * 4, [1] * 4, rows=False, equal=False),
    "one row": quadratic([-INFINITE] * 4, [INFINITE] * 4, equal=False),
}


@pytest.mark.parametrize("name", ALL)
def test_multipliers_have_the_signs_of_a_claim(name):
    for words, program in PROGRAMS.items():
        claim = solver(name).solve(program, 1e-10)
        close = COARSE.get(name, 1e-8)
        assert claim.status == "solved", (words, claim.message)
        stationary = program.P @ claim.x + program.q + program.G.T @ claim.z + program.A.T @ claim.y + claim.z_box
        assert np.abs(stationary).max() <= close, words
        assert (program.G @ claim.x <= program.h + close).all(), words
        assert np.abs(program.A @ claim.x - program.b).max(initial=0.0) <= close, words
        assert (claim.z >= -close).all(), words
        assert (claim.z_box[claim.x < program.upper - 1e-3] <= 10 * close).all(), words
        assert (claim.z_box[claim.x > program.lower + 1e-3] >= -10 * close).all(), words


def test_there_are_solvers_to_be_tested():
    assert {"daqp", "highs", "osqp", "piqp", "proxqp", "clarabel", "quadprog"} <= set(ALL)


@pytest.mark.parametrize("name", INSTALLED)
class TestEverySolverOfQpsolvers(SolverContract):
    @pytest.fixture(autouse=True)
    def named(self, name):
        self.name = name
        self.may_fail = 18 if name in NEEDS_CURVATURE else 3
        self.precision = 1e2 * COARSE.get(name, 1e-8)

    def create(self):
        return solver(self.name)


@pytest.mark.first(1)
@pytest.mark.parametrize("name", sorted({"daqp", "highs", "osqp"} & set(ALL)))
def test_whole_problems_are_certified_by_them(name):
    problem = sr.OptimalControlProblem(
        system=sr.LinearSystem(np.array([[0.0, 1.0], [0.0, 0.0]]), np.array([[0.0], [1.0]])),
        horizon=5.0,
        initial_state=[4.0, 0.0],
        control=sr.Box([-1.0], [1.0]),
        disturbance=sr.Box([-0.02, -0.02], [0.02, 0.02]),
        terminal=[sr.Box([-0.5, -0.3], [0.5, 0.3])],
    )
    ours, theirs = (sr.solve(problem, solver=one) for one in ("piqp", name))
    assert theirs.status == ours.status == "certified"
    assert abs(theirs.cost - ours.cost) <= 1e-6


def test_they_are_listed_without_being_imported():
    packages = {known.package for known in SOLVERS.values()} | {"qpsolvers", "scipy"}
    code = (
        "import sys, sparserob_core as sr; registry = sr.load_registry(); "
        "assert {'highs', 'osqp', 'gurobi', 'qpsolvers'} <= set(registry.names('solver')); "
        f"sys.exit(bool({packages!r} & set(sys.modules)))"
    )
    subprocess.run([sys.executable, "-c", code], check=True)


def test_what_is_missing_is_told_by_name_before_anything_is_solved(monkeypatch):
    monkeypatch.setitem(sys.modules, "gurobipy", None)
    with pytest.raises(sr.UnknownPluginError, match="solver 'gurobi': gurobipy is not installed; `pip install"):
        REGISTRY.build("solver", "gurobi", {"Threads": 1})
    with pytest.raises(sr.InputError, match=r"qpsolvers .* finds no solver 'cplex'; it finds clarabel, "):
        REGISTRY.build("solver", "qpsolvers", {"solver": "cplex"})


@pytest.mark.parametrize(
    ("name", "settings", "words"),
    [
        ("osqp", {"eps_ab": 1e-8}, "eps_ab: unknown key; did you mean 'eps_abs'"),
        ("osqp", {"eps_abs": "small"}, r"eps_abs: must be a number \(got 'small'\)"),
        ("highs", {"simplex_strategy": 1.5}, "simplex_strategy: must be a whole number"),
        ("quadprog", {"eps_abs": 1e-8}, "eps_abs: unknown key"),
        ("osqp", {"eps_abs": -1.0}, r"eps_abs: must be greater than or equal to 0 \(got -1.0\)"),
        ("osqp", {"max_iter": 0}, "max_iter: must be greater than or equal to 1"),
        ("highs", {"primal_feasibility_tolerance": -1.0}, "feasibility_tolerance: must be greater"),
        ("qpsolvers", {"solver": "piqp", "max_iter": -3}, r"piqp\.max_iter"),
        ("qpsolvers", {}, "solver: missing"),
        ("qpsolvers", {"solver": "piqp", "max_iters": 3}, "no setting 'max_iters' of piqp; the nearest is 'max_iter'"),
        ("qpsolvers", {"solver": "piqp", "max_iter": "many"}, "max_iter"),
    ],
)
def test_a_setting_that_the_solver_does_not_have_is_refused_with_the_nearest(name, settings, words):
    with pytest.raises(sr.InputError, match=words):
        REGISTRY.build("solver", name, settings)


def test_settings_reach_the_solver_and_only_those_given_are_written_down():
    few, many = (solver("osqp", max_iter=limit, polishing=False) for limit in (1, 4000))
    assert few.model_dump(mode="json") == {"max_iter": 1, "polishing": False}
    program = PROGRAMS["bounded"]
    assert few.solve(program, 1e-8).status == "failed"
    assert many.solve(program, 1e-8).status == "solved"
    assert (
        REGISTRY.build("solver", "qpsolvers", {"solver": "piqp", "max_iter": 1}).solve(program, 1e-8).status == "failed"
    )
    sparse = REGISTRY.build("solver", "qpsolvers", {"solver": "piqp", "kkt_solver": "sparse_ldlt"})
    assert sparse.solve(program, 1e-8).status == "solved", "the name of an enumeration's member"


def test_who_answered_is_told_with_the_solver_that_was_chosen():
    program = sr.SemiInfiniteProgram(n=2, q=[-1.0, -1.0], P=np.eye(2), lower=-1.0, upper=0.5)
    chosen = {"name": "qpsolvers", "solver": "quadprog"}
    for given, name in ((chosen, "qpsolvers (quadprog)"), ({"name": "quadprog"}, "quadprog")):
        result = sr.solve(program, solver=given)
        assert (result.status, set(result.solved_by)) == ("certified", {name})
    assert REGISTRY.build("solver", "auto", {"general": chosen}).called == "qpsolvers (quadprog)"


def test_a_solver_can_be_sent_to_another_process():
    for name in ("osqp", "piqp"):
        sent = pickle.loads(pickle.dumps(solver(name, max_iter=77)))
        assert sent.solve(PROGRAMS["bounded"], 1e-8).status == "solved"


def test_a_cost_that_a_solver_refuses_is_a_failure_and_no_exception():
    flat = replace(PROGRAMS["bounded"], P=csc_array((4, 4)))
    claim = solver("quadprog").solve(flat, 1e-8)
    assert claim.status == "failed"
    assert "not positive definite" in claim.message


def test_an_answer_of_few_digits_is_given_more_or_not_believed():
    """A first-order method without a polish ends far from what is believed."""
    for epsilon in (1.0, 1e-4):
        found = solve_finite(
            regularised(robust_terminal(), epsilon), solver("osqp", polishing=False, eps_abs=1e-2, eps_rel=1e-2)
        )
        truth = solve_finite(regularised(robust_terminal(), epsilon), REGISTRY.build("solver", "piqp"))
        assert found.status == "failed" or abs(found.value - truth.value) <= 1e-8
        assert found.lower_bound <= truth.value + 1e-9


def test_the_command_lists_settings_and_what_is_missing(command: Command):
    done = command("plugins", "osqp")
    assert done.returncode == 0
    assert any(line.split()[:1] == ["eps_abs"] and "0.001" in line for line in done.stdout.splitlines())
    listed = command("plugins").stdout
    gone = [name for name in SOLVERS if name not in ALL]
    assert all(f"solver '{name}': " in listed for name in gone)


@pytest.mark.parametrize("threads", [1, 2])
def test_highs_answers_after_any_other_highs_of_the_process_and_prints_nothing(threads):
    script = f"""
import os, sys, threading
out = os.dup(1); os.dup2(os.open(os.devnull, os.O_WRONLY), 1)
import highspy
def other():
    one = highspy.Highs(); one.setOptionValue("output_flag", False); one.setOptionValue("threads", {threads})
    one.addVar(0, 1); one.run()
other() if {threads} == 2 else None
sys.stdout.flush(); os.dup2(out, 1)
from tests.plugins.test_qpsolvers import PROGRAMS, solver
from sparserob_core.sip.inner.simplex.interruptible import run
for _ in range(2):
    assert solver("highs").solve(PROGRAMS["bounded"], 1e-6).status == "solved"
def counterpart():
    other()
    linear = highspy.Highs(); linear.setOptionValue("output_flag", False)
    linear.setOptionValue("threads", 3 - {threads})
    linear.addVar(1, 2); run(linear)
    answers.append(linear.getModelStatus())
answers = []
thread = threading.Thread(target=counterpart); thread.start(); thread.join()
assert answers == [highspy.HighsModelStatus.kOptimal], answers
"""
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=False)
    assert (done.returncode, done.stdout) == (0, ""), done.stderr[-500:]
