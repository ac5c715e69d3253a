"""How the state of a system that changes with time depends on its parameters: affinely, or as its expansion says.

Entries of ``B``, ``E`` and ``c`` in which parameters stand to the first power make the state an affine function of
them, ``x(t; p) = x_0(t) + sum_j (p_j - centre_j) / unit_j y_j(t)``: every part of it is a state that obeys a known
system. So do entries of ``A``, where what they multiply depends on no parameter. What is linear in the parameters is
largest at a corner of their box, whatever the times, controls and disturbances.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from math import comb
from typing import Any, TypeAlias, final

import numpy as np

from sparserob_core.control.enclosures.elementary import FUNCTIONS, eccentric_anomaly
from sparserob_core.control.enclosures.matrix_exponential import EPSILON
from sparserob_core.control.enclosures.taylor import TaylorSpace
from sparserob_core.sip.convex_set import Array

Value: TypeAlias = Any
"""A float, or anything else with arithmetic, such as a `TaylorModel`."""
Table: TypeAlias = "np.ndarray"
Exponents: TypeAlias = tuple[int, ...]
Refused: TypeAlias = tuple[int, str, int, int]
PARTS = ("A", "B", "E", "c")
MOST_POWERS = 8  # of an entry in all parameters together; of twice as many an expansion that holds them is too large


@final
class AnyNumber:
    """A number of which nothing is known: whatever is made of it is one too."""

    def _one(self, *_: object) -> AnyNumber:
        return self

    __add__ = __radd__ = __sub__ = __rsub__ = __mul__ = __rmul__ = __truediv__ = __rtruediv__ = __pow__ = _one
    __rpow__ = __neg__ = __pos__ = sin = cos = tan = exp = sqrt = log = tanh = kepler = _one


@final
@dataclass(frozen=True, eq=False)
class Dependent:
    """A polynomial in ``delta``, whatever numbers its coefficients are: floats, Taylor models, balls of series.
    ``value`` is the constant one, ``others`` are those of the other monomials by their exponents, as far as there are
    any; ``None`` where it is no polynomial, or one of a degree above `MOST_POWERS`."""

    value: Value
    others: Mapping[Exponents, Value] | None

    @property
    def free(self) -> bool:
        """Whether no parameter is in it."""
        return self.others is not None and not self.others

    @staticmethod
    def _like(other: object) -> Dependent:
        return other if isinstance(other, Dependent) else Dependent(other, {})

    def _each(self, of: Callable[[Value], Value]) -> Dependent:
        """A function that is linear, of every coefficient."""
        others = None if self.others is None else {key: of(one) for key, one in self.others.items()}
        return Dependent(of(self.value), others)

    def __add__(self, other: object) -> Dependent:
        more = self._like(other)
        if self.others is None or more.others is None:
            return Dependent(self.value, None)
        sums = dict(self.others)
        for key, one in more.others.items():
            sums[key] = sums[key] + one if key in sums else one
        return Dependent(self.value + more.value, sums)

    def __neg__(self) -> Dependent:
        return self._each(lambda one: -one)

    def __pos__(self) -> Dependent:
        return self

    def __sub__(self, other: object) -> Dependent:
        return self + -self._like(other)

    def __rsub__(self, other: object) -> Dependent:
        return -self + other

    def __mul__(self, other: object) -> Dependent:
        factor = self._like(other)
        if factor.free:
            return self._each(lambda one: one * factor.value)
        if self.free:
            return factor * self
        if self.others is None or factor.others is None:
            return Dependent(self.value, None)
        products = {key: one * factor.value for key, one in self.others.items()}
        for key, one in factor.others.items():
            products[key] = products[key] + self.value * one if key in products else self.value * one
        for left, one in self.others.items():
            for right, two in factor.others.items():
                key = tuple(a + b for a, b in zip(left, right, strict=True))
                if sum(key) > MOST_POWERS:
                    return Dependent(self.value, None)
                products[key] = products[key] + one * two if key in products else one * two
        return Dependent(self.value * factor.value, products)

    def __truediv__(self, other: object) -> Dependent:
        under = self._like(other)
        return self._each(lambda one: one / under.value) if under.free else Dependent(self.value, None)

    def __rtruediv__(self, other: object) -> Dependent:
        return self._like(other) / self

    def __pow__(self, other: object) -> Dependent:
        exponent = self._like(other)
        if self.free and exponent.free:
            return Dependent(self.value**exponent.value, {})
        power = exponent.value
        if not (exponent.free and isinstance(power, int | float | np.floating) and power in range(MOST_POWERS + 1)):
            return Dependent(self.value, None)
        found = self._like(1.0)
        for _ in range(int(power)):
            found = found * self
        return found

    def __rpow__(self, other: object) -> Dependent:
        return self._like(other) ** self

    __radd__, __rmul__ = __add__, __mul__

    def of(self, function: Callable[[Value], Value]) -> Dependent:
        """A function of it, which is no polynomial where a parameter is in it."""
        return Dependent(function(self.value), {}) if self.free else Dependent(self.value, None)

    def __getattr__(self, name: str) -> Callable[[], Dependent]:
        if name not in FUNCTIONS:
            raise AttributeError(name)
        return partial(self.of, FUNCTIONS[name])

    def kepler(self, eccentricity: float) -> Dependent:
        """The eccentric anomaly."""
        found = self.value.kepler if hasattr(self.value, "kepler") else partial(eccentric_anomaly, self.value)
        return self.of(lambda _: found(eccentricity))


@final
@dataclass(frozen=True, eq=False)
class Split:
    """A matrix that is a polynomial in ``delta (nu,)``: ``parts``, its coefficients by their exponents, ``(rows,
    columns)`` of objects each, the constant one first; ``curved`` are the entries that are none."""

    parts: Mapping[Exponents, Table]
    curved: list[tuple[int, int]]
    nu: int

    @staticmethod
    def of(entry: object, time: Value, centre: Array, units: Array) -> Split:
        """That of an entry of a law, an array or a function of the time and of the parameters, about their ``centre``
        and in ``units`` of theirs, 0 of a parameter that is known."""
        nu = centre.size
        p = np.empty(1 + nu, dtype=object)
        p[0] = Dependent(time, {})
        with np.errstate(all="ignore"):  # what is not finite is reported where the numbers are used
            nothing = 0.0 * time  # a number of the kind of the time, which counts what is rounded
            for j, (middle, unit) in enumerate(zip(centre.tolist(), units.tolist(), strict=True)):
                p[1 + j] = Dependent(nothing + middle, {single(nu, j): nothing + unit} if unit else {})
            table = np.asarray(entry(p) if callable(entry) else entry, dtype=object)
        parts: dict[Exponents, Table] = {(0,) * nu: np.zeros(table.shape, dtype=object)}
        curved = list[tuple[int, int]]()
        for place, found in np.ndenumerate(table):
            one = found if isinstance(found, Dependent) else Dependent(found, {})
            parts[(0,) * nu][place] = one.value
            if one.others is None:
                curved.append((place[0], place[1]))
            for key, slope in (one.others or {}).items():
                if key not in parts:
                    parts[key] = np.zeros(table.shape, dtype=object)
                parts[key][place] = slope
        return Split(parts, curved, nu)

    @property
    def whole(self) -> Table:
        """The constant coefficients, and those of each of the parameters, ``(1 + nu, rows, columns)``."""
        first = self.parts[(0,) * self.nu]
        return np.stack([first, *(self.parts.get(single(self.nu, j), np.zeros(first.shape)) for j in range(self.nu))])

    @property
    def degree(self) -> int:
        """The largest degree of an entry that is other than 0 at `AnyNumber`."""
        return max((sum(key) for key, table in self.parts.items() if _there(table).any()), default=0)

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
class Spread:
    """The state of a system of ``d`` states, whose entries are polynomials in its parameters, as one too:
    ``x = sum_a delta^a x_a`` and what is left of higher degrees. The ``x_a`` are the blocks of a larger state, in the
    order of the monomials of the ``space``, and obey ``x_a' = sum_b A_b x_(a-b) + B_a u + E_a w + c_a``; about the
    ``centre (nu,)`` of the parameters and in ``units (nu,)`` of theirs. ``powers``: the largest degree of an entry."""

    d: int
    space: TaylorSpace
    centre: Array
    units: Array
    powers: int

    @property
    def states(self) -> int:
        """How many states there are in all."""
        return self.d * self.space.size

    def shares(self, parameters: Array) -> Array:
        """``delta (k, nu)`` of parameters ``(k, nu)``."""
        return np.asarray((parameters - self.centre) / np.where(self.units > 0.0, self.units, 1.0))

    def directions(self, directions: Array, parameters: Array) -> Array:
        """Directions ``(k, d)`` at parameters ``(k, nu)`` as such on the larger state, ``(k, states)``."""
        powers = self.space.monomials(self.shares(parameters))
        return np.asarray((powers[:, :, None] * directions[:, None]).reshape(len(directions), self.states))

    def seen(self, states: Array, parameters: Array) -> Array:
        """The states ``(k, ..., d)`` at parameters ``(k, nu)`` of larger ones ``(k, ..., states)``."""
        powers = self.space.monomials(self.shares(parameters))
        apart = states.reshape(*states.shape[:-1], self.space.size, self.d)
        return np.asarray(np.einsum("ka,k...ad->k...d", powers, apart))

    def filled(self, first: Array) -> Array:
        """What all coefficients become, ``(k, states, states)``, from what the constant ones do, ``(k, states, d)``."""
        left, right, target = self.space.products
        apart, size = first.reshape(len(first), self.space.size, self.d, self.d), self.space.size
        whole = np.zeros((len(first), size, size, self.d, self.d))
        whole[:, target, right] = apart[:, left]
        return whole.swapaxes(2, 3).reshape(len(first), self.states, self.states)

    def recentred(self, low: Array, high: Array) -> Array:
        """What makes of the coefficients of a polynomial in ``delta`` those, ``(M, M)``, of it on a cell ``[low,
        high]`` of parameters, from -1 to 1 in each; which is a little wider than the cell."""
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
        parts = Split.of(entry, time, self.centre, self.units).parts
        places = {self.space.index[key]: table for key, table in parts.items() if key in self.space.index}
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


def dependence(laws: Sequence[Sequence[object]], centre: Array, units: Array) -> Dependence | int | Refused:
    """That of a system whose laws have these ``A``, ``B``, ``E`` and ``c`` (or ``None``), and whose parameters are at
    most ``units (nu,)`` from their ``centre``: so states are in units of what they do, and rows at a corner are sums
    and differences of them. Where the state is no affine function of the parameters, the largest degree of an entry;
    or which law, matrix and entry of it are no polynomial in them."""
    every: list[tuple[Split, list[Split]]] = []
    for number, entries in enumerate(laws):
        parts = []
        for name, entry in zip(PARTS, entries, strict=True):
            if entry is None:
                continue
            split = Split.of(entry, AnyNumber(), centre, units)
            if split.curved:
                i, j = split.curved[0]
                return number, name, i, j
            parts.append(split)
        every.append((parts[0], parts[1:]))
    powers = max((split.degree for A, others in every for split in (A, *others)), default=0)
    if powers > 1:
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
