"""The constraint of a plan that repeats: every final state is one of the initial states."""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum
from typing import final

import numpy as np

from sparserob_core.control.problem.terms.windows import PathConstraint
from sparserob_core.control.sets.sets import Equality
from sparserob_core.errors import InputError
from sparserob_core.sip.convex_set import Array, Box, ConvexSet

SET_ROUNDING = 1e-12  # relative to the size of a set, the rounding error of its numbers
RETURN = "return"  # the name of the constraint `Return` in messages, tables and figures
# The share of the set of initial states by which final states stay inside of it. It is ten times the tolerance of a
# proof, so that no period hands a violation on to the next: a tenth of it would, and ten times as much shows in the
# cost.
WITHIN = 1e-8


@final
@dataclass(frozen=True, eq=False)
class Return(PathConstraint):
    """A constraint that brings the state of a repeating plan back into the set of initial states at the horizon.

    It is a path constraint with a window of one time. `OptimalControlProblem` makes it.
    """

    stated = False


class Repeating(Enum):
    """The value of ``repeat`` of a problem whose constraints contain the `Return`."""

    IMPOSED = "imposed"


def require_return(bound: ConvexSet | None, centre: Array, horizon: float) -> tuple[list[Return], list[Equality]]:
    """Return the constraints by which a repeating plan ends where it can begin again.

    Parameters
    ----------
    bound : ConvexSet or None
        The set of deviations of the initial state, or ``None`` where the initial state is known.
    centre : array (d,)
        The centre of the initial states.
    horizon : float
        The time at which the plan begins again.

    Returns
    -------
    returns : list of Return
        The constraint that final states are in the set of initial states, which is reduced by the share `WITHIN`. The
        list is empty without a set.
    equalities : list of Equality
        The final values of the coordinates that have a single initial value. The list is empty where there are none.

    Raises
    ------
    InputError
        If the set has no interior and is no box.
    """
    fixed = np.where(widths(bound, centre.size) > 0.0, np.nan, centre)
    ends = [] if np.isnan(fixed).all() else [Equality(fixed)]
    if bound is None:
        return [], ends
    reference = np.column_stack([[0.0, horizon], np.vstack([centre, centre])]) if centre.any() else None
    return [Return(_free_flat_coordinates(bound).scaled(1.0 - WITHIN), horizon, horizon, RETURN, reference)], ends


def widths(bound: ConvexSet | None, states: int) -> Array:
    """Return the width of a set of deviations along every axis.

    Parameters
    ----------
    bound : ConvexSet or None
        The set; ``None`` stands for 0 alone.
    states : int
        The number ``d`` of axes.

    Returns
    -------
    array (d,)
        The widths, 0 without a set.
    """
    if bound is None:
        return np.zeros(states)
    axes = np.eye(states)
    return np.asarray(bound.support(axes) + bound.support(-axes))


def _free_flat_coordinates(bound: ConvexSet) -> ConvexSet:
    """Return a set of initial deviations with the coordinates free in which it has no width.

    Raises `InputError` for a set that has no interior and is no box.
    """
    axes = np.eye(bound.dimension)
    free = widths(bound, bound.dimension) == 0.0
    if bound.is_box and free.any():
        box = bound.bounding_box()
        return Box(np.where(free, -np.inf, box.lower), np.where(free, np.inf, box.upper))
    flat = bound.halfspaces()
    if flat is not None:
        room = flat[1] - flat[0] @ bound.interior_point()
        if (room <= SET_ROUNDING * np.abs(flat[0]).max(axis=1) * float(bound.reach(axes).max())).any():
            raise InputError(
                path="repeat",
                expected="a set of initial states with an interior, or a box",
                got=f"a {bound.kind} without one",
            )
    return bound
