"""Coordinates in which the modes of a matrix do not disturb each other, and the rounding of the way there.

``x = T z`` brings ``A`` to ``D + R``: ``D`` is block diagonal, one *group* for every cluster of eigenvalues and
quasi-triangular within a group (Bavely and Stewart 1979; Golub and Van Loan 2013, 7.6.3), and ``R`` is rounding, which
is bounded and not dropped. The 1 by 1 and 2 by 2 *blocks* of ``D`` are real eigenvalues and normal rotations.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from typing import TypeAlias

import numpy as np
import numpy.typing as npt
from scipy.linalg import schur

from sparserob_core.control.enclosures.matrix_exponential import exponential_rounding, transitions
from sparserob_core.sip.convex_set import Array
from sparserob_core.sip.expressions.rounding import EPSILON, rounding

LongArray: TypeAlias = npt.NDArray[np.longdouble]

WELL_CONDITIONED = 1e3
# What modes may be conditioned by where there are so many states and no clusters of them either: in one group of 348
# states what couples the modes of a beam, which are conditioned by 5e3, grows to 1e88 within a fifth of a second. What
# is rounded grows with the condition: with ten times as much it is felt by a proof, with a tenth the beam has none.
POORLY_CONDITIONED, MANY = 1e5, 50
SEPARATED = (1e-6, 1e-4, 1e-2, 0.1, 0.5)  # of the largest eigenvalue: closer ones are tried in one group
SWEEPS = 16  # of balancing
BALANCE_TOLERANCE = 6.0  # bits by which two ways to balance may differ before the one that is not step by step is taken


@dataclass(frozen=True, eq=False)
class Decoupling:
    """Transform ``T (d, d)`` and its ``inverse`` ``V (d, d)`` as computed, in extended precision where the machine has
    it.

    ``defect (d, d)`` bounds ``|T^-1 - V|`` relative to ``V``: ``|T^-1 y - V y| <= defect |V y|``, entry by entry.

    ``starts (q,)``: where the blocks begin; ``groups (g,)``: where the groups begin (each a union of blocks).
    """

    transform: Array
    inverse: LongArray
    defect: Array
    starts: np.ndarray
    groups: np.ndarray

    def normal_form(self, transformed: Array) -> Array:
        """Return ``D (d, d)``, which ``T^-1 A T`` would be without rounding, from the computed product ``transformed
        (d, d)``.

        Entries outside the groups and below the diagonal blocks are 0, and 2 by 2 blocks are ``[[a, b], [-b, a]]``.
        Without a transform ``D`` is ``transformed`` itself.
        """
        if self.is_identity:
            return transformed.copy()
        d = self.transform.shape[0]
        block = np.searchsorted(self.starts, np.arange(d), side="right")
        group = np.searchsorted(self.groups, np.arange(d), side="right")
        D = np.where((group[:, None] == group) & (block[:, None] <= block), transformed, 0.0)
        for i in np.flatnonzero(np.diff(np.append(self.starts, d)) == 2):
            at = self.starts[i]
            rate, rotation = (D[at, at] + D[at + 1, at + 1]) / 2, (D[at, at + 1] - D[at + 1, at]) / 2
            D[at : at + 2, at : at + 2] = [[rate, rotation], [-rotation, rate]]
        return D

    def vector(self, columns: Array) -> tuple[Array, Array]:
        """Return ``V b`` in double precision for columns ``b (..., d, e)``, and a bound of its distance from
        ``T^-1 b``, entry by entry."""
        if self.is_identity:
            return columns, np.zeros(columns.shape)
        return self._round_to_double(self.inverse @ columns.astype(np.longdouble), np.abs(columns))

    def matrix(self, A: Array) -> tuple[Array, Array]:
        """Return ``V A T`` in double precision for matrices ``A (..., d, d)``, and a bound of its distance from
        ``T^-1 A T``, entry by entry."""
        if self.is_identity:
            return A, np.zeros(A.shape)
        transformed = self.inverse @ A.astype(np.longdouble) @ self.transform
        return self._round_to_double(transformed, np.abs(A) @ np.abs(self.transform))

    def _round_to_double(self, transformed: LongArray, sizes: Array) -> tuple[Array, Array]:
        """Return ``transformed`` in double precision, and a bound of its distance from the truth; ``sizes`` bounds the
        moduli of the factor of the inverse."""
        products = _bound_long_rounding(2 * transformed.shape[-2]) * (np.abs(self.inverse) @ sizes)
        result = transformed.astype(float)
        bound = products + self.defect @ (np.abs(transformed) + products) + np.abs(transformed - result)
        return result, 1.001 * bound.astype(float)

    @cached_property
    def parts(self) -> list[tuple[slice, bool]]:
        """The groups, and whether each is a single block."""
        ends = np.append(self.groups[1:], self.transform.shape[0])
        return [
            (slice(start, stop), ((self.starts >= start) & (self.starts < stop)).sum() == 1)
            for start, stop in zip(self.groups, ends, strict=True)
        ]

    @property
    def is_identity(self) -> bool:
        """True where no coordinates are transformed, so that nothing is rounded."""
        return not self.defect.any()


def decoupled(A: Array) -> Decoupling:
    """Return coordinates for ``A (d, d)``: its modes where they are well conditioned, else clusters of them, else the
    Schur form of all.

    The transform of the Schur form has orthogonal columns after balancing. Where no transform can be verified, or for
    a single state, the coordinates are the states.
    """
    d = A.shape[0]
    if d == 1 or not np.isfinite(A).all():
        return identity(d)
    scale = balance(A)
    balanced = A * scale / scale[:, None]
    for candidate in _generate_candidates(balanced):
        checked = _verify_inverse(scale[:, None] * candidate[0], *candidate[1:])
        if checked is not None:
            return checked
    return identity(d)


def identity(d: int) -> Decoupling:
    """Return the decoupling without a change of coordinates, with every state as a block of its own, in one group."""
    return Decoupling(np.eye(d), np.eye(d, dtype=np.longdouble), np.zeros((d, d)), np.arange(d), np.zeros(1, dtype=int))


def _verify_inverse(T: Array, starts: np.ndarray, groups: np.ndarray) -> Decoupling | None:
    """Return the decoupling with a bound of the defect of the inverse of ``T (d, d)``; ``None`` where the residual is
    too large for a bound."""
    try:
        V = np.asarray(np.linalg.inv(T), dtype=float)
    except np.linalg.LinAlgError:
        return None
    d = T.shape[0]
    inverse = V + (np.eye(d) - V.astype(np.longdouble) @ T) @ V  # one step of Newton's method (Schulz 1933)
    long_residual = np.abs(inverse @ T - np.eye(d)) + _bound_long_rounding(d) * (np.abs(inverse) @ np.abs(T))
    residual = 1.001 * long_residual.astype(float)
    size = float(residual.sum(axis=1).max())
    if not size < 0.5:
        return None
    # T^-1 = (I + S)^-1 V with |S| <= residual, and (I + S)^-1 - I is at most residual + residual^2 + ...
    defect = residual + residual @ residual + size**3 / (1.0 - size)
    return Decoupling(T, inverse, defect, starts, groups)


def _bound_long_rounding(terms: int) -> float:
    """`rounding` in extended precision."""
    return rounding(terms) * float(np.finfo(np.longdouble).eps) / EPSILON


def _generate_candidates(A: Array) -> Iterator[tuple[Array, np.ndarray, np.ndarray]]:
    """Yield transforms of a balanced matrix with the starts of their blocks and groups, in the order of preference.

    The modes come first where they are well conditioned, then clusters from fine to coarse. The modes of many states
    follow where they are poorly conditioned, and one group of all is last.
    """
    values, vectors = np.linalg.eig(A)
    columns: list[Array] = []
    starts: list[int] = []
    for i in np.argsort(-values.real, kind="stable"):
        if values[i].imag < 0:
            continue
        starts.append(len(columns))
        components = (vectors[:, i].real,) if values[i].imag == 0 else (vectors[:, i].real, vectors[:, i].imag)
        columns += [component / np.linalg.norm(vectors[:, i]) for component in components]
    modal = np.stack(columns, axis=1)
    condition = np.linalg.cond(modal) if modal.shape[0] == modal.shape[1] else np.inf
    if condition < WELL_CONDITIONED:
        yield modal, np.array(starts), np.array(starts)
    form, basis = schur(A, output="real")
    values = _read_eigenvalues(form)
    for closeness in SEPARATED:
        clusters = _cluster_eigenvalues(values, closeness * np.abs(values).max())
        if len(clusters) == 1:
            break
        candidate = _build_group_bases(form, basis, clusters)
        if candidate is not None and np.linalg.cond(candidate[0]) < WELL_CONDITIONED:
            yield candidate
    if len(A) >= MANY and condition < POORLY_CONDITIONED:
        yield modal, np.array(starts), np.array(starts)
    candidate = _build_group_bases(form, basis, [np.ones(values.size, dtype=bool)])
    if candidate is not None:
        yield candidate


def _read_eigenvalues(form: Array) -> np.ndarray:
    """The eigenvalues of a quasi-triangular matrix, in the order of its diagonal."""
    below = np.append(np.diag(form, -1), 0.0)
    turning = np.sqrt(np.abs(below * np.append(np.diag(form, 1), 0.0))) * (below != 0)
    return np.asarray(np.diag(form) + 1j * (turning - np.append(0.0, turning[:-1])))


def _cluster_eigenvalues(values: np.ndarray, distance: float) -> list[np.ndarray]:
    """Return the masks of clusters of eigenvalues, in the order of their first eigenvalues.

    Eigenvalues within ``distance`` of each other are in one cluster, also in chains, and conjugates always together.
    """
    upper = np.where(values.imag < 0, values.conj(), values)
    linked = np.abs(upper[:, None] - upper) <= distance
    for _ in range(values.size.bit_length()):
        linked = linked @ linked
    labels = linked.argmax(axis=1)
    return [labels == label for label in np.unique(labels)]


def _build_group_bases(
    form: Array, basis: Array, clusters: list[np.ndarray]
) -> tuple[Array, np.ndarray, np.ndarray] | None:
    """Return orthogonal bases of the invariant subspaces of the clusters, side by side, with the starts of their blocks
    and groups.

    Each basis comes from moving its eigenvalues to the front of one Schur form (Bai and Demmel 1993). It is orthonormal
    but for the second column of a rotation, whose scale makes the rotation normal. ``None`` where the order fails.
    """
    from scipy.linalg.lapack import dtrsen

    bases, starts, groups, start = [], [], [], 0
    for cluster in clusters:
        reordered, reordered_basis, count = form, basis, int(cluster.sum())
        if len(clusters) > 1:
            reordered, reordered_basis, *_, error = dtrsen(
                cluster.astype(np.int32), form, basis, job="N", lwork=form.shape[0]
            )
            if error or (count < form.shape[0] and abs(reordered[count, count - 1]) > 0):
                return None
        columns = reordered_basis[:, :count].copy()
        block_starts, offset = [], 0
        while offset < count:
            block_starts.append(start + offset)
            is_pair = offset + 1 < count and reordered[offset + 1, offset] != 0
            if is_pair:  # a rotation: equal off-diagonal entries make it normal
                columns[:, offset + 1] *= np.sqrt(abs(reordered[offset + 1, offset] / reordered[offset, offset + 1]))
            offset += 2 if is_pair else 1
        bases.append(columns)
        starts += block_starts
        groups.append(start)
        start += count
    return np.hstack(bases), np.array(starts), np.array(groups)


def pace(A: Array) -> float:
    """Return an estimate of how fast a system moves: the 2-norm of ``A (d, d)`` as it is or in balanced units of the
    states, the smaller one."""
    scale = balance(A)
    return float(min(np.linalg.norm(A, 2), np.linalg.norm(A * scale / scale[:, None], 2)))


def balance(A: Array) -> Array:
    """Return powers of two ``s (d,)`` such that rows and columns of ``A_ij s_j / s_i`` are about equally large, without
    their diagonal (Osborne 1960)."""
    scale, start = _sweep_scales(A, np.ones(A.shape[0])), _fit_scales(A)
    # where many states are in a row, each next to its like, the sweeps stop early
    return scale if np.ptp(np.log2(scale / start)) <= BALANCE_TOLERANCE else _sweep_scales(A, start)


def _sweep_scales(A: Array, scale: Array) -> Array:
    """The powers of two after some sweeps from ``scale (d,)``."""
    size = np.abs(A - np.diag(np.diag(A))) * scale / scale[:, None]
    scale = scale.copy()
    for _ in range(SWEEPS):
        changed = False
        for i in range(A.shape[0]):
            row, column = float(size[i].sum()), float(size[:, i].sum())
            if row > 0 and column > 0:
                factor = 2.0 ** round(0.5 * np.log2(row / column))
                if factor != 1.0:
                    scale[i] *= factor
                    size[:, i] *= factor
                    size[i] /= factor
                    changed = True
        if not changed:
            break
    return scale


def _fit_scales(A: Array) -> Array:
    """Return the powers of two ``(d,)`` next to the ``s`` for which the logarithms of ``A_ij s_j / s_i`` have the least
    squares (Curtis and Reid 1972)."""
    i, j = np.nonzero(A - np.diag(np.diag(A)))
    logs, d = np.log2(np.abs(A[i, j])), A.shape[0]
    graph, sums = np.zeros((d, d)), np.zeros(d)
    for sign, row, column in ((1.0, i, j), (-1.0, j, i)):
        np.add.at(graph, (row, row), 1.0)
        np.add.at(graph, (row, column), -1.0)
        np.add.at(sums, row, sign * logs)
    return np.asarray(np.exp2(np.round(np.linalg.lstsq(graph, sums, rcond=None)[0])))


def decoupled_transitions(decoupling: Decoupling, D: Array, durations: Array) -> tuple[Array, Array]:
    """``e^{D r}`` and its integral for durations ``(...)``, ``(..., d, d)`` each, group by group: a fast mode does not
    cost the slow ones their digits, as squaring a whole matrix would."""
    d = D.shape[-1]
    flow, integral = np.zeros((*durations.shape, d, d)), np.zeros((*durations.shape, d, d))
    for block, single in decoupling.parts:
        blocks = (_exponentiate_mode if single else transitions)(D[block, block], durations)
        flow[..., block, block], integral[..., block, block] = blocks
    return flow, integral


def decoupled_rounding(decoupling: Decoupling, D: Array, durations: Array) -> Array:
    """Return bounds ``(k,)`` of the rounding error of `decoupled_transitions` for ``durations (k,)``, relative to the
    exponential of the bounds.

    The exponent of a mode is rounded, by ``eps |a r|`` for a growing and ``eps |b r|`` for a rotating one. Where a mode
    decays, ``|a r| e^{a r} <= 1``.
    """
    worst = np.zeros(durations.shape)
    for block, single in decoupling.parts:
        matrix = D[block, block]
        if single:
            rotation = abs(matrix[0, -1]) if matrix.shape[0] == 2 else 0.0
            error = EPSILON * (6.0 + 2.0 * (max(matrix[0, 0], 0.0) + rotation) * durations)
        else:
            error = exponential_rounding(2 * matrix.shape[0], np.abs(matrix).sum(axis=0).max() * durations)
        worst = np.maximum(worst, error)
    return worst


def _exponentiate_mode(D: Array, durations: Array) -> tuple[Array, Array]:
    """Return `transitions` of a single mode: a real eigenvalue ``a``, or a rotation ``[[a, b], [-b, a]]``, which is the
    complex number ``a + ib``."""
    rotates = D.shape[0] == 2
    rate = complex(D[0, 0], D[0, 1]) if rotates else D[0, 0]
    flow = np.exp(rate * durations)
    integral = np.expm1(rate * durations) / rate if rate != 0 else durations
    if not rotates:
        return flow[..., None, None], integral[..., None, None]
    both = np.empty((2, *durations.shape, 2, 2))
    for matrix, z in zip(both, (flow, integral), strict=True):
        matrix[..., 0, 0] = matrix[..., 1, 1] = z.real
        matrix[..., 0, 1] = z.imag
        matrix[..., 1, 0] = -z.imag
    return both[0], both[1]
