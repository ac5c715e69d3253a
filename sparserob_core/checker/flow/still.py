"""Systems that do not change with time, at one parameter: their matrices in balls, and their flow in floats."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from sparserob_core.checker.arithmetic.balls import ball
from sparserob_core.checker.arithmetic.models import Frame, Model
from sparserob_core.checker.arithmetic.monomials import NONE
from sparserob_core.checker.arithmetic.series import stacked
from sparserob_core.checker.flow.plant import called
from sparserob_core.control.problem.system import System
from sparserob_core.sip.convex_set import Array

if TYPE_CHECKING:
    from flint import arb_mat

POINT = Frame(NONE, 0)
TERMS = 18  # of the power series of a transition in floats, at a norm of at most 1/2: further terms round away


def modes_at(system: System, parameter: Sequence[float]) -> list[dict[str, arb_mat]]:
    """Return the ball matrices ``A``, ``B`` with the drift as its last column, and ``E`` of every mode of a switched
    system."""
    p = np.empty(1 + len(parameter), dtype=object)
    p[:] = [POINT.number(ball(value)) for value in (0.0, *parameter)]
    matrices = []
    for mode in system.modes:
        table = [
            [value.constant if isinstance(value, Model) else ball(value) for value in row] for row in called(mode, p)
        ]
        d, m = mode.states, mode.controls + (mode.c is not None)
        cuts = {"A": slice(0, d), "B": slice(d, d + m), "E": slice(d + m, None)}
        matrices.append({name: stacked([row[cut] for row in table]) for name, cut in cuts.items()})
    return matrices


def held_about(A: Array, inputs: Array, time: float) -> tuple[Array, Array]:
    """Return ``e^{A time}`` and ``int_0^time e^{A s} ds inputs`` in floats: a power series over a short time,
    doubled."""
    d, size = A.shape[0], float(np.abs(A).sum(axis=1).max(initial=0.0)) * time
    halvings = max(0, int(np.ceil(np.log2(2.0 * size)))) if 0.0 < size < np.inf else 0
    short = time / 2.0**halvings
    flow, integral, term = np.eye(d), np.eye(d) * short, np.eye(d)
    for order in range(1, TERMS + 1):
        term = term @ A * (short / order)
        flow, integral = flow + term, integral + term * (short / (order + 1))
    integral = integral @ inputs
    for _ in range(halvings):
        flow, integral = flow @ flow, integral + flow @ integral
    return flow, integral
