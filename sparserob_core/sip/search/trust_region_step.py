"""The maximum of a quadratic in a ball and a box: the step of a trust region."""

from __future__ import annotations

import numpy as np

from sparserob_core.sip.convex_set import Array

ITERATIONS = 40


def highest_in_ball_and_box(gradient: Array, hessian: Array, radius: float, lower: Array, upper: Array) -> Array:
    """A step ``s (d,)`` with ``|s| <= radius``, ``lower <= s <= upper`` that makes ``gradient's + 1/2 s'hessian s``
    large; ``lower <= 0 <= upper``.

    Exact while no bound of the box is met. A coordinate that would leave the box is fixed at its bound, and the rest is
    solved again in the ball that is left, at most ``d`` times.
    """
    step = np.zeros(gradient.size)
    free = ~(((lower >= 0.0) & (gradient < 0.0)) | ((upper <= 0.0) & (gradient > 0.0)))
    while free.any():
        room = float(np.sqrt(max(radius**2 - float(step @ step), 0.0)))
        if room == 0.0:
            break
        slope = gradient[free] + hessian[np.ix_(free, ~free)] @ step[~free]
        inner = highest_in_ball(slope, hessian[np.ix_(free, free)], room)
        clipped = np.clip(inner, lower[free], upper[free])
        outside = clipped != inner
        step[free] = np.where(outside, clipped, 0.0) if outside.any() else inner
        if not outside.any():
            return step
        where = np.flatnonzero(free)
        free[where[outside]] = False
    return step


def highest_in_ball(gradient: Array, hessian: Array, radius: float) -> Array:
    """The ``s (d,)`` with ``|s| <= radius`` that maximises ``gradient's + 1/2 s'hessian s`` (More and Sorensen
    1983)."""
    curvature, basis = np.linalg.eigh(-hessian)
    slope = basis.T @ gradient
    lowest = float(curvature[0])
    size = float(np.linalg.norm(slope))
    if size == 0.0 and lowest >= 0.0:
        return np.zeros(gradient.size)
    if lowest > 0.0:
        inner = slope / curvature
        if float(inner @ inner) <= radius**2:
            return np.asarray(basis @ inner, dtype=float)
    tiny = 1e-14 * max(abs(lowest), float(curvature[-1]), size / radius)
    least = max(0.0, -lowest) + tiny
    inner = slope / (curvature + least)
    missing = radius**2 - float(inner @ inner)
    if missing >= 0.0:
        inner[0] += np.copysign(np.sqrt(inner[0] ** 2 + missing) - abs(inner[0]), slope[0])
        return np.asarray(basis @ inner, dtype=float)
    return np.asarray(basis @ _on_the_sphere(slope, curvature, radius, least), dtype=float)


def _on_the_sphere(slope: Array, curvature: Array, radius: float, least: float) -> Array:
    """``slope / (curvature + shift)`` of length ``radius``, ``shift > least``: Newton on the inverse of the length,
    from the left."""
    shift = least
    for _ in range(ITERATIONS):
        inner = slope / (curvature + shift)
        length = float(np.sqrt(inner @ inner))
        if length <= radius * (1.0 + 1e-6):
            break
        shift += length**2 / float(inner @ (inner / (curvature + shift))) * (length / radius - 1.0)
    return np.asarray(inner * min(1.0, radius / length), dtype=float)
