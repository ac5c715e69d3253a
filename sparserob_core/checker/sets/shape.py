"""The interface of a set in ball arithmetic: the checker uses sets through it alone."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Sequence
from fractions import Fraction
from functools import cached_property
from typing import TypeAlias

import numpy as np
from flint import arb, ctx

from sparserob_core.checker.arithmetic.balls import above, ball, balls, rational
from sparserob_core.checker.arithmetic.balls import smallest as least_of
from sparserob_core.checker.outcome import RESOLVED, Broken, Unchecked
from sparserob_core.checker.sets.along import Norm, NormSummand
from sparserob_core.checker.sets.summands import Summand
from sparserob_core.sip.convex_set import Array, ConvexSet

# Relative to the size of a set: a thinner direction counts as none, and a nearer point counts as one of the set. A
# larger value makes no false claim hold, since such a point is replaced by one of the set. A run uses a tenth of it.
NEAR = 1e-8
WRITTEN = (
    1e-13  # relative rounding error of the coordinates of a written point; products of norms round by a tenth of it
)
PARALLEL = 1e-12  # unit normals whose sum is smaller are opposite ones
SPARE = 20  # a point that must be in a set is drawn inwards by at least this number of the last bits

Facet: TypeAlias = "tuple[Array, arb]"
"""A half-space ``c'x <= b``: the normal ``c (d,)`` in exact numbers, and the limit ``b``."""


