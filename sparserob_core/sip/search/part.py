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
    """Objective with a budget of its own, for a maximiser that lets other maximisers search.

    Parameters
    ----------
    objective : Objective
        Objective of the whole search, which counts all evaluations.
    budget : int
        Evaluations that this part may spend, of those that remain.
    points : ndarray, shape (k, d)
        Points whose values are known from the start.
    values : ndarray, shape (k,)
        Their values. A known value is returned without an evaluation, at most as often as the budget allows.

    Examples
    --------
    ``part = SearchPart(objective, 100, *objective.known())``, ``part.run(maximiser, rng)``; then ``part.best_value``.
    """

    def __init__(self, objective: Objective, budget: int, points: Array, values: Array) -> None:
        super().__init__(objective)
        self.domain, self.block = objective.domain, objective.block
        self._budget, self._spent, self._recall_count = budget, 0, 0
        self._points, self._values = points, values
        self._stored_values = {point.tobytes(): float(value) for point, value in zip(points, values, strict=True)}
        self.found: list[tuple[Array, Array]] = []
        """Points ``(k, d)`` and values ``(k,)`` of every batch that was evaluated; only the best point where all would
        be too many."""
        self._keeps = self.domain.dimension * budget <= KEPT_NUMBERS
        top = int(values.argmax()) if values.size else -1
        self._best_value = float(values[top]) if values.size else -np.inf
        self._best_point = points[top].copy() if values.size else np.full(self.domain.dimension, np.nan)

    def run(self, maximiser: Maximiser, rng: np.random.Generator) -> None:
        """Let a maximiser search until the budget of the part is spent or no improvement is possible.

        Parameters
        ----------
        maximiser : Maximiser
            The maximiser. A maximiser that requires units of about 1, or indices apart, receives them.
        rng : numpy.random.Generator
            Its random numbers.

        Raises
        ------
        SearchEnded
            Where the whole search has ended.
        PluginError
            Where the maximiser raises an error, or returns no number.
        """
        with suppress(_PartEnded):
            ask(maximiser, self, rng)

    def full(self, points: Array) -> Array:
        """Return the points unchanged: the part has the coordinates of the whole search."""
        return points

    def own(self, points: Array) -> Array:
        """Return the points unchanged: the part has the coordinates of the whole search."""
        return points

    @property
    def budget(self) -> int:
        """Evaluations that the part may spend, with the values known from the start."""
        return self._budget + len(self._values)

    @property
    def evaluations(self) -> int:
        """Evaluations of the part so far, with the values known from the start."""
        return self._spent + len(self._values)

    @property
    def remaining(self) -> int:
        """Evaluations that are left to the part."""
        return min(self._budget - self._spent, self._objective.remaining)

    @property
    def best_point(self) -> Array:
        """Best point of the part so far ``(d,)``; NaN before the first value."""
        return self._best_point.copy()

    @property
    def best_value(self) -> float:
        """Largest value of the part so far; ``-inf`` before the first value."""
        return self._best_value

    def known(self) -> tuple[Array, Array]:
        """Return the points ``(k, d)`` and values ``(k,)`` that are known from the start."""
        return self._points, self._values

    def evaluate(self, points: Array) -> Array:
        """Return the values ``(k,)`` at points ``(k, d)``, from the known values where possible.

        Parameters
        ----------
        points : ndarray, shape (k, d)
            Points of the domain.

        Returns
        -------
        ndarray, shape (k,)
            Values.

        Raises
        ------
        SearchEnded
            Where the budget of the part is spent, or the whole search has ended.
        """
        point_array = np.array(points, dtype=float)
        values = np.full(len(point_array), np.nan)
        if self._stored_values and self._recall_count < self._budget:
            values[:] = [self._stored_values.get(point.tobytes(), np.nan) for point in point_array]
            self._recall_count += int((~np.isnan(values)).sum())
        unknown = np.flatnonzero(np.isnan(values))
        allowed = unknown[: self.remaining]
        if allowed.size:
            values[allowed] = self._objective.evaluate(point_array[allowed])
            self._record(point_array[allowed], values[allowed])
        if allowed.size < unknown.size:
            raise _PartEnded("the budget of the part is spent")
        return values

    def value_and_gradient(self, point: Array) -> tuple[float, Array]:
        """Return the value and the gradient ``(d,)`` at one point ``(d,)``; this counts as one evaluation of the
        part."""
        if self.remaining <= 0:
            raise _PartEnded("the budget of the part is spent")
        value, gradient = self._objective.value_and_gradient(point)
        self._record(np.array(point, dtype=float)[np.newaxis], np.array([value]))
        return value, gradient

    def _record(self, points: Array, values: Array) -> None:
        self._spent += len(values)
        top = int(values.argmax())
        if values[top] > self._best_value or np.isnan(self._best_point[0]):
            self._best_value, self._best_point = float(values[top]), points[top].copy()
        if self._keeps:
            self.found.append((points, values))
        else:
            self.found = [(self.best_point[np.newaxis], np.array([self._best_value]))]


class _PartEnded(SearchEnded):
    """Exception that ends a part; the whole search continues."""
