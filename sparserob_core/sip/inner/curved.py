"""Lower bounds of programs with a quadratic cost and entries without bounds.

A tangent of the cost bounds an entry without bounds only where its slope is exactly 0, which numbers seldom are. The
cost itself bounds it: with ``P >= diag(c)`` for some ``c > 0``, ``1/2 x'P x`` is at least its tangent at any point plus
``1/2 (x - at)'diag(c)(x - at)``, so that residual slopes ``r`` cost no more than ``sum_k r_k^2 / (2 c_k)``.
"""

from __future__ import annotations

import numpy as np

from sparserob_core.sip.convex_set import Array
from sparserob_core.sip.finite import FiniteProgram
from sparserob_core.sip.inner.duality import minimisers

# Of the least eigenvalue that is estimated, what is tried to be proven. With all of it rounding decides; a hundredth of
# it is as good, for what residual slopes cost is mostly far below the tolerated gap.
PROVEN = 0.5
ROUNDING = 2.0**-52


def least_curvature(P: Array) -> Array | None:
    """Positive numbers ``c (n,)`` such that ``P - diag(c)`` is proven to be positive definite; ``None`` where none are
    found.

    ``P (n, n)`` is scaled to a diagonal of about 1 by powers of two, so that units do not matter, and shifted by a part
    of its least eigenvalue. Where the Cholesky factorisation then ends, what it proves is off by no more than
    ``(n + 2) eps`` of the trace (Rump 2006, "Verification of positive definiteness", BIT 46, theorem 2.3).
    """
    n, diagonal = len(P), P.diagonal()
    if not (diagonal > 0.0).all():
        return None
    unit = np.exp2(-np.round(0.5 * np.log2(diagonal)))
    scaled = P * unit * unit[:, np.newaxis]
    share = PROVEN * float(np.linalg.eigvalsh(scaled)[0])
    lost = 2.0 * (n + 2) * ROUNDING * float(scaled.trace())
    if not share > lost:
        return None
    try:
        np.linalg.cholesky(scaled - share * np.eye(n))
    except np.linalg.LinAlgError:
        return None
    return np.asarray((share - lost) / unit**2 * (1.0 - 4.0 * ROUNDING), dtype=float)


def curved_bound(program: FiniteProgram, bend: Array, y: Array, mu: Array, at: Array) -> tuple[float, Array]:
    """A lower bound of ``program`` by the multipliers ``y (r,)``, at least 0, and ``mu (e,)``, with the tangent of its
    cost at ``at (n,)``, or at the point nearby that is better, and the curvature ``bend (n,)``; and that point.

    Rounding is counted: every sum of ``k`` products is off by at most ``(k + 2) eps`` of their absolute values (Higham
    2002, section 3.1).
    """
    assert program.P is not None
    used = y > 0.0
    h, b = np.where(used, program.h, 0.0), program.b
    pull = program.q + y @ program.G + mu @ program.A
    with np.errstate(all="ignore"):
        step = np.linalg.lstsq(program.P.toarray(), -(program.P @ at + pull), rcond=None)[0]
    offers = [at, at + step] if np.isfinite(step).all() else [at]
    bounds = [_bound_at(program, bend, (y, mu, h, b, pull), one) for one in offers]
    best = int(np.argmax(bounds))
    return bounds[best], offers[best]


def _bound_at(program: FiniteProgram, bend: Array, given: tuple[Array, Array, Array, Array, Array], at: Array) -> float:
    """The bound with the tangent at one point."""
    assert program.P is not None
    y, mu, h, b, pull = given
    terms = program.n + y.size + mu.size + 4
    size = abs(program.P) @ np.abs(at)
    slope = program.P @ at + pull
    sizes = np.abs(program.q) + y @ np.abs(program.G) + np.abs(mu) @ np.abs(program.A) + size
    away = minimisers(program.weights, bend, slope - bend * at, program.lower, program.upper)
    moved = away - at
    values = program.weights * np.abs(away) + slope * moved + 0.5 * bend * moved**2
    # at the point itself: 1/2 at'P at + pull'at, and what the slopes allow beyond it
    constant = program.constant - float(y @ h) - float(mu @ b)
    value = constant + 0.5 * float(at @ (program.P @ at)) + float(pull @ at) + float(values.sum())
    magnitude = abs(program.constant) + float(y @ np.abs(h)) + float(np.abs(mu) @ np.abs(b))
    magnitude += float(sizes @ (2.0 * np.abs(at) + np.abs(moved))) + float(np.abs(values).sum())
    magnitude += float(program.weights @ np.abs(away))
    # a slope that is off by e moves the minimum over one entry by e |moved|, and by e^2 / (2 c) where it is free
    error = terms * ROUNDING * sizes
    bound = value - terms * ROUNDING * magnitude - float(error @ np.abs(moved)) - float((error**2 / bend).sum())
    return bound if np.isfinite(bound) else -np.inf
