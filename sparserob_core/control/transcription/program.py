"""Exact program of a posed problem, whatever its control answers; open loop is the simplest case."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import final

import numpy as np
from scipy.sparse import block_array, csc_array, eye_array, kron, vstack

from sparserob_core.control.combinations import refusal
from sparserob_core.control.constraints.control import ControlConstraint, held_at
from sparserob_core.control.constraints.flat import FlatConstraint
from sparserob_core.control.constraints.literal import LiteralConstraint
from sparserob_core.control.constraints.sensitivity import Sensitivity
from sparserob_core.control.constraints.state import StateConstraint
from sparserob_core.control.problem.dictionary import Dictionary
from sparserob_core.control.problem.problem import OptimalControlProblem
from sparserob_core.control.problem.units import Units, power_of_two, ratios
from sparserob_core.control.reach.functional import WorstFunctionals
from sparserob_core.control.reach.sizes import nominal_sizes
from sparserob_core.control.response.disturbance import DisturbanceModel
from sparserob_core.control.response.inner_loop import InnerLoop
from sparserob_core.control.response.parameters import ParameterIndex
from sparserob_core.control.transcription.objective import objective, quadratics
from sparserob_core.control.transcription.own_units import (
    LEAST_UNIT_SHARE,
    added_up,
    extent,
    fixed,
    units_of_sides,
    units_of_steps,
)
from sparserob_core.control.transcription.provable import hindrance
from sparserob_core.control.transcription.record import Acting, Posed, ProgramPart, RowUnits, Transcription
from sparserob_core.control.transcription.steps import Steps, pair_sides
from sparserob_core.control.transcription.telling import Telling
from sparserob_core.errors import InputError, NotEnclosable
from sparserob_core.sip.convex_set import Array, Box, ConvexSet
from sparserob_core.sip.expressions.taylor import TaylorSpace
from sparserob_core.sip.program import TOLERANCE, ConstraintFamily, EqualityErrors, Formulation, SemiInfiniteProgram

DIFFERENCE_ROUNDING = 1e-11  # of the numbers that are added up, a difference that is rounding
EQUALS = "equals"  # the name of the fixed final states
NEGLIGIBLE_ROW_ENTRY = 1e-15  # of the numbers that are added up, an entry of a row that is rounding


@final
@dataclass(frozen=True, eq=False)
class OpenLoopModel(Acting):
    """Open-loop control, which answers no measurement: its families have rows of the decision."""

    formulation: Formulation = "reduced"

    @property
    def answers_by(self) -> None:
        """``None``: no policy answers measurements."""

    def in_own(self, theirs: Posed, own: Posed, units: Units) -> OpenLoopModel:
        """Return this control, which is the same in all units since it uses no measurements."""
        return self

    def part(self, posed: Posed) -> ProgramPart:
        """Return the families of the constraints, and of the sets of controls without flat sides."""
        problem, control, functionals = posed.problem, posed.control, posed.functionals
        families = [family_of(constraint) for constraint in posed.constraints]
        extra = functionals.variables - functionals.coefficients
        for name, convex, places in held_at(problem, control.breakpoints, answering=False):
            if convex.halfspaces() is None:  # sides are rows of the image
                families.append(ControlConstraint.of(name, convex, places, control, extra).family())
        if self.formulation == "literal":
            families = [family.literal or family for family in families]
        activity = np.outer(problem.counts, control.lengths).ravel()
        return ProgramPart(families=families, activity=activity, settle=_land(posed))

    def widen(self, posed: Posed, around: Array) -> Posed:
        """Return the problem as it is: the range of a control in open loop is its set."""
        return posed

    def from_state(self, model: Transcription, posed: Posed) -> Transcription:
        """Return the program of the same problem from another initial state. Everything that does not depend on this
        state is shared, and the families are in their reduced form only."""
        reduced_families = {
            constraint.name: replace(
                _build_reduced_family(constraint), row_units=family.row_units, index_units=family.index_units
            )
            for constraint, family in zip(posed.constraints, model.program.families, strict=False)
        }
        A, b = _build_scaled_equalities(posed)
        program = replace(
            model.program,
            **quadratics(posed.problem, model.control, posed.functionals.variables),
            families=[reduced_families.get(family.name, family) for family in model.program.families],
            A=A if b.size else None,
            b=b if b.size else None,
            errors=final_errors(posed) if b.size else None,
        )
        return posed.became(OpenLoopModel(), program)

    def free(self, model: Transcription) -> Transcription:
        """Return the program as it is: only the control itself has a cost."""
        return model

    def telling(self, own: Posed, units: Units) -> Telling:
        """Return the conversion to the user's units, with the units of the disturbance's coefficients that a literal
        index holds."""
        model = own.functionals.disturbance
        return Telling(units, blocks=np.zeros(0) if model is None else _block_units(model, units))

    def compute_extra_units(self, own: Posed, units: Units) -> Array:
        """Return an empty array: the decision has no entries after the nominal ones."""
        return np.zeros(0)


def build_program(posed: Posed, acting: Acting) -> Transcription:
    """Return the program of a posed problem, without a twin. It has the nominal entries with their cost, bounds and
    equalities, and the part that depends on how the control is ``acting``."""
    problem, control, functionals, acting_part = posed.problem, posed.control, posed.functionals, acting.part(posed)
    A, b = _build_scaled_equalities(posed)
    if posed.rows is not None:
        b = np.where(A.any(axis=1) | (np.abs(b) > TOLERANCE), b, 0.0)  # no control enters, and rounding is missing
    S, lower, upper = _build_image(posed.held, control, posed.rows)
    if functionals.execution is not None:
        S, lower, upper = _append_sizes(S, lower, upper, functionals, control.pieces)
    lower, upper = np.concatenate([lower, acting_part.lower]), np.concatenate([upper, acting_part.upper])
    n = functionals.variables + acting_part.lower.size
    priced = objective(problem, control, lower.size, n)
    if acting_part.weights is not None:
        priced["weights"] = acting_part.weights
    if acting_part.largest is not None:
        priced.setdefault("largest", acting_part.largest)
    errors = None if not b.size else final_errors(posed)
    program = SemiInfiniteProgram(
        n=n,
        families=acting_part.families,
        errors=errors,
        **priced,
        S=S,
        lower=lower,
        upper=upper,
        A=A if b.size else None,
        b=b if b.size else None,
        channels=problem.system.controls,
        lengths=np.tile(control.lengths, problem.system.controls),
        activity=acting_part.activity,
        spread=acting_part.spread,
        settle=acting_part.settle,
        guide=acting_part.guide,
        among=acting_part.among,
    )
    return posed.became(acting, program, acting_part.feedback)


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
        sides = np.vstack([rows, -rows]), np.append(heights, -heights)
        constraint = FlatConstraint(EQUALS, nominal, *sides, *ends, ParameterIndex(None))
        error = float(constraint.enclosure(x, horizon[None], horizon[None]).bounds[0])
        error = error if (sizes > 0.0).any() else 0.0
        response, end = posed.functionals.response, posed.problem.horizon
        advice = (
            f"the fixed final states may be missed by up to {error:.1e} of their sizes, {TOLERANCE:g} is excused;"
            f" {hindrance(response, end) or 'wider final sets would help'}"
        )
        return EqualityErrors(error * sizes / unit, TOLERANCE * sizes / unit, advice)

    return errors


def held_nominally(problem: OptimalControlProblem, inner: InnerLoop) -> OptimalControlProblem:
    """Return a problem in which the ranges of the controls are the only bounds of the control, and terminal sets
    without equalities the only ones of the final state. All other requirements on a control that answers hold for every
    deviation. Beside an ``inner`` loop the decided part of the control has a wider range."""
    low, high = ranges(problem.control)
    ranged = Box(low - inner.reach, high + inner.reach) if inner.acts else Box(low, high)
    return replace(problem, control=ranged, control_step=None, terminal=problem.terminal_sets)


def compute_conversion_factors(theirs: Posed, own: Transcription, units: Units) -> tuple[Array, Array, Array]:
    """Return the factors from own units to the user's units for every entry of a decision ``(n,)``, of its image
    ``(k,)``, and for every equality ``(e,)``."""
    rows, pieces, controls = own.rows, own.control.pieces, units.controls
    assert rows is not None
    slants, slanting = (slanted_sides(posed.held.control)[0] for posed in (theirs, own))
    sides = ratios(slants, slanting / rows.sides[:, None], controls)
    steps, own_steps = (Steps.of(posed.held, posed.control) for posed in (theirs, own))
    changes = np.repeat(ratios(steps.H, own_steps.divided(rows.steps).H, controls), steps.times.size)
    extra_units = own.acting.compute_extra_units(own, units)
    execution = own.functionals.execution
    sizes = [] if execution is None else [np.repeat(controls, execution.size // controls.size)]  # bounded on both sides
    decision = np.concatenate([np.repeat(controls, own.control.functions), *sizes, extra_units])
    image = np.concatenate([np.repeat(np.concatenate([controls, sides]), pieces), changes, *2 * sizes, extra_units])
    return decision, image, fixed(theirs.held)[0] @ units.states * rows.fixed


def held_units(posed: Posed, ranged: ConvexSet) -> RowUnits:
    """Return the units of the rows of the nominal decision, where the control is ``ranged`` in a set. Equalities hold
    up to rounding only: where no control enters a row, its residual is compared with the resolution of double
    precision."""
    sums = added_up(replace(posed.held, control=ranged), posed.functionals)
    is_controlled = (
        np.abs(_build_equalities(posed.held, posed.functionals, posed.parameters)[0]).max(axis=1, initial=0.0)
        > NEGLIGIBLE_ROW_ENTRY * sums
    )
    H, h = slanted_sides(ranged)
    sides = units_of_sides(H, h, ranged.reach(H), np.abs(H) @ extent(ranged)) if h.size else h
    ends = power_of_two(np.where(is_controlled, 1.0, LEAST_UNIT_SHARE) * sums)
    return RowUnits(sides, _step_units(posed.held, ranged), ends, is_controlled)


def _step_units(problem: OptimalControlProblem, ranged: ConvexSet) -> Array:
    """Return the unit ``(r,)`` of every row of the control's steps: the smaller one of the units of its two sides."""
    H, lower, upper = pair_sides(problem.control_step, problem.system.controls)
    if problem.control_step is None or not upper.size:
        return upper
    both, heights = np.vstack([H, -H]), np.concatenate([upper, -lower])
    return np.asarray(units_of_steps(problem.control_step, both, heights, ranged).reshape(2, -1).min(axis=0))


