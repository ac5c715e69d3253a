"""Polytopes: intersections of finitely many half-spaces, bounded or not."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from sparserob_core.brief import noun
from sparserob_core.errors import InputError
from sparserob_core.shapes import Float, dense, sealed, shaped
from sparserob_core.sip.convex_set import Array, ConvexSet, as_bound, continued_by_corners, vertex_excess
from sparserob_core.sip.expressions.triangulation import find_vertices

_VERTEX_DIMENSIONS = 6
_VERTEX_ROWS = 200
_SWEEPS = 12
_ORDINARY = 10  # binary orders of magnitude of the scale factors within which rows and columns are not scaled
# Binary orders of magnitude of the balanced numbers beyond which rows and units are chosen by the largest entries.
# HiGHS refuses entries of 1e15 and drops those of 1e-9. With half of it sets that means balance well are scaled anew.
_WIDE = 40
# Largest right-hand side in the program of the Chebyshev centre, which is judged without the others. HiGHS takes those
# of 1e20 as infinite, and with a thousandth of it sides would be left out of sets that are that far from 0.
_FAR = 1e17
_SQUARED = 400  # binary orders of magnitude of the largest entry of a row, beyond which its norm may not be a number
_TOGETHER = 64  # linear programs that are solved as one
_CLEAR, _NOTHING = 1e-6, 1e-14  # relative sizes above which a number is clearly not 0, and below which it is rounding
_PROGRAMS = 96  # extreme points that are computed where the vertices are not known, one linear program each


@dataclass(frozen=True, eq=False)
class Polytope(ConvexSet):
    """A polytope ``{x : H x <= h}``, bounded or not.

    Parameters
    ----------
    H : array (r, d)
        The normals of the half-spaces, one row each.
    h : float or array (r,)
        The right-hand sides; a number holds for every row. A row with an infinite side is left out.

    Raises
    ------
    InputError
        If shapes disagree, an entry of ``H`` is not finite, or the set is empty. Emptiness is decided by the linear
        program of the Chebyshev centre.

    Examples
    --------
    >>> import sparserob_core as sr
    >>> triangle = sr.Polytope([[-1, 0], [0, -1], [1, 1]], [0, 0, 1])
    >>> triangle.dimension
    2
    """

    H: Array
    h: Array

    if TYPE_CHECKING:  # users may give a list; the field is an array

        def __init__(self, H: npt.ArrayLike, h: npt.ArrayLike) -> None: ...

    __repr__ = noun

    def __post_init__(self) -> None:
        try:
            H = np.array(dense(self.H), dtype=float)
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
        exponents = np.frexp(np.abs(H).max(axis=1))[1]
        factors = np.where(np.abs(exponents) > _SQUARED, -exponents, 0)
        with np.errstate(over="ignore"):  # a side beyond all numbers is none
            H, h = np.ldexp(H, factors[:, None]), np.ldexp(h, factors)
        keep = ~zero & np.isfinite(h)
        object.__setattr__(self, "H", H[keep])
        object.__setattr__(self, "h", h[keep])
        sealed(self)
        sides = np.abs(self._balanced_halfspaces[1])
        if self.chebyshev[1] < -1e-9 * max(1.0, float(sides[sides <= _FAR].max(initial=0.0))):
            raise InputError("empty, no point satisfies every row of H x <= h", path="polytope")

    @property
    def dimension(self) -> int:
        return int(self.H.shape[1])

    @shaped
    def halfspaces(self) -> tuple[Float[Array, "r d"], Float[Array, " r"]]:
        return self.H, self.h

    @shaped
    def in_units(self, units: Float[Array, " d"]) -> Polytope:
        """Return the set of all ``x / units`` for ``x`` in the polytope and ``units (d,)``.

        Every row is divided by a power of two, so that its largest entry is about 1.
        """
        H = self.H * units
        sizes = np.abs(H).max(axis=1, initial=0.0)
        factors = np.ldexp(1.0, -np.frexp(np.where(sizes > 0.0, sizes, 1.0))[1])
        polytope = object.__new__(Polytope)  # without the check for emptiness, which this set has passed
        object.__setattr__(polytope, "H", H * factors[:, None])
        object.__setattr__(polytope, "h", self.h * factors)
        return polytope

    @cached_property
    def _balanced_halfspaces(self) -> tuple[Array, Array, Array]:
        """The arrays ``H'``, ``h'`` and ``units`` with ``{x : H x <= h} = {units * y : H' y <= h'}``.

        Rows and columns of very different sizes are divided by powers of two, the means of the logarithms of their
        entries (Curtis and Reid 1972). A linear program over the set then gives the same answer in all units.
        """
        with np.errstate(divide="ignore"):
            entries = np.log2(np.abs(np.column_stack([self.H, self.h])))
        is_nonzero = np.isfinite(entries)
        sizes, columns = np.where(is_nonzero, entries, 0.0), np.zeros(self.dimension + 1)
        for _ in range(_SWEEPS):
            rows = -np.where(is_nonzero, sizes + columns, 0.0).sum(axis=1) / np.maximum(is_nonzero.sum(axis=1), 1)
            columns = -np.where(is_nonzero, sizes + rows[:, None], 0.0).sum(axis=0) / np.maximum(
                is_nonzero.sum(axis=0), 1
            )
            columns[-1] = 0.0  # the right-hand sides have no unit of their own
        exponents = np.rint(np.concatenate([rows, columns[:-1]])).astype(int)
        if np.abs(exponents).max(initial=0) <= _ORDINARY:
            return self.H, self.h, np.ones(self.dimension)
        balanced = np.where(
            is_nonzero, sizes + np.append(exponents[rows.size :], 0) + exponents[: rows.size, None], 0.0
        )
        if np.abs(balanced).max(initial=0.0) > _WIDE:
            exponents = _balance_largest(np.where(is_nonzero, sizes, -np.inf), self.H > 0.0, exponents[rows.size :])
        factors, units = exponents[: rows.size], exponents[rows.size :]
        H = np.ldexp(self.H, factors[:, None] + units)
        return H, np.ldexp(self.h, factors), np.ldexp(1.0, units)

    @cached_property
    def chebyshev(self) -> tuple[Array, float]:
        """The centre ``(d,)`` and the radius of a largest ball in the set.

        The radius is capped, and is negative for an empty set.

        The ball is one in balanced coordinates where rows or columns differ much in size.
        """
        from scipy.optimize import linprog

        (rows, d), (H, h, units) = self.H.shape, self._balanced_halfspaces
        if rows == 0:
            return np.zeros(d), np.inf
        is_near = h <= _FAR
        H, h, distant = H[is_near], h[is_near], (H[~is_near], h[~is_near])
        cap = 1.0 + float(np.abs(h).max(initial=0.0))
        norms = np.linalg.norm(H, axis=1)
        answer = linprog(
            np.append(np.zeros(d), -1.0),
            np.column_stack([H, norms]),
            h,
            bounds=[(None, None)] * d + [(None, cap)],
        )
        if answer.status != 0 or (distant[0] @ answer.x[:-1] > distant[1]).any():
            raise InputError(f"could not decide whether it is empty ({answer.message})", path="polytope")
        return np.asarray(answer.x[:-1]) * units, float(answer.x[-1])

    @shaped
    def interior_point(self) -> Float[Array, " d"]:
        return self.chebyshev[0].copy()

    @shaped
    def amid(self) -> Float[Array, " d"]:
        """Return the mean ``(d,)`` of the vertices; the Chebyshev centre where these are not known.

        The Chebyshev centre depends on the units.
        """
        return self.interior_point() if self.vertices is None else np.asarray(self.vertices.mean(axis=0))

    @cached_property
    def is_bounded(self) -> bool:
        axes = np.eye(self.dimension)
        return bool(np.isfinite(self._coordinate_bound)) or all(
            np.isfinite(self._maximise(axis)[0]) for axis in np.vstack([axes, -axes])
        )

    @cached_property
    def vertices(self) -> Array | None:
        """All vertices ``(v, d)``; ``None`` where there may be too many of them or the set is unbounded."""
        rows, d = self.H.shape
        if d > _VERTEX_DIMENSIONS or rows > _VERTEX_ROWS or not self.is_bounded:
            return None
        if d == 1:
            slopes, ends = self.H[:, 0], self.h / self.H[:, 0]
            return np.array([[ends[slopes < 0].max()], [ends[slopes > 0].min()]])
        (centre, radius), (H, h, units) = self.chebyshev, self._balanced_halfspaces
        centre = centre / units
        if radius <= 1e-9 * (1.0 + float(np.abs(centre).max())):
            return self._find_exact_vertices()
        from scipy.spatial import HalfspaceIntersection, QhullError

        try:
            intersection = HalfspaceIntersection(np.column_stack([H, -h]), centre)
        except QhullError:
            return None
        return self._polish_vertices(intersection.intersections, intersection.dual_facets) * units

    def _find_exact_vertices(self) -> Array | None:
        """Return the vertices ``(v, d)`` of a set without an interior, computed in fractions.

        A vertex is a point at which ``d`` rows meet and which no row excludes. The value is ``None`` where there are
        too many meetings, or where the set is empty up to rounding.
        """
        H, h, units = self._balanced_halfspaces
        corners = find_vertices(H, h)
        return np.array([[float(a) for a in x] for x in corners]) * units if corners else None

    @shaped
    def _polish_vertices(self, points: Float[Array, "v d"], facets: list[list[int]]) -> Float[Array, "u d"]:
        """Return vertices ``(u, d)`` without repetitions, solved for from their active rows ``facets``.

        The points ``(v, d)`` of qhull are less accurate, because qhull computes in a dual space.
        """
        H, h, _ = self._balanced_halfspaces
        vertices = [np.linalg.lstsq(H[rows], h[rows], rcond=None)[0] for rows in facets]
        exact = np.where(np.isfinite(vertices), vertices, points)
        _, first = np.unique(np.round(exact, 12), axis=0, return_index=True)
        return exact[np.sort(first)]

    @shaped
    def support(self, directions: Float[Array, "*k d"]) -> Float[Array, " *k"]:
        directions = np.asarray(directions, dtype=float)
        if self.vertices is not None:
            highest: Array = (directions @ self.vertices.T).max(axis=-1)
            return highest
        return self._maximise_all(directions.reshape(-1, self.dimension))[0].reshape(directions.shape[:-1])

    @shaped
    def continued(self, centre: Float[Array, "k d"], spread: Float[Array, "k d"]) -> Float[Array, " k"] | None:
        return None if self.vertices is None else continued_by_corners(self.vertices, centre, spread)

    def scaled(self, factor: float) -> Polytope:
        offset = self.H @ self.middle()
        return Polytope(self.H, offset + factor * (self.h - offset))

    @shaped
    def sample_extreme(self, count: int, rng: np.random.Generator) -> Float[Array, "{count} d"]:
        """Return random vertices, each known vertex with the same probability.

        Where the vertices are not known, support points of random directions stand for them.

        Parameters
        ----------
        count : int
            The number of points.
        rng : numpy.random.Generator
            The source of random numbers.

        Returns
        -------
        array (count, d)
            The points.
        """
        points = self.vertices
        if points is None:
            points = self.support_point(rng.normal(size=(min(count, _PROGRAMS), self.dimension)))
        return np.asarray(points[rng.integers(0, points.shape[0], size=count)])

    @shaped
    def linearisation_excess(self, centre: Float[Array, "*k d"], spread: Float[Array, "*k J d"]) -> Float[Array, " *k"]:
        if self.vertices is None:
            return super().linearisation_excess(centre, spread)
        return vertex_excess(self.vertices, np.asarray(centre, dtype=float), np.asarray(spread, dtype=float))

    @shaped
    def support_point(self, directions: Float[Array, "*k d"]) -> Float[Array, "*k d"]:
        directions = np.asarray(directions, dtype=float)
        if self.vertices is not None:
            point: Array = self.vertices[(directions @ self.vertices.T).argmax(axis=-1)]
            return point
        return self._maximise_all(directions.reshape(-1, self.dimension))[1].reshape(directions.shape)

    @shaped
    def _maximise_all(self, directions: Float[Array, "k d"]) -> tuple[Float[Array, " k"], Float[Array, "k d"]]:
        """Return the support function ``(k,)`` and maximisers ``(k, d)`` of directions ``(k, d)``.

        Several linear programs are solved together as one, because a call of the solver costs far more than a small
        program. Where this fails, they are solved one by one.
        """
        _, h, units = self._balanced_halfspaces
        values, points = np.zeros(len(directions)), np.tile(self.interior_point(), (len(directions), 1))
        is_unbounded = self._is_along_lines(directions * units)
        values[is_unbounded] = np.inf
        pending = np.flatnonzero((np.abs(directions).max(axis=1, initial=0.0) > 0) & ~is_unbounded)
        for start in range(0, pending.size, _TOGETHER):
            batch = pending[start : start + _TOGETHER]
            scaled = directions[batch] * units
            sizes = np.abs(scaled).max(axis=1)
            balanced = scaled / sizes[:, None]
            if batch.size > 1 and h.size and np.isfinite(balanced).all():
                solution = self._maximise_together(balanced)
                if solution is not None:
                    maximisers, multipliers = solution
                    proven = sizes * self._bound_by_duality(balanced, multipliers)
                    values[batch] = np.maximum((scaled * maximisers).sum(axis=1), proven)
                    points[batch] = maximisers * units
                    continue
            for position in batch:
                values[position], points[position] = self._maximise(directions[position])
        return values, points

    def _maximise_together(self, directions: Array) -> tuple[Array, Array] | None:
        """Return maximisers ``(k, d)`` and multipliers ``(k, r)`` of directions ``(k, d)``, by one linear program.

        All are in balanced coordinates. The value is ``None`` where the program has no solution, as for an unbounded
        direction.
        """
        from scipy.optimize import linprog
        from scipy.sparse import block_diag, csc_array

        (H, h, _), count = self._balanced_halfspaces, len(directions)
        rows = block_diag([csc_array(H)] * count, format="csc")
        answer = linprog(-directions.reshape(-1), rows, np.tile(h, count), bounds=(None, None))
        if answer.status != 0:
            return None
        multipliers = -np.asarray(answer.ineqlin.marginals).reshape(count, h.size)
        return np.asarray(answer.x).reshape(directions.shape), multipliers

    def _is_along_lines(self, directions: Array) -> npt.NDArray[np.bool_]:
        """Return a mask ``(k,)`` of the directions ``(k, d)`` with a clear part along a line that is in the set.

        Directions are in balanced coordinates.
        """
        along = np.linalg.norm(directions @ self._lines.T, axis=1)
        return np.asarray(along > _CLEAR * np.linalg.norm(directions, axis=1))

    @cached_property
    def _lines(self) -> Array:
        """The lines in the set as orthonormal rows ``(l, d)``, in balanced coordinates.

        There are no rows where rounding leaves a doubt.
        """
        _, sizes, vectors = np.linalg.svd(self._balanced_halfspaces[0])
        sizes = np.concatenate([sizes, np.zeros(self.dimension - sizes.size)]) / max(
            float(sizes.max(initial=0.0)), 1e-300
        )
        if ((sizes > _NOTHING) & (sizes < _CLEAR)).any():
            return np.zeros((0, self.dimension))
        return np.asarray(vectors[sizes <= _NOTHING])

    @shaped
    def _maximise(self, direction: Float[Array, " d"]) -> tuple[float, Float[Array, " d"]]:
        """Return the support function and a maximiser ``(d,)`` of one direction ``(d,)`` by a linear program.

        The value is infinite where the set is unbounded; the point is then any point of the set.
        """
        from scipy.optimize import linprog

        H, h, units = self._balanced_halfspaces
        scaled = direction * units
        size = float(np.abs(scaled).max())
        if size == 0.0:
            return 0.0, self.interior_point()
        if h.size == 0:
            return np.inf, self.interior_point()
        answer = linprog(-scaled / size, H, h, bounds=(None, None))
        if answer.status != 0:
            return np.inf, self.interior_point()
        proven = size * self._bound_by_duality(scaled[None] / size, -np.asarray(answer.ineqlin.marginals)[None])[0]
        return max(float(scaled @ answer.x), float(proven)), np.asarray(answer.x) * units

    def _bound_by_duality(self, directions: Array, multipliers: Array) -> Array:
        """Return proven upper bounds ``(k,)`` of the support function of directions ``(k, d)``.

        All are in balanced coordinates.

        Weak duality: ``c'x = (c - H'y)'x + y'H x <= |c - H'y|_1 R + y'h`` for ``y >= 0`` and ``|x_i| <= R``. The bound
        does not rest on the accuracy of the linear program, except for the rounding of these sums. It is ``-inf`` where
        no ``R`` is known.
        """
        H, h, _ = self._balanced_halfspaces
        y = np.maximum(multipliers, 0.0)
        residual = np.abs(directions - y @ H).sum(axis=1)
        with np.errstate(invalid="ignore"):
            bound: Array = y @ h + np.where(residual > 0.0, residual * self._coordinate_bound, 0.0)
        return np.where(np.isfinite(bound), bound, -np.inf)

    @cached_property
    def _coordinate_bound(self) -> float:
        """A proven bound of every coordinate of every point, in balanced coordinates; ``inf`` where none is found.

        With multipliers ``y`` of each axis, ``M = max |x_i|`` is at most ``y'h + |e_i - H'y|_1 M``. This bounds ``M``
        where the factor of ``M`` is below 1.
        """
        H, h, _ = self._balanced_halfspaces
        axes = np.vstack([np.eye(self.dimension), -np.eye(self.dimension)])
        highest, residual = 0.0, 0.0
        if not h.size:
            return np.inf
        for start in range(0, len(axes), _TOGETHER):
            batch = axes[start : start + _TOGETHER]
            solution = self._maximise_together(batch)
            if solution is None:
                return np.inf
            y = np.maximum(solution[1], 0.0)
            highest, residual = (
                max(highest, float((y @ h).max())),
                max(residual, float(np.abs(batch - y @ H).sum(axis=1).max())),
            )
        return 2.0 * abs(highest) / (1.0 - residual) if residual < 0.5 else np.inf


def _balance_largest(
    sizes: Array, is_positive: npt.NDArray[np.bool_], units: npt.NDArray[np.int_]
) -> npt.NDArray[np.int_]:
    """Return exponents ``(r + d,)`` of factors of rows and of units, from the logarithms ``sizes (r, d + 1)`` of the
    entries of ``H`` and ``h``, the signs of ``H``, and first exponents of the ``units (d,)``.

    The largest entry of every row of ``H`` becomes about 1. The rows with the largest entry at one coordinate bound it
    from above or from below, by about their right-hand sides. The larger of the two nearest bounds becomes about 1.
    """
    H, h, d = sizes[:, :-1], sizes[:, -1], units.size
    for _ in range(_SWEEPS):
        largest, rows = (H + units).argmax(axis=1), -np.rint((H + units).max(axis=1)).astype(int)
        nearest = np.full((2, d), np.inf)
        side = is_positive[np.arange(len(H)), largest].astype(int)
        np.minimum.at(nearest, (side, largest), np.where(np.isfinite(h), h + rows, np.inf))
        bounds = np.where(np.isfinite(nearest), nearest, -np.inf).max(axis=0)
        change = np.where(np.isfinite(bounds) & (np.abs(bounds) > _ORDINARY), np.rint(bounds), 0.0).astype(int)
        if not change.any():
            break
        units = units + change
    return np.concatenate([-np.rint((H + units).max(axis=1)).astype(int), units])
