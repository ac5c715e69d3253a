"""Guards sip/methods/branching: a solver that is named answers every part of the tree, and whoever is interrupted while
a part is divided claims no more than what the parts that are left prove."""

from __future__ import annotations

import pytest

import sparserob_core as sr
from sparserob_core.sip.evidence import Branch
from sparserob_core.sip.methods import branching
from tests.sip.test_solver import Spied, given_up

LEAST = 0.95  # of the lengths 0.3, 0.7, 0.25, 0.75 the smallest sum that is at least 0.9
BREAKPOINTS = {"name": "piecewise_constant", "breakpoints": [0.0, 0.3, 1.0, 1.25, 2.0]}


def solved(solver="auto", **options):
    problem = sr.OptimalControlProblem(
        system=sr.LinearSystem(A=[[0.0]], B=[[1.0]]),
        horizon=2.0,
        initial_state=[1.0],
        control=sr.Box([-1], [1]),
        terminal=[sr.Box([-0.1], [0.1])],
    )
    return sr.solve(problem, control=BREAKPOINTS, solver=solver, method={"name": "sparsest", **options})


@pytest.mark.first(1)
@pytest.mark.parametrize("options", [{}, {"alphabet": [-1.0, 0.0, 1.0]}, {"alphabet": [-0.3, 0.0]}])
def test_a_solver_that_is_named_answers_every_part_of_the_tree(options):
    spied = Spied()
    named, auto = solved(spied, **options), solved(**options)
    assert dict(named.solved_by) == {"Spied": named.counts["relaxed_programs"]}
    assert spied.calls == named.counts["solver_calls"] >= len(named.sparsest.tree)
    assert named.status == auto.status == ("infeasible" if -0.3 in options.get("alphabet", ()) else "certified")
    assert named.lower_bound == pytest.approx(auto.lower_bound, rel=1e-7)
    assert options or named.lower_bound == pytest.approx(LEAST, rel=1e-7)


def test_parts_that_it_does_not_answer_are_answered_by_another_one_which_is_told():
    named = solved(Spied(given_up))
    assert named.status == "certified"
    assert named.solved_by["Spied"] == 0
    assert sum(one.count for one in named.unanswered) == named.counts["relaxed_programs"]


@pytest.mark.parametrize("call", [2, 3])
def test_an_interrupt_while_a_part_is_divided_proves_nothing(call, monkeypatch):
    calls, simplex = 0, branching.simplex

    def interrupted(program):
        nonlocal calls
        calls += 1
        if calls == call:
            raise KeyboardInterrupt("enough")
        return simplex(program)

    monkeypatch.setattr(branching, "simplex", interrupted)
    result = solved()
    assert calls == call
    assert result.status == "verified"
    assert result.lower_bound < LEAST - 1e-3
    divided = sum(isinstance(node, Branch) for node in result.sparsest.tree)
    assert len(result.sparsest.tree) == 1 + 2 * divided
