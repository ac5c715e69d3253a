"""Arrays with error bounds, made from ball matrices."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, final

import numpy as np
from flint import arb_mat

from sparserob_core.checker.arithmetic.series import around, exactly
from sparserob_core.checker.outcome import Unchecked
from sparserob_core.sip.convex_set import Array

HALF_ULP = 1.2e-16
OUTWARD = 1.0 + 1e-12  # factor on computed error bounds, which are sums of at most a few thousand rounded numbers
TINY = 1e-300
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
