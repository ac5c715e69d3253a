"""The times at which the control of a problem acts, and one grid of all times at which an input may jump."""

from __future__ import annotations

from bisect import bisect_right
from dataclasses import dataclass
from functools import cached_property
from typing import final

import numpy as np

from sparserob_core.checker.outcome import Clock
from sparserob_core.control.problem.problem import OptimalControlProblem
from sparserob_core.sip.convex_set import Array

SAME = 1e-12  # relative to the horizon: nearer breakpoints are one up to rounding, as in a problem's records
# Relative to the horizon: times that a problem gives as fractions of it, such as 9/15 and 12/20, may differ by so much
# in doubles. With a tenth of it some of these are two; with a thousand times more, times are moved that are two.
ROUNDED_TIME = 2.0**-49


@final
@dataclass(frozen=True, eq=False)
class Timing:
    """The times of a ``problem`` whose ``control`` and ``disturbance`` have these breakpoints. A control that is
    ``answering`` measures at its breakpoints."""

    problem: OptimalControlProblem
    control: Array
    disturbance: Array
    answering: bool
    clock: Clock

    @cached_property
    def acting(self) -> list[float]:
        """The times at which the pieces of the control begin to act, from 0 on, and until which they may be late."""
        settled = self.control[1:-1] + self.problem.jitter if self.problem.jitter else np.zeros(0)
        starts: list[float] = np.unique([0.0, *(self.control[:-1] + self.problem.system.delay), *settled]).tolist()
        return starts

    @property
    def until(self) -> float:
        """The last time about which anything is claimed."""
        return max(float(self.control[-1]), float(self.disturbance[-1]), self.problem.horizon)

    @cached_property
    def grid(self) -> list[float]:
        """The breakpoints of both dictionaries, those of the control later by the delay, and the switches of the
        system; also the breakpoints at which an answering control measures."""
        self.clock.check()
        ends, last = (self.control[-1], self.disturbance[-1]), self.until
        measured = self.control.tolist() if self.answering else []
        times = np.unique([*self.acting, *measured, *self.disturbance.tolist(), *self.problem.system.switches])
        return [*times[(times < last) & ~np.isin(times, ends)].tolist(), last]

    def piece_at(self, time: float) -> int:
        """Return the piece of the `grid` that contains a time from 0 on; the last piece contains the end too."""
        return min(bisect_right(self.grid, time) - 1, len(self.grid) - 2)


def before(problem: OptimalControlProblem) -> list[float]:
    """Return the control ``(m,)`` that acts until the first piece of a delayed system acts."""
    initial_control = problem.initial_control
    return (
        [0.0] * problem.system.controls if initial_control is None else [float(u) for u in np.asarray(initial_control)]
    )


def join_breakpoints(times: Array, others: Array) -> Array:
    """Return the increasing ``times``, of which those that differ from one of the ``others`` by the rounding of a
    fraction of the horizon only (`ROUNDED_TIME`) are replaced by it; never the first and the last.

    No bound can be charged for such a difference. A control with unbounded gains that measures a block of the
    disturbance for one unit in the last place knows it. So breakpoints of a problem in which a control measures at
    fractions of the horizon, and a disturbance jumps at such, are the same where the fractions are.
    """
    after = np.clip(np.searchsorted(others, times), 1, others.size - 1)
    before, behind = others[after - 1], others[after]
    nearest = np.where(times - before <= behind - times, before, behind)
    is_same = np.abs(nearest - times) <= ROUNDED_TIME * times[-1]
    is_same[[0, -1]] = False
    joined: Array = np.where(is_same, nearest, times)
    return joined if (np.diff(joined) > 0.0).all() else times
