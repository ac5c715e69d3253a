"""Parts of the uncertainty, enclosed over cells of time, parameters and directions, and the sum of several parts.

The module holds the support function of the deviations of the initial state, and the support over a cell of directions
from the support along single directions.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from itertools import product as every_choice
from typing import Protocol, TypeAlias, final

import numpy as np

from sparserob_core.control.enclosures.comparison import block_norms, product
from sparserob_core.control.enclosures.polynomial import distinct_patterns
from sparserob_core.control.reach.disturbance_support import (
    LiftedSupport,
    PropagatedEffect,
    over_faces,
    propagate_effect,
    summed,
)
from sparserob_core.control.reach.varying_motion import OUTWARD, SpreadMotion, VaryingMotion
from sparserob_core.control.response.lifted import KNOWN, LiftedSystem
from sparserob_core.shapes import Float, shaped
from sparserob_core.sip.convex_set import Array, ConvexSet
from sparserob_core.sip.expressions.rounding import rounding
from sparserob_core.sip.expressions.taylor import Combination, TaylorSpace

Leg: TypeAlias = LiftedSystem | VaryingMotion | SpreadMotion
"""A system over a cell of parameters, or one of its phases, in each of the forms that bounds are derived from."""
# said where it is met, and before anything is solved
WITHOUT_PROOF = (
    "measurable disturbances are proven only beside parameters in a box over which the state can be expanded in them,"
    " and where it is no affine function of these only for sets with flat sides"
)
NOT_PROVEN = f"{WITHOUT_PROOF}; with disturbance_class piecewise_constant there is one"


class Support(Protocol):
    """A part of the uncertainty on functionals ``(r, d)`` over one cell, in the form of `DisturbanceSupport`."""

    def steepness(self, times: Array) -> Array:
        """Return bounds ``(k, r, nu)`` of the slope in each parameter."""

    def at(self, times: Array, ends: Array) -> tuple[Array, Array]:
        """Taylor coefficients ``(k, r, M)`` and excess ``(k, r)``."""

    def deviation(self, start: Array, widths: Array) -> Array:
        """Return bounds ``(k, r)`` of the height of the support function above its chord on cells of time
        ``[start, start + width]``."""

    @property
    def neglected(self) -> Array:
        """Bounds ``(r, L)`` of the remainder of the Taylor models on every piece."""

    @property
    def effect_bounds(self) -> Array:
        """Norm bounds ``(L, q)`` of the effect on the state on every piece, block by block."""


@dataclass(frozen=True, eq=False)
class Supports:
    """The parts of the uncertainty together: their sums, since each is maximised on its own."""

    parts: tuple[Support, ...]

    def steepness(self, times: Array) -> Array:
        """`Support.steepness` of all parts."""
        return np.asarray(sum(support.steepness(times) for support in self.parts))

    def at(self, times: Array, ends: Array) -> tuple[Array, Array]:
        """`Support.at` of all parts."""
        pairs = [support.at(times, ends) for support in self.parts]
        return np.asarray(sum(polynomial for polynomial, _ in pairs)), np.asarray(sum(excess for _, excess in pairs))

    def deviation(self, start: Array, widths: Array) -> Array:
        """`Support.deviation` of all parts."""
        return np.asarray(sum(support.deviation(start, widths) for support in self.parts))

    @cached_property
    def neglected(self) -> Array:
        """`Support.neglected` of all parts."""
        return np.asarray(sum(support.neglected for support in self.parts))

    @cached_property
    def effect_bounds(self) -> Array:
        """`Support.effect_bounds` of all parts."""
        return np.asarray(sum(support.effect_bounds for support in self.parts))


@dataclass(frozen=True, eq=False)
class InitialSupport(LiftedSupport):
    """Support function ``h(e^{A't} c)`` of a set of deviations from the initial state, for functionals ``rows (r, d)``
    (in the lifted system's coordinates) over one cell.

    The deviation is one block that acts at time 0 and never again: the bounds of `DisturbanceSupport` for a block that
    has ended hold for it.
    """

    lifted: LiftedSystem
    set: ConvexSet
    rows: Array
    combination: Combination | None = None

    def steepness(self, times: Array) -> Array:
        """Return bounds ``(k, r, nu)`` of the slope of the functional in each parameter over the cell, under *any* one
        deviation."""
        return np.asarray(self._bound_coefficients(self._apply_combination(self.blocks(times))) @ self._space.exponents)

    def at(self, times: Array, ends: Array) -> tuple[Array, Array]:
        """Taylor coefficients ``(k, r, M)`` under the worst deviation of a centre, and the excess ``(k, r)``, as in
        `DisturbanceSupport.at`."""
        return over_faces(
            self._space,
            ends,
            lambda selection, face: summed(
                self.set, self._apply_combination(self.blocks(times[selection]))[:, :, :, None], face
            )[:, :, 0],
        )

    def deviation(self, start: Array, widths: Array) -> Array:
        """Return bounds ``(k, r)`` of the height of the support function above its chord on
        ``[start, start + width]``.

        Each interval is inside one piece. Distances are summed over the Taylor coefficients, as in
        `DisturbanceSupport.deviation`.
        """
        curvature_rows = self._propagate_rows(start) @ self.lifted.row_matrix @ self.lifted.row_matrix
        sizes = self._bound_coefficients(self._weigh_deviation(curvature_rows)).sum(axis=2)
        return self._bound_chords(start, widths, sizes, self._breakpoint_bounds, np.zeros(self.lifted.starts.size))

    @cached_property
    def neglected(self) -> Array:
        """Bounds ``(r, L)`` of the remainder of the Taylor models on every piece."""
        lifted = self.lifted
        sizes, remainder = lifted.row_bounds(self.rows)
        remainders = remainder @ self._norm_bounds + sizes.sum(axis=2) @ self._error_bounds
        if self._earlier_effect is not None:
            remainders = remainders + np.einsum("rlaj,aj->rl", sizes, lifted.spilt(self._earlier_effect.sizes))
        return np.asarray(np.maximum.reduceat(remainders[:, lifted.span], lifted.ends[:-1], axis=1))

    @cached_property
    def effect_bounds(self) -> Array:
        """Norm bounds ``(L, q)`` of the effect of any deviation on every block of the coordinates on every piece."""
        peak = self.lifted.comparison.over(self.lifted.grid.lengths).peak
        return peak.on(self._breakpoint_bounds[:-1])

    def _apply_combination(self, blocks: Array) -> Array:
        return blocks if self.combination is None else self.combination.apply(blocks)

    def _bound_coefficients(self, blocks: Array) -> Array:
        """Return bounds ``(k, r, M)`` of the absolute value of every Taylor coefficient under any one deviation, from
        weights ``(k, r, M, d)``."""
        return np.asarray(self.set.reach(blocks))

    def blocks(self, times: Array) -> Array:
        """Taylor coefficients ``(k, r, M, d)`` of the weights on the deviation, in the coordinates of its set."""
        return self._weigh_deviation(self._propagate_rows(times))

    def _weigh_deviation(self, rows: Array) -> Array:
        """Lifted rows ``(k, r, M d)`` as Taylor coefficients of weights on the deviation ``(k, r, M, d)``."""
        space = self.lifted.space
        coefficients = rows.reshape(*rows.shape[:2], space.size, self.lifted.states)
        if self._earlier_effect is None:
            return np.asarray(coefficients @ self.lifted.decoupling.inverse.astype(float))
        weights, effect = np.zeros((*coefficients.shape[:-1], self.set.dimension)), self._earlier_effect.effect
        for left, right, target in zip(*space.products, strict=True):
            weights[..., target, :] += coefficients[..., right, :] @ effect[left]
        return weights

    @property
    def _earlier_effect(self) -> PropagatedEffect | None:
        """The effect of a deviation on the state before a later phase begins, ``effect (M, d, d)``; ``None`` in the
        first phase."""
        past = self.lifted.past
        if past is None:
            return None
        earlier_effect = past.effects.get(id(self.set))
        if not isinstance(earlier_effect, PropagatedEffect):
            d = past.turn.shape[0]
            earlier_support = InitialSupport(past.lifted, self.set, np.eye(d))
            radii = self.set.reach(np.eye(self.set.dimension))
            effect = earlier_support.blocks(past.lifted.grid.breakpoints[-1:])[0]  # (d, M, d)
            earlier_effect = past.effects[id(self.set)] = propagate_effect(
                past,
                self.set,
                effect,
                np.abs(effect) @ radii,
                earlier_support._breakpoint_bounds[-1],
                earlier_support.neglected[:, -1],
            )
        return earlier_effect

    def _propagate_rows(self, times: Array) -> Array:
        """The lifted functionals that ``c'x(t)`` are of the state at time 0, ``(k, r, M d)``."""
        grid = self.lifted.grid
        pieces = np.clip(np.searchsorted(grid.breakpoints, times, side="right") - 1, 0, grid.pieces - 1)
        return self.lifted.flown(self._node_rows[pieces], times - grid.breakpoints[pieces])[0]

    @cached_property
    def _node_rows(self) -> Array:
        """The lifted functionals at the breakpoints of the grid, ``(L + 1, r, M d)``."""
        backward = self.lifted.backward
        steps, pieces = backward.steps(KNOWN), self.lifted.grid.pieces
        rows = np.empty((pieces + 1, *self._lifted_rows.shape))
        rows[0] = self._lifted_rows
        for piece, length in enumerate(backward.which.tolist()):
            rows[piece + 1] = rows[piece] @ steps.Phi[0, length]
        return rows

    @cached_property
    def _norm_bounds(self) -> Array:
        """Norm bounds ``(q,)`` of every block of the coordinates of any deviation, at the beginning of this phase."""
        if self._earlier_effect is not None:
            return self._earlier_effect.effect_bounds
        radii = self.set.reach(np.eye(self.set.dimension))
        return (
            block_norms(np.abs(self.lifted.decoupling.inverse).astype(float) @ radii, self.lifted.starts)
            + self._error_bounds
        )

    @cached_property
    def _error_bounds(self) -> Array:
        """Norm bounds ``(q,)`` of the rounding error of every block of a deviation, from the coordinates; in a later
        phase, of the remainder of the Taylor models at its beginning."""
        if self._earlier_effect is not None:
            return self._earlier_effect.remainder
        decoupling = self.lifted.decoupling
        radii = self.set.reach(np.eye(self.set.dimension))
        if decoupling.is_identity:
            return np.zeros(self.lifted.starts.size)
        # of V rounded to double precision, and of the defect of V: entry by entry, however a deviation points
        size = np.abs(decoupling.inverse).astype(float) @ radii
        errors = np.finfo(float).eps * size + decoupling.defect.astype(float) @ size
        return block_norms(1.001 * errors, self.lifted.starts)

    @cached_property
    def _breakpoint_bounds(self) -> Array:
        """Norm bounds ``(L + 1, q)`` of the effect of any deviation on every block at the breakpoints."""
        grid = self.lifted.grid
        flow = self.lifted.comparison.over(grid.lengths).flow
        return flow.summed(self._norm_bounds, np.zeros((grid.pieces, self._norm_bounds.size)))


class KnownCellSupport:
    """A part of the uncertainty on functionals ``rows (r, d)`` of a *known* system, in the form of `Support`."""

    rows: Array

    @shaped
    def steepness(self, times: Float[Array, " k"]) -> Float[Array, "k r 0"]:
        """Return the slopes in the parameters, an empty array ``(k, r, 0)``, since a known system has none."""
        return np.zeros((times.size, self.rows.shape[0], 0))

    def repeated(self, times: Array) -> tuple[Array, Array]:
        """Return all pairs of a time and a row: the times ``(k r,)`` and the rows ``(k r, d)``."""
        return np.repeat(times, self.rows.shape[0]), np.tile(self.rows, (times.size, 1))

    def between(self, bounds: Array) -> tuple[Array, Array]:
        """Return the middle ``(k, r, 1)`` of bounds ``(k r, 2)``, and their distance from it, ``(k, r)``."""
        bounds = bounds.reshape(-1, self.rows.shape[0], 2)
        return bounds.mean(axis=2)[..., None], (bounds[..., 1] - bounds[..., 0]) / 2 * (1.0 + rounding(4))


@final
@dataclass(frozen=True, eq=False)
class DirectionsCellSupport:
    """A part of the uncertainty of a *known* system on one functional over a cell of directions, in the form of
    `Support`.

    The directions are ``c = rows[0] + sum_j eta_j rows[j]`` with ``|eta_j| <= 1``. ``made`` gives the part on rows
    ``(r, d)``, and ``joined`` the monomials.

    The part is a support function, or a sum of support functions with factors that are not negative: sublinear in
    ``c``. So, in one coordinate after another, the part is at most the linear interpolation of its values at the
    corners. Its distance from its chord in time is a mean of differences ``h(y(s)) - h(y(r))`` with ``y`` linear in
    ``c``, each at most the sum of the differences of the rows. So the bounds of the distance, and of the remainder, add
    up.
    """

    made: Callable[[Array], Support]
    rows: Array
    leg: Leg
    joined: Combination

    @shaped
    def steepness(self, times: Float[Array, " k"]) -> Float[Array, "k 1 nu"]:
        """Return the bounds of `Support.steepness`: the largest support value along a row, or against it, and at least
        0."""
        axes = self.rows[1:]
        # powers of two of one row are asked for again in every smaller cell
        sizes = np.exp2(np.frexp(np.abs(axes).max(axis=1, initial=0.0))[1])
        axes = axes / sizes[:, None]
        values, error_bounds = self._evaluate_rows(times, np.vstack([axes, -axes]))
        largest = np.maximum(values + error_bounds, 0.0).reshape(times.size, 2, len(axes)).max(axis=1)
        return np.asarray((largest * sizes * OUTWARD)[:, None])

    @shaped
    def at(
        self, times: Float[Array, " k"], ends: Float[Array, "k 1 nu"]
    ) -> tuple[Float[Array, "k 1 M"], Float[Array, "k 1"]]:
        """Return the coefficients and the excess of `Support.at`.

        The loss in the middle of the cell is a part of the excess, since smaller cells lose less.
        """
        coefficients, excess = np.zeros((times.size, 1, self.joined.space.size)), np.zeros((times.size, 1))
        patterns, pattern_indices = distinct_patterns(ends)
        for position, pattern in enumerate(patterns):
            members = np.flatnonzero(pattern_indices[:, 0] == position)
            corners = _list_corners(pattern)
            values, error_bounds = self._evaluate_rows(
                times[members], self.rows[0] + np.vstack([pattern, corners]) @ self.rows[1:]
            )
            interpolation, truncation = between_corners(self.joined.space, pattern, values[:, 1:])
            middle_loss = np.maximum(values[:, 1:].mean(axis=1) - values[:, 0], 0.0)
            rounding_errors = rounding(len(corners) + 4) * np.abs(values).max(axis=1)
            interpolation[:, 0] -= middle_loss
            coefficients[members, 0] = interpolation
            excess[members, 0] = (
                error_bounds[:, 1:].max(axis=1) + truncation + middle_loss + rounding_errors
            ) * OUTWARD
        return coefficients, excess

    @shaped
    def deviation(self, start: Float[Array, " k"], widths: Float[Array, " k"]) -> Float[Array, "k r"]:
        """`Support.deviation` of every row."""
        return self._row_support.deviation(start, widths)

    @cached_property
    def neglected(self) -> Array:
        """Bounds ``(r, L)`` of `Support.neglected` of every row, with the rounding of the corners."""
        sizes = block_norms(np.abs(self.rows) @ np.abs(self.leg.transform), self.leg.starts)
        return np.asarray(self._row_support.neglected + rounding(len(self.rows)) * product(sizes, self.effect_bounds.T))

    @cached_property
    def effect_bounds(self) -> Array:
        """`Support.effect_bounds`."""
        return self._row_support.effect_bounds

    @cached_property
    def _row_support(self) -> Support:
        return self.made(self.rows)

    def _evaluate_rows(self, times: Array, rows: Array) -> tuple[Array, Array]:
        """Return the support values along ``rows (r, d)``, and their error bounds, ``(k, r)`` each."""
        coefficients, error_bounds = self.made(rows).at(times, np.zeros((times.size, len(rows), 0)))
        return coefficients[..., 0], error_bounds


def over_directions(made: Callable[[Array], Support], rows: Array, leg: Leg, joined: Combination | None) -> Support:
    """Return the support on functionals, or on the direction that they make up where they are ``joined``.

    Parameters
    ----------
    made : Callable
        The support as a function of functionals ``(r, d)``.
    rows : Array
        Functionals ``(r, d)``.
    leg : Leg
        The system, or a phase of a switched system.
    joined : Combination or None
        How the rows make up one direction that varies over a cell.

    Returns
    -------
    Support
        The support.
    """
    return made(rows) if joined is None else DirectionsCellSupport(made, rows, leg, joined)


def _list_corners(pattern: Array) -> Array:
    """The corners ``(n, nu)`` of the face of ``[-1, 1]^nu`` on which the coordinates with an end in ``pattern (nu,)``
    are at it."""
    free = np.flatnonzero(pattern == 0.0)
    signs = np.array(list(every_choice((-1.0, 1.0), repeat=free.size)))
    corners = np.tile(pattern, (len(signs), 1))
    corners[:, free] = signs
    return corners


def between_corners(space: TaylorSpace, pattern: Array, values: Array) -> tuple[Array, Array]:
    """Return the interpolation of values at the corners of a face that is linear in every coordinate.

    Parameters
    ----------
    space : TaylorSpace
        The polynomials, of ``M`` coefficients.
    pattern : Array
        The face ``(nu,)``: -1 or 1 for a coordinate at an end, else 0.
    values : Array
        Values ``(q, n)`` at the `_list_corners` of the face.

    Returns
    -------
    Array, Array
        Coefficients ``(q, M)``; and bounds ``(q,)`` of how far the interpolation is above them, by products that are
        not in the space and by rounding.
    """
    corners, free = _list_corners(pattern), np.flatnonzero(pattern == 0.0)
    coefficients = np.zeros((len(values), space.size))
    truncation = len(corners) * rounding(2 * len(corners) + 8) * np.abs(values).max(axis=1)
    for chosen in every_choice((0, 1), repeat=free.size):
        coefficient = values @ corners[:, free[np.flatnonzero(chosen)]].prod(axis=1) / len(corners)
        exponents = np.zeros(space.nu, dtype=int)
        exponents[free] = chosen
        index = space.index.get(tuple(exponents.tolist()))
        if index is None:  # of more coordinates than there are degrees
            truncation = truncation + np.abs(coefficient)
        else:
            coefficients[:, index] = coefficient
    return coefficients, truncation
