"""A known system that changes with time, between the breakpoints, as bounds over cells of time see it.

Between two *marks*, breakpoints and ends of segments of the expansion, the system is one polynomial of the time but
for a remainder. There ``y'' = Q y + R v`` with ``Q = A' + A^2`` and ``R = F' + A F`` for the state, and for what any
block of an uncertainty makes of it, under inputs ``v`` through ``F = [B E]``; and what ``y''`` moves by within a cell
is bounded entry by entry by its own derivative. What is computed may be off by what every step was off by, carried on:
the products of transitions that carry it are at most what is computed of them, and a little.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from sparserob_core.control.enclosures.cache import remember
from sparserob_core.control.enclosures.comparison import product
from sparserob_core.control.enclosures.matrix_exponential import rounding
from sparserob_core.control.enclosures.taylor import Combination, TaylorSpace
from sparserob_core.control.response.disturbance import DisturbanceModel
from sparserob_core.control.response.disturbance_support import over_faces, summed
from sparserob_core.control.response.response import Propagator, TimeGrid
from sparserob_core.control.response.varying.expansion import Expansion, Flow
from sparserob_core.sip.convex_set import Array, ConvexSet

KNOWN = TaylorSpace(0, 0)
GROWN = 8  # terms of an exponential of bounds, whose tail is added; half of them, and third derivatives count twice
OUTWARD = 1.0 + 1e-12  # for sums of some thousand numbers that are not negative
AT_ONCE = 4_000_000  # numbers of weights that are made at once
TINY = float(np.finfo(float).tiny)
PATHS_KEPT = 4  # controls whose states are remembered


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
        return float(self._paces.max())

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
        start = self.grid.breakpoints[pieces]
        flow = self.expansion.flow(start, start + within)
        found = np.einsum("kij,kj->ki", flow.state, begun[:, 0]) + np.einsum("kim,km->ki", flow.control, inputs)
        return np.asarray(found[:, None])

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
        inputs, path = np.abs(self.grid.inputs(control)), np.abs(self.nodes(control)[:-1, 0])
        m = inputs.shape[0]
        left_out = self.left_out(path, self.flow.sizes[:, :, :m] * inputs.T[:, None])
        begun = path + self.grid.lengths[:, None] * np.einsum("kim,mk->ki", self.most[:, :, self._columns(m)], inputs)
        sizes = self.grown(self.every, self.grid.lengths, begun)
        return np.asarray(product(rows, left_out.T) + product(others, sizes.T))

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
        another; that is carried on by the transitions from there, and within the piece."""
        units, steps = self.expansion.units, self.flow.state
        begun = self.expansion.over_parts((sizes / units)[:, :, None])[:, :, 0]
        ahead = (np.abs(steps) / units[:, None] * units).sum(axis=2).max(axis=1)
        rounded = rounding(self.states + self.inputs.shape[2])
        here = (self.flow.error + rounded * (ahead + self.flow.error))[:, None] * (begun + pushed)
        none = np.full((1, units.size), TINY)  # not 0, which times no bound is no number
        before = np.concatenate([none, np.cumsum(here, axis=0)[:-1]])
        carried = units * self._carries[:-1] * before
        return np.asarray((self.grown(self.every, self.grid.lengths, carried) + units * here) * OUTWARD)

    @cached_property
    def _carries(self) -> Array:
        """The largest row sums ``(K + 1, d)`` of the transitions from any mark to each one, in own units: of the
        computed ones, and with ``P`` the largest of them and ``e`` the sum of what all steps are off by, ``P^2 e / (1
        - P e)`` more."""
        units = self.expansion.units
        steps = self.flow.state / units[:, None] * units
        found, every = np.ones((steps.shape[0] + 1, units.size)), np.empty((steps.shape[0] + 1, *steps.shape[1:]))
        every[0] = np.eye(units.size)
        for k, step in enumerate(steps):
            every[: k + 1] = step @ every[: k + 1]
            every[k + 1] = np.eye(units.size)
            found[k + 1] = np.abs(every[: k + 2]).sum(axis=2).max(axis=0)
        largest, ahead = float(found.max()), np.abs(steps).sum(axis=2).max(axis=1)
        off = float((self.flow.error + rounding(units.size) * (ahead + self.flow.error)).sum())
        share = largest * off
        return found + (largest * share / (1.0 - share) if share < 0.5 else np.inf)

    def grown(self, pieces: np.ndarray, width: Array, sizes: Array) -> Array:
        """What states of at most ``sizes (k, d)`` may become within a ``width (k,)`` of a piece, ``(k, d)``: by the
        exponential of the largest entries of ``A`` there."""
        units, most, pace = self.expansion.units, self.most[pieces][:, :, : self.states], self._paces[pieces] * width
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
        pace = (A / expansion.units[:, None] * expansion.units).sum(axis=2).max(axis=1)
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
    def _paces(self) -> Array:
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
        bent = self._weights(start, self.rows @ at[:, :, :d])
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
        motion, sums = self.motion, self._sizes
        pushed = np.zeros((sums.shape[0] - 1, 1, 1))
        if self.lasts:
            pushed = motion.flow.sizes[..., -self.far.size :] * self.far
        total = motion.left_out(sums[:-1], pushed) + rounding(self.effect[0, 0].size) * self.reached
        return product(np.abs(self.rows), total.T)

    @cached_property
    def reached(self) -> Array:
        """What any of it can have made of every state on every piece, ``(K, d)``."""
        motion, begun = self.motion, self._sizes[:-1]
        lengths = motion.grid.lengths
        if self.lasts:
            begun = begun + lengths[:, None] * (motion.most[:, :, -self.far.size :] @ self.far)
        return motion.grown(motion.every, lengths, begun)

    @cached_property
    def _sizes(self) -> Array:
        """The same at the marks, ``(K + 1, d)``."""
        return np.asarray(np.einsum("kdpw,w->kd", np.abs(self.effect), self.far) * OUTWARD)

    @property
    def _space(self) -> TaylorSpace:
        return KNOWN if self.combination is None else self.combination.space

    def _seen(self, times: Array) -> Array:
        """Taylor coefficients ``(k, r, M, nb, q)`` of what the functionals give to every block."""
        rows = np.broadcast_to(self.rows, (times.size, *self.rows.shape))
        found = self.blocks(self._weights(times, rows))[:, :, None]
        return found if self.combination is None else self.combination.apply(found)

    def _weights(self, times: Array, rows: Array) -> Array:
        """What rows ``(k, r, d)`` at times ``(k,)`` give to every part, ``(k, r, P, w)``."""
        motion, place = self.motion, self.motion.place(times)
        parts = self.effect.shape[2:]
        flow = motion.expansion.flow(motion.grid.breakpoints[place], times)
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
