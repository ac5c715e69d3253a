"""Dependence of the state of a time-varying system on its parameters: affine, or by an expansion.

Entries of ``B``, ``E`` and ``c`` in which parameters stand to the first power make the state an affine function of the
parameters, ``x(t; p) = x_0(t) + sum_j (p_j - centre_j) / unit_j y_j(t)``: every part of it is a state that obeys a
known system. The same holds for entries of ``A`` that multiply states independent of the parameters. A function that is
linear in the parameters is largest at a corner of their box, whatever the times, controls and disturbances.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from math import comb
from typing import Any, TypeAlias, final

import numpy as np

from sparserob_core.errors import InputError
from sparserob_core.sip.convex_set import Array
from sparserob_core.sip.expressions.elementary import eccentric_anomaly
from sparserob_core.sip.expressions.rounding import EPSILON
from sparserob_core.sip.expressions.taylor import OUTWARD_FACTOR, TaylorSpace, taylor_space

Value: TypeAlias = Any
"""A float, or anything else with arithmetic, such as a `TaylorModel`."""
Table: TypeAlias = "np.ndarray"
Exponents: TypeAlias = tuple[int, ...]
MAX_ENTRY_DEGREE = 8
"""The degree in all parameters together up to which an entry counts as a polynomial in them. With twice the degree an
expansion of all terms is too large; beyond it an entry is a power series, of which only the terms that matter count."""
MAX_CELL_DEGREE, NUMBERS_ON_CELL = 6, 80
"""The degree on a cell of parameters, and the coefficients times states, at most: with twice as many a cell takes three
times as long, with half as many there are three times as many cells."""
Part: TypeAlias = "dict[Exponents, Value]"
"""The coefficients of the monomials of one degree, as far as there are any."""


@final
class AnyNumber:
    """A number of which nothing is known: whatever is made of it is one too."""

    def _return_unknown(self, *_: object) -> AnyNumber:
        return self

    __add__ = __radd__ = __sub__ = __rsub__ = __mul__ = __rmul__ = __truediv__ = __rtruediv__ = __pow__ = (
        _return_unknown
    )
    __rpow__ = __neg__ = __pos__ = sin = cos = tan = exp = sqrt = log = tanh = kepler = _return_unknown


def _is_array(other: object) -> bool:
    """Return whether an operand is an array with axes, through whose entries numpy is to go.

    A function that multiplies a whole matrix by a parameter is an example.
    """
    return isinstance(other, np.ndarray) and other.ndim > 0


@final
@dataclass(frozen=True, eq=False)
class Dependent:
    """A power series in ``delta`` up to a ``degree``, with any numbers as coefficients: floats, Taylor models, balls.

    ``value`` is the constant coefficient. ``others`` are the coefficients of the other monomials by their exponents, as
    far as there are any. ``beyond``: there may be terms of higher degrees.
    """

    value: Value
    others: Mapping[Exponents, Value]
    degree: int = MAX_ENTRY_DEGREE
    beyond: bool = False

    @property
    def free(self) -> bool:
        """True where the series depends on no parameter."""
        return not self.others and not self.beyond

    def _convert_to_series(self, other: object) -> Dependent:
        return other if isinstance(other, Dependent) else Dependent(other, {}, self.degree)

    def _map_coefficients(self, of: Callable[[Value], Value]) -> Dependent:
        """Return the series with a linear function applied to every coefficient."""
        return Dependent(
            of(self.value), {key: of(coefficient) for key, coefficient in self.others.items()}, self.degree, self.beyond
        )

    def __add__(self, other: object) -> Dependent:
        if _is_array(other):
            return NotImplemented
        summand = self._convert_to_series(other)
        sums = _add_parts([dict(self.others), dict(summand.others)])
        return Dependent(self.value + summand.value, sums, self.degree, self.beyond or summand.beyond)

    def __neg__(self) -> Dependent:
        return self._map_coefficients(lambda value: -value)

    def __pos__(self) -> Dependent:
        return self

    def __sub__(self, other: object) -> Dependent:
        if _is_array(other):
            return NotImplemented
        return self + -self._convert_to_series(other)

    def __rsub__(self, other: object) -> Dependent:
        if _is_array(other):
            return NotImplemented
        return -self + other

    def __mul__(self, other: object) -> Dependent:
        if _is_array(other):
            return NotImplemented
        factor = self._convert_to_series(other)
        if factor.free:
            return self._map_coefficients(lambda value: value * factor.value)
        if self.free:
            return factor * self
        products = _add_parts([
            {key: coefficient * factor.value for key, coefficient in self.others.items()},
            {key: self.value * coefficient for key, coefficient in factor.others.items()},
        ])  # fmt: skip
        is_truncated = self.beyond or factor.beyond
        for first_key, first in self.others.items():
            for second_key, second in factor.others.items():
                key = tuple(a + b for a, b in zip(first_key, second_key, strict=True))
                if sum(key) > self.degree:
                    is_truncated = True
                    continue
                products[key] = products[key] + first * second if key in products else first * second
        return Dependent(self.value * factor.value, products, self.degree, is_truncated)

    def __truediv__(self, other: object) -> Dependent:
        if _is_array(other):
            return NotImplemented
        divisor = self._convert_to_series(other)
        return (
            self._map_coefficients(lambda value: value / divisor.value) if divisor.free else self * divisor.raised(-1.0)
        )

    def __rtruediv__(self, other: object) -> Dependent:
        if _is_array(other):
            return NotImplemented
        return self._convert_to_series(other) / self

    def __pow__(self, other: object) -> Dependent:
        exponent = self._convert_to_series(other)
        if self.free and exponent.free:
            return Dependent(self.value**exponent.value, {}, self.degree)
        power = exponent.value
        if not (exponent.free and isinstance(power, int | float | np.floating)):
            return (exponent * self.log()).exp()
        if power < 0 or power != int(power):
            return self.raised(float(power))
        product, base, count = self._convert_to_series(1.0), self, int(power)
        while count:
            product, count = product * base if count & 1 else product, count >> 1
            base = base * base if count else base
        return product

    def __rpow__(self, other: object) -> Dependent:
        return self._convert_to_series(other) ** self

    __radd__, __rmul__ = __add__, __mul__

    @property
    def parts(self) -> list[Part]:
        """The coefficients degree by degree, ``degree + 1`` of them."""
        constant = (0,) * len(next(iter(self.others), ()))
        by_degree: list[Part] = [{constant: self.value}, *({} for _ in range(self.degree))]
        for key, coefficient in self.others.items():
            by_degree[sum(key)][key] = coefficient
        return by_degree

    def _build_series(self, parts: Sequence[Part]) -> Dependent:
        """The series with these coefficients, which goes on."""
        (first,) = parts[0].values()
        return Dependent(
            first, {key: coefficient for part in parts[1:] for key, coefficient in part.items()}, self.degree, True
        )

    def _solve_recurrence(self, first: Value, step: Callable[[int, list[Part]], Part]) -> Dependent:
        """Return the series with the constant ``first``, in which ``step`` gives the coefficients of every degree from
        those of the degrees before.

        Along a line through the centre a series is one in a single number, with the parts of a degree as coefficients.
        So the recurrences of such series hold for the parts.
        """
        (constant,) = self.parts[0]
        parts: list[Part] = [{constant: first}]
        for n in range(1, self.degree + 1):
            parts.append(step(n, parts))
        return self._build_series(parts)

    def exp(self) -> Dependent:
        """The exponential, from ``g' = f' g``."""
        if self.free:
            return self._map_coefficients(np.exp)
        f = self.parts
        return self._solve_recurrence(
            np.exp(self.value), lambda n, g: _convolve_parts((k / n, f[k], g[n - k]) for k in _list_orders(n))
        )

    def log(self) -> Dependent:
        """The natural logarithm, from ``f g' = f'``."""
        if self.free:
            return self._map_coefficients(np.log)
        f, inverse = self.parts, 1.0 / self.value

        def step(n: int, g: list[Part]) -> Part:
            before = _convolve_parts((-k / n, g[k], f[n - k]) for k in _list_orders(n - 1))
            return _scale_part(_add_parts([f[n], before]), inverse)

        return self._solve_recurrence(np.log(self.value), step)

    def raised(self, power: float) -> Dependent:
        """A power that need be no natural number, from ``f g' = power f' g``."""
        first = self.value**power
        if self.free:
            return Dependent(first, {}, self.degree)
        f, inverse = self.parts, 1.0 / self.value

        def step(n: int, g: list[Part]) -> Part:
            return _scale_part(
                _convolve_parts(((k * power - (n - k)) / n, f[k], g[n - k]) for k in _list_orders(n)), inverse
            )

        return self._solve_recurrence(first, step)

    def sqrt(self) -> Dependent:
        """The square root."""
        return self._map_coefficients(np.sqrt) if self.free else self.raised(0.5)

    def _compute_sine_cosine(self) -> tuple[Dependent, Dependent]:
        """Sine and cosine, from ``s' = f' c`` and ``c' = -f' s``."""
        f, (constant,) = self.parts, self.parts[0]
        s, c = [{constant: np.sin(self.value)}], [{constant: np.cos(self.value)}]
        for n in _list_orders(self.degree):
            s.append(_convolve_parts((k / n, f[k], c[n - k]) for k in _list_orders(n)))
            c.append(_convolve_parts((-k / n, f[k], s[n - k]) for k in _list_orders(n)))
        return self._build_series(s), self._build_series(c)

    def sin(self) -> Dependent:
        """The sine."""
        return self._map_coefficients(np.sin) if self.free else self._compute_sine_cosine()[0]

    def cos(self) -> Dependent:
        """The cosine."""
        return self._map_coefficients(np.cos) if self.free else self._compute_sine_cosine()[1]

    def tan(self) -> Dependent:
        """The tangent."""
        if self.free:
            return self._map_coefficients(np.tan)
        sine, cosine = self._compute_sine_cosine()
        return sine / cosine

    def tanh(self) -> Dependent:
        """The hyperbolic tangent, from ``g' = h f'`` with ``h = 1 - g^2``."""
        if self.free:
            return self._map_coefficients(np.tanh)
        f, first = self.parts, np.tanh(self.value)
        (constant,) = f[0]
        h = [{constant: 1.0 - first * first}]

        def step(n: int, g: list[Part]) -> Part:
            next_part = _convolve_parts((k / n, f[k], h[n - k]) for k in _list_orders(n))
            parts = [*g, next_part]
            h.append(_convolve_parts((-1.0, parts[k], parts[n - k]) for k in range(n + 1)))
            return next_part

        return self._solve_recurrence(first, step)

    def kepler(self, eccentricity: float) -> Dependent:
        """The eccentric anomaly, from ``E' = M' + e E' cos E``."""
        of = self.value.kepler if hasattr(self.value, "kepler") else partial(eccentric_anomaly, self.value)
        first = of(eccentricity)
        if self.free:
            return Dependent(first, {}, self.degree)
        M, (constant,) = self.parts, self.parts[0]
        s, c = [{constant: np.sin(first)}], [{constant: np.cos(first)}]
        inverse = 1.0 / (1.0 - eccentricity * c[0][constant])

        def step(n: int, E: list[Part]) -> Part:
            before = _convolve_parts((eccentricity * k / n, E[k], c[n - k]) for k in _list_orders(n - 1))
            next_part = _scale_part(_add_parts([M[n], before]), inverse)
            parts = [*E, next_part]
            s.append(_convolve_parts((k / n, parts[k], c[n - k]) for k in _list_orders(n)))
            c.append(_convolve_parts((-k / n, parts[k], s[n - k]) for k in _list_orders(n)))
            return next_part

        return self._solve_recurrence(first, step)


