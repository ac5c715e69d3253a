"""The proof of one row of a constraint along its adjoint, on cells of time of the checker's own."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import final

import numpy as np

from sparserob_core.checker.arithmetic.balls import above, balls, below
from sparserob_core.checker.claims.case import Case
from sparserob_core.checker.claims.window import ConstraintWindow
from sparserob_core.checker.outcome import Broken, Unchecked
from sparserob_core.checker.reach.adjoint import Worst
from sparserob_core.checker.reach.execution import FollowedExecution
from sparserob_core.checker.sets.known import known
from sparserob_core.checker.sets.polynomials import HALF_ULP
from sparserob_core.sip.convex_set import Array

MOST_CELLS = 400_000  # of time, examined for one row
PARTS = 8  # into which a cell is cut that is not bounded: a tenth of a chord's distance is left, and less
HALVINGS = 16  # rounds of cuts: cells are then rounding


@final
@dataclass(frozen=True, eq=False)
class FollowedRow:
    """The row of a window of a case with the normal ``direction``."""

    case: Case
    window: ConstraintWindow
    direction: Array

    @cached_property
    def worst(self) -> Worst:
        """The worst of what the state does to it."""
        return self.case.followed.worst(self.window.split(self.direction)[0], self.case.scene)

    def prove(self, limit: float) -> tuple[int, float]:
        """Show that the row is nowhere in its window above ``limit``; the number of cells that this took, and what it
        is at most."""
        window = self.window
        times = self.worst.cuts([window.start, window.stop, *window.cuts(self.case.control.breakpoints.tolist())])
        times = times[(times >= window.start) & (times <= window.stop)]
        start, stop = (times[:-1], times[1:]) if times.size > 1 else (times, times)
        count, top = 0, -np.inf
        for _ in range(HALVINGS):
            self.case.clock.check()
            count += start.size
            if count > MOST_CELLS:
                break
            tops = self.worst.over(start, stop, self._added(start, stop))
            open_ = ~(tops <= limit)
            top = max(top, float(tops[~open_].max(initial=-np.inf)))
            if not open_.any():
                return count, top
            self._refute(start[open_], stop[open_], limit)
            start, stop = _parts(start[open_], stop[open_])
            if not start.size:
                break
        raise Unchecked(f"neither shown nor refuted: after {count} cells more than {limit!r} is not excluded")

    def beside(self, time: float, inside: float) -> tuple[float, float]:
        """What stands beside the state in the row at a time, with the control of the piece that holds ``inside``,
        between bounds."""
        case, window, (state, gains) = self.case, self.window, self.window.split(self.direction)
        offset, _ = window.moved(time, time)
        total = -sum((a * b for a, b in zip(balls(state), offset, strict=True)), balls([0.0])[0])
        if window.is_mixed:
            ends = case.control.breakpoints
            piece = int(np.clip(np.searchsorted(ends, inside, side="right") - 1, 0, case.control.pieces - 1))
            window.meets(ends.tolist(), piece, time)
            u = case.pieces[piece].entries()
            total = total + sum((a * v for a, v in zip(balls(gains), u, strict=True)), 0 * total)
        return below(total), above(total)

    @property
    def _delivered(self) -> FollowedExecution | None:
        """How exactly the control is delivered."""
        found = self.case.sources.execution
        assert found is None or isinstance(found, FollowedExecution)  # it is followed by age there
        return found

    def erring(self, times: Array) -> tuple[Array, Array]:
        """What the worst errors of execution add to it at ``times (k,)``: between ``(k,)`` and ``(k,)``."""
        delivered, none = self._delivered, np.zeros(times.size)
        return (none, none) if delivered is None else delivered.added_at(self.window.split(self.direction)[0], times)

    def _added(self, start: Array, stop: Array) -> Array:
        """What stands beside the state at both ends of cells, and what errors of execution add there, ``(2, k)``, at
        most; with how far these may be above their chord."""
        found, delivered = np.zeros((2, start.size)), self._delivered
        if self.window.reference is not None or self.window.is_mixed:
            cells = self.case.clock.each(zip(start.tolist(), stop.tolist(), strict=True))
            found = np.array([[self.beside(t, (a + b) / 2)[1] for t in (a, b)] for a, b in cells]).T
        if delivered is not None:
            bent = delivered.bent_over(self.window.split(self.direction)[0], start, stop)
            more = np.stack([self.erring(times)[1] for times in (start, stop)]) + bent
            found = found + more + HALF_ULP * 4.0 * (np.abs(found) + more)
        return found

    def _refute(self, start: Array, stop: Array, limit: float) -> None:
        """Raise `Broken` where the row is certainly above ``limit`` in the middle of a cell, with sets whose support
        functions are sharp."""
        sets = (self.case.problem.initial_set, self.case.problem.disturbance)
        if any(one is not None and known(one).facets is None for one in sets):
            return
        middles = (start + stop) / 2
        top, wide = self.worst.most(middles)
        least = (top - wide) - HALF_ULP * 8.0 * np.abs(top)
        if self.window.reference is not None or self.window.is_mixed:
            more = [self.beside(t, t)[0] for t in middles.tolist()]
            least = least + np.array(more) - HALF_ULP * 8.0 * np.abs(more)
        errors, _ = self.erring(middles)
        least = least + errors - HALF_ULP * 8.0 * np.abs(errors)
        place = int(least.argmax())
        if least[place] > limit:
            raise Broken(f"{limit!r} is exceeded, by {least[place] - limit:.3g} at t = {middles[place]:.6g}")


def _parts(start: Array, stop: Array) -> tuple[Array, Array]:
    """Cells in equal parts; none where these are rounding."""
    ends = start[:, None] + (stop - start)[:, None] * (np.arange(PARTS + 1) / PARTS)
    ends[:, 0], ends[:, -1] = start, stop
    if not (np.diff(ends, axis=1) > 0.0).all():
        return np.zeros(0), np.zeros(0)
    return ends[:, :-1].ravel(), ends[:, 1:].ravel()
