"""The figure of a margin of the horizon: the cost at scanned horizons, and the horizons that are excluded."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from sparserob_core.experiment.figures import style as look
from sparserob_core.experiment.figures.figure_data import plain
from sparserob_core.experiment.margin.figure import least_cost
from sparserob_core.experiment.margin.search import FEASIBLE, Margin

if TYPE_CHECKING:
    from matplotlib.figure import Figure


def write_horizon_figure(file: Path, found: Margin) -> None:
    """Draw the curve of cost against horizon into a file (.png, .pdf, .svg), which is complete or does not exist.

    Raises `InputError` where matplotlib is missing, and where the file cannot be written.
    """
    look.require_matplotlib()
    with look.style():
        look.write_figure(file, draw_horizons(found))


def draw_horizons(found: Margin) -> Figure:
    """Return the figure of a margin of the horizon.

    It has both bounds of the cost at every scanned horizon, which are not joined, since nothing is claimed between
    them. Crosses mark horizons that are infeasible or not decided, and a hatched band those that are all excluded.
    """
    figure, (ax,) = look.panels(1, 2.9)
    proven = [point for point in found.curve if point.status in FEASIBLE]
    horizons = np.array([point.factor for point in proven])
    upper, lower = (np.array([getattr(point, name) for point in proven]) for name in ("upper_bound", "lower_bound"))
    ax.plot(horizons, upper, "v", color=look.BLUE, markersize=4.5, zorder=3, label="certified upper bound")
    ax.plot(horizons, lower, "^", color=look.ORANGE, markersize=4.5, zorder=4, label="certified lower bound")
    longest = max((point.factor for point in found.curve), default=1.0)
    highest = float(upper.max(initial=0.0)) or 1.0
    ax.set_xlim(0.0, 1.03 * longest)
    ax.set_ylim(0.0, 1.15 * highest)
    for status, colour, label in (
        ("infeasible", look.VERMILLION, "proven infeasible"),
        ("other", look.GREY, "not decided"),
    ):
        crosses = [
            point.factor
            for point in found.curve
            if point.status not in FEASIBLE and (point.status == "infeasible") == (status == "infeasible")
        ]
        if crosses:
            ax.plot(crosses, np.zeros(len(crosses)), "x", color=colour, clip_on=False, zorder=5, label=label)
    if found.lower > 0.0:
        ax.axvspan(
            0.0,
            found.lower,
            facecolor=look.MIST,
            edgecolor=look.GREY,
            hatch="///",
            linewidth=0,
            alpha=0.6,
            zorder=0,
            label=f"excluded up to {found.lower:.6g}",
        )
    ax.set_ylabel(least_cost(found))
    ax.set_xlabel(plain(found.quantity).replace("horizon", "horizon $T$", 1))
    ax.set_title(found.title, pad=8)
    figure.legend(
        *ax.get_legend_handles_labels(), loc="outside lower center", ncols=2, columnspacing=1.6, handlelength=1.6
    )
    return figure
