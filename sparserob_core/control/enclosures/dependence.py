"""How the state of a system that changes with time depends on its parameters: affinely, or not.

Entries of ``B``, ``E`` and ``c`` in which parameters stand to the first power make the state an affine function of
them, ``x(t; p) = x_0(t) + sum_j (p_j - centre_j) / unit_j y_j(t)``: every part of it is a state that obeys a known
system. So do entries of ``A``, where what they multiply depends on no parameter. What is linear in the parameters is
largest at a corner of their box, whatever the times, controls and disturbances.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any, TypeAlias, final

import numpy as np

from sparserob_core.control.enclosures.elementary import FUNCTIONS, eccentric_anomaly
from sparserob_core.sip.convex_set import Array

Value: TypeAlias = Any
"""A float, or anything else with arithmetic, such as a `TaylorModel`."""
Table: TypeAlias = "np.ndarray"
PARTS = ("A", "B", "E", "c")


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
    """``value + sum_j slopes_j delta_j``, whatever numbers these are: floats, Taylor models, balls of series. A slope
    is ``None`` where there is none; ``slopes`` are where it is no such function."""

    value: Value
    slopes: tuple[Value | None, ...] | None

    @property
    def free(self) -> bool:
        """Whether no parameter is in it."""
        return self.slopes is not None and all(one is None for one in self.slopes)

    def _like(self, other: object) -> Dependent:
        if isinstance(other, Dependent):
            return other
        return Dependent(other, None if self.slopes is None else (None,) * len(self.slopes))

    def _scaled(self, value: Value, by: Callable[[Value], Value]) -> Dependent:
        slopes = None if self.slopes is None else tuple(None if one is None else by(one) for one in self.slopes)
        return Dependent(value, slopes)

    def __add__(self, other: object) -> Dependent:
        more = self._like(other)
        if self.slopes is None or more.slopes is None:
            return Dependent(self.value, None)
        pairs = zip(self.slopes, more.slopes, strict=True)
        sums = tuple(b if a is None else a if b is None else a + b for a, b in pairs)
        return Dependent(self.value + more.value, sums)

    def __neg__(self) -> Dependent:
        return self._scaled(-self.value, lambda one: -one)

    def __pos__(self) -> Dependent:
        return self

    def __sub__(self, other: object) -> Dependent:
        return self + -self._like(other)

    def __rsub__(self, other: object) -> Dependent:
        return -self + other

    def __mul__(self, other: object) -> Dependent:
        factor = self._like(other)
        if factor.free:
            return self._scaled(self.value * factor.value, lambda one: one * factor.value)
        if self.free:
            return factor * self
        return Dependent(self.value, None)

    def __truediv__(self, other: object) -> Dependent:
        under = self._like(other)
        if not under.free:
            return Dependent(self.value, None)
        return self._scaled(self.value / under.value, lambda one: one / under.value)

    def __rtruediv__(self, other: object) -> Dependent:
        return self._like(other) / self

    def __pow__(self, other: object) -> Dependent:
        exponent = self._like(other)
        if self.free and exponent.free:
            return Dependent(self.value**exponent.value, self.slopes)
        first = isinstance(exponent.value, int | float | np.floating) and exponent.free and exponent.value == 1
        return self if first else Dependent(self.value, None)

    def __rpow__(self, other: object) -> Dependent:
        return self._like(other) ** self

    __radd__, __rmul__ = __add__, __mul__

    def of(self, function: Callable[[Value], Value]) -> Dependent:
        """A function of it, which is none that is affine where a parameter is in it."""
        return Dependent(function(self.value) if self.free else self.value, self.slopes if self.free else None)

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
    """A matrix that is ``whole[0] + sum_j whole[j] delta_j``, ``(1 + nu, rows, columns)``, objects; ``curved`` are the
    entries that are no such sum."""

    whole: Table
    curved: list[tuple[int, int]]

    @staticmethod
    def of(entry: object, time: Value, centre: Array, units: Array) -> Split:
        """That of an entry of a law, an array or a function of the time and of the parameters, about their ``centre``
        and in ``units`` of theirs, 0 of a parameter that is known."""
        nu = centre.size
        known: tuple[Value | None, ...] = (None,) * nu
        p = np.empty(1 + nu, dtype=object)
        p[0] = Dependent(time, known)
        with np.errstate(all="ignore"):  # what is not finite is reported where the numbers are used
            nothing = 0.0 * time  # a number of the kind of the time, which counts what is rounded
            for j, (middle, unit) in enumerate(zip(centre.tolist(), units.tolist(), strict=True)):
                slopes = tuple(nothing + unit if i == j and unit else None for i in range(nu))
                p[1 + j] = Dependent(nothing + middle, slopes)
            table = np.asarray(entry(p) if callable(entry) else entry, dtype=object)
        whole = np.zeros((1 + nu, *table.shape), dtype=object)
        curved = list[tuple[int, int]]()
        for place, found in np.ndenumerate(table):
            one = found if isinstance(found, Dependent) else Dependent(found, known)
            whole[(0, *place)] = one.value
            if one.slopes is None:
                curved.append((place[0], place[1]))
            for j, slope in enumerate(one.slopes or ()):
                whole[(1 + j, *place)] = 0.0 if slope is None else slope
        return Split(whole, curved)

    @property
    def there(self) -> np.ndarray:
        """Where these are other than 0 at `AnyNumber`."""
        found = np.array([isinstance(one, AnyNumber) or float(one) != 0.0 for one in self.whole.ravel()])
        return found.reshape(self.whole.shape)


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
    dependence: Dependence

    def __call__(self, p: Sequence[Value]) -> Table:
        """The matrix at a time ``(1,)``."""
        return self.dependence.matrix(self.name, self.entry, p[0])


def dependence(laws: Sequence[Sequence[object]], centre: Array, units: Array) -> Dependence | tuple[int, str, int, int]:
    """That of a system whose laws have these ``A``, ``B``, ``E`` and ``c`` (or ``None``), and whose parameters are at
    most ``units (nu,)`` from their ``centre``: so states are in units of what they do, and rows at a corner are sums
    and differences of them. Or the law, the matrix and the entry of it that make the state no affine function of the
    parameters."""
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
    d, nu = every[0][0].there.shape[1], centre.size
    moves = np.any([A.there[0] for A, _ in every], axis=0)
    reached = np.zeros((nu, d), dtype=bool)
    for j in range(nu):
        reached[j] = np.any([split.there[1 + j].any(axis=1) for A, others in every for split in (A, *others)], axis=0)
        for _ in range(d):
            reached[j] = reached[j] | moves[:, reached[j]].any(axis=1)
    for number, (A, _) in enumerate(every):
        twice = A.there[1:].any(axis=0) & reached.any(axis=0)  # columns of states that a parameter reaches
        if twice.any():
            i, j = np.argwhere(twice)[0].tolist()
            return number, "A", i, j
    return Dependence(reached, centre, units)
