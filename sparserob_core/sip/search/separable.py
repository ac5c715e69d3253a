"""Maxima of separable functions, sums of functions of one coordinate each, that are fitted to evaluated points."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from sparserob_core.sip.convex_set import Array

KNOTS = (40, 20, 10)
"""Numbers of knots of a function of one coordinate. Twice as many resolve hills of half the width, and need twice as
many points."""
POINTS_PER_UNKNOWN = 1.5
"""Points for each unknown of a fit. With fewer, the part of the values that is not separable determines the maximum."""
RIDGE = 1e-3
"""Regularisation of constants that the functions may exchange, and of knots without points. A value a thousand times
larger flattens hills."""


def separable_maxima(points: Array, values: Array) -> Iterator[Array]:
    """Yield the maxima ``(d,)`` of sums of functions of one coordinate each, fitted to evaluated points.

    The functions are piecewise linear, and fitted by least squares. The finest comes first; those for which there are
    too few points are left out. Nothing is yielded in one dimension, or where all values are equal.

    Parameters
    ----------
    points : ndarray, shape (k, d)
        Points of the unit box.
    values : ndarray, shape (k,)
        Their values; values that are not finite are ignored.

    Yields
    ------
    ndarray, shape (d,)
        Maximum of a fitted sum, in the unit box.
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
        if count < POINTS_PER_UNKNOWN * knots * dimension:
            continue
        places = points * (knots - 1)
        lower_knots = np.minimum(places.astype(int), knots - 2)
        share = places - lower_knots
        hats = np.zeros((count, dimension, knots))
        rows, columns = np.arange(count)[:, np.newaxis], np.arange(dimension)
        hats[rows, columns, lower_knots], hats[rows, columns, lower_knots + 1] = 1.0 - share, share
        basis = hats.reshape(count, -1)
        heights = np.linalg.solve(basis.T @ basis + RIDGE * np.eye(basis.shape[1]), basis.T @ scaled)
        yield heights.reshape(dimension, knots).argmax(axis=1) / (knots - 1.0)
