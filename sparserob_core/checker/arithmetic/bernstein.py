"""Proven upper bounds of polynomials on a box, by Bernstein's form.

On ``[0, 1]^v`` a polynomial is a convex combination of its Bernstein coefficients; the corner coefficients are values
of the polynomial (Farouki 2012). Halving a box averages coefficients. Hence the bound converges quadratically, and is
attained where the largest coefficient is at a corner.

Rounding: a conversion is a sum of products, whose rounding error is bounded by the same sum of absolute values. A
halving is a chain of averages of numbers no larger than those, each rounded once. The rounding error of a thousand
operations is at most `ROUNDING` times the absolute values (Higham 2002, section 3.1).
"""

from __future__ import annotations

from collections.abc import Sequence
from fractions import Fraction
from functools import lru_cache
from math import comb

import numpy as np

from sparserob_core.sip.convex_set import Array

ROUNDING = 2e-13
HALVINGS = 60
MAX_BOXES = 20_000


@lru_cache(maxsize=32)
def _compute_conversion(degree: int, symmetric: bool) -> Array:
    """Return the matrix ``(degree + 1, degree + 1)`` from powers to Bernstein coefficients on ``[0, 1]``; with
    ``symmetric`` from powers on ``[-1, 1]``. Its entries are rounded once: sums in doubles would lose digits."""
    orders = range(degree + 1)
    rows = [[Fraction(comb(i, k), comb(degree, k)) for k in orders] for i in orders]
    if symmetric:
        shift = [[comb(j, k) * 2**k * (-1) ** (j - k) if k <= j else 0 for j in orders] for k in orders]
        rows = [[sum((row[k] * shift[k][j] for k in orders), Fraction(0)) for j in orders] for row in rows]
    return np.array([[float(entry) for entry in row] for row in rows])


def bernstein(coefficients: Array, symmetric: Sequence[bool], absolute: bool = False) -> Array:
    """Return the Bernstein coefficients of polynomials with coefficients ``(k, n_1, ..., n_v)``, on ``[-1, 1]`` for a
    ``symmetric`` variable and on ``[0, 1]`` for others. With ``absolute`` add up absolute values, which bounds rounding
    errors."""
    b = np.abs(coefficients) if absolute else coefficients
    for axis, both in enumerate(symmetric):
        matrix = _compute_conversion(b.shape[axis + 1] - 1, both)
        matrix = np.abs(matrix) if absolute else matrix
        b = np.moveaxis(np.tensordot(b, matrix, axes=(axis + 1, 1)), -1, axis + 1)
    return b


def highest(coefficients: Array, symmetric: Sequence[bool], errors: Array, limit: float) -> Array:
    """Return upper bounds ``(k,)`` of each polynomial plus its ``errors (k,)`` and the rounding errors made here;
    ``inf`` where numbers overflow. Boxes are halved until a bound is at most ``limit``, or certainly cannot become
    so."""
    with np.errstate(over="ignore", invalid="ignore"):
        slack = errors + ROUNDING * bernstein(coefficients, symmetric, absolute=True).reshape(
            coefficients.shape[0], -1
        ).max(axis=1)
        b = bernstein(coefficients, symmetric)
    is_finite = np.isfinite(b).reshape(b.shape[0], -1).all(axis=1) & np.isfinite(slack)  # the other bounds are infinite
    owner, b = np.flatnonzero(is_finite), b[is_finite]
    bounds = np.where(is_finite, -np.inf, np.inf)
    for step in range(HALVINGS if owner.size else 0):
        upper = b.reshape(b.shape[0], -1).max(axis=1)
        is_shown = upper + slack[owner] <= limit
        attained = _select_corners(b).max(axis=1)
        is_refuted = attained + slack[owner] > limit  # the polynomial attains this value
        is_stopped = (
            np.zeros(owner.size, dtype=bool)
            if step < HALVINGS - 1 and owner.size <= MAX_BOXES
            else np.ones(owner.size, dtype=bool)
        )
        is_given_up = np.isin(owner, owner[is_refuted | is_stopped & ~is_shown])
        is_closed = is_shown | is_given_up
        np.maximum.at(bounds, owner[is_closed], (upper + slack[owner])[is_closed])
        b, owner = b[~is_closed], owner[~is_closed]
        if not owner.size:
            break
        b, owner = _halve_boxes(b), np.tile(owner, 2)
    return bounds


def _select_corners(b: Array) -> Array:
    corners = b
    for axis in range(1, b.ndim):
        corners = np.take(corners, [0, -1], axis=axis)
    return corners.reshape(b.shape[0], -1)


def _halve_boxes(b: Array) -> Array:
    """Return both halves of every box, the lower halves first. Each box is halved along the axis on which its
    coefficients vary most (de Casteljau)."""
    variation = np.stack(
        [np.abs(np.diff(b, axis=axis)).reshape(b.shape[0], -1).max(axis=1, initial=0.0) for axis in range(1, b.ndim)],
        axis=1,
    )
    axes = variation.argmax(axis=1) + 1
    low, high = np.empty_like(b), np.empty_like(b)
    for axis in range(1, b.ndim):
        is_chosen = axes == axis
        if is_chosen.any():
            lower_half, upper_half = _apply_de_casteljau(np.moveaxis(b[is_chosen], axis, -1))
            low[is_chosen], high[is_chosen] = np.moveaxis(lower_half, -1, axis), np.moveaxis(upper_half, -1, axis)
    return np.concatenate([low, high])


def _apply_de_casteljau(b: Array) -> tuple[Array, Array]:
    lower_half, upper_half, row = np.empty_like(b), np.empty_like(b), b
    for i in range(b.shape[-1]):
        lower_half[..., i], upper_half[..., b.shape[-1] - 1 - i] = row[..., 0], row[..., -1]
        row = (row[..., :-1] + row[..., 1:]) / 2
    return lower_half, upper_half
