"""Local maxima of sampled functions, and the vertex of a parabola between the samples."""

from __future__ import annotations

from collections.abc import Callable
from itertools import product

import numpy as np

from sparserob_core.sip.convex_set import Array, ConvexSet

SMALLEST_STEP_SHARE = 1e-6  # of the first step: a step that is not made smaller any more
CLIMBED_MAXIMA = 16  # maxima along time at which a curved set is left, that are climbed from
NEARER, LOOKS = 8, 2  # the others are narrowed down to so many times nearer, and so often
UNSURE = 4.0  # by how much the rise that a parabola predicts may be wrong
SAME_FOUND_DISTANCE = 1e-6  # found maxima that are one, in times and on the cube of directions
# Indices of a curved set that are found at once, and those told where nothing is violated. With ten times fewer of the
# first, rounds grow with the length of a wall that is ridden; with ten times more, there are more than help.
MAX_RETURNED, FEWEST_RETURNED = 64, 8
DIRECTIONS_PER_TIME = 4  # directions at a time in which a curved set may be left
# Of them and of times, from how many directions are climbed to. With ten times fewer, a violation beside a wall that is
# ridden for long is left to the proof, which meets one a round.
MAX_CLIMBS = 2048
MIN_GAUGE_SHORTFALL = 0.02  # of the way out of a set, how near its wall a sample must be to be looked at
MAX_CLIMB_STEPS = 120  # steps at most
MIN_STEP_GAIN = 0.002  # a step that gains less than this share of the value is followed by a smaller one
# multiples of the last moves that are tried besides, to follow a ridge (Hooke and Jeeves 1961)
AGAIN = np.array([[1.0], [3.0]])
MAX_GRADIENT_STEPS = 6  # to points where a gradient is highest on a set, at most
SHARES = np.array([1.0, 0.5, 0.2, 0.05])  # of such a step that are tried
LEAST_DIVISOR = 1e-300  # instead of nothing to divide by
INWARD, DIFFERENCE = 1e-3, 1e-7  # shares of the set: how far inside it differences are taken, and how large


def local_maxima(values: Array, lattice: tuple[int, ...], kept: int) -> np.ndarray:
    """Return positions ``(k, 3)`` in ``values (v, r, times)`` of the largest local maxima, at most ``kept`` per row.

    ``v`` runs over a tensor lattice of shape ``lattice``; neighbours are those along its axes and in time.
    """
    v, r, times = values.shape
    tensor = values.reshape(*lattice, r, times)
    is_peak = np.ones(tensor.shape, dtype=bool)
    for axis in (*range(len(lattice)), tensor.ndim - 1):
        first = [slice(None)] * tensor.ndim
        last = [slice(None)] * tensor.ndim
        first[axis], last[axis] = slice(None, -1), slice(1, None)
        rise = tensor[tuple(last)] - tensor[tuple(first)]
        is_peak[tuple(first)] &= rise <= 0
        is_peak[tuple(last)] &= rise >= 0
    positions = np.array(is_peak.reshape(v, r, times).nonzero()).T
    heights = values[tuple(positions.T)]
    best: list[np.ndarray] = []
    for row in range(r):  # every row keeps its own maxima, so that none starves another
        is_in_row = positions[:, 1] == row
        best.append(positions[is_in_row][(-heights[is_in_row]).argsort(kind="stable")][:kept])
    return np.concatenate(best)


def along_spans(values: Array, maxima: np.ndarray, pieces: np.ndarray, kept: int) -> np.ndarray:
    """Return positions ``(k, 3)`` in ``values (v, r, times)`` along spans where a row is above 0 and none of its
    ``maxima (j, 3)`` is near. They are the highest sample of every piece of the control, thinned evenly to ``kept`` a
    row. ``pieces (times,)``: the numbers of the pieces.

    A state that leaves a wall for good has one maximum, at the end. Imposed there alone, the wall would be left a
    piece later in the next round, and rounds would grow with its length.
    """
    heights = values.max(axis=0)
    positions = [np.zeros((0, 3), dtype=int)]
    for row in np.flatnonzero((heights > 0.0).any(axis=1)):
        height = heights[row]
        near_pieces = pieces[maxima[maxima[:, 1] == row, 2]]
        samples = np.flatnonzero((height > 0.0) & ~np.isin(pieces, [near_pieces - 1, near_pieces, near_pieces + 1]))
        samples = samples[np.lexsort((-height[samples], pieces[samples]))]
        samples = samples[np.unique(pieces[samples], return_index=True)[1]]
        samples = samples[np.unique(np.linspace(0, samples.size - 1, min(kept, samples.size)).astype(int))]
        positions.append(
            np.stack([values[:, row, samples].argmax(axis=0), np.full(samples.size, row), samples], axis=1)
        )
    return np.concatenate(positions)


