"""Effect of errors of execution on the reachable set.

The delivered control differs from the command by at most a share of it, any function of time. The worst such error adds
``sum_jk share_j |u_jk| int |c'e^{A(t-s)} B_j| ds`` to ``c'x(t)``, with the integral over piece ``k`` up to ``t``. The
sum is convex in the command, and 0 where the command is 0.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Self, final

import numpy as np
from scipy.sparse import csr_array

from sparserob_core.control.enclosures.cache import remember
from sparserob_core.control.enclosures.comparison import block_norms
from sparserob_core.control.problem.system import LinearSystem
from sparserob_core.control.reach.measurable import AT_ONCE, KEPT, MeasurableSupport, _propagate_rows, bound_chords
from sparserob_core.control.reach.support import KnownCellSupport, Leg, Support, over_directions
from sparserob_core.control.response.lifted import LiftedSystem
from sparserob_core.control.response.response import Response, unique_rows
from sparserob_core.shapes import Float, shaped
from sparserob_core.sip.convex_set import Array, Box
from sparserob_core.sip.expressions.rounding import rounding
from sparserob_core.sip.expressions.taylor import Combination

# Of the horizon: ages that differ by less are one where nothing is proven. Ten times as much would be seen in a
# violation of 1e-9, a tenth of it is below what the difference of two times rounds to.
ALIKE = 1e-14
STEP = 1e-6  # of the horizon, over which a slope is a difference: a tenth of it shows what integrals are rounded to


@dataclass(frozen=True, eq=False)
class Execution(ABC):
    """Errors of execution: the delivered control may differ from the commanded one by ``shares (m,)`` of it.

    ``breakpoints (K + 1,)`` are those of the command, on which commands may act with a delay. ``scaling (K, K)`` maps a
    command to the values on its pieces of which the shares are taken. ``error_mask (d,)`` is 0
    for states that add up what is commanded, and do nothing else, and 1 for others.
    """

    response: Response
    breakpoints: Array
    shares: Array
    error_mask: Array
    scaling: csr_array

    def over(self, control: Array, rows: Array, leg: Leg, joined: Combination | None = None) -> Support:
        """Return the support of the worst errors of a control on functionals over cells of time.

        Parameters
        ----------
        control : Array
            Command ``(m, K)``.
        rows : Array
            Functionals ``(r, d)``.
        leg : Leg
            The system, or a phase of a switched system.
        joined : Combination, optional
            How the rows make up one direction that varies over a cell; without it each row is a functional.

        Returns
        -------
        Support
            Support of the errors.
        """
        return over_directions(lambda functionals: self.on_functionals(control, functionals, leg), rows, leg, joined)

    @abstractmethod
    def on_functionals(self, control: Array, rows: Array, leg: Leg) -> Support:
        """Return the support of `over` on functionals ``(r, d)``, each of which is the same on the whole cell."""

    @abstractmethod
    def unit_errors(self, times: Array, directions: Array) -> Array:
        """Return the largest contribution of errors to ``c'x(t)`` for size 1 of each entry of `acts`,
        ``(k, m, late + K)``, at ``times (k,)`` in ``directions``. It is not enclosed."""

    @abstractmethod
    def enclosed(self, control: Array, times: Array, directions: Array) -> Array:
        """Return lower and upper bounds of `added`, ``(k, 2)``."""

    def extend_directions(self, directions: Array, parameters: Array) -> Array:
        """Return directions ``(k, d)`` at parameters ``(k, nu)`` as directions on the states along which errors are
        followed."""
        return directions

    def none(self) -> Self:
        """Return the execution without errors: the control is delivered as it is commanded."""
        return replace(self, shares=np.zeros(self.shares.size))

    @shaped
    def lengths(self, times: Float[Array, " k"], directions: Float[Array, "k d"]) -> Float[Array, "k n"]:
        """Return the largest contribution of errors to ``c'x(t)`` for a command of size 1, on every piece of every
        channel.

        The result ``(k, m K)`` is ordered channel by channel. It is not enclosed.
        """
        return self.unit_errors(times, directions)[:, :, self.late :].reshape(times.size, self.size)

    @shaped
    def added(
        self, control: Float[Array, "m K"], times: Float[Array, " k"], directions: Float[Array, "k d"]
    ) -> Float[Array, " k"]:
        """Return the largest contribution ``(k,)`` of errors of a command to ``c'x(t)``, at ``times (k,)`` in
        ``directions (k, d)``: the middle of its bounds."""
        return np.asarray(self.enclosed(control, times, directions).mean(axis=1))

    def sampled(self, control: Array, times: Array, directions: Array) -> Array:
        """`added` at times and directions that are asked for again and again: where these are not too many, from the
        errors of commands of size 1, which are remembered."""
        if times.size * self.size > AT_ONCE:
            return self.added(control, times, directions)
        key = times.tobytes() + directions.tobytes()
        if key not in self._cached_errors:
            remember(self._cached_errors, key, self.unit_errors(times, directions).reshape(times.size, -1), KEPT)
        return np.asarray(self._cached_errors[key] @ self.acts(control).ravel())

    @cached_property
    def _cached_errors(self) -> dict[bytes, Array]:
        return {}

    def given(self, times: Array, directions: Array) -> Array:
        """Return the contribution ``(k,)`` to ``c'x(t)`` of errors of the control before the first piece, where
        commands act late."""
        if not self.late:
            return np.zeros(times.size)
        return self.added(np.zeros((self.shares.size, self.breakpoints.size - 1)), times, directions)

    @shaped
    def slope(
        self, control: Float[Array, "m K"], times: Float[Array, " k"], directions: Float[Array, "k d"]
    ) -> Float[Array, " k"]:
        """Return the derivative ``(k,)`` of `added` in the time, from the left, as a difference over a little time;
        nothing is proven by it."""
        before = np.maximum(times - STEP * float(self.breakpoints[-1]), 0.0)
        now, then = (self.added(control, at, directions) for at in (times, before))
        return np.asarray((now - then) / np.where(times > before, times - before, 1.0))

    @property
    def late(self) -> int:
        """Number of inputs before the first piece of the command: 1 where commands act with a delay, else 0."""
        return int(self.response.grid.before is not None)

    def acts(self, control: Array) -> Array:
        """Return the absolute value of all that acts, ``(m, late + K)``, for a command ``(m, K)``."""
        size, before = self.sizes(control), self.response.grid.before
        return size if before is None or not self.late else np.column_stack([np.abs(before), size])

    def sizes(self, control: Array) -> Array:
        """Return the absolute values ``(m, K)`` of which the shares of a command ``(m, K)`` are taken."""
        return np.asarray(np.abs(control @ self.scaling))

    def deviations(self, control: Array) -> Array:
        """Return the largest errors ``(m, L)`` of a command ``(m, K)`` on the pieces of the grid."""
        acting = self.response.grid.control_piece + self.late
        return np.asarray(self.shares[:, None] * self.acts(control)[:, acting])

    @property
    def size(self) -> int:
        """Number ``m K`` of absolute values, one for every channel and piece."""
        return int(self.shares.size * (self.breakpoints.size - 1))


@final
@dataclass(frozen=True, eq=False)
class ConstantExecution(Execution):
    """`Execution` of a known constant system: errors depend on the age of a command alone."""

    def on_functionals(self, control: Array, rows: Array, leg: Leg) -> ExecutionCellSupport:
        """`Execution.on_functionals`."""
        assert isinstance(leg, LiftedSystem)
        return ExecutionCellSupport(self, control, rows, leg)

    @cached_property
    def begins(self) -> Array:
        """Times ``(late + K + 1,)`` at which what acts changes, on the grid of the response; the horizon for pieces
        that would act after it."""
        grid = self.response.grid
        first = np.searchsorted(grid.control_piece, np.arange(-self.late, self.breakpoints.size - 1))
        return np.append(grid.breakpoints[first], grid.breakpoints[-1])

    @cached_property
    def matrices(self) -> tuple[Array, Array]:
        """``A (d, d)``, ``B (d, m)``."""
        A, B, _ = self.response.system.modes[0].matrices(np.zeros((1, 0)))
        return A[0], self.error_mask[:, None] * B[0][:, : self.shares.size]

    @cached_property
    def _supports(self) -> list[MeasurableSupport | None]:
        """``int_0^t |c'e^{A s} B_j| ds`` of every channel, ``None`` where it is delivered as it is commanded."""
        A, B = self.matrices
        unit, grid, start = Box([-1.0], [1.0]), self.response.grid, self.response.initial_state
        responses = [Response(LinearSystem(A, B, B[:, [j]]), grid, start) for j in range(self.shares.size)]
        return [
            MeasurableSupport(response, unit) if s > 0.0 else None
            for response, s in zip(responses, self.shares, strict=True)
        ]

    @shaped
    def unit_errors(self, times: Float[Array, " k"], directions: Float[Array, "k d"]) -> Float[Array, "k m n"]:
        """Return `Execution.unit_errors`, from integrals up to ages; ages that differ by less than the share `ALIKE` of
        the horizon are one."""
        ages = np.clip(times[:, None] - self.begins, 0.0, None)
        c, owner = unique_rows(directions)
        rounded, age_indices = np.unique(np.rint(ages / (ALIKE * self.breakpoints[-1])), return_inverse=True)
        numbers = owner[:, None] * rounded.size + age_indices.reshape(ages.shape)
        pairs, first, pair_indices = np.unique(numbers, return_index=True, return_inverse=True)
        distinct_ages, rows, nothing = ages.ravel()[first], c[pairs // rounded.size], np.zeros((pairs.size, 0))
        contributions = np.zeros((times.size, self.shares.size, self.begins.size - 1))
        for j, support in enumerate(self._supports):
            if support is not None:
                integrals = support(distinct_ages, rows, nothing)[pair_indices.reshape(ages.shape)]
                contributions[:, j] = self.shares[j] * np.maximum(integrals[:, :-1] - integrals[:, 1:], 0.0)
        return contributions

    @shaped
    def slope(
        self, control: Float[Array, "m K"], times: Float[Array, " k"], directions: Float[Array, "k d"]
    ) -> Float[Array, " k"]:
        """Return `Execution.slope` in closed form."""
        (A, B), (pieces, jumps) = self.matrices, self.jumps(control)
        ages = times[:, None] - self.begins[pieces]
        impulse_responses = _propagate_rows(A, directions, ages) @ B
        return np.asarray(np.einsum("kqm,mq,kq->k", np.abs(impulse_responses), jumps, ages > 0.0))

    @shaped
    def jumps(self, control: Float[Array, "m K"]) -> tuple[np.ndarray, Float[Array, "m q"]]:
        """The entries ``(q,)`` of `acts` with which the size of the largest error changes, and by how much, ``(m, q)``:
        by parts, ``sum_k r_k int_k = sum_k (r_k - r_{k-1}) int_{t_k}^t``, of which a sparse control needs few."""
        jumps = np.diff(self.shares[:, None] * self.acts(control), axis=1, prepend=0.0)
        pieces = np.flatnonzero(jumps.any(axis=0))
        return pieces, jumps[:, pieces]

    @shaped
    def enclosed(
        self, control: Float[Array, "m K"], times: Float[Array, " k"], directions: Float[Array, "k d"]
    ) -> Float[Array, "k 2"]:
        """`Execution.enclosed`."""
        pieces, jumps = self.jumps(control)
        total, size = np.zeros((times.size, 2)), np.zeros(times.size)
        ages = np.clip(times[:, None] - self.begins[pieces], 0.0, None).ravel()
        # sums and differences of times are rounded, and an integral grows with its length
        last, rows = float(self.breakpoints[-1]), np.repeat(directions, pieces.size, axis=0)
        room = 2.0 * np.spacing(last)
        age_bounds = np.maximum(ages - room, 0.0), np.minimum(ages + room, last)
        for support, change in zip(self._supports, jumps, strict=True):
            if support is None or not change.any():
                continue
            low, high = (support.enclosed(age_bound, rows)[:, side] for side, age_bound in enumerate(age_bounds))
            ends = np.stack([low, high], axis=1).reshape(times.size, pieces.size, 2)
            total += np.einsum("kqe,q->ke", ends, np.maximum(change, 0.0))
            total += np.einsum("kqe,q->ke", ends[..., ::-1], np.minimum(change, 0.0))
            size += np.abs(ends).max(axis=2) @ np.abs(change)
        return np.asarray(total + (rounding(4 * pieces.size + 8) * size)[:, None] * [-1.0, 1.0])


@final
@dataclass(frozen=True, eq=False)
class ExecutionCellSupport(KnownCellSupport):
    """The support of errors of execution of a ``control (m, K)`` on functionals ``rows (r, d)`` over cells of time.

    The form is that of `MeasurableCellSupport`; ``lifted`` is the known system.
    """

    execution: ConstantExecution
    control: Array
    rows: Array
    lifted: LiftedSystem

    @shaped
    def at(
        self, times: Float[Array, " k"], ends: Float[Array, "k r 0"]
    ) -> tuple[Float[Array, "k r 1"], Float[Array, "k r"]]:
        """Return support values ``(k, r, 1)`` and their error bounds ``(k, r)``; ``ends (k, r, 0)`` is empty."""
        return self.between(self.execution.enclosed(self.control, *self.repeated(times)))

    @shaped
    def deviation(self, start: Float[Array, " k"], widths: Float[Array, " k"]) -> Float[Array, "k r"]:
        """Return bounds ``(k, r)`` of the distance of the support function from its chord on
        ``[start, start + width]``.

        Each interval is inside one piece. The support function is a sum of integrals up to the ages of the jumps.
        """
        pieces, jumps = self.execution.jumps(self.control)
        if not pieces.size:
            return np.zeros((start.size, self.rows.shape[0]))
        lifted, sizes = self.lifted, np.tile(np.abs(jumps).T, (start.size, 1))  # (k q, m)
        ages, drive = start[:, None] - self.execution.begins[pieces], lifted.B[0][:, : jumps.shape[0]]
        is_active = ages + widths[:, None] > 0.0  # the others begin after the cell
        bounds = bound_chords(
            lifted,
            self.rows @ lifted.transform,
            np.where(is_active, np.maximum(ages, 0.0), 0.0).ravel(),
            np.repeat(widths, pieces.size),
            block_norms(sizes @ np.abs(drive).T, lifted.starts),
            lambda slopes: np.einsum("nrm,nm->nr", np.abs(slopes @ drive), sizes),
        )
        total = (bounds.reshape(start.size, pieces.size, -1) * is_active[..., None]).sum(axis=1)
        return np.asarray(total * (1.0 + rounding(16 * (lifted.states + pieces.size))))

    @property
    def neglected(self) -> Array:
        """Zeros ``(r, L)``, since the error bounds of `at` contain all errors."""
        return np.zeros((self.rows.shape[0], self.lifted.grid.pieces))

    @property
    def effect_bounds(self) -> Array:
        """Norm bounds ``(L, q)`` of the effect of the errors on every block of the coordinates until the end of every
        piece."""
        error_sizes = self.execution.shares * self.execution.acts(self.control).max(axis=1)
        norms = block_norms(np.abs(self.lifted.B[0][:, : error_sizes.size]) @ error_sizes, self.lifted.starts)
        reach = self.lifted.comparison.over(self.lifted.grid.breakpoints[1:])
        return reach.integral.on(np.broadcast_to(norms, (self.lifted.grid.pieces, norms.size)))
