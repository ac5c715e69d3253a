"""From a problem whose control answers what it measures to a program, exactly: nominal control and gains together."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import reduce
from typing import final

import numpy as np

from sparserob_core.control.constraints.control import STEP, Places, held_at, of_control
from sparserob_core.control.constraints.effort import FeedbackEffort
from sparserob_core.control.constraints.feedback import FeedbackConstraint, FeedbackControl
from sparserob_core.control.constraints.feedback_curved import FeedbackCurvedControl, of_state
from sparserob_core.control.constraints.flat import FlatConstraint
from sparserob_core.control.constraints.state import StateConstraint
from sparserob_core.control.feedback.closed_loop import ClosedLoop, deviations_of
from sparserob_core.control.feedback.innovations import Answers, answers, innovations_seen, unfelt
from sparserob_core.control.feedback.measurable import MeasurablePieces, measurable_pieces
from sparserob_core.control.feedback.observer import Observer, between, innovations_of
from sparserob_core.control.feedback.zonoid import has_corners
from sparserob_core.control.policies.policy import Charge, Policy
from sparserob_core.control.problem.dictionary import Dictionary
from sparserob_core.control.problem.problem import OptimalControlProblem
from sparserob_core.control.problem.units import Units, power_of_two
from sparserob_core.control.reach.measurable import MISSED
from sparserob_core.control.reach.sizes import widths
from sparserob_core.control.transcription.own_units import added_up, constraint_sides, extent, fixed, units_of_steps
from sparserob_core.control.transcription.program import EQUALS, ranges, transcribed
from sparserob_core.control.transcription.provable import hindrance
from sparserob_core.control.transcription.record import Acting, Feedback, Part, Posed, Transcription
from sparserob_core.control.transcription.telling import Telling
from sparserob_core.errors import InputError
from sparserob_core.shapes import read_only
from sparserob_core.sip.convex_set import Array, ConvexSet
from sparserob_core.sip.finite import Spread
from sparserob_core.sip.program import Formulation

PEAK, EFFORT = "peak", "effort"  # names of the families that are about the control
# Of the size of a row, what an entry of a deviation does to it at most that nothing answers. With a thousandth,
# programs with sets of 1e-12 fail; with ten times as much, costs are off by more than decision 0088 excuses.
STILL = 1e-9
# Of its unit, how far an entry deviates at least whose effects are variables as they are: those on less are numbers of
# 1e8 beside others of 1. With a millionth of it programs of initial states that deviate by 1e-8 fail.
SMALL = 2.0**-10
FINER = 2.0**-11  # of the numbers that are added up, the unit of an equality: it is met to `EQUALITY` of them


@final
@dataclass(frozen=True, eq=False)
class Seen:
    """What a control sees and answers, in one set of units: the coordinates of its ``answers``; the ``pieces`` on which
    measurable disturbances are the deviations, and the ``observer`` of outputs, where there are such; the terminal
    equalities, ``fixed``, as rows ``H x(T) <= h``, the second half of them the opposites of the first. ``still (Q,)``:
    which entries of the deviations do no more than doubles resolve.

    In own units ``deviations (Q,)``, what one of each is in the user's, and ``steps (r,)``, what the rows of the
    control's steps are divided by.
    """

    answers: Answers
    pieces: MeasurablePieces | None
    observer: Observer | None
    fixed: tuple[Array, Array]
    still: np.ndarray
    deviations: Array | None = None
    steps: Array | None = None


@final
@dataclass(frozen=True, eq=False)
class Answering(Acting):
    """A control that answers what it measures by a ``policy``, which answers what ``mask (K, K)`` says and is charged
    ``charge``: its constraints, and terminal equalities, hold for every deviation that is ``seen`` or not."""

    policy: Policy
    mask: np.ndarray
    charge: Charge
    seen: Seen
    first: tuple[Posed, Seen]
    """The problem in the own units in which this was seen first, and what was seen there."""
    formulation: Formulation = "reduced"

    @property
    def answers_by(self) -> Policy:
        """Its own."""
        return self.policy

    def in_own(self, theirs: Posed, own: Posed, units: Units) -> Answering:
        """With what is seen in own units."""
        seen = self.first[1] if own is self.first[0] else _seen(self.mask, theirs, own, units)[0]
        return replace(self, seen=seen)

    def from_state(self, model: Transcription, begun: Posed) -> Transcription:
        """With what is seen shared."""
        made = transcribed(begun, self)
        named = {family.name: family for family in model.program.families}
        families = [
            replace(
                one,
                explain=told.explain,
                row_units=told.row_units,
                index_units=told.index_units,
                measured=told.measured,
                along=told.along,
            )
            for one, told in ((one, named.get(one.name, one)) for one in made.program.families)
        ]
        return replace(made, program=replace(made.program, families=families, cost_unit=model.program.cost_unit))

    def free(self, model: Transcription) -> Transcription:
        """Charged the nominal control alone."""
        if self.charge.cost == "nominal":
            return model
        charge = replace(self.charge, cost="nominal", among=None)
        return replace(replace(self, charge=charge).from_state(model, model), given=model.given)

    def telling(self, own: Posed, units: Units) -> Telling:
        """With the deviations, which a literal index holds."""
        assert self.seen.deviations is not None
        return Telling(units, deviations=self.seen.deviations)

    def units_beside(self, own: Posed, units: Units) -> Array:
        """Those of the gains and of what is charged."""
        answers, deviations = self.seen.answers, self.seen.deviations
        assert deviations is not None
        peaks = np.repeat(units.controls, own.control.pieces)
        charged = {"nominal": peaks[:0], "peak": peaks, "worst": np.full(1, units.cost)}[self.charge.cost]
        return np.concatenate([units.controls[answers.channel] / deviations[answers.entry], charged])

    def part(self, posed: Posed) -> Part:
        """Families that hold for every deviation, gains, and what bounds the charge."""
        functionals, problem, pieces = posed.functionals, posed.problem, posed.control.pieces
        seen, gains, charge = self.seen, self.seen.answers, self.charge
        nominal, first = functionals.variables, functionals.variables + gains.variables
        size = first + {"nominal": 0, "peak": nominal, "worst": 1}[charge.cost]
        loop = ClosedLoop(
            functionals,
            gains,
            _spread(posed, seen.pieces, seen.still),
            size,
            seen.pieces,
            seen.observer,
            anew=_begins_anew(posed),
        )
        system, horizon = functionals.response.system, problem.horizon
        families = [of_state(constraint, loop).family() for constraint in posed.constraints]
        settled: list[Callable[[Array], Array]] = []
        if seen.fixed[1].size:
            ends = (problem.horizon, problem.horizon)
            equal = FeedbackConstraint(
                FlatConstraint(EQUALS, functionals, *seen.fixed, *ends, posed.parameters), loop, exact=True
            )
            families.append(equal.family())
            settled.append(equal.met)
        breakpoints = posed.control.breakpoints
        for name, convex, places in held_at(problem, breakpoints, answering=True):
            flat = convex.halfspaces()
            if flat is None:
                families.append(FeedbackCurvedControl(loop, convex, name, places).family())
                continue
            H, h = flat
            if places.steps and seen.steps is not None:
                H, h = H / seen.steps[:, None], h / seen.steps
            families.append(FeedbackControl(name, loop, places, H, h).family())
        axes, (low, high) = np.eye(problem.system.controls), ranges(problem.control)
        most = gains.share * (high - low)[gains.channel] / loop.spread.chords[gains.entry]
        far = np.repeat(np.maximum(np.abs(low), np.abs(high)), pieces)
        lower, upper, weights, largest = -most, most, None, None
        prices, peak = problem.prices(breakpoints).ravel(), replace(self, charge=replace(charge, cost="peak"))
        guide, among = None, None
        if charge.cost == "peak":
            both, every = np.vstack([axes, -axes]), Places.of_values(breakpoints, len(axes))
            peaks = FeedbackControl(PEAK, loop, every, both, np.zeros(len(both)), first)
            families.append(peaks.family())
            settled.append(peaks.settled)
            weights = np.concatenate([np.zeros(first), prices])
            lower, upper = np.append(lower, np.zeros(nominal)), np.append(upper, far)
        elif charge.cost == "worst":
            effort = FeedbackEffort(EFFORT, loop, prices, first)
            families.append(effort.family())
            settled.append(effort.settled)
            guide = (transcribed(posed, peak).program, first)
            weights = np.append(np.zeros(first), 1.0)
            largest = float(prices @ far)
            lower, upper = np.append(lower, 0.0), np.append(upper, 2.0 * largest)
        elif charge.among == "peak" and problem.cost.is_linear:
            among = (transcribed(posed, peak).program, first)
        return Part(
            families=[replace(one, hindrance=lambda low, high: hindrance(system, horizon)) for one in families],
            lower=lower,
            upper=upper,
            weights=weights,
            largest=largest,
            spread=loop.spread,
            settle=None if not settled else lambda x: reduce(lambda at, settle: settle(at), settled, x),
            guide=guide,
            among=among,
            feedback=Feedback(self.policy, self.mask, charge, loop),
        )


def answering(policy: Policy, mask: np.ndarray, posed: Posed, own: Posed, units: Units) -> Answering:
    """How a control acts by a policy in the user's units, from what it sees in its ``own`` ones."""
    scaled, outputs = _seen(mask, posed, own, units)
    assert scaled.deviations is not None
    pieces, observer = scaled.pieces, scaled.observer
    seen = Seen(
        answers=_in_users(scaled.answers, outputs, scaled.deviations),
        pieces=None if pieces is None else pieces.in_units_of(posed.functionals, units.states, units.disturbances),
        observer=None if observer is None else observer.in_units(units.states, outputs),
        fixed=_equal(*fixed(posed.problem)),
        still=scaled.still,
    )
    return Answering(policy, mask, policy.charge, seen, (own, scaled))


