"""The plant, one form for every system of a problem: phases of time, each with a law in the time and in the
parameters."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import final

import numpy as np
from flint import arb_mat

from sparserob_core.checker.arithmetic.balls import ball
from sparserob_core.checker.arithmetic.models import Frame, Model, matrix_at
from sparserob_core.checker.arithmetic.monomials import NONE
from sparserob_core.checker.arithmetic.series import stacked
from sparserob_core.checker.outcome import Unchecked
from sparserob_core.control.problem.phase import Phase
from sparserob_core.control.problem.system import System
from sparserob_core.errors import InputError
from sparserob_core.sip.convex_set import Array

GOLDEN = 0.6180339887
LOOKS = 17  # sample times of a phase; no claim rests on the samples
POINT = Frame(NONE, 0)


@final
@dataclass(frozen=True, eq=False)
class Plant:
    """The ``phases`` of a system, and its numbers of ``states`` and of inputs.

    The first ``driven`` inputs are the controls and a drift; the disturbances follow. ``inputs`` counts all of them.
    """

    phases: tuple[Phase, ...]
    states: int
    driven: int
    inputs: int

    @staticmethod
    def of(system: System, horizon: float) -> Plant:
        """Return the plant of a system up to the horizon."""
        known_inputs = int(system.controls + system.drifts)
        return Plant(system.until(horizon), int(system.states), known_inputs, known_inputs + int(system.disturbances))

    @property
    def is_timed(self) -> bool:
        """True where entries of the matrices may depend on the time."""
        return any(phase.timed for phase in self.phases)

    def looked_at(self, parameter: Sequence[float]) -> Iterator[Array]:
        """Yield ``[A B c E]``, ``(d, d + w)``, at a few sample times of every phase and at one parameter."""
        for phase in self.phases:
            for share in np.sort(np.arange(LOOKS) * GOLDEN % 1.0).tolist():  # they share no period with the law
                time = phase.begin + share * (phase.until - phase.begin)
                try:
                    yield called(phase, np.array([time, *parameter])).astype(float)
                except (InputError, Unchecked):  # not finite there
                    continue


def called(phase: Phase, p: np.ndarray) -> np.ndarray:
    """Return ``[A B c E]``, ``(d, d + w)``, of a phase at the time and the parameters ``p (1 + nu,)``, numbers of any
    kind."""
    arguments, entries = p if phase.timed else p[1:], [phase.entry(name) for name in ("A", "B", "c", "E")]
    return np.hstack([matrix_at(entry, arguments) for entry in entries if entry is not None])


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
    """Return ``e^{A time}`` and ``int_0^time e^{A s} ds inputs`` in floats."""
    from scipy.linalg import expm

    d, columns = inputs.shape
    whole = np.zeros((d + columns, d + columns))
    whole[:d] = np.hstack([A, inputs]) * time
    flow = expm(whole)[:d]
    return flow[:, :d], flow[:, d:]
