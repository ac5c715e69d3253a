"""The set of parameters on a box of the subdivision: whether both intersect, and half-spaces that sharpen a bound
there."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TypeAlias, final

import numpy as np
from flint import arb

from sparserob_core.checker.arithmetic.balls import above, ball, balls
from sparserob_core.checker.sets.shape import Facet, Shape
from sparserob_core.sip.convex_set import Array

Corners: TypeAlias = tuple[tuple[float, ...], tuple[float, ...]]
"""The lower and the upper corner of a box of parameters."""


@final
@dataclass(frozen=True, eq=False)
class Parameters:
    """The set that contains the parameters; its ``shape`` is ``None`` for a known system."""

    shape: Shape | None

    @property
    def is_box(self) -> bool:
        """True where boxes of the subdivision contain points of the set only."""
        return self.shape is None or self.shape.is_box

    def holds(self, point: Array) -> bool:
        """Return True where a point is proven to be in the set."""
        return self.shape is None or self.shape.contains(point)

    def meets(self, box: Corners) -> bool:
        """Return True where a box may intersect the set; False only where a half-space of the set provably excludes the
        box."""
        if self.shape is None or self.is_box:
            return True
        low, high = np.array(box[0]), np.array(box[1])
        return all(
            not _minimise_on_box(normal, low, high) > limit
            for normal, limit in halfspaces(self.shape, (low + high) / 2)
        )

    def bounds(self, box: Corners, slope: Array) -> list[tuple[Array, Array, float]]:
        """Return combinations of half-spaces of the set that balance the ``slope (nu,)`` of a bound on a box of
        parameters. They are normals ``a (k, nu)``, limits ``s (k,)`` with ``a p <= s`` on the set, and weights ``(k,)
        >= 0``."""
        if self.is_box or self.shape is None or not slope.any():
            return []
        combinations = [(slope[None], np.array([above(self.shape.support(balls(slope)))]), np.ones(1))]
        low, high = np.array(box[0]), np.array(box[1])
        cutting = [
            (a, s) for a, s in halfspaces(self.shape, (low + high) / 2) if not -_minimise_on_box(-a, low, high) <= s
        ]
        if cutting:
            from scipy.optimize import nnls

            normals, limits = np.array([a for a, _ in cutting]), np.array([above(s) for _, s in cutting])
            combinations.append((normals, limits, nnls(normals.T, slope)[0]))
        return combinations  # type: ignore[return-value]


def halfspaces(shape: Shape, point: Array) -> list[Facet]:
    """Return half-spaces that contain a set: its facets, or for a curved set the one in the direction of a point."""
    if shape.facets is not None:
        return shape.facets
    normal = shape.towards(point - shape.centre)
    return [(normal, shape.support(balls(normal)))] if normal.any() else []


def _minimise_on_box(normal: Array, low: Array, high: Array) -> arb:
    """Return the least ``a'p`` on a box."""
    ends = zip(normal, balls(normal), balls(low), balls(high), strict=True)
    return sum((c * (a if weight > 0 else b) for weight, c, a, b in ends), ball(0.0))