def _seen(mask: np.ndarray, theirs: Posed, own: Posed, units: Units) -> tuple[Seen, Array]:
    """What a control sees in ``own`` units, of a problem that is ``theirs`` in the user's, and what one of each of its
    outputs is in these."""
    problem, disturbance, begins = own.problem, own.functionals.disturbance, own.problem.initial_set is not None
    pieces = measurable_pieces(own.functionals)
    spread = _spread(own, pieces, None)
    still: np.ndarray = read_only(_still(own, spread))
    spread = replace(spread, still=still)
    blocks = 0 if disturbance is None else disturbance.block_count
    deviations = np.tile(units.disturbances[: problem.system.disturbances], blocks)
    deviations = deviations if pieces is None else np.ones(pieces.size)
    seen = innovations_seen(own.response, own.control, disturbance, begins, pieces)
    outputs, observer, begun = units.states, None, units.states[: len(units.states) * begins]
    if problem.measurements is not None and theirs.problem.measurements is not None:
        outputs = theirs.problem.measurements.units(units.states)
        radii = np.delete(spread.radii, np.arange(deviations.size, spread.size - begun.size))
        observer = Observer.of(problem.measurements, seen, between(own.response, own.control), radii)
        deviations = np.append(deviations, np.tile(outputs, own.control.pieces if observer.noisy else 0))
    anew = _begins_anew(own)
    deviations = np.concatenate([deviations, begun, *[begun] * anew])
    seen = innovations_of(seen, begun.size, observer, anew) * (spread.radii > 0.0)
    coordinates, (H, h) = answers(spread.within(seen), mask, problem.system.controls, seen), fixed(problem)
    small = (spread.radii > 0.0) & (spread.radii < SMALL)
    coordinates = coordinates.on(power_of_two(np.where(small, spread.radii, 1.0)))
    finer = FINER * power_of_two(np.maximum(added_up(problem, own.functionals), np.abs(h)))
    ends = _equal(H / finer[:, None], h / finer)
    return Seen(coordinates, pieces, observer, ends, still, deviations, _step_units(problem)), outputs


