"""Construction of the objects that a checked config describes: problem, dictionaries, program and tools."""

from __future__ import annotations

import json
from abc import ABC, abstractmethod
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, final

import numpy as np

from sparserob_core.control.policies.policy import Policy
from sparserob_core.control.problem.dictionary import Dictionary
from sparserob_core.control.problem.problem import OptimalControlProblem
from sparserob_core.errors import InputError, TimeLimitError
from sparserob_core.experiment.config.load import Loaded, load_config
from sparserob_core.experiment.plugins.guards import guarded
from sparserob_core.sip.convexity import Regulariser
from sparserob_core.sip.limits.deadline import Deadline, OutOfTime
from sparserob_core.sip.method import Tools
from sparserob_core.sip.program import SemiInfiniteProgram
from sparserob_core.sip.solver import AUTO, Auto, Solver, named

if TYPE_CHECKING:
    from sparserob_core.control.transcription.record import Transcription
    from sparserob_core.experiment.config.run_config import Entry


@dataclass(frozen=True, eq=False)
class Experiment(ABC):
    """An experiment that was built from a config: a transcribed control problem, or a semi-infinite program."""

    loaded: Loaded

    @property
    @abstractmethod
    def program(self) -> SemiInfiniteProgram:
        """The semi-infinite program."""

    @abstractmethod
    def of_control(self, expected: str) -> ControlExperiment:
        """Return the experiment itself where it is a control problem.

        Raises `InputError` for any other program; ``expected`` is the beginning of its message.
        """

    @property
    def model(self) -> Transcription | None:
        """The transcription of the control problem; ``None`` for a program of another kind."""
        return None

    @property
    def problem(self) -> OptimalControlProblem | None:
        """The control problem; ``None`` for a program of another kind."""
        return None

    @property
    def gap_tolerance(self) -> float | None:
        """The relative gap that the config's method has to close; ``None`` for a method that has no such option."""
        return gap_tolerance(self.loaded)

    @property
    def title(self) -> str:
        """The title of the config or, where it has none, its name."""
        return self.loaded.config.title or name_of(self.loaded)


@final
@dataclass(frozen=True, eq=False)
class ControlExperiment(Experiment):
    """A control problem with its transcription."""

    transcription: Transcription

    @property
    def program(self) -> SemiInfiniteProgram:
        return self.transcription.program

    def of_control(self, expected: str) -> ControlExperiment:
        return self

    @property
    def model(self) -> Transcription:
        return self.transcription

    @property
    def problem(self) -> OptimalControlProblem:
        return self.transcription.problem

    @property
    def control(self) -> Dictionary:
        """The dictionary of the control."""
        return self.transcription.control

    @property
    def disturbance(self) -> Dictionary:
        """The dictionary of the disturbance."""
        return self.transcription.disturbance


@final
@dataclass(frozen=True, eq=False)
class PlainExperiment(Experiment):
    """A semi-infinite program that is no control problem."""

    given: SemiInfiniteProgram

    @property
    def program(self) -> SemiInfiniteProgram:
        return self.given

    def of_control(self, expected: str) -> ControlExperiment:
        raise InputError(f"{expected}, got a semi-infinite program of another kind")


@final
@dataclass(frozen=True, eq=False)
class UntranscribedExperiment(Experiment):
    """A control problem that was not transcribed in time; ``reason`` says so.

    Its program has no constraints. The only known fact is that no term of its cost is negative.
    """

    given: OptimalControlProblem
    reason: str

    @property
    def program(self) -> SemiInfiniteProgram:
        return SemiInfiniteProgram(n=1, q=[0.0], lower=0.0, upper=0.0, families=[])

    @property
    def problem(self) -> OptimalControlProblem:
        return self.given

    def of_control(self, expected: str) -> ControlExperiment:
        raise TimeLimitError(self.reason)


LATE = (
    "{} while the problem was transcribed, before anything is known of it; fewer pieces and parameters take less, or"
    " limits.seconds gives more"
)


@contextmanager
def transcribed_by(deadline: Deadline) -> Iterator[None]:
    """Raise `TimeLimitError` where the transcription inside the context is not finished at the ``deadline``."""
    try:
        with deadline.enforced():
            yield
    except OutOfTime as late:
        raise TimeLimitError(LATE.format(late)) from late


def assemble(loaded: Loaded, deadline: Deadline | None = None) -> Experiment:
    """Build the experiment that a checked config describes, with its program.

    Parameters
    ----------
    loaded : Loaded
        The checked config.
    deadline : Deadline, optional
        The time by which the transcription must be finished; none unless given.

    Returns
    -------
    Experiment
        A control problem with its transcription, or a semi-infinite program.

    Raises
    ------
    ConfigError
        If a key is at fault; the error names its place.
    TimeLimitError
        If the transcription is not finished at the ``deadline``.
    """
    experiment = assemble_in_time(loaded, deadline or Deadline())
    if isinstance(experiment, UntranscribedExperiment):
        raise TimeLimitError(experiment.reason)
    return experiment


def assemble_in_time(loaded: Loaded, deadline: Deadline) -> Experiment:
    """Build the experiment of a config, or an `UntranscribedExperiment` where the ``deadline`` comes first.

    Raises `ConfigError` with the place of the key at fault. Raises `TimeLimitError` where the ``deadline`` comes before
    the problem itself is built.
    """
    with transcribed_by(deadline):
        problem = problem_of(loaded)
    if isinstance(problem, SemiInfiniteProgram):
        return PlainExperiment(loaded, problem)
    try:
        with deadline.enforced():
            return _transcribe(loaded, problem)
    except OutOfTime as error:
        return UntranscribedExperiment(loaded, problem, LATE.format(error))


