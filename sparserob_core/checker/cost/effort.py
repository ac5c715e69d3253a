"""The largest effort over all deviations, bounded in balls: ``max_z sum_k |a_k + A_k z|``.

The sum is at most ``sum_k (s_k (a_k + A_k z) + h_k)``. Either ``s_k`` is the sign of the entry and ``h_k = 0``. Or
``s_k`` is any number of ``[-1, 1]`` and ``h_k`` the larger of ``high (1 - s_k)`` and ``-low (1 + s_k)``, for an entry
from ``low`` to ``high``: an absolute value minus a linear function is convex, hence largest at an end. The maximum of
the right side has a closed form. The search branches on the sign of one entry after the other, until the bound is small
enough.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from flint import arb

from sparserob_core.checker.arithmetic.balls import ball, balls
from sparserob_core.checker.arithmetic.series import stacked
from sparserob_core.checker.outcome import Broken, Clock, Unchecked
from sparserob_core.sip.convex_set import Array

MAX_PARTS = 200_000  # parts of the search that are examined at most
TOGETHER = 200  # parts that are bounded by one product of matrices


def prove_effort_limit(
    a: list[arb], A: list[list[arb]], support: Callable[[list[arb]], arb], reach: Array, limit: arb, clock: Clock
) -> int:
    """Show that the largest effort ``max_z sum_k |a_k + A_k z|``, ``A (n, Q)``, is at most a ``limit``; return the
    number of parts that were examined. ``support`` is the support function of the deviations; approximate bounds
    ``reach (Q,)`` of them decide the order of the search.

    Raise `Broken` where the effort is certainly larger, `Unchecked` where the question remains undecided."""
    high = [x + support(row) for x, row in zip(a, A, strict=True)]
    low = [x - support([-y for y in row]) for x, row in zip(a, A, strict=True)]
    slopes = np.array([_compute_chord_slope(float(u), float(v)) for u, v in zip(high, low, strict=True)])
    ends = zip(high, low, balls(slopes), strict=True)
    heights = [(u * (1 - s)).max(-v * (1 + s)).max(ball(0)) for u, v, s in ends]
    middles, table = np.array([float(x) for x in a]), stacked([[x, *row] for x, row in zip(a, A, strict=True)])
    matrix = np.array([[float(x) for x in row] for row in A]).reshape(len(a), -1)
    float_heights = np.array([float(h) for h in heights])
    pending: list[tuple[Array, np.ndarray]] = [(slopes, np.array([bool(h > 0) or not h.is_zero() for h in heights]))]
    count = 0
    while pending:
        clock.check()
        batch, pending = pending[-TOGETHER:], pending[:-TOGETHER]
        count += len(batch)
        if count > MAX_PARTS:
            raise Unchecked(f"the largest effort was not bounded by {count} parts of the signs of the control")
        sums = (stacked([[ball(s) for s in signs] for signs, _ in batch]) * table).tolist()
        for (signs, is_open), (constant, *coefficients) in zip(batch, sums, strict=True):
            bound = constant + support(coefficients) + sum((heights[k] for k in np.flatnonzero(is_open)), ball(0))
            if bound <= limit:
                continue
            if not is_open.any():
                if bound > limit:
                    raise Broken(f"a disturbance causes the effort {float(bound)!r}")
                raise Unchecked("the largest effort is known too roughly")
            worst = np.sign(np.array([float(x) for x in coefficients])) * reach
            values = middles + matrix @ worst
            k = int(np.where(is_open, float_heights + signs * values - np.abs(values), -np.inf).argmax())
            still_open = is_open.copy()
            still_open[k] = False
            for sign in (1.0, -1.0):
                branch_signs = signs.copy()
                branch_signs[k] = sign
                pending.append((branch_signs, still_open))
    return count


def _compute_chord_slope(high: float, low: float) -> float:
    """Return the slope of the chord of the absolute value, within ``[-1, 1]``."""
    if low >= 0.0 or high <= 0.0:
        return 1.0 if low >= 0.0 else -1.0
    return float(np.clip((high + low) / (high - low), -1.0, 1.0))
