"""The climb of a search, one panel for each weight epsilon: every stage on a scale of its own, and all of them on the
screen."""

from __future__ import annotations

from typing import Any, final

import numpy as np

from sparserob_rerun.drawing import palette as ink
from sparserob_rerun.drawing.canvas import LEAST, Axes, Drawing, ticks
from sparserob_rerun.drawing.palette import Floats
from sparserob_rerun.search.way import Stage

WIDTH, HEIGHT, GAP = 1150.0, 240.0, 110.0
EXTENT = (-120.0, WIDTH + 50.0, -120.0, HEIGHT + 186.0)
LINE = 56.0  # units between two lines of words
ROOM = LINE - 26.0  # units above the axis across, without a number: those below it have their middle 26 units lower
CORNERS, POINTS = 500, 300  # of a curve, and of a cloud, in one panel
MOST = 4  # panels beside one another; of more stages the last ones


@final
class Climb:
    """Draws below ``/search/stages``: proposals as points, the walk and the best as lines, what is proven."""

    def __init__(self, rr: Any, stream: Any) -> None:
        self.rr, self.stream = rr, stream

    def draw(self, stages: list[Stage], exact: float | None = None) -> None:
        """All stages so far; ``exact``: the value of the program, where it is proven."""
        shown = [stage for stage in stages if np.isfinite(stage.values).any()][-MOST:]
        if not shown:
            return
        drawing, clouds = Drawing(), {"tried": list[Floats](), "refused": list[Floats]()}
        width = (WIDTH - GAP * (len(shown) - 1)) / len(shown)
        for place, stage in enumerate(shown):
            self._panel(drawing, clouds, stage, (place * (width + GAP), width), exact)
        hidden = len(stages) - len(shown)
        if hidden > 0:
            words = "1 earlier search is not shown" if hidden == 1 else f"{hidden} earlier searches are not shown"
            drawing.text(WIDTH / 2, HEIGHT + 26.0 + 2 * LINE, words, ink.GREY)
        drawing.log(
            self.rr, self.stream, "search/stages", layers=("frame", "restart", "bound", "exact", "best", "walk")
        )
        for name, colour, size in (("tried", ink.SKY, 1.4), ("refused", ink.REFUSED, 1.2)):
            points = np.concatenate([np.zeros((0, 2)), *clouds[name]])
            self.stream.log(
                f"search/stages/{name}",
                self.rr.Points2D(points, colors=[colour], radii=self.rr.Radius.ui_points(size), draw_order=8.0),
            )

    def _panel(
        self,
        drawing: Drawing,
        clouds: dict[str, list[Floats]],
        stage: Stage,
        place: tuple[float, float],
        exact: float | None,
    ) -> None:
        values, count = np.where(np.isfinite(stage.values), stage.values, np.nan), stage.values.size
        walk, best = stage.walk, np.fmax.accumulate(values)
        low, high = _limits(values, walk, best, [stage.lower_bound, np.nan if exact is None else exact])
        numbers: Floats = stage.base + 1.0 + np.arange(count, dtype=float)
        axes = Axes(place[0], 0.0, place[1], HEIGHT, (stage.base, stage.base + max(count, 2.0)), (low, high))
        _frame(drawing, axes, stage, float(best[-1]))
        for name, which in (("tried", ~stage.refused), ("refused", stage.refused)):
            mine = np.flatnonzero(which & (values >= low))
            few = mine[np.unique(np.linspace(0, mine.size - 1, POINTS).astype(int))] if mine.size else mine
            clouds[name].append(axes.at(numbers[few], values[few]))
        for row in stage.restarts:
            drawing.dashed("restart", axes.at(np.full(2, numbers[row]), np.array([low, high])), ink.PURPLE)
        for layer, colour, level in (("bound", ink.GREEN, stage.lower_bound), ("exact", ink.PURPLE, exact)):
            if level is not None and low <= level <= high:
                drawing.line(layer, axes.at(np.array(axes.x), np.full(2, level)), colour, 2.0)
        if np.isfinite(stage.lower_bound) and not low <= stage.lower_bound <= high:
            words = f"proven ≥ {stage.lower_bound:.5g}"  # below the panel: in a narrow one it lies over the walk
            drawing.text(place[0] + place[1] / 2, HEIGHT + 26.0 + LINE, words, ink.GREEN)
        if 0 < stage.searched < count:  # then its last share of the budget
            at = numbers[stage.searched - 1] + 0.5
            drawing.dashed("restart", axes.at(np.full(2, at), np.array([low, high])), ink.GREEN)
            x = float(axes.at(at, low)[0, 0])
            drawing.text(min(x, place[0] + place[1] - 30.0), HEIGHT - 60.0, "polish", ink.GREEN)
        few = _corners(best)
        drawing.line("best", axes.at(numbers[few], best[few]), ink.ORANGE, 2.5)
        known = np.flatnonzero(~np.isnan(walk))
        if known.size:
            few = known[_corners(walk[known])]
            drawing.line("walk", axes.at(numbers[few], np.maximum(walk[few], low)), ink.INK, 1.2)


