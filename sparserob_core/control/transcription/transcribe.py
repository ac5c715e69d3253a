"""Exact transcription of an optimal control problem and two dictionaries into a convex semi-infinite program."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from typing import Literal

import numpy as np

from sparserob_core.control.combinations import refusal
from sparserob_core.control.constraints.flat import FlatConstraint
from sparserob_core.control.constraints.state import StateConstraint
from sparserob_core.control.policies.policy import Policy, answers_of
from sparserob_core.control.problem.dictionary import Dictionary
from sparserob_core.control.problem.problem import OptimalControlProblem
from sparserob_core.control.problem.representable import require_representable
from sparserob_core.control.problem.terms.windows import MixedConstraint, PathConstraint
from sparserob_core.control.problem.units import Units, ratios
from sparserob_core.control.reach.functional import WorstFunctionals
from sparserob_core.control.response.disturbance import DisturbanceModel, disturbance_model
from sparserob_core.control.response.inner_loop import NO_INNER_LOOP, InnerLoop
from sparserob_core.control.response.parameters import ParameterIndex
from sparserob_core.control.response.reference import Reference
from sparserob_core.control.response.response import Response
from sparserob_core.control.response.time_grid import SAME_TIME, distinct_times
from sparserob_core.control.transcription.grid import grid_of
from sparserob_core.control.transcription.own_units import (
    own_units,
    rough_units,
    row_units,
    shortfall,
)
from sparserob_core.control.transcription.program import (
    OpenLoopModel,
    build_program,
    compute_conversion_factors,
    held_nominally,
    held_units,
)
from sparserob_core.control.transcription.record import Acting, Posed, Transcription
from sparserob_core.control.transcription.steps import refuse_without_steps
from sparserob_core.control.transcription.terms.accumulated import integrals_as_states
from sparserob_core.errors import InputError
from sparserob_core.sip.convex_set import Array
from sparserob_core.sip.program import OwnUnits, SemiInfiniteProgram


def transcribe(
    problem: OptimalControlProblem,
    control: Dictionary,
    disturbance: Dictionary | None = None,
    formulation: Literal["reduced", "literal"] = "reduced",
    policy: Policy | None = None,
) -> SemiInfiniteProgram:
    """Return the convex semi-infinite program of a problem (the paper's (7)).

    The decision is ``theta (m, N)`` raveled; its image ``S theta`` is the control on every piece, channel-major ``(m
    K,)``. The program remembers its problem, so that `solve` gives it a result like that of the problem; a program in
    which something is replaced does not.

    Parameters
    ----------
    problem : OptimalControlProblem
        The problem.
    control : Dictionary
        The dictionary of the control.
    disturbance : Dictionary, optional
        The dictionary of the disturbance; the control's dictionary by default.
    formulation : str
        ``reduced`` eliminates the disturbance exactly, by support functions. ``literal`` keeps its coefficients as part
        of the index.
    policy : Policy, optional
        A policy that answers measurements, such as an `AffinePolicy`. Its gains follow ``theta`` in the decision.

    Raises
    ------
    InputError
        Where a dictionary does not span the horizon.
    """
    if formulation not in ("reduced", "literal"):
        raise InputError(f"formulation: expected reduced or literal, got {formulation!r}")
    model = prepare(problem, control, disturbance or control, formulation, policy)
    model.program.__dict__["origin"] = model
    return model.program


def _require_dictionary(name: str, given: object) -> None:
    if not isinstance(given, Dictionary):
        expected = "a Dictionary, such as sr.Dictionary.indicators(times); sr.solve takes one by its name too"
        raise InputError(path=name, expected=expected, got=type(given).__name__)


def prepare(
    problem: OptimalControlProblem,
    control: Dictionary,
    disturbance: Dictionary,
    formulation: Literal["reduced", "literal"] = "reduced",
    policy: Policy | None = None,
) -> Transcription:
    """Return the transcription of a problem on its dictionaries: its program with everything that it was made of.

    A policy that answers nothing is open loop, as is ``None``. Raises `InputError` where a dictionary does not span the
    horizon, for terminal equalities that no control can meet, and for steps that no control can take. The error is also
    raised for a policy that does not say which measurements it answers, or that answers what it cannot know.
    """
    for name, dictionary in (("control", control), ("disturbance", disturbance)):
        _require_dictionary(name, dictionary)
        if abs(dictionary.horizon - problem.horizon) > 1e-12 * problem.horizon:
            raise InputError(
                f"{name} dictionary: ends at {dictionary.horizon:g}, expected the horizon {problem.horizon:g}"
            )
        if dictionary.lengths.min() <= SAME_TIME * problem.horizon:
            raise InputError(
                f"{name} dictionary: a piece is {dictionary.lengths.min():.2g} long, "
                f"which is rounding for a horizon of {problem.horizon:g}"
            )
    require_representable(problem)
    user_problem, disturbance = _merge_disturbance_grids(problem, disturbance)
    problem = integrals_as_states(user_problem)
    refuse_without_steps(problem, control)
    mask = answers_of(policy, control.breakpoints, problem.measurements)
    if problem.execution is not None and mask.any():
        raise refusal("execution", "affine", got=f"{np.asarray(problem.execution).tolist()}")
    if problem.jitter and mask.any():
        raise refusal("jitter", "affine", got=f"{problem.jitter:g}")
    if problem.jitter and not problem.jitter < control.lengths.min():
        expected = f"less than {control.lengths.min():g}, the shortest piece of the control"
        raise InputError(path="jitter", expected=expected, got=f"{problem.jitter:g}")
    nominal_problem, inner = problem, NO_INNER_LOOP
    if policy is not None and mask.any():
        from sparserob_core.control.transcription import feedback

        control = control.by_values()  # what answers a measurement is a value, which must not reach back before it
        feedback.refuse(problem, control, disturbance, policy.charge.cost, user_problem.system.parameter_count > 0)
        if formulation != "reduced":
            raise refusal("affine", "literal", formulation)
        inner = _build_inner_loop(policy, problem, user_problem.system.states, control, disturbance)
        nominal_problem = held_nominally(problem, inner)
    posed = _pose_problem(problem, nominal_problem, control, disturbance, inner)
    own = cache(lambda: _scale_to_own_units(posed))
    acting: Acting = OpenLoopModel(formulation)
    if policy is not None and mask.any():
        acting = feedback.answering(policy, mask, posed, *own())
    model = build_program(posed, acting)
    return replace(model, program=model.program.mirrored(lambda _: _build_own_units(model, *own())), given=user_problem)


def _merge_disturbance_grids(
    problem: OptimalControlProblem, disturbance: Dictionary
) -> tuple[OptimalControlProblem, Dictionary]:
    """Return the problem with the breakpoints of every disturbance of a list, where one has its own, and indicators of
    the pieces on which all of them are constant. Raise `InputError` for a dictionary with fewer functions than pieces
    together with such disturbances."""
    if problem.disturbance_breakpoints is None:
        return problem, disturbance
    if not disturbance.is_complete:
        raise refusal("pieces of their own", "few functions")
    common = disturbance.merged().breakpoints
    own = tuple(common if times is None else times for times in problem.disturbance_breakpoints)
    joint = distinct_times(np.concatenate(own), problem.horizon)
    return replace(problem, disturbance_breakpoints=own), Dictionary.indicators(joint)


def _build_inner_loop(
    policy: Policy, problem: OptimalControlProblem, states: int, control: Dictionary, disturbance: Dictionary
) -> InnerLoop:
    """Return the inner loop of a policy for a problem, in the units of the problem. Only the first ``states`` states
    are measured."""
    from sparserob_core.control.transcription import feedback

    if policy.inner_gain is None:
        return NO_INNER_LOOP
    units = rough_units(problem)
    rough, control, disturbance = (
        units.of_problem(problem),
        units.of_dictionary(control),
        units.of_dictionary(disturbance),
    )
    posed = _pose_problem(rough, rough, control, disturbance, NO_INNER_LOOP)
    return feedback.build_inner_loop(policy.inner_gain, posed, problem, states, units)


def _build_functionals(
    problem: OptimalControlProblem, control: Dictionary, disturbance: Dictionary, inner: InnerLoop
) -> tuple[WorstFunctionals, ParameterIndex]:
    delivery = problem.delivery
    control = control if delivery is None else delivery.mean(control)
    system, grid = problem.system.forced, grid_of(problem, control.breakpoints, disturbance.breakpoints)
    model: DisturbanceModel | None = None
    if problem.disturbance is not None:
        bound, breakpoints = problem.disturbance, problem.disturbance_breakpoints
        model = disturbance_model(problem.disturbance_class, bound, disturbance, grid, breakpoints)
    response = Response(system, grid, np.asarray(problem.initial_state, dtype=float), inner=inner)
    initial_set = problem.initial_set
    execution = None
    if delivery is not None:
        from sparserob_core.control.reach.varying_execution import execution_of

        error_mask = np.ones(problem.system.states)
        error_mask[list(problem.commanded)] = 0.0
        execution = execution_of(response, control.breakpoints, delivery.shares, error_mask, delivery.scaling(control))
    functionals = WorstFunctionals(
        response, control, model, names=problem.names, initial=initial_set, execution=execution
    )
    return functionals, ParameterIndex(problem.system.parameters)


def _pose_problem(
    problem: OptimalControlProblem,
    held: OptimalControlProblem,
    control: Dictionary,
    disturbance: Dictionary,
    inner: InnerLoop,
) -> Posed:
    """Return a problem on its dictionaries, in its units, with an ``inner`` loop; ``held`` is the part that becomes
    rows of the nominal decision."""
    functionals, parameters = _build_functionals(problem, control, disturbance, inner)
    return Posed(
        problem=problem,
        held=held,
        control=control,
        disturbance=disturbance,
        functionals=functionals,
        parameters=parameters,
        constraints=_build_state_constraints(problem, functionals, parameters),
    )


def _scale_to_own_units(posed: Posed, wide: bool = False) -> tuple[Posed, Units]:
    """Return the same problem in its own units (decision 0016), with every row divided by its own unit, and these
    units.

    For a control of very large range, double precision may not resolve the bounds of the state. The units are then
    those of a control with a smaller range, for which it does, if there is one. With ``wide`` they are those of the
    whole range nonetheless.
    """
    controls = np.ones(posed.problem.system.controls)
    own, units = _scale_to_shares(posed, controls)
    least_share = shortfall(own.constraints)
    if wide or least_share >= 1.0:
        return own, units
    share = float(np.exp2(np.floor(np.log2(least_share)))) / 2.0
    ranged = _scale_to_shares(posed, share * controls)
    if shortfall(ranged[0].constraints) < 1.0:  # what is too fine is so without a control
        return own, units
    for channel in range(controls.size if controls.size > 1 else 0):
        chosen = np.where(np.arange(controls.size) == channel, 1.0, ranged[1].controls / units.controls)
        candidate = _scale_to_shares(posed, chosen)
        ranged = candidate if shortfall(candidate[0].constraints) >= 1.0 else ranged
    return ranged


def _scale_to_shares(posed: Posed, shares: Array) -> tuple[Posed, Units]:
    """Return the problem in the units that it would have if every channel used only the share ``(m,)`` of its range,
    and these units; the range itself does not change."""
    problem = posed.problem
    ranged = replace(problem, control=problem.control.in_units(1.0 / shares), control_step=None)
    ranged = problem if (shares == 1.0).all() else ranged
    rough, dictionaries = rough_units(ranged), (posed.control, posed.disturbance)
    rough_problem = rough.of_problem(ranged)
    rough_control, rough_disturbance = (rough.of_dictionary(dictionary) for dictionary in dictionaries)
    rough_inner = posed.response.inner.in_units(rough)
    reaching, _ = _build_functionals(rough_problem, rough_control, rough_disturbance, rough_inner)
    units = own_units(ranged, rough, reaching, rough_problem.control)
    control, disturbance = (units.of_dictionary(dictionary) for dictionary in dictionaries)
    scaled = units.of_problem(problem)
    inner = posed.response.inner.in_units(units)
    nominal_problem = scaled if posed.held is problem else held_nominally(scaled, inner)
    own = _pose_problem(scaled, nominal_problem, control, disturbance, inner)
    control_range, held_range = (variant.control.in_units(1.0 / shares) for variant in (scaled, nominal_problem))
    constraints = tuple(constraint.divided(row_units(constraint, control_range)) for constraint in own.constraints)
    return replace(own, constraints=constraints, rows=held_units(own, held_range)), units


def in_own_units(model: Transcription, wide: bool = False) -> tuple[Transcription, Units]:
    """Return the transcription of the same problem in its own units, and these units (`_scale_to_own_units`). Its
    families are explained in the user's units."""
    return _transcribe_in_own_units(model, *_scale_to_own_units(model, wide))


def _transcribe_in_own_units(model: Transcription, posed: Posed, units: Units) -> tuple[Transcription, Units]:
    """Return the transcription of a problem that is ``posed`` in its own units, with families that are explained in the
    user's units, and these own units."""
    own = build_program(posed, model.acting.in_own(model, posed, units))
    telling = own.acting.telling(own, units)
    families = [
        telling.family(family, theirs)
        for family, theirs in zip(own.program.families, model.program.families, strict=True)
    ]
    return replace(own, program=replace(own.program, families=families, cost_unit=units.cost)), units


def like(own: Transcription, problem: OptimalControlProblem) -> SemiInfiniteProgram:
    """Return the program of another problem on the dictionaries of ``own``, with the row units and the explanations of
    ``own``. The two problems may differ only in numbers on the right-hand sides."""
    posed = _pose_problem(problem, problem, own.control, own.disturbance, own.response.inner)
    pairs = zip(posed.constraints, own.constraints, strict=True)
    constraints = tuple(
        constraint.divided(_compute_row_ratios(constraint, own_constraint)) for constraint, own_constraint in pairs
    )
    program = build_program(replace(posed, constraints=constraints, rows=own.rows), own.acting).program
    families = [
        replace(family, explain=own_family.explain, row_units=own_family.row_units, index_units=own_family.index_units)
        for family, own_family in zip(program.families, own.program.families, strict=True)
    ]
    return replace(program, families=families)


def _build_own_units(model: Transcription, posed: Posed, units: Units) -> OwnUnits:
    """Return the program of a problem that is ``posed`` in its own units, and the factors back to the user's units."""
    own, _ = _transcribe_in_own_units(model, posed, units)
    decision, image, equalities = compute_conversion_factors(model, own, units)

    def wider() -> OwnUnits:
        return _build_own_units(model, *_scale_to_own_units(model, wide=True))

    narrow = bool((units.controls < rough_units(model.problem).controls).any())  # it goes less far than it may
    return OwnUnits(
        program=replace(own.program, activity=model.program.activity, image_units=image),
        decision=decision,
        image=image,
        equalities=equalities,
        cost=units.cost,
        wider=wider if narrow else None,
    )


def _compute_row_ratios(one: StateConstraint, other: StateConstraint) -> Array:
    """Return the ratios ``(r,)`` of the rows of a constraint to those of another constraint with the same
    directions."""
    theirs, ours = (constraint.normals_at(constraint.index_set.lower) for constraint in (one, other))
    return ratios(theirs, ours, np.ones(ours.shape[1]))


def from_state(model: Transcription, initial_state: Array, around: Array | None = None) -> Transcription:
    """Return the reduced program of the same problem from another initial state ``(d,)``; everything that does not
    depend on this state is shared. The decision has the range that it needs from every initial state that differs from
    this one by at most ``around (d,)``, by default 0."""
    posed: Posed = replace(
        model,
        problem=replace(model.problem, initial_state=initial_state),
        held=replace(model.held, initial_state=initial_state),
        functionals=model.functionals.from_state(initial_state),
        constraints=tuple(constraint.from_state(initial_state) for constraint in model.constraints),
    )
    posed = model.acting.widen(posed, np.zeros_like(initial_state) if around is None else around)
    return replace(model.acting.from_state(model, posed), given=model.given)


def _build_state_constraints(
    problem: OptimalControlProblem, functionals: WorstFunctionals, parameters: ParameterIndex
) -> tuple[StateConstraint, ...]:
    """Return the path and terminal constraints in the form that the program uses; equalities are not among them."""
    constraints: list[StateConstraint] = []
    for name, entry in windows_of(problem):
        stop = problem.horizon if entry.stop is None else entry.stop
        rows, window, reference = entry.flat, (entry.start, stop), Reference.of(entry.relative_to)
        if rows is None:
            from sparserob_core.control.constraints.curved import CurvedConstraint

            constraints.append(CurvedConstraint(name, functionals, entry.set, *window, parameters, reference=reference))
        elif rows[-1].size:
            constraints.append(FlatConstraint.of(name, functionals, rows, window, parameters, reference))
    return tuple(constraints)


def windows_of(problem: OptimalControlProblem) -> list[tuple[str, PathConstraint | MixedConstraint]]:
    """Return the path and terminal constraints with the names of their families. The window of a terminal constraint is
    the horizon alone."""
    end, ends = problem.horizon, problem.terminal_sets
    finals = [
        (_name_family("terminal", i, len(ends)), PathConstraint(convex, end, end)) for i, convex in enumerate(ends)
    ]
    return [*zip(problem.called("path"), problem.windows, strict=True), *finals]


def _name_family(kind: str, position: int, count: int) -> str:
    return f"{kind}[{position}]" if count > 1 else kind
