"""First survey of the violation of a family: grids, finer ones where they do not resolve it, and the local maxima of
all points that were evaluated."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import product

import numpy as np

from sparserob_core.sip.convex_set import Array
from sparserob_core.sip.separation.refinement import Candidates, Truths, VectorFunction, move_into_box

GRID_SIDE = {1: 257, 2: 33, 3: 13, 4: 7}
RANDOM_POINTS = 2048
# Points along each coordinate of a block that halves the spacing around one point of a grid, from one neighbour to the
# other. With 9 of them a level costs twice as much; with 3 of them no curvature of the block can be compared.
BLOCK_SIDE = 5
# Times that the spacing of a grid is halved at most. With a third of them the ends of an interval, where polynomials of
# degree 40 oscillate 20 times as fast as in the middle, are not resolved; with ten times as many a kink is followed to
# rounding, which the refinement does better.
DEPTH = 6
# Of the points of a grid, along each coordinate, one in so many may get a block, half as many at every level: together
# these have then about as many points as the grid. With 1 a crest of two coordinates takes eight times as
# long as the grid; with 10 only a single peak in a hundred is resolved.
POINTS_PER_BLOCK = 3
# Of the larger of two neighbouring second differences, by how much they may differ where a grid resolves a function:
# that is the case from some ten points a period on. With a tenth of it every grid is halved; ten times as much is true
# everywhere.
MAX_DIFFERENCE_CHANGE = 0.5
# Of the largest violation of a grid, what is worth more points in the same round. With a tenth of it early rounds cost
# twice as much; with all of it peaks come one round after the other.
WORTHWHILE_SHARE = 0.1


@dataclass(frozen=True, eq=False)
class Survey:
    """Points ``(k, d)`` of the unit box with the values ``(k, r)`` there, and their local ``peaks`` with the
    ``promise (c,)`` of each, an estimate of the maximum, and its ``reach (c,)``, what the maximum may be at most."""

    points: Array
    values: Array
    peaks: Candidates
    promise: Array
    reach: Array

    def join(self, other: Survey) -> Survey:
        """The points and peaks of both."""
        return Survey(
            np.concatenate([self.points, other.points]),
            np.concatenate([self.values, other.values]),
            self.peaks.join(other.peaks),
            np.concatenate([self.promise, other.promise]),
            np.concatenate([self.reach, other.reach]),
        )

    def best(self, most: int) -> Truths:
        """Return a mask of the peaks that are among the ``most`` promising ones of their row."""
        order = np.lexsort((-self.promise, self.peaks.rows))
        rows = self.peaks.rows[order]
        rank = np.arange(rows.size) - np.searchsorted(rows, rows)
        chosen = np.zeros(rows.size, dtype=bool)
        chosen[order[rank < most]] = True
        return chosen


def survey_grid(function: VectorFunction, dimension: int, side: int, threshold: float) -> Survey:
    """A grid with ``side`` points along every coordinate, finer where neighbouring values show that it does not resolve
    the function, and where that may hide more than ``threshold``.

    Around every such point a block of half the spacing is laid, and so on, all blocks of a level in one batch.
    """
    spacing = 1.0 / max(1, side - 1)
    level = _evaluate_level(function, np.zeros((1, dimension)), side, spacing)
    worth, surveys = max(threshold, WORTHWHILE_SHARE * float(level.values.max(initial=0.0))), [level.survey()]
    blocks = side**dimension // POINTS_PER_BLOCK**dimension
    for halved in range(DEPTH if dimension and side > BLOCK_SIDE else 0):
        centres = level.unresolved(worth, max(1, blocks >> halved))
        if not len(centres):
            break
        corners = np.clip(centres - spacing, 0.0, 1.0 - 2.0 * spacing)
        spacing /= 2.0
        level = _evaluate_level(function, np.unique(corners, axis=0), BLOCK_SIDE, spacing)
        surveys.append(level.survey())
    return _join_surveys(surveys)


def survey_scattered(points: Array, values: Array, known: Survey | None = None) -> Survey:
    """The local maxima of scattered points ``(k, d)`` with values ``(k, r)``, beside those ``known``: those that
    neither neighbour exceeds for one coordinate, and none of the ``2 d`` nearest points for more."""
    all_points = points if known is None else np.concatenate([points, known.points])
    all_values = values if known is None else np.concatenate([values, known.values])
    count, dimension = points.shape
    if len(all_points) == 1:
        neighbours, distance = np.zeros((1, 1), dtype=int), np.ones((1, 1))
    elif dimension == 1:
        order = np.argsort(all_points[:, 0], kind="stable")
        rank = np.empty(order.size, dtype=int)
        rank[order] = np.arange(order.size)
        sides = rank[:count, np.newaxis] + np.array([-1, 1])
        neighbours = order[np.where(sides < 0, 1, np.where(sides >= order.size, order.size - 2, sides))]
        distance = np.abs(all_points[neighbours, 0] - points)
    else:
        from scipy.spatial import cKDTree

        k = min(2 * dimension + 1, len(all_points))
        distance, neighbours = cKDTree(all_points).query(points, k=k, p=np.inf)
    neighbour_values = all_values[neighbours]
    is_peak = (values >= neighbour_values.max(axis=1)) & (values > neighbour_values.min(axis=1))
    is_peak[values.argmax(axis=0), np.arange(values.shape[1])] = True
    where, row = np.nonzero(is_peak)
    height = values[where, row]
    radius = np.clip(distance.max(axis=1), 1e-9, 0.5)[where]
    peaks = Candidates(points[where], row, height, radius)
    with np.errstate(invalid="ignore"):
        rise = np.nan_to_num(height - neighbour_values.min(axis=1)[where, row], nan=0.0, posinf=0.0)
    return Survey(points, values, peaks, height, height + rise)


@dataclass(frozen=True, eq=False)
class _Level:
    """Blocks of points ``(p, s, ..., s, d)`` of one ``spacing``, and their values ``(p, s, ..., s, r)``."""

    points: Array
    values: Array
    spacing: float

    @property
    def axes(self) -> range:
        return range(1, self.points.ndim - 1)

    def survey(self) -> Survey:
        """Return the points of the level, and its peaks: the points that no neighbour within their block exceeds.

        A point at an end of its block is no peak unless it is at an end of the unit box too, since a neighbour is
        unknown. A single block always has a peak for every row, its highest point.
        """
        values, rows = self.values, self.values.shape[-1]
        highest, lowest, promise, reach = values, values, values.copy(), values.copy()
        is_complete = np.ones(self.points.shape[:-1], dtype=bool)
        for axis in self.axes:
            highest = _find_extremes(highest, axis, np.maximum)
            lowest = _find_extremes(lowest, axis, np.minimum)
            promise += _estimate_peak_rise(values, axis)
            reach += _find_extremes(np.abs(_compute_second_difference(values, axis)), axis, np.maximum)
            ends = np.zeros(values.shape[axis], dtype=bool)
            ends[[0, -1]] = True
            coordinate = self.points[..., axis - 1]
            shape = [-1 if k == axis else 1 for k in range(coordinate.ndim)]
            is_complete &= ~ends.reshape(shape) | (coordinate <= 0.0) | (coordinate >= 1.0)
        is_peak = is_complete[..., np.newaxis] & (values >= highest) & (values > lowest)
        flat = values.reshape(-1, rows)
        is_peak = is_peak.reshape(flat.shape)
        if len(values) == 1:  # where nothing rises above anything, still something to return
            is_peak[flat.argmax(axis=0), np.arange(rows)] = True
        where, row = np.nonzero(is_peak)
        points = self.points.reshape(len(flat), -1) if self.axes else np.zeros((1, 0))
        peaks = Candidates(points[where], row, flat[where, row], np.full(where.size, self.spacing))
        estimates = promise.reshape(flat.shape)[where, row], reach.reshape(flat.shape)[where, row]
        return Survey(points, flat, peaks, *estimates)

    def unresolved(self, worth: float, most: int) -> Array:
        """Return at most ``most`` points ``(c, d)`` around which the level does not resolve the values, the highest
        first.

        Around such a point, neighbouring second differences differ by about as much as their size, so that a maximum
        above ``worth`` may hide there.
        """
        values = self.values
        reach, is_coarse = values.copy(), np.zeros(values.shape, dtype=bool)
        for axis in self.axes:
            bend = _compute_second_difference(values, axis)
            size = _find_extremes(np.abs(bend), axis, np.maximum)
            change = np.zeros_like(bend)
            aligned, step = np.moveaxis(change, axis, 0), np.abs(np.diff(np.moveaxis(bend, axis, 0)[1:-1], axis=0))
            aligned[1:-2] = step
            aligned[2:-1] = np.maximum(aligned[2:-1], step)
            aligned[0], aligned[-1] = aligned[1], aligned[-2]
            reach += size
            is_coarse |= (change > MAX_DIFFERENCE_CHANGE * size) & (change > worth)
        high = np.where(is_coarse & (reach > worth), reach, -np.inf).max(axis=-1).ravel()
        order = np.argsort(-high, kind="stable")[: min(most, int((high > -np.inf).sum()))]
        return self.points.reshape(high.size, -1)[order]


def _evaluate_level(function: VectorFunction, corners: Array, side: int, spacing: float) -> _Level:
    """The values of blocks with these lower corners ``(p, d)``; points of several blocks are evaluated once."""
    count, dimension = corners.shape
    offsets = np.array(list(product(range(side), repeat=dimension)), dtype=float)
    flat = move_into_box(corners[:, np.newaxis] + spacing * offsets).reshape(count * len(offsets), dimension)
    if count == 1:
        values = function(flat)
    else:
        unique_points, inverse = np.unique(flat, axis=0, return_inverse=True)
        values = function(unique_points)[inverse.reshape(-1)]
    shape = (count, *[side] * dimension)
    return _Level(flat.reshape(*shape, dimension), values.reshape(*shape, -1), spacing)


def _join_surveys(surveys: Sequence[Survey]) -> Survey:
    joined = surveys[0]
    for survey in surveys[1:]:
        joined = joined.join(survey)
    return joined


def _find_extremes(values: Array, axis: int, of: Callable[..., Array]) -> Array:
    """The maximum, or the minimum, of every entry and its two neighbours along an axis."""
    extremes = np.moveaxis(values.copy(), axis, 0)
    original = np.moveaxis(values, axis, 0)
    of(extremes[1:], original[:-1], out=extremes[1:])
    of(extremes[:-1], original[1:], out=extremes[:-1])
    return np.moveaxis(extremes, 0, axis)


def _compute_second_difference(values: Array, axis: int) -> Array:
    """The second difference at every entry along an axis; 0 at both ends, and where it is no number."""
    aligned = np.moveaxis(values, axis, 0)
    bend = np.zeros_like(aligned)
    with np.errstate(invalid="ignore", over="ignore"):
        inner = aligned[2:] - 2 * aligned[1:-1] + aligned[:-2]
    bend[1:-1] = np.where(np.isfinite(inner), inner, 0.0)
    return np.moveaxis(bend, 0, axis)


def _estimate_peak_rise(values: Array, axis: int) -> Array:
    """Return the rise of the parabola through three neighbours above the middle one, at most as far as both neighbours
    together lie below it."""
    aligned = np.moveaxis(values, axis, 0)
    rise = np.zeros_like(aligned)
    with np.errstate(invalid="ignore", divide="ignore", over="ignore"):
        bend = 2 * aligned[1:-1] - aligned[:-2] - aligned[2:]
        peak = (aligned[2:] - aligned[:-2]) ** 2 / (8 * bend)
        rise[1:-1] = np.where((bend > 0) & np.isfinite(peak), np.minimum(peak, bend), 0.0)
    return np.moveaxis(rise, 0, axis)
