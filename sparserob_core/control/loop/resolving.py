"""Plans that a controller applies, and the next one: what is left of the horizon, solved anew from a measured state."""

from __future__ import annotations

import time as clock
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import cached_property, partial
from typing import final

import numpy as np

from sparserob_core.control.feedback.innovations import DEPENDENT, KNOWN
from sparserob_core.control.loop.remaining import refuse_remaining, remaining_problem
from sparserob_core.control.loop.retuning import Retuning, replace_control
from sparserob_core.control.loop.tracking import Tracking, is_trackable
from sparserob_core.control.problem.units import Units
from sparserob_core.control.response.time_grid import SAME_TIME
from sparserob_core.control.transcription.record import Transcription
from sparserob_core.control.transcription.transcribe import from_state, in_own_units
from sparserob_core.errors import SparseRobError
from sparserob_core.sip.convex_set import Array
from sparserob_core.sip.events import ignore
from sparserob_core.sip.evidence import Cut
from sparserob_core.sip.limits.deadline import Deadline, OutOfTime
from sparserob_core.sip.method import Tools
from sparserob_core.sip.methods.exchange import Exchange
from sparserob_core.sip.methods.own_units import answered_in_own_units
from sparserob_core.sip.program import SemiInfiniteProgram
from sparserob_core.sip.result import Result, relative_gap
from sparserob_core.sip.working.ledger import Violated, prover_of

PROVEN = ("certified", "verified")
WHOLE = 10.0  # times what it takes to write a whole program down: a solution takes more
BETTER = 1e-6  # of the cost of what is left: less than that is no better
EDGE_HALVINGS = 50  # of the way to a curved edge of the controls; a tenth ends 3 % before it, more is below rounding


