"""Curved sets: ellipsoids and norm balls, with their support functions in closed form."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from itertools import product
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from sparserob_core.brief import noun
from sparserob_core.errors import InputError
from sparserob_core.shapes import Bool, Float, dense, sealed, shaped
from sparserob_core.sip.convex_set import (
    BISECTION_HALVINGS,
    Array,
    Box,
    ConvexSet,
    bisect,
    continued_by_corners,
    continued_by_signs,
    few_digits,
    finite,
    ratios,
    vertex_excess,
)

_SIGN_DIMENSIONS = 10
# Exponents up to which the rounding of a base changes the power by less than the bounds leave free
MAX_NORM_EXPONENT = 1e10
# Relative deviation of a sum of powers, below which the sum is away from 0 in spite of rounding
MAX_POWER_DEVIATION = 0.999


@dataclass(frozen=True, eq=False)
class Ellipsoid(ConvexSet):
    """An ellipsoid ``{x : (x - centre)' shape^-1 (x - centre) <= 1} = {centre + L z : |z| <= 1}`` with
    ``L L' = shape``.

    Parameters
    ----------
    centre : array (d,)
        The centre.
    shape : array (d, d)
        A symmetric, positive definite matrix, in squared units of the coordinates.

    Raises
    ------
    InputError
        If the matrix is not symmetric and positive definite, or a number is not finite.

    Notes
    -----
    The support function is ``c'centre + sqrt(c' shape c)``.

    Examples
    --------
    >>> import numpy as np
    >>> import sparserob_core as sr
    >>> sr.Ellipsoid([0, 0], [[4, 0], [0, 1]]).support(np.array([1.0, 0.0])).item()
    2.0
    """

    centre: Array
    shape: Array

    if TYPE_CHECKING:  # users may give a list; the field is an array

        def __init__(self, centre: npt.ArrayLike, shape: npt.ArrayLike) -> None: ...

    __repr__ = noun

    def __post_init__(self) -> None:
        try:
            shape = np.atleast_2d(np.array(dense(self.shape), dtype=float))
        except (TypeError, ValueError) as error:
            raise InputError("shape must be a square matrix of numbers", path="ellipsoid") from error
        if shape.ndim != 2 or shape.shape[0] != shape.shape[1] or not np.isfinite(shape).all():
            raise InputError(
                f"shape must be a square matrix of finite numbers, got shape {shape.shape}", path="ellipsoid"
            )
        if (fault := _describe_indefiniteness(shape)) is not None:
            raise InputError(f"shape must be symmetric positive definite, got {fault}", path="ellipsoid")
        object.__setattr__(self, "centre", finite("ellipsoid.centre", self.centre, shape.shape[0]))
        object.__setattr__(self, "shape", (shape + shape.T) / 2)
        sealed(self)

    @property
    def dimension(self) -> int:
        return int(self.centre.size)

    @cached_property
    def factor(self) -> Array:
        """The lower triangular matrix ``L (d, d)`` with ``L L' = shape``."""
        return np.asarray(np.linalg.cholesky(self.shape), dtype=float)

    @cached_property
    def frame(self) -> Array:
        """The matrix ``L^-1``, rounded to a few digits.

        In its coordinates ``z`` of a direction, the support function about the centre is the 2-norm of ``z``.
        """
        return few_digits(np.asarray(np.linalg.solve(self.factor, np.eye(self.dimension)), dtype=float))

    @shaped
    def in_units(self, units: Float[Array, " d"]) -> Ellipsoid:
        return Ellipsoid(self.centre / units, self.shape / np.outer(units, units))

    @shaped
    def support(self, directions: Float[Array, "*k d"]) -> Float[Array, " *k"]:
        directions = np.asarray(directions, dtype=float)
        height: Array = directions @ self.centre + np.linalg.norm(directions @ self.factor, axis=-1)
        return height

    @shaped
    def continued(self, centre: Float[Array, "k d"], spread: Float[Array, "k d"]) -> Float[Array, " k"] | None:
        root = _bound_complex_root(centre @ self.factor, spread @ np.abs(self.factor), 2.0)
        return np.asarray((np.abs(centre) + spread) @ np.abs(self.centre) + root)

    @shaped
    def support_point(self, directions: Float[Array, "*k d"]) -> Float[Array, "*k d"]:
        images = np.asarray(directions, dtype=float) @ self.factor
        norms = np.linalg.norm(images, axis=-1, keepdims=True)
        point: Array = self.centre + images / np.where(norms > 0.0, norms, 1.0) @ self.factor.T
        return point

    @shaped
    def linearisation_excess(self, centre: Float[Array, "*k d"], spread: Float[Array, "*k J d"]) -> Float[Array, " *k"]:
        return _bound_length_excess(
            np.asarray(centre, dtype=float) @ self.factor, np.asarray(spread, dtype=float) @ self.factor
        )

    @shaped
    def support_minorant(
        self, centre: Float[Array, " d"], spread: Float[Array, "J d"]
    ) -> tuple[float, Float[Array, " J"], Float[Array, "J J"]]:
        value, gradient, _ = super().support_minorant(centre, spread)
        return value, gradient, norm_curvature(centre @ self.factor, spread @ self.factor)

    @shaped
    def violation(self, points: Float[Array, "*k d"]) -> Float[Array, " *k"]:
        """Return how far points are outside (positive) or inside (negative) of the ellipsoid.

        Outside, the value is the Euclidean distance. Inside, it is ``(gauge - 1)`` times the shortest half-axis, which
        is at least minus the depth.

        Parameters
        ----------
        points : array (..., d)
            The points.

        Returns
        -------
        array (...,)
            The violation of each point.
        """
        # The half-axes are singular values of the factor: eigenvalues of its square may be negative by rounding where
        # the half-axes differ much. A half-axis that is shorter than the rounding of the longest is replaced by this
        # rounding, which changes the projection only.
        axes, lengths, _ = np.linalg.svd(self.factor)
        lengths = np.maximum(lengths, np.finfo(float).eps * lengths.max())
        axes, squares = axes[:, ::-1], lengths[::-1] ** 2
        z = np.abs((np.asarray(points, dtype=float) - self.centre) @ axes)
        # The gauge decides between inside and outside, by substitution in the triangular factor, which gives the same
        # answer in all units. A point of gauge g > 1 is at least (g - 1) * shortest half-axis away, because the set
        # contains a ball of that radius.
        gauge = self.gauge(points)
        depth = (gauge - 1.0) / np.linalg.norm(np.linalg.solve(self.factor, np.eye(self.dimension)), ord=2)
        # The multiplier of the projection is where |shape^(1/2) z / (shape + multiplier)| has decreased to 1.
        _, high = bisect(
            lambda multiplier: (squares * (z / (squares + multiplier[..., None])) ** 2).sum(axis=-1) <= 1.0,
            np.zeros(gauge.shape),
            np.sqrt(squares[-1]) * np.linalg.norm(z, axis=-1),
        )
        distance = np.linalg.norm(z * (high[..., None] / (squares + high[..., None])), axis=-1)
        excess: Array = np.where(gauge > 1.0, np.maximum(distance, depth), depth)
        return excess

    @shaped
    def gauge(self, points: Float[Array, "*k d"]) -> Float[Array, " *k"]:
        return np.asarray(np.linalg.norm(self._solve_from_centre(self.factor, points), axis=-1))

    @shaped
    def normal(self, points: Float[Array, "*k d"]) -> Float[Array, "*k d"]:
        return self._solve_from_centre(self.shape, points)

    @shaped
    def _solve_from_centre(self, matrix: Float[Array, "d d"], points: Float[Array, "*k d"]) -> Float[Array, "*k d"]:
        """Return the solutions ``(..., d)`` of ``matrix y = point - centre``."""
        rays = np.asarray(points, dtype=float) - self.centre
        return np.asarray(np.linalg.solve(matrix, rays.reshape(-1, self.dimension).T).T.reshape(rays.shape))

    @shaped
    def unit_ball_image(self) -> tuple[Float[Array, " d"], Float[Array, "d d"]]:
        return self.centre, self.factor

    def scaled(self, factor: float) -> Ellipsoid:
        """Return the ellipsoid scaled by a ``factor`` about its centre; raise `InputError` for the factor 0.

        An ellipsoid has an interior, and a point has none.
        """
        return Ellipsoid(self.centre, factor**2 * self.shape)

    @shaped
    def middle(self) -> Float[Array, " d"]:
        return self.centre.copy()

    @shaped
    def sample(self, count: int, rng: np.random.Generator) -> Float[Array, "{count} d"]:
        """Return independent points of the ellipsoid, distributed uniformly.

        Parameters
        ----------
        count : int
            The number of points.
        rng : numpy.random.Generator
            The source of random numbers.

        Returns
        -------
        array (count, d)
            The points.
        """
        return np.asarray(self.centre + _sample_ball(2.0, self.dimension, count, rng) @ self.factor.T)

    @shaped
    def interior_point(self) -> Float[Array, " d"]:
        return self.centre.copy()