class Shape(ABC):
    """A set in ball arithmetic, from the data of its ``source`` alone: no claim rests on what the set's own class
    computes.

    A flat set has `facets`; a curved one has a `centre` and a `gauge` about it. A method that a kind of set cannot
    answer raises `Unchecked`.
    """

    is_box = False
    """True where the boxes of a subdivision contain points of the set only."""

    has_limits_as_sizes = False
    """True where the limit of a facet is one of the sizes that its unit is chosen from."""

    def __init__(self, source: ConvexSet) -> None:
        self.source, self.dimension = source, source.dimension

    @abstractmethod
    def support(self, direction: Sequence[arb]) -> arb:
        """Return the support value ``h(c)`` of a direction ``c (d,)`` of balls; raise `Broken` where the set is
        unbounded."""

    @abstractmethod
    def holds(self, point: Sequence[arb]) -> bool:
        """Return True where a point, ``(d,)`` balls, is proven to be in the set."""

    def contains(self, point: Sequence[float] | Array) -> bool:
        """Return True where an exact point is proven to be in the set; raise `Unchecked` where the rounding of its
        coordinates may have moved it out of the set."""
        if self.holds(balls(point)):
            return True
        if self.member(point, WRITTEN) is not None:
            raise Unchecked(f"rounding may have taken a point out of the {self.source.kind}")
        return False

    def member(self, point: Sequence[float] | Array, near: float = NEAR) -> list[arb] | None:
        """Return the point of the set that an exact point ``(d,)`` stands for: itself, or one within ``near`` of the
        size of the set or of the point, since floats are seldom in a thin set; ``None`` where none is. In a set without
        an interior it lies in the span of the `segments`."""
        if self.segments is None and self.holds(balls(point)):
            return balls(point)
        candidate = self.nearest(np.asarray(point, dtype=float))
        if candidate is None:
            return None
        size = max(max(self.radius, default=0.0), float(np.abs(point).max(initial=0.0)))
        distance = total(abs(a - b) for a, b in zip(candidate, balls(point), strict=True))
        return candidate if distance <= near * size else None

    def nearest(self, point: Array) -> list[arb] | None:
        """Return a point of the set close to another one, in the span of the `segments` where there are some; ``None``
        for a kind of set without an answer."""
        return None

    @property
    def segments(self) -> list[tuple[list[Fraction], Fraction]] | None:
        """The vectors ``v (d,)`` along which the points of a thin set differ, each with a number ``c``; ``None`` for
        other sets. Its width along any ``a`` is at least ``c |a'v|``. The vectors span a part of the set, and the whole
        set is close to it."""
        return None

    @abstractmethod
    def bound(self, value: Array, spread: Array) -> tuple[Array, Array]:
        """Return points ``w (k, d)`` and ``excess (k,)`` with ``h(f) <= w'f + excess`` for every ``f`` within ``spread
        (k, d)`` of ``value (k, d)``. The bound is sharp where ``spread`` is 0."""

    @property
    def spanned(self) -> int:
        """The number of first coordinates that the set bounds, alone or in sums with others."""
        return self.dimension

    def lifted(self, directions: Array) -> Array:
        """Return directions ``(k, b)`` of the `spanned` coordinates as directions ``(k, d)`` of the set."""
        return directions

    def chords(self, middle: Array) -> list[arb]:
        """Return the lengths of the chords along the axes through the ``middle`` of the set: its width along any ``a``
        is at least such a length times ``|a_b|``."""
        if self.facets is None:
            raise Unchecked("the checker does not know how long the disturbance's set is along the axes")
        chords = []
        for axis in range(self.dimension):
            ends = [
                [(b - along(c, balls(middle))) / ball(abs(c[axis])) for c, b in self.facets if sign * c[axis] > 0]
                for sign in (1.0, -1.0)
            ]
            chords.append(sum(map(least_of, ends), ball(0)))
        return chords

    def spans(self, middle: Array) -> list[tuple[list[Fraction], arb]]:
        """Return vectors ``v (d,)`` that span the directions along which points of the set differ, each with a number
        ``c > 0``: the width of the set along any ``a`` is at least ``c |a'v|``. The vectors are along the axes, except
        for a set without an interior."""
        chords, axes = self.chords(middle), np.eye(self.dimension).tolist()
        widths = [width(self, channel) for channel in range(self.dimension)]
        if all(width.is_zero() or chord > NEAR * width for width, chord in zip(widths, chords, strict=True)):
            spans = zip(axes, chords, widths, strict=True)
            return [([*map(Fraction, axis)], chord) for axis, chord, width in spans if not width.is_zero()]
        if self.segments is None:
            raise Unchecked(f"the checker does not know how long the {self.source.kind} is along the axes")
        return [(vector, rational(length)) for vector, length in self.segments]

    # Flat sets

    @cached_property
    def facets(self) -> list[Facet] | None:
        """The facets of a flat set, ``None`` for a curved one."""
        return None

    def shares(self, direction: Array) -> Array:
        """Return numbers ``y (k,) >= 0`` such that the facets' normals times ``y`` add up to the direction, up to
        rounding."""
        raise Unchecked(f"the checker does not know the facets of a {self.source.kind}")

    @cached_property
    def units(self) -> list[float]:
        """The own unit of every facet of a flat set: the smallest nonzero one of the largest absolute value of ``c'x``
        over the set, the width to the opposite facet, and others that the kind of set names."""
        assert self.facets is not None
        units = []
        for (c, b), across in zip(self.facets, widths(self.facets), strict=True):
            sizes = [across, max(_estimate_support(self, c), _estimate_support(self, -c))]
            units.append(smallest([*sizes, abs(float(b))] if self.has_limits_as_sizes else sizes))
        return units

    # Curved sets

    @property
    def centre(self) -> Array:
        """The centre ``(d,)`` of a curved set, about which its gauge is defined."""
        raise Unchecked(f"the checker does not know where the middle of a {self.source.kind} is")

    def gauge(self, offsets: Sequence[arb]) -> arb:
        """Return the factor by which the set must be enlarged about its centre to contain ``centre + offsets``."""
        raise Unchecked(f"the checker cannot tell who is in a {self.source.kind}")

    def compute_support_offset(self, direction: Sequence[arb]) -> list[arb]:
        """Return balls near the offset from the centre to the point of the set farthest out in a direction."""
        raise Unchecked(f"the checker does not know how far a {self.source.kind} reaches")

    @property
    def norm(self) -> Norm | None:
        """The norm ``|L'c|_q`` with ``h(c) = c'm + |L'c|_q``, ``m`` the centre; ``None`` for other sets."""
        return None

    # All of them

    def summands(self, about: Array) -> list[Summand | NormSummand]:
        """Return sets whose sum is the set minus a point ``about (d,)``: for a box one for every channel, for a
        zonotope one for every segment and one for its centre, for a product those of its factors."""
        if self.norm is None:
            raise Unchecked(
                "the checker knows measurable disturbances in boxes, polytopes, ellipsoids, balls, zonotopes, and"
                " products of these; balls of the 1-norm in up to 10 dimensions"
            )
        return [NormSummand(self.norm, self.centre - about)]

    def limit(self, direction: Array) -> arb:
        """Return the largest ``c'x`` over the set, or an upper bound of it."""
        return self.support(balls(direction))

    def least(self, ups: Sequence[arb], downs: Sequence[arb], slope: Sequence[arb]) -> arb:
        """Return a lower bound of ``min sum_i ups_i max(u_i, 0) + downs_i max(-u_i, 0) + slope_i u_i`` over the set,
        ``ups`` and ``downs`` not negative. A linear function with any slope from ``-down`` to ``up`` is below the first
        two terms."""
        tilt = [
            s + ball(float(np.clip(-float(s), -float(down.lower()), float(up.lower()))))
            for up, down, s in zip(ups, downs, slope, strict=True)
        ]
        return -self.support([-t for t in tilt])

    def least_by(
        self, ups: Sequence[arb], downs: Sequence[arb], slope: Sequence[arb], blocks: Sequence[Sequence[int]]
    ) -> list[arb]:
        """Return numbers that add up to `least`: for a box those of every one of ``blocks``, which hold each component
        once; for another set one number."""
        return [self.least(ups, downs, slope)]

    def towards(self, offset: Array) -> Array:
        """Return a normal that separates the set from a point outside, at this ``offset (d,)`` from the centre."""
        return offset

    @cached_property
    def radius(self) -> list[float]:
        """The upper bounds of ``|w_i|`` over the set, one per coordinate, rounded up."""
        ranges = [find_range(self, channel) for channel in range(self.dimension)]
        return [above(high.max(-low)) for low, high in ranges]


