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
from sparserob_core.control.loop.remaining import refuse_remaining, remaining
from sparserob_core.control.loop.retuning import Retuning, retuned
from sparserob_core.control.loop.tracking import Tracking, trackable
from sparserob_core.control.problem.units import Units
from sparserob_core.control.response.response import SAME_TIME
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


@final
@dataclass(frozen=True, eq=False)
class Plan:
    """A proven decision ``(n,)`` of a transcribed problem, whose time 0 is the beginning of piece ``first`` of the
    control that it is a plan for; ``cuts`` are the constraints that mattered. ``known`` is the problem, or the same one
    from another initial state than its own, ``state (d,)``."""

    known: Transcription
    decision: Array
    first: int = 0
    cuts: Sequence[Cut] = ()
    state: Array | None = None

    @cached_property
    def model(self) -> Transcription:
        """The transcribed problem; written down when it is asked for, since a controller does without it."""
        return self.known if self.state is None else from_state(self.known, self.state)

    def reach(self, piece: int, state: Array, control: Array) -> tuple[Array, Array] | None:
        """The least and the largest of every state ``(d,)`` to which a piece that begins in ``state (d,)`` may lead
        under a ``control (m,)``; ``None`` where that is not told from one piece alone."""
        problem, response = self.known.problem, self.known.response
        if problem.system.parameters is not None or problem.system.delay > 0.0 or problem.system.switches:
            return None
        if problem.names.corners:  # parameters beside the time are states by now, that nobody measures
            return None
        if problem.classes - {"piecewise_constant"}:
            return None
        steps, grid = response.steps(KNOWN), response.grid
        acting, pushes, middle = np.append(control, np.ones(grid.constants)), list[Array](), state
        for number in np.flatnonzero(grid.control_piece == piece).tolist():
            Phi, Gamma = (part[0, int(response.which[number])] for part in (steps.Phi, steps.Gamma))
            B, E = (grid.of_modes(part[0])[int(grid.modes[number])] for part in (steps.B, steps.E))
            middle = Phi @ middle + Gamma @ (B @ acting)
            pushes = [Phi @ push for push in pushes] + [Gamma @ E]
        lower, upper = middle, middle
        if problem.disturbance is not None:
            for push in pushes:
                upper, lower = upper + problem.disturbance.support(push), lower - problem.disturbance.support(-push)
        return lower, upper

    def added(self, piece: int, control: Array) -> Array:
        """What a ``control (m,)`` on a piece drives every state by, ``(d,)``, if nothing else did: of an integral of
        controls alone, what it adds to it."""
        response, found = self.known.response, np.zeros(self.known.problem.system.states)
        grid, system = response.grid, response.system
        for number in np.flatnonzero(grid.control_piece == piece).tolist():
            if grid.varying:  # whose pieces are its modes
                B = grid.of_modes(response.steps(self.known.parameters.middle[None]).B[0])[number]
            else:
                mode = system.modes[int(grid.modes[number])]
                B = mode.matrices(mode.probes[:1])[1][0]
            found = found + grid.lengths[number] * (B[: found.size, : control.size] @ control)
        return found

    def caused(self, piece: int, state: Array, control: Array, after: Array) -> tuple[int, Array, Array, float] | None:
        """What the disturbance was on a piece that led from ``state (d,)`` to ``after (d,)`` under a ``control (m,)``:
        the number of its own piece, its value ``(mw,)``, what of the state that leaves unexplained ``(d,)``, and by how
        much at most an error of the state grows in the value; ``None`` where the state does not tell it."""
        problem, response, signal = self.known.problem, self.known.response, self.known.functionals.disturbance
        numbers = np.flatnonzero(response.grid.control_piece == piece).tolist()
        if response.propagator.laws is not None:  # which parameters did it is not known
            return None
        if problem.disturbance is None or signal is None or signal.starts is None or len(numbers) != 1:
            return None
        steps, length = response.steps(KNOWN), int(response.which[numbers[0]])
        Phi, Gamma = steps.Phi[0, length], steps.Gamma[0, length]
        seen = self.known.stated.system.states
        pushed = (Gamma @ steps.E[0])[:seen]
        sizes = np.linalg.svd(pushed, compute_uv=False)
        if pushed.shape[0] < pushed.shape[1] or not sizes[-1] > DEPENDENT * sizes[0]:
            return None
        driven = steps.B[0] @ np.append(control, np.ones(response.grid.constants))
        moved = (after - Phi @ state - Gamma @ driven)[:seen]
        value = np.linalg.lstsq(pushed, moved, rcond=None)[0]
        block = int(np.searchsorted(signal.starts, numbers[0], side="right")) - 1
        return block, value, moved - pushed @ value, 1.0 / float(sizes[-1])

    def drawn_in(self, control: Array, nominal: Array) -> Array:
        """A control ``(m,)`` within the set of controls: as it is, but for rounding, where the proof covers what was
        measured."""
        bound = self.known.problem.control
        flat = bound.halfspaces()
        if bound.is_box:
            box = bound.bounding_box()
            return np.clip(control, box.lower, box.upper)
        if flat is None or float(bound.violation(control)) <= 0.0:
            return control
        H, h = flat
        rise, room = H @ (control - nominal), np.maximum(h - H @ nominal, 0.0)
        share = np.divide(room, rise, out=np.ones_like(room), where=rise > 0.0).min(initial=1.0)
        return np.asarray(nominal + min(1.0, float(share)) * (control - nominal))

    def left(self, piece: int, innovations: Sequence[Array]) -> Array:
        """The nominal control ``(m, K')`` that is left from piece ``piece`` of this plan on, when nothing more happens
        than what was seen: one innovation ``(d,)`` for each breakpoint so far."""
        nominal = self.known.pieces(self.decision)[:, piece:]
        feedback = self.known.feedback
        if feedback is None:
            return nominal
        gains = feedback.loop.gains(self.decision)[piece:, : len(innovations)]
        return np.asarray(nominal + np.einsum("kjmd,jd->mk", gains, np.array(innovations)))

    def cost_left(self, piece: int, innovations: Sequence[Array]) -> float:
        """The cost of that under feedback: of the nominal control, or of its peaks over what may still happen."""
        feedback, problem = self.known.answering, self.known.problem
        nominal, spread = self.left(piece, innovations), feedback.loop.spread
        size = np.abs(nominal)
        if feedback.charge.cost == "peak":
            effects = feedback.loop.effects(self.decision)[piece:].copy()
            begin, grid = float(self.known.control.breakpoints[piece]), self.known.response.grid
            acting = feedback.loop.entries[grid.breakpoints[1:] > begin]  # (L', mw, Q): which deviations act later
            effects[:, :, np.abs(acting).sum(axis=(0, 1)) == 0.0] = 0.0
            size = np.maximum(nominal.T + spread.support(effects), -nominal.T + spread.support(-effects)).T
        return float((problem.prices(self.known.control.breakpoints)[:, piece:] * size).sum())