@dataclass(frozen=True, eq=False, init=False)
class NormBall(ConvexSet):
    """A ball ``{x : |x - centre|_p <= radius}`` of the ``p``-norm.

    Parameters
    ----------
    p : float
        The exponent, from 1 to infinity.
    radius : float
        The radius, at least 0 and finite.
    centre : array (d,), optional
        The centre. It may be left out where ``dimension`` is given.
    dimension : int, optional
        The dimension ``d`` of a ball about the origin.

    Raises
    ------
    InputError
        If the exponent or the radius is unsuitable, a number of the centre is not finite, or neither a centre nor a
        dimension is given.

    Notes
    -----
    The support function is ``c'centre + radius |c|_q`` with ``1/p + 1/q = 1``. The set is flat for ``p = 1`` in up to
    ten dimensions, and for ``p = inf``. A ball of radius 0 is a point, and is kept with ``p = inf``. A point has no
    gauge by which directions could be scaled.

    Examples
    --------
    >>> import numpy as np
    >>> import sparserob_core as sr
    >>> sr.NormBall(1, 0.5, dimension=2).support(np.array([3.0, -4.0])).item()
    2.0
    """

    p: float
    radius: float
    centre: Array

    __repr__ = noun

    def __init__(
        self, p: float, radius: float, centre: npt.ArrayLike | None = None, dimension: int | None = None
    ) -> None:
        if not float(p) >= 1.0:
            raise InputError(path="norm.p", expected="a number of at least 1 (inf for the maximum norm)", got=repr(p))
        if not 0.0 <= float(radius) < np.inf:
            raise InputError(path="norm.radius", expected="a finite number, at least 0", got=repr(radius))
        if centre is None and dimension is None:
            raise InputError(path="norm", expected="a centre, or a dimension for a ball about the origin")
        if dimension is not None and dimension < 1:
            raise InputError(path="norm.dimension", expected="at least 1", got=str(dimension))
        middle = np.zeros(dimension or 0) if centre is None else finite("norm.centre", centre, dimension)
        object.__setattr__(self, "p", float(p) if float(radius) > 0.0 else np.inf)
        object.__setattr__(self, "radius", float(radius))
        object.__setattr__(self, "centre", middle)
        sealed(self)

    @property
    def dimension(self) -> int:
        return int(self.centre.size)

    @property
    def dual(self) -> float:
        """The exponent ``q`` of the dual norm."""
        return np.inf if self.p == 1.0 else 1.0 if self.p == np.inf else self.p / (self.p - 1.0)

    @shaped
    def support(self, directions: Float[Array, "*k d"]) -> Float[Array, " *k"]:
        directions = np.asarray(directions, dtype=float)
        height: Array = directions @ self.centre + self.radius * _compute_norms(directions, self.dual)
        return height

    @shaped
    def continued(self, centre: Float[Array, "k d"], spread: Float[Array, "k d"]) -> Float[Array, " k"] | None:
        if self.p == np.inf or self.dimension == 1:
            return continued_by_signs(self.centre, np.full(self.dimension, self.radius), centre, spread)
        if self.p == 1.0:
            axes = self.radius * np.eye(self.dimension)
            return continued_by_corners(self.centre + np.vstack([axes, -axes]), centre, spread)
        root = self.radius * _bound_complex_root(centre, spread, self.dual) if self.radius > 0.0 else 0.0  # a point
        return np.asarray((np.abs(centre) + spread) @ np.abs(self.centre) + root)

    @shaped
    def support_point(self, directions: Float[Array, "*k d"]) -> Float[Array, "*k d"]:
        c = np.asarray(directions, dtype=float)
        size = np.abs(c).max(axis=-1, keepdims=True)
        c = c / np.where(size > 0.0, size, 1.0)
        if self.p == 1.0:
            unit = np.where(np.arange(self.dimension) == np.abs(c).argmax(axis=-1)[..., None], np.sign(c), 0.0)
        elif self.p == np.inf:
            unit = np.sign(c)
        else:
            steep = np.sign(c) * np.abs(c) ** (self.dual - 1.0)
            norms = np.linalg.norm(steep, ord=self.p, axis=-1, keepdims=True)
            unit = steep / np.where(norms > 0.0, norms, 1.0)
        point: Array = self.centre + self.radius * unit
        return point

    @shaped
    def linearisation_excess(self, centre: Float[Array, "*k d"], spread: Float[Array, "*k J d"]) -> Float[Array, " *k"]:
        if self.p == 1.0:
            corners = self.radius * np.vstack([np.eye(self.dimension), -np.eye(self.dimension)])
            return vertex_excess(
                self.centre + corners, np.asarray(centre, dtype=float), np.asarray(spread, dtype=float)
            )
        if self.p == np.inf:
            return Box(self.centre - self.radius, self.centre + self.radius).linearisation_excess(
                np.asarray(centre), np.asarray(spread)
            )
        if self.p != 2.0:
            smooth = self.radius * _bound_power_excess(
                np.asarray(centre, dtype=float), np.abs(spread).sum(axis=-2), self.dual
            )
            return np.minimum(super().linearisation_excess(centre, spread), smooth)
        return self.radius * _bound_length_excess(np.asarray(centre, dtype=float), np.asarray(spread, dtype=float))

    @shaped
    def support_majorant(
        self, centre: Float[Array, "*k d"], spread: Float[Array, "*k J d"]
    ) -> tuple[Float[Array, "*k d"], Float[Array, " *k"]]:
        if self.p == np.inf:
            return Box(self.centre - self.radius, self.centre + self.radius).support_majorant(centre, spread)
        return super().support_majorant(centre, spread)

    @shaped
    def halfspaces(self) -> tuple[Float[Array, "r d"], Float[Array, " r"]] | None:
        d = self.dimension
        if self.p == np.inf or d == 1:
            H = np.vstack([np.eye(d), -np.eye(d)])
        elif self.p == 1.0 and d <= _SIGN_DIMENSIONS:
            H = np.array(list(product([1.0, -1.0], repeat=d)))
        else:
            return None
        return H, H @ self.centre + self.radius

    @shaped
    def violation(self, points: Float[Array, "*k d"]) -> Float[Array, " *k"]:
        """Return how far points are outside (positive) or inside (negative) of the ball.

        Outside, the value is the Euclidean distance. Inside, it is
        ``(|x - centre|_p - radius) / max {|v|_p : |v|_2 = 1}``, which is at least minus the depth. A flat ball has the
        violation of its half-spaces.

        Parameters
        ----------
        points : array (..., d)
            The points.

        Returns
        -------
        array (...,)
            The violation of each point.
        """
        if self.halfspaces() is not None:
            return super().violation(points)
        z = np.abs(np.asarray(points, dtype=float) - self.centre)
        excess = np.asarray(_compute_norms(z, self.p) - self.radius)
        if self.p == 2.0:
            return excess
        if self.radius == 0.0:
            return np.asarray(np.linalg.norm(z, axis=-1))
        signed, outside = np.array(excess / self.dimension ** max(0.0, 1.0 / self.p - 0.5)), excess > 0.0
        if outside.any():
            z = z[outside] / self.radius
            signed[outside] = self.radius * np.linalg.norm(z - self._project_onto_unit_ball(z), axis=-1)
        return signed

    @shaped
    def contains(self, points: Float[Array, "*k d"], tolerance: float = 1e-9) -> Bool[np.ndarray, " *k"]:
        """Return the points that violate the ball by at most a tolerance, as a mask.

        Parameters
        ----------
        points : array (..., d)
            The points.
        tolerance : float, default 1e-9
            The absolute tolerance, a Euclidean distance.

        Returns
        -------
        array (...,) of bool
            True for points in the ball.

        Notes
        -----
        The ``p``-norm is at most ``to_p_norm`` times the Euclidean norm, and the Euclidean norm is at most
        ``to_euclidean`` times the ``p``-norm. The projection is computed only for points that these bounds leave
        undecided.
        """
        if self.halfspaces() is not None:
            return super().contains(points, tolerance)
        rays = np.asarray(points, dtype=float) - self.centre
        excess = np.atleast_1d(_compute_norms(rays, self.p) - self.radius)
        to_p_norm, to_euclidean = (self.dimension ** max(0.0, sign * (1.0 / self.p - 0.5)) for sign in (1.0, -1.0))
        inside = excess <= to_p_norm * tolerance
        undecided = inside & (excess > 0.0) & (to_euclidean * excess > tolerance)
        inside[undecided] = self.violation(self.centre + rays.reshape(*excess.shape, -1)[undecided]) <= tolerance
        return np.asarray(inside.reshape(rays.shape[:-1]))

    def _project_onto_unit_ball(self, z: Array) -> Array:
        """Return the Euclidean projections of ``z >= 0`` onto the unit ball.

        A projection ``y`` satisfies ``y_i + multiplier y_i^(p-1) = z_i`` with the multiplier for which its norm is 1.
        """
        power = self.p - 1.0
        _, high = bisect(
            lambda logarithm: (
                np.linalg.norm(_solve_power_equation(z, np.exp(logarithm)[..., None], power), ord=self.p, axis=-1)
                <= 1.0
            ),
            np.full(z.shape[:-1], -50.0),
            np.full(z.shape[:-1], 50.0),
        )
        return _solve_power_equation(z, np.exp(high)[..., None], power)

    @shaped
    def gauge(self, points: Float[Array, "*k d"]) -> Float[Array, " *k"]:
        return ratios(_compute_norms(np.asarray(points, dtype=float) - self.centre, self.p), self.radius)

    @shaped
    def normal(self, points: Float[Array, "*k d"]) -> Float[Array, "*k d"]:
        if self.p == np.inf:
            return super().normal(points)
        z = (np.asarray(points, dtype=float) - self.centre) / (self.radius or 1.0)
        return np.asarray(np.sign(z) * np.abs(z) ** (self.p - 1.0))

    @shaped
    def unit_ball_image(self) -> tuple[Float[Array, " d"], Float[Array, "d d"]] | None:
        return (self.centre, self.radius * np.eye(self.dimension)) if self.p == 2.0 and self.radius > 0.0 else None

    def scaled(self, factor: float) -> NormBall:
        return NormBall(self.p, factor * self.radius, self.centre)

    @shaped
    def middle(self) -> Float[Array, " d"]:
        return self.centre.copy()

    @shaped
    def sample(self, count: int, rng: np.random.Generator) -> Float[Array, "{count} d"]:
        """Return independent points of the ball, distributed uniformly.

        Parameters
        ----------
        count : int
            The number of points.
        rng : numpy.random.Generator
            The source of random numbers.

        Returns
        -------
        array (count, d)
            The points.
        """
        unit = (
            rng.uniform(-1.0, 1.0, size=(count, self.dimension))
            if self.p == np.inf
            else _sample_ball(self.p, self.dimension, count, rng)
        )
        return np.asarray(self.centre + self.radius * unit)

    @shaped
    def interior_point(self) -> Float[Array, " d"]:
        return self.centre.copy()

    @property
    def frame(self) -> Array:
        return few_digits(np.eye(self.dimension) / (self.radius or 1.0))

    @shaped
    def in_units(self, units: Float[Array, " d"]) -> ConvexSet:
        if (units == units[0]).all():
            return NormBall(self.p, self.radius / units[0], self.centre / units)
        if self.p == np.inf:
            return Box((self.centre - self.radius) / units, (self.centre + self.radius) / units)
        if self.p == 2.0 and self.radius > 0.0:
            return Ellipsoid(self.centre / units, np.diag((self.radius / units) ** 2))
        return super().in_units(units)


