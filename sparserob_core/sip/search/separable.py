"""Where a sum of functions of one coordinate each, fitted to evaluated points, has its maximum."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from sparserob_core.sip.convex_set import Array

KNOTS = (40, 20, 10)
"""Of a function of one coordinate: twice as many resolve hills of half the width, and need twice as many points."""
POINTS = 1.5
"""Points for each unknown of a fit: with fewer, noise of what is not separable decides where the maximum is."""
RIDGE = 1e-3
"""Against constants that the functions may exchange, and knots without points; a thousand times more flattens hills."""


def separable_maxima(points: Array, values: Array) -> Iterator[Array]:
    """Yield the maxima ``(d,)`` of sums of functions of one coordinate each, fitted to evaluated points.

    The functions are piecewise linear, the fits least squares; the finest comes first, and those are left out for which
    the points are too few. Nothing in one dimension, and where the values are all equal.

    Parameters
    ----------
    points : Array
        Points ``(k, d)`` of the unit box.
    values : Array
        Their values ``(k,)``; those that are not finite do not count.
    """
    finite = np.isfinite(values)
    points, values = points[finite], values[finite]
    count, dimension = points.shape
    largest = float(np.abs(values).max(initial=0.0))
    if dimension < 2 or not largest > 0.0:
        return
    scaled = values / largest
    scaled -= scaled.mean()
    spread = float(np.std(scaled))
    if not spread > 0.0:
        return
    scaled /= spread
    for knots in KNOTS:
        if count < POINTS * knots * dimension:
            continue
        places = points * (knots - 1)
        left = np.minimum(places.astype(int), knots - 2)
        share = places - left
        hats = np.zeros((count, dimension, knots))
        rows, columns = np.arange(count)[:, np.newaxis], np.arange(dimension)
        hats[rows, columns, left], hats[rows, columns, left + 1] = 1.0 - share, share
        basis = hats.reshape(count, -1)
        heights = np.linalg.solve(basis.T @ basis + RIDGE * np.eye(basis.shape[1]), basis.T @ scaled)
        yield heights.reshape(dimension, knots).argmax(axis=1) / (knots - 1.0)
