"""Least slopes under which no evaluated value lies above the bound that the other values put on it."""

from __future__ import annotations

from math import isqrt
from typing import NamedTuple

import numpy as np

NOISE_PRICE = 1e-3
"""A unit of noise costs as much as a thousand units of slope (dlib's relative noise)."""
NEGLIGIBLE = 1e-6
"""Differences of values, relative to their spread, that need no slope."""
SHORTFALL = 0.99
"""Constraints may fall short by this factor; noise makes up for it."""
ALWAYS = 60
"""Up to so many points all pairs are looked at again with every point, later each time their number has grown by a
tenth."""
LATEST = 2000
PAIRS = 2**27
"""Points squared times coordinates, up to which all pairs are looked at: `LATEST` points up to 33 coordinates, and 180
in four thousand. Ten times as many, and the looks alone take a minute there; a tenth, and from 4 coordinates on
slopes are no longer the least of all pairs."""
NEAR = 1e-4
"""Squared distance below which the program would pay with noise rather than with slope."""
ROUNDS = 6
AT_ONCE = 12
ACTIVE = 60
ROWS = 256


class Pairs(NamedTuple):
    """Constraints ``sum_j s_j squares_j + o_lower >= rise``, one for each pair of points: ``squares (m, d)``,
    ``lower (m,)``, ``rise (m,)``."""

    squares: np.ndarray
    lower: np.ndarray
    rise: np.ndarray

    def take(self, which: np.ndarray) -> Pairs:
        return Pairs(self.squares[which], self.lower[which], self.rise[which])

    def join(self, other: Pairs) -> Pairs:
        return Pairs(*(np.concatenate(arrays) for arrays in zip(self, other, strict=True)))


