"""Exact transcription of a problem whose control answers measurements: one program for the nominal control and the
gains."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import reduce
from typing import final

import numpy as np
import numpy.typing as npt

from sparserob_core.control.combinations import refuse_cases
from sparserob_core.control.constraints.control import STEP, Places, held_at, of_control
from sparserob_core.control.constraints.effort import FeedbackEffort
from sparserob_core.control.constraints.feedback import FeedbackConstraint, FeedbackControl
from sparserob_core.control.constraints.feedback_curved import FeedbackCurvedControl
from sparserob_core.control.constraints.flat import FlatConstraint
from sparserob_core.control.constraints.state import StateConstraint
from sparserob_core.control.feedback.closed_loop import ClosedLoop, deviations_of
from sparserob_core.control.feedback.innovations import Answers, answers, build_innovations, find_negligible_entries
from sparserob_core.control.feedback.observer import Observer, between, innovations_of
from sparserob_core.control.feedback.prestabilised import SampledPlant, StateRows
from sparserob_core.control.policies.policy import Charge, InnerGain, Policy
from sparserob_core.control.problem.dictionary import Dictionary
from sparserob_core.control.problem.problem import OptimalControlProblem
from sparserob_core.control.problem.terms.windows import end_of
from sparserob_core.control.problem.units import Units, power_of_two
from sparserob_core.control.reach.sizes import row_sizes
from sparserob_core.control.response.inner_loop import InnerLoop
from sparserob_core.control.transcription.own_units import added_up, constraint_sides, fixed, units_of_steps
from sparserob_core.control.transcription.program import EQUALS, build_program, held_nominally, ranges
from sparserob_core.control.transcription.provable import hindrance
from sparserob_core.control.transcription.record import Acting, Feedback, Posed, ProgramPart, Transcription
from sparserob_core.control.transcription.telling import Telling
from sparserob_core.errors import InputError
from sparserob_core.shapes import read_only
from sparserob_core.sip.convex_set import Array, ConvexSet
from sparserob_core.sip.finite import Spread
from sparserob_core.sip.program import Formulation

PEAK, EFFORT = "peak", "effort"  # names of the families that are about the control
# Largest effect on a row, relative to its size, of an entry of the deviations that no gain answers. With a thousandth,
# programs with sets of 1e-12 fail; with ten times as much, costs are off by more than decision 0088 excuses.
NEGLIGIBLE_EFFECT = 1e-9
# Least deviation of an entry, in its unit, whose effects are variables in this unit; those of smaller ones are
# rescaled, since they would be numbers of 1e8 beside others of 1. With a millionth of it programs of initial states
# that deviate by 1e-8 fail.
LEAST_DEVIATION = 2.0**-10
FINER = 2.0**-11  # of the numbers that are added up, the unit of an equality: it is met to `EQUALITY` of them


@final
@dataclass(frozen=True, eq=False)
class AnsweredMeasurements:
    """Measurements that a control answers, in one set of units.

    ``answers``: the coordinates of the gains. ``observer``: the observer of outputs, ``None`` where the state is
    measured. ``fixed``: the terminal equalities as rows ``H x(T) <= h``; the second half of the rows are the opposites
    of the first. ``still (Q,)``: true for entries of the deviations whose effect double precision does not resolve.

    In own units there are two more fields. ``deviations (Q,)``: one unit of each deviation, in the user's units.
    ``steps (r,)``: the divisors of the rows of the control's steps.
    """

    answers: Answers
    observer: Observer | None
    fixed: tuple[Array, Array]
    still: np.ndarray
    deviations: Array | None = None
    steps: Array | None = None


@final
@dataclass(frozen=True, eq=False)
class FeedbackModel(Acting):
    """Control that answers measurements by a ``policy``. ``mask (K, K)`` says which piece answers which measurement,
    and ``charge`` says which cost the policy is chosen by. The constraints and terminal equalities hold for every
    deviation, whether it is measured or not."""

    policy: Policy
    mask: np.ndarray
    charge: Charge
    measurements: AnsweredMeasurements
    first: tuple[Posed, AnsweredMeasurements]
    """Problem in the own units in which the measurements were computed first, and these measurements."""
    formulation: Formulation = "reduced"

    @property
    def answers_by(self) -> Policy:
        """Policy by which the control answers measurements."""
        return self.policy

    def in_own(self, theirs: Posed, own: Posed, units: Units) -> FeedbackModel:
        """Return this control with its measurements in the problem's ``own`` units.

        In other own units than the first ones, the coordinates of the gains stay those of the user's units: a decision
        is converted entry by entry.
        """
        if own is self.first[0]:
            return replace(self, measurements=self.first[1])
        built, outputs = _build_measurements(self.mask, theirs, own, units)
        assert built.deviations is not None
        answers = _scale_to_user_units(self.measurements.answers, 1.0 / outputs, 1.0 / built.deviations)
        return replace(self, measurements=replace(built, answers=answers))

    def widen(self, posed: Posed, around: Array) -> Posed:
        """Return the problem with the range that the decided part of the control has from its initial state, and from
        those around it. With an inner loop this range depends on the state."""
        inner = posed.response.inner
        if not inner.acts:
            return posed
        reach = _bound_inner_loop(posed, _sample_plant(posed), inner.gains, around)
        control = held_nominally(posed.problem, replace(inner, reach=reach)).control
        return replace(posed, held=replace(posed.held, control=control))

    def from_state(self, model: Transcription, posed: Posed) -> Transcription:
        """Return the program of the same problem from another initial state; it shares the record of the measurements,
        and the explanations of the families, with the program of ``model``."""
        transcription = build_program(posed, self)
        named = {family.name: family for family in model.program.families}
        families = [
            replace(
                family,
                explain=source.explain,
                row_units=source.row_units,
                index_units=source.index_units,
                measured=source.measured,
                along=source.along,
            )
            for family, source in (
                (family, named.get(family.name, family)) for family in transcription.program.families
            )
        ]
        return replace(
            transcription, program=replace(transcription.program, families=families, cost_unit=model.program.cost_unit)
        )

    def free(self, model: Transcription) -> Transcription:
        """Return the program in which only the nominal control is charged."""
        if self.charge.cost == "nominal":
            return model
        charge = replace(self.charge, cost="nominal", among=None)
        return replace(replace(self, charge=charge).from_state(model, model), given=model.given)

    def telling(self, own: Posed, units: Units) -> Telling:
        """Return the conversion to the user's units, with the units of the deviations that end a literal index."""
        assert self.measurements.deviations is not None
        return Telling(units, deviations=self.measurements.deviations)

    def compute_extra_units(self, own: Posed, units: Units) -> Array:
        """Return one unit of each gain, and of each variable that is charged, in the user's units."""
        answers, deviations = self.measurements.answers, self.measurements.deviations
        assert deviations is not None
        peaks = np.repeat(units.controls, own.control.pieces)
        of_nominal = peaks if own.response.inner.acts else peaks[:0]
        charged = {"nominal": of_nominal, "peak": peaks, "worst": np.full(1, units.cost)}[self.charge.cost]
        return np.concatenate([units.controls[answers.channel] / deviations[answers.entry], charged])

    def _count_charged(self, nominal: int, acts: bool) -> int:
        """Return the number of variables that bound what is charged, for so many ``nominal`` entries of the control.
        Where an inner loop ``acts``, the nominal control is no entry of the decision, and is bounded by variables."""
        return {"nominal": nominal * acts, "peak": nominal, "worst": 1}[self.charge.cost]

    def part(self, posed: Posed) -> ProgramPart:
        """Return the families that hold for every deviation, the gains with their bounds, and the variables that bound
        the charge."""
        functionals, problem, pieces = posed.functionals, posed.problem, posed.control.pieces
        measurements, gains, charge = self.measurements, self.measurements.answers, self.charge
        nominal, first = functionals.variables, functionals.variables + gains.variables
        size = first + self._count_charged(nominal, functionals.response.inner.acts)
        loop = ClosedLoop(
            functionals,
            gains,
            _collect_deviations(posed, measurements.still),
            size,
            measurements.observer,
            anew=_has_next_initial_state(posed),
        )
        families = [FeedbackConstraint.of(constraint, loop).family() for constraint in posed.constraints]
        settle_functions: list[Callable[[Array], Array]] = []
        if measurements.fixed[1].size:
            ends = (problem.horizon, problem.horizon)
            equal = FeedbackConstraint(
                FlatConstraint(EQUALS, functionals, *measurements.fixed, *ends, posed.parameters), loop, exact=True
            )
            families.append(equal.family())
            settle_functions.append(equal.met)
        breakpoints = posed.control.breakpoints
        for name, convex, places in held_at(problem, breakpoints, answering=True):
            flat = convex.halfspaces()
            if flat is None:
                families.append(FeedbackCurvedControl(name, loop, places, convex).family())
                continue
            H, h = flat
            if places.steps and measurements.steps is not None:
                H, h = H / measurements.steps[:, None], h / measurements.steps
            families.append(FeedbackControl(name, loop, places, H, h).family())
        axes, (low, high) = np.eye(problem.system.controls), ranges(problem.control)
        widths = np.subtract(*reversed(ranges(posed.held.control))) + 2.0 * loop.widest
        gain_bounds = gains.share * widths[gains.channel] / loop.spread.chords[gains.entry]
        magnitudes = np.repeat(np.maximum(np.abs(low), np.abs(high)), pieces)
        lower, upper, weights, largest = -gain_bounds, gain_bounds, None, None
        prices, peak = problem.prices(breakpoints).ravel(), replace(self, charge=replace(charge, cost="peak"))
        guide, among = None, None
        if charge.cost == "peak" or (charge.cost == "nominal" and loop.inner.acts):
            directions, all_places = np.vstack([axes, -axes]), Places.of_values(breakpoints, len(axes))
            limits, is_nominal = np.zeros(len(directions)), charge.cost == "nominal"
            peaks = FeedbackControl(PEAK, loop, all_places, directions, limits, first, nominal=is_nominal)
            families.append(peaks.family())
            settle_functions.append(peaks.settled)
            weights = np.concatenate([np.zeros(first), prices])
            lower, upper = np.append(lower, np.zeros(nominal)), np.append(upper, magnitudes)
        elif charge.cost == "worst":
            effort = FeedbackEffort(EFFORT, loop, prices, first)
            families.append(effort.family())
            settle_functions.append(effort.settled)
            guide = (build_program(posed, peak).program, first)
            weights = np.append(np.zeros(first), 1.0)
            largest = float(prices @ magnitudes)
            lower, upper = np.append(lower, 0.0), np.append(upper, 2.0 * largest)
        elif charge.among == "peak" and problem.cost.is_linear:
            among = (build_program(posed, peak).program, first)
        return ProgramPart(
            families=[
                replace(family, hindrance=lambda low, high: hindrance(functionals.response, problem.horizon))
                for family in families
            ],
            lower=lower,
            upper=upper,
            weights=weights,
            largest=largest,
            spread=loop.spread,
            settle=None
            if not settle_functions
            else lambda x: reduce(lambda at, settle: settle(at), settle_functions, x),
            guide=guide,
            among=among,
            feedback=Feedback(self.policy, self.mask, charge, loop),
        )


