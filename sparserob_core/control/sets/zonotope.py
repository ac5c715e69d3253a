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
from sparserob_core.sip.convex_set import CLOSED, Array, ConvexSet, chords, continued_by_signs

MOST_SIDES = 500  # pairs of half-spaces that are listed; beyond, the set is left to its support function
ROUNDED = 1e-14  # of what is added up along a generator
PARALLEL = 1e-10  # of its generators' size, a normal that is none


@final
@dataclass(frozen=True, eq=False)
class Zonotope(ConvexSet):
    """``{centre + sum_j s_j generators_j : |s_j| <= 1}``, ``centre (d,)``, ``generators (q, d)``.

    Support function ``c'centre + sum_j |c'generators_j|``. Without an interior where the generators do not span the
    space: it then has two opposite sides across every direction in which it does not reach.
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
        """Every facet is spanned by as many generators as their span has dimensions, less one; ``None`` where these are
        too many. Of a set without an interior the sides across its span are apart by rounding, so that its points are
        within them."""
        d, sizes = self.dimension, np.linalg.norm(self.generators, axis=1)
        generators = self.generators[sizes > 0] / sizes[sizes > 0, None]
        _, values, turned = np.linalg.svd(generators, full_matrices=True)
        rank = int((values > PARALLEL).sum())
        if comb(len(generators), max(rank - 1, 0)) > MOST_SIDES:
            return None
        turned = np.where(np.abs(turned) > ROUNDED, turned, 0.0) if rank < d else np.eye(d)
        within = [normal @ turned[:rank] for normal in self._across(generators @ turned[:rank].T, rank)] if rank else []
        H = np.vstack([*within, turned[rank:]])
        H, both, size = (
            np.vstack([H, -H]),
            np.tile(self.width(H), 2),
            np.abs(self.generators).sum(axis=0),
        )
        room = np.where(both > CLOSED * (np.abs(H) @ size), 0.0, ROUNDED)
        return H, self.support(H) + room * (np.abs(H) @ (np.abs(self.centre) + size))

    @staticmethod
    def _across(generators: Array, d: int) -> list[Array]:
        """A normal of every pair of facets, of generators of length 1 that span all ``d`` dimensions."""
        normals = []
        for chosen in combinations(generators, d - 1):
            _, values, rows = np.linalg.svd(np.array(chosen).reshape(d - 1, d))
            if d == 1 or values.min() > PARALLEL:
                normals.append(rows[-1])
        return normals
