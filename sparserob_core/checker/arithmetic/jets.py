"""Taylor coefficients in the parameters, as balls: at a point for the polynomial part, at a whole box for Lagrange's
remainder."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import lru_cache
from itertools import product
from typing import TYPE_CHECKING, Any, final

import numpy as np
import numpy.typing as npt

from sparserob_core.checker.outcome import Unchecked
from sparserob_core.control.problem.expression import ExpressionMatrix

if TYPE_CHECKING:
    from flint import arb, arb_mat, arb_series

    from sparserob_core.control.problem.system import LinearSystem

_LARGEST_POWER = 64
_NEWTON = 80  # steps, each halves at least; with a tenth of them long ellipses get wide balls


@final
@dataclass(frozen=True)
class Monomials:
    """The monomials of at most ``degree`` in ``count`` variables, by degree; number 0 is the constant."""

    count: int
    degree: int

    @property
    def exponents(self) -> list[tuple[int, ...]]:
        """Exponent vectors, in increasing degree."""
        return _exponents(self.count, self.degree)

    @property
    def number(self) -> dict[tuple[int, ...], int]:
        """The place of an exponent vector."""
        return _places(self.count, self.degree)

    @property
    def products(self) -> list[tuple[int, int, int]]:
        """All ``(i, j, k)`` with monomial ``i`` times monomial ``j`` equal to monomial ``k``."""
        return _products(self.count, self.degree)

    @property
    def products_with(self) -> list[list[tuple[int, int]]]:
        """The same for every monomial ``i``: all ``(j, k)``."""
        return _products_with(self.count, self.degree)

    @property
    def size(self) -> int:
        return len(self.exponents)


@lru_cache(maxsize=64)
def _exponents(count: int, degree: int) -> list[tuple[int, ...]]:
    every = [e for e in product(range(degree + 1), repeat=count) if sum(e) <= degree]
    return sorted(every, key=lambda e: (sum(e), e))


@lru_cache(maxsize=64)
def _places(count: int, degree: int) -> dict[tuple[int, ...], int]:
    return {e: i for i, e in enumerate(_exponents(count, degree))}


@lru_cache(maxsize=64)
def _products_with(count: int, degree: int) -> list[list[tuple[int, int]]]:
    found: list[list[tuple[int, int]]] = [[] for _ in _exponents(count, degree)]
    for i, j, k in _products(count, degree):
        found[i].append((j, k))
    return found


@lru_cache(maxsize=64)
def _products(count: int, degree: int) -> list[tuple[int, int, int]]:
    places, every = _places(count, degree), _exponents(count, degree)
    return [
        (i, j, places[g])
        for i, e in enumerate(every)
        for j, f in enumerate(every)
        if sum(e) + sum(f) <= degree
        for g in [tuple(a + b for a, b in zip(e, f, strict=True))]
    ]


@final
class Jet:
    """A truncated power series in the parameters; arithmetic and the functions of expressions act on it."""

    __slots__ = ("coefficients", "monomials")

    def __init__(self, monomials: Monomials, coefficients: Sequence[arb]) -> None:
        self.monomials, self.coefficients = monomials, list(coefficients)

    def _other(self, value: object) -> Jet:
        from flint import arb

        if isinstance(value, Jet):
            return value
        if isinstance(value, int | float | np.integer | np.floating):
            return Jet(self.monomials, [arb(float(value))] + [arb(0)] * (self.monomials.size - 1))
        raise Unchecked(f"an entry of the system holds a {type(value).__name__}, expected a number")

    def __add__(self, other: object) -> Jet:
        return Jet(
            self.monomials, [a + b for a, b in zip(self.coefficients, self._other(other).coefficients, strict=True)]
        )

    def __neg__(self) -> Jet:
        return Jet(self.monomials, [-a for a in self.coefficients])

    def __pos__(self) -> Jet:
        return self

    def __sub__(self, other: object) -> Jet:
        return self + -self._other(other)

    def __rsub__(self, other: object) -> Jet:
        return self._other(other) - self

    def __mul__(self, other: object) -> Jet:
        from flint import arb

        left, right = self.coefficients, self._other(other).coefficients
        here, there = ([not a.is_zero() for a in side] for side in (left, right))
        total = [arb(0)] * self.monomials.size
        for i, j, k in self.monomials.products:
            if here[i] and there[j]:
                total[k] = total[k] + left[i] * right[j]
        return Jet(self.monomials, total)

    def __truediv__(self, other: object) -> Jet:
        return self * self._other(other)._composed(lambda series: 1 / series)

    def __rtruediv__(self, other: object) -> Jet:
        return self._other(other) / self

    def __pow__(self, other: object) -> Jet:
        if (
            isinstance(other, int | float | np.integer | np.floating)
            and float(other).is_integer()
            and 0 <= other <= _LARGEST_POWER
        ):
            result = self._other(1.0)
            for _ in range(int(other)):
                result = result * self
            return result
        return (self._other(other) * self.log()).exp()

    def __rpow__(self, other: object) -> Jet:
        return self._other(other) ** self

    __radd__, __rmul__ = __add__, __mul__

    def kepler(self, eccentricity: float) -> Jet:
        """The ``E`` with ``E - e sin E`` equal to this series: its coefficients in balls around the root, from
        ``E' = 1 / (1 - e cos E)``."""
        return self._composed(lambda series: kepler_series(series, eccentricity, self.monomials.degree + 1))

    def _composed(self, function: Callable[[Any], Any]) -> Jet:
        """``f`` of this series: the series of ``f`` at its constant term, with what is left of it put in."""
        from flint import arb, arb_series, ctx

        with ctx.extraprec(20):
            before, ctx.cap = ctx.cap, self.monomials.degree + 1
            try:
                outer = function(arb_series([self.coefficients[0], arb(1)], self.monomials.degree + 1))
            finally:
                ctx.cap = before
        step, power, result = Jet(self.monomials, [arb(0), *self.coefficients[1:]]), self._other(1.0), self._other(0.0)
        for order in range(self.monomials.degree + 1):
            result = result + power * Jet(self.monomials, [outer[order], *[arb(0)] * (self.monomials.size - 1)])
            power = power * step
        if not all(a.is_finite() for a in result.coefficients):
            raise Unchecked("an entry of the system is not finite on a cell of parameters")
        return result

    def exp(self) -> Jet:
        return self._composed(lambda s: s.exp())

    def sin(self) -> Jet:
        return self._composed(lambda s: s.sin())

    def cos(self) -> Jet:
        return self._composed(lambda s: s.cos())

    def tan(self) -> Jet:
        return self._composed(lambda s: s.tan())

    def log(self) -> Jet:
        return self._composed(lambda s: s.log())

    def sqrt(self) -> Jet:
        return self._composed(lambda s: s.sqrt())

    def tanh(self) -> Jet:
        twice = (self * 2.0).exp()
        return (twice - 1.0) / (twice + 1.0)


