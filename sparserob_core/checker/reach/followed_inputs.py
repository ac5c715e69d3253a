"""Bounded inputs of a known system that does not change with time, along the adjoints of its rows.

Integration by parts rewrites the worst case of an input as a sum over the jumps of its size, each times ``F(t - t_k)``
with ``F(a) = int_0^a h(l(s)'B) ds``, where ``h`` is the support function of the input of size 1. A measurable
disturbance has one jump, at 0. Neither many states nor fast modes are expensive.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise
from math import comb
from typing import final

import numpy as np

from sparserob_core.checker.arithmetic.balls import difference
from sparserob_core.checker.arithmetic.remembered import remembered
from sparserob_core.checker.reach.adjoint import ORDER, AdjointRow, accumulate_exactly
from sparserob_core.checker.reach.bounded_inputs import SizedInput
from sparserob_core.checker.reach.kernels import BoundedInputHere
from sparserob_core.checker.sets.along import NormSummand
from sparserob_core.checker.sets.polynomials import HALF_ULP, OUTWARD, rounding
from sparserob_core.checker.sets.summands import Summand, integrate
from sparserob_core.sip.convex_set import Array

# from powers of the share ``v`` of a step to powers of ``u = 2 v - 1``: ``v^j = (1 + u)^j / 2^j``
CENTRED = np.array([[comb(j, i) / 2.0**j for j in range(ORDER + 1)] for i in range(ORDER + 1)])


@final
@dataclass(frozen=True, eq=False)
class FollowedInput(BoundedInputHere):
    """An ``input`` of a system with ``adjoints`` of exact rows ``(d,)``, of which it enters by some columns."""

    adjoints: Callable[[Array], AdjointRow]
    input: SizedInput

    @remembered(key=lambda self, c: self.input.sort_direction(c))
    def _integrate_along(self, c: Array) -> SupportIntegrals:
        """Return the integrals of support functions for an exact direction ``c (d,)``."""
        return SupportIntegrals(self.adjoints(self.input.reaching(c)), self.input.columns, self.input.summands)

    def integrals(self, c: Array, times: Array, points: Array) -> tuple[Array, Array]:
        """Return lower and upper bounds ``(k, q, S)`` each of ``F(a)`` at the ages ``a = times (k,) - points (q,)``,
        and 0 where the age is not positive. The bounds hold for the exact differences of these times."""
        ages, rounded = (v.ravel() for v in difference(times[:, None], points))
        bounds = self._integrate_along(c).at(np.maximum(ages, 0.0), np.abs(rounded))
        low, high = np.where(ages[:, None] > 0.0, bounds, 0.0)
        shape = times.size, points.size, self.input.shares.size
        return low.reshape(shape), high.reshape(shape)

    def least(self, c: Array, time: float) -> Array:
        """Return lower bounds ``(K, S)`` of what the worst input adds to ``c'x(t)``, for a command of size 1 on one
        piece in one channel."""
        (low,), (high,) = self.integrals(c, np.array([time]), self.input.breakpoints)
        return np.asarray(np.maximum(self.input.shares * (low[:-1] - high[1:]) * (1.0 - 1e-15), 0.0))

    @cached_property
    def jumps(self) -> tuple[np.ndarray, Array, Array]:
        """The indices ``(q,)`` of the pieces that differ from the piece before, the jumps ``(q, S)`` of the size of the
        input, and their error bounds ``(q, S)``."""
        size, errors = self.input.sizes.mid, self.input.sizes.rad
        change = np.diff(size, axis=0, prepend=0.0)
        errors = errors + np.concatenate([np.zeros_like(errors[:1]), errors[:-1]]) + rounding(1) * np.abs(change)
        is_new = np.array([True, *(a is not b for a, b in pairwise(self.input.pieces))])
        indices = np.flatnonzero(is_new & (change.any(axis=1) | errors.any(axis=1)))
        return indices, change[indices], (errors * OUTWARD)[indices]

    def added_at(self, c: Array, times: Array) -> tuple[Array, Array]:
        """Return lower and upper bounds of what the worst input adds to ``c'x`` at ``times (k,)``, ``(k,)`` each."""
        indices, change, errors = self.jumps
        low, high = self.integrals(c, times, self.input.breakpoints[indices])
        up, down, size = np.maximum(change, 0.0), np.minimum(change, 0.0), np.maximum(np.abs(low), np.abs(high))
        error = ((errors + rounding(2 * change.size + 8) * np.abs(change)) * size).sum(axis=(1, 2)) * OUTWARD
        return (up * low + down * high).sum(axis=(1, 2)) - error, (up * high + down * low).sum(axis=(1, 2)) + error

    def bound_chord_errors(self, c: Array, start: Array, stop: Array) -> Array:
        """Return upper bounds ``(k,)`` of the distance between `added` and its chord on every interval from
        ``start (k,)`` to ``stop (k,)``, each within one piece."""
        if not (start < stop).any():
            return np.zeros(start.size)
        indices, change, errors = self.jumps
        row = self.adjoints(self.input.reaching(c))
        steepest = row.derivative_bounds[1][:, self.input.columns] @ self.input.radii.T * OUTWARD
        ages = np.stack([start, stop])[:, :, None] - self.input.breakpoints[indices]
        places = np.clip(np.floor(ages / row.step).astype(int) + np.array([-1, 1])[:, None, None], 0, row.count - 1)
        tops = _find_largest(steepest, places[0], places[1] + 1)
        total = ((np.abs(change) + errors) * tops * (ages[1] > 0.0)[..., None]).sum(axis=(1, 2))
        return np.asarray((stop - start) ** 2 / 8.0 * total * (1.0 + rounding(change.size + 16)))


