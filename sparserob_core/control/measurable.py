"""Support of the reachable set when the disturbance may be any measurable function with values in a set.

``sigma(t) = int_0^t h_W(E' e^{A' s} c) ds`` (the integral and the maximum commute: Aumann 1965). For boxes the integrand is a sum of
``|exponential polynomial|``, integrated exactly between its roots; for other sets by Gauss-Legendre quadrature on the pieces.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from sparserob_core.control.response import Response, transitions
from sparserob_core.sip.convex_set import Array, Box, ConvexSet

NODES, WEIGHTS = np.polynomial.legendre.leggauss(6)
BISECTIONS = 60


def measurable_support(response: Response, bound: ConvexSet, times: Array, directions: Array, parameters: Array) -> Array:
    """``sigma (k,)`` at ``times (k,)``, ``directions (k, d)``, ``parameters (k, nu)``."""
    result = np.empty(times.size)
    key = np.hstack([directions, parameters])
    unique, which = np.unique(key, axis=0, return_inverse=True)
    for position, row in enumerate(unique):
        members = np.flatnonzero(which.reshape(-1) == position)
        direction, parameter = row[: directions.shape[1]], row[directions.shape[1]:]
        result[members] = _cumulative(response, bound, times[members], direction, parameter)
    return result


def _cumulative(response: Response, bound: ConvexSet, times: Array, direction: Array, parameter: Array) -> Array:
    """Integrate over the grid's pieces (as a partition of ``[0, t]`` in ``s``), refined by the asked times."""
    points = np.unique(np.concatenate([response.grid.breakpoints, times]))
    A, _, W = response.system.matrices(parameter[None])
    lengths = np.diff(points)
    starts = np.einsum("i,lij->lj", direction, transitions(A[0][None], points[:-1])[0])
    integrals = (_box_integrals(A[0], W[0], starts, lengths, bound) if isinstance(bound, Box)
                 else _smooth_integrals(A[0], W[0], starts, lengths, bound))
    total = np.concatenate([[0.0], np.cumsum(integrals)])
    return total[np.searchsorted(points, times)]


def _smooth_integrals(A: Array, W: Array, starts: Array, lengths: Array, bound: ConvexSet) -> Array:
    within = lengths[:, None] * (NODES + 1) / 2
    flow, _ = transitions(A[None, None], within)
    values = bound.support(np.einsum("li,lqij,jw->lqw", starts, flow, W))
    return np.asarray((values * WEIGHTS).sum(axis=1) * lengths / 2, dtype=float)


def _box_integrals(A: Array, W: Array, starts: Array, lengths: Array, bound: Box) -> Array:
    """``int max(u y, l y) = c int y + r int |y|`` per channel, with centre ``c`` and half-width ``r`` of the box."""
    centre, radius = (bound.upper + bound.lower) / 2, (bound.upper - bound.lower) / 2
    _, whole = transitions(A[None], lengths)
    integral = np.einsum("li,lij,jw->lw", starts, whole, W)
    total = np.asarray(integral @ centre, dtype=float)
    for channel in np.flatnonzero(radius > 0):
        total = total + radius[channel] * _absolute(A, W[:, channel], starts, lengths)
    return total


def _absolute(A: Array, w: Array, starts: Array, lengths: Array) -> Array:
    """``int_0^h |y(s)| ds`` with ``y(s) = start' e^{A s} w`` on each piece, split at the extremum of ``y`` and then at its roots."""
    ends = _value(A, w, starts, lengths)
    slope_start, slope_end = starts @ (A @ w), _value(A, A @ w, starts, lengths)
    turning = slope_start * slope_end < 0
    middle = lengths.copy()
    middle[turning] = _root(A, A @ w, starts[turning], lengths[turning])
    at_middle = np.where(turning, _value(A, w, starts, middle), ends)
    first = _between(A, w, starts, np.zeros_like(lengths), middle, starts @ w, at_middle)
    return first + np.where(turning, _between(A, w, starts, middle, lengths, at_middle, ends), 0.0)


