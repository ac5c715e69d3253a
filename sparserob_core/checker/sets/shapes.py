"""The problem's sets from their data alone: facets, support functions as balls, proven membership."""

from __future__ import annotations

import math
from fractions import Fraction
from functools import lru_cache
from itertools import combinations, product
from typing import TYPE_CHECKING

import numpy as np

from sparserob_core.checker.arithmetic.balls import above, balls, rational
from sparserob_core.checker.outcome import RESOLVED, Broken, Unchecked
from sparserob_core.control.sets.sets import Box, ConvexSet, Cylinder, Ellipsoid, NormBall, Polytope
from sparserob_core.sip.convex_set import Array

if TYPE_CHECKING:
    from collections.abc import Sequence

    from flint import arb

MOST_CORNERS = 20_000  # intersections of facets looked at when a polytope's corners are listed
KINDS = (Box, Polytope, Ellipsoid, NormBall)  # the kinds whose definitions stand here, and cylinders over them
PARALLEL = 1e-12  # of unit vectors: rows that differ by less are opposite ones
MOST_SIGNS = 10  # dimension up to which a 1-norm ball is listed by its facets


def known(shape: ConvexSet) -> None:
    """Raise `Unchecked` for a kind of set whose data the checker cannot read: nothing that such a set says of itself is
    believed, nor what a subclass of a known kind does."""
    base = shape.base if type(shape) is Cylinder else shape
    if type(base) not in KINDS:
        raise Unchecked(f"the checker does not know sets of the kind {base.kind}")


def facets(shape: ConvexSet) -> list[tuple[Array, arb]] | None:
    """``c'x <= b`` for every facet, as ``(c (d,), b)``; ``None`` for a curved set. Raises `Unchecked` for an unknown
    kind."""
    from flint import arb

    known(shape)
    if isinstance(shape, Box):
        axes = np.eye(shape.dimension)
        above = [(axes[i], arb(float(b))) for i, b in enumerate(shape.upper) if np.isfinite(b)]
        return above + [(-axes[i], -arb(float(b))) for i, b in enumerate(shape.lower) if np.isfinite(b)]
    if isinstance(shape, Polytope):
        return [(c, arb(float(b))) for c, b in zip(shape.H, shape.h, strict=True)]
    if isinstance(shape, NormBall) and (
        shape.dimension == 1 or shape.p == np.inf or (shape.p == 1.0 and shape.dimension <= MOST_SIGNS)
    ):
        axes = np.eye(shape.dimension)
        normals = (
            np.array(list(product((-1.0, 1.0), repeat=shape.dimension))) if shape.p == 1.0 else np.vstack([axes, -axes])
        )
        return [(c, dot(c, shape.centre) + arb(shape.radius)) for c in normals]
    return None


def dot(left: Sequence[float] | Array, right: Sequence[float] | Array) -> arb:
    """The scalar product of exact numbers."""
    from flint import arb

    return sum((arb(float(a)) * arb(float(b)) for a, b in zip(left, right, strict=True) if a and b), arb(0))


def support(shape: ConvexSet, direction: Sequence[arb]) -> arb:
    """``h(c)``, ``c`` a vector of balls ``(d,)``; raises `Unchecked` where the set has no such formula here."""
    from flint import arb

    known(shape)
    d = list(direction)
    if isinstance(shape, Box):
        return sum(
            (
                _interval_support(c, float(low), float(high))
                for c, low, high in zip(d, shape.lower, shape.upper, strict=True)
            ),
            arb(0),
        )
    if isinstance(shape, Ellipsoid):
        quadratic = sum(
            (d[i] * arb(float(shape.shape[i, j])) * d[j] for i in range(len(d)) for j in range(len(d))), arb(0)
        )
        return _along(shape.centre, d) + quadratic.nonnegative_part().sqrt()
    if isinstance(shape, NormBall):
        return _along(shape.centre, d) + arb(shape.radius) * _dual_norm(shape, d)
    if isinstance(shape, Cylinder):
        base = shape.base.dimension
        if any(not c.is_zero() for c in d[base:]):
            raise Broken("a direction points where its set is unbounded")
        return support(shape.base, d[:base])
    heights = [sum((rational(x) * c for x, c in zip(corner, d, strict=True)), arb(0)) for corner in corners(shape)]
    answer = heights[0]
    for height in heights[1:]:
        answer = answer.max(height)
    return answer


