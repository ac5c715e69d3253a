"""Local maxima of sampled functions, and the vertex of a parabola between the samples."""

from __future__ import annotations

from collections.abc import Callable
from itertools import product

import numpy as np

from sparserob_core.sip.convex_set import Array, ConvexSet

SMALLEST = 1e-6  # of the first step: a step that is not made smaller any more
MOVES = 120  # steps at most
ENOUGH = 0.002  # a step that gains less than this share of the value is followed by a smaller one
# multiples of the last moves that are tried besides, to follow a ridge (Hooke and Jeeves 1961)
AGAIN = np.array([[1.0], [3.0]])
STEPS = 6  # to points where a gradient is highest on a set, at most
SHARES = np.array([1.0, 0.5, 0.2, 0.05])  # of such a step that are tried
TINY = 1e-300  # instead of nothing to divide by
INWARD, DIFFERENCE = 1e-3, 1e-7  # shares of the set: how far inside it differences are taken, and how large


def local_maxima(values: Array, lattice: tuple[int, ...], kept: int) -> np.ndarray:
    """Positions ``(k, 3)`` in ``values (v, r, times)`` of the largest local maxima, at most ``kept`` per row.

    ``v`` runs over a tensor lattice of shape ``lattice``; neighbours are those along its axes and in time.
    """
    v, r, times = values.shape
    tensor = values.reshape(*lattice, r, times)
    peak = np.ones(tensor.shape, dtype=bool)
    for axis in (*range(len(lattice)), tensor.ndim - 1):
        first = [slice(None)] * tensor.ndim
        last = [slice(None)] * tensor.ndim
        first[axis], last[axis] = slice(None, -1), slice(1, None)
        ahead = tensor[tuple(last)] - tensor[tuple(first)]
        peak[tuple(first)] &= ahead <= 0
        peak[tuple(last)] &= ahead >= 0
    positions = np.array(peak.reshape(v, r, times).nonzero()).T
    heights = values[tuple(positions.T)]
    best: list[np.ndarray] = []
    for row in range(r):  # every row keeps its own maxima, so that none starves another
        mine = positions[:, 1] == row
        best.append(positions[mine][(-heights[mine]).argsort(kind="stable")][:kept])
    return np.concatenate(best)


def vertices(values: Array, positions: np.ndarray, times: Array) -> tuple[Array, Array]:
    """The vertex of the parabola through every position's sample and the two beside it: its time ``(k,)`` and height
    ``(k,)``."""
    v, r, t = positions.T
    moved, height = times[t].copy(), values[v, r, t].copy()
    inner = (t > 0) & (t < times.size - 1)
    ti, vi, ri = t[inner], v[inner], r[inner]
    h1, h2 = times[ti] - times[ti - 1], times[ti + 1] - times[ti]
    d1 = (values[vi, ri, ti] - values[vi, ri, ti - 1]) / h1
    d2 = (values[vi, ri, ti + 1] - values[vi, ri, ti]) / h2
    curvature, slope = (d2 - d1) / (h1 + h2), (d1 * h2 + d2 * h1) / (h1 + h2)
    bent = curvature < 0
    shift = np.zeros(ti.size)
    shift[bent] = np.minimum(np.maximum(-slope[bent] / (2 * curvature[bent]), -h1[bent]), h2[bent])
    moved[inner] += shift
    height[inner] += slope * shift + curvature * shift**2
    return moved, height


def climb(
    evaluate: Callable[[Array, np.ndarray], Array], points: Array, radius: Array, project: Callable[[Array], Array]
) -> tuple[Array, Array]:
    """Climb from points ``(k, D)`` on stencils that shrink from ``radius (D,)``, all points at once.

    ``evaluate(points (j, D), which (j,))`` gives the values of points that started as number ``which``; ``project``
    maps any point back into the domain. Returns the best points ``(k, D)`` and their values ``(k,)``.
    """
    dimension = points.shape[1]
    points, stencil = points.copy(), np.vstack([np.eye(dimension), -np.eye(dimension)])
    if dimension <= 3:
        stencil = np.array([step for step in product((-1.0, 0.0, 1.0), repeat=dimension) if any(step)])
    which = np.arange(points.shape[0])
    size, smallest = np.tile(radius, (points.shape[0], 1)), SMALLEST * radius
    best, last = evaluate(points, which), np.zeros_like(points)
    for _ in range(MOVES):
        live = np.flatnonzero((size > smallest).any(axis=1))
        if not live.size:
            break
        steps = np.concatenate([size[live, None] * stencil, last[live, None] * AGAIN], axis=1)
        around = project((points[live, None] + steps).reshape(-1, dimension)).reshape(steps.shape)
        found = evaluate(around.reshape(-1, dimension), np.repeat(live, steps.shape[1])).reshape(around.shape[:2])
        top = found.argmax(axis=1)
        value = found[np.arange(live.size), top]
        gain = value - best[live]
        better = gain > 0
        reached = around[np.arange(live.size), top]
        last[live] = np.where(better[:, None], reached - points[live] + last[live] / 2, 0.0)
        points[live[better]] = reached[better]
        best[live[better]] = value[better]
        size[live[gain <= ENOUGH * np.abs(best[live])]] /= 3
    return points, best


def step_out(
    evaluate: Callable[[Array, np.ndarray], Array], points: Array, values: Array, convex: ConvexSet
) -> tuple[Array, Array]:
    """Steps to where the gradient is highest on a set (Frank and Wolfe 1956), from points ``(k, D)`` whose coordinates
    but the first are in it.

    A climb that is drawn back to the set gets stuck short of its corners. ``evaluate`` as for `climb`; its differences
    are taken a little inside the set. Returns the points and their ``values (k,)``, none of which gets lower.
    """
    points, values, middle = points.copy(), values.copy(), convex.interior_point()
    axes = np.eye(middle.size)
    every, moves = np.arange(values.size), DIFFERENCE * (convex.support(axes) + convex.support(-axes)) * axes
    for _ in range(STEPS):
        inner = np.repeat(points[:, None], 2 * middle.size, axis=1)
        inner[:, :, 1:] += INWARD * (middle - inner[:, :, 1:]) + np.vstack([moves, -moves])
        ahead, behind = np.split(
            evaluate(inner.reshape(-1, points.shape[1]), every.repeat(2 * middle.size)).reshape(values.size, -1),
            2,
            axis=1,
        )
        gradient = (ahead - behind) / np.maximum(np.diag(moves), TINY)
        trials = np.repeat(points[:, None], SHARES.size, axis=1)
        trials[:, :, 1:] += SHARES[:, None] * (convex.support_point(gradient)[:, None] - trials[:, :, 1:])
        found = evaluate(trials.reshape(-1, points.shape[1]), every.repeat(SHARES.size)).reshape(values.size, -1)
        best = found.argmax(axis=1)
        better = found[every, best] > values
        if not better.any():
            break
        points[better], values[better] = trials[every, best][better], found[every, best][better]
    return points, values
