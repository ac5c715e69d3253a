"""A system that changes with time and whose state is no affine function of its parameters, in balls: at one parameter
as the known system that it is there, and over a box of them as a polynomial in their shares, by power series of its
own.

With ``s`` the shares of the parameters and ``A = sum_b A_b s^b + A'``, the coefficients of ``x = sum_a x_a s^a + R``
up to a degree ``D`` obey ``x_a' = sum_b A_b x_(a-b) + B_a u + E_a w``: matrices of such polynomials are a ring, in
which power series in time solve as they do for numbers. What is beyond is ``R' = A R`` plus the products whose degrees
add up to more than ``D``: at most what transitions make of them, whose own norm is bounded by what it is of their
coefficients. What a power series of ``D`` factors leaves of entries, ``A'``, ``B'`` and ``E'``, is there as well, times
states and inputs: by the integral form of Taylor's remainder along the line from the middle, whose terms of ``D + 1``
factors are enclosed on boxes.
"""

from __future__ import annotations

from bisect import bisect_right
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property
from itertools import pairwise
from math import comb
from typing import TYPE_CHECKING, Any, NamedTuple, final

import numpy as np

from sparserob_core.checker.arithmetic.jets import Monomials
from sparserob_core.checker.arithmetic.series import Series, upper
from sparserob_core.checker.arithmetic.timed import Timed
from sparserob_core.checker.outcome import Unchecked
from sparserob_core.checker.reach.disturbance_support import Scene, bounded
from sparserob_core.checker.reach.flow import balanced, stacked
from sparserob_core.checker.reach.superposition import FREE, MOST_FACTORS, Parts, Something
from sparserob_core.checker.reach.tube import Known, Polynomial
from sparserob_core.checker.reach.varying.flow import (
    LONG,
    ORDER,
    SHARP,
    TERMS,
    VaryingFlow,
    _largest,
    _Tails,
    _wider,
    segmented,
)
from sparserob_core.checker.reach.varying.tube import ORDER as IN_TIME
from sparserob_core.checker.sets.known import known
from sparserob_core.checker.sets.parameters import Corners
from sparserob_core.checker.sets.polynomials import OUTWARD, Enclosed, rounding
from sparserob_core.control.problem.system import LinearSystem, VaryingSystem
from sparserob_core.control.sets.sets import Box
from sparserob_core.sip.convex_set import Array

if TYPE_CHECKING:
    from flint import arb, arb_mat, arb_poly

LEFT = ((1e-16, 160), (1e-13, 160))
"""Of the state, what is to be beyond the degree, and with how many coefficients times states at most: the first that is
reached; where none is, the box of parameters is halved. Norms of transitions multiply it by 1e3 and more, and walls are
ridden to 1e-9. Twice as many numbers take four times as long."""
FAR = 600.0  # exponents of what is too far in any case, whose exponential is a number
MOST_PARTS = 64  # of a box of parameters, each with an expansion of its own
GROWING = 0.5  # norm of the system times the length of a part: twice as much makes bounds of norms 2.7 times as large
MOST_MARKS = 64  # of the horizon, but for its segments: of every pair a product is looked at
FLOWS_KEPT = 256  # of single parameters
MOST_DEGREE = 60  # of the expansion, which is that of a few states and one parameter
MOST_TERMS = 30  # of power series of entries that are no polynomials; with q^n of them 40 take twice the time
FURTHER = 40  # degrees beyond one, whose sum is about what is beyond: of norms of a few the rest is far less
AHEAD = 4  # degrees beyond the last one that are looked at: what is beyond these is a small part of what is there
SLICES = 8
"""Parts of the way from the middle of the box to its sides, on which terms beyond the degree are enclosed; of two of
them they are a thousand times what they are, of more a few times less."""
PARTS_IN_TIME = 2  # of a segment, for these terms; more of them find the same where segments are short anyway
LOOKS = 17  # times at which the numbers of the system are looked at, by which nothing is proven
RATIOS = (1.0, 2.0, 4.0, 8.0, 16.0)
"""What a degree more counts in the norms that transitions are off by: with the first alone each coefficient of a high
degree is off by what the constant one is, and what is beyond never falls below rounding times the growth."""
EXPONENTIAL = 40  # terms of the exponential of norms on an interval, which are a few: 4^40 / 40! is 1e-24
REST = 1e-20  # of the norms, more than what is beyond these terms


@final
@dataclass(frozen=True, eq=False)
class Fixed:
    """An entry of a system at one ``parameter (nu,)``, as a function of the time."""

    entry: Any
    parameter: tuple[float, ...]

    def __call__(self, p: Any) -> object:
        whole, nothing = np.empty(1 + len(self.parameter), dtype=object), 0.0 * p[0]
        whole[0] = p[0]
        for j, value in enumerate(self.parameter):
            whole[1 + j] = nothing + value
        return self.entry(whole)


@final
@dataclass(frozen=True, eq=False)
class Segment:
    """``[A B E]`` from ``start`` to ``stop``, part by part of the shares' monomials: polynomials in the time since
    ``centre``, and balls ``left`` that hold what stands before the next power of it. ``beyond (d, d + m + mw)``: what
    is beyond these monomials at most."""

    start: float
    stop: float
    centre: float
    law: list[list[list[arb_poly]]]
    left: list[list[list[arb]]]
    beyond: Array

    @cached_property
    def there(self) -> list[int]:
        """The numbers of the parts that are not exactly 0 in all of this."""
        entries = enumerate(zip(self.law, self.left, strict=True))
        return [
            number
            for number, (law, left) in entries
            if any(one.length() for row in law for one in row) or not all(one == 0 for row in left for one in row)
        ]


