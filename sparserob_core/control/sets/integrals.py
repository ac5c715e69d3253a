"""Enclosures of integrals of the support function of a set along polynomials.

Consider an interval for which the support function is analytic in all directions that the polynomial has on an ellipse
about the interval. Gauss's rule with ``q + 1`` nodes then has an error of at most ``64 / 15 M r^-2q / (1 - r^-2)``.
Here ``r`` is the sum of the half-axes of the ellipse and ``M`` the largest absolute value on it (Trefethen 2013,
theorem 19.3). Other intervals, such as those in which the polynomial is close to 0, are halved. Their contribution is
of the order of the square of their length.
"""

from __future__ import annotations

from functools import cache
from math import comb

import numpy as np

from sparserob_core.sip.convex_set import Array, ConvexSet

EPSILON = float(np.finfo(float).eps)
INTERVAL_HALVINGS = 48  # halvings of an interval, after which its contribution is below rounding
NODES, WEIGHTS = np.polynomial.legendre.leggauss(17)  # with 9 nodes intervals would be halved four times more
RADIUS = 3.0  # sum of the half-axes of the ellipse: with 2 the error is 1e-9, with 4 each interval is halved once more
# error bound, relative to M: 3e-15
ERROR_FACTOR = 64.0 / 15.0 * RADIUS ** (2.0 - 2.0 * NODES.size) / (1.0 - RADIUS**-2.0)
# Divisions at sign changes before an interval is halved: a polynomial has one or two of them on a piece
CUTS_PER_INTERVAL = 3
SECANT_STEPS = 10  # steps of the secant method; with half of them a part near a sign change is halved a few times more
NEAR_END = 1e-9  # share of an interval next to its ends: an interval with a sign change there is halved


def can_enclose_integrals(bound: ConvexSet) -> bool:
    """Return True where integrals of the support function of a set can be enclosed.

    The set has to be flat, or its analytic continuation known.
    """
    nowhere = np.zeros((1, bound.dimension))
    return bound.halfspaces() is not None or bound.continued(nowhere, nowhere) is not None


def curved_integral(bound: ConvexSet, terms: Array, lengths: Array, accuracy: Array) -> Array:
    """Return lower and upper bounds of the integrals of the support function of a curved set along polynomials.

    Parameters
    ----------
    bound : ConvexSet
        The set, with a known analytic continuation of its support function (`ConvexSet.continued`).
    terms : array (l, p + 1, w)
        The coefficients of the polynomial on each interval, in the share of the interval that has passed.
    lengths : array (l,)
        The lengths of the intervals.
    accuracy : array (l,)
        The distance of the bounds at which an interval is not halved any more.

    Returns
    -------
    array (l, 2)
        The bounds for each interval.
    """
    total, owner = np.zeros((lengths.size, 2)), np.arange(lengths.size)
    orders = np.arange(terms.shape[1])
    # from here on in powers of a variable that runs from -1 to 1 over the interval
    terms = _build_substitution_matrix(terms.shape[1], 0.5, 0.5) @ terms
    reach = bound.reach(np.eye(bound.dimension))
    step_rounding, first_sizes = 2.0 * orders.size * EPSILON, np.abs(terms).sum(axis=1) @ reach
    rounding = step_rounding + (8.0 * reach.size + 64.0) * EPSILON
    to_series = _build_chebyshev_matrix(orders.size)
    powers, halves = (
        NODES[:, None] ** orders,
        [_build_substitution_matrix(orders.size, 0.5, side) for side in (-0.5, 0.5)],
    )
    for halving in range(INTERVAL_HALVINGS + 1):
        series = to_series @ terms
        radii = np.einsum("k,lkw->lw", RADIUS ** orders[1:], np.abs(series[:, 1:])) * (1.0 + rounding)
        maxima = bound.continued(series[:, 0], radii)
        assert maxima is not None
        sizes = np.abs(terms).sum(axis=1) @ reach
        middle = bound.support(powers @ terms) @ WEIGHTS / 2.0
        error = np.where(np.isfinite(maxima), ERROR_FACTOR * maxima, np.inf)
        # the support function changes by at most the reach of the set along the change of its argument
        constant, constant_error = bound.support(terms[:, 0]), np.abs(terms[:, 1:]).sum(axis=1) @ reach
        is_better = constant_error < error
        middle, error = np.where(is_better, constant, middle), np.minimum(error, constant_error)
        is_open = (2.0 * error * lengths > accuracy[owner]) & (error > rounding * sizes) & (halving < INTERVAL_HALVINGS)
        # every halving rounds all coefficients again
        error = error + rounding * sizes + step_rounding * halving * first_sizes[owner]
        bounds = np.stack([middle - error, middle + error], axis=1) * lengths[:, None]
        np.add.at(total, owner[~is_open], bounds[~is_open])
        terms, owner, lengths = terms[is_open], np.tile(owner[is_open], 2), np.tile(lengths[is_open] / 2.0, 2)
        if not owner.size:
            break
        terms = np.concatenate([half @ terms for half in halves])
    return total


@cache
def _build_chebyshev_matrix(count: int) -> Array:
    """Return the matrix ``(count, count)`` from coefficients of powers to those of Chebyshev polynomials."""
    matrix = np.zeros((count, count))
    for k, power in enumerate(np.eye(count)):
        matrix[: k + 1, k] = np.polynomial.chebyshev.poly2cheb(power[: k + 1])
    return matrix


@cache
def _build_substitution_matrix(count: int, share: float, begin: float) -> Array:
    """Return the matrix from coefficients of powers of ``x`` to those of ``y``, ``x = begin + share y``.

    Its shape is ``(count, count)``.
    """
    matrix = np.zeros((count, count))
    power = np.ones(1)
    for j in range(count):
        matrix[: power.size, j] = power
        power = np.convolve(power, [begin, share])
    return matrix


