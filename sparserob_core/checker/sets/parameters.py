"""The set of parameters on a box of the subdivision: whether they meet, and half-spaces of the set that help a bound
there."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, TypeAlias, final

import numpy as np

from sparserob_core.checker.arithmetic.balls import above, balls
from sparserob_core.checker.sets.shape import Facet, Shape
from sparserob_core.sip.convex_set import Array

if TYPE_CHECKING:
    from flint import arb

Corners: TypeAlias = tuple[tuple[float, ...], tuple[float, ...]]
"""Lower and upper corners of a box of parameters."""


@final
@dataclass(frozen=True, eq=False)
class Parameters:
    """The set that the parameters are known to be in; ``None`` for a known system."""

    shape: Shape | None

    @property
    def is_box(self) -> bool:
        """Whether boxes of the subdivision hold parameters only."""
        return self.shape is None or self.shape.is_box

    def holds(self, point: Array) -> bool:
        """Whether a point is proven to be in the set."""
        return self.shape is None or self.shape.contains(point)

    def meets(self, box: Corners) -> bool:
        """Whether a box may hold parameters; ``False`` only where a half-space of the set provably excludes it."""
        if self.shape is None or self.is_box:
            return True
        low, high = np.array(box[0]), np.array(box[1])
        return all(not _least(normal, low, high) > limit for normal, limit in halfspaces(self.shape, (low + high) / 2))

    def bounds(self, box: Corners, slope: Array) -> list[tuple[Array, Array, float]]:
        """Ways to use the set: normals ``a (k, nu)``, limits ``s (k,)`` with ``a p <= s`` on the set, and weights
        ``(k,) >= 0``, such that the weighted normals take up as much as they can of ``slope (nu,)``."""
        if self.is_box or self.shape is None or not slope.any():
            return []
        found = [(slope[None], np.array([above(self.shape.support(balls(slope)))]), np.ones(1))]
        low, high = np.array(box[0]), np.array(box[1])
        near = [(a, s) for a, s in halfspaces(self.shape, (low + high) / 2) if not -_least(-a, low, high) <= s]
        if near:
            from scipy.optimize import nnls

            normals, limits = np.array([a for a, _ in near]), np.array([above(s) for _, s in near])
            found.append((normals, limits, nnls(normals.T, slope)[0]))
        return found  # type: ignore[return-value]


def halfspaces(shape: Shape, point: Array) -> list[Facet]:
    """Half-spaces that hold a set: its facets, or that of a curved one that looks towards a point."""
    if shape.facets is not None:
        return shape.facets
    normal = shape.towards(point - shape.centre)
    return [(normal, shape.support(balls(normal)))] if normal.any() else []


def _least(normal: Array, low: Array, high: Array) -> arb:
    """The least ``a'p`` on a box."""
    ends = zip(normal, balls(normal), balls(low), balls(high), strict=True)
    return sum((c * (a if weight > 0 else b) for weight, c, a, b in ends), balls([0.0])[0])
