"""A known system that changes with time, between the breakpoints, as bounds over cells of time see it.

Between two *marks*, breakpoints and ends of segments of the expansion, the system is one polynomial of the time with a
remainder. There ``y'' = Q y + R v`` with ``Q = A' + A^2`` and ``R = F' + A F``, for the state and for the effect of any
block of an uncertainty on it, under inputs ``v`` through ``F = [B E]``. The change of ``y''`` within a cell is bounded
entry by entry by its own derivative. The error of the computed states is the propagated error of all steps: the
products of transitions that propagate it are at most the computed ones, and a little more.

For a system with parameters whose state is not affine in them, the motion is that of all coefficients of an expansion
in the parameters. With ``x = sum_a delta^a x_a + R`` (`ExpandedSystem`), the remainder beyond the degree ``D`` obeys
``R' = A(t, p) R`` plus the products of coefficients of ``A`` and of the state whose degrees add up to more than ``D``.
So the remainder is at most the norm of the transitions times the integral of ``sum_j n_j sum_(b > D - j) a_b``, with
``a_b`` and ``n_j`` the norms of all coefficients of ``A`` and of the state of a degree. The transitions are such an
expansion themselves, and their norm is bounded from the norms of their own coefficients. For entries that are no
polynomials the remainder of their power series (`TruncationBound`) is added: that of ``A`` times all coefficients of
the state, and that of ``[B E]`` times inputs.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import cached_property
from math import factorial

import numpy as np

from sparserob_core.control.enclosures.cache import remember
from sparserob_core.control.enclosures.comparison import product
from sparserob_core.control.enclosures.dependence import ExpandedSystem
from sparserob_core.control.reach.disturbance_support import over_faces, summed
from sparserob_core.control.response.disturbance import DisturbanceModel
from sparserob_core.control.response.response import Propagator
from sparserob_core.control.response.time_grid import TimeGrid
from sparserob_core.control.response.varying.expansion import Expansion, Flow
from sparserob_core.errors import NotEnclosable
from sparserob_core.sip.convex_set import Array, ConvexSet
from sparserob_core.sip.expressions.rounding import rounding
from sparserob_core.sip.expressions.taylor import Combination, TaylorSpace

KNOWN = TaylorSpace(0, 0)
FEWEST_TERMS, MAX_TERMS = 8, 32
"""Terms of an exponential of bounds, at least and at most. With half of them third derivatives count twice."""
TAIL = 2.0**-60
"""Share of a norm that the terms beyond may be. They are bounded in the norm of all coefficients of a cell. With a
thousand times more they were a floor under the coefficients of high degree, and no halving of a cell closed it."""
OUTWARD = 1.0 + 1e-12  # for sums of some thousand numbers that are not negative
AT_ONCE = 4_000_000  # numbers of weights that are made at once
TINY = float(np.finfo(float).tiny)
TERMS = 40  # of the exponential of norms on a piece, which are at most a few: 4^40 / 40! is 1e-24
REST = 1e-20  # added to each entry, more than the sum of the terms beyond these
RATIOS = (1.0, 2.0, 4.0, 8.0, 16.0)
"""Weights of one further degree in the norms in which the errors of transitions are bounded. With the first alone the
error bound of a coefficient of high degree would be that of the constant one. Then the truncation error could never
fall below rounding times the growth."""
PATHS_KEPT = 4  # controls whose states are remembered
FLOWS_KEPT = 4  # sets of times whose flows are remembered: those of cells, and of their beginnings, of two constraints
STRETCHES = 256  # of pieces, whose bounds count at their largest; a tenth mixes parts of an orbit, ten times are 1 GB


@dataclass(frozen=True, eq=False)
class VaryingMotion:
    """The `EnclosedMotion` of a system that changes with time from one initial state ``(d,)``; each state is a block
    of its own, so that all bounds are entry by entry."""

    propagator: Propagator
    initial_state: Array

    @cached_property
    def grid(self) -> TimeGrid:
        """The pieces between all marks, ``K`` of them."""
        grid, origin = self.propagator.grid, self.origin
        control_pieces, disturbance_pieces = grid.control_piece[origin], grid.disturbance_piece[origin]
        modes = np.arange(origin.size)
        marks = self.propagator.marks
        return TimeGrid(
            marks, control_pieces, disturbance_pieces, grid.before, grid.constants, mode=modes, varying=True
        )

    @cached_property
    def origin(self) -> np.ndarray:
        """The piece of the propagator's grid that each of the pieces is in, ``(K,)``."""
        marks = self.propagator.marks
        return self.propagator.grid.locate((marks[:-1] + marks[1:]) / 2)

    @property
    def space(self) -> TaylorSpace:
        """The polynomials in no parameter, with one coefficient."""
        return KNOWN

    @property
    def states(self) -> int:
        """``d``."""
        return int(self.initial_state.size)

    @cached_property
    def transform(self) -> Array:
        """The identity."""
        return np.eye(self.states)

    @cached_property
    def starts(self) -> np.ndarray:
        """Indices ``(d,)`` at which the blocks begin: every state is a block of its own."""
        return np.arange(self.states)

    @property
    def influence(self) -> Array:
        """An empty array ``(0,)``, since the system has no parameters."""
        return np.zeros(0)

    @cached_property
    def norm(self) -> float:
        """The largest bound of the norm of ``A`` on a piece, in own units."""
        return float(self.paces.max())

    @property
    def terms(self) -> int:
        """Number of terms that are added up in an entry of `compute_curvature_matrices` times a state."""
        return 2 * int(self.expansion.coefficients.shape[1]) + 4 * self.states

    @cached_property
    def expansion(self) -> Expansion:
        """The system as polynomials in time."""
        expansion = self.propagator.expansion
        assert expansion is not None
        return expansion

    @cached_property
    def flow(self) -> Flow:
        """Effect of the state at the beginning of every piece, and of inputs, on the state at its end."""
        marks = self.propagator.marks
        return self.expansion.flow(marks[:-1], marks[1:])

    @cached_property
    def inputs(self) -> Array:
        """Effect of constant inputs on every piece on the state at its end, those of the disturbance after the others,
        ``(K, d, m + mw)``."""
        return np.concatenate([self.flow.control, self.flow.disturbance], axis=2)

    def nodes(self, control: Array) -> Array:
        """States ``(K + 1, 1, d)`` at the marks."""
        key = control.tobytes()
        if key not in self._paths:
            forcings = np.einsum("kdm,mk->kd", self.flow.control, self.grid.inputs(control))
            path = np.empty((forcings.shape[0] + 1, self.states))
            path[0] = self.initial_state
            for k, (step, forcing) in enumerate(zip(self.flow.state, forcings, strict=True)):
                path[k + 1] = step @ path[k] + forcing
            remember(self._paths, key, path[:, None], PATHS_KEPT)
        return self._paths[key]

    @cached_property
    def _paths(self) -> dict[bytes, Array]:
        return {}

    def propagate(self, within: Array, pieces: np.ndarray, start_states: Array, inputs: Array) -> Array:
        """`EnclosedMotion.propagate`."""
        flow = self.over(within, pieces)
        states = np.einsum("kij,kj->ki", flow.state, start_states[:, 0]) + np.einsum("kim,km->ki", flow.control, inputs)
        return np.asarray(states[:, None])

    def over(self, within: Array, pieces: np.ndarray) -> Flow:
        """Return the effect of states and inputs over the first times ``within (k,)`` of ``pieces (k,)``.

        The result is remembered, since a state and its uncertainty are looked at together.
        """
        pieces = np.minimum(pieces, self.origin.size - 1)  # beyond the last there is no time
        key = within.tobytes() + pieces.tobytes()
        if key not in self._flows:
            start = self.grid.breakpoints[pieces]
            remember(self._flows, key, self.expansion.flow(start, start + within), FLOWS_KEPT)
        return self._flows[key]

    @cached_property
    def _flows(self) -> dict[bytes, Flow]:
        return {}

    def deviation(
        self, rows: Array, start: Array, width: Array, pieces: np.ndarray, states: Array, inputs: Array
    ) -> Array:
        """`EnclosedMotion.deviation`."""
        return self.bound_chord_errors(
            rows, start, width, pieces, states[:, 0, :, None], inputs[:, :, None], np.ones(1)
        )

    def bound_chord_errors(
        self,
        rows: Array,
        start: Array,
        width: Array,
        pieces: np.ndarray,
        states: Array,
        inputs: Array,
        sizes: Array,
    ) -> Array:
        """Return bounds ``(k, r)`` of the distance of rows of states from their chords on ``[start, start + width]``.

        The bounds are from the second time derivative at the start, and from its change by the third.

        Parameters
        ----------
        rows : Array
            Rows ``(r, d)``, or ``(k, r, d)``.
        start, width : Array
            Cells of time ``(k,)``.
        pieces : array
            The piece ``(k,)`` of each cell.
        states, inputs : Array
            States ``(k, d, n)`` at ``start``, and their inputs ``(k, i, n)``, the first ``i`` of all.
        sizes : Array
            Bounds ``(n,)``: the bounds hold for any sum of the states, each times a factor of at most its size.

        Returns
        -------
        Array
            The bounds ``(k, r)``.
        """
        d, last = self.states, self.states + inputs.shape[1]
        matrices = self.compute_curvature_matrices(start, pieces)[:, :, :last]
        curvatures = matrices[:, :, :d] @ states + matrices[:, :, d:] @ inputs
        start_sizes, input_sizes = np.abs(states) @ sizes, np.abs(inputs) @ sizes
        law_bounds, third = self.law_bounds[pieces], self.third[pieces]
        driven_sizes = start_sizes + width[:, None] * np.einsum("kim,km->ki", law_bounds[:, :, d:last], input_sizes)
        change = np.einsum("kij,kj->ki", third[:, :, :d], self.grown(pieces, width, driven_sizes))
        change = change + np.einsum("kim,km->ki", third[:, :, d:last], input_sizes)
        magnitudes = np.einsum("kij,kj->ki", np.abs(matrices), np.concatenate([start_sizes, input_sizes], axis=1))
        change = width[:, None] * change + rounding(self.terms + inputs.shape[1]) * magnitudes
        row_curvature = np.abs(rows @ curvatures) @ sizes + (np.abs(rows) @ change[:, :, None])[:, :, 0]
        return np.asarray((width**2 / 8)[:, None] * row_curvature * OUTWARD)

    def along(self, control: Array, rows: Array, others: Array) -> Array:
        """`EnclosedMotion.along`."""
        error_bounds, sizes = self.under(control)
        return np.asarray(product(rows, error_bounds.T) + product(others, sizes.T))

    def under(self, control: Array) -> tuple[Array, Array]:
        """Return bounds of the error of the states under a control on every piece, as `bound_state_errors` counts it,
        and bounds of the states, ``(K, d)`` each.

        The result is remembered, since it is the same for all rows.
        """
        key = control.tobytes()
        if key not in self._control_bounds:
            input_sizes, start_sizes = np.abs(self.grid.inputs(control)), np.abs(self.nodes(control)[:-1, 0])
            m = input_sizes.shape[0]
            error_bounds = self.bound_state_errors(start_sizes, self.flow.sizes[:, :, :m] * input_sizes.T[:, None])
            forcing = np.einsum("kim,mk->ki", self.law_bounds[:, :, self._slice_inputs(m)], input_sizes)
            driven_sizes = start_sizes + self.grid.lengths[:, None] * forcing
            bounds = error_bounds, self.grown(self.every, self.grid.lengths, driven_sizes)
            remember(self._control_bounds, key, bounds, PATHS_KEPT)
        return self._control_bounds[key]

    @cached_property
    def _control_bounds(self) -> dict[bytes, tuple[Array, Array]]:
        return {}

    def bound_state_errors(self, sizes: Array, forcing: Array) -> Array:
        """Return bounds of the error of states on every piece, entry by entry, ``(K, d)``.

        The error counts twice, since both a chord and the state itself are looked at. Its effect on the second and on
        the third derivative is added.

        Parameters
        ----------
        sizes : Array
            Bounds ``(K, d)`` of the states at the beginning of every piece.
        forcing : Array
            Bounds ``(K, d, ...)`` of the inputs to the states that are coupled with each state, in the norm of their
            units.

        Returns
        -------
        Array
            Bounds ``(K, d)``.
        """
        state_errors, lengths, d = (
            self._propagate_step_errors(sizes, forcing.sum(axis=2)),
            self.grid.lengths[:, None],
            self.states,
        )
        second = np.einsum("kij,kj->ki", self.second[:, :, :d], state_errors)
        third = np.einsum("kij,kj->ki", self.third[:, :, :d], self.grown(self.every, lengths[:, 0], state_errors))
        return np.asarray((2.0 * state_errors + lengths**2 / 8 * (second + lengths * third)) * OUTWARD)

    def _propagate_step_errors(self, sizes: Array, forcing: Array) -> Array:
        """Return bounds ``(K, d)`` of the propagated error of all steps, on every piece.

        Every step has an error in proportion to the states at its beginning, and to their inputs, of all states that
        are coupled with one another, in the units of its segment. The transitions from there, and within the piece,
        propagate it.
        """
        units, step_errors = self._step_errors
        start_norms = self.expansion.over_parts((sizes / units)[:, :, None])[:, :, 0]
        # not 0, which times no bound is no number
        local_errors = np.maximum(step_errors[:, None] * (start_norms + forcing), TINY)
        stretch, first = self._stretches
        sums_within, stretch_totals = np.empty_like(local_errors), np.add.reduceat(local_errors, first, axis=0)
        for begin, end in zip(first, [*first[1:], len(local_errors)], strict=True):
            sums_within[begin:end] = np.cumsum(local_errors[begin:end], axis=0)
        propagated, is_earlier = np.zeros_like(local_errors), np.arange(first.size) < stretch[:-1, None]
        propagated[1:] = np.einsum("kb,kbi,bi->ki", is_earlier, self.transition_bounds[1:-1], stretch_totals)
        propagated[1:] += self.transition_bounds[np.arange(1, len(local_errors)), stretch[:-1]] * sums_within[:-1]
        return np.asarray((self.grown(self.every, self.grid.lengths, propagated) + units * local_errors) * OUTWARD)

    @cached_property
    def _step_errors(self) -> tuple[Array, Array]:
        """Units and errors of the steps over all pieces.

        The units ``(K, d)`` are those of the segment that a piece is in, or of all where it is in several. The error
        ``(K,)`` of a step is in the norm of largest row sums in these units, with the rounding of a product with the
        step.
        """
        expansion, marks, flow = self.expansion, self.propagator.marks, self.flow
        spans_segments = np.searchsorted(expansion.ends, marks[1:], side="left") - 1 > expansion.segment_of(marks[:-1])
        ratios = np.where(spans_segments[:, None], 1.0, expansion.ratios[self._segments])
        units = expansion.units * ratios
        errors = flow.error / ratios.max(axis=1)
        transition_norms = (np.abs(flow.state) / units[:, :, None] * units[:, None]).sum(axis=2).max(axis=1)
        return units, errors + rounding(self.states + self.inputs.shape[2]) * (transition_norms + errors)

    @cached_property
    def _stretches(self) -> tuple[np.ndarray, np.ndarray]:
        """The stretch of the horizon that each piece is in, ``(K,)``, and the first piece of each."""
        stretch = self.every // -(-self.every.size // STRETCHES)
        return stretch, np.unique(stretch, return_index=True)[1]

    @cached_property
    def transition_bounds(self) -> Array:
        """Bounds ``(K + 1, stretches, d)`` of the effect on every mark of a step with error 1 in an earlier stretch,
        state by state.

        The error is 1 in the units of the piece of the step. The bound is that of the computed transitions to the mark
        from the ends of the pieces of the stretch, and ``P^2 e / (1 - P e)`` more. Here ``P`` is the largest norm of
        these transitions, each in the units of the pieces that end at both marks, and ``e`` the sum of the errors of
        all steps in these units.
        """
        (units, step_errors), first = self._step_errors, self._stretches[1]
        bounds = np.zeros((len(units) + 1, first.size, self.states))
        for mark, sums in enumerate(self.sums()):
            earlier = first[first < mark]
            if mark:
                bounds[mark, : earlier.size] = np.maximum.reduceat(sums[1:], earlier, axis=0)
        bounds = self.expansion.of_all(bounds)
        start_units = np.concatenate([units[:1], units[:-1]])
        mark_units = np.concatenate([units[:1], units])
        largest = max(1.0, float((bounds / mark_units[:, None]).max()))
        share = largest * float((step_errors * (start_units / units).max(axis=1)).sum())
        surplus = largest * share / (1.0 - share) if share < 0.5 else np.inf
        return bounds + np.where(bounds > 0.0, surplus * mark_units[:, None], 0.0)

    def sums(self) -> Iterator[Array]:
        """Yield, mark after mark, the effect on it of states of at most 1 at every mark up to it, ``(marks, d)``.

        States are in the units of the piece before their mark. For coefficients of polynomials, the states are those of
        the constant coefficient.
        """
        units, own = self._step_errors[0], self.expansion.own
        effects = np.empty((len(units) + 1, self.states, own))
        for mark in range(len(effects)):
            if mark:
                effects[:mark] = self.flow.state[mark - 1] @ effects[:mark]
            effects[mark] = np.diag(units[max(mark - 1, 0)])[:, :own]
            yield np.abs(effects[: mark + 1]).sum(axis=2)

    def grown(self, pieces: np.ndarray, width: Array, sizes: Array) -> Array:
        """Return bounds ``(k, d)`` of states of at most ``sizes (k, d)`` after up to a time ``width (k,)`` within a
        piece.

        The bounds are from the exponential of the largest entries of ``A`` on the piece.
        """
        matrix_bounds, pace = self.law_bounds[pieces][:, :, : self.states], self.paces[pieces] * width
        units = self.expansion.units * self.expansion.ratios[self._segments[pieces]]
        total, term, count = sizes.astype(float), sizes.astype(float), _count_terms(float(pace.max(initial=0.0)))
        for n in range(1, count):
            term = np.einsum("kij,kj->ki", matrix_bounds, term) * (width / n)[:, None]
            total = total + term
        tail_factors = (pace / count) / np.maximum(1.0 - pace / (count + 1), 0.1)
        tail = self.expansion.over_parts((term / units)[:, :, None])[:, :, 0] * tail_factors[:, None]
        tail = np.where(pace[:, None] < 0.8 * count, tail, np.inf)
        return np.asarray((total + units * tail) * OUTWARD)

    def place(self, times: Array) -> np.ndarray:
        """The mark at or before each time."""
        return np.maximum(np.searchsorted(self.grid.breakpoints, times, side="right") - 1, 0)

    def compute_curvature_matrices(self, times: Array, pieces: np.ndarray) -> Array:
        """``[Q R]`` at times on pieces, ``(k, d, d + m + mw)``."""
        law, slope = self.law(times, pieces)
        return np.asarray(slope + law[:, :, : self.states] @ law)

    def law(self, times: Array, pieces: np.ndarray) -> tuple[Array, Array]:
        """``[A F]`` and its derivative at times on pieces, ``(k, d, d + m + mw)`` each."""
        size = max(1, AT_ONCE // self.expansion.coefficients[0].size)
        if times.size > size:
            chunks = [slice(begin, begin + size) for begin in range(0, times.size, size)]
            pairs = [self.law(times[chunk], pieces[chunk]) for chunk in chunks]
            return np.concatenate([law for law, _ in pairs]), np.concatenate([slope for _, slope in pairs])
        segments = self._segments[pieces]
        begin, end = self.expansion.ends[segments], self.expansion.ends[segments + 1]
        coefficients = self.expansion.coefficients[segments]
        radius, orders = (end - begin) / 2, np.arange(coefficients.shape[1])
        powers = ((times - (begin + end) / 2) / radius)[:, None] ** orders
        law = np.einsum("kn,knij->kij", powers, coefficients)
        slope = np.einsum("kn,knij->kij", powers[:, :-1] * orders[1:] / radius[:, None], coefficients[:, 1:])
        return law, slope

    @cached_property
    def every(self) -> np.ndarray:
        """The numbers of all pieces."""
        return np.arange(self.origin.size)

    @property
    def motion(self) -> VaryingMotion:
        """The motion of all coefficients, which is this one."""
        return self

    def along_cell(self, rows: Array) -> Array:
        """Rows ``(r, d)`` as those of every coefficient, on all coefficients: they are the same."""
        return rows

    def folded(self, sizes: Array) -> Array:
        """Return the bounds ``(K, d)`` of states with these bounds of all coefficients: they are the same."""
        return sizes

    def bound_truncation(self, sizes: Array, inputs: Array) -> Array:
        """Return `SpreadMotion.bound_truncation`, which is 0 for a known system."""
        return np.zeros(sizes.shape)

    def supports(
        self, model: DisturbanceModel | None, initial: ConvexSet | None, rows: Array, joined: Combination | None
    ) -> list[VaryingSupport]:
        """Return the supports of a disturbance and of deviations of the initial state, as far as there are any."""
        return _list_supports(self, model, initial, rows, joined)

    def _slice_inputs(self, m: int) -> slice:
        return slice(self.states, self.states + m)

    @cached_property
    def _segments(self) -> np.ndarray:
        """The segment of the expansion that each piece is in, ``(K,)``."""
        marks = self.propagator.marks
        return self.expansion.segment_of((marks[:-1] + marks[1:]) / 2)

    @cached_property
    def _segment_bounds(self) -> tuple[Array, Array, Array, Array]:
        """Bounds on every segment of the expansion, entry by entry.

        Of ``[A F]``, and of the matrices that give the second and the third derivative of a solution from the state and
        its inputs, ``(s, d, d + m + mw)`` each; and a bound ``(s,)`` of the norm of ``A`` in own units.
        """
        expansion, d, sizes = self.expansion, self.states, np.abs(self.expansion.coefficients)
        radius, orders = (np.diff(expansion.ends) / 2)[:, None, None], np.arange(float(sizes.shape[1]))
        law_bounds = sizes.sum(axis=1) + expansion.remainder
        law_slopes = np.einsum("n,snij->sij", orders, sizes) / radius
        law_curvatures = np.einsum("n,snij->sij", orders * (orders - 1.0), sizes) / radius**2
        A, slope = law_bounds[:, :, :d], law_slopes[:, :, :d]
        second = law_slopes + A @ law_bounds
        third = law_curvatures + slope @ law_bounds + A @ law_slopes + second[:, :, :d] @ law_bounds
        units = expansion.units * expansion.ratios
        pace = (A / units[:, :, None] * units[:, None]).sum(axis=2).max(axis=1)
        return law_bounds * OUTWARD, second * OUTWARD, third * OUTWARD, pace * OUTWARD

    @cached_property
    def law_bounds(self) -> Array:
        """Bounds ``(K, d, d + m + mw)`` of the absolute values of ``[A F]`` on every piece."""
        return np.asarray(self._segment_bounds[0][self._segments])

    @cached_property
    def second(self) -> Array:
        """Bounds of the matrix that gives the second derivative of a solution from the state and its inputs, on every
        piece, ``(K, d, d + m + mw)``."""
        return np.asarray(self._segment_bounds[1][self._segments])

    @cached_property
    def third(self) -> Array:
        """Bounds of the matrix that gives the third derivative of a solution from the state and its inputs, on every
        piece, ``(K, d, d + m + mw)``."""
        return np.asarray(self._segment_bounds[2][self._segments])

    @cached_property
    def paces(self) -> Array:
        """Bounds ``(K,)`` of the norm of ``A`` in own units on every piece."""
        return np.asarray(self._segment_bounds[3][self._segments])

    @cached_property
    def of_initial(self) -> Array:
        """Effect of a deviation of the initial state on the states at the marks, ``(K + 1, d, 1, d)``."""
        effects = np.empty((self.origin.size + 1, self.states, self.states))
        effects[0] = np.eye(self.states)
        for k, step in enumerate(self.flow.state):
            effects[k + 1] = step @ effects[k]
        return effects[:, :, None]

    @cached_property
    def of_disturbance(self) -> Array:
        """Effect of the disturbance on every piece of the propagator's grid on the states at the marks,
        ``(K + 1, d, L, mw)``."""
        input_effects = self.flow.disturbance
        effects = np.zeros((self.origin.size + 1, self.states, self.propagator.grid.pieces, input_effects.shape[2]))
        for k, (step, piece) in enumerate(zip(self.flow.state, self.origin.tolist(), strict=True)):
            effects[k + 1, :, : piece + 1] = np.einsum("ij,jlw->ilw", step, effects[k, :, : piece + 1])
            effects[k + 1, :, piece] += input_effects[k]
        return effects


def _count_terms(pace: float) -> int:
    """Return the number of terms of ``e^pace`` whose tail is at most `TAIL`, within `FEWEST_TERMS` and `MAX_TERMS`."""
    count, pace = FEWEST_TERMS, min(pace, float(MAX_TERMS))
    while count < MAX_TERMS and pace**count > TAIL * factorial(count):
        count += 2
    return count


@dataclass(frozen=True, eq=False)
class VaryingSupport:
    """The support function of a part of the uncertainty on functionals ``rows (r, d)`` of a system that changes with
    time, over a cell of parameters where it has any, in the form of `DisturbanceSupport` for a known system.

    ``effect (K + 1, states, P, w)`` is the effect of its ``P`` components on all coefficients of the state until every
    mark. ``blocks`` takes weights ``(..., P, w)`` on the components to weights ``(..., nb, q)`` on the blocks, each of
    which is in ``set``. ``radii (w,)`` bounds the entries of a component. ``lasts``: the components act one after
    another, each on its piece of the propagator's grid, through ``E``.
    """

    cell: VaryingMotion | SpreadMotion
    set: ConvexSet
    effect: Array
    blocks: Callable[[Array], Array]
    radii: Array
    lasts: bool
    rows: Array
    combination: Combination | None = None

    @staticmethod
    def of_disturbance(
        cell: VaryingMotion | SpreadMotion, model: DisturbanceModel, rows: Array, combination: Combination | None
    ) -> VaryingSupport:
        """Return the support of the worst disturbance on functionals ``rows (r, d)``."""
        radii = model.bound.reach(np.eye(model.channels))
        effect = cell.motion.of_disturbance
        return VaryingSupport(cell, model.set, effect, model.blocks, radii, True, rows, combination)

    @staticmethod
    def of_initial(
        cell: VaryingMotion | SpreadMotion, bound: ConvexSet, rows: Array, combination: Combination | None
    ) -> VaryingSupport:
        """Return the support of the worst deviation of the initial state on functionals ``rows (r, d)``.

        The deviation is one block that acts at time 0, one of the constant coefficient alone.
        """
        radii, effect = bound.reach(np.eye(bound.dimension)), cell.motion.of_initial[..., : cell.states]
        return VaryingSupport(cell, bound, effect, lambda weights: weights, radii, False, rows, combination)

    @property
    def motion(self) -> VaryingMotion:
        """The motion of all coefficients of the state."""
        return self.cell.motion

    def steepness(self, times: Array) -> Array:
        """`Support.steepness`."""
        sizes = self.set.reach(self._weigh_blocks(times)).sum(axis=3)
        return np.asarray(sizes @ self._space.exponents)

    def at(self, times: Array, ends: Array) -> tuple[Array, Array]:
        """`Support.at`."""
        return over_faces(
            self._space,
            ends,
            lambda selection, face: summed(self.set, self._weigh_blocks(times)[selection], face).sum(axis=2),
        )

    def deviation(self, start: Array, widths: Array) -> Array:
        """`Support.deviation`: as `VaryingMotion.deviation`, for every block, of every coefficient on the cell."""
        motion, d, rows = self.motion, self.motion.states, self._coefficient_rows
        pieces = np.minimum(motion.place(start), motion.origin.size - 1)
        matrices = motion.compute_curvature_matrices(start, pieces)
        curvatures = self.weights(start, rows @ matrices[:, :, :d])
        third = motion.third[pieces]
        change = np.einsum("kij,kj->ki", third[:, :, :d], self._coefficient_bounds[pieces])
        if self.lasts:
            columns = slice(matrices.shape[2] - self.radii.size, None)
            curvatures[np.arange(start.size), :, motion.origin[pieces]] += rows @ matrices[:, :, columns]
            change = change + third[:, :, columns] @ self.radii
        exact = self.set.reach(self.blocks(curvatures)).sum(axis=2)
        change = widths[:, None] * change
        change = change + rounding(motion.terms + curvatures[0, 0].size) * np.einsum(
            "kij,kj->ki", motion.second[pieces][:, :, :d], self._coefficient_bounds[pieces]
        )
        row_curvature = (exact + change @ np.abs(rows).T) * OUTWARD
        row_curvature = row_curvature.reshape(start.size, len(self.rows), -1).sum(axis=2)
        return np.asarray((widths**2 / 8)[:, None] * row_curvature * OUTWARD)

    @cached_property
    def neglected(self) -> Array:
        """Bounds ``(r, K)`` of the error of the functionals on every piece, from the error of the transitions, the
        rounding of the sums over the blocks, and the terms beyond the degree of the expansion in parameters."""
        motion, start_sizes = self.motion, self.sizes[:-1]
        forcing = np.zeros((len(start_sizes), 1, 1))
        inputs = np.zeros((len(start_sizes), motion.law_bounds.shape[2] - motion.states))
        if self.lasts:
            forcing = motion.flow.sizes[..., -self.radii.size :] * self.radii
            inputs[:, -self.radii.size :] = self.radii
        state_errors = motion.bound_state_errors(start_sizes, forcing)
        total = state_errors + rounding(self.effect[0, 0].size) * self._coefficient_bounds
        errors = product(np.abs(self._coefficient_rows), total.T).reshape(len(self.rows), -1, len(total)).sum(axis=1)
        truncation = self.cell.bound_truncation(start_sizes + state_errors, inputs)
        return np.asarray((errors + product(np.abs(self.rows), truncation.T)) * OUTWARD)

    @cached_property
    def effect_bounds(self) -> Array:
        """Bounds ``(K, d)`` of the effect of this part of the uncertainty on every state on every piece."""
        return self.cell.folded(self._coefficient_bounds)

    @cached_property
    def _coefficient_rows(self) -> Array:
        """The functionals as rows ``(r M, states)`` of every coefficient on the cell, on all coefficients."""
        return self.cell.along_cell(self.rows)

    @cached_property
    def _coefficient_bounds(self) -> Array:
        """Bounds ``(K, states)`` of the effect of this part of the uncertainty on all coefficients on every piece."""
        motion, sizes = self.motion, self.sizes[:-1]
        lengths = motion.grid.lengths
        if self.lasts:
            sizes = sizes + lengths[:, None] * (motion.law_bounds[:, :, -self.radii.size :] @ self.radii)
        return motion.grown(motion.every, lengths, sizes)

    @cached_property
    def sizes(self) -> Array:
        """Bounds ``(K + 1, states)`` of the effect of this part of the uncertainty on all coefficients at the marks."""
        return np.asarray(np.einsum("kdpw,w->kd", np.abs(self.effect), self.radii) * OUTWARD)

    @property
    def _space(self) -> TaylorSpace:
        return self.cell.space if self.combination is None else self.combination.space

    def _weigh_blocks(self, times: Array) -> Array:
        """Taylor coefficients ``(k, r, M, nb, q)`` of what the functionals give to every block; those of the last times
        are remembered."""
        if self._last_weights.get("times") is not times:
            rows = np.broadcast_to(self._coefficient_rows, (times.size, *self._coefficient_rows.shape))
            blocks = self.blocks(self.weights(times, rows))
            coefficients = blocks.reshape(times.size, len(self.rows), self.cell.space.size, *blocks.shape[2:])
            coefficients = coefficients if self.combination is None else self.combination.apply(coefficients)
            self._last_weights.update(times=times, coefficients=coefficients)
        return self._last_weights["coefficients"]

    @cached_property
    def _last_weights(self) -> dict[str, Array]:
        return {}

    def weights(self, times: Array, rows: Array) -> Array:
        """Return the weights ``(k, r, P, w)`` of rows ``(k, r, states)`` at times ``(k,)`` on every component of the
        uncertainty."""
        motion, mark_indices = self.motion, self.motion.place(times)
        shape = self.effect.shape[2:]
        flow = motion.over(times - motion.grid.breakpoints[mark_indices], mark_indices)
        propagated_rows = rows @ flow.state
        weights = np.empty((*rows.shape[:2], *shape))
        size = max(1, AT_ONCE // max(1, motion.states * shape[0] * shape[1]))
        for begin in range(0, times.size, size):
            chunk = slice(begin, begin + size)
            table = self.effect[mark_indices[chunk]].reshape(-1, motion.states, shape[0] * shape[1])
            weights[chunk] = (propagated_rows[chunk] @ table).reshape(-1, rows.shape[1], *shape)
        if self.lasts:
            pieces = motion.origin[np.minimum(mark_indices, motion.origin.size - 1)]
            weights[np.arange(times.size), :, pieces] += rows @ flow.disturbance
        return weights


def _list_supports(
    cell: VaryingMotion | SpreadMotion,
    model: DisturbanceModel | None,
    initial: ConvexSet | None,
    rows: Array,
    joined: Combination | None,
) -> list[VaryingSupport]:
    """Return the supports of a disturbance and of deviations of the initial state, as far as there are any."""
    supports = [] if model is None else [VaryingSupport.of_disturbance(cell, model, rows, joined)]
    return supports if initial is None else [*supports, VaryingSupport.of_initial(cell, initial, rows, joined)]


@dataclass(frozen=True, eq=False)
class Truncation:
    """Truncation error of an expansion in parameters, of states whose coefficients all are in one ``motion``.

    Norms are in the units of the first block of the coefficients. ``known`` is the `growth` on a cell around this one,
    where that is known.
    """

    motion: VaryingMotion
    spread: ExpandedSystem
    known: float | None = None

    @cached_property
    def units(self) -> Array:
        """Units of the states, ``(d,)``."""
        return self.motion.expansion.units[: self.spread.d]

    def norms(self, sizes: Array) -> Array:
        """Return bounds ``(..., D + 1)`` of the summed norms of the coefficients of every degree, from bounds
        ``sizes (..., states)`` of all coefficients."""
        space = self.spread.space
        coefficient_norms = (sizes.reshape(*sizes.shape[:-1], space.size, self.spread.d) / self.units).max(axis=-1)
        return np.stack(
            [coefficient_norms[..., space.degrees == j].sum(axis=-1) for j in range(space.degree + 1)], axis=-1
        )

    def driven(self, inputs: Array) -> Array:
        """Return bounds ``(K, D + 1)`` of the rates at which inputs of at most ``inputs (K, m + mw)`` drive the
        coefficients of every degree."""
        d = self.motion.states
        rates = np.einsum("kin,kn->ki", self.motion.law_bounds[:, :, d:], inputs)
        return self.norms(rates)

    @cached_property
    def _coefficient_norms(self) -> Array:
        """Bounds ``(K, M)`` of the norms of the coefficients of ``A`` on every piece."""
        d, space = self.spread.d, self.spread.space
        first = self.motion.law_bounds[:, :, :d].reshape(-1, space.size, d, d) / self.units[:, None] * self.units
        return np.asarray(first.sum(axis=3).max(axis=2))

    @property
    def influence(self) -> Array:
        """Size of the change of the law with every parameter, over the horizon, ``(nu,)``."""
        d, space, lengths = self.motion.states, self.spread.space, self.motion.grid.lengths
        inputs = self.motion.law_bounds[:, :, d:].reshape(lengths.size, space.size, self.spread.d, -1)
        input_norms = (inputs / self.units[:, None]).max(axis=(2, 3), initial=0.0)
        return np.asarray(lengths @ (self._coefficient_norms + input_norms) @ space.exponents)

    @property
    def growing(self) -> int:
        """The parameter that moves ``A`` most, which alone decides how far states grow."""
        changes = self.motion.grid.lengths @ self._coefficient_norms @ self.spread.space.exponents
        return int(changes.argmax())

    @cached_property
    def _degree_norms(self) -> Array:
        """Bounds ``(K, D + 1)`` of the summed norms of the coefficients of ``A`` of every degree on every piece."""
        space, norms = self.spread.space, self._coefficient_norms
        return np.stack([norms[:, space.degrees == j].sum(axis=1) for j in range(space.degree + 1)], axis=1)

    @cached_property
    def _law_remainders(self) -> tuple[Array, Array]:
        """Bounds of the remainder of the entries of the law on every piece: the norm of that of ``A``, ``(K,)``, and
        the rate at which that of ``[B E]`` drives states per unit of each input, ``(K, m + mw)``."""
        d, K = self.spread.d, self.motion.grid.pieces
        if self.spread.remainder is None:
            return np.zeros(K), np.zeros((K, self.motion.law_bounds.shape[2] - self.motion.states))
        sizes = self.spread.remainder.over(self.motion.grid.breakpoints) / self.units[:, None]
        return (sizes[:, :, :d] * self.units).sum(axis=2).max(axis=1) * OUTWARD, sizes[:, :, d:].max(axis=1) * OUTWARD

    @cached_property
    def _growth_bounds(self) -> Array:
        """Bounds ``(K, D + 1, D + 1)`` of the growth of the norms of the coefficients of every degree, anywhere on a
        piece."""
        size, count = self.spread.space.degree + 1, self._degree_norms.shape[0]
        rate = np.zeros((count, size, size))
        for j in range(size):
            for i in range(j + 1):
                rate[:, j, i] = self._degree_norms[:, j - i]
        rate = rate * self.motion.grid.lengths[:, None, None]
        total, term = np.tile(np.eye(size), (count, 1, 1)), np.tile(np.eye(size), (count, 1, 1))
        for n in range(1, TERMS):
            term = term @ rate / n
            total = total + term
        return (total + REST) * OUTWARD

    @cached_property
    def _truncation_factors(self) -> Array:
        """Factors ``(K, D + 1)`` of the coefficients of every degree in the products beyond the degree ``D``, with the
        remainder of ``A``."""
        sums = np.cumsum(self._degree_norms[:, ::-1], axis=1)  # of the degrees D, D and D - 1, ...: for j = 1, 2, ...
        above = np.concatenate([np.zeros((sums.shape[0], 1)), sums[:, :-1]], axis=1)
        return np.asarray((above + self._law_remainders[0][:, None]) * OUTWARD)

    def _integrate_truncation(self, start_norms: Array, driven: Array, off: Array) -> Array:
        """Return bounds ``(K,)`` of the integral of the terms beyond the degree over every piece.

        ``start_norms (K, D + 1)`` bounds the norms of the states at the beginning of the piece, ``driven (K, D + 1)``
        the rates of their inputs, and ``off (K,)`` the rate from the remainder of the entries ``[B E]``.
        """
        lengths = self.motion.grid.lengths[:, None]
        state_norms = np.einsum("kij,kj->ki", self._growth_bounds, start_norms + lengths * driven)
        return np.asarray(((state_norms * self._truncation_factors).sum(axis=1) + off) * lengths[:, 0] * OUTWARD)

    @cached_property
    def _transition_norms(self) -> Array:
        """Bounds ``(K + 1, D + 1)`` of the norms of the coefficients of every degree of the transitions from any mark
        to each one.

        The bounds are those of the computed effect of the constant coefficient on all coefficients, plus the error of
        the steps, propagated as in `VaryingMotion.transition_bounds`. The error is bounded in each of several norms, in
        which a degree ``j`` counts ``ratio^j``, so that the error of that degree is the bound divided by ``ratio^j``.
        """
        motion, space, d = self.motion, self.spread.space, self.spread.d
        marks = motion.grid.breakpoints
        degree_weights = np.array(RATIOS)[:, None] ** np.arange(space.degree + 1)
        degree_norms, largest = np.empty((marks.size, space.degree + 1)), np.ones(degree_weights.shape[0])
        for mark, sums in enumerate(motion.sums()):
            norms = self.norms(sums)
            degree_norms[mark], largest = norms.max(axis=0), np.maximum(largest, (norms @ degree_weights.T).max(axis=0))
        step_norms = degree_weights @ self.norms((np.abs(motion.flow.state[:, :, :d]) * self.units).sum(axis=2)).T
        error = motion.expansion.off(marks[:-1], marks[1:], RATIOS)
        share = largest * (error + rounding(motion.states) * (step_norms + error)).sum(axis=1) * OUTWARD
        error_bounds = np.where(share < 0.5, largest * share / np.where(share < 0.5, 1.0 - share, 1.0), np.inf)
        return np.asarray((degree_norms + (error_bounds[:, None] / degree_weights).min(axis=0)) * OUTWARD)

    @cached_property
    def growth(self) -> float:
        """An upper bound of the norm of the transitions from any time to any later one, at any parameter."""
        if self.known is not None:
            return self.known
        sizes = self._degree_norms.sum(axis=1) + self._law_remainders[0]
        piece_growth = float(np.exp((sizes * self.motion.grid.lengths).max()) * OUTWARD)
        mark_norms = self._transition_norms[:-1]
        share = piece_growth * float(
            self._integrate_truncation(mark_norms, np.zeros(mark_norms.shape), np.zeros(len(mark_norms))).sum()
        )
        largest = float(self._transition_norms.sum(axis=1).max())
        return piece_growth * piece_growth * largest / (1.0 - share) * OUTWARD if share < 0.5 else np.inf

    def bound_error(self, sizes: Array, inputs: Array) -> Array:
        """Return bounds ``(K, d)`` of the truncation error of states, state by state.

        Parameters
        ----------
        sizes : Array
            Bounds ``(K, states)`` of the coefficients at the beginning of every piece.
        inputs : Array
            Bounds ``(K, m + mw)`` of the inputs.

        Returns
        -------
        Array
            Bounds ``(K, d)``.
        """
        remainder_rates = (self._law_remainders[1] * inputs).sum(axis=1)
        accumulated = np.cumsum(self._integrate_truncation(self.norms(sizes), self.driven(inputs), remainder_rates))
        return np.asarray(self.growth * accumulated[:, None] * self.units * OUTWARD)

    def under(self, control: Array) -> Array:
        """Return bounds ``(K, d)`` of the truncation error of the states under a control; remembered."""
        key = control.tobytes()
        if key not in self._control_bounds:
            motion, inputs = self.motion, np.abs(self.motion.grid.inputs(control)).T
            all_inputs = np.zeros((len(inputs), motion.law_bounds.shape[2] - motion.states))
            all_inputs[:, : inputs.shape[1]] = inputs
            start_sizes = np.abs(motion.nodes(control)[:-1, 0]) + motion.under(control)[0]
            remember(self._control_bounds, key, self.bound_error(start_sizes, all_inputs), PATHS_KEPT)
        return self._control_bounds[key]

    @cached_property
    def _control_bounds(self) -> dict[bytes, Array]:
        return {}


@dataclass(frozen=True, eq=False)
class SpreadMotion:
    """The `EnclosedMotion` of a system over a cell of parameters: the motion of all coefficients on the cell, and a
    ``truncation`` for the terms beyond their degree."""

    truncation: Truncation

    @staticmethod
    def of(propagator: Propagator, initial_state: Array, growth: float | None) -> SpreadMotion:
        """Return the motion of a system over the cell on which its coefficients are expanded.

        ``growth`` is the `Truncation.growth` on a cell around this one, where it is known. Raises `NotEnclosable` where
        the cell is so wide that the terms beyond the degree grow without a bound.
        """
        assert propagator.expansion is not None
        spread = propagator.expansion.spread
        assert spread is not None
        coefficients = np.append(initial_state, np.zeros(spread.states - spread.d))
        truncation = Truncation(VaryingMotion(propagator, coefficients), spread, growth)
        with np.errstate(over="ignore", invalid="ignore"):  # of a cell that is too wide
            bounded = np.isfinite(truncation.growth)
        if not bounded:
            wide = "the state moves too far on a cell of parameters"
            raise NotEnclosable(wide, along=truncation.growing)
        return SpreadMotion(truncation)

    def supports(
        self, model: DisturbanceModel | None, initial: ConvexSet | None, rows: Array, joined: Combination | None
    ) -> list[VaryingSupport]:
        """Return `VaryingMotion.supports` over the cell."""
        return _list_supports(self, model, initial, rows, joined)

    @property
    def motion(self) -> VaryingMotion:
        """The motion of all coefficients."""
        return self.truncation.motion

    @property
    def spread(self) -> ExpandedSystem:
        """The parametric expansion of the state."""
        return self.truncation.spread

    @property
    def grid(self) -> TimeGrid:
        """The pieces between all marks."""
        return self.motion.grid

    @property
    def space(self) -> TaylorSpace:
        """The polynomials in the parameters."""
        return self.spread.space

    @property
    def states(self) -> int:
        """``d``."""
        return self.spread.d

    @cached_property
    def transform(self) -> Array:
        """The identity."""
        return np.eye(self.states)

    @cached_property
    def starts(self) -> np.ndarray:
        """Indices ``(d,)`` at which the blocks begin: every state is a block of its own."""
        return np.arange(self.states)

    @property
    def influence(self) -> Array:
        """`EnclosedMotion.influence`."""
        return self.truncation.influence

    @property
    def norm(self) -> float:
        """The largest norm of ``A`` for all coefficients together, in own units."""
        return self.motion.norm

    def nodes(self, control: Array) -> Array:
        """`EnclosedMotion.nodes`."""
        return self._separate_coefficients(self.motion.nodes(control)[:, 0])

    def propagate(self, within: Array, pieces: np.ndarray, start_states: Array, inputs: Array) -> Array:
        """`EnclosedMotion.propagate`."""
        return self._separate_coefficients(
            self.motion.propagate(within, pieces, start_states.reshape(len(start_states), 1, -1), inputs)[:, 0]
        )

    def deviation(
        self, rows: Array, start: Array, width: Array, pieces: np.ndarray, states: Array, inputs: Array
    ) -> Array:
        """`EnclosedMotion.deviation`, of every coefficient on the cell."""
        bounds = self.motion.deviation(
            self.along_cell(rows), start, width, pieces, states.reshape(len(states), 1, -1), inputs
        )
        return np.asarray(bounds.reshape(start.size, len(rows), -1).sum(axis=2) * OUTWARD)

    def along(self, control: Array, rows: Array, others: Array) -> Array:
        """Return the bounds of `EnclosedMotion.along`, with the truncation error and the rounding of the sums over
        coefficients."""
        bounds = self.motion.along(control, self.sizes(rows), (1.0 + self.space.size) * self.sizes(others))
        return np.asarray(bounds + rows @ self.truncation.under(control).T * OUTWARD)

    def along_cell(self, rows: Array) -> Array:
        """Rows ``(r, d)`` as those of every coefficient, on all coefficients, ``(r M, states)``."""
        coefficient_rows = np.eye(self.space.size)[None, :, :, None] * rows[:, None, None, :]
        return np.asarray(coefficient_rows.reshape(len(rows) * self.space.size, -1))

    def sizes(self, rows: Array) -> Array:
        """Rows ``(r, d)`` on sizes of states as such on sizes of all coefficients, ``(r, states)``."""
        return np.tile(rows, self.space.size)

    def folded(self, sizes: Array) -> Array:
        """Return the bounds ``(K, d)`` of states with bounds ``sizes (K, states)`` of all coefficients, times
        ``1 + M``, as the sums over ``M`` coefficients round more."""
        sums = sizes.reshape(len(sizes), self.space.size, -1).sum(axis=1)
        return np.asarray((1.0 + self.space.size) * OUTWARD * sums)

    def bound_truncation(self, sizes: Array, inputs: Array) -> Array:
        """Return bounds ``(K, d)`` of the truncation error of states with ``sizes (K, states)`` of all coefficients at
        the beginning of every piece, under inputs of at most ``inputs (K, m + mw)``."""
        return self.truncation.bound_error(sizes, inputs)

    def _separate_coefficients(self, states: Array) -> Array:
        return states.reshape(len(states), self.space.size, self.states)
