"""Disturbances of a list that stay what they are for several of the pieces on which all of them are constant."""

from __future__ import annotations

from bisect import bisect_right
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, final

import numpy as np

from sparserob_core.checker.arithmetic.balls import ball
from sparserob_core.checker.outcome import Unchecked
from sparserob_core.checker.sets.polynomials import OUTWARD, rounding
from sparserob_core.control.problem.dictionary import Dictionary
from sparserob_core.control.sets.sets import Product
from sparserob_core.sip.convex_set import Array

if TYPE_CHECKING:
    from flint import arb

    from sparserob_core.control.problem.problem import OptimalControlProblem

SAME = 1e-12  # of the horizon, two breakpoints that are one but for rounding, as in a problem's records


def on_one_grid(problem: OptimalControlProblem, dictionary: Dictionary) -> tuple[OptimalControlProblem, Dictionary]:
    """A problem of which every disturbance of the list has breakpoints, those of the ``dictionary`` where it had none,
    and the dictionary of the pieces on which all of them are constant."""
    if not dictionary.is_complete:
        raise Unchecked("beside breakpoints the checker knows dictionaries that take any value on each piece")
    assert problem.disturbance_breakpoints is not None
    plain = dictionary.merged().breakpoints
    own = tuple(plain if one is None else one for one in problem.disturbance_breakpoints)
    joint: list[float] = []
    for time in sorted({time for times in own for time in times[:-1].tolist()}):
        if not joint or time - joint[-1] > SAME * problem.horizon:
            joint.append(time)
    return replace(problem, disturbance_breakpoints=own), Dictionary.indicators([*joint, dictionary.horizon])


@final
@dataclass(frozen=True, eq=False)
class Lasting:
    """The breakpoints ``changes`` of the pieces, without the horizon, and for the components ``columns`` of every part
    the first pieces of its own, ``firsts``: what all pieces of one of these give to a row is given to the first, since
    it has one value on all of them."""

    changes: list[float]
    parts: tuple[tuple[slice, np.ndarray], ...]

    @staticmethod
    def of(problem: OptimalControlProblem, changes: list[float]) -> Lasting | None:
        """Those of a problem `on_one_grid`, whose disturbance may jump at the ``changes``; ``None`` where no part of it
        has breakpoints of its own."""
        if problem.disturbance_breakpoints is None:
            return None
        if not isinstance(problem.disturbance, Product):
            raise Unchecked("of disturbances with breakpoints of their own, the checker knows lists of sets only")
        parts, column = [], 0
        for part, times in zip(problem.disturbance.parts, problem.disturbance_breakpoints, strict=True):
            assert times is not None
            slack = SAME * problem.horizon
            firsts = [bisect_right(changes, time + slack) - 1 for time in times[:-1].tolist()]
            parts.append((slice(column, column + part.dimension), np.array(firsts)))
            column += part.dimension
        return Lasting(changes, tuple(parts))

    def gathered(self, mid: Array, rad: Array) -> tuple[Array, Array]:
        """What the first pieces ``(pieces, ..., mw, b)`` of all add per unit, with errors of the same shape, as what
        the components add that have one value for several of them."""
        mid, rad = mid.copy(), rad.copy()
        for columns, firsts in self.parts:
            begun = firsts[firsts < mid.shape[0]]
            here, off = mid[..., columns, :], rad[..., columns, :]
            off = off + rounding(mid.shape[0]) * np.abs(here)
            here, off = (np.add.reduceat(one, begun, axis=0) for one in (here, off))
            mid[..., columns, :], rad[..., columns, :] = 0.0, 0.0
            mid[begun, ..., columns, :], rad[begun, ..., columns, :] = here, off * OUTWARD
        return mid, rad

    def may_jump(self, time: float) -> np.ndarray:
        """Which components ``(mw,)`` may have another value from a time on."""
        piece = bisect_right(self.changes, time) - 1
        begins = self.changes[piece] == time
        return np.concatenate([np.full(one.stop - one.start, begins and piece in firsts) for one, firsts in self.parts])


def summed(lasting: Lasting | None, weights: Sequence[Sequence[arb]]) -> list[list[arb]]:
    """`Lasting.gathered` of weights ``(mw,)`` on every piece, exactly; as they are where no component lasts longer."""
    found = [list(one) for one in weights]
    for columns, firsts in () if lasting is None else lasting.parts:
        first = 0
        for piece in range(len(found)):
            first = piece if piece in firsts else first
            for j in range(columns.start, columns.stop) if piece != first else ():
                found[first][j], found[piece][j] = found[first][j] + found[piece][j], ball(0)
    return found
