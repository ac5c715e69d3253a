"""The whole walk of an experiment, from a config to a directory that says what was proven."""

from __future__ import annotations

import time
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, final

import numpy as np

from sparserob_core.control.dictionary import Dictionary
from sparserob_core.control.problem import OptimalControlProblem
from sparserob_core.errors import InputError, SparseRobError
from sparserob_core.experiment.artefacts import RunDirectory, create_directory, trace_columns
from sparserob_core.experiment.config import write_yaml
from sparserob_core.experiment.events import Broadcast, Event, Observer, RoundFinished, RunFinished, RunStarted
from sparserob_core.experiment.load import Loaded, load_config
from sparserob_core.experiment.record import arrays_of, control_of, summary_of, versions
from sparserob_core.experiment.solve import indicators
from sparserob_core.sip.convex_set import Array
from sparserob_core.sip.method import Continuation, Tools
from sparserob_core.sip.program import SemiInfiniteProgram
from sparserob_core.sip.result import Result

if TYPE_CHECKING:
    from sparserob_core.experiment.run_config import Entry

HEADING = "Complete and resolved. To repeat the run: sparserob run config.yaml"
UNFINISHED = "the run has not finished"


@final
@dataclass(frozen=True, eq=False)
class Experiment:
    """What a config describes, built: the program, and for a control problem the problem itself and its two dictionaries."""

    loaded: Loaded
    program: SemiInfiniteProgram
    problem: OptimalControlProblem | None = None
    control: Dictionary | None = None
    disturbance: Dictionary | None = None

    @property
    def title(self) -> str:
        """The title, or else the name of the config."""
        return self.loaded.config.title or name_of(self.loaded)


@final
@dataclass(frozen=True, eq=False)
class Outcome:
    """A finished run. ``control (m, K)`` is ``None`` without a decision or for a program that is no control problem; ``summary`` is
    what ``result.json`` holds; ``remarks`` say what could not be done beside the result."""

    result: Result
    directory: Path
    experiment: Experiment
    control: Array | None
    summary: Mapping[str, Any]
    remarks: Sequence[str] = ()

    @property
    def status(self) -> str:
        """The status of the result."""
        return self.result.status

    @property
    def problem(self) -> OptimalControlProblem | None:
        """The control problem."""
        return self.experiment.problem

    @property
    def program(self) -> SemiInfiniteProgram:
        """The semi-infinite program that was solved."""
        return self.experiment.program


def run(config: str | Path | Mapping[str, Any], overrides: Mapping[str, object] | Iterable[str] | None = None,
        out: str | Path | None = None, *, quiet: bool = False, figures: bool = True) -> Outcome:
    """Run an experiment: what ``sparserob run CONFIG key=value ... --out OUT`` does.

    ``config`` is a file or a mapping, ``overrides`` a mapping such as ``{"solver.name": "clarabel"}`` or texts ``key=value``.
    Raises `ConfigError` or another `InputError` before anything is solved. An error or an interrupt during the run leaves a directory
    with the config, the rounds so far and the status ``failed``.
    """
    loaded = load_config(config, overrides)
    experiment = assemble(loaded)
    tools, observers = _tools(loaded), _observers(loaded)
    method = loaded.registry.build("method", loaded.config.method.name, loaded.config.method.options)
    directory = create_directory(out, name_of(loaded), loaded.config.digest())
    journal = _Journal(directory, experiment)
    broadcast = Broadcast([*observers, ("journal", journal)])
    ending, started = RunFinished(status="failed", message=UNFINISHED, seconds=0.0), time.perf_counter()
    try:
        directory.write_text("config.yaml", write_yaml(loaded.config.plain(), HEADING))
        journal.record(Result(status="failed", message=UNFINISHED))
        broadcast(RunStarted(title=experiment.title, directory=directory.path, problem=experiment.problem, program=experiment.program,
                             quiet=quiet))
        result: Result = method.solve(experiment.program, _notifying(tools, broadcast))
        ending = RunFinished(status=result.status, message=result.message, seconds=result.seconds, result=result)
        return journal.outcome(result, figures)
    except BaseException as error:
        said = "interrupted from the keyboard" if isinstance(error, KeyboardInterrupt) else f"{type(error).__name__}: {error}"
        ending = RunFinished(status="failed", message=said, seconds=time.perf_counter() - started)
        error.add_note(f"what was done until then is in {directory.path}")
        journal.record_unfinished(said, ending.seconds)
        raise
    finally:
        broadcast(ending)


