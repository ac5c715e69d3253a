"""Objectives as a maximiser receives them: without fixed coordinates, in units of ordinary size, or with indices
apart."""

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

LEAST, LARGEST = 2.0**-1000, 2.0**1000  # with units beyond these, products of numbers overflow or underflow


class Handed(ABC):
    """An `Objective` in other coordinates than the objective behind it, which counts the evaluations.

    `full` maps points ``(k, c)`` of this ``domain`` to points ``(k, d)`` of the objective behind it, and `own` maps
    them back. All other calls are passed on.
    """

    domain: Box
    block: int

    def __init__(self, objective: Objective) -> None:
        self._objective = objective

    @abstractmethod
    def full(self, points: Array) -> Array:
        """Return the points ``(k, d)`` of the objective for points ``(k, c)`` of this domain."""

    @abstractmethod
    def own(self, points: Array) -> Array:
        """Return the points ``(k, c)`` of this domain for points ``(k, d)`` of the objective."""

    def marked(self, truths: np.ndarray) -> np.ndarray:
        """Return the truth values ``(c,)`` of these coordinates, from those ``(d,)`` of the objective."""
        return truths

    def slope(self, gradient: Array) -> Array:
        """Return the gradient ``(c,)`` in these coordinates, from the gradient ``(d,)`` of the objective."""
        return gradient

    def values(self, values: Array) -> Array:
        """Return the values ``(k,)`` in these units, from the values ``(k,)`` of the objective."""
        return values

    @property
    def budget(self) -> int:
        """Total number of evaluations that the search may spend."""
        return self._objective.budget

    @property
    def evaluations(self) -> int:
        """Number of evaluations so far."""
        return self._objective.evaluations

    @property
    def remaining(self) -> int:
        """Number of evaluations left; 0 once the search has ended."""
        return self._objective.remaining

    @property
    def best_point(self) -> Array:
        """Best point so far ``(c,)``; NaN while ``evaluations`` is 0."""
        return np.asarray(self.own(self._objective.best_point[np.newaxis])[0])

    @property
    def best_value(self) -> float:
        """Largest value so far, in these units; ``-inf`` while ``evaluations`` is 0."""
        return float(self.values(np.array([self._objective.best_value]))[0])

    @property
    def differentiable(self) -> bool:
        """True where `value_and_gradient` is offered."""
        return self._objective.differentiable

    @property
    def acting(self) -> Callable[[], np.ndarray] | None:
        """Function that returns the acting blocks (`Objective.acting`); ``None`` where they are not known."""
        return self._objective.acting

    @cached_property
    def linear(self) -> LinearBlocks | None:
        """Linear coordinates of the blocks, in these coordinates (`Objective.linear`); ``None`` where there are
        none."""
        behind = self._objective.linear
        if behind is None:
            return None

        def steepest(point: Array) -> Array:
            return np.asarray(self.own(behind.steepest(self.full(point[np.newaxis])[0])[np.newaxis])[0])

        return LinearBlocks(self.marked(behind.coordinates), behind.acting, steepest)

    def known(self) -> tuple[Array, Array]:
        """Return the points ``(k, c)`` that were evaluated before the search, and their values ``(k,)``."""
        return self.seen(*self._objective.known())

    def seen(self, points: Array, values: Array) -> tuple[Array, Array]:
        """Return points and values of the objective in these coordinates and units.

        Parameters
        ----------
        points : ndarray, shape (k, d)
            Points of the objective.
        values : ndarray, shape (k,)
            Their values.

        Returns
        -------
        points : ndarray, shape (k, c)
            The points in these coordinates.
        values : ndarray, shape (k,)
            The values in these units.
        """
        return self.own(points), self.values(values)

    def evaluate(self, points: Array) -> Array:
        """Return the values ``(k,)`` at points ``(k, c)`` (`Objective.evaluate`)."""
        return self.values(self._objective.evaluate(self.full(np.asarray(points, dtype=float))))

    def value_and_gradient(self, point: Array) -> tuple[float, Array]:
        """Return the value and the gradient ``(c,)`` at one point ``(c,)`` (`Objective.value_and_gradient`)."""
        value, gradient = self._objective.value_and_gradient(self.full(np.asarray(point, dtype=float)[np.newaxis])[0])
        return float(self.values(np.array([value]))[0]), self.slope(gradient)

    def accepts(self, current: float, candidate: float, temperature: float, rng: np.random.Generator) -> bool:
        """Return whether the search moves to a candidate (`Objective.accepts`)."""
        return self._objective.accepts(current, candidate, temperature, rng)

    def note(self, **scalars: float) -> None:
        """Record scalars in the trace, and pass them to observers."""
        self._objective.note(**scalars)

    @property
    def observed(self) -> bool:
        """True where anybody looks at sketches."""
        return self._objective.observed

    def sketch(self, role: str, lower: Array, upper: Array | None = None, rounded: bool = False) -> None:
        """Show observers points or regions, mapped to the coordinates of the objective (`Objective.sketch`)."""
        self._objective.sketch(role, self.full(lower), None if upper is None else self.full(upper), rounded)


