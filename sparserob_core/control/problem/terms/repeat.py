"""The return of a plan that repeats: every final state is one of the initial ones."""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum
from typing import final

import numpy as np

from sparserob_core.control.problem.terms.windows import PathConstraint
from sparserob_core.control.sets.sets import Equality
from sparserob_core.errors import InputError
from sparserob_core.sip.convex_set import Array, Box, ConvexSet

SAME = 1e-12  # of the size of a set, what is rounding
RETURN = "return"  # what the constraint that a plan which repeats ends where it may begin is called
# The share of the set of initial states by which final ones stay inside it, ten times the tolerance of a proof, so that
# no violation is handed on: a tenth of it would let one, ten times as much is seen in the cost.
WITHIN = 1e-8


@final
@dataclass(frozen=True, eq=False)
class Return(PathConstraint):
    """The state comes back to where a period may begin, of a plan that repeats: a window of one time, the horizon, and
    the set of initial deviations about their centre. Made by `OptimalControlProblem`."""

    stated = False


class Repeating(Enum):
    """What `repeat` of a problem is whose constraints have the return among them."""

    IMPOSED = "imposed"


def ending(bound: ConvexSet | None, centre: Array, horizon: float) -> tuple[list[Return], list[Equality]]:
    """What a plan whose initial states are a ``centre (d,)`` and the deviations of ``bound`` ends in, so that it can
    begin again: within their set by `WITHIN`, and where there is one value of a coordinate, in that. Raises
    `InputError` for a set that is flat and no box."""
    fixed = np.where(widths(bound, centre.size) > 0.0, np.nan, centre)
    ends = [] if np.isnan(fixed).all() else [Equality(fixed)]
    if bound is None:
        return [], ends
    moved = np.column_stack([[0.0, horizon], np.vstack([centre, centre])]) if centre.any() else None
    return [Return(_free_where_flat(bound).scaled(1.0 - WITHIN), horizon, horizon, RETURN, moved)], ends


def widths(bound: ConvexSet | None, states: int) -> Array:
    """How long a set of deviations is along every axis, ``(d,)``; 0 without one."""
    if bound is None:
        return np.zeros(states)
    axes = np.eye(states)
    return np.asarray(bound.support(axes) + bound.support(-axes))


def _free_where_flat(bound: ConvexSet) -> ConvexSet:
    """The set of initial deviations with its flat coordinates free; raises `InputError` for one that is flat and no
    box."""
    axes = np.eye(bound.dimension)
    free = widths(bound, bound.dimension) == 0.0
    if bound.is_box and free.any():
        box = bound.bounding_box()
        return Box(np.where(free, -np.inf, box.lower), np.where(free, np.inf, box.upper))
    flat = bound.halfspaces()
    if flat is not None:
        room = flat[1] - flat[0] @ bound.interior_point()
        if (room <= SAME * np.abs(flat[0]).max(axis=1) * float(bound.reach(axes).max())).any():
            raise InputError(
                path="repeat",
                expected="a set of initial states with an interior, or a box",
                got=f"a {bound.kind} without one",
            )
    return bound
