"""Quadratic costs of the nominal trajectory, exactly: integrals of the flow in closed form (Van Loan 1978, Theorem 1).

On a piece of length ``h`` the control is constant, so ``z = (x - r, 1, u)`` obeys ``z' = F z`` and
``int_0^h z'M z dt = z(0)' W(h) z(0)`` with ``W(h) = int_0^h e^{F't} M e^{Ft} dt``. For a short piece ``W`` is
read off one exponential; ``W(2h) = W(h) + e^{F'h} W(h) e^{Fh}`` doubles it, a sum of matrices without a sign that could
cancel.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.linalg import expm
from scipy.sparse import csc_array, diags_array, eye_array, kron

from sparserob_core.control.problem.cost import nominal_point
from sparserob_core.control.problem.dictionary import Dictionary
from sparserob_core.control.problem.problem import OptimalControlProblem
from sparserob_core.control.response.response import Propagator
from sparserob_core.control.response.time_grid import TimeGrid
from sparserob_core.control.transcription.grid import grid_of
from sparserob_core.errors import InputError
from sparserob_core.sip.convex_set import Array

COUPLING_LIMIT = 5000  # values of a control that may be coupled: a matrix of their square
# Of Gauss' rule, on times on which the norm of A is at most 2: half of them leave a millionth of a digit
GAUSS_POINTS = 16
MAX_EXPONENT_NORM = 0.5  # the norm of F h up to which W is read off one exponential


@dataclass(frozen=True, eq=False)
class QuadraticCost:
    """Quadratic cost ``u'P u / 2 + q'u + constant`` in the control's values on its pieces, channel-major ``(m K,)``."""

    P: csc_array
    q: Array
    constant: float

    def on(self, dictionary: Dictionary) -> QuadraticCost:
        """Return the same cost in the coefficients of a dictionary, ``(m N,)``."""
        if dictionary.is_indicators:
            return self
        V = csc_array(kron(eye_array(self.q.size // dictionary.pieces), dictionary.sparse))
        P = V @ self.P @ V.T
        return QuadraticCost(csc_array((P + P.T) / 2), np.asarray(V @ self.q), self.constant)

    def largest(self, reach: Array) -> float:
        """Return the largest value of the cost at a control that stays 0, or stays at ``+-reach_i`` in one of the ``m``
        channels."""
        held_controls = np.kron(np.diag(reach), np.ones(self.q.size // reach.size))
        quadratic, slope = (
            np.einsum("ik,ik->i", held_controls, held_controls @ self.P) / 2,
            np.abs(held_controls @ self.q),
        )
        return float(max(self.constant, self.constant + (quadratic + slope).max()))


@dataclass(frozen=True, eq=False)
class NominalPieces:
    """Effect of every piece of time on the nominal ``z = (x - r, 1, u)``, for ``q`` different pieces.

    ``which (L,)``: the kind of each piece of time. ``acts (L,)``: the piece of the control that acts on it, -1 where
    none acts yet. ``flow (q, d + 1 + m, d + 1 + m)``: the transition of ``z``; ``weight``, of the same shape: the
    matrix ``W``. ``start (d + 1,)``: the initial ``(x - r, 1)``. ``end (d + 1, d + 1)``: the matrix of the cost of the
    final state.
    """

    which: np.ndarray
    acts: np.ndarray
    flow: Array
    weight: Array
    start: Array
    end: Array


def nominal_pieces(problem: OptimalControlProblem, breakpoints: Array) -> NominalPieces:
    """Return the nominal trajectory of a problem whose control changes at ``breakpoints (K + 1,)``, and its cost."""
    system, (state, _, final) = problem.system, problem.cost.terms
    d, m, horizon = system.states, system.controls, float(breakpoints[-1])
    first_control = np.zeros(m) if problem.initial_control is None else np.asarray(problem.initial_control, dtype=float)
    grid = grid_of(problem, breakpoints, np.array([0.0, horizon]))
    parameter = np.zeros(0) if system.parameters is None else nominal_point(system.parameters)
    modes = [[matrix[0] for matrix in mode.matrices(parameter[None])] for mode in system.forced.modes]
    reference = np.zeros(d) if state is None else state.reference
    noise = np.zeros(system.disturbances) if problem.disturbance is None else nominal_point(problem.disturbance)
    M = np.zeros((d + 1 + m, d + 1 + m))
    if state is not None:
        M[:d, :d] = state.Q
    if system.varies:
        propagator = Propagator(system.at(parameter).forced, grid)
        kind_of_piece, (flows, weights) = (
            np.arange(grid.pieces),
            _integrate_varying(propagator, reference, noise, first_control, M),
        )
    else:
        kind_of_piece, flows, weights = _integrate_by_kind(grid, modes, reference, noise, first_control, M)
    end = np.zeros((d + 1, d + 1))
    if final is not None:
        final_deviation = np.hstack([np.eye(d), (reference - final.reference)[:, None]])
        end = final_deviation.T @ final.Q @ final_deviation
    begin = np.asarray(problem.initial_state, dtype=float)
    if problem.initial_set is not None:
        begin = begin + nominal_point(problem.initial_set)
    start = np.append(begin - reference, 1.0)
    return NominalPieces(kind_of_piece, grid.control_piece, flows, weights, start, end)


def _integrate_by_kind(
    grid: TimeGrid, modes: Sequence[Sequence[Array]], reference: Array, noise: Array, given: Array, M: Array
) -> tuple[np.ndarray, Array, Array]:
    """Return the kind of every piece ``(L,)``, and the flows and weights of each kind (`NominalPieces`). Pieces of one
    kind have the same length and the same phase, and the control acts on all of them or on none."""
    d, m = reference.size, given.size
    decided, mode = grid.control_piece >= 0, grid.modes
    kinds, kind_of_piece = np.unique(
        np.column_stack([np.round(grid.lengths / float(grid.breakpoints[-1]), 13), decided, mode]),
        axis=0,
        return_inverse=True,
    )
    kind_of_piece = kind_of_piece.reshape(-1)
    # the rounding of equal pieces must not add up
    means = np.bincount(kind_of_piece, grid.lengths) / np.bincount(kind_of_piece)
    flows, weights = [], []
    for length, (_, acting, number) in zip(means, kinds, strict=True):
        F, (A, B, E) = np.zeros_like(M), modes[int(number)]
        drift = A @ reference + B[:, m:].sum(axis=1) + E @ noise
        F[:d, :d], F[:d, d] = A, drift if acting else drift + B[:, :m] @ given
        F[:d, d + 1 :] = B[:, :m] if acting else 0.0
        flow, weight = _integrate_weight(F, M, float(length))
        flows.append(flow)
        weights.append(weight)
    return kind_of_piece, np.stack(flows), np.stack(weights)


def _integrate_varying(
    propagator: Propagator, reference: Array, noise: Array, given: Array, M: Array
) -> tuple[Array, Array]:
    """Return the flows and weights of every piece of a system that changes with time, ``(L, ...)`` each. The integrals
    use Gauss' rule between the times at which the system becomes another polynomial."""
    grid, expansion, d = propagator.grid, propagator.expansion, reference.size
    assert expansion is not None
    m = M.shape[0] - d - 1

    def compute_transitions(pieces: np.ndarray, stops: Array) -> Array:
        flow, decided = expansion.flow(grid.breakpoints[pieces], stops), grid.control_piece[pieces] >= 0
        transitions = np.tile(np.eye(M.shape[0]), (stops.size, 1, 1))
        drift = flow.state @ reference - reference + flow.control[:, :, m:].sum(axis=2) + flow.disturbance @ noise
        drift[~decided] += (flow.control[:, :, :m] @ given)[~decided]
        transitions[:, :d, :d], transitions[:, :d, d], transitions[:, :d, d + 1 :] = (
            flow.state,
            drift,
            flow.control[:, :, :m],
        )
        transitions[~decided, :d, d + 1 :] = 0.0
        return transitions

    points, shares = np.polynomial.legendre.leggauss(GAUSS_POINTS)
    half = np.diff(propagator.marks)[:, None] / 2
    times = (propagator.marks[:-1, None] + half * (1.0 + points)).ravel()
    pieces, weights = grid.locate(times), np.zeros((grid.pieces, *M.shape))
    inside = compute_transitions(pieces, times)
    np.add.at(weights, pieces, np.swapaxes(inside, 1, 2) @ M @ inside * (half * shares).reshape(-1, 1, 1))
    return compute_transitions(np.arange(grid.pieces), grid.breakpoints[1:]), weights


def quadratic_cost(problem: OptimalControlProblem, breakpoints: Array) -> QuadraticCost:
    """Return the quadratic terms of a problem's cost as one quadratic function of the control's values on its
    pieces."""
    (state, control, final), m = problem.cost.terms, problem.system.controls
    size = m * (breakpoints.size - 1)
    P, q, constant = csc_array((size, size)), np.zeros(size), 0.0
    if control is not None:
        P = csc_array(2.0 * kron(csc_array(control.Q), diags_array(np.diff(breakpoints))))
    if state is not None or final is not None:
        if size > COUPLING_LIMIT:
            raise InputError(
                f"a quadratic cost of the state couples all {size} values of the control, at most {COUPLING_LIMIT} can"
                " be; expected fewer pieces",
                path="cost",
            )
        coupled, q, constant = _condense_state_cost(nominal_pieces(problem, breakpoints), m, size)
        P = csc_array(P + csc_array(coupled))
    return QuadraticCost(P, q, constant)


def _condense_state_cost(pieces: NominalPieces, m: int, size: int) -> tuple[Array, Array, float]:
    """Return ``P (m K, m K)``, ``q (m K,)`` and the constant of the cost of the state.

    ``V`` is the cost of the free motion from the start of a piece ``l`` of time. By telescoping, the whole cost is
    ``x_0'V_0 x_0 + sum_l 2 x_l'H_l u_l + u_l'U_l u_l`` with the state ``x_l`` at the start of piece ``l``. There ``x_l
    = f_l + X_l u`` for the free motion ``f`` and the response ``X`` to the controls before.
    """
    L, e, K = pieces.which.size, pieces.start.size, size // m
    free, forced = pieces.flow[:, :e, :e], pieces.flow[:, :e, e:]
    H, U = np.empty((L, e, m)), np.empty((L, m, m))
    V = pieces.end
    for piece in range(L - 1, -1, -1):
        i = pieces.which[piece]
        W, Phi, Gamma = pieces.weight[i], free[i], forced[i]
        after = V @ Gamma
        H[piece] = W[:e, e:] + Phi.T @ after
        U[piece] = W[e:, e:] + Gamma.T @ after
        V = W[:e, :e] + Phi.T @ V @ Phi
        V = (V + V.T) / 2
    P, q = np.zeros((K, m, K, m)), np.zeros((K, m))
    x, X, last = pieces.start, np.zeros((e, K * m)), 0
    for piece in range(L):
        i, k = pieces.which[piece], int(pieces.acts[piece])
        if k >= 0:
            q[k] += 2.0 * (x @ H[piece])
            before = 2.0 * (X[:, : last * m].T @ H[piece])
            P[:last, :, k, :] += before.reshape(last, m, m)
            P[k, :, :last, :] += before.T.reshape(m, last, m)
            P[k, :, k, :] += U[piece] + U[piece].T
            last = max(last, k + 1)
        X[:, : last * m] = free[i] @ X[:, : last * m]
        if k >= 0:
            X[:, k * m : (k + 1) * m] += forced[i]
        x = free[i] @ x
    constant = float(pieces.start @ V @ pieces.start)
    return P.transpose(1, 0, 3, 2).reshape(size, size), q.T.ravel(), constant


def _integrate_weight(F: Array, M: Array, length: float) -> tuple[Array, Array]:
    """Return ``e^{F h}`` and ``int_0^h e^{F't} M e^{Ft} dt``."""
    size = F.shape[0]
    doublings = max(0, int(np.ceil(np.log2(max(np.abs(F).sum(axis=0).max() * length / MAX_EXPONENT_NORM, 1e-300)))))
    short = length / 2.0**doublings
    block = np.zeros((2 * size, 2 * size))
    block[:size, :size], block[:size, size:], block[size:, size:] = -F.T, M, F
    exponential = expm(block * short)
    flow = exponential[size:, size:]
    weight = flow.T @ exponential[:size, size:]
    weight = (weight + weight.T) / 2
    for _ in range(doublings):
        weight = weight + flow.T @ weight @ flow
        flow = flow @ flow
    return flow, weight