def _interval_support(c: arb, low: float, high: float) -> arb:
    from flint import arb

    if c.is_zero():
        return arb(0)
    if not (np.isfinite(low) and np.isfinite(high)):
        if c > 0 and np.isfinite(high):
            return c * arb(high)
        if c < 0 and np.isfinite(low):
            return c * arb(low)
        raise Broken("a direction points where its set is unbounded")
    return (arb(high) + arb(low)) / 2 * c + (arb(high) - arb(low)) / 2 * abs(c)


def _along(point: Array, d: Sequence[arb]) -> arb:
    from flint import arb

    return sum((arb(float(a)) * c for a, c in zip(point, d, strict=True) if a), arb(0))


def _dual_norm(shape: NormBall, d: Sequence[arb]) -> arb:
    from flint import arb

    sizes = [abs(c) for c in d]
    if shape.p == 1.0:
        largest = sizes[0]
        for size in sizes[1:]:
            largest = largest.max(size)
        return largest
    if shape.p == np.inf:
        return sum(sizes, arb(0))
    if shape.p == 2.0:
        return sum((c * c for c in d), arb(0)).nonnegative_part().sqrt()
    q = arb(shape.p) / (arb(shape.p) - 1)
    total = sum((_power(size, q) for size in sizes if not size.is_zero()), arb(0))
    return arb(0) if total.is_zero() else _power(total, 1 / q)


def _power(value: arb, exponent: arb) -> arb:
    """``|value|^exponent``, ``exponent > 0``, also of a ball that holds 0, for which Arb gives none."""
    from flint import arb

    size = abs(value)
    return size**exponent if size > 0 else arb(0).union(arb(size.upper()) ** exponent)


def radius(shape: ConvexSet) -> list[float]:
    """Bounds of ``|w_i|`` over the set, rounded up, one per coordinate."""
    from flint import arb

    axes = [[arb(int(i == j)) for j in range(shape.dimension)] for i in range(shape.dimension)]
    return [above(support(shape, e).max(support(shape, [-c for c in e]))) for e in axes]


def corners(shape: ConvexSet) -> tuple[tuple[Fraction, ...], ...]:
    """The corners of a bounded polytope, exactly."""
    if isinstance(shape, Polytope):
        return _meets(_key(shape.H, shape.h), ())
    raise Unchecked(f"the checker has no support function of a {type(shape).__name__}")


def arrangement(shape: ConvexSet) -> tuple[tuple[Fraction, ...], ...]:
    """The corners of the parts into which the coordinate planes cut a flat set (or one that holds it, larger by
    rounding).

    On every part an absolute sum is linear, so its least value plus a linear term is attained at one of them.
    """
    flat = facets(shape)
    assert flat is not None
    rows = tuple((*map(float, c), float(b.mid()) if b.is_exact() else above(b)) for c, b in flat)
    return _meets(rows, tuple(range(shape.dimension)))


def _key(H: Array, h: Array) -> tuple[tuple[float, ...], ...]:
    return tuple((*map(float, row), float(b)) for row, b in zip(H, h, strict=True))


