"""Functionals over cells of parameters: the system there, phase by phase, and what the uncertainty adds to a row."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, final

import numpy as np

from sparserob_core.control.enclosures.cache import remember
from sparserob_core.control.reach.disturbance_support import DisturbanceSupport
from sparserob_core.control.reach.support import InitialSupport, Leg, Support, Supports
from sparserob_core.control.reach.varying_motion import SpreadMotion, VaryingMotion
from sparserob_core.control.response.disturbance import DisturbanceModel
from sparserob_core.control.response.lifted import LiftedSystem, frozen, lift_legs
from sparserob_core.control.response.response import Response
from sparserob_core.errors import NotEnclosable
from sparserob_core.shapes import Float, shaped
from sparserob_core.sip.convex_set import Array, ConvexSet
from sparserob_core.sip.expressions.taylor import Combination

if TYPE_CHECKING:
    from sparserob_core.control.reach.execution import Execution
    from sparserob_core.control.reach.measurable import MeasurableSupport
    from sparserob_core.control.reach.varying_measurable import VaryingMeasurable

HALVINGS = 8  # of a part of the parameters, after which states that still have no bound on a cell have none
LEGS_KEPT = 256  # cells of parameters whose lifted systems are kept


@final
@dataclass(frozen=True, eq=False)
class FunctionalsOverCells:
    """`WorstFunctionals` over cells of parameters, ``low, high (nu,)``.

    ``disturbance``, ``initial``, ``execution`` and ``measurable`` are the uncertainty, each ``None`` where there is
    none; ``known (m + constants, L)`` are the inputs that are not decided.
    """

    response: Response
    disturbance: DisturbanceModel | None
    initial: ConvexSet | None
    execution: Execution | None
    measurable: MeasurableSupport | VaryingMeasurable | None
    known: Array

    @shaped
    def legs(self, low: Float[Array, " nu"], high: Float[Array, " nu"]) -> tuple[Leg, ...]:
        """Return the lifted system over a cell of parameters, phase by phase, or the motion of a system that changes
        with time.

        The result is remembered, for all constraints.
        """
        key, response = low.tobytes() + high.tobytes(), self.response
        if key not in self._cached_phases:
            cell = (low + high) / 2, (high - low) / 2
            legs: tuple[Leg, ...]
            if response.propagator.laws is not None:
                legs = (self._expand_over_cell(low, high),)
            elif response.grid.varying:
                legs = (VaryingMotion(response.propagator, response.initial_state),)
            else:
                legs = lift_legs(response, *cell)
            remember(self._cached_phases, key, legs, LEGS_KEPT)
        return self._cached_phases[key]

    @shaped
    def at(self, parameter: Float[Array, " nu"]) -> LiftedSystem:
        """Return the lifted system of a system without phases at one parameter; it is remembered."""
        lifted = self._frozen_systems.get(parameter.tobytes())
        if lifted is None:
            arguments = (self.response.system.modes[0], self.response.grid, self.response.initial_state, parameter)
            lifted = remember(self._frozen_systems, parameter.tobytes(), frozen(*arguments), LEGS_KEPT)
        return lifted

    def _expand_over_cell(self, low: Array, high: Array) -> SpreadMotion:
        """Return the motion over a cell of parameters; its growth bound is the least known one of the cells around it,
        if there is any."""
        propagator, initial_state = self.response.propagator, self.response.initial_state
        assert propagator.laws is not None
        part_index = propagator.laws.holding(low, high)  # growth is in the units of a part
        around = [
            growth
            for own, a, b, growth in self._growth_bounds
            if own == part_index and (a <= low).all() and (high <= b).all()
        ]
        least_growth = min(around, default=None)
        leg = SpreadMotion.of(propagator.on_cell(low, high), initial_state, least_growth)
        if least_growth is None:
            self._growth_bounds.append((part_index, low, high, leg.truncation.growth))
        return leg

    @cached_property
    def _growth_bounds(self) -> list[tuple[int | None, Array, Array, float]]:
        return []

    def _bound_growth(self, low: Array, high: Array, halvings: int) -> float:
        """Return a bound of the norm of the transitions at any parameter of a cell; ``inf`` where smaller cells have
        none."""
        try:
            return self._expand_over_cell(low, high).truncation.growth
        except NotEnclosable as error:
            if error.along is None or not halvings:
                return np.inf
            ends = low.copy(), high.copy()
            for end in ends:
                end[error.along] = (low[error.along] + high[error.along]) / 2
            return max(self._bound_growth(low, ends[1], halvings - 1), self._bound_growth(ends[0], high, halvings - 1))

    def truncation(self, control_bound: Array) -> Array:
        """Return bounds ``(d,)`` of the truncation error of the state at any time and parameter, from the series of the
        law in the parameters.

        ``control_bound (m,)`` bounds the absolute value of the control. The error is 0 where the entries of the law are
        polynomials.
        """
        laws, bounds = self.response.propagator.laws, np.zeros(self.response.initial_state.size)
        if laws is None or all(spread.remainder is None for spread, _ in laws.every):
            return bounds
        initial_sizes, inputs = self._bound_initial_and_inputs(control_bound)
        for part_index, (spread, _) in enumerate(laws.every):
            if spread.remainder is not None:
                growth = self._bound_growth(*laws.ends(part_index), HALVINGS)
                error_bounds = laws.bound_truncation_error(part_index, initial_sizes, inputs, growth)
                bounds = np.maximum(bounds, error_bounds)
        return bounds

    def _bound_initial_and_inputs(self, control_bound: Array) -> tuple[Array, Array]:
        """Return bounds of the initial state, ``(d,)``, and of all inputs, ``(m + constants + mw,)``, for a control of
        at most ``control_bound (m,)``."""
        initial_sizes, model = np.abs(self.response.initial_state), self.disturbance
        if self.initial is not None:
            initial_sizes = initial_sizes + self.initial.reach(np.eye(initial_sizes.size))
        disturbance_sizes = np.zeros(self.response.system.disturbances)
        if model is not None:
            disturbance_sizes = model.bound.reach(np.eye(model.channels))
        input_sizes = np.abs(self.known).max(axis=1)
        delivered = np.maximum(control_bound, input_sizes[: control_bound.size])
        if self.execution is not None:  # the series truncates the effect of errors as that of commands
            delivered = (1.0 + self.execution.shares) * delivered
        return initial_sizes, np.concatenate([delivered, input_sizes[control_bound.size :], disturbance_sizes])

    @shaped
    def support(self, leg: Leg, H: Float[Array, "r d"], joined: Combination | None = None) -> Supports | None:
        """Return the support of the worst disturbance and of the worst initial state on functionals over a cell.

        Parameters
        ----------
        leg : LiftedSystem, VaryingMotion or SpreadMotion
            The system over the cell, or a phase of it.
        H : Array
            Functionals ``(r, d)``.
        joined : Combination, optional
            How the functionals make up one direction that varies over the cell.

        Returns
        -------
        Supports or None
            The support, ``None`` where there is neither a disturbance nor a set of initial states.

        Raises
        ------
        NotEnclosable
            Where no bound of the support is proven.
        """
        supports: list[Support] = []
        if self.measurable is not None:
            supports += self.measurable.over(H, leg, joined)
        by_block = None if self.disturbance is None else self.disturbance.on_blocks
        rows = H @ leg.transform
        if isinstance(leg, LiftedSystem):  # it knows nothing of what is made of it
            supports += [] if by_block is None else [DisturbanceSupport(leg, by_block, rows, joined)]
            supports += [] if self.initial is None else [InitialSupport(leg, self.initial, rows, joined)]
        else:
            supports += leg.supports(by_block, self.initial, rows, joined)
        return Supports(tuple(supports)) if supports else None

    def with_execution(
        self, known: Supports | None, control: Array, H: Array, leg: Leg, joined: Combination | None = None
    ) -> Supports | None:
        """Return a ``known`` `support` over a cell, with the errors of execution of a control.

        Parameters
        ----------
        known : Supports or None
            The support of the uncertainty.
        control : Array
            The control on its pieces, ``(m, K)``.
        H, leg, joined
            Functionals, system and combination, as in `support`.

        Returns
        -------
        Supports or None
            The support with errors; ``known`` itself where there is no execution.
        """
        if self.execution is None:
            return known
        errors = self.execution.over(control, H, leg, joined)
        return Supports((*(() if known is None else known.parts), errors))

    @cached_property
    def _frozen_systems(self) -> dict[bytes, LiftedSystem]:
        return {}

    @cached_property
    def _cached_phases(self) -> dict[bytes, tuple[Leg, ...]]:
        return {}
