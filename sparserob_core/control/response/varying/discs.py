"""What entries of a system leave out of their power series in the parameters, by Cauchy's bound on discs.

An entry ``f(t, delta)`` along the line ``z delta`` through the centre of the box is a function of one complex number.
Where it is analytic for ``|z| <= R`` and at most ``M`` from a constant there, its power series up to a degree ``D``
misses at most ``M R^-D / (R - 1)`` at ``z = 1``, whatever the parameter. Values are enclosed by discs around real
numbers, at all times of a cell and for many radii ``R`` at once.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from typing import final

import numpy as np

from sparserob_core.control.enclosures.dependence import AnyNumber, Left, Split
from sparserob_core.control.enclosures.elementary import KEPLER_CIRCLES, eccentric_anomaly
from sparserob_core.control.enclosures.matrix_exponential import EPSILON
from sparserob_core.control.problem.expression import ExpressionMatrix
from sparserob_core.control.problem.phase import Phase
from sparserob_core.control.problem.system import System
from sparserob_core.errors import InputError
from sparserob_core.sip.convex_set import Array

NAMES = ("A", "B", "c", "E")  # in the order of columns: a drift is one more column of B
DEGREES = (4, 10, 20)  # at which a cell of time is judged; beyond one radius another one is the best
RADII = 1.0 + np.geomspace(0.02, 60.0, 60)
"""In multiples of the box. With ten times fewer a bound is three times what the best radius gives; a pole that is a
hundredth of the box outside of it needs a degree of a thousand."""
FIRST = 32  # cells of time to begin with
AS_GOOD = 10.0  # times what a cell's middle leaves: a wider one is halved; with 2 there are as many cells as in a proof
NOTHING = 1e-18  # of an entry's values, what may be left whatever the middle says
MOST_CELLS = 4096  # in all; halving goes on where an entry is steep
LARGEST_POWER = 64
SEARCHED = 4000  # parts of horizon and box that are looked through for a pole
TINIEST = 2.0**-20  # of horizon and box, a part without an enclosure holds a pole
OUTWARD = 1.0 + 1e-9
_ROUNDED = 16.0 * EPSILON  # of a value, more than what a function of numpy is off by


@final
class Discs:
    """Discs of the plane around real numbers: ``middle`` and ``radius``, arrays of one shape; infinite where nothing is
    known. Knows the arithmetic and the functions of expressions."""

    __slots__ = ("middle", "radius")

    def __init__(self, middle: Array, radius: Array) -> None:
        with np.errstate(all="ignore"):
            radius = (radius + _ROUNDED * np.abs(middle)) * OUTWARD
        known = np.isfinite(middle) & np.isfinite(radius)
        self.middle: Array = np.where(known, middle, 0.0)
        self.radius: Array = np.where(known, radius, np.inf)

    @staticmethod
    def _like(other: object) -> tuple[Array, Array]:
        if isinstance(other, Discs):
            return other.middle, other.radius
        return np.asarray(other, dtype=float), np.zeros(())

    def __add__(self, other: object) -> Discs:
        middle, radius = self._like(other)
        return Discs(self.middle + middle, self.radius + radius)

    def __neg__(self) -> Discs:
        return Discs(-self.middle, self.radius)

    def __pos__(self) -> Discs:
        return self

    def __sub__(self, other: object) -> Discs:
        middle, radius = self._like(other)
        return Discs(self.middle - middle, self.radius + radius)

    def __rsub__(self, other: object) -> Discs:
        return -self + other

    def __mul__(self, other: object) -> Discs:
        middle, radius = self._like(other)
        with np.errstate(all="ignore"):
            off = np.abs(self.middle) * radius + self.radius * (np.abs(middle) + radius)
        return Discs(self.middle * middle, off)

    def reciprocal(self) -> Discs:
        """``1 / z``: a disc again, of discs without 0."""
        a, r = self.middle, self.radius
        with np.errstate(all="ignore"):
            under = (np.abs(a) - r) * (np.abs(a) + r)
            return self._where(np.abs(a) > r, a / under, r / under)

    def __truediv__(self, other: object) -> Discs:
        if isinstance(other, Discs):
            return self * other.reciprocal()
        with np.errstate(all="ignore"):
            factor = np.asarray(other, dtype=float)
            return Discs(self.middle / factor, self.radius / np.abs(factor))

    def __rtruediv__(self, other: object) -> Discs:
        return self.reciprocal() * other

    def __pow__(self, other: object) -> Discs:
        if isinstance(other, Discs):
            return (other * self.log()).exp()
        power = float(other)  # type: ignore[arg-type]  # a number then
        if not power.is_integer() or abs(power) > LARGEST_POWER:
            return self._raised(power)
        found, base = Discs(np.ones(self.middle.shape), np.zeros(self.middle.shape)), self
        for _ in range(abs(int(power))):
            found = found * base
        return found if power >= 0 else found.reciprocal()

    def __rpow__(self, other: object) -> Discs:
        found: Discs = (self * np.log(np.asarray(other, dtype=float))).exp()
        return found

    __radd__, __rmul__ = __add__, __mul__

    @staticmethod
    def _where(known: np.ndarray, middle: Array, radius: Array) -> Discs:
        return Discs(np.where(known, middle, 0.0), np.where(known, radius, np.inf))

    def _raised(self, power: float) -> Discs:
        """A power of discs to the right of 0, from ``|(1 + w)^a - 1| <= (1 - |w|)^-|a| - 1``, and ``(1 + |w|)^a + 1``
        where ``a`` is positive; of a root ``1 - (1 - |w|)^a``, whose coefficients are the same but for signs."""
        a, share = self.middle, self.radius / np.where(self.middle > 0.0, self.middle, 1.0)
        with np.errstate(all="ignore"):
            middle, rest = a**power, np.log1p(-np.minimum(share, 1.0))
            off = -np.expm1(power * rest) if 0.0 < power <= 1.0 else np.expm1(-abs(power) * rest)
            off = np.minimum(off, (1.0 + share) ** power + 1.0) if power > 0.0 else off
        return self._where((a > 0.0) & (share < 1.0), middle, middle * off)

    def sqrt(self) -> Discs:
        """The square root."""
        return self._raised(0.5)

    def log(self) -> Discs:
        """The natural logarithm, of discs to the right of 0."""
        a, share = self.middle, self.radius / np.where(self.middle > 0.0, self.middle, 1.0)
        known = (a > 0.0) & (share < 1.0)
        return self._where(known, np.log(np.where(known, a, 1.0)), -np.log1p(-np.where(known, share, 0.0)))

    def exp(self) -> Discs:
        """The exponential."""
        with np.errstate(all="ignore"):
            middle = np.exp(self.middle)
            return Discs(middle, middle * np.expm1(self.radius))

    def sin(self) -> Discs:
        """The sine, from its sum ``sin a cos z + cos a sin z``."""
        return self._turned(np.sin(self.middle), np.cos(self.middle))

    def cos(self) -> Discs:
        """The cosine."""
        return self._turned(np.cos(self.middle), np.sin(self.middle))

    def _turned(self, value: Array, other: Array) -> Discs:
        with np.errstate(all="ignore"):
            r = self.radius
            off = np.abs(value) * (np.cosh(r) - 1.0) + (np.abs(other) + _ROUNDED) * np.sinh(r)
        return Discs(value, off + _ROUNDED * np.where(np.isfinite(r), r, 0.0) + _ROUNDED)

    def tan(self) -> Discs:
        """The tangent, from that of a sum; ``|tan z| <= tan |z|``."""
        return self._tangent(np.tan(self.middle), 1.0)

    def tanh(self) -> Discs:
        """The hyperbolic tangent, in the same way; ``|tanh z| <= tan |z|``."""
        return self._tangent(np.tanh(self.middle), -1.0)

    def _tangent(self, value: Array, sign: float) -> Discs:
        with np.errstate(all="ignore"):
            far = np.tan(np.minimum(self.radius, 1.57))
            under = 1.0 - np.abs(value) * far
            return self._where(
                (self.radius < 1.57) & (under > 1e-6), value, ((1.0 + sign * value**2) + _ROUNDED) * far / under
            )

    def kepler(self, eccentricity: float) -> Discs:
        """The ``E`` with ``E - e sin E = M``: within the smallest circle that Rouche's theorem allows. On ``|E - E_0| =
        R`` the anomaly differs from its tangent by at most ``e (|sin E_0| (cosh R - 1) + |cos E_0| (sinh R - R))``."""
        e, E = eccentricity, np.asarray(eccentric_anomaly(self.middle, eccentricity))
        slope, found = 1.0 - e * np.cos(E), np.full(E.shape, np.inf)
        for step in range(2 * KEPLER_CIRCLES):
            R = 4.0 * 0.85**step
            bent = e * (np.abs(np.sin(E)) * (np.cosh(R) - 1.0) + np.abs(np.cos(E)) * (np.sinh(R) - R))
            found = np.where(R * slope - bent - 1e-9 * R > self.radius, R, found)  # what is rounded is far less
        return Discs(E, found + _ROUNDED * (np.abs(self.middle) + 1.0) / slope)


@final
@dataclass(frozen=True, eq=False)
class Cauchy:
    """The entries of a system on discs over cells of time: ``far (s, r, d, d + n)``, how far those of ``[A B c E]`` are
    from a constant, between ``ends (s + 1,)`` and for all `RADII`; ``sizes (d, d + n)``: about how large they are."""

    system: System
    ends: Array
    far: Array
    sizes: Array

    def left(self, degree: int) -> Left:
        """What is beyond a degree, of entries that are no polynomials of it."""
        sizes = _least(self.far, degree)
        sizes[:, ~beyond(self.system, degree)] = 0.0
        return Left(self.ends, sizes)

    def share(self, degree: int, units: Array) -> float:
        """About what `left` makes of states in ``units (d,)``: of ``A`` over the horizon, of inputs as a share of what
        they do."""
        d, sizes = units.size, self.left(degree).sizes / units[:, None]
        A = (sizes[:, :, :d] * units).sum(axis=2).max(axis=1) @ np.diff(self.ends)
        inputs, whole = sizes[:, :, d:].max(axis=(0, 1)), (self.sizes[:, d:] / units[:, None]).max(axis=0)
        return float(A + (inputs / np.where(whole > 0.0, whole, 1.0)).max(initial=0.0))


def cauchy(system: System) -> Cauchy:
    """The entries of a system with parameters on discs; raises `InputError`, which names an entry, a time and
    parameters, where one has a pole or is no real number."""
    wanted, ends, found, sizes = beyond(system, 0), [0.0], list[Array](), list[Array]()
    for law in system.phases:
        count = max(1, int(np.ceil(FIRST * (law.until - law.begin) / system.horizon)))
        for _, stop, far, size in _Law(system, law).cells(np.linspace(law.begin, law.until, count + 1), wanted):
            ends.append(stop)
            found.append(far)
            sizes.append(size + far[0])
    return Cauchy(system, np.array(ends), np.array(found), np.max(sizes, axis=0))


@final
@dataclass(frozen=True, eq=False)
class _Law:
    """``[A B c E]`` of one law of a system."""

    system: System
    law: Phase

    @cached_property
    def places(self) -> list[tuple[str, int]]:
        """Of which matrix every column is, and which of its columns."""
        shapes = {name: self.law._shape(name) for name in NAMES if self.law.entry(name) is not None}
        return [(name, j) for name, (_, columns) in shapes.items() for j in range(columns)]

    def on(self, time: Discs, parameters: list[Discs]) -> tuple[Array, Array]:
        """The entries' discs, ``(..., d, d + n)`` each."""
        shape, d = time.middle.shape, self.law.states
        p = np.empty(1 + len(parameters), dtype=object)
        p[0], p[1:] = time, parameters
        middle, radius = (np.zeros((*shape, d, len(self.places))) for _ in range(2))
        column = 0
        for name in NAMES:
            entry = self.law.entry(name)
            if entry is None:
                continue
            with np.errstate(all="ignore"):
                table = np.asarray(entry(p) if callable(entry) else entry, dtype=object)
            for (i, j), one in np.ndenumerate(table):
                part = (..., i, column + j)
                middle[part], radius[part] = (one.middle, one.radius) if isinstance(one, Discs) else (float(one), 0.0)
            column += table.shape[1]
        return middle, radius

    def over(self, starts: Array, stops: Array) -> tuple[Array, Array]:
        """How large entries are in the middle, ``(s, d, d + n)``, and how far from there, ``(s, r, d, d + n)``, at
        all times of cells and on all `RADII`."""
        centre, units = self.system.deviations
        middles = (starts + stops) / 2
        halves = np.maximum(stops - middles, middles - starts)
        time = Discs(*(np.repeat(one[:, None], RADII.size, axis=1) for one in (middles, halves)))
        none = np.zeros(time.middle.shape)
        middle, radius = self.on(time, [Discs(none + c, none + u * RADII) for c, u in zip(centre, units, strict=True)])
        return np.abs(middle).max(axis=1), radius

    def cells(self, cuts: Array, wanted: np.ndarray) -> Iterator[tuple[float, float, Array, Array]]:
        """Cells of time between the ``cuts``, one after another, with how far entries are from a constant there; halved
        where those that are ``wanted (d, d + n)`` leave much more than in the middle of a cell."""
        starts, stops, done = cuts[:-1], cuts[1:], list[tuple[float, float, Array, Array]]()
        while starts.size:
            middles = (starts + stops) / 2
            sizes, wide = self.over(starts, stops)
            there = self.over(middles, middles)[1]
            good = np.ones(starts.size, dtype=bool)
            for degree in DEGREES:
                mine, least = (_least(one, degree)[:, wanted] for one in (wide, there))
                for k in np.flatnonzero(~np.isfinite(least).all(axis=1)):
                    self._without_pole(float(starts[k]), float(stops[k]), wanted)
                good &= (mine <= AS_GOOD * least + NOTHING * sizes[:, wanted]).all(axis=1)
            good |= len(done) + 2 * starts.size > MOST_CELLS
            done += [(float(starts[k]), float(stops[k]), wide[k], sizes[k]) for k in np.flatnonzero(good)]
            halved = [(starts[~good], middles[~good]), (middles[~good], stops[~good])]
            starts, stops = (np.concatenate([one[side] for one in halved]) for side in range(2))
        yield from sorted(done, key=lambda one: one[0])

    def _without_pole(self, start: float, stop: float, wanted: np.ndarray) -> None:
        """Raise `InputError` where an entry that is ``wanted`` has a pole, or is no real number, at a time and
        parameters."""
        box = self.system.box
        lower, upper = np.append(start, box.lower), np.append(stop, box.upper)
        widths, todo = np.maximum(upper - lower, np.finfo(float).tiny), [(lower, upper)]
        for _ in range(SEARCHED):
            if not todo:
                return
            low, high = todo.pop()
            middle = (low + high) / 2
            every = [
                Discs(np.array(m), np.array(r))
                for m, r in zip(middle, np.maximum(high - middle, middle - low), strict=True)
            ]
            lost = ~np.isfinite(self.on(every[0], every[1:])[1]) & wanted
            if not lost.any():
                continue
            shares = (high - low) / widths
            if shares.max() <= TINIEST:
                raise self._has_pole(np.argwhere(lost)[0], middle)
            axis = int(shares.argmax())
            for side in range(2):
                part = low.copy(), high.copy()
                part[1 - side][axis] = middle[axis]
                todo.append(part)

    def _has_pole(self, place: np.ndarray, at: Array) -> InputError:
        row, column = place.tolist()
        name, j = self.places[column]
        entry = self.law.entry(name)
        text = entry.entries[row][j].text if isinstance(entry, ExpressionMatrix) else "a function of them"
        phases = self.system.phases
        where = f"system.pieces.{phases.index(self.law)}" if len(phases) > 1 else "system"
        told = self.system.describe(at[1:])
        return InputError(
            path=where,  # the entry tells itself where it is: a drift may be one more column of B by now
            expected="entries that are real numbers at all times of the horizon and all parameters, without a pole",
            got=f"{text}, which has a pole or is no real number near t = {at[0]:.6g}, {told}",
        )


def _least(far: Array, degree: int) -> Array:
    """What is beyond a degree by the best of the `RADII`, ``(s, d, d + n)``, of entries that go so ``far (s, r, d, d +
    n)`` from a constant."""
    with np.errstate(all="ignore"):
        found = far * (RADII ** -float(degree) / (RADII - 1.0))[:, None, None]
    return np.asarray(found.min(axis=1) * OUTWARD)


def beyond(system: System, degree: int) -> np.ndarray:
    """Which entries of ``[A B c E]`` are no polynomials of so high a degree at most, ``(d, d + n)``."""
    tables = []
    for law in system.phases:
        parts = []
        for name in NAMES:
            if law.entry(name) is not None:
                found = np.zeros(law._shape(name), dtype=bool)
                split = Split.of(law.entry(name), AnyNumber(), *system.deviations, degree)
                for place in split.beyond:
                    found[place] = True
                parts.append(found)
        tables.append(np.hstack(parts))
    return np.asarray(np.any(tables, axis=0))
