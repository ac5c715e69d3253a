"""Parameters beside the time as states: a problem whose state is an affine function of them, as one of a known system,
of which every bound of the state is one for each corner of their box."""

from __future__ import annotations

from dataclasses import replace
from fractions import Fraction
from itertools import product as every_choice

import numpy as np

from sparserob_core.control.enclosures.dependence import PARTS, Dependence, Superposed
from sparserob_core.control.problem.names import Names
from sparserob_core.control.problem.problem import OptimalControlProblem
from sparserob_core.control.problem.system import TIME, LinearSystem, VaryingSystem
from sparserob_core.control.problem.terms.windows import everywhere
from sparserob_core.control.sets.sets import Box
from sparserob_core.control.transcription.terms.larger import larger
from sparserob_core.errors import InputError
from sparserob_core.sip.convex_set import Array

CORNERS = 64  # of a box of parameters: rows are as many times more, with ten times as many it would take minutes


def superposed(problem: OptimalControlProblem) -> OptimalControlProblem:
    """The same problem without parameters beside the time. The states of one in the middle of their box stay the first
    ones, after which comes what each parameter adds, per about half of its interval; both obey known equations. A bound
    of the state holds for all parameters where it holds at the corners. Differences to the middle are rounded
    outwards."""
    system = problem.system
    if not isinstance(system, VaryingSystem) or system.parameters is None:
        return problem
    depends, rows = system.dependence, at_corners(problem)
    assert rows is not None
    return larger(
        problem,
        depends.states - system.states,
        system=_known(system, depends),
        path=[entry.everywhere(rows) for entry in problem.windows],
        terminal=[everywhere(end, rows) for end in problem.terminal_sets],
        integral=[entry.everywhere(rows) for entry in problem.integral],
        names=_names(problem.names, system, depends),
    )


def at_corners(problem: OptimalControlProblem) -> list[Array] | None:
    """The stated states at every corner of the box of parameters beside the time, as rows ``(d, size)`` on those of one
    in the middle and on what the parameters add; ``None`` where there are no such parameters."""
    system = problem.system
    if not isinstance(system, VaryingSystem) or system.parameters is None:
        return None
    return [system.dependence.rows(corner) for corner in _corners(system.parameters, system.dependence)]


def _corners(box: Box, depends: Dependence) -> list[Array]:
    """The corners of the box as deviations from its middle, of parameters that reach a state; rounded outwards."""
    ends = [
        sorted({_outwards(low, middle, up=False), _outwards(high, middle, up=True)}) if any(reached) else [0.0]
        for low, high, middle, reached in zip(
            box.lower.tolist(), box.upper.tolist(), depends.centre.tolist(), depends.reached.tolist(), strict=True
        )
    ]
    count = int(np.prod([len(one) for one in ends]))
    if count > CORNERS:
        expected = f"a box with at most {CORNERS} corners beside the time t"
        raise InputError(path="system.parameters", expected=expected, got=f"{count}")
    return [np.array(one) for one in every_choice(*ends)]


def _outwards(end: float, middle: float, up: bool) -> float:
    """The difference of two numbers, or the next double beyond it."""
    exact, found = Fraction(end) - Fraction(middle), end - middle
    short = Fraction(found) < exact if up else Fraction(found) > exact
    return float(np.nextafter(found, np.inf if up else -np.inf)) if short else found


def _known(system: VaryingSystem, depends: Dependence) -> VaryingSystem:
    """The system of all states."""
    laws = []
    for begin, until, law in system.laws:
        parts = {name: law.entry(name) for name in PARTS}
        made = {name: Superposed(name, part, depends) for name, part in parts.items() if part is not None}
        times = Box([begin], [until])
        laws.append((begin, LinearSystem(made["A"], made["B"], made["E"], times, (TIME,), made.get("c"))))
    return VaryingSystem(laws[0][1], system.horizon, system.delay, tuple(laws[1:]))


def _names(names: Names, system: VaryingSystem, depends: Dependence) -> Names:
    """Those of the states, and of what a parameter adds to one per unit of it."""
    added = [
        (i, name)
        for name, reached in zip(system.names, depends.reached, strict=True)
        for i in np.flatnonzero(reached).tolist()
    ]
    units = [names.state_units[i] for i, _ in added] if names.state_units else []
    return replace(
        names,
        states=[
            *(names.state(i) for i in range(system.states)),
            *(f"{names.state(i)} per {name}" for i, name in added),
        ],
        state_units=[*names.state_units, *units],
    )
