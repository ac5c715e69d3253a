"""Decides which landscape is evaluated next, and how far: the background work of a recording."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import final

import numpy as np

import sparserob_core as sr
from sparserob_rerun.drawing.palette import Floats
from sparserob_rerun.options import LandscapeOptions
from sparserob_rerun.search.landscape import Landscape, axes_of, deciding_pair, places_of

SLICE = 0.02  # seconds of work between two looks at the queue
LARGE = 0.02  # of the height of a landscape: a gain after which it is drawn anew
STALE = 10.0  # seconds after which any gain is enough
RESERVE = 0.25  # of the evaluations, for which landscapes stay coarse


@final
@dataclass(frozen=True, eq=False)
class Aim:
    """A tuple ``(D, width)`` whose surroundings are worth a look, with the ``value`` that the search has for it.
    ``round``: the round that it is of, 0 for none; ``pair``: which two indices decide most, where that is known."""

    slots: Floats
    epsilon: float
    value: float
    words: str
    round: int = 0
    pair: tuple[int, ...] = ()


@final
class Explorer:
    """Draws one landscape after the other, each through the best tuple that is known when it is begun.

    A landscape of another weight epsilon is given up at once, for a coarse one of the new weight, which waits for
    nothing. After a gain of `LARGE` a coarse one follows, as soon as the share of a core that the options allow has
    grown again; what is left of it refines. The share is of processor time, which is what it takes from others.
    """

    def __init__(
        self,
        draw: Callable[[Landscape, Aim], None],
        inspection: sr.Inspection | None,
        options: LandscapeOptions | None,
        hurried: bool = False,
    ) -> None:
        self.draw, self.inspection, self.options = draw, inspection, options
        self.left = 0 if options is None or inspection is None else options.evaluations
        self.share = 1.0 if hurried or options is None else options.share
        self.landscape: Landscape | None = None
        self.aimed: Aim | None = None
        self.waiting: Aim | None = None
        self.work: Iterator[bool] = iter(())
        self.began = self.since = time.monotonic()
        self.used, self.wrong = 0.0, ""

    @property
    def busy(self) -> bool:
        """Whether there is something left to evaluate."""
        return self.left > 0 and (self.waiting is not None or (self.aimed is not None and not self._finished))

    @property
    def urgent(self) -> bool:
        """Whether a first, coarse landscape is wanted: the first of a weight."""
        return self.left > 0 and (
            (self.aimed is not None and not self._coarse)
            or (self.waiting is not None and (self.aimed is None or self.aimed.epsilon != self.waiting.epsilon))
        )

    @property
    def rest(self) -> float:
        """Seconds until the share allows more work."""
        return 0.0 if self.urgent else max(0.0, self.used / self.share - (time.monotonic() - self.began))

    def aim(self, aim: Aim) -> None:
        """Ask for the landscape through a tuple, in the middle of the coordinates that it does not say."""
        if self.left <= 0:
            return
        now = self.aimed
        if now is not None and now.epsilon == aim.epsilon and np.array_equal(now.slots, aim.slots):
            self.waiting = None
            return
        self.waiting = aim
        if now is not None and now.epsilon != aim.epsilon:
            self.aimed = self.landscape = None

    def step(self, hurry: bool = False) -> None:
        """Work for a moment, if the share allows it or in a ``hurry``."""
        if self.left > 0 and (hurry or self.rest == 0.0):
            before = time.thread_time()
            try:
                self._step()
            except sr.SparseRobError as error:
                self.left, self.wrong = 0, f"no landscape: {error}"
            finally:
                self.used += time.thread_time() - before

    def finish(self, seconds: float, level: int = 1) -> None:
        """Work for some seconds, until the landscape of the tuple that was asked for last has a level."""
        end = time.monotonic() + seconds
        while self.busy and time.monotonic() < end:
            if self.waiting is None and self.landscape is not None and 0 < self.landscape.level <= level:
                return
            if self.waiting is not None and self._coarse:
                self.aimed = None
            self.step(hurry=True)

    @property
    def _coarse(self) -> bool:
        return self.landscape is not None and self.landscape.level != 0

    @property
    def _finished(self) -> bool:
        return self.landscape is not None and self.landscape.level == 1

    def _step(self) -> None:
        if self.waiting is not None and self._better(self.waiting):
            self.aimed, self.waiting, self.landscape = self.waiting, None, None
            self.since, self.work = time.monotonic(), self._worked(self.aimed)
        end = time.monotonic() + SLICE
        while self.left > 0 and self.aimed is not None and not self._finished and time.monotonic() < end:
            spare = self.options is not None and self.left < RESERVE * self.options.evaluations
            if spare and self._coarse:
                return
            self.left -= 1
            level = next(self.work, None)
            if level is None:
                self.aimed = None
            elif level and self.landscape is not None and np.isfinite(self.landscape.values).any():
                self.draw(self.landscape, self.aimed)
                return

    def _better(self, waiting: Aim) -> bool:
        """Whether a tuple that is waiting is worth more than the landscape in work."""
        if self.aimed is None or self._finished or self.landscape is None:
            return self.aimed is None or self._finished
        if not self._coarse:
            return False
        low, high = self.landscape.limits
        gain = waiting.value - self.aimed.value
        return not gain <= LARGE * (high - low) or time.monotonic() - self.since > STALE

    def _worked(self, aim: Aim) -> Iterator[bool]:
        """Find the indices that decide, then fill the landscape; ``True`` where a level is complete."""
        assert self.inspection is not None and self.options is not None
        g = self.inspection.relaxed_value(len(aim.slots), aim.epsilon)
        known, middle = min(aim.slots.shape[1], g.slot.dimension), (g.slot.lower + g.slot.upper) / 2
        anchor = np.tile(middle, (len(aim.slots), 1))
        anchor[:, :known] = aim.slots[:, :known]
        anchor = np.clip(anchor, g.slot.lower, g.slot.upper)
        axes = axes_of(g, len(anchor), self.options.coordinates)
        if axes is None:
            self.left, self.wrong = 0, "no landscape: fewer than two coordinates of the indices can move"
            return
        known_pair = len(aim.pair) == 2 and max(aim.pair) < len(anchor)
        if not known_pair:
            g.at(anchor)
            yield False
        pair = (aim.pair[0], aim.pair[1]) if known_pair else deciding_pair(g, anchor)
        if pair[0] == pair[1] and axes.orders:
            self.left, self.wrong = 0, "no landscape: a tuple of one index has no second one"
            return
        self.landscape = Landscape(g, anchor, *places_of(axes, pair, anchor), self.options.grid, aim.epsilon, axes)
        yield from self.landscape.evaluate()
