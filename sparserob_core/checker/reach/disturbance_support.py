"""What the disturbance may add to ``c'x(t)``: its support function as a polynomial with an error, piece by piece of the
disturbance."""

from __future__ import annotations

from bisect import bisect_right
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import TYPE_CHECKING, final

import numpy as np

from sparserob_core.checker.arithmetic.bernstein import bernstein
from sparserob_core.checker.arithmetic.jets import Monomials
from sparserob_core.checker.arithmetic.series import Exponentials, Series
from sparserob_core.checker.reach.flow import ORDER, Flow, expansion, exponentials, stacked
from sparserob_core.checker.reach.lasting import Lasting
from sparserob_core.checker.sets.known import known
from sparserob_core.checker.sets.polynomials import HALF_ULP, OUTWARD, ROUNDING, Enclosed, lengths, rounding
from sparserob_core.checker.sets.shape import Shape
from sparserob_core.control.sets.sets import ConvexSet
from sparserob_core.sip.convex_set import Array

if TYPE_CHECKING:
    from flint import arb, arb_mat

TABLES_KEPT = 8  # parts of pieces whose integrals are remembered
# Pieces from which sums over them are remembered: of a known system, over a box of parameters.
FEWEST_SUMMED = (16, 256)
SAME = 1e-14  # of the horizon: durations closer than this are treated as one ball that holds them all


@final
@dataclass(frozen=True, eq=False)
class Scene:
    """What is simulated: the ``grid`` (all breakpoints), the control ``(m, 1)`` on each of its pieces, the centre of
    ``x(0)`` and the set of deviations from it, and the disturbance: its set and the breakpoints between which it is
    constant, of which some components may be ``lasting`` longer. At the ``switches``, which are breakpoints, another
    system takes over."""

    grid: list[float]
    control: list[arb_mat]
    initial_state: list[float]
    disturbance: ConvexSet | None
    changes: list[float]
    initial_set: ConvexSet | None = None
    switches: tuple[float, ...] = ()
    lasting: Lasting | None = None

    def leg(self, piece: int) -> int:
        """Which system acts on a piece of the grid; the last one at its end."""
        return bisect_right(self.switches, self.grid[piece]) if piece < len(self.grid) - 1 else len(self.switches)

    @cached_property
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
        self.mid = self.rad = np.zeros((0,))

    def add(self, lags: list[int], mid: Array, rad: Array) -> None:
        """More lags, with their arrays along the first axis."""
        used = len(self.places)
        if used + len(lags) > self.mid.shape[0]:
            size = max(16, 2 * used, used + len(lags))
            self.mid, self.rad = (
                np.concatenate([old[:used].reshape(used, *new.shape[1:]), np.zeros((size - used, *new.shape[1:]))])
                for old, new in zip((self.mid, self.rad), (mid, rad), strict=True)
            )
        self.mid[used : used + len(lags)], self.rad[used : used + len(lags)] = mid, rad
        self.places |= {lag: used + i for i, lag in enumerate(lags)}


@final
@dataclass(frozen=True, eq=False)
class Sums:
    """Sums over the last pieces of the disturbance, ``(count, k, ...)``: coefficients of a bound, its errors, what of
    them is due to switching, and what of that to the size of the ``box`` of parameters. Of every piece: the ``point
    (count, k, mw)`` of the set, and by how much the integral since its beginning may be off, ``off`` of that shape."""

    moved: Array
    error: Array
    kinks: Array
    box: Array
    point: Array
    off: Array

    def joined(self, more: Sums) -> Sums:
        """With what more pieces add, one by one."""
        return Sums(
            *(np.concatenate([old, old[-1:] + np.cumsum(new, axis=0)]) for old, new in self._pairs(more)[:4]),
            *(np.concatenate(pair) for pair in self._pairs(more)[4:]),
        )

    def _pairs(self, more: Sums) -> list[tuple[Array, Array]]:
        names = ("moved", "error", "kinks", "box", "point", "off")
        return [(getattr(self, name), getattr(more, name)) for name in names]

    @staticmethod
    def none(shape: tuple[int, ...], k: int, mw: int) -> Sums:
        """Before the first piece: 0."""
        return Sums(np.zeros((1, k, *shape)), *np.zeros((3, 1, k)), *np.zeros((2, 1, k, mw)))


