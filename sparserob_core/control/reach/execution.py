"""What errors of execution make of the reachable set.

What is delivered of a control differs from the command by at most a share of it, any function of time. What the worst
such error adds to ``c'x(t)`` is ``sum_jk share_j |u_jk| int |c'e^{A(t-s)} B_j| ds``, the integral over piece ``k`` up
to ``t``: convex in the command, and 0 where that is 0.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import final

import numpy as np

from sparserob_core.control.enclosures.comparison import block_norms
from sparserob_core.control.enclosures.matrix_exponential import rounding
from sparserob_core.control.enclosures.taylor import Combination
from sparserob_core.control.problem.system import LinearSystem
from sparserob_core.control.reach.measurable import MeasurableSupport, _moved
from sparserob_core.control.reach.support import KnownCellSupport, Support, over_directions
from sparserob_core.control.reach.varying_motion import (
    SpreadMotion,
    VaryingMotion,
)
from sparserob_core.control.response.lifted import LiftedSystem
from sparserob_core.control.response.response import Response, unique_rows
from sparserob_core.shapes import Float, shaped
from sparserob_core.sip.convex_set import Array, Box

# Of the horizon: ages that differ by less are one where nothing is proven. Ten times as much would be seen in a
# violation of 1e-9, a tenth of it is below what the difference of two times rounds to.
ALIKE = 1e-14


@dataclass(frozen=True, eq=False)
class Execution:
    """The ``shares (m,)`` of the commanded control by which what is delivered may differ; ``breakpoints (K + 1,)`` are
    the command's, ``response`` is that of a known system. ``felt (d,)``: 0 of states that add up what is commanded,
    and do nothing else, 1 of others."""

    response: Response
    breakpoints: Array
    shares: Array
    felt: Array

    def seen(self, directions: Array, parameters: Array) -> Array:
        """Directions ``(k, d)`` at parameters ``(k, nu)`` as those on the states that errors are followed in."""
        return directions

    def over(
        self,
        control: Array,
        rows: Array,
        leg: LiftedSystem | VaryingMotion | SpreadMotion,
        joined: Combination | None = None,
    ) -> Support:
        """What the worst errors of a ``control (m, K)`` add to functionals ``rows (r, d)`` over cells of time; with
        ``joined`` to that of a direction that is made of them."""
        assert isinstance(leg, LiftedSystem)
        return over_directions(lambda every: ExecutionCellSupport(self, control, every, leg), rows, leg, joined)

    def sampled(self, control: Array, times: Array, directions: Array) -> Array:
        """`added` at times and directions that are asked for again and again."""
        return self.added(control, times, directions)

    def none(self) -> Execution:
        """The same of a control that is delivered as it is commanded."""
        return replace(self, shares=np.zeros(self.shares.size))

    def given(self, times: Array, directions: Array) -> Array:
        """What errors of what was commanded before the first piece add to ``c'x(t)``, ``(k,)``: nothing."""
        return np.zeros(times.size)

    @property
    def size(self) -> int:
        """How many absolute values there are, one for every channel and piece."""
        return int(self.shares.size * (self.breakpoints.size - 1))

    @cached_property
    def matrices(self) -> tuple[Array, Array]:
        """``A (d, d)``, ``B (d, m)``."""
        A, B, _ = self.response.system.modes[0].matrices(np.zeros((1, 0)))
        return A[0], self.felt[:, None] * B[0][:, : self.shares.size]

    @cached_property
    def _supports(self) -> list[MeasurableSupport | None]:
        """``int_0^t |c'e^{A s} B_j| ds`` of every channel, ``None`` where it is delivered as it is commanded."""
        A, B = self.matrices
        unit, grid, start = Box([-1.0], [1.0]), self.response.grid, self.response.initial_state
        made = [Response(LinearSystem(A, B, B[:, [j]]), grid, start) for j in range(self.shares.size)]
        return [MeasurableSupport(one, unit) if s > 0.0 else None for one, s in zip(made, self.shares, strict=True)]

    @shaped
    def lengths(self, times: Float[Array, " k"], directions: Float[Array, "k d"]) -> Float[Array, "k n"]:
        """What a command of size 1 on every piece of every channel adds at most, ``(k, m K)``, channel by channel."""
        ages = np.clip(times[:, None] - self.breakpoints, 0.0, None)
        found = np.zeros((times.size, self.shares.size, self.breakpoints.size - 1))
        for j, integral in enumerate(self._integrals(ages, directions)):
            found[:, j] = self.shares[j] * np.maximum(integral[:, :-1] - integral[:, 1:], 0.0)
        return found.reshape(times.size, self.shares.size * (self.breakpoints.size - 1))

    @shaped
    def added(
        self, control: Float[Array, "m K"], times: Float[Array, " k"], directions: Float[Array, "k d"]
    ) -> Float[Array, " k"]:
        """What the worst errors of a command add to ``c'x(t)``, ``(k,)``."""
        which, jumps = self.jumps(control)
        if not which.size:
            return np.zeros(times.size)
        ages = np.clip(times[:, None] - self.breakpoints[which], 0.0, None)
        every = zip(self._integrals(ages, directions), jumps, strict=True)
        return np.asarray(sum(integral @ change for integral, change in every))

    @shaped
    def slope(
        self, control: Float[Array, "m K"], times: Float[Array, " k"], directions: Float[Array, "k d"]
    ) -> Float[Array, " k"]:
        """The derivative ``(k,)`` of `added` in the time, from the left where that jumps."""
        (A, B), (which, jumps) = self.matrices, self.jumps(control)
        ages = times[:, None] - self.breakpoints[which]
        at = _moved(A, directions, ages) @ B
        return np.asarray(np.einsum("kqm,mq,kq->k", np.abs(at), jumps, ages > 0.0))

    @shaped
    def jumps(self, control: Float[Array, "m K"]) -> tuple[np.ndarray, Float[Array, "m q"]]:
        """The pieces ``(q,)`` with which the size of the largest error changes, and by how much, ``(m, q)``: by parts,
        ``sum_k r_k int_k = sum_k (r_k - r_{k-1}) int_{t_k}^t``, of which a sparse control needs few."""
        jumps = np.diff(self.shares[:, None] * np.abs(control), axis=1, prepend=0.0)
        which = np.flatnonzero(jumps.any(axis=0))
        return which, jumps[:, which]

    def _integrals(self, ages: Array, directions: Array) -> list[Array]:
        """``int_0^age |c'e^{A s} B_j| ds`` for ages ``(k, q)`` of directions ``(k, d)``, of every channel; of ages that
        are alike once."""
        alike = ALIKE * float(self.breakpoints[-1])
        c, owner = unique_rows(directions)
        keys = np.stack([np.repeat(owner.reshape(-1), ages.shape[1]), np.rint(ages.ravel() / alike)])
        (who, _), first, which = np.unique(keys, axis=1, return_index=True, return_inverse=True)
        times, rows = ages.ravel()[first], c[who.astype(int)]
        none = np.zeros((times.size, 0))
        return [
            np.zeros(ages.shape) if one is None else one(times, rows, none)[which.reshape(-1)].reshape(ages.shape)
            for one in self._supports
        ]

    @shaped
    def enclosed(
        self, control: Float[Array, "m K"], times: Float[Array, " k"], directions: Float[Array, "k d"]
    ) -> Float[Array, "k 2"]:
        """What `added` is at least and at most, ``(k, 2)``."""
        which, jumps = self.jumps(control)
        total, size = np.zeros((times.size, 2)), np.zeros(times.size)
        ages = np.clip(times[:, None] - self.breakpoints[which], 0.0, None).ravel()
        # a difference of times is rounded, and an integral grows with its length
        last, rows = float(self.breakpoints[-1]), np.repeat(directions, which.size, axis=0)
        around = np.nextafter(ages, 0.0), np.minimum(np.nextafter(ages, np.inf), last)
        for one, change in zip(self._supports, jumps, strict=True):
            if one is None or not change.any():
                continue
            low, high = (one.enclosed(at, rows)[:, side] for side, at in enumerate(around))
            ends = np.stack([low, high], axis=1).reshape(times.size, which.size, 2)
            total += np.einsum("kqe,q->ke", ends, np.maximum(change, 0.0))
            total += np.einsum("kqe,q->ke", ends[..., ::-1], np.minimum(change, 0.0))
            size += np.abs(ends).max(axis=2) @ np.abs(change)
        return np.asarray(total + (rounding(4 * which.size + 8) * size)[:, None] * [-1.0, 1.0])


