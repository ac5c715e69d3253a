"""The units in which a problem's own numbers are of ordinary size (decision 0016)."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from sparserob_core.control.constraints.state import StateConstraint
from sparserob_core.control.problem.problem import OptimalControlProblem
from sparserob_core.control.problem.units import Units, power_of_two
from sparserob_core.control.reach.functional import WorstFunctionals
from sparserob_core.control.reach.sizes import widths
from sparserob_core.control.response.parameters import ParameterIndex
from sparserob_core.control.response.reference import MovingReference
from sparserob_core.control.sets.directions import sampled
from sparserob_core.sip.convex_set import Array, ConvexSet

MAX_SAMPLED_TIMES = 17  # at most, at which a reach is looked at
MAX_FUNCTIONAL_NUMBERS = 2_000_000  # numbers that functionals are made of
SAMPLED_PIECES = 1000  # pieces, in about so many of which a reach is computed
MAX_SAMPLED_PARAMETERS = 9  # at most, at which a reach is looked at: the middle and ends of axes; the diagonal adds two
LEAST_UNIT_SHARE = 2.0**-18  # of the numbers that are added up, the least unit: 1e-9 of it is 17 units of rounding
# Of the numbers that are added up: a set that is thinner holds no point that a solver of doubles finds, and counts as a
# point there. With a thousandth of it, balls of radius 1e-12 end undecided; with a thousand times as much, sets that
# are kept now would be excused more than their width. The checker's `THIN` is larger, so that it calls thin
# what is.
THIN_SET_SHARE = 2.0**-37
# Of how far a row of such a set reaches, its unit: a search leaves half a billionth of the unit, a claim may excuse a
# billionth of what the row does, which is less than it could. A tenth of it is what solvers are off by; with ten times
# as much, sets end undecided whose row does a tenth of what it could.
POINT_UNIT_SHARE = 2.0**-4
COST = 0.125  # of the largest possible cost, its unit: weights of a regulariser keep their size in the paper's problems
CHAINED = 1e150  # a state that a chain of couplings might bring beyond this is left to the response


def rough_units(problem: OptimalControlProblem) -> Units:
    """Return units from products of the problem's numbers alone: estimates of each state by one coupling after the
    other.

    Every step is a product or a maximum, so a change of units by powers of two changes them by exactly that.
    """
    system, bound = problem.system, problem.disturbance
    time = float(power_of_two(np.array(problem.horizon)))
    controls, disturbances = _choose_control_units(problem), np.ones(system.disturbances)
    if bound is not None:
        disturbances = power_of_two(extent(bound))
    index = ParameterIndex(system.parameters)
    parameters = np.ones(0) if system.parameters is None else power_of_two(_measure_widths(system.parameters))
    matrices = [mode.matrices(sampled_parameters(index)) for mode in system.forced.modes]
    A, B, E = _find_largest_entries(matrices)
    # a fast system is coupled through for a time of about 1/norm only; the eigenvalues do not depend on the units
    # (LAPACK balances)
    fastest = max(float(np.abs(np.linalg.eigvals(mode_matrices[0])).max()) for mode_matrices in matrices)
    coupling_time = float(power_of_two(np.array(min(time, 1.0 / fastest if fastest > 0.0 else np.inf))))
    inputs = controls if problem.initial_control is None else np.maximum(controls, np.abs(problem.initial_control))
    inputs = np.concatenate([inputs, np.ones(B.shape[1] - inputs.size)])  # that of a drift is 1
    initial_sizes = np.abs(np.asarray(problem.initial_state))
    if problem.initial_set is not None:
        initial_sizes = np.maximum(initial_sizes, extent(problem.initial_set))
    reach = np.maximum(initial_sizes, time * (B * inputs).max(axis=1, initial=0.0))
    if bound is not None:
        reach = np.maximum(reach, time * (E * disturbances).max(axis=1, initial=0.0))
    for _ in range(system.states - 1):
        reach = np.maximum(reach, coupling_time * (A * reach).max(axis=1))
    reach = np.where(reach < CHAINED, reach, 0.0)
    return Units(
        time, power_of_two(np.where(reach > 0.0, reach, walls(problem))), controls, disturbances, parameters, 1.0
    )


def own_units(problem: OptimalControlProblem, rough: Units, functionals: WorstFunctionals, control: ConvexSet) -> Units:
    """Return the units of a problem, from the largest distance of its states from 0. ``functionals`` and the set of the
    ``control`` are those of the problem in rough units."""
    axes, parameters = np.eye(problem.system.states), ParameterIndex(functionals.response.system.parameters)
    functionals = functionals.coarser(SAMPLED_PIECES)
    times = window_times(functionals, 0.0, float(functionals.response.grid.breakpoints[-1]))
    reach, _ = reaches(functionals, parameters, control, axes, times)
    usable = np.isfinite(reach) & (reach > 0.0)
    states = rough.states * power_of_two(np.where(usable, reach, 1.0))
    states = np.where(usable, states, power_of_two(walls(problem)))
    cost = COST * float(power_of_two(np.array(_estimate_cost_per_time(problem, states, rough.time)))) * rough.time
    return Units(rough.time, states, rough.controls, rough.disturbances, rough.parameters, cost)


def _choose_control_units(problem: OptimalControlProblem) -> Array:
    """Return a unit for every control, ``(m,)``. Controls of one group share a unit, since their norm is the norm of
    one vector."""
    size = extent(problem.control)
    for block in problem.cost.blocks:
        size[list(block)] = size[list(block)].max()
    return power_of_two(size)


def _estimate_cost_per_time(problem: OptimalControlProblem, states: Array, time: float) -> float:
    """Estimate the largest cost per time, where states are as large as their units. Their distance from a reference
    counts as the unit plus the reference."""
    size = extent(problem.control)
    total = float((problem.prices(np.array([0.0, problem.horizon]))[:, 0] * size).sum()) / problem.horizon
    state, control, final = problem.cost.terms
    for term, reach, over in ((state, states, 1.0), (control, size, 1.0), (final, states, time)):
        if term is not None:
            largest = reach + np.abs(term.reference)
            total += float(largest @ np.abs(term.Q) @ largest) / over
    return total


def row_units(constraint: StateConstraint, control: ConvexSet) -> Array:
    """Return the unit ``(r,)`` of each row of a constraint (`units_of_sides`).

    The rows of a curved set are multiples of its gauge. Their unit is 1, or the resolution of double precision where
    that is larger. For a set that is a point to rounding, the unit is `POINT_UNIT_SHARE` times the least reach of the
    rows in these multiples, at least 1.
    """
    functionals, sides = constraint.functionals.coarser(SAMPLED_PIECES), constraint.sides
    times = window_times(functionals, constraint.start, constraint.stop)
    reference = constraint.reference
    if sides is not None:
        offsets = MovingReference(reference, sides[0]).at(times) if reference.moves else None
        reach_and_sums = reaches(
            functionals, constraint.parameters, control, sides[0], times, offsets, constraint.gains
        )
        H, h = constraint_sides(constraint)
        size = np.abs(H).sum(axis=1)
        is_used = (size > 0.0) & np.isfinite(h)
        position = float((np.abs(h[is_used]) / size[is_used]).max(initial=0.0))
        near = size * max(position, _estimate_uncontrolled_reach(functionals, constraint.parameters))
        return units_of_sides(H, h, *reach_and_sums, near)
    box = constraint.index_set
    z = sampled(box.dimension - 1 - constraint.parameters.count)
    indices = np.hstack([np.tile(box.lower[: box.dimension - z.shape[1]], (z.shape[0], 1)), z])
    _, directions, _, heights = constraint.functionals_at(indices)
    _, sums = reaches(functionals, constraint.parameters, control, np.eye(directions.shape[1]), times)
    sums = sums + reference.size
    if (
        np.abs(directions) @ sums
    ).max() <= 1.0 / LEAST_UNIT_SHARE:  # a sum along c is at most |c| times those along the axes
        return np.ones(1)
    reach, sums = reaches(functionals, constraint.parameters, control, directions, times)
    sums = sums + reference.reach(directions)
    near = max(
        np.abs(heights).max(),
        np.abs(directions).sum(axis=1).max() * _estimate_uncontrolled_reach(functionals, constraint.parameters),
    )
    if (THIN_SET_SHARE * np.minimum(sums, near) > 1.0).all():
        reach = reach + reference.reach(directions)
        return np.maximum(1.0, power_of_two(np.array([POINT_UNIT_SHARE * reach[reach > 0.0].min(initial=sums.max())])))
    return np.maximum(1.0, power_of_two(np.array([LEAST_UNIT_SHARE * sums.max()])))


def shortfall(constraints: Sequence[StateConstraint]) -> float:
    """Return the smallest bound or width of a slab that is not 0, in the unit of its row, over constraints that are
    divided by their units; 1 where this is not below 1.

    A value below 1 means that the unit is the resolution of double precision for a control that uses its whole range.
    """
    least = 1.0
    for constraint in constraints:
        if constraint.sides is not None:
            H, h = constraint_sides(constraint)
            sizes = np.minimum(np.where(h != 0.0, np.abs(h), np.inf), np.where((w := widths(H, h)) > 0.0, w, np.inf))
            least = min(least, float(sizes.min(initial=1.0)))
    return least


def constraint_sides(constraint: StateConstraint) -> tuple[Array, Array]:
    """Return the rows of a constraint with flat sides; for a mixed constraint with their part on the control."""
    assert constraint.sides is not None
    H, h = constraint.sides
    return (H if constraint.gains is None else np.hstack([H, constraint.gains])), h


def units_of_sides(H: Array, h: Array, reach: Array, added: Array, driven: Array | float = np.inf) -> Array:
    """Return the unit ``(r,)`` of rows ``H x <= h``: the least of ``reach (r,)``, ``|h|`` and the width to the opposite
    row.

    The result is a power of two, 1.2 to 2.5 times below this value. The value is never below `LEAST_UNIT_SHARE` times
    the sums ``added (r,)``. Left out are numbers that are 0, and of ``|h|`` and the width those below `THIN_SET_SHARE`
    times the smaller one of ``added`` and ``driven (r,)``, the sums without growth and control. For a row whose width
    is that small, only `POINT_UNIT_SHARE` times ``reach`` counts, since nothing is left to keep away from the row.
    """
    least_sums = np.minimum(added, driven)
    across, thin = widths(H, h), np.where(np.isfinite(added), THIN_SET_SHARE * least_sums, 0.0)
    near = np.where(across > thin, np.stack([np.abs(h), across]), 0.0)
    reach = np.where(across > thin, 1.0, POINT_UNIT_SHARE) * reach
    sizes = np.vstack([reach[None], np.where(near > thin, near, 0.0)])
    sizes = np.where(np.isfinite(sizes) & (sizes > 0.0), sizes, np.inf).min(axis=0)
    least = np.where(np.isfinite(added), LEAST_UNIT_SHARE * added, 0.0)
    unit = np.where(np.isfinite(sizes), np.maximum(sizes, least), np.where(least > 0.0, least, 2.0))
    return power_of_two(unit) / 2.0


def units_of_steps(step: ConvexSet, H: Array, h: Array, control: ConvexSet) -> Array:
    """Return the unit ``(r,)`` of each side ``H a <= h`` of the steps of a control in its set (`units_of_sides`)."""
    largest_steps = 2.0 * np.abs(H) @ extent(control)
    return units_of_sides(H, h, np.minimum(step.reach(H), largest_steps), largest_steps)


def reaches(
    functionals: WorstFunctionals,
    parameters: ParameterIndex,
    control: ConvexSet,
    H: Array,
    times: Array,
    added_terms: Array | None = None,
    G: Array | None = None,
) -> tuple[Array, Array]:
    """Return the largest distance of ``H x(t)`` from 0 at some times, and the largest sum of absolute values from which
    it is computed.

    The largest values are taken over the control's set, the worst disturbance, the worst initial state and the
    parameters of `sampled_parameters`.

    Parameters
    ----------
    functionals : WorstFunctionals
        The worst-case functionals of the problem.
    parameters : ParameterIndex
        The set of the parameters.
    control : ConvexSet
        The set of the control.
    H : array (r, d)
        The rows on the state.
    times : array (T,)
        The times.
    added_terms : array (T, r), optional
        Numbers that are added to ``H x(t)``.
    G : array (r, m), optional
        Rows on the control: ``G u`` of any control is added.

    Returns
    -------
    reach : array (r,)
        The largest distances from 0.
    added : array (r,)
        The largest sums of absolute values.
    """
    points, r = sampled_parameters(parameters), H.shape[0]
    shape = (points.shape[0], r, times.size)
    at, p = np.tile(times, shape[0] * r), np.repeat(points, r * times.size, axis=0)
    directions = np.tile(np.repeat(H, times.size, axis=0), (shape[0], 1))
    up, down, magnitudes = (np.zeros(at.size) for _ in range(3))
    size = max(1, MAX_FUNCTIONAL_NUMBERS // functionals.response.numbers(p.shape[1]))
    for begin in range(0, at.size, size):
        batch = slice(begin, begin + size)
        free, on_inputs, on_noise = functionals.response.weights(at[batch], directions[batch], p[batch])
        on_control, known_effect = functionals.decided(on_inputs), functionals.given(on_inputs)
        offset = free @ functionals.response.initial_state + known_effect
        up[batch], down[batch] = (
            offset + control.support(on_control).sum(axis=1),
            control.support(-on_control).sum(axis=1) - offset,
        )
        magnitudes[batch] = np.abs(free) @ np.abs(functionals.response.initial_state)
        magnitudes[batch] += np.einsum("klm,ml->k", np.abs(on_inputs), np.abs(functionals.known))
        magnitudes[batch] += np.abs(on_control @ np.diag(extent(control))).sum(axis=(1, 2))
        model, initial = functionals.disturbance, functionals.initial
        if initial is not None:
            up[batch] += initial.support(free)
            down[batch] += initial.support(-free)
            magnitudes[batch] += np.abs(free) @ extent(initial)
        if model is not None:
            up[batch] += model.support(on_noise)
            down[batch] += model.support(-on_noise)
            magnitudes[batch] += np.abs(on_noise @ np.diag(extent(model.bound))).sum(axis=(1, 2))
    high, low, sums = (values.reshape(shape).swapaxes(1, 2) for values in (up, down, magnitudes))
    if added_terms is not None:
        high, low, sums = high + added_terms, low - added_terms, sums + np.abs(added_terms)
    if G is not None:
        high, low = high + control.support(G), low + control.support(-G)
        sums = sums + np.abs(G) @ extent(control)
    reach = np.maximum(np.maximum(high, low), 0.0).max(axis=(0, 1))
    return reach, sums.max(axis=(0, 1))


def _estimate_uncontrolled_reach(functionals: WorstFunctionals, parameters: ParameterIndex) -> float:
    """Estimate the largest distance of any state from 0 over the whole horizon, in own units, due to the initial state,
    drift, disturbance and one coupling. Amplification by an instability is left out, and so is the control, which need
    not act."""
    response, time = functionals.response, float(functionals.response.grid.breakpoints[-1])
    system = response.system
    A, B, E = _find_largest_entries([mode.matrices(sampled_parameters(parameters)) for mode in system.forced.modes])
    distances = np.abs(response.initial_state) + time * B[:, system.controls :].sum(axis=1)
    if functionals.initial is not None:
        distances = distances + extent(functionals.initial)
    if functionals.disturbance is not None:
        distances = distances + time * E @ extent(functionals.disturbance.bound)
    return float((distances + time * A @ distances).max())


def _find_largest_entries(every: Sequence[tuple[Array, Array, Array]]) -> list[Array]:
    """Return the largest absolute entries of ``A``, ``B`` and ``E`` over some parameters and all phases; the drift is a
    further column of ``B``."""
    return [np.abs(np.concatenate([matrices[index] for matrices in every])).max(axis=0) for index in range(3)]


def fixed(problem: OptimalControlProblem) -> tuple[Array, Array]:
    """Return the unit vectors ``(e, d)`` of the states that the terminal equalities fix, in the order of their rows,
    and the values ``(e,)`` of these states."""
    ends = problem.terminal_equalities
    states = np.array([state for end in ends for state in end.fixed], dtype=int)
    values = np.concatenate([np.zeros(0), *(end.values[end.fixed] for end in ends)])
    return np.eye(problem.system.states)[states], values


def added_up(problem: OptimalControlProblem, functionals: WorstFunctionals) -> Array:
    """Return the largest sums ``(e,)`` of absolute numbers from which the fixed states are computed."""
    H, no_parameters = fixed(problem)[0], ParameterIndex(None)
    if not H.size:
        return np.zeros(0)
    nominal = functionals if functionals.response.system.parameters is None else functionals.nominal()
    _, sums = reaches(nominal, no_parameters, problem.control, H, np.array([problem.horizon]))
    return sums


def sampled_parameters(parameters: ParameterIndex) -> Array:
    """Return a middle parameter, and support points along the axes and the diagonal, ``(v, nu)``."""
    if parameters.set is None:
        return np.zeros((1, 0))
    axes = np.eye(parameters.count)[: (MAX_SAMPLED_PARAMETERS - 1) // 2]
    points = parameters.set.support_point(np.vstack([axes, -axes]))
    corners = np.ones((1, parameters.count))
    outer = parameters.set.support_point(np.vstack([corners, -corners]))
    return np.vstack([parameters.set.interior_point()[None], points, outer])


def extent(convex: ConvexSet) -> Array:
    """Return the largest absolute value of each component of a bounded set, ``(d,)``."""
    return convex.reach(np.eye(convex.dimension))


def window_times(functionals: WorstFunctionals, start: float, stop: float) -> Array:
    """Return the ends of a window and some breakpoints between them."""
    breaks = functionals.response.grid.breakpoints
    inside = breaks[(breaks > start) & (breaks < stop)]
    chosen = np.unique(np.linspace(0, inside.size - 1, min(inside.size, MAX_SAMPLED_TIMES - 2)).round().astype(int))
    return np.unique(np.concatenate([[start], inside[chosen] if inside.size else inside, [stop]]))


def _measure_widths(convex: ConvexSet) -> Array:
    """Return the width of each component of a bounded set, or its distance from 0 where the width is 0."""
    axes = np.eye(convex.dimension)
    width = convex.width(axes)
    return np.where(width > 0.0, width, convex.reach(axes))


def walls(problem: OptimalControlProblem) -> Array:
    """Return the least bound other than 0 that a row or an equality gives each state by itself; 1 for a state without
    one. A set with a bound of 0 on either side of a state counts as none."""
    least = np.full(problem.system.states, np.inf)
    bounds = [np.abs(np.where(np.isnan(end.values), 0.0, end.values)) for end in problem.terminal_equalities]
    axes = np.eye(problem.system.states)
    for convex in (*(entry.set for entry in problem.of_states), *problem.terminal_sets):
        with np.errstate(invalid="ignore"):
            bounds.append(np.minimum(np.abs(convex.support(axes)), np.abs(convex.support(-axes))))
    for sizes in bounds:
        least = np.minimum(least, np.where(sizes > 0.0, sizes, np.inf))
    return np.where(np.isfinite(least), least, 1.0)
