"""The landscape of ``g`` over two coordinates of a tuple of indices, the others held where the best tuple has them.

It is filled from coarse to fine by evaluations of its own: of another program, with another solver, on a grid that only
the options decide.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import final

import numpy as np

import sparserob_core as sr
from sparserob_rerun.drawing.palette import Floats

STRIDES = (8, 4, 2, 1)


@final
@dataclass(eq=False)
class Landscape:
    """One slice through an ``anchor (D, width)``: ``values (grid, grid)`` over ``first`` and ``second``, coordinates
    ``(slot, coordinate)``.

    ``values[i, j]`` belongs to ``axes[0][i]`` and ``axes[1][j]``; NaN where nothing was evaluated, ``inf`` where the
    relaxed program is infeasible. ``level`` is the stride of the finest grid that is complete, 0 before the first.
    """

    g: sr.RelaxedValue
    anchor: Floats
    first: tuple[int, int]
    second: tuple[int, int]
    grid: int
    values: Floats = field(init=False)
    axes: tuple[Floats, Floats] = field(init=False)
    level: int = 0
    spent: int = 0

    def __post_init__(self) -> None:
        self.values = np.full((self.grid, self.grid), np.nan)
        ends = [
            (self.g.slot.lower[coordinate], self.g.slot.upper[coordinate])
            for _, coordinate in (self.first, self.second)
        ]
        self.axes = tuple(np.linspace(low, high, self.grid) for low, high in ends)  # type: ignore[assignment]

    def evaluate(self) -> Iterator[bool]:
        """Evaluate one point at each step; ``True`` where a level has become complete."""
        for stride in STRIDES:
            across = np.arange(0, self.grid, stride)
            for turn, i in enumerate(across):
                # neighbours follow one another: the last optimum is a good start
                along = across if turn % 2 == 0 else across[::-1]
                for j in along:
                    if np.isnan(self.values[i, j]):
                        self.values[i, j] = self._at(int(i), int(j))
                        self.spent += 1
                        yield False
            self.level = stride
            yield True

    def _at(self, i: int, j: int) -> float:
        slots = self.anchor.copy()
        slots[self.first], slots[self.second] = self.axes[0][i], self.axes[1][j]
        value = self.g.at(slots)
        return value if not np.isnan(value) else -np.inf

    @property
    def filled(self) -> Floats:
        """The values with every gap closed by the nearest coarser point before it."""
        known = np.isfinite(self.values)
        if not known.any():
            return np.full_like(self.values, np.nan)
        shown = np.where(known, self.values, np.nan)
        for stride in reversed(STRIDES):
            origin = (np.arange(self.grid) // stride) * stride
            coarse = shown[np.ix_(origin, origin)]
            shown = np.where(np.isnan(shown), coarse, shown)
        return np.asarray(shown)

    @property
    def highest(self) -> tuple[float, float, float]:
        """The largest value so far and where it is: value, first, second."""
        i, j = np.unravel_index(
            np.nanargmax(np.where(np.isfinite(self.values), self.values, -np.inf)), self.values.shape
        )
        return float(self.values[i, j]), float(self.axes[0][i]), float(self.axes[1][j])

    def names(self) -> tuple[str, str]:
        """The two coordinates in words: ``t of index 2``; just ``t`` where a tuple has a single index."""
        single = len(self.anchor) == 1
        one, other = (
            self.g.names[c] if single else f"{self.g.names[c]} of index {slot + 1}"
            for slot, c in (self.first, self.second)
        )
        return one, other


def coordinate(name: str, g: sr.RelaxedValue, count: int) -> tuple[int, int]:
    """The place ``(slot, coordinate)`` of a name such as ``t``, ``p1`` or ``t[3]`` (that of the third index); raises
    `InputError`."""
    letter, bracket, rest = name.partition("[")
    number = rest.rstrip("]") if bracket else "1"
    if letter not in g.names or not number.isdigit() or not 1 <= int(number) <= count:
        raise sr.InputError(
            f"landscape: coordinates: there is no {name!r}; expected one of {', '.join(g.names[:6])}"
            f"{', ...' if len(g.names) > 6 else ''}, or such a name with the number of an index, t[1] to t[{count}]"
        )
    return int(number) - 1, g.names.index(letter)


def influential(g: sr.RelaxedValue, anchor: Floats, weights: Floats) -> tuple[tuple[int, int], tuple[int, int]] | None:
    """The two coordinates that are shown unless the config names others, ``None`` where fewer than two can move.

    The time of the index with the largest multiplier (``weights (D,)``), and with it: where times alone decide, the
    time of the next index; else the first parameter of the same index. Where the constraint has a fixed time, the first
    two of its other coordinates.
    """
    moves = [k for k in range(g.slot.dimension) if g.slot.upper[k] > g.slot.lower[k]]
    if not moves:
        return None
    order = np.argsort(-weights, kind="stable")
    head = int(order[0])
    parameters = [k for k in moves if g.kinds[k] in ("parameter", "index")]
    if moves[0] == 0 and not parameters and len(anchor) > 1:
        return (head, 0), (int(order[1]), 0)
    chosen = [moves[0], *(k for k in parameters if k != moves[0])] if parameters else moves
    if len(chosen) > 1:
        return (head, chosen[0]), (head, chosen[1])
    return ((head, chosen[0]), (int(order[1]), chosen[0])) if len(anchor) > 1 else None
