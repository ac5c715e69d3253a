"""Products of matrices in twice the digits, each a sum ``hi + lo`` of two matrices of floats.

The leading digits of two factors are so few that every sum of their products is a float, in any order of addition.
Only the products with the other digits, smaller by as many digits, are rounded (Ozaki, Ogita, Oishi and Rump 2012,
"Error-free transformations of matrix multiplication", Numer. Algorithms 59).
"""

from __future__ import annotations

from fractions import Fraction
from math import factorial

import numpy as np

from sparserob_core.sip.convex_set import Array

DIGITS = 53  # of a float
# Terms of the series that are summed in twice the digits, and in all: of those beyond, what a float rounds is below a
# millionth of the rounding of the sum; 1 / 24! is 1e-24.
LONG_TERMS, TERMS = 10, 24
LARGE = 1e150  # the product of two such numbers is a float


def product(hi: Array, lo: Array | None, other_hi: Array, other_lo: Array | None) -> tuple[Array, Array]:
    """Return ``(hi + lo) (other_hi + other_lo)`` as a sum of two matrices ``(d, d)``, without the product of the low
    parts.

    A low part ``None`` is 0. Where numbers become too large, the result is the product of floats ``hi other_hi``.
    """
    if not max(np.abs(hi).max(), np.abs(other_hi).max()) < LARGE:
        return hi @ other_hi, np.zeros_like(hi)
    rows, columns = _extract_leading_digits(hi, 1), _extract_leading_digits(other_hi, 0)
    exact, correction = rows @ columns, rows @ (other_hi - columns) + (hi - rows) @ other_hi
    if other_lo is not None:
        correction += hi @ other_lo
    if lo is not None:
        correction += lo @ other_hi
    return _add_with_error(exact, correction)


def flows(A: Array) -> tuple[Array, Array, Array]:
    """Return ``e^A`` as ``hi`` and ``lo``, and ``int_0^1 e^{A s} ds`` as floats, ``(d, d)`` each.

    The norm of ``A (d, d)`` is at most 1. The series is summed from its last term.
    """
    identity = np.eye(A.shape[0])
    hi = np.asarray(identity / factorial(TERMS))
    for order in range(TERMS - 1, LONG_TERMS, -1):
        hi = A @ hi + identity / factorial(order)
    lo: Array | None = None
    for order in range(LONG_TERMS, 0, -1):
        hi, lo = product(A, None, hi, lo)
        share = Fraction(1, factorial(order))
        rounded_share = float(share)
        # every entry of the first summand is larger than those of the second, or 0
        hi, error = _add_with_error(identity * rounded_share, hi)
        lo = lo + error + identity * float(share - Fraction(rounded_share))
    flow, flow_lo = product(A, None, hi, lo)
    flow, error = _add_with_error(identity, flow)
    return flow, flow_lo + error, hi


def _extract_leading_digits(A: Array, axis: int) -> Array:
    """Return the entries of ``A (d, d)``, rounded to the leading digits of the largest entry along an axis.

    The digits are so few that a sum of ``d`` products of two such numbers is a float.
    """
    kept = (DIGITS - int(np.ceil(np.log2(A.shape[0])))) // 2
    _, exponent = np.frexp(np.abs(A).max(axis=axis, keepdims=True))
    shift = np.ldexp(1.5, exponent + DIGITS - 1 - kept)
    return np.asarray((A + shift) - shift)


def _add_with_error(large: Array, small: Array) -> tuple[Array, Array]:
    """Return the rounded sum, and its rounding error as a float, exactly (Knuth 1997, section 4.2.2)."""
    total = large + small
    included = total - large
    return total, (large - (total - included)) + (small - included)
