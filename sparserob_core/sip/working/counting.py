"""Number of entries of ``S x`` that are not 0: the counted program, and the lower bound by a convex program.

The count ``sum_k activity_k [s_k != 0]``, ``s = S x``, is not convex. The largest convex function below ``[s != 0]`` on
``[lower, upper]`` with 0 inside is ``max(s, 0) / upper + max(-s, 0) / |lower|``. An entry whose bounds exclude 0 always
counts. So a semi-infinite program with that cost and the same constraints bounds the count of every feasible decision
from below. With one symmetric range and the L1 norm as the cost, it is the same program.
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

DUST = 1e-5  # of an entry's range: what solvers leave of an entry that should be 0; nothing is claimed without a proof
MISSED = 1e-6  # of one price: rounding error of a whole number of them
NEGLIGIBLE_ENTRY = 1e-12  # of the terms of which an entry is a sum: an entry of this size is rounding, and counts as 0


@final
@dataclass(frozen=True, eq=False)
class CountBound:
    """Convex program whose optimal value bounds the count from below.

    Parameters
    ----------
    program : SemiInfiniteProgram
        The same constraints with the convex cost below the count, in the cost's own unit.
    certain : float
        Count of the entries that always count, in the user's units.
    tilt : ndarray, shape (k,)
        Coefficients of the part of the cost that is linear in ``S x``.
    """

    program: SemiInfiniteProgram
    certain: float
    tilt: Array


def counted_below(program: SemiInfiniteProgram) -> CountBound:
    """Return the convex program whose cost plus ``certain`` is at most the count at every feasible decision."""
    prices = prices_of(program)
    finite, tilt, certain = convex_below(program.finite, prices / program.cost_unit)
    cost = finite.weights, finite.q
    cheaper = replace(program, weights=cost[0], q=cost[1], P=None, constant=0.0, blocks=None, largest=None, twin=None)
    return CountBound(cheaper, certain * program.cost_unit, tilt)


def convex_below(
    base: FiniteProgram, prices: Array, on: np.ndarray | None = None
) -> tuple[FiniteProgram, Array, float]:
    """Return the finite program with the convex cost below the count of its images.

    Parameters
    ----------
    base : FiniteProgram
        The program.
    prices : ndarray, shape (k,)
        Price of each image that is not 0.
    on : ndarray of bool, shape (k,), optional
        Images that count in any case.

    Returns
    -------
    program : FiniteProgram
        The program with the convex cost.
    tilt : ndarray, shape (k,)
        Coefficients of the part of the cost that is linear in the images.
    certain : float
        Count of the images that are ``on`` or whose bounds exclude 0.
    """
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
    """Return the slopes ``(up, down)`` of the convex function below ``[s != 0]``, above and below 0.

    Where one side is forbidden, its slope is that of the other side. Where there is no bound, the slope is 0.

    Parameters
    ----------
    lower, upper : ndarray, shape (k,)
        Bounds of the images.

    Returns
    -------
    up, down : ndarray, shape (k,)
        Cost per unit above 0, and per unit below 0.
    """
    with np.errstate(divide="ignore"):
        up, down = np.where(upper > 0.0, 1.0 / upper, 0.0), np.where(lower < 0.0, -1.0 / lower, 0.0)
    return np.where(upper > 0.0, up, down), np.where(lower < 0.0, down, up)


def prices_of(program: SemiInfiniteProgram) -> Array:
    """Return the price ``(k,)`` of every entry of ``S x`` that is not 0, in the user's units; 0 for entries that do not
    count."""
    prices = np.zeros(program.finite.weights.size)
    if program.activity is not None:
        prices[: program.activity.size] = program.activity
    return prices


def counting(program: SemiInfiniteProgram) -> int:
    """Return the number of first entries of a decision that determine the images that count.

    The number is that of all entries, unless bounds of absolute values follow the entries.
    """
    base, images = program.finite, 0 if program.activity is None else program.activity.size
    return program.n if base.S is None else int(np.unique(base.S.tocsr()[:images].indices).size)


def complete_decision(program: SemiInfiniteProgram, entries: Array) -> Array:
    """Return the decision ``(n,)`` that begins with ``entries``, and whose others are as small as bounds of images
    allow."""
    base, size = program.finite, entries.size
    if program.n == size:
        return entries
    assert base.S is not None
    rows, other_columns = base.lower - base.S[:, :size] @ entries, base.S[:, size:].tocoo()
    other_entries = np.zeros(program.n - size)
    np.maximum.at(other_entries, other_columns.col, rows[other_columns.row] / other_columns.data)
    return np.concatenate([entries, other_entries])


def count(program: SemiInfiniteProgram, x: Array) -> float:
    """Return the count of a decision ``x (n,)``, in the user's units; entries of one vector count together."""
    base = program.finite
    terms = np.abs(x) if base.S is None else abs(base.S) @ np.abs(x)
    return count_of(program, np.abs(base.image(x)) > NEGLIGIBLE_ENTRY * terms)


