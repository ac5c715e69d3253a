"""Of the constraints that cannot hold together, few enough to be read."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from sparserob_core.sip.finite import FiniteSolution
from sparserob_core.sip.relaxed import RelaxedProgram, Rows

PRUNED = 40   # constraints that are dropped at most


def irreducible(relaxed: RelaxedProgram, rows: Rows, solution: FiniteSolution) -> tuple[Rows, FiniteSolution]:
    """Drop the rows without which nothing is feasible either, the least important first; returns what is left, proven infeasible too."""
    fixed = relaxed.program.finite.h.size
    for _ in range(PRUNED):
        y = solution.y[fixed:]
        support = np.flatnonzero(y > 0.0)
        rows, y = rows.take(support), y[support]
        for position in np.argsort(y, kind="stable") if y.size > 1 else ():
            fewer = rows.take(np.arange(y.size) != position)
            without = relaxed.solve(fewer, 0.0)
            if without.status == "infeasible":
                rows, solution = fewer, without
                break
        else:
            return rows, replace(solution, y=np.concatenate([solution.y[:fixed], y]))
    return rows, solution
