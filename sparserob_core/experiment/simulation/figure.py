"""The figure of a simulation: sampled states within the worst case."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING

from sparserob_core.experiment.figures import style as look
from sparserob_core.experiment.figures.active import stored_active
from sparserob_core.experiment.figures.adversary_figure import caption, draw_tube, finish_panel, write_adversary
from sparserob_core.experiment.figures.drawing import figure_data
from sparserob_core.experiment.figures.figure_data import FigureData
from sparserob_core.experiment.figures.style import panels, style, write_figure
from sparserob_core.sip.convex_set import Array

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from sparserob_core.experiment.directory.finished import FinishedRun
    from sparserob_core.experiment.simulation.simulation import Simulation


def write_simulation(
    file: Path, simulation: Simulation, finished: FinishedRun, worst: Mapping[str, Array] | None = None
) -> None:
    """Draw a simulation over the worst case of its run into a file (.png, .pdf, .svg).

    Parameters
    ----------
    file : Path
        The file.
    simulation : Simulation
        The simulation.
    finished : FinishedRun
        The run.
    worst : mapping, optional
        Adversaries, which are drawn instead of the simulation.

    Raises
    ------
    InputError
        If the file cannot be written.
    """
    active = stored_active(finished.experiment.transcription, finished.solution)
    status = str(finished.summary["status"])
    data = figure_data(finished.experiment, finished.decision, active, (), None, status=status)
    if worst is not None:
        write_adversary(file, worst, data)
        return
    with style():
        write_figure(file, draw_simulation(simulation, data))


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
