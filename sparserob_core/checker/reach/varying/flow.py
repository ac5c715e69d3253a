"""The flow of a known system that changes with time, in balls: its own power series over every piece of a grid, and
their products by a tree, in which balls grow with the logarithm of the number of pieces only."""

from __future__ import annotations

from bisect import bisect_right
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from itertools import pairwise
from math import ceil
from typing import TYPE_CHECKING, TypeVar, final

import numpy as np

from sparserob_core.checker.arithmetic.series import upper
from sparserob_core.checker.arithmetic.timed import Timed
from sparserob_core.checker.outcome import Unchecked
from sparserob_core.checker.reach.flow import balanced, stacked
from sparserob_core.sip.convex_set import Array

if TYPE_CHECKING:
    from flint import arb, arb_mat, arb_poly

    from sparserob_core.control.problem.system import LinearSystem, VaryingSystem

Part = TypeVar("Part")

ORDER = 24  # of the system in time on a segment; with a tenth of it segments are a million times shorter
TERMS = (16, 24, 32, 48, 64)  # of the solution over a part of a segment: the fewest that are sharp, else the last
SHARP = 2.0**-100  # of the system's numbers, what is left out on a segment; 2^-10 would show in what states miss
ENOUGH = 2.0**-64  # the same of a kernel, which goes on as numbers of 53 bits; 2^-54 would show, 2^-74 takes more terms
SHORTER = 0.5  # of `LONG`, to which a slow part is brought: ten times less doubles digits lost, 1 takes more terms
LONG = 2.0  # norm of the system times the length of a segment; ten times more takes more terms than there are
FIRST = 8  # segments to begin with
SHORTEST = 2.0**-30  # of the horizon: a shorter segment holds a pole
CIRCLES = (1.5, 2.0, 3.0, 4.0, 6.0, 8.0, 12.0, 24.0, 48.0, 96.0)
"""Shares of an interval on which Cauchy's bound is looked at; short intervals need the wide ones."""


@final
@dataclass(frozen=True, eq=False)
class Segment:
    """``[A B E]`` from ``start`` to ``stop``: a table of polynomials in the time since ``centre``, and balls ``left``
    that hold what stands before the next power of it. ``units``: of the states, in which it is small there."""

    start: float
    stop: float
    centre: float
    law: list[list[arb_poly]]
    left: list[list[arb]]
    units: list[float]


@final
@dataclass(frozen=True, eq=False)
class Weights:
    """What a state at a time is made of: ``free`` times the state at 0, and ``control`` and ``disturbance`` times the
    inputs on every piece of a grid."""

    free: arb_mat
    control: list[arb_mat]
    disturbance: list[arb_mat]


def segmented(
    system: VaryingSystem, horizon: float, made: Callable[[float, float, LinearSystem], Part | None]
) -> list[Part]:
    """What is ``made`` of a system between two times by their law, on parts of the horizon one after another, each
    halved where it is too long; raises `Unchecked` where the system is not finite."""
    found, cuts = list[Part](), [*(begin for begin, _, _ in system.laws), horizon]
    todo = [
        (start, stop, law)
        for (begin, until), (_, _, law) in zip(pairwise(cuts), system.laws, strict=True)
        for start, stop in pairwise(np.linspace(begin, until, ceil(FIRST * (until - begin) / horizon) + 1).tolist())
    ][::-1]
    while todo:
        start, stop, law = todo.pop()
        part = made(start, stop, law)
        if part is not None:
            found.append(part)
            continue
        if stop - start <= SHORTEST * horizon:
            raise Unchecked(f"near t = {start:.9g} the system is not enclosed")
        middle = (start + stop) / 2
        todo += [(middle, stop, law), (start, middle, law)]
    return found


