"""Parameter sets as index coordinates: a bounding box to search in, and a continuous map of the box onto the set."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import product

import numpy as np

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
        middle = self.set.interior_point()
        inside = self.set.contains(parameters, 0.0)
        low, high = np.zeros(parameters.shape[0]), np.ones(parameters.shape[0])
        for _ in range(50):
            half = (low + high) / 2
            ok = self.set.contains(middle + half[:, None] * (parameters - middle), 0.0)
            low, high = np.where(ok, half, low), np.where(ok, high, half)
        return np.where(inside[:, None], parameters, middle + low[:, None] * (parameters - middle))

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
