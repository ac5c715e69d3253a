"""How the state of a system that changes with time depends on its parameters: affinely, or as its expansion says.

Entries of ``B``, ``E`` and ``c`` in which parameters stand to the first power make the state an affine function of
them, ``x(t; p) = x_0(t) + sum_j (p_j - centre_j) / unit_j y_j(t)``: every part of it is a state that obeys a known
system. So do entries of ``A``, where what they multiply depends on no parameter. What is linear in the parameters is
largest at a corner of their box, whatever the times, controls and disturbances.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from math import comb
from typing import Any, TypeAlias, final

import numpy as np

from sparserob_core.control.enclosures.elementary import eccentric_anomaly
from sparserob_core.control.enclosures.matrix_exponential import EPSILON
from sparserob_core.control.enclosures.taylor import OUTWARD, TaylorSpace, taylor_space
from sparserob_core.errors import InputError
from sparserob_core.sip.convex_set import Array

Value: TypeAlias = Any
"""A float, or anything else with arithmetic, such as a `TaylorModel`."""
Table: TypeAlias = "np.ndarray"
Exponents: TypeAlias = tuple[int, ...]
MOST_POWERS = 8
"""The degree in all parameters together up to which an entry counts as a polynomial in them: of twice as many an
expansion that holds them is too large, and as an analytic function it needs no more than it shows."""
MOST_ON_CELL, NUMBERS_ON_CELL = 6, 80
"""The degree on a cell of parameters, and the coefficients times states, at most: of twice as many a cell takes three
times as long, of half as many there are three times as many cells."""
Part: TypeAlias = "dict[Exponents, Value]"
"""The coefficients of the monomials of one degree, as far as there are any."""


@final
class AnyNumber:
    """A number of which nothing is known: whatever is made of it is one too."""

    def _one(self, *_: object) -> AnyNumber:
        return self

    __add__ = __radd__ = __sub__ = __rsub__ = __mul__ = __rmul__ = __truediv__ = __rtruediv__ = __pow__ = _one
    __rpow__ = __neg__ = __pos__ = sin = cos = tan = exp = sqrt = log = tanh = kepler = _one


def _is_array(other: object) -> bool:
    """Whether numpy is to go through the entries, as where a function multiplies a whole matrix by a parameter."""
    return isinstance(other, np.ndarray) and other.ndim > 0


@final
@dataclass(frozen=True, eq=False)
class Dependent:
    """A power series in ``delta`` up to a ``degree``, whatever numbers its coefficients are: floats, Taylor models,
    balls. ``value`` is the constant one, ``others`` are those of the other monomials by their exponents, as far as
    there are any; ``beyond``: there may be more of higher degrees."""

    value: Value
    others: Mapping[Exponents, Value]
    degree: int = MOST_POWERS
    beyond: bool = False

    @property
    def free(self) -> bool:
        """Whether no parameter is in it."""
        return not self.others and not self.beyond

    def _like(self, other: object) -> Dependent:
        return other if isinstance(other, Dependent) else Dependent(other, {}, self.degree)

    def _each(self, of: Callable[[Value], Value]) -> Dependent:
        """A function that is linear, of every coefficient."""
        return Dependent(of(self.value), {key: of(one) for key, one in self.others.items()}, self.degree, self.beyond)

    def __add__(self, other: object) -> Dependent:
        if _is_array(other):
            return NotImplemented
        more = self._like(other)
        sums = _added([dict(self.others), dict(more.others)])
        return Dependent(self.value + more.value, sums, self.degree, self.beyond or more.beyond)

    def __neg__(self) -> Dependent:
        return self._each(lambda one: -one)

    def __pos__(self) -> Dependent:
        return self

    def __sub__(self, other: object) -> Dependent:
        if _is_array(other):
            return NotImplemented
        return self + -self._like(other)

    def __rsub__(self, other: object) -> Dependent:
        if _is_array(other):
            return NotImplemented
        return -self + other

    def __mul__(self, other: object) -> Dependent:
        if _is_array(other):
            return NotImplemented
        factor = self._like(other)
        if factor.free:
            return self._each(lambda one: one * factor.value)
        if self.free:
            return factor * self
        products = _added([
            {key: one * factor.value for key, one in self.others.items()},
            {key: self.value * one for key, one in factor.others.items()},
        ])  # fmt: skip
        beyond = self.beyond or factor.beyond
        for left, one in self.others.items():
            for right, two in factor.others.items():
                key = tuple(a + b for a, b in zip(left, right, strict=True))
                if sum(key) > self.degree:
                    beyond = True
                    continue
                products[key] = products[key] + one * two if key in products else one * two
        return Dependent(self.value * factor.value, products, self.degree, beyond)

    def __truediv__(self, other: object) -> Dependent:
        if _is_array(other):
            return NotImplemented
        under = self._like(other)
        return self._each(lambda one: one / under.value) if under.free else self * under.raised(-1.0)

    def __rtruediv__(self, other: object) -> Dependent:
        if _is_array(other):
            return NotImplemented
        return self._like(other) / self

    def __pow__(self, other: object) -> Dependent:
        exponent = self._like(other)
        if self.free and exponent.free:
            return Dependent(self.value**exponent.value, {}, self.degree)
        power = exponent.value
        if not (exponent.free and isinstance(power, int | float | np.floating)):
            return (exponent * self.log()).exp()
        if power < 0 or power != int(power):
            return self.raised(float(power))
        found, base, count = self._like(1.0), self, int(power)
        while count:
            found, count = found * base if count & 1 else found, count >> 1
            base = base * base if count else base
        return found

    def __rpow__(self, other: object) -> Dependent:
        return self._like(other) ** self

    __radd__, __rmul__ = __add__, __mul__

    @property
    def parts(self) -> list[Part]:
        """The coefficients degree by degree, ``degree + 1`` of them."""
        nothing = (0,) * len(next(iter(self.others), ()))
        found: list[Part] = [{nothing: self.value}, *({} for _ in range(self.degree))]
        for key, one in self.others.items():
            found[sum(key)][key] = one
        return found

    def _made(self, parts: Sequence[Part]) -> Dependent:
        """The series with these coefficients, which goes on."""
        (first,) = parts[0].values()
        return Dependent(first, {key: one for part in parts[1:] for key, one in part.items()}, self.degree, True)

    def _solved(self, first: Value, step: Callable[[int, list[Part]], Part]) -> Dependent:
        """The series that begins with a number and of which every ``step`` makes the coefficients of a degree from
        those before: along a line through the centre they are those of powers of one number, and obey what these do."""
        (nothing,) = self.parts[0]
        found: list[Part] = [{nothing: first}]
        for n in range(1, self.degree + 1):
            found.append(step(n, found))
        return self._made(found)

    def exp(self) -> Dependent:
        """The exponential, from ``g' = f' g``."""
        if self.free:
            return self._each(np.exp)
        f = self.parts
        return self._solved(np.exp(self.value), lambda n, g: _convolved((k / n, f[k], g[n - k]) for k in _upto(n)))

    def log(self) -> Dependent:
        """The natural logarithm, from ``f g' = f'``."""
        if self.free:
            return self._each(np.log)
        f, inverse = self.parts, 1.0 / self.value

        def step(n: int, g: list[Part]) -> Part:
            before = _convolved((-k / n, g[k], f[n - k]) for k in _upto(n - 1))
            return _scaled(_added([f[n], before]), inverse)

        return self._solved(np.log(self.value), step)

    def raised(self, power: float) -> Dependent:
        """A power that need be no natural number, from ``f g' = power f' g``."""
        first = self.value**power
        if self.free:
            return Dependent(first, {}, self.degree)
        f, inverse = self.parts, 1.0 / self.value

        def step(n: int, g: list[Part]) -> Part:
            return _scaled(_convolved(((k * power - (n - k)) / n, f[k], g[n - k]) for k in _upto(n)), inverse)

        return self._solved(first, step)

    def sqrt(self) -> Dependent:
        """The square root."""
        return self._each(np.sqrt) if self.free else self.raised(0.5)

    def _turned(self) -> tuple[Dependent, Dependent]:
        """Sine and cosine, from ``s' = f' c`` and ``c' = -f' s``."""
        f, (nothing,) = self.parts, self.parts[0]
        s, c = [{nothing: np.sin(self.value)}], [{nothing: np.cos(self.value)}]
        for n in _upto(self.degree):
            s.append(_convolved((k / n, f[k], c[n - k]) for k in _upto(n)))
            c.append(_convolved((-k / n, f[k], s[n - k]) for k in _upto(n)))
        return self._made(s), self._made(c)

    def sin(self) -> Dependent:
        """The sine."""
        return self._each(np.sin) if self.free else self._turned()[0]

    def cos(self) -> Dependent:
        """The cosine."""
        return self._each(np.cos) if self.free else self._turned()[1]

    def tan(self) -> Dependent:
        """The tangent."""
        if self.free:
            return self._each(np.tan)
        sine, cosine = self._turned()
        return sine / cosine

    def tanh(self) -> Dependent:
        """The hyperbolic tangent, from ``g' = h f'`` with ``h = 1 - g^2``."""
        if self.free:
            return self._each(np.tanh)
        f, first = self.parts, np.tanh(self.value)
        (nothing,) = f[0]
        h = [{nothing: 1.0 - first * first}]

        def step(n: int, g: list[Part]) -> Part:
            found = _convolved((k / n, f[k], h[n - k]) for k in _upto(n))
            whole = [*g, found]
            h.append(_convolved((-1.0, whole[k], whole[n - k]) for k in range(n + 1)))
            return found

        return self._solved(first, step)

    def kepler(self, eccentricity: float) -> Dependent:
        """The eccentric anomaly, from ``E' = M' + e E' cos E``."""
        of = self.value.kepler if hasattr(self.value, "kepler") else partial(eccentric_anomaly, self.value)
        first = of(eccentricity)
        if self.free:
            return Dependent(first, {}, self.degree)
        M, (nothing,) = self.parts, self.parts[0]
        s, c = [{nothing: np.sin(first)}], [{nothing: np.cos(first)}]
        inverse = 1.0 / (1.0 - eccentricity * c[0][nothing])

        def step(n: int, E: list[Part]) -> Part:
            before = _convolved((eccentricity * k / n, E[k], c[n - k]) for k in _upto(n - 1))
            found = _scaled(_added([M[n], before]), inverse)
            whole = [*E, found]
            s.append(_convolved((k / n, whole[k], c[n - k]) for k in _upto(n)))
            c.append(_convolved((-k / n, whole[k], s[n - k]) for k in _upto(n)))
            return found

        return self._solved(first, step)


