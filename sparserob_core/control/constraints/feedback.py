"""State and control constraints under feedback, as families whose rows must hold for every deviation."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Protocol, final

import numpy as np

from sparserob_core.control.combinations import refusal
from sparserob_core.control.constraints.control import Places
from sparserob_core.control.constraints.explanation import ConstraintSource, TimedExplanation, combination
from sparserob_core.control.constraints.flat import FlatConstraint
from sparserob_core.control.constraints.local_maxima import local_maxima
from sparserob_core.control.constraints.state import StateConstraint
from sparserob_core.control.feedback.closed_loop import ROUND_OFF, ClosedLoop
from sparserob_core.control.feedback.loop_bounds import LoopBounds
from sparserob_core.control.feedback.loop_rows import LoopRows, shared
from sparserob_core.control.problem.names import unit_of_row
from sparserob_core.control.problem.units import Units
from sparserob_core.control.reach.sizes import row_sizes
from sparserob_core.sip.convex_set import Array, Box
from sparserob_core.sip.finite import UncertainRows
from sparserob_core.sip.program import ConstraintFamily, Enclosure, Explanation, Separation

SEPARATED_TIMES_PER_ROW = 64  # separated times for each row and round
ZOOMED, ZOOMS, CLOSER = 9, 14, 4.0  # samples around a maximum, and how often they are drawn so many times closer
NEAR, FEW = 1e-3, 4  # maxima that are so near to their limit are refined, and so many in any case
HALVINGS, HALVED = 14, 200  # how often samples are drawn closer, and how many intervals at a time
HIDDEN, SHARE = 2e-10, 0.2  # a violation that samples may miss; the share of the largest that they may
FIRST_TIMES = 20  # times of a window that a method begins with
STATES = 60_000_000  # numbers in the states that are sampled at once
NEGLIGIBLE_COEFFICIENT = 1e-14  # of the largest coefficient, one that is rounding
DEPENDENT_EQUATION_SHARE = 1e-12  # of the largest one, a singular value of equations that depend on one another


def not_linear(indices: Array) -> tuple[Array, Array]:
    """Raise `InputError`: the family has no rows that are linear in the decision."""
    raise refusal("affine", "plain rows")


class Uncertain(Protocol):
    """A constraint that must hold for every deviation."""

    @property
    def name(self) -> str:
        """Name of the constraint."""

    @property
    def loop(self) -> ClosedLoop:
        """Closed loop of the constraint."""

    @property
    def measured(self) -> tuple[str, ...]:
        """The unit of every row, empty where it has none that is known."""

    def excess(self, x: Array, indices: Array) -> Array:
        """Return violations ``(k, r)`` at indices, under the worst deviations."""

    def uncertain(self, index: Array) -> UncertainRows:
        """Return the rows at one index."""

    def worst(self, x: Array) -> Separation:
        """Return the largest violations."""

    def enclosure(self, x: Array, lower: Array, upper: Array) -> Enclosure:
        """Return proven bounds on cells."""

    @property
    def cells(self) -> tuple[Array, Array]:
        """Cells of the index with which a proof begins."""

    def explain(self, index: Array, row: int) -> Explanation:
        """Return the description of one constraint for a reader, for every disturbance, or at the deviations that the
        index holds."""


def build_family(constraint: Uncertain, index_set: Box, start: Array, source: ConstraintSource) -> ConstraintFamily:
    """Return a constraint as a family; in its literal form, deviations are part of the index."""
    family = ConstraintFamily(
        name=constraint.name,
        index_set=index_set,
        rows=not_linear,
        scale=source.scale,
        excess=constraint.excess,
        uncertain=constraint.uncertain,
        start=start,
        worst=constraint.worst,
        enclosure=constraint.enclosure,
        cells=constraint.cells,
        explain=constraint.explain,
        measured=constraint.measured,
        along=constraint.loop.functionals.names.time,
        source=source,
    )
    radii = constraint.loop.spread.radii
    box = Box(np.concatenate([index_set.lower, -radii]), np.concatenate([index_set.upper, radii]))
    literal = replace(
        family,
        index_set=box,
        formulation="literal",
        reduced=family,
        worst=None,
        excess=None,
    )
    return replace(family, literal=literal)


@final
@dataclass(frozen=True, eq=False)
class FeedbackConstraint(ConstraintSource):
    """``H (x(t) - r(t)) + G u(t) <= h`` for all times of a window and every disturbance, with the control that it
    causes; the index is ``(t,)``, or with the deviations of the disturbance ``(t, w)``. ``flat``: the same constraint
    without feedback, which has every row of a mixed constraint twice, for both values of a control that jumps."""

    flat: FlatConstraint
    loop: ClosedLoop
    exact: bool = False
    """True for an equality, whose second half of rows are the opposites of the first half."""

    @staticmethod
    def of(constraint: StateConstraint, loop: ClosedLoop) -> FeedbackConstraint:
        """Return a constraint on the state under feedback; its set has flat sides, since others are refused."""
        assert isinstance(constraint, FlatConstraint)
        return FeedbackConstraint(constraint, loop)

    @property
    def name(self) -> str:
        """The name of the constraint."""
        return self.flat.name

    @property
    def measured(self) -> tuple[str, ...]:
        """The unit of every row, empty where it has none that is known."""
        return self.flat.measured

    def normals_in(self, units: Units) -> tuple[Array, Array]:
        """Return the normals of the rows, and the units of their coordinates, which are the same as without
        feedback."""
        return self.flat.normals_in(units)

    def scale(self, x: Array) -> float:
        rows, sizes = self.flat.sized_rows
        small = sizes < 1.0
        if self.flat.gains is not None or not (small.any() or self.exact):
            return self.flat.scale(x)
        row_sizes = np.maximum(sizes, self.loop.sizes(x, rows))[small | self.exact]
        least = float(row_sizes[row_sizes > 0.0].min(initial=np.inf))  # a row of a state that rests at 0 is met exactly
        return least if self.exact and np.isfinite(least) else min(1.0, least)

    @property
    def of_state(self) -> FlatConstraint:
        """Constraint without feedback."""
        return self.flat

    def family(self) -> ConstraintFamily:
        """Return the constraint as a family."""
        start, stop = self.flat.start, self.flat.stop
        positions = np.unique(
            np.linspace(0, self.times.size - 1, min(FIRST_TIMES, self.times.size)).round().astype(int)
        )
        source = self if self.exact else self.flat
        family = build_family(self, Box(np.array([start]), np.array([stop])), self.times[positions][:, None], source)
        family = replace(family, scale=self.scale)
        return replace(family, scaled=self.scaled) if self.loop.scales else family

    def scaled(self, factor: float) -> ConstraintFamily:
        """Return the family of the same constraint with all deviations multiplied by ``factor``."""
        return replace(self, loop=self.loop.scaled(factor)).family()

    @cached_property
    def times(self) -> Array:
        """The ends of the window, and the breakpoints in it."""
        return np.unique(np.concatenate([self.flat.cells[0][:, 0], self.flat.cells[1][:, 0]]))

    def excess(self, x: Array, indices: Array) -> Array:
        """Return violations ``(k, r)`` at times ``(k, 1)`` under the worst disturbances."""
        return np.asarray(self.loop.height(self._compute_left_sides(x, indices[:, 0])) - self.flat.h)

    def _compute_left_sides(self, x: Array, times: Array) -> Array:
        """Return the left-hand sides at times ``(k,)`` and their responses to the deviations, ``(k, r, 1 + Q)``."""
        flat = self.flat
        values = flat.H @ self.loop.states(x, times)
        values[:, :, 0] += flat.compute_reference_terms(times)
        if flat.gains is not None:
            values += np.einsum("rm,krmq->krq", flat.gains, self.loop.controls(x)[flat.commanded(times)])
        return np.asarray(values)

    def uncertain(self, index: Array) -> UncertainRows:
        """Return the rows at one time."""
        flat, time = self.flat, index[:1]
        allowed = flat.h - flat.compute_reference_terms(time)[0]
        if flat.gains is None:
            rows = LoopRows(self.loop).of_state(float(time[0]), flat.H, allowed, *self._row_parts)
            # what cannot deviate need not be answered
            return replace(rows, exact=True, d=rows.d * (self.loop.spread.radii > 0.0)) if self.exact else rows
        pieces, (part, factor) = flat.commanded(time)[0], self._row_parts
        if pieces[0] != pieces[-1]:  # the rows of a control that jumps are others before and after
            half = part.size // 2
            part = np.concatenate([part[:half], part[half:] + 1 + part.max()])
        return LoopRows(self.loop).with_control(
            LoopRows(self.loop).of_state(float(time[0]), flat.H, allowed, part, factor), flat.gains, pieces
        )

    def against(self, x: Array, index: Array, row: int) -> tuple[Array, float]:
        """Return a deviation ``(Q,)`` that is the worst at an index, and what the control adds to the row then."""
        time, gains = index[:1], self.flat.gains
        w = self.loop.spread.worst(self._compute_left_sides(x, time)[0, row, 1:])
        if gains is None:
            return w, 0.0
        control = self.loop.controls(x)[int(self.flat.commanded(time)[0, row])]
        return w, float(gains[row] @ (control[:, 0] + control[:, 1:] @ w))

    def met(self, x: Array) -> Array:
        """Return the nearest decision that meets an equality to rounding; one that no control enters is left as it
        is."""
        table, rhs = self.uncertain(np.array([self.flat.stop])).equations
        has_control = abs(table).max(axis=1).toarray().ravel() > NEGLIGIBLE_COEFFICIENT * abs(table).max()
        table, rhs = table[has_control], rhs[has_control]
        square = (table @ table.T).toarray()
        for _ in range(2):
            x = x + table.T @ np.linalg.lstsq(square, rhs - table @ x, rcond=DEPENDENT_EQUATION_SHARE)[0]
        return x

    @cached_property
    def _row_parts(self) -> tuple[np.ndarray, Array]:
        gains = self.flat.gains
        if gains is None:
            return shared(self.flat.H, self.loop.spread)
        half = self.flat.h.size // 2
        part, factor = shared(np.hstack([self.flat.H, gains])[:half], self.loop.spread)
        return np.tile(part, 2), np.tile(factor, 2)

    def worst(self, x: Array) -> Separation:
        """Return the largest local maxima of the violation over the window, refined between the samples."""
        times, values = self._sample_violations(x)
        positions = local_maxima(values.T[None], (1,), SEPARATED_TIMES_PER_ROW)
        rows, at = positions[:, 1], positions[:, 2]
        best, violations = times[at].copy(), values[at, rows].copy()
        width = np.maximum(
            times[np.minimum(at + 1, times.size - 1)] - times[at], times[at] - times[np.maximum(at - 1, 0)]
        )
        likely = np.argsort(-violations, kind="stable")[: 4 * SEPARATED_TIMES_PER_ROW]
        likely = likely[
            (violations[likely] > -NEAR * np.abs(self.flat.h[rows[likely]])) | (np.arange(likely.size) < FEW)
        ]
        best, violations, rows, width = best[likely], violations[likely], rows[likely], width[likely]
        offsets = np.linspace(-1.0, 1.0, ZOOMED)
        for _ in range(ZOOMS if width.any() else 0):
            samples = np.clip(best[:, None] + width[:, None] * offsets, self.flat.start, self.flat.stop)
            heights = self.excess(x, samples.reshape(-1, 1)).reshape(*samples.shape, -1)
            heights = np.take_along_axis(heights, rows[:, None, None], axis=2)[..., 0]
            highest = heights.argmax(axis=1)
            is_higher = heights[np.arange(rows.size), highest] > violations
            best = np.where(is_higher, samples[np.arange(rows.size), highest], best)
            violations = np.where(is_higher, heights[np.arange(rows.size), highest], violations)
            width = width / CLOSER
        order = np.argsort(-violations, kind="stable")
        if self.flat.gains is not None:  # where nothing jumps, both halves of the rows say the same
            pieces = self.flat.commanded(best[order])
            order = order[(rows[order] < self.flat.h.size // 2) | (pieces[:, 0] != pieces[:, -1])]
        return Separation(best[order][:, None], rows[order], violations[order])

    def _sample_violations(self, x: Array) -> tuple[Array, Array]:
        """Return times ``(k,)`` in order and the violations there ``(k, r)``: halfway between two of them again and
        again, where a larger violation can be."""
        times = self.flat.times
        step = max(1, STATES // ((1 + self.loop.spread.size) * self.flat.H.shape[1]))
        values = np.concatenate(
            [self.excess(x, times[first : first + step, None]) for first in range(0, times.size, step)]
        )
        cells = np.arange(times.size - 1)
        for _ in range(HALVINGS):
            lower, upper = times[cells], times[cells + 1]
            bounds = self.enclosure(x, lower[:, None], upper[:, None]).bounds
            ends = np.maximum(values[cells], values[cells + 1]).max(axis=1)
            is_hidden = (bounds > HIDDEN) & (bounds - ends > SHARE * np.maximum(bounds, ends.max(initial=0.0)))
            if not is_hidden.any():
                break
            split = cells[is_hidden][np.argsort(-bounds[is_hidden], kind="stable")[:HALVED]]
            split.sort()
            between = (times[split] + times[split + 1]) / 2
            times = np.insert(times, split + 1, between)
            values = np.insert(values, split + 1, self.excess(x, between[:, None]), axis=0)
            left_cells = split + np.arange(split.size)
            cells = np.sort(np.concatenate([left_cells, left_cells + 1]))
        return times, values

    @property
    def cells(self) -> tuple[Array, Array]:
        """The window cut at the breakpoints."""
        return self.flat.cells

    def enclosure(self, x: Array, lower: Array, upper: Array) -> Enclosure:
        """Return proven upper bounds of the violation on cells of time, each within one piece, with the control of
        that."""
        flat, ends = self.flat, (lower[:, 0], upper[:, 0])
        proven = flat.h.size if flat.gains is None else flat.h.size // 2
        additions = [flat.compute_reference_terms(times)[:, :proven, None] for times in ends]
        if flat.gains is not None:
            acting = flat.commanded((ends[0] + ends[1]) / 2)[:, 0]
            control_terms = flat.gains[:proven] @ self.loop.controls(x)[acting]
            additions = [
                np.concatenate([addition + control_terms[..., :1], control_terms[..., 1:]], axis=-1)
                for addition in additions
            ]
        bounds, chord_distances = LoopBounds(self.loop).over_cells(
            x, *ends, flat.H[:proven], (additions[0], additions[1])
        )
        excess, cells = bounds - flat.h[:proven], np.arange(bounds.shape[0])
        worst = excess.argmax(axis=1)
        return Enclosure(excess[cells, worst], np.zeros_like(cells), chord_distances[cells, worst])

    def explain(self, index: Array, row: int) -> Explanation:
        """Return the description of one constraint for a reader, for every disturbance, or at the deviations that the
        index holds."""
        description = describe_deviations(self.flat.explain(index[:1], row), self.loop, index[1:])
        if not self._unanswered_rows[row]:
            return description
        last = float(self.loop.functionals.dictionary.breakpoints[-2])
        at = f"{last:.6g} {self.loop.functionals.names.time}".rstrip()
        text = f"{description.text} (what comes after the last measurement, at {at}, reaches it unanswered)"
        return replace(description, text=text)

    @cached_property
    def _unanswered_rows(self) -> np.ndarray:
        """The rows ``(r,)`` of an equality that deviations reach which no control answers."""
        if not self.exact:
            return np.zeros(self.flat.h.size, dtype=bool)
        rows = self.uncertain(np.array([self.flat.stop]))
        size = np.abs(rows.d) * self.loop.spread.radii
        bare = np.array([np.diff(C.indptr) == 0 for C in rows.C])
        return np.asarray((bare & (size > DEPENDENT_EQUATION_SHARE * np.abs(self.flat.H).max())).any(axis=1)[rows.part])


def acting(loop: ClosedLoop, places: Places, x: Array) -> tuple[Array, Array]:
    """Return the control at ``places`` and its responses to the deviations, ``(q, m, 1 + Q)``, and the sizes of the
    numbers that were added up.

    Across the seam, the first control of the next period responds to the initial state of that period.
    """
    controls = loop.controls(x)
    pieces, table = len(controls), places.table.T
    values = (table @ controls.reshape(pieces, -1)).reshape(-1, *controls.shape[1:])
    sizes = (abs(table) @ np.abs(controls).reshape(pieces, -1)).reshape(values.shape)
    if places.seam:  # of a single piece too, whose value and the next are no difference of the table
        first, at = controls[0], loop.begins.shape[0] * loop.anew
        first = np.concatenate([first[:, :1], np.roll(first[:, 1:], -at, axis=1)], axis=1)
        values[-1], sizes[-1] = first - controls[-1], np.abs(first) + np.abs(controls[-1])
    values[:, :, 0] += places.offset
    sizes[:, :, 0] += np.abs(places.offset)
    return values, sizes


def rows_at(
    loop: ClosedLoop, places: Places, place: int, H: Array, h: Array, extra: Array | None = None
) -> UncertainRows:
    """Return the rows ``H a <= h`` on the value or change ``a`` of the control at one place, for every deviation;
    ``extra (r, n)`` is added on the left."""
    column = places.table[:, [place]].tocoo()
    pairs = sorted(zip(column.row.tolist(), column.data.tolist(), strict=True), reverse=True)
    across_seam = places.seam and place == places.starts.size - 1
    if across_seam:
        pairs = [(places.table.shape[0] - 1, -1.0), (0, 1.0)]
    following = across_seam and loop.anew
    (piece, share), *further_pairs = pairs
    rows = LoopRows(loop).of_control(piece, share * H, h - H @ places.offset[place], extra)
    for piece, share in further_pairs:
        rows = LoopRows(loop).with_control(rows, share * H, np.full(h.size, piece), following=following)
    return rows


@final
@dataclass(frozen=True, eq=False)
class FeedbackControl(ConstraintSource):
    """Constraint ``H a <= h`` for every disturbance, on the value ``a`` of the control on every piece or on its change
    at every step.

    With ``bound``, the position of the first of the variables ``p (m, K)``, it is ``H u_k <= p_k`` instead; that of the
    ``nominal`` control, where this says so. An index is the time of a place, or with the deviations ``(t, w)``.
    """

    name: str
    loop: ClosedLoop
    places: Places
    H: Array
    h: Array
    bound: int | None = None
    nominal: bool = False

    def normals_in(self, units: Units) -> tuple[Array, Array]:
        """Return the normals ``H`` of the rows, and the units of the controls."""
        return self.H, units.controls

    def scale(self, x: Array) -> float:
        sizes = row_sizes(self.H, self.h)
        return float(sizes[sizes > 0.0].min(initial=1.0))

    def family(self) -> ConstraintFamily:
        """Return the constraint as a family."""
        index_set = Box(self.places.starts[:1], np.array([self.places.stop]))
        family = build_family(self, index_set, self.places.times[:, None], self)
        family = replace(family, scaled=self.scaled) if self.loop.scales else family
        return family if self.bound is None else replace(family, defines=True)

    def scaled(self, factor: float) -> ConstraintFamily:
        """Return the family of the same constraint with all deviations multiplied by ``factor``."""
        return replace(self, loop=self.loop.scaled(factor)).family()

    def limits(self, x: Array) -> Array:
        """Return the right-hand sides ``(q, r)``."""
        q = self.places.times.size
        if self.bound is None:
            return np.broadcast_to(self.h, (q, self.h.size))
        p = x[self.bound : self.bound + self.H.shape[1] * q].reshape(-1, q)
        return np.asarray((np.abs(self.H) @ p).T, dtype=float)

    def heights(self, x: Array) -> tuple[Array, Array]:
        """Return violations ``(q, r)`` at all places, and the sizes of the numbers that were added up."""
        (values, size), limits = acting(self.loop, self.places, x), self.limits(x)
        radii = np.concatenate([[1.0], self.loop.spread.radii])
        if self.nominal:
            values[:, :, 1:] = size[:, :, 1:] = 0.0
        return self.loop.height(self.H @ values) - limits, np.abs(self.H) @ size @ radii + np.abs(limits)

    def settled(self, x: Array) -> Array:
        """Return the same decision with the peaks at the largest values that they bound, at least 0."""
        assert self.bound is not None
        peaks = np.zeros((self.H.shape[1], self.places.times.size))
        violations = self.heights(np.concatenate([x[: self.bound], peaks.ravel()]))[0]
        for row, channel in enumerate(np.abs(self.H).argmax(axis=1)):
            peaks[channel] = np.maximum(peaks[channel], violations[:, row])
        settled: Array = np.concatenate([x[: self.bound], peaks.ravel(), x[self.bound + peaks.size :]])
        return settled

    def excess(self, x: Array, indices: Array) -> Array:
        """Return violations ``(k, r)`` at the places of times ``(k, 1)`` under the worst disturbances."""
        violations: Array = self.heights(x)[0][self.places.at(indices[:, 0])]
        return violations

    def uncertain(self, index: Array) -> UncertainRows:
        """Return the rows at the place of one time."""
        (place,) = self.places.at(index[:1]).tolist()
        if self.bound is None:
            return rows_at(self.loop, self.places, place, self.H, self.h)
        K, extra = self.places.times.size, np.zeros((self.h.size, self.loop.variables))
        for row, channel in enumerate(np.abs(self.H).argmax(axis=1)):
            extra[row, self.bound + channel * K + place] = -np.abs(self.H[row, channel])
        rows = rows_at(self.loop, self.places, place, self.H, self.h, extra)
        return replace(rows, C=tuple(0.0 * C for C in rows.C), d=0.0 * rows.d) if self.nominal else rows

    def worst(self, x: Array) -> Separation:
        """Return the worst row of every place, worst first."""
        return worst_of_each(self.heights(x)[0], self.places.times)

    @property
    def cells(self) -> tuple[Array, Array]:
        """Cells of the index, one for the times that stand for each place."""
        lower, upper = self.places.spans
        return lower[:, None], upper[:, None]

    def enclosure(self, x: Array, lower: Array, upper: Array) -> Enclosure:
        """Return the violations at the places of the cells, plus an allowance for rounding: nothing changes between
        places."""
        violations, size = self.heights(x)
        bounds = (violations + ROUND_OFF * size).max(axis=1)[self.places.at((lower[:, 0] + upper[:, 0]) / 2)]
        return Enclosure(bounds, np.zeros(bounds.size, dtype=int))

    @property
    def measured(self) -> tuple[str, ...]:
        """The unit of every row, empty where it has none that is known."""
        return tuple(unit_of_row(normal, self.loop.functionals.names, 0).strip() for normal in self.H)

    def explain(self, index: Array, row: int) -> Explanation:
        """Return the description of one constraint for a reader."""
        names, direction = self.loop.functionals.names, self.H[row]
        time = float(self.places.times[self.places.at(index[:1])[0]]) if self.places.steps else float(index[0])
        if self.places.steps:
            at = f"{time:.6g} {names.time}".rstrip()
            terms = f"the change of {combination(direction, names, states=0)} at {at}"
        else:
            terms = combination(direction, names, f"({time:.6g})", 0)
        right = f"{self.h[row] + 0.0:.6g} {self.measured[row]}".rstrip() if self.bound is None else "its peak"
        text = f"{self.name}: {terms} <= {right}"
        description = TimedExplanation(text, self.name, text, time, direction)
        return describe_deviations(description, self.loop, index[1:])


def worst_of_each(found: Array, times: Array) -> Separation:
    """Return the worst row at every time, worst first, of violations ``(k, r)`` at ``times (k,)``."""
    rows = found.argmax(axis=1)
    heights = found[np.arange(rows.size), rows]
    order = np.argsort(-heights, kind="stable")
    return Separation(times[order][:, None], rows[order], heights[order], float(found.max()))


def describe_deviations(said: TimedExplanation, loop: ClosedLoop, w: Array) -> TimedExplanation:
    """Return the description of a constraint for every disturbance, or at the deviations ``w (Q,)`` if ``w`` is not
    empty."""
    problem, noises = loop.functionals, loop.noises(w) if w.size else None
    noisy = True if loop.observer is not None and loop.observer.noisy else None
    sources = ("disturbance", problem.disturbance), ("noise", noisy), ("initial state", problem.initial)
    text = f"{said.statement} for every {' and '.join(name for name, s in sources if s is not None) or 'disturbance'}"
    if not w.size and loop.spread.size:
        return replace(said, text=text, disturbance=None, initial_state=None, deviation=None, quantity="", noise=None)
    point, width = loop.spread.middle + w, problem.response.system.disturbances
    signal = None if problem.disturbance is None else point[: loop.noise.start].reshape(-1, width).T
    if problem.initial is None:
        return replace(said, text=text, disturbance=signal, quantity="", noise=noises)
    deviation = loop.begins @ point
    return replace(
        said,
        text=text,
        disturbance=signal,
        initial_state=problem.response.initial_state + deviation,
        deviation=deviation,
        following=loop.following @ point if loop.anew else None,
        quantity="",
        noise=noises,
    )
