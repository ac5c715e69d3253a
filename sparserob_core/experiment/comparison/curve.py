"""Curve of a stored run: its best lower bound against the evaluations and the seconds that the bound took."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, final

import numpy as np

from sparserob_core.errors import ConfigError, InputError
from sparserob_core.experiment.config.matrices.arrays import read_arrays
from sparserob_core.experiment.config.reading.reader import read_source
from sparserob_core.experiment.directory.finished import stored_run
from sparserob_core.sip.convex_set import Array
from sparserob_core.sip.result import relative_gap

WITHOUT_CURVE = frozenset({"failed", "infeasible"})
SEARCH, ROUNDS = (
    ("evaluations.npz", ("bound", "seconds")),
    ("trace.npz", ("lower_bound", "seconds", "relaxed_programs")),
)


@final
@dataclass(frozen=True, eq=False, kw_only=True)
class Curve:
    """A run. ``bound (n,)`` is the best lower bound of the semi-infinite program proven after ``evaluations (n,)`` and
    ``seconds (n,)``; all three are empty for a run that failed, has not finished, or is infeasible.

    For a run that searches (``searched``) an evaluation is a value of g, and the entries are those at which the bound
    rose; for any other it is a relaxed program, and the entries are the rounds. Numbers that the run does not know are
    nan. ``measured``: the unit of the worst ``violation``, ``cost_unit`` that of the cost and its bounds, where they
    are known.
    """

    directory: Path
    config: Mapping[str, Any] = field(repr=False)
    title: str
    status: str
    message: str
    searched: bool
    evaluations: Array
    seconds: Array
    bound: Array
    lower_bound: float
    upper_bound: float
    gap: float
    cost: float
    violation: float
    measured: str
    all_evaluations: float
    all_seconds: float
    dimension: int = 0
    """Coordinates of what is searched, or variables of a decision; 0: it is not known."""
    counts: bool = False
    """Whether its cost is the time that the control acts."""
    cost_unit: str = ""

    def find_seconds(self, target: float) -> float:
        """The seconds after which the bound was at least ``target``; infinite when it never was."""
        return spent_until(target, self.bound, self.seconds)

    def find_evaluations(self, target: float) -> float:
        """The evaluations after which the bound was at least ``target``; infinite when it never was."""
        return spent_until(target, self.bound, self.evaluations)


def spent_until(target: float, best: Array, spent: Array) -> float:
    """Return the effort that was spent when the best value so far ``(n,)`` reached a target; infinite where it never
    did.

    Parameters
    ----------
    target : float
        Value to be reached.
    best : array, (n,)
        Best value so far at each step.
    spent : array, (n,)
        Effort until each step, such as evaluations or seconds.
    """
    indices = np.flatnonzero(best >= target)
    return float(spent[indices[0]]) if indices.size else np.inf


def read_curve(directory: Path) -> Curve:
    """Read a run directory; raises `InputError` when it is none, or a file of it cannot be understood."""
    summary, config = stored_run(directory).summary, _read_config(directory / "config.yaml")
    counts, worst, units = (_get_mapping(summary, key) for key in ("counts", "worst", "units"))
    status, searched = str(summary["status"]), (directory / SEARCH[0]).is_file()
    spent, lower = (
        _get_number(counts, "evaluations" if searched else "relaxed_programs"),
        _get_number(summary, "lower_bound"),
    )
    seconds, upper = _get_number(summary, "seconds"), _get_number(summary, "upper_bound")
    evaluations, times, bound = _read_points(directory, searched) if status not in WITHOUT_CURVE else (np.empty(0),) * 3
    if bound.size and lower > bound[-1]:  # the last relaxed program came after the last evaluation
        evaluations, times, bound = np.append(evaluations, spent), np.append(times, seconds), np.append(bound, lower)
    return Curve(
        directory=directory,
        config=config,
        title=str(summary.get("title") or ""),
        status=status,
        message=str(summary.get("message") or ""),
        searched=searched,
        evaluations=evaluations,
        seconds=times,
        bound=bound,
        lower_bound=lower,
        upper_bound=upper,
        gap=relative_gap(lower, upper, summary.get("cost_scale") or 0.0),
        cost=_get_number(summary, "cost"),
        violation=_get_number(worst, "violation"),
        measured=str(units.get("worst") or ""),
        cost_unit=str(units.get("cost") or ""),
        all_evaluations=spent,
        all_seconds=seconds,
        dimension=_read_dimension(directory, searched) if status not in WITHOUT_CURVE else 0,
        counts="J" in summary,
    )


def _read_dimension(directory: Path, searched: bool) -> int:
    """The last dimension of the points that were searched, or else of the decision."""
    for name, column in (("evaluations.npz", "points"), ("solution.npz", "decision"))[0 if searched else 1 :]:
        if (directory / name).is_file() and (array := read_arrays(directory / name).get(column)) is not None:
            return int(array.shape[-1]) if array.ndim else 0
    return 0


def _read_points(directory: Path, searched: bool) -> tuple[Array, Array, Array]:
    name, columns = SEARCH if searched else ROUNDS
    bound, seconds, *counted = _read_columns(directory / name, columns)
    evaluations = counted[0] if counted else np.arange(1.0, bound.size + 1)
    best = np.maximum.accumulate(bound) if bound.size else bound
    kept = np.isfinite(best)
    if searched:
        kept &= np.diff(best, prepend=-np.inf) > 0
    return evaluations[kept], seconds[kept], best[kept]


def _read_columns(file: Path, names: tuple[str, ...]) -> list[Array]:
    if not file.is_file():
        raise InputError(f"{file}: there is no such file; expected one, for the run has finished")
    stored = read_arrays(file)
    missing = [name for name in names if name not in stored or stored[name].dtype.kind not in "fiu"]
    if missing:
        raise InputError(f"{file}: expected {', '.join(names)} as columns of numbers, got no {', '.join(missing)}")
    columns = [np.asarray(stored[name], dtype=float) for name in names]
    if any(column.shape != columns[0].shape or column.ndim != 1 or np.isnan(column).any() for column in columns):
        raise InputError(f"{file}: expected {', '.join(names)} as columns of one length without nan")
    return columns


def _read_config(file: Path) -> dict[str, Any]:
    data = read_source(file).data
    for section in ("problem", "method", "maximiser"):
        if not isinstance(data.get(section), Mapping) or "name" not in data[section]:
            raise ConfigError(f"{file}: {section}: expected a mapping with a name, as in the resolved config of a run")
    return data


def _get_mapping(data: Mapping[str, Any], key: str) -> Mapping[str, Any]:
    entry = data.get(key)
    return entry if isinstance(entry, Mapping) else {}


def _get_number(data: Mapping[str, Any], key: str) -> float:
    value = data.get(key)
    return float(value) if isinstance(value, int | float) else np.nan
