"""Every figure of a run, when it is over and when it is drawn again."""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterable, Iterator, Mapping
from pathlib import Path
from typing import TypeAlias

import numpy as np

from sparserob_core.errors import InputError, SparseRobError
from sparserob_core.experiment.assemble import ControlExperiment, Experiment, assemble
from sparserob_core.experiment.directory.adversary import adversaries
from sparserob_core.experiment.directory.finished import read_finished, stored_run
from sparserob_core.experiment.run.inspection import Inspection
from sparserob_core.experiment.run.landscape import landscape_of
from sparserob_core.experiment.run.replay import stored_result
from sparserob_core.experiment.terminal.printing import printable
from sparserob_core.sip.convex_set import Array
from sparserob_core.sip.events import Notify, ignore
from sparserob_core.sip.result import Result

Drawing: TypeAlias = Callable[[], list[Path]]

logger = logging.getLogger("sparserob")


def draw_run(directory: Path, plugins: Iterable[str | Path] = (), notify: Notify = ignore) -> list[Path]:
    """Draw the figures of a run directory again; raises `InputError` when it is none, or there is nothing to draw.

    ``plugins``: files that offer what the run was made with; the directory itself is data, and no plugin that it names
    is loaded. ``notify`` receives `StudyProgress`."""
    run = stored_run(directory)
    worst: Mapping[str, Array] = {}
    if "theta" in run.solution:
        finished = read_finished(directory, plugins)
        experiment: Experiment = finished.experiment
        worst = adversaries(experiment, finished.decision)
    elif run.summary["status"] == "infeasible" or run.evaluations is not None:
        experiment = assemble(run.config(plugins))
    else:
        status, message = run.summary["status"], run.summary["message"]
        raise InputError(f"{directory}: there is no control in it; the status is '{status}': {message}")
    files, refused = list[Path](), list[InputError]()
    for draw in drawings(experiment, stored_result(run), run.directory, worst, notify):
        try:
            files += draw()
        except InputError as error:
            refused.append(error)
    if refused and not files:
        raise refused[0]
    for one in refused:
        logger.warning("%s", one)
    if not files:
        raise InputError(f"{directory}: there is nothing to draw; the status is '{run.summary['status']}'")
    return files


def drawings(
    experiment: Experiment, result: Result, directory: Path, worst: Mapping[str, Array], notify: Notify = ignore
) -> Iterator[Drawing]:
    """What there is to draw of a result into ``directory/figures``, each as a function that returns its files and
    raises `InputError` where it cannot: the clash of an infeasible control problem, or the figures of its decision;
    and those of a search. ``worst``: the arrays of `adversaries`."""
    from sparserob_core.experiment.figures.clash import draw_clash
    from sparserob_core.experiment.figures.climb_figure import write_climb
    from sparserob_core.experiment.figures.drawing import draw_experiment

    if isinstance(experiment, ControlExperiment) and result.status == "infeasible":
        yield lambda: draw_clash(experiment, result, directory)
    elif isinstance(experiment, ControlExperiment) and result.decision is not None:
        about = {one.name for one in experiment.transcription.constraints}
        kept = [cut for cut in result.indices if cut.family in about or experiment.transcription.feedback is None]
        active = np.unique([cut.index[0] for cut in kept if cut.multiplier > 0])
        decision = np.asarray(result.decision, dtype=float).ravel()
        yield lambda: draw_experiment(experiment, decision, active, result.history, directory, result.cost, worst)
    trace = result.trace
    if trace is not None and np.isfinite(trace.value).any():
        exact = result.status == "certified"
        yield lambda: write_climb(
            directory / "figures", trace, printable(experiment.title), result.upper_bound, exact=exact
        )
        yield lambda: _landscape(experiment, result, directory, notify)


def _landscape(experiment: Experiment, result: Result, directory: Path, notify: Notify) -> list[Path]:
    from sparserob_core.experiment.figures.landscape_figure import write_landscape

    assert result.trace is not None
    inspection = Inspection(experiment.loaded, experiment)
    data = landscape_of(inspection, result.trace, printable(experiment.title), notify)
    return [] if data is None else write_landscape(directory / "figures", data)


def drawn(
    experiment: Experiment, result: Result, directory: Path, worst: Mapping[str, Array], notify: Notify = ignore
) -> tuple[str, ...]:
    """Draw what there is to draw when a run is over, and return what could not be drawn: the figures are an extra, and
    whatever goes wrong with one is a remark."""
    remarks = []
    for draw in drawings(experiment, result, directory, worst, notify) if result.status != "failed" else ():
        try:
            draw()
        except SparseRobError as error:
            remarks.append(str(error))
        except Exception as error:  # noqa: BLE001  as said above
            remarks.append(f"the figures could not be drawn: {type(error).__name__}: {error}")
    return tuple(dict.fromkeys(remarks))
