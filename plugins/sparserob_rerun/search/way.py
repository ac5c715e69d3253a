"""The way of a search through the space of tuples, and its shadow on the two coordinates of a landscape."""

from __future__ import annotations

from typing import final

import numpy as np

import sparserob_core as sr
from sparserob_rerun.drawing.palette import Floats
from sparserob_rerun.search.landscape import Landscape
from sparserob_rerun.search.terrain import Terrain

KEPT = 1000  # evaluated points that are remembered
SEEN = 10  # evaluations, or a hundredth of the budget, between two pictures


@final
class Way:
    """The last evaluated points, so that they can be shown on a landscape over other coordinates as well."""

    def __init__(self) -> None:
        self.kept = np.zeros(0, dtype=int)
        self.points: Floats = np.zeros((0, 0))
        self.values: Floats = np.zeros(0)
        self.best, self.best_value, self.block = np.zeros(0), -np.inf, 1
        self.landscape: Landscape | None = None
        self.unseen = 0

    def go(self, event: sr.EvaluationsFinished, kept: np.ndarray, terrain: Terrain) -> None:
        """Remember a batch, of whose points the coordinates ``kept`` have come along, and draw it now and then."""
        trace = event.batch.trace
        self.best, self.best_value, self.block = event.best_point, event.best_value, event.block
        if trace.points.shape[1:] != kept.shape:
            return
        if self.kept.shape != kept.shape:
            self.points, self.values, self.kept = np.zeros((0, kept.size)), np.zeros(0), kept
        self.points = np.concatenate([self.points, trace.points])[-KEPT:]
        self.values = np.concatenate([self.values, trace.values])[-KEPT:]
        self.unseen += event.count
        if self.unseen >= max(SEEN, event.budget // 100) or event.total >= event.budget:
            self.unseen = 0
            self.project(terrain)

    def project(self, terrain: Terrain) -> None:
        """Draw the way on the landscape that is shown."""
        self.landscape = landscape = terrain.known
        if landscape is None or not self.points.size or not self.best.size:
            return
        wanted = np.array([slot * self.block + coordinate for slot, coordinate in (landscape.first, landscape.second)])
        where = np.minimum(np.searchsorted(self.kept, wanted), self.kept.size - 1)
        if (self.kept[where] == wanted).all():
            terrain.visit(self.points[:, where], self.values, (self.best[wanted], self.best_value))
