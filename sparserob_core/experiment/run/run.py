"""The run of an experiment, from its config to a directory that says what was proven."""

from __future__ import annotations

import time
from collections.abc import Iterable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

from sparserob_core.control.transcription.provable import UNPROVABLE_SECONDS, announce, unprovable
from sparserob_core.errors import InputError, SparseRobError, named
from sparserob_core.experiment.assemble import Anew, UntranscribedExperiment, assemble_in_time, build, name_of, tools_of
from sparserob_core.experiment.config.load import Loaded, load_config
from sparserob_core.experiment.config.reading.reader import write_yaml
from sparserob_core.experiment.directory.artefacts import create_directory
from sparserob_core.experiment.directory.finished import UNFINISHED
from sparserob_core.experiment.directory.provenance import git_revision, provenance
from sparserob_core.experiment.directory.study import open_directory
from sparserob_core.experiment.run.events import Broadcast, Event, Observer, RunFinished, RunStarted
from sparserob_core.experiment.run.given import GivenConfig, as_config
from sparserob_core.experiment.run.inspection import Inspection
from sparserob_core.experiment.run.journal import Journal
from sparserob_core.experiment.run.outcome import HEADING, Outcome, SolvedProblem, concluded
from sparserob_core.experiment.terminal.printing import printable
from sparserob_core.sip.limits.deadline import Deadline, OutOfTime
from sparserob_core.sip.method import ExecutorFactory, Method, Tools, require_suited
from sparserob_core.sip.methods.own_units import solve_in_own_units
from sparserob_core.sip.proof.branch_and_bound import more
from sparserob_core.sip.relaxed.relaxed import require_separable
from sparserob_core.sip.result import Result


def run(
    config: GivenConfig,
    overrides: Mapping[str, object] | Iterable[str] | None = None,
    out: str | Path | None = None,
    *,
    quiet: bool = False,
    figures: bool = True,
    observers: Iterable[Observer] = (),
) -> Outcome:
    """Run an experiment and write its run directory, as ``sparserob run CONFIG key=value ... --out OUT`` does.

    Parameters
    ----------
    config : str, Path, mapping, OptimalControlProblem or finished run
        The config: a file, a mapping, a problem, or a run or its directory, whose config is taken (`as_config`).
    overrides : mapping or iterable of str, optional
        Changes of the config: ``{"solver.name": "clarabel"}``, or texts ``key=value``.
    out : str or Path, optional
        The run directory, new or empty. A new one below ``runs/`` unless given.
    quiet : bool, default False
        Whether the terminal is left alone.
    figures : bool, default True
        Whether the figures of the run are drawn.
    observers : iterable of Observer, default ()
        Observers of the run, in addition to those that the config names.

    Returns
    -------
    Outcome
        The finished run.

    Raises
    ------
    ConfigError
        If a key of the config is at fault.
    InputError
        If another argument is at fault. This and `ConfigError` are raised before anything is solved.
    TimeLimitError
        If ``limits.seconds`` of the config is over before the problem is read.

    Notes
    -----
    ``limits.seconds`` of the config bounds the time; at the limit the method ends as at an interrupt. An interrupt ends
    the method with its last round: the status is ``undecided`` unless more was proven. An error, or an interrupt before
    the first decision, leaves a directory with the config, the rounds so far and the status ``failed``.
    """
    loaded = load_config(as_config(config), overrides)
    git = git_revision(loaded.source.folder)
    return run_loaded(loaded, git, out, quiet=quiet, figures=figures, observers=observers)


def run_loaded(
    loaded: Loaded,
    git: Mapping[str, Any] | None,
    out: str | Path | None = None,
    *,
    quiet: bool = False,
    figures: bool = True,
    observers: Iterable[Observer] = (),
) -> Outcome:
    """Run an experiment whose config is loaded already.

    Parameters
    ----------
    loaded : Loaded
        The checked config.
    git : mapping or None
        The revision of the config's folder, as `git_revision` returns it.
    out, quiet, figures, observers
        As for `run`.

    Returns
    -------
    Outcome
        The finished run.
    """
    origin = provenance(loaded.config.plain(), git)
    executors: ExecutorFactory = build(loaded, "executor", loaded.config.executor)
    with executors.open() as executor:  # opened first, so that sums are rounded here as they are on the workers
        rebuild = Anew.of(loaded) if executors.parallel else None
        tools = replace(tools_of(loaded), executor=executor, rebuild=rebuild)
        return _run(loaded, tools, origin, out, quiet=quiet, figures=figures, observers=observers)


