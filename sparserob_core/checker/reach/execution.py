"""Errors of execution of a known system that does not change: what is delivered of a control differs from the command.

They are measurable disturbances through ``B``, as large as a share of the command. By parts the worst of them is a sum
over the jumps of ``share_j |u_j|`` of ``F_j(t - t_k)``, ``F_j(a) = int_0^a |c'e^{A s} B_j| ds``. The rows ``c'e^{A s}``
are followed by their adjoints, so that neither many states nor fast modes are dear.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property
from itertools import accumulate
from typing import TYPE_CHECKING, final

import numpy as np

from sparserob_core.checker.arithmetic.balls import balls
from sparserob_core.checker.arithmetic.series import stacked
from sparserob_core.checker.flow.still import modes_at
from sparserob_core.checker.outcome import Clock
from sparserob_core.checker.reach.adjoint import CENTRED, ORDER, Adjoint, Motion, subtract_times
from sparserob_core.checker.reach.kernels import Missed
from sparserob_core.checker.reach.measurable import signed, swept
from sparserob_core.checker.sets.polynomials import HALF_ULP, OUTWARD, Enclosed, rounding
from sparserob_core.control.problem.problem import OptimalControlProblem
from sparserob_core.sip.convex_set import Array

if TYPE_CHECKING:
    from flint import arb, arb_mat


@final
@dataclass(frozen=True, eq=False)
class Ages:
    """``|c'e^{A s} B_j|`` for one ``c`` on equal steps: polynomials ``P (N, p + 1, m)`` of ``u`` from -1 to 1 across
    each, off by at most ``off (N, m)``; integrals up to the end of every step between ``low`` and ``high (N + 1, m)``;
    and how large it is, ``heights (N, m)``, and how fast it changes, ``steepest (N, m)``, at most."""

    P: Array
    off: Array
    low: Array
    high: Array
    heights: Array
    steepest: Array


@final
@dataclass(frozen=True, eq=False)
class Execution(Missed):
    """The ``shares (m,)`` of a control that is ``pieces``, ``(m, 1)`` each, between ``breakpoints (K + 1,)``; there are
    none where only rows are asked for."""

    problem: OptimalControlProblem
    shares: Array
    breakpoints: Array
    pieces: Sequence[arb_mat]
    clock: Clock = field(default_factory=Clock)
    _known: dict[bytes, Ages] = field(default_factory=dict, repr=False)

    @cached_property
    def motion(self) -> Motion:
        """What the rows share, with ``B`` as far as errors enter by it."""
        (mode,) = modes_at(self.problem.system, [])
        A, B, m = mode["A"], mode["B"], self.shares.size
        B = stacked([[x * (i not in self.problem.commanded) for x in row[:m]] for i, row in enumerate(B.tolist())])
        return Motion.of(A, B, float(self.breakpoints[-1]), self.clock)

    def ages(self, c: Array) -> Ages:
        """Those of a direction ``c (d,)``, which is exact; its opposite has the same."""
        exact = c + 0.0
        key = min(exact.tobytes(), (0.0 - exact).tobytes())
        if key not in self._known:
            row, m = Adjoint.of(self.motion, exact), self.shares.size
            P, sizes = (np.einsum("ij,kjw->kiw", *pair) for pair in (
                (CENTRED, row.driven.mid), (np.abs(CENTRED), np.abs(row.driven.mid))
            ))  # fmt: skip
            # in other powers, and as they are summed
            off = (row.driven.rad.sum(axis=1) + rounding(6 * ORDER + 32) * sizes.sum(axis=1)) * OUTWARD
            value, more, less = (part.reshape(-1, m) for part in swept(*signed(P, off), np.ones(len(P) * m)))
            half = row.step / 2.0  # a power of two
            sums = zip(*map(_accumulated, value.T), strict=True)
            totals = np.array([[float(x.mid()) for x in line] for line in sums])
            outward = OUTWARD * (1.0 + rounding(len(P)))
            lost = [np.vstack([np.zeros((1, m)), np.cumsum(part, axis=0)]) * outward for part in (less, more)]
            ends = 4.0 * HALF_ULP * totals
            low, high = (totals - lost[0] - ends) * half, (totals + lost[1] + ends) * half
            heights = np.abs(P).sum(axis=1) + off
            self._known[key] = Ages(P, off, low, high, heights * OUTWARD, row.bends[1])
        return self._known[key]

    def integrals(self, c: Array, times: Array, points: Array) -> tuple[Array, Array]:
        """``F_j`` at the ages ``times (k,)`` minus ``points (q,)``, exactly, between ``(k, q, m)`` and ``(k, q, m)``; 0
        before a point."""
        known, m, step = self.ages(c), self.shares.size, self.motion.step
        ages, rounded = (part.ravel() for part in subtract_times(times[:, None], points))
        place = np.clip(np.floor(np.maximum(ages, 0.0) / step).astype(int), 0, len(known.P) - 1)
        ends = np.clip(2.0 * (np.maximum(ages, 0.0) - place * step) / step - 1.0, -1.0, 1.0)
        P, off = known.P[place], known.off[place]
        value, more, less = (one.reshape(-1, m) for one in swept(*signed(P, off), np.repeat(ends, m)))
        # the exact age is within what is rounded, which is far less than a step
        near = np.maximum(known.heights[place], known.heights[np.maximum(place - 1, 0)])
        near = np.maximum(near, known.heights[np.minimum(place + 1, len(known.P) - 1)])
        late = (rounded[:, None] + HALF_ULP * step) * near + rounding(4) * np.abs(value) * step / 2.0
        low = known.low[place] + (value - less) * (step / 2.0) - late
        high = known.high[place] + (value + more) * (step / 2.0) + late
        size = rounding(4) * (np.abs(low) + np.abs(high))
        begun, shape = (ages > 0.0)[:, None], (times.size, points.size, m)
        low, high = np.where(begun, np.maximum(low - size, 0.0), 0.0), np.where(begun, high + size, 0.0)
        return low.reshape(shape), high.reshape(shape)

    def least(self, c: Array, time: float) -> Array:
        """What a command of size 1 on every piece adds at least to ``c'x(t)``, ``(K, m)``."""
        (low,), (high,) = self.integrals(c, np.array([time]), self.breakpoints)
        return np.asarray(np.maximum(self.shares * (low[:-1] - high[1:]) * (1.0 - 1e-15), 0.0))

    @cached_property
    def jumps(self) -> tuple[np.ndarray, Array, Array]:
        """The pieces ``(q,)`` with which the size of an error changes, by how much ``(q, m)``, and how far that may be
        off."""
        control = Enclosed.all(self.pieces, (len(self.pieces), self.shares.size))
        size = self.shares * np.abs(control.mid)
        off = self.shares * control.rad + rounding(2) * size
        change = np.diff(size, axis=0, prepend=0.0)
        off = off + np.concatenate([np.zeros_like(off[:1]), off[:-1]]) + rounding(1) * np.abs(change)
        which = np.flatnonzero(np.diff(control.mid, axis=0, prepend=0.0).any(axis=1) | change.any(axis=1))
        return which, change[which], (off * OUTWARD)[which]

    def added(self, c: Array, time: float) -> tuple[float, float]:
        """What the worst errors add to ``c'x(t)``, between two numbers."""
        (low,), (high,) = self.added_at(c, np.array([time]))
        return float(low), float(high)

    def added_at(self, c: Array, times: Array) -> tuple[Array, Array]:
        """`added` at ``times (k,)``, ``(k,)`` each."""
        which, change, off = self.jumps
        low, high = self.integrals(c, times, self.breakpoints[which])
        up, down = np.maximum(change, 0.0), np.minimum(change, 0.0)
        lost = (off * high + rounding(2 * change.size + 8) * np.abs(change) * high).sum(axis=(1, 2)) * OUTWARD
        return (up * low + down * high).sum(axis=(1, 2)) - lost, (up * high + down * low).sum(axis=(1, 2)) + lost

    def bent(self, c: Array, start: float, stop: float) -> float:
        """How far `added` may be from its chord on ``[start, stop]``, which lies within one piece."""
        return float(self.bent_over(c, np.array([start]), np.array([stop]))[0])

    def bent_over(self, c: Array, start: Array, stop: Array) -> Array:
        """`bent` on intervals from ``start (k,)`` to ``stop (k,)``."""
        which, change, off = self.jumps
        steepest, step = self.ages(c).steepest, self.motion.step
        ages = np.stack([start, stop])[:, :, None] - self.breakpoints[which]
        places = np.clip(np.floor(ages / step).astype(int) + np.array([-1, 1])[:, None, None], 0, len(steepest) - 1)
        tops = _tallest(steepest, places[0], places[1] + 1)
        total = ((np.abs(change) + off) * tops * (ages[1] > 0.0)[..., None]).sum(axis=(1, 2))
        return np.asarray((stop - start) ** 2 / 8.0 * total * (1.0 + rounding(change.size + 16)))


def _accumulated(values: Array) -> list[arb]:
    """The sums of the first ``0, 1, ..., n`` of ``values (n,)``, without rounding that one would notice."""
    return list(accumulate(balls(values), initial=balls([0.0])[0]))


def _tallest(values: Array, first: np.ndarray, last: np.ndarray) -> Array:
    """The largest of ``values (N, m)`` from each of ``first (...)`` up to before ``last (...)``, ``(..., m)``."""
    padded = np.vstack([values, values[-1:]])
    ends = np.stack([first.ravel(), last.ravel()], axis=1).ravel()
    return np.asarray(np.maximum.reduceat(padded, ends, axis=0)[::2].reshape(*first.shape, values.shape[1]))
