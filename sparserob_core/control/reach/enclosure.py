"""Proven upper bounds of the worst-case violation on cells of times and parameters.

On a cell ``[a, b]`` of times inside one piece of the grid, every Taylor coefficient of the state lies within
``(b - a)^2 / 8 max |second derivative|`` of its chord, and within twice a bound of its change. The support function of
a chord lies below the chord of the support functions. So the violation is at most the larger of its bounds at ``a`` and
at ``b``, plus that deviation, plus the remainder of the Taylor models. The propagation to ``a`` has no error but
rounding and truncation: only the length of the cell counts, not the length of the piece.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Protocol, TypeAlias, TypeVar

import numpy as np

from sparserob_core.control.enclosures.comparison import block_norms, product
from sparserob_core.control.enclosures.polynomial import (
    distinct_patterns,
    face_of,
    monotone_ends,
    polynomial_bound,
    quadratic_part,
)
from sparserob_core.control.enclosures.valid_inequalities import Cuts
from sparserob_core.control.reach.support import Supports
from sparserob_core.control.response.reference import Direct, MovingReference
from sparserob_core.control.response.time_grid import TimeGrid
from sparserob_core.errors import NotEnclosable
from sparserob_core.sip.convex_set import Array
from sparserob_core.sip.expressions.rounding import rounding
from sparserob_core.sip.expressions.taylor import Combination, TaylorSpace
from sparserob_core.sip.program import Enclosure

# times the numbers of a constraint: a larger distance from the chord on a short cell is not for halving the times
WILD = 1e3
SMALL_SHARE = 1e-6  # so that every parameter or direction has a positive share in the remainder
CELLS_KEPT, CELLS_SIZE = 256, 2_000_000  # enclosures that are kept, and numbers in their decisions
TIME_FIRST = (
    0.25  # times are halved before anything else unless that gains less than this share: their cells share all work
)
TINY = 1e-4  # of a cell of parameters: a cell on which a system that can be enclosed at all will be
TINIEST = float(np.finfo(float).tiny)  # instead of nothing to divide by
FEW_CELLS = 64  # of which only neighbours are asked whether they share an end


class EnclosedMotion(Protocol):
    """A system over a cell of parameters, as bounds over cells of time see it: the Taylor models of a state in
    coordinates ``z`` with ``x = T z``, ``transform`` ``T (d, d)``, whose blocks begin at ``starts (q,)``, on a
    ``grid`` between whose breakpoints nothing jumps."""

    @property
    def grid(self) -> TimeGrid:
        """The pieces, in times from the beginning of the phase."""

    @property
    def space(self) -> TaylorSpace:
        """The polynomials in the parameters, ``M`` coefficients."""

    @property
    def transform(self) -> Array:
        """``T (d, d)``."""

    @property
    def starts(self) -> np.ndarray:
        """Indices ``(q,)`` at which the blocks of the coordinates begin."""

    @property
    def states(self) -> int:
        """``d``."""

    @property
    def norm(self) -> float:
        """An estimate of how fast the system moves: cells of a time shorter than its reciprocal are short."""

    @property
    def influence(self) -> Array:
        """Influence of every parameter on the remainder of the models, ``(nu,)``, which only guides the halving."""

    def nodes(self, control: Array) -> Array:
        """Taylor coefficients ``(L+1, M, d)`` of the state at the breakpoints, under ``control (m, K)``."""

    def propagate(self, within: Array, pieces: np.ndarray, start_states: Array, inputs: Array) -> Array:
        """The coefficients ``(k, M, d)`` at times ``within (k,)`` the ``pieces (k,)``, from those at their beginning,
        ``start_states (k, M, d)``, under ``inputs (k, m)``."""

    def deviation(
        self, rows: Array, start: Array, width: Array, pieces: np.ndarray, states: Array, inputs: Array
    ) -> Array:
        """Return bounds ``(k, r)`` of the distance of rows of the state from their chords on
        ``[start, start + width]``.

        The distances are summed over the Taylor coefficients.

        Parameters
        ----------
        rows : Array
            Rows ``(r, d)`` in the coordinates ``z``.
        start, width : Array
            Cells of time ``(k,)``, each on one piece.
        pieces : array
            The piece ``(k,)`` of each cell.
        states : Array
            Taylor coefficients ``(k, M, d)`` of the state at ``start``.
        inputs : Array
            Inputs ``(k, m)`` on the pieces.
        """

    def along(self, control: Array, rows: Array, others: Array) -> Array:
        """Return sums ``(r, L)`` of bounds of the state under ``control (m, K)``, weighted block by block.

        ``rows (r, q)`` are the weights on the remainder of the Taylor models, and ``others (r, q)`` the weights on the
        size of the state.
        """


@dataclass(frozen=True, eq=False)
class CellEnclosure:
    """Bounds of ``H x(t) - rhs`` for one decision over one cell of parameters, and of directions where there is a
    ``combination``.

    ``H (r, d)``; ``rhs (r', M')``, polynomials over the cell; ``control (m, K)`` on the pieces of the control's
    dictionary. Without a combination every row of ``H`` is a constraint (``r' = r``, ``M' = M``); with one the rows are
    the parts of a single constraint. ``looseness (nu',)``: how far ``rhs`` may be below the truth at the ends of every
    coordinate. ``lengthening (nu',)``: the share by which directions there are longer than the shortest direction of
    the cell, in whose length a violation is reported. Both only guide the halving. ``cuts``: inequalities that hold for
    all parameters in the cell. ``moving``, ``direct``: terms that are added to the rows, linear in time or constant on
    every cell of times.
    """

    lifted: EnclosedMotion
    sigma: Supports | None
    H: Array
    rhs: Array
    control: Array
    combination: Combination | None = None
    looseness: Array | float = 0.0
    lengthening: Array | float = 0.0
    cuts: Cuts | None = None
    moving: MovingReference | None = None
    direct: Direct | None = None

    def bounds(self, start: Array, stop: Array) -> tuple[Array, Array, Array]:
        """Return upper bounds of the violation on cells of time, and how much of them halving would reduce.

        Parameters
        ----------
        start, stop : Array
            Ends ``(k,)`` of the cells, each inside one piece.

        Returns
        -------
        Array, Array, Array
            Upper bounds ``(k,)`` of the largest violation of a row; the part of them that halving the times would
            reduce, ``(k,)``; and estimates ``(k, nu')`` of the parts that halving each parameter, or direction, would
            reduce.
        """
        with np.errstate(over="ignore", invalid="ignore"):  # a bound that overflows is no bound, and is told as such
            return self._compute_bounds(start, stop)

    def _compute_bounds(self, start: Array, stop: Array) -> tuple[Array, Array, Array]:
        pieces = self.lifted.grid.locate(stop)
        ends, end_indices = _merge_ends(start, stop, pieces, self.lifted.grid.breakpoints)
        bounds, spreads = self._bound_at(*ends)
        start_bounds, stop_bounds = bounds[end_indices[: start.size]], bounds[end_indices[start.size :]]
        chord_error = self._bound_chord_error(start, stop, pieces)
        neglected = self._remainder_bounds[:, pieces].T
        if self.combination is not None:  # the parts of one constraint, each with a factor of at most 1
            chord_error, neglected = chord_error.sum(axis=1, keepdims=True), neglected.sum(axis=1, keepdims=True)
        if self.direct is not None:
            elapsed = self.lifted.grid.elapsed
            direct_terms = self.direct.on(start + elapsed, stop + elapsed)
            start_bounds, stop_bounds = start_bounds + direct_terms, stop_bounds + direct_terms
        total = np.maximum(start_bounds, stop_bounds) + chord_error + neglected
        worst = total.argmax(axis=1)
        pick = (np.arange(worst.size), worst)
        spread = (
            np.maximum(spreads[end_indices[: start.size]][pick], spreads[end_indices[start.size :]][pick])
            + self._remainder_shares * neglected[pick][:, None]
        )
        # A short cell that bends beyond all measure has models that are good for narrower parameters only.
        short = self.lifted.norm * (stop - start) < 1.0
        wild = short & ~(chord_error[pick] <= WILD * (1.0 + np.abs(start_bounds[pick]) + np.abs(stop_bounds[pick])))
        gain = np.where(wild, 0.0, chord_error[pick]) if spread.shape[1] else chord_error[pick]
        return total[pick], gain, spread

    def _bound_at(self, times: Array, pieces: np.ndarray) -> tuple[Array, Array]:
        """Return upper bounds ``(k, r)`` at single times, without the remainder of the models, and estimates
        ``(k, r, nu')`` of what halving each parameter or direction would gain."""
        states = self._compute_states(times, pieces)
        coefficients = np.einsum("ri,kai->kra", self._rows, states)
        if self.moving is not None:
            coefficients[:, :, 0] += self.moving.at(times + self.lifted.grid.elapsed)
        space = self.lifted.space
        if self.combination is not None:
            coefficients, space = self.combination.apply(coefficients), self.combination.space
        coefficients = coefficients - self.rhs
        steepness = (
            np.zeros((*coefficients.shape[:2], space.nu))
            if self.sigma is None or not space.nu
            else self.sigma.steepness(times)
        )
        coefficients, gain = self._apply_cuts(space, coefficients, times)
        ends = self._find_better_ends(space, coefficients, steepness)
        coefficients, excess = _restrict_to_faces(space, coefficients, ends), np.zeros(coefficients.shape[:2])
        if self.sigma is not None:
            support, excess = self.sigma.at(times, ends)
            coefficients = coefficients + support
        bound, spread = polynomial_bound(space, coefficients)
        blame = np.where(ends == 0, steepness, 0.0) + np.finfo(float).tiny
        spread = spread if gain is None else gain
        if self.combination is not None:
            spread = self._add_direction_gains(space, coefficients, ends, spread, np.maximum(bound + excess, 0.0))
        return bound + excess, spread + excess[..., None] * blame / blame.sum(axis=2, keepdims=True)

    def _add_direction_gains(
        self, space: TaylorSpace, coefficients: Array, ends: Array, spread: Array, violated: Array
    ) -> Array:
        """Return the ``spread (k, r, nu')`` with the gain from halving each direction.

        A polynomial that bends downwards is bounded exactly, however wide the cell. So only the loss at its highest
        point counts: how far ``rhs`` is below the truth there, and the length in which what is ``violated (k, r)`` is
        reported. The products with other variables are added.
        """
        nu = self.lifted.space.nu
        gradient, hessian = (
            derivative.reshape(*ends.shape, *derivative.shape[2:])
            for derivative in quadratic_part(space, coefficients.reshape(-1, space.size))
        )
        own = np.einsum("...ii->...i", hessian)
        highest = np.where(ends == 0, np.clip(gradient / np.maximum(-own, TINIEST), -1.0, 1.0), ends)
        loss = self.looseness + violated[..., None] * self.lengthening
        gain = np.abs(hessian).sum(axis=3) - np.abs(own) + loss * highest**2
        return np.concatenate([spread[..., :nu], gain[..., nu:]], axis=2)

    def _apply_cuts(self, space: TaylorSpace, coefficients: Array, times: Array) -> tuple[Array, Array | None]:
        """Return polynomials above ``coefficients (k, r, M)`` where the parameters are, and estimates ``(k, r, nu')``
        of what halving the cell would gain with them; ``None`` for these without cuts."""
        if self.cuts is None:
            return coefficients, None
        support = 0.0 if self.sigma is None else self.sigma.at(times, np.zeros((*coefficients.shape[:2], space.nu)))[0]
        return self.cuts.lowered(space, coefficients, support)

    @staticmethod
    def _find_better_ends(space: TaylorSpace, coefficients: Array, steepness: Array) -> Array:
        """Return the better ends ``(k, r, nu)`` of the parameters in which the violation is monotone over the cell,
        whatever the disturbance; 0 for the others."""
        if not space.nu:
            return np.zeros(steepness.shape)
        return monotone_ends(space, coefficients.reshape(-1, space.size), steepness.reshape(-1, space.nu)).reshape(
            steepness.shape
        )

    def _compute_states(self, times: Array, pieces: np.ndarray) -> Array:
        """Taylor coefficients ``(k, M, d)`` of the state under the control alone, from the last breakpoint."""
        start: Array = self._nodes[pieces]
        within = times - self.lifted.grid.breakpoints[pieces]
        if not within.any():
            return start
        pieces = np.minimum(pieces, self.lifted.grid.pieces - 1)  # beyond the last there is no time to be driven in
        return self.lifted.propagate(within, pieces, start, self._inputs[pieces])

    def _bound_chord_error(self, start: Array, stop: Array, pieces: np.ndarray) -> Array:
        """Return bounds ``(k, r)`` of the height of the rows above their chords on the cells: of the state, summed over
        its Taylor coefficients, and of the support function."""
        width, states = stop - start, self._compute_states(start, pieces)
        total = self.lifted.deviation(self._rows, start, width, pieces, states, self._inputs[pieces])
        return np.asarray(total if self.sigma is None else total + self.sigma.deviation(start, width))

    @cached_property
    def _rows(self) -> Array:
        return self.H @ self.lifted.transform

    @cached_property
    def _row_norms(self) -> Array:
        return block_norms(self._rows, self.lifted.starts)

    @property
    def _nodes(self) -> Array:
        return self.lifted.nodes(self.control)

    @cached_property
    def _inputs(self) -> Array:
        return self.lifted.grid.inputs(self.control).T

    @cached_property
    def _remainder_shares(self) -> Array:
        """Shares ``(nu',)`` of the parameters (and directions) in the remainder of the models, of sum 1."""
        directions = (self.combination.space.nu - self.lifted.space.nu) if self.combination is not None else 0
        total = np.append(self.lifted.influence, np.zeros(directions)) + SMALL_SHARE
        return np.asarray(total / total.sum())

    @cached_property
    def _remainder_bounds(self) -> Array:
        """Bounds ``(r, L)`` of the remainder of the Taylor models and of the rounding of the last products and sums."""
        lifted = self.lifted
        widest = block_norms(np.abs(self.H) @ np.abs(lifted.transform), lifted.starts)  # with what cancels in H T
        terms = rounding(2 * lifted.states + self.rhs.shape[1])
        total = lifted.along(self.control, self._row_norms, terms * widest)
        if self.sigma is not None:
            total = total + self.sigma.neglected + terms * product(widest, self.sigma.effect_bounds.T)
        sides = np.abs(self.rhs).sum(axis=1, keepdims=True)  # of every row, or of the one that a combination makes
        for term in (self.moving, self.direct):
            sides = sides if term is None else sides + term.size[:, None]
        return np.asarray(total + terms * sides)


@dataclass(frozen=True, eq=False)
class LegsEnclosure:
    """The `CellEnclosure` of every phase of a switched system, in times from the beginning of the phase,
    ``begin (J,)``."""

    legs: Sequence[CellEnclosure]
    begin: Array

    def bounds(self, start: Array, stop: Array) -> tuple[Array, Array, Array]:
        """Return the bounds of `CellEnclosure.bounds` for cells ``[start, stop]`` that lie within one phase each."""
        leg_indices = np.maximum(np.searchsorted(self.begin, stop, side="left") - 1, 0)
        leg_bounds: list[tuple[np.ndarray, tuple[Array, Array, Array]]] = []
        for number in np.unique(leg_indices):
            members, begin = np.flatnonzero(leg_indices == number), self.begin[number]
            times = np.maximum(start[members] - begin, 0.0), np.maximum(stop[members] - begin, 0.0)
            leg_bounds.append((members, self.legs[number].bounds(*times)))
        order = np.argsort(np.concatenate([members for members, _ in leg_bounds]))
        bounds, chord_error, spread = (np.concatenate([triple[i] for _, triple in leg_bounds])[order] for i in range(3))
        return bounds, chord_error, spread


AnyMotion = TypeVar("AnyMotion", bound=EnclosedMotion)
Bounded: TypeAlias = CellEnclosure | LegsEnclosure


def kept(control: Array) -> int:
    """Return the number of enclosures to remember for controls of this size, from 2 to `CELLS_KEPT`."""
    return max(2, min(CELLS_KEPT, CELLS_SIZE // control.size))


def over_legs(legs: Sequence[AnyMotion], cell: Callable[[AnyMotion], CellEnclosure]) -> Bounded:
    """Return the enclosure that ``cell`` makes of a motion, for every phase of a switched system."""
    if len(legs) == 1:
        return cell(legs[0])
    return LegsEnclosure([cell(leg) for leg in legs], np.array([leg.grid.elapsed for leg in legs]))


def _restrict_to_faces(space: TaylorSpace, coefficients: Array, ends: Array) -> Array:
    """Polynomials ``(k, r, M)`` with the variables that have an end in ``ends (k, r, nu)`` set to it."""
    if not ends.any():
        return coefficients
    patterns, pattern_indices = distinct_patterns(ends)
    on_faces = coefficients.copy()
    for position, pattern in enumerate(patterns):
        if pattern.any():
            mask = pattern_indices == position
            on_faces[mask] = (face_of(space, pattern).matrix @ coefficients[mask].T).T
    return on_faces


def _merge_ends(
    start: Array, stop: Array, pieces: np.ndarray, breakpoints: Array
) -> tuple[tuple[Array, np.ndarray], np.ndarray]:
    """Return the ends of the cells with the piece from which each is computed, and the index of each of ``start`` and
    then ``stop`` among them.

    Equal ends are merged where cells follow one another, or everywhere for many cells that share pieces. The end of a
    piece belongs to the next one.
    """
    count, ended = start.size, pieces + (stop == breakpoints[pieces + 1])
    if count <= FEW_CELLS or (pieces[1:] > pieces[:-1]).all():
        is_shared = np.append((stop[:-1] == start[1:]) & (ended[:-1] == pieces[1:]), False)
        end_indices, unshared = np.arange(1, count + 1), np.flatnonzero(~is_shared)
        end_indices[unshared] = count + np.arange(unshared.size)
        points = np.concatenate([start, stop[unshared]]), np.concatenate([pieces, ended[unshared]])
        return points, np.concatenate([np.arange(count), end_indices])
    pairs = np.stack([np.concatenate([start, stop]), np.concatenate([pieces, ended])])
    unique, end_indices = np.unique(pairs, axis=1, return_inverse=True)
    return (unique[0], unique[1].astype(int)), end_indices.reshape(-1)


def enclose(
    lower: Array, upper: Array, touched: np.ndarray, nu: int, cell_over: Callable[[Array, Array], Bounded]
) -> Enclosure:
    """Return upper bounds on cells ``(k, 1 + nu + b)`` of times, ``nu`` parameters and ``b`` coordinates of directions;
    cells with one box ``(low, high)`` of the latter two share its ``cell_over``.

    Cells that are not ``touched (k,)`` are closed: their bound is ``-inf``. A cell without an enclosure has the bound
    ``inf`` and is to be halved. Raises `NotEnclosable` where a tiny one in its middle has none either.
    """
    bounds, split = np.full(lower.shape[0], -np.inf), np.zeros(lower.shape[0], dtype=int)
    if lower.shape[1] == 1:
        bounds, chord_error, _ = cell_over(lower[0, 1:], upper[0, 1:]).bounds(lower[:, 0], upper[:, 0])
        return Enclosure(bounds, split, chord_error)
    for members in _group_by_key(np.hstack([lower[:, 1:], upper[:, 1:]]), touched):
        low, high = lower[members[0], 1:], upper[members[0], 1:]
        try:
            cell = cell_over(low, high)
        except NotEnclosable as error:
            middle, radius = (low + high) / 2, (high - low) / 2
            radius[:nu] *= TINY
            cell_over(middle - radius, middle + radius)
            widest = int(np.argmax((high - low)[:nu])) if error.along is None else error.along
            bounds[members], split[members] = np.inf, 1 + widest
            continue
        bounds[members], chord_error, spread = cell.bounds(lower[members, 0], upper[members, 0])
        coordinates = np.concatenate([np.arange(1 + nu), 1 + nu + np.flatnonzero(high[nu:] > low[nu:])])
        split[members] = coordinates[where_to_halve(chord_error, spread, bounds[members])]
    return Enclosure(bounds, split)


def _group_by_key(keys: Array, touched: np.ndarray) -> list[np.ndarray]:
    """Positions of the touched rows of ``keys``, those with the same row together."""
    touched_rows = np.flatnonzero(touched)
    if not touched_rows.size or not keys.shape[1]:
        return [touched_rows] if touched_rows.size else []
    _, key_indices = np.unique(keys[touched_rows], axis=0, return_inverse=True)
    order = np.argsort(key_indices.reshape(-1), kind="stable")
    return np.split(touched_rows[order], np.flatnonzero(np.diff(key_indices.reshape(-1)[order])) + 1)


def where_to_halve(chord_error: Array, spread: Array, bounds: Array) -> np.ndarray:
    """Return the coordinate to halve of every cell, ``(k,)``: 0 for the times where they matter most, else one other
    coordinate.

    The other coordinate is the same for the whole group, so that its cells stay shared.

    Parameters
    ----------
    chord_error : Array
        Gain ``(k,)`` from halving the times of a cell.
    spread : Array
        Gain ``(k, j)`` from halving each other coordinate.
    bounds : Array
        Upper bounds ``(k,)`` of the violation; where some are positive, only their cells decide on the coordinate.
    """
    if not spread.shape[1]:
        return np.zeros(chord_error.size, dtype=int)
    open_ = bounds > 0
    total = spread[open_].sum(axis=0) if open_.any() else spread.sum(axis=0)
    return np.where(chord_error > TIME_FIRST * spread.max(axis=1), 0, 1 + int(total.argmax()))
