"""Lower bound of a robust linear program by weak duality."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy.sparse import csr_array

from sparserob_core.sip.convex_set import Array
from sparserob_core.sip.finite import FiniteProgram, UncertainRows
from sparserob_core.sip.inner.duality import Terms, add_pairwise, bound_rounding, replace_norms, tangent_terms


class RobustBound(NamedTuple):
    """Lower bound of a robust program by weak duality, but for the rounding of its evaluation.

    Parameters
    ----------
    value : float
        The bound, as it was computed.
    size : float
        Sum of the absolute numbers that were added up in it.
    rounding : float
        Bound of the rounding error, as a share of the ``size``.
    """

    value: float
    size: float
    rounding: float


def robust_bound(
    program: FiniteProgram,
    blocks: list[UncertainRows],
    y: Array,
    deviations: Array,
    mu: Array,
    priced: bool,
    at: Array | None = None,
) -> RobustBound:
    """Return a lower bound of the cost by weak duality from multipliers ``y (r,) >= 0`` of rows at
    ``deviations (r, Q)`` and ``mu (e,)``. It is the minimum over the bounds of the program alone. Quadratic terms are
    replaced by their tangent ``at (n,)``, of 0 unless given. Not ``priced``: of the weighted sum of the rows, which is
    positive only where nothing is feasible."""
    constant, size = -add_pairwise(mu * program.b), float(np.abs(mu) @ np.abs(program.b))
    slope, noise = mu @ program.A, np.abs(mu) @ np.abs(program.A)
    if priced:
        constant, size = constant + program.constant, size + abs(program.constant)
        slope, noise = slope + program.q, noise + np.abs(program.q)
    if priced and program.P is not None and at is not None:
        gradient, sizes, square, square_size = tangent_terms(program.P, at)
        constant, size = constant - square, size + square_size
        slope, noise = slope + gradient, noise + sizes
    none = np.zeros(0, dtype=int), np.zeros(0)
    terms, magnitudes, longest, first = [none], [none], 2 * len(blocks) + program.b.size, 0
    for block in blocks:
        multipliers, w = y[first : first + block.h.size], deviations[first : first + block.h.size]
        first += block.h.size
        used = np.flatnonzero(multipliers)
        if not used.size:
            continue
        weight, weight_size = np.zeros((2, *block.d.shape))
        entries = (multipliers[used] * block.factor[used])[:, None] * w[used]
        np.add.at(weight, block.part[used], entries)
        np.add.at(weight_size, block.part[used], np.abs(entries))  # rows of one part may cancel
        longest += int(np.bincount(block.part[used]).max())
        terms += [weighted(multipliers, block.g), weighted(weight.ravel(), block.stacked)]
        magnitudes += [terms[-2], weighted(weight_size.ravel(), block.stacked)]
        constant += add_pairwise((weight * block.d).ravel()) - add_pairwise(multipliers * block.h)
        size += float((weight_size * np.abs(block.d)).sum() + multipliers @ np.abs(block.h))
    column, value = (np.concatenate(arrays) for arrays in zip(*terms, strict=True))
    slope = slope + np.bincount(column, value, program.n)
    noise_column, noise_value = (np.concatenate(arrays) for arrays in zip(*magnitudes, strict=True))
    noise = noise + np.bincount(noise_column, np.abs(noise_value), program.n)
    weights = program.weights if priced else np.zeros(program.n)
    if priced and program.blocks is not None:
        tilted = replace_norms(Terms(constant, slope, noise, weights, None, size, at), program)
        slope, noise, weights = tilted.slope, tilted.noise, tilted.weights
    ends = np.stack([program.lower, program.upper, np.clip(0.0, program.lower, program.upper)])
    with np.errstate(invalid="ignore"):
        least = (weights * np.abs(ends) + np.where(slope == 0.0, 0.0, slope * ends)).min(axis=0)
        reach = np.where(noise > 0.0, np.abs(ends[:2]).max(axis=0), np.abs(ends[2]))
        largest = np.where(noise + weights > 0.0, (noise + weights) * reach, 0.0)
    bound, size = constant + add_pairwise(least), size + float(largest.sum())
    # a slope has a term for each entry of its column; other sums are by pairs, but for those over the blocks
    longest += int(np.bincount(column, minlength=1).max())
    longest += 0 if program.P is None else int(np.diff(program.P.indptr).max(initial=0))
    count = max(program.n, *(max(block.d.size, block.h.size) for block in blocks), 1)
    rounding = bound_rounding(longest + count.bit_length())
    return RobustBound(bound, size, rounding) if np.isfinite(bound) else RobustBound(-np.inf, size, rounding)


def weighted(weights: Array, table: csr_array) -> tuple[np.ndarray, Array]:
    """Return the terms of ``weights @ table`` of a sparse ``table (r, n)``: columns and values, which are still to be
    added up; of thousands of small tables at once that is far less than their products."""
    row = np.repeat(weights, np.diff(table.indptr))
    used = np.flatnonzero(row)
    return table.indices[used], row[used] * table.data[used]