class Looks(NamedTuple):
    """How large the numbers of a system are at some times, by which nothing is proven: ``units (d,)`` of the states, by
    the entries of ``A`` in the middle of the box; the largest ``degree`` of an entry that is a polynomial; about the
    integrals of the norms of all coefficients of ``A`` of the degrees from 1 on, ``paces``; what power series of inputs
    leave beyond every degree, ``rest``; ``drives (m + mw,)``, how large inputs are; and what of these norms every
    parameter is in, ``moved (nu,)``."""

    units: Array
    degree: int
    paces: Array
    rest: Array
    drives: Array
    moved: Array


@final
@dataclass(eq=False)
class SpreadFlow:
    """The system ``x' = A(t, p) x + B(t, p) u + E(t, p) w`` from 0 to ``until``; a drift is one more column of
    ``B``."""

    system: VaryingSystem
    until: float
    _at: dict[tuple[float, ...], VaryingFlow] = field(default_factory=dict)
    _known: dict[tuple[float, float], tuple[Series, Series, Series]] = field(default_factory=dict)

    def at(self, parameter: Sequence[float]) -> VaryingFlow:
        """The flow at one parameter."""
        point = tuple(map(float, parameter))
        if point not in self._at:
            if len(self._at) >= FLOWS_KEPT:
                self._at.clear()
            self._at[point] = VaryingFlow(self._fixed(point), self.until)
        return self._at[point]

    def _fixed(self, point: tuple[float, ...]) -> VaryingSystem:
        laws = []
        for begin, until, law in self.system.laws:
            A, B, E, c = (Fixed(e, point) if callable(e) else e for e in map(law.entry, ("A", "B", "E", "c")))
            laws.append((begin, LinearSystem(A, B, E, Box([begin], [until]), ("t",), c)))  # type: ignore[arg-type]
        return VaryingSystem(laws[0][1], self.system.horizon, self.system.delay, tuple(laws[1:]))

    @cached_property
    def parts(self) -> Parts:
        """The parameters as shares of the most that they deviate from the middle."""
        assert self.system.parameters is not None
        return Parts(self.system, tuple(self.system.parameters.interior_point().tolist()))

    @cached_property
    def _looks(self) -> Looks:
        """How large the numbers of the system are."""
        d, horizon = self.system.states, self.system.horizon
        most = self.degrees[-1] + AHEAD if self._bent.any() else MOST_FACTORS
        every, drives, degree = np.zeros((d, d)), np.zeros(1), 0
        tables = []
        for begin, until, law in self.system.laws:
            for time in np.linspace(begin, until, LOOKS):
                found = self._coefficients(law, time, most)[0]
                sizes = {key: np.abs(table.astype(float)) for key, table in found.items()}
                every = np.maximum(every, sizes[FREE][:, :d])
                drives = np.maximum(drives, sum(sizes.values())[:, d:].max(axis=0))
                degree = max(degree, *(len(key) for key, table in sizes.items() if table[~self._bent].any() or not key))
                tables.append(((until - begin) / LOOKS, sizes))
        u = np.array(balanced(every, horizon, np.ones(d) / horizon))
        paces, rates, moved = np.zeros(most + 1), np.zeros(most + 1), np.zeros(len(self.parts.middle))
        inputs = np.where(drives > 0.0, drives, 1.0)
        for width, sizes in tables:
            for key, table in sizes.items():
                size = width * float((table[:, :d] * u / u[:, None]).sum(axis=1).max())
                pushed = width / horizon * float((table[:, d:] / inputs).max(initial=0.0)) * bool(self._bent.any())
                paces[len(key)] += size
                rates[len(key)] += pushed
                for j in key:
                    moved[j] += size + pushed
        rest = 2.0 * np.append(rates[::-1].cumsum()[::-1][1:], 0.0)
        return Looks(u, degree, paces[1:], rest, drives, moved)

    @property
    def inputs(self) -> int:
        """How many inputs there are, a drift and disturbances among them."""
        return self.system.controls + (self.system.c is not None) + self.system.disturbances

    @property
    def units(self) -> Array:
        """Units of the states, powers of two; any would be right."""
        return self._looks.units

    @cached_property
    def _bent(self) -> np.ndarray:
        """Which entries of ``[A B E]`` are no polynomials."""
        laws = self.system.laws
        return np.asarray(np.any([self._coefficients(law, Something(), MOST_FACTORS)[1] for _, _, law in laws], axis=0))

    @cached_property
    def degrees(self) -> list[int]:
        """Those of which there are not too many monomials."""
        nu, d, most = len(self.parts.middle), self.system.states, MOST_TERMS if self._bent.any() else MOST_DEGREE
        return [n for n in range(most + 1) if d * comb(nu + n, nu) <= LEFT[-1][1]]

    @cached_property
    def monomials(self) -> Monomials:
        """Those of the shares; raises `Unchecked` where too many were needed."""
        found = self._few_monomials()
        if found is None:
            raise Unchecked("the parameters beside the time move the state further than an expansion reaches")
        return found

    def _few_monomials(self) -> Monomials | None:
        """Those of the shares up to a degree beyond which little is; ``None`` where they are too many. What is beyond
        grows as states do and meets states that grew, by the exponential of the norms each."""
        nu, powers, paces, rest = len(self.parts.middle), self._looks.degree, self._looks.paces, self._looks.rest
        beyond = self._beyond_degrees(paces) * float(np.exp(min(2.0 * paces.sum(), FAR)))
        for left, most in LEFT:
            for degree in self.degrees[max(1, powers) :]:
                small = beyond[degree] <= left and (not self._bent.any() or (degree + 1) * rest[degree] <= left)
                if small and self.system.states * comb(nu + degree, nu) <= most:
                    return Monomials(nu, degree)
        return None

    @cached_property
    def divided(self) -> list[tuple[Corners, SpreadFlow]]:
        """Parts of the box of parameters, and the flow over each: itself where its expansion reaches, else halves of
        halves along the parameter that moves the state most."""
        assert self.system.parameters is not None
        box = self.system.parameters.bounding_box()
        todo: list[tuple[Corners, SpreadFlow]] = [((tuple(box.lower.tolist()), tuple(box.upper.tolist())), self)]
        found = list[tuple[Corners, SpreadFlow]]()
        while todo:
            (low, high), flow = todo.pop()
            if flow._few_monomials() is not None:
                found.append(((low, high), flow))
                continue
            axis = int(np.argmax(flow._looks.moved))
            middle = (low[axis] + high[axis]) / 2
            if len(todo) + len(found) + 2 > MOST_PARTS or not low[axis] < middle < high[axis]:
                raise Unchecked("the parameters beside the time move the state further than expansions reach")
            for one, other in ((middle, high[axis]), (low[axis], middle)):
                ends = (*low[:axis], one, *low[axis + 1 :]), (*high[:axis], other, *high[axis + 1 :])
                system = self.system.with_parameters(Box(np.array(ends[0]), np.array(ends[1])))
                todo.append((ends, SpreadFlow(system, self.until, self._at)))
        return found

    def parted(self, box: Corners) -> list[tuple[Corners, SpreadFlow]]:
        """A box of parameters cut where the parts end, and the flow over the part that each lies in."""
        found = list[tuple[Corners, SpreadFlow]]()
        for (low, high), flow in self.divided:
            a, b = (tuple(map(of, *ends)) for of, ends in ((max, (box[0], low)), (min, (box[1], high))))
            flat = [x == y for x, y in zip(*box, strict=True)]
            if all(x < y or (x == y and thin) for x, y, thin in zip(a, b, flat, strict=True)):
                found.append(((a, b), flow))
        return found

    @staticmethod
    def _beyond_degrees(paces: Array) -> Array:
        """About what is beyond every degree: the coefficients of ``exp(sum_b paces[b - 1] z^b)`` after it, summed."""
        every = np.zeros(MOST_DEGREE + FURTHER + 1)
        every[0] = 1.0
        for n in range(1, every.size):
            of = np.arange(1, min(n, paces.size) + 1)
            every[n] = (of * paces[: of.size] * every[n - of]).sum() / n
        return np.append(every[::-1].cumsum()[::-1][1:], 0.0)

    def _coefficients(
        self, law: LinearSystem, time: object, most: int, middle: Sequence[Any] | None = None
    ) -> tuple[dict[tuple[int, ...], np.ndarray], np.ndarray]:
        """``[A B E]`` at a time up to so many factors, by the numbers of the shares, and where it is not all."""
        entries = [law.A, law.B, *([] if law.c is None else [law.c]), law.E]
        every = [self.parts.coefficients(one, time, most, middle) for one in entries]
        keys = dict.fromkeys(key for one, _ in every for key in one)
        found = {
            key: np.hstack([one.get(key, np.zeros(bent.shape, dtype=object)) for one, bent in every]) for key in keys
        }
        return found, np.hstack([bent for _, bent in every])

    def _table(self, law: LinearSystem, centre: arb, length: int) -> list[list[list[list[arb]]]]:
        """The first coefficients in time of every entry of ``[A B E]``, part by part, at all times of a ball."""
        from flint import arb, ctx

        before, ctx.cap = ctx.cap, length
        try:
            found, _ = self._coefficients(law, Timed.time(centre, length), self.monomials.degree)
            none = [arb(0)] * length
            rows, columns = found[FREE].shape
            parts = [[[none] * columns for _ in range(rows)] for _ in range(self.monomials.size)]
            for key, table in found.items():
                exponents = tuple(key.count(j) for j in range(self.monomials.count))
                for (i, j), one in np.ndenumerate(table):
                    if isinstance(one, Timed):
                        parts[self.monomials.number[exponents]][i][j] = one.coefficients(length)
                    elif float(one) != 0.0:
                        parts[self.monomials.number[exponents]][i][j] = [arb(float(one)), *none[1:]]
            return parts
        finally:
            ctx.cap = before

    def beyond(self, law: LinearSystem, start: float, stop: float) -> Array:
        """What is beyond the monomials of every entry of ``[A B E]`` at most, ``(d, d + m + mw)``, at any time between
        two and any parameter: with the terms ``f_a`` of ``D + 1`` factors ``(D + 1) int_0^1 (1 - z)^D sum_a
        |f_a(z s)| dz``. Raises `Unchecked` where it is not finite."""
        from flint import arb, ctx

        degree = self.monomials.degree
        bent = self._coefficients(law, Something(), degree)[1]
        total = np.zeros(bent.shape)
        if not bent.any():
            return total
        before, ctx.cap = ctx.cap, 1
        try:
            cuts = np.linspace(start, stop, PARTS_IN_TIME + 1).tolist()
            for begin, until in pairwise(cuts):
                time, sums = Timed.time(arb(begin).union(arb(until)), 1), np.full(bent.shape, arb(0), dtype=object)
                for k in range(SLICES):
                    low, high = arb(k) / SLICES, arb(k + 1) / SLICES
                    weight = (1 - low) ** (degree + 1) - (1 - high) ** (degree + 1)
                    middle = [
                        Timed.time(arb(value), 1) + Timed.time(arb(0, 1) * arb(scale) * high, 1)
                        for value, scale in zip(self.parts.middle, self.parts.scales, strict=True)
                    ]
                    found, _ = self._coefficients(law, time, degree + 1, middle)
                    for key, table in found.items():
                        if len(key) == degree + 1:
                            for place in np.argwhere(bent).tolist():
                                one = table[tuple(place)]
                                term = one.coefficients(1)[0] if isinstance(one, Timed) else arb(float(one))
                                sums[tuple(place)] += upper(abs(term)) * weight
                total = np.maximum(total, [[float(upper(one).upper()) for one in row] for row in sums])
        finally:
            ctx.cap = before
        return total * OUTWARD

    @cached_property
    def segments(self) -> list[Segment]:
        """The system on parts of the horizon, one after another; raises `Unchecked` where it is not finite."""
        return segmented(self.system, self.until, self._segment)

    def _segment(self, start: float, stop: float, law: LinearSystem) -> Segment | None:
        """The system from ``start`` to ``stop``; ``None`` where that is too long."""
        from flint import arb, arb_poly

        centre = (start + stop) / 2
        half = upper(abs(arb(stop) - arb(centre)).max(abs(arb(start) - arb(centre))))
        try:
            exact = self._table(law, arb(centre), ORDER + 1)
            wide = self._table(law, arb(start).union(arb(stop)), ORDER + 2)
        except Unchecked:
            return None
        d, u, drives = self.system.states, self.units.tolist(), self._looks.drives
        size, lost = arb(0), arb(0)
        for i in range(d):
            sums, over = arb(0), arb(0)
            for part, rest in zip(exact, wide, strict=True):
                for j, entry in enumerate(part[i]):
                    left = upper(abs(rest[i][j][ORDER + 1])) * half ** (ORDER + 1)
                    if j >= d:
                        if not left <= arb(SHARP) * arb(float(drives[j - d]) or 1.0):
                            return None
                        continue
                    far = sum((upper(abs(one)) * half**k for k, one in enumerate(entry)), arb(0))
                    sums, over = sums + far * u[j] / u[i], over + left * u[j] / u[i]
            size, lost = size.max(sums), lost.max(over)
        most = size.max(arb(1.0 / self.system.horizon))
        if not (size * (arb(stop) - arb(start)) <= LONG and lost <= arb(SHARP) * most):
            return None
        try:
            beyond = self.beyond(law, start, stop)
        except Unchecked:
            return None
        return Segment(
            start,
            stop,
            centre,
            [[[arb_poly(entry) for entry in row] for row in part] for part in exact],
            [[[entry[ORDER + 1] for entry in row] for row in part] for part in wide],
            beyond,
        )

    @cached_property
    def ends(self) -> list[float]:
        """Where the segments end."""
        return [one.stop for one in self.segments]

    @cached_property
    def _begins(self) -> list[float]:
        return [one.start for one in self.segments]

    def over(self, start: float, stop: float) -> tuple[Series, Series, Series]:
        """What an interval makes of a state, of a control that stays the same, and of such a disturbance."""
        if not 0.0 <= start <= stop <= self.until:
            raise Unchecked(f"the system is not known from {start:g} to {stop:g}")
        if (start, stop) not in self._known:
            d, m = self.system.states, self.system.controls + (self.system.c is not None)
            first = max(0, bisect_right(self._begins, start) - 1)
            last = max(first, bisect_right(self._begins, np.nextafter(stop, -np.inf)) - 1)
            times = [start, *self._begins[first + 1 : last + 1], stop]
            whole: tuple[Series, Series] | None = None
            for number, (one, other) in enumerate(pairwise(times), first):
                terms, rest = self._series(self.segments[number], one, other)
                total = rest
                for term in reversed(terms):
                    total = total + term
                part = _columns(total, 0, d), _columns(total, d, None)
                whole = part if whole is None else (part[0] * whole[0], part[0] * whole[1] + part[1])
            assert whole is not None
            self._known[start, stop] = whole[0], _columns(whole[1], 0, m), _columns(whole[1], m, None)
        return self._known[start, stop]

    def within(self, start: float, stop: float, order: int) -> tuple[list[Series], Series]:
        """What an interval within one segment makes of states and of inputs that stay the same: coefficients of powers
        of the share of the interval, up to ``order``, and balls that hold the rest."""
        segment = self.segments[max(0, bisect_right(self._begins, start) - 1)]
        if not 0.0 <= start <= stop <= segment.stop:
            raise Unchecked(f"the system is no polynomial from {start!r} to {stop!r}")
        terms, rest = self._series(segment, start, stop)
        later = [_around(parts) for parts in zip(*(term.parts for term in terms[order + 1 :]), strict=True)]
        return terms[: order + 1], rest + Series(self.monomials, later) if later else rest

    def _series(self, segment: Segment, start: float, stop: float) -> tuple[list[Series], Series]:
        """The terms of the solution of ``Y' = h A Y + [0, h B, h E]``, ``Y(0) = [I, 0, 0]``, in powers of the share of
        the interval, and balls around 0 that hold the rest: its tail by Cauchy's bound, for the norms of coefficients
        are at most those of ``y' = a(s) y + b(s)``, and what the segment leaves out, by variation of constants."""
        from flint import arb, arb_poly

        d, h, u = self.system.states, arb(stop) - arb(start), [arb(one) for one in self.units.tolist()]
        shifted, none = arb_poly([arb(start) - arb(segment.centre), h]), arb(0)
        law = [segment.law[number] for number in segment.there] or segment.law[:1]
        table = [[[(entry(shifted) * h).coeffs() for entry in row] for row in part] for part in law]
        order, columns = max(1, *(len(entry) for part in table for row in part for entry in row)), len(table[0][0])
        rows, a_sizes, b_sizes = [], [], []
        for k in range(order):
            rows.append([[[entry[k] if k < len(entry) else none for entry in row] for row in part] for part in table])
            a_sizes.append(upper(sum((self._norm(part, d, u) for part in rows[k]), none)))
            pushes = [
                [_largest([upper(abs(row[j])) / u[i] for i, row in enumerate(part)]) for part in rows[k]]
                for j in range(d, columns)
            ]
            b_sizes.append([upper(sum(one, none)) for one in pushes])
        kept = self._kept(a_sizes, b_sizes)
        A = [self._placed(segment, [stacked([row[:d] for row in part]) for part in one]) for one in rows[:kept]]
        driven = [
            self._placed(segment, [stacked([[none] * d + row[d:] for row in part]) for part in one])
            for one in rows[:kept]
        ]
        first = stacked([[arb(int(i == j)) for j in range(columns)] for i in range(d)])
        terms, tails = [Series.constant(self.monomials, first)], _Tails(a_sizes)
        count = next((one for one in TERMS if tails.of(one, None) <= arb(SHARP)), TERMS[-1])
        for n in range(count):
            nexts = A[0] * terms[n]
            for k in range(1, min(n + 1, kept)):
                if any(A[k].there):
                    nexts = nexts + A[k] * terms[n - k]
            if n < kept:
                nexts = nexts + driven[n]
            terms.append(nexts.scaled(1 / arb(n + 1)))
        far = upper(abs(arb(segment.stop) - arb(segment.centre)).max(abs(arb(segment.start) - arb(segment.centre))))
        rest = [
            [[upper(abs(one)) * far ** (ORDER + 1) * upper(abs(h)) for one in row] for row in part]
            for part in (segment.left[number] for number in segment.there)
        ]
        r, a = sum((self._norm(part, d, u) for part in rest), none), upper(sum(a_sizes, none))
        r = upper(r + sum(a_sizes[kept:], none))
        spread = (a + r).exp() * a.exp()
        state = tails.of(count, None) + r * spread
        errors = [[state * u[i] / u[j] for j in range(d)] for i in range(d)]
        for j in range(d, columns):
            forced = [one[j - d] for one in b_sizes]
            missing = sum((_largest([row[j] / u[i] for i, row in enumerate(part)]) for part in rest), none)
            missing += sum(forced[kept:], none)
            error = tails.of(count, forced) + spread * (r * sum(forced, none) + missing)
            for i in range(d):
                errors[i].append(error * u[i])
        around = stacked([[_wider(none, one) for one in row] for row in errors])
        return terms, Series(self.monomials, [around] * self.monomials.size)

    @staticmethod
    def _kept(states: Sequence[arb], inputs: Sequence[Sequence[arb]]) -> int:
        """How many coefficients in time are more than is left out anyway, of norms of ``A`` and of the columns of ``[B
        E]``: over a short interval few."""
        from flint import arb

        for kept in range(1, len(states)):
            left = [
                sum(column[kept:], arb(0)) <= arb(SHARP) * sum(column, arb(0)) for column in zip(*inputs, strict=True)
            ]
            if sum(states[kept:], arb(0)) <= arb(SHARP) and all(left):
                return kept
        return len(states)

    def _placed(self, segment: Segment, parts: Sequence[arb_mat]) -> Series:
        """A series of parts of which only those that are in a segment are given."""
        found = [parts[0] * 0] * self.monomials.size
        for number, part in zip(segment.there, parts, strict=False):
            found[number] = part
        return Series(self.monomials, found)

    @staticmethod
    def _norm(part: Sequence[Sequence[arb]], d: int, u: Sequence[arb]) -> arb:
        """The norm of largest row sums, in own units, of the first ``d`` columns."""
        return _largest(
            [sum((upper(abs(row[j])) * u[j] / u[i] for j in range(d)), u[0] * 0) for i, row in enumerate(part)]
        )

    @cached_property
    def marks(self) -> list[float]:
        """Where segments begin and end, and between these where the norms of transitions would grow by much."""
        parts, found = self._parts, [0.0]
        for start, stop, count in zip([0.0, *self.ends[:-1]], self.ends, parts.tolist(), strict=True):
            found += [start + (stop - start) * k / count for k in range(1, count)] + [stop]
        return found

    @cached_property
    def _parts(self) -> np.ndarray:
        """Into how many parts each segment is cut."""
        grows = self._most[0].sum(axis=1) * np.diff([0.0, *self.ends])
        wanted = np.ceil(grows / GROWING)
        return np.asarray(np.maximum(np.floor(wanted * min(1.0, MOST_MARKS / max(1.0, wanted.sum()))), 1.0), dtype=int)

    @cached_property
    def _sizes(self) -> tuple[Array, Array]:
        """`_most` between all marks."""
        return self._between(self._most)

    @cached_property
    def _left(self) -> tuple[Array, Array]:
        """`_off` between all marks."""
        return self._between(self._off)

    def _between(self, sizes: tuple[Array, Array]) -> tuple[Array, Array]:
        return np.repeat(sizes[0], self._parts, axis=0), np.repeat(sizes[1], self._parts, axis=0)

    def _degrees(self, sizes: Array) -> Array:
        """The norms ``(..., M)`` of all parts summed by their degree, ``(..., D + 1)``."""
        degrees = np.array([sum(e) for e in self.monomials.exponents])
        found = [sizes[..., degrees == j].sum(axis=-1) for j in range(self.monomials.degree + 1)]
        return np.stack(found, axis=-1) * OUTWARD

    @cached_property
    def _most(self) -> tuple[Array, Array]:
        """The norms of ``A`` on every segment by degree, ``(K, D + 1)``, and those of the columns of ``[B E]``, ``(K, m
        + mw, D + 1)``, all in own units."""
        return self._norms(0)

    def _norms(self, order: int) -> tuple[Array, Array]:
        """Those of their derivatives of an ``order``, 0 or 1."""
        d, u, states, inputs = self.system.states, self.units, [], []
        for one in self.segments:
            far = upper(abs(_ball(one.stop) - _ball(one.centre)).max(abs(_ball(one.start) - _ball(one.centre))))
            table = np.array([
                [
                    [_largest_of(entry, left, far, order) for entry, left in zip(*rows, strict=True)]
                    for rows in zip(*part, strict=True)
                ]
                for part in zip(one.law, one.left, strict=True)
            ])  # fmt: skip
            states.append((table[:, :, :d] * u / u[:, None]).sum(axis=2).max(axis=1) * OUTWARD)
            inputs.append((table[:, :, d:] / u[:, None]).max(axis=1).T * OUTWARD)
        return self._degrees(np.array(states)), self._degrees(np.array(inputs))

    @cached_property
    def _off(self) -> tuple[Array, Array]:
        """What power series leave of entries on every segment: the norm of ``A``, ``(K,)``, and how fast inputs drive
        states by it, ``(K, m + mw)``."""
        d, u = self.system.states, self.units
        every = np.array([one.beyond for one in self.segments]) / u[:, None]
        return (every[:, :, :d] * u).sum(axis=2).max(axis=1) * OUTWARD, every[:, :, d:].max(axis=1) * OUTWARD

    @cached_property
    def _lengths(self) -> Array:
        return np.diff(self.marks) * (1.0 + rounding(2))

    @cached_property
    def _within_norms(self) -> Array:
        """What a segment makes of norms by degree, anywhere on it, ``(K, D + 1, D + 1)``."""
        sizes, n = self._sizes[0], self.monomials.degree + 1
        rate = np.zeros((len(sizes), n, n))
        for j in range(n):
            for i in range(j + 1):
                rate[:, j, i] = sizes[:, j - i]
        rate = rate * self._lengths[:, None, None]
        total, term = np.tile(np.eye(n), (len(sizes), 1, 1)), np.tile(np.eye(n), (len(sizes), 1, 1))
        for order in range(1, EXPONENTIAL):
            term = term @ rate / order
            total = total + term
        return (total + REST) * OUTWARD

    def _beyond(self, norms: Array) -> float:
        """The integral over the horizon of what is beyond the degree where the state's norms by degree are at most
        ``norms (K, D + 1)`` on every segment."""
        sizes = np.cumsum(self._sizes[0][:, ::-1], axis=1)
        factors = np.concatenate([np.zeros((len(sizes), 1)), sizes[:, :-1]], axis=1) + self._left[0][:, None]
        return float(((norms * factors).sum(axis=1) * self._lengths).sum() * OUTWARD)

    @cached_property
    def _carried(self) -> Array:
        """The largest norms by degree of the transitions from the beginning of any segment to that of any later one,
        ``(D + 1,)``; of the computed products, and of what these are off by: with ``P`` the largest of their summed
        norms and ``e`` the sum of what all steps are off by, ``P^2 e / (1 - P e)``; in each of several norms, in which
        a degree ``j`` counts ``ratio^j``, so that it is off by that over this."""
        d, u, M, first = self.system.states, self.units, self.monomials.size, np.array(self.monomials.products)
        steps = [self.over(*ends)[0] for ends in pairwise(self.marks)]
        tables = Enclosed.all([part for one in steps for part in one.parts], (len(steps), M, d, d))
        mid, rad = (one * u / u[:, None] for one in (tables.mid, tables.rad))
        every, unit = np.zeros((0, M, d, d)), np.zeros((1, M, d, d))
        unit[0, 0] = np.eye(d)
        counted = np.array(RATIOS)[:, None] ** np.arange(self.monomials.degree + 1)  # powers of two
        found = self._degrees(_row_sums(unit))[0]
        largest = np.ones(len(RATIOS))
        for step in mid:
            every, moved = np.concatenate([every, unit]), np.zeros((len(every) + 1, M, d, d))
            for i, j, k in first.tolist():
                moved[:, k] += step[i] @ every[:, j]
            every = moved
            norms = self._degrees(_row_sums(every))
            found, largest = np.maximum(found, norms.max(axis=0)), np.maximum(largest, (norms @ counted.T).max(axis=0))
        missed = self._degrees(_row_sums(rad) + rounding(d * M) * _row_sums(mid)).sum(axis=0)
        share = largest * (counted @ missed) * OUTWARD**2
        near = share < 0.5
        if not near.any():
            raise Unchecked("the transitions are not known closely enough")
        off = ((largest * share)[near] / (1.0 - share[near]))[:, None] / counted[near]
        return np.asarray((found + off.min(axis=0)) * OUTWARD**2)

    def lost(self, begun: Array, inputs: Array) -> Array:
        """What is beyond the degree of any state, ``(d,)``, that begins at no more than ``begun (d,)`` and is driven by
        at most ``inputs (m + mw,)``."""
        missing = float((self._left[1] @ inputs * self._lengths).sum() * OUTWARD)
        return self._growth * (self._beyond(self.reached(begun, inputs)) + missing) * self.units * OUTWARD

    @cached_property
    def _growth(self) -> float:
        """The norm of the transitions from any time to any later one, at any parameter."""
        ends = float(np.exp(((self._sizes[0].sum(axis=1) + self._left[0]) * self._lengths).max())) * OUTWARD
        carried = self._carried
        share = ends * self._beyond(np.einsum("kij,j->ki", self._within_norms, carried))
        if not share < 0.5:
            raise Unchecked("what the expansion in the parameters leaves out is not bounded")
        return ends * ends * float(carried.sum()) / (1.0 - share) * OUTWARD

    def reached(self, begun: Array, inputs: Array) -> Array:
        """The norms by degree of the coefficients of such states, at most, on every segment, ``(K, D + 1)``."""
        sizes, lengths, u, n = self._sizes, self._lengths, self.units, self.monomials.degree + 1
        driven, carried, within = np.einsum("kcj,c->kj", sizes[1], inputs), self._carried, self._within_norms
        pushed = (np.einsum("kij,kj->ki", within, driven) * lengths[:, None]).sum(axis=0)
        pushed[0] += float((begun / u).max(initial=0.0))
        at_marks = np.array([sum(carried[j - i] * pushed[i] for i in range(j + 1)) for j in range(n)])
        return np.asarray(np.einsum("kij,kj->ki", within, at_marks + lengths[:, None] * driven) * OUTWARD)

    def bent(self, start: float, inputs: Array, states: float) -> float:
        """How fast the slopes of states may change at any parameter, in own units: of states that are at most
        ``states`` in the norm of these, driven by at most ``inputs (m + mw,)``, on the segment that a time is in."""
        place = max(0, bisect_right(self._begins, start) - 1)
        a, b, faster, driven = (one[place].sum(axis=-1) for parts in (self._most, self._moving) for one in parts)
        return float(((driven + a * b) @ inputs + (faster + a * a) * states) * OUTWARD)

    @cached_property
    def _moving(self) -> tuple[Array, Array]:
        return self._norms(1)