def find_kink_neighbours(values: Array, times: Array, kinks: np.ndarray, kept: int) -> np.ndarray:
    """Return positions ``(k, 3)`` in ``values (v, r, times)`` next to ``kinks``, the places among ``times`` at which
    anything turns or jumps. At these positions the violation may rise above 0 between samples; there are at most
    ``kept`` before and ``kept`` behind kinks. A parabola across a kink does not see that, one on either side of it
    does."""
    positions = [np.zeros((0, 3), dtype=int)]
    for step in (-1, 1) if times.size > 2 else ():
        at = kinks[(kinks + 2 * step >= 0) & (kinks + 2 * step < times.size)]
        near_distance, far_distance = (np.abs(times[at + k * step] - times[at]) for k in (1, 2))
        base, next_, last = (values[:, :, at + k * step] for k in (0, 1, 2))
        rate = (next_ - base) / near_distance
        curvature = ((last - next_) / (far_distance - near_distance) - rate) / far_distance
        slope = rate - curvature * near_distance
        # The vertex is slope / (-2 curvature) away and slope^2 / (-4 curvature) higher, of which parabolas may be
        # wrong by 4.
        rises = (slope > 0.0) & (slope < -2.0 * curvature * far_distance) & (slope**2 >= curvature * base)
        v, r, t = rises.nonzero()
        order = np.argsort(-base[v, r, t], kind="stable")[:kept]
        positions.append(np.stack([v[order], r[order], at[t[order]] + step], axis=1))
    return np.concatenate(positions)


def turns(heights: Array, neighbours: np.ndarray, unit: float) -> tuple[np.ndarray, int]:
    """Return positions ``(k, 2)`` in ``heights (r, times)`` of local maxima over directions, at most
    `DIRECTIONS_PER_TIME` at a time, and how many of them are to be climbed from. These are the first ones: those that
    may be above 0 between the sampled directions, but at least `FEWEST_RETURNED` and at most `MAX_CLIMBS`. ``neighbours
    (r, j)``: the numbers of the directions that are neighbours of each.

    The worst case of a disturbance that has corners has several maxima: what lies between sampled directions may make
    any of them the largest.
    """
    highest, lowest = heights[neighbours[:, 0]], heights[neighbours[:, 0]]
    for neighbour in neighbours.T[1:]:  # one by one: in six dimensions they are hundreds
        neighbour_heights = heights[neighbour]
        np.maximum(highest, neighbour_heights, out=highest)
        np.minimum(lowest, neighbour_heights, out=lowest)
    is_peak = heights >= highest
    promise = np.where(is_peak, 2.0 * heights - lowest, -np.inf)
    order = np.argsort(-np.where(is_peak, heights, -np.inf), axis=0, kind="stable")[:DIRECTIONS_PER_TIME]
    rows, times = order.ravel(), np.tile(np.arange(heights.shape[1]), len(order))
    promised = promise[rows, times]
    first = np.argsort(-promised, kind="stable")
    first = first[: int(is_peak[rows, times].sum())]
    likely = int((promised[first] * unit > -MIN_GAUGE_SHORTFALL).sum())
    return np.stack([rows[first], times[first]], axis=1), min(MAX_CLIMBS, max(FEWEST_RETURNED, likely))


def highest_at(times: np.ndarray, heights: Array) -> np.ndarray:
    """Return the position of the highest of the candidates at each of the places ``times (k,)``, in the order of
    places."""
    order = np.lexsort((-heights, times))
    return order[np.unique(times[order], return_index=True)[1]]


