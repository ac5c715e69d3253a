"""Linear programs by the simplex method: vertices, which have many zeros, and multipliers that others judge.

Of a linear program with ``r`` active rows, and as many entries of ``S x`` as variables, at most ``r`` of these entries
are strictly between 0 and their bounds at a vertex (Dantzig 1951). Nothing here is believed: whoever uses it checks
decisions and multipliers like any other.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np

from sparserob_core.sip.convex_set import Array
from sparserob_core.sip.finite import FiniteProgram

SIMPLEX_ACCURACY = 1e-10  # the finest that the simplex method offers
SIFTED_ENTRIES = 5000  # entries of a separable program from which most are left out of the simplex method
NEAREST = 1000  # of them, those that it begins with; or a share of them
NEAREST_SHARE = 0.05  # of the entries: those that the simplex method begins with, where that is more
UNSOLVED: dict[int, Literal["infeasible", "unbounded"]] = {2: "infeasible", 3: "unbounded"}  # scipy's numbers


@dataclass(frozen=True, eq=False)
class Corner:
    """Answer of the simplex method: a vertex ``x (n,)`` with its multipliers.

    The multipliers are ``y (r,)`` of the rows, ``mu (e,)`` of the equalities, and ``z (k,)`` of the image, unless the
    image is ``x`` itself or no multipliers are known.
    """

    status: Literal["optimal", "infeasible", "unbounded", "failed"]
    x: Array
    y: Array
    mu: Array
    z: Array | None = None


def vertex(program: FiniteProgram, y: Array | None = None, mu: Array | None = None) -> Array | None:
    """Return an optimal vertex ``(n,)`` of a program without a quadratic cost; ``None`` where none is found.
    Multipliers ``y (r,)``, ``mu (e,)`` that are nearly optimal spare most of the work."""
    if program.P is not None or program.blocks is not None:
        return None
    corner = solve_by_sifting(program, y, mu) if has_many_entries(program) else simplex(program)
    return corner.x if corner.status == "optimal" else None


def has_many_entries(program: FiniteProgram) -> bool:
    """Return whether a linear program is to be solved by `solve_by_sifting`: separable, with at least `SIFTED_ENTRIES`
    entries, and with rows."""
    return bool(
        program.n >= SIFTED_ENTRIES
        and program.h.size + program.b.size
        and all(term is None for term in (program.P, program.S, program.blocks))
    )


def solve_by_sifting(program: FiniteProgram, y: Array | None = None, mu: Array | None = None) -> Corner:
    """Apply `simplex` to the entries that may be between 0 and their bounds, while the others stay where the
    multipliers put them; until none of these is in the wrong place (sifting, Bixby, Gregory, Lustig, Marsten and Shanno
    1992).

    ``y (r,)``, ``mu (e,)``: multipliers to begin with.
    """
    y = np.zeros(program.h.size) if y is None or y.shape != program.h.shape else y
    mu = np.zeros(program.b.size) if mu is None or mu.shape != program.b.shape else mu
    near, count = np.zeros(program.n, dtype=bool), max(NEAREST, int(NEAREST_SHARE * program.n))
    near[:: max(1, program.n // count)] = True  # neighbours are alike: some of everything, then zoom in
    x, distance = _evaluate_entries(program, y, mu)
    while True:
        count = min(count, program.n)
        near[np.argpartition(distance, count - 1)[:count]] = True
        near |= distance < 0.0
        if near.sum() > program.n // 2:
            return simplex(program)
        fixed_values = np.where(near, 0.0, x)
        corner = simplex(_restrict(program, near, fixed_values))
        if corner.status != "optimal":  # what is left out may be what is needed
            count *= 4
            continue
        values, distance = _evaluate_entries(program, corner.y, corner.mu)
        # the others stay where they are: the next ones fit, as these do
        misplaced = np.flatnonzero(~near & (values != fixed_values))
        if not misplaced.size:
            fixed_values[near] = corner.x
            return replace(corner, x=fixed_values)
        near[misplaced[:: max(1, misplaced.size // NEAREST)]] = True


def _evaluate_entries(program: FiniteProgram, y: Array, mu: Array) -> tuple[Array, Array]:
    """Return the values ``(n,)`` of all entries at given multipliers, and the distance ``(n,)`` of each slope from a
    change.

    An entry changes where its absolute slope equals its weight. The distance is -1 for an entry that would be infinite.
    """
    slope = program.q + y @ program.G + mu @ program.A
    ends = np.where(slope > 0.0, program.lower, program.upper)
    x = np.clip(np.where(np.abs(slope) <= program.weights, 0.0, ends), program.lower, program.upper)
    finite = np.isfinite(x)
    return np.where(finite, x, 0.0), np.where(finite, np.abs(np.abs(slope) - program.weights), -1.0)


def _restrict(program: FiniteProgram, near: np.ndarray, far: Array) -> FiniteProgram:
    """Return the program in some of the entries, the others at ``far (n,)``."""
    return replace(
        program,
        q=program.q[near],
        weights=program.weights[near],
        lower=program.lower[near],
        upper=program.upper[near],
        G=program.G[:, near],
        h=program.h - program.G @ far,
        A=program.A[:, near],
        b=program.b - program.A @ far,
        P=None,
    )


def simplex(program: FiniteProgram, turns: int | None = None) -> Corner:
    """Solve the program without its quadratic cost by the dual simplex method of HiGHS, in at most so many ``turns``.
    Rows whose right-hand side is infinite ask for nothing."""
    from scipy.optimize import linprog

    is_finite = program.h < np.inf
    if not is_finite.all():
        answer = simplex(replace(program, G=program.G[is_finite], h=program.h[is_finite]), turns)
        if answer.status != "optimal":
            return answer
        y = np.zeros(program.h.size)
        y[is_finite] = answer.y
        return replace(answer, y=y)
    n, k, r = program.n, program.weights.size, program.h.size
    is_plain = program.S is None and not (program.bounded or program.weights.any())
    by_parts = _build_separable_columns if program.S is None else _build_image_columns
    columns = (_build_plain_columns if is_plain else by_parts)(program)
    answer = linprog(
        columns["c"],
        A_ub=columns["rows"] if r else None,
        b_ub=program.h if r else None,
        A_eq=columns["equal"],
        b_eq=columns["right"],
        bounds=columns["bounds"],
        method="highs-ds",
        options={"primal_feasibility_tolerance": SIMPLEX_ACCURACY, "dual_feasibility_tolerance": SIMPLEX_ACCURACY}
        | ({} if turns is None else {"maxiter": turns}),
    )
    if answer.status != 0 or answer.x is None:
        none = np.zeros(0)
        return Corner(UNSOLVED.get(answer.status, "failed"), none, none, none)
    y = -np.asarray(answer.ineqlin.marginals) if r else np.zeros(0)
    mu = -np.asarray(answer.eqlin.marginals)[-program.b.size :] if program.b.size else np.zeros(0)
    if program.S is None:
        image = answer.x if is_plain else answer.x[:k] - answer.x[k:]
        x = np.clip(image, program.lower, program.upper)
        return Corner("optimal", x, np.maximum(y, 0.0), mu)
    return Corner("optimal", np.asarray(answer.x[:n]), np.maximum(y, 0.0), mu, -np.asarray(answer.eqlin.marginals)[:k])


def _split_bounds(program: FiniteProgram) -> tuple[list[Array], list[Array]]:
    """Return bounds of the positive and of the negative part of an image, so that a vertex has exact zeros."""
    lower, upper = program.lower, program.upper
    plus = [np.maximum(lower, 0.0), np.maximum(upper, 0.0)]
    return plus, [np.maximum(-upper, 0.0), np.maximum(-lower, 0.0)]


def _build_plain_columns(program: FiniteProgram) -> dict[str, Any]:
    """Return the columns of the linear program itself, where no absolute value costs anything."""
    return {
        "c": program.q,
        "rows": program.G,
        "equal": program.A if program.b.size else None,
        "right": program.b if program.b.size else None,
        "bounds": np.column_stack([program.lower, program.upper]),
    }


def _build_separable_columns(program: FiniteProgram) -> dict[str, Any]:
    """Return the columns of the linear program with ``x = plus - minus``."""
    plus, minus = _split_bounds(program)
    return {
        "c": np.concatenate([program.weights + program.q, program.weights - program.q]),
        "rows": np.hstack([program.G, -program.G]),
        "equal": np.hstack([program.A, -program.A]) if program.b.size else None,
        "right": program.b if program.b.size else None,
        "bounds": np.vstack([np.column_stack(plus), np.column_stack(minus)]),
    }


def _build_image_columns(program: FiniteProgram) -> dict[str, Any]:
    """Return the columns of the linear program with free ``x`` and ``S x = plus - minus``."""
    from scipy.sparse import csr_array, eye_array, hstack, vstack

    n, k = program.n, program.weights.size
    images = hstack([csr_array(program.S), -eye_array(k), eye_array(k)], format="csr")
    plus, minus = _split_bounds(program)
    return {
        "c": np.concatenate([program.q, program.weights, program.weights]),
        "rows": _widen_rows(program.G, k),
        "equal": images if not program.b.size else vstack([images, _widen_rows(program.A, k)], format="csr"),
        "right": np.concatenate([np.zeros(k), program.b]),
        "bounds": np.vstack([np.tile([-np.inf, np.inf], (n, 1)), np.column_stack(plus), np.column_stack(minus)]),
    }


def _widen_rows(rows: Array, k: int) -> object:
    from scipy.sparse import csr_array, hstack

    return hstack([csr_array(rows), csr_array((rows.shape[0], 2 * k))], format="csr")
