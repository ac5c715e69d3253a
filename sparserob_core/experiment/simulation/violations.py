"""The number, the size and the time of violations of one constraint by many trajectories."""

from __future__ import annotations

from typing import final

import numpy as np

from sparserob_core.control.constraints.state import StateConstraint
from sparserob_core.control.response.time_grid import SAME_TIME
from sparserob_core.sip.convex_set import Array
from sparserob_core.sip.program import TOLERANCE


@final
class ViolationCount:
    """The largest violation of one constraint along every trajectory of a block, and over all blocks.

    With flat sides it is the largest ``H x(t) - h`` over the sides and the times. It counts as a violation where one is
    above `TOLERANCE` of its own unit (``units (r,)``). For a curved set it is the gauge less 1, at the time at which
    the trajectory is furthest outwards; its unit is 1. ``x (n,)`` is the decision.
    """

    def __init__(self, constraint: StateConstraint, times: Array, units: Array, x: Array) -> None:
        slack = SAME_TIME * times[-1]
        self.constraint, self.times = constraint, times
        self._is_curved = constraint.sides is None
        self.units, self._own_constraint = units, constraint.divided(units)
        self._is_inside = (times >= constraint.start - slack) & (times <= constraint.stop + slack)
        self._offsets, self._own_offsets = (
            constraint.compute_added_terms(x, times),
            self._own_constraint.compute_added_terms(x, times),
        )
        self.violated, self.largest, self.time = 0, -np.inf, np.nan
        self._last_state = np.zeros((constraint.functionals.response.initial_state.size, 0))

    @property
    def tolerance(self) -> float:
        """The largest violation of any row that counts as none, in the row's unit."""
        return TOLERANCE * float(self.units.min())

    def begin(self, count: int) -> None:
        """Begin a new block of ``count`` trajectories."""
        self._largest_values, self._worst_positions = np.full(count, -np.inf), np.zeros(count, dtype=int)
        self._own_violations = np.full(count, -np.inf)
        self._worst_states = np.zeros((self.constraint.functionals.response.initial_state.size, count))

    def add(self, position: int, state: Array, control: Array | None = None) -> None:
        """Add the states ``(d, n)`` at one of the times.

        ``control (m, n)`` is the control that acted until then, where it differs from one trajectory to another.
        """
        gains = self.constraint.gains
        if control is None or gains is None:
            if self._is_inside[position]:
                value = self.constraint.outwardness(state, self._offsets[position])
                own = None
                if not self._is_curved:
                    own = self._own_constraint.outwardness(state, self._own_offsets[position])
                self._update_largest(position, state, value, own)
        elif position and self._is_inside[position - 1] and self._is_inside[position]:
            for index, x in ((position - 1, self._last_state), (position, state)):
                value, own = (
                    _compute_mixed_violation(constraint, x, control)
                    for constraint in (self.constraint, self._own_constraint)
                )
                self._update_largest(index, x, value, own)
        self._last_state = state

    def _update_largest(self, position: int, state: Array, value: Array, own: Array | None) -> None:
        if own is not None:
            np.maximum(self._own_violations, own, out=self._own_violations)
        better = value > self._largest_values
        if better.any():
            np.copyto(self._largest_values, value, where=better)
            self._worst_positions[better] = position
            if self._is_curved:
                np.copyto(self._worst_states, state + self._offsets[position][:, None], where=better)

    def close(self) -> np.ndarray:
        """End the block, and return which of its trajectories ``(n,)`` violate the constraint."""
        violations = self._largest_values
        if self._is_curved:  # outwardness increases outwards, but it is no distance
            violations = self.constraint.excess(self._worst_states)
            self._own_violations = violations / self.units.max()
        is_violated = self._own_violations > TOLERANCE
        self.violated += int(is_violated.sum())
        top = int(violations.argmax())
        if violations[top] > self.largest:
            self.largest, self.time = float(violations[top]), float(self.times[self._worst_positions[top]])
        return is_violated


def _compute_mixed_violation(constraint: StateConstraint, state: Array, control: Array) -> Array:
    """Return the largest ``H x + G u - h`` of a mixed constraint, ``(n,)``."""
    assert constraint.sides is not None and constraint.gains is not None
    H, h = constraint.sides
    return np.asarray((H @ state + constraint.gains @ control - h[:, None]).max(axis=0))
