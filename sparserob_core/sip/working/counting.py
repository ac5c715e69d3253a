"""How often entries of ``S x`` are not 0: the counted program, and what a convex one proves of it.

The count ``sum_k activity_k [s_k != 0]``, ``s = S x``, is not convex. The largest convex function below ``[s != 0]`` on
``[lower, upper]`` with 0 inside is ``max(s, 0) / upper + max(-s, 0) / |lower|``; an entry whose bounds exclude 0 always
counts. So a semi-infinite program with that cost, and every constraint as it was, bounds the count of every feasible
decision from below: with one symmetric range and the L1 norm as the cost it is the same program.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import final

import numpy as np

from sparserob_core.shapes import Float, shaped
from sparserob_core.sip.convex_set import Array
from sparserob_core.sip.finite import FiniteProgram
from sparserob_core.sip.program import SemiInfiniteProgram

DUST = 1e-5  # of an entry's range: so much is what solvers leave where 0 is meant; nothing is claimed without a proof
MISSED = 1e-6  # of one count, by which a whole number of them may be missed
ROUNDED = 1e-12  # of the terms of which an entry is a sum: that much counts as 0, since it is rounding


@final
@dataclass(frozen=True, eq=False)
class Counted:
    """``program``: the same constraints with the convex cost below the count, in the cost's own unit; ``certain``: what
    is counted whatever the decision, in the user's units; ``tilt (k,)``: the part of the cost that is linear in
    ``S x``."""

    program: SemiInfiniteProgram
    certain: float
    tilt: Array


def counted_below(program: SemiInfiniteProgram) -> Counted:
    """The program whose cost, and ``certain``, are below the count at every feasible decision."""
    prices = prices_of(program)
    finite, tilt, certain = convex_below(program.finite, prices / program.cost_unit)
    cost = finite.weights, finite.q
    cheaper = replace(program, weights=cost[0], q=cost[1], P=None, constant=0.0, blocks=None, largest=None, twin=None)
    return Counted(cheaper, certain * program.cost_unit, tilt)


def convex_below(
    base: FiniteProgram, prices: Array, on: np.ndarray | None = None
) -> tuple[FiniteProgram, Array, float]:
    """The finite program with the convex cost below the count of its images ``(k,)``, the ``tilt (k,)`` of that cost,
    and what is counted in any case: images whose bounds exclude 0, and those that are ``on``."""
    always = (base.lower > 0.0) | (base.upper < 0.0)
    always = always if on is None else always | on
    up, down = slopes(base.lower, base.upper)
    share = np.where(always, 0.0, prices)
    tilt = share * (up - down) / 2.0
    q = tilt if base.S is None else np.asarray(base.S.T @ tilt)
    weights = share * (up + down) / 2.0
    cheaper = replace(base, weights=weights, q=q, P=None, constant=0.0, blocks=None)
    return cheaper, tilt, float(prices[always].sum())


@shaped
def slopes(lower: Float[Array, " k"], upper: Float[Array, " k"]) -> tuple[Float[Array, " k"], Float[Array, " k"]]:
    """``(up, down)``: what the convex function below ``[s != 0]`` costs per unit above and below 0. Where one side is
    forbidden its slope is that of the other; where there is no bound it is 0."""
    with np.errstate(divide="ignore"):
        up, down = np.where(upper > 0.0, 1.0 / upper, 0.0), np.where(lower < 0.0, -1.0 / lower, 0.0)
    return np.where(upper > 0.0, up, down), np.where(lower < 0.0, down, up)


def prices_of(program: SemiInfiniteProgram) -> Array:
    """What every entry of ``S x`` counts when it is not 0, ``(k,)``, in the user's units; zeros where none counts."""
    prices = np.zeros(program.finite.weights.size)
    if program.activity is not None:
        prices[: program.activity.size] = program.activity
    return prices


@shaped
def acting(coefficients: Float[Array, "m n"], values: Float[Array, "n k"]) -> np.ndarray:
    """Where ``coefficients @ values`` is not 0, ``(m, k)``, but for the rounding of that sum itself."""
    return np.asarray(np.abs(coefficients @ values) > ROUNDED * (np.abs(coefficients) @ np.abs(values)))


def counting(program: SemiInfiniteProgram) -> int:
    """How many entries of a decision make the images that count: the first ones, all that there are unless bounds of
    absolute values follow them."""
    base, images = program.finite, 0 if program.activity is None else program.activity.size
    return program.n if base.S is None else int(np.unique(base.S.tocsr()[:images].indices).size)


def completed(program: SemiInfiniteProgram, entries: Array) -> Array:
    """The decision ``(n,)`` that begins with ``entries``, and whose others are as small as bounds of the images
    allow."""
    base, size = program.finite, entries.size
    if program.n == size:
        return entries
    assert base.S is not None
    rows, rest = base.lower - base.S[:, :size] @ entries, base.S[:, size:].tocoo()
    found = np.zeros(program.n - size)
    np.maximum.at(found, rest.col, rows[rest.row] / rest.data)
    return np.concatenate([entries, found])


def count(program: SemiInfiniteProgram, x: Array) -> float:
    """The count of a decision ``x (n,)``, in the user's units: entries that make one vector count together."""
    base = program.finite
    terms = np.abs(x) if base.S is None else abs(base.S) @ np.abs(x)
    return count_of(program, np.abs(base.image(x)) > ROUNDED * terms)


