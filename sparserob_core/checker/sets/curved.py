"""Curved sets in ball arithmetic: ellipsoids, balls of p-norms, cylinders over them, and products of sets."""

from __future__ import annotations

import math
from collections.abc import Sequence
from fractions import Fraction
from functools import cached_property
from itertools import pairwise, product
from typing import final

import numpy as np
from flint import arb, arb_mat, ctx

from sparserob_core.checker.arithmetic.balls import above, ball, balls, largest
from sparserob_core.checker.arithmetic.series import exactly
from sparserob_core.checker.outcome import Broken, Unchecked
from sparserob_core.checker.sets.along import Norm, NormSummand
from sparserob_core.checker.sets.polynomials import HALF_ULP, OUTWARD, ROUNDING
from sparserob_core.checker.sets.shape import NEAR, Shape, along, total
from sparserob_core.checker.sets.summands import Summand
from sparserob_core.control.sets.sets import Cylinder, Ellipsoid, NormBall, Product
from sparserob_core.sip.convex_set import Array

DIGITS = 4  # times the working precision, for the comparison of an ellipsoid with its factor
LEAST = 2.0**-1000  # an error bound below this is rounded up: underflow has cost it digits
MAX_CORNER_DIMENSION = 8  # the largest dimension in which a ball of a p-norm is evaluated at all corners of a range


@final
class Ellipsoidal(Shape):
    """An ellipsoid: ``h(c) = c'm + sqrt(c'S c)``."""

    source: Ellipsoid

    @property
    def centre(self) -> Array:
        return np.asarray(self.source.centre, dtype=float)

    def support(self, direction: Sequence[arb]) -> arb:
        quadratic = total(a * along(row, direction) for a, row in zip(direction, self.source.shape, strict=True))
        return along(self.centre, direction) + quadratic.nonnegative_part().sqrt()

    def holds(self, point: Sequence[arb]) -> bool:
        return bool(self._compute_squared_gauge([x - m for x, m in zip(point, balls(self.centre), strict=True)]) <= 1)

    def compute_support_offset(self, direction: Sequence[arb]) -> list[arb]:
        images = [along(row, direction) for row in self.source.shape]
        size = total(c * v for c, v in zip(direction, images, strict=True)).nonnegative_part().sqrt()
        return [v / size for v in images]

    def gauge(self, offsets: Sequence[arb]) -> arb:
        return self._compute_squared_gauge(offsets).nonnegative_part().sqrt()

    def _compute_squared_gauge(self, offsets: Sequence[arb]) -> arb:
        z = arb_mat([balls(row) for row in self.source.shape]).solve(arb_mat([[v] for v in offsets]))
        return total(v * z[i, 0] for i, v in enumerate(offsets))

    def towards(self, offset: Array) -> Array:
        return np.asarray(np.linalg.solve(self.source.shape, offset), dtype=float)

    def bound(self, value: Array, spread: Array) -> tuple[Array, Array]:
        return _bound_ellipsoid(self.centre, self.source.shape, value, spread)

    def chords(self, middle: Array) -> list[arb]:
        inverse = exactly(self.source.shape).inv()
        return [2 / inverse[b, b].sqrt() for b in range(self.dimension)]

    @cached_property
    def norm(self) -> Norm:
        return Norm(self.source.factor, self.factor_residual, 2.0)

    @cached_property
    def factor_residual(self) -> float:
        """The upper bound, in balls, of the difference between the matrix ``S`` and ``L L'`` relative to ``L L'``: of
        the norm of ``L^-1 S L'^-1 - 1``, with the rounded Cholesky factor ``L``."""
        L = self.source.factor
        with ctx.workprec(DIGITS * ctx.prec):  # in a long ellipsoid most digits cancel
            inverse = arb_mat(L.tolist()).inv()
            shares = (inverse * arb_mat(self.source.shape.tolist()) * inverse.transpose()).tolist()
            residual = [x - int(i == j) for i, row in enumerate(shares) for j, x in enumerate(row)]
            # a square as a product: Arb gives no power of a ball that contains 0
            bound = above(total(x * x for x in residual).nonnegative_part().sqrt())
        if not bound < 1.0:
            raise Unchecked("the ellipsoid is too long for its axes to be told in floats")
        return bound


