"""Grid of a problem: its pieces with the system, the delay and the control before time 0."""

from __future__ import annotations

import numpy as np

from sparserob_core.control.problem.problem import OptimalControlProblem
from sparserob_core.control.response.time_grid import TimeGrid, merge_grids
from sparserob_core.sip.convex_set import Array


def grid_of(problem: OptimalControlProblem, control: Array, disturbance: Array) -> TimeGrid:
    """Return the merged grid of a problem whose control and disturbance change at ``control (K + 1,)`` and at
    ``disturbance (M + 1,)``. Where no control before time 0 is given, it is 0."""
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