def _describe_indefiniteness(shape: Array) -> str | None:
    """Return in words why a square matrix is not symmetric and positive definite; ``None`` where it is both.

    The matrix is judged with its diagonal scaled to 1, so that units change no answer.
    """
    differs = np.abs(shape - shape.T) > 1e-12 * np.abs(shape.T)
    if differs.any():
        i, j = np.argwhere(differs)[0]
        return f"{shape[i, j]:.12g} in row {i + 1}, column {j + 1} and {shape[j, i]:.12g} across the diagonal"
    sizes = np.sqrt(np.maximum(np.diag(shape), 0.0))
    if not (sizes > 0.0).all():
        return f"{np.diag(shape).min():.6g} on its diagonal"
    least = float(np.linalg.eigvalsh(shape / np.outer(sizes, sizes))[0])
    if not least > 0.0:
        return f"the eigenvalue {least:.6g} where its diagonal is scaled to 1"
    try:
        np.linalg.cholesky(shape)
    except np.linalg.LinAlgError:
        return f"an eigenvalue that is 0 but for rounding, {least:.6g}, where its diagonal is scaled to 1"
    return None


@shaped
def _bound_length_excess(centre: Float[Array, "*k d"], spread: Float[Array, "*k J d"]) -> Float[Array, " *k"]:
    """Return an upper bound ``(...,)`` of ``|y| - g'y`` over ``y = centre + sum_j s_j spread_j`` with ``|s_j| <= 1``.

    Here ``g`` is the unit vector of the centre. The bound is ``sqrt(a^2 + b^2) - a``, which decreases in ``a <= g'y``
    and increases in ``b >= |y - g g'y|``.

    Parameters
    ----------
    centre : array (..., d)
        The middle of the vectors ``y``.
    spread : array (..., J, d)
        The deviations of the vectors ``y``.
    """
    length = np.linalg.norm(centre, axis=-1)
    unit = centre / np.where(length > 0.0, length, 1.0)[..., None]
    along = (spread * unit[..., None, :]).sum(axis=-1)
    across = np.linalg.norm(spread - along[..., None] * unit[..., None, :], axis=-1).sum(axis=-1)
    least = length - np.abs(along).sum(axis=-1)
    excess: Array = np.hypot(least, across) - least
    return excess


