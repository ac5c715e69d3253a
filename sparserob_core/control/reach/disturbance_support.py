"""How far the worst disturbance pushes a functional of the state, enclosed over a cell of parameters."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property, partial

import numpy as np

from sparserob_core.control.enclosures.comparison import block_norms, product
from sparserob_core.control.enclosures.matrix_exponential import rounding
from sparserob_core.control.enclosures.polynomial import distinct_patterns, face_of
from sparserob_core.control.enclosures.taylor import Combination, Face, TaylorSpace
from sparserob_core.control.response.disturbance import DisturbanceModel
from sparserob_core.control.response.lifted import LiftedSystem, Past
from sparserob_core.control.response.response import Impulses
from sparserob_core.sip.convex_set import Array, ConvexSet

AT_ONCE = 4_000_000  # numbers that are summed over all ages at once
SAME = 1e-9  # of a piece: a time that is no nearer to its end is inside
KEPT = 8_000_000  # numbers of sums over all ages, up to which they are remembered


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
        if self._repeats:
            return np.asarray(self._gathered(times, self._reaches) @ self._space.exponents[self._monomials])
        self._asked["blocks"] = times, (blocks := self._side_by_side(self.blocks(times)))
        return np.asarray(self._reaches(blocks).sum(axis=2) @ self._space.exponents[self._monomials])

    def at(self, times: Array, ends: Array) -> tuple[Array, Array]:
        """Taylor coefficients ``(k, r, M)`` of the support function under the worst disturbance of a centre, and its
        excess ``(k, r)``.

        ``ends (k, r, nu)``: parameters that are known to be at an end of the cell (-1 or 1); the centre is that of the
        face they leave.
        """
        if not self._repeats:  # and `steepness` has just been asked for these times, where there are parameters
            asked, blocks = self._asked.pop("blocks", (None, None))
            if blocks is None or asked is not times:
                blocks = self._side_by_side(self.blocks(times))
            return over_faces(self._space, ends, lambda here, face: self._summed(blocks[here], face).sum(axis=2))
        return over_faces(
            self._space,
            ends,
            lambda here, face: self._gathered(
                times[here], partial(self._summed, face=face), kept="worst" if face is None else ""
            ),
        )

    def _summed(self, blocks: Array, face: Face | None) -> Array:
        return summed(self.disturbance.set, blocks, face, self._monomials, self._space.size)

    def deviation(self, start: Array, widths: Array) -> Array:
        """Bounds ``(k, r)``, for times in ``[start, start + width]`` inside one piece, of how far what the blocks
        receive is from its chord, summed over blocks and Taylor coefficients.

        A block that has ended receives ``y(r) = c e^{A r} z``, the one that lasts ``y' = c e^{A r} W``. The chord is
        missed by at most ``width^2 / 8`` of the largest second derivative, and mode by mode by at most twice what it
        moves: that bound serves fast modes, which have died away long before a cell is as short as they are.
        """
        grid, comparison = self.lifted.grid, self.lifted.comparison
        bent, once, twice, norms, squared = self._bending
        sizes = self._gathered(start, self._reaches, bent, plain=True, kept="bent").sum(axis=2)
        pieces = np.minimum(np.maximum(grid.breakpoints.searchsorted(start, side="right") - 1, 0), grid.pieces - 1)
        moved = comparison.over(start - grid.breakpoints[pieces], cells=True).flow
        reach = comparison.over(widths, cells=True)
        young = moved.on(np.broadcast_to(self._drive, (start.size, self._drive.size)))
        old = moved.on(self._gains[pieces])
        square = (widths**2 / 8)[:, None]
        exact = square * (sizes + product(twice, reach.departure.on(old).T).T + product(once, reach.peak.on(young).T).T)
        ended = np.minimum(
            square * product(reach.peak.on(old), squared.T),
            2.0 * product(reach.integral.on(old), comparison.sizes.T),
        )
        lasting = np.minimum(
            square * product(reach.peak.on(young), comparison.sizes.T),
            2.0 * reach.integral.on(young),
        )
        by_mode = product(norms, (ended + lasting).T).T
        return np.asarray(np.minimum(exact, by_mode))

    @cached_property
    def _bending(self) -> tuple[Array, Array, Array, Array, Array]:
        """What `deviation` needs at all times: the lifted functionals times the square of the matrix, the block norms
        ``(r, q)`` of these and of their first derivative (before them), those of the functionals, and the square of the
        comparison's sizes."""
        lifted, rows = self.lifted, self._lifted_rows
        sloping, bent = rows @ lifted.row_matrix, rows @ lifted.row_matrix @ lifted.row_matrix
        once, twice = (
            block_norms(part.reshape(*part.shape[:-1], -1, lifted.states), lifted.starts).sum(axis=-2)
            for part in (sloping, bent)
        )
        sizes = lifted.comparison.sizes
        return bent, once, twice, block_norms(self.rows, lifted.starts), sizes @ sizes

    @cached_property
    def neglected(self) -> Array:
        """What the Taylor models leave out, at most, on every piece: ``(r, L)``.

        Of what a disturbance had made of the state before this leg, the product with a row leaves out what the row
        does, what is left out of the state already, and the terms of too high a degree.
        """
        lifted, radius = self.lifted, self.disturbance.radius
        sizes, remainder = lifted.row_bounds(self.rows, self._repeats)
        spilt = lifted.spilt(_row_norms(lifted.W, lifted.starts)) + np.linalg.norm(lifted.slack_W, axis=1)
        pushed = remainder @ self._drive + radius * np.einsum("rlaj,aj->rl", sizes, spilt)
        within = np.cumsum(pushed[:, lifted.span] * lifted.fine.lengths, axis=1)[:, lifted.ends[1:] - 1]
        before = self._carried
        if before is None:
            return np.asarray(within)
        missed = remainder @ (before.reached + before.left_out) + sizes.sum(axis=2) @ before.left_out
        missed = missed + np.einsum("rlaj,aj->rl", sizes, lifted.spilt(before.sizes))
        return np.asarray(within + np.maximum.reduceat(missed[:, lifted.span], lifted.ends[:-1], axis=1))

    @property
    def reached(self) -> Array:
        """What any disturbance can have made of every block of the coordinates until the end of every piece,
        ``(L, q)``."""
        return self._gains[1:]

    @property
    def _space(self) -> TaylorSpace:
        return (self.combination or self.lifted).space

    @property
    def _repeats(self) -> bool:
        """Whether the blocks are the pieces of a uniform grid: what they receive then depends on their age ``t - s``
        only."""
        alone = self.lifted.grid.pieces == self.disturbance.grid.pieces  # not one leg of several
        return alone and self.lifted.backward.uniform and self.disturbance.by_piece

    def _gathered(
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
        combined = (lambda blocks: blocks) if plain else self._side_by_side
        if not self._repeats:
            return np.asarray(of_blocks(combined(self._blocks(times, start))).sum(axis=2))
        grid = self.lifted.grid
        pieces = grid.locate(times)
        within, which = grid.distinct(times - grid.breakpoints[pieces])
        if within.size == 1 and kept and self._whole(float(within[0])):
            key = (kept, float(within[0]))
            if key not in self._sums:
                sums = self._by_age(within, grid.pieces - 1, start, lambda blocks: of_blocks(combined(blocks)))
                if sums.size > KEPT:
                    return np.asarray(sums[which, :, pieces])
                self._sums[key] = sums
            return np.asarray(self._sums[key][which, :, pieces])
        count = int(pieces.max(initial=0))
        share = max(1, AT_ONCE // max(1, start.shape[0] * count * self._impulses.columns.shape[1]))
        answer = None
        for begin in range(0, within.size, share):
            part = slice(begin, begin + share)
            found = self._by_age(within[part], count, start, lambda blocks: of_blocks(combined(blocks)))
            if share >= within.size:
                return np.asarray(found[which, :, pieces])
            mine = np.flatnonzero((which >= part.start) & (which < part.stop))
            if answer is None:
                answer = np.empty((times.size, found.shape[1], found.shape[3]))
            answer[mine] = found[which[mine] - begin, :, pieces[mine]]
        assert answer is not None
        return answer

    def _whole(self, within: float) -> bool:
        """Whether a time within a piece is its beginning or its end."""
        length = float(self.lifted.backward.propagator.lengths[0])
        return within == 0.0 or abs(within - length) <= SAME * length

    @cached_property
    def _asked(self) -> dict[str, tuple[Array, Array]]:
        """The times that `steepness` was last asked for, and the blocks there, until `at` has used them."""
        return {}

    @cached_property
    def _sums(self) -> dict[tuple[str, float], Array]:
        return {}

    def _by_age(self, within: Array, count: int, start: Array, of_blocks: Callable[[Array], Array]) -> Array:
        """The sums of `_gathered` at such times ``within (q,)`` of the pieces ``0, ..., count``, ``(q, r, count + 1,
        j)``, since what a block receives depends on its age."""
        flown, driven = self.lifted.flown(np.broadcast_to(start, (within.size, *start.shape)), within)
        young = self._weights(driven)[..., None, :]
        old = self._impulses.of(flown, count)
        old = old.reshape(*old.shape[:-1], young.shape[2], young.shape[4]).swapaxes(-2, -3)
        return np.asarray(np.concatenate([of_blocks(young), of_blocks(old)], axis=2).cumsum(axis=2))

    @cached_property
    def _impulses(self) -> Impulses:
        """What the disturbance on a piece gives to the Taylor coefficients of a functional, by the piece's age."""
        whole = self._weights(np.eye(self.lifted.row_matrix.shape[0]))
        return Impulses(self.lifted.backward.propagator, whole.reshape(whole.shape[0], -1))

    def _side_by_side(self, blocks: Array) -> Array:
        """Coefficients ``(k, r, M, nb, q)`` as those of the polynomials whose sums are taken: of the one of a direction
        that varies, ``(k, 1, r M, nb, q)``, whose other coefficients are 0."""
        k, r, size, *each = blocks.shape
        return blocks if self.combination is None else blocks.reshape(k, 1, r * size, *each)

    @cached_property
    def _monomials(self) -> np.ndarray:
        """Of which monomials of the space `_side_by_side` has the coefficients, that of the centre first."""
        return np.arange(self._space.size) if self.combination is None else self.combination.targets.reshape(-1)

    def _reaches(self, blocks: Array) -> Array:
        """How much any one disturbance can make of every Taylor coefficient of every block, ``(k, r, nb, M)``."""
        return self.disturbance.set.reach(blocks).swapaxes(2, 3)

    def blocks(self, times: Array) -> Array:
        """Taylor coefficients ``(k, r, M, nb, q)`` of what the functionals give to every block."""
        return self._blocks(times, self._lifted_rows)

    def _blocks(self, times: Array, rows: Array) -> Array:
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
        weights = self._weights(gains.reshape(k, r, gains.shape[1], -1))
        first, whole = self.lifted.first, self.disturbance.grid.pieces
        if whole == weights.shape[2]:
            return weights
        every = np.zeros((k, r, whole, *weights.shape[3:]))
        every[:, :, first : first + weights.shape[2]] = weights
        if self._carried is not None:
            space, effect = self.lifted.space, self._carried.effect
            along = free.reshape(k, r, space.size, -1)
            for left, right, target in zip(*space.products, strict=True):
                every[:, :, :first, target] += np.einsum("krd,dlw->krlw", along[:, :, right], effect[left])
        return every

    @property
    def _carried(self) -> Carried | None:
        past = self.lifted.past
        if past is None:
            return None
        known = past.carried.get(id(self.disturbance))
        if not isinstance(known, Carried):
            known = past.carried[id(self.disturbance)] = _carry(past, self.disturbance)
        return known

    def _weights(self, gains: Array) -> Array:
        """Gains ``(..., M d)`` on the state's drive, as Taylor coefficients ``(..., M, mw)`` of the weights on the
        disturbance."""
        space = self.lifted.space
        parts = gains.reshape(*gains.shape[:-1], space.size, self.lifted.states)
        if space.size == 1:
            return np.asarray(parts @ self.lifted.W[0])
        weights = np.zeros((*parts.shape[:-1], self.lifted.W.shape[2]))
        used = [part.any() for part in self.lifted.W]
        for left, right, target in zip(*space.products, strict=True):
            if used[left]:
                weights[..., target, :] += parts[..., right, :] @ self.lifted.W[left]
        return weights

    @cached_property
    def before(self) -> Array:
        """What any disturbance can have made of every block of the coordinates before time 0, ``(q,)``."""
        return np.zeros(self.lifted.starts.size) if self._carried is None else self._carried.reached

    @cached_property
    def _lifted_rows(self) -> Array:
        rows = np.zeros((self.rows.shape[0], self.lifted.row_matrix.shape[0]))
        rows[:, : self.lifted.states] = self.rows
        return rows

    @cached_property
    def _drive(self) -> Array:
        """How much of every block of the coordinates any admissible disturbance drives, at most, ``(q,)``."""
        norms = _row_norms(self.lifted.W, self.lifted.starts).sum(axis=0)
        return np.asarray(self.disturbance.radius * (norms + np.linalg.norm(self.lifted.slack_W, axis=1)))

    @cached_property
    def _gains(self) -> Array:
        """``int_0^t e^{M s} |W| ds`` for the comparison system at the breakpoints, ``(L+1, q)``: what any disturbance
        until then can have made of every block."""
        grid = self.lifted.grid
        reach = self.lifted.comparison.over(grid.lengths)
        driven = reach.integral.on(np.broadcast_to(self._drive, (grid.pieces, self._drive.size)))
        return reach.flow.summed(self.before, driven)


@dataclass(frozen=True, eq=False)
class Carried:
    """What a part of the uncertainty made of the state before a leg begins: its ``effect (M, d, ...)`` per unit, Taylor
    coefficients in the leg's coordinates.

    Whatever is admissible, block by block: the norms of the coefficients ``sizes (M, q)``, all that it can be,
    ``reached (q,)``, and what the coefficients leave out, ``left_out (q,)``. ``of``: whose it is.
    """

    of: object
    effect: Array
    sizes: Array
    reached: Array
    left_out: Array


def carried(past: Past, of: object, old: Array, entries: Array, reached: Array, neglected: Array) -> Carried:
    """`Carried` from what is known at the end of the leg before: the effect ``old (d, M, ...)`` in its coordinates, how
    large its coefficients can be, ``entries (d, M)``, block norms ``reached (q',)``, and ``neglected (d,)`` of every
    coordinate."""
    effect = np.moveaxis(np.tensordot(past.turn, old, axes=1), 1, 0)
    terms = rounding(2 * past.turn.shape[0] + old[0].size)
    sizes = (1.0 + terms) * block_norms((np.abs(past.turn) @ entries).T, past.starts)
    moved = product(past.blocks, reached[:, None])[:, 0]
    missed = block_norms(np.abs(past.turn) @ neglected, past.starts) * (1.0 + terms)
    return Carried(of, effect, sizes, moved, missed + past.rounded(entries.sum(axis=1)) + terms * moved)


def _carry(past: Past, disturbance: DisturbanceModel) -> Carried:
    lifted, d = past.lifted, past.turn.shape[0]
    ended, rows = DisturbanceSupport(lifted, disturbance, np.eye(d)), np.eye(d, lifted.row_matrix.shape[0])
    first = lifted.first + lifted.grid.pieces
    old = ended.on_pieces(lifted.grid.breakpoints[-1:], rows)[0, :, :first]  # (d, L, M, mw)
    entries = disturbance.radius * np.linalg.norm(old, axis=3).sum(axis=1)
    return carried(past, disturbance, old.swapaxes(1, 2), entries, ended.reached[-1], ended.neglected[:, -1])


def over_faces(
    space: TaylorSpace, ends: Array, parts: Callable[[np.ndarray, Face | None], Array]
) -> tuple[Array, Array]:
    """Coefficients ``(k, r, M)`` and excess ``(k, r)`` where every functional has its own pattern of ``ends (k, r,
    nu)``; ``parts(here, face)`` gives both as ``(k', r, M + 1)`` for the times ``here`` on one face of the cell."""
    if not space.nu:
        found = parts(np.arange(ends.shape[0]), None)
        return found[..., :-1], found[..., -1]
    k, r, _ = ends.shape
    patterns, which = distinct_patterns(ends)
    coefficients, excess = np.empty((k, r, space.size)), np.empty((k, r))
    for position, pattern in enumerate(patterns):
        face = face_of(space, pattern) if pattern.any() else None
        here = (which == position).any(axis=1)
        found = parts(here, face)
        mine = which[here] == position
        coefficients[which == position], excess[which == position] = found[mine][:, :-1], found[mine][:, -1]
    return coefficients, excess


def summed(
    bound: ConvexSet, blocks: Array, face: Face | None, monomials: np.ndarray | None = None, size: int = 0
) -> Array:
    """Per block in ``bound``: the polynomial under the centre's worst point, and the excess as one more entry; from
    Taylor coefficients ``(k, r, M, nb, q)``.

    ``monomials (M,)``: whose they are where these are not all ``size`` of a space; the others are 0, in many
    dimensions most of them. On a ``face`` only monomials of the variables that it leaves are looked at.
    """
    k, r, given, count, width = blocks.shape
    kept = np.arange(given) if monomials is None else monomials
    if face is not None:
        kept, onto = face.onto(kept)
        blocks = (onto @ blocks.reshape(k, r, given, count * width)).reshape(k, r, kept.size, count, width)
    size = given if monomials is None else size
    polynomials = np.zeros((k, r, count, size + 1))
    if kept.size > 1:
        point, polynomials[..., -1] = bound.support_majorant(blocks[:, :, 0], np.moveaxis(blocks[:, :, 1:], 2, 3))
    else:
        point = bound.support_point(blocks[:, :, 0])
    polynomials[..., kept] = np.einsum("krbq,krabq->krba", point, blocks)
    return polynomials


def _row_norms(coefficients: Array, starts: np.ndarray) -> Array:
    """Norms ``(M, q)`` of the rows of every block of ``(M, d, mw)``."""
    return np.asarray(np.sqrt(np.add.reduceat((coefficients**2).sum(axis=2), starts, axis=1)))
