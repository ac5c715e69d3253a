"""Plans that repeat: every final state must be one of the initial states."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from sparserob_core.checker.outcome import Unchecked
from sparserob_core.checker.sets.known import known
from sparserob_core.checker.sets.shape import width
from sparserob_core.control.problem.problem import OptimalControlProblem
from sparserob_core.control.problem.terms.repeat import Return
from sparserob_core.control.sets.sets import Box

RETURN = "return"
# The relative margin of final states in the set of initial states. It is ten times the violation that counts as none,
# so that no violation is passed on from period to period.
INSIDE = 1e-8


def returning(problem: OptimalControlProblem) -> OptimalControlProblem:
    """Return the problem with one more constraint for a plan that repeats: every final state is one of the initial
    states, inside by the share `INSIDE` of the size of the set. It is derived from the initial states alone;
    coordinates with one initial value are left free."""
    bound, end, fixed = problem.initial_set, problem.horizon, single(problem)
    path = [entry for entry in problem.windows if not isinstance(entry, Return)]
    if not problem.repeat or bound is None or len(fixed) == problem.system.states:
        return replace(problem, path=path) if len(path) < len(problem.path) else problem
    free = np.isin(np.arange(bound.dimension), fixed)
    if free.any():
        if not isinstance(bound, Box):
            raise Unchecked("of a flat set of initial states, the checker knows boxes only")
        bound = Box(np.where(free, -np.inf, bound.lower), np.where(free, np.inf, bound.upper))
    centre = np.asarray(problem.initial_state, dtype=float)
    reference = np.column_stack([[0.0, end], np.vstack([centre, centre])]) if centre.any() else None
    return_constraint = Return(bound.scaled(1.0 - INSIDE), end, end, RETURN, reference)
    return replace(problem, path=[*path, return_constraint])


def single(problem: OptimalControlProblem) -> list[int]:
    """Return the coordinates of the state in which all initial states are equal."""
    bound, d = problem.initial_set, problem.system.states
    if bound is None:
        return list(range(d))
    return [i for i in range(d) if width(known(bound), i).is_zero()]
