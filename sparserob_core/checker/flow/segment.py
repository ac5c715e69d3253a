"""The flow of ``x' = A x + F u`` over a share of time from 0 to 1, at every parameter: a guessed and verified
polynomial.

Nothing about the guess is believed. The *defect* of a polynomial ``P`` is its residual ``P' - A P - F`` in the
equation. The defect is bounded in balls. By Gronwall's inequality the error of the polynomial is at most the integral
of the defect, times ``e^(int |A|)``.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property, lru_cache, reduce
from math import comb
from operator import add
from typing import final

import numpy as np
from flint import arb, arb_mat

from sparserob_core.checker.arithmetic.balls import ball
from sparserob_core.checker.arithmetic.series import OUTWARD, Series, dot, identity, sizes_of, zeros
from sparserob_core.checker.flow.units import pace
from sparserob_core.checker.outcome import Unchecked
from sparserob_core.sip.convex_set import Array

SHARP = 2.0**-100  # relative truncation error of a guess; with a tenth of these bits it would show in the states
ROUGH = 2.0**-70  # the same over a box of parameters, which is less sharp anyway, and of kernels, which become floats
AT_ONCE = 4  # terms between two tests for whether more are needed
TERMS = 64  # the largest order of the terms of a guess
LONGER = 1.0 + 2.0**-30  # the largest share for which a flow is verified: ends of parts of time are rounded
MAX_EXPONENT = 300.0  # the largest exponent in Gronwall's inequality: with a larger one the bound is useless


@final
@dataclass(frozen=True, eq=False)
class Powers:
    """A matrix ``(d, n)`` that is a polynomial in a share of time. The ``stack`` holds its ``count`` coefficients, one
    above the other. ``off (d, n)`` bounds the error at every share up to `LONGER` and every parameter."""

    stack: Series
    count: int
    off: Array

    def within(self, start: arb, width: arb, order: int) -> tuple[list[Series], Array]:
        """Return the matrix on the shares from ``start`` to ``start + width``: at most ``order`` coefficients ``(d,
        n)`` in powers of the share of the ``width``, and the error bound of this polynomial."""
        (d, columns), count, kept = self.off.shape, self.count, min(order, self.count)
        a, b = ([x**n for n in range(count)] for x in (start, width))
        weights = [[a[n - j] * b[j] * comb(n, j) if n >= j else arb(0) for n in range(count)] for j in range(kept)]
        size, coefficients = d * columns, []
        for row in (arb_mat(weights) * self._coefficient_table).tolist():
            matrices = [arb_mat(d, columns, row[k : k + size]) for k in range(0, len(row), size)]
            coefficients.append(Series(self.stack.monomials, matrices))
        dropped_weights = shifted(float(start.abs_upper()), float(width.abs_upper()), count)[kept:].sum(axis=0)
        return coefficients, np.einsum("n,nij->ij", dropped_weights, self.sizes) * OUTWARD + self.off

    @cached_property
    def _coefficient_table(self) -> arb_mat:
        """All entries of all coefficients, one row for each power."""
        entries, size = [matrix.entries() for matrix in self.stack.parts], self.off.size
        return arb_mat(
            [[x for values in entries for x in values[n * size : (n + 1) * size]] for n in range(self.count)]
        )

    @cached_property
    def sizes(self) -> Array:
        """The upper bounds of the absolute values of the entries of every coefficient, ``(N, d, n)``."""
        return self.stack.size.reshape(self.count, *self.off.shape)


@final
@dataclass(frozen=True, eq=False)
class VerifiedSegment:
    """The flow ``[Phi Gamma]`` at a share ``x`` of the time: the factors of the states at its beginning and of constant
    inputs. It is ``sum_n terms_n x^n``, with an error of at most ``off (d, d + w)`` at every share up to `LONGER` and
    every parameter."""

    terms: list[Series]
    off: Array
    _stacks: dict[int, Series] = field(default_factory=dict, repr=False)

    def at(self, share: arb) -> Series:
        """Return the flow at a share of the time, ``(d, d + w)``."""
        (value,), remainder = self.within(share, share * 0, 1)
        return value.within(remainder)

    def within(self, start: arb, width: arb, order: int) -> tuple[list[Series], Array]:
        """Return the flow on the shares from ``start`` to ``start + width``: at most ``order`` coefficients, and the
        error bound of this polynomial."""
        return self.powers.within(start, width, order)

    def first(self, count: int) -> tuple[list[Series], Array]:
        """Return the first ``count`` terms, and an upper bound ``(d, d + w)`` of the difference between their
        polynomial and the flow, at shares up to 1."""
        return self.terms[:count], (sum((term.size for term in self.terms[count:]), self.off)) * OUTWARD

    @property
    def end(self) -> Series:
        """The flow over all of the time. The smallest terms are added first, which reduces the rounding error."""
        return reduce(add, reversed(self.terms)).within(self.off)

    @cached_property
    def powers(self) -> Powers:
        """The flow as a polynomial."""
        (rows, columns), first = self.terms[0].shape, self.terms[0]
        matrices = [
            arb_mat(rows * len(self.terms), columns, [x for term in self.terms for x in term.parts[k].entries()])
            for k in range(first.monomials.size)
        ]
        return Powers(Series(first.monomials, matrices), len(self.terms), self.off)

    def applied(self, columns: Series) -> Powers:
        """Return the flow times some columns of states and of the first inputs."""
        used = columns.shape[0]
        if used not in self._stacks:
            self._stacks[used] = self.powers.stack.columns(0, used)
        remainder = self.off[:, :used] @ columns.size * OUTWARD
        return Powers(self._stacks[used] * columns, self.powers.count, remainder)


def shifted(start: float, width: float, count: int) -> Array:
    """Return the matrix ``(power of y, power)`` from coefficients of powers of ``start + width y``, both nonnegative,
    to those of powers of ``y``. Each entry is increased by more than its rounding error, some ``8 count`` units of
    rounding."""
    n = np.arange(count)
    table = (
        _compute_binomials(count) * np.power(start, np.maximum(n[None] - n[:, None], 0)) * np.power(width, n)[:, None]
    )
    return np.asarray(table * (1.0 + 8.0 * count * 2.0**-53))


@lru_cache(maxsize=16)
def _compute_binomials(count: int) -> Array:
    return np.array([[float(comb(n, j)) for n in range(count)] for j in range(count)])


def solve(A: Sequence[Series], F: Sequence[Series], units: Array, sharp: float = SHARP) -> VerifiedSegment:
    """Return the verified flow of ``x' = A x + F u`` from 0 to 1, with coefficients of ``A (d, d)`` and ``F (d, w)`` in
    powers of the share of time. The system is small in the ``units (d,)``; the guess ends at the relative truncation
    error ``sharp``, at least `ROUGH` over a box of parameters."""
    equation = Equation(A, F)
    terms = guess(equation, units, max(sharp, ROUGH) if A[0].monomials.degree else sharp)
    return VerifiedSegment(terms, verify(equation, terms, units))


def guess(equation: Equation, units: Array, sharp: float = SHARP) -> list[Series]:
    """Return the first terms of the flow's power series, each as the middles of its balls."""
    d, w = len(units), equation.F[0].shape[1]
    terms = [equation.begin]
    scale = np.concatenate([1.0 / units, np.ones(w)]) * units[:, None]
    largest = np.concatenate([np.ones(d), np.zeros(w)])
    while len(terms) <= TERMS:
        first = len(terms)
        for n in range(first - 1, first - 1 + AT_ONCE):
            terms.append(equation.slope(terms, n).scaled(_invert(n + 1)).middle)
        sizes = (sizes_of(terms[first:]) / scale).max(axis=1)
        largest = np.maximum(largest, sizes.max(axis=0))
        small = (sizes[-2:] <= sharp * np.where(largest > 0.0, largest, 1.0)).all()
        if len(terms) > max(len(equation.A), len(equation.F)) and small:
            break
    return terms


