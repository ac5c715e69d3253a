"""Valid inequalities for the parameters of a cell, taken into the bound of a function by multipliers.

Where ``q_j >= 0`` holds on the set, ``v <= v + sum_j lambda_j q_j`` there for any ``lambda >= 0`` (weak duality). The
``q_j`` are half-spaces of the set, products of a half-space with the side of the cell that faces it (Sherali and Adams
1999), and the quadratic of a round set. The best multiplier of the quadratic is that of a trust region (More and
Sorensen 1983).
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from itertools import chain, combinations
from typing import final

import numpy as np

from sparserob_core.control.enclosures.polynomial import polynomial_bound, quadratic_part
from sparserob_core.sip.convex_set import Array, ConvexSet, bisect
from sparserob_core.sip.expressions.taylor import TaylorSpace

TOGETHER = 6  # cuts of one cell that are tried in all combinations; singly, beyond
HALVINGS = 40  # of the interval of a trust region's multiplier
TINY = 1e-300  # instead of nothing to divide by


@final
@dataclass(frozen=True, eq=False)
class Cuts:
    """Functions of ``delta in [-1, 1]^nu`` that are at least 0 wherever a cell ``centre + radius delta`` holds
    parameters of a set.

    Half-spaces ``slack - slopes delta`` with ``slopes (q, nu)`` and ``slack (q,)``, all of them crossing the cell; ``(1
    - |base + image delta|^2) / 2`` for a ``ball`` ``(base (nu,), image (nu, nu))``. ``curvature (nu,)`` estimates how
    far the set curves away from its half-spaces over the cell, along every coordinate; it only guides the halving.
    """

    slopes: Array
    slack: Array
    ball: tuple[Array, Array] | None
    curvature: Array

    def lowered(self, space: TaylorSpace, polynomials: Array, rest: Array | float) -> tuple[Array, Array]:
        """Return polynomials that are above ``polynomials (k, r, M)`` where the parameters are, and measures
        ``(k, r, nu')`` of what halving each variable would gain.

        Of some additions the one is chosen that gives the lowest bound of the sum with the ``rest (k, r, M)``.
        """
        total = polynomials + rest
        additions, multipliers = self._build_additions(space, total)
        bounds = [polynomial_bound(space, total + addition) for addition in additions]
        spreads = [spread for _, spread in bounds]
        if self.slack.size:
            spreads[1][..., : self.curvature.size] += multipliers.sum(axis=-1, keepdims=True) * self.curvature
            spreads[2] = spreads[1]  # that products bend downwards is no reason to halve
        best = np.array([heights for heights, _ in bounds]).argmin(axis=0)[None, ..., None]
        lowered = polynomials + np.take_along_axis(np.array(additions), best, axis=0)[0]
        return lowered, np.take_along_axis(np.array(spreads), best, axis=0)[0]

    def _build_additions(self, space: TaylorSpace, total: Array) -> tuple[list[Array], Array]:
        """The polynomials that are tried: none, those of the half-spaces, of their products, of the ball; and the
        multipliers ``(k, r, q)``."""
        count = self.curvature.size
        gradient, hessian = (
            array.reshape(*total.shape[:2], *array.shape[1:])
            for array in quadratic_part(space, total.reshape(-1, space.size))
        )
        gradient, hessian = gradient[..., :count], hessian[..., :count, :count]
        additions, multipliers = [np.zeros_like(total)], np.zeros((*total.shape[:2], 0))
        if self.slack.size:
            multipliers = cheapest_multipliers(self.slopes, self.slack, gradient)
            additions.append(
                _build_quadratic(space, multipliers @ self.slack, -multipliers @ self.slopes, np.zeros_like(hessian))
            )
            additions.append(_build_quadratic(space, *self._expand_products(multipliers)))
        if self.ball is not None:
            additions += [
                _build_quadratic(space, *self._expand_ball(multiplier))
                for multiplier in self._compute_ball_multipliers(gradient, hessian)
            ]
        return additions, multipliers

    def _expand_products(self, multipliers: Array) -> tuple[Array, Array, Array]:
        """``sum lambda (s - a'd)(a'd + |a|_1) / (s + |a|_1)``: nowhere on the cell above ``sum lambda (s - a'd)``. As
        value, gradient, Hessian."""
        reach = np.abs(self.slopes).sum(axis=1)
        weights = multipliers / np.maximum(self.slack + reach, TINY)
        return (
            weights @ (self.slack * reach),
            (weights * (self.slack - reach)) @ self.slopes,
            -2.0 * _sum_outer_products(weights, self.slopes),
        )

    def _expand_ball(self, multiplier: Array) -> tuple[Array, Array, Array]:
        assert self.ball is not None
        base, image = self.ball
        return (
            multiplier * (1.0 - base @ base) / 2,
            -multiplier[..., None] * (base @ image),
            -multiplier[..., None, None] * (image.T @ image),
        )

    def _compute_ball_multipliers(self, gradient: Array, hessian: Array) -> list[Array]:
        """Return two multipliers of the ball, ``(k, r)`` each.

        The first is about the best one for the quadratic part on the whole set. The second balances the slope of the
        quadratic part outwards, at the point of the sphere next to the cell.
        """
        assert self.ball is not None
        base, _ = self.ball
        inverse = self._inverse_image
        curvature = inverse.T @ hessian @ inverse
        slope = gradient @ inverse - curvature @ base
        length = np.linalg.norm(base)
        towards = base / length if length > 0 else base
        local = np.maximum((slope + curvature @ towards) @ towards, 0.0)
        values, vectors = np.linalg.eigh(curvature)
        along = np.abs(np.einsum("...ij,...i->...j", vectors, slope))
        low = np.maximum(values[..., -1], 0.0)
        _, high = bisect(
            lambda multiplier: ((along / np.maximum(multiplier[..., None] - values, TINY)) ** 2).sum(axis=-1) <= 1.0,
            low,
            low + np.linalg.norm(slope, axis=-1),
            HALVINGS,
        )
        return [high, local]

    @cached_property
    def _inverse_image(self) -> Array:
        assert self.ball is not None
        return np.asarray(np.linalg.inv(self.ball[1]), dtype=float)


def ball_of(convex: ConvexSet | None, centre: Array, radius: Array) -> tuple[Array, Array] | None:
    """Return base and image of `Cuts` for a set that is the image of the unit ball, ``{p : |L^-1 (p - middle)| <= 1}``.

    ``None`` for any other set, and where a radius of the cell is 0.
    """
    image = None if convex is None else convex.unit_ball_image()
    if image is None or not (radius > 0.0).all():
        return None
    middle, factor = image
    return np.asarray(np.linalg.solve(factor, centre - middle), dtype=float), np.asarray(
        np.linalg.solve(factor, np.diag(radius)), dtype=float
    )


def cheapest_multipliers(slopes: Array, slack: Array, gradient: Array) -> Array:
    """Return multipliers ``lambda (..., q)``, at least 0, for ``gradient (..., nu)``, the best of those that are tried.

    Better is a smaller ``lambda's + |gradient - lambda'A|_1``. It bounds ``gradient'delta`` for ``|delta_i| <= 1`` with
    ``A delta <= s`` (weak duality, for any ``lambda >= 0``). ``slopes`` is ``A (q, nu)``, ``slack`` is ``s (q,)``.
    Tried are the projections on all sets of rows of ``A``, or on single rows if these are more than `TOGETHER`. They
    are exact at a corner of the set. Tried are also the multipliers of single rows that cancel one coordinate, which
    are exact beside a corner.
    """
    q, nu = slopes.shape
    trials = [np.zeros((*gradient.shape[:-1], q))]
    largest_size = min(q, nu) if q <= TOGETHER else 1
    for chosen in chain.from_iterable(combinations(range(q), size) for size in range(1, largest_size + 1)):
        trials.append(_place_multipliers(trials[0], chosen, gradient @ np.linalg.pinv(slopes[list(chosen)])))
    for row, coordinate in np.argwhere(slopes != 0.0):
        trials.append(_place_multipliers(trials[0], (row,), gradient[..., [coordinate]] / slopes[row, coordinate]))
    multipliers = np.stack(trials, axis=-2)
    heights = multipliers @ slack + np.abs(gradient[..., None, :] - multipliers @ slopes).sum(axis=-1)
    best: Array = np.take_along_axis(multipliers, heights.argmin(axis=-1)[..., None, None], axis=-2)[..., 0, :]
    return best


def _place_multipliers(zeros: Array, chosen: tuple[int, ...], values: Array) -> Array:
    trial = zeros.copy()
    trial[..., list(chosen)] = np.maximum(np.where(np.isfinite(values), values, 0.0), 0.0)
    return trial


def _sum_outer_products(weights: Array, rows: Array) -> Array:
    """``sum_j weights_j rows_j rows_j'``, ``(..., nu, nu)``."""
    return np.asarray(np.einsum("...q,qi,qj->...ij", weights, rows, rows))


def _find_linear_monomials(space: TaylorSpace, count: int) -> list[int]:
    """Return the indices of the first ``count`` variables of a space among its monomials."""
    return [space.index[tuple(unit)] for unit in np.eye(space.nu, dtype=int)[:count].tolist()]


def _build_quadratic(space: TaylorSpace, value: Array, gradient: Array, hessian: Array) -> Array:
    """The coefficients ``(..., M)`` of ``value + gradient'd + d'hessian d / 2`` in the first variables of a space."""
    coefficients = np.zeros((*value.shape, space.size))
    coefficients[..., 0] = value
    coefficients[..., _find_linear_monomials(space, gradient.shape[-1])] = gradient
    units = np.eye(space.nu, dtype=int)[: gradient.shape[-1]]
    for i, first in enumerate(units):
        for j, second in enumerate(units):
            coefficients[..., space.index[tuple((first + second).tolist())]] += hessian[..., i, j] / 2
    return coefficients