def _list_orders(n: int) -> range:
    return range(1, n + 1)


def _add_parts(parts: Iterable[Mapping[Exponents, Value]]) -> Part:
    """The sum of coefficients."""
    total: Part = {}
    for part in parts:
        for key, coefficient in part.items():
            total[key] = total[key] + coefficient if key in total else coefficient
    return total


def _scale_part(part: Part, factor: Value) -> Part:
    return {key: coefficient * factor for key, coefficient in part.items()}


def _convolve_parts(terms: Iterable[tuple[float, Part, Part]]) -> Part:
    """The sum of products of coefficients of two degrees each, each times its number."""
    total: Part = {}
    for factor, first, second in terms:
        for a, u in first.items():
            for b, v in second.items():
                key, term = tuple(i + j for i, j in zip(a, b, strict=True)), (u * v) * factor
                total[key] = total[key] + term if key in total else term
    return total


@final
@dataclass(frozen=True, eq=False)
class Split:
    """A matrix that is a polynomial in ``delta (nu,)``.

    ``parts`` are its coefficients by their exponents, ``(rows, columns)`` of objects each, the constant one first. The
    entries at the positions ``beyond`` are power series, of which the coefficients go up to a degree.
    """

    parts: Mapping[Exponents, Table]
    beyond: list[tuple[int, int]]
    nu: int

    @staticmethod
    def of(entry: object, time: Value, centre: Array, units: Array, degree: int = MAX_ENTRY_DEGREE) -> Split:
        """Return the expansion of an entry of a law in its parameters.

        Parameters
        ----------
        entry : object
            An array, or a function of the time and of the parameters.
        time : Value
            The time, a number or another object with arithmetic.
        centre, units : Array
            Centre ``(nu,)`` of the parameters, and their units ``(nu,)``, 0 for a parameter that is known.
        degree : int
            The degree in all parameters together up to which coefficients are kept.

        Returns
        -------
        Split
            The coefficients.

        Raises
        ------
        InputError
            Where the entry, or the result of the function, is not a matrix.
        """
        nu = centre.size
        p = np.empty(1 + nu, dtype=object)
        time = np.float64(time) if isinstance(time, float) else time  # which divides by 0 without an exception
        p[0] = Dependent(time, {}, degree)
        with np.errstate(all="ignore"):  # what is not finite is reported where the numbers are used
            zero = 0.0 * time  # a number of the kind of the time, which counts what is rounded
            for j, (middle, unit) in enumerate(zip(centre.tolist(), units.tolist(), strict=True)):
                coefficient = {single(nu, j): zero + unit} if unit and degree else {}
                p[1 + j] = Dependent(zero + middle, coefficient, degree, bool(unit) and not degree)
            table = np.asarray(entry(p) if callable(entry) else entry, dtype=object)
        if table.ndim != 2:
            raise InputError(
                path="system", expected="matrices of arithmetic in single parameters", got="a whole matrix"
            )
        tables: dict[Exponents, Table] = {(0,) * nu: np.zeros(table.shape, dtype=object)}
        truncated = list[tuple[int, int]]()
        for position, number in np.ndenumerate(table):
            series = number if isinstance(number, Dependent) else Dependent(number, {})
            tables[(0,) * nu][position] = series.value
            if series.beyond:
                truncated.append((position[0], position[1]))
            for key, coefficient in series.others.items():
                if key not in tables:
                    tables[key] = np.zeros(table.shape, dtype=object)
                tables[key][position] = coefficient
        return Split(tables, truncated, nu)

    @property
    def whole(self) -> Table:
        """The constant coefficients, and those of each of the parameters, ``(1 + nu, rows, columns)``."""
        first = self.parts[(0,) * self.nu]
        return np.stack([first, *(self.parts.get(single(self.nu, j), np.zeros(first.shape)) for j in range(self.nu))])

    @property
    def degree(self) -> int:
        """The largest degree of an entry that is a polynomial and other than 0 at `AnyNumber`."""
        masks = {key: _mark_nonzeros(table) for key, table in self.parts.items()}
        for mask in masks.values():
            mask[tuple(np.array(self.beyond, dtype=int).reshape(-1, 2).T)] = False
        return max((sum(key) for key, mask in masks.items() if mask.any()), default=0)

    @property
    def there(self) -> np.ndarray:
        """True where the `whole` is other than 0 at `AnyNumber`, an array of the same shape."""
        return _mark_nonzeros(self.whole)


