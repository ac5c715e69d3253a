"""The figure of a study in closed loop: the states in the tube of the plan, and the control that was applied."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from sparserob_core.experiment.figures import style as look
from sparserob_core.experiment.figures.adversary_figure import caption, draw_tube, finish_panel
from sparserob_core.experiment.figures.figure_data import FigureData
from sparserob_core.experiment.figures.style import panels
from sparserob_core.experiment.simulation.simulation import ADVERSARY

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from sparserob_core.experiment.loop.study import ClosedLoops

PLAN = (0, (3, 1))
COLOURS = {
    ADVERSARY: look.INK,
    "iid": look.BLUE,
    "vertices": look.GREEN,
    "slow": look.PURPLE,
    "neighbours": look.ORANGE,
}


def draw_loops(loops: ClosedLoops, data: FigureData) -> Figure:
    """Return the figure of closed loops.

    It has every state of the first loops of every law in the tube of the plan, and below them the controls that were
    applied and that of the plan. There is no tube where the horizon is solved anew, since the states may then leave it.
    For a plan that repeats it shows the first period.
    """
    states, channels = len(data.drawn_states), len(data.control)
    figure, axes = panels(states + channels, 1.7, extra=0.35)
    for component, ax in zip(data.drawn_states, axes[:states], strict=True):
        if not loops.resolve:  # with a new plan, states may leave the tube of the first one, but violate no constraint
            draw_tube(ax, data, component)
        named = set[str]()
        for law, path in loops.paths:
            label = None if law in named else f"{law}"
            named.add(law)
            ax.plot(loops.shown, path[component], color=COLOURS[law], linewidth=0.7, alpha=0.7, zorder=3, label=label)
        finish_panel(ax, data, component, tuple(path[component] for _, path in loops.paths), tube=not loops.resolve)
    for channel, ax in enumerate(axes[states:]):
        ax.axhline(0.0, color=look.GREY, linewidth=0.6, zorder=1)
        for law, control in loops.controls:
            ax.stairs(control[channel], data.breakpoints, baseline=None, color=COLOURS[law], linewidth=0.7, alpha=0.7)
        ax.stairs(
            data.control[channel],
            data.breakpoints,
            baseline=None,
            color=look.INK,
            linewidth=1.4,
            linestyle=PLAN,
            label="the plan",
        )
        for bound in (data.control_lower[channel], data.control_upper[channel]):
            if np.isfinite(bound):
                ax.axhline(bound, color=look.GREY, linewidth=0.6, linestyle=(0, (4, 2)))
        ax.set_ylabel(data.control_label(channel))
        ax.margins(y=0.12)
    time = loops.summary()["milliseconds"]
    how = "solved anew at every step" if loops.resolve else "the plan applied"
    caption(figure, axes, data, f"closed loop, {how}: {loops.steps} steps of {time['median']:.3g} ms (median)")
    return figure
