"""Systems that take turns, what acts late, and parameters, as one system whose entries depend on the time: errors of
execution are followed in the time, not in the age of a command; so are measurable disturbances beside parameters."""

from __future__ import annotations

from dataclasses import replace

from sparserob_core.checker.outcome import Unchecked
from sparserob_core.control.problem.problem import OptimalControlProblem
from sparserob_core.control.sets.sets import Box


def in_turns(problem: OptimalControlProblem) -> OptimalControlProblem:
    """The problem with such a system where it has errors of execution beside turns, a delay or parameters, or
    measurable disturbances beside a box of parameters; it itself elsewhere."""
    system = problem.system
    missed = problem.execution is not None and bool(system.switches or system.delay or system.parameter_count)
    pushed = problem.measurable is not None and isinstance(system.parameters, Box)
    if system.varies or not (missed or pushed):
        return problem
    if not isinstance(system.parameters, Box | None):
        raise Unchecked("beside errors of execution the checker knows boxes of parameters")
    return replace(problem, system=system.in_time(problem.horizon))
