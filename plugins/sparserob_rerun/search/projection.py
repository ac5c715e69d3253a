"""Projection of a search onto the coordinates of the map: where the two indices are that decide most in each of its
tuples.

Of a tuple only the coordinates that a map may have travel to the process that records (`thin`), never those of its
disturbances: all else is computed there, and takes no time from the search.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from itertools import islice
from typing import final

import numpy as np

import sparserob_core as sr
from sparserob_rerun.drawing.palette import Floats

REMEMBERED = 20_000
"""Evaluated tuples whose deciding indices are remembered for cells around them, 200 bytes each. With a tenth of it most
cells of a search by partition are older; with ten times as many they take 40 MB."""
DIGITS = 1e7
"""Number of parts of a box by which two tuples are told apart: ten times fewer mix neighbours in deep cells, ten times
more lose those whose middle was rounded."""


@final
@dataclass(frozen=True, eq=False)
class Outlines:
    """Sketch of ``count`` things, over the places of the indices that decide at the middle of each: points, boxes or
    ellipses from ``lower (k, 2, c)`` to ``upper``."""

    lower: Floats
    upper: Floats
    rounded: bool
    points: bool
    count: int


@final
@dataclass(frozen=True, eq=False)
class Projection:
    """Evaluated tuples in the coordinates of a map. ``coordinates (c,)``: which coordinates of an index are told.

    ``places (n, 2, c)``: where in each tuple the two indices are that decide most, ``slots (n, 2)``: which they are.
    ``moves (m, 3)``: rows (evaluation in the batch, coordinate of an index, its value): what moved.
    """

    coordinates: tuple[int, ...] = ()
    places: Floats = field(default_factory=lambda: np.zeros((0, 2, 0)))
    slots: np.ndarray = field(default_factory=lambda: np.zeros((0, 2), dtype=int))
    moves: Floats = field(default_factory=lambda: np.zeros((0, 3)))
    sketches: Mapping[str, Outlines] = field(default_factory=dict)


def thin(event: sr.EvaluationsFinished) -> sr.EvaluationsFinished:
    """Return the event with points, domain and sketches over the ``coordinates`` of each index only, the others left
    out; without any of them where there is no map of it."""
    batch, domain, width = event.batch, event.domain, len(event.coordinates)
    count = sum(len(values) for values in batch.values)
    values = [np.concatenate(list(batch.values))] if count else []
    if domain is None or not width or len(event.deciding) != count or not count:
        empty = replace(batch, points=[np.zeros((count, 0))], values=values, origin=None)
        return replace(event, domain=None, sketches={}, deciding=event.deciding[:0], batch=empty)
    starts = np.arange(0, domain.dimension, event.block)[:, np.newaxis]
    columns = (starts + np.array(event.coordinates)).ravel()
    points = np.concatenate(list(batch.points))[:, columns]
    origin = None if batch.origin is None else batch.origin[columns]
    return replace(
        event,
        domain=sr.Box(domain.lower[columns], domain.upper[columns]),
        batch=replace(batch, points=[points], values=values, origin=origin),
        sketches={role: _thinned(sketch, columns) for role, sketch in event.sketches.items()},
    )


def _thinned(sketch: sr.Sketch, columns: np.ndarray) -> sr.Sketch:
    lower = sketch.lower[:, columns]
    return sr.Sketch(lower, lower if sketch.points else sketch.upper[:, columns], sketch.rounded)


@final
class Projector:
    """Projector of the events of searches, `thin` ones; it remembers of evaluated tuples which of their indices
    decide."""

    def __init__(self) -> None:
        self.pair, self.known = (0, 0), dict[int, tuple[int, int]]()

    def of(self, event: sr.EvaluationsFinished) -> Projection:
        """Return what is drawn of an event."""
        if event.domain is None:
            return Projection()
        count, width = event.count, len(event.coordinates)
        lower, upper = event.domain.lower, event.domain.upper
        if event.total == count:
            self.pair, self.known = (0, min(1, lower.size // width - 1)), {}
        points = event.batch.trace.points
        tuples = points.reshape(count, -1, width)
        slots = sr.deciding_slots(event.deciding, tuples, (upper - lower)[:width], self.pair)
        self.pair = (int(slots[-1, 0]), int(slots[-1, 1]))
        self.known.update(zip(_keys(points, lower, upper).tolist(), map(tuple, slots.tolist()), strict=True))
        for key in list(islice(self.known, max(0, len(self.known) - REMEMBERED))):
            del self.known[key]
        rows, coordinates = event.batch.moves.T
        moves = np.column_stack([rows, np.array(event.coordinates)[coordinates % width], points[rows, coordinates]])
        sketches = {role: self._outlines(sketch, event.domain, width) for role, sketch in event.sketches.items()}
        places = tuples[np.arange(count)[:, np.newaxis], slots]
        return Projection(event.coordinates, places, slots, moves, sketches)

    def _outlines(self, sketch: sr.Sketch, box: sr.Box, width: int) -> Outlines:
        lower, upper = sketch.lower, sketch.upper
        keys = _keys((lower + upper) / 2, box.lower, box.upper)
        pairs = np.array([self.known.get(int(key), self.pair) for key in keys]).reshape(-1, 2)
        selection = np.arange(len(pairs))[:, np.newaxis], pairs
        low, high = (side.reshape(len(pairs), -1, width)[selection] for side in (lower, upper))
        return Outlines(low, high, sketch.rounded, sketch.points, len(pairs))


def _keys(plain: Floats, lower: Floats, upper: Floats) -> np.ndarray:
    """Return numbers ``(k,)`` by which tuples ``(k, d)`` are found again, whatever rounding did to their last
    digits."""
    weights = np.cos(np.arange(1.0, plain.shape[1] + 1.0))  # so that no two coordinates of a grid make up for another
    return np.round(((plain - lower) / (upper - lower)) @ weights * DIGITS).astype(np.int64)


def outlines_on(axes: sr.LandscapeAxes, told: tuple[int, ...], sketch: Outlines) -> tuple[Floats, Floats] | None:
    """Return the corners ``(k, 2)`` of a sketch on a map, lower and upper; ``None`` where its coordinates are not among
    those ``told``."""
    if not set(axes.coordinates) <= set(told):
        return None
    columns = [told.index(c) for c in axes.coordinates]
    low, high = (side[:, list(axes.ranks), columns] for side in (sketch.lower, sketch.upper))
    if not axes.orders:
        return low, high
    order = np.argsort(low + high, axis=1, kind="stable")
    return np.take_along_axis(low, order, axis=1), np.take_along_axis(high, order, axis=1)