def _solve_power_equation(z: Array, multiplier: Array, power: float) -> Array:
    """Return the root ``0 <= y <= z`` of ``y + multiplier y^power = z``, entry by entry.

    One of the two summands, ``a``, is chosen such that the other is a convex function ``(a / unit)^q`` of it,
    ``q >= 1``. Newton's method then decreases to the root from the smaller of the two values at which one summand alone
    equals ``z``.
    """
    q = max(power, 1.0 / power)
    unit = multiplier if power < 1.0 else multiplier ** (-1.0 / q)
    a = np.minimum(z, unit * z ** (1.0 / q))
    for _ in range(BISECTION_HALVINGS):
        convex_summand = (a / unit) ** q
        step = ratios((a + convex_summand - z) * a, a + q * convex_summand)
        a = np.maximum(a - step, 0.0)
        if (np.abs(step) <= np.finfo(float).eps * a).all():
            break
    return np.minimum(z, (a / unit) ** q if power < 1.0 else a)


def _sample_ball(p: float, dimension: int, count: int, rng: np.random.Generator) -> Array:
    """Return ``count`` uniform points in the unit ball of the ``p``-norm.

    The method is that of Barthe, Guedon, Mendelson and Naor 2005, Theorem 1.
    """
    sizes = rng.gamma(1.0 / p, size=(count, dimension)) ** (1.0 / p)
    norms = ((sizes**p).sum(axis=1, keepdims=True) + rng.exponential(size=(count, 1))) ** (1.0 / p)
    return np.asarray(np.where(rng.integers(0, 2, size=(count, dimension), dtype=np.int8) > 0, sizes, -sizes) / norms)