def _equal(H: Array, h: Array) -> tuple[Array, Array]:
    """Equalities as twice as many rows."""
    return np.vstack([H, -H]), np.append(h, -h)


def refuse(
    problem: OptimalControlProblem, control: Dictionary, disturbance: Dictionary, cost: str, uncertain: bool
) -> None:
    """Raise `InputError` for what a policy is not built for, in one sentence; ``uncertain``: the system has parameters,
    which may be states by now."""
    paths, classes = problem.windows, problem.classes
    sets = [entry.set for entry in paths] + problem.terminal_sets
    steps = [] if problem.control_step is None else [problem.control_step]
    curved = [one.kind for one in (*sets, problem.control, *steps) if one.halfspaces() is None]
    named = [entry.name for entry in paths if entry.name in (of_control(problem), PEAK, EFFORT, EQUALS, STEP)]
    bound, measurable = problem.disturbance, classes == {"measurable"}
    uncertainty = [one for one in (None if measurable else bound, problem.initial_set) if one is not None]
    slanted = [one.kind for one in uncertainty if _is_slanted(one)]
    leaning = [one.kind for one in uncertainty if fixed(problem)[1].size and Spread(((1, one),)).leans]
    reasons = {
        "control that can have any value on every piece: an answer to a measurement does not reach back before it": (
            not control.is_indicators
        ),
        "system without uncertain parameters: else what is measured is not the disturbance alone": uncertain,
        f"disturbance of one class, piecewise_constant or measurable, not {' and '.join(sorted(classes))}": len(classes)
        > 1
        or "l1_ball" in classes,
        "disturbance on the pieces of one dictionary, not on some of its own": problem.disturbance_breakpoints
        is not None,
        f"measurable disturbance in a set with known corners, which the {bound.kind if bound else ''} has not": bool(
            measurable and bound is not None and not has_corners(bound)
        ),
        f"set with flat sides for states and controls under measurable disturbances, which the "
        f"{' and the '.join(curved)} has not": measurable and bool(curved),
        "cost other than worst under measurable disturbances": measurable and cost == "worst",
        f"set of disturbances and of initial states with an interior, or with sides that can be listed, which the"
        f" {' and the '.join(slanted)} has not: a flat set is a box of its own coordinates, whose directions are the"
        " columns of E": bool(slanted),
        f"set of disturbances and of initial states with an interior, or of axes that are points, beside fixed final"
        f" states, which the {' and the '.join(leaning)} has not: a small box of final states does": bool(leaning),
        "disturbance that takes any value on each of its pieces": bool(classes)
        and not measurable
        and not disturbance.is_complete,
        f"path constraint of another name than {' or '.join(map(str, named))}, which is taken": bool(named),
        "terminal set with an interior under measurable disturbances: they reach a fixed state": measurable
        and bool(problem.terminal_equalities),
        "measurement of the whole state without noise under measurable disturbances": measurable
        and problem.measurements is not None,
        "control that acts at once under measurable disturbances, without a delay": measurable
        and problem.system.delay > 0.0,
        "single linear system under measurable disturbances, without pieces": measurable
        and bool(problem.system.switches),
        "whole state that is measured without noise where a plan with a control_step repeats": bool(problem.repeat)
        and problem.control_step is not None
        and problem.measurements is not None,
        f"cost of single channels where the policy is charged {cost}: without group": bool(problem.cost.blocks)
        and cost != "nominal",
    }
    for wanted, hindered in reasons.items():
        if hindered:
            raise InputError(f"feedback needs a {wanted}", path="policy.name")


