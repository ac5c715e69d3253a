"""From a checked config to the records that it describes: the problem, its dictionaries, the program, the tools."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, final

import numpy as np

from sparserob_core.control.problem.dictionary import Dictionary
from sparserob_core.control.problem.problem import OptimalControlProblem
from sparserob_core.errors import InputError
from sparserob_core.experiment.config.load import Loaded
from sparserob_core.experiment.solve import indicators
from sparserob_core.sip.method import Tools
from sparserob_core.sip.program import SemiInfiniteProgram

if TYPE_CHECKING:
    from sparserob_core.experiment.config.run_config import Entry


@final
@dataclass(frozen=True, eq=False)
class Described:
    """The records that a config describes: a control problem and its two dictionaries, or a program that was ``stated``
    as it is."""

    loaded: Loaded
    problem: OptimalControlProblem | None = None
    control: Dictionary | None = None
    disturbance: Dictionary | None = None
    stated: SemiInfiniteProgram | None = None


@final
@dataclass(frozen=True, eq=False)
class Experiment:
    """What a config describes, built: the program, and for a control problem the problem itself and its two
    dictionaries."""

    loaded: Loaded
    program: SemiInfiniteProgram
    problem: OptimalControlProblem | None = None
    control: Dictionary | None = None
    disturbance: Dictionary | None = None

    @property
    def gap_tolerance(self) -> float | None:
        """The relative gap that the config's method is to close; ``None`` for a method that has no such option."""
        return gap_tolerance(self.loaded)

    @property
    def title(self) -> str:
        """The title, or else the name of the config."""
        return self.loaded.config.title or name_of(self.loaded)


def described(loaded: Loaded) -> Described:
    """Build the problem and the dictionaries of a checked config; raises `ConfigError` with the place of the key at
    fault."""
    config = loaded.config
    try:
        problem = build(loaded, "problem", config.problem).build()
    except InputError as error:
        raise loaded.located(("problem",), error) from error
    if isinstance(problem, SemiInfiniteProgram):
        return Described(loaded, stated=problem)
    control = _dictionary(loaded, "control", config.dictionaries.control, problem.horizon)
    entry = config.dictionaries.disturbance
    disturbance = indicators(control) if entry is None else _dictionary(loaded, "disturbance", entry, problem.horizon)
    return Described(loaded, problem, control, disturbance)


def assemble(loaded: Loaded) -> Experiment:
    """Build what a checked config describes, and its program; raises `ConfigError` with the place of the key at
    fault."""
    from sparserob_core.control.transcription.transcribe import transcribe

    parts = described(loaded)
    if parts.stated is not None:
        return Experiment(loaded, parts.stated)
    assert parts.problem is not None and parts.control is not None
    try:
        program = transcribe(parts.problem, control=parts.control, disturbance=parts.disturbance)
    except InputError as error:
        raise loaded.located(("problem",), error) from error
    return Experiment(loaded, program, parts.problem, parts.control, parts.disturbance)


def gap_tolerance(loaded: Loaded) -> float | None:
    """The relative gap that the config's method is to close; ``None`` for a method that has no such option."""
    tolerance = getattr(build(loaded, "method", loaded.config.method), "tolerance", None)
    return None if tolerance is None else float(tolerance)


def name_of(loaded: Loaded) -> str:
    """The name of an experiment: its file's, without the ending."""
    return Path(loaded.source.name).stem


def build(loaded: Loaded, kind: str, entry: Entry) -> Any:
    """The component that an entry of the config names."""
    return loaded.registry.build(kind, entry.name, entry.options)


def _dictionary(loaded: Loaded, which: str, entry: Entry, horizon: float) -> Dictionary:
    try:
        dictionary: Dictionary = build(loaded, "dictionary", entry).build(horizon)
    except InputError as error:
        raise loaded.located(("dictionaries", which), error) from error
    return dictionary


def tools_of(loaded: Loaded) -> Tools:
    """The components and numbers that a method works with."""
    config = loaded.config
    return Tools(
        solver=build(loaded, "solver", config.solver),
        maximiser=build(loaded, "maximiser", config.maximiser),
        regulariser=None if config.regulariser is None else build(loaded, "regulariser", config.regulariser),
        continuation=config.continuation,
        budget=config.maximiser.budget,
        polish=config.maximiser.polish,
        rng=np.random.default_rng(config.seed),
    )
