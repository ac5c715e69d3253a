"""Integrals of the support function of a curved set along polynomials, between bounds.

On a cell, with ``s`` from -1 to 1, the argument is ``a_0 + a_1 s + ...``. In the disc ``|s| <= R`` it is within ``sum_n
|a_n| R^n`` of ``a_0``, entry by entry. Let the support function be analytic there, and at most ``M``. Then coefficients
of its series are at most ``M R^-n`` (Cauchy). Gauss' rule with ``q`` nodes is exact up to the degree ``2 q - 1``, so
that its error is at most ``4 M R^-2q / (1 - 1 / R)``. Other cells are halved. On a small cell with a kink the error is
at most the support function of the change of the argument.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cache, cached_property
from math import comb
from typing import NamedTuple, final

import numpy as np
from flint import arb, ctx

from sparserob_core.checker.outcome import Unchecked
from sparserob_core.checker.sets.polynomials import HALF_ULP, OUTWARD, TINY, rounding
from sparserob_core.sip.convex_set import Array

DISC = 3.0  # radius: with 2 the error of the rule is 1e-9, with 4 cells are halved once more
NODES = 16  # of Gauss' rule: its relative error is then 3e-15
LEFT = 4.0 * DISC ** (-2.0 * NODES) / (1.0 - 1.0 / DISC) * OUTWARD
ROUNDS = 60  # rounds in which cells are cut
SETTLED = 2.0**-49  # relative to the support values: a cell with a smaller error is cut no more
ROOM = 0.999  # the largest relative change of a sum of squares or powers: it stays away from 0 despite rounding
STEEP = 1e9  # the largest exponent: rounding changes such a power by some 1e-6 of itself, and `ROOM` leaves 1e-3
AT_ONCE = 20_000  # cells that are evaluated together: some 50 MB


class Norm(NamedTuple):
    """The norm ``|L'c|_q`` with a matrix ``L (d, d)``, which has the relative error ``share``."""

    L: Array
    share: float
    q: float


@final
@dataclass(frozen=True, eq=False)
class NormSummand:
    """A set with the support function ``c'offset + |L'c|_q``, with integrals of it along polynomials. Further
    coordinates ``before`` and ``after`` its own are 0."""

    norm: Norm
    offset: Array
    before: int = 0
    after: int = 0

    @property
    def dimension(self) -> int:
        """The number of coordinates, ``mw``."""
        return self.before + self.offset.size + self.after

    @property
    def is_symmetric(self) -> bool:
        """True where the middle is 0."""
        return not self.offset.any()

    def widened(self, before: int, after: int) -> NormSummand:
        """Return the set with 0 in further coordinates before and after its own."""
        return replace(self, before=self.before + before, after=self.after + after)

    @cached_property
    def _radii(self) -> Array:
        """The upper bounds ``(d,)`` of the distance from the point to the set's ends along its own coordinates."""
        axes = np.vstack([np.eye(self.offset.size), -np.eye(self.offset.size)])
        heights, errors = _evaluate_support(self.norm, self.offset, axes)
        return np.asarray((heights + errors).reshape(2, -1).max(axis=0) * OUTWARD)

    @cached_property
    def radii(self) -> Array:
        """The upper bounds ``(mw,)`` of the distance from the point to the set's ends along every coordinate."""
        return np.pad(self._radii, (self.before, self.after))

    def integrate_support(self, plain: Array, off: Array, sizes: Array, ends: Array) -> tuple[Array, Array, Array]:
        """Return the integrals of the support function along polynomials, as `Summand.integrate_support` does;
        ``sizes`` are not used."""
        own = plain[:, :, self.before : self.before + self.offset.size]
        outputs = [np.zeros(0)] * 2
        for first in range(0, len(plain), AT_ONCE):
            batch = slice(first, first + AT_ONCE)
            batch_outputs = self._integrate(own[batch], ends[batch])
            outputs = [np.concatenate(pair) for pair in zip(outputs, batch_outputs, strict=True)]
        value, errors = outputs
        errors = (errors + (ends + 1.0) * (off @ self.radii)) * OUTWARD
        return value, errors, errors

    def _integrate(self, plain: Array, ends: Array) -> tuple[Array, Array]:
        count = plain.shape[1]
        owner, radii = np.arange(len(plain)), self._radii
        value, errors, length = np.zeros(len(plain)), np.zeros(len(plain)), (ends + 1.0) / 2.0
        tops = np.abs(plain).sum(axis=1) @ radii
        # on the cell from -1 to the end, with s from -1 to 1: u = -1 + length (1 + s) = (length - 1) + length s
        a, step_error = _rescale_polynomials(plain, length), rounding(2 * count) * tops
        coefficient_error = step_error.copy()
        nodes, weights = rule()
        orders, powers = np.arange(count), nodes[:, None] ** np.arange(count)
        for level in range(ROUNDS + 1):
            spread = np.einsum("n,mnw->mw", DISC ** orders[1:], np.abs(a[:, 1:])) * OUTWARD
            bounds = _bound_support(self.norm, self.offset, a[:, 0], spread)
            heights, height_errors = _evaluate_support(self.norm, self.offset, (powers @ a).reshape(-1, a.shape[2]))
            total = heights.reshape(len(a), -1) @ weights
            rounding_errors = (
                height_errors.reshape(len(a), -1) @ weights
                + rounding(4 * count + NODES) * np.abs(a).sum(axis=1) @ radii
            )
            rule_error = np.where(np.isfinite(bounds), LEFT * bounds, np.inf)
            change = 2.0 * np.abs(a[:, 1:]).sum(axis=1) @ radii
            middle_heights, middle_errors = _evaluate_support(self.norm, self.offset, a[:, 0])
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
        return value, errors + rounding(2 * ROUNDS) * np.abs(value)


