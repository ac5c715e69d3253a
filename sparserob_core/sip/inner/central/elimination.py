"""Elimination of one block from a Newton system: its share of the Schur complement, and solutions with its matrix.

The matrix of a block of ``n`` variables is ``M = D + A' W A``. ``D`` is the diagonal of the absolute values that hold a
single variable; ``A (k, n)`` has the few that hold several. The coupling of the block to the parts is ``B``.
``M u = r`` is ``D u + A' y = r`` and ``A u - W^-1 y = 0``. The pivots are the diagonal as far as that is safe, and then
the rows. A block with few rows therefore costs ``k n`` instead of ``n^2`` operations for a part, and the Newton step
about a quarter.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol, final

import numpy as np
from scipy.linalg import lapack

from sparserob_core.sip.convex_set import Array
from sparserob_core.sip.inner.central.layout import Block

LARGE = 100  # variables of a block from which on fewer operations are less time: calls take as long below
SAFE = 1e-4  # share of what rows add to an entry of the diagonal that makes it a pivot: 4 of 16 digits are lost
SPARE = 0.5  # share of the variables that there may be other pivots: beyond, nothing is gained
GREATER = 1e-14  # by which a diagonal is enlarged, relative to itself

State = tuple[Array, ...]


class Eliminated(Protocol):
    """A block that is eliminated."""

    def forward(self, r: Array) -> tuple[State, Array]:
        """Return a right-hand side among the pivots, and what it makes of the parts: ``B' M^-1 r``."""
        ...

    def back(self, state: State, parts: Array) -> Array:
        """Return the variables: ``M^-1 (r - B parts)``."""
        ...


@final
class Left:
    """Contribution of eliminated blocks to the Schur complement over their ``parts``: the sum of ``B' M^-1 B``. Tall
    matrices are multiplied at once."""

    def __init__(self, parts: int) -> None:
        self.parts = parts
        self._total, self._cross = np.zeros((parts, parts)), np.zeros((parts, parts))
        self._diagonal = np.zeros(parts)
        self._added, self._subtracted = list[Array](), list[Array]()

    def at(self, columns: np.ndarray, values: Array) -> None:
        """Add ``values`` to entries of the diagonal."""
        self._diagonal += np.bincount(columns, values, self.parts)

    def cross(self, at: np.ndarray, rows: Array) -> None:
        """Add rows, and their transposes."""
        self._cross[at] += rows

    def more(self, X: Array) -> None:
        """Add ``X' X``, at once where ``X`` is as tall as it is wide or nearly."""
        if 4 * X.shape[0] > self.parts:
            self._total += X.T @ X
        elif X.size:
            self._added.append(X)

    def less(self, X: Array) -> None:
        """Subtract ``X' X``."""
        if X.size:
            self._subtracted.append(X)

    def total(self) -> Array:
        """Return the sum."""
        for sign, matrices in ((1.0, self._added), (-1.0, self._subtracted)):
            if matrices:
                tall = np.vstack(matrices)
                self._total += sign * (tall.T @ tall)
        self._total += self._cross + self._cross.T
        self._total.reshape(-1)[:: self.parts + 1] += self._diagonal
        return self._total


@final
@dataclass(eq=False)
class Whole:
    """A block by the Cholesky factor of its matrix. Its coupling is kept as it is, ``single`` of single absolute values
    and ``rows`` of the others: solved for, it would be as tall as the block and as wide as all parts."""

    block: Block
    factor: Array
    single: Array
    rows: Array
    parts: int

    def forward(self, r: Array) -> tuple[State, Array]:
        """Return a right-hand side among the pivots, and what it makes of the parts."""
        block, u = self.block, self._solve_with_factor(r)
        reduced_rhs: Array = np.bincount(block.columns, self.single * u[block.of], self.parts).astype(float)
        reduced_rhs += np.bincount(block.mixed, self.rows @ u, self.parts)
        return (r,), reduced_rhs

    def back(self, state: State, parts: Array) -> Array:
        """Return the variables."""
        block = self.block
        r = state[0] - np.bincount(block.of, self.single * parts[block.columns], state[0].size)
        return self._solve_with_factor(r - parts[block.mixed] @ self.rows)

    def _solve_with_factor(self, r: Array) -> Array:
        intermediate, _ = lapack.dtrtrs(self.factor, r, lower=1)
        u, _ = lapack.dtrtrs(self.factor, intermediate, lower=1, trans=1)
        return np.asarray(u)


@final
@dataclass(eq=False)
class Lean:
    """A block by its pivots. First come the safe entries ``1 / inverse`` of the diagonal; then the rows, by the factor
    ``T`` of ``W^-1 + A D^-1 A'`` over the safe entries. The ``others`` follow, by the factor ``H`` of ``D + Z' Z``,
    where ``Z`` is ``T^-1 A``. ``Q (k, p)`` and ``R`` are the coupling among the pivots of rows and of the others,
    ``single`` and ``kept`` what is coupled of single absolute values and of rows."""

    block: Block
    inverse: Array
    single: Array
    kept: Array
    others: np.ndarray
    T: Array
    Q: Array
    Z: Array
    H: Array
    R: Array

    def forward(self, r: Array) -> tuple[State, Array]:
        """Return a right-hand side among the pivots, and what it makes of the parts."""
        block, u = self.block, self.inverse * r
        reduced_rhs = np.zeros(self.Q.shape[1])
        reduced_rhs[block.columns] = self.single * u[block.of]
        if not block.at.size:
            return (r,), reduced_rhs
        q = block.A @ u
        y, _ = lapack.dtrtrs(self.T, q, lower=1)
        reduced_rhs[block.mixed] += self.kept * q
        reduced_rhs -= y @ self.Q
        v = r[self.others]
        if v.size:
            v, _ = lapack.dtrtrs(self.H, v - self.Z.T @ y, lower=1)
            reduced_rhs += v @ self.R
        return (r, y, v), reduced_rhs

    def back(self, state: State, parts: Array) -> Array:
        """Return the variables."""
        block = self.block
        r = state[0] - np.bincount(block.of, self.single * parts[block.columns], self.inverse.size)
        if not block.at.size:
            return np.asarray(self.inverse * r)
        _, y, v = state
        y = y - self.Q @ parts
        if v.size:
            v, _ = lapack.dtrtrs(self.H, v - self.R @ parts, lower=1, trans=1)
            y += self.Z @ v
        y, _ = lapack.dtrtrs(self.T, y, lower=1, trans=1)
        u = self.inverse * (r - (y + self.kept * parts[block.mixed]) @ block.A)
        u[self.others] = v
        return np.asarray(u)


