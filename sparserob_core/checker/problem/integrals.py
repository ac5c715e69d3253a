"""Bounded integrals, as coordinates of a larger state: derived from the problem's records alone.

After the ``d`` states of the problem comes one coordinate for each row of each integral, in their order. Its derivative
is ``h'x + g'u`` while the row is integrated, and 0 otherwise. With a delay, ``u`` is the control that acts. A row with
both ``h`` and ``g`` is then two coordinates, first that of ``h``, and the second is integrated later by the delay.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Any, TypeAlias, final

import numpy as np

from sparserob_core.control.policies.measurements import Measurements
from sparserob_core.control.problem.cost import Quadratic
from sparserob_core.control.problem.names import Names
from sparserob_core.control.problem.phase import Phase
from sparserob_core.control.problem.problem import OptimalControlProblem
from sparserob_core.control.problem.system import System
from sparserob_core.control.problem.terms.integral import Accumulated, IntegralConstraint
from sparserob_core.control.problem.terms.repeat import Return
from sparserob_core.control.problem.terms.windows import MixedConstraint, PathConstraint
from sparserob_core.control.sets.sets import Box, ConvexSet, Cylinder, Equality, Polytope, Product
from sparserob_core.errors import InputError
from sparserob_core.sip.convex_set import Array

APART = 1e-12  # relative to the horizon: nearer times are one; ten times more would join times that a clock separates


@final
@dataclass(frozen=True, eq=False)
class Coordinate:
    """The integrand ``h'x + g'u`` of one coordinate, ``h (d,)`` of the state and ``g (m,)`` of the control that acts,
    and its window of time. Files use its ``name`` and ``unit``."""

    h: Array
    g: Array
    begin: float
    end: float
    name: str
    unit: str


@final
@dataclass(frozen=True, eq=False)
class Above:
    """A matrix of a system at any parameter, enlarged by zeros at its right and by the rows ``below``."""

    top: object
    below: Array

    def __call__(self, p: object) -> object:
        table = np.asarray(self.top(p) if callable(self.top) else self.top)
        (n, columns), (k, width) = table.shape, self.below.shape
        enlarged = np.zeros((n + k, width), dtype=object)
        enlarged[:n, :columns], enlarged[n:] = table, self.below
        return enlarged


Rows: TypeAlias = list[PathConstraint | MixedConstraint | IntegralConstraint]
DERIVED: dict[type, Callable[[Any, str], Rows]] = {
    kind: lambda entry, called: [replace(entry, name=called)]
    for kind in (PathConstraint, MixedConstraint, Return, Accumulated, IntegralConstraint)
}
"""The function that writes a constraint as windows and integrals with a given name, by the exact kind of constraint."""


def spelt(problem: OptimalControlProblem) -> OptimalControlProblem:
    """Return the problem with all constraints written as windows and integrals; the problem itself where they are. A
    constraint that is not among the `DERIVED` ones raises `InputError`, so that none is ignored."""
    constraints = [(name, entry) for name, entries in problem.lists.items() for entry in entries]
    for name, entry in constraints:
        if type(entry) not in DERIVED:
            expected = "a constraint that the checker derives too"
            raise InputError(path=name, expected=expected, got=type(entry).__name__)
    if all(name in ("path", "integral") for name, _ in constraints):
        return problem
    lists: dict[str, Any] = {name: [] for name in problem.lists}
    for name, entries in problem.lists.items():
        for i, entry in enumerate(entries):
            label = entry.name or (name if len(entries) == 1 else f"{name}[{i}]")
            for row in DERIVED[type(entry)](entry, label):
                lists["integral" if isinstance(row, IntegralConstraint) else "path"].append(row)
    return replace(problem, **lists)


def integrating(problem: OptimalControlProblem) -> OptimalControlProblem:
    """Return the problem with one more coordinate for every integral; the problem itself where there is none."""
    if not problem.integral:
        return problem
    d, (coordinates, windows) = problem.system.states, _derive_coordinates(problem)
    size = d + len(coordinates)
    return replace(
        problem,
        **with_zeros(problem, len(coordinates)),
        system=_extend_system(problem.system, coordinates, problem.horizon),
        path=[
            *(_extend_constraint(entry, size) for entry in problem.windows),
            *(Accumulated(_make_sum_set(sums, size), time, time, name) for name, time, sums in windows),
        ],
        terminal=[
            Equality(np.pad(end.values, (0, size - d), constant_values=np.nan))
            if isinstance(end, Equality)
            else _extend_set(end, size)
            for end in problem.terminal
        ],
        integral=(),
        names=_extend_names(problem, coordinates),
        commanded=tuple(
            d + i for i, coordinate in enumerate(coordinates) if coordinate.g.any() and problem.execution is not None
        ),
    )


def _derive_coordinates(
    problem: OptimalControlProblem,
) -> tuple[list[Coordinate], list[tuple[str, float, list[tuple[list[int], float, float]]]]]:
    """Return the coordinates of all integrals; and for every integral its name, the time when it is judged, and for
    every row the coordinates that are added up, with their bounds."""
    d, m = problem.system.states, problem.system.controls
    coordinates, windows = list[Coordinate](), list[tuple[str, float, list[tuple[list[int], float, float]]]]()
    for number, entry in enumerate(problem.integral):
        H, G = np.reshape(np.asarray(entry.H), (-1, d)), np.reshape(np.asarray(entry.G), (-1, m))
        delay = problem.system.delay if G.any() else 0.0
        assert entry.stop is not None
        judged_at, sums = min(entry.stop + delay, problem.horizon), []
        label = entry.name or ("integral" if len(problem.integral) == 1 else f"integral[{number}]")
        bounds = zip(np.asarray(entry.lower).tolist(), np.asarray(entry.upper).tolist(), strict=True)
        for row, (h, g, (lower, upper)) in enumerate(zip(H, G, bounds, strict=True)):
            name, unit = label + (f" {row + 1}" if len(H) > 1 else ""), _derive_unit(problem.names, h, g)
            coords = [Coordinate(h, g, entry.start, entry.stop, name, unit)]
            if g.any() and (delay or problem.execution is not None):  # commands count, their errors do not
                names = [f"{name} of states", f"{name} of controls"] if h.any() else [name]
                coords = [Coordinate(0.0 * h, g, entry.start + delay, judged_at, names[-1], unit)]
                coords = [Coordinate(h, 0.0 * g, entry.start, entry.stop, names[0], unit)] * (len(names) - 1) + coords
            sums.append(([d + len(coordinates) + i for i in range(len(coords))], lower, upper))
            coordinates += coords
        windows.append((label, judged_at, sums))
    if not problem.system.switches and not any(coordinate.begin > 0.0 for coordinate in coordinates):
        # a system of one phase remains one
        coordinates = [replace(coordinate, end=problem.horizon) for coordinate in coordinates]
    return coordinates, windows


def _extend_system(system: System, coordinates: list[Coordinate], horizon: float) -> System:
    """Return the system with its coordinates, divided where one of them begins or ends."""
    switches = [phase.begin for phase in system.phases[1:]]
    boundaries = [*switches, horizon]
    for time in sorted({t for coordinate in coordinates for t in (coordinate.begin, coordinate.end)}):
        if all(abs(time - boundary) > APART * horizon for boundary in (0.0, *boundaries)):
            boundaries.append(time)
    phases = []
    for begin, until in pairwise([0.0, *sorted(boundaries)]):
        number = sum(switch <= begin for switch in switches)
        phases.append(
            _extend_phase(system.phases[number], list(_list_rates(coordinates, begin, until))).between(begin, until)
        )
    return system.in_phases(phases)


def _list_rates(coordinates: list[Coordinate], begin: float, until: float) -> Iterator[tuple[Array, Array]]:
    """Yield the rates of the coordinates on an interval of time, which lies inside the window of each or outside of
    it."""
    middle = (begin + until) / 2
    for coordinate in coordinates:
        share = float(coordinate.begin < middle < coordinate.end)
        yield share * coordinate.h, share * coordinate.g


def _extend_phase(phase: Phase, rates: list[tuple[Array, Array]]) -> Phase:
    k, m = len(rates), phase.controls
    below = {
        "A": np.array([[*h, *np.zeros(k)] for h, _ in rates]),
        "B": np.array([g for _, g in rates]).reshape(k, m),
        "E": np.zeros((k, phase.disturbances)),
        "c": np.zeros((k, 1)),
    }
    pairs = {name: (phase.entry(name), rows) for name, rows in below.items() if phase.entry(name) is not None}
    matrices: dict[str, Any] = {name: Above(entry, rows) for name, (entry, rows) in pairs.items()}
    if phase.domain is None:
        matrices = {name: np.asarray(entry(()), dtype=float) for name, entry in matrices.items()}
    return replace(phase, A=matrices["A"], B=matrices["B"], E=matrices["E"], c=matrices.get("c"))


def _extend_constraint(entry: PathConstraint | MixedConstraint, size: int) -> PathConstraint | MixedConstraint:
    if isinstance(entry, MixedConstraint):
        H = np.asarray(entry.H)
        return replace(entry, H=np.pad(H, ((0, 0), (0, size - H.shape[1]))))
    rows = None if entry.relative_to is None else np.asarray(entry.relative_to)
    padded = None if rows is None else np.pad(rows, ((0, 0), (0, size + 1 - rows.shape[1])))
    return replace(entry, set=_extend_set(entry.set, size), relative_to=padded)


def _extend_set(bound: ConvexSet, size: int) -> ConvexSet:
    """Return a set of more coordinates: the first ones are in the given set, the others are free."""
    extra = size - bound.dimension
    if isinstance(bound, Box):
        ends = ((bound.lower, -np.inf), (bound.upper, np.inf))
        return Box(*(np.pad(side, (0, extra), constant_values=infinity) for side, infinity in ends))
    facets = bound.halfspaces()
    if facets is None and isinstance(bound, Cylinder) and bound.slopes is not None:
        return Cylinder(bound.base, size, np.pad(bound.slopes, ((0, 0), (0, extra))))
    return Cylinder(bound, size) if facets is None else Polytope(np.pad(facets[0], ((0, 0), (0, extra))), facets[1])


def with_zeros(problem: OptimalControlProblem, more: int) -> dict[str, Any]:
    """Return the initial states, the cost and the measurements of a problem with ``more`` states, which begin at 0 and
    cost nothing."""
    initial_set, zeros, d = problem.initial_set, np.zeros(more), problem.system.states
    if isinstance(initial_set, Box):
        initial_set = Box(np.append(initial_set.lower, zeros), np.append(initial_set.upper, zeros))
    elif initial_set is not None and more:
        initial_set = Product((initial_set, Box(zeros, zeros)))
    state, _, final = (
        None if term is None else Quadratic(np.pad(term.Q, (0, more)), np.pad(term.reference, (0, more)))
        for term in problem.cost.terms
    )
    measurements = problem.measurements or Measurements(np.eye(d))
    return {
        "initial_state": np.concatenate([np.asarray(problem.initial_state), zeros]),
        "initial_set": initial_set,
        "cost": replace(problem.cost, state=state, final=final),
        "measurements": replace(measurements, C=np.pad(np.asarray(measurements.C), ((0, 0), (0, more)))),
    }


def _make_sum_set(sums: list[tuple[list[int], float, float]], size: int) -> ConvexSet:
    """Return the set in which sums of coordinates are between their bounds."""
    if all(len(indices) == 1 for indices, _, _ in sums):
        lower, upper = np.full(size, -np.inf), np.full(size, np.inf)
        for (index,), low, high in sums:
            lower[index], upper[index] = low, high
        return Box(lower, upper)
    rows = np.array([[float(i in indices) for i in range(size)] for indices, _, _ in sums])
    above, below = ([row[side] for row in sums] for side in (2, 1))
    H, h = np.vstack([rows, -rows]), np.append(above, np.negative(below))
    return Polytope(H[np.isfinite(h)], h[np.isfinite(h)])


def _extend_names(problem: OptimalControlProblem, coordinates: list[Coordinate]) -> Names:
    names, d = problem.names, problem.system.states
    units = [*(names.state_units or ("",) * d), *(coordinate.unit for coordinate in coordinates)]
    labels = [*(names.states or [f"x{i + 1}" for i in range(d)]), *(coordinate.name for coordinate in coordinates)]
    return replace(names, states=labels, state_units=units if any(units) else ())


def _derive_unit(names: Names, h: Array, g: Array) -> str:
    """Return the unit of an integral, that of the integrand times that of time; empty where terms have different
    units."""
    pairs = [(h, names.state_units), (g, names.control_units)]
    distinct_units = {units[i] if units else "" for values, units in pairs for i in np.flatnonzero(values).tolist()}
    (unit,) = distinct_units if len(distinct_units) == 1 else ("",)
    if not (unit and names.time):
        return ""
    head, slash, per = unit.rpartition("/")
    return head if slash and per == names.time else f"{unit} {names.time}"
