"""Curved sets of states and of controls under feedback: the normal direction is one more index, as without feedback.

For a fixed direction a row is as any other. All directions of a cell are proven at once: for a point ``p`` of the set,
``max_w c'x(t) - h(c) <= max_w c'x(t) - c'p``. The right side is convex in ``c``, so that it is largest at a corner of
the cell.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import product
from typing import final

import numpy as np

from sparserob_core.control.constraints.control import Places
from sparserob_core.control.constraints.curved import STEP, CurvedConstraint
from sparserob_core.control.constraints.explanation import ConstraintSource, TimedExplanation, of_gauge
from sparserob_core.control.constraints.feedback import (
    STATES,
    FeedbackConstraint,
    acting,
    describe_deviations,
    indexed,
    rows_at,
)
from sparserob_core.control.constraints.local_maxima import climb, highest_at, ridden, turns
from sparserob_core.control.feedback.closed_loop import ROUND_OFF, ClosedLoop
from sparserob_core.control.feedback.loop_bounds import LoopBounds
from sparserob_core.control.feedback.loop_rows import LoopRows
from sparserob_core.control.problem.units import Units
from sparserob_core.control.sets.directions import faces, neighbours, on_surface, sampled, unit
from sparserob_core.sip.convex_set import Array, Box, ConvexSet
from sparserob_core.sip.finite import UncertainRows
from sparserob_core.sip.program import ConstraintFamily, Enclosure, Explanation, Separation

FIRST_TIMES = 5  # times that a method begins with, in the directions of the axes


@dataclass(frozen=True, eq=False)
class Turning(ABC):
    """Constraint under feedback that a quantity stays in the curved ``set``, in every direction ``c``.

    Directions are normalised such that ``h(c) - c'm = 1 / unit`` for the interior point ``m`` of the set. The index is
    ``(t, z)``, with a direction ``z`` in the coordinates of the set's frame, or ``(t, z, w)`` with the deviations.
    """

    loop: ClosedLoop

    @property
    @abstractmethod
    def name(self) -> str:
        """The name of the constraint."""

    @property
    @abstractmethod
    def set(self) -> ConvexSet:
        """The set."""

    @property
    def unit(self) -> float:
        """Divisor of the gauge: violations are the gauge less 1, in multiples of this unit."""
        return 1.0

    @property
    @abstractmethod
    def times(self) -> Array:
        """Times that are sampled, increasing."""

    @property
    @abstractmethod
    def spans(self) -> tuple[Array, Array]:
        """Times between which nothing jumps, ``(k,)`` each."""

    @abstractmethod
    def answers(self, x: Array, times: Array) -> Array:
        """Return the nominal quantity and its answers to the deviations at times ``(k,)``: ``(k, d, 1 + Q)``."""

    @abstractmethod
    def between(self, x: Array, lower: Array, upper: Array, H: Array) -> tuple[Array, Array]:
        """Return upper bounds ``(k, r)`` of the quantity along ``H (k, r, d)`` on cells of time, and the part of each
        bound that is due to the length of the cell."""

    @abstractmethod
    def rows(self, time: float, H: Array, h: Array) -> UncertainRows:
        """Return the rows ``H q(t) <= h``, ``H (1, d)``."""

    @abstractmethod
    def explained(self, index: Array) -> TimedExplanation:
        """Return the constraint at an index ``(t, z)`` without deviations."""

    @property
    @abstractmethod
    def source(self) -> ConstraintSource:
        """Constraint that the family belongs to."""

    @property
    def measured(self) -> tuple[str, ...]:
        """The unit of its one row: none, since that is in multiples of the set's gauge."""
        return ("",)

    def family(self) -> ConstraintFamily:
        """Return the constraint as a family."""
        cube = np.ones(self._cube_dimension)
        low, high = (ends[position] for ends, position in zip(self.spans, (0, -1), strict=True))
        index_set = Box(np.append(low, -cube), np.append(high, cube))
        positions = np.unique(
            np.linspace(0, self.times.size - 1, min(FIRST_TIMES, self.times.size)).round().astype(int)
        )
        axes = np.vstack([np.eye(self._cube_dimension), -np.eye(self._cube_dimension)])
        start = np.hstack([np.repeat(self.times[positions], len(axes))[:, None], np.tile(axes, (positions.size, 1))])
        family = indexed(self, index_set, start, self.source)
        return replace(family, scaled=self.scaled) if self.loop.scales else family

    def scaled(self, factor: float) -> ConstraintFamily:
        """Return the family of the same constraint with all deviations multiplied by ``factor``."""
        return replace(self, loop=self.loop.scaled(factor)).family()

    @property
    def _cube_dimension(self) -> int:
        return int(self.set.normals.shape[0])

    @cached_property
    def _lattice(self) -> tuple[Array, Array, Array]:
        """Sampled directions as points of the cube ``(r, b)`` and normalised ``(r, d)``, and the support function of
        the set there, ``(r,)``."""
        z = sampled(self._cube_dimension)
        c = self.normals(z)
        return z, c, self.set.support(c)

    def normals(self, z: Array) -> Array:
        """Return the directions ``(k, d)`` of cube points ``(k, b)``, normalised."""
        return unit(self.set, z) / self.unit

    def excess(self, x: Array, indices: Array) -> Array:
        """Return violations ``(k, 1)`` at indices ``(k, 1 + b)`` under the worst deviations."""
        c = self.normals(indices[:, 1:])
        along = np.einsum("kd,kdq->kq", c, self.answers(x, indices[:, 0]))
        return np.asarray(self.loop.height(along) - self.set.support(c))[:, None]

    def uncertain(self, index: Array) -> UncertainRows:
        """Return the row at one time and direction."""
        c = self.normals(index[None, 1:])
        return self.rows(float(index[0]), c, self.set.support(c))

    def worst(self, x: Array) -> Separation:
        """Return the largest local maxima over times and directions, climbed from until the steps vanish."""
        (z, c, support_values), times = self._lattice, self.times
        step = max(1, STATES // ((1 + self.loop.spread.size) * max(c.shape)))
        values = np.concatenate(
            [self.loop.height(c @ self.answers(x, times[first : first + step])) for first in range(0, times.size, step)]
        )
        values = values - support_values
        places, likely = turns(values.T, neighbours(self._cube_dimension), self.unit)
        rows, at = places.T
        heights, worst_indices = values[at, rows], np.hstack([times[at, None], z[rows]])
        worst_indices[:likely], heights[:likely] = self._climb_directions(x, worst_indices[:likely])
        best = highest_at(at, heights)
        worst_indices, heights = worst_indices[best], heights[best]
        largest_step, pieces = float(np.max(np.diff(times), initial=0.0)), np.searchsorted(self.spans[0], times)
        indices, violations = ridden(
            worst_indices,
            heights,
            pieces,
            np.flatnonzero(np.isin(times, np.concatenate(self.spans))),
            lambda points: self._climb_directions(x, points),
            lambda points: self._climb_points(x, points, largest_step),
        )
        return Separation(indices, np.zeros(violations.size, dtype=int), violations)

    def _climb_directions(self, x: Array, points: Array) -> tuple[Array, Array]:
        """Return the ends of climbs over directions alone from points ``(k, 1 + b)``, and the violations there."""
        if not points.size:
            return points, np.zeros(0)
        times = np.clip(points[:, :1], self.spans[0][0], self.spans[1][-1])
        responses, step = self.answers(x, times[:, 0]), np.full(self._cube_dimension, STEP)

        def excess(z: Array, which: np.ndarray) -> Array:
            c = self.normals(z)
            size = max(1, STATES // responses[0].size)
            chunks = [slice(first, first + size) for first in range(0, which.size, size)]
            along = [self.loop.height(np.einsum("kd,kdq->kq", c[chunk], responses[which[chunk]])) for chunk in chunks]
            return np.asarray(np.concatenate(along) - self.set.support(c))

        z, violations = climb(excess, points[:, 1:], step, lambda z: on_surface(np.clip(z, -1.0, 1.0)))
        return np.hstack([times, z]), violations

    def _climb_points(self, x: Array, points: Array, wide: float) -> tuple[Array, Array]:
        """Return the ends of climbs from points ``(k, 1 + b)``, and the violations there; for a single time, climb over
        directions alone."""
        first, last = self.spans[0][0], self.spans[1][-1]
        if first == last:
            return self._climb_directions(x, points)

        def project(inside: Array) -> Array:
            return np.hstack([np.clip(inside[:, :1], first, last), on_surface(np.clip(inside[:, 1:], -1.0, 1.0))])

        sizes = np.append(wide, np.full(self._cube_dimension, STEP))
        return climb(lambda at, _: self.excess(x, at)[:, 0], points, sizes, project)

    @property
    def cells(self) -> tuple[Array, Array]:
        """The spans of time, times the faces of the cube of directions."""
        low, high = faces(self._cube_dimension)
        corner_lists = []
        for ends, corners in zip(self.spans, (low, high), strict=True):
            corner_lists.append(np.hstack([np.repeat(ends, len(low))[:, None], np.tile(corners, (ends.size, 1))]))
        return corner_lists[0], corner_lists[1]

    def enclosure(self, x: Array, lower: Array, upper: Array) -> Enclosure:
        """Return proven upper bounds of the violation on cells of times and directions, by a point ``p`` of the set for
        each."""
        frame, low, high = self.set.frame / self.unit, lower[:, 1:], upper[:, 1:]
        ends = np.stack(
            [np.where(side, high, low) for side in product((False, True), repeat=self._cube_dimension)], axis=1
        )
        H, centre = ends @ frame, (low + high) / 2 @ frame
        p = self.set.support_point(centre)
        bounds, chord_distances = self.between(x, lower[:, 0], upper[:, 0], H)
        tangent = np.einsum("krd,kd->kr", H, p)
        size = np.einsum("krd,kd->kr", np.abs(H), np.abs(p))
        violations = (bounds - tangent + ROUND_OFF * size).max(axis=1)
        # in the length of the directions: at least how far p is from the middle along them
        rooms = (tangent - H @ self.set.interior_point()).min(axis=1) * self.unit
        with np.errstate(divide="ignore", invalid="ignore"):
            violations = np.where(
                violations > 0.0, np.where(rooms > 0.0, violations / np.maximum(rooms, 0.0), np.inf), violations
            )
        direction_gaps = (self.set.support(H) - tangent).max(axis=1)
        widest = 1 + (high - low).argmax(axis=1)
        narrow = (high - low).max(axis=1) <= 0.0
        split = np.where((chord_distances.max(axis=1) > direction_gaps) | narrow, 0, widest)
        split = np.where(upper[:, 0] > lower[:, 0], split, widest)
        return Enclosure(violations, split)

    def against(self, x: Array, index: Array, row: int) -> tuple[Array, float]:
        """Return a deviation ``(Q,)`` that is the worst at an index, and what stands beside the state then: no
        control."""
        along = self.normals(index[None, 1:])[0] @ self.answers(x, index[:1])[0]
        return self.loop.spread.worst(along[1:]), 0.0

    def explain(self, index: Array, row: int) -> Explanation:
        """Return the description of one constraint for a reader, for every disturbance, or at the deviations that the
        index holds."""
        return describe_deviations(
            self.explained(index[: 1 + self._cube_dimension]), self.loop, index[1 + self._cube_dimension :]
        )


@final
@dataclass(frozen=True, eq=False)
class FeedbackCurved(Turning):
    """``x(t)`` in a curved set for all times of a window and every disturbance, with the control that it causes;
    ``curved``: the same constraint without feedback."""

    curved: CurvedConstraint

    @property
    def name(self) -> str:
        return self.curved.name

    @property
    def set(self) -> ConvexSet:
        return self.curved.set

    @property
    def unit(self) -> float:
        return self.curved.unit

    @property
    def source(self) -> ConstraintSource:
        return self.curved

    @cached_property
    def _outer_constraint(self) -> FeedbackConstraint:
        return FeedbackConstraint(self.curved.outer, self.loop)

    @property
    def times(self) -> Array:
        return self._outer_constraint.flat.times

    @property
    def spans(self) -> tuple[Array, Array]:
        lower, upper = self._outer_constraint.cells
        return lower[:, 0], upper[:, 0]

    def answers(self, x: Array, times: Array) -> Array:
        values = self.loop.states(x, times)
        values[:, :, 0] += self.curved.compute_added_terms(x, times)
        return values

    def between(self, x: Array, lower: Array, upper: Array, H: Array) -> tuple[Array, Array]:
        additions = tuple(H @ self.curved.compute_added_terms(x, times)[:, :, None] for times in (lower, upper))
        return LoopBounds(self.loop).over_cells(x, lower, upper, H, (additions[0], additions[1]))

    def rows(self, time: float, H: Array, h: Array) -> UncertainRows:
        shift = H @ self.curved.compute_added_terms(np.zeros(0), np.array([time]))[0]
        return LoopRows(self.loop).of_state(time, H, h - shift, np.zeros(1, dtype=int), np.ones(1))

    def explained(self, index: Array) -> TimedExplanation:
        return self.curved.explain(index, 0)


@final
@dataclass(frozen=True, eq=False)
class FeedbackCurvedControl(Turning, ConstraintSource):
    """Constraint that the control at ``places``, on every piece or at every step, stays in a curved set for every
    disturbance."""

    convex: ConvexSet
    called: str
    places: Places

    def normals_in(self, units: Units) -> tuple[Array, Array]:
        """Return the normal ``(1, 1)`` and the unit ``(1,)`` of the one row, which is in multiples of the set's gauge
        in any units."""
        return of_gauge()

    @property
    def name(self) -> str:
        return self.called

    @property
    def set(self) -> ConvexSet:
        return self.convex

    @property
    def source(self) -> ConstraintSource:
        return self

    @property
    def times(self) -> Array:
        return self.places.times

    @property
    def spans(self) -> tuple[Array, Array]:
        return self.places.spans

    def answers(self, x: Array, times: Array) -> Array:
        return np.asarray(acting(self.loop, self.places, x)[0][self.places.at(times)])

    def between(self, x: Array, lower: Array, upper: Array, H: Array) -> tuple[Array, Array]:
        at = self.places.at((lower + upper) / 2)
        along, sizes = (array[at] for array in acting(self.loop, self.places, x))
        magnitudes = np.abs(H) @ sizes @ np.concatenate([[1.0], self.loop.spread.radii])
        bounds = self.loop.height(H @ along) + ROUND_OFF * magnitudes
        return bounds, np.zeros(bounds.shape)

    def rows(self, time: float, H: Array, h: Array) -> UncertainRows:
        return rows_at(self.loop, self.places, int(self.places.at(np.array([time]))[0]), H, h)

    def worst(self, x: Array) -> Separation:
        """Return every place with its worst direction, worst first."""
        controls, (z, c, support_values) = acting(self.loop, self.places, x)[0], self._lattice
        start = z[(self.loop.height(c @ controls) - support_values).argmax(axis=1)]

        def excess(at: Array, which: np.ndarray) -> Array:
            directions = self.normals(at)
            along = np.einsum("kd,kdq->kq", directions, controls[which])
            return np.asarray(self.loop.height(along) - self.set.support(directions))

        z, violations = climb(
            excess, start, np.full(self._cube_dimension, STEP), lambda at: on_surface(np.clip(at, -1.0, 1.0))
        )
        order = np.argsort(-violations, kind="stable")
        indices = np.hstack([self.times[order, None], z[order]])
        return Separation(indices, np.zeros(order.size, dtype=int), violations[order])

    def explained(self, index: Array) -> TimedExplanation:
        time = float(self.places.times[self.places.at(index[:1])[0]]) if self.places.steps else float(index[0])
        text = f"{self.name}: {self.places.words(time)} in the {self.set.kind}"
        return TimedExplanation(text, self.name, text, time, self.normals(index[None, 1:])[0])


def of_state(constraint: object, loop: ClosedLoop) -> FeedbackConstraint | FeedbackCurved:
    """Return a constraint on the state under feedback."""
    if isinstance(constraint, CurvedConstraint):
        return FeedbackCurved(loop, constraint)
    return FeedbackConstraint(constraint, loop)  # type: ignore[arg-type]
