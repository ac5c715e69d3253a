"""The rows of a problem that are followed by their adjoints, where one known system acts all along."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import final

import numpy as np

from sparserob_core.checker.arithmetic.series import stacked
from sparserob_core.checker.flow.still import modes_at
from sparserob_core.checker.problem.disturbances import Disturbances
from sparserob_core.checker.problem.integrals import RunningIntegrals, spelt
from sparserob_core.checker.problem.timing import Timing
from sparserob_core.checker.reach.adjoint import AdjointFlow, AdjointRow, Stopped, Worst
from sparserob_core.checker.reach.states import Scene
from sparserob_core.checker.sets.polynomials import Enclosed
from sparserob_core.control.problem.problem import OptimalControlProblem
from sparserob_core.control.problem.system import System
from sparserob_core.sip.convex_set import Array

# States from which the rows of a known system are followed: a ball matrix for every length of a cell, as the tube has
# them, takes as long as all rows. Of few states the tube takes less; of 48 it takes minutes, and of 270 hours.
FOLLOWED = 16
# Pieces up to which they are: what a piece adds is summed at every end of a cell. With a tenth of it tubes of 48 states
# on 1600 pieces end without a verdict; with ten times as many the sums take minutes.
MOST_PIECES = 4000


@final
@dataclass(frozen=True, eq=False)
class FollowedRows:
    """The rows of a ``problem``, of which ``stated`` is what it was given as, and the adjoints that were made."""

    problem: OptimalControlProblem
    stated: OptimalControlProblem
    timing: Timing
    disturbances: Disturbances
    _made: dict[bytes, AdjointRow] = field(default_factory=dict, repr=False)

    @cached_property
    def running(self) -> RunningIntegrals | None:
        """What is integrated, where nothing else changes with time."""
        system = self.problem.system
        if not system.switches:
            return None
        found, d = RunningIntegrals.of(spelt(self.stated)), self.stated.system.states
        return found if found is not None and all(found.is_beside(phase, d) for phase in system.phases) else None

    @property
    def still(self) -> System | None:
        """The one system that acts all along, beside what is integrated of it; ``None`` where others do."""
        if self.running is not None:
            return self.running.system
        system = self.problem.system
        return None if system.varies or system.switches else system

    @property
    def are_possible(self) -> bool:
        """Whether the system is known, acts all along, and is disturbed in one way."""
        return self.still is not None and not self.problem.system.parameter_count and self.disturbances.alike

    @property
    def are_best(self) -> bool:
        """Whether rows are followed where a tube would do too: with many states, or measurable disturbances, which
        would be integrated along matrices on every piece."""
        if self.timing.answering or not self.disturbances.alike or len(self.timing.grid) > MOST_PIECES:
            return False
        return self.are_possible and (self.problem.measurable is not None or self.problem.system.states >= FOLLOWED)

    @cached_property
    def flow(self) -> AdjointFlow:
        """What the rows have in common, the inputs of the control before those of the disturbance."""
        assert self.still is not None
        (parts,) = modes_at(self.still, [])
        A, B, E = (parts[name] for name in ("A", "B", "E"))
        if self.problem.disturbance is not None:
            B = stacked([[*b, *e] for b, e in zip(B.tolist(), E.tolist(), strict=True)])
        return AdjointFlow.of(A, B, self.timing.grid[-1], self.timing.clock)

    def worst(self, c: Array, scene: Scene | None) -> Worst:
        """The worst of the row ``c (d,)``, under the control of a scene or without any; one adjoint serves a row and
        its opposite."""
        problem = self.problem
        inputs = problem.system.controls + problem.system.drifts
        table = Enclosed(*np.zeros((2, inputs, len(self.timing.grid) - 1)))
        if scene is not None:
            on_grid = [u.entries() for u in scene.control]
            table = Enclosed.of(stacked([list(row) for row in zip(*on_grid, strict=True)]))
        jumps = None if problem.measurable is not None else self.disturbances.changes
        return Worst(
            self._adjoint(c),
            np.asarray(problem.initial_state, dtype=float),
            problem.initial_set,
            np.array(self.timing.grid),
            replace(table, rad=np.where(table.rad > 1e-290, table.rad, 0.0)),
            problem.disturbance,
            None if jumps is None else np.append(jumps, problem.horizon),
        )

    def _adjoint(self, c: Array) -> AdjointRow | Stopped:
        """That of a row ``c (d,)``, of what is integrated in a window as of two that stop."""
        if self.running is not None:
            parts = self.running.parts(c)
            rows = [(self._kept(row), until) for row, until in parts]
            if self.problem.measurable is not None and len(parts) == 2 and not (parts[0][0] + parts[1][0]).any():
                (row, end), (_, begin) = parts
                return Stopped.integral(rows, row, begin, end)
            if len(parts) > 1 or parts[0][1] < np.inf:
                return Stopped(rows, [(*rows[0], 0.0)] if len(parts) == 1 else ())
        return self._kept(c)

    def _kept(self, c: Array) -> AdjointRow:
        made, c = self._made, c + 0.0  # no -0, of which the bytes of an opposite row would be others
        if c.tobytes() not in made:
            opposite = made.get((0.0 - c).tobytes())
            made[c.tobytes()] = AdjointRow.of(self.flow, c) if opposite is None else opposite.reversed()
        return made[c.tobytes()]
