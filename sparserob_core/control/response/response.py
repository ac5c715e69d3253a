"""State responses by matrix exponentials: no time stepping, any times, any parameters, all vectorised.

On every piece of the merged time grid the inputs are constant, so the state follows
``x(tau_l + r) = Phi(r) x(tau_l) + Gamma(r) (B u_l + E w_l)`` with ``Phi(r) = e^{A r}`` and
``Gamma(r) = int_0^r e^{A s} ds``; both are blocks of one exponential of ``[[A, I], [0, 0]]`` (Van Loan 1978, Theorem
1).
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import cached_property
from itertools import pairwise

import numpy as np

from sparserob_core.control.enclosures.cache import remember
from sparserob_core.control.enclosures.flows import FEW_STATES, DoublingExponentials, Exponentials
from sparserob_core.control.enclosures.matrix_exponential import transitions
from sparserob_core.control.problem.system import System
from sparserob_core.control.response.inner_loop import NO_INNER_LOOP, InnerLoop, Weights
from sparserob_core.control.response.orbit import Orbit
from sparserob_core.control.response.time_grid import TimeGrid, merge_breakpoints
from sparserob_core.control.response.varying.expansion import Expansion
from sparserob_core.control.response.varying.spread import ParameterParts, law_of
from sparserob_core.shapes import Float, Int, shaped
from sparserob_core.sip.convex_set import Array
from sparserob_core.sip.expressions.rounding import EPSILON

# Blocks in which states are computed, where they are of two pieces and more. With a tenth of them what a block adds
# from 0 is made of more products; ten times as many are ten times the steps from block to block.
FEWEST = 64
LITTLE = 0.5  # norm of A times the duration of a block, at most
BLOCK = 32  # pieces of a block in which outputs are computed: what grows with it is as large as what does not
# Numbers in transitions over several pieces, beyond as many as those of single ones have (16 MB). Of pieces that all
# differ there are no more; of few kinds that follow each other in any order there would be one for every piece. With a
# tenth of it rows of such a plant of many pieces go from piece to piece, ten times as many are 160 MB.
STRETCHED = 2_000_000
TINY = float(np.finfo(float).tiny)
STEP = 4 * EPSILON  # of the horizon: times that differ by less are a whole piece apart, or not at all
STEPS_KEPT = 16  # sets of parameters whose transitions are remembered
FLOWS_KEPT = 2  # sets of times that a varying system has flown to: a picture asks for many rows at the same ones
SAME_DURATION = 1e-15  # of the horizon: durations that differ by less are computed once
ALIKE = 1e-13  # of the horizon: pieces whose lengths differ by less are equally long


@dataclass(frozen=True, eq=False)
class PieceTransitions:
    """Matrices at ``v`` parameters, and transitions over whole pieces of ``q`` distinct modes and lengths.

    ``A (v, J, d, d)`` has one matrix for every mode; ``B`` and ``E`` hold those of all modes side by side. ``Phi = e^{A
    h}`` and ``Gamma = int_0^h e^{A s} ds``, ``(v, q, d, d)`` each. ``modes (q,)``: the mode of each of them.
    """

    A: Array
    B: Array
    E: Array
    Phi: Array
    Gamma: Array
    modes: np.ndarray

    @cached_property
    def inputs(self) -> Array:
        """Columns of ``B`` and of ``E`` of every mode, ``(v, J, d, m + mw)``."""
        by_mode = (np.stack(np.split(matrix, self.A.shape[1], axis=-1), axis=1) for matrix in (self.B, self.E))
        return np.concatenate(list(by_mode), axis=-1)

    @cached_property
    def input_transitions(self) -> Array:
        """Matrices ``[Gamma (B, E), Phi] (v, q, d, m + mw + d)``, with which one product gives the weights of a row on
        the inputs and its transition."""
        return np.concatenate([self.Gamma @ self.inputs[:, self.modes], self.Phi], axis=-1)

    @cached_property
    def driven(self) -> Array:
        """Matrices ``[Gamma, Phi] (v, q, d, 2 d)``, for weights of a row on the forcing in every direction of the
        state."""
        return np.concatenate([self.Gamma, self.Phi], axis=-1)


@dataclass(frozen=True, eq=False)
class Impulses:
    """Impulse response ``e^{A i h} Gamma(h) M`` of later states to inputs through ``columns M (d, c)`` on a piece, by
    the age ``i`` of the piece. Only for a known system and equal pieces, whose response is a convolution with it.

    No table of all ages is made. The responses of the first ``reach`` ages (baby steps) are multiplied with rows that
    went on by a multiple of ``reach`` (giant steps). This takes ``O(sqrt(L) d^2)`` numbers for the steps, and one
    product. Both kinds of steps are doubled, so that every step is a product of few transitions, however late it is.
    With powers of one transition, rounding errors would grow with the number of pieces.
    """

    propagator: Propagator
    columns: Array

    @cached_property
    def reach(self) -> int:
        """Number of baby steps, a power of two."""
        return int(2 ** ((self.propagator.grid.pieces - 1).bit_length() // 2 + 1))

    @cached_property
    def steps(self) -> Array:
        """Products ``e^{A i h} Gamma(h) M`` side by side for ``i < reach``, ``(d, reach c)``."""
        d, c = self.columns.shape
        first = self.propagator.steps(np.zeros((1, 0))).Gamma[0, 0] @ self.columns
        steps = np.empty((d, min(self.reach, self.propagator.grid.pieces) * c))
        steps[:, :c], filled = first, c
        for transition in self.propagator.transition_powers:
            if filled >= steps.shape[1]:
                break
            batch = min(filled, steps.shape[1] - filled)
            steps[:, filled : filled + batch] = transition @ steps[:, :batch]
            filled += batch
        return steps

    def of(self, rows: Array, count: int) -> Array:
        """Return the weights ``(..., count, c)`` of ``rows (..., d)`` on the inputs of pieces of age ``0, ..., count -
        1``."""
        c, leading_shape = self.columns.shape[1], rows.shape[:-1]
        if count <= self.reach:
            return np.asarray((rows @ self.steps[:, : count * c]).reshape(*leading_shape, count, c))
        flat = rows.reshape(-1, rows.shape[-1])
        giants = np.empty((flat.shape[0], -(-count // self.reach), flat.shape[1]))
        giants[:, 0], filled = flat, 1
        for transition in self.propagator.transition_powers[self.reach.bit_length() - 1 :]:
            if filled >= giants.shape[1]:
                break
            batch = min(filled, giants.shape[1] - filled)
            giants[:, filled : filled + batch] = giants[:, :batch] @ transition
            filled += batch
        weights = (giants.reshape(-1, flat.shape[1]) @ self.steps).reshape(flat.shape[0], -1, c)
        return np.asarray(weights[:, :count].reshape(*leading_shape, count, c))


@dataclass(frozen=True, eq=False)
class Stretches:
    """Responses of later states to inputs on pieces of any lengths, over stretches of 1, 2, 4, ... pieces, one next to
    the other from the first piece on. Only for a known system.

    ``kinds``: the kind of every stretch, one array for each length of stretches. ``inputs (q, d, 2^s w)``: the response
    of the state at the end of a stretch to the inputs on it. ``flows (q, d, d)``: the transitions over a stretch.

    A row goes back through one stretch for every bit of the number of its piece, instead of through every piece. The
    weights on the inputs within a stretch are one product with few columns.
    """

    kinds: list[np.ndarray]
    inputs: list[Array]
    flows: list[Array]

    @staticmethod
    def of(which: np.ndarray, inputs: Array, flows: Array) -> Stretches:
        """Return the stretches of pieces of the kinds ``which (L,)``, with the responses ``inputs (q, d, w)`` to inputs
        on a piece and the transitions ``flows (q, d, d)`` of each kind. Stretches are doubled as long as the
        transitions over several pieces have at most `STRETCHED` numbers more than those over one."""
        stretches, budget = Stretches([which], [inputs], [flows]), flows.size + STRETCHED
        while which.size > 1:
            pairs, which = np.unique(which[: which.size // 2 * 2].reshape(-1, 2), axis=0, return_inverse=True)
            which, budget = which.reshape(-1), budget - len(pairs) * flows[0].size
            if budget < 0:
                break
            early, late = pairs.T
            inputs = np.concatenate([flows[late] @ inputs[early], inputs[late]], axis=2)
            flows = np.stack([flows[second] @ flows[first] for first, second in pairs.tolist()])
            stretches.kinds.append(which)
            stretches.inputs.append(inputs)
            stretches.flows.append(flows)
        return stretches

    def on(self, at: np.ndarray, rows: Array, found: Array) -> None:
        """Propagate ``rows (k, d)`` from the beginnings of the pieces ``at (k,)``, in decreasing order, back to time 0.
        The weights on the inputs of the pieces between are written to ``found (k, L, w)``, the rows at time 0 to
        ``rows``."""
        width, longest = found.shape[2], len(self.kinds) - 1
        for level, (kinds, inputs, flows) in enumerate(zip(self.kinds, self.inputs, self.flows, strict=True)):
            numbers, size = at >> level, 2**level
            if level < longest:  # the stretch before, where that is no half of a longer one
                ends = np.append(np.flatnonzero(np.diff(numbers, prepend=-1)), numbers.size).tolist()
                stretches = [(int(numbers[first]) - 1, slice(first, last)) for first, last in pairwise(ends)]
                stretches = [(number, selection) for number, selection in stretches if number % 2 == 0]
            else:  # of the longest ones, one before the other
                last = int(numbers.max(initial=0))
                active_counts = np.searchsorted(-numbers, -np.arange(last)).tolist()
                stretches = [(number, slice(0, active_counts[number])) for number in range(last - 1, -1, -1)]
            for number, selection in stretches:
                kind, selected = kinds[number], rows[selection]
                weights = (selected @ inputs[kind]).reshape(len(selected), size, width)
                found[selection, number * size : (number + 1) * size], rows[selection] = weights, selected @ flows[kind]


@dataclass(frozen=True, eq=False)
class Propagator:
    """Transition matrices, and functionals as weights, of one system on one time grid; all responses share them,
    whatever their initial state.

    ``propagate``: the exponentials of a known system whose matrix has a structure. ``given``: the system as polynomials
    in time, where they exist already.

    The weights of a functional on the pieces are computed in two ways. For a known system on equal pieces they depend
    on the age of a piece alone (`Impulses`). Otherwise rows go back from piece to piece.
    """

    system: System
    grid: TimeGrid
    propagate: Exponentials | None = None
    given: Expansion | None = None
    _steps: dict[bytes, PieceTransitions] = field(default_factory=dict, repr=False)
    _flows: dict[bytes, tuple[Array, Array]] = field(default_factory=dict, repr=False)
    _exponentials: dict[int, DoublingExponentials] = field(default_factory=dict, repr=False)

    @cached_property
    def which(self) -> np.ndarray:
        """Index of every piece among the distinct modes and lengths, in the order of `PieceTransitions`, ``(L,)``."""
        lengths = self.grid.lengths / self.grid.breakpoints[-1]
        if self.grid.mode is None and np.ptp(lengths) <= ALIKE:  # rounded, some might go up and others down
            return np.zeros(lengths.size, dtype=int)
        lengths = np.round(lengths / ALIKE)
        mode = np.zeros(lengths.size) if self.grid.mode is None else self.grid.mode
        _, indices = np.unique(np.stack([mode, lengths]), axis=1, return_inverse=True)
        return np.asarray(indices.reshape(-1))

    @cached_property
    def orbit(self) -> Orbit | None:
        """The states from 0 of a plant that grows by much, in more digits; ``None`` for others."""
        return Orbit.of(self.system, self.grid)

    @cached_property
    def lengths(self) -> Array:
        """Lengths ``(q,)`` of the distinct modes and lengths, as means over their pieces, so that rounding errors do
        not add up."""
        means: Array = np.bincount(self.which, self.grid.lengths) / np.bincount(self.which)
        return means

    @cached_property
    def _modes(self) -> np.ndarray:
        """Mode ``(q,)`` of every entry of `PieceTransitions`."""
        modes = np.zeros(self.lengths.size, dtype=int)
        if self.grid.mode is not None:
            modes[self.which] = self.grid.mode
        return modes

    @cached_property
    def laws(self) -> ParameterParts | None:
        """Law of a system that changes with time as a function of its parameters, on parts of their box. ``None`` where
        the state is an affine function of the parameters, or where there are none."""
        return None if self.system.powers is None else law_of(self.system)

    @property
    def law(self) -> Expansion | ParameterParts:
        """Law of a system that changes with time, known or with parameters."""
        law = self.expansion if self.laws is None else self.laws
        assert law is not None
        return law

    def on_cell(self, low: Array, high: Array) -> Propagator:
        """Return the propagator of all coefficients of the state on a cell ``[low, high]`` of parameters
        (`ParameterParts.on_cell`)."""
        assert self.laws is not None
        return Propagator(self.system, self.grid, given=self.laws.on_cell(low, high))

    def at_point(self, parameter: Array) -> Propagator:
        """Return the propagator of the known system at a parameter ``(nu,)``."""
        assert self.laws is not None
        return Propagator(self.system, self.grid, given=self.laws.at_point(parameter))

    @shaped
    def steps(self, parameters: Float[Array, "v nu"]) -> PieceTransitions:
        """Return the matrices and the transitions over whole pieces at parameters ``(v, nu)``; remembered for the last
        few calls."""
        # no parameters: any number of rows has the same bytes
        key = bytes(str(parameters.shape), "ascii") + parameters.tobytes()
        if key not in self._steps and self.system.varies:
            remember(self._steps, key, self._compute_varying_steps(parameters), STEPS_KEPT)
        if key not in self._steps:
            by_mode = [mode.matrices(parameters) for mode in self.system.modes]
            A, B, E = (
                np.stack([matrices[0] for matrices in by_mode], axis=1),
                *(np.concatenate([matrices[index] for matrices in by_mode], axis=2) for index in (1, 2)),
            )
            Phi, Gamma = self._compute_transitions(A, self._modes, self.lengths)
            remember(self._steps, key, PieceTransitions(A, B, E, Phi, Gamma, self._modes), STEPS_KEPT)
        return self._steps[key]

    def _compute_transitions(self, A: Array, modes: np.ndarray, durations: Array) -> tuple[Array, Array]:
        """Return ``e^{A r}`` and its integral, ``(v, q, d, d)`` each, of ``modes (q,)`` over ``durations (q,)``."""
        if self._has_dependence:
            return transitions(A[:, modes], durations[None])
        flows = np.empty((2, 1, durations.size, *A.shape[2:]))
        for mode in np.unique(modes):
            is_mode = modes == mode
            flows[0, 0, is_mode], flows[1, 0, is_mode] = self.exponentials(mode).transitions(durations[is_mode])
        return flows[0], flows[1]

    @cached_property
    def _has_dependence(self) -> bool:
        """True where the system depends on parameters, or changes with time."""
        return self.system.varies or self.system.parameters is not None

    def exponentials(self, mode: int = 0) -> Exponentials:
        """Return the exponentials of a mode of a known system."""
        return self.own(mode) if self.propagate is None else self.propagate

    def own(self, mode: int = 0) -> DoublingExponentials:
        """Return the exponentials of the matrix of a mode, without any structure of the matrix."""
        if mode not in self._exponentials:
            self._exponentials[mode] = DoublingExponentials(self.system.modes[mode].matrices(np.zeros((1, 0)))[0][0])
        return self._exponentials[mode]

    def _compute_varying_weights(self, times: Array, directions: Array, parameters: Array) -> Weights:
        """Return the weights of functionals (`weights`) for a system that changes with time, without an input matrix
        for every index."""
        unique, indices = unique_rows(parameters)
        steps, pieces, expansion = self.steps(unique), self.grid.locate(times), self.expansion
        order = np.argsort(-pieces, kind="stable")
        rows, at = np.array(directions, dtype=float)[order], pieces[order]
        starts = self.grid.breakpoints[at]
        if expansion is None:
            state, input_response = self.law.along(starts, np.maximum(times[order], starts), parameters[order])
        else:
            intervals, interval_indices = np.unique(
                np.stack([starts, np.maximum(times[order], starts)]), axis=1, return_inverse=True
            )
            key, interval_indices = intervals.tobytes(), interval_indices.reshape(-1)
            if key not in self._flows:
                remember(self._flows, key, self.law.over(intervals[0], intervals[1], parameters[:0]), FLOWS_KEPT)
            state, input_response = (flow[0, interval_indices] for flow in self._flows[key])
        weights = np.zeros((times.size, self.grid.pieces, input_response.shape[2]))
        weights[np.arange(times.size), at] = (rows[:, None] @ input_response)[:, 0]
        rows = (rows[:, None] @ state)[:, 0]
        self._propagate_by_recursion(steps.input_transitions, indices[order], at, rows, weights)
        inverse_order = np.empty_like(order)
        inverse_order[order] = np.arange(order.size)
        channels = self.system.controls
        return Weights(rows[inverse_order], weights[inverse_order, :, :channels], weights[inverse_order, :, channels:])

    @cached_property
    def marks(self) -> Array:
        """Breakpoints, and the times at which a system that changes with time becomes another polynomial in time.

        A time that differs from a breakpoint by rounding only counts as the breakpoint, unless another law begins
        there. Then the velocity of the state jumps at this time, however near it is to a breakpoint.
        """
        breaks = self.grid.breakpoints
        for expansion in self.law.expansions if self.system.varies else ():
            breaks = np.union1d(merge_breakpoints(breaks, expansion.ends[1:-1]), expansion.ends[list(expansion.turns)])
        return breaks

    @cached_property
    def expansion(self) -> Expansion | None:
        """System as polynomials in time, where it changes with time and is known; otherwise ``None``."""
        if self.given is not None:
            return self.given
        return Expansion.of(self.system) if self.system.varies and self.laws is None else None

    @property
    def slack(self) -> float:
        """Measure `Expansion.slack` of the relative error for a system that changes with time, the largest one of all
        parts; 0 for another system."""
        return max((expansion.slack for expansion in self.law.expansions), default=0.0) if self.system.varies else 0.0

    def _compute_varying_steps(self, parameters: Array) -> PieceTransitions:
        """Return the `PieceTransitions` of a system that changes with time, whose pieces are modes. ``Gamma`` is the
        length of a piece. ``B`` and ``E`` of a mode are the response of the state to an input on the piece, divided by
        its length."""
        points = parameters if self.laws is not None else parameters[:1]
        count, pieces, breaks, lengths = len(points), self.grid.pieces, self.grid.breakpoints, self.grid.lengths
        state, input_response = self.law.over(breaks[:-1], breaks[1:], points)
        d, m = state.shape[2], self.system.controls
        A = self.law.averages(breaks, points)
        Gamma = np.broadcast_to(np.eye(d) * lengths[:, None, None], (count, pieces, d, d))
        rates = (input_response / lengths[:, None, None]).swapaxes(1, 2)
        B, E = (np.ascontiguousarray(columns).reshape(count, d, -1) for columns in (rates[..., :m], rates[..., m:]))
        return PieceTransitions(A, B, E, state, Gamma, self._modes)

    def _compute_varying_adjoint(
        self, times: Array, directions: Array, parameters: Array
    ) -> tuple[Array, Array, Array, Array]:
        """Return the functionals (`adjoint`) for a system that changes with time. The part of a piece before a time has
        its own ``B`` and ``E``."""
        unique, indices = unique_rows(parameters)
        steps, pieces, m = self.steps(unique), self.grid.locate(times), self.system.controls
        starts, all_rows = self.grid.breakpoints[pieces], np.arange(times.size)
        state, input_response = self.law.along(starts, np.maximum(times, starts), parameters)
        d, L = directions.shape[1], self.grid.pieces
        gains, rows = np.zeros((times.size, L, d)), directions.astype(float)
        length = self.grid.lengths[pieces]
        gains[all_rows, pieces] = rows * length[:, None]
        B, E = steps.B[indices], steps.E[indices]
        for table, response in ((B, input_response[..., :m]), (E, input_response[..., m:])):
            table.reshape(times.size, d, L, -1)[all_rows, :, pieces] = response / length[:, None, None]
        rows = (rows[:, None] @ state)[:, 0]
        for piece in range(int(pieces.max(initial=0)) - 1, -1, -1):
            active = np.flatnonzero(pieces > piece)
            gains[active, piece] = rows[active] * self.grid.lengths[piece]
            transition = steps.Phi[:, piece]
            is_known = len(transition) == 1
            rows[active] = (
                rows[active] @ transition[0] if is_known else (rows[active, None] @ transition[indices[active]])[:, 0]
            )
        return rows, gains, B, E

    @shaped
    def adjoint(
        self, times: Float[Array, " k"], directions: Float[Array, "k d"], parameters: Float[Array, "k nu"]
    ) -> tuple[Float[Array, "k d"], Float[Array, "k L d"], Float[Array, "k d m"], Float[Array, "k d mw"]]:
        """Return the functional ``c'x(t)`` of each index, as weights on the initial state and on the forcing of every
        piece.

        ``times (k,)``, ``directions (k, d)``, ``parameters (k, nu)`` give ``free (k, d) = e^{A't} c``, ``gains (k, L,
        d) = int_{piece, s < t} e^{A'(t-s)} c ds``, and the input matrices ``B (k, d, J m)``, ``E (k, d, J mw)`` at the
        parameters; matrices of several modes are side by side (`TimeGrid.through`).
        """
        if self.system.varies:
            return self._compute_varying_adjoint(times, directions, parameters)
        if self.aged(parameters.shape[1]):
            free, (gains,) = self._compute_weights_by_age(times, directions, self._state_impulses)
            indices, steps = np.zeros(times.size, dtype=int), self.steps(np.zeros((1, 0)))
        else:
            free, gains, steps, indices = self._compute_weights_by_piece(times, directions, parameters, drives=True)
        return free, gains, steps.B[indices], steps.E[indices]

    @shaped
    def weights(
        self, times: Float[Array, " k"], directions: Float[Array, "k d"], parameters: Float[Array, "k nu"]
    ) -> Weights:
        """Return the functional ``c'x(t)`` of each index as weights on the initial state and on inputs: `adjoint` and
        `TimeGrid.through`, without ``(k, L, d)`` numbers."""
        if self.system.varies:
            return self._compute_varying_weights(times, directions, parameters)
        if self.aged(parameters.shape[1]):
            channels = self.steps(np.zeros((1, 0))).B.shape[2]
            free, (control, disturbance) = self._compute_weights_by_age(times, directions, self.inputs, channels)
            return Weights(free, control, disturbance)
        free, input_weights, steps, _ = self._compute_weights_by_piece(times, directions, parameters, drives=False)
        channels = steps.B.shape[2] // steps.A.shape[1]
        return Weights(free, input_weights[..., :channels], input_weights[..., channels:])

    def _compute_weights_by_piece(
        self, times: Array, directions: Array, parameters: Array, drives: bool
    ) -> tuple[Array, Array, PieceTransitions, np.ndarray]:
        """Return the weights of functionals on the initial state, ``(k, d)``, and on every input on every piece, ``(k,
        L, m + mw)``; with ``drives`` instead on the forcing of every piece, ``(k, L, d)``. Return the
        `PieceTransitions` at the distinct parameters, and the index of each parameter among them, too."""
        unique, indices = unique_rows(parameters)
        steps, pieces = self.steps(unique), self.grid.locate(times)
        order = np.argsort(-pieces, kind="stable")
        at, within = pieces[order], np.clip(times - self.grid.breakpoints[pieces], 0.0, None)[order]
        rows, last_weights = self._propagate_within_pieces(steps, indices[order], at, directions[order], within)
        if not drives:
            last_weights = (last_weights[:, None] @ steps.inputs[indices[order], self.grid.modes[at]])[:, 0]
        weights = np.zeros((times.size, self.grid.pieces, last_weights.shape[1]))
        weights[np.arange(times.size), at] = last_weights
        if drives or self._has_dependence:
            self._propagate_by_recursion(
                steps.driven if drives else steps.input_transitions, indices[order], at, rows, weights
            )
        else:
            self._stretches.on(at, rows, weights)
        inverse_order = np.empty_like(order)
        inverse_order[order] = np.arange(order.size)
        return rows[inverse_order], weights[inverse_order], steps, indices

    def _propagate_by_recursion(self, over: Array, mine: np.ndarray, at: np.ndarray, rows: Array, found: Array) -> None:
        """Propagate ``rows (k, d)`` from the beginnings of the pieces ``at (k,)``, in decreasing order, back to time 0,
        piece by piece. ``over (v, q, d, w + d)`` are the matrices, ``mine (k,)`` the index of each row's parameters.
        The weights on the pieces between are written to ``found (k, L, w)``, the rows at time 0 to ``rows``."""
        is_known, width, first = over.shape[0] == 1, found.shape[2], int(at[0]) if at.size else 0
        active_counts = np.searchsorted(-at, -np.arange(first)).tolist()  # how many functionals reach back to a piece
        row_matrices = over[mine, 0][:, None] if self.uniform and not is_known else None
        for piece in range(first - 1, -1, -1):
            active, length = active_counts[piece], self.which[piece]
            if is_known:
                products = rows[:active] @ over[0, length]
            else:
                matrices = over[mine[:active], length] if row_matrices is None else row_matrices[:active, 0]
                products = (rows[:active, None] @ matrices)[:, 0]
            found[:active, piece], rows[:active] = products[:, :width], products[:, width:]

    @cached_property
    def _stretches(self) -> Stretches:
        """Stretches of the response to inputs through the columns of ``B`` and of ``E``, for a known system."""
        steps = self.steps(np.zeros((1, 0)))
        return Stretches.of(self.which, steps.Gamma[0] @ steps.inputs[0, self._modes], steps.Phi[0])

    def _propagate_within_pieces(
        self, steps: PieceTransitions, which: np.ndarray, pieces: np.ndarray, rows: Array, within: Array
    ) -> tuple[Array, Array]:
        """Return ``c'e^{A r}`` and ``c'Gamma(r)``, ``(k, d)`` each, of ``rows (k, d)`` over parts ``within (k,)`` of
        their pieces. No matrix is made for a time where no parameter is uncertain."""
        modes = self.grid.modes[pieces]
        if not self._has_dependence:
            products = np.empty((2, *rows.shape))
            for mode in np.unique(modes):
                is_mode = modes == mode
                products[0, is_mode], products[1, is_mode] = self.exponentials(mode).rows(
                    rows[is_mode], within[is_mode]
                )
            return products[0], products[1]
        horizon = self.grid.breakpoints[-1]
        cases, case_indices = np.unique(
            np.stack([which, modes, np.round(within / horizon, 15)]), axis=1, return_inverse=True
        )
        flows = transitions(steps.A[cases[0].astype(int), cases[1].astype(int)], cases[2] * horizon)
        propagated, integrated = ((rows[:, None] @ flow[case_indices.reshape(-1)])[:, 0] for flow in flows)
        return propagated, integrated

    def weigh_part(self, pieces: np.ndarray, directions: Array, within: Array) -> tuple[Array, Array]:
        """Return the weights of functionals ``c'x``, ``directions (k, d)``, at times ``within (k,)`` their ``pieces
        (k,)``: on the state at the beginning of the piece, ``(k, d)``, and on the inputs on it, ``(k, m + mw)``. Only
        for a known system."""
        steps, none = self.steps(np.zeros((1, 0))), np.zeros(pieces.size, dtype=int)
        rows, integrated = self._propagate_within_pieces(steps, none, pieces, directions, within)
        return rows, (integrated[:, None] @ steps.inputs[0, self.grid.modes[pieces]])[:, 0]

    def aged(self, parameters: int) -> bool:
        """Return whether the weights on a piece depend only on its age, with so many ``parameters``."""
        return not parameters and self.uniform

    def _compute_weights_by_age(
        self, times: Array, directions: Array, impulses: Impulses, *ends: int
    ) -> tuple[Array, list[Array]]:
        """Return the weights of functionals on the initial state, ``(k, d)``, and on the columns of ``impulses`` on
        every piece. The columns are divided at ``ends`` into parts, ``(k, L, c)`` each."""
        pieces, steps = self.grid.locate(times), self.steps(np.zeros((1, 0)))
        rows, integrated = self._propagate_within_equal_pieces(steps, directions, times - self.grid.breakpoints[pieces])
        count = int(pieces.max(initial=0))
        all_rows, signs = np.arange(times.size), np.ones(times.size)
        distinct, indices = rows, all_rows
        if times.size > 1 and rows.shape[1] > FEW_STATES:
            # later times are shifts of one impulse response, and an opposite row has the opposite one
            signs = np.where(rows[all_rows, np.abs(rows).argmax(axis=1)] < 0.0, -1.0, 1.0)
            distinct, indices = _find_distinct_rows(rows * signs[:, None])
        by_age, last_weights = impulses.of(distinct, count), integrated @ impulses.columns
        limits = [0, *ends, last_weights.shape[1]]
        slices = [slice(*pair) for pair in pairwise(limits)]
        weights = [np.zeros((times.size, self.grid.pieces, columns.stop - columns.start)) for columns in slices]
        for number, (piece, row, sign) in enumerate(
            zip(pieces.tolist(), indices.tolist(), signs.tolist(), strict=True)
        ):
            if piece:
                backwards = by_age[row, piece - 1 :: -1]
                for gains, columns in zip(weights, slices, strict=True):
                    np.multiply(backwards[:, columns], sign, out=gains[number, :piece])
        for gains, columns in zip(weights, slices, strict=True):
            gains[all_rows, pieces] = last_weights[:, columns]
        return self._propagate_whole_pieces(rows, pieces), weights

    @cached_property
    def inputs(self) -> Impulses:
        """Impulse response to inputs through the columns of ``B`` and of ``E``, side by side."""
        steps = self.steps(np.zeros((1, 0)))
        return Impulses(self, np.concatenate([steps.B[0], steps.E[0]], axis=1))

    def _propagate_within_equal_pieces(
        self, steps: PieceTransitions, rows: Array, within: Array
    ) -> tuple[Array, Array]:
        """Return ``c'e^{A r}`` and ``c'Gamma(r)`` of ``rows (k, d)`` over parts ``within (k,)`` of equal pieces of a
        known system, ``(k, d)`` each."""
        length, tolerance = float(self.lengths[0]), STEP * float(self.grid.breakpoints[-1])
        is_whole = np.abs(within - length) <= tolerance
        if is_whole.all():
            return rows @ steps.Phi[0, 0], rows @ steps.Gamma[0, 0]
        return self.exponentials().rows(
            rows, np.where(np.abs(within) <= tolerance, 0.0, np.where(is_whole, length, within))
        )

    @shaped
    def backwards(
        self, times: Float[Array, " k"], directions: Float[Array, "r d"], parameter: Float[Array, " nu"]
    ) -> Float[Array, "k r d"]:
        """Return ``e^{A't} c (k, r, d)`` at all ``times (k,)`` for all ``directions (r, d)``, at one parameter. Parts
        of equal pieces are computed together first, whole pieces after."""
        (k, r), d = (times.size, directions.shape[0]), directions.shape[1]
        if not self.aged(parameter.size):
            exponentials = (
                DoublingExponentials(self.steps(parameter[None]).A[0, 0]) if self._has_dependence else self.own()
            )
            return exponentials.orbits(directions, times)[0]
        pieces = self.grid.locate(times)
        within, indices = self.grid.distinct(np.maximum(times - self.grid.breakpoints[pieces], 0.0))
        rows = self.own().orbits(directions, within)[0][indices].reshape(-1, d)
        return self._propagate_whole_pieces(rows, np.repeat(pieces, r)).reshape(k, r, d)

    def _propagate_whole_pieces(self, rows: Array, pieces: np.ndarray) -> Array:
        """Return ``rows (k, d)`` propagated over ``pieces (k,)`` whole pieces, ``(k, d)``."""
        free, common_pieces = rows.copy(), int(pieces[0]) if pieces.size and (pieces == pieces[0]).all() else None
        for level, transition in enumerate(self.transition_powers[: int(pieces.max(initial=0)).bit_length()]):
            if common_pieces is None:
                active = (pieces >> level & 1).nonzero()[0]
                free[active] = free[active] @ transition
            elif common_pieces >> level & 1:
                free = free @ transition
        return free

    @property
    def uniform(self) -> bool:
        """True where all pieces of the grid are equally long and of one mode."""
        return bool(self.lengths.size == 1) and not self.grid.varying

    def block(self, steps: PieceTransitions) -> int:
        """Return the number of equal pieces, a power of two, that are taken together where the states of many pieces
        are asked for; 1 for none. The system moves little over a block, so that the response to the inputs of a block
        alone is not much larger than the states."""
        if self.grid.pieces < 2 * FEWEST:
            return 1
        size = np.abs(steps.A)
        pace = max(float(min(matrix.sum(axis=0).max(), matrix.sum(axis=1).max())) for matrix in size[:, 0])
        bound = min(self.grid.pieces / FEWEST, LITTLE / max(pace * float(self.lengths[0]), TINY))
        return int(2 ** max(0, int(np.log2(max(1.0, bound)))))

    def products(self, pieces: int, block: int) -> int:
        """Return an upper bound of the number of products with transitions for the states on ``pieces`` pieces, from
        the beginning of one of the blocks: over blocks, down the tree of parts of one block, and up the tree of its
        inputs."""
        return pieces + 1 if block == 1 else -(-pieces // block) + 4 * block.bit_length()

    @cached_property
    def drift(self) -> float:
        """Upper bound of the distance of the breakpoints from those of equal pieces, rounding included."""
        breaks, length = self.grid.breakpoints, float(self.lengths[0])
        distance = np.abs(breaks - length * np.arange(breaks.size)).max()
        return float(distance + 4.0 * EPSILON * (breaks[-1] + self.grid.elapsed))

    def flows(self, durations: Array) -> tuple[Array, Array]:
        """Return ``e^{A r}`` and its integral ``(k, d, d)`` for durations ``(k,)``; for a known system."""
        return self.exponentials().transitions(durations)

    def flows_in(self, pieces: np.ndarray, durations: Array) -> tuple[Array, Array]:
        """Return ``e^{A r}`` and its integral ``(k, d, d)`` for durations ``(k,)`` of the systems that act on ``pieces
        (k,)`` of the grid."""
        A, modes = self.steps(np.zeros((1, 0))).A[0], self.grid.modes[pieces]
        flow, integral = np.empty((2, durations.size, *A.shape[1:]))
        for mode in np.unique(modes):
            is_mode = modes == mode
            distinct, indices = self.grid.distinct(durations[is_mode])
            flow[is_mode], integral[is_mode] = (
                matrices[indices] for matrices in self.exponentials(mode).transitions(distinct)
            )
        return flow, integral

    @cached_property
    def transition_powers(self) -> Array:
        """Transitions over 1, 2, 4, ... pieces, ``(q, d, d)``; for a known system and equal pieces."""
        return self.flows(2.0 ** np.arange(self.grid.pieces.bit_length()) * self.lengths[0])[0]

    def compute_transition_powers(self, steps: PieceTransitions, count: int) -> list[Array]:
        """Return the transposed transitions ``(v, d, d)`` over 1, 2, 4, ... equal pieces, ``count`` of them."""
        if self.system.parameters is None and steps.A.shape[:2] == (1, 1):
            return [transition.T[None] for transition in self.transition_powers[:count]]
        durations = 2.0 ** np.arange(count) * self.lengths[0]
        flows = self._compute_transitions(steps.A, np.zeros(count, dtype=int), durations)[0]
        return [np.swapaxes(flows[:, level], 1, 2) for level in range(count)]

    @cached_property
    def _state_impulses(self) -> Impulses:
        return Impulses(self, np.eye(self.system.states))

    @cached_property
    def kernel(self) -> Array:
        """Table ``e^{A i h} Gamma(h)`` for ``i = 0, ..., L - 1``, ``(d, L, d)``, of the impulse response in every
        direction of the state; for a known system and equal pieces."""
        return self._state_impulses.of(np.eye(self.system.states), self.grid.pieces)

    @cached_property
    def duration_errors(self) -> tuple[float, float]:
        """Upper bounds of the errors of durations. The first is that of pieces, where nearly equal ones are taken as
        equal. The second is that of times within a piece, which are rounded (`TimeGrid.distinct`)."""
        length_error, elapsed = np.abs(self.grid.lengths - self.lengths[self.which]).max(), self.grid.elapsed
        return float(length_error + EPSILON * elapsed), float(SAME_DURATION * (self.grid.breakpoints[-1] + elapsed))


@dataclass(frozen=True, eq=False)
class OutputResponse:
    """Outputs ``H x(t)`` at many ``times (T,)``, for rows ``H (r, d)``, at parameters ``points (v, nu)``, under any
    control.

    For a known system and equal pieces, the states at all breakpoints are not computed, only those at the beginning of
    blocks of pieces. The contributions of these states, and of the inputs within a block, to ``H x`` in the block are
    the same for every block.
    """

    propagator: Propagator
    H: Array
    times: Array
    points: Array

    @cached_property
    def within(self) -> tuple[np.ndarray, Array, np.ndarray]:
        """Piece of every time, the distinct durations ``(q,)`` since the beginning of a piece, and the index of each
        time among them, ``(T,)``; durations that differ by the rounding of breakpoints are one."""
        grid = self.propagator.grid
        pieces = grid.locate(self.times)
        elapsed = self.times - grid.breakpoints[pieces]
        order = np.argsort(elapsed, kind="stable")
        group = np.cumsum(np.diff(elapsed[order], prepend=elapsed[order[:1]]) > STEP * float(grid.breakpoints[-1]))
        indices = np.empty_like(group)
        indices[order] = group
        return pieces, np.bincount(indices, elapsed) / np.bincount(indices), indices

    @cached_property
    def _modes_and_durations(self) -> tuple[np.ndarray, Array, np.ndarray]:
        """Distinct modes and durations, ``(q,)`` each, and the index of every time among them, ``(T,)``. For a single
        mode the durations are those of `within`."""
        pieces, durations, duration_indices = self.within
        modes = self.propagator.grid.modes[pieces]
        kinds, kind_indices = np.unique(np.stack([modes, duration_indices]), axis=1, return_inverse=True)
        return kinds[0], durations[kinds[1]], kind_indices.reshape(-1)

    @cached_property
    def _steps(self) -> tuple[Array, Array]:
        """Products ``H e^{A r}`` and ``H Gamma(r)`` for the distinct modes and durations: ``(v, q, r, d)`` each."""
        steps, (modes, durations, _) = self.propagator.steps(self.points), self._modes_and_durations
        if steps.A.shape[0] > 1:
            flow, integral = transitions(steps.A[:, modes], durations[None])
            return self.H @ flow, self.H @ integral
        products = np.empty((2, 1, durations.size, *self.H.shape))
        for mode in np.unique(modes):
            is_mode = modes == mode
            exponentials = DoublingExponentials(steps.A[0, mode]) if self.points.shape[1] else self.propagator.own(mode)
            products[0, 0, is_mode], products[1, 0, is_mode] = exponentials.orbits(self.H, durations[is_mode])
        return products[0], products[1]

    @cached_property
    def _varying_responses(self) -> tuple[Array, Array] | None:
        """Response of the rows at every time to the state at the beginning of its piece, ``(v, T, r, d)``, and to the
        inputs on the piece, ``(v, T, r, m)``; for a system that changes with time, otherwise ``None``."""
        if not self.propagator.system.varies:
            return None
        starts = self.propagator.grid.breakpoints[self.within[0]]
        flow, forced = (
            self.H @ table for table in self.propagator.law.over(starts, np.maximum(self.times, starts), self.points)
        )
        return flow, forced[..., : self.propagator.system.controls]

    def at(self, response: Response, control: Array) -> Array:
        """Return the outputs ``(v, r, T)`` from the initial state of a response, under a control ``(m, K)`` on its own
        pieces."""
        steps, grid = self.propagator.steps(self.points), self.propagator.grid
        if self.propagator.aged(self.points.shape[1]) and self.propagator.block(steps) > 1:
            return self._propagate_in_blocks(response.initial_state, grid.inputs(control))[None]
        if self._varying_responses is not None:
            flow, forced = self._varying_responses
            nodes, inputs = response.nodes(control, self.points), grid.inputs(control).T
            pieces = self.within[0]
            forced_outputs = np.einsum("vtrm,tm->vrt", forced, inputs[pieces])
            return np.asarray(np.einsum("vtri,vti->vrt", flow, nodes[:, pieces]) + forced_outputs)
        nodes, drive = response.nodes(control, self.points), grid.driven(steps.B, grid.inputs(control))
        pieces, indices = self.within[0], self._modes_and_durations[2]
        flow, forced = (table[:, indices] for table in self._steps)
        outputs = np.einsum("vtri,vti->vrt", flow, nodes[:, pieces]) + np.einsum(
            "vtri,vti->vrt", forced, drive[:, pieces]
        )
        return np.asarray(outputs)

    def _propagate_in_blocks(self, initial_state: Array, inputs: Array) -> Array:
        """Return the outputs ``(r, T)`` from an initial state and inputs ``(m, L)``, block by block."""
        block, first, count = self._block_layout
        state_response, input_response = self._output_responses
        pieces, durations, indices = self.within
        m, d = inputs.shape[0], initial_state.size
        padded = np.zeros(((first + count) * block, m))
        kept = min(padded.shape[0], inputs.shape[1])
        padded[:kept] = inputs[:, :kept].T
        by_block = padded.reshape(first + count, block * m)
        block_states, forced_states = np.empty((first + count, d)), by_block @ self._block_input_response
        block_states[0], transition = initial_state, self._block_transition
        for number in range(1, first + count):
            block_states[number] = transition @ block_states[number - 1] + forced_states[number - 1]
        outputs = block_states[first:] @ state_response + by_block[first:] @ input_response
        by_piece = outputs.reshape(count * block, durations.size, self.H.shape[0])
        return np.asarray(by_piece[pieces - first * block, indices].T)

    @cached_property
    def _block_layout(self) -> tuple[int, int, int]:
        """Number of pieces of a block, the first block that contains a time, and the number of blocks from it to the
        last one that does."""
        steps, pieces = self.propagator.steps(self.points), self.within[0]
        block = min(BLOCK, self.propagator.block(steps))
        first = int(pieces.min()) // block
        return block, first, int(pieces.max()) // block + 1 - first

    @cached_property
    def _block_transition(self) -> Array:
        """Transition over a block, ``(d, d)``."""
        steps, block = self.propagator.steps(self.points), self._block_layout[0]
        return np.asarray(transitions(steps.A[0, 0], block * self.propagator.lengths[:1])[0][0])

    @cached_property
    def _block_input_response(self) -> Array:
        """Response of the state at the end of a block to the inputs of the block, ``(block m, d)``."""
        block, m = self._block_layout[0], self.propagator.steps(self.points).B.shape[2]
        responses = self.propagator.inputs.of(np.eye(self.H.shape[1]), block)  # (d, block, m + mw)
        return np.ascontiguousarray(responses[:, ::-1, :m].reshape(responses.shape[0], -1).T)

    @cached_property
    def _output_responses(self) -> tuple[Array, Array]:
        """Response of ``H x`` on the pieces of a block, for all distinct durations, to the state at its beginning,
        ``(d, block q r)``, and to the inputs in it, ``(block m, block q r)``."""
        steps, block = self.propagator.steps(self.points), self._block_layout[0]
        flow, integral = (table[0].reshape(-1, self.H.shape[1]) for table in self._steps)  # (q r, d)
        m, rows = steps.B.shape[2], flow.shape[0]
        state_response = np.empty((block, rows, self.H.shape[1]))
        state_response[0] = flow
        for piece in range(1, block):
            state_response[piece] = state_response[piece - 1] @ steps.Phi[0, 0]
        older = self.propagator.inputs.of(flow, block)[:, :, :m]  # (q r, block, m)
        input_response = np.zeros((block, m, block, rows))
        for piece in range(block):
            input_response[piece, :, piece] = (integral @ steps.B[0]).T
            input_response[:piece, :, piece] = older[:, :piece][:, ::-1].transpose(1, 2, 0)
        return state_response.reshape(block * rows, -1).T, input_response.reshape(block * m, block * rows)


@dataclass(frozen=True, eq=False)
class Response:
    """Responses of one system on one time grid, from one initial state ``(d,)``.

    Everything that does not depend on the initial state is in the ``propagator``, which responses from other initial
    states (`from_state`) share. With an ``inner`` loop, the control whose weights and states these are is what is
    decided beside that feedback; `steps` and `flows` are those of the system alone.
    """

    system: System
    grid: TimeGrid
    initial_state: Array
    propagate: Exponentials | None = None
    shared: Propagator | None = field(default=None, repr=False)
    inner: InnerLoop = NO_INNER_LOOP

    @cached_property
    def propagator(self) -> Propagator:
        """Transition matrices and functionals; the ``shared`` ones where they are of this system on this grid."""
        shared = self.shared
        if shared and shared.system is self.system and shared.grid is self.grid and shared.propagate is self.propagate:
            return shared
        return Propagator(self.system, self.grid, self.propagate)

    @shaped
    def from_state(self, initial_state: Float[Array, " d"]) -> Response:
        """Return the responses of the same system from another initial state ``(d,)``."""
        return Response(self.system, self.grid, initial_state, self.propagate, self.propagator, self.inner)

    @cached_property
    def bare(self) -> Response:
        """Responses of the same system without the inner loop."""
        return replace(self, inner=NO_INNER_LOOP, shared=self.propagator) if self.inner.acts else self

    @shaped
    def at(self, parameter: Float[Array, " nu"]) -> Response:
        """Return the responses of the known system at one parameter; this response where there are no parameters."""
        system = self.system.at(parameter)
        return self if system is self.system else Response(system, self.grid, self.initial_state)

    @shaped
    def steps(self, parameters: Float[Array, "v nu"]) -> PieceTransitions:
        """Return the matrices and the transitions over whole pieces at parameters ``(v, nu)`` (`Propagator.steps`)."""
        return self.propagator.steps(parameters)

    @shaped
    def adjoint(
        self, times: Float[Array, " k"], directions: Float[Array, "k d"], parameters: Float[Array, "k nu"]
    ) -> tuple[Float[Array, "k d"], Float[Array, "k L d"], Float[Array, "k d m"], Float[Array, "k d mw"]]:
        """Return functionals as weights on the initial state and on the forcing of every piece
        (`Propagator.adjoint`)."""
        return self.propagator.adjoint(times, directions, parameters)

    @shaped
    def weights(
        self, times: Float[Array, " k"], directions: Float[Array, "k d"], parameters: Float[Array, "k nu"]
    ) -> Weights:
        """Return functionals as weights on the initial state and on inputs (`Propagator.weights`)."""
        return self.inner.weights(self.propagator, times, directions, parameters)

    def weigh_controls(self, controls: Array) -> Weights:
        """Return functionals of what the inner loop adds to the control (`InnerLoop.weigh_controls`)."""
        return self.inner.weigh_controls(self.propagator, controls)

    def numbers(self, parameters: int) -> int:
        """Return how many numbers `weights` holds at once for one index, with so many ``parameters``."""
        system, grid = self.system, self.grid
        width = system.states if parameters else system.controls + system.disturbances
        if self.propagator.laws is not None:  # transitions of every piece
            width *= system.states + system.controls + system.disturbances
        return int(grid.pieces * width)

    def flows(self, durations: Array) -> tuple[Array, Array]:
        """Return ``e^{A r}`` and its integral ``(k, d, d)`` for durations ``(k,)`` (`Propagator.flows`)."""
        return self.propagator.flows(durations)

    @property
    def uniform(self) -> bool:
        """True where all pieces of the grid are equally long and of one mode (`Propagator.uniform`)."""
        return self.propagator.uniform

    @property
    def which(self) -> np.ndarray:
        """Index of every piece among the distinct modes and lengths (`Propagator.which`)."""
        return self.propagator.which

    @shaped
    def states(
        self,
        control: Float[Array, "m K"],
        parameters: Float[Array, "v nu"],
        disturbance: Float[Array, "vw mw M"] | None = None,
        deviations: Float[Array, "vd d"] | None = None,
    ) -> Float[Array, "vx points d"]:
        """Return the states ``(v, L+1, d)`` at the breakpoints of the grid.

        ``control (m, K)`` on the control's pieces (`TimeGrid.inputs`), ``parameters (v, nu)`` (one row serves all
        disturbances), ``disturbance (v, mw, M)`` on the disturbance's pieces or ``None``, ``deviations (v, d)`` of the
        initial state.
        """
        steps = self.steps(parameters)
        count = max(samples.shape[0] for samples in (parameters, disturbance, deviations) if samples is not None)
        drive = self.grid.driven(steps.B, self.grid.inputs(control))
        if disturbance is not None:
            drive = drive + self.grid.driven(steps.E, disturbance[:, :, self.grid.disturbance_piece])
        path = np.empty((count, self.grid.pieces + 1, self.initial_state.size))
        path[:, 0] = self.initial_state if deviations is None else self.initial_state + deviations
        if self.inner.acts:
            return self.inner.states(self.propagator, path[:, 0], np.broadcast_to(drive, (count, *drive.shape[1:])))
        shared, lengths = steps.Phi.shape[0] == 1, self.which.tolist()

        def multiply(matrices: Array, vectors: Array) -> Array:
            return np.asarray(vectors @ matrices[0].T if shared else (matrices @ vectors[..., None])[..., 0])

        if self.uniform:
            path[:, 1:] = drive @ steps.Gamma[:, 0].swapaxes(1, 2)
            block = self.propagator.block(steps)
            if block > 1:
                return self._propagate_in_blocks(path, steps, block)
        else:
            for piece, length in enumerate(lengths):
                path[:, piece + 1] = multiply(steps.Gamma[:, length], drive[:, piece])
        if shared and self.uniform:
            Phi = steps.Phi[0, 0].T
            for piece in range(self.grid.pieces):
                path[:, piece + 1] += path[:, piece] @ Phi
            return path
        for piece, length in enumerate(lengths):
            path[:, piece + 1] += multiply(steps.Phi[:, length], path[:, piece])
        return path

    def nodes(self, control: Array, parameters: Array) -> Array:
        """Return the `states` without a disturbance, remembered for the last control, since all constraints ask for
        them."""
        key = control.tobytes() + parameters.tobytes()
        if key not in self._node_cache:
            exact = None if self.orbit is None else self.orbit.states(control)[0][None]
            remember(self._node_cache, key, self.states(control, parameters) if exact is None else exact, 1)
        return self._node_cache[key]

    @cached_property
    def orbit(self) -> Orbit | None:
        """The states of a plant that grows by much, in more digits; ``None`` for others, and beside an inner loop."""
        orbit = None if self.inner.acts else self.propagator.orbit
        return None if orbit is None else orbit.from_state(self.initial_state)

    @cached_property
    def _node_cache(self) -> dict[bytes, Array]:
        return {}

    def _propagate_in_blocks(self, path: Array, steps: PieceTransitions, block: int) -> Array:
        """Solve ``x_{k+1} = Phi x_k + f_k`` in blocks, from a ``path (v, L+1, d)`` that holds ``x_0, f_0, f_1, ...``;
        return the path of the states.

        First the responses to the inputs of a block alone are added up, two neighbouring parts at a time. Then follow
        the states at the ends of blocks, and last the states inside, each from the part that ends there (Blelloch
        1990). No state goes through more products than `Propagator.products`, and rounding errors do not grow with the
        pieces of a block.
        """
        powers = self.propagator.compute_transition_powers(steps, block.bit_length())
        processed, v, d = 0, path.shape[0], path.shape[2]
        sizes = [block] + [block >> shift for shift in range(1, block.bit_length())]  # the last block may be shorter
        for size in sizes:
            count, levels = (self.grid.pieces - processed) // size, size.bit_length() - 1
            if not count:
                continue
            inside = path[:, processed + 1 : processed + count * size + 1].reshape(v, count, size, d)
            for level in range(levels):
                step = 2**level
                inside[:, :, 2 * step - 1 :: 2 * step] += _apply_transition(
                    inside[:, :, step - 1 :: 2 * step], powers[level]
                )
            starts = np.empty((v, count, 1, d))
            starts[:, 0, 0] = path[:, processed]
            for number in range(count):
                inside[:, number, -1:] += starts[:, number] @ powers[levels]
                if number + 1 < count:
                    starts[:, number + 1] = inside[:, number, -1:]
            for level in range(levels - 1, -1, -1):
                step = 2**level
                before = np.concatenate([starts, inside[:, :, 2 * step - 1 :: 2 * step][:, :, :-1]], axis=2)
                inside[:, :, step - 1 :: 2 * step] += _apply_transition(before, powers[level])
            processed += count * size
        return path


def _apply_transition(states: Array, transition: Array) -> Array:
    """Return ``(v, count, k, d)`` states, as rows, times the transposed transitions ``(v, d, d)``."""
    return np.asarray(states.reshape(states.shape[0], -1, states.shape[3]) @ transition).reshape(states.shape)


@shaped
def unique_rows(rows: Float[Array, "k n"]) -> tuple[Float[Array, "u n"], Int[np.ndarray, " k"]]:
    """Return the distinct rows in increasing order, and the index of every row among them.

    Copies are found by their bytes first: sorting long rows would read all their numbers for every comparison.
    """
    if rows.shape[1] == 0 or rows.shape[0] == 1:
        return rows[:1], np.zeros(rows.shape[0], dtype=int)
    distinct, row_index = _find_distinct_rows(rows)
    unique, indices = np.unique(distinct, axis=0, return_inverse=True)
    return unique, indices.reshape(-1)[row_index]


def _find_distinct_rows(rows: Array) -> tuple[Array, np.ndarray]:
    """Return the distinct rows in the order of their first occurrence, and the index of every row among them."""
    index_of: dict[bytes, int] = {}
    is_new = np.append(True, (rows[1:] != rows[:-1]).any(axis=1))  # a repeated row is looked at once
    # adding 0 turns -0 into 0
    indices = np.array([index_of.setdefault(row.tobytes(), len(index_of)) for row in rows[is_new] + 0.0], dtype=int)
    indices = indices[np.cumsum(is_new) - 1]
    if len(index_of) == len(rows):
        return rows, indices
    first = np.empty(len(index_of), dtype=int)
    first[indices[::-1]] = np.arange(indices.size)[::-1]
    return rows[first], indices
