"""Sets whose sum is the set of an input, and integrals of their support functions along polynomials.

On each interval one corner is integrated in place of all. The error bound says how much better another corner
could be.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import final

import numpy as np

from sparserob_core.checker.sets.along import ROUNDS, SETTLED, NormSummand
from sparserob_core.checker.sets.polynomials import OUTWARD, rounding
from sparserob_core.sip.convex_set import Array

# Rounds that always cut where two corners are equally good. Later every second one halves the cell: where two corners
# touch at an end, that point lies next to this end, and such cuts gain little.
CROSSING = 8
SECANTS = 12  # steps of the search for the point where two corners are equally good


@final
@dataclass(frozen=True, eq=False)
class Summand:
    """A summand of the set of the deviations, by its ``corners (v, mw)`` with error bounds ``rad (v, mw)``."""

    corners: Array
    rad: Array

    @property
    def dimension(self) -> int:
        """The number of coordinates, ``mw``."""
        return int(self.corners.shape[1])

    @cached_property
    def radii(self) -> Array:
        """The upper bound of the absolute value of every coordinate on the set, ``(mw,)``."""
        return np.asarray((np.abs(self.corners) + self.rad).max(axis=0) * OUTWARD)

    @property
    def is_symmetric(self) -> bool:
        """True where the corners are opposite in pairs, the first to the last."""
        return all(np.array_equal(values, sign * values[::-1]) for values, sign in ((self.corners, -1), (self.rad, 1)))

    def widened(self, before: int, after: int) -> Summand:
        """Return the set with 0 in further coordinates before and after its own."""
        return Summand(*(np.pad(table, ((0, 0), (before, after))) for table in (self.corners, self.rad)))

    def integrate_support(self, plain: Array, off: Array, sizes: Array, ends: Array) -> tuple[Array, Array, Array]:
        """Return the integrals of the support function over ``u`` from -1 to ``ends (n,)``, along polynomials ``plain
        (n, p + 1, mw)`` with error bounds ``off`` and sums of absolute values ``sizes``; and how much more and how much
        less they may be."""
        P = np.einsum("npw,vw->npv", plain, self.corners)
        e = (off @ (np.abs(self.corners) + self.rad).T + sizes @ self.rad.T) * OUTWARD
        return integrate_maximum(P, e, ends)


def channels(count: int) -> list[Summand]:
    """Return the segments from -1 to 1 along every axis, whose support functions are absolute values."""
    return [Summand(np.stack([axis, -axis]), np.zeros((2, count))) for axis in np.eye(count)]


def integrate(
    summands: Sequence[Summand | NormSummand], plain: Array, off: Array, ends: Array | float = 1.0
) -> tuple[Array, Array]:
    """Return lower and upper bounds ``(n, S)`` of half the integrals, over ``u`` from -1 to ``ends (n,)``, of the
    support functions of ``summands`` along polynomials ``plain (n, p + 1, mw)`` with error bounds ``off (n, mw)``. Up
    to 1 they are means."""
    (count, order, mw), sizes = plain.shape, np.abs(plain).sum(axis=1)
    errors = off + rounding(4 * order + 32 + mw) * sizes
    integrals = [summand.integrate_support(plain, errors, sizes, np.broadcast_to(ends, count)) for summand in summands]
    value, excess, deficit = (np.stack(columns, axis=1) / 2.0 for columns in zip(*integrals, strict=True))
    rounded = rounding(4) * (np.abs(value) + excess)
    return value - deficit - rounded, value + excess + rounded


def integrate_maximum(P: Array, e: Array, ends: Array) -> tuple[Array, Array, Array]:
    """Return the integrals of the largest of ``v`` polynomials ``P (M, p + 1, v)``, over ``u`` from -1 to ``ends
    (M,)``, and how much more and how much less they may be. Error bounds ``e (M, v)`` of the polynomials allow for the
    rounding errors in the sum of two values."""
    orders = np.arange(P.shape[1])
    owners, start, stop = np.arange(len(P)), -np.ones(len(P)), ends.copy()
    value, excess, deficit = np.zeros(len(P)), np.zeros(len(P)), np.zeros(len(P))
    allowed = SETTLED * np.abs(P).sum(axis=1).max(axis=1)
    weights = 1.0 / (orders + 1.0)
    for iteration in range(ROUNDS + 1):
        Q = P[owners]
        start_values, stop_values = _evaluate_polynomials(Q, start), _evaluate_polynomials(Q, stop)
        best, rows, width = (start_values + stop_values).argmax(axis=1), np.arange(owners.size), stop - start
        G = Q[rows, :, best][:, :, None] - Q
        g = [values[rows, best][:, None] - values for values in (start_values, stop_values)]
        below = np.maximum(0.0, -np.minimum(*g))
        bend = (np.abs(G) * (orders * (orders - 1))[:, None]).sum(axis=1)
        # a function with |f''| <= bend that is not negative at the ends is nowhere negative where this holds
        near = (np.sqrt(np.maximum(g[0], 0.0)) + np.sqrt(np.maximum(g[1], 0.0))) ** 2
        dips = np.where(near >= bend * (width**2 / 2.0)[:, None], 0.0, bend * (width**2 / 8.0)[:, None])
        shortfall = (below + dips) * (1.0 + 1e-13)
        shortfall[rows, best] = 0.0
        shortfall = shortfall.max(axis=1)
        # where the corners differ by less than their error bounds, no further cut helps
        is_settled = (
            (shortfall * width <= allowed[owners]) | (shortfall <= e[owners].max(axis=1)) | (iteration == ROUNDS)
        )
        settled, targets = rows[is_settled], owners[is_settled]
        chosen = Q[settled, :, best[settled]] * weights
        area = (
            _evaluate_polynomials(chosen, stop[settled]) * stop[settled]
            - _evaluate_polynomials(chosen, start[settled]) * start[settled]
        )
        own_errors, largest_errors = e[targets, best[settled]], e[targets].max(axis=1)
        np.add.at(value, targets, area)
        # ``e`` allows for the rounding errors of two parts; with more parts, those at both ends of each are added
        rounded = 2.0 * rounding(orders.size + 4) * np.abs(chosen).sum(axis=1) * (iteration > 1)
        np.add.at(excess, targets, (shortfall[settled] + own_errors + 2.0 * largest_errors) * width[settled] + rounded)
        np.add.at(deficit, targets, own_errors * width[settled] + rounded)
        if is_settled.all():
            break
        open_cells = rows[~is_settled]
        a, b = start_values[open_cells].argmax(axis=1), stop_values[open_cells].argmax(axis=1)
        cut = (start[open_cells] + stop[open_cells]) / 2.0
        if iteration < CROSSING or iteration % 2:
            cut = _find_crossings(Q[open_cells, :, a] - Q[open_cells, :, b], start[open_cells], stop[open_cells])
        owners = np.tile(owners[open_cells], 2)
        start, stop = np.concatenate([start[open_cells], cut]), np.concatenate([cut, stop[open_cells]])
    return value, excess * OUTWARD, deficit * OUTWARD


def _evaluate_polynomials(P: Array, u: Array) -> Array:
    """Return the values of polynomials ``(M, p + 1, ...)`` at ``u (M,)``."""
    powers = u[:, None] ** np.arange(P.shape[1])
    return np.asarray(np.einsum("mp,mp...->m...", powers, P))


def _find_crossings(P: Array, start: Array, stop: Array) -> Array:
    """Return points near a root of polynomials ``(M, p + 1)`` that differ in sign at the ends, by the Illinois method:
    secants in which the value at the older end is halved. Elsewhere return the middle. All bounds hold wherever the
    points are."""
    a, b, fa, fb = start, stop, _evaluate_polynomials(P, start), _evaluate_polynomials(P, stop)
    middle_of = (a + b) / 2.0
    crossing, cut = fa * fb < 0.0, middle_of
    for _ in range(SECANTS):
        with np.errstate(divide="ignore", invalid="ignore"):
            cut = np.where(crossing, b - fb * (b - a) / (fb - fa), middle_of)
        cut = np.where(np.isfinite(cut), cut, middle_of)
        f = _evaluate_polynomials(P, cut)
        has_changed = f * fb < 0.0
        a, fa = np.where(has_changed, b, a), np.where(has_changed, fb, fa / 2.0)
        b, fb = cut, f
    margin = 1e-9 * (stop - start)
    return np.asarray(np.where(crossing & (cut > start + margin) & (cut < stop - margin), cut, middle_of))
