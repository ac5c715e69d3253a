"""From an optimal control problem and two dictionaries to a convex semi-infinite program, exactly."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, Literal

import numpy as np

from sparserob_core.control.constraints.control import ControlConstraint
from sparserob_core.control.constraints.curved import CurvedConstraint
from sparserob_core.control.constraints.flat import FlatConstraint
from sparserob_core.control.constraints.literal import LiteralConstraint
from sparserob_core.control.constraints.samples import sample_disturbances, sample_parameters
from sparserob_core.control.constraints.scenario import ScenarioConstraint
from sparserob_core.control.constraints.sensitivity import Sensitivity
from sparserob_core.control.constraints.state import StateConstraint
from sparserob_core.control.enclosures.taylor import TaylorSpace
from sparserob_core.control.problem.dictionary import Dictionary
from sparserob_core.control.problem.problem import OptimalControlProblem, PathConstraint
from sparserob_core.control.response.disturbance import DisturbanceModel, disturbance_model
from sparserob_core.control.response.functional import WorstCase
from sparserob_core.control.response.parameters import ParameterIndex
from sparserob_core.control.response.response import SAME_TIME, Response, merge_grids
from sparserob_core.control.sets.sets import Equality
from sparserob_core.control.transcription.record import Transcription
from sparserob_core.errors import InputError, NotEnclosable
from sparserob_core.sip.convex_set import Array, ConvexSet
from sparserob_core.sip.program import ConstraintFamily, SemiInfiniteProgram

if TYPE_CHECKING:
    from scipy.sparse import csc_array

SAME = 1e-11  # relative to the largest entry of a row, a difference that is rounding


def transcribe(
    problem: OptimalControlProblem,
    control: Dictionary,
    disturbance: Dictionary | None = None,
    formulation: Literal["reduced", "literal"] = "reduced",
) -> SemiInfiniteProgram:
    """The convex semi-infinite program of a problem (the paper's (7)).

    The decision is ``theta (m, N)`` raveled; its image ``S theta`` is the control on every piece, channel-major
    ``(m K,)``. ``disturbance`` defaults to the control's dictionary. ``formulation``: ``reduced`` eliminates the
    disturbance exactly, by support functions; ``literal`` keeps its coefficients as part of the index. Raises
    `InputError` when a dictionary does not span the horizon.
    """
    if formulation not in ("reduced", "literal"):
        raise InputError(f"formulation: expected reduced or literal, got {formulation!r}")
    return prepare(problem, control, disturbance or control, formulation).program


def prepare(
    problem: OptimalControlProblem,
    control: Dictionary,
    disturbance: Dictionary,
    formulation: Literal["reduced", "literal"] = "reduced",
) -> Transcription:
    """The program of a problem on its dictionaries, with everything that it was made of. Raises `InputError` when a
    dictionary does not span the horizon, and for terminal equalities that no control can meet."""
    for name, dictionary in (("control", control), ("disturbance", disturbance)):
        if abs(dictionary.horizon - problem.horizon) > 1e-12 * problem.horizon:
            raise InputError(
                f"{name} dictionary: ends at {dictionary.horizon:g}, expected the horizon {problem.horizon:g}"
            )
        if dictionary.lengths.min() <= SAME_TIME * problem.horizon:
            raise InputError(
                f"{name} dictionary: a piece is {dictionary.lengths.min():.2g} long, "
                f"which is rounding for a horizon of {problem.horizon:g}"
            )
    grid = merge_grids(control.breakpoints, disturbance.breakpoints)
    model: DisturbanceModel | None = None
    if problem.disturbance is not None:
        model = disturbance_model(problem.disturbance_class, problem.disturbance, disturbance, grid)
    response = Response(problem.system, grid, np.asarray(problem.initial_state, dtype=float))
    functionals, parameters = WorstCase(response, control, model), ParameterIndex(problem.system.parameters)
    constraints = _state_constraints(problem, functionals, parameters)
    S, lower, upper, weights = _image(problem, control)
    A, b = _equalities(problem, functionals, parameters)
    families = [family_of(constraint) for constraint in constraints]
    if problem.control.halfspaces() is None:
        families.append(ControlConstraint(problem.control, control).family())
    if formulation == "literal":
        families = [family.literal or family for family in families]
    program = SemiInfiniteProgram(
        n=functionals.variables,
        families=families,
        weights=weights,
        S=S,
        lower=lower,
        upper=upper,
        A=A if b.size else None,
        b=b if b.size else None,
        channels=problem.system.controls,
        lengths=np.tile(control.lengths, problem.system.controls),
    )
    return Transcription(problem, control, disturbance, functionals, parameters, constraints, program, formulation)


def from_state(model: Transcription, initial_state: Array) -> Transcription:
    """The reduced program of the same problem from another initial state ``(d,)``; what does not depend on it is
    shared, and only the families' reduced form is offered."""
    functionals = model.functionals.from_state(initial_state)
    problem = replace(model.problem, initial_state=initial_state)
    constraints = tuple(one.from_state(initial_state) for one in model.constraints)
    moved = {one.name: _reduced(one) for one in constraints}
    A, b = _equalities(problem, functionals, model.parameters)
    program = replace(
        model.program,
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
    """The path and terminal constraints, named as the families of the program; equalities are not among them."""
    end = problem.horizon
    path = [entry for entry in problem.path if isinstance(entry, PathConstraint)]
    ends = [terminal for terminal in problem.terminal if not isinstance(terminal, Equality)]
    windows = [(entry.name or _name("path", i, len(path)), entry) for i, entry in enumerate(path)]
    windows += [
        (_name("terminal", i, len(ends)), PathConstraint(terminal, end, end)) for i, terminal in enumerate(ends)
    ]
    found: list[StateConstraint] = []
    for name, entry in windows:
        stop, sides = end if entry.stop is None else entry.stop, entry.set.halfspaces()
        if sides is None:
            found.append(CurvedConstraint(name, functionals, entry.set, entry.start, stop, parameters))
        elif sides[1].size:
            found.append(FlatConstraint(name, functionals, *sides, entry.start, stop, parameters))
    return tuple(found)


def _name(kind: str, position: int, count: int) -> str:
    return f"{kind}[{position}]" if count > 1 else kind


def _image(problem: OptimalControlProblem, dictionary: Dictionary) -> tuple[csc_array | None, Array, Array, Array]:
    """The control on every piece, its bounds and weights, and one more image per piece and side of a polytope."""
    from scipy.sparse import csc_array, eye_array, kron, vstack

    bound, channels = problem.control, problem.system.controls
    axes = np.eye(channels)
    lower, upper = (
        np.repeat(-bound.support(-axes), dictionary.pieces),
        np.repeat(bound.support(axes), dictionary.pieces),
    )
    weights: Array = np.kron(np.asarray(problem.weights, dtype=float), dictionary.lengths)
    values = csc_array(dictionary.values.T)
    H, h = slanted(bound)
    if not h.size:
        return (
            (None if dictionary.is_indicators else csc_array(kron(eye_array(channels), values))),
            lower,
            upper,
            weights,
        )
    S = csc_array(vstack([kron(eye_array(channels), values), kron(csc_array(H), values)]))
    extra = np.repeat(h, dictionary.pieces)
    return (
        S,
        np.concatenate([lower, np.full(extra.size, -np.inf)]),
        np.concatenate([upper, extra]),
        np.concatenate([weights, np.zeros(extra.size)]),
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
    horizon = problem.horizon
    A, b = [np.zeros((0, functionals.variables))], [np.zeros(0)]
    middle = np.zeros((1, 0)) if parameters.set is None else parameters.set.interior_point()[None]
    for terminal in problem.terminal:
        if not isinstance(terminal, Equality):
            continue
        for state in terminal.fixed:
            time, up = np.array([horizon]), np.eye(terminal.dimension)[[state]]
            G, offset = functionals.rows(time, up, middle)
            sigma = functionals.offsets(time, up, middle) + functionals.offsets(time, -up, middle)
            rounding = SAME * max(1.0, float(np.abs(G).max()), float(np.abs(offset).max()))
            if sigma[0] > rounding or _reached(problem, parameters, int(state)):
                raise InputError(
                    f"terminal: equals: state {state + 1} depends on the uncertainty, so no control can fix its final"
                    f" value to {terminal.values[state]:g}; expected a set with interior"
                )
            A.append(G)
            b.append(np.array([terminal.values[state] - offset[0]]))
    return np.vstack(A), np.concatenate(b)


def _reached(problem: OptimalControlProblem, parameters: ParameterIndex, state: int) -> bool:
    """Whether an uncertain entry of the system may reach a state: follow the entries of ``A`` that are not exactly 0,
    over all parameters."""
    if parameters.set is None:
        return False
    system, box = problem.system, parameters.box
    try:
        parts = system.taylor(
            TaylorSpace(parameters.count, 1), (box.lower + box.upper) / 2, (box.upper - box.lower) / 2
        )
    except NotEnclosable:
        return True
    uncertain = [np.any(parts[k][1:] != 0, axis=(0, 2)) | np.any(parts[k + 1] != 0, axis=1) for k in (0, 2, 4)]
    linked = np.any(parts[0] != 0, axis=0) | (parts[1] != 0)
    reaching = np.arange(system.states) == state
    for _ in range(system.states):
        reaching = reaching | linked[reaching].any(axis=0)
    rows = uncertain[0] | uncertain[1] | (uncertain[2] if problem.disturbance is not None else False)
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
        disturbances = None if model is None else sample_disturbances(model, count, rng)
        drawn = sample_parameters(constraint.parameters.set, count, rng)
        return ScenarioConstraint(constraint, *sides, disturbances, drawn).family()

    model, reduced = constraint.functionals.disturbance, _reduced(constraint)
    literal = reduced if model is None else LiteralConstraint(constraint, model).family(reduced)
    nominal = replace(_reduced(constraint.nominal()), formulation="nominal", source=constraint)
    return replace(reduced, nominal=nominal, sample=sample, literal=literal)


def _reduced(constraint: StateConstraint) -> ConstraintFamily:
    return ConstraintFamily(
        name=constraint.name,
        index_set=constraint.index_set,
        rows=constraint.rows,
        worst=constraint.worst,
        enclosure=constraint.enclosure,
        cells=constraint.cells,
        gradient=Sensitivity(constraint).gradient,
        explain=constraint.explain,
        scale=constraint.scale,
        source=constraint,
    )