@final
@dataclass(frozen=True, eq=False)
class SupportIntegrals:
    """The integrals, from 0 on, of the support functions of ``summands`` at some ``columns`` of ``l'F`` for one
    ``row``: one integral for every summand."""

    row: AdjointRow
    columns: slice
    summands: Sequence[Summand | NormSummand]

    @cached_property
    def _polynomials(self) -> tuple[Array, Array]:
        """The columns of ``l'F`` on every step in powers of ``u`` from -1 to 1, ``(N, p + 1, w)``, and their error
        bounds, ``(N, w)``."""
        mid, rad = (values[:, :, self.columns] for values in (self.row.driven.mid, self.row.driven.rad))
        # in powers of ``u`` the sizes are no larger, since ``|v| <= (1 + |u|) / 2``
        errors = rad.sum(axis=1) + rounding(2 * ORDER) * np.abs(mid).sum(axis=1)
        return np.einsum("ij,kjw->kiw", CENTRED, mid), errors * OUTWARD

    @cached_property
    def _support_bounds(self) -> Array:
        """The upper bounds of the absolute values of the support functions on every step and its neighbours,
        ``(N, S)``."""
        polynomials, errors = self._polynomials
        sizes = np.abs(polynomials).sum(axis=1) * OUTWARD + errors
        heights = sizes @ np.array([summand.radii for summand in self.summands]).T * OUTWARD
        padded = np.pad(heights, ((1, 1), (0, 0)), mode="edge")
        return np.asarray(np.maximum(heights, np.maximum(padded[:-2], padded[2:])))

    def _integrate_steps(self, steps: np.ndarray, shares: Array) -> Array:
        """Return lower and upper bounds ``(2, k, S)`` of the integrals over the first ``shares (k,)`` of ``steps
        (k,)``, whose length is a power of two."""
        polynomials, errors = (values[steps] for values in self._polynomials)
        bounds = np.array(integrate(self.summands, polynomials, errors, 2.0 * shares - 1.0))
        # the end of a part is rounded as one of the whole step, however short the part is
        rounded = rounding(4 * ORDER) * self._support_bounds[steps] * (shares < 1.0)[:, None]
        return np.asarray(self.row.step * (bounds + np.array([-1.0, 1.0])[:, None, None] * rounded * OUTWARD))

    @cached_property
    def _end_integrals(self) -> Array:
        """Lower and upper bounds of the integrals from 0 to the ends of all steps, 0 itself first, ``(2, N + 1, S)``,
        up to the rounding of each."""
        bounds = self._integrate_steps(np.arange(self.row.count), np.ones(self.row.count))
        return np.array([accumulate_exactly(bound) for bound in bounds])

    def at(self, times: Array, rounded: Array | float = 0.0) -> Array:
        """Return lower and upper bounds, ``(2, k, S)``, of the integrals from 0 to ``times (k,)``. The given times may
        differ from the true ones by at most ``rounded``."""
        steps, shares = self.row.placed(times)
        bounds, is_inside = self._end_integrals[:, steps], shares > 0.0
        error = 4.0 * HALF_ULP * np.abs(bounds)
        bounds[:, is_inside] += self._integrate_steps(steps[is_inside], shares[is_inside])
        error += 4.0 * HALF_ULP * np.abs(bounds) + np.asarray(rounded)[..., None] * self._support_bounds[steps]
        return np.asarray(bounds + np.array([-1.0, 1.0])[:, None, None] * error * OUTWARD)


def _find_largest(values: Array, first: np.ndarray, last: np.ndarray) -> Array:
    """Return the largest of ``values (N, m)`` from index ``first (...)`` up to before ``last (...)``, ``(..., m)``."""
    padded = np.vstack([values, values[-1:]])
    ends = np.stack([first.ravel(), last.ravel()], axis=1).ravel()
    return np.asarray(np.maximum.reduceat(padded, ends, axis=0)[::2].reshape(*first.shape, values.shape[1]))
