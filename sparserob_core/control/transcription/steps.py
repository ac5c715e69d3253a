"""The change of the control from one piece to the next, as rows of a program's image."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING, final

import numpy as np

from sparserob_core.control.constraints.control import before, differences
from sparserob_core.control.problem.dictionary import Dictionary
from sparserob_core.control.problem.problem import OptimalControlProblem
from sparserob_core.control.problem.units import power_of_two
from sparserob_core.errors import InputError
from sparserob_core.sip.convex_set import Array, ConvexSet

if TYPE_CHECKING:
    from scipy.sparse import csc_array

MOST_CUTS = 60  # rounds of tangents
CLOSE = 1e-7  # of the control's range, a point that is as good as inside


@final
@dataclass(frozen=True, eq=False)
class Steps:
    """``lower <= H (u_{k+1} - u_k) <= upper`` of a set with flat sides, ``H (r, m)``, for every step of a dictionary;
    ``before (m,)``: the control from which the first piece is a step too, ``None`` where there is none. ``seam``:
    whether the first piece follows the last one, at the horizon, which is then the last of the steps.

    Opposite sides share a row; the image's entries are those of one row of ``H`` after another, ``(r q,)`` for ``q``
    steps.
    """

    H: Array
    lower: Array
    upper: Array
    dictionary: Dictionary
    before: Array | None
    seam: bool = False

    @staticmethod
    def of(problem: OptimalControlProblem, dictionary: Dictionary) -> Steps:
        """Those of a problem: none where its steps are free, or their set is curved."""
        H, lower, upper = paired(problem.control_step, problem.system.controls)
        return Steps(H, lower, upper, dictionary, before(problem), seam(problem, dictionary))

    def divided(self, units: Array) -> Steps:
        """The same with rows divided by ``units (r,)``."""
        return replace(self, H=self.H / units[:, None], lower=self.lower / units, upper=self.upper / units)

    @property
    def times(self) -> Array:
        """When the steps are taken, ``(q,)``."""
        points = self.dictionary.breakpoints
        return points[0 if self.before is not None else 1 : points.size - (not self.seam)]

    @property
    def count(self) -> int:
        """How many entries of the image there are, ``r q``."""
        return int(self.upper.size * self.times.size)

    @cached_property
    def rows(self) -> csc_array:
        """The entries as rows of the decision, ``(r q, m N)``."""
        from scipy.sparse import csc_array, kron

        changes = self.dictionary.sparse @ differences(self.dictionary.pieces, self.before is not None, self.seam)
        return csc_array(kron(csc_array(self.H), changes.T))

    def bounds(self) -> tuple[Array, Array]:
        """The least and the largest value of every entry, ``(r q,)`` each."""
        first = np.zeros((self.upper.size, self.times.size))
        if self.before is not None:
            first[:, 0] = self.H @ self.before
        return (self.lower[:, None] + first).ravel(), (self.upper[:, None] + first).ravel()

    def priced(self, z: Array) -> list[tuple[float, Array, float]]:
        """Time, normal ``(m,)`` and multiplier of every side that multipliers ``z (r q,)`` of the entries stand for; a
        side that there is not has none, where its multiplier is rounding."""
        table = z.reshape(self.upper.size, self.times.size)
        table = np.where(np.isfinite(np.where(table > 0.0, self.upper[:, None], self.lower[:, None])), table, 0.0)
        return [
            (float(self.times[k]), np.sign(table[row, k]) * self.H[row], abs(float(table[row, k])))
            for row, k in np.argwhere(table)
        ]


def seam(problem: OptimalControlProblem, dictionary: Dictionary) -> bool:
    """Whether the first piece of a control that answers nothing follows the last one, and is another."""
    return bool(problem.repeat) and dictionary.pieces > 1


def paired(convex: ConvexSet | None, dimension: int) -> tuple[Array, Array, Array]:
    """``lower <= H x <= upper`` of a set with flat sides, opposite ones in one row; nothing for none and a curved
    one."""
    flat = None if convex is None else convex.halfspaces()
    if flat is None:
        return np.zeros((0, dimension)), np.zeros(0), np.zeros(0)
    rows: dict[bytes, int] = {}
    kept: list[tuple[Array, float, float]] = []
    for normal, height in zip(*flat, strict=True):
        place = rows.get((-normal + 0.0).tobytes())
        if place is not None and kept[place][1] == -np.inf:
            kept[place] = (kept[place][0], -float(height), kept[place][2])
            continue
        rows.setdefault((normal + 0.0).tobytes(), len(kept))
        kept.append((normal, -np.inf, float(height)))
    H, lower, upper = zip(*kept, strict=True)
    return np.array(H), np.array(lower), np.array(upper)


def refuse_without_steps(problem: OptimalControlProblem, dictionary: Dictionary) -> None:
    """Raise `InputError` where no control in its set takes steps within theirs, whatever the state does.

    A control that never changes takes steps of 0, so that this is looked at only where 0 is no step, or the control
    before time 0 is none of the set. By cutting planes (Kelley 1960): what is refused here is proven.
    """
    step, m = problem.control_step, problem.system.controls
    start = before(problem)
    still = step is None or bool(step.contains(np.zeros(m)))
    if step is None or (still and (start is None or bool(problem.control.contains(start)))):
        return
    K, units = 1 if still else dictionary.pieces, power_of_two(problem.control.reach(np.eye(m)))
    steps = differences(K, start is not None).toarray().T
    first = np.zeros((len(steps), m)) if start is None else np.vstack([-start / units, np.zeros((K - 1, m))])
    held = [(problem.control.in_units(units), np.eye(K), np.zeros((K, m))), (step.in_units(units), steps, first)]
    if _cut_off(held, K, m):
        known = "" if start is None else f" and begins at the initial_control {start.tolist()}"
        raise InputError(f"no control that stays in its set{known} changes by such steps only", path="control_step")


def _cut_off(held: list[tuple[ConvexSet, Array, Array]], K: int, m: int) -> bool:
    """Whether tangents show that no ``u (K, m)`` has every row of ``M u + offset`` in its set, for all ``(set, M,
    offset)``."""
    from scipy.optimize import linprog

    rows: list[Array] = []
    heights: list[float] = []
    axes = np.vstack([np.eye(m), -np.eye(m)])
    cuts = [(convex, M, offset, place, c) for convex, M, offset in held for place in range(len(M)) for c in axes]
    for _ in range(MOST_CUTS):
        for convex, M, offset, place, c in cuts:
            height = float(convex.support(c[None])[0])
            if np.isfinite(height):
                rows.append(np.kron(M[place], c))
                heights.append(height - float(c @ offset[place]))
        found = linprog(np.zeros(K * m), rows, heights, bounds=(None, None), method="highs")
        if found.status == 2:
            return True
        if found.x is None:
            return False
        points = [(convex, M, offset, M @ found.x.reshape(K, m) + offset) for convex, M, offset in held]
        cuts = []
        for convex, M, offset, at in points:
            flat = convex.halfspaces()
            outside = np.flatnonzero(convex.violation(at) > CLOSE * (1.0 + np.abs(at).max(initial=0.0)))
            for number in outside.tolist():
                normals = convex.normal(at[[number]]) if flat is None else flat[0]
                cuts += [(convex, M, offset, number, c) for c in normals]
        if not cuts:
            return False
    return False