def assemble(loaded: Loaded) -> Experiment:
    """Build the problem, the dictionaries and the program of a checked config; raises `ConfigError` with the place of the key at fault."""
    from sparserob_core.control.transcription import transcribe

    config = loaded.config
    try:
        problem = _build(loaded, "problem", config.problem).build()
    except InputError as error:
        raise loaded.blame(("problem",), error) from error
    if isinstance(problem, SemiInfiniteProgram):
        return Experiment(loaded, problem)
    control = _dictionary(loaded, "control", config.dictionaries.control, problem.horizon)
    entry = config.dictionaries.disturbance
    disturbance = indicators(control) if entry is None else _dictionary(loaded, "disturbance", entry, problem.horizon)
    try:
        program = transcribe(problem, control=control, disturbance=disturbance)
    except InputError as error:
        raise loaded.blame(("problem",), error) from error
    return Experiment(loaded, program, problem, control, disturbance)


def name_of(loaded: Loaded) -> str:
    """The name of an experiment: its file's, without the ending."""
    return Path(loaded.source.name).stem


def _build(loaded: Loaded, kind: str, entry: Entry) -> Any:
    return loaded.registry.build(kind, entry.name, entry.options)


def _dictionary(loaded: Loaded, which: str, entry: Entry, horizon: float) -> Dictionary:
    try:
        dictionary: Dictionary = _build(loaded, "dictionary", entry).build(horizon)
    except InputError as error:
        raise loaded.blame(("dictionaries", which), error) from error
    return dictionary


def _tools(loaded: Loaded) -> Tools:
    config = loaded.config
    return Tools(
        solver=_build(loaded, "solver", config.solver), maximiser=_build(loaded, "maximiser", config.maximiser),
        regulariser=None if config.regulariser is None else _build(loaded, "regulariser", config.regulariser),
        continuation=Continuation(**config.continuation.model_dump()), budget=config.maximiser.budget, polish=config.maximiser.polish,
        rng=np.random.default_rng(config.seed))


def _notifying(tools: Tools, broadcast: Broadcast) -> Tools:
    def notify(event: object) -> None:
        if isinstance(event, Event):
            broadcast(event)

    return replace(tools, notify=notify)


def _observers(loaded: Loaded) -> list[tuple[str, Observer]]:
    return [(entry.name, _build(loaded, "observer", entry)) for entry in loaded.config.observers]


@final
class _Journal(Observer):
    """Keeps the rounds, so that a run that ends early leaves them, and writes everything down."""

    def __init__(self, directory: RunDirectory, experiment: Experiment) -> None:
        self.directory, self.experiment = directory, experiment
        self.rounds: list[RoundFinished] = []

    def receive(self, event: Event) -> None:
        if isinstance(event, RoundFinished):
            self.rounds.append(event)

    def record(self, result: Result) -> tuple[Array | None, dict[str, Any]]:
        control = control_of(result, self.experiment.program, self.experiment.control)
        config = self.experiment.loaded.config
        summary = {"title": self.experiment.title, **summary_of(result, control, self.experiment.control),
                   "seed": config.seed, "versions": versions(), "config": config.digest()}
        self.directory.write_json("result.json", summary)
        return control, summary

    def record_unfinished(self, message: str, seconds: float) -> None:
        last = self.rounds[-1] if self.rounds else None
        result = Result(status="failed", message=message, history=tuple(self.rounds), seconds=seconds)
        if last is not None:
            result = replace(result, lower_bound=last.lower_bound, upper_bound=last.upper_bound, epsilon=last.epsilon)
        try:
            self.record(result)
            self.directory.write_arrays("trace.npz", trace_columns(self.rounds))
        except SparseRobError:
            return  # the error that ended the run is the one to be told

    def outcome(self, result: Result, figures: bool) -> Outcome:
        experiment = self.experiment
        control, summary = self.record(result)
        self.directory.write_arrays("solution.npz", arrays_of(result, experiment.program, experiment.control, control))
        self.directory.write_arrays("trace.npz", trace_columns(self.rounds or list(result.history)))
        if result.trace is not None:
            self.directory.write_arrays("evaluations.npz", vars(result.trace))
        remarks = _draw(experiment, result, self.directory.path) if figures and control is not None else ()
        return Outcome(result, self.directory.path, experiment, control, summary, remarks)


def _draw(experiment: Experiment, result: Result, directory: Path) -> Sequence[str]:
    """The figures are an extra: whatever goes wrong with them is a remark, and the run is as good as before."""
    from sparserob_core.experiment.drawing import draw_experiment

    active = np.array([cut.index[0] for cut in result.indices if cut.multiplier > 0])
    try:
        draw_experiment(experiment, np.asarray(result.decision), active, result.history, directory, result.cost)
    except InputError as error:
        return (str(error),)
    except Exception as error:  # noqa: BLE001  as said above
        return (f"the figures could not be drawn: {type(error).__name__}: {error}",)
    return ()
