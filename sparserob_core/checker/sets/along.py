"""Integrals of the support function of a curved set along polynomials, between bounds.

On a cell, with ``s`` from -1 to 1, the argument is ``a_0 + a_1 s + ...``. In the disc ``|s| <= R`` it is within ``sum_n
|a_n| R^n`` of ``a_0``, entry by entry. Let the support function be analytic there, and at most ``M``. Then coefficients
of its series are at most ``M R^-n`` (Cauchy). Gauss' rule with ``q`` nodes is exact up to the degree ``2 q - 1``, so
that its error is at most ``4 M R^-2q / (1 - 1 / R)``. Other cells are halved. On a small cell with a kink the error is
at most the support function of the change of the argument.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from fractions import Fraction
from functools import cache, cached_property
from math import comb
from typing import final

import numpy as np

from sparserob_core.checker.outcome import Unchecked
from sparserob_core.checker.sets.curved import Ball, Ellipsoidal, Joint
from sparserob_core.checker.sets.flat import Boxed, Cornered, Segments
from sparserob_core.checker.sets.polynomials import HALF_ULP, OUTWARD, TINY, rounding
from sparserob_core.checker.sets.shape import Shape
from sparserob_core.sip.convex_set import Array

DISC = 3.0  # radius: with 2 the error of the rule is 1e-9, with 4 cells are halved once more
NODES = 16  # of Gauss' rule: its relative error is then 3e-15
LEFT = 4.0 * DISC ** (-2.0 * NODES) / (1.0 - 1.0 / DISC) * OUTWARD
ROUNDS = 60  # rounds in which cells are halved
SETTLED = 2.0**-49  # relative to the support values: a cell with a smaller error is halved no more
ROOM = 0.999  # the largest relative change of a sum of squares or powers: it stays away from 0 despite rounding
STEEP = 1e9  # the largest exponent: rounding changes such a power by some 1e-6 of itself, and `ROOM` leaves 1e-3
AT_ONCE = 20_000  # cells that are evaluated together: some 50 MB


@final
@dataclass(frozen=True, eq=False)
class CurvedSide:
    """A set relative to a point ``about (mw,)``, with integrals of its support function along polynomials."""

    shape: Shape
    about: Array

    @property
    def dimension(self) -> int:
        """The number of coordinates."""
        return self.shape.dimension

    @cached_property
    def far(self) -> Array:
        """The upper bounds ``(mw,)`` of the distance from the point to the set's ends along every coordinate."""
        axes = np.vstack([np.eye(self.dimension), -np.eye(self.dimension)])
        heights, errors = _evaluate_support(self.shape, self.about, axes)
        return np.asarray((heights + errors).reshape(2, -1).max(axis=0) * OUTWARD)

    def swept(self, plain: Array, off: Array, sizes: Array, ends: Array) -> tuple[Array, Array, Array, Array]:
        """Return the integral over ``u`` from -1 to ``ends (n,)`` of the support function at polynomials of ``u``.

        Parameters
        ----------
        plain
            Coefficients ``(n, p + 1, mw)`` of the polynomials.
        off
            Upper bounds ``(n, mw)`` of the errors of the polynomials.
        sizes
            The sums ``(n, mw)`` of the absolute values of the coefficients; not used here.
        ends
            The ends ``(n,)`` of the integrals.

        Returns
        -------
        tuple[Array, Array, Array, Array]
            Values, upper bounds of how much more and how much less the integral may be, and upper bounds of the
            absolute support values, ``(n,)`` each.
        """
        outputs = [np.zeros(0)] * 3
        for first in range(0, len(plain), AT_ONCE):
            batch = slice(first, first + AT_ONCE)
            batch_outputs = self._integrate(plain[batch], ends[batch])
            outputs = [np.concatenate(pair) for pair in zip(outputs, batch_outputs, strict=True)]
        value, errors, tops = outputs
        errors = (errors + (ends + 1.0) * (off @ self.far)) * OUTWARD
        return value, errors, errors, tops

    def _integrate(self, plain: Array, ends: Array) -> tuple[Array, Array, Array]:
        count = plain.shape[1]
        owner, radii = np.arange(len(plain)), self.far
        value, errors, length = np.zeros(len(plain)), np.zeros(len(plain)), (ends + 1.0) / 2.0
        tops = np.abs(plain).sum(axis=1) @ radii
        # on the cell from -1 to the end, with s from -1 to 1: u = -1 + length (1 + s) = (length - 1) + length s
        a, step_error = _rescale_polynomials(plain, length), rounding(2 * count) * tops
        coefficient_error = step_error.copy()
        nodes, weights = rule()
        orders, powers = np.arange(count), nodes[:, None] ** np.arange(count)
        for level in range(ROUNDS + 1):
            spread = np.einsum("n,mnw->mw", DISC ** orders[1:], np.abs(a[:, 1:])) * OUTWARD
            bounds = _bound_support(self.shape, self.about, a[:, 0], spread)
            heights, height_errors = _evaluate_support(self.shape, self.about, (powers @ a).reshape(-1, a.shape[2]))
            total = heights.reshape(len(a), -1) @ weights
            rounding_errors = (
                height_errors.reshape(len(a), -1) @ weights
                + rounding(4 * count + NODES) * np.abs(a).sum(axis=1) @ radii
            )
            rule_error = np.where(np.isfinite(bounds), LEFT * bounds, np.inf)
            change = 2.0 * np.abs(a[:, 1:]).sum(axis=1) @ radii
            middle_heights, middle_errors = _evaluate_support(self.shape, self.about, a[:, 0])
            if not np.isfinite(rounding_errors).all():
                raise Unchecked("a support function grows beyond what numbers can hold")
            use_middle = change < rule_error
            total, rule_error = np.where(use_middle, 2.0 * middle_heights, total), np.minimum(rule_error, change)
            rounding_errors = np.where(use_middle, np.maximum(rounding_errors, 2.0 * middle_errors), rounding_errors)
            width = length[owner] * 0.5**level
            is_done = (
                (rule_error * width <= SETTLED * tops[owner]) | (rule_error <= rounding_errors) | (level == ROUNDS)
            )
            finished = owner[is_done]
            np.add.at(value, finished, (total * width)[is_done])
            np.add.at(
                errors, finished, ((rule_error + rounding_errors + 2.0 * coefficient_error[owner]) * width)[is_done]
            )
            if is_done.all():
                break
            a, owner = a[~is_done], np.tile(owner[~is_done], 2)
            coefficient_error = coefficient_error + step_error
            a = np.concatenate([np.einsum("kn,mnw->mkw", half, a) for half in _compute_halving_matrices(count)])
        return value, errors + rounding(2 * ROUNDS) * np.abs(value), tops


