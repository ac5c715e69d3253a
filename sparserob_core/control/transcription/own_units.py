"""The units in which a problem's own numbers are of ordinary size (decision 0016)."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from sparserob_core.control.constraints.state import StateConstraint
from sparserob_core.control.problem.problem import OptimalControlProblem
from sparserob_core.control.problem.units import Units, power_of_two
from sparserob_core.control.reach.functional import WorstCase
from sparserob_core.control.reach.sizes import widths
from sparserob_core.control.response.parameters import ParameterIndex
from sparserob_core.control.response.reference import Moving
from sparserob_core.control.sets.directions import sampled
from sparserob_core.sip.convex_set import Array, ConvexSet

TIMES = 17  # at most, at which a reach is looked at
AT_ONCE = 2_000_000  # numbers that functionals are made of
LOOKED_AT = 1000  # pieces, in about so many of which a reach is computed
PARAMETERS = 9  # at most, at which a reach is looked at
RESOLVED = 2.0**-18  # of the numbers that are added up, the least unit: 1e-9 of it is 17 units of rounding
# Of the numbers that are added up: a set that is thinner holds no point that a solver of doubles finds, and counts as a
# point there. With a thousandth of it, balls of radius 1e-12 end undecided; with a thousand times as much, sets that
# are kept now would be excused more than their width. The checker's `THIN` is larger, so that it calls thin what is.
THIN = 2.0**-37
# Of how far a row of such a set reaches, its unit: a search leaves half a billionth of the unit, a claim may excuse a
# billionth of what the row does, which is less than it could. A tenth of it is what solvers are off by; with ten times
# as much, sets end undecided whose row does a tenth of what it could.
POINT = 2.0**-4
COST = 0.125  # of the largest possible cost, its unit: weights of a regulariser keep their size in the paper's problems
CHAINED = 1e150  # a state that a chain of couplings might bring beyond this is left to the response


def rough_units(problem: OptimalControlProblem) -> Units:
    """Units from products of the problem's numbers alone: what one coupling after the other may bring into each state.

    Every step is a product or a maximum, so a change of units by powers of two changes them by exactly that.
    """
    system, bound = problem.system, problem.disturbance
    time = float(power_of_two(np.array(problem.horizon)))
    controls, disturbances = _control_units(problem), np.ones(system.disturbances)
    if bound is not None:
        disturbances = power_of_two(extent(bound))
    index = ParameterIndex(system.parameters)
    parameters = np.ones(0) if system.parameters is None else power_of_two(_widths(system.parameters))
    every = [mode.matrices(looked_at(index)) for mode in system.forced.modes]
    A, B, E = _largest(every)
    # a fast system is coupled through for a time of about 1/norm only; the eigenvalues do not depend on the units
    fastest = max(float(np.abs(np.linalg.eigvals(one[0])).max()) for one in every)  # LAPACK balances
    lasting = float(power_of_two(np.array(min(time, 1.0 / fastest if fastest > 0.0 else np.inf))))
    inputs = controls if problem.initial_control is None else np.maximum(controls, np.abs(problem.initial_control))
    inputs = np.concatenate([inputs, np.ones(B.shape[1] - inputs.size)])  # that of a drift is 1
    begun = np.abs(np.asarray(problem.initial_state))
    if problem.initial_set is not None:
        begun = np.maximum(begun, extent(problem.initial_set))
    reach = np.maximum(begun, time * (B * inputs).max(axis=1, initial=0.0))
    if bound is not None:
        reach = np.maximum(reach, time * (E * disturbances).max(axis=1, initial=0.0))
    for _ in range(system.states - 1):
        reach = np.maximum(reach, lasting * (A * reach).max(axis=1))
    reach = np.where(reach < CHAINED, reach, 0.0)
    return Units(
        time, power_of_two(np.where(reach > 0.0, reach, walls(problem))), controls, disturbances, parameters, 1.0
    )


def own_units(problem: OptimalControlProblem, rough: Units, functionals: WorstCase, control: ConvexSet) -> Units:
    """The units of a problem, from how far its states reach: ``functionals`` and the set of the ``control`` are those
    of the problem in rough units."""
    axes, parameters = np.eye(problem.system.states), ParameterIndex(functionals.response.system.parameters)
    functionals = functionals.coarser(LOOKED_AT)
    times = window_times(functionals, 0.0, float(functionals.response.grid.breakpoints[-1]))
    reach, _ = reaches(functionals, parameters, control, axes, times)
    usable = np.isfinite(reach) & (reach > 0.0)
    states = rough.states * power_of_two(np.where(usable, reach, 1.0))
    states = np.where(usable, states, power_of_two(walls(problem)))
    cost = COST * float(power_of_two(np.array(_cost_per_time(problem, states, rough.time)))) * rough.time
    return Units(rough.time, states, rough.controls, rough.disturbances, rough.parameters, cost)


def _control_units(problem: OptimalControlProblem) -> Array:
    """A unit for every control, ``(m,)``; one for all of a group, whose norm is that of one vector."""
    size = extent(problem.control)
    for block in problem.cost.blocks:
        size[list(block)] = size[list(block)].max()
    return power_of_two(size)


def _cost_per_time(problem: OptimalControlProblem, states: Array, time: float) -> float:
    """The largest cost per time, where states are as large as their units or their references."""
    size = extent(problem.control)
    total = float((problem.prices(np.array([0.0, problem.horizon]))[:, 0] * size).sum()) / problem.horizon
    state, control, final = problem.cost.terms
    for term, reach, over in ((state, states, 1.0), (control, size, 1.0), (final, states, time)):
        if term is not None:
            far = reach + np.abs(term.reference)
            total += float(far @ np.abs(term.Q) @ far) / over
    return total


def row_units(constraint: StateConstraint, control: ConvexSet) -> Array:
    """The unit ``(r,)`` of each row of a constraint: see `units_of_sides`; of a curved set, whose rows are in multiples
    of its gauge, 1, or what double precision resolves of that; of one that is a point to rounding, how far it reaches
    in these multiples."""
    functionals, sides = constraint.functionals.coarser(LOOKED_AT), constraint.sides
    times = window_times(functionals, constraint.start, constraint.stop)
    moved = constraint.reference
    if sides is not None:
        beside = Moving(moved, sides[0]).at(times) if moved.moves else None
        found = reaches(functionals, constraint.parameters, control, sides[0], times, beside, constraint.gains)
        H, h = constraint_sides(constraint)
        size = np.abs(H).sum(axis=1)
        used = (size > 0.0) & np.isfinite(h)
        place = float((np.abs(h[used]) / size[used]).max(initial=0.0))
        near = size * max(place, _driven(functionals, constraint.parameters))
        return units_of_sides(H, h, *found, near)
    box = constraint.index_set
    z = sampled(box.dimension - 1 - constraint.parameters.count)
    indices = np.hstack([np.tile(box.lower[: box.dimension - z.shape[1]], (z.shape[0], 1)), z])
    _, directions, _, heights = constraint.functionals_at(indices)
    _, added = reaches(functionals, constraint.parameters, control, np.eye(directions.shape[1]), times)
    added = added + moved.size
    if (np.abs(directions) @ added).max() <= 1.0 / RESOLVED:  # a sum along c is at most |c| times those along the axes
        return np.ones(1)
    reach, added = reaches(functionals, constraint.parameters, control, directions, times)
    added = added + moved.reach(directions)
    near = max(
        np.abs(heights).max(), np.abs(directions).sum(axis=1).max() * _driven(functionals, constraint.parameters)
    )
    if (THIN * np.minimum(added, near) > 1.0).all():
        reach = reach + moved.reach(directions)
        return np.maximum(1.0, power_of_two(np.array([POINT * reach[reach > 0.0].min(initial=added.max())])))
    return np.maximum(1.0, power_of_two(np.array([RESOLVED * added.max()])))


def shortfall(constraints: Sequence[StateConstraint]) -> float:
    """Of constraints that are divided by their units, the smallest bound or width of a slab that is not 0, in the
    row's unit, where that is below 1: the unit is then what double precision resolves of a control that goes as far as
    it may. Else 1."""
    least = 1.0
    for one in constraints:
        if one.sides is not None:
            H, h = constraint_sides(one)
            sizes = np.minimum(np.where(h != 0.0, np.abs(h), np.inf), np.where((w := widths(H, h)) > 0.0, w, np.inf))
            least = min(least, float(sizes.min(initial=1.0)))
    return least


def constraint_sides(constraint: StateConstraint) -> tuple[Array, Array]:
    """The rows of a constraint with flat sides, those of a mixed one with their part on the control."""
    assert constraint.sides is not None
    H, h = constraint.sides
    return (H if constraint.gains is None else np.hstack([H, constraint.gains])), h


def units_of_sides(H: Array, h: Array, reach: Array, added: Array, driven: Array | float = np.inf) -> Array:
    """The unit ``(r,)`` of rows ``H x <= h``: the least of ``reach (r,)``, ``|h|`` and the width to the opposite row,
    those of them that are not 0, nor `THIN` beside the sums ``added (r,)``, or beside what these are without growth
    and control, ``driven (r,)``; of a row whose width is, ``reach`` alone, since nothing is left to keep
    away from it. No less than what double precision resolves of these. A power of two, 1.2 to 2.5 times below that."""
    beside = np.minimum(added, driven)
    across, thin = widths(H, h), np.where(np.isfinite(added), THIN * beside, 0.0)
    near = np.where(across > thin, np.stack([np.abs(h), across]), 0.0)
    reach = np.where(across > thin, 1.0, POINT) * reach
    sizes = np.vstack([reach[None], np.where(near > thin, near, 0.0)])
    sizes = np.where(np.isfinite(sizes) & (sizes > 0.0), sizes, np.inf).min(axis=0)
    least = np.where(np.isfinite(added), RESOLVED * added, 0.0)
    unit = np.where(np.isfinite(sizes), np.maximum(sizes, least), np.where(least > 0.0, least, 2.0))
    return power_of_two(unit) / 2.0


def units_of_steps(step: ConvexSet, H: Array, h: Array, control: ConvexSet) -> Array:
    """The unit ``(r,)`` of each side ``H a <= h`` of the steps of a control in its set: see `units_of_sides`."""
    far = 2.0 * np.abs(H) @ extent(control)
    return units_of_sides(H, h, np.minimum(step.reach(H), far), far)


def reaches(
    functionals: WorstCase,
    parameters: ParameterIndex,
    control: ConvexSet,
    H: Array,
    times: Array,
    beside: Array | None = None,
    G: Array | None = None,
) -> tuple[Array, Array]:
    """How far the quantities ``H x(t)`` come from 0 at some times, over the control's set, the worst disturbance and
    the worst initial state, ``(r,)``, and the largest sum of absolute values from which they are computed, ``(r,)``.
    ``beside (times, r)`` is added to them, and ``G u`` of any control where there is ``G (r, m)``."""
    points, r = looked_at(parameters), H.shape[0]
    shape = (points.shape[0], r, times.size)
    at, p = np.tile(times, shape[0] * r), np.repeat(points, r * times.size, axis=0)
    directions = np.tile(np.repeat(H, times.size, axis=0), (shape[0], 1))
    up, down, added = (np.zeros(at.size) for _ in range(3))
    size = max(1, AT_ONCE // functionals.response.numbers(p.shape[1]))
    for begin in range(0, at.size, size):
        part = slice(begin, begin + size)
        free, every, on_noise = functionals.response.weights(at[part], directions[part], p[part])
        on_control, known = functionals.decided(every), functionals.given(every)
        rest = free @ functionals.response.initial_state + known
        up[part], down[part] = (
            rest + control.support(on_control).sum(axis=1),
            control.support(-on_control).sum(axis=1) - rest,
        )
        added[part] = np.abs(free) @ np.abs(functionals.response.initial_state)
        added[part] += np.einsum("klm,ml->k", np.abs(every), np.abs(functionals.known))
        added[part] += np.abs(on_control @ np.diag(extent(control))).sum(axis=(1, 2))
        model, initial = functionals.disturbance, functionals.initial
        if initial is not None:
            up[part] += initial.support(free)
            down[part] += initial.support(-free)
            added[part] += np.abs(free) @ extent(initial)
        if model is not None:
            up[part] += model.support(on_noise)
            down[part] += model.support(-on_noise)
            added[part] += np.abs(on_noise @ np.diag(extent(model.bound))).sum(axis=(1, 2))
    high, low, sums = (one.reshape(shape).swapaxes(1, 2) for one in (up, down, added))
    if beside is not None:
        high, low, sums = high + beside, low - beside, sums + np.abs(beside)
    if G is not None:
        high, low = high + control.support(G), low + control.support(-G)
        sums = sums + np.abs(G) @ extent(control)
    reach = np.maximum(np.maximum(high, low), 0.0).max(axis=(0, 1))
    return reach, sums.max(axis=(0, 1))


def _driven(functionals: WorstCase, parameters: ParameterIndex) -> float:
    """How far any state comes from 0 in the whole horizon, in own units, by where it begins, by drift and disturbance,
    and by one coupling: what no instability has amplified, and no control that need not act."""
    response, time = functionals.response, float(functionals.response.grid.breakpoints[-1])
    system = response.system
    A, B, E = _largest([mode.matrices(looked_at(parameters)) for mode in system.forced.modes])
    far = np.abs(response.initial_state) + time * B[:, system.controls :].sum(axis=1)
    if functionals.initial is not None:
        far = far + extent(functionals.initial)
    if functionals.disturbance is not None:
        far = far + time * E @ extent(functionals.disturbance.bound)
    return float((far + time * A @ far).max())


def _largest(every: Sequence[tuple[Array, Array, Array]]) -> list[Array]:
    """The absolute entries of ``A``, ``B`` and ``E``, with the drift as one more column of ``B``, at the largest of
    some parameters and in any of the phases."""
    return [np.abs(np.concatenate([one[part] for one in every])).max(axis=0) for part in range(3)]


def fixed(problem: OptimalControlProblem) -> tuple[Array, Array]:
    """The unit vectors ``(e, d)`` of the states that the terminal equalities fix, in the order of their rows, and the
    values ``(e,)`` of these states."""
    ends = problem.terminal_equalities
    states = np.array([state for end in ends for state in end.fixed], dtype=int)
    values = np.concatenate([np.zeros(0), *(end.values[end.fixed] for end in ends)])
    return np.eye(problem.system.states)[states], values


def added_up(problem: OptimalControlProblem, functionals: WorstCase) -> Array:
    """The largest sums ``(e,)`` of absolute numbers from which the fixed states are computed."""
    H, known = fixed(problem)[0], ParameterIndex(None)
    if not H.size:
        return np.zeros(0)
    nominal = functionals if functionals.response.system.parameters is None else functionals.nominal()
    _, added = reaches(nominal, known, problem.control, H, np.array([problem.horizon]))
    return added


def looked_at(parameters: ParameterIndex) -> Array:
    """A middle parameter and support points along the axes, ``(v, nu)``."""
    if parameters.set is None:
        return np.zeros((1, 0))
    axes = np.eye(parameters.count)[: (PARAMETERS - 1) // 2]
    points = parameters.set.support_point(np.vstack([axes, -axes]))
    corners = np.ones((1, parameters.count))
    outer = parameters.set.support_point(np.vstack([corners, -corners]))
    return np.vstack([parameters.set.interior_point()[None], points, outer])


def extent(convex: ConvexSet) -> Array:
    """How far each component of a bounded set comes from 0, ``(d,)``."""
    return convex.reach(np.eye(convex.dimension))


def window_times(functionals: WorstCase, start: float, stop: float) -> Array:
    """The ends of a window and some breakpoints between them."""
    breaks = functionals.response.grid.breakpoints
    inside = breaks[(breaks > start) & (breaks < stop)]
    chosen = np.unique(np.linspace(0, inside.size - 1, min(inside.size, TIMES - 2)).round().astype(int))
    return np.unique(np.concatenate([[start], inside[chosen] if inside.size else inside, [stop]]))


def _widths(convex: ConvexSet) -> Array:
    """The width of each component of a bounded set; where that is 0, its distance from 0."""
    axes = np.eye(convex.dimension)
    width = convex.width(axes)
    return np.where(width > 0.0, width, convex.reach(axes))


def walls(problem: OptimalControlProblem) -> Array:
    """The least bound other than 0 that a row or an equality on it alone gives each state; 1 without one."""
    least = np.full(problem.system.states, np.inf)
    every = [np.abs(np.where(np.isnan(end.values), 0.0, end.values)) for end in problem.terminal_equalities]
    axes = np.eye(problem.system.states)
    for convex in (*(entry.set for entry in problem.of_states), *problem.terminal_sets):
        with np.errstate(invalid="ignore"):
            every.append(np.minimum(np.abs(convex.support(axes)), np.abs(convex.support(-axes))))
    for sizes in every:
        least = np.minimum(least, np.where(sizes > 0.0, sizes, np.inf))
    return np.where(np.isfinite(least), least, 1.0)
