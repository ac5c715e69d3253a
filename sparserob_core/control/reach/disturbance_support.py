"""Support function of the disturbance on functionals of the state, enclosed over a cell of parameters."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property, partial

import numpy as np

from sparserob_core.control.enclosures.comparison import block_norms, product
from sparserob_core.control.enclosures.polynomial import distinct_patterns, face_of
from sparserob_core.control.response.disturbance import DisturbanceModel
from sparserob_core.control.response.lifted import LiftedSystem, Past
from sparserob_core.control.response.response import Impulses
from sparserob_core.sip.convex_set import Array, ConvexSet
from sparserob_core.sip.expressions.rounding import rounding
from sparserob_core.sip.expressions.taylor import Combination, Face, TaylorSpace

AT_ONCE = 4_000_000  # numbers that are summed over all ages at once
SAME = 1e-9  # of a piece: a time that is not as near to its end is inside
KEPT = 8_000_000  # numbers of sums over all ages, up to which they are remembered


class LiftedSupport:
    """A part of the uncertainty that acts in blocks, on functionals ``rows (r, d)`` in the coordinates of a ``lifted``
    system; with a ``combination`` they make up one direction that varies over a cell."""

    lifted: LiftedSystem
    rows: Array
    combination: Combination | None

    @property
    def _space(self) -> TaylorSpace:
        return (self.combination or self.lifted).space

    @cached_property
    def _lifted_rows(self) -> Array:
        rows = np.zeros((self.rows.shape[0], self.lifted.row_matrix.shape[0]))
        rows[:, : self.lifted.states] = self.rows
        return rows

    @cached_property
    def _curvature_terms(self) -> tuple[Array, Array, Array, Array, Array]:
        """Quantities of `deviation` that do not depend on time: the lifted functionals times the square of the matrix;
        the block norms ``(r, q)`` of their first derivative, of their second derivative, and of the functionals
        themselves; and the square of the block sizes."""
        lifted, rows = self.lifted, self._lifted_rows
        slope_rows, curvature_rows = rows @ lifted.row_matrix, rows @ lifted.row_matrix @ lifted.row_matrix
        slope_norms, curvature_norms = (
            block_norms(derivative.reshape(*derivative.shape[:-1], -1, lifted.states), lifted.starts).sum(axis=-2)
            for derivative in (slope_rows, curvature_rows)
        )
        sizes = lifted.comparison.sizes
        return curvature_rows, slope_norms, curvature_norms, block_norms(self.rows, lifted.starts), sizes @ sizes

    def _bound_chords(self, start: Array, widths: Array, sizes: Array, ended_bounds: Array, drive: Array) -> Array:
        """Return bounds ``(k, r)`` of the distance of the support function from its chord on
        ``[start, start + width]``, inside one piece.

        A block that has ended has ``y(r) = c e^{A r} z``, the one that lasts ``y' = c e^{A r} W``. The distance is at
        most ``width^2 / 8`` of the largest second derivative, and mode by mode at most twice the total change. The
        latter bound serves fast modes, which have died away long before a cell is as short as they are.

        Given are bounds ``sizes (k, r)`` of the second derivative at the start, from the blocks that have ended, and
        norm bounds ``ended_bounds (L + 1, q)`` of their effect until each breakpoint. The norm bounds ``drive (q,)``
        are of the rate at which the block that lasts drives the coordinates.
        """
        grid, comparison = self.lifted.grid, self.lifted.comparison
        _, slope_norms, curvature_norms, norms, squared = self._curvature_terms
        pieces = np.minimum(np.maximum(grid.breakpoints.searchsorted(start, side="right") - 1, 0), grid.pieces - 1)
        flow = comparison.over(start - grid.breakpoints[pieces], cells=True).flow
        reach = comparison.over(widths, cells=True)
        current_sizes = flow.on(np.broadcast_to(drive, (start.size, drive.size)))
        ended_sizes = flow.on(ended_bounds[pieces])
        square = (widths**2 / 8)[:, None]
        exact = square * (
            sizes
            + product(curvature_norms, reach.departure.on(ended_sizes).T).T
            + product(slope_norms, reach.peak.on(current_sizes).T).T
        )
        ended = np.minimum(
            square * product(reach.peak.on(ended_sizes), squared.T),
            2.0 * product(reach.integral.on(ended_sizes), comparison.sizes.T),
        )
        current = np.minimum(
            square * product(reach.peak.on(current_sizes), comparison.sizes.T),
            2.0 * reach.integral.on(current_sizes),
        )
        by_mode = product(norms, (ended + current).T).T
        return np.asarray(np.minimum(exact, by_mode))


@dataclass(frozen=True, eq=False)
class DisturbanceSupport(LiftedSupport):
    """The support function ``sigma(t) = sum_b h_D(y_b(t))`` of functionals ``rows (r, d)`` (in the lifted system's
    coordinates) over one cell.

    ``y_b`` is a polynomial in the parameters; ``h_D(y_b)`` is its value at the worst disturbance of the cell's centre,
    plus an excess that is zero wherever that disturbance stays the worst on the whole cell.
    """

    lifted: LiftedSystem
    disturbance: DisturbanceModel
    rows: Array
    combination: Combination | None = None

    def steepness(self, times: Array) -> Array:
        """Return bounds ``(k, r, nu)`` of the slope of the functionals in each parameter over the cell, under *any* one
        disturbance."""
        bounds = self._sum_over_blocks(times, self._bound_coefficients)
        return np.asarray(bounds @ self._space.exponents[self._monomials])

    def at(self, times: Array, ends: Array) -> tuple[Array, Array]:
        """Taylor coefficients ``(k, r, M)`` of the support function under the worst disturbance of a centre, and its
        excess ``(k, r)``.

        ``ends (k, r, nu)``: parameters that are known to be at an end of the cell (-1 or 1); the centre is that of the
        face they leave.
        """
        return over_faces(
            self._space,
            ends,
            lambda selection, face: self._sum_over_blocks(
                times[selection], partial(self._majorise_blocks, face=face), kept="worst" if face is None else ""
            ),
        )

    def _majorise_blocks(self, blocks: Array, face: Face | None) -> Array:
        return summed(self.disturbance.set, blocks, face, self._monomials, self._space.size)

    def deviation(self, start: Array, widths: Array) -> Array:
        """Return bounds ``(k, r)`` of the height of the support function above its chord, for times in
        ``[start, start + width]`` inside one piece.

        The height is at most the distance of the weights ``y`` on the blocks from their chords, times any disturbance,
        summed over blocks and Taylor coefficients.
        """
        curvature_rows = self._curvature_terms[0]
        sizes = self._sum_over_blocks(
            start, self._bound_coefficients, curvature_rows, plain=True, kept="curvature"
        ).sum(axis=2)
        return self._bound_chords(start, widths, sizes, self._breakpoint_bounds, self._drive)

    @cached_property
    def neglected(self) -> Array:
        """Bounds ``(r, L)`` of the remainder of the Taylor models on every piece.

        The effect of a disturbance before this phase of a switched system adds three parts to the remainder of its
        product with a row: the remainder of the row, the remainder of the effect itself, and the terms of too high a
        degree.
        """
        lifted, radius = self.lifted, self.disturbance.radius
        sizes, remainder = lifted.row_bounds(self.rows, self._has_uniform_blocks)
        truncation = lifted.spilt(_compute_row_norms(lifted.W, lifted.starts)) + np.linalg.norm(lifted.slack_W, axis=1)
        rates = remainder @ self._drive + radius * np.einsum("rlaj,aj->rl", sizes, truncation)
        within = np.cumsum(rates[:, lifted.span] * lifted.fine.lengths, axis=1)[:, lifted.ends[1:] - 1]
        earlier_effect = self._earlier_effect
        if earlier_effect is None:
            return np.asarray(within)
        earlier_errors = (
            remainder @ (earlier_effect.effect_bounds + earlier_effect.remainder)
            + sizes.sum(axis=2) @ earlier_effect.remainder
        )
        earlier_errors = earlier_errors + np.einsum("rlaj,aj->rl", sizes, lifted.spilt(earlier_effect.sizes))
        return np.asarray(within + np.maximum.reduceat(earlier_errors[:, lifted.span], lifted.ends[:-1], axis=1))

    @property
    def effect_bounds(self) -> Array:
        """Norm bounds ``(L, q)`` of the effect of any disturbance on every block of the coordinates until the end of
        every piece."""
        return self._breakpoint_bounds[1:]

    @property
    def _has_uniform_blocks(self) -> bool:
        """True where the blocks are the pieces of a uniform grid, so that what a block receives depends only on its age
        ``t - s``."""
        alone = self.lifted.grid.pieces == self.disturbance.grid.pieces  # not one leg of several
        return alone and self.lifted.backward.uniform and self.disturbance.by_piece

    def _sum_over_blocks(
        self,
        times: Array,
        of_blocks: Callable[[Array], Array],
        rows: Array | None = None,
        plain: bool = False,
        kept: str = "",
    ) -> Array:
        """Sums over the blocks of a function of them: from blocks ``(k, r, M, nb, q)`` to parts ``(k, r, nb, j)``;
        returns ``(k, r, j)``.

        ``rows (r, M d)``: the lifted functionals, the support function's own unless given; ``plain``: leave them
        uncombined; ``kept``: a name by which sums over the ages of whole pieces are remembered.
        """
        start = self._lifted_rows if rows is None else rows
        combined = (lambda blocks: blocks) if plain else self._stack_functionals
        if not self._has_uniform_blocks:
            return np.asarray(of_blocks(combined(self._weigh_blocks(times, start))).sum(axis=2))
        grid = self.lifted.grid
        pieces = grid.locate(times)
        within, duration_indices = grid.distinct(times - grid.breakpoints[pieces])
        if within.size == 1 and kept and self._is_at_breakpoint(float(within[0])):
            key = (kept, float(within[0]))
            if key not in self._cached_sums:
                sums = self._sum_by_age(within, grid.pieces - 1, start, lambda blocks: of_blocks(combined(blocks)))
                if sums.size > KEPT:
                    return np.asarray(sums[duration_indices, :, pieces])
                self._cached_sums[key] = sums
            return np.asarray(self._cached_sums[key][duration_indices, :, pieces])
        count = int(pieces.max(initial=0))
        chunk_size = max(1, AT_ONCE // max(1, start.shape[0] * count * self._impulses.columns.shape[1]))
        answer = None
        for begin in range(0, within.size, chunk_size):
            chunk = slice(begin, begin + chunk_size)
            chunk_sums = self._sum_by_age(within[chunk], count, start, lambda blocks: of_blocks(combined(blocks)))
            if chunk_size >= within.size:
                return np.asarray(chunk_sums[duration_indices, :, pieces])
            members = np.flatnonzero((duration_indices >= chunk.start) & (duration_indices < chunk.stop))
            if answer is None:
                answer = np.empty((times.size, chunk_sums.shape[1], chunk_sums.shape[3]))
            answer[members] = chunk_sums[duration_indices[members] - begin, :, pieces[members]]
        assert answer is not None
        return answer

    def _is_at_breakpoint(self, within: float) -> bool:
        """Return whether a time within a piece is its beginning or, up to the share `SAME` of it, its end."""
        length = float(self.lifted.backward.propagator.lengths[0])
        return within == 0.0 or abs(within - length) <= SAME * length

    @cached_property
    def _cached_sums(self) -> dict[tuple[str, float], Array]:
        return {}

    def _sum_by_age(self, within: Array, count: int, start: Array, of_blocks: Callable[[Array], Array]) -> Array:
        """The sums of `_sum_over_blocks` at such times ``within (q,)`` of the pieces ``0, ..., count``,
        ``(q, r, count + 1, j)``, since what a block receives depends on its age."""
        propagated_rows, gains = self.lifted.flown(np.broadcast_to(start, (within.size, *start.shape)), within)
        current_weights = self._weigh_disturbance(gains)[..., None, :]
        ended_weights = self._impulses.of(propagated_rows, count)
        ended_weights = ended_weights.reshape(
            *ended_weights.shape[:-1], current_weights.shape[2], current_weights.shape[4]
        ).swapaxes(-2, -3)
        return np.asarray(np.concatenate([of_blocks(current_weights), of_blocks(ended_weights)], axis=2).cumsum(axis=2))

    @cached_property
    def _impulses(self) -> Impulses:
        """Contributions of the disturbance on a piece to the Taylor coefficients of a functional, by the age of the
        piece."""
        weights = self._weigh_disturbance(np.eye(self.lifted.row_matrix.shape[0]))
        return Impulses(self.lifted.backward.propagator, weights.reshape(weights.shape[0], -1))

    def _stack_functionals(self, blocks: Array) -> Array:
        """Coefficients ``(k, r, M, nb, q)`` as those of the polynomials whose sums are taken: of the one of a direction
        that varies, ``(k, 1, r M, nb, q)``, whose other coefficients are 0."""
        k, r, size, *block_shape = blocks.shape
        return blocks if self.combination is None else blocks.reshape(k, 1, r * size, *block_shape)

    @cached_property
    def _monomials(self) -> np.ndarray:
        """Indices, in the space, of the monomials of the coefficients of `_stack_functionals`, the constant one
        first."""
        return np.arange(self._space.size) if self.combination is None else self.combination.targets.reshape(-1)

    def _bound_coefficients(self, blocks: Array) -> Array:
        """Return bounds ``(k, r, nb, M)`` of the absolute value of every Taylor coefficient of every block under any
        one disturbance."""
        return self.disturbance.set.reach(blocks).swapaxes(2, 3)

    def blocks(self, times: Array) -> Array:
        """Taylor coefficients ``(k, r, M, nb, q)`` of what the functionals give to every block."""
        return self._weigh_blocks(times, self._lifted_rows)

    def _weigh_blocks(self, times: Array, rows: Array) -> Array:
        """Taylor coefficients ``(k, r, M, nb, q)`` of what functionals that start as lifted ``rows (r, M d)`` give to
        every block."""
        return self.disturbance.blocks(np.moveaxis(self.on_pieces(times, rows), 3, 2))

    def on_pieces(self, times: Array, rows: Array) -> Array:
        """Taylor coefficients ``(k, r, L, M, mw)`` of what functionals that start as lifted ``rows (r, M d)`` give to
        the disturbance on every piece of the whole grid."""
        k, r = times.size, rows.shape[0]
        free, gains, _, _ = self.lifted.backward.adjoint(
            np.repeat(times, r), np.tile(rows, (k, 1)), np.zeros((k * r, 0))
        )
        weights = self._weigh_disturbance(gains.reshape(k, r, gains.shape[1], -1))
        first, piece_count = self.lifted.first, self.disturbance.grid.pieces
        if piece_count == weights.shape[2]:
            return weights
        all_weights = np.zeros((k, r, piece_count, *weights.shape[3:]))
        all_weights[:, :, first : first + weights.shape[2]] = weights
        if self._earlier_effect is not None:
            space, effect = self.lifted.space, self._earlier_effect.effect
            row_coefficients = free.reshape(k, r, space.size, -1)
            for left, right, target in zip(*space.products, strict=True):
                all_weights[:, :, :first, target] += np.einsum(
                    "krd,dlw->krlw", row_coefficients[:, :, right], effect[left]
                )
        return all_weights

    @property
    def _earlier_effect(self) -> PropagatedEffect | None:
        past = self.lifted.past
        if past is None:
            return None
        earlier_effect = past.effects.get(id(self.disturbance))
        if not isinstance(earlier_effect, PropagatedEffect):
            earlier_effect = past.effects[id(self.disturbance)] = _propagate_disturbance(past, self.disturbance)
        return earlier_effect

    def _weigh_disturbance(self, gains: Array) -> Array:
        """Gains ``(..., M d)`` on the state's drive, as Taylor coefficients ``(..., M, mw)`` of the weights on the
        disturbance."""
        space = self.lifted.space
        coefficients = gains.reshape(*gains.shape[:-1], space.size, self.lifted.states)
        if space.size == 1:
            return np.asarray(coefficients @ self.lifted.W[0])
        weights = np.zeros((*coefficients.shape[:-1], self.lifted.W.shape[2]))
        is_used = [matrix.any() for matrix in self.lifted.W]
        for left, right, target in zip(*space.products, strict=True):
            if is_used[left]:
                weights[..., target, :] += coefficients[..., right, :] @ self.lifted.W[left]
        return weights

    @cached_property
    def before(self) -> Array:
        """Norm bounds ``(q,)`` of the effect of any disturbance before time 0 on every block of the coordinates."""
        return np.zeros(self.lifted.starts.size) if self._earlier_effect is None else self._earlier_effect.effect_bounds

    @cached_property
    def _drive(self) -> Array:
        """Norm bounds ``(q,)`` of the rate at which any admissible disturbance drives every block of the
        coordinates."""
        norms = _compute_row_norms(self.lifted.W, self.lifted.starts).sum(axis=0)
        return np.asarray(self.disturbance.radius * (norms + np.linalg.norm(self.lifted.slack_W, axis=1)))

    @cached_property
    def _breakpoint_bounds(self) -> Array:
        """Norm bounds ``(L+1, q)`` of the effect of any disturbance until each breakpoint on every block: in the
        comparison system ``int_0^t e^{M s} |W| ds``, plus the growth of `before`."""
        grid = self.lifted.grid
        reach = self.lifted.comparison.over(grid.lengths)
        drive_effects = reach.integral.on(np.broadcast_to(self._drive, (grid.pieces, self._drive.size)))
        return reach.flow.summed(self.before, drive_effects)


@dataclass(frozen=True, eq=False)
class PropagatedEffect:
    """The effect of a part of the uncertainty on the state before a phase of a switched system begins.

    ``effect (M, d, ...)`` are Taylor coefficients of the effect per unit, in the coordinates of the phase. The bounds
    hold block by block for all admissible values: ``sizes (M, q)`` of the norms of the coefficients, ``effect_bounds
    (q,)`` of the whole effect, and ``remainder (q,)`` of the remainder of the coefficients. ``of`` is the part of the
    uncertainty.
    """

    of: object
    effect: Array
    sizes: Array
    effect_bounds: Array
    remainder: Array


def propagate_effect(
    past: Past, of: object, old: Array, entries: Array, effect_bounds: Array, neglected: Array
) -> PropagatedEffect:
    """Return the effect of a part of the uncertainty at the beginning of a phase, from bounds at the end of the phase
    before.

    Parameters
    ----------
    past : Past
        The phase before, and the change of coordinates.
    of : object
        The part of the uncertainty.
    old : Array
        Effect ``(d, M, ...)`` per unit, in the coordinates of the phase before.
    entries : Array
        Bounds ``(d, M)`` of the coefficients of the effect.
    effect_bounds : Array
        Norm bounds ``(q',)`` of the whole effect, block by block.
    neglected : Array
        Bounds ``(d,)`` of the remainder of every coordinate.

    Returns
    -------
    PropagatedEffect
        The effect in the coordinates of the phase that begins.
    """
    effect = np.moveaxis(np.tensordot(past.turn, old, axes=1), 1, 0)
    terms = rounding(2 * past.turn.shape[0] + old[0].size)
    sizes = (1.0 + terms) * block_norms((np.abs(past.turn) @ entries).T, past.starts)
    bounds = product(past.blocks, effect_bounds[:, None])[:, 0]
    error_bounds = block_norms(np.abs(past.turn) @ neglected, past.starts) * (1.0 + terms)
    return PropagatedEffect(
        of, effect, sizes, bounds, error_bounds + past.rounded(entries.sum(axis=1)) + terms * bounds
    )


def _propagate_disturbance(past: Past, disturbance: DisturbanceModel) -> PropagatedEffect:
    lifted, d = past.lifted, past.turn.shape[0]
    earlier_support, rows = DisturbanceSupport(lifted, disturbance, np.eye(d)), np.eye(d, lifted.row_matrix.shape[0])
    first = lifted.first + lifted.grid.pieces
    effect = earlier_support.on_pieces(lifted.grid.breakpoints[-1:], rows)[0, :, :first]  # (d, L, M, mw)
    entries = disturbance.radius * np.linalg.norm(effect, axis=3).sum(axis=1)
    return propagate_effect(
        past,
        disturbance,
        effect.swapaxes(1, 2),
        entries,
        earlier_support.effect_bounds[-1],
        earlier_support.neglected[:, -1],
    )


def over_faces(
    space: TaylorSpace, ends: Array, parts: Callable[[np.ndarray | slice, Face | None], Array]
) -> tuple[Array, Array]:
    """Return coefficients ``(k, r, M)`` and excess ``(k, r)`` where every functional has its own pattern of ``ends``.

    Parameters
    ----------
    space : TaylorSpace
        The polynomials, of ``M`` coefficients.
    ends : Array
        Patterns ``(k, r, nu)``: -1 or 1 for a parameter at an end of the cell, else 0.
    parts : Callable
        ``parts(selection, face)`` gives coefficients and excess as ``(k', r, M + 1)`` on one face of the cell, for the
        times at ``selection``, a mask or a slice.

    Returns
    -------
    Array, Array
        The coefficients and the excess.
    """
    if not space.nu:
        values = parts(slice(None), None)
        return values[..., :-1], values[..., -1]
    k, r, _ = ends.shape
    patterns, pattern_indices = distinct_patterns(ends)
    coefficients, excess = np.empty((k, r, space.size)), np.empty((k, r))
    for position, pattern in enumerate(patterns):
        face = face_of(space, pattern) if pattern.any() else None
        selection = (pattern_indices == position).any(axis=1)
        values = parts(selection, face)
        is_on_face = pattern_indices[selection] == position
        coefficients[pattern_indices == position], excess[pattern_indices == position] = (
            values[is_on_face][:, :-1],
            values[is_on_face][:, -1],
        )
    return coefficients, excess


def summed(
    bound: ConvexSet, blocks: Array, face: Face | None, monomials: np.ndarray | None = None, size: int = 0
) -> Array:
    """Return the polynomial of each block at the worst point of a set for the centre, with the excess as one more
    entry.

    Parameters
    ----------
    bound : ConvexSet
        The set in which each block is.
    blocks : Array
        Taylor coefficients ``(k, r, M, nb, q)``.
    face : Face, optional
        A face of the cell; only monomials of the variables that it leaves free are then looked at.
    monomials : array, optional
        Indices ``(M,)`` of the monomials, where the coefficients are not all of a space. The others are 0, in many
        dimensions most of them.
    size : int
        Number of monomials of the space, where ``monomials`` are given.

    Returns
    -------
    Array
        Coefficients and excess, ``(k, r, nb, size + 1)``, where ``size`` is ``M`` without ``monomials``.
    """
    k, r, monomial_count, count, width = blocks.shape
    kept = np.arange(monomial_count) if monomials is None else monomials
    if face is not None:
        kept, onto = face.onto(kept)
        blocks = (onto @ blocks.reshape(k, r, monomial_count, count * width)).reshape(k, r, kept.size, count, width)
    size = monomial_count if monomials is None else size
    polynomials = np.zeros((k, r, count, size + 1))
    if kept.size > 1:
        point, polynomials[..., -1] = bound.support_majorant(blocks[:, :, 0], np.moveaxis(blocks[:, :, 1:], 2, 3))
    else:
        point = bound.support_point(blocks[:, :, 0])
    polynomials[..., kept] = np.einsum("krbq,krabq->krba", point, blocks)
    return polynomials


def _compute_row_norms(coefficients: Array, starts: np.ndarray) -> Array:
    """Return the Frobenius norms ``(M, q)`` of the blocks of rows of matrices ``(M, d, mw)``."""
    return np.asarray(np.sqrt(np.add.reduceat((coefficients**2).sum(axis=2), starts, axis=1)))