@cache
def rule() -> tuple[Array, Array]:
    """Return the nodes and weights of Gauss' rule, rounded once: those of NumPy have errors of several units in the
    last place."""
    from flint import arb, ctx

    with ctx.workprec(128):
        pairs = [arb.legendre_p_root(NODES, k, weight=True) for k in range(NODES)]
        nodes, weights = ([float(x) for x in column] for column in zip(*pairs, strict=True))
    return np.array(nodes), np.array(weights)


@cache
def _compute_halving_matrices(count: int) -> tuple[Array, Array]:
    """Return the matrices from coefficients of powers of ``x`` to those of ``s``, for ``x = -1/2 + s/2`` and ``x = 1/2
    + s/2``."""
    matrices = [
        np.array(
            [[comb(n, k) * side ** (n - k) * 0.5**k if n >= k else 0.0 for n in range(count)] for k in range(count)]
        )
        for side in (-0.5, 0.5)
    ]
    return matrices[0], matrices[1]


def _rescale_polynomials(plain: Array, length: Array) -> Array:
    """Return polynomials ``(M, p + 1, mw)`` at ``(length - 1) + length s``, by Horner's rule."""
    polynomials = np.zeros_like(plain)
    shift, stretch = (length - 1.0)[:, None, None], length[:, None, None]
    for n in reversed(range(plain.shape[1])):
        shifted = np.zeros_like(polynomials)
        shifted[:, 1:] = stretch * polynomials[:, :-1]
        polynomials = shift * polynomials + shifted
        polynomials[:, 0] += plain[:, n]
    return polynomials


def _split_product(shape: Shape, about: Array, *arrays: Array) -> list[tuple[Shape, list[Array]]]:
    """Return the factors of a product of sets, each with its columns of the arrays; another set is its own only
    factor."""
    if not isinstance(shape, Joint):
        return [(shape, [about, *arrays])]
    pairs = zip(shape.parts, shape.places, strict=True)
    return [(factor, [about[columns], *(array[:, columns] for array in arrays)]) for factor, columns in pairs]


