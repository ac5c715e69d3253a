"""Bounds of the rounding of sums of products in double precision."""

from __future__ import annotations

import numpy as np

EPSILON = float(np.finfo(float).eps)


def rounding(terms: int) -> float:
    """Return ``(n + 4) u``, a bound of the rounding error of a sum of ``n`` products, relative to the sum of their
    absolute values.

    The unit roundoff ``u`` is half of the machine's epsilon. Up to ``n = 1e8`` the result is above
    ``gamma_n = n u / (1 - n u)`` (Higham 2002, section 3.1), and for few terms it has room for some operations around
    the product.
    """
    return (terms + 4) * EPSILON / 2