def width(shape: Shape, channel: int) -> arb:
    """Return the width of a set along an axis."""
    low, high = find_range(shape, channel)
    return high - low


def find_range(shape: Shape, channel: int) -> tuple[arb, arb]:
    """Return the least and the largest value of a channel over a set."""
    axis = np.eye(shape.dimension)[channel]
    return -shape.support(balls(-axis)), shape.support(balls(axis))


def basis_of(shape: Shape) -> tuple[Array, Array] | None:
    """Return the ``basis (b, d)`` and ``z (k, b)`` where ``z_i'basis`` is exactly the normal of facet ``i``; ``None``
    for a curved set. Opposite normals share a row of the basis."""
    if shape.facets is None:
        return None
    numbers: dict[bytes, int] = {}
    normals, z = [c + 0.0 for c, _ in shape.facets], np.zeros((len(shape.facets), len(shape.facets)))
    for i, c in enumerate(normals):
        opposite = numbers.get((-c + 0.0).tobytes())
        z[i, numbers.setdefault(c.tobytes(), len(numbers)) if opposite is None else opposite] = (
            1.0 if opposite is None else -1.0
        )
    vectors = [np.frombuffer(key) for key in numbers]
    return np.array(vectors).reshape(len(vectors), shape.dimension), z[:, : len(vectors)]


def find_inner_support_point(shape: Shape, direction: Array) -> list[arb]:
    """Return a point of the set far out in a direction, in exact numbers and proven to be in the set; the centre
    where none better is. A rounded point would be far outside a thin set that is oblique to the axes."""
    middle, offset, spare = (
        balls(shape.centre),
        shape.compute_support_offset(balls(direction)),
        arb(2) ** (SPARE - ctx.prec),
    )
    while spare < 0.5:
        point = [(m + (1 - spare) * v).mid() for m, v in zip(middle, offset, strict=True)]
        if shape.holds(point):
            return point
        spare = spare * 1024
    return middle


