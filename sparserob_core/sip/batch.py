"""Evaluations as a search made them: joined into arrays only when somebody looks at them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np

from sparserob_core.sip.convex_set import Array
from sparserob_core.sip.maximiser import Trace


@dataclass(frozen=True, eq=False)
class Batch:
    """The evaluations of a search since it was last told of: ``trace`` and ``moves`` are computed when they are first read.

    ``points`` and ``values`` are the pieces ``(k_i, d)`` and ``(k_i,)`` as they were evaluated, ``moments`` their sizes and seconds since the
    search began, ``notes`` per name the pairs (evaluations of the search so far, value). ``first`` evaluations came before, the best
    of which was ``best``; ``origin (d,)`` is where the walk stood then, ``None`` at the start.
    """

    points: Sequence[Array] = ()
    values: Sequence[Array] = ()
    moments: Sequence[tuple[int, float]] = ()
    notes: Mapping[str, Sequence[tuple[float, float]]] = field(default_factory=dict)
    first: int = 0
    best: float = -np.inf
    origin: Array | None = None

    @cached_property
    def trace(self) -> Trace:
        """The evaluations as a `Trace`; ``best`` and ``notes`` count from the beginning of the search."""
        if not self.values:
            return Trace(np.empty((0, 0)), np.empty(0), np.empty(0), np.empty(0))
        values = np.concatenate(self.values)
        seconds = np.repeat([moment for _, moment in self.moments], [count for count, _ in self.moments])
        notes = {name: np.array(rows, dtype=float).reshape(-1, 2) for name, rows in self.notes.items()}
        return Trace(np.concatenate(self.points), values, np.maximum(np.maximum.accumulate(values), self.best), seconds, notes)

    @cached_property
    def moves(self) -> np.ndarray:
        """Rows ``(evaluation in the batch, coordinate)``, ``(k, 2)``: where each point differs from where the walk stood.

        That is the point accepted last where the maximiser notes ``accepted``, and the point before where it does not. The first point of a search
        has moved from nowhere, and is left out.
        """
        points = self.trace.points
        place = np.arange(len(points))
        if not place.size:
            return np.zeros((0, 2), dtype=int)
        standing = np.maximum.accumulate(np.where(self._accepted(), place, -1))
        before = np.concatenate([[-1], standing[:-1]])
        origin = np.full(points.shape[1], np.nan) if self.origin is None else self.origin
        stood = np.where(before[:, np.newaxis] < 0, origin, points[before])
        return np.argwhere((points != stood) & ~np.isnan(stood))

    def _accepted(self) -> np.ndarray:
        accepted = np.ones(len(self.trace.points), dtype=bool)
        rows = self.trace.notes.get("accepted", np.empty((0, 2)))
        which = rows[:, 0].astype(int) - 1 - self.first
        mine = (which >= 0) & (which < accepted.size)
        accepted[which[mine]] = rows[mine, 1] > 0.0
        return accepted