def _transcribe(loaded: Loaded, problem: OptimalControlProblem) -> Experiment:
    from sparserob_core.control.transcription.transcribe import prepare

    policy: Policy = build(loaded, "policy", loaded.config.policy)
    control, disturbance = dictionaries_of(loaded, problem.horizon)
    try:
        return ControlExperiment(loaded, prepare(problem, control, disturbance, policy=policy))
    except InputError as error:
        raise loaded.located(() if error.path[:1] == ("policy",) else ("problem",), error) from error


def problem_of(loaded: Loaded) -> OptimalControlProblem | SemiInfiniteProgram:
    """Return the control problem, or the semi-infinite program, that a checked config describes.

    Raises `ConfigError` with the place of the key at fault.
    """
    try:
        problem: OptimalControlProblem | SemiInfiniteProgram = build(loaded, "problem", loaded.config.problem).build()
    except InputError as error:
        raise loaded.located(("problem",), error) from error
    return problem


def control_problem_of(loaded: Loaded, expected: str) -> OptimalControlProblem:
    """Return the control problem that a checked config describes.

    Raises `InputError` where the config describes another program; ``expected`` is the beginning of its message.
    """
    problem = problem_of(loaded)
    if isinstance(problem, SemiInfiniteProgram):
        raise InputError(f"{expected}, got a semi-infinite program of another kind")
    return problem


def dictionaries_of(loaded: Loaded, horizon: float) -> tuple[Dictionary, Dictionary]:
    """Return the dictionaries of control and disturbance of a checked config, in this order.

    The dictionary of the disturbance has one indicator function on each piece of the control where the config names
    none. Raises `ConfigError` with the place of the key at fault.
    """
    control = _build_dictionary(loaded, "control", loaded.config.dictionaries.control, horizon)
    entry = loaded.config.dictionaries.disturbance
    if entry is not None:
        return control, _build_dictionary(loaded, "disturbance", entry, horizon)
    from sparserob_core.experiment.solve import indicators

    return control, indicators(control)


def gap_tolerance(loaded: Loaded) -> float | None:
    """Return the relative gap that the config's method has to close; ``None`` for a method that has no such option."""
    entry = loaded.config.method
    tolerance = getattr(loaded.registry.build("method", entry.name, entry.options), "tolerance", None)
    return None if tolerance is None else float(tolerance)


def counting(loaded: Loaded) -> tuple[bool, tuple[float, ...] | None]:
    """Return how the config's method counts the cost, and which values it leaves to the control.

    A method that is not registered gives ``(False, None)``. This happens where somebody else's run directory is read.

    Returns
    -------
    counts : bool
        Whether the cost is the time during which the control acts.
    letters : tuple of float or None
        The only values that the control may take; ``None`` where the method does not restrict them.
    """
    entry = loaded.config.method
    if entry.name not in loaded.registry.names("method"):
        return False, None
    method = loaded.registry.build("method", entry.name, entry.options)
    letters = getattr(method, "alphabet", None)
    return bool(getattr(method, "counts", False)), None if letters is None else tuple(letters)


def name_of(loaded: Loaded) -> str:
    """Return the name of an experiment: that of its file, without the ending."""
    return Path(loaded.source.name).stem


def build(loaded: Loaded, kind: str, entry: Entry) -> Any:
    """Return the component of a ``kind`` that an ``entry`` of the config names, wrapped in the checks of its kind."""
    component = loaded.registry.build(kind, entry.name, entry.options)
    return guarded(component, loaded.registry.get(kind, entry.name).origin)


def _build_dictionary(loaded: Loaded, which: str, entry: Entry, horizon: float) -> Dictionary:
    try:
        dictionary: Dictionary = build(loaded, "dictionary", entry).build(horizon)
    except InputError as error:
        raise loaded.located(("dictionaries", which), error) from error
    return dictionary


@final
@dataclass(frozen=True)
class Anew:
    """A function that builds the program of a resolved config once more, for workers.

    It returns the program in its own units, its solver and its regulariser. ``config`` is the JSON text of the config.
    """

    config: str

    @staticmethod
    def of(loaded: Loaded) -> Anew:
        """Return the function that builds the program of a config."""
        plain = {**loaded.config.plain(), "executor": {"name": "serial"}, "observers": []}
        return Anew(json.dumps(plain))

    def __call__(self) -> tuple[SemiInfiniteProgram, Solver, Regulariser | None]:
        loaded = load_config(json.loads(self.config))
        program, tools = assemble(loaded).program, tools_of(loaded)
        own = program.own_units
        return program if own is None else own.program, tools.solver, tools.regulariser


def solver_of(loaded: Loaded) -> Solver:
    """Return the solver of a checked config.

    A solver that is named is asked for every program; `Auto` answers those that it does not solve.
    """
    name = loaded.config.solver.name
    try:
        solver: Solver = build(loaded, "solver", loaded.config.solver)
    except InputError as error:
        raise loaded.located(("solver",), error) from error
    return solver if isinstance(solver, Auto) else named(solver, name, loaded.registry.build("solver", AUTO))


def tools_of(loaded: Loaded) -> Tools:
    """Return the components and numbers that a method works with."""
    config = loaded.config
    return Tools(
        solver=solver_of(loaded),
        maximiser=build(loaded, "maximiser", config.maximiser),
        regulariser=None if config.regulariser is None else build(loaded, "regulariser", config.regulariser),
        continuation=config.continuation,
        budget=config.maximiser.budget,
        polish=config.maximiser.polish,
        rng=np.random.default_rng(config.seed),
        deadline=Deadline(config.limits.seconds),
    )
