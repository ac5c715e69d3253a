"""Coordinates in which a program is easier: those of a square image, units in which every variable is of size 1, and
variables for the few directions of the decision along which rows change by far more than they do beside them."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from typing import TYPE_CHECKING

import numpy as np

from sparserob_core.sip.convex_set import Array
from sparserob_core.sip.finite import FiniteProgram, FiniteSolution
from sparserob_core.sip.inner.image import Memory

if TYPE_CHECKING:
    from scipy.sparse import csc_array

MAX_CONDITION = 1e6  # condition number above which coordinates are left alone
ORDINARY = 1e3  # variables whose bounds are within this factor of 1 are left in their units
# Units by which a row changes over the bounds of the decision, or ratio of the largest and the least of independent
# equalities, from which directions become variables; and their number, at most: more are no few that stand out.
LARGE, DIRECTIONS = 1e3, 8
UNEVEN, LARGEST = 1e6, 1000  # ratio of curvatures from which they are made even, and entries at most
ALONE = 0.999  # of a direction: an entry so large is a variable already
DEPENDENT_EQUALITY_SHARE = 1e-14  # of the largest one: what is left of an equality that depends on others
_inverses = Memory(4)
_curvatures = Memory(4)
_units = Memory(4)


@dataclass(frozen=True, eq=False)
class NewVariables:
    """The ``program`` in new variables, with the ways ``to`` them and ``back`` for decisions.

    ``dual`` is the way back for the multipliers of the image. Those of the rows are the same. Those of the equalities
    are, too, unless ``divided`` has ways for them.
    """

    program: FiniteProgram
    to: Callable[[Array], Array]
    back: Callable[[Array], Array]
    dual: Callable[[Array], Array]
    divided: DividedRows | None = None

    def translate(self, solution: FiniteSolution) -> FiniteSolution:
        """Return a solution of the program in its new variables."""
        mu = solution.mu if self.divided is None else self.divided.new_prices(solution.y, solution.mu)
        return replace(solution, x=self.to(solution.x), mu=mu)

    def equality_prices(self, solution: FiniteSolution) -> Array:
        """Return the multipliers of the program's equalities, from a solution in the new variables."""
        return solution.mu if self.divided is None else self.divided.old_prices(solution.y, solution.mu)


@dataclass(frozen=True, eq=False)
class DividedRows:
    """Rows of a program, divided into parts along a few orthonormal directions and a rest.

    The equalities ``A = L Q`` have the directions ``Q (e, n)``; ``lower (e, e)`` is ``L``. Further directions ``F (k,
    n)`` have variables of their own, ``F x / units`` with ``units (k,)``. The rows ``G`` have the parts ``fixed (r,
    e)`` along ``Q`` and ``moving (r, k)`` along ``F``.
    """

    Q: Array
    lower: Array
    F: Array
    units: Array
    fixed: Array
    moving: Array

    def new_decision(self, x: Array) -> Array:
        """Return a decision with the variables of the directions after its entries."""
        return np.concatenate([x, (self.F @ x) / self.units])

    def new_prices(self, y: Array, mu: Array) -> Array:
        """Return the multipliers of the new equalities, from those of the rows and of the equalities."""
        return np.concatenate([self.lower.T @ mu + self.fixed.T @ y, self.moving.T @ y])

    def old_prices(self, y: Array, mu: Array) -> Array:
        """Return the multipliers of the equalities, from those of the rows and of the new equalities."""
        from scipy.linalg import solve_triangular

        prices = mu[: len(self.Q)] - self.fixed.T @ y
        return np.asarray(solve_triangular(self.lower, prices, lower=True, trans=1))


def change_variables(program: FiniteProgram) -> NewVariables | None:
    """Return the program in coordinates that make it easier; ``None`` where it has such coordinates already."""
    divided = _divide_rows(program)
    if divided is not None:
        return divided
    if program.S is not None:
        return _change_to_image(program)
    return _rescale_variables(program) or _even_curvature(program)


