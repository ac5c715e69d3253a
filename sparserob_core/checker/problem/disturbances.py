"""The disturbances of a problem: where each may jump, and which of them stay constant between these times."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import final

import numpy as np

from sparserob_core.checker.outcome import Unchecked
from sparserob_core.checker.problem.held import HeldComponents
from sparserob_core.checker.problem.timing import Timing
from sparserob_core.checker.sets.known import middle
from sparserob_core.control.problem.dictionary import Dictionary
from sparserob_core.control.problem.problem import OptimalControlProblem
from sparserob_core.control.sets.sets import Box, ConvexSet, Product, product
from sparserob_core.sip.convex_set import Array


@final
@dataclass(frozen=True, eq=False)
class Disturbances:
    """The disturbances of a ``problem`` on the pieces of a ``dictionary``."""

    problem: OptimalControlProblem
    dictionary: Dictionary
    timing: Timing

    @cached_property
    def held_components(self) -> HeldComponents | None:
        """The components of the disturbance that are held over several of its pieces, ``None`` where there are none."""
        return HeldComponents.of(self.problem, self.changes or [])

    @property
    def alike(self) -> bool:
        """True where all disturbances are of one class, and those on pieces are constant on the same pieces, any value
        of the set on each."""
        is_coupled = self.problem.has_budget
        return not self.several and self.held_components is None and not is_coupled

    def may_jump(self, time: float) -> np.ndarray:
        """Return which components ``(mw,)`` of the disturbance may have another value from a time on, among those that
        are constant on pieces."""
        assert self.problem.disturbance is not None
        if self.held_components is not None:
            return self.held_components.may_jump(time)
        return np.full(self.problem.disturbance.dimension, time in (self.changes or ()))

    @property
    def several(self) -> bool:
        """True where some disturbances are measurable and others are constant on pieces."""
        return not isinstance(self.problem.disturbance_class, str)

    @cached_property
    def changes(self) -> list[float] | None:
        """The times at which the disturbance may jump; ``None`` without one. For measurable ones, which may jump at any
        time, these are the times of the grid: units of rows are measured with disturbances that jump there."""
        if self.problem.disturbance is None:
            return None
        if self.problem.measurable is not None and not self.several:
            return self.timing.grid[:-1]
        jumps = np.flatnonzero(self.dictionary.changes) + 1
        if not self.several and self.problem.disturbance_class != "piecewise_constant":
            raise Unchecked(
                "the checker knows piecewise constant and measurable disturbances, not those of the class"
                f" {self.problem.disturbance_class}"
            )
        if self.dictionary.functions != jumps.size + 1:
            raise Unchecked(
                "the checker knows disturbances that take any value on each piece, this dictionary has fewer functions"
                " than pieces"
            )
        return [0.0, *(float(self.dictionary.breakpoints[j]) for j in jumps)]

    @cached_property
    def middle(self) -> Array:
        """The middle ``(mw,)`` of the set of the disturbances; 0 where there are none."""
        bound = self.problem.disturbance
        return np.zeros(self.problem.system.disturbances) if bound is None else middle(bound)

    @cached_property
    def held(self) -> ConvexSet | None:
        """The set of the disturbances that stay constant between `changes`; ``None`` where there are none. A measurable
        disturbance is at the middle of its set here, and a bounded input contains its deviations."""
        bound, classes = self.problem.disturbance, self.problem.disturbance_class
        if self.problem.measurable is None or bound is None:
            return bound
        factors, kinds = ((bound,), (classes,)) if isinstance(classes, str) else (_list_factors(bound), classes)
        sets = [
            factor if kind != "measurable" else Box(*2 * (middle(factor),))
            for factor, kind in zip(factors, kinds, strict=True)
        ]
        held_set = product(sets)
        return None if isinstance(classes, str) and not middle(held_set).any() else held_set


def _list_factors(bound: ConvexSet) -> Sequence[ConvexSet]:
    if not isinstance(bound, Product):
        raise Unchecked("of disturbances of several classes, the checker knows lists of sets only")
    return bound.parts
