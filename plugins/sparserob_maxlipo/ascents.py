"""Local half of the search: one ascent after another, each from the best point that is not below an earlier one."""

from __future__ import annotations

import numpy as np

import sparserob_core as sr
from sparserob_maxlipo.slopes import Slopes

APART = 0.03
"""A point that lies within this share of the box of a summit, and no higher, starts no further ascent."""


class Ascents:
    """Trust regions, one at a time; where one ended is a summit, and the next begins elsewhere."""

    def __init__(self, seen: Slopes) -> None:
        self.seen, self._region, self._progress = seen, sr.TrustRegion(), list[float]()
        self._summits, self._heights = np.empty((0, seen.points.shape[1])), np.empty(0)
        self._closed = np.zeros(0, dtype=bool)

    @property
    def secondary(self) -> bool:
        """True where the best point is a summit, so that the next ascent begins lower."""
        return bool(self._heights.max(initial=-np.inf) >= self.seen.best)

    @property
    def radius(self) -> float:
        """Radius of the present trust region."""
        return self._region.radius

    def propose(self) -> np.ndarray | None:
        """Return the next point ``(d,)`` of the ascent, or ``None`` when it has just ended or none can begin."""
        points, values = self._open()
        if len(points) <= points.shape[1] + 1 or not np.isfinite(values.max()):
            return None
        value = float(values.max())
        point = None if self._futile(value) else self._region.propose(points, values)
        if point is None or self._is_below_a_summit(point, value):
            self._end(points[values.argmax()], value)
            return None
        return point

    def tell(self, value: float) -> None:
        """Report the value at the point that was proposed last to the trust region."""
        self._region.tell(value)

    def note_global(self, point: np.ndarray, value: float) -> None:
        """Begin the ascent again from the point of a global step, if it is the better start and far away."""
        points, values = self._open()
        if not len(points) or value < values.max() or self._closed[-1]:
            return
        earlier_values = values[:-1]
        if len(earlier_values) and float(np.linalg.norm(point - points[earlier_values.argmax()])) > self._region.radius:
            self._begin()

    def _begin(self) -> None:
        self._region, self._progress = sr.TrustRegion(), []

    def _end(self, summit: np.ndarray, height: float) -> None:
        slopes = self.seen
        self._summits, self._heights = np.vstack([self._summits, summit]), np.append(self._heights, height)
        self._closed |= (np.abs(slopes.points - summit).max(axis=1) < APART) & (slopes.raw <= height)
        self._begin()

    def _is_below_a_summit(self, point: np.ndarray, value: float) -> bool:
        return bool(((np.abs(self._summits - point).max(axis=1) < APART) & (value <= self._heights)).any())

    def _open(self) -> tuple[np.ndarray, np.ndarray]:
        """Return the points that lie below no summit, and their values."""
        points, values = self.seen.points, self.seen.raw
        checked_count = self._closed.size
        is_below = [
            self._is_below_a_summit(point, value)
            for point, value in zip(points[checked_count:], values[checked_count:], strict=True)
        ]
        self._closed = np.concatenate([self._closed, np.array(is_below, dtype=bool)])
        return points[~self._closed], values[~self._closed]

    def _futile(self, value: float) -> bool:
        """Return whether recent progress would not carry this ascent to the best value."""
        self._progress.append(value)
        window = 2 * self.seen.points.shape[1] + 4
        return len(self._progress) > window and bool(
            self.seen.best - value > 4.0 * (value - self._progress[-1 - window])
        )
