"""The worst case of every row of a problem, as a number between two bounds, at a control that is given."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Literal, TypeAlias, final

import numpy as np

from sparserob_core.brief import brief
from sparserob_core.control.problem.dictionary import Dictionary
from sparserob_core.control.problem.names import measured_in
from sparserob_core.control.problem.problem import OptimalControlProblem
from sparserob_core.control.problem.terms.repeat import Return
from sparserob_core.control.problem.terms.windows import MixedConstraint, PathConstraint
from sparserob_core.control.reach.functional import WorstFunctionals
from sparserob_core.control.sets.sets import Polytope
from sparserob_core.control.studies.adjoint import Adjoint, DisturbanceInputs, WorstRow, tidy, within
from sparserob_core.control.studies.adversary import evaluate_disturbance, worst_signal
from sparserob_core.control.transcription.grid import grid_of
from sparserob_core.control.transcription.transcribe import prepare, windows_of
from sparserob_core.errors import InputError, NotEnclosable
from sparserob_core.shapes import sealed
from sparserob_core.sip.convex_set import Array, Box, ConvexSet
from sparserob_core.sip.events import Notify, ignore
from sparserob_core.sip.limits.deadline import Deadline
from sparserob_core.sip.program import ConstraintFamily, Enclosure
from sparserob_core.sip.proof.branch_and_bound import Supremum, supremum

Sense: TypeAlias = Literal["sup", "inf"]

OUTPUT, STATE = "output", "state"  # what rows are called that no constraint asks for
# Of the largest value of a row that is met: the enclosure of one that is near 0 is as wide as one of that
MIN_ROW_SHARE = 1e-3
ZERO_ROW_SHARE = 1e-12  # of a row's unit: one that is nowhere larger is 0 but for rounding, and is enclosed to its unit
FIRST_SAMPLED_TIMES = 65  # times at which values of a row are looked at first
BINS = 240  # equal parts of a window, on each of which both sides are told: the width of a figure in half points
MAX_SPELT_TERMS = 4  # of a row, at most, that are spelt out
WIDENING_SHARE = 2e-11  # of a row's largest value, by which both sides are reported wider: a checker rounds as well
TERMS_ROUNDING = 2e-12  # of the terms that make it, which are more where they cancel: rounding was a twentieth of that


@final
@dataclass(frozen=True, eq=False)
class Row:
    """``direction'(x(t) - r(t), u(t)) <= wall`` on a window: a row of a ``constraint`` with flat sides, or one that
    nothing bounds, with the wall infinite. Of a mixed one the direction has a part on the control, ``(d + m,)``;
    ``relative_to``: times and points of ``r``."""

    constraint: str
    direction: Array
    wall: float
    start: float
    stop: float
    relative_to: Array | None = None

    def __post_init__(self) -> None:
        sealed(self)

    @property
    def sense(self) -> Sense:
        """``inf`` where the first number of the direction is negative: what is bounded from below is then the
        quantity."""
        return "inf" if self.direction[np.flatnonzero(self.direction)[0]] < 0.0 else "sup"

    @property
    def sign(self) -> float:
        """Factor from the row to its quantity: 1 for ``sup``, -1 for ``inf``."""
        return 1.0 if self.sense == "sup" else -1.0

    def quantity(self, problem: OptimalControlProblem) -> str:
        """The row in words, with the sign that its sense says, of the states that were stated: what parameters beside
        the time add is told by `Corners.at`."""
        d, names = problem.system.states, problem.names
        used = np.flatnonzero(names.corners.without(self.direction)).tolist()
        if len(used) > MAX_SPELT_TERMS:
            return f"a combination of {len(used)} states"
        text = ""
        for i in used:
            factor = self.sign * float(self.direction[i])
            name = names.state(i) if i < d else names.control(i - d)
            size = "" if abs(factor) == 1.0 else f"{abs(factor):g} "
            join = (" - " if factor < 0 else " + ") if text else ""
            text += f"{join}{size}{name}"
        return text if self.relative_to is None else f"{text}, relative to its reference"

    def unit(self, problem: OptimalControlProblem) -> str:
        """The unit of the row, empty where none is known."""
        return measured_in(self.direction, problem.names, problem.system.states).strip()


def rows_of(problem: OptimalControlProblem) -> list[Row]:
    """The rows of the constraints with flat sides, on the path and at the end, integrals being states; of a problem
    that has none the outputs that are measured, each way, and where there are none the states. Fixed final states are
    no rows. Raises `InputError` where all constraints are curved."""
    rows: list[Row] = []
    curved: list[str] = []

    for name, entry in windows_of(problem):
        if isinstance(entry, Return):
            continue
        sides, reference_points = entry.set.halfspaces(), entry.relative_to
        if sides is None:
            curved.append(name)
            continue
        reference = None if reference_points is None else np.asarray(reference_points, dtype=float)
        stop = problem.horizon if entry.stop is None else entry.stop
        rows += [
            Row(name, direction, float(wall), entry.start, stop, reference)
            for direction, wall in zip(*sides, strict=True)
            if np.isfinite(wall)
        ]
    if rows:
        return rows
    if curved:
        raise InputError(
            f"{', '.join(curved)}: expected a constraint with flat sides, whose rows have a worst case each, got only"
            " curved ones"
        )
    name, directions = STATE, np.eye(problem.system.states)
    if problem.measurements is not None:
        name, directions = OUTPUT, np.asarray(problem.measurements.C, dtype=float)
    return [
        Row(name, sign * direction, np.inf, 0.0, problem.horizon) for direction in directions for sign in (1.0, -1.0)
    ]


@final
@dataclass(frozen=True, eq=False)
class BoundedRow:
    """The largest value of a ``row``: at least ``lower``, which is reached at ``time`` with ``parameter (nu,)``, from
    ``initial_state (d,)``, under ``disturbance (mw, M)`` between the times ``changes (M + 1,)`` (``None``: there is
    none); at most ``upper``, which is proven over the continuum.

    ``edges (n + 1,)``: parts of the window, on each of which the worst case is at least ``low (n,)``, reached in its
    middle, and at most ``high (n,)``; nothing of a window of one time. ``cells``: how many were examined; ``reason``:
    what hindered the sides from being as close as was asked for.
    """

    row: Row
    lower: float
    upper: float
    time: float
    parameter: Array
    deviation: Array
    changes: Array
    disturbance: Array | None
    edges: Array
    low: Array
    high: Array
    cells: int
    reason: str = ""

    __repr__ = brief

    def __post_init__(self) -> None:
        sealed(self)


def bound_row(
    problem: OptimalControlProblem,
    dictionaries: tuple[Dictionary, Dictionary],
    theta: Array,
    row: Row,
    tolerance: float,
    notify: Notify = ignore,
    deadline: Deadline | None = None,
) -> BoundedRow:
    """Enclose the worst case of a row at the control ``theta (m, N)``, to a ``tolerance`` relative to it.

    At least `MIN_ROW_SHARE` of the largest value that the row has anywhere in its window counts as its size, or of its
    unit where that is 0 but for rounding. Dictionaries are those of control and disturbance."""
    worst = follow_row(problem, dictionaries, theta, row)
    if worst is not None:
        return _bound_known_row(worst, row, tolerance, notify, deadline)
    return _bound_by_program(problem, dictionaries, theta, row, tolerance, notify, deadline)


def follow_row(
    problem: OptimalControlProblem, dictionaries: tuple[Dictionary, Dictionary], theta: Array, row: Row
) -> WorstRow | None:
    """The row by its adjoint; ``None`` where the system has parameters or pieces, or changes with time, or where
    disturbances are of a kind that adds up otherwise, or there are errors of execution."""
    control, disturbance = dictionaries
    system, d = problem.system, problem.system.states
    classes = problem.classes
    is_one_class = len(classes) <= 1 and problem.disturbance_breakpoints is None
    is_one_class = is_one_class and not problem.has_budget
    has_errors = problem.delivery is not None and theta.any()  # what stands still is delivered as it is commanded
    if not system.is_constant or system.parameter_count or not is_one_class or has_errors:
        return None
    changes: Array | None = None
    if classes == {"piecewise_constant"}:
        jumps = np.flatnonzero(disturbance.changes) + 1
        if disturbance.functions != jumps.size + 1:
            return None
        changes = disturbance.breakpoints[[0, *jumps, -1]]
    elif problem.disturbance is not None and (classes != {"measurable"} or problem.disturbance.halfspaces() is None):
        return None
    A, B, E = (matrix[0] for matrix in system.forced.phases[0].matrices(np.zeros((1, 0))))
    grid = grid_of(problem, control.breakpoints, disturbance.breakpoints)
    pieces = control.control(theta)
    inputs = np.hstack([B, E]) if problem.disturbance is not None else B
    state, gains = row.direction[:d], row.direction[d:]
    adjoint = Adjoint.of(np.asarray(A, dtype=float), inputs, state, problem.horizon)
    reference = None if row.relative_to is None else (row.relative_to[:, 0], row.relative_to[:, 1:] @ state)
    return WorstRow(
        adjoint,
        np.asarray(problem.initial_state, dtype=float),
        problem.initial_set,
        grid.breakpoints,
        grid.inputs(pieces),
        None
        if problem.disturbance is None
        else DisturbanceInputs(problem.disturbance, slice(B.shape[1], inputs.shape[1]), changes),
        (control.breakpoints, gains @ pieces) if gains.size else None,
        reference,
    )


def _bound_known_row(
    worst: WorstRow, row: Row, tolerance: float, notify: Notify, deadline: Deadline | None
) -> BoundedRow:
    cuts, window = worst.cuts(), np.array([row.start, row.stop])
    cuts = np.unique(np.concatenate([window, cuts[(cuts > row.start) & (cuts < row.stop)]]))
    cells = (cuts[:-1], cuts[1:]) if cuts.size > 1 else (cuts, cuts)
    family = ConstraintFamily(
        name=row.constraint,
        index_set=Box(window[:1], window[1:]),
        rows=lambda times: (np.zeros((times.shape[0], 1, 1)), -worst.at(times[:, 0])[0][:, None]),
        enclosure=lambda _, lower, upper: Enclosure(
            worst.enclosed(lower[:, 0], upper[:, 0]), np.zeros(lower.shape[0], dtype=int)
        ),
        cells=(cells[0][:, None], cells[1][:, None]),
    )
    times = np.linspace(row.start, row.stop, FIRST_SAMPLED_TIMES)
    samples = worst.at(times)[0]
    bounds = supremum(
        family, np.zeros(1), tolerance, MIN_ROW_SHARE * float(np.abs(samples).max()), notify, deadline=deadline
    )
    # cells are probed in their middles, and what grows until the end of its window is largest there
    best = float(times[samples.argmax()]) if samples.max() > bounds.lower else float(bounds.index[0])
    tidied = float(tidy(np.array([best]), float(worst.grid[-1]))[0])
    time = tidied if row.start <= tidied <= row.stop else best
    state, changes, disturbance = worst.witness(time)
    edges, middles = _divide_window(row)
    rounding_error = WIDENING_SHARE * max(float(np.abs(samples).max()), abs(bounds.lower)) + worst.error_bound
    return BoundedRow(
        row,
        worst.evaluate(time, state, changes, disturbance) - rounding_error,
        bounds.upper + rounding_error,
        time,
        np.zeros(0),
        state,
        changes,
        disturbance,
        edges,
        worst.at(middles)[0] - worst.error_bound,
        _bound_bins(edges, bounds),
        bounds.cells,
        bounds.reason,
    )


def _divide_window(row: Row) -> tuple[Array, Array]:
    """The ends of equal parts of a window, and their middles; nothing of a window of one time."""
    if row.stop <= row.start:
        return np.zeros(0), np.zeros(0)
    edges = np.linspace(row.start, row.stop, BINS + 1)
    return edges, (edges[:-1] + edges[1:]) / 2


def _bound_bins(edges: Array, found: Supremum) -> Array:
    """The largest bound of the cells that meet each part."""
    lower, upper, bounds = found.leaves[0][:, 0], found.leaves[1][:, 0], found.leaves[2]
    return np.array([bounds[(lower < b) & (upper > a)].max(initial=-np.inf) for a, b in pairwise(edges.tolist())])


def _bound_by_program(
    problem: OptimalControlProblem,
    dictionaries: tuple[Dictionary, Dictionary],
    theta: Array,
    row: Row,
    tolerance: float,
    notify: Notify,
    deadline: Deadline | None,
) -> BoundedRow:
    """Bound a row by the enclosures of the program whose only constraint is the row, with the wall at 0."""
    d = problem.system.states
    path: list[PathConstraint | MixedConstraint] = []
    end: list[ConvexSet] = []
    wall = np.zeros(1)
    if row.direction.size > d:
        path = [MixedConstraint(row.direction[None, :d], row.direction[None, d:], wall, row.start, row.stop)]
    elif row.start == row.stop == problem.horizon:
        end = [Polytope(row.direction[None], wall)]
    else:
        path = [PathConstraint(Polytope(row.direction[None], wall), row.start, row.stop, relative_to=row.relative_to)]
    single_row = replace(problem, path=path, terminal=end, control_step=None, repeat=False)
    model = prepare(single_row, *dictionaries)
    own = model.program.own_units
    assert own is not None
    family, decision = own.program.families[0], model.functionals.decided_by(theta) / own.decision
    units, unit = np.asarray(family.index_units), family.row_unit(0)
    middle = (family.index_set.lower + family.index_set.upper) / 2
    times = np.linspace(family.index_set.lower[0], family.index_set.upper[0], FIRST_SAMPLED_TIMES)
    samples = family.violations(decision, np.hstack([times[:, None], np.tile(middle[1:], (FIRST_SAMPLED_TIMES, 1))]))
    parameter = model.parameters.clamp((middle * units)[None, 1:])
    magnitude = _sum_magnitudes(model.functionals, theta, row.direction[:d], times * units[0], parameter)
    largest = float(np.abs(samples).max())
    size = largest if max(largest, magnitude / unit) > ZERO_ROW_SHARE else 1.0
    try:
        bounds = supremum(family, decision, tolerance, MIN_ROW_SHARE * size, notify, deadline=deadline)
    except NotEnclosable as error:
        index = np.append(times[samples[:, 0].argmax()], middle[1:])
        leaves = (family.index_set.lower[None], family.index_set.upper[None], np.full(1, np.inf))
        bounds = Supremum(float(samples.max()), np.inf, index, 0, 0, leaves, str(error))
    index, functionals, bound = bounds.index * units, model.functionals, problem.system.parameters
    time, parameter = float(index[0]), model.parameters.clamp(index[None, 1:])[0]
    parameter = parameter if bound is None else within(bound, parameter)
    at = np.array([time]), row.direction[None, :d], parameter[None]
    deviation, initial_set = functionals.worst_deviations(*at)[0], problem.initial_set
    of_state = time, row.direction[:d], parameter
    changes, disturbance = worst_signal(functionals, *of_state)
    shortfall = 0.0
    if disturbance is not None and problem.disturbance is not None:
        disturbance = within(problem.disturbance, disturbance.T).T
        if functionals.measurable is not None:  # whose worst signal is found to rounding, or less
            support = float(functionals.offsets(*at)[0]) - functionals.parts(*of_state).initial_support
            shortfall = max(0.0, support - evaluate_disturbance(functionals, *of_state, (changes, disturbance)))
    edges, middles = _divide_window(row)
    low = np.full(middles.size, -np.inf)
    for p in (bounds.index[1:], middle[1:]):
        indices = np.hstack([(middles / units[0])[:, None], np.tile(p, (middles.size, 1))])
        low = np.maximum(low, family.violations(decision, indices)[:, 0] if middles.size else low)
    rounding_error = max(WIDENING_SHARE * max(size, abs(bounds.lower)), TERMS_ROUNDING * magnitude / unit)
    own_edges = edges / units[0]
    return BoundedRow(
        row,
        unit * (bounds.lower - rounding_error) - shortfall,
        unit * (bounds.upper + rounding_error),
        time,
        parameter,
        deviation if initial_set is None else within(initial_set, deviation),
        changes,
        disturbance,
        edges,
        unit * (low - rounding_error),
        unit * (_bound_bins(own_edges, bounds) + rounding_error),
        bounds.cells,
        bounds.reason,
    )


def _sum_magnitudes(functionals: WorstFunctionals, theta: Array, state: Array, times: Array, parameter: Array) -> float:
    """The largest sum of the sizes of what makes a row ``state (d,)`` beside the disturbance, at ``times (k,)`` and
    ``parameter (1, nu)``: so much is rounded where the row itself is near 0."""
    at = times, np.tile(state, (times.size, 1)), np.repeat(parameter, times.size, axis=0)
    weights, response = functionals.response.weights(*at), functionals.response
    initial_effect = np.abs(weights.free) @ np.abs(response.initial_state)
    control_effect = np.einsum("klm,ml->k", np.abs(weights.control), np.abs(functionals.on_grid(theta.ravel())))
    return float((initial_effect + control_effect).max())


Announce: TypeAlias = Callable[[str, int, int], None]


def bound_rows(
    problem: OptimalControlProblem,
    dictionaries: tuple[Dictionary, Dictionary],
    theta: Array,
    tolerance: float,
    announce: Announce,
    notify: Notify = ignore,
    deadline: Deadline | None = None,
) -> list[BoundedRow]:
    """Bound all rows of a problem (`rows_of`) by `bound_row`; before each row, ``announce`` receives its description,
    its number, and the number of rows."""
    rows, bounds = rows_of(problem), []
    for i, row in enumerate(rows):
        at = problem.names.corners.at(row.direction)
        announce(
            f"{row.constraint}: {row.sense} of {row.quantity(problem)}" + (f" at {at}" if at else ""),
            i,
            len(rows),
        )
        bounds.append(bound_row(problem, dictionaries, theta, row, tolerance, notify, deadline))
    return bounds
