"""The answers of a control to deviations, derived anew from its gains in ball arithmetic.

This module has the closed loop of the system with the gains, the deviations that a certificate names, and their
innovations. The module also bounds how far all gains together can lower a weighted sum of constraints. A control that
answers nothing has no deviations here, and no innovations."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, final

import numpy as np
from flint import arb, arb_mat

from sparserob_core.checker.arithmetic.balls import ball, balls, below
from sparserob_core.checker.arithmetic.remembered import remembered
from sparserob_core.checker.arithmetic.series import exactly, stacked
from sparserob_core.checker.claims.case import STEP, Case, number, numbers, observer_gains, shaped
from sparserob_core.checker.cost.duality import EFFORT, ConstraintRow, steps
from sparserob_core.checker.cost.effort import prove_effort_limit
from sparserob_core.checker.cost.gains import GainsBound
from sparserob_core.checker.outcome import CANCELLED, FIGURES, Broken, Unchecked
from sparserob_core.checker.problem.timing import before
from sparserob_core.checker.reach.closed_loop import NO_GAINS, VerifiedLoop
from sparserob_core.checker.reach.inner_loop import PlantInputs, StateBound
from sparserob_core.checker.sets.known import known
from sparserob_core.checker.sets.shape import find_range
from sparserob_core.sip.convex_set import Array, ConvexSet

PEAK, WORST = "peak", "worst"


@final
class VerifiedFeedback:
    """The answers of the control of a case, from its ``gains (K, K, m, p)``."""

    def __init__(self, case: Case) -> None:
        self.case = case

    @cached_property
    def gains(self) -> Array:
        """The gains ``(K, K, m, p)``, 0 for a control that answers nothing. Raises `Broken` where they answer what is
        not yet measured, or what the policy does not answer."""
        case = self.case
        if not case.answering:
            return self._zero_gains
        gains = shaped(case.certificate, "gains", self._zero_gains.shape)
        times, measurements = case.control.breakpoints, case.problem.measurements
        has_first_deviation = case.problem.initial_set is not None or (
            measurements is not None and measurements.noise is not None
        )
        for k, j in np.argwhere(gains.any(axis=(2, 3))).tolist():
            if j > k or (j == 0 and not has_first_deviation):
                raise Broken(f"the control from t = {float(times[k]):.6g} on answers what is not measured yet")
            if not case.answers[k, j]:
                raise Broken(
                    f"the control from t = {float(times[k]):.6g} on answers what was measured at"
                    f" {float(times[j]):.6g}, which its policy does not"
                )
        return gains

    @property
    def _zero_gains(self) -> Array:
        """Gains that answer nothing, ``(K, K, m, p)``."""
        system, measurements, K = self.case.problem.system, self.case.problem.measurements, self.case.control.pieces
        return np.zeros((K, K, system.controls, system.states if measurements is None else measurements.outputs))

    @cached_property
    def observer(self) -> Array | None:
        """The observer gains ``(K, d, p)`` that make innovations of the outputs (`observer_gains`); ``None`` without
        answered outputs."""
        gains = observer_gains(self.case)
        return gains if gains.size else None

    @cached_property
    def loop(self) -> VerifiedLoop:
        """The system under the nominal control and the gains."""
        case = self.case
        return self._close_loop(case.on_pieces(case.theta), self.gains, case.inner.gains)

    def _close_loop(self, nominal: Sequence[arb_mat], gains: Array, inner: Array = NO_GAINS) -> VerifiedLoop:
        """Return the closed loop. Raise `Unchecked` for the kinds of systems and disturbances that the checker does not
        know under feedback."""
        case = self.case
        system = case.problem.system
        if system.parameter_count:
            raise Unchecked("the checker knows feedback of known systems only")
        if case.measurable or not case.disturbances.alike:
            raise Unchecked("the checker knows feedback under disturbances on the pieces of one dictionary")
        jump_times = case.disturbances.changes or []
        return VerifiedLoop(
            system,
            [float(v) for v in np.asarray(case.problem.initial_state)],
            nominal,
            gains,
            sorted({*case.timing.grid, *jump_times}),
            [float(t) for t in case.control.breakpoints],
            jump_times,
            case.problem.disturbance,
            case.problem.initial_set,
            tuple(float(v) for v in before(case.problem)),
            case.problem.measurements,
            self.observer,
            law=case.flows.at(()),
            inner=inner,
        )

    @cached_property
    def commands(self) -> list[arb_mat]:
        """The control on every piece, ``(m, 1)``; under feedback ``(m, 1 + Q)``, with responses to all deviations."""
        return (
            [self.loop.inputs(k) for k in range(self.case.control.pieces)] if self.case.answering else self.case.pieces
        )

    def changes(self, k: int) -> list[arb_mat]:
        """Return the step of the control at the beginning of piece ``k``, as parts ``(m, 1 + Q)`` with independent
        deviations. At the seam of a plan that repeats, ``k = K``, two controls answer the deviations of two different
        periods."""
        if k == self.case.control.pieces:
            return [self.commands[0], -self.commands[k - 1]]
        if k:
            return [self.commands[k] - self.commands[k - 1]]
        none = [0.0] * (self.commands[0].ncols() - 1)
        return [self.commands[0] - stacked([balls([u, *none]) for u in before(self.case.problem)])]

    def parts_at(self, name: str, time: float) -> list[arb_mat]:
        """Return the control at a time, or its step there, as parts ``(m, 1 + Q)`` with independent deviations, whose
        sum it is."""
        case = self.case
        if name != STEP:
            return [self.commands[case.duality.control_piece(time)]]
        indices = [k for k in steps(case.problem, case.control) if float(case.control.breakpoints[k]) == time]
        if not indices:
            raise Broken(f"{name}: there is no step at t = {time!r}")
        return self.changes(indices[0])

    def support(self, responses: list[arb]) -> arb:
        """Return the support value of all deviations in the direction ``responses (Q,)``; 0 without any."""
        return self.loop.deviations.support(responses) if responses else ball(0.0)

    def heights(self, parts: Sequence[arb_mat], rows: arb_mat) -> list[arb]:
        """Return the largest ``c'u`` over all deviations, ``(r,)``, for every row ``c`` of ``rows (r, m)``. ``u`` is a
        sum of ``parts (m, 1 + Q)`` with independent deviations."""
        support_values = [[row[0] + self.support(row[1:]) for row in (rows * part).tolist()] for part in parts]
        return [sum(values[1:], values[0]) for values in zip(*support_values, strict=True)]

    def sizes(self, rows: Array) -> Array:
        """Return lower bounds ``(k,)`` of the largest ``|c'x|`` on the grid over deviations, for ``rows (k, d)``."""
        largest = np.zeros(len(rows))
        for node in self.loop.nodes:
            for sign in (1.0, -1.0):
                heights = self.heights([node], exactly(sign * rows))
                largest = np.maximum(largest, [below(height) for height in heights])
        return np.asarray(np.where(np.isfinite(largest), largest, 0.0))

    def added(self, state: int) -> float:
        """Return an upper bound of the size of the numbers that are added up to a state at the end. The numbers are the
        state without control, the state with it, and what deviations add to both."""
        total = 0.0
        for loop in (self.loop_at_rest, self.loop):
            first, *responses = (float(abs(x).upper()) for x in loop.nodes[-1].tolist()[state])
            total += first + float(np.array(responses) @ loop.deviations.radii)
        return total

    def cost(self) -> arb:
        """Return the cost of the control as a ball. With the cost ``worst`` it is the written one, shown to be large
        enough."""
        case, total = self.case, ball(0)
        if case.charge not in (PEAK, WORST):
            return case.price.of(case.pieces)
        squares = case.price.squares(case.pieces)
        if case.charge == WORST:
            written = ball(number(case.certificate, "cost"))
            terms = max(case.price.added(case.pieces, ball(0)), case.price.terms(case.pieces))
            rounded = CANCELLED * ball(terms if case.price.is_quadratic else 0.0)
            self._verify_effort(written - squares + FIGURES * abs(written).max(rounded))
            return written.max(squares)  # an effort is never less than 0
        for k, costs in enumerate(case.price.costs):
            for i, price in enumerate(costs):
                u, row = case.pieces[k][i, 0], self.loop.effects[k][i]
                height = (u + self.support(row)).max(-u + self.support([-x for x in row]))
                total = total + price * height
        return total + squares

    def _verify_effort(self, limit: arb) -> None:
        """Raise `Broken` or `Unchecked` unless it is shown that no deviation causes an effort beyond ``limit``."""
        case, loop = self.case, self.loop
        a, A = [], []
        for k, costs in enumerate(case.price.costs):
            for i, price in enumerate(costs):
                a.append(price * case.pieces[k][i, 0])
                A.append([price * x for x in loop.effects[k][i]])
        deviations = loop.deviations
        axes = [[ball(int(b == axis)) for b in range(deviations.starts[-1])] for axis in range(deviations.starts[-1])]
        support_values = np.array([float(deviations.support(axis).mid()) for axis in axes])
        prove_effort_limit(a, A, deviations.support, support_values, limit, case.clock)

    def least(self, rows: Sequence[tuple[float, ConstraintRow]], priced: bool) -> arb:
        """Return a ball whose lower end bounds from below what gains, and charged peaks or an effort, add to the sum of
        weighted ``rows``, with the cost where ``priced``. Peaks and the effort are bounded by the set of the control
        alone; the gains by its width: ``h(F_kl) + h(-F_kl) <= width``, summed over the blocks ``l``."""
        case, total, largest_effort = self.case, ball(0), ball(0)
        for k, costs in enumerate(case.price.costs if self.charges_bounds else ()):
            for i, price in enumerate(costs):
                low, high = find_range(known(case.problem.control), i)
                largest_value = high.max(-low).max(ball(0))
                largest_effort = largest_effort + price * largest_value
                if case.charge != WORST:
                    remaining_price = price * int(priced) - sum(
                        (ball(y) for y, row in rows if row.charged == (k, i)), ball(0)
                    )
                    total = total + (remaining_price * largest_value).min(ball(0))
        if case.charge == WORST:
            remaining_price = ball(int(priced)) - sum((ball(y) for y, row in rows if row.charged == EFFORT), ball(0))
            total = total + (remaining_price * largest_effort).min(ball(0))
        return total - self._gains_bound.of(rows) if case.answering else total

    @property
    def charges_bounds(self) -> bool:
        """True where the price of the control is that of numbers which bound it: peaks, the effort, or beside an inner
        loop the absolute values of the nominal control."""
        return self.case.charge in (PEAK, WORST) or self.case.inner.acts

    @cached_property
    def range(self) -> ConvexSet:
        """The set of the decided part of the control on every piece, with its answers: the set of the control, or
        beside an inner loop a box that is wider by what that loop may add."""
        case = self.case
        return case.inner.widen(
            case.problem.control, lambda: _collect_inputs(case, self.loop_at_rest.bound_missing(case.inner.gains))
        )

    def on_decided(self, row: ConstraintRow, named: NamedDeviations) -> ConstraintRow:
        """Return a row of the control under named deviations as one of its decided part, which is the same without an
        inner loop."""
        constant, slope = self.case.inner.on_decided(row.slope, lambda: (named.entering, named.errors))
        return replace(row, constant=row.constant + constant, slope=slope)

    @cached_property
    def _gains_bound(self) -> GainsBound:
        """The upper bound of how far all gains together can lower a weighted sum of constraints."""
        return GainsBound(self.loop_at_rest, self.case.answers, self.range)

    @cached_property
    def loop_at_rest(self) -> VerifiedLoop:
        """The system without any control."""
        return self._close_loop(self._zero_control, self._zero_gains)

    @property
    def _zero_control(self) -> list[arb_mat]:
        """The control 0 on every piece."""
        none = stacked([balls([0.0])] * self.case.problem.system.controls)
        return [none] * self.case.control.pieces

    def named(self, entry: Mapping[str, Any], name: str) -> NamedDeviations:
        """Return the deviations that an entry of a certificate names, each shown to be in its set."""
        loop = self.loop_at_rest
        return NamedDeviations(self.case, loop, _read_deviations(self.case, loop, entry, name))

    def following(self, named: NamedDeviations, entry: Mapping[str, Any], name: str) -> NamedDeviations:
        """Return the deviations that the first control of the next period answers, in a plan that repeats: the entry
        names the ``following`` deviation ``(d,)`` of the next initial state, where there are several."""
        inner_deviations = named.loop.deviations.rests[: named.loop.deviations.initial_block]
        if self.case.problem.initial_set is None:
            return NamedDeviations(self.case, named.loop, inner_deviations)
        point = numbers(entry.get("following"), f"{name}: following")
        initial_set = known(self.case.problem.initial_set)
        member = initial_set.member(point) if point.shape == (self.case.problem.system.states,) else None
        if member is None:
            raise Broken(f"{name}: the next deviation {point.tolist()} is not shown to be in its set")
        middle = self.loop_at_rest.deviations.sets[-1][1]
        deviation = [v - ball(c) for v, c in zip(member, middle, strict=True)]
        return NamedDeviations(self.case, named.loop, [*inner_deviations, deviation])


