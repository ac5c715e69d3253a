"""The figures of a simulation: sampled states inside the worst case, and the worst disturbances with what they do to the state."""

from __future__ import annotations

import os
from collections.abc import Mapping
from io import BytesIO
from pathlib import Path
from textwrap import shorten
from typing import TYPE_CHECKING, Any

import numpy as np

from sparserob_core.errors import InputError
from sparserob_core.experiment import figure_style as look
from sparserob_core.experiment.compare_figure import KINDS
from sparserob_core.experiment.figure_data import FigureData
from sparserob_core.experiment.figure_style import panels, require_matplotlib, style
from sparserob_core.experiment.figures import draw_legend, draw_time_axis, draw_walls
from sparserob_core.sip.convex_set import Array

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from sparserob_core.experiment.finished import FinishedRun
    from sparserob_core.experiment.simulation import Simulation

COLOURS = (look.BLUE, look.GREEN, look.PURPLE, look.ORANGE, look.INK)   # vermillion is the terminal set's
DASHES: tuple[Any, ...] = ("solid", (0, (5, 2)), (0, (1.5, 1.5)))


def require_writable(file: Path) -> None:
    """Raise `InputError` unless the ending of the file is a kind of figure, its folder can be written to, and matplotlib is there."""
    if file.suffix.lower() not in KINDS:
        raise InputError(f"{file}: expected a file that ends in {', '.join(KINDS)}, got {file.suffix or 'no ending'}")
    folder = next(parent for parent in file.absolute().parents if parent.exists())
    if file.is_dir() or not folder.is_dir() or not os.access(folder, os.W_OK):
        raise InputError(f"{file}: cannot be written there; expected a file in a folder that can be written to")
    require_matplotlib()


def write_simulation(file: Path, simulation: Simulation, finished: FinishedRun, worst: Mapping[str, Array] | None = None) -> None:
    """Draw a simulation over the worst case of its run into a file (.png, .pdf, .svg); ``worst``, adversaries, are drawn instead when given.

    Raises `InputError` when the file cannot be written.
    """
    from sparserob_core.experiment.drawing import active_times, figure_data

    data = figure_data(finished.experiment, finished.theta, active_times(finished.solution), (), None)
    if worst is not None:
        write_adversary(file, worst, data)
        return
    with style():
        _write(file, draw_simulation(simulation, data))


def write_adversary(file: Path, arrays: Mapping[str, Array], data: FigureData) -> None:
    """Draw the contents of ``adversary.npz`` into a file (.png, .pdf, .svg); raises `InputError` when it cannot be written."""
    require_writable(file)
    with style():
        _write(file, draw_adversary(arrays, data))


def draw_simulation(simulation: Simulation, data: FigureData) -> Figure:
    """Every state: some sampled trajectories, the envelope of all of them, and around it the worst case that no sample reached."""
    figure, axes = panels(len(data.state), 1.9, extra=0.35)
    for component, ax in enumerate(axes):
        _tube(ax, data, component)
        for number, path in enumerate(simulation.fan[:, component]):
            ax.plot(simulation.shown, path, color=look.BLUE, linewidth=0.5, alpha=0.35, zorder=3,
                    label="sampled trajectories" if number == 0 else None)
        for number, edge in enumerate((simulation.lower[component], simulation.upper[component])):
            ax.plot(simulation.shown, edge, color=look.INK, linewidth=0.9, linestyle=(0, (4, 2)), zorder=4,
                    label=f"envelope of all {simulation.trajectories}" if number == 0 else None)
        _finish(ax, data, component, (simulation.lower[component], simulation.upper[component]))
    _below(figure, axes, data, f"{simulation.law}: {_said(simulation)}")
    return figure


