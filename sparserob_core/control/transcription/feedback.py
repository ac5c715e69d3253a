"""From a problem whose control answers what it measures to a program, exactly: nominal control and gains together."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import reduce

import numpy as np

from sparserob_core.control.constraints.control import STEP, Places, held_at, of_control
from sparserob_core.control.constraints.effort import FeedbackEffort
from sparserob_core.control.constraints.feedback import FeedbackConstraint, FeedbackControl
from sparserob_core.control.constraints.feedback_curved import FeedbackCurvedControl, of_state
from sparserob_core.control.constraints.flat import FlatConstraint
from sparserob_core.control.feedback.closed_loop import ClosedLoop, deviations_of
from sparserob_core.control.feedback.innovations import Answers, answers, innovations_seen
from sparserob_core.control.feedback.measurable import MeasurablePieces, measurable_pieces
from sparserob_core.control.feedback.observer import Observer, between, innovations_of
from sparserob_core.control.feedback.zonoid import has_corners
from sparserob_core.control.policies.policy import Charge, Policy
from sparserob_core.control.problem.dictionary import Dictionary
from sparserob_core.control.problem.problem import MixedConstraint, OptimalControlProblem, PathConstraint
from sparserob_core.control.problem.system import VaryingSystem
from sparserob_core.control.problem.units import Units, power_of_two
from sparserob_core.control.response.measurable import MISSED
from sparserob_core.control.response.parameters import ParameterIndex
from sparserob_core.control.sets.sets import Equality
from sparserob_core.control.transcription.objective import objective
from sparserob_core.control.transcription.own_units import extent, reaches, units_of_sides
from sparserob_core.control.transcription.record import Feedback, Transcription
from sparserob_core.control.transcription.telling import Telling
from sparserob_core.errors import InputError
from sparserob_core.sip.convex_set import Array, ConvexSet
from sparserob_core.sip.finite import Spread
from sparserob_core.sip.program import OwnUnits, SemiInfiniteProgram

PEAK, EFFORT = "peak", "effort"  # names of the families that are about the control
EQUALS = "equals"  # the name of that of the terminal equalities
FINER = 2.0**-11  # of the numbers that are added up, the unit of an equality: it is met to `EQUALITY` of them


def with_feedback(
    problem: OptimalControlProblem,
    model: Transcription,
    own: Transcription,
    units: Units,
    policy: Policy,
    mask: np.ndarray,
    wider: Callable[[], OwnUnits] | None = None,
) -> tuple[Transcription, Transcription]:
    """The program of a problem under a policy that answers what ``mask (K, K)`` says, from its transcription ``model``
    without feedback and without terminal equalities, and the same in its ``own`` ``units``: the user's and the own
    one."""
    pieces = measurable_pieces(own.functionals)
    spread = _spread(own, pieces)
    begins = own.problem.initial_set is not None
    blocks = 0 if own.functionals.disturbance is None else own.functionals.disturbance.block_count
    deviations = np.tile(units.disturbances[: own.problem.system.disturbances], blocks)
    deviations = deviations if pieces is None else np.ones(pieces.size)
    seen = innovations_seen(own.response, own.control, own.functionals.disturbance, begins, pieces)
    outputs, observed, theirs_observed, begun = units.states, None, None, units.states[: len(units.states) * begins]
    if problem.measurements is not None and own.problem.measurements is not None:
        outputs = problem.measurements.units(units.states)
        radii = np.delete(spread.radii, np.arange(deviations.size, spread.size - begun.size))
        observed = Observer.of(own.problem.measurements, seen, between(own.response, own.control), radii)
        theirs_observed = observed.in_units(units.states, outputs)
        deviations = np.append(deviations, np.tile(outputs, own.control.pieces if observed.noisy else 0))
    anew = _begins_anew(own)
    deviations = np.concatenate([deviations, begun, *[begun] * anew])
    seen = innovations_of(seen, begun.size, observed, anew) * (spread.chords > 0.0)  # else not answered
    scaled = answers(seen, mask, own.problem.system.controls)
    known = _in_users(scaled, outputs, deviations)

    acting = None if pieces is None else pieces.in_units_of(model.functionals, units.states, units.disturbances)
    fixed = _fixed(problem, own, units)
    repeated = own.control.pieces

    def in_users(one: Transcription, charge: Charge) -> tuple[SemiInfiniteProgram, ClosedLoop]:
        return _program(one, charge, known, (acting, theirs_observed), fixed[0], own=False)

    def in_own(one: Transcription, charge: Charge) -> tuple[SemiInfiniteProgram, ClosedLoop]:
        return _program(one, charge, scaled, (pieces, observed), fixed[1], own=True)

    charge = policy.charge
    mine, theirs = in_users(model, charge), in_own(own, charge)
    telling = Telling(units, deviations=deviations)
    told = [telling.family(family, other) for family, other in zip(theirs[0].families, mine[0].families, strict=True)]
    scaled_program = replace(theirs[0], families=told, cost_unit=units.cost)
    decision = np.concatenate(
        [
            np.repeat(units.controls, repeated),
            units.controls[scaled.channel] / deviations[scaled.entry],
            np.full(1, units.cost) if charge.cost == "worst" else np.repeat(units.controls, repeated),
        ]
    )[: scaled_program.n]
    program = mine[0].mirrored(lambda _: OwnUnits(scaled_program, decision, decision, np.zeros(0), units.cost, wider))
    scaled_problem = units.of_problem(problem)
    return (
        replace(model, problem=problem, program=program, feedback=Feedback(policy, mask, charge, mine[1], in_users)),
        replace(
            own,
            problem=scaled_problem,
            program=scaled_program,
            feedback=Feedback(policy, mask, charge, theirs[1], in_own),
        ),
    )


def made_again(model: Transcription, charge: Charge) -> Transcription:
    """The transcription with the program that belongs to its initial state, and to a policy that is charged something
    else."""
    assert model.feedback is not None
    program, loop = model.feedback.made(model, charge)
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
        for one, told in ((one, named.get(one.name, one)) for one in program.families)
    ]
    program = replace(program, families=families, cost_unit=model.program.cost_unit)
    return replace(model, program=program, feedback=replace(model.feedback, charge=charge, loop=loop))


def _fixed(
    problem: OptimalControlProblem, own: Transcription, units: Units
) -> tuple[tuple[Array, Array], tuple[Array, Array]]:
    """The terminal equalities as rows ``H x(T) <= h``, the second half of them the opposites of the first: in the
    user's units, and in own ones divided by a small part of the numbers that are added up."""
    ends = [(state, end.values[state]) for end in problem.terminal if isinstance(end, Equality) for state in end.fixed]
    states = np.array([state for state, _ in ends], dtype=int)
    H, h = np.eye(problem.system.states)[states], np.array([value for _, value in ends])
    if not h.size:
        return (H, h), (H, h)
    horizon, values = np.array([own.problem.horizon]), h / units.states[states]
    _, added = reaches(own.functionals, ParameterIndex(None), own.problem.control, H, horizon)
    small = FINER * power_of_two(np.maximum(added, np.abs(values)))
    scaled, both = H / small[:, None], values / small
    return (np.vstack([H, -H]), np.append(h, -h)), (np.vstack([scaled, -scaled]), np.append(both, -both))