@final
@dataclass(frozen=True, eq=False)
class ProvenPlan:
    """Proven decision ``(n,)`` of a transcribed problem, whose time 0 is the beginning of piece ``first`` of the
    control that the plan is for.

    ``cuts`` are the constraints that were active. ``known`` is the transcribed problem. Where ``state (d,)`` is given,
    the plan begins in this state, and ``known`` is the same problem from another initial state.
    """

    known: Transcription
    decision: Array
    first: int = 0
    cuts: Sequence[Cut] = ()
    state: Array | None = None

    @cached_property
    def model(self) -> Transcription:
        """Transcribed problem of this plan; written down when it is asked for, since a controller does without it."""
        return self.known if self.state is None else from_state(self.known, self.state)

    def reach(self, piece: int, state: Array, control: Array) -> tuple[Array, Array] | None:
        """Return the least and the largest value of every state ``(d,)`` after a piece that begins in ``state (d,)``
        under a ``control (m,)``; ``None`` where one piece alone does not determine them."""
        problem, response = self.known.problem, self.known.response
        if problem.system.parameters is not None or problem.system.delay > 0.0 or problem.system.switches:
            return None
        if problem.names.corners:  # parameters beside the time are states by now, that nobody measures
            return None
        if problem.classes - {"piecewise_constant"} or problem.delivery is not None:  # any function of time
            return None
        steps, grid = response.steps(KNOWN), response.grid
        inputs, disturbance_responses, nominal = np.append(control, np.ones(grid.constants)), list[Array](), state
        for number in np.flatnonzero(grid.control_piece == piece).tolist():
            Phi, Gamma = (table[0, int(response.which[number])] for table in (steps.Phi, steps.Gamma))
            B, E = (grid.of_modes(table[0])[int(grid.modes[number])] for table in (steps.B, steps.E))
            nominal = Phi @ nominal + Gamma @ (B @ inputs)
            disturbance_responses = [Phi @ disturbance_response for disturbance_response in disturbance_responses] + [
                Gamma @ E
            ]
        lower, upper = nominal, nominal
        if problem.disturbance is not None:
            for disturbance_response in disturbance_responses:
                upper, lower = (
                    upper + problem.disturbance.support(disturbance_response),
                    lower - problem.disturbance.support(-disturbance_response),
                )
        return lower, upper

    def added(self, piece: int, control: Array) -> Array:
        """Return the change of every state ``(d,)`` that a ``control (m,)`` on a piece alone causes, without the flow
        of the system. For a state that is an integral of controls alone this is the exact increase."""
        response, change = self.known.response, np.zeros(self.known.problem.system.states)
        grid, system = response.grid, response.system
        for number in np.flatnonzero(grid.control_piece == piece).tolist():
            if grid.varying:  # whose pieces are its modes
                B = grid.of_modes(response.steps(self.known.parameters.middle[None]).B[0])[number]
            else:
                mode = system.modes[int(grid.modes[number])]
                B = mode.matrices(mode.probes[:1])[1][0]
            change = change + grid.lengths[number] * (B[: change.size, : control.size] @ control)
        return change

    def caused(self, piece: int, state: Array, control: Array, after: Array) -> tuple[int, Array, Array, float] | None:
        """Return the disturbance on a piece that led from ``state (d,)`` to ``after (d,)`` under a ``control (m,)``.

        Returns
        -------
        tuple or None
            The index of the piece of the disturbance; its value ``(mw,)``; the residual of the state ``(d,)`` that this
            value does not explain; and the largest factor by which an error of the state grows in the value. ``None``
            where the states do not determine the disturbance.
        """
        problem, response, signal = self.known.problem, self.known.response, self.known.functionals.disturbance
        numbers = np.flatnonzero(response.grid.control_piece == piece).tolist()
        if response.propagator.laws is not None:  # which parameters did it is not known
            return None
        if problem.disturbance is None or signal is None or signal.starts is None or len(numbers) != 1:
            return None
        steps, length = response.steps(KNOWN), int(response.which[numbers[0]])
        Phi, Gamma = steps.Phi[0, length], steps.Gamma[0, length]
        state_count = self.known.stated.system.states
        input_response = (Gamma @ steps.E[0])[:state_count]
        sizes = np.linalg.svd(input_response, compute_uv=False)
        if input_response.shape[0] < input_response.shape[1] or not sizes[-1] > DEPENDENT * sizes[0]:
            return None
        forcing = steps.B[0] @ np.append(control, np.ones(response.grid.constants))
        difference = (after - Phi @ state - Gamma @ forcing)[:state_count]
        value = np.linalg.lstsq(input_response, difference, rcond=None)[0]
        block = int(np.searchsorted(signal.starts, numbers[0], side="right")) - 1
        return block, value, difference - input_response @ value, 1.0 / float(sizes[-1])

    def drawn_in(self, control: Array, nominal: Array) -> Array:
        """Return the control ``(m,)``, clipped to the box of controls, or moved towards the ``nominal`` control until
        it is on the flat sides of their set. Where the proof covers the measurements, the control changes by rounding
        only. For a set without flat sides the control is returned as it is."""
        bound = self.known.problem.control
        flat = bound.halfspaces()
        if bound.is_box:
            box = bound.bounding_box()
            return np.clip(control, box.lower, box.upper)
        if float(bound.violation(control)) <= 0.0:
            return control
        if flat is None:
            inside, outside = 0.0, 1.0  # shares of the way from the nominal control
            for _ in range(EDGE_HALVINGS):
                share = (inside + outside) / 2
                is_inside = float(bound.violation(nominal + share * (control - nominal))) <= 0.0
                inside, outside = (share, outside) if is_inside else (inside, share)
            return np.asarray(nominal + inside * (control - nominal))
        H, h = flat
        rise, room = H @ (control - nominal), np.maximum(h - H @ nominal, 0.0)
        share = np.divide(room, rise, out=np.ones_like(room), where=rise > 0.0).min(initial=1.0)
        return np.asarray(nominal + min(1.0, float(share)) * (control - nominal))

    def remaining_control(self, piece: int, innovations: Sequence[Array]) -> Array:
        """Return the nominal control ``(m, K')`` that remains from piece ``piece`` of this plan on, if nothing more
        happens than was measured: one innovation ``(d,)`` for each breakpoint so far."""
        nominal = self.known.pieces(self.decision)[:, piece:]
        feedback = self.known.feedback
        if feedback is None:
            return nominal
        return np.asarray(nominal + feedback.loop.respond(self.decision, innovations)[:, piece:])

    def remaining_cost(self, piece: int, innovations: Sequence[Array]) -> float:
        """Return the cost of the remaining control under feedback, from piece ``piece`` of this plan on: of the nominal
        control, or of its peaks over the deviations that may still happen."""
        feedback, problem = self.known.answering, self.known.problem
        nominal, spread = self.remaining_control(piece, innovations), feedback.loop.spread
        size = np.abs(nominal)
        if feedback.charge.cost == "peak":
            effects = feedback.loop.effects(self.decision)[piece:].copy()
            begin, grid = float(self.known.control.breakpoints[piece]), self.known.response.grid
            # (L', mw, Q): which deviations act later
            later_entries = feedback.loop.entries[grid.breakpoints[1:] > begin]
            effects[:, :, np.abs(later_entries).sum(axis=(0, 1)) == 0.0] = 0.0
            size = np.maximum(nominal.T + spread.support(effects), -nominal.T + spread.support(-effects)).T
        return float((problem.prices(self.known.control.breakpoints)[:, piece:] * size).sum())


