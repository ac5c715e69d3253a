"""What a maximiser is handed: the objective in the coordinates that can move, in units in which its box and its values
are of ordinary size, and with the indices of a tuple apart in its middle."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable
from functools import cached_property
from typing import final

import numpy as np
from numpy.typing import NDArray

from sparserob_core.errors import PluginError
from sparserob_core.sip.convex_set import Array, Box
from sparserob_core.sip.maximiser import LinearBlocks, Objective

LEAST, LARGEST = 2.0**-1000, 2.0**1000  # units beyond these leave no room for what is computed with them


class Handed(ABC):
    """An `Objective` in coordinates of its own: points ``(k, c)`` of its ``domain`` are `full` ones ``(k, d)`` of the
    objective behind it, which `own` leads back from; everything else is passed on. The accounts stay behind it."""

    domain: Box
    block: int

    def __init__(self, objective: Objective) -> None:
        self._objective = objective

    @abstractmethod
    def full(self, points: Array) -> Array:
        """Points ``(k, d)`` of the objective."""

    @abstractmethod
    def own(self, points: Array) -> Array:
        """Points ``(k, c)`` of the domain."""

    def marked(self, truths: np.ndarray) -> np.ndarray:
        """Which coordinates are meant ``(c,)``, of those of the objective ``(d,)``."""
        return truths

    def slope(self, gradient: Array) -> Array:
        """A gradient of the objective ``(d,)`` as one of this ``(c,)``."""
        return gradient

    def values(self, values: Array) -> Array:
        """Values of the objective ``(k,)`` as those of this."""
        return values

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
        """See `Objective`."""
        return np.asarray(self.own(self._objective.best_point[np.newaxis])[0])

    @property
    def best_value(self) -> float:
        """See `Objective`."""
        return float(self.values(np.array([self._objective.best_value]))[0])

    @property
    def differentiable(self) -> bool:
        """See `Objective.differentiable`."""
        return self._objective.differentiable

    @property
    def acting(self) -> Callable[[], np.ndarray] | None:
        """See `Objective.acting`."""
        return self._objective.acting

    @cached_property
    def linear(self) -> LinearBlocks | None:
        """See `Objective.linear`."""
        behind = self._objective.linear
        if behind is None:
            return None

        def steepest(point: Array) -> Array:
            return np.asarray(self.own(behind.steepest(self.full(point[np.newaxis])[0])[np.newaxis])[0])

        return LinearBlocks(self.marked(behind.coordinates), behind.acting, steepest)

    def known(self) -> tuple[Array, Array]:
        """See `Objective.known`."""
        return self.seen(*self._objective.known())

    def seen(self, points: Array, values: Array) -> tuple[Array, Array]:
        """Points ``(k, d)`` and values ``(k,)`` of the objective as they are here."""
        return self.own(points), self.values(values)

    def evaluate(self, points: Array) -> Array:
        """See `Objective.evaluate`."""
        return self.values(self._objective.evaluate(self.full(np.asarray(points, dtype=float))))

    def value_and_gradient(self, point: Array) -> tuple[float, Array]:
        """See `Objective.value_and_gradient`."""
        value, gradient = self._objective.value_and_gradient(self.full(np.asarray(point, dtype=float)[np.newaxis])[0])
        return float(self.values(np.array([value]))[0]), self.slope(gradient)

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
        self._objective.sketch(role, self.full(lower), None if upper is None else self.full(upper), rounded)


@final
class Moving(Handed):
    """The coordinates ``moves`` ``(c,)``, ``c >= 1``, of a point ``(d,)``; each of the others keeps its only value.

    The ``domain`` has ``lower < upper`` everywhere, so that no maximiser sees a degenerate box. ``block``: where the
    same coordinates of every index can move, as many as these are; otherwise 1. ``asker``: who searches, for messages.
    """

    def __init__(self, objective: Objective, moves: NDArray[np.intp], asker: str) -> None:
        super().__init__(objective)
        self._moves, self._asker = moves, asker
        self._fixed = objective.domain.lower.copy()
        self.domain = Box(objective.domain.lower[moves], objective.domain.upper[moves])
        self.block = _block(objective.block, moves, objective.domain.dimension)

    def full(self, points: Array) -> Array:
        """See `Handed.full`."""
        moved = np.asarray(points, dtype=float)
        if moved.ndim != 2 or moved.shape[1] != self._moves.size:
            raise PluginError(f"{self._asker}: points: expected shape (k, {self._moves.size}), got {moved.shape}")
        full = np.repeat(self._fixed[np.newaxis], len(moved), axis=0)
        full[:, self._moves] = moved
        return full

    def own(self, points: Array) -> Array:
        """See `Handed.own`."""
        return points[:, self._moves]

    def marked(self, truths: np.ndarray) -> np.ndarray:
        """See `Handed.marked`."""
        return truths[self._moves]

    def slope(self, gradient: Array) -> Array:
        """See `Handed.slope`."""
        return gradient[self._moves]

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
        return super().linear if self._whole else None


@final
class Scaled(Handed):
    """Other units: every side of the box has a length of about 1, and the first value that is neither 0 nor infinite a
    size of about 1.

    All units are powers of two, so that no number is rounded: in other units of the user, which differ by powers of
    two, a search makes the same walk to the last bit. What is noted is passed on as it is; a rule that accepts is asked
    in the user's units. ``values (k,)``: those that are known already.
    """

    def __init__(self, objective: Objective, values: Array) -> None:
        super().__init__(objective)
        domain, self.block = objective.domain, objective.block
        self.sides = power_of_two(domain.upper - domain.lower)
        self.domain = Box(domain.lower / self.sides, domain.upper / self.sides)
        self.value = 0.0  # the unit of the values; 0 while none is known
        self._learn(values)

    def full(self, points: Array) -> Array:
        """See `Handed.full`."""
        return np.asarray(points * self.sides)

    def own(self, points: Array) -> Array:
        """See `Handed.own`."""
        return np.asarray(points / self.sides)

    def values(self, values: Array) -> Array:
        """See `Handed.values`; the first that has a size is the unit."""
        self._learn(values)
        return values / (self.value or 1.0)

    def slope(self, gradient: Array) -> Array:
        """See `Handed.slope`."""
        return np.asarray(gradient * (self.sides / (self.value or 1.0)))

    def accepts(self, current: float, candidate: float, temperature: float, rng: np.random.Generator) -> bool:
        """See `Objective.accepts`."""
        unit = self.value or 1.0
        return self._objective.accepts(current * unit, candidate * unit, temperature * unit, rng)

    def _learn(self, values: Array) -> None:
        """Take the unit of the values from the first of them that has a size."""
        usable = np.isfinite(values) & (values != 0.0)
        if not self.value and usable.any():
            self.value = float(power_of_two(np.abs(values[usable][:1]))[0])


@final
class Apart(Handed):
    """Every index of a tuple shifted round its box by as much of its own: in the middle of the box, where all of them
    would be one, they are apart, as evenly as so many can be.

    A search that begins in the middle and cuts one coordinate after the other sees nothing of a tuple otherwise but
    what one index shows. The first coordinates, times as a rule, are in the middles of as many equal parts; the others
    follow the sequence of Roberts (2018). What is at the end of a side is beside what is at its beginning.
    """

    def __init__(self, objective: Objective) -> None:
        super().__init__(objective)
        self.domain, self.block = objective.domain, objective.block
        count, rest = self.domain.dimension // self.block, self.block - 1
        root = 2.0
        for _ in range(60):
            root = (1.0 + root) ** (1.0 / (rest + 1.0))
        numbers = np.arange(count)[:, np.newaxis]
        others = 0.5 + (numbers - (count - 1) / 2.0) * root ** -np.arange(1.0, rest + 1.0)
        places = np.hstack([(numbers + 0.5) / count, others]).ravel()
        self._sides = self.domain.upper - self.domain.lower
        self._shift = np.mod(places - 0.5, 1.0) * self._sides

    def full(self, points: Array) -> Array:
        """See `Handed.full`."""
        return self._moved(points, self._shift)

    def own(self, points: Array) -> Array:
        """See `Handed.own`."""
        return self._moved(points, -self._shift)

    @cached_property
    def linear(self) -> LinearBlocks | None:
        """None: a vertex is at both ends of a side."""
        return None

    def sketch(self, role: str, lower: Array, upper: Array | None = None, rounded: bool = False) -> None:
        """See `Objective.sketch`; boxes are where their middles are, as far as these are within the domain."""
        if upper is None:
            super().sketch(role, lower)
            return
        middle, half = self.full((lower + upper) / 2.0), (upper - lower) / 2.0
        low, high = (np.clip(middle + side, self.domain.lower, self.domain.upper) for side in (-half, half))
        self._objective.sketch(role, low, high, rounded)

    def _moved(self, points: Array, shift: Array) -> Array:
        moved = points - self.domain.lower + shift
        moved = np.where(moved < 0.0, moved + self._sides, np.where(moved > self._sides, moved - self._sides, moved))
        return np.clip(self.domain.lower + moved, self.domain.lower, self.domain.upper)


def _block(block: int, moves: NDArray[np.intp], dimension: int) -> int:
    """How many coordinates of each index can move, where these are the same in every index; otherwise 1."""
    free = np.zeros(dimension, dtype=bool)
    free[moves] = True
    of_index = free.reshape(-1, block)
    return int(of_index[0].sum()) if (of_index == of_index[0]).all() else 1


def power_of_two(sizes: Array) -> Array:
    """The powers of two next below positive ``sizes (k,)``."""
    return np.clip(np.exp2(np.frexp(sizes)[1] - 1.0), LEAST, LARGEST)
