"""Curved sets of states and of controls under feedback: the normal direction is one more index, as without feedback.

For a fixed direction a row is as any other. What proves all directions of a cell at once: for a point ``p`` of the set,
``max_w c'x(t) - h(c) <= max_w c'x(t) - c'p``, and the right side is convex in ``c``, so that it is largest at a corner.
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
from sparserob_core.control.constraints.explanation import Source, TimedExplanation, of_gauge
from sparserob_core.control.constraints.feedback import STATES, FeedbackConstraint, acting, indexed, rows_at, told
from sparserob_core.control.constraints.local_maxima import climb, highest_at, ridden, turns
from sparserob_core.control.feedback.closed_loop import ROUND_OFF, ClosedLoop
from sparserob_core.control.problem.units import Units
from sparserob_core.control.sets.directions import faces, neighbours, on_surface, sampled, unit
from sparserob_core.sip.convex_set import Array, Box, ConvexSet
from sparserob_core.sip.finite import UncertainRows
from sparserob_core.sip.program import ConstraintFamily, Enclosure, Explanation, Separation

BEGUN = 5  # times that a method begins with, in the directions of the axes


@dataclass(frozen=True, eq=False)
class Turning(ABC):
    """What the loop makes of a quantity that must stay in the curved ``set``: in every direction ``c``, normalised such
    that ``h(c) - c'm = unit`` for the middle ``m`` of the set. The index is ``(t, z)``, ``z`` a direction in the
    coordinates of the set's frame, or with the deviations ``(t, z, w)``."""

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
        """What 1 of the gauge is divided by."""
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
        """The nominal quantity and its answers to the deviations at times ``(k,)``: ``(k, d, 1 + Q)``."""

    @abstractmethod
    def between(self, x: Array, lower: Array, upper: Array, H: Array) -> tuple[Array, Array]:
        """Upper bounds of its largest values along ``H (k, r, d)`` on cells of time, ``(k, r)``, and how much of them
        is owed to the length of the cells."""

    @abstractmethod
    def rows(self, time: float, H: Array, h: Array) -> UncertainRows:
        """The rows ``H q(t) <= h``, ``H (1, d)``."""

    @abstractmethod
    def explained(self, index: Array) -> TimedExplanation:
        """The constraint at an index ``(t, z)`` without deviations."""

    @property
    @abstractmethod
    def source(self) -> Source:
        """What the family is of."""

    @property
    def measured(self) -> tuple[str, ...]:
        """The unit of its one row: none, since that is in multiples of the set's gauge."""
        return ("",)

    def family(self) -> ConstraintFamily:
        """The constraint as a family."""
        cube = np.ones(self._b)
        low, high = (ends[place] for ends, place in zip(self.spans, (0, -1), strict=True))
        index_set = Box(np.append(low, -cube), np.append(high, cube))
        begun = np.unique(np.linspace(0, self.times.size - 1, min(BEGUN, self.times.size)).round().astype(int))
        axes = np.vstack([np.eye(self._b), -np.eye(self._b)])
        start = np.hstack([np.repeat(self.times[begun], len(axes))[:, None], np.tile(axes, (begun.size, 1))])
        family = indexed(self, index_set, start, self.source)
        return replace(family, scaled=self.scaled) if self.loop.scales else family

    def scaled(self, factor: float) -> ConstraintFamily:
        """The same where deviations are ``factor`` times as large."""
        return replace(self, loop=self.loop.scaled(factor)).family()

    @property
    def _b(self) -> int:
        return int(self.set.normals.shape[0])

    @cached_property
    def _lattice(self) -> tuple[Array, Array, Array]:
        """Sampled directions as cube points ``(r, b)`` and normalised ``(r, d)``, and how far the set reaches."""
        z = sampled(self._b)
        c = self.normals(z)
        return z, c, self.set.support(c)

    def normals(self, z: Array) -> Array:
        """The directions ``(k, d)`` of cube points ``(k, b)``, normalised."""
        return unit(self.set, z) / self.unit

    def excess(self, x: Array, indices: Array) -> Array:
        """Violations ``(k, 1)`` at indices ``(k, 1 + b)`` under the worst deviations."""
        c = self.normals(indices[:, 1:])
        along = np.einsum("kd,kdq->kq", c, self.answers(x, indices[:, 0]))
        return np.asarray(self.loop.height(along) - self.set.support(c))[:, None]

    def uncertain(self, index: Array) -> UncertainRows:
        """The row at one time and direction."""
        c = self.normals(index[None, 1:])
        return self.rows(float(index[0]), c, self.set.support(c))

    def worst(self, x: Array) -> Separation:
        """The largest local maxima over times and directions, climbed from until the steps vanish."""
        (z, c, reach), times = self._lattice, self.times
        step = max(1, STATES // ((1 + self.loop.spread.size) * max(c.shape)))
        values = np.concatenate(
            [self.loop.height(c @ self.answers(x, times[first : first + step])) for first in range(0, times.size, step)]
        )
        values = values - reach
        places, likely = turns(values.T, neighbours(self._b), self.unit)
        rows, at = places.T
        heights, held = values[at, rows], np.hstack([times[at, None], z[rows]])
        held[:likely], heights[:likely] = self._turned(x, held[:likely])
        best = highest_at(at, heights)
        held, heights = held[best], heights[best]
        wide, pieces = float(np.max(np.diff(times), initial=0.0)), np.searchsorted(self.spans[0], times)
        indices, found = ridden(
            held,
            heights,
            pieces,
            np.flatnonzero(np.isin(times, np.concatenate(self.spans))),
            lambda points: self._turned(x, points),
            lambda points: self._climbed(x, points, wide),
        )
        return Separation(indices, np.zeros(found.size, dtype=int), found)

    def _turned(self, x: Array, points: Array) -> tuple[Array, Array]:
        """Where climbs from points ``(k, 1 + b)`` over directions alone end, and how high."""
        if not points.size:
            return points, np.zeros(0)
        held = np.clip(points[:, :1], self.spans[0][0], self.spans[1][-1])
        at, step = self.answers(x, held[:, 0]), np.full(self._b, STEP)

        def excess(z: Array, which: np.ndarray) -> Array:
            c = self.normals(z)
            size = max(1, STATES // at[0].size)
            parts = [slice(first, first + size) for first in range(0, which.size, size)]
            along = [self.loop.height(np.einsum("kd,kdq->kq", c[part], at[which[part]])) for part in parts]
            return np.asarray(np.concatenate(along) - self.set.support(c))

        z, found = climb(excess, points[:, 1:], step, lambda z: on_surface(np.clip(z, -1.0, 1.0)))
        return np.hstack([held, z]), found

    def _climbed(self, x: Array, points: Array, wide: float) -> tuple[Array, Array]:
        """Where climbs from points ``(k, 1 + b)`` end, and how high; over directions alone at a single time."""
        first, last = self.spans[0][0], self.spans[1][-1]
        if first == last:
            return self._turned(x, points)

        def project(inside: Array) -> Array:
            return np.hstack([np.clip(inside[:, :1], first, last), on_surface(np.clip(inside[:, 1:], -1.0, 1.0))])

        sizes = np.append(wide, np.full(self._b, STEP))
        return climb(lambda at, _: self.excess(x, at)[:, 0], points, sizes, project)

    @property
    def cells(self) -> tuple[Array, Array]:
        """The spans of time, times the faces of the cube of directions."""
        low, high = faces(self._b)
        found = []
        for ends, corners in zip(self.spans, (low, high), strict=True):
            found.append(np.hstack([np.repeat(ends, len(low))[:, None], np.tile(corners, (ends.size, 1))]))
        return found[0], found[1]

    def enclosure(self, x: Array, lower: Array, upper: Array) -> Enclosure:
        """Proven upper bounds of the violation on cells of times and directions, by a point ``p`` of the set for
        each."""
        frame, low, high = self.set.frame / self.unit, lower[:, 1:], upper[:, 1:]
        ends = np.stack([np.where(side, high, low) for side in product((False, True), repeat=self._b)], axis=1)
        H, centre = ends @ frame, (low + high) / 2 @ frame
        p = self.set.support_point(centre)
        bounds, late = self.between(x, lower[:, 0], upper[:, 0], H)
        tangent = np.einsum("krd,kd->kr", H, p)
        size = np.einsum("krd,kd->kr", np.abs(H), np.abs(p))
        over = (bounds - tangent + ROUND_OFF * size).max(axis=1)
        # in the length of the directions: at least how far p is from the middle along them
        rooms = (tangent - H @ self.set.interior_point()).min(axis=1) * self.unit
        with np.errstate(divide="ignore", invalid="ignore"):
            over = np.where(over > 0.0, np.where(rooms > 0.0, over / np.maximum(rooms, 0.0), np.inf), over)
        turned = (self.set.support(H) - tangent).max(axis=1)
        widest = 1 + (high - low).argmax(axis=1)
        narrow = (high - low).max(axis=1) <= 0.0
        split = np.where((late.max(axis=1) > turned) | narrow, 0, widest)
        split = np.where(upper[:, 0] > lower[:, 0], split, widest)
        return Enclosure(over, split)

    def against(self, x: Array, index: Array, row: int) -> tuple[Array, float, int | None]:
        """A deviation ``(Q,)`` that is the worst at an index, and what stands beside the state then: no control."""
        along = self.normals(index[None, 1:])[0] @ self.answers(x, index[:1])[0]
        return self.loop.spread.worst(along[1:]), 0.0, None

    def explain(self, index: Array, row: int) -> Explanation:
        """One constraint for people, at every disturbance, or at the deviations that the index says."""
        return told(self.explained(index[: 1 + self._b]), self.loop, index[1 + self._b :])


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
    def source(self) -> Source:
        return self.curved

    @cached_property
    def _flat(self) -> FeedbackConstraint:
        return FeedbackConstraint(self.curved.outer, self.loop)

    @property
    def times(self) -> Array:
        return self._flat.flat.times

    @property
    def spans(self) -> tuple[Array, Array]:
        lower, upper = self._flat.cells
        return lower[:, 0], upper[:, 0]

    def answers(self, x: Array, times: Array) -> Array:
        found = self.loop.states(x, times)
        found[:, :, 0] += self.curved.beside(x, times)
        return found

    def between(self, x: Array, lower: Array, upper: Array, H: Array) -> tuple[Array, Array]:
        beside = tuple(H @ self.curved.beside(x, times)[:, :, None] for times in (lower, upper))
        return self.loop.bounded(x, lower, upper, H, (beside[0], beside[1]))

    def rows(self, time: float, H: Array, h: Array) -> UncertainRows:
        moved = H @ self.curved.beside(np.zeros(0), np.array([time]))[0]
        return self.loop.state_rows(time, H, h - moved, np.zeros(1, dtype=int), np.ones(1))

    def explained(self, index: Array) -> TimedExplanation:
        return self.curved.explain(index, 0)


@final
@dataclass(frozen=True, eq=False)
class FeedbackCurvedControl(Turning, Source):
    """What the control does at ``places``, on every piece or at every step, in a curved set for every disturbance."""

    convex: ConvexSet
    called: str
    places: Places

    def normals_in(self, units: Units) -> tuple[Array, Array]:
        """That of a gauge."""
        return of_gauge()

    @property
    def name(self) -> str:
        return self.called

    @property
    def set(self) -> ConvexSet:
        return self.convex

    @property
    def source(self) -> Source:
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
        along, size = (each[at] for each in acting(self.loop, self.places, x))
        lost = np.abs(H) @ size @ np.concatenate([[1.0], self.loop.spread.radii])
        found = self.loop.height(H @ along) + ROUND_OFF * lost
        return found, np.zeros(found.shape)

    def rows(self, time: float, H: Array, h: Array) -> UncertainRows:
        return rows_at(self.loop, self.places, int(self.places.at(np.array([time]))[0]), H, h)

    def worst(self, x: Array) -> Separation:
        """Every place in its worst direction, worst first."""
        every, (z, c, reach) = acting(self.loop, self.places, x)[0], self._lattice
        start = z[(self.loop.height(c @ every) - reach).argmax(axis=1)]

        def excess(at: Array, which: np.ndarray) -> Array:
            directions = self.normals(at)
            along = np.einsum("kd,kdq->kq", directions, every[which])
            return np.asarray(self.loop.height(along) - self.set.support(directions))

        z, found = climb(excess, start, np.full(self._b, STEP), lambda at: on_surface(np.clip(at, -1.0, 1.0)))
        order = np.argsort(-found, kind="stable")
        indices = np.hstack([self.times[order, None], z[order]])
        return Separation(indices, np.zeros(order.size, dtype=int), found[order])

    def explained(self, index: Array) -> TimedExplanation:
        time = float(self.places.times[self.places.at(index[:1])[0]]) if self.places.steps else float(index[0])
        text = f"{self.name}: {self.places.words(time)} in the {self.set.kind}"
        return TimedExplanation(text, self.name, text, time, self.normals(index[None, 1:])[0])


def of_state(constraint: object, loop: ClosedLoop) -> FeedbackConstraint | FeedbackCurved:
    """A constraint on the state under feedback."""
    if isinstance(constraint, CurvedConstraint):
        return FeedbackCurved(loop, constraint)
    return FeedbackConstraint(constraint, loop)  # type: ignore[arg-type]
