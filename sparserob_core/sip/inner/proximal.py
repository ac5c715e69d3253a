"""Polish a claim of a separable program to round-off, whatever its curvature."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from sparserob_core.sip.convex_set import Array
from sparserob_core.sip.finite import FiniteProgram, FiniteSolution
from sparserob_core.sip.inner.dual_newton import newton_solve
from sparserob_core.sip.inner.duality import measure
from sparserob_core.sip.inner.repair import diagonal

# below this, relative to the linear cost, the curvature amplifies round-off too much for Newton's method alone
FLAT = 1e-4
STILL = 1e-9  # a proximal point that moves by less, relative to the decision, has arrived


def polish(program: FiniteProgram, x: Array, y: Array, mu: Array) -> FiniteSolution | None:
    """The optimum to round-off from a nearby claim, by `newton_solve` or, where the curvature is too small for it,
    `proximal_polish`."""
    curvature = diagonal(program.P, program.n) if program.S is None else None
    if curvature is None or x.shape != program.q.shape or y.shape != program.h.shape or mu.shape != program.b.shape:
        return None
    bent = float(curvature.min(initial=np.inf)) >= FLAT * _cost(program)
    found = newton_solve(program, y, mu) if bent else None
    return proximal_polish(program, x, y, mu) if found is None else found


def _cost(program: FiniteProgram) -> float:
    return float(max(program.weights.max(initial=0.0), np.abs(program.q).max(initial=0.0)))


def proximal_polish(program: FiniteProgram, x: Array, y: Array, mu: Array) -> FiniteSolution | None:
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
