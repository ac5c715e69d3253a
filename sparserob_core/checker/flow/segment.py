"""The flow of ``x' = A x + F u`` over a share of time from 0 to 1, and at every parameter: a polynomial that is
guessed, and then verified.

Nothing about the guess is believed. The *defect* of a polynomial ``P`` is ``P' - A P - F``: what it leaves of the
equation. It is bounded in balls, and by Gronwall's inequality the polynomial is off from the flow by at most what the
defect adds up to, times ``e^(int |A|)``.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property, lru_cache, reduce
from math import comb
from operator import add
from typing import TYPE_CHECKING, final

import numpy as np

from sparserob_core.checker.arithmetic.balls import ball
from sparserob_core.checker.arithmetic.series import OUTWARD, Series, dot, identity, sizes_of, zeros
from sparserob_core.checker.flow.units import pace
from sparserob_core.checker.outcome import Unchecked
from sparserob_core.sip.convex_set import Array

if TYPE_CHECKING:
    from flint import arb, arb_mat

SHARP = 2.0**-100  # of the system's numbers, what a guess leaves out; 2^-10 would show in what states miss
ROUGH = 2.0**-70  # the same over a box of parameters, where less is known anyway, and of kernels, which become floats
AT_ONCE = 4  # terms after which it is looked whether more are needed
TERMS = 64  # of a guess, at most
LONGER = 1.0 + 2.0**-30  # than 1, shares for which a flow is verified: parts of time have ends that are rounded
FAR = 300.0  # of the exponent in Gronwall's inequality: beyond, nothing is known


@final
@dataclass(frozen=True, eq=False)
class Powers:
    """A matrix ``(d, n)`` that is a polynomial in a share of time, with ``count`` coefficients, one above the other in
    a ``stack``, and off by at most ``off (d, n)`` at every share and parameter."""

    stack: Series
    count: int
    off: Array

    def within(self, start: arb, width: arb, order: int) -> tuple[list[Series], Array]:
        """The matrix on shares from ``start`` on, as so many terms of a polynomial in the share of the ``width``; and
        by how much that is off at most."""
        from flint import arb, arb_mat

        (d, columns), count, kept = self.off.shape, self.count, min(order, self.count)
        a, b = ([one**n for n in range(count)] for one in (start, width))
        weights = [[a[n - j] * b[j] * comb(n, j) if n >= j else arb(0) for n in range(count)] for j in range(kept)]
        size, moved = d * columns, []
        for row in (arb_mat(weights) * self._table).tolist():
            parts = [arb_mat(d, columns, row[k : k + size]) for k in range(0, len(row), size)]
            moved.append(Series(self.stack.monomials, parts))
        beyond = shifted(float(start.abs_upper()), float(width.abs_upper()), count)[kept:].sum(axis=0)
        return moved, np.einsum("n,nij->ij", beyond, self.sizes) * OUTWARD + self.off

    @cached_property
    def _table(self) -> arb_mat:
        """Every entry of every coefficient, a row for each power."""
        from flint import arb_mat

        entries, size = [part.entries() for part in self.stack.parts], self.off.size
        return arb_mat([[x for part in entries for x in part[n * size : (n + 1) * size]] for n in range(self.count)])

    @cached_property
    def sizes(self) -> Array:
        """How large the entries of every coefficient are at most, ``(N, d, n)``."""
        return self.stack.size.reshape(self.count, *self.off.shape)


@final
@dataclass(frozen=True, eq=False)
class VerifiedSegment:
    """``[Phi Gamma]``, what a share ``x`` of the time makes of the states at its beginning and of inputs that stay the
    same: ``sum_n terms_n x^n``, off by at most ``off (d, d + w)`` at every share up to `LONGER` and every parameter."""

    terms: list[Series]
    off: Array
    _stacks: dict[int, Series] = field(default_factory=dict, repr=False)

    def at(self, share: arb) -> Series:
        """The flow at a share of the time."""
        (value,), off = self.within(share, share * 0, 1)
        return value.within(off)

    def within(self, start: arb, width: arb, order: int) -> tuple[list[Series], Array]:
        """`Powers.within` of the flow."""
        return self.powers.within(start, width, order)

    def first(self, count: int) -> tuple[list[Series], Array]:
        """The first terms, and by how much their sum is off from the flow at most."""
        return self.terms[:count], (sum((one.size for one in self.terms[count:]), self.off)) * OUTWARD

    @property
    def end(self) -> Series:
        """The flow over all of the time; the smallest terms are added up first, which rounds less."""
        return reduce(add, reversed(self.terms)).within(self.off)

    @cached_property
    def powers(self) -> Powers:
        """The flow as a polynomial."""
        from flint import arb_mat

        (rows, columns), first = self.terms[0].shape, self.terms[0]
        parts = [
            arb_mat(rows * len(self.terms), columns, [x for term in self.terms for x in term.parts[k].entries()])
            for k in range(first.monomials.size)
        ]
        return Powers(Series(first.monomials, parts), len(self.terms), self.off)

    def applied(self, columns: Series) -> Powers:
        """The flow of some columns of states and of the first inputs."""
        used = columns.shape[0]
        if used not in self._stacks:
            self._stacks[used] = self.powers.stack.columns(0, used)
        off = self.off[:, :used] @ columns.size * OUTWARD
        return Powers(self._stacks[used] * columns, self.powers.count, off)


def shifted(start: float, width: float, count: int) -> Array:
    """What makes of the first ``count`` powers of ``start + width y`` those of ``y``, numbers from 0 on, ``(power of y,
    power)``, each up to rounding of ``4 count`` terms."""
    n = np.arange(count)
    table = _binomials(count) * np.power(start, np.maximum(n[None] - n[:, None], 0)) * np.power(width, n)[:, None]
    return np.asarray(table * (1.0 + 8.0 * count * 2.0**-53))


@lru_cache(maxsize=16)
def _binomials(count: int) -> Array:
    return np.array([[float(comb(n, j)) for n in range(count)] for j in range(count)])


def solve(A: Sequence[Series], F: Sequence[Series], units: Array, sharp: float = SHARP) -> VerifiedSegment:
    """The flow of ``sum_k A_k x^k`` and ``sum_k F_k x^k`` for ``x`` from 0 to 1; ``units (d,)`` are those of the
    states, in which the system is small. ``sharp``: of the states, what the guess may leave out."""
    equation = Equation(A, F)
    terms = guess(equation, units, max(sharp, ROUGH) if A[0].monomials.degree else sharp)
    return VerifiedSegment(terms, verify(equation, terms, units))


def guess(equation: Equation, units: Array, sharp: float = SHARP) -> list[Series]:
    """The first terms of the flow's power series, rounded."""
    d, w = len(units), equation.F[0].shape[1]
    terms = [equation.begin]
    scale = np.concatenate([1.0 / units, np.ones(w)]) * units[:, None]
    largest = np.concatenate([np.ones(d), np.zeros(w)])
    while len(terms) <= TERMS:
        first = len(terms)
        for n in range(first - 1, first - 1 + AT_ONCE):
            terms.append(equation.slope(terms, n).scaled(_inverse(n + 1)).middle)
        sizes = (sizes_of(terms[first:]) / scale).max(axis=1)
        largest = np.maximum(largest, sizes.max(axis=0))
        small = (sizes[-2:] <= sharp * np.where(largest > 0.0, largest, 1.0)).all()
        if len(terms) > max(len(equation.A), len(equation.F)) and small:
            break
    return terms