def _evaluate_support(shape: Shape, about: Array, values: Array) -> tuple[Array, Array]:
    """Return the support function of the set minus the point at exact directions ``(k, mw)``, and error bounds,
    ``(k,)`` each."""
    total, total_error = np.zeros(len(values)), np.zeros(len(values))
    for factor, (point, c) in _split_product(shape, about, values):
        height, error = _evaluate_factor(factor, point, c)
        total, total_error = total + height, total_error + error + HALF_ULP * np.abs(total + height)
    return total, total_error * OUTWARD


def _evaluate_factor(part: Shape, about: Array, c: Array) -> tuple[Array, Array]:
    size = np.abs(c)
    if isinstance(part, Boxed):
        middle, half, error = _shift_box(part, about)
        high = c @ middle + size @ half
        return high, (size @ (error + rounding(c.shape[1] + 2) * (np.abs(middle) + half))) * OUTWARD
    if isinstance(part, Cornered):
        corners, error = _shift_corners(part, about)
        high = (c @ corners.T).max(axis=1)
        return high, (size @ (error + rounding(c.shape[1] + 2) * np.abs(corners)).T).max(axis=1) * OUTWARD
    if isinstance(part, Segments):
        ends, offset = np.abs(part.source.generators).T, part.source.centre - about
        high = np.abs(c @ part.source.generators.T).sum(axis=1) + c @ offset
        error = rounding(sum(ends.shape) + 2) * (size @ ends).sum(axis=1)
        return high, (error + rounding(len(ends) + 4) * (size @ np.abs(offset))) * OUTWARD
    L, share, q = _find_norm_matrix(part)
    y = c @ L
    norm = _compute_norms(y, q)
    norm_error = _compute_norms(size @ np.abs(L), q) * rounding(2 * len(L) + 8) + norm * (
        2.0 * share + rounding(64 * len(L))
    )
    offset = part.centre - about
    norm_error = norm_error + (size @ np.abs(offset)) * rounding(len(L) + 2)
    return norm + c @ offset, norm_error * OUTWARD


def _bound_support(shape: Shape, about: Array, c: Array, spread: Array) -> Array:
    """Return bounds ``(k,)`` of the absolute value of the support function of the set minus the point at complex
    directions.

    The directions are those within ``spread (k, mw)`` of ``c (k, mw)``. A bound is ``inf`` where the function is not
    shown to be analytic at all of them.
    """
    total = np.zeros(len(c))
    for factor, (point, value, deviation) in _split_product(shape, about, c, spread):
        reach = np.abs(value) + deviation
        if isinstance(factor, Boxed):
            middle, half, error = _shift_box(factor, point)
            is_fixed = (np.abs(value) > deviation) | (half + error == 0.0) | (reach == 0.0)
            bound = np.where(is_fixed.all(axis=1), reach @ (np.abs(middle) + half + error), np.inf)
        elif isinstance(factor, Cornered):
            corners, error = _shift_corners(factor, point)
            heights = value @ corners.T
            best = corners[heights.argmax(axis=1)]
            rounding_error = 2.0 * (reach @ (error + rounding(value.shape[1] + 2) * np.abs(corners)).T)
            gap = heights.max(axis=1, keepdims=True) - heights - rounding_error
            is_below = np.einsum("kvw,kw->kv", np.abs(best[:, None] - corners), deviation) < gap
            is_dominated = is_below | (best[:, None] == corners).all(axis=2)
            bound = np.where(is_dominated.all(axis=1), (reach @ (np.abs(corners) + error).T).max(axis=1), np.inf)
        elif isinstance(factor, Segments):
            ends = np.abs(factor.source.generators).T
            change = deviation @ ends + rounding(len(ends) + 2) * (reach @ ends)
            is_fixed = (np.abs(value @ factor.source.generators.T) > change) | (change == 0.0)
            heights = (reach @ ends).sum(axis=1) + reach @ (np.abs(factor.source.centre - point) * OUTWARD)
            bound = np.where(is_fixed.all(axis=1), heights, np.inf)
        else:
            L, share, q = _find_norm_matrix(factor)
            y, b = np.abs(value @ L), deviation @ np.abs(L)
            unit = np.maximum((y + b).max(axis=1, keepdims=True), TINY)
            y, b = y / unit, b / unit
            if q == 2.0:  # |sum (y + b)^2 - sum y^2| <= 2 |y| |b| + |b|^2
                norm, change = np.linalg.norm(y, axis=1), np.linalg.norm(b, axis=1)
                power_sum, change = norm**2, 2.0 * norm * change + change**2
                is_analytic = change < ROOM * power_sum
            else:  # the slope of z^q is at most q (y + b)^(q - 1) between
                power_sum, change = (y**q).sum(axis=1), (q * b * (y + b) ** (q - 1.0)).sum(axis=1)
                is_analytic = (change < ROOM * power_sum) & (q < STEEP)
            norm_bound = np.where(is_analytic, (power_sum + change) ** (1.0 / q), np.inf)
            if q != 2.0:
                is_smooth = ((y * ROOM > b) | (y + b == 0.0)).all(axis=1)
                norm_bound = np.where(is_smooth, np.minimum(norm_bound, _bound_dominated_norm(y, b, q)), np.inf)
            offset = np.abs(factor.centre - point) * OUTWARD
            bound = unit[:, 0] * norm_bound * (1.0 + 2.0 * share) + reach @ offset
        total = total + bound
    return total * OUTWARD


