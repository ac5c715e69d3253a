"""`Execution` of systems that change with time: ``c'Phi(t, s) B_j(s)`` takes the place of ``c'e^{A(t-s)} B_j``.

On every piece between two marks ``Phi(end, s) B(s)`` is a polynomial with a remainder (`Expansion.kernel`), and the
propagation from its end to ``t`` enters as the row ``c'Phi(t, end)``. In the time ``t`` each integrand obeys the
equation of the state. This bounds how far the sum is above its chord.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import NamedTuple, final

import numpy as np
from scipy.sparse import csr_array

from sparserob_core.control.enclosures.cache import remember
from sparserob_core.control.enclosures.comparison import product
from sparserob_core.control.enclosures.polynomial import distinct_patterns
from sparserob_core.control.reach.execution import ConstantExecution, Execution
from sparserob_core.control.reach.measurable import ACCURACY, AT_ONCE, KEPT, TINY
from sparserob_core.control.reach.support import (
    Leg,
    Support,
    _list_corners,
    between_corners,
)
from sparserob_core.control.reach.varying_motion import (
    OUTWARD,
    SpreadMotion,
    VaryingMotion,
)
from sparserob_core.control.response.lifted import LiftedSystem
from sparserob_core.control.response.response import Propagator, Response, unique_rows
from sparserob_core.control.response.varying.expansion import Kernel
from sparserob_core.control.sets.integrals import (
    CUTS_PER_INTERVAL,
    INTERVAL_HALVINGS,
    enclose_absolute_integrals,
    enclose_integrals,
)
from sparserob_core.shapes import Float, shaped
from sparserob_core.sip.convex_set import Array, ConvexSet
from sparserob_core.sip.expressions.rounding import rounding
from sparserob_core.sip.expressions.taylor import Combination

POINTS_KEPT = 256  # parameters whose errors are remembered: twice the points of a lattice of parameters
CELLS_KEPT = 16  # cells of parameters whose errors are: those of all rows of a few constraints


class Integrands(NamedTuple):
    """Integrands of errors through ``m`` columns on intervals, as polynomials in the share that remains of an interval.

    ``terms (..., p + 1, m)``: the coefficients. ``sizes (..., m)``: sums of the absolute numbers that are added up to
    them. ``errors (..., m)``: error bounds of the integrals.
    """

    terms: Array
    sizes: Array
    errors: Array

    def chosen(self, mask: np.ndarray) -> Integrands:
        """Return the integrands of the intervals in a mask, one after another."""
        return Integrands(self.terms[mask], self.sizes[mask], self.errors[mask])


class InputKernel(NamedTuple):
    """`Kernel` of ``m`` columns of inputs on ``k`` intervals, as matrices by which rows are multiplied.

    ``terms (k, d, (p + 1) m)``: the coefficients. ``sizes (k, d, m)``: the sums of their absolute values. ``errors
    (k, d, m)``: error bounds of the entries.
    """

    terms: Array
    sizes: Array
    errors: Array

    @staticmethod
    def of(kernel: Kernel, columns: np.ndarray, units: Array) -> InputKernel:
        """Return a kernel for inputs through some columns; ``units (d,)`` are those of its errors."""
        terms = np.moveaxis(kernel.terms[..., columns], 1, 2)  # (k, d, p + 1, m)
        errors = kernel.sizes[..., columns] * units[:, None] * kernel.error[:, None, None]
        return InputKernel(terms.reshape(*terms.shape[:2], -1), np.abs(terms).sum(axis=2), errors)

    def along(self, which: np.ndarray, rows: Array) -> Integrands:
        """Return the integrands along rows ``(q, n, d)`` at the ends of intervals ``which (q,)``."""
        terms, sizes, m = rows @ self.terms[which], np.abs(rows), self.sizes.shape[2]
        shape = (*rows.shape[:2], self.terms.shape[2] // m, m)
        return Integrands(terms.reshape(shape), sizes @ self.sizes[which], sizes @ self.errors[which])


@final
@dataclass(frozen=True, eq=False)
class VaryingExecution(Execution):
    """`Execution` of a system that changes with time.

    ``disturbing``: one command for all times enters through ``E``, as the disturbances of a `VaryingMeasurable` do.
    ``bound``: a set of the inputs through the columns ``through (m,)`` of
    ``E`` together, in the place of separate channels. Then there is one share of 1, and integrals are those of the
    support function of the set.
    """

    disturbing: bool = False
    bound: ConvexSet | None = None
    through: np.ndarray | None = None
    _transitions: dict[bytes, tuple[Array, InputKernel]] = field(default_factory=dict, repr=False)

    def following(self, propagator: Propagator, initial_state: Array) -> VaryingExecution:
        """Return the errors along states ``(d,)`` or their coefficients ``(M d,)``, that a propagator moves."""
        response = Response(propagator.system, propagator.grid, initial_state, shared=propagator)
        error_mask = np.tile(self.error_mask, initial_state.size // self.error_mask.size)
        return replace(self, response=response, error_mask=error_mask, _transitions={})

    def on_functionals(self, control: Array, rows: Array, leg: Leg) -> VaryingExecutionSupport:
        """`Execution.on_functionals`."""
        assert not isinstance(leg, LiftedSystem)
        return VaryingExecutionSupport(self.bound_states(control, leg.motion), rows, leg)

    def bound_states(self, control: Array, motion: VaryingMotion) -> StateErrors:
        """Return the errors of a ``control (m, K)`` in all coefficients of the state of a ``motion``; the result is
        remembered for all functionals."""
        key = control.tobytes() + id(motion).to_bytes(8)
        if key not in self._state_errors:
            remember(self._state_errors, key, StateErrors(self, control, motion), KEPT)
        return self._state_errors[key]

    @cached_property
    def _state_errors(self) -> dict[bytes, StateErrors]:
        return {}

    @cached_property
    def motion(self) -> VaryingMotion:
        """The motion of the response, over all times from its initial state."""
        return VaryingMotion(self.response.propagator, self.response.initial_state)

    @cached_property
    def columns(self) -> np.ndarray:
        """The columns of ``[B E]`` through which errors enter."""
        first = self.motion.expansion.channels[0] if self.disturbing else 0
        return first + (np.arange(self.error_radii.size) if self.through is None else self.through)

    @cached_property
    def error_radii(self) -> Array:
        """Bounds ``(m,)`` of the absolute value of the error through each column, where the command is 1."""
        if self.bound is None:
            return self.shares
        box = self.bound.bounding_box()
        return np.asarray(np.maximum(np.abs(box.lower), np.abs(box.upper)) * OUTWARD)

    @cached_property
    def around(self) -> VaryingExecution:
        """The errors of the box around the set, where there is one."""
        if self.bound is None:
            return self
        return replace(self, shares=self.error_radii, bound=None)

    @cached_property
    def acting(self) -> np.ndarray:
        """The column of `acts` that acts on every piece between marks, ``(L,)``.

        With a delay, column 0 is the control before the first piece of the command; the pieces of the command follow.
        """
        grid = self.motion.grid
        return np.zeros(grid.pieces, dtype=int) if self.disturbing else np.asarray(grid.control_piece + self.late)

    @property
    def late(self) -> int:
        """Number of inputs before the first piece of the command: 1 where commands act with a delay, else 0."""
        return 0 if self.disturbing else super().late

    @cached_property
    def kernel(self) -> InputKernel:
        """Kernel of the pieces between all marks."""
        marks = self.motion.grid.breakpoints
        return self._compute_kernel(marks[:-1], marks[1:])

    @shaped
    def unit_errors(self, times: Float[Array, " k"], directions: Float[Array, "k d"]) -> Float[Array, "k m n"]:
        """Return `Execution.unit_errors`: the middle of the bounds."""
        wanted = np.ones((self.shares.size, self.late + self.breakpoints.size - 1), dtype=bool)
        return np.asarray(self._bound_integrals(times, directions, wanted).mean(axis=3))

    @shaped
    def enclosed(
        self, control: Float[Array, "m K"], times: Float[Array, " k"], directions: Float[Array, "k d"]
    ) -> Float[Array, "k 2"]:
        """Return `Execution.enclosed`, without the error of the transitions."""
        size = self.acts(control)
        bounds = np.einsum("kjpe,jp->ke", self._bound_integrals(times, directions, np.asarray(size > 0.0)), size)
        rounding_errors = rounding(self.size + 8) * np.abs(bounds).max(axis=1)
        return np.asarray(bounds + rounding_errors[:, None] * [-1.0, 1.0])

    def _bound_integrals(self, times: Array, directions: Array, wanted: np.ndarray) -> Array:
        """Return bounds of ``share_j int |c'Phi(t, s) B_j(s)| ds`` for each entry of `acts`, ``(k, m, late + K, 2)``.

        The transitions are those that are computed. Entries that are not ``wanted (m, late + K)`` have 0.
        """
        contributions = np.zeros((times.size, *wanted.shape, 2))
        is_active = np.logical_and(wanted, self.shares[:, None] > 0.0)
        acting = self.acting
        pieces = np.flatnonzero(is_active[:, acting].any(axis=0))
        if not pieces.size or not times.size:
            return contributions
        directions = directions * self.error_mask
        (_, d, numbers), count = self.kernel.terms.shape, self.motion.grid.pieces
        chunk_size = max(1, AT_ONCE // (count * (numbers + d) + numbers * d))
        for begin in range(0, times.size, chunk_size):
            chunk = slice(begin, begin + chunk_size)
            for time_indices, piece, integrands in self._build_integrands(times[chunk], directions[chunk], pieces):
                bounds = self._bound_errors(integrands, is_active[:, acting[piece]])
                np.add.at(contributions.swapaxes(1, 2), (begin + time_indices, acting[piece]), bounds)
        return contributions

    def _build_integrands(
        self, times: Array, directions: Array, pieces: np.ndarray
    ) -> Iterator[tuple[np.ndarray, np.ndarray, Integrands]]:
        """Yield the integrands on ``pieces`` between marks, for every one of ``times (k,)`` after their beginning.

        Each item has the indices ``(q,)`` of the times, the pieces ``(q,)``, and the integrands. The first item is for
        pieces that have ended at their time, the second for pieces that have not.
        """
        motion, grid = self.motion, self.motion.grid
        steps = motion.flow.state
        last_pieces = np.clip(np.searchsorted(grid.breakpoints, times, side="left") - 1, 0, grid.pieces - 1)
        distinct, distinct_indices = np.unique(
            np.stack([times, grid.breakpoints[last_pieces]]), axis=1, return_inverse=True
        )
        distinct_indices = distinct_indices.reshape(-1)
        transitions, kernel = self._compute_transitions(distinct)
        row, rows = np.zeros(directions.shape), np.empty((grid.pieces, *directions.shape))
        first = (directions[:, None] @ transitions[distinct_indices])[:, 0]
        for k in range(int(last_pieces.max()) - 1, int(pieces[0]) - 1, -1):  # rows on the end of every piece
            row = np.where((last_pieces == k + 1)[:, None], first, row)
            rows[k] = row
            row = row @ steps[k]
        ended = pieces[pieces < last_pieces.max()]
        has_ended = ended[:, None] < last_pieces
        positions, indices = np.nonzero(has_ended)
        yield indices, ended[positions], self.kernel.along(ended, rows[ended]).chosen(has_ended)
        inside = np.flatnonzero(np.isin(last_pieces, pieces) & np.greater(times, grid.breakpoints[last_pieces]))
        integrands = kernel.along(distinct_indices[inside], directions[inside, None])
        yield inside, last_pieces[inside], integrands.chosen(np.ones((inside.size, 1), dtype=bool))

    def _compute_transitions(self, distinct: Array) -> tuple[Array, InputKernel]:
        """Return the transitions ``(k, d, d)`` from the breakpoint before each time to the time, and the kernel between
        them.

        ``distinct (2, k)`` holds the times and the breakpoints before them. The result is remembered, since the same
        times are asked for in many directions.
        """
        key = distinct.tobytes()
        if key not in self._transitions:
            until = np.maximum(*distinct)
            entry = self.motion.expansion.flow(distinct[1], until).state, self._compute_kernel(distinct[1], until)
            remember(self._transitions, key, entry, max(1, AT_ONCE // (entry[0].size + entry[1].terms.size)))
        return self._transitions[key]

    def _compute_kernel(self, starts: Array, stops: Array) -> InputKernel:
        """Return the kernel of intervals ``(k,)`` within one segment each, of the columns through which errors
        enter."""
        expansion = self.motion.expansion
        return InputKernel.of(expansion.kernel(starts, stops), self.columns, expansion.units)

    def _bound_errors(self, integrands: Integrands, asked: np.ndarray) -> Array:
        """Return lower and upper bounds ``(q, m, 2)`` of the errors on intervals with ``integrands``.

        Channels that are not ``asked (m, q)`` have 0.
        """
        if self.bound is not None:
            return self._bound_joint_inputs(self.bound, integrands)
        (count, order, m), sizes = integrands.terms.shape, integrands.sizes
        # a cut rounds every coefficient four times for every order; halves, of half the length each, twice in all
        errors = (
            integrands.errors
            + rounding(self.motion.states + (2 + 4 * CUTS_PER_INTERVAL) * order + INTERVAL_HALVINGS) * sizes
        )
        bounds = np.zeros((count, m, 2))
        for j, share in enumerate(self.shares):
            members = np.flatnonzero(asked[j])
            accuracy = np.maximum(ACCURACY * self.motion.grid.pieces * sizes[members, j], TINY)
            integrals = enclose_absolute_integrals(integrands.terms[members, :, j], accuracy)
            integrals = integrals + errors[members, j, None] * [-1.0, 1.0]
            bounds[members, j] = share * np.maximum(integrals, 0.0) * [1.0 / OUTWARD, OUTWARD]
        return bounds

    def _bound_joint_inputs(self, bound: ConvexSet, integrands: Integrands) -> Array:
        """Return `_bound_errors` for a set of inputs through all columns together, ``(q, 1, 2)``."""
        (count, order, m), sizes = integrands.terms.shape, integrands.sizes @ self.error_radii
        terms = rounding(self.motion.states + 2 * order + INTERVAL_HALVINGS + 2 * m)
        errors = integrands.errors @ self.error_radii + terms * sizes
        accuracy = np.maximum(ACCURACY * self.motion.grid.pieces * sizes, TINY)
        integrals = enclose_integrals(bound, integrands.terms, np.ones(count), accuracy)
        return np.asarray(integrals + OUTWARD * errors[:, None] * [-1.0, 1.0])[:, None]


@final
@dataclass(frozen=True, eq=False)
class UncertainExecution(Execution):
    """`Execution` of a system that changes with time and has parameters.

    ``known`` is the execution of a known system; an execution is made from it for each parameter and on each cell.
    Directions are followed by their parameters (`extend_directions`).
    """

    known: VaryingExecution

    def none(self) -> UncertainExecution:
        """`Execution.none`."""
        return replace(self, shares=np.zeros(self.shares.size), known=self.known.none())

    @property
    def late(self) -> int:
        """`Execution.late`."""
        return self.known.late

    @property
    def around(self) -> UncertainExecution:
        """`VaryingExecution.around`."""
        around = self.known.around
        return self if around is self.known else replace(self, shares=around.shares, known=around)

    def extend_directions(self, directions: Array, parameters: Array) -> Array:
        """Return directions ``(k, d)`` with the parameters ``(k, nu)`` as further columns, ``(k, d + nu)``."""
        return np.hstack([directions, parameters])

    def at(self, parameter: Array) -> VaryingExecution:
        """Return the errors of the known system at a ``parameter (nu,)``; the last ones are remembered."""
        if not self.shares.any():  # there may be no parameters
            return self.known
        key = parameter.tobytes()
        if key not in self._point_executions:
            execution = self.known.following(self.response.propagator.at_point(parameter), self.response.initial_state)
            remember(self._point_executions, key, execution, POINTS_KEPT)
        return self._point_executions[key]

    @cached_property
    def _point_executions(self) -> dict[bytes, VaryingExecution]:
        return {}

    @cached_property
    def _cell_executions(self) -> dict[bytes, tuple[SpreadMotion, VaryingExecution]]:
        return {}

    def over(self, control: Array, rows: Array, leg: Leg, joined: Combination | None = None) -> Support:
        """`Execution.over`."""
        assert joined is None  # refused beside curved sets
        return self.on_functionals(control, rows, leg)

    def on_functionals(self, control: Array, rows: Array, leg: Leg) -> VaryingExecutionSupport:
        """`Execution.on_functionals`."""
        assert isinstance(leg, SpreadMotion)
        key = id(leg).to_bytes(8)  # of a leg that is kept beside
        if key not in self._cell_executions:
            execution = self.known.following(leg.motion.propagator, leg.motion.initial_state)
            remember(self._cell_executions, key, (leg, execution), CELLS_KEPT)
        return self._cell_executions[key][1].on_functionals(control, rows, leg)

    def _each(
        self, directions: Array, found: Array, of: Callable[[VaryingExecution, np.ndarray, Array], Array]
    ) -> Array:
        """Fill ``found (k, ...)`` with the values of a function ``of`` the errors at every parameter, and return it."""
        d = self.error_mask.size
        unique, parameter_indices = unique_rows(directions[:, d:])
        for number, parameter in enumerate(unique):
            indices = np.flatnonzero(parameter_indices == number)
            found[indices] = of(self.at(parameter), indices, directions[indices, :d])
        return found

    @shaped
    def unit_errors(self, times: Float[Array, " k"], directions: Float[Array, "k d"]) -> Float[Array, "k m n"]:
        """`Execution.unit_errors`."""
        values = np.empty((times.size, self.shares.size, self.late + self.breakpoints.size - 1))
        return self._each(directions, values, lambda errors, indices, c: errors.unit_errors(times[indices], c))

    def sampled(self, control: Array, times: Array, directions: Array) -> Array:
        """Return `Execution.sampled`, remembered at every parameter by itself."""
        return self._each(
            directions, np.empty(times.size), lambda errors, indices, c: errors.sampled(control, times[indices], c)
        )

    @shaped
    def enclosed(
        self, control: Float[Array, "m K"], times: Float[Array, " k"], directions: Float[Array, "k d"]
    ) -> Float[Array, "k 2"]:
        """`Execution.enclosed`."""
        bounds = np.empty((times.size, 2))
        return self._each(directions, bounds, lambda errors, indices, c: errors.enclosed(control, times[indices], c))


def followed(errors: VaryingExecution) -> VaryingExecution | UncertainExecution:
    """Return the errors of a system that changes with time: where it has parameters, at each of them and on cells."""
    if errors.response.propagator.laws is None:
        return errors
    return UncertainExecution(
        errors.response, errors.breakpoints, errors.shares, errors.error_mask, errors.scaling, errors
    )


def execution_of(
    response: Response, breakpoints: Array, shares: Array, error_mask: Array, scaling: csr_array
) -> Execution:
    """Return the errors of execution of a system, with the fields of `Execution`."""
    arguments = response, breakpoints, shares, error_mask, scaling
    return followed(VaryingExecution(*arguments)) if response.system.varies else ConstantExecution(*arguments)


@final
@dataclass(frozen=True, eq=False)
class StateErrors:
    """The effect of errors of execution of a ``control (m, K)`` on the states of a ``motion``, bounded state by
    state."""

    execution: VaryingExecution
    control: Array
    motion: VaryingMotion

    @cached_property
    def sizing(self) -> Array:
        """Bounds ``(K, m)`` of the errors of execution on every piece between marks."""
        size = self.execution.error_radii[:, None] * self.execution.acts(self.control)
        return np.asarray(size[:, self.execution.acting].T * OUTWARD)

    @cached_property
    def at_marks(self) -> Array:
        """Bounds ``(K + 1, d)`` of the effect on every state at the marks.

        For a set of inputs through several columns together the bounds are those of the box around it, whose integrals
        are of absolute values.
        """
        around, marks, d = self.execution.around, self.motion.grid.breakpoints, self.motion.states
        control = np.repeat(self.control, around.shares.size // self.execution.shares.size, axis=0)
        bounds = around.enclosed(control, np.repeat(marks, d), np.tile(np.eye(d), (marks.size, 1)))
        return np.asarray(np.maximum(bounds[:, 1], 0.0).reshape(-1, d) * OUTWARD)

    @cached_property
    def rounded(self) -> Array:
        """Bounds ``(K, d)`` of the error of the states on every piece, from the error of the transitions."""
        forcing = self.motion.flow.sizes[..., self.execution.columns] * self.sizing[:, None]
        return self.motion.bound_state_errors(self.at_marks[:-1], forcing)

    @cached_property
    def bounds(self) -> Array:
        """Bounds ``(K, d)`` of the effect on every state on every piece."""
        motion, lengths = self.motion, self.motion.grid.lengths
        rates = np.einsum("kim,km->ki", motion.law_bounds[:, :, self.columns], self.sizing)
        return motion.grown(motion.every, lengths, self.at_marks[:-1] + lengths[:, None] * rates)

    @cached_property
    def curvatures(self) -> Array:
        """Bounds ``(K, d)`` of the second derivative in time of the effect on every state, on every piece."""
        second, d = self.motion.second, self.motion.states
        of_states = np.einsum("kij,kj->ki", second[:, :, :d], self.bounds)
        return np.asarray((of_states + np.einsum("kim,km->ki", second[:, :, self.columns], self.sizing)) * OUTWARD)

    @cached_property
    def inputs(self) -> Array:
        """Bounds ``(K, m + mw)`` of the errors through every column of ``[B E]`` on every piece."""
        inputs = np.zeros((len(self.sizing), self.motion.law_bounds.shape[2] - self.motion.states))
        inputs[:, self.execution.columns] = self.sizing
        return inputs

    @property
    def columns(self) -> np.ndarray:
        """The columns of ``[A B E]`` through which errors enter."""
        return self.motion.states + self.execution.columns


@final
@dataclass(frozen=True, eq=False)
class VaryingExecutionSupport:
    """The support of errors of execution on functionals ``rows (r, d)`` of a system that changes with time, over a cell
    of parameters where it has any, in the form of `Support`.

    ``errors`` are those in all coefficients of the state. A polynomial ``f`` of one parameter is nowhere further from
    its chord than half the largest ``|f''|`` on ``[-1, 1]``, and the absolute value of the chord is not above the chord
    of the absolute values. So, in one parameter after another, the integrals of ``|f|`` are at most the linear
    interpolation of those at the corners, plus half of the integrals of ``|f''|``.
    """

    errors: StateErrors
    rows: Array
    cell: VaryingMotion | SpreadMotion

    @shaped
    def steepness(self, times: Float[Array, " k"]) -> Float[Array, "k r nu"]:
        """`Support.steepness`."""
        return np.asarray(self._bound_effects(times) @ self.cell.space.exponents)

    @shaped
    def at(
        self, times: Float[Array, " k"], ends: Float[Array, "k r nu"]
    ) -> tuple[Float[Array, "k r M"], Float[Array, "k r"]]:
        """`Support.at`."""
        space, sizes, errors = self.cell.space, self._bound_effects(times), self.errors
        coefficients, excess = np.zeros((*ends.shape[:2], space.size)), np.zeros(ends.shape[:2])
        patterns, pattern_indices = distinct_patterns(ends)
        for position, pattern in enumerate(patterns):
            time_indices, row_indices = np.nonzero(pattern_indices == position)
            free, corners = np.flatnonzero(pattern == 0.0), _list_corners(pattern)
            powers = space.monomials(corners)
            directions = (powers[:, :, None] * self.rows[row_indices][:, None, None, :]).reshape(
                len(row_indices) * len(corners), -1
            )
            bounds = errors.execution.enclosed(errors.control, np.repeat(times[time_indices], len(corners)), directions)
            bounds = bounds.reshape(len(row_indices), len(corners), 2)
            error_bounds = (bounds[..., 1] - bounds[..., 0]).max(axis=1) / 2
            curvature = sizes[time_indices, row_indices] @ (
                space.exponents[:, free] * (space.exponents[:, free] - 1)
            ).sum(axis=1)
            coefficients[time_indices, row_indices], truncation = between_corners(space, pattern, bounds.mean(axis=2))
            excess[time_indices, row_indices] = (error_bounds + curvature / 2 + truncation) * OUTWARD
        return coefficients, excess

    @shaped
    def deviation(self, start: Float[Array, " k"], widths: Float[Array, " k"]) -> Float[Array, "k r"]:
        """Return bounds ``(k, r)`` of the height of the support function above its chord on ``[start, start + width]``.

        Each interval is inside one piece. With ``g(t, s) = c'Phi(t, s) B(s)`` the second derivative of the integral of
        ``|g|`` up to ``t`` is at least ``-|c'B'| - |c'A B| - int |g_tt| ds``, and ``g_tt = c'(A' + A^2) Phi B``: where
        ``g`` changes its sign the slope jumps upwards only. All matrices are those at the start, and their change
        within the cell is added. The bounds are summed over the coefficients.
        """
        motion, rows = self.cell.motion, self._coefficient_rows
        d, columns = motion.states, self.errors.columns
        pieces = np.minimum(motion.place(start), motion.origin.size - 1)
        (law, slope), third = motion.law(start, pieces), motion.third[pieces]
        A, inputs = law[:, :, :d], law[:, :, columns]
        states, sizing, whole = (
            bounds[pieces] for bounds in (self.errors.bounds, self.errors.sizing, self.errors.curvatures)
        )
        change = np.einsum("kij,kj->ki", third[:, :, :d], states) + np.einsum(
            "kim,km->ki", third[:, :, columns], sizing
        )
        change = widths[:, None] * change + rounding(2 * motion.terms) * whole
        of_inputs = np.abs(rows @ slope[:, :, columns]) + np.abs(rows @ A @ inputs)
        curvatures = np.einsum("krj,kj->kr", np.abs(rows @ (slope[:, :, :d] + A @ A)), states)
        curvatures += np.einsum("krm,km->kr", of_inputs, sizing) + change @ np.abs(rows).T
        least = np.minimum(curvatures, whole @ np.abs(rows).T).reshape(start.size, len(self.rows), -1).sum(axis=2)
        return np.asarray((widths**2 / 8)[:, None] * least * OUTWARD)

    @cached_property
    def neglected(self) -> Array:
        """Bounds ``(r, K)`` of the error of the functionals on every piece, from the error of the transitions and from
        the terms beyond the degree."""
        errors, rows = self.errors, np.abs(self.rows)
        rounded = product(np.abs(self._coefficient_rows), errors.rounded.T)
        rounded = rounded.reshape(len(rows), -1, len(errors.sizing)).sum(axis=1)
        truncation = self.cell.bound_truncation(errors.at_marks[:-1] + errors.rounded, errors.inputs)
        return np.asarray((rounded + product(rows, truncation.T)) * OUTWARD)

    @property
    def effect_bounds(self) -> Array:
        """Bounds ``(K, d)`` of `Support.effect_bounds`."""
        return self.cell.folded(self.errors.bounds)

    def _bound_effects(self, times: Array) -> Array:
        """Return bounds ``(k, r, M)`` of the effect of the errors of execution along every coefficient on the cell."""
        motion = self.cell.motion
        pieces = np.minimum(motion.place(times), motion.origin.size - 1)
        bounds = self.errors.bounds[pieces].reshape(times.size, self.cell.space.size, -1)
        return np.asarray(np.einsum("rd,kad->kra", np.abs(self.rows), bounds) * OUTWARD)

    @cached_property
    def _coefficient_rows(self) -> Array:
        """The functionals as rows ``(r M, states)`` of every coefficient on the cell, on all coefficients."""
        return self.cell.along_cell(self.rows)
