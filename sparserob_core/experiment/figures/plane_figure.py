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
# Of the larger side: a smaller goal is drawn as a mark; at a tenth boxes that one sees become marks
MARKED_GOAL_SHARE = 0.01
# of the width: of nearer marks one has its time above, the lower one below; of a tenth all are one blot
MIN_SPACING = 0.08
MARKS = 4  # parts of the horizon whose ends are marked


def draw_plane(data: FigureData) -> Figure:
    """The nominal path with the places that the worst case brings the system to. What is forbidden all the time is
    hatched; a set that holds for a part of it, or moves, is outlined beside the part of the path that it is about.
    Where the goal is a small part of all this, what is around it is shown below once more."""
    from matplotlib.figure import Figure

    plane = data.plane
    assert plane is not None
    views = [plane.view(data.path)]
    if (close := plane.goal(data.path)) is not None:
        views.append(close)
    talls = [float(np.clip(look.FIGURE_WIDTH * (high - low)[1] / (high - low)[0], 2.0, 7.0)) for low, high in views]
    figure = Figure(figsize=(look.FIGURE_WIDTH, sum(talls) + 0.6 + 0.5 * len(talls)), layout="constrained")
    axes = figure.subplots(len(views), squeeze=False, height_ratios=talls)[:, 0].tolist()
    for ax, (low, high) in zip(axes, views, strict=True):
        _draw_plane(ax, data, low, high)
    axes[0].set_title(data.title)
    if close is not None:
        axes[1].set_title("the same around the terminal set", fontsize="medium", color=look.GREY)
    draw_legend(figure, axes)
    return figure


def _draw_plane(ax: Axes, data: FigureData, low: Array, high: Array) -> None:
    """All that is in the plane, as far as it is between two corners."""
    from matplotlib.patches import Polygon

    plane, path = data.plane, data.path
    assert plane is not None
    sides = high - low
    ax.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]), aspect="equal")
    frame, colour = framed(low, high), iter((look.GREEN, look.PURPLE, look.INK))
    _hatch_forbidden(ax, frame, plane.walls)
    for limit, allowed in plane.outlined(frame):
        if limit.is_final:
            goal = Polygon(allowed, fill=False, edgecolor=look.VERMILLION, linewidth=2.0, zorder=4)
            goal.set_label("terminal set")
            if len(allowed) and np.ptp(allowed, axis=0).max() <= MARKED_GOAL_SHARE * sides.max():
                ax.plot(*allowed.mean(axis=0), "s", color=look.VERMILLION, fillstyle="none", markeredgewidth=2.0,
                        markersize=9, zorder=4, label="terminal set")  # fmt: skip
            else:
                ax.add_patch(goal)
        else:
            _draw_gate(ax, data, limit, path, allowed, next(colour, look.INK))
    pair = list(plane.states)
    if (data.tube_upper[pair] > data.tube_lower[pair]).any():
        label = "worst case" if data.gains is None else "worst case, with feedback"
        for number, polygon in enumerate(plane.places):  # they overlap: one opaque colour, that of the tube of a state
            ax.fill(*polygon.T, color=PALE, linewidth=0.4, zorder=2, label="" if number else label)
    ax.plot(*path.T, color=look.BLUE, linewidth=1.5, zorder=3, label="nominal")
    for number, arc in enumerate(data.arcs):
        ax.plot(*arc.T, color=look.ORANGE, linewidth=4.0, zorder=3.5, solid_capstyle="round",
                label="" if number else "the control acts")  # fmt: skip
    _draw_marks(ax, data, path, frame)
    ax.set_xlabel(data.state_label(plane.states[0]))
    ax.set_ylabel(data.state_label(plane.states[1]))


