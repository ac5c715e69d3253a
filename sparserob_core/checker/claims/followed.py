"""The proof of one row of a constraint by its adjoint, on cells of time that the checker chooses itself."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import final

import numpy as np

from sparserob_core.checker.arithmetic.balls import above, ball, balls, below
from sparserob_core.checker.claims.case import Case
from sparserob_core.checker.claims.window import ConstraintWindow
from sparserob_core.checker.outcome import Broken, Unchecked
from sparserob_core.checker.reach.adjoint import Worst
from sparserob_core.checker.reach.kernels import BoundedInputHere
from sparserob_core.checker.sets.known import known
from sparserob_core.checker.sets.polynomials import HALF_ULP
from sparserob_core.sip.convex_set import Array

MAX_CELLS = 400_000  # cells of time examined for one row
PARTS = 8  # of a cell whose bound is too large: the distance to a chord, quadratic in the length, falls to 1/64
HALVINGS = 16  # rounds of examination: the last cells are 2^-45 of their first length, near rounding


@final
@dataclass(frozen=True, eq=False)
class FollowedRow:
    """The row with the normal ``direction`` of a constraint of a case."""

    case: Case
    window: ConstraintWindow
    direction: Array

    @cached_property
    def worst(self) -> Worst:
        """The worst case of ``c'x(t)`` over all deviations, ``c`` the part of the normal on the state."""
        return self.case.followed.worst(self.window.split(self.direction)[0], self.case.scene)

    def prove(self, limit: float) -> tuple[int, float]:
        """Show that the row is at most ``limit`` at every time of its window; return the number of cells, and an upper
        bound of the row."""
        window = self.window
        times = self.worst.cuts([window.start, window.stop, *window.cuts(self.case.control.breakpoints.tolist())])
        times = times[(times >= window.start) & (times <= window.stop)]
        start, stop = (times[:-1], times[1:]) if times.size > 1 else (times, times)
        count, top = 0, -np.inf
        for _ in range(HALVINGS):
            self.case.clock.check()
            count += start.size
            if count > MAX_CELLS:
                break
            tops = self.worst.over(start, stop, self._bound_added_terms(start, stop))
            is_open = ~(tops <= limit)
            top = max(top, float(tops[~is_open].max(initial=-np.inf)))
            if not is_open.any():
                return count, top
            self._refute(start[is_open], stop[is_open], limit)
            start, stop = _divide_cells(start[is_open], stop[is_open])
            if not start.size:
                break
        raise Unchecked(f"neither shown nor refuted: after {count} cells more than {limit!r} is not excluded")

    def enclose_added_terms(self, time: float, inside: float) -> tuple[float, float]:
        """Return a lower and an upper bound of the terms that the reference and the control add to the row at a time. A
        mixed constraint takes the control of the piece that holds the time ``inside``."""
        case, window, (state, gains) = self.case, self.window, self.window.split(self.direction)
        offset, _ = window.evaluate_reference(time, time)
        total = -sum((a * b for a, b in zip(balls(state), offset, strict=True)), ball(0.0))
        if window.is_mixed:
            ends = case.control.breakpoints
            piece = int(np.clip(np.searchsorted(ends, inside, side="right") - 1, 0, case.control.pieces - 1))
            window.meets(ends.tolist(), piece, time)
            u = case.pieces[piece].entries()
            total = total + sum((a * v for a, v in zip(balls(gains), u, strict=True)), 0 * total)
        return below(total), above(total)

    @cached_property
    def _inputs(self) -> list[BoundedInputHere]:
        """The inputs of which only the size is known."""
        return self.case.sources.entering_at([])

    def add_inputs(self, times: Array) -> tuple[Array, Array]:
        """Return bounds, ``(k,)`` below and above, of what the worst bounded inputs add at ``times (k,)``."""
        c, low, high = self.window.split(self.direction)[0], np.zeros(times.size), np.zeros(times.size)
        for entering in self._inputs:
            least, most = entering.added_at(c, times)
            low, high = low + least, high + most
            rounding_error = HALF_ULP * (np.abs(low) + np.abs(high))
            low, high = low - rounding_error, high + rounding_error
        return low, high

    def _bound_added_terms(self, start: Array, stop: Array) -> Array:
        """Return upper bounds ``(2, k)``, at both ends of cells, of the terms that are added to the state; among them
        the worst bounded inputs, with how far they may lie above their chord."""
        bounds, c = np.zeros((2, start.size)), self.window.split(self.direction)[0]
        if self.window.reference is not None or self.window.is_mixed:
            cells = self.case.clock.each(zip(start.tolist(), stop.tolist(), strict=True))
            bounds = np.array([[self.enclose_added_terms(t, (a + b) / 2)[1] for t in (a, b)] for a, b in cells]).T
        for entering in self._inputs:
            chord_errors = entering.bound_chord_errors(c, start, stop)
            input_bounds = np.stack([entering.added_at(c, times)[1] for times in (start, stop)]) + chord_errors
            bounds = bounds + input_bounds + HALF_ULP * 4.0 * (np.abs(bounds) + np.abs(input_bounds))
        return bounds

    def _refute(self, start: Array, stop: Array, limit: float) -> None:
        """Raise `Broken` where the row is certainly above ``limit`` in the middle of a cell; never where a set of
        deviations is curved, because its computed support function need not be sharp."""
        sets = (self.worst.initial_set, self.worst.disturbance_set)
        if any(deviation_set is not None and known(deviation_set).facets is None for deviation_set in sets):
            return
        middles = (start + stop) / 2
        top, overestimates = self.worst.bound_largest_value(middles)
        least = (top - overestimates) - HALF_ULP * 8.0 * np.abs(top)
        if self.window.reference is not None or self.window.is_mixed:
            lower_bounds = [self.enclose_added_terms(t, t)[0] for t in middles.tolist()]
            least = least + np.array(lower_bounds) - HALF_ULP * 8.0 * np.abs(lower_bounds)
        errors, _ = self.add_inputs(middles)
        least = least + errors - HALF_ULP * 8.0 * np.abs(errors)
        index = int(least.argmax())
        if least[index] > limit:
            raise Broken(f"{limit!r} is exceeded, by {least[index] - limit:.3g} at t = {middles[index]:.6g}")


def _divide_cells(start: Array, stop: Array) -> tuple[Array, Array]:
    """Return every cell cut into `PARTS` equal parts; no cells at all where the parts of one are too short for
    doubles."""
    ends = start[:, None] + (stop - start)[:, None] * (np.arange(PARTS + 1) / PARTS)
    ends[:, 0], ends[:, -1] = start, stop
    if not (np.diff(ends, axis=1) > 0.0).all():
        return np.zeros(0), np.zeros(0)
    return ends[:, :-1].ravel(), ends[:, 1:].ravel()
