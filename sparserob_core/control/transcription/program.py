"""The program of a posed problem, exactly, whatever its control answers; to answer nothing is the least of it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, final

import numpy as np

from sparserob_core.control.constraints.control import ControlConstraint, held_at
from sparserob_core.control.constraints.flat import FlatConstraint
from sparserob_core.control.constraints.literal import LiteralConstraint
from sparserob_core.control.constraints.sensitivity import Sensitivity
from sparserob_core.control.constraints.state import StateConstraint
from sparserob_core.control.enclosures.taylor import TaylorSpace
from sparserob_core.control.problem.dictionary import Dictionary
from sparserob_core.control.problem.problem import OptimalControlProblem
from sparserob_core.control.problem.units import Units, power_of_two, ratios
from sparserob_core.control.reach.functional import WorstCase
from sparserob_core.control.reach.sizes import nominal_sizes
from sparserob_core.control.response.disturbance import DisturbanceModel
from sparserob_core.control.response.parameters import ParameterIndex
from sparserob_core.control.transcription.objective import objective, quadratics
from sparserob_core.control.transcription.own_units import (
    RESOLVED,
    added_up,
    extent,
    fixed,
    units_of_sides,
    units_of_steps,
)
from sparserob_core.control.transcription.provable import hindrance
from sparserob_core.control.transcription.record import Acting, Part, Posed, RowUnits, Transcription
from sparserob_core.control.transcription.steps import Steps, paired
from sparserob_core.control.transcription.telling import Telling
from sparserob_core.errors import InputError, NotEnclosable
from sparserob_core.sip.convex_set import Array, Box, ConvexSet
from sparserob_core.sip.program import TOLERANCE, ConstraintFamily, EqualityErrors, Formulation, SemiInfiniteProgram

if TYPE_CHECKING:
    from scipy.sparse import csc_array

SAME = 1e-11  # of the numbers that are added up, a difference that is rounding
EQUALS = "equals"  # the name of the fixed final states
IDLE = 1e-15  # of the numbers that are added up, an entry of a row that is rounding


@final
@dataclass(frozen=True, eq=False)
class OpenLoop(Acting):
    """A control that answers nothing: its families have rows of the decision."""

    formulation: Formulation = "reduced"

    @property
    def answers_by(self) -> None:
        """None."""

    def in_own(self, theirs: Posed, own: Posed, units: Units) -> OpenLoop:
        """The same: it sees nothing."""
        return self

    def part(self, posed: Posed) -> Part:
        """The families of the constraints, and of the sets of controls without flat sides."""
        problem, control, functionals = posed.problem, posed.control, posed.functionals
        families = [family_of(constraint) for constraint in posed.constraints]
        beside = functionals.variables - functionals.coefficients
        for name, convex, places in held_at(problem, control.breakpoints, answering=False):
            if convex.halfspaces() is None:  # sides are rows of the image
                families.append(ControlConstraint.of(name, convex, places, control, beside).family())
        if self.formulation == "literal":
            families = [family.literal or family for family in families]
        return Part(families=families, activity=np.outer(problem.counts, control.lengths).ravel())

    def from_state(self, model: Transcription, begun: Posed) -> Transcription:
        """With what does not depend on the state shared, and the families' reduced form alone."""
        moved = {
            one.name: replace(_reduced(one), row_units=told.row_units, index_units=told.index_units)
            for one, told in zip(begun.constraints, model.program.families, strict=False)
        }
        A, b = _equalities(begun)
        program = replace(
            model.program,
            **quadratics(begun.problem, model.control, begun.functionals.variables),
            families=[moved.get(family.name, family) for family in model.program.families],
            A=A if b.size else None,
            b=b if b.size else None,
            errors=final_errors(begun) if b.size else None,
        )
        return begun.became(OpenLoop(), program)

    def free(self, model: Transcription) -> Transcription:
        """The same: all that costs is the control itself."""
        return model

    def telling(self, own: Posed, units: Units) -> Telling:
        """With the coefficients of the disturbance, which a literal index holds."""
        model = own.functionals.disturbance
        return Telling(units, blocks=np.zeros(0) if model is None else _block_units(model, units))

    def units_beside(self, own: Posed, units: Units) -> Array:
        """None."""
        return np.zeros(0)