class Slopes:
    """The evaluated points of a unit box, and ``slope (d,)``, ``noise (n,)`` in squared units of ``unit``, of least
    squared norm such that ``y_k <= y_i + unit sqrt(noise_i + sum_j slope_j (x_kj - x_ij)^2)`` for all pairs.

    The pairs form a quadratic program (a linear support vector machine with hard margin, in dlib), solved on the few
    pairs that matter. Between two looks at all pairs slopes only grow, so that what held keeps holding. Points with the
    value ``-inf`` take no part.
    """

    def __init__(self, dimension: int, capacity: int) -> None:
        self._points, self._raw = np.empty((capacity, dimension)), np.empty(capacity)
        self.slope, self._noise = np.zeros(dimension), np.zeros(capacity)
        self.count, self.unit, self._fitted = 0, 0.0, 0
        self._latest = min(LATEST, isqrt(PAIRS // dimension))
        self.active = Pairs(np.empty((0, dimension)), np.empty(0, dtype=int), np.empty(0))

    @property
    def points(self) -> np.ndarray:
        """Evaluated points ``(n, d)`` of the unit box."""
        return self._points[: self.count]

    @property
    def raw(self) -> np.ndarray:
        """Values ``(n,)`` as evaluated."""
        return self._raw[: self.count]

    @property
    def noise(self) -> np.ndarray:
        """Noise ``(n,)`` of each point, in squared units."""
        return self._noise[: self.count]

    @property
    def best(self) -> float:
        """Best value."""
        return float(self.raw.max())

    @property
    def top(self) -> np.ndarray:
        """Best point ``(d,)``."""
        return np.asarray(self.points[self.raw.argmax()])

    @property
    def heights(self) -> np.ndarray:
        """Values ``(n,)`` below the best one, in units; ``-inf`` counts as the lowest that is finite."""
        finite = np.isfinite(self.raw)
        unit = self.unit or 1.0
        return np.where(finite, self.raw, self.raw[finite].min()) / unit - self.best / unit

    def add(self, point: np.ndarray, value: float) -> None:
        """Append a point and refit."""
        self._points[self.count], self._raw[self.count], self._noise[self.count] = point, value, 0.0
        self.count += 1
        if not np.isfinite(value):
            return
        self._rescale()
        if not self.unit:
            return
        if self.count <= ALWAYS or self._fitted * 1.1 < self.count <= self._latest:
            self._fitted = self.count
            self._refit()
        else:
            self._extend()

    def _rescale(self) -> None:
        finite = self.raw[np.isfinite(self.raw)]
        spread = min(float(finite.max() / 2 - finite.min() / 2), 1e300)
        if spread > 2.0 * self.unit:
            shrink = (self.unit / spread) ** 2
            self.slope, self._noise[:], self.unit = self.slope * shrink, self._noise * shrink, spread
            active = self.active._replace(rise=self.active.rise * shrink)
            self.active = active.take(np.flatnonzero(active.rise > NEGLIGIBLE**2))

    def _refit(self) -> None:
        """Fit the slopes from scratch, by adding the pairs that are violated most."""
        heights = self.heights
        slope, noise = np.zeros_like(self.slope), np.zeros(self.count)
        if self.active.rise.size:
            slope, noise = self._solve()
        for _ in range(ROUNDS):
            missing, worst = self._all_pairs(heights, slope, noise)
            if not worst.rise.size:
                break
            self.active = self.active.join(worst)
            slope, noise = self._solve()
        else:
            missing, _ = self._all_pairs(heights, slope, noise)
        self.slope, self._noise[: self.count] = slope, noise + missing

    def _extend(self) -> None:
        """Raise the slopes so that they also hold for the pairs of the last point; none gets smaller."""
        last, heights = self.count - 1, self.heights
        rise = heights[:last] - heights[last]
        is_relevant = np.isfinite(self.raw[:last]) & (np.abs(rise) > NEGLIGIBLE)
        lower = np.where(rise > 0, last, np.arange(last))
        squares = self.points[:last] - self.points[last]
        pairs = Pairs(np.square(squares, out=squares), lower, rise**2)
        pairs = pairs if is_relevant.all() else pairs.take(is_relevant)
        slope, noise = self.slope, self.noise.copy()
        for _ in range(ROUNDS):
            slope_terms = pairs.squares @ slope
            left_sides = slope_terms + noise[pairs.lower]
            worst = _worst(left_sides / pairs.rise, pairs.squares)
            if not worst.size:
                break
            self.active = self.active.join(pairs.take(worst))
            new_slope, new_noise = self._solve()
            slope, noise = np.maximum(slope, new_slope), np.maximum(noise, new_noise)
        else:
            slope_terms = pairs.squares @ slope
        np.maximum.at(noise, pairs.lower, pairs.rise - slope_terms)
        self.slope, self._noise[: self.count] = slope, noise

    def _all_pairs(self, heights: np.ndarray, slope: np.ndarray, noise: np.ndarray) -> tuple[np.ndarray, Pairs]:
        """Return the noise ``(n,)`` that is still missing, and the pairs that ask for more slope."""
        order = np.flatnonzero(np.isfinite(self.raw))
        order = order[np.argsort(heights[order], kind="stable")]
        points, heights, noise = self.points[order], heights[order], noise[order]
        missing, partner, ratio = np.zeros(order.size), np.zeros(order.size, dtype=int), np.full(order.size, np.inf)
        for start in range(0, order.size, ROWS):
            rows = slice(start, start + ROWS)
            rise = np.maximum(heights - heights[rows, np.newaxis], 0.0) ** 2
            left_sides = _squares(points[rows] * np.sqrt(slope), points * np.sqrt(slope)) + noise[rows, np.newaxis]
            missing[rows] = np.maximum((rise - left_sides).max(axis=1), 0.0)
            is_relevant = rise > NEGLIGIBLE**2
            is_relevant &= _squares(points[rows], points) > NEAR
            ratios = np.where(is_relevant, left_sides, np.inf) / np.where(is_relevant, rise, 1.0)
            partner[rows], ratio[rows] = ratios.argmin(axis=1), ratios.min(axis=1)
        squares = (points - points[partner]) ** 2
        worst = _worst(ratio, squares)
        all_missing = np.zeros(self.count)
        all_missing[order] = missing
        return all_missing, Pairs(squares, order, (heights - heights[partner]) ** 2).take(worst)

    def _solve(self) -> tuple[np.ndarray, np.ndarray]:
        """Return the least slopes and noise for the active pairs, of which the slack ones are dropped (Lawson and
        Hanson 1974, section 23.4)."""
        from scipy.optimize import nnls

        pairs = self.active
        noisy_points, column = np.unique(pairs.lower, return_inverse=True)
        rows = np.hstack([pairs.squares, NOISE_PRICE * (column[:, np.newaxis] == np.arange(noisy_points.size))])
        constraints = rows.T / pairs.rise
        scale = np.sqrt((constraints**2).sum(axis=0))
        target = np.zeros(len(constraints) + 1)
        target[-1] = 1.0
        dual, _ = nnls(np.vstack([constraints / scale, 1.0 / scale]), target)
        solution = constraints @ (dual / scale)
        # The residual's last entry is a positive multiple of the squared norm; what rounding loses, the caller adds as
        # noise.
        solution /= max(1.0 - float((dual / scale).sum()), np.finfo(float).tiny)
        self.active = pairs.take(np.flatnonzero(dual > 0.0)[:ACTIVE])
        noise = np.zeros(self.count)
        noise[noisy_points] = NOISE_PRICE * solution[self.slope.size :]
        return solution[: self.slope.size], noise


def _squares(one: np.ndarray, other: np.ndarray) -> np.ndarray:
    """Return the squared distances ``(k, n)`` of two sets of points."""
    inner = one @ other.T
    inner *= -2.0
    inner += np.einsum("ij,ij->i", other, other)
    inner += np.einsum("ij,ij->i", one, one)[:, np.newaxis]
    return np.asarray(np.maximum(inner, 0.0, out=inner))


def _worst(ratio: np.ndarray, squares: np.ndarray) -> np.ndarray:
    """Return the indices of the handful of pairs, of ``squares (m, d)``, that are satisfied least. Near pairs are left
    out: they cost less as noise than as slope."""
    violated = np.flatnonzero(ratio < SHORTFALL)
    violated = violated[squares[violated].sum(axis=1) > NEAR]
    return np.asarray(violated[np.argsort(ratio[violated], kind="stable")[:AT_ONCE]])