@final
class MovingObjective(Handed):
    """The objective in the coordinates that can move; each of the others keeps its only value.

    The ``domain`` has ``lower < upper`` everywhere, so that no maximiser receives a degenerate box. The ``block`` is
    the number of moving coordinates of an index, where they are the same in every index; otherwise it is 1.

    Parameters
    ----------
    objective : Objective
        The objective in all coordinates ``(d,)``.
    moves : ndarray of int, shape (c,)
        Coordinates that can move, at least one.
    asker : str
        Name of the maximiser in messages.
    """

    def __init__(self, objective: Objective, moves: NDArray[np.intp], asker: str) -> None:
        super().__init__(objective)
        self._free_axes, self._asker = moves, asker
        self._fixed = objective.domain.lower.copy()
        self.domain = Box(objective.domain.lower[moves], objective.domain.upper[moves])
        self.block = _count_moving(objective.block, moves, objective.domain.dimension)

    def full(self, points: Array) -> Array:
        """Return points ``(k, d)`` with the fixed coordinates filled in; raise `PluginError` for a wrong shape."""
        free_points = np.asarray(points, dtype=float)
        if free_points.ndim != 2 or free_points.shape[1] != self._free_axes.size:
            raise PluginError(
                f"{self._asker}: points: expected shape (k, {self._free_axes.size}), got {free_points.shape}"
            )
        full = np.repeat(self._fixed[np.newaxis], len(free_points), axis=0)
        full[:, self._free_axes] = free_points
        return full

    def own(self, points: Array) -> Array:
        """Return the moving coordinates ``(k, c)`` of points ``(k, d)``."""
        return points[:, self._free_axes]

    def marked(self, truths: np.ndarray) -> np.ndarray:
        """Return the truth values ``(c,)`` of the moving coordinates."""
        return truths[self._free_axes]

    def slope(self, gradient: Array) -> Array:
        """Return the gradient ``(c,)`` in the moving coordinates."""
        return gradient[self._free_axes]

    @property
    def _has_full_blocks(self) -> bool:
        """True where the blocks are those of the full objective, without their fixed coordinates."""
        return self.domain.dimension // self.block == self._fixed.size // self._objective.block

    @property
    def acting(self) -> Callable[[], np.ndarray] | None:
        """Function that returns the acting blocks; ``None`` where the blocks differ from those of the objective."""
        return self._objective.acting if self._has_full_blocks else None

    @cached_property
    def linear(self) -> LinearBlocks | None:
        """Linear coordinates of the blocks; ``None`` where the blocks differ from those of the objective."""
        return super().linear if self._has_full_blocks else None