@lru_cache(maxsize=64)
def _meets(rows: tuple[tuple[float, ...], ...], planes: tuple[int, ...]) -> tuple[tuple[Fraction, ...], ...]:
    """The points of ``{x : H x <= h}`` (rows ``(*H_i, h_i)``) where ``d`` of its facets and of the coordinate
    ``planes`` meet, in rational arithmetic; raises `Unchecked` when these are too many to list."""
    from math import comb

    from flint import fmpq, fmpq_mat

    d = len(rows[0]) - 1
    if comb(len(rows) + len(planes), d) > MOST_CORNERS:
        raise Unchecked(f"a polytope with {len(rows)} facets in {d} dimensions has too many corners to be listed")
    exact = [[fmpq(*Fraction(x).as_integer_ratio()) for x in row] for row in rows]
    walls = exact + [[fmpq(int(i == plane)) for i in range(d)] + [fmpq(0)] for plane in planes]
    found: set[tuple[Fraction, ...]] = set()
    for chosen in combinations(walls, d):
        matrix = fmpq_mat([row[:d] for row in chosen])
        if matrix.det() == 0:
            continue
        point = matrix.solve(fmpq_mat([[row[d]] for row in chosen]))
        x = [point[i, 0] for i in range(d)]
        if all(sum((a * b for a, b in zip(row[:d], x, strict=True)), fmpq(0)) <= row[d] for row in exact):
            found.add(tuple(Fraction(int(v.p), int(v.q)) for v in x))
    if not found:
        raise Unchecked("a polytope has no corners")
    return tuple(sorted(found))


def member(shape: ConvexSet, point: Sequence[float] | Array) -> bool:
    """Whether an exact point is proven to be in the set."""
    from flint import arb

    x = [arb(float(v)) for v in point]
    flat = facets(shape)
    if flat is not None:
        return all(bool(dot(c, point) <= b) for c, b in flat)
    if isinstance(shape, Cylinder):
        return member(shape.base, np.asarray(point)[: shape.base.dimension])
    offsets = [v - arb(float(m)) for v, m in zip(x, getattr(shape, "centre", np.zeros(len(x))), strict=True)]
    if isinstance(shape, Ellipsoid):
        from flint import arb_mat

        z = arb_mat([[arb(float(v)) for v in row] for row in shape.shape]).solve(arb_mat([[v] for v in offsets]))
        return bool(sum((v * z[i, 0] for i, v in enumerate(offsets)), arb(0)) <= 1)
    if isinstance(shape, NormBall):
        if shape.p == 2.0:
            return bool(sum((v * v for v in offsets), arb(0)) <= arb(shape.radius) ** 2)
        total = sum((abs(v) ** arb(shape.p) for v in offsets if not v.is_zero()), arb(0))
        return bool(total <= arb(shape.radius) ** arb(shape.p))
    raise Unchecked(f"the checker cannot tell who is in a {type(shape).__name__}")


def centre(shape: ConvexSet) -> Array:
    """The centre ``(d,)`` of a curved set: what its gauge is about."""
    if isinstance(shape, Cylinder):
        return np.concatenate([centre(shape.base), np.zeros(shape.dimension - shape.base.dimension)])
    if isinstance(shape, Ellipsoid | NormBall):
        return np.asarray(shape.centre, dtype=float)
    raise Unchecked(f"the checker does not know where the middle of a {type(shape).__name__} is")


def boxed(shape: ConvexSet) -> ConvexSet:
    """A ball of the maximum norm as a box, larger by rounding; any other set as it is."""
    if isinstance(shape, NormBall) and (shape.p == np.inf or shape.dimension == 1):
        return Box(
            np.nextafter(shape.centre - shape.radius, -np.inf), np.nextafter(shape.centre + shape.radius, np.inf)
        )
    return shape


def limit(shape: ConvexSet, direction: Array) -> arb:
    """The largest ``c'x`` over a set, or a bound of it; for a facet's own normal simply what the facet says."""
    flat = facets(shape)
    if flat is None or isinstance(shape, Box | NormBall):
        return support(shape, balls(direction))
    number, factor = facet(flat, direction)
    return flat[number][1] * rational(factor)


def facet(flat: Sequence[tuple[Array, arb]], direction: Array) -> tuple[int, Fraction]:
    """Which facet a direction is the normal of, the nearest of parallel ones, and its length in terms of that normal;
    exact, and `Broken` if none."""
    place, best = int(np.abs(direction).argmax()), None
    for number, (c, b) in enumerate(flat):
        if c[place] * direction[place] <= 0.0:
            continue
        factor = Fraction(float(direction[place])) / Fraction(float(c[place]))
        if all(Fraction(float(a)) == factor * Fraction(float(b)) for a, b in zip(direction, c, strict=True)):
            height = float(b.mid()) * float(factor)
            best = min((height, number, factor), best or (np.inf, number, factor))
    if best is None:
        raise Broken(f"{np.asarray(direction).tolist()} is not the normal of a facet")
    return best[1:]


