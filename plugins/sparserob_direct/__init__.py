"""DIRECT, the deterministic division of a box into ever smaller rectangles, an iteration at a time."""

from __future__ import annotations

from collections.abc import Iterator
from heapq import heappop, heappush
from typing import ClassVar, Final

import numpy as np
from pydantic import Field

import sparserob_core as sr

MAX_SHOWN = 200  # rectangles
NUMBERS_AT_ONCE: Final = 2**23  # coordinates of a batch: 64 MB, however many dimensions there are
DEEPEST: Final = 33
"""Cuts of one side, at most: 3^-33 is the spacing of doubles near 1. With ten fewer the last digits are lost; with
more, points repeat."""


class Direct(sr.Maximiser, sr.Options):
    """Dividing rectangles (Jones, Perttunen and Stuckman 1993), with the local bias of Gablonsky and Kelley (2001)
    unless switched off.

    The rectangles that some Lipschitz constant makes the most promising ones are cut into thirds along all of their
    longest sides; the side beside whose new centres the better value lies is cut first. The new centres of all
    rectangles of one iteration are evaluated in one batch. Of equal values the earlier rectangle comes first.
    Deterministic: the generator is not used. It proves no upper bound.
    """

    apart: ClassVar[bool] = True

    eps: float = Field(default=1e-8, ge=0.0, le=1.0)
    """Least improvement, relative to the best value, that a rectangle must promise: small is local and accurate."""

    locally_biased: bool = True
    """Divide at most one rectangle of each size per iteration: faster when the maxima are few."""

    def search(self, objective: sr.Objective, rng: np.random.Generator) -> float:
        """Search until the budget is spent and return ``inf``, as no upper bound is proven; see
        `sparserob_core.Maximiser`."""
        division = Division(objective, self.locally_biased)
        while chosen := division.promising(self.eps):
            division.divide(chosen)
            if objective.observed:
                objective.sketch("rectangles, the best ones", *division.boxes())
        return float("inf")


