"""Every system of a problem as one: phases of time, each with a law in the time and in the parameters."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any, final

import numpy as np

from sparserob_core.checker.outcome import Unchecked
from sparserob_core.control.problem.system import LinearSystem, System, VaryingSystem
from sparserob_core.errors import InputError
from sparserob_core.sip.convex_set import Array

GOLDEN = 0.6180339887
LOOKS = 17  # times of a phase at which its numbers are looked at, by which nothing is proven


@final
@dataclass(frozen=True, eq=False)
class PlantPhase:
    """``A``, ``B`` with the drift beside it, and ``E`` of a ``law`` from ``begin`` to ``until``: functions of the
    parameters, which may come after the time (``timed``)."""

    begin: float
    until: float
    law: LinearSystem
    timed: bool

    def called(self, p: np.ndarray) -> np.ndarray:
        """``[A B c E]`` at the time and the parameters ``(1 + nu,)``, numbers of any kind."""
        law, given = self.law, p if self.timed else p[1:]
        parts = [law.entry(name) for name in ("A", "B", "c", "E")]
        return np.hstack([_called(part, given) for part in parts if part is not None])


@final
@dataclass(frozen=True, eq=False)
class Plant:
    """The ``phases`` of a system with ``states``, and with so many inputs that are ``driven``, controls and a drift,
    before the disturbances, and all ``inputs``."""

    phases: tuple[PlantPhase, ...]
    states: int
    driven: int
    inputs: int

    @staticmethod
    def of(system: System, horizon: float) -> Plant:
        """That of any system of a problem."""
        if isinstance(system, VaryingSystem):
            laws = [(begin, law) for begin, _, law in system.laws]
        else:
            laws = list(zip((0.0, *system.switches), system.modes, strict=True))
        ends = [*(begin for begin, _ in laws[1:]), horizon]
        timed = isinstance(system, VaryingSystem)
        phases = [PlantPhase(begin, until, law, timed) for (begin, law), until in zip(laws, ends, strict=True)]
        driven = int(system.controls + (system.c is not None))
        return Plant(tuple(phases), int(system.states), driven, driven + int(system.disturbances))

    @property
    def is_timed(self) -> bool:
        """Whether entries may depend on the time."""
        return any(phase.timed for phase in self.phases)

    def looked_at(self, parameter: Sequence[float]) -> Iterator[Array]:
        """``[A B c E]`` at some times, and a parameter."""
        for phase in self.phases:
            for share in np.sort(np.arange(LOOKS) * GOLDEN % 1.0).tolist():  # none is a period of anything
                time = phase.begin + share * (phase.until - phase.begin)
                try:
                    yield phase.called(np.array([time, *parameter])).astype(float)
                except (InputError, Unchecked):  # not finite there
                    continue


def _called(entry: Any, p: np.ndarray) -> np.ndarray:
    if not callable(entry):
        return np.asarray(entry)
    try:
        return np.asarray(entry(p), dtype=object)
    except (TypeError, ValueError, ArithmeticError, AttributeError) as error:
        raise Unchecked(f"an entry of the system cannot be expanded: {error}") from error