def count_of(program: SemiInfiniteProgram, acts: np.ndarray) -> float:
    """Return the count, in the user's units, where the images ``acts (k,)`` are not 0."""
    return math.fsum(together(program)[np.unique(vectors(program)[acts & (prices_of(program) > 0.0)])])


def together(program: SemiInfiniteProgram) -> Array:
    """Return the price ``(g,)`` of every block of entries and of every entry that counts alone; 0 for numbers without
    one."""
    return np.asarray(np.bincount(vectors(program), prices_of(program)), dtype=float)


def vectors(program: SemiInfiniteProgram) -> np.ndarray:
    """Return for each image ``(k,)`` the number of the first image of its vector, with which it counts."""
    numbers, blocks = np.arange(program.finite.weights.size), program.finite.blocks
    if blocks is None:
        return numbers
    first = np.full(int(blocks.number.max(initial=-1)) + 1, -1)
    first[blocks.number[blocks.first]] = blocks.first
    return np.asarray(np.where(blocks.number >= 0, first[blocks.number], numbers))


def share_of(program: SemiInfiniteProgram, counted: float) -> float:
    """Return a count as a share of the largest count."""
    prices = together(program)
    prices = prices[prices > 0.0]
    price = _find_common_price(prices)
    return float(np.rint(counted / price) / prices.size if price else counted / math.fsum(prices))


def round_up_count(program: SemiInfiniteProgram, least: float) -> float:
    """Return the smallest count of at least ``least``, except for rounding, where all prices are equal.

    Parameters
    ----------
    program : SemiInfiniteProgram
        The program.
    least : float
        Lower bound of the count, in the user's units.

    Returns
    -------
    float
        A multiple of the price, not more than the largest count; ``least`` itself, at least 0, where prices differ.
    """
    prices = together(program)
    price = _find_common_price(prices[prices > 0.0])
    if not price:
        return max(0.0, least)
    return float(min(np.count_nonzero(prices), max(0.0, np.ceil(least / price - MISSED)))) * price


def _find_common_price(prices: Array) -> float:
    """Return the common price of all entries; 0 where prices differ."""
    return float(prices.mean()) if prices.size and np.ptp(prices) <= NEGLIGIBLE_ENTRY * prices.max() else 0.0


