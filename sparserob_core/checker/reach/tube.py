"""The worst case of ``c'x(t)`` over every disturbance and initial state, on cells of time and over one box of
parameters, as polynomials with an error."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property
from math import comb
from typing import NamedTuple, final

import numpy as np

from sparserob_core.checker.arithmetic.monomials import NONE, Monomials
from sparserob_core.checker.arithmetic.series import stacked
from sparserob_core.checker.flow.law import ParameterBox
from sparserob_core.checker.reach.states import States
from sparserob_core.checker.reach.supports import bounded
from sparserob_core.checker.sets.known import known
from sparserob_core.checker.sets.polynomials import OUTWARD, Enclosed, rounding
from sparserob_core.sip.convex_set import Array, ConvexSet

ORDER = 6  # of polynomials in the time on a cell: half of it takes shorter cells, twice it takes longer for each
CELLS_KEPT = 20_000  # of which rows are remembered: those of a box are asked for again in its parts


@final
@dataclass(frozen=True, eq=False)
class Polynomial:
    """``coefficients (J + 1, M)`` in powers of the time within the cell (from 0 to 1) and monomials of the parameters;
    the truth exceeds it by at most ``error``, of which ``expansion`` is due to the size of the box of parameters, or of
    the cell of time where it is a chord; both together exceed the truth by at most twice the ``error`` and ``kinks``,
    which is due to disturbances about to switch, about ``turning`` of it because the box of parameters is so large.
    ``bent``: what of the error each parameter makes beside those, ``None`` where none does.
    """

    coefficients: Array
    error: float
    expansion: float
    kinks: float
    turning: float = 0.0
    bent: Array | None = None


class Around(NamedTuple):
    """The ``monomials`` of parameters about the ``centre (nu,)`` of a box, in units of its ``radius (nu,)``; there may
    be none that anything depends on. ``sizes (M,)``: how much each has to do with the system."""

    monomials: Monomials = NONE
    centre: tuple[float, ...] = ()
    radius: tuple[float, ...] = ()
    sizes: Array = np.ones(1)


@final
@dataclass(eq=False)
class ProjectedStates:
    """The ``states`` along the rows of a ``basis (b, d)``."""

    states: States
    basis: Array
    _seen: dict[tuple[int, float, float], tuple[Enclosed, list[tuple[ConvexSet, Enclosed]]]] = field(
        default_factory=dict, repr=False
    )

    def on(self, place: int, start: float, stop: float) -> tuple[Enclosed, list[tuple[ConvexSet, Enclosed]]]:
        """`States.seen` of the basis."""
        key = place, start, stop
        if key not in self._seen:
            if len(self._seen) >= CELLS_KEPT or not self.states.flow.monomials.degree:
                self._seen.clear()
            self._seen[key] = self.states.seen(self.basis, place, start, stop, ORDER)
        return self._seen[key]


@final
@dataclass(eq=False)
class VerifiedTube:
    """The reachable states over a ``box`` of parameters, seen along combinations of ``rows``, which are known over that
    box or one that holds it."""

    rows: ProjectedStates
    box: ParameterBox = ParameterBox()  # noqa: RUF009  immutable

    @cached_property
    def flow(self) -> Around:
        """The monomials on the box."""
        flow = self.rows.states.flow
        return Around(flow.monomials, self.box.middle, self.box.halves, flow.law.weights)

    @cached_property
    def _recentred(self) -> Enclosed | None:
        """What makes of coefficients about the middle of the larger box those on this one, ``(M, M)``; ``None`` where
        these are the same."""
        from flint import arb

        whole = self.rows.states.flow.box
        if whole == self.box:
            return None
        moves, table = [], []
        for middle, half, centre, width in zip(
            self.box.middle, self.box.halves, whole.middle, whole.halves, strict=True
        ):
            unit = arb(width) if width else arb(1)
            moves.append(((arb(middle) - arb(centre)) / unit, arb(half) / unit))
        for e in self.flow.monomials.exponents:  # of this box
            row = []
            for f in self.flow.monomials.exponents:
                entry = arb(1)
                for k, n, (c, r) in zip(e, f, moves, strict=True):
                    entry = entry * comb(n, k) * c ** (n - k) * r**k if n >= k else arb(0)
                row.append(entry)
            table.append(row)
        return Enclosed.of(stacked(table))

    def cells(self, piece: int, start: float, stop: float, z: Array, sharp: bool = False) -> list[Polynomial]:
        """For every ``c = z_i'basis``, ``z (k, b)``, the polynomial above ``c'x`` on ``[start, stop]``, a part
        of piece ``piece`` of the grid; ``sharp``: with less for disturbances about to switch, where that can be."""
        states = self.rows.states
        place = states.place(piece, start)
        state, parts = self.rows.on(place, start, stop)
        state = self._moved(state, 1)
        mid = np.einsum("jmb,ib->ijm", state.mid, z)
        lost = state.rad + rounding(z.shape[1]) * np.abs(state.mid)
        rad, kinks, turning = np.abs(z) @ lost.sum(axis=(0, 1)), np.zeros(len(z)), np.zeros(len(z))
        for convex, part in parts:
            here = self._moved(part, 2)
            moved, off, switching, of_box = bounded(known(convex), self.flow.monomials, here.mid, here.rad, z, sharp)
            rad += off + rounding(1) * (np.abs(mid) + np.abs(moved)).sum(axis=(1, 2))
            mid, kinks, turning = mid + moved, kinks + switching, turning + of_box
        blur = np.abs(z) @ (np.abs(self.rows.basis) @ states.blur(place))
        return [
            Polynomial(mid[i], float(rad[i]) * OUTWARD, float(blur[i]), float(kinks[i]), float(turning[i]))
            for i in range(len(z))
        ]

    def _moved(self, rows: Enclosed, axis: int) -> Enclosed:
        """Coefficients on this box, from those about the middle of the larger one along an ``axis``."""
        moves = self._recentred
        if moves is None:
            return rows
        mid, rad, size = (np.moveaxis(one, axis, -1) for one in (rows.mid, rows.rad, np.abs(rows.mid)))
        off = (rad + rounding(moves.mid.shape[0]) * size) @ (np.abs(moves.mid) + moves.rad).T + size @ moves.rad.T
        return Enclosed(np.moveaxis(mid @ moves.mid.T, -1, axis), np.moveaxis(off * OUTWARD, -1, axis))