@shaped
def norm_curvature(centre: Float[Array, " b"], spread: Float[Array, "J b"]) -> Float[Array, "J J"]:
    """Return ``H (J, J)`` with ``|a + B's| >= |a| + a'B's / |a| + s'H s / 2`` for all ``|s_j| <= 1``.

    Parameters
    ----------
    centre : array (b,)
        The vector ``a``.
    spread : array (J, b)
        The matrix ``B``.

    Returns
    -------
    array (J, J)
        The positive semidefinite matrix ``H``; 0 where ``a`` is 0.

    Notes
    -----
    Let ``u`` be the component of ``a + B's`` along ``a``, at most ``U``, and ``v`` the length of the component across.
    ``sqrt(u^2 + v^2) - u`` decreases in ``u``. It is therefore at least ``g(v^2) = sqrt(U^2 + v^2) - U``, and ``g`` is
    concave.

    Write ``v^2 = sum_k t_k`` with ``t_k = (c_k's)^2`` from 0 to ``m_k``. Then ``g`` is at least ``sum_k a_k t_k`` with
    the coefficients of the greedy algorithm, ``a_k m_k = g(m_1 + ... + m_k) - g(m_1 + ... + m_{k-1})``, because ``g``
    of a sum is submodular (Edmonds 1970). The narrowest ``t_k`` come first, so that wide ones do not reduce their
    curvature. The ``c_k`` are columns of a pivoted Cholesky factor, which begins with the widest.

    References
    ----------
    J. Edmonds (1970), Submodular functions, matroids, and certain polyhedra.
    """
    size = float(np.linalg.norm(centre))
    if size == 0.0:
        return np.zeros((spread.shape[0], spread.shape[0]))
    along = spread @ centre / size
    across = spread - np.outer(along, centre / size)
    columns = _factorise_semidefinite(across @ across.T)
    widths = np.abs(columns).sum(axis=1) ** 2
    # Terms whose widths agree up to a factor of 2 share the mean of their slopes, which is as good as any order.
    _, group = np.unique(np.frexp(widths)[1], return_inverse=True)
    upper, totals = size + float(np.abs(along).sum()), np.cumsum(np.bincount(group, widths))
    slopes = np.diff(totals / (upper + np.sqrt(upper**2 + totals)), prepend=0.0) / np.diff(totals, prepend=0.0)
    return np.asarray((2.0 * slopes[group] * columns.T) @ columns)


