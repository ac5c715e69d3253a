"""Parameter sets as index coordinates: a bounding box to search in, and a continuous map of the box onto the set."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import product

import numpy as np

from sparserob_core.control.ray import outward, shares
from sparserob_core.sip.convex_set import Array, Box, ConvexSet

LATTICE = 4096  # points at most in the lattice over the parameters


@dataclass(frozen=True, eq=False)
class ParameterIndex:
    """The part of an index that is the parameter ``p``; empty (``nu = 0``) for a known system."""

    set: ConvexSet | None

    @property
    def count(self) -> int:
        return 0 if self.set is None else self.set.dimension

    @property
    def box(self) -> Box:
        """The smallest box ``(nu,)`` around the set; only for ``count > 0``."""
        assert self.set is not None
        if isinstance(self.set, Box):
            return self.set
        axes = np.eye(self.count)
        return Box(-self.set.support(-axes), self.set.support(axes))

    def clamp(self, parameters: Array) -> Array:
        """Points ``(k, nu)`` of the box mapped onto the set: kept where inside, else drawn along the ray to an interior point."""
        if self.set is None or isinstance(self.set, Box):
            return parameters
        share, middle = shares(self.set, parameters)[:, None], self.set.interior_point()
        return np.where(share == 1.0, parameters, middle + share * (parameters - middle))

    def pulled_back(self, parameters: Array, slopes: Array) -> Array:
        """Derivatives ``(k, nu)`` in the points of the box, from derivatives ``slopes (k, nu)`` in what `clamp` makes of them.

        A point ``p`` outside the set is drawn to ``middle + s (p - middle)`` on the boundary. With an outward normal ``v`` there, the derivative of
        ``s`` is ``-s v / v'(p - middle)``. Points of the set stay where they are; at a corner of the set one of its normals is taken.
        """
        if self.set is None or isinstance(self.set, Box):
            return slopes
        share, middle, result = shares(self.set, parameters), self.set.interior_point(), slopes.astype(float)
        outside = np.flatnonzero(share < 1.0)
        ray, before, kept = parameters[outside] - middle, result[outside], share[outside, None]
        normals = outward(self.set, middle + kept * ray)
        across, along = (normals * ray).sum(axis=1, keepdims=True), (before * ray).sum(axis=1, keepdims=True)
        result[outside] = kept * (before - np.where(across > 0, along / np.where(across > 0, across, 1.0), 0.0) * normals)
        return result

    def touches(self, lower: Array, upper: Array) -> np.ndarray:
        """Whether cells ``[lower, upper]`` (``(k, nu)``) may meet the set; ``False`` only when they provably do not."""
        if self.set is None or isinstance(self.set, Box) or (flat := self.set.halfspaces()) is None:
            return np.ones(lower.shape[0], dtype=bool)
        H, h = flat
        smallest = np.minimum(H[None] * lower[:, None], H[None] * upper[:, None]).sum(axis=2)
        return np.asarray((smallest <= h + 1e-12).all(axis=1))

    def lattice(self) -> tuple[Array, tuple[int, ...]]:
        """A tensor lattice ``(v, nu)`` over the box (ends and middle included), clamped onto the set, and its shape."""
        if self.set is None:
            return np.zeros((1, 0)), ()
        per_axis = next(n for n in (9, 7, 5, 3, 2, 1) if n**self.count <= (125 if n > 3 else LATTICE) or n == 1)
        box = self.box
        axes = [np.linspace(low, high, per_axis) for low, high in zip(box.lower, box.upper, strict=True)]
        return self.clamp(np.array(list(product(*axes)))), (per_axis,) * self.count
