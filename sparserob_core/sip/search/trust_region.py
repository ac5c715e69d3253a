"""A trust region without derivatives, one step at a time: it proposes a point, and the caller reports the value."""

from __future__ import annotations

from typing import NamedTuple, final

import numpy as np

from sparserob_core.sip.convex_set import Array

FIRST, LARGEST = 0.1, 0.3
"""Largest first radius, and largest radius, as shares of the box."""
SMALLEST_RADIUS = 1e-13
"""Radius in the unit box below which no improvement is possible in double precision."""
SURPLUS = 1.5
"""Number of points of a model for each of its coefficients. Interpolation needs fewer, but a few more points fit a
function with kinks better."""
MAX_MODEL_POINTS = 99
"""Largest number of points of a model: one and a half times the coefficients of a full quadratic in ten coordinates."""
STEP_LENGTH_ITERATIONS = 40  # largest number of Newton steps for the length of a step
SLOPE_OVER_CURVATURE = 10.0
"""Price of curvature relative to that of slope, where the points do not determine the model."""


class _Quadratic(NamedTuple):
    """Quadratic ``gradient's + 1/2 s'hessian s`` of steps ``s`` from the best point."""

    gradient: Array
    hessian: Array

    def gain(self, step: Array) -> float:
        """Return the value of the quadratic at a step ``(d,)``."""
        return float(self.gradient @ step + 0.5 * step @ self.hessian @ step)


@final
class TrustRegion:
    """Derivative-free ascent in a unit box, from the best evaluated point, with a quadratic model of its neighbours.

    The caller scales its coordinates to ``[0, 1]`` and alternates::

        point = region.propose(points, values)     # None: no improvement is possible
        region.tell(value at the point)            # and appends both to its points and values

    Parameters
    ----------
    radius : float, default 0
        First radius; 0: it is taken from the distances of the neighbours.

    Notes
    -----
    The model uses the nearest points. Beyond the current scale their weight is the inverse cube of their distance,
    because the error of a quadratic grows like the cube. With as many points as coefficients the model interpolates.
    With fewer points it is the model of least norm, in which curvature counts far more than slope (after Powell's
    NEWUOA 2006). With more points it is a least-squares fit. The model is maximised in the ball of the radius and in
    the box. A step that gains less than a quarter of the predicted gain halves the radius. A step that gains more than
    three quarters may double it, as in dlib's trust region (King 2017). After a failed step, directions that the
    neighbours do not span are tried first.

    Smooth maxima are reached faster than linearly, kinks linearly. A step costs 0.1 to 0.2 ms up to five coordinates.
    At thirty it costs of the order of 10 ms, and the points are far too few to determine the model. Nothing is proven:
    the result is a local maximum. A neighbour with the value ``-inf`` counts as the lowest of the others.
    """

    def __init__(self, radius: float = 0.0) -> None:
        self.radius = radius
        """Current radius; 0: the next proposal takes it from the distances of the neighbours."""
        self.promise = 0.0
        """Gain over the best value that the model predicts for the last proposal."""
        self._best, self._length = -np.inf, 0.0
        self._is_spanning, self._has_failed, self._is_hopeless = False, False, False

    def restart(self) -> None:
        """Forget the radius, since another point that is farther away than the radius has become the best."""
        self.radius, self._has_failed, self._is_hopeless = 0.0, False, False

    def propose(self, points: Array, values: Array) -> Array | None:
        """Return the next point to evaluate.

        Parameters
        ----------
        points : ndarray, shape (n, d)
            Evaluated points of the unit box, at least one.
        values : ndarray, shape (n,)
            Their values; the largest must be finite.

        Returns
        -------
        ndarray, shape (d,), or None
            The point; ``None`` where no improvement is possible.
        """
        top = int(values.argmax())
        if values[top] > self._best:
            self._best, self._is_hopeless = float(values[top]), False
        offsets, distances, rises = _find_neighbours(points, values, top)
        if not self.radius:
            self.radius = min(FIRST, 0.95 * float(distances.max(initial=0.0))) or FIRST
        lower, upper = -points[top], 1.0 - points[top]
        while self.radius >= SMALLEST_RADIUS:
            step = _find_missing_direction(offsets, distances, self.radius, lower, upper) if self._has_failed else None
            self._is_spanning = step is not None
            if step is None:
                size = float(np.abs(rises).max(initial=0.0)) or 1.0
                model = _fit_quadratic(offsets, distances, rises / size, self.radius)
                step = highest_in_ball_and_box(model.gradient, model.hessian, self.radius, lower, upper)
                self.promise = size * model.gain(step)
            if self._is_spanning or self.promise > 1e-17 * abs(self._best):
                self._length = float(np.linalg.norm(step))
                point: Array = np.clip(points[top] + step, 0.0, 1.0)
                if not (point == points).all(axis=1).any():
                    return point
            if self._is_hopeless:
                break
            # A model that predicts no gain is accepted only when another one, of a tenth of the size, agrees.
            self.radius, self._has_failed, self._is_hopeless = 0.1 * self.radius, True, True
        return None

    def tell(self, value: float) -> None:
        """Receive the value at the point that was proposed last, and adapt the radius."""
        if self._is_spanning:
            return
        ratio = (value - self._best) / self.promise
        self._has_failed = not ratio >= 0.25
        if self._has_failed:
            self.radius = 0.5 * min(self.radius, max(self._length, 0.25 * self.radius))
        elif ratio > 0.75:
            self.radius = max(self.radius, min(LARGEST, 2.0 * self._length))


