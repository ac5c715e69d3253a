"""Polish a claim of a separable program to round-off.

Newton's method on the dual, whose unknowns are the rows, about ten; and proximal points, each by Newton's method, where
the curvature is too small for it alone.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from sparserob_core.shapes import Bool, Float, shaped
from sparserob_core.sip.convex_set import Array
from sparserob_core.sip.finite import FiniteProgram, FiniteSolution, diagonal
from sparserob_core.sip.inner.duality import measure, minimisers

ITERATIONS = 60
PATIENCE = 10
SEARCH = 25
TARGET = 1e-12
# below this, relative to the linear cost, the curvature amplifies round-off too much for Newton's method alone
FLAT = 1e-4
STILL = 1e-9  # a proximal point that moves by less, relative to the decision, has arrived


@shaped
def polish(
    program: FiniteProgram, x: Float[Array, " n"], y: Float[Array, " r"], mu: Float[Array, " e"]
) -> FiniteSolution | None:
    """The optimum to round-off from a nearby claim, by `newton_solve` or, where the curvature is too small for it,
    `proximal_polish`."""
    curvature = diagonal(program.P, program.n) if program.S is None and program.blocks is None else None
    if curvature is None or x.shape != program.q.shape or y.shape != program.h.shape or mu.shape != program.b.shape:
        return None
    bent = float(curvature.min(initial=np.inf)) >= FLAT * _cost(program)
    found = newton_solve(program, y, mu) if bent else None
    return proximal_polish(program, x, y, mu) if found is None else found


def _cost(program: FiniteProgram) -> float:
    return float(max(program.weights.max(initial=0.0), np.abs(program.q).max(initial=0.0)))


@shaped
def proximal_polish(
    program: FiniteProgram, x: Float[Array, " n"], y: Float[Array, " r"], mu: Float[Array, " e"]
) -> FiniteSolution | None:
    """Proximal points ``min cost + 1/2 weight |x - centre|^2`` (Rockafellar 1976) from a near-optimal ``x``, each by
    `newton_solve`.

    A polyhedral program ends after finitely many rounds at an exact optimum. A strictly convex one needs weights as
    small as its curvature to bring ``x`` itself, not only the value, to the optimiser. The best round is returned.
    """
    curvature = diagonal(program.P, program.n)
    if program.S is not None or curvature is None:
        return None
    from scipy.sparse import dia_array

    flat = not curvature.min(initial=np.inf) > 0
    best: FiniteSolution | None = None
    for weight in _weights(_cost(program) or 1.0, float(curvature.min(initial=np.inf))):
        P = dia_array(((curvature + weight)[None], [0]), shape=(program.n, program.n)).tocsc()
        near = newton_solve(replace(program, P=P, q=program.q - weight * x), y, mu)
        if near is None:
            break
        found = measure(program, near.x, near.y, near.mu, message="proximal Newton")
        moved = float(np.abs(found.x - x).max(initial=0.0))
        x, y, mu = found.x, found.y, found.mu
        improved = best is None or _better(found, best)
        best = found if improved or best is None else best
        if flat and not (improved and found.gap > _noise(found)):
            break
        if not flat and moved <= STILL * (1.0 + float(np.abs(x).max(initial=0.0))) and weight <= 2 * curvature.min():
            break
    return best


def _weights(cost: float, curvature: float) -> Iterator[float]:
    """Constant for a polyhedral program; otherwise down to the curvature, where each round halves the distance to the
    optimiser."""
    weight = 0.1 * cost
    for _ in range(30):
        yield weight
        if curvature > 0:
            weight = max(0.1 * weight, curvature, 1e-6 * cost)


def _better(one: FiniteSolution, other: FiniteSolution) -> bool:
    return one.gap <= max(0.9 * other.gap, _noise(other)) and one.residual <= max(other.residual, 1e-10)


def _noise(solution: FiniteSolution) -> float:
    return 1e-13 * (1.0 + abs(solution.value))


class _Point(NamedTuple):
    """Dual variables, the decision they imply, and the gradient ``M x - c`` of the dual there."""

    dual: Array
    x: Array
    gradient: Array


@dataclass(frozen=True)
class _Dual:
    """Concave, once differentiable and piecewise quadratic:
    ``d(v) = -c'v + sum_k min_s weights_k |s| + 1/2 p_k s^2 + (q + M'v)_k s``."""

    program: FiniteProgram
    curvature: Array
    M: Array
    c: Array
    signed: npt.NDArray[np.bool_]

    @shaped
    def decision(self, slope: Float[Array, " n"]) -> Float[Array, " n"]:
        """The minimising ``x (n,)`` of the Lagrangian whose linear part is ``slope (n,)``."""
        program = self.program
        return minimisers(program.weights, self.curvature, slope, program.lower, program.upper)

    @shaped
    def at(self, dual: Float[Array, " v"]) -> _Point:
        x = self.decision(self.program.q + dual @ self.M)
        return _Point(dual, x, self.M @ x - self.c)

    def error(self, point: _Point) -> float:
        """The largest complementarity error ``|min(y_i, h_i - G_i x)|``, or ``|A_i x - b_i|``."""
        natural = np.where(self.signed, np.minimum(point.dual, -point.gradient), point.gradient)
        return float(np.abs(natural).max(initial=0.0))

    @shaped
    def hessian(self, point: _Point) -> Float[Array, "v v"]:
        """Minus the generalised Hessian, damped so that duplicated and flat directions stay solvable."""
        free = (point.x != 0) & (point.x > self.program.lower) & (point.x < self.program.upper)
        rows = self.M[:, free]
        hessian: Array = (rows / self.curvature[free]) @ rows.T
        flat = hessian.diagonal() <= 1e-14 / self.curvature.max()
        damping = (
            1e-13 * float(hessian.trace()) + np.where(flat, np.linalg.norm(point.gradient), 0.0) + np.finfo(float).tiny
        )
        hessian[np.diag_indices_from(hessian)] += damping
        return hessian


@shaped
def newton_solve(
    program: FiniteProgram, y0: Float[Array, " r"], mu0: Float[Array, " e"] | None = None
) -> FiniteSolution | None:
    """The optimum of a program with identity image and a positive diagonal ``P``, from dual variables ``y0 (r,)``,
    ``mu0 (e,)``.

    Semismooth Newton (Qi and Sun 1993) on the dual, whose minimising ``x`` is explicit: a soft threshold and a clip per
    entry. Converges in a finite number of steps, as the dual is piecewise quadratic, but from far away it may take too
    many: then ``None``, as for a program of another structure.
    """
    curvature = diagonal(program.P, program.n) if program.S is None and program.P is not None else None
    if curvature is None or not (curvature > 0).all() or y0.size != program.h.size:
        return None
    keep = np.isfinite(program.h)
    M, c = np.vstack([program.G[keep], program.A]), np.concatenate([program.h[keep], program.b])
    norms = np.sqrt(np.einsum("ij,ij->i", M, M))
    norms[norms == 0] = 1.0
    start = np.concatenate([np.maximum(y0[keep], 0.0), np.zeros(program.b.size) if mu0 is None else mu0]) * norms
    dual = _Dual(program, curvature, M / norms[:, None], c / norms, np.arange(c.size) < int(keep.sum()))
    try:
        point = _ascend(dual, start)
    except np.linalg.LinAlgError:
        return None
    if point is None:
        return None
    multipliers = point.dual / norms
    y = np.zeros(program.h.size)
    y[keep] = multipliers[: int(keep.sum())]
    return measure(program, point.x, y, multipliers[int(keep.sum()) :], message="Newton")


@shaped
def _ascend(dual: _Dual, start: Float[Array, " v"]) -> _Point | None:
    point = dual.at(start)
    scale = 1.0 + float(np.abs(point.x).max(initial=0.0))
    error = least = dual.error(point)
    stalled = 0
    for _ in range(ITERATIONS):
        if error <= TARGET * scale:
            return point
        if not np.isfinite(error) or stalled > PATIENCE:
            return None
        hessian = dual.hessian(point)
        target = _non_negative(hessian, point.gradient + hessian @ point.dual, dual.signed, point.dual > 0)
        trial = dual.at(target)
        if not dual.error(trial) < 0.5 * least:
            step = target - point.dual
            trial = dual.at(point.dual + _line_maximum(dual, point, step) * step)
        point, error = trial, dual.error(trial)
        stalled = 0 if error < 0.9 * least else stalled + 1
        least = min(least, error)
    return None


@shaped
def _non_negative(
    hessian: Float[Array, "v v"],
    linear: Float[Array, " v"],
    signed: Bool[np.ndarray, " v"],
    support: Bool[np.ndarray, " v"],
) -> Float[Array, " v"]:
    """argmin ``1/2 v'Hv - linear'v``, ``v >= 0`` where signed, by active sets from a first support (Lawson and Hanson
    1974, chapter 23)."""
    passive = support | ~signed
    v = np.zeros(signed.size)
    floor = 1e-13 * float(np.abs(linear).max(initial=0.0))
    for _ in range(3 * signed.size + 10):
        wanted = np.zeros_like(v)
        wanted[passive] = np.linalg.solve(hessian[np.ix_(passive, passive)], linear[passive])
        blocked = signed & passive & (wanted <= 0)
        if blocked.any():
            share = float((v[blocked] / (v[blocked] - wanted[blocked] + np.finfo(float).tiny)).min())
            v = v + share * (wanted - v)
            passive &= ~(blocked & (v <= 1e-15 * np.abs(wanted)))
            v = np.where(passive, v, 0.0)
            continue
        v = wanted
        pull = np.where(passive, -np.inf, linear - hessian @ v)
        if not pull.max(initial=-np.inf) > floor:
            break
        passive[int(np.argmax(pull))] = True
    return v


@shaped
def _line_maximum(dual: _Dual, point: _Point, step: Float[Array, " v"]) -> float:
    """A feasible length at which the dual's derivative along ``step`` has fallen to a tenth, by bisection and false
    position."""
    slope, change, constant = dual.program.q + point.dual @ dual.M, step @ dual.M, float(dual.c @ step)
    first = float(point.gradient @ step)
    if not first > 0:
        return 0.0
    falling = dual.signed & (step < 0)
    furthest = max(1.0, float((point.dual[falling] / -step[falling]).min(initial=np.inf)))
    low, rising, high = 0.0, first, 1.0
    for _ in range(SEARCH):
        derivative = float(change @ dual.decision(slope + high * change)) - constant
        if derivative <= 0.1 * first:
            break
        if high == furthest:
            return high
        low, rising, high = high, derivative, min(4.0 * high, furthest)
    if derivative > 0:
        return high
    length, sinking = high, derivative
    for _ in range(SEARCH):
        if abs(derivative) <= 0.1 * first:
            return length
        if derivative > 0:
            low, rising = length, derivative
        else:
            high, sinking = length, derivative
        share = rising / (rising - sinking)
        length = low + (high - low) * min(max(share, 0.1), 0.9)
        derivative = float(change @ dual.decision(slope + length * change)) - constant
    return low
