"""Picture of runs of one problem: a line of its own for the bounds of each, over the same axes."""

from __future__ import annotations

import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any, final

import numpy as np

import sparserob_core as sr
from sparserob_rerun.drawing import palette as ink
from sparserob_rerun.drawing.palette import Colour, Floats
from sparserob_rerun.study.board import number
from sparserob_rerun.study.statuses import plainly

COLOURS: tuple[Colour, ...] = (ink.SKY, ink.VERMILLION, ink.GREEN, ink.PURPLE, ink.ORANGE, ink.GREY)
MARKERS = ("circle", "square", "diamond", "up", "plus", "cross")
"""Markers at the corners of each line: lines are told apart by them where their colours are not."""
MOST = 12
"""Runs that have a line. With ten times as many neither lines nor names can be told apart; with a tenth there is
nothing to compare."""
WIDEST, THINNEST = 3.5, 1.5  # points: lines that coincide are seen as the edges of one another
VIEW = 1.5
"""The axis of bounds reaches down by this many times the size of the best one. The first bounds of a search may be far
below: with ten times as much the last gains are flat, with a tenth the climb is cut off."""
RIM = 0.06  # of the axis of bounds, above and below what it shows
CLOSED = 1e-10
"""The least relative gap that is drawn. With a thousandth of it rounding is drawn, for bounds are proven to about 1e-9
of the cost; with a thousand times as much, gaps that close look like those that do not."""
NEAR = 1e-3  # of the least cost: a gap that is marked, as in the table of `sparserob compare`
BEYOND = 1.03  # of the longest run, to where the line of the optimum goes: the last step of a run is seen beside it
PROBLEM = ("problem", "dictionaries", "extends")
"""Keys of a config after whose change bounds are of another optimum."""


def folder_of_runs(event: sr.SweepStarted) -> Path | None:
    """Return where the runs of a study are, if they have one optimum, so that their bounds can be compared."""
    return None if any(key.split(".")[0] in PROBLEM for key in event.axes) else event.runs