@final
@dataclass(frozen=True, eq=False)
class Operator:
    """Products with power series of ball matrices, as one matrix ``(outputs, M n)`` of floats with an error each."""

    mid: Array
    rad: Array

    @staticmethod
    def of(factors: Sequence[Series], first: int) -> Operator:
        """The product with each of ``factors``, of which rows from ``first`` on are wanted: outputs are ordered by
        factor, monomial and row."""
        monomials, n = factors[0].monomials, factors[0].parts[0].nrows()
        M = monomials.size
        mid = np.zeros((len(factors), M, n - first, M, n))
        rad = np.zeros_like(mid)
        for number, factor in enumerate(factors):
            parts = Enclosed.all(factor.parts, (M, n, n))
            for i, j, k in monomials.products:
                mid[number, k, :, j], rad[number, k, :, j] = parts.mid[i, first:], parts.rad[i, first:]
        return Operator(mid.reshape(-1, M * n), rad.reshape(-1, M * n))

    def applied(self, rows: Enclosed) -> Enclosed:
        """The product with ``rows (M n, k)``."""
        size = np.abs(rows.mid)
        mid = self.mid @ rows.mid
        rad = np.abs(self.mid) @ (rows.rad + rounding(self.mid.shape[1]) * size) + self.rad @ (size + rows.rad)
        return Enclosed(mid, rad * OUTWARD)


