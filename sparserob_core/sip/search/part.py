"""A part of a search that one maximiser leaves to another."""

from __future__ import annotations

from contextlib import suppress
from typing import final

import numpy as np

from sparserob_core.sip.convex_set import Array
from sparserob_core.sip.maximiser import Maximiser, Objective, SearchEnded
from sparserob_core.sip.search.handed import Handed
from sparserob_core.sip.search.search import KEPT_NUMBERS, ask


@final
class SearchPart(Handed):
    """An objective with a budget of its own, for a maximiser that lets others search.

    Parameters
    ----------
    objective : Objective
        What the whole search is for, which keeps the accounts.
    budget : int
        Evaluations that this part may spend, of those that remain.
    points, values : Array
        Points ``(k, d)`` and values ``(k,)`` that it knows from the start. A value that it asks for again is taken from
        these and costs nothing, as often as its budget says.

    Examples
    --------
    ``part = SearchPart(objective, 100, *objective.known())``, ``part.run(maximiser, rng)``; then ``part.best_value``.
    """

    def __init__(self, objective: Objective, budget: int, points: Array, values: Array) -> None:
        super().__init__(objective)
        self.domain, self.block = objective.domain, objective.block
        self._budget, self._spent, self._recalls = budget, 0, 0
        self._points, self._values = points, values
        self._before = {point.tobytes(): float(value) for point, value in zip(points, values, strict=True)}
        self.found: list[tuple[Array, Array]] = []
        """Points ``(k, d)`` and values ``(k,)`` of every batch that it has evaluated; only of its best point where all
        of them would be too many."""
        self._keeps = self.domain.dimension * budget <= KEPT_NUMBERS
        top = int(values.argmax()) if values.size else -1
        self._best_value = float(values[top]) if values.size else -np.inf
        self._best_point = points[top].copy() if values.size else np.full(self.domain.dimension, np.nan)

    def run(self, maximiser: Maximiser, rng: np.random.Generator) -> None:
        """Let a maximiser search until the budget of the part is spent or nothing is left to gain.

        Parameters
        ----------
        maximiser : Maximiser
            Who searches; in units of about 1, and with indices apart, where it asks for these.
        rng : numpy.random.Generator
            What it draws from.

        Raises
        ------
        SearchEnded
            Where the whole search has ended.
        PluginError
            For a maximiser that raises, or returns no number.
        """
        with suppress(_PartEnded):
            ask(maximiser, self, rng)

    def full(self, points: Array) -> Array:
        """See `Handed.full`."""
        return points

    def own(self, points: Array) -> Array:
        """See `Handed.own`."""
        return points

    @property
    def budget(self) -> int:
        """See `Objective`."""
        return self._budget + len(self._values)

    @property
    def evaluations(self) -> int:
        """See `Objective`."""
        return self._spent + len(self._values)

    @property
    def remaining(self) -> int:
        """See `Objective.remaining`."""
        return min(self._budget - self._spent, self._objective.remaining)

    @property
    def best_point(self) -> Array:
        """See `Objective`."""
        return self._best_point.copy()

    @property
    def best_value(self) -> float:
        """See `Objective`."""
        return self._best_value

    def known(self) -> tuple[Array, Array]:
        """See `Objective.known`."""
        return self._points, self._values

    def evaluate(self, points: Array) -> Array:
        """See `Objective.evaluate`."""
        asked = np.array(points, dtype=float)
        values = np.full(len(asked), np.nan)
        if self._before and self._recalls < self._budget:
            values[:] = [self._before.get(point.tobytes(), np.nan) for point in asked]
            self._recalls += int((~np.isnan(values)).sum())
        new = np.flatnonzero(np.isnan(values))
        allowed = new[: self.remaining]
        if allowed.size:
            values[allowed] = self._objective.evaluate(asked[allowed])
            self._take(asked[allowed], values[allowed])
        if allowed.size < new.size:
            raise _PartEnded("the budget of the part is spent")
        return values

    def value_and_gradient(self, point: Array) -> tuple[float, Array]:
        """See `Objective.value_and_gradient`."""
        if self.remaining <= 0:
            raise _PartEnded("the budget of the part is spent")
        value, gradient = self._objective.value_and_gradient(point)
        self._take(np.array(point, dtype=float)[np.newaxis], np.array([value]))
        return value, gradient

    def _take(self, points: Array, values: Array) -> None:
        self._spent += len(values)
        top = int(values.argmax())
        if values[top] > self._best_value or np.isnan(self._best_point[0]):
            self._best_value, self._best_point = float(values[top]), points[top].copy()
        if self._keeps:
            self.found.append((points, values))
        else:
            self.found = [(self.best_point[np.newaxis], np.array([self._best_value]))]


class _PartEnded(SearchEnded):
    """The end of a part, after which the whole goes on."""
