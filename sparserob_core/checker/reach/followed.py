"""The rows of a problem that are computed by their adjoints: one known system acts all the time."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import final

import numpy as np

from sparserob_core.checker.arithmetic.remembered import remembered
from sparserob_core.checker.arithmetic.series import stacked
from sparserob_core.checker.flow.flow import StateWeights
from sparserob_core.checker.flow.plant import modes_at
from sparserob_core.checker.problem.disturbances import Disturbances
from sparserob_core.checker.problem.timing import Timing
from sparserob_core.checker.reach.adjoint import AdjointFlow, AdjointRow, Worst
from sparserob_core.checker.reach.states import Scene
from sparserob_core.checker.sets.polynomials import Enclosed
from sparserob_core.control.problem.problem import OptimalControlProblem
from sparserob_core.control.problem.system import System
from sparserob_core.sip.convex_set import Array

# Number of states from which rows are computed by adjoints. A tube makes a ball matrix for every length of a cell, and
# one such matrix takes as long as all rows. For few states a tube is faster; for 48 it takes minutes, for 270 hours.
FOLLOWED = 16
# Number of pieces up to which adjoints are used: the effects of all pieces are summed at every end of a cell. With a
# tenth of it tubes of 48 states on 1600 pieces end without a verdict; with ten times as many the sums take minutes.
MAX_PIECES = 4000


@final
@dataclass(frozen=True, eq=False)
class FollowedRows:
    """The rows of a ``problem`` that are computed by their adjoints, with the adjoints made so far."""

    problem: OptimalControlProblem
    timing: Timing
    disturbances: Disturbances

    @property
    def still(self) -> System | None:
        """The one system that acts all the time; ``None`` where the system changes with time."""
        return self.problem.system if self.problem.system.is_constant else None

    @property
    def are_possible(self) -> bool:
        """True if the system is known, acts all the time, and its disturbances are all of one kind."""
        return self.still is not None and not self.problem.system.parameter_count and self.disturbances.alike

    @property
    def are_best(self) -> bool:
        """True if adjoints are used although a tube would do as well: for many states, or for measurable disturbances,
        which a tube integrates along matrices on every piece."""
        if self.timing.answering or not self.disturbances.alike or len(self.timing.grid) > MAX_PIECES:
            return False
        return self.are_possible and (self.problem.measurable is not None or self.problem.system.states >= FOLLOWED)

    @cached_property
    def flow(self) -> AdjointFlow:
        """The adjoint flow that all rows share, with the inputs of the control before those of the disturbance."""
        assert self.still is not None
        (matrices,) = modes_at(self.still, [])
        A, B, E = (matrices[name] for name in ("A", "B", "E"))
        if self.problem.disturbance is not None:
            B = stacked([[*b, *e] for b, e in zip(B.tolist(), E.tolist(), strict=True)])
        return AdjointFlow.of(A, B, self.timing.grid[-1], self.timing.clock)

    def worst(self, c: Array, scene: Scene) -> Worst:
        """Return the worst case of the row ``c'x``, ``c (d,)``, under the control of a ``scene``."""
        problem = self.problem
        on_grid = [u.entries() for u in scene.control]
        table = Enclosed.of(stacked([list(row) for row in zip(*on_grid, strict=True)]))
        is_constant = problem.measurable is not None  # the middle of the set, and a bounded input beside it
        changes = [0.0] if is_constant else self.disturbances.changes or [0.0]
        return Worst(
            self.adjoint(c),
            np.asarray(problem.initial_state, dtype=float),
            problem.initial_set,
            np.array(self.timing.grid),
            table,
            self.disturbances.held,
            np.append(changes, problem.horizon),
        )

    def weigh(self, c: Array, parameter: Sequence[float], grid: Sequence[float]) -> StateWeights:
        """Return the weights of ``c'x`` at the end of a grid, as `VerifiedFlows.weigh` does."""
        row, time, m = self.adjoint(c), np.array([grid[-1]]), self.problem.system.controls
        effects, m = row.between(time, np.array(grid[:-1]), np.array(grid[1:])), m + self.problem.system.drifts
        pieces, columns = range(len(grid) - 1), (slice(m), slice(m, None))
        control, disturbance = ([effects[k : k + 1, part].matrix for k in pieces] for part in columns)
        return StateWeights(row.at(time).matrix, control, disturbance)

    @remembered(key=lambda self, c: (c + 0.0).tobytes())  # -0 becomes 0, so that equal rows have equal bytes
    def adjoint(self, c: Array) -> AdjointRow:
        """Return the adjoint of a row ``c (d,)``, which is made once for the row and its opposite."""
        c, opposite = c + 0.0, 0.0 - c
        is_first = c.tobytes() <= opposite.tobytes()
        return AdjointRow.of(self.flow, c) if is_first else self.adjoint(opposite).reversed()
