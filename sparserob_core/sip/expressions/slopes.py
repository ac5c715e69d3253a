"""Bounds of rows that are functions of Python over cells, from numbers that bound their slopes or their curvature."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from itertools import product
from typing import final

import numpy as np
import numpy.typing as npt

from sparserob_core.errors import InputError
from sparserob_core.shapes import Array
from sparserob_core.sip.expressions.rounding import rounding

# Indices at which a stated bound is compared with the rows; a tenth misses what turns a few times
COMPARED_INDICES = 64
# Of a bound: differences of rows round, so that a bound that is met exactly may seem exceeded
MET_BOUND_ALLOWANCE = 1e-6
# Of a side: distance of the indices that are compared; with a tenth of it rounding grows a hundredfold
COMPARED_DISTANCE = 1e-4
SLOPE_OUTWARD_FACTOR = 1.0 + 1e-9  # for sums of a few bounds that are not negative
MAX_COORDINATES = 8  # of an index with a bound of curvatures: a cell has 256 corners then

Rows = Callable[[Array], tuple[Array, Array]]


@final
@dataclass(frozen=True, eq=False)
class BoundedSlopes:
    """Rows ``rows(xi) x <= rhs(xi)`` whose entries, and right-hand sides, have bounded derivatives in the index.

    Parameters
    ----------
    rows : callable
        Maps indices ``(k, d)`` to ``(G (k, r, n), h (k, r))``.
    lower, upper : array (d,)
        Corners of the index set.
    bounds : array (d,)
        Bound of the derivative of every entry, in absolute value, in each coordinate of the index.
    order : int
        Order of that derivative: 1 for slopes, 2 for curvatures.
    """

    rows: Rows
    lower: Array
    upper: Array
    bounds: Array
    order: int

    @staticmethod
    def of(
        rows: Rows, lower: Array, upper: Array, lipschitz: npt.ArrayLike | None, curvature: npt.ArrayLike | None
    ) -> BoundedSlopes:
        """Return the rows with the bound that is given, after a look at samples; raise `InputError` where these
        contradict it."""
        given = {"lipschitz": lipschitz, "curvature": curvature}
        named = [name for name, bound in given.items() if bound is not None]
        if len(named) != 1:
            raise InputError(path="lipschitz", expected="one of lipschitz and curvature", got=f"{len(named)} of them")
        name = named[0]
        if isinstance(given[name], bool | str):
            raise InputError(path=name, expected="a number that is not negative", got=repr(given[name]))
        try:
            bounds = np.broadcast_to(np.asarray(given[name], dtype=float), (lower.size,)).copy()
        except (TypeError, ValueError):
            bounds = np.full(1, np.nan)
        if not (np.isfinite(bounds).all() and (bounds >= 0.0).all()):
            expected = f"a number that is not negative, or {lower.size} of them"
            raise InputError(path=name, expected=expected, got=repr(given[name]))
        if name == "curvature" and lower.size > MAX_COORDINATES:
            raise InputError(path=name, expected=f"an index of at most {MAX_COORDINATES} coordinates", got="more")
        _require_shapes(rows, lower, upper)
        found = BoundedSlopes(rows, lower, upper, bounds, 1 if name == "lipschitz" else 2)
        found._require_plausible(name)
        return found

    def enclose(self, x: Array, lower: Array, upper: Array) -> tuple[Array, np.ndarray]:
        """Return upper bounds ``(k,)`` of the violation at a decision over cells, and the coordinates to halve."""
        widths = np.maximum(upper - lower, 0.0)
        entries = float(np.abs(x).sum()) + 1.0  # how far a row moves where all its entries and the right side move by 1
        if self.order == 1:
            parts = entries * self.bounds * widths / 2
            values = self._evaluate(x, lower + widths / 2)
        else:  # a function is below its multilinear interpolant but for its curvatures in single coordinates
            parts = entries * self.bounds * widths**2 / 8
            moves = np.any(widths > 0.0, axis=0).tolist()
            corners = product(*([0.0, 1.0] if axis_moves else [0.0] for axis_moves in moves))
            values = np.max([self._evaluate(x, lower + np.array(corner) * widths) for corner in corners], axis=0)
        bounds = values + parts.sum(axis=1) * SLOPE_OUTWARD_FACTOR
        return bounds, np.where(parts.any(axis=1, keepdims=True), parts, widths).argmax(axis=1)

    def _evaluate(self, x: Array, indices: Array) -> Array:
        """Return the largest violation of all rows at each index, with the rounding of the sums added."""
        G, h = self.rows(np.clip(indices, self.lower, self.upper))
        rounded = rounding(x.size + 1) * (np.abs(G) @ np.abs(x) + np.abs(h))
        return np.asarray((G @ x - h + rounded).max(axis=1), dtype=float)

    def _require_plausible(self, name: str) -> None:
        """Raise `InputError` where differences of the rows at samples exceed the bound."""
        sides, rng = self.upper - self.lower, np.random.default_rng(0)
        for axis in np.flatnonzero(sides > 0.0).tolist():
            step = COMPARED_DISTANCE * sides[axis]
            room = sides.copy()
            room[axis] -= 2.0 * step
            first = self.lower + rng.random((COMPARED_INDICES, self.lower.size)) * room
            points = [first + k * step * np.eye(self.lower.size)[axis] for k in range(3)]
            tables = [np.concatenate([G, h[..., None]], axis=2) for G, h in map(self.rows, points)]
            change = tables[1] - tables[0] if self.order == 1 else tables[2] - 2.0 * tables[1] + tables[0]
            size = max(float(np.abs(table).max(initial=0.0)) for table in tables)
            largest = (float(np.abs(change).max(initial=0.0)) - 8.0 * np.finfo(float).eps * size) / step**self.order
            if largest > self.bounds[axis] * (1.0 + MET_BOUND_ALLOWANCE):
                at = first[int(np.abs(change).max(axis=(1, 2)).argmax())].tolist()
                what = "slope" if self.order == 1 else "curvature"
                expected = f"a bound of every {what} in coordinate {axis + 1} of the index"
                got = f"{self.bounds[axis]:.6g}, though an entry has {largest:.6g} near {at}"
                raise InputError(path=name, expected=expected, got=got)


def _require_shapes(rows: Rows, lower: Array, upper: Array) -> None:
    """Raise `InputError` unless rows and right-hand sides at two indices are finite numbers of their shapes."""
    indices = np.stack([lower + (upper - lower) / 2, lower])
    try:
        G, h = (np.asarray(table, dtype=float) for table in rows(indices))
    except (TypeError, ValueError) as error:
        expected = "a function of indices that returns rows and right-hand sides"
        raise InputError(path="rows", expected=expected, got=str(error)) from None
    if G.ndim != 3 or G.shape[:2] != h.shape or len(G) != len(indices):
        raise InputError(
            path="rows", expected="rows of shape (k, r, n) and right-hand sides (k, r)", got=f"{G.shape} and {h.shape}"
        )
    if not (np.isfinite(G).all() and np.isfinite(h).all()):
        raise InputError(path="rows", expected="finite numbers", got=f"others at the index {indices[0].tolist()}")
