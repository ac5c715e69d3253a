"""Parameters beside the time as states: a problem whose state is an affine function of them, as one of a known system,
of which every bound of the state is one for each corner of their box."""

from __future__ import annotations

from dataclasses import replace
from itertools import product as every_choice

import numpy as np

from sparserob_core.control.enclosures.dependence import Dependence
from sparserob_core.control.problem.names import Corners, Names
from sparserob_core.control.problem.problem import OptimalControlProblem
from sparserob_core.control.problem.system import System
from sparserob_core.control.problem.terms.windows import everywhere
from sparserob_core.control.sets.sets import Equality, cylinder
from sparserob_core.control.transcription.terms.in_time import corners_of_box, in_time
from sparserob_core.control.transcription.terms.larger import larger
from sparserob_core.sip.convex_set import Array


def superposed(problem: OptimalControlProblem) -> OptimalControlProblem:
    """The same problem without parameters beside the time. The states of one in the middle of their box stay the first
    ones, after which comes what each parameter adds, per half of its interval; both obey known equations. A bound of
    the state holds for all parameters where it holds at the corners; a curved one is one constraint for each of them.
    Halves of intervals are rounded outwards. Beside errors of execution, or measurable disturbances, parameters of any
    system are such (`in_time`).
    """
    problem = in_time(problem)
    system = problem.system
    depends, rows = system.dependence, at_corners(problem)
    if depends is None or rows is None:  # there are none, or they stay in the index
        return problem
    return larger(
        problem,
        depends.states - system.states,
        system=system.superposed(depends),
        path=[
            one
            for entry, name in zip(problem.windows, problem.called("path"), strict=True)
            for one in entry.everywhere(rows, name)
        ],
        terminal=[
            one
            for end in problem.terminal
            for one in ([cylinder(end, depends.states)] if isinstance(end, Equality) else everywhere(end, rows))
        ],
        integral=[entry.everywhere(rows) for entry in problem.integral],
        names=replace(_names(problem.names, system, depends), corners=corners_of(problem)),
    )


def at_corners(problem: OptimalControlProblem) -> list[Array] | None:
    """The stated states at every corner of the box of parameters beside the time, as rows ``(d, size)`` on those of one
    in the middle and on what the parameters add; ``None`` where there are none that the state is an affine function
    of."""
    depends = in_time(problem).system.dependence
    return None if depends is None else [depends.rows(corner) for corner in corners_of_box(depends)]


def corners_of(problem: OptimalControlProblem) -> Corners:
    """The corners of a problem as it is stated; none where it has no parameters beside the time."""
    system, rows = in_time(problem).system, at_corners(problem)
    if rows is None or system.dependence is None:
        return Corners()
    box, reached = system.box, system.dependence.reached
    ends = [
        sorted({low, high}) if any(one) else [low]
        for low, high, one in zip(box.lower.tolist(), box.upper.tolist(), reached, strict=True)
    ]
    return Corners(rows, np.array(list(every_choice(*ends))), system.names)


def _names(names: Names, system: System, depends: Dependence) -> Names:
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
