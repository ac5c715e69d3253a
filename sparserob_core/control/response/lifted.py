"""An uncertain system over a cell of parameters, as one larger known system.

With ``p = centre + radius delta`` and ``A(p) = sum_g A_g delta^g + remainder``, the Taylor coefficients of the state in
``delta`` obey ``x_a' = sum_{g + b = a} A_g x_b + B_a u``: a known linear system of dimension ``d M``, propagated
exactly. What the truncation at degree ``q`` neglects obeys the same equation with a small drive, and is bounded by
Gronwall's inequality with the logarithmic norm (Dahlquist 1958). A known system is the case ``M = 1`` without any
remainder.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from itertools import accumulate

import numpy as np

from sparserob_core.control.enclosures.algebra import lifted_matrix, lifted_transitions
from sparserob_core.control.enclosures.cache import remember
from sparserob_core.control.enclosures.matrix_exponential import exponential
from sparserob_core.control.enclosures.taylor import TaylorSpace
from sparserob_core.control.problem.system import LinearSystem
from sparserob_core.control.response.response import Response, TimeGrid
from sparserob_core.sip.convex_set import Array

DEGREES = {0: 0, 1: 6, 2: 4, 3: 3}  # of the Taylor models, by the number of parameters; 2 beyond
HUGE = 300.0  # a logarithm of a growth that is as good as infinite
KNOWN = np.zeros((1, 0))
WELL_CONDITIONED = 1e3
# norm times length of the parts that pieces are cut into for what is neglected, and how many of a piece at most
SHORT, MOST_CUTS = (
    0.5,
    64,
)
PATHS_KEPT = 4


@dataclass(frozen=True, eq=False)
class LiftedSystem:
    """The Taylor models of a system over the cell ``centre +- radius`` (``(nu,)`` each) on a time grid.

    ``A (M, d, d)``, ``B (M, d, m)``, ``W (M, d, mw)`` are coefficients, ``slack_*`` norm bounds of their remainders.
    """

    space: TaylorSpace
    grid: TimeGrid
    initial_state: Array
    A: Array
    B: Array
    W: Array
    transform: Array
    slack_A: float
    slack_B: float
    slack_W: float

    @property
    def states(self) -> int:
        return int(self.A.shape[1])

    @cached_property
    def growth(self) -> float:
        """An upper bound of the logarithmic norm of ``A(p)`` over the cell."""
        symmetric = (self.A + np.swapaxes(self.A, 1, 2)) / 2
        return float(
            np.linalg.eigvalsh(symmetric[0])[-1] + np.linalg.norm(symmetric[1:], axis=(1, 2)).sum() + self.slack_A
        )

    @cached_property
    def norm(self) -> float:
        """An upper bound of the 2-norm of the lifted matrix, on columns and on rows (Golub and Van Loan 2013,
        2.3.3)."""
        size = max(
            np.abs(matrix).sum(axis=0).max() * np.abs(matrix).sum(axis=1).max()
            for matrix in (self.matrix, self.row_matrix)
        )
        return float(np.sqrt(size))

    @cached_property
    def matrix(self) -> Array:
        """The lifted matrix ``(M d, M d)`` that acts on columns: block (target, source) is ``A_g`` with
        ``g + source = target``."""
        return lifted_matrix(self.space, self.A, rows=False)

    @cached_property
    def row_matrix(self) -> Array:
        """The lifted matrix that acts on rows from the right."""
        return lifted_matrix(self.space, self.A, rows=True)

    @cached_property
    def fine(self) -> TimeGrid:
        """The grid with long pieces cut into equal parts: a norm bound over a part is only good if the system moves
        little on it."""
        counts, breaks = (
            np.clip(np.ceil(self.norm * self.grid.lengths / SHORT), 1, MOST_CUTS).astype(int),
            self.grid.breakpoints,
        )
        if not self.space.nu or counts.max() == 1:
            return self.grid
        inner = [
            np.linspace(a, b, count, endpoint=False)
            for a, b, count in zip(breaks[:-1], breaks[1:], counts, strict=True)
        ]
        return TimeGrid(
            np.concatenate([*inner, breaks[-1:]]),
            np.repeat(self.grid.control_piece, counts),
            np.repeat(self.grid.disturbance_piece, counts),
        )

    @cached_property
    def ends(self) -> np.ndarray:
        """Where the breakpoints of the grid are among those of the fine one, ``(L+1,)``."""
        return np.searchsorted(self.fine.breakpoints, self.grid.breakpoints)

    @cached_property
    def forward(self) -> Response:
        """The lifted system as a response on the fine grid; its states are the Taylor coefficients of the state,
        ``(M d,)``."""
        start = np.zeros(self.matrix.shape[0])
        start[: self.states] = self.initial_state
        drive = self.B.reshape(-1, self.B.shape[2])
        return Response(
            LinearSystem(self.matrix, drive), self.fine, start, lifted_transitions(self.space, self.A, rows=False)
        )

    @cached_property
    def backward(self) -> Response:
        """The adjoint of the lifted system; its functionals are Taylor coefficients of ``c'e^{A(p) t}``."""
        size = self.row_matrix.shape[0]
        propagate = lifted_transitions(self.space, self.A, rows=True)
        return Response(LinearSystem(self.row_matrix, np.zeros((size, 1))), self.grid, np.zeros(size), propagate)

    def nodes(self, control: Array) -> Array:
        """Taylor coefficients ``(L+1, M, d)`` of the state at the breakpoints, under ``control (m, K)``."""
        answer: Array = self._path(control)[self.ends]
        return answer

    def state_remainder(self, control: Array) -> Array:
        """Norm bounds ``(L,)``, per piece, of the neglected part of the state."""
        if self.space.nu == 0:
            return np.zeros(self.grid.pieces)
        inputs = control[:, self.fine.control_piece]
        driven = inputs.T @ self.forward.system.matrices(KNOWN)[1][0].T
        neglected = self._neglected(
            self._sizes(self._path(control), driven, self.matrix), np.abs(inputs).sum(axis=0) * self.slack_B
        )
        answer: Array = np.maximum.reduceat(neglected, self.ends[:-1])
        return answer

    def _path(self, control: Array) -> Array:
        """Taylor coefficients of the state at the breakpoints of the fine grid, remembered: all directions of a cell
        share them."""
        key = control.tobytes()
        if key not in self._paths:
            states = self.forward.states(control, KNOWN)[0]
            remember(self._paths, key, states.reshape(-1, self.space.size, self.states), PATHS_KEPT)
        return self._paths[key]

    @cached_property
    def _paths(self) -> dict[bytes, Array]:
        return {}

    def row_bounds(self, direction: Array) -> tuple[Array, Array]:
        """For the Taylor model of ``c'e^{A(p) s}``, read backwards from ``t``: norms ``(L', M)`` of its coefficients,
        the largest on every piece of the fine grid, and norm bounds ``(L',)`` of its neglected part."""
        sizes = self._sizes(self.row_nodes(direction), np.zeros(1), self.row_matrix.T)
        return sizes, self._neglected(sizes, np.zeros(self.fine.pieces))

    def row_nodes(self, direction: Array) -> Array:
        """Taylor coefficients ``(L'+1, M, d)`` of ``c'e^{A(p) s}`` at the breakpoints ``s`` of the fine grid."""
        row = np.zeros(self.row_matrix.shape[0])
        row[: self.states] = direction
        still = np.zeros((1, int(self.grid.control_piece.max()) + 1))
        path = replace(self._transposed, initial_state=row).states(still, KNOWN)
        answer: Array = path[0].reshape(-1, self.space.size, self.states)
        return answer

    @cached_property
    def _transposed(self) -> Response:
        """Rows as states; its transitions are shared by all of them."""
        size = self.row_matrix.shape[0]
        propagate = lifted_transitions(self.space, self.A, rows=True, transposed=True)
        return Response(LinearSystem(self.row_matrix.T, np.zeros((size, 1))), self.fine, np.zeros(size), propagate)

    def _sizes(self, nodes: Array, driven: Array, matrix: Array) -> Array:
        """Norms ``(L', M)`` of Taylor coefficients, the largest on every fine piece: at its ends, or between them, near
        their chord."""
        lengths = self.fine.lengths
        second = ((nodes[:-1].reshape(lengths.size, -1) @ matrix.T + driven) @ matrix.T).reshape(
            lengths.size, self.space.size, -1
        )
        norms = np.linalg.norm(nodes, axis=2)
        return np.asarray(
            np.maximum(norms[:-1], norms[1:])
            + (lengths**2 / 8)[:, None] * (np.linalg.norm(second, axis=2) @ self._growths.T)
        )

    def _neglected(self, norms: Array, extra: Array) -> Array:
        """Gronwall: ``|e|' <= growth |e| + residual``, with the residual of the truncation bounded on every fine
        piece."""
        lengths = self.fine.lengths
        residual = norms @ self.spilt(self.A) + norms.sum(axis=1) * self.slack_A + extra
        factor = grown(self.growth * lengths)
        added = residual * (
            grown_less_one(self.growth * lengths) / self.growth if abs(self.growth) > 1e-12 else lengths
        )
        bound = np.array(
            list(
                accumulate(
                    zip(factor.tolist(), added.tolist(), strict=True),
                    lambda b, step: b * step[0] + step[1],
                    initial=0.0,
                )
            )
        )
        answer: Array = bound[:-1] * np.maximum(factor, 1.0) + np.maximum(added, residual * lengths)
        return answer

    @cached_property
    def _growths(self) -> Array:
        """``G (M, M)``: the norm of coefficient ``a`` of ``e^{lifted r} z`` is at most ``sum_b G_ab |z_b|``, ``r`` up
        to the longest fine piece."""
        left, right, target = self.space.products
        sizes = np.zeros((self.space.size, self.space.size))
        sizes[target, right] = np.linalg.norm(self.A, axis=(1, 2))[left]
        exponent = sizes * self.fine.lengths.max()
        return exponential(exponent) if exponent.max() < HUGE else np.full(sizes.shape, np.inf)

    def spilt(self, coefficients: Array) -> Array:
        """For every monomial, the norms of those ``coefficients (M, ...)`` of a factor that push its product out of the
        space, ``(M,)``."""
        leaves = self.space.degrees[:, None] + self.space.degrees[None, :] > self.space.degree
        answer: Array = leaves @ np.linalg.norm(coefficients, axis=(1, 2))
        return answer


