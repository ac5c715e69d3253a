"""Arrays with error bounds, made from ball matrices; polynomials of such arrays, and the lengths of vectors of them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property, lru_cache
from typing import Any, final

import numpy as np
from flint import arb_mat

from sparserob_core.checker.arithmetic.monomials import Monomials
from sparserob_core.checker.arithmetic.series import around, exactly
from sparserob_core.checker.outcome import Unchecked
from sparserob_core.sip.convex_set import Array

HALF_ULP = 1.2e-16
OUTWARD = 1.0 + 1e-12  # factor on computed error bounds, which are sums of at most a few thousand rounded numbers
TINY = 1e-300
NEAR = 0.5  # the relative deviation of a squared length from its middle, below which a polynomial bounds the length
# Terms of a product of floats in one partial sum; the partial sums are added up then. With 348 states an entry is
# rounded 43 times instead of 348. With half of it products take a fourth longer, and with twice as much bounds along
# modes that are far from normal are twice as wide.
SUMMED = 32
ROUNDING = 1e-13  # rounding error of a sum of up to a few hundred floats, relative to the sum of absolute values


def rounding(terms: int) -> float:
    """Return a bound of the rounding error of a sum of that many products, relative to the sum of their absolute values
    (Higham 2002, section 3.1)."""
    return (terms + 4) * HALF_ULP


@final
@dataclass(frozen=True, eq=False)
class Enclosed:
    """An array ``mid`` with an error bound ``rad`` of the same shape."""

    mid: Array
    rad: Array

    @staticmethod
    def of(matrix: arb_mat) -> Enclosed:
        """Return the entries of a ball matrix, ``(rows, columns)``."""
        return Enclosed.all([matrix], (matrix.nrows(), matrix.ncols()))

    @staticmethod
    def all(matrices: Sequence[arb_mat], shape: tuple[int, ...]) -> Enclosed:
        """Return the entries of ball matrices in an array of that shape, one matrix after another, row by row. An exact
        0 has the radius 0, and no other number has it."""
        entries = [x for matrix in matrices for x in matrix.entries()]
        mid, rad = np.array([*map(float, entries)]), np.array([float(x.rad()) for x in entries])
        if not (np.isfinite(mid).all() and np.isfinite(rad).all()):
            raise Unchecked("the response grows beyond what numbers can hold")
        bounds = (rad + HALF_ULP * np.abs(mid)) * OUTWARD + TINY
        bounds[[i for i in np.flatnonzero((mid == 0.0) & (rad == 0.0)).tolist() if entries[i].is_zero()]] = 0.0
        return Enclosed(mid.reshape(shape), bounds.reshape(shape))

    def __getitem__(self, index: Any) -> Enclosed:
        return Enclosed(self.mid[index], self.rad[index])

    def swapped(self, first: int, second: int) -> Enclosed:
        """Return the array with two axes swapped."""
        return Enclosed(np.swapaxes(self.mid, first, second), np.swapaxes(self.rad, first, second))

    def __add__(self, other: Enclosed) -> Enclosed:
        mid = self.mid + other.mid
        return Enclosed(mid, (self.rad + other.rad + HALF_ULP * np.abs(mid)) * OUTWARD)

    @property
    def matrix(self) -> arb_mat:
        """The ball matrix of an array of two axes."""
        return exactly(self.mid) + around(self.rad)


def multiply_rows(left: Enclosed, right: Enclosed) -> Enclosed:
    """Return the products ``(k, j, n)`` of rows ``(k, d)`` with matrices ``(j, d, n)``. The rounding error grows with
    the number of terms of one partial sum plus the number of these sums (Higham 2002, section 4.2)."""
    j, d, n = right.mid.shape
    flat, flat_rad = (matrices.transpose(1, 0, 2).reshape(d, j * n) for matrices in (right.mid, right.rad))
    size = np.abs(left.mid)
    mid = left.mid[:, :SUMMED] @ flat[:SUMMED]
    for start in range(SUMMED, d, SUMMED):
        mid += left.mid[:, start : start + SUMMED] @ flat[start : start + SUMMED]
    operations = min(d, SUMMED) + (d - 1) // SUMMED
    rad = size @ (flat_rad + rounding(operations) * np.abs(flat)) + left.rad @ (np.abs(flat) + flat_rad)
    return Enclosed(mid.reshape(-1, j, n), rad.reshape(-1, j, n) * OUTWARD)


@final
@dataclass(frozen=True, eq=False)
class Truncated:
    """Polynomials in the time on ``[0, 1]`` and in the parameters on ``[-1, 1]``, with bounded truncation errors.

    The ``coefficients`` are ``(n, J + 1, M)``. The error of each polynomial is at most ``error (n,)``: products drop
    the terms beyond the degrees, and bound them.
    """

    monomials: Monomials
    coefficients: Array
    error: Array

    def __mul__(self, other: Truncated) -> Truncated:
        left, right = self.coefficients, other.coefficients
        J, first, second, gather, degrees = left.shape[1], *_tabulate_products(self.monomials)
        coefficients = np.empty_like(left)
        for t in range(J):
            pairs = sum(left[:, s, first] * right[:, t - s, second] for s in range(t + 1))
            coefficients[:, t] = pairs @ gather
        sizes = [np.abs(factor) @ degrees for factor in (left, right)]  # by time and degree
        kept = np.zeros(len(left))
        for t in range(J):
            for s in range(t + 1):
                partial_sums = np.cumsum(sizes[1][:, t - s], axis=1)[:, ::-1]
                kept += (sizes[0][:, s] * partial_sums).sum(axis=1)
        a, b = self.size, other.size
        dropped = np.maximum(a * b - kept, 0.0) + rounding(J * len(first) + 4) * a * b
        return Truncated(
            self.monomials, coefficients, (dropped + a * other.error + (b + other.error) * self.error) * OUTWARD
        )

    def __add__(self, other: Truncated) -> Truncated:
        coefficients, size = self.coefficients + other.coefficients, self.size + other.size
        return Truncated(self.monomials, coefficients, (self.error + other.error + rounding(1) * size) * OUTWARD)

    def scaled(self, factors: Array) -> Truncated:
        """Return each polynomial times a number."""
        coefficients, sizes = self.coefficients * factors[:, None, None], np.abs(factors)
        return Truncated(self.monomials, coefficients, sizes * (self.error + rounding(1) * self.size) * OUTWARD)

    def plus(self, number: float) -> Truncated:
        """Return each polynomial plus a number."""
        coefficients = self.coefficients.copy()
        coefficients[:, 0, 0] += number
        return Truncated(self.monomials, coefficients, self.error + rounding(1) * (self.size + abs(number)))

    @cached_property
    def size(self) -> Array:
        """The upper bounds ``(n,)`` of the absolute values of the polynomials without their errors."""
        size: Array = np.abs(self.coefficients).sum(axis=(1, 2))
        return size


@lru_cache(maxsize=16)
def _tabulate_products(monomials: Monomials) -> tuple[Array, Array, Array, Array]:
    """Return the first and the second monomial of each pair whose product is kept, the matrix from pairs to products,
    and the matrix from monomials to degrees."""
    products = np.array(monomials.products)
    gather, degrees = np.zeros((len(products), monomials.size)), np.zeros((monomials.size, monomials.degree + 1))
    gather[np.arange(len(products)), products[:, 2]] = 1.0
    degrees[np.arange(monomials.size), [sum(e) for e in monomials.exponents]] = 1.0
    return products[:, 0], products[:, 1], gather, degrees


def lengths(monomials: Monomials, parts: Array) -> tuple[Array, Array, Array]:
    """Return polynomials above the lengths ``|g|`` of vectors of polynomials ``g (n, J + 1, M, r)``: coefficients ``(n,
    J + 1, M)``, and their errors ``(n,)``. The third value says how far they may be too large, infinite where a vector
    may come near 0.

    With ``|g|^2 = s^2 (1 + e)`` it is ``s sqrt(1 + e) <= s (1 + e/2 - e^2/8 + e^3/16)``, since the fourth derivative of
    the root is negative. The bound exceeds the length by a term of fourth order in ``e``."""
    none = np.zeros(len(parts))
    with np.errstate(over="ignore", invalid="ignore"):
        return _bound_lengths(monomials, parts, none)


def _bound_lengths(monomials: Monomials, parts: Array, none: Array) -> tuple[Array, Array, Array]:
    square = Truncated(monomials, np.zeros(parts.shape[:3]), none)
    for r in range(parts.shape[3]):
        component = Truncated(monomials, parts[..., r], none)
        square = square + component * component
    middle = square.coefficients[:, 0, 0] + square.coefficients[:, 1:, 0].sum(axis=1) / 2
    is_valid = np.isfinite(middle) & (middle > TINY)
    middle = np.where(is_valid, middle, 1.0)
    e = square.scaled(1.0 / middle).plus(-1.0)
    deviation = np.abs(e.coefficients).sum(axis=(1, 2)) + e.error
    is_near = is_valid & (deviation < NEAR)
    root = (e * (e * e.scaled(none + 1.0 / 16.0).plus(-1.0 / 8.0)).plus(1.0 / 2.0)).plus(1.0).scaled(np.sqrt(middle))
    deviation = np.where(is_near, deviation, 0.0)
    excess = np.sqrt(middle) * deviation**4 * 5.0 / 128.0 / (1.0 - deviation) ** 3.5
    error = (root.error + rounding(8) * root.size) * OUTWARD
    coefficients = np.where(is_near[:, None, None], root.coefficients, 0.0)
    return coefficients, np.where(is_near, error, np.inf), np.where(is_near, excess, np.inf)
