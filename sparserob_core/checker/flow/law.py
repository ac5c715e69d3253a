"""The law of a system, ``[A B c E]``: enclosing polynomials on stretches of time and over one box of parameters."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from fractions import Fraction
from functools import cached_property
from itertools import pairwise
from math import ceil, floor, inf, log2
from typing import final

import numpy as np
from flint import arb, arb_poly

from sparserob_core.checker.arithmetic.models import Frame, Model
from sparserob_core.checker.arithmetic.monomials import NONE, Monomials, monomials_of
from sparserob_core.checker.arithmetic.series import OUTWARD, Series, stacked, uppers
from sparserob_core.checker.flow.plant import Plant, called
from sparserob_core.checker.flow.segment import SHARP
from sparserob_core.checker.flow.units import balanced, pace
from sparserob_core.checker.outcome import Unchecked
from sparserob_core.control.problem.phase import Phase
from sparserob_core.sip.convex_set import Array

ORDER = 24  # of the law in time on a stretch; with a tenth of it stretches are a million times shorter
LONG = 2.0  # the largest norm of a law times the length of a stretch or stride; ten times more exceeds `TERMS` terms
FIRST = 8  # stretches on the whole horizon of a law that changes with time, before any is halved
SHORTEST = 2.0**-30  # of the horizon: where a shorter stretch would be needed, there is a pole as a rule


@final
@dataclass(frozen=True)
class ParameterBox:
    """A box of parameters: its ``middle (nu,)``, and half its widths, ``halves (nu,)``, all exact numbers."""

    middle: tuple[float, ...] = ()
    halves: tuple[float, ...] = ()

    @staticmethod
    def between(low: Sequence[float], high: Sequence[float]) -> ParameterBox:
        """Return a box that contains all points between two corners, with halves rounded up."""
        ends = [(a, b, (a + b) / 2) for a, b in zip(map(float, low), map(float, high), strict=True)]
        halves = [0.0 if a == b else float(np.nextafter(max(b - m, m - a), np.inf)) for a, b, m in ends]
        return ParameterBox(tuple(m for _, _, m in ends), tuple(halves))

    def wider(self, extra: Sequence[float] | Array) -> ParameterBox:
        """Return the box with ``extra (nu,)`` added at either side of every parameter."""
        halves = [h + float(x) for h, x in zip(self.halves, extra, strict=True)]
        return (
            ParameterBox(self.middle, tuple(float(np.nextafter(h, np.inf)) if h else 0.0 for h in halves))
            if any(extra)
            else self
        )

    def holds(self, other: ParameterBox) -> bool:
        """Return True where another box lies in this one; the test is exact, since sums of two floats would be
        rounded."""
        for m, h, n, k in zip(self.middle, self.halves, other.middle, other.halves, strict=True):
            if abs(Fraction(n) - Fraction(m)) + Fraction(k) > Fraction(h):
                return False
        return True

    def halved(self, axis: int) -> list[ParameterBox]:
        """Return two boxes that cover the box across one parameter up to rounding, each a little larger than half."""
        boxes = []
        for sign in (-0.5, 0.5):
            middle, halves = list(self.middle), list(self.halves)
            middle[axis] += sign * halves[axis]
            halves[axis] *= 0.5 * (1.0 + 1e-9)
            boxes.append(ParameterBox(tuple(middle), tuple(halves)))
        return boxes


@final
@dataclass(frozen=True, eq=False)
class Stretch:
    """The law on an interval of time from ``start`` to ``stop``, on which it is a polynomial.

    For every monomial of the parameters the ``table (d, d + w)`` holds polynomials in the time, which runs from -1 to 1
    across the stretch. Its balls contain the law at every time and parameter. The law is small in the ``units (d,)`` of
    the states. Where it is constant, ``stride`` is a power of two; the norm of ``A`` times it is about `LONG` at most.
    """

    start: float
    stop: float
    frame: Frame
    table: list[list[list[arb_poly]]]
    units: Array
    stride: float = inf

    @cached_property
    def is_still(self) -> bool:
        """True where the polynomials are constant; wide balls may still hold a law that changes."""
        return all(entry.length() <= 1 for table in self.table for row in table for entry in row)

    def between(self, start: float, stop: float, backwards: bool = False) -> tuple[list[Series], list[Series]]:
        """Return ``A`` and ``[B c E]`` times the length of a part of the stretch, as one series for each power of the
        share of the part that has passed, or ``backwards`` of the share that is left. The last powers of ``A`` may be
        in the balls of the first."""
        half, length = (arb(self.stop) - arb(self.start)) / 2, arb(stop) - arb(start)
        begin = (arb(stop if backwards else start) - (arb(self.start) + arb(self.stop)) / 2) / half
        shifted, d = arb_poly([begin, (-length if backwards else length) / half]), len(self.table[0])
        coefficients = [
            [[(entry(shifted) * length).coeffs() for entry in row] for row in table] for table in self.table
        ]
        order, zero = max(1, *(len(entry) for table in coefficients for row in table for entry in row)), arb(0)
        terms = []
        for k in range(order):
            tables = [[[e[k] if k < len(e) else zero for e in row] for row in table] for table in coefficients]
            terms.append(Series(self.frame.monomials, list(map(stacked, tables))))
        return _truncate_powers([term.columns(0, d) for term in terms], self.units), [
            term.columns(d, None) for term in terms
        ]

    @cached_property
    def sizes(self) -> tuple[Array, Array]:
        """The upper bounds of the absolute values of the law and of its derivative in time, ``(d, d + w)`` each."""
        half = (self.stop - self.start) / 2.0
        sizes = np.zeros((2, len(self.table[0]), len(self.table[0][0])))
        for table in self.table:
            for i, row in enumerate(table):
                for j, entry in enumerate(row):
                    for n, size in enumerate(uppers(entry.coeffs()).tolist()):
                        sizes[:, i, j] += size, size * n / half
        return sizes[0] * OUTWARD**2, sizes[1] * OUTWARD**2


def bound_entries(table: Sequence[Sequence[arb_poly]]) -> Array:
    """Return bounds ``(d, d + w)`` of the absolute values of polynomials on [-1, 1], up to rounding of floats."""
    return np.array([[sum(float(c.abs_upper()) for c in entry.coeffs()) for entry in row] for row in table])


def _sum_radii(table: Sequence[Sequence[arb_poly]]) -> Array:
    """Return the sums ``(d, d + w)`` of the radii of the coefficients of polynomials, up to rounding of floats."""
    return np.array([[sum(float(c.rad()) for c in entry.coeffs()) for entry in row] for row in table])


def _round_up_to_power(length: float) -> float:
    """Return the least power of two that is not below the length."""
    return 2.0 ** ceil(log2(length))


def _truncate_powers(A: list[Series], units: Array) -> list[Series]:
    """Return the leading powers of ``A``. The first one encloses the others, whose norms add up to at most `SHARP`."""
    sizes = [term.size for term in A]
    paces = [pace(size, units) for size in sizes]
    count = len(A)
    while count > 1 and sum(paces[count - 1 :]) <= SHARP:
        count -= 1
    return A if count == len(A) else [A[0].within(np.sum(sizes[count:], axis=0) * OUTWARD), *A[1:count]]


@final
@dataclass(frozen=True, eq=False)
class Law:
    """The law of a ``plant`` up to the time ``until`` over a ``box`` of parameters, to a ``degree`` in the parameters.
    With a ``timing`` it has the stretches of that law."""

    plant: Plant
    until: float
    box: ParameterBox
    degree: int = 0
    timing: Law | None = None

    @cached_property
    def monomials(self) -> Monomials:
        """The monomials of the parameters."""
        return monomials_of(len(self.box.middle), self.degree) if self.degree else NONE

    @cached_property
    def units(self) -> Array:
        """The units ``(d,)`` of the states, powers of two, in which the system is small."""
        A = self._sampled_sizes[0]
        return balanced(A, self.until, np.ones(A.shape[0]) / self.until)

    @cached_property
    def _sampled_sizes(self) -> tuple[Array, Array]:
        """The largest absolute values of the entries of ``A``, and of every column of ``[B c E]``, at sample times in
        the middle of the box. Units are made of them; any values would be right."""
        none = np.zeros((self.plant.states, self.plant.states + self.plant.inputs))  # where every time is skipped
        samples = np.array([none, *(np.abs(table) for table in self.plant.looked_at(self.box.middle))])
        with np.errstate(invalid="ignore"):
            A, inputs = (
                samples[..., : self.plant.states].max(axis=0),
                samples[..., self.plant.states :].max(axis=(0, 1)),
            )
        return np.where(np.isfinite(A), A, 0.0), np.where(np.isfinite(inputs) & (inputs > 0.0), inputs, 1.0)

    @cached_property
    def stretches(self) -> list[Stretch]:
        """The law on consecutive parts of the horizon, each halved where it is too long; `Unchecked` where it is not
        finite, has a pole, or is too fast."""
        if self.timing is not None:
            return [self._rebuild_stretch(stretch) for stretch in self.timing.stretches]
        spans = [(phase.begin, min(phase.until, self.until), phase) for phase in self.plant.phases]
        return [
            stretch
            for begin, until, phase in spans
            if begin < until
            for stretch in self._divide_phase(begin, until, phase)
        ]

    @cached_property
    def there(self) -> np.ndarray:
        """The entries of ``[A B c E]`` that may differ from 0 at some time and parameter, Booleans ``(d, d + w)``."""
        return np.asarray(np.any([stretch.sizes[0] > 0.0 for stretch in self.stretches], axis=0))

    @cached_property
    def weights(self) -> Array:
        """The approximate size of the part of the law that belongs to each monomial of the parameters, ``(M,)``."""
        weights = np.zeros(self.monomials.size)
        for stretch in self.stretches:
            weights += [bound_entries(table).sum() for table in stretch.table]
        return weights

    def _rebuild_stretch(self, other: Stretch) -> Stretch:
        """Return the law of this box on a stretch of the timing."""
        phase = next(phase for phase in reversed(self.plant.phases) if phase.begin <= other.start)
        frame, table = self._tabulate_law(other.start, other.stop, phase, self.monomials)
        return replace(
            other, frame=frame, table=table, stride=min(other.stride, _round_up_to_power(other.stop - other.start))
        )

    def _has_small_radii(self, radii: Array, rate: float) -> bool:
        """Return True where the radii ``(d, d + w)`` of a law are small next to its numbers."""
        d, u = self.plant.states, self.units
        is_small = pace(radii[:, :d], u) <= SHARP * max(rate, pace(self._sampled_sizes[0], u))
        return bool(is_small and (radii[:, d:] <= SHARP * self._sampled_sizes[1]).all())

    def _divide_phase(self, begin: float, until: float, phase: Phase) -> list[Stretch]:
        constant_stretch = self._enclose_constant_law(begin, until, phase)
        if constant_stretch is not None:
            return [constant_stretch]
        count = ceil(FIRST * (until - begin) / self.until)
        todo, stretches = list(pairwise(np.linspace(begin, until, count + 1).tolist()))[::-1], []
        while todo:
            start, stop = todo.pop()
            stretch = self._enclose_stretch(start, stop, phase)
            if stretch is not None:
                stretches.append(stretch)
                continue
            if stop - start <= SHORTEST * self.until:
                raise Unchecked(f"near t = {start:.9g} the system is not enclosed")
            middle = (start + stop) / 2
            todo += [(middle, stop), (start, middle)]
        return stretches

    def _enclose_constant_law(self, begin: float, until: float, phase: Phase) -> Stretch | None:
        """Return a law that does not change with time as one stretch; ``None`` where that is not shown."""
        try:
            stretch = Stretch(begin, until, *self._tabulate_law(begin, until, phase, self.monomials), self.units)
        except Unchecked:
            return None
        if not stretch.is_still or (phase.timed and self._has_hidden_dependence(stretch, phase)):
            return None
        longest, rate = _round_up_to_power(until - begin), pace(stretch.sizes[0][:, : self.plant.states], self.units)
        if not rate < 2.0**1000:
            raise Unchecked("the system is too fast for its horizon to be followed")
        return replace(stretch, stride=min(longest, 2.0 ** floor(log2(LONG / rate))) if rate > 0.0 else longest)

    def _has_hidden_dependence(self, found: Stretch, phase: Phase) -> bool:
        """Return True where wide balls hide a dependence on time: at a single time the balls are less than half as
        wide."""
        time = (found.start + found.stop) / 2
        _, table = self._tabulate_law(time, time, phase, self.monomials)
        return any(
            a.length() and float(a[0].rad()) > 2.0 * float(b[0].rad())
            for wide, sharp in zip(found.table, table, strict=True)
            for wide_row, sharp_row in zip(wide, sharp, strict=True)
            for a, b in zip(wide_row, sharp_row, strict=True)
        )

    def _enclose_stretch(self, start: float, stop: float, phase: Phase) -> Stretch | None:
        """Return the law from ``start`` to ``stop``; ``None`` where that is too long, by norms and radii in the middle
        of the box, or where the law is not finite."""
        try:
            _, middle = self._tabulate_law(start, stop, phase, NONE)
            d, u = len(middle[0]), self.units
            size = bound_entries(middle[0])
            rate, length = pace(size[:, :d], u), float((stop - start) * OUTWARD)
            if not rate * length <= LONG or not self._has_small_radii(_sum_radii(middle[0]), rate):
                return None
            table = middle if self.monomials.size == 1 else self._tabulate_law(start, stop, phase, self.monomials)[1]
        except Unchecked:
            return None
        return Stretch(start, stop, Frame(self.monomials, ORDER), table, u)

    def _tabulate_law(
        self, start: float, stop: float, phase: Phase, monomials: Monomials
    ) -> tuple[Frame, list[list[list[arb_poly]]]]:
        """Return every entry of the law from ``start`` to ``stop``, one table ``(d, d + w)`` for each monomial, and the
        frame of these polynomials."""
        frame = Frame(monomials, ORDER)
        p = np.empty(1 + len(self.box.middle), dtype=object)
        p[0] = frame.time((arb(start) + arb(stop)) / 2, (arb(stop) - arb(start)) / 2)
        for j, (middle, half) in enumerate(zip(self.box.middle, self.box.halves, strict=True)):
            wide = arb(half) if monomials.count else arb(0)
            p[1 + j] = frame.number(arb(middle)) if wide.is_zero() else frame.parameter(j, arb(middle), wide)
        values = called(phase, p)
        tables = [[[arb_poly([])] * values.shape[1] for _ in range(values.shape[0])] for _ in range(monomials.size)]
        for (i, j), value in np.ndenumerate(values):
            polynomials = value.parts if isinstance(value, Model) else [arb_poly([float(value)])]
            for k, polynomial in enumerate(polynomials):
                if polynomial is not None:
                    if not all(c.is_finite() for c in polynomial.coeffs()):
                        raise Unchecked("an entry of the system is not finite")
                    tables[k][i][j] = polynomial
        return frame, tables
