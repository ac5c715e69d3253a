"""How far the worst initial state of a set pushes a functional of the state, enclosed over a cell of parameters; and
what several such parts of the uncertainty add up to."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Protocol

import numpy as np

from sparserob_core.control.enclosures.comparison import block_norms, product
from sparserob_core.control.enclosures.taylor import Combination, TaylorSpace
from sparserob_core.control.response.disturbance_support import Carried, carried, over_faces, summed
from sparserob_core.control.response.lifted import KNOWN, LiftedSystem
from sparserob_core.sip.convex_set import Array, ConvexSet


class Support(Protocol):
    """A part of the uncertainty on functionals ``(r, d)`` over one cell, as `DisturbanceSupport` says it."""

    def steepness(self, times: Array) -> Array:
        """How steep it can be in each parameter, ``(k, r, nu)``."""

    def at(self, times: Array, ends: Array) -> tuple[Array, Array]:
        """Taylor coefficients ``(k, r, M)`` and excess ``(k, r)``."""

    def deviation(self, start: Array, widths: Array) -> Array:
        """How far it is from its chord on time cells, ``(k, r)``."""

    @property
    def neglected(self) -> Array:
        """What the Taylor models leave out on every piece, ``(r, L)``."""

    @property
    def reached(self) -> Array:
        """How large what it makes of the state may be on every piece, block by block, ``(L, q)``."""


@dataclass(frozen=True, eq=False)
class Supports:
    """The parts of the uncertainty together: their sums, since each is maximised on its own."""

    parts: tuple[Support, ...]

    def steepness(self, times: Array) -> Array:
        """`Support.steepness` of all parts."""
        return np.asarray(sum(part.steepness(times) for part in self.parts))

    def at(self, times: Array, ends: Array) -> tuple[Array, Array]:
        """`Support.at` of all parts."""
        found = [part.at(times, ends) for part in self.parts]
        return np.asarray(sum(one for one, _ in found)), np.asarray(sum(excess for _, excess in found))

    def deviation(self, start: Array, widths: Array) -> Array:
        """`Support.deviation` of all parts."""
        return np.asarray(sum(part.deviation(start, widths) for part in self.parts))

    @cached_property
    def neglected(self) -> Array:
        """`Support.neglected` of all parts."""
        return np.asarray(sum(part.neglected for part in self.parts))

    @cached_property
    def reached(self) -> Array:
        """`Support.reached` of all parts."""
        return np.asarray(sum(part.reached for part in self.parts))


@dataclass(frozen=True, eq=False)
class InitialSupport:
    """The support function ``h(e^{A't} c)`` of a set of deviations from the initial state, for functionals ``rows (r,
    d)`` (in the lifted system's coordinates) over one cell.

    The deviation is one block that received all it ever will at time 0: what `DisturbanceSupport` says of a block that
    has ended holds of it.
    """

    lifted: LiftedSystem
    set: ConvexSet
    rows: Array
    combination: Combination | None = None

    def steepness(self, times: Array) -> Array:
        """How steep the functional of *any* one deviation can be in each parameter over the cell: ``(k, r, nu)``."""
        return np.asarray(self._reaches(self._combined(self.blocks(times))) @ self._space.exponents)

    def at(self, times: Array, ends: Array) -> tuple[Array, Array]:
        """Taylor coefficients ``(k, r, M)`` under the worst deviation of a centre, and the excess ``(k, r)``, as in
        `DisturbanceSupport.at`."""
        return over_faces(
            self._space,
            ends,
            lambda here, face: summed(self.set, self._combined(self.blocks(times[here]))[:, :, :, None], face)[:, :, 0],
        )

    def deviation(self, start: Array, widths: Array) -> Array:
        """Bounds ``(k, r)`` of how far it is from its chord on ``[start, start + width]``, each inside one piece,
        summed over the Taylor coefficients: as in `DisturbanceSupport.deviation`."""
        lifted, grid = self.lifted, self.lifted.grid
        comparison, starts = lifted.comparison, lifted.starts
        pieces = np.clip(np.searchsorted(grid.breakpoints, start, side="right") - 1, 0, grid.pieces - 1)
        moved = comparison.over(start - grid.breakpoints[pieces], cells=True).flow
        old, reach = moved.on(self._gains[pieces]), comparison.over(widths, cells=True)
        bent = self._lifted_rows(start) @ lifted.row_matrix @ lifted.row_matrix
        sizes = self._reaches(self._parts(bent)).sum(axis=2)
        square = (widths**2 / 8)[:, None]
        first = np.zeros((self.rows.shape[0], lifted.row_matrix.shape[0]))
        first[:, : lifted.states] = self.rows
        twice = first @ lifted.row_matrix @ lifted.row_matrix
        norms = block_norms(twice.reshape(*twice.shape[:-1], -1, lifted.states), starts).sum(axis=-2)
        exact = square * (sizes + product(norms, reach.departure.on(old).T).T)
        ended = np.minimum(
            square * product(reach.peak.on(old), (comparison.sizes @ comparison.sizes).T),
            2.0 * product(reach.integral.on(old), comparison.sizes.T),
        )
        return np.asarray(np.minimum(exact, product(block_norms(self.rows, starts), ended.T).T))

    @cached_property
    def neglected(self) -> Array:
        """What the Taylor models leave out, at most, on every piece: ``(r, L)``."""
        lifted = self.lifted
        sizes, remainder = lifted.row_bounds(self.rows)
        pushed = remainder @ self._sizes + sizes.sum(axis=2) @ self._slack
        if self._carried is not None:
            pushed = pushed + np.einsum("rlaj,aj->rl", sizes, lifted.spilt(self._carried.sizes))
        return np.asarray(np.maximum.reduceat(pushed[:, lifted.span], lifted.ends[:-1], axis=1))

    @cached_property
    def reached(self) -> Array:
        """What any deviation can have made of every block of the coordinates on every piece, ``(L, q)``."""
        peak = self.lifted.comparison.over(self.lifted.grid.lengths).peak
        return peak.on(self._gains[:-1])

    @property
    def _space(self) -> TaylorSpace:
        return (self.combination or self.lifted).space

    def _combined(self, blocks: Array) -> Array:
        return blocks if self.combination is None else self.combination.apply(blocks)

    def _reaches(self, blocks: Array) -> Array:
        """How much any one deviation can make of every Taylor coefficient ``(k, r, M, d)``: ``(k, r, M)``."""
        return np.asarray(self.set.reach(blocks))

    def blocks(self, times: Array) -> Array:
        """Taylor coefficients ``(k, r, M, d)`` of the weights on the deviation, in the coordinates of its set."""
        return self._parts(self._lifted_rows(times))

    def _parts(self, rows: Array) -> Array:
        """Lifted rows ``(k, r, M d)`` as Taylor coefficients of weights on the deviation ``(k, r, M, d)``."""
        space = self.lifted.space
        parts = rows.reshape(*rows.shape[:2], space.size, self.lifted.states)
        if self._carried is None:
            return np.asarray(parts @ self.lifted.decoupling.inverse.astype(float))
        found, effect = np.zeros((*parts.shape[:-1], self.set.dimension)), self._carried.effect
        for left, right, target in zip(*space.products, strict=True):
            found[..., target, :] += parts[..., right, :] @ effect[left]
        return found

    @property
    def _carried(self) -> Carried | None:
        """What a deviation made of the state before a later leg begins, ``effect (M, d, d)``."""
        past = self.lifted.past
        if past is None:
            return None
        known = past.carried.get(id(self.set))
        if not isinstance(known, Carried):
            d = past.turn.shape[0]
            ended = InitialSupport(past.lifted, self.set, np.eye(d))
            far = self.set.reach(np.eye(self.set.dimension))
            old = ended.blocks(past.lifted.grid.breakpoints[-1:])[0]  # (d, M, d)
            known = past.carried[id(self.set)] = carried(
                past, self.set, old, np.abs(old) @ far, ended._gains[-1], ended.neglected[:, -1]
            )
        return known

    def _lifted_rows(self, times: Array) -> Array:
        """The lifted functionals that ``c'x(t)`` are of the state at time 0, ``(k, r, M d)``."""
        grid = self.lifted.grid
        pieces = np.clip(np.searchsorted(grid.breakpoints, times, side="right") - 1, 0, grid.pieces - 1)
        return self.lifted.flown(self._nodes[pieces], times - grid.breakpoints[pieces])[0]

    @cached_property
    def _nodes(self) -> Array:
        """The lifted functionals at the breakpoints of the grid, ``(L + 1, r, M d)``."""
        backward = self.lifted.backward
        steps, pieces = backward.steps(KNOWN), self.lifted.grid.pieces
        rows = np.zeros((pieces + 1, self.rows.shape[0], self.lifted.row_matrix.shape[0]))
        rows[0, :, : self.lifted.states] = self.rows
        for piece, length in enumerate(backward.which.tolist()):
            rows[piece + 1] = rows[piece] @ steps.Phi[0, length]
        return rows

    @cached_property
    def _sizes(self) -> Array:
        """Norms of every block of the coordinates of any deviation, at most, ``(q,)``."""
        if self._carried is not None:
            return self._carried.reached
        far = self.set.reach(np.eye(self.set.dimension))
        return block_norms(np.abs(self.lifted.decoupling.inverse).astype(float) @ far, self.lifted.starts) + self._slack

    @cached_property
    def _slack(self) -> Array:
        """What the rounding of the coordinates may change of every block of a deviation, at most, ``(q,)``; at the
        beginning of a later leg what the Taylor models leave out."""
        if self._carried is not None:
            return self._carried.left_out
        inverse = self.lifted.decoupling
        far = self.set.reach(np.eye(self.set.dimension))
        if inverse.is_identity:
            return np.zeros(self.lifted.starts.size)
        # of V rounded to double precision, and of the defect of V: entry by entry, however a deviation points
        size = np.abs(inverse.inverse).astype(float) @ far
        lost = np.finfo(float).eps * size + inverse.defect.astype(float) @ size
        return block_norms(1.001 * lost, self.lifted.starts)

    @cached_property
    def _gains(self) -> Array:
        """What any deviation can have made of every block at the breakpoints, ``(L + 1, q)``."""
        grid = self.lifted.grid
        flow = self.lifted.comparison.over(grid.lengths).flow
        return flow.summed(self._sizes, np.zeros((grid.pieces, self._sizes.size)))
