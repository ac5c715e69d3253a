"""Bounds of integrals as bounds of states: a problem with the running integrals of its `IntegralConstraint`s beside its
states, so that a row of the state at the end of a window is all that is left of them."""

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
from sparserob_core.control.transcription.terms.in_time import in_time
from sparserob_core.control.transcription.terms.larger import larger
from sparserob_core.control.transcription.terms.superposed import superposed
from sparserob_core.sip.convex_set import Array, Box, ConvexSet


@final
@dataclass(frozen=True, eq=False)
class Running:
    """A state more: ``z' = h'x + g'u`` with the ``u`` that acts, from ``start`` to ``stop``, and 0 elsewhere;
    ``h (d,)``, ``g (m,)``. ``name`` and ``unit`` are for people."""

    h: Array
    g: Array
    start: float
    stop: float
    name: str
    unit: str


def accumulated(problem: OptimalControlProblem) -> OptimalControlProblem:
    """The same problem without integrals: each row of them is a state more, or the sum of two, known at the beginning
    and not measured, that is bounded at one time. The system stays a single one where it is one and all windows begin
    at 0: integrals then go on to the horizon, since nothing looks at them again. Parameters beside the time became
    states before (`superposed`), of which there are integrals too; beside errors of execution pieces of the system, and
    a delay, become one that changes with time (`in_time`)."""
    problem = superposed(in_rows(problem))
    if not problem.integral:
        return in_time(problem)
    running, ends, d = list[Running](), list[Accumulated](), problem.system.states
    for entry, name in zip(problem.integral, problem.called("integral"), strict=True):
        rows, end = _running(problem, entry, name)
        bound = _bounded(entry, rows, d + len(running))
        ends.append(Accumulated(bound, end, end, name))
        running += [one for row in rows for one in row]
    if not problem.system.switches and all(one.start == 0.0 for one in running):
        running = [replace(one, stop=problem.horizon) for one in running]
    k = len(running)
    found = larger(
        problem,
        k,
        system=_system(problem.system, running, problem.horizon),
        path=[entry.widened(d + k) for entry in (*problem.windows, *ends)],
        terminal=[cylinder(end, d + k) for end in problem.terminal],
        integral=(),
        names=_names(problem.names, d, running),
        commanded=_commanded(problem, running),
    )
    return in_time(found)


def in_rows(problem: OptimalControlProblem) -> OptimalControlProblem:
    """The same problem with no other constraints than windows and integrals, which others say that they are."""
    if all(entry.among for entries in problem.lists.values() for entry in entries):
        return problem
    told: dict[str, Any] = {name: [] for name in problem.lists}
    for name, entries in problem.lists.items():
        for entry, called in zip(entries, problem.called(name), strict=True):
            for row in entry.rows(called):
                told[row.among].append(row)
    return replace(problem, **told)


def _running(problem: OptimalControlProblem, entry: IntegralConstraint, name: str) -> tuple[list[list[Running]], float]:
    """The states that the rows of an integral are sums of, and the time at which all of these are complete. Where the
    control acts later than it is commanded, its part is integrated as much later; where it is missed by errors of
    execution, which are not counted, it is a state of its own too."""
    H, G, start, stop, delay = np.asarray(entry.H), np.asarray(entry.G), entry.start, entry.stop, problem.system.delay
    assert stop is not None
    end = min(stop + delay, problem.horizon) if G.any() else stop
    found = []
    for called, h, g in zip(_called(name, H, G, problem.names.corners), H, G, strict=True):
        unit = _unit(measured_in(np.append(h, g), problem.names, h.size).strip(), problem.names.time)
        if (delay == 0.0 and problem.execution is None) or not g.any():
            found.append([Running(h, g, start, stop, called, unit)])
            continue
        late = Running(np.zeros_like(h), g, start + delay, end, called, unit)
        early = Running(h, np.zeros_like(g), start, stop, f"{called} of states", unit)
        found.append([early, replace(late, name=f"{called} of controls")] if h.any() else [late])
    return found, end


def _commanded(problem: OptimalControlProblem, running: list[Running]) -> tuple[int, ...]:
    """The numbers of the states that add up what is commanded, where something else may be delivered."""
    d = problem.system.states
    return () if problem.execution is None else tuple(d + i for i, one in enumerate(running) if one.g.any())


def _called(name: str, H: Array, G: Array, corners: Corners) -> list[str]:
    """What the rows of an integral are called: by their numbers where there are several, and by the parameters beside
    the time at whose corner they are; by their numbers alone where that does not tell them apart."""
    numbered = [name] if len(H) == 1 else [f"{name} {row + 1}" for row in range(len(H))]
    if not corners:
        return numbered
    rows = np.hstack([np.array([corners.without(h) for h in H]), G])
    _, first, which = np.unique(rows, axis=0, return_index=True, return_inverse=True)
    order = np.argsort(np.argsort(first))[which.ravel()].tolist()
    told = [
        (name if first.size == 1 else f"{name} {number + 1}") + (f" at {at}" if (at := corners.at(h)) else "")
        for number, h in zip(order, H, strict=True)
    ]
    return told if len(set(told)) == len(told) else numbered


def _bounded(entry: IntegralConstraint, rows: list[list[Running]], first: int) -> ConvexSet:
    """The bounds of the sums of states, of which the first has the number ``first``."""
    lower, upper = np.asarray(entry.lower), np.asarray(entry.upper)
    if all(len(row) == 1 for row in rows):
        free = np.full(first, np.inf)
        return Box(np.append(-free, lower), np.append(free, upper))
    which = np.repeat(np.arange(len(rows)), [len(row) for row in rows])
    sums = np.hstack([np.zeros((len(rows), first)), (which == np.arange(len(rows))[:, None]).astype(float)])
    H, h = np.vstack([sums, -sums]), np.append(upper, -lower)
    return Polytope(H[np.isfinite(h)], h[np.isfinite(h)])


def _system(system: System, running: list[Running], horizon: float) -> System:
    """The system beside what is integrated of it; of pieces where one of the integrals begins later than at 0, or ends
    before it is looked at."""
    slack, phases = SAME_TIME * horizon, list[Phase]()
    for phase in legs(system, {time for one in running for time in (one.start, one.stop)}, horizon):
        acts = np.array([[one.start <= phase.begin + slack and phase.until <= one.stop + slack] for one in running])
        h, g = np.stack([one.h for one in running]), np.stack([one.g for one in running])
        phases.append(phase.accumulating(acts * h, acts * g))
    return system.in_phases(phases)


def _names(names: Names, states: int, running: list[Running]) -> Names:
    units = [*(names.state_units or [""] * states), *(one.unit for one in running)]
    return replace(
        names,
        states=[*(names.state(i) for i in range(states)), *(one.name for one in running)],
        state_units=units if any(units) else (),
    )


def _unit(unit: str, time: str) -> str:
    """The unit of an integral over time of what has a ``unit``; empty where one of them is not known."""
    if not unit or not time:
        return ""
    return unit.removesuffix(f"/{time}") if unit.endswith(f"/{time}") else f"{unit} {time}"
