"""Bounds of the truncation error of power series in the parameters, for the entries of a system, by Cauchy's bound on
discs.

An entry ``f(t, delta)`` along the line ``z delta`` through the centre of the box is a function of one complex number.
Let it be analytic for ``|z| <= R``, and at most ``M`` from a constant there. Then its power series up to a degree ``D``
has an error of at most ``M R^-D / (R - 1)`` at ``z = 1``, whatever the parameter. Values are enclosed by discs around
real numbers, at all times of a cell and for many radii ``R`` at once.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from typing import final

import numpy as np

from sparserob_core.control.enclosures.dependence import AnyNumber, Split, TruncationBound
from sparserob_core.control.problem.phase import Phase
from sparserob_core.control.problem.system import System
from sparserob_core.errors import InputError
from sparserob_core.sip.convex_set import Array
from sparserob_core.sip.expressions.elementary import KEPLER_CIRCLES, eccentric_anomaly
from sparserob_core.sip.expressions.expression import ExpressionMatrix
from sparserob_core.sip.expressions.rounding import EPSILON

NAMES = ("A", "B", "c", "E")  # in the order of columns: a drift is one more column of B
DEGREES = (4, 10, 20)  # at which a cell of time is judged; beyond one radius another one is the best
RADII = 1.0 + np.geomspace(0.02, 60.0, 60)
"""In multiples of the box. With ten times fewer a bound is three times what the best radius gives; a pole that is a
hundredth of the box outside of it needs a degree of a thousand."""
FIRST = 32  # cells of time to begin with
AS_GOOD = 10.0  # times what a cell's middle leaves: a wider one is halved; with 2 there are as many cells as in a proof
NOTHING = 1e-18  # of an entry's values, what may be left whatever the middle says
MAX_CELLS = 4096  # in all; halving goes on where an entry is steep
MAX_POWER = 64
SEARCHED = 4000  # parts of horizon and box that are looked through for a pole
TINIEST = 2.0**-20  # of horizon and box, a part without an enclosure holds a pole
OUTWARD = 1.0 + 1e-9
_ROUNDING = 16.0 * EPSILON  # of a value, above the rounding error of a function of numpy


@final
class Discs:
    """Discs of the plane around real numbers: ``middle`` and ``radius``, arrays of one shape; the radius is infinite
    where nothing is known. The class has the arithmetic and the functions of expressions."""

    __slots__ = ("middle", "radius")

    def __init__(self, middle: Array, radius: Array) -> None:
        with np.errstate(all="ignore"):
            radius = (radius + _ROUNDING * np.abs(middle)) * OUTWARD
        is_finite = np.isfinite(middle) & np.isfinite(radius)
        self.middle: Array = np.where(is_finite, middle, 0.0)
        self.radius: Array = np.where(is_finite, radius, np.inf)

    @staticmethod
    def _convert_operand(other: object) -> tuple[Array, Array]:
        if isinstance(other, Discs):
            return other.middle, other.radius
        return np.asarray(other, dtype=float), np.zeros(())

    def __add__(self, other: object) -> Discs:
        middle, radius = self._convert_operand(other)
        return Discs(self.middle + middle, self.radius + radius)

    def __neg__(self) -> Discs:
        return Discs(-self.middle, self.radius)

    def __pos__(self) -> Discs:
        return self

    def __sub__(self, other: object) -> Discs:
        middle, radius = self._convert_operand(other)
        return Discs(self.middle - middle, self.radius + radius)

    def __rsub__(self, other: object) -> Discs:
        return -self + other

    def __mul__(self, other: object) -> Discs:
        middle, radius = self._convert_operand(other)
        with np.errstate(all="ignore"):
            distance = np.abs(self.middle) * radius + self.radius * (np.abs(middle) + radius)
        return Discs(self.middle * middle, distance)

    def reciprocal(self) -> Discs:
        """Return ``1 / z``, which is a disc again for discs without 0."""
        a, r = self.middle, self.radius
        with np.errstate(all="ignore"):
            under = (np.abs(a) - r) * (np.abs(a) + r)
            return self._mask_unknown(np.abs(a) > r, a / under, r / under)

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
        if not power.is_integer() or abs(power) > MAX_POWER:
            return self._raise_to_power(power)
        product, base = Discs(np.ones(self.middle.shape), np.zeros(self.middle.shape)), self
        for _ in range(abs(int(power))):
            product = product * base
        return product if power >= 0 else product.reciprocal()

    def __rpow__(self, other: object) -> Discs:
        power: Discs = (self * np.log(np.asarray(other, dtype=float))).exp()
        return power

    __radd__, __rmul__ = __add__, __mul__

    @staticmethod
    def _mask_unknown(known: np.ndarray, middle: Array, radius: Array) -> Discs:
        return Discs(np.where(known, middle, 0.0), np.where(known, radius, np.inf))

    def _raise_to_power(self, power: float) -> Discs:
        """Return a power of discs to the right of 0.

        The bound is ``|(1 + w)^a - 1| <= (1 - |w|)^-|a| - 1``, and ``(1 + |w|)^a + 1`` where ``a`` is positive. For a
        root it is ``1 - (1 - |w|)^a``, whose coefficients are the same except for signs.
        """
        a, share = self.middle, self.radius / np.where(self.middle > 0.0, self.middle, 1.0)
        with np.errstate(all="ignore"):
            middle, logarithm = a**power, np.log1p(-np.minimum(share, 1.0))
            distance = -np.expm1(power * logarithm) if 0.0 < power <= 1.0 else np.expm1(-abs(power) * logarithm)
            distance = np.minimum(distance, (1.0 + share) ** power + 1.0) if power > 0.0 else distance
        return self._mask_unknown((a > 0.0) & (share < 1.0), middle, middle * distance)

    def sqrt(self) -> Discs:
        """Return the square root."""
        return self._raise_to_power(0.5)

    def log(self) -> Discs:
        """Return the natural logarithm, of discs to the right of 0."""
        a, share = self.middle, self.radius / np.where(self.middle > 0.0, self.middle, 1.0)
        is_positive = (a > 0.0) & (share < 1.0)
        return self._mask_unknown(
            is_positive, np.log(np.where(is_positive, a, 1.0)), -np.log1p(-np.where(is_positive, share, 0.0))
        )

    def exp(self) -> Discs:
        """Return the exponential."""
        with np.errstate(all="ignore"):
            middle = np.exp(self.middle)
            return Discs(middle, middle * np.expm1(self.radius))

    def sin(self) -> Discs:
        """Return the sine, from its sum ``sin a cos z + cos a sin z``."""
        return self._enclose_sine_or_cosine(np.sin(self.middle), np.cos(self.middle))

    def cos(self) -> Discs:
        """Return the cosine."""
        return self._enclose_sine_or_cosine(np.cos(self.middle), np.sin(self.middle))

    def _enclose_sine_or_cosine(self, value: Array, other: Array) -> Discs:
        with np.errstate(all="ignore"):
            r = self.radius
            distance = np.abs(value) * (np.cosh(r) - 1.0) + (np.abs(other) + _ROUNDING) * np.sinh(r)
        return Discs(value, distance + _ROUNDING * np.where(np.isfinite(r), r, 0.0) + _ROUNDING)

    def tan(self) -> Discs:
        """Return the tangent, from that of a sum; ``|tan z| <= tan |z|``."""
        return self._enclose_tangent(np.tan(self.middle), 1.0)

    def tanh(self) -> Discs:
        """Return the hyperbolic tangent, in the same way; ``|tanh z| <= tan |z|``."""
        return self._enclose_tangent(np.tanh(self.middle), -1.0)

    def _enclose_tangent(self, value: Array, sign: float) -> Discs:
        with np.errstate(all="ignore"):
            tangent = np.tan(np.minimum(self.radius, 1.57))
            under = 1.0 - np.abs(value) * tangent
            return self._mask_unknown(
                (self.radius < 1.57) & (under > 1e-6), value, ((1.0 + sign * value**2) + _ROUNDING) * tangent / under
            )

    def kepler(self, eccentricity: float) -> Discs:
        """Return the ``E`` with ``E - e sin E = M``, within the smallest circle that Rouche's theorem allows.

        On ``|E - E_0| = R`` the anomaly differs from its tangent by at most ``e (|sin E_0| (cosh R - 1) + |cos E_0|
        (sinh R - R))``.
        """
        e, E = eccentricity, np.asarray(eccentric_anomaly(self.middle, eccentricity))
        slope, radius = 1.0 - e * np.cos(E), np.full(E.shape, np.inf)
        for step in range(2 * KEPLER_CIRCLES):
            R = 4.0 * 0.85**step
            curvature = e * (np.abs(np.sin(E)) * (np.cosh(R) - 1.0) + np.abs(np.cos(E)) * (np.sinh(R) - R))
            radius = np.where(R * slope - curvature - 1e-9 * R > self.radius, R, radius)  # what is rounded is far less
        return Discs(E, radius + _ROUNDING * (np.abs(self.middle) + 1.0) / slope)


@final
@dataclass(frozen=True, eq=False)
class Cauchy:
    """Entries of a system on discs over cells of time, between ``ends (s + 1,)``.

    ``distances (s, r, d, d + n)``: bounds of the distance of the entries of ``[A B c E]`` from a constant, for all
    `RADII`. ``sizes (d, d + n)``: estimates of their absolute values.
    """

    system: System
    ends: Array
    distances: Array
    sizes: Array

    def bound_remainder(self, degree: int) -> TruncationBound:
        """Return bounds of the terms beyond a degree, of entries that are no polynomials of this degree."""
        sizes = _bound_remainder(self.distances, degree)
        sizes[:, ~beyond(self.system, degree)] = 0.0
        return TruncationBound(self.ends, sizes)

    def share(self, degree: int, units: Array) -> float:
        """Return an estimate of the effect of `bound_remainder` on states in ``units (d,)``: of ``A`` over the horizon,
        of inputs relative to their own effect."""
        d, sizes = units.size, self.bound_remainder(degree).sizes / units[:, None]
        A = (sizes[:, :, :d] * units).sum(axis=2).max(axis=1) @ np.diff(self.ends)
        inputs, input_sizes = sizes[:, :, d:].max(axis=(0, 1)), (self.sizes[:, d:] / units[:, None]).max(axis=0)
        return float(A + (inputs / np.where(input_sizes > 0.0, input_sizes, 1.0)).max(initial=0.0))


def cauchy(system: System) -> Cauchy:
    """Return the entries of a system with parameters on discs. Raise `InputError`, which names an entry, a time and
    parameters, where an entry has a pole or is no real number."""
    wanted, ends, distances, sizes = beyond(system, 0), [0.0], list[Array](), list[Array]()
    for law in system.phases:
        count = max(1, int(np.ceil(FIRST * (law.until - law.begin) / system.horizon)))
        for _, stop, distance, size in _Law(system, law).cells(np.linspace(law.begin, law.until, count + 1), wanted):
            ends.append(stop)
            distances.append(distance)
            sizes.append(size + distance[0])
    return Cauchy(system, np.array(ends), np.array(distances), np.max(sizes, axis=0))


@final
@dataclass(frozen=True, eq=False)
class _Law:
    """Matrix ``[A B c E]`` of one law of a system."""

    system: System
    law: Phase

    @cached_property
    def places(self) -> list[tuple[str, int]]:
        """Matrix of which every column is a column, and its number there."""
        shapes = {name: self.law._shape(name) for name in NAMES if self.law.entry(name) is not None}
        return [(name, j) for name, (_, columns) in shapes.items() for j in range(columns)]

    def on(self, time: Discs, parameters: list[Discs]) -> tuple[Array, Array]:
        """Return the middles and the radii of the entries' discs, ``(..., d, d + n)`` each."""
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
            for (i, j), value in np.ndenumerate(table):
                index = (..., i, column + j)
                middle[index], radius[index] = (
                    (value.middle, value.radius) if isinstance(value, Discs) else (float(value), 0.0)
                )
            column += table.shape[1]
        return middle, radius

    def over(self, starts: Array, stops: Array) -> tuple[Array, Array]:
        """Return the absolute values of the entries in the middle, ``(s, d, d + n)``, and bounds ``(s, r, d, d + n)``
        of their distance from there, at all times of cells and on all `RADII`."""
        centre, units = self.system.deviations
        middles = (starts + stops) / 2
        halves = np.maximum(stops - middles, middles - starts)
        time = Discs(*(np.repeat(values[:, None], RADII.size, axis=1) for values in (middles, halves)))
        zeros = np.zeros(time.middle.shape)
        middle, radius = self.on(
            time, [Discs(zeros + c, zeros + u * RADII) for c, u in zip(centre, units, strict=True)]
        )
        return np.abs(middle).max(axis=1), radius

    def cells(self, cuts: Array, wanted: np.ndarray) -> Iterator[tuple[float, float, Array, Array]]:
        """Yield cells of time between the ``cuts``, one after another: both ends, bounds ``(r, d, d + n)`` of the
        distance of the entries from a constant there, and their absolute values in the middle.

        A cell is halved where the bounds of the truncation errors of entries that are ``wanted (d, d + n)`` are much
        larger than at its middle.
        """
        starts, stops, accepted = cuts[:-1], cuts[1:], list[tuple[float, float, Array, Array]]()
        while starts.size:
            middles = (starts + stops) / 2
            sizes, distances = self.over(starts, stops)
            middle_distances = self.over(middles, middles)[1]
            is_good = np.ones(starts.size, dtype=bool)
            for degree in DEGREES:
                cell_bounds, middle_bounds = (
                    _bound_remainder(distance, degree)[:, wanted] for distance in (distances, middle_distances)
                )
                for k in np.flatnonzero(~np.isfinite(middle_bounds).all(axis=1)):
                    self._require_no_pole(float(starts[k]), float(stops[k]), wanted)
                is_good &= (cell_bounds <= AS_GOOD * middle_bounds + NOTHING * sizes[:, wanted]).all(axis=1)
            is_good |= len(accepted) + 2 * starts.size > MAX_CELLS
            accepted += [(float(starts[k]), float(stops[k]), distances[k], sizes[k]) for k in np.flatnonzero(is_good)]
            halved = [(starts[~is_good], middles[~is_good]), (middles[~is_good], stops[~is_good])]
            starts, stops = (np.concatenate([pair[side] for pair in halved]) for side in range(2))
        yield from sorted(accepted, key=lambda cell: cell[0])

    def _require_no_pole(self, start: float, stop: float, wanted: np.ndarray) -> None:
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
            discs = [
                Discs(np.array(m), np.array(r))
                for m, r in zip(middle, np.maximum(high - middle, middle - low), strict=True)
            ]
            is_unbounded = ~np.isfinite(self.on(discs[0], discs[1:])[1]) & wanted
            if not is_unbounded.any():
                continue
            shares = (high - low) / widths
            if shares.max() <= TINIEST:
                raise self._build_pole_error(np.argwhere(is_unbounded)[0], middle)
            axis = int(shares.argmax())
            for side in range(2):
                half = low.copy(), high.copy()
                half[1 - side][axis] = middle[axis]
                todo.append(half)

    def _build_pole_error(self, place: np.ndarray, at: Array) -> InputError:
        row, column = place.tolist()
        name, j = self.places[column]
        entry = self.law.entry(name)
        text = entry.entries[row][j].text if isinstance(entry, ExpressionMatrix) else "a function of them"
        phases = self.system.phases
        where = f"system.pieces.{phases.index(self.law)}" if len(phases) > 1 else "system"
        parameters = self.system.describe(at[1:])
        return InputError(
            path=where,  # the entry tells itself where it is: a drift may be one more column of B by now
            expected="entries that are real numbers at all times of the horizon and all parameters, without a pole",
            got=f"{text}, which has a pole or is no real number near t = {at[0]:.6g}, {parameters}",
        )


def _bound_remainder(distances: Array, degree: int) -> Array:
    """Return bounds ``(s, d, d + n)`` of the terms beyond a degree, by the best of the `RADII`, from bounds
    ``distances (s, r, d, d + n)`` of the distance of the entries from a constant."""
    with np.errstate(all="ignore"):
        bounds = distances * (RADII ** -float(degree) / (RADII - 1.0))[:, None, None]
    return np.asarray(bounds.min(axis=1) * OUTWARD)


def beyond(system: System, degree: int) -> np.ndarray:
    """Return which entries of ``[A B c E]`` are not polynomials of at most this degree in the parameters, ``(d, d +
    n)``."""
    tables = []
    for law in system.phases:
        blocks = []
        for name in NAMES:
            if law.entry(name) is not None:
                is_beyond = np.zeros(law._shape(name), dtype=bool)
                split = Split.of(law.entry(name), AnyNumber(), *system.deviations, degree)
                for index in split.beyond:
                    is_beyond[index] = True
                blocks.append(is_beyond)
        tables.append(np.hstack(blocks))
    return np.asarray(np.any(tables, axis=0))
