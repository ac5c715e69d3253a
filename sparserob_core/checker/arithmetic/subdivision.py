"""The test for whether cells fill a box: exact, in rational arithmetic."""

from __future__ import annotations

from fractions import Fraction

import numpy as np

from sparserob_core.checker.outcome import NO_LIMIT, Broken, Clock, Unchecked
from sparserob_core.sip.convex_set import Array

MAX_CELLS = 100_000


def fill(lower: Array, upper: Array, low: Array, high: Array, clock: Clock = NO_LIMIT) -> None:
    """Raise `Broken` unless the cells ``[lower_i, upper_i]`` (``(k, d)``) fill the box ``[low, high]`` without overlap:
    they lie inside, share no more than faces, and have the volume of the box together. A coordinate in which the box is
    a point does not count in the volume."""
    if (
        lower.ndim != 2
        or lower.shape != upper.shape
        or lower.shape[1] != low.size
        or not (np.isfinite(lower).all() and np.isfinite(upper).all())
    ):
        raise Broken(f"its cells are no pairs of corners with {low.size} coordinates")
    if (lower < low).any() or (upper > high).any() or (lower > upper).any():
        raise Broken("a cell lies outside what is to be covered")
    thick = high > low
    if lower.shape[0] > MAX_CELLS and thick.sum() > 1:
        raise Unchecked(f"{lower.shape[0]} cells are too many to be told apart one by one")
    if not thick.any():
        if lower.shape[0] != 1:
            raise Broken(f"{lower.shape[0]} cells stand for a single point, expected one")
        return
    a, b = lower[:, thick], upper[:, thick]
    if _has_overlap(a, b, clock):
        raise Broken("two cells overlap")
    missing = _compute_volume(low[thick], high[thick])
    if a.shape[1] == 1:  # gaps lie between neighbours in order, before the first or after the last
        order = np.lexsort((b[:, 0], a[:, 0]))
        starts, stops = np.append(a[order, 0], high[thick]), np.append(low[thick], b[order, 0])
        missing = sum((Fraction(x) - Fraction(y) for x, y in zip(starts, stops, strict=True) if x != y), Fraction(0))
    else:
        missing -= sum((_compute_volume(x, y) for x, y in clock.each(zip(a, b, strict=True))), Fraction(0))
    if missing != 0:
        raise Broken(
            f"the cells leave a share of {float(missing / _compute_volume(low[thick], high[thick])):.3g}"
            " of the index set out"
        )


def _has_overlap(a: Array, b: Array, clock: Clock) -> bool:
    """Return True where two of the cells ``[a_i, b_i]`` share more than a face."""
    if a.shape[1] == 1:  # in order, only neighbours can overlap; of two with one start, the shorter is first
        order = np.lexsort((b[:, 0], a[:, 0]))
        return bool((b[order[:-1], 0] > a[order[1:], 0]).any())
    return any(
        bool(((a[i] < b[i + 1 :]) & (a[i + 1 :] < b[i])).all(axis=1).any()) for i in clock.each(range(a.shape[0]))
    )


def _compute_volume(low: Array, high: Array) -> Fraction:
    product = Fraction(1)
    for x, y in zip(low.tolist(), high.tolist(), strict=True):
        product *= Fraction(y) - Fraction(x)
    return product