def answering(policy: Policy, mask: np.ndarray, posed: Posed, own: Posed, units: Units) -> FeedbackModel:
    """Return the control that acts by a policy in the user's units, from its measurements in the problem's ``own``
    units."""
    scaled, outputs = _build_measurements(mask, posed, own, units)
    assert scaled.deviations is not None
    observer = scaled.observer
    measurements = AnsweredMeasurements(
        answers=_scale_to_user_units(scaled.answers, outputs, scaled.deviations),
        observer=None if observer is None else observer.in_units(units.states, outputs),
        fixed=_split_equalities(*fixed(posed.problem)),
        still=scaled.still,
    )
    return FeedbackModel(policy, mask, policy.charge, measurements, (own, scaled))


def _build_measurements(
    mask: np.ndarray, theirs: Posed, own: Posed, units: Units
) -> tuple[AnsweredMeasurements, Array]:
    """Return the measurements that a control answers, in ``own`` units, and one unit of each measured output in the
    user's units. ``theirs`` is the problem in the user's units."""
    problem, disturbance, has_initial_set = (
        own.problem,
        own.functionals.disturbance,
        own.problem.initial_set is not None,
    )
    spread = _collect_deviations(own, None)
    still: np.ndarray = read_only(_find_ineffective_entries(own, spread))
    spread = replace(spread, still=still)
    blocks = 0 if disturbance is None else disturbance.block_count
    deviations = np.tile(units.disturbances[: problem.system.disturbances], blocks)
    innovations = build_innovations(own.response, own.control, disturbance, has_initial_set)
    output_units, observer, initial_units = units.states, None, units.states[: len(units.states) * has_initial_set]
    if problem.measurements is not None and theirs.problem.measurements is not None:
        output_units = theirs.problem.measurements.units(units.states)
        radii = np.delete(spread.radii, np.arange(deviations.size, spread.size - initial_units.size))
        flows, breakpoints = between(own.response, own.control), own.control.breakpoints
        observer = Observer.of(problem.measurements, innovations, flows, radii, breakpoints)
        deviations = np.append(deviations, np.tile(output_units, own.control.pieces if observer.noisy else 0))
    begins_anew = _has_next_initial_state(own)
    deviations = np.concatenate([deviations, initial_units, *[initial_units] * begins_anew])
    innovations, _ = innovations_of(innovations, initial_units.size, observer, begins_anew)
    innovations = innovations * (spread.radii > 0.0)
    coordinates, (H, h) = (
        answers(spread.within(innovations), mask, problem.system.controls, innovations),
        fixed(problem),
    )
    is_small = (spread.radii > 0.0) & (spread.radii < LEAST_DEVIATION)
    coordinates = coordinates.on(power_of_two(np.where(is_small, spread.radii, 1.0)))
    equality_units = FINER * power_of_two(np.maximum(added_up(problem, own.functionals), np.abs(h)))
    ends = _split_equalities(H / equality_units[:, None], h / equality_units)
    return AnsweredMeasurements(coordinates, observer, ends, still, deviations, _step_units(problem)), output_units


