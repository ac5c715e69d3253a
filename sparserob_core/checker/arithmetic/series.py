"""Matrices that depend on the parameters: truncated power series with ball matrices as coefficients."""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import cached_property
from typing import TYPE_CHECKING, final

from sparserob_core.checker.arithmetic.jets import Monomials

if TYPE_CHECKING:
    from flint import arb, arb_mat

SMALL = 0.25  # norm below which the exponential series is summed
SPARE = 16  # bits of the working precision that what is left out of the series may take
STRIDE = 4  # of the powers by which it is summed; divides the number of terms
MOST_STRIDES = 2**60  # in one time: what takes more is no number
STRIDES_KEPT = 256  # whole numbers of strides that are remembered, beside powers of two
LEAST = 2.0**-900  # norm that counts, so that a stride is a number


@final
class Series:
    """``sum_k parts_k delta^k``; products drop what is beyond the degree of the monomials, which Lagrange's remainder
    accounts for."""

    __slots__ = ("_there", "monomials", "parts")

    def __init__(self, monomials: Monomials, parts: Sequence[arb_mat]) -> None:
        self.monomials, self.parts = monomials, list(parts)
        self._there: list[bool] | None = None

    @property
    def there(self) -> list[bool]:
        """Which coefficients are not exactly 0: those of a system are few."""
        if self._there is None:
            from flint import arb_mat

            zero = arb_mat(self.parts[0].nrows(), self.parts[0].ncols())
            absent = [part == zero for part in self.parts]  # certainly equal; != is certainly different
            self._there = [not gone for gone in absent]
        return self._there

    @property
    def generated(self) -> list[bool]:
        """Which coefficients a power of this series may have: those of monomials in the variables that appear."""
        every = self.monomials.exponents
        present = [e for e, here in zip(every, self.there, strict=True) if here]
        appear = [any(e[i] for e in present) for i in range(self.monomials.count)]
        return [all(appears or not power for appears, power in zip(appear, e, strict=True)) for e in every]

    @staticmethod
    def constant(monomials: Monomials, value: arb_mat) -> Series:
        """A matrix that does not depend on the parameters."""
        return Series(monomials, [value] + [value * 0] * (monomials.size - 1))

    def __add__(self, other: Series) -> Series:
        return Series(self.monomials, [a + b for a, b in zip(self.parts, other.parts, strict=True)])

    def __mul__(self, other: Series) -> Series:
        if self.monomials.size == 1:
            return Series(self.monomials, [self.parts[0] * other.parts[0]])
        from flint import arb_mat

        total: list[arb_mat | None] = [None] * self.monomials.size
        left, right, there, products = self.parts, other.parts, other.there, self.monomials.products_with
        for factor, pairs, here in zip(left, products, self.there, strict=True):
            for j, k in pairs if here else ():
                if there[j]:
                    term, so_far = factor * right[j], total[k]
                    total[k] = term if so_far is None else so_far + term
        zero = arb_mat(left[0].nrows(), right[0].ncols())
        return Series(self.monomials, [zero if part is None else part for part in total])

    def scaled(self, factor: arb) -> Series:
        """Every coefficient times a number."""
        return Series(self.monomials, [part * factor for part in self.parts])

    def applied(self, vector: arb_mat) -> Series:
        """The product with a matrix that does not depend on the parameters."""
        return Series(self.monomials, [part * vector for part in self.parts])

    def size(self) -> arb:
        """An upper bound of the summed Frobenius norms of the coefficients; that of a product is at most the product of
        those."""
        from flint import arb

        return sum((upper(norm(part)) for part in self.parts), arb(0))

    def exp(self) -> Series:
        """The exponential: its series where the norm is small, and squaring back (Moler and Van Loan 2003, method 3),
        with the tail bounded."""
        from flint import arb, arb_mat, ctx

        if self.monomials.size == 1:
            return Series(self.monomials, [self.parts[0].exp()])
        halvings = 0
        size = self.size()
        while not size < SMALL:
            size, halvings = size / 2, halvings + 1
            if halvings > 60:
                return Series(self.monomials, [part * arb("nan") for part in self.parts])
        small, n = self.scaled(arb(1) / 2**halvings), self.parts[0].nrows()
        unit = arb_mat([[int(i == j) for j in range(n)] for i in range(n)])
        powers = [Series.constant(self.monomials, unit), small]
        while len(powers) <= STRIDE:
            powers.append(powers[-1] * small)
        terms, left_out = STRIDE, arb(2) ** (SPARE - ctx.prec)
        while not _tail(size, terms) < left_out:
            terms += STRIDE
        factors = [1 / arb(order).fac() for order in range(terms + 1)]
        result = powers[0].scaled(factors[terms])
        for first in range(terms - STRIDE, -1, -STRIDE):  # Paterson and Stockmeyer 1973
            result = powers[STRIDE] * result
            for order in range(STRIDE):
                result = result + powers[order].scaled(factors[first + order])
        tail = arb_mat([[arb(0, _tail(size, terms).upper())] * n] * n)
        parts = [part + tail if mine else part for part, mine in zip(result.parts, self.generated, strict=True)]
        result = Series(self.monomials, parts)
        for _ in range(halvings):
            result = result * result
        return result

    def held(self, inputs: Series, time: arb) -> tuple[Series, Series]:
        """``e^{matrix time}`` and ``int_0^time e^{matrix s} ds inputs`` from one exponential (Van Loan 1978)."""
        return self.beside(inputs).scaled(time).exp().apart(self.parts[0].nrows())

    def beside(self, inputs: Series) -> Series:
        """What drives a state and an input that stays as it is."""
        from flint import arb, arb_mat

        n, m = self.parts[0].nrows(), inputs.parts[0].ncols()
        below = [[arb(0)] * (n + m)] * m
        joined = [
            arb_mat([a + b for a, b in zip(left.tolist(), right.tolist(), strict=True)] + below)
            for left, right in zip(self.parts, inputs.parts, strict=True)
        ]
        return Series(self.monomials, joined)

    def apart(self, n: int) -> tuple[Series, Series]:
        """The first ``n`` rows: of the state, and of the input."""
        from flint import arb_mat

        whole = [part.tolist() for part in self.parts]
        return (
            Series(self.monomials, [arb_mat([row[:n] for row in part[:n]]) for part in whole]),
            Series(self.monomials, [arb_mat([row[n:] for row in part[:n]]) for part in whole]),
        )


