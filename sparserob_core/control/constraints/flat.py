"""State constraints as families of a semi-infinite program: ``c'x(t) <= h(c)`` for all times of a window, parameters
and disturbances."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import TYPE_CHECKING, final

import numpy as np

from sparserob_core.control.constraints.explanation import TimedExplanation, explanation
from sparserob_core.control.constraints.local_maxima import (
    LEAST_DIVISOR,
    along_spans,
    climb,
    find_kink_neighbours,
    local_maxima,
    step_out,
    vertices,
)
from sparserob_core.control.constraints.state import StateConstraint
from sparserob_core.control.enclosures.cache import remember
from sparserob_core.control.problem.terms.windows import Flat
from sparserob_core.control.reach.enclosure import Bounded, CellEnclosure, enclose, kept, over_legs
from sparserob_core.control.reach.functional import WorstFunctionals
from sparserob_core.control.reach.many_directions import ManyDirections
from sparserob_core.control.reach.over_cells import LEGS_KEPT
from sparserob_core.control.reach.sizes import row_sizes
from sparserob_core.control.reach.support import Leg, Supports
from sparserob_core.control.response.parameters import ParameterIndex
from sparserob_core.control.response.reference import STILL, Direct, MovingReference, Reference
from sparserob_core.control.response.response import OutputResponse, Response
from sparserob_core.control.response.time_grid import distinct_times
from sparserob_core.shapes import Float, Int, shaped
from sparserob_core.sip.convex_set import Array, Box
from sparserob_core.sip.program import Enclosure, Separation

if TYPE_CHECKING:
    from sparserob_core.control.reach.execution import Execution

VERTEX_ACCURACY = 1e-8  # a vertex that is predicted to this accuracy is one
NEARER, LOOKS = 8, 4  # an unsure vertex is predicted from samples so many times nearer, and so often
ARRIVED = 1e-11  # what a vertex that was arrived at may still promise
INSIDE, MAX_INSIDE = 3, 64  # times sampled inside every piece, beside its ends: more where the system moves on it
STENCIL = np.array([-1.0, 0.0, 1.0])
MAX_SPACING_NORM = 0.1  # norm of A times the spacing of samples between which a parabola is a good guide
CLIMBED_CANDIDATES = 10  # largest number of candidates that are climbed from, in parameters, or in time beside a kink
SEPARATED_CONSTRAINTS_PER_ROW = 64  # separated constraints per row and round
# Numbers of the rows that are imposed along the spans of one row, of which there is at least one. On 10 000 pieces four
# controls had 268 rows in the first round where 64 say as much, and took twice the time; on 100 000 eight for each row
# took half as long again as one.
SPANNED = 2**19
# Pieces from which maxima well below 0 are told as they were sampled. With a tenth of them ordinary runs tell less;
# with ten times as many every round of a long one refines thousands.
SAMPLED_ONLY_PIECES = 1000
FOUND_KEPT = 1  # decisions whose separation is remembered


@final
@dataclass(frozen=True, eq=False)
class Samples:
    """Data of ``H x(t) <= h`` in a window that do not depend on the initial state.

    They are sampled times and parameters, and the margins that the worst disturbance leaves there. ``H`` is ``(r, d)``,
    ``h`` is ``(r,)``.
    """

    functionals: WorstFunctionals
    H: Array
    h: Array
    window: tuple[float, float]
    parameters: ParameterIndex
    reference: Reference = STILL
    gains: Array | None = None
    undivided: tuple[Samples, Array] | None = None
    """Samples of the undivided rows, and the divisors ``(r,)`` of the rows."""
    _supports: dict[bytes, list[Supports | None]] = field(default_factory=dict, repr=False)

    def serve(self, constraint: FlatConstraint) -> bool:
        """Return whether the samples belong to the constraint, whatever its initial state."""
        functionals, other_functionals = self.functionals, constraint.functionals
        return (
            functionals.response.propagator is other_functionals.response.propagator
            and functionals.dictionary is other_functionals.dictionary
            and functionals.disturbance is other_functionals.disturbance
            and functionals.initial is other_functionals.initial
            and self.H is constraint.H
            and self.h is constraint.h
            and self.window == (constraint.start, constraint.stop)
            and self.parameters is constraint.parameters
            and self.reference is constraint.reference
            and self.gains is constraint.gains
        )

    @cached_property
    def proven(self) -> int:
        """Number of rows that are to be proven. A mixed constraint has every row twice, for both values of a control
        that jumps; its first half counts."""
        return self.h.size if self.gains is None else self.h.size // 2

    @cached_property
    def cuts(self) -> Array:
        """Times inside the window at which anything turns or jumps: breakpoints of the grid, kinks of a reference,
        where the commanded control of a mixed constraint changes, and where a system that changes with time is another
        polynomial of it."""
        start, stop = self.window
        sources = [self._response.propagator.marks, self.reference.times]
        sources += [] if self.gains is None else [self.functionals.dictionary.breakpoints]
        times = np.concatenate(sources)
        return np.unique(times[(times > start) & (times < stop)])

    @cached_property
    def times(self) -> Array:
        """Sampled times: the window's ends, the breakpoints in it, and a few times in every piece, increasing."""
        if self.undivided is not None:
            return self.undivided[0].times
        grid, (start, stop) = self._response.grid, self.window
        pace = float(np.linalg.norm(self._response.steps(self.lattice[0]).A, axis=(2, 3)).max())
        counts = np.clip(np.ceil(pace * grid.lengths / MAX_SPACING_NORM), INSIDE + 1, MAX_INSIDE).astype(int)
        sample_numbers = np.arange(counts.sum()) - np.repeat(np.cumsum(counts) - counts, counts)
        inside = np.repeat(grid.breakpoints[:-1], counts) + sample_numbers * np.repeat(grid.lengths / counts, counts)
        inside = np.concatenate([inside[(inside > start) & (inside < stop)], self.cuts])
        return self.apart(np.concatenate([[start], inside, [stop]]))

    def apart(self, times: Array) -> Array:
        """Return the times in increasing order, those closer than rounding as one; not where a control may jump
        between."""
        horizon = float(self._response.grid.breakpoints[-1])
        return np.unique(times) if self.gains is not None else distinct_times(times, horizon)

    @cached_property
    def lattice(self) -> tuple[Array, tuple[int, ...]]:
        """Sampled parameters ``(v, nu)`` and the shape of their lattice."""
        return self.parameters.lattice()

    @cached_property
    def margins(self) -> Array:
        """``h - sigma`` on the lattice, ``(v, r, times)``: what the worst disturbance leaves of every side."""
        if self.undivided is not None:
            return self.undivided[0].margins / self.undivided[1][None, :, None]
        points, _ = self.lattice
        if not self.functionals.disturbed:
            return np.broadcast_to(self.h[None, :, None], (points.shape[0], self.h.size, self.times.size))
        H, copies = self.H[: self.proven], self.h.size // max(1, self.proven)
        sigma = np.stack([ManyDirections(self.functionals).profile(self.times, H, p).T for p in points])
        return self.h[None, :, None] - np.tile(sigma, (1, copies, 1))

    @cached_property
    def outputs(self) -> OutputResponse:
        """``H x`` at the sampled times and parameters, once for rows that are equal or opposite. The states themselves
        where there are fewer of them than rows."""
        rows = np.eye(self.H.shape[1]) if self._has_fewer_states else self.H[self._distinct_rows[0]]
        return OutputResponse(self._response.propagator, rows, self.times, self.lattice[0])

    def along(self, response: Response, control: Array) -> Array:
        """Return ``H x (v, r, times)`` from the initial state of a response, under a control ``(m, K)``."""
        if self.undivided is not None:
            return self.undivided[0].along(response, control) / self.undivided[1][None, :, None]
        outputs, (_, inverse, signs) = self.outputs.at(response, control), self._distinct_rows
        return np.asarray(self.H @ outputs if self._has_fewer_states else outputs[:, inverse] * signs[:, None])

    @property
    def _has_fewer_states(self) -> bool:
        return bool(self._distinct_rows[0].size > self.H.shape[1])

    @cached_property
    def _distinct_rows(self) -> tuple[np.ndarray, np.ndarray, Array]:
        """The rows of ``H`` without copies and opposites, which of them every row is, and with which sign."""
        signs = np.where(self.H[np.arange(self.h.size), np.abs(self.H).argmax(axis=1)] < 0.0, -1.0, 1.0)
        _, first, inverse = np.unique(self.H * signs[:, None], axis=0, return_index=True, return_inverse=True)
        return first, inverse.reshape(-1), signs * signs[first[inverse.reshape(-1)]]

    @shaped
    def support_over(
        self, legs: Sequence[Leg], low: Float[Array, " nu"], high: Float[Array, " nu"]
    ) -> list[Supports | None]:
        """Return the support functions of the uncertainty over a cell of parameters, one for each segment of time in
        ``legs``; results are kept."""
        key = low.tobytes() + high.tobytes()
        if key not in self._supports:
            supports = [self.functionals.over_cells.support(leg, self.H[: self.proven]) for leg in legs]
            remember(self._supports, key, supports, LEGS_KEPT)
        return self._supports[key]

    @property
    def _response(self) -> Response:
        return self.functionals.response


