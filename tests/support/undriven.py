"""The checker's loop of a system under measurable disturbances in which nothing is commanded."""

from __future__ import annotations

import numpy as np
from flint import arb_mat

from sparserob_core.checker.flow.flows import VerifiedFlows
from sparserob_core.checker.reach.measurable import MeasurableLoop
from sparserob_core.control.problem.problem import OptimalControlProblem


def undriven(problem: OptimalControlProblem, grid: list[float]) -> MeasurableLoop:
    """That of a known problem, whose control may change on the ``grid``."""
    d, m, K = problem.system.states, problem.system.controls, len(grid) - 1
    gains, law = np.zeros((K, K, m, d)), VerifiedFlows.of(problem.system, grid[-1]).at(())
    still = [arb_mat(m, 1)] * K
    return MeasurableLoop(problem.system, [0.0] * d, still, gains, grid, grid, [], problem.measurable, law=law)
