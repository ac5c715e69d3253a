"""Half-spaces that cut a cell, taken into the bound of a function by multipliers."""

from __future__ import annotations

from itertools import chain, combinations

import numpy as np

from sparserob_core.sip.convex_set import Array

TOGETHER = 6    # cuts of one cell that are tried in all combinations; singly, beyond


def cheapest_multipliers(slopes: Array, slack: Array, gradient: Array) -> Array:
    """Multipliers ``(..., q)``, at least 0, for ``gradient (..., nu)``: small ``lambda's + |gradient - lambda'A|_1``, a bound of ``gradient'delta``
    for ``|delta_i| <= 1`` with ``A delta <= s`` (weak duality, for any ``lambda >= 0``).

    ``slopes`` is ``A (q, nu)``, ``slack`` is ``s (q,)``. Tried are the projections on every few rows of ``A``, which are exact at a corner of the
    set, and the multipliers of single rows that cancel one coordinate, which are exact beside one.
    """
    q, nu = slopes.shape
    trials = [np.zeros((*gradient.shape[:-1], q))]
    most = min(q, nu) if q <= TOGETHER else 1
    for chosen in chain.from_iterable(combinations(range(q), size) for size in range(1, most + 1)):
        trials.append(_placed(trials[0], chosen, gradient @ np.linalg.pinv(slopes[list(chosen)])))
    for row, coordinate in np.argwhere(slopes != 0.0):
        trials.append(_placed(trials[0], (row,), gradient[..., [coordinate]] / slopes[row, coordinate]))
    multipliers = np.stack(trials, axis=-2)
    heights = multipliers @ slack + np.abs(gradient[..., None, :] - multipliers @ slopes).sum(axis=-1)
    best: Array = np.take_along_axis(multipliers, heights.argmin(axis=-1)[..., None, None], axis=-2)[..., 0, :]
    return best


def _placed(zeros: Array, chosen: tuple[int, ...], values: Array) -> Array:
    trial = zeros.copy()
    trial[..., list(chosen)] = np.maximum(np.where(np.isfinite(values), values, 0.0), 0.0)
    return trial
