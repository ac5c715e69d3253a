"""Choice of the landscape that is evaluated next, and how far: the background work of a recording."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import final

import numpy as np

import sparserob_core as sr
from sparserob_rerun.drawing.palette import Floats
from sparserob_rerun.options import LandscapeOptions

SLICE = 0.02  # seconds of processor time between two looks at the queue
LARGE = 0.02
"""Gain, as a share of the height of a landscape, after which it is drawn anew at once. Ten times as much, and the
search is seen to be elsewhere than where it is; a tenth, and no landscape is ever refined."""
SAME = 1e-3
"""Gain, as a share of the same height, below which nothing is to be seen in the colours. Ten times as much, and
landscapes that look different are seconds old; a tenth, and the last digits of a polished search begin them anew for
ever."""
STALE = 1.0
"""Seconds after which any gain that is to be seen is enough. Ten times as many, and what is drawn is of ten seconds
ago; with a tenth a landscape that a slow climb renews is never refined."""
BETWEEN = 2
"""The stride to which a landscape is refined on which g is the same everywhere, before another one is begun of the same
weight, unless it is `STALE` by then. On four times as coarse a grid what matters lies between two lines; on the finest,
flat ones are a second old."""
HELD = 0.8
"""Seconds for which a new landscape may wait until it is as fine as the one that is shown, which is of the same weight
and nearly as high. Ten times as many, and what is drawn is too old; a tenth, and fine drawings flicker."""
REFINING = 2 / 3
"""Part of the share of a core that finer grids may take; the rest is kept for the coarse one after the next gain. With
a third of it no map of a literal search is ever fine; with all of it, what is drawn after a gain is seconds old."""
VISIBLE = 1e-6  # of g: what two solvers make of one value differs by less, and what is seen by more
RESERVE = 0.25  # of the evaluations, for which landscapes stay coarse


@final
@dataclass(frozen=True, eq=False)
class Aim:
    """Tuple ``(D, width)`` whose surroundings are worth a look, with the ``value`` that the search has for it.
    ``round``: the round that it is of, 0 for none; ``pair``: which two indices decide most, where that is known."""

    slots: Floats
    epsilon: float
    value: float
    words: str
    round: int = 0
    pair: tuple[int, ...] = ()

    def exceeds(self, other: Aim) -> bool:
        """Return whether the value is visibly above another one of the same weight, or either is not known."""
        return self.epsilon != other.epsilon or not self.value - other.value <= VISIBLE * max(1.0, abs(self.value))


@final
class Explorer:
    """Evaluation of one landscape after the other, each through the best tuple that is known when it is begun.

    A landscape of another weight epsilon is given up at once, for a coarse one of the new weight, which waits for
    nothing. After a gain of `LARGE` a coarse one follows, as soon as the share of a core that the options allow has
    grown again; what is left of it refines. The share is of processor time, which is what it takes from others.
    """

    def __init__(
        self,
        draw: Callable[[sr.Landscape, Aim], None],
        inspection: sr.Inspection | None,
        options: LandscapeOptions | None,
        hurried: bool = False,
    ) -> None:
        self.draw, self.inspection, self.options = draw, inspection, options
        self.left = 0 if options is None or inspection is None else options.evaluations
        self.share = 1.0 if hurried or options is None else options.share
        self.landscape: sr.Landscape | None = None
        self.aimed: Aim | None = None
        self.waiting: Aim | None = None
        self.work: Iterator[bool] = iter(())
        self.began = self.since = time.monotonic()
        self.used, self.wrong = 0.0, ""
        self.drawn: tuple[Aim, sr.Landscape] | None = None
        self.fresh = False  # a level is complete that was not drawn yet

    @property
    def busy(self) -> bool:
        """True where there is something left to evaluate."""
        return self.left > 0 and (self.waiting is not None or (self.aimed is not None and not self._finished))

    @property
    def urgent(self) -> bool:
        """True where a first, coarse landscape is wanted: the first of a weight."""
        return self.left > 0 and (
            (self.aimed is not None and not self._coarse)
            or (self.waiting is not None and (self.aimed is None or self.aimed.epsilon != self.waiting.epsilon))
        )

    @property
    def rest(self) -> float:
        """Seconds until the share allows more work."""
        if self.urgent or (self.fresh and not self._held):
            return 0.0
        refines = self._coarse and (self.waiting is None or not self._better(self.waiting))
        share = self.share * (REFINING if refines else 1.0)
        return max(0.0, self.used / share - (time.monotonic() - self.began))

    def aim(self, aim: Aim) -> None:
        """Ask for the landscape through a tuple, in the middle of the coordinates that it does not say."""
        if self.left <= 0:
            return
        now = self.aimed
        if now is not None and (not aim.exceeds(now) or _same(now, aim)):
            self.waiting = None
            return
        self.waiting = aim
        if now is not None and now.epsilon != aim.epsilon:
            self.aimed = self.landscape = None
            self.fresh = False

    def step(self, hurry: bool = False) -> None:
        """Work for a moment, if the share allows it or in a ``hurry``."""
        if self.left > 0 and (hurry or self.rest == 0.0):
            before = time.thread_time()
            try:
                self._step()
            except sr.SparseRobError as error:  # of this tuple: the next one may have a map
                self.aimed, self.wrong = None, f"no landscape: {error}"
            finally:
                self.used += time.thread_time() - before

    def finish(self, seconds: float, level: int = 1, work: float = 0.0) -> None:
        """Work for some seconds, until the landscape of the tuple that was asked for last has a level; some seconds of
        ``work`` of the processor are its own, however busy the machine is."""
        end, granted = time.monotonic() + seconds, time.thread_time() + work
        while self.busy and (time.monotonic() < end or time.thread_time() < granted):
            if self.waiting is None and self.landscape is not None and 0 < self.landscape.level <= level:
                break
            if self.waiting is not None and self._coarse:
                self.aimed, self.fresh = None, False
            self.step(hurry=True)
        if self.fresh and not (self._coarser and self._gained <= LARGE):  # what is shown last is the finest
            self._draw()

    @property
    def _coarse(self) -> bool:
        return self.landscape is not None and self.landscape.level != 0

    @property
    def _finished(self) -> bool:
        return self.landscape is not None and self.landscape.level == 1

    def _step(self) -> None:
        if self.waiting is not None and self._better(self.waiting):
            self.aimed, self.waiting, self.landscape = self.waiting, None, None
            self.since, self.work, self.fresh = time.monotonic(), self._worked(self.aimed), False
        if self.fresh and not self._held:
            self._draw()
            return
        end = time.thread_time() + SLICE
        while self.left > 0 and self.aimed is not None and not self._finished and time.thread_time() < end:
            spare = self.options is not None and self.left < RESERVE * self.options.evaluations
            if spare and self._coarse:
                return
            self.left -= 1
            level = next(self.work, None)
            if level is None:
                self.aimed, self.fresh = None, False
            elif level and self.landscape is not None and np.isfinite(self.landscape.values).any():
                self.fresh = True
            if self.fresh and not self._held:
                self._draw()
                return

    def _draw(self) -> None:
        assert self.landscape is not None and self.aimed is not None
        self.wrong = ""
        if self.drawn is None or self.drawn[0].epsilon != self.aimed.epsilon:  # the first is beside the share
            self.began, self.used = time.monotonic(), 0.0
        self.fresh, self.drawn = False, (self.aimed, self.landscape)
        self.draw(self.landscape, self.aimed)

    @property
    def _coarser(self) -> bool:
        """True where the new landscape is coarser than the one that is shown, of the same weight."""
        if self.drawn is None or self.landscape is None or self.aimed is None:
            return False
        before, shown = self.drawn
        return before.epsilon == self.aimed.epsilon and 0 < shown.level < self.landscape.level

    @property
    def _gained(self) -> float:
        """Gain of the new landscape over the one that is shown, in heights of the latter."""
        assert self.drawn is not None and self.aimed is not None
        before, shown = self.drawn
        return _gain(self.aimed, before, shown)

    @property
    def _held(self) -> bool:
        """True where the landscape that is shown may stay for a moment, because the new one is coarser and hardly
        higher."""
        if not self._coarser:
            return False
        gain = self._gained
        return gain <= SAME or (gain <= LARGE and time.monotonic() - self.since < HELD)

    def _better(self, waiting: Aim) -> bool:
        """Return whether a tuple that is waiting is worth more than the landscape in work."""
        if self.aimed is None or self._finished or self.landscape is None:
            return self.aimed is None or self._finished
        if not self._coarse:
            return False
        gain = _gain(waiting, self.aimed, self.landscape)
        if gain > SAME and time.monotonic() - self.since > STALE:
            return True
        return not (gain <= LARGE or (self.landscape.flat and self.landscape.level > BETWEEN))

    def _worked(self, aim: Aim) -> Iterator[bool]:
        """Find the indices that decide, then fill the landscape; ``True`` where a level is complete."""
        assert self.inspection is not None and self.options is not None
        g = self.inspection.relaxed_value(len(aim.slots), aim.epsilon)
        slots = aim.slots
        if len(slots) == 1 and sr.LandscapeAxes.over(g, 1) is None:  # then the other axis is where one more index is
            slots = np.repeat(slots, 2, axis=0)
            g = self.inspection.relaxed_value(2, aim.epsilon)
        width, middle = min(slots.shape[1], g.slot.dimension), (g.slot.lower + g.slot.upper) / 2
        anchor = np.tile(middle, (len(slots), 1))
        anchor[:, :width] = slots[:, :width]
        anchor = np.clip(anchor, g.slot.lower, g.slot.upper)
        if sr.LandscapeAxes.over(g, len(anchor)) is None:
            self.wrong = "no landscape: no coordinate of the indices can move"
            return
        has_pair = len(aim.pair) == 2 and len(set(aim.pair)) == min(2, len(anchor)) and max(aim.pair) < len(anchor)
        if not has_pair:
            g.at(anchor)
            yield False
        pair = (aim.pair[0], aim.pair[1]) if has_pair else sr.deciding_pair(g, anchor)
        reach = dict[tuple[int, int], tuple[float, float]]()
        if self.options.coordinates is None:
            for _ in sr.LandscapeAxes.measure(g, anchor, pair, reach):
                yield False
        axes = sr.LandscapeAxes.over(g, len(anchor), self.options.coordinates, reach)
        if axes is None or (pair[0] == pair[1] and axes.orders):
            self.wrong = "no landscape: a tuple of one index has no second one"
            return
        self.landscape = sr.Landscape(g, anchor, *axes.places(pair, anchor), self.options.grid, aim.epsilon, axes)
        yield from self.landscape.evaluate()


def _same(one: Aim, other: Aim) -> bool:
    return one.epsilon == other.epsilon and np.array_equal(one.slots, other.slots)


def _gain(aim: Aim, before: Aim, landscape: sr.Landscape) -> float:
    """Return by how much a tuple has a higher value than the one before, relative to the height of its landscape; NaN
    where a value is not known."""
    low, high = landscape.limits
    gain = aim.value - before.value
    return gain / (high - low) if high > low else (np.inf if gain > 0.0 else gain)
