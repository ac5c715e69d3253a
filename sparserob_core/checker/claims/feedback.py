"""The claims of a run whose control answers what it measures, each derived anew from its gains in ball arithmetic."""

from __future__ import annotations

from bisect import bisect_right
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import cached_property, lru_cache
from typing import TYPE_CHECKING, Any, final

import numpy as np

from sparserob_core.checker.arithmetic.balls import balls, below
from sparserob_core.checker.claims.case import EQUALS, STEP, Case, number, numbers
from sparserob_core.checker.claims.constraints import covered, cut, normals_of, of_fixed
from sparserob_core.checker.claims.duality import Row, before, steps
from sparserob_core.checker.claims.units import RowUnits
from sparserob_core.checker.claims.window import Window
from sparserob_core.checker.outcome import EQUALITY, RESOLVED, TOLERANCE, Broken, Unchecked
from sparserob_core.checker.reach.closed_loop import ClosedLoop
from sparserob_core.checker.reach.directions import Directions
from sparserob_core.checker.reach.effort import at_most
from sparserob_core.checker.reach.flow import stacked
from sparserob_core.checker.reach.measurable import MeasurableLoop
from sparserob_core.checker.reach.preimages import Pushed, Seen
from sparserob_core.checker.reach.varying.loop import VaryingLoop
from sparserob_core.checker.sets.known import known
from sparserob_core.control.problem.system import LinearSystem
from sparserob_core.control.sets.sets import Box, Ellipsoid, NormBall, Product
from sparserob_core.sip.convex_set import Array, ConvexSet

if TYPE_CHECKING:
    from flint import arb, arb_mat

MOST_CELLS = 40_000  # cells of time examined for each constraint
PEAK = "peak"
WORST, EFFORT = "worst", "effort"
FIGURES = 1e-11  # of an effort: how closely it is known