@final
class Ball(Shape):
    """A ball of a p-norm: ``h(c) = c'm + radius |c|_q``, ``1/p + 1/q = 1``."""

    source: NormBall

    @property
    def centre(self) -> Array:
        return np.asarray(self.source.centre, dtype=float)

    def support(self, direction: Sequence[arb]) -> arb:
        return along(self.centre, direction) + ball(self.source.radius) * self._compute_dual_norm(direction)

    def _compute_dual_norm(self, direction: Sequence[arb]) -> arb:
        p, sizes = self.source.p, [abs(c) for c in direction]
        if p == 1.0:
            return largest(sizes)
        if p == 2.0:
            return total(c * c for c in direction).nonnegative_part().sqrt()
        q = ball(p) / (ball(p) - 1)
        power_sum = total(_compute_power(size, q) for size in sizes if not size.is_zero())
        return power_sum if power_sum.is_zero() else _compute_power(power_sum, 1 / q)

    def compute_support_offset(self, direction: Sequence[arb]) -> list[arb]:
        q = ball(self.source.p) / (ball(self.source.p) - 1)
        powers = [_compute_power(c, q - 1) if not c.is_zero() else c for c in direction]
        size = self.gauge(powers)
        return [v / size if c > 0 else -v / size for c, v in zip(direction, powers, strict=True)]

    def holds(self, point: Sequence[arb]) -> bool:
        p, radius = self.source.p, ball(self.source.radius)
        offsets = [x - m for x, m in zip(point, balls(self.centre), strict=True)]
        if p == 2.0:
            return bool(total(v * v for v in offsets) <= radius**2)
        return bool(total(abs(v) ** ball(p) for v in offsets if not v.is_zero()) <= radius ** ball(p))

    def gauge(self, offsets: Sequence[arb]) -> arb:
        p = ball(self.source.p)
        power_sum = total(_compute_power(v, p) for v in offsets if not v.is_zero())
        return (power_sum if power_sum.is_zero() else _compute_power(power_sum, 1 / p)) / ball(self.source.radius)

    def bound(self, value: Array, spread: Array) -> tuple[Array, Array]:
        """Return linear upper bounds of the support function: ``h(f) - w'f`` is convex, hence largest at a corner of a
        range."""
        d, p = self.dimension, self.source.p
        if p == 2.0:
            size, power = math.frexp(self.source.radius)
            return _bound_ellipsoid(self.centre, size**2 * np.eye(d), value, spread, power)
        w = self.source.support_point(value)
        if d <= MAX_CORNER_DIMENSION:
            ends = value[:, None] + spread[:, None] * np.array(list(product((-1.0, 1.0), repeat=d)))
            excess = (self._evaluate_support(ends) - np.einsum("kw,kew->ke", w - self.centre, ends)).max(axis=1)
        else:
            excess = self._evaluate_support(value) - ((w - self.centre) * value).sum(axis=1)
            excess += self._evaluate_support(spread) + (np.abs(w - self.centre) * spread).sum(axis=1)
        reach = np.abs(value) + spread
        rounding_error = ROUNDING * (
            self._evaluate_support(reach) + (reach * (np.abs(w) + 2.0 * np.abs(self.centre))).sum(axis=1)
        )
        return w, (np.maximum(excess, 0.0) + rounding_error) * OUTWARD

    def _evaluate_support(self, vectors: Array) -> Array:
        """Return the support values about the centre, up to rounding; no component overflows or underflows."""
        size = np.abs(vectors).max(axis=-1, keepdims=True)
        scaled = vectors / np.where(size > 0.0, size, 1.0)
        norms: Array = self.source.radius * size[..., 0] * np.linalg.norm(scaled, ord=self.source.dual, axis=-1)
        return norms

    def chords(self, middle: Array) -> list[arb]:
        return [2 * ball(self.source.radius)] * self.dimension

    @cached_property
    def norm(self) -> Norm | None:
        p = self.source.p
        return None if p == 1.0 else Norm(self.source.radius * np.eye(self.dimension), HALF_ULP, p / (p - 1.0))


@final
class Cylindrical(Shape):
    """A cylinder: the first coordinates, or their sums with others, are in the set ``base``; everything else is
    free."""

    source: Cylinder

    def __init__(self, source: Cylinder, base: Shape) -> None:
        super().__init__(source)
        self.base = base
        zero_slopes = np.zeros((base.dimension, source.dimension - base.dimension))
        self.slopes = zero_slopes if source.slopes is None else np.asarray(source.slopes, dtype=float)
        is_signed_sum = (
            np.isin(self.slopes, (-1.0, 0.0, 1.0)).all() and (np.count_nonzero(self.slopes, axis=0) <= 1).all()
        )
        if self.slopes.shape != zero_slopes.shape or not is_signed_sum:
            raise Unchecked("the checker knows cylinders along sums and differences of coordinates")

    @property
    def spanned(self) -> int:
        return self.base.dimension

    @property
    def centre(self) -> Array:
        return np.concatenate([self.base.centre, np.zeros(self.dimension - self.spanned)])

    def lifted(self, directions: Array) -> Array:
        """Return directions ``(k, b)`` of the base as directions of the set; exact, since each entry comes from one
        number."""
        return np.hstack([directions, directions @ self.slopes])

    def support(self, direction: Sequence[arb]) -> arb:
        base_direction = direction[: self.spanned]
        for column, c in enumerate(direction[self.spanned :]):
            (rows,) = np.nonzero(self.slopes[:, column])
            residual = (
                c - total(float(self.slopes[i, column]) * base_direction[i] for i in rows.tolist()) if rows.size else c
            )
            # where `lifted` made the direction exactly, rounding leaves a ball that contains 0
            if not (residual.is_zero() if not rows.size else residual.contains(0)):
                raise Broken("a direction points where its set is unbounded")
        return self.base.support(base_direction)

    def _project_onto_base(self, point: Sequence[arb]) -> list[arb]:
        """Return a point projected onto the coordinates of the base."""
        projection = list(point[: self.spanned])
        for i, column in np.argwhere(self.slopes).tolist():
            projection[i] = projection[i] + float(self.slopes[i, column]) * point[self.spanned + column]
        return projection

    def holds(self, point: Sequence[arb]) -> bool:
        return self.base.holds(self._project_onto_base(point))

    def gauge(self, offsets: Sequence[arb]) -> arb:
        return self.base.gauge(self._project_onto_base(offsets))

    def compute_support_offset(self, direction: Sequence[arb]) -> list[arb]:
        return [
            *self.base.compute_support_offset(direction[: self.spanned]),
            *balls(np.zeros(self.dimension - self.spanned)),
        ]

    def bound(self, value: Array, spread: Array) -> tuple[Array, Array]:
        raise Broken("a disturbance is unbounded")


