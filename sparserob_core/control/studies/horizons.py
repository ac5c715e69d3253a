"""Proofs that no control is feasible at any horizon of an interval: one set of multipliers, with the horizon as a
parameter.

In the time ``s = t / T`` of a dictionary whose pieces are fixed shares of the horizon ``T``, a system obeys
``dx/ds = T (A x + B u + E w + c)``. So ``T`` is a parameter of the system, and the weighted sum of its constraints is a
Taylor model in ``T``. Windows of the path begin at absolute times. A row of such a window is therefore taken no earlier
than the window begins at the shortest horizon of the interval.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import final

import numpy as np

from sparserob_core.control.combinations import refusal
from sparserob_core.control.enclosures.polynomial import polynomial_bound
from sparserob_core.control.problem.dictionary import Dictionary
from sparserob_core.control.problem.phase import Phase
from sparserob_core.control.problem.problem import OptimalControlProblem
from sparserob_core.control.problem.system import System
from sparserob_core.control.problem.units import Units
from sparserob_core.control.reach.disturbance_support import DisturbanceSupport, summed
from sparserob_core.control.reach.support import InitialSupport
from sparserob_core.control.response.disturbance import DisturbanceModel, disturbance_model
from sparserob_core.control.response.lifted import LiftedSystem, lift
from sparserob_core.control.response.reference import STILL, Reference
from sparserob_core.control.response.time_grid import TimeGrid, merge_grids
from sparserob_core.control.transcription.own_units import extent, rough_units
from sparserob_core.errors import InputError, NotEnclosable
from sparserob_core.sip.convex_set import Array, Box, ConvexSet
from sparserob_core.sip.expressions.rounding import rounding


@final
@dataclass(frozen=True, eq=False)
class Multiplier:
    """``weight (c'x(share T) - limit)`` at a parameter ``(nu,)``, of a run at some horizon: ``c = direction (d,)``,
    the time as a ``share`` of the horizon, and the absolute time at which its window begins, ``earliest``.

    ``uncertain``: whether the worst uncertainty is part of it, which is so but for equalities. ``reference``: of a set
    that moves, which adds ``c'r(share T)`` to the limit. ``gain (m,)``: the part on the control of a mixed constraint,
    and ``piece`` the two shares between which the piece lies that it looks at.
    """

    weight: float
    share: float
    direction: Array
    parameter: Array
    limit: float
    earliest: float = 0.0
    uncertain: bool = True
    reference: Reference = STILL
    gain: Array | None = None
    piece: tuple[float, float] = (0.0, 1.0)

    def share_from(self, low: float) -> float:
        """The share at which it is taken for horizons of ``low`` and more, so that its window has begun; ``nan`` where
        there is none."""
        if self.earliest == 0.0:
            return self.share
        if self.earliest > low:
            return np.nan
        begins = min(1.0, float(np.nextafter(self.earliest / low, np.inf)))
        if self.gain is not None and begins >= self.piece[1]:  # that piece is over when the window begins
            return np.nan
        return max(self.share, begins)

    def highest(self, share: float, low: float, high: float) -> float:
        """The largest limit at that share of the horizons in ``[low, high]``."""
        times = np.array([share * low, share * high])
        times = np.concatenate([times, self.reference.kinks(*times)])
        return self.limit + float(self.reference.along(times, self.direction[None]).max())


def shorten_horizon(problem: OptimalControlProblem, horizon: float) -> OptimalControlProblem:
    """The problem with another, shorter ``horizon``: windows that lasted until the end do so still, those that would
    begin later are gone, as are the systems that would take their turn later. Raises `InputError` for a window that
    ends before the horizon of the problem."""
    for i, entry in enumerate(problem.windows):
        if entry.stop is not None and entry.stop < problem.horizon:
            raise InputError(
                path=f"path.{i}",
                expected=f"a window that lasts until the horizon, {problem.horizon:g}, since windows stay where they"
                " are while the horizon varies",
                got=f"one that ends at {entry.stop:g}",
            )
    if problem.disturbance_breakpoints is not None:
        raise refusal("horizon", "pieces of their own", got="breakpoints of their own")
    if problem.has_budget:
        raise refusal("horizon", "budget", got="a budget over the horizon")
    if problem.system.varies:
        raise refusal("horizon", "entries in t", got="one in t")
    shorter = problem.remaining(0.0, horizon)
    assert shorter is not None
    return shorter


def stretch_dictionary(dictionary: Dictionary, horizon: float) -> Dictionary:
    """The dictionary with the same pieces as shares of another horizon."""
    shares = dictionary.breakpoints / dictionary.horizon
    breakpoints = horizon * shares
    breakpoints[-1] = horizon
    return dictionary.on(breakpoints)


@final
@dataclass(frozen=True, eq=False)
class Horizons:
    """Range of horizons of one problem, whose dictionaries have the same pieces as shares of the horizon.

    Raises
    ------
    InputError
        If the pieces of the system do not move with the horizon, or if a control of the dictionary cannot take any
        values on its pieces.
    """

    problem: OptimalControlProblem
    control: Dictionary
    disturbance: Dictionary

    def __post_init__(self) -> None:
        if self.problem.system.delay > 0.0:
            raise refusal("horizon", "delay")
        if not self.control.is_complete:
            raise refusal("horizon", "few functions of the control")
        shorten_horizon(self.problem, self.problem.horizon)
        object.__setattr__(self, "control", self.control.merged())

    @property
    def changes(self) -> float:
        """The time at which the system changes first, ``inf`` where it does not: nothing is proven of intervals of
        horizons beyond it, since the time of a change is no share of the horizon."""
        return min(self.problem.system.switches, default=np.inf)

    def amount(self, multipliers: Sequence[Multiplier], low: float, high: float) -> float:
        """A proven lower bound of the weighted sum of violations, over all controls and all horizons in
        ``[low, high]``: where it is positive, none of them is feasible (Farkas). Rows whose window begins after ``low``
        count for nothing; ``-inf`` where nothing can be enclosed."""
        rows = [multiplier for multiplier in multipliers if np.isfinite(multiplier.share_from(low))]
        size = sum(abs(multiplier.weight) for multiplier in rows)
        if not size > 0.0 or high > self.changes:
            return -np.inf
        lifted: dict[bytes, LiftedSystem] = {}
        total = None
        for multiplier in rows:
            key = multiplier.parameter.tobytes()
            try:
                if key not in lifted:
                    lifted[key] = self._lift_system(
                        multiplier.parameter, low / self._units.time, high / self._units.time
                    )
                share = multiplier.share_from(low)
                with np.errstate(over="ignore", invalid="ignore"):
                    summand = self._expand_row(multiplier, lifted[key], share, multiplier.highest(share, low, high))
            except NotEnclosable:
                return -np.inf
            scaled = summand.times(multiplier.weight / size)
            total = scaled if total is None else total.plus(scaled)
        assert total is not None
        answer = total.least(self._own_problem.control)
        return answer * size if np.isfinite(answer) else -np.inf

    def _lift_system(self, parameter: Array, low: float, high: float) -> LiftedSystem:
        """The system at one parameter in the time ``s``, over the horizons of an interval."""
        at = (parameter / self._units.parameters)[None]
        A, B, E = (matrix[0] for matrix in self._own_problem.system.forced.modes[0].matrices(at))
        horizons = Box(np.array([low]), np.array([high]))
        scaled = Phase(lambda T: A * T[0], lambda T: B * T[0], lambda T: E * T[0], horizons)
        middle, radius = np.array([(low + high) / 2]), np.array([(high - low) / 2])
        return lift(scaled, self._grid, self._initial_state, middle, radius * (1.0 + 4.0 * np.finfo(float).eps))

    def _expand_row(self, one: Multiplier, lifted: LiftedSystem, share: float, limit: float) -> _TaylorRow:
        """``c'x(s) - limit`` with the worst uncertainty of the interval's middle, as a Taylor model in the horizon."""
        own, m = self._own_problem, self._own_problem.system.controls
        at, rows = np.array([share]), (one.direction * self._units.states)[None] @ lifted.transform
        piece = int(self._grid.locate(at)[0])
        coefficients = np.zeros(lifted.space.size)
        coefficients[0] = -limit
        initial_set = own.initial_set
        radius = np.zeros(own.system.states) if initial_set is None else extent(initial_set)
        initial = InitialSupport(lifted, Box(self._initial_state - radius, self._initial_state + radius), rows)
        weights = initial.blocks(at)[0, 0]
        start = self._initial_state
        if initial_set is not None and one.uncertain:
            start = start + initial_set.support_point(weights[:1])[0]
        coefficients += weights @ start
        sizes = abs(limit) + abs(one.limit) + float((np.abs(weights) @ (np.abs(self._initial_state) + radius)).sum())
        error = float(initial.neglected[0, piece])
        if self._disturbance_model is not None and one.uncertain:
            support = DisturbanceSupport(lifted, self._disturbance_model, rows)
            blocks = support.blocks(at)[0, 0]
            worst = self._disturbance_model.set.support_point(blocks[0])
            coefficients += np.einsum("bq,abq->a", worst, blocks)
            sizes += float(np.einsum("bq,abq->", np.abs(worst), np.abs(blocks)))
            error += float(support.neglected[0, piece])
        if lifted.B.shape[2] > m:  # a drift, whose input is always 1
            ones = Box(np.ones(lifted.B.shape[2] - m), np.ones(lifted.B.shape[2] - m))
            drift_model = DisturbanceModel("piecewise_constant", ones, ones, self._grid, starts=np.zeros(1, dtype=int))
            support = DisturbanceSupport(_replace_disturbance(lifted, slice(m, None)), drift_model, rows)
            blocks = support.blocks(at)[0, 0].sum(axis=(1, 2))
            coefficients += blocks
            sizes += float(np.abs(blocks).sum())
            error += float(support.neglected[0, piece])
        acting = DisturbanceSupport(_replace_disturbance(lifted, slice(0, m)), self._control_model, rows)
        blocks = acting.blocks(at)[0, 0]
        if one.gain is not None:
            ends = stretch_dictionary(self.control, 1.0).breakpoints
            blocks[0, np.searchsorted(ends, sum(one.piece) / 2) - 1] += one.gain * self._units.controls
        sizes += float(own.control.reach(blocks).sum())
        error += float(acting.neglected[0, piece])
        terms = rounding(2 * own.system.states + lifted.space.size + self._grid.pieces)
        return _TaylorRow(lifted, coefficients, blocks, error + terms * sizes)

    @cached_property
    def _units(self) -> Units:
        return rough_units(self._problem_before_change)

    @cached_property
    def _own_problem(self) -> OptimalControlProblem:
        return self._units.of_problem(self._problem_before_change)

    @property
    def _problem_before_change(self) -> OptimalControlProblem:
        """The problem as it is up to the first change of the system."""
        system = self.problem.system
        return replace(self.problem, system=System((system.phases[0].between(0.0, np.inf),), system.parameters))

    @cached_property
    def _initial_state(self) -> Array:
        return np.asarray(self._own_problem.initial_state, dtype=float)

    @cached_property
    def _grid(self) -> TimeGrid:
        """The merged grid in the time ``s``, from 0 to 1."""
        breakpoints = [
            stretch_dictionary(dictionary, 1.0).breakpoints for dictionary in (self.control, self.disturbance)
        ]
        forced = self._own_problem.system.forced
        return merge_grids(
            breakpoints[0], breakpoints[1], 0.0, None, forced.controls - self._own_problem.system.controls
        )

    @cached_property
    def _disturbance_model(self) -> DisturbanceModel | None:
        own = self._own_problem
        if own.disturbance is None:
            return None
        if own.measurable is not None:  # what is constant on pieces is measurable
            starts = np.arange(self._grid.pieces)
            return DisturbanceModel("piecewise_constant", own.disturbance, own.disturbance, self._grid, starts=starts)
        return disturbance_model(
            own.disturbance_class, own.disturbance, stretch_dictionary(self.disturbance, 1.0), self._grid
        )

    @cached_property
    def _control_model(self) -> DisturbanceModel:
        """The control on its pieces, in the form of a disturbance."""
        starts = np.flatnonzero(np.diff(self._grid.control_piece, prepend=-1))
        return DisturbanceModel(
            "piecewise_constant", self._own_problem.control, self._own_problem.control, self._grid, starts=starts
        )


@final
@dataclass(frozen=True, eq=False)
class _TaylorRow:
    """Taylor coefficients ``(M,)`` in the horizon of what no control changes, and ``(M, K, m)`` of the weights on the
    control's pieces; the truth is off by at most ``error_bound``."""

    lifted: LiftedSystem
    coefficients: Array
    weights: Array
    error_bound: float

    def times(self, factor: float) -> _TaylorRow:
        """Return the sum multiplied by ``factor``."""
        return _TaylorRow(
            self.lifted, factor * self.coefficients, factor * self.weights, abs(factor) * self.error_bound
        )

    def plus(self, other: _TaylorRow) -> _TaylorRow:
        """Return the sum of two."""
        return _TaylorRow(
            self.lifted,
            self.coefficients + other.coefficients,
            self.weights + other.weights,
            self.error_bound + other.error_bound,
        )

    def least(self, control: ConvexSet) -> float:
        """A lower bound of the least value over every control and every horizon of the interval."""
        support_values = summed(control, -self.weights[None, None], None)[0, 0].sum(axis=0)
        above, _ = polynomial_bound(self.lifted.space, (support_values[:-1] - self.coefficients)[None])
        return -float(above[0] + support_values[-1] + self.error_bound * (1.0 + 1e-12))


def _replace_disturbance(lifted: LiftedSystem, columns: slice) -> LiftedSystem:
    """The lifted system with some columns of ``B`` in the place of the disturbance's."""
    return replace(lifted, W=lifted.B[:, :, columns], slack_W=lifted.slack_B[:, columns])