def tidy_decision(program: SemiInfiniteProgram, x: Array) -> Array:
    """Return the decision ``x (n,)`` with entries of ``S x`` that are nearly 0, or nearly at a bound, moved there.

    Only entries that count are moved to 0. Where the count would not fall, or the program is too large, ``x`` itself is
    returned. The new decision may violate constraints, which must be checked again.
    """
    base, prices = program.finite, prices_of(program)
    radii = np.maximum(np.abs(base.lower), np.abs(base.upper))
    image = base.image(x)
    is_small = np.isfinite(radii) & (prices > 0.0) & (np.abs(image) <= DUST * radii)
    is_small &= (base.lower <= 0.0) & (base.upper >= 0.0)
    if not (is_small & (image != 0.0)).any():
        return x
    if (np.abs(image) <= DUST * radii).all():
        return np.zeros_like(x)  # least squares would leave rounding errors, and a cost that is not exactly 0
    if base.S is None:
        return np.where(is_small, 0.0, x)
    if x.size > MAX_IMAGE_VARIABLES:
        return x
    with np.errstate(invalid="ignore"):
        targets = np.where(is_small, 0.0, np.where(image > 0.0, base.upper, base.lower))
        is_fixed = is_small | (np.isfinite(targets) & (np.abs(image - targets) <= DUST * np.abs(targets)))
    rows = base.S[np.flatnonzero(is_fixed)].toarray()
    is_single = np.count_nonzero(rows, axis=1) == 1  # images of one entry, which are 0 exactly where the entry is 0
    candidate, is_free = x.copy(), np.ones(x.size, dtype=bool)
    is_free[np.abs(rows[is_single & is_small[is_fixed]]).argmax(axis=1)] = False
    candidate[~is_free] = 0.0
    candidate[is_free] += np.linalg.lstsq(rows[:, is_free], targets[is_fixed] - rows @ candidate, rcond=None)[0]
    return candidate if count(program, candidate) < count(program, x) else x


def meet_equalities(program: SemiInfiniteProgram, x: Array, G: Array, h: Array) -> Array:
    """Return the decision ``x (n,)`` with its equalities, and the rows ``G x = h``, satisfied to rounding.

    Only entries that are neither 0 nor at a bound are changed. The rows are those that an earlier decision satisfied
    with equality. Where entries were moved to 0, the others make up for their part in these rows. Where there is
    nothing to satisfy, ``x`` itself is returned.

    Parameters
    ----------
    program : SemiInfiniteProgram
        The program.
    x : ndarray, shape (n,)
        The decision.
    G : ndarray, shape (r, n)
        Rows.
    h : ndarray, shape (r,)
        Their values at the earlier decision.

    Returns
    -------
    ndarray, shape (n,)
        The decision.
    """
    base = program.finite
    if not base.b.size + h.size or (base.S is not None and x.size > MAX_IMAGE_VARIABLES):
        return x
    widths = np.where(np.isfinite(base.upper - base.lower), base.upper - base.lower, 1.0)
    image, is_free, kept_rows = base.image(x), np.ones(x.size, dtype=bool), np.zeros((0, x.size))
    is_at_bound = (image <= base.lower + DUST * widths) | (image >= base.upper - DUST * widths)
    if base.S is None:
        is_free = (np.abs(x) > DUST * widths) & ~is_at_bound
    else:
        is_fixed = is_at_bound | ((image == 0.0) & (prices_of(program) > 0.0))
        rows = base.S[np.flatnonzero(is_fixed)].toarray()
        is_single = np.count_nonzero(rows, axis=1) == 1
        is_free[np.abs(rows[is_single]).argmax(axis=1)], kept_rows = False, rows[~is_single]
    columns, decision = np.vstack([base.A, G, kept_rows])[:, is_free], x.copy()
    sizes = np.linalg.norm(columns, axis=1)
    sizes = np.where(sizes > 0.0, sizes, 1.0)[:, None]
    for _ in range(REFINEMENT_ROUNDS):
        residuals = np.concatenate([base.excess(decision), G @ decision - h, kept_rows @ (decision - x)])
        decision[is_free] -= np.linalg.lstsq(columns / sizes, residuals / sizes[:, 0], rcond=None)[0]
    return decision


REFINEMENT_ROUNDS = 3  # of the least squares that meet active rows: the second one corrects the rounding of the first
MAX_IMAGE_VARIABLES = 2000  # largest number of variables for which images are solved