def _split_equalities(H: Array, h: Array) -> tuple[Array, Array]:
    """Return equalities ``H x = h`` as twice as many inequalities."""
    return np.vstack([H, -H]), np.append(h, -h)


def refuse(
    problem: OptimalControlProblem, control: Dictionary, disturbance: Dictionary, cost: str, uncertain: bool
) -> None:
    """Raise `InputError` for what a policy is not built for, in one sentence; ``uncertain``: the system has parameters,
    which may be states by now."""
    paths, classes = problem.windows, problem.classes
    named = [entry.name for entry in paths if entry.name in (of_control(problem), PEAK, EFFORT, EQUALS, STEP)]
    uncertainty = [convex for convex in (problem.disturbance, problem.initial_set) if convex is not None]
    slanted = [convex.kind for convex in uncertainty if _has_zero_chord(convex)]
    state_sets = [*(entry.set for entry in problem.of_states), *problem.terminal_sets]
    curved = [convex.kind for convex in state_sets if convex.halfspaces() is None]
    leaning = [convex.kind for convex in uncertainty if fixed(problem)[1].size and Spread(((1, convex),)).leans]
    unsupported = " and ".join(sorted(classes)) if not classes <= {"piecewise_constant"} else ""
    cases: dict[str, bool | str] = {
        "few functions of the control": not control.is_indicators,
        "parameters": uncertain,
        "measurable": unsupported if "measurable" in classes else "",
        "l1_ball": unsupported,
        "budget": problem.has_budget,
        "pieces of their own": problem.disturbance_breakpoints is not None,
        "flat uncertainty": " and the ".join(slanted),
        "fixed final state and flat uncertainty": " and the ".join(leaning),
        "curved path": " and the ".join(dict.fromkeys(curved)),
        "few functions of the disturbance": bool(classes) and not disturbance.is_complete,
        "name that is taken": " or ".join(map(str, named)),
        "control_step, repeat and outputs": bool(problem.repeat)
        and problem.control_step is not None
        and problem.measurements is not None,
        "group with a charge": cost if problem.cost.blocks and cost != "nominal" else "",
    }
    refuse_cases("affine", cases)


