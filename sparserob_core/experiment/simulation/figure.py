"""The figure of a simulation: sampled states within the worst case."""

from __future__ import annotations

from typing import TYPE_CHECKING

from sparserob_core.experiment.figures import style as look
from sparserob_core.experiment.figures.adversary_figure import caption, draw_tube, finish_panel
from sparserob_core.experiment.figures.figure_data import FigureData
from sparserob_core.experiment.figures.style import panels

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from sparserob_core.experiment.simulation.simulation import Simulation


def draw_simulation(simulation: Simulation, data: FigureData) -> Figure:
    """Return the figure of a simulation.

    For every state it has some sampled trajectories, the envelope of all of them, and the worst-case tube around it.
    """
    figure, axes = panels(len(data.drawn_states), 1.9, extra=0.35)
    for component, ax in zip(data.drawn_states, axes, strict=True):
        draw_tube(ax, data, component)
        for number, path in enumerate(simulation.fan[:, component]):
            ax.plot(
                simulation.shown,
                path,
                color=look.BLUE,
                linewidth=0.5,
                alpha=0.35,
                zorder=3,
                label="sampled trajectories" if number == 0 else None,
            )
        for number, edge in enumerate((simulation.lower[component], simulation.upper[component])):
            ax.plot(
                simulation.shown,
                edge,
                color=look.INK,
                linewidth=0.9,
                linestyle=(0, (4, 2)),
                zorder=4,
                label=f"envelope of all {simulation.trajectories}" if number == 0 else None,
            )
        finish_panel(ax, data, component, (simulation.lower[component], simulation.upper[component]))
    caption(figure, axes, data, f"{simulation.law}: {_write_caption(simulation)}")
    return figure


def _write_caption(simulation: Simulation) -> str:
    rows = [simulation.any_violated or simulation.constraints[0]]
    return f"{rows[0].violated} of {simulation.trajectories} trajectories violate a constraint; a sample is no proof"
