"""Changes of the control from one piece to the next, as rows of a program's image."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import final

import numpy as np
from scipy.sparse import csc_array, kron

from sparserob_core.control.constraints.control import before, differences
from sparserob_core.control.problem.dictionary import Dictionary
from sparserob_core.control.problem.problem import OptimalControlProblem
from sparserob_core.control.problem.units import power_of_two
from sparserob_core.errors import InputError
from sparserob_core.sip.convex_set import Array, ConvexSet
from sparserob_core.sip.expressions.rounding import rounding

MAX_CUTS = 60  # rounds of tangents
INTERIOR_TOLERANCE = 1e-7  # of the control's range, a point that is as good as inside


@final
@dataclass(frozen=True, eq=False)
class Steps:
    """Bounds ``lower <= H (u_{k+1} - u_k) <= upper`` of every step of a dictionary, of a set with flat sides, ``H (r,
    m)``.

    ``before (m,)``: the control before time 0, from which the first piece is a step too; ``None`` where there is none.
    ``seam``: true where the first piece follows the last one at the horizon, which is then the time of the last step.

    Opposite sides share a row. The entries of the image are ordered by the rows of ``H``, ``(r q,)`` for ``q`` steps.
    """

    H: Array
    lower: Array
    upper: Array
    dictionary: Dictionary
    before: Array | None
    seam: bool = False

    @staticmethod
    def of(problem: OptimalControlProblem, dictionary: Dictionary) -> Steps:
        """Return the steps of a problem; without rows where its steps are free, or where their set is curved."""
        H, lower, upper = pair_sides(problem.control_step, problem.system.controls)
        return Steps(H, lower, upper, dictionary, before(problem), seam(problem, dictionary))

    def divided(self, units: Array) -> Steps:
        """Return the same steps with rows divided by ``units (r,)``."""
        return replace(self, H=self.H / units[:, None], lower=self.lower / units, upper=self.upper / units)

    @property
    def times(self) -> Array:
        """Times at which the steps are taken, ``(q,)``."""
        points = self.dictionary.breakpoints
        return points[0 if self.before is not None else 1 : points.size - (not self.seam)]

    @property
    def count(self) -> int:
        """Number of entries of the image, ``r q``."""
        return int(self.upper.size * self.times.size)

    @cached_property
    def rows(self) -> csc_array:
        """Entries of the image as rows of the decision, ``(r q, m N)``."""
        changes = self.dictionary.sparse @ differences(self.dictionary.pieces, self.before is not None, self.seam)
        return csc_array(kron(csc_array(self.H), changes.T))

    def bounds(self) -> tuple[Array, Array]:
        """Return the least and the largest value of every entry of the image, ``(r q,)`` each."""
        first = np.zeros((self.upper.size, self.times.size))
        if self.before is not None:
            first[:, 0] = self.H @ self.before
        return (self.lower[:, None] + first).ravel(), (self.upper[:, None] + first).ravel()

    def priced(self, z: Array) -> list[tuple[float, Array, float]]:
        """Return the time, the normal ``(m,)`` and the multiplier of every side that has one, from the multipliers ``z
        (r q,)`` of the entries. Where a side does not exist, a multiplier is rounding and is left out."""
        table = z.reshape(self.upper.size, self.times.size)
        table = np.where(np.isfinite(np.where(table > 0.0, self.upper[:, None], self.lower[:, None])), table, 0.0)
        return [
            (float(self.times[k]), np.sign(table[row, k]) * self.H[row], abs(float(table[row, k])))
            for row, k in np.argwhere(table)
        ]


def seam(problem: OptimalControlProblem, dictionary: Dictionary) -> bool:
    """Return whether, in open loop, the first piece of the control follows the last one and is a different piece."""
    return bool(problem.repeat) and dictionary.pieces > 1


def pair_sides(convex: ConvexSet | None, dimension: int) -> tuple[Array, Array, Array]:
    """Return ``H``, ``lower`` and ``upper`` of ``lower <= H x <= upper`` for a set with flat sides, opposite sides in
    one row. The arrays have no rows for ``None`` and for a curved set."""
    flat = None if convex is None else convex.halfspaces()
    if flat is None:
        return np.zeros((0, dimension)), np.zeros(0), np.zeros(0)
    rows: dict[bytes, int] = {}
    kept: list[tuple[Array, float, float]] = []
    for normal, height in zip(*flat, strict=True):
        index = rows.get((-normal + 0.0).tobytes())
        if index is not None and kept[index][1] == -np.inf:
            kept[index] = (kept[index][0], -float(height), kept[index][2])
            continue
        rows.setdefault((normal + 0.0).tobytes(), len(kept))
        kept.append((normal, -np.inf, float(height)))
    H, lower, upper = zip(*kept, strict=True)
    return np.array(H), np.array(lower), np.array(upper)


def refuse_without_steps(problem: OptimalControlProblem, dictionary: Dictionary) -> None:
    """Raise `InputError` where no control in its set takes steps within theirs, whatever the state does.

    A control that never changes takes steps of 0. So the check is made only where 0 is no admissible step, or where the
    control before time 0 is outside the set. The check uses cutting planes (Kelley 1960). A refusal rests on tangents
    of the sets, and on multipliers that show that these cannot hold together (Farkas' lemma).
    """
    step, m = problem.control_step, problem.system.controls
    start = before(problem)
    may_stay = step is None or bool(step.contains(np.zeros(m)))
    if step is None or (may_stay and (start is None or bool(problem.control.contains(start)))):
        return
    reach = problem.control.reach(np.eye(m))
    K, units = 1 if may_stay else dictionary.pieces, power_of_two(reach)
    steps = differences(K, start is not None).toarray().T
    first = np.zeros((len(steps), m)) if start is None else np.vstack([-start / units, np.zeros((K - 1, m))])
    constraints = [(problem.control.in_units(units), np.eye(K), np.zeros((K, m))), (step.in_units(units), steps, first)]
    if _has_infeasible_tangents(constraints, np.tile(reach / units, K)):
        condition = "" if start is None else f" and begins at the initial_control {start.tolist()}"
        raise InputError(f"no control that stays in its set{condition} changes by such steps only", path="control_step")


def _has_infeasible_tangents(held: list[tuple[ConvexSet, Array, Array]], reach: Array) -> bool:
    """Return whether multipliers show that no ``u (K, m)``, with entries of at most ``reach (K m,)``, has every row of
    ``M u + offset`` within tangents of its set, for all ``(set, M, offset)``."""
    from scipy.optimize import linprog

    rows: list[Array] = []
    heights: list[float] = []
    m, n = held[0][0].dimension, reach.size
    axes = np.vstack([np.eye(m), -np.eye(m)])
    cuts = [(convex, M, offset, index, c) for convex, M, offset in held for index in range(len(M)) for c in axes]
    for _ in range(MAX_CUTS):
        for convex, M, offset, index, c in cuts:
            height = float(convex.support(c[None])[0])
            if np.isfinite(height):
                rows.append(np.kron(M[index], c))
                heights.append(height - float(c @ offset[index]))
        wider = np.column_stack([rows, -np.ones(len(rows))])  # the last variable: by how much rows are missed
        limits = [(None, None)] * n + [(0.0, None)]
        solution = linprog(np.eye(n + 1)[-1], wider, heights, bounds=limits, method="highs")
        if solution.x is None:
            return False
        if _contradict(np.array(rows), np.array(heights), np.maximum(-solution.ineqlin.marginals, 0.0), reach):
            return True
        points = [(convex, M, offset, M @ solution.x[:-1].reshape(-1, m) + offset) for convex, M, offset in held]
        cuts = []
        for convex, M, offset, at in points:
            flat = convex.halfspaces()
            outside = np.flatnonzero(convex.violation(at) > INTERIOR_TOLERANCE * (1.0 + np.abs(at).max(initial=0.0)))
            for number in outside.tolist():
                normals = convex.normal(at[[number]]) if flat is None else flat[0]
                cuts += [(convex, M, offset, number, c) for c in normals]
        if not cuts:
            return False
    return False


def _contradict(rows: Array, heights: Array, multipliers: Array, reach: Array) -> bool:
    """Return whether nonnegative ``multipliers (r,)`` prove that no ``u`` with entries of at most ``reach (n,)`` has
    ``rows u <= heights``: the sum of the rows is then above that of the heights for every such ``u``."""
    slopes, height = multipliers @ rows, float(multipliers @ heights)
    rounded = rounding(len(rows) + 8) * float(multipliers @ (np.abs(rows) @ reach + np.abs(heights)))
    return height + float(np.abs(slopes) @ reach) + rounded < 0.0
