"""Rows of a closed loop in the program: they hold for every deviation, of the state, of the control or of both."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, final

import numpy as np
from scipy.sparse import csr_array

from sparserob_core.control.feedback.closed_loop import ClosedLoop
from sparserob_core.sip.convex_set import Array
from sparserob_core.sip.finite import Spread, UncertainRows, table_of

if TYPE_CHECKING:
    from sparserob_core.control.response.inner_loop import Weights


@final
@dataclass(frozen=True, eq=False)
class LoopRows:
    """The rows of a ``loop``, in its variables."""

    loop: ClosedLoop

    def of_state(self, time: float, H: Array, h: Array, part: np.ndarray, factor: Array) -> UncertainRows:
        """Return the rows ``H x(t) <= h`` at one time as `UncertainRows`. The direction of row ``r`` is ``factor_r``
        times that of the first row of its part, ``part_r``."""
        count = H.shape[0]
        weights = self.loop.functionals.response.weights(np.full(count, time), H, np.zeros((count, 0)))
        return self._of_weights(weights, h, part, factor)

    def _of_weights(self, functional: Weights, h: Array, part: np.ndarray, factor: Array) -> UncertainRows:
        """Return the rows on functionals, given as weights, that are at most ``h (r,)``."""
        (free, weights, on_noise), firsts = functional, _find_firsts(part)
        count = len(free)
        on_control = self.loop.functionals.on_decision(weights)  # (r, m K), channel-major
        offset = free @ self.loop.start + self.loop.functionals.given(weights)
        offset = offset + np.einsum("rli,li->r", on_noise, self.loop.middles)
        K = self.loop.functionals.dictionary.pieces
        position, variable, value = self.loop.answers.effect
        m, Q = self.loop.answers.shape[1], self.loop.spread.size
        control_entry, entry = position // Q, position % Q
        piece, channel = control_entry // m, control_entry % m
        values = (on_control[first].reshape(m, K)[channel, piece] * value for first in firsts)
        matrices = [self._tabulate_responses(entry, variable, each) for each in values]
        rows, columns = np.nonzero(on_control)
        g = table_of(rows, columns, on_control[rows, columns], (count, self.loop.variables))
        d = np.einsum("pli,liq->pq", on_noise[firsts], self.loop.entries) + free[firsts] @ self.loop.begins
        if self.loop.inner.acts:
            d += self._weigh_missing(on_control[firsts].reshape(len(firsts), m, K).swapaxes(1, 2))
        return UncertainRows(g, h - offset, part, factor, tuple(matrices), d)

    def with_control(self, rows: UncertainRows, G: Array, pieces: np.ndarray, following: bool = False) -> UncertainRows:
        """Return the rows with ``G u_k`` added on the left, ``G (r, m)``, for the piece ``k`` of each row,
        ``pieces (r,)``.

        Rows of one part have the same direction of the control, times their factors, and the same piece. ``following``
        says that the control is the first one of the next period, which responds to the initial state of that period.
        """
        K, Q = self.loop.functionals.dictionary.pieces, self.loop.spread.size
        row, channel = np.nonzero(G)
        coordinates = (row, channel * K + pieces[row])
        g = csr_array(rows.g + csr_array((G[row, channel], coordinates), shape=rows.g.shape))
        matrices = []
        for first, C in zip(_find_firsts(rows.part), rows.C, strict=True):
            position, variable, value = self.loop.answers.of_piece(int(pieces[first]))
            entry = position % Q - following * self.loop.begins.shape[0]
            response = csr_array(
                (G[first][position // Q] * value, (entry, self.loop.nominal_size + variable)), shape=C.shape
            )
            matrices.append(csr_array(C + response))
        return self._with_inner(replace(rows, g=g, C=tuple(matrices)), G, pieces)

    def _with_inner(self, rows: UncertainRows, G: Array, pieces: np.ndarray) -> UncertainRows:
        """Return the rows with ``G K_k x(tau_k)`` added on the left, for the piece ``k`` of each row, ``pieces (r,)``:
        what the inner loop adds to ``G u_k``."""
        if not self.loop.inner.acts:
            return rows
        controls = np.zeros((len(G), self.loop.functionals.dictionary.pieces, G.shape[1]))
        controls[np.arange(len(G)), pieces] = G
        return self.with_controls(rows, controls)

    def with_controls(self, rows: UncertainRows, controls: Array) -> UncertainRows:
        """Return the rows with ``sum_k W_k K_k x(tau_k)`` added on the left, ``controls (r, K, m)``: what the inner
        loop adds to ``sum_k W_k u_k``. Rows of one part have the same weights, times their factors."""
        if not self.loop.inner.acts:
            return rows
        functional = self.loop.functionals.response.weigh_controls(controls)
        added = self._of_weights(functional, np.zeros(len(controls)), rows.part, rows.factor)
        matrices = tuple(csr_array(C + more) for C, more in zip(rows.C, added.C, strict=True))
        d = rows.d + added.d + self._weigh_missing(controls[_find_firsts(rows.part)])
        return replace(rows, g=csr_array(rows.g + added.g), h=rows.h + added.h, C=matrices, d=d)

    def _weigh_missing(self, controls: Array) -> Array:
        """Return the responses ``(r, Q)`` of ``sum_k W_k u_k``, of weights ``controls (r, K, m)``, to what the inner
        loop does not know of the state."""
        return np.asarray(np.einsum("rkm,kmq->rq", controls, self.loop.missing))

    def of_control(self, piece: int, H: Array, h: Array, extra: Array | None = None) -> UncertainRows:
        """Return the rows ``H u_k <= h`` on one piece for every deviation; ``extra (r, n)`` is added on the left."""
        part, factor = shared(H, self.loop.spread)
        firsts = _find_firsts(part)
        position, variable, value = self.loop.answers.of_piece(piece)
        Q, K = self.loop.spread.size, self.loop.functionals.dictionary.pieces
        channel, entry = position // Q, position % Q
        matrices = [self._tabulate_responses(entry, variable, H[first][channel] * value) for first in firsts]
        rows, channels = np.nonzero(H)
        columns, values = channels * K + piece, H[rows, channels]
        if extra is not None:
            extra_entries = np.nonzero(extra)
            rows, columns = np.concatenate([rows, extra_entries[0]]), np.concatenate([columns, extra_entries[1]])
            values = np.concatenate([values, extra[extra_entries]])
        g = table_of(rows, columns, values, (H.shape[0], self.loop.variables))
        uncertain = UncertainRows(g, h, part, factor, tuple(matrices), np.zeros((len(firsts), Q)))
        return self._with_inner(uncertain, H, np.full(H.shape[0], piece))

    def _tabulate_responses(self, entry: np.ndarray, variable: np.ndarray, values: Array) -> csr_array:
        """Return the matrix ``(Q, n)`` of ``values (k,)`` by which entries of a deviation respond to variables of the
        gains."""
        kept, shape = values != 0.0, (self.loop.spread.size, self.loop.variables)
        return table_of(entry[kept], self.loop.nominal_size + variable[kept], values[kept], shape)


def _find_firsts(part: np.ndarray) -> list[int]:
    """Return the first row of every part, of rows that belong to the parts ``part (r,)``."""
    return [int(np.flatnonzero(part == number)[0]) for number in range(int(part.max()) + 1)]


def shared(H: Array, spread: Spread) -> tuple[np.ndarray, Array]:
    """Group the rows of ``H (r, d)`` into parts of parallel rows; opposite rows share a part where deviations are
    symmetric. Return the part of every row, and its factor relative to the first row of the part."""
    part, factor = np.zeros(H.shape[0], dtype=int), np.ones(H.shape[0])
    firsts: list[int] = []
    for row in range(H.shape[0]):
        for p, first in enumerate(firsts):
            column = int(np.abs(H[first]).argmax())
            share = H[row, column] / H[first, column]
            if np.array_equal(H[row], share * H[first]) and (share > 0.0 or spread.is_symmetric):
                part[row], factor[row] = p, share
                break
        else:
            part[row] = len(firsts)
            firsts.append(row)
    return part, factor