def _is_slanted(convex: ConvexSet) -> bool:
    """Whether a set has no length along an axis within its span, though it deviates along it: then no gain on that
    entry of a deviation is bounded."""
    spread = Spread(((1, convex),))
    return bool(((spread.chords <= 0.0) & (spread.radii > 0.0)).any())


def _in_users(own: Answers, measured: Array, deviations: Array) -> Answers:
    """The same coordinates of gains in the user's units, in which one of what is ``measured (d,)`` and of the
    ``deviations (Q,)`` is that; powers of two change no number but its exponent."""
    _, _, Q, d = own.shape
    at, which, value = own.effect
    effect = (at, which, value * deviations[own.entry[which]] / deviations[at % Q])
    at, which, value = own.gain
    gain = (at, which, value * deviations[own.entry[which]] / measured[at % d])
    return replace(own, effect=effect, gain=gain)


def _spread(posed: Posed, acting: MeasurablePieces | None, still: np.ndarray | None) -> Spread:
    """The deviations of a problem's disturbance and of its initial state, of which some entries are ``still (Q,)``."""
    problem, disturbance, periods = posed.problem, posed.functionals.disturbance, 1 + _begins_anew(posed)
    if acting is not None:
        sets = (*acting.sets, *deviations_of(None, 0, problem.initial_set, periods=periods).sets)
        return Spread(sets, MISSED, still)
    blocks = 0 if disturbance is None else disturbance.block_count
    noise = None if problem.measurements is None else problem.measurements.noise
    found = deviations_of(problem.disturbance, blocks, problem.initial_set, noise, posed.control.pieces, periods)
    return replace(found, still=still)


