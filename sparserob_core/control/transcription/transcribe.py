"""From an optimal control problem and two dictionaries to a convex semi-infinite program, exactly."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, Literal

import numpy as np

from sparserob_core.control.constraints.control import ControlConstraint, held_at
from sparserob_core.control.constraints.flat import FlatConstraint
from sparserob_core.control.constraints.literal import LiteralConstraint
from sparserob_core.control.constraints.sensitivity import Sensitivity
from sparserob_core.control.constraints.state import StateConstraint
from sparserob_core.control.enclosures.taylor import TaylorSpace
from sparserob_core.control.policies.policy import Policy, answers_of
from sparserob_core.control.problem.dictionary import Dictionary
from sparserob_core.control.problem.problem import (
    Accumulated,
    MixedConstraint,
    OptimalControlProblem,
    PathConstraint,
    Return,
)
from sparserob_core.control.problem.representable import require_representable
from sparserob_core.control.problem.system import VaryingSystem
from sparserob_core.control.problem.units import Units, power_of_two, ratios
from sparserob_core.control.response.disturbance import DisturbanceModel, disturbance_model
from sparserob_core.control.response.functional import WorstCase
from sparserob_core.control.response.parameters import ParameterIndex
from sparserob_core.control.response.reference import Reference
from sparserob_core.control.response.response import SAME_TIME, Response, merge_grids
from sparserob_core.control.sets.sets import Equality
from sparserob_core.control.transcription.accumulated import accumulated
from sparserob_core.control.transcription.objective import objective, quadratics
from sparserob_core.control.transcription.own_units import (
    RESOLVED,
    extent,
    own_units,
    reaches,
    rough_units,
    row_units,
    shortfall,
    units_of_sides,
)
from sparserob_core.control.transcription.provable import hindrance
from sparserob_core.control.transcription.record import RowUnits, Transcription
from sparserob_core.control.transcription.steps import Steps, paired, refuse_without_steps
from sparserob_core.control.transcription.telling import Telling
from sparserob_core.errors import InputError, NotEnclosable
from sparserob_core.sip.convex_set import Array, ConvexSet
from sparserob_core.sip.program import TOLERANCE, ConstraintFamily, Formulation, OwnUnits, SemiInfiniteProgram

if TYPE_CHECKING:
    from scipy.sparse import csc_array

SAME = 1e-11  # of the numbers that are added up, a difference that is rounding
IDLE = 1e-15  # of the numbers that are added up, an entry of a row that is rounding


def transcribe(
    problem: OptimalControlProblem,
    control: Dictionary,
    disturbance: Dictionary | None = None,
    formulation: Literal["reduced", "literal"] = "reduced",
    policy: Policy | None = None,
) -> SemiInfiniteProgram:
    """The convex semi-infinite program of a problem (the paper's (7)).

    The decision is ``theta (m, N)`` raveled; its image ``S theta`` is the control on every piece, channel-major
    ``(m K,)``. ``disturbance`` defaults to the control's dictionary. ``formulation``: ``reduced`` eliminates the
    disturbance exactly, by support functions; ``literal`` keeps its coefficients as part of the index. ``policy``: one
    that answers what is measured, such as an `AffinePolicy`, has its gains after ``theta`` in the decision. The program
    remembers what it is of, so that `solve` gives it a result like that of its problem; one in which something is
    replaced does not. Raises `InputError` when a dictionary does not span the horizon.
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
    """The program of a problem on its dictionaries, with everything that it was made of. Raises `InputError` when a
    dictionary does not span the horizon, for terminal equalities that no control can meet, or steps that none can take,
    and for a policy that does not say what it answers, or answers what it cannot know; one that answers nothing is an
    open loop, as none is."""
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
    stated, problem = problem, accumulated(problem)
    refuse_without_steps(problem, control)
    mask = answers_of(policy, control.breakpoints, problem.measurements)
    if problem.execution is not None and mask.any():
        expected = "none under feedback, where the size of the control, and with it that of its error, answers too"
        raise InputError(path="execution", expected=expected, got=f"{np.asarray(problem.execution).tolist()}")
    if policy is not None and mask.any():
        from sparserob_core.control.transcription.feedback import refuse

        control = control.by_values()  # what answers a measurement is a value, which must not reach back before it
        refuse(problem, control, disturbance, policy.charge.cost)
        if formulation != "reduced":
            raise InputError(
                f"formulation: expected reduced with a policy that answers what is measured, got {formulation!r}"
            )
        return replace(_answering(problem, control, disturbance, policy, mask)[0], given=stated)
    model = _assembled(problem, control, disturbance, formulation)
    return replace(model, program=model.program.mirrored(lambda _: _in_own_units(model)), given=stated)


def _answering(
    problem: OptimalControlProblem,
    control: Dictionary,
    disturbance: Dictionary,
    policy: Policy,
    mask: np.ndarray,
    wide: bool = False,
) -> tuple[Transcription, Transcription, Units]:
    """A problem under a policy that answers what ``mask`` says, in the user's units, in its own, and these
    (`in_own_units`)."""
    from sparserob_core.control.transcription.feedback import with_feedback

    ends = [end for end in problem.terminal if not isinstance(end, Equality)]
    model = _assembled(replace(problem, terminal=ends), control, disturbance, "reduced")
    own, units = in_own_units(model, wide)

    def wider() -> OwnUnits:
        found = _answering(problem, control, disturbance, policy, mask, wide=True)[0].program.own_units
        assert found is not None
        return found

    more = wider if not wide and _is_narrow(model, units) else None
    return *with_feedback(problem, model, own, units, policy, mask, more), units


def _functionals(
    problem: OptimalControlProblem, control: Dictionary, disturbance: Dictionary
) -> tuple[WorstCase, ParameterIndex]:
    system, before = problem.system.forced, np.zeros(problem.system.controls)
    before = before if problem.initial_control is None else np.asarray(problem.initial_control, dtype=float)
    constants = system.controls - problem.system.controls
    varying = isinstance(system, VaryingSystem)
    grid = merge_grids(
        control.breakpoints, disturbance.breakpoints, problem.system.delay, before, constants, system.switches, varying
    )
    model: DisturbanceModel | None = None
    if problem.disturbance is not None:
        model = disturbance_model(problem.disturbance_class, problem.disturbance, disturbance, grid)
    response, begun = Response(system, grid, np.asarray(problem.initial_state, dtype=float)), problem.initial_set
    execution = None
    if problem.execution is not None:
        from sparserob_core.control.response.measurable import Execution, VaryingExecution

        made = VaryingExecution if varying else Execution
        execution = made(response, control.breakpoints, np.asarray(problem.execution))
    functionals = WorstCase(response, control, model, names=problem.names, initial=begun, execution=execution)
    return functionals, ParameterIndex(problem.system.parameters)


def _assembled(
    problem: OptimalControlProblem,
    control: Dictionary,
    disturbance: Dictionary,
    formulation: Formulation,
    own: ConvexSet | None = None,
    like: Transcription | None = None,
) -> Transcription:
    """The program in the units of the problem; every row divided by the unit that it has where the control is in a set
    of its ``own``, or by what it is divided by in another one that it is to be ``like``."""
    functionals, parameters = _functionals(problem, control, disturbance)
    constraints = _state_constraints(problem, functionals, parameters)
    A, b = _equalities(problem, functionals, parameters)
    rows: RowUnits | None = None
    if like is not None and like.rows is not None:
        rows = like.rows
        pairs = zip(constraints, like.constraints, strict=True)
        constraints = tuple(one.divided(_shares(one, other)) for one, other in pairs)
    elif own is not None:
        rows = _row_units(problem if own is problem.control else replace(problem, control=own), functionals, A)
        constraints = tuple(one.divided(row_units(one, own)) for one in constraints)
    S, lower, upper = _image(problem, control, rows)
    if rows is not None:
        A, b = rows.equalities(A, b)
        b = np.where(A.any(axis=1) | (np.abs(b) > TOLERANCE), b, 0.0)  # no control enters, and rounding is missing
    if functionals.execution is not None:
        S, lower, upper = _with_sizes(S, lower, upper, functionals)
    families = [family_of(constraint) for constraint in constraints]
    beside = functionals.variables - functionals.coefficients
    for name, convex, places in held_at(problem, control.breakpoints, answering=False):
        if convex.halfspaces() is None:  # sides are rows of the image
            families.append(ControlConstraint.of(name, convex, places, control, beside).family())
    if formulation == "literal":
        families = [family.literal or family for family in families]
    program = SemiInfiniteProgram(
        n=functionals.variables,
        families=families,
        **objective(problem, control, lower.size, functionals.variables),
        S=S,
        lower=lower,
        upper=upper,
        A=A if b.size else None,
        b=b if b.size else None,
        channels=problem.system.controls,
        lengths=np.tile(control.lengths, problem.system.controls),
        activity=np.outer(problem.counts, control.lengths).ravel(),
    )
    return Transcription(
        problem, control, disturbance, functionals, parameters, constraints, program, formulation, rows
    )


def in_own_units(model: Transcription, wide: bool = False) -> tuple[Transcription, Units]:
    """The same problem in its own units (decision 0016), every row divided by its own, and these units; its families
    are explained in the user's.

    Where a control may go so far that double precision does not resolve the walls beside it, the units are those of a
    control that goes as far as that allows, ``wide`` asks for those of its whole range nonetheless.
    """
    if model.feedback is not None:
        answering = model.feedback
        return _answering(model.problem, model.control, model.disturbance, answering.policy, answering.answers)[1:]
    controls = np.ones(model.problem.system.controls)
    own, units = _scaled(model, controls)
    short = shortfall(own.constraints)
    if wide or short >= 1.0:
        return own, units
    share = float(np.exp2(np.floor(np.log2(short)))) / 2.0
    ranged = _scaled(model, share * controls)
    if shortfall(ranged[0].constraints) < 1.0:  # what is too fine is so without a control
        return own, units
    for channel in range(controls.size if controls.size > 1 else 0):
        chosen = np.where(np.arange(controls.size) == channel, 1.0, ranged[1].controls / units.controls)
        fewer = _scaled(model, chosen)
        ranged = fewer if shortfall(fewer[0].constraints) >= 1.0 else ranged
    return ranged


def _scaled(model: Transcription, shares: Array) -> tuple[Transcription, Units]:
    """The problem in the units that it has where every channel goes as far as the share ``(m,)`` of its range; the
    range stays as it is."""
    problem = model.problem
    ranged = replace(problem, control=problem.control.in_units(1.0 / shares), control_step=None)
    ranged = problem if (shares == 1.0).all() else ranged
    rough, dictionaries = rough_units(ranged), (model.control, model.disturbance)
    moved = rough.of_problem(ranged)
    known, _ = _functionals(moved, *(rough.of_dictionary(one) for one in dictionaries))
    units = own_units(ranged, rough, known, moved.control)
    control, disturbance = (units.of_dictionary(one) for one in dictionaries)
    scaled = units.of_problem(problem)
    far = scaled.control if ranged is problem else units.of_problem(ranged).control
    own = _assembled(scaled, control, disturbance, model.formulation, own=far)
    disturbed = own.functionals.disturbance
    telling = Telling(units, blocks=np.zeros(0) if disturbed is None else _block_units(disturbed, units))
    families = [
        telling.family(one, theirs) for one, theirs in zip(own.program.families, model.program.families, strict=True)
    ]
    return replace(own, program=replace(own.program, families=families, cost_unit=units.cost)), units


def like(own: Transcription, problem: OptimalControlProblem) -> SemiInfiniteProgram:
    """The program of another problem on the dictionaries of ``own``, with its rows divided by what those of ``own`` are
    divided by, and told as these are: for problems that differ from it in numbers on the right-hand sides only."""
    program = _assembled(problem, own.control, own.disturbance, own.formulation, like=own).program
    families = [
        replace(one, explain=told.explain, row_units=told.row_units, index_units=told.index_units)
        for one, told in zip(program.families, own.program.families, strict=True)
    ]
    return replace(program, families=families)


def _in_own_units(model: Transcription, wide: bool = False) -> OwnUnits:
    """The program of the same problem in its own units, and the way back."""
    own, units = in_own_units(model, wide)
    rows = own.rows
    assert rows is not None
    theirs, ours = slanted(model.problem.control)[0], slanted(own.problem.control)[0]
    sides = ratios(theirs, ours / rows.sides[:, None], units.controls)
    steps, mine = Steps.of(model.problem, model.control), Steps.of(own.problem, own.control).divided(rows.steps)
    pieces = np.repeat(np.concatenate([units.controls, sides]), own.control.pieces)
    image = np.concatenate([pieces, np.repeat(ratios(steps.H, mine.H, units.controls), steps.times.size)])
    decision = np.repeat(units.controls, own.control.functions)
    if own.functionals.execution is not None:
        sizes = np.repeat(units.controls, own.control.pieces)
        decision, image = np.concatenate([decision, sizes]), np.concatenate([image, sizes, sizes])
    return OwnUnits(
        program=replace(own.program, activity=model.program.activity, image_units=image),
        decision=decision,
        image=image,
        equalities=_fixed(model.problem) @ units.states * rows.fixed,
        cost=units.cost,
        wider=None if wide or not _is_narrow(model, units) else lambda: _in_own_units(model, wide=True),
    )


def _is_narrow(model: Transcription, units: Units) -> bool:
    """Whether units are those of a control that goes less far than it may."""
    return bool((units.controls < rough_units(model.problem).controls).any())


def _row_units(problem: OptimalControlProblem, functionals: WorstCase, A: Array) -> RowUnits:
    """Equalities hold to rounding only: where no control enters a row, what is missing is compared with what double
    precision resolves."""
    added = _added_up(problem, functionals)
    entered = np.abs(A).max(axis=1, initial=0.0) > IDLE * added
    H, h = slanted(problem.control)
    size = np.abs(H) @ extent(problem.control)
    sides = units_of_sides(H, h, problem.control.reach(H), size) if h.size else h
    return RowUnits(sides, _step_units(problem), power_of_two(np.where(entered, 1.0, RESOLVED) * added), entered)


def _step_units(problem: OptimalControlProblem) -> Array:
    """The unit ``(r,)`` of every row of the control's steps, the least of those of its two sides."""
    H, lower, upper = paired(problem.control_step, problem.system.controls)
    if problem.control_step is None or not upper.size:
        return upper
    both, far = np.vstack([H, -H]), 2.0 * np.abs(H) @ extent(problem.control)
    reach = np.minimum(problem.control_step.reach(both), np.tile(far, 2))
    units = units_of_sides(both, np.concatenate([upper, -lower]), reach, np.tile(far, 2))
    return np.asarray(units.reshape(2, -1).min(axis=0))


def _shares(one: StateConstraint, other: StateConstraint) -> Array:
    """What the rows ``(r,)`` of a constraint are of those of another one, whose directions are the same."""
    theirs, ours = (each.normals_at(each.index_set.lower) for each in (one, other))
    return ratios(theirs, ours, np.ones(ours.shape[1]))


def _block_units(model: DisturbanceModel, units: Units) -> Array:
    """What one of every coefficient of a disturbance's blocks is in the user's units."""
    if model.scale is not None:
        return np.ones(model.block_count * model.set.dimension)
    return np.tile(np.repeat(units.disturbances, model.set.dimension // model.channels), model.block_count)


def from_state(model: Transcription, initial_state: Array) -> Transcription:
    """The reduced program of the same problem from another initial state ``(d,)``; what does not depend on it is
    shared, and only the families' reduced form is offered."""
    functionals = model.functionals.from_state(initial_state)
    problem = replace(model.problem, initial_state=initial_state)
    constraints = tuple(one.from_state(initial_state) for one in model.constraints)
    if model.feedback is not None:
        from sparserob_core.control.transcription.feedback import made_again

        begun = replace(model, problem=problem, functionals=functionals, constraints=constraints)
        return made_again(begun, model.feedback.charge)
    moved = {
        one.name: replace(_reduced(one), row_units=told.row_units, index_units=told.index_units)
        for one, told in zip(constraints, model.program.families, strict=False)
    }
    A, b = _equalities(problem, functionals, model.parameters)
    A, b = (A, b) if model.rows is None else model.rows.equalities(A, b)
    program = replace(
        model.program,
        **quadratics(problem, model.control, functionals.variables),
        families=[moved.get(family.name, family) for family in model.program.families],
        A=A if b.size else None,
        b=b if b.size else None,
    )
    return replace(
        model, problem=problem, functionals=functionals, constraints=constraints, program=program, formulation="reduced"
    )


def _state_constraints(
    problem: OptimalControlProblem, functionals: WorstCase, parameters: ParameterIndex
) -> tuple[StateConstraint, ...]:
    """The path and terminal constraints as they stand in the program; equalities are not among them."""
    found: list[StateConstraint] = []
    for name, entry in windows_of(problem):
        stop = problem.horizon if entry.stop is None else entry.stop
        sides = entry.set.halfspaces()
        if isinstance(entry, MixedConstraint):
            found.append(FlatConstraint.twofold(name, functionals, entry, stop, parameters))
            continue
        moved = Reference.of(entry.relative_to)
        if sides is None:
            from sparserob_core.control.constraints.curved import CurvedConstraint

            window = (entry.start, stop)
            found.append(CurvedConstraint(name, functionals, entry.set, *window, parameters, reference=moved))
        elif sides[1].size:
            found.append(FlatConstraint(name, functionals, *sides, entry.start, stop, parameters, reference=moved))
    return tuple(found)


def windows_of(problem: OptimalControlProblem) -> list[tuple[str, PathConstraint | MixedConstraint]]:
    """The path and terminal constraints with the names of their families; a terminal one has the window of one time."""
    end, path = problem.horizon, [entry for entry in problem.path if not isinstance(entry, ConvexSet)]
    ends = [terminal for terminal in problem.terminal if not isinstance(terminal, Equality)]
    finals = [(_name("terminal", i, len(ends)), PathConstraint(one, end, end)) for i, one in enumerate(ends)]
    return [*zip(path_names(problem), path, strict=True), *finals]


def path_names(problem: OptimalControlProblem) -> list[str]:
    """What the families of the path constraints are called: by their own name, or by their place."""
    path = [entry for entry in problem.path if not isinstance(entry, ConvexSet)]
    own = sum(not isinstance(entry, Return | Accumulated) for entry in path)
    return [entry.name or _name("path", i, own) for i, entry in enumerate(path)]


def _name(kind: str, position: int, count: int) -> str:
    return f"{kind}[{position}]" if count > 1 else kind


def _image(
    problem: OptimalControlProblem, dictionary: Dictionary, rows: RowUnits | None
) -> tuple[csc_array | None, Array, Array]:
    """The control on every piece, its bounds, one more image per piece and side of a polytope, and one per
    step and side of the set of its changes."""
    from scipy.sparse import csc_array, eye_array, kron, vstack

    bound, channels = problem.control, problem.system.controls
    axes = np.eye(channels)
    lower, upper = (
        np.repeat(-bound.support(-axes), dictionary.pieces),
        np.repeat(bound.support(axes), dictionary.pieces),
    )
    values = csc_array(dictionary.sparse.T)
    H, h = slanted(bound)
    H, h = (H, h) if rows is None else (H / rows.sides[:, None], h / rows.sides)
    steps = Steps.of(problem, dictionary)
    steps = steps if rows is None else steps.divided(rows.steps)
    if not h.size and not steps.count:
        return (
            (None if dictionary.is_indicators else csc_array(kron(eye_array(channels), values))),
            lower,
            upper,
        )
    blocks = [kron(eye_array(channels), values)]
    blocks += [kron(csc_array(H), values)] if h.size else []
    blocks += [steps.rows] if steps.count else []
    S = csc_array(vstack(blocks))
    extra, (least, most) = np.repeat(h, dictionary.pieces), steps.bounds()
    return (
        S,
        np.concatenate([lower, np.full(extra.size, -np.inf), least]),
        np.concatenate([upper, extra, most]),
    )


def _with_sizes(
    S: csc_array | None, lower: Array, upper: Array, functionals: WorstCase
) -> tuple[csc_array, Array, Array]:
    """The images of `_image` where the decision goes on with a bound ``a`` of the size of every value ``s`` of the
    control, and those that make it one: ``0 <= a - s``, ``0 <= a + s``, neither more than twice as far as ``s`` goes,
    which ``a = |s|`` is not."""
    from scipy.sparse import block_array, csc_array, eye_array

    assert functionals.execution is not None
    known = eye_array(functionals.coefficients, format="csc") if S is None else S
    values, one = known[: functionals.execution.size], eye_array(functionals.execution.size, format="csc")
    far = 2.0 * np.maximum(np.abs(lower), np.abs(upper))[: functionals.execution.size]
    none = np.zeros(far.size)
    return (
        csc_array(block_array([[known, None], [-values, one], [values, one]])),
        np.concatenate([lower, none, none]),
        np.concatenate([upper, far, far]),
    )


def slanted(bound: ConvexSet) -> tuple[Array, Array]:
    """The sides ``(H (r, m), h (r,))`` of a set of controls that bound several of them together; none for a box or a
    curved set."""
    flat = bound.halfspaces()
    if flat is None:
        return np.zeros((0, bound.dimension)), np.zeros(0)
    several = np.count_nonzero(flat[0], axis=1) > 1
    return flat[0][several], flat[1][several]


def _equalities(
    problem: OptimalControlProblem, functionals: WorstCase, parameters: ParameterIndex
) -> tuple[Array, Array]:
    """Terminal equalities as rows; refused where the uncertainty reaches the state, since nothing could then satisfy
    them."""
    A, b = [np.zeros((0, functionals.variables))], [np.zeros(0)]
    middle = np.zeros((1, 0)) if parameters.set is None else parameters.set.interior_point()[None]
    values = np.concatenate(
        [np.zeros(0), *(end.values[end.fixed] for end in problem.terminal if isinstance(end, Equality))]
    )
    directions, added = _fixed(problem), _added_up(problem, functionals)
    for up, value, size in zip(directions, values, added, strict=True):
        time = np.array([problem.horizon])
        G, offset = functionals.rows(time, up[None], middle)
        sigma = functionals.offsets(time, up[None], middle) + functionals.offsets(time, -up[None], middle)
        state = int(np.flatnonzero(up)[0])
        if sigma[0] > SAME * size or _reached(problem, parameters, state):
            raise InputError(
                f"terminal: equals: state {state + 1} depends on the uncertainty, so no control can fix its final"
                f" value to {value:g}; expected a set with interior"
            )
        A.append(G)
        b.append(np.array([value - offset[0]]))
    return np.vstack(A), np.concatenate(b)


def _fixed(problem: OptimalControlProblem) -> Array:
    """The unit vectors ``(e, d)`` of the states that the terminal equalities fix, in the order of their rows."""
    fixed = [state for end in problem.terminal if isinstance(end, Equality) for state in end.fixed]
    directions: Array = np.eye(problem.system.states)[np.array(fixed, dtype=int)]
    return directions


def _added_up(problem: OptimalControlProblem, functionals: WorstCase) -> Array:
    """The largest sums ``(e,)`` of absolute numbers from which the fixed states are computed."""
    H, known = _fixed(problem), ParameterIndex(None)
    if not H.size:
        return np.zeros(0)
    nominal = functionals if functionals.response.system.parameters is None else functionals.nominal()
    _, added = reaches(nominal, known, problem.control, H, np.array([problem.horizon]))
    return added


def _reached(problem: OptimalControlProblem, parameters: ParameterIndex, state: int) -> bool:
    """Whether an uncertain entry of the system may reach a state: follow the entries of ``A`` that are not exactly 0,
    over all parameters."""
    if parameters.set is None:
        return False
    system, box = problem.system.forced, parameters.box
    try:
        middle, radius = (box.lower + box.upper) / 2, (box.upper - box.lower) / 2
        every = [mode.taylor(TaylorSpace(parameters.count, 1), middle, radius) for mode in system.modes]
    except NotEnclosable:
        return True
    counted = (0, 2) if problem.disturbance is None else (0, 2, 4)
    rows, linked = np.zeros(system.states, dtype=bool), np.zeros((system.states,) * 2, dtype=bool)
    for parts in every:  # of systems that take turns, whatever any of them links
        for k in counted:
            rows |= np.any(parts[k][1:] != 0, axis=(0, 2)) | np.any(parts[k + 1] != 0, axis=1)
        linked |= np.any(parts[0] != 0, axis=0) | (parts[1] != 0)
    reaching = np.arange(system.states) == state
    for _ in range(system.states):
        reaching = reaching | linked[reaching].any(axis=0)
    return bool(rows[reaching].any())


def family_of(constraint: StateConstraint) -> ConstraintFamily:
    """The family of a constraint with its other forms: without the uncertainty, for sampled ones, and with the
    disturbance as an index."""

    def sample(count: int, rng: np.random.Generator) -> ConstraintFamily:
        sides = constraint.sides
        if sides is None:
            raise InputError(
                f"method: scenario: the constraint {constraint.name} has a curved set; expected sets with flat sides"
            )
        if constraint.functionals.execution is not None:
            raise InputError("method: scenario: expected no problem.execution, whose errors are not sampled")
        from sparserob_core.control.constraints.scenario import (
            ScenarioConstraint,
            sample_disturbances,
            sample_parameters,
        )

        disturbances = None if model is None else sample_disturbances(model, count, rng)
        drawn = sample_parameters(constraint.parameters.set, count, rng)
        bound = constraint.functionals.initial
        begun = None if bound is None else bound.sample(count, rng)
        return ScenarioConstraint(constraint, *sides, disturbances, drawn, begun).family()

    model, reduced = constraint.functionals.disturbance, _reduced(constraint)
    literal = reduced if model is None else LiteralConstraint(constraint, model).family(reduced)
    nominal = replace(_reduced(constraint.nominal()), formulation="nominal", source=constraint)
    return replace(reduced, nominal=nominal, sample=sample, literal=literal)


def _reduced(constraint: StateConstraint) -> ConstraintFamily:
    response = constraint.functionals.response
    return ConstraintFamily(
        name=constraint.name,
        index_set=constraint.index_set,
        rows=constraint.rows,
        chosen=constraint.chosen,
        excess=constraint.at,
        worst=constraint.worst,
        enclosure=constraint.enclosure,
        cells=constraint.cells,
        gradient=Sensitivity(constraint).gradient,
        explain=constraint.explain,
        hindrance=lambda lower, upper: hindrance(response.system, float(response.grid.breakpoints[-1])),
        measured=constraint.measured,
        along=constraint.functionals.names.time,
        source=constraint,
    )
