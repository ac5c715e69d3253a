"""Picture of where the system moves: the plane that its problem names, or else its state space. That is a plane for two
states, space for three, and of more the first states."""

from __future__ import annotations

from collections.abc import Mapping
from itertools import product
from typing import TYPE_CHECKING, Any

import numpy as np

from sparserob_rerun.drawing import palette as ink
from sparserob_rerun.drawing.canvas import Axes, Drawing

if TYPE_CHECKING:
    import sparserob_core as sr
    from sparserob_rerun.drawing.palette import Colour, Floats

SIDE = 420.0
WIDER = {True: 260.0, False: 0.0}
"""How much wider than high a plane of two states is, in the arrangement of a search and in the others: it fills its
panel there. With ten times as much the words beside it are outside; with a tenth half of the panel is empty."""
EXTENT = (-40.0, 830.0, -24.0, 530.0)  # left, right, top and bottom of the plane, where it is as wide as high
FLAT, LENGTH = 0.4, 640.0  # a plane that is flatter is drawn that long, and what it shows is said below it
SLICES = 36
ROOM = 2.0  # the panel is half as large as the drawing
POINT = 8.0  # pixels: a goal that is smaller is drawn as a square of that size
LAYERS = ("hatch", "slices", "frame", "worst", "curve", "arcs", "wall")
LINE, ENTRY = 36.0, 380.0  # of words beside a plot, from one to the next, and how wide the longest are
COLUMNS, WIDE = 2, 400.0  # of words below one, which have the width of the panel


def draw_phase(rr: Any, stream: Any, data: sr.FigureData, worst: Mapping[str, Any], searches: bool) -> None:
    """Draw the nominal trajectory, the worst ones, slices of the tube and the terminal set below ``/physics/phase``;
    nothing for a single state; with ``searches`` as wide as the panel of a search is."""
    if data.plane is not None:
        moved(data, worst).log(rr, stream, "physics/phase", layers=LAYERS)
    elif len(data.state) == 2:
        _plane(data, worst, WIDER[searches]).log(rr, stream, "physics/phase", layers=LAYERS)
    elif len(data.state) > 2:
        _space(rr, stream, data, worst)


def pair_of(problem: sr.OptimalControlProblem) -> tuple[int, int] | None:
    """Return the two states that are drawn across and upwards; ``None`` where there are more, in space."""
    return problem.names.in_plane or ((0, 1) if problem.system.states == 2 else None)


def extent(problem: sr.OptimalControlProblem, searches: bool) -> tuple[float, float, float, float]:
    """Return left, right, top and bottom of the plane that is drawn."""
    left, right, top, bottom = EXTENT
    return left, right + WIDER[searches and problem.names.in_plane is None], top, bottom


def moved(data: sr.FigureData, worst: Mapping[str, Any]) -> Drawing:
    """Draw the path in the plane as it is, one unit as long upwards as across, and where the control acts on it."""
    plane = data.plane
    assert plane is not None
    (low, high), (across, up) = plane.view(data.path), plane.states
    wide = bool(high[1] - low[1] <= FLAT * (high[0] - low[0]))
    scale = (LENGTH if wide else SIDE) / float((high - low).max())
    width, height = (scale * (high - low)).tolist()
    axes = Axes(60.0, 0.0, width, height, (low[0], high[0]), (low[1], high[1]))
    drawing, legend = Drawing(), [("dot: x(0)", ink.INK)]
    drawing.frame(axes, "", data.names.state(across), room=ROOM)
    frame = np.array([low, [high[0], low[1]], high, [low[0], high[1]]])
    if (data.tube_upper > data.tube_lower)[[across, up]].any():
        for slice_corners in plane.places[np.unique(np.linspace(0, data.times.size - 1, SLICES).astype(int))]:
            drawing.line("slices", axes.at(*np.vstack([slice_corners, slice_corners[:1]]).T), ink.TUBE, 1.0)
        legend.append(("worst case", ink.SKY))
    for wall in plane.walls:
        for corners in wall.beyond(frame):
            drawing.forbidden("hatch", axes, axes.at(*corners.T), ink.HATCH)
    legend += [_outlined(drawing, axes, *outline) for outline in plane.outlined(frame) if len(outline[1])]
    for path in worst.get("states", ()):
        drawing.line("worst", axes.at(path[across], path[up]), ink.ORANGE, 1.2)
    if len(worst.get("states", ())):
        legend.append(("worst cases", ink.ORANGE))
    drawing.line("curve", axes.at(*data.path.T), ink.SKY, 2.0)
    for arc in data.arcs:
        drawing.line("arcs", axes.at(*arc.T), ink.SKY, 6.0)
    if data.arcs:
        legend.append(("thick: the control acts", ink.SKY))
    drawing.dot(axes.at(*data.path[0]), ink.INK, 5.0)
    _named(drawing, axes, legend, wide)
    return drawing