def _run(
    loaded: Loaded,
    tools: Tools,
    origin: Mapping[str, Any],
    out: str | Path | None,
    *,
    quiet: bool,
    figures: bool,
    observers: Iterable[Observer],
) -> Outcome:
    deadline = Deadline(loaded.config.limits.seconds)  # the time of the transcription is part of the limit
    experiment = assemble_in_time(loaded, deadline)
    if isinstance(experiment, UntranscribedExperiment):
        return _write_untranscribed(experiment, origin, out)
    why = None if experiment.problem is None else unprovable(experiment.problem)
    if why is not None:
        deadline, why = (
            (deadline if deadline.bounded else Deadline(UNPROVABLE_SECONDS)),
            announce(why, deadline.bounded),
        )
    tools = replace(tools, deadline=deadline)
    watching = [*_build_observers(loaded), *((type(observer).__name__, observer) for observer in observers)]
    method: Method = build(loaded, "method", loaded.config.method)
    try:
        require_suited(method, experiment.program, loaded.config.method.name)
        require_separable(experiment.program, tools.solver, tools.regulariser)
    except InputError as error:
        raise loaded.located((), error) from error
    with create_directory(out, name_of(loaded), loaded.config.digest()) as directory:
        journal = Journal(directory, experiment, origin)
        broadcast = Broadcast([("journal", journal), *watching])
        ending, started = RunFinished(status="failed", message=UNFINISHED, seconds=0.0), time.perf_counter()
        result: Result | None = None
        try:
            directory.write_text("config.yaml", write_yaml(loaded.config.plain(), HEADING))
            journal.record(Result(status="failed", message=UNFINISHED))
            broadcast(
                RunStarted(
                    title=printable(experiment.title),
                    directory=directory.path,
                    problem=experiment.problem,
                    unprovable=why,
                    program=experiment.program,
                    quiet=quiet,
                    inspection=Inspection(loaded),
                )
            )
            try:
                with deadline.enforced():
                    result = solve_in_own_units(method, experiment.program, _connect_broadcast(tools, broadcast))
                    result = result.accounted(tools.solver)
            except KeyboardInterrupt as interrupt:  # a method that returns no result when it is interrupted
                reason = deadline.interrupt(interrupt)
                result = journal.known(reason, time.perf_counter() - started)
                if result is None and not isinstance(interrupt, OutOfTime):
                    raise
                result = result or Result(status="undecided", message=f"{reason}; {more(deadline)}", stopped=reason)
            result = concluded(experiment, result, tools, broadcast)
            ending = RunFinished(
                status=result.status,
                message=result.message,
                seconds=result.seconds,
                result=result.plain if isinstance(result, SolvedProblem) else result,
                pressed=deadline.pressed,
            )
            control, summary, remarks = journal.finish(result, figures, broadcast, deadline)
            return Outcome(result, directory.path, experiment, control, summary, remarks, deadline.pressed)
        except BaseException as error:
            if result is not None and isinstance(error, SparseRobError):  # a result that could not be written
                error.add_note(f"the run itself came to its end, {result.status}: {result.message}")
            error.add_note(f"what was done until then is in {directory.path}")
            if result is None or not isinstance(error, KeyboardInterrupt):
                ending = RunFinished(
                    status="failed", message=_describe_error(error), seconds=time.perf_counter() - started
                )
            ending = replace(ending, pressed=ending.pressed or isinstance(error, KeyboardInterrupt))
            if result is None:
                journal.record_unfinished(ending.message, ending.seconds)
            raise
        finally:
            broadcast(ending)


def _write_untranscribed(
    experiment: UntranscribedExperiment, origin: Mapping[str, Any], out: str | Path | None
) -> Outcome:
    """Write the directory of a problem that was not transcribed in time, and return its outcome."""
    loaded = experiment.loaded
    result = Result(status="undecided", message=experiment.reason, lower_bound=0.0, stopped=experiment.reason)
    with open_directory(loaded, out, HEADING) as directory:
        control, summary, remarks = Journal(directory, experiment, origin).finish(result, figures=False)
        return Outcome(result, directory.path, experiment, control, summary, remarks)


def _describe_error(error: BaseException) -> str:
    """Return the reason for which a run ended without its method.

    The text of an interrupt is its own; one from the keyboard has none and is named here.
    """
    if isinstance(error, KeyboardInterrupt):
        return str(error) or "interrupted from the keyboard"
    return named(error)


def _connect_broadcast(tools: Tools, broadcast: Broadcast) -> Tools:
    def notify(event: object) -> None:
        if isinstance(event, Event):
            broadcast(event)

    return replace(tools, notify=notify)


def _build_observers(loaded: Loaded) -> list[tuple[str, Observer]]:
    return [(entry.name, build(loaded, "observer", entry)) for entry in loaded.config.observers]
