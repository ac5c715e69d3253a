"""Pieces of a polytope, shown to be its parts and to cover it, in fractions."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from fractions import Fraction
from typing import TypeAlias

from sparserob_core.checker.arithmetic.balls import rationals
from sparserob_core.checker.outcome import Broken, Unchecked
from sparserob_core.sip.expressions.index_sets import Region

Point: TypeAlias = "tuple[Fraction, ...]"
Row: TypeAlias = "tuple[list[Fraction], Fraction]"


def require_cover(region: Region) -> int:
    """Return the number of simplices that are the polytope of an index set; raise `Broken` where they are not.

    Every vertex keeps all rows, so that the simplices lie in the polytope ``P``. A facet of a simplex either belongs to
    a second simplex on its other side, or lies in the plane of a row that the simplex does not lie in. A path inside
    ``P`` that avoids faces of lower dimension thus never leaves the simplices: they cover ``P``. Where they are flat,
    equalities among the rows have to say that ``P`` is.
    """
    simplices = [tuple(dict.fromkeys(piece.simplex)) for piece in region.pieces]
    rows = [
        ([Fraction(value) for value in normal], Fraction(side))
        for normal, side in zip(region.H.tolist(), region.h.tolist(), strict=True)
    ]
    for vertex in {vertex for simplex in simplices for vertex in simplex}:
        if any(_excess(row, vertex) > 0 for row in rows):
            raise Broken(f"a vertex is outside of the polytope, at {[float(value) for value in vertex]}")
    _require_dimension(simplices, rows, len(region.coupled))
    owners: dict[frozenset[Point], list[tuple[Point, tuple[Point, ...]]]] = {}
    for simplex in simplices:
        for apex, facet in _list_facets(simplex):
            owners.setdefault(frozenset(facet), []).append((apex, simplex))
    for shared, neighbours in owners.items():
        if len(neighbours) == 2:
            is_closed = _is_opposite(shared, neighbours[0][0], neighbours[1][0])
        else:
            apex = neighbours[0][0]
            is_closed = len(neighbours) == 1 and any(
                _excess(row, apex) < 0 and all(_excess(row, vertex) == 0 for vertex in shared) for row in rows
            )
        if not is_closed:
            raise Broken("the simplices leave a gap in the polytope")
    return len(simplices)


def _excess(row: Row, point: Point) -> Fraction:
    """Return by how much a point violates a row."""
    return sum((a * b for a, b in zip(row[0], point, strict=True)), -row[1])


def _list_facets(simplex: Sequence[Point]) -> Iterator[tuple[Point, tuple[Point, ...]]]:
    """Yield every vertex of a simplex with the facet of all others; none of a point."""
    for i, apex in enumerate(simplex if len(simplex) > 1 else ()):
        yield apex, (*simplex[:i], *simplex[i + 1 :])


def _require_dimension(simplices: Sequence[Sequence[Point]], rows: Sequence[Row], dimension: int) -> None:
    """Raise unless all simplices have the dimension of the polytope: that of the space, less the equalities."""
    size = len(simplices[0]) - 1
    points = [simplex[0] for simplex in simplices]
    for simplex in simplices:
        if len(simplex) != size + 1 or _rank(simplex[0], simplex[1:]) != size:
            raise Broken("a simplex of the polytope is flat")
    if _rank(points[0], [vertex for simplex in simplices for vertex in simplex]) != size:
        raise Broken("the simplices of the polytope do not lie in one plane")
    equalities = [
        normal
        for normal, side in rows
        if any(side == -end and normal == [-value for value in opposite] for opposite, end in rows)
    ]
    count = _rank((Fraction(0),) * dimension, equalities) if equalities else 0
    if size != dimension - count:
        raise Unchecked(f"rows that hold with equality: {dimension - size} are needed, {count} are in pairs")


def _rank(origin: Point, points: Sequence[Sequence[Fraction]]) -> int:
    """Return the number of independent directions from an origin to points."""
    return rationals([[a - b for a, b in zip(point, origin, strict=True)] for point in points]).rank()


def _is_opposite(facet: frozenset[Point], first: Point, second: Point) -> bool:
    """Return whether two points lie on different sides of a facet, in the plane of all of them."""
    base, *others = sorted(facet)
    steps = [[a - b for a, b in zip(point, base, strict=True)] for point in (*others, first)]
    target = [a - b for a, b in zip(second, base, strict=True)]
    columns = rationals(steps).transpose()
    normal = columns.transpose() * columns
    right = columns.transpose() * rationals([[value] for value in target])
    share = normal.solve(right)[len(others), 0]
    return bool(share < 0)