@final
@dataclass(frozen=True, eq=False)
class FlatConstraint(StateConstraint):
    """``H (x(t) - r(t)) + G u(t) <= h`` for all ``t`` in ``[start, stop]``, ``p`` and ``w``; the index is ``(t, p)``.

    ``H (r, d)``, ``h (r,)``; ``reference``: ``r``, of a set that moves; ``gains (r, m)``: ``G``, of a mixed constraint,
    whose rows are there twice (`of`): the second half looks at the control that follows a jump. A terminal
    constraint is the window ``[T, T]``.
    """

    name: str
    functionals: WorstFunctionals
    H: Array
    h: Array
    start: float
    stop: float
    parameters: ParameterIndex
    shared: Samples | None = field(default=None, repr=False)
    reference: Reference = STILL
    gains: Array | None = None

    @staticmethod
    def of(
        name: str,
        functionals: WorstFunctionals,
        rows: Flat,
        window: tuple[float, float],
        parameters: ParameterIndex,
        reference: Reference = STILL,
    ) -> FlatConstraint:
        """Return the constraint of the given rows; mixed rows are taken twice, for the control before and after a
        jump."""
        H, G, h = rows
        if G is not None:
            H, G, h = np.vstack([H, H]), np.vstack([G, G]), np.tile(h, 2)
        return FlatConstraint(name, functionals, H, h, *window, parameters, reference=reference, gains=G)

    @cached_property
    def samples(self) -> Samples:
        """Data that do not depend on the initial state; the ``shared`` ones where they belong to this constraint."""
        if self.shared is not None and self.shared.serve(self):
            return self.shared
        window = (self.start, self.stop)
        return Samples(self.functionals, self.H, self.h, window, self.parameters, self.reference, self.gains)

    @property
    @shaped
    def sides(self) -> tuple[Float[Array, "r d"], Float[Array, " r"]]:
        """``H``, ``h``."""
        return self.H, self.h

    @cached_property
    def index_set(self) -> Box:
        if not self.parameters.count:
            return Box(np.array([self.start]), np.array([self.stop]))
        box = self.parameters.box
        return Box(np.concatenate([[self.start], box.lower]), np.concatenate([[self.stop], box.upper]))

    @shaped
    def divided(self, units: Float[Array, " r"]) -> FlatConstraint:
        gains = None if self.gains is None else self.gains / units[:, None]
        return replace(self, H=self.H / units[:, None], h=self.h / units, gains=gains, shared=None)

    @shaped
    def looked_at_in(self, units: Float[Array, " r"]) -> FlatConstraint:
        constraint, samples = self.divided(units), self.samples
        return replace(
            constraint,
            shared=replace(samples, H=constraint.H, h=constraint.h, gains=constraint.gains, undivided=(samples, units)),
        )

    @shaped
    def functionals_at(
        self, indices: Float[Array, "k j"]
    ) -> tuple[Float[Array, " n"], Float[Array, "n d"], Float[Array, "n nu"], Float[Array, " n"]]:
        parameters = np.repeat(self.parameters.clamp(indices[:, 1:]), self.h.size, axis=0)
        count, rhs = indices.shape[0], self.h[None] - self.compute_reference_terms(indices[:, 0])
        H = self.H if count == 1 else np.tile(self.H, (count, 1))
        return np.repeat(indices[:, 0], self.h.size), H, parameters, rhs.ravel()

    @shaped
    def violations(
        self, x: Float[Array, " n"], indices: Float[Array, "k j"], rows: Int[np.ndarray, " k"]
    ) -> Float[Array, " k"]:
        parameters = self.parameters.clamp(indices[:, 1:])
        answer: Array = self.functionals.values(x, indices[:, 0], self.H[rows], parameters) - self.h[rows]
        if not self.reference.moves and self.gains is None:
            return answer
        answer += self.compute_added_terms(x, indices[:, 0])[np.arange(rows.size), rows]
        return answer

    @shaped
    def compute_added_terms(self, x: Float[Array, " n"], times: Float[Array, " k"]) -> Float[Array, "k r"]:
        additions = self.compute_reference_terms(times)
        if self.gains is not None:
            control = self.functionals.control(x)[:, self.commanded(times)]
            additions = additions + np.einsum("rm,mkr->kr", self.gains, control)
        return additions

    @shaped
    def direct(self, times: Float[Array, " k"]) -> Float[Array, "q n"] | None:
        if self.gains is None:
            return None
        values = self.functionals.dictionary.at(self.commanded(times))
        rows = np.einsum("rm,nkr->krmn", self.gains, values).reshape(times.size * self.h.size, -1)
        return np.pad(rows, ((0, 0), (0, self.functionals.variables - rows.shape[1])))

    @shaped
    def compute_reference_terms(self, times: Float[Array, " k"]) -> Float[Array, "k r"]:
        """Return ``-H r(t)``."""
        return MovingReference(self.reference, self.H).at(times)

    @shaped
    def commanded(self, times: Float[Array, " k"]) -> Int[np.ndarray, "k r"]:
        """Return the piece of the control's dictionary that every row looks at. For the first half of the rows it is
        the piece that a time ends or is in, for the second half the piece that it begins or is in. Only pieces that
        meet the window in positive length count."""
        ends = self.functionals.dictionary.breakpoints
        first, last = np.searchsorted(ends, self.start, side="right") - 1, np.searchsorted(ends, self.stop) - 1
        pieces = np.stack([np.searchsorted(ends, times, side=side) - 1 for side in ("left", "right")], axis=1)
        return np.repeat(np.clip(pieces, first, last), self.h.size // 2, axis=1)

    @shaped
    def worst(self, x: Float[Array, " n"]) -> Separation:
        """Return the largest local maxima of the violation over the index set, times refined between the nodes,
        parameters between lattice points; remembered, since the proof asks for them again."""
        key = x.tobytes()
        return (
            self._separations[key]
            if key in self._separations
            else remember(self._separations, key, self._compute_separation(x), FOUND_KEPT)
        )

    @shaped
    def _compute_separation(self, x: Float[Array, " n"]) -> Separation:
        values = self.on_lattice(x)
        positions = local_maxima(values, self.lattice[1], SEPARATED_CONSTRAINTS_PER_ROW)
        spans = max(1, min(SEPARATED_CONSTRAINTS_PER_ROW, SPANNED // x.size))
        positions = np.concatenate(
            [
                positions,
                along_spans(values, positions, self.pieces, spans),
                find_kink_neighbours(values, self.times, self.kinks, SEPARATED_CONSTRAINTS_PER_ROW),
            ]
        )
        heights, rows = values[tuple(positions.T)], positions[:, 1]
        indices = np.hstack([self.times[positions[:, 2], None], self.lattice[0][positions[:, 0]]])
        violations = heights
        times, predicted = vertices(values, positions, self.times)
        between = np.flatnonzero(times != indices[:, 0])  # the others are samples
        if self.parameters.count or self.functionals.response.grid.pieces >= SAMPLED_ONLY_PIECES:
            # among many samples, those well below 0 are only told
            promised = heights + 4.0 * (predicted - heights)
            between = between[promised[between] >= min(0.0, heights.max(initial=-np.inf))]
        if between.size:
            at = np.hstack([times[between, None], indices[between, 1:]])
            refined = self._refine_times(x, at, rows[between], predicted[between], violations)
            higher = refined[1] >= violations[between]  # at a kink a parabola is no guide
            between = between[higher]
            indices[between, 0], violations[between] = (array[higher] for array in refined)
        if self.parameters.count:
            likely = np.argsort(-violations, kind="stable")[:CLIMBED_CANDIDATES]
            # a maximum at a breakpoint is a kink: it is climbed along, not across
            indices[likely], violations[likely] = self._climb_candidates(x, indices[likely], rows[likely])
        order = np.argsort(-violations, kind="stable")
        if self.gains is not None:  # where nothing jumps, both halves of the rows say the same
            pieces = self.commanded(indices[order, 0])
            order = order[(rows[order] < self.samples.proven) | (pieces[:, 0] != pieces[:, -1])]
        return Separation(indices[order], rows[order], violations[order])

    @cached_property
    def kinks(self) -> np.ndarray:
        """Positions of the sampled times at which anything bends or jumps, and of the ends of the window."""
        return np.flatnonzero(np.isin(self.times, np.concatenate([[self.start], self.samples.cuts, [self.stop]])))

    @shaped
    def explain(self, index: Float[Array, " j"], row: int) -> TimedExplanation:
        time, parameter = float(index[0]), self.parameters.clamp(index[None, 1:])[0]
        allowed = self.h - self.compute_reference_terms(index[:1])[0]
        if self.gains is None:
            return explanation(self.name, self.functionals, self.H, allowed, row, time, parameter)
        mixed = (self.gains, int(self.commanded(index[:1])[0, row]))
        return explanation(self.name, self.functionals, self.H, allowed, row, time, parameter, mixed=mixed)

    @property
    @shaped
    def sized_rows(self) -> tuple[Float[Array, "q d"], Float[Array, " q"]]:
        normals = self.H if self.gains is None else np.hstack([self.H, self.gains])
        return self.H, row_sizes(normals, self.h)

    def nominal(self) -> FlatConstraint:
        return replace(self, functionals=self.functionals.nominal(), parameters=ParameterIndex(None), shared=None)

    @shaped
    def from_state(self, initial_state: Float[Array, " d"]) -> FlatConstraint:
        return replace(self, functionals=self.functionals.from_state(initial_state), shared=self.samples)

    @shaped
    def directions(
        self, z: Float[Array, "k b"], rows: Int[np.ndarray, " k"]
    ) -> tuple[Float[Array, "k e d"], Float[Array, "k e"]]:
        return self.H[rows][:, None], np.ones((rows.size, 1))

    @shaped
    def outwardness(
        self, states: Float[Array, "d n"], added_terms: Float[Array, " r"] | None = None
    ) -> Float[Array, " n"]:
        allowed = self.h if added_terms is None else self.h - added_terms
        return np.asarray((self.H @ states - allowed[:, None]).max(axis=0))

    @property
    @shaped
    def cells(self) -> tuple[Float[Array, "k j"], Float[Array, "k j"]]:
        """The window cut wherever anything turns or jumps, times the box of parameters, or each of its parts: ``(lower,
        upper)``, ``(k, 1 + nu)`` each."""
        points = self.samples.apart(np.concatenate([[self.start], self.samples.cuts, [self.stop]]))
        starts, stops = (points[:-1], points[1:]) if points.size > 1 else (points, points)
        box, laws = self.index_set, self.functionals.response.propagator.laws
        lower = np.hstack([starts[:, None], np.tile(box.lower[1:], (starts.size, 1))])
        upper = np.hstack([stops[:, None], np.tile(box.upper[1:], (starts.size, 1))])
        return (lower, upper) if laws is None else laws.cut(lower, upper)

    @shaped
    def enclosure(self, x: Float[Array, " n"], lower: Float[Array, "k j"], upper: Float[Array, "k j"]) -> Enclosure:
        """Return proven upper bounds of the violation on cells ``(k, 1 + nu)``, each within one piece; cells of
        parameters share their work."""
        touched = self.parameters.touches(lower[:, 1:], upper[:, 1:])
        return enclose(lower, upper, touched, self.parameters.count, lambda low, high: self._enclose_cell(x, low, high))

    @shaped
    def _enclose_cell(self, x: Float[Array, " n"], low: Float[Array, " j"], high: Float[Array, " j"]) -> Bounded:
        key = x.tobytes() + low.tobytes() + high.tobytes()
        if key not in self._cell_enclosures:
            legs = self.functionals.over_cells.legs(low, high)
            control, cuts = self.functionals.control(x), self.parameters.cuts(low, high)
            rows = self.samples.proven
            rhs, H = np.zeros((rows, legs[0].space.size)), self.H[:rows]
            rhs[:, 0] = self.h[:rows]
            moving = MovingReference(self.reference, H) if self.reference.moves else None
            direct = None if self.gains is None else Direct(self.gains[:rows], self.functionals.dictionary, control)
            supports = self.samples.support_over(legs, low, high)
            pairs = zip(supports, legs, strict=True)
            over_cells = self.functionals.over_cells
            delivered = iter([over_cells.with_execution(support, control, H, leg) for support, leg in pairs])
            bounded = over_legs(
                legs,
                lambda leg: CellEnclosure(
                    leg, next(delivered), H, rhs, control, cuts=cuts, moving=moving, direct=direct
                ),
            )
            remember(self._cell_enclosures, key, bounded, kept(control))
        return self._cell_enclosures[key]

    @cached_property
    def _cell_enclosures(self) -> dict[bytes, Bounded]:
        return {}

    @cached_property
    def _separations(self) -> dict[bytes, Separation]:
        return {}

    @property
    def times(self) -> Array:
        """Sampled times of the window, increasing."""
        return self.samples.times

    @cached_property
    def pieces(self) -> np.ndarray:
        """The numbers ``(times,)`` of the control's pieces that the sampled times end or are in."""
        return np.searchsorted(self.functionals.dictionary.breakpoints, self.times)

    @property
    def lattice(self) -> tuple[Array, tuple[int, ...]]:
        """Sampled parameters ``(v, nu)`` and the shape of their lattice."""
        return self.samples.lattice

    @shaped
    def on_lattice(self, x: Float[Array, " n"]) -> Float[Array, "v r t"]:
        """Return violations ``(v, r, times)`` at every lattice point and sampled time."""
        along = self.samples.along(self.functionals.response, self.functionals.control(x))
        answer: Array = along - self.samples.margins
        if self.functionals.execution is not None:
            answer = answer + self._compute_execution_errors(self.functionals.execution, x)
        has_additions = self.reference.moves or self.gains is not None
        return answer + self.compute_added_terms(x, self.times).T if has_additions else answer

    def _compute_execution_errors(self, execution: Execution, x: Array) -> Array:
        """Return the contribution of the worst errors of execution to all rows at every lattice point and sampled time,
        ``(v, r, times)``."""
        rows, copies = self.H[: self.samples.proven], self.h.size // max(1, self.samples.proven)
        (points, _), k, r = self.lattice, self.times.size, rows.shape[0]
        v = len(points)
        along = execution.extend_directions(np.tile(rows, (v * k, 1)), np.repeat(points, k * r, axis=0))
        contributions = execution.sampled(self.functionals.control(x), np.tile(np.repeat(self.times, r), v), along)
        return np.tile(contributions.reshape(v, k, r).swapaxes(1, 2), (1, copies, 1))

    @shaped
    def _refine_times(
        self,
        x: Float[Array, " n"],
        indices: Float[Array, "k j"],
        rows: Int[np.ndarray, " k"],
        predicted: Float[Array, " k"],
        heights: Float[Array, " q"],
    ) -> tuple[Float[Array, " k"], Float[Array, " k"]]:
        """Return times ``(k,)`` near the vertices of parabolas, and the violations there with the parameters of
        ``indices``. They are found by parabolas through nearer and nearer samples, as long as one may be the largest of
        all, or a violation. Where parabolas are no guide, at a kink or beyond one, the candidate is climbed from.
        ``predicted (k,)``, ``heights (q,)``: what the first parabolas say, and what is known at samples."""
        spacing = float((self.times[1:] - self.times[:-1]).max())
        middle, violations, live = indices[:, 0].copy(), predicted.copy(), np.arange(rows.size)
        width = np.full(rows.size, min(spacing / NEARER, (self.stop - self.start) / 2))
        for look in range(LOOKS):
            steps = width[live]
            at = np.minimum(np.maximum(middle[live], self.start + steps), self.stop - steps)
            neighbours = indices[live].repeat(3, axis=0)
            neighbours[:, 0] = (at[:, None] + steps[:, None] * STENCIL).ravel()
            samples = self.violations(x, neighbours, rows[live].repeat(3)).reshape(-1, 3)
            before, now, after = samples.T
            slope, curvature = (after - before) / 2, 2 * now - before - after
            is_inside = np.abs(slope) < curvature
            share = slope / np.where(is_inside, curvature, np.maximum(np.abs(slope), LEAST_DIVISOR))
            error, size = np.abs(violations[live] - now), np.maximum(1.0, np.abs(now))
            is_sure = is_inside & (share * slope <= 2 * ARRIVED * size)
            if look == 0:
                is_sure |= error <= VERTEX_ACCURACY * size
            middle[live], violations[live] = at, now
            highest = max(float(violations.max()), float(heights.max()))
            is_relevant = now + 4.0 * np.maximum(error, np.abs(slope)) >= min(0.0, highest)
            is_unfinished = ~is_sure & is_relevant
            if not is_unfinished.any():
                live = live[is_unfinished]
                break
            middle[live] = np.where(is_unfinished, at + steps * share, at)
            width[live] = np.where(is_inside, steps / NEARER, steps)
            live = live[is_unfinished]
        kinks = live[np.argsort(-violations[live], kind="stable")][:CLIMBED_CANDIDATES]
        if kinks.size and not self.parameters.count:
            points, violations[kinks] = self._climb_candidates(x, indices[kinks], rows[kinks])
            middle[kinks] = points[:, 0]
        return middle, violations

    @shaped
    def _climb_candidates(
        self, x: Float[Array, " n"], indices: Float[Array, "k j"], rows: Int[np.ndarray, " k"]
    ) -> tuple[Float[Array, "k j"], Float[Array, " k"]]:
        """Climb from every candidate ``(t, p)``; the set of parameters is never left."""
        box = self.index_set
        radius = np.concatenate([[np.max(np.diff(self.times), initial=0.0)], (box.upper - box.lower)[1:] / 4])

        def project(points: Array) -> Array:
            inside = np.clip(points, box.lower, box.upper)
            return np.hstack([inside[:, :1], self.parameters.clamp(inside[:, 1:])])

        def evaluate(points: Array, which: np.ndarray) -> Array:
            return self.violations(x, points, rows[which])

        points, violations = climb(evaluate, indices, radius, project)
        bound = self.parameters.set
        if bound is None or bound.is_box:
            return points, violations
        stepped, higher = step_out(evaluate, points, violations, bound)
        improved = np.flatnonzero(higher > violations)
        points[improved], violations[improved] = climb(
            lambda at, which: evaluate(at, improved[which]), stepped[improved], radius / 16, project
        )
        return points, violations
