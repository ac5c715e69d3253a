"""The exponential of many small matrices at once."""

from __future__ import annotations

import numpy as np

from sparserob_core.shapes import Float, shaped
from sparserob_core.sip.convex_set import Array
from sparserob_core.sip.expressions.rounding import rounding

# 1 / k!; beyond degree 18 nothing is left on the unit ball (1 / 19! < 1e-17)
COEFFICIENTS = 1.0 / np.cumprod([1.0, *range(1, 19)])
FEW = 1000  # numbers in an array up to which a call of numpy costs little more than its overhead


@shaped
def exponential(matrices: Float[Array, "*k d d"]) -> Float[Array, "*k d d"]:
    """``e^A`` of matrices, by scaling and squaring of the Taylor polynomial of degree 18 (Moler and Van
    Loan 2003, method 3).

    Matrix products only. `scipy.linalg.expm` solves a tiny linear system per matrix, for which a threaded LAPACK wakes
    all its threads: on a busy machine that takes twenty times as long.
    """
    norms = np.abs(matrices).sum(axis=-2).max(axis=-1)
    scaled, squarings = matrices, np.zeros(1, dtype=int)
    if norms.max(initial=0.0) > 1.0:
        squarings = np.maximum(0, np.ceil(np.log2(np.maximum(norms, np.finfo(float).tiny)))).astype(int)
        scaled = matrices / np.exp2(squarings)[..., None, None]
    second = scaled @ scaled
    third = second @ scaled
    identity = np.eye(matrices.shape[-1])
    result: Array = np.broadcast_to(COEFFICIENTS[18] * identity, matrices.shape)
    # in blocks of three (Paterson and Stockmeyer 1973), of few numbers all at once
    blocks = COEFFICIENTS[:18].reshape(-1, 3, *(1 for _ in matrices.shape))
    group = 6 if matrices.size <= FEW else 1
    for stop in range(6, 0, -group):
        constant, first, square = blocks[stop - group : stop].swapaxes(0, 1)
        for polynomial in (constant * identity + first * scaled + square * second)[::-1]:
            result = result @ third + polynomial
    for squaring in range(int(squarings.max(initial=0))):
        result = np.where((squarings > squaring)[..., None, None], result @ result, result)
    return result


def transitions(A: Array, durations: Array) -> tuple[Array, Array]:
    """``e^{A r}`` and ``int_0^r e^{A s} ds`` for matrices ``(..., d, d)`` and durations ``(...,)``, broadcast together:
    both are blocks of one exponential of ``[[A, I], [0, 0]] r`` (Van Loan 1978, Theorem 1)."""
    size = A.shape[-1]
    shape = np.broadcast_shapes(A.shape[:-2], durations.shape)
    block = np.zeros((*shape, 2 * size, 2 * size))
    # I in place of I r, and times r after: so the number of squarings does not depend on the unit of time
    block[..., :size, :size] = A * durations[..., None, None]
    block[..., :size, size:] = np.eye(size)
    both = exponential(block)
    return both[..., :size, :size], both[..., :size, size:] * durations[..., None, None]


def exponential_rounding(terms: int, sizes: Array) -> Array:
    """Return a bound ``(...)`` of the rounding error of `exponential` and of both parts of `transitions`.

    It is relative to the exponential of any matrix of bounds that compares with ``A`` (`ComparisonSystem`), for 1-norms
    ``||A|| r`` of ``sizes (...)``. On the unit ball, each of eight products errs by ``rounding(terms)`` relative to a
    polynomial of ``|A|``. That is at most ``e^2`` times the exponential of the bounds. Every squaring doubles the
    relative error and adds one product.
    """
    squared = np.exp2(np.maximum(0.0, np.ceil(np.log2(np.maximum(sizes + 1.0, 1.0)))))
    return np.asarray(60.0 * rounding(terms) * squared)
