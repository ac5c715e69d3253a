"""Open-loop program of a known system on equal pieces, solved and proven again for one initial state after another.

Rows, the worst disturbance at a time, and its curvature do not depend on the initial state. They are stored by the
position of a time in its piece. A new state then needs only a linear program from the last basis, and a proof in which
only the nominal state is new.
"""

from __future__ import annotations

import time
from bisect import bisect_left
from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol, final

import numpy as np

from sparserob_core.control.constraints.flat import FlatConstraint
from sparserob_core.control.feedback.innovations import KNOWN
from sparserob_core.control.transcription.record import Transcription
from sparserob_core.sip.convex_set import Array
from sparserob_core.sip.finite import FiniteProgram
from sparserob_core.sip.inner.duality import dual_bound
from sparserob_core.sip.inner.simplex.growing import GrowingProgram
from sparserob_core.sip.program import TOLERANCE

PARTS, LEVELS = 32, 3  # a cell that is open is cut in so many parts, so many times
MIN_LEVEL = 2  # the level on which the instant of a new row lies at least
TAYLOR_TERMS = 8  # of the Taylor expansion that bounds a curvature
PLAN_ROUNDING = 2.0**-46  # of the numbers that are added up
TIGHTENING = 2e-9  # by which rows are tightened, in their own units
MAX_ROUNDS = 40  # of adding rows
MAX_MAP_NUMBERS = 8_000_000  # in the map from controls to states, at most
MAX_REFINED_CELLS = 400  # open cells that are looked at closer, at most
KEPT, RECENT = 40, 200  # rows at most, before one begins anew with those that had one of so many multipliers
SAME_BREAKPOINT_SHARE = 1e-9  # of a piece: an end of a window that is a breakpoint


@final
@dataclass(frozen=True, eq=False)
class Tracked:
    """A proven ``decision (n,)`` with the ``cost`` and the ``lower`` bound of it, in the units of the program."""

    decision: Array
    cost: float
    lower: float


@final
@dataclass(frozen=True, eq=False)
class _Instants:
    """Quantities that all pieces share at some times after they begin: ``flow``, ``driven (q, d, d)``, and the support
    value of the disturbance in the rows until then, ``support_values (q, K + 1, R)``."""

    flow: Array
    driven: Array
    support_values: Array


def is_trackable(own: Transcription) -> bool:
    """Return whether `Tracking` accepts a transcription, given in its own units: a linear open-loop program of a known
    system, with flat constraints, a box of controls around 0, and windows that end at breakpoints of equal pieces."""
    problem, grid, program, model = own.problem, own.response.grid, own.program, own.functionals.disturbance
    K = own.control.pieces
    is_plain = problem.system.parameters is None and not problem.system.switches and problem.system.delay == 0.0
    is_plain = is_plain and problem.initial_set is None and problem.control_step is None and own.feedback is None
    is_linear = program.S is None and program.P is None and program.A is None and problem.cost.is_linear
    is_linear = is_linear and problem.control.is_box and own.control.is_indicators
    is_uniform = own.response.uniform and grid.pieces == K
    if model is not None:
        is_uniform = (
            is_uniform and model.kind == "piecewise_constant" and model.starts is not None and model.starts.size == K
        )
    if (
        not (is_plain and is_linear and is_uniform)
        or K * K * problem.system.states * problem.system.controls > MAX_MAP_NUMBERS
    ):
        return False
    is_flat = all(isinstance(constraint, FlatConstraint) and constraint.gains is None and not constraint.reference.moves
                  for constraint in own.constraints)  # fmt: skip
    box, ends = (
        problem.control.bounding_box(),
        [t for constraint in own.constraints for t in (constraint.start, constraint.stop)],
    )
    places = np.array(ends) * K / problem.horizon
    is_on_grid = bool((np.abs(places - np.rint(places)) <= SAME_BREAKPOINT_SHARE).all())
    return is_flat and is_on_grid and bool((box.lower <= 0.0).all() and (box.upper >= 0.0).all())