@final
@dataclass(frozen=True, eq=False)
class Solved:
    """Result of a re-solve: a ``plan``, or ``None`` where none is proven, its ``cost`` and the ``lower`` bound of the
    cost. ``cheaper`` is true where the plan costs less than the remainder of the last plan."""

    plan: ProvenPlan | None
    cost: float = np.nan
    lower: float = np.nan
    cheaper: bool = False


@final
class Resolving:
    """Solves what is left of the horizon by the exchange method, at most for ``seconds`` a step (`None`: no limit).

    Every program begins with the constraints that mattered at the last step, and a control that is fixed beforehand
    keeps what does not depend on the state for the next loop. Under feedback the nominal control is chosen anew for the
    same gains, which has no lower bound of its own, and then, where that is expected to end in time, the whole program.
    With a limit everything that does not depend on the state is made by `prepare`, and nothing is begun that is
    expected to take longer than the limit. Raises `InputError` for a problem of which nothing can be left.
    """

    def __init__(self, model: Transcription, tools: Tools, tolerance: float, seconds: float | None = None) -> None:
        refuse_remaining(model)
        self._model, self._tools, self._seconds = model, tools, seconds
        self._method = Exchange(tolerance=tolerance)
        self._prepared_problems: dict[int, tuple[Transcription, Transcription, Units]] = {}
        self._trackers: dict[int, Tracking | None] = {}
        self._retunings: list[Retuning] = []
        self._solve_seconds, self._solved_pieces = (
            0.0,
            model.control.pieces,
        )  # a whole program, and the pieces that it had
        self._next_control: Array | None = None  # with what the next period begins, of a plan that repeats
        self._transcription_seconds = 0.0  # what it takes to write a whole program down, however few pieces are left

    def prepare(self, plan: ProvenPlan) -> None:
        """Compute everything that steps with a time limit should not wait for, for the plan that loops begin with;
        nothing without a limit."""
        self._next_control = plan.known.pieces(plan.decision)[:, 0]
        if self._seconds is None:
            return
        state, start_time = np.asarray(self._model.problem.initial_state, dtype=float), clock.perf_counter()
        remaining_problem(self._model, 0, state, None)
        self._transcription_seconds = clock.perf_counter() - start_time
        self._solve_seconds = WHOLE * self._transcription_seconds
        if self._model.feedback is not None:
            retuning = Retuning(plan.known, plan.decision)
            retuning.prepare(state)
            self._retunings = [retuning]
            return
        if self._model.problem.control_step is None:
            for piece in range(self._model.control.pieces):
                if self._get_tracker(piece, state) is None and self._transcription_seconds > self._seconds:
                    return  # those that are left are never begun

    def _is_in_time(self, piece: int) -> bool:
        """Return whether a whole program from a piece on is expected to end within the time limit."""
        pieces = self._model.control.pieces - piece
        needed = max(self._transcription_seconds, self._solve_seconds * (pieces / self._solved_pieces) ** 2)
        return self._seconds is None or needed <= self._seconds

    def answer(
        self, plan: ProvenPlan, piece: int, state: Array, before: Array | None, innovations: Sequence[Array]
    ) -> Solved:
        """Return the best plan for the remaining horizon from piece ``piece`` of the whole control on, compared with
        the remainder of ``plan`` after the ``innovations`` so far. The ``state (d,)`` is measured, ``before (m,)`` is
        the last control. The result holds no plan where no answer is proven."""
        deadline = Deadline(self._seconds)
        tools = replace(self._tools, deadline=deadline, notify=ignore)
        try:
            solved = (self._solve_open_loop if self._model.feedback is None else self._solve_feedback)(
                plan, piece, state, before, innovations, tools
            )
        except (
            SparseRobError,
            OutOfTime,
        ):  # a state from which nothing is to be had; what the last plan has left is proven
            solved = Solved(None)
        if deadline.pressed:
            raise KeyboardInterrupt
        return solved

    def _solve_feedback(
        self,
        plan: ProvenPlan,
        piece: int,
        state: Array,
        before: Array | None,
        innovations: Sequence[Array],
        tools: Tools,
    ) -> Solved:
        tools.deadline.check()
        tuned, pieces = self._retune(plan, piece, state, innovations, tools), self._model.control.pieces - piece
        if not self._is_in_time(piece):
            return tuned
        start_time, full = clock.perf_counter(), Solved(None)
        with suppress(SparseRobError, OutOfTime):
            model = remaining_problem(self._model, piece, state, before)
            gap = float(self._model.control.breakpoints[piece] - self._model.control.breakpoints[plan.first])
            result = answered_in_own_units(partial(self._solve_from_cuts, plan.cuts, gap), model.program, tools)
            known_cost = plan.remaining_cost(piece - plan.first, innovations)
            full = self._judge_result(
                model, result, piece, result.decision, result.cost, result.lower_bound, known_cost
            )
        self._solve_seconds, self._solved_pieces = clock.perf_counter() - start_time, pieces
        if full.plan is None:
            self._solve_seconds *= 2.0  # it needs more than it had
        if tuned.plan is None or (full.plan is not None and full.cost <= tuned.cost):
            return full
        return replace(tuned, lower=full.lower)

    def _solve_from_cuts(self, cuts: Sequence[Cut], gap: float, program: SemiInfiniteProgram, tools: Tools) -> Result:
        """Solve a program in its own units by the exchange method, starting from the ``cuts`` of an earlier solve. The
        program begins ``gap`` later than the program in which these cuts were active."""
        return self._method.close(program, tools, prover_of(program, tools), shift_cuts(cuts, gap, program))

    def _retune(self, plan: ProvenPlan, piece: int, state: Array, innovations: Sequence[Array], tools: Tools) -> Solved:
        """Solve for the best nominal control with the same gains, where `Retuning` accepts the problem."""
        retuning = next((entry for entry in self._retunings if entry.model is plan.known), None)
        if retuning is None:
            if self._seconds is not None and self._transcription_seconds > self._seconds:
                return Solved(None)
            retuning = Retuning(plan.known, plan.decision)
            self._retunings = [*self._retunings[:1], retuning]  # that of the plan that loops begin with, and the last
        plan_piece = piece - plan.first
        tracked = retuning.solve(plan_piece, state, tools.deadline.at_most(np.inf))
        if tracked is None:
            return Solved(None)
        decision = replace_control(
            plan.known, plan.decision, plan_piece, plan.remaining_control(plan_piece, innovations), tracked.decision
        )
        tuned = replace(plan, decision=decision)
        cost, known_cost = (candidate.remaining_cost(plan_piece, innovations) for candidate in (tuned, plan))
        return Solved(tuned, cost, cheaper=is_cheaper(cost, known_cost))

    def _solve_open_loop(
        self,
        plan: ProvenPlan,
        piece: int,
        state: Array,
        before: Array | None,
        innovations: Sequence[Array],
        tools: Tools,
    ) -> Solved:
        tracked = self._solve_by_tracking(plan, piece, state, innovations, tools)
        if tracked is not None:
            return tracked
        tools.deadline.check()
        if not self._is_in_time(piece):
            return Solved(None)
        start_time = clock.perf_counter()
        try:
            return self._solve_by_exchange(plan, piece, state, before, innovations, tools)
        finally:
            self._solve_seconds, self._solved_pieces = (
                clock.perf_counter() - start_time,
                self._model.control.pieces - piece,
            )

    def _solve_by_exchange(
        self,
        plan: ProvenPlan,
        piece: int,
        state: Array,
        before: Array | None,
        innovations: Sequence[Array],
        tools: Tools,
    ) -> Solved:
        """Solve the remaining program by the exchange method until its gap is closed."""
        model, own, units = self._pose_from_state(piece, state, before)
        program = own.program
        gap = float(self._model.control.breakpoints[piece] - self._model.control.breakpoints[plan.first])
        result = self._method.close(
            program,
            tools,
            prover_of(program, replace(tools, notify=ignore)),
            shift_cuts(plan.cuts, gap, program),
        )
        control_units = np.repeat(units.controls, own.control.functions)
        decision = None if result.decision is None else result.decision * control_units
        tail = plan.remaining_control(piece - plan.first, innovations).ravel() / control_units
        known_cost = units.cost * float(program.cost(tail))
        cuts = tuple(replace(cut, index=cut.index * index_units(program, cut)) for cut in result.indices)
        result = replace(result, indices=cuts)
        return self._judge_result(
            model, result, piece, decision, units.cost * result.cost, units.cost * result.lower_bound, known_cost
        )

    def _solve_by_tracking(
        self, plan: ProvenPlan, piece: int, state: Array, innovations: Sequence[Array], tools: Tools
    ) -> Solved | None:
        """Return the answer of `Tracking` where it accepts the problem and closes the gap; otherwise ``None``."""
        if self._model.problem.control_step is not None:
            return None
        is_too_late = (
            self._seconds is not None and self._transcription_seconds > self._seconds and piece not in self._trackers
        )
        tracking = None if is_too_late else self._get_tracker(piece, state)
        if tracking is None:
            return None
        model, own, units = self._prepare_problem(piece, state)
        tracked = tracking.solve(state / units.states, tools.deadline.at_most(np.inf))
        if tracked is None:
            return None
        if relative_gap(tracked.lower, tracked.cost, own.program.added(tracked.decision)) > self._method.tolerance:
            return None
        control_units = np.repeat(units.controls, own.control.functions)
        known_cost = float(
            own.program.cost(plan.remaining_control(piece - plan.first, innovations).ravel() / control_units)
        )
        decision, cost = tracked.decision * control_units, units.cost * tracked.cost
        return Solved(
            ProvenPlan(model, decision, piece, state=state.copy()),
            cost,
            units.cost * tracked.lower,
            is_cheaper(tracked.cost, known_cost),
        )

    def _get_tracker(self, piece: int, state: Array) -> Tracking | None:
        """Return the solver `Tracking` of the remaining problem from a piece on; ``None`` where it does not accept the
        problem."""
        if piece not in self._trackers:
            own = self._prepare_problem(piece, state)[1]
            self._trackers[piece] = Tracking(own) if is_trackable(own) else None
        return self._trackers[piece]

    def _prepare_problem(self, piece: int, state: Array) -> tuple[Transcription, Transcription, Units]:
        """Return the remaining problem in the user's units, the same problem in its own units, and these units. The
        initial state is the first one that was asked for at this piece."""
        if piece not in self._prepared_problems:
            model = remaining_problem(self._model, piece, state, None)
            self._prepared_problems[piece] = (model, *in_own_units(model))
        return self._prepared_problems[piece]

    def _pose_from_state(
        self, piece: int, state: Array, before: Array | None
    ) -> tuple[Transcription, Transcription, Units]:
        """Return the remaining problem from this state in the user's units, the same problem in its own units, and
        these units."""
        if self._model.problem.control_step is not None:
            model = remaining_problem(self._model, piece, state, before, again=self._next_control)
            return (model, *in_own_units(model))
        model, own, units = self._prepare_problem(piece, state)
        return from_state(model, state), from_state(own, state / units.states), units

    def _judge_result(
        self,
        model: Transcription,
        result: Result,
        piece: int,
        decision: Array | None,
        cost: float,
        lower: float,
        known: float,
    ) -> Solved:
        if result.status not in PROVEN or decision is None:
            return Solved(None)
        return Solved(ProvenPlan(model, decision, piece, result.indices), cost, lower, is_cheaper(cost, known))


