"""The replay of a finished run as events, for observers that were not there; nothing is solved again."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from sparserob_core.control.constraints.explanation import Witness
from sparserob_core.errors import InputError
from sparserob_core.experiment.directory.finished import UNFINISHED, StoredRun, stored_run
from sparserob_core.experiment.run.events import Event, RunFinished, RunStarted
from sparserob_core.experiment.run.inspection import Inspection
from sparserob_core.experiment.run.landscape import deciding_again
from sparserob_core.experiment.run.viewer import recorded, recorder
from sparserob_core.experiment.terminal.printing import printable
from sparserob_core.quantities import statistics
from sparserob_core.sip.convex_set import Array, Box
from sparserob_core.sip.events import DECIDING, Batch, EvaluationsFinished
from sparserob_core.sip.evidence import Dual, Proof
from sparserob_core.sip.program import WorstConstraint
from sparserob_core.sip.result import Result, SearchTrace
from sparserob_core.sip.scenario_bound import ScenarioBound

BATCHES = 100  # into which the evaluations of a run are divided
DECIDING_SECONDS = 10.0
"""Seconds in which the tuples of one search are evaluated once more. With a tenth of it the trajectory of a search of
some thousand evaluations would begin in its middle. Ten times as many seconds are more than a user waits for."""
LANDSCAPE_SECONDS = 60.0  # seconds that the landscape may take


def replay(
    directory: str | Path,
    *,
    save: str | Path | None = None,
    serve: bool = False,
    connect: str | None = None,
    plugins: Iterable[str | Path] = (),
    remark: Callable[[str], object] = lambda line: None,
) -> Path:
    """Send a finished run to the viewer of Rerun, as ``sparserob replay RUN`` does.

    Parameters
    ----------
    directory : str or Path
        The run directory.
    save : str or Path, optional
        A file in which the run is recorded, to be shown later.
    serve : bool, default False
        Whether the run is shown in a browser.
    connect : str, optional
        The address of a viewer that is open. A new viewer is opened where neither this nor the two above are given.
    plugins : iterable of str or Path, default ()
        Files of plugins that the run was made with. The directory itself is data: no plugin that it names is loaded.
    remark : callable, optional
        A function that receives the sentence that says what was recorded into ``save``.

    Returns
    -------
    Path
        The run directory.

    Raises
    ------
    InputError
        If the directory holds no finished run.

    Notes
    -----
    The controls of all rounds come from ``rounds.npz``. The evaluations of g, with their tuples and the notes of the
    maximiser, come from ``evaluations.npz``. A run directory keeps neither the searches for violated constraints nor
    what a maximiser shows in addition to its points.
    """
    run = stored_run(directory)
    if run.summary["message"] == UNFINISHED:
        raise InputError(f"{directory}: expected a finished run, got one that is still going on or was killed")
    title = printable(run.summary["title"] or run.directory.name)
    inspection, result = Inspection(run.config(plugins)), stored_result(run)
    sentences = play(events(inspection, title, run.directory, result), save=save, serve=serve, connect=connect)
    for line in sentences:
        remark(line)
    return run.directory


def play(
    event_stream: Iterator[Event], *, save: str | Path | None, serve: bool, connect: str | None
) -> tuple[str, ...]:
    """Send events to a recorder, and return the sentence that says what was recorded."""
    observer = recorder(save, serve, connect, LANDSCAPE_SECONDS)
    try:
        for event in event_stream:
            observer.receive(event)
    finally:
        observer.close()
    return recorded(observer, save)


def events(inspection: Inspection, title: str, directory: Path | None, result: Result) -> Iterator[Event]:
    """Yield the events that the observers of a run with this result received, as far as the result knows them.

    Parameters
    ----------
    inspection : Inspection
        The run.
    title : str
        Its title.
    directory : Path or None
        Its directory.
    result : Result
        Its result.

    Yields
    ------
    Event
        The events; searches and rounds come in the order of their rounds.
    """
    yield RunStarted(
        title=title,
        directory=directory,
        problem=inspection.problem,
        program=inspection.program,
        quiet=True,
        inspection=inspection,
    )
    searches = [] if result.trace is None else list(_replay_searches(result.trace, inspection))
    for entry in result.history:
        while searches and searches[0][0] <= entry.round:
            yield searches.pop(0)[1]
        yield entry
    yield from (event for _, event in searches)
    yield RunFinished(status=result.status, message=result.message, seconds=result.seconds, result=result)


def stored_result(run: StoredRun) -> Result:
    """Return the result that a run directory holds; raises `InputError` if its files do not fit together."""
    summary, solution = run.summary, run.solution
    decision = solution.get("decision", np.zeros(0))
    try:
        return Result(
            **_read_statistics(summary),
            decision=decision if decision.size else None,
            worst=_read_worst(summary["worst"], solution),
            proofs=[
                Proof(str(name), "proven", float(np.nan if tolerance.get("proven") is None else tolerance["proven"]))
                for name, tolerance in summary.get("tolerances", {}).items()
            ],
            counts={str(name): int(count) for name, count in summary["counts"].items() if isinstance(count, int)},
            scenario_bound=None
            if summary.get("scenario_bound") is None
            else ScenarioBound(**summary["scenario_bound"]),
            indices=run.cuts,
            dual=Dual(-np.inf, *run.proving),
            history=run.history,
            trace=run.evaluations,
        )
    except (KeyError, TypeError, ValueError, AttributeError) as error:
        raise InputError(
            f"{run.directory}: expected the files of a run, got some that do not fit together: {error}"
        ) from error


def _read_worst(said: Mapping[str, Any], solution: Mapping[str, Array]) -> WorstConstraint | None:
    """Return the worst constraint; its index is empty, since no file keeps it."""
    if said.get("violation") is None:
        return None
    violation, constraint, no_index = float(said["violation"]), str(said["constraint"]), np.empty(0)
    if said.get("time") is None:
        return WorstConstraint(violation, constraint, no_index)
    return Witness(
        violation,
        constraint,
        no_index,
        time=float(said["time"]),
        parameter=None if said.get("parameter") is None else np.asarray(said["parameter"], dtype=float),
        disturbance=solution.get("worst_disturbance"),
        initial_state=None if said.get("initial_state") is None else np.asarray(said["initial_state"], dtype=float),
        corner=str(said.get("corner", "")),
    )


def _read_statistics(summary: Mapping[str, Any], kind: type[Result] = Result) -> dict[str, Any]:
    """Return the fields of a result that are statistics; those that are null or not written have their defaults."""
    return {
        name: float(summary[name]) if described.unit else str(summary[name])
        for name, described in statistics(kind).items()
        if not described.after and summary.get(name) is not None
    }


def _replay_searches(trace: SearchTrace, inspection: Inspection) -> Iterator[tuple[int, EvaluationsFinished]]:
    """Yield every search in batches, each with the number of its round.

    The events have the tuples of indices as far as these were kept.
    """
    size, width = trace.points.shape[1], inspection.width
    has_tuples = bool(size) and size % width == 0 and inspection.program.spread is None
    for outer in np.unique(trace.outer):
        evaluations = np.flatnonzero(trace.outer == outer)
        values, seconds = trace.value[evaluations], trace.seconds[evaluations] - trace.seconds[evaluations[0]]
        points, notes = trace.points[evaluations], {name: column[evaluations] for name, column in trace.notes.items()}
        ranked = np.where(np.isnan(values), -np.inf, values)
        domain, deciding = None, np.zeros((0, DECIDING), dtype=int)
        coordinates: tuple[int, ...] = ()
        if has_tuples:
            g = inspection.relaxed_value(size // width, float(trace.epsilon[evaluations[0]]))
            domain = Box(np.tile(g.slot.lower, size // width), np.tile(g.slot.upper, size // width))
            coordinates, deciding = g.coordinates, deciding_again(g, points, notes, DECIDING_SECONDS)
        best, total = np.maximum.accumulate(ranked), 0
        batches = min(evaluations.size, max(1, BATCHES * evaluations.size // trace.outer.size))
        search_size = int((~trace.polished[evaluations]).sum())
        ends = [indices[-1] + 1 for indices in np.array_split(np.arange(evaluations.size), batches)]
        for indices in np.split(np.arange(evaluations.size), sorted({*ends, search_size} - {0, evaluations.size})):
            previous_best, standing = -np.inf if not total else float(best[total - 1]), _find_standing(notes, total)
            moments = [(1, float(moment)) for moment in seconds[indices]]
            note_points = {
                name: [(k + 1.0, column[k]) for k in indices if not np.isnan(column[k])]
                for name, column in notes.items()
            }
            batch = Batch(
                points=[points[indices]],
                values=[values[indices]],
                moments=moments,
                notes={name: rows for name, rows in note_points.items() if rows},
                first=total,
                best=previous_best,
                origin=points[standing] if size and total else None,
                stood=float(values[standing]) if total else np.nan,
            )
            total = int(indices[-1]) + 1
            best_index = int(ranked[:total].argmax())
            yield (
                int(outer) + 1,
                EvaluationsFinished(
                    count=indices.size,
                    total=total,
                    best_value=float(best[total - 1]),
                    seconds=float(seconds[indices[-1]]),
                    budget=evaluations.size,
                    best_point=points[best_index],
                    block=width if size and size % width == 0 else max(1, size),
                    phase="polish" if indices[0] >= search_size else "search",
                    round=int(outer) + 1,
                    epsilon=float(trace.epsilon[evaluations[0]]),
                    lower_bound=float(trace.bound[evaluations[indices[-1]]]),
                    batch=batch,
                    domain=domain,
                    coordinates=coordinates,
                    deciding=deciding[indices] if has_tuples else deciding,
                ),
            )


def _find_standing(notes: Mapping[str, np.ndarray], done: int) -> int:
    """Return the evaluation at which the search stood after ``done`` evaluations (`Batch`).

    It is the last one that was accepted or, where none was, the last one of all.
    """
    accepted = notes.get("accepted")
    accepted_indices = np.zeros(0, dtype=int) if accepted is None else np.flatnonzero(accepted[:done] > 0.0)
    return int(accepted_indices[-1]) if accepted_indices.size else done - 1
