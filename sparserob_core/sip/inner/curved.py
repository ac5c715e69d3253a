"""Lower bounds of programs with a quadratic cost whose matrix is positive definite.

A tangent of the cost bounds an entry without bounds only where its slope is exactly 0, which numbers seldom are, and an
entry between distant bounds poorly. The cost itself does better. With ``P >= diag(c)`` for some ``c > 0``,
``1/2 x'P x`` is at least its tangent at any point plus ``1/2 (x - at)'diag(c)(x - at)``. Residual slopes ``r`` then
cost no more than ``sum_k r_k^2 / (2 c_k)``. All of it is evaluated in extended precision: with a matrix of condition
1e12, double precision has no digits left for the slopes.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from sparserob_core.sip.convex_set import Array
from sparserob_core.sip.finite import FiniteProgram, FiniteSolution
from sparserob_core.sip.inner.duality import bent_minimisers
from sparserob_core.sip.inner.extended import UNIT, WIDE
from sparserob_core.sip.inner.image import Memory

# Of the least eigenvalue that is estimated, what is tried to be proven. With all of it rounding decides; a hundredth of
# it is as good, for what residual slopes cost is mostly far below the tolerated gap.
PROVEN = 0.5
MACHINE_EPSILON = 2.0**-52  # the distance of 1 to the next double
# Entries up to which a matrix is looked at. Ten times as many take minutes, a tenth leaves fits of a hundred terms out.
MAX_MATRIX_ENTRIES = 600
REFINEMENTS = 4  # each gains four digits at a condition of 1e12; a fifth is lost in rounding
HELD_DISTANCE = 1e-9  # of its bounds' distance: an entry so near to a bound is held there
_curvatures = Memory(4)


def least_curvature(P: Array) -> Array | None:
    """Return positive numbers ``c (n,)`` such that ``P - diag(c)`` is proven to be positive definite; ``None`` where
    none are found.

    ``P (n, n)`` is scaled to a diagonal of about 1 by powers of two, so that units do not matter, and shifted by a part
    of its least eigenvalue. Where the Cholesky factorisation then succeeds, it proves this up to ``(n + 2) eps`` of the
    trace (Rump 2006, "Verification of positive definiteness", BIT 46, theorem 2.3), which is doubled here. It also
    proves it up to the error of the product of the factors, which is bounded where the former is too much.
    """
    n, diagonal = len(P), P.diagonal()
    if not (diagonal > 0.0).all() or not np.isfinite(P).all():
        return None
    unit = np.exp2(-np.round(0.5 * np.log2(diagonal)))
    scaled = P * unit * unit[:, np.newaxis]
    share = PROVEN * float(np.linalg.eigvalsh(scaled)[0])
    if not share > 0.0:
        return None
    try:
        factor = np.linalg.cholesky(scaled - share * np.eye(n))
    except np.linalg.LinAlgError:
        return None
    error = 2.0 * (n + 2) * MACHINE_EPSILON * float(scaled.trace())
    if not share > error:
        error = _bound_factor_error(scaled, share, factor)
    if not share > error:
        return None
    return np.asarray((share - error) / unit**2 * (1.0 - 4.0 * MACHINE_EPSILON), dtype=float)


def _bound_factor_error(scaled: Array, share: float, factor: np.ndarray) -> float:
    """Return an upper bound of the norm of ``scaled - share I - factor factor'``, by the sums of its rows. Every entry
    is a sum of ``n + 2`` terms, and off by at most so many roundings of their absolute values (Higham 2002, section
    3.1)."""
    wide, size = factor.astype(WIDE), np.abs(factor)
    shift = share * np.eye(len(scaled))
    residual = np.abs(scaled.astype(WIDE) - shift - wide @ wide.T)
    residual += (len(scaled) + 4) * UNIT * (np.abs(scaled) + shift + 2.0 * size @ size.T)
    return float(residual.sum(axis=1).max()) * (1.0 + 1e-9)


def curvature_of(program: FiniteProgram) -> Array | None:
    """Return numbers ``c (n,)`` with ``P >= diag(c)`` for the matrix of a quadratic cost, remembered between calls.

    ``None`` without a quadratic cost, for an image, for norms of blocks, beyond `MAX_MATRIX_ENTRIES` entries, and where
    nothing is proven; also for a diagonal ``P``, which a dual bound minimises entry by entry.
    """
    P = program.P
    if (
        P is None
        or program.S is not None
        or program.blocks is not None
        or program.separable
        or program.n > MAX_MATRIX_ENTRIES
    ):
        return None
    return _curvatures.recall((P,), None, lambda: least_curvature(P.toarray()))


def add_curvature_bound(program: FiniteProgram, solution: FiniteSolution) -> FiniteSolution:
    """Return the solution with the lower bound that the curvature of its cost proves, where that is a better one."""
    bend = curvature_of(program)
    if bend is None or not np.isfinite(solution.x).all():
        return solution
    bound, _ = curved_bound(program, bend, solution.y, solution.mu, solution.x)
    if not bound > solution.lower_bound:
        return solution
    return replace(solution, lower_bound=bound, gap=solution.value - bound)


def curved_bound(program: FiniteProgram, bend: Array, y: Array, mu: Array, at: Array) -> tuple[float, Array]:
    """Return a lower bound of ``program`` by the multipliers ``y (r,)``, at least 0, and ``mu (e,)``, and the point of
    its tangent. The bound takes the tangent of the cost at ``at (n,)``, or at a point nearby that is better, and the
    curvature ``bend (n,)``.

    Rounding is counted: every sum of ``k`` products is off by at most ``(k + 2) eps`` of their absolute values (Higham
    2002, section 3.1).
    """
    assert program.P is not None
    wide, point = program.P.toarray().astype(WIDE), at.astype(WIDE)
    rows, equalities = y.astype(WIDE), mu.astype(WIDE)
    h = np.where(y > 0.0, program.h, 0.0)
    pull = program.q + rows @ program.G + equalities @ program.A
    offers: list[np.ndarray] = [point, _find_stationary_point(program, wide, pull, point)]
    bounds = [_evaluate_bound(program, wide, bend, (rows, equalities, h, pull), offer) for offer in offers]
    best = int(np.argmax(bounds))
    return bounds[best], offers[best].astype(float)


def _find_stationary_point(program: FiniteProgram, wide: np.ndarray, pull: np.ndarray, at: np.ndarray) -> np.ndarray:
    """Return the point near ``at`` where the slope of every entry is 0 that no bound and no kink holds."""
    low, high, weights = program.lower, program.upper, program.weights
    width = np.where(np.isfinite(high - low), high - low, 1.0)
    is_held = (at - low <= HELD_DISTANCE * width) | (high - at <= HELD_DISTANCE * width) | (weights > 0.0) & (at == 0.0)
    point = np.where(at - low <= HELD_DISTANCE * width, low, np.where(high - at <= HELD_DISTANCE * width, high, at))
    free = np.flatnonzero(~is_held)
    if not free.size:
        return point
    inside = wide[np.ix_(free, free)].astype(float)
    unit = np.exp2(-np.round(0.5 * np.log2(inside.diagonal())))
    scaled = inside * unit * unit[:, np.newaxis]
    for _ in range(REFINEMENTS):
        slope = wide @ point + pull + weights * np.sign(at)
        try:
            step = np.linalg.solve(scaled, -(slope[free].astype(float) * unit)) * unit
        except np.linalg.LinAlgError:
            return at
        if not np.isfinite(step).all():
            return at
        point[free] += step
    return np.asarray(np.minimum(np.maximum(point, low), high))


def _evaluate_bound(
    program: FiniteProgram, wide: np.ndarray, bend: Array, given: tuple[np.ndarray, ...], at: np.ndarray
) -> float:
    """Return the bound with the tangent at one point."""
    y, mu, h, pull = given
    terms = program.n + y.size + mu.size + 4
    size = np.abs(wide) @ np.abs(at)
    gradient = wide @ at
    slope = gradient + pull
    sizes = np.abs(program.q) + y @ np.abs(program.G) + np.abs(mu) @ np.abs(program.A) + size
    with np.errstate(all="ignore"):
        away = bent_minimisers(program.weights, bend, slope - bend * at, program.lower, program.upper)
    displacement = away - at
    values = program.weights * np.abs(away) + slope * displacement + 0.5 * bend * displacement**2
    # at the point itself: 1/2 at'P at + pull'at, and what the slopes allow beyond it
    constant = program.constant - y @ h - mu @ program.b
    value = constant + 0.5 * (at @ gradient) + pull @ at + values.sum()
    magnitude = abs(program.constant) + y @ np.abs(h) + np.abs(mu) @ np.abs(program.b)
    magnitude += sizes @ (2.0 * np.abs(at) + np.abs(displacement)) + np.abs(values).sum()
    magnitude += program.weights @ np.abs(away)
    # a slope that is off by e moves the minimum over one entry by e |displacement|, and by e^2 / (2 c) where it is free
    error = terms * UNIT * sizes
    bound = value - terms * UNIT * magnitude - error @ np.abs(displacement) - (error**2 / bend).sum()
    lowered = float(np.nextafter(float(bound), -np.inf))
    return lowered if np.isfinite(lowered) else -np.inf
