"""Decides which landscape is evaluated next, and how far: the background work of a recording."""

from __future__ import annotations

import time
from collections.abc import Iterator
from typing import final

import numpy as np

import sparserob_core as sr
from sparserob_rerun.drawing.palette import Floats
from sparserob_rerun.options import LandscapeOptions
from sparserob_rerun.search.landscape import Landscape, coordinate, influential
from sparserob_rerun.search.terrain import Terrain

SLICE = 0.02  # seconds of work between two looks at the queue
FEWEST = 32  # evaluations that a first, coarse landscape needs


@final
class Explorer:
    """Fills one landscape after the other: through the first tuple of a search, then through the best tuple of a round,
    the newest first.

    All of them together take no more evaluations than the options allow. What a landscape shows is decided by its
    anchor alone, not by the clock.
    """

    def __init__(self, terrain: Terrain, inspection: sr.Inspection | None, options: LandscapeOptions | None) -> None:
        self.terrain, self.inspection, self.options = terrain, inspection, options
        self.left = 0 if options is None or inspection is None else options.evaluations
        self.landscape: Landscape | None = None
        self.words, self.round = "", 0
        self.work: Iterator[bool] = iter(())
        self.waiting: tuple[Floats, float, str, int] | None = None
        self.wrong = ""

    @property
    def busy(self) -> bool:
        """Whether there is something left to evaluate."""
        return self.left > 0 and (
            (self.landscape is not None and self.landscape.level != 1) or self.waiting is not None
        )

    def aim(self, slots: Floats, epsilon: float, words: str, number: int = 0) -> None:
        """Ask for the landscape through a tuple ``(D, width)``, in the middle of the coordinates that it does not say;
        it is begun when the one in work is complete. ``number``: the round that the tuple is of, 0 for none."""
        if self.left > 0:
            self.waiting = (np.array(slots, dtype=float), epsilon, words, number)

    def hurry(self) -> None:
        """Leave an unfinished landscape for the one that is waiting."""
        if self.waiting is not None and (self.landscape is None or self.landscape.level != 1):
            self.landscape = None

    def step(self) -> None:
        """Work for a moment."""
        try:
            self._step()
        except sr.SparseRobError as error:
            self.left, self.wrong = 0, f"no landscape: {error}"

    def _step(self) -> None:
        if (self.landscape is None or self.landscape.level == 1) and not self._begin():
            self.left = 0 if self.waiting is not None else self.left
            self.waiting = None
            return
        landscape, end = self.landscape, time.monotonic() + SLICE
        assert landscape is not None
        while time.monotonic() < end and self.left > 0:
            before = landscape.spent
            if next(self.work, True):
                if np.isfinite(landscape.values).any():
                    self.terrain.surface(landscape, self.words)
                return
            self.left -= landscape.spent - before

    def _begin(self) -> bool:
        """Start on the tuple that is waiting; ``False`` where there is none, or nothing in it can move."""
        if self.waiting is None or self.inspection is None or self.options is None or self.left < FEWEST:
            return False
        slots, epsilon, self.words, self.round = self.waiting
        g = self.inspection.relaxed_value(len(slots), epsilon)
        known, middle = min(slots.shape[1], g.slot.dimension), (g.slot.lower + g.slot.upper) / 2
        anchor = np.tile(middle, (len(slots), 1))
        anchor[:, :known] = slots[:, :known]
        anchor = np.clip(anchor, g.slot.lower, g.slot.upper)
        g.at(anchor)
        if self.options.coordinates is not None:
            pair = tuple(coordinate(name, g, len(slots)) for name in self.options.coordinates)
        else:
            found = influential(g, anchor, g.weights())
            if found is None:
                self.wrong = "no landscape: fewer than two coordinates of the indices can move"
                return False
            pair = found
        self.waiting = None
        self.landscape = Landscape(g, anchor, pair[0], pair[1], self.options.grid)
        self.work = self.landscape.evaluate()
        return True