@final
@dataclass(frozen=True, eq=False)
class ExecutionCellSupport(KnownCellSupport):
    """What errors of execution of a ``control (m, K)`` add to functionals ``rows (r, d)`` over cells of time, in the
    form of `MeasurableCellSupport`; ``lifted`` is the known system."""

    execution: Execution
    control: Array
    rows: Array
    lifted: LiftedSystem

    @shaped
    def at(
        self, times: Float[Array, " k"], ends: Float[Array, "k r 0"]
    ) -> tuple[Float[Array, "k r 1"], Float[Array, "k r"]]:
        """What is added ``(k, r, 1)`` and how far it may be from that, ``(k, r)``; ``ends (k, r, 0)``."""
        return self.between(self.execution.enclosed(self.control, *self.repeated(times)))

    @shaped
    def deviation(self, start: Float[Array, " k"], widths: Float[Array, " k"]) -> Float[Array, "k r"]:
        """Bounds ``(k, r)`` of how far it is from its chord on ``[start, start + width]``, each inside one piece: its
        slope is a sum of ``|c'e^{A s} B_j|`` at the ages of the jumps, of which each changes no faster than
        ``|c'e^{A s} A B_j|``."""
        which, jumps = self.execution.jumps(self.control)
        if not which.size:
            return np.zeros((start.size, self.rows.shape[0]))
        comparison, lifted = self.lifted.comparison, self.lifted
        ages = start[:, None] - self.execution.breakpoints[which]
        begun = ages + widths[:, None] > 0.0  # the others begin after the cell
        ages, width = np.where(begun, np.maximum(ages, 0.0), 0.0).ravel(), np.repeat(widths, which.size)
        rows, drive = self.rows @ lifted.transform, lifted.B[0][:, : jumps.shape[0]]
        slopes = lifted.flown(np.broadcast_to(rows, (ages.size, *rows.shape)), ages)[0] @ lifted.A[0]  # (k q, r, d)
        departure = comparison.over(width).departure
        bent = np.abs(slopes @ drive)  # (k q, r, m)
        norms = block_norms(slopes, lifted.starts)
        for j in range(drive.shape[1]):
            pushed = np.broadcast_to(block_norms(np.abs(drive[:, j]), lifted.starts), (width.size, norms.shape[2]))
            bent[..., j] += np.einsum("nrq,nq->nr", norms, departure.on(pushed))
        total = np.einsum("kqrj,jq,kq->kr", bent.reshape(start.size, which.size, *bent.shape[1:]), np.abs(jumps), begun)
        return np.asarray((widths**2 / 8)[:, None] * total * (1.0 + rounding(16 * (lifted.states + which.size))))

    @property
    def neglected(self) -> Array:
        """Nothing beside what `at` says, ``(r, L)``."""
        return np.zeros((self.rows.shape[0], self.lifted.grid.pieces))

    @property
    def reached(self) -> Array:
        """As in `DisturbanceSupport`, ``(L, q)``."""
        far = self.execution.shares * np.abs(self.control).max(axis=1)
        norms = block_norms(np.abs(self.lifted.B[0][:, : far.size]) @ far, self.lifted.starts)
        reach = self.lifted.comparison.over(self.lifted.grid.breakpoints[1:])
        return reach.integral.on(np.broadcast_to(norms, (self.lifted.grid.pieces, norms.size)))
