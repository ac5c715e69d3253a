"""Problem with further states, which follow its own, begin at 0, are not measured and cost nothing."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from sparserob_core.control.policies.measurements import Measurements
from sparserob_core.control.problem.cost import Quadratic
from sparserob_core.control.problem.problem import OptimalControlProblem
from sparserob_core.control.problem.terms.windows import columns
from sparserob_core.control.sets.sets import product
from sparserob_core.sip.convex_set import Box


def enlarge_problem(problem: OptimalControlProblem, more: int, **replacements: Any) -> OptimalControlProblem:
    """Return the problem with ``more`` further states; ``replacements`` holds its new system, constraints and names."""
    d, zeros, initial_set = problem.system.states, np.zeros(more), problem.initial_set
    measurements, (state, _, final) = problem.measurements or Measurements(np.eye(d)), problem.cost.terms
    return replace(
        problem,
        initial_state=np.append(np.asarray(problem.initial_state), zeros),
        initial_set=initial_set if initial_set is None or not more else product([initial_set, Box(zeros, zeros)]),
        cost=replace(problem.cost, state=_pad_cost(state, more), final=_pad_cost(final, more)),
        measurements=replace(measurements, C=columns(measurements.C, d + more)),
        **replacements,
    )


def _pad_cost(term: Quadratic | None, more: int) -> Quadratic | None:
    return None if term is None else Quadratic(np.pad(term.Q, (0, more)), np.pad(term.reference, (0, more)))