def _hatch_forbidden(ax: Axes, frame: Array, walls: list[Limit]) -> None:
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
    hole_codes = [Path.LINETO] * (len(hole) - 1)
    codes = [Path.MOVETO, *[Path.LINETO] * 3, Path.CLOSEPOLY, Path.MOVETO, *hole_codes, Path.CLOSEPOLY]
    ax.add_patch(PathPatch(Path(corners, codes), **look.EXCLUDED, label="forbidden"))
    for corner, next_corner in zip(allowed, np.roll(allowed, -1, axis=0), strict=True):
        # the edge of the picture is no wall
        if not ((corner == next_corner) & ((corner == frame[0]) | (corner == frame[2]))).any():
            ax.plot(*np.stack([corner, next_corner]).T, color=look.GREY, linewidth=1.0, zorder=1)


def _draw_gate(ax: Axes, data: FigureData, limit: Limit, path: Array, allowed: Array, colour: str) -> None:
    """A set that holds for a part of the time, or moves: the outline of what is ``allowed (k, 2)``, or where its sides
    are when the path is beside them, and that part of the path."""
    is_active = (data.times >= limit.times[0]) & (data.times <= limit.times[-1])
    unit = f" {plain(data.names.time)}" if data.names.time else ""
    label = f"{plain(limit.name)}, $t$ from {limit.times[0]:.6g} to {limit.times[-1]:.6g}{unit}"
    ax.plot(*path[is_active].T, color=colour, linewidth=4.0, alpha=0.6, zorder=2.5, solid_capstyle="butt", label=label)
    if not limit.moves:
        if len(allowed):
            ax.fill(*allowed.T, fill=False, edgecolor=colour, linewidth=1.1, linestyle=(0, (4, 2)), zorder=1.5)
        return
    for normal, bounds in zip(limit.normals, limit.bounds.T, strict=True):
        positions = np.stack([np.interp(limit.times, data.times, coordinate) for coordinate in path.T], axis=1)
        side_positions = positions + ((bounds - positions @ normal) / (normal @ normal))[:, None] * normal
        ax.plot(*side_positions.T, color=colour, linewidth=1.1, zorder=1.5)


def _draw_marks(ax: Axes, data: FigureData, path: Array, frame: Array) -> None:
    """Times along the path from where it is in the ``frame (4, 2)`` for good, and those of the active constraints."""
    from matplotlib.patheffects import withStroke

    outside_indices = np.flatnonzero(((path < frame[0]) | (path > frame[2])).any(axis=1))
    start_time = data.times[min(outside_indices[-1] + 1, path.shape[0] - 1)] if outside_indices.size else data.times[0]
    times = np.linspace(start_time, data.times[-1], MARKS + 1)
    marked_points = np.stack([np.interp(times, data.times, coordinate) for coordinate in path.T], axis=1)
    ax.plot(*marked_points.T, "o", color="white", markeredgecolor=look.BLUE, markersize=4.5, zorder=5)
    unit = f" {plain(data.names.time)}" if data.names.time else ""
    spacing = MIN_SPACING * (ax.get_xlim()[1] - ax.get_xlim()[0])
    is_crowded = np.abs(marked_points[:, None] - marked_points).max(axis=2) < spacing
    labelled_marks: list[int] = []
    for number in range(MARKS, -1, -1):  # of marks that crowd, the last ones have their times
        if is_crowded[number, labelled_marks].sum() < 2:
            labelled_marks.append(number)
    for number in labelled_marks:
        is_higher = is_crowded[number, labelled_marks] & (marked_points[labelled_marks, 1] > marked_points[number, 1])
        ax.annotate(
            f"{times[number]:.6g}{unit}",
            marked_points[number],
            xytext=(5, -13) if is_higher.any() else (5, 5),
            textcoords="offset points",
            fontsize=8.5,
            color=look.GREY,
            path_effects=[withStroke(linewidth=2.0, foreground="white")],
            zorder=6,
        )
    if len(data.active.times):
        positions = np.stack([np.interp(data.active.times, data.times, coordinate) for coordinate in path.T], axis=1)
        ax.plot(
            *positions.T, "^", color=look.PURPLE, markersize=6, markeredgewidth=0, zorder=5, label="active constraint"
        )