@final
class Exponentials:
    """``e^{matrix t}`` at many times ``t``. Powers of the matrix are made once: within a *stride*, in which its norm is
    below `SMALL`, an exponential is a sum of them; the longer ones are products of whole strides, each remembered. Such
    a sum costs about a product, a series of its own ten of these.

    Norms are in ``units (n,)``, powers of two: any are right, those in which the matrix is small take the fewest
    strides.
    """

    def __init__(self, matrix: Series, tick: float, units: Sequence[float] | None = None) -> None:
        self.matrix, self.tick = matrix, tick
        self._units = [1.0] * matrix.parts[0].nrows() if units is None else list(map(float, units))
        self._known: dict[int, Series] = {}
        self._strides: dict[int, Series] = {}

    def at(self, ticks: int) -> Series:
        """After that many ticks, exactly."""
        from flint import arb

        if ticks not in self._known:
            self._known[ticks] = self.of(arb(self.tick) * ticks)
        return self._known[ticks]

    def around(self, ticks: int) -> Series:
        """From so many ticks before to so many after."""
        from flint import arb

        return self.of(arb(0, self.tick * ticks))

    def of(self, time: arb) -> Series:
        """At every time of a ball that is not much wider than a stride."""
        from flint import arb

        stride = self._stride
        count = 0 if stride is None else math.floor(min(float(time.mid()) / stride, MOST_STRIDES))
        if stride is None or not count < MOST_STRIDES:
            return self._none()
        if not count > 0:
            return self._near(time)
        return self._whole(count) * self._near(time - arb(stride) * count)

    def within(self, length: arb) -> Series:
        """At every time from 0 to the ``length``."""
        from flint import arb

        halvings = 0
        while not self._size * length < SMALL:
            length, halvings = length / 2, halvings + 1
            if halvings > 60:
                return self._none()
        found = self._near(arb(0).union(length))
        for _ in range(halvings):
            found = found * found
        return found

    def power(self, order: int) -> Series:
        """A power of the matrix."""
        while len(self._powers) <= order:
            self._powers.append(self.matrix * self._powers[-1])
        return self._powers[order]

    @cached_property
    def _powers(self) -> list[Series]:
        from flint import arb_mat

        n = self.matrix.parts[0].nrows()
        unit = arb_mat([[int(i == j) for j in range(n)] for i in range(n)])
        return [Series.constant(self.matrix.monomials, unit), self.matrix]

    @cached_property
    def _size(self) -> arb:
        """`Series.size` of the matrix in the units."""
        from flint import arb_mat

        n, u = len(self._units), self._units
        left, right = (
            arb_mat([[factors[i] if i == j else 0 for j in range(n)] for i in range(n)])
            for factors in ([1.0 / x for x in u], u)
        )
        return Series(self.matrix.monomials, [left * part * right for part in self.matrix.parts]).size()

    @cached_property
    def _stride(self) -> float | None:
        """A time in which the norm is below `SMALL`, a power of two; ``None`` where there is none."""
        size = float(self._size.upper())
        if not size < math.inf:
            return None
        return 2.0 ** math.floor(math.log2(SMALL / max(size, LEAST)))

    @cached_property
    def _terms(self) -> int:
        """How many powers are added up within a stride."""
        from flint import arb, ctx

        terms = STRIDE
        while not _tail(arb(SMALL), terms) < arb(2) ** (SPARE - ctx.prec):
            terms += 1
        return terms

    @cached_property
    def _table(self) -> arb_mat:
        """Every entry of every coefficient of the powers, a column for each power."""
        from flint import arb_mat

        columns = [[x for part in self.power(order).parts for x in part.entries()] for order in range(self._terms + 1)]
        return arb_mat(list(zip(*columns, strict=True)))

    def _near(self, time: arb) -> Series:
        """At every time of a ball by the powers, with what the others add in every unit."""
        from flint import arb, arb_mat

        size = upper(self._size * upper(abs(time)))
        if not size < 1.0:
            return self._none()
        factors, n = [[arb(1)]], len(self._units)
        for order in range(1, self._terms + 1):
            factors.append([factors[-1][0] * time / order])
        entries, tail = (self._table * arb_mat(factors)).entries(), _tail(size, self._terms).upper()
        missing = arb_mat([[arb(0, (tail * (a / b)).upper()) for b in self._units] for a in self._units])
        parts = [arb_mat(n, n, entries[first : first + n * n]) for first in range(0, len(entries), n * n)]
        return Series(
            self.matrix.monomials,
            [part + missing if mine else part for part, mine in zip(parts, self._generated, strict=True)],
        )

    @cached_property
    def _generated(self) -> list[bool]:
        return self.matrix.generated

    def _whole(self, count: int) -> Series:
        """After whole strides."""
        from flint import arb

        if count in self._strides:
            return self._strides[count]
        last = count & -count
        if count > last:
            found = self._whole(count - last) * self._whole(last)
            if len(self._strides) >= STRIDES_KEPT:
                return found
        elif count == 1:
            assert self._stride is not None
            found = self._near(arb(self._stride))
        else:
            found = self._whole(count // 2) * self._whole(count // 2)
        self._strides[count] = found
        return found

    def _none(self) -> Series:
        """Of a matrix that is too large for an exponential to be enclosed."""
        from flint import arb

        return Series(self.matrix.monomials, [part * arb("nan") for part in self.matrix.parts])


def _tail(size: arb, terms: int) -> arb:
    """A bound of what the exponential series adds after so many terms, of an argument of at most that ``size``, below
    1."""
    from flint import arb

    return size ** (terms + 1) * 2 / arb(terms + 1).fac()


def norm(matrix: arb_mat) -> arb:
    """The Frobenius norm, which bounds the 2-norm."""
    return (matrix.transpose() * matrix).trace().nonnegative_part().sqrt()


def upper(ball: arb) -> arb:
    """The upper end of a ball, as an exact number."""
    return ball.upper()