def _outlined(drawing: Drawing, axes: Axes, limit: Any, allowed: Floats) -> tuple[str, Colour]:
    """Outline what is ``allowed`` for a while, or as the goal; return its entry in the legend."""
    points = axes.at(*np.vstack([allowed, allowed[:1]]).T)
    if np.ptp(points, axis=0).max() < POINT:  # a mark around a goal that is too small to be seen
        points = points.mean(axis=0) + POINT / 2 * np.array([[-1, -1], [1, -1], [1, 1], [-1, 1], [-1, -1]])
    drawing.line("wall", points, ink.VERMILLION, 2.0 if limit.is_final else 1.0)
    return ("terminal set" if limit.is_final else limit.name), ink.VERMILLION


def _named(drawing: Drawing, axes: Axes, drawn: list[tuple[str, Colour]], below: bool = False) -> None:
    """Write the legend beside the plot or ``below`` it, where no curve is."""
    left, top, columns, wide, line = axes.left + axes.width, 0.0, 1, ENTRY, ROOM * LINE
    if below:
        columns, wide = COLUMNS, WIDE
        left, top = axes.left + (axes.width - columns * wide) / 2, axes.top + axes.height + line
    for entry, (words, colour) in enumerate(dict.fromkeys(drawn)):
        row, column = divmod(entry, columns)
        drawing.text(left + wide * (column + 0.5), top + line * (row + 0.5), words, colour)


def _slices(data: sr.FigureData) -> Floats:
    """Return boxes ``(k, d, 2)`` that hold every state at some times."""
    indices = np.unique(np.linspace(0, data.times.size - 1, SLICES).astype(int))
    return np.stack([data.tube_lower[:, indices].T, data.tube_upper[:, indices].T], axis=-1)


def _plane(data: sr.FigureData, worst: Mapping[str, Any], wider: float) -> Drawing:
    axes = Axes(60.0, 0.0, SIDE + wider, SIDE, _limits(data, 0), _limits(data, 1))
    drawing, legend = Drawing(), [("dot: x(0)", ink.INK), ("worst-case boxes", ink.SKY)]
    drawing.frame(axes, "", data.names.state(0), room=ROOM)
    for box in _slices(data):
        (a, b), (c, d) = box
        drawing.line("slices", axes.at(np.array([a, b, b, a, a]), np.array([c, c, d, d, c])), ink.TUBE, 1.0)
    if _walls(drawing, axes, data):
        legend.append(("terminal set", ink.VERMILLION))
    for path in worst.get("states", ()):
        drawing.line("worst", axes.at(path[0], path[1]), ink.ORANGE, 1.2)
    if len(worst.get("states", ())):
        legend.append(("worst cases", ink.ORANGE))
    drawing.line("curve", axes.at(data.state[0], data.state[1]), ink.SKY, 2.0)
    drawing.dot(axes.at(data.state[0, 0], data.state[1, 0]), ink.INK, 5.0)
    _named(drawing, axes, legend)
    return drawing


