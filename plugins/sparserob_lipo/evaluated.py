"""Evaluated points, lowest value first, and the balls that a Lipschitz constant excludes."""

from __future__ import annotations

from typing import Final

import numpy as np

KEPT_NUMBERS: Final = 2**25  # coordinates of kept points, 256 MB: more than enough below some ten thousand dimensions
TESTED_NUMBERS: Final = 2**22  # coordinates of points that are gathered for one part of the test
FRONT: Final = 16
GROUP: Final = 8
ROUNDED: Final = 8 * float(np.finfo(float).eps)  # of a value, which is no rise


class Evaluated:
    """Points ``(n, d)`` with finite values ``(n,)``, ordered by value from the lowest, and the steepest slope between
    any two.

    A point that is far below the best excludes the largest ball around it, so in this order a test ends early. Where
    all points would take too much memory, those of high value, which exclude least, are forgotten: fewer places are
    excluded then, and none wrongly.
    """

    def __init__(self, dimension: int, budget: int) -> None:
        self.capacity = max(2, min(budget, KEPT_NUMBERS // dimension))
        self.part = max(1, TESTED_NUMBERS // dimension)
        self._points = np.empty((self.capacity + 1, dimension))
        self._order = np.arange(self.capacity + 1)  # _points[_order[:count]] are sorted; the row _order[count] is free
        self._values, self._of_row = np.empty(self.capacity + 1), np.empty(self.capacity + 1)
        self.count, self.slope = 0, 0.0

    @property
    def values(self) -> np.ndarray:
        """Values ``(n,)``, the lowest first."""
        return self._values[: self.count]

    @property
    def best_point(self) -> np.ndarray:
        """Point ``(d,)`` of the last of `values`."""
        best: np.ndarray = self._points[self._order[self.count - 1]]
        return best

    def balls(self, constant: float, most: int) -> tuple[np.ndarray, np.ndarray]:
        """Return the balls that the constant excludes: the ``most`` largest, of centres ``(k, d)`` and radii ``(k,)``,
        the largest first."""
        radii = (self.values[-1] - self.values[:most]) / constant
        count = int(np.searchsorted(-radii, 0.0))
        return self._points[self._order[:count]], radii[:count]

    def add(self, point: np.ndarray, value: float) -> None:
        """Remember a finite value; one pass over the points updates the slope."""
        count, row = self.count, self._order[self.count]
        self._points[row], self._of_row[row] = point, value
        if count:
            self.slope = max(self.slope, self._steepest(point, value))
        position = int(np.searchsorted(self._values[:count], value, side="right"))
        for array, entry in ((self._values, value), (self._order, row)):
            array[position + 1 : count + 1] = array[position:count]
            array[position] = entry
        self.count = count + 1
        if self.count > self.capacity:
            for entries in (self._values, self._order):
                entries[count - 1], entries[count] = entries[count], entries[count - 1]
            self.count = count

    def first_possible(self, candidates: np.ndarray, constant: float) -> int | None:
        """Return the index of the first of the candidates ``(m, d)`` whose value can still reach the best,
        ``value_i + constant |x - x_i| >= best`` for all ``i``; ``None`` if there is none."""
        radii = self._radii(constant)
        with np.errstate(over="ignore"):
            squares = np.square(radii[: int(np.searchsorted(-radii, 0.0))])
        alive = self._outside(candidates, np.arange(len(candidates)), squares, 0, FRONT)
        group = GROUP
        while alive.size:  # most are excluded by now; those behind the first that is not need no test
            tested, alive = alive[:group], alive[group:]
            tested = self._outside(candidates, tested, squares, FRONT, 4 * FRONT)
            if tested.size:
                return int(tested[0])
            group *= 4
        return None

    def _outside(
        self, candidates: np.ndarray, alive: np.ndarray, squares: np.ndarray, start: int, size: int
    ) -> np.ndarray:
        """Return those of the indices ``alive`` whose candidates lie in none of the balls from ``start`` on (of the
        first ``FRONT`` only when it is 0)."""
        from scipy.spatial.distance import cdist

        last = len(squares) if start else min(FRONT, len(squares))
        while start < last and alive.size:
            stop = min(last, start + min(size, self.part))
            distances = cdist(candidates[alive], self._points[self._order[start:stop]], "sqeuclidean")
            alive = alive[(distances >= squares[start:stop]).all(axis=1)]
            start, size = stop, 4 * size
        return alive

    def bounds(self, places: np.ndarray, constant: float) -> np.ndarray:
        """Return the Lipschitz bound ``min_i value_i + constant |x - x_i|`` at places ``(m, d)``."""
        from scipy.spatial.distance import cdist

        lowest = np.full(len(places), np.inf)
        for start in range(0, self.count, self.part):
            rows = self._order[start : min(self.count, start + self.part)]
            with np.errstate(over="ignore"):
                cones = self._values[start : start + len(rows)] + constant * cdist(places, self._points[rows])
            lowest = np.minimum(lowest, cones.min(axis=1))
        return lowest

    def refutes(self, constant: float, allowance: float) -> bool:
        """Return whether two values differ by more than the constant permits, beyond the allowance for rounding."""
        for start in range(0, self.count, self.part):
            stop = min(self.count, start + self.part)
            bounds = self.bounds(self._points[self._order[start:stop]], constant)
            if (bounds < self._values[start:stop] - allowance).any():
                return True
        return False

    def _radii(self, constant: float) -> np.ndarray:
        if constant == 0.0:
            return np.zeros(self.count)
        with np.errstate(over="ignore"):
            radii: np.ndarray = (self.values[-1] - self.values) / constant
        return radii

    def _steepest(self, point: np.ndarray, value: float) -> float:
        from scipy.spatial.distance import cdist

        steepest = 0.0
        # the free row, which holds the point itself, is among them where the capacity is reached
        row_count = self.count + (self.count == self.capacity)
        # in the order of the memory: to gather rows takes several times as long
        for start in range(0, row_count, self.part):
            rows = slice(start, min(row_count, start + self.part))
            distances = cdist(point[np.newaxis], self._points[rows])[0]
            is_distinct = distances > 0
            other_values = self._of_row[rows][is_distinct]
            with np.errstate(over="ignore"):
                rise = np.abs(other_values - value) - ROUNDED * np.maximum(np.abs(other_values), abs(value))
                slopes = rise / distances[is_distinct]
            steepest = max(steepest, float(slopes.max(initial=0.0)))
        return min(steepest, float(np.finfo(float).max))
