"""Random disturbances and parameters, for baselines and simulation; a sample proves nothing."""

from __future__ import annotations

import numpy as np

from sparserob_core.control.disturbance import DisturbanceModel
from sparserob_core.errors import InputError
from sparserob_core.sip.convex_set import Array, Box, ConvexSet

TRIES = 10_000   # points drawn per wanted point before rejection sampling gives up


def uniform_points(convex_set: ConvexSet, count: int, rng: np.random.Generator) -> Array:
    """``count`` independent points ``(count, d)``, uniform in a bounded set: directly in a box, else by rejection from its bounding box."""
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
            raise InputError(f"sampling: {type(convex_set).__name__} fills too little of its bounding box to be sampled by rejection")
    return found[:count]


def sample_disturbances(model: DisturbanceModel, count: int, rng: np.random.Generator) -> Array:
    """``count`` disturbances ``(count, mw, L)`` on the grid's pieces: every block uniform in its set, independent of the others."""
    blocks = model.block_count
    points = uniform_points(model.set, count * blocks, rng).reshape(count, blocks, -1)
    return model.signals(points)


def sample_parameters(convex_set: ConvexSet | None, count: int, rng: np.random.Generator) -> Array:
    """``count`` parameters ``(count, nu)``, uniform in their set."""
    return np.zeros((count, 0)) if convex_set is None else uniform_points(convex_set, count, rng)