def kepler_series(anomaly: arb_series, eccentricity: float, length: int) -> arb_series:
    """The first ``length`` terms of the ``E`` with ``E - e sin E`` equal to a series ``M``, whatever number of a ball
    its constant is: from ``E' = M' + e E' cos E``, term by term."""
    from flint import arb, arb_series

    e, M = arb(eccentricity), anomaly[0]
    E = [kepler_root(arb(M.lower()), e).union(kepler_root(arb(M.upper()), e))]  # E increases with M
    s, c = [E[0].sin()], [E[0].cos()]
    slope = 1 - e * c[0]
    for n in range(length - 1):
        moved = [(k + 1) * one for k, one in enumerate(E[1:])]
        pushed = sum((moved[k] * c[n - k] for k in range(n)), arb(0))
        E.append(((n + 1) * anomaly[n + 1] + e * pushed) / (slope * (n + 1)))
        moved.append((n + 1) * E[-1])
        s.append(sum((moved[k] * c[n - k] for k in range(n + 1)), arb(0)) / (n + 1))
        c.append(-sum((moved[k] * s[n - k] for k in range(n + 1)), arb(0)) / (n + 1))
    return arb_series(E, length)


def kepler_root(anomaly: arb, e: arb) -> arb:
    """A ball around the ``E`` with ``E - e sin E = M`` of a number ``M``: by Newton's method, and then as far to either
    side as the sign of the equation shows."""
    from flint import arb, ctx

    E = anomaly
    low, high = anomaly - e, anomaly + e
    for _ in range(_NEWTON):
        missed = arb((E - e * E.sin() - anomaly).mid())
        if missed > 0:
            high = E
        else:
            low = E
        E = arb((E - missed / (1 - e * E.cos())).mid())
        if not (low <= E <= high):
            E = arb(((low + high) / 2).mid())
    width = arb(2) ** (8 - ctx.prec) * (1 + abs(anomaly))
    for _ in range(ctx.prec):
        below, above = E - width, E + width
        if below - e * below.sin() < anomaly and above - e * above.sin() > anomaly:
            return below.union(above)
        width = 4 * width
    raise Unchecked("Kepler's equation is not solved")


def expanded(
    system: LinearSystem, monomials: Monomials, base: Sequence[arb], radius: Sequence[float]
) -> dict[str, list[arb_mat]]:
    """Taylor coefficients of ``A``, ``B``, ``E`` at ``base (nu,)`` in ``delta``, ``p = base + radius * delta``: a
    matrix per monomial. A drift ``c`` is one more column of ``B``, whose input is always 1.

    ``base`` may be wide balls: then every coefficient holds those at every parameter in them.
    """
    from flint import arb, arb_mat

    zeros = [arb(0)] * monomials.size
    variables = np.empty(len(base), dtype=object)
    for i, value in enumerate(base):
        coefficients = list(zeros)
        coefficients[0] = value
        if monomials.degree:
            coefficients[monomials.number[tuple(int(i == j) for j in range(len(base)))]] = arb(radius[i])
        variables[i] = Jet(monomials, coefficients)
    found = {}
    for name in ("A", "B", "E"):
        values = _values(name, getattr(system, name), variables)
        if name == "B" and system.c is not None:
            values = np.hstack([values, _values("c", system.c, variables)])
        tables = [[[arb(0)] * values.shape[1] for _ in range(values.shape[0])] for _ in range(monomials.size)]
        for (row, column), value in np.ndenumerate(values):
            parts = value.coefficients if isinstance(value, Jet) else [arb(float(value)), *zeros[1:]]
            for k, part in enumerate(parts):
                tables[k][row][column] = part
        found[name] = [arb_mat(table) for table in tables]
    return found


def _values(name: str, entry: object, variables: npt.NDArray[np.object_]) -> npt.NDArray[Any]:
    if isinstance(entry, np.ndarray):
        return entry
    assert callable(entry)
    try:
        values = entry(variables)
    except (TypeError, ValueError, ArithmeticError, AttributeError) as error:
        raise Unchecked(f"the function {name} of the system cannot be expanded in the parameters: {error}") from error
    return np.array(values, dtype=object) if not isinstance(entry, ExpressionMatrix) else np.asarray(values)
