"""The largest effort that any deviation causes, enclosed: ``max_w sum_k |a_k + A_k w|`` is a convex maximisation.

For signs ``s`` the sum ``s'(a + A w)`` has its largest value over the deviations in closed form, and the largest of
these over all signs is the effort. So signs are what is branched on. Where ``a_k + A_k w`` lies between ``l < 0 < u``,
its absolute value lies below its chord ``-2 l u / (u - l) + (u + l) / (u - l) (a_k + A_k w)``. With the chords of all
entries whose sign is open, the bound of a part is in closed form too (McCormick 1976). The deviation at which it is
attained is a candidate, from which signs and deviations are improved in turn.
"""

from __future__ import annotations

import heapq
from dataclasses import dataclass
from typing import final

import numpy as np

from sparserob_core.sip.convex_set import Array
from sparserob_core.sip.finite import Spread

PARTS, WORK = 200_000, 4_000_000_000  # that are bounded at most; and how many times a number of `A` is used
AT_ONCE = 128  # parts that are divided together
ASCENT = 4  # times that signs and deviations are improved in turn
CLOSE = 2e-9  # of the effort, by which a part may exceed the largest that was found
KEPT = 16  # signs that are remembered


@final
@dataclass(frozen=True, eq=False)
class Effort:
    """Bounds of the largest effort, and the best signs that the search found.

    Parameters
    ----------
    lower, upper : float
        Bounds of the largest effort, without an allowance for rounding.
    signs : ndarray, shape (c, n)
        Signs with the largest efforts, the largest first.
    values : ndarray, shape (c,)
        Largest value of ``s'(a + A w)`` over all deviations, for each row ``s`` of signs.
    """

    lower: float
    upper: float
    signs: Array
    values: Array


def largest_effort(a: Array, A: Array, spread: Spread, parts: int = PARTS) -> Effort:
    """Return ``max_w sum_k |a_k + A_k w|`` of ``a (n,)`` and ``A (n, Q)``, over the deviations of the ``spread``."""
    return _SignSearch(a, A, spread).run(parts)


@final
class _SignSearch:
    """Branch and bound over the signs of the control's entries. A part holds sign vectors by its ``slopes (n,)``: a
    sign where it is fixed, and the slope of the chord where it is open."""

    def __init__(self, a: Array, A: Array, spread: Spread) -> None:
        self.a, self.A, self.spread = a, A, spread
        high, low = a + spread.support(A), a - spread.support(-A)
        self.open = (low < 0.0) & (high > 0.0)
        width = np.where(self.open, high - low, 1.0)
        self.slopes = np.where(self.open, (high + low) / width, np.where(low >= 0.0, 1.0, -1.0))
        self.heights = np.where(self.open, -2.0 * (low / width) * high, 0.0)
        self.lower, self.closed, self.count = -np.inf, -np.inf, 0
        self.heap: list[tuple[float, int, Array, np.ndarray, int]] = []
        self.found: dict[bytes, tuple[float, Array]] = {}

    @property
    def enough(self) -> float:
        """Upper bound up to which a part is not divided any more."""
        return self.lower + CLOSE * abs(self.lower)

    def run(self, parts: int) -> Effort:
        self.bound(self.slopes[None], self.open[None])
        limit = min(parts, WORK // max(1, self.A.size))
        while self.heap and self.count < limit:
            batch = [heapq.heappop(self.heap) for _ in range(min(AT_ONCE, len(self.heap)))]
            if -batch[0][0] <= self.enough:
                self.closed = max(self.closed, -batch[0][0])
                self.heap = []
                break
            slopes, open_ = (np.repeat([item[position] for item in batch], 2, axis=0) for position in (2, 3))
            rows, entries = np.arange(2 * len(batch)), np.repeat([item[4] for item in batch], 2)
            open_[rows, entries] = False
            slopes[rows, entries] = np.tile([1.0, -1.0], len(batch))
            self.bound(slopes, open_)
        upper = max(self.enough, self.closed, -self.heap[0][0] if self.heap else -np.inf)
        best = sorted(self.found.values(), key=lambda candidate: -candidate[0])[:KEPT]
        return Effort(self.lower, upper, np.array([s for _, s in best]), np.array([value for value, _ in best]))

    def bound(self, slopes: Array, open_: np.ndarray) -> None:
        """Bound parts, improve what they suggest, and keep those that must be divided."""
        first, self.count = self.count, self.count + len(slopes)
        along = slopes @ self.A
        bounds = slopes @ self.a + open_ @ self.heights + self.spread.support(along)
        w = self.spread.worst(along)
        values = self.a + w @ self.A.T
        self.improve(values)
        slack = np.where(open_, self.heights + slopes * values - np.abs(values), -1.0)
        entries = slack.argmax(axis=1)
        for i, height in enumerate(bounds.tolist()):
            if height <= self.enough or not open_[i].any():
                self.closed = max(self.closed, height)
            else:
                heapq.heappush(self.heap, (-height, first + i, slopes[i], open_[i], int(entries[i])))

    def improve(self, values: Array) -> None:
        """Improve signs and deviations in turn, starting from the largest efforts among the controls
        ``values (k, n)``."""
        order = np.argsort(-np.abs(values).sum(axis=1), kind="stable")[:KEPT]
        signs = np.where(values[order] >= 0.0, 1.0, -1.0)
        for _ in range(ASCENT):
            along = signs @ self.A
            heights = signs @ self.a + self.spread.support(along)
            for sign_vector, height in zip(signs, heights.tolist(), strict=True):
                self.found.setdefault(sign_vector.tobytes(), (height, sign_vector))
            self.lower = max(self.lower, float(heights.max()))
            better_signs = np.where(self.a + self.spread.worst(along) @ self.A.T >= 0.0, 1.0, -1.0)
            is_changed = (better_signs != signs).any(axis=1)
            if not is_changed.any():
                break
            signs = better_signs[is_changed]
