"""The change of the control from one piece to the next, as rows of a program's image."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, final

import numpy as np

from sparserob_core.control.problem.dictionary import Dictionary
from sparserob_core.control.problem.problem import OptimalControlProblem
from sparserob_core.sip.convex_set import Array, ConvexSet

if TYPE_CHECKING:
    from scipy.sparse import csc_array


@final
@dataclass(frozen=True, eq=False)
class Steps:
    """``lower <= H (u_{k+1} - u_k) <= upper`` of a set with flat sides, ``H (r, m)``, for every step of a dictionary;
    ``before (m,)``: the control from which the first piece is a step too, ``None`` where there is none.

    Opposite sides share a row; the image's entries are those of one row of ``H`` after another, ``(r q,)`` for ``q``
    steps.
    """

    H: Array
    lower: Array
    upper: Array
    dictionary: Dictionary
    before: Array | None

    @staticmethod
    def of(problem: OptimalControlProblem, dictionary: Dictionary) -> Steps:
        """Those of a problem: none where its steps are free, or their set is curved."""
        H, lower, upper = paired(problem.control_step, problem.system.controls)
        before = None if problem.initial_control is None else np.asarray(problem.initial_control, dtype=float)
        return Steps(H, lower, upper, dictionary, before)

    def divided(self, units: Array) -> Steps:
        """The same with rows divided by ``units (r,)``."""
        return Steps(self.H / units[:, None], self.lower / units, self.upper / units, self.dictionary, self.before)

    @property
    def times(self) -> Array:
        """When the steps are taken, ``(q,)``."""
        return self.dictionary.breakpoints[0 if self.before is not None else 1 : -1]

    @property
    def count(self) -> int:
        """How many entries of the image there are, ``r q``."""
        return int(self.upper.size * self.times.size)

    @cached_property
    def rows(self) -> csc_array:
        """The entries as rows of the decision, ``(r q, m N)``."""
        from scipy.sparse import csc_array, kron

        return csc_array(kron(csc_array(self.H), csc_array(changes(self.dictionary, self.before is not None).T)))

    def bounds(self) -> tuple[Array, Array]:
        """The least and the largest value of every entry, ``(r q,)`` each."""
        first = np.zeros((self.upper.size, self.times.size))
        if self.before is not None:
            first[:, 0] = self.H @ self.before
        return (self.lower[:, None] + first).ravel(), (self.upper[:, None] + first).ravel()

    def priced(self, z: Array) -> list[tuple[float, Array, float]]:
        """Time, normal ``(m,)`` and multiplier of every side that multipliers ``z (r q,)`` of the entries stand for."""
        table = z.reshape(self.upper.size, self.times.size)
        return [
            (float(self.times[k]), np.sign(table[row, k]) * self.H[row], abs(float(table[row, k])))
            for row, k in np.argwhere(table)
        ]


def changes(dictionary: Dictionary, at_start: bool) -> Array:
    """What every function of a dictionary changes by at its steps, ``(N, q)``; ``at_start``: from 0 before time 0."""
    return np.diff(dictionary.values, axis=1, **({"prepend": 0.0} if at_start else {}))


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