def excess(shape: Shape, point: Sequence[arb], beyond: Callable[[Array], arb] | None = None) -> tuple[float, str]:
    """Return an upper bound of the distance by which a point, ``(d,)`` balls, may lie outside the set, and where:
    relative to the own unit of each facet, at least what double precision resolves, or along the gauge. ``beyond``
    says what is added to the value along a normal."""
    if shape.facets is None:
        assert beyond is None
        gauge = shape.gauge([x - m for x, m in zip(point, balls(shape.centre), strict=True)])
        if not gauge.is_finite():
            raise Unchecked("the size of a point cannot be bounded")
        return max(0.0, float((gauge - 1).upper())), "it"
    worst, where = 0.0, ""
    for number, ((c, b), unit) in enumerate(zip(shape.facets, shape.units, strict=True)):
        terms = [a * x for a, x in zip(balls(c), point, strict=True) if not a.is_zero()]
        extra = total([] if beyond is None else [beyond(c)])
        unit = max(unit, RESOLVED * float((abs(b) + abs(extra) + total(abs(t) for t in terms)).mid())) or 1.0
        over = float((total(terms) + extra - b).upper()) / unit
        if over > worst:
            worst, where = over, _name_facet(c, number)
    return worst, where


def _estimate_support(shape: Shape, direction: Array) -> float:
    try:
        return abs(float(shape.support(balls(direction)).mid()))
    except (Broken, Unchecked):  # unbounded in this direction, or without corners
        return math.inf


def _name_facet(normal: Array, number: int) -> str:
    return f"u{int(np.abs(normal).argmax()) + 1}" if np.count_nonzero(normal) == 1 else f"row {number + 1}"


def widths(flat: Sequence[Facet]) -> list[float]:
    """Return the distance of every facet to the opposite one, in the measure of its own normal; infinite where there is
    none."""
    normals = np.array([c for c, _ in flat]).reshape(len(flat), -1)
    sizes = np.linalg.norm(normals, axis=1)
    heights = np.array([float(b) for _, b in flat])
    unit_normals = normals / sizes[:, None]
    distances = []
    for i in range(len(flat)):
        opposite = np.abs(unit_normals + unit_normals[i]).max(axis=1) <= PARALLEL
        across = heights[i] + heights[opposite] * sizes[i] / sizes[opposite]
        distances.append(float(across.min(initial=math.inf)))
    return distances


def facet(flat: Sequence[Facet], direction: Array) -> tuple[int, Fraction]:
    """Return the number of the facet whose normal a direction is, of parallel ones the tightest, and the exact factor
    between the two; raise `Broken` where there is none."""
    index, best = int(np.abs(direction).argmax()), None
    for number, (c, b) in enumerate(flat):
        if c[index] * direction[index] <= 0.0:
            continue
        factor = Fraction(float(direction[index])) / Fraction(float(c[index]))
        if all(Fraction(float(a)) == factor * Fraction(float(b)) for a, b in zip(direction, c, strict=True)):
            height = float(b) * float(factor)
            best = min((height, number, factor), best or (np.inf, number, factor))
    if best is None:
        raise Broken(f"{np.asarray(direction).tolist()} is not the normal of a facet")
    return best[1:]


def smallest(sizes: Sequence[float]) -> float:
    """Return the smallest of the sizes that is not zero; 0 where none is."""
    return min((size for size in sizes if 0.0 < size < math.inf), default=0.0)


def dot(left: Sequence[float] | Array, right: Sequence[float] | Array) -> arb:
    """Return the scalar product of exact numbers."""
    return total(a * b for a, b in zip(balls(left), balls(right), strict=True) if not (a.is_zero() or b.is_zero()))


def total(terms: Iterable[arb]) -> arb:
    """Return the sum of balls, 0 where there are none."""
    return sum(terms, ball(0))


def along(point: Sequence[float] | Array, direction: Sequence[arb]) -> arb:
    """Return the scalar product of exact numbers with balls."""
    return total(ball(a) * c for a, c in zip(point, direction, strict=True) if a)