def _frame(drawing: Drawing, axes: Axes, stage: Stage, best: float) -> None:
    """The box of a panel, with the weight and the best value above it and few ticks: it may be narrow."""
    left, top, right, bottom = axes.left, axes.top, axes.left + axes.width, axes.top + axes.height
    drawing.line("frame", np.array([[left, top], [left, bottom], [right, bottom]]), ink.GREY, 1.0)
    numbered = _numbered(axes, 4)
    for value in numbered if len(numbered) > 1 else _numbered(axes, 2 * 4):  # one number is no scale
        y = float(axes.at(axes.x[0], value)[0, 1])
        drawing.line("frame", np.array([[left - 5, y], [left, y]]), ink.GREY, 1.0)
        drawing.text(left - 48.0, y, f"{value:.7g}", ink.GREY)
    for value, x in ((axes.x[0], left + 8.0), (axes.x[1], right - 8.0)):
        drawing.text(x, bottom + 26.0, f"{value:.0f}", ink.GREY)
    middle = (left + right) / 2
    if np.isfinite(stage.epsilon) and stage.epsilon > 0.0:
        drawing.text(middle, top - 36.0 - LINE, f"epsilon {stage.epsilon:.3g}")
    drawing.text(middle, top - 36.0, f"best {best:.6g}", ink.ORANGE)


def _numbered(axes: Axes, most: int) -> list[float]:
    """Round numbers upwards that are written beside the axis: from the highest on those with a line of words between
    them, above the last number of the panel on the left."""
    found, below = list[float](), -np.inf
    for value in ticks(*axes.y, most)[::-1]:
        y = float(axes.at(axes.x[0], value)[0, 1])
        if below + LINE <= y < axes.top + axes.height - ROOM:
            found.append(float(value))
            below = y
    return found


def _corners(values: Floats) -> np.ndarray:
    """Which of the values ``(n,)`` a curve needs: the lowest and the highest of every stretch."""
    if values.size <= 2 * CORNERS:
        return np.arange(values.size)
    stretch = np.arange(values.size) * CORNERS // values.size
    order = np.lexsort((values, stretch))  # in each stretch from the lowest to the highest, NaN last
    order = order[np.isfinite(values[order])]
    change = np.flatnonzero(np.diff(stretch[order]))
    ends = order[np.concatenate([[0], change, change + 1, [order.size - 1]])] if order.size else order
    return np.unique(np.concatenate([[0], ends, [values.size - 1]]))


def _limits(values: Floats, walk: Floats, best: Floats, levels: list[float]) -> tuple[float, float]:
    """The range of a panel: that of the walk after the first twentieth, or of the better half of the values and of the
    best so far from then on, and what is proven where that is near."""
    top = float(np.nanmax(best))
    settled = walk[walk.size // 20 :]
    walked = bool(np.isfinite(settled).any())
    started = float(np.nanmin(best[best.size // 20 :]))  # what climbs to its end has passed its median late
    low = float(np.nanmin(settled)) if walked else min(float(np.nanquantile(values, 0.5)), started)
    span = max(top - low, LEAST * (abs(top) or 1.0))
    for level in levels:
        if np.isfinite(level):
            low, top = (min(low, level), top) if level >= top - 3.0 * span else (low, top)
            top = max(top, level) if level <= top + span else top
    span = max(top - low, LEAST * (abs(top) or 1.0))
    middle = (low + top) / 2.0
    return middle - 0.56 * span, middle + 0.56 * span
