"""Parameter sets as index coordinates: a bounding box to search in, and a continuous map of the box onto the set."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import product

import numpy as np

from sparserob_core.control.enclosures.valid_inequalities import Cuts, ball_of
from sparserob_core.sip.convex_set import Array, Box, ConvexSet

TOUCHING = 1e-12  # relative: a cell this close to the set meets it
LATTICE = 4096  # points at most in the lattice over the parameters


@dataclass(frozen=True, eq=False)
class ParameterIndex:
    """Part of an index that is the parameter ``p``; empty (``nu = 0``) for a known system."""

    set: ConvexSet | None

    @property
    def count(self) -> int:
        return 0 if self.set is None else self.set.dimension

    @property
    def box(self) -> Box:
        """The smallest box ``(nu,)`` around the set; only for ``count > 0``."""
        assert self.set is not None
        return self.set.bounding_box()

    @property
    def middle(self) -> Array:
        """A point in the interior of the set, ``(nu,)``; of a known system the only one there is."""
        return np.zeros(0) if self.set is None else self.set.interior_point()

    def clamp(self, parameters: Array) -> Array:
        """Return points ``(k, nu)`` of the box mapped onto the set. Points of the set stay; others move along the ray
        to an interior point."""
        if self.set is None or self.set.is_box:
            return parameters
        size, middle = self.set.gauge(parameters)[:, None], self.set.interior_point()
        return np.where(size <= 1.0, parameters, middle + (parameters - middle) / np.maximum(size, 1.0))

    def pulled_back(self, parameters: Array, slopes: Array) -> Array:
        """Return derivatives ``(k, nu)`` at the points of the box, from derivatives ``slopes (k, nu)`` at the points to
        which `clamp` maps them.

        A point ``p`` outside the set moves to ``middle + s (p - middle)`` on the boundary. With an outward normal ``v``
        there, the derivative of ``s`` is ``-s v / v'(p - middle)``. Points of the set stay where they are; at a corner
        of the set one of its normals is taken.
        """
        if self.set is None or self.set.is_box:
            return slopes
        share, middle = 1.0 / np.maximum(self.set.gauge(parameters), 1.0), self.set.interior_point()
        result, outside = slopes.astype(float), np.flatnonzero(share < 1.0)
        ray, before, kept = parameters[outside] - middle, result[outside], share[outside, None]
        normals = self.set.normal(middle + kept * ray)
        across, along = (normals * ray).sum(axis=1, keepdims=True), (before * ray).sum(axis=1, keepdims=True)
        result[outside] = kept * (
            before - np.where(across > 0, along / np.where(across > 0, across, 1.0), 0.0) * normals
        )
        return result

    def touches(self, lower: Array, upper: Array) -> np.ndarray:
        """Return whether cells ``[lower, upper]`` (``(k, nu)``) may meet the set; ``False`` only where they provably do
        not."""
        if self.set is None or self.set.is_box:
            return np.ones(lower.shape[0], dtype=bool)
        H, h = self._enclose_by_halfspaces(self.set, (lower + upper) / 2)
        smallest = np.minimum(H * lower[:, None], H * upper[:, None]).sum(axis=2)
        return np.asarray((smallest <= h + TOUCHING * np.maximum(1.0, np.abs(h))).all(axis=1))

    def cuts(self, low: Array, high: Array) -> Cuts | None:
        """Return valid inequalities of the set on a cell ``[low, high]``; ``None`` where the whole cell is in the set,
        as far as the test can decide."""
        if self.set is None or self.set.is_box:
            return None
        centre, radius = (low + high) / 2, (high - low) / 2
        ball, flat = ball_of(self.set, centre, radius), self.set.halfspaces() is not None
        towards = (
            centre[None] if flat or ball is not None else np.vstack([centre, *product(*zip(low, high, strict=True))])
        )
        H, h = (side.reshape(-1, *side.shape[2:]) for side in self._enclose_by_halfspaces(self.set, towards))
        slopes, slack = H * radius, h - H @ centre
        crossing = np.abs(slopes).sum(axis=1) > slack
        if not crossing.any() and (
            ball is None or np.linalg.norm(np.abs(ball[0]) + np.abs(ball[1]).sum(axis=1)) <= 1.0
        ):
            return None
        curvature = np.zeros(centre.size)
        if not flat:
            box = self.box
            curvature = (
                float((h - H @ self.set.interior_point()).max()) * ((high - low) / (box.upper - box.lower)) ** 2 / 2
            )
        return Cuts(slopes[crossing], slack[crossing], ball, curvature)

    @staticmethod
    def _enclose_by_halfspaces(convex_set: ConvexSet, points: Array) -> tuple[Array, Array]:
        """Return half-spaces ``H p <= h`` that contain the set, ``(k, q, nu), (k, q)``: its own sides, or a tangent one
        on the ray to each of ``points``."""
        flat = convex_set.halfspaces()
        if flat is not None:
            return np.broadcast_to(flat[0], (points.shape[0], *flat[0].shape)), np.broadcast_to(
                flat[1], (points.shape[0], flat[1].size)
            )
        middle = convex_set.interior_point()
        normals = convex_set.normal(middle + (points - middle) / np.maximum(convex_set.gauge(points), 1.0)[:, None])
        sizes = np.linalg.norm(normals, axis=1, keepdims=True)
        normals = normals / np.where(sizes > 0, sizes, 1.0)
        return normals[:, None], convex_set.support(normals)[:, None]

    def lattice(self) -> tuple[Array, tuple[int, ...]]:
        """Return a tensor lattice ``(v, nu)`` over the box, clamped onto the set, and its shape.

        It includes the ends of the box, and its middle for up to 7 parameters. Beyond 12 parameters it is the lower
        corner alone.
        """
        if self.set is None:
            return np.zeros((1, 0)), ()
        per_axis = next(n for n in (9, 5, 3, 2, 1) if n**self.count <= (125 if n > 3 else LATTICE) or n == 1)
        box = self.box
        axes = [np.linspace(low, high, per_axis) for low, high in zip(box.lower, box.upper, strict=True)]
        return self.clamp(np.array(list(product(*axes)))), (per_axis,) * self.count
