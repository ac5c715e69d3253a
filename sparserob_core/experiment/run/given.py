"""What a study of a run or of a problem may be given: files, mappings and directories, or what Python has in hand.

The one place that turns problems, results and outcomes into configs and run directories."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any, TypeAlias

from sparserob_core.control.problem.problem import OptimalControlProblem
from sparserob_core.errors import InputError
from sparserob_core.experiment.assemble import Experiment
from sparserob_core.experiment.config.load import Loaded
from sparserob_core.experiment.config.reading.reader import Source
from sparserob_core.experiment.config.stated.source import source_of
from sparserob_core.experiment.directory.finished import read_config
from sparserob_core.experiment.run.outcome import Outcome, SolvedProblem

GivenRun: TypeAlias = str | Path | Outcome | SolvedProblem
GivenConfig: TypeAlias = str | Path | Mapping[str, Any] | Source | OptimalControlProblem | Outcome | SolvedProblem


def as_run(run: object) -> tuple[Path, Experiment | None]:
    """The directory of a run, and its experiment where that is at hand: of a directory, of what ``sr.run`` returned, or
    of what ``sr.solve`` returned for a problem, which is written into a temporary directory unless it was saved.

    Raises `InputError` for anything else."""
    if isinstance(run, Outcome | SolvedProblem):
        return run.directory, run.experiment
    if isinstance(run, str | Path):
        return Path(run), None
    raise InputError(
        "run: expected the directory of a run, or what sr.run, or sr.solve for a problem, returned, got"
        f" {type(run).__name__}"
    )


def as_config(config: object) -> str | Path | Mapping[str, Any] | Source:
    """What `load_config` reads: files and mappings as they are, a problem as the config that states it, and of a run,
    its result or its directory the config that it is of, which is data: no plugin file that it names is loaded.

    Raises `InputError` for anything else, and for a problem that no config can say."""
    if isinstance(config, OptimalControlProblem):
        return source_of(config)
    if isinstance(config, Outcome | SolvedProblem):
        return _stated(config.experiment.loaded)
    if isinstance(config, str | Path):
        path = Path(config)
        return _stated(read_config(path), files=False) if (path / "config.yaml").is_file() else config
    if isinstance(config, Mapping | Source):
        return config
    raise InputError(
        "config: expected a config, an OptimalControlProblem, the directory of a run, or what sr.run, or sr.solve for a"
        f" problem, returned, got {type(config).__name__}"
    )


def _stated(loaded: Loaded, files: bool = True) -> Source:
    plain = loaded.config.plain()
    return Source(loaded.source.name, loaded.source.folder, plain if files else {**plain, "plugins": []})
