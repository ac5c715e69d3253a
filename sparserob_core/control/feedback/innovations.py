"""Innovations of the disturbance at the breakpoints, and coordinates of the gains that respond to them.

The innovation ``e_j`` is linear in the deviations ``w`` of the disturbance from its middle: ``e_j = D_j w``. A gain
acts only through its *effect* ``F_k = sum_j M_kj D_j``, which is the dependence of the control on piece ``k`` on ``w``.
So the variables are entries of ``F_k``, at as many entries of ``w`` as are linearly independent in the innovations. The
gains that have these effects are ``M_k = F_k D^+``.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING, final

import numpy as np
from scipy.linalg import qr

from sparserob_core.control.response.response import Response
from sparserob_core.sip.convex_set import Array

if TYPE_CHECKING:
    from sparserob_core.control.problem.dictionary import Dictionary
    from sparserob_core.control.response.disturbance import DisturbanceModel

DEPENDENT = 1e-9  # of its own size, the rest of a column that is a combination of others
KNOWN = np.zeros((1, 0))


def build_innovations(
    response: Response,
    control: Dictionary,
    model: DisturbanceModel | None,
    begins: bool = False,
) -> Array:
    """Return the matrices ``D (K, d, Q)`` from the deviations to every innovation.

    The columns belong to the blocks of the disturbance, one after another. Where ``begins`` says that the initial
    states are a set, the last ``d`` columns are the deviations of the initial state, of which ``e_0`` consists. From a
    single initial state ``e_0`` is 0.
    """
    K, d = control.pieces, response.initial_state.size
    initial_innovations = np.zeros((K, d, d if begins else 0))
    if begins:
        initial_innovations[0] = np.eye(d)
    if model is None:
        return initial_innovations
    grid, steps = response.grid, response.steps(KNOWN)
    block, input_effects = _build_disturbance_matrices(response, model)
    commanded = grid.commanded(control.breakpoints)
    D = np.zeros((K, d, model.block_count, input_effects.shape[2]))
    for piece in range(int(np.searchsorted(commanded, K - 1))):  # what happens on the last one is seen when all is over
        innovation, last = D[commanded[piece] + 1], int(block[piece]) + 1
        first = int(block[np.searchsorted(commanded, commanded[piece])])
        innovation[:, first:last] = np.tensordot(steps.Phi[0, response.which[piece]], innovation[:, first:last], axes=1)
        innovation[:, block[piece]] += input_effects[piece]
    return np.concatenate([D.reshape(K, d, -1), initial_innovations], axis=2)


def _build_disturbance_matrices(response: Response, model: DisturbanceModel) -> tuple[np.ndarray, Array]:
    """Return the block that acts on every piece of the grid, ``(L,)``, and the state at the end of the piece per unit
    of each of its entries, ``(L, d, mw)``."""
    grid, steps = response.grid, response.steps(KNOWN)
    assert model.starts is not None
    block = np.searchsorted(model.starts, np.arange(grid.pieces), side="right") - 1
    return block, steps.Gamma[0, response.which] @ grid.of_modes(steps.E[0])[grid.modes]


def find_negligible_entries(
    response: Response,
    model: DisturbanceModel | None,
    disturbance_widths: Array,
    initial_widths: Array,
    rows: Array,
    least: float,
) -> np.ndarray:
    """Return which entries ``(Q,)`` of the deviations move none of the rows by more than ``least`` at any breakpoint.
    The entries are those of the disturbance, block after block, and then those of the initial state.

    Parameters
    ----------
    response : Response
        Response of the system.
    model : DisturbanceModel or None
        Disturbance, if any.
    disturbance_widths : ndarray, shape (mw,)
        Widths of the set of the disturbance along the axes.
    initial_widths : ndarray, shape (d,) or (0,)
        Widths of the set of initial states; empty for a single initial state.
    rows : ndarray, shape (r, d)
        Rows on the state.
    least : float
        Largest movement of a row that is ignored.
    """
    grid, steps, first = response.grid, response.steps(KNOWN), 0
    if model is not None:
        block, input_effects = _build_disturbance_matrices(response, model)
        first, input_effects = model.block_count * disturbance_widths.size, input_effects * disturbance_widths
        columns = block[:, None] * disturbance_widths.size + np.arange(disturbance_widths.size)
    nodes = np.zeros((response.initial_state.size, first + initial_widths.size))
    nodes[:, first:] = np.eye(len(nodes), initial_widths.size) * initial_widths
    largest_movements = np.abs(rows @ nodes).max(axis=0, initial=0.0)
    for piece in range(grid.pieces):
        nodes = steps.Phi[0, response.which[piece]] @ nodes
        if first:
            nodes[:, columns[piece]] += input_effects[piece]
        largest_movements = np.maximum(largest_movements, np.abs(rows @ nodes).max(axis=0, initial=0.0))
    is_effective: np.ndarray = largest_movements > least
    return ~is_effective


@final
@dataclass(frozen=True, eq=False)
class Answers:
    """The variables of the gains: ``variables`` numbers, each the effect on channel ``channel`` of the control on piece
    ``piece`` of so much, ``share``, of the entry ``entry`` of the deviations, ``(n,)`` each.

    Effects ``F (K, m, Q)`` and gains ``M (K, K, m, d)`` are sparse linear functions of them: ``effect`` and ``gain``
    list flat positions, variables and values.
    """

    shape: tuple[int, int, int, int]
    piece: np.ndarray
    channel: np.ndarray
    entry: np.ndarray
    share: Array
    effect: tuple[np.ndarray, np.ndarray, Array]
    gain: tuple[np.ndarray, np.ndarray, Array]

    @property
    def variables(self) -> int:
        """Number of variables of the gains."""
        return int(self.piece.size)

    def of_piece(self, piece: int) -> tuple[np.ndarray, np.ndarray, Array]:
        """Return the entries of ``effect`` that belong to one piece: positions in ``(m, Q)``, variables and values."""
        position, variable, value = self.effect
        first, last = self._piece_offsets[piece : piece + 2]
        return position[first:last] - piece * self.shape[1] * self.shape[2], variable[first:last], value[first:last]

    @cached_property
    def _piece_offsets(self) -> np.ndarray:
        """Positions ``(K + 1,)`` at which the entries of ``effect`` of every piece begin; they are sorted by piece."""
        K, m, Q, _ = self.shape
        return np.searchsorted(self.effect[0] // max(1, m * Q), np.arange(K + 1))

    def effects(self, numbers: Array) -> Array:
        """Return the effects ``F (K, m, Q)`` of the variables ``numbers (n,)``."""
        K, m, Q, _ = self.shape
        position, variable, value = self.effect
        effects: Array = np.bincount(position, value * numbers[variable], K * m * Q).astype(float).reshape(K, m, Q)
        return effects

    def gains(self, numbers: Array) -> Array:
        """Return the gains ``M (K, K, m, d)`` of the variables ``numbers (n,)``: ``M[k, j]`` acts on ``e_j``, and is 0
        for ``j > k``."""
        K, m, _, d = self.shape
        position, variable, value = self.gain
        gains: Array = np.bincount(position, value * numbers[variable], K * K * m * d).astype(float).reshape(K, K, m, d)
        return gains

    def on(self, sizes: Array) -> Answers:
        """Return the same gains with rescaled variables, each the effect of ``sizes (Q,)`` of its entry of the
        deviations."""
        share = sizes[self.entry]
        if (share == 1.0).all():
            return self
        effect, gain = (
            (position, variable, value / share[variable]) for position, variable, value in (self.effect, self.gain)
        )
        return replace(self, share=share * self.share, effect=effect, gain=gain)

    @cached_property
    def single(self) -> bool:
        """True where every entry of the effects is one variable or 0."""
        position, _, value = self.effect
        return bool(np.unique(position).size == position.size and (value == 1.0).all())


def answers(D: Array, mask: np.ndarray, channels: int, innovations: Array | None = None) -> Answers:
    """Return coordinates of the gains that respond to innovations.

    Variables are numbered piece by piece of the control, and then channel by channel of every cluster of innovations.

    Parameters
    ----------
    D : ndarray, shape (K, d, Q)
        Innovations that are answered, in units in which states and deviations are of ordinary size.
    mask : ndarray of bool, shape (K, K)
        True at ``[k, j]`` where piece ``k`` responds to the innovation at breakpoint ``j``.
    channels : int
        Number ``m`` of controls.
    innovations : ndarray, shape (K, d, Q), optional
        All innovations, where ``D`` leaves out some of their entries. The gains have effects at these entries too.

    Returns
    -------
    Answers
        Variables of the gains.
    """
    K, d, Q = D.shape
    groups = list(_group_pieces(D, mask, D if innovations is None else innovations))
    sizes = np.zeros((K, 1 + max((group.cluster for group in groups), default=0)), dtype=int)
    for group in groups:
        sizes[group.pieces, group.cluster] = channels * group.free.size
    starts = (np.cumsum(sizes.ravel()) - sizes.ravel()).reshape(sizes.shape)
    piece, channel, entry = (np.zeros(int(sizes.sum()), dtype=int) for _ in range(3))
    effect: list[tuple[np.ndarray, np.ndarray, Array]] = []
    gain: list[tuple[np.ndarray, np.ndarray, Array]] = []
    i = np.arange(channels)[:, None]
    for group in groups:
        k, r = group.pieces[:, None, None], group.free.size
        variables = starts[group.pieces, group.cluster][:, None, None] + i * r + np.arange(r)
        piece[variables], channel[variables], entry[variables] = k, i, group.free
        rows, cols = np.nonzero(group.Z)
        effect.append(
            _flatten_entries((k * channels + i) * Q + group.columns[cols], variables[..., rows], group.Z[rows, cols])
        )
        rows, cols = np.nonzero(group.G)
        positions = ((k * K + group.breakpoints[cols // d]) * channels + i) * d + cols % d
        gain.append(_flatten_entries(positions, variables[..., rows], group.G[rows, cols]))
    return Answers(
        (K, channels, Q, d), piece, channel, entry, np.ones(entry.size), _join_entries(effect), _join_entries(gain)
    )


@final
@dataclass(frozen=True, eq=False)
class _PieceGroup:
    """``pieces`` of the control that answer the same ``breakpoints`` of one ``cluster``, by number, and
    `_compute_coordinates` of these."""

    pieces: np.ndarray
    cluster: int
    breakpoints: np.ndarray
    columns: np.ndarray
    free: np.ndarray
    Z: Array
    G: Array


def _group_pieces(D: Array, mask: np.ndarray, every: Array) -> Iterator[_PieceGroup]:
    """Yield the pieces of the control that respond to any innovation, cluster by cluster."""
    plain = np.array_equal(D, every)
    for cluster_number, cluster in enumerate(_cluster_breakpoints((D != 0.0).any(axis=1))):
        choices, choice_of_piece = np.unique(mask[:, cluster], axis=0, return_inverse=True)
        for choice, is_answered in enumerate(choices):
            if not is_answered.any():
                continue
            breakpoints = cluster[is_answered]
            columns, free, Z, G = _compute_coordinates(D[breakpoints])
            if not plain:
                flat = every[breakpoints].reshape(-1, every.shape[2])
                columns = np.flatnonzero(flat.any(axis=0))
                Z = G @ flat[:, columns]
            if free.size:
                yield _PieceGroup(
                    np.flatnonzero(choice_of_piece.ravel() == choice), cluster_number, breakpoints, columns, free, Z, G
                )


def _flatten_entries(at: Array, which: Array, value: Array) -> tuple[np.ndarray, np.ndarray, Array]:
    return at.ravel(), which.ravel(), np.broadcast_to(value, which.shape).ravel()


def _cluster_breakpoints(where: np.ndarray) -> list[np.ndarray]:
    """Return the breakpoints of ``where (K, Q)`` in groups that see an entry in common; those that see nothing are left
    out."""
    clusters: list[tuple[set[int], np.ndarray]] = []
    for j in np.flatnonzero(where.any(axis=1)):
        union, disjoint = ({int(j)}, where[j].copy()), []
        for members, columns in clusters:
            if (columns & union[1]).any():
                union = (union[0] | members, union[1] | columns)
            else:
                disjoint.append((members, columns))
        clusters = [*disjoint, union]
    return [np.array(sorted(members)) for members, _ in sorted(clusters, key=lambda cluster: min(cluster[0]))]


def _compute_coordinates(innovations: Array) -> tuple[np.ndarray, np.ndarray, Array, Array]:
    """Return coordinates of the effects of gains on ``innovations (J, d, Q)``.

    Returns
    -------
    columns : ndarray of int, shape (c,)
        Entries of the deviations in the innovations.
    free : ndarray of int, shape (r,)
        Linearly independent ones among these entries.
    Z : ndarray, shape (r, c)
        Effect at all entries for a unit effect at each independent one.
    G : ndarray, shape (r, J d)
        Gains with these effects.
    """
    flat = innovations.reshape(-1, innovations.shape[2])
    sizes = np.linalg.norm(flat, axis=0)
    columns = np.flatnonzero(sizes > 0.0)
    unit = flat[:, columns] / sizes[columns]
    _, R, order = qr(unit, mode="economic", pivoting=True)
    independent = np.sort(order[: int((np.abs(np.diag(R)) > DEPENDENT).sum())])
    inverse = np.linalg.pinv(unit[:, independent])  # well conditioned: every column is of size 1
    dependent = np.setdiff1d(np.arange(columns.size), independent)
    Z = np.zeros((independent.size, columns.size))
    Z[np.arange(independent.size), independent] = 1.0
    Z[:, dependent] = inverse @ unit[:, dependent]
    Z[np.abs(Z) < DEPENDENT] = 0.0
    scale = sizes[columns]
    return columns, columns[independent], Z * scale / scale[independent][:, None], inverse / scale[independent][:, None]


def _join_entries(parts: list[tuple[np.ndarray, np.ndarray, Array]]) -> tuple[np.ndarray, np.ndarray, Array]:
    """Return positions, variables and values, in the order of the variables."""
    if not parts:
        return np.zeros(0, dtype=int), np.zeros(0, dtype=int), np.zeros(0)
    position, variable, value = (np.concatenate(arrays) for arrays in zip(*parts, strict=True))
    order = np.argsort(variable, kind="stable")
    return position[order], variable[order], value[order]
