"""Polytopes in fractions: their vertices, and simplices that cover them."""

from __future__ import annotations

from collections.abc import Sequence
from fractions import Fraction
from itertools import combinations
from math import comb
from typing import TypeAlias

import numpy as np

from sparserob_core.shapes import Array

Point: TypeAlias = "tuple[Fraction, ...]"
Simplex: TypeAlias = "tuple[Point, ...]"

MAX_MEETINGS = 20_000  # meetings of rows that are tried as vertices: a second or two
REGULAR = 1e-12  # determinant of unit rows from which on their meeting is known to a thousandth
# Relative violation of a row by a meeting, above which fractions are not needed to exclude it; and what rounding moves
# a meeting by, times its determinant, with room for six coordinates.
VIOLATED, MOVED = 1e-9, 1e-12


def exact(numbers: Array) -> list[list[Fraction]]:
    """Return the rows of a matrix of doubles as fractions."""
    return [[Fraction(float(x)) for x in row] for row in numbers]


def find_vertices(H: Array, h: Array) -> list[Point] | None:
    """Return the vertices of ``{x : H x <= h}``, sorted; ``None`` where more than `MAX_MEETINGS` would be tried.

    A vertex is a point at which ``d`` rows meet and which no row excludes.

    Parameters
    ----------
    H : array (r, d)
        The normals, none of which is 0.
    h : array (r,)
        The right-hand sides.
    """
    (count, d), norms = H.shape, np.linalg.norm(H, axis=1)
    if comb(count, d) > MAX_MEETINGS:
        return None
    choices = np.array(list(combinations(range(count), d)), dtype=int).reshape(-1, d)
    normals, ends = (H / norms[:, None])[choices], (h / norms)[choices]
    sizes = np.abs(np.linalg.det(normals))
    is_regular = sizes > REGULAR
    points = np.linalg.solve(normals[is_regular], ends[is_regular][..., None])[..., 0]
    doubt = VIOLATED + MOVED / sizes[is_regular]
    is_outside = points @ H.T - h > doubt[:, None] * (np.abs(points) @ np.abs(H).T + np.abs(h))
    candidates = np.concatenate([choices[is_regular][~is_outside.any(axis=1)], choices[~is_regular]])
    rows, sides = exact(H), [Fraction(float(side)) for side in h]
    meetings = {_intersect_hyperplanes([rows[i] for i in choice], [sides[i] for i in choice]) for choice in candidates}
    return sorted(
        x for x in meetings if x is not None and all(dot(row, x) <= side for row, side in zip(rows, sides, strict=True))
    )


def dot(row: Sequence[Fraction], point: Sequence[Fraction]) -> Fraction:
    """Return the product of a row and a point."""
    return sum((a * b for a, b in zip(row, point, strict=True)), Fraction(0))


def _intersect_hyperplanes(rows: Sequence[Sequence[Fraction]], ends: Sequence[Fraction]) -> Point | None:
    """Return the point at which ``d`` hyperplanes meet, by Gauss-Jordan elimination; ``None`` where it is not unique.

    Parameters
    ----------
    rows : d sequences of d fractions
        The normals of the hyperplanes.
    ends : sequence of d fractions
        The right-hand sides.
    """
    augmented = [[*row, end] for row, end in zip(rows, ends, strict=True)]
    for i in range(len(augmented)):
        pivot = next((k for k in range(i, len(augmented)) if augmented[k][i]), None)
        if pivot is None:
            return None
        augmented[i], augmented[pivot] = augmented[pivot], augmented[i]
        augmented[i] = [x / augmented[i][i] for x in augmented[i]]
        for k, row in enumerate(augmented):
            if k != i and row[i]:
                augmented[k] = [a - row[i] * b for a, b in zip(row, augmented[i], strict=True)]
    return tuple(row[-1] for row in augmented)


def triangulate(H: Array, h: Array, vertices: Sequence[Point]) -> list[Simplex]:
    """Return simplices that cover the polytope ``{x : H x <= h}`` with these vertices and meet in common faces.

    Every face is a cone from its first vertex over those of its facets that lack it (a pulling triangulation, De Loera,
    Rambau and Santos 2010, section 4.3). No rounding is involved.
    """
    rows, sides = exact(H), [Fraction(float(side)) for side in h]
    faces = {
        frozenset(k for k, x in enumerate(vertices) if dot(row, x) == side)
        for row, side in zip(rows, sides, strict=True)
    }

    def pull(face: frozenset[int], dimension: int) -> list[tuple[int, ...]]:
        if len(face) == dimension + 1:
            return [tuple(sorted(face))]
        apex = min(face)
        facets = {face & side for side in faces if not face <= side and apex not in side}
        return [
            (apex, *simplex)
            for facet in sorted(facets, key=sorted)
            if len(facet) >= dimension and affine_dimension([vertices[k] for k in facet]) == dimension - 1
            for simplex in pull(facet, dimension - 1)
        ]

    simplices = pull(frozenset(range(len(vertices))), affine_dimension(vertices))
    return [tuple(vertices[k] for k in simplex) for simplex in simplices]


def affine_dimension(points: Sequence[Point]) -> int:
    """Return the dimension of the smallest flat through points."""
    rows = [[a - b for a, b in zip(point, points[0], strict=True)] for point in points[1:]]
    rank = 0
    for column in range(len(points[0])):
        pivot = next((k for k in range(rank, len(rows)) if rows[k][column]), None)
        if pivot is None:
            continue
        rows[rank], rows[pivot] = rows[pivot], rows[rank]
        for k in range(rank + 1, len(rows)):
            share = rows[k][column] / rows[rank][column]
            rows[k] = [a - share * b for a, b in zip(rows[k], rows[rank], strict=True)]
        rank += 1
    return rank
