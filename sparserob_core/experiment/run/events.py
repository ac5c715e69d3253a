"""The events of a run, and their way to the observers, who cannot disturb the run."""

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
    """The first event of a run, with its title, its directory and its problem.

    Parameters
    ----------
    title : str
        The title of the run.
    directory : Path or None
        Its directory.
    problem : OptimalControlProblem or None
        The control problem; ``None`` for another program.
    program : SemiInfiniteProgram
        The program that is solved.
    quiet : bool, default False
        Whether the terminal must be left alone.
    inspection : Inspection, optional
        The answers to an observer's further questions, on a copy of its own.
    unprovable : str, optional
        The reason for which no control can be certified, where it is known before anything is solved.
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
    """The last event of a run, after a success and after an error.

    Parameters
    ----------
    status, message : str
        The status of the result, and its explanation.
    seconds : float
        The seconds that the run has taken.
    result : Result, optional
        The result. ``None`` where an error ended the run, or an interrupt before there was a decision.
    pressed : bool, default False
        Whether a key or a signal ended the run.
    """

    status: str
    message: str
    seconds: float
    result: Result | None = None
    pressed: bool = False


@dataclass(frozen=True, kw_only=True, eq=False)
class StudyProgress(Event):
    """The progress of a study of many programs or trajectories, or of the last phases of a run.

    Such a study is a margin, a set of initial states, or a simulation.

    Parameters
    ----------
    text : str
        The progress in words. Of a phase of a run, the part up to a colon is its name.
    done, total : int, default 0
        The number of steps that are done, and of all steps; 0 where that is not known.
    phase : bool, default False
        Whether a run begins a phase after its method.
    result : Result, optional
        The result of the method, where the phase begins with it.
    """

    text: str
    done: int = 0
    total: int = 0
    phase: bool = False
    result: Result | None = field(default=None, repr=False)


@dataclass(frozen=True, kw_only=True, eq=False)
class SweepProgress(StudyProgress):
    """The progress of a sweep.

    Points are given by their places in `SweepStarted.points`.

    Parameters
    ----------
    done, total : int
        The number of points that are done, and of all points.
    running, failed : int, default 0
        The number of points that run, and of those that ended without an answer.
    left : float, optional
        The seconds that remain, roughly; ``None`` where they are not known yet.
    row : mapping, optional
        The row of the table that was added, if there is one.
    axes : sequence of str
        The keys of the row that are axes.
    places : sequence of int
        The points of the row; several where configs are equal.
    now : sequence of int
        The points that run.
    found : sequence
        New points, of a study that finds its points as it proceeds (``search``). They follow those that are known.
    seconds : float
        The seconds since the sweep began.
    """

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
    """The first event for an observer of a study.

    Parameters
    ----------
    title : str
        The title of the study.
    directory : Path
        Its directory.
    axes : sequence of str
        The keys of the axes.
    logarithmic : sequence of bool
        The axes that are logarithmic.
    points : sequence
        The values of all points on the axes, in the order of the table.
    arrangement : str
        The choice of the points. ``grid``, ``zip``, ``random`` or ``sobol``: as in `sweep`. ``search``: a margin, whose
        points come with `SweepProgress` when they are found. ``runs``: finished runs of one problem, which are
        compared.
    rows : mapping
        The rows that were finished before, by the place of the point.
    parallel : bool, default False
        Whether the runs are made elsewhere, so that no `PointProgress` comes before they end.
    sense : {"", "largest", "smallest"}, default ""
        Where the largest or the smallest feasible value of the only axis is sought, and a value that is proven
        infeasible excludes all values beyond it. Empty otherwise.
    runs : Path, optional
        The folder with the directories of the runs, which the rows name (``run``); ``None`` where these are not kept.
    """

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
    """The progress of one point of a study that runs in this process: it has begun, or its bounds have changed.

    Parameters
    ----------
    point : int
        The place of the point.
    round : int, default 0
        The round of its method; 0 at its beginning.
    lower_bound, upper_bound : float
        The bounds, in the units of the config; ``-inf`` and ``inf`` where they are unknown.
    seconds : float
        The seconds since the study began.
    """

    point: int
    round: int = 0
    lower_bound: float = -math.inf
    upper_bound: float = math.inf
    seconds: float = 0.0


@dataclass(frozen=True, kw_only=True, eq=False)
class SweepFinished(Event):
    """The last event for an observer of a study.

    Parameters
    ----------
    rows : mapping
        All rows of the table, by the place of the point.
    seconds : float
        The seconds that the study has taken.
    stopped : str, default ""
        The reason for which the study ended early, if it did.
    pressed : bool, default False
        Whether that reason was a key or a signal.
    answer : str, default ""
        The answer of a search, in words.
    """

    rows: Mapping[int, Mapping[str, Any]]
    seconds: float
    stopped: str = ""
    pressed: bool = False
    answer: str = ""


FIRST, LAST = (RunStarted, SweepStarted), (RunFinished, SweepFinished)
"""The events that an observer receives first and last."""


class Observer(ABC):
    """An object that receives the events of a run: `RunStarted` first, `RunFinished` last, each of them once.

    The events come on the thread of the solver. Work that takes long belongs in a thread or a process of its own, which
    is started at `RunStarted`.

    An observer of a sweep receives the events of the study: `SweepStarted` first, then `SweepProgress` and
    `PointProgress`, and `SweepFinished` last. It receives no event of the runs themselves.
    """

    @property
    def incomplete(self) -> str:
        """The reason for which the record of the observer is not complete; empty as long as it is."""
        return ""

    @abstractmethod
    def receive(self, event: Event) -> None:
        """Receive an event, and ignore it where its type is unknown.

        An exception that is raised here detaches the observer and has no other effect.
        """

    def close(self) -> None:  # noqa: B027  most hold nothing
        """Release files, threads and the terminal.

        This is called once: after the last event, or when the observer is detached before it.
        """


@final
class Broadcast:
    """A sender of events to all observers.

    An observer that raises an exception is detached with one warning, and the run goes on. Every observer that received
    the first event receives the last one, once, and is closed; it receives nothing after that.

    An interrupt from the keyboard is no failure of the observer, and it is raised again. With the last event it is
    raised only after all observers have received that event.
    """

    def __init__(self, observers: Iterable[tuple[str, Observer]]) -> None:
        self._observers = [_Listener(name, observer) for name, observer in observers]

    @property
    def heard(self) -> bool:
        """True where there is an observer."""
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
    """The connection to one observer of one run, or of one study."""

    def __init__(self, name: str, observer: Observer) -> None:
        self.name, self.observer, self.has_started = name, observer, False

    def receive(self, event: Event) -> bool:
        """Send an event to the observer; returns whether it takes further events."""
        last = isinstance(event, LAST)
        self.has_started |= isinstance(event, FIRST)
        try:
            if self.has_started or not last:
                self.observer.receive(event)
        except (Exception, SystemExit) as error:  # noqa: BLE001  an observer must not end the run
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
        except (Exception, SystemExit) as error:  # noqa: BLE001  an observer must not end the run
            if not quietly:
                self._warn(error)

    def _warn(self, error: BaseException) -> None:
        logger.warning("observer '%s' is detached: %s: %s", self.name, type(error).__name__, error)


@final
class _DetachedObserver(Observer):
    """The substitute for an observer that was closed."""

    def receive(self, event: Event) -> None:
        """Ignore the event."""


_DETACHED = _DetachedObserver()
