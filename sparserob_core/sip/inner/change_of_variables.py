"""Coordinates in which a program is easier: those of a square image, and units in which every variable is of size 1."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from typing import TYPE_CHECKING

import numpy as np

from sparserob_core.sip.convex_set import Array
from sparserob_core.sip.finite import FiniteProgram
from sparserob_core.sip.inner.image import Memory

if TYPE_CHECKING:
    from scipy.sparse import csc_array

WORST = 1e6  # condition number above which coordinates are left alone
ORDINARY = 1e3  # variables whose bounds are within this factor of 1 are left in their units
_inverses = Memory(4)
_curvatures = Memory(4)
_units = Memory(4)


@dataclass(frozen=True, eq=False)
class NewVariables:
    """The ``program`` in new variables, with the ways ``to`` them and ``back`` for decisions, and ``dual`` for the
    multipliers of the image; those of rows and equalities are the same."""

    program: FiniteProgram
    to: Callable[[Array], Array]
    back: Callable[[Array], Array]
    dual: Callable[[Array], Array]


def in_new_variables(program: FiniteProgram) -> NewVariables | None:
    """Return the program in coordinates that make it easier; ``None`` where it has such coordinates already."""
    return _change_to_image(program) if program.S is not None else _rescale_variables(program)


def _change_to_image(program: FiniteProgram) -> NewVariables | None:
    """Return the coordinates ``s = S x``, in which the program is separable; ``None`` unless ``S`` is square and well
    conditioned and ``P`` becomes diagonal."""
    S = program.S
    if S is None or S.shape[0] != S.shape[1]:
        return None
    inverse = _inverses.recall((S,), None, partial(_invert, S))
    if inverse is None:
        return None
    P = (
        None
        if program.P is None
        else _curvatures.recall((S, program.P), None, partial(_transform_curvature, program.P, inverse))
    )
    if program.P is not None and P is None:
        return None
    easier = replace(program, S=None, P=P, q=program.q @ inverse, G=program.G @ inverse, A=program.A @ inverse)
    return NewVariables(easier, program.image, lambda s: np.asarray(inverse @ s), lambda z: z)


def _rescale_variables(program: FiniteProgram) -> NewVariables | None:
    """Return the variables ``x_k / unit_k``, with powers of two for units, which change no number but its exponent;
    ``None`` where the bounds of all variables are of ordinary size."""
    if program.blocks is not None:  # a norm has one unit for all its entries
        return None
    sources = (program.lower, program.upper, program.weights)
    scaling = _units.recall(sources, None, lambda: _scale_bounds(*sources))
    if scaling is None:
        return None
    unit, lower, upper, weights = scaling
    P = None
    if program.P is not None:
        from scipy.sparse import diags_array

        P = (diags_array(unit) @ program.P @ diags_array(unit)).tocsc()
    G, A = program.G * unit, program.A * unit
    easier = FiniteProgram(
        program.q * unit, weights, lower, upper, G, program.h, A, program.b, P=P, constant=program.constant
    )
    return NewVariables(easier, lambda x: x / unit, lambda v: v * unit, lambda z: z / unit)


def _scale_bounds(lower: Array, upper: Array, weights: Array) -> tuple[Array, Array, Array, Array] | None:
    reach = np.maximum(np.abs(lower), np.abs(upper))
    has_size = np.isfinite(reach) & (reach > 0.0)
    if not ((reach[has_size] > ORDINARY) | (reach[has_size] < 1.0 / ORDINARY)).any():
        return None
    unit = np.where(has_size, np.exp2(np.round(np.log2(np.where(has_size, reach, 1.0)))), 1.0)
    return unit, lower / unit, upper / unit, weights * unit


def _invert(S: csc_array) -> Array | None:
    dense = S.toarray()
    try:
        inverse = np.linalg.inv(dense)
    except np.linalg.LinAlgError:
        return None
    return inverse if np.linalg.norm(dense, 1) * np.linalg.norm(inverse, 1) <= WORST else None


def _transform_curvature(P: csc_array, inverse: Array) -> csc_array | None:
    from scipy.sparse import csc_array, diags_array

    transformed = inverse.T @ (P @ inverse)
    entries = np.diag(transformed)
    off_diagonal = np.abs(transformed - np.diag(entries)).max(initial=0.0)
    return csc_array(diags_array(entries)) if off_diagonal <= 1e-13 * entries.max(initial=0.0) else None
