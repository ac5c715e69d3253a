"""The search behind the feasible initial states: the plane fitted to the set, its boundary from both sides, and costs
inside."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from itertools import product
from typing import Any, final

import numpy as np

from sparserob_core.control.studies.initial_states import InitialPlane
from sparserob_core.control.studies.polygon_approximation import (
    AXES,
    SupportBound,
    inner_polygon,
    inside,
    outer_polygon,
    polygon_area,
    sandwich,
)
from sparserob_core.errors import InputError, SolverError
from sparserob_core.experiment.initial_states.feasible_set import InitialStates
from sparserob_core.experiment.run.events import StudyProgress
from sparserob_core.sip.convex_set import Array
from sparserob_core.sip.events import Notify
from sparserob_core.sip.evidence import Cut
from sparserob_core.sip.method import Tools
from sparserob_core.sip.methods.exchange import Exchange
from sparserob_core.sip.result import Result

# The box of coordinates, relative to what is proven to contain the set: its sides must not matter
COORDINATE_BOX_FACTOR = 1.1
FRAMES = 4  # boxes at most, each fitted to the set by the last one
SLIVER = 1e-9  # of the box in area: a set without interior
CLOSED_AREA_SHARE = 1e-3  # of the area: a difference of the polygons that is called none
COST_INSET = 1e-3  # how far costs are measured within the vertices, where no control has any room
PROVEN = ("certified", "verified")


@final
@dataclass(eq=False)
class InitialStatesSearch:
    """State of one search: the plane, the cuts that each direction needed, and the controls of the points found.

    ``least (2,)``: radii of the plane below which a coordinate has no interior. ``units (2,)``: one unit of each
    coordinate in the user's units, for messages only.
    """

    plane: InitialPlane
    tools: Tools
    tolerance: float
    notify: Notify
    least: Array
    units: Array
    bounded: bool
    cuts: dict[tuple[float, ...], Sequence[Cut]] = field(default_factory=dict)
    controls: dict[bytes, Array] = field(default_factory=dict)
    gains: dict[bytes, Array] = field(default_factory=dict)
    remarks: list[str] = field(default_factory=list)
    asked: list[SupportBound] = field(default_factory=list)
    interrupted: str = ""
    frame: tuple[InitialPlane, list[SupportBound]] | None = None
    programs: int = 0
    directions: int = 0
    started: float = field(default_factory=time.perf_counter)

    def states(self, title: str, directions: int, values: int) -> InitialStates:
        self.directions = directions
        problem = self.plane.model.problem
        origin = np.asarray(problem.initial_state, dtype=float)
        template = InitialStates(
            title=title,
            states=self.plane.states,
            status="undecided",
            message="",
            origin=origin,
            called=problem.names,
            cost_unit=problem.cost_unit,
        )
        limit = self._format_size(self.plane.radius)
        try:
            with self.tools.deadline.enforced():
                framed = self._fit_frame()
        except KeyboardInterrupt as pressed:
            self._note_interrupt(pressed)
            if self.frame is None:
                return self._finish_result(template, message="nothing is known of the set yet")
            self.plane, framed = self.frame
        if isinstance(framed, Result):
            # amounts would be relative to rows that hold the initial state in units of the box: of no use
            reason = framed.message if framed.infeasible is None else framed.infeasible.sentence(amounts=False)
            message = f"no initial state of this plane, up to {limit} in size, is feasible{self._restriction}: {reason}"
            return self._finish_result(template, status="infeasible", message=message)
        try:
            self._report_progress("direction", len(framed), directions)
            with self.tools.deadline.enforced():
                supports = sandwich(
                    self._explore_direction, framed, 0 if self.interrupted else directions, 0.1 * CLOSED_AREA_SHARE
                )
        except KeyboardInterrupt as pressed:
            self._note_interrupt(pressed)
            supports = sorted([*framed, *self.asked], key=lambda one: float(np.arctan2(*one.direction[::-1])))
        inner = inner_polygon(supports)
        points, results = self._compute_costs(inner, values)
        feasible_set = replace(
            self._add_polygons(template, supports, inner),
            points=self.plane.point(points),
            costs=np.array([r.upper_bound for r in results]),
            lower_bounds=np.array([r.lower_bound for r in results]),
        )
        if not inner.shape[0]:
            return self._finish_result(
                feasible_set,
                message="no initial state is proven feasible, and none in the outer polygon is proven infeasible",
            )
        size = polygon_area(outer_polygon(supports))
        if size <= max(SLIVER, self.plane.strip):
            return self._finish_result(
                feasible_set, status="certified", message="proven from both sides; the set has no interior"
            )
        share = 1.0 - polygon_area(inner) / size
        return self._finish_result(
            feasible_set,
            status="certified" if share <= CLOSED_AREA_SHARE else "verified",
            message=f"between two polygons, both proven{self._restriction}, that differ by {share:.2%} of the area",
        )

    def _add_polygons(self, bare: InitialStates, supports: Sequence[SupportBound], inner: Array) -> InitialStates:
        """The polygons and half-planes in the units of the model's states."""
        plane, scaled = self.plane, np.array([s.direction for s in supports]) / self.plane.radius
        norms = np.linalg.norm(scaled, axis=1)
        normals, vertices, outer = scaled / norms[:, None], plane.point(inner), plane.point(outer_polygon(supports))
        return replace(
            bare,
            inner=vertices,
            outer=outer,
            controls=np.array([self.controls[vertex.tobytes()] for vertex in inner]),
            gains=np.array([self.gains[vertex.tobytes()] for vertex in inner]) if self.gains else bare.gains,
            inner_gains=plane.model.response.inner.gains,
            directions=normals,
            bounds=np.array([s.bound for s in supports]) / norms + normals @ plane.centre,
            reached=(normals @ vertices.T).max(axis=1, initial=-np.inf),
        )

    def _finish_result(self, found: InitialStates, **changes: Any) -> InitialStates:
        if self.interrupted:
            changes["message"] = f"{changes['message']}; {self.interrupted}"
        return replace(
            found,
            remarks=tuple(self.remarks),
            programs=self.programs,
            seconds=time.perf_counter() - self.started,
            **changes,
        )

    @property
    def _restriction(self) -> str:
        """Restriction of a proof of infeasibility to affine policies, for messages; empty without feedback."""
        return "" if self.plane.model.feedback is None else " for affine policies"

    def _format_size(self, radius: Array) -> str:
        """The size of a box about 0 in the user's units."""
        first, second = (f"{size:.4g}" for size in radius * self.units)
        return first if first == second else f"{first} and {second}"

    def _report_progress(self, what: str, done: int, total: int) -> None:
        self.notify(StudyProgress(text=f"{what} {done} of {total}", done=done, total=total))

    def _note_interrupt(self, pressed: KeyboardInterrupt) -> None:
        """Go on with what is known."""
        self.interrupted = str(pressed) or "interrupted from the keyboard"

    def _fit_frame(self) -> list[SupportBound] | Result:
        """Fit the box of coordinates to the set; returns the supports along the axes, or the result that proves the set
        empty."""
        limit, least = self.plane.radius, self.least
        for number in range(FRAMES):
            supports = []
            for axis in AXES:
                result = self._solve_direction(axis)
                if result.status == "infeasible":
                    return result
                if not np.isfinite(result.lower_bound):
                    raise SolverError(f"the initial states could not be bounded: {result.message}")
                supports.append(self._make_support(axis, result))
            high, low = np.array([s.bound for s in supports[:2]]), -np.array([s.bound for s in supports[2:]])
            if not number and not self.bounded:
                self._require_bounded(np.concatenate([high, -low]))
            self.frame = self.plane, supports
            lower, upper = self.plane.point(low), self.plane.point(high)
            fits = (high - low > 1.0) | (self.plane.radius <= least)
            if number == FRAMES - 1 or (number and fits.all()):
                return supports
            middle, half = (lower + upper) / 2, np.maximum(COORDINATE_BOX_FACTOR * (upper - lower) / 2, least)
            self.plane = self.plane.resized(np.maximum(middle - half, -limit), np.minimum(middle + half, limit))
        raise AssertionError("the last frame returns")

    def _require_bounded(self, bounds: Array) -> None:
        free = np.flatnonzero(bounds > 0.999)
        if free.size:
            called = self.plane.model.problem.names
            names = [f"{called.state(self.plane.states[k % 2])}(0) {'above' if k < 2 else 'below'}" for k in free]
            limit = self._format_size(self.plane.radius)
            raise InputError(
                f"within: the set of feasible initial states has no bound on {', '.join(names)} up to {limit}; expected"
                " path or terminal sets that bound it, or a size of the plane to look at, such as 10"
            )

    def _explore_direction(self, direction: Array) -> SupportBound:
        support = self._make_support(direction, self._solve_direction(direction))
        self.asked.append(support)
        self._report_progress("direction", len(self.asked) + len(AXES), self.directions)
        return support

    def _solve_direction(self, direction: Array) -> Result:
        nearest_directions = sorted(
            self.cuts, key=lambda solved_direction: -float(np.dot(solved_direction, direction))
        )[:2]
        start_cuts = {
            (cut.family, cut.row, cut.index.tobytes()): cut
            for solved_direction in nearest_directions
            for cut in self.cuts[solved_direction]
        }
        program = self.plane.support(direction, list(start_cuts.values()))
        # The cost is linear and the point is all that is wanted: a regulariser of the control would only be in the way.
        result = Exchange(tolerance=self.tolerance).solve(program, replace(self.tools, regulariser=None))
        result = self.plane.weakened(result)
        self.programs += result.counts.get("relaxed_programs", 0)
        self.tools.deadline.check()
        self.cuts[tuple(direction.tolist())] = result.indices or tuple(start_cuts.values())
        return result

    def _make_support(self, direction: Array, result: Result) -> SupportBound:
        bound, proven = float(np.abs(direction).sum()), result.status in PROVEN
        # it is not: another direction has a point
        bound = bound if result.status == "infeasible" else min(-result.lower_bound, bound)
        point = None if result.decision is None else np.array(result.decision[-2:])
        if point is not None and proven and result.decision is not None:
            self.controls[point.tobytes()] = self.plane.controls(result.decision)
            feedback = self.plane.model.feedback
            if feedback is not None:
                self.gains[point.tobytes()] = feedback.loop.gains(result.decision[:-2])
        if not proven:
            self.remarks.append(
                f"in the direction {np.round(direction, 4).tolist()} no point is proven: {result.message}"
            )
        return SupportBound(direction, bound, point, proven)

    def _compute_costs(self, inner: Array, values: int) -> tuple[Array, list[Result]]:
        """Costs on a lattice within the inner polygon, and beside its vertices."""
        points, kept, results = _make_lattice(inner, 0 if self.interrupted else values), [], []
        for number, z in enumerate(points):
            try:
                self._report_progress("cost", number + 1, len(points))
                result = self.plane.rounded(z, Exchange(tolerance=self.tolerance).solve(self.plane.at(z), self.tools))
                self.tools.deadline.check()
            except KeyboardInterrupt as pressed:
                self._note_interrupt(pressed)
                break
            self.programs += result.counts.get("relaxed_programs", 0)
            if result.status in PROVEN:
                kept.append(z)
                results.append(result)
        if len(kept) < len(points):
            self.remarks.append(
                f"{len(points) - len(kept)} of {len(points)} costs could not be proven and are left out"
            )
        return np.array(kept).reshape(-1, 2), results


