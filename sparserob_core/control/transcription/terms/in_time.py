"""Systems that take turns, what acts late, and parameters, as one system that changes with time, where errors of
execution need that."""

from __future__ import annotations

from dataclasses import replace

from sparserob_core.control.problem.problem import OptimalControlProblem
from sparserob_core.control.problem.system import LinearSystem, VaryingSystem


def in_time(problem: OptimalControlProblem) -> OptimalControlProblem:
    """The same problem with a system that changes with time, where it has errors of execution beside pieces of the
    system, a delay or parameters: the integrals over pieces of the command, which are not of its age alone, are those
    of such a system (`VaryingExecution`), and its parameters become states (`superposed`)."""
    system = problem.system
    if problem.execution is None or isinstance(system, VaryingSystem):
        return problem
    if isinstance(system, LinearSystem) and not system.delay and not system.parameter_count:
        return problem
    return replace(problem, system=VaryingSystem.made_of(system, problem.horizon))
