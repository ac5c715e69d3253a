"""How far along a ray from its middle a convex set reaches, and its outward normal there."""

from __future__ import annotations

import numpy as np

from sparserob_core.control.sets.curved import Ellipsoid, NormBall
from sparserob_core.sip.convex_set import Array, ConvexSet
from sparserob_core.sip.relaxed.index_gradient import differences

HALVINGS = 50


def shares(convex: ConvexSet, points: Array) -> Array:
    """The largest ``s <= 1 (k,)`` with ``middle + s (point - middle)`` in the set, for points ``(k, d)`` and the set's
    interior point."""
    middle = convex.interior_point()
    rays = points - middle
    if isinstance(convex, Ellipsoid):
        return _reached(np.linalg.norm(np.linalg.solve(convex.factor, rays.T), axis=0), 1.0)
    if isinstance(convex, NormBall):
        return _reached(np.linalg.norm(rays, ord=convex.p, axis=1), convex.radius)
    flat = convex.halfspaces()
    if flat is None:
        return _bisected(convex, middle, rays)
    return np.asarray(_reached(rays @ flat[0].T, flat[1] - flat[0] @ middle).min(axis=1, initial=1.0))


def outward(convex: ConvexSet, points: Array) -> Array:
    """Outward normals ``(k, d)``, of any length, at points of the boundary; one of them at a corner."""
    if isinstance(convex, Ellipsoid):
        return np.asarray(np.linalg.solve(convex.shape, (points - convex.centre).T).T)
    if isinstance(convex, NormBall) and convex.p < np.inf:
        z = (points - convex.centre) / (convex.radius or 1.0)
        return np.asarray(np.sign(z) * np.abs(z) ** (convex.p - 1.0))
    flat = convex.halfspaces()
    if flat is None:
        radius = np.full(convex.dimension, 2.0 * convex.radius_bound)
        return differences(lambda near, _: convex.violation(near), points, -radius, radius)
    H, h = flat
    steepest = ((points @ H.T - h) / np.linalg.norm(H, axis=1)).argmax(axis=1)
    return np.asarray(H[steepest])


def _reached(sizes: Array, room: Array | float) -> Array:
    """``room / size`` where the size exceeds the room; 1 elsewhere."""
    left = np.maximum(room, 0.0)  # an interior point may be outside by rounding
    beyond = sizes > left
    answer: Array = np.where(beyond, left / np.where(beyond, sizes, 1.0), 1.0)
    return answer


def _bisected(convex: ConvexSet, middle: Array, rays: Array) -> Array:
    share = np.ones(rays.shape[0])
    outside = np.flatnonzero(~convex.contains(middle + rays, 0.0))
    low, high = np.zeros(outside.size), np.ones(outside.size)
    for _ in range(HALVINGS if outside.size else 0):
        half = (low + high) / 2
        inside = convex.contains(middle + half[:, None] * rays[outside], 0.0)
        low, high = np.where(inside, half, low), np.where(inside, high, half)
    share[outside] = low
    return share
