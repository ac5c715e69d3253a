"""The outcome of a run or of `solve`: it saves and draws itself, and stands wherever a run directory does."""

from __future__ import annotations

import shutil
import tempfile
import weakref
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, fields
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any, final

import numpy.typing as npt

from sparserob_core.control.policies.policy import Policy
from sparserob_core.control.problem.dictionary import Dictionary
from sparserob_core.control.problem.problem import OptimalControlProblem
from sparserob_core.control.studies.adversary import Adversary
from sparserob_core.control.studies.answer import ControlResult, Tube
from sparserob_core.control.transcription.record import Transcription
from sparserob_core.errors import InputError
from sparserob_core.experiment.assemble import ControlExperiment, Experiment, assemble, tools_of
from sparserob_core.experiment.config.load import Loaded, load_config
from sparserob_core.experiment.config.reading.reader import ConfigSource, require_readable, write_yaml
from sparserob_core.experiment.config.writing.source import component_keys, dictionary_keys, source_of
from sparserob_core.experiment.directory.provenance import git_revision, provenance
from sparserob_core.experiment.directory.study import open_directory
from sparserob_core.experiment.plugins.registry import load_registry
from sparserob_core.experiment.run.conclusion.bound import bounded, unbounded
from sparserob_core.experiment.run.conclusion.causal import with_causal
from sparserob_core.experiment.run.conclusion.fewest import with_activity
from sparserob_core.experiment.run.events import StudyProgress
from sparserob_core.experiment.run.inspection import Inspection
from sparserob_core.experiment.run.journal import Journal
from sparserob_core.experiment.terminal.table import result_rows
from sparserob_core.sip.convex_set import Array
from sparserob_core.sip.events import Notify, ignore
from sparserob_core.sip.method import Tools
from sparserob_core.sip.program import SemiInfiniteProgram
from sparserob_core.sip.proof.verdict import add_warning
from sparserob_core.sip.result import Result
from sparserob_core.sip.solver import Named

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from sparserob_core.control.studies.causal import CausalBound

REPR_ROWS = 4  # of the table of a run, which `repr` shows
HEADING = "Complete and resolved. To repeat the run: sparserob run config.yaml"
COMPONENTS = ("method", "maximiser", "solver", "regulariser", "policy")


@final
@dataclass(frozen=True, eq=False)
class SolveArguments:
    """The arguments of `solve` for a problem.

    ``choices`` are the components, by name, by mapping or as objects. ``rest`` holds the other keys of a config.
    """

    problem: OptimalControlProblem
    choices: Mapping[str, Any]
    dictionaries: Mapping[str, Any]
    rest: Mapping[str, Any]

    def source(self) -> ConfigSource:
        """Return the config with the same meaning; raises `InputError` where there is none."""
        registry, keys = load_registry(), dict(self.rest)
        for kind, choice in self.choices.items():
            keys[kind] = None if choice is None else component_keys(registry, kind, choice)
        keys["maximiser"] = {**keys["maximiser"], **keys.pop("search")}
        keys["dictionaries"] = {
            signal: dictionary_keys(registry, signal, choice) for signal, choice in self.dictionaries.items()
        }
        return source_of(self.problem, keys)