@final
@dataclass(eq=False)
class DisturbanceSupports:
    """The functionals ``c'e^{A s}`` and their integrals over one box of parameters, for the rows ``c`` of ``basis (b,
    d)``; remembered by duration. Of systems that take turns, while that of ``leg`` does, and ``before`` it."""

    flow: Flow
    scene: Scene
    basis: Array
    leg: int = 0
    before: DisturbanceSupports | None = None
    _tables: dict[tuple[int, int], Table] = field(default_factory=dict)
    _operators: dict[int, Operator] = field(default_factory=dict)
    _selves: dict[int, Operator] = field(default_factory=dict)
    _onward: dict[int, Operator] = field(default_factory=dict)
    _rows: tuple[list[int], list[Series]] | None = None
    _floats: dict[int, Enclosed] = field(default_factory=dict)
    _latest: tuple[tuple[float, int], Array, Array] | None = None
    _latest_factors: tuple[int, list[Series]] | None = None
    _sums: dict[tuple[int, int, bytes], Sums] = field(default_factory=dict)

    def bounds(self, start: float, ticks: int, z: Array, sharp: bool) -> tuple[Array, Array, Array, Array]:
        """For every direction ``z_i'basis``, ``z (k, b)``: coefficients ``(k, J + 1, M)`` of a bound of the
        disturbance's support from ``start`` on for that many ticks, its error ``(k,)``, how much of that, or of the
        coefficients, is due to switching, and about how much of that would go in smaller boxes of parameters.
        ``sharp``: less of it where the set is round, which takes longer."""
        assert self.scene.disturbance is not None
        shape = known(self.scene.disturbance)
        if not sharp or shape.round is None:
            found = self._of_equal_pieces(shape, start, ticks, z)
            if found is not None:
                return found
        if self._latest is None or self._latest[0] != (start, ticks):
            every = self.every(start, ticks)
            every = every if self.scene.lasting is None else self.scene.lasting.gathered(*every)
            self._latest = ((start, ticks), *every)
        return bounded(shape, self.flow.monomials, *self._latest[1:], z, sharp)

    def begun(self, start: float, ticks: int, z: Array, sharp: bool) -> tuple[Array, Array, Array, Array]:
        """`bounds` of what the worst initial state adds to that of the centre: the support function of the set of
        deviations at the rows themselves."""
        assert self.scene.initial_set is not None
        bound = known(self.scene.initial_set)
        return bounded(bound, self.flow.monomials, *self.initial(start, ticks), z, sharp)

    def initial(self, start: float, ticks: int) -> tuple[Array, Array]:
        """The rows on the deviation of the initial state, ``(1, J + 1, M, d, b)``, with errors of the same shape."""
        row = self._since_start(start, ticks)
        if self.before is None:
            return row.mid[None], row.rad[None]
        return self._composed(row, self._initial_effect)

    @cached_property
    def _initial_effect(self) -> Enclosed:
        """What a deviation made of the state when this leg begins, ``(1, M, d, d)``."""
        assert self.before is not None
        mid, rad = self.before.initial(self._begins, 0)
        return Enclosed(*(np.moveaxis(part[:, 0], 3, 2) for part in (mid, rad)))

    def every(self, start: float, ticks: int) -> tuple[Array, Array]:
        """What every piece of the disturbance adds per unit, ``(pieces, J + 1, M, mw, b)``, with errors of the same
        shape; those before this leg through the state that it begins with."""
        mid, rad = self._weights(start, ticks)
        if self.before is None:
            return mid, rad
        early, lost = self._composed(self._since_start(start, ticks), self.effect)
        if self._jumps[0] not in self.scene.changes:  # that piece goes on
            early, added, lost, more = early.copy(), mid[0], lost.copy(), rad[0]
            lost[-1] += more + rounding(1) * (np.abs(early[-1]) + np.abs(added))
            early[-1] += added
            mid, rad = mid[1:], rad[1:]
        return np.concatenate([early, mid]), np.concatenate([lost, rad])

    @property
    def _begins(self) -> float:
        return (0.0, *self.scene.switches)[self.leg]

    def _since_start(self, start: float, ticks: int) -> Enclosed:
        """The rows as weights on the state with which this leg begins, ``(J + 1, M, d, b)``."""
        node = self.scene.grid[bisect_right(self.scene.grid, start) - 1]
        lag, offset = (round(length / self.scene.tick) for length in (node - self._begins, start - node))
        found = self._row(lag)
        M, size, b = found.mid.shape
        rows = Enclosed(found.mid.reshape(M * size, b), found.rad.reshape(M * size, b))
        if offset:
            rows = self._later(offset).applied(rows)
        moved, d = self._onwards(ticks).applied(rows), len(self.scene.initial_state)
        return Enclosed(*(part.reshape(-1, M, size, b)[:, :, :d] for part in (moved.mid, moved.rad)))

    def _composed(self, row: Enclosed, effect: Enclosed) -> tuple[Array, Array]:
        """Weights ``(P, J + 1, M, w, b)`` on what had the ``effect (P, M, d, w)`` on the state with which this leg
        begins, with errors of the same shape."""
        shape = (effect.mid.shape[0], *row.mid.shape[:2], effect.mid.shape[3], row.mid.shape[3])
        mid, rad = np.zeros(shape), np.zeros(shape)
        terms = rounding(row.mid.shape[2] * len(self.flow.monomials.products))

        def product(left: Array, right: Array) -> Array:
            return np.asarray(np.einsum("jdb,pdw->pjwb", left, right))

        for i, j, k in self.flow.monomials.products:
            here, there = np.abs(row.mid[:, i]), np.abs(effect.mid[:, j])
            mid[:, :, k] += product(row.mid[:, i], effect.mid[:, j])
            rad[:, :, k] += product(here, effect.rad[:, j] + terms * there)
            rad[:, :, k] += product(row.rad[:, i], there + effect.rad[:, j])
        return mid, rad * OUTWARD

    @cached_property
    def effect(self) -> Enclosed:
        """What every piece of the disturbance made of the state when this leg begins, ``(pieces, M, d, mw)``."""
        assert self.before is not None
        mid, rad = self.before.every(self._begins, 0)
        return Enclosed(*(np.moveaxis(part[:, 0], 3, 2) for part in (mid, rad)))

    def _weights(self, start: float, ticks: int) -> tuple[Array, Array]:
        """What every piece of the disturbance before the cell adds per unit, ``(pieces, J + 1, M, mw, b)``, with errors
        of the same shape."""
        node = self.scene.grid[bisect_right(self.scene.grid, start) - 1]
        jumps = self._jumps[: np.searchsorted(self._jumps, start, side="right")]
        lags = np.rint((node - jumps) / self.scene.tick).astype(int).tolist()
        offset = round((start - node) / self.scene.tick)
        table = self._table(offset, ticks)
        # short ones first: each row starts from the one before
        missing = [lag for lag in dict.fromkeys(reversed(lags)) if lag not in table.places]
        if missing:
            table.add(missing, *self._integrals(missing, offset, ticks))
        places = [table.places[lag] for lag in lags]
        mid, rad = table.mid[places], table.rad[places]
        rad[:-1] += rad[1:] + rounding(1) * (np.abs(mid[:-1]) + np.abs(mid[1:]))
        mid[:-1] -= mid[1:]
        return mid, rad

    def _table(self, offset: int, ticks: int) -> Table:
        if (offset, ticks) not in self._tables:
            if len(self._tables) >= TABLES_KEPT:
                self._tables.popitem()  # the latest: the first is that of whole pieces
            self._tables[offset, ticks] = Table()
        return self._tables[offset, ticks]

    def _of_equal_pieces(
        self, shape: Shape, start: float, ticks: int, z: Array
    ) -> tuple[Array, Array, Array, Array] | None:
        """`bounds` where what a piece adds depends on its age alone, since they are equally long: a sum over the ages,
        which is remembered; ``None`` where they are not, or are few."""
        grid, count = self.scene.grid, int(np.searchsorted(self._jumps, start, side="right"))
        if count < FEWEST_SUMMED[bool(self.flow.centre)] or self.scene.switches or self.scene.lasting is not None:
            return None
        # no piece begins at the end, which is looked at from the beginning of the last one
        node = float(self._jumps[-1]) if start == grid[-1] else grid[bisect_right(grid, start) - 1]
        ages = self._ages[:count]
        # an age may be off by a tick, and its offset by half of one: two are allowed for (`_factors`)
        late = abs(node - float(self._jumps[count - 1])) / self.scene.tick
        if late + self._uneven > 1.0 and not (
            np.abs((node - self._jumps[count - 1 :: -1]) / self.scene.tick - ages).max() <= 1.0
        ):
            return None
        offset = round((start - node) / self.scene.tick)
        key = (offset, ticks, z.tobytes())
        sums = self._sums.get(key)
        if sums is None or len(sums.error) <= count:
            if sums is None and len(self._sums) >= TABLES_KEPT:
                self._sums.popitem()
            sums = self._sums[key] = self._by_age(shape, sums, count, offset, ticks, z)
        outward = 1.0 + rounding(count)  # sums of so many numbers that are not negative
        ends = (sums.off[count] * np.abs(sums.point[count])).sum(axis=1)
        return sums.moved[count], (sums.error[count] + ends) * outward, sums.kinks[count] * outward, sums.box[count]

    def _by_age(self, shape: Shape, sums: Sums | None, count: int, offset: int, ticks: int, z: Array) -> Sums:
        """The sums over at least ``count`` pieces, in the order of their ages.

        With a point ``w_i`` of the set for every piece, and the integrals ``I_i`` since it began, the bound is the sum
        of ``w_i (I_i - I_{i-1})``, which is that of ``I_i (w_i - w_{i+1})``: what an integral is off by counts only
        where the point changes, and at the oldest piece.
        """
        done = 0 if sums is None else len(sums.error) - 1
        until = min(self._ages.size, max(count, 2 * done))
        ages, table = self._ages[max(done - 1, 0) : until].tolist(), self._table(offset, ticks)
        missing = [age for age in ages if age not in table.places]
        if missing:
            table.add(missing, *self._integrals(missing, offset, ticks))
        places = [table.places[age] for age in ages]
        every, errors = table.mid[places], table.rad[places]
        first, change, rad = int(done > 0), every.copy(), errors.copy()
        change[1:] -= every[:-1]
        rad[1:] += errors[:-1] + rounding(1) * np.abs(change[1:])
        change, rad = change[first:], rad[first:]
        mid, w, _, _, kinks, share = _linear(shape, change, rad, z, self._ages.size)
        size, terms = np.abs(z), rounding(self._ages.size * mid.shape[-1])
        rounded = np.einsum("ljkwb,ib->liw", np.abs(change), size) * (rounding(1) + rounding(z.shape[1]))
        rounded += terms * np.swapaxes(np.abs(mid).sum(axis=(2, 3)), 0, 1)
        point, off = np.swapaxes(w, 0, 1), np.einsum("ljkwb,ib->liw", errors[first:], size) * OUTWARD
        if sums is None:
            sums = Sums.none(mid.shape[2:4], len(z), mid.shape[-1])
        turned = np.concatenate([sums.off[-1:], off[:-1]]) * np.abs(
            np.concatenate([sums.point[-1:], point[:-1]]) - point
        )
        lost = (np.abs(point) * rounded + turned).sum(axis=2) * OUTWARD + kinks.T
        return sums.joined(Sums(np.einsum("ilw,iljkw->lijk", w, mid), lost, kinks.T, (share * kinks).T, point, off))

    @cached_property
    def _ages(self) -> Array:
        """How long before the latest jump every piece began, in ticks, first the latest."""
        return np.asarray(np.rint((self._jumps[-1] - self._jumps[::-1]) / self.scene.tick).astype(int))

    @cached_property
    def _uneven(self) -> float:
        """How far the time since a piece began may be from its age, in ticks, wherever one looks from: four times what
        the beginnings are off equal distances by (twice for the time, twice for the age), an age's own rounding, and
        that of these numbers."""
        even = np.linspace(self._jumps[0], self._jumps[-1], self._jumps.size)
        return float(4.0 * np.abs(self._jumps - even).max() / self.scene.tick) + 0.5 + 16.0 * HALF_ULP / SAME

    @cached_property
    def _jumps(self) -> Array:
        switches, changes = self.scene.switches, self.scene.changes
        if not switches:
            return np.array(changes)
        begin, end = (0.0, *switches)[self.leg], (*switches, np.inf)[self.leg]
        return np.array([begin, *(s for s in changes if begin < s < end)])

    def _integrals(self, lags: list[int], offset: int, ticks: int) -> tuple[Array, Array]:
        """``int_0^s c'e^{A r} E dr`` for ``s`` from each of the ``lags (l,)`` plus ``offset`` on: ``(l, J + 1, M, mw,
        b)`` with errors of the same shape: products of float matrices, for all of them together."""
        M, d, b = self.flow.monomials.size, len(self.scene.initial_state), self.basis.shape[0]
        found = [self._row(lag) for lag in lags]
        size = found[0].mid.shape[1]
        rows = Enclosed(
            *(
                np.moveaxis(np.array(numbers), 0, 2).reshape(M * size, -1)
                for numbers in ([one.mid for one in found], [one.rad for one in found])
            )
        )
        if offset:
            rows = self._later(offset).applied(rows)
        weights, outputs = self._operator(ticks).applied(rows), (-1, M, size - d, len(lags), b)
        return np.moveaxis(weights.mid.reshape(outputs), 3, 0), np.moveaxis(weights.rad.reshape(outputs), 3, 0)

    def _later(self, ticks: int) -> Operator:
        """From a row to that after so many ticks."""
        if ticks not in self._onward:
            self._onward[ticks] = Operator.of([self._exponentials.at(ticks)], 0)
        return self._onward[ticks]

    def _operator(self, ticks: int) -> Operator:
        """From a row to the coefficients of its integral within that many ticks."""
        if ticks not in self._operators:
            self._operators[ticks] = Operator.of(self._factors(ticks), len(self.scene.initial_state))
        return self._operators[ticks]

    def _onwards(self, ticks: int) -> Operator:
        """From a row to its own coefficients within that many ticks, with those of its integral below."""
        if ticks not in self._selves:
            self._selves[ticks] = Operator.of(self._factors(ticks), 0)
        return self._selves[ticks]

    def _factors(self, ticks: int) -> list[Series]:
        """What makes the coefficients in time of a row within that many ticks; whatever a row does in two ticks to
        either side is included, since lags are rounded to ticks twice."""
        if self._latest_factors is not None and self._latest_factors[0] == ticks:
            return self._latest_factors[1]
        length, (start, *derivatives) = self.scene.duration(ticks), self._derivatives
        found = [start]
        if ticks:
            found += expansion(derivatives, length, self._exponentials.within(length))
        self._latest_factors = ticks, found
        return found

    @cached_property
    def _exponentials(self) -> Exponentials:
        """What becomes of rows."""
        return exponentials(self.flow.rows, self.scene.tick, self.scene.grid[-1])

    @cached_property
    def _derivatives(self) -> list[Series]:
        """What makes a row, and its derivatives in time, of those within two ticks to either side."""
        widened = self._exponentials.around(2)
        return [self._exponentials.power(order) * widened for order in range(ORDER + 1)]

    def _row(self, ticks: int) -> Enclosed:
        """The rows after that many ticks, as columns: ``(M, n, b)``."""
        if ticks not in self._floats:
            row = self._balls(ticks)
            shape = (len(row.parts), row.parts[0].nrows(), row.parts[0].ncols())
            self._floats[ticks] = Enclosed.all(row.parts, shape)
        return self._floats[ticks]

    def _balls(self, ticks: int) -> Series:
        """`_row` in balls, from the longest rows before it that are known."""
        if self._rows is None:
            self._rows = ([0], [self._first_rows()])
        known = self._rows
        place = bisect_right(known[0], ticks)
        before = known[0][place - 1]
        if before == ticks:
            return known[1][place - 1]
        row = self._exponentials.at(ticks - before) * known[1][place - 1]
        known[0].insert(place, ticks)
        known[1].insert(place, row)
        return row

    def _first_rows(self) -> Series:
        from flint import arb

        size, d = self.flow.rows.parts[0].nrows(), self.basis.shape[1]
        columns = [[arb(float(c[i])) if i < d else arb(0) for c in self.basis] for i in range(size)]
        return Series.constant(self.flow.monomials, stacked(columns))