def _make_lattice(inner: Array, values: int) -> Array:
    """The points of a lattice that lie in a polygon, and points all around its edge, moved inwards a little; without
    interior, points on the segment."""
    if not values or not inner.shape[0]:
        return np.zeros((0, 2))
    middle = inner.mean(axis=0)
    corners = middle + (1.0 - COST_INSET) * (inner - middle)
    if polygon_area(inner) <= SLIVER:
        ends = inner[[0, int(np.linalg.norm(inner - inner[0], axis=1).argmax())]]
        return np.asarray(ends[0] + np.linspace(COST_INSET, 1.0 - COST_INSET, values)[:, None] * (ends[1] - ends[0]))
    sides = [
        np.linspace(low, high, values + 2)[1:-1] for low, high in zip(inner.min(axis=0), inner.max(axis=0), strict=True)
    ]
    lattice, step = np.array(list(product(*sides))), np.ptp(inner, axis=0) / (values + 1)
    around = [
        corner
        + np.linspace(0.0, 1.0, int(np.ceil(np.abs((next_corner - corner) / step).max())), endpoint=False)[:, None]
        * (next_corner - corner)
        for corner, next_corner in zip(corners, np.roll(corners, -1, axis=0), strict=True)
    ]
    return np.vstack([lattice[inside(corners, lattice)], *around])