def _upto(n: int) -> range:
    return range(1, n + 1)


def _added(parts: Iterable[Mapping[Exponents, Value]]) -> Part:
    """The sum of coefficients."""
    found: Part = {}
    for part in parts:
        for key, one in part.items():
            found[key] = found[key] + one if key in found else one
    return found


def _scaled(part: Part, factor: Value) -> Part:
    return {key: one * factor for key, one in part.items()}


def _convolved(terms: Iterable[tuple[float, Part, Part]]) -> Part:
    """The sum of products of coefficients of two degrees each, each times its number."""
    found: Part = {}
    for number, left, right in terms:
        for a, one in left.items():
            for b, two in right.items():
                key, made = tuple(i + j for i, j in zip(a, b, strict=True)), (one * two) * number
                found[key] = found[key] + made if key in found else made
    return found


@final
@dataclass(frozen=True, eq=False)
class Split:
    """A matrix that is a polynomial in ``delta (nu,)``: ``parts``, its coefficients by their exponents, ``(rows,
    columns)`` of objects each, the constant one first; of the entries ``beyond`` it is the power series, up to a
    degree."""

    parts: Mapping[Exponents, Table]
    beyond: list[tuple[int, int]]
    nu: int

    @staticmethod
    def of(entry: object, time: Value, centre: Array, units: Array, degree: int = MOST_POWERS) -> Split:
        """That of an entry of a law, an array or a function of the time and of the parameters, about their ``centre``
        and in ``units`` of theirs, 0 of a parameter that is known."""
        nu = centre.size
        p = np.empty(1 + nu, dtype=object)
        time = np.float64(time) if isinstance(time, float) else time  # which divides by 0 without an exception
        p[0] = Dependent(time, {}, degree)
        with np.errstate(all="ignore"):  # what is not finite is reported where the numbers are used
            nothing = 0.0 * time  # a number of the kind of the time, which counts what is rounded
            for j, (middle, unit) in enumerate(zip(centre.tolist(), units.tolist(), strict=True)):
                slope = {single(nu, j): nothing + unit} if unit and degree else {}
                p[1 + j] = Dependent(nothing + middle, slope, degree, bool(unit) and not degree)
            table = np.asarray(entry(p) if callable(entry) else entry, dtype=object)
        if table.ndim != 2:
            raise InputError(
                path="system", expected="matrices of arithmetic in single parameters", got="a whole matrix"
            )
        parts: dict[Exponents, Table] = {(0,) * nu: np.zeros(table.shape, dtype=object)}
        beyond = list[tuple[int, int]]()
        for place, found in np.ndenumerate(table):
            one = found if isinstance(found, Dependent) else Dependent(found, {})
            parts[(0,) * nu][place] = one.value
            if one.beyond:
                beyond.append((place[0], place[1]))
            for key, slope in one.others.items():
                if key not in parts:
                    parts[key] = np.zeros(table.shape, dtype=object)
                parts[key][place] = slope
        return Split(parts, beyond, nu)

    @property
    def whole(self) -> Table:
        """The constant coefficients, and those of each of the parameters, ``(1 + nu, rows, columns)``."""
        first = self.parts[(0,) * self.nu]
        return np.stack([first, *(self.parts.get(single(self.nu, j), np.zeros(first.shape)) for j in range(self.nu))])

    @property
    def degree(self) -> int:
        """The largest degree of an entry that is a polynomial and other than 0 at `AnyNumber`."""
        there = {key: _there(table) for key, table in self.parts.items()}
        for found in there.values():
            found[tuple(np.array(self.beyond, dtype=int).reshape(-1, 2).T)] = False
        return max((sum(key) for key, found in there.items() if found.any()), default=0)

    @property
    def there(self) -> np.ndarray:
        """Where the `whole` is other than 0 at `AnyNumber`."""
        return _there(self.whole)


