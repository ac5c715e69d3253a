"""Bounds of integrals as bounds of states.

The larger problem has the running integrals of its `IntegralConstraint`s as further states. A row of the state at the
end of a window then replaces each integral.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, final

import numpy as np

from sparserob_core.control.problem.disturbances import legs
from sparserob_core.control.problem.names import Corners, Names, measured_in
from sparserob_core.control.problem.phase import Phase
from sparserob_core.control.problem.problem import OptimalControlProblem
from sparserob_core.control.problem.system import System
from sparserob_core.control.problem.terms.integral import Accumulated, IntegralConstraint
from sparserob_core.control.sets.sets import Polytope, cylinder
from sparserob_core.control.term import SAME_TIME
from sparserob_core.control.transcription.terms.in_time import follow_in_time
from sparserob_core.control.transcription.terms.larger import enlarge_problem
from sparserob_core.control.transcription.terms.superposed import parameters_as_states
from sparserob_core.sip.convex_set import Array, Box, ConvexSet


@final
@dataclass(frozen=True, eq=False)
class Running:
    """Further state ``z' = h'x + g'u``, with the ``u`` that acts, from ``start`` to ``stop``, and ``z' = 0`` elsewhere;
    ``h (d,)``, ``g (m,)``. ``name`` and ``unit`` are for people."""

    h: Array
    g: Array
    start: float
    stop: float
    name: str
    unit: str


def integrals_as_states(problem: OptimalControlProblem) -> OptimalControlProblem:
    """Return the same problem without integrals: each of their rows is a further state, or the sum of two, that is
    bounded at one time. These states are known at the beginning and not measured.

    The system stays a single one where it is one and all windows begin at 0. Integrals then continue to the horizon,
    since nothing depends on them after their window. Parameters of a system that also depends on time became states
    before (`parameters_as_states`), and integrals of these states are possible too. With errors of execution, the
    phases of a system and a delay become one system that changes with time (`follow_in_time`).
    """
    problem = parameters_as_states(combine_states(problem))
    if not problem.integral:
        return follow_in_time(problem)
    running, ends, d = list[Running](), list[Accumulated](), problem.system.states
    for entry, name in zip(problem.integral, problem.called("integral"), strict=True):
        rows, end = _build_running_states(problem, entry, name)
        bound = _build_bounding_set(entry, rows, d + len(running))
        ends.append(Accumulated(bound, end, end, name))
        running += [state for row in rows for state in row]
    if not problem.system.switches and all(state.start == 0.0 for state in running):
        running = [replace(state, stop=problem.horizon) for state in running]
    k = len(running)
    larger_problem = enlarge_problem(
        problem,
        k,
        system=_extend_system(problem.system, running, problem.horizon),
        path=[entry.widened(d + k) for entry in (*problem.windows, *ends)],
        terminal=[cylinder(end, d + k) for end in problem.terminal],
        integral=(),
        names=_extend_names(problem.names, d, running),
        commanded=_find_commanded_states(problem, running),
    )
    return follow_in_time(larger_problem)


def combine_states(problem: OptimalControlProblem) -> OptimalControlProblem:
    """Return the same problem with windows and integrals as its only constraints; every other constraint is expressed
    by these."""
    if all(entry.among for entries in problem.lists.values() for entry in entries):
        return problem
    constraints: dict[str, Any] = {name: [] for name in problem.lists}
    for name, entries in problem.lists.items():
        for entry, called in zip(entries, problem.called(name), strict=True):
            for row in entry.rows(called):
                constraints[row.among].append(row)
    return replace(problem, **constraints)


def _build_running_states(
    problem: OptimalControlProblem, entry: IntegralConstraint, name: str
) -> tuple[list[list[Running]], float]:
    """Return the states whose sums are the rows of an integral, and the time at which all of them are complete.

    Where the control acts later than it is commanded, its part is integrated with the same delay. With errors of
    execution, which are not counted, the part of the control is a state of its own too.
    """
    H, G, start, stop, delay = np.asarray(entry.H), np.asarray(entry.G), entry.start, entry.stop, problem.system.delay
    assert stop is not None
    end = min(stop + delay, problem.horizon) if G.any() else stop
    rows = []
    for row_name, h, g in zip(_name_rows(name, H, G, problem.names.corners), H, G, strict=True):
        unit = _derive_unit(measured_in(np.append(h, g), problem.names, h.size).strip(), problem.names.time)
        if (delay == 0.0 and problem.execution is None) or not g.any():
            rows.append([Running(h, g, start, stop, row_name, unit)])
            continue
        control_part = Running(np.zeros_like(h), g, start + delay, end, row_name, unit)
        state_part = Running(h, np.zeros_like(g), start, stop, f"{row_name} of states", unit)
        rows.append([state_part, replace(control_part, name=f"{row_name} of controls")] if h.any() else [control_part])
    return rows, end


def _find_commanded_states(problem: OptimalControlProblem, running: list[Running]) -> tuple[int, ...]:
    """Return the indices of the states that integrate the command, where the delivered control may differ from it."""
    d = problem.system.states
    return () if problem.execution is None else tuple(d + i for i, state in enumerate(running) if state.g.any())


def _name_rows(name: str, H: Array, G: Array, corners: Corners) -> list[str]:
    """Return the names of the rows of an integral: with numbers where there are several, and with the parameters at the
    corner to which a row belongs, for a system that depends on time and on parameters. Only the numbers are used where
    names with parameters would not be distinct."""
    numbered = [name] if len(H) == 1 else [f"{name} {row + 1}" for row in range(len(H))]
    if not corners:
        return numbered
    rows = np.hstack([np.array([corners.without(h) for h in H]), G])
    _, first, indices = np.unique(rows, axis=0, return_index=True, return_inverse=True)
    order = np.argsort(np.argsort(first))[indices.ravel()].tolist()
    named = [
        (name if first.size == 1 else f"{name} {number + 1}") + (f" at {at}" if (at := corners.at(h)) else "")
        for number, h in zip(order, H, strict=True)
    ]
    return named if len(set(named)) == len(named) else numbered


def _build_bounding_set(entry: IntegralConstraint, rows: list[list[Running]], first: int) -> ConvexSet:
    """Return the set that bounds the sums of states; the first of these states has the index ``first``."""
    lower, upper = np.asarray(entry.lower), np.asarray(entry.upper)
    if all(len(row) == 1 for row in rows):
        free = np.full(first, np.inf)
        return Box(np.append(-free, lower), np.append(free, upper))
    row_of_state = np.repeat(np.arange(len(rows)), [len(row) for row in rows])
    sums = np.hstack([np.zeros((len(rows), first)), (row_of_state == np.arange(len(rows))[:, None]).astype(float)])
    H, h = np.vstack([sums, -sums]), np.append(upper, -lower)
    return Polytope(H[np.isfinite(h)], h[np.isfinite(h)])


def _extend_system(system: System, running: list[Running], horizon: float) -> System:
    """Return the system with its running integrals as further states. A new phase begins at each time within the
    horizon at which an integral begins or ends."""
    slack, phases = SAME_TIME * horizon, list[Phase]()
    for phase in legs(system, {time for state in running for time in (state.start, state.stop)}, horizon):
        acts = np.array(
            [[state.start <= phase.begin + slack and phase.until <= state.stop + slack] for state in running]
        )
        h, g = np.stack([state.h for state in running]), np.stack([state.g for state in running])
        phases.append(phase.accumulating(acts * h, acts * g))
    return system.in_phases(phases)


def _extend_names(names: Names, states: int, running: list[Running]) -> Names:
    units = [*(names.state_units or [""] * states), *(state.unit for state in running)]
    return replace(
        names,
        states=[*(names.state(i) for i in range(states)), *(state.name for state in running)],
        state_units=units if any(units) else (),
    )


def _derive_unit(unit: str, time: str) -> str:
    """Return the unit of an integral over time of a quantity with a ``unit``; empty where one of the two units is not
    known."""
    if not unit or not time:
        return ""
    return unit.removesuffix(f"/{time}") if unit.endswith(f"/{time}") else f"{unit} {time}"
