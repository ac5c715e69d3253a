"""The status map of a study: costs along one axis, cells over two, points that were drawn, or a table."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any, final

import numpy as np

from sparserob_rerun.drawing import palette as ink
from sparserob_rerun.drawing.canvas import Axes, Drawing
from sparserob_rerun.drawing.canvas import ticks as round_numbers
from sparserob_rerun.drawing.palette import Floats
from sparserob_rerun.study.statuses import COLOURS, legend, mark, plainly, said

if TYPE_CHECKING:
    import sparserob_core as sr

LEFT, WIDTH, HEIGHT = 150.0, 620.0, 330.0
EXTENT = (0.0, LEFT + WIDTH + 40.0, -62.0, HEIGHT + 116.0)
"""Left, right, top and bottom of the map."""
LETTER = 8.0  # pixels, about
VEIL = 8.0  # pixels by which the veil behind words is wider than they are
CORNER = 9.0  # pixels of a mark from the corner of a cell that has words
SHADE = 0.35  # of the colour of a status, for a cell: words are bright, and are to be read on it
LINE = 22.0  # pixels between two labels above one another
MARKED = 14.0  # pixels of a cell from which on it has room for a mark
COSTED = 68.0  # pixels of a cell's width from which on its cost and gap fit into it
LINES = 60  # of the table
EMPTY: ink.Colour = (48, 52, 60, 255)
FEASIBLE = ("certified", "verified")
DECADES = 3.0  # between costs from which on their axis is logarithmic
NARROW = 1e-3
"""Least distance by which an axis of costs goes beyond a cost, as a share of it. With a thousandth of it all numbers
beside the axis are the same, and a closed gap looks wide; with a hundred times as much, costs that differ by per cent
look the same."""
NAMED = 42.0  # pixels of the name of an axis below it, under its numbers


@final
class Scale:
    """Axis of a study as an axis of a picture: numbers by their size or their logarithm, others, and those of cells, in
    a ``row``."""

    def __init__(self, key: str, values: Sequence[Any], logarithmic: bool, drawn: bool, row: bool) -> None:
        numbers = all(isinstance(value, int | float) and not isinstance(value, bool) for value in values)
        self.key, self.drawn, self.numeric = key, drawn, numbers and not row
        self.log = self.numeric and logarithmic and min(values, default=0) > 0
        distinct = {repr(value): value for value in values}
        self.values = sorted(distinct.values()) if numbers else list(distinct.values())
        self.places = {repr(value): index for index, value in enumerate(self.values)}
        positions = [self.at(value) for value in self.values] or [0.0, 1.0]
        rim = (0.06 * (max(positions) - min(positions)) if self.numeric else 0.5) or 0.5
        self.limits = (min(positions) - rim, max(positions) + rim)

    def at(self, value: Any) -> float:
        """Return the position of a value on the axis."""
        if not self.numeric:
            return float(self.places[repr(value)])
        return float(np.log10(value)) if self.log else float(value)

    def ticks(self, at: Any, room: float) -> list[tuple[float, str]]:
        """Return the pixels, by ``at``, of values that are not too close to one another, and their labels."""
        candidates = [(self.at(value), said(value)) for value in self.values]
        if self.drawn and self.numeric:
            candidates = [
                (float(value), f"{10.0**value if self.log else value:.6g}") for value in round_numbers(*self.limits)
            ]
        labels = list[tuple[float, str]]()
        for position, words in candidates:
            pixel = float(at(position))
            width = max(room, LETTER * len(words) + VEIL if room > LINE else 0.0)
            if not labels or abs(pixel - labels[-1][0]) >= width:
                labels.append((pixel, words))
        return labels


@final
class Board:
    """Map of one study."""

    def __init__(self, event: sr.SweepStarted) -> None:
        self.event, self.drawn = event, event.arrangement in ("random", "sobol")
        count = 1 if event.arrangement == "zip" else len(event.axes)
        columns: list[Sequence[Any]] = list(zip(*event.points, strict=True)) or [()] * len(event.axes)
        anywhere = self.drawn or event.arrangement == "search"  # round numbers on the axes, since values are none
        self.scales = [
            Scale(key, values, log, anywhere, row=count == 2 and not self.drawn)
            for key, values, log in zip(event.axes[:count], columns[:count], event.logarithmic[:count], strict=True)
        ]
        self.kind = "table"
        if len(self.scales) == 1:
            self.kind = "line"
        elif len(self.scales) == 2:
            self.kind = "points" if self.drawn else "cells"
        self.boxes: tuple[list[Floats], list[ink.Colour]] = ([], [])
        self.half, self.thick = np.zeros(2), 0.0

    def statuses(self, rows: Mapping[int, Mapping[str, Any]], now: Sequence[int]) -> list[str]:
        """Return the status of every point, in their order."""
        running = set(now)
        return [
            "running" if point in running else str(rows[point]["status"]) if point in rows else "waiting"
            for point in range(len(self.event.points))
        ]

    def draw(self, rows: Mapping[int, Mapping[str, Any]], now: Sequence[int]) -> Drawing:
        """Draw the picture of what is known. ``boxes`` holds the cells, as centres and colours; they are filled by
        lines ``thick`` to each side about rectangles of ``half`` the size."""
        drawing, statuses = Drawing(), self.statuses(rows, now)
        below = HEIGHT + 72.0
        if self.kind == "line":
            self._line(drawing, rows, statuses)
        elif self.kind == "cells":
            self._cells(drawing, rows, statuses)
        else:
            axes = self._axes(self.scales[1].limits)
            self._upwards(drawing, axes, self.scales[1])
            for values, status in zip(self.event.points, statuses, strict=True):
                mark(drawing, axes.at(*self._at(values))[0], status)
        legend(drawing, LEFT, below, Counter(statuses))
        return drawing

    def table(self, rows: Mapping[int, Mapping[str, Any]], newest: Sequence[int]) -> str:
        """Return the newest points as a table in Markdown, for a study with many axes."""
        head = [*map(plainly, self.event.axes), "status", "cost J", "proven lower bound"]
        lines = [" | ".join(head), " | ".join("---" for _ in head)]
        for point in newest[:LINES]:
            row = rows[point]
            cells = [*(plainly(said(value)) for value in self.event.points[point]), str(row["status"])]
            lines.append(" | ".join([*cells, number(row.get("cost")), number(row.get("lower_bound"))]))
        if not newest:
            lines.append(" | ".join(["no point is finished yet", *("" for _ in head[1:])]))
        return "\n".join(f"| {line} |" for line in lines)

    def _at(self, values: Sequence[Any]) -> tuple[float, float]:
        return self.scales[0].at(values[0]), self.scales[1].at(values[1])

    def _axes(self, y: tuple[float, float]) -> Axes:
        return Axes(LEFT, 0.0, WIDTH, HEIGHT, self.scales[0].limits, y)

    def _along(self, drawing: Drawing, axes: Axes) -> None:
        """Draw the box, and the axis at the bottom."""
        right, bottom = axes.left + axes.width, axes.top + axes.height
        drawing.line("frame", np.array([[axes.left, axes.top], [axes.left, bottom], [right, bottom]]), ink.GREY, 1.0)
        for x, words in self.scales[0].ticks(lambda value: axes.at(value, axes.y[0])[0, 0], 40.0):
            drawing.line("frame", np.array([[x, bottom], [x, bottom + 5]]), ink.GREY, 1.0)
            drawing.text(x, bottom + 15, words, ink.GREY)
        also = f" (with {', '.join(self.event.axes[1:])})" if self.event.arrangement == "zip" else ""
        key = self.scales[0].key + also + (", logarithmic" if self.scales[0].log else "")
        drawing.text((axes.left + right) / 2, bottom + NAMED, key, ink.GREY)

    def _upwards(self, drawing: Drawing, axes: Axes, scale: Scale) -> None:
        """Draw both axes, the second of them upwards."""
        self._along(drawing, axes)
        for y, words in scale.ticks(lambda value: axes.at(axes.x[0], value)[0, 1], LINE):
            drawing.line("frame", np.array([[axes.left - 5, y], [axes.left, y]]), ink.GREY, 1.0)
            drawing.text(axes.left - 14 - LETTER * len(words) / 2, y, words, ink.GREY)
        key = scale.key + (", logarithmic" if scale.log else "")
        drawing.text(max(axes.left, LETTER * len(key) / 2), axes.top - 34, key, ink.GREY)

    def _cells(self, drawing: Drawing, rows: Mapping[int, Mapping[str, Any]], statuses: Sequence[str]) -> None:
        """Draw a cell for each pair of values, in rows and columns of equal width, with the cost and the gap where
        there is room for them."""
        across, up = (len(scale.values) for scale in self.scales)
        axes = self._axes(self.scales[1].limits)
        half = np.array([axes.width / across, axes.height / up]) / 2.0 * 0.92
        self.thick = float(half.min()) / 2.0
        self.half = half - self.thick
        self._upwards(drawing, axes, self.scales[1])
        self.boxes = ([], [])
        width, height = (half * 2.0).tolist()
        for point, (values, status) in enumerate(zip(self.event.points, statuses, strict=True)):
            centre = axes.at(*self._at(values))[0]
            self.boxes[0].append(centre)
            self.boxes[1].append(EMPTY if status in ("waiting", "running") else shaded(status))
            texts = _told(rows.get(point, {})) if status not in ("waiting", "running") else []
            texts = texts[: int(height / LINE)] if width >= COSTED else []
            if half.min() * 2.0 >= MARKED and status != "waiting":
                corner = np.array([CORNER - width / 2.0, CORNER - height / 2.0])
                mark(drawing, centre + corner if texts else centre, status)
                for line, words in enumerate(texts):
                    drawing.text(centre[0], centre[1] + LINE * (line + 0.5 * (1 - len(texts))), words)
            elif status == "running":
                drawing.dot(centre[np.newaxis], ink.INK, 2.0)

    def _line(self, drawing: Drawing, rows: Mapping[int, Mapping[str, Any]], statuses: Sequence[str]) -> None:
        """Draw costs and proven lower bounds against the first axis; points without a cost at the lower edge."""
        scale = self.scales[0]
        costs = {point: float(row["cost"]) for point, row in rows.items() if row.get("cost") is not None}
        lower = {point: float(rows[point]["lower_bound"]) for point in costs if _known(rows[point].get("lower_bound"))}
        is_logarithmic = bool(costs) and min(costs.values()) > 0.0
        is_logarithmic = is_logarithmic and max(costs.values()) >= 10.0**DECADES * min(costs.values())
        values, least = list(costs.values()), min(costs.values(), default=0.0)
        span = max(max(values, default=0.0) - least, 0.5 * max(map(abs, values), default=0.0))
        values += [max(bound, least if is_logarithmic else least - span) for bound in lower.values()]
        heights = [float(np.log10(max(cost, least))) if is_logarithmic else cost for cost in values]
        low, high = min(heights, default=0.0), max(heights, default=1.0)
        axes = self._axes(about(low, high, 0.12))
        title = "cost J, down to its proven lower bound" if costs else "cost J: no point has one yet"
        title += self._critical(drawing, axes, rows)
        self._along(drawing, axes)
        for value in round_numbers(*axes.y) if costs else ():
            y = float(axes.at(axes.x[0], value)[0, 1])
            drawing.line("frame", np.array([[LEFT - 5, y], [LEFT, y]]), ink.GREY, 1.0)
            drawing.text(LEFT - 34, y, f"{10.0**value if is_logarithmic else value:.6g}", ink.GREY)
        drawing.text(LEFT + WIDTH / 2, -14.0, title)

        def height(value: float) -> float:
            return float(np.log10(max(value, 10.0 ** axes.y[0]))) if is_logarithmic else value

        joined = sorted((scale.at(self.event.points[point][0]), height(cost)) for point, cost in costs.items())
        if scale.numeric and len(joined) > 1 and not self.drawn:
            drawing.line("curve", axes.at(*np.array(joined).T), ink.FAINT, 1.0)
        for point, status in enumerate(statuses):
            x = scale.at(self.event.points[point][0])
            if point in costs and status != "running":
                pixel = axes.at(x, height(costs[point]))[0]
                if point in lower:
                    foot = axes.at(x, height(lower[point]))[0]
                    drawing.line("bounds", np.array([pixel, foot]), ink.GREEN, 1.5)
                    drawing.line("bounds", foot + np.array([[-5.0, 0.0], [5.0, 0.0]]), ink.GREEN, 1.5)
            else:
                pixel = axes.at(x, axes.y[0])[0] - np.array([0.0, 8.0])
            mark(drawing, pixel, status)

    def bracket(self, rows: Mapping[int, Mapping[str, Any]]) -> tuple[float, float]:
        """Return the bracket of a search for a critical value: the last one that is proven feasible, and the first that
        is proven infeasible; NaN where there is none."""
        largest = self.event.sense == "largest"
        values = {point: float(self.event.points[point][0]) for point in rows}
        feasible = [value for point, value in values.items() if rows[point]["status"] in FEASIBLE]
        infeasible = [value for point, value in values.items() if rows[point]["status"] == "infeasible"]
        ends = (max, min) if largest else (min, max)
        return ends[0](feasible, default=np.nan), ends[1](infeasible, default=np.nan)

    def _critical(self, drawing: Drawing, axes: Axes, rows: Mapping[int, Mapping[str, Any]]) -> str:
        """Hatch what is proven infeasible; say between which values the critical one is."""
        if not self.event.sense:
            return ""
        feasible, infeasible = self.bracket(rows)
        if np.isfinite(infeasible):
            low, high = (infeasible, axes.x[1]) if self.event.sense == "largest" else (axes.x[0], infeasible)
            drawing.hatched("hatch", axes, (low, high), axes.y, ink.HATCH)
            edge = axes.at(np.full(2, infeasible), np.array(axes.y))
            drawing.line("frame", edge, ink.VERMILLION, 1.5)
        if np.isfinite([feasible, infeasible]).all():
            low, high = sorted((feasible, infeasible))
            return f"; critical between {low:.7g} and {high:.7g}; hatched: infeasible"
        if np.isfinite(infeasible):
            return "; hatched: infeasible"
        return f"; feasible at {feasible:.7g}" if np.isfinite(feasible) else ""


def about(low: float, high: float, rim: float) -> tuple[float, float]:
    """Return the limits of an axis of costs from ``low`` to ``high``, with a ``rim``, a share of their distance."""
    margin = max(rim * (high - low), NARROW * max(abs(low), abs(high))) or 0.5
    return low - margin, high + margin


def shaded(status: str) -> ink.Colour:
    """Return the colour of a cell with that status."""
    red, green, blue = (round(SHADE * channel) for channel in COLOURS.get(status, ink.INK)[:3])
    return red, green, blue, 255


def _told(row: Mapping[str, Any]) -> list[str]:
    """Write the cost of a point and its relative gap, as far as they are known, in a few digits."""
    cost, gap = row.get("cost"), row.get("gap")
    if not _known(cost):
        return []
    return [f"{cost:.4g}", *([f"gap {gap:.0e}".replace("e-0", "e-")] if _known(gap) else [])]


def number(value: Any, unknown: str = "-") -> str:
    """Write a number in a few digits, or ``unknown`` for one that is not known."""
    return f"{value:.7g}" if _known(value) else unknown


def _known(value: Any) -> bool:
    return isinstance(value, int | float) and bool(np.isfinite(value))
