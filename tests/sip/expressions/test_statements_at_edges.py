"""Guards statements at their edges: sums without turns are 0, and a decision within a function is an error in words."""

from __future__ import annotations

import numpy as np
import pytest

import sparserob_core as sr
from sparserob_core.sip.stated.statement import StatedDecision, StatedProgram

DECISION = {"a": 3, "d": None}


def family(row: str) -> sr.ConstraintFamily:
    return sr.ConstraintFamily.from_expressions("f", index={"x": (-1, 1)}, rows=row, decision=DECISION)


@pytest.mark.parametrize(
    "text",
    [
        "sum(a[k] for k in range(0)) <= d",
        "sum(a[k]*chebyshev(k, x) for k in range(2, 1)) <= d",
        "sum(sum(a[j] for j in range(i)) for i in range(1)) <= d",
        "sum(a[j]*x for i in range(0) for j in range(i)) <= d",
    ],
)
def test_a_sum_without_turns_is_nothing(text: str) -> None:
    G, h = family(text).rows(np.array([[0.5]]))
    assert (G.tolist(), h.tolist()) == ([[[0.0, 0.0, 0.0, -1.0]]], [[0.0]])
    assert family(text).violations(np.array([1.0, 1.0, 1.0, 2.0]), np.array([[0.5]])).tolist() == [[-2.0]]


@pytest.mark.parametrize("text", ["sin(a[0]) <= d", "sqrt(d) <= 1", "2^a[0] <= d", "exp(a[0] + x) <= d"])
def test_a_decision_within_a_function_is_an_error_that_names_the_row(text: str) -> None:
    with pytest.raises(sr.InputError, match="decision") as caught:
        family(text)
    assert text in str(caught.value)


@pytest.mark.parametrize("text", ["sqrt(d)", "abs(abs(d))", "abs(d)^2", "exp(a[0])"])
def test_an_objective_with_a_decision_within_a_function_is_an_error_with_its_key(text: str) -> None:
    decision = {"a": StatedDecision(3, -1, 1), "d": StatedDecision(None, -1, 1)}
    with pytest.raises(sr.InputError, match="minimise"):
        StatedProgram(decision, text, []).build()