def bounded(
    shape: Shape, monomials: Monomials, every: Array, errors: Array, z: Array, sharp: bool
) -> tuple[Array, Array, Array, Array]:
    """Bounds of the sum of a set's support functions at weights ``(pieces, J + 1, M, mw, b)`` that are off by at
    most ``errors``, for combinations ``z (k, b)`` of them: as in `DisturbanceSupports.bounds`."""
    pieces = every.shape[0]
    mid, w, lost, error, kinks, share = _linear(shape, every, errors, z, pieces)
    k, mw = mid.shape[0], mid.shape[-1]
    if not sharp or shape.round is None:
        moved = np.einsum("ilw,iljkw->ijk", w, mid)
        return moved, error.sum(axis=1) * OUTWARD, kinks.sum(axis=1) * OUTWARD, (share * kinks).sum(axis=1)
    # of every piece the better of this linear bound and of a polynomial above the length of L'f
    m, L = shape.round
    parts = (mid @ L).reshape(-1, *mid.shape[2:4], L.shape[1])
    above, off, over = (part.reshape(k, pieces, *part.shape[1:]) for part in lengths(monomials, parts))
    spare = (lost + rounding(mw) * np.abs(mid).sum(axis=(2, 3))) @ np.abs(L)
    off = off + np.linalg.norm(spare, axis=2) + lost @ np.abs(m)
    off = (off + rounding(pieces) * np.abs(above).sum(axis=(2, 3))) * OUTWARD
    better = off < error
    linear = np.einsum("ilw,iljkw->iljk", w, mid)
    moved = np.where(better[:, :, None, None], above + mid @ m, linear).sum(axis=1)
    error, kinks = np.where(better, off, error), np.where(better, over, kinks)
    return moved, error.sum(axis=1) * OUTWARD, kinks.sum(axis=1) * OUTWARD, (share * kinks).sum(axis=1)


