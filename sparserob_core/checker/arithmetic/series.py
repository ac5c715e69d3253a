"""Matrices that depend on the parameters: truncated power series with ball matrices as coefficients."""

from __future__ import annotations

from bisect import bisect_right
from collections.abc import Sequence
from typing import TYPE_CHECKING, final

from sparserob_core.checker.arithmetic.jets import Monomials

if TYPE_CHECKING:
    from flint import arb, arb_mat

SMALL = 0.25  # norm below which the exponential series is summed
SPARE = 16  # bits of the working precision that what is left out of the series may take
STRIDE = 4  # of the powers by which it is summed; divides the number of terms


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
    def _generated(self) -> list[bool]:
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
        left, right, here, there = self.parts, other.parts, self.there, other.there
        for i, j, k in self.monomials.products:
            if here[i] and there[j]:
                term, so_far = left[i] * right[j], total[k]
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
        parts = [part + tail if mine else part for part, mine in zip(result.parts, self._generated, strict=True)]
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
    """``e^{matrix t}`` at whole numbers of ticks, each remembered: that of the longest time before it, times that of
    the time between, which is remembered too, since cells are halves of halves. A product costs a tenth of a series,
    and balls hardly grow."""

    def __init__(self, matrix: Series, tick: float) -> None:
        self.matrix, self.tick = matrix, tick
        self._known: dict[int, Series] = {}
        self._times: list[int] = []
        self._steps: dict[int, Series] = {}

    def at(self, ticks: int) -> Series:
        """After that many ticks, exactly."""
        if ticks not in self._known:
            place = bisect_right(self._times, ticks)
            before = self._times[place - 1] if place else 0
            step = self.over(ticks - before)
            self._known[ticks] = step * self._known[before] if before else step
            self._times.insert(place, ticks)
        return self._known[ticks]

    def over(self, ticks: int) -> Series:
        """The same, of a time that occurs often, by its own series."""
        from flint import arb

        if ticks not in self._steps:
            self._steps[ticks] = self.matrix.scaled(arb(self.tick) * ticks).exp()
        return self._steps[ticks]

    def around(self, ticks: int) -> Series:
        """From so many ticks before to so many after."""
        from flint import arb

        return self.matrix.scaled(arb(0, self.tick * ticks)).exp()


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