def draw_adversary(arrays: Mapping[str, Array], data: FigureData) -> Figure:
    """Above the states under the worst case of every constraint, with a dot where it is attained, below the disturbances that cause them."""
    disturbances = arrays["disturbances"]
    states, channels = len(data.state), disturbances.shape[1]
    figure, axes = panels(states + channels, 1.7, extra=0.35)
    for number, name in enumerate(arrays["names"].tolist()):
        pen = {"color": COLOURS[number % len(COLOURS)], "linestyle": DASHES[number // len(COLOURS) % len(DASHES)]}
        at = int(np.abs(arrays["state_times"] - arrays["times"][number]).argmin())
        for component, ax in enumerate(axes[:states]):
            path = arrays["states"][number, component]
            ax.plot(arrays["state_times"], path, linewidth=1.4, zorder=3 - 0.01 * number, label=f"worst case of {name}", **pen)
            if arrays["directions"][number, component]:
                ax.plot(arrays["times"][number], path[at], "o", color=pen["color"], markersize=5, markeredgecolor="white",
                        markeredgewidth=0.7, zorder=6, clip_on=False)
        for channel, ax in enumerate(axes[states:]):
            ax.stairs(disturbances[number, channel], arrays["breakpoints"], baseline=None, linewidth=1.3, zorder=3 - 0.01 * number, **pen)
    for component, ax in enumerate(axes[:states]):
        _tube(ax, data, component)
        _finish(ax, data, component, tuple(arrays["states"][:, component]))
    for channel, ax in enumerate(axes[states:]):
        ax.axhline(0.0, color=look.GREY, linewidth=0.6, zorder=1)
        ax.set_ylabel(f"$w_{{{channel + 1}}}(t)$" if channels > 1 else "$w(t)$")
        ax.margins(y=0.15)
    _below(figure, axes, data, "the worst disturbance and parameter of every constraint")
    return figure


def _tube(ax: Axes, data: FigureData, component: int) -> None:
    lower, upper = data.tube_lower[component], data.tube_upper[component]
    ax.fill_between(data.times, lower, upper, color=look.SKY, alpha=0.4, linewidth=0, zorder=2, label="worst-case tube")
    for edge in (lower, upper):
        ax.plot(data.times, edge, color=look.SKY, linewidth=0.8, zorder=2)


def _finish(ax: Axes, data: FigureData, component: int, curves: tuple[Array, ...]) -> None:
    """Limits around everything that is drawn, then the walls within them."""
    walls = [wall for wall in data.walls if wall.state == component]
    edges = [edge for wall in walls for edge in (wall.lower, wall.upper) if np.isfinite(edge)]
    low = min([*edges, float(data.tube_lower[component].min()), *(float(curve.min()) for curve in curves)])
    high = max([*edges, float(data.tube_upper[component].max()), *(float(curve.max()) for curve in curves)])
    margin = 0.12 * max(high - low, 1e-9)
    ax.set_ylim(low - margin, high + margin)
    draw_walls(ax, walls)
    ax.set_ylabel(data.state_label(component))


def _below(figure: Figure, axes: list[Axes], data: FigureData, text: str) -> None:
    draw_time_axis(axes[-1], data)
    axes[0].set_title(shorten(data.title, 80, placeholder=" ..."), pad=20)
    axes[0].text(0.0, 1.045, text, transform=axes[0].transAxes, fontsize=9.5, color=look.GREY)
    draw_legend(figure, axes)
    figure.align_ylabels(axes)


def _said(simulation: Simulation) -> str:
    rows = [simulation.any_violated or simulation.constraints[0]]
    return f"{rows[0].violated} of {simulation.trajectories} trajectories violate a constraint; a sample is no proof"


def _write(file: Path, figure: Figure) -> None:
    stream, kind = BytesIO(), file.suffix.lower()
    figure.savefig(stream, format=kind[1:], **KINDS[kind])
    temporary = file.with_name(f".{file.name}.{os.getpid()}.tmp")
    try:
        file.parent.mkdir(parents=True, exist_ok=True)
        temporary.write_bytes(stream.getvalue())
        temporary.replace(file)
    except OSError as error:
        temporary.unlink(missing_ok=True)
        raise InputError(f"{file}: cannot be written: {error.strerror}") from error
