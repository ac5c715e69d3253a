"""Inputs of a study: files, mappings and run directories, or problems, results and outcomes from Python.

This is the only module that turns problems, results and outcomes into configs and run directories.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any, TypeAlias

from sparserob_core.control.problem.problem import OptimalControlProblem
from sparserob_core.errors import InputError
from sparserob_core.experiment.assemble import Experiment
from sparserob_core.experiment.config.load import Loaded
from sparserob_core.experiment.config.reading.reader import ConfigSource
from sparserob_core.experiment.config.writing.source import source_of
from sparserob_core.experiment.directory.finished import read_config
from sparserob_core.experiment.run.outcome import Outcome, SolvedProblem

GivenRun: TypeAlias = str | Path | Outcome | SolvedProblem
GivenConfig: TypeAlias = str | Path | Mapping[str, Any] | ConfigSource | OptimalControlProblem | Outcome | SolvedProblem


def as_run(run: object) -> tuple[Path, Experiment | None]:
    """Return the directory of a run and, where it is in memory, its experiment.

    Parameters
    ----------
    run : str, Path, Outcome or SolvedProblem
        The directory of a run, an outcome of `run`, or a result of `solve` for a problem. A result that was not saved
        is written into a temporary directory.

    Returns
    -------
    directory : Path
        The run directory.
    experiment : Experiment or None
        The experiment; ``None`` where only a directory was given.

    Raises
    ------
    InputError
        If ``run`` is anything else.
    """
    if isinstance(run, Outcome | SolvedProblem):
        return run.directory, run.experiment
    if isinstance(run, str | Path):
        return Path(run), None
    raise InputError(
        "run: expected the directory of a run, or what sr.run, or sr.solve for a problem, returned, got"
        f" {type(run).__name__}"
    )


def as_config(config: object) -> str | Path | Mapping[str, Any] | ConfigSource:
    """Return the config of anything that describes an experiment, in a form that `load_config` reads.

    Parameters
    ----------
    config : str, Path, mapping, Source, OptimalControlProblem, Outcome or SolvedProblem
        Files and mappings are returned as they are. A problem becomes a config that describes it. A run, its result or
        its directory gives the config of that run.

    Returns
    -------
    str, Path, mapping or Source
        The config.

    Raises
    ------
    InputError
        If ``config`` is anything else, or a problem that no config can describe.

    Notes
    -----
    A run directory is data: no plugin file that its config names is loaded.
    """
    if isinstance(config, OptimalControlProblem):
        return source_of(config)
    if isinstance(config, Outcome | SolvedProblem):
        return _make_source(config.experiment.loaded)
    if isinstance(config, str | Path):
        path = Path(config)
        return _make_source(read_config(path), files=False) if (path / "config.yaml").is_file() else config
    if isinstance(config, Mapping | ConfigSource):
        return config
    raise InputError(
        "config: expected a config, an OptimalControlProblem, the directory of a run, or what sr.run, or sr.solve for a"
        f" problem, returned, got {type(config).__name__}"
    )


def _make_source(loaded: Loaded, files: bool = True) -> ConfigSource:
    plain = loaded.config.plain()
    return ConfigSource(loaded.source.name, loaded.source.folder, plain if files else {**plain, "plugins": []})
