"""What a set of a problem is in ball arithmetic: the one interface by which the checker sees sets."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Sequence
from fractions import Fraction
from functools import cached_property
from typing import TYPE_CHECKING, TypeAlias

import numpy as np

from sparserob_core.checker.arithmetic.balls import above, ball, balls
from sparserob_core.checker.outcome import RESOLVED, Broken, Unchecked
from sparserob_core.sip.convex_set import Array, ConvexSet

if TYPE_CHECKING:
    from flint import arb

# Of a set's size: what is no further off counts as no direction of its own, and a point as one of the set. Nothing
# false is believed with more of it: points are replaced by some of the set. A run's own number is a tenth of it.
NEAR = 1e-8
WRITTEN = (
    1e-13  # of a point's size, what rounding of its numbers may have moved it; a tenth is what products of norms round
)
PARALLEL = 1e-12  # of unit vectors: rows that differ by less are opposite ones
SPARE = 20  # bits of the working precision by which a point that is to be in a set is drawn inwards

Facet: TypeAlias = "tuple[Array, arb]"
"""``c'x <= b`` as ``c (d,)``, exact numbers, and ``b``."""


class Shape(ABC):
    """A kind of set, from the data of ``source`` alone: nothing that the set's own class computes is part of a claim.

    A flat set has `facets`; a curved one a `centre` and a `gauge` about it. A kind that has no answer to a question
    raises `Unchecked`.
    """

    is_box = False
    """Whether the boxes of a subdivision hold points of the set only."""

    def __init__(self, source: ConvexSet) -> None:
        self.source, self.dimension = source, source.dimension

    @abstractmethod
    def support(self, direction: Sequence[arb]) -> arb:
        """``h(c)``, ``c`` a vector of balls ``(d,)``; raises `Broken` where the set is unbounded."""

    @abstractmethod
    def holds(self, point: Sequence[arb]) -> bool:
        """Whether a point is proven to be in the set, ``(d,)`` balls."""

    def contains(self, point: Sequence[float] | Array) -> bool:
        """Whether an exact point is proven to be in the set; raises `Unchecked` for one that rounding may have taken
        out of it."""
        if self.holds(balls(point)):
            return True
        if self.member(point, WRITTEN) is not None:
            raise Unchecked(f"rounding may have taken a point out of the {self.source.kind}")
        return False

    def member(self, point: Sequence[float] | Array, near: float = NEAR) -> list[arb] | None:
        """The point of the set that an exact one stands for: itself, or one of the set next to it, since floats are
        seldom in a thin one; of a set without an interior one along its `segments`. ``None`` where there is none as
        ``near``, in parts of the size of both."""
        if self.segments is None and self.holds(balls(point)):
            return balls(point)
        found = self.nearest(np.asarray(point, dtype=float))
        if found is None:
            return None
        size = max(max(self.radius, default=0.0), float(np.abs(point).max(initial=0.0)))
        far = total(abs(a - b) for a, b in zip(found, balls(point), strict=True))
        return found if far <= near * size else None

    def nearest(self, point: Array) -> list[arb] | None:
        """A point of the set next to another one, in what its `segments` span where it has some; ``None`` of a kind
        that has no answer."""
        return None

    @property
    def segments(self) -> list[tuple[list[Fraction], Fraction]] | None:
        """Of a set without an interior, or none beside its length, vectors ``v (d,)`` along which its points differ,
        and numbers ``c`` such that its width along any ``a`` is at least ``c |a'v|``; ``None`` of others. They span
        what a part of the set is in, next to all of it."""
        return None

    @abstractmethod
    def bound(self, value: Array, spread: Array) -> tuple[Array, Array]:
        """``w (k, d)`` and ``excess (k,)`` with ``h(f) <= w'f + excess`` for every ``f`` within ``spread (k, d)`` of
        ``value (k, d)``; sharp where ``spread`` is 0."""

    @property
    def round(self) -> tuple[Array, Array] | None:
        """``m (d,)`` and ``L (d, r)`` with ``h(c) <= c'm + |L'c|``, nearly equal, where the set is round; the numbers
        are off by no more than rounding makes them."""
        return None

    @property
    def spanned(self) -> int:
        """How many of the first coordinates the set bounds, alone or in sums with others."""
        return self.dimension

    def lifted(self, directions: Array) -> Array:
        """Directions of the `spanned` coordinates ``(k, b)`` as those of the set, ``(k, d)``."""
        return directions

    # Flat sets

    @cached_property
    def facets(self) -> list[Facet] | None:
        """The facets of a flat set, ``None`` for a curved one."""
        return None

    @cached_property
    def basis(self) -> tuple[Array, Array] | None:
        """``basis (b, d)`` and ``z (k, b)`` with ``z_i'basis`` the normal of the ``i``-th facet, exactly; opposite
        normals share a row of the basis. ``None`` for a curved set."""
        if self.facets is None:
            return None
        places: dict[bytes, int] = {}
        normals, z = [c + 0.0 for c, _ in self.facets], np.zeros((len(self.facets), len(self.facets)))
        for i, c in enumerate(normals):
            opposite = places.get((-c + 0.0).tobytes())
            z[i, places.setdefault(c.tobytes(), len(places)) if opposite is None else opposite] = (
                1.0 if opposite is None else -1.0
            )
        kept = [np.frombuffer(key) for key in places]
        return np.array(kept).reshape(len(kept), self.dimension), z[:, : len(kept)]

    def shares(self, direction: Array) -> Array:
        """Numbers ``y (k,) >= 0`` with ``c`` the sum of the facets' normals times ``y``, to rounding."""
        raise Unchecked(f"the checker does not know the facets of a {self.source.kind}")

    @cached_property
    def units(self) -> list[float]:
        """The own unit of every facet of a flat set: the smallest that is not zero of how far it reaches over the set,
        the width between it and the opposite facet, and what else the kind of set names."""
        assert self.facets is not None
        return [
            smallest([width, max(_reach(self, c), _reach(self, -c)), *self._sizes(b)])
            for (c, b), width in zip(self.facets, widths(self.facets), strict=True)
        ]

    def _sizes(self, limit: arb) -> list[float]:
        return []

    # Curved sets

    @property
    def centre(self) -> Array:
        """The centre ``(d,)`` of a curved set: what its gauge is about."""
        raise Unchecked(f"the checker does not know where the middle of a {self.source.kind} is")

    def gauge(self, offsets: Sequence[arb]) -> arb:
        """How many times as large the set must be to reach ``centre + offsets``."""
        raise Unchecked(f"the checker cannot tell who is in a {self.source.kind}")

    def far(self, direction: Sequence[arb]) -> list[arb]:
        """What takes the centre to the point farthest out in a direction, nearly."""
        raise Unchecked(f"the checker does not know how far a {self.source.kind} reaches")

    def point(self, direction: Array) -> list[arb]:
        """A point of the set far out in a direction, exact numbers, proven to be in it; the middle when nothing better
        is. Floats would not do: in a thin set that is turned, a rounded point is far outside."""
        from flint import arb, ctx

        middle, far, spare = balls(self.centre), self.far(balls(direction)), arb(2) ** (SPARE - ctx.prec)
        while spare < 0.5:
            point = [(m + (1 - spare) * v).mid() for m, v in zip(middle, far, strict=True)]
            if self.holds(point):
                return point
            spare = spare * 1024
        return middle

    # All of them

    def limit(self, direction: Array) -> arb:
        """The largest ``c'x`` over the set, or a bound of it."""
        return self.support(balls(direction))

    def least(self, ups: Sequence[arb], downs: Sequence[arb], slope: Sequence[arb]) -> arb:
        """At most ``min sum_i ups_i max(u_i, 0) + downs_i max(-u_i, 0) + slope_i u_i`` over the set; ``ups`` and
        ``downs`` are not negative, and any slope between ``-down`` and ``up`` is below their part."""
        tilt = [
            s + balls([float(np.clip(-float(s), -float(down.lower()), float(up.lower())))])[0]
            for up, down, s in zip(ups, downs, slope, strict=True)
        ]
        return -self.support([-t for t in tilt])

    def towards(self, offset: Array) -> Array:
        """A normal that tells the set from a point outside."""
        return offset

    @cached_property
    def radius(self) -> list[float]:
        """Bounds of ``|w_i|`` over the set, rounded up, one per coordinate."""
        axes = np.eye(self.dimension)
        return [above(self.support(balls(axis)).max(self.support(balls(-axis)))) for axis in axes]

    def excess(self, point: Sequence[arb], beyond: Callable[[Array], arb] | None = None) -> tuple[float, str]:
        """An upper bound of how far a point may lie outside, and where: relative to the own unit of each facet (at
        least what double precision resolves), or along the gauge of a curved set; 0 when proven inside. Of a flat set
        with what may lie ``beyond`` the point along a normal."""
        if self.facets is None:
            assert beyond is None
            gauge = self.gauge([x - m for x, m in zip(point, balls(self.centre), strict=True)])
            if not gauge.is_finite():
                raise Unchecked("the size of a point cannot be bounded")
            return max(0.0, float((gauge - 1).upper())), "it"
        worst, where = 0.0, ""
        for number, ((c, b), unit) in enumerate(zip(self.facets, self.units, strict=True)):
            terms = [a * x for a, x in zip(balls(c), point, strict=True) if not a.is_zero()]
            more = total([] if beyond is None else [beyond(c)])
            unit = max(unit, RESOLVED * float((abs(b) + abs(more) + total(abs(t) for t in terms)).mid())) or 1.0
            over = float((total(terms) + more - b).upper()) / unit
            if over > worst:
                worst, where = over, _named(c, number)
        return worst, where


