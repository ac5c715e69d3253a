"""A dual bound in extended precision, with a running bound of its own rounding: for large multipliers.

Where rows are nearly parallel, as those at the end of an unstable system are, multipliers are large and cancel; what
double precision must allow for its rounding is then more than the gap that is to be closed.
"""

from __future__ import annotations

import numpy as np

from sparserob_core.shapes import Float, shaped
from sparserob_core.sip.convex_set import Array
from sparserob_core.sip.finite import FiniteProgram

WIDE = np.longdouble
# Of a slope: one that is so near its weight decides nothing, so that either side of its entry is evaluated.
SLOPE_ALLOWANCE = 1e-9
UNIT = float(np.finfo(WIDE).eps)  # at least twice the unit roundoff, whatever the machine calls extended


@shaped
def extended_bound(program: FiniteProgram, y: Float[Array, " r"], mu: Float[Array, " e"]) -> float:
    """Return a lower bound of the value for any ``y >= 0``, ``mu``. It is
    ``constant - y'h - mu'b + sum_k min_s weights_k |s| + 1/2 p_k s^2 + slope_k s`` over the bounds, with
    ``slope = q + G'y + A'mu``, rounded downwards.

    ``-inf`` for a program of another structure than an identity image, finite bounds and a diagonal ``P``.

    Why it is a bound (Higham 2002, sections 3.1 and 4.2). A sum of ``n`` products in floating point is off by at most
    ``gamma(n) = n u / (1 - n u)`` times the sum of their absolute values. Here ``u`` is doubled (`UNIT`), which pays
    for the rounding of that sum of absolute values, and of ``gamma``, itself. So the exact slope is in
    ``[slope - error, slope + error]``. The minimum over ``s`` is concave in the slope, so over that interval it is
    least at one of the two ends. Without curvature it is attained at ``lower``, 0 or ``upper``. With curvature ``p``
    the point ``s`` that is computed may miss the minimiser by ``2 u (|slope| + weights) / p``, which costs at most
    ``p/2`` times the square of that.
    """
    curvature = program.curvature if program.S is None else None
    if curvature is None or program.blocks is not None or not program.bounded:
        return -np.inf
    used = y > 0.0
    v = np.concatenate([y[used], mu]).astype(WIDE)
    rows = np.vstack([program.G[used], program.A]).astype(WIDE)
    rhs = np.concatenate([program.h[used], program.b]).astype(WIDE)
    slope, terms = program.q + v @ rows, np.abs(program.q) + np.abs(v) @ np.abs(rows)
    error = _bound_rounding(v.size + 2) * terms
    least = np.minimum(*(_minimise_entries(program, curvature, slope + side * error) for side in (-1.0, 1.0)))
    reach = np.maximum(np.abs(program.lower), np.abs(program.upper)).astype(WIDE)
    size = np.abs(v) @ np.abs(rhs) + np.abs(least).sum() + abs(program.constant)
    # the terms of each minimum are rounded too, and no larger than at the bound further away; where the slope is well
    # within the weight, the minimum is 0 without rounding
    near = (least != 0.0) | ((1.0 + SLOPE_ALLOWANCE) * np.abs(slope) + error >= program.weights)
    moving = np.where(near, (program.weights + terms + curvature * reach) * reach, 0.0)
    size = size + 8.0 * moving.sum() / (program.n + v.size + 8)
    total = least.sum() - v @ rhs + program.constant - _bound_rounding(program.n + v.size + 8) * size
    return float(np.nextafter(float(total), -np.inf))


def _bound_rounding(count: int) -> float:
    return count * UNIT / (1.0 - count * UNIT)


def _minimise_entries(program: FiniteProgram, curvature: Array, slope: Array) -> Array:
    """Return the minima ``(n,)`` over the bounds at a slope ``(n,)``; rounding of the terms apart."""
    lower, upper, weights = (array.astype(WIDE) for array in (program.lower, program.upper, program.weights))
    is_curved = curvature > 0.0
    pull = -slope - np.clip(-slope, -weights, weights)
    stationary = np.where(is_curved, pull / np.where(is_curved, curvature, 1.0), 0.0)
    inner = np.clip(stationary, lower, upper)
    values = [weights * np.abs(s) + (0.5 * curvature * s + slope) * s for s in (lower, inner, upper)]
    error = np.zeros_like(slope)
    error[is_curved] = 2.0 * (UNIT * (np.abs(slope[is_curved]) + weights[is_curved])) ** 2 / curvature[is_curved]
    return np.asarray(np.minimum(np.minimum(values[0], values[1]), values[2]) - error)