@final
@dataclass(frozen=True, eq=False, kw_only=True, repr=False)
class SolvedProblem(ControlResult):
    """The result of `solve` for a control problem, or of a run, with its control, tube and worst cases.

    It stands for a run: it can be saved and drawn, and `check`, `simulate`, `margin`, `controller`, `loop` and
    `compare` take it.

    Parameters
    ----------
    origin : ConfigSource or SolveArguments
        The config of the result, or the arguments of `solve`, which become a config when one is needed.

    Notes
    -----
    The other fields are those of `ControlResult`.
    """

    origin: ConfigSource | SolveArguments = field(repr=False)

    @staticmethod
    def run(result: Result, experiment: ControlExperiment, causal: CausalBound | None = None) -> SolvedProblem:
        """Return the result of a run, together with its experiment.

        Parameters
        ----------
        result : Result
            The result.
        experiment : ControlExperiment
            The experiment that was run.
        causal : CausalBound, optional
            The bound for every causal policy.

        Returns
        -------
        SolvedProblem
            The result.
        """
        loaded = experiment.loaded
        source = ConfigSource(loaded.source.name, loaded.source.folder, loaded.config.plain())
        solved = SolvedProblem.asked(result, experiment.transcription, source, causal)
        solved.__dict__["experiment"] = experiment
        return solved

    @staticmethod
    def asked(
        result: Result, model: Transcription, origin: ConfigSource | SolveArguments, causal: CausalBound | None = None
    ) -> SolvedProblem:
        """Return the result of a problem that was transcribed.

        Parameters
        ----------
        result : Result
            The result.
        model : Transcription
            The problem on its dictionaries.
        origin : ConfigSource or SolveArguments
            The config of the result, or the arguments of `solve`.
        causal : CausalBound, optional
            The bound for every causal policy.

        Returns
        -------
        SolvedProblem
            The result.
        """
        values = {entry.name: getattr(result, entry.name) for entry in fields(Result)}
        return SolvedProblem(**values, model=model, causal=causal, origin=origin)

    @cached_property
    def experiment(self) -> ControlExperiment:
        """The experiment, as a config describes it; raises `InputError` where no config can."""
        return ControlExperiment(self._loaded, self.model)

    @cached_property
    def directory(self) -> Path:
        """The run directory: the last one that was saved, else a temporary one that is removed with the result."""
        path = Path(tempfile.mkdtemp(prefix="sparserob-"))
        weakref.finalize(self, shutil.rmtree, path, ignore_errors=True)
        return self._save_result(path / "run", figures=False).directory

    def save(self, directory: str | Path, *, figures: bool = True) -> Outcome:
        """Write a run directory like that of `run`.

        The bounds that a run adds to the result of its method are added here too. They are a lower bound without
        rounding errors, bounds of the time of action, and under feedback a bound for every causal policy.

        Parameters
        ----------
        directory : str or Path
            The directory, new or empty.
        figures : bool, default True
            Whether the figures are drawn.

        Returns
        -------
        Outcome
            The run.

        Raises
        ------
        InputError
            If no config can describe the problem, for example one with a function of the parameters that is no
            arithmetic. Also if the directory cannot be made.
        """
        outcome = self._save_result(Path(directory), figures)
        self.__dict__["directory"] = outcome.directory
        return outcome

    def plot(self, name: str | None = None) -> Figure:
        """Return a figure of the run, for matplotlib.

        Parameters
        ----------
        name : str, optional
            The figure. With a control: ``control``, ``states``, ``convergence``, ``adversary``, ``plane`` where the
            problem names one, and under feedback ``gains``, ``effort`` and ``answers``. Of a search: ``climb`` and
            ``landscape``. Of an infeasible problem: ``clash``. Unless given it is ``states``, or ``clash`` where the
            problem is infeasible.

        Returns
        -------
        matplotlib.figure.Figure
            The figure.

        Raises
        ------
        InputError
            If there is no such figure; the message names those that there are.
        """
        from sparserob_core.experiment.run.drawing import plot

        return plot(self.experiment, self, name)

    @property
    def _loaded(self) -> Loaded:
        experiment = self.__dict__.get("experiment")
        return load_config(_get_source(self.origin)) if experiment is None else experiment.loaded

    def _save_result(self, path: Path, figures: bool) -> Outcome:
        experiment = self.experiment
        loaded, tools = experiment.loaded, tools_of(experiment.loaded)
        if isinstance(tools.solver, Named):  # the counts of solver calls go on from those of the result
            tools.solver.failures.resume(self.counts.get("solver_calls", 0), self.unanswered)
        plain = loaded.config.plain()
        require_readable(plain, write_yaml(plain, HEADING))
        result = self if "directory" in self.__dict__ else concluded(experiment, self, tools)
        with open_directory(loaded, path, HEADING) as directory:
            journal = Journal(directory, experiment, provenance(plain, git_revision(loaded.source.folder)))
            journal.asked = True  # nothing listened to the search: no note may claim that the maximiser was idle
            control, summary, remarks = journal.finish(result, figures)
        return Outcome(result, directory.path, experiment, control, summary, remarks)

    def _repr_html_(self) -> str:
        """Return the table of the result and the figure of its control, for notebooks.

        There is no figure where no config can describe the problem.
        """
        from sparserob_core.experiment.directory.record import control_of, summary_of
        from sparserob_core.experiment.run.drawing import picture
        from sparserob_core.experiment.terminal.notebook import page

        summary = summary_of(self, control_of(self, self.model), self.model)
        title = self.problem.title or "Result"
        try:
            drawn = picture(self.experiment, self)
        except InputError:
            drawn = None
        return page(title, result_rows({"title": title, **summary}), drawn)

    def __reduce__(self) -> tuple[Callable[..., Any], tuple[Any, ...]]:
        model = self.model
        arguments = (model.problem, model.control, model.disturbance, model.formulation, model.policy)
        return _rebuild_result, (self.plain, *arguments, self.causal, self.origin)


