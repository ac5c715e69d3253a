"""A maximiser at work: every value, the best of them, its own scalars, and where in the index space it looks."""

from __future__ import annotations

from typing import Any, final

import numpy as np

import sparserob_core as sr
from sparserob_rerun.drawing import palette as ink
from sparserob_rerun.drawing.palette import Colour, Floats
from sparserob_rerun.drawing.timelines import Timelines

MOVES = (
    4  # coordinates of one evaluation that are shown; a search that changes all of them at once would bury the panel
)
NOTES = {  # what a maximiser notes: the words for it, and its colour
    "temperature": ("temperature", ink.VERMILLION),
    "accepted": ("share of moves accepted (last 50)", ink.GREEN),
    "scale": ("size of a move", ink.SKY),
    "depth": ("depth of the opened cell", ink.SKY),
    "openings": ("cells opened", ink.GREEN),
    "hmax": ("deepest cells allowed", ink.GREY),
    "constant": ("Lipschitz constant", ink.VERMILLION),
    "rejected": ("share of points rejected", ink.GREEN),
    "spread": ("distance from the best point", ink.SKY),
    "ascent": ("number of the ascent", ink.GREEN),
    "start": ("number of the start", ink.GREEN),
    "slope": ("norm of the gradient", ink.SKY),
    "radius": ("radius of the trust region", ink.SKY),
    "step": ("0: global, 1: local step", ink.GREEN),
}
WINDOW = 50


@final
class SearchView:
    """Logs evaluations below ``/search`` in columns: one call for each batch and entity, whatever its size."""

    def __init__(self, rr: Any, stream: Any, timelines: Timelines) -> None:
        self.rr, self.stream, self.timelines = rr, stream, timelines
        self.base, self.known = 0, {"search/g"}
        self.recent = np.empty(0)
        stream.log(
            "search/g",
            rr.SeriesLines(
                names=["g of the tuple", "best so far", "proven lower bound"],
                colors=[ink.SKY, ink.ORANGE, ink.GREEN],
                widths=[1.0, 2.5, 2.0],
            ),
            static=True,
        )

    def show(self, event: sr.EvaluationsFinished, began: float, moving: dict[int, str], kept: np.ndarray) -> None:
        """Log a batch of a search that began ``began`` seconds after the run; of the points the coordinates ``kept``
        are there."""
        batch = event.batch.trace
        count = batch.values.size
        if event.total == event.count:
            self.base, self.recent = self.timelines.evaluation, np.empty(0)
        numbers = self.base + event.total - count + 1 + np.arange(count)
        at = self.timelines.columns(numbers, began + batch.seconds, event.round)
        values = np.stack(
            [_shown(batch.values), _shown(batch.best), np.full(count, _finite(event.lower_bound))], axis=1
        )
        self.stream.send_columns("search/g", at, self.rr.Scalars.columns(scalars=values.ravel()).partition([3] * count))
        self._notes(event, numbers, began)
        self._moves(event, numbers, moving, kept)
        self.timelines.move(self.base + event.total, event.round, began + event.seconds)

    def separation(self, event: sr.EvaluationsFinished, began: float) -> None:
        """A search for the worst index of one family: a series of its own, on the timeline of seconds only."""
        path, batch = f"separation/{event.family}", event.batch.trace
        self._line(path, f"violation of {event.family}", ink.VERMILLION)
        at = [self.rr.TimeColumn("time", duration=began + batch.seconds)]
        self.stream.send_columns(path, at, self.rr.Scalars.columns(scalars=_shown(batch.values)))

    def _notes(self, event: sr.EvaluationsFinished, numbers: np.ndarray, began: float) -> None:
        batch = event.batch.trace
        for name, rows in batch.notes.items():
            words, colour = NOTES.get(name, (name, ink.GREY))
            where = np.clip(rows[:, 0].astype(int) + self.base - numbers[0], 0, numbers.size - 1)
            values = self._share(rows[:, 1]) if name == "accepted" else rows[:, 1]
            self._line(f"search/notes/{name}", words, colour)
            at = self.timelines.columns(numbers[where], began + batch.seconds[where], event.round)
            self.stream.send_columns(f"search/notes/{name}", at, self.rr.Scalars.columns(scalars=_shown(values)))

    def _share(self, accepted: Floats) -> Floats:
        """The mean of the last accepted flags at each of the new ones."""
        joined = np.concatenate([self.recent, accepted])
        sums = np.concatenate([[0.0], np.cumsum(joined)])
        ends = np.arange(self.recent.size + 1, joined.size + 1)
        starts = np.maximum(ends - WINDOW, 0)
        self.recent = joined[-WINDOW:]
        return np.asarray((sums[ends] - sums[starts]) / (ends - starts))

    def _moves(
        self, event: sr.EvaluationsFinished, numbers: np.ndarray, moving: dict[int, str], kept: np.ndarray
    ) -> None:
        """The value of the coordinates that moved, one series for each kind: to which time, to which parameter."""
        trace, moves = event.batch.trace, event.batch.moves
        if not len(moves) or trace.points.shape[1:] != kept.shape:
            return
        kinds = kept[moves[:, 1]] % event.block
        for kind, name in moving.items():
            mine = _few(moves[kinds == kind])
            if not len(mine):
                continue
            path = f"search/moves/{name}"
            if path not in self.known:
                self.known.add(path)
                self.stream.log(
                    path,
                    self.rr.SeriesPoints(names=[f"{name} tried"], colors=[ink.PURPLE], marker_sizes=[2.0]),
                    static=True,
                )
            at = [self.rr.TimeColumn("evaluation", sequence=numbers[mine[:, 0]])]
            self.stream.send_columns(path, at, self.rr.Scalars.columns(scalars=trace.points[mine[:, 0], mine[:, 1]]))

    def _line(self, path: str, words: str, colour: Colour) -> None:
        if path not in self.known:
            self.known.add(path)
            self.stream.log(path, self.rr.SeriesLines(names=[words], colors=[colour], widths=[1.5]), static=True)


def _few(moves: np.ndarray) -> np.ndarray:
    """At most `MOVES` rows of each evaluation; rows are sorted by evaluation."""
    if not len(moves):
        return moves
    first = np.searchsorted(moves[:, 0], moves[:, 0], side="left")
    return moves[np.arange(len(moves)) - first < MOVES]


def _shown(values: Floats) -> Floats:
    """NaN, which a plot leaves out, in the place of infinite values, which would flatten it."""
    return np.where(np.isfinite(values), values, np.nan)


def _finite(value: float) -> float:
    return value if np.isfinite(value) else np.nan
