"""Products of matrices in twice the digits, each a sum ``hi + lo`` of two matrices of floats.

The leading digits of two factors are so few that every sum of their products is a float, whatever order it is added up
in; only what is left, smaller by as many digits, is rounded (Ozaki, Ogita, Oishi and Rump 2012, "Error-free
transformations of matrix multiplication", Numer. Algorithms 59).
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
    """``(hi + lo) (other_hi + other_lo)``, ``(d, d)`` each; ``None``: no more digits than a float has. Where numbers
    become too large, the product of floats."""
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
    """``e^A`` as ``hi + lo``, and ``int_0^1 e^{A s} ds``, ``(d, d)`` each, where the norm of ``A (d, d)`` is at most
    1: by its series, from the last term."""
    identity = np.eye(A.shape[0])
    hi = np.asarray(identity / factorial(TERMS))
    for order in range(TERMS - 1, LONG_TERMS, -1):
        hi = A @ hi + identity / factorial(order)
    lo: Array | None = None
    for order in range(LONG_TERMS, 0, -1):
        hi, lo = product(A, None, hi, lo)
        share = Fraction(1, factorial(order))
        rounded_share = float(share)
        # what is added to is larger than any entry of what is added, or 0
        hi, error = _add_with_error(identity * rounded_share, hi)
        lo = lo + error + identity * float(share - Fraction(rounded_share))
    flow, flow_lo = product(A, None, hi, lo)
    flow, error = _add_with_error(identity, flow)
    return flow, flow_lo + error, hi


def _extract_leading_digits(A: Array, axis: int) -> Array:
    """The leading digits of the entries of ``A (d, d)``, of their largest along an axis: few enough that a sum of ``d``
    products of two has no more than a float."""
    kept = (DIGITS - int(np.ceil(np.log2(A.shape[0])))) // 2
    _, exponent = np.frexp(np.abs(A).max(axis=axis, keepdims=True))
    shift = np.ldexp(1.5, exponent + DIGITS - 1 - kept)
    return np.asarray((A + shift) - shift)


def _add_with_error(large: Array, small: Array) -> tuple[Array, Array]:
    """The rounded sum, and what was rounded away (Knuth 1997, section 4.2.2)."""
    total = large + small
    included = total - large
    return total, (large - (total - included)) + (small - included)
