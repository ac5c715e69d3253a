"""Upper bounds of polynomials in several variables on the box ``[-1, 1]^nu``."""

from __future__ import annotations

import numpy as np

from sparserob_core.control.enclosures.cache import remember
from sparserob_core.shapes import Bool, Float, Int, shaped
from sparserob_core.sip.convex_set import Array
from sparserob_core.sip.expressions.taylor import Face, TaylorSpace

DEFINITE = 1e-12  # share of the largest eigenvalue below 0 to which those of a Hessian are lowered
SLOPE = 1e-9  # slope inwards, relative to the Hessian, above which a variable leaves a side of the box again
ROUNDS = 3  # at most, of the active set method, per variable
FACES_KEPT = 256  # faces that a space remembers


@shaped
def polynomial_bound(
    space: TaylorSpace, coefficients: Float[Array, "*k M"]
) -> tuple[Float[Array, " *k"], Float[Array, "*k nu"]]:
    """Return upper bounds of polynomials ``(..., M)`` on ``[-1, 1]^nu``, and measures ``(..., nu)`` of what halving
    each variable would gain.

    Variables in which the polynomial is monotone are set to their better end. In the others the quadratic part is
    bounded variable by variable, or by the tangents of a concave function. Where the part is not concave, a multiple of
    ``|delta|^2`` is subtracted first and its largest value added. Terms of degree three and more are bounded by their
    modulus, even monomials by their positive part. The measures are bounds of the partial derivatives, without the
    gradient in a variable that is set to its end. Rounding is not in the bounds.
    """
    nu = space.nu
    shape = coefficients.shape[:-1]
    if nu == 0 or space.degree == 0:
        return coefficients[..., 0].copy(), np.zeros((*shape, nu))
    flat = coefficients.reshape(-1, space.size)
    gradient, hessian = quadratic_part(space, flat)
    tail, steepness = _bound_tail(space, flat)
    bound = flat[:, 0] + tail
    slope = np.abs(hessian).sum(axis=2)
    ends = np.where(np.abs(gradient) >= slope + steepness, np.sign(gradient), 0.0)
    bound += (gradient * ends).sum(axis=1) + 0.5 * np.einsum("ki,kij,kj->k", ends, hessian, ends)
    inner = (ends == 0) & ((gradient != 0) | (slope > 0))
    gradient = np.where(inner, gradient + np.einsum("kij,kj->ki", hessian, ends), 0.0)
    hessian = np.where(inner[:, :, None] & inner[:, None, :], hessian, 0.0)
    bound += np.minimum(_bound_by_variable(gradient, hessian), _bound_as_concave(gradient, hessian, inner))
    spread = np.abs(gradient) + steepness + slope
    return bound.reshape(shape), spread.reshape(*shape, nu)


@shaped
def monotone_ends(
    space: TaylorSpace, coefficients: Float[Array, "k M"], steepness: Float[Array, "k nu"]
) -> Float[Array, "k nu"]:
    """Return the better end ``(k, nu)``, -1 or 1, of every variable in which polynomials ``(k, M)`` are monotone; 0 for
    the other variables.

    The polynomials stay monotone with any summand whose partial derivatives are at most ``steepness (k, nu)``.
    """
    if space.nu == 0 or space.degree == 0:
        return np.zeros((coefficients.shape[0], space.nu))
    gradient, hessian = quadratic_part(space, coefficients)
    certain = np.abs(gradient) > np.abs(hessian).sum(axis=2) + _bound_tail(space, coefficients)[1] + steepness
    return np.where(certain, np.sign(gradient), 0.0)


@shaped
def distinct_patterns(ends: Float[Array, "k r nu"]) -> tuple[Float[Array, "u nu"], Int[np.ndarray, "k r"]]:
    """The distinct rows of ``ends (k, r, nu)``, and which of them stands at every ``(k, r)``."""
    if not ends.shape[2]:
        return np.zeros((1, 0)), np.zeros(ends.shape[:2], dtype=int)
    patterns, inverse = np.unique(ends.reshape(-1, ends.shape[2]), axis=0, return_inverse=True)
    return patterns, inverse.reshape(ends.shape[:2])


def face_of(space: TaylorSpace, ends: Array) -> Face:
    """The face on which the variables with ``ends (nu,)`` not 0 are at them; remembered."""
    key = ends.tobytes()
    return space.faces.get(key) or remember(space.faces, key, _build_face(space, ends), FACES_KEPT)


def _build_face(space: TaylorSpace, ends: Array) -> Face:
    fixed = ends != 0
    sign = np.prod(np.where(fixed, ends, 1.0) ** space.exponents, axis=1)
    return Face(space.places(np.where(fixed, 0, space.exponents)), sign)


@shaped
def quadratic_part(
    space: TaylorSpace, flat: Float[Array, "k M"]
) -> tuple[Float[Array, "k nu"], Float[Array, "k nu nu"]]:
    """Gradient ``(k, nu)`` and Hessian ``(k, nu, nu)`` at the centre."""
    nu = space.nu
    unit = np.eye(nu, dtype=int)
    gradient = flat[:, [space.index[tuple(unit[i])] for i in range(nu)]]
    hessian = np.zeros((flat.shape[0], nu, nu))
    if space.degree >= 2:
        for i in range(nu):
            for j in range(i + 1):
                entry = flat[:, space.index[tuple(unit[i] + unit[j])]]
                hessian[:, i, j] = hessian[:, j, i] = 2 * entry if i == j else entry
    return gradient, hessian


