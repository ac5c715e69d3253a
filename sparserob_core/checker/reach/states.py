"""The states that a system reaches under a given control, over a box of parameters, at marks of time and between
them."""

from __future__ import annotations

from bisect import bisect_right
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import final

import numpy as np
from flint import arb_mat

from sparserob_core.checker.arithmetic.balls import ball, balls
from sparserob_core.checker.arithmetic.monomials import Monomials
from sparserob_core.checker.arithmetic.remembered import remembered
from sparserob_core.checker.arithmetic.series import Series, exactly, identity, stacked
from sparserob_core.checker.flow.flow import VerifiedFlow
from sparserob_core.checker.flow.flows import VerifiedFlows
from sparserob_core.checker.flow.law import ParameterBox
from sparserob_core.checker.flow.segment import Powers, VerifiedSegment, shifted
from sparserob_core.checker.problem.held import HeldComponents
from sparserob_core.checker.sets.budget import couple
from sparserob_core.checker.sets.known import known
from sparserob_core.checker.sets.polynomials import OUTWARD, Enclosed, rounding
from sparserob_core.sip.convex_set import Array, ConvexSet

PATHS_KEPT = 256  # intervals whose states are remembered
BOXES_KEPT = 8  # boxes of parameters whose states are remembered
EFFECTS_KEPT = 16  # marks at which the effect of all intervals before is remembered; cells come one after another


@final
@dataclass(frozen=True, eq=False)
class Scene:
    """The inputs and initial states of a system.

    Attributes
    ----------
    grid
        All breakpoints.
    control
        The control on each piece of the grid, ``(m, 1)``; with a drift its last entry is 1.
    initial_state, initial_set
        The centre of the initial states, ``(d,)``, and the set of deviations from it.
    disturbance, changes
        The set of the disturbance, ``None`` without one, and the breakpoints between which it is constant.
    held_components
        The components of the disturbance that are held over several of these intervals.
    """

    grid: list[float]
    control: list[arb_mat]
    initial_state: list[float]
    disturbance: ConvexSet | None
    changes: list[float]
    initial_set: ConvexSet | None = None
    held_components: HeldComponents | None = None


@final
@dataclass(frozen=True, eq=False)
class StateBlock:
    """The flow over ``2^level`` consecutive intervals: the transition ``Phi (d, d)``, and the effects of the
    disturbances on each of them, ``Delta``. The controls of a single interval enter by ``Gamma``."""

    Phi: Series
    Delta: Series
    Gamma: Series

    @cached_property
    def effect(self) -> Enclosed:
        """``Delta`` as floats with radii."""
        return single(self.Delta)


