"""What a maximiser is handed: the objective in the coordinates that can move."""

from __future__ import annotations

from collections.abc import Callable
from functools import cached_property
from typing import final

import numpy as np
from numpy.typing import NDArray

from sparserob_core.errors import PluginError
from sparserob_core.sip.convex_set import Array, Box
from sparserob_core.sip.maximiser import LinearBlocks, Objective


@final
class Moving:
    """The `Objective` of a search as a function of the coordinates ``moves`` ``(c,)``, ``c >= 1``, of a point ``(d,)``;
    each of the others keeps its only value.

    Its ``domain`` has ``lower < upper`` everywhere, so that no maximiser sees a degenerate box. The accounts stay with
    the search, in full coordinates. ``block``: where the same coordinates of every index can move, as many as these
    are; otherwise 1. ``asker``: who searches, for messages.
    """

    def __init__(self, objective: Objective, moves: NDArray[np.intp], asker: str) -> None:
        self._objective, self._moves, self._asker = objective, moves, asker
        self._fixed = objective.domain.lower.copy()
        self.domain = Box(objective.domain.lower[moves], objective.domain.upper[moves])
        self.block = _block(objective.block, moves, objective.domain.dimension)

    @property
    def budget(self) -> int:
        """See `Objective`."""
        return self._objective.budget

    @property
    def evaluations(self) -> int:
        """See `Objective`."""
        return self._objective.evaluations

    @property
    def remaining(self) -> int:
        """See `Objective.remaining`."""
        return self._objective.remaining

    @property
    def best_point(self) -> Array:
        """See `Objective`; ``(c,)``."""
        best: Array = self._objective.best_point[self._moves]
        return best

    @property
    def best_value(self) -> float:
        """See `Objective`."""
        return self._objective.best_value

    def known(self) -> tuple[Array, Array]:
        """See `Objective.known`; points ``(k, c)``."""
        points, values = self._objective.known()
        return points[:, self._moves], values

    @property
    def differentiable(self) -> bool:
        """See `Objective.differentiable`."""
        return self._objective.differentiable

    @property
    def _whole(self) -> bool:
        """Whether the blocks are those of the full objective, as far as they can move."""
        return self.domain.dimension // self.block == self._fixed.size // self._objective.block

    @property
    def acting(self) -> Callable[[], np.ndarray] | None:
        """See `Objective.acting`."""
        return self._objective.acting if self._whole else None

    @cached_property
    def linear(self) -> LinearBlocks | None:
        """See `Objective.linear`."""
        full = self._objective.linear
        if full is None or not self._whole:
            return None

        def steepest(point: Array) -> Array:
            return full.steepest(self._placed(point[np.newaxis])[0])[self._moves]

        return LinearBlocks(full.coordinates[self._moves], full.acting, steepest)

    def evaluate(self, points: Array) -> Array:
        """See `Objective.evaluate`; points ``(k, c)``."""
        return self._objective.evaluate(self._placed(points))

    def value_and_gradient(self, point: Array) -> tuple[float, Array]:
        """See `Objective.value_and_gradient`; point and gradient ``(c,)``."""
        value, gradient = self._objective.value_and_gradient(self._placed(np.asarray(point)[np.newaxis])[0])
        return value, gradient[self._moves]

    def accepts(self, current: float, candidate: float, temperature: float, rng: np.random.Generator) -> bool:
        """See `Objective.accepts`."""
        return self._objective.accepts(current, candidate, temperature, rng)

    def note(self, **scalars: float) -> None:
        """See `Objective.note`."""
        self._objective.note(**scalars)

    @property
    def observed(self) -> bool:
        """See `Objective.observed`."""
        return self._objective.observed

    def sketch(self, role: str, lower: Array, upper: Array | None = None, rounded: bool = False) -> None:
        """See `Objective.sketch`."""
        self._objective.sketch(role, self._placed(lower), None if upper is None else self._placed(upper), rounded)

    def _placed(self, points: Array) -> Array:
        moved = np.asarray(points, dtype=float)
        if moved.ndim != 2 or moved.shape[1] != self._moves.size:
            raise PluginError(f"{self._asker}: points: expected shape (k, {self._moves.size}), got {moved.shape}")
        full = np.repeat(self._fixed[np.newaxis], len(moved), axis=0)
        full[:, self._moves] = moved
        return full


def _block(block: int, moves: NDArray[np.intp], dimension: int) -> int:
    """How many coordinates of each index can move, where these are the same in every index; otherwise 1."""
    free = np.zeros(dimension, dtype=bool)
    free[moves] = True
    of_index = free.reshape(-1, block)
    return int(of_index[0].sum()) if (of_index == of_index[0]).all() else 1
