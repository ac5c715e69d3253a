"""The table of a study as a file that any program can read.

It has one row for every point: the axes, then the entries of ``result.json``.
"""

from __future__ import annotations

import csv
import io
import json
import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from sparserob_core.errors import InputError
from sparserob_core.quantities import statistics
from sparserob_core.sip.result import Result

TABLE, COLUMNS = "table.csv", "columns.csv"
Row = dict[str, Any]
LAST = ("stopped", "message", "run", "hash", "seconds")
"""Columns at the end; ``seconds`` is the last one, as no other column differs when a study is repeated."""
FIRST = (
    "worst.violation",
    "worst.constraint",
    "worst.time",
    "sparsity.active_fraction",
    "sparsity.switches",
    "sparsity.channels",
    "sparsity.fewest_active.lower",
    "sparsity.fewest_active.upper",
)
"""Columns that every run has, after the statistics of a result."""
LEFT = frozenset({"title", "versions", "provenance", "config", "tolerances", "units", "worst.parameter", "seed"})
MEANING = {
    "worst.violation": ("constraint", "by how much the worst constraint is exceeded; negative: a margin"),
    "worst.constraint": ("", "which constraint that is"),
    "worst.time": ("time", "when"),
    "sparsity.active_fraction": ("1", "share of the time at which the control acts, in at least one channel"),
    "sparsity.switches": ("1", "how often it switches"),
    "sparsity.channels": ("1", "number of channels, over which the least shares are the mean"),
    "sparsity.fewest_active.lower": ("1", "share of the time that every admissible control acts at least"),
    "sparsity.fewest_active.upper": ("1", "share of the time for which some admissible control acts"),
    "units.cost": ("", "what the cost and its bounds are measured in, where the names of the config tell"),
    "units.worst": ("", "what the worst violation is measured in, where the names of the config tell"),
    "units.time": ("", "what times are measured in, where the names of the config tell"),
    "run": ("", "the run's directory below runs"),
    "hash": ("", "SHA-256 of the run's config, without where it was solved, who watched, its title and its limits"),
}
"""Unit and meaning of the other columns. ``cost``, ``constraint`` and ``time`` stand for the units of the config; the
columns of `UNITS` have those that it names."""
TEXTS = {name for name, (unit, _) in MEANING.items() if not unit}
TEXTS |= {name for name, entry in statistics(Result).items() if not entry.unit}
"""Columns that are text, whatever it looks like."""
UNITS = {"cost": "units.cost", "constraint": "units.worst", "time": "units.time"}
TIMES = frozenset({"horizon", "from", "to", "delay", "latency"})
"""Keys whose values are times, anywhere in a config's problem."""


def row_of(axes: Mapping[str, Any], summary: Mapping[str, Any] | None, run: str, digest: str, said: str = "") -> Row:
    """Return the row of a point.

    Parameters
    ----------
    axes : mapping
        The values of the axes; a list of numbers also gives the columns ``axis.0``, ``axis.1``, and so on.
    summary : mapping or None
        The contents of ``result.json``. Every number and text is a column; that in an object is ``object.name``.
    run, digest : str
        The run directory, and the hash of the config.
    said : str, default ""
        The reason where there is no summary; the status is then ``failed``.

    Returns
    -------
    dict
        The row.
    """
    entries: Row = {"status": "failed", "message": said} if summary is None else {}
    for name, value in (summary or {}).items():
        inside = dict(_list_entries(name, value))
        if name not in LEFT:
            entries |= {
                key: entry for key, entry in inside.items() if key not in LEFT and not isinstance(entry, list | Mapping)
            }
    units = (summary or {}).get("units") or {}
    entries |= {name: units[name.partition(".")[2]] for name in UNITS.values() if units.get(name.partition(".")[2])}
    axis_columns = {**_split_lists(axes), **axes}
    return {
        **axis_columns,
        **{key: entry for key, entry in entries.items() if key not in axis_columns},
        "run": run,
        "hash": digest,
    }


def _split_lists(axes: Mapping[str, Any]) -> Row:
    """Return the entries of values that are lists of numbers, each under the key that the config has for it."""
    lists = {key: value for key, value in axes.items() if isinstance(value, list | tuple)}
    return {
        f"{key}.{index}": entry
        for key, value in lists.items()
        if all(isinstance(entry, int | float) and not isinstance(entry, bool) for entry in value)
        for index, entry in enumerate(value)
    }


def _list_entries(name: str, value: Any) -> Iterator[tuple[str, Any]]:
    """Yield the entries of a value with their full names.

    An object within an object is entered only in ``sparsity``.
    """
    if not isinstance(value, Mapping):
        yield name, value
        return
    for key, entry in value.items():
        if name == "sparsity" and isinstance(entry, Mapping):
            yield from _list_entries(f"{name}.{key}", entry)
        else:
            yield f"{name}.{key}", entry


