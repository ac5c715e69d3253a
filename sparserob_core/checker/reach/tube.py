"""The largest ``c'x(t)`` over all deviations on cells of time, as polynomials with error bounds: over one box of
parameters, for a closed loop, and for quantities with numbered places instead of times."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from math import comb
from typing import NamedTuple, final

import numpy as np
from flint import arb, arb_mat

from sparserob_core.checker.arithmetic.balls import ball
from sparserob_core.checker.arithmetic.bernstein import bernstein
from sparserob_core.checker.arithmetic.monomials import NONE, Monomials
from sparserob_core.checker.arithmetic.remembered import remembered
from sparserob_core.checker.arithmetic.series import exactly, stacked
from sparserob_core.checker.flow.law import ParameterBox
from sparserob_core.checker.reach.closed_loop import VerifiedLoop
from sparserob_core.checker.reach.states import States
from sparserob_core.checker.sets.known import known
from sparserob_core.checker.sets.polynomials import OUTWARD, ROUNDING, Enclosed, rounding
from sparserob_core.checker.sets.shape import Shape
from sparserob_core.sip.convex_set import Array, ConvexSet

ORDER = 6  # terms of polynomials in the time on a cell: half of it needs shorter cells, twice it more time for each
CELLS_KEPT = 20_000  # cells whose rows are remembered: the parts of a box need the rows of the box again


@final
@dataclass(frozen=True, eq=False)
class Polynomial:
    """A polynomial with an error bound, near the largest ``c'x`` on a cell of time and a box of parameters.

    The true value exceeds the polynomial by at most ``error``. The polynomial plus ``error`` exceeds the true value by
    at most twice the ``error`` plus ``kinks``; for a chord this holds at its ends only.

    Attributes
    ----------
    coefficients
        The coefficients ``(J + 1, M)`` of powers of the time within the cell, from 0 to 1, and monomials of the
        parameters.
    error
        The error bound.
    expansion
        About the part of ``error`` that is due to the size of the box of parameters; for a chord, to the length of the
        cell.
    kinks
        How much the bound may be above the true value because the worst disturbance switches within the cell.
    turning
        About the part of ``kinks`` that is due to the size of the box of parameters.
    parameter_errors
        A further part of the error, due to each parameter, ``(nu,)``; ``None`` where there is none.
    """

    coefficients: Array
    error: float
    expansion: float
    kinks: float
    turning: float = 0.0
    parameter_errors: Array | None = None


class Around(NamedTuple):
    """The ``monomials`` of parameters about the ``centre (nu,)`` of a box, in units of its ``radius (nu,)``. There may
    be no parameter. ``sizes (M,)`` says about how much each monomial contributes to the system."""

    monomials: Monomials = NONE
    centre: tuple[float, ...] = ()
    radius: tuple[float, ...] = ()
    sizes: Array = np.ones(1)


@final
@dataclass(eq=False)
class ProjectedStates:
    """The ``states`` projected onto the rows of a ``basis (b, d)``."""

    states: States
    basis: Array
    _projections: dict[tuple[int, float, float], tuple[Enclosed, list[tuple[ConvexSet, Enclosed]]]] = field(
        default_factory=dict, repr=False
    )

    def on(self, place: int, start: float, stop: float) -> tuple[Enclosed, list[tuple[ConvexSet, Enclosed]]]:
        """Return `States.project` for the basis on ``[start, stop]``, a part of an interval between marks."""
        key = place, start, stop
        if key not in self._projections:
            if len(self._projections) >= CELLS_KEPT or not self.states.flow.monomials.degree:
                self._projections.clear()
            self._projections[key] = self.states.project(self.basis, place, start, stop, ORDER)
        return self._projections[key]


@final
@dataclass(eq=False)
class VerifiedTube:
    """The reachable states over a ``box`` of parameters, projected onto combinations of ``rows``, which are known over
    this box or a larger one."""

    rows: ProjectedStates
    box: ParameterBox = ParameterBox()  # noqa: RUF009  immutable

    @cached_property
    def flow(self) -> Around:
        """The monomials on the box."""
        flow = self.rows.states.flow
        return Around(flow.monomials, self.box.middle, self.box.halves, flow.law.weights)

    @cached_property
    def _recentring_matrix(self) -> Enclosed | None:
        """The matrix ``(M, M)`` from coefficients on the larger box to those on this one; ``None`` where both boxes are
        the same."""
        outer_box = self.rows.states.flow.box
        if outer_box == self.box:
            return None
        moves, table = [], []
        for middle, half, centre, width in zip(
            self.box.middle, self.box.halves, outer_box.middle, outer_box.halves, strict=True
        ):
            unit = ball(width) if width else ball(1)
            moves.append(((ball(middle) - ball(centre)) / unit, ball(half) / unit))
        for e in self.flow.monomials.exponents:  # on this box; below, ``f`` on the larger one
            row = []
            for f in self.flow.monomials.exponents:
                entry = ball(1)
                for k, n, (c, r) in zip(e, f, moves, strict=True):
                    entry = entry * comb(n, k) * c ** (n - k) * r**k if n >= k else ball(0)
                row.append(entry)
            table.append(row)
        return Enclosed.of(stacked(table))

    def cells(self, piece: int, start: float, stop: float, z: Array) -> list[Polynomial]:
        """Return polynomials near the largest ``c'x`` over all deviations, for every direction ``c = z_i'basis``, ``z
        (k, b)``, on a cell of time, a part of a piece of the grid without marks."""
        states = self.rows.states
        interval = states.place(piece, start)
        state, effects = self.rows.on(interval, start, stop)
        state = self._recentre(state, 1)
        mid = np.einsum("jmb,ib->ijm", state.mid, z)
        errors = state.rad + rounding(z.shape[1]) * np.abs(state.mid)
        rad, kinks, turning = np.abs(z) @ errors.sum(axis=(0, 1)), np.zeros(len(z)), np.zeros(len(z))
        for convex, effect in effects:
            arguments = self._recentre(effect, 2)
            supports, support_errors, switching, of_box = bound_supports(known(convex), arguments.mid, arguments.rad, z)
            rad += support_errors + rounding(1) * (np.abs(mid) + np.abs(supports)).sum(axis=(1, 2))
            mid, kinks, turning = mid + supports, kinks + switching, turning + of_box
        blur = np.abs(z) @ (np.abs(self.rows.basis) @ states.blur(interval))
        return [
            Polynomial(mid[i], float(rad[i]) * OUTWARD, float(blur[i]), float(kinks[i]), float(turning[i]))
            for i in range(len(z))
        ]

    def _recentre(self, rows: Enclosed, axis: int) -> Enclosed:
        """Return coefficients on this box from those on the larger one; they stand along an ``axis``."""
        moves = self._recentring_matrix
        if moves is None:
            return rows
        mid, rad, size = (np.moveaxis(values, axis, -1) for values in (rows.mid, rows.rad, np.abs(rows.mid)))
        errors = (rad + rounding(moves.mid.shape[0]) * size) @ (np.abs(moves.mid) + moves.rad).T + size @ moves.rad.T
        return Enclosed(np.moveaxis(mid @ moves.mid.T, -1, axis), np.moveaxis(errors * OUTWARD, -1, axis))


def bound_supports(shape: Shape, every: Array, errors: Array, z: Array) -> tuple[Array, Array, Array, Array]:
    """Return polynomials that, with their errors, are upper bounds of the sum over pieces of a set's support function,
    by a point of the set that is best or nearly so in the middle of the range of the arguments. These are combinations
    ``z (k, b)`` of ``every (pieces, J + 1, M, mw, b)`` with ``errors``.

    They are coefficients ``(k, J + 1, M)`` and their errors ``(k,)``. The third value says how much they may be too
    large because the worst point of the set switches, ``(k,)``, the last about how much of that is due to the box of
    parameters."""
    mid = np.einsum("ljkwb,ib->iljkw", every, z)
    rad = np.einsum("ljkwb,ib->iljkw", errors + rounding(z.shape[1]) * np.abs(every), np.abs(z)) * OUTWARD
    k, pieces, mw = mid.shape[0], mid.shape[1], mid.shape[-1]
    value, spread, of_box = _compute_ranges(mid, rad)
    w, excess = shape.bound(value.reshape(-1, mw), spread.reshape(-1, mw))
    w, kinks = w.reshape(k, pieces, mw), excess.reshape(k, pieces) * OUTWARD
    argument_errors = rad.sum(axis=(2, 3)) + rounding(pieces * mw) * np.abs(mid).sum(axis=(2, 3))
    radius = np.array(shape.radius)
    total_width, box_width = spread @ radius, of_box @ radius
    share = np.divide(box_width, total_width, out=np.zeros_like(total_width), where=total_width > 0.0)
    error = np.einsum("ilw,ilw->il", np.abs(w), argument_errors) * OUTWARD + kinks
    coefficients = np.einsum("ilw,iljkw->ijk", w, mid)
    return coefficients, error.sum(axis=1) * OUTWARD, kinks.sum(axis=1) * OUTWARD, (share * kinks).sum(axis=1)


def _compute_ranges(mid: Array, rad: Array) -> tuple[Array, Array, Array]:
    """Return the ranges of arguments ``(k, pieces, J + 1, M, mw)`` on the cell: their middles, their half-widths, and
    the part of the half-widths due to the parameters, ``(k, pieces, mw)`` each."""
    k, pieces, orders, _, mw = mid.shape
    ends = bernstein(np.moveaxis(mid[:, :, :, 0], 2, 3).reshape(-1, orders), [False]).reshape(k, pieces, mw, -1)
    highest, lowest = ends.max(axis=3), ends.min(axis=3)
    of_box = np.abs(mid[:, :, :, 1:]).sum(axis=(2, 3))
    spread = (highest - lowest) / 2 + of_box + rad.sum(axis=(2, 3)) + ROUNDING * np.abs(mid[:, :, :, 0]).sum(axis=2)
    return (highest + lowest) / 2, spread * OUTWARD, of_box


@final
@dataclass(eq=False)
class LoopTube:
    """The reachable states of a closed ``loop``, projected onto combinations of the rows of ``basis (b, d)``. With
    ``gains (b, m)``, these rows also hold the answers of the control, without its nominal part."""

    loop: VerifiedLoop
    basis: Array
    gains: Array
    flow: Around = Around()  # noqa: RUF009  immutable

    def cells(self, piece: int, start: float, stop: float, z: Array) -> list[Polynomial]:
        """Return chords with error bounds for every direction ``c = z_i'basis``, with the parameters of
        `VerifiedTube.cells`. The part ``expansion`` of the error is due to the length of the cell. The true value may
        be far below a chord between its ends."""
        begin, end = self._enclose_heights(piece, start, z), self._enclose_heights(piece, stop, z)
        chord_errors = np.zeros(z.shape[0])
        if start < stop:
            chord_errors = self.loop.bound_chord_error(piece, start, stop, _combine_rows(z, self.basis))
        errors = np.maximum(begin.rad, end.rad) + rounding(2) * (np.abs(begin.mid) + np.abs(end.mid)) + chord_errors
        chords = np.stack([begin.mid, end.mid - begin.mid] if start < stop else [begin.mid])
        return [
            Polynomial(chord[:, None], float(error) * OUTWARD, float(length), 0.0)
            for chord, error, length in zip(chords.T, errors, chord_errors, strict=True)
        ]

    @remembered(key=lambda self, piece, time, z: (piece, time, z.tobytes()))
    def _enclose_heights(self, piece: int, time: float, z: Array) -> Enclosed:
        """Return the largest ``c'x`` at a time in a piece of the grid, with the answers of the control, ``(k,)``."""
        answers = None
        if self.gains.shape[1]:
            answers = exactly(_combine_rows(z, self.gains)) * self.loop.answers(self.loop.on(piece))
        return _convert_balls(self.loop.highest(piece, time, _combine_rows(z, self.basis), answers))