def single(nu: int, j: int) -> Exponents:
    """The exponents of the parameter ``j`` itself."""
    return tuple(int(i == j) for i in range(nu))


def _mark_nonzeros(table: Table) -> np.ndarray:
    is_nonzero = np.array(
        [isinstance(number, AnyNumber) or float(number) != 0.0 for number in table.ravel()], dtype=bool
    )
    return is_nonzero.reshape(table.shape)


@final
@dataclass(frozen=True, eq=False)
class Dependence:
    """Affine dependence of the state on parameters: ``affected (nu, d)`` is the mask of the states ``y_j`` that
    parameter ``j`` reaches.

    The parameters are measured from their ``centre (nu,)`` in ``units (nu,)``.
    """

    affected: np.ndarray
    centre: Array
    units: Array

    @property
    def states(self) -> int:
        """Number of all states: those of the system, and those that parameters reach."""
        return int(self.affected.shape[1] + self.affected.sum())

    def rows(self, shares: Array) -> Array:
        """Return ``x`` as rows on all states, ``(d, states)``, where the parameters deviate from their centre by these
        ``shares (nu,)`` of their units."""
        nu, d = self.affected.shape
        axes = np.eye(d)
        return np.hstack([axes, *(shares[j] * axes[:, self.affected[j]] for j in range(nu))])

    def matrix(self, name: str, entry: object, time: Value) -> Table:
        """``A``, or one of ``B``, ``E``, ``c``, of the system of all states at a time."""
        tables, (nu, d) = Split.of(entry, time, self.centre, self.units).whole, self.affected.shape
        if name != "A":
            return np.concatenate([tables[0], *(tables[1 + j][self.affected[j]] for j in range(nu))])
        below = []
        for j in range(nu):
            is_affected = self.affected[j]
            row = [tables[1 + j][is_affected]]
            for i in range(nu):
                own = tables[0][np.ix_(is_affected, is_affected)]
                row.append(
                    own if i == j else np.zeros((int(is_affected.sum()), int(self.affected[i].sum())), dtype=object)
                )
            below.append(np.concatenate(row, axis=1))
        first = np.concatenate([tables[0], np.zeros((d, self.states - d), dtype=object)], axis=1)
        return np.concatenate([first, *below])


