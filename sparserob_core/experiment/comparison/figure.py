"""The figure of a comparison: lower bounds against evaluations and against seconds, below the exact optimum."""

from __future__ import annotations

from math import ceil
from textwrap import fill
from typing import TYPE_CHECKING, Any

import numpy as np

from sparserob_core.experiment.figures import style as look
from sparserob_core.experiment.figures.figure_data import measured, plain

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from sparserob_core.experiment.comparison.comparison import Comparison
    from sparserob_core.experiment.comparison.curve import Curve
    from sparserob_core.sip.convex_set import Array

COLOURS = (look.BLUE, look.VERMILLION, look.GREEN, look.PURPLE, look.ORANGE, look.SKY, look.GREY)
DASHES: tuple[Any, ...] = ("solid", (0, (1, 1)), (0, (4, 1, 1, 1)))
MARKERS = "osD^vP"
LINE = 84
"""Letters of a label in one line of the legend; half of them when two labels share the line."""


def draw_comparison(comparison: Comparison) -> Figure:
    """Two panels on one axis of bounds; a run that searches is a line, the rounds of any other are marked."""
    from matplotlib.figure import Figure

    drawn = [
        (curve, label) for curve, label in zip(comparison.curves, comparison.labels, strict=True) if curve.bound.size
    ]
    curves, texts = [curve for curve, _ in drawn], [fill(plain(label), LINE) for _, label in drawn]
    columns = 2 if max(map(len, texts)) <= LINE // 2 else 1
    lines = ceil((sum(text.count("\n") + 1 for text in texts) + 1) / columns)
    figure = Figure(figsize=(look.FIGURE_WIDTH, 3.2 + 0.165 * lines), layout="constrained")
    left_ax, right_ax = figure.subplots(1, 2, sharey=True)
    for number, (curve, text) in enumerate(zip(curves, texts, strict=True)):
        pen = _choose_pen(number, len(curves), curve.searched)
        _draw_curve(left_ax, curve.evaluations, curve.bound, curve.all_evaluations, {**pen, "label": text})
        _draw_curve(right_ax, curve.seconds, curve.bound, curve.all_seconds, pen)
    _draw_axes(left_ax, right_ax, comparison.exact, curves, comparison.cost_unit)
    figure.suptitle(plain(comparison.title), x=0.012, ha="left", fontsize=11.5)
    figure.legend(
        *left_ax.get_legend_handles_labels(),
        loc="outside lower left",
        ncols=columns,
        fontsize=9,
        labelspacing=0.3,
        columnspacing=1.6,
        handlelength=2.4,
        handletextpad=0.6,
    )
    return figure


def _choose_pen(number: int, count: int, searched: bool) -> dict[str, Any]:
    """Later searches are thinner, so that those which coincide show as the edges of one another."""
    width = 1.2 + 1.4 * (count - 1 - number) / max(count - 1, 1)
    return {
        "color": COLOURS[number % len(COLOURS)],
        "linestyle": DASHES[number // len(COLOURS) % len(DASHES)],
        "linewidth": width if searched else 1.2,
        "marker": "" if searched else MARKERS[number % len(MARKERS)],
    }


def _draw_curve(ax: Axes, places: Array, bound: Array, end: float, pen: dict[str, Any]) -> None:
    """Steps from each place to the next, and from the last one to the end of the run; a place of 0 is not on the
    axis."""
    last = max(float(places[-1]), end if np.isfinite(end) else 0.0)
    x, y = np.append(places, last), np.append(bound, bound[-1])
    marked = np.append(np.full(places.size, True), False)
    ax.plot(x[x > 0], y[x > 0], drawstyle="steps-post", markersize=5, markevery=marked[x > 0].tolist(), zorder=3, **pen)


def _draw_axes(left: Axes, right: Axes, exact: float, curves: list[Curve], unit: str) -> None:
    for ax in (left, right):
        _scale_axis(ax)
        ax.grid(axis="y", color=look.MIST, linewidth=0.6)
        ax.set_axisbelow(True)
        if np.isfinite(exact):
            ax.axhline(
                exact,
                color=look.INK,
                linewidth=0.9,
                linestyle=(0, (6, 4)),
                zorder=4,
                label=f"exact optimum {exact:.9g}",
            )
    left.set_ylim(*_compute_limits(exact, curves))
    left.set_ylabel(measured("lower bound of the cost $J$", unit))
    searched = {curve.searched for curve in curves}
    left.set_xlabel(
        " or ".join(
            text
            for text, does_search in (("evaluations of $g$", True), ("relaxed programs", False))
            if does_search in searched
        )
    )
    right.set_xlabel("seconds")


def _scale_axis(ax: Axes) -> None:
    """Logarithmic from a decade on; with plain numbers at 1, 2 and 5 until there are two."""
    from matplotlib.ticker import LogLocator, NullFormatter, StrMethodFormatter

    places = np.concatenate([np.asarray(line.get_xdata(), dtype=float) for line in ax.get_lines()])
    spread = places.max() / places.min() if places.size else 1.0
    if spread < 10.0:
        return
    ax.set_xscale("log")
    if spread < 100.0:
        ax.xaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
        ax.xaxis.set_major_formatter(StrMethodFormatter("{x:g}"))
        ax.xaxis.set_minor_formatter(NullFormatter())


def _compute_limits(exact: float, curves: list[Curve]) -> tuple[float, float]:
    bounds = np.concatenate([curve.bound for curve in curves])
    top = float(np.nanmax([exact, bounds.max()]))
    low = max(float(bounds.min()), top - look.VIEW_BELOW_OPTIMUM * abs(top)) if top else float(bounds.min())
    margin = 0.06 * max(top - low, 1e-9 * max(1.0, abs(top)))
    return low - margin, top + margin
