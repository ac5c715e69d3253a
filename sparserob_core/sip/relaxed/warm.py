"""A linear program of few rows that is solved again and again for other right-hand sides, each time from the last
basis."""

from __future__ import annotations

from typing import final

import numpy as np
from numpy.typing import NDArray

from sparserob_core.sip.convex_set import Array
from sparserob_core.sip.finite import FiniteProgram
from sparserob_core.sip.inner.vertex import simplex

ROUNDING = 2.0**-46  # of the numbers that are added up
FEASIBLE = 1e-10  # a violation that is none
PIVOTS, MORE = 100, 20  # steps after which HiGHS is asked, and as many more for every row
LEAST = 1e-9  # of the largest: a change of a slope that is no pivot
CLOSED = 1e-9  # of the largest cost, a gap that rounding leaves
SINGULAR = 1e11  # entries of an inverse that nothing is computed from


@final
class WarmProgram:
    """Minimise ``sum_k weights_k |x_k|`` over ``lower <= x <= upper (n,)``, which hold 0, and rows ``G x <= h``.

    Rows are added with `add`; `solve` says the right-hand sides. The dual simplex method for piecewise linear costs
    (Fourer 1985): with multipliers ``y`` the slope of entry ``k`` is ``(G'y)_k``, and the entry is at 0 while that is
    within its weight, at a bound beyond. A basis is as many ``rows`` with multipliers as entries whose slope is at its
    limit, ``free`` between 0 and a bound; the rows then say where. Where one is beyond, or a row is violated, the
    multipliers move until the dual no longer rises, over as many limits of other slopes as that takes. A basis that was
    optimal is one for other right-hand sides. Where no basis is found in time, HiGHS begins anew.
    """

    def __init__(self, weights: Array, lower: Array, upper: Array) -> None:
        self.weights, self.lower, self.upper = weights, lower, upper
        self.G = np.zeros((0, weights.size))
        self._reset_basis()

    def _reset_basis(self) -> None:
        """The basis of no rows: everything is at 0."""
        n = self.weights.size
        self._rows, self._free = list[int](), list[int]()
        self._sides = list[int]()  # 1 where the slope of a free entry is at its weight, so that it is at most 0; or -1
        self._positions = np.zeros(n)  # -1, 0 or 1: at its lower bound, at 0, at its upper bound

    def add(self, G: Array) -> None:
        """More rows ``(r, n)``."""
        self.G = np.vstack([self.G, G])

    def keep(self, wanted: NDArray[np.bool_]) -> NDArray[np.bool_]:
        """Leave out rows but for those that are ``wanted (r,)`` and those that have multipliers now, so that the basis
        is one without them too; which rows are kept ``(r,)``."""
        kept = wanted.copy()
        kept[self._rows] = True
        number = np.cumsum(kept) - 1
        self._rows = [int(number[row]) for row in self._rows]
        self.G = self.G[kept]
        return kept

    def solve(self, h: Array) -> tuple[Array, Array] | None:
        """``x (n,)`` and multipliers ``y (r,)``, for right-hand sides ``h (r,)``; ``None`` where there is no
        optimum."""
        answer, closed = None, False
        try:
            answer = self._pivot(h)
            closed = answer is not None and self._is_closed(h, *answer)
        except np.linalg.LinAlgError:
            pass
        finally:  # a basis that is wrong, or that was interrupted, is none to go on from
            if not closed:
                self._reset_basis()
        if closed:
            return answer
        n, none = self.weights.size, np.zeros(0)
        program = FiniteProgram(np.zeros(n), self.weights, self.lower, self.upper, self.G, h, np.zeros((0, n)), none)
        corner = simplex(program)
        return (corner.x, corner.y) if corner.status == "optimal" else None

    def _is_closed(self, h: Array, x: Array, y: Array) -> bool:
        """Return whether the multipliers prove a point optimal: its gap is at most `CLOSED` times the largest possible
        cost."""
        largest = float(self.weights @ np.maximum(-self.lower, self.upper))
        return float(self.weights @ np.abs(x)) - self.bound(h, y) <= CLOSED * largest

    def _pivot(self, h: Array) -> tuple[Array, Array] | None:
        """The answer by steps from the last basis; ``None`` where they lead nowhere."""
        for _ in range(PIVOTS + MORE * h.size):
            x = np.where(self._positions > 0.0, self.upper, np.where(self._positions < 0.0, self.lower, 0.0))
            x[self._free] = 0.0
            residual, columns = h - self.G @ x, self.G[:, self._free]
            inverse = np.linalg.inv(columns[self._rows])
            if not np.abs(inverse).max(initial=0.0) < SINGULAR:
                return None
            x[self._free] = at = inverse @ residual[self._rows]
            y = (self.weights[self._free] * self._sides) @ inverse
            slack = residual - columns @ at
            slack[self._rows] = np.inf
            row = int(slack.argmin()) if slack.size else -1
            short = -float(slack[row]) if slack.size else 0.0
            excess, entry, up = self._find_largest_violation(at.tolist())
            if max(excess, short) <= FEASIBLE:
                multipliers = np.zeros(h.size)
                multipliers[self._rows] = np.maximum(y, 0.0)
                return np.minimum(np.maximum(x, self.lower), self.upper), multipliers
            if short >= excess:  # the multiplier of the row rises from 0
                change = -self.G[row, self._free] @ inverse
                slope_change, kept = self.G[row] + change @ self.G[self._rows], self._free
            else:  # the slope of the entry leaves its limit
                change = inverse[entry] if up else -inverse[entry]
                slope_change, kept = change @ self.G[self._rows], self._free[:entry] + self._free[entry + 1 :]
                self._positions[self._free[entry]] = (1 - self._sides[entry]) // 2 - up
            slope_change[kept] = 0.0
            end = self._find_step_end(y, change, slope_change, max(excess, short))
            if end is None:
                return None
            leaving, entering = end
            if leaving is not None:
                del self._rows[leaving]
            if short >= excess:
                self._rows.append(row)
            else:
                del self._free[entry], self._sides[entry]
            if entering is not None:
                self._free.append(entering[0])
                self._sides.append(entering[1])
        return None

    def _find_largest_violation(self, at: list[float]) -> tuple[float, int, bool]:
        """Return the largest violation of a free entry, its number among the free entries, and whether the entry is too
        low.

        A free entry must be between 0 and one of its bounds. The number is -1 where no entry is outside.
        """
        furthest = (0.0, -1, False)
        for number, (value, free, side) in enumerate(zip(at, self._free, self._sides, strict=True)):
            low, high = (0.0, float(self.upper[free])) if side < 0 else (float(self.lower[free]), 0.0)
            furthest = max(furthest, (low - value, number, True), (value - high, number, False))
        return furthest

    def _find_step_end(
        self, y: Array, change: Array, moved: Array, rising: float
    ) -> tuple[int | None, tuple[int, int] | None] | None:
        """Move multipliers ``y`` along ``change``, and slopes along ``moved (n,)``, while the dual rises, at first by
        ``rising``: the place of the multiplier that comes to 0, or the entry whose slope comes to a limit, and the sign
        of that; ``None`` where it rises for ever."""
        slopes, size, signs = y @ self.G[self._rows], np.abs(moved), np.sign(moved)
        ahead = signs * self._positions  # 1: two limits are ahead of a slope; 0: one; -1: none
        second = np.flatnonzero((ahead >= 0.0) & (size > LEAST * size.max(initial=0.0)))
        first = second[ahead[second] > 0.0]
        entries = np.concatenate([first, second])
        lower_limit = np.concatenate([signs[first] > 0.0, signs[second] < 0.0])
        limits = np.concatenate([-self.weights[first], self.weights[second]])
        lengths = np.maximum((limits - signs[entries] * slopes[entries]) / size[entries], 0.0)
        # beyond the lower limit of its slope, minus the weight, an entry is at its upper bound
        drops = size[entries] * np.where(lower_limit, self.upper[entries], -self.lower[entries])
        order = np.argsort(lengths, kind="stable")
        passed = int(np.cumsum(drops[order]).searchsorted(rising))
        stop = float(lengths[order[passed]]) if passed < order.size else np.inf
        least, soonest, leaving = LEAST * float(np.abs(change).max(initial=0.0)), np.inf, -1
        for number, (multiplier, rate) in enumerate(zip(y.tolist(), change.tolist(), strict=True)):
            if -rate > least and max(multiplier, 0.0) / -rate < soonest:
                soonest, leaving = max(multiplier, 0.0) / -rate, number
        if min(stop, soonest) == np.inf:
            return None
        if soonest <= stop:
            passed = int(lengths[order].searchsorted(soonest))
        crossed = entries[order[:passed]]
        np.subtract.at(self._positions, crossed, signs[crossed])
        if soonest <= stop:
            return leaving, None
        enters = order[passed]
        return None, (int(entries[enters]), -1 if lower_limit[enters] else 1)

    def bound(self, h: Array, y: Array) -> float:
        """A lower bound of the cost under right-hand sides ``h (r,)``, by weak duality from any ``y (r,) >= 0``, less
        what rounding may do."""
        slope = y @ self.G
        ends = np.minimum((self.weights + slope) * self.upper, np.minimum((slope - self.weights) * self.lower, 0.0))
        reach = np.maximum(-self.lower, self.upper)
        size = y @ (np.abs(h) + np.abs(self.G) @ reach) + self.weights @ reach
        return float(ends.sum() - y @ h - ROUNDING * size)
