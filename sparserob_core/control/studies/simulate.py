"""Exact simulation of many trajectories at once: matrix exponentials of the pieces, no time stepping."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Protocol

import numpy as np
from scipy.linalg import matrix_balance

from sparserob_core.control.constraints.flat import INSIDE, MAX_INSIDE, MAX_SPACING_NORM
from sparserob_core.control.enclosures.decoupling import decoupled, pace
from sparserob_core.control.enclosures.flows import Flows
from sparserob_core.control.enclosures.matrix_exponential import transitions
from sparserob_core.control.response.parameters import ParameterIndex
from sparserob_core.control.response.response import Response
from sparserob_core.control.response.time_grid import TimeGrid, distinct_times
from sparserob_core.sip.convex_set import Array

# Pieces, from which no times inside are looked at where the system hardly moves on one
BREAKPOINTS_ONLY_PIECES = 10_000
MAX_NUMBERS_AT_ONCE = 2_000_000  # numbers of signals, or of transition matrices, that are held at once


def times_inside(times: Array, breakpoints: Array) -> int:
    """Return the smallest number of increasing ``times (T,)`` that lie strictly between two neighbouring
    ``breakpoints (K + 1,)``."""
    ends = np.searchsorted(times, breakpoints[1:], side="left")
    return int((ends - np.searchsorted(times, breakpoints[:-1], side="right")).min())


def fine_times(response: Response, parameters: ParameterIndex, more: Array) -> Array:
    """The breakpoints, ``more (k,)`` times, and times inside every piece: three of them, or more where the system moves
    on it, and fewer where there are many pieces; ``(T,)``."""
    grid = response.grid
    points = parameters.lattice()[0]
    matrices = np.concatenate([mode.matrices(points)[0] for mode in response.system.modes])
    rate = max(pace(A) for A in np.unique(matrices, axis=0))
    fewest = INSIDE + 1 if grid.pieces < BREAKPOINTS_ONLY_PIECES else 1
    counts = np.clip(np.ceil(rate * grid.lengths / MAX_SPACING_NORM), fewest, MAX_INSIDE).astype(int)
    index = np.arange(counts.sum()) - np.repeat(np.cumsum(counts) - counts, counts)
    inside = np.repeat(grid.breakpoints[:-1], counts) + np.repeat(grid.lengths, counts) * index / np.repeat(
        counts, counts
    )
    return distinct_times(np.concatenate([inside, more, grid.breakpoints[-1:]]), float(grid.breakpoints[-1]))


def refine_grid(grid: TimeGrid, times: Array) -> TimeGrid:
    """A grid on other times, ``(T,)`` from 0 to the horizon, that include the breakpoints; its inputs are given on the
    pieces of ``grid``."""
    return grid.refined(times)


class PieceMotion(Protocol):
    """Motion of a system on a piece with constant inputs, in internal coordinates of the system."""

    def enter(self, states: Array) -> Array:
        """The coordinates of ``states (n, d)``."""

    def leave(self, state: Array) -> Array:
        """The states ``(d, n)`` of coordinates."""

    def step(self, piece: int, state: Array, control: Array, disturbance: Array) -> Array:
        """The coordinates at the end of a ``piece`` that begins in ``state``, under ``control (m, n or 1)`` and
        ``disturbance (mw, n or 1)``."""


def simulate_states(
    response: Response,
    control: Array | Callable[[int, Array], Array],
    parameters: Array,
    disturbances: Array | None,
    initial_states: Array | None = None,
) -> Iterator[Array]:
    """The states ``(d, n)`` of ``n`` trajectories at every breakpoint of the response's grid, one time after another,
    from ``initial_states (n, d)``, or from that of the response.

    ``control (m, K)``, or what it is on a piece that begins in states ``(d, n)``, and ``disturbances (n, mw, M)`` (or
    ``None``) on the pieces that the grid refers to,
    ``parameters (n, nu)``: the variation of constants over each piece, in which both inputs are constant.
    """
    grid, motion = response.grid, _choose_motion(response, parameters)
    if initial_states is None:
        initial_states = np.repeat(response.initial_state[None], parameters.shape[0], axis=0)
    zero_signal = np.broadcast_to(0.0, (1, response.system.disturbances, grid.disturbance_piece.max() + 1))
    signal = np.ascontiguousarray((zero_signal if disturbances is None else disturbances).transpose(2, 1, 0))
    state = motion.enter(initial_states)
    states = motion.leave(state)
    yield states
    acting_control, last_index = np.zeros(0), -1
    for piece, (control_index, disturbance_index) in enumerate(
        zip(grid.control_piece.tolist(), grid.disturbance_piece.tolist(), strict=True)
    ):
        if control_index != last_index:
            acting_control, last_index = (
                control(control_index, states) if callable(control) else control[:, control_index, None],
                control_index,
            )
        state = motion.step(piece, state, acting_control, signal[disturbance_index])
        states = motion.leave(state)
        yield states


def _choose_motion(response: Response, parameters: Array) -> PieceMotion:
    """Return the motion that takes the least work; ``parameters (n, nu)`` are those of the trajectories."""
    grid, system = response.grid, response.system
    if grid.varying:
        return _TimeVaryingMotion(response, parameters)
    is_large = grid.distinct(grid.lengths)[0].size * 4 * system.states**2 > MAX_NUMBERS_AT_ONCE
    if is_large and not parameters.shape[1] and grid.mode is None:
        return _DecoupledMotion(response)
    return _MatrixMotion(response, parameters)


class _MatrixMotion:
    """A system that is the same on each of its pieces: one transition for every length."""

    def __init__(self, response: Response, parameters: Array) -> None:
        self.grid = grid = response.grid
        points = parameters if parameters.shape[1] else parameters[:1]
        self.modes = [
            [np.moveaxis(matrix, 0, -1) if parameters.shape[1] else matrix[0] for matrix in mode.matrices(points)]
            for mode in response.system.modes
        ]
        self.lengths, self.which = grid.distinct(grid.lengths)
        self.mode, self.inputs, self.driven = -1, (-1, -1, -1, -1), np.zeros(0)

    def enter(self, states: Array) -> Array:
        return np.ascontiguousarray(states.T)

    def leave(self, state: Array) -> Array:
        return state

    def step(self, piece: int, state: Array, control: Array, disturbance: Array) -> Array:
        grid = self.grid
        mode = int(grid.modes[piece])
        A, B, W = self.modes[mode]
        if mode != self.mode:
            self.mode, (self.flows, self.integrals) = mode, _compute_transitions(A, self.lengths)
        inputs = (int(self.which[piece]), int(grid.control_piece[piece]), int(grid.disturbance_piece[piece]), mode)
        if inputs != self.inputs:  # the pieces that times inside cut one into are driven alike
            drive = _multiply(B, control) + _multiply(W, disturbance)
            self.inputs, self.driven = inputs, _multiply(self.integrals[inputs[0]], drive)
        return _multiply(self.flows[inputs[0]], state) + self.driven


class _DecoupledMotion:
    """A known system with many states on pieces of many lengths, in coordinates in which its modes are apart: no matrix
    is held for a length."""

    def __init__(self, response: Response) -> None:
        A, B, W = (matrix[0] for matrix in response.system.modes[0].matrices(np.zeros((1, 0))))
        self.lengths, self.basis = response.grid.lengths, decoupled(A)
        self.flows = Flows(self.basis, self.basis.normal_form(self.basis.matrix(A)[0]))
        self.inverse = self.basis.inverse.astype(float)
        self.B, self.W = self.inverse @ B, self.inverse @ W

    def enter(self, states: Array) -> Array:
        return np.asarray(states @ self.inverse.T)

    def leave(self, state: Array) -> Array:
        return np.asarray(self.basis.transform @ state.T)

    def step(self, piece: int, state: Array, control: Array, disturbance: Array) -> Array:
        drive = self.B @ control + self.W @ disturbance
        lengths = np.full(state.shape[0], self.lengths[piece])
        return np.asarray(self.flows.columns(state, np.broadcast_to(drive.T, state.shape), lengths))


class _TimeVaryingMotion:
    """A system that changes with time: the transitions of the pieces, of each trajectory at its parameters."""

    def __init__(self, response: Response, parameters: Array) -> None:
        by_trajectory = parameters.shape[1] > 0
        steps, self.lengths = response.steps(parameters if by_trajectory else parameters[:1]), response.grid.lengths
        inputs, m = steps.inputs, response.system.controls
        self.Phi, self.B, self.E = (
            [np.moveaxis(matrix, 0, -1) if by_trajectory else matrix[0] for matrix in np.moveaxis(table, 1, 0)]
            for table in (steps.Phi, inputs[..., :m], inputs[..., m:])
        )

    def enter(self, states: Array) -> Array:
        return np.ascontiguousarray(states.T)

    def leave(self, state: Array) -> Array:
        return state

    def step(self, piece: int, state: Array, control: Array, disturbance: Array) -> Array:
        drive = _multiply(self.B[piece], control) + _multiply(self.E[piece], disturbance)
        return np.asarray(_multiply(self.Phi[piece], state) + self.lengths[piece] * drive)


def deliver_control(command: Array, errors: Array) -> Callable[[int, Array], Array]:
    """Return a function that gives `simulate_states` the delivered control: a ``command (m + constants, L)`` and
    ``errors (L, m, n)`` in ``n`` trajectories."""

    def acting(piece: int, state: Array) -> Array:
        inputs = np.repeat(command[:, piece, None], state.shape[1], axis=1)
        inputs[: errors.shape[1]] += errors[piece]
        return inputs

    return acting


def worst_errors(response: Response, sizes: Array, at: tuple[Array, Array, Array]) -> Array:
    """The errors ``(L, m, k)`` of at most ``sizes (m, L)``, constant on the pieces of a response, that raise
    functionals ``c'x(t)`` the most, ``at`` times ``(k,)``, directions ``(k, d)`` and parameters."""
    weights = response.weights(*at).control[:, :, : len(sizes)].transpose(1, 2, 0)
    return np.asarray(sizes.T[:, :, None] * np.sign(weights))