def _linear(
    shape: Shape, every: Array, errors: Array, z: Array, count: int
) -> tuple[Array, Array, Array, Array, Array, Array]:
    """The weights ``(k, pieces, J + 1, M, mw)`` for combinations ``z (k, b)``, the points ``(k, pieces, mw)`` of the
    set that are best at them or nearly, what is lost of the weights, ``(k, pieces, mw)``, where up to ``count``
    pieces are added up, and by how much the points' products may be too small, ``(k, pieces)``; with what of that is
    due to switching, and about what share of this to the size of the box of parameters."""
    mid = np.einsum("ljkwb,ib->iljkw", every, z)
    rad = np.einsum("ljkwb,ib->iljkw", errors + rounding(z.shape[1]) * np.abs(every), np.abs(z)) * OUTWARD
    k, pieces, mw = mid.shape[0], mid.shape[1], mid.shape[-1]
    value, spread, of_box = _ranges(mid, rad)
    w, excess = shape.bound(value.reshape(-1, mw), spread.reshape(-1, mw))
    w, kinks = w.reshape(k, pieces, mw), excess.reshape(k, pieces) * OUTWARD
    lost = rad.sum(axis=(2, 3)) + rounding(count * mw) * np.abs(mid).sum(axis=(2, 3))
    radius = np.array(shape.radius)
    far, wide = spread @ radius, of_box @ radius
    share = np.divide(wide, far, out=np.zeros_like(far), where=far > 0.0)
    return mid, w, lost, np.einsum("ilw,ilw->il", np.abs(w), lost) * OUTWARD + kinks, kinks, share


def _ranges(mid: Array, rad: Array) -> tuple[Array, Array, Array]:
    """The ranges that weights ``(k, pieces, J + 1, M, mw)`` stay in on the cell: middles and half-widths, ``(k, pieces,
    mw)``, and what parameters have to do with these."""
    k, pieces, orders, _, mw = mid.shape
    ends = bernstein(np.moveaxis(mid[:, :, :, 0], 2, 3).reshape(-1, orders), [False]).reshape(k, pieces, mw, -1)
    highest, lowest = ends.max(axis=3), ends.min(axis=3)
    of_box = np.abs(mid[:, :, :, 1:]).sum(axis=(2, 3))
    spread = (highest - lowest) / 2 + of_box + rad.sum(axis=(2, 3)) + ROUNDING * np.abs(mid[:, :, :, 0]).sum(axis=2)
    return (highest + lowest) / 2, spread * OUTWARD, of_box