def transcribed(posed: Posed, acting: Acting) -> Transcription:
    """The program of a posed problem, without a twin: nominal entries with their cost, bounds and equalities, and the
    part that it owes to how the control is ``acting``."""
    problem, control, functionals, part = posed.problem, posed.control, posed.functionals, acting.part(posed)
    A, b = _equalities(posed)
    if posed.rows is not None:
        b = np.where(A.any(axis=1) | (np.abs(b) > TOLERANCE), b, 0.0)  # no control enters, and rounding is missing
    S, lower, upper = _image(posed.held, control, posed.rows)
    if functionals.execution is not None:
        S, lower, upper = _with_sizes(S, lower, upper, functionals)
    lower, upper = np.concatenate([lower, part.lower]), np.concatenate([upper, part.upper])
    n = functionals.variables + part.lower.size
    priced = objective(problem, control, lower.size, n)
    if part.weights is not None:
        priced["weights"] = part.weights
    if part.largest is not None:
        priced.setdefault("largest", part.largest)
    errors = None if not b.size else final_errors(posed)
    program = SemiInfiniteProgram(
        n=n,
        families=part.families,
        errors=errors,
        **priced,
        S=S,
        lower=lower,
        upper=upper,
        A=A if b.size else None,
        b=b if b.size else None,
        channels=problem.system.controls,
        lengths=np.tile(control.lengths, problem.system.controls),
        activity=part.activity,
        spread=part.spread,
        settle=part.settle,
        guide=part.guide,
        among=part.among,
    )
    return posed.became(acting, program, part.feedback)


def final_errors(posed: Posed) -> Callable[[Array], EqualityErrors]:
    """Return the function that bounds the errors of the fixed final states at a decision, in units of their rows.

    The final state of the middle parameter is enclosed as that of every terminal constraint is, with the rounding of
    the response counted. A claim may excuse a billionth of a fixed value, or of what its state does until then: nothing
    of a state that is 0 and stays 0.
    """
    (H, values), horizon = fixed(posed.held), np.array([posed.problem.horizon])
    unit = np.ones(values.size) if posed.rows is None else posed.rows.fixed
    nominal, ends = posed.functionals.nominal(), (posed.problem.horizon, posed.problem.horizon)

    def errors(x: Array) -> EqualityErrors:
        sizes = np.maximum(np.abs(values), nominal_sizes(nominal, x, H))
        share = np.where(sizes > 0.0, sizes, 1.0)
        rows, heights = H / share[:, None], values / share
        both = np.vstack([rows, -rows]), np.append(heights, -heights)
        constraint = FlatConstraint(EQUALS, nominal, *both, *ends, ParameterIndex(None))
        missed = float(constraint.enclosure(x, horizon[None], horizon[None]).bounds[0])
        missed = missed if (sizes > 0.0).any() else 0.0
        system, end = posed.functionals.response.system, posed.problem.horizon
        advice = (
            f"the fixed final states may be missed by up to {missed:.1e} of their sizes, {TOLERANCE:g} is excused;"
            f" {hindrance(system, end) or 'wider final sets would help'}"
        )
        return EqualityErrors(missed * sizes / unit, TOLERANCE * sizes / unit, advice)

    return errors


def held_nominally(problem: OptimalControlProblem) -> OptimalControlProblem:
    """A problem with the ranges of its controls alone, of all that its own or their final values are held in: what
    else is asked of a control that answers is asked of it for every deviation."""
    ranged = Box(*ranges(problem.control))
    return replace(problem, control=ranged, control_step=None, terminal=problem.terminal_sets)


def way_back(theirs: Posed, own: Transcription, units: Units) -> tuple[Array, Array, Array]:
    """What one of every entry of a decision ``(n,)``, of its image ``(k,)`` and of every equality ``(e,)`` in own units
    is in the user's."""
    rows, pieces, controls = own.rows, own.control.pieces, units.controls
    assert rows is not None
    slants, slanting = (slanted(one.held.control)[0] for one in (theirs, own))
    sides = ratios(slants, slanting / rows.sides[:, None], controls)
    steps, mine = (Steps.of(one.held, one.control) for one in (theirs, own))
    changes = np.repeat(ratios(steps.H, mine.divided(rows.steps).H, controls), steps.times.size)
    beside = own.acting.units_beside(own, units)
    sizes = [] if own.functionals.execution is None else [np.repeat(controls, pieces)]  # bounded from both sides
    decision = np.concatenate([np.repeat(controls, own.control.functions), *sizes, beside])
    image = np.concatenate([np.repeat(np.concatenate([controls, sides]), pieces), changes, *2 * sizes, beside])
    return decision, image, fixed(theirs.held)[0] @ units.states * rows.fixed


