"""The events of a run, and how they reach its observers without disturbing it."""

from __future__ import annotations

import logging
import math
from abc import ABC, abstractmethod
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, final

from sparserob_core.sip.events import EvaluationsFinished, Event, ProofProgress, RoundFinished, StageProgress

if TYPE_CHECKING:
    from sparserob_core.control.problem.problem import OptimalControlProblem
    from sparserob_core.experiment.run.inspection import Inspection
    from sparserob_core.sip.program import SemiInfiniteProgram
    from sparserob_core.sip.result import Result

__all__ = [
    "Broadcast",
    "EvaluationsFinished",
    "Event",
    "Observer",
    "PointProgress",
    "ProofProgress",
    "RoundFinished",
    "RunFinished",
    "RunStarted",
    "StageProgress",
    "StudyProgress",
    "SweepFinished",
    "SweepProgress",
    "SweepStarted",
]

logger = logging.getLogger("sparserob")


@dataclass(frozen=True, kw_only=True, eq=False)
class RunStarted(Event):
    """A run begins: its title, its directory, what is to be solved, and whether the terminal is to be left alone
    (``quiet``).

    Always the first event. ``inspection`` answers what an observer wants to know beside the events, on a copy of its
    own; ``None`` where there is none. ``unprovable`` says why no control can be certified, where that is known before
    anything is solved.
    """

    title: str
    directory: Path | None
    problem: OptimalControlProblem | None
    program: SemiInfiniteProgram
    quiet: bool = False
    inspection: Inspection | None = None
    unprovable: str | None = None


@dataclass(frozen=True, kw_only=True, eq=False)
class RunFinished(Event):
    """A run is over, whether well or not; always the last event. ``result`` is ``None`` when an error ended it, or an
    interrupt before there was a decision; ``pressed``: a key or a signal has ended it."""

    status: str
    message: str
    seconds: float
    result: Result | None = None
    pressed: bool = False


@dataclass(frozen=True, kw_only=True, eq=False)
class StudyProgress(Event):
    """A study of many programs or trajectories goes on (a margin, a set of initial states, a simulation): in words, and
    as ``done`` of ``total`` steps (0: unknown). ``phase``: a run goes on with what comes after its method, which the
    words name up to a colon; ``result``: what its method has returned, where the phase begins with it."""

    text: str
    done: int = 0
    total: int = 0
    phase: bool = False
    result: Result | None = field(default=None, repr=False)


@dataclass(frozen=True, kw_only=True, eq=False)
class SweepProgress(StudyProgress):
    """A sweep goes on: ``done`` of ``total`` points, of them ``failed`` without an answer; ``running`` now; about
    ``left`` seconds to go (``None``: not known yet), ``seconds`` since it began. ``row``: the row of the table that has
    just come, if any; ``axes``: its keys that are axes. Points by their place in `SweepStarted.points`: ``places`` are
    those of the row (several where configs are equal), ``now`` those that run. ``found``: points that come after those
    that were known, where a study finds its points on the way (``search``)."""

    running: int = 0
    failed: int = 0
    left: float | None = None
    row: Mapping[str, Any] | None = None
    axes: Sequence[str] = ()
    places: Sequence[int] = ()
    now: Sequence[int] = ()
    found: Sequence[Sequence[Any]] = ()
    seconds: float = 0.0


@dataclass(frozen=True, kw_only=True, eq=False)
class SweepStarted(Event):
    """A sweep begins: its title, its directory, the keys of its ``axes``, which of them are ``logarithmic``, and the
    values of all ``points`` on them, in the order of the table.

    The first event for an observer of a study. ``rows``: what was finished before, by the place of the point.
    ``arrangement``: how the points were chosen (``grid``, ``zip``, ``random``, ``sobol``; ``search``: a margin, whose
    points are told as they are found, `SweepProgress`; ``runs``: finished runs of one problem, which are compared).
    ``runs``: the folder in which the rows name the directories of their runs (``run``), where these are kept.
    ``parallel``: the runs are
    made elsewhere, and nothing is heard of them (`PointProgress`) before they end. ``sense``: the *largest* or the
    *smallest* value of the only axis is sought at which something is feasible, and what is proven infeasible at one
    value is so beyond it; empty where nothing is."""

    title: str
    directory: Path
    axes: Sequence[str]
    logarithmic: Sequence[bool]
    points: Sequence[Sequence[Any]]
    arrangement: str
    rows: Mapping[int, Mapping[str, Any]] = field(default_factory=dict)
    parallel: bool = False
    sense: Literal["", "largest", "smallest"] = ""
    runs: Path | None = None