def verify(equation: Equation, terms: Sequence[Series], units: Array) -> Array:
    """Return an upper bound ``(d, d + w)`` of the error of a polynomial up to a share of `LONGER`; raise `Unchecked`
    where the exponent of Gronwall's inequality is too large."""
    A, F, last, d = equation.A, equation.F, len(terms) - 1, len(units)
    longer = LONGER ** (last + max(len(A), len(F)) + 1) * OUTWARD
    defects = [terms[n + 1].scaled(ball(n + 1)) - equation.slope(terms, n) for n in range(last)]
    orders = np.array([1.0, *range(1, last + 1)])[:, None, None]
    residual = (sizes_of([terms[0] - equation.begin, *defects]) / orders).sum(axis=0)
    sizes, A_sizes, F_sizes = map(sizes_of, (terms, A, F))
    for n in range(last, last + max(len(A), len(F))):
        for k in range(max(0, n - last), min(n + 1, len(A))):
            residual = residual + A_sizes[k] @ sizes[n - k] / (n + 1)
        if n < len(F):
            residual[:, d:] += F_sizes[n] / (n + 1)
    growth = sum(pace(rates, units) / (k + 1) for k, rates in enumerate(A_sizes)) * longer
    if not growth <= MAX_EXPONENT:
        raise Unchecked("the system is too fast for a part of its horizon")
    worst = (residual / units[:, None]).max(axis=0, initial=0.0) * (np.exp(growth) * longer)
    return np.asarray(units[:, None] * worst * OUTWARD)


@final
@dataclass(frozen=True, eq=False)
class Equation:
    """The equation ``P' = A P + [0 F]``, ``P(0) = [1 0]``, with polynomials ``A`` and ``F`` of the share of time.

    Its solution is ``P = [Phi Gamma]``.
    """

    A: Sequence[Series]
    F: Sequence[Series]
    _slope_cache: dict[int, tuple[list[Series], Series]] = field(default_factory=dict, repr=False)

    @cached_property
    def begin(self) -> Series:
        """The flow at the share 0."""
        d, monomials = self.A[0].shape[0], self.A[0].monomials
        return Series.constant(monomials, identity(d)).append_columns(
            Series.constant(monomials, zeros(d, self.F[0].shape[1]))
        )

    @cached_property
    def _inputs(self) -> list[Series]:
        d = self.A[0].shape[0]
        zero = Series.constant(self.A[0].monomials, zeros(d, d))
        return [zero.append_columns(term) for term in self.F]

    def slope(self, terms: Sequence[Series], n: int) -> Series:
        """Return the term of order ``n`` of ``A P + [0 F]``; for the same terms of ``P`` it is remembered."""
        count = min(n + 1, len(self.A))
        factors = [terms[n - k] for k in range(count)]
        cached = self._slope_cache.get(n)
        if cached is None or not all(a is b for a, b in zip(cached[0], factors, strict=True)):
            product = dot(self.A[:count], factors)
            cached = self._slope_cache[n] = factors, product + self._inputs[n] if n < len(self.F) else product
        return cached[1]


def _invert(value: int) -> arb:
    return 1 / ball(value)
