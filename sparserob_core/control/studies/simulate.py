"""Many trajectories at once, exactly: matrix exponentials of the pieces, no time stepping."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import TYPE_CHECKING

import numpy as np

from sparserob_core.control.constraints.flat import INSIDE, MOST_INSIDE, SMOOTH
from sparserob_core.control.enclosures.decoupling import decoupled, pace
from sparserob_core.control.enclosures.flows import Flows
from sparserob_core.control.enclosures.matrix_exponential import transitions
from sparserob_core.control.response.parameters import ParameterIndex
from sparserob_core.control.response.response import Response, TimeGrid, distinct_times
from sparserob_core.sip.convex_set import Array

if TYPE_CHECKING:
    from sparserob_core.control.response.measurable import Execution

MANY = 10_000  # pieces, from which no times inside are looked at where the system hardly moves on one
HELD = 2_000_000  # numbers of signals, or of transition matrices, that are held at once


def fine_times(response: Response, parameters: ParameterIndex, more: Array) -> Array:
    """The breakpoints, ``more (k,)`` times, and times inside every piece: three of them, or more where the system moves
    on it, and fewer where there are many pieces; ``(T,)``."""
    grid = response.grid
    points = parameters.lattice()[0]
    rate = max(pace(A) for mode in response.system.modes for A in mode.matrices(points)[0])
    fewest = INSIDE + 1 if grid.pieces < MANY else 1
    counts = np.clip(np.ceil(rate * grid.lengths / SMOOTH), fewest, MOST_INSIDE).astype(int)
    place = np.arange(counts.sum()) - np.repeat(np.cumsum(counts) - counts, counts)
    inside = np.repeat(grid.breakpoints[:-1], counts) + np.repeat(grid.lengths, counts) * place / np.repeat(
        counts, counts
    )
    return distinct_times(np.concatenate([inside, more, grid.breakpoints[-1:]]), float(grid.breakpoints[-1]))


def finer(grid: TimeGrid, times: Array) -> TimeGrid:
    """A grid on other times, ``(T,)`` from 0 to the horizon, that include the breakpoints; its inputs are given on the
    pieces of ``grid``."""
    return grid.refined(times)


def walk(
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
    grid = response.grid
    if grid.varying:
        yield from _walk_varying(response, control, parameters.shape[0], disturbances, initial_states)
        return
    modes = [
        [np.moveaxis(matrix, 0, -1) if parameters.shape[1] else matrix[0] for matrix in mode.matrices(points)]
        for points in [parameters if parameters.shape[1] else parameters[:1]]
        for mode in response.system.modes
    ]
    signal = None if disturbances is None else np.ascontiguousarray(disturbances.transpose(2, 1, 0))
    lengths, which = grid.distinct(grid.lengths)
    if not parameters.shape[1] and grid.mode is None and lengths.size * 4 * response.system.states**2 > HELD:
        yield from _walk_by_modes(response, control, parameters.shape[0], disturbances, initial_states)
        return
    state = np.repeat(response.initial_state[:, None], parameters.shape[0], axis=1)
    if initial_states is not None:
        state = np.ascontiguousarray(initial_states.T)
    yield state
    before, sigma, mode = (-1, -1, -1, -1), np.zeros(0), -1
    driven = np.zeros(0)
    for piece in range(grid.pieces):
        acting = 0 if grid.mode is None else int(grid.mode[piece])
        if acting != mode:
            mode, (A, B, W) = acting, modes[acting]
            flows, integrals = _transitions(A, lengths)
        inputs = (int(which[piece]), int(grid.control_piece[piece]), int(grid.disturbance_piece[piece]), mode)
        if inputs != before:
            if callable(control):
                driven = control(inputs[1], state) if inputs[1] != before[1] else driven
            else:
                driven = control[:, inputs[1], None]
            drive = _times(B, driven)
            sigma, before = (
                _times(integrals[inputs[0]], drive if signal is None else drive + _times(W, signal[inputs[2]])),
                inputs,
            )
        state = _times(flows[inputs[0]], state) + sigma
        yield state


def _walk_by_modes(
    response: Response,
    control: Array | Callable[[int, Array], Array],
    count: int,
    disturbances: Array | None,
    initial_states: Array | None,
) -> Iterator[Array]:
    """`walk` of a known system with many states on pieces of many lengths, in coordinates in which its modes are apart:
    no matrix is held for a length."""
    grid = response.grid
    A, B, W = (part[0] for part in response.system.modes[0].matrices(np.zeros((1, 0))))
    basis = decoupled(A)
    flows, inverse = Flows(basis, basis.normal_form(basis.matrix(A)[0])), basis.inverse.astype(float)
    B, W = inverse @ B, inverse @ W
    begun = np.repeat(response.initial_state[None], count, axis=0) if initial_states is None else initial_states
    yield begun.T.copy()
    state = begun @ inverse.T
    for piece, length in enumerate(grid.lengths.tolist()):
        acting = int(grid.control_piece[piece])
        driven = control(acting, basis.transform @ state.T) if callable(control) else control[:, acting, None]
        drive = np.broadcast_to(_times(B, driven).T, state.shape)
        if disturbances is not None:
            drive = drive + disturbances[:, :, grid.disturbance_piece[piece]] @ W.T
        state = flows.columns(state, drive, np.full(count, length))
        yield basis.transform @ state.T


def _walk_varying(
    response: Response,
    control: Array | Callable[[int, Array], Array],
    count: int,
    disturbances: Array | None,
    initial_states: Array | None,
) -> Iterator[Array]:
    """`walk` of a system that changes with time, which is known."""
    grid, steps = response.grid, response.steps(np.zeros((1, 0)))
    state = np.repeat(response.initial_state[:, None], count, axis=1)
    state = state if initial_states is None else np.ascontiguousarray(initial_states.T)
    yield state
    decided, before = np.zeros(0), -2
    for piece, (B, E) in enumerate(zip(grid.of_modes(steps.B[0]), grid.of_modes(steps.E[0]), strict=True)):
        acting = int(grid.control_piece[piece])
        if acting != before:
            decided, before = control(acting, state) if callable(control) else control[:, acting, None], acting
        drive = B @ decided
        if disturbances is not None:
            drive = drive + E @ disturbances[:, :, grid.disturbance_piece[piece]].T
        state = steps.Phi[0, piece] @ state + steps.Gamma[0, piece] @ drive
        yield state


def delivered(command: Array, errors: Array) -> Callable[[int, Array], Array]:
    """What `walk` drives a system with where a ``command (m + constants, L)`` is missed by ``errors (L, m, n)``, as
    shares of it, in ``n`` trajectories."""

    def acting(piece: int, state: Array) -> Array:
        now = np.repeat(command[:, piece, None], state.shape[1], axis=1)
        now[: errors.shape[1]] *= 1.0 + errors[piece]
        return now

    return acting


def worst_errors(response: Response, execution: Execution, command: Array, at: tuple[Array, Array, Array]) -> Array:
    """The errors ``(L, m, k)``, constant on the pieces of a response, that raise functionals ``c'x(t)`` the most,
    ``at`` times ``(k,)``, directions ``(k, d)`` and parameters, of a ``command (m + constants, L)`` as shares of it."""
    weights = response.weights(*at).control[:, :, : execution.shares.size].transpose(1, 2, 0)
    return np.asarray(execution.shares[:, None] * np.sign(weights * command[: execution.shares.size].T[:, :, None]))


def trajectories_at_once(response: Response, uncertain: bool) -> int:
    """How many trajectories are held in memory together."""
    grid, system = response.grid, response.system
    signals = HELD // (max(1, system.disturbances) * (int(grid.disturbance_piece.max()) + 1))
    flows = HELD // (grid.distinct(grid.lengths)[0].size * 4 * system.states**2) if uncertain else signals
    return int(np.clip(min(signals, flows), 16, 4096))


def _transitions(A: Array, lengths: Array) -> tuple[Array, Array]:
    """``e^{A r}`` and its integral for every distinct length, ``(q, d, d)``, or ``(q, d, d, n)`` for ``n`` matrices
    ``(d, d, n)``. A known system is taken in units in which it is small, powers of two: in metres and seconds an orbit
    is known a hundred times better so."""
    from scipy.linalg import matrix_balance

    if A.ndim == 2:
        balanced, (units, _) = matrix_balance(A, permute=False, separate=True)
        back = units[:, None] / units
        flows, integrals = transitions(balanced[None], lengths)
        return flows * back, integrals * back
    flows, integrals = transitions(np.moveaxis(A, -1, 0)[None], lengths[:, None])
    return np.ascontiguousarray(np.moveaxis(flows, 1, -1)), np.ascontiguousarray(np.moveaxis(integrals, 1, -1))


def _times(matrix: Array, vectors: Array) -> Array:
    """Matrix times vectors ``(b, n)``, for one matrix ``(a, b)`` or one for each vector ``(a, b, n)``."""
    if matrix.ndim == 2:
        return matrix @ vectors
    return np.asarray(np.einsum("abn,bn->an", matrix, np.broadcast_to(vectors, (vectors.shape[0], matrix.shape[2]))))
