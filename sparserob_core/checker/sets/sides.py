"""The rows to be bounded on a cell: the facets of a flat set, or the directions of a cell of a curved one."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import product
from typing import final

import numpy as np
from flint import arb

from sparserob_core.checker.arithmetic.balls import below
from sparserob_core.checker.outcome import TOLERANCE, Unchecked
from sparserob_core.checker.sets.shape import Shape, along, dot, find_inner_support_point, total
from sparserob_core.sip.convex_set import Array


@final
@dataclass(frozen=True, eq=False)
class Bounded:
    """A constraint ``(z'basis) x <= limit``, ``z (b,)``. An excess of at most `TOLERANCE` times the row's own ``unit``
    counts as none."""

    z: Array
    limit: float
    unit: float

    @property
    def slack(self) -> float:
        """The largest excess that counts as none."""
        return TOLERANCE * self.unit

    @property
    def allowed(self) -> float:
        """The limit with the slack, rounded down."""
        return float(np.nextafter(self.limit + self.slack, -np.inf))


@final
@dataclass(frozen=True, eq=False)
class Curved:
    """A curved set with the coordinates of its directions ``c = z'normals``, ``normals (b, d)``.

    ``least`` returns the least unit of a direction ``c (d,)``, from the distance between the centre and the end of the
    set along it.
    """

    shape: Shape
    normals: Array
    least: Callable[[Array, float], float]

    def bounded(self, z: Array, inside: Sequence[arb]) -> Bounded:
        """Return the constraint in one direction, with a point ``inside`` the set as its limit. Its unit is the
        distance along the direction from the centre to the point, so that an excess is judged along the gauge."""
        c = self.balls(z)
        height, middle = total(a * x for a, x in zip(c, inside, strict=True)), along(self.shape.centre, c)
        unit = max(0.0, below(height - middle))
        return self._build_row(z, below(height), unit)

    def true(self, z: Array) -> Bounded:
        """Return the constraint in one direction, with its true limit."""
        c = self.balls(z)
        height = self.shape.support(c)
        return self._build_row(z, below(height), max(0.0, below(height - along(self.shape.centre, c))))

    def _build_row(self, z: Array, limit: float, unit: float) -> Bounded:
        return Bounded(z, limit, max(unit, self.least(self.floats(z), unit)) or 1.0)

    def floats(self, z: Array) -> Array:
        """Return the direction ``c (d,)``, rounded."""
        return np.asarray(z @ self.normals, dtype=float)

    def balls(self, z: Array) -> list[arb]:
        """Return the direction ``c (d,)`` in balls."""
        return [dot(z, column) for column in self.normals.T]


@final
@dataclass(frozen=True, eq=False)
class Sides:
    """The rows of one cell; for a curved set the directions between ``low`` and ``high`` on the surface of a cube.

    ``c'x`` is convex in the direction ``c``, and ``h(c) >= w'c`` for any point ``w`` of the set. Hence it suffices to
    bound the corners of the cell, with the limit ``w'c``.
    """

    rows: Sequence[Bounded]
    curved: Curved | None = None
    low: Array | None = None
    high: Array | None = None

    @staticmethod
    def cell(curved: Curved, low: Array, high: Array) -> Sides:
        """Return the rows of a curved set on the cell of directions ``[low, high]``."""
        w = find_inner_support_point(curved.shape, curved.floats((low + high) / 2))
        free = np.flatnonzero(high > low)
        rows = []
        for ends in product((0, 1), repeat=free.size):
            z = low.copy()
            z[free] = np.where(np.array(ends, dtype=bool), high[free], low[free])
            rows.append(curved.bounded(z, w))
        return Sides(rows, curved, low, high)

    @property
    def centre(self) -> Bounded | None:
        """The constraint in the middle of the cell of directions, with its true limit; ``None`` for a flat set."""
        if self.curved is None or self.low is None or self.high is None:
            return None
        return self.curved.true((self.low + self.high) / 2)

    @property
    def is_wide(self) -> bool:
        """True for a cell of more than one direction; on a line a curved set has two directions and no more."""
        return self.low is not None and self.high is not None and bool((self.high > self.low).any())

    def slopes(self, tops: Sequence[float]) -> Array:
        """Return the mean difference of bounds ``tops`` between the two ends of every coordinate of the directions,
        ``(b,)``: what the bound on the cell loses."""
        assert self.low is not None and self.high is not None
        free, slopes = np.flatnonzero(self.high > self.low), np.zeros(self.low.size)
        corners = np.asarray(tops, dtype=float).reshape((2,) * free.size)
        for number, axis in enumerate(free):
            slopes[axis] = abs(float((corners.take(1, axis=number) - corners.take(0, axis=number)).mean()))
        return slopes

    def halves(self, slopes: Array) -> list[Sides]:
        """Return both halves of the cell of directions, across the coordinate of the largest of the ``slopes (b,)``."""
        assert self.curved is not None and self.low is not None and self.high is not None
        axis = int(np.where(self.high > self.low, slopes, -np.inf).argmax())
        middle = (self.low[axis] + self.high[axis]) / 2
        if not self.low[axis] < middle < self.high[axis]:
            raise Unchecked("a cell of directions cannot be halved any more")
        left_high, right_low = self.high.copy(), self.low.copy()
        left_high[axis] = right_low[axis] = middle
        return [Sides.cell(self.curved, self.low, left_high), Sides.cell(self.curved, right_low, self.high)]