def columns_of(axes: Sequence[str], rows: Iterable[Row], kind: type[Result] = Result) -> list[str]:
    """Return the columns of a table.

    First come the axes, each followed by its entries where it has some. The columns that every run has follow in a
    fixed order, first the statistics of its result, which has the class ``kind``. Then come the others by name, and the
    last ones.
    """
    first = [*(name for name in statistics(kind) if name not in LAST), *FIRST]
    kept = list(rows)
    entries = {
        axis: max((sum(_find_axis(name, axes) == axis for name in row) for row in kept), default=0) for axis in axes
    }
    axis_columns = [
        name
        for axis in axes
        for name in (axis, *(f"{axis}.{index}" for index in range(entries[axis])))
        if name == axis or name not in axes
    ]
    run_columns = {name for row in kept for name in row} - set(axis_columns)
    other_columns = sorted(run_columns - {*first, *LAST})
    return [*axis_columns, *(name for name in (*first, *other_columns, *LAST) if name not in axis_columns)]


def _find_axis(name: str, axes: Sequence[str]) -> str | None:
    """Return the axis of whose value a column holds one number."""
    axis, _, index = name.rpartition(".")
    return axis if axis in axes and index.isdigit() and name not in axes else None


def table_text(axes: Sequence[str], rows: Sequence[Row]) -> str:
    """Return the table as CSV (RFC 4180, line feeds).

    Numbers are as short as they can be read back exactly, lists and mappings are JSON, and unknown values are empty.
    """
    names = columns_of(axes, rows)
    return _format_csv([names, *([_format_cell(row.get(name)) for name in names] for row in rows)])


def shared_unit(rows: Iterable[Row], kind: str = "cost") -> str:
    """Return the unit of the costs, constraints or times of `UNITS`; empty unless all rows with a cost have the same
    one."""
    units = {str(row.get(UNITS[kind]) or "") for row in rows if row.get("cost") is not None}
    return units.pop() if len(units) == 1 else ""


def axis_unit(key: str, rows: Iterable[Row]) -> str:
    """Return the unit of an axis, where its key is a time and all rows have the same unit of time.

    It is empty for other keys: their units depend on the states or controls that they belong to.
    """
    first, *steps = key.split(".")
    names = [step for step in steps if not step.isdigit()]
    return shared_unit(rows, "time") if first == "problem" and names and names[-1] in TIMES else ""


def columns_text(axes: Sequence[str], rows: Sequence[Row], kind: type[Result] = Result) -> str:
    """Return the unit and the meaning of every column, as CSV."""
    lines = [["column", "unit", "meaning"]]
    meanings = MEANING | {name: (entry.unit, entry.meaning) for name, entry in statistics(kind).items()}
    for name in columns_of(axes, rows, kind):
        unit, meaning = meanings.get(name, ("1", ""))
        if name in axes:
            unit, meaning = axis_unit(name, rows), "an axis: this key of the config"
        unit = (shared_unit(rows, unit) or unit) if unit in UNITS else unit
        if axis := _find_axis(name, axes):
            unit, meaning = "", f"the number at place {name.rpartition('.')[2]} of {axis}"
        lines.append([name, unit, meaning or (f"{name.partition('.')[2]} of {name.partition('.')[0]} in result.json")])
    return _format_csv(lines)


def read_table(directory: Path) -> list[Row]:
    """Return the rows of a study's ``table.csv``, with its numbers as numbers.

    Raises `InputError` where the table cannot be understood.
    """
    file = directory / TABLE
    try:
        lines = list(csv.reader(io.StringIO(file.read_text(encoding="utf-8"), newline=""), strict=True))
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        raise InputError(f"{file}: cannot be read: expected the table of a study: {error}") from None
    if not lines or not {"status", "run", "seconds"} <= set(lines[0]) or len(set(lines[0])) < len(lines[0]):
        raise InputError(f"{file}: expected the table of a study, with columns such as status, run and seconds")
    for number, line in enumerate(lines[1:], 2):
        if len(line) != len(lines[0]):
            raise InputError(f"{file}:{number}: expected {len(lines[0])} cells, as in the first line, got {len(line)}")
    return [{name: _parse_cell(name, cell) for name, cell in zip(lines[0], line, strict=True)} for line in lines[1:]]


def _format_csv(lines: Iterable[Sequence[str]]) -> str:
    stream = io.StringIO()
    csv.writer(stream, lineterminator="\n").writerows(lines)
    return stream.getvalue()


def _format_cell(value: object) -> str:
    if value is None or (isinstance(value, float) and not math.isfinite(value)):
        return ""
    if isinstance(value, bool | list | Mapping):
        return json.dumps(value)
    return repr(value) if isinstance(value, float) else str(value)


def _parse_cell(name: str, cell: str) -> Any:
    if cell == "":
        return None
    if name in TEXTS:
        return cell
    try:
        return json.loads(cell)
    except ValueError:
        return cell
