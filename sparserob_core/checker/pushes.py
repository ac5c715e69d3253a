"""What the disturbance may add to ``c'x(t)``: its support function as a polynomial with an error, piece by piece of the disturbance."""

from __future__ import annotations

from bisect import bisect_right
from dataclasses import dataclass, field
from functools import cached_property
from typing import TYPE_CHECKING, final

import numpy as np

from sparserob_core.checker.bernstein import bernstein
from sparserob_core.checker.flow import Flow, exponential, in_time, stacked, up_to
from sparserob_core.checker.polynomials import OUTWARD, ROUNDING, Enclosed, linear_bound
from sparserob_core.control.sets import ConvexSet
from sparserob_core.sip.convex_set import Array

if TYPE_CHECKING:
    from flint import arb, arb_mat

SAME = 1e-14            # of the horizon: durations closer than this are treated as one ball that holds them all


@final
@dataclass(frozen=True, eq=False)
class Scene:
    """What is simulated: the ``grid`` (all breakpoints), the control ``(m, 1)`` on each of its pieces, ``x(0)``, and the disturbance: its set and
    the breakpoints between which it is constant."""

    grid: list[float]
    control: list[arb_mat]
    initial_state: list[float]
    disturbance: ConvexSet | None
    changes: list[float]


@final
@dataclass(eq=False)
class Pushes:
    """The functionals ``c'e^{A s}`` and their integrals over one box of parameters, remembered by duration and direction."""

    flow: Flow
    scene: Scene
    _made: dict[object, object] = field(default_factory=dict)
    _rows: dict[bytes, tuple[list[int], list[arb_mat]]] = field(default_factory=dict)

    @cached_property
    def _row_matrix(self) -> arb_mat:
        return self.flow.rows()

    def bound(self, start: float, length: arb, direction: Array) -> tuple[Array, float, float]:
        """Coefficients of a bound of the disturbance's support, its error, and how much of that is due to switching."""
        assert self.scene.disturbance is not None
        lags = [s for s in self.scene.changes if s <= start]
        sign = 1.0 if direction[np.flatnonzero(direction)[0]] > 0 else -1.0   # opposite directions share their rows
        parts = [self._integral(start, s, length, sign * direction) for s in reversed(lags)]  # short ones first: each starts from the one before
        mids, rads = zip(*reversed(parts), strict=True)
        mid, rad = sign * np.array(mids), np.array(rads)            # (lags, J + 1, M, mw)
        mid, rad = np.concatenate([mid, np.zeros_like(mid[:1])]), np.concatenate([rad, np.zeros_like(rad[:1])])
        rad = rad[:-1] + rad[1:] + ROUNDING * (np.abs(mid[:-1]) + np.abs(mid[1:]))
        mid = mid[:-1] - mid[1:]
        ends = bernstein(np.moveaxis(mid[:, :, 0], 1, 2).reshape(-1, mid.shape[1]), [False]).reshape(mid.shape[0], -1, mid.shape[1])
        value, spread = (ends.max(axis=2) + ends.min(axis=2)) / 2, (ends.max(axis=2) - ends.min(axis=2)) / 2
        spread = spread + np.abs(mid[:, :, 1:]).sum(axis=(1, 2)) + rad.sum(axis=(1, 2)) + ROUNDING * np.abs(mid[:, :, 0]).sum(axis=1)
        w, excess = linear_bound(self.scene.disturbance, value, spread * OUTWARD)
        size = np.abs(w)
        moved = np.einsum("lw,ljkw->jk", w, mid)
        off = float(np.einsum("lw,ljkw->", size, rad) + ROUNDING * np.einsum("lw,ljkw->", size, np.abs(mid)))
        return moved, off * OUTWARD, float(excess.sum()) * OUTWARD

    def _integral(self, time: float, since: float, length: arb, direction: Array) -> tuple[Array, Array]:
        """``int_0^{t - since} c'e^{A s} E ds`` for ``t`` from ``time`` on, as ``(J + 1, M, mw)`` with errors of the same shape."""
        key = ("row", round((time - since) / self._tick), str(length), direction.tobytes())
        if key not in self._made:
            row = self._widened * self._row(key[1], direction)
            terms = [row]
            if not length.is_zero():
                terms += in_time(self._row_matrix, self._row_matrix * row, length, self._inside(length))
            M, d = self.flow.monomials.size, len(self.scene.initial_state)
            block = row.nrows() // M
            both = Enclosed.of(stacked([[term[k * block + i, 0] for k in range(M) for i in range(d, block)] for term in terms]))
            shape = (len(terms), M, block - d)
            self._made[key] = (both.mid.reshape(shape), both.rad.reshape(shape))
        return self._made[key]  # type: ignore[return-value]

    def _inside(self, length: arb) -> arb_mat:
        key = ("inside", str(length))
        if key not in self._made:
            self._made[key] = exponential(self._row_matrix, up_to(length))
        return self._made[key]  # type: ignore[return-value]

    @property
    def _tick(self) -> float:
        return SAME * self.scene.grid[-1]

    @cached_property
    def _widened(self) -> arb_mat:
        """Whatever a row does within a tick to either side."""
        from flint import arb

        return exponential(self._row_matrix, arb(0, self._tick))

    def _row(self, ticks: int, direction: Array) -> arb_mat:
        """The row after that many ticks, from the longest one before it that is known."""
        from flint import arb

        known = self._rows.setdefault(direction.tobytes(), ([0], [self._first_row(direction)]))
        place = bisect_right(known[0], ticks)
        before = known[0][place - 1]
        if before == ticks:
            return known[1][place - 1]
        name = ("row step", ticks - before)
        if name not in self._made:
            self._made[name] = exponential(self._row_matrix, arb(self._tick) * (ticks - before))
        row: arb_mat = self._made[name] * known[1][place - 1]  # type: ignore[operator]
        known[0].insert(place, ticks)
        known[1].insert(place, row)
        return row

    def _first_row(self, direction: Array) -> arb_mat:
        from flint import arb

        M, d = self.flow.monomials.size, direction.size
        block = self._row_matrix.nrows() // M
        return stacked([[arb(float(direction[i]) if k == 0 and i < d else 0.0)] for k in range(M) for i in range(block)])
