"""The state at one time under an admissible disturbance and parameter, and its excess over a constraint.

The excess is that of a witness, or that of the worst disturbance."""

from __future__ import annotations

from bisect import bisect_right
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from flint import arb

from sparserob_core.checker.arithmetic.balls import ball, balls
from sparserob_core.checker.arithmetic.series import exactly, stacked
from sparserob_core.checker.claims.answers import NamedDeviations, commanded, feedback_of
from sparserob_core.checker.claims.case import EQUALS, Case, number, numbers, shaped
from sparserob_core.checker.claims.cells import AnyTube
from sparserob_core.checker.claims.constraints import compute_residuals
from sparserob_core.checker.claims.followed import FollowedRow
from sparserob_core.checker.claims.multipliers import admissible, asked, fixed_limit, piece_of, sized
from sparserob_core.checker.claims.units import units_of
from sparserob_core.checker.outcome import EQUALITY, TOLERANCE, Broken, Unchecked
from sparserob_core.checker.reach.states import States
from sparserob_core.checker.reach.tube import LoopTube, Polynomial, ProjectedStates, VerifiedTube
from sparserob_core.checker.sets.known import admit, known
from sparserob_core.checker.sets.shape import along, basis_of
from sparserob_core.control.problem.disturbances import columns_of
from sparserob_core.sip.convex_set import Array

if TYPE_CHECKING:
    from sparserob_core.checker.claims.window import ConstraintWindow

# The rounding error that is allowed in a reported violation where rows are followed, per state and in a row's unit:
# sums of so many terms are rounded. A run of 348 states whose modes have a condition number of 5e3 rounds by 1.6e-9,
# for which its proof allows. A tenth of this calls such a run wrong; ten times as much shows in the seventh digit of a
# wall.
ROUNDED = 1e-11


def compute_value(
    case: Case,
    c: Array,
    time: float,
    parameter: Array,
    deviation: Array | None,
    signal: Array | None,
    changes: Sequence[float] | None = None,
) -> arb:
    """Return ``c'x(t)``, ``c (d,)``, at a parameter ``(nu,)`` under the control of the case. The initial state has a
    ``deviation (d,)``, the disturbance is a ``signal (mw, M)`` that jumps at ``changes``, by default at the grid's
    breakpoints. Both are admissible, or ``None`` where the problem has none."""
    breaks = case.timing.grid
    changes = breaks if changes is None else changes
    grid = [0.0, *sorted({t for t in (*breaks, *changes) if 0.0 < t < time}), time]
    weights, value = case.duality.flows.weigh(c, parameter.tolist(), grid), ball(0.0)
    for state in (case.problem.initial_state, deviation):
        if state is not None:
            value = value + sum(w * x for w, x in zip(weights.free.entries(), balls(np.asarray(state)), strict=True))
    for start, of_control, of_disturbance in zip(grid, weights.control, weights.disturbance, strict=False):
        value = value + (of_control * case.scene.control[bisect_right(breaks, start) - 1])[0, 0]
        if signal is not None:
            w = signal[:, bisect_right(changes, start) - 1]
            value = value + (of_disturbance * stacked([[v] for v in balls(w)]))[0, 0]
    return value


def witnessed(case: Case, data: Mapping[str, Any]) -> tuple[arb, float]:
    """Return the excess of a witness over the constraint that it names, and how closely a figure of it must agree. Its
    disturbance and initial state must be admissible; the worst errors of execution are added."""
    name, time, direction = (
        str(data.get("constraint")),
        number(data, "time"),
        numbers(data.get("direction"), "direction"),
    )
    feedback, named, control_set = feedback_of(case), None, commanded(case, name)
    if case.answering:
        if case.problem.disturbance is not None and data.get("disturbance") is None:
            raise Unchecked("the certificate holds no disturbance of the witness")
        named = feedback.named(data, name)
    if control_set is not None:
        sized(direction, case.problem.system.controls, name)
        summands = feedback.parts_at(name, time)
        if len(summands) > 1 and case.answering:
            raise Unchecked("a witness across the seam is not followed")
        value, limit = (
            sum(_project_onto_direction(direction, named, summand.tolist()) for summand in summands),
            known(control_set).limit(direction),
        )
        slack = TOLERANCE * (1.0 if known(control_set).facets is None else max(known(control_set).units, default=1.0))
    elif name == EQUALS and named is not None:
        sized(direction, case.problem.system.states, name)
        value, limit = (
            _project_onto_direction(direction, named, feedback.loop.nodes[-1].tolist()),
            fixed_limit(case, direction, time),
        )
        slack = EQUALITY * max(term_size for _, term_size in compute_residuals(case))
    else:
        window, parameter = case.window(name), numbers(data.get("parameter", []), "parameter")
        sized(direction, window.shape.dimension, name)
        admissible(case, window, time, parameter)
        piece = piece_of(case, window, data, time) if window.is_mixed else None
        limit = window.limit(direction, time)
        slack = units_of(case, window).slack(direction, limit)
        if named is not None:
            rows = feedback.loop.state(case.timing.piece_at(time), time).tolist()
            value = _project_onto_direction(
                direction, named, rows if piece is None else rows + feedback.commands[piece].tolist()
            )
        else:
            (c, gain), is_measurable = window.split(direction), case.sources.measurable_input is not None
            value = (
                _enclose_largest_value(case, c, time, parameter.tolist())
                if is_measurable
                else compute_value(case, c, time, parameter, *_read_deviations(case, data))
            )
            if piece is not None:
                value = value + along(gain, case.pieces[piece].entries())
        execution = case.sources.delivered_at(parameter.tolist())
        if execution is not None:
            low, high = execution.added(window.split(direction)[0], time)
            value = value + ball(low).union(ball(high))
    return value - limit, slack