def refuse(problem: OptimalControlProblem, control: Dictionary, disturbance: Dictionary, cost: str) -> None:
    """Raise `InputError` for what a policy is not built for, in one sentence."""
    disturbed = problem.disturbance is not None
    paths = [entry for entry in problem.path if isinstance(entry, PathConstraint | MixedConstraint)]
    sets = [entry.set for entry in paths] + [end for end in problem.terminal if not isinstance(end, Equality)]
    steps = [] if problem.control_step is None else [problem.control_step]
    curved = [one.kind for one in (*sets, problem.control, *steps) if one.halfspaces() is None]
    named = [entry.name for entry in paths if entry.name in (of_control(problem), PEAK, EFFORT, EQUALS, STEP)]
    kind, bound = problem.disturbance_class, problem.disturbance
    measurable = bound is not None and kind == "measurable"
    ends = any(isinstance(end, Equality) for end in problem.terminal)
    reasons = {
        "control that can have any value on every piece: an answer to a measurement does not reach back before it": (
            not control.is_indicators
        ),
        "system without uncertain parameters: else what is measured is not the disturbance alone": bool(
            problem.system.parameter_count
        ),
        "disturbance of one class, piecewise_constant or measurable, not "
        f"{kind if isinstance(kind, str) else ' and '.join(sorted(set(kind)))}": disturbed
        and kind not in ("piecewise_constant", "measurable"),
        f"measurable disturbance in a set with known corners, which the {bound.kind if bound else ''} has not": bool(
            measurable and bound is not None and not has_corners(bound)
        ),
        f"set with flat sides for states and controls under measurable disturbances, which the "
        f"{' and the '.join(curved)} has not": measurable and bool(curved),
        "cost other than worst under measurable disturbances": measurable and cost == "worst",
        "disturbance that takes any value on each of its pieces": disturbed
        and not measurable
        and not disturbance.is_complete,
        f"path constraint of another name than {' or '.join(map(str, named))}, which is taken": bool(named),
        "terminal set with an interior under measurable disturbances: they reach a fixed state": measurable and ends,
        "measurement of the whole state without noise under measurable disturbances": measurable
        and problem.measurements is not None,
        "control that acts at once under measurable disturbances, without a delay": measurable
        and problem.system.delay > 0.0,
        "single linear system under measurable disturbances, without pieces": measurable
        and bool(problem.system.switches),
        "system that stays the same with time under measurable disturbances": measurable
        and isinstance(problem.system, VaryingSystem),
        "whole state that is measured without noise where a plan with a control_step repeats": bool(problem.repeat)
        and problem.control_step is not None
        and problem.measurements is not None,
        f"cost of single channels where the policy is charged {cost}: without group": bool(problem.cost.blocks)
        and cost != "nominal",
    }
    for wanted, hindered in reasons.items():
        if hindered:
            raise InputError(f"feedback needs a {wanted}", path="policy.name")


