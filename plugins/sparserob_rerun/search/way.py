"""Path of a search: its evaluations stage by stage, one stage for each weight epsilon, and where its walk stood."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise
from typing import final

import numpy as np

import sparserob_core as sr
from sparserob_rerun.drawing.palette import Floats
from sparserob_rerun.search.projection import Outlines, Projection

POINTS = 100_000  # tuples whose places are remembered; a tenth of it forgets a long walk, ten times of it takes 50 MB


@final
class Stage:
    """Stage of a search: ``values (n,)`` of its evaluations, which are numbers ``base + 1, ...`` of the run. ``began``:
    the seconds of the run before it.

    ``began``: the seconds of the run before it.

    ``notes``: what the maximiser noted, one column ``(n,)`` for each name, NaN where it noted nothing.
    ``places (m, 2, c)``: of the last of them where the two indices were that decided most, in the ``coordinates (c,)``
    of an index; ``pair``: which they were in the best tuple, () where that is not known.
    """

    def __init__(self, number: int, epsilon: float, base: int, began: float = 0.0) -> None:
        self.number, self.epsilon, self.base, self.began = number, epsilon, base, began
        self.values: Floats = np.zeros(0)
        self.notes: dict[str, Floats] = {}
        self.coordinates: tuple[int, ...] = ()
        self.places: Floats = np.zeros((0, 2, 0))
        self.pair: tuple[int, ...] = ()
        self.best, self.best_value, self.block = np.zeros(0), -np.inf, 1
        self.lower_bound, self.budget = -np.inf, 0
        self.searched = 0  # evaluations before the polish, 0 where there was none yet
        self.sketches: dict[str, Outlines] = {}

    def add(self, event: sr.EvaluationsFinished, projection: Projection) -> None:
        """Remember a batch, and the part of its tuples that is drawn on a map."""
        trace, previous_count = event.batch.trace, self.values.size
        if event.phase == "polish" and not self.searched:
            self.searched = previous_count
        self.values = np.concatenate([self.values, trace.values])
        for name in {*self.notes, *trace.notes}:
            column = np.full(self.values.size, np.nan)
            column[:previous_count] = self.notes.get(name, np.nan)
            rows = trace.notes.get(name, np.zeros((0, 2)))
            indices = rows[:, 0].astype(int) - 1 - event.batch.first
            is_inside = (indices >= 0) & (indices < trace.values.size)
            column[previous_count + indices[is_inside]] = rows[is_inside, 1]
            self.notes[name] = column
        if event.best_value != self.best_value:
            best = int(np.argmax(trace.values)) if trace.values.size else -1
            has_best = 0 <= best < len(projection.slots) and trace.values[best] == event.best_value
            self.pair = tuple(int(k) for k in projection.slots[best]) if has_best else ()
        if event.best_point.size:
            self.best = event.best_point
        self.best_value, self.block = event.best_value, event.block
        self.lower_bound, self.budget = event.lower_bound, event.budget
        self.sketches.update(projection.sketches)
        if len(projection.places) == trace.values.size:
            if self.coordinates != projection.coordinates or not self.places.size:
                self.coordinates, self.places = projection.coordinates, projection.places
            else:
                self.places = np.concatenate([self.places, projection.places])[-POINTS:]
        else:
            self.coordinates, self.places = (), np.zeros((0, 2, 0))

    def note(self, name: str) -> Floats:
        """Return what was noted at each evaluation ``(n,)``; NaN where nothing was."""
        return self.notes.get(name, np.full(self.values.size, np.nan))

    @property
    def walks(self) -> bool:
        """True where the maximiser has reported where its walk stands."""
        return "stands" in self.notes

    @property
    def standing(self) -> np.ndarray:
        """Evaluation ``(n,)``, from 0, at which the walk stands after each; -1 where that is not known."""
        stands = self.note("stands")
        return np.where(np.isnan(stands), 0.0, stands).astype(int) - 1

    @property
    def walk(self) -> Floats:
        """Value ``(n,)`` of the walk after each evaluation; NaN where it is not known."""
        standing = self.standing
        return np.where(standing >= 0, self.values[np.maximum(standing, 0)], np.nan)

    @property
    def refused(self) -> np.ndarray:
        """Mask ``(n,)`` of the evaluations that were proposals which the walk did not accept."""
        return np.asarray(self.note("accepted") == 0.0)

    @property
    def restarts(self) -> np.ndarray:
        """Evaluations, from 0, that are the first after the walk was heated again, or of another ascent or start."""
        restarts = np.zeros(0, dtype=int)
        for name in ("cycle", "ascent", "start"):
            column = self.note(name)
            noted = np.flatnonzero(~np.isnan(column))
            restarts = np.union1d(restarts, noted[1:][np.diff(column[noted]) != 0.0])
        return restarts


@final
@dataclass(frozen=True, eq=False)
class Shadow:
    """Stage on two coordinates: the points ``(m, 2)`` that are remembered, which were refused ``(m,)``, the walk's
    ``legs`` ``(k_i, 2)`` from one restart to the next, and where it stood when it was heated again ``(r, 2)``."""

    points: Floats
    refused: np.ndarray
    legs: list[Floats]
    restarts: Floats
    now: Floats


def shadow(stage: Stage, axes: sr.LandscapeAxes) -> Shadow | None:
    """Return a stage on the two ``axes`` of a map; ``None`` where its tuples have not come along."""
    points = axes.of(stage.coordinates, stage.places)
    if points is None or not len(points):
        return None
    first = stage.values.size - len(points)
    legs, restart_points, restart_indices = [], [], stage.restarts
    if stage.walks:
        standing = stage.standing - first
        for start, end in zip([0, *restart_indices], [*restart_indices, stage.values.size], strict=True):
            path = standing[start:end]
            path = path[path >= 0]
            leg = points[path]
            legs.append(leg[np.append(True, (np.diff(leg, axis=0) != 0.0).any(axis=1))] if len(leg) else leg)
        restart_points = [leg[0] for leg in legs[1:] if len(leg)]
    else:  # an ascent is its evaluations
        ends = [max(0, start - first) for start in [0, *restart_indices, stage.values.size]]
        ascends = bool({"ascent", "start"} & set(stage.notes))
        legs = [points[start:end] for start, end in pairwise(ends)] if ascends else []
        restart_points = [leg[0] for leg in legs[1:] if len(leg)]
    standing_now = next((leg[-1] for leg in reversed(legs) if len(leg)), points[-1])
    return Shadow(
        points,
        stage.refused[first:],
        [leg for leg in legs if len(leg)],
        np.array(restart_points).reshape(-1, 2),
        np.asarray(standing_now),
    )