@final
@dataclass(eq=False)
class VaryingFlow:
    """The system ``x' = A(t) x + B(t) u + E(t) w`` from 0 to ``until``; a drift is one more column of ``B``, whose
    input is always 1."""

    system: VaryingSystem
    until: float
    _known: dict[tuple[float, float], tuple[arb_mat, arb_mat, arb_mat]] = field(default_factory=dict)
    _whole: dict[int, tuple[arb_mat, arb_mat]] = field(default_factory=dict)
    _weights: dict[tuple[float, ...], Weights] = field(default_factory=dict)
    _most: dict[float, tuple[Array, Array]] = field(default_factory=dict)

    def at(self, parameter: Sequence[float]) -> VaryingFlow:
        """The flow at one parameter, of which there is none."""
        return self

    @cached_property
    def segments(self) -> list[Segment]:
        """The system on parts of the horizon, one after another; raises `Unchecked` where it is not finite."""
        return segmented(self.system, self.until, self._segment)

    def _segment(self, start: float, stop: float, system: LinearSystem) -> Segment | None:
        """The system from ``start`` to ``stop``; ``None`` where that is too long."""
        from flint import arb, arb_poly

        centre = (start + stop) / 2
        half = upper(abs(arb(stop) - arb(centre)).max(abs(arb(start) - arb(centre))))
        try:
            exact = self._table(system, arb(centre), ORDER + 1)
            wide = self._table(system, arb(start).union(arb(stop)), ORDER + 2)
        except Unchecked:
            return None
        d, u = self.system.states, self.units
        lost, size, most = arb(0), arb(0), list[list[arb]]()
        for i, row in enumerate(exact):
            sums, over = arb(0), arb(0)
            most.append([])
            for j, entry in enumerate(row):
                far = sum((upper(abs(one)) * half**k for k, one in enumerate(entry)), arb(0))
                rest = upper(abs(wide[i][j][ORDER + 1])) * half ** (ORDER + 1)
                if j < d:
                    most[i].append(far * u[j] / u[i])
                    sums, over = sums + most[i][j], over + rest * u[j] / u[i]
                elif not rest <= arb(SHARP) * self._inputs[j - d]:
                    return None
            size, lost = size.max(sums), lost.max(over)
        ratios = [1.0] * d if size * (arb(stop) - arb(start)) <= LONG else self._slow(most, start, stop)
        if ratios is None or not lost * max(ratios) <= arb(SHARP) * size.max(arb(self._pace)):
            return None
        law = [[arb_poly(entry) for entry in row] for row in exact]
        left = [[entry[ORDER + 1] for entry in row] for row in wide]
        return Segment(start, stop, centre, law, left, [one * ratio for one, ratio in zip(u, ratios, strict=True)])

    @staticmethod
    def _slow(most: list[list[arb]], start: float, stop: float) -> list[float] | None:
        """Ratios of units of the states, in which a system of at most ``most (d, d)`` is small enough on a segment, to
        those in which it is not: with ``g`` a share of `LONG`, ``u = (1 - M / g)^-1 1`` has ``M u <= g u``; ``None``
        where there are none. Any would be right."""
        from flint import arb

        M = np.array([[float(entry.upper()) for entry in row] for row in most]) * ((stop - start) / (SHORTER * LONG))
        u = np.linalg.lstsq(np.eye(len(M)) - M, np.ones(len(M)), rcond=None)[0]
        if not (np.isfinite(u).all() and u.min() > 0.0):
            return None
        ratios, h = [arb(float(one)) for one in np.maximum(u, 1.0)], arb(stop) - arb(start)
        rows = [sum((entry * one for entry, one in zip(row, ratios, strict=True)), arb(0)) * h for row in most]
        small = all(row <= LONG * ratio for row, ratio in zip(rows, ratios, strict=True))
        return [float(one.mid()) for one in ratios] if small else None

    @staticmethod
    def _table(law: LinearSystem, centre: arb, length: int) -> list[list[list[arb]]]:
        """The first coefficients of every entry of ``[A B E]`` of a law at all times of a ball."""
        from flint import arb, ctx

        before, ctx.cap = ctx.cap, length
        try:
            time = np.empty(1, dtype=object)
            time[0] = Timed.time(centre, length)
            parts = [law.A, law.B, *([] if law.c is None else [law.c]), law.E]
            values = np.hstack([np.asarray(part(time) if callable(part) else part, dtype=object) for part in parts])
            return [
                [
                    one.coefficients(length) if isinstance(one, Timed) else [arb(float(one))] + [arb(0)] * (length - 1)
                    for one in row
                ]
                for row in values
            ]
        finally:
            ctx.cap = before

    @cached_property
    def _middles(self) -> Array:
        """The largest absolute values of the entries of ``A`` at some times; any would do."""
        return np.asarray(np.max([np.abs(np.asarray(one.A, dtype=float)) for one in self.system.modes], axis=0))

    @cached_property
    def units(self) -> list[float]:
        """Units of the states, powers of two, in which the system is small; any would be right."""
        A = self._middles
        units = balanced(A, self.system.horizon, np.ones(A.shape[0]) / self.system.horizon)
        return [float(one) for one in units]

    @cached_property
    def _pace(self) -> float:
        u = np.array(self.units)
        return float((self._middles * u / u[:, None]).sum(axis=1).max())

    @cached_property
    def _inputs(self) -> list[float]:
        """The largest entry of every column of ``[B E]`` at some times; 1 where that is 0."""
        every = [one.forced.matrices(np.zeros((1, 0)))[1:] for one in self.system.modes]
        tables = [np.hstack([part[0] for part in parts]) for parts in every]
        found = np.abs(tables).max(axis=(0, 1))
        return [float(one) if one > 0.0 else 1.0 for one in found]

    def over(self, start: float, stop: float) -> tuple[arb_mat, arb_mat, arb_mat]:
        """What an interval makes of a state, of a control that stays the same, and of such a disturbance; raises
        `Unchecked` beyond what is expanded."""
        if not 0.0 <= start <= stop <= self.until:
            raise Unchecked(f"the system is not known from {start:g} to {stop:g}")
        if (start, stop) not in self._known:
            m = self.system.controls + (self.system.c is not None)
            begins = [one.start for one in self.segments]
            first = max(0, bisect_right(begins, start) - 1)
            last = max(first, bisect_right(begins, np.nextafter(stop, -np.inf)) - 1)
            times = [start, *begins[first + 1 : last + 1], stop]
            whole = None
            for number, (one, other) in enumerate(pairwise(times), first):
                part = self._on(number, one, other)
                whole = part if whole is None else (part[0] * whole[0], part[0] * whole[1] + part[1])
            assert whole is not None
            table = whole[1].tolist()
            self._known[start, stop] = (
                whole[0],
                stacked([row[:m] for row in table]),
                stacked([row[m:] for row in table]),
            )
        return self._known[start, stop]

    def _on(self, number: int, start: float, stop: float) -> tuple[arb_mat, arb_mat]:
        """`_within` of a part of a segment; of the whole of it remembered, since many intervals go across it."""
        segment = self.segments[number]
        if (start, stop) != (segment.start, segment.stop):
            return self._within(segment, start, stop)
        if number not in self._whole:
            self._whole[number] = self._within(segment, start, stop)
        return self._whole[number]

    def _within(self, segment: Segment, start: float, stop: float) -> tuple[arb_mat, arb_mat]:
        """``Y(1)`` of ``Y' = h A Y + [0, h B, h E]`` in the share of the interval, ``Y(0) = [I, 0, 0]``."""
        terms, rest = self._series(segment, start, stop)
        total = terms[0]
        for term in terms[1:]:
            total = total + term
        table = (total + rest).tolist()
        d = self.system.states
        return stacked([row[:d] for row in table]), stacked([row[d:] for row in table])

    def within(self, start: float, stop: float, order: int) -> tuple[list[arb_mat], arb_mat]:
        """What an interval within one segment makes of states and of inputs that stay the same, ``(d, d + m + mw)``:
        coefficients of powers of the share of the interval, up to ``order``, and balls that hold the rest."""
        terms, rest = self._series(self._segment_of(start, stop), start, stop)
        for term in terms[order + 1 :]:
            rest = rest + stacked([[_wider(zero, abs(x)) for zero, x in zip(*pair, strict=True)] for pair in
                                   zip((term * 0).tolist(), term.tolist(), strict=True)])  # fmt: skip
        return terms[: order + 1], rest

    def kernel(self, start: float, stop: float) -> list[arb_mat]:
        """What inputs at any time ``s`` on an interval within one segment make of the state at its end: ``h Phi(stop,
        s) [B E](s)`` as coefficients ``(d, m + mw)`` of powers of the share ``r`` of the interval that is left at
        ``s``; the first one holds what all of them leave out.

        ``Psi(r) = Phi(stop, stop - r h)`` has ``Psi' = h Psi A``: its norms are at most the coefficients of the
        solution of ``y' = a(r) y``, and those of the kernel at most those of ``y(r) b(r)``.
        """
        from flint import arb, arb_poly

        segment = self._segment_of(start, stop)
        d, h, u = self.system.states, arb(stop) - arb(start), [arb(one) for one in segment.units]
        shifted = arb_poly([arb(stop) - arb(segment.centre), -h])
        table = [[(entry(shifted) * h).coeffs() for entry in row] for row in segment.law]
        order = max(1, *(len(entry) for row in table for entry in row))
        rows = [[[entry[k] if k < len(entry) else arb(0) for entry in row] for row in table] for k in range(order)]
        A, F = ([stacked([row[part] for row in one]) for one in rows] for part in (slice(d), slice(d, None)))
        tails, rest = _Tails(self._norms(table, segment)), self._rest(segment, h)
        columns = range(F[0].ncols())
        forced = [[_largest([upper(abs(F[k][i, j])) / u[i] for i in range(d)]) for k in range(order)] for j in columns]
        every = [_largest([one[k] for one in forced]) for k in range(order)] if forced else [arb(0)]
        wanted = arb(ENOUGH) * max(arb(1e-300), *every)
        beyond = tails.times(every)
        count = next((one for one in (8, *TERMS) if beyond(one) <= wanted), TERMS[-1])
        back, found = [stacked([[arb(int(i == j)) for j in range(d)] for i in range(d)])], []
        for n in range(count):
            kernel, nexts = back[n] * F[0], back[n] * A[0]
            for k in range(1, min(n + 1, order)):
                kernel, nexts = kernel + back[n - k] * F[k], nexts + back[n - k] * A[k]
            found.append(kernel)
            back.append(nexts / (n + 1))
        r = _largest([sum((one * u[j] / u[i] for j, one in enumerate(row[:d])), arb(0)) for i, row in enumerate(rest)])
        a = sum(tails.sizes, arb(0))
        first = found[0].tolist()
        for j in columns:
            missing = _largest([row[d + j] / u[i] for i, row in enumerate(rest)])
            spread = (a + r).exp() * (r * (sum(forced[j], arb(0)) + missing) + missing)
            error = tails.times(forced[j])(count) + spread
            for i in range(d):
                first[i][j] = _wider(first[i][j], error * u[i])
        return [stacked(first), *found[1:]]

    def most(self, start: float, stop: float) -> tuple[Array, Array]:
        """The largest absolute values of ``[A B E]`` and of its derivative on the segment that an interval is in,
        ``(d, d + m + mw)`` each."""
        segment = self._segment_of(start, stop)
        if segment.start not in self._most:
            far = upper(self._far(segment))
            tables = []
            for order in (0, 1):
                rows = []
                for row, left in zip(segment.law, segment.left, strict=True):
                    entries = []
                    for entry, rest in zip(row, left, strict=True):
                        coefficients = [upper(abs(one)) for one in entry.coeffs()]
                        coefficients += [far * 0] * (ORDER + 1 - len(coefficients)) + [upper(abs(rest))]
                        powers = enumerate(coefficients[order:])
                        entries.append(sum((one * (n + 1) ** order * far**n for n, one in powers), far * 0))
                    rows.append(entries)
                tables.append(np.array([[float(one.upper()) for one in row] for row in rows]))
            self._most[segment.start] = tables[0], tables[1]
        return self._most[segment.start]

    def units_on(self, start: float, stop: float) -> list[float]:
        """Units of the states in which the system is small on the segment that an interval is in."""
        return self._segment_of(start, stop).units

    def _segment_of(self, start: float, stop: float) -> Segment:
        if not 0.0 <= start <= stop <= self.until:
            raise Unchecked(f"the system is not known from {start:g} to {stop:g}")
        begins = [one.start for one in self.segments]
        segment = self.segments[max(0, bisect_right(begins, start) - 1)]
        if stop > segment.stop:
            raise Unchecked(f"the system is no polynomial from {start!r} to {stop!r}")
        return segment

    @cached_property
    def ends(self) -> list[float]:
        """Where the segments end."""
        return [one.stop for one in self.segments]

    @cached_property
    def links(self) -> dict[str, list[arb_mat]]:
        """Which entries of ``A``, ``B`` and ``E`` are other than 0 at any time: 1 for those."""
        d, m = self.system.states, self.system.controls + (self.system.c is not None)
        table = [
            [int(any(not entry.is_zero() for entry in found)) for found in zip(*rows, strict=True)]
            for rows in zip(*self._tables, strict=True)
        ]
        from flint import arb

        parts = {"A": slice(0, d), "B": slice(d, d + m), "E": slice(d + m, None)}
        return {name: [stacked([[arb(x) for x in row[part]] for row in table])] for name, part in parts.items()}

    @property
    def _tables(self) -> list[list[list[arb]]]:
        """What the entries of ``[A B E]`` are at most, segment by segment."""
        from flint import arb

        return [
            [
                [sum(map(abs, entry.coeffs()), arb(0)) + abs(left) for entry, left in zip(*rows, strict=True)]
                for rows in zip(one.law, one.left, strict=True)
            ]
            for one in self.segments
        ]

    def _series(self, segment: Segment, start: float, stop: float) -> tuple[list[arb_mat], arb_mat]:
        """The terms of the solution of ``Y' = h A Y + [0, h B, h E]``, ``Y(0) = [I, 0, 0]``, in powers of the share of
        the interval, and balls around 0 that hold the rest."""
        from flint import arb, arb_mat, arb_poly

        d, h = self.system.states, arb(stop) - arb(start)
        shifted = arb_poly([arb(start) - arb(segment.centre), h])
        table = [[(entry(shifted) * h).coeffs() for entry in row] for row in segment.law]
        order = max(1, *(len(entry) for row in table for entry in row))  # none in no time, or where all is 0
        columns, none = len(table[0]), arb(0)
        A, driven = [], []
        for k in range(order):
            rows = [[entry[k] if k < len(entry) else none for entry in row] for row in table]
            A.append(arb_mat([row[:d] for row in rows]))
            driven.append(arb_mat([[none] * d + row[d:] for row in rows]))
        first = [[arb(int(i == j)) for j in range(columns)] for i in range(d)]
        terms = [arb_mat(first)]
        tails = _Tails(self._norms(table, segment))
        count = next((one for one in TERMS if tails.of(one, None) <= arb(SHARP)), TERMS[-1])
        for n in range(count):
            nexts = A[0] * terms[n]
            for k in range(1, min(n + 1, order)):
                nexts = nexts + A[k] * terms[n - k]
            if n < order:
                nexts = nexts + driven[n]
            terms.append(nexts / (n + 1))
        return terms, self._left_out([[none] * columns for _ in range(d)], segment, table, h, tails, count)

    def _norms(self, table: list[list[list[arb]]], segment: Segment) -> list[arb]:
        """The norms of largest row sums, in the units of a segment, of the coefficients of ``A``."""
        from flint import arb

        d, u = self.system.states, [arb(one) for one in segment.units]
        found = []
        for k in range(max(len(entry) for row in table for entry in row)):
            sums = [
                sum((upper(abs(row[j][k])) * u[j] / u[i] for j in range(d) if k < len(row[j])), arb(0))
                for i, row in enumerate(table)
            ]
            found.append(upper(_largest(sums)))
        return found

    def _left_out(
        self,
        total: list[list[arb]],
        segment: Segment,
        table: list[list[list[arb]]],
        h: arb,
        tails: _Tails,
        count: int,
    ) -> arb_mat:
        """The sum of a series with what it leaves out: its tail by Cauchy's bound on circles, for the coefficients are
        at most those of ``y' = a(s) y + b(s)`` with the norms ``a_k`` and ``b_k``; and what stands before the next
        power of the time, by the formula of variation of constants."""
        from flint import arb

        d, u = self.system.states, [arb(one) for one in segment.units]
        sizes, rest = tails.sizes, self._rest(segment, h)
        r = _largest([sum((one * u[j] / u[i] for j, one in enumerate(row[:d])), arb(0)) for i, row in enumerate(rest)])
        a = sum(sizes, arb(0))
        spread = (a + r).exp() * a.exp()

        state = tails.of(count, None) + r * spread
        columns = [[_wider(total[i][j], state * u[i] / u[j]) for i in range(d)] for j in range(d)]
        for j in range(d, len(table[0])):
            forced = [
                _largest([upper(abs(row[j][k])) / u[i] if k < len(row[j]) else arb(0) for i, row in enumerate(table)])
                for k in range(len(sizes))
            ]
            missing = _largest([row[j] / u[i] for i, row in enumerate(rest)])
            error = tails.of(count, forced) + spread * (r * sum(forced, arb(0)) + missing)
            columns.append([_wider(total[i][j], error * u[i]) for i in range(d)])
        return stacked([list(row) for row in zip(*columns, strict=True)])

    @staticmethod
    def _far(segment: Segment) -> arb:
        from flint import arb

        return abs(arb(segment.stop) - arb(segment.centre)).max(abs(arb(segment.start) - arb(segment.centre)))

    def _rest(self, segment: Segment, h: arb) -> list[list[arb]]:
        """What stands before the next power of the time on a segment, times ``h``, at most."""
        far = upper(self._far(segment))
        return [[upper(abs(one)) * far ** (ORDER + 1) * upper(abs(h)) for one in row] for row in segment.left]

    def weights(self, grid: Sequence[float]) -> Weights:
        """What the state at the end of a grid, which begins at 0, is made of."""
        key = tuple(grid)
        if key not in self._weights:
            parts = [self.over(*ends) for ends in pairwise(grid)]
            after = products([part[0] for part in parts])
            control = [Z * part[1] for Z, part in zip(after[1:], parts, strict=True)]
            disturbance = [Z * part[2] for Z, part in zip(after[1:], parts, strict=True)]
            self._weights[key] = Weights(after[0], control, disturbance)
        return self._weights[key]