def _in_users(own: Answers, measured: Array, deviations: Array) -> Answers:
    """The same coordinates of gains in the user's units, in which one of what is ``measured (d,)`` and of the
    ``deviations (Q,)`` is that; powers of two change no number but its exponent."""
    _, _, Q, d = own.shape
    at, which, value = own.effect
    effect = (at, which, value * deviations[own.entry[which]] / deviations[at % Q])
    at, which, value = own.gain
    gain = (at, which, value * deviations[own.entry[which]] / measured[at % d])
    return replace(own, effect=effect, gain=gain)


def _program(
    model: Transcription,
    charge: Charge,
    known: Answers,
    acting: tuple[MeasurablePieces | None, Observer | None],
    fixed: tuple[Array, Array],
    own: bool,
) -> tuple[SemiInfiniteProgram, ClosedLoop]:
    """The program of one transcription, in its units; ``fixed``: the rows of its terminal equalities; ``own``: whether
    rows of steps are divided by their units."""
    functionals, problem, pieces = model.functionals, model.problem, model.control.pieces
    nominal, first = functionals.variables, functionals.variables + known.variables
    size = first + {"nominal": 0, "peak": nominal, "worst": 1}[charge.cost]
    loop = ClosedLoop(functionals, known, _spread(model, acting[0]), size, *acting, anew=_begins_anew(model))
    families = [of_state(constraint, loop).family() for constraint in model.constraints]
    settled: list[Callable[[Array], Array]] = []
    if fixed[1].size:
        ends = (problem.horizon, problem.horizon)
        equal = FeedbackConstraint(
            FlatConstraint(EQUALS, functionals, *fixed, *ends, model.parameters), loop, exact=True
        )
        families.append(equal.family())
        settled.append(equal.met)
    breakpoints = model.control.breakpoints
    for name, convex, places in held_at(problem, breakpoints, answering=True):
        flat = convex.halfspaces()
        if flat is None:
            families.append(FeedbackCurvedControl(loop, convex, name, places).family())
            continue
        H, h = _divided(problem, *flat, convex) if own and places.steps else flat
        families.append(FeedbackControl(name, loop, places, H, h).family())
    axes = np.eye(problem.system.controls)
    low, high = -problem.control.support(-axes), problem.control.support(axes)
    most = (high - low)[known.channel] / loop.spread.chords[known.entry]
    low, high = np.repeat(low, pieces), np.repeat(high, pieces)
    lower, upper = np.concatenate([low, -most]), np.concatenate([high, most])
    priced = objective(problem, model.control, size, size)
    weights, cost = np.zeros(size), priced["weights"][:nominal]
    guide, among = None, None
    if charge.cost == "peak":
        both, every = np.vstack([axes, -axes]), Places.of_values(breakpoints, len(axes))
        peaks = FeedbackControl(PEAK, loop, every, both, np.zeros(len(both)), first)
        families.append(peaks.family())
        settled.append(peaks.settled)
        weights[first:] = cost
        lower = np.concatenate([lower, np.zeros(nominal)])
        upper = np.concatenate([upper, np.maximum(np.abs(low), np.abs(high))])
    elif charge.cost == "worst":
        effort = FeedbackEffort(EFFORT, loop, cost, first)
        families.append(effort.family())
        settled.append(effort.settled)
        guide = (_program(model, replace(charge, cost="peak"), known, acting, fixed, own)[0], first)
        weights[first:] = 1.0
        lower = np.append(lower, 0.0)
        most_effort = float(cost @ np.maximum(np.abs(low), np.abs(high)))
        priced.setdefault("largest", most_effort)
        upper = np.append(upper, 2.0 * most_effort)
    else:
        weights[:nominal] = cost
        if charge.among == "peak" and problem.cost.is_linear:
            peak = replace(charge, cost="peak")
            among = (_program(model, peak, known, acting, fixed, own)[0], first)
    priced["weights"] = weights
    program = SemiInfiniteProgram(
        n=size,
        families=families,
        **priced,
        lower=lower,
        upper=upper,
        channels=problem.system.controls,
        lengths=np.tile(model.control.lengths, problem.system.controls),
        spread=loop.spread,
        settle=None if not settled else lambda x: reduce(lambda at, settle: settle(at), settled, x),
        guide=guide,
        among=among,
    )
    return program, loop


def _spread(model: Transcription, acting: MeasurablePieces | None) -> Spread:
    """The deviations of a problem's disturbance and of its initial state."""
    problem, disturbance, periods = model.problem, model.functionals.disturbance, 1 + _begins_anew(model)
    if acting is not None:
        return Spread((*acting.sets, *deviations_of(None, 0, problem.initial_set, periods=periods).sets), MISSED)
    blocks = 0 if disturbance is None else disturbance.block_count
    noise = None if problem.measurements is None else problem.measurements.noise
    return deviations_of(problem.disturbance, blocks, problem.initial_set, noise, model.control.pieces, periods)


def _begins_anew(model: Transcription) -> bool:
    """Whether the initial state of the next period is seen in this one's program: by the step across the seam."""
    problem = model.problem
    return problem.control_step is not None and bool(problem.repeat) and problem.initial_set is not None


def _divided(problem: OptimalControlProblem, H: Array, h: Array, step: ConvexSet) -> tuple[Array, Array]:
    """The sides ``H a <= h`` of the control's steps, every row divided by its own unit."""
    far = 2.0 * np.abs(H) @ extent(problem.control)
    unit = units_of_sides(H, h, np.minimum(step.reach(H), far), far)
    return H / unit[:, None], h / unit
