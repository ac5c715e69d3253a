"""Derivatives of a constraint in its index: the family's own, or differences of its rows inside the index set."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from sparserob_core.sip.convex_set import Array
from sparserob_core.sip.program import ConstraintFamily

# of the width of the box: where truncation and rounding of a central difference are equal
STEP = float(np.cbrt(np.finfo(float).eps))


def index_gradient(family: ConstraintFamily, x: Array, indices: Array, rows: Array) -> Array:
    """The derivative ``(k, d)`` of ``row x - rhs`` in the index, one row of the family per index: ``indices (k, d)``,
    ``rows (k,)``.

    The family's ``gradient`` where it offers one. Else second-order differences of its rows, never outside the index
    set: about ``1e-9`` of the largest derivatives where the rows are smooth; two evaluations per coordinate, three
    beside a face. Zero in coordinates that cannot move. At a kink it is one of the slopes beside it, or a mean of them.
    """
    if family.gradient is not None:
        return np.asarray(family.gradient(x, indices, rows), dtype=float)
    row_numbers = np.asarray(rows, dtype=int)

    def violation(points: Array, owner: np.ndarray) -> Array:
        return np.asarray(family.violations(x, points)[np.arange(owner.size), row_numbers[owner]], dtype=float)

    return differences(violation, indices, family.index_set.lower, family.index_set.upper)


def differences(function: Callable[[Array, np.ndarray], Array], points: Array, lower: Array, upper: Array) -> Array:
    """The derivatives ``(k, d, ...)`` at ``points (k, d)`` of ``function(points (j, d), owner (j,)) -> (j, ...)`` in
    the box ``[lower, upper]``.

    ``owner`` says which of the ``k`` points an evaluated one belongs to. Three points in line, two where the middle one
    has no weight; they are moved inwards at a face, where the derivative is that of the parabola through them. Zero
    where ``lower == upper``.
    """
    slopes: dict[int, Array] = {}
    for axis in np.flatnonzero(upper > lower):
        step = STEP * (upper[axis] - lower[axis])
        middles = points.copy()
        middles[:, axis] = np.clip(points[:, axis], lower[axis] + step, upper[axis] - step)
        slopes[int(axis)] = _compute_parabola_slopes(function, points, middles, int(axis), step)
    still = np.zeros_like(next(iter(slopes.values())) if slopes else function(points, np.arange(points.shape[0])))
    return np.stack([slopes.get(axis, still) for axis in range(points.shape[1])], axis=1)


def _compute_parabola_slopes(
    function: Callable[[Array, np.ndarray], Array], points: Array, middles: Array, axis: int, step: float
) -> Array:
    """The slopes at ``points`` of parabolas through three values about ``middles``, a step apart along one axis."""
    owner = np.arange(points.shape[0])
    ends = np.vstack([middles, middles])
    ends[: owner.size, axis] -= step
    ends[owner.size :, axis] += step
    gap = ends[owner.size :, axis] - ends[: owner.size, axis]
    values = function(ends, np.tile(owner, 2))
    low, high = values[: owner.size], values[owner.size :]
    column = (slice(None), *[None] * (values.ndim - 1))
    slope: Array = (high - low) / gap[column]
    offsets = (points[:, axis] - middles[:, axis]) / step
    shifted = np.flatnonzero(offsets)
    if shifted.size:
        bend = high[shifted] + low[shifted] - 2.0 * function(middles[shifted], shifted)
        slope[shifted] += (2.0 * offsets[shifted] / gap[shifted])[column] * bend
    return slope