@final
class _Tails:
    """What the solution of ``y' = a(s) y + b(s)`` at 1 has beyond some terms, ``sizes`` the coefficients of ``a``, from
    ``y(0) = 1`` without ``b``, and from 0 with it."""

    def __init__(self, sizes: list[arb]) -> None:
        from flint import arb

        self.sizes = sizes
        self._grown = [
            (R, sum((size * R ** (k + 1) / (k + 1) for k, size in enumerate(sizes)), arb(0)).exp())
            for R in map(arb, CIRCLES)
        ]

    def of(self, count: int, forced: list[arb] | None) -> arb:
        """Beyond ``count`` terms; ``forced``: the coefficients of ``b``."""
        from flint import arb

        found = []
        for R, y in self._grown:
            driven = arb(1)
            if forced is not None:
                driven = sum((size * R ** (k + 1) / (k + 1) for k, size in enumerate(forced)), arb(0))
            found.append(upper(y * driven * R ** (-count) / (R - 1)))
        return min(found)

    def times(self, forced: list[arb]) -> Callable[[int], arb]:
        """What ``y(r) b(r)`` has from a power on, ``y' = a(r) y``, ``y(0) = 1``, ``forced`` the coefficients of
        ``b``."""
        found = []
        for R, y in self._grown:
            driven, power = y * 0, y * 0 + 1
            for size in forced:
                driven, power = driven + size * power, power * R
            found.append((R, y * driven * R / (R - 1)))
        return lambda count: min(upper(size * R ** (-count)) for R, size in found)


