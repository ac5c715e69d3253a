"""A point of a study, run on any executor: from plain data to a run directory, and back to plain data."""

from __future__ import annotations

import math
import shutil
from collections.abc import Callable, Iterable, Mapping
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any, final

import numpy as np

from sparserob_core.errors import SparseRobError, named
from sparserob_core.experiment.assemble import build
from sparserob_core.experiment.config.load import Loaded, load_config
from sparserob_core.experiment.directory.artefacts import finite
from sparserob_core.experiment.run.events import EvaluationsFinished, Event, Observer, RoundFinished
from sparserob_core.experiment.run.run import run_loaded
from sparserob_core.sip.limits.deadline import OutOfTime
from sparserob_core.sip.solver import QuadraticProgram

WARM_UP_ACCURACY = 1e-6  # of a program that is solved only so that its imports are made
RENAME_ATTEMPTS = 5  # attempts to rename a directory while another process may give the same name to another one


_imported_solvers = set[tuple[str, str]]()  # in this process


@final
@dataclass(frozen=True)
class Task:
    """The run of one point.

    Parameters
    ----------
    config : mapping
        The resolved config.
    partial, final : str
        The directory that is written, and its name when the run is over; both are absolute paths.
    git : mapping or None
        The revision of the base's folder.
    figures : bool
        Whether the figures are drawn.
    """

    config: Mapping[str, Any]
    partial: str
    final: str
    git: Mapping[str, Any] | None
    figures: bool


@final
@dataclass(frozen=True)
class PointAnswer:
    """The result of a task: the contents of ``result.json``, or the reason why there are none (``failure``).

    ``interrupted`` says that a key or a signal came while it ended.
    """

    summary: Mapping[str, Any] | None = None
    failure: str = ""
    interrupted: bool = False

    @property
    def failed(self) -> bool:
        """True where there is no checked answer."""
        return self.summary is None or self.summary["status"] == "failed"


@final
class Bounds(Observer):
    """An observer of the run of a point in this process.

    It calls ``tell(round, lower, upper)`` at its first event, and whenever the bounds have changed.
    """

    def __init__(self, tell: Callable[[int, float, float], object]) -> None:
        self.tell, self.reported = tell, (-1, -math.inf, math.inf)

    def receive(self, event: Event) -> None:
        """Take the bounds of an event, and report them where they have changed."""
        number, lower, upper = self.reported
        number = max(number, 0)
        if isinstance(event, RoundFinished):
            number, lower = event.round, max(lower, event.lower_bound)
            upper = upper if event.simplified else min(upper, event.upper_bound)
        elif isinstance(event, EvaluationsFinished) and not event.family:
            lower = max(lower, event.lower_bound)
        if (number, lower, upper) != self.reported:
            self.reported = (number, lower, upper)
            self.tell(number, lower, upper)


def run_point(task: Task, observers: Iterable[Observer] = ()) -> PointAnswer:
    """Run a point of a study.

    The directory has its final name only when it is complete. A process that dies therefore loses only the points on
    which it worked. Every error becomes an answer; only an interrupt is raised.

    Parameters
    ----------
    task : Task
        The run.
    observers : iterable of Observer, default ()
        Observers of the run.

    Returns
    -------
    Answer
        The result.
    """
    partial, ends = Path(task.partial), Path(task.final)
    while partial.exists():  # a worker has died, and the cluster gave its call to another one
        partial = partial.with_name(f"{partial.name}+")
    try:
        partial.parent.mkdir(parents=True, exist_ok=True)
        loaded = load_config(task.config)
        _import_packages(loaded)
        outcome = run_loaded(loaded, task.git, partial, quiet=True, figures=task.figures, observers=observers)
        if outcome.interrupted and outcome.result.stopped:
            raise KeyboardInterrupt(outcome.result.stopped)
        keep(partial, ends)
        return PointAnswer(finite(outcome.summary), interrupted=outcome.interrupted)
    except OutOfTime as error:
        return _keep_failure(partial, ends, str(error))
    except KeyboardInterrupt:
        shutil.rmtree(partial, ignore_errors=True)
        raise
    except (Exception, SystemExit) as error:  # noqa: BLE001  one point must not end the study
        return _keep_failure(partial, ends, str(error) if isinstance(error, SparseRobError) else named(error))


def _import_packages(loaded: Loaded) -> None:
    """Import the packages that a run imports when it needs them, the solver's included.

    Otherwise the column ``seconds`` of the first run in every process would be half a second larger.
    """
    import scipy.optimize
    from scipy.sparse import csc_array

    assert scipy.optimize
    entry = loaded.config.solver
    if (entry.name, repr(entry.options)) in _imported_solvers:
        return
    _imported_solvers.add((entry.name, repr(entry.options)))
    unit, empty = csc_array(np.ones((1, 1))), csc_array((0, 1))
    smallest = QuadraticProgram(unit, -np.ones(1), unit, np.ones(1), empty, np.zeros(0), np.zeros(1), np.ones(1))
    with suppress(SparseRobError):  # the run itself reports the error
        build(loaded, "solver", entry).solve(smallest, WARM_UP_ACCURACY)


def keep(partial: Path, ends: Path) -> None:
    """Give a complete run directory its final name; a directory with that name, of a run that ended early, is
    removed."""
    for attempt in range(RENAME_ATTEMPTS):
        retired = partial.with_name(f"{partial.name}.old{attempt}")
        try:
            ends.rename(retired)
            shutil.rmtree(retired, ignore_errors=True)
        except FileNotFoundError:
            pass
        try:
            partial.rename(ends)
            return
        except OSError:
            if attempt == RENAME_ATTEMPTS - 1 or not ends.exists():
                raise


def _keep_failure(partial: Path, ends: Path, said: str) -> PointAnswer:
    """Keep the directory of a run that ended in an error, and return an answer with the reason."""
    if (partial / "result.json").is_file():
        keep(partial, ends)
    else:
        shutil.rmtree(partial, ignore_errors=True)
    return PointAnswer(failure=said)