def single(nu: int, j: int) -> Exponents:
    """The exponents of the parameter ``j`` itself."""
    return tuple(int(i == j) for i in range(nu))


def _there(table: Table) -> np.ndarray:
    found = np.array([isinstance(one, AnyNumber) or float(one) != 0.0 for one in table.ravel()], dtype=bool)
    return found.reshape(table.shape)


@final
@dataclass(frozen=True, eq=False)
class Dependence:
    """Which states ``y_j`` there are: those that parameter ``j`` reaches, ``reached (nu, d)``, about the ``centre
    (nu,)`` of the parameters and in ``units (nu,)`` of theirs."""

    reached: np.ndarray
    centre: Array
    units: Array

    @property
    def states(self) -> int:
        """How many states there are in all."""
        return int(self.reached.shape[1] + self.reached.sum())

    def rows(self, shares: Array) -> Array:
        """``x`` as rows on all states, ``(d, states)``, where the parameters deviate from their centre by these shares
        of their units."""
        nu, d = self.reached.shape
        axes = np.eye(d)
        return np.hstack([axes, *(shares[j] * axes[:, self.reached[j]] for j in range(nu))])

    def matrix(self, name: str, entry: object, time: Value) -> Table:
        """``A``, or one of ``B``, ``E``, ``c``, of the system of all states at a time."""
        whole, (nu, d) = Split.of(entry, time, self.centre, self.units).whole, self.reached.shape
        if name != "A":
            return np.concatenate([whole[0], *(whole[1 + j][self.reached[j]] for j in range(nu))])
        below = []
        for j in range(nu):
            mine = self.reached[j]
            row = [whole[1 + j][mine]]
            for i in range(nu):
                own = whole[0][np.ix_(mine, mine)]
                row.append(own if i == j else np.zeros((int(mine.sum()), int(self.reached[i].sum())), dtype=object))
            below.append(np.concatenate(row, axis=1))
        first = np.concatenate([whole[0], np.zeros((d, self.states - d), dtype=object)], axis=1)
        return np.concatenate([first, *below])