def grown(exponent: Array) -> Array:
    """``e^x``, infinite where it is as good as that."""
    return np.where(exponent > HUGE, np.inf, np.exp(np.minimum(exponent, HUGE)))


def grown_less_one(exponent: Array) -> Array:
    """``e^x - 1``, infinite where it is as good as that."""
    return np.where(exponent > HUGE, np.inf, np.expm1(np.minimum(exponent, HUGE)))


def lift(system: LinearSystem, grid: TimeGrid, initial_state: Array, centre: Array, radius: Array) -> LiftedSystem:
    """The lifted system over a cell, in the coordinates ``x = T z`` with ``T`` its `transform`; raises `NotEnclosable`
    when it has none."""
    space = _space(centre.size)
    A, slack_A, B, slack_B, W, slack_W = system.taylor(space, centre, radius)
    T = _modal(A[0]) if centre.size else np.eye(A.shape[1])
    inverse = np.linalg.inv(T)
    norm = np.linalg.norm
    return LiftedSystem(
        space,
        grid,
        inverse @ initial_state,
        inverse @ A @ T,
        inverse @ B,
        inverse @ W,
        T,
        float(norm(inverse, 2) * norm(slack_A) * norm(T, 2)),
        float(norm(inverse, 2) * norm(slack_B)),
        float(norm(inverse, 2) * norm(slack_W)),
    )


def frozen(system: LinearSystem, grid: TimeGrid, initial_state: Array, parameter: Array) -> LiftedSystem:
    """The system at one parameter, without any expansion."""
    A, B, W = system.matrices(parameter[None])
    return LiftedSystem(_space(0), grid, initial_state, A, B, W, np.eye(A.shape[1]), 0.0, 0.0, 0.0)


def _modal(A: Array) -> Array:
    """Real modal coordinates, in which the logarithmic norm is the spectral abscissa; the identity where they are ill
    conditioned."""
    values, vectors = np.linalg.eig(A)
    columns = [
        part
        for i, value in enumerate(values)
        if value.imag >= 0
        for part in ((vectors[:, i].real,) if value.imag == 0 else (vectors[:, i].real, vectors[:, i].imag))
    ]
    T = np.stack(columns, axis=1)
    return T if np.linalg.cond(T) < WELL_CONDITIONED else np.eye(A.shape[0])


_SPACES: dict[int, TaylorSpace] = {}


def _space(nu: int) -> TaylorSpace:
    if nu not in _SPACES:
        _SPACES[nu] = TaylorSpace(nu, DEGREES.get(nu, 2))
    return _SPACES[nu]