@final
class ScaledObjective(Handed):
    """The objective in units in which the box and the values are of size 1.

    Every side of the box has a length of about 1. The first value that is neither 0 nor infinite has a size of about 1.
    All units are powers of two, so that no number is rounded. In other units of the user that differ by powers of two,
    a search has the same trajectory, to the last bit. Notes are passed on unchanged; a rule of acceptance receives the
    user's units.

    Parameters
    ----------
    objective : Objective
        The objective in the user's units.
    values : ndarray, shape (k,)
        Values that are already known.
    """

    def __init__(self, objective: Objective, values: Array) -> None:
        super().__init__(objective)
        domain, self.block = objective.domain, objective.block
        self.sides = power_of_two(domain.upper - domain.lower)
        self.domain = Box(domain.lower / self.sides, domain.upper / self.sides)
        self.value = 0.0  # the unit of the values; 0 while none is known
        self._set_value_unit(values)

    def full(self, points: Array) -> Array:
        """Return points ``(k, d)`` in the user's units."""
        return np.asarray(points * self.sides)

    def own(self, points: Array) -> Array:
        """Return points ``(k, d)`` in units of size 1."""
        return np.asarray(points / self.sides)

    def values(self, values: Array) -> Array:
        """Return values ``(k,)`` in their unit, which is set by the first value that is neither 0 nor infinite."""
        self._set_value_unit(values)
        return values / (self.value or 1.0)

    def slope(self, gradient: Array) -> Array:
        """Return the gradient ``(d,)`` in units of size 1."""
        return np.asarray(gradient * (self.sides / (self.value or 1.0)))

    def accepts(self, current: float, candidate: float, temperature: float, rng: np.random.Generator) -> bool:
        """Return whether the search moves to a candidate; the rule receives the user's units."""
        unit = self.value or 1.0
        return self._objective.accepts(current * unit, candidate * unit, temperature * unit, rng)

    def _set_value_unit(self, values: Array) -> None:
        """Set the unit of the values by the first of them that is neither 0 nor infinite."""
        usable = np.isfinite(values) & (values != 0.0)
        if not self.value and usable.any():
            self.value = float(power_of_two(np.abs(values[usable][:1]))[0])


@final
class Apart(Handed):
    """The objective with every index of a tuple shifted cyclically in its box, each by another amount.

    In the middle of the box all indices of a tuple would be equal. After the shifts they differ there, as evenly as
    possible. Otherwise a search that begins in the middle, and divides one coordinate after the other, learns no more
    from a tuple than from one index. The first coordinates, usually times, are in the middles of equally many equal
    parts of the side. The others follow the sequence of Roberts (2018). The two ends of a side become neighbours.
    """

    def __init__(self, objective: Objective) -> None:
        super().__init__(objective)
        self.domain, self.block = objective.domain, objective.block
        count, other_count = self.domain.dimension // self.block, self.block - 1
        root = 2.0
        for _ in range(60):
            root = (1.0 + root) ** (1.0 / (other_count + 1.0))
        numbers = np.arange(count)[:, np.newaxis]
        other_places = 0.5 + (numbers - (count - 1) / 2.0) * root ** -np.arange(1.0, other_count + 1.0)
        places = np.hstack([(numbers + 0.5) / count, other_places]).ravel()
        self._sides = self.domain.upper - self.domain.lower
        self._shift = np.mod(places - 0.5, 1.0) * self._sides

    def full(self, points: Array) -> Array:
        """Return the points ``(k, d)`` with every index shifted."""
        return self._shift_points(points, self._shift)

    def own(self, points: Array) -> Array:
        """Return the points ``(k, d)`` with the shifts undone."""
        return self._shift_points(points, -self._shift)

    @cached_property
    def linear(self) -> LinearBlocks | None:
        """``None``: after the shifts, a vertex is at both ends of a side."""
        return None

    def sketch(self, role: str, lower: Array, upper: Array | None = None, rounded: bool = False) -> None:
        """Show observers points or regions; a box is placed by its middle, and cut off at the domain."""
        if upper is None:
            super().sketch(role, lower)
            return
        middle, half = self.full((lower + upper) / 2.0), (upper - lower) / 2.0
        low, high = (np.clip(middle + side, self.domain.lower, self.domain.upper) for side in (-half, half))
        self._objective.sketch(role, low, high, rounded)

    def _shift_points(self, points: Array, shift: Array) -> Array:
        offsets = points - self.domain.lower + shift
        offsets = np.where(
            offsets < 0.0, offsets + self._sides, np.where(offsets > self._sides, offsets - self._sides, offsets)
        )
        return np.clip(self.domain.lower + offsets, self.domain.lower, self.domain.upper)


def _count_moving(block: int, moves: NDArray[np.intp], dimension: int) -> int:
    """Return the number of moving coordinates of an index, where they are the same in every index; otherwise 1."""
    free = np.zeros(dimension, dtype=bool)
    free[moves] = True
    of_index = free.reshape(-1, block)
    return int(of_index[0].sum()) if (of_index == of_index[0]).all() else 1


def power_of_two(sizes: Array) -> Array:
    """Return the largest powers of two that do not exceed positive ``sizes (k,)``."""
    return np.clip(np.exp2(np.frexp(sizes)[1] - 1.0), LEAST, LARGEST)