def _largest_of(entry: arb_poly, left: arb, far: arb, order: int) -> float:
    """The largest absolute value, no further than ``far`` from its centre, of a polynomial with what is ``left``, or of
    its derivative."""
    coefficients = [upper(abs(one)) for one in entry.coeffs()]
    coefficients += [far * 0] * (ORDER + 1 - len(coefficients)) + [upper(abs(left))]
    powers = enumerate(coefficients[order:])
    return float(sum((one * (n + 1) ** order * far**n for n, one in powers), far * 0).upper())


@final
@dataclass(eq=False)
class SpreadTube:
    """The reachable states over a ``box`` of parameters, seen along combinations of the rows of ``basis (b, d)``."""

    every: SpreadStates
    basis: Array
    box: Corners

    @cached_property
    def flow(self) -> Known:
        """The monomials on the box, its middle and half its widths."""
        low, high = np.array(self.box[0]), np.array(self.box[1])
        centre = (low + high) / 2
        radius = np.nextafter(np.maximum(high - centre, centre - low), np.inf)
        monomials = self.every.law.monomials
        return Known(monomials, tuple(centre.tolist()), tuple(radius.tolist()), np.ones(monomials.size))

    @cached_property
    def _recentred(self) -> Enclosed:
        """What makes of coefficients in the shares those on the box, ``(M, M)``."""
        from flint import arb

        parts, monomials = self.every.law.parts, self.every.law.monomials
        moves = []
        for centre, radius, middle, scale in zip(
            self.flow.centre, self.flow.radius, parts.middle, parts.scales, strict=True
        ):
            unit = arb(scale) if scale else arb(1)
            moves.append(((arb(centre) - arb(middle)) / unit, arb(radius) / unit))
        table = []
        for e in monomials.exponents:  # of the box
            row = []
            for f in monomials.exponents:
                entry = arb(1)
                for k, n, (c, r) in zip(e, f, moves, strict=True):
                    entry = entry * comb(n, k) * c ** (n - k) * r**k if n >= k else arb(0)
                row.append(entry)
            table.append(row)
        return Enclosed.of(stacked(table))

    def cells(self, piece: int, start: float, stop: float, z: Array, sharp: bool = False) -> list[Polynomial]:
        """As `Tube.cells`, on a part of a piece within one segment of the system."""
        scene = self.every.scene
        state, parts = self.every.over(piece, start, stop)
        seen = self._seen(state)  # (1, J + 1, M, 1, b)
        mid = np.einsum("jkb,ib->ijk", seen.mid[0, :, :, 0], z)
        lost = seen.rad[0, :, :, 0] + rounding(z.shape[1]) * np.abs(seen.mid[0, :, :, 0])
        rad, kinks, turning = np.abs(z) @ lost.sum(axis=(0, 1)), np.zeros(len(z)), np.zeros(len(z))
        for convex, part in parts:
            here = self._seen(part)
            if convex is scene.disturbance and scene.lasting is not None:
                here = Enclosed(*scene.lasting.gathered(here.mid, here.rad))
            moved, off, switching, of_box = bounded(known(convex), self.flow.monomials, here.mid, here.rad, z, sharp)
            rad += off + rounding(1) * (np.abs(mid) + np.abs(moved)).sum(axis=(1, 2))
            mid, kinks, turning = mid + moved, kinks + switching, turning + of_box
        rad += np.abs(z) @ (np.abs(self.basis) @ self.every.lost) * (1.0 + rounding(sum(self.basis.shape)))
        assert scene.switches == ()
        return [
            Polynomial(mid[i], float(rad[i]) * OUTWARD, 0.0, float(kinks[i]), float(turning[i])) for i in range(len(z))
        ]

    def _seen(self, states: Enclosed) -> Enclosed:
        """``basis`` times states ``(l, J + 1, M, d, w)``, on the box, ``(l, J + 1, M, w, b)``."""
        basis, moves = self.basis, self._recentred
        mid = np.einsum("bi,ef,ljfiw->ljewb", basis, moves.mid, states.mid, optimize=True)
        size = np.abs(moves.mid) + moves.rad
        rough = states.rad + rounding(2 * (basis.shape[1] + moves.mid.shape[0])) * np.abs(states.mid)
        rad = np.einsum("bi,ef,ljfiw->ljewb", np.abs(basis), size, rough, optimize=True)
        rad = rad + np.einsum("bi,ef,ljfiw->ljewb", np.abs(basis), moves.rad, np.abs(states.mid), optimize=True)
        return Enclosed(mid, rad * OUTWARD)


