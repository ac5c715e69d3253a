"""A vertex of the set of optimal decisions: of a linear program with ``r`` active rows, at most ``r`` entries of
``S x`` are strictly between 0 and their bounds there (Dantzig 1951)."""

from __future__ import annotations

import numpy as np

from sparserob_core.sip.convex_set import Array
from sparserob_core.sip.finite import FiniteProgram

ACCURACY = 1e-10  # the finest that the simplex method offers


def vertex(program: FiniteProgram) -> Array | None:
    """An optimal vertex ``(n,)`` of a program without a quadratic cost, by the dual simplex method; ``None`` where it
    finds none. It proves nothing: whoever uses it checks it like any other decision."""
    if program.P is not None:
        return None
    from scipy.optimize import linprog
    from scipy.sparse import csr_array, eye_array, hstack, vstack

    n, k = program.n, program.weights.size
    S = csr_array(eye_array(n)) if program.S is None else csr_array(program.S)
    priced = program.weights > 0.0
    # x is free, S x = plus - minus where it has a price, so that a vertex has exact zeros there
    images = hstack([S, -eye_array(k), eye_array(k)], format="csr")
    equal = images if not program.b.size else vstack([images, _wide(program.A, k)], format="csr")
    upper, lower = program.upper, program.lower
    plus = [np.where(priced, np.maximum(lower, 0.0), lower), np.where(priced, np.maximum(upper, 0.0), upper)]
    minus = [np.where(priced, np.maximum(-upper, 0.0), 0.0), np.where(priced, np.maximum(-lower, 0.0), 0.0)]
    bounds = np.vstack([np.tile([-np.inf, np.inf], (n, 1)), np.column_stack(plus), np.column_stack(minus)])
    found = linprog(
        np.concatenate([program.q, program.weights, program.weights]),
        A_ub=_wide(program.G, k) if program.h.size else None,
        b_ub=program.h if program.h.size else None,
        A_eq=equal,
        b_eq=np.concatenate([np.zeros(k), program.b]),
        bounds=bounds,
        method="highs-ds",
        options={"primal_feasibility_tolerance": ACCURACY, "dual_feasibility_tolerance": ACCURACY},
    )
    if found.status != 0 or found.x is None:
        return None
    x, image = np.asarray(found.x[:n]), found.x[n : n + k] - found.x[n + k :]
    return np.clip(image, program.lower, program.upper) if program.S is None else x


def _wide(rows: Array, k: int) -> object:
    from scipy.sparse import csr_array, hstack

    return hstack([csr_array(rows), csr_array((rows.shape[0], 2 * k))], format="csr")
