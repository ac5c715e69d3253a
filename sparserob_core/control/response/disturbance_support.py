"""How far the worst disturbance pushes a functional of the state, enclosed over a cell of parameters."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property, partial

import numpy as np

from sparserob_core.control.enclosures.combination import Combination
from sparserob_core.control.enclosures.polynomial import distinct_patterns, face_matrix
from sparserob_core.control.enclosures.taylor import TaylorSpace
from sparserob_core.control.response.disturbance import DisturbanceModel
from sparserob_core.control.response.lifted import KNOWN, LiftedSystem, grown, grown_less_one
from sparserob_core.sip.convex_set import Array


@dataclass(frozen=True, eq=False)
class DisturbanceSupport:
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
        """How steep the support function of *any* one disturbance can be in each parameter over the cell:
        ``(k, r, nu)``."""
        return self._gathered(times, self._reaches) @ self._space.exponents

    def at(self, times: Array, ends: Array) -> tuple[Array, Array]:
        """Taylor coefficients ``(k, r, M)`` of the support function under the worst disturbance of a centre, and its
        excess ``(k, r)``.

        ``ends (k, r, nu)``: parameters that are known to be at an end of the cell (-1 or 1); the centre is that of the
        face they leave.
        """
        k, r, _ = ends.shape
        patterns, which = distinct_patterns(ends)
        coefficients, excess = np.empty((k, r, self._space.size)), np.empty((k, r))
        for position, pattern in enumerate(patterns):
            face = face_matrix(self._space, pattern) if pattern.any() else None
            here = (which == position).any(axis=1)
            parts = self._gathered(times[here], partial(self._summed, face=face))
            mine = which[here] == position
            coefficients[which == position], excess[which == position] = parts[mine][:, :-1], parts[mine][:, -1]
        return coefficients, excess

    def curvature(self, start: Array, widths: Array) -> Array:
        """Bounds ``(k, r)``, for times in ``[start, start + width]`` inside one piece, of the second time derivative of
        what the blocks receive, summed over blocks and Taylor coefficients."""
        matrix, norm, grid = self.lifted.row_matrix, self.lifted.norm, self.lifted.grid
        bent = self._lifted_rows @ matrix @ matrix
        sizes = self._gathered(start, self._reaches, bent, plain=True)
        pieces = np.clip(np.searchsorted(grid.breakpoints, start, side="right") - 1, 0, grid.pieces - 1)
        distinct, which = grid.distinct(start - grid.breakpoints[pieces])
        fresh = np.linalg.norm(self._lifted_rows @ matrix @ self.lifted.backward.flows(distinct)[0], axis=2)[which]
        growth = (norm * widths)[:, None]
        along = np.linalg.norm(bent, axis=1) * self._total_gain[pieces + 1][:, None] * grown_less_one(growth)
        return np.asarray(
            sizes.sum(axis=2) + np.sqrt(self.lifted.space.size) * self._reach * (along + fresh * grown(growth))
        )

    @cached_property
    def neglected(self) -> Array:
        """What the Taylor models neglect, at most, on every piece: ``(r, L)``."""
        total = np.zeros((self.rows.shape[0], self.lifted.grid.pieces))
        if self.lifted.space.nu == 0:
            return total
        lengths = self.lifted.fine.lengths
        spilt = self.lifted.spilt(self.lifted.W) + self.lifted.slack_W
        reach = self._reach + self.lifted.slack_W * self.disturbance.radius
        for row, direction in enumerate(self.rows):
            sizes, remainder = self.lifted.row_bounds(direction)
            total[row] = np.cumsum((remainder * reach + sizes @ spilt * self.disturbance.radius) * lengths)[
                self.lifted.ends[1:] - 1
            ]
        return total

    @property
    def _space(self) -> TaylorSpace:
        return (self.combination or self.lifted).space

    @property
    def _repeats(self) -> bool:
        """Whether the blocks are the pieces of a uniform grid: what they receive then depends on their age ``t - s``
        only."""
        return self.lifted.backward.uniform and self.disturbance.by_piece

    def _gathered(
        self, times: Array, of_blocks: Callable[[Array], Array], rows: Array | None = None, plain: bool = False
    ) -> Array:
        """Sums over the blocks of a function of them: from blocks ``(k, r, M, nb, q)`` to parts ``(k, r, nb, j)``;
        returns ``(k, r, j)``.

        ``rows (r, M d)``: the lifted functionals, the support function's own unless given; ``plain``: leave them
        uncombined.
        """
        start = self._lifted_rows if rows is None else rows
        combined = (lambda blocks: blocks) if plain else self._combined
        if not self._repeats:
            return np.asarray(of_blocks(combined(self._blocks(times, start))).sum(axis=2))
        backward, grid = self.lifted.backward, self.lifted.grid
        pieces = grid.locate(times)
        within, which = grid.distinct(times - grid.breakpoints[pieces])
        flow, driven = backward.flows(within)
        young = self._weights(start @ driven)[..., None, :]
        moved = np.einsum("rd,qde->qre", start, flow)
        old = np.moveaxis(
            self._weights(np.einsum("qre,aef->qraf", moved, backward.ages[: int(pieces.max(initial=0))])), -2, -3
        )
        parts = np.concatenate([of_blocks(combined(young)), of_blocks(combined(old))], axis=2)
        return np.asarray(np.cumsum(parts, axis=2)[which, :, pieces])

    def _combined(self, blocks: Array) -> Array:
        return blocks if self.combination is None else self.combination.apply(blocks)

    def _reaches(self, blocks: Array) -> Array:
        """How much any one disturbance can make of every Taylor coefficient of every block, ``(k, r, nb, M)``."""
        return self.disturbance.set.reach(blocks).swapaxes(2, 3)

    def _summed(self, blocks: Array, face: Array | None) -> Array:
        """Per block: the polynomial under the centre's worst disturbance, and the excess as one more entry; from
        ``(k, r, M, nb, q)``."""
        bound = self.disturbance.set
        blocks = blocks if face is None else np.einsum("ab,krbnq->kranq", face, blocks, optimize=True)
        point = bound.support_point(blocks[:, :, 0])
        coefficients = np.einsum("krbq,krabq->krba", point, blocks, optimize=True)
        excess = np.zeros(coefficients.shape[:3])
        if blocks.shape[2] > 1:
            excess = bound.linearisation_excess(blocks[:, :, 0], np.moveaxis(blocks[:, :, 1:], 2, 3))
        return np.concatenate([coefficients, excess[..., None]], axis=3)

    def _blocks(self, times: Array, rows: Array) -> Array:
        """Taylor coefficients ``(k, r, M, nb, q)`` of what functionals that start as lifted ``rows (r, M d)`` give to
        every block."""
        k, r = times.size, rows.shape[0]
        _, gains, _, _ = self.lifted.backward.adjoint(np.repeat(times, r), np.tile(rows, (k, 1)), np.zeros((k * r, 0)))
        weights = self._weights(gains.reshape(k, r, gains.shape[1], -1))
        return self.disturbance.blocks(np.moveaxis(weights, 3, 2))

    def _weights(self, gains: Array) -> Array:
        """Gains ``(..., M d)`` on the state's drive, as Taylor coefficients ``(..., M, mw)`` of the weights on the
        disturbance."""
        space = self.lifted.space
        parts = gains.reshape(*gains.shape[:-1], space.size, self.lifted.states)
        weights = np.zeros((*parts.shape[:-1], self.lifted.W.shape[2]))
        used = [part.any() for part in self.lifted.W]
        for left, right, target in zip(*space.products, strict=True):
            if used[left]:
                weights[..., target, :] += parts[..., right, :] @ self.lifted.W[left]
        return weights

    @cached_property
    def _lifted_rows(self) -> Array:
        rows = np.zeros((self.rows.shape[0], self.lifted.row_matrix.shape[0]))
        rows[:, : self.lifted.states] = self.rows
        return rows

    @cached_property
    def _reach(self) -> float:
        return self.disturbance.radius * float(np.linalg.norm(self.lifted.W, axis=(1, 2)).sum())

    @cached_property
    def _total_gain(self) -> Array:
        """``int_0^t |e^{R s}| ds`` at the breakpoints, bounded from above, ``(L+1,)``."""
        grid, matrix = self.lifted.grid, self.lifted.row_matrix
        steps = self.lifted.backward.steps(KNOWN)
        powers = np.empty((grid.pieces, *matrix.shape))
        powers[0] = np.eye(matrix.shape[0])
        for piece in range(1, grid.pieces):
            powers[piece] = powers[piece - 1] @ steps.E[0, self.lifted.backward.length_of(piece - 1)]
        norms = np.linalg.norm(powers, axis=(1, 2))
        rising = float(np.linalg.eigvalsh((matrix + matrix.T) / 2)[-1])
        return np.concatenate([[0.0], np.cumsum(norms * grown(np.maximum(rising * grid.lengths, 0.0)) * grid.lengths)])
