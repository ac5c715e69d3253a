"""Systems that take turns, what acts late, and parameters, as one system that changes with time, where errors of
execution or measurable disturbances need that."""

from __future__ import annotations

from dataclasses import replace
from itertools import product as every_choice
from weakref import WeakKeyDictionary

import numpy as np

from sparserob_core.control.enclosures.dependence import Dependence
from sparserob_core.control.problem.problem import OptimalControlProblem
from sparserob_core.control.response.varying.expansion import Expansion
from sparserob_core.control.response.varying.spread import law_of
from sparserob_core.errors import InputError, NotEnclosable
from sparserob_core.sip.convex_set import Array

CORNERS = 64  # of a box of parameters: rows are as many times more, with ten times as many it would take minutes
_KNOWN: WeakKeyDictionary[OptimalControlProblem, OptimalControlProblem] = WeakKeyDictionary()


def in_time(problem: OptimalControlProblem) -> OptimalControlProblem:
    """The same problem with a system that changes with time, where it has errors of execution beside pieces of the
    system, a delay or parameters, or measurable disturbances beside parameters: the integrals over pieces of the
    command, which are not of its age alone, are those of such a system (`VaryingExecution`), and so are those of
    measurable disturbances, over all parameters (`VaryingMeasurable`); those that the state is an affine function of
    become states (`superposed`). Measurable disturbances beside parameters that are not within reach stay as they are:
    of these nothing is proven."""
    system = problem.system
    if system.varies:
        return problem
    plain = not (system.switches or system.delay or system.parameter_count)
    if problem.execution is not None:
        return problem if plain else replace(problem, system=system.in_time(problem.horizon))
    if problem.measurable is None or not system.parameter_count:
        return problem
    if problem not in _KNOWN:
        found = within_reach(problem)
        _KNOWN[problem] = problem if isinstance(found, str) else found
    return _KNOWN[problem]


def within_reach(problem: OptimalControlProblem) -> OptimalControlProblem | str:
    """A problem with parameters with a system that changes with time, whose state can be followed over all of them; or
    why it cannot."""
    try:
        system = problem.system.in_time(problem.horizon)
        found, depends = replace(problem, system=system), system.dependence
        if system.powers is not None:
            for _, law in law_of(system.forced).every:
                Expansion.of(law)
        elif depends is not None:
            corners_of_box(depends)
            system.superposed(depends)
    except (InputError, NotEnclosable) as error:
        return str(error)
    except (TypeError, ValueError):  # of a function that asks how large a parameter is, or multiplies whole matrices
        return "their entries are no arithmetic, entry by entry, in single parameters"
    return found


def corners_of_box(depends: Dependence) -> list[Array]:
    """The corners of the box of parameters as shares of what these may deviate from its middle by, of those that reach
    a state; raises `InputError` where there are too many."""
    moves = depends.reached.any(axis=1) & (depends.units > 0.0)
    count = 2 ** int(moves.sum())
    if count > CORNERS:
        expected = f"a box with at most {CORNERS} corners beside the time t"
        raise InputError(path="system.parameters", expected=expected, got=f"{count}")
    return [np.array(one) for one in every_choice(*((-1.0, 1.0) if one else (0.0,) for one in moves.tolist()))]
