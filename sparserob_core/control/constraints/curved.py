"""State constraints with curved sets: the normal direction is one more index, so that every constraint stays a
half-space."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import final

import numpy as np

from sparserob_core.control.constraints.explanation import TimedExplanation, explanation
from sparserob_core.control.constraints.flat import FlatConstraint
from sparserob_core.control.constraints.local_maxima import (
    climb,
    highest_at,
    local_maxima,
    ridden,
    turns,
    vertices,
)
from sparserob_core.control.constraints.state import StateConstraint
from sparserob_core.control.enclosures.cache import remember
from sparserob_core.control.reach.enclosure import Bounded, CellEnclosure, enclose, kept, over_legs
from sparserob_core.control.reach.functional import WorstFunctionals
from sparserob_core.control.reach.many_directions import ManyDirections
from sparserob_core.control.reach.sizes import nominal_sizes
from sparserob_core.control.reach.support import Leg
from sparserob_core.control.response.parameters import ParameterIndex
from sparserob_core.control.response.reference import STILL, MovingReference, Reference
from sparserob_core.control.sets.directions import across, faces, neighbours, on_surface, sampled, shares, unit
from sparserob_core.shapes import Float, Int, shaped
from sparserob_core.sip.convex_set import Array, Box, ConvexSet
from sparserob_core.sip.expressions.taylor import Combination, combination
from sparserob_core.sip.program import Enclosure, Separation

CLIMBED_SAMPLES = 8  # samples in any direction that are climbed from, beside the maxima along time
# Of the longest direction of a cell, what its shortest is taken for when it is said where to halve; a bound that may be
# 0 would say nothing of the others.
SHORTEST, TINY = 1e-3, float(np.finfo(float).tiny)
FIRST_STEP = 0.1  # first step of directions, on the cube of edge 2


@final
@dataclass(frozen=True, eq=False)
class CurvedConstraint(StateConstraint):
    """``x(t)`` in a curved set for all ``t`` in ``[start, stop]``, ``p`` and ``w``: ``c'x(t) <= h(c)`` for every
    direction ``c``, normalised such that ``h(c) - c'm = 1 / unit`` for the interior point ``m`` of the set. The largest
    violation is the gauge of ``x(t)`` about ``m`` less 1, in multiples of ``unit``. A set with a ``reference`` moves:
    it holds ``x(t) - r(t)``.

    The index is ``(t, p, z)`` with ``z`` in ``[-1, 1]^b`` a direction, not normalised, in the coordinates of the set's
    `ConvexSet.frame`.
    """

    name: str
    functionals: WorstFunctionals
    set: ConvexSet
    start: float
    stop: float
    parameters: ParameterIndex
    unit: float = 1.0
    reference: Reference = STILL
    shared: CurvedConstraint | None = field(default=None, repr=False)

    @property
    def sides(self) -> None:
        """Half-spaces of the set: ``None``, since the set is curved."""

    @property
    def shape(self) -> ConvexSet:
        return self.set

    @property
    def index_set(self) -> Box:
        box, cube = self._outer_constraint.index_set, np.ones(self._cube_dimension)
        return Box(np.concatenate([box.lower, -cube]), np.concatenate([box.upper, cube]))

    @shaped
    def divided(self, units: Float[Array, " r"]) -> CurvedConstraint:
        return replace(self, unit=float(units[0]), shared=None)

    @shaped
    def functionals_at(
        self, indices: Float[Array, "k j"]
    ) -> tuple[Float[Array, " n"], Float[Array, "n d"], Float[Array, "n nu"], Float[Array, " n"]]:
        nu = self.parameters.count
        directions = unit(self.set, indices[:, 1 + nu :]) / self.unit
        rhs = self.set.support(directions) + (directions * self.reference.at(indices[:, 0])).sum(axis=1)
        return indices[:, 0], directions, self.parameters.clamp(indices[:, 1 : 1 + nu]), rhs

    @shaped
    def violations(
        self, x: Float[Array, " n"], indices: Float[Array, "k j"], rows: Int[np.ndarray, " k"]
    ) -> Float[Array, " k"]:
        return self._compute_violations(x, indices)

    @shaped
    def worst(self, x: Float[Array, " n"]) -> Separation:
        """Return the largest local maxima over a lattice of times, parameters and directions, climbed from until the
        steps vanish."""
        flat, box, times = self._outer_constraint, self.index_set, self._outer_constraint.times
        values = flat.on_lattice(x)
        worst_indices, heights = self._find_worst_indices(x, values)
        samples = local_maxima(values, flat.lattice[1], CLIMBED_SAMPLES)
        samples = samples[np.argsort(-values[tuple(samples.T)], kind="stable")][:CLIMBED_SAMPLES]
        sample_points = self._build_indices(vertices(values, samples, times)[0], samples)
        step = np.concatenate(
            [
                [np.max(np.diff(times), initial=0.0)],
                (box.upper - box.lower)[1 : 1 + self.parameters.count] / 4,
                np.full(self._cube_dimension, FIRST_STEP),
            ]
        )

        def climbed(points: Array) -> tuple[Array, Array]:
            starts = np.vstack([points, sample_points])
            ends, violations = climb(
                lambda at, _: self._compute_violations(x, at, self._has_integrals), starts, step, self._project_indices
            )
            return ends, self._compute_violations(x, ends) if self._has_integrals else violations

        indices, violations = ridden(
            worst_indices, heights, flat.pieces, flat.kinks, lambda points: self._climb_directions(x, points), climbed
        )
        return Separation(indices, np.zeros(violations.size, dtype=int), violations)

    @shaped
    def _find_worst_indices(
        self, x: Float[Array, " n"], values: Float[Array, "v r t"]
    ) -> tuple[Float[Array, "t j"], Float[Array, " t"]]:
        """Return the worst index at every sampled time and its violation, at the worst sampled parameter, in a
        direction that is climbed to from the sampled ones wherever these say that the set may be left. Samples are
        lower by what lies between directions, which hides where along a wall that is ridden it is left."""
        places, likely = turns(values.max(axis=0), neighbours(self._cube_dimension), self.unit)
        rows, at = places.T
        heights = values[:, rows, at].max(axis=0)
        worst_indices = self._build_indices(
            self._outer_constraint.times[at], np.stack([values[:, rows, at].argmax(axis=0), rows], axis=1)
        )
        worst_indices[:likely], heights[:likely] = self._climb_directions(x, worst_indices[:likely])
        best = highest_at(at, heights)
        return worst_indices[best], heights[best]

    @shaped
    def _climb_directions(
        self, x: Float[Array, " n"], indices: Float[Array, "k j"]
    ) -> tuple[Float[Array, "k j"], Float[Array, " k"]]:
        """Return indices at the same times and parameters, their directions climbed from, and the violations there."""
        if not indices.size:
            return indices, np.zeros(0)
        indices, first = self._project_indices(indices), 1 + self.parameters.count
        times = indices[:, 0]
        along = ManyDirections(self.functionals).turning(x, times, self.parameters.clamp(indices[:, 1:first]))
        moves = self.reference.at(times)

        def height(z: Array, which: np.ndarray) -> Array:
            c = unit(self.set, z) / self.unit
            return np.asarray(along(c, which) - self.set.support(c) - (c * moves[which]).sum(axis=1))

        start = np.full(self._cube_dimension, FIRST_STEP)
        z, violations = climb(height, indices[:, first:], start, lambda z: on_surface(np.clip(z, -1.0, 1.0)))
        ends = np.hstack([indices[:, :first], z])
        return ends, self._compute_violations(x, ends) if self._has_integrals else violations

    @shaped
    def _build_indices(self, times: Float[Array, " k"], positions: Int[np.ndarray, "k q"]) -> Float[Array, "k j"]:
        """Return indices ``(t, p, z)`` of positions on the lattice, at these times."""
        return np.hstack(
            [
                times[:, None],
                self._outer_constraint.lattice[0][positions[:, 0]],
                sampled(self._cube_dimension)[positions[:, 1]],
            ]
        )

    @shaped
    def _compute_violations(
        self, x: Float[Array, " n"], indices: Float[Array, "k j"], roughly: bool = False
    ) -> Float[Array, " k"]:
        times, directions, parameters, rhs = self.functionals_at(indices)
        return self.functionals.values(x, times, directions, parameters, roughly) - rhs

    @property
    def _has_integrals(self) -> bool:
        """True where measurable disturbances or errors of execution add integrals to the rows.

        Climbs then use approximate integrals, so that the directions they reach are approximate. The violations there
        are evaluated again.
        """
        return self.functionals.measurable is not None or self.functionals.execution is not None

    @shaped
    def _project_indices(self, points: Float[Array, "k j"]) -> Float[Array, "k j"]:
        """Return the nearest indices to points ``(k, j)``, directions on the surface of their cube."""
        box, count = self.index_set, self.parameters.count
        inside = np.clip(points, box.lower, box.upper)
        return np.hstack(
            [inside[:, :1], self.parameters.clamp(inside[:, 1 : 1 + count]), on_surface(inside[:, 1 + count :])]
        )

    @property
    @shaped
    def cells(self) -> tuple[Float[Array, "k j"], Float[Array, "k j"]]:
        """The cells of times and parameters, times the faces of the cube of directions."""
        lower, upper = self._outer_constraint.cells
        low, high = faces(self._cube_dimension)
        return (
            np.hstack([np.repeat(lower, low.shape[0], axis=0), np.tile(low, (lower.shape[0], 1))]),
            np.hstack([np.repeat(upper, high.shape[0], axis=0), np.tile(high, (upper.shape[0], 1))]),
        )

    @shaped
    def enclosure(self, x: Float[Array, " n"], lower: Float[Array, "k j"], upper: Float[Array, "k j"]) -> Enclosure:
        """Return proven upper bounds of the violation on cells ``(k, 1 + nu + b)``; where nothing is violated, in the
        length of the cube's directions."""
        nu = self.parameters.count
        touched = self.parameters.touches(lower[:, 1 : 1 + nu], upper[:, 1 : 1 + nu])
        enclosure = enclose(lower, upper, touched, nu, lambda low, high: self._enclose_cell(x, low, high))
        with np.errstate(divide="ignore"):
            rooms = np.maximum(self._bound_extents(lower[:, 1 + nu :], upper[:, 1 + nu :]), 0.0)
            return replace(
                enclosure, bounds=np.where(enclosure.bounds > 0.0, enclosure.bounds / rooms, enclosure.bounds)
            )

    @shaped
    def _bound_extents(self, low: Float[Array, "k b"], high: Float[Array, "k b"]) -> Float[Array, " k"]:
        """Return lower bounds ``(k,)`` of ``h(c) - c'm`` for the directions of cells: a point ``p`` of the set far out
        in the middle direction gives at least ``c'(p - m)``."""
        frame = self.set.frame
        centre, radius = (low + high) / 2, (high - low) / 2
        outwards = (self.set.support_point(centre @ frame) - self.set.interior_point()) @ frame.T
        answer: Array = (centre * outwards).sum(axis=1) - (radius * np.abs(outwards)).sum(axis=1)
        return answer

    @shaped
    def _compute_lengthening(self, H: Float[Array, "r d"], shortest: float) -> Float[Array, " j"]:
        """Return the share by which ``h(c) - c'm`` exceeds ``shortest`` where one coordinate of the directions
        ``c = H[0] + sum_j eta_j H[j]`` is at an end."""
        ends = np.maximum(*(self.set.support(c) - c @ self.set.interior_point() for c in (H[0] + H[1:], H[0] - H[1:])))
        return np.asarray(ends / max(shortest, SHORTEST * ends.max(initial=0.0), TINY) - 1.0)

    @shaped
    def explain(self, index: Float[Array, " j"], row: int) -> TimedExplanation:
        times, directions, parameters, rhs = self.functionals_at(index[None])
        at = (float(times[0]), parameters[0])
        description = explanation(
            self.name, self.functionals, directions, rhs, 0, *at, scale=float(np.abs(directions).max())
        )
        tangent = f" (a tangent of the {self.set.kind})"
        return replace(description, text=description.text + tangent, statement=description.statement + tangent)

    @property
    @shaped
    def sized_rows(self) -> tuple[Float[Array, "q d"], Float[Array, " q"]]:
        rows = self._outer_constraint.H if self.unit > 1.0 else np.zeros((0, self.set.dimension))
        return rows, np.full(len(rows), 1.0 / self.unit)

    def _compute_row_sizes(self, x: Array, rows: Array) -> Array:
        return np.asarray(np.abs(rows) @ nominal_sizes(self.functionals, x, np.eye(self.set.dimension)))

    def nominal(self) -> CurvedConstraint:
        functionals = self.functionals.nominal()
        return replace(self, functionals=functionals, parameters=ParameterIndex(None), shared=None)

    @shaped
    def from_state(self, initial_state: Float[Array, " d"]) -> CurvedConstraint:
        functionals = self.functionals.from_state(initial_state)
        return replace(self, functionals=functionals, shared=self._shareable_constraint or self)

    @shaped
    def directions(
        self, z: Float[Array, "k b"], rows: Int[np.ndarray, " k"]
    ) -> tuple[Float[Array, "k b d"], Float[Array, "k b"]]:
        frame = self.set.frame / self.unit
        return np.broadcast_to(frame, (rows.size, *frame.shape)), shares(self.set, z)

    @shaped
    def turned(
        self, z: Float[Array, "k b"], directions: Float[Array, "k d"], states: Float[Array, "k b"]
    ) -> Float[Array, "k b"]:
        return across(self.set, z, states - self.set.support_point(directions) @ self.set.frame.T / self.unit)

    @shaped
    def compute_added_terms(self, x: Float[Array, " n"], times: Float[Array, " k"]) -> Float[Array, "k d"]:
        return np.zeros(self.set.dimension) - self.reference.at(times)

    @shaped
    def outwardness(
        self, states: Float[Array, "d n"], added_terms: Float[Array, " d"] | None = None
    ) -> Float[Array, " n"]:
        states = states if added_terms is None else states + added_terms[:, None]
        sizes = self.set.gauge(states.T) - 1.0
        return sizes if np.isfinite(sizes).all() else self.set.violation(states.T)

    @shaped
    def _enclose_cell(self, x: Float[Array, " n"], low: Float[Array, " j"], high: Float[Array, " j"]) -> Bounded:
        key = x.tobytes() + low.tobytes() + high.tobytes()
        if key not in self._cell_enclosures:
            nu = self.parameters.count
            centre, radius = (low + high)[nu:] / 2, (high - low)[nu:] / 2
            free = np.flatnonzero(radius > 0)
            H = np.vstack([centre, np.diag(radius)[free]]) @ self.set.frame / self.unit
            over_cells = self.functionals.over_cells
            legs = over_cells.legs(low[:nu], high[:nu])
            joined = self._build_combination(legs[0], free.size)
            rhs, looseness = self._compute_minorant(H, joined, nu)
            shortest = self._bound_extents(low[None, nu:], high[None, nu:])[0]
            lengthening = np.concatenate([np.zeros(nu), self._compute_lengthening(H, shortest / self.unit)])
            control = self.functionals.control(x)
            cuts = self.parameters.cuts(low[:nu], high[:nu])
            moving = MovingReference(self.reference, H) if self.reference.moves else None

            def cell(leg: Leg) -> CellEnclosure:
                supports = over_cells.support(leg, H, joined)
                sigma = over_cells.with_execution(supports, control, H, leg, joined)
                return CellEnclosure(leg, sigma, H, rhs, control, joined, looseness, lengthening, cuts, moving)

            remember(self._cell_enclosures, key, over_legs(legs, cell), kept(control))
        return self._cell_enclosures[key]

    @shaped
    def _compute_minorant(
        self, H: Float[Array, "r d"], joined: Combination, nu: int
    ) -> tuple[Float[Array, "1 M"], Float[Array, " j"]]:
        """Return a quadratic polynomial below ``h(c_0 + sum_j eta_j c_j)``, ``(1, M')``, and how far below at the ends
        of every coordinate."""
        value, gradient, hessian = self.set.support_minorant(H[0], H[1:])
        rhs = np.zeros((1, joined.space.size))
        rhs[0, 0] = value
        unit_exponents = np.eye(joined.space.nu, dtype=int)[nu:]
        for i, first in enumerate(unit_exponents):
            rhs[0, joined.space.index[tuple(first.tolist())]] = gradient[i]
            for j, second in enumerate(unit_exponents):
                rhs[0, joined.space.index[tuple((first + second).tolist())]] += hessian[i, j] / 2
        ends = [
            self.set.support(H[0] + sign * H[1:]) - value - sign * gradient - np.diag(hessian) / 2
            for sign in (-1.0, 1.0)
        ]
        return rhs, np.concatenate([np.zeros(nu), np.maximum(*ends)])

    def _build_combination(self, lifted: Leg, free: int) -> Combination:
        if free not in self._combinations:
            self._combinations[free] = combination(lifted.space, free)
        return self._combinations[free]

    @cached_property
    def _combinations(self) -> dict[int, Combination]:
        return {} if self._shareable_constraint is None else self._shareable_constraint._combinations

    @property
    def _shareable_constraint(self) -> CurvedConstraint | None:
        """The ``shared`` constraint where it is the same but for its initial state."""
        shared = self.shared
        if shared is None or (shared.start, shared.stop) != (self.start, self.stop):
            return None
        functionals, shared_functionals = self.functionals, shared.functionals
        same = (
            shared.set is self.set
            and shared.reference is self.reference
            and shared.parameters is self.parameters
            and functionals.response.propagator is shared_functionals.response.propagator
            and functionals.dictionary is shared_functionals.dictionary
            and functionals.disturbance is shared_functionals.disturbance
            and functionals.initial is shared_functionals.initial
        )
        return shared if same else None

    @cached_property
    def _cell_enclosures(self) -> dict[bytes, Bounded]:
        return {}

    @property
    def _cube_dimension(self) -> int:
        return int(self.set.normals.shape[0])

    @cached_property
    def _outer_constraint(self) -> FlatConstraint:
        """The half-spaces of the sampled directions: an outer polytope of the set, on which the search starts."""
        if self._shareable_constraint is not None:
            return self._shareable_constraint._outer_constraint.from_state(self.functionals.response.initial_state)
        H = unit(self.set, sampled(self._cube_dimension)) / self.unit
        return FlatConstraint(
            self.name,
            self.functionals,
            H,
            self.set.support(H),
            self.start,
            self.stop,
            self.parameters,
            reference=self.reference,
        )