def verify(equation: Equation, terms: Sequence[Series], units: Array) -> Array:
    """By how much a polynomial is off from the flow at most up to a share of `LONGER`, ``(d, d + w)``; raises
    `Unchecked` where that is not known."""
    A, F, last, d = equation.A, equation.F, len(terms) - 1, len(units)
    longer = LONGER ** (last + max(len(A), len(F)) + 1) * OUTWARD
    defects = [terms[n + 1].scaled(ball(n + 1)) - equation.slope(terms, n) for n in range(last)]
    orders = np.array([1.0, *range(1, last + 1)])[:, None, None]
    missed = (sizes_of([terms[0] - equation.begin, *defects]) / orders).sum(axis=0)
    sizes, paces, drives = map(sizes_of, (terms, A, F))
    for n in range(last, last + max(len(A), len(F))):
        for k in range(max(0, n - last), min(n + 1, len(A))):
            missed = missed + paces[k] @ sizes[n - k] / (n + 1)
        if n < len(F):
            missed[:, d:] += drives[n] / (n + 1)
    growth = sum(pace(one, units) / (k + 1) for k, one in enumerate(paces)) * longer
    if not growth <= FAR:
        raise Unchecked("the system is too fast for a part of its horizon")
    worst = (missed / units[:, None]).max(axis=0, initial=0.0) * (np.exp(growth) * longer)
    return np.asarray(units[:, None] * worst * OUTWARD)


@final
@dataclass(frozen=True, eq=False)
class Equation:
    """``P' = A P + [0 F]``, ``P(0) = [1 0]``, with polynomials ``A`` and ``F`` of the share of time."""

    A: Sequence[Series]
    F: Sequence[Series]
    _known: dict[int, tuple[list[Series], Series]] = field(default_factory=dict, repr=False)

    @cached_property
    def begin(self) -> Series:
        """The flow in no time."""
        d, monomials = self.A[0].shape[0], self.A[0].monomials
        return Series.constant(monomials, identity(d)).beside(Series.constant(monomials, zeros(d, self.F[0].shape[1])))

    @cached_property
    def _inputs(self) -> list[Series]:
        d = self.A[0].shape[0]
        none = Series.constant(self.A[0].monomials, zeros(d, d))
        return [none.beside(one) for one in self.F]

    def slope(self, terms: Sequence[Series], n: int) -> Series:
        """The term of order ``n`` of ``A P + [0 F]``; of the same terms of ``P`` it is remembered."""
        count = min(n + 1, len(self.A))
        factors = [terms[n - k] for k in range(count)]
        known = self._known.get(n)
        if known is None or not all(a is b for a, b in zip(known[0], factors, strict=True)):
            found = dot(self.A[:count], factors)
            known = self._known[n] = factors, found + self._inputs[n] if n < len(self.F) else found
        return known[1]


def _inverse(value: int) -> arb:
    return 1 / ball(value)
