"""What is to be bounded on a cell: the facets of a flat set, or the directions of a cell of a curved one."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import product
from typing import TYPE_CHECKING, final

import numpy as np

from sparserob_core.checker.arithmetic.balls import balls, below
from sparserob_core.checker.outcome import RESOLVED, TOLERANCE, Unchecked
from sparserob_core.checker.sets.shapes import centre, dot, facets, member, support
from sparserob_core.control.sets.sets import ConvexSet, Cylinder
from sparserob_core.sip.convex_set import Array

if TYPE_CHECKING:
    from flint import arb

INSIDE = 1.0 - 1e-14  # a point that is to be in a set is drawn inwards by rounding


@final
@dataclass(frozen=True, eq=False)
class Bounded:
    """``(z'basis) x <= limit``, ``z (b,)``. An excess of at most `TOLERANCE` of the row's own ``unit`` counts as
    none."""

    z: Array
    limit: float
    unit: float

    @property
    def slack(self) -> float:
        """What counts as none."""
        return TOLERANCE * self.unit

    @property
    def allowed(self) -> float:
        """What is not to be exceeded, rounded down."""
        return float(np.nextafter(self.limit + self.slack, -np.inf))


@final
@dataclass(frozen=True, eq=False)
class Curved:
    """A curved set with the coordinates of its directions: ``c = z'normals``, ``normals (b, d)``; ``sums (d,)``: the
    largest numbers that are added up to a state."""

    shape: ConvexSet
    normals: Array
    sums: Array

    def bounded(self, z: Array, inside: Array) -> Bounded:
        """The constraint in one direction with a point ``inside`` the set as its limit. Its unit is the width of the
        set from its centre to there, so that an excess is judged along the gauge."""
        c = self.balls(z)
        height, middle = _along(c, inside), _along(c, centre(self.shape))
        unit = max(0.0, below(height - middle))
        return self._row(z, below(height), unit)

    def true(self, z: Array) -> Bounded:
        """The constraint in one direction, with its true limit."""
        c = self.balls(z)
        height = support(self.shape, c)
        return self._row(z, below(height), max(0.0, below(height - _along(c, centre(self.shape)))))

    def _row(self, z: Array, limit: float, unit: float) -> Bounded:
        return Bounded(z, limit, max(unit, RESOLVED * float(np.abs(self.floats(z)) @ self.sums)) or 1.0)

    def floats(self, z: Array) -> Array:
        """``c (d,)`` rounded."""
        return np.asarray(z @ self.normals, dtype=float)

    def balls(self, z: Array) -> list[arb]:
        """``c (d,)``."""
        return [dot(z, column) for column in self.normals.T]


@final
@dataclass(frozen=True, eq=False)
class Sides:
    """The rows of one cell. A curved set has a cell of directions between ``low`` and ``high``, on the cube's surface:
    ``c'x`` is convex in the direction and ``h(c) >= w'c`` for any point ``w`` of the set, so the corners of the cell,
    with limit ``w'c``, stand for all of it.
    """

    rows: Sequence[Bounded]
    curved: Curved | None = None
    low: Array | None = None
    high: Array | None = None

    @staticmethod
    def cell(curved: Curved, low: Array, high: Array) -> Sides:
        """The cell of directions ``[low, high]`` of a curved set."""
        w = _point(curved.shape, curved.floats((low + high) / 2))
        free = np.flatnonzero(high > low)
        rows = []
        for ends in product((0, 1), repeat=free.size):
            z = low.copy()
            z[free] = np.where(np.array(ends, dtype=bool), high[free], low[free])
            rows.append(curved.bounded(z, w))
        return Sides(rows, curved, low, high)

    @property
    def centre(self) -> Bounded | None:
        """The constraint in the middle of the cell of directions, with its true limit."""
        if self.curved is None or self.low is None or self.high is None or not (self.high > self.low).any():
            return None
        return self.curved.true((self.low + self.high) / 2)

    def halves(self) -> list[Sides]:
        """Both halves of the cell of directions, across its widest coordinate."""
        assert self.curved is not None and self.low is not None and self.high is not None
        axis = int((self.high - self.low).argmax())
        middle = (self.low[axis] + self.high[axis]) / 2
        if not self.low[axis] < middle < self.high[axis]:
            raise Unchecked("a cell of directions cannot be halved any more")
        left, right = self.high.copy(), self.low.copy()
        left[axis] = right[axis] = middle
        return [Sides.cell(self.curved, self.low, left), Sides.cell(self.curved, right, self.high)]


def flat_basis(shape: ConvexSet) -> tuple[Array, Array] | None:
    """``basis (b, d)`` and ``z (k, b)`` with ``z_i'basis`` the normal of the ``i``-th facet, exactly; opposite normals
    share a row of the basis. ``None`` for a curved set."""
    found = facets(shape)
    if found is None:
        return None
    places: dict[bytes, int] = {}
    normals, z = [c + 0.0 for c, _ in found], np.zeros((len(found), len(found)))
    for i, c in enumerate(normals):
        opposite = places.get((-c + 0.0).tobytes())
        z[i, places.setdefault(c.tobytes(), len(places)) if opposite is None else opposite] = (
            1.0 if opposite is None else -1.0
        )
    kept = [np.frombuffer(key) for key in places]
    return np.array(kept).reshape(len(kept), shape.dimension), z[:, : len(kept)]


def _along(c: Sequence[arb], point: Array) -> arb:
    return sum((a * x for a, x in zip(c, balls(point), strict=True)), balls([0.0])[0])


def _point(shape: ConvexSet, direction: Array) -> Array:
    """A point of the set far out in a direction, proven to be in it; the middle when nothing better is."""
    base = shape.base if isinstance(shape, Cylinder) else shape
    middle = centre(base)
    far = base.support_point(direction[None, : base.dimension])[0]
    share, rest = INSIDE, np.zeros(shape.dimension - base.dimension)
    while share > 0.5:
        point: Array = middle + share * (far - middle)
        if member(base, point):
            return np.concatenate([point, rest])
        share = 1.0 - 10.0 * (1.0 - share)
    return np.concatenate([middle, rest])