def _collect_inputs(case: Case, missing: Array) -> PlantInputs:
    """Return what drives the plant, what bounds its states, and what is ``missing (m,)`` in a feedback of them."""
    states, initial = balls(np.asarray(case.problem.initial_state)), case.problem.initial_set
    if initial is not None:
        states = [x + deviation for x, deviation in zip(states, _span(initial), strict=True)]
    disturbance = [ball(0.0)] * case.problem.system.disturbances
    if case.problem.disturbance is not None:
        disturbance = _span(case.problem.disturbance)
    columns = [arb_mat(len(values), 1, values) for values in (states, _span(case.problem.control), disturbance)]
    return PlantInputs(columns[0], columns[1], columns[2], _bound_states(case), missing)


def _bound_states(case: Case) -> list[StateBound]:
    """Return the bounds of rows on the state, from both sides, at the breakpoints at which a constraint holds."""
    bounds, times = list[StateBound](), case.control.breakpoints.tolist()
    for window in case.windows:
        if window.is_mixed or window.reference is not None:
            continue
        facets = window.enclosed_set.facets
        normals = [np.asarray(c) for c, _ in facets] if facets is not None else list(np.eye(window.states))
        sides = [(c, window.limit(c, window.start), window.limit(-c, window.start)) for c in normals]
        sides = [(c, b, a) for c, b, a in sides if b.is_finite() and a.is_finite()]
        if sides:
            value = arb_mat(len(sides), 1, [(-a).union(b) for _, b, a in sides])
            holds = [window.start <= time <= window.stop for time in times]
            rows = np.array([c for c, _, _ in sides])
            bounds.append(StateBound(rows, [value if is_held else None for is_held in holds]))
    none = [None] * (len(times) - 1)
    for state, goal in case.equalities:
        axis = np.eye(case.problem.system.states)[[state]]
        bounds.append(StateBound(axis, [*none, arb_mat(1, 1, [ball(goal)])]))
    return bounds


