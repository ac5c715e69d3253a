"""Matrices that depend on parameters: polynomials with ball matrices as coefficients."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cached_property, reduce
from operator import add
from typing import final

import numpy as np
from flint import arb, arb_mat

from sparserob_core.checker.arithmetic.balls import balls
from sparserob_core.checker.arithmetic.monomials import NONE, Monomials
from sparserob_core.checker.outcome import Unchecked
from sparserob_core.sip.convex_set import Array

OUTWARD = 1.0 + 1e-12  # factor on sums of a few hundred numbers, above their rounding error
TINY = 1e-300  # bound of a positive number that is too small to be a float


@final
class Series:
    """A matrix ``sum_k parts_k s^k`` that depends on the parameters ``s``, each from -1 to 1.

    At every ``s`` the true matrix lies in the balls that the coefficients give. Terms of products beyond the degree of
    the ``monomials`` are in the balls of the first part.
    """

    def __init__(self, monomials: Monomials, parts: Sequence[arb_mat]) -> None:
        self.monomials, self.parts = monomials, list(parts)

    @staticmethod
    def constant(monomials: Monomials, value: arb_mat) -> Series:
        """Return a matrix that does not depend on the parameters."""
        return Series(monomials, [value] + [value * 0] * (monomials.size - 1))

    @staticmethod
    def known(value: arb_mat) -> Series:
        """Return a matrix where there are no parameters."""
        return Series(NONE, [value])

    @property
    def matrix(self) -> arb_mat:
        """The only coefficient, of a series without parameters."""
        (matrix,) = self.parts
        return matrix

    @property
    def shape(self) -> tuple[int, int]:
        """The numbers of rows and of columns."""
        return self.parts[0].nrows(), self.parts[0].ncols()

    @cached_property
    def there(self) -> list[bool]:
        """The coefficients that are not exactly 0, as Booleans: those of a system are few."""
        zero = self.parts[0] * 0
        is_zero = [coefficient == zero for coefficient in self.parts]  # certainly equal; != is certainly different
        return [not vanishes for vanishes in is_zero]

    @cached_property
    def sizes(self) -> Array:
        """For every degree, upper bounds ``(D + 1, rows, columns)`` of the sums of the absolute values of its
        coefficients."""
        nonzero = [coefficient for coefficient, is_nonzero in zip(self.parts, self.there, strict=True) if is_nonzero]
        entries = np.array([float(x.abs_upper()) for coefficient in nonzero for x in coefficient.entries()])
        bounds = np.zeros((self.monomials.size, *self.shape))
        bounds[self.there] = entries.reshape(len(nonzero), *self.shape) + TINY
        return np.add.reduceat(bounds, self.monomials.firsts, axis=0) * OUTWARD

    @cached_property
    def size(self) -> Array:
        """The upper bounds ``(rows, columns)`` of the absolute values of the entries; 0 where an entry is exactly 0."""
        bounds = uppers([x for coefficient in self.parts for x in coefficient.entries()])
        return np.asarray(bounds.reshape(len(self.parts), *self.shape).sum(axis=0) * OUTWARD)

    @property
    def middle(self) -> Series:
        """The series of the middles of the balls."""
        return Series(self.monomials, [coefficient.mid() for coefficient in self.parts])

    def __add__(self, other: Series) -> Series:
        return Series(self.monomials, [a + b for a, b in zip(self.parts, other.parts, strict=True)])

    def __sub__(self, other: Series) -> Series:
        return Series(self.monomials, [a - b for a, b in zip(self.parts, other.parts, strict=True)])

    def __mul__(self, other: Series) -> Series:
        if self.monomials.size == 1:
            return Series(self.monomials, [self.parts[0] * other.parts[0]])
        sums: list[arb_mat | None] = [None] * self.monomials.size
        right, right_mask, products = other.parts, other.there, self.monomials.products_with
        for factor, pairs, is_nonzero in zip(self.parts, products, self.there, strict=True):
            for j, k in pairs if is_nonzero else ():
                if right_mask[j]:
                    term, total = factor * right[j], sums[k]
                    sums[k] = term if total is None else total + term
        zero = zeros(self.shape[0], other.shape[1])
        product = Series(self.monomials, [zero if coefficient is None else coefficient for coefficient in sums])
        remainder = self._bound_beyond(other)
        return product.within(remainder) if remainder.any() else product

    def _bound_beyond(self, other: Series) -> Array:
        """Return an upper bound ``(rows, columns)`` of the terms of a product beyond the degree."""
        tail_sums = np.cumsum(other.sizes[:0:-1], axis=0)  # sums over the last degree, the last two, ...
        remainder = np.zeros((self.shape[0], other.shape[1]))
        return sum((self.sizes[i] @ tail_sums[i - 1] for i in range(1, len(self.sizes))), remainder) * OUTWARD

    def within(self, off: Array) -> Series:
        """Return the series with larger radii: it contains every matrix that is within ``off (rows, columns)`` of this
        one at every parameter."""
        return Series(self.monomials, [self.parts[0] + around(off), *self.parts[1:]])

    def scaled(self, factor: arb | arb_mat) -> Series:
        """Return the series times a number, or times a matrix from the right, that does not depend on the
        parameters."""
        return Series(self.monomials, [coefficient * factor for coefficient in self.parts])

    def along(self, rows: arb_mat) -> Series:
        """Return the product of a matrix that does not depend on the parameters with the series."""
        return Series(self.monomials, [rows * coefficient for coefficient in self.parts])

    def columns(self, first: int, last: int | None) -> Series:
        """Return the columns from ``first`` up to, but without, ``last``."""
        n, tables = self.shape[0], [[row[first:last] for row in coefficient.tolist()] for coefficient in self.parts]
        return Series(self.monomials, [arb_mat(n, len(rows[0]), [x for row in rows for x in row]) for rows in tables])

    def append_columns(self, other: Series) -> Series:
        """Return the series with the columns of another one at its right."""
        (n, p), q = self.shape, other.shape[1]
        pairs = [(a.tolist(), b.tolist()) for a, b in zip(self.parts, other.parts, strict=True)]
        tables = [
            [x for left_row, right_row in zip(a, b, strict=True) for x in (*left_row, *right_row)] for a, b in pairs
        ]
        return Series(self.monomials, [arb_mat(n, p + q, entries) for entries in tables])

    def above(self, below: arb_mat) -> Series:
        """Return the series with the rows of a matrix below it that does not depend on the parameters."""
        zero_rows = (below * 0).tolist()
        constant, *higher = (coefficient.tolist() for coefficient in self.parts)
        return Series(
            self.monomials,
            [stacked(constant + below.tolist()), *(stacked(coefficient + zero_rows) for coefficient in higher)],
        )

    def transpose(self) -> Series:
        """Return the transpose."""
        return Series(self.monomials, [coefficient.transpose() for coefficient in self.parts])


def uppers(entries: Sequence[arb]) -> Array:
    """Return upper bounds of absolute values, up to `OUTWARD`: 0 for an exact 0 alone, since floats underflow."""
    sizes = np.array([float(x.abs_upper()) for x in entries])
    exact = [i for i in np.flatnonzero(sizes == 0.0).tolist() if entries[i].is_zero()]
    sizes += TINY
    sizes[exact] = 0.0
    return sizes


def sizes_of(series: Sequence[Series]) -> Array:
    """Return upper bounds ``(n, rows, columns)`` of the absolute values of the entries of series of one shape."""
    return np.array([matrix.size for matrix in series])


def dot(left: Sequence[Series], right: Sequence[Series]) -> Series:
    """Return the sum of the products of some series with others."""
    pairs = [(a, b) for a, b in zip(left, right, strict=True) if any(a.there)] or [(left[0], right[0])]
    return reduce(add, (a * b for a, b in pairs))


def identity(count: int) -> arb_mat:
    """Return the identity matrix."""
    return arb_mat(count, count, [int(i == j) for i in range(count) for j in range(count)])


def zeros(rows: int, columns: int) -> arb_mat:
    """Return a matrix of zeros."""
    return arb_mat(rows, columns)


def stacked(table: Sequence[Sequence[arb]]) -> arb_mat:
    """Return a ball matrix from its rows."""
    return arb_mat([list(row) for row in table])


def exactly(rows: Array | arb_mat) -> arb_mat:
    """Return rows of floats as a ball matrix; a ball matrix is returned as it is."""
    return stacked([balls(row) for row in rows]) if isinstance(rows, np.ndarray) else rows


def around(off: Array) -> arb_mat:
    """Return balls around 0 with these radii; raise `Unchecked` where a radius is not finite."""
    if not np.isfinite(off).all():
        raise Unchecked("the response grows beyond what numbers can hold")
    rows, columns = off.shape
    return arb_mat(rows, columns, [arb(0, float(x)) for x in off.ravel()])


def middles(matrix: arb_mat) -> Array:
    """Return the middles of the balls of a matrix, rounded to floats."""
    return np.array([[float(x) for x in row] for row in matrix.tolist()])


def norm(matrix: arb_mat) -> arb:
    """Return the Frobenius norm, which bounds the 2-norm."""
    return (matrix.transpose() * matrix).trace().nonnegative_part().sqrt()


def products(steps: Sequence[Series]) -> list[Series]:
    """Return ``Z_k = Phi_N ... Phi_{k+1}`` for ``k = 0, ..., N``, of steps ``Phi_1, ..., Phi_N``: in pairs, level by
    level."""
    unit = Series.constant(steps[0].monomials, identity(steps[0].shape[0]))
    if len(steps) == 1:
        return [steps[0], unit]
    odd = len(steps) % 2
    cache = dict[tuple[int, int], Series]()  # equal pairs of objects share one product
    pairs = []
    for first, second in zip(steps[:-1:2], steps[1::2], strict=False):
        key = id(first), id(second)
        if key not in cache:
            cache[key] = second * first
        pairs.append(cache[key])
    coarse = products([*pairs, *([steps[-1]] if odd else [])])
    suffixes: list[Series] = []
    for k in range(len(steps) + 1):
        pair, parity = divmod(k, 2)
        if not parity:
            suffixes.append(coarse[pair])
        elif k == len(steps):
            suffixes.append(unit)
        else:
            suffixes.append(coarse[pair + 1] * steps[k])
    return suffixes
