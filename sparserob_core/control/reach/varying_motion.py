"""A known system that changes with time, between the breakpoints, as bounds over cells of time see it.

Between two *marks*, breakpoints and ends of segments of the expansion, the system is one polynomial of the time but
for a remainder. There ``y'' = Q y + R v`` with ``Q = A' + A^2`` and ``R = F' + A F`` for the state, and for what any
block of an uncertainty makes of it, under inputs ``v`` through ``F = [B E]``; and what ``y''`` moves by within a cell
is bounded entry by entry by its own derivative. What is computed may be off by what every step was off by, carried on:
the products of transitions that carry it are at most what is computed of them, and a little.

Of a system with parameters that its state is no affine function of, it is the motion of all coefficients of an
expansion in them. With ``x = sum_a delta^a x_a + R`` (`Spread`), what is beyond the degree ``D`` obeys ``R' = A(t, p)
R`` plus the products of coefficients of ``A`` and of the state whose degrees add up to more than ``D``. So it is at
most the transitions' norm times the integral of ``sum_j n_j sum_(b > D - j) a_b``, with ``a_b`` and ``n_j`` the norms
of all coefficients of ``A`` and of the state of a degree; and the transitions themselves are such an expansion, whose
norm is bounded by what it is of its own coefficients. Of entries that are no polynomials what their own power series
leave (`Left`) is there too: that of ``A`` times all coefficients of the state, and that of ``[B E]`` times inputs.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from sparserob_core.control.enclosures.cache import remember
from sparserob_core.control.enclosures.comparison import product
from sparserob_core.control.enclosures.dependence import Spread
from sparserob_core.control.enclosures.matrix_exponential import rounding
from sparserob_core.control.enclosures.taylor import Combination, TaylorSpace
from sparserob_core.control.reach.disturbance_support import over_faces, summed
from sparserob_core.control.response.disturbance import DisturbanceModel
from sparserob_core.control.response.response import Propagator, TimeGrid
from sparserob_core.control.response.varying.expansion import Expansion, Flow
from sparserob_core.errors import NotEnclosable
from sparserob_core.sip.convex_set import Array, ConvexSet

KNOWN = TaylorSpace(0, 0)
GROWN = 8  # terms of an exponential of bounds, whose tail is added; half of them, and third derivatives count twice
OUTWARD = 1.0 + 1e-12  # for sums of some thousand numbers that are not negative
AT_ONCE = 4_000_000  # numbers of weights that are made at once
TINY = float(np.finfo(float).tiny)
TERMS = 40  # of the exponential of norms on a piece, which are at most a few: 4^40 / 40! is 1e-24
REST = 1e-20  # of the norms, more than what is beyond these terms
RATIOS = (1.0, 2.0, 4.0, 8.0, 16.0)
"""What a degree more counts in the norms that transitions are off by: with the first alone each coefficient of a high
degree is off by what the constant one is, and what is beyond never falls below rounding times the growth."""
PATHS_KEPT = 4  # controls whose states are remembered
WAYS_KEPT = 4  # times of which the way there is: those of cells, and where they begin, of two constraints
STRETCHES = 256  # of pieces, whose carries count at their largest; a tenth mixes parts of an orbit, ten times are 1 GB


@dataclass(frozen=True, eq=False)
class VaryingMotion:
    """The `Motion` of a system that changes with time from one initial state ``(d,)``; each state is a block of its
    own, so that all bounds are entry by entry."""

    propagator: Propagator
    initial_state: Array

    @cached_property
    def grid(self) -> TimeGrid:
        """The pieces between all marks, ``K`` of them."""
        whole, origin = self.propagator.grid, self.origin
        acting, pushing = whole.control_piece[origin], whole.disturbance_piece[origin]
        numbers = np.arange(origin.size)
        marks = self.propagator.marks
        return TimeGrid(marks, acting, pushing, whole.before, whole.constants, mode=numbers, varying=True)

    @cached_property
    def origin(self) -> np.ndarray:
        """The piece of the propagator's grid that each of the pieces is in, ``(K,)``."""
        marks = self.propagator.marks
        return self.propagator.grid.locate((marks[:-1] + marks[1:]) / 2)

    @property
    def space(self) -> TaylorSpace:
        """Nothing depends on parameters."""
        return KNOWN

    @property
    def states(self) -> int:
        """``d``."""
        return int(self.initial_state.size)

    @cached_property
    def transform(self) -> Array:
        """The identity."""
        return np.eye(self.states)

    @cached_property
    def starts(self) -> np.ndarray:
        """Every state is a block."""
        return np.arange(self.states)

    @property
    def influence(self) -> Array:
        """There are no parameters."""
        return np.zeros(0)

    @cached_property
    def norm(self) -> float:
        """The largest norm of ``A``, in its own units."""
        return float(self.paces.max())

    @property
    def terms(self) -> int:
        """How many numbers are added up to an entry of `bends` times a state."""
        return 2 * int(self.expansion.coefficients.shape[1]) + 4 * self.states

    @cached_property
    def expansion(self) -> Expansion:
        """The system as polynomials in time."""
        expansion = self.propagator.expansion
        assert expansion is not None
        return expansion

    @cached_property
    def flow(self) -> Flow:
        """What the pieces make of states and inputs."""
        marks = self.propagator.marks
        return self.expansion.flow(marks[:-1], marks[1:])

    @cached_property
    def inputs(self) -> Array:
        """What the pieces make of inputs, those of the disturbance after the others, ``(K, d, m + mw)``."""
        return np.concatenate([self.flow.control, self.flow.disturbance], axis=2)

    def nodes(self, control: Array) -> Array:
        """States ``(K + 1, 1, d)`` at the marks."""
        key = control.tobytes()
        if key not in self._paths:
            pushed = np.einsum("kdm,mk->kd", self.flow.control, self.grid.inputs(control))
            path = np.empty((pushed.shape[0] + 1, self.states))
            path[0] = self.initial_state
            for k, (step, push) in enumerate(zip(self.flow.state, pushed, strict=True)):
                path[k + 1] = step @ path[k] + push
            remember(self._paths, key, path[:, None], PATHS_KEPT)
        return self._paths[key]

    @cached_property
    def _paths(self) -> dict[bytes, Array]:
        return {}

    def moved(self, within: Array, pieces: np.ndarray, begun: Array, inputs: Array) -> Array:
        """`Motion.moved`."""
        flow = self.over(within, pieces)
        found = np.einsum("kij,kj->ki", flow.state, begun[:, 0]) + np.einsum("kim,km->ki", flow.control, inputs)
        return np.asarray(found[:, None])

    def over(self, within: Array, pieces: np.ndarray) -> Flow:
        """What the first times ``within (k,)`` pieces make of states and inputs; remembered, since a state and all that
        is uncertain of it are looked at together."""
        pieces = np.minimum(pieces, self.origin.size - 1)  # beyond the last there is no time
        key = within.tobytes() + pieces.tobytes()
        if key not in self._ways:
            start = self.grid.breakpoints[pieces]
            remember(self._ways, key, self.expansion.flow(start, start + within), WAYS_KEPT)
        return self._ways[key]

    @cached_property
    def _ways(self) -> dict[bytes, Flow]:
        return {}

    def deviation(
        self, rows: Array, start: Array, width: Array, pieces: np.ndarray, states: Array, inputs: Array
    ) -> Array:
        """`Motion.deviation`."""
        return self.bent(rows, start, width, pieces, states[:, 0, :, None], inputs[:, :, None], np.ones(1))

    def bent(
        self,
        rows: Array,
        start: Array,
        width: Array,
        pieces: np.ndarray,
        states: Array,
        inputs: Array,
        sizes: Array,
    ) -> Array:
        """How far ``rows (r, d)``, or ``(k, r, d)``, of several states are from their chords on ``[start, start +
        width]``, ``(k, r)``: of any sum of ``states (k, d, n)`` at ``start``, driven by the first of the ``inputs (k,
        i, n)``, each times a factor of at most its size, ``sizes (n,)``. By the second time derivative at the start,
        and how far the third may move it."""
        d, last = self.states, self.states + inputs.shape[1]
        at = self.bends(start, pieces)[:, :, :last]
        bent = at[:, :, :d] @ states + at[:, :, d:] @ inputs
        begun, pushes = np.abs(states) @ sizes, np.abs(inputs) @ sizes
        most, third = self.most[pieces], self.third[pieces]
        reached = begun + width[:, None] * np.einsum("kim,km->ki", most[:, :, d:last], pushes)
        turned = np.einsum("kij,kj->ki", third[:, :, :d], self.grown(pieces, width, reached))
        turned = turned + np.einsum("kim,km->ki", third[:, :, d:last], pushes)
        added = np.einsum("kij,kj->ki", np.abs(at), np.concatenate([begun, pushes], axis=1))
        turned = width[:, None] * turned + rounding(self.terms + inputs.shape[1]) * added
        along = np.abs(rows @ bent) @ sizes + (np.abs(rows) @ turned[:, :, None])[:, :, 0]
        return np.asarray((width**2 / 8)[:, None] * along * OUTWARD)

    def along(self, control: Array, rows: Array, others: Array) -> Array:
        """`Motion.along`."""
        left_out, sizes = self.under(control)
        return np.asarray(product(rows, left_out.T) + product(others, sizes.T))

    def under(self, control: Array) -> tuple[Array, Array]:
        """What states under a control may be off by on every piece, and how large they are at most, ``(K, d)`` each;
        remembered, since it is the same for all rows."""
        key = control.tobytes()
        if key not in self._under:
            inputs, path = np.abs(self.grid.inputs(control)), np.abs(self.nodes(control)[:-1, 0])
            m = inputs.shape[0]
            left_out = self.left_out(path, self.flow.sizes[:, :, :m] * inputs.T[:, None])
            pushed = np.einsum("kim,mk->ki", self.most[:, :, self._columns(m)], inputs)
            begun = path + self.grid.lengths[:, None] * pushed
            found = left_out, self.grown(self.every, self.grid.lengths, begun)
            remember(self._under, key, found, PATHS_KEPT)
        return self._under[key]

    @cached_property
    def _under(self) -> dict[bytes, tuple[Array, Array]]:
        return {}

    def left_out(self, sizes: Array, pushed: Array) -> Array:
        """What states that are at most ``sizes (K, d)`` at the beginning of every piece, and are driven by at most
        ``pushed (K, d, ...)`` in the norm of the units of what is coupled with each, may be off by on it, entry by
        entry, ``(K, d)``: twice, since both a chord and the state itself are looked at; and what that makes of the
        second and third derivative."""
        lost, lengths, d = self._lost(sizes, pushed.sum(axis=2)), self.grid.lengths[:, None], self.states
        second = np.einsum("kij,kj->ki", self.second[:, :, :d], lost)
        third = np.einsum("kij,kj->ki", self.third[:, :, :d], self.grown(self.every, lengths[:, 0], lost))
        return np.asarray((2.0 * lost + lengths**2 / 8 * (second + lengths * third)) * OUTWARD)

    def _lost(self, sizes: Array, pushed: Array) -> Array:
        """Every step misses a share of what it begins with, and of what drives it, of states that are coupled with one
        another, in the units of its segment; that is carried on by the transitions from there, and within the piece."""
        units, off = self._steps_off
        begun = self.expansion.over_parts((sizes / units)[:, :, None])[:, :, 0]
        here = np.maximum(off[:, None] * (begun + pushed), TINY)  # not 0, which times no bound is no number
        stretch, first = self._stretches
        so_far, whole = np.empty_like(here), np.add.reduceat(here, first, axis=0)
        for begin, end in zip(first, [*first[1:], len(here)], strict=True):
            so_far[begin:end] = np.cumsum(here[begin:end], axis=0)
        carried, all_before = np.zeros_like(here), np.arange(first.size) < stretch[:-1, None]
        carried[1:] = np.einsum("kb,kbi,bi->ki", all_before, self.carries[1:-1], whole)
        carried[1:] += self.carries[np.arange(1, len(here)), stretch[:-1]] * so_far[:-1]
        return np.asarray((self.grown(self.every, self.grid.lengths, carried) + units * here) * OUTWARD)

    @cached_property
    def _steps_off(self) -> tuple[Array, Array]:
        """The units ``(K, d)`` of the segment that a piece is in, or of all where it is in several, and what its step
        is off by in the norm of largest row sums in them, what a product with it rounds included, ``(K,)``."""
        expansion, marks, flow = self.expansion, self.propagator.marks, self.flow
        apart = np.searchsorted(expansion.ends, marks[1:], side="left") - 1 > expansion.segment_of(marks[:-1])
        ratios = np.where(apart[:, None], 1.0, expansion.ratios[self._segments])
        units = expansion.units * ratios
        off = flow.error / ratios.max(axis=1)
        ahead = (np.abs(flow.state) / units[:, :, None] * units[:, None]).sum(axis=2).max(axis=1)
        return units, off + rounding(self.states + self.inputs.shape[2]) * (ahead + off)

    @cached_property
    def _stretches(self) -> tuple[np.ndarray, np.ndarray]:
        """The stretch of the horizon that each piece is in, ``(K,)``, and the first piece of each."""
        stretch = self.every // -(-self.every.size // STRETCHES)
        return stretch, np.unique(stretch, return_index=True)[1]

    @cached_property
    def carries(self) -> Array:
        """What the transitions to every mark from the ends of the pieces of a stretch before it make of a step that
        is off by 1 in the units of its piece, state by state, at most: ``(K + 1, stretches, d)``. That of the computed
        ones, and with ``P`` the largest norm of them, each in the units of the pieces that end at both marks, and ``e``
        the sum of what all steps are off by in these, ``P^2 e / (1 - P e)`` more."""
        (units, off), first = self._steps_off, self._stretches[1]
        found = np.zeros((len(units) + 1, first.size, self.states))
        for mark, sums in enumerate(self.sums()):
            begun = first[first < mark]
            if mark:
                found[mark, : begun.size] = np.maximum.reduceat(sums[1:], begun, axis=0)
        found = self.expansion.of_all(found)
        before = np.concatenate([units[:1], units[:-1]])
        ends = np.concatenate([units[:1], units])
        largest = max(1.0, float((found / ends[:, None]).max()))
        share = largest * float((off * (before / units).max(axis=1)).sum())
        more = largest * share / (1.0 - share) if share < 0.5 else np.inf
        return found + np.where(found > 0.0, more * ends[:, None], 0.0)

    def sums(self) -> Iterator[Array]:
        """Yield, mark after mark, what the transitions to it from every mark up to it make of states that are at most 1
        in the units of the piece before, ``(marks, d)``; of coefficients of polynomials, of the constant ones."""
        units, own = self._steps_off[0], self.expansion.own
        every = np.empty((len(units) + 1, self.states, own))
        for mark in range(len(every)):
            if mark:
                every[:mark] = self.flow.state[mark - 1] @ every[:mark]
            every[mark] = np.diag(units[max(mark - 1, 0)])[:, :own]
            yield np.abs(every[: mark + 1]).sum(axis=2)

    def grown(self, pieces: np.ndarray, width: Array, sizes: Array) -> Array:
        """What states of at most ``sizes (k, d)`` may become within a ``width (k,)`` of a piece, ``(k, d)``: by the
        exponential of the largest entries of ``A`` there."""
        most, pace = self.most[pieces][:, :, : self.states], self.paces[pieces] * width
        units = self.expansion.units * self.expansion.ratios[self._segments[pieces]]
        total, term = sizes.astype(float), sizes.astype(float)
        for n in range(1, GROWN):
            term = np.einsum("kij,kj->ki", most, term) * (width / n)[:, None]
            total = total + term
        shares = (pace / GROWN) / np.maximum(1.0 - pace / (GROWN + 1), 0.1)
        rest = self.expansion.over_parts((term / units)[:, :, None])[:, :, 0] * shares[:, None]
        rest = np.where(pace[:, None] < 0.8 * GROWN, rest, np.inf)
        return np.asarray((total + units * rest) * OUTWARD)

    def place(self, times: Array) -> np.ndarray:
        """The mark at or before each time."""
        return np.maximum(np.searchsorted(self.grid.breakpoints, times, side="right") - 1, 0)

    def bends(self, times: Array, pieces: np.ndarray) -> Array:
        """``[Q R]`` at times on pieces, ``(k, d, d + m + mw)``."""
        law, slope = self.law(times, pieces)
        return np.asarray(slope + law[:, :, : self.states] @ law)

    def law(self, times: Array, pieces: np.ndarray) -> tuple[Array, Array]:
        """``[A F]`` and its derivative at times on pieces, ``(k, d, d + m + mw)`` each."""
        size = max(1, AT_ONCE // self.expansion.coefficients[0].size)
        if times.size > size:
            every = [slice(begin, begin + size) for begin in range(0, times.size, size)]
            parts = [self.law(times[part], pieces[part]) for part in every]
            return np.concatenate([one for one, _ in parts]), np.concatenate([one for _, one in parts])
        segments = self._segments[pieces]
        begin, end = self.expansion.ends[segments], self.expansion.ends[segments + 1]
        every = self.expansion.coefficients[segments]
        radius, orders = (end - begin) / 2, np.arange(every.shape[1])
        powers = ((times - (begin + end) / 2) / radius)[:, None] ** orders
        law = np.einsum("kn,knij->kij", powers, every)
        slope = np.einsum("kn,knij->kij", powers[:, :-1] * orders[1:] / radius[:, None], every[:, 1:])
        return law, slope

    @cached_property
    def every(self) -> np.ndarray:
        """The numbers of all pieces."""
        return np.arange(self.origin.size)

    def _columns(self, m: int) -> slice:
        return slice(self.states, self.states + m)

    @cached_property
    def _segments(self) -> np.ndarray:
        """The segment of the expansion that each piece is in, ``(K,)``."""
        marks = self.propagator.marks
        return self.expansion.segment_of((marks[:-1] + marks[1:]) / 2)

    @cached_property
    def _bounds(self) -> tuple[Array, Array, Array, Array]:
        """Of ``[A F]`` on every piece, entry by entry: the largest absolute values, those of the second and third
        derivative of a solution by what multiplies it and its inputs, ``(K, d, d + m + mw)`` each; and the norm of
        ``A`` in own units, ``(K,)``."""
        expansion, d, sizes = self.expansion, self.states, np.abs(self.expansion.coefficients)
        radius, orders = (np.diff(expansion.ends) / 2)[:, None, None], np.arange(float(sizes.shape[1]))
        most = sizes.sum(axis=1) + expansion.remainder
        once = np.einsum("n,snij->sij", orders, sizes) / radius
        twice = np.einsum("n,snij->sij", orders * (orders - 1.0), sizes) / radius**2
        A, slope = most[:, :, :d], once[:, :, :d]
        second = once + A @ most
        third = twice + slope @ most + A @ once + second[:, :, :d] @ most
        units = expansion.units * expansion.ratios
        pace = (A / units[:, :, None] * units[:, None]).sum(axis=2).max(axis=1)
        return most * OUTWARD, second * OUTWARD, third * OUTWARD, pace * OUTWARD

    @cached_property
    def most(self) -> Array:
        """The largest absolute values of ``[A F]`` on every piece, ``(K, d, d + m + mw)``."""
        return np.asarray(self._bounds[0][self._segments])

    @cached_property
    def second(self) -> Array:
        """Those of what makes the second derivative, ``(K, d, d + m + mw)``."""
        return np.asarray(self._bounds[1][self._segments])

    @cached_property
    def third(self) -> Array:
        """Those of what makes the third derivative, ``(K, d, d + m + mw)``."""
        return np.asarray(self._bounds[2][self._segments])

    @cached_property
    def paces(self) -> Array:
        """The norm of ``A`` in own units on every piece, ``(K,)``."""
        return np.asarray(self._bounds[3][self._segments])

    @cached_property
    def of_initial(self) -> Array:
        """What a deviation of the initial state makes of the states at the marks, ``(K + 1, d, 1, d)``."""
        found = np.empty((self.origin.size + 1, self.states, self.states))
        found[0] = np.eye(self.states)
        for k, step in enumerate(self.flow.state):
            found[k + 1] = step @ found[k]
        return found[:, :, None]

    @cached_property
    def of_disturbance(self) -> Array:
        """What the disturbance on every piece of the propagator's grid makes of the states at the marks, ``(K + 1, d,
        L, mw)``."""
        pushes = self.flow.disturbance
        found = np.zeros((self.origin.size + 1, self.states, self.propagator.grid.pieces, pushes.shape[2]))
        for k, (step, piece) in enumerate(zip(self.flow.state, self.origin.tolist(), strict=True)):
            found[k + 1, :, : piece + 1] = np.einsum("ij,jlw->ilw", step, found[k, :, : piece + 1])
            found[k + 1, :, piece] += pushes[k]
        return found


@dataclass(frozen=True, eq=False)
class VaryingSupport:
    """The support function of a part of the uncertainty on functionals ``rows (r, d)`` of a system that changes with
    time: as `DisturbanceSupport`, for one that is known.

    ``effect (K + 1, d, P, w)``: what its ``P`` parts made of the state until every mark; ``blocks``: from weights
    ``(..., P, w)`` on these to those on its blocks ``(..., nb, q)``, each of which is in ``set``; ``far (w,)``: how
    far a part goes. ``lasts``: it acts all the time, on the piece of the grid as it is its turn, through ``E``.
    """

    motion: VaryingMotion
    set: ConvexSet
    effect: Array
    blocks: Callable[[Array], Array]
    far: Array
    lasts: bool
    rows: Array
    combination: Combination | None = None

    @staticmethod
    def of_disturbance(
        motion: VaryingMotion, model: DisturbanceModel, rows: Array, combination: Combination | None
    ) -> VaryingSupport:
        """That of the worst disturbance."""
        far = model.bound.reach(np.eye(model.channels))
        return VaryingSupport(motion, model.set, motion.of_disturbance, model.blocks, far, True, rows, combination)

    @staticmethod
    def of_initial(
        motion: VaryingMotion, bound: ConvexSet, rows: Array, combination: Combination | None
    ) -> VaryingSupport:
        """That of the worst deviation of the initial state, one block that acts at time 0."""
        far = bound.reach(np.eye(bound.dimension))
        return VaryingSupport(motion, bound, motion.of_initial, lambda one: one, far, False, rows, combination)

    def steepness(self, times: Array) -> Array:
        """`Support.steepness`."""
        sizes = self.set.reach(self._seen(times)).sum(axis=3)
        return np.asarray(sizes @ self._space.exponents)

    def at(self, times: Array, ends: Array) -> tuple[Array, Array]:
        """`Support.at`."""
        return over_faces(
            self._space, ends, lambda here, face: summed(self.set, self._seen(times[here]), face).sum(axis=2)
        )

    def deviation(self, start: Array, widths: Array) -> Array:
        """`Support.deviation`: as `VaryingMotion.deviation`, for every block."""
        motion, d = self.motion, self.motion.states
        pieces = np.minimum(motion.place(start), motion.origin.size - 1)
        at = motion.bends(start, pieces)
        bent = self.weights(start, self.rows @ at[:, :, :d])
        third = motion.third[pieces]
        turned = np.einsum("kij,kj->ki", third[:, :, :d], self.reached[pieces])
        if self.lasts:
            pushes = slice(at.shape[2] - self.far.size, None)
            bent[np.arange(start.size), :, motion.origin[pieces]] += self.rows @ at[:, :, pushes]
            turned = turned + third[:, :, pushes] @ self.far
        exact = self.set.reach(self.blocks(bent)).sum(axis=2)
        turned = widths[:, None] * turned
        turned = turned + rounding(motion.terms + bent[0, 0].size) * np.einsum(
            "kij,kj->ki", motion.second[pieces][:, :, :d], self.reached[pieces]
        )
        along = exact + turned @ np.abs(self.rows).T
        return np.asarray((widths**2 / 8)[:, None] * along * OUTWARD)

    @cached_property
    def neglected(self) -> Array:
        """What is off in the transitions, and rounded in the sums over the blocks, on every piece: ``(r, K)``."""
        motion, sums = self.motion, self.sizes
        pushed = np.zeros((sums.shape[0] - 1, 1, 1))
        if self.lasts:
            pushed = motion.flow.sizes[..., -self.far.size :] * self.far
        total = motion.left_out(sums[:-1], pushed) + rounding(self.effect[0, 0].size) * self.reached
        return product(np.abs(self.rows), total.T)

    @cached_property
    def reached(self) -> Array:
        """What any of it can have made of every state on every piece, ``(K, d)``."""
        motion, begun = self.motion, self.sizes[:-1]
        lengths = motion.grid.lengths
        if self.lasts:
            begun = begun + lengths[:, None] * (motion.most[:, :, -self.far.size :] @ self.far)
        return motion.grown(motion.every, lengths, begun)

    @cached_property
    def sizes(self) -> Array:
        """The same at the marks, ``(K + 1, d)``."""
        return np.asarray(np.einsum("kdpw,w->kd", np.abs(self.effect), self.far) * OUTWARD)

    @property
    def _space(self) -> TaylorSpace:
        return KNOWN if self.combination is None else self.combination.space

    def _seen(self, times: Array) -> Array:
        """Taylor coefficients ``(k, r, M, nb, q)`` of what the functionals give to every block."""
        rows = np.broadcast_to(self.rows, (times.size, *self.rows.shape))
        found = self.blocks(self.weights(times, rows))[:, :, None]
        return found if self.combination is None else self.combination.apply(found)

    def weights(self, times: Array, rows: Array) -> Array:
        """What rows ``(k, r, d)`` at times ``(k,)`` give to every part, ``(k, r, P, w)``."""
        motion, place = self.motion, self.motion.place(times)
        parts = self.effect.shape[2:]
        flow = motion.over(times - motion.grid.breakpoints[place], place)
        carried = rows @ flow.state
        found = np.empty((*rows.shape[:2], *parts))
        size = max(1, AT_ONCE // max(1, motion.states * parts[0] * parts[1]))
        for begin in range(0, times.size, size):
            part = slice(begin, begin + size)
            table = self.effect[place[part]].reshape(-1, motion.states, parts[0] * parts[1])
            found[part] = (carried[part] @ table).reshape(-1, rows.shape[1], *parts)
        if self.lasts:
            pieces = motion.origin[np.minimum(place, motion.origin.size - 1)]
            found[np.arange(times.size), :, pieces] += rows @ flow.disturbance
        return found


@dataclass(frozen=True, eq=False)
class Truncation:
    """What an expansion leaves out of states that a ``motion`` of all coefficients tells of; in the norm of the units
    of the first block of these. ``known``: the `growth` on a cell around this one, where that is known."""

    motion: VaryingMotion
    spread: Spread
    known: float | None = None

    @cached_property
    def units(self) -> Array:
        """Units of the states, ``(d,)``."""
        return self.motion.expansion.units[: self.spread.d]

    def norms(self, sizes: Array) -> Array:
        """The summed norms of the coefficients of every degree, ``(..., D + 1)``, of states that are at most ``sizes
        (..., states)``."""
        space = self.spread.space
        apart = (sizes.reshape(*sizes.shape[:-1], space.size, self.spread.d) / self.units).max(axis=-1)
        return np.stack([apart[..., space.degrees == j].sum(axis=-1) for j in range(space.degree + 1)], axis=-1)

    def driven(self, inputs: Array) -> Array:
        """The rates at which inputs that are at most ``inputs (K, m + mw)`` drive the coefficients of every degree,
        ``(K, D + 1)``."""
        d = self.motion.states
        rates = np.einsum("kin,kn->ki", self.motion.most[:, :, d:], inputs)
        return self.norms(rates)

    @cached_property
    def _norms(self) -> Array:
        """The norms of the coefficients of ``A`` on every piece, ``(K, M)``."""
        d, space = self.spread.d, self.spread.space
        first = self.motion.most[:, :, :d].reshape(-1, space.size, d, d) / self.units[:, None] * self.units
        return np.asarray(first.sum(axis=3).max(axis=2))

    @property
    def influence(self) -> Array:
        """How far every parameter moves the law over the horizon, ``(nu,)``."""
        d, space, lengths = self.motion.states, self.spread.space, self.motion.grid.lengths
        inputs = self.motion.most[:, :, d:].reshape(lengths.size, space.size, self.spread.d, -1)
        pushed = (inputs / self.units[:, None]).max(axis=(2, 3), initial=0.0)
        return np.asarray(lengths @ (self._norms + pushed) @ space.exponents)

    @property
    def growing(self) -> int:
        """The parameter that moves ``A`` most, which alone decides how far states grow."""
        moved = self.motion.grid.lengths @ self._norms @ self.spread.space.exponents
        return int(moved.argmax())

    @cached_property
    def _sizes(self) -> Array:
        """The norms of the coefficients of ``A`` of every degree on every piece, ``(K, D + 1)``."""
        space, norms = self.spread.space, self._norms
        return np.stack([norms[:, space.degrees == j].sum(axis=1) for j in range(space.degree + 1)], axis=1)

    @cached_property
    def _off(self) -> tuple[Array, Array]:
        """What the entries themselves leave out on every piece: the norm of ``A``, ``(K,)``, and how fast it drives
        states, ``(K, m + mw)``."""
        d, K = self.spread.d, self.motion.grid.pieces
        if self.spread.left is None:
            return np.zeros(K), np.zeros((K, self.motion.most.shape[2] - self.motion.states))
        sizes = self.spread.left.over(self.motion.grid.breakpoints) / self.units[:, None]
        return (sizes[:, :, :d] * self.units).sum(axis=2).max(axis=1) * OUTWARD, sizes[:, :, d:].max(axis=1) * OUTWARD

    @cached_property
    def _within(self) -> Array:
        """What a piece makes of norms at most, anywhere on it, ``(K, D + 1, D + 1)``."""
        size, count = self.spread.space.degree + 1, self._sizes.shape[0]
        rate = np.zeros((count, size, size))
        for j in range(size):
            for i in range(j + 1):
                rate[:, j, i] = self._sizes[:, j - i]
        rate = rate * self.motion.grid.lengths[:, None, None]
        total, term = np.tile(np.eye(size), (count, 1, 1)), np.tile(np.eye(size), (count, 1, 1))
        for n in range(1, TERMS):
            term = term @ rate / n
            total = total + term
        return (total + REST) * OUTWARD

    @cached_property
    def _beyond(self) -> Array:
        """What coefficients of every degree are multiplied by in the products beyond, ``(K, D + 1)``."""
        found = np.cumsum(self._sizes[:, ::-1], axis=1)  # of the degrees D, D and D - 1, ...: for j = 0, 1, ...
        above = np.concatenate([np.zeros((found.shape[0], 1)), found[:, :-1]], axis=1)
        return np.asarray((above + self._off[0][:, None]) * OUTWARD)

    def _added(self, begun: Array, driven: Array, off: Array) -> Array:
        """The integral over every piece of what is beyond the degree, ``(K,)``, of states whose norms are ``begun (K, D
        + 1)`` at its beginning and that are driven so fast, ``(K, D + 1)``, and ``off (K,)`` by what entries leave."""
        lengths = self.motion.grid.lengths[:, None]
        most = np.einsum("kij,kj->ki", self._within, begun + lengths * driven)
        return np.asarray(((most * self._beyond).sum(axis=1) + off) * lengths[:, 0] * OUTWARD)

    @cached_property
    def _carried(self) -> Array:
        """The norms of the coefficients of every degree of the transitions from any mark to each one, ``(K + 1, D +
        1)``: what the constant coefficient there makes of all of them, as computed, and what steps are off by, carried
        on as in `VaryingMotion.carries`; in each of several norms, in which a degree ``j`` counts ``ratio^j``, so that
        it is off by that over this."""
        motion, space, d = self.motion, self.spread.space, self.spread.d
        marks = motion.grid.breakpoints
        counted = np.array(RATIOS)[:, None] ** np.arange(space.degree + 1)
        found, largest = np.empty((marks.size, space.degree + 1)), np.ones(counted.shape[0])
        for mark, sums in enumerate(motion.sums()):
            norms = self.norms(sums)
            found[mark], largest = norms.max(axis=0), np.maximum(largest, (norms @ counted.T).max(axis=0))
        ahead = counted @ self.norms((np.abs(motion.flow.state[:, :, :d]) * self.units).sum(axis=2)).T
        error = motion.expansion.off(marks[:-1], marks[1:], RATIOS)
        share = largest * (error + rounding(motion.states) * (ahead + error)).sum(axis=1) * OUTWARD
        near = np.where(share < 0.5, largest * share / np.where(share < 0.5, 1.0 - share, 1.0), np.inf)
        return np.asarray((found + (near[:, None] / counted).min(axis=0)) * OUTWARD)

    @cached_property
    def growth(self) -> float:
        """The norm of the transitions from any time to any later one, at any parameter; at most this."""
        if self.known is not None:
            return self.known
        sizes = self._sizes.sum(axis=1) + self._off[0]
        ends = float(np.exp((sizes * self.motion.grid.lengths).max()) * OUTWARD)
        marks = self._carried[:-1]
        share = ends * float(self._added(marks, np.zeros(marks.shape), np.zeros(len(marks))).sum())
        largest = float(self._carried.sum(axis=1).max())
        return ends * ends * largest / (1.0 - share) * OUTWARD if share < 0.5 else np.inf

    def lost(self, sizes: Array, inputs: Array) -> Array:
        """What is beyond the degree of states that are at most ``sizes (K, states)`` at the beginning of every piece
        and are driven by at most ``inputs (K, m + mw)``: state by state, ``(K, d)``."""
        off = (self._off[1] * inputs).sum(axis=1)
        added = np.cumsum(self._added(self.norms(sizes), self.driven(inputs), off))
        return np.asarray(self.growth * added[:, None] * self.units * OUTWARD)

    def under(self, control: Array) -> Array:
        """The same of the states under a control, ``(K, d)``; remembered."""
        key = control.tobytes()
        if key not in self._under:
            motion, inputs = self.motion, np.abs(self.motion.grid.inputs(control)).T
            every = np.zeros((len(inputs), motion.most.shape[2] - motion.states))
            every[:, : inputs.shape[1]] = inputs
            begun = np.abs(motion.nodes(control)[:-1, 0]) + motion.under(control)[0]
            remember(self._under, key, self.lost(begun, every), PATHS_KEPT)
        return self._under[key]

    @cached_property
    def _under(self) -> dict[bytes, Array]:
        return {}


@dataclass(frozen=True, eq=False)
class SpreadMotion:
    """The `Motion` over a cell of parameters, by that of all coefficients on it, and what is beyond their degree, in a
    ``truncation``."""

    truncation: Truncation

    @staticmethod
    def of(propagator: Propagator, initial_state: Array, growth: float | None) -> SpreadMotion:
        """Return the motion of a system over the cell that its coefficients are expanded on.

        ``growth`` is that of a cell around this one, where it is known. Raises `NotEnclosable` where the cell is so
        wide that what is beyond the degree grows without a bound.
        """
        assert propagator.expansion is not None
        spread = propagator.expansion.spread
        assert spread is not None
        begun = np.append(initial_state, np.zeros(spread.states - spread.d))
        truncation = Truncation(VaryingMotion(propagator, begun), spread, growth)
        with np.errstate(over="ignore", invalid="ignore"):  # of a cell that is too wide
            bounded = np.isfinite(truncation.growth)
        if not bounded:
            wide = "the state moves too far on a cell of parameters"
            raise NotEnclosable(wide, along=truncation.growing)
        return SpreadMotion(truncation)

    @property
    def motion(self) -> VaryingMotion:
        """That of all coefficients."""
        return self.truncation.motion

    @property
    def spread(self) -> Spread:
        """How the state is expanded."""
        return self.truncation.spread

    @property
    def grid(self) -> TimeGrid:
        """The pieces between all marks."""
        return self.motion.grid

    @property
    def space(self) -> TaylorSpace:
        """The polynomials in the parameters."""
        return self.spread.space

    @property
    def states(self) -> int:
        """``d``."""
        return self.spread.d

    @cached_property
    def transform(self) -> Array:
        """The identity."""
        return np.eye(self.states)

    @cached_property
    def starts(self) -> np.ndarray:
        """Every state is a block."""
        return np.arange(self.states)

    @property
    def influence(self) -> Array:
        """`Motion.influence`."""
        return self.truncation.influence

    @property
    def norm(self) -> float:
        """That of all coefficients."""
        return self.motion.norm

    def nodes(self, control: Array) -> Array:
        """`Motion.nodes`."""
        return self._apart(self.motion.nodes(control)[:, 0])

    def moved(self, within: Array, pieces: np.ndarray, begun: Array, inputs: Array) -> Array:
        """`Motion.moved`."""
        return self._apart(self.motion.moved(within, pieces, begun.reshape(len(begun), 1, -1), inputs)[:, 0])

    def deviation(
        self, rows: Array, start: Array, width: Array, pieces: np.ndarray, states: Array, inputs: Array
    ) -> Array:
        """`Motion.deviation`, of every coefficient on the cell."""
        found = self.motion.deviation(
            self.along_cell(rows), start, width, pieces, states.reshape(len(states), 1, -1), inputs
        )
        return np.asarray(found.reshape(start.size, len(rows), -1).sum(axis=2) * OUTWARD)

    def along(self, control: Array, rows: Array, others: Array) -> Array:
        """`Motion.along`; what coefficients are multiplied by and added up is rounded too."""
        found = self.motion.along(control, self.sizes(rows), (1.0 + self.space.size) * self.sizes(others))
        return np.asarray(found + rows @ self.truncation.under(control).T * OUTWARD)

    def along_cell(self, rows: Array) -> Array:
        """Rows ``(r, d)`` as those of every coefficient, on all coefficients, ``(r M, states)``."""
        found = np.eye(self.space.size)[None, :, :, None] * rows[:, None, None, :]
        return np.asarray(found.reshape(len(rows) * self.space.size, -1))

    def sizes(self, rows: Array) -> Array:
        """Rows ``(r, d)`` on sizes of states as such on sizes of all coefficients, ``(r, states)``."""
        return np.tile(rows, self.space.size)

    def folded(self, sizes: Array) -> Array:
        """What sizes ``(K, states)`` of all coefficients add up to, ``(K, d)``."""
        return np.asarray(sizes.reshape(len(sizes), self.space.size, -1).sum(axis=1) * OUTWARD)

    def _apart(self, states: Array) -> Array:
        return states.reshape(len(states), self.space.size, self.states)


@dataclass(frozen=True, eq=False)
class SpreadSupport:
    """A part of the uncertainty on functionals ``rows (r, d)`` over a cell of parameters, by that of all coefficients
    on the cell, `VaryingSupport`."""

    motion: SpreadMotion
    every: VaryingSupport
    rows: Array
    combination: Combination | None = None

    @staticmethod
    def of_disturbance(
        motion: SpreadMotion, model: DisturbanceModel, rows: Array, combination: Combination | None
    ) -> SpreadSupport:
        """That of the worst disturbance."""
        every = VaryingSupport.of_disturbance(motion.motion, model, motion.along_cell(rows), None)
        return SpreadSupport(motion, every, rows, combination)

    @staticmethod
    def of_initial(
        motion: SpreadMotion, bound: ConvexSet, rows: Array, combination: Combination | None
    ) -> SpreadSupport:
        """That of the worst deviation of the initial state, which is one of the constant coefficient alone."""
        every = VaryingSupport.of_initial(motion.motion, bound, motion.along_cell(rows), None)
        every = replace(every, effect=every.effect[..., : motion.states])
        return SpreadSupport(motion, every, rows, combination)

    def steepness(self, times: Array) -> Array:
        """`Support.steepness`."""
        sizes = self.every.set.reach(self._seen(times)).sum(axis=3)
        return np.asarray(sizes @ self._space.exponents)

    def at(self, times: Array, ends: Array) -> tuple[Array, Array]:
        """`Support.at`."""
        return over_faces(
            self._space, ends, lambda here, face: summed(self.every.set, self._seen(times)[here], face).sum(axis=2)
        )

    def deviation(self, start: Array, widths: Array) -> Array:
        """`Support.deviation`, of every coefficient on the cell."""
        found = self.every.deviation(start, widths)
        return np.asarray(found.reshape(start.size, len(self.rows), -1).sum(axis=2) * OUTWARD)

    @cached_property
    def neglected(self) -> Array:
        """`Support.neglected`, with what is beyond the degree."""
        motion, begun = self.motion, self.every.sizes[:-1]
        inputs, pushed = (
            np.zeros((len(begun), motion.motion.most.shape[2] - motion.motion.states)),
            np.zeros((len(begun), 1, 1)),
        )
        if self.every.lasts:
            inputs[:, -self.every.far.size :] = self.every.far
            pushed = motion.motion.flow.sizes[..., -self.every.far.size :] * self.every.far
        lost = motion.truncation.lost(begun + motion.motion.left_out(begun, pushed), inputs)
        found = self.every.neglected.reshape(len(self.rows), self.motion.space.size, -1).sum(axis=1)
        return np.asarray((found + np.abs(self.rows) @ lost.T) * OUTWARD)

    @cached_property
    def reached(self) -> Array:
        """`Support.reached`, with what rounding there is more of them."""
        return (1.0 + self.motion.space.size) * self.motion.folded(self.every.reached)

    @property
    def _space(self) -> TaylorSpace:
        return self.motion.space if self.combination is None else self.combination.space

    def _seen(self, times: Array) -> Array:
        """Taylor coefficients ``(k, r, M, nb, q)`` of what the functionals give to every block; those of the last times
        are remembered."""
        if self._asked.get("times") is not times:
            rows = np.broadcast_to(self.every.rows, (times.size, *self.every.rows.shape))
            found = self.every.blocks(self.every.weights(times, rows))
            found = found.reshape(times.size, len(self.rows), self.motion.space.size, *found.shape[2:])
            found = found if self.combination is None else self.combination.apply(found)
            self._asked.update(times=times, found=found)
        return self._asked["found"]

    @cached_property
    def _asked(self) -> dict[str, Array]:
        return {}
