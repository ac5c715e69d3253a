"""Zonotopes: sums of segments, ``{m + sum_j s_j g_j : |s_j| <= 1}`` (Ziegler 1995, section 7.3)."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from itertools import combinations
from math import comb
from typing import final

import numpy as np

from sparserob_core.brief import noun
from sparserob_core.shapes import sealed
from sparserob_core.sip.convex_set import Array, ConvexSet, chords, continued_by_signs

MOST_SIDES = 500  # pairs of half-spaces that are listed; beyond, the set is left to its support function
ROUNDED = 1e-14  # of what is added up along a generator
PARALLEL = 1e-10  # of its generators' size, a normal that is none


@final
@dataclass(frozen=True, eq=False)
class Zonotope(ConvexSet):
    """``{centre + sum_j s_j generators_j : |s_j| <= 1}``, ``centre (d,)``, ``generators (q, d)``.

    Support function ``c'centre + sum_j |c'generators_j|``. Without an interior where the generators do not span the
    space: such a set can be a disturbance's, but not one that states must stay in.
    """

    centre: Array
    generators: Array

    __repr__ = noun

    def __post_init__(self) -> None:
        sealed(self)

    @property
    def dimension(self) -> int:
        return int(self.centre.size)

    def support(self, directions: Array) -> Array:
        directions = np.asarray(directions, dtype=float)
        height: Array = directions @ self.centre + np.abs(directions @ self.generators.T).sum(axis=-1)
        return height

    def continued(self, centre: Array, spread: Array) -> Array:
        """Where no ``c'g_j`` may be 0, as rounding leaves it."""
        each = np.abs(self.generators).T
        along = continued_by_signs(
            np.zeros(len(self.generators)),
            np.ones(len(self.generators)),
            centre @ self.generators.T,
            (spread + ROUNDED * np.abs(centre)) @ each,
        )
        return np.asarray(along + (np.abs(centre) + spread) @ np.abs(self.centre))

    def support_point(self, directions: Array) -> Array:
        signs = np.sign(np.asarray(directions, dtype=float) @ self.generators.T)
        point: Array = self.centre + signs @ self.generators
        return point

    def interior_point(self) -> Array:
        return self.centre.copy()

    def middle(self) -> Array:
        return self.centre.copy()

    def linearisation_excess(self, centre: Array, spread: Array) -> Array:
        """``|a + b| - sign(a) (a + b) <= 2 max(|b| - |a|, 0)`` for every generator; ``|a + b|`` itself where ``a`` is
        0."""
        along = np.abs(np.asarray(centre) @ self.generators.T)
        moved = np.abs(np.asarray(spread) @ self.generators.T).sum(axis=-2)
        excess: Array = np.where(along > 0, 2.0 * np.maximum(moved - along, 0.0), moved).sum(axis=-1)
        return excess

    def support_majorant(self, centre: Array, spread: Array) -> tuple[Array, Array]:
        share, excess = chords(
            np.asarray(centre) @ self.generators.T, np.abs(np.asarray(spread) @ self.generators.T).sum(axis=-2)
        )
        return self.centre + share @ self.generators, excess.sum(axis=-1)

    def halfspaces(self) -> tuple[Array, Array] | None:
        return self._sides

    @cached_property
    def _sides(self) -> tuple[Array, Array] | None:
        """Every facet is spanned by ``d - 1`` generators; ``None`` where these are too many, or there is no
        interior."""
        d, sizes = self.dimension, np.linalg.norm(self.generators, axis=1)
        generators = self.generators[sizes > 0] / sizes[sizes > 0, None]
        few = comb(len(generators), d - 1) <= MOST_SIDES
        if not few or not len(generators) or np.linalg.matrix_rank(generators, tol=PARALLEL) < d:
            return None
        normals = []
        for chosen in combinations(generators, d - 1):
            _, values, rows = np.linalg.svd(np.array(chosen).reshape(d - 1, d))
            if d == 1 or values.min() > PARALLEL:
                normals.append(rows[-1])
        H = np.vstack([normals, -np.array(normals)])
        return H, self.support(H)