@final
@dataclass(frozen=True, eq=False)
class Solved:
    """What a re-solve gave: a ``plan``, or none that is proven, its ``cost`` and the ``lower`` bound of it, and whether
    it is ``cheaper`` than what the last plan has left."""

    plan: Plan | None
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
        self._kept: dict[int, tuple[Transcription, Transcription, Units]] = {}
        self._tracking: dict[int, Tracking | None] = {}
        self._retuning: list[Retuning] = []
        self._took, self._pieces = 0.0, model.control.pieces  # a whole program, and the pieces that it had
        self._again: Array | None = None  # with what the next period begins, of a plan that repeats
        self._written = 0.0  # what it takes to write a whole program down, however few pieces are left

    def prepare(self, plan: Plan) -> None:
        """Make what steps with a limit are not to wait for, for the plan that loops begin with; nothing without a
        limit."""
        self._again = plan.known.pieces(plan.decision)[:, 0]
        if self._seconds is None:
            return
        state, began = np.asarray(self._model.problem.initial_state, dtype=float), clock.perf_counter()
        remaining(self._model, 0, state, None)
        self._written = clock.perf_counter() - began
        self._took = WHOLE * self._written
        if self._model.feedback is not None:
            retuning = Retuning(plan.known, plan.decision)
            retuning.prepare(state)
            self._retuning = [retuning]
            return
        if self._model.problem.control_step is None:
            for piece in range(self._model.control.pieces):
                if self._tracker(piece, state) is None and self._written > self._seconds:
                    return  # those that are left are never begun

    def _in_time(self, piece: int) -> bool:
        """Whether a whole program from a piece on is expected to end within the limit."""
        pieces = self._model.control.pieces - piece
        needed = max(self._written, self._took * (pieces / self._pieces) ** 2)
        return self._seconds is None or needed <= self._seconds

    def answer(
        self, plan: Plan, piece: int, state: Array, before: Array | None, innovations: Sequence[Array]
    ) -> Solved:
        """The best of what is left from piece ``piece`` of the whole control on, compared with what ``plan`` has left
        after what was seen; the state ``(d,)`` is measured, ``before (m,)`` is the last control. Nothing where no
        answer is proven."""
        deadline = Deadline(self._seconds)
        tools = replace(self._tools, deadline=deadline, notify=ignore)
        try:
            found = (self._fixed if self._model.feedback is None else self._feedback)(
                plan, piece, state, before, innovations, tools
            )
        except (
            SparseRobError,
            OutOfTime,
        ):  # a state from which nothing is to be had; what the last plan has left is proven
            found = Solved(None)
        if deadline.pressed:
            raise KeyboardInterrupt
        return found

    def _feedback(
        self,
        plan: Plan,
        piece: int,
        state: Array,
        before: Array | None,
        innovations: Sequence[Array],
        tools: Tools,
    ) -> Solved:
        tools.deadline.check()
        tuned, pieces = self._tuned(plan, piece, state, innovations), self._model.control.pieces - piece
        if not self._in_time(piece):
            return tuned
        began, whole = clock.perf_counter(), Solved(None)
        with suppress(SparseRobError, OutOfTime):
            model = remaining(self._model, piece, state, before)
            gap = float(self._model.control.breakpoints[piece] - self._model.control.breakpoints[plan.first])
            result = answered_in_own_units(partial(self._begun, plan.cuts, gap), model.program, tools)
            known = plan.cost_left(piece - plan.first, innovations)
            whole = self._judged(model, result, piece, result.decision, result.cost, result.lower_bound, known)
        self._took, self._pieces = clock.perf_counter() - began, pieces
        if whole.plan is None:
            self._took *= 2.0  # it needs more than it had
        if tuned.plan is None or (whole.plan is not None and whole.cost <= tuned.cost):
            return whole
        return replace(tuned, lower=whole.lower)

    def _begun(self, cuts: Sequence[Cut], gap: float, program: SemiInfiniteProgram, tools: Tools) -> Result:
        """The exchange of a program in its own units that begins ``gap`` later than where these ``cuts`` mattered."""
        return self._method.close(program, tools, prover_of(program, tools), shifted(cuts, gap, program))

    def _tuned(self, plan: Plan, piece: int, state: Array, innovations: Sequence[Array]) -> Solved:
        """The same gains with the best nominal control for them, where `Retuning` knows such problems."""
        retuning = next((one for one in self._retuning if one.model is plan.known), None)
        if retuning is None:
            if self._seconds is not None and self._written > self._seconds:
                return Solved(None)
            retuning = Retuning(plan.known, plan.decision)
            self._retuning = [*self._retuning[:1], retuning]  # that of the plan that loops begin with, and the last
        begun = piece - plan.first
        found = retuning.solve(begun, state)
        if found is None:
            return Solved(None)
        decision = retuned(plan.known, plan.decision, begun, plan.left(begun, innovations), found.decision)
        tuned = replace(plan, decision=decision)
        cost, known = (one.cost_left(begun, innovations) for one in (tuned, plan))
        return Solved(tuned, cost, cheaper=is_cheaper(cost, known))

    def _fixed(
        self,
        plan: Plan,
        piece: int,
        state: Array,
        before: Array | None,
        innovations: Sequence[Array],
        tools: Tools,
    ) -> Solved:
        quick = self._tracked(plan, piece, state, innovations)
        if quick is not None:
            return quick
        tools.deadline.check()
        if not self._in_time(piece):
            return Solved(None)
        began = clock.perf_counter()
        try:
            return self._closed(plan, piece, state, before, innovations, tools)
        finally:
            self._took, self._pieces = clock.perf_counter() - began, self._model.control.pieces - piece

    def _closed(
        self,
        plan: Plan,
        piece: int,
        state: Array,
        before: Array | None,
        innovations: Sequence[Array],
        tools: Tools,
    ) -> Solved:
        """The program of what is left, closed by the exchange."""
        model, own, units = self._own(piece, state, before)
        program = own.program
        gap = float(self._model.control.breakpoints[piece] - self._model.control.breakpoints[plan.first])
        result = self._method.close(
            program,
            tools,
            prover_of(program, replace(tools, notify=ignore)),
            shifted(plan.cuts, gap, program),
        )
        theirs = np.repeat(units.controls, own.control.functions)
        decision = None if result.decision is None else result.decision * theirs
        tail = plan.left(piece - plan.first, innovations).ravel() / theirs
        known = units.cost * float(program.cost(tail))
        cuts = tuple(replace(cut, index=cut.index * index_units(program, cut)) for cut in result.indices)
        result = replace(result, indices=cuts)
        return self._judged(
            model, result, piece, decision, units.cost * result.cost, units.cost * result.lower_bound, known
        )

    def _tracked(self, plan: Plan, piece: int, state: Array, innovations: Sequence[Array]) -> Solved | None:
        """The answer of `Tracking` where it knows such problems and closes the gap."""
        if self._model.problem.control_step is not None:
            return None
        late = self._seconds is not None and self._written > self._seconds and piece not in self._tracking
        tracking = None if late else self._tracker(piece, state)
        if tracking is None:
            return None
        model, own, units = self._prepared(piece, state)
        found = tracking.solve(state / units.states)
        if found is None:
            return None
        if relative_gap(found.lower, found.cost, own.program.added(found.decision)) > self._method.tolerance:
            return None
        theirs = np.repeat(units.controls, own.control.functions)
        known = float(own.program.cost(plan.left(piece - plan.first, innovations).ravel() / theirs))
        decision, cost = found.decision * theirs, units.cost * found.cost
        return Solved(
            Plan(model, decision, piece, state=state.copy()),
            cost,
            units.cost * found.lower,
            is_cheaper(found.cost, known),
        )

    def _tracker(self, piece: int, state: Array) -> Tracking | None:
        """What solves from a piece on, where it knows such problems."""
        if piece not in self._tracking:
            own = self._prepared(piece, state)[1]
            self._tracking[piece] = Tracking(own) if trackable(own) else None
        return self._tracking[piece]

    def _prepared(self, piece: int, state: Array) -> tuple[Transcription, Transcription, Units]:
        """What is left, from the first state that was asked for, in the user's units and in its own."""
        if piece not in self._kept:
            model = remaining(self._model, piece, state, None)
            self._kept[piece] = (model, *in_own_units(model))
        return self._kept[piece]

    def _own(self, piece: int, state: Array, before: Array | None) -> tuple[Transcription, Transcription, Units]:
        """What is left, in the user's units and in its own."""
        if self._model.problem.control_step is not None:
            model = remaining(self._model, piece, state, before, again=self._again)
            return (model, *in_own_units(model))
        model, own, units = self._prepared(piece, state)
        return from_state(model, state), from_state(own, state / units.states), units

    def _judged(
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
        return Solved(Plan(model, decision, piece, result.indices), cost, lower, is_cheaper(cost, known))


def is_cheaper(cost: float, known: float) -> bool:
    """Whether a cost is less than a known one by more than rounding."""
    return cost < known - BETTER * max(abs(known), abs(cost))


def shifted(cuts: Sequence[Cut], gap: float, program: SemiInfiniteProgram) -> Violated:
    """Cuts in the user's units as rows of a program in its own that begins ``gap`` later; those of the past, and of
    constraints that are over, are left out. Where a program holds for every deviation they are times, with all rows."""
    families = {family.name: family for family in program.families}
    found = []
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
        begun = family.uncertain is not None and family.start is not None and _holds(family.start, index, box.upper[0])
        if box.lower[0] <= index[0] <= box.upper[0] and not begun:
            found.append((index[None], np.array([cut.row]), cut.family))
    return found


def _holds(start: Array, index: Array, last: float) -> bool:
    """Whether an index is among those that a method begins with, but for the rounding of times up to ``last``."""
    return bool((np.abs(start - index).max(axis=1) <= SAME_TIME * abs(last)).any())


def index_units(program: SemiInfiniteProgram, cut: Cut) -> Array:
    """What one of each coordinate of a cut's index is in the user's units."""
    units = program.family(cut.family).index_units
    return np.ones(cut.index.size) if units is None else units
