"""Polytopes of many shapes, as index sets of stated programs."""

from __future__ import annotations

from collections.abc import Mapping
from itertools import combinations
from typing import Any

import numpy as np

from sparserob_core.sip.expressions.index_sets import Region, read_index

POLYTOPES: dict[str, tuple[list[list[float]], list[float]]] = {
    "segment": ([[3], [-7]], [1, 0.5]),
    "triangle": ([[-1, 0], [0, -1], [1, 2]], [0, 0, 2]),
    "thirds": ([[-3, 1], [1, -7], [1, 3]], [0, 0.1, 1]),
    "hexagon": ([[1, 0], [-1, 0], [0, 1], [0, -1], [1, 1], [-1, -1]], [1, 1, 1, 1, 1.5, 1.5]),
    "tetrahedron": ([[-1, 0, 0], [0, -1, 0], [0, 0, -1], [1, 1, 1]], [0, 0, 0, 1]),
    "pyramid": ([[1, 0, 1], [-1, 0, 1], [0, 1, 1], [0, -1, 1], [0, 0, -1]], [1, 1, 1, 1, 0]),
    "octahedron": ([[a, b, c] for a in (-1, 1) for b in (-1, 1) for c in (-1, 1)], [1] * 8),
    "prism": ([[-1, 0, 0], [0, -1, 0], [1, 1, 0], [0, 0, 1], [0, 0, -1]], [0, 0, 1, 2, 1]),
    "box": ([[1, 0], [-1, 0], [0, 1], [0, -1]], [1, 0, 2, 1]),
    "skew": ([[1, 1], [-1, -1], [1, -1], [-1, 1], [5, 0]], [1, 1, 1, 1, 4]),
    "flat": ([[-1, 0, 0], [0, -1, 0], [0, 0, -1], [1, 1, 1], [-1, -1, -1]], [0, 0, 0, 1, -1]),
    "flat square": ([[1, 1, 0], [-1, -1, 0], [1, -1, 0], [-1, 1, 0], [1, 0, -1], [-1, 0, 1]], [1, 1, 1, 1, 0, 0]),
    "line": ([[1, -2], [-1, 2], [1, 0], [-1, 0]], [0, 0, 1, 1]),
    "point": ([[1, 1], [-1, -1], [1, -1], [-1, 1]], [1, -1, 0, 0]),
}
"""Normals and right-hand sides."""


def index_of(name: str) -> Mapping[str, Any]:
    """Return a polytope as an index set."""
    H, h = POLYTOPES[name]
    return {"names": [f"t{j}" for j in range(len(H[0]))], "polytope": {"H": H, "h": h}}


def region_of(name: str) -> Region:
    """Return a polytope as an index set that was read."""
    return read_index(index_of(name))[0]


def list_corners(name: str) -> np.ndarray:
    """Return the vertices ``(k, d)`` of a polytope up to rounding: meetings of rows that no other row excludes."""
    H, h = (np.array(table, dtype=float) for table in POLYTOPES[name])
    corners = []
    for choice in combinations(range(len(H)), H.shape[1]):
        if abs(np.linalg.det(H[list(choice)])) > 1e-9:
            point = np.linalg.solve(H[list(choice)], h[list(choice)])
            corners += [point] if (H @ point <= h + 1e-12).all() else []
    return np.array(corners)


def sample(name: str, count: int, seed: int = 0) -> np.ndarray:
    """Return points ``(k, d)`` of a polytope, by means of hit-and-run: of steps along random directions that stay."""
    H, h = (np.array(table, dtype=float) for table in POLYTOPES[name])
    rng = np.random.default_rng(seed)
    pairs = [(i, j) for i in range(len(H)) for j in range(i) if (H[i] == -H[j]).all() and h[i] == -h[j]]
    flat = H[[i for i, _ in pairs]] if pairs else np.zeros((1, H.shape[1]))
    _, sizes, axes = np.linalg.svd(flat)
    basis = axes[int((sizes > 1e-9).sum()) :] if pairs else axes
    loose = [i for i in range(len(H)) if not any(i in pair for pair in pairs)]
    point, points = _centre(H, h), []
    for _ in range(count):
        direction = rng.normal(size=len(basis)) @ basis if len(basis) else np.zeros(H.shape[1])
        slopes, room = H[loose] @ direction, h[loose] - H[loose] @ point
        with np.errstate(divide="ignore", invalid="ignore"):
            steps = room / slopes
        far = [min(steps[slopes > 0], default=0.0), max(steps[slopes < 0], default=0.0)]
        ends = [point + share * direction for share in far]
        points += [*ends, point]
        point = ends[1] + rng.random() * (ends[0] - ends[1])
    return np.array(points)


def _centre(H: np.ndarray, h: np.ndarray) -> np.ndarray:
    from scipy.optimize import linprog

    axes = np.vstack([np.eye(H.shape[1]), -np.eye(H.shape[1])])
    corners = [linprog(axis, A_ub=H, b_ub=h, bounds=(None, None)).x for axis in axes]
    return np.asarray(np.mean(corners, axis=0))