def _span(shape: ConvexSet) -> list[arb]:
    """Return balls that contain the values of every channel over a set."""
    ranges = [find_range(known(shape), channel) for channel in range(shape.dimension)]
    return [low.union(high) for low, high in ranges]


def commanded(case: Case, name: str) -> ConvexSet | None:
    """Return the set in which the named constraint keeps the control or its steps; ``None`` for one on the state."""
    if any(window.name == name for window in case.windows):
        return None
    return {case.of_control: case.problem.control, STEP: case.problem.control_step}.get(name)


@remembered()
def feedback_of(case: Case) -> VerifiedFeedback:
    """Return the answers of the control of a case, which are made once."""
    return VerifiedFeedback(case)


@final
@dataclass(frozen=True, eq=False)
class NamedDeviations:
    """Deviations ``z`` from the middles of their sets, one list of balls per block, in a ``loop`` without control."""

    case: Case
    loop: VerifiedLoop
    z: list[list[arb]]

    def of(self, rows: Sequence[list[arb]]) -> list[arb]:
        """Return the values of ``rows`` under these deviations, each a nominal value and responses, ``(1 + Q,)``."""
        deviations = [x for block in self.z for x in block]
        return [sum((a * b for a, b in zip(row[1:], deviations, strict=True)), row[0]) for row in rows]

    @property
    def entering(self) -> list[list[arb]]:
        """Contribution of the deviations to the state at every breakpoint since the one before, ``(K, d)``."""
        return self._see(self.loop.innovations.entering_effects, self.case.problem.system.states)

    @property
    def errors(self) -> list[list[arb]]:
        """Errors of the states that the control knows at every breakpoint, ``(K, d)``; 0 where these are measured."""
        return self._see(self.loop.innovations.errors, self.case.problem.system.states)

    @property
    def middles(self) -> NamedDeviations:
        """The middles of the sets: no deviation."""
        return NamedDeviations(self.case, self.loop, [[ball(0)] * len(block) for block in self.z])

    @property
    def answered(self) -> list[list[arb]]:
        """The deviations that gains answer, block by block: those from points of the sets next to the middles. A
        rounded middle may lie outside of a thin set, and differences from it outside of its span."""
        pairs = zip(self.z, self.loop.deviations.rests, strict=True)
        return [[ball(0)] * len(z) if z is rest else [x - r for x, r in zip(z, rest, strict=True)] for z, rest in pairs]

    def _see(self, effects: Sequence[Mapping[int, arb_mat]], count: int) -> list[list[arb]]:
        """Return the ``count`` entries at every breakpoint that the deviations make block by block, with these
        ``effects``."""
        return [
            [
                sum(
                    (response[s, b] * x for block, response in responses.items() for b, x in enumerate(self.z[block])),
                    ball(0),
                )
                for s in range(count)
            ]
            for responses in effects
        ]

    def given(self, direction: Array, time: float) -> arb:
        """Return the contribution of disturbance and initial state to ``c'x(t)``, ``c (d,)``, without control."""
        case, loop = self.case, self.loop
        weights = case.duality.compute_disturbance_weights(direction, time)
        blocks, loop_deviations = [*zip(loop.deviations.sets, self.z, strict=True)], loop.deviations
        # noise reaches the state through answers alone
        blocks = blocks[: loop_deviations.blocks] + blocks[loop_deviations.initial_block :]
        weights += [] if case.problem.initial_set is None else [case.duality.compute_initial_weights(direction, time)]
        return sum(
            (
                weight * (ball(centre) + deviation)
                for row, ((_, middle), block) in zip(weights, blocks, strict=True)
                for weight, centre, deviation in zip(row, middle, block, strict=True)
            ),
            ball(0),
        )


