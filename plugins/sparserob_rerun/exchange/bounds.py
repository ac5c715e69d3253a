"""The two bounds with the gap between them shaded, and below them how the gap and the violation fall."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, final

import numpy as np

from sparserob_rerun.drawing import palette as ink
from sparserob_rerun.drawing.canvas import LEAST, Axes, Drawing
from sparserob_rerun.drawing.palette import Floats

if TYPE_CHECKING:
    import sparserob_core as sr

LEFT, WIDTH, HEIGHT, GAP = 74.0, 640.0, 136.0, 66.0
ABOVE = 36.0  # the caption, which is as wide as the plot, is above the highest number upwards
ONE = (-36.0, LEFT + WIDTH + 94.0, -64.0, HEIGHT + 62.0)
BOTH = (-36.0, LEFT + WIDTH + 94.0, -64.0, 2 * HEIGHT + GAP + 48.0)
"""Left, right, top and bottom of the bounds, and of both drawings."""
VIEW = 1.5  # the view reaches down by this many times the size of the best bound; first bounds may be far below
SMALLEST = 1e-12
ROOM = 1.15  # of words, in the panel of the first screen, which is smaller than the drawing
FEWEST = 5.0  # rounds on the axis at least


@final
class Bounds:
    """Draws below ``/rounds/picture``; it keeps the rounds that it has seen."""

    def __init__(self, rr: Any, stream: Any) -> None:
        self.rr, self.stream = rr, stream
        self.rows: list[tuple[float, float, float, float, float]] = []

    def add(self, event: sr.RoundFinished) -> None:
        """One more round: all of them are drawn anew. What is an upper bound of a program with less uncertainty only is
        none; the cost of a decision that was proven is one."""
        upper = min(np.inf if event.simplified else event.upper_bound, event.proven)
        self.rows.append((float(event.round), event.lower_bound, upper, event.gap, event.violation))
        self._draw(np.array(self.rows))

    def end(self, lower: float, upper: float, gap: float) -> None:
        """The bounds that the run ended with, and their gap: rounding, and what was proven last, have moved them. A run
        that was stopped in its first round has no other ones."""
        if np.isfinite(lower):
            number, *_, violation = self.rows.pop() if self.rows else (1.0, np.nan)
            self.rows.append((number, lower, upper, gap, violation))
            self._draw(np.array(self.rows))

    def _draw(self, rows: Floats) -> None:
        rounds, lower, upper, gap, violation = rows.T
        across = (0.5, max(float(rounds[-1]), FEWEST) + 0.5)
        above, below = Drawing(), Drawing()
        self._bounds(above, across, rounds, lower, upper)
        self._gaps(below, across, rounds, gap, violation)
        for name, drawing in (("bounds", above), ("gaps", below)):
            drawing.log(self.rr, self.stream, f"rounds/picture/{name}", layers=("tube", "frame", "marks", "curve"))

    def _bounds(
        self, drawing: Drawing, across: tuple[float, float], rounds: Floats, lower: Floats, upper: Floats
    ) -> None:
        known, best = lower[np.isfinite(lower)], float(upper.min())
        shown = np.concatenate([known, upper[np.isfinite(upper)]])
        high = float(shown.max()) if shown.size else 1.0
        low = (
            max(float(shown.min()), high - VIEW * abs(high)) if shown.size and high else float(min(known, default=0.0))
        )
        least = (LEAST * abs(high) - (high - low)) / 2.0  # a gap of 1e-8 is a line, and no panel full of it
        margin = max(0.1 * (high - low), least) if high > low else 0.5 * max(1.0, abs(high))
        axes = Axes(LEFT, 0.0, WIDTH, HEIGHT, across, (low - margin, high + margin))
        said = f"{_number(lower.max())} ≤ J* ≤ {_number(best)}"
        there, closes = np.isfinite(lower), bool(np.isfinite(best))
        shades = closes and there.sum() > 1
        drawing.frame(axes, "", "round", room=ROOM)
        caption = f"proven: {said}{'; the gap is shaded' if shades else ''}"
        drawing.text(axes.left + axes.width / 2, axes.top - ABOVE, caption)
        if closes:
            drawing.line("marks", axes.at(np.array(across), np.full(2, best)), ink.VERMILLION, 1.0)
        if shades:
            drawing.band("tube", axes, rounds[there], lower[there], np.full(int(there.sum()), best), ink.TUBE)
        for values, colour in ((lower, ink.GREEN), (upper, ink.VERMILLION)):
            there = np.isfinite(values)
            if there.any():
                drawing.line("curve", axes.at(rounds[there], values[there]), colour, 2.0)
                drawing.dot(axes.at(rounds[there], values[there]), colour, 4.0)

    def _gaps(
        self, drawing: Drawing, across: tuple[float, float], rounds: Floats, gap: Floats, violation: Floats
    ) -> None:
        falls = {"violation": (violation, ink.ORANGE), "relative gap": (gap, ink.SKY)}
        logs = {name: _decades(values) for name, (values, _) in falls.items()}
        known = np.concatenate([values[np.isfinite(values)] for values in logs.values()])
        low, high = (float(known.min()), float(known.max())) if known.size else (-6.0, 0.0)
        axes = Axes(LEFT, HEIGHT + GAP, WIDTH, HEIGHT, across, (np.floor(low - 0.3), np.ceil(high + 0.3)))
        drawing.frame(axes, "relative gap (blue) and worst violation (yellow)", "round", decades=True)
        for name, (_, colour) in falls.items():
            there = np.isfinite(logs[name])
            if there.any():
                drawing.line("curve", axes.at(rounds[there], logs[name][there]), colour, 2.0)
                drawing.dot(axes.at(rounds[there], logs[name][there]), colour, 4.0)


def _decades(values: Floats) -> Floats:
    """Decimal logarithms, NaN where there is nothing to see: not positive, or not finite."""
    shown = np.where(np.isfinite(values) & (values > 0.0), values, np.nan)
    return np.log10(np.maximum(shown, SMALLEST))


def _number(value: float) -> str:
    return f"{value:.8g}" if np.isfinite(value) else "unknown"