@final
@dataclass(frozen=True, eq=False)
class Superposed:
    """An entry of the law of all states, as a function of the time alone."""

    name: str
    entry: object
    dependence: Dependence | ExpandedSystem

    def __call__(self, p: Sequence[Value]) -> Table:
        """The matrix at a time ``(1,)``."""
        return self.dependence.matrix(self.name, self.entry, p[0])


@final
@dataclass(frozen=True, eq=False)
class TruncationBound:
    """Bounds of the entries of a law beyond a degree in the parameters, for all values of the parameters.

    ``sizes (s, d, d + n)`` are the bounds of ``[A B c E]`` between the times ``ends (s + 1,)``.
    """

    ends: Array
    sizes: Array

    def over(self, times: Array) -> Array:
        """Return the bounds ``(K, d, d + n)`` between neighbours of ``times (K + 1,)``."""
        first = np.searchsorted(self.ends[1:-1], times[:-1], side="right")
        last = np.searchsorted(self.ends[1:-1], times[1:], side="left")
        return np.array([self.sizes[a : b + 1].max(axis=0) for a, b in zip(first, last, strict=True)])


@final
@dataclass(frozen=True, eq=False)
class ExpandedSystem:
    """The state of a system of ``d`` states as a polynomial in its parameters, ``x = sum_a delta^a x_a``, with a
    remainder of higher degrees.

    The ``x_a`` are the blocks of a larger state, in the order of the monomials of the ``space``. They obey ``x_a' =
    sum_b A_b x_(a-b) + B_a u + E_a w + c_a``, about the ``centre (nu,)`` of the parameters and in ``units (nu,)``.
    ``remainder`` bounds the terms beyond the degree of the space, of entries that are no polynomials of that degree.
    """

    d: int
    space: TaylorSpace
    centre: Array
    units: Array
    remainder: TruncationBound | None = None

    @property
    def states(self) -> int:
        """Number of all states: ``d`` for each monomial."""
        return self.d * self.space.size

    def on_cell(self, low: Array, high: Array, ends: Array, law: Array) -> tuple[ExpandedSystem, np.ndarray]:
        """Return how the state depends on the parameters of a cell, and which coefficients of the law it keeps.

        Parameters
        ----------
        low, high : Array
            Ends ``(nu,)`` of the cell.
        ends : Array
            Times ``(s + 1,)`` between which the law is looked at.
        law : Array
            How large the coefficients ``(s, M, d, d + n)`` of ``[A B E]`` on the cell are at most.

        Returns
        -------
        ExpandedSystem, np.ndarray
            The polynomials on the cell; and the indices of the monomials of this space that are at most of their
            degree. The terms beyond this degree are bounded by their `remainder`.
        """
        nu = self.space.nu
        degrees = [
            degree for degree in range(1, MAX_CELL_DEGREE + 1) if self.d * comb(nu + degree, nu) <= NUMBERS_ON_CELL
        ]
        space = taylor_space(nu, max([1, *degrees]))
        kept = np.flatnonzero(self.space.degrees <= space.degree)
        truncated = law[:, self.space.degrees > space.degree].sum(axis=1)
        if self.remainder is not None:
            truncated = truncated + self.remainder.over(ends)
        remainder = TruncationBound(ends, truncated * OUTWARD_FACTOR) if truncated.any() else None
        return ExpandedSystem(self.d, space, (low + high) / 2, (high - low) / 2, remainder), kept

    def shares(self, parameters: Array) -> Array:
        """``delta (k, nu)`` of parameters ``(k, nu)``."""
        return np.asarray((parameters - self.centre) / np.where(self.units > 0.0, self.units, 1.0))

    def filled(self, first: Array) -> Array:
        """Return matrices ``(k, states, states)`` on all coefficients, products of polynomials, from their columns
        ``(k, states, d)`` for the constant coefficient."""
        left, right, target = self.space.products
        columns, size = first.reshape(len(first), self.space.size, self.d, self.d), self.space.size
        blocks = np.zeros((len(first), size, size, self.d, self.d))
        blocks[:, target, right] = columns[:, left]
        return blocks.swapaxes(2, 3).reshape(len(first), self.states, self.states)

    def recentred(self, low: Array, high: Array) -> Array:
        """Return the matrix ``(M, M)`` that takes the coefficients of a polynomial in ``delta`` to those on a cell of
        parameters.

        On the cell ``[low, high]`` the new variables run from -1 to 1. The cell is enlarged by a bound of its rounding.
        """
        units = np.where(self.units > 0.0, self.units, 1.0)
        middle, radius = (low + high) / 2, (high - low) / 2
        c = (middle - self.centre) / units
        r = radius / units * (1.0 + 8.0 * EPSILON) + 8.0 * EPSILON * (np.abs(low) + np.abs(high)) / units
        exponents, matrix = self.space.exponents, np.ones((self.space.size, self.space.size))
        for i in range(self.space.nu):
            a, b = exponents[None, :, i], exponents[:, None, i]
            binomials = np.array([[comb(int(n), int(k)) for n in a[0]] for k in b[:, 0]], dtype=float)
            matrix *= np.where(a >= b, binomials * c[i] ** np.maximum(a - b, 0) * r[i] ** b, 0.0)
        return matrix

    def matrix(self, name: str, entry: object, time: Value) -> Table:
        """``A``, or one of ``B``, ``E``, ``c``, of the system of all states at a time."""
        tables = Split.of(entry, time, self.centre, self.units, self.space.degree).parts
        by_index = {self.space.index[key]: table for key, table in tables.items()}
        rows, columns = tables[(0,) * self.space.nu].shape
        if name != "A":
            stacked = np.zeros((self.space.size, rows, columns), dtype=object)
            for index, table in by_index.items():
                stacked[index] = table
            return stacked.reshape(self.states, columns)
        blocks = np.zeros((self.space.size, rows, self.space.size, columns), dtype=object)
        for left, right, target in zip(*(indices.tolist() for indices in self.space.products), strict=True):
            if left in by_index:
                blocks[target, :, right] = by_index[left]
        return blocks.reshape(self.states, self.states)


