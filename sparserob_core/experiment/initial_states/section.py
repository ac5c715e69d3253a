"""The section of a convex set with a plane of two coordinates, as a polygon to be drawn."""

from __future__ import annotations

import numpy as np

from sparserob_core.sip.convex_set import Array, ConvexSet, bisect

RAYS, HALVINGS = 360, 48


def section(value: ConvexSet, origin: Array, states: tuple[int, int], middle: Array, view: float) -> Array:
    """The points ``(RAYS + k, 2)`` at which rays from ``middle (2,)``, in the set, leave the set within a distance of
    ``view``.

    ``origin (d,)``: what the coordinates other than ``states`` are. Corners of sets with flat sides are among the
    points.
    """
    angles = np.linspace(-np.pi, np.pi, RAYS, endpoint=False)
    corners = _intersect_sides(value, origin, states, middle)
    angles = np.sort(np.concatenate([angles, np.arctan2(*(corners - middle).T[::-1])]))
    rays = np.stack([np.cos(angles), np.sin(angles)], axis=1)
    points = np.tile(origin, (angles.size, 1))

    def beyond(lengths: Array) -> np.ndarray:
        points[:, list(states)] = middle + lengths[:, None] * rays
        return ~value.contains(points, 0.0)

    _, high = bisect(beyond, np.zeros(angles.size), np.full(angles.size, view), HALVINGS)
    return np.asarray(middle + high[:, None] * rays)


def _intersect_sides(value: ConvexSet, origin: Array, states: tuple[int, int], middle: Array) -> Array:
    """Return the points ``(k, 2)`` where two sides of a set with flat sides meet in the plane; none for a curved
    set."""
    flat = value.halfspaces()
    if flat is None:
        return np.zeros((0, 2))
    H, h = flat
    normals = H[:, list(states)]
    offsets = h - H @ origin + normals @ origin[list(states)]
    pairs = [(i, j) for i in range(h.size) for j in range(i) if abs(np.linalg.det(normals[[i, j]])) > 1e-12]
    corners = np.array([np.linalg.solve(normals[[i, j]], offsets[[i, j]]) for i, j in pairs]).reshape(-1, 2)
    return np.asarray(corners[np.linalg.norm(corners - middle, axis=1) > 0.0])