def enclose_integrals(bound: ConvexSet, terms: Array, lengths: Array, accuracy: Array) -> Array:
    """Return lower and upper bounds of the integrals of the support function of a set along polynomials.

    Parameters
    ----------
    bound : ConvexSet
        The set.
    terms : array (l, p + 1, w)
        The coefficients of the polynomial on each interval, in the share of the interval that has passed.
    lengths : array (l,)
        The lengths of the intervals.
    accuracy : array (l,)
        The distance of the bounds at which an interval is not halved any more.

    Returns
    -------
    array (l, 2)
        The bounds for each interval.
    """
    if bound.halfspaces() is None:
        return curved_integral(bound, terms, lengths, accuracy)
    total, owner = np.zeros((lengths.size, 2)), np.arange(lengths.size)
    order = terms.shape[1] - 1
    points = np.einsum("kj,ljw->lkw", bezier(order), terms)
    for halving in range(INTERVAL_HALVINGS + 1):
        best = bound.support_point(points[:, order // 2])
        low = (points @ best[:, :, None])[..., 0].mean(axis=1) * lengths
        high = bound.support(points).mean(axis=1) * lengths
        is_open = (high - low > accuracy[owner]) & (halving < INTERVAL_HALVINGS)
        np.add.at(total, owner[~is_open], np.stack([low, high], axis=1)[~is_open])
        points, owner = points[is_open], np.tile(owner[is_open], 2)
        points = _split_polynomials(points, np.full(len(points), 0.5))
        lengths = np.tile(lengths[is_open] / 2, 2)
        if not owner.size:
            break
    return total


def enclose_absolute_integrals(terms: Array, accuracy: Array) -> Array:
    """Return lower and upper bounds of the integrals over ``[0, 1]`` of the absolute values of polynomials.

    Intervals are divided where a polynomial changes its sign: both parts are then enclosed at once, where halves would
    be divided some twenty times. The bounds hold for every choice of the points of division.

    Parameters
    ----------
    terms : array (l, p + 1)
        The coefficients of each polynomial, in powers of the variable.
    accuracy : array (l,)
        The distance of the bounds at which an interval is not divided any more.

    Returns
    -------
    array (l, 2)
        The bounds for each polynomial.
    """
    total, owner = np.zeros((len(terms), 2)), np.arange(len(terms))
    order = terms.shape[1] - 1
    points, lengths = terms @ bezier(order).T, np.ones(len(terms))
    for division in range(INTERVAL_HALVINGS + 1):
        low, high = np.abs(points.mean(axis=1)) * lengths, np.abs(points).mean(axis=1) * lengths
        is_open = (high - low > accuracy[owner]) & (division < INTERVAL_HALVINGS)
        np.add.at(total, owner[~is_open], np.stack([low, high], axis=1)[~is_open])
        points, owner, lengths = points[is_open], np.tile(owner[is_open], 2), lengths[is_open]
        if not owner.size:
            break
        at = _find_sign_changes(points) if division < CUTS_PER_INTERVAL else np.full(len(points), 0.5)
        points, lengths = _split_polynomials(points, at), np.concatenate([lengths * at, lengths * (1.0 - at)])
    return total


def _find_sign_changes(points: Array) -> Array:
    """Return approximate points ``(l,)`` at which polynomials change their signs.

    They are computed by the Illinois variant of the secant method.

    The value is the middle where both ends have the same sign.

    Parameters
    ----------
    points : array (l, p + 1)
        The Bernstein coefficients of the polynomials on ``[0, 1]``.
    """
    order = points.shape[1] - 1
    weights, powers = np.array([comb(order, k) for k in range(order + 1)]) * points, np.arange(order + 1)
    a, b, fa, fb = np.zeros(len(points)), np.ones(len(points)), points[:, 0], points[:, -1]
    crossing, at = fa * fb < 0.0, np.full(len(points), 0.5)
    for _ in range(SECANT_STEPS):
        with np.errstate(divide="ignore", invalid="ignore"):
            secant = b - fb * (b - a) / (fb - fa)
        at = np.where(crossing & (secant > NEAR_END) & (secant < 1.0 - NEAR_END), secant, 0.5)
        value = (weights * at[:, None] ** powers * (1.0 - at[:, None]) ** powers[::-1]).sum(axis=1)
        crosses = value * fb < 0.0
        a, fa = np.where(crosses, b, a), np.where(crosses, fb, fa / 2.0)
        b, fb = at, value
    return at


def _split_polynomials(points: Array, at: Array) -> Array:
    """Return Bernstein coefficients on both sides of the points ``at (l,)``, all left parts first (de Casteljau).

    Parameters
    ----------
    points : array (l, p + 1, ...)
        The Bernstein coefficients on ``[0, 1]``.
    at : array (l,)
        The point of division of each polynomial.

    Returns
    -------
    array (2 l, p + 1, ...)
        The coefficients on the left parts, followed by those on the right parts.
    """
    left, right, row, last = np.empty_like(points), np.empty_like(points), points, points.shape[1] - 1
    share = at.reshape(-1, *([1] * (points.ndim - 1)))
    complement = 1.0 - share
    for order in range(last + 1):
        left[:, order], right[:, last - order] = row[:, 0], row[:, -1]
        row = complement * row[:, :-1] + share * row[:, 1:]
    return np.concatenate([left, right])


@cache
def bezier(order: int) -> Array:
    """Return the matrix ``(order + 1, order + 1)`` from powers on ``[0, 1]`` to Bernstein coefficients."""
    return np.array([[comb(k, j) / comb(order, j) for j in range(order + 1)] for k in range(order + 1)])
