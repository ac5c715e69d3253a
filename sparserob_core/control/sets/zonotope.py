"""Zonotopes: sums of segments, ``{m + sum_j s_j g_j : |s_j| <= 1}`` (Ziegler 1995, section 7.3)."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from itertools import combinations
from math import comb
from typing import TYPE_CHECKING, final

import numpy as np
import numpy.typing as npt

from sparserob_core.brief import noun
from sparserob_core.errors import InputError
from sparserob_core.shapes import dense, sealed
from sparserob_core.sip.convex_set import CLOSED_WIDTH_SHARE, Array, ConvexSet, chords, continued_by_signs, finite

MAX_SIDES = 500  # pairs of half-spaces that are listed; a set with more is described by its support function alone
GENERATOR_ROUNDING = 1e-14  # relative rounding error of the sums along a generator
DEGENERATE_FACET = 1e-10  # singular value, relative to generators of length 1, below which these do not span a facet


@final
@dataclass(frozen=True, eq=False)
class Zonotope(ConvexSet):
    """A zonotope ``{centre + sum_j s_j generators_j : |s_j| <= 1}``.

    Parameters
    ----------
    centre : array (d,)
        The centre.
    generators : array (q, d)
        The half-segments that are added up, one row each.

    Notes
    -----
    The support function is ``c'centre + sum_j |c'generators_j|``. The set has no interior where the generators do not
    span the space. Then two opposite half-spaces bound it in every direction in which its width is 0.

    Examples
    --------
    >>> import numpy as np
    >>> import sparserob_core as sr
    >>> sr.Zonotope(np.zeros(2), np.array([[1.0, 0.0], [0.5, 0.5]])).support(np.array([1.0, 0.0])).item()
    1.5
    """

    centre: Array
    generators: Array

    if TYPE_CHECKING:  # users may give lists; the fields are arrays

        def __init__(self, centre: npt.ArrayLike, generators: npt.ArrayLike) -> None: ...

    __repr__ = noun

    def __post_init__(self) -> None:
        try:
            generators = np.array(dense(self.generators), dtype=float)
        except (TypeError, ValueError) as error:
            raise InputError("generators must be rows of numbers, one for each", path="zonotope") from error
        if generators.ndim != 2 or not generators.shape[1] or not np.isfinite(generators).all():
            raise InputError(
                f"generators must be rows of finite numbers, one for each, got shape {generators.shape}",
                path="zonotope",
            )
        object.__setattr__(self, "centre", finite("zonotope.centre", self.centre, generators.shape[1]))
        object.__setattr__(self, "generators", generators)
        sealed(self)

    @property
    def dimension(self) -> int:
        return int(self.centre.size)

    def support(self, directions: Array) -> Array:
        directions = np.asarray(directions, dtype=float)
        height: Array = directions @ self.centre + np.abs(directions @ self.generators.T).sum(axis=-1)
        return height

    def continued(self, centre: Array, spread: Array) -> Array:
        """Return a bound ``(k,)`` of the absolute value of the support function at complex directions near real ones.

        The bound is infinite where some product ``c'g_j`` may be 0 up to rounding.

        Parameters
        ----------
        centre, spread : arrays (k, d)
            The real directions, and the distances by which each entry may differ from them.
        """
        sizes = np.abs(self.generators).T
        along = continued_by_signs(
            np.zeros(len(self.generators)),
            np.ones(len(self.generators)),
            centre @ self.generators.T,
            (spread + GENERATOR_ROUNDING * np.abs(centre)) @ sizes,
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
        """Return how much the support function can exceed its linearisation at ``centre``.

        For every generator ``|a + b| - sign(a) (a + b) <= 2 max(|b| - |a|, 0)`` holds, and the excess is ``|a + b|``
        where ``a`` is 0.

        Parameters
        ----------
        centre : array (..., d)
            The direction of the linearisation.
        spread : array (..., J, d)
            The deviations of the direction, ``centre + sum_j s_j spread_j`` with ``|s_j| <= 1``.

        Returns
        -------
        array (...,)
            Upper bounds of the excess.
        """
        along = np.abs(np.asarray(centre) @ self.generators.T)
        deviations = np.abs(np.asarray(spread) @ self.generators.T).sum(axis=-2)
        excess: Array = np.where(along > 0, 2.0 * np.maximum(deviations - along, 0.0), deviations).sum(axis=-1)
        return excess

    def support_majorant(self, centre: Array, spread: Array) -> tuple[Array, Array]:
        share, excess = chords(
            np.asarray(centre) @ self.generators.T, np.abs(np.asarray(spread) @ self.generators.T).sum(axis=-2)
        )
        return self.centre + share @ self.generators, excess.sum(axis=-1)

    def halfspaces(self) -> tuple[Array, Array] | None:
        return self._halfspaces

    @cached_property
    def _halfspaces(self) -> tuple[Array, Array] | None:
        """The half-spaces ``H (r, d)`` and ``h (r,)`` of the set; ``None`` where there are too many of them.

        As many generators as the dimension of their span, less one, span a facet. For a set without an interior the
        opposite half-spaces across its span are moved apart by rounding, so that its points satisfy them.
        """
        d, sizes = self.dimension, np.linalg.norm(self.generators, axis=1)
        generators = self.generators[sizes > 0] / sizes[sizes > 0, None]
        _, values, basis = np.linalg.svd(generators, full_matrices=True)
        rank = int((values > DEGENERATE_FACET).sum())
        if comb(len(generators), max(rank - 1, 0)) > MAX_SIDES:
            return None
        basis = np.where(np.abs(basis) > GENERATOR_ROUNDING, basis, 0.0) if rank < d else np.eye(d)
        within = (
            [normal @ basis[:rank] for normal in self._find_facet_normals(generators @ basis[:rank].T, rank)]
            if rank
            else []
        )
        H = np.vstack([*within, basis[rank:]])
        H, widths, size = (
            np.vstack([H, -H]),
            np.tile(self.width(H), 2),
            np.abs(self.generators).sum(axis=0),
        )
        room = np.where(widths > CLOSED_WIDTH_SHARE * (np.abs(H) @ size), 0.0, GENERATOR_ROUNDING)
        return H, self.support(H) + room * (np.abs(H) @ (np.abs(self.centre) + size))

    @staticmethod
    def _find_facet_normals(generators: Array, d: int) -> list[Array]:
        """Return a normal for every pair of opposite facets, from generators that span all ``d`` dimensions.

        The generators have length 1.
        """
        normals = []
        for chosen in combinations(generators, d - 1):
            _, values, rows = np.linalg.svd(np.array(chosen).reshape(d - 1, d))
            if d == 1 or values.min() > DEGENERATE_FACET:
                normals.append(rows[-1])
        return normals