def eliminate(block: Block, D: Array, weight: Array, lean: Array, left: Left) -> Eliminated:
    """Eliminate a block, and add what it leaves to ``left``. ``D (n,)``: the diagonal; of all absolute
    values: ``weight (J,)``, and ``lean (J,)``, by which its part is coupled to it."""
    lean_block = _eliminate_lean(block, D, weight, lean, left) if block.once and D.size > LARGE else None
    return _eliminate_whole(block, D, weight, lean, left) if lean_block is None else lean_block


def _eliminate_whole(block: Block, D: Array, weight: Array, lean: Array, left: Left) -> Whole:
    n, A = D.size, block.A
    scaled = A * np.sqrt(weight[block.at])[:, None]
    M = scaled.T @ scaled
    M.reshape(-1)[:: n + 1] += D
    factor = cholesky(M)
    single, rows = block.value * lean[block.single], A * lean[block.at][:, None]
    B = np.zeros((n, left.parts), order="F")
    if block.once:
        B[:, block.mixed] = rows.T
    else:
        np.add.at(B.T, block.mixed, rows)
    np.add.at(B, (block.of, block.columns), single)
    X, _ = lapack.dtrtrs(factor, B, lower=1, overwrite_b=1)
    left.more(X)
    return Whole(block, factor, single, rows, left.parts)


def _eliminate_lean(block: Block, D: Array, weight: Array, lean: Array, left: Left) -> Lean | None:
    """Return the block by its pivots; ``None`` where these are too many.

    A part is coupled by ``B = S + A' m``. ``[A' m; 0]`` is the sum of ``[D, A'; A, -W^-1] [0; m]`` and ``[0; W^-1 m]``.
    For a row of great weight the diagonal would leave a small difference of large numbers. Such a row takes a small
    right-hand side of its own instead, which leaves ``m^2 / w``; of the other rows ``m`` is ``kept``.
    """
    A, w, m = block.A, weight[block.at], lean[block.at]
    k, n = A.shape
    unsafe = np.flatnonzero(~block.alone | (SAFE * (w @ (A * A)) > D))
    if k + unsafe.size > SPARE * n:
        return None
    inverse = 1.0 / D
    inverse[unsafe] = 0.0
    AD = A * inverse
    T = AD @ A.T
    diagonal = T.reshape(-1)[:: k + 1]
    is_heavy = w * diagonal > 1.0
    kept = np.where(is_heavy, 0.0, m)
    single = block.value * lean[block.single]
    left.at(block.columns, single * single * inverse[block.of])
    left.at(block.mixed, np.where(is_heavy, m * m / w, 0.0))
    Q = np.zeros((k, left.parts))
    Q[:, block.columns] = AD[:, block.of] * single
    rows = kept[:, None] * Q
    rows[:, block.mixed] += kept[:, None] * T * kept / 2.0
    left.cross(block.mixed, rows)
    coupling = T * kept
    coupling.reshape(-1)[:: k + 1] -= np.where(is_heavy, m / w, 0.0)
    Q[:, block.mixed] += coupling
    diagonal += 1.0 / w
    T = cholesky(T)
    Q, _ = lapack.dtrtrs(T, Q, lower=1)
    left.less(Q)
    Z, _ = lapack.dtrtrs(T, A[:, unsafe], lower=1)
    H, R = Z.T @ Z, np.zeros((unsafe.size, left.parts))
    if unsafe.size:
        H.reshape(-1)[:: unsafe.size + 1] += D[unsafe]
        H = cholesky(H)
        position = np.full(n, -1)
        position[unsafe] = np.arange(unsafe.size)
        entries = np.flatnonzero(position[block.of] >= 0)
        R[position[block.of[entries]], block.columns[entries]] = single[entries]
        R[:, block.mixed] += A[:, unsafe].T * kept
        R, _ = lapack.dtrtrs(H, R - Z.T @ Q, lower=1)
        left.more(R)
    return Lean(block, inverse, single, kept, unsafe, T, Q, Z, H, R)


def cholesky(M: Array) -> Array:
    """Return the lower factor of a positive definite matrix, whose diagonal is enlarged until it is one."""
    diagonal, increase = M.reshape(-1)[:: M.shape[0] + 1], GREATER
    while increase < 1e-6:
        diagonal *= 1.0 + increase
        factor, info = lapack.dpotrf(M, lower=1, clean=1)
        if not info:
            return np.asarray(factor)
        increase *= 100.0
    raise np.linalg.LinAlgError
