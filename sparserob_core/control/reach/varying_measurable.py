"""Measurable disturbances of systems that change with time: errors of execution of a command that nobody gives."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import final

import numpy as np

from sparserob_core.control.enclosures.taylor import Combination
from sparserob_core.control.reach.measurable import AT_ONCE, MeasurableSupport
from sparserob_core.control.reach.support import Support
from sparserob_core.control.reach.varying_execution import UncertainExecution, VaryingExecution, followed
from sparserob_core.control.reach.varying_motion import (
    SpreadMotion,
    SpreadSupport,
    VaryingMotion,
    VaryingSupport,
)
from sparserob_core.control.response.disturbance import DisturbanceModel
from sparserob_core.control.response.lifted import LiftedSystem
from sparserob_core.control.response.response import Response
from sparserob_core.control.sets.sets import Polytope
from sparserob_core.shapes import Float, shaped
from sparserob_core.sip.convex_set import Array, Box, ConvexSet


@final
@dataclass(frozen=True, eq=False)
class VaryingMeasurable:
    """`MeasurableSupport` of a system that changes with time. Of a box: what stays in the middle of the box, and the
    errors, through the columns of ``E``, of a command that is 1 and may be missed by half the widths. Of another set
    what all of it does at once takes the place of such errors, and the middle is 0. Where the state is expanded in
    parameters, the errors are those of all coefficients, on each of the parts of their box."""

    response: Response
    bound: ConvexSet

    @shaped
    def __call__(
        self, times: Float[Array, " k"], directions: Float[Array, "k d"], parameters: Float[Array, "k nu"]
    ) -> Float[Array, " k"]:
        """``sigma (k,)`` at ``times (k,)``, ``directions (k, d)``, ``parameters (k, nu)``."""
        along = self.errors.seen(directions, parameters)
        found = np.array(self.errors.sampled(self.command, times, along))
        resting = self.resting
        if resting is None:
            return found
        several = max(1, AT_ONCE // self.response.numbers(0))
        for first in range(0, times.size, several):
            part = slice(first, first + several)
            weights = self.response.weights(times[part], directions[part], parameters[part])
            found[part] += resting.support(weights.disturbance)
        return found

    def roughly(self, times: Array, directions: Array, parameters: Array) -> Array:
        """The same, in no other way."""
        return self(times, directions, parameters)

    @cached_property
    def middle(self) -> Array:
        """That of the box, ``(mw,)``; 0 of another set."""
        if not self.bound.is_box:
            return np.zeros(self.bound.dimension)
        box = self.bound.bounding_box()
        return np.asarray((box.lower + box.upper) / 2)

    @cached_property
    def errors(self) -> VaryingExecution | UncertainExecution:
        """How far disturbances may be from the middle: rounded outwards where that is not 0."""
        shares, bound, through = np.ones(1), None, None
        if self.bound.is_box:
            box = self.bound.bounding_box()
            far = np.maximum(box.upper - self.middle, self.middle - box.lower)
            shares = np.where(self.middle == 0.0, far, np.where(box.upper > box.lower, np.nextafter(far, np.inf), 0.0))
        else:
            bound, through = _moving(self.bound)
        ends, felt = self.response.grid.breakpoints[[0, -1]], np.ones(self.response.system.states)
        one = VaryingExecution(self.response, ends, shares, felt, disturbing=True, bound=bound, through=through)
        return followed(one)

    @property
    def command(self) -> Array:
        """The 1 that is missed, ``(mw, 1)``, of sets of all channels at once ``(1, 1)``."""
        return np.ones((self.errors.shares.size, 1))

    @cached_property
    def resting(self) -> DisturbanceModel | None:
        """The disturbance that stays in the middle, ``None`` where that is 0."""
        if not self.middle.any():
            return None
        point, pieces = Box(self.middle, self.middle), np.arange(self.response.grid.pieces)
        return DisturbanceModel("piecewise_constant", point, point, self.response.grid, starts=pieces)

    def over(
        self, rows: Array, leg: LiftedSystem | VaryingMotion | SpreadMotion, joined: Combination | None = None
    ) -> list[Support]:
        """`MeasurableSupport.over`, over a cell of parameters too."""
        assert not isinstance(leg, LiftedSystem)
        found = [self.errors.over(self.command, rows, leg, joined)]
        if self.resting is not None and isinstance(leg, SpreadMotion):
            found.append(SpreadSupport.of_disturbance(leg, self.resting, rows, joined))
        elif self.resting is not None and isinstance(leg, VaryingMotion):
            found.append(VaryingSupport.of_disturbance(leg, self.resting, rows, joined))
        return found

    def integrated_sizes(self, times: Array, directions: Array, parameters: Array) -> Array:
        """`MeasurableSupport.integrated_sizes`: integrals of absolute values."""
        along = self.errors.seen(directions, parameters)
        return np.asarray(self.errors.around.lengths(times, along).sum(axis=1))


def _moving(bound: ConvexSet) -> tuple[ConvexSet, np.ndarray]:
    """A flat set without the entries that are 0 in all of it, as those of another class are, and which the others
    are."""
    box, flat = bound.bounding_box(), bound.halfspaces()
    moving = np.flatnonzero((box.lower != 0.0) | (box.upper != 0.0))
    if moving.size in (0, bound.dimension) or flat is None:
        return bound, np.arange(bound.dimension)
    rows = flat[0][:, moving].any(axis=1)
    return Polytope(flat[0][rows][:, moving], flat[1][rows]), moving


def measurable_support(response: Response, bound: ConvexSet) -> MeasurableSupport | VaryingMeasurable:
    """The support of measurable disturbances in a set."""
    return (VaryingMeasurable if response.grid.varying else MeasurableSupport)(response, bound)
