"""Movement of a system in a plane: its places, the limits on them, and the section that is worth showing."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from sparserob_core.sip.convex_set import Array

PLANE_MARGIN = 0.08  # of the larger side of what is drawn, around it; ten times as much leaves no picture
SLIM = 0.25  # of the larger side, the smaller one at least: of a tenth nothing is seen, at 1 all is a square
# Of coordinates, what is rounding: with 0 a goal that is a point is empty, 1e9 times as much is seen
COORDINATE_ROUNDING = 1e-12
# of the larger side: a goal that is smaller is shown larger, too; at 0.5 all are, at 0.005 a dot stays one
MAX_ENLARGED = 0.05
# Sides of the goal that are shown of what is around it; of one no path is seen, of thirty no goal
GOAL_SURROUNDINGS = 3.0
# Of the larger side: a wall that is nearer to the path is within the view; of all walls one sees no path
VIEW_DISTANCE = 0.3


@dataclass(frozen=True, eq=False, kw_only=True)
class Limit:
    """Constraint on the place alone, called ``name``: ``normals (r, 2) y <= bounds (k, r)`` at ``times (k,)``.

    Between the times the bounds go in straight lines; a limit of the final place (``is_final``) has one time.
    ``is_wall``: the constraint holds all the time, and stands still.
    """

    name: str
    normals: Array
    times: Array
    bounds: Array
    is_final: bool = False
    is_wall: bool = False

    @property
    def moves(self) -> bool:
        """True where a bound changes with time."""
        return bool((self.bounds != self.bounds[0]).any())

    def allowed(self, frame: Array) -> Array:
        """Return the part of a convex polygon ``(k, 2)`` that satisfies the constraint at its last time."""
        return clipped(frame, self.normals, self.bounds[-1])

    def beyond(self, frame: Array) -> list[Array]:
        """Return, for each side of the constraint, the part of a convex polygon ``(k, 2)`` that violates it at the last
        time.

        Empty parts are left out.
        """
        sides = zip(-self.normals, -self.bounds[-1], strict=True)
        return [polygon for normal, bound in sides if len(polygon := clipped(frame, normal[None], bound[None]))]


@dataclass(frozen=True, eq=False, kw_only=True)
class Plane:
    """Plane in which a system moves, with its places and their ``limits``.

    The two ``states`` are the place of the system, drawn to the right and upwards. ``places (T, q, 2)`` holds a polygon
    for every time, which contains all places of the worst case.
    """

    states: tuple[int, int]
    places: Array
    limits: tuple[Limit, ...] = ()

    @property
    def walls(self) -> list[Limit]:
        """Limits that hold all the time and stand still."""
        return [limit for limit in self.limits if limit.is_wall]

    def outlined(self, frame: Array) -> Iterator[tuple[Limit, Array]]:
        """The other limits, each with what of a convex polygon ``(k, 2)`` is within it; nothing of one that moves."""
        for limit in self.limits:
            if not limit.is_wall:
                yield limit, np.empty((0, 2)) if limit.moves else limit.allowed(frame)

    def view(self, path: Array) -> tuple[Array, Array]:
        """The lower and the upper corner of what is shown: a ``path (T, 2)``, its places, the goal, and walls that are
        near."""
        points = np.vstack([path, self.places.reshape(-1, 2)])
        size = float(np.ptp(points, axis=0).max()) or 1.0
        low, high = points.min(axis=0) - size, points.max(axis=0) + size
        wide = framed(low, high)
        shown = [points]
        for limit in self.limits:
            if limit.is_final:
                goal = limit.allowed(wide)
                shown.append(goal[((goal > low) & (goal < high)).all(axis=1)])  # no corner of a side that is free
                continue
            for normal, bounds in zip(limit.normals, limit.bounds.T, strict=True):
                gaps = (bounds.min() - path @ normal) / (normal @ normal)
                nearest = int(np.abs(gaps).argmin())
                if abs(gaps[nearest]) * np.linalg.norm(normal) <= VIEW_DISTANCE * size:
                    shown.append((path[nearest] + gaps[nearest] * normal)[None])
        points = np.vstack(shown)
        low, high = points.min(axis=0), points.max(axis=0)
        size = float((high - low).max()) or 1.0
        missing = np.maximum(SLIM * size - (high - low), 0.0) / 2 + PLANE_MARGIN * size
        return low - missing, high + missing

    def goal(self, path: Array) -> tuple[Array, Array] | None:
        """The lower and the upper corner of what is around the goal, where that is a small part of the `view` of a
        ``path (T, 2)``; ``None`` where it is not, or has no sides."""
        low, high = self.view(path)
        goals = [limit for limit in self.limits if limit.is_final]
        allowed = framed(low, high)
        for limit in goals:
            allowed = limit.allowed(allowed)
        if not goals or not len(allowed):
            return None
        side = float(np.ptp(allowed, axis=0).max())
        if not COORDINATE_ROUNDING * float(np.abs(allowed).max()) < side <= MAX_ENLARGED * float((high - low).max()):
            return None
        middle, half = (
            (allowed.min(axis=0) + allowed.max(axis=0)) / 2,
            GOAL_SURROUNDINGS * side / 2 * np.array([1.0, 0.5]),
        )
        return middle - half, middle + half


def framed(low: Array, high: Array) -> Array:
    """A rectangle as a polygon ``(4, 2)``, from its lower and its upper corner."""
    return np.array([low, [high[0], low[1]], high, [low[0], high[1]]])


def clipped(polygon: Array, normals: Array, bounds: Array) -> Array:
    """A convex polygon ``(k, 2)`` without what is beyond one of the lines ``normals (r, 2) x = bounds (r,)``
    (Sutherland and Hodgman 1974)."""
    kept = np.asarray(polygon, dtype=float)
    for normal, bound in zip(normals, bounds, strict=True):
        heights, corners = kept @ normal - bound, []
        heights[np.abs(heights) <= COORDINATE_ROUNDING * (np.abs(kept) @ np.abs(normal))] = (
            0.0  # of a side that was cut before
        )
        for k in range(len(kept)):
            a, b = heights[k - 1], heights[k]
            if (a > 0.0) != (b > 0.0):
                corners.append(kept[k - 1] + (kept[k] - kept[k - 1]) * a / (a - b))
            if b <= 0.0:
                corners.append(kept[k])
        kept = np.array(corners).reshape(-1, 2)
    return kept