def _still(own: Posed, spread: Spread) -> np.ndarray:
    """Which entries ``(Q,)`` of the disturbance, and of the initial state, do no more to any row than doubles resolve
    of what the row keeps (decision 0088): gains on these would be without measure. All of a set, or of a box a
    coordinate, at all times: beside one that is answered others like it count. None beside fixed final states, which
    hold at every deviation."""
    found, model = np.zeros(spread.size, dtype=bool), own.functionals.disturbance
    if fixed(own.problem)[1].size:
        return found
    held = None if model is None or model.kind != "piecewise_constant" else own.problem.disturbance
    sets = [held, own.problem.initial_set]
    far, begun = (np.zeros(0) if one is None else one.width(np.eye(one.dimension)) for one in sets)
    rows = _rows_in_sizes(own.constraints, own.problem.system.states)
    still = unfelt(own.response, None if held is None else model, far, begun, rows, STILL)
    if held is not None and model is not None:
        entries = _at_all_times(held, still[: still.size - begun.size])
        found[: still.size - begun.size] = np.tile(entries, model.block_count)
    if own.problem.initial_set is not None:
        periods = 1 + _begins_anew(own)
        entries = _at_all_times(own.problem.initial_set, still[still.size - begun.size :])
        found[spread.size - begun.size * periods :] = np.tile(entries, periods)
    return found


def _at_all_times(convex: ConvexSet, still: np.ndarray) -> np.ndarray:
    """Which coordinates ``(q,)`` of points of a set are still where their entries are, one point after another; of a
    set that is no box all of them or none."""
    entries = np.asarray(still.reshape(-1, convex.dimension).all(axis=0))
    return entries if convex.is_box else np.full(convex.dimension, entries.all())


def _rows_in_sizes(constraints: Sequence[StateConstraint], d: int) -> Array:
    """Rows ``(k, d)`` on the state, in multiples of what a user reads of them: the larger of bound and width, of a
    curved set those along the axes. Whose size is 0 alone stands in its unit."""
    found = [np.zeros((0, d))]
    for one in constraints:
        if one.sides is not None:
            normals, (H, h) = one.sides[0], constraint_sides(one)
            width = widths(H, h)
            sizes = np.maximum(np.abs(h), np.where(np.isfinite(width), width, 0.0))
        else:
            assert one.shape is not None
            normals = np.eye(one.shape.dimension)
            sizes = np.maximum(extent(one.shape), one.shape.width(normals))
        found.append(normals / np.where(sizes > 0.0, sizes, 1.0)[:, None])
    return np.vstack(found)


def _begins_anew(posed: Posed) -> bool:
    """Whether the initial state of the next period is seen in this one's program: by the step across the seam."""
    problem = posed.problem
    return problem.control_step is not None and bool(problem.repeat) and problem.initial_set is not None


def _step_units(problem: OptimalControlProblem) -> Array | None:
    """The units ``(r,)`` of the rows of the control's steps; ``None`` where these are free, or their set is curved."""
    step = problem.control_step
    flat = None if step is None else step.halfspaces()
    return None if step is None or flat is None else units_of_steps(step, *flat, problem.control)