def is_cheaper(cost: float, known: float) -> bool:
    """Return whether a cost is less than a known cost by more than rounding."""
    return cost < known - BETTER * max(abs(known), abs(cost))


def shift_cuts(cuts: Sequence[Cut], gap: float, program: SemiInfiniteProgram) -> Violated:
    """Return cuts, given in the user's units, as rows of a program in its own units that begins ``gap`` later.

    Cuts of the past, and of constraints that are over, are left out. For a family that holds for every deviation, the
    cuts are times, with all rows.
    """
    families = {family.name: family for family in program.families}
    rows = []
    for cut in cuts:
        family = families.get(cut.family)
        if family is None:
            continue
        size, units, box = family.index_set.dimension, family.index_units, family.index_set
        if family.uncertain is None and (cut.formulation != family.formulation or cut.index.size != size):
            continue
        index = cut.index[:size].copy()
        index[0] -= gap
        index = index if units is None else index / units
        is_start = (
            family.uncertain is not None
            and family.start is not None
            and _is_start_index(family.start, index, box.upper[0])
        )
        if box.lower[0] <= index[0] <= box.upper[0] and not is_start:
            rows.append((index[None], np.array([cut.row]), cut.family))
    return rows


def _is_start_index(start: Array, index: Array, last: float) -> bool:
    """Return whether an index is among the indices that a method begins with, up to the rounding of times up to
    ``last``."""
    return bool((np.abs(start - index).max(axis=1) <= SAME_TIME * abs(last)).any())


def index_units(program: SemiInfiniteProgram, cut: Cut) -> Array:
    """Return the value of one unit of each coordinate of a cut's index, in the user's units."""
    units = program.family(cut.family).index_units
    return np.ones(cut.index.size) if units is None else units