def excused(case: Case, data: Mapping[str, Any], slack: float) -> float:
    """Return the part of a witness's excess that counts as none: what a claim excuses, but at most ``slack``, the
    accuracy of the figure, which it is for constraints that are not on the state."""
    name, direction = str(data.get("constraint")), numbers(data.get("direction"), "direction")
    if commanded(case, name) is not None or (name == EQUALS and case.equalities):
        return slack
    window = case.window(name)
    return min(slack, units_of(case, window).excused(direction, window.limit(direction, number(data, "time"))))


def _enclose_largest_value(case: Case, c: Array, time: float, parameter: Sequence[float]) -> arb:
    """Return a ball that holds the largest ``c'x(t)``, ``c (d,)``, under measurable disturbances, at a parameter."""
    measurable_input = case.sources.measurable_input_at(parameter)
    assert measurable_input is not None
    row = case.duality.row(c, time, parameter, ball(0.0))
    low, high = measurable_input.added(c, time)
    total = row.constant + ball(low).union(ball(high))
    for slope, control in zip(row.slope, case.pieces, strict=True):
        total = total + sum((a * u for a, u in zip(slope, control.entries(), strict=True)), ball(0.0))
    return total


def _project_onto_direction(direction: Array, named: NamedDeviations | None, rows: Sequence[list[arb]]) -> arb:
    """Return ``c'x`` for rows with a nominal value and responses, ``(1 + Q,)`` each, under the named deviations.
    Without named deviations it is the nominal value."""
    return along(direction, [row[0] for row in rows] if named is None else named.of(rows))