@final
@dataclass(eq=False)
class SpreadStates:
    """All coefficients of the reachable states of a system, of which ``law`` is the flow, whatever the box."""

    law: SpreadFlow
    scene: Scene
    _over: dict[tuple[int, float, float], tuple[Enclosed, list[Any]]] = field(default_factory=dict)

    @cached_property
    def _pieces(self) -> list[tuple[Series, Series, Series]]:
        return [self.law.over(*ends) for ends in pairwise(self.scene.grid)]

    @cached_property
    def nodes(self) -> list[Series]:
        """The undisturbed state at the breakpoints of the grid."""
        x = Series.constant(self.law.monomials, stacked([[_ball(v)] for v in self.scene.initial_state]))
        found = [x]
        for (Phi, Gamma, _), u in zip(self._pieces, self.scene.control, strict=True):
            x = Phi * x + Gamma.applied(u)
            found.append(x)
        return found

    @cached_property
    def _effects(self) -> list[tuple[Enclosed, Enclosed]]:
        """At every breakpoint what a deviation at 0, ``(M, d, d)``, and the disturbance on every piece before, ``(node,
        M, d, mw)``, made of the state."""
        d, mw, M = self.law.system.states, self.law.system.disturbances, self.law.monomials.size
        after = Series.constant(self.law.monomials, stacked([[_ball(i == j) for j in range(d)] for i in range(d)]))
        past, found = list[Series](), []
        for k in range(len(self._pieces) + 1):
            if k:
                Phi, _, Delta = self._pieces[k - 1]
                after, past = Phi * after, [*(Phi * one for one in past), Delta]
                past = past if self.scene.disturbance is not None else []
            pushed = Enclosed.all([part for one in past for part in one.parts], (len(past), M, d, mw))
            found.append((Enclosed.all(after.parts, (M, d, d)), pushed))
        return found

    def over(self, piece: int, start: float, stop: float) -> tuple[Enclosed, list[Any]]:
        """On ``[start, stop]``, in powers of the share of it: the undisturbed state, ``(1, J + 1, M, d, 1)``, and the
        sets of what is uncertain with what each of their members makes of the state, ``(blocks, J + 1, M, d, w)``."""
        key = piece, start, stop
        if key in self._over:
            return self._over[key]
        law, scene = self.law, self.scene
        d, M = law.system.states, law.monomials.size
        m = law.system.controls + (law.system.c is not None)
        terms, rest = law.within(start, stop, 0 if start == stop else IN_TIME - 1)
        Phi, Gamma, Delta = law.over(scene.grid[piece], start)
        u = scene.control[min(piece, len(scene.control) - 1)]
        x = Phi * self.nodes[piece] + Gamma.applied(u)
        states = [_columns(one, 0, d) for one in (*terms, rest)]
        every = [
            one * x + _columns(whole, d, d + m).applied(u) for one, whole in zip(states, (*terms, rest), strict=True)
        ]
        state = _with_rest(every, (M, d, 1))
        found = []
        if scene.disturbance is not None and stop > 0.0:
            carried = _with_rest([one * Phi for one in states], (M, d, d))
            past = _ring(law.monomials, carried, self._effects[piece][1])
            now = _with_rest(
                [one * Delta + _columns(whole, d + m, None) for one, whole in zip(states, (*terms, rest), strict=True)],
                (M, d, law.system.disturbances),
            )
            mid, rad = (np.concatenate([a, b[None]]) for a, b in ((past.mid, now.mid), (past.rad, now.rad)))
            block = np.searchsorted(np.array(scene.changes), np.array(scene.grid[: len(mid)]), side="right")
            firsts = np.flatnonzero(np.diff(block, prepend=-1))
            rad = (rad + rounding(len(mid)) * np.abs(mid)) * OUTWARD
            mid, rad = (np.add.reduceat(part, firsts, axis=0) for part in (mid, rad))
            found.append((scene.disturbance, Enclosed(mid, rad)))
        if scene.initial_set is not None:
            carried = _with_rest([one * Phi for one in states], (M, d, d))
            begun = self._effects[piece][0]
            found.append((
                scene.initial_set, _ring(law.monomials, carried, Enclosed(begun.mid[None], begun.rad[None]))
            ))  # fmt: skip
        self._over[key] = Enclosed(state.mid[None], state.rad[None]), found
        return self._over[key]

    @cached_property
    def lost(self) -> Array:
        """What is beyond the degree, ``(d,)``."""
        scene = self.scene
        begun = np.abs(np.array(scene.initial_state))
        if scene.initial_set is not None:
            begun = (begun + np.array(known(scene.initial_set).radius)) * OUTWARD
        control = np.max([[float(upper(abs(v)).upper()) for v in u.entries()] for u in scene.control], axis=0)
        pushed = np.zeros(self.law.system.disturbances)
        if scene.disturbance is not None:
            pushed = np.array(known(scene.disturbance).radius) * OUTWARD
        return self.law.lost(begun, np.concatenate([control * OUTWARD, pushed]))


