"""Polytopes: finitely many half-spaces, bounded or not."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from sparserob_core.errors import InputError
from sparserob_core.sip.convex_set import Array, ConvexSet, as_bound, vertex_excess

_VERTEX_DIMENSIONS = 6
_VERTEX_ROWS = 200


@dataclass(frozen=True, eq=False)
class Polytope(ConvexSet):
    """``{x : H x <= h}`` with ``H (r, d)`` and ``h (r,)``; a single number ``h`` serves every row.

    Raises `InputError` when shapes disagree, an entry is not finite, or the set is empty (Chebyshev's linear program).
    """

    H: Array
    h: Array

    def __post_init__(self) -> None:
        try:
            H = np.array(self.H, dtype=float)
        except (TypeError, ValueError) as error:
            raise InputError("H must be a matrix of numbers, one row per half-space", path="polytope") from error
        if H.ndim != 2 or H.size == 0 or not np.isfinite(H).all():
            raise InputError(
                f"H must be a matrix of finite numbers, one row per half-space, got shape {H.shape}", path="polytope"
            )
        h = as_bound("polytope.h", self.h, H.shape[0])
        if np.isneginf(h).any():
            raise InputError("h must not be -inf", path="polytope")
        zero = ~H.any(axis=1)
        if (h[zero] < 0).any():
            raise InputError(
                f"empty, row {int(np.flatnonzero(zero & (h < 0))[0])} of H is zero and its h is negative",
                path="polytope",
            )
        keep = ~zero & np.isfinite(h)
        object.__setattr__(self, "H", H[keep])
        object.__setattr__(self, "h", h[keep])
        if self.chebyshev[1] < -1e-9 * max(1.0, float(np.abs(self.h).max(initial=0.0))):
            raise InputError("empty, no point satisfies every row of H x <= h", path="polytope")

    @property
    def dimension(self) -> int:
        return int(self.H.shape[1])

    def halfspaces(self) -> tuple[Array, Array]:
        return self.H, self.h

    @cached_property
    def chebyshev(self) -> tuple[Array, float]:
        """Centre ``(d,)`` and radius of a largest ball in the set; the radius is capped, negative when the set is
        empty."""
        from scipy.optimize import linprog

        rows, d = self.H.shape
        if rows == 0:
            return np.zeros(d), np.inf
        cap = 1.0 + float(np.abs(self.h).max())
        norms = np.linalg.norm(self.H, axis=1)
        answer = linprog(
            np.append(np.zeros(d), -1.0),
            np.column_stack([self.H, norms]),
            self.h,
            bounds=[(None, None)] * d + [(None, cap)],
        )
        if answer.status != 0:
            raise InputError(f"could not decide whether it is empty ({answer.message})", path="polytope")
        return np.asarray(answer.x[:-1]), float(answer.x[-1])

    def interior_point(self) -> Array:
        return self.chebyshev[0].copy()

    @cached_property
    def is_bounded(self) -> bool:
        axes = np.eye(self.dimension)
        return all(np.isfinite(self._maximise(axis)[0]) for axis in np.vstack([axes, -axes]))

    @cached_property
    def vertices(self) -> Array | None:
        """All vertices ``(v, d)`` of a bounded polytope with an interior, or ``None`` when they are too many or do not
        exist."""
        rows, d = self.H.shape
        if d > _VERTEX_DIMENSIONS or rows > _VERTEX_ROWS or not self.is_bounded:
            return None
        if d == 1:
            slopes, ends = self.H[:, 0], self.h / self.H[:, 0]
            return np.array([[ends[slopes < 0].max()], [ends[slopes > 0].min()]])
        centre, radius = self.chebyshev
        if radius <= 1e-9 * (1.0 + float(np.abs(centre).max())):
            return None
        from scipy.spatial import HalfspaceIntersection, QhullError

        try:
            found = HalfspaceIntersection(np.column_stack([self.H, -self.h]), centre)
        except QhullError:
            return None
        return self._polished(found.intersections, found.dual_facets)

    def _polished(self, points: Array, facets: list[list[int]]) -> Array:
        """Vertices solved for from their active rows: what qhull returns has passed through a dual space."""
        vertices = [np.linalg.lstsq(self.H[rows], self.h[rows], rcond=None)[0] for rows in facets]
        exact = np.where(np.isfinite(vertices), vertices, points)
        _, first = np.unique(np.round(exact, 12), axis=0, return_index=True)
        return exact[np.sort(first)]

    def support(self, directions: Array) -> Array:
        directions = np.asarray(directions, dtype=float)
        if self.vertices is not None:
            highest: Array = (directions @ self.vertices.T).max(axis=-1)
            return highest
        flat = directions.reshape(-1, self.dimension)
        return np.array([self._maximise(c)[0] for c in flat]).reshape(directions.shape[:-1])

    def linearisation_excess(self, centre: Array, spread: Array) -> Array:
        if self.vertices is None:
            return super().linearisation_excess(centre, spread)
        return vertex_excess(self.vertices, np.asarray(centre, dtype=float), np.asarray(spread, dtype=float))

    def support_point(self, directions: Array) -> Array:
        directions = np.asarray(directions, dtype=float)
        if self.vertices is not None:
            point: Array = self.vertices[(directions @ self.vertices.T).argmax(axis=-1)]
            return point
        flat = directions.reshape(-1, self.dimension)
        return np.array([self._maximise(c)[1] for c in flat]).reshape(directions.shape)

    def _maximise(self, direction: Array) -> tuple[float, Array]:
        """Support function and a maximiser by a linear program; ``(inf, some point)`` when unbounded."""
        from scipy.optimize import linprog

        size = float(np.abs(direction).max())
        if size == 0.0:
            return 0.0, self.interior_point()
        if self.h.size == 0:
            return np.inf, self.interior_point()
        answer = linprog(-direction / size, self.H, self.h, bounds=(None, None))
        if answer.status != 0:
            return np.inf, self.interior_point()
        return float(direction @ answer.x), np.asarray(answer.x)