@shaped
def _bound_tail(space: TaylorSpace, flat: Float[Array, "k M"]) -> tuple[Float[Array, " k"], Float[Array, "k nu"]]:
    """Return upper bounds ``(k,)`` of the terms of degree three and more, and bounds ``(k, nu)`` of the modulus of
    their partial derivatives."""
    high = space.degrees >= 3
    terms = flat[:, high]
    value = np.where(space.even[high], np.maximum(terms, 0.0), np.abs(terms)).sum(axis=1)
    return value, np.abs(terms) @ space.exponents[high]


@shaped
def _bound_by_variable(gradient: Float[Array, "k d"], hessian: Float[Array, "k d d"]) -> Float[Array, " k"]:
    """``sum_i max_s g_i s + h_ii s^2 / 2`` plus the modulus of the mixed terms."""
    square = np.einsum("kii->ki", hessian) / 2
    inside = (square < 0) & (np.abs(gradient) < -2 * square)
    top = np.where(inside, -(gradient**2) / np.where(inside, 4 * square, 1.0), np.abs(gradient) + square)
    mixed = (np.abs(hessian).sum(axis=(1, 2)) - 2 * np.abs(square).sum(axis=1)) / 2
    return np.asarray(top.sum(axis=1) + mixed)


@shaped
def _bound_as_concave(
    gradient: Float[Array, "k d"], hessian: Float[Array, "k d d"], inner: Bool[np.ndarray, "k d"]
) -> Float[Array, " k"]:
    """Return an upper bound of ``g's + s'H s / 2`` over the box in the inner variables, close where ``H`` is negative
    definite in them.

    ``H`` is first lowered by a multiple of the identity, at least by the share `DEFINITE`, which costs at most half of
    that per variable. The bound is ``inf`` where fewer than two variables are inner: there, the bound variable by
    variable is exact.
    """
    top = np.full(gradient.shape[0], np.inf)
    indices = np.flatnonzero(inner.sum(axis=1) > 1)
    if not indices.size:
        return top
    H, free = hessian[indices], inner[indices]
    values = np.linalg.eigvalsh(H)  # the other variables add zeros only
    size = np.abs(values).max(axis=1)
    lowered = np.maximum(values[:, -1], 0.0) + DEFINITE * size
    H = np.where(free[:, :, None] & free[:, None, :], H - lowered[:, None, None] * np.eye(H.shape[1]), 0.0)
    top[indices] = _bound_concave_maximum(gradient[indices], H, free, size) + lowered * free.sum(axis=1) / 2
    return top


def _solve_systems(matrices: Array, right: Array) -> Array:
    """``matrices^-1 right``, ``(k, d)``; in the least-squares sense for all where one is singular, since a tangent at
    any point will do."""
    try:
        return np.asarray(np.linalg.solve(matrices, right[..., None])[..., 0], dtype=float)
    except np.linalg.LinAlgError:
        return np.asarray(np.einsum("kij,kj->ki", np.linalg.pinv(matrices), right), dtype=float)


@shaped
def _bound_concave_maximum(
    gradient: Float[Array, "k d"],
    hessian: Float[Array, "k d d"],
    inner: Bool[np.ndarray, "k d"],
    size: Float[Array, " k"],
) -> Float[Array, " k"]:
    """Return upper bounds ``(k,)`` of concave functions ``g's + s'H s / 2`` of the inner variables on the box.

    A bound is the least maximum of the tangents at the points of an active set method. In each round of it one variable
    is fixed at a side or released from it.
    """
    rows, free, fixed = np.arange(gradient.shape[0]), inner.copy(), np.zeros(gradient.shape)
    filler = -np.where(size > 0, size, 1.0)[:, None, None] * np.eye(gradient.shape[1])
    top = np.full(rows.size, np.inf)
    for _ in range(ROUNDS * gradient.shape[1]):
        pull = np.where(free, gradient + np.einsum("kij,kj->ki", hessian, fixed), 0.0)
        stationary = fixed - _solve_systems(np.where(free[:, :, None] & free[:, None, :], hessian, filler), pull)
        point = np.clip(np.nan_to_num(stationary), -1.0, 1.0)
        hessian_product = np.einsum("kij,kj->ki", hessian, point)
        slope = np.where(inner, gradient + hessian_product, 0.0)
        top = np.minimum(
            top, ((gradient + hessian_product / 2) * point).sum(axis=1) + (np.abs(slope) - slope * point).sum(axis=1)
        )
        excess = np.where(free, np.abs(stationary) - 1.0, 0.0)
        inward = np.where(free, 0.0, -slope * fixed)
        worst = np.where(excess.max(axis=1) > 0.0, excess.argmax(axis=1), inward.argmax(axis=1))
        changed = (excess.max(axis=1) > 0.0) | (inward.max(axis=1) > SLOPE * size)
        if not changed.any():
            break
        changes = (rows[changed], worst[changed])
        fixed[changes] = np.where(free[changes], point[changes], 0.0)
        free[changes] = ~free[changes]
    return top