def _ring(monomials: Monomials, left: Enclosed, right: Enclosed) -> Enclosed:
    """Products of polynomials in time and shares ``(J + 1, M, d, d)`` with such in shares ``(l, M, d, w)``: ``(l, J +
    1, M, d, w)``."""
    shape = (len(right.mid), *left.mid.shape[:3], right.mid.shape[3])
    mid, rad = np.zeros(shape), np.zeros(shape)
    size, there = np.abs(left.mid), np.abs(right.mid)
    wide = right.rad + rounding(left.mid.shape[3] * monomials.size) * there
    for i, j, k in monomials.products:
        mid[:, :, k] += left.mid[None, :, i] @ right.mid[:, None, j]
        rad[:, :, k] += size[None, :, i] @ wide[:, None, j] + left.rad[None, :, i] @ (there + right.rad)[:, None, j]
    return Enclosed(mid, rad * OUTWARD)


def _with_rest(parts: Sequence[Series], shape: tuple[int, ...]) -> Enclosed:
    """Coefficients ``(J + 1, ...)``, the last of ``parts`` being what all of them together leave out."""
    every = [Enclosed.all(one.parts, shape) for one in parts]
    mid, rad = (np.array([getattr(one, name) for one in every]) for name in ("mid", "rad"))
    rad[0] += (np.abs(mid[-1]) + rad[-1]) * OUTWARD
    return Enclosed(mid[:-1], rad[:-1])


def _columns(series: Series, first: int, last: int | None) -> Series:
    parts = [stacked([row[first:last] for row in part.tolist()]) for part in series.parts]
    return Series(series.monomials, parts)


def _around(matrices: Sequence[arb_mat]) -> arb_mat:
    """Balls around 0 that hold the sums of entries, each times any factor from -1 to 1."""
    rows = zip(*(one.tolist() for one in matrices), strict=True)
    return stacked(
        [[_wider(x[0] * 0, sum(map(abs, x[1:]), abs(x[0]))) for x in zip(*row, strict=True)] for row in rows]
    )


def _row_sums(tables: Array) -> Array:
    """The norms of largest row sums of ``(..., d, d)``."""
    return np.asarray(np.abs(tables).sum(axis=-1).max(axis=-1))


def _ball(value: float) -> arb:
    from flint import arb

    return arb(float(value))