@final
class Joint(Shape):
    """A product of sets: some coordinates are in one set, the next ones in another. It serves as the set of a
    disturbance only."""

    source: Product

    def __init__(self, source: Product, parts: Sequence[Shape]) -> None:
        super().__init__(source)
        self.parts = parts
        ends = np.cumsum([0, *(factor.dimension for factor in parts)]).tolist()
        self.places = [slice(start, stop) for start, stop in pairwise(ends)]

    def support(self, direction: Sequence[arb]) -> arb:
        return total(
            factor.support(direction[columns]) for factor, columns in zip(self.parts, self.places, strict=True)
        )

    def holds(self, point: Sequence[arb]) -> bool:
        return all(factor.holds(point[columns]) for factor, columns in zip(self.parts, self.places, strict=True))

    def member(self, point: Sequence[float] | Array, near: float = NEAR) -> list[arb] | None:
        members = [factor.member(point[columns], near) for factor, columns in zip(self.parts, self.places, strict=True)]
        proven = [member for member in members if member is not None]
        return [x for member in proven for x in member] if len(proven) == len(members) else None

    def spans(self, middle: Array) -> list[tuple[list[Fraction], arb]]:
        return [
            ([*[Fraction(0)] * columns.start, *vector, *[Fraction(0)] * (self.dimension - columns.stop)], length)
            for factor, columns in zip(self.parts, self.places, strict=True)
            for vector, length in factor.spans(middle[columns])
        ]

    def summands(self, about: Array) -> list[Summand | NormSummand]:
        return [
            summand.widened(columns.start, self.dimension - columns.stop)
            for factor, columns in zip(self.parts, self.places, strict=True)
            for summand in factor.summands(about[columns])
        ]

    def bound(self, value: Array, spread: Array) -> tuple[Array, Array]:
        bounds = [
            factor.bound(value[:, columns], spread[:, columns])
            for factor, columns in zip(self.parts, self.places, strict=True)
        ]
        return np.hstack([w for w, _ in bounds]), np.sum([excess for _, excess in bounds], axis=0) * OUTWARD


def _compute_power(value: arb, exponent: arb) -> arb:
    """Return ``|value|^exponent`` with ``exponent > 0``, also for a ball that contains 0, where Arb gives none."""
    size = abs(value)
    return size**exponent if size > 0 else arb(0).union(arb(size.upper()) ** exponent)


def _bound_ellipsoid(centre: Array, S: Array, value: Array, spread: Array, power: int = 0) -> tuple[Array, Array]:
    """Return linear upper bounds of the support function of an ellipsoid with the matrix ``S``, enlarged by
    ``2^power``, as `Shape.bound` does. In the norm of the set, ``|f| - f0'f / |f0| <= |f - f0|^2 / (2 (|f0| - |f -
    f0|))``.

    Directions are scaled by powers of two, such that the largest support value of an entry is from 1/2 to 1. Otherwise
    squares of numbers below 1e-162 would be 0, and the set a point."""
    largest_support = (np.maximum(np.abs(value), spread) * np.sqrt(np.diag(S))).max(axis=1)
    shift = np.frexp(np.where(np.isfinite(largest_support), largest_support, 1.0))[1][:, None]
    value, spread = np.ldexp(value, -shift), np.ldexp(spread, -shift)
    middle = np.ldexp(centre, -power)
    square = np.maximum(np.einsum("ki,ij,kj->k", value, S, value), 0.0)
    error = ROUNDING * np.einsum("ki,ij,kj->k", np.abs(value), np.abs(S), np.abs(value))  # error by cancellation
    size = np.sqrt(square)
    safe = np.where(size > 0, size, 1.0)
    w = centre + np.ldexp(np.where(size[:, None] > 0, value @ S / safe[:, None], 0.0), power)
    change = spread @ np.sqrt(np.diag(S)) * OUTWARD
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):  # an overflow makes the bound infinite
        excess = np.where(
            change < 0.5 * size, change**2 / (2.0 * (size - change)), 2.0 * change + np.where(size > 0, 0.0, change)
        )
    shortfall = np.sqrt(square + error) - size + error / safe
    error = (excess + shortfall) * OUTWARD + 1e-14 * (size + change + np.abs(value) @ np.abs(middle))
    error = np.ldexp(error, shift[:, 0] + power)
    return w, np.where(error < LEAST, np.nextafter(error, np.inf), error)