def concluded(experiment: Experiment, result: Result, tools: Tools, notify: Notify = ignore) -> Result:
    """Add to the result of a method the bounds that a run proves before it writes its result.

    They are lower bounds without rounding errors, bounds of the time of action, and bounds for causal policies. A bound
    is left out where the time of the tools is over before it is known.

    Parameters
    ----------
    experiment : Experiment
        The experiment of the result.
    result : Result
        The result of the method.
    tools : Tools
        The solver and the deadline.
    notify : callable, optional
        A function that receives `StudyProgress`, once at the beginning of each phase.

    Returns
    -------
    Result
        For a control problem a `SolvedProblem`; for another program the result as `add_warning` returns it.
    """
    if not isinstance(experiment, ControlExperiment):
        return add_warning(experiment.program, result)
    attempt = tools.deadline.attempt
    notify(StudyProgress(text="certificate: what the multipliers prove without rounding", phase=True, result=result))
    if result.sparsest is None:
        result = attempt(lambda: bounded(experiment, result, tools.deadline), lambda: unbounded(result))
    notify(StudyProgress(text="fewest active: how little any admissible control must act", phase=True))
    bounded_result = attempt(lambda: with_activity(experiment, result, tools), lambda: result).accounted(tools.solver)
    notify(StudyProgress(text="causal bound: what no causal policy can do", phase=True))
    solved = SolvedProblem.run(bounded_result, experiment)
    conclusion = attempt(lambda: with_causal(solved, tools), lambda: solved)
    conclusion.__dict__["experiment"] = experiment
    return conclusion


def _get_source(origin: ConfigSource | SolveArguments) -> ConfigSource:
    return origin.source() if isinstance(origin, SolveArguments) else origin


def _rebuild_result(
    result: Result,
    problem: OptimalControlProblem,
    control: Dictionary,
    disturbance: Dictionary,
    form: Any,
    policy: Policy | None,
    causal: CausalBound | None,
    origin: ConfigSource | SolveArguments,
) -> SolvedProblem:
    """Return a result that was pickled; its program is built anew."""
    from sparserob_core.control.transcription.transcribe import prepare

    return SolvedProblem.asked(result, prepare(problem, control, disturbance, form, policy), origin, causal)