def held_units(posed: Posed, ranged: ConvexSet) -> RowUnits:
    """The units of the rows of the nominal decision, where the control is ``ranged`` in a set. Equalities hold to
    rounding only: where no control enters a row, what is missing is compared with what double precision resolves."""
    added = added_up(replace(posed.held, control=ranged), posed.functionals)
    entered = np.abs(_ends(posed.held, posed.functionals, posed.parameters)[0]).max(axis=1, initial=0.0) > IDLE * added
    H, h = slanted(ranged)
    sides = units_of_sides(H, h, ranged.reach(H), np.abs(H) @ extent(ranged)) if h.size else h
    ends = power_of_two(np.where(entered, 1.0, RESOLVED) * added)
    return RowUnits(sides, _step_units(posed.held, ranged), ends, entered)


def _step_units(problem: OptimalControlProblem, ranged: ConvexSet) -> Array:
    """The unit ``(r,)`` of every row of the control's steps, the least of those of its two sides."""
    H, lower, upper = paired(problem.control_step, problem.system.controls)
    if problem.control_step is None or not upper.size:
        return upper
    both, heights = np.vstack([H, -H]), np.concatenate([upper, -lower])
    return np.asarray(units_of_steps(problem.control_step, both, heights, ranged).reshape(2, -1).min(axis=0))


def _block_units(model: DisturbanceModel, units: Units) -> Array:
    """What one of every coefficient of a disturbance's blocks is in the user's units."""
    if model.scale is not None:
        return np.ones(model.block_count * model.set.dimension)
    return np.tile(np.repeat(units.disturbances, model.set.dimension // model.channels), model.block_count)


def _image(
    problem: OptimalControlProblem, dictionary: Dictionary, rows: RowUnits | None
) -> tuple[csc_array | None, Array, Array]:
    """The control on every piece, its bounds, one more image per piece and side of a polytope, and one per
    step and side of the set of its changes."""
    from scipy.sparse import csc_array, eye_array, kron, vstack

    bound, channels = problem.control, problem.system.controls
    lower, upper = (np.repeat(ends, dictionary.pieces) for ends in ranges(bound))
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
    image = eye_array(functionals.coefficients, format="csc") if S is None else S
    values, sizes = image[: functionals.execution.size], eye_array(functionals.execution.size, format="csc")
    far = 2.0 * np.maximum(np.abs(lower), np.abs(upper))[: functionals.execution.size]
    none = np.zeros(far.size)
    return (
        csc_array(block_array([[image, None], [-values, sizes], [values, sizes]])),
        np.concatenate([lower, none, none]),
        np.concatenate([upper, far, far]),
    )


def ranges(bound: ConvexSet) -> tuple[Array, Array]:
    """Between what every control ``(m,)`` of a set of them lies."""
    axes = np.eye(bound.dimension)
    return -bound.support(-axes), bound.support(axes)


def slanted(bound: ConvexSet) -> tuple[Array, Array]:
    """The sides ``(H (r, m), h (r,))`` of a set of controls that bound several of them together; none for a box or a
    curved set."""
    flat = bound.halfspaces()
    if flat is None:
        return np.zeros((0, bound.dimension)), np.zeros(0)
    several = np.count_nonzero(flat[0], axis=1) > 1
    return flat[0][several], flat[1][several]


def _equalities(posed: Posed) -> tuple[Array, Array]:
    """Terminal equalities as rows of the decision, in their units."""
    A, b = _ends(posed.held, posed.functionals, posed.parameters)
    return (A, b) if posed.rows is None else posed.rows.equalities(A, b)


def _ends(problem: OptimalControlProblem, functionals: WorstCase, parameters: ParameterIndex) -> tuple[Array, Array]:
    """Terminal equalities as rows; refused where the uncertainty reaches the state, since nothing could then satisfy
    them."""
    A, b = [np.zeros((0, functionals.variables))], [np.zeros(0)]
    middle = parameters.middle[None]
    (directions, values), added = fixed(problem), added_up(problem, functionals)
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
        scale=constraint.scale,
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