@final
class SideBySide:
    """Picture of the finished runs of a study below ``/study/runs``."""

    def __init__(self, rr: Any, stream: Any, folder: Path) -> None:
        self.rr, self.stream, self.folder = rr, stream, folder
        self.comparison: sr.Comparison | None = None
        self.places: list[int] = []
        self.count = 0
        self.drawn = set[str]()

    @property
    def limits(self) -> tuple[float, float] | None:
        """Limits of the axis of bounds; ``None`` where no bound is known."""
        curve_bounds = [] if self.comparison is None else [curve.bound for curve in self.comparison.curves]
        bounds = np.concatenate(curve_bounds) if curve_bounds else np.empty(0)
        if self.comparison is None or not bounds.size:
            return None
        top = float(np.nanmax([self.target, bounds.max()]))
        low = max(float(bounds.min()), top - VIEW * abs(top)) if top else float(bounds.min())
        margin = RIM * max(top - low, 1e-9 * max(1.0, abs(top)))
        return low - margin, top + margin

    @property
    def target(self) -> float:
        """Cost to which gaps are relative: the exact optimum, or the least upper bound; NaN where there is neither."""
        if self.comparison is None or np.isfinite(self.comparison.exact):
            return math.nan if self.comparison is None else self.comparison.exact
        upper_bounds = [curve.upper_bound for curve in self.comparison.curves if np.isfinite(curve.upper_bound)]
        return min(upper_bounds, default=math.nan)

    @property
    def last(self) -> tuple[float, float]:
        """Evaluations and seconds at which the picture ends; 1 and 1 before anything is known."""
        ends = [] if self.comparison is None else [_end(curve) for curve in self.comparison.curves]
        evaluations, seconds = (max(column, default=0.0) or 1.0 for column in zip(*ends or [(0.0, 0.0)], strict=True))
        return BEYOND * evaluations, BEYOND * seconds

    def draw(self, rows: Mapping[int, Mapping[str, Any]]) -> None:
        """Draw the lines of the runs that have come since the last picture, by the ``rows`` of their points."""
        runs = {str(row["run"]): point for point, row in sorted(rows.items(), reverse=True) if _has_run(row)}
        self.count, points = len(runs), sorted(runs.values())[:MOST]
        if points == self.places or not points:
            return
        comparison = sr.compare([self.folder / str(rows[point]["run"]) for point in points])
        if not isinstance(comparison, sr.Comparison):
            return
        self.comparison, self.places = comparison, points
        for point, curve, label in zip(points, comparison.curves, comparison.labels, strict=True):
            self._line(f"study/runs/bound/{point}", point, curve, label, curve.bound)
        self.stream.log(
            "study/runs/words", self.rr.TextDocument(self._words(), media_type="text/markdown"), static=True
        )

    def finish(self) -> None:
        """Draw what is known once all runs are over: the least cost, and how the gap to it closes."""
        comparison, target = self.comparison, self.target
        if comparison is None or not np.isfinite(target):
            return
        name = "exact optimum" if np.isfinite(comparison.exact) else "least upper bound"
        last = np.array(self.last)
        self._styled("study/runs/bound/target", f"{name} {target:.9g}", ink.INK, 1.0)
        evaluations, seconds = np.stack([np.zeros(2), last], axis=1)
        self._send("study/runs/bound/target", evaluations, seconds, np.full(2, target))
        if not target:
            return
        self._styled("study/runs/gap/close", f"{NEAR:.1%} of it", ink.GREY, 1.0)
        self._send("study/runs/gap/close", evaluations, seconds, np.full(2, np.log10(NEAR)))
        for point, curve, label in zip(self.places, comparison.curves, comparison.labels, strict=True):
            gap = np.maximum((target - curve.bound) / abs(target), CLOSED)
            self._line(f"study/runs/gap/{point}", point, curve, label, np.log10(gap))

    def _line(self, path: str, place: int, curve: Any, label: str, values: Floats) -> None:
        """Draw the line of a run through its ``values``, as steps, to the end of the run; its name may change later."""
        if not values.size:
            return
        width = max(THINNEST, WIDEST - 0.5 * place)
        self._styled(path, label, COLOURS[place % len(COLOURS)], width, MARKERS[place % len(MARKERS)])
        if path not in self.drawn:
            self.drawn.add(path)
            end = _end(curve)
            self._send(
                path,
                np.append(curve.evaluations, end[0]),
                np.append(curve.seconds, end[1]),
                np.append(values, values[-1]),
            )

    def _styled(self, path: str, name: str, colour: Colour, width: float, marker: str = "") -> None:
        rr, shown = self.rr, ink.legible(colour)
        lines = rr.SeriesLines(names=[name], colors=[shown], widths=[width], interpolation_mode="StepAfter")
        points = (
            [rr.SeriesPoints(names=[name], colors=[shown], markers=[marker], marker_sizes=[width])] if marker else []
        )
        self.stream.log(path, lines, *points, static=True)

    def _send(self, path: str, evaluations: Floats, seconds: Floats, values: Floats) -> None:
        at = [
            self.rr.TimeColumn("evaluation", sequence=np.rint(evaluations).astype(np.int64)),
            self.rr.TimeColumn("time", duration=seconds),
        ]
        self.stream.send_columns(path, at, self.rr.Scalars.columns(scalars=values))

    def _words(self) -> str:
        """Describe what is compared, how it ended, and in what the configs differ, in Markdown."""
        comparison = self.comparison
        if comparison is None:
            return "no run is finished yet"
        unit = f" {plainly(comparison.cost_unit)}" if comparison.cost_unit else ""
        paragraphs = [f"### {plainly(comparison.title or 'Runs of one problem')}", self._known(unit)]
        for index, (curve, label) in enumerate(zip(comparison.curves, comparison.labels, strict=True)):
            differences = "; ".join(
                f"{plainly(key)} {plainly(values[index])}" for key, values in comparison.differences
            )
            paragraphs.append(
                f"**{plainly(label)}**: {_verdict(curve)}{unit}; {_spent(curve)}"
                + (f"\n\n*{differences}*" if differences else "")
            )
        note = f"The first {MOST} runs have lines." if self.count > MOST else ""
        return "\n\n".join([*paragraphs, f"{HELP} {note}".rstrip()])

    def _known(self, unit: str) -> str:
        comparison = self.comparison
        if comparison is None or comparison.certified is None:
            return "No run is certified: the exact optimum is not known."
        best = plainly(comparison.labels[comparison.certified])
        return f"**Exact optimum {comparison.exact:.9g}{unit}**, certified by {best}."


