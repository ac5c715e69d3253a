"""Picture of the two bounds with the gap between them shaded; below them, how the gap and the violation fall."""

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
    """Picture of the bounds below ``/rounds/picture``, with all rounds so far."""

    def __init__(self, rr: Any, stream: Any) -> None:
        self.rr, self.stream = rr, stream
        self.rows: list[tuple[float, float, float, float, float]] = []

    def add(self, event: sr.RoundFinished) -> None:
        """Add a round and draw all of them anew. The upper bound of a program with less uncertainty only is none; the
        cost of a decision that was proven is one."""
        upper = min(np.inf if event.simplified else event.upper_bound, event.proven)
        self.rows.append((float(event.round), event.lower_bound, upper, event.gap, event.violation))
        self._draw(np.array(self.rows))

    def end(self, lower: float, upper: float, gap: float) -> None:
        """Draw the bounds that the run ended with, and their gap: rounding, and what was proven last, have moved them.
        A run that was stopped in its first round has no other ones."""
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
        finite_lower, best = lower[np.isfinite(lower)], float(upper.min())
        finite_values = np.concatenate([finite_lower, upper[np.isfinite(upper)]])
        high = float(finite_values.max()) if finite_values.size else 1.0
        low = (
            max(float(finite_values.min()), high - VIEW * abs(high))
            if finite_values.size and high
            else float(min(finite_lower, default=0.0))
        )
        least_margin = (LEAST * abs(high) - (high - low)) / 2.0  # a gap of 1e-8 is a line, and no panel full of it
        margin = max(0.1 * (high - low), least_margin) if high > low else 0.5 * max(1.0, abs(high))
        axes = Axes(LEFT, 0.0, WIDTH, HEIGHT, across, (low - margin, high + margin))
        interval = f"{_number(lower.max())} ≤ J* ≤ {_number(best)}"
        is_finite, has_upper = np.isfinite(lower), bool(np.isfinite(best))
        is_shaded = has_upper and is_finite.sum() > 1
        drawing.frame(axes, "", "round", room=ROOM)
        caption = f"proven: {interval}{'; the gap is shaded' if is_shaded else ''}"
        drawing.text(axes.left + axes.width / 2, axes.top - ABOVE, caption)
        if has_upper:
            drawing.line("marks", axes.at(np.array(across), np.full(2, best)), ink.VERMILLION, 1.0)
        if is_shaded:
            drawing.band(
                "tube", axes, rounds[is_finite], lower[is_finite], np.full(int(is_finite.sum()), best), ink.TUBE
            )
        for values, colour in ((lower, ink.GREEN), (upper, ink.VERMILLION)):
            is_finite = np.isfinite(values)
            if is_finite.any():
                drawing.line("curve", axes.at(rounds[is_finite], values[is_finite]), colour, 2.0)
                drawing.dot(axes.at(rounds[is_finite], values[is_finite]), colour, 4.0)

    def _gaps(
        self, drawing: Drawing, across: tuple[float, float], rounds: Floats, gap: Floats, violation: Floats
    ) -> None:
        falls = {"violation": (violation, ink.ORANGE), "relative gap": (gap, ink.SKY)}
        logs = {name: _decades(values) for name, (values, _) in falls.items()}
        finite_logs = np.concatenate([values[np.isfinite(values)] for values in logs.values()])
        low, high = (float(finite_logs.min()), float(finite_logs.max())) if finite_logs.size else (-6.0, 0.0)
        axes = Axes(LEFT, HEIGHT + GAP, WIDTH, HEIGHT, across, (np.floor(low - 0.3), np.ceil(high + 0.3)))
        drawing.frame(axes, "relative gap (blue) and worst violation (yellow)", "round", decades=True)
        for name, (_, colour) in falls.items():
            is_finite = np.isfinite(logs[name])
            if is_finite.any():
                drawing.line("curve", axes.at(rounds[is_finite], logs[name][is_finite]), colour, 2.0)
                drawing.dot(axes.at(rounds[is_finite], logs[name][is_finite]), colour, 4.0)


def _decades(values: Floats) -> Floats:
    """Return decimal logarithms, NaN where there is nothing to see: not positive, or not finite."""
    shown = np.where(np.isfinite(values) & (values > 0.0), values, np.nan)
    return np.log10(np.maximum(shown, SMALLEST))


def _number(value: float) -> str:
    return f"{value:.8g}" if np.isfinite(value) else "unknown"
