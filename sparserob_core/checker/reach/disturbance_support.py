"""What the disturbance may add to ``c'x(t)``: its support function as a polynomial with an error, piece by piece of the
disturbance."""

from __future__ import annotations

from bisect import bisect_right
from dataclasses import dataclass, field
from functools import cached_property
from typing import TYPE_CHECKING, final

import numpy as np

from sparserob_core.checker.arithmetic.bernstein import bernstein
from sparserob_core.checker.arithmetic.series import Series
from sparserob_core.checker.reach.flow import Flow, in_time, stacked, up_to
from sparserob_core.checker.sets.polynomials import OUTWARD, ROUNDING, Enclosed, linear_bound
from sparserob_core.control.sets.sets import ConvexSet
from sparserob_core.sip.convex_set import Array

if TYPE_CHECKING:
    from flint import arb, arb_mat

SAME = 1e-14  # of the horizon: durations closer than this are treated as one ball that holds them all


@final
@dataclass(frozen=True, eq=False)
class Scene:
    """What is simulated: the ``grid`` (all breakpoints), the control ``(m, 1)`` on each of its pieces, ``x(0)``, and
    the disturbance: its set and the breakpoints between which it is constant."""

    grid: list[float]
    control: list[arb_mat]
    initial_state: list[float]
    disturbance: ConvexSet | None
    changes: list[float]

    @property
    def tick(self) -> float:
        """The unit in which durations are told apart."""
        return SAME * self.grid[-1]

    def ticks(self, start: float, stop: float) -> int:
        """A duration in ticks, rounded up; 0 only for none."""
        return 0 if start == stop else round((stop - start) / self.tick) + 1

    def duration(self, ticks: int) -> arb:
        """That many ticks, exactly."""
        from flint import arb

        return arb(self.tick) * ticks


@final
class Table:
    """Arrays by lag, in one array that grows."""

    def __init__(self) -> None:
        self.places: dict[int, int] = {}
        self.mid = self.rad = np.zeros((0, 0, 0, 0))

    def add(self, lag: int, entry: tuple[Array, Array]) -> None:
        """One more lag."""
        place = len(self.places)
        if place == self.mid.shape[0] or not place:
            size = max(16, 2 * place)
            self.mid, self.rad = (
                np.concatenate([old.reshape(place, *new.shape), np.zeros((size - place, *new.shape))])
                for old, new in zip((self.mid, self.rad), entry, strict=True)
            )
        self.mid[place], self.rad[place] = entry
        self.places[lag] = place