def ridden(
    held: Array,
    heights: Array,
    pieces: np.ndarray,
    kinks: np.ndarray,
    turned: Callable[[Array], tuple[Array, Array]],
    climbed: Callable[[Array], tuple[Array, Array]],
) -> tuple[Array, Array]:
    """Return the indices at which a curved set is left, and the violations there, worst first.

    The largest maxima along time are ``climbed`` from. The others that may be violations are narrowed down along time
    by parabolas, whose points are ``turned``. Where there is no maximum near, one sample of each piece is taken.

    Parameters
    ----------
    held : ndarray, shape (n, j)
        Worst index at every sampled time; the first coordinate is the time.
    heights : ndarray, shape (n,)
        Violations at these indices.
    pieces : ndarray of int, shape (n,)
        Numbers of the pieces of the control that hold the times.
    kinks : ndarray of int
        Positions of the sampled times at which anything bends.
    turned : callable
        Function that improves indices at fixed times, and returns them with their violations.
    climbed : callable
        Function that improves indices in all coordinates, and returns them with their violations.

    Returns
    -------
    indices : ndarray, shape (k, j)
        Indices of the violations, at most `MAX_RETURNED`. The best `FEWEST_RETURNED` are returned even where nothing
        is violated.
    violations : ndarray, shape (k,)
        Violations, worst first; negative where there is a margin.
    """
    line, times = heights[None, None], held[:, 0]
    peaks = local_maxima(line, (1,), MAX_RETURNED)
    peaks = np.unique(np.vstack([peaks, find_kink_neighbours(line, times, kinks, MAX_RETURNED)]), axis=0)
    vertex_times, promised = vertices(line, peaks, times)
    promised = line[0, 0, peaks[:, 2]] + UNSURE * (promised - line[0, 0, peaks[:, 2]])
    spans = along_spans(line, peaks, pieces, MAX_RETURNED)[:, 2]
    points = held[peaks[:, 2]]
    points[:, 0] = vertex_times
    order = np.argsort(-promised, kind="stable")
    first, remaining = order[:CLIMBED_MAXIMA], order[CLIMBED_MAXIMA:]
    remaining = remaining[promised[remaining] > 0.0]
    sample_positions = np.concatenate([peaks[:, 2], spans])  # at a kink a parabola is no guide
    nearer = _move_to_vertices(points[remaining], float(np.diff(times).max(initial=0.0)), turned)
    groups = [climbed(points[first]), nearer, (held[sample_positions], heights[sample_positions])]
    indices, violations = np.vstack([group[0] for group in groups]), np.concatenate([group[1] for group in groups])
    order = _select_distinct(indices, violations)
    order = order[(violations[order] > 0.0) | (np.arange(order.size) < FEWEST_RETURNED)][:MAX_RETURNED]
    return indices[order], violations[order]


def _move_to_vertices(
    points: Array, spacing: float, turned: Callable[[Array], tuple[Array, Array]]
) -> tuple[Array, Array]:
    """Return points ``(k, j)`` moved along time to the vertices of parabolas through nearer and nearer ones,
    ``turned``."""
    if not points.size:
        return points, np.zeros(0)
    width = spacing / NEARER
    for _ in range(LOOKS):
        neighbours = points.repeat(3, axis=0)
        neighbours[:, 0] += np.tile(width * np.array([-1.0, 0.0, 1.0]), len(points))
        before, now, after = turned(neighbours)[1].reshape(-1, 3).T
        slope, curvature = (after - before) / 2, 2 * now - before - after
        share = slope / np.where(np.abs(slope) < curvature, curvature, np.maximum(np.abs(slope), LEAST_DIVISOR))
        points[:, 0] += width * share
        width /= NEARER
    return turned(points)


def _select_distinct(indices: Array, found: Array) -> np.ndarray:
    """Return positions of different maxima, highest first."""
    remaining, kept = np.argsort(-found, kind="stable"), []
    while remaining.size:
        kept.append(int(remaining[0]))
        remaining = remaining[(np.abs(indices[remaining] - indices[remaining[0]]) > SAME_FOUND_DISTANCE).any(axis=1)]
    return np.array(kept, dtype=int)


