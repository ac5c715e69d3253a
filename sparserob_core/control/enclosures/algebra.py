"""Polynomials with matrix coefficients, as an algebra: a lifted system's transitions without exponentials of its large
matrix.

Lifted matrices multiply like the truncated polynomials ``A(delta) = sum_g A_g delta^g`` that they stand for, so the
exponential of the one is the lifted matrix of the exponential of the other: ``M`` small coefficients instead of one
matrix of ``M^2`` blocks.
"""

from __future__ import annotations

import numpy as np

from sparserob_core.control.enclosures.matrix_exponential import COEFFICIENTS, exponential_rounding
from sparserob_core.sip.convex_set import Array
from sparserob_core.sip.expressions.taylor import TaylorSpace


def lifted_matrix(space: TaylorSpace, coefficients: Array, rows: bool) -> Array:
    """Return the lifted matrices ``(..., M d, M d)`` of polynomials ``(..., M, d, d)``.

    They act on columns from the left, or with ``rows`` on rows from the right.
    """
    size, d = space.size, coefficients.shape[-1]
    lifted = np.zeros((size, size, *coefficients.shape[:-3], d, d))
    left, right, target = space.products
    lifted[(right, target) if rows else (target, right)] = np.moveaxis(coefficients, -3, 0)[left]
    return np.moveaxis(lifted, (0, 1), (-4, -2)).reshape(*coefficients.shape[:-3], size * d, size * d)


def lifted_transitions(space: TaylorSpace, A: Array, durations: Array, rows: bool) -> tuple[Array, Array]:
    """`transitions` of the lifted matrix of ``A (M, d, d)`` over durations ``(k,)``, ``(k, M d, M d)`` each."""
    flow, integral = (lifted_matrix(space, polynomial, rows) for polynomial in flows_of(space, A, durations))
    return flow, integral


def flows_of(space: TaylorSpace, A: Array, durations: Array) -> tuple[Array, Array]:
    """Truncations ``(k, M, d, d)`` of ``e^{A(delta) r}`` and of its integral over ``[0, r]``, for ``A (M, d, d)`` and
    durations ``(k,)``."""
    d = A.shape[-1]
    block = np.zeros((durations.size, space.size, 2 * d, 2 * d))
    block[:, :, :d, :d] = A * durations[:, None, None, None]
    block[:, 0, :d, d:] = np.eye(d)  # and times r after, as in `transitions`
    both = exponential(space, block)
    return both[:, :, :d, :d], both[:, :, :d, d:] * durations[:, None, None, None]


def flows_rounding(space: TaylorSpace, A: Array, durations: Array) -> Array:
    """Return a bound ``(k,)`` of the rounding error of `flows_of`, relative to the exponential of the bounds."""
    terms = int(np.bincount(space.products[2]).max()) * 2 * A.shape[-1]
    return exponential_rounding(terms, np.abs(A).sum(axis=-2).max(axis=-1).sum() * durations)


def exponential(space: TaylorSpace, polynomials: Array) -> Array:
    """``e^A`` of polynomials ``(k, M, d, d)``, truncated; as
    `sparserob_core.control.enclosures.matrix_exponential.exponential` does it for matrices.

    The sum over the coefficients of their 1-norms is a norm of the algebra, so the same scaling and the same degree
    serve.
    """

    def times(first: Array, second: Array) -> Array:
        return multiplied(space, first, second)

    norms = np.abs(polynomials).sum(axis=-2).max(axis=-1).sum(axis=-1)
    squarings = np.maximum(0, np.ceil(np.log2(np.maximum(norms, np.finfo(float).tiny)))).astype(int)
    scaled = polynomials / np.exp2(squarings)[:, None, None, None]
    identity = np.zeros_like(scaled)
    identity[:, 0] = np.eye(scaled.shape[-1])
    second = times(scaled, scaled)
    third, powers = times(second, scaled), (identity, scaled, second)
    result: Array = COEFFICIENTS[18] * identity
    for block in (15, 12, 9, 6, 3, 0):
        result = times(result, third) + sum(COEFFICIENTS[block + i] * powers[i] for i in range(3))
    for squaring in range(int(squarings.max(initial=0))):
        result = np.where((squarings > squaring)[:, None, None, None], times(result, result), result)
    return result


def multiplied(space: TaylorSpace, first: Array, second: Array) -> Array:
    """Products ``(k, M, d, d)`` of polynomials with matrix coefficients ``(k, M, d, d)``, truncated."""
    left, right, target = space.products
    order = np.argsort(target, kind="stable")
    starts = np.searchsorted(target[order], np.arange(space.size))
    return np.asarray(np.add.reduceat(first[:, left[order]] @ second[:, right[order]], starts, axis=1))
