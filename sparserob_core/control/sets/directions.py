"""Directions of a curved set as coordinates of an index: points on the surface of the cube ``[-1, 1]^b``."""

from __future__ import annotations

from functools import cache

import numpy as np

from sparserob_core.shapes import Float, shaped
from sparserob_core.sip.convex_set import Array, ConvexSet

# The number of sampled directions along an edge of the cube, by dimension; 3 in higher ones. A local search for the
# most violated index begins at them. With 13 and 7 in three and four dimensions a round takes four times as long and
# finds the same indices.
PER_EDGE = {1: 1, 2: 33, 3: 9, 4: 5}


@shaped
def shares(convex_set: ConvexSet, z: Float[Array, "k b"]) -> Float[Array, "k b"]:
    """Return points of the cube, each divided by the extent of the set in its direction.

    Parameters
    ----------
    convex_set : ConvexSet
        The set.
    z : array (k, b)
        Points of the cube, as coordinates of directions ``c = z N`` in the frame ``N`` of the set.

    Returns
    -------
    array (k, b)
        The points divided by ``h(c) - c'm``, where ``m`` is an interior point. Where the set has no extent, they are
        divided by the length of ``c``; 0 remains 0.
    """
    directions = convex_set.along(z)
    return np.asarray(z / _measure_extents(convex_set, directions)[:, None])


@shaped
def unit(convex_set: ConvexSet, z: Float[Array, "k b"]) -> Float[Array, "k d"]:
    """Return directions for which ``h(c) - c'm = 1``, from points of the cube.

    The excess of ``c'x`` over ``h(c)`` is then the gauge of ``x`` about the interior point ``m``, less 1, for the
    direction that is most violated.

    Parameters
    ----------
    convex_set : ConvexSet
        The set.
    z : array (k, b)
        Points of the cube.

    Returns
    -------
    array (k, d)
        The directions, in the span in which the support function is finite; 0 remains 0.
    """
    return np.asarray(convex_set.along(shares(convex_set, z)))


@shaped
def across(convex_set: ConvexSet, z: Float[Array, "k b"], slopes: Float[Array, "k b"]) -> Float[Array, "k b"]:
    """Return derivatives in points of the cube, from derivatives in their `shares`.

    Parameters
    ----------
    convex_set : ConvexSet
        The set.
    z : array (k, b)
        Points of the cube.
    slopes : array (k, b)
        The derivatives in the shares.

    Returns
    -------
    array (k, b)
        The derivatives in the points; 0 at the point 0.
    """
    directions = convex_set.along(z)
    rooms, sizes = _measure_extents(convex_set, directions), np.linalg.norm(directions, axis=1, keepdims=True)
    outwards = convex_set.support_point(directions) - convex_set.interior_point()
    flat = (outwards * directions).sum(axis=1, keepdims=True) <= 0.0
    outwards = np.where(flat, directions / np.where(sizes > 0, sizes, 1.0), outwards) @ convex_set.frame.T
    along = (z / rooms[:, None] * slopes).sum(axis=1, keepdims=True)
    return np.asarray(np.where(sizes > 0, (slopes - along * outwards) / rooms[:, None], 0.0))


@shaped
def _measure_extents(convex_set: ConvexSet, directions: Float[Array, "k d"]) -> Float[Array, " k"]:
    """Return the extent ``(k,)`` of a set from its interior point along directions ``(k, d)``.

    Where the extent is 0, the length of the direction is returned.
    """
    rooms = convex_set.support(directions) - directions @ convex_set.interior_point()
    sizes = np.linalg.norm(directions, axis=1)
    return np.asarray(np.where(rooms > 0, rooms, np.where(sizes > 0, sizes, 1.0)))


@shaped
def on_surface(z: Float[Array, "*k b"]) -> Float[Array, "*k b"]:
    """Return points ``(..., b)`` of the cube scaled to its surface; 0 remains 0."""
    size = np.abs(z).max(axis=-1, keepdims=True)
    return np.asarray(z / np.where(size > 0, size, 1.0))


@cache
def sampled(dimension: int) -> Array:
    """Return a lattice ``(k, b)`` on the surface of the cube of a ``dimension``, as a read-only array."""
    points = np.linspace(-1.0, 1.0, PER_EDGE.get(dimension, 3)) if dimension > 1 else np.array([-1.0, 1.0])
    lattice = np.stack(np.meshgrid(*[points] * dimension, indexing="ij"), axis=-1).reshape(-1, dimension)
    surface: Array = lattice[np.abs(lattice).max(axis=1) == 1.0]
    surface.flags.writeable = False
    return surface


@cache
def neighbours(dimension: int) -> np.ndarray:
    """Return the indices ``(k, j)`` of the neighbours of every one of the `sampled` directions, and of itself.

    A direction with fewer neighbours than others has its own index in the remaining places.
    """
    points = sampled(dimension)
    spacing = 2.0 / max(1, PER_EDGE.get(dimension, 3) - 1)
    rows = [np.flatnonzero(np.abs(points - point).max(axis=1) <= 1.01 * spacing) for point in points]
    indices = np.tile(np.arange(len(rows))[:, None], max(row.size for row in rows))
    for number, row in enumerate(rows):
        indices[number, : row.size] = row
    return indices


@shaped
def faces(dimension: int) -> tuple[Float[Array, "f b"], Float[Array, "f b"]]:
    """Return the faces of the cube as degenerate boxes, by their ``lower`` and ``upper`` corners ``(2 b, b)``."""
    lower, upper = -np.ones((2 * dimension, dimension)), np.ones((2 * dimension, dimension))
    for axis in range(dimension):
        lower[2 * axis, axis] = upper[2 * axis, axis] = -1.0
        lower[2 * axis + 1, axis] = upper[2 * axis + 1, axis] = 1.0
    return lower, upper