def excess(shape: ConvexSet, point: Sequence[arb]) -> tuple[float, str]:
    """An upper bound of how far a point may lie outside, and where: relative to the own unit of each facet (of a
    component of a box: its range; of a row of a polytope: the smallest of its right-hand side, of how far it reaches
    over the set and, where the opposite row exists, of what is between them; at least what double precision resolves),
    or along the gauge of a curved set; 0 when proven inside."""
    from flint import arb, arb_mat

    flat = facets(shape)
    if flat is not None:
        worst, where = 0.0, ""
        for number, ((c, b), unit) in enumerate(zip(flat, units(shape), strict=True)):
            terms = [arb(float(a)) * x for a, x in zip(c, point, strict=True) if a]
            unit = max(unit, RESOLVED * float(sum((abs(t) for t in terms), abs(b)).mid())) or 1.0
            over = float((sum(terms, arb(0)) - b).upper()) / unit
            if over > worst:
                worst, where = over, _named(shape, c, number)
        return worst, where
    offsets = [x - arb(float(m)) for x, m in zip(point, centre(shape), strict=True)]
    if isinstance(shape, Ellipsoid):
        z = arb_mat([[arb(float(v)) for v in row] for row in shape.shape]).solve(arb_mat([[v] for v in offsets]))
        gauge = sum((v * z[i, 0] for i, v in enumerate(offsets)), arb(0)).nonnegative_part().sqrt()
    elif isinstance(shape, NormBall):
        total = sum((_power(v, arb(shape.p)) for v in offsets if not v.is_zero()), arb(0))
        gauge = (arb(0) if total.is_zero() else _power(total, 1 / arb(shape.p))) / arb(shape.radius)
    else:
        raise Unchecked(f"the checker cannot tell who is in a {type(shape).__name__}")
    if not gauge.is_finite():
        raise Unchecked("the size of a point cannot be bounded")
    return max(0.0, float((gauge - 1).upper())), "it"


def _named(shape: ConvexSet, normal: Array, number: int) -> str:
    return f"u{int(np.abs(normal).argmax()) + 1}" if np.count_nonzero(normal) == 1 else f"row {number + 1}"


def units(shape: ConvexSet) -> list[float]:
    """The own unit of every facet of a flat set: the smallest that is not zero of how far it reaches over the
    set, the width between it and the opposite facet, and for a row of a polytope its right-hand side."""
    flat = facets(shape)
    assert flat is not None
    answer = []
    for (c, b), width in zip(flat, widths(flat), strict=True):
        reach = max(_reach(shape, c), _reach(shape, -c))
        answer.append(smallest([width, reach, *([abs(float(b.mid()))] if isinstance(shape, Polytope) else [])]))
    return answer


def _reach(shape: ConvexSet, direction: Array) -> float:
    try:
        return abs(float(support(shape, balls(direction)).mid()))
    except (Broken, Unchecked):  # unbounded there, or nowhere cornered
        return math.inf


def widths(flat: Sequence[tuple[Array, arb]]) -> list[float]:
    """For every facet how far it is from the opposite one, in its own measure; infinite where there is none."""
    normals = np.array([c for c, _ in flat]).reshape(len(flat), -1)
    sizes = np.linalg.norm(normals, axis=1)
    heights = np.array([float(b.mid()) for _, b in flat])
    turned = normals / sizes[:, None]
    answer = []
    for i in range(len(flat)):
        opposite = np.abs(turned + turned[i]).max(axis=1) <= PARALLEL
        across = heights[i] + heights[opposite] * sizes[i] / sizes[opposite]
        answer.append(float(across.min(initial=math.inf)))
    return answer


def smallest(sizes: Sequence[float]) -> float:
    """The smallest of these that is not zero; 0 when none is."""
    return min((size for size in sizes if 0.0 < size < math.inf), default=0.0)
