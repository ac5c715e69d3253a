"""What a run tells its observers, and how it tells them without being disturbed."""

from __future__ import annotations

import logging
from abc import ABC, abstractmethod
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, final

from sparserob_core.sip.events import EvaluationsFinished, Event, ProofProgress, RoundFinished

if TYPE_CHECKING:
    from sparserob_core.control.problem import OptimalControlProblem
    from sparserob_core.sip.program import SemiInfiniteProgram
    from sparserob_core.sip.result import Result

__all__ = ["Broadcast", "EvaluationsFinished", "Event", "Observer", "ProofProgress", "RoundFinished", "RunFinished", "RunStarted"]

logger = logging.getLogger("sparserob")


@dataclass(frozen=True, kw_only=True)
class RunStarted(Event):
    """A run begins: its title, its directory, what is to be solved, and whether the terminal is to be left alone (``quiet``)."""

    title: str
    directory: Path | None
    problem: OptimalControlProblem | None
    program: SemiInfiniteProgram
    quiet: bool = False


@dataclass(frozen=True, kw_only=True)
class RunFinished(Event):
    """A run is over, whether well or not; always the last event. ``result`` is ``None`` when it was interrupted or an error ended it."""

    status: str
    message: str
    seconds: float
    result: Result | None = None


class Observer(ABC):
    """Watches a run."""

    @abstractmethod
    def receive(self, event: Event) -> None:
        """Take note of an event; ignore those of unknown type. Whatever this raises only detaches the observer."""


@final
class Broadcast:
    """Passes every event on to every observer; one that raises is detached with one warning, and the run goes on."""

    def __init__(self, observers: Iterable[tuple[str, Observer]]) -> None:
        self._observers = list(observers)

    def __call__(self, event: Event) -> None:
        for name, observer in tuple(self._observers):
            try:
                observer.receive(event)
            except Exception as error:  # noqa: BLE001  an observer must not hurt the run
                self._observers.remove((name, observer))
                logger.warning("observer '%s' is detached: %s: %s", name, type(error).__name__, error)
