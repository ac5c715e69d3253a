"""A curved set along the trajectories of a closed loop, for all directions of a cell at once, in balls.

For a point ``p`` of the set, ``max c'x - h(c) <= max c'x - c'p`` for every direction ``c``, and the right side is
convex in ``c``: on a cell of directions it is largest at a corner.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from itertools import product
from typing import TYPE_CHECKING, final

import numpy as np

from sparserob_core.checker.arithmetic.balls import balls
from sparserob_core.checker.outcome import TOLERANCE, Broken
from sparserob_core.checker.reach.closed_loop import ClosedLoop
from sparserob_core.checker.reach.flow import stacked
from sparserob_core.checker.sets.shape import Shape, along
from sparserob_core.sip.convex_set import Array

if TYPE_CHECKING:
    from flint import arb, arb_mat

Corner = tuple[float, ...]


@final
@dataclass(frozen=True, eq=False)
class Directions:
    """The directions ``z'normals``, ``z`` in a cube, ``normals (b, d)``, of a curved set that the state of a loop must
    stay in; or of what else is ``held`` in it, by how far that comes at a place, by number, along rows ``(r, d)``."""

    loop: ClosedLoop
    shape: Shape
    normals: Array
    held: Callable[[int, arb_mat], list[arb]] | None = None
    about: Callable[[float], list[arb]] | None = None
    """Where the set is at a time; at rest where there is none."""
    _known: dict[tuple[int, float, Corner], arb] = field(default_factory=dict, repr=False)

    def over(
        self, piece: int, start: float, stop: float, low: Array, high: Array
    ) -> tuple[float, float, tuple[float, float]]:
        """By how much the set is left at most on a cell of times, within a piece of the grid, and of directions; what
        of that counts as none; and how much of it is owed to the length of the cell and to its width. Raises `Broken`
        where the set is certainly left by more."""
        corners = sorted({*product(*zip(low.tolist(), high.tolist(), strict=True))})
        p = self.shape.point((low + high) / 2 @ self.normals)
        rows = [self._direction(z) for z in corners]
        late = np.zeros(len(rows)) if self.held else self.loop.bent(piece, start, stop, stacked(rows))
        worst, wide, room = -np.inf, 0.0, np.inf
        for z, c, bent in zip(corners, rows, late.tolist(), strict=True):
            tangent = _dot(p, c)
            height = max((self._height(piece, t, z, c) for t in (start, stop)), key=lambda value: float(value.upper()))
            worst = max(worst, float((height - tangent).upper()) + bent)
            wide = max(wide, float((self.shape.support(c) - tangent).upper()))
            room = min(room, float((tangent - along(self.shape.centre, c)).lower()))
        return worst, TOLERANCE * max(room, 0.0), (float(late.max()), wide)

    def _direction(self, z: Corner) -> list[arb]:
        return [_dot(balls(z), balls(column)) for column in self.normals.T]

    def _height(self, piece: int, time: float, z: Corner, c: list[arb]) -> arb:
        """``max c'x`` at a time."""
        key = piece, time, z
        if key not in self._known:
            row = stacked([c])
            every = self.loop.heights(self.loop.state(piece, time), row) if self.held is None else self.held(piece, row)
            (found,) = every
            found = found if self.about is None else found - _dot(self.about(time), c)
            limit = self.shape.support(c)
            room = limit - along(self.shape.centre, c)
            if found - limit > room * TOLERANCE:
                raise Broken(f"it is left at t = {time:.6g}, by {float((found - limit).mid()):.1e}")
            self._known[key] = found
        return self._known[key]


def _dot(left: list[arb], right: list[arb]) -> arb:
    from flint import arb

    return sum((a * b for a, b in zip(left, right, strict=True)), arb(0))
