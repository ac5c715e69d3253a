"""Systems that take turns, and what acts late, as one system that changes with time, where errors of execution need
that."""

from __future__ import annotations

from dataclasses import replace

from sparserob_core.control.problem.problem import OptimalControlProblem
from sparserob_core.control.problem.system import TIME, LinearSystem, VaryingSystem
from sparserob_core.sip.convex_set import Box


def in_time(problem: OptimalControlProblem) -> OptimalControlProblem:
    """The same problem with a system that changes with time, where it has errors of execution beside pieces of the
    system or a delay: the integrals over pieces of the command, which are not of its age alone, are those of such a
    system (`VaryingExecution`)."""
    system = problem.system
    if problem.execution is None or isinstance(system, VaryingSystem):
        return problem
    if isinstance(system, LinearSystem) and not system.delay:
        return problem
    begins = [0.0, *system.switches]
    ends = [*system.switches, problem.horizon]
    laws = [_law(mode, begin, end) for mode, begin, end in zip(system.modes, begins, ends, strict=True)]
    later = tuple(zip(begins[1:], laws[1:], strict=True))
    return replace(problem, system=VaryingSystem(laws[0], problem.horizon, system.delay, later))


def _law(mode: LinearSystem, begin: float, end: float) -> LinearSystem:
    """The matrices of a known system as those at every time from ``begin`` to ``end``."""
    return LinearSystem(mode.A, mode.B, mode.E, Box([begin], [end]), (TIME,), mode.c)
