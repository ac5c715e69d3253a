"""Systems that take turns, and what acts late, as one known system whose law is another in every turn: errors of
execution are followed in the time, not in the age of a command."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise

from sparserob_core.control.problem.problem import OptimalControlProblem
from sparserob_core.control.problem.system import TIME, LinearSystem, SwitchedSystem, VaryingSystem
from sparserob_core.control.sets.sets import Box


def in_turns(problem: OptimalControlProblem) -> OptimalControlProblem:
    """The problem with such a system where it has errors of execution beside turns or a delay; it itself elsewhere."""
    system = problem.system
    late = isinstance(system, SwitchedSystem) or (isinstance(system, LinearSystem) and system.delay > 0.0)
    if problem.execution is None or not late or system.parameter_count:
        return problem
    ends = [0.0, *system.switches, problem.horizon]
    laws = [
        (start, LinearSystem(one.A, one.B, one.E, Box([start], [stop]), (TIME,), one.c))
        for (start, stop), one in zip(pairwise(ends), system.modes, strict=True)
    ]
    return replace(problem, system=VaryingSystem(laws[0][1], problem.horizon, system.delay, tuple(laws[1:])))
