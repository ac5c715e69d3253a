"""Measurable disturbances of systems that change with time, as errors of execution of a constant command of 1."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import final

import numpy as np
from scipy.sparse import csr_array

from sparserob_core.control.reach.measurable import AT_ONCE, MeasurableSupport
from sparserob_core.control.reach.support import NOT_PROVEN, Leg, Support
from sparserob_core.control.reach.varying_execution import UncertainExecution, VaryingExecution, followed
from sparserob_core.control.response.disturbance import DisturbanceModel
from sparserob_core.control.response.lifted import LiftedSystem
from sparserob_core.control.response.response import Response
from sparserob_core.control.sets.sets import Polytope
from sparserob_core.errors import NotEnclosable
from sparserob_core.shapes import Float, shaped
from sparserob_core.sip.convex_set import Array, Box, ConvexSet
from sparserob_core.sip.expressions.taylor import Combination

ALONE = csr_array(np.ones((1, 1)))  # one command for all times scales its own errors


@final
@dataclass(frozen=True, eq=False)
class VaryingMeasurable:
    """`MeasurableSupport` of a system that changes with time.

    A disturbance in a box is the middle of the box, at all times, plus errors of execution through the columns of
    ``E``: those of a command of 1 with half the widths of the box as shares. For another set the middle is 0, and the
    whole set takes the place of the errors. Where the state is expanded in parameters, the errors are those of all
    coefficients, on each part of the box of the parameters.
    """

    response: Response
    bound: ConvexSet

    @shaped
    def __call__(
        self, times: Float[Array, " k"], directions: Float[Array, "k d"], parameters: Float[Array, "k nu"]
    ) -> Float[Array, " k"]:
        """Return ``sigma (k,)`` at ``times (k,)``, ``directions (k, d)``, ``parameters (k, nu)``; it is not
        enclosed."""
        error_directions = self.errors.extend_directions(directions, parameters)
        values = np.array(self.errors.sampled(self.command, times, error_directions))
        resting = self.resting
        if resting is None:
            return values
        chunk_size = max(1, AT_ONCE // self.response.numbers(0))
        for first in range(0, times.size, chunk_size):
            chunk = slice(first, first + chunk_size)
            weights = self.response.weights(times[chunk], directions[chunk], parameters[chunk])
            values[chunk] += resting.support(weights.disturbance)
        return values

    def roughly(self, times: Array, directions: Array, parameters: Array) -> Array:
        """Return ``sigma (k,)`` as `__call__` does, without a rougher approximation."""
        return self(times, directions, parameters)

    @cached_property
    def middle(self) -> Array:
        """The middle of the box, ``(mw,)``; 0 for another set."""
        if not self.bound.is_box:
            return np.zeros(self.bound.dimension)
        box = self.bound.bounding_box()
        return np.asarray((box.lower + box.upper) / 2)

    @cached_property
    def errors(self) -> VaryingExecution | UncertainExecution:
        """Deviations of the disturbances from the middle, as errors of execution; the half widths are rounded outwards
        where the middle is not 0."""
        shares, bound, through = np.ones(1), None, None
        if self.bound.is_box:
            box = self.bound.bounding_box()
            half_widths = np.maximum(box.upper - self.middle, self.middle - box.lower)
            shares = np.where(
                self.middle == 0.0, half_widths, np.where(box.upper > box.lower, np.nextafter(half_widths, np.inf), 0.0)
            )
        else:
            bound, through = _drop_zero_coordinates(self.bound)
        ends, error_mask = self.response.grid.breakpoints[[0, -1]], np.ones(self.response.system.states)
        execution = VaryingExecution(
            self.response, ends, shares, error_mask, ALONE, disturbing=True, bound=bound, through=through
        )
        return followed(execution)

    @property
    def command(self) -> Array:
        """The command of 1 whose errors are the disturbances, ``(mw, 1)``; ``(1, 1)`` for a set of all channels
        together."""
        return np.ones((self.errors.shares.size, 1))

    @cached_property
    def resting(self) -> DisturbanceModel | None:
        """The disturbance that stays in the middle; ``None`` where the middle is 0."""
        if not self.middle.any():
            return None
        point, pieces = Box(self.middle, self.middle), np.arange(self.response.grid.pieces)
        return DisturbanceModel("piecewise_constant", point, point, self.response.grid, starts=pieces)

    def over(self, rows: Array, leg: Leg, joined: Combination | None = None) -> list[Support]:
        """Return the supports as `MeasurableSupport.over` does, over a cell of parameters too; raise `NotEnclosable`
        for directions that vary over it."""
        assert not isinstance(leg, LiftedSystem)
        if joined is not None and leg.space.nu:
            raise NotEnclosable(NOT_PROVEN)
        return [self.errors.over(self.command, rows, leg, joined), *leg.supports(self.resting, None, rows, joined)]

    def integrated_sizes(self, times: Array, directions: Array, parameters: Array) -> Array:
        """Return the sum ``(k,)`` of the integrals of absolute values that enter ``sigma`` at each time."""
        error_directions = self.errors.extend_directions(directions, parameters)
        return np.asarray(self.errors.around.lengths(times, error_directions).sum(axis=1))


def _drop_zero_coordinates(bound: ConvexSet) -> tuple[ConvexSet, np.ndarray]:
    """Return a flat set without the coordinates that are 0 in all of it, and the indices of the others.

    Coordinates are 0 where the disturbances in them are of another class.
    """
    box, flat = bound.bounding_box(), bound.halfspaces()
    moving = np.flatnonzero((box.lower != 0.0) | (box.upper != 0.0))
    if moving.size in (0, bound.dimension) or flat is None:
        return bound, np.arange(bound.dimension)
    rows = flat[0][:, moving].any(axis=1)
    return Polytope(flat[0][rows][:, moving], flat[1][rows]), moving


def measurable_support(response: Response, bound: ConvexSet) -> MeasurableSupport | VaryingMeasurable:
    """The support of measurable disturbances in a set."""
    return (VaryingMeasurable if response.grid.varying else MeasurableSupport)(response, bound)
