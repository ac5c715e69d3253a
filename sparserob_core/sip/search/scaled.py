"""What a maximiser is handed: the objective in units in which its box and its values are of ordinary size."""

from __future__ import annotations

from collections.abc import Callable
from functools import cached_property
from typing import final

import numpy as np

from sparserob_core.sip.convex_set import Array, Box
from sparserob_core.sip.maximiser import LinearBlocks, Objective

LEAST, LARGEST = 2.0**-1000, 2.0**1000  # units beyond these leave no room for what is computed with them


@final
class Scaled:
    """The `Objective` of a search in other units: every side of the box has a length of about 1, and the first value
    that is neither 0 nor infinite a size of about 1.

    All units are powers of two, so that no number is rounded: in other units of the user, which differ by powers of
    two, a search makes the same walk to the last bit. What is noted is passed on as it is; a rule that accepts is asked
    in the user's units. ``values (k,)``: those that are known already.
    """

    def __init__(self, objective: Objective, values: Array) -> None:
        self._objective = objective
        domain = objective.domain
        self.sides = power_of_two(domain.upper - domain.lower)
        self.domain = Box(domain.lower / self.sides, domain.upper / self.sides)
        self.value = 0.0  # the unit of the values; 0 while none is known
        self._learn(values)

    @property
    def block(self) -> int:
        """See `Objective`."""
        return self._objective.block

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
        return np.asarray(self._objective.best_point / self.sides)

    @property
    def best_value(self) -> float:
        """See `Objective`."""
        return self._objective.best_value / (self.value or 1.0)

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
        full = self._objective.linear
        if full is None:
            return None
        return LinearBlocks(
            full.coordinates, full.acting, lambda point: np.asarray(full.steepest(point * self.sides) / self.sides)
        )

    def known(self) -> tuple[Array, Array]:
        """See `Objective.known`."""
        return self.seen(*self._objective.known())

    def seen(self, points: Array, values: Array) -> tuple[Array, Array]:
        """Points ``(k, d)`` and values ``(k,)`` of the user in these units."""
        return points / self.sides, values / (self.value or 1.0)

    def evaluate(self, points: Array) -> Array:
        """See `Objective.evaluate`."""
        values = self._objective.evaluate(np.asarray(points, dtype=float) * self.sides)
        self._learn(values)
        return values / (self.value or 1.0)

    def value_and_gradient(self, point: Array) -> tuple[float, Array]:
        """See `Objective.value_and_gradient`."""
        value, slope = self._objective.value_and_gradient(np.asarray(point, dtype=float) * self.sides)
        self._learn(np.array([value]))
        return value / (self.value or 1.0), slope * (self.sides / (self.value or 1.0))

    def accepts(self, current: float, candidate: float, temperature: float, rng: np.random.Generator) -> bool:
        """See `Objective.accepts`."""
        unit = self.value or 1.0
        return self._objective.accepts(current * unit, candidate * unit, temperature * unit, rng)

    def note(self, **scalars: float) -> None:
        """See `Objective.note`."""
        self._objective.note(**scalars)

    @property
    def observed(self) -> bool:
        """See `Objective.observed`."""
        return self._objective.observed

    def sketch(self, role: str, lower: Array, upper: Array | None = None, rounded: bool = False) -> None:
        """See `Objective.sketch`."""
        self._objective.sketch(role, lower * self.sides, None if upper is None else upper * self.sides, rounded)

    def _learn(self, values: Array) -> None:
        """Take the unit of the values from the first of them that has a size."""
        usable = np.isfinite(values) & (values != 0.0)
        if not self.value and usable.any():
            self.value = float(power_of_two(np.abs(values[usable][:1]))[0])


def power_of_two(sizes: Array) -> Array:
    """The powers of two next below positive ``sizes (k,)``."""
    return np.clip(np.exp2(np.frexp(sizes)[1] - 1.0), LEAST, LARGEST)
