"""The own units of state constraints, by which violations are judged (decision 0016)."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property, partial
from typing import final

import numpy as np
import numpy.typing as npt
from flint import arb

from sparserob_core.checker.arithmetic.remembered import remembered
from sparserob_core.checker.claims.answers import feedback_of
from sparserob_core.checker.claims.case import Case
from sparserob_core.checker.claims.window import ConstraintWindow
from sparserob_core.checker.flow.flows import VerifiedFlows
from sparserob_core.checker.outcome import RESOLVED, THIN, TOLERANCE, Unchecked
from sparserob_core.checker.problem.timing import before
from sparserob_core.checker.reach.states import Scene
from sparserob_core.checker.sets.known import known
from sparserob_core.checker.sets.shape import smallest, widths
from sparserob_core.control.problem.problem import OptimalControlProblem
from sparserob_core.control.sets.sets import ConvexSet
from sparserob_core.sip.convex_set import Array

MAX_TIMES = 64  # times at which a window is examined
MAX_WEIGHTS = 16_000_000  # weights of inputs on every piece that are in memory at once
# The numbers that are added up count the range of the control, but at most so many times what the decision uses of it.
# With a tenth of it, runs would be refused that were honest in the units of their whole range; with ten times as much,
# a control of 1 in a range of 1e7 would forgive seven digits.
BEYOND = 2.0**20
# The unit of a row whose bound, width and nominal values are all 0, as a share of what is resolved, or of 1 if that is
# less. A billionth of this unit is excused: less than the rounding of any number that the row could have, but more than
# the radius of a ball around a 0. The run itself excuses less.
NOTHING = 2.0**-50
MAX_AXES = 4  # axes of the parameters at whose ends a window is examined


@final
@dataclass(frozen=True, eq=False)
class WindowUnits:
    """The units of the rows of one constraint: a violation of `TOLERANCE` of a unit counts as none.

    The constraint is that ``x(t) - r(t)`` is in ``shape`` from ``start`` to ``stop``, or ``(x(t), u(t))`` in a shape of
    more coordinates. ``reference (q, 1 + d)`` holds times and points of ``r``. ``acting (m,)`` is the largest absolute
    value of each channel of the decision's control. ``flows`` are those of the system. ``nominal`` returns the largest
    absolute values of rows, on the state and on the control, along the nominal trajectory.

    The unit of a row ``c'x <= b`` is the smallest number that is not zero among three. The first is how far ``c'x`` can
    reach over the window, for any admissible control, the worst disturbance and some parameters. The others are ``|b|``
    and the width of the slab where the opposite row exists. A row whose width is `THIN` has the reach alone. The unit
    of a curved set in a direction ``c`` is ``h(c) - c'm``, ``m`` its centre.

    A unit is at least what double precision resolves of the numbers that are added up. A unit is never more than what a
    user can read: the largest of ``|b|``, the width, and the values of the row along the nominal trajectory (decision
    0088). Units are no claims, so they are computed in floating point."""

    problem: OptimalControlProblem
    flows: VerifiedFlows
    scene: Scene
    shape: ConvexSet
    start: float
    stop: float
    reference: Array | None = None
    acting: Array | None = None
    nominal: Callable[[Array, Array], Array] | None = None

    @cached_property
    def rows(self) -> Array:
        """The unit ``(k,)`` of every facet of a flat set, by which a claim excuses violations."""
        resolved, facets = self.resolved, known(self.shape).facets
        assert facets is not None
        slab_widths = np.array(widths(facets))
        sizes = np.array([abs(float(b)) for _, b in facets])
        sizes = np.maximum(sizes, np.where(np.isfinite(slab_widths), slab_widths, 0.0))
        if (resolved > sizes).any() and self.nominal is not None:
            sizes = np.maximum(sizes, self.nominal(*self._select_rows(states=False)))
        return np.asarray(np.minimum(resolved, np.where(sizes > 0.0, sizes, NOTHING * np.minimum(resolved, 1.0))))

    def least(self, direction: Array, width: float) -> float:
        """Return the least unit of a direction ``c (d,)``, along which a curved set reaches ``width`` from its centre:
        what double precision resolves, but at most the values along the nominal trajectory, which alone count where the
        set is `THIN`."""
        size = np.abs(direction)
        floors = self._nominal_state_sizes if width < THIN * float(size @ self.sums) else self._least_units
        return float(size @ floors)

    @cached_property
    def _least_units(self) -> Array:
        """The least units ``(d,)`` of the states."""
        return np.minimum(RESOLVED * self.sums, self._nominal_state_sizes)

    @cached_property
    def _nominal_state_sizes(self) -> Array:
        """The largest absolute value of every state along the nominal trajectory, ``(d,)``."""
        d = self.problem.system.states
        return np.zeros(d) if self.nominal is None else self.nominal(np.eye(d), np.zeros((d, 0)))

    @cached_property
    def resolved(self) -> Array:
        """The unit ``(k,)`` of every facet of a flat set as far as double precision resolves it, large or small. This
        unit says how closely figures must agree; no violation is excused by it."""
        facets = known(self.shape).facets
        assert facets is not None
        heights = np.array([abs(float(b)) for _, b in facets])
        reach, sums = self._measure_reach(self._interior_parameter, states=False)
        slab_widths, thin = np.array(widths(facets)), THIN * sums[: heights.size]
        candidates = np.where(slab_widths > thin, np.stack([heights, slab_widths]), 0.0)
        sizes = np.array([smallest(pair) for pair in np.where(candidates > thin, candidates, 0.0).T.tolist()])
        # another parameter may take a row further
        if (reach[: sizes.size] < np.where(sizes > 0.0, sizes, np.inf)).any():
            other_reaches = [self._measure_reach(point, states=False)[0] for point in self._edge_parameters]
            reach = np.max([reach, *other_reaches], axis=0)
        unit = [smallest(pair) for pair in zip(sizes.tolist(), reach.tolist(), strict=False)]
        least = RESOLVED * sums[: sizes.size]
        units: Array = np.where((unit > least) | (least > 0.0), np.maximum(unit, least), 1.0)
        return units

    @cached_property
    def sums(self) -> Array:
        """The largest sums ``(d,)`` of the absolute values of the terms that add up to each state within the
        window."""
        return self._measure_reach(self._interior_parameter, states=True)[1]

    def slack(self, direction: Array, limit: arb) -> float:
        """Return how closely doubles determine ``c'x`` in a direction ``c (d,)`` with ``c'x <= limit`` on the set. Of a
        flat set the direction is a weighted sum of normals, and so are the numbers that are added up."""
        return self._scale_tolerance(
            direction,
            limit,
            lambda: self.resolved,
            lambda width: max(RESOLVED * float(np.abs(direction) @ self.sums), self.least(direction, width)),
        )

    def excused(self, direction: Array, limit: arb) -> float:
        """Return the violation that a claim excuses in a direction ``c (d,)`` with ``c'x <= limit`` (decision 0088)."""
        return self._scale_tolerance(direction, limit, lambda: self.rows, lambda width: self.least(direction, width))

    def _scale_tolerance(
        self, direction: Array, limit: arb, facets: Callable[[], Array], least: Callable[[float], float]
    ) -> float:
        """Return `TOLERANCE` of the unit of a direction: of a flat set by the units ``facets (k,)``, of a curved one by
        its width, but at least the ``least`` unit for that width."""
        shape = known(self.shape)
        if shape.facets is None:
            width = float(limit) - float(direction @ shape.centre)
            return TOLERANCE * max(width, least(width))
        return TOLERANCE * float(shape.shares(direction) @ facets())

    @property
    def _interior_parameter(self) -> tuple[float, ...]:
        """A parameter in the interior of the set, ``(nu,)``."""
        bound = self.problem.system.parameters
        return () if bound is None else tuple(map(float, bound.interior_point()))

    @property
    def _edge_parameters(self) -> list[tuple[float, ...]]:
        """Some parameters at the edge of their set."""
        bound = self.problem.system.parameters
        if bound is None:
            return []
        axes = np.vstack([np.eye(bound.dimension)[:MAX_AXES], np.ones((1, bound.dimension))])
        return [tuple(map(float, point)) for point in bound.support_point(np.vstack([axes, -axes]))]

    @remembered()
    def _measure_reach(self, parameter: tuple[float, ...], states: bool) -> tuple[Array, Array]:
        """Return how far rows, the normals of the facets or all ``states``, reach over the window at one parameter, and
        the largest sums of absolute terms, ``(k,)`` each. As many times are followed backwards together as memory
        allows."""
        with np.errstate(over="ignore", invalid="ignore"):
            nodes, places = self._find_nodes()
            weights_per_time = len(nodes) * len(self._select_rows(states)[0])
            weights_per_time *= self.problem.system.controls + 1 + self.problem.system.disturbances
            batches = np.array_split(places, min(places.size, -(-places.size * weights_per_time // MAX_WEIGHTS)))
            results = [self._measure_batch(parameter, states, nodes[: batch[-1] + 1], batch) for batch in batches]
            reach_and_sums = (
                np.max([reach for reach, _ in results], axis=0),
                np.max([sums for _, sums in results], axis=0),
            )
        if not all(np.isfinite(numbers).all() for numbers in reach_and_sums):
            raise Unchecked("the response grows beyond what numbers can hold")
        return reach_and_sums

    def _select_rows(self, states: bool) -> tuple[Array, Array]:
        """Return the facets' normals on state ``(k, d)`` and control ``(k, m)``, or the axes of the ``states``."""
        d = self.problem.system.states
        if states:
            return np.eye(d), np.zeros((d, 0))
        normals, gains = np.split(
            np.array([c for c, _ in known(self.shape).facets or []]).reshape(-1, self.shape.dimension), [d], 1
        )
        return normals, gains

    def _measure_batch(
        self, parameter: tuple[float, ...], states: bool, nodes: list[float], places: npt.NDArray[np.intp]
    ) -> tuple[Array, Array]:
        """Return reach and sums as `_measure_reach` does, ``(k,)`` each, at the times ``places`` of the ``nodes``."""
        system, bound = self.problem.system, self.problem.disturbance
        d, m, input_count = system.states, system.controls, system.controls + system.drifts
        rows, gains = self._select_rows(states)
        flow = self.flows.at(parameter)
        v = np.tile(rows, (len(places), 1, 1))
        count = len(nodes) - 1
        control_weights = np.zeros((count, *v.shape[:2], input_count))
        disturbance_weights = np.zeros((count, *v.shape[:2], system.disturbances))
        for k in range(count - 1, -1, -1):
            first = int(np.searchsorted(places, k, side="right"))
            if first < len(places):
                Phi, Gamma, Delta = flow.about(nodes[k], nodes[k + 1])
                control_weights[k, first:], disturbance_weights[k, first:] = v[first:] @ Gamma, v[first:] @ Delta
                v[first:] = v[first:] @ Phi
        start = np.asarray(self.problem.initial_state, dtype=float)
        high, low, sums = v @ start, -(v @ start), np.abs(v) @ np.abs(start)
        deviations = self.problem.initial_set
        if deviations is not None:
            axes = np.eye(d)
            high, low = high + deviations.support(v), low + deviations.support(-v)
            sums = sums + np.abs(v) @ np.maximum(np.abs(deviations.support(axes)), np.abs(deviations.support(-axes)))
        first_acting, early_inputs = int(np.searchsorted(nodes[:-1], system.delay)), np.ones(input_count)
        early_inputs[:m] = before(self.problem)
        applied = np.concatenate(
            [
                control_weights[:first_acting] * early_inputs,
                control_weights[first_acting:] * np.append(np.zeros(m), early_inputs[m:]),
            ]
        )
        high, low = high + applied.sum(axis=(0, 3)), low - applied.sum(axis=(0, 3))
        sums = sums + np.abs(applied).sum(axis=(0, 3))
        for convex, weights in (
            (self.problem.control, control_weights[first_acting:, ..., :m]),
            (bound, self._sum_over_pieces(nodes, disturbance_weights)),
        ):
            if convex is not None and len(weights):
                high, low = high + convex.support(weights).sum(axis=0), low + convex.support(-weights).sum(axis=0)
                axes = np.eye(convex.dimension)
                largest_values = np.maximum(np.abs(convex.support(axes)), np.abs(convex.support(-axes)))
                if convex is self.problem.control and self.acting is not None:
                    share = (self.acting / np.where(largest_values > 0.0, largest_values, np.inf)).max(initial=0.0)
                    largest_values = largest_values * min(1.0, BEYOND * float(share))
                sums = sums + (np.abs(weights) @ largest_values).sum(axis=0)
        if self.reference is not None:
            examined_times, (times, *points) = np.array(nodes)[places], self.reference.T
            references = np.stack([np.interp(examined_times, times, column) for column in points], axis=1)
            offsets = references @ rows.T
            high, low, sums = high - offsets, low + offsets, sums + np.abs(offsets)
        if gains.shape[1]:
            up, down = self.problem.control.support(gains), self.problem.control.support(-gains)
            high, low, sums = high + up, low + down, sums + np.maximum(np.abs(up), np.abs(down))
        return np.maximum(np.abs(high), np.abs(low)).max(axis=0), sums.max(axis=0)

    def _sum_over_pieces(self, nodes: list[float], interval_weights: Array) -> Array:
        """Return the weights of the disturbance on its pieces, from those on the intervals between ``nodes``."""
        if self.problem.disturbance is None or len(nodes) < 2:
            return interval_weights
        middles = (np.array(nodes[:-1]) + np.array(nodes[1:])) / 2
        blocks = np.searchsorted(self.scene.changes, middles, side="right")
        weights: Array = np.add.reduceat(interval_weights, np.flatnonzero(np.diff(blocks, prepend=-1)), axis=0)
        if self.scene.held_components is None:
            return weights
        return self.scene.held_components.gathered(weights[..., None], np.zeros((*weights.shape, 1)))[0][..., 0]

    def _find_nodes(self) -> tuple[list[float], npt.NDArray[np.intp]]:
        """Return the grid up to the window's end, with both its ends, and the places of the times to examine."""
        inside = [t for t in self.scene.grid if t < self.stop]
        nodes = sorted({*inside, self.start, self.stop})
        window = np.flatnonzero(np.array(nodes) >= self.start)
        if window.size > MAX_TIMES:
            window = window[np.unique(np.linspace(0, window.size - 1, MAX_TIMES).round().astype(int))]
        return nodes, window


@remembered()
def units_of(case: Case, window: ConstraintWindow) -> WindowUnits:
    """Return the units by which violations of a constraint are judged."""
    acting = None if case.answering else np.abs(case.control.control(case.theta)).max(axis=1)
    times = window.start, window.stop, window.reference
    return WindowUnits(case.problem, case.flows, case.scene, window.shape, *times, acting, partial(nominal_sizes, case))


@remembered()
def _enclose_nominal_values(case: Case) -> tuple[Array, Array]:
    """Return the nominal ``(x, u)`` where pieces begin to act and at the end, ``(K', d + m)``, and the radii."""
    states = case.price.nominal_states(case.pieces)
    entries = np.array([[(float(x), float(x.rad())) for x in state.entries()] for state in states])
    values = np.delete(entries, case.problem.system.states, axis=1)  # without the 1
    return values[:, :, 0], values[:, :, 1]


def nominal_sizes(case: Case, rows: Array, gains: Array) -> Array:
    """Return the largest ``|c'x + g'u|`` along the nominal trajectory of the decision, ``(k,)``, never too large, for
    ``rows (k, d)`` and ``gains (k, m)`` or none: where pieces begin to act, and at the end. Under feedback, rows of the
    state alone include the deviations."""
    if case.answering and not gains.any():
        return feedback_of(case).sizes(rows)
    mid, rad = _enclose_nominal_values(case)
    both = np.zeros((len(rows), mid.shape[1]))
    d = case.problem.system.states
    both[:, :d], both[:, d : d + gains.shape[1]] = rows, gains
    sizes = np.abs(both @ mid.T) - np.abs(both) @ rad.T
    return np.asarray(np.where(np.isfinite(sizes), np.maximum(sizes, 0.0), 0.0).max(axis=1, initial=0.0))