def build_inner_loop(
    wanted: InnerGain, rough: Posed, problem: OptimalControlProblem, states: int, units: Units
) -> InnerLoop:
    """Return the inner loop that a policy wants for a problem, in the units of the problem.

    Parameters
    ----------
    wanted : InnerGain
        Gains as the policy gives them, or ``auto``.
    rough : Posed
        Problem in the ``units``, without an inner loop.
    problem : OptimalControlProblem
        Problem in its own units.
    states : int
        Number of states that are measured; they come first.
    units : Units
        Units of ``rough``.

    Raises
    ------
    InputError
        Where the gains are no such numbers, or the problem has what an inner loop is not built for.
    """
    _refuse_inner_loop(problem)
    (K, m, d), scaled = (rough.control.pieces, problem.system.controls, problem.system.states), rough.problem
    plant, gains = _sample_plant(rough), np.zeros((K, m, d))
    if wanted is None or isinstance(wanted, str):
        rows = _normalise_rows(rough.constraints, d)[:, :states]
        lengths = rough.control.lengths / scaled.horizon
        measured = replace(plant, Phi=plant.Phi[:, :states, :states], Gamma=plant.Gamma[:, :states])
        gains[:, :, :states] = measured.regulator(rows, scaled.control.reach(np.eye(m)), lengths)
    else:
        gains[:, :, :states] = _read_gains(wanted, (K, m, states)) * units.states[:states] / units.controls[:, None]
    reach = _bound_inner_loop(rough, plant, gains, np.zeros(d))
    return InnerLoop(gains * units.controls[:, None] / units.states, reach * units.controls)


