"""One point of a study, run wherever the executor likes: from plain data to a run directory, and plain data back."""

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

ACCURACY = 1e-6  # of a program that is solved for nothing but its imports
TRIES = 5  # to give a directory a name that somebody else gives another one at the same moment


_solved_with = set[tuple[str, str]]()  # in this process


@final
@dataclass(frozen=True)
class Task:
    """What a worker is to do: run the resolved ``config`` into the directory ``partial``, and move it to ``final`` when
    it is over, both absolute paths. ``git``: the revision of the base's folder; ``figures``: whether to draw the
    run."""

    config: Mapping[str, Any]
    partial: str
    final: str
    git: Mapping[str, Any] | None
    figures: bool


@final
@dataclass(frozen=True)
class Answer:
    """What came of a task: what ``result.json`` says, or why there is none (``failure``). ``interrupted``: a key or a
    signal came while it ended."""

    summary: Mapping[str, Any] | None = None
    failure: str = ""
    interrupted: bool = False

    @property
    def failed(self) -> bool:
        """Whether there is no checked answer."""
        return self.summary is None or self.summary["status"] == "failed"


@final
class Bounds(Observer):
    """Watches the run of a point in this process: calls ``tell(round, lower, upper)`` at its first event, and whenever
    its bounds have moved."""

    def __init__(self, tell: Callable[[int, float, float], object]) -> None:
        self.tell, self.told = tell, (-1, -math.inf, math.inf)

    def receive(self, event: Event) -> None:
        """See `Observer`."""
        number, lower, upper = self.told
        number = max(number, 0)
        if isinstance(event, RoundFinished):
            number, lower = event.round, max(lower, event.lower_bound)
            upper = upper if event.simplified else min(upper, event.upper_bound)
        elif isinstance(event, EvaluationsFinished) and not event.family:
            lower = max(lower, event.lower_bound)
        if (number, lower, upper) != self.told:
            self.told = (number, lower, upper)
            self.tell(number, lower, upper)


def run_point(task: Task, observers: Iterable[Observer] = ()) -> Answer:
    """Run a point. What it leaves stands under its final name only when it is complete, so that a process that dies
    loses nothing but the points that it was about to finish. Nothing is raised but an interrupt."""
    partial, ends = Path(task.partial), Path(task.final)
    while partial.exists():  # of a worker that died, on a cluster that gave its call to another one
        partial = partial.with_name(f"{partial.name}+")
    try:
        partial.parent.mkdir(parents=True, exist_ok=True)
        loaded = load_config(task.config)
        _import_what_runs(loaded)
        outcome = run_loaded(loaded, task.git, partial, quiet=True, figures=task.figures, observers=observers)
        if outcome.interrupted and outcome.result.stopped:
            raise KeyboardInterrupt(outcome.result.stopped)
        keep(partial, ends)
        return Answer(finite(outcome.summary), interrupted=outcome.interrupted)
    except OutOfTime as error:
        return _failed(partial, ends, str(error))
    except KeyboardInterrupt:
        shutil.rmtree(partial, ignore_errors=True)
        raise
    except (Exception, SystemExit) as error:  # noqa: BLE001  one point must not end the study
        return _failed(partial, ends, str(error) if isinstance(error, SparseRobError) else named(error))


def _import_what_runs(loaded: Loaded) -> None:
    """Import now what a run imports where it needs it, the solver's package too: or the column ``seconds`` would say of
    the first run of every process that it took half a second more."""
    import scipy.optimize
    from scipy.sparse import csc_array

    assert scipy.optimize
    entry = loaded.config.solver
    if (entry.name, repr(entry.options)) in _solved_with:
        return
    _solved_with.add((entry.name, repr(entry.options)))
    one, none = csc_array(np.ones((1, 1))), csc_array((0, 1))
    smallest = QuadraticProgram(one, -np.ones(1), one, np.ones(1), none, np.zeros(0), np.zeros(1), np.ones(1))
    with suppress(SparseRobError):  # the run will say so
        build(loaded, "solver", entry).solve(smallest, ACCURACY)


def keep(partial: Path, ends: Path) -> None:
    """Give a complete run directory its final name; one that has it already, of a run that was cut short, goes."""
    for attempt in range(TRIES):
        old = partial.with_name(f"{partial.name}.old{attempt}")
        try:
            ends.rename(old)
            shutil.rmtree(old, ignore_errors=True)
        except FileNotFoundError:
            pass
        try:
            partial.rename(ends)
            return
        except OSError:
            if attempt == TRIES - 1 or not ends.exists():
                raise


def _failed(partial: Path, ends: Path, said: str) -> Answer:
    """Keep what a run left that ended in an error, and say which."""
    if (partial / "result.json").is_file():
        keep(partial, ends)
    else:
        shutil.rmtree(partial, ignore_errors=True)
    return Answer(failure=said)
