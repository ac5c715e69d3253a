"""Pictures of a maximiser at work: every value, its walk, the best, its own scalars, and where in the index space it
looks."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, final

import numpy as np

import sparserob_core as sr
from sparserob_rerun.drawing import palette as ink
from sparserob_rerun.drawing.palette import Colour, Floats
from sparserob_rerun.drawing.timelines import Timelines
from sparserob_rerun.search.projection import Projection
from sparserob_rerun.search.way import Stage

MOVES = (
    4  # coordinates of one evaluation that are shown; a search that changes all of them at once would bury the panel
)
LOGARITHMIC = ("temperature", "scale", "constant", "radius", "reach", "slope", "step", "spread")
NOTES = {  # what a maximiser notes: the words for it, and its colour
    "temperature": ("log10 of the temperature", ink.VERMILLION),
    "accepted": ("share accepted of the last 50 moves that changed g", ink.GREEN),
    "scale": ("log10 of the size of a move, in widths of the box", ink.SKY),
    "move": ("share accepted of the last 50, by what was moved", ink.PURPLE),
    "acting": ("indices with a multiplier, in the polish", ink.ORANGE),
    "depth": ("depth of the opened cell", ink.SKY),
    "openings": ("cells opened", ink.GREEN),
    "hmax": ("deepest cells allowed", ink.GREY),
    "constant": ("log10 of the Lipschitz constant", ink.VERMILLION),
    "rejected": ("share of points rejected", ink.GREEN),
    "spread": ("log10 of the distance from the best point", ink.SKY),
    "ascent": ("number of the ascent", ink.GREEN),
    "start": ("number of the start", ink.GREEN),
    "slope": ("log10 of the largest slope", ink.SKY),
    "radius": ("log10 of the radius of the trust region", ink.SKY),
    "reach": ("log10 of the reach of a local step", ink.SKY),
    "step": ("log10 of the local step", ink.GREEN),
    "local": ("share of local steps among the last 50", ink.GREEN),
    "cycle": ("how often it was heated again", ink.GREY),
}
KINDS = {  # of the moves of a walk, as `move` numbers them: the words for what is moved, and the colour
    0: ("everything, drawn anew", ink.GREY),
    1: ("one coordinate", ink.SKY),
    2: ("several", ink.ORANGE),
    3: ("all, or all of an index", ink.PURPLE),
}
SILENT = ("stands",)  # what says where the walk is, and is drawn as such
SERIES: dict[str, tuple[str, Colour, float]] = {
    "walk": ("g where the walk stands", ink.INK, 1.5),
    "best": ("best so far", ink.ORANGE, 2.5),
    "bound": ("proven lower bound", ink.GREEN, 2.0),
}
CLOUDS: dict[str, tuple[str, Colour]] = {"tried": ("tried", ink.SKY), "refused": ("tried, refused", ink.VERMILLION)}
MEANS = ("accepted", "local")  # 0 or 1 at every evaluation, of which a mean says more
WINDOW = 50
STRAIGHT = 1e-9
"""Second difference, as a share of the largest value, below which a line is straight. Rounding alone gives more than a
tenth of it; ten times as much is not seen either."""


@final
class SearchView:
    """Series of evaluations below ``/search``, logged in columns: one call for each batch and entity, whatever its
    size."""

    def __init__(self, rr: Any, stream: Any, timelines: Timelines) -> None:
        self.rr, self.stream, self.timelines = rr, stream, timelines
        self.known, self.lines = set[str](), set[str]()
        self.notes, self.moved = set[str](), set[str]()  # what the maximiser has told, and what has moved
        self.recent = dict[str, Floats]()  # of each share what it is the mean of, the last of it
        self.of: Stage | None = None

    def show(
        self,
        event: sr.EvaluationsFinished,
        stage: Stage,
        began: float,
        moving: dict[int, str],
        projection: Projection,
    ) -> None:
        """Log a batch of a search that began ``began`` seconds after the run, of which the stage knows already; the
        ``projection`` says what has moved."""
        batch = event.batch.trace
        count = batch.values.size
        if stage is not self.of:
            if self.of is not None:
                self._break(stage.base)
            self.of, self.recent = stage, {}
        numbers = stage.base + event.total - count + 1 + np.arange(count)

        def at(which: np.ndarray) -> list[Any]:
            return self.timelines.columns(numbers[which], began + batch.seconds[which], event.round)

        refused = stage.refused[stage.values.size - count :]
        self._cloud("search/g/tried", at, np.where(refused, np.nan, batch.values), CLOUDS["tried"])
        self._cloud("search/g/refused", at, np.where(refused, batch.values, np.nan), CLOUDS["refused"])
        walk, best = stage.walk[stage.values.size - count :], batch.best
        for name, values, indices in (
            ("walk", walk, _corners(walk)),
            ("best", best, _corners(best)),
            ("bound", np.full(count, event.lower_bound), np.array([0, count - 1] if count > 1 else [0])),
        ):
            path = f"search/g/{name}"
            if path in self.known or np.isfinite(values).any():  # that a line is interrupted has to be sent as well
                self._line(path, *SERIES[name])
                self.stream.send_columns(path, at(indices), self.rr.Scalars.columns(scalars=_shown(values[indices])))
        self._notes(event, stage, numbers, began)
        self._moves(event, stage, numbers, began, moving, projection.moves)
        self.timelines.move(stage.base + event.total, event.round, began + event.seconds)

    def _break(self, base: int) -> None:
        """End every line after so many evaluations: what comes next is of another search, and nothing lies between."""
        at = self.timelines.columns(np.array([base]), np.array([self.timelines.seconds]), self.timelines.round)
        for path in sorted(self.lines):
            self.stream.send_columns(path, at, self.rr.Scalars.columns(scalars=np.array([np.nan])))

    def exact(self, value: float, epsilon: float, base: int) -> None:
        """Draw the proven value over the evaluations of the last search, before which there were ``base``."""
        self._line("search/g/exact", f"exact value (epsilon {epsilon:.3g})" if epsilon else "exact value", ink.PURPLE)
        at = [self.rr.TimeColumn("evaluation", sequence=np.array([base + 1, max(base + 2, self.timelines.evaluation)]))]
        self.stream.send_columns("search/g/exact", at, self.rr.Scalars.columns(scalars=np.full(2, value)))

    def separation(self, event: sr.EvaluationsFinished, began: float) -> None:
        """Log a search for the worst index of one family as a series of its own, on the timeline of seconds only."""
        path, batch = f"separation/{event.family}", event.batch.trace
        self._line(path, f"violation of {event.family}", ink.VERMILLION)
        at = [self.rr.TimeColumn("time", duration=began + batch.seconds)]
        self.stream.send_columns(path, at, self.rr.Scalars.columns(scalars=_shown(batch.values)))

    def _notes(self, event: sr.EvaluationsFinished, stage: Stage, numbers: np.ndarray, began: float) -> None:
        batch = event.batch.trace
        for name, rows in batch.notes.items():
            if name in SILENT:
                continue
            self.notes.add(name)
            words, colour = NOTES.get(name, (name, ink.GREY))
            positions = np.clip(rows[:, 0].astype(int) + stage.base - numbers[0], 0, numbers.size - 1)
            values = rows[:, 1]
            if name in MEANS:
                is_counted = (
                    event.batch.changes[positions] if name == "accepted" else np.ones(positions.size, dtype=bool)
                )
                positions, values = positions[is_counted], self._share(name, values[is_counted])
            if not values.size:
                continue
            if name in LOGARITHMIC:
                values = np.log10(np.where(values > 0.0, values, np.nan))
            path = f"search/notes/{name}"

            def at(which: np.ndarray, rows: np.ndarray = positions) -> list[Any]:
                indices = rows[which]
                return self.timelines.columns(numbers[indices], began + batch.seconds[indices], event.round)

            if name == "move":
                self._kinds(event, path, positions, values, at)
                continue
            self._line(path, words, colour)
            corners = _corners(values)
            self.stream.send_columns(path, at(corners), self.rr.Scalars.columns(scalars=_shown(values[corners])))

    def _kinds(
        self,
        event: sr.EvaluationsFinished,
        path: str,
        where: np.ndarray,
        kinds: Floats,
        at: Callable[[np.ndarray], list[Any]],
    ) -> None:
        """Draw the share of the moves of each of the ``kinds (k,)``, of those that changed g, that the walk
        accepted."""
        changes, accepted = event.batch.changes[where], event.batch.accepted[where].astype(float)
        for kind, (words, colour) in KINDS.items():
            indices = np.flatnonzero(changes & (kinds == kind))
            if indices.size:
                self._line(f"{path}/{kind}", words, colour)
                shares = self._share(f"{path}/{kind}", accepted[indices])
                self.stream.send_columns(f"{path}/{kind}", at(indices), self.rr.Scalars.columns(scalars=shares))

    def _share(self, of: str, flags: Floats) -> Floats:
        """Return the mean of the last flags ``of`` one kind at each of the new ones."""
        recent = self.recent.get(of, np.empty(0))
        joined = np.concatenate([recent, flags])
        sums = np.concatenate([[0.0], np.cumsum(joined)])
        ends = np.arange(recent.size + 1, joined.size + 1)
        starts = np.maximum(ends - WINDOW, 0)
        self.recent[of] = joined[-WINDOW:]
        return np.asarray((sums[ends] - sums[starts]) / (ends - starts))

    def _moves(
        self,
        event: sr.EvaluationsFinished,
        stage: Stage,
        numbers: np.ndarray,
        began: float,
        moving: dict[int, str],
        moves: Floats,
    ) -> None:
        """Draw where the coordinates went that moved ``(m, 3)``, one series for each kind: to which time or parameter.
        Of a walk, draw the moves that it accepted and that changed g."""
        rows = moves[:, 0].astype(int)
        is_accepted = ~stage.refused[stage.values.size - event.batch.trace.values.size :]
        moves = moves[(is_accepted & event.batch.changes if stage.walks else is_accepted)[rows]]
        for kind, name in moving.items():
            kind_moves = _few(moves[moves[:, 1] == kind])
            if not len(kind_moves):
                continue
            self.moved.add(name)

            def at(which: np.ndarray, rows: Floats = kind_moves) -> list[Any]:
                evaluations = rows[which, 0].astype(int)
                return self.timelines.columns(
                    numbers[evaluations], began + event.batch.trace.seconds[evaluations], event.round
                )

            self._cloud(f"search/moves/{name}", at, kind_moves[:, 2], (f"{name} of what moved", ink.PURPLE))

    def _line(self, path: str, words: str, colour: Colour, width: float = 1.5) -> None:
        if path not in self.known:
            self.known.add(path)
            self.lines.add(path)
            self.stream.log(
                path, self.rr.SeriesLines(names=[words], colors=[ink.legible(colour)], widths=[width]), static=True
            )

    def _cloud(
        self, path: str, at: Callable[[np.ndarray], list[Any]], values: Floats, style: tuple[str, Colour]
    ) -> None:
        """Draw points at those of the values ``(k,)`` that are finite; ``at`` makes the columns of times of these."""
        indices = np.flatnonzero(np.isfinite(values))
        if not indices.size:
            return
        if path not in self.known:
            self.known.add(path)
            words, colour = style
            points = self.rr.SeriesPoints(names=[words], colors=[ink.legible(colour)], marker_sizes=[1.5])
            self.stream.log(path, points, static=True)
        self.stream.send_columns(path, at(indices), self.rr.Scalars.columns(scalars=values[indices]))


def _few(moves: np.ndarray) -> np.ndarray:
    """Return at most `MOVES` rows of each evaluation; rows are sorted by evaluation."""
    if not len(moves):
        return moves
    first = np.searchsorted(moves[:, 0], moves[:, 0], side="left")
    return moves[np.arange(len(moves)) - first < MOVES]


def _corners(values: Floats) -> np.ndarray:
    """Return the indices of the values ``(k,)`` of a batch that a line needs: the first, the last, and those that are
    not between their neighbours on a straight line; of several in a row that are not finite the first."""
    shown = _shown(values)
    curvature, is_finite = np.abs(np.diff(shown, 2)), np.isfinite(shown)
    scale = np.max(np.abs(shown[is_finite]), initial=0.0)
    is_needed = np.ones(values.size, dtype=bool)
    is_needed[1:-1] = ~(curvature <= STRAIGHT * scale)  # what is beside a gap stays
    is_needed[1:] &= is_finite[1:] | is_finite[:-1]
    return np.flatnonzero(is_needed)


def _shown(values: Floats) -> Floats:
    """Replace infinite values, which would flatten a plot, by NaN, which it leaves out."""
    return np.where(np.isfinite(values), values, np.nan)
