"""Parts of the uncertainty, enclosed over cells of time, parameters and directions, and what several of them add up to:
how far the worst initial state of a set pushes a functional of the state, and what is asked along single directions, as
over a cell of these."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from itertools import product as every_choice
from typing import Protocol, final

import numpy as np

from sparserob_core.control.enclosures.comparison import block_norms, product
from sparserob_core.control.enclosures.matrix_exponential import rounding
from sparserob_core.control.enclosures.polynomial import distinct_patterns
from sparserob_core.control.enclosures.taylor import Combination, TaylorSpace
from sparserob_core.control.reach.disturbance_support import Carried, carried, over_faces, summed
from sparserob_core.control.reach.varying_motion import OUTWARD, VaryingMotion
from sparserob_core.control.response.lifted import KNOWN, LiftedSystem
from sparserob_core.shapes import Float, shaped
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


class KnownCellSupport:
    """A part of the uncertainty on functionals ``rows (r, d)`` of a *known* system, in the form of `Support`."""

    rows: Array

    @shaped
    def steepness(self, times: Float[Array, " k"]) -> Float[Array, "k r 0"]:
        """No parameters, no steepness: ``(k, r, 0)``."""
        return np.zeros((times.size, self.rows.shape[0], 0))

    def repeated(self, times: Array) -> tuple[Array, Array]:
        """Every time with every row: ``(k r,)``, ``(k r, d)``."""
        return np.repeat(times, self.rows.shape[0]), np.tile(self.rows, (times.size, 1))

    def between(self, bounds: Array) -> tuple[Array, Array]:
        """The middle ``(k, r, 1)`` of bounds ``(k r, 2)``, and how far they are from it, ``(k, r)``."""
        bounds = bounds.reshape(-1, self.rows.shape[0], 2)
        return bounds.mean(axis=2)[..., None], (bounds[..., 1] - bounds[..., 0]) / 2 * (1.0 + rounding(4))


@final
@dataclass(frozen=True, eq=False)
class DirectionsCellSupport:
    """A part of the uncertainty of a *known* system on one functional over a cell of directions ``c = rows[0] + sum_j
    eta_j rows[j]``, ``|eta_j| <= 1``, in the form of `Support`; ``made`` is what it is on given ``rows (r, d)``, and
    ``joined`` says which monomials there are.

    It is a support function, or a sum of such with factors that are not negative: sublinear in ``c``. So it is, one
    coordinate after another, at most what is linear in each between the corners. How far it leaves its chord in time is
    a mean of differences ``h(y(s)) - h(y(r))`` with ``y`` linear in ``c``, each at most the sum of those of the rows:
    so bounds of these, and of what is left out, add up.
    """

    made: Callable[[Array], Support]
    rows: Array
    leg: LiftedSystem | VaryingMotion
    joined: Combination

    @shaped
    def steepness(self, times: Float[Array, " k"]) -> Float[Array, "k 1 nu"]:
        """`Support.steepness`: what is added along a row, or against it, at most."""
        axes = self.rows[1:]
        # powers of two of one row are asked for again in every smaller cell
        sizes = np.exp2(np.frexp(np.abs(axes).max(axis=1, initial=0.0))[1])
        axes = axes / sizes[:, None]
        along, off = self._at(times, np.vstack([axes, -axes]))
        most = np.maximum(along + off, 0.0).reshape(times.size, 2, len(axes)).max(axis=1)
        return np.asarray((most * sizes * OUTWARD)[:, None])

    @shaped
    def at(
        self, times: Float[Array, " k"], ends: Float[Array, "k 1 nu"]
    ) -> tuple[Float[Array, "k 1 M"], Float[Array, "k 1"]]:
        """`Support.at`. What is lost in the middle of the cell is a part of the excess, since smaller cells lose
        less."""
        coefficients, excess = np.zeros((times.size, 1, self.joined.space.size)), np.zeros((times.size, 1))
        patterns, which = distinct_patterns(ends)
        for position, pattern in enumerate(patterns):
            here = np.flatnonzero(which[:, 0] == position)
            corners = _corners(pattern)
            along, off = self._at(times[here], self.rows[0] + np.vstack([pattern, corners]) @ self.rows[1:])
            found, beyond = between_corners(self.joined.space, pattern, along[:, 1:])
            lost = np.maximum(along[:, 1:].mean(axis=1) - along[:, 0], 0.0)
            size = rounding(len(corners) + 4) * np.abs(along).max(axis=1)
            found[:, 0] -= lost
            coefficients[here, 0] = found
            excess[here, 0] = (off[:, 1:].max(axis=1) + beyond + lost + size) * OUTWARD
        return coefficients, excess

    @shaped
    def deviation(self, start: Float[Array, " k"], widths: Float[Array, " k"]) -> Float[Array, "k r"]:
        """`Support.deviation` of every row."""
        return self._each.deviation(start, widths)

    @cached_property
    def neglected(self) -> Array:
        """`Support.neglected` of every row, with what rounding makes of the corners, ``(r, L)``."""
        sizes = block_norms(np.abs(self.rows) @ np.abs(self.leg.transform), self.leg.starts)
        return np.asarray(self._each.neglected + rounding(len(self.rows)) * product(sizes, self.reached.T))

    @cached_property
    def reached(self) -> Array:
        """`Support.reached`."""
        return self._each.reached

    @cached_property
    def _each(self) -> Support:
        return self.made(self.rows)

    def _at(self, times: Array, rows: Array) -> tuple[Array, Array]:
        """What is added along ``rows (r, d)``, and how far it may be from that, ``(k, r)`` each."""
        found, off = self.made(rows).at(times, np.zeros((times.size, len(rows), 0)))
        return found[..., 0], off


def over_directions(
    made: Callable[[Array], Support], rows: Array, leg: LiftedSystem | VaryingMotion, joined: Combination | None
) -> Support:
    """What is ``made`` of functionals ``rows (r, d)``, or of the direction that they make where they are ``joined``."""
    return made(rows) if joined is None else DirectionsCellSupport(made, rows, leg, joined)


def _corners(pattern: Array) -> Array:
    """The corners ``(n, nu)`` of the face of ``[-1, 1]^nu`` on which the coordinates with an end in ``pattern (nu,)``
    are at it."""
    free = np.flatnonzero(pattern == 0.0)
    signs = np.array(list(every_choice((-1.0, 1.0), repeat=free.size)))
    corners = np.tile(pattern, (len(signs), 1))
    corners[:, free] = signs
    return corners


def between_corners(space: TaylorSpace, pattern: Array, values: Array) -> tuple[Array, Array]:
    """What is linear in every coordinate between ``values (q, n)`` at the `_corners` of a face: coefficients ``(q,
    M)``, and how far it may be above these, ``(q,)``: of products that the space has not, and by rounding."""
    corners, free = _corners(pattern), np.flatnonzero(pattern == 0.0)
    coefficients = np.zeros((len(values), space.size))
    beyond = len(corners) * rounding(2 * len(corners) + 8) * np.abs(values).max(axis=1)
    for chosen in every_choice((0, 1), repeat=free.size):
        found = values @ corners[:, free[np.flatnonzero(chosen)]].prod(axis=1) / len(corners)
        exponents = np.zeros(space.nu, dtype=int)
        exponents[free] = chosen
        place = space.index.get(tuple(exponents.tolist()))
        if place is None:  # of more coordinates than there are degrees
            beyond = beyond + np.abs(found)
        else:
            coefficients[:, place] = found
    return coefficients, beyond
