"""A study that was run: its table, and the outcome of every point."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from shlex import quote
from typing import Any, final, overload

from sparserob_core.brief import brief
from sparserob_core.errors import InputError
from sparserob_core.experiment.assemble import assemble
from sparserob_core.experiment.config.load import load_config
from sparserob_core.experiment.config.plain import value_text
from sparserob_core.experiment.directory.finished import stored_run
from sparserob_core.experiment.run.outcome import Outcome
from sparserob_core.experiment.run.replay import stored_result
from sparserob_core.experiment.sweep.axes import Axis
from sparserob_core.experiment.sweep.plan import FILE, Arrangement, read_plan
from sparserob_core.experiment.sweep.table import Row, read_table, shared_unit

RUNS = "runs"
COLUMNS = ("status", "cost", "relative gap", "active", "seconds")  # columns on a terminal, after those of the axes
MAX_TABLE_ROWS = 50  # largest number of rows of a table on a terminal
MAX_NAMED_FAILURES = 5  # largest number of failures that are reported one by one


@final
@dataclass(frozen=True, eq=False)
class Study:
    """A study that was run.

    Parameters
    ----------
    directory : Path
        Its directory.
    title : str
        Its title.
    axes : sequence of Axis
        Its axes.
    table : list of dict
        One row for every point that has an answer or an error: the keys of the axes, then the entries of
        ``result.json``, with ``None`` where nothing is known. ``pandas.DataFrame(study.table)`` makes a data frame.
    points : int
        The number of all points.
    arrangement : {"grid", "zip", "random", "sobol"}, default "grid"
        The choice of the points.
    stopped : str, default ""
        The reason why some points have no row.
    remarks : sequence of str, default ()
        Warnings.
    """

    directory: Path
    title: str
    axes: Sequence[Axis] = field(repr=False)
    table: list[Row] = field(repr=False)
    points: int
    arrangement: Arrangement = "grid"
    stopped: str = ""
    remarks: Sequence[str] = ()

    __repr__ = brief

    @property
    def outcomes(self) -> Outcomes:
        """The outcome of every row; it is read from its run directory, and its problem is built, when it is
        asked for."""
        return Outcomes(self.directory, self.table)

    @property
    def failed(self) -> int:
        """The number of points without a checked answer."""
        return sum(row["status"] == "failed" for row in self.table)

    @property
    def counts(self) -> Mapping[str, int]:
        """The number of points with each status."""
        return Counter(str(row["status"]) for row in self.table)

    @property
    def cost_unit(self) -> str:
        """The unit of the costs, where it is known and the same for all."""
        return shared_unit(self.table)

    def summary(self) -> dict[str, Any]:
        """Return the study in a few numbers, as plain data."""
        return {
            "title": self.title,
            "directory": str(self.directory),
            "axes": [axis.key for axis in self.axes],
            "points": self.points,
            "counts": dict(self.counts),
            "stopped": self.stopped,
            "remarks": list(self.remarks),
        }


def shown(study: Study) -> tuple[list[str], list[list[str]]]:
    """Return the table for a terminal: names of the columns, and one row per point, or one per status where there are
    many."""
    unit = f" [{study.cost_unit}]" if study.cost_unit else ""
    if len(study.table) > MAX_TABLE_ROWS:
        return _summarise_by_status(study.table, unit)
    keys = [axis.key for axis in study.axes]
    columns = [name + unit if name == "cost" else name for name in COLUMNS]
    return [*keys, *columns], [[*(value_text(row[key]) for key in keys), *short(row)] for row in study.table]


def short(row: Mapping[str, Any]) -> list[str]:
    """Return the columns of a point on a terminal: status, cost, gap, share of time active, seconds."""
    return [
        str(row["status"]),
        _format_number(row.get("cost"), ".9g"),
        _format_number(row.get("gap"), ".1e"),
        _format_number(row.get("sparsity.active_fraction"), ".1%"),
        _format_number(row.get("seconds"), ".2f"),
    ]


def remarks_of(study: Study) -> Iterator[str]:
    """Yield the notes below the table."""
    counts = ", ".join(f"{count} {status}" for status, count in sorted(study.counts.items()))
    yield f"{len(study.table)} of {study.points} points: {counts or 'none yet'}"
    failed = [row for row in study.table if row["status"] == "failed"]
    for row in failed[:MAX_NAMED_FAILURES]:
        values = ", ".join(f"{axis.key}={value_text(row[axis.key])}" for axis in study.axes)
        yield f"failed: {f'{values}: ' if values else ''}{row.get('message')}"
    if len(failed) > MAX_NAMED_FAILURES:
        yield f"and {len(failed) - MAX_NAMED_FAILURES} more that failed; the column message says why"
    cut = sum(bool(row.get("stopped")) for row in study.table)
    if cut:
        yield f"{cut} ended at a time limit; they run again when the study is resumed"
    yield from study.remarks
    if study.stopped:
        yield f"{study.stopped}; what is left: sparserob sweep --resume {quote(str(study.directory))}"


def _summarise_by_status(table: Sequence[Row], unit: str) -> tuple[list[str], list[list[str]]]:
    rows = []
    for status in sorted({str(row["status"]) for row in table}):
        rows_of_status = [row for row in table if row["status"] == status]
        costs = [row["cost"] for row in rows_of_status if row.get("cost") is not None]
        seconds = sum(row.get("seconds") or 0.0 for row in rows_of_status)
        smallest, largest = (_format_number(pick(costs), ".9g") if costs else "-" for pick in (min, max))
        rows.append([status, str(len(rows_of_status)), smallest, largest, f"{seconds:.2f}"])
    return ["status", "points", f"least cost{unit}", f"largest cost{unit}", "seconds"], rows


def _format_number(value: Any, form: str) -> str:
    return "-" if value is None else format(value, form)


@final
class Outcomes(Sequence[Outcome]):
    """The outcomes of a study, one for each row of its table.

    The outcome of a point without a run raises `InputError` with the reason.
    """

    def __init__(self, directory: Path, table: Sequence[Row]) -> None:
        self._directory, self._table = directory, table

    def __len__(self) -> int:
        return len(self._table)

    @overload
    def __getitem__(self, position: int) -> Outcome: ...

    @overload
    def __getitem__(self, position: slice) -> Sequence[Outcome]: ...

    def __getitem__(self, position: int | slice) -> Outcome | Sequence[Outcome]:
        if isinstance(position, slice):
            return Outcomes(self._directory, self._table[position])
        row = self._table[position]
        return read_outcome(self._directory / RUNS / str(row["run"]), str(row.get("message") or ""))

    def __iter__(self) -> Iterator[Outcome]:
        return (self[position] for position in range(len(self)))


def read_outcome(directory: Path, failure: str = "") -> Outcome:
    """Return the outcome of a run, from its directory; the plugin files that its config names are loaded.

    ``failure`` is the reason where there is no run, for the `InputError`.
    """
    if not directory.is_dir() and failure:
        raise InputError(f"{directory.name}: there is no outcome: {failure}")
    run = stored_run(directory)
    experiment = assemble(load_config(directory / "config.yaml"))
    return Outcome(stored_result(run), directory, experiment, run.solution.get("control"), run.summary)


def read_study(directory: str | Path) -> Study:
    """Return the study in a directory, as data; raises `InputError` where there is none, or it cannot be understood."""
    path = Path(directory)
    if not (path / FILE).is_file():
        raise InputError(f"{path}: expected the directory of a study, got one without {FILE}")
    plan, table = read_plan(path / FILE), read_table(path)
    for axis in plan.axes:
        if table and axis.key not in table[0]:
            raise InputError(f"{path / 'table.csv'}: expected a column for the axis {axis.key}, got none")
    return Study(path, str(plan.base.data.get("title") or plan.name), plan.axes, table, len(plan.values()), plan.points)