def products(steps: Sequence[arb_mat]) -> list[arb_mat]:
    """``Z_k = Phi_N ... Phi_{k+1}`` for ``k = 0, ..., N``, of steps ``Phi_1, ..., Phi_N``: from the products of pairs
    of them, each of which is made of at most twice as many products as there are levels."""
    from flint import arb_mat

    d = steps[0].nrows()
    unit = arb_mat([[int(i == j) for j in range(d)] for i in range(d)])
    if len(steps) == 1:
        return [steps[0], unit]
    odd = len(steps) % 2
    pairs = [second * first for first, second in zip(steps[:-1:2], steps[1::2], strict=False)]
    coarse = products([*pairs, *([steps[-1]] if odd else [])])
    found: list[arb_mat] = []
    for k in range(len(steps) + 1):
        place, inside = divmod(k, 2)
        if not inside:
            found.append(coarse[place])
        elif k == len(steps):
            found.append(unit)
        else:
            found.append(coarse[place + 1] * steps[k])
    return found


def prefixes(steps: Sequence[arb_mat]) -> list[arb_mat]:
    """``Phi_k ... Phi_1`` for ``k = 0, ..., N``, of steps ``Phi_1, ..., Phi_N``, as `products`."""
    from flint import arb_mat

    d = steps[0].nrows()
    unit = arb_mat([[int(i == j) for j in range(d)] for i in range(d)])
    if len(steps) == 1:
        return [unit, steps[0]]
    pairs = [second * first for first, second in zip(steps[:-1:2], steps[1::2], strict=False)]
    coarse = prefixes([*pairs, *([steps[-1]] if len(steps) % 2 else [])])
    return [coarse[k // 2] if k % 2 == 0 else steps[k - 1] * coarse[k // 2] for k in range(len(steps))] + [coarse[-1]]


def _wider(ball: arb, radius: arb) -> arb:
    from flint import arb

    return ball + arb(0, upper(radius))


def _largest(numbers: Sequence[arb]) -> arb:
    found = numbers[0]
    for one in numbers[1:]:
        found = found.max(one)
    return found
