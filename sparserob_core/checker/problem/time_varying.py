"""Switched systems and systems with parameters as one system whose entries depend on the time.

Errors of execution are then propagated in the time, not in the age of a command; so are measurable disturbances of a
system with parameters.
"""

from __future__ import annotations

from dataclasses import replace

from sparserob_core.checker.outcome import Unchecked
from sparserob_core.control.problem.problem import OptimalControlProblem
from sparserob_core.control.sets.sets import Box


def make_time_varying(problem: OptimalControlProblem) -> OptimalControlProblem:
    """Return the problem with one system that depends on the time, where that is needed, else the problem itself.

    It is needed for errors of execution with phases or parameters, and for measurable disturbances over a box of
    parameters.
    """
    system = problem.system
    is_execution_case = problem.delivery is not None and bool(system.switches or system.parameter_count)
    is_measurable_case = problem.measurable is not None and isinstance(system.parameters, Box)
    if system.varies or not (is_execution_case or is_measurable_case):
        return problem
    if not isinstance(system.parameters, Box | None):
        raise Unchecked("beside errors of execution the checker knows boxes of parameters")
    return replace(problem, system=system.in_time(problem.horizon))