def _between(A: Array, w: Array, starts: Array, left: Array, right: Array, at_left: Array, at_right: Array) -> Array:
    """``|int|`` over ``[left, right]``, where ``y`` is monotone: split at its root when the ends differ in sign."""
    cross = at_left * at_right < 0
    root = right.copy()
    if cross.any():
        moved = np.einsum("li,lij->lj", starts[cross], transitions(A[None], left[cross])[0])
        root[cross] = left[cross] + _root(A, w, moved, (right - left)[cross])
    cumulative = np.einsum("li,qlij,j->ql", starts, transitions(A[None, None], np.stack([left, root, right]))[1], w)
    answer: Array = np.abs(cumulative[1] - cumulative[0]) + np.abs(cumulative[2] - cumulative[1])
    return answer


def _root(A: Array, w: Array, starts: Array, lengths: Array) -> Array:
    """The root in ``[0, length]`` of ``start' e^{A s} w``, which changes sign there: bisection, all pieces at once."""
    low, high = np.zeros_like(lengths), lengths.copy()
    sign = np.sign(starts @ w)
    for _ in range(BISECTIONS):
        middle = (low + high) / 2
        left = np.sign(_value(A, w, starts, middle)) == sign
        low, high = np.where(left, middle, low), np.where(left, high, middle)
    return (low + high) / 2


def _value(A: Array, w: Array, starts: Array, durations: Array) -> Array:
    if not starts.shape[0]:
        return np.zeros(0)
    answer: Array = np.einsum("li,lij,j->l", starts, transitions(A[None], durations)[0], w)
    return answer


@dataclass(frozen=True, eq=False)
class MeasurablePush:
    """The push of measurable disturbances on functionals ``rows (r, d)`` of a *known* system, in the form of `Push`.

    ``sigma`` is an integral with a Lipschitz integrand, so its second derivative is bounded by that of the integrand's argument.
    """

    response: Response
    bound: ConvexSet
    rows: Array

    def swing(self, times: Array) -> Array:
        """No parameters, no swing: ``(k, r, 0)``."""
        return np.zeros((times.size, self.rows.shape[0], 0))

    def at(self, times: Array, ends: Array) -> tuple[Array, Array]:
        """The push ``(k, r, 1)`` and an excess of zero ``(k, r)``; ``ends (k, r, 0)``."""
        k, r = times.size, self.rows.shape[0]
        sigma = measurable_support(self.response, self.bound, np.repeat(times, r), np.tile(self.rows, (k, 1)), np.zeros((k * r, 0)))
        return sigma.reshape(k, r, 1), np.zeros((k, r))

    @cached_property
    def curvature(self) -> Array:
        """Bounds ``(L, r)`` of the integrand's slope ``h(E' A' e^{A' s} c)`` on every piece."""
        grid = self.response.grid
        A, _, W = self.response.system.matrices(np.zeros((1, 0)))
        slopes = self.rows @ (transitions(A[0][None], grid.breakpoints)[0] @ A[0])
        ends = slopes @ W[0]
        size = np.maximum(self.bound.support(ends), self.bound.support(-ends))
        norm = float(np.linalg.norm(A[0], 2))
        axes = np.eye(self.bound.dimension)
        reach = float(np.linalg.norm(np.maximum(self.bound.support(axes), self.bound.support(-axes)))) * float(np.linalg.norm(W[0], 2))
        grown = np.linalg.norm(slopes[:-1], axis=2) * np.expm1(np.minimum(norm * grid.lengths, 300.0))[:, None] * reach
        return np.asarray(size[:-1] + grown)

    @property
    def neglected(self) -> Array:
        """Nothing: ``(r, L)`` of zeros."""
        return np.zeros((self.rows.shape[0], self.response.grid.pieces))
