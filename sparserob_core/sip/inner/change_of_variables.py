"""A square image is a change of coordinates: after it the program is separable, and far easier."""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from typing import TYPE_CHECKING

import numpy as np

from sparserob_core.sip.convex_set import Array
from sparserob_core.sip.finite import FiniteProgram
from sparserob_core.sip.inner.image import Memory

if TYPE_CHECKING:
    from scipy.sparse import csc_array

WORST = 1e6  # condition number above which coordinates are left alone
_inverses = Memory(4)
_curvatures = Memory(4)


def in_new_variables(program: FiniteProgram) -> FiniteProgram | None:
    """The program in the coordinates ``s = S x``; ``None`` unless ``S`` is square and well conditioned and ``P``
    becomes diagonal.

    ``y``, ``mu`` and the image multiplier ``z`` are the same in both coordinates.
    """
    S = program.S
    if S is None or S.shape[0] != S.shape[1]:
        return None
    inverse = _inverses.recall((S,), None, partial(_inverse, S))
    if inverse is None:
        return None
    P = None if program.P is None else _curvatures.recall((S, program.P), None, partial(_curvature, program.P, inverse))
    if program.P is not None and P is None:
        return None
    return replace(program, S=None, P=P, q=program.q @ inverse, G=program.G @ inverse, A=program.A @ inverse)


def from_new_variables(program: FiniteProgram, s: Array) -> Array:
    """``x (n,)`` with ``S x = s``, for a program that has new variables."""
    S = program.S
    inverse = None if S is None else _inverses.recall((S,), None, partial(_inverse, S))
    return s if inverse is None else np.asarray(inverse @ s)


def _inverse(S: csc_array) -> Array | None:
    dense = S.toarray()
    try:
        inverse = np.linalg.inv(dense)
    except np.linalg.LinAlgError:
        return None
    return inverse if np.linalg.norm(dense, 1) * np.linalg.norm(inverse, 1) <= WORST else None


def _curvature(P: csc_array, inverse: Array) -> csc_array | None:
    from scipy.sparse import csc_array, diags_array

    bent = inverse.T @ (P @ inverse)
    entries = np.diag(bent)
    rest = np.abs(bent - np.diag(entries)).max(initial=0.0)
    return csc_array(diags_array(entries)) if rest <= 1e-13 * entries.max(initial=0.0) else None
