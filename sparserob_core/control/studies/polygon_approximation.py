"""A convex set of the plane between two polygons, from its support function: where they differ most, ask again (Rote
1992)."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import final

import numpy as np

from sparserob_core.sip.convex_set import Array

AXES = np.array([[1.0, 0.0], [0.0, 1.0], [-1.0, 0.0], [0.0, -1.0]])
SAME_DIRECTION_SINE = 1e-9  # sine of an angle between directions that are one
SAME_POINT_SHARE = 1e-12  # of the box, a distance that is rounding


@final
@dataclass(frozen=True, eq=False)
class SupportBound:
    """Support of a planar set in one direction: an upper bound, and the best point that was found.

    Parameters
    ----------
    direction : ndarray, shape (2,)
        The direction.
    bound : float
        Upper bound: the set lies in ``direction'z <= bound``.
    point : ndarray, shape (2,), optional
        Best point that was found.
    proven : bool, default False
        Whether the point is certainly in the set.
    """

    direction: Array
    bound: float
    point: Array | None = None
    proven: bool = False


def sandwich(
    ask: Callable[[Array], SupportBound], known: Sequence[SupportBound], count: int, gap: float
) -> list[SupportBound]:
    """Supports of a planar set in up to ``count`` directions, in the order of their angles, fewer when the polygons
    differ by a share of at most ``gap`` in area.

    ``known`` are supports in at least the four axis directions. Between neighbouring directions with points ``v``,
    ``w`` the boundary lies in the triangle of ``v``, ``w`` and the vertex of the outer polygon; the largest triangle is
    cut by the direction normal to ``w - v``. Source: G. Rote (1992), The convergence rate of the sandwich algorithm for
    approximating convex functions.
    """
    supports = sorted(known, key=_compute_angle)
    while len(supports) < count:
        wedges = [
            _measure_wedge(support, neighbour)
            for support, neighbour in zip(supports, [*supports[1:], supports[0]], strict=True)
        ]
        area, direction = max(wedges, key=lambda wedge: wedge[0])
        total = polygon_area(outer_polygon(supports))
        if area <= 0.0 or direction is None or sum(wedge[0] for wedge in wedges) <= gap * total:
            break
        supports = sorted([*supports, ask(direction)], key=_compute_angle)
    return supports


def inner_polygon(supports: Sequence[SupportBound]) -> Array:
    """The convex hull of the proven points, its vertices ``(k, 2)`` anticlockwise; one or two points where it has no
    interior."""
    points = [s.point for s in supports if s.proven and s.point is not None]
    return convex_hull(np.array(points).reshape(-1, 2))


def outer_polygon(supports: Sequence[SupportBound]) -> Array:
    """The intersection of the half-planes, its vertices ``(k, 2)`` anticlockwise; the four axis directions must be
    among them."""
    axes = [min(s.bound for s in supports if float(s.direction @ axis) > 1.0 - SAME_DIRECTION_SINE) for axis in AXES]
    polygon = np.array([[axes[0], -axes[3]], [axes[0], axes[1]], [-axes[2], axes[1]], [-axes[2], -axes[3]]])
    for support in supports:
        polygon = _clip_polygon(polygon, support.direction, support.bound)
    return polygon


def convex_hull(points: Array) -> Array:
    """The vertices ``(k, 2)`` of the convex hull of ``(n, 2)``, anticlockwise (Andrew 1979)."""
    ordered = np.unique(points, axis=0)
    if ordered.shape[0] < 3:
        return ordered
    lower, upper = _build_chain(ordered), _build_chain(ordered[::-1])
    return np.array(lower[:-1] + upper[:-1])


def polygon_area(vertices: Array) -> float:
    """The area of a polygon ``(k, 2)``, positive when anticlockwise."""
    if vertices.shape[0] < 3:
        return 0.0
    after = np.roll(vertices, -1, axis=0)
    return float(np.sum(vertices[:, 0] * after[:, 1] - after[:, 0] * vertices[:, 1]) / 2)


def inside(polygon: Array, points: Array) -> np.ndarray:
    """Return which of ``points (n, 2)`` lie in a convex polygon ``(k, 2)`` with interior, given anticlockwise."""
    edges = np.roll(polygon, -1, axis=0) - polygon
    offsets = points[:, None] - polygon
    return np.asarray((edges[:, 0] * offsets[..., 1] - edges[:, 1] * offsets[..., 0] >= 0.0).all(axis=1))


def _compute_angle(support: SupportBound) -> float:
    return float(np.arctan2(support.direction[1], support.direction[0]))


def _measure_wedge(one: SupportBound, other: SupportBound) -> tuple[float, Array | None]:
    """The area in which the boundary between two neighbouring directions is still to be found, and the direction that
    would cut it."""
    if one.point is None or other.point is None:
        return 0.0, None
    sine = _cross(one.direction, other.direction)
    if sine < SAME_DIRECTION_SINE:
        return 0.0, None
    corner = (
        np.array(
            [
                one.bound * other.direction[1] - other.bound * one.direction[1],
                other.bound * one.direction[0] - one.bound * other.direction[0],
            ]
        )
        / sine
    )
    chord = other.point - one.point
    length = float(np.linalg.norm(chord))
    normal = np.array([chord[1], -chord[0]]) / length if length > SAME_POINT_SHARE else _compute_bisector(one, other)
    within = (
        _cross(one.direction, normal) > SAME_DIRECTION_SINE and _cross(normal, other.direction) > SAME_DIRECTION_SINE
    )
    area = abs(_cross(corner - one.point, chord)) / 2
    return (area, normal) if within else (0.0, None)


def _compute_bisector(one: SupportBound, other: SupportBound) -> Array:
    middle = one.direction + other.direction
    return np.asarray(middle / np.linalg.norm(middle))


def _clip_polygon(polygon: Array, direction: Array, bound: float) -> Array:
    """The part of a convex polygon in ``direction'z <= bound`` (Sutherland and Hodgman 1974)."""
    if not polygon.shape[0]:
        return polygon
    heights = polygon @ direction - bound
    kept: list[Array] = []
    for k in range(heights.size):
        previous, current = heights[k - 1], heights[k]
        if (previous > 0.0) != (current > 0.0):
            kept.append(polygon[k - 1] + (polygon[k] - polygon[k - 1]) * (previous / (previous - current)))
        if current <= 0.0:
            kept.append(polygon[k])
    return np.array(kept).reshape(-1, 2)


def _build_chain(points: Array) -> list[Array]:
    chain: list[Array] = []
    for point in points:
        while len(chain) > 1 and _cross(chain[-1] - chain[-2], point - chain[-2]) <= 0.0:
            chain.pop()
        chain.append(point)
    return chain


def _cross(a: Array, b: Array) -> float:
    return float(a[0] * b[1] - a[1] * b[0])
