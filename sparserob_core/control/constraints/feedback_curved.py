"""Curved sets of controls under feedback: the normal direction is one more index, as without feedback.

For a fixed direction a row is as any other. All directions of a cell are proven at once: for a point ``p`` of the set,
``max_w c'u - h(c) <= max_w c'u - c'p``. The right side is convex in ``c``, so that it is largest at a corner of the
cell.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from itertools import product
from typing import final

import numpy as np

from sparserob_core.control.constraints.control import Places
from sparserob_core.control.constraints.curved import FIRST_STEP
from sparserob_core.control.constraints.explanation import ConstraintSource, TimedExplanation, of_gauge
from sparserob_core.control.constraints.feedback import acting, build_family, describe_deviations, rows_at
from sparserob_core.control.constraints.local_maxima import climb
from sparserob_core.control.feedback.closed_loop import ROUND_OFF, ClosedLoop
from sparserob_core.control.problem.units import Units
from sparserob_core.control.sets.directions import faces, on_surface, sampled, unit
from sparserob_core.sip.convex_set import Array, Box, ConvexSet
from sparserob_core.sip.finite import UncertainRows
from sparserob_core.sip.program import ConstraintFamily, Enclosure, Explanation, Separation

FIRST_PLACES = 5  # places that a method begins with, in the directions of the axes


@final
@dataclass(frozen=True, eq=False)
class FeedbackCurvedControl(ConstraintSource):
    """Constraint that the control at ``places``, on every piece or at every step, stays in a curved ``set`` for every
    disturbance, in every direction ``c``.

    Directions are normalised such that ``h(c) - c'm = 1`` for the interior point ``m`` of the set. The index is
    ``(t, z)``, with a direction ``z`` in the coordinates of the set's frame, or ``(t, z, w)`` with the deviations.
    """

    name: str
    loop: ClosedLoop
    places: Places
    set: ConvexSet

    def normals_in(self, units: Units) -> tuple[Array, Array]:
        """Return the normal ``(1, 1)`` and the unit ``(1,)`` of the one row, which is in multiples of the set's gauge
        in any units."""
        return of_gauge()

    @property
    def measured(self) -> tuple[str, ...]:
        """The unit of its one row: none, since that is in multiples of the set's gauge."""
        return ("",)

    def family(self) -> ConstraintFamily:
        """Return the constraint as a family."""
        cube, times = np.ones(self._cube_dimension), self.places.times
        low, high = (ends[position] for ends, position in zip(self.places.spans, (0, -1), strict=True))
        index_set = Box(np.append(low, -cube), np.append(high, cube))
        positions = np.unique(np.linspace(0, times.size - 1, min(FIRST_PLACES, times.size)).round().astype(int))
        axes = np.vstack([np.eye(self._cube_dimension), -np.eye(self._cube_dimension)])
        start = np.hstack([np.repeat(times[positions], len(axes))[:, None], np.tile(axes, (positions.size, 1))])
        family = build_family(self, index_set, start, self)
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
        c = unit(self.set, z)
        return z, c, self.set.support(c)

    def excess(self, x: Array, indices: Array) -> Array:
        """Return violations ``(k, 1)`` at indices ``(k, 1 + b)`` under the worst deviations."""
        controls = acting(self.loop, self.places, x)[0][self.places.at(indices[:, 0])]
        return self._compute_violations(controls, indices[:, 1:])[:, None]

    def _compute_violations(self, controls: Array, z: Array) -> Array:
        """Return violations ``(k,)`` of controls with their responses, ``(k, m, 1 + Q)``, in directions ``(k, b)``."""
        c = unit(self.set, z)
        return np.asarray(self.loop.height(np.einsum("kd,kdq->kq", c, controls)) - self.set.support(c))

    def uncertain(self, index: Array) -> UncertainRows:
        """Return the row at one place and direction."""
        c = unit(self.set, index[None, 1:])
        (place,) = self.places.at(index[:1]).tolist()
        return rows_at(self.loop, self.places, place, c, self.set.support(c))

    def worst(self, x: Array) -> Separation:
        """Return every place with its worst direction, climbed to from the sampled ones, worst first."""
        controls, (z, c, support_values) = acting(self.loop, self.places, x)[0], self._lattice
        start = z[(self.loop.height(c @ controls) - support_values).argmax(axis=1)]
        z, violations = climb(
            lambda at, which: self._compute_violations(controls[which], at),
            start,
            np.full(self._cube_dimension, FIRST_STEP),
            lambda at: on_surface(np.clip(at, -1.0, 1.0)),
        )
        order = np.argsort(-violations, kind="stable")
        indices = np.hstack([self.places.times[order, None], z[order]])
        return Separation(indices, np.zeros(order.size, dtype=int), violations[order])

    @property
    def cells(self) -> tuple[Array, Array]:
        """The spans of time that stand for the places, times the faces of the cube of directions."""
        low, high = (
            np.hstack([np.repeat(ends, len(corners))[:, None], np.tile(corners, (ends.size, 1))])
            for ends, corners in zip(self.places.spans, faces(self._cube_dimension), strict=True)
        )
        return low, high

    def enclosure(self, x: Array, lower: Array, upper: Array) -> Enclosure:
        """Return proven upper bounds of the violation on cells of places and directions, by a point ``p`` of the set
        for each."""
        frame, low, high = self.set.frame, lower[:, 1:], upper[:, 1:]
        ends = np.stack(
            [np.where(side, high, low) for side in product((False, True), repeat=self._cube_dimension)], axis=1
        )
        H, p = ends @ frame, self.set.support_point((low + high) / 2 @ frame)
        at = self.places.at((lower[:, 0] + upper[:, 0]) / 2)
        along, sizes = (array[at] for array in acting(self.loop, self.places, x))
        magnitudes = np.abs(H) @ sizes @ np.concatenate([[1.0], self.loop.spread.radii])
        bounds = self.loop.height(H @ along) + ROUND_OFF * magnitudes
        tangent = np.einsum("krd,kd->kr", H, p)
        size = np.einsum("krd,kd->kr", np.abs(H), np.abs(p))
        violations = (bounds - tangent + ROUND_OFF * size).max(axis=1)
        # in the length of the directions: at least how far p is from the middle along them
        rooms = (tangent - H @ self.set.interior_point()).min(axis=1)
        with np.errstate(divide="ignore", invalid="ignore"):
            violations = np.where(
                violations > 0.0, np.where(rooms > 0.0, violations / np.maximum(rooms, 0.0), np.inf), violations
            )
        return Enclosure(violations, 1 + (high - low).argmax(axis=1))

    def explain(self, index: Array, row: int) -> Explanation:
        """Return the description of one constraint for a reader, for every disturbance, or at the deviations that the
        index holds."""
        z, w = np.split(index[1:], [self._cube_dimension])
        time = float(self.places.times[self.places.at(index[:1])[0]]) if self.places.steps else float(index[0])
        text = f"{self.name}: {self.places.words(time)} in the {self.set.kind}"
        direction = unit(self.set, z[None])[0]
        return describe_deviations(TimedExplanation(text, self.name, text, time, direction), self.loop, w)
