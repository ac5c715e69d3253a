"""Systems that take turns, what acts late, and parameters, as one system whose law is another in every turn: errors of
execution are followed in the time, not in the age of a command; so are measurable disturbances beside parameters."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Any, final

from sparserob_core.checker.outcome import Unchecked
from sparserob_core.control.problem.problem import OptimalControlProblem
from sparserob_core.control.problem.system import TIME, LinearSystem, SwitchedSystem, VaryingSystem
from sparserob_core.control.sets.sets import Box


@final
@dataclass(frozen=True, eq=False)
class Anytime:
    """A function of the parameters as one of the time and of them."""

    function: Callable[[Any], object]

    def __call__(self, p: Any) -> object:
        return self.function(p[1:])


def in_turns(problem: OptimalControlProblem) -> OptimalControlProblem:
    """The problem with such a system where it has errors of execution beside turns, a delay or parameters, or
    measurable disturbances beside a box of parameters; it itself elsewhere."""
    system = problem.system
    late = isinstance(system, SwitchedSystem) or (isinstance(system, LinearSystem) and system.delay > 0.0)
    missed = problem.execution is not None and (late or system.parameter_count > 0)
    pushed = problem.measurable is not None and isinstance(system.parameters, Box)
    if isinstance(system, VaryingSystem) or not (missed or pushed):
        return problem
    bound, names = system.parameters, tuple(system.names)
    if not (bound is None or isinstance(bound, Box)):
        raise Unchecked("beside errors of execution the checker knows boxes of parameters")
    ends, laws = [0.0, *system.switches, problem.horizon], list[tuple[float, LinearSystem]]()
    for (start, stop), one in zip(pairwise(ends), system.modes, strict=True):
        box = Box([start], [stop]) if bound is None else Box([start, *bound.lower], [stop, *bound.upper])
        parts = {name: one.entry(name) for name in ("A", "B", "E", "c")}
        made: dict[str, Any] = {name: Anytime(part) if callable(part) else part for name, part in parts.items()}
        laws.append((start, LinearSystem(made["A"], made["B"], made["E"], box, (TIME, *names), made["c"])))
    later = tuple(laws[1:])
    return replace(problem, system=VaryingSystem(laws[0][1], problem.horizon, system.delay, later, bound))