def _bound_inner_loop(posed: Posed, plant: SampledPlant, gains: Array, around: Array) -> Array:
    """Return a bound ``(m,)`` of ``|K_k x_k|`` under every control that keeps the constraints of a problem, in its
    units, for ``gains (K, m, d)`` and from every initial state that differs from that of the problem by at most
    ``around (d,)``."""
    problem, times = posed.problem, posed.control.breakpoints
    initial = np.asarray(problem.initial_state, dtype=float)
    low, high = (0.0, 0.0) if problem.initial_set is None else ranges(problem.initial_set)
    windows = [(entry.set, entry.start, end_of(entry.stop, problem.horizon))
               for entry in problem.of_states if entry.relative_to is None]  # fmt: skip
    windows += [(end, problem.horizon, problem.horizon) for end in problem.ends]
    constraints = [
        StateRows(*_find_sides(convex), (times >= start) & (times <= stop)) for convex, start, stop in windows
    ]
    bounds = initial + low - around, initial + high + around
    return plant.bound(gains, bounds, ranges(problem.control), constraints)


def _sample_plant(posed: Posed) -> SampledPlant:
    """Return the plant of a problem from breakpoint to breakpoint of its control, with all its disturbances."""
    low, high = (np.zeros(posed.problem.system.disturbances),) * 2
    if posed.problem.disturbance is not None:
        low, high = ranges(posed.problem.disturbance)
    return SampledPlant.of(posed.response, posed.control, low, high)


def _read_gains(wanted: npt.ArrayLike, shape: tuple[int, int, int]) -> Array:
    """Return gains ``(K, m, d)`` after a check; one matrix is that of every piece."""
    _, m, d = shape
    try:
        gains = np.array(wanted, dtype=float)
    except (TypeError, ValueError):
        gains = np.zeros(0)
    if gains.shape not in ((m, d), shape) or not np.isfinite(gains).all():
        got = f"{wanted!r}" if gains.ndim < 2 else f"an array of shape {gains.shape}"
        got = got if np.isfinite(gains).all() else "a number that is not finite"
        expected = f"auto, or {m} rows of {d} finite numbers: a row per control, a number per state"
        raise InputError(path="policy.prestabilise", expected=expected, got=got)
    return np.broadcast_to(gains, shape)


def _find_sides(convex: ConvexSet) -> tuple[Array, Array, Array]:
    """Return directions ``(r, d)`` along which a set is bounded on both sides, and the least and largest values there:
    normals of its sides, or the axes where it is curved."""
    flat = convex.halfspaces()
    directions = np.eye(convex.dimension) if flat is None else flat[0]
    low, high = -convex.support(-directions), convex.support(directions)
    is_bounded = np.isfinite(low) & np.isfinite(high)
    return directions[is_bounded], low[is_bounded], high[is_bounded]


def _refuse_inner_loop(problem: OptimalControlProblem) -> None:
    """Raise `InputError` for what an inner loop is not built for, in one sentence."""
    cases = {
        "entries in t": problem.system.varies,
        "delay": problem.system.delay > 0.0,
        "quadratic cost or group": not problem.cost.is_linear or bool(problem.cost.blocks),
        "control_step and repeat": bool(problem.repeat) and problem.control_step is not None,
    }
    refuse_cases("prestabilise", cases)


def _has_zero_chord(convex: ConvexSet) -> bool:
    """Return whether a set has no length along an axis through its middle although its entry on this axis deviates.
    Then no gain on that entry of a deviation is bounded."""
    spread = Spread(((1, convex),))
    return bool(((spread.chords <= 0.0) & (spread.radii > 0.0)).any())