@final
@dataclass(frozen=True, eq=False)
class TimelessTube:
    """The largest values of quantities with numbered places instead of times. ``heights`` gives them at a place for
    rows ``(r, d)``, which are combinations of the rows of ``basis (b, d)``."""

    heights: Callable[[int, arb_mat], list[arb]]
    basis: Array
    flow: Around = Around()  # noqa: RUF009  immutable

    def cells(self, piece: int, start: float, stop: float, z: Array) -> list[Polynomial]:
        """Return constants with error bounds at the place number ``piece``, with the parameters of
        `VerifiedTube.cells`."""
        heights = _convert_balls(self.heights(piece, exactly(_combine_rows(z, self.basis))))
        return [
            Polynomial(np.array([[height]]), float(error), 0.0, 0.0)
            for height, error in zip(heights.mid, heights.rad, strict=True)
        ]


def _combine_rows(z: Array, basis: Array) -> Array | arb_mat:
    """Return the products of ``z (k, b)`` with ``basis (b, d)``: floats where they need no rounding, else balls."""
    is_exact = (np.count_nonzero(z, axis=1) <= 1).all() and np.isin(z, (-1.0, 0.0, 1.0)).all()
    return np.asarray(z @ basis) if is_exact else exactly(z) * exactly(basis)


def _convert_balls(heights: Sequence[arb]) -> Enclosed:
    """Return balls as floats with radii, ``(k,)`` each."""
    return Enclosed.of(stacked([[height] for height in heights]))[:, 0]