@final
@dataclass(eq=False)
class DisturbanceSupports:
    """The functionals ``c'e^{A s}`` and their integrals over one box of parameters, remembered by duration and
    direction."""

    flow: Flow
    scene: Scene
    _tables: dict[tuple[int, bytes], Table] = field(default_factory=dict)
    _steps: dict[int, Series] = field(default_factory=dict)
    _inside: dict[int, Series] = field(default_factory=dict)
    _latest: tuple[tuple[float, int, bytes], Array, Array, Array, Array] | None = None
    _rows: dict[bytes, tuple[list[int], list[Series]]] = field(default_factory=dict)

    def bound(self, start: float, ticks: int, direction: Array) -> tuple[Array, float, float]:
        """Coefficients of a bound of the disturbance's support from ``start`` on for that many ticks, its error, and
        how much of that is due to switching."""
        assert self.scene.disturbance is not None
        # opposite directions share everything but the sign
        sign = 1.0 if direction[np.flatnonzero(direction)[0]] > 0 else -1.0
        key = (start, ticks, (sign * direction).tobytes())
        if self._latest is None or self._latest[0] != key:
            self._latest = (key, *self._ranged(start, ticks, sign * direction))
        _, mid, rad, value, spread = self._latest
        w, excess = linear_bound(self.scene.disturbance, sign * value, spread)
        size = np.abs(w)
        moved = sign * np.einsum("lw,ljkw->jk", w, mid)
        off = float(np.einsum("lw,lw->", size, rad.sum(axis=(1, 2)) + ROUNDING * np.abs(mid).sum(axis=(1, 2))))
        return moved, off * OUTWARD, float(excess.sum()) * OUTWARD

    def _ranged(self, start: float, ticks: int, direction: Array) -> tuple[Array, Array, Array, Array]:
        """`_weights`, and the ranges that they stay in on the cell: middles and half-widths, ``(pieces, mw)``."""
        mid, rad = self._weights(start, ticks, direction)
        ends = bernstein(np.moveaxis(mid[:, :, 0], 1, 2).reshape(-1, mid.shape[1]), [False]).reshape(
            mid.shape[0], -1, mid.shape[1]
        )
        highest, lowest = ends.max(axis=2), ends.min(axis=2)
        spread = (
            (highest - lowest) / 2
            + np.abs(mid[:, :, 1:]).sum(axis=(1, 2))
            + rad.sum(axis=(1, 2))
            + ROUNDING * np.abs(mid[:, :, 0]).sum(axis=1)
        )
        return mid, rad, (highest + lowest) / 2, spread * OUTWARD

    def _weights(self, start: float, ticks: int, direction: Array) -> tuple[Array, Array]:
        """What every piece of the disturbance before the cell adds per unit, ``(pieces, J + 1, M, mw)``, with errors of
        the same shape."""
        table = self._tables.setdefault((ticks, direction.tobytes()), Table())
        lags = (
            np.rint((start - self._jumps[: np.searchsorted(self._jumps, start, side="right")]) / self.scene.tick)
            .astype(int)
            .tolist()
        )
        for lag in reversed(lags):  # short ones first: each row starts from the one before
            if lag not in table.places:
                table.add(lag, self._integral(lag, ticks, direction))
        places = [table.places[lag] for lag in lags]
        mid, rad = table.mid[places], table.rad[places]
        rad[:-1] += rad[1:] + ROUNDING * (np.abs(mid[:-1]) + np.abs(mid[1:]))
        mid[:-1] -= mid[1:]
        return mid, rad

    @cached_property
    def _jumps(self) -> Array:
        return np.array(self.scene.changes)

    def _integral(self, lag: int, ticks: int, direction: Array) -> tuple[Array, Array]:
        """``int_0^s c'e^{A r} E dr`` for ``s`` from ``lag`` on, as ``(J + 1, M, mw)`` with errors of the same shape."""
        row = self._widened * self._row(lag, direction)
        terms = [row]
        if ticks:
            if ticks not in self._inside:
                self._inside[ticks] = self.flow.rows.scaled(up_to(self.scene.duration(ticks))).exp()
            terms += in_time(self.flow.rows, self.flow.rows * row, self.scene.duration(ticks), self._inside[ticks])
        M, d = self.flow.monomials.size, len(self.scene.initial_state)
        block = row.parts[0].nrows()
        both = Enclosed.of(
            stacked([[term.parts[k][i, 0] for k in range(M) for i in range(d, block)] for term in terms])
        )
        shape = (len(terms), M, block - d)
        return both.mid.reshape(shape), both.rad.reshape(shape)

    @cached_property
    def _widened(self) -> Series:
        """Whatever a row does within a tick to either side."""
        from flint import arb

        return self.flow.rows.scaled(arb(0, self.scene.tick)).exp()

    def _row(self, ticks: int, direction: Array) -> Series:
        """The row after that many ticks, from the longest one before it that is known."""

        known = self._rows.setdefault(direction.tobytes(), ([0], [self._first_row(direction)]))
        place = bisect_right(known[0], ticks)
        before = known[0][place - 1]
        if before == ticks:
            return known[1][place - 1]
        if ticks - before not in self._steps:
            self._steps[ticks - before] = self.flow.rows.scaled(self.scene.duration(ticks - before)).exp()
        row = self._steps[ticks - before] * known[1][place - 1]
        known[0].insert(place, ticks)
        known[1].insert(place, row)
        return row

    def _first_row(self, direction: Array) -> Series:
        from flint import arb

        size = self.flow.rows.parts[0].nrows()
        column = [[arb(float(direction[i]) if i < direction.size else 0.0)] for i in range(size)]
        return Series.constant(self.flow.monomials, stacked(column))
