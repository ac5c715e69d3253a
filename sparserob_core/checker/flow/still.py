"""What does not change with time, at one parameter: its matrices in balls, and what they make of a time."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from sparserob_core.checker.arithmetic.models import Frame, Model
from sparserob_core.checker.arithmetic.monomials import NONE
from sparserob_core.checker.arithmetic.series import stacked
from sparserob_core.checker.flow.plant import Phase
from sparserob_core.control.problem.system import System

if TYPE_CHECKING:
    from flint import arb, arb_mat

POINT = Frame(NONE, 0)


def modes_at(system: System, parameter: Sequence[float]) -> list[dict[str, arb_mat]]:
    """``A``, ``B`` with the drift beside it, and ``E`` of the systems that take turns."""
    from flint import arb

    p = np.empty(1 + len(parameter), dtype=object)
    p[:] = [Model.number(POINT, arb(float(value))) for value in (0.0, *parameter)]
    found = []
    for mode in system.modes:
        table = [
            [value.constant if isinstance(value, Model) else arb(float(value)) for value in row]
            for row in Phase(0.0, 0.0, mode, timed=False).called(p)
        ]
        d, m = mode.states, mode.controls + (mode.c is not None)
        cuts = {"A": slice(0, d), "B": slice(d, d + m), "E": slice(d + m, None)}
        found.append({name: stacked([row[cut] for row in table]) for name, cut in cuts.items()})
    return found


def held(matrix: arb_mat, inputs: arb_mat, time: arb) -> tuple[arb_mat, arb_mat]:
    """``e^{matrix time}`` and ``int_0^time e^{matrix s} ds inputs`` from one exponential (Van Loan 1978)."""
    from flint import arb, arb_mat

    n, m = matrix.nrows(), inputs.ncols()
    rows = [a + b for a, b in zip(matrix.tolist(), inputs.tolist(), strict=True)]
    whole = (stacked(rows + [[arb(0)] * (n + m)] * m) * time).exp().tolist()
    return stacked([row[:n] for row in whole[:n]]), arb_mat(n, m, [x for row in whole[:n] for x in row[n:]])


def column(matrix: arb_mat, number: int) -> arb_mat:
    """One column of a ball matrix."""
    return stacked([[matrix[i, number]] for i in range(matrix.nrows())])