def _bound_dominated_norm(y: Array, b: Array, q: float) -> Array:
    """Return bounds of the ``q``-norm within ``b (k, d)`` of ``y (k, d)``, both nonnegative, where one entry dominates.

    The entries are divided by the dominating one. Where the powers of all others add up to less than 1, the sum of all
    is away from 0; elsewhere the bound is ``inf``. For a large ``q`` one entry dominates nearly everywhere, while a
    power changes by its own size where its base changes by a share ``1 / q``.
    """
    lead = y.argmax(axis=1)[:, None]
    low, high = (np.take_along_axis(end, lead, axis=1) for end in (y - b, y + b))
    quotients = np.where(low > 0.0, (y + b) / np.where(low > 0.0, low, 1.0), 1.0)
    quotients = np.minimum(quotients * (1.0 + 16.0 * HALF_ULP), 1.0) ** q
    np.put_along_axis(quotients, lead, 0.0, axis=1)
    power_sum = quotients.sum(axis=1)
    return np.where((low[:, 0] > 0.0) & (power_sum < ROOM), high[:, 0] * (1.0 + power_sum) ** (1.0 / q), np.inf)


def _compute_norms(y: Array, q: float) -> Array:
    """Return the q-norms of rows; no entry overflows or underflows."""
    size = np.abs(y).max(axis=1, keepdims=True)
    safe = np.where(size > 0.0, size, 1.0)
    return np.asarray(size[:, 0] * np.linalg.norm(y / safe, ord=q, axis=1))


def _find_norm_matrix(part: Shape) -> tuple[Array, float, float]:
    """Return ``L (d, d)``, the relative error of ``L``, and ``q`` with ``h(c) = c'm + |L'c|_q``."""
    if isinstance(part, Ball) and part.source.p > 1.0:
        p = part.source.p
        return part.source.radius * np.eye(part.dimension), HALF_ULP, p / (p - 1.0)
    if isinstance(part, Ellipsoidal):
        return part.source.factor, part.missed, 2.0
    raise Unchecked(
        "the checker knows measurable disturbances in boxes, polytopes, ellipsoids, balls, zonotopes, and products of"
        " these; balls of the 1-norm in up to 10 dimensions"
    )


def _shift_box(part: Boxed, about: Array) -> tuple[Array, Array, Array]:
    """Return the middle of a box minus a point, half its widths, and the error bound of both together, ``(d,)``
    each."""
    ends = part.exact
    middle = [float((low + high) / 2 - Fraction(float(m))) for (low, high), m in zip(ends, about, strict=True)]
    half = [float((high - low) / 2) for low, high in ends]
    return np.array(middle), np.array(half), HALF_ULP * 2.0 * (np.abs(middle) + np.array(half))


def _shift_corners(part: Cornered, about: Array) -> tuple[Array, Array]:
    """Return the corners of a set minus a point, and their error bounds, ``(v, d)`` each."""
    exact: Sequence[Sequence[Fraction]] = part.corners
    corners = [[float(x - Fraction(float(m))) for x, m in zip(corner, about, strict=True)] for corner in exact]
    return np.array(corners), HALF_ULP * np.abs(corners)
