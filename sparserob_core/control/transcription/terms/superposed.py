"""Parameters of a system that also depends on time, as states. The state is an affine function of such parameters. The
larger system is known, and every bound of the state becomes one bound for each corner of the parameters' box."""

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
from sparserob_core.control.transcription.terms.in_time import corners_of_box, follow_in_time
from sparserob_core.control.transcription.terms.larger import enlarge_problem
from sparserob_core.sip.convex_set import Array


def parameters_as_states(problem: OptimalControlProblem) -> OptimalControlProblem:
    """Return the same problem without parameters of a system that also depends on time.

    The states at the middle of the box of parameters stay the first ones. The contribution of each parameter follows,
    per half of its interval; both obey known equations. A bound of the state holds for all parameters where it holds at
    the corners. A curved bound becomes one constraint for each corner. Halves of intervals are rounded outwards. With
    errors of execution, or measurable disturbances, parameters of any system are treated so (`follow_in_time`).
    """
    problem = follow_in_time(problem)
    system = problem.system
    depends, rows = system.dependence, at_corners(problem)
    if depends is None or rows is None:  # there are none, or they stay in the index
        return problem
    return enlarge_problem(
        problem,
        depends.states - system.states,
        system=system.superposed(depends),
        path=[
            constraint
            for entry, name in zip(problem.windows, problem.called("path"), strict=True)
            for constraint in entry.everywhere(rows, name)
        ],
        terminal=[
            terminal
            for end in problem.terminal
            for terminal in ([cylinder(end, depends.states)] if isinstance(end, Equality) else everywhere(end, rows))
        ],
        integral=[entry.everywhere(rows) for entry in problem.integral],
        names=replace(_extend_names(problem.names, system, depends), corners=corners_of(problem)),
    )


def at_corners(problem: OptimalControlProblem) -> list[Array] | None:
    """Return one matrix ``(d, size)`` for each corner of the box of parameters. It gives the states of the user from
    the states at the middle and the contributions of the parameters. ``None`` where the state is not an affine function
    of parameters."""
    depends = follow_in_time(problem).system.dependence
    return None if depends is None else [depends.rows(corner) for corner in corners_of_box(depends)]


def corners_of(problem: OptimalControlProblem) -> Corners:
    """Return the corners of a problem as the user stated it; without entries where the state is not an affine function
    of parameters."""
    system, rows = follow_in_time(problem).system, at_corners(problem)
    if rows is None or system.dependence is None:
        return Corners()
    box, is_affected = system.box, system.dependence.affected
    ends = [
        sorted({low, high}) if any(row) else [low]
        for low, high, row in zip(box.lower.tolist(), box.upper.tolist(), is_affected, strict=True)
    ]
    return Corners(rows, np.array(list(every_choice(*ends))), system.names)


def _extend_names(names: Names, system: System, depends: Dependence) -> Names:
    """Return the names and units of the states, and those of the contribution of each parameter to a state, per unit of
    the parameter."""
    contributions = [
        (i, name)
        for name, is_affected in zip(system.names, depends.affected, strict=True)
        for i in np.flatnonzero(is_affected).tolist()
    ]
    units = [names.state_units[i] for i, _ in contributions] if names.state_units else []
    return replace(
        names,
        states=[
            *(names.state(i) for i in range(system.states)),
            *(f"{names.state(i)} per {name}" for i, name in contributions),
        ],
        state_units=[*names.state_units, *units],
    )
