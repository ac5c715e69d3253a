"""From ball matrices to arrays with an error bound, and the disturbance's support function as a linear bound on small
ranges."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, final

import numpy as np

from sparserob_core.checker.outcome import Unchecked
from sparserob_core.checker.sets.shapes import boxed, corners, known
from sparserob_core.control.sets.sets import Box, ConvexSet, Ellipsoid, NormBall, Polytope
from sparserob_core.sip.convex_set import Array

if TYPE_CHECKING:
    from flint import arb_mat

HALF_ULP = 1.2e-16
OUTWARD = 1.0 + 1e-12  # factor on computed error bounds, which are sums of a few thousand rounded numbers at most
TINY = 1e-300
ROUNDING = 1e-13  # of a sum of floats, relative to the sum of absolute values (up to a few hundred terms)


def rounding(terms: int) -> float:
    """What rounding may do to a sum of that many products, relative to the sum of their absolute values (Higham 2002,
    section 3.1)."""
    return (terms + 4) * HALF_ULP


@final
@dataclass(frozen=True, eq=False)
class Enclosed:
    """Numbers ``mid`` that are off by at most ``rad``, arrays of one shape."""

    mid: Array
    rad: Array

    @staticmethod
    def of(matrix: arb_mat) -> Enclosed:
        """The entries of a ball matrix, ``(rows, columns)``."""
        return Enclosed.all([matrix], (matrix.nrows(), matrix.ncols()))

    @staticmethod
    def all(matrices: Sequence[arb_mat], shape: tuple[int, ...]) -> Enclosed:
        """The entries of ball matrices, one matrix after another, row by row, in an array of that shape."""
        entries = [x for matrix in matrices for x in matrix.entries()]
        mid = np.array([float(x.mid()) for x in entries]).reshape(shape)
        rad = np.array([float(x.rad()) for x in entries]).reshape(shape)
        if not (np.isfinite(mid).all() and np.isfinite(rad).all()):
            raise Unchecked("the response grows beyond what numbers can hold")
        return Enclosed(mid, (rad + HALF_ULP * np.abs(mid)) * OUTWARD + TINY)


def linear_bound(shape: ConvexSet, value: Array, spread: Array) -> tuple[Array, Array]:
    """``w (k, mw)`` and ``excess (k,)`` with ``h(f) <= w'f + excess`` for every ``f`` within ``spread (k, mw)`` of
    ``value (k, mw)``.

    For flat sets ``w`` is the corner that is best at ``value``, and nothing is lost where it stays the best; for round
    ones the loss is of second order in ``spread``: in the norm of the set,
    ``|f| - f0'f / |f0| <= |f - f0|^2 / (2 (|f0| - |f - f0|))``.
    """
    known(shape)
    shape = boxed(shape)
    if isinstance(shape, Box):
        w = np.where(value >= 0, shape.upper, shape.lower)
        return w, (np.maximum(spread - np.abs(value), 0.0) * (shape.upper - shape.lower)).sum(axis=1) * OUTWARD
    if isinstance(shape, Polytope) or (isinstance(shape, NormBall) and shape.p == 1.0):
        points = (
            np.array([[float(x) for x in corner] for corner in corners(shape)])
            if isinstance(shape, Polytope)
            else _octahedron(shape)
        )
        heights = value @ points.T
        best = heights.argmax(axis=1)
        w, reach = points[best], np.abs(value) + spread
        apart = np.einsum("kvw,kw->kv", np.abs(points[None] - w[:, None]), spread)
        ahead = heights - heights.max(axis=1, keepdims=True) + apart
        ahead += 3.0 * rounding(shape.dimension) * (reach @ np.abs(points).max(axis=0))[:, None]
        ahead[np.arange(best.size), best] = 0.0
        corner = 2.0 * HALF_ULP * (reach @ np.abs(points).T).max(axis=1)  # corners are rounded to floats
        return w, (np.maximum(ahead.max(axis=1), 0.0) + corner) * OUTWARD
    if isinstance(shape, Ellipsoid) or (isinstance(shape, NormBall) and shape.p == 2.0):
        S = shape.shape if isinstance(shape, Ellipsoid) else shape.radius**2 * np.eye(shape.dimension)
        return _round_bound(shape.centre, S, value, spread)
    raise Unchecked(f"the checker has no bound of the support function of this {type(shape).__name__}")


def _round_bound(centre: Array, S: Array, value: Array, spread: Array) -> tuple[Array, Array]:
    square = np.maximum(np.einsum("ki,ij,kj->k", value, S, value), 0.0)
    lost = ROUNDING * np.einsum("ki,ij,kj->k", np.abs(value), np.abs(S), np.abs(value))  # by cancellation
    size = np.sqrt(square)
    safe = np.where(size > 0, size, 1.0)
    w = centre + np.where(size[:, None] > 0, value @ S / safe[:, None], 0.0)
    off = spread @ np.sqrt(np.diag(S)) * OUTWARD
    with np.errstate(divide="ignore", invalid="ignore"):
        excess = np.where(off < 0.5 * size, off**2 / (2.0 * (size - off)), 2.0 * off + np.where(size > 0, 0.0, off))
    short = np.sqrt(square + lost) - size + lost / safe
    return w, (excess + short) * OUTWARD + 1e-14 * (size + off + np.abs(value) @ np.abs(centre))


def _octahedron(shape: NormBall) -> Array:
    ends = np.vstack([np.eye(shape.dimension), -np.eye(shape.dimension)]) * shape.radius
    points: Array = shape.centre + ends
    return points
