"""A finished run, read back from its directory: the experiment built again, and the control that was returned."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, final
from zipfile import BadZipFile

import numpy as np

from sparserob_core.errors import InputError
from sparserob_core.sip.convex_set import Array

if TYPE_CHECKING:
    from sparserob_core.experiment.assemble import Experiment


UNFINISHED = "the run has not finished"


@final
@dataclass(frozen=True, eq=False)
class FinishedRun:
    """A run directory: its ``experiment``, the decision ``theta (m, N)``, ``summary`` (``result.json``) and
    ``solution`` (``solution.npz``)."""

    directory: Path
    experiment: Experiment
    theta: Array
    summary: Mapping[str, Any]
    solution: Mapping[str, Array]


def read_finished(directory: Path) -> FinishedRun:
    """Read a run directory; raises `InputError` when it is none, holds no control, or a file of it cannot be
    understood."""
    from sparserob_core.experiment.assemble import assemble
    from sparserob_core.experiment.config.load import load_config

    for name in ("config.yaml", "result.json"):
        if not (directory / name).is_file():
            raise InputError(f"{directory}: expected the directory of a run, got {_instead(directory, name)}")
    summary = read_summary(directory / "result.json")
    solution = read_arrays(directory / "solution.npz")
    if "theta" not in solution:
        raise InputError(
            f"{directory}: there is no control in it; the status is '{summary['status']}': {summary.get('message')}"
        )
    experiment = assemble(load_config(directory / "config.yaml"))
    if experiment.problem is None or experiment.control is None:
        raise InputError(
            f"{directory}: expected the run of a control problem, got one of another semi-infinite program"
        )
    theta, shape = solution["theta"], (experiment.problem.system.controls, experiment.control.functions)
    if theta.shape != shape or theta.dtype.kind != "f" or not np.isfinite(theta).all():
        raise InputError(
            f"{directory / 'solution.npz'}: theta: expected finite numbers of shape {shape}, as config.yaml says, "
            f"got {theta.dtype} of shape {theta.shape}" + ("" if theta.shape != shape else " that are not all finite")
        )
    return FinishedRun(directory, experiment, theta, summary, solution)


def read_arrays(file: Path) -> dict[str, Array]:
    """The arrays of an ``.npz`` file, none when there is no such file; raises `InputError` when it cannot be read."""
    if not file.is_file():
        return {}
    try:
        with np.load(file, allow_pickle=False) as stored:
            return {name: stored[name] for name in stored.files}
    except (OSError, ValueError, KeyError, EOFError, BadZipFile, AttributeError) as error:
        raise InputError(f"{file}: cannot be read: {error}") from None


def read_summary(file: Path) -> dict[str, Any]:
    """The contents of ``result.json``; raises `InputError` when it is not the result of a run."""
    try:
        summary = json.loads(file.read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise InputError(f"{file}: cannot be read: {error}") from None
    if not isinstance(summary, dict) or "status" not in summary:
        raise InputError(f"{file}: expected the result of a run, with a status")
    return summary


def _instead(directory: Path, missing: str) -> str:
    return f"one without {missing}" if directory.is_dir() else "a file" if directory.exists() else "nothing"
