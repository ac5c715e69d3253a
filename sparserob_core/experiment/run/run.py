"""The whole walk of an experiment, from a config to a directory that says what was proven."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, final

import numpy.typing as npt

from sparserob_core.control.problem.problem import OptimalControlProblem
from sparserob_core.control.studies.adversary import Adversary
from sparserob_core.control.studies.answer import ControlResult, Tube
from sparserob_core.control.transcription.provable import SECONDS, announced, unprovable
from sparserob_core.errors import InputError, named
from sparserob_core.experiment.assemble import Anew, ControlExperiment, Experiment, assemble, build, name_of, tools_of
from sparserob_core.experiment.config.load import Loaded, load_config
from sparserob_core.experiment.config.reader import Source, write_yaml
from sparserob_core.experiment.directory.artefacts import create_directory
from sparserob_core.experiment.directory.finished import UNFINISHED
from sparserob_core.experiment.directory.provenance import git_revision, provenance
from sparserob_core.experiment.run.bound import bounded
from sparserob_core.experiment.run.causal import with_causal
from sparserob_core.experiment.run.events import Broadcast, Event, Observer, RunFinished, RunStarted
from sparserob_core.experiment.run.fewest import with_activity
from sparserob_core.experiment.run.inspection import Inspection
from sparserob_core.experiment.run.journal import Journal
from sparserob_core.experiment.terminal.printing import printable
from sparserob_core.experiment.terminal.table import result_rows
from sparserob_core.sip.convex_set import Array
from sparserob_core.sip.method import Deadline, ExecutorFactory, Method, Tools, require_suited
from sparserob_core.sip.methods.own_units import solve_in_own_units
from sparserob_core.sip.program import SemiInfiniteProgram
from sparserob_core.sip.relaxed.relaxed import require_separable
from sparserob_core.sip.result import Result

if TYPE_CHECKING:
    from sparserob_core.control.studies.causal import CausalBound

ROWS = 4  # of a table, in a line each of what `repr` says
HEADING = "Complete and resolved. To repeat the run: sparserob run config.yaml"


@final
@dataclass(frozen=True, eq=False)
class Outcome:
    """A finished run. ``control (m, K)`` is ``None`` without a decision or for a program that is no control problem;
    the ``result`` of a control problem is a `ControlResult`; ``summary`` is what ``result.json`` holds; ``remarks`` say
    what could not be done beside the result; ``interrupted``: a key or a signal ended it, or came while it ended.

    It can be pickled: the experiment is built anew from its config where it is read."""

    result: Result
    directory: Path
    experiment: Experiment
    control: Array | None
    summary: Mapping[str, Any]
    remarks: Sequence[str] = ()
    interrupted: bool = False

    def __post_init__(self) -> None:
        if isinstance(self.experiment, ControlExperiment) and not isinstance(self.result, ControlResult):
            object.__setattr__(self, "result", ControlResult.of(self.result, self.experiment.transcription))

    @property
    def status(self) -> str:
        """The status of the result."""
        return self.result.status

    @property
    def problem(self) -> OptimalControlProblem | None:
        """The control problem."""
        return self.experiment.problem if isinstance(self.experiment, ControlExperiment) else None

    @property
    def program(self) -> SemiInfiniteProgram:
        """The semi-infinite program that was solved."""
        return self.experiment.program

    def tube(self, times: npt.ArrayLike) -> Tube:
        """The states at times ``(T,)`` and how far the disturbance may bring them: `ControlResult.tube`."""
        return self._of_control().tube(times)

    def worst(self, constraint: str) -> Adversary:
        """The worst case of the constraint of that name: `ControlResult.adversary`."""
        return self._of_control().adversary(constraint)

    def _of_control(self) -> ControlResult:
        if not isinstance(self.result, ControlResult):
            raise InputError("this is a semi-infinite program that is no control problem: it has no states")
        return self.result

    def __repr__(self) -> str:
        said = [f"  {name}: {value}" for name, value in result_rows(self.summary)[:ROWS]]
        return "\n".join([f"Outcome of {self.experiment.title!r} in {self.directory}", *said])

    def _repr_html_(self) -> str:
        """The table of the run and the figure of its control, for notebooks."""
        from sparserob_core.experiment.terminal.notebook import page

        return page(self.experiment.title, result_rows(self.summary), self.directory / "figures" / "control.png")

    def __reduce__(self) -> tuple[Callable[..., Any], tuple[Any, ...]]:
        of = self.result
        plain, causal = (of.plain, of.causal) if isinstance(of, ControlResult) else (of, None)
        loaded = self.experiment.loaded
        stated = Source(loaded.source.name, loaded.source.folder, loaded.config.plain())
        kept = (self.directory, self.control, self.summary, self.remarks, self.interrupted)
        return _read, (stated, plain, *kept, causal)

    def show(self, save: str | Path | None = None, *, serve: bool = False, connect: str | None = None) -> None:
        """Show the run in the viewer of Rerun: a new one, one that listens at ``connect``, a browser (``serve``), or
        later (``save``, a file).

        Raises `InputError` where there is none, or no display."""
        from sparserob_core.experiment.run.replay import events, play

        inspection = Inspection(self.experiment.loaded)
        play(
            events(inspection, self.experiment.title, self.directory, self.result),
            save=save,
            serve=serve,
            connect=connect,
        )


def _read(
    stated: Source,
    result: Result,
    directory: Path,
    control: Array | None,
    summary: Mapping[str, Any],
    remarks: Sequence[str],
    interrupted: bool,
    causal: CausalBound | None = None,
) -> Outcome:
    """A pickled outcome; its experiment is built anew from its config."""
    experiment = assemble(load_config(stated))
    if isinstance(experiment, ControlExperiment):
        result = ControlResult.of(result, experiment.transcription, causal)
    return Outcome(result, directory, experiment, control, summary, remarks, interrupted)


def run(
    config: str | Path | Mapping[str, Any],
    overrides: Mapping[str, object] | Iterable[str] | None = None,
    out: str | Path | None = None,
    *,
    quiet: bool = False,
    figures: bool = True,
    observers: Iterable[Observer] = (),
) -> Outcome:
    """Run an experiment: what ``sparserob run CONFIG key=value ... --out OUT`` does.

    ``config`` is a file or a mapping, ``overrides`` a mapping such as ``{"solver.name": "clarabel"}`` or texts
    ``key=value``. ``observers`` watch beside those that the config names. ``limits.seconds`` of the config bounds its
    time: the method then ends as at an interrupt.
    Raises `ConfigError` or another `InputError` before anything is solved, and `TimeLimitError` when the limit comes
    before there is anything to solve. An interrupt ends the method with what it
    knows by then: the outcome is that of the last round, ``undecided`` unless more was proven. An error, or an
    interrupt before there was a decision, leaves a directory with the config, the rounds so far and the status
    ``failed``.
    """
    loaded = load_config(config, overrides)
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
    """`run`, of a config that was loaded; ``git``: the revision of its folder, as `git_revision` has it."""
    origin = provenance(loaded.config.plain(), git)
    executors: ExecutorFactory = build(loaded, "executor", loaded.config.executor)
    with executors.open() as executor:  # first: what is added up from here on is added up as on the workers
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
    deadline = Deadline(loaded.config.limits.seconds)  # the transcription counts too
    experiment = assemble(loaded, deadline)
    why = unprovable(experiment.problem) if isinstance(experiment, ControlExperiment) else None
    if why is not None:
        deadline, why = (deadline if deadline.bounded else Deadline(SECONDS)), announced(why, deadline.bounded)
    tools = replace(tools, deadline=deadline)
    watching = [*_observers(loaded), *((type(observer).__name__, observer) for observer in observers)]
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
        complete = True
        try:
            directory.write_text("config.yaml", write_yaml(loaded.config.plain(), HEADING))
            journal.record(Result(status="failed", message=UNFINISHED))
            broadcast(
                RunStarted(
                    title=printable(experiment.title),
                    directory=directory.path,
                    problem=experiment.problem if isinstance(experiment, ControlExperiment) else None,
                    unprovable=why,
                    program=experiment.program,
                    quiet=quiet,
                    inspection=Inspection(loaded),
                )
            )
            try:
                result = solve_in_own_units(method, experiment.program, _notifying(tools, broadcast))
                result = result.accounted(tools.solver)
            except KeyboardInterrupt as pressed:  # a method that does not return what it knows
                deadline.interrupt(pressed)
                result, complete = journal.known(_said(pressed), time.perf_counter() - started), False
                if result is None:
                    raise
            if isinstance(experiment, ControlExperiment):
                known = bounded(experiment, result) if result.sparsest is None else result
                known = with_activity(experiment, known, tools)
                result = with_causal(ControlResult.of(known, experiment.transcription), tools)
            ending = RunFinished(
                status=result.status,
                message=result.message,
                seconds=result.seconds,
                result=result.plain if isinstance(result, ControlResult) else result,
                pressed=deadline.pressed,
            )
            control, summary, remarks = journal.finish(result, figures and complete, certify=complete, notify=broadcast)
            return Outcome(result, directory.path, experiment, control, summary, remarks, deadline.pressed)
        except BaseException as error:
            error.add_note(f"what was done until then is in {directory.path}")
            if result is None or not isinstance(error, KeyboardInterrupt):
                ending = RunFinished(status="failed", message=_said(error), seconds=time.perf_counter() - started)
            ending = replace(ending, pressed=ending.pressed or isinstance(error, KeyboardInterrupt))
            if result is None:
                journal.record_unfinished(ending.message, ending.seconds)
            raise
        finally:
            broadcast(ending)


def _said(error: BaseException) -> str:
    """What ended a run that its method did not end; an interrupt says what it was, unless it is from the keyboard."""
    if isinstance(error, KeyboardInterrupt):
        return str(error) or "interrupted from the keyboard"
    return named(error)


def _notifying(tools: Tools, broadcast: Broadcast) -> Tools:
    def notify(event: object) -> None:
        if isinstance(event, Event):
            broadcast(event)

    return replace(tools, notify=notify)


def _observers(loaded: Loaded) -> list[tuple[str, Observer]]:
    return [(entry.name, build(loaded, "observer", entry)) for entry in loaded.config.observers]