@dataclass(frozen=True, kw_only=True, eq=False)
class PointProgress(Event):
    """A point of a study that runs in this process has begun (``round`` 0), or has moved its bounds in some round:
    ``-inf`` and ``inf`` while unknown, in the units of the config. ``seconds`` since the study began."""

    point: int
    round: int = 0
    lower_bound: float = -math.inf
    upper_bound: float = math.inf
    seconds: float = 0.0


@dataclass(frozen=True, kw_only=True, eq=False)
class SweepFinished(Event):
    """A sweep is over; the last event for an observer of a study. ``rows``: all rows of the table by the place of the
    point; ``stopped``: what ended the study early, if anything did; ``pressed``: it was a key or a signal. ``answer``:
    what a search found, in words."""

    rows: Mapping[int, Mapping[str, Any]]
    seconds: float
    stopped: str = ""
    pressed: bool = False
    answer: str = ""


FIRST, LAST = (RunStarted, SweepStarted), (RunFinished, SweepFinished)
"""What an observer hears first, and last."""


class Observer(ABC):
    """Watches a run. It receives `RunStarted` first and `RunFinished` last, each once, and in between whatever happens,
    on the solver's thread: what takes long belongs into a thread or a process of its own, begun at `RunStarted`.

    One that is given to a sweep watches the study: it receives `SweepStarted` first, `SweepProgress` and
    `PointProgress`, and `SweepFinished` last, and no event of the runs themselves."""

    @property
    def incomplete(self) -> str:
        """Why what it was to leave is not complete, in words; empty as long as it is."""
        return ""

    @abstractmethod
    def receive(self, event: Event) -> None:
        """Take note of an event; ignore those of unknown type. Whatever this raises only detaches the observer."""

    def close(self) -> None:  # noqa: B027  most hold nothing
        """Let go of files, threads and the terminal: called once, after the last event, or when the observer is
        detached before it."""


@final
class Broadcast:
    """Passes every event on to every observer; one that raises is detached with one warning, and the run goes on.

    Every observer that received the first event receives the last one, once, and is closed; nothing is sent after that.
    An interrupt from the keyboard is not the observer's failure: it is raised, at the end of a run only after all
    observers have received the last event.
    """

    def __init__(self, observers: Iterable[tuple[str, Observer]]) -> None:
        self._observers = [_Listener(name, observer) for name, observer in observers]

    @property
    def heard(self) -> bool:
        """Whether anybody listens."""
        return bool(self._observers)

    def __call__(self, event: Event) -> None:
        last, interrupt = isinstance(event, LAST), None
        for listener in tuple(self._observers):
            try:
                if not listener.receive(event):
                    self._observers.remove(listener)
            except KeyboardInterrupt as pressed:
                if not last:
                    raise
                interrupt = pressed
        if last:
            self._observers.clear()
        if interrupt is not None:
            raise interrupt


@final
class _Listener:
    """One observer of one run, or of one study."""

    def __init__(self, name: str, observer: Observer) -> None:
        self.name, self.observer, self.began = name, observer, False

    def receive(self, event: Event) -> bool:
        """Pass an event on; returns whether the observer takes further events."""
        last = isinstance(event, LAST)
        self.began |= isinstance(event, FIRST)
        try:
            if self.began or not last:
                self.observer.receive(event)
        except (Exception, SystemExit) as error:  # noqa: BLE001  an observer must not hurt the run
            self._warn(error)
            self._close(quietly=True)
            return False
        finally:
            if last:
                self._close()
        return not last

    def _close(self, quietly: bool = False) -> None:
        observer, self.observer = self.observer, _DETACHED
        try:
            observer.close()
        except (Exception, SystemExit) as error:  # noqa: BLE001  as above
            if not quietly:
                self._warn(error)

    def _warn(self, error: BaseException) -> None:
        logger.warning("observer '%s' is detached: %s: %s", self.name, type(error).__name__, error)


@final
class _Detached(Observer):
    """Stands for an observer that was closed."""

    def receive(self, event: Event) -> None:
        """Nothing."""


_DETACHED = _Detached()
