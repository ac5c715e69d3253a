"""Errors of execution of a known system that changes with time.

``sum_jk share_j |u_jk| int |c'Phi(t, s) B_j(s)| ds``: on every piece between two marks ``Phi(end, s) B(s)`` is a
polynomial but for a remainder (`Expansion.kernel`), and what the time after it makes of its end is a row. In the time
``t`` each integrand obeys the equation of the state, so that the sum is nowhere further above its chord than that says.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from functools import cached_property
from typing import TYPE_CHECKING, final

import numpy as np

from sparserob_core.control.enclosures.cache import remember
from sparserob_core.control.enclosures.comparison import product
from sparserob_core.control.enclosures.matrix_exponential import rounding
from sparserob_core.control.response.initial_support import Support
from sparserob_core.control.response.measurable import (
    ACCURACY,
    HALVINGS,
    TINY,
    Execution,
    KnownCellSupport,
    integrated,
)
from sparserob_core.control.response.varying.expansion import Kernel
from sparserob_core.control.response.varying_motion import OUTWARD, VaryingMotion
from sparserob_core.shapes import Float, shaped
from sparserob_core.sip.convex_set import Array, Box

if TYPE_CHECKING:
    from sparserob_core.control.response.lifted import LiftedSystem

AT_ONCE = 4_000_000  # numbers of polynomials, or of remembered lengths, that are made at once (32 MB)
KEPT = 8  # tables of lengths at sampled times, one for each constraint
UNIT = Box([-1.0], [1.0])
STEP = 1e-6  # of the horizon, over which a slope is a difference: a tenth of it shows what integrals are rounded to


@final
@dataclass(frozen=True, eq=False)
class VaryingExecution(Execution):
    """`Execution` of a system that changes with time."""

    _lengths: dict[bytes, Array] = field(default_factory=dict, repr=False)

    def over(self, control: Array, rows: Array, leg: LiftedSystem | VaryingMotion) -> Support:
        """`Execution.over`."""
        assert isinstance(leg, VaryingMotion)
        return VaryingExecutionCellSupport(self, control, rows, leg)

    @cached_property
    def motion(self) -> VaryingMotion:
        """That of the response."""
        return VaryingMotion(self.response.propagator, self.response.initial_state)

    @cached_property
    def kernel(self) -> Kernel:
        """Of the pieces between all marks."""
        marks = self.motion.grid.breakpoints
        return self.motion.expansion.kernel(marks[:-1], marks[1:])

    @shaped
    def lengths(self, times: Float[Array, " k"], directions: Float[Array, "k d"]) -> Float[Array, "k n"]:
        """`Execution.lengths`."""
        every = np.ones((self.shares.size, self.breakpoints.size - 1), dtype=bool)
        return np.asarray(self._over_pieces(times, directions, every).mean(axis=3).reshape(times.size, -1))

    @shaped
    def added(
        self, control: Float[Array, "m K"], times: Float[Array, " k"], directions: Float[Array, "k d"]
    ) -> Float[Array, " k"]:
        """`Execution.added`."""
        return np.asarray(self._summed(control, times, directions).mean(axis=1))

    def sampled(self, control: Array, times: Array, directions: Array) -> Array:
        """`Execution.sampled`: where that is not too much, from the lengths, which are the same for every control."""
        if times.size * self.size > AT_ONCE:
            return self.added(control, times, directions)
        key = times.tobytes() + directions.tobytes()
        if key not in self._lengths:
            remember(self._lengths, key, self.lengths(times, directions), KEPT)
        return np.asarray(self._lengths[key] @ np.abs(control).ravel())

    @shaped
    def slope(
        self, control: Float[Array, "m K"], times: Float[Array, " k"], directions: Float[Array, "k d"]
    ) -> Float[Array, " k"]:
        """`Execution.slope`, as a difference over a little time before; nothing is proven by it."""
        before = np.maximum(times - STEP * float(self.breakpoints[-1]), 0.0)
        now, then = (self.added(control, at, directions) for at in (times, before))
        return np.asarray((now - then) / np.where(times > before, times - before, 1.0))

    @shaped
    def enclosed(
        self, control: Float[Array, "m K"], times: Float[Array, " k"], directions: Float[Array, "k d"]
    ) -> Float[Array, "k 2"]:
        """`Execution.enclosed`, but for what transitions are off by."""
        bounds = self._summed(control, times, directions)
        lost = rounding(self.size + 8) * np.abs(bounds).max(axis=1)
        return np.asarray(bounds + lost[:, None] * [-1.0, 1.0])

    def _summed(self, control: Array, times: Array, directions: Array) -> Array:
        """What errors of a control add, between two bounds, ``(k, 2)``."""
        size = np.abs(control)
        bounds: Array = self._over_pieces(times, directions, np.asarray(size > 0.0))
        return np.asarray(np.einsum("kjpe,jp->ke", bounds, size))

    def _over_pieces(self, times: Array, directions: Array, wanted: np.ndarray) -> Array:
        """Bounds of ``share_j int |c'Phi(t, s) B_j(s)| ds`` over every piece of the command, ``(k, m, K, 2)``; 0 for
        pieces that are not ``wanted (m, K)``."""
        found = np.zeros((times.size, self.shares.size, self.breakpoints.size - 1, 2))
        asked = np.logical_and(wanted, self.shares[:, None] > 0.0)
        acting = self.motion.grid.control_piece
        pieces = np.flatnonzero(asked[:, acting].any(axis=0))
        if not pieces.size or not times.size:
            return found
        each = max(1, AT_ONCE // (pieces.size * self.kernel.terms[0].size + acting.size * directions.shape[1]))
        for begin in range(0, times.size, each):
            part = slice(begin, begin + each)
            for who, piece, bounds in self._bounds(times[part], directions[part], pieces, asked):
                np.add.at(found.swapaxes(1, 2), (begin + who, acting[piece]), bounds)
        return found

    def _bounds(
        self, times: Array, directions: Array, pieces: np.ndarray, asked: np.ndarray
    ) -> Iterator[tuple[np.ndarray, np.ndarray, Array]]:
        """Of ``times (k,)`` and ``pieces`` between marks that begin before them: the numbers of both, ``(q,)``, and the
        bounds ``(q, m, 2)``; of pieces that are over by then, and of those that are not."""
        motion, grid = self.motion, self.motion.grid
        steps = motion.flow.state
        place = np.clip(np.searchsorted(grid.breakpoints, times, side="left") - 1, 0, grid.pieces - 1)
        distinct, where = np.unique(np.stack([times, grid.breakpoints[place]]), axis=1, return_inverse=True)
        until, where = np.maximum(*distinct), where.reshape(-1)
        begun = motion.expansion.flow(distinct[1], until).state
        row, rows = np.zeros(directions.shape), np.empty((times.size, *directions.shape[1:], grid.pieces))
        first = np.einsum("ki,kij->kj", directions, begun[where])
        for k in range(int(place.max()) - 1, int(pieces[0]) - 1, -1):  # rows on the end of every piece
            row = np.where((place == k + 1)[:, None], first, row)
            rows[:, :, k] = row
            row = row @ steps[k]
        who, which = np.nonzero(pieces < place[:, None])
        piece = pieces[which]
        yield who, piece, self._along(self.kernel, piece, rows[who, :, piece], asked[:, grid.control_piece[piece]])
        here = np.flatnonzero(np.isin(place, pieces) & np.greater(times, grid.breakpoints[place]))
        kernel = motion.expansion.kernel(distinct[1], until)
        piece = place[here]
        yield here, piece, self._along(kernel, where[here], directions[here], asked[:, grid.control_piece[piece]])

    def _along(self, kernel: Kernel, which: np.ndarray, rows: Array, asked: np.ndarray) -> Array:
        """Bounds ``(q, m, 2)`` of what intervals ``which (q,)`` of a kernel make of ``rows (q, d)`` on their ends, of
        channels that are ``asked (m, q)``."""
        m, units = self.shares.size, self.motion.expansion.units
        sizes = np.einsum("qd,qdm->qm", np.abs(rows), np.abs(kernel.terms[..., :m]).sum(axis=1)[which])
        lost = (np.abs(rows) @ units * kernel.error[which])[:, None] * kernel.sizes[which, :m]
        lost = lost + rounding(rows.shape[1] + 2 * kernel.terms.shape[1] + HALVINGS) * sizes
        bounds = np.zeros((which.size, m, 2))
        for j, share in enumerate(self.shares):
            mine = np.flatnonzero(asked[j])
            terms = np.einsum("qd,qpd->qp", rows[mine], kernel.terms[which[mine], :, :, j])[..., None]
            accuracy = np.maximum(ACCURACY * self.motion.grid.pieces * sizes[mine, j], TINY)
            found = integrated(UNIT, terms, np.ones(mine.size), accuracy)
            found = found + lost[mine, j, None] * [-1.0, 1.0]
            bounds[mine, j] = share * np.maximum(found, 0.0) * [1.0 / OUTWARD, OUTWARD]
        return bounds


@final
@dataclass(frozen=True, eq=False)
class VaryingExecutionCellSupport(KnownCellSupport):
    """`ExecutionCellSupport` of a system that changes with time; ``motion`` is its."""

    execution: VaryingExecution
    control: Array
    rows: Array
    motion: VaryingMotion

    @shaped
    def at(
        self, times: Float[Array, " k"], ends: Float[Array, "k r 0"]
    ) -> tuple[Float[Array, "k r 1"], Float[Array, "k r"]]:
        """What is added ``(k, r, 1)`` and how far it may be from that, ``(k, r)``; ``ends (k, r, 0)``."""
        return self.between(self.execution.enclosed(self.control, *self.repeated(times)))

    @shaped
    def deviation(self, start: Float[Array, " k"], widths: Float[Array, " k"]) -> Float[Array, "k r"]:
        """Bounds ``(k, r)`` of how far it is above its chord on ``[start, start + width]``, each inside one piece.

        With ``g(t, s) = c'Phi(t, s) B(s)`` the second derivative of the integral of ``|g|`` up to ``t`` is at least
        ``-|c'B'| - |c'A B| - int |g_tt| ds``, and ``g_tt = c'(A' + A^2) Phi B``: where ``g`` changes its sign the slope
        jumps upwards only. All of it is bounded at the start, and how much it changes within the cell.
        """
        motion, d, m = self.motion, self.motion.states, self.execution.shares.size
        pieces = np.minimum(motion.place(start), motion.origin.size - 1)
        (law, slope), width = motion.law(start, pieces), widths[:, None]
        most, second, third = (one[pieces][:, :, : d + m] for one in (motion.most, motion.second, motion.third))
        begun, pushed = self._sizes(start), self._sizing[pieces]
        exact = np.abs(self.rows @ (slope[:, :, :d] + law[:, :, :d] @ law[:, :, :d]))
        now = np.abs(self.rows @ slope[:, :, d : d + m]) + np.abs(self.rows @ law[:, :, :d] @ law[:, :, d : d + m])
        entered = width * np.einsum("kim,km->ki", most[:, :, d:], pushed)
        grown = motion.grown(pieces, widths, begun + entered)
        turned = np.einsum("kij,kj->ki", third[:, :, :d], grown) + np.einsum("kim,km->ki", third[:, :, d:], pushed)
        turned = width * turned + np.einsum("kij,kj->ki", second[:, :, :d], entered)
        rounded = np.einsum("kij,kj->ki", second[:, :, :d], begun) + np.einsum("kim,km->ki", second[:, :, d:], pushed)
        turned = turned + rounding(2 * motion.terms) * rounded
        along = np.einsum("krj,kj->kr", exact, begun) + np.einsum("krm,km->kr", now, pushed)
        return np.asarray(width**2 / 8 * (along + turned @ np.abs(self.rows).T) * OUTWARD)

    @cached_property
    def neglected(self) -> Array:
        """What is off in the transitions, on every piece: ``(r, K)``."""
        motion, m = self.motion, self.execution.shares.size
        total = motion.left_out(self._at_marks[:-1], motion.flow.sizes[:, :m] * self._sizing)
        return product(np.abs(self.rows), total.T)

    @cached_property
    def reached(self) -> Array:
        """As in `VaryingSupport`, ``(K, d)``."""
        motion, m, lengths = self.motion, self.execution.shares.size, self.motion.grid.lengths
        entered = np.einsum("kim,km->ki", motion.most[:, :, motion.states : motion.states + m], self._sizing)
        return motion.grown(motion.every, lengths, self._at_marks[:-1] + lengths[:, None] * entered)

    @cached_property
    def _sizing(self) -> Array:
        """How large errors may be on every piece between marks, ``(K, m)``."""
        size = self.execution.shares[:, None] * np.abs(self.control)
        return np.asarray(size[:, self.motion.grid.control_piece].T * OUTWARD)

    @cached_property
    def _at_marks(self) -> Array:
        return self._sizes(self.motion.grid.breakpoints)

    def _sizes(self, times: Array) -> Array:
        """What errors can have made of every state, ``(k, d)``, at most."""
        d = self.motion.states
        every = np.repeat(times, d), np.tile(np.eye(d), (times.size, 1))
        return np.asarray(self.execution.enclosed(self.control, *every)[:, 1].reshape(-1, d) * OUTWARD)