@final
@dataclass(frozen=True, eq=False)
class Outcome:
    """A finished run.

    It can be pickled; the experiment is then built anew from its config where the outcome is read.

    Parameters
    ----------
    result : Result
        The result; for a control problem a `SolvedProblem`.
    directory : Path
        The run directory.
    experiment : Experiment
        The experiment that was run.
    control : array (m, K) or None
        The control on its pieces. ``None`` without a decision, or for a program that is no control problem.
    summary : mapping
        The contents of ``result.json``.
    remarks : sequence of str, default ()
        Warnings about anything that could not be done in addition to the result.
    interrupted : bool, default False
        Whether a key or a signal ended the run, or came while it ended.
    """

    result: Result
    directory: Path
    experiment: Experiment
    control: Array | None
    summary: Mapping[str, Any]
    remarks: Sequence[str] = ()
    interrupted: bool = False

    def __post_init__(self) -> None:
        if isinstance(self.experiment, ControlExperiment) and not isinstance(self.result, SolvedProblem):
            object.__setattr__(self, "result", SolvedProblem.run(self.result, self.experiment))

    @property
    def status(self) -> str:
        """The status of the result."""
        return self.result.status

    @property
    def problem(self) -> OptimalControlProblem | None:
        """The control problem; ``None`` for a program of another kind."""
        return self.experiment.problem

    @property
    def program(self) -> SemiInfiniteProgram:
        """The semi-infinite program that was solved."""
        return self.experiment.program

    def tube(self, times: npt.ArrayLike) -> Tube:
        """Return the states at ``times (T,)`` with the bounds that the disturbance can bring them to
        (`ControlResult.tube`)."""
        return self._get_solved_problem().tube(times)

    def worst(self, constraint: str) -> Adversary:
        """Return the worst case of the ``constraint`` of that name (`ControlResult.adversary`)."""
        return self._get_solved_problem().adversary(constraint)

    def plot(self, name: str | None = None) -> Figure:
        """Return a figure of the run, for matplotlib.

        ``name`` is one of those of `SolvedProblem.plot`; unless given it is ``states``, or ``clash`` where the problem
        is infeasible. Raises `InputError` if there is no such figure.
        """
        from sparserob_core.experiment.run.drawing import plot

        return plot(self.experiment, self.result, name)

    def _get_solved_problem(self) -> SolvedProblem:
        if not isinstance(self.result, SolvedProblem):
            raise InputError("this is a semi-infinite program that is no control problem: it has no states")
        return self.result

    def __repr__(self) -> str:
        lines = [f"  {name}: {value}" for name, value in result_rows(self.summary)[:REPR_ROWS]]
        return "\n".join([f"Outcome of {self.experiment.title!r} in {self.directory}", *lines])

    def _repr_html_(self) -> str:
        """Return the table of the run and the figure of its control, for notebooks."""
        from sparserob_core.experiment.terminal.notebook import page

        file = self.directory / "figures" / "control.png"
        drawn = file.read_bytes() if file.is_file() else None
        return page(self.experiment.title, result_rows(self.summary), drawn)

    def __reduce__(self) -> tuple[Callable[..., Any], tuple[Any, ...]]:
        of = self.result
        plain, causal = (of.plain, of.causal) if isinstance(of, ControlResult) else (of, None)
        loaded = self.experiment.loaded
        source = ConfigSource(loaded.source.name, loaded.source.folder, loaded.config.plain())
        kept = (self.directory, self.control, self.summary, self.remarks, self.interrupted)
        return _rebuild_outcome, (source, plain, *kept, causal)

    def show(self, save: str | Path | None = None, *, serve: bool = False, connect: str | None = None) -> None:
        """Show the run in the viewer of Rerun.

        Parameters
        ----------
        save : str or Path, optional
            A file in which the run is recorded, to be shown later.
        serve : bool, default False
            Whether the run is shown in a browser.
        connect : str, optional
            The address of a viewer that is open.

        Raises
        ------
        InputError
            If there is no viewer, or no display.

        Notes
        -----
        A new viewer is opened where none of the three is given.
        """
        from sparserob_core.experiment.run.replay import events, play

        inspection = Inspection(self.experiment.loaded)
        play(
            events(inspection, self.experiment.title, self.directory, self.result),
            save=save,
            serve=serve,
            connect=connect,
        )


def _rebuild_outcome(
    source: ConfigSource,
    result: Result,
    directory: Path,
    control: Array | None,
    summary: Mapping[str, Any],
    remarks: Sequence[str],
    interrupted: bool,
    causal: CausalBound | None = None,
) -> Outcome:
    """Return an outcome that was pickled; its experiment is built anew from its config."""
    experiment = assemble(load_config(source))
    if isinstance(experiment, ControlExperiment):
        result = SolvedProblem.run(result, experiment, causal)
    return Outcome(result, directory, experiment, control, summary, remarks, interrupted)
