"""How often, how much and when many trajectories violate one constraint."""

from __future__ import annotations

from typing import final

import numpy as np

from sparserob_core.control.constraints.curved import CurvedConstraint
from sparserob_core.control.response.response import SAME_TIME
from sparserob_core.control.sets.curved import Ellipsoid, NormBall
from sparserob_core.control.sets.directions import sampled, unit
from sparserob_core.control.sets.sets import Cylinder
from sparserob_core.control.transcription.state_constraints import StateConstraint
from sparserob_core.sip.convex_set import Array, ConvexSet
from sparserob_core.sip.proof.branch_and_bound import TOLERANCE


@final
class Census:
    """The largest violation of one constraint along every trajectory of a block, and over all blocks.

    With flat sides: the largest ``H x(t) - h`` over the sides and the times. A curved set: the signed distance, outside
    exactly, inside by tangents of the set (so that a margin is never understated), at the time at which the trajectory
    is furthest out by the set's gauge.
    """

    def __init__(self, constraint: StateConstraint, times: Array) -> None:
        slack = SAME_TIME * times[-1]
        self.constraint, self.times = constraint, times
        self.tolerance = TOLERANCE * min(1.0, 1e3 * constraint.scale)
        self._inside = (times >= constraint.start - slack) & (times <= constraint.stop + slack)
        self.violated, self.largest, self.time = 0, -np.inf, np.nan

    def begin(self, count: int) -> None:
        """A new block of ``count`` trajectories."""
        self._best, self._when = np.full(count, -np.inf), np.zeros(count, dtype=int)
        self._states = np.zeros((self.constraint.functionals.response.initial_state.size, count))

    def meet(self, position: int, state: Array) -> None:
        """The states ``(d, n)`` at one of the times."""
        if not self._inside[position]:
            return
        constraint = self.constraint
        if isinstance(constraint, CurvedConstraint):
            value = _outwardness(constraint.set, state.T)
        else:
            value = (constraint.H @ state - constraint.h[:, None]).max(axis=0)
        better = value > self._best
        if better.any():
            np.copyto(self._best, value, where=better)
            self._when[better] = position
            if isinstance(constraint, CurvedConstraint):
                np.copyto(self._states, state, where=better)

    def close(self) -> np.ndarray:
        """Which trajectories of the block violate the constraint, ``(n,)``."""
        found = self._best
        if isinstance(self.constraint, CurvedConstraint):
            found = _distances(self.constraint.set, self._states.T)
        out = found > self.tolerance
        self.violated += int(out.sum())
        top = int(found.argmax())
        if found[top] > self.largest:
            self.largest, self.time = float(found[top]), float(self.times[self._when[top]])
        return out


def _outwardness(convex: ConvexSet, points: Array) -> Array:
    """A cheap measure ``(n,)`` of points ``(n, d)`` that is positive outside, negative inside, and grows outwards."""
    if isinstance(convex, Cylinder):
        return _outwardness(convex.base, points[:, : convex.base.dimension])
    if isinstance(convex, Ellipsoid):
        inverse = np.linalg.inv(convex.factor)
        return np.asarray(np.linalg.norm(inverse @ (points - convex.centre).T, axis=0) - 1.0)
    if isinstance(convex, NormBall):
        return np.asarray(np.linalg.norm(points - convex.centre, ord=convex.p, axis=1) - convex.radius)
    return convex.violation(points)


def _distances(convex: ConvexSet, points: Array) -> Array:
    """Distance to a curved set outside, and inside the largest ``c'x - h(c)`` over sampled unit directions,
    ``(n,)``."""
    directions = unit(convex, sampled(int(convex.normals.shape[0])))
    tangent = (points @ directions.T - convex.support(directions)).max(axis=1)
    outside = convex.violation(points)
    return np.asarray(np.where(outside > 0.0, np.maximum(outside, tangent), tangent))
