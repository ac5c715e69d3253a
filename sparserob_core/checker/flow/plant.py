"""Every system of a problem as one: phases of time, each with a law in the time and in the parameters."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any, final

import numpy as np

from sparserob_core.checker.outcome import Unchecked
from sparserob_core.control.problem.phase import Phase
from sparserob_core.control.problem.system import System
from sparserob_core.errors import InputError
from sparserob_core.sip.convex_set import Array

GOLDEN = 0.6180339887
LOOKS = 17  # times of a phase at which its numbers are looked at, by which nothing is proven


@final
@dataclass(frozen=True, eq=False)
class Plant:
    """The ``phases`` of a system with ``states``, and with so many inputs that are ``driven``, controls and a drift,
    before the disturbances, and all ``inputs``."""

    phases: tuple[Phase, ...]
    states: int
    driven: int
    inputs: int

    @staticmethod
    def of(system: System, horizon: float) -> Plant:
        """That of any system of a problem."""
        driven = int(system.controls + system.drifts)
        return Plant(system.until(horizon), int(system.states), driven, driven + int(system.disturbances))

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
                    yield called(phase, np.array([time, *parameter])).astype(float)
                except (InputError, Unchecked):  # not finite there
                    continue


def called(phase: Phase, p: np.ndarray) -> np.ndarray:
    """``[A B c E]`` of a phase at the time and the parameters ``(1 + nu,)``, numbers of any kind."""
    given, parts = p if phase.timed else p[1:], [phase.entry(name) for name in ("A", "B", "c", "E")]
    return np.hstack([_called(part, given) for part in parts if part is not None])


def _called(entry: Any, p: np.ndarray) -> np.ndarray:
    if not callable(entry):
        return np.asarray(entry)
    try:
        return np.asarray(entry(p), dtype=object)
    except (TypeError, ValueError, ArithmeticError, AttributeError) as error:
        raise Unchecked(f"an entry of the system cannot be expanded: {error}") from error
