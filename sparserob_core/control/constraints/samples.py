"""Random disturbances, parameters and initial states for the scenario approach; a sample proves nothing."""

from __future__ import annotations

import numpy as np

from sparserob_core.control.response.disturbance import DisturbanceModel
from sparserob_core.sip.convex_set import Array, ConvexSet


def sample_disturbances(model: DisturbanceModel, count: int, rng: np.random.Generator) -> Array:
    """``count`` disturbances ``(count, mw, L)`` on the grid's pieces: every block uniform in its set, independent of
    the others."""
    blocks = model.block_count
    points = model.set.sample(count * blocks, rng).reshape(count, blocks, -1)
    return model.signals(points)


def sample_parameters(convex_set: ConvexSet | None, count: int, rng: np.random.Generator) -> Array:
    """``count`` parameters ``(count, nu)``, uniform in their set."""
    return np.zeros((count, 0)) if convex_set is None else convex_set.sample(count, rng)