@final
@dataclass(eq=False)
class States:
    """The states that a ``flow`` makes of a ``scene``, as polynomials in the parameters."""

    flow: VerifiedFlow
    scene: Scene

    @cached_property
    def marks(self) -> list[float]:
        """The times between which the flow is a polynomial in time and the inputs are constant."""
        return self.flow.marks(self.scene.grid)

    @cached_property
    def pieces(self) -> list[int]:
        """The index of the piece of the grid that holds each interval between marks."""
        return [bisect_right(self.scene.grid, t) - 1 for t in self.marks[:-1]]

    def place(self, piece: int, time: float) -> int:
        """Return the index of the interval between marks that holds a time in a piece of the grid."""
        last = bisect_right(self.pieces, piece) - 1
        return min(bisect_right(self.marks, time) - 1, last)

    @property
    def last(self) -> Series:
        """The undisturbed state at the end, ``(d, 1)``."""
        return self.node(len(self.marks) - 1)

    @remembered()
    def node(self, mark: int) -> Series:
        """Return the undisturbed state at a mark, ``(d, 1)``, from blocks of intervals as in `effect`."""
        x = Series.constant(self.flow.monomials, stacked([[v] for v in balls(self.scene.initial_state)]))
        for level, number in _list_blocks(mark):
            x = self._find_block(level, number).Phi * x + self._compute_control_effect(level, number)
        return x

    @remembered()
    def _compute_control_effect(self, level: int, number: int) -> Series:
        """Return what the control adds to the state over ``2^level`` consecutive intervals, ``(d, 1)``."""
        if not level:
            return self._apply_control(self._find_block(0, number), self.scene.control[self.pieces[number]])
        early, late = (self._compute_control_effect(level - 1, 2 * number + i) for i in range(2))
        return self._join_effects(self._find_block(level - 1, 2 * number + 1), early, late)

    @remembered(key=lambda self, block, u: (id(block), id(u)))
    def _apply_control(self, block: StateBlock, u: arb_mat) -> Series:
        return block.Gamma.scaled(u)

    @remembered(key=lambda self, *parts: tuple(map(id, parts)))  # most pieces of a sparse control are the same
    def _join_effects(self, block: StateBlock, early: Series, late: Series) -> Series:
        return block.Phi * early + late

    @remembered(lambda: EFFECTS_KEPT)
    def effect(self, mark: int) -> tuple[Enclosed, Enclosed]:
        """Return how the state at a mark depends on the initial state, ``(M, d, d)``, and on the disturbance on every
        interval before the mark, ``(M, d, mark mw)``. Both are made of blocks of 1, 2, 4, ... intervals, each
        propagated by the blocks after it."""
        d, blocks = self.flow.states, [self._find_block(*pair) for pair in _list_blocks(mark)]
        monomials = self.flow.monomials
        after, effects = Series.constant(monomials, identity(d)), [Enclosed(*np.zeros((2, monomials.size, d, 0)))]
        for block in reversed(blocks):
            effects.insert(1, ring(monomials, single(after), block.effect))
            after = after * block.Phi
        mid, rad = (np.concatenate([getattr(effect, name) for effect in effects], axis=2) for name in ("mid", "rad"))
        return single(after), Enclosed(mid, rad)

    @remembered()
    def _find_block(self, level: int, number: int) -> StateBlock:
        """Return the block of ``2^level`` consecutive intervals. Blocks with the same flow are one object."""
        if not level:
            return self._make_block(self.marks[number], self.marks[number + 1])
        return self._join_blocks(*(self._find_block(level - 1, 2 * number + i) for i in range(2)))

    @remembered(key=lambda self, start, stop: self.flow.kind(start, stop))
    def _make_block(self, start: float, stop: float) -> StateBlock:
        step, d, driven = self.flow.step(start, stop), self.flow.states, self.flow.states + self.flow.driven
        has_disturbance = self.scene.disturbance is not None
        Delta = step.columns(driven, None) if has_disturbance else step.columns(0, 0)
        return StateBlock(step.columns(0, d), Delta, step.columns(d, driven))

    @remembered(key=lambda self, *pair: tuple(map(id, pair)))
    def _join_blocks(self, first: StateBlock, second: StateBlock) -> StateBlock:
        Delta = (second.Phi * first.Delta).append_columns(second.Delta)
        return StateBlock(second.Phi * first.Phi, Delta, second.Gamma.columns(0, 0))

    def project(
        self, basis: Array, place: int, start: float, stop: float, order: int
    ) -> tuple[Enclosed, list[tuple[ConvexSet, Enclosed]]]:
        """Return the states projected onto rows ``basis (b, d)`` on a part from ``start`` to ``stop`` of the interval
        number ``place`` between marks, as polynomials of at most ``order = J`` terms in the share of the part.

        They are the undisturbed state, ``(J, M, b)``; and for the disturbance and the initial deviation, as far as
        there are any, the set and the effect per unit of every entry on every block, ``(blocks, J, M, w, b)``."""
        flow, scene, d, m = self.flow, self.scene, self.flow.states, self.flow.driven
        begin, end, order = self.marks[place], self.marks[place + 1], 1 if start == stop else order
        segment, share = flow.segment(begin, end)
        first, width = ((ball(b) - ball(a)) / (ball(end) - ball(begin)) * share
                        for a, b in ((begin, start), (start, stop)))  # fmt: skip
        terms, remainder = self._compute_path(place).within(first, width, order)
        rows = exactly(basis)
        state = enclosed([term.along(rows) for term in terms])
        state.rad[0, 0] += np.abs(basis) @ remainder * OUTWARD
        lines = self._project_flow(segment, basis).shifted(float(first), float(width), order)
        propagated_rows, effects = lines[..., :d], list[tuple[ConvexSet, Enclosed]]()
        if scene.disturbance is not None and stop > 0.0:
            past = ring(flow.monomials, propagated_rows, self.effect(place)[1])
            shape = (*past.mid.shape[:3], place, -1) if place else (*past.mid.shape[:3], 0, lines.mid.shape[-1] - d - m)
            mid, rad = (
                np.moveaxis(
                    np.concatenate([earlier.reshape(shape), current[:, :, :, None, d + m :]], axis=3), (3, 4), (0, 3)
                )
                for earlier, current in ((past.mid, lines.mid), (past.rad, lines.rad))
            )
            block = np.searchsorted(np.array(scene.changes), np.array(self.marks[: place + 1]), side="right")
            firsts = np.flatnonzero(np.diff(block, prepend=-1))
            rad = (rad + rounding(len(mid)) * np.abs(mid)) * OUTWARD
            mid, rad = (np.add.reduceat(values, firsts, axis=0) for values in (mid, rad))
            if scene.held_components is not None:
                mid, rad = scene.held_components.gathered(mid, rad)
            lengths = np.diff([*scene.changes, scene.grid[-1]])[: len(mid)]
            coupled, mid, rad = couple(scene.disturbance, lengths, mid, rad)
            effects.append((coupled, Enclosed(mid, rad)))
        if scene.initial_set is not None:
            initial = ring(flow.monomials, propagated_rows, self.effect(place)[0])
            effects.append((scene.initial_set, initial.swapped(2, 3)[None]))
        return state[..., 0], effects

    @remembered(lambda: PATHS_KEPT)
    def _compute_path(self, place: int) -> Powers:
        """Return the undisturbed state from one mark to the next, ``(d, 1)``, as a polynomial in the share of the
        interval."""
        segment, _ = self.flow.segment(self.marks[place], self.marks[place + 1])
        control = self.scene.control[min(self.pieces[place], len(self.scene.control) - 1)]
        return segment.applied(self.node(place).above(control))

    @remembered(lambda: PATHS_KEPT, lambda self, segment, basis: (segment, basis.tobytes()))
    def _project_flow(self, segment: VerifiedSegment, basis: Array) -> Lines:
        """Return the products of the rows ``basis (b, d)`` with the flow on a segment."""
        return Lines.of(segment, basis)

    def blur(self, place: int) -> Array:
        """Return about how much of the error of the state at a mark, ``(d,)``, is due to the size of the box of
        parameters. No claim rests on it."""
        if not self.flow.monomials.degree:
            return np.zeros(self.flow.states)
        mark = max(place, 1)  # at the first mark nothing is uncertain yet
        radii = np.array([float(x.rad()) for x in self.node(mark).parts[0].entries()])
        for convex, number in ((self.scene.initial_set, 0), (self.scene.disturbance, 1)):
            if convex is not None:
                rad = self.effect(mark)[number].rad[0]
                radii += rad.reshape(*rad.shape[:1], -1, convex.dimension).sum(axis=1) @ np.array(known(convex).radius)
        return radii


