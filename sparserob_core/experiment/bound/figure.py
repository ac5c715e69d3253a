"""The figure of worst cases: the envelope of every quantity over time, between its two bounds, and its walls."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from sparserob_core.experiment.figures import style as look
from sparserob_core.experiment.figures.figure_data import measured, plain

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from sparserob_core.experiment.bound.record import Bound, WorstCase

MAX_PANELS = 8  # largest number of panels: more of them are too small to be read on a page
EMPTY_HEIGHT_SHARE = 0.12  # empty space above and below the curves, as a share of their height


def draw_bound(found: Bound) -> Figure:
    """Return the figure of worst cases: a panel for every quantity that has a window of positive length, at most
    `MAX_PANELS`.

    Each panel has the largest and the smallest value over all uncertainty, as bands between the bound that is reached
    and the one that is proven, and the walls.
    """
    panels: dict[tuple[str, bool], list[WorstCase]] = {}
    for row in found.over_parameters:
        if row.edges.size:
            panels.setdefault((row.quantity, row.direction.size > row.deviation.size), []).append(row)
    shown = list(panels.values())[:MAX_PANELS]
    figure, axes = look.panels(len(shown), 1.9, extra=0.3)
    for ax, rows in zip(axes, shown, strict=True):
        _draw_panel(ax, rows)
    axes[0].set_title(plain(found.title))
    axes[-1].set_xlabel(measured("time $t$", found.time_unit))
    look.draw_legend(figure, axes)
    return figure


def _draw_panel(ax: Axes, rows: list[WorstCase]) -> None:
    finite = np.concatenate([band[np.isfinite(band)] for row in rows for band in (row.low, row.high)])
    walls = [row.wall for row in rows if row.wall is not None]
    low, high = float(finite.min(initial=0.0)), float(finite.max(initial=0.0))
    near = [wall for wall in walls if low - 2.0 * (high - low) <= wall <= high + 2.0 * (high - low)]
    low, high = min([low, *near]), max([high, *near])
    room = EMPTY_HEIGHT_SHARE * max(high - low, 1e-300)
    ax.set_ylim(low - room, high + room)
    for row in rows:
        colour = look.BLUE if row.sense == "sup" else look.ORANGE
        name = "largest value" if row.sense == "sup" else "smallest value"
        below, above = (np.where(np.isfinite(band), band, np.nan) for band in (row.low, row.high))
        ax.stairs(above, row.edges, baseline=below, fill=True, color=colour, alpha=0.35, linewidth=0)
        attained_values = row.low if row.sense == "sup" else row.high
        ax.stairs(
            attained_values, row.edges, baseline=None, color=colour, linewidth=1.2, label=f"{name}, reached and proven"
        )
        ax.plot(row.time, row.reached, "o", color=colour, markersize=4, zorder=4)
        if row.wall is not None:
            ends = (row.wall, ax.get_ylim()[1]) if row.sense == "sup" else (ax.get_ylim()[0], row.wall)
            if ends[0] < ends[1]:
                spanned = [row.start, row.stop]
                ax.fill_between(spanned, *ends, **look.EXCLUDED, label="beyond the wall")
    ax.set_ylabel(measured(plain(rows[0].quantity), rows[0].unit))
