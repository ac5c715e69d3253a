"""The figure of a study: curves along one numeric axis, a map over two, otherwise costs and seconds in two panels."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from textwrap import shorten
from typing import TYPE_CHECKING, Any

import numpy as np

from sparserob_core.errors import InputError
from sparserob_core.experiment.config.plain import value_text
from sparserob_core.experiment.figures import style as look
from sparserob_core.experiment.figures.figure_data import measured, plain
from sparserob_core.experiment.sweep.axes import Axis
from sparserob_core.experiment.sweep.study import Study
from sparserob_core.experiment.sweep.table import Row, axis_unit
from sparserob_core.sip.convex_set import Array

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

COLOURS = (look.BLUE, look.VERMILLION, look.GREEN, look.PURPLE, look.ORANGE, look.SKY, look.GREY)
DASHES: tuple[Any, ...] = ("solid", (0, (4, 1.5)), (0, (1, 1)))
MARKS: Mapping[str, str] = {
    "certified": "o",
    "verified": "s",
    "undecided": "D",
    "refuted": "v",
    "infeasible": "x",
    "failed": "X",
}
"""Marker of each status."""
FILLED = "osDvX"
MAX_LABEL_LETTERS = 44  # largest length of a label
MIN_MAP_VALUES = 5  # number of values of each axis from which a map is clearer than curves
SEVERAL = 5  # number of seeds from which a box is clearer than points


def draw_study(study: Study) -> Figure:
    """Return the figure of a study.

    Seeds are no axis of the figure but samples, whose median and quartiles are shown. Raises `InputError` where no
    point has a cost.
    """
    if not any(row.get("cost") is not None for row in study.table):
        raise InputError("no figure of the study: no point has a cost")
    leading = [axis for axis in study.axes if not axis.follows]
    numeric = [axis for axis in leading if axis.numeric and not _is_seed(axis)]
    categorical = [axis for axis in leading if not axis.numeric]
    if study.arrangement == "zip":  # one line through the values, drawn over the first axis
        numeric, categorical = numeric[:1], categorical[:1] if not numeric else []
    drawn = study.arrangement in ("random", "sobol")
    if (
        len(numeric) == 2
        and not categorical
        and (drawn or min(_count_values(study, axis) for axis in numeric) >= MIN_MAP_VALUES)
    ):
        return _draw_map(study, numeric)
    if numeric:
        numeric.sort(key=lambda axis: -_count_values(study, axis))
        return _draw_curves(study, numeric[0], [*numeric[1:], *categorical])
    return _draw_categories(study, categorical)


def _compute_quartiles(values: Sequence[float | None]) -> Array:
    """Return the lower quartile, the median and the upper quartile of rows that differ in the seed only, ``(3,)``.

    They are NaN where no value is known.
    """
    known_values = [value for value in values if value is not None]
    return np.quantile(known_values, (0.25, 0.5, 0.75)) if known_values else np.full(3, np.nan)


def _group_rows(rows: Sequence[Row], axes: Sequence[Axis]) -> dict[str, list[Row]]:
    """Return rows by the values of axes, in words."""
    groups: dict[str, list[Row]] = {}
    for row in rows:
        alone = len(axes) == 1 and not axes[0].numeric
        label = ", ".join(value_text(row[axis.key]) if alone else _name_value(axis, row[axis.key]) for axis in axes)
        groups.setdefault(plain(shorten(label, MAX_LABEL_LETTERS, placeholder="...")) if axes else "", []).append(row)
    return groups


def _name_value(axis: Axis, value: object) -> str:
    steps = [str(step) for step in axis.path if step != "name"]
    return f"{steps[-1] if steps else axis.key} {value_text(value)}"


def _draw_curves(study: Study, along: Axis, others: Sequence[Axis]) -> Figure:
    """Return curves of the cost and of the lower bound along an axis, one pair for each combination of the others."""
    groups = _group_rows(study.table, others)
    legend_rows = -(-(len(groups) + 2) // 2) if len(groups) <= len(COLOURS) * len(DASHES) else 1
    figure, (ax,) = look.panels(1, 2.9, extra=0.2 * legend_rows)
    has_legend = len(groups) <= len(COLOURS) * len(DASHES)
    for number, (label, rows) in enumerate(groups.items()):
        colour = COLOURS[number % len(COLOURS)] if has_legend else look.GREY
        dash = DASHES[number // len(COLOURS) % len(DASHES)]
        by_value: dict[float, list[Row]] = {}
        for row in rows:
            by_value.setdefault(float(row[along.key]), []).append(row)
        x = np.array(sorted(by_value))
        cost = np.array([_compute_quartiles([row.get("cost") for row in by_value[value]]) for value in x])
        lower = np.array([_compute_quartiles([row.get("lower_bound") for row in by_value[value]]) for value in x])
        middle, below = cost[:, 1], lower[:, 1]
        ax.fill_between(x, below, middle, color=colour, alpha=0.15, linewidth=0, zorder=1)
        if max(map(len, by_value.values())) > 1:
            ax.fill_between(x, cost[:, 0], cost[:, 2], color=colour, alpha=0.3, linewidth=0)
        ax.plot(x, middle, color=colour, linestyle=dash, linewidth=1.4, zorder=3, label=label or "cost")
        ax.plot(x, below, color=colour, linestyle=dash, linewidth=0.8, zorder=2)
        _draw_marks(ax, x, middle, [_find_worst_status(by_value[value]) for value in x], colour)
    ax.plot([], [], color=look.INK, linewidth=0.8, label="proven lower bound (thin)")
    _scale_axis(ax.set_xscale, along, [float(row[along.key]) for row in study.table])
    _scale_costs(ax.set_yscale, study.table)
    ax.set_xlabel(measured(along.key, axis_unit(along.key, study.table)))
    ax.set_ylabel(measured("cost $J$", study.cost_unit))
    _finish_figure(figure, ax, study, has_legend)
    return figure


def _draw_marks(ax: Axes, x: Array, y: Array, statuses: Sequence[str], colour: str) -> None:
    """Draw the status of every point: on its cost, or at the lower edge where there is none."""
    edge = ax.get_xaxis_transform()
    for status in dict.fromkeys(statuses):
        has_status = np.array([point_status == status for point_status in statuses])
        with_cost = has_status & np.isfinite(y)
        filled = MARKS[status] in FILLED
        style: dict[str, Any] = {
            "marker": MARKS[status],
            "linestyle": "none",
            "markersize": 4.5 if filled else 6.5,
            "markerfacecolor": colour if status == "certified" else "white",
            "markeredgecolor": colour,
            "clip_on": False,
            "zorder": 4,
        }
        places: list[tuple[Any, Any, dict[str, Any]]] = [
            (with_cost, y, style),
            (has_status & ~with_cost, np.full(x.size, 0.02), {**style, "transform": edge}),
        ]
        for mask, height, looks in places:
            if mask.any():
                ax.plot(x[mask], height[mask], **looks)[0].set_in_layout(False)


def _draw_map(study: Study, axes: Sequence[Axis]) -> Figure:
    """Return a map of the cost over two axes: cells of a grid, or points that were drawn."""
    from matplotlib.figure import Figure

    first, second = axes
    figure = Figure(figsize=(look.FIGURE_WIDTH, 3.9), layout="constrained")
    ax = figure.subplots()
    cells: dict[tuple[float, float], list[Row]] = {}
    for row in study.table:
        cells.setdefault((float(row[first.key]), float(row[second.key])), []).append(row)
    x, y = (np.array(sorted({pair[k] for pair in cells})) for k in (0, 1))
    _scale_axis(ax.set_xscale, first, x)
    _scale_axis(ax.set_yscale, second, y)
    if study.arrangement in ("random", "sobol"):
        points = np.array(list(cells))
        costs = np.array([_compute_quartiles([row.get("cost") for row in rows])[1] for rows in cells.values()])
        is_finite = np.isfinite(costs)
        drawn: Any = ax.scatter(
            points[is_finite, 0], points[is_finite, 1], c=costs[is_finite], cmap="viridis", s=26, linewidths=0
        )
    else:
        costs = np.full((y.size, x.size), np.nan)
        for (first_value, second_value), rows in cells.items():
            median = _compute_quartiles([row.get("cost") for row in rows])[1]
            costs[np.searchsorted(y, second_value), np.searchsorted(x, first_value)] = median
        drawn = ax.pcolormesh(
            _compute_edges(x, first.log), _compute_edges(y, second.log), costs, cmap="viridis", linewidth=0
        )
        drawn.set_edgecolor("face")
    for status in MARKS:
        marked = [pair for pair, rows in cells.items() if _find_worst_status(rows) == status]
        if marked and status != "certified":
            places = np.array(marked)
            kind: dict[str, Any] = {"facecolors": "none"} if MARKS[status] in FILLED else {}
            colour = look.INK if status in ("infeasible", "failed") else "white"
            edge: dict[str, Any] = {"edgecolors": colour} if kind else {"color": colour}
            ax.scatter(places[:, 0], places[:, 1], marker=MARKS[status], s=26, linewidths=1.0, **kind, **edge)
    figure.colorbar(drawn, ax=ax, label=measured("cost $J$", study.cost_unit))
    ax.set_xlabel(measured(first.key, axis_unit(first.key, study.table)))
    ax.set_ylabel(measured(second.key, axis_unit(second.key, study.table)))
    for spine in ("top", "right"):
        ax.spines[spine].set_visible(True)
    _finish_figure(figure, ax, study, has_labels=False, marked=[status for status in MARKS if status != "certified"])
    return figure


def _draw_categories(study: Study, axes: Sequence[Axis]) -> Figure:
    """Return the costs down to their lower bounds, and the seconds, one line for each combination of values.

    Several seeds are shown as a box.
    """
    from matplotlib.figure import Figure

    groups = _group_rows(study.table, axes)
    figure = Figure(figsize=(look.FIGURE_WIDTH, 0.32 * len(groups) + 1.6), layout="constrained")
    left_ax, right_ax = figure.subplots(1, 2, sharey=True, width_ratios=(3, 2))
    for position, rows in enumerate(groups.values()):
        shift = np.linspace(-0.22, 0.22, len(rows)) if len(rows) > 1 else np.zeros(1)
        for offset, row in zip(shift, rows, strict=True):
            cost, lower = row.get("cost"), row.get("lower_bound")
            if cost is not None and lower is not None:
                left_ax.plot([lower, cost], [position + offset] * 2, color=look.SKY, linewidth=2.5, zorder=1)
            status, edge = str(row["status"]), left_ax.get_yaxis_transform()
            style: dict[str, Any] = {
                "marker": MARKS[status],
                "linestyle": "none",
                "markersize": 4.5,
                "markerfacecolor": look.BLUE if status == "certified" else "white",
                "markeredgecolor": look.BLUE,
                "clip_on": False,
                "zorder": 3,
            }
            if cost is not None:
                left_ax.plot([cost], [position + offset], **style)
            else:
                left_ax.plot([0.0], [position + offset], transform=edge, **style)
        seconds = [float(row["seconds"]) for row in rows if row.get("seconds")]
        if len(seconds) >= SEVERAL:
            right_ax.boxplot([seconds], positions=[position], orientation="horizontal", widths=0.5, **_BOX)
        else:
            right_ax.plot(seconds, [position] * len(seconds), "o", color=look.VERMILLION, markersize=4)
    left_ax.set_yticks(range(len(groups)), [label or "all" for label in groups])
    left_ax.set_ylim(len(groups) - 0.5, -0.5)
    _scale_costs(left_ax.set_xscale, study.table)
    times = [float(row["seconds"]) for row in study.table if row.get("seconds")]
    if times and max(times) > 20.0 * min(times):
        right_ax.set_xscale("log")
    else:
        right_ax.set_xlim(left=0.0)
    left_ax.set_xlabel(measured("cost $J$", study.cost_unit) + ", down to its proven lower bound")
    right_ax.set_xlabel("seconds of the method (s)")
    _finish_figure(figure, left_ax, study, has_labels=False)
    return figure


_BOX: dict[str, Any] = {
    "manage_ticks": False,
    "boxprops": {"color": look.VERMILLION},
    "whiskerprops": {"color": look.VERMILLION},
    "capprops": {"color": look.VERMILLION},
    "medianprops": {"color": look.INK},
    "flierprops": {"marker": ".", "markersize": 3, "markeredgecolor": look.VERMILLION},
}


def _finish_figure(figure: Figure, ax: Axes, study: Study, has_labels: bool, marked: Iterable[str] = MARKS) -> None:
    """Add the title, and below the figure a legend of the markers that occur."""
    from matplotlib.lines import Line2D

    ax.set_title(plain(study.title))
    handles, labels = ax.get_legend_handles_labels() if has_labels else ([], [])
    for status in (mark for mark in marked if mark in study.counts):
        filled = MARKS[status] in FILLED
        handles.append(
            Line2D(
                [],
                [],
                marker=MARKS[status],
                linestyle="none",
                markersize=4.5 if filled else 6.5,
                markerfacecolor=look.INK if status == "certified" else "white",
                markeredgecolor=look.INK,
            )
        )
        labels.append(status)
    columns = 2 if any(len(label) > MAX_LABEL_LETTERS // 2 for label in labels) else 4
    figure.legend(handles, labels, loc="outside lower center", ncols=columns, columnspacing=1.6, handlelength=1.8)


def _find_worst_status(rows: Sequence[Row]) -> str:
    """Return the status of several seeds that proves least."""
    return max((str(row["status"]) for row in rows), key=list(MARKS).index)


def _compute_edges(values: Array, log: bool) -> Array:
    """Return the edges of cells about values, half-way between them."""
    centres = np.log(values) if log else values
    if centres.size == 1:
        edges = np.array([centres[0] - 0.5, centres[0] + 0.5])
    else:
        middle = (centres[1:] + centres[:-1]) / 2
        edges = np.concatenate([[2 * centres[0] - middle[0]], middle, [2 * centres[-1] - middle[-1]]])
    return np.exp(edges) if log else edges


def _scale_axis(set_scale: Any, axis: Axis, values: Sequence[float] | Array) -> None:
    if axis.log and min(values) > 0.0:
        set_scale("log")


def _scale_costs(set_scale: Any, rows: Sequence[Row]) -> None:
    """Use a logarithmic axis for costs over three decades and more."""
    costs = [float(row["cost"]) for row in rows if row.get("cost") is not None]
    if costs and min(costs) > 0.0 and max(costs) >= 1000.0 * min(costs):
        set_scale("log")


def _count_values(study: Study, axis: Axis) -> int:
    """Return the number of values of an axis that occur."""
    return len({float(row[axis.key]) for row in study.table})


def _is_seed(axis: Axis) -> bool:
    return axis.path == ("seed",)