def _walls(drawing: Drawing, axes: Axes, data: sr.FigureData) -> bool:
    """Draw the walls of the states; return whether there is a terminal set."""
    end = [wall for wall in data.walls if wall.start == wall.end]
    if end:
        limits = [axes.x, axes.y]
        for wall in end:
            limits[wall.state] = (max(wall.lower, limits[wall.state][0]), min(wall.upper, limits[wall.state][1]))
        (a, b), (c, d) = limits
        drawing.line("wall", axes.at(np.array([a, b, b, a, a]), np.array([c, c, d, d, c])), ink.VERMILLION, 2.0)
    for wall in data.walls:
        if wall.start == wall.end or wall.moves:
            continue
        low, high = axes.x if wall.state == 0 else axes.y
        for edge, outside in ((wall.lower, low), (wall.upper, high)):
            if np.isfinite(edge):
                span = (min(edge, outside), max(edge, outside))
                across, up = (span, axes.y) if wall.state == 0 else (axes.x, span)
                drawing.hatched("hatch", axes, across, up, ink.HATCH)
    return bool(end)


def _limits(data: sr.FigureData, state: int) -> tuple[float, float]:
    edges = [edge for wall in data.walls if wall.state == state for edge in wall.edges]
    low, high = min([*edges, float(data.tube_lower[state].min())]), max([*edges, float(data.tube_upper[state].max())])
    margin = 0.1 * max(high - low, 1e-9)
    return low - margin, high + margin


def _space(rr: Any, stream: Any, data: sr.FigureData, worst: Mapping[str, Any]) -> None:
    boxes = _slices(data)[:, :3]
    stream.log(
        "physics/phase/nominal", rr.LineStrips3D([data.state[:3].T], colors=[ink.SKY], radii=rr.Radius.ui_points(1.5))
    )
    stream.log(
        "physics/phase/tube",
        rr.Boxes3D(
            centers=boxes.mean(axis=2),
            half_sizes=(boxes[:, :, 1] - boxes[:, :, 0]) / 2,
            colors=[ink.TUBE] * len(boxes),
            radii=rr.Radius.ui_points(0.7),
        ),
    )
    if len(worst.get("states", ())):
        stream.log(
            "physics/phase/worst",
            rr.LineStrips3D(
                [path[:3].T for path in worst["states"]], colors=[ink.ORANGE], radii=rr.Radius.ui_points(1.0)
            ),
        )
    ends = [(float(data.tube_lower[k].min()), float(data.tube_upper[k].max())) for k in range(3)]
    stream.log("physics/phase/axes", rr.LineStrips3D(_cage(ends), colors=[ink.FAINT], radii=rr.Radius.ui_points(0.5)))
    start = data.state[:3, 0]
    corners = [
        (tuple(ends[j][1 if j == k else 0] for j in range(3)), f"{data.names.state(k)} = {ends[k][1]:.3g}")
        for k in range(3)
    ]
    stream.log(
        "physics/phase/labels",
        rr.Points3D(
            [start, *(point for point, _ in corners)],
            labels=["x(0)", *(words for _, words in corners)],
            colors=[ink.INK],
            radii=rr.Radius.ui_points(3.0),
            show_labels=True,
        ),
    )
    terminal = [list(limits) for limits in ends]
    for wall in data.walls:
        if wall.start == wall.end and wall.state < 3:
            terminal[wall.state] = [max(wall.lower, terminal[wall.state][0]), min(wall.upper, terminal[wall.state][1])]
    if any(wall.start == wall.end for wall in data.walls):
        box = np.array(terminal)
        stream.log(
            "physics/phase/terminal",
            rr.Boxes3D(
                centers=[box.mean(axis=1)],
                half_sizes=[(box[:, 1] - box[:, 0]) / 2],
                colors=[ink.VERMILLION],
                radii=rr.Radius.ui_points(1.5),
            ),
        )


def _cage(ends: list[tuple[float, float]]) -> list[Floats]:
    """Return the twelve edges of a box."""
    edges = []
    for axis in range(3):
        other_axes = [k for k in range(3) if k != axis]
        for sides in product((0, 1), repeat=2):
            points = np.zeros((2, 3))
            points[:, axis] = ends[axis]
            points[:, other_axes[0]], points[:, other_axes[1]] = (
                ends[other_axes[0]][sides[0]],
                ends[other_axes[1]][sides[1]],
            )
            edges.append(points)
    return edges
