"""Uncertain system over a cell of parameters, as one larger known system.

With ``p = centre + radius delta`` and ``A(p) = sum_g A_g delta^g + remainder``, the Taylor coefficients of the state in
``delta`` obey ``x_a' = sum_{g + b = a} A_g x_b + B_a u``: a known linear system of dimension ``d M``, propagated by its
exponentials. The truncation error, and the rounding errors of the change to coordinates in which the modes are apart,
obey the same equation with a small forcing. Both are bounded by Gronwall's inequality, mode by mode. A known system is
the case ``M = 1`` without truncation.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np

from sparserob_core.control.enclosures.algebra import (
    flows_of,
    flows_rounding,
    lifted_matrix,
    lifted_transitions,
    multiplied,
)
from sparserob_core.control.enclosures.cache import remember
from sparserob_core.control.enclosures.comparison import (
    ComparisonSystem,
    NormBounds,
    alike,
    block_norms,
    block_sizes,
    comparison_matrix,
    finite,
    product,
    rising,
)
from sparserob_core.control.enclosures.decoupling import (
    Decoupling,
    decoupled,
    decoupled_rounding,
    decoupled_transitions,
    identity,
)
from sparserob_core.control.enclosures.flows import Flows
from sparserob_core.control.problem.phase import Phase
from sparserob_core.control.problem.system import LinearSystem
from sparserob_core.control.response.orbit import Orbit
from sparserob_core.control.response.response import TINY, Response
from sparserob_core.control.response.time_grid import TimeGrid
from sparserob_core.sip.convex_set import Array
from sparserob_core.sip.expressions.rounding import rounding
from sparserob_core.sip.expressions.taylor import TaylorSpace, taylor_space

DEGREES = {0: 0, 1: 6, 2: 4, 3: 3}  # of the Taylor models, by the number of parameters; 2 beyond
KNOWN = np.zeros((1, 0))
# growth of the comparison system times length of the parts that pieces are cut into for what is neglected, and how
# many of a piece at most
SHORT, MAX_CUTS = 0.5, 64
LONG_STEP = 1.0  # in norm times duration: longer steps are taken by matrix exponentials
TAYLOR_TERMS = 1e-17  # relative size below which further terms of the exponential series are left out
PATHS_KEPT, PATHS_SIZE = 4, 20_000_000  # paths that are remembered, and the numbers in all of them beyond the first
# Numbers in exponentials that are kept, for the same times are asked for in every direction. With a tenth of them those
# of a dozen times of four states with a parameter are forgotten; ten times as many are 80 MB a cell of parameters.
FLOWN_SIZE = 500_000
SPANS = 256  # of several pieces each, for which what is left out is bounded, where there are four times as many pieces


@dataclass(frozen=True, eq=False)
class Past:
    """Phase before a phase of a switched system, with the change of coordinates between the two.

    ``lifted``: the lifted system of the phase before. ``turn (d, d)``: the matrix from its coordinates to the new ones,
    with an error of at most ``slip (d, d)`` entry by entry. ``starts (q,)``: the indices at which the blocks of the new
    coordinates begin. ``effects``: remembered effects of the disturbance on the state.
    """

    lifted: LiftedSystem
    turn: Array
    slip: Array
    starts: np.ndarray
    effects: dict[int, object] = field(default_factory=dict, repr=False)

    @cached_property
    def blocks(self) -> Array:
        """Norm bounds ``(q, q')`` of the blocks of ``turn``: from norms of the old blocks to those of the new ones."""
        squares = np.add.reduceat((np.abs(self.turn) + self.slip) ** 2, self.starts, axis=0)
        return np.asarray(
            np.sqrt(np.add.reduceat(squares, self.lifted.starts, axis=1)) * (1.0 + rounding(squares.size))
        )

    def rounded(self, sizes: Array) -> Array:
        """Return upper bounds ``(q,)`` of the error of the change of coordinates, for vectors whose entries are at most
        ``sizes (d,)``."""
        errors = (self.slip + rounding(self.turn.shape[0]) * np.abs(self.turn)) @ sizes
        return np.asarray(block_norms(errors, self.starts))


@dataclass(frozen=True, eq=False)
class LiftedSystem:
    """Taylor models of a system over the cell ``centre +- radius`` (``(nu,)`` each) on a time grid, in the coordinates
    ``x = T z`` of a `Decoupling` with ``q`` blocks.

    ``A (M, d, d)``, ``B (M, d, m)``, ``W (M, d, mw)`` are the coefficients. ``slack_A (q, q)``, ``slack_B (q, m)``,
    ``slack_W (q, mw)``, ``slack_x (q,)`` bound, block by block, the remainders of these and of ``initial_state``.
    ``past``: for a later phase of a switched system, the phase before it, at whose end this one begins; time 0 is then
    there. ``orbit``: the states at the breakpoints, of a plant that grows by much.
    """

    space: TaylorSpace
    grid: TimeGrid
    initial_state: Array
    A: Array
    B: Array
    W: Array
    decoupling: Decoupling
    slack_A: Array
    slack_B: Array
    slack_W: Array
    slack_x: Array
    past: Past | None = None
    orbit: Orbit | None = None

    @property
    def first(self) -> int:
        """Number of pieces before this phase."""
        return 0 if self.past is None else self.past.lifted.first + self.past.lifted.grid.pieces

    @property
    def turn(self) -> int:
        """Number of phases before this one."""
        return 0 if self.past is None else self.past.lifted.turn + 1

    @property
    def transform(self) -> Array:
        """Matrix ``T (d, d)``, with ``x = T z``."""
        return self.decoupling.transform

    @property
    def starts(self) -> np.ndarray:
        """Indices at which the blocks of the coordinates begin, ``(q,)``."""
        return self.decoupling.starts

    @property
    def states(self) -> int:
        return int(self.A.shape[1])

    @cached_property
    def comparison(self) -> ComparisonSystem:
        """Bounds of the lifted system: for its Taylor coefficients, the norms of every block summed over them."""
        sizes = block_sizes(self.A, self.starts)
        variation = sizes[1:].sum(axis=0) + self.slack_A
        return ComparisonSystem(comparison_matrix(self.A[0], self.starts) + variation, sizes[0] + variation)

    @cached_property
    def norm(self) -> float:
        """Upper bound of the 2-norm of the lifted matrix, on columns and on rows (Golub and Van Loan 2013, 2.3.3)."""
        size = max(
            np.abs(matrix).sum(axis=0).max() * np.abs(matrix).sum(axis=1).max()
            for matrix in (self.matrix, self.row_matrix)
        )
        return float(np.sqrt(size))

    @cached_property
    def matrix(self) -> Array:
        """Lifted matrix ``(M d, M d)`` that acts on columns: block (target, source) is ``A_g`` with ``g + source =
        target``."""
        return lifted_matrix(self.space, self.A, rows=False)

    @cached_property
    def row_matrix(self) -> Array:
        """Lifted matrix that acts on rows from the right."""
        return lifted_matrix(self.space, self.A, rows=True)

    @cached_property
    def fine(self) -> TimeGrid:
        """Grid with long pieces cut into equal parts: a norm bound over a part is only good if the modes grow little on
        it."""
        if not self.space.nu:  # without truncation there is little to bound
            return self.grid
        growth = float(np.abs(np.linalg.eigvals(self.comparison.rising)).max())
        counts = np.clip(np.ceil(growth * self.grid.lengths / SHORT), 1, MAX_CUTS).astype(int)
        breaks = self.grid.breakpoints
        if counts.max() == 1:
            return self.grid
        inner = [
            np.linspace(a, b, count, endpoint=False)
            for a, b, count in zip(breaks[:-1], breaks[1:], counts, strict=True)
        ]
        return TimeGrid(
            np.concatenate([*inner, breaks[-1:]]),
            np.repeat(self.grid.control_piece, counts),
            np.repeat(self.grid.disturbance_piece, counts),
            self.grid.before,
            self.grid.constants,
            elapsed=self.grid.elapsed,
        )

    @cached_property
    def spans(self) -> np.ndarray:
        """First piece of the fine grid in every span, ``(S,)``. Remainders are bounded span by span. For a known
        system, whose remainder is rounding only, a span may be many pieces on which the system moves little."""
        pieces = self.fine.pieces
        if self.space.nu or self.orbit is not None or pieces < 4 * SPANS:
            return np.arange(pieces)
        growth = float(np.abs(np.linalg.eigvals(self.comparison.rising)).max()) * float(self.fine.lengths.max())
        count = int(max(1.0, min(pieces // SPANS, SHORT / max(growth, TINY))))
        return np.arange(0, pieces, max(1, count // self._block_size) * self._block_size)

    @cached_property
    def _block_size(self) -> int:
        """Number of pieces in which the states are computed at once; every span begins where such a block does."""
        forward = self.forward
        return forward.propagator.block(forward.steps(KNOWN)) if forward.uniform else 1

    @cached_property
    def span(self) -> np.ndarray:
        """Span to which every piece of the fine grid belongs, ``(L',)``."""
        return np.repeat(np.arange(self.spans.size), self._piece_counts)

    @cached_property
    def _piece_counts(self) -> np.ndarray:
        return np.diff(np.append(self.spans, self.fine.pieces))

    @cached_property
    def _span_durations(self) -> Array:
        """Durations of the spans, ``(S,)``."""
        return np.diff(self.fine.breakpoints[np.append(self.spans, self.fine.pieces)])

    @cached_property
    def ends(self) -> np.ndarray:
        """Indices of the breakpoints of the grid among those of the fine grid, ``(L+1,)``."""
        return np.searchsorted(self.fine.breakpoints, self.grid.breakpoints)

    @cached_property
    def forward(self) -> Response:
        """Lifted system as a response on the fine grid; its states are the Taylor coefficients of the state, ``(M
        d,)``."""
        start = np.zeros(self.matrix.shape[0])
        start[: self.states] = self.initial_state
        drive = self.B.reshape(-1, self.B.shape[2])
        return Response(LinearSystem(self.matrix, drive), self.fine, start, self._build_exponentials(rows=False))

    @cached_property
    def backward(self) -> Response:
        """Adjoint of the lifted system; its functionals are Taylor coefficients of ``c'e^{A(p) t}``."""
        return self._build_adjoint(self.grid)

    @cached_property
    def _backward_fine(self) -> Response:
        return self.backward if self.fine is self.grid else self._build_adjoint(self.fine)

    def _build_adjoint(self, grid: TimeGrid) -> Response:
        size = self.row_matrix.shape[0]
        drive = LinearSystem(self.row_matrix, np.zeros((size, 1)))
        return Response(drive, grid, np.zeros(size), self._build_exponentials(rows=True))

    def _build_exponentials(self, rows: bool) -> LiftedExponentials:
        return LiftedExponentials(self, rows)

    def nodes(self, control: Array) -> Array:
        """Return the Taylor coefficients ``(L+1, M, d)`` of the state at the breakpoints, under ``control (m, K)``."""
        path = self._compute_path(control)
        return path if self.fine is self.grid else path[self.ends]

    def propagate(self, within: Array, pieces: np.ndarray, start_states: Array, inputs: Array) -> Array:
        """Return the coefficients ``(k, M, d)`` at times ``within (k,)`` the ``pieces (k,)``, from those at their
        beginning, ``start_states (k, M, d)``, under ``inputs (k, m)``. Short steps use the exponential series, long
        ones matrix exponentials."""
        start = start_states.reshape(within.size, -1)
        size = self.norm * float(within.max(initial=0.0))
        if size < LONG_STEP:
            coefficients = self._propagate_by_series(
                start, start @ self.matrix.T + self._compute_forcing(inputs), within[:, None], size
            )
        else:
            coefficients = self._propagate_columns(start, self._compute_forcing(inputs), within)
        return np.asarray(coefficients.reshape(within.size, self.space.size, -1))

    def _propagate_columns(self, start: Array, drives: Array, within: Array) -> Array:
        """Return the coefficients ``(k, M d)`` after durations ``(k,)`` under the forcing ``drives (k, M d)``, by
        matrix exponentials."""
        if not self.space.nu:
            return self.flows.columns(start, drives, within)
        distinct, indices = self.grid.distinct(within)
        flow, integral = self.forward.flows(distinct)
        coefficients = np.einsum("kij,kj->ki", flow[indices], start)
        return np.asarray(coefficients + np.einsum("kij,kj->ki", integral[indices], drives))

    @cached_property
    def flows(self) -> Flows:
        """Exponentials of a known system on vectors."""
        return Flows(self.decoupling, self.A[0])

    def flown(self, rows: Array, durations: Array) -> tuple[Array, Array]:
        """Return lifted functionals ``(k, r, M d)`` propagated backwards over durations ``(k,)``, and their integrals
        over these."""
        if not self.space.nu:
            return self.flows.rows(rows, durations)
        distinct, indices = self.grid.distinct(durations)
        key, size = distinct.tobytes(), distinct.size * self.row_matrix.size
        flows = self._flow_cache.get(key)
        if flows is None:
            flows = self.backward.flows(distinct)
            if size <= FLOWN_SIZE:
                remember(self._flow_cache, key, flows, max(1, FLOWN_SIZE // size))
        flow, integral = flows
        return rows @ flow[indices], rows @ integral[indices]

    @cached_property
    def _flow_cache(self) -> dict[bytes, tuple[Array, Array]]:
        return {}

    def _propagate_by_series(self, start: Array, slopes: Array, within: Array, size: float) -> Array:
        """Return the coefficients after short steps by the exponential series; no matrix is built."""
        total, term, order, bound = start + within * slopes, slopes, 1, size
        while bound > TAYLOR_TERMS:
            order += 1
            term = term @ self.matrix.T * (within / order)
            total = total + within * term
            bound *= size / order
        return total

    def _compute_forcing(self, inputs: Array) -> Array:
        """Return the forcing of the Taylor coefficients, ``(k, M d)``, under inputs ``(k, m)``."""
        return np.asarray(inputs @ self.B.reshape(-1, self.B.shape[2]).T)

    def deviation(
        self, rows: Array, start: Array, width: Array, pieces: np.ndarray, states: Array, inputs: Array
    ) -> Array:
        """Return bounds ``(k, r)`` of the distance of ``rows (r, d)`` of the state from their chords, summed over the
        Taylor coefficients (`EnclosedMotion.deviation`).

        They are the smaller of two: by the second derivative of the rows in time, and mode by mode by the second
        derivative or by twice the distance that the mode can move (as in `DisturbanceSupport.deviation`).
        """
        slopes = states.reshape(start.size, -1) @ self.matrix.T + self._compute_forcing(inputs)
        curvature = (slopes @ self.matrix.T).reshape(states.shape)
        row_curvature = np.abs(np.einsum("ri,kai->kra", rows, curvature)).sum(axis=2)
        slope_norms, curvature_norms = (
            block_norms(derivative.reshape(states.shape), self.starts).sum(axis=1) for derivative in (slopes, curvature)
        )
        reach = self.comparison.over(width, cells=True)
        square, norms = (width**2 / 8)[:, None], block_norms(rows, self.starts)
        exact = square * (row_curvature + product(norms, reach.departure.on(curvature_norms).T).T)
        by_mode = np.minimum(square * reach.peak.on(curvature_norms), 2.0 * reach.integral.on(slope_norms))
        return np.asarray(np.minimum(exact, product(norms, by_mode.T).T))

    @property
    def influence(self) -> Array:
        """Influence of every parameter on the remainder, ``(nu,)``: the size of its first-order part in the system."""
        if not self.space.degree:
            return np.ones(self.space.nu)
        indices = [self.space.index[tuple(unit)] for unit in np.eye(self.space.nu, dtype=int).tolist()]
        return np.array(
            [sum(float(np.linalg.norm(coefficients[i])) for coefficients in (self.A, self.B, self.W)) for i in indices]
        )

    def along(self, control: Array, rows: Array, others: Array) -> Array:
        """Return sums ``(r, L)`` of norm bounds on every piece of the grid, block by block (`EnclosedMotion.along`).

        ``rows (r, q)`` are the weights of the remainder of the Taylor models of the state, rounding included, and
        ``others (r, q)`` those of the models themselves, summed over their coefficients.
        """
        remainders, sizes, _ = self._get_remainder_bounds(control)
        answer: Array = product(rows, remainders.T) + product(others, sizes.T)
        return answer[:, self.span] if self.spans.size < self.fine.pieces else answer

    def _get_remainder_bounds(self, control: Array) -> tuple[Array, Array, Array]:
        """Return the two bounds of `along`, ``(L, q)`` each, on the spans where these are many pieces, and the bound
        of the remainder at the end, ``(q,)``; remembered."""
        key = control.tobytes()
        if key not in self._remainder_cache:
            remember(self._remainder_cache, key, self._compute_remainder_bounds(control), PATHS_KEPT)
        return self._remainder_cache[key]

    @cached_property
    def _remainder_cache(self) -> dict[bytes, tuple[Array, Array, Array]]:
        return {}

    def _compute_remainder_bounds(self, control: Array) -> tuple[Array, Array, Array]:
        inputs, slack = np.abs(self.fine.inputs(control)), self._bound_initial_remainder(control)[None]
        size = np.abs(self.B).sum(axis=0)
        if self.spans.size < self.fine.pieces:
            largest_inputs = np.maximum.reduceat(inputs, self.spans, axis=1)
            forcing_norms, drive = (
                block_norms((size @ largest_inputs).T, self.starts),
                (self.slack_B @ largest_inputs).T[None],
            )
            begin = block_norms(self._compute_path(control)[self.spans, 0], self.starts)[None]
            neglected, bounds, size_bounds = self._bound_error(
                begin, forcing_norms, drive, slack, rows=False, jumps=self._sum_jumps(control, size)
            )
            return neglected[0], size_bounds[0], bounds[0, -1]
        forcing = self.fine.inputs(control).T @ self.forward.steps(KNOWN).B[0].T
        nodes = self._compute_path(control)[None]
        sizes = self._bound_sizes(nodes, forcing, rows=False)
        forcing_norms, drive = block_norms((size @ inputs).T, self.starts), (self.slack_B @ inputs).T[None]
        begin = block_norms(nodes[:, :-1], self.starts).sum(axis=2)
        residual = self._bound_residual(sizes, rows=False) + drive
        errors = None if self.orbit is None else self._transform_orbit(self.orbit, control)[1][None]
        neglected, bounds, _ = self._bound_error(begin, forcing_norms, residual, slack, rows=False, ends=errors)
        first = self.ends[:-1]
        remainders: Array = np.maximum.reduceat(neglected[0], first, axis=0)
        return remainders, np.maximum.reduceat(sizes[0].sum(axis=1), first, axis=0), bounds[0, -1]

    def _sum_jumps(self, control: Array, size: Array) -> Array:
        """Return norm bounds ``(S, q)`` of the sum of the jumps of the forcing of each block within each span."""
        inputs = self.fine.inputs(control)
        jumps = np.abs(np.diff(inputs, axis=1, prepend=inputs[:, :1]))
        jumps[:, self.spans] = 0.0
        return block_norms((size @ np.add.reduceat(jumps, self.spans, axis=1)).T, self.starts)

    def _bound_initial_remainder(self, control: Array) -> Array:
        """Return norm bounds ``(q,)`` of the remainder of the Taylor models at time 0, the beginning of this phase."""
        if self.past is None:
            return self.slack_x
        before, final_sizes = self.past.lifted, np.abs(self.past.lifted.nodes(control)[-1]).sum(axis=0)
        return np.asarray(
            product(self.past.blocks, before._get_remainder_bounds(control)[2][:, None])[:, 0]
            + self.past.rounded(final_sizes)
        )

    def _compute_path(self, control: Array) -> Array:
        """Return the Taylor coefficients of the state at the breakpoints of the fine grid, remembered: all directions
        of a cell share them."""
        key = control.tobytes()
        if key not in self._path_cache:
            capacity = max(1, min(PATHS_KEPT, PATHS_SIZE // ((self.fine.pieces + 1) * self.matrix.shape[0])))
            while len(self._path_cache) >= capacity:  # before the new one is made: either may be large
                self._path_cache.pop(next(iter(self._path_cache)))
            if self.orbit is not None:
                self._path_cache[key] = self._transform_orbit(self.orbit, control)[0][:, None]
                return self._path_cache[key]
            forward = self.forward
            if self.past is not None:
                final_coefficients = self.past.lifted.nodes(control)[-1]
                forward = forward.from_state((final_coefficients @ self.past.turn.T).ravel())
            states = forward.states(control, KNOWN)[0]
            self._path_cache[key] = states.reshape(-1, self.space.size, self.states)
        return self._path_cache[key]

    def _transform_orbit(self, orbit: Orbit, control: Array) -> tuple[Array, Array]:
        """Return the states of an orbit in the coordinates of this system, ``(L+1, d)``, and norm bounds ``(L+1, q)``
        of their errors."""
        phase = slice(self.first, self.first + self.grid.pieces + 1)
        states, errors = (table[phase] for table in orbit.states(control))
        coordinates, rounded = self.decoupling.vector(states.T)
        size = np.abs(self.decoupling.inverse).astype(float)
        errors = rounded + (np.eye(size.shape[0]) + self.decoupling.defect) @ size @ errors.T
        return coordinates.T, block_norms(errors.T, self.starts)

    @cached_property
    def _path_cache(self) -> dict[bytes, Array]:
        return {}

    def row_bounds(self, directions: Array, by_age: bool = False) -> tuple[Array, Array]:
        """Return bounds for the Taylor models of ``c'e^{A(p) s}``, of ``directions (r, d)``, read backwards from ``t``.

        They are block norms ``(r, S, M, q)`` of the coefficients, the largest on every span, and norm bounds ``(r, S,
        q)`` of the remainder. ``by_age``: true where the responses of equal pieces are computed by `Impulses`, with one
        length for all.
        """
        nodes, zeros = self.row_nodes(directions), np.zeros((self.spans.size, self.starts.size))
        begin, start = block_norms(nodes[:, :-1], self.starts).sum(axis=2), zeros[:1]
        if self.spans.size < self.fine.pieces:
            neglected, _, size_bounds = self._bound_error(begin, zeros, zeros[None], start, rows=True, by_age=by_age)
            if by_age:
                propagator = self.backward.propagator
                neglected = neglected + propagator.duration_errors[0] / float(propagator.lengths[0]) * size_bounds
            return size_bounds[:, :, None], neglected
        sizes = self._bound_sizes(nodes, np.zeros(1), rows=True)
        return sizes, self._bound_error(begin, zeros, self._bound_residual(sizes, rows=True), start, rows=True)[0]

    def row_nodes(self, directions: Array) -> Array:
        """Return the Taylor coefficients ``(r, S+1, M, d)`` of ``c'e^{A(p) s}`` at the ends ``s`` of the spans."""
        response, count = self._backward_spans, self.spans.size
        steps = response.steps(KNOWN)
        rows = np.zeros((count + 1, directions.shape[0], self.row_matrix.shape[0]))
        rows[0, :, : self.states] = directions
        for piece, length in enumerate(response.which.tolist()):
            rows[piece + 1] = rows[piece] @ steps.Phi[0, length]
        return np.moveaxis(rows, 0, 1).reshape(directions.shape[0], count + 1, self.space.size, self.states)

    @cached_property
    def _backward_spans(self) -> Response:
        if self.spans.size == self.fine.pieces:
            return self._backward_fine
        ends, none = np.append(self.spans, self.fine.pieces), np.zeros(self.spans.size, dtype=int)
        return self._build_adjoint(TimeGrid(self.fine.breakpoints[ends], none, none, elapsed=self.fine.elapsed))

    def _bound_sizes(self, nodes: Array, driven: Array, rows: bool) -> Array:
        """Return bounds ``(r, L', M, q)`` of the block norms of Taylor coefficients on every fine piece, from those at
        its ends, ``nodes (r, L'+1, M, d)``.

        They are the least of three bounds: the values at the ends plus the distance from the chord between them; the
        value at the start plus the distance that it can move; the growth of the value at the start plus the effect of
        the forcing.
        """
        matrix = self.row_matrix.T if rows else self.matrix
        lengths, shape = self.fine.lengths, (nodes.shape[0], nodes.shape[1] - 1, *nodes.shape[2:])

        flat = nodes[:, :-1].reshape(*shape[:2], -1)
        slopes = flat @ matrix.T + driven
        curvature = block_norms((slopes @ matrix.T).reshape(shape), self.starts)
        ends = block_norms(nodes, self.starts)
        integral, peak = self._compute_majorants(lengths, rows)
        forcing_norms = block_norms(np.broadcast_to(driven, flat.shape).reshape(shape), self.starts)
        displacement = _apply_bounds(integral, block_norms(slopes.reshape(shape), self.starts))
        chord = np.maximum(ends[:, :-1], ends[:, 1:]) + (lengths**2 / 8)[:, None, None] * _apply_bounds(peak, curvature)
        return np.minimum(
            np.minimum(chord, ends[:, :-1] + displacement),
            _apply_bounds(peak, ends[:, :-1]) + _apply_bounds(integral, forcing_norms),
        )

    def _compute_majorants(self, lengths: Array, rows: bool) -> tuple[NormBounds, NormBounds]:
        """Return bounds of ``int |e^{lifted s}| ds`` and ``|e^{lifted r}|`` on every fine piece, coefficient by
        coefficient, matrices ``(M q, M q)``; as in `ComparisonSystem.over`."""
        if not self.space.nu:
            reach = self.comparison.over(lengths)
            return (reach.integral.transposed, reach.peak.transposed) if rows else (reach.integral, reach.peak)
        if rows not in self._majorant_cache:
            _, longest, indices = alike(lengths, (self.space.size * self.starts.size) ** 2)
            majorant = block_sizes(self.A, self.starts)
            majorant[0] = comparison_matrix(self.A[0], self.starts)
            rising_majorant = majorant.copy()
            rising_majorant[0] = rising(majorant[0])
            if rows:
                majorant, rising_majorant = np.swapaxes(majorant, 1, 2), np.swapaxes(rising_majorant, 1, 2)
            with np.errstate(over="ignore", invalid="ignore"):
                integral = finite(flows_of(self.space, majorant, longest)[1])
                peak = finite(multiplied(self.space, np.broadcast_to(rising_majorant, integral.shape), integral))
            peak[:, 0] += np.eye(self.starts.size)
            both = (
                NormBounds(lifted_matrix(self.space, coefficients, rows=False), indices)
                for coefficients in (integral, peak)
            )
            self._majorant_cache[rows] = (next(both), next(both))
        return self._majorant_cache[rows]

    @cached_property
    def _majorant_cache(self) -> dict[bool, tuple[NormBounds, NormBounds]]:
        return {}

    def _bound_residual(self, sizes: Array, rows: bool) -> Array:
        """Return bounds ``(r, L', q)`` of the residual of the truncation on every fine piece, from the ``sizes
        (r, L', M, q)`` of the coefficients."""
        residual_norms = self.spilt(block_sizes(self.A, self.starts))
        return np.asarray(np.einsum("rlaj,aij->rli" if not rows else "rlai,aij->rlj", sizes, residual_norms))

    def _bound_error(
        self,
        begin: Array,
        driven: Array,
        residual: Array,
        start: Array,
        rows: bool,
        jumps: Array | float = 0.0,
        by_age: bool = False,
        ends: Array | None = None,
    ) -> tuple[Array, Array, Array]:
        """Return bounds of the error by Gronwall's inequality: ``|e|' <= M |e| + residual`` block by block, from
        ``|e(0)| <= start (r, q)``, or from bounds at the ``ends (r, S+1, q)`` of the spans, where these are known.

        The three results are the bounds on the spans, ``(r, S, q)``, the bounds at the ends of the spans, ``(r, S+1,
        q)``, and bounds of the quantity of which ``e`` is the error, ``(r, S, q)``.

        Every span adds the effects of the slack of ``A`` and of rounding on the values at its beginning, of block norms
        ``begin (r, S, q)``, and on the forcing. The forcing is at most ``driven (S, q)``, and jumps by ``jumps (S, q)``
        on spans of many pieces.
        """
        reach = self.comparison.over(self._span_durations)
        flow, integral, peak = (
            norms.transposed if rows else norms for norms in (reach.flow, reach.integral, reach.peak)
        )
        drives = np.broadcast_to(driven, begin.shape)
        size_bounds, growth = peak.on(begin) + integral.on(drives), flow
        if self.spans.size < self.fine.pieces:
            error_gain, delay = self._bound_span_error(peak, rows, by_age)
            end_rounding = inner_rounding = error_gain.on(size_bounds) + delay * peak.on(drives + jumps)
            size_bounds = size_bounds + end_rounding
            if rows:  # what is computed piece by piece begins a span elsewhere, and its rounding is that of where it is
                growth = NormBounds(flow.matrices + product(error_gain.matrices, peak.matrices), flow.which)
        else:
            relative, speed = (
                self._bound_transition_rounding(self.fine.lengths)[:, None] * size_bounds,
                self._bound_speed(size_bounds, driven, rows),
            )
            end_rounding, inner_rounding = (
                relative + delay * speed
                for delay in (self._backward_fine if rows else self.forward).propagator.duration_errors
            )
            # the state at the end of a piece is the one that the next begins with
            inner_rounding = np.maximum(end_rounding, inner_rounding)

        slack = self.slack_A.T if rows else self.slack_A
        end_slips, largest_slips = (
            flow_slip.on(begin) + integral_slip.on(drives) for flow_slip, integral_slip in self._bound_slips(rows)
        )
        largest_slips = np.minimum(finite(largest_slips), integral.on(product(size_bounds, slack.T)))

        residual_effect = integral.on(residual)
        increments = residual_effect + end_rounding + np.minimum(end_slips, largest_slips)
        bounds = growth.summed(np.broadcast_to(start, begin[:, 0].shape), increments) if ends is None else ends
        propagated = peak.on(bounds[:, :-1])
        if growth is not flow:
            propagated = propagated + error_gain.on(propagated)
            size_bounds = size_bounds + propagated
        return np.asarray(propagated + residual_effect + inner_rounding + largest_slips), bounds, size_bounds

    def _bound_span_error(self, peak: NormBounds, rows: bool, by_age: bool) -> tuple[NormBounds, float]:
        """Return bounds of the error of a piece-by-piece computation on spans of many pieces, relative to the exact
        sizes; and a time, by which the forcing is multiplied for the error that it adds.

        Every product loses a small share ``W`` of the sizes, and until the end of the span this error grows by at most
        ``peak``. The sizes have to be larger by this error, and so on: ``peak + peak W peak + ... <= 2 peak`` where
        ``peak W peak`` is at most half of ``peak``. For equal pieces only the distance of a breakpoint from the end of
        its piece counts. This distance moves the value by its speed, and has an effect where an input jumps there
        (summation by parts of the errors of the durations).
        """
        longest, count = np.maximum.reduceat(self.fine.lengths, self.spans), int(self._piece_counts.max())
        propagator = (self._backward_fine if rows else self.forward).propagator
        piece_delay, inner_delay = propagator.duration_errors
        if by_age:  # a row and a column go through one transition for every bit of the age
            share = (self.fine.pieces.bit_length() + 4) * self._bound_transition_rounding(self.fine.breakpoints[-1:])
            delay = 2.0 * propagator.drift + inner_delay
        elif rows or self._block_size == 1:
            share, delay = (count + 1) * self._bound_transition_rounding(longest), count * piece_delay + inner_delay
        else:
            share = propagator.products(count, self._block_size) * self._bound_transition_rounding(
                self._block_size * longest
            )
            delay = 2.0 * propagator.drift + inner_delay
        if rows:  # the ends of the spans are computed by transitions of their own
            share = share + 2.0 * self._bound_transition_rounding(self._span_durations)
            delay = delay + 2.0 * self._backward_spans.propagator.duration_errors[0]
        sizes = self.comparison.sizes.T if rows else self.comparison.sizes
        first_order = product(peak.matrices, share.max() * np.eye(sizes.shape[0]) + delay * sizes)
        is_small = (product(first_order, peak.matrices) <= 0.5 * peak.matrices).all()
        return NormBounds(np.where(is_small, 2.0 * first_order, np.inf), peak.which), 2.0 * delay

    def _bound_slips(self, rows: bool) -> tuple[tuple[NormBounds, NormBounds], tuple[NormBounds, NormBounds]]:
        """Return the bounds `ComparisonSystem.slips` at the end of every span, and the largest on it; remembered."""
        if not rows:
            return self._slip_bounds
        # e^{(A + S) r} - e^{A r} is what it is from either side
        at_end, largest = (tuple(norms.transposed for norms in pair) for pair in self._slip_bounds)
        return (at_end[0], at_end[1]), (largest[0], largest[1])

    @cached_property
    def _slip_bounds(self) -> tuple[tuple[NormBounds, NormBounds], tuple[NormBounds, NormBounds]]:
        # where nothing decays, slips grow with the time, so that the last is the largest
        majorant = ComparisonSystem(self.comparison.rising, self.comparison.sizes)
        slack, lengths = self.slack_A, self._span_durations
        return self.comparison.slips(slack, lengths), majorant.slips(slack, lengths)

    def _bound_transition_rounding(self, lengths: Array) -> Array:
        """Return bounds ``(S,)`` of the rounding error of transitions over such ``lengths (S,)``, and of a product with
        them, relative to the sizes."""
        if self.space.nu:
            relative, terms = flows_rounding(self.space, self.A, lengths), self.A.shape[1]
        else:  # beyond the groups there are zeros, whose products and sums are exact
            relative = decoupled_rounding(self.decoupling, self.A[0], lengths)
            terms = max(block.stop - block.start for block, _ in self.decoupling.parts)
        terms = terms * int(np.bincount(self.space.products[2]).max()) + max(self.B.shape[2], self.W.shape[2])
        return np.asarray(relative + rounding(terms))

    def _bound_speed(self, sizes: Array, driven: Array, rows: bool) -> Array:
        """Return an upper bound of the speed of a quantity of ``sizes (r, S, q)`` under the forcing
        ``driven``."""
        return np.asarray(product(sizes, self.comparison.sizes if rows else self.comparison.sizes.T) + driven)

    def spilt(self, coefficients: Array) -> Array:
        """Return, for every monomial, a sum of norms ``(M, ...)``: of those ``coefficients (M, ...)`` of a factor whose
        product with the monomial is beyond the degree of the space."""
        is_beyond = self.space.degrees[:, None] + self.space.degrees[None, :] > self.space.degree
        return np.asarray(np.tensordot(is_beyond.astype(float), coefficients, axes=1))


@dataclass(frozen=True, eq=False)
class LiftedExponentials:
    """`Exponentials` of the lifted matrix, on ``along_rows`` or on columns: mode by mode where there is one
    coefficient, in the algebra of polynomials otherwise."""

    lifted: LiftedSystem
    along_rows: bool

    def rows(self, rows: Array, durations: Array) -> tuple[Array, Array]:
        """Return ``c'e^{A r}`` and ``c'int_0^r e^{A s} ds`` of functionals (`Exponentials.rows`)."""
        assert self.along_rows
        propagated, integral = self.lifted.flown(rows[:, None], durations)
        return propagated[:, 0], integral[:, 0]

    def transitions(self, durations: Array) -> tuple[Array, Array]:
        """Return ``e^{A r}`` and ``int_0^r e^{A s} ds`` for durations (`Exponentials.transitions`)."""
        lifted = self.lifted
        if lifted.space.nu:
            return lifted_transitions(lifted.space, lifted.A, durations, rows=self.along_rows)
        return decoupled_transitions(lifted.decoupling, lifted.A[0], durations)


def _apply_bounds(bounds: NormBounds, norms: Array) -> Array:
    """Return bounds by matrices ``(M q, M q)`` on block norms ``(r, L', M, q)``."""
    return bounds.on(norms.reshape(*norms.shape[:2], -1)).reshape(norms.shape)


def lift(phase: Phase, grid: TimeGrid, initial_state: Array, centre: Array, radius: Array) -> LiftedSystem:
    """Return the lifted system over a cell, in the coordinates of `decoupled`; raise `NotEnclosable` where there is
    none."""
    space = _choose_space(centre.size)
    A, slack_A, B, slack_B, W, slack_W = phase.taylor(space, centre, radius)
    basis = decoupled(A[0])
    size, transformed = np.abs(basis.inverse).astype(float), basis.matrix(A)
    coefficients, rounded = transformed[0].copy(), transformed[1].sum(axis=0)
    coefficients[0] = basis.normal_form(transformed[0][0])
    rounded = rounded + np.abs(coefficients[0] - transformed[0][0])
    slack = (np.eye(size.shape[0]) + basis.defect) @ size
    inputs, state = [basis.vector(matrices) for matrices in (B, W)], basis.vector(initial_state[:, None])
    return LiftedSystem(
        space,
        grid,
        state[0][:, 0],
        coefficients,
        inputs[0][0],
        inputs[1][0],
        basis,
        block_sizes(rounded + slack @ slack_A @ np.abs(basis.transform), basis.starts),
        _compute_column_norms(inputs[0][1].sum(axis=0) + slack @ slack_B, basis.starts),
        _compute_column_norms(inputs[1][1].sum(axis=0) + slack @ slack_W, basis.starts),
        block_norms(state[1][:, 0], basis.starts),
    )


def lift_legs(response: Response, centre: Array, radius: Array) -> tuple[LiftedSystem, ...]:
    """Return the lifted systems of the modes of a switched system, each from where it begins; a single one where the
    system does not switch."""
    system, grid, initial_state, orbit = response.system, response.grid, response.initial_state, response.orbit
    if grid.mode is None:
        return (replace(lift(system.modes[0], grid, initial_state, centre, radius), orbit=orbit),)
    lifted_phases: list[LiftedSystem] = []
    for number, mode in enumerate(system.modes):
        lifted = replace(lift(mode, grid.leg(number), initial_state, centre, radius), orbit=orbit)
        if lifted_phases:
            transform, slip = lifted.decoupling.vector(lifted_phases[-1].transform)
            lifted = replace(lifted, past=Past(lifted_phases[-1], transform, slip, lifted.starts))
        lifted_phases.append(lifted)
    return tuple(lifted_phases)


def _compute_column_norms(entries: Array, starts: np.ndarray) -> Array:
    """Return the norms ``(q, m)`` of the blocks of columns ``(d, m)``."""
    return block_norms(entries.T, starts).T


def frozen(phase: Phase, grid: TimeGrid, initial_state: Array, parameter: Array) -> LiftedSystem:
    """Return the system at one parameter, without any expansion."""
    A, B, W = phase.matrices(parameter[None])
    basis = identity(A.shape[1])
    none_A, none_B, none_W = (np.zeros((A.shape[1], matrix.shape[2])) for matrix in (A, B, W))
    return LiftedSystem(
        _choose_space(0), grid, initial_state, A, B, W, basis, none_A, none_B, none_W, slack_x=np.zeros(A.shape[1])
    )


def _choose_space(nu: int) -> TaylorSpace:
    return taylor_space(nu, DEGREES.get(nu, 2))