@final
@dataclass(frozen=True, eq=False)
class StatesOverBoxes:
    """The states of a ``scene`` over boxes of parameters; those over the latest boxes are remembered."""

    flows: VerifiedFlows
    scene: Scene

    def over(self, box: ParameterBox) -> States:
        """Return the states over a box, or over a larger one that holds it."""
        return self._build_states(self.flows.holding(box))

    @remembered(lambda: BOXES_KEPT)
    def _build_states(self, flow: VerifiedFlow) -> States:
        return States(flow, self.scene)


@final
@dataclass(frozen=True, eq=False)
class Lines:
    """Products of rows with the flow on a segment of time: ``terms (N, M, b, d + w)`` in powers of its share.

    ``off (b, d + w)`` is the error bound of this polynomial at any share for which the segment is verified.
    ``sizes (N, b, d + w)`` are upper bounds of the absolute values of the terms at every parameter.
    """

    terms: Enclosed
    off: Array
    sizes: Array

    @staticmethod
    def of(segment: VerifiedSegment, basis: Array) -> Lines:
        """Return the products of the rows ``basis (b, d)`` with the flow on a segment."""
        rows = exactly(basis)
        terms = enclosed([term.along(rows) for term in segment.terms])
        return Lines(terms, np.abs(basis) @ segment.off * OUTWARD, np.abs(basis) @ segment.powers.sizes * OUTWARD)

    def shifted(self, first: float, width: float, order: int) -> Enclosed:
        """Return the rows on a part of the segment, from the share ``first`` on and of this ``width``. They are at most
        ``order`` terms in powers of its share, ``(J, M, b, d + w)``; the remainder is in the radius of the first."""
        count = len(self.terms.mid)
        table = shifted(first, width, count)
        kept, size = table[:order], np.abs(self.terms.mid)
        mid = np.tensordot(kept, self.terms.mid, axes=1)
        rad = np.tensordot(kept, self.terms.rad + rounding(20 * count) * size, axes=1)
        rad[0, 0] += self.off + np.tensordot(table[order:].sum(axis=0), self.sizes, axes=1)
        return Enclosed(mid, rad * OUTWARD)


