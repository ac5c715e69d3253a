"""Signals with a budget over time in ball arithmetic, bounded by weak duality with a multiplier of its own."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cached_property, lru_cache
from typing import final

import numpy as np
from flint import arb

from sparserob_core.checker.arithmetic.balls import ball, balls
from sparserob_core.checker.sets.polynomials import HALF_ULP, OUTWARD, rounding
from sparserob_core.checker.sets.shape import Shape, total
from sparserob_core.control.sets.budget import BudgetedSignals
from sparserob_core.sip.convex_set import Array, ConvexSet

HALVINGS = 100  # of the interval of a multiplier: any multiplier is valid, and with half of them digits are lost
INSIDE = 1.0 - 1e-13  # factor by which a point whose sums are rounded becomes one of the set


@final
class Budgeted(Shape):
    """The set ``{x : |x_i| <= r_i, sum_i h_i |x_i|^p <= size}``.

    For every ``lambda >= 0``, ``c'x <= lambda size + sum_i phi_i(c_i)`` on the set, with ``phi_i(f)`` the maximum of
    ``f x - lambda h_i |x|^p`` over ``|x| <= r_i``. Points of the set give lower bounds.
    """

    source: BudgetedSignals

    def holds(self, point: Sequence[arb]) -> bool:
        is_in_box = all(bool(abs(x) <= ball(r)) for x, r in zip(point, self.source.radii, strict=True))
        return is_in_box and bool(self._compute_cost(point) <= ball(self.source.size))

    def member(self, point: Sequence[float] | Array, near: float = 0.0) -> list[arb] | None:
        """Return the point itself, or the point times `INSIDE`, where one of the two is proven to be in the set."""
        exact = balls(point)
        candidates = (exact, [INSIDE * x for x in exact])
        return next((candidate for candidate in candidates if self.holds(candidate)), None)

    def _compute_cost(self, point: Sequence[arb]) -> arb:
        squared = self.source.p == 2
        return total(ball(h) * (x * x if squared else abs(x)) for h, x in zip(self.source.costs, point, strict=True))

    def support(self, direction: Sequence[arb]) -> arb:
        values = np.array([[float(c) for c in direction]])
        multipliers = self._choose_multipliers(np.abs(values))
        multiplier = ball(multipliers[0, 0])
        high = multiplier * ball(self.source.size)
        for c, r, h in zip(direction, balls(self.source.radii), balls(self.source.costs), strict=True):
            high = high + self._price(abs(c), multiplier * h, r)
        point = [ball(x) for x in self._choose_points(values, multipliers)[0]]
        while not self.holds(point):
            point = [INSIDE * x for x in point]
        low = total(c * x for c, x in zip(direction, point, strict=True))
        return low.union(high)

    def _price(self, size: arb, price: arb, radius: arb) -> arb:
        """Return the maximum of ``size x - price x^p`` over ``0 <= x <= radius``, or an upper bound of it."""
        if self.source.p == 1:
            return radius * (size - price).nonnegative_part()
        if size >= 2 * price * radius:
            return radius * size - price * radius * radius
        return size * size / (4 * price) if price > 0 else radius * size

    def bound(self, value: Array, spread: Array) -> tuple[Array, Array]:
        """Return what `Shape.bound` says. For ``p = 1`` the multiplier follows the coordinate on which the last of the
        budget is spent: ``lambda(f) = |f_j| / h_j``, linear in ``f``. For ``p = 2`` it is that of the middle."""
        if self.source.p == 1:
            return self._bound_linear(value, spread)
        radii, costs, size = self.source.radii, self.source.costs, self.source.size
        multipliers = self._choose_multipliers(np.abs(value))
        low, high = (self._evaluate_prices(value + sign * spread, multipliers) for sign in (-1.0, 1.0))
        points = self._choose_points(value, multipliers)
        with np.errstate(divide="ignore", invalid="ignore"):
            chord = np.where(spread > 0.0, (high - low) / (2.0 * spread), points)
        w = np.clip(np.where(np.isfinite(chord), chord, points), -radii, radii)
        ends = [prices - w * (value + sign * spread) for sign, prices in ((-1.0, low), (1.0, high))]
        excess = multipliers[:, 0] * size + np.maximum(*ends).sum(axis=1)
        reach = np.abs(value) + spread
        numbers = multipliers[:, 0] * size + 3.0 * (reach * radii).sum(axis=1)
        numbers = numbers + (multipliers * costs * radii**2).sum(axis=1)
        return w, (excess + rounding(8 * radii.size + 16) * numbers) * OUTWARD + 2.0 * HALF_ULP * numbers

    def _bound_linear(self, value: Array, spread: Array) -> tuple[Array, Array]:
        radii, costs, size = self.source.radii, self.source.costs, self.source.size
        multipliers = self._choose_multipliers(np.abs(value))
        k = np.arange(len(value))
        j = np.abs(np.abs(value) / costs - multipliers).argmin(axis=1)  # where the last of the budget is spent
        sign = np.where(value[k, j] >= 0.0, 1.0, -1.0)
        keeps = (np.abs(value[k, j]) > spread[k, j]) & (multipliers[:, 0] > 0.0)  # else the multiplier is a constant
        rate = np.where(keeps, sign / costs[j], 0.0)[:, None]
        middle = np.where(keeps[:, None], rate * value[k, j][:, None], multipliers)
        w, numbers = np.zeros_like(value), middle[:, 0] * size + 4.0 * ((np.abs(value) + spread) * radii).sum(axis=1)
        numbers = numbers + 4.0 * (costs * radii).sum() * (middle[:, 0] + np.abs(rate[:, 0]) * spread[k, j])
        excess = np.where(keeps, 0.0, multipliers[:, 0] * size)
        w[k, j] += rate[:, 0] * size
        is_last = np.arange(value.shape[1]) == j[:, None]
        for side in (1.0, -1.0):  # r max(side f_i - lambda(f) h_i, 0), the argument linear in f_i and f_j
            centre = side * value - middle * costs
            width = spread + np.abs(rate) * costs * spread[k, j][:, None]
            of_last = is_last & keeps[:, None]
            own = side - np.where(of_last, rate * costs, 0.0)
            centre = np.where(of_last & (side == sign[:, None]), 0.0, centre)
            width = np.where(of_last & (side == sign[:, None]), 0.0, width)
            share = np.where(width > 0.0, np.clip((centre + width) / np.where(width > 0.0, 2.0 * width, 1.0), 0.0, 1.0),
                             (centre > 0.0) * 1.0)  # fmt: skip
            # the chord of max(., 0) between both ends
            at_ends = [np.maximum(centre + s * width, 0.0) - share * (centre + s * width) for s in (-1.0, 1.0)]
            excess = excess + (radii * np.maximum(*at_ends)).sum(axis=1)
            slopes = radii * share
            w += slopes * np.where(of_last & (side == sign[:, None]), 0.0, own)
            w[k, j] -= (np.where(of_last, 0.0, slopes * rate * costs)).sum(axis=1)
            # what does not depend on f: a constant multiplier
            excess = excess - np.where(keeps, 0.0, (slopes * multipliers * costs).sum(axis=1))
        return w, (np.maximum(excess, 0.0) + rounding(16 * radii.size + 32) * numbers) * OUTWARD

    def _evaluate_prices(self, values: Array, multipliers: Array) -> Array:
        """Return the ``phi_i`` at values ``(k, d)`` for multipliers ``(k, 1)``, for ``p = 2``."""
        radii, prices, sizes = self.source.radii, multipliers * self.source.costs, np.abs(values)
        x = np.where(prices > 0.0, np.minimum(sizes / np.where(prices > 0.0, 2.0 * prices, 1.0), radii), radii)
        return np.asarray(sizes * x - prices * x**2)

    def _respond(self, sizes: Array, multipliers: Array) -> Array:
        """Return the maximisers of ``size x - lambda h x^p`` over ``0 <= x <= r``, for ``sizes (k, d)``."""
        radii, prices = self.source.radii, multipliers * self.source.costs
        if self.source.p == 1:
            return np.asarray(np.where(sizes > prices, radii, 0.0))
        bound = np.minimum(sizes / np.where(prices > 0.0, 2.0 * prices, 1.0), radii)
        return np.asarray(np.where(prices > 0.0, bound, radii))

    def _choose_multipliers(self, sizes: Array) -> Array:
        """Return multipliers ``(k, 1)`` near the best ones: where they are larger the budget is not spent."""
        source = self.source
        low = np.zeros((len(sizes), 1))
        if (source.costs * source.radii**source.p).sum() <= source.size:
            return low
        high = (sizes / source.costs).max(axis=1, keepdims=True)
        if source.p == 2:
            high = np.sqrt((sizes**2 / source.costs).sum(axis=1, keepdims=True) / (4.0 * source.size))
        for _ in range(HALVINGS):
            middle = (low + high) / 2.0
            spent = (source.costs * self._respond(sizes, middle) ** source.p).sum(axis=1, keepdims=True)
            low, high = np.where(spent > source.size, middle, low), np.where(spent > source.size, high, middle)
        return np.asarray(high)

    def _choose_points(self, values: Array, multipliers: Array) -> Array:
        """Return points ``(k, d)`` near the farthest ones: the response to the ``multipliers (k, 1)``, filled up to the
        budget."""
        source, sizes = self.source, np.abs(values)
        point = self._respond(sizes, multipliers)
        if source.p == 1:
            open_cost = source.costs * np.where(sizes > 0.0, source.radii - point, 0.0)
            order = np.argsort(-sizes / source.costs, axis=1)  # several may be equally good
            ordered = np.take_along_axis(open_cost, order, axis=1)
            left = np.maximum(source.size - (source.costs * point).sum(axis=1), 0.0)[:, None]
            filled = np.clip(left - (ordered.cumsum(axis=1) - ordered), 0.0, ordered)
            np.put_along_axis(open_cost, order, filled, axis=1)
            point = point + open_cost / source.costs
        return np.asarray(np.sign(values) * point)

    @cached_property
    def radius(self) -> list[float]:
        return [float(r) for r in self.source.radii]


def couple(bound: ConvexSet, lengths: Array, mid: Array, rad: Array) -> tuple[ConvexSet, Array, Array]:
    """Return the set of one block, and the coefficients ``(blocks, ..., w, b)`` of a disturbance on the blocks with
    their error bounds: unchanged where the ``bound`` is pointwise, else one block of all values, a component after
    another. ``lengths (blocks,)`` are those of the pieces."""
    if bound.is_pointwise:
        return bound, mid, rad
    mid, rad = (np.moveaxis(values, 0, -2) for values in (mid, rad))  # (..., w, blocks, b)
    mid, rad = (values.reshape(*values.shape[:-3], -1, values.shape[-1])[None] for values in (mid, rad))
    return join_signals(bound, lengths), mid, rad


def join_signals(bound: ConvexSet, lengths: Array) -> ConvexSet:
    """Return the set of signals of a set that couples values, on pieces of such ``lengths (n,)``; it is made once."""
    return _join_signals(bound, lengths.tobytes())


@lru_cache(maxsize=256)
def _join_signals(bound: ConvexSet, lengths: bytes) -> ConvexSet:
    return bound.of_signals(np.frombuffer(lengths))