def count_of(program: SemiInfiniteProgram, acts: np.ndarray) -> float:
    """The count, in the user's units, where these images ``(k,)`` are not 0."""
    return math.fsum(together(program)[np.unique(vectors(program)[acts & (prices_of(program) > 0.0)])])


def together(program: SemiInfiniteProgram) -> Array:
    """What counts together, ``(g,)``: every block of entries, and every entry that counts alone; 0 where none does."""
    return np.asarray(np.bincount(vectors(program), prices_of(program)), dtype=float)


def vectors(program: SemiInfiniteProgram) -> np.ndarray:
    """With which others each image counts, ``(k,)``: the number of the first image of its vector."""
    alone, blocks = np.arange(program.finite.weights.size), program.finite.blocks
    if blocks is None:
        return alone
    first = np.full(int(blocks.number.max(initial=-1)) + 1, -1)
    first[blocks.number[blocks.first]] = blocks.first
    return np.asarray(np.where(blocks.number >= 0, first[blocks.number], alone))


def share_of(program: SemiInfiniteProgram, counted: float) -> float:
    """What a count is of the largest."""
    prices = together(program)
    prices = prices[prices > 0.0]
    one = _one(prices)
    return float(np.rint(counted / one) / prices.size if one else counted / math.fsum(prices))


def whole(program: SemiInfiniteProgram, least: float) -> float:
    """The least count that is at least ``least`` but for rounding, where all that count, count the same: a whole number
    of them. ``least`` itself otherwise."""
    prices = together(program)
    one = _one(prices[prices > 0.0])
    if not one:
        return max(0.0, least)
    return float(min(np.count_nonzero(prices), max(0.0, np.ceil(least / one - MISSED)))) * one


def _one(prices: Array) -> float:
    """What all count, where that is the same; else 0."""
    return float(prices.mean()) if prices.size and np.ptp(prices) <= ROUNDED * prices.max() else 0.0


def tidied(program: SemiInfiniteProgram, x: Array) -> Array:
    """The decision ``x (n,)`` with entries of ``S x`` that are nearly 0, or nearly a bound, moved there, where they
    count; ``x`` itself where nothing is to be moved. It is as good as the constraints say: look at them again."""
    base, prices = program.finite, prices_of(program)
    reach = np.maximum(np.abs(base.lower), np.abs(base.upper))
    image = base.image(x)
    near = np.isfinite(reach) & (prices > 0.0) & (np.abs(image) <= DUST * reach)
    near &= (base.lower <= 0.0) & (base.upper >= 0.0)
    if not (near & (image != 0.0)).any():
        return x
    if (np.abs(image) <= DUST * reach).all():
        return np.zeros_like(x)  # least squares would leave rounding, and a cost that is not exactly 0
    if base.S is None:
        return np.where(near, 0.0, x)
    if x.size > LARGE:
        return x
    with np.errstate(invalid="ignore"):
        targets = np.where(near, 0.0, np.where(image > 0.0, base.upper, base.lower))
        still = near | (np.isfinite(targets) & (np.abs(image - targets) <= DUST * np.abs(targets)))
    rows = base.S[np.flatnonzero(still)].toarray()
    alone = np.count_nonzero(rows, axis=1) == 1  # images of one entry, which are 0 exactly where it is
    moved, free = x.copy(), np.ones(x.size, dtype=bool)
    free[np.abs(rows[alone & near[still]]).argmax(axis=1)] = False
    moved[~free] = 0.0
    moved[free] += np.linalg.lstsq(rows[:, free], targets[still] - rows @ moved, rcond=None)[0]
    return moved if count(program, moved) < count(program, x) else x


def met(program: SemiInfiniteProgram, x: Array, G: Array, h: Array) -> Array:
    """The decision ``x (n,)`` with its equalities, and the rows ``G x = h (r,)`` that an earlier one was held by, met
    to rounding, by those entries alone that are neither 0 nor at a bound; ``x`` itself where there is nothing to meet.
    Where entries were moved to 0, this is what they gave to rows at their limit, taken over by the others."""
    base = program.finite
    if not base.b.size + h.size or (base.S is not None and x.size > LARGE):
        return x
    reach = np.where(np.isfinite(base.upper - base.lower), base.upper - base.lower, 1.0)
    image, free, kept = base.image(x), np.ones(x.size, dtype=bool), np.zeros((0, x.size))
    ends = (image <= base.lower + DUST * reach) | (image >= base.upper - DUST * reach)
    if base.S is None:
        free = (np.abs(x) > DUST * reach) & ~ends
    else:
        still = ends | ((image == 0.0) & (prices_of(program) > 0.0))
        rows = base.S[np.flatnonzero(still)].toarray()
        alone = np.count_nonzero(rows, axis=1) == 1
        free[np.abs(rows[alone]).argmax(axis=1)], kept = False, rows[~alone]
    columns, moved = np.vstack([base.A, G, kept])[:, free], x.copy()
    sizes = np.linalg.norm(columns, axis=1)
    sizes = np.where(sizes > 0.0, sizes, 1.0)[:, None]
    for _ in range(REFINED):
        missed = np.concatenate([base.excess(moved), G @ moved - h, kept @ (moved - x)])
        moved[free] -= np.linalg.lstsq(columns / sizes, missed / sizes[:, 0], rcond=None)[0]
    return moved


REFINED = 3
LARGE = 2000  # variables that images are solved for