class Division:
    """Division of the unit box into ``count`` rectangles. ``centres (n, d)`` and the cuts of each side,
    ``levels (n, d)``, describe them; ``losses (n,)`` are the values at the centres, negated."""

    def __init__(self, objective: sr.Objective, biased: bool) -> None:
        self.objective, self.biased, self.count = objective, biased, 0
        dimension = objective.domain.dimension
        self.centres, self.levels = np.empty((0, dimension)), np.empty((0, dimension), dtype=np.int8)
        self.losses, self.worst = np.empty(0), -np.inf
        self.waiting: dict[tuple[int, int], list[tuple[float, int]]] = {}  # by size, the best one first
        self._add(np.full((1, dimension), 0.5), np.zeros((1, dimension), dtype=np.int8))
        self._wait(0)

    def promising(self, eps: float) -> list[int]:
        """Take out the rectangles that are the best for some Lipschitz constant and promise a gain of ``eps``."""
        sizes = sorted(size for size, rectangles in self.waiting.items() if rectangles)
        losses = np.array([self.waiting[size][0][0] for size in sizes])
        losses[np.isinf(losses)] = self.worst if np.isfinite(self.worst) else 0.0
        chosen = list[int]()
        for index in best_for_some_slope(np.array([self._width(size) for size in sizes]), losses, eps):
            rectangles = self.waiting[sizes[index]]
            loss, rectangle = heappop(rectangles)
            chosen.append(rectangle)
            while not self.biased and rectangles and rectangles[0][0] == loss:
                chosen.append(heappop(rectangles)[1])
        return chosen

    def divide(self, chosen: list[int]) -> None:
        """Evaluate the new centres in the chosen rectangles, and cut these."""
        longest = [np.flatnonzero(self.levels[rectangle] == self.levels[rectangle].min()) for rectangle in chosen]
        parents = np.repeat(chosen, [2 * axes.size for axes in longest])
        axes = np.repeat(np.concatenate(longest), 2)
        offsets = 3.0 ** -(self.levels[parents, axes].astype(float) + 1.0)
        offsets[1::2] *= -1.0
        first_child, batch_size = self.count, max(1, NUMBERS_AT_ONCE // self.centres.shape[1])
        for start in range(0, parents.size, batch_size):
            batch = slice(start, start + batch_size)
            centres = self.centres[parents[batch]]
            centres[np.arange(len(centres)), axes[batch]] += offsets[batch]
            self._add(centres, self.levels[parents[batch]])
        for rectangle, sides in zip(chosen, longest, strict=True):
            losses = self.losses[first_child : first_child + 2 * sides.size].reshape(-1, 2).min(axis=1)
            for position in np.argsort(losses, kind="stable").tolist():  # a side that is cut first leaves larger thirds
                self.levels[rectangle, sides[position]] += 1
                self.levels[first_child + 2 * position : first_child + 2 * position + 2] = self.levels[rectangle]
            for index in (rectangle, *range(first_child, first_child + 2 * sides.size)):
                self._wait(index)
            first_child += 2 * sides.size

    def boxes(self) -> tuple[np.ndarray, np.ndarray]:
        """Return the lower and upper corners ``(k, d)``, of the best rectangles first."""
        order = np.argsort(self.losses[: self.count], kind="stable")[:MAX_SHOWN]
        half = 0.5 / 3.0 ** self.levels[order].astype(float)
        return self._placed(self.centres[order] - half), self._placed(self.centres[order] + half)

    def _add(self, centres: np.ndarray, levels: np.ndarray) -> None:
        losses = -self.objective.evaluate(self._placed(centres))
        end = self.count + len(centres)
        if end > len(self.losses):
            capacity = max(end, 2 * self.count)
            self.centres, self.levels, self.losses = (
                np.concatenate([array[: self.count], np.empty((capacity - self.count, *array.shape[1:]), array.dtype)])
                for array in (self.centres, self.levels, self.losses)
            )
        self.centres[self.count : end], self.levels[self.count : end] = centres, levels
        self.losses[self.count : end], self.count = losses, end
        self.worst = float(losses[np.isfinite(losses)].max(initial=self.worst))

    def _wait(self, rectangle: int) -> None:
        levels = self.levels[rectangle]
        least = int(levels.min())
        if least < DEEPEST:
            size = (least, 0 if self.biased else int((levels > least).sum()))
            heappush(self.waiting.setdefault(size, []), (float(self.losses[rectangle]), rectangle))

    def _width(self, size: tuple[int, int]) -> float:
        """Return the longest side with the local bias, else the diagonal."""
        level, shorter = size
        if self.biased:
            return float(3.0**-level)
        return float(3.0**-level * np.sqrt(self.centres.shape[1] - shorter + shorter / 9.0))

    def _placed(self, unit: np.ndarray) -> np.ndarray:
        domain = self.objective.domain
        return np.clip(domain.lower + unit * (domain.upper - domain.lower), domain.lower, domain.upper)


def best_for_some_slope(widths: np.ndarray, losses: np.ndarray, eps: float) -> Iterator[int]:
    """Yield the indices ``j`` at which a slope ``K > 0`` makes ``losses[j] - K widths[j]`` the least of all, and less
    than the least loss by the share ``eps`` of it; ``widths (k,)`` decrease."""
    least = losses.min(initial=np.inf)
    for index, (width, loss) in enumerate(zip(widths.tolist(), losses.tolist(), strict=True)):
        with np.errstate(over="ignore"):  # a slope beyond all doubles is no slope
            steepest = float(((losses[:index] - loss) / (widths[:index] - width)).min(initial=np.inf))
            flattest = float(((loss - losses[index + 1 :]) / (width - widths[index + 1 :])).max(initial=0.0))
        gains = steepest == np.inf or loss - steepest * width <= least - eps * abs(least)
        if steepest > 0.0 and flattest <= steepest and gains:
            yield index


@sr.hookimpl
def sparserob_maximisers() -> Iterator[sr.MaximiserPlugin]:
    """Offer ``direct``."""
    yield sr.MaximiserPlugin(name="direct", factory=Direct, summary="dividing rectangles, deterministic, in batches")
