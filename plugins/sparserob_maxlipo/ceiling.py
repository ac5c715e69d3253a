"""The highest of many random points under the fitted bound, without computing the bound at most of them."""

from __future__ import annotations

import numpy as np

from sparserob_maxlipo.slopes import Slopes

FRONT = 96
BATCH = 48
PASSES = 8


class Ceiling:
    """Maximises ``U``. A few points, those that decided before, bound it from above at all candidates; only where that
    is high are all points asked."""

    def __init__(self) -> None:
        self._decided = np.zeros(0)

    def highest(self, seen: Slopes, candidates: np.ndarray) -> np.ndarray:
        """The candidate with the highest bound, the first of equals."""
        self._decided = np.concatenate([0.9 * self._decided, np.ones(seen.count - self._decided.size)])
        bound = _Bound(seen)
        if seen.count <= FRONT:
            return np.asarray(candidates[bound.above(candidates, np.arange(seen.count)).argmax()])
        above = bound.above(candidates, np.argpartition(-self._decided, FRONT - 1)[:FRONT])
        order = np.argsort(-above, kind="stable")
        best, chosen = -np.inf, int(order[0])
        for start in range(0, min(len(order), BATCH * PASSES), BATCH):
            part = order[start : start + BATCH]
            if above[part[0]] <= best:
                break
            heights, deciding = bound.at(candidates[part])
            np.add.at(self._decided, deciding, 1.0)
            if heights.max() > best:
                best, chosen = float(heights.max()), int(part[heights.argmax()])
        return np.asarray(candidates[chosen])


class _Bound:
    """``U`` in units, less the best value."""

    def __init__(self, seen: Slopes) -> None:
        self.root = np.sqrt(seen.slope)
        self.scaled, self.heights = seen.points * self.root, seen.heights
        self.squares = np.einsum("ij,ij->i", self.scaled, self.scaled) + seen.noise

    def above(self, candidates: np.ndarray, which: np.ndarray) -> np.ndarray:
        """The least of the cones ``which`` at candidates ``(c, d)``: an upper bound of ``U``."""
        return np.asarray(
            self._cones(self.scaled[which], self.squares[which], self.heights[which], candidates * self.root).min(
                axis=0
            )
        )

    def at(self, candidates: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """``U`` at candidates ``(c, d)``, and which point decides it."""
        cones = self._cones(self.scaled, self.squares, self.heights, candidates * self.root)
        deciding = cones.argmin(axis=0)
        return cones[deciding, np.arange(len(candidates))], deciding

    @staticmethod
    def _cones(points: np.ndarray, squares: np.ndarray, heights: np.ndarray, candidates: np.ndarray) -> np.ndarray:
        """The cone of every point at every candidate ``(n, c)``: reductions along the first axis are the fast ones."""
        cones = points @ (-2.0 * candidates).T
        cones += squares[:, np.newaxis]
        cones += np.einsum("ij,ij->i", candidates, candidates)
        np.sqrt(np.maximum(cones, 0.0, out=cones), out=cones)
        cones += heights[:, np.newaxis]
        return np.asarray(cones)
