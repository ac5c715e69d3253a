"""The times between which nothing jumps: those at which control and disturbance may change, merged."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise

import numpy as np

from sparserob_core.shapes import Float, Int, shaped
from sparserob_core.sip.convex_set import Array

SAME_TIME = 1e-12  # times closer than this share of the horizon are one


@dataclass(frozen=True, eq=False)
class TimeGrid:
    """Union of the times at which control and disturbance may change.

    ``breakpoints (L+1,)``. ``control_piece (L,)`` and ``disturbance_piece (L,)``: the piece of each dictionary that
    acts on a piece of the grid; -1 where the control ``before (m,)`` still acts. ``constants``: the number of columns
    of ``B`` after those of the control, whose input is always 1 (a drift). ``mode (L,)``: the mode of a switched system
    on each piece; ``None`` for a single system. ``elapsed``: the time that has passed before time 0 of this grid, where
    the grid begins later. ``varying``: true for a system that changes with time, so that every piece is a mode of its
    own.
    """

    breakpoints: Array
    control_piece: np.ndarray
    disturbance_piece: np.ndarray
    before: Array | None = None
    constants: int = 0
    mode: np.ndarray | None = None
    elapsed: float = 0.0
    varying: bool = False

    @property
    def pieces(self) -> int:
        return int(self.breakpoints.size - 1)

    @property
    def lengths(self) -> Array:
        return np.diff(self.breakpoints)

    @cached_property
    def decided(self) -> np.ndarray:
        """Pieces ``(J,)`` on which a piece of the control acts."""
        return np.flatnonzero(self.control_piece >= 0)

    @shaped
    def inputs(self, control: Float[Array, "m K"]) -> Float[Array, "mc L"]:
        """Return the inputs through every column of ``B`` on the pieces of this grid, from the control on its own
        pieces."""
        acting = control[:, np.maximum(self.control_piece, 0)]
        if self.before is not None:
            acting = np.where(self.control_piece >= 0, acting, self.before[:, None])
        return np.vstack([acting, np.ones((self.constants, self.pieces))]) if self.constants else acting

    def commanded(self, breakpoints: Array) -> np.ndarray:
        """Return the piece of the control, with these ``breakpoints (K + 1,)``, that is commanded on every piece of the
        grid, ``(L,)``. Without a delay this is the piece that acts."""
        middles = (self.breakpoints[:-1] + self.breakpoints[1:]) / 2
        return np.asarray(np.searchsorted(breakpoints, middles) - 1)

    @property
    def modes(self) -> np.ndarray:
        """Mode of the system on every piece, ``(L,)``."""
        return np.zeros(self.pieces, dtype=int) if self.mode is None else self.mode

    def of_modes(self, matrices: Array) -> Array:
        """Return the matrices ``(J, d, m)`` of every mode, from ``(d, J m)`` side by side."""
        rows, columns, modes = *matrices.shape, len(self.turns)
        by_mode = matrices.reshape(rows, modes, columns // modes)
        return np.ascontiguousarray(by_mode.swapaxes(0, 1))

    @cached_property
    def turns(self) -> list[slice]:
        """Pieces of each mode, one mode after another."""
        if self.mode is None:
            return [slice(0, self.pieces)]
        ends = np.searchsorted(self.mode, np.arange(int(self.mode[-1]) + 2))
        return [slice(int(start), int(stop)) for start, stop in pairwise(ends)]

    def through(self, gains: Array, matrices: Array) -> Array:
        """Return ``gains @ matrices``: weights ``(..., L, m)`` on the inputs of every piece, from weights ``(..., L,
        d)`` on the forcing of the state. ``matrices (..., d, J m)`` are those of the ``J`` modes side by side."""
        if self.mode is None:
            return np.asarray(gains @ matrices)
        by_mode = np.split(matrices, len(self.turns), axis=-1)
        return np.concatenate(
            [gains[..., segment, :] @ matrix for segment, matrix in zip(self.turns, by_mode, strict=True)], axis=-2
        )

    def driven(self, matrices: Array, inputs: Array) -> Array:
        """Return the forcing of the state on every piece, ``(..., L, d)``, from inputs ``(..., m, L)``. ``matrices
        (..., d, J m)`` are those of the ``J`` modes side by side."""
        if self.mode is None:
            return np.asarray(np.swapaxes(matrices @ inputs, -1, -2))
        by_mode = np.split(matrices, len(self.turns), axis=-1)
        force = [matrix @ inputs[..., segment] for segment, matrix in zip(self.turns, by_mode, strict=True)]
        return np.swapaxes(np.concatenate(force, axis=-1), -1, -2)

    def leg(self, mode: int) -> TimeGrid:
        """Return the grid of the pieces of one mode, in times from where the mode begins."""
        segment, breaks = self.turns[mode], self.breakpoints
        start = float(breaks[segment.start])
        points = breaks[segment.start : segment.stop + 1] - start
        control_piece, disturbance_piece = self.control_piece[segment], self.disturbance_piece[segment]
        return TimeGrid(points, control_piece, disturbance_piece, self.before, self.constants, elapsed=start)

    def refined(self, times: Array) -> TimeGrid:
        """Return a grid on other times, ``(T,)`` from 0 to the horizon, that include the breakpoints; its inputs are
        given on the pieces of this grid."""
        origin = self.locate((times[:-1] + times[1:]) / 2)
        if self.varying:
            return TimeGrid(times, origin, origin, mode=np.arange(origin.size), varying=True)
        return TimeGrid(times, origin, origin, mode=None if self.mode is None else self.mode[origin])

    @shaped
    def distinct(self, durations: Float[Array, " k"]) -> tuple[Float[Array, " u"], Int[np.ndarray, " k"]]:
        """Return the distinct durations ``(u,)`` among ``(k,)``, and the index of each duration among them. Durations
        are rounded to the share 1e-15 of the horizon first, so that those that differ by rounding are one."""
        horizon = self.breakpoints[-1]
        shares, indices = np.unique((durations / horizon).round(15), return_inverse=True)
        return shares * horizon, indices.reshape(-1)

    @shaped
    def locate(self, times: Float[Array, " k"]) -> Int[np.ndarray, " k"]:
        """Return the index of the piece that contains each time ``(k,)``; a breakpoint belongs to the piece that it
        ends."""
        return np.minimum(np.maximum(self.breakpoints.searchsorted(times) - 1, 0), self.pieces - 1)


@shaped
def distinct_times(times: Float[Array, " k"], horizon: float) -> Float[Array, " u"]:
    """Return the times in increasing order; times closer than rounding are one. The first and the last time do not
    change."""
    points = np.unique(times)
    kept = points[np.concatenate([[True], np.diff(points) > SAME_TIME * horizon])]
    kept[-1] = points[-1]
    answer: Array = kept
    return answer


@shaped
def merge_grids(
    control: Float[Array, " K"],
    disturbance: Float[Array, " M"],
    delay: float = 0.0,
    before: Float[Array, " m"] | None = None,
    constants: int = 0,
    switches: Sequence[float] = (),
    varying: bool = False,
) -> TimeGrid:
    """Return the merged grid of two sets of breakpoints over the same horizon.

    A control acts later by ``delay``, less than the horizon, and ``before (m,)`` acts until then. The times at which
    the control is commanded, and at which the measurements that it answers are taken, are on the grid too. The mode
    changes at ``switches``, or from piece to piece for a system that is ``varying`` with time.

    A breakpoint of the disturbance that differs from one of the control by rounding only is replaced by the latter. Two
    breakpoints of one set are never merged, however near they are, so that no piece of either set is lost.
    """
    begin = control
    if delay > 0.0:
        begin, horizon = control + delay, float(control[-1])
        later = np.concatenate([[0.0], begin[begin < horizon - SAME_TIME * horizon], [horizon]])
        control = merge_breakpoints(control, later)
    points = merge_breakpoints(control, disturbance)
    if switches:
        points = merge_breakpoints(points, np.array(switches))
    middles = (points[:-1] + points[1:]) / 2
    control_piece, disturbance_piece = np.searchsorted(begin, middles) - 1, np.searchsorted(disturbance, middles) - 1
    mode = np.searchsorted(switches, middles) if switches else np.arange(middles.size) if varying else None
    return TimeGrid(
        points, control_piece, disturbance_piece, before if delay > 0.0 else None, constants, mode, varying=varying
    )


def merge_breakpoints(points: Array, others: Array) -> Array:
    """Return the union of two sets of breakpoints. A breakpoint of the second set that differs from one of the first by
    rounding only is left out; of several next to the same one, only the first is."""
    after = np.clip(np.searchsorted(points, others), 1, points.size - 1)
    nearest = np.where(others - points[after - 1] <= points[after] - others, after - 1, after)
    is_near = np.abs(others - points[nearest]) <= SAME_TIME * float(points[-1])
    # the first of those near one breakpoint
    is_same = is_near & (np.diff(np.where(is_near, nearest, -1), prepend=-1) != 0)
    return np.union1d(points, others[~is_same])