def _scale_to_user_units(own: Answers, measured: Array, deviations: Array) -> Answers:
    """Return the same coordinates of gains in the user's units. ``measured (d,)`` and ``deviations (Q,)`` are one unit
    of each measured quantity and of each deviation there. The factors are powers of two and change only the exponents
    of numbers."""
    _, _, Q, d = own.shape
    at, indices, value = own.effect
    effect = (at, indices, value * deviations[own.entry[indices]] / deviations[at % Q])
    at, indices, value = own.gain
    gain = (at, indices, value * deviations[own.entry[indices]] / measured[at % d])
    return replace(own, effect=effect, gain=gain)


def _collect_deviations(posed: Posed, still: np.ndarray | None) -> Spread:
    """Return the deviations of the disturbance, of the noise of measurements, and of the initial state of a problem.
    Some entries of these are ``still (Q,)``."""
    problem, disturbance, periods = posed.problem, posed.functionals.disturbance, 1 + _has_next_initial_state(posed)
    blocks = 0 if disturbance is None else disturbance.block_count
    noise = None if problem.measurements is None else problem.measurements.noise
    spread = deviations_of(problem.disturbance, blocks, problem.initial_set, noise, posed.control.pieces, periods)
    return replace(spread, still=still)


def _find_ineffective_entries(own: Posed, spread: Spread) -> np.ndarray:
    """Return a mask ``(Q,)`` of the entries of the disturbance and of the initial state that move no row by more than
    `NEGLIGIBLE_EFFECT` of its size (decision 0088). Gains on such entries would be unbounded.

    The entries of one coordinate of a box, at all times, are in the mask together or not at all; of any other set, all
    its entries. Entries of the noise are never in it. With fixed final states nothing is, since these hold at every
    deviation.
    """
    is_still, model = np.zeros(spread.size, dtype=bool), own.functionals.disturbance
    if fixed(own.problem)[1].size:
        return is_still
    bound, sets = own.problem.disturbance, [own.problem.disturbance, own.problem.initial_set]
    disturbance_widths, initial_widths = (
        np.zeros(0) if convex is None else convex.width(np.eye(convex.dimension)) for convex in sets
    )
    rows = _normalise_rows(own.constraints, own.problem.system.states)
    is_negligible = find_negligible_entries(
        own.response, model, disturbance_widths, initial_widths, rows, NEGLIGIBLE_EFFECT
    )
    if bound is not None and model is not None:
        entries = _combine_over_times(bound, is_negligible[: is_negligible.size - initial_widths.size])
        is_still[: is_negligible.size - initial_widths.size] = np.tile(entries, model.block_count)
    if own.problem.initial_set is not None:
        periods = 1 + _has_next_initial_state(own)
        entries = _combine_over_times(
            own.problem.initial_set, is_negligible[is_negligible.size - initial_widths.size :]
        )
        is_still[spread.size - initial_widths.size * periods :] = np.tile(entries, periods)
    return is_still


def _combine_over_times(convex: ConvexSet, still: np.ndarray) -> np.ndarray:
    """Return which coordinates ``(q,)`` of the points of a set are ``still`` in every point, where the points follow
    one another. For a set that is no box the answer is the same for all coordinates."""
    entries = np.asarray(still.reshape(-1, convex.dimension).all(axis=0))
    return entries if convex.is_box else np.full(convex.dimension, entries.all())


def _normalise_rows(constraints: Sequence[StateConstraint], d: int) -> Array:
    """Return rows ``(k, d)`` on the state in multiples of the size that a user reads from them: the larger of bound and
    width. A row with size 0 stays in its own unit."""
    rows = [np.zeros((0, d))]
    for constraint in constraints:
        assert constraint.sides is not None
        sizes = row_sizes(*constraint_sides(constraint))
        rows.append(constraint.sides[0] / np.where(sizes > 0.0, sizes, 1.0)[:, None])
    return np.vstack(rows)


def _has_next_initial_state(posed: Posed) -> bool:
    """Return whether this period's program contains the initial state of the next period: for the step between the
    periods."""
    problem = posed.problem
    return problem.control_step is not None and bool(problem.repeat) and problem.initial_set is not None


def _step_units(problem: OptimalControlProblem) -> Array | None:
    """Return the units ``(r,)`` of the rows of the control's steps; ``None`` where these are free, or their set is
    curved."""
    step = problem.control_step
    flat = None if step is None else step.halfspaces()
    return None if step is None or flat is None else units_of_steps(step, *flat, problem.control)
