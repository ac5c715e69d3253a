"""Guards checker/claims: fixed final states beside disturbances that are known numbers there."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from flint import ctx

import sparserob_core as sr
from sparserob_core.checker.claims import constraints
from sparserob_core.checker.claims.case import Case
from sparserob_core.checker.claims.claims import check
from sparserob_core.control.problem.dictionary import Dictionary
from sparserob_core.control.sets.sets import Box, Equality

PIECES = Dictionary.indicators(np.linspace(0.0, 1.0, 5))
KNOWN: dict[str, Any] = {
    "one that pushes": ([[0.0]], [[1.0]], [[1.0]], Box([1.0], [1.0]), [1.5]),
    "beside one that varies": (
        [[0.0, 0.0], [0.0, -1.0]], [[1.0], [0.0]], np.eye(2), Box([1.0, -0.1], [1.0, 0.1]), [1.5, np.nan],
    ),
}  # fmt: skip


def case_of(which: str, goal: float | None = None, **said: Any) -> Case:
    A, B, E, bound, goals = KNOWN[which]
    problem = sr.OptimalControlProblem(
        system=sr.LinearSystem(A, B, E), horizon=1.0, initial_state=np.zeros(len(A)), control=Box([-1.0], [1.0]),
        disturbance=bound, terminal=[Equality(np.array(goals if goal is None else [goal, *goals[1:]]))],
    )  # fmt: skip
    return Case(problem, PIECES, PIECES, {"format": 1, **said})


def verdicts(case: Case) -> dict[str, str]:
    return {claim.name: claim.verdict for claim in check(case, 1e-3)}


@pytest.mark.parametrize("which", KNOWN)
def test_a_push_that_is_known_counts_in_a_fixed_state(which: str) -> None:
    """``x' = u + 1`` from 0 ends at 1.5 with ``u = 0.5``, and at 2.5 never."""
    held = {"multipliers": {"constraints": [], "equalities": [-1.0]}}
    assert verdicts(case_of(which, status="infeasible", **held)) == {"infeasibility": "fails"}
    assert verdicts(case_of(which, 2.5, status="infeasible", **held)) == {"infeasibility": "holds"}
    figures = {"cost": 0.5, "lower_bound": 0.5, "gap_tolerance": 1e-3}
    told = {"status": "certified", "decision": [[0.5] * 4], **figures, **held}
    assert set(verdicts(case_of(which, **told)).values()) == {"holds"}
    assert verdicts(case_of(which, **{**told, "lower_bound": 0.6}))["lower bound"] == "fails"
    assert verdicts(case_of(which, **{**told, "decision": [[0.4] * 4]}))["equalities"] == "fails"


def test_a_state_that_a_known_push_moves_does_not_rest() -> None:
    case = case_of("one that pushes", 1.0, status="certified", decision=[[0.0] * 4])
    with ctx.workprec(96):
        ((off, _),) = constraints.compute_residuals(case)
        assert off.contains(0) and not constraints._is_at_rest(case, 0)
        assert constraints._is_at_rest(case_of("beside one that varies", decision=[[0.0] * 4]), 1)


@pytest.mark.parametrize("push", [0.0, 1.0])
def test_a_known_push_through_an_uncertain_entry_is_uncertain(push: float) -> None:
    """``x' = u + (1 + p) w`` with ``w = 1`` ends at ``1.5 + p``: no value is fixed for every ``p``."""
    system = sr.LinearSystem([[0.0]], [[1.0]], lambda p: np.array([[1.0 + p[0]]]), Box([-0.5], [0.5]))
    problem = sr.OptimalControlProblem(
        system=system, horizon=1.0, initial_state=[0.0], control=Box([-1.0], [1.0]),
        disturbance=Box([push], [push]), terminal=[Equality(np.array([0.5 + push]))],
    )  # fmt: skip
    figures = {"cost": 0.5, "lower_bound": 0.5, "gap_tolerance": 1e-3}
    held = {"multipliers": {"constraints": [], "equalities": [-1.0]}}
    case = Case(
        problem, PIECES, PIECES, {"format": 1, "status": "certified", "decision": [[0.5] * 4], **figures, **held}
    )
    assert verdicts(case)["equalities"] == ("not checked" if push else "holds")


def test_a_row_of_a_fixed_state_is_that_of_the_parameter_at_which_known_pushes_are() -> None:
    """In a triangle of parameters the middle of its box is another point than the one that is farthest inside."""
    triangle = sr.Polytope([[-1.0, 0.0], [0.0, -1.0], [1.0, 1.0]], [0.0, 0.0, 1.0])
    system = sr.LinearSystem([[0.0]], lambda p: np.array([[1.0 + p[0]]]), lambda p: np.array([[1.0 + p[0]]]), triangle)
    problem = sr.OptimalControlProblem(
        system=system, horizon=1.0, initial_state=[0.0], control=Box([-1.0], [1.0]),
        disturbance=Box([1.0], [1.0]), terminal=[Equality(np.array([2.95]))],
    )  # fmt: skip
    # at p = 1/2 the state ends at 1.5 (1 + u) <= 3, so that 2.95 is reached there; at p = 0.29 it is at most 2.59
    held = {"multipliers": {"constraints": [], "equalities": [-1.0]}}
    case = Case(problem, PIECES, PIECES, {"format": 1, "status": "infeasible", **held})
    assert verdicts(case) == {"infeasibility": "fails"}
