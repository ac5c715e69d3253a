"""The elastic program: how far must the rows be relaxed until they can be met?"""

from __future__ import annotations

import numpy as np

from sparserob_core.sip.finite import FiniteProgram
from sparserob_core.sip.inner.standard_form import Recovered


def elastic_program(program: FiniteProgram) -> FiniteProgram:
    """minimise ``t >= 0`` subject to the bounds, ``G_i x <= h_i + t |G_i|`` and ``|A_i x - b_i| <= t |A_i|``.

    Its decision is ``(x, t)``; its rows are those of ``G``, then ``A x - b <= t |A|``, then ``b - A x <= t |A|``. It is
    always feasible (when the bounds are), and a positive value proves the program infeasible.
    """
    images = program.weights.size
    rows = np.vstack([program.G, program.A, -program.A])
    rows = np.hstack([rows, -np.linalg.norm(rows, axis=1)[:, None]])
    S = None
    if program.S is not None:
        from scipy.sparse import block_diag

        S = block_diag([program.S, [[1.0]]], format="csc")
    q = np.zeros(program.n + 1)
    q[-1] = 1.0
    return FiniteProgram(
        q,
        np.zeros(images + 1),
        np.append(program.lower, 0.0),
        np.append(program.upper, np.inf),
        rows,
        np.concatenate([program.h, program.b, -program.b]),
        np.zeros((0, program.n + 1)),
        np.zeros(0),
        S=S,
    )


def unrelaxed(program: FiniteProgram, answer: Recovered) -> Recovered:
    """An answer to the elastic program in terms of ``program``: its ``x``, and multipliers that may prove
    infeasibility."""
    x, multipliers, _, z = answer
    r, e = program.h.size, program.b.size
    y = np.maximum(multipliers, 0.0)
    return x[:-1], y[:r], y[r : r + e] - y[r + e :], None if z is None else z[:-1]
