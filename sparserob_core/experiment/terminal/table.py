"""Tables for people: drawn on a terminal, plain columns anywhere else."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from sparserob_core.brief import ENTRIES
from sparserob_core.experiment.terminal.printing import output, printable
from sparserob_core.quantities import statistics
from sparserob_core.sip.result import Result

KNOWN = {"lower bound", "upper bound", "relative gap"}
"""Rows that are shown even where the value is unknown."""


def print_table(title: str, columns: Sequence[str], rows: Sequence[Sequence[str]]) -> None:
    """Print rows under column names; empty ``columns`` make a list of keys and values."""
    show = _draw_table if output().isatty() else _write_table
    show(printable(title), columns, [[printable(cell).replace("\n", " ") for cell in row] for row in rows])


def _draw_table(title: str, columns: Sequence[str], rows: Sequence[Sequence[str]]) -> None:
    from rich.box import SIMPLE
    from rich.console import Console
    from rich.table import Table
    from rich.text import Text

    table = Table(title=Text(title), title_justify="left", title_style="bold", box=SIMPLE, show_header=bool(columns))
    for position in range(len(rows[0]) if rows else len(columns)):
        table.add_column(columns[position] if columns else "", overflow="fold", style="bold" if position == 0 else "")
    for row in rows:
        table.add_row(*(Text(cell) for cell in row))
    Console(file=output()).print(table)


def _write_table(title: str, columns: Sequence[str], rows: Sequence[Sequence[str]]) -> None:
    lines = [list(columns), *map(list, rows)] if columns else list(map(list, rows))
    widths = [max(len(line[position]) for line in lines) for position in range(len(lines[0]))] if lines else []
    text = [
        title,
        *(
            "  " + "  ".join(cell.ljust(width) for cell, width in zip(line, widths, strict=True)).rstrip()
            for line in lines
        ),
    ]
    output().write("\n".join(text) + "\n")


def result_rows(summary: Mapping[str, Any], kind: type[Result] = Result) -> list[tuple[str, str]]:
    """Return the main facts of a finished run for a user, as rows of a table, from the contents of ``result.json``.

    ``kind`` is the class of the result.
    """
    worst, sparsity, counts = summary["worst"], summary["sparsity"], summary["counts"]
    units = summary.get("units") or {}
    cost, *others = (
        (described.label, _format_measured(summary.get(name), units.get(described.unit), described.form))
        for name, described in statistics(kind).items()
        if described.label
    )
    rows = [
        ("status", f"{summary['status']}: {summary['message']}"),
        cost,
        ("cost of", summary.get("cost_of") or "unknown"),
        *others,
        ("any causal policy", _format_causal_bound(summary, units.get("cost"))),
        ("worst violation", _format_worst(worst, units, summary.get("parameters") or ())),
        (
            "kept",
            _format_tolerances(summary.get("tolerances") or {}, summary.get("equalities"), units.get("rows") or {}),
        ),
        ("active indices", str(counts["active_indices"])),
        ("rounds", str(counts["rounds"])),
        ("solved by", _name_solvers(counts.get("solved_by"))),
        ("share of time active", _format_active_share(sparsity)),
        ("J", _format_measured(summary.get("J"), units.get("J"))),
        ("sparsest", sparsity.get("verdict") or "unknown"),
        ("fewest active", _format_fewest_active(sparsity.get("fewest_active"), sparsity.get("channels"))),
        ("switches", _format_number(sparsity["switches"], "d")),
        ("seconds", f"{_format_number(summary['seconds'], '.3f')} of the method, which solves and proves"),
        *(("note", f"{note['place']}: {note['key']}: {note['note']}") for note in summary.get("notes") or ()),
    ]
    return [(name, value) for name, value in rows if value != "unknown" or name in KNOWN]


WHO = {
    "closed_form": "in closed form, no row being active",
    "dual_newton": "by the dual Newton method",
    "highs": "by HiGHS",
    "interior_point": "by the interior point method for feedback",
    "nobody": "not solved",
}


def _name_solvers(counts: Mapping[str, int] | None) -> str:
    """Name the solvers of the relaxed programs, each with the number that it solved."""
    if not counts:
        return "unknown"
    return ", ".join(f"{count} {WHO.get(name, f'by {name}')}" for name, count in counts.items())


def _format_active_share(sparsity: Mapping[str, Any]) -> str:
    """Format the share of the time in which the control acts."""
    share, is_multichannel = sparsity["active_fraction"], (sparsity.get("channels") or 1) > 1
    return _format_number(share, ".1%") + (", in at least one channel" if is_multichannel and share is not None else "")


def _format_fewest_active(known: Mapping[str, Any] | None, channels: int | None) -> str:
    """State the least share of the time that any admissible control must act, in the words of the checker."""
    if not known:
        return "unknown"
    lower, upper = _format_number(known["lower"], ".1%"), known["upper"]
    above = (
        ""
        if upper is None
        else f", and {_format_number(upper, '.1%')} suffice" + (": none acts less" if upper == known["lower"] else "")
    )
    mean = ", the mean over its channels" if (channels or 1) > 1 else ""
    return f"every admissible control acts at least {lower} of the time{mean}{above}"


def _format_measured(value: float | None, unit: str | None, form: str = ".9g") -> str:
    """A number with its unit, where both are known."""
    return "unknown" if value is None else _format_quantity(value, unit or "", form)


def _format_causal_bound(summary: Mapping[str, Any], unit: str | None) -> str:
    """State the lower bound of the cost of every causal policy, or that none exists."""
    if summary.get("causal_infeasible"):
        return "none exists: proven"
    lower = summary.get("causal_lower_bound")
    return "unknown" if lower is None else f"costs at least {_format_measured(lower, unit)}"


def _format_number(value: Any, form: str) -> str:
    return "unknown" if value is None else format(value, form)


def _format_tolerances(
    tolerances: Mapping[str, Any], equalities: Mapping[str, Any] | None, units: Mapping[str, Sequence[str]]
) -> str:
    """Return to what every constraint is kept, with what is excused, in the user's units: of rows with the same unit
    the largest."""
    entries = {
        name: (tolerance.get("kept"), tolerance["rows"], tolerance["proven"]) for name, tolerance in tolerances.items()
    }
    if equalities:
        entries["equals"] = equalities["missed"], equalities["excused"], None
    return (
        ", ".join(_format_tolerance(name, *entry, units.get(name) or [""]) for name, entry in entries.items())
        or "unknown"
    )


def _format_tolerance(name: str, kept: Any, excused: Any, share: float | None, units: Sequence[str]) -> str:
    if kept is None or excused is None:
        kept, excused, units = [share or 0.0], [0.0], [""]
    measured = list(units) * len(kept) if len(units) == 1 else list(units)
    largest: dict[str, tuple[float, float]] = {}
    for unit, kept_value, excused_value in zip(measured, kept, excused, strict=True):
        before = largest.get(unit, (float("-inf"), 0.0))
        largest[unit] = max(before[0], kept_value), max(before[1], excused_value)
    if max(kept, default=0.0) <= 0.0:
        spared = [_format_quantity(abs(kept_value), unit, ".1e") for unit, (kept_value, _) in largest.items()]
        return f"{name} with {', '.join(spared)} to spare"
    phrases = [
        f"{_format_quantity(max(kept_value, 0.0), unit, '.1e')} ({excused_value:.1e} excused)"
        for unit, (kept_value, excused_value) in largest.items()
    ]
    return f"{name} to {', '.join(phrases)}"


def _format_worst(worst: Mapping[str, Any], units: Mapping[str, Any], parameters: Sequence[str]) -> str:
    if worst["violation"] is None:
        return "unknown"
    unit, time, states = (units.get(key) or "" for key in ("worst", "time", "states"))
    description = "" if worst["time"] is None else f" at t = {_format_quantity(worst['time'], time)}"
    if worst["parameter"] is not None and len(worst["parameter"]):
        values = [f"{value:.6g}" for value in worst["parameter"]]
        assignments = [f"{name} = {value}" for name, value in zip(parameters, values, strict=False)]
        description += ", " + (
            _join_values(assignments) if len(assignments) == len(values) else f"p = ({_join_values(values)})"
        )
    description += f", {worst['corner']}" if worst.get("corner") else ""
    if worst.get("initial_state") is not None:
        initial_state = worst["initial_state"]
        measured = zip(initial_state, states or [""] * len(initial_state), strict=True)
        description += (
            f", from ({_join_values([_format_quantity(value, state_unit) for value, state_unit in measured])})"
        )
    return f"{worst['violation']:.2e}{f' {unit}' if unit else ''} in {worst['constraint']}{description}"


def _join_values(values: Sequence[str]) -> str:
    """Numbers for a row of a table; of more than `ENTRIES` the first, and how many more ``result.json`` has."""
    some = list(values) if len(values) <= ENTRIES else [*values[:ENTRIES], f"and {len(values) - ENTRIES} more"]
    return ", ".join(some)


def _format_quantity(value: float, unit: str, form: str = ".6g") -> str:
    return f"{value:{form}} {unit}".rstrip()