def _list_blocks(mark: int) -> list[tuple[int, int]]:
    """Return the level and the number of the blocks of ``2^level`` intervals that fill those before a mark, longest
    first."""
    blocks, begin = [], 0
    for level in range(mark.bit_length() - 1, -1, -1):
        if mark >> level & 1:
            blocks.append((level, begin >> level))
            begin += 1 << level
    return blocks


def enclosed(series: Sequence[Series]) -> Enclosed:
    """Return the coefficients of series of one shape as floats with radii, ``(J, M, rows, columns)``."""
    first = series[0]
    shape = len(series), len(first.parts), *first.shape
    return Enclosed.all([matrix for term in series for matrix in term.parts], shape)


def single(series: Series) -> Enclosed:
    """Return the coefficients of one series as floats with radii, ``(M, rows, columns)``."""
    return enclosed([series])[0]


def ring(monomials: Monomials, left: Enclosed, right: Enclosed) -> Enclosed:
    """Return the products of polynomials in the parameters, ``left (..., M, a, d)`` times ``right (M, d, n)``,
    truncated at the degree. The radii of the constants hold the truncation error."""
    left_size, right_size = np.abs(left.mid), np.abs(right.mid)
    right_error = right.rad + rounding(left.mid.shape[-1] * monomials.size) * right_size
    mid = _multiply_coefficients(monomials, left.mid, right.mid)
    with np.errstate(invalid="ignore"):
        rad = _multiply_coefficients(monomials, left_size, right_error) + _multiply_coefficients(
            monomials, left.rad, right_size + right.rad
        )
    rad = np.where(np.isnan(rad), np.inf, rad)  # 0 times infinity: no bound
    if monomials.degree:
        degrees = np.array(monomials.degrees)
        sums = [
            np.stack([values[..., degrees == n, :, :].sum(axis=-3) for n in range(monomials.degree + 1)])
            for values in (left_size + left.rad, right_size + right.rad)
        ]
        later = np.cumsum(sums[1][:0:-1], axis=0)
        rad[..., 0, :, :] += sum(sums[0][n] @ later[n - 1] for n in range(1, monomials.degree + 1))
    return Enclosed(mid, rad * OUTWARD)


def _multiply_coefficients(monomials: Monomials, left: Array, right: Array) -> Array:
    """Return the coefficients of the products up to the degree by one matrix product: ``right (M, d, n)`` becomes a
    matrix ``(M d, M n)``, whose blocks belong to a monomial of the left factor and a monomial of the product."""
    (M, d, n), indices = right.shape, monomials.quotients
    table = np.concatenate([right, np.zeros((1, d, n))])[indices]  # (M, M, d, n)
    rows = np.swapaxes(left, -3, -2)
    product = rows.reshape(*rows.shape[:-2], M * d) @ table.transpose(0, 2, 1, 3).reshape(M * d, M * n)
    return np.swapaxes(product.reshape(*rows.shape[:-2], M, n), -3, -2)
