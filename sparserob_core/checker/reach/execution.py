"""Errors of execution in a known system that does not change with time: the delivered control differs from the command.

These errors are measurable disturbances through ``B`` whose size is a share of the command. Integration by parts
rewrites the worst case as a sum over the jumps of ``share_j |u_j|``, each times ``F_j(t - t_k)`` with
``F_j(a) = int_0^a |c'e^{A s} B_j| ds``. The rows ``c'e^{A s}`` are computed by their adjoints, so that neither many
states nor fast modes are expensive.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import final

import numpy as np
from flint import arb_mat

from sparserob_core.checker.arithmetic.remembered import remembered
from sparserob_core.checker.arithmetic.series import stacked
from sparserob_core.checker.flow.plant import modes_at
from sparserob_core.checker.outcome import Clock
from sparserob_core.checker.reach.adjoint import AdjointFlow, AdjointRow, SupportIntegrals, subtract_times
from sparserob_core.checker.reach.kernels import BoundedInputHere
from sparserob_core.checker.sets.polynomials import OUTWARD, Enclosed, rounding
from sparserob_core.checker.sets.summands import channels
from sparserob_core.control.problem.problem import OptimalControlProblem
from sparserob_core.sip.convex_set import Array


@final
@dataclass(frozen=True, eq=False)
class FollowedExecution(BoundedInputHere):
    """The errors of execution of a control, at most the ``shares (m,)`` of its ``pieces``, ``(m, 1)`` each, between
    ``breakpoints (K + 1,)``; ``pieces`` is empty where only bounds per unit of command are needed."""

    problem: OptimalControlProblem
    shares: Array
    breakpoints: Array
    pieces: Sequence[arb_mat]
    clock: Clock = field(default_factory=Clock)

    @cached_property
    def motion(self) -> AdjointFlow:
        """The adjoint flow that all rows share, with ``B`` set to 0 at states that no error of execution reaches."""
        (mode,) = modes_at(self.problem.system, [])
        A, B, m = mode["A"], mode["B"], self.shares.size
        B = stacked([[x * (i not in self.problem.commanded) for x in row[:m]] for i, row in enumerate(B.tolist())])
        return AdjointFlow.of(A, B, float(self.breakpoints[-1]), self.clock)

    @remembered(key=lambda self, c: min((c + 0.0).tobytes(), (0.0 - c).tobytes()))
    def absolute(self, c: Array) -> SupportIntegrals:
        """Return the integrals of ``|c'e^{A s} B_j|`` for an exact direction ``c (d,)``; the direction ``-c`` has the
        same ones."""
        return SupportIntegrals(AdjointRow.of(self.motion, c + 0.0), slice(None), channels(self.shares.size))

    def integrals(self, c: Array, times: Array, points: Array) -> tuple[Array, Array]:
        """Return lower and upper bounds ``(k, q, m)`` each of ``F_j(a)`` at the ages ``a = times (k,) - points (q,)``,
        and 0 where the age is not positive. The bounds hold for the exact differences of these times."""
        ages, rounded = (values.ravel() for values in subtract_times(times[:, None], points))
        bounds = self.absolute(c).at(np.maximum(ages, 0.0), rounded)
        low, high = (np.where(ages[:, None] > 0.0, bound, 0.0) for bound in bounds)
        shape = times.size, points.size, self.shares.size
        return low.reshape(shape), high.reshape(shape)

    def least(self, c: Array, time: float) -> Array:
        """Return lower bounds ``(K, m)`` of what the worst errors add to ``c'x(t)``, for a command of size 1 on one
        piece in one channel."""
        (low,), (high,) = self.integrals(c, np.array([time]), self.breakpoints)
        return np.asarray(np.maximum(self.shares * (low[:-1] - high[1:]) * (1.0 - 1e-15), 0.0))

    @cached_property
    def jumps(self) -> tuple[np.ndarray, Array, Array]:
        """The indices ``(q,)`` of the pieces at which the control or the size of an error jumps, the jumps of this size
        ``(q, m)``, and their error bounds ``(q, m)``."""
        control = Enclosed.all(self.pieces, (len(self.pieces), self.shares.size))
        size = self.shares * np.abs(control.mid)
        errors = self.shares * control.rad + rounding(2) * size
        change = np.diff(size, axis=0, prepend=0.0)
        errors = errors + np.concatenate([np.zeros_like(errors[:1]), errors[:-1]]) + rounding(1) * np.abs(change)
        indices = np.flatnonzero(np.diff(control.mid, axis=0, prepend=0.0).any(axis=1) | change.any(axis=1))
        return indices, change[indices], (errors * OUTWARD)[indices]

    def added(self, c: Array, time: float) -> tuple[float, float]:
        """Return a lower and an upper bound of what the worst errors add to ``c'x(t)``."""
        (low,), (high,) = self.added_at(c, np.array([time]))
        return float(low), float(high)

    def added_at(self, c: Array, times: Array) -> tuple[Array, Array]:
        """Return lower and upper bounds of what the worst errors add to ``c'x`` at ``times (k,)``, ``(k,)`` each."""
        indices, change, errors = self.jumps
        low, high = self.integrals(c, times, self.breakpoints[indices])
        up, down = np.maximum(change, 0.0), np.minimum(change, 0.0)
        error = (errors * high + rounding(2 * change.size + 8) * np.abs(change) * high).sum(axis=(1, 2)) * OUTWARD
        return (up * low + down * high).sum(axis=(1, 2)) - error, (up * high + down * low).sum(axis=(1, 2)) + error

    def bound_chord_error(self, c: Array, start: float, stop: float) -> float:
        """Return an upper bound of the distance between `added` and its chord on ``[start, stop]``, which lies within
        one piece."""
        return float(self.bound_chord_errors(c, np.array([start]), np.array([stop]))[0])

    def bound_chord_errors(self, c: Array, start: Array, stop: Array) -> Array:
        """Return upper bounds ``(k,)`` of the distance between `added` and its chord on every interval from
        ``start (k,)`` to ``stop (k,)``, each within one piece."""
        indices, change, errors = self.jumps
        steepest, step = self.absolute(c).row.derivative_bounds[1], self.motion.step
        ages = np.stack([start, stop])[:, :, None] - self.breakpoints[indices]
        places = np.clip(np.floor(ages / step).astype(int) + np.array([-1, 1])[:, None, None], 0, len(steepest) - 1)
        tops = _find_largest(steepest, places[0], places[1] + 1)
        total = ((np.abs(change) + errors) * tops * (ages[1] > 0.0)[..., None]).sum(axis=(1, 2))
        return np.asarray((stop - start) ** 2 / 8.0 * total * (1.0 + rounding(change.size + 16)))


def _find_largest(values: Array, first: np.ndarray, last: np.ndarray) -> Array:
    """Return the largest of ``values (N, m)`` from index ``first (...)`` up to before ``last (...)``, ``(..., m)``."""
    padded = np.vstack([values, values[-1:]])
    ends = np.stack([first.ravel(), last.ravel()], axis=1).ravel()
    return np.asarray(np.maximum.reduceat(padded, ends, axis=0)[::2].reshape(*first.shape, values.shape[1]))
