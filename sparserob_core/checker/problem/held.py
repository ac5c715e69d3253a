"""Disturbances of a list that are held over several of the pieces on which all of them are constant."""

from __future__ import annotations

from bisect import bisect_right
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, final

import numpy as np
from flint import arb

from sparserob_core.checker.arithmetic.balls import ball
from sparserob_core.checker.outcome import Unchecked
from sparserob_core.checker.problem.timing import SAME
from sparserob_core.checker.sets.polynomials import OUTWARD, rounding
from sparserob_core.control.problem.dictionary import Dictionary
from sparserob_core.control.sets.sets import Product
from sparserob_core.sip.convex_set import Array

if TYPE_CHECKING:
    from sparserob_core.control.problem.problem import OptimalControlProblem


def on_one_grid(problem: OptimalControlProblem, dictionary: Dictionary) -> tuple[OptimalControlProblem, Dictionary]:
    """Return a problem in which every disturbance of the list has breakpoints, by default those of the ``dictionary``;
    and the dictionary of the pieces on which all are constant."""
    if not dictionary.is_complete:
        raise Unchecked("beside breakpoints the checker knows dictionaries that take any value on each piece")
    assert problem.disturbance_breakpoints is not None
    default = dictionary.merged().breakpoints
    grids = tuple(default if breakpoints is None else breakpoints for breakpoints in problem.disturbance_breakpoints)
    joint: list[float] = []
    for time in sorted({time for times in grids for time in times[:-1].tolist()}):
        if not joint or time - joint[-1] > SAME * problem.horizon:
            joint.append(time)
    return replace(problem, disturbance_breakpoints=grids), Dictionary.indicators([*joint, dictionary.horizon])


@final
@dataclass(frozen=True, eq=False)
class HeldComponents:
    """The components of a disturbance that are held over several pieces.

    ``changes`` are the breakpoints of the pieces, without the horizon. ``parts`` has for every part of the disturbance
    its ``columns``, and ``firsts``, the first piece of each of its own intervals. A component has one value on an
    interval, so that the coefficients of all its pieces are added to the first piece.
    """

    changes: list[float]
    parts: tuple[tuple[slice, np.ndarray], ...]

    @staticmethod
    def of(problem: OptimalControlProblem, changes: list[float]) -> HeldComponents | None:
        """Return the held components of a problem `on_one_grid`, whose disturbance may jump at the ``changes``;
        ``None`` where no part of it has its own breakpoints."""
        if problem.disturbance_breakpoints is None:
            return None
        if not isinstance(problem.disturbance, Product):
            raise Unchecked("of disturbances with breakpoints of their own, the checker knows lists of sets only")
        pairs, column = [], 0
        for factor, times in zip(problem.disturbance.parts, problem.disturbance_breakpoints, strict=True):
            assert times is not None
            slack = SAME * problem.horizon
            firsts = [bisect_right(changes, time + slack) - 1 for time in times[:-1].tolist()]
            pairs.append((slice(column, column + factor.dimension), np.array(firsts)))
            column += factor.dimension
        return HeldComponents(changes, tuple(pairs))

    def gathered(self, mid: Array, rad: Array) -> tuple[Array, Array]:
        """Return the coefficients ``(pieces, ..., mw, b)`` of the first pieces of the disturbance and their error
        bounds, added up over the intervals on which a component has one value. The sum is at the first piece of each,
        and 0 at the others."""
        mid, rad = mid.copy(), rad.copy()
        for columns, firsts in self.parts:
            starts = firsts[firsts < mid.shape[0]]
            values, errors = mid[..., columns, :], rad[..., columns, :]
            errors = errors + rounding(mid.shape[0]) * np.abs(values)
            values, errors = (np.add.reduceat(array, starts, axis=0) for array in (values, errors))
            mid[..., columns, :], rad[..., columns, :] = 0.0, 0.0
            mid[starts, ..., columns, :], rad[starts, ..., columns, :] = values, errors * OUTWARD
        return mid, rad

    def may_jump(self, time: float) -> np.ndarray:
        """Return which components ``(mw,)`` may have another value from a time on."""
        piece = bisect_right(self.changes, time) - 1
        is_breakpoint = self.changes[piece] == time
        return np.concatenate(
            [np.full(columns.stop - columns.start, is_breakpoint and piece in firsts) for columns, firsts in self.parts]
        )


def summed(held_components: HeldComponents | None, weights: Sequence[Sequence[arb]]) -> list[list[arb]]:
    """Return weights ``(mw,)`` on every piece, added up exactly to the first piece of the interval on which a component
    is held."""
    sums = [list(row) for row in weights]
    for columns, firsts in () if held_components is None else held_components.parts:
        first = 0
        for piece in range(len(sums)):
            first = piece if piece in firsts else first
            for j in range(columns.start, columns.stop) if piece != first else ():
                sums[first][j], sums[piece][j] = sums[first][j] + sums[piece][j], ball(0)
    return sums
