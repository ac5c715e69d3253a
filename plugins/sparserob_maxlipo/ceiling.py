"""Highest of many random points under the fitted bound, without computing the bound at most of them."""

from __future__ import annotations

import numpy as np

from sparserob_maxlipo.slopes import Slopes

FRONT = 96
BATCH = 48
PASSES = 8


class Ceiling:
    """Maximiser of ``U`` over candidates. A few points, those that decided before, bound it from above at all
    candidates; only where that is high are all points asked."""

    def __init__(self) -> None:
        self._decided = np.zeros(0)
        self._slope, self._squares = np.zeros(0), np.zeros(0)

    def highest(self, seen: Slopes, candidates: np.ndarray) -> np.ndarray:
        """Return the candidate with the highest bound, the first of equals."""
        self._decided = np.concatenate([0.9 * self._decided, np.ones(seen.count - self._decided.size)])
        bound = _Bound(seen, self._lengths(seen))
        if seen.count <= FRONT:
            return np.asarray(candidates[bound.above(candidates, np.arange(seen.count)).argmax()])
        if len(candidates) <= BATCH:  # all of which would be asked
            heights, deciding = bound.at(candidates)
            np.add.at(self._decided, deciding, 1.0)
            return np.asarray(candidates[heights.argmax()])
        upper_bounds = bound.above(candidates, np.argpartition(-self._decided, FRONT - 1)[:FRONT])
        order = np.argsort(-upper_bounds, kind="stable")
        best, chosen = -np.inf, int(order[0])
        for start in range(0, min(len(order), BATCH * PASSES), BATCH):
            batch = order[start : start + BATCH]
            if upper_bounds[batch[0]] <= best:
                break
            heights, deciding = bound.at(candidates[batch])
            np.add.at(self._decided, deciding, 1.0)
            if heights.max() > best:
                best, chosen = float(heights.max()), int(batch[heights.argmax()])
        return np.asarray(candidates[chosen])

    def _lengths(self, seen: Slopes) -> np.ndarray:
        """Return ``sum_j s_j x_ij^2`` of every point ``(n,)``; computed for the new points only, while the slopes are
        the same."""
        known_count = self._squares.size if np.array_equal(self._slope, seen.slope) else 0
        new_squares = np.einsum("ij,ij->i", seen.points[known_count:] * seen.slope, seen.points[known_count:])
        self._slope, self._squares = seen.slope.copy(), np.concatenate([self._squares[:known_count], new_squares])
        return self._squares


class _Bound:
    """Upper bound ``U`` in units, less the best value. ``lengths (n,)``: ``sum_j s_j x_ij^2``."""

    def __init__(self, seen: Slopes, lengths: np.ndarray) -> None:
        self.slope, self.points, self.heights = seen.slope, seen.points, seen.heights
        self.squares = lengths + seen.noise

    def above(self, candidates: np.ndarray, which: np.ndarray) -> np.ndarray:
        """Return the least of the cones ``which`` at candidates ``(c, d)``: an upper bound of ``U``."""
        cones = self._cones(self.points[which], self.squares[which], self.heights[which], candidates)
        return np.asarray(cones.min(axis=0))

    def at(self, candidates: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return ``U`` at candidates ``(c, d)``, and the index of the point that decides it."""
        cones = self._cones(self.points, self.squares, self.heights, candidates)
        deciding = cones.argmin(axis=0)
        return cones[deciding, np.arange(len(candidates))], deciding

    def _cones(
        self, points: np.ndarray, squares: np.ndarray, heights: np.ndarray, candidates: np.ndarray
    ) -> np.ndarray:
        """Return the cone of every point at every candidate ``(n, c)``: reductions along the first axis are the fast
        ones."""
        weighted = candidates * self.slope  # the candidates are few, and are scaled in the place of the points
        cones = points @ (-2.0 * weighted).T
        cones += squares[:, np.newaxis]
        cones += np.einsum("ij,ij->i", weighted, candidates)
        np.sqrt(np.maximum(cones, 0.0, out=cones), out=cones)
        cones += heights[:, np.newaxis]
        return np.asarray(cones)
