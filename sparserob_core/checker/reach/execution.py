"""Errors of execution: what is delivered of a control differs from the command by a share of it at most, any function
of time.

Given the command ``u`` the worst of ``c'x(t)`` grows by ``sum_jk share_j |u_jk| int |c'e^{A(t-s)} B_j| ds`` over the
pieces. By parts that is a sum over the jumps of ``share_j |u_j|`` of ``F_j(t - t_k)``, ``F_j(a) = int_0^a |c'e^{A s}
B_j| ds``; the ``F_j`` are enclosed by the polynomials of a `Kernel`, and so is how fast ``|c'e^{A s} B_j|`` changes.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import TYPE_CHECKING, final

import numpy as np

from sparserob_core.checker.reach.flow import OwnUnits, flows, middles, stacked
from sparserob_core.checker.reach.measurable import APART, ORDER, Kernel, swept
from sparserob_core.checker.sets.polynomials import OUTWARD, Enclosed, rounding
from sparserob_core.control.problem.problem import OptimalControlProblem
from sparserob_core.sip.convex_set import Array

if TYPE_CHECKING:
    from flint import arb_mat


@final
@dataclass(frozen=True, eq=False)
class Ages:
    """``|c'e^{A s} B_j|`` for one ``c`` on equal parts of the horizon: polynomials ``P (S, p + 1, m)``, off by at most
    ``off (S, m)``, integrals up to the end of every part between ``low`` and ``high (S + 1, m)``, and how fast it
    changes at most, ``steepest (S, m)``."""

    P: Array
    off: Array
    low: Array
    high: Array
    steepest: Array


@final
@dataclass(frozen=True, eq=False)
class Execution:
    """The ``shares (m,)`` of a control that is ``pieces``, ``(m, 1)`` each, between ``breakpoints (K + 1,)``; there are
    none where only rows are asked for."""

    problem: OptimalControlProblem
    shares: Array
    breakpoints: Array
    pieces: Sequence[arb_mat]
    _known: dict[bytes, Ages] = field(default_factory=dict, repr=False)

    @cached_property
    def kernel(self) -> Kernel:
        """``e^{A s} [B, A B]`` over the horizon: the second half is how fast the first one changes."""
        from flint import arb

        (flow,) = flows(self.problem.system, [])
        A, B, m = flow.parts["A"][0], flow.parts["B"][0], self.shares.size
        B = stacked([row[:m] for row in B.tolist()])
        both = stacked([[*b, *more] for b, more in zip(B.tolist(), (A * B).tolist(), strict=True)])
        horizon = float(self.breakpoints[-1])
        return Kernel.of(A, both, arb(horizon), OwnUnits.of(A, horizon, np.abs(middles(B)).sum(axis=1)))

    def ages(self, c: Array) -> Ages:
        """Those of a direction ``c (d,)``, which is exact."""
        key = (c + 0.0).tobytes()
        if key not in self._known:
            kernel, m = self.kernel, self.shares.size
            plain, off = kernel.along(Enclosed(c[None], np.zeros((1, c.size))))
            P, off = plain[0], off[0] + rounding(4 * ORDER + 32) * np.abs(plain[0]).sum(axis=1)  # as they are summed
            value, more, less = swept(*_signed(P[..., :m], off[:, :m]), np.ones(len(P) * m))
            low, high = (part.reshape(-1, m) * kernel.half for part in (value - less, value + more))
            lost = rounding(len(P) + 8) * np.cumsum(np.abs(high), axis=0)
            totals = [np.concatenate([np.zeros((1, m)), np.cumsum(part, axis=0)]) for part in (low, high)]
            lost = np.concatenate([np.zeros((1, m)), lost]) * OUTWARD
            steepest = np.abs(P[..., m:]).sum(axis=1) + off[:, m:]
            self._known[key] = Ages(P[..., :m], off[:, :m], totals[0] - lost, totals[1] + lost, steepest * OUTWARD)
        return self._known[key]

    def integrals(self, c: Array, ages: Array) -> tuple[Array, Array]:
        """``F_j`` at ``ages (n,)`` that are rounded differences of times, between ``(n, m)`` and ``(n, m)``."""
        known, kernel, m = self.ages(c), self.kernel, self.shares.size
        place = np.clip(ages / float(self.breakpoints[-1]) * kernel.count, 0.0, kernel.count)
        part = np.minimum(place.astype(int), kernel.count - 1)
        ends = np.clip(2.0 * (place - part) - 1.0, -1.0, 1.0)
        P, off = known.P[part], known.off[part]
        value, more, less = swept(*_signed(P, off), np.repeat(ends, m))
        value, more, less = (one.reshape(-1, m) for one in (value, more, less))
        # of where an age is among the parts, and of the polynomial's own height there
        late = APART * kernel.count * np.abs(known.P).sum(axis=1).max(axis=0) + rounding(16) * np.abs(value)
        low = known.low[part] + (value - less - late) * kernel.half
        high = known.high[part] + (value + more + late) * kernel.half
        size = rounding(4) * (np.abs(low) + np.abs(high))
        begun = (ages > 0.0)[:, None]
        return np.where(begun, np.maximum(low - size, 0.0), 0.0), np.where(begun, high + size, 0.0)

    def least(self, c: Array, time: float) -> Array:
        """What a command of size 1 on every piece adds at least to ``c'x(t)``, ``(K, m)``."""
        low, high = self.integrals(c, np.maximum(time - self.breakpoints, 0.0))
        found = self.shares * (low[:-1] - high[1:]) * (1.0 - 1e-15)
        return np.maximum(found, 0.0)

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
        which, change, off = self.jumps
        low, high = self.integrals(c, np.maximum(time - self.breakpoints[which], 0.0))
        up, down = np.maximum(change, 0.0), np.minimum(change, 0.0)
        lost = (off * high).sum() + rounding(2 * change.size + 8) * (np.abs(change) * high).sum()
        lost *= OUTWARD
        return float((up * low + down * high).sum() - lost), float((up * high + down * low).sum() + lost)

    def bent(self, c: Array, start: float, stop: float) -> float:
        """How far `added` may be from its chord on ``[start, stop]``, which lies within one piece."""
        which, change, off = self.jumps
        ages = np.array([start, stop])[:, None] - self.breakpoints[which]
        known, kernel = self.ages(c), self.kernel
        places = np.clip(ages / float(self.breakpoints[-1]) * kernel.count, 0.0, kernel.count - 1).astype(int)
        first, last = np.maximum(places[0] - 1, 0), np.minimum(places[1] + 1, kernel.count - 1)
        steep = np.array([known.steepest[a : b + 1].max(axis=0) for a, b in zip(first, last, strict=True)])
        begun = (ages[1] > 0.0)[:, None]
        total = ((np.abs(change) + off) * steep.reshape(change.shape) * begun).sum()
        return float((stop - start) ** 2 / 8.0 * total * (1.0 + rounding(change.size + 16)))


def _signed(P: Array, off: Array) -> tuple[Array, Array]:
    """Polynomials ``(n, p + 1, m)`` with their opposites, one after another, ``(n m, p + 1, 2)``, and how far both are
    off."""
    each = np.moveaxis(P, 2, 1).reshape(-1, P.shape[1])
    return np.stack([each, -each], axis=2), np.repeat(off.reshape(-1, 1), 2, axis=1)
