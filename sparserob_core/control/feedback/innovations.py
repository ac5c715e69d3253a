"""What is seen of the disturbance at the breakpoints, and coordinates of the gains that answer it.

The innovation ``e_j`` is linear in the deviations ``w`` of the disturbance from its middle: ``e_j = D_j w``. A gain
acts through its *effect* ``F_k = sum_j M_kj D_j``, how the control on piece ``k`` depends on ``w``, alone. So the
variables are entries of ``F_k``, at as many entries of ``w`` as are independent of one another in what is seen, and
the gains that have these effects are ``M_k = F_k D^+``.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING, final

import numpy as np

from sparserob_core.control.response.response import Response
from sparserob_core.sip.convex_set import Array

if TYPE_CHECKING:
    from sparserob_core.control.feedback.measurable import MeasurablePieces
    from sparserob_core.control.problem.dictionary import Dictionary
    from sparserob_core.control.response.disturbance import DisturbanceModel

DEPENDENT = 1e-9  # of its own size, the rest of a column that is a combination of others
KNOWN = np.zeros((1, 0))


def innovations_seen(
    response: Response,
    control: Dictionary,
    model: DisturbanceModel | None,
    begins: bool = False,
    pieces: MeasurablePieces | None = None,
) -> Array:
    """``D (K, d, Q)``: what every innovation is of the deviations, block after block, and then, where a set of initial
    states ``begins``, of those of the initial state, of which ``e_0`` is all; ``e_0`` is 0 from one initial state."""
    K, d = control.pieces, response.initial_state.size
    begun = np.zeros((K, d, d if begins else 0))
    if begins:
        begun[0] = np.eye(d)
    if model is None:
        return begun
    if pieces is not None:
        return np.concatenate([_measurable(response, control, pieces), begun], axis=2)
    grid, steps = response.grid, response.steps(KNOWN)
    block, pushes = _pushes(response, model)
    commanded = grid.commanded(control.breakpoints)
    D = np.zeros((K, d, model.block_count, pushes.shape[2]))
    for piece in range(int(np.searchsorted(commanded, K - 1))):  # what happens on the last one is seen when all is over
        seen, last = D[commanded[piece] + 1], int(block[piece]) + 1
        first = int(block[np.searchsorted(commanded, commanded[piece])])
        seen[:, first:last] = np.tensordot(steps.Phi[0, response.which[piece]], seen[:, first:last], axes=1)
        seen[:, block[piece]] += pushes[piece]
    return np.concatenate([D.reshape(K, d, -1), begun], axis=2)


def _pushes(response: Response, model: DisturbanceModel) -> tuple[np.ndarray, Array]:
    """The block that acts on every piece of the grid ``(L,)``, and what one of each of its entries makes of the state
    at the end, ``(L, d, mw)``."""
    grid, steps = response.grid, response.steps(KNOWN)
    assert model.starts is not None
    block = np.searchsorted(model.starts, np.arange(grid.pieces), side="right") - 1
    return block, steps.Gamma[0, response.which] @ grid.of_modes(steps.E[0])[grid.modes]


def unfelt(
    response: Response, model: DisturbanceModel | None, far: Array, begun: Array, rows: Array, least: float
) -> np.ndarray:
    """Which entries ``(Q,)`` of a disturbance of at most ``far (mw,)``, block after block, and then of initial states
    that deviate by at most ``begun (d,)``, or none, ``(0,)``, bring none of the ``rows (r, d)`` further than ``least``
    at any breakpoint."""
    grid, steps, first = response.grid, response.steps(KNOWN), 0
    if model is not None:
        block, pushes = _pushes(response, model)
        first, pushes = model.block_count * far.size, pushes * far
        own = block[:, None] * far.size + np.arange(far.size)
    nodes = np.zeros((response.initial_state.size, first + begun.size))
    nodes[:, first:] = np.eye(len(nodes), begun.size) * begun
    most = np.abs(rows @ nodes).max(axis=0, initial=0.0)
    for piece in range(grid.pieces):
        nodes = steps.Phi[0, response.which[piece]] @ nodes
        if first:
            nodes[:, own[piece]] += pushes[piece]
        most = np.maximum(most, np.abs(rows @ nodes).max(axis=0, initial=0.0))
    felt: np.ndarray = most > least
    return ~felt


def _measurable(response: Response, control: Dictionary, pieces: MeasurablePieces) -> Array:
    """The same of what measurable disturbances make of the state at the end of every piece."""
    grid, K = response.grid, control.pieces
    ends = control.breakpoints[grid.control_piece + 1]
    flows = pieces.carried(np.arange(grid.pieces), ends)
    D = np.zeros((K, response.initial_state.size, pieces.size))
    for piece in range(grid.pieces):
        if grid.control_piece[piece] + 1 < K:
            place, outward = pieces.at(piece)
            D[grid.control_piece[piece] + 1, :, place] = flows[piece] @ outward * pieces.seen(piece)
    return D


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
        """How many."""
        return int(self.piece.size)

    def effects(self, numbers: Array) -> Array:
        """``F (K, m, Q)``."""
        K, m, Q, _ = self.shape
        at, which, value = self.effect
        found: Array = np.bincount(at, value * numbers[which], K * m * Q).astype(float).reshape(K, m, Q)
        return found

    def gains(self, numbers: Array) -> Array:
        """``M (K, K, m, d)``: ``M[k, j]`` acts on ``e_j``, zero for ``j > k``."""
        K, m, _, d = self.shape
        at, which, value = self.gain
        found: Array = np.bincount(at, value * numbers[which], K * K * m * d).astype(float).reshape(K, K, m, d)
        return found

    def on(self, sizes: Array) -> Answers:
        """The same with variables that are effects on so much of every entry of the deviations, ``sizes (Q,)``."""
        share = sizes[self.entry]
        if (share == 1.0).all():
            return self
        effect, gain = ((at, which, value / share[which]) for at, which, value in (self.effect, self.gain))
        return replace(self, share=share * self.share, effect=effect, gain=gain)

    @cached_property
    def single(self) -> bool:
        """Whether every entry of the effects is one variable, or 0."""
        at, _, value = self.effect
        return bool(np.unique(at).size == at.size and (value == 1.0).all())


def answers(D: Array, mask: np.ndarray, channels: int, seen: Array | None = None) -> Answers:
    """The coordinates of gains that answer innovations ``D (K, d, Q)``, each piece those of its row of the truth values
    ``mask (K, K)``; in units in which states and deviations are of ordinary size. Variables are numbered piece by piece
    of the control, and then channel by channel of everything that hangs together. Where more is ``seen (K, d, Q)`` than
    is to be answered, gains have effects there too."""
    K, d, Q = D.shape
    alike = list(_alike(D, mask, D if seen is None else seen))
    sizes = np.zeros((K, 1 + max((one.cluster for one in alike), default=0)), dtype=int)
    for one in alike:
        sizes[one.pieces, one.cluster] = channels * one.free.size
    starts = (np.cumsum(sizes.ravel()) - sizes.ravel()).reshape(sizes.shape)
    piece, channel, entry = (np.zeros(int(sizes.sum()), dtype=int) for _ in range(3))
    effect: list[tuple[np.ndarray, np.ndarray, Array]] = []
    gain: list[tuple[np.ndarray, np.ndarray, Array]] = []
    i = np.arange(channels)[:, None]
    for one in alike:
        k, r = one.pieces[:, None, None], one.free.size
        names = starts[one.pieces, one.cluster][:, None, None] + i * r + np.arange(r)
        piece[names], channel[names], entry[names] = k, i, one.free
        rows, cols = np.nonzero(one.Z)
        effect.append(_listed((k * channels + i) * Q + one.columns[cols], names[..., rows], one.Z[rows, cols]))
        rows, cols = np.nonzero(one.G)
        at = ((k * K + one.seen[cols // d]) * channels + i) * d + cols % d
        gain.append(_listed(at, names[..., rows], one.G[rows, cols]))
    return Answers((K, channels, Q, d), piece, channel, entry, np.ones(entry.size), _joined(effect), _joined(gain))


@final
@dataclass(frozen=True, eq=False)
class _Alike:
    """``pieces`` of the control that answer the same breakpoints ``seen`` of one ``cluster``, by number, and
    `_coordinates` of these."""

    pieces: np.ndarray
    cluster: int
    seen: np.ndarray
    columns: np.ndarray
    free: np.ndarray
    Z: Array
    G: Array


def _alike(D: Array, mask: np.ndarray, every: Array) -> Iterator[_Alike]:
    """All pieces of the control that answer anything, cluster by cluster."""
    plain = np.array_equal(D, every)
    for number, cluster in enumerate(_clusters((D != 0.0).any(axis=1))):
        choices, which = np.unique(mask[:, cluster], axis=0, return_inverse=True)
        for place, chosen in enumerate(choices):
            if not chosen.any():
                continue
            seen = cluster[chosen]
            columns, free, Z, G = _coordinates(D[seen])
            if not plain:
                flat = every[seen].reshape(-1, every.shape[2])
                columns = np.flatnonzero(flat.any(axis=0))
                Z = G @ flat[:, columns]
            if free.size:
                yield _Alike(np.flatnonzero(which.ravel() == place), number, seen, columns, free, Z, G)


def _listed(at: Array, which: Array, value: Array) -> tuple[np.ndarray, np.ndarray, Array]:
    return at.ravel(), which.ravel(), np.broadcast_to(value, which.shape).ravel()


def _clusters(where: np.ndarray) -> list[np.ndarray]:
    """The breakpoints ``(K, Q)`` that see something in common, together; those that see nothing are left out."""
    clusters: list[tuple[set[int], np.ndarray]] = []
    for j in np.flatnonzero(where.any(axis=1)):
        mine, rest = ({int(j)}, where[j].copy()), []
        for members, columns in clusters:
            if (columns & mine[1]).any():
                mine = (mine[0] | members, mine[1] | columns)
            else:
                rest.append((members, columns))
        clusters = [*rest, mine]
    return [np.array(sorted(members)) for members, _ in sorted(clusters, key=lambda one: min(one[0]))]


def _coordinates(seen: Array) -> tuple[np.ndarray, np.ndarray, Array, Array]:
    """Of innovations ``(J, d, Q)``: the entries of the deviations that they see ``(c,)``, those of them that are
    independent ``(r,)``, what the effect of each is on all, ``(r, c)``, and gains of such effects, ``(r, J d)``."""
    from scipy.linalg import qr

    flat = seen.reshape(-1, seen.shape[2])
    sizes = np.linalg.norm(flat, axis=0)
    columns = np.flatnonzero(sizes > 0.0)
    unit = flat[:, columns] / sizes[columns]
    _, R, order = qr(unit, mode="economic", pivoting=True)
    chosen = np.sort(order[: int((np.abs(np.diag(R)) > DEPENDENT).sum())])
    inverse = np.linalg.pinv(unit[:, chosen])  # well conditioned: every column is of size 1
    rest = np.setdiff1d(np.arange(columns.size), chosen)
    Z = np.zeros((chosen.size, columns.size))
    Z[np.arange(chosen.size), chosen] = 1.0
    Z[:, rest] = inverse @ unit[:, rest]
    Z[np.abs(Z) < DEPENDENT] = 0.0
    far = sizes[columns]
    return columns, columns[chosen], Z * far / far[chosen][:, None], inverse / far[chosen][:, None]


def _joined(parts: list[tuple[np.ndarray, np.ndarray, Array]]) -> tuple[np.ndarray, np.ndarray, Array]:
    """Positions, variables and values, in the order of the variables."""
    if not parts:
        return np.zeros(0, dtype=int), np.zeros(0, dtype=int), np.zeros(0)
    at, which, value = (np.concatenate(part) for part in zip(*parts, strict=True))
    order = np.argsort(which, kind="stable")
    return at[order], which[order], value[order]