def _divide_rows(program: FiniteProgram) -> NewVariables | None:
    """Return the program with a variable for every direction along which rows change by `LARGE` units and more.

    Rows of an unstable system at late times are large, and nearly parallel: what the control does early has grown until
    then. A solver has digits for what they have in common, and none for what they differ in. With a direction ``f``,
    they are ``a f + r`` with small ``r``. With the variable ``v = f'x / unit`` they become ``(a unit) v + r'x``, which
    are ordinary numbers. Along the directions of equalities ``f'x`` is known, and no variable is needed.

    Returns ``None`` where rows are ordinary, where too many directions are large, and where every large row has one.
    """
    if program.blocks is not None or not (program.h.size or program.b.size) or program.b.size > program.n:
        return None
    reach = _reach(program)
    L, Q = _orthogonalise(program.A)
    sizes = np.abs(np.diag(L))
    # some equalities may say the same
    if not sizes.min(initial=np.inf) > DEPENDENT_EQUALITY_SHARE * sizes.max(initial=0.0):
        return None
    is_uneven = bool(sizes.size) and sizes.max() > LARGE * sizes.min()
    large = int(np.count_nonzero(np.abs(program.G) @ reach > LARGE))
    if not is_uneven and not large:
        return None
    fixed = program.G @ Q.T
    rest = program.G - fixed @ Q
    F = np.zeros((0, program.n))
    while (sizes := np.linalg.norm(rest * reach, axis=1)).max(initial=0.0) > LARGE:
        if len(F) == min(DIRECTIONS, program.n // 4):
            return None
        direction = rest[int(np.argmax(sizes))]
        direction = direction / np.linalg.norm(direction)
        if np.abs(direction).max() > ALONE:
            return None
        F = np.vstack([F, direction])
        for _ in range(2):  # the second time for what rounding has left
            rest = rest - (rest @ F.T) @ F
    if not is_uneven and len(F) in (0, large):
        return None
    moving = (program.G - fixed @ Q) @ F.T
    units = 1.0 / np.exp2(np.round(np.log2(np.abs(moving).max(axis=0, initial=1.0))))
    return _introduce(program, DividedRows(Q, L, F, units, fixed, moving), rest)


def _reach(program: FiniteProgram) -> Array:
    """Return how far every entry of the decision may go, ``(n,)``, but no further than most do: a bound may be far away
    because it is none. Entries without bounds have 0, and 1 where the image is another."""
    if program.S is not None:
        return np.ones(program.n)
    bounds = np.maximum(np.abs(program.lower), np.abs(program.upper))
    finite = bounds[np.isfinite(bounds)]
    return np.where(np.isfinite(bounds), np.minimum(bounds, np.median(finite) if finite.size else 0.0), 0.0)


def _introduce(program: FiniteProgram, divided: DividedRows, rest: Array) -> NewVariables:
    """Return a program with variables for the directions ``F``; ``rest (r, n)`` is what rows have beside them."""
    from scipy.linalg import solve_triangular
    from scipy.sparse import block_diag, csc_array, hstack

    k, n = len(divided.F), program.n
    b = solve_triangular(divided.lower, program.b, lower=True)
    links = np.hstack([divided.F, -np.diag(divided.units)])
    free, none = np.full(k, np.inf), np.zeros(k)
    images = (0, k) if program.S is None else (0, 0)
    S = None if program.S is None else csc_array(hstack([program.S, csc_array((program.S.shape[0], k))]))
    easier = FiniteProgram(
        np.concatenate([program.q, none]),
        np.concatenate([program.weights, none[slice(*images)]]),
        np.concatenate([program.lower, -free[slice(*images)]]),
        np.concatenate([program.upper, free[slice(*images)]]),
        np.hstack([rest, divided.moving * divided.units]),
        program.h - divided.fixed @ b,
        np.vstack([np.hstack([divided.Q, np.zeros((len(divided.Q), k))]), links]),
        np.concatenate([b, none]),
        P=None if program.P is None else csc_array(block_diag([program.P, csc_array((k, k))], format="csc")),
        S=S,
        constant=program.constant,
    )
    images_before = program.weights.size
    return NewVariables(easier, divided.new_decision, lambda v: v[:n], lambda z: z[:images_before], divided)


def _orthogonalise(A: Array) -> tuple[Array, Array]:
    """Return ``L (e, e)``, lower triangular after a change of the order of its rows, and orthonormal ``Q (e, n)`` with
    ``A = L Q``."""
    Q, R = np.linalg.qr(A.T)
    return np.asarray(R.T), np.asarray(Q.T)


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


def _even_curvature(program: FiniteProgram) -> NewVariables | None:
    """Return the variables ``v`` with ``x = V v``, in which the curvature ``V'P V`` is the identity; ``None`` where a
    variable has a bound or a weight of its own, and where the curvatures differ by less than `UNEVEN`."""
    is_free = np.isinf(program.lower).all() and np.isinf(program.upper).all() and not program.weights.any()
    if program.P is None or program.curvature is not None or not is_free or program.blocks is not None:
        return None
    axes = _curvatures.recall((program.P,), None, partial(_find_axes, program.P))
    if axes is None:
        return None
    from scipy.sparse import eye_array

    V, lengths = axes
    q, G, A = program.q @ V, program.G @ V, program.A @ V
    easier = replace(program, P=eye_array(program.n, format="csc"), q=q, G=G, A=A)
    return NewVariables(easier, lambda x: (V.T @ x) * lengths, lambda v: np.asarray(V @ v), lambda z: V @ (lengths * z))


def _find_axes(P: csc_array) -> tuple[Array, Array] | None:
    """Return ``V (n, n)`` with ``V'P V = I``, and the eigenvalues ``(n,)`` of ``P``; ``None`` where they are alike, or
    differ by more than rounding leaves of them."""
    if P.shape[0] > LARGEST:
        return None
    eigenvalues, axes = np.linalg.eigh(P.toarray())
    ratio = eigenvalues[0] / eigenvalues[-1] if eigenvalues[-1] > 0.0 else 0.0
    return (axes / np.sqrt(eigenvalues), eigenvalues) if DEPENDENT_EQUALITY_SHARE <= ratio <= 1.0 / UNEVEN else None


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
    return inverse if np.linalg.norm(dense, 1) * np.linalg.norm(inverse, 1) <= MAX_CONDITION else None


def _transform_curvature(P: csc_array, inverse: Array) -> csc_array | None:
    from scipy.sparse import csc_array, diags_array

    transformed = inverse.T @ (P @ inverse)
    entries = np.diag(transformed)
    off_diagonal = np.abs(transformed - np.diag(entries)).max(initial=0.0)
    return csc_array(diags_array(entries)) if off_diagonal <= 1e-13 * entries.max(initial=0.0) else None