def _read_deviations(case: Case, loop: VerifiedLoop, entry: Mapping[str, Any], name: str) -> list[list[arb]]:
    """Return the deviations from the middles that an entry names, block by block: its ``disturbance (mw, blocks)``,
    ``noise (K, p)`` and ``deviation (d,)``. A point that rounding took out of a thin set is replaced by one of the
    set."""
    points, loop_deviations = list[Array](), loop.deviations
    noises = loop_deviations.initial_block - loop_deviations.blocks
    if case.problem.disturbance is not None:
        points = list(shaped(entry, "disturbance", (loop_deviations.width, loop_deviations.blocks), f"{name}: ").T)
    if noises and loop.measured is not None:
        points += list(shaped(entry, "noise", (noises, loop.innovations.outputs), f"{name}: "))
    if case.problem.initial_set is not None:
        points.append(shaped(entry, "deviation", (case.problem.system.states,), f"{name}: "))
    deviations = list[list[arb]]()
    for index, (point, (shape, middle)) in enumerate(zip(points, loop_deviations.sets, strict=True)):
        member = known(shape).member(point)
        if member is None:
            kinds = ("disturbance", "noise", "deviation of the initial state")
            kind = kinds[(index >= loop_deviations.blocks) + (index >= loop_deviations.initial_block)]
            raise Broken(f"{name}: the {kind} {point.tolist()} is not shown to be in its set")
        deviations.append([v - arb(float(c)) for v, c in zip(member, middle, strict=True)])
    return deviations
