"""The state space: a plane for two states, space for three; the first states of more."""

from __future__ import annotations

from collections.abc import Mapping
from itertools import product
from typing import TYPE_CHECKING, Any

import numpy as np

from sparserob_rerun.drawing import palette as ink
from sparserob_rerun.drawing.canvas import Axes, Drawing

if TYPE_CHECKING:
    import sparserob_core as sr
    from sparserob_rerun.drawing.palette import Floats

SIDE = 420.0
SLICES = 36
ROOM = 2.0  # the panel is half as large as the drawing
LINE, ENTRY = 30.0, 300.0  # of words from one to the next, and how wide the longest are that say what is drawn


def draw_phase(rr: Any, stream: Any, data: sr.FigureData, worst: Mapping[str, Any]) -> None:
    """The nominal trajectory, the worst ones, slices of the tube and the terminal set below ``/physics/phase``; nothing
    for a single state."""
    if len(data.state) == 2:
        _plane(data, worst).log(
            rr, stream, "physics/phase", layers=("hatch", "slices", "frame", "worst", "curve", "wall")
        )
    elif len(data.state) > 2:
        _space(rr, stream, data, worst)


def _slices(data: sr.FigureData) -> Floats:
    """Boxes ``(k, d, 2)`` that hold every state at some times."""
    which = np.unique(np.linspace(0, data.times.size - 1, SLICES).astype(int))
    return np.stack([data.tube_lower[:, which].T, data.tube_upper[:, which].T], axis=-1)


def _plane(data: sr.FigureData, worst: Mapping[str, Any]) -> Drawing:
    axes = Axes(60.0, 0.0, SIDE, SIDE, _limits(data, 0), _limits(data, 1))
    drawing, drawn = Drawing(), [("dot: x(0)", ink.INK), ("worst-case boxes", ink.SKY)]
    drawing.frame(axes, "", data.names.state(0), room=ROOM)
    for box in _slices(data):
        (a, b), (c, d) = box
        drawing.line("slices", axes.at(np.array([a, b, b, a, a]), np.array([c, c, d, d, c])), ink.TUBE, 1.0)
    if _walls(drawing, axes, data):
        drawn.append(("terminal set", ink.VERMILLION))
    for path in worst.get("states", ()):
        drawing.line("worst", axes.at(path[0], path[1]), ink.ORANGE, 1.2)
    if len(worst.get("states", ())):
        drawn.append(("worst cases", ink.ORANGE))
    drawing.line("curve", axes.at(data.state[0], data.state[1]), ink.SKY, 2.0)
    drawing.dot(axes.at(data.state[0, 0], data.state[1, 0]), ink.INK, 5.0)
    for line, (words, colour) in enumerate(drawn):  # beside the plot, where no curve is
        drawing.text(axes.left + axes.width + ENTRY / 2, ROOM * LINE * (line + 0.5), words, colour)
    return drawing


def _walls(drawing: Drawing, axes: Axes, data: sr.FigureData) -> bool:
    """Draw what the states are held in; returns whether there is a terminal set."""
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
            [start, *(place for place, _ in corners)],
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
    """The twelve edges of a box."""
    edges = []
    for axis in range(3):
        others = [k for k in range(3) if k != axis]
        for sides in product((0, 1), repeat=2):
            points = np.zeros((2, 3))
            points[:, axis] = ends[axis]
            points[:, others[0]], points[:, others[1]] = ends[others[0]][sides[0]], ends[others[1]][sides[1]]
            edges.append(points)
    return edges
