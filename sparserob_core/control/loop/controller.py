"""A control that runs: the measured state goes in at every breakpoint, the control of the next piece comes out."""

from __future__ import annotations

import time as clock
from dataclasses import dataclass, replace
from typing import final

import numpy as np
import numpy.typing as npt

from sparserob_core.brief import brief
from sparserob_core.control.feedback.observer import Observer
from sparserob_core.control.loop.resolving import Plan, Resolving
from sparserob_core.control.studies.measuring import Measuring
from sparserob_core.errors import InputError
from sparserob_core.sip.convex_set import Array

SAME_BREAKPOINT = 1e-9  # of the horizon: how far a time may be from the breakpoint that it means
SEEN = 1e-7  # of the size of a state, a deviation that is rounding


@final
@dataclass(frozen=True)
class Step:
    """What one step of a `Controller` was: it began at ``time``, took ``seconds``, and was from a control that was
    ``resolved`` anew at this step or not; ``covered``: whether the proof covers what was measured so far. ``cost`` and
    ``lower_bound`` enclose the cost of what is left, where a re-solve has told them (else NaN)."""

    time: float
    seconds: float
    resolved: bool
    covered: bool
    cost: float = np.nan
    lower_bound: float = np.nan

    __repr__ = brief


@final
class Controller:
    """The control of a proven plan while the system runs, one `step` at every breakpoint.

    Without a re-solve it applies the plan: a control fixed beforehand is told piece by piece, gains answer what is
    measured. With one, what is left of the horizon is solved anew from the measured state at every step; the answer is
    taken where it is proven and costs less than what the last plan has left, which is proven too.

    No constraint is violated as long as the states that it is told are those of a system, a disturbance and an initial
    state of the problem. For any other state it still gives a control, within the set of controls, and says so:
    `covered` is then false. Of a problem that repeats the plan begins again at the horizon, and times go on: the step
    after the last one of a period is that of the next one's first breakpoint. Not to be shared by threads.

    What is not as it should be:

    * *A measurement is missing*: ``step(time, None)``. The control is that of a state which is as it was predicted, an
      innovation 0; nothing is solved anew at that step. `covered` is false from then on, until a plan is made of a
      measured state, or a period of a problem that repeats begins in a state that is one of its initial ones.
    * *A measurement that is none*, with NaN, infinity, or another shape; *a time* that is early, late, or told before:
      `InputError`, and the controller is as it was, so that the same step can be made again, with ``None`` where there
      is nothing better. A call that comes late is made with the time of its breakpoint; one that was left out is made
      with ``None``, before the next.
    * *A spike of a sensor*: the state is believed. `covered` is false where no disturbance of the problem leads there,
      gains answer it as they answer any innovation, and the next measurement shows it again with the opposite sign;
      a state that is not believed is told as ``None``.
    """

    def __init__(self, plan: Plan, resolving: Resolving | None = None) -> None:
        self._planned, self._resolving = plan, resolving
        began = clock.perf_counter()
        if resolving is not None:
            resolving.prepare(plan)
        self._prepared = clock.perf_counter() - began if resolving is not None else 0.0
        self.reset()

    def __repr__(self) -> str:
        pieces = len(self._planned.model.control.breakpoints) - 1
        state = "covered" if self._covered else "not covered by the proof"
        kind = "applies its plan" if self._resolving is None else "solves anew at every step"
        return f"Controller of {pieces} pieces, {len(self._steps)} steps made: {kind}; {state}"

    @property
    def breakpoints(self) -> Array:
        """When the pieces of the control begin, and the horizon at the end, ``(K + 1,)``, in the time of the
        problem."""
        return np.array(self._planned.model.control.breakpoints)

    @property
    def prepared(self) -> float:
        """How many seconds were spent before the first step, on what no step with a limit waits for; 0 without a
        re-solve. A limit is one of every step, the first one too: make the controller before the system runs."""
        return self._prepared

    @property
    def covered(self) -> bool:
        """Whether the proof covers every state that was measured since the last `reset`, or since the last plan that
        was made of a measured state. Exact where every state tells what the disturbance was, that is, one value on
        each piece of the control, which moves the states independently; else states are compared one by one, and it may
        be true too long. Parameters are not told from a disturbance: with uncertain ones it is true as long as no
        measurement was missing."""
        return self._covered

    @property
    def ever_uncovered(self) -> bool:
        """Whether a state since the last `reset` was missing, or one that the proof did not cover, a later plan or not:
        then what acts on the system is more than the problem says."""
        return self._ever

    @property
    def steps(self) -> tuple[Step, ...]:
        """The steps since the last `reset`."""
        return tuple(self._steps)

    @property
    def plan(self) -> Plan:
        """The plan that is applied: the first one, or the last that was solved anew."""
        return self._plan

    def reset(self) -> None:
        """Begin anew: the next step is that of time 0."""
        self._take(self._planned)
        self._next, self._covered, self._steps = 0, True, list[Step]()
        self._period, self._ever = 0, False
        self._before: Array | None = None
        self._last: Array | None = None
        self._reach: tuple[Array, Array] | None = None
        # of the integrals, which nobody measures, what the applied controls have added up to
        self._added_up = np.zeros(self._planned.model.problem.system.states - self._states - self._beside)

    def step(self, time: float, state: npt.ArrayLike | None) -> Array:
        """The control ``(m,)`` for the piece that begins at ``time``, a breakpoint, from the ``state (d,)`` measured
        then, or of a problem with ``measurements`` from the outputs ``(p,)``; ``None`` where the measurement is
        missing. Breakpoints come one after another. Raises `InputError` for a time or a state that is none, and is then
        as it was before."""
        began = clock.perf_counter()
        period, piece = self._timed(time)
        measured = None if state is None else self._measured(state)
        if period > self._period:
            self._begin(period)
            measured = None if state is None else self._measured(state)  # integrals begin anew
        # from any of the initial states the proof holds for another period
        anew = period > 0 and piece == 0 and self._observer is None
        covered = measured is not None and (self._covered or anew) and self._within(measured)
        self._ever = self._ever or not covered
        answer = None
        if self._resolving is not None and measured is not None:
            answer = self._resolving.answer(self._plan, piece, measured, self._before, self._innovations(measured))
            if answer.plan is not None and (answer.cheaper or not covered):
                self._go_on(answer.plan)
                covered = True
            else:
                answer = None
        u = self._control(piece - self._plan.first, measured)
        told = None if self._observer is not None else measured
        self._reach = None if told is None else self._plan.reach(piece - self._plan.first, told, u)
        self._added_up = self._added_up + self._plan.added(piece - self._plan.first, u)[self._states + self._beside :]
        self._next, self._covered, self._before, self._last = piece + 1, covered, u, measured
        at = self._begins_at(period, piece)
        taken = (False, np.nan, np.nan) if answer is None else (answer.plan is not None, answer.cost, answer.lower)
        self._steps.append(Step(at, clock.perf_counter() - began, taken[0], covered, *taken[1:]))
        return u.copy()

    def _begin(self, period: int) -> None:
        """Apply the plan anew, in the next period."""
        self._take(self._planned)
        self._next, self._period = 0, period
        self._added_up = np.zeros_like(self._added_up)

    def _begins_at(self, period: int, piece: int) -> float:
        points = self._planned.model.control.breakpoints
        return float(period * points[-1] + points[piece])

    def _take(self, plan: Plan) -> None:
        self._plan = plan
        self._acting: tuple[int, Array] | None = None  # the last piece of the disturbance that was seen, and its value
        feedback = plan.known.feedback
        self._measuring = None if feedback is None else Measuring.of(plan.known, plan.decision)
        self._nominal = plan.known.pieces(plan.decision)

    def _go_on(self, plan: Plan) -> None:
        """Apply a new plan from now on; one with the same gains goes on answering what was seen so far."""
        if self._measuring is None or plan.known is not self._plan.known:
            self._take(plan)
            return
        self._plan, self._nominal = plan, plan.known.pieces(plan.decision)
        self._measuring = replace(self._measuring, nominal=self._nominal)

    def _timed(self, time: object) -> tuple[int, int]:
        """The period and the piece of it that begins at a time, which must be the next one."""
        points = self._planned.model.control.breakpoints
        period, piece = self._period, self._next
        if piece >= points.size - 1 and self._planned.model.problem.repeat:
            period, piece = period + 1, 0
        if piece >= points.size - 1:
            got = f"a step at {time!r}"
            raise InputError(path="time", expected=f"reset() first, since the horizon {points[-1]:g} is over", got=got)
        expected = self._begins_at(period, piece)
        number = isinstance(time, int | float | np.number) and not isinstance(time, bool)
        if not number or not abs(float(time) - expected) <= SAME_BREAKPOINT * points[-1]:  # type: ignore[arg-type]
            said = "0, since it begins there" if not period + piece else f"{expected!r}, the next breakpoint"
            raise InputError(path="time", expected=said, got=f"{time!r}")
        return period, piece

    @property
    def _states(self) -> int:
        """How many states are measured where all of them are: those of the problem as it was stated."""
        return self._planned.model.stated.system.states

    @property
    def _beside(self) -> int:
        """How many states after these hold what parameters beside the time add, which is nothing where a state is
        measured."""
        first, end = self._planned.model.problem.names.corners.added
        return end - first

    @property
    def _observer(self) -> Observer | None:
        """What makes innovations of outputs; ``None`` where the state is measured."""
        return self._plan.known.observer

    def _measured(self, state: object) -> Array:
        """The outputs, or the state with what is not measured after it."""
        observer, count, one = self._observer, self._states, "state"
        if observer is not None:
            count, one = observer.C.shape[0], "output"
        try:
            measured = np.array(state, dtype=float)
        except (TypeError, ValueError):
            measured = np.zeros(0)
        if measured.shape != (count,) or not np.isfinite(measured).all():
            expected = f"{count} finite numbers, one per {one}, or None where the measurement is missing"
            raise InputError(path="state", expected=expected, got=f"{state!r}")
        unseen = np.append(np.zeros(self._beside), self._added_up)
        return measured if observer is not None else np.append(measured, unseen)

    def _within(self, state: Array) -> bool:
        """Whether a state is among those that the last one may lead to, or may begin with; coordinate by coordinate. Of
        outputs: whether the innovation is as large as deviations can make it, number by number."""
        if self._observer is not None:
            return self._expected(state)
        if self._next == 0:
            problem = self._planned.model.problem
            centre, axes = np.asarray(problem.initial_state, dtype=float), np.eye(state.size)
            deviation, size = state - centre, np.abs(state) + np.abs(centre)
            if problem.initial_set is None:
                return bool((np.abs(deviation) <= SEEN * np.maximum(size, size.max())).all())
            room = SEEN * float(problem.initial_set.reach(axes).max() + size.max())
            return float(problem.initial_set.violation(deviation)) <= room
        if self._reach is None or self._last is None:
            return True
        lower, upper = (bound[: self._states] for bound in self._reach)
        room = SEEN * max(float(np.abs(lower).max()), float(np.abs(upper).max()), np.finfo(float).tiny)
        seen = state[: self._states]
        return bool((seen >= lower - room).all() and (seen <= upper + room).all()) and self._caused(state, room)

    def _expected(self, outputs: Array) -> bool:
        assert self._measuring is not None
        new = self._measuring.seen(outputs)[-1]
        least, most = (bound[self._next - self._plan.first] for bound in self._plan.known.answering.loop.expected)
        room = SEEN * float(np.max([np.abs(outputs), np.abs(new), np.abs(least), np.abs(most)]))
        return bool((new >= least - room).all() and (new <= most + room).all())

    def _caused(self, state: Array, room: float) -> bool:
        """Whether an admissible disturbance led from the last state to this one, where that can be told."""
        assert self._last is not None and self._before is not None
        told = self._plan.caused(self._next - 1 - self._plan.first, self._last, self._before, state)
        bound = self._planned.model.problem.disturbance
        if told is None or bound is None:
            return True
        block, value, rest, growth = told
        rest = rest[: self._states]
        near = growth * room + SEEN * float(np.abs(value).max())
        known = self._acting is None or self._acting[0] != block
        same = known or bool((np.abs(value - self._acting[1]) <= 2.0 * near).all())  # type: ignore[index]
        self._acting = (block, value)
        return same and bool((np.abs(rest) <= room).all()) and float(bound.violation(value)) <= near

    def _innovations(self, state: Array) -> list[Array]:
        """What the applied plan knows of the disturbance when this state is measured, one vector for each breakpoint
        since it began."""
        return [np.zeros(state.size)] if self._measuring is None else self._measuring.seen(state)

    def _control(self, piece: int, state: Array | None) -> Array:
        nominal = self._nominal[:, piece]
        if self._measuring is None:
            return nominal.copy()
        seen = self._measuring.predicted() if state is None else state[:, None]
        for number in np.flatnonzero(self._measuring.commanded == piece).tolist():
            self._measuring.after(number, lambda _: seen)
        return self._plan.drawn_in(self._measuring.command(piece)[:, 0], nominal)
