"""More digits from the same solver: what an answer misses is a program of its kind, blown up to ordinary size.

Gleixner, Steffy and Wolter (2016, "Iterative refinement for linear programming", INFORMS J. Comput. 28) for linear
programs; Weber, Sager and Gleixner (2019, "Solving quadratic programs to high precision using scaled iterative
refinement", Math. Prog. Comp. 11) for quadratic ones. It helps where rows are nearly parallel, as those of the end of
an unstable system are, and where one variable is cheaper than another by more than the digits of a solver.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from sparserob_core.sip.convex_set import Array
from sparserob_core.sip.solver import Claim, QuadraticProgram, Solver

REFINEMENT_STEPS = 4  # at most, each with the residual of the last one
GROWTH = 2.0**20  # by which a step blows up more than the last one, at most
LARGEST_SCALE = 2.0**60  # by which a residual is enlarged: a smaller one is rounding
ABSENT_BOUND = 2.0**30  # a bound at this distance is none
PROHIBITIVE_COST = 2.0**30  # a variable that costs this much stays at its bound
DEPENDENT_ROW_SHARE = 1e-13  # of the largest entry: what is left of a row that depends on others


def refine_claims(program: QuadraticProgram, solver: Solver, start: Claim | None, accuracy: float) -> Iterator[Claim]:
    """Yield better and better claims from ``start``, or from zero; ends where the solver gives no numbers.

    Inequalities become ``G x + s = h`` with ``s >= 0``, so that only equalities ``M w = c`` and bounds on
    ``w = (x, s)`` are left; these may be combined (`_orthogonalise_rows`). Take multipliers ``y`` and factors ``p, d``,
    which are powers of two and the inverses of what is missed. The next program minimises
    ``d/(2p) v'P v + d (q + P w + M'y)'v`` subject to ``M v = p (c - M w)`` and ``p (lower - w) <= v <= p (upper - w)``.
    Then ``w + v/p`` and ``y + y'/d`` miss less.
    """
    from scipy.sparse import block_array, block_diag, csc_array, diags_array

    n, r = program.q.size, program.h.size
    combine = _orthogonalise_rows(program.G.toarray()) if r else np.zeros((0, 0))
    units = np.exp2(-np.round(np.log2(np.abs(combine).max(axis=0, initial=0.0)))) if r else np.ones(0)  # of slacks
    rows = [csc_array(combine @ program.G), csc_array(combine * units)]
    M = csc_array(block_array([rows, [program.A, None]]) if program.b.size else block_array([rows])) if r else program.A
    P = csc_array(block_diag([program.P, csc_array((r, r))], format="csc"))
    c, q = np.concatenate([combine @ program.h, program.b]), np.concatenate([program.q, np.zeros(r)])
    lower, upper = np.concatenate([program.lower, np.zeros(r)]), np.concatenate([program.upper, np.full(r, np.inf)])
    w, y = np.zeros(n + r), np.zeros(c.size)
    if start is not None:
        w = np.concatenate([start.x, (program.h - program.G @ start.x) / units])
        y = np.concatenate([np.linalg.solve(combine.T, np.maximum(start.z, 0.0)), start.y])
    p = d = 1.0
    for number in range(REFINEMENT_STEPS):
        w = np.clip(w, lower, upper)
        residual, slope = c - M @ w, q + P @ w + M.T @ y
        if number or start is not None:
            p = _choose_factor(p, float(np.abs(residual).max(initial=0.0)))
            d = _choose_factor(d, _measure_dual_residual(slope, p * (w - lower), p * (upper - w)))
        below, above, cost = p * (lower - w), p * (upper - w), d * slope
        is_held = (cost > PROHIBITIVE_COST) & (below > -1.0) | (cost < -PROHIBITIVE_COST) & (above < 1.0)
        fixed, free = np.where(is_held, np.where(cost > 0.0, below, above), 0.0), np.flatnonzero(~is_held)
        step = QuadraticProgram(
            csc_array(diags_array(np.full(free.size, d / p)) @ P[free][:, free]),
            cost[free],
            csc_array((0, free.size)),
            np.zeros(0),
            csc_array(M[:, free]),
            p * residual - M @ fixed,
            np.where(below < -ABSENT_BOUND, -np.inf, below)[free],
            np.where(above > ABSENT_BOUND, np.inf, above)[free],
        )
        answer = solver.solve(step, accuracy)
        if answer.x.shape != free.shape or answer.y.shape != c.shape:
            return
        if not (np.isfinite(answer.x).all() and np.isfinite(answer.y).all()):
            return
        v = fixed
        v[free] = answer.x
        w, y = w + v / p, y + answer.y / d
        x, z = np.clip(w[:n], program.lower, program.upper), np.maximum(combine.T @ y[:r], 0.0)
        yield Claim(answer.status, x, z, y[r:], np.zeros(n), answer.message)


def _orthogonalise_rows(G: Array) -> Array:
    """Return a nonsingular ``T (r, r)`` for which ``T G`` has orthonormal rows, and rows of 0 where ``G (r, n)`` has
    rows that depend on others."""
    from scipy.linalg import qr, solve_triangular

    count = G.shape[0]
    R, order = qr(G.T, mode="r", pivoting=True)
    L = np.eye(count)
    kept = min(R.shape[0], count)
    L[:, :kept] = R[:kept].T
    size = np.abs(np.diag(R))
    rank = int((size > DEPENDENT_ROW_SHARE * size.max(initial=0.0)).sum())
    L[:, rank:] = np.eye(count)[:, rank:]
    return np.asarray(solve_triangular(L, np.eye(count)[order], lower=True))


def _choose_factor(before: float, residual: float) -> float:
    """Return the power of two that makes what is missed of size 1, at most `GROWTH` times the one before."""
    wanted = LARGEST_SCALE if residual < 1.0 / LARGEST_SCALE else float(np.exp2(np.floor(-np.log2(residual))))
    return float(min(max(wanted, before), GROWTH * before, LARGEST_SCALE))


def _measure_dual_residual(slope: Array, below: Array, above: Array) -> float:
    """Return the dual residual: the largest absolute slope of an entry that has room to move against its slope.

    ``below`` and ``above`` are the distances to the bounds, blown up; room is a distance of more than 1.
    """
    return float(np.where(np.where(slope > 0.0, below, above) > 1.0, np.abs(slope), 0.0).max(initial=0.0))