def _factorise_semidefinite(matrix: Array) -> Array:
    """Return rows ``c_k (b, J)``, the widest first, for which ``sum_k c_k c_k'`` is a matrix up to rounding.

    The ``matrix (J, J)`` is positive semidefinite.
    """
    residual, tolerance, columns = (
        matrix,
        matrix.shape[0] * np.finfo(float).eps * matrix.diagonal().max(initial=0.0),
        [],
    )
    for _ in range(matrix.shape[0]):
        pivot = int(residual.diagonal().argmax())
        if residual[pivot, pivot] <= tolerance:
            break
        columns.append(residual[pivot] / np.sqrt(residual[pivot, pivot]))
        residual = residual - np.outer(columns[-1], columns[-1])
    return np.array(columns).reshape(len(columns), matrix.shape[0])


def _bound_complex_root(a: Array, b: Array, q: float) -> Array:
    """Return an upper bound of ``|(sum_i z_i^q)^(1/q)|`` for complex ``z_i`` within ``b_i`` of ``|a_i|``.

    Parameters
    ----------
    a, b : arrays (k, d)
        The real numbers, and the radii of the discs about their absolute values.
    q : float
        The exponent.

    Returns
    -------
    array (k,)
        The bound. It is ``inf`` where the sum may leave the right half-plane, or, for ``q`` other than 2, where an
        entry may be 0 without being 0 in the whole disc.

    Notes
    -----
    The deviation of ``z^q`` is at most ``q b (|a| + b)^(q - 1)``, the integral of its derivative. Where one entry is
    larger than the others, `_bound_by_largest` may give a smaller bound.
    """
    largest = (np.abs(a) + b).max(axis=1, keepdims=True)
    unit = np.where(largest > 0.0, largest, 1.0)
    a, b = np.abs(a) / unit, b / unit
    total, deviation = (a**q).sum(axis=1), (q * b * (a + b) ** (q - 1.0)).sum(axis=1)
    analytic = deviation < MAX_POWER_DEVIATION * total
    if q == 2.0:
        return np.where(analytic, unit[:, 0] * np.sqrt(total + deviation), np.inf)
    away = ((a > b) | (b == 0.0)).all(axis=1)
    power_bound = np.where(analytic & away & (q < MAX_NORM_EXPONENT), (total + deviation) ** (1.0 / q), np.inf)
    return np.asarray(unit[:, 0] * np.minimum(power_bound, np.where(away, _bound_by_largest(a, b, q), np.inf)))


