"""What is to be bounded on a cell: the facets of a flat set, or the directions of a cell of a curved one."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import product
from typing import TYPE_CHECKING, final

import numpy as np

from sparserob_core.checker.arithmetic.balls import below
from sparserob_core.checker.sets.shapes import dot, facets, member, support
from sparserob_core.control.sets.sets import ConvexSet, Cylinder
from sparserob_core.sip.convex_set import Array

if TYPE_CHECKING:
    pass

INSIDE = 1.0 - 1e-14  # a point that is to be in a set is drawn inwards by rounding


@final
@dataclass(frozen=True, eq=False)
class Bounded:
    """``direction'x <= limit``."""

    direction: Array
    limit: float


@final
@dataclass(frozen=True, eq=False)
class Sides:
    """The rows of one cell. A curved set has a cell of directions between ``low`` and ``high``, on the cube's surface:
    ``c'x`` is convex in the direction and ``h(c) >= w'c`` for any point ``w`` of the set, so the corners of the cell,
    with limit ``w'c``, stand for all of it.
    """

    rows: Sequence[Bounded]
    shape: ConvexSet | None = None
    low: Array | None = None
    high: Array | None = None

    @staticmethod
    def flat(shape: ConvexSet) -> Sides | None:
        """The facets of a flat set; ``None`` for a curved one."""
        found = facets(shape)
        return None if found is None else Sides([Bounded(c, below(b)) for c, b in found])

    @staticmethod
    def curved(shape: ConvexSet, low: Array, high: Array) -> Sides:
        """The cell of directions ``[low, high]`` of a curved set."""
        centre = (low + high) / 2
        w = _point(shape, centre)
        free = np.flatnonzero(high > low)
        rows = []
        for ends in product((0, 1), repeat=free.size):
            z = low.copy()
            z[free] = np.where(np.array(ends, dtype=bool), high[free], low[free])
            rows.append(Bounded(_direction(shape, z), below(dot(z, w))))
        return Sides(rows, shape, low, high)

    @property
    def centre(self) -> Bounded | None:
        """The constraint in the middle of the cell of directions, with its true limit."""
        from flint import arb

        if self.shape is None or self.low is None or self.high is None or not (self.high > self.low).any():
            return None
        c = _direction(self.shape, (self.low + self.high) / 2)
        return Bounded(c, below(support(self.shape, [arb(float(v)) for v in c])))

    def halves(self) -> list[Sides]:
        """Both halves of the cell of directions, across its widest coordinate."""
        assert self.shape is not None and self.low is not None and self.high is not None
        axis = int((self.high - self.low).argmax())
        middle = (self.low[axis] + self.high[axis]) / 2
        left, right = self.high.copy(), self.low.copy()
        left[axis] = right[axis] = middle
        return [Sides.curved(self.shape, self.low, left), Sides.curved(self.shape, right, self.high)]


def _direction(shape: ConvexSet, z: Array) -> Array:
    return np.concatenate([z, np.zeros(shape.dimension - z.size)])


def _point(shape: ConvexSet, direction: Array) -> Array:
    """A point of the set far out in a direction, proven to be in it; the middle when nothing better is."""
    base = shape.base if isinstance(shape, Cylinder) else shape
    middle = getattr(base, "centre")  # noqa: B009  every curved set has one
    far = base.support_point(direction[None])[0]
    share = INSIDE
    while share > 0.5:
        point: Array = middle + share * (far - middle)
        if member(base, point):
            return point
        share = 1.0 - 10.0 * (1.0 - share)
    return np.asarray(middle, dtype=float)