@final
class FeedbackClaims:
    """What a certificate claims of a policy: nominal control and ``gains (K, K, m, p)``."""

    def __init__(self, case: Case) -> None:
        self.case = case

    @cached_property
    def gains(self) -> Array:
        """The gains, none of a control that answers nothing; raises `Broken` where they answer what is not yet
        measured, or what the policy does not answer."""
        case = self.case
        if case.policy is None:
            return self._none
        gains = numbers(case.certificate.get("gains"), "gains")
        if gains.shape != self._none.shape:
            raise Broken(f"the gains have shape {gains.shape}, expected {self._none.shape}")
        times, measured = case.control.breakpoints, case.problem.measurements
        told = case.problem.initial_set is not None or (measured is not None and measured.noise is not None)
        for k, j in np.argwhere(gains.any(axis=(2, 3))).tolist():
            if j > k or (j == 0 and not told):
                raise Broken(f"the control from t = {float(times[k]):.6g} on answers what is not measured yet")
            if not case.answers[k, j]:
                raise Broken(
                    f"the control from t = {float(times[k]):.6g} on answers what was measured at"
                    f" {float(times[j]):.6g}, which its policy does not"
                )
        return gains

    @property
    def _none(self) -> Array:
        """Gains that answer nothing, ``(K, K, m, p)``."""
        system, measured, K = self.case.problem.system, self.case.problem.measurements, self.case.control.pieces
        return np.zeros((K, K, system.controls, system.states if measured is None else measured.outputs))

    @cached_property
    def observer(self) -> Array | None:
        """What makes innovations of the outputs, ``(K, d, p)``; any is right that is written."""
        case = self.case
        if case.problem.measurements is None or case.policy is None:
            return None
        shape = case.control.pieces, case.problem.system.states, case.problem.measurements.outputs
        found = numbers(case.certificate.get("observer"), "observer")
        if found.shape != shape:
            raise Broken(f"the observer has shape {found.shape}, expected {shape}")
        return found

    @cached_property
    def loop(self) -> ClosedLoop:
        """The system under the nominal control and the gains."""
        return self._loop(self.case.theta, self.gains)

    def _loop(self, nominal: Array, gains: Array, changes: list[float] | None = None) -> ClosedLoop:
        """The loop; where ``changes`` are given, under disturbances that jump there only."""
        case = self.case
        system, answers = case.problem.system, case.policy is not None and not case.measurable
        if system.parameter_count or not (answers or isinstance(system, LinearSystem)):
            raise Unchecked("the checker knows feedback and measurable disturbances of known systems only")
        if not answers and not (case.control.is_indicators and system.delay == 0.0):
            raise Unchecked(
                "of measurable disturbances the checker knows controls of their own on every piece, undelayed"
            )
        held = (changes or []) if case.measurable else (case.changes or [])
        measured = None if case.policy is None else case.problem.measurements
        if measured is not None and case.measurable:
            raise Unchecked("the checker knows outputs beside disturbances that are constant on pieces only")
        parts = (
            case.problem.system,
            [float(v) for v in np.asarray(case.problem.initial_state)],
            nominal,
            gains,
            sorted({*case.grid, *held}),
            [float(t) for t in case.control.breakpoints],
            held,
            case.problem.disturbance,
            case.problem.initial_set,
            tuple(float(v) for v in before(case.problem)),
            measured,
            self.observer,
        )
        if case.changing is not None:
            return VaryingLoop(*parts, law=case.changing)
        return (MeasurableLoop if case.measurable and changes is None else ClosedLoop)(*parts)

    def control(self) -> str:
        """Every piece of the control in its set, for every disturbance."""
        shape = self.case.problem.control
        flat = known(shape).facets
        if flat is None:
            pieces = range(len(self.loop.effects))
            said = self._turned(shape, pieces, lambda k, rows: self.loop.heights(self.loop.inputs(k), rows))
            return f"{len(pieces)} pieces {said}"
        worst, loop = -np.inf, self.loop
        for k, effect in enumerate(loop.effects):
            self.case.clock.check()
            v = balls(loop.nominal[:, k])
            for (c, b), unit in zip(flat, known(shape).units, strict=True):
                along = [_dot(c, [row[q] for row in effect]) for q in range(len(effect[0]))] if effect else []
                height = _dot(c, v) + loop.support(along)
                unit = max(unit, RESOLVED * float((abs(height) + abs(b)).mid())) or 1.0
                over = float((height - b).upper()) / unit
                if over > TOLERANCE:
                    raise Broken(
                        f"it leaves its set by {over:.3g} of its own unit, on piece {k + 1}, for some disturbance"
                    )
                worst = max(worst, over)
        return f"{len(loop.effects)} pieces in their set for every disturbance, {_to(worst)}"

    def _turned(self, convex: ConvexSet, places: Sequence[int], held: Callable[[int, arb_mat], list[arb]]) -> str:
        """What is held at every place in a curved set, for every disturbance: figures in words."""
        shape, m = known(convex), convex.dimension
        every = Directions(self.loop, shape, np.diag(1.0 / np.array(shape.radius)), held)
        faces = [(-np.ones(m), np.ones(m)) for _ in range(2 * m)]
        for place, (low, high) in enumerate(faces):
            low[place // 2] = high[place // 2] = 1.0 if place % 2 else -1.0
        count, most = self._shown(every, [(k, 0.0, 0.0, *face) for k in places for face in faces])
        return f"in their set for every disturbance, to {most:.1e} ({count} cells of directions)"

    def steps(self) -> str:
        """Every change of the control in its set, for every disturbance."""
        case, loop, worst = self.case, self.loop, -np.inf
        assert case.problem.control_step is not None
        shape, found = known(case.problem.control_step), steps(case.problem, case.control)
        if shape.facets is None:
            return f"{len(found)} steps {self._turned(case.problem.control_step, found, self._changes)}"
        rows = np.array([c for c, _ in shape.facets])
        for k in found:
            case.clock.check()
            heights = self._changes(k, rows)
            for (_, b), height, unit in zip(shape.facets, heights, shape.units, strict=True):
                over = float((height - b).upper()) / (max(unit, RESOLVED * float((abs(height) + abs(b)).mid())) or 1.0)
                if over > TOLERANCE:
                    raise Broken(
                        f"the change of the control leaves its set by {over:.3g} of its own unit for some disturbance,"
                        f" at t = {loop.breakpoints[k]:.6g}"
                    )
                worst = max(worst, over)
        return f"{len(found)} steps in their set for every disturbance, {_to(worst)}"

    def _changes(self, k: int, rows: Array | arb_mat) -> list[arb]:
        """The largest change along every row, at the beginning of piece ``k``. Across the seam of a plan that repeats
        the last control of a period and the first one of the next are chosen apart: what each answers is another's."""
        if k < self.case.control.pieces:
            return self.loop.heights(self._change(k), rows)
        first, last = self.loop.heights(self.loop.inputs(0), rows), self.loop.heights(self.loop.inputs(k - 1), -rows)
        return [a + b for a, b in zip(first, last, strict=True)]

    def _change(self, k: int) -> arb_mat:
        """The change of the nominal control, and of its answers, to piece ``k``, ``(m, 1 + Q)``."""
        if k:
            return self.loop.inputs(k) - self.loop.inputs(k - 1)
        zero = [0.0] * self.loop.starts[-1]
        return self.loop.inputs(0) - stacked([balls([float(u), *zero]) for u in before(self.case.problem)])

    def cost(self) -> arb:
        """The cost of the policy; where absolute values are charged as an effort, the written one, which is shown to
        be none too small."""
        from flint import arb

        case, total = self.case, arb(0)
        if case.charge == "nominal":
            return case.price.of(case.pieces)
        squares = case.price.squares(case.pieces)
        if case.charge == WORST:
            written = arb(number(case.certificate, "cost"))
            self._effort(written - squares + FIGURES * abs(written))
            return written
        for k, costs in enumerate(case.price.costs):
            for i, price in enumerate(costs):
                u, row = arb(float(case.theta[i, k])), self.loop.effects[k][i]
                height = (u + self.loop.support(row)).max(-u + self.loop.support([-x for x in row]))
                total = total + price * height
        return total + squares

    def _effort(self, limit: arb) -> None:
        """Show that no deviation causes an effort beyond a limit."""
        from flint import arb

        case, loop = self.case, self.loop
        a, A = [], []
        for k, costs in enumerate(case.price.costs):
            for i, price in enumerate(costs):
                a.append(price * arb(float(case.theta[i, k])))
                A.append([price * x for x in loop.effects[k][i]])
        reach = [
            float(known(shape).support(balls([float(b == axis) for b in range(shape.dimension)])).mid()) - about[axis]
            for shape, about in loop.sets
            for axis in range(shape.dimension)
        ]
        at_most(a, A, loop.support, np.array(reach), limit, case.clock)

    def bounded(self, window: Window) -> str:
        """Show that a constraint is kept at every time, for every disturbance."""
        case, entry, flat = self.case, self._entry(window), window.seen.facets
        if flat is None:
            return self._turning(window, entry)
        lower, upper = numbers(entry.get("lower"), "lower"), numbers(entry.get("upper"), "upper")
        covered(case, window, lower, upper)
        sides = _Sides(self.loop, window, flat, case.units(window).rows)
        grid, cuts = np.array(case.grid), self._cuts(window)
        todo = [part for a, b in zip(lower, upper, strict=True) for part in cut(grid, cuts, float(a[0]), float(b[0]))]
        count, most = 0, -np.inf
        while todo:
            case.clock.check()
            piece, start, stop = todo.pop()
            count += 1
            if count > MOST_CELLS:
                raise Unchecked(f"neither shown nor refuted after {count} cells")
            over = sides.over(piece, start, stop)
            if over <= TOLERANCE:
                most = max(most, over)
                continue
            half = (start + stop) / 2
            if not start < half < stop:
                raise Unchecked(f"the times around {start!r} cannot be halved any more")
            todo += [(piece, start, half), (piece, half, stop)]
        return f"kept for every disturbance, {_to(most)} ({count} cells)"

    def _cuts(self, window: Window) -> Array:
        """The times at which the state, or what stands beside it, turns or jumps."""
        segments = [] if self.case.changing is None else self.case.changing.ends
        return np.unique([*self.case.grid, *segments, *window.cuts(self.loop.breakpoints)])

    def _turning(self, window: Window, entry: Mapping[str, Any]) -> str:
        """The same for a curved set: cells of times and directions."""
        case = self.case
        if case.measurable:
            raise Unchecked("the checker knows measurable disturbances with flat sets of states only")
        lower, upper = numbers(entry.get("lower"), "lower"), numbers(entry.get("upper"), "upper")
        normals = normals_of(window, entry.get("normals"))
        covered(case, window, lower, upper)
        about = None if window.reference is None else (lambda time: window.moved(time, time)[0])
        every = Directions(self.loop, window.seen, normals, about=about)
        grid, cuts = np.array(case.grid), self._cuts(window)
        todo = [
            (*part, low[1:], high[1:])
            for low, high in zip(lower, upper, strict=True)
            for part in cut(grid, cuts, float(low[0]), float(high[0]))
        ]
        count, most = self._shown(every, todo)
        return f"kept for every disturbance, to {most:.1e} ({count} cells)"

    def _shown(self, every: Directions, todo: list[tuple[int, float, float, Array, Array]]) -> tuple[int, float]:
        """How many cells of times and directions it took to show that a curved set is kept on all of these, and by how
        much it is left at most."""
        count, most = 0, -np.inf
        while todo:
            self.case.clock.check()
            piece, start, stop, low, high = todo.pop()
            count += 1
            if count > MOST_CELLS:
                raise Unchecked(f"neither shown nor refuted after {count} cells")
            over, none, (late, wide) = every.over(piece, start, stop, low, high)
            if over <= none:
                most = max(most, over)
                continue
            half, axis = (start + stop) / 2, int((high - low).argmax())
            if start < half < stop and (late > wide or not low[axis] < high[axis]):
                todo += [(piece, start, half, low, high), (piece, half, stop, low, high)]
                continue
            middle = (low[axis] + high[axis]) / 2
            if not low[axis] < middle < high[axis]:
                raise Unchecked(f"the directions around {low.tolist()} cannot be halved any more")
            at = np.arange(low.size) == axis
            todo += [(piece, start, stop, low, np.where(at, middle, high))]
            todo += [(piece, start, stop, np.where(at, middle, low), high)]
        return count, most

    def equalities(self) -> str:
        """Show that the fixed states are met for every disturbance and initial state; a sentence with the figures."""
        case, worst = self.case, 0.0
        state = self._last(self.loop)
        for row, value in case.equalities:
            missed = self._missed(state, row, value)
            sums = self._added(row)
            most = EQUALITY * max(sums, abs(value))
            if not missed <= most:
                name = case.problem.names.state(row)
                raise Broken(
                    f"{name} is missed by up to {float(missed.upper()):.3g} for some disturbance or initial state,"
                    f" rounding is at most {most:.1e}"
                )
            worst = max(worst, float(missed.upper()))
        return f"kept for every disturbance to {worst:.1e}{of_fixed(case)}"

    def _missed(self, state: list[list[arb]], row: int, value: float) -> arb:
        """By how much a fixed state is missed at most."""
        from flint import arb

        line = state[row]
        up, down = self.loop.support(line[1:]), self.loop.support([-x for x in line[1:]])
        off = line[0] - arb(value)
        return (off + up).max(down - off)

    def _last(self, loop: ClosedLoop) -> list[list[arb]]:
        """The nominal state and every response at the end, ``(d, 1 + Q)``."""
        found: list[list[arb]] = loop.nodes[-1].tolist()
        return found

    def _added(self, row: int) -> float:
        """The size of the numbers that are added up in a state at the end: of what the system does without control,
        with it, and of what the control can add."""
        total = float(self._reaches[row])
        for loop in (self.loop_at_rest, self.loop):
            first, *answers = (float(abs(x).upper()) for x in self._last(loop)[row])
            total += first + float(np.array(answers) @ self.loop.radii)
        return total

    @cached_property
    def _reaches(self) -> Array:
        """What initial state and control add up to in every state at the end, ``(d,)``."""
        case, d = self.case, self.case.problem.system.states
        everything, end = Box(np.full(d, -np.inf), np.full(d, np.inf)), case.problem.horizon
        scene = replace(case.scene, disturbance=None, initial_set=None)
        return RowUnits(case.problem, scene, everything, end, end, varying=case.changing).sums

    def _entry(self, window: Window) -> Mapping[str, Any]:
        """What the certificate says of the proof of a constraint."""
        data = self.case.certificate.get("proof", {})
        entry = data.get(window.name) if isinstance(data, Mapping) else None
        if not isinstance(entry, Mapping):
            if self.case.certificate.get("status") == "undecided":
                raise Unchecked("the certificate does not claim it")
            raise Broken("the certificate holds no proof of it")
        tolerance = number(entry, "tolerance")
        if not 0 < tolerance <= TOLERANCE * (1.0 + 1e-12):
            raise Broken(f"a violation of {tolerance:g} is to count as none, of its own unit at most {TOLERANCE:g} may")
        return entry

    def exceeded(self, said: Mapping[str, object]) -> tuple[list[float], float]:
        """By how much the worst disturbance exceeds each row of a constraint at one time, and how closely that is
        known: `said` holds the names ``constraint``, ``time`` and ``violation``."""
        case, loop, name, time = self.case, self.loop, str(said.get("constraint")), number(said, "time")
        number(said, "violation")
        if name == self.of_control:
            k = int(np.clip(bisect_right(loop.breakpoints, time) - 1, 0, case.control.pieces - 1))
            sides = known(case.problem.control).facets
            if sides is None:
                raise Unchecked("the worst direction of a curved set is not told")
            v, effect = balls(loop.nominal[:, k]), loop.effects[k]
            columns = [[row[q] for row in effect] for q in range(len(effect[0]))]
            over = [_dot(c, v) + loop.support([_dot(c, column) for column in columns]) - b for c, b in sides]
            return [float(value.mid()) for value in over], TOLERANCE * max(
                known(case.problem.control).units, default=1.0
            )
        if name == STEP and case.problem.control_step is not None:
            sides = known(case.problem.control_step).facets
            places = [k for k in steps(case.problem, case.control) if loop.breakpoints[k] == time]
            if sides is None:
                raise Unchecked("the worst direction of a curved set is not told")
            if not places:
                raise Broken(f"there is no step at t = {time!r}")
            found = self._changes(places[0], np.array([c for c, _ in sides]))
            slack = TOLERANCE * max(known(case.problem.control_step).units, default=1.0)
            return [float((height - b).mid()) for height, (_, b) in zip(found, sides, strict=True)], slack
        if name == EQUALS and case.equalities:
            state = self._last(loop)
            return [float(self._missed(state, row, value).mid()) for row, value in case.equalities], TOLERANCE * max(
                self._added(row) for row, _ in case.equalities
            )
        window = case.window(name)
        if not window.start <= time <= window.stop:
            raise Broken(f"t = {time!r} is not within {window.start:g} to {window.stop:g}")
        flat = window.seen.facets
        if flat is None:
            raise Unchecked("the worst direction of a curved set is not told")
        piece = case.piece_at(time)
        seen = _Sides(loop, window, flat, np.ones(len(flat)))
        at = [int(np.searchsorted(loop.breakpoints, time, side=side)) - 1 for side in ("left", "right")]
        at = [min(max(k, 0), case.control.pieces - 1) for k in at]
        found = [height for k in sorted({*at}) for height in seen.heights(piece, time, k)]
        slack = TOLERANCE * float(case.units(window).rows.max(initial=0.0))
        limits = [b for _, b in flat] * (len(found) // max(1, len(flat)))
        return [float((height - b).mid()) for height, b in zip(found, limits, strict=True)], slack

    def driven(self, data: Mapping[str, Any]) -> tuple[arb, float]:
        """By how much a witness exceeds the constraint that it names, under the disturbance and from the initial state
        that it names, and how much of that counts as none."""
        case, loop, name, time = self.case, self.loop, str(data.get("constraint")), number(data, "time")
        if case.problem.disturbance is not None and data.get("disturbance") is None:
            raise Unchecked("the certificate holds no disturbance of the witness")
        direction = numbers(data.get("direction"), "direction")
        z = [x for block in _deviations(case, loop, data, name) for x in block]
        held = {self.of_control: case.problem.control, STEP: case.problem.control_step}.get(name)
        window = None if held is not None or name == EQUALS else case.window(name)
        size = case.problem.system.controls if held is not None else case.problem.system.states
        if direction.shape != (size if window is None else window.shape.dimension,):
            raise Broken(f"{name}: {direction.size} numbers in the direction")
        if window is None and held is None:
            values = [row[0] + _along(row[1:], z) for row in self._last(loop)]
            over = _dot(direction, values) - _fixed(case, direction, time)
            return over, EQUALITY * max(self._added(row) for row, _ in case.equalities)
        if window is None:
            assert held is not None
            if name == STEP and time == loop.breakpoints[-1]:
                raise Unchecked("a witness across the seam is not followed")
            k = int(np.clip(bisect_right(loop.breakpoints, time) - 1, 0, case.control.pieces - 1))
            acting = loop.inputs(k) if name == self.of_control else self._change(k)
            limit = known(held).limit(direction)
            unit = 1.0 if known(held).facets is None else max(known(held).units, default=1.0)
            return _dot(direction, [row[0] + _along(row[1:], z) for row in acting.tolist()]) - limit, TOLERANCE * unit
        if not window.start <= time <= window.stop:
            raise Broken(f"t = {time!r} is not within {window.start:g} to {window.stop:g}")
        piece = case.piece_at(time)
        state, limit = loop.state(piece, time).tolist(), window.limit(direction, time)
        if window.is_mixed:
            said = data.get("piece")
            if type(said) is not int:
                raise Broken(f"{name}: the piece of the control is {said!r}")
            window.meets(loop.breakpoints, said, time)
            state += loop.inputs(said).tolist()
        values = [row[0] + _along(row[1:], z) for row in state]
        return _dot(direction, values) - limit, case.units(window).slack(direction, limit)

    @property
    def of_control(self) -> str:
        """As `Case.of_control`."""
        return self.case.of_control

    def disturbed(self, direction: Array, time: float, limit: arb) -> arb:
        """By how much ``c'x(t)`` exceeds a limit without any control, for the worst disturbance and initial state."""
        return self.at_rest.highest(self.case.piece_at(time), time, direction[None])[0] - limit

    def farthest(self, c: Array, gain: Array, time: float, k: int | None) -> arb:
        """The largest ``c'x(t) + gain'u``, ``u`` the control on piece ``k``, over all deviations."""
        piece = self.case.piece_at(time)
        beside = None if k is None else stacked([balls(gain)]) * self.loop.inputs(k)
        return self.loop.highest(piece, time, c[None], beside)[0]

    @cached_property
    def at_rest(self) -> ClosedLoop:
        """The system without any control, under the disturbances of the problem."""
        K, m = self.case.control.pieces, self.case.problem.system.controls
        return self._loop(np.zeros((m, K)), self._none)

    def multiplied(self, entries: Sequence[Any], priced: bool, touched: Sequence[arb_mat] | None = None) -> arb:
        """The bound that multipliers of constraints at single disturbances prove, for every policy of the kind; norms
        and quadratic terms of the nominal control are replaced by their tangents where it is ``touched``.

        Of the nominal control ``v`` and, with the costs ``peak`` and ``worst``, of the peaks and of the effort only the
        sets are used, and how far these let them go; of the gains that
        the control they cause is no wider than its set, ``h(F_kl) + h(-F_kl) <= width`` summed over the blocks ``l``.
        """
        from flint import arb

        case = self.case
        rows = [row for entry in entries for row in _Row.of(case, self._told(entry), entry, case.charge)]
        nominal = [(float(row.multiplier.mid()), Row(row.constant, row.nominal)) for row in rows]
        price = case.price if priced else None
        total = case.duality.bound(nominal, None, price, touched, lengths=case.charge == "nominal")
        most = arb(0)
        for k, asked_of in enumerate(case.price.costs):
            for i, asked in enumerate(asked_of):
                reach = _reach(case.problem.control, i)
                if case.charge == PEAK:
                    left = asked * int(priced) - sum((r.multiplier for r in rows if r.peak == (k, i)), arb(0))
                    total = total + (left * reach).min(arb(0))
                most = most + asked * reach
        if case.charge == WORST:
            left = arb(int(priced)) - sum((r.multiplier for r in rows if r.of_effort), arb(0))
            total = total + (left * most).min(arb(0))
        return total - self._of_gains(self.loop_at_rest, rows)

    def _of_gains(self, loop: ClosedLoop, rows: list[_Row]) -> arb:
        """How much the gains can lower the weighted sum of the rows, at most."""
        from flint import arb

        case, total = self.case, arb(0)
        rows = [row for row in rows if any(not x.is_zero() for part in row.innovations for x in part)]
        if not rows:
            return total
        K, m, d = case.control.pieces, case.problem.system.controls, loop.outputs
        left = stacked([[r.multiplier * r.nominal[k][i] for r in rows] for k in range(K) for i in range(m)])
        right = stacked([[x for part in r.innovations for x in part] for r in rows])
        product = (left * right).tolist()
        width = [_width(case.problem.control, i) for i in range(m)]
        for k in range(K):
            clusters = self._clusters(loop, k)
            for i in range(m):
                sizes = [arb(0)]
                for members, inverse, blocks in clusters:
                    z = (
                        inverse * stacked([[product[k * m + i][j * d + s]] for j in members for s in range(d)])
                    ).entries()
                    shares = iter(z)
                    sizes += [
                        sum((abs(next(shares)) / chord for chord in self._chords[block].values()), arb(0))
                        for block in blocks
                    ]
                total = total + width[i] * _largest(sizes)
        return total

    def _clusters(self, loop: ClosedLoop, k: int) -> list[tuple[list[int], arb_mat, list[int]]]:
        """The breakpoints that the control on a piece answers, those that see a block in common together; for each what
        gives, from a combination of the states seen there, a combination of the blocks, ``(q, J d)``."""
        groups: list[tuple[list[int], set[int]]] = []
        for j in np.flatnonzero(self.case.answers[k, : k + 1]).tolist():
            seen = {block for block in loop.seen[j] if self._chords[block]}
            if not seen:
                continue
            mine, rest = ([j], seen), []
            for members, blocks in groups:
                if blocks & mine[1]:
                    mine = (members + mine[0], mine[1] | blocks)
                else:
                    rest.append((members, blocks))
            groups = [*rest, mine]
        return [(sorted(members), *self._inverse(loop, tuple(sorted(members)))) for members, _ in groups]

    def _inverse(self, loop: ClosedLoop, members: tuple[int, ...]) -> tuple[arb_mat, list[int]]:
        """What gives, of any combination of the states seen at these breakpoints, one of the blocks that is seen so."""
        from flint import arb

        if members not in self._inverses:
            blocks = sorted({block for j in members for block in loop.seen[j] if self._chords[block]})
            d, zero = loop.outputs, arb(0)
            table: list[list[arb]] = []
            for j in members:
                lists = {block: push.tolist() for block, push in loop.seen[j].items()}
                table += [
                    [lists[block][s][b] if block in lists else zero for block in blocks for b in self._chords[block]]
                    for s in range(d)
                ]
            groups = [self._pushed(loop, block) for block in blocks]
            pattern = np.vstack(
                [np.hstack([g.pattern & (b in loop.seen[j]) for g, b in zip(groups, blocks, strict=True)])
                 for j in members]
            )  # fmt: skip
            most = max(group.states for group in groups)
            rows = [(d * (k + 1), most) for k in range(len(members))]
            ends = np.cumsum([group.pattern.shape[1] for group in groups]).tolist()
            columns = [(end, group.entries) for end, group in zip(ends, groups, strict=True)]
            self._inverses[members] = Seen(stacked(table), pattern, rows, columns).inverse(), blocks
        return self._inverses[members]

    def _pushed(self, loop: ClosedLoop, block: int) -> Pushed:
        """Who can see the deviations of a block; of the initial state everyone sees its own."""
        d, varying = loop.system.states, tuple(self._chords[block])
        if loop.measured is not None:  # outputs see what the observer makes of everything: as many as there are
            return Pushed(np.ones((loop.outputs, len(varying)), dtype=bool), loop.outputs, len(varying))
        if self.case.problem.initial_set is not None and block == loop.begun:
            return Pushed(np.eye(d, dtype=bool)[:, list(varying)], len(varying), len(varying))
        if varying not in self._pushes:
            self._pushes[varying] = loop.pushed(varying)
        return self._pushes[varying]

    @cached_property
    def _pushes(self) -> dict[tuple[int, ...], Pushed]:
        return {}

    @cached_property
    def _chords(self) -> list[dict[int, arb]]:
        """Of every block how long its set is along the axes, those along which it is a point left out: what cannot
        deviate is never seen."""
        loop = self.loop_at_rest
        found = {id(shape): _chords(shape, about) for shape, about in loop.sets}
        return [{b: chord for b, chord in enumerate(found[id(shape)]) if chord > 0} for shape, _ in loop.sets]

    @cached_property
    def loop_at_rest(self) -> ClosedLoop:
        """The same system without any control; of measurable disturbances under some of them, that jump often enough to
        push the state wherever any do."""
        case = self.case
        if not case.measurable:
            return self._resting(None)
        parts = np.arange(case.problem.system.states) / case.problem.system.states
        ends = zip(case.grid[:-1], case.grid[1:], strict=True)
        return self._resting([float(t) for a, b in ends for t in a + parts * (b - a)])

    def _resting(self, changes: list[float] | None) -> ClosedLoop:
        K, m = self.case.control.pieces, self.case.problem.system.controls
        return self._loop(np.zeros((m, K)), self._none, changes)

    def _told(self, entry: object) -> ClosedLoop:
        """The system at rest under disturbances that jump where the one does that an entry names."""
        if not self.case.measurable:
            return self.loop_at_rest
        if not isinstance(entry, Mapping):
            raise Broken("multipliers: expected a constraint, a time, a direction, a disturbance and a number each")
        name = str(entry.get("constraint"))
        changes = numbers(entry.get("changes"), f"{name}: changes")
        if changes.ndim != 1 or not changes.size or changes[0] != 0.0 or not (np.diff(changes) > 0.0).all():
            raise Broken(f"{name}: the disturbance must change at increasing times from 0 on")
        if changes[-1] >= self.case.grid[-1]:
            raise Broken(f"{name}: the disturbance changes at {float(changes[-1]):.6g}, after the end")
        return self._resting([float(t) for t in changes])

    @cached_property
    def _inverses(self) -> dict[tuple[int, ...], tuple[arb_mat, list[int]]]:
        return {}


@final
class _Sides:
    """The rows of a window with flat sides, seen along the trajectories of a closed loop; ``unit (r,)`` is that of
    each."""

    def __init__(self, loop: ClosedLoop, window: Window, flat: Sequence[tuple[Array, arb]], unit: Array) -> None:
        self.loop, self.window, self.unit = loop, window, unit
        both = np.array([c for c, _ in flat]).reshape(len(flat), -1)
        self.rows, self.gains = both[:, : window.states], both[:, window.states :]
        self.limits = np.array([below(b) for _, b in flat])
        self._known: dict[tuple[int, float], Array] = {}

    def over(self, piece: int, start: float, stop: float) -> float:
        """By how much of its unit a row is exceeded on a cell of time at most; raises `Broken` where one certainly is
        at an end by more than counts as none."""
        ends = np.nextafter(np.maximum(self._heights(piece, start), self._heights(piece, stop)), np.inf)
        found = (ends + self.loop.bent(piece, start, stop, self.rows) - self.limits) * (1.0 + 1e-15) / self.unit
        return float(found.max())

    def heights(self, piece: int, time: float, k: int) -> list[arb]:
        """The largest left sides at a time in a piece of the grid, with the control on piece ``k``."""
        beside = None
        if self.gains.shape[1]:
            beside = stacked([balls(row) for row in self.gains]) * self.loop.inputs(k)
        found = self.loop.highest(piece, time, self.rows, beside)
        if self.window.reference is None:
            return found
        about = self.window.moved(time, time)[0]
        return [height - _dot(c, about) for height, c in zip(found, self.rows, strict=True)]

    def _heights(self, piece: int, time: float) -> Array:
        if (piece, time) not in self._known:
            found = self.heights(piece, time, self.loop.on(piece))
            self._known[piece, time] = np.array([float(x.upper()) for x in found])
            over = (np.array([float(x.lower()) for x in found]) - self.limits) / self.unit
            if (over > TOLERANCE).any():
                raise Broken(f"it is exceeded at t = {time:.6g}, by {over.max():.1e} of its unit")
        return self._known[piece, time]


@lru_cache(maxsize=2)
def feedback_of(case: Case) -> FeedbackClaims:
    """What is claimed of the policy of a case, made once."""
    return FeedbackClaims(case)


@final
class _Row:
    """One constraint at one disturbance: ``constant + sum_k nominal_k (v_k + sum_j M_kj innovations_j)``, less the peak
    ``(k, i)`` where it compares with one, or less the effort, is at most 0 for every feasible policy."""

    def __init__(
        self,
        multiplier: float,
        constant: arb,
        nominal: list[list[arb]],
        innovations: list[list[arb]],
        peak: tuple[int, int] | None,
        of_effort: bool = False,
    ) -> None:
        from flint import arb

        self.multiplier, self.constant, self.nominal = arb(multiplier), constant, nominal
        self.innovations, self.peak, self.of_effort = innovations, peak, of_effort

    @staticmethod
    def of(case: Case, loop: ClosedLoop, entry: object, cost: str) -> list[_Row]:
        """The constraint that an entry of the certificate names, which must be one of the problem's; a step across the
        seam is the sum of two, of the last control and of the first one, which answer what they see of two periods."""
        case.clock.check()
        if not isinstance(entry, Mapping):
            raise Broken("multipliers: expected a constraint, a time, a direction, a disturbance and a number each")
        name = str(entry.get("constraint"))
        direction, time = numbers(entry.get("direction"), f"{name}: direction"), number(entry, "time")
        y = number(entry, "multiplier")
        if not y > 0:
            raise Broken(f"a multiplier of {name} is {y!r}, expected a positive number")
        if numbers(entry.get("parameter", []), f"{name}: parameter").size:
            raise Broken(f"{name}: a parameter is given of a known system")
        z = _deviations(case, loop, entry, name)
        if name in (feedback_of(case).of_control, PEAK):
            return [_Row._of_control(case, loop, (name, direction, time, y), z, cost == PEAK)]
        if name == EFFORT and cost == WORST:
            return [_Row._of_effort(case, loop, direction, y, z)]
        if name == STEP and case.problem.control_step is not None:
            if direction.shape != (case.problem.system.controls,):
                raise Broken(f"{name}: {direction.size} numbers where {case.problem.system.controls} are expected")
            row = case.duality.step_row(direction, time)
            if time != loop.breakpoints[-1]:
                return [_Row(y, row.constant, row.slope, _seen(loop, z), None)]
            zero = [row.constant * 0] * direction.size
            first = [balls(direction), *[zero] * (case.control.pieces - 1)]
            last = [*[zero] * (case.control.pieces - 1), balls(-direction)]
            begun = _seen(loop, [[x * 0 for x in block] for block in z[: loop.blocks]] + _following(case, entry, name))
            return [_Row(y, row.constant, last, _seen(loop, z), None), _Row(y, row.constant * 0, first, begun, None)]
        return [_Row._of_state(case, loop, (name, direction, time, y), z, entry.get("piece"))]

    @staticmethod
    def _of_state(
        case: Case, loop: ClosedLoop, said: tuple[str, Array, float, float], z: list[list[arb]], piece: object
    ) -> _Row:
        """A constraint on the state, and on the control on a piece of it."""
        name, direction, time, y = said
        d = case.problem.system.states
        window = None if name == EQUALS and case.equalities else case.window(name)
        if direction.shape != (d if window is None else window.shape.dimension,):
            raise Broken(f"{name}: {direction.size} numbers where another number of them is expected")
        if window is not None and not window.start <= time <= window.stop:
            raise Broken(f"{name}: t = {time!r} is not within {window.start:g} to {window.stop:g}")
        limit = _fixed(case, direction, time) if window is None else window.limit(direction, time)
        c, gain = np.split(direction, [d])
        row = case.duality.row(c, time, [], limit, disturbed=False)
        slope = row.slope
        if window is not None and window.is_mixed:
            if not isinstance(piece, int) or isinstance(piece, bool):
                raise Broken(f"{name}: the piece of the control is {piece!r}")
            window.meets(loop.breakpoints, piece, time)
            own = [a + b for a, b in zip(slope[piece], balls(gain), strict=True)]
            slope = [own if k == piece else values for k, values in enumerate(slope)]
        return _Row(y, row.constant + _given(case, loop, c, time, z), slope, _seen(loop, z), None)

    @staticmethod
    def _of_control(
        case: Case, loop: ClosedLoop, said: tuple[str, Array, float, float], z: list[list[arb]], peaks: bool
    ) -> _Row:
        """A constraint on the control on one piece, or on its peak."""
        from flint import arb

        name, direction, time, y = said
        K, m = case.control.pieces, case.problem.system.controls
        if direction.shape != (m,):
            raise Broken(f"{name}: {direction.size} numbers where {m} are expected")
        nominal = [[arb(0)] * m for _ in range(K)]
        piece = int(np.clip(bisect_right(loop.breakpoints, time) - 1, 0, K - 1))
        nominal[piece] = balls(direction)
        seen = [part if j <= piece else [arb(0)] * loop.outputs for j, part in enumerate(_seen(loop, z))]
        if name != PEAK:
            return _Row(y, -known(case.problem.control).limit(direction), nominal, seen, None)
        channel = int(np.abs(direction).argmax())
        if not peaks or sorted(np.abs(direction).tolist()) != [0.0] * (m - 1) + [1.0]:
            raise Broken(f"{name}: the direction {direction.tolist()} is not that of a peak of this policy")
        return _Row(y, arb(0), nominal, seen, (piece, channel))

    @staticmethod
    def _of_effort(case: Case, loop: ClosedLoop, shares: Array, y: float, z: list[list[arb]]) -> _Row:
        """The control at deviations, each entry of it times a share of ``[-1, 1]``, is at most the effort."""
        K, m = case.control.pieces, case.problem.system.controls
        if shares.shape != (m * K,) or not (np.abs(shares) <= 1.0).all():
            raise Broken(f"{EFFORT}: expected {m * K} numbers from -1 to 1")
        from flint import arb

        nominal = [
            [price * arb(float(shares[i * K + k])) for i, price in enumerate(costs)]
            for k, costs in enumerate(case.price.costs)
        ]
        return _Row(y, arb(0), nominal, _seen(loop, z), None, of_effort=True)


def _fixed(case: Case, direction: Array, time: float) -> arb:
    """What ``c'x(T)`` must be, for a direction of one fixed state or its opposite."""
    from flint import arb

    values = dict(case.equalities)
    states = np.flatnonzero(direction).tolist()
    if len(states) != 1 or states[0] not in values or time != case.problem.horizon:
        raise Broken(f"{EQUALS}: the direction {direction.tolist()} at t = {time!r} is not that of a fixed final state")
    return arb(float(direction[states[0]])) * arb(values[states[0]])


def _given(case: Case, loop: ClosedLoop, direction: Array, time: float, z: list[list[arb]]) -> arb:
    """What the disturbance and the initial state, that deviate by ``z`` from their middles, give to ``c'x(t)`` where no
    control answers them."""
    from flint import arb

    weights = case.duality.pushed(direction, time, loop.changes)
    parts = [*zip(loop.sets, z, strict=True)]
    parts = parts[: loop.blocks] + parts[loop.begun :]  # noise reaches the state through answers alone
    weights += [] if case.problem.initial_set is None else [case.duality.carried(direction, time)]
    return sum(
        (
            weight * (arb(float(m)) + off)
            for row, ((_, about), block) in zip(weights, parts, strict=True)
            for weight, m, off in zip(row, about, block, strict=True)
        ),
        arb(0),
    )


def _seen(loop: ClosedLoop, z: list[list[arb]]) -> list[list[arb]]:
    """The innovations ``(K, p)`` of deviations, block by block."""
    from flint import arb

    return [
        [
            sum((push[s, b] * x for block, push in seen.items() for b, x in enumerate(z[block])), arb(0))
            for s in range(loop.outputs)
        ]
        for seen in loop.seen
    ]


def _deviations(case: Case, loop: ClosedLoop, entry: Mapping[str, Any], name: str) -> list[list[arb]]:
    """The deviations, block by block, of the ``disturbance (mw, blocks)``, of the ``noise (K, p)`` and of the initial
    state, ``deviation (d,)`` from its centre, that an entry names, which must be in their sets."""
    from flint import arb

    points: list[Array] = []
    if case.problem.disturbance is not None:
        w = numbers(entry.get("disturbance"), f"{name}: disturbance")
        if w.shape != (loop.width, loop.blocks):
            raise Broken(f"{name}: a disturbance of shape {w.shape}, expected {(loop.width, loop.blocks)}")
        points = list(w.T)
    if loop.noises and loop.measured is not None:
        v = numbers(entry.get("noise"), f"{name}: noise")
        if v.shape != (loop.noises, loop.outputs):
            raise Broken(f"{name}: a noise of shape {v.shape}, expected {(loop.noises, loop.outputs)}")
        points += list(v)
    if case.problem.initial_set is not None:
        points.append(numbers(entry.get("deviation"), f"{name}: deviation"))
        if points[-1].shape != (case.problem.system.states,):
            raise Broken(f"{name}: a deviation of the initial state of shape {points[-1].shape}")
    for number_of, (point, (shape, _)) in enumerate(zip(points, loop.sets, strict=True)):
        if not known(shape).contains(point):
            kinds = ("disturbance", "noise", "deviation of the initial state")
            what = kinds[(number_of >= loop.blocks) + (number_of >= loop.begun)]
            raise Broken(f"{name}: the {what} {point.tolist()} is not shown to be in its set")
    return [
        [arb(float(v)) - arb(float(c)) for v, c in zip(point, about, strict=True)]
        for point, (_, about) in zip(points, loop.sets, strict=True)
    ]


def _following(case: Case, entry: Mapping[str, Any], name: str) -> list[list[arb]]:
    """The deviation of the next period's initial state that an entry names, which must be in its set; none where there
    is one initial state."""
    from flint import arb

    if case.problem.initial_set is None:
        return []
    point = numbers(entry.get("following"), f"{name}: following")
    if point.shape != (case.problem.system.states,) or not known(case.problem.initial_set).contains(point):
        raise Broken(f"{name}: the next deviation {point.tolist()} is not shown to be in its set")
    about = feedback_of(case).loop_at_rest.sets[-1][1]
    return [[arb(float(v)) - arb(float(c)) for v, c in zip(point, about, strict=True)]]


def _dot(c: Array, x: list[arb]) -> arb:
    from flint import arb

    return sum((arb(float(a)) * v for a, v in zip(c, x, strict=True) if a), arb(0))


def _along(row: list[arb], z: list[arb]) -> arb:
    from flint import arb

    return sum((a * b for a, b in zip(row, z, strict=True)), arb(0))


def _axis(shape: ConvexSet, channel: int, sign: float) -> arb:
    return known(shape).support(balls([sign * float(i == channel) for i in range(shape.dimension)]))


def _width(shape: ConvexSet, channel: int) -> arb:
    return _axis(shape, channel, 1.0) + _axis(shape, channel, -1.0)


def _reach(shape: ConvexSet, channel: int) -> arb:
    return _axis(shape, channel, 1.0).max(_axis(shape, channel, -1.0)).max(_axis(shape, channel, 1.0) * 0)


def _chords(shape: ConvexSet, middle: Array) -> list[arb]:
    """Numbers ``c_b`` such that the width of a set along any ``a`` is at least ``c_b |a_b|``: how long it is along the
    axes through its middle."""
    from flint import arb

    if isinstance(shape, Product):
        return [chord for part, own in shape.split(middle) for chord in _chords(part, own)]
    if isinstance(shape, NormBall):
        return [2 * arb(shape.radius)] * shape.dimension
    if isinstance(shape, Ellipsoid):
        inverse = stacked([[arb(float(v)) for v in row] for row in shape.shape]).inv()
        return [2 / inverse[b, b].sqrt() for b in range(shape.dimension)]
    flat = known(shape).facets
    if flat is None:
        raise Unchecked("the checker does not know how long the disturbance's set is along the axes")
    found = []
    for axis in range(shape.dimension):
        reach = []
        for sign in (1.0, -1.0):
            ends = [(b - _dot(c, balls(middle))) / arb(abs(float(c[axis]))) for c, b in flat if sign * c[axis] > 0]
            least = ends[0]
            for end in ends[1:]:
                least = least.min(end)
            reach.append(least)
        found.append(reach[0] + reach[1])
    return found


def _to(worst: float) -> str:
    """By how much a set is left at most, or how much room there is, in words."""
    return f"to {worst:.1e} of its own unit" if worst > 0.0 else f"with a margin of {-worst:.1e} of its own unit"


def _largest(values: list[arb]) -> arb:
    largest = values[0]
    for value in values[1:]:
        largest = largest.max(value)
    return largest
