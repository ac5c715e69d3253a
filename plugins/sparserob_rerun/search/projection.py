"""What a search does, in the coordinates of the map: where the two indices are that decide most in each of its tuples.

It is computed where the tuples are known, in the process of the run, so that none of them has to travel.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import final

import numpy as np

import sparserob_core as sr
from sparserob_rerun.drawing.palette import Floats

NEAR = 0.05
"""Indices that are nearer to one another, in widths of the box, stand for one constraint and move together. A tenth of
it, and two that a search has put beside one another hide that g depends on them; ten times, and all of them are one."""
REMEMBERED = 20_000
"""Evaluated tuples whose deciding indices are remembered for cells around them, 200 bytes each. With a tenth of it most
cells of a search by partition are older; with ten times as many they take 40 MB of the run's memory."""
DIGITS = 1e7
"""By this many parts of a box two tuples are told apart: ten times fewer mix neighbours in deep cells, ten times more
lose those whose middle was rounded."""


@final
@dataclass(frozen=True, eq=False)
class Outlines:
    """A sketch of ``count`` things, over the places of the indices that decide at the middle of each: points, boxes or
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


@final
class Projector:
    """Projects the events of searches; it remembers of evaluated tuples which of their indices decide."""

    def __init__(self) -> None:
        self.pair, self.known = (0, 0), dict[int, tuple[int, int]]()

    def small(self, event: sr.EvaluationsFinished) -> tuple[sr.EvaluationsFinished, Projection]:
        """The event without points, domain and sketches, and what is drawn of them."""
        batch, count = event.batch, sum(len(values) for values in event.batch.values)
        bare = replace(event, domain=None, sketches={}, deciding=np.zeros((0, 0), dtype=int))
        bare = replace(bare, batch=replace(batch, points=[np.zeros((count, 0))], origin=None))
        domain, width = event.domain, len(event.coordinates)
        if domain is None or not width or len(event.deciding) != count or not count:
            return bare, Projection()
        if event.total == event.count:
            self.pair, self.known = (0, min(1, domain.dimension // event.block - 1)), {}
        columns = np.arange(0, domain.dimension, event.block)[:, np.newaxis] + np.array(event.coordinates)
        plain = np.concatenate([piece[:, columns.ravel()] for piece in batch.points])
        lower, upper = (side[columns.ravel()] for side in (domain.lower, domain.upper))
        tuples = plain.reshape(count, -1, width)
        slots = self._slots(event.deciding, tuples, (upper - lower)[:width])
        for key, pair in zip(_keys(plain, lower, upper), slots, strict=True):
            self.known[int(key)] = (int(pair[0]), int(pair[1]))
        for key in list(self.known)[: max(0, len(self.known) - REMEMBERED)]:
            del self.known[key]
        thin = replace(batch, points=[plain], origin=None if batch.origin is None else batch.origin[columns.ravel()])
        rows, moved = thin.moves.T
        moves = np.column_stack([rows, np.array(event.coordinates)[moved % width], plain[rows, moved]])
        sketches = {role: self._outlines(sketch, columns, (lower, upper)) for role, sketch in event.sketches.items()}
        places = tuples[np.arange(count)[:, np.newaxis], slots]
        return bare, Projection(event.coordinates, places, slots, moves, sketches)

    def _slots(self, deciding: np.ndarray, tuples: Floats, widths: Floats) -> np.ndarray:
        """The two indices ``(n, 2)`` of each tuple ``(D, c)``; the last ones where fewer decide."""
        found = np.empty((len(tuples), 2), dtype=int)
        for row, (ranked, slots) in enumerate(zip(deciding, tuples, strict=True)):
            found[row] = self.pair = two_of(ranked, slots, widths, self.pair)
        return found

    def _outlines(self, sketch: sr.Sketch, columns: np.ndarray, box: tuple[Floats, Floats]) -> Outlines:
        lower, upper = sketch.lower[:, columns.ravel()], sketch.upper[:, columns.ravel()]
        keys = _keys((lower + upper) / 2, *box)
        pairs = np.array([self.known.get(int(key), self.pair) for key in keys]).reshape(-1, 2)
        mine = np.arange(len(pairs))[:, np.newaxis], pairs
        low, high = (side.reshape(-1, *columns.shape)[mine] for side in (lower, upper))
        return Outlines(low, high, sketch.rounded, sketch.points, len(pairs))


def two_of(ranked: Sequence[int] | np.ndarray, slots: Floats, widths: Floats, others: Sequence[int]) -> tuple[int, int]:
    """The two indices of a tuple ``(D, c)`` that decide most and do not stand for the same constraint: of those
    ``ranked`` by their multipliers, -1 for none, then of the ``others``, then any; one twice where there is one."""
    first, *rest = [int(k) for k in ranked if k >= 0] or [int(others[0])]
    apart = [k for k in rest if np.abs((slots[k] - slots[first]) / widths).max() > NEAR]
    second = next((k for k in (*apart, *others, *rest, *range(len(slots))) if k != first), first)
    return first, int(second)


def _keys(plain: Floats, lower: Floats, upper: Floats) -> np.ndarray:
    """Numbers ``(k,)`` by which tuples ``(k, d)`` are found again, whatever rounding did to their last digits."""
    weights = np.cos(np.arange(1.0, plain.shape[1] + 1.0))  # so that no two coordinates of a grid make up for another
    return np.round(((plain - lower) / (upper - lower)) @ weights * DIGITS).astype(np.int64)


@final
@dataclass(frozen=True)
class Axes:
    """The two axes of a map: each is a coordinate of an index, of that which decides most (``ranks`` 0) or of the other
    (1). ``orders``: both are the same coordinate of two indices, of which the lesser is across."""

    ranks: tuple[int, int]
    coordinates: tuple[int, int]

    @property
    def orders(self) -> bool:
        """Whether the axes are the same coordinate of two indices."""
        return self.coordinates[0] == self.coordinates[1]

    def of(self, told: tuple[int, ...], places: Floats) -> Floats | None:
        """The points ``(n, 2)`` of places ``(n, 2, c)`` whose coordinates are those ``told (c,)``; ``None`` where these
        have not come along."""
        if not set(self.coordinates) <= set(told):
            return None
        points = np.stack(
            [places[:, r, told.index(c)] for r, c in zip(self.ranks, self.coordinates, strict=True)], axis=-1
        )
        return np.sort(points, axis=1) if self.orders else points

    def outlines(self, told: tuple[int, ...], sketch: Outlines) -> tuple[Floats, Floats] | None:
        """The corners ``(k, 2)`` of a sketch on the map, lower and upper."""
        if not set(self.coordinates) <= set(told):
            return None
        columns = [told.index(c) for c in self.coordinates]
        low, high = (side[:, list(self.ranks), columns] for side in (sketch.lower, sketch.upper))
        if not self.orders:
            return low, high
        order = np.argsort(low + high, axis=1, kind="stable")
        return np.take_along_axis(low, order, axis=1), np.take_along_axis(high, order, axis=1)
