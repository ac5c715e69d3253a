"""Inputs of a problem that enter at any time and of which only the size is known: measurable disturbances and errors of
execution."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise
from typing import final

import numpy as np
from flint import arb, arb_mat

from sparserob_core.checker.arithmetic.balls import ball, balls
from sparserob_core.checker.arithmetic.series import stacked
from sparserob_core.checker.flow.flows import VerifiedFlows
from sparserob_core.checker.outcome import Unchecked
from sparserob_core.checker.problem.timing import Timing, before
from sparserob_core.checker.reach.bounded_inputs import BoundedInputAt, BoundedInputOver, SizedInput
from sparserob_core.checker.reach.followed import FollowedRows
from sparserob_core.checker.reach.followed_inputs import FollowedInput
from sparserob_core.checker.reach.kernels import BoundedInput, BoundedInputHere
from sparserob_core.checker.sets.known import summands_of
from sparserob_core.checker.sets.summands import channels
from sparserob_core.control.problem.problem import OptimalControlProblem
from sparserob_core.sip.convex_set import Array


@final
@dataclass(frozen=True, eq=False)
class Sources:
    """The bounded inputs of a ``problem``. ``pieces`` makes the pieces of the control, of which there may be none."""

    problem: OptimalControlProblem
    timing: Timing
    flows: VerifiedFlows
    pieces: Callable[[], Sequence[arb_mat]]
    followed: FollowedRows

    @cached_property
    def measurable_input(self) -> BoundedInput | None:
        """The measurable disturbances, counted from the middle of their set; ``None`` without such. They are the errors
        of a command of size 1 through the columns of ``E``."""
        bound = self.problem.measurable
        if bound is None:
            return None
        summands, system = summands_of(bound), self.problem.system
        whole, ends = stacked([[v] for v in balls(np.ones(len(summands)))]), np.array([0.0, self.timing.grid[-1]])
        return self._build_bounded_input(
            SizedInput(np.ones(len(summands)), ends, [whole], summands, system.controls + system.drifts)
        )

    def _build_bounded_input(self, entering: SizedInput) -> BoundedInput:
        """Return a bounded input of this size at every parameter of the system."""
        if self.flows.box.middle:
            return BoundedInputOver(self.flows, entering)
        if self.followed.still is not None:
            return FollowedInput(self.followed.adjoint, entering)
        return BoundedInputAt(self.flows.at(()), entering)

    def measurable_input_at(self, parameter: Sequence[float]) -> BoundedInputHere | None:
        """Return `measurable_input` at one parameter."""
        return None if self.measurable_input is None else self.measurable_input.at(parameter)

    def find_means(self, pieces: Sequence[arb_mat]) -> list[arb_mat]:
        """Return the middle of what may be delivered for ``pieces`` of the control, from each of the times
        `Timing.acting` on.

        It is the value of a piece, and half of the old and half of the new value while a change may be late.
        """
        mean = lambda old, new: new if old is new else (old + new) / 2  # noqa: E731
        return self._between_changes(pieces, mean, lambda value: value)

    def _between_changes(
        self,
        pieces: Sequence[arb_mat],
        late: Callable[[arb_mat, arb_mat], arb_mat],
        settled: Callable[[arb_mat], arb_mat],
    ) -> list[arb_mat]:
        """Return one matrix for each interval in which a change may be late, and for each in which none is."""
        if not self.problem.jitter:
            return [settled(value) for value in pieces]
        after = [matrix for old, new in pairwise(pieces) for matrix in (late(old, new), settled(new))]
        return [*map(settled, pieces[:1]), *after]

    @cached_property
    def changes(self) -> BoundedInput | None:
        """The input that late changes of the control may deliver beside `find_means`: up to half of a change."""
        if not self.problem.jitter:
            return None
        if self.timing.answering:
            raise Unchecked("the checker knows changes that come late without feedback")
        m, breakpoints = self.problem.system.controls, np.array([*self.timing.acting, self.problem.horizon])
        none = stacked([[v] for v in balls(np.zeros(m))])
        pieces = self._between_changes(self.pieces(), lambda old, new: (new - old) / 2, lambda _: none)
        return self._build_bounded_input(SizedInput(np.ones(m), breakpoints, pieces, channels(m)))

    @cached_property
    def execution(self) -> BoundedInput | None:
        """The errors of execution, or `changes` that come late; ``None`` where the command is delivered exactly.

        They have no pieces where the certificate has no control.
        """
        shares, system = self.problem.execution, self.problem.system
        if shares is None:
            return self.changes
        if self.timing.answering:
            raise Unchecked("the checker knows errors of execution without feedback")
        shares, breakpoints, pieces = np.asarray(shares, dtype=float), self.timing.control, self.pieces()
        if system.delay > 0.0:  # the control before 0 is the first piece; the last pieces act after the horizon
            begins = breakpoints[:-1] + system.delay
            breakpoints = np.array([0.0, *begins[begins < self.problem.horizon], self.problem.horizon])
            pieces = [stacked([[v] for v in balls(before(self.problem))]), *pieces][
                : breakpoints.size - 1 if pieces else 0
            ]
        summands = channels(shares.size)
        return self._build_bounded_input(SizedInput(shares, breakpoints, pieces, summands, numb=self.problem.commanded))

    def delivered_at(self, parameter: Sequence[float]) -> BoundedInputHere | None:
        """Return `execution` at one parameter."""
        return None if self.execution is None else self.execution.at(parameter)

    @property
    def entering(self) -> list[BoundedInput]:
        """All bounded inputs."""
        return [source for source in (self.execution, self.measurable_input) if source is not None]

    def entering_at(self, parameter: Sequence[float]) -> list[BoundedInputHere]:
        """Return all bounded inputs at one parameter."""
        return [source.at(parameter) for source in self.entering]

    def erring(self, c: Array, time: float, parameter: Sequence[float]) -> tuple[Array | None, arb]:
        """Return lower bounds of what errors of execution add to ``c'x(t)`` at a parameter, for a command of size 1 on
        every piece, ``(K, m)`` or ``None``; where changes may come late, for changes of size 2 on ``2 K - 1`` ones.
        The second value is that for the control that acts until the delay is over, or 0."""
        delivered = self.delivered_at(parameter)
        bounds, none = None if delivered is None else delivered.least(c, time), ball(0)
        if bounds is None or not self.problem.system.delay > 0.0:
            return bounds, none
        sizes: Array = np.zeros((self.timing.control.size - 1, bounds.shape[1]))
        sizes[: len(bounds) - 1] = bounds[1:]
        pairs = zip(balls(bounds[0]), balls(before(self.problem)), strict=True)
        return sizes, sum((size * abs(u) for size, u in pairs), none)