def trajectories_at_once(response: Response, uncertain: bool) -> int:
    """Return the number of trajectories that are held in memory together, between 16 and 4096."""
    grid, system = response.grid, response.system
    signals = MAX_NUMBERS_AT_ONCE // (max(1, system.disturbances) * (int(grid.disturbance_piece.max()) + 1))
    kinds = grid.pieces if grid.varying else grid.distinct(grid.lengths)[0].size
    flows = MAX_NUMBERS_AT_ONCE // (kinds * 4 * system.states**2) if uncertain else signals
    return int(np.clip(min(signals, flows), 16, 4096))


def _compute_transitions(A: Array, lengths: Array) -> tuple[Array, Array]:
    """``e^{A r}`` and its integral for every distinct length, ``(q, d, d)``, or ``(q, d, d, n)`` for ``n`` matrices
    ``(d, d, n)``. A known system is taken in units in which it is small, powers of two: in metres and seconds an orbit
    is known a hundred times better so."""
    if A.ndim == 2:
        balanced, (units, _) = matrix_balance(A, permute=False, separate=True)
        back = units[:, None] / units
        flows, integrals = transitions(balanced[None], lengths)
        return flows * back, integrals * back
    flows, integrals = transitions(np.moveaxis(A, -1, 0)[None], lengths[:, None])
    return np.ascontiguousarray(np.moveaxis(flows, 1, -1)), np.ascontiguousarray(np.moveaxis(integrals, 1, -1))


def _multiply(matrix: Array, vectors: Array) -> Array:
    """Matrix times vectors ``(b, n)``, for one matrix ``(a, b)`` or one for each vector ``(a, b, n)``."""
    if matrix.ndim == 2:
        return matrix @ vectors
    return np.asarray(np.einsum("abn,bn->an", matrix, np.broadcast_to(vectors, (vectors.shape[0], matrix.shape[2]))))