def dependence(laws: Sequence[Sequence[object]], centre: Array, units: Array) -> Dependence | int:
    """Return the affine dependence of the state of a system on its parameters, or a degree where the state is not
    affine.

    The states of the dependence are the effects of whole units, so rows at a corner are sums and differences of them.

    Parameters
    ----------
    laws : sequence
        ``A``, ``B``, ``E`` and ``c`` (or ``None``) of every law of the system.
    centre : Array
        Centre ``(nu,)`` of the parameters.
    units : Array
        Largest deviation ``(nu,)`` of the parameters from their centre.

    Returns
    -------
    Dependence or int
        The dependence; or the largest degree of an entry that is a polynomial in the parameters.
    """
    split_laws: list[tuple[Split, list[Split]]] = []
    for entries in laws:
        law_splits = [Split.of(entry, AnyNumber(), centre, units) for entry in entries if entry is not None]
        split_laws.append((law_splits[0], law_splits[1:]))
    splits = [split for A, inputs in split_laws for split in (A, *inputs)]
    powers = max((split.degree for split in splits), default=0)
    if powers > 1 or any(split.beyond for split in splits):
        return powers
    d, nu = split_laws[0][0].there.shape[1], centre.size
    coupling = np.any([A.there[0] for A, _ in split_laws], axis=0)
    is_affected = np.zeros((nu, d), dtype=bool)
    for j in range(nu):
        is_affected[j] = np.any(
            [split.there[1 + j].any(axis=1) for A, inputs in split_laws for split in (A, *inputs)], axis=0
        )
        for _ in range(d):
            is_affected[j] = is_affected[j] | coupling[:, is_affected[j]].any(axis=1)
    for A, _ in split_laws:
        if (A.there[1:].any(axis=0) & is_affected.any(axis=0)).any():  # columns of states that a parameter reaches
            return powers
    return Dependence(is_affected, centre, units)
