"""Where variables are unbounded weak duality asks for exact slopes, and a solver's multipliers are not exact."""

from __future__ import annotations

from typing import TYPE_CHECKING, TypeAlias

import numpy as np
import numpy.typing as npt

from sparserob_core.sip.convex_set import Array
from sparserob_core.sip.finite import FiniteProgram

if TYPE_CHECKING:
    from scipy.sparse import csc_array

NEAR = 1e-6  # a slope this close to its limit, or beyond it, is moved onto the limit
ROUNDS = 4


def diagonal(P: csc_array | None, n: int) -> Array | None:
    """The diagonal ``(n,)`` of a diagonal ``P`` (zeros for ``None``), or ``None`` when ``P`` has other entries."""
    if P is None:
        return np.zeros(n)
    columns = np.repeat(np.arange(n), np.diff(P.indptr))
    if not np.array_equal(columns, P.indices):
        return None
    return np.bincount(columns, P.data, n).astype(float)


Multipliers: TypeAlias = tuple[Array, Array, Array | None, Array | None]


def repaired(program: FiniteProgram, y: Array, mu: Array, z: Array | None, at: Array | None) -> Multipliers | None:
    """``(y, mu, z, at)`` after the least-norm correction that gives every unbounded entry the slope that it needs, or
    ``None``.

    Only positive ``y``, ``mu``, the point ``at`` of the tangent to ``P``, and the ``z`` of bounded images are moved.
    """
    better: Multipliers | None = (y, mu, z, at)
    for _ in range(ROUNDS):
        if better is None or not all(np.isfinite(v).all() for v in better if v is not None):
            return None
        better = _corrected(program, *better)
        if better is not None and (better[0] >= 0).all():
            return better
        better = None if better is None else (np.maximum(better[0], 0.0), *better[1:])
    return better


def _corrected(program: FiniteProgram, y: Array, mu: Array, z: Array | None, at: Array | None) -> Multipliers | None:
    tangent = None
    if program.P is not None and (program.S is not None or diagonal(program.P, program.n) is None):
        tangent = program.P.toarray()
        at = np.zeros(program.n) if at is None else at
    slope = program.q + y @ program.G + mu @ program.A + (0.0 if tangent is None else tangent @ at)
    used = y > 0
    blocks = [program.G[used].T, program.A.T, np.zeros((program.n, 0)) if tangent is None else tangent]
    if program.S is None:
        tight = _tight(program, -slope) & (tangent is not None or diagonal(program.P, program.n) == 0)
        target = np.sign(slope[tight]) * program.weights[tight] - slope[tight]
        moved = _least_norm([block[tight] for block in blocks], target)
    else:
        z = np.zeros(program.weights.size) if z is None else z.copy()
        tight = _tight(program, z)
        z[tight] = np.sign(z[tight]) * program.weights[tight]
        moved = _least_norm([*blocks, program.S[np.flatnonzero(~tight)].toarray().T], -(program.S.T @ z + slope))
        z[~tight] += 0.0 if moved is None else moved[3]
    if moved is None:
        return None
    better = y.copy()
    better[used] += moved[0]
    return better, mu + moved[1], z, at if tangent is None or at is None else at + moved[2]


def _tight(program: FiniteProgram, z: Array) -> npt.NDArray[np.bool_]:
    """Unbounded images whose multiplier is at its limit, the weight, or beyond."""
    near = np.abs(z) > program.weights - NEAR * (1.0 + program.weights)
    return near & (np.isposinf(program.upper) & (z >= 0) | np.isneginf(program.lower) & (z <= 0))


def _least_norm(blocks: list[Array], target: Array) -> list[Array] | None:
    columns = np.hstack(blocks)
    if not columns.size:
        return None
    change = np.linalg.lstsq(columns, target, rcond=1e-12)[0]
    change = change + np.linalg.lstsq(columns, target - columns @ change, rcond=1e-12)[0]
    return np.split(change, np.cumsum([block.shape[1] for block in blocks])[:-1])