def _block_units(model: DisturbanceModel, units: Units) -> Array:
    """Return one unit of every coefficient of a disturbance's blocks, in the user's units."""
    if model.scale is not None:
        return np.ones(model.block_count * model.set.dimension)
    return np.tile(np.repeat(units.disturbances, model.set.dimension // model.channels), model.block_count)


def _build_image(
    problem: OptimalControlProblem, dictionary: Dictionary, rows: RowUnits | None
) -> tuple[csc_array | None, Array, Array]:
    """Return the matrix of the image, and its bounds. The image is the control on every piece, then one entry per piece
    and side of a polytope, and one per step and side of the set of its changes. The matrix is ``None`` where it is the
    identity."""
    bound, channels = problem.control, problem.system.controls
    lower, upper = (np.repeat(ends, dictionary.pieces) for ends in ranges(bound))
    values = csc_array(dictionary.sparse.T)
    H, h = slanted_sides(bound)
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
    extra, (step_lower, step_upper) = np.repeat(h, dictionary.pieces), steps.bounds()
    return (
        S,
        np.concatenate([lower, np.full(extra.size, -np.inf), step_lower]),
        np.concatenate([upper, extra, step_upper]),
    )


def _append_sizes(
    S: csc_array | None, lower: Array, upper: Array, functionals: WorstFunctionals, pieces: int
) -> tuple[csc_array, Array, Array]:
    """Return the images of `_build_image` for a decision that continues with a bound ``a`` of the size of every value
    ``s`` of the control. Further images hold ``0 <= a - s`` and ``0 <= a + s``. Both are at most twice the largest
    ``|s|``, which ``a = |s|`` never exceeds."""
    assert functionals.execution is not None
    image = eye_array(functionals.coefficients, format="csc") if S is None else S
    sizes, m = eye_array(functionals.execution.size, format="csc"), functionals.channels
    values = kron(eye_array(m), (functionals.dictionary.sparse @ functionals.execution.scaling).T)
    reach = np.maximum(np.abs(lower), np.abs(upper))[: m * pieces].reshape(m, pieces)[:, 0]
    limits = 2.0 * np.repeat(reach, functionals.execution.size // m)
    none = np.zeros(limits.size)
    return (
        csc_array(block_array([[image, None], [-values, sizes], [values, sizes]])),
        np.concatenate([lower, none, none]),
        np.concatenate([upper, limits, limits]),
    )


def ranges(bound: ConvexSet) -> tuple[Array, Array]:
    """Return the least and the largest value of each control in a set of controls, ``(m,)`` each."""
    axes = np.eye(bound.dimension)
    return -bound.support(-axes), bound.support(axes)


def slanted_sides(bound: ConvexSet) -> tuple[Array, Array]:
    """Return the sides ``(H (r, m), h (r,))`` of a set of controls that bound several controls together; none for a box
    or a curved set."""
    flat = bound.halfspaces()
    if flat is None:
        return np.zeros((0, bound.dimension)), np.zeros(0)
    is_slanted = np.count_nonzero(flat[0], axis=1) > 1
    return flat[0][is_slanted], flat[1][is_slanted]


def _land(posed: Posed) -> Callable[[Array], Array] | None:
    """Return the function that lets a decision meet the fixed final states to the last digits of the control; ``None``
    where there are none, or where rounding is not amplified."""
    functionals, (H, values) = posed.functionals, fixed(posed.held)
    orbit = functionals.response.orbit
    if orbit is None or not values.size or not posed.control.is_indicators or functionals.execution is not None:
        return None

    limits = ranges(posed.held.control)

    def land(x: Array) -> Array:
        return orbit.landed(functionals.control(x), H, values, limits).ravel()

    return land


def _build_scaled_equalities(posed: Posed) -> tuple[Array, Array]:
    """Return the terminal equalities as rows of the decision, in their units."""
    A, b = _build_equalities(posed.held, posed.functionals, posed.parameters)
    return (A, b) if posed.rows is None else posed.rows.equalities(A, b)


def _build_equalities(
    problem: OptimalControlProblem, functionals: WorstFunctionals, parameters: ParameterIndex
) -> tuple[Array, Array]:
    """Return the terminal equalities as rows of the decision. Raise `InputError` where the uncertainty reaches a fixed
    state, since no control could then satisfy the equality."""
    A, b = [np.zeros((0, functionals.variables))], [np.zeros(0)]
    middle = parameters.middle[None]
    (directions, values), sums = fixed(problem), added_up(problem, functionals)
    for up, value, size in zip(directions, values, sums, strict=True):
        time = np.array([problem.horizon])
        G, offset = functionals.rows(time, up[None], middle)
        sigma = functionals.offsets(time, up[None], middle) + functionals.offsets(time, -up[None], middle)
        state = int(np.flatnonzero(up)[0])
        if sigma[0] > DIFFERENCE_ROUNDING * size or _is_uncertain_state(problem, parameters, state):
            raise refusal("fixed final state", "uncertainty", state + 1, f"{value:g}")
        A.append(G)
        b.append(np.array([value - offset[0]]))
    return np.vstack(A), np.concatenate(b)


def _is_uncertain_state(problem: OptimalControlProblem, parameters: ParameterIndex, state: int) -> bool:
    """Return whether an uncertain entry of the system may reach a state, over all parameters. The function follows the
    entries of ``A`` that are not exactly 0."""
    if parameters.set is None:
        return False
    system, box = problem.system.forced, parameters.box
    try:
        middle, radius = (box.lower + box.upper) / 2, (box.upper - box.lower) / 2
        expansions = [mode.taylor(TaylorSpace(parameters.count, 1), middle, radius) for mode in system.modes]
    except NotEnclosable:
        return True
    indices = (0, 2) if problem.disturbance is None else (0, 2, 4)
    is_uncertain, is_linked = np.zeros(system.states, dtype=bool), np.zeros((system.states,) * 2, dtype=bool)
    for expansion in expansions:  # of systems that take turns, whatever any of them links
        for k in indices:
            is_uncertain |= np.any(expansion[k][1:] != 0, axis=(0, 2)) | np.any(expansion[k + 1] != 0, axis=1)
        is_linked |= np.any(expansion[0] != 0, axis=0) | (expansion[1] != 0)
    is_reaching = np.arange(system.states) == state
    for _ in range(system.states):
        is_reaching = is_reaching | is_linked[is_reaching].any(axis=0)
    return bool(is_uncertain[is_reaching].any())


def family_of(constraint: StateConstraint) -> ConstraintFamily:
    """Return the family of a constraint with its other forms: without the uncertainty, with samples of it, and with the
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
        parameters = sample_parameters(constraint.parameters.set, count, rng)
        bound = constraint.functionals.initial
        initial_states = None if bound is None else bound.sample(count, rng)
        return ScenarioConstraint(constraint, *sides, disturbances, parameters, initial_states).family()

    model, reduced = constraint.functionals.disturbance, _build_reduced_family(constraint)
    literal = reduced if model is None else LiteralConstraint(constraint, model).family(reduced)
    nominal = replace(_build_reduced_family(constraint.nominal()), formulation="nominal", source=constraint)
    return replace(reduced, nominal=nominal, sample=sample, literal=literal)


def _build_reduced_family(constraint: StateConstraint) -> ConstraintFamily:
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
        hindrance=lambda lower, upper: hindrance(response, float(response.grid.breakpoints[-1])),
        measured=constraint.measured,
        along=constraint.functionals.names.time,
        source=constraint,
    )
