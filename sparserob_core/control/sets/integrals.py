"""Integrals of the support function of a curved set along polynomials, enclosed.

Where the support function is analytic in all directions that the polynomial has on an ellipse about an interval, Gauss'
rule is off by no more than ``64 / 15 M r^-2q / (1 - r^-2)``, with ``q + 1`` nodes, ``r`` the sum of the half-axes of
the ellipse, and ``M`` the largest absolute value on it (Trefethen 2013, theorem 19.3). Intervals beside a direction in
which it is not, as where the polynomial goes through 0, are halved: what they add is of the order of the square of
their length.
"""

from __future__ import annotations

from functools import cache

import numpy as np

from sparserob_core.sip.convex_set import Array, ConvexSet

EPSILON = float(np.finfo(float).eps)
HALVINGS = 48  # of an interval: what is left of it is below rounding
NODES, WEIGHTS = np.polynomial.legendre.leggauss(17)  # with 9 of them intervals would be halved four times more
RADIUS = 3.0  # of the ellipse: with 2 the rule is off by 1e-9, with 4 every interval is halved once more
MISSED = 64.0 / 15.0 * RADIUS ** (2.0 - 2.0 * NODES.size) / (1.0 - RADIUS**-2.0)  # 3e-15 of the largest value


def enclosed(bound: ConvexSet) -> bool:
    """Whether integrals of its support function are enclosed: it is flat, or known to be analytic somewhere."""
    nowhere = np.zeros((1, bound.dimension))
    return bound.halfspaces() is not None or bound.continued(nowhere, nowhere) is not None


def curved_integral(bound: ConvexSet, terms: Array, lengths: Array, accuracy: Array) -> Array:
    """Lower and upper bounds ``(l, 2)`` of the integrals of the support function of ``bound`` over intervals of
    ``lengths (l,)``, on which its argument is a polynomial with ``terms (l, p + 1, w)`` in the share of the interval
    that has passed, halved until their bounds are within ``accuracy (l,)``."""
    total, owner = np.zeros((lengths.size, 2)), np.arange(lengths.size)
    orders = np.arange(terms.shape[1])
    # in powers of the place from -1 to 1 across the interval
    terms = _moved(terms.shape[1], 0.5, 0.5) @ terms
    far = bound.reach(np.eye(bound.dimension))
    each, first = 2.0 * orders.size * EPSILON, np.abs(terms).sum(axis=1) @ far
    lost = each + (8.0 * far.size + 64.0) * EPSILON
    to_series = _series(orders.size)
    powers, halves = NODES[:, None] ** orders, [_moved(orders.size, 0.5, side) for side in (-0.5, 0.5)]
    for turn in range(HALVINGS + 1):
        waves = to_series @ terms
        spread = np.einsum("k,lkw->lw", RADIUS ** orders[1:], np.abs(waves[:, 1:])) * (1.0 + lost)
        most = bound.continued(waves[:, 0], spread)
        assert most is not None
        sizes = np.abs(terms).sum(axis=1) @ far
        middle = bound.support(powers @ terms) @ WEIGHTS / 2.0
        off = np.where(np.isfinite(most), MISSED * most, np.inf)
        # within its reach the support function changes by no more than that of the change
        plain, apart = bound.support(terms[:, 0]), np.abs(terms[:, 1:]).sum(axis=1) @ far
        better = apart < off
        middle, off = np.where(better, plain, middle), np.minimum(off, apart)
        open_ = (2.0 * off * lengths > accuracy[owner]) & (off > lost * sizes) & (turn < HALVINGS)
        off = off + lost * sizes + each * turn * first[owner]  # every halving rounds all coefficients
        found = np.stack([middle - off, middle + off], axis=1) * lengths[:, None]
        np.add.at(total, owner[~open_], found[~open_])
        terms, owner, lengths = terms[open_], np.tile(owner[open_], 2), np.tile(lengths[open_] / 2.0, 2)
        if not owner.size:
            break
        terms = np.concatenate([half @ terms for half in halves])
    return total


@cache
def _series(count: int) -> Array:
    """From the coefficients of powers to those of Chebyshev's polynomials, ``(count, count)``."""
    found = np.zeros((count, count))
    for k, power in enumerate(np.eye(count)):
        found[: k + 1, k] = np.polynomial.chebyshev.poly2cheb(power[: k + 1])
    return found


@cache
def _moved(count: int, share: float, begin: float) -> Array:
    """From the coefficients of powers of ``x`` to those of ``y``, ``x = begin + share y``, ``(count, count)``."""
    found = np.zeros((count, count))
    power = np.ones(1)
    for j in range(count):
        found[: power.size, j] = power
        power = np.convolve(power, [begin, share])
    return found