def _bound_by_largest(a: Array, b: Array, q: float) -> Array:
    """Return the bound of `_bound_complex_root` for entries ``a >= 0`` whose discs of radius ``b`` do not contain 0.

    The root is written as ``z (1 + sum (z_i / z)^q)^(1/q)`` with the largest entry ``z``. Where the other entries are
    smaller by more than the share ``1 / q`` of it, this form gives a bound for discs of any size. The sum of powers
    gives a bound for discs that are smaller than the share ``1 / q`` only.

    Parameters
    ----------
    a, b : arrays (k, d)
        The entries, and the radii of the discs.
    q : float
        The exponent.

    Returns
    -------
    array (k,)
        The bound, or ``inf`` where none is found.
    """
    is_largest = np.arange(a.shape[1]) == a.argmax(axis=1)[:, None]
    lower, upper = (np.where(is_largest, end, 0.0).sum(axis=1) for end in (a - b, a + b))
    shares = (a + b) / np.where(lower > 0.0, lower, 1.0)[:, None] * (1.0 + 8.0 * np.finfo(float).eps)
    ratio_sum = np.where(is_largest, 0.0, np.minimum(shares, 1.0) ** q).sum(axis=1)
    return np.where((lower > 0.0) & (ratio_sum < MAX_POWER_DEVIATION), upper * (1.0 + ratio_sum) ** (1.0 / q), np.inf)


