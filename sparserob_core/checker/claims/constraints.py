"""The proof of one state constraint from the cells of a certificate, and of the states that are fixed at the end.

Without feedback, no parameter, no disturbance and no choice of initial state may reach a fixed state. The control must
bring it to its value."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace
from functools import lru_cache
from itertools import groupby, pairwise
from typing import TYPE_CHECKING

import numpy as np
from flint import arb

from sparserob_core.checker.arithmetic.balls import balls, below, rationals
from sparserob_core.checker.arithmetic.remembered import remembered
from sparserob_core.checker.arithmetic.series import stacked
from sparserob_core.checker.arithmetic.subdivision import fill
from sparserob_core.checker.claims.answers import feedback_of
from sparserob_core.checker.claims.case import Case, number, numbers
from sparserob_core.checker.claims.cells import AnyTube, Interval, Proven, Work, prove
from sparserob_core.checker.claims.followed import FollowedRow
from sparserob_core.checker.claims.units import WindowUnits, nominal_sizes, units_of
from sparserob_core.checker.claims.window import ConstraintWindow
from sparserob_core.checker.flow.law import ParameterBox
from sparserob_core.checker.outcome import EQUALITY, TOLERANCE, Broken, Unchecked
from sparserob_core.checker.reach.states import Scene, States
from sparserob_core.checker.reach.tube import LoopTube, ProjectedStates, VerifiedTube
from sparserob_core.checker.sets.known import known
from sparserob_core.checker.sets.parameters import Corners, Parameters
from sparserob_core.checker.sets.shape import basis_of, width
from sparserob_core.checker.sets.sides import Bounded, Curved, Sides
from sparserob_core.control.problem.names import join_units, measured_in, unit_of_row
from sparserob_core.control.sets.sets import Box
from sparserob_core.sip.convex_set import Array, ConvexSet

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

TUBES_KEPT = 8
WIDER = 1e-12  # of their whole extent, by which boxes are widened where the set of parameters is no box


def bounded(case: Case, window: ConstraintWindow) -> str:
    """Show that a constraint is kept at every time, for every disturbance and every parameter; return a sentence with
    the upper bound of the excess, what is excused, and the number of cells."""
    data = case.certificate.get("proof", {})
    entry = data.get(window.name) if isinstance(data, Mapping) else None
    if not isinstance(entry, Mapping):
        if case.certificate.get("status") == "undecided":
            raise Unchecked("the certificate does not claim it")
        raise Broken("the certificate holds no proof of it")
    tolerance = number(entry, "tolerance")
    if not 0 < tolerance <= TOLERANCE * (1.0 + 1e-12):
        raise Broken(f"a violation of {tolerance:g} is to count as none, of its own unit at most {TOLERANCE:g} may")
    lower, upper = numbers(entry.get("lower"), "lower"), numbers(entry.get("upper"), "upper")
    if not lower.size:
        raise Unchecked("the certificate holds no cells for a constraint that was not proven on cells")
    normals = normals_of(window, entry.get("normals"))
    covered(case, window, lower, upper)
    if case.followed.are_best and window.enclosed_set.facets is not None:
        proven = _prove_by_adjoints(case, window)
    else:
        basis, gains, work = _prepare_work(case, window, normals, lower, upper)
        proven = prove_on_cells(case, window, (basis, gains), work, (lower, upper))
    size = f"{proven.cells} cells" + (f" in {proven.boxes} boxes" if proven.boxes > 1 else "")
    if proven.bound < 0:
        return f"kept, with a margin of at least {-proven.bound:.1e}{_format_units(case, window)} ({size})"
    return f"kept to {proven.bound:.1e}{_format_units(case, window)}{_format_tolerance(case, window, normals)} ({size})"


def _format_tolerance(case: Case, window: ConstraintWindow, normals: Array) -> str:
    """Return, in words, the largest violation that counts as none; of a curved set the largest along its normals."""
    if window.enclosed_set.facets is None:
        curved = Curved(window.enclosed_set, normals, units_of(case, window).least)
        axes = np.eye(len(normals))
        return f" of its gauge, where {max(curved.true(z).slack for z in np.vstack([axes, -axes])):.2g} is excused"
    return (
        f", where {TOLERANCE * float(units_of(case, window).rows.max(initial=0.0)):.1e}"
        f"{_format_units(case, window)} is excused"
    )


def _prove_by_adjoints(case: Case, window: ConstraintWindow) -> Proven:
    """Show by the adjoints of the rows that no row of a flat set is exceeded by more than what counts as none."""
    facets, units = window.enclosed_set.facets, units_of(case, window).rows.tolist()
    assert facets is not None
    count, bound, share = 0, -np.inf, -np.inf
    for (direction, b), unit in zip(facets, units, strict=True):
        row = Bounded(direction, below(b), unit)
        cells, top = FollowedRow(case, window, np.asarray(direction, dtype=float)).prove(row.allowed)
        over = float(np.nextafter(top - row.limit, np.inf))
        count, bound, share = count + cells, max(bound, over), max(share, over / unit)
    return Proven(bound, share, count, 1)


def _format_units(case: Case, window: ConstraintWindow) -> str:
    """Return the units of the rows of a window in words; none for a curved set, judged along its gauge."""
    sides = window.shape.halfspaces()
    rows = () if sides is None else sides[0]
    return join_units(unit_of_row(row, case.problem.names, window.states).strip() for row in rows)


def normals_of(window: ConstraintWindow, data: object) -> Array:
    """Return the vectors ``(b, d)`` whose combinations are the directions of a curved set: the normals of the
    certificate, or else the axes of the coordinates that the set bounds."""
    shape, b, d = window.enclosed_set, window.enclosed_set.spanned, window.shape.dimension
    if data is None:
        return shape.lifted(np.eye(b))
    normals = numbers(data, "normals")
    if normals.shape != (b, d) or not np.array_equal(shape.lifted(normals[:, :b]), normals):
        raise Broken(f"normals: expected {b} directions of the first {b} of {d} states, or of their sums with others")
    if rationals(normals[:, :b].tolist()).det() == 0:
        raise Broken("normals: the directions lie in a plane")
    return normals


def parameters_of(case: Case) -> Parameters:
    """Return the set of the parameters."""
    bound = case.problem.system.parameters
    return Parameters(None if bound is None else known(bound))


def covered(case: Case, window: ConstraintWindow, lower: Array, upper: Array) -> None:
    """Raise `Broken` unless the cells, with corners ``(k, 1 + nu + b)``, fill the window in time and the set of
    parameters, and for a curved set every face of the cube of directions."""
    nu = case.problem.system.parameter_count
    b = 0 if window.enclosed_set.facets is not None else window.enclosed_set.spanned
    if lower.ndim != 2 or lower.shape != upper.shape or lower.shape[1] != 1 + nu + b:
        raise Broken(f"its cells are no pairs of corners with {1 + nu + b} coordinates")
    low, high = _find_extent(case, window, lower, upper)
    if not b:
        fill(lower, upper, low, high, case.clock)
        return
    for axis in range(b):
        for sign in (-1.0, 1.0):
            face = 1 + nu + axis
            is_on_face = (lower[:, face] == sign) & (upper[:, face] == sign)
            ends = (np.append(low, -np.ones(b)), np.append(high, np.ones(b)))
            ends[0][face] = ends[1][face] = sign
            fill(lower[is_on_face], upper[is_on_face], *ends, case.clock)


def _find_extent(case: Case, window: ConstraintWindow, lower: Array, upper: Array) -> tuple[Array, Array]:
    """Return the corners ``(1 + nu,)`` of the times and parameters that the cells must fill. For a set that is no box
    they are those of the box around the cells, which must hold the set up to a share `WIDER` of its width."""
    nu, bound = case.problem.system.parameter_count, case.problem.system.parameters
    if bound is None:
        return np.array([window.start]), np.array([window.stop])
    if known(bound).is_box:
        box = bound.bounding_box()
        return np.append(window.start, box.lower), np.append(window.stop, box.upper)
    low, high = lower[:, 1 : 1 + nu].min(axis=0), upper[:, 1 : 1 + nu].max(axis=0)
    slack = balls(WIDER * (high - low))
    for i, axis in enumerate(np.eye(nu)):
        if not (
            known(bound).support(balls(axis)) <= balls(high)[i] + slack[i]
            and known(bound).support(balls(-axis)) <= -balls(low)[i] + slack[i]
        ):
            raise Broken("the cells leave out some of the parameters")
    return np.append(window.start, low), np.append(window.stop, high)


def _prepare_work(
    case: Case, window: ConstraintWindow, normals: Array, lower: Array, upper: Array
) -> tuple[Array, Array, list[Work]]:
    """Return the vectors that directions are combinations of, ``(b, d)`` on the state and ``(b, m)`` on the control,
    and the cells in the form that `prove` takes, with their times cut at every kink and jump."""
    nu, units = case.problem.system.parameter_count, units_of(case, window)
    basis, gains, flat = _extract_facets(window, units)
    curved = None if flat is not None else Curved(window.enclosed_set, normals, units.least)
    pairs = case.clock.each(zip(lower, upper, strict=True))
    keys = [(tuple(a[1:].tolist()), tuple(b[1:].tolist())) for a, b in pairs]
    order = sorted(range(len(keys)), key=lambda i: (keys[i], lower[i, 0]))
    work = list[Work]()
    for (a, b), members in groupby(order, key=lambda i: keys[i]):
        case.clock.check()
        sides = Sides.cell(curved, np.array(a[nu:]), np.array(b[nu:])) if curved is not None else flat
        assert sides is not None
        times = [(float(lower[i, 0]), float(upper[i, 0])) for i in case.clock.each(members)]
        work.append(((a[:nu], b[:nu]), sides, cut_times(case, window, times)))
    return normals if curved is not None else basis, gains, work


def cut_times(case: Case, window: ConstraintWindow, times: Sequence[tuple[float, float]]) -> list[Interval]:
    """Return the ``times``, each a start and an end, cut at every kink and jump of the state and of the rows."""
    cuts = np.union1d(_find_cuts(case), window.cuts(case.control.breakpoints.tolist()))
    return [interval for start, stop in times for interval in cut(np.array(case.timing.grid), cuts, start, stop)]


@remembered()
def _find_cuts(case: Case) -> Array:
    """Return the times between which one polynomial in time encloses the state, under one control."""
    return np.union1d(case.timing.grid, case.flows.marks(case.timing.grid))


def _extract_facets(window: ConstraintWindow, units: WindowUnits) -> tuple[Array, Array, Sides | None]:
    """Return the normals of a flat set's facets, on the state ``(b, d)`` and on the control ``(b, m)``, and its rows.
    Opposite facets share a normal. The rows are ``None`` for a curved set."""
    facet_basis, facets = basis_of(window.enclosed_set), window.enclosed_set.facets
    if facet_basis is None or facets is None:
        return np.zeros((0, 0)), np.zeros((0, 0)), None
    basis, z = facet_basis
    rows = [
        Bounded(direction, below(b), unit)
        for direction, (_, b), unit in zip(z, facets, units.rows.tolist(), strict=True)
    ]
    return basis[:, : window.states], basis[:, window.states :], Sides(rows)


def cut(grid: Array, cuts: Array, start: float, stop: float) -> list[Interval]:
    """Return the parts between the increasing ``cuts``, each with the piece of the ``grid`` that it lies in."""
    inside = cuts[np.searchsorted(cuts, start, side="right") : np.searchsorted(cuts, stop)].tolist()
    intervals = list(pairwise([start, *inside, stop]))
    pieces = np.searchsorted(grid, [a for a, _ in intervals], side="right") - 1
    return [(int(k), a, b) for k, (a, b) in zip(np.clip(pieces, 0, grid.size - 2), intervals, strict=True)]


def prove_on_cells(
    case: Case, window: ConstraintWindow, rows: tuple[Array, Array], work: Sequence[Work], cells: tuple[Array, Array]
) -> Proven:
    """Show with `prove` that a constraint is kept on the parts ``work`` of ``cells`` between lower and upper corners.
    The rows to bound are combinations of ``rows``, ``(b, d)`` on the state and ``(b, m)`` on the control."""
    added_terms = case.build_added_terms(window, *rows)
    return prove(tubes(case, *rows, *cells), parameters_of(case), work, case.clock, added_terms)


def tubes(case: Case, basis: Array, gains: Array, lower: Array, upper: Array) -> Callable[[Corners], AnyTube]:
    """Return a function that makes the reachable states over a box of parameters, for combinations of ``basis (b, d)``
    on the state and ``gains (b, m)`` on the control. Boxes of a set that is no box are widened by a share `WIDER` of
    the cells."""
    if case.answering:
        loop_tube = LoopTube(feedback_of(case).loop, basis, gains)
        return lambda _: loop_tube
    nu = case.problem.system.parameter_count
    widened = nu and not parameters_of(case).is_box
    extra = WIDER * (upper[:, 1 : 1 + nu].max(axis=0) - lower[:, 1 : 1 + nu].min(axis=0)) if widened else np.zeros(nu)
    projected_states = dict[int, ProjectedStates]()

    @lru_cache(maxsize=TUBES_KEPT)
    def tube(corners: Corners) -> VerifiedTube:
        box = ParameterBox.between(corners[0], corners[1]).wider(extra)
        states = case.states.over(box)
        if len(projected_states) >= TUBES_KEPT and id(states) not in projected_states:
            projected_states.clear()
        return VerifiedTube(projected_states.setdefault(id(states), ProjectedStates(states, basis)), box)

    return tube


def equalities(case: Case) -> str:
    """Show that every fixed state has its value at the end, for every parameter, disturbance and initial state; return
    a sentence with the largest residual."""
    worst, states = 0.0, np.eye(case.problem.system.states)[[state for state, _ in case.equalities]]
    sizes = nominal_sizes(case, states, np.zeros((len(states), 0))).tolist()
    for (state, value), (residual, term_size), size, row in zip(
        case.equalities, compute_residuals(case), sizes, states, strict=True
    ):
        allowed = min(EQUALITY * max(term_size, abs(value)), TOLERANCE * max(size, abs(value)))
        if not residual <= allowed:
            name, unit = case.problem.names.state(state), measured_in(row, case.problem.names)
            raise Broken(
                f"{name} is missed by up to {float(residual.upper()):.3g}{unit}, at most {allowed:.1e}{unit} is excused"
            )
        worst = max(worst, float(residual.upper()))
    return f"kept to {worst:.1e}{of_fixed(case)}"


def compute_residuals(case: Case) -> list[tuple[arb, float]]:
    """Return for every fixed state its largest absolute residual as a ball, and the size of the numbers added up to it:
    initial state, control, and deviations without the control and with it."""
    scene, d = replace(case.scene, disturbance=None, initial_set=None), case.problem.system.states
    horizon, whole_space = case.problem.horizon, Box(np.full(d, -np.inf), np.full(d, np.inf))
    sums = WindowUnits(case.problem, case.flows, scene, whole_space, horizon, horizon).sums
    feedback, residuals = feedback_of(case), []
    last = feedback.loop.nodes[-1].tolist() if case.answering else _compute_final_state(case, scene)
    for state, value in case.equalities:
        (final_value, *responses), (goal,) = last[state], balls([value])
        if not case.answering:
            final_value = (
                final_value * 0 if _is_at_rest(case, state) else final_value + compute_middle_effect(case, state)
            )
        residual = final_value - goal
        high, low = residual + feedback.support(responses), feedback.support([-x for x in responses]) - residual
        residuals.append((high.max(low), float(sums[state]) + (feedback.added(state) if case.answering else 0.0)))
    return residuals


def _compute_final_state(case: Case, scene: Scene) -> list[list[arb]]:
    """Return the undisturbed final state ``(d, 1)``; raise `Unchecked` where an uncertainty may reach a fixed entry."""
    for state, _ in case.equalities:
        if _is_uncertain(case, state):
            raise Unchecked(f"the uncertainty may reach {case.problem.names.state(state)}, which is to be fixed")
    return list(States(case.price.flow, scene).last.matrix.tolist())


def compute_middle_effect(case: Case, state: int) -> arb:
    """Return what the disturbance in the middle of its set adds to a state at the end."""
    (total,), middle = balls([0.0]), case.disturbances.middle
    if middle.any():
        end, column = case.problem.horizon, stacked([[w] for w in balls(middle)])
        ends = [t for t in case.timing.grid if t < end]
        for weights in case.price.flow.weights([*ends, end]).disturbance:
            total = total + (weights * column)[state, 0]
    return total


def of_fixed(case: Case) -> str:
    """Return the units of the fixed states in words."""
    units = case.problem.names.state_units
    return join_units(units[state] if units else "" for state, _ in case.equalities)


def _is_uncertain(case: Case, state: int) -> bool:
    """Return whether an uncertain entry, a disturbance or the choice of an initial state may reach a state. An
    uncertain entry of ``E`` counts where the middle of that disturbance is not 0."""
    reaching = _find_linked_states(case, state)
    rows = sorted(reaching)
    is_nonzero, is_parametric = case.flows.links
    d, m = case.problem.system.states, case.flows.plant.driven
    acting_columns = [*range(d + m), *(d + m + int(w) for w in np.flatnonzero(case.disturbances.middle))]
    is_uncertain = bool(is_parametric[np.ix_(rows, acting_columns)].any())
    bound = case.problem.disturbance
    free_disturbances = [] if bound is None else [w for w in range(bound.dimension) if _is_wide(bound, w)]
    is_disturbed = bool(is_nonzero[np.ix_(rows, [d + m + w for w in free_disturbances])].any())
    initial_set = case.problem.initial_set
    has_uncertain_start = initial_set is not None and any(
        known(initial_set).radius[j] > math.ulp(0.0) for j in reaching
    )
    return is_uncertain or is_disturbed or has_uncertain_start


def _is_wide(bound: ConvexSet, channel: int) -> bool:
    """Return whether a set may be more than one point along an axis; False only where it provably is one."""
    return not width(known(bound), channel) <= math.ulp(0.0)


def _is_at_rest(case: Case, state: int) -> bool:
    """Return whether a state provably starts at 0 and nothing ever moves it, uncertainties aside. Neither a linked
    state, nor a control of the decision, nor a drift, nor the middle of a disturbance may move it."""
    reaching, (is_nonzero, _) = _find_linked_states(case, state), case.flows.links
    m, initial_control = case.problem.system.controls, case.problem.initial_control
    commands = [
        *case.pieces,
        *([] if initial_control is None else [stacked([[u] for u in balls(np.asarray(initial_control))])]),
    ]
    idle = [all(command[channel, 0].is_zero() for command in commands) for channel in range(m)]
    d, input_count = case.problem.system.states, case.flows.plant.driven
    acting_columns = [d + channel for channel in range(input_count) if channel >= m or not idle[channel]]
    acting_columns += [d + input_count + int(w) for w in np.flatnonzero(case.disturbances.middle)]
    is_driven = bool(is_nonzero[np.ix_(sorted(reaching), acting_columns)].any())
    return not is_driven and not any(np.asarray(case.problem.initial_state)[[*reaching]])


def _find_linked_states(case: Case, state: int) -> set[int]:
    """Return the states that may reach a state, by entries of ``A`` that may differ from 0 at some time and
    parameter."""
    d, reaching = case.problem.system.states, {state}
    A = case.flows.links[0][:, :d]
    for _ in range(d):
        reaching |= {int(j) for i in reaching for j in np.flatnonzero(A[i])}
    return reaching
