"""Many local maxima at once: a trust region with finite differences, vectorised over the points that it improves."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from itertools import combinations, product
from typing import Any, TypeAlias

import numpy as np
import numpy.typing as npt

from sparserob_core.sip.convex_set import Array

Rows: TypeAlias = npt.NDArray[Any]
Truths: TypeAlias = npt.NDArray[np.bool_]
VectorFunction: TypeAlias = Callable[[Array], Array]

MAX_REFINEMENT_STEPS = 80  # of a climb to a maximum
MAX_STEP_RADII = 2.0
"""Longest step, in radii and per coordinate."""
FARTHER = 2.0
"""Of its radius, that of the next step of who has moved as far as it lets: with 1 a crest is crept along for ever."""
PEAK_ACCURACY = 1e-14
HOPELESS = 8.0
"""Times the variation of a model by which its maximum may lie above its best point. With an eighth of it narrow peaks
are given up; with ten times as much nothing is."""
MAX_DIMENSION_WITH_CROSS_TERMS = 8
# Where `surround` measures curvatures, and how far at most it goes, in sides of the unit box. With a tenth of the
# first, curvatures of rows that are nearly straight are rounding; ten times as much spans several peaks. A quarter of
# the second takes more rounds where rows are straight; with four times as much all points are outside of the box.
MEASURED, FARTHEST = 1e-3, 0.25
# Of the distance from a maximum to where its row is kept, where the points around it are: with a fifth of it they say
# little that the maximum does not, and with twice as much they are not violated.
SURROUNDING = 0.5


@dataclass(frozen=True, eq=False)
class Candidates:
    """Points ``(c, d)`` of the unit box, the row ``(c,)`` that each is about, its value ``(c,)``, and a radius
    ``(c,)``."""

    points: Array
    rows: Rows
    values: Array
    radius: Array

    def take(self, which: npt.NDArray[np.intp] | Truths) -> Candidates:
        """Return the candidates at the given positions, or where the given mask is true."""
        return Candidates(self.points[which], self.rows[which], self.values[which], self.radius[which])

    def join(self, other: Candidates) -> Candidates:
        """Return these candidates followed by the ``other`` candidates."""
        return Candidates(
            np.concatenate([self.points, other.points]),
            np.concatenate([self.rows, other.rows]),
            np.concatenate([self.values, other.values]),
            np.concatenate([self.radius, other.radius]),
        )


@dataclass(frozen=True, eq=False)
class _Model:
    """Quadratic models around ``middle (a, d)`` in units of the radius: value ``(a,)``, gradient ``(a, d)``, Hessian
    ``(a, d, d)``."""

    middle: Array
    value: Array
    gradient: Array
    hessian: Array
    spread: Array

    def at(self, steps: Array) -> Array:
        curved = np.einsum("ai,aij,aj->a", steps, self.hessian, steps)
        return np.asarray(self.value + np.einsum("ai,ai->a", self.gradient, steps) + curved / 2, dtype=float)


def refine(function: VectorFunction, candidates: Candidates, least: float = -np.inf) -> Candidates:
    """Climb from every candidate to a local maximum of its row of ``function`` (points ``(k, d)`` of the unit box to
    ``(k, r)``).

    A quadratic model from finite differences is maximised over a trust region that stays inside the box, whose faces
    are met exactly. The model is believed where it predicts and where its curvature does not depend on the radius;
    elsewhere (kinks) the radius shrinks to a quarter around the best point. A candidate is given up whose values show
    that it does not come near ``least``. Values never get worse. A smooth row ends within about 1e-14 of its local
    maximum, a kinked one within 1e-13, both relative to ``max(1, |value|)``.
    """
    count, dimension = candidates.points.shape
    if dimension == 0 or count == 0:
        return candidates
    offsets = _build_stencil(dimension)
    curvature = np.full((count, dimension), np.nan)
    active = np.arange(count)
    points, values, radius = candidates.points.copy(), candidates.values.copy(), candidates.radius.copy()
    for _ in range(MAX_REFINEMENT_STEPS):
        now = Candidates(points[active], candidates.rows[active], values[active], radius[active])
        better, curved, is_done = _take_step(function, now, offsets, curvature[active], least)
        points[active], values[active], radius[active], curvature[active] = (
            better.points,
            better.values,
            better.radius,
            curved,
        )
        active = active[~is_done]
        if active.size == 0:
            break
    return replace(candidates, points=points, values=values, radius=radius)


def surround(function: VectorFunction, maxima: Candidates) -> Candidates:
    """Return points on both sides of every maximum ``(c, d)`` of positive value, along the axes of its curvature, where
    about three quarters of its value are left."""
    dimension = maxima.points.shape[1]
    offsets = _build_stencil(dimension)
    middle = np.clip(maxima.points, MEASURED, 1.0 - MEASURED)
    values = _evaluate_points(function, move_into_box(middle[:, np.newaxis] + MEASURED * offsets), maxima.rows)
    curvature, axes = np.linalg.eigh(_fit_models(middle, values, offsets).hessian / MEASURED**2)
    fall = 2.0 * SURROUNDING**2 * maxima.values[:, np.newaxis]
    steps = np.sqrt(fall / np.maximum(-curvature, fall / FARTHEST**2))[:, np.newaxis] * axes  # an axis in each column
    middle = np.repeat(maxima.points, 2 * dimension, axis=0)
    points = move_into_box(middle + np.concatenate([steps, -steps], axis=2).transpose(0, 2, 1).reshape(-1, dimension))
    rows = np.repeat(maxima.rows, 2 * dimension)
    values = _evaluate_points(function, points[:, np.newaxis], rows)[:, 0]
    return Candidates(points, rows, values, np.full(rows.size, MEASURED))


def _take_step(
    function: VectorFunction, now: Candidates, offsets: Array, curvature: Array, least: float
) -> tuple[Candidates, Array, Truths]:
    radius = np.minimum(now.radius, 0.5)[:, np.newaxis]
    middle = np.clip(now.points, radius, 1 - radius)
    stencil = move_into_box(middle[:, np.newaxis] + radius[:, np.newaxis] * offsets)
    stencil_values = _evaluate_points(function, stencil, now.rows)
    model = _fit_models(middle, stencil_values, offsets)
    steps = _maximise_models(
        model, np.maximum(-MAX_STEP_RADII, -middle / radius), np.minimum(MAX_STEP_RADII, (1 - middle) / radius)
    )
    trial = move_into_box(middle + radius * steps)
    trial_values = _evaluate_points(function, trial[:, np.newaxis], now.rows)
    scale = np.maximum(1.0, np.abs(now.values))
    curved = np.einsum("aii->ai", model.hessian) / radius**2
    change = np.abs(np.nan_to_num(curved - curvature, nan=np.inf, posinf=np.inf)).max(axis=1) * radius[:, 0] ** 2
    is_smooth = (np.abs(trial_values[:, 0] - model.at(steps)) <= 0.05 * model.spread + PEAK_ACCURACY * scale) & (
        change <= 0.1 * model.spread
    )
    points, values = _keep_best(
        now,
        np.concatenate([stencil, trial[:, np.newaxis]], axis=1),
        np.concatenate([stencil_values, trial_values], axis=1),
    )
    moved_far = np.abs(points - now.points).max(axis=1) > 0.75 * radius[:, 0]
    shrink = np.where(moved_far, FARTHER, np.where(is_smooth, 0.125, 1.0 / 4))
    is_settled = (
        is_smooth & (model.at(steps) - values <= PEAK_ACCURACY * scale) & (values - now.values <= PEAK_ACCURACY * scale)
    )
    is_done = is_settled | (model.spread <= 10 * PEAK_ACCURACY * scale) | (radius[:, 0] < PEAK_ACCURACY)
    is_done |= values + HOPELESS * model.spread < least
    return Candidates(points, now.rows, values, radius[:, 0] * shrink), curved, is_done


def _build_stencil(dimension: int) -> Array:
    """The middle, one step either way along every coordinate, and the four corners of every pair of coordinates."""
    unit = np.eye(dimension)
    offsets = [np.zeros(dimension), *unit, *-unit]
    if dimension <= MAX_DIMENSION_WITH_CROSS_TERMS:
        offsets += [
            a * unit[i] + b * unit[j]
            for i, j in combinations(range(dimension), 2)
            for a, b in product((1, -1), repeat=2)
        ]
    return np.array(offsets)


def move_into_box(points: Array) -> Array:
    """Into the unit box; what is within rounding of a face lies on it."""
    points = np.where(points < 1e-15, 0.0, points)
    return np.where(points > 1 - 1e-15, 1.0, points)


def _evaluate_points(function: VectorFunction, points: Array, rows: Rows) -> Array:
    count, size, dimension = points.shape
    values = function(points.reshape(count * size, dimension)).reshape(count, size, -1)
    return np.take_along_axis(values, rows[:, np.newaxis, np.newaxis], axis=2)[:, :, 0]


def _fit_models(middle: Array, seen: Array, offsets: Array) -> _Model:
    count, dimension = middle.shape
    finite = np.asarray(np.isfinite(seen).all(axis=1))
    safe = np.where(finite[:, np.newaxis], seen, 0.0)
    ahead, behind, centre = safe[:, 1 : 1 + dimension], safe[:, 1 + dimension : 1 + 2 * dimension], safe[:, :1]
    hessian = np.zeros((count, dimension, dimension))
    hessian[:, range(dimension), range(dimension)] = ahead + behind - 2 * centre
    corners = (
        safe[:, 1 + 2 * dimension :].reshape(count, -1, 4)
        if len(offsets) > 1 + 2 * dimension
        else np.empty((count, 0, 4))
    )
    for (i, j), four in zip(combinations(range(dimension), 2), np.moveaxis(corners, 1, 0), strict=False):
        hessian[:, i, j] = hessian[:, j, i] = (four[:, 0] - four[:, 1] - four[:, 2] + four[:, 3]) / 4
    spread = np.where(finite, safe.max(axis=1) - safe.min(axis=1), np.inf)
    return _Model(middle, centre[:, 0], (ahead - behind) / 2, hessian, spread)


def _maximise_models(model: _Model, lower: Array, upper: Array) -> Array:
    """Maximise the models over boxes: a Newton step with the curvature made concave, then coordinate ascent, exact for
    one coordinate."""
    dimension = lower.shape[1]
    steps = np.zeros_like(lower)
    if dimension > 1:
        eigenvalues, vectors = np.linalg.eigh(model.hessian)
        stiff = np.maximum(np.abs(eigenvalues), 1e-12 * np.abs(eigenvalues).max(axis=1, keepdims=True) + 1e-300)
        along = np.einsum("aij,ai->aj", vectors, model.gradient) / stiff
        steps = np.clip(np.einsum("aij,aj->ai", vectors, np.clip(along, -1e6, 1e6)), lower, upper)
    for i in list(range(dimension)) * (1 if dimension == 1 else 4):
        bend, low, high = model.hessian[:, i, i], lower[:, i], upper[:, i]
        slope = model.gradient[:, i] + np.einsum("aj,aj->a", model.hessian[:, i], steps) - bend * steps[:, i]
        ends = np.where((high - low) * (slope + bend / 2 * (high + low)) >= 0, high, low)
        concave = bend < -1e-300
        inner = np.clip(-slope / np.where(concave, bend, -1.0), low, high)
        steps[:, i] = np.where(concave, inner, np.where((slope == 0) & (bend == 0), steps[:, i], ends))
    return steps


def _keep_best(now: Candidates, points: Array, values: Array) -> tuple[Array, Array]:
    top = np.argmax(values, axis=1)
    indices = np.arange(len(top))
    better = values[indices, top] > now.values
    return np.where(better[:, np.newaxis], points[indices, top], now.points), np.where(
        better, values[indices, top], now.values
    )