def _find_neighbours(points: Array, values: Array, top: int) -> tuple[Array, Array, Array]:
    """Return offsets, distances and differences of value of the points nearest to point ``top``, nearest first."""
    dimension = points.shape[1]
    offsets = points - points[top]
    squares = np.einsum("ij,ij->i", offsets, offsets)
    coefficients = dimension * (dimension + 3) // 2
    count = 1 + min(int(SURPLUS * coefficients), max(MAX_MODEL_POINTS, 2 * dimension))
    nearest = np.argpartition(squares, count - 1)[:count] if len(points) > count else np.arange(len(points))
    nearest = nearest[np.argsort(squares[nearest], kind="stable")]
    nearest = nearest[squares[nearest] > 0.0]
    rises = values[nearest] - values[top]
    finite = np.isfinite(rises)
    return (
        offsets[nearest],
        np.sqrt(squares[nearest]),
        np.where(finite, rises, rises[finite].min(initial=-np.finfo(float).tiny)),
    )


def _fit_quadratic(offsets: Array, distances: Array, rises: Array, radius: float) -> _Quadratic:
    """Return the quadratic through the best point that fits its neighbours."""
    count, dimension = offsets.shape
    if count == 0:
        return _Quadratic(np.zeros(dimension), np.zeros((dimension, dimension)))
    i, j = np.triu_indices(dimension)
    scale = min(radius, float(distances[min(count, dimension + i.size) - 1]))
    scaled, weights = offsets / scale, np.maximum(1.0, distances / scale) ** -3.0
    # The factors make the norm of the coefficients that of the Hessian (Frobenius, times 2 ** -0.5).
    factors = np.where(i == j, 0.5, 0.5**0.5)
    features = np.hstack([SLOPE_OVER_CURVATURE * scaled, scaled[:, i] * scaled[:, j] * factors])
    solution = np.linalg.lstsq(features * weights[:, np.newaxis], rises * weights, rcond=1e-10)[0]
    hessian = np.zeros((dimension, dimension))
    hessian[i, j] = solution[dimension:] * factors / scale**2
    return _Quadratic(
        np.asarray(solution[:dimension] * (SLOPE_OVER_CURVATURE / scale), dtype=float), hessian + hessian.T
    )


def _find_missing_direction(
    offsets: Array, distances: Array, radius: float, lower: Array, upper: Array
) -> Array | None:
    """Return a step of length ``radius`` in the direction that the near points span least; ``None`` where they span the
    space."""
    near_offsets = offsets[distances <= 5.0 * radius] / radius
    if not len(near_offsets):
        near_offsets = np.zeros((1, lower.size))
    _, singular, right = np.linalg.svd(near_offsets, full_matrices=True)
    if singular.size == lower.size and singular[-1] > 0.1:
        return None
    forward, backward = (np.clip(sign * radius * right[-1], lower, upper) for sign in (1.0, -1.0))
    return np.asarray(forward if np.abs(forward).max() >= np.abs(backward).max() else backward)


def highest_in_ball_and_box(gradient: Array, hessian: Array, radius: float, lower: Array, upper: Array) -> Array:
    """Return a step that makes ``gradient's + 1/2 s'hessian s`` large, in a ball and a box.

    The step is the maximum as long as it meets no bound of the box. A coordinate that would leave the box is fixed at
    its bound. The rest is solved again in the remaining ball, at most ``d`` times.

    Parameters
    ----------
    gradient : ndarray, shape (d,)
        Gradient.
    hessian : ndarray, shape (d, d)
        Hessian.
    radius : float
        Radius of the ball, ``|s| <= radius``.
    lower, upper : ndarray, shape (d,)
        Bounds of the step, ``lower <= 0 <= upper``.

    Returns
    -------
    ndarray, shape (d,)
        The step ``s``.
    """
    step = np.zeros(gradient.size)
    free = ~(((lower >= 0.0) & (gradient < 0.0)) | ((upper <= 0.0) & (gradient > 0.0)))
    while free.any():
        remaining_radius = float(np.sqrt(max(radius**2 - float(step @ step), 0.0)))
        if remaining_radius == 0.0:
            break
        slope = gradient[free] + hessian[np.ix_(free, ~free)] @ step[~free]
        inner = highest_in_ball(slope, hessian[np.ix_(free, free)], remaining_radius)
        clipped = np.clip(inner, lower[free], upper[free])
        outside = clipped != inner
        step[free] = np.where(outside, clipped, 0.0) if outside.any() else inner
        if not outside.any():
            return step
        free_indices = np.flatnonzero(free)
        free[free_indices[outside]] = False
    return step


def highest_in_ball(gradient: Array, hessian: Array, radius: float) -> Array:
    """Return the maximiser of ``gradient's + 1/2 s'hessian s`` over ``|s| <= radius`` (More and Sorensen 1983).

    Parameters
    ----------
    gradient : ndarray, shape (d,)
        Gradient.
    hessian : ndarray, shape (d, d)
        Hessian.
    radius : float
        Radius of the ball.

    Returns
    -------
    ndarray, shape (d,)
        The maximiser ``s``.
    """
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
    return np.asarray(basis @ _step_to_sphere(slope, curvature, radius, least), dtype=float)


def _step_to_sphere(slope: Array, curvature: Array, radius: float, least: float) -> Array:
    """Return ``slope / (curvature + shift)`` of length ``radius`` with ``shift >= least``.

    Newton's method on the inverse of the length finds the shift from the left.
    """
    shift = least
    for _ in range(STEP_LENGTH_ITERATIONS):
        inner = slope / (curvature + shift)
        length = float(np.sqrt(inner @ inner))
        if length <= radius * (1.0 + 1e-6):
            break
        shift += length**2 / float(inner @ (inner / (curvature + shift))) * (length / radius - 1.0)
    return np.asarray(inner * min(1.0, radius / length), dtype=float)
