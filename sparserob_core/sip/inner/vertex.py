"""Linear programs by the simplex method: vertices, which have many zeros, and multipliers that others judge.

Of a linear program with ``r`` active rows at most ``r`` entries of ``S x`` are strictly between 0 and their bounds at a
vertex (Dantzig 1951). Nothing here is believed: whoever uses it checks decisions and multipliers like any other.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal

import numpy as np

from sparserob_core.sip.convex_set import Array
from sparserob_core.sip.finite import FiniteProgram

ACCURACY = 1e-10  # the finest that the simplex method offers


@dataclass(frozen=True, eq=False)
class Corner:
    """What the simplex method says: a vertex ``x (n,)`` with multipliers ``y (r,)`` of the rows, ``mu (e,)`` of the
    equalities and ``z (k,)`` of the image unless that is ``x``, or none."""

    status: Literal["optimal", "infeasible", "failed"]
    x: Array
    y: Array
    mu: Array
    z: Array | None = None


def vertex(program: FiniteProgram) -> Array | None:
    """An optimal vertex ``(n,)`` of a program without a quadratic cost; ``None`` where none is found."""
    curved = program.P is not None or program.blocks is not None
    corner = None if curved else simplex(program)
    return corner.x if corner is not None and corner.status == "optimal" else None


def simplex(program: FiniteProgram) -> Corner:
    """The program without its quadratic cost, by the dual simplex method of HiGHS."""
    from scipy.optimize import linprog

    n, k, r = program.n, program.weights.size, program.h.size
    columns = _separable(program) if program.S is None else _images(program)
    found = linprog(
        columns["c"],
        A_ub=columns["rows"] if r else None,
        b_ub=program.h if r else None,
        A_eq=columns["equal"],
        b_eq=columns["right"],
        bounds=columns["bounds"],
        method="highs-ds",
        options={"primal_feasibility_tolerance": ACCURACY, "dual_feasibility_tolerance": ACCURACY},
    )
    if found.status != 0 or found.x is None:
        none = np.zeros(0)
        return Corner("infeasible" if found.status == 2 else "failed", none, none, none)
    y = -np.asarray(found.ineqlin.marginals) if r else np.zeros(0)
    mu = -np.asarray(found.eqlin.marginals)[-program.b.size :] if program.b.size else np.zeros(0)
    if program.S is None:
        x = np.clip(found.x[:k] - found.x[k:], program.lower, program.upper)
        return Corner("optimal", x, np.maximum(y, 0.0), mu)
    return Corner("optimal", np.asarray(found.x[:n]), np.maximum(y, 0.0), mu, -np.asarray(found.eqlin.marginals)[:k])


def _sides(program: FiniteProgram) -> tuple[list[Array], list[Array]]:
    """Bounds of the positive and of the negative part of an image, so that a vertex has exact zeros."""
    lower, upper = program.lower, program.upper
    plus = [np.maximum(lower, 0.0), np.maximum(upper, 0.0)]
    return plus, [np.maximum(-upper, 0.0), np.maximum(-lower, 0.0)]


def _separable(program: FiniteProgram) -> dict[str, Any]:
    """``x = plus - minus``."""
    plus, minus = _sides(program)
    return {
        "c": np.concatenate([program.weights + program.q, program.weights - program.q]),
        "rows": np.hstack([program.G, -program.G]),
        "equal": np.hstack([program.A, -program.A]) if program.b.size else None,
        "right": program.b if program.b.size else None,
        "bounds": np.vstack([np.column_stack(plus), np.column_stack(minus)]),
    }


def _images(program: FiniteProgram) -> dict[str, Any]:
    """``x`` is free, ``S x = plus - minus``."""
    from scipy.sparse import csr_array, eye_array, hstack, vstack

    n, k = program.n, program.weights.size
    images = hstack([csr_array(program.S), -eye_array(k), eye_array(k)], format="csr")
    plus, minus = _sides(program)
    return {
        "c": np.concatenate([program.q, program.weights, program.weights]),
        "rows": _wide(program.G, k),
        "equal": images if not program.b.size else vstack([images, _wide(program.A, k)], format="csr"),
        "right": np.concatenate([np.zeros(k), program.b]),
        "bounds": np.vstack([np.tile([-np.inf, np.inf], (n, 1)), np.column_stack(plus), np.column_stack(minus)]),
    }


def _wide(rows: Array, k: int) -> object:
    from scipy.sparse import csr_array, hstack

    return hstack([csr_array(rows), csr_array((rows.shape[0], 2 * k))], format="csr")