def _compute_norms(vectors: Array, q: float) -> Array:
    """Return the ``q``-norms ``(...,)`` of vectors ``(..., d)``.

    Vectors are divided by their largest entries first. A large power of an entry that is not near 1 is 0 or infinite.
    """
    if q in (1.0, 2.0, np.inf):
        return np.asarray(np.linalg.norm(vectors, ord=q, axis=-1))
    unit = np.abs(vectors).max(axis=-1, keepdims=True)
    return np.asarray(unit[..., 0] * np.linalg.norm(vectors / np.where(unit > 0.0, unit, 1.0), ord=q, axis=-1))


@shaped
def _bound_power_excess(a: Float[Array, "*k d"], b: Float[Array, "*k d"], q: float) -> Float[Array, " *k"]:
    """Return an upper bound of ``|a + s|_q - |a|_q - gradient's`` for all ``|s_i| <= b_i``.

    The root is concave in ``sum |a_i + s_i|^q``, and each term of this sum is convex.

    Parameters
    ----------
    a, b : arrays (..., d)
        The vectors, and the bounds of the deviations of their entries.
    q : float
        The exponent.

    Returns
    -------
    array (...,)
        The bound; infinite where ``a`` is 0.
    """
    unit = np.abs(a).max(axis=-1, keepdims=True)
    a, b, unit = *(vector / np.where(unit > 0.0, unit, 1.0) for vector in (a, b)), unit[..., 0]
    slope = q * np.sign(a) * np.abs(a) ** (q - 1.0)
    ends = [np.abs(a + sign * b) ** q - np.abs(a) ** q - sign * slope * b for sign in (-1.0, 1.0)]
    norms = np.linalg.norm(a, ord=q, axis=-1)
    with np.errstate(divide="ignore", invalid="ignore"):
        excess = unit * norms ** (1.0 - q) * np.maximum(*ends).sum(axis=-1) / q
    return np.where(norms > 0.0, excess, np.inf)
