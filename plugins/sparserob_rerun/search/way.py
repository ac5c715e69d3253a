"""The way of a search: its evaluations stage by stage, one stage for each weight epsilon, and where its walk stood."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise
from typing import final

import numpy as np

import sparserob_core as sr
from sparserob_rerun.drawing.palette import Floats

NUMBERS = 2_000_000  # coordinates of points that are remembered


@final
class Stage:
    """One search: ``values (n,)`` of its evaluations, which are numbers ``base + 1, ...`` of the run.

    ``notes``: what the maximiser noted, one column ``(n,)`` for each name, NaN where it noted nothing.
    ``points (m, c)``: the last of them, of the coordinates ``kept (c,)``.
    """

    def __init__(self, number: int, epsilon: float, base: int) -> None:
        self.number, self.epsilon, self.base = number, epsilon, base
        self.values: Floats = np.zeros(0)
        self.notes: dict[str, Floats] = {}
        self.kept = np.zeros(0, dtype=int)
        self.points: Floats = np.zeros((0, 0))
        self.best, self.best_value, self.block = np.zeros(0), -np.inf, 1
        self.lower_bound, self.budget = -np.inf, 0
        self.sketches: dict[str, sr.Sketch] = {}

    def add(self, event: sr.EvaluationsFinished, kept: np.ndarray) -> None:
        """Remember a batch, of whose points the coordinates ``kept`` have come along."""
        trace, before = event.batch.trace, self.values.size
        self.values = np.concatenate([self.values, trace.values])
        for name in {*self.notes, *trace.notes}:
            column = np.full(self.values.size, np.nan)
            column[:before] = self.notes.get(name, np.nan)
            rows = trace.notes.get(name, np.zeros((0, 2)))
            which = rows[:, 0].astype(int) - 1 - event.batch.first
            inside = (which >= 0) & (which < trace.values.size)
            column[before + which[inside]] = rows[inside, 1]
            self.notes[name] = column
        self.best, self.best_value, self.block = event.best_point, event.best_value, event.block
        self.lower_bound, self.budget = event.lower_bound, event.budget
        self.sketches.update(event.sketches)
        if trace.points.shape[1:] == kept.shape and kept.size:
            if self.kept.shape != kept.shape:
                self.points, self.kept = np.zeros((0, kept.size)), kept
            self.points = np.concatenate([self.points, trace.points])[-max(1, NUMBERS // kept.size) :]

    def note(self, name: str) -> Floats:
        """What was noted at each evaluation ``(n,)``; NaN where nothing was."""
        return self.notes.get(name, np.full(self.values.size, np.nan))

    @property
    def walks(self) -> bool:
        """Whether the maximiser has told where its walk stands."""
        return "stands" in self.notes

    @property
    def standing(self) -> np.ndarray:
        """At which evaluation ``(n,)``, from 0, the walk stands after each; -1 where that is not known."""
        stands = self.note("stands")
        return np.where(np.isnan(stands), 0.0, stands).astype(int) - 1

    @property
    def walk(self) -> Floats:
        """The value ``(n,)`` of the walk after each evaluation; NaN where it is not known."""
        standing = self.standing
        return np.where(standing >= 0, self.values[np.maximum(standing, 0)], np.nan)

    @property
    def refused(self) -> np.ndarray:
        """Which evaluations ``(n,)`` were proposals that the walk did not accept."""
        return np.asarray(self.note("accepted") == 0.0)

    @property
    def restarts(self) -> np.ndarray:
        """The evaluations, from 0, that are the first after the walk was heated again, or of another ascent or
        start."""
        found = np.zeros(0, dtype=int)
        for name in ("cycle", "ascent", "start"):
            column = self.note(name)
            known = np.flatnonzero(~np.isnan(column))
            found = np.union1d(found, known[1:][np.diff(column[known]) != 0.0])
        return found


@final
@dataclass(frozen=True, eq=False)
class Shadow:
    """A stage on two coordinates: the points ``(m, 2)`` that are remembered, which were refused ``(m,)``, the walk's
    ``legs`` ``(k_i, 2)`` from one restart to the next, and where it stood when it was heated again ``(r, 2)``."""

    points: Floats
    refused: np.ndarray
    legs: list[Floats]
    restarts: Floats
    now: Floats


def shadow(stage: Stage, wanted: np.ndarray) -> Shadow | None:
    """A stage on the coordinates ``wanted (2,)`` of its points; ``None`` where they have not come along."""
    if not stage.points.size or not np.isin(wanted, stage.kept).all():
        return None
    points = stage.points[:, np.searchsorted(stage.kept, wanted)]
    first = stage.values.size - len(points)
    legs, places, heated = [], [], stage.restarts
    if stage.walks:
        standing = stage.standing - first
        for start, end in zip([0, *heated], [*heated, stage.values.size], strict=True):
            path = standing[start:end]
            path = path[path >= 0]
            legs.append(points[path[np.append(True, np.diff(path) != 0)]] if path.size else np.zeros((0, 2)))
        places = [leg[0] for leg in legs[1:] if len(leg)]
    else:  # an ascent is its evaluations
        ends = [max(0, start - first) for start in [0, *heated, stage.values.size]]
        ascends = bool({"ascent", "start"} & set(stage.notes))
        legs = [points[start:end] for start, end in pairwise(ends)] if ascends else []
        places = [leg[0] for leg in legs[1:] if len(leg)]
    standing_now = next((leg[-1] for leg in reversed(legs) if len(leg)), points[-1])
    return Shadow(
        points,
        stage.refused[first:],
        [leg for leg in legs if len(leg)],
        np.array(places).reshape(-1, 2),
        np.asarray(standing_now),
    )