def _reach(shape: Shape, direction: Array) -> float:
    try:
        return abs(float(shape.support(balls(direction)).mid()))
    except (Broken, Unchecked):  # unbounded there, or nowhere cornered
        return math.inf


def _named(normal: Array, number: int) -> str:
    return f"u{int(np.abs(normal).argmax()) + 1}" if np.count_nonzero(normal) == 1 else f"row {number + 1}"


def widths(flat: Sequence[Facet]) -> list[float]:
    """For every facet how far it is from the opposite one, in its own measure; infinite where there is none."""
    normals = np.array([c for c, _ in flat]).reshape(len(flat), -1)
    sizes = np.linalg.norm(normals, axis=1)
    heights = np.array([float(b) for _, b in flat])
    turned = normals / sizes[:, None]
    answer = []
    for i in range(len(flat)):
        opposite = np.abs(turned + turned[i]).max(axis=1) <= PARALLEL
        across = heights[i] + heights[opposite] * sizes[i] / sizes[opposite]
        answer.append(float(across.min(initial=math.inf)))
    return answer


def facet(flat: Sequence[Facet], direction: Array) -> tuple[int, Fraction]:
    """Which facet a direction is the normal of, the nearest of parallel ones, and its length in terms of that normal;
    exact, and `Broken` if none."""
    place, best = int(np.abs(direction).argmax()), None
    for number, (c, b) in enumerate(flat):
        if c[place] * direction[place] <= 0.0:
            continue
        factor = Fraction(float(direction[place])) / Fraction(float(c[place]))
        if all(Fraction(float(a)) == factor * Fraction(float(b)) for a, b in zip(direction, c, strict=True)):
            height = float(b) * float(factor)
            best = min((height, number, factor), best or (np.inf, number, factor))
    if best is None:
        raise Broken(f"{np.asarray(direction).tolist()} is not the normal of a facet")
    return best[1:]


def smallest(sizes: Sequence[float]) -> float:
    """The smallest of these that is not zero; 0 when none is."""
    return min((size for size in sizes if 0.0 < size < math.inf), default=0.0)


def dot(left: Sequence[float] | Array, right: Sequence[float] | Array) -> arb:
    """The scalar product of exact numbers."""
    return total(a * b for a, b in zip(balls(left), balls(right), strict=True) if not (a.is_zero() or b.is_zero()))


def total(terms: Iterable[arb]) -> arb:
    """The sum of balls, 0 of none."""
    return sum(terms, ball(0))


def along(point: Sequence[float] | Array, direction: Sequence[arb]) -> arb:
    """The scalar product of exact numbers with balls."""
    return total(balls([a])[0] * c for a, c in zip(point, direction, strict=True) if a)
