"""Guards sip/working/tightening: what a decision that keeps away from the constraints is solved from."""

from __future__ import annotations

import numpy as np
import pytest

import sparserob_core as sr
from sparserob_core.sip.working.tightening import LARGE_CELLS_COST_SHARE, _compute_dear_margin


@pytest.mark.parametrize("pieces", [50, 250])
def test_a_round_in_which_a_decision_is_tightened_begins_with_what_is_known(pieces):
    system = sr.LinearSystem(A=[[0, 1], [-2, -0.5]], B=[[0], [1]])
    problem = sr.OptimalControlProblem(
        system=system,
        horizon=5.0,
        initial_state=[-1, 1],
        control=sr.Box([-1], [1]),
        disturbance=sr.Box([-0.06, -0.06], [0.06, 0.06]),
        path=[sr.PathConstraint(sr.Box([-0.7, -float("inf")], [0.7, float("inf")]), start=0.3)],
        terminal=[sr.Box([-0.3, -0.3], [0.3, 0.3])],
    )
    result = sr.solve(problem, control={"name": "piecewise_constant", "pieces": pieces})
    assert result.status == "certified"
    assert result.counts["solver_calls"] == 0  # closed forms, and Newton's method from a guess, answered all


def test_a_distance_that_costs_next_to_nothing_is_a_number() -> None:
    for price in (0.0, 5e-324, np.finfo(float).tiny):
        for cost in (1e-3, 100.0, 1e12):
            assert np.isfinite(_compute_dear_margin(np.float64(cost), np.float64(price)))
    assert _compute_dear_margin(2.0, 0.5) == LARGE_CELLS_COST_SHARE * 4.0