def exceeded(case: Case, said: Mapping[str, object], initial_state: Array | None = None) -> tuple[list[float], float]:
    """Return the excess of the worst disturbance over each row of the constraint, at the time and parameter that a
    report has ``said``, as estimates; and a slack that says how closely a reported figure must agree. The
    ``initial_state (d,)`` is by default the worst one.

    A mixed constraint at a jump of the control has its rows on both sides. A curved set is `Unchecked`."""
    name, time, control_set = (
        str(said.get("constraint")),
        number(said, "time"),
        commanded(case, str(said.get("constraint"))),
    )
    number(said, "violation")
    if control_set is not None:
        facets, feedback = known(control_set).facets, feedback_of(case)
        if facets is None:
            raise Unchecked("the worst direction of a curved set is not told")
        heights = feedback.heights(feedback.parts_at(name, time), exactly(np.array([c for c, _ in facets])))
        slack = TOLERANCE * max(known(control_set).units, default=1.0)
        return [float((height - b).mid()) for height, (_, b) in zip(heights, facets, strict=True)], slack
    if name == EQUALS and case.equalities:
        residuals = compute_residuals(case)
        return [float(residual) for residual, _ in residuals], TOLERANCE * max(term_size for _, term_size in residuals)
    window, parameter = case.window(name), numbers(said.get("parameter", []), "parameter")
    asked(case, window, time, parameter)  # not `admissible`: rounding may take a parameter at the edge out of its set
    facets, facet_basis = window.enclosed_set.facets, basis_of(window.enclosed_set)
    if facets is None or facet_basis is None:
        raise Unchecked("the worst direction of a curved set is not told")
    pieces = _find_pieces(case, time, jumps=window.is_mixed)
    if case.followed.are_best:
        over, slack = _compute_excess_by_adjoints(case, window, time, initial_state, pieces)
        return over, slack + ROUNDED * case.problem.system.states * float(
            units_of(case, window).resolved.max(initial=0.0)
        )
    (basis, gains), z = np.split(facet_basis[0], [window.states], axis=1), facet_basis[1]
    tube = _build_tube(case, parameter, initial_state, basis, gains)
    added_terms = case.build_added_terms(window, basis, gains, parameter.tolist())
    polynomials = list[Polynomial]()
    for piece, k in pieces:
        cells = tube.cells(piece, time, time, z)
        polynomials += cells if added_terms is None else added_terms.added(cells, time, time, z, k)
    limits = [float(b) for _, b in facets] * (len(polynomials) // max(1, len(facets)))
    over = [float(poly.coefficients[0, 0]) - b for poly, b in zip(polynomials, limits, strict=True)]
    slack = max(float(poly.error) for poly in polynomials) + TOLERANCE * float(
        units_of(case, window).resolved.max(initial=0.0)
    )
    return over, slack


def _compute_excess_by_adjoints(
    case: Case, window: ConstraintWindow, time: float, initial_state: Array | None, pieces: Sequence[tuple[int, int]]
) -> tuple[list[float], float]:
    """Return the excess of the worst disturbance over each row of a flat set, by adjoints, with its accuracy."""
    facets, over, slack = window.enclosed_set.facets, list[float](), 0.0
    assert facets is not None
    breaks = case.control.breakpoints.tolist()
    for _, k in pieces:
        for direction, b in facets:
            row = FollowedRow(case, window, np.asarray(direction, dtype=float))
            worst = row.worst if initial_state is None else replace(row.worst, centre=initial_state, initial_set=None)
            (top,), (overestimate,) = worst.bound_largest_value(np.array([time]))
            low, high = row.enclose_added_terms(time, (breaks[k] + breaks[k + 1]) / 2)
            (error_low,), (error_high,) = row.add_inputs(np.array([time]))
            low, high = low + error_low, high + error_high
            over.append(float(top - overestimate / 3.0 + (low + high) / 2.0) - float(b))
            slack = max(slack, float(overestimate + high - low))
    return over, slack


def _find_pieces(case: Case, time: float, jumps: bool) -> list[tuple[int, int]]:
    """Return the pairs of a piece of the grid and a piece of the control that a time is in. Where the control
    ``jumps``, the pieces on both sides of the time count."""
    sides: tuple[Literal["left", "right"], ...] = ("left", "right") if jumps else ("right",)
    ends = np.array(case.timing.grid), case.control.breakpoints
    places = ([int(np.clip(np.searchsorted(e, time, side=side) - 1, 0, e.size - 2)) for e in ends] for side in sides)
    return sorted({(piece, k) for piece, k in places})


def _build_tube(case: Case, parameter: Array, initial_state: Array | None, basis: Array, gains: Array) -> AnyTube:
    """Return the reachable states at a parameter, from ``initial_state (d,)`` alone where it is given."""
    if case.answering:
        return LoopTube(feedback_of(case).loop, basis, gains)
    scene = (
        case.scene
        if initial_state is None
        else replace(case.scene, initial_state=initial_state.tolist(), initial_set=None)
    )
    flow = case.flows.at(parameter.tolist())
    return VerifiedTube(ProjectedStates(States(flow, scene), basis), flow.box)


def _read_deviations(case: Case, data: Mapping[str, Any]) -> tuple[Array | None, Array | None]:
    """Return the deviation ``(d,)`` of the initial state and the disturbance on the grid, as far as there are any;
    raise `Broken` unless they are shown to be admissible."""
    bound, deviation = case.problem.initial_set, None
    if bound is not None:
        deviation = shaped(data, "deviation", (bound.dimension,))
        if not known(bound).contains(deviation):
            raise Broken(f"the deviation {deviation.tolist()} of the initial state is not shown to be in its set")
    return deviation, None if case.problem.disturbance is None else _read_disturbance(case, data.get("disturbance"))


def _read_disturbance(case: Case, signal: object) -> Array:
    """Return the disturbance ``(mw, pieces)``, shown to be admissible; raise `Unchecked` where its grid is another."""
    bound = case.problem.disturbance
    assert bound is not None
    w = numbers(signal, "disturbance")
    if w.ndim != 2 or w.shape[0] != bound.dimension:
        raise Broken(f"disturbance: expected {bound.dimension} rows, got shape {w.shape}")
    if w.shape[1] != len(case.timing.grid) - 1:
        raise Unchecked("the disturbance is given on another grid")
    require_admissible(case, w, case.timing.grid)
    return w


def require_admissible(case: Case, signal: Array, times: Sequence[float]) -> None:
    """Raise `Broken` unless a disturbance ``(mw, M)``, whose values change at ``times (M + 1,)``, jumps only where it
    may, and is shown to be in its set."""
    bound = case.problem.disturbance
    assert bound is not None
    is_held = ~columns_of(bound, case.problem.disturbance_class, "measurable")
    for time, jumping in zip(times[1:-1], ((signal[:, 1:] != signal[:, :-1]) & is_held[:, None]).T, strict=True):
        if jumping.any() and (jumping & ~case.disturbances.may_jump(time)).any():
            raise Broken(f"the disturbance jumps within a piece, at t = {time:.6g}")
    shown_values = set[tuple[float, ...]]()
    for time, value in zip(times[:-1], case.clock.each(map(tuple, signal.T.tolist())), strict=True):
        if value not in shown_values and not known(bound).contains(value):
            raise Broken(f"the disturbance {list(value)} at t = {time:.6g} is not shown to be in its set")
        shown_values.add(value)
    if not admit(bound, np.diff(times), signal):
        raise Broken("the disturbance is not shown to keep its budget")
