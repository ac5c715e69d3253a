"""Information that a causal control has about a signal, and the worst continuations that it cannot exclude.

A causal control is a function of the reports that it has received: it is the same under two signals with the same
reports. Reports are the blocks of the disturbance: whatever is measured tells no more.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from typing import final

import numpy as np

from sparserob_core.sip.convex_set import Array
from sparserob_core.sip.finite import Spread

NONE = 1e-9  # of a size, below which a number is rounding


@final
@dataclass(frozen=True, eq=False)
class Knowledge:
    """Information of a causal control about signals, the deviations ``(Q,)`` of a disturbance.

    Parameters
    ----------
    N : ndarray, shape (R, Q)
        Rows, linear functions of the deviations.
    spread : Spread
        Set of the deviations.
    width : int
        Number of deviations in each block of the disturbance.
    known_reports : ndarray, shape (K,)
        Number of reports that every piece of the control knows.
    past_reports : ndarray, shape (R,)
        Number of reports that are older than the time of each row.
    """

    N: Array
    spread: Spread
    width: int
    known_reports: np.ndarray
    past_reports: np.ndarray

    @property
    def reports(self) -> int:
        """Number of blocks of the disturbance."""
        return int(self.N.shape[1] // max(1, self.width))

    @property
    def nominal(self) -> Array:
        """No deviation."""
        return np.zeros(self.N.shape[1])

    @cached_property
    def first(self) -> np.ndarray:
        """The first piece that may know of a report, ``(reports + 1,)``."""
        return np.searchsorted(self.known_reports, np.arange(self.reports + 1), side="right")

    @cached_property
    def worst(self) -> Array:
        """The deviations that are the worst for every row, ``(R, Q)``."""
        return extreme(self.spread, self.N)

    @cached_property
    def contribution_bounds(self) -> Array:
        """Upper bounds ``(R,)`` of the contribution of the worst deviations to every row."""
        return np.asarray(np.abs(self.N * self.worst).sum(axis=1))

    def history(self, signal: Array, reports: int) -> bytes:
        """Return the first ``reports`` reports of a signal as bytes; equal bytes mean that a control cannot distinguish
        two signals."""
        return signal[: reports * self.width].tobytes()

    def bound_contributions(self, signals: Array) -> Array:
        """Return the largest contribution of the deviations to every row, among signals whose first reports are those
        of a given signal: ``(S, R, reports + 1)``.

        The signal's own blocks contribute before a report, and the worst blocks from the report on.
        """
        return sums(self.by_block(self.N * signals[:, None]).sum(axis=3)) + self._later_support_values

    def changed(self, signal: Array, row: int, report: int) -> tuple[float, Array]:
        """Return the largest contribution to the row, and the signal with the blocks that are the worst for the row
        from ``report`` on."""
        stop, start, z = self.past_reports[row] * self.width, report * self.width, signal.copy()
        z[start:stop] = self.worst[row, start:stop]
        return float(self.N[row, :start] @ z[:start]) + float(self._later_support_values[row, report]), z

    def leaving(
        self, signals: Array, own: Array, answered: Array | None, scale: float, units: Array
    ) -> Iterator[tuple[int, int, Array]]:
        """Yield signals that depart from a given one at a report and are the worst for a row from there on.

        Every item holds the number of the given signal, the number of the report, and the new signal. Signals whose row
        has the largest excess come first.

        Parameters
        ----------
        signals : ndarray, shape (S, Q)
            Given signals.
        own : ndarray, shape (S, R)
            Values of the rows under each signal without the deviations. A control is part of them.
        answered : ndarray, shape (R, ...), optional
            Coefficients, in every row, of the control's response to deviations that differ from those of the signal.
            Without it the control does not respond.
        scale : float
            Factor of all deviations.
        units : ndarray, shape (R,)
            Units in which the excess of the rows is compared.
        """
        responses = np.zeros_like(self.N) if answered is None else answered[:, : self.N.shape[1]]
        closed = responses + self.N
        closed = np.where(np.abs(closed) > NONE * np.abs(self.N), closed, self.N * NONE)
        worst = extreme(self.spread, closed)
        past_values = sums(self.by_block(self.N * signals[:, None]).sum(axis=-1))
        later_responses = self._sum_later_blocks(responses * signals[:, None])
        excess = own[:, :, None] + scale * (past_values - later_responses + self._sum_later_blocks(closed * worst))
        excess = excess / units[:, None]
        excess[:, :, -1] = -np.inf
        excess = np.where(np.arange(excess.shape[2]) < self.past_reports[:, None], excess, -np.inf)
        for flat_index in np.argsort(-excess, axis=None).tolist():
            signal, row, report = (int(v) for v in np.unravel_index(flat_index, excess.shape))
            if excess[signal, row, report] <= NONE:
                return
            child = signals[signal].copy()
            child[report * self.width :] = worst[row, report * self.width :]
            yield signal, report, child

    def _sum_later_blocks(self, a: Array) -> Array:
        past = sums(self.by_block(a).sum(axis=-1))
        return np.asarray(past[..., -1:] - past)

    @cached_property
    def _later_support_values(self) -> Array:
        """The most that the disturbance from every block on gives to every row, ``(R, blocks + 1)``."""
        contributions = self.by_block(self.N * self.worst).sum(axis=2)
        return sums(contributions[:, ::-1])[:, ::-1]

    def by_block(self, a: Array) -> Array:
        """Return numbers of every deviation, block by block."""
        return a.reshape(*a.shape[:-1], self.reports, max(1, self.width))


def extreme(spread: Spread, along: Array) -> Array:
    """Return an extreme deviation ``(..., Q)`` of the set that is the worst along ``along (..., Q)``; any one where the
    direction is 0."""
    if spread.is_box:
        return np.asarray(np.where(along >= 0.0, 1.0, -1.0) * spread.radii)
    return np.asarray(spread.worst(along))


def sums(a: Array) -> Array:
    """Return the sums over the last axis of the entries before each position, and of all entries."""
    return np.concatenate([np.zeros((*a.shape[:-1], 1)), np.cumsum(a, axis=-1)], axis=-1)
