"""Random points of convex sets: uniform ones, and extreme ones."""

from __future__ import annotations

import numpy as np

from sparserob_core.control.sets.curved import Ellipsoid, NormBall
from sparserob_core.control.sets.polytope import Polytope
from sparserob_core.errors import InputError
from sparserob_core.sip.convex_set import Array, Box, ConvexSet

PLAIN = 3  # dimension up to which a polytope is sampled by rejection
MIXING = 8  # steps of hit and run per dimension
TRIES = 10_000  # points drawn per wanted point before rejection sampling gives up
PROGRAMS = 96  # extreme points of a polytope with unknown vertices that are computed, one linear program each


def uniform_points(convex: ConvexSet, count: int, rng: np.random.Generator) -> Array:
    """``count`` independent points ``(count, d)`` of a bounded set: uniform, but for polytopes in more than three
    dimensions or too thin for rejection, where hit and run (Smith 1984) makes them uniform in the limit only. Raises
    `InputError` where no way is known.
    """
    if isinstance(convex, Ellipsoid):
        return np.asarray(convex.centre + _in_ball(2.0, convex.dimension, count, rng) @ convex.factor.T)
    if isinstance(convex, NormBall) and convex.p < np.inf:
        return np.asarray(convex.centre + convex.radius * _in_ball(convex.p, convex.dimension, count, rng))
    if not isinstance(convex, Polytope):
        return _by_rejection(convex, count, rng)
    if convex.dimension <= PLAIN:
        try:
            return _by_rejection(convex, count, rng)
        except InputError:  # too thin
            pass
    return _hit_and_run(convex, count, rng)


def _by_rejection(convex_set: ConvexSet, count: int, rng: np.random.Generator) -> Array:
    """Directly in a box, else the points of its bounding box that lie in the set."""
    if isinstance(convex_set, Box):
        return rng.uniform(convex_set.lower, convex_set.upper, size=(count, convex_set.dimension))
    axes = np.eye(convex_set.dimension)
    lower, upper = -convex_set.support(-axes), convex_set.support(axes)
    found, drawn = np.empty((0, axes.shape[0])), 0
    while found.shape[0] < count:
        points = rng.uniform(lower, upper, size=(max(64, count), axes.shape[0]))
        found = np.vstack([found, points[convex_set.contains(points, 0.0)]])
        drawn += points.shape[0]
        if drawn > TRIES * (found.shape[0] + 1):
            raise InputError(
                f"sampling: {type(convex_set).__name__} fills too little of its bounding box to be sampled by rejection"
            )
    return found[:count]


def extreme_points(convex: ConvexSet, count: int, rng: np.random.Generator) -> Array:
    """``count`` random extreme points ``(count, d)`` of a bounded set: of a box each corner equally likely, of a
    polytope each known vertex, else the support points of directions that are uniform on the sphere."""
    if isinstance(convex, Box):
        return np.where(
            rng.integers(0, 2, size=(count, convex.dimension), dtype=np.int8) > 0, convex.upper, convex.lower
        )
    if isinstance(convex, Polytope):
        known = convex.vertices
        if known is None:
            known = convex.support_point(rng.normal(size=(min(count, PROGRAMS), convex.dimension)))
        return np.asarray(known[rng.integers(0, known.shape[0], size=count)])
    return convex.support_point(rng.normal(size=(count, convex.dimension)))


def _in_ball(p: float, dimension: int, count: int, rng: np.random.Generator) -> Array:
    """Uniform in the unit ball of the ``p``-norm (Barthe, Guedon, Mendelson and Naor 2005, Theorem 1)."""
    sizes = rng.gamma(1.0 / p, size=(count, dimension)) ** (1.0 / p)
    norms = ((sizes**p).sum(axis=1, keepdims=True) + rng.exponential(size=(count, 1))) ** (1.0 / p)
    return np.asarray(np.where(rng.integers(0, 2, size=(count, dimension), dtype=np.int8) > 0, sizes, -sizes) / norms)


def _hit_and_run(convex: Polytope, count: int, rng: np.random.Generator) -> Array:
    """One chain per point, all from the Chebyshev centre; a chain that cannot move along a line stays where it is."""
    H, h = convex.halfspaces()
    points = np.tile(convex.interior_point(), (count, 1))
    for _ in range(MIXING * convex.dimension):
        directions = rng.normal(size=points.shape)
        slopes, room = directions @ H.T, np.maximum(h - points @ H.T, 0.0)
        with np.errstate(divide="ignore", invalid="ignore"):
            reach = room / slopes
        upper = np.where(slopes > 0, reach, np.inf).min(axis=1)
        lower = np.where(slopes < 0, reach, -np.inf).max(axis=1)
        points = points + rng.uniform(lower, upper)[:, None] * directions
    return points
