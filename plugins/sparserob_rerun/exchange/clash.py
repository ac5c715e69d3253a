"""Picture of why nothing is feasible: every quantity of the reason between its walls, where the control can bring it,
and what the worst disturbance makes of its best."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from sparserob_rerun.drawing import palette as ink
from sparserob_rerun.drawing.canvas import Axes, Drawing

if TYPE_CHECKING:
    import sparserob_core as sr

LEFT, WIDTH, HEIGHT, GAP = 40.0, 640.0, 84.0, 104.0
BAR = 11.0  # pixels
CHARACTER, MARGIN = 7.0, 16.0
"""Units of the drawing that a character takes, and the edges of a label: of up to three strips, which are as large as
the panel is wide; more of them are smaller, and their words are not."""


def extent(strips: Sequence[sr.Strip]) -> tuple[float, float, float, float]:
    """Return left, right, top and bottom of the drawing."""
    return 0.0, LEFT + WIDTH + 40.0, -64.0, max(len(strips), 1) * (HEIGHT + GAP)


def draw_clash(rr: Any, stream: Any, strips: Sequence[sr.Strip]) -> None:
    """Draw the strips below ``/clash``, each on an axis of its own."""
    drawing = Drawing()
    for position, strip in enumerate(strips):
        _strip(drawing, position, strip, max(1.0, len(strips) / 3.0))
    drawing.log(rr, stream, "clash", layers=("hatch", "frame", "marks", "reach", "worst", "curve", "wall"))


def _strip(drawing: Drawing, place: int, strip: sr.Strip, size: float) -> None:
    """Draw one strip; ``size``: that of its words, relative to those of three strips."""
    worst = (strip.best - strip.sigma_low, strip.best + strip.sigma_high)
    axes = Axes(LEFT, place * (HEIGHT + GAP), WIDTH, HEIGHT, strip.view, (0.0, 3.0))
    (left, top), (right, bottom) = axes.at(axes.x[0], 3.0)[0], axes.at(axes.x[1], 0.0)[0]
    drawing.text((left + right) / 2, top - 34.0, strip.label.replace("\n", ", "))
    drawing.text((left + right) / 2, top - 14.0, _said(strip), ink.ORANGE)
    drawing.line("frame", np.array([[left, bottom], [right, bottom]]), ink.GREY, 1.0)
    walls = sorted({v for v in (strip.low, strip.high) if np.isfinite(v)})
    words = [f"{value:.4g}" for value in walls]
    for x, label in zip(
        _beside([float(axes.at(value, 0.0)[0, 0]) for value in walls], words, size), words, strict=True
    ):
        drawing.text(x, bottom + 16.0, label, ink.VERMILLION)
    for edge, end in ((strip.low, axes.x[0]), (strip.high, axes.x[1])):
        if np.isfinite(edge):
            drawing.hatched("hatch", axes, (min(edge, end), max(edge, end)), (0.0, 3.0), ink.HATCH)
            drawing.line("wall", axes.at(np.full(2, edge), np.array([0.0, 3.0])), ink.VERMILLION, 2.0)
    reach = np.clip((strip.reach_low, strip.reach_high), *axes.x)
    for layer, (low, high), height, colour in (
        ("reach", (float(reach[0]), float(reach[1])), 2.1, ink.SKY),
        ("worst", worst, 0.9, ink.ORANGE),
    ):
        if high > low:
            drawing.line(layer, axes.at(np.array([low, high]), np.full(2, height)), colour, BAR)
        else:
            drawing.dot(axes.at(low, height), colour, BAR / 2)
    drawing.line("curve", axes.at(np.full(2, strip.best), np.array([0.4, 1.4])), ink.INK, 2.0)


def _beside(places: list[float], words: list[str], size: float) -> list[float]:
    """Return the middles of the labels of one or two walls: below these, or as far apart as the words are wide."""
    if len(places) < 2:
        return places
    missing = size * (CHARACTER * sum(map(len, words)) / 2.0 + MARGIN) - (places[1] - places[0])
    return [places[0] - max(0.0, missing) / 2.0, places[1] + max(0.0, missing) / 2.0]


def _said(strip: sr.Strip) -> str:
    down, up = f"{strip.sigma_low:.4g}", f"{strip.sigma_high:.4g}"
    shift = down if up in ("0", down) else up if down == "0" else f"{down} downwards and {up} upwards"
    unit = f" {strip.unit}" if strip.unit else ""
    disturbance_text = f"the disturbance alone moves it by {shift}{unit}; " if shift != "0" else ""
    if strip.short > 0.0:
        return (
            f"{disturbance_text}the best that the control does, {strip.best:.4g}{unit}, "
            f"still misses by {strip.short:.4g}{unit}"
        )
    return f"{disturbance_text}it can be met, but not together with the others"