HELP = (
    "Each run has a line of its own, in its colour and with its mark: the best lower bound that it has proven so far."
    " Higher is better. Below its verdict is in what its config differs from the others."
    f" The grey line of the lower picture is a gap of {NEAR:.1%}."
    " Two timelines can be chosen at the lower left. On *evaluation* are the evaluations of g, or the relaxed programs"
    " of a method that does not search. On *time* are the seconds since the start of each run."
)


def _has_run(row: Mapping[str, Any]) -> bool:
    return bool(row.get("run")) and row.get("status") != "failed"


def _end(curve: Any) -> tuple[float, float]:
    """Return the evaluations and the seconds after which a run was over; 0 where they are not known."""
    columns = ((curve.evaluations, curve.all_evaluations), (curve.seconds, curve.all_seconds))
    first, second = (float(np.nanmax([*values[-1:], total, 0.0])) for values, total in columns)
    return first, second


def _verdict(curve: Any) -> str:
    return f"{curve.status}, {number(curve.lower_bound, '−∞')} ≤ J\\* ≤ {number(curve.upper_bound, '∞')}"


def _spent(curve: Any) -> str:
    """Write in words what a run took."""
    unit = "evaluations of g" if curve.searched else "relaxed programs"
    return f"{number(curve.all_evaluations, '?')} {unit}, {curve.all_seconds:.3g} s"


def tab(shown: SideBySide | None) -> Any:
    """Return the tab of the runs side by side, as far as is known of them."""
    import rerun.blueprint as rrb

    limits, comparison = (None, None) if shown is None else (shown.limits, shown.comparison)
    unit = f" [{comparison.cost_unit}]" if comparison is not None and comparison.cost_unit else ""
    ranges = [] if shown is None else _ranges(rrb, *shown.last)
    across = "over evaluations or seconds (across)"
    plots = [
        rrb.TimeSeriesView(
            origin="/study/runs/bound",
            name=f"Best proven lower bound of J{unit} (up) {across}",
            plot_legend=rrb.Corner2D.RightBottom,
            axis_y=None if limits is None else rrb.ScalarAxis(range=limits),
            time_ranges=ranges or None,
        )
    ]
    if shown is not None and any("/gap/" in path for path in shown.drawn):
        reference = (
            "the exact optimum" if comparison is not None and np.isfinite(comparison.exact) else "the least upper bound"
        )
        name = f"log10 of the relative gap to {reference} (up) {across}"
        legend = rrb.PlotLegend(visible=False)  # the colours are those above
        plots.append(
            rrb.TimeSeriesView(origin="/study/runs/gap", name=name, plot_legend=legend, time_ranges=ranges or None)
        )
    words = rrb.TextDocumentView(origin="/study/runs/words", name="What is compared")
    return rrb.Horizontal(
        rrb.Vertical(*plots, row_shares=[3, 2][: len(plots)]),
        words,
        column_shares=[5, 3],
        name="Runs side by side",
    )


def _ranges(rrb: Any, evaluations: float, seconds: float) -> list[Any]:
    """Return what is shown on either timeline: all of the runs, and nothing beyond them, wherever the cursor is."""
    boundary = rrb.TimeRangeBoundary.absolute
    return [
        rrb.VisibleTimeRange("evaluation", start=boundary(seq=0), end=boundary(seq=int(np.ceil(evaluations)))),
        rrb.VisibleTimeRange("time", start=boundary(seconds=0.0), end=boundary(seconds=seconds)),
    ]
