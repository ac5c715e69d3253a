"""Newton's method on the dual of a separable program, whose unknowns are the rows, about ten.

`DualNewton` is the solver ``dual_newton``, which begins with nothing; `polish` brings a claim that is near to
round-off. Where the curvature is too small for Newton's method alone, both take proximal points, each by Newton's
method.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import ClassVar, NamedTuple

import numpy as np
import numpy.typing as npt
from pydantic import Field

from sparserob_core.options import Options
from sparserob_core.shapes import Bool, Float, shaped
from sparserob_core.sip.convex_set import Array
from sparserob_core.sip.finite import FiniteProgram, FiniteSolution, diagonal
from sparserob_core.sip.inner.change_of_variables import change_variables
from sparserob_core.sip.inner.duality import bent_minimisers, measure
from sparserob_core.sip.solver import Claim, QuadraticProgram, Solver

NEWTON_ITERATIONS = 60  # at most, before the program is left to another solver
IDLE_STEPS = 10  # without a smaller error, after which the method gives up
LINE_SEARCH_STEPS = 25  # at most, in either direction: lengths are multiplied by four, so that 25 reach any size
RESIDUAL_TARGET = 1e-12  # of the decision: a residual at which the method ends, some roundings of a product
TINY = float(np.finfo(float).tiny)
DAMPING, DAMPED = 1e-13, 1e4  # of the trace of a Hessian, and what that becomes where a step climbs nothing
# below this, relative to the linear cost, the curvature amplifies round-off too much for Newton's method alone
MIN_CURVATURE_SHARE = 1e-4
ARRIVAL_DISTANCE = 1e-9  # a proximal point that moves by less, relative to the decision, has arrived
HEAVIEST, LIGHTEST = 1e6, 1e-9  # weights of a proximal point, of the largest coefficient of the cost
LIGHTER, HEAVIER = 0.1, 30.0  # what a weight becomes after a proximal point that was found, and one that was not
NOT_SEPARABLE = "its quadratic cost couples variables: a separable program is needed"


class DualNewton(Solver, Options):
    """Separable programs alone, to round-off: bounds and costs of every entry for itself, coupled by few rows.

    The dual of such a program has the rows for unknowns, is concave, and piecewise quadratic where the cost is strictly
    convex: semismooth Newton (Qi and Sun 1993) ends after finitely many steps. Where it is not, or hardly, proximal
    points (Rockafellar 1976) with a weight that falls as long as Newton's method follows. The work of a step is
    ``O(r^2 n)`` for ``r`` rows and ``n`` entries, and what is claimed is checked like any other claim. A program whose
    quadratic cost couples variables is given up; so is one without a solution, whose rows are then relaxed to prove it.
    """

    sparse: ClassVar[bool] = False

    points: int = Field(default=60, ge=1, le=10_000)
    """Proximal points before giving up."""

    def solve(self, program: QuadraticProgram, accuracy: float) -> Claim:
        """See `Solver.solve`; ``solved`` where residual and gap, both measured here, are at most ``accuracy``, or what
        double precision can tell."""
        P = program.P if program.P.nnz else None
        if diagonal(P, program.q.size) is None:
            none = np.full(program.q.size, np.nan)
            return Claim("failed", none, np.zeros(program.h.size), np.zeros(program.b.size), none, NOT_SEPARABLE)
        finite = FiniteProgram(
            program.q,
            np.zeros(program.q.size),
            program.lower,
            program.upper,
            program.G.toarray(),
            program.h,
            program.A.toarray(),
            program.b,
            P=P,
        )
        solution, steps = solve_from_nothing(finite, accuracy, self.points)
        gradient = 0.0 if finite.P is None else finite.P @ solution.x
        slope = program.q + gradient + solution.y @ finite.G + solution.mu @ finite.A
        low, high = solution.x <= program.lower, solution.x >= program.upper
        box = np.where(low, np.minimum(-slope, 0.0), 0.0) + np.where(high, np.maximum(-slope, 0.0), 0.0)
        converged = solution.residual <= accuracy and solution.gap <= max(accuracy, _estimate_rounding(solution))
        message = f"{steps} proximal points; residual {solution.residual:.1e}, gap {solution.gap:.1e}"
        return Claim("solved" if converged else "failed", solution.x, solution.y, solution.mu, box, message)


def not_separable(program: FiniteProgram) -> str:
    """Return the reason why `DualNewton` cannot solve a program, in words; an empty text where it can."""
    if program.blocks is not None:
        return "its cost takes norms of several entries together"
    easier = None if program.S is None else change_variables(program)
    if program.S is not None and easier is None:
        return "its costs and bounds are of sums of entries, and there are no variables in which each has its own"
    if (easier.program if easier else program).curvature is None:
        return "its quadratic cost, or its regulariser, couples entries"
    return ""


def solve_from_nothing(program: FiniteProgram, accuracy: float, points: int) -> tuple[FiniteSolution, int]:
    """Return the best answer to a separable program that at most so many proximal points find from nothing, and how
    many it took; it is not sought further once residual and gap are at most ``accuracy``."""
    from scipy.sparse import dia_array

    curvature = program.curvature
    assert curvature is not None
    least, cost = float(curvature.min(initial=np.inf)), program.steepest or 1.0
    y, mu, x = np.zeros(program.h.size), np.zeros(program.b.size), np.clip(0.0, program.lower, program.upper)
    best = measure(program, x, y, mu, message="nothing")
    weight, idle, number = cost, 0, 0
    while number < points and idle <= IDLE_STEPS and weight <= HEAVIEST * cost:
        number += 1
        if weight <= least:
            near = newton_solve(program, y, mu)  # it is bent enough itself
        else:
            P = dia_array(((curvature + weight)[None], [0]), shape=(program.n, program.n)).tocsc()
            near = newton_solve(replace(program, P=P, q=program.q - weight * x), y, mu)
        if near is None:
            weight = HEAVIER * weight
            continue
        solution = measure(program, near.x, near.y, near.mu, message="dual Newton")
        x, y, mu = solution.x, solution.y, solution.mu
        is_better = solution.error < 0.5 * best.error
        best, idle = (solution, 0) if is_better else (best, idle + 1)
        if best.residual <= accuracy and best.gap <= max(0.1 * accuracy, _estimate_rounding(best)):
            break
        weight = max(LIGHTER * weight, LIGHTEST * cost)
    return best, number


@shaped
def polish(
    program: FiniteProgram, x: Float[Array, " n"], y: Float[Array, " r"], mu: Float[Array, " e"]
) -> FiniteSolution | None:
    """Return the optimum to round-off from a nearby claim, by `newton_solve` or, where the curvature is too small for
    it, `proximal_polish`."""
    curvature = program.curvature if program.separable else None
    if curvature is None or x.shape != program.q.shape or y.shape != program.h.shape or mu.shape != program.b.shape:
        return None
    is_curved = float(curvature.min(initial=np.inf)) >= MIN_CURVATURE_SHARE * program.steepest
    solution = newton_solve(program, y, mu, x0=x) if is_curved else None
    return proximal_polish(program, x, y, mu) if solution is None else solution


@shaped
def proximal_polish(
    program: FiniteProgram, x: Float[Array, " n"], y: Float[Array, " r"], mu: Float[Array, " e"]
) -> FiniteSolution | None:
    """Take proximal points ``min cost + 1/2 weight |x - centre|^2`` (Rockafellar 1976) from a near-optimal ``x``, each
    by `newton_solve`.

    A polyhedral program ends after finitely many rounds at an exact optimum. A strictly convex one needs weights as
    small as its curvature to bring ``x`` itself, not only the value, to the optimiser. The best round is returned.
    """
    curvature = program.curvature
    if program.S is not None or curvature is None:
        return None
    from scipy.sparse import dia_array

    is_flat = not curvature.min(initial=np.inf) > 0
    best: FiniteSolution | None = None
    for weight in _list_weights(program.steepest or 1.0, float(curvature.min(initial=np.inf))):
        P = dia_array(((curvature + weight)[None], [0]), shape=(program.n, program.n)).tocsc()
        near = newton_solve(replace(program, P=P, q=program.q - weight * x), y, mu)
        if near is None:
            break
        solution = measure(program, near.x, near.y, near.mu, message="proximal Newton")
        distance = float(np.abs(solution.x - x).max(initial=0.0))
        x, y, mu = solution.x, solution.y, solution.mu
        is_better = best is None or _is_better(solution, best)
        best = solution if is_better or best is None else best
        if is_flat and not (is_better and solution.gap > _estimate_rounding(solution)):
            break
        if (
            not is_flat
            and distance <= ARRIVAL_DISTANCE * (1.0 + float(np.abs(x).max(initial=0.0)))
            and weight <= 2 * curvature.min()
        ):
            break
    return best


def _list_weights(cost: float, curvature: float) -> Iterator[float]:
    """Yield weights: a constant one for a polyhedral program; otherwise down to the curvature, where each round halves
    the distance to the optimiser."""
    weight = 0.1 * cost
    for _ in range(30):
        yield weight
        if curvature > 0:
            weight = max(0.1 * weight, curvature, 1e-6 * cost)


def _is_better(one: FiniteSolution, other: FiniteSolution) -> bool:
    return one.gap <= max(0.9 * other.gap, _estimate_rounding(other)) and one.residual <= max(other.residual, 1e-10)


def _estimate_rounding(solution: FiniteSolution) -> float:
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
        """Return the minimising ``x (n,)`` of the Lagrangian whose linear part is ``slope (n,)``."""
        program = self.program
        return bent_minimisers(program.weights, self.curvature, slope, program.lower, program.upper)

    @shaped
    def at(self, dual: Float[Array, " v"]) -> _Point:
        x = self.decision(self.program.q + dual @ self.M)
        return _Point(dual, x, self.M @ x - self.c)

    def error(self, point: _Point) -> float:
        """Return the largest complementarity error ``|min(y_i, h_i - G_i x)|``, or ``|A_i x - b_i|``."""
        natural = np.where(self.signed, np.minimum(point.dual, -point.gradient), point.gradient)
        return float(np.abs(natural).max(initial=0.0))

    @shaped
    def free(self, x: Float[Array, " n"]) -> Bool[np.ndarray, " n"]:
        """Return a mask of the entries that are strictly between their bounds and not 0."""
        free: np.ndarray = (x != 0) & (x > self.program.lower) & (x < self.program.upper)
        return free

    @shaped
    def hessian(self, point: _Point, damping: float = DAMPING) -> Float[Array, "v v"]:
        """Return minus the generalised Hessian, damped so that duplicated and flat directions stay solvable."""
        free = self.free(point.x)
        rows = self.M[:, free]
        hessian: Array = (rows / self.curvature[free]) @ rows.T
        sizes = hessian.reshape(-1)[:: hessian.shape[0] + 1]  # its diagonal, to write to
        flat = sizes <= 1e-14 / self.curvature.max()
        extra = damping * float(sizes.sum())
        sizes += extra + np.where(flat, np.linalg.norm(point.gradient), 0.0) + TINY if flat.any() else extra + TINY
        return hessian


@shaped
def newton_solve(
    program: FiniteProgram,
    y0: Float[Array, " r"],
    mu0: Float[Array, " e"] | None = None,
    steps: int = NEWTON_ITERATIONS,
    patience: int = IDLE_STEPS,
    x0: Float[Array, " n"] | None = None,
) -> FiniteSolution | None:
    """Return the optimum of a program with identity image and a positive diagonal ``P``, from dual variables
    ``y0 (r,)``, ``mu0 (e,)``; or from those that go with the entries of ``x0 (n,)`` that are free, where these are
    nearer.

    Semismooth Newton (Qi and Sun 1993) on the dual, whose minimising ``x`` is explicit: a soft threshold and a clip per
    entry. Converges in a finite number of steps, as the dual is piecewise quadratic, but from far away it may take too
    many: then ``None``, as for a program of another structure.
    """
    curvature = program.curvature if program.S is None and program.P is not None else None
    if curvature is None or not (curvature > 0).all() or y0.size != program.h.size:
        return None
    keep = np.isfinite(program.h)
    G, h = (program.G, program.h) if keep.all() else (program.G[keep], program.h[keep])
    M, c = (np.vstack([G, program.A]), np.concatenate([h, program.b])) if program.b.size else (G, h)
    norms = np.sqrt(np.einsum("ij,ij->i", M, M))
    norms[norms == 0] = 1.0
    start = np.concatenate([np.maximum(y0[keep], 0.0), np.zeros(program.b.size) if mu0 is None else mu0]) * norms
    dual = _Dual(program, curvature, M / norms[:, None], c / norms, np.arange(c.size) < h.size)
    try:
        with np.errstate(over="ignore"):
            first = dual.at(start)
            if x0 is not None and (dual.free(x0) != dual.free(first.x)).any():
                predicted = dual.at(_predict_multipliers(dual, start, x0))
                first = predicted if dual.error(predicted) < dual.error(first) else first
            point = _ascend(dual, first, steps, patience)
    except np.linalg.LinAlgError:
        return None
    if point is None:
        return None
    multipliers = point.dual / norms
    y = np.zeros(program.h.size)
    y[keep] = multipliers[: h.size]
    return measure(program, point.x, y, multipliers[h.size :], message="Newton")


@shaped
def _predict_multipliers(dual: _Dual, start: Float[Array, " v"], x: Float[Array, " n"]) -> Float[Array, " v"]:
    """Return the multipliers under which the free entries of ``x (n,)`` move to where the rows hold, while the others
    stay: where the program has changed a little, or only its curvature, mostly the optimal ones."""
    x = np.minimum(np.maximum(x, dual.program.lower), dual.program.upper)
    free, residual = dual.free(x), dual.M @ x - dual.c
    rows, curvature = dual.M[:, free], dual.curvature[free]
    linear = (
        residual
        - rows @ x[free]
        - (rows / curvature) @ (dual.program.q[free] + dual.program.weights[free] * np.sign(x[free]))
    )
    return _solve_non_negative(dual.hessian(_Point(start, x, residual)), linear, dual.signed, start > 0)


@shaped
def _ascend(dual: _Dual, point: _Point, steps: int, patience: int) -> _Point | None:
    scale = 1.0 + float(np.abs(point.x).max(initial=0.0))
    error = least = dual.error(point)
    stalled, damping = 0, DAMPING
    for _ in range(steps):
        if error <= RESIDUAL_TARGET * scale:
            return point
        if not np.isfinite(error) or stalled > patience:
            return None
        hessian = dual.hessian(point, damping)
        target = _solve_non_negative(hessian, point.gradient + hessian @ point.dual, dual.signed, point.dual > 0)
        trial = dual.at(target)
        if not dual.error(trial) < 0.5 * least:
            step = target - point.dual
            length = _search_line(dual, point, step)
            # where too few entries are free, a step is as good as any direction: nearer to the gradient then
            damping = DAMPING if length > 0.0 else min(DAMPED * damping, 1.0)
            trial = dual.at(point.dual + length * step)
        point, error = trial, dual.error(trial)
        stalled = 0 if error < 0.9 * least else stalled + 1
        least = min(least, error)
    return None


@shaped
def _solve_non_negative(
    hessian: Float[Array, "v v"],
    linear: Float[Array, " v"],
    signed: Bool[np.ndarray, " v"],
    support: Bool[np.ndarray, " v"],
) -> Float[Array, " v"]:
    """Return the argmin of ``1/2 v'Hv - linear'v``, ``v >= 0`` where signed, by active sets from a first support
    (Lawson and Hanson 1974, chapter 23). Raises `numpy.linalg.LinAlgError` where they go round, as rounding lets them
    where rows crowd: a step to such a point has never led to an optimum, and takes as long as all others together."""
    passive = support | ~signed
    v = np.zeros(signed.size)
    for _ in range(3 * signed.size + 10):
        wanted = np.zeros(signed.size)
        if passive.all():
            wanted[:] = np.linalg.solve(hessian, linear)
        else:
            wanted[passive] = np.linalg.solve(hessian[passive][:, passive], linear[passive])
        blocked = signed & passive & (wanted <= 0)
        if blocked.any():
            share = float((v[blocked] / (v[blocked] - wanted[blocked] + np.finfo(float).tiny)).min())
            v = v + share * (wanted - v)
            passive &= ~(blocked & (v <= 1e-15 * np.abs(wanted)))
            v = np.where(passive, v, 0.0)
            continue
        v = wanted
        if passive.all():
            return v
        pull = np.where(passive, -np.inf, linear - hessian @ v)
        if not pull.max() > 1e-13 * float(np.abs(linear).max()):
            return v
        passive[int(np.argmax(pull))] = True
    raise np.linalg.LinAlgError("active sets go round")


@shaped
def _search_line(dual: _Dual, point: _Point, step: Float[Array, " v"]) -> float:
    """Return a feasible length at which the dual's derivative along ``step`` has fallen to a tenth, by bisection and
    false position."""
    slope, change, constant = dual.program.q + point.dual @ dual.M, step @ dual.M, float(dual.c @ step)
    first = float(point.gradient @ step)
    if not first > 0:
        return 0.0
    falling = dual.signed & (step < 0)
    furthest = max(1.0, float((point.dual[falling] / -step[falling]).min(initial=np.inf)))
    low, rising, high = 0.0, first, 1.0
    for _ in range(LINE_SEARCH_STEPS):
        derivative = float(change @ dual.decision(slope + high * change)) - constant
        if derivative <= 0.1 * first:
            break
        if high == furthest:
            return high
        low, rising, high = high, derivative, min(4.0 * high, furthest)
    if derivative > 0:
        return high
    length, sinking = high, derivative
    for _ in range(LINE_SEARCH_STEPS):
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
