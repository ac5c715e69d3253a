"""The grid of a problem: what its system, its delay and the control before time 0 make of its pieces."""

from __future__ import annotations

import numpy as np

from sparserob_core.control.problem.problem import OptimalControlProblem
from sparserob_core.control.response.response import TimeGrid, merge_grids
from sparserob_core.sip.convex_set import Array


def grid_of(problem: OptimalControlProblem, control: Array, disturbance: Array) -> TimeGrid:
    """The merged grid of a problem whose control and whose disturbance change at ``control (K + 1,)`` and at
    ``disturbance (M + 1,)``; where nobody says what the control was before time 0, it was 0."""
    system, before = problem.system, problem.initial_control
    return merge_grids(
        control,
        disturbance,
        system.delay,
        np.zeros(system.controls) if before is None else np.asarray(before, dtype=float),
        system.forced.controls - system.controls,
        system.switches,
        system.varies,
    )
