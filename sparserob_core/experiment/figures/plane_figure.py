"""The figure of a system that moves in a plane: its path, the places of the worst case, walls, gates and goal."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from sparserob_core.experiment.figures import style as look
from sparserob_core.experiment.figures.figure_data import FigureData, plain
from sparserob_core.experiment.figures.plane import Limit, framed
from sparserob_core.experiment.figures.style import draw_legend

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from sparserob_core.sip.convex_set import Array

PALE = "#BEE1F6"  # SKY at 45 % on white
POINT = 0.01  # of the larger side: a smaller goal is drawn as a mark; at a tenth boxes that one sees become marks
BESIDE = 0.08  # of the width: a mark nearer to an earlier one has its time below; of a tenth of it both are one blot
MARKS = 4  # parts of the horizon whose ends are marked


def draw_plane(data: FigureData) -> Figure:
    """The nominal path with the places that the worst case brings the system to. What is forbidden all the time is
    hatched; a set that holds for a part of it, or moves, is outlined beside the part of the path that it is about."""
    from matplotlib.figure import Figure
    from matplotlib.patches import Polygon

    plane = data.plane
    assert plane is not None
    path, places = data.path, plane.places
    low, high = plane.view(path)
    sides = high - low
    tall = float(np.clip(look.WIDTH * sides[1] / sides[0], 2.0, 7.0))
    figure = Figure(figsize=(look.WIDTH, tall + 1.1), layout="constrained")
    ax = figure.subplots()
    ax.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]), aspect="equal")
    frame, colour = framed(low, high), iter((look.GREEN, look.PURPLE, look.INK))
    _hatched(ax, frame, plane.walls)
    for limit, allowed in plane.outlined(frame):
        if limit.is_final:
            goal = Polygon(allowed, fill=False, edgecolor=look.VERMILLION, linewidth=2.0, zorder=4)
            goal.set_label("terminal set")
            if len(allowed) and np.ptp(allowed, axis=0).max() <= POINT * sides.max():
                ax.plot(*allowed.mean(axis=0), "s", color=look.VERMILLION, fillstyle="none", markeredgewidth=2.0,
                        markersize=9, zorder=4, label="terminal set")  # fmt: skip
            else:
                ax.add_patch(goal)
        else:
            _gate(ax, data, limit, path, allowed, next(colour, look.INK))
    pair = list(plane.states)
    if (data.tube_upper[pair] > data.tube_lower[pair]).any():
        said = "worst case" if data.gains is None else "worst case, with feedback"
        for number, place in enumerate(places):  # they overlap: one opaque colour, that of the tube of a state
            ax.fill(*place.T, color=PALE, linewidth=0.4, zorder=2, label="" if number else said)
    ax.plot(*path.T, color=look.BLUE, linewidth=1.5, zorder=3, label="nominal")
    for number, arc in enumerate(data.arcs):
        ax.plot(*arc.T, color=look.ORANGE, linewidth=4.0, zorder=3.5, solid_capstyle="round",
                label="" if number else "the control acts")  # fmt: skip
    _marks(ax, data, path)
    ax.set_xlabel(data.state_label(plane.states[0]))
    ax.set_ylabel(data.state_label(plane.states[1]))
    ax.set_title(data.title)
    draw_legend(figure, [ax])
    return figure


def _hatched(ax: Axes, frame: Array, walls: list[Limit]) -> None:
    """Hatch what is forbidden for the whole time."""
    from matplotlib.patches import PathPatch
    from matplotlib.path import Path

    allowed = frame
    for wall in walls:
        allowed = wall.allowed(allowed)
    if not walls or not len(allowed):
        return
    hole = allowed[::-1]
    if len(hole) == len(frame) and np.allclose(np.sort(hole, axis=0), np.sort(frame, axis=0)):
        return  # no wall is within the view
    corners = np.vstack([frame, frame[:1], hole, hole[:1]])
    drawn = [Path.LINETO] * (len(hole) - 1)
    codes = [Path.MOVETO, *[Path.LINETO] * 3, Path.CLOSEPOLY, Path.MOVETO, *drawn, Path.CLOSEPOLY]
    ax.add_patch(PathPatch(Path(corners, codes), **look.EXCLUDED, label="forbidden"))
    for one, other in zip(allowed, np.roll(allowed, -1, axis=0), strict=True):
        if not ((one == other) & ((one == frame[0]) | (one == frame[2]))).any():  # the edge of the picture is no wall
            ax.plot(*np.stack([one, other]).T, color=look.GREY, linewidth=1.0, zorder=1)


def _gate(ax: Axes, data: FigureData, limit: Limit, path: Array, allowed: Array, colour: str) -> None:
    """A set that holds for a part of the time, or moves: the outline of what is ``allowed (k, 2)``, or where its sides
    are when the path is beside them, and that part of the path."""
    during = (data.times >= limit.times[0]) & (data.times <= limit.times[-1])
    unit = f" {plain(data.names.time)}" if data.names.time else ""
    said = f"{plain(limit.name)}, $t$ from {limit.times[0]:.6g} to {limit.times[-1]:.6g}{unit}"
    ax.plot(*path[during].T, color=colour, linewidth=4.0, alpha=0.6, zorder=2.5, solid_capstyle="butt", label=said)
    if not limit.moves:
        if len(allowed):
            ax.fill(*allowed.T, fill=False, edgecolor=colour, linewidth=1.1, linestyle=(0, (4, 2)), zorder=1.5)
        return
    for normal, bounds in zip(limit.normals, limit.bounds.T, strict=True):
        here = np.stack([np.interp(limit.times, data.times, coordinate) for coordinate in path.T], axis=1)
        beside = here + ((bounds - here @ normal) / (normal @ normal))[:, None] * normal
        ax.plot(*beside.T, color=colour, linewidth=1.1, zorder=1.5)


def _marks(ax: Axes, data: FigureData, path: Array) -> None:
    """Times along the path, and those of the active constraints."""
    from matplotlib.patheffects import withStroke

    at = np.linspace(data.times[0], data.times[-1], MARKS + 1)
    marked = np.stack([np.interp(at, data.times, coordinate) for coordinate in path.T], axis=1)
    ax.plot(*marked.T, "o", color="white", markeredgecolor=look.BLUE, markersize=4.5, zorder=5)
    unit = f" {plain(data.names.time)}" if data.names.time else ""
    near = BESIDE * (ax.get_xlim()[1] - ax.get_xlim()[0])
    for number, (time, place) in enumerate(zip(at, marked, strict=True)):
        crowded = (np.abs(marked[:number] - place).max(axis=1) < near).any()
        ax.annotate(
            f"{time:.6g}{unit}",
            place,
            xytext=(5, -13) if crowded else (5, 5),
            textcoords="offset points",
            fontsize=8.5,
            color=look.GREY,
            path_effects=[withStroke(linewidth=2.0, foreground="white")],
            zorder=6,
        )
    if len(data.active.times):
        where = np.stack([np.interp(data.active.times, data.times, coordinate) for coordinate in path.T], axis=1)
        ax.plot(*where.T, "^", color=look.PURPLE, markersize=6, markeredgewidth=0, zorder=5, label="active constraint")