class FutureEffects(Protocol):
    """Effect of future disturbances under gains on rows ``H x <= h (R,)``. Times are counted as in the nominal problem:
    from the beginning of each of its ``K`` pieces."""

    def room(self) -> tuple[Array, Array]:
        """Return how far the control may lie below and above the nominal control on every piece, ``(m, K)`` each."""

    def added(self, flow: Array, driven: Array, piece: int) -> Array:
        """Return the support value ``(q, R)`` of future disturbances in every row at instants of a piece, which have
        the flows ``flow``, ``driven (q, d, d)`` from its beginning. After the last piece, ``piece = K`` is the horizon
        alone."""

    def bending(self, curvature: Callable[[Array], Array]) -> tuple[Array, Array]:
        """Return bounds ``(K, R)`` of the second derivative of the support value over every piece, and the sums of
        absolute numbers ``(K + 1, R)`` from which the support value is computed. ``curvature`` bounds the second
        derivative of the rows of a state from its rates ``(..., d)``."""


@final
class Tracking:
    """Solver for transcriptions that `is_trackable` accepts, from one initial state ``(d,)`` after another. With
    ``answering``, the control also has gains that do not change; ``own`` is then the remaining problem if nothing
    happens."""

    def __init__(self, own: Transcription, answering: Callable[[Array], FutureEffects] | None = None) -> None:
        problem, response, steps = own.problem, own.response, own.response.steps(KNOWN)
        self.own, self.K, self.m = own, own.control.pieces, problem.system.controls
        self.bound, self.horizon = problem.disturbance, problem.horizon
        self.length = self.horizon / self.K
        self.A, self.B, self.E = steps.A[0, 0], steps.B[0][:, : self.m], steps.E[0]
        self.drift = steps.B[0][:, self.m :].sum(axis=1)
        flats = [flat for flat in own.constraints if isinstance(flat, FlatConstraint)]
        d = problem.system.states
        self.H = np.vstack([np.zeros((0, d)), *(flat.H for flat in flats)])
        self.h = np.concatenate([np.zeros(0), *(flat.h for flat in flats)])
        sizes = [flat.h.size for flat in flats]
        self.start = np.repeat([round(flat.start / self.length) for flat in flats], sizes).astype(int)
        self.stop = np.repeat([round(flat.stop / self.length) for flat in flats], sizes).astype(int)
        kernel = response.propagator.kernel  # what a piece of an age gives, (d, K, d)
        self.kernel = np.ascontiguousarray(kernel.swapaxes(0, 1))
        self.powers = response.flows(response.grid.breakpoints)[0]
        control_response, effects = self.kernel @ self.B, np.cumsum(self.kernel @ self.drift, axis=0)
        nodes = np.zeros((self.K + 1, d, self.m, self.K))
        for k in range(1, self.K + 1):
            nodes[k, :, :, :k] = control_response[k - 1 :: -1].transpose(1, 2, 0)
        self.nodes = nodes.reshape(self.K + 1, d, -1)
        self.fixed = np.vstack([np.zeros((1, d)), effects])
        box = problem.control.bounding_box()
        self._answering = None if answering is None else answering(self.H)
        low, high = np.repeat(box.lower, self.K), np.repeat(box.upper, self.K)
        if self._answering is not None:
            below, above = self._answering.room()
            low, high = low + below.ravel(), high - above.ravel()
        self.limited = bool((low <= 0.0).all() and (high >= 0.0).all())
        self.sizes = np.abs(self.nodes) @ np.maximum(-low, high) + np.abs(self.fixed)
        self.limits: tuple[Array, Array, Array] = (problem.prices(own.control.breakpoints).ravel(), low, high)
        factors = [1.0]
        self.rates = [self.H @ self.A]
        for order in range(1, TAYLOR_TERMS):
            factors.append(factors[-1] / order)
            self.rates.append(self.rates[-1] @ self.A)
        self.factors = np.array(factors)
        self.last = np.linalg.norm(self.rates[-1] @ self.A, axis=1)
        self.growth = float(np.linalg.norm(self.A, 2))
        self._summation = np.tile(np.eye(self.h.size), (TAYLOR_TERMS, 1))
        self._series: dict[float, tuple[Array, Array]] = {}
        self._blocks: dict[tuple[int, int], _Instants] = {}
        self._offsets: dict[int, tuple[Array, Array]] = {}
        self._disturbance_kernel = self.kernel @ self.E
        self._support_cache: dict[tuple[int, int, int], Array] = {}
        self._support_values, zeros = (
            self._compute_support(np.eye(d)[None], np.zeros((1, d, d)))[0],
            np.zeros((1, d, d)),
        )
        self._curvature_bounds, magnitudes = self._bound_disturbance_curvature(), np.zeros_like(self._support_values)
        if self._answering is not None:
            ends = [self._answering.added(np.eye(d)[None], zeros, k) for k in range(self.K + 1)]
            self._support_values = np.concatenate(ends)
            self._curvature_bounds, magnitudes = self._answering.bending(
                lambda rates: self._bound_curvature(rates, self.length)
            )
        self._flat_nodes = self.nodes.reshape(-1, self.nodes.shape[2])
        self._power_magnitudes = np.abs(self.powers)
        self._row_roundings = PLAN_ROUNDING * np.abs(self.H).T
        number = np.arange(self.K + 1)[:, None]
        self._is_active_node = (number >= self.start) & (number <= self.stop)
        self._is_active_piece = (number[:-1] >= self.start) & (number[:-1] < self.stop)
        effects = np.abs(self._support_values)
        self._rounding_errors = self.sizes @ self._row_roundings + PLAN_ROUNDING * (
            np.abs(self.h) + effects.max(axis=0, initial=0.0)
        )
        self._rounding_errors = self._rounding_errors + PLAN_ROUNDING * magnitudes
        self._recent_instants: list[
            tuple[int, int, int, int]
        ] = []  # rows that had a multiplier, those of the last states last
        self._start_program()

    def _start_program(self) -> None:
        """Begin with a program without rows, whose columns are the positive and the negative parts of the control."""
        weights, low, high = self.limits
        self._program = GrowingProgram()
        for reach in (high, -low):
            self._program.variables(np.zeros(reach.size), np.maximum(reach, 0.0), weights)
        self._row_instants: list[tuple[int, int, int, int]] = []  # row, piece, level and number of an instant
        self._input_rows, self._state_rows = np.zeros((0, weights.size)), np.zeros((0, self.H.shape[1]))
        self._right_hand_sides = np.zeros(0)

    def solve(self, state: Array, seconds: float = np.inf) -> Tracked | None:
        """Return the answer from an initial state; ``None`` where none was proven within ``seconds``."""
        until = time.monotonic() + seconds
        if len(self._row_instants) > KEPT:
            self._drop_idle_rows()
        nominal, (weights, low, high) = self._propagate_uncontrolled(state), self.limits
        for round_ in range(MAX_ROUNDS):
            h = self._right_hand_sides - self._state_rows @ state
            self._program.limit(np.arange(h.size), h - TIGHTENING)
            solved, _, parts, y = self._program.solve(until - time.monotonic())
            if not solved:
                return None
            x = np.clip(parts[: low.size] - parts[low.size :], low, high)
            open_instants = self._find_unproven_instants(x, *nominal)
            if open_instants is None:
                return None
            if not open_instants:
                self._recent_instants = [
                    *self._recent_instants,
                    *(self._row_instants[i] for i in np.flatnonzero(y > 0.0)),
                ][-RECENT:]
                q, A, b = np.zeros(low.size), np.zeros((0, low.size)), np.zeros(0)
                program = FiniteProgram(q, weights, low, high, self._input_rows, h, A, b)
                return Tracked(x, float(weights @ np.abs(x)), dual_bound(program, y, b))
            new_instants = [instant for instant in open_instants if instant not in self._row_instants]
            if not new_instants:
                return None
            self._impose_rows(new_instants + self._bisect_instants(new_instants) if round_ else new_instants)
        return None

    def _drop_idle_rows(self) -> None:
        """Begin anew with the rows that had a multiplier in the last solutions."""
        needed = list(dict.fromkeys(reversed(self._recent_instants)))[: KEPT // 2]
        self._start_program()
        self._impose_rows(needed)

    def _bisect_instants(self, fresh: list[tuple[int, int, int, int]]) -> list[tuple[int, int, int, int]]:
        """Return instants halfway from new rows to the next rows on both sides. Without them, a peak between two rows
        would be halved round by round."""
        instants = list[tuple[int, int, int, int]]()
        for row, piece, level, number in fresh:
            numbers = sorted(n for *same, n in self._row_instants if same == [row, piece, level])
            after = bisect_left(numbers, number)
            instants += [(row, piece, level, (number + n) // 2) for n in numbers[max(after - 1, 0) : after + 1]]
        return [
            instant for instant in dict.fromkeys(instants) if instant not in fresh and instant not in self._row_instants
        ]

    def _impose_rows(self, places: list[tuple[int, int, int, int]]) -> None:
        inputs, F, right = list[Array](), list[Array](), list[float]()
        for row, piece, level, number in places:
            c, input_row, support_value = self.H[row], np.zeros(self.H.shape[1]), self._support_values[piece, row]
            if level:
                parent = min(number // PARTS, PARTS ** (level - 1) - 1)
                block, at = self._get_block(level, parent), number - parent * PARTS
                c, input_row, support_value = (
                    c @ block.flow[at],
                    c @ block.driven[at],
                    self._get_support(level, parent, piece)[at, row],
                )
            g = (c @ self.nodes[piece]).reshape(self.m, self.K)
            if level:
                g[:, piece] += input_row @ self.B
            inputs.append(g.ravel())
            F.append(c @ self.powers[piece])
            right.append(self.h[row] - c @ self.fixed[piece] - input_row @ self.drift - support_value)
        G = np.array(inputs).reshape(-1, self._input_rows.shape[1])
        (at, column), free = np.indices(G.shape).reshape(2, -1), np.full(len(G), np.inf)
        entries = [(at, column, G.ravel()), (at, column + G.shape[1], -G.ravel())]
        self._program.rows(entries, -free, free)
        self._input_rows = np.vstack([self._input_rows, G])
        self._state_rows = np.vstack([self._state_rows, *F])
        self._right_hand_sides = np.concatenate([self._right_hand_sides, right])
        self._row_instants += places

    def _propagate_uncontrolled(self, state: Array) -> tuple[Array, Array]:
        """Return the states ``(K + 1, d)`` at the breakpoints without control, and the rounding error of the rows
        there, ``(K + 1, R)``."""
        return self.powers @ state + self.fixed, self._rounding_errors + self._power_magnitudes @ np.abs(
            state
        ) @ self._row_roundings

    def _find_unproven_instants(
        self, x: Array, undriven: Array, noise: Array
    ) -> list[tuple[int, int, int, int]] | None:
        """Return the worst instant of every row in every run of cells in which the row is not proven to hold. The list
        is empty where all rows are proven; ``None`` where this remains undecided."""
        nodes = (self._flat_nodes @ x).reshape(self.fixed.shape) + undriven
        drives = x.reshape(self.m, self.K).T @ self.B.T + self.drift
        heights = nodes @ self.H.T + self._support_values - self.h
        is_violated = (heights + noise > TOLERANCE) & self._is_active_node
        if is_violated.any():
            worst = np.where(is_violated, heights, -np.inf)
            peaks = self._find_peaks(worst, 0, np.zeros(self.K + 1, int), np.arange(self.K + 1))
            return self._refine_peaks(peaks, nodes, drives)
        rates = nodes[:-1] @ self.A.T + drives
        curvature = (self._bound_curvature(rates, self.length) + self._curvature_bounds) * (self.length**2 / 8.0)
        noise = np.maximum(noise[:-1], noise[1:])
        is_open = (np.maximum(heights[:-1], heights[1:]) + curvature + noise > TOLERANCE) & self._is_active_piece
        cells = [(int(k), 0) for k in np.flatnonzero(is_open.any(axis=1))]
        for level in range(1, LEVELS + 1):
            if not cells or len(cells) > MAX_REFINED_CELLS:
                break
            instants, open_cells = list[tuple[int, int, int, int]](), list[tuple[int, int]]()
            width = self.length / PARTS**level
            for k, parent in cells:
                at = self._get_block(level, parent)
                states = at.flow @ nodes[k] + at.driven @ drives[k]  # (PARTS + 1, d)
                heights = states @ self.H.T + self._get_support(level, parent, k) - self.h
                is_violated = (heights + noise[k] > TOLERANCE) & self._is_active_piece[k]
                first = parent * PARTS
                if is_violated.any():
                    numbers = np.arange(first, first + PARTS + 1)
                    worst = np.where(is_violated, heights, -np.inf)
                    instants += self._find_peaks(worst, level, numbers, np.full(numbers.size, k))
                elif not instants:
                    cell_curvature = (
                        self._bound_curvature(states[:-1] @ self.A.T + drives[k], width) + self._curvature_bounds[k]
                    )
                    upper_bounds = np.maximum(heights[:-1], heights[1:]) + cell_curvature * (width**2 / 8.0) + noise[k]
                    is_open_cell = ((upper_bounds > TOLERANCE) & self._is_active_piece[k]).any(axis=1)
                    open_cells += [(k, first + int(cell)) for cell in np.flatnonzero(is_open_cell)]
            if instants:
                return self._refine_peaks(instants, nodes, drives)
            cells = open_cells
        return None if cells else []

    def _find_peaks(
        self, worst: Array, level: int, at: np.ndarray, pieces: np.ndarray
    ) -> list[tuple[int, int, int, int]]:
        """Return the local maxima of violations ``(k, R)`` at consecutive instants."""
        padded = np.vstack([np.full(worst.shape[1], -np.inf), worst, np.full(worst.shape[1], -np.inf)])
        is_peak = (worst > padded[:-2]) & (worst >= padded[2:]) & np.isfinite(worst)
        return [(int(row), int(pieces[k]), level, int(at[k])) for k, row in np.argwhere(is_peak)]

    def _refine_peaks(
        self, places: list[tuple[int, int, int, int]], nodes: Array, drives: Array
    ) -> list[tuple[int, int, int, int]]:
        """Return the instants near these places at which the rows are worst. A row at the very peak of a trajectory
        saves the rounds that would approach the peak row by row."""
        instants = []
        for row, piece, level, number in places:
            while level < MIN_LEVEL:
                size, candidates = PARTS**level, list[tuple[float, int, int]]()
                for before in (1, 0):  # the cells that end and begin in the instant
                    k, cell = (piece - 1, size - 1) if number < before else (piece, number - before)
                    k, cell = (k + 1, 0) if cell == size else (k, cell)
                    if 0 <= k < self.K and self._is_active_piece[k, row]:
                        block = self._get_block(level + 1, cell)
                        states = block.flow @ nodes[k] + block.driven @ drives[k]
                        heights = states @ self.H[row] + self._get_support(level + 1, cell, k)[:, row]
                        worst = int(heights.argmax())
                        candidates.append((float(heights[worst]), k, cell * PARTS + worst))
                if not candidates:
                    break
                _, piece, number = max(candidates)
                level += 1
            instants.append((row, piece, level, number))
        return list(dict.fromkeys(instants))

    def _bound_curvature(self, rates: Array, width: float) -> Array:
        """Return bounds ``(..., R)`` of the second derivative of the rows over a cell of this ``width``, at whose
        beginning the states have the ``rates (..., d)``."""
        if rates.ndim > 2:
            return np.array([self._bound_curvature(table, width) for table in rates]).reshape(
                *rates.shape[:-1], self.h.size
            )
        if width not in self._series:
            powers = np.cumprod([1.0] + [width] * TAYLOR_TERMS)
            tail = self.factors[-1] / TAYLOR_TERMS * powers[-1] * np.exp(self.growth * width)
            terms = np.array(self.rates) * (self.factors * powers[:-1])[:, None, None]  # (TERMS, R, d)
            self._series[width] = terms.reshape(-1, rates.shape[-1]).T.copy(), tail * self.last
        terms, tail = self._series[width]
        sizes = np.sqrt(np.einsum("ki,ki->k", rates, rates))
        return np.asarray(np.abs(rates @ terms) @ self._summation + sizes[:, None] * tail)

    def _get_block(self, level: int, parent: int) -> _Instants:
        """Return the quantities at the ``PARTS + 1`` ends of the parts of one cell of the level before."""
        key = (level, parent)
        if key not in self._blocks:
            if level not in self._offsets:
                self._offsets[level] = self.own.response.flows(np.arange(PARTS + 1) * self.length / PARTS**level)
            flow, integral = self._offsets[level]
            if level > 1:
                before, at = self._get_block(level - 1, parent // PARTS), parent % PARTS
                flow, integral = flow @ before.flow[at], flow @ before.driven[at] + integral
            self._blocks[key] = _Instants(flow, integral, self._compute_support(flow, integral))
        return self._blocks[key]

    def _get_support(self, level: int, parent: int, piece: int) -> Array:
        """Return the support value of the disturbance in every row at the instants of a block on one piece, ``(q, R)``.
        Under gains, the effect of the control that answers is included."""
        block = self._get_block(level, parent)
        if self._answering is None:
            return np.asarray(block.support_values[:, piece])
        key = (level, parent, piece)
        if key not in self._support_cache:
            self._support_cache[key] = self._answering.added(block.flow, block.driven, piece)
        return self._support_cache[key]

    def _compute_support(self, flow: Array, driven: Array) -> Array:
        """Return the support value of the disturbance in every row on every piece, ``(q, K + 1, R)``, at instants with
        these flows from the beginning of a piece."""
        support_values = np.zeros((flow.shape[0], self.K + 1, self.h.size))
        if self.bound is not None:
            q, (K, d, w) = flow.shape[0], self._disturbance_kernel.shape
            responses = (self.H @ flow).reshape(-1, d) @ self._disturbance_kernel.transpose(1, 0, 2).reshape(d, -1)
            responses = responses.reshape(q, self.h.size, K, w).swapaxes(1, 2)
            support_values[:, 1:] = np.cumsum(self.bound.support(responses), axis=1)
            support_values[:, : self.K] += self.bound.support(self.H @ driven @ self.E)[:, None]
        return support_values

    def _bound_disturbance_curvature(self) -> Array:
        """Return bounds ``(K, R)`` of the second derivative of the effect of any disturbance over every piece: the sum
        of the bounds of its entries, each as large as it may be."""
        if self.bound is None:
            return np.zeros((self.K, self.h.size))
        reach = self.bound.reach(np.eye(self.E.shape[1]))
        rates = (self.A @ self._disturbance_kernel).swapaxes(1, 2)  # (K, mw, d)
        bounds = np.einsum("kir,i->kr", self._bound_curvature(rates, self.length), reach)
        past = np.vstack([np.zeros((1, self.h.size)), np.cumsum(bounds, axis=0)[:-1]])
        return np.asarray(past + reach @ self._bound_curvature(self.E.T, self.length))