@cache
def rule() -> tuple[Array, Array]:
    """Return the nodes and weights of Gauss' rule, rounded once: those of NumPy have errors of several units in the
    last place."""
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


def _evaluate_support(norm: Norm, offset: Array, c: Array) -> tuple[Array, Array]:
    """Return the support function at exact directions ``(k, d)``, and error bounds, ``(k,)`` each."""
    (L, share, q), size = norm, np.abs(c)
    lengths = _compute_norms(c @ L, q)
    errors = _compute_norms(size @ np.abs(L), q) * rounding(2 * len(L) + 8)
    errors += lengths * (2.0 * share + rounding(64 * len(L))) + (size @ np.abs(offset)) * rounding(len(L) + 2)
    return lengths + c @ offset, errors * OUTWARD


def _bound_support(norm: Norm, offset: Array, c: Array, spread: Array) -> Array:
    """Return bounds ``(k,)`` of the absolute support function at complex directions, within
    ``spread (k, d)`` of ``c (k, d)``. A bound is ``inf`` where it is not shown to be analytic at all of them."""
    L, share, q = norm
    y, b = np.abs(c @ L), spread @ np.abs(L)
    unit = np.maximum((y + b).max(axis=1, keepdims=True), TINY)
    y, b = y / unit, b / unit
    if q == 2.0:  # |sum (y + b)^2 - sum y^2| <= 2 |y| |b| + |b|^2
        length, change = np.linalg.norm(y, axis=1), np.linalg.norm(b, axis=1)
        power_sum, change = length**2, 2.0 * length * change + change**2
        is_analytic = change < ROOM * power_sum
    else:  # the slope of z^q is at most q (y + b)^(q - 1) between
        power_sum, change = (y**q).sum(axis=1), (q * b * (y + b) ** (q - 1.0)).sum(axis=1)
        is_analytic = (change < ROOM * power_sum) & (q < STEEP)
    norm_bound = np.where(is_analytic, (power_sum + change) ** (1.0 / q), np.inf)
    if q != 2.0:
        is_smooth = ((y * ROOM > b) | (y + b == 0.0)).all(axis=1)
        norm_bound = np.where(is_smooth, np.minimum(norm_bound, _bound_dominated_norm(y, b, q)), np.inf)
    linear = (np.abs(c) + spread) @ (np.abs(offset) * OUTWARD)
    return np.asarray((unit[:, 0] * norm_bound * (1.0 + 2.0 * share) + linear) * OUTWARD)


def _bound_dominated_norm(y: Array, b: Array, q: float) -> Array:
    """Return bounds of the ``q``-norm within ``b (k, d)`` of ``y (k, d)``, both nonnegative, where one entry dominates:
    divided by it, the powers of all others add up to less than 1. For a large ``q`` that is so nearly everywhere, while
    a power changes by its own size where its base changes by a share ``1 / q``."""
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