def vertices(values: Array, positions: np.ndarray, times: Array) -> tuple[Array, Array]:
    """Return the vertex of the parabola through every position's sample and the two beside it: its time ``(k,)`` and
    height ``(k,)``."""
    v, r, t = positions.T
    vertex_times, heights = times[t].copy(), values[v, r, t].copy()
    inner = (t > 0) & (t < times.size - 1)
    ti, vi, ri = t[inner], v[inner], r[inner]
    h1, h2 = times[ti] - times[ti - 1], times[ti + 1] - times[ti]
    d1 = (values[vi, ri, ti] - values[vi, ri, ti - 1]) / h1
    d2 = (values[vi, ri, ti + 1] - values[vi, ri, ti]) / h2
    curvature, slope = (d2 - d1) / (h1 + h2), (d1 * h2 + d2 * h1) / (h1 + h2)
    is_peak = curvature < 0
    shift = np.zeros(ti.size)
    shift[is_peak] = np.minimum(np.maximum(-slope[is_peak] / (2 * curvature[is_peak]), -h1[is_peak]), h2[is_peak])
    vertex_times[inner] += shift
    heights[inner] += slope * shift + curvature * shift**2
    return vertex_times, heights


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
    numbers = np.arange(points.shape[0])
    size, smallest = np.tile(radius, (points.shape[0], 1)), SMALLEST_STEP_SHARE * radius
    best, last = evaluate(points, numbers), np.zeros_like(points)
    for _ in range(MAX_CLIMB_STEPS):
        live = np.flatnonzero((size > smallest).any(axis=1))
        if not live.size:
            break
        steps = np.concatenate([size[live, None] * stencil, last[live, None] * AGAIN], axis=1)
        trials = project((points[live, None] + steps).reshape(-1, dimension)).reshape(steps.shape)
        values = evaluate(trials.reshape(-1, dimension), np.repeat(live, steps.shape[1])).reshape(trials.shape[:2])
        top = values.argmax(axis=1)
        value = values[np.arange(live.size), top]
        gain = value - best[live]
        is_better = gain > 0
        highest = trials[np.arange(live.size), top]
        last[live] = np.where(is_better[:, None], highest - points[live] + last[live] / 2, 0.0)
        points[live[is_better]] = highest[is_better]
        best[live[is_better]] = value[is_better]
        size[live[gain <= MIN_STEP_GAIN * np.abs(best[live])]] /= 3
    return points, best


def step_out(
    evaluate: Callable[[Array, np.ndarray], Array], points: Array, values: Array, convex: ConvexSet
) -> tuple[Array, Array]:
    """Step to where the gradient is highest on a set (Frank and Wolfe 1956), from points ``(k, D)`` whose
    coordinates but the first are in it.

    A climb that is drawn back to the set gets stuck short of its corners. ``evaluate`` as for `climb`; its differences
    are taken a little inside the set. Returns the points and their ``values (k,)``, none of which gets lower.
    """
    points, values, middle = points.copy(), values.copy(), convex.interior_point()
    axes = np.eye(middle.size)
    numbers, moves = np.arange(values.size), DIFFERENCE * convex.width(axes) * axes
    for _ in range(MAX_GRADIENT_STEPS):
        inner = np.repeat(points[:, None], 2 * middle.size, axis=1)
        inner[:, :, 1:] += INWARD * (middle - inner[:, :, 1:]) + np.vstack([moves, -moves])
        ahead, behind = np.split(
            evaluate(inner.reshape(-1, points.shape[1]), numbers.repeat(2 * middle.size)).reshape(values.size, -1),
            2,
            axis=1,
        )
        gradient = (ahead - behind) / np.maximum(np.diag(moves), LEAST_DIVISOR)
        trials = np.repeat(points[:, None], SHARES.size, axis=1)
        trials[:, :, 1:] += SHARES[:, None] * (convex.support_point(gradient)[:, None] - trials[:, :, 1:])
        trial_values = evaluate(trials.reshape(-1, points.shape[1]), numbers.repeat(SHARES.size)).reshape(
            values.size, -1
        )
        best = trial_values.argmax(axis=1)
        is_better = trial_values[numbers, best] > values
        if not is_better.any():
            break
        points[is_better], values[is_better] = trials[numbers, best][is_better], trial_values[numbers, best][is_better]
    return points, values