@final
@dataclass(frozen=True, eq=False)
class Superposed:
    """An entry of the law of all states, as a function of the time alone."""

    name: str
    entry: object
    dependence: Dependence | Spread

    def __call__(self, p: Sequence[Value]) -> Table:
        """The matrix at a time ``(1,)``."""
        return self.dependence.matrix(self.name, self.entry, p[0])


@final
@dataclass(frozen=True, eq=False)
class Left:
    """What entries are at most beyond a degree in the parameters, whatever these are: ``sizes (s, d, d + n)`` of ``[A B
    c E]`` between the times ``ends (s + 1,)``."""

    ends: Array
    sizes: Array

    def over(self, times: Array) -> Array:
        """Between every two of ``times (K + 1,)``, ``(K, d, d + n)``."""
        first = np.searchsorted(self.ends[1:-1], times[:-1], side="right")
        last = np.searchsorted(self.ends[1:-1], times[1:], side="left")
        return np.array([self.sizes[a : b + 1].max(axis=0) for a, b in zip(first, last, strict=True)])


@final
@dataclass(frozen=True, eq=False)
class Spread:
    """The state of a system of ``d`` states as a polynomial in its parameters: ``x = sum_a delta^a x_a`` and what is
    left of higher degrees. The ``x_a`` are the blocks of a larger state, in the
    order of the monomials of the ``space``, and obey ``x_a' = sum_b A_b x_(a-b) + B_a u + E_a w + c_a``; about the
    ``centre (nu,)`` of the parameters and in ``units (nu,)`` of theirs.
    Of entries that are no polynomials of that degree ``left`` tells what is beyond the degree of the space."""

    d: int
    space: TaylorSpace
    centre: Array
    units: Array
    left: Left | None = None

    @property
    def states(self) -> int:
        """How many states there are in all."""
        return self.d * self.space.size

    def on_cell(self, low: Array, high: Array, ends: Array, law: Array) -> tuple[Spread, np.ndarray]:
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
        Spread, np.ndarray
            The polynomials on the cell; and the numbers of the monomials of this space that are of their degree. What
            is beyond is `left`.
        """
        nu = self.space.nu
        degrees = [one for one in range(1, MOST_ON_CELL + 1) if self.d * comb(nu + one, nu) <= NUMBERS_ON_CELL]
        space = taylor_space(nu, max([1, *degrees]))
        kept = np.flatnonzero(self.space.degrees <= space.degree)
        beyond = law[:, self.space.degrees > space.degree].sum(axis=1)
        if self.left is not None:
            beyond = beyond + self.left.over(ends)
        left = Left(ends, beyond * OUTWARD) if beyond.any() else None
        return Spread(self.d, space, (low + high) / 2, (high - low) / 2, left), kept

    def shares(self, parameters: Array) -> Array:
        """``delta (k, nu)`` of parameters ``(k, nu)``."""
        return np.asarray((parameters - self.centre) / np.where(self.units > 0.0, self.units, 1.0))

    def filled(self, first: Array) -> Array:
        """What all coefficients become, ``(k, states, states)``, from what the constant ones do, ``(k, states, d)``."""
        left, right, target = self.space.products
        apart, size = first.reshape(len(first), self.space.size, self.d, self.d), self.space.size
        whole = np.zeros((len(first), size, size, self.d, self.d))
        whole[:, target, right] = apart[:, left]
        return whole.swapaxes(2, 3).reshape(len(first), self.states, self.states)

    def recentred(self, low: Array, high: Array) -> Array:
        """What makes of the coefficients of a polynomial in ``delta`` those, ``(M, M)``, of it on a cell ``[low,
        high]`` of parameters, from -1 to 1 in each: of the cell but for what is rounded."""
        units = np.where(self.units > 0.0, self.units, 1.0)
        middle, radius = (low + high) / 2, (high - low) / 2
        c = (middle - self.centre) / units
        r = radius / units * (1.0 + 8.0 * EPSILON) + 8.0 * EPSILON * (np.abs(low) + np.abs(high)) / units
        exponents, found = self.space.exponents, np.ones((self.space.size, self.space.size))
        for i in range(self.space.nu):
            a, b = exponents[None, :, i], exponents[:, None, i]
            binomials = np.array([[comb(int(n), int(k)) for n in a[0]] for k in b[:, 0]], dtype=float)
            found *= np.where(a >= b, binomials * c[i] ** np.maximum(a - b, 0) * r[i] ** b, 0.0)
        return found

    def matrix(self, name: str, entry: object, time: Value) -> Table:
        """``A``, or one of ``B``, ``E``, ``c``, of the system of all states at a time."""
        parts = Split.of(entry, time, self.centre, self.units, self.space.degree).parts
        places = {self.space.index[key]: table for key, table in parts.items()}
        rows, columns = parts[(0,) * self.space.nu].shape
        if name != "A":
            found = np.zeros((self.space.size, rows, columns), dtype=object)
            for place, table in places.items():
                found[place] = table
            return found.reshape(self.states, columns)
        whole = np.zeros((self.space.size, rows, self.space.size, columns), dtype=object)
        for left, right, target in zip(*(one.tolist() for one in self.space.products), strict=True):
            if left in places:
                whole[target, :, right] = places[left]
        return whole.reshape(self.states, self.states)


def dependence(laws: Sequence[Sequence[object]], centre: Array, units: Array) -> Dependence | int:
    """That of a system whose laws have these ``A``, ``B``, ``E`` and ``c`` (or ``None``), and whose parameters are at
    most ``units (nu,)`` from their ``centre``: so states are in units of what they do, and rows at a corner are sums
    and differences of them. Where the state is no affine function of the parameters, the largest degree of an entry
    that is a polynomial in them."""
    every: list[tuple[Split, list[Split]]] = []
    for entries in laws:
        parts = [Split.of(entry, AnyNumber(), centre, units) for entry in entries if entry is not None]
        every.append((parts[0], parts[1:]))
    splits = [split for A, others in every for split in (A, *others)]
    powers = max((split.degree for split in splits), default=0)
    if powers > 1 or any(split.beyond for split in splits):
        return powers
    d, nu = every[0][0].there.shape[1], centre.size
    moves = np.any([A.there[0] for A, _ in every], axis=0)
    reached = np.zeros((nu, d), dtype=bool)
    for j in range(nu):
        reached[j] = np.any([split.there[1 + j].any(axis=1) for A, others in every for split in (A, *others)], axis=0)
        for _ in range(d):
            reached[j] = reached[j] | moves[:, reached[j]].any(axis=1)
    for A, _ in every:
        if (A.there[1:].any(axis=0) & reached.any(axis=0)).any():  # columns of states that a parameter reaches
            return powers
    return Dependence(reached, centre, units)
