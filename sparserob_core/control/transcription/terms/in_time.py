"""Switched systems and systems with parameters as one system that changes with time, where errors of execution or
measurable disturbances need it."""

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

# Of a box of parameters: rows are as many times more, with ten times as many it would take minutes
MAX_BOX_CORNERS = 64
_CACHE: WeakKeyDictionary[OptimalControlProblem, OptimalControlProblem] = WeakKeyDictionary()


def follow_in_time(problem: OptimalControlProblem) -> OptimalControlProblem:
    """Return the same problem with a system that changes with time, where the method needs one.

    This is the case for errors of execution with phases of the system or parameters, and for measurable disturbances
    with parameters. The integrals over pieces of the command do not depend on its age alone. They are integrals of such
    a system (`VaryingExecution`), and so are those of measurable disturbances, over all parameters
    (`VaryingMeasurable`). Parameters of which the state is an affine function become states (`superposed`). Measurable
    disturbances with parameters that are not within reach stay as they are: nothing is proven for them.
    """
    system = problem.system
    if system.varies:
        return problem
    plain = not (system.switches or system.parameter_count)
    if problem.delivery is not None:
        return problem if plain else replace(problem, system=system.in_time(problem.horizon))
    if problem.measurable is None or not system.parameter_count:
        return problem
    if problem not in _CACHE:
        converted = within_reach(problem)
        _CACHE[problem] = problem if isinstance(converted, str) else converted
    return _CACHE[problem]


def within_reach(problem: OptimalControlProblem) -> OptimalControlProblem | str:
    """Return the problem with a system that changes with time, whose state can be followed over all parameters; or, as
    a string, the reason why it cannot."""
    try:
        system = problem.system.in_time(problem.horizon)
        converted, depends = replace(problem, system=system), system.dependence
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
    return converted


def corners_of_box(depends: Dependence) -> list[Array]:
    """Return the corners of the box of parameters as shares of their deviation from its middle; only parameters that
    reach a state vary. Raise `InputError` where there are more than `MAX_BOX_CORNERS`."""
    moves = depends.affected.any(axis=1) & (depends.units > 0.0)
    count = 2 ** int(moves.sum())
    if count > MAX_BOX_CORNERS:
        expected = f"a box with at most {MAX_BOX_CORNERS} corners beside the time t"
        raise InputError(path="system.parameters", expected=expected, got=f"{count}")
    return [
        np.array(corner) for corner in every_choice(*((-1.0, 1.0) if varies else (0.0,) for varies in moves.tolist()))
    ]
