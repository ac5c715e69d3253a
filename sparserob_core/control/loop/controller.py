"""A control that runs: the measured state goes in at every breakpoint, the control of the next piece comes out."""

from __future__ import annotations

import time as clock
from dataclasses import dataclass, replace
from typing import final

import numpy as np
import numpy.typing as npt

from sparserob_core.brief import brief
from sparserob_core.control.feedback.observer import Observer
from sparserob_core.control.loop.resolving import ProvenPlan, Resolving
from sparserob_core.control.studies.measuring import Measuring
from sparserob_core.errors import InputError
from sparserob_core.sip.convex_set import Array

SAME_BREAKPOINT = 1e-9  # of the horizon: how far a time may be from the breakpoint that it means
DEVIATION_ROUNDING = 1e-7  # of the size of a state, a deviation that is rounding


@final
@dataclass(frozen=True)
class Step:
    """Record of one step of a `Controller`.

    Attributes: the ``time`` at which the step began, in the time of the problem, and the ``seconds`` that it took.
    ``resolved``: true where the control comes from a problem that was solved anew at this step. ``covered``: true where
    the proof covers everything that was measured so far. ``cost`` and ``lower_bound`` enclose the cost over the
    remaining horizon where a re-solve reported them (otherwise NaN).
    """

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

    def __init__(self, plan: ProvenPlan, resolving: Resolving | None = None) -> None:
        self._first_plan, self._resolver = plan, resolving
        start = clock.perf_counter()
        if resolving is not None:
            resolving.prepare(plan)
        self._preparation_seconds = clock.perf_counter() - start if resolving is not None else 0.0
        self.reset()

    def __repr__(self) -> str:
        pieces = len(self._first_plan.model.control.breakpoints) - 1
        state = "covered" if self._is_covered else "not covered by the proof"
        kind = "applies its plan" if self._resolver is None else "solves anew at every step"
        return f"Controller of {pieces} pieces, {len(self._steps)} steps made: {kind}; {state}"

    @property
    def breakpoints(self) -> Array:
        """Times at which the pieces of the control begin, and the horizon as the last one, ``(K + 1,)``, in the time of
        the problem."""
        return np.array(self._first_plan.model.control.breakpoints)

    @property
    def prepared(self) -> float:
        """Seconds spent before the first step on work that no step with a time limit waits for; 0 without a re-solve.
        The time limit applies to every step, also to the first one: make the controller before the system runs."""
        return self._preparation_seconds

    @property
    def covered(self) -> bool:
        """True where the proof covers every state measured since the last `reset`, or since the last plan that was made
        from a measured state.

        The answer is exact where every measured state determines the disturbance: one value on each piece of the
        control, which moves the states independently. Otherwise states are compared coordinate by coordinate, and the
        answer may stay true too long. Parameters cannot be told apart from a disturbance: with uncertain parameters the
        answer is true as long as no measurement was missing.
        """
        return self._is_covered

    @property
    def ever_uncovered(self) -> bool:
        """True where any state since the last `reset` was missing or not covered by the proof, even if a later plan
        covers the states again. Then more acts on the system than the problem says."""
        return self._is_ever_uncovered

    @property
    def steps(self) -> tuple[Step, ...]:
        """The steps since the last `reset`."""
        return tuple(self._steps)

    @property
    def plan(self) -> ProvenPlan:
        """The plan that is applied: the first one, or the last that was solved anew."""
        return self._plan

    def reset(self) -> None:
        """Begin anew: the next step is that of time 0."""
        self._apply_plan(self._first_plan)
        self._next_piece, self._is_covered, self._steps = 0, True, list[Step]()
        self._period, self._is_ever_uncovered = 0, False
        self._last_control: Array | None = None
        self._last_state: Array | None = None
        self._reach_bounds: tuple[Array, Array] | None = None
        # of the integrals, which nobody measures, what the applied controls have added up to
        self._integral_values = np.zeros(
            self._first_plan.model.problem.system.states - self._state_count - self._added_state_count
        )

    def step(self, time: float, state: npt.ArrayLike | None) -> Array:
        """Return the control ``(m,)`` for the piece that begins at ``time``, a breakpoint. Breakpoints come one after
        another.

        Parameters
        ----------
        time : float
            The breakpoint, in the time of the problem.
        state : array (d,) or None
            The state measured then, or the outputs ``(p,)`` of a problem with ``measurements``. ``None`` where the
            measurement is missing.

        Returns
        -------
        array (m,)
            The control.

        Raises
        ------
        InputError
            For a time or a state that is none. The controller is then as it was before.
        """
        start_time = clock.perf_counter()
        period, piece = self._check_time(time)
        measured = None if state is None else self._read_measurement(state)
        if period > self._period:
            self._begin_period(period)
            measured = None if state is None else self._read_measurement(state)  # integrals begin anew
        # from any of the initial states the proof holds for another period
        anew = period > 0 and piece == 0 and self._observer is None
        covered = measured is not None and (self._is_covered or anew) and self._is_expected_state(measured)
        self._is_ever_uncovered = self._is_ever_uncovered or not covered
        answer = None
        if self._resolver is not None and measured is not None:
            answer = self._resolver.answer(
                self._plan, piece, measured, self._last_control, self._compute_innovations(measured)
            )
            if answer.plan is not None and (answer.cheaper or not covered):
                self._replace_plan(answer.plan)
                covered = True
            else:
                answer = None
        u = self._compute_control(piece - self._plan.first, measured)
        measured_state = None if self._observer is not None else measured
        self._reach_bounds = (
            None if measured_state is None else self._plan.reach(piece - self._plan.first, measured_state, u)
        )
        self._integral_values = (
            self._integral_values
            + self._plan.added(piece - self._plan.first, u)[self._state_count + self._added_state_count :]
        )
        self._next_piece, self._is_covered, self._last_control, self._last_state = piece + 1, covered, u, measured
        at = self._compute_piece_time(period, piece)
        outcome = (False, np.nan, np.nan) if answer is None else (answer.plan is not None, answer.cost, answer.lower)
        self._steps.append(Step(at, clock.perf_counter() - start_time, outcome[0], covered, *outcome[1:]))
        return u.copy()

    def _begin_period(self, period: int) -> None:
        """Apply the plan anew, in the next period."""
        self._apply_plan(self._first_plan)
        self._next_piece, self._period = 0, period
        self._integral_values = np.zeros_like(self._integral_values)

    def _compute_piece_time(self, period: int, piece: int) -> float:
        points = self._first_plan.model.control.breakpoints
        return float(period * points[-1] + points[piece])

    def _apply_plan(self, plan: ProvenPlan) -> None:
        self._plan = plan
        self._last_disturbance: tuple[int, Array] | None = (
            None  # the last piece of the disturbance that was seen, and its value
        )
        feedback = plan.known.feedback
        self._measuring = None if feedback is None else Measuring.of(plan.known, plan.decision)
        self._nominal_control = plan.known.pieces(plan.decision)

    def _replace_plan(self, plan: ProvenPlan) -> None:
        """Apply a new plan from now on; one with the same gains goes on answering what was seen so far."""
        if self._measuring is None or plan.known is not self._plan.known:
            self._apply_plan(plan)
            return
        self._plan, self._nominal_control = plan, plan.known.pieces(plan.decision)
        self._measuring = replace(self._measuring, nominal=self._nominal_control)

    def _check_time(self, time: object) -> tuple[int, int]:
        """Return the period, and the piece of it, that begin at a time, which must be the next breakpoint."""
        points = self._first_plan.model.control.breakpoints
        period, piece = self._period, self._next_piece
        if piece >= points.size - 1 and self._first_plan.model.problem.repeat:
            period, piece = period + 1, 0
        if piece >= points.size - 1:
            got = f"a step at {time!r}"
            raise InputError(path="time", expected=f"reset() first, since the horizon {points[-1]:g} is over", got=got)
        expected = self._compute_piece_time(period, piece)
        number = isinstance(time, int | float | np.number) and not isinstance(time, bool)
        if not number or not abs(float(time) - expected) <= SAME_BREAKPOINT * points[-1]:  # type: ignore[arg-type]
            expectation = "0, since it begins there" if not period + piece else f"{expected!r}, the next breakpoint"
            raise InputError(path="time", expected=expectation, got=f"{time!r}")
        return period, piece

    @property
    def _state_count(self) -> int:
        """Number of states of the problem as the user stated it, all of which are measured where the whole state is
        measured."""
        return self._first_plan.model.stated.system.states

    @property
    def _added_state_count(self) -> int:
        """Number of further states that hold the effect of the parameters of a system that also depends on time. They
        follow the `_state_count` states of the user, and are 0 where a state is measured."""
        first, end = self._first_plan.model.problem.names.corners.added
        return end - first

    @property
    def _observer(self) -> Observer | None:
        """Observer that makes innovations of measured outputs; ``None`` where the state is measured."""
        return self._plan.known.observer

    def _read_measurement(self, state: object) -> Array:
        """Return the measured outputs; or the measured state, followed by the states that nobody measures."""
        observer, count, kind = self._observer, self._state_count, "state"
        if observer is not None:
            count, kind = observer.C.shape[0], "output"
        try:
            measured = np.array(state, dtype=float)
        except (TypeError, ValueError):
            measured = np.zeros(0)
        if measured.shape != (count,) or not np.isfinite(measured).all():
            expected = f"{count} finite numbers, one per {kind}, or None where the measurement is missing"
            raise InputError(path="state", expected=expected, got=f"{state!r}")
        unmeasured = np.append(np.zeros(self._added_state_count), self._integral_values)
        return measured if observer is not None else np.append(measured, unmeasured)

    def _is_expected_state(self, state: Array) -> bool:
        """Return whether the last state may lead to this state, or, at the first step, whether it is an admissible
        initial state. Later states are compared coordinate by coordinate; the result is true where the last state tells
        no bounds. Of outputs, return whether each entry of the innovation is within the bounds that admissible
        deviations give."""
        if self._observer is not None:
            return self._is_expected_output(state)
        if self._next_piece == 0:
            problem = self._first_plan.model.problem
            centre, axes = np.asarray(problem.initial_state, dtype=float), np.eye(state.size)
            deviation, size = state - centre, np.abs(state) + np.abs(centre)
            if problem.initial_set is None:
                return bool((np.abs(deviation) <= DEVIATION_ROUNDING * np.maximum(size, size.max())).all())
            tolerance = DEVIATION_ROUNDING * float(problem.initial_set.reach(axes).max() + size.max())
            return float(problem.initial_set.violation(deviation)) <= tolerance
        if self._reach_bounds is None or self._last_state is None:
            return True
        lower, upper = (bound[: self._state_count] for bound in self._reach_bounds)
        tolerance = DEVIATION_ROUNDING * max(
            float(np.abs(lower).max()), float(np.abs(upper).max()), np.finfo(float).tiny
        )
        user_state = state[: self._state_count]
        return bool(
            (user_state >= lower - tolerance).all() and (user_state <= upper + tolerance).all()
        ) and self._has_admissible_cause(state, tolerance)

    def _is_expected_output(self, outputs: Array) -> bool:
        assert self._measuring is not None
        innovation = self._measuring.list_innovations(outputs)[-1]
        lower, upper = (
            bound[self._next_piece - self._plan.first] for bound in self._plan.known.answering.loop.expected
        )
        tolerance = DEVIATION_ROUNDING * float(
            np.max([np.abs(outputs), np.abs(innovation), np.abs(lower), np.abs(upper)])
        )
        return bool((innovation >= lower - tolerance).all() and (innovation <= upper + tolerance).all())

    def _has_admissible_cause(self, state: Array, room: float) -> bool:
        """Return whether an admissible disturbance led from the last state to this one; true where the states do not
        determine the disturbance."""
        assert self._last_state is not None and self._last_control is not None
        cause = self._plan.caused(self._next_piece - 1 - self._plan.first, self._last_state, self._last_control, state)
        bound = self._first_plan.model.problem.disturbance
        if cause is None or bound is None:
            return True
        block, value, residual, growth = cause
        residual = residual[: self._state_count]
        margin = growth * room + DEVIATION_ROUNDING * float(np.abs(value).max())
        is_new_block = self._last_disturbance is None or self._last_disturbance[0] != block
        is_same = is_new_block or bool((np.abs(value - self._last_disturbance[1]) <= 2.0 * margin).all())  # type: ignore[index]
        self._last_disturbance = (block, value)
        return is_same and bool((np.abs(residual) <= room).all()) and float(bound.violation(value)) <= margin

    def _compute_innovations(self, state: Array) -> list[Array]:
        """Return the innovations that the applied plan answers when this state is measured, one vector for each
        breakpoint since the plan began; a single zero vector where the plan has no feedback."""
        return [np.zeros(state.size)] if self._measuring is None else self._measuring.list_innovations(state)

    def _compute_control(self, piece: int, state: Array | None) -> Array:
        nominal = self._nominal_control[:, piece]
        if self._measuring is None:
            return nominal.copy()
        observed = self._measuring.predicted() if state is None else state[:, None]
        for number in np.flatnonzero(self._measuring.commanded == piece).tolist():
            self._measuring.after(number, lambda _: observed)
        return self._plan.drawn_in(self._measuring.command(piece)[:, 0], nominal)
