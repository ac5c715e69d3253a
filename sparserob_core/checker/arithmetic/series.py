"""Matrices that depend on parameters: polynomials with ball matrices as coefficients."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cached_property
from typing import TYPE_CHECKING, final

import numpy as np

from sparserob_core.checker.arithmetic.balls import balls
from sparserob_core.checker.arithmetic.monomials import NONE, Monomials
from sparserob_core.checker.outcome import Unchecked
from sparserob_core.sip.convex_set import Array

if TYPE_CHECKING:
    from flint import arb, arb_mat

OUTWARD = 1.0 + 1e-12  # on sums of a few hundred numbers, each rounded
TINY = 1e-300  # for what is too small to be a float


@final
class Series:
    """``sum_k parts_k s^k``: at all parameters ``s`` from -1 to 1 the matrix is one that the balls allow. What products
    have beyond the degree of the ``monomials`` is in the balls of the first part."""

    def __init__(self, monomials: Monomials, parts: Sequence[arb_mat]) -> None:
        self.monomials, self.parts = monomials, list(parts)

    @staticmethod
    def constant(monomials: Monomials, value: arb_mat) -> Series:
        """A matrix that does not depend on the parameters."""
        return Series(monomials, [value] + [value * 0] * (monomials.size - 1))

    @staticmethod
    def known(value: arb_mat) -> Series:
        """A matrix where there are no parameters."""
        return Series(NONE, [value])

    @property
    def matrix(self) -> arb_mat:
        """The matrix where there are no parameters."""
        (found,) = self.parts
        return found

    @property
    def shape(self) -> tuple[int, int]:
        """How many rows and columns it has."""
        return self.parts[0].nrows(), self.parts[0].ncols()

    @cached_property
    def there(self) -> list[bool]:
        """Which coefficients are not exactly 0: those of a system are few."""
        zero = self.parts[0] * 0
        absent = [part == zero for part in self.parts]  # certainly equal; != is certainly different
        return [not gone for gone in absent]

    @cached_property
    def sizes(self) -> Array:
        """Of every degree how large the entries of its coefficients are together at most, ``(D + 1, rows,
        columns)``."""
        there = [part for part, here in zip(self.parts, self.there, strict=True) if here]
        entries = np.array([float(x.abs_upper()) for part in there for x in part.entries()])
        found = np.zeros((self.monomials.size, *self.shape))
        found[self.there] = entries.reshape(len(there), *self.shape) + TINY
        return np.add.reduceat(found, self.monomials.firsts, axis=0) * OUTWARD

    @cached_property
    def size(self) -> Array:
        """How large the entries are at most, ``(rows, columns)``."""
        entries = np.array([float(x.abs_upper()) for part in self.parts for x in part.entries()])
        found = np.where(entries > 0.0, entries + TINY, 0.0)
        return np.asarray(found.reshape(len(self.parts), *self.shape).sum(axis=0) * OUTWARD)

    @property
    def middle(self) -> Series:
        """The same with the middles of the balls."""
        return Series(self.monomials, [part.mid() for part in self.parts])

    def __add__(self, other: Series) -> Series:
        return Series(self.monomials, [a + b for a, b in zip(self.parts, other.parts, strict=True)])

    def __sub__(self, other: Series) -> Series:
        return Series(self.monomials, [a - b for a, b in zip(self.parts, other.parts, strict=True)])

    def __mul__(self, other: Series) -> Series:
        if self.monomials.size == 1:
            return Series(self.monomials, [self.parts[0] * other.parts[0]])
        total: list[arb_mat | None] = [None] * self.monomials.size
        right, there, products = other.parts, other.there, self.monomials.products_with
        for factor, pairs, here in zip(self.parts, products, self.there, strict=True):
            for j, k in pairs if here else ():
                if there[j]:
                    term, so_far = factor * right[j], total[k]
                    total[k] = term if so_far is None else so_far + term
        zero = zeros(self.shape[0], other.shape[1])
        found = Series(self.monomials, [zero if part is None else part for part in total])
        later = np.cumsum(other.sizes[:0:-1], axis=0)  # of the last degree, the last two, ...
        beyond = sum((self.sizes[i] @ later[i - 1] for i in range(1, len(self.sizes))), np.zeros(found.shape))
        return found.within(beyond * OUTWARD) if beyond.any() else found

    def within(self, off: Array) -> Series:
        """All that are off from it by at most ``off (rows, columns)`` at every parameter."""
        return Series(self.monomials, [self.parts[0] + around(off), *self.parts[1:]])

    def scaled(self, factor: arb | arb_mat) -> Series:
        """Every coefficient times a number, or a matrix, that does not depend on the parameters."""
        return Series(self.monomials, [part * factor for part in self.parts])

    def along(self, rows: arb_mat) -> Series:
        """The product of a matrix that does not depend on the parameters with it."""
        return Series(self.monomials, [rows * part for part in self.parts])

    def columns(self, first: int, last: int | None) -> Series:
        """Some of the columns."""
        from flint import arb_mat

        n, tables = self.shape[0], [[row[first:last] for row in part.tolist()] for part in self.parts]
        return Series(self.monomials, [arb_mat(n, len(rows[0]), [x for row in rows for x in row]) for rows in tables])

    def beside(self, other: Series) -> Series:
        """With another one at its right."""
        from flint import arb_mat

        (n, p), q = self.shape, other.shape[1]
        pairs = [(a.tolist(), b.tolist()) for a, b in zip(self.parts, other.parts, strict=True)]
        every = [[x for one, two in zip(a, b, strict=True) for x in (*one, *two)] for a, b in pairs]
        return Series(self.monomials, [arb_mat(n, p + q, entries) for entries in every])

    def above(self, below: arb_mat) -> Series:
        """With the rows of a matrix below that does not depend on the parameters."""
        none = (below * 0).tolist()
        first, *others = (part.tolist() for part in self.parts)
        return Series(self.monomials, [stacked(first + below.tolist()), *(stacked(part + none) for part in others)])

    def transpose(self) -> Series:
        """The transposed one."""
        return Series(self.monomials, [part.transpose() for part in self.parts])


def sizes_of(series: Sequence[Series]) -> Array:
    """How large the entries of series of one shape are at most, ``(n, rows, columns)``."""
    return np.array([one.size for one in series])


def dot(left: Sequence[Series], right: Sequence[Series]) -> Series:
    """The sum of the products of some series with others."""
    pairs = [(a, b) for a, b in zip(left, right, strict=True) if any(a.there)] or [(left[0], right[0])]
    if left[0].monomials.size == 1:  # ten times as quick as series are
        total = pairs[0][0].parts[0] * pairs[0][1].parts[0]
        for a, b in pairs[1:]:
            total = total + a.parts[0] * b.parts[0]
        return Series(left[0].monomials, [total])
    found = pairs[0][0] * pairs[0][1]
    for a, b in pairs[1:]:
        found = found + a * b
    return found


def identity(count: int) -> arb_mat:
    """The matrix of ones on the diagonal."""
    from flint import arb_mat

    return arb_mat(count, count, [int(i == j) for i in range(count) for j in range(count)])


def zeros(rows: int, columns: int) -> arb_mat:
    """A matrix of zeros."""
    from flint import arb_mat

    return arb_mat(rows, columns)


def stacked(table: Sequence[Sequence[arb]]) -> arb_mat:
    """A ball matrix from its rows."""
    from flint import arb_mat

    return arb_mat([list(row) for row in table])


def exactly(rows: Array | arb_mat) -> arb_mat:
    """Rows of floats as balls."""
    return stacked([balls(row) for row in rows]) if isinstance(rows, np.ndarray) else rows


def around(off: Array) -> arb_mat:
    """Balls around 0 with these radii."""
    from flint import arb, arb_mat

    if not np.isfinite(off).all():
        raise Unchecked("the response grows beyond what numbers can hold")
    rows, columns = off.shape
    return arb_mat(rows, columns, [arb(0, float(x)) for x in off.ravel()])


def middles(matrix: arb_mat) -> Array:
    """The middles of balls."""
    return np.array([[float(x) for x in row] for row in matrix.tolist()])


def norm(matrix: arb_mat) -> arb:
    """The Frobenius norm, which bounds the 2-norm."""
    return (matrix.transpose() * matrix).trace().nonnegative_part().sqrt()


def products(steps: Sequence[Series]) -> list[Series]:
    """``Z_k = Phi_N ... Phi_{k+1}`` for ``k = 0, ..., N``, of steps ``Phi_1, ..., Phi_N``: from the products of pairs
    of them, each of which is made of at most twice as many products as there are levels."""
    unit = Series.constant(steps[0].monomials, identity(steps[0].shape[0]))
    if len(steps) == 1:
        return [steps[0], unit]
    odd = len(steps) % 2
    made = dict[tuple[int, int], Series]()  # steps that are one object have products that are one
    pairs = []
    for first, second in zip(steps[:-1:2], steps[1::2], strict=False):
        key = id(first), id(second)
        if key not in made:
            made[key] = second * first
        pairs.append(made[key])
    coarse = products([*pairs, *([steps[-1]] if odd else [])])
    found: list[Series] = []
    for k in range(len(steps) + 1):
        place, inside = divmod(k, 2)
        if not inside:
            found.append(coarse[place])
        elif k == len(steps):
            found.append(unit)
        else:
            found.append(coarse[place + 1] * steps[k])
    return found
