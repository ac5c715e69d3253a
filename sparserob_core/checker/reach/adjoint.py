"""Rows ``c'x(t)`` of a known system that does not change with time, by their adjoints ``l(s) = e^{A's} c``: values
along one trajectory, and upper bounds over all trajectories.

The adjoints at the ends of equal steps are vectors of balls, each a product of a few matrices; afterwards they are
floats with a radius. Within a step the adjoint, and its product with the inputs, is a polynomial in time. Its terms and
its remainder are those of a segment of the verified flow. No transition matrix is made for every time.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import accumulate
from math import ceil, factorial, floor, log2
from typing import final

import numpy as np
from flint import arb_mat

from sparserob_core.checker.arithmetic.balls import ball, balls, difference
from sparserob_core.checker.arithmetic.series import Series, middles, stacked, zeros
from sparserob_core.checker.flow.segment import VerifiedSegment, solve
from sparserob_core.checker.flow.units import balanced
from sparserob_core.checker.outcome import Clock, Unchecked
from sparserob_core.checker.sets.known import known
from sparserob_core.checker.sets.polynomials import HALF_ULP, OUTWARD, TINY, Enclosed, multiply_rows, rounding
from sparserob_core.sip.convex_set import Array, ConvexSet

ORDER = 13  # degree of the polynomials
REST = 2e-15  # about their truncation error in parts of a row: more widens the bounds, less needs shorter steps
LONGEST = 16.0  # size of a system over a step, at most: the terms of its series are then below 1e6, and cancel little
DERIVATIVE_DEGREE = 7  # degree of the polynomials that bound second derivatives
MAX_STEPS = 2**17
BLOCK = 64  # rows in one ball matrix, a power of two: fewer need more calls, more make more rows that are not needed
# Steps between rows that are products of ball matrices, a power of two, where it would take long to make all rows of
# balls. Every row in between takes one more product of floats, with an error like that of the terms of polynomials.
# With half of it the rows of many states take twice as long; with twice as much the transitions take as long as rows.
APART = 16
# Multiplications of balls for all rows, about six seconds; beyond, only every `APART`-th row is made of balls. With a
# tenth of it bounds for plants whose rows take no time are wider than those that a run reports to the last digit.
DEAR = 2**29
MAX_ENTRIES = 2**27  # entries of the rows of all steps, at most
AT_ONCE = 2**22  # entries of rows that are computed at once


@final
@dataclass(frozen=True, eq=False)
class AdjointFlow:
    """The flow that the adjoints of all rows of ``x' = A x + F u`` share: ``e^{A s}`` on a ``segment`` of time of the
    length ``step``, and the number ``count`` of such steps, which cover the horizon. The length is a power of two, so
    that places within a step are exact."""

    A: arb_mat
    F: arb_mat
    segment: VerifiedSegment
    step: float
    count: int
    clock: Clock

    @staticmethod
    def of(A: arb_mat, F: arb_mat, horizon: float, clock: Clock) -> AdjointFlow:
        """Return the flow up to the ``horizon``, with inputs by ``F (d, q)``; raise `Unchecked` where the system is too
        fast, or has too many states."""
        plain, speed = middles(A), np.abs(middles(F)).sum(axis=1)
        units = balanced(plain, horizon, speed)
        step = choose_step(plain * units / units[:, None], horizon)
        count = ceil(horizon / step)
        if not (count <= MAX_STEPS and count * A.nrows() <= MAX_ENTRIES):
            raise Unchecked("the system is too fast for its horizon to be followed")
        clock.check()
        segment = solve([Series.known(A * ball(step))], [Series.known(zeros(A.nrows(), 0))], units)
        return AdjointFlow(A, F, segment, step, count, clock)

    @property
    def states(self) -> int:
        """The number of states, ``d``."""
        return int(self.A.nrows())

    @property
    def apart(self) -> int:
        """The number of steps between adjoints that are products of ball matrices."""
        return APART if self.count * self.states**2 > DEAR else 1

    @cached_property
    def _transition_powers(self) -> list[arb_mat]:
        """The transitions over 1, 2, 4, ... steps that are made so far."""
        return [self.segment.end.matrix]

    def over(self, place: int) -> arb_mat:
        """Return the transition over ``2^place`` steps."""
        while len(self._transition_powers) <= place:
            self.clock.check()
            self._transition_powers.append(self._transition_powers[-1] * self._transition_powers[-1])
        return self._transition_powers[place]

    @cached_property
    def between(self) -> list[Enclosed]:
        """The transitions over 1, 2, ... steps, fewer than `apart`, ``(1, d, d)`` each."""
        transitions: list[arb_mat] = []
        shape = (1, self.states, self.states)
        for j in range(1, self.apart):
            self.clock.check()
            exponent = floor(log2(j))
            power = self.over(exponent)
            transitions.append(power if j == 2**exponent else transitions[j - 2**exponent - 1] * power)
        return [Enclosed.all([transition], shape) for transition in transitions]

    def _expand_adjoint(self, order: int, columns: arb_mat | None = None) -> Enclosed:
        """Return matrices ``(order + 1, d, n)`` that turn an adjoint at the beginning of a step into the terms of ``l``
        on this step, or of ``l'`` times ``columns (d, n)``. The terms are those of powers of the share of the step. The
        remainder is in the radius of the first matrix."""
        self.clock.check()
        terms, remainder = self.segment.first(order + 1)
        matrices = [term.matrix for term in terms]
        if columns is not None:
            matrices, remainder = [matrix * columns for matrix in matrices], remainder @ Series.known(columns).size
        matrices += [matrices[0] * 0] * (order + 1 - len(matrices))  # the series of a system may end earlier
        enclosure = Enclosed.all(matrices, (order + 1, *remainder.shape))
        enclosure.rad[0] += remainder * OUTWARD
        return enclosure

    @cached_property
    def rows(self) -> Enclosed:
        """The matrices that turn an adjoint into the terms of ``l`` on a step, ``(p + 1, d, d)``."""
        return self._expand_adjoint(ORDER)

    @cached_property
    def inputs(self) -> Enclosed:
        """The matrices that turn an adjoint into the terms of ``l'F`` on a step, ``(p + 1, d, q)``."""
        return self._expand_adjoint(ORDER, self.F)

    @cached_property
    def derivative_terms(self) -> Enclosed:
        """The matrices that turn an adjoint into the first terms of ``l'[A^2, A F, A^2 F]`` on a step,
        ``(DERIVATIVE_DEGREE + 1, d, d + 2 q)``, with the remainder in the radius of the first."""
        once, twice = (Series.known(self.A * matrix) for matrix in (self.F, self.A))
        return self._expand_adjoint(
            DERIVATIVE_DEGREE, twice.append_columns(once).append_columns(Series.known(self.A * once.matrix)).matrix
        )


def choose_step(A: Array, horizon: float) -> float:
    """Return the length of a step, a power of two, such that a polynomial has about `REST` of a row as truncation
    error, which is bounded wherever the step ends. ``A`` is in units in which it is small; its power is often far
    smaller than that of its norm."""
    size = float(np.abs(A).sum(axis=1).max(initial=0.0))
    if not size < 2.0**1000:
        raise Unchecked("the system is too fast for its horizon to be followed")
    if not size:
        return 2.0 ** floor(log2(horizon / 64.0))
    last = float(np.abs(np.linalg.matrix_power(A / size, ORDER + 1)).sum(axis=1).max())
    share = (REST * factorial(ORDER + 1) / max(last, TINY)) ** (1.0 / (ORDER + 1))
    return 2.0 ** floor(log2(min(horizon / 64.0, min(share, LONGEST) / size)))


@final
@dataclass(frozen=True, eq=False)
class AdjointRow:
    """The adjoint ``l`` of a row at the ends of the steps of a ``motion``, ``nodes (N + 1, d)``."""

    motion: AdjointFlow
    nodes: Enclosed
    opposite: AdjointRow | None = None  # the adjoint of ``-c``, which has the same absolute values

    @staticmethod
    def of(motion: AdjointFlow, c: Array) -> AdjointRow:
        """Return the adjoint of a row ``c (d,)`` of exact numbers."""
        rows, exponent, count = [balls(c)], floor(log2(motion.apart)), motion.count // motion.apart + 1
        while len(rows) < BLOCK:
            rows += (stacked(rows) * motion.over(exponent)).tolist()
            exponent += 1
        blocks = [stacked(rows)]
        while len(blocks) * BLOCK < count:
            motion.clock.check()
            power, exponent = motion.over(exponent), exponent + 1
            blocks += [block * power for block in blocks[: -(-count // BLOCK) - len(blocks)]]
        enclosures = [Enclosed.of(block) for block in blocks]
        mid, rad = (
            np.concatenate(arrays)[:count] for arrays in zip(*((p.mid, p.rad) for p in enclosures), strict=True)
        )
        nodes = [np.empty((count, motion.apart, len(c))) for _ in range(2)]
        nodes[0][:, 0], nodes[1][:, 0] = mid, rad
        for j in range(1, motion.apart):
            motion.clock.check()
            product = multiply_rows(Enclosed(mid, rad), motion.between[j - 1])
            nodes[0][:, j], nodes[1][:, j] = product.mid[:, 0], product.rad[:, 0]
        return AdjointRow(motion, Enclosed(*(node.reshape(-1, len(c))[: motion.count + 1] for node in nodes)))

    @property
    def step(self) -> float:
        """The length of a step."""
        return self.motion.step

    @property
    def ends(self) -> Array:
        """The ends of the steps, 0 first, ``(N + 1,)``."""
        return np.asarray(np.arange(self.count + 1) * self.step)

    def reversed(self) -> AdjointRow:
        """Return the adjoint of the row ``-c``."""
        return replace(self, nodes=Enclosed(-self.nodes.mid, self.nodes.rad), opposite=self)

    @property
    def count(self) -> int:
        """The number of steps, ``N``."""
        return int(self.nodes.mid.shape[0]) - 1

    @cached_property
    def driven(self) -> Enclosed:
        """The terms of ``l'F`` on every step in powers of its share, ``(N, p + 1, q)``; the remainder is in the radius
        of the first."""
        return multiply_rows(self.nodes[:-1], self.motion.inputs)

    @cached_property
    def _integration_weights(self) -> Array:
        return 1.0 / np.arange(1.0, ORDER + 2.0)

    @cached_property
    def sums(self) -> Enclosed:
        """The integrals of ``l'F`` from 0 to the ends of all steps, 0 itself first, ``(N + 1, q)``. The radius grows
        from step to step, so that the difference of two radii bounds the error of the difference of both integrals,
        apart from their rounding to floats."""
        increments, size = (
            self.step * np.einsum("kjq,j->kq", terms, self._integration_weights)
            for terms in (self.driven.mid, np.abs(self.driven.mid))
        )
        rad = (
            self.step * np.einsum("kjq,j->kq", self.driven.rad, self._integration_weights) + rounding(ORDER + 2) * size
        )
        return Enclosed(
            accumulate_exactly(increments), np.vstack([np.zeros((1, rad.shape[1])), np.cumsum(rad, axis=0)]) * OUTWARD
        )

    def placed(self, times: Array) -> tuple[np.ndarray, Array]:
        """Return the step that holds each time, and the share of the step that has passed, both exact."""
        steps = np.clip(np.floor(times / self.step).astype(int), 0, self.count - 1)
        return steps, (times - steps * self.step) / self.step

    def at(self, times: Array) -> Enclosed:
        """Return ``l`` at exact ``times (k,)``, ``(k, d)``."""
        steps, shares = self.placed(times)
        mid, rad = np.empty((2, times.size, self.motion.states))
        is_node = shares == 0.0
        mid[is_node], rad[is_node] = self.nodes.mid[steps[is_node]], self.nodes.rad[steps[is_node]]
        indices = np.flatnonzero(~is_node)
        indices = indices[np.argsort(steps[indices], kind="stable")]
        batch_size = max(1, AT_ONCE // self.motion.rows.mid[:, 0].size)
        for start in range(0, indices.size, batch_size):
            batch = indices[start : start + batch_size]
            distinct, positions = np.unique(steps[batch], return_inverse=True)
            terms = multiply_rows(self.nodes[distinct], self.motion.rows)[positions]
            powers = shares[batch][:, None] ** np.arange(ORDER + 1)
            mid[batch] = np.einsum("kjd,kj->kd", terms.mid, powers)
            error = np.einsum("kjd,kj->kd", terms.rad + rounding(3 * ORDER) * np.abs(terms.mid), powers)
            rad[batch] = error * OUTWARD
        return Enclosed(mid, rad)

    def integrals(self, times: Array) -> tuple[Enclosed, Array]:
        """Return the integrals of ``l'F``, ``(..., q)``, from 0 to exact times ``(...)``, 0 for negative times, with
        radii as in `sums`; and bounds of the rounding errors made here and by the floats of `sums`."""
        steps, shares = self.placed(np.maximum(times, 0.0))
        powers = self.step * shares[..., None] ** np.arange(1, ORDER + 2) * self._integration_weights
        mid = np.einsum("...jq,...j->...q", self.driven.mid[steps], powers)
        rad = np.einsum("...jq,...j->...q", self.driven.rad[steps], powers)
        size = np.einsum("...jq,...j->...q", np.abs(self.driven.mid[steps]), powers)
        total = self.sums.mid[steps] + mid
        rounded = rounding(3 * ORDER) * size + 2.0 * HALF_ULP * (np.abs(self.sums.mid[steps]) + np.abs(total))
        return Enclosed(total, (self.sums.rad[steps] + rad) * OUTWARD), rounded * OUTWARD

    def between(self, times: Array, start: Array | float, stop: Array | float) -> Enclosed:
        """Return what an input of 1 by every column of ``F``, from ``start`` to ``stop``, adds to the row at exact
        times, ``(..., q)``. The radius allows for the rounding of differences of times."""
        (since, since_rounding), (until, until_rounding) = difference(times, start), difference(times, stop)
        (late, late_rounding), (early, early_rounding) = self.integrals(since), self.integrals(until)
        mid = late.mid - early.mid
        rad = np.abs(late.rad - early.rad) + (OUTWARD - 1.0) * (late.rad + early.rad) + late_rounding + early_rounding
        rad = rad + HALF_ULP * np.abs(mid) + (np.abs(since_rounding) + np.abs(until_rounding))[..., None] * self.fastest
        return Enclosed(mid, rad * OUTWARD)

    @cached_property
    def fastest(self) -> Array:
        """The upper bound of ``|l'F|`` at all times, ``(q,)``."""
        return np.asarray((np.abs(self.driven.mid) + self.driven.rad).sum(axis=1).max(axis=0) * OUTWARD)

    @cached_property
    def derivative_bounds(self) -> tuple[Array, Array, Array]:
        """The upper bounds on every step of ``|l''|``, ``(N, d)``, of ``|l'AF|`` and of ``|l'A^2 F|``, ``(N, q)``
        each."""
        if self.opposite is not None:
            return self.opposite.derivative_bounds
        d, q, terms = self.motion.states, self.motion.F.ncols(), self.motion.derivative_terms
        bounds = np.zeros((self.count, d + 2 * q))
        batch_size = max(1, AT_ONCE // (d + 2 * q))
        for start in range(0, self.count, batch_size):
            steps = slice(start, min(start + batch_size, self.count))
            for k in range(len(terms.mid)):
                product = multiply_rows(self.nodes[steps], terms[k : k + 1])
                bounds[steps] += (np.abs(product.mid) + product.rad)[:, 0]
        bounds *= OUTWARD
        return bounds[:, :d], bounds[:, d : d + q], bounds[:, d + q :]


def accumulate_exactly(values: Array) -> Array:
    """Return the sums of the first ``0, 1, ..., N`` of ``values (N, q)``, ``(N + 1, q)``: added in balls, each rounded
    to a float once."""
    sums = [accumulate(balls(column), initial=ball(0.0)) for column in values.T]
    return np.array([[float(x) for x in column] for column in sums]).reshape(-1, len(values) + 1).T


@final
@dataclass(frozen=True, eq=False)
class Worst:
    """The largest ``c'x(t)`` over all initial states and disturbances.

    Attributes
    ----------
    adjoint
        The adjoint of the row ``c``.
    centre, initial_set
        The centre of the initial states, ``(d,)``, and the set of deviations from it, or ``None``.
    grid, drives
        Times ``(L + 1,)``, and the known inputs between them, ``(q', L)``, which enter by the first inputs of the
        adjoint.
    disturbance_set, changes
        The set of the disturbance that is constant between the times ``changes (M + 1,)``, or ``None``. It enters by
        the last inputs.
    """

    adjoint: AdjointRow
    centre: Array
    initial_set: ConvexSet | None
    grid: Array
    drives: Enclosed
    disturbance_set: ConvexSet | None
    changes: Array

    @property
    def _disturbance_columns(self) -> slice:
        """The inputs of the adjoint by which the disturbance enters."""
        return slice(self.drives.mid.shape[0], None)

    def _evaluate_inputs(self, times: Array) -> tuple[Array, Array]:
        """Return what the known inputs add to the row at ``times (k,)``, and the error bounds, ``(k,)`` each."""
        mid, rad, size = np.zeros(times.size), np.zeros(times.size), np.zeros(times.size)
        used = self.drives.mid.shape[0]
        for k, (start, stop) in enumerate(zip(self.grid[:-1], self.grid[1:], strict=True)):
            u, u_rad = self.drives.mid[:, k], self.drives.rad[:, k]
            if u.any() or u_rad.any():
                effects = self.adjoint.between(times, float(start), float(stop))
                mid += effects.mid[:, :used] @ u
                rad += effects.rad[:, :used] @ (np.abs(u) + u_rad) + np.abs(effects.mid[:, :used]) @ u_rad
                size += np.abs(effects.mid[:, :used]) @ np.abs(u)
        return mid, rad + rounding(used + self.grid.size) * size

    def bound_largest_value(self, times: Array) -> tuple[Array, Array]:
        """Return upper bounds ``(k,)`` of the largest value at exact ``times (k,)``, and how far these bounds may be
        above it, ``(k,)``. The second result is proven for flat sets only."""
        rows = self.adjoint.at(times)
        top, rad = self._evaluate_inputs(times)
        size = np.abs(rows.mid) @ np.abs(self.centre)
        top = top + rows.mid @ self.centre
        rad = rad + rows.rad @ np.abs(self.centre) + rounding(self.centre.size) * size
        supports = [] if self.initial_set is None else [_evaluate_support(self.initial_set, rows)]
        if self.disturbance_set is not None:
            supports.append(self._evaluate_disturbance(times))
        for support, error in supports:
            top, rad, size = top + support, rad + error, size + np.abs(support)
        rad = (rad + 8.0 * HALF_ULP * (np.abs(top) + size)) * OUTWARD
        return top + rad, 3.0 * rad

    def _evaluate_disturbance(self, times: Array) -> tuple[Array, Array]:
        """Return what the worst disturbance adds to the row at ``times (k,)``, and how much more it may be, ``(k,)``
        each."""
        assert self.disturbance_set is not None
        top, rad = np.zeros(times.size), np.zeros(times.size)
        for start, stop in zip(self.changes[:-1], self.changes[1:], strict=True):
            effects = self.adjoint.between(times, float(start), float(stop))
            support, error = _evaluate_support(
                self.disturbance_set,
                effects[:, self._disturbance_columns],
            )
            top, rad = top + support, rad + error + HALF_ULP * np.abs(top)
        return top, rad

    @cached_property
    def _curvature_bounds(self) -> Array:
        """The upper bounds ``(N,)`` of the downward curvature of the largest value on every step. Times an eighth of
        the square of the width of a cell, they bound how far the largest value lies above its chord."""
        states, once, twice = self.adjoint.derivative_bounds
        state_bound = np.abs(self.centre) + (
            0.0 if self.initial_set is None else np.array(known(self.initial_set).radius)
        )
        curvature = states @ state_bound
        inputs = np.zeros(once.shape[1])
        used = self.drives.mid.shape[0]
        inputs[:used] = (np.abs(self.drives.mid) + self.drives.rad).max(axis=1, initial=0.0)
        if self.disturbance_set is not None:
            inputs[self._disturbance_columns] = known(self.disturbance_set).radius
        # an input on a piece has a difference of l'AF as second derivative: all together the total variation of l'AF,
        # and one value for the piece that acts
        total = self.adjoint.step * float((twice @ inputs).sum()) + float((once @ inputs).max(initial=0.0))
        return np.asarray((curvature + total) * OUTWARD)

    def over(self, start: Array, stop: Array, added_values: Array | float = 0.0) -> Array:
        """Return upper bounds ``(k,)`` of the largest value on cells from ``start (k,)`` to ``stop (k,)``, each between
        two `cuts`, with the values ``added_values (2, k)`` at both ends, and linear in between."""
        ends, positions = np.unique(np.concatenate([start, stop]), return_inverse=True)
        batch_size = max(1, AT_ONCE // self.adjoint.motion.states)  # the adjoints at all ends take much memory
        bounds = [self.bound_largest_value(ends[k : k + batch_size])[0] for k in range(0, ends.size, batch_size)]
        tops = np.concatenate(bounds)[positions]
        width, curvature = (stop - start) * OUTWARD, np.zeros(start.size)
        if width.any():
            step, last = self.adjoint.step, self.adjoint.count - 1
            curvature = np.maximum(
                *(self._curvature_bounds[np.clip((t / step).astype(int), 0, last)] for t in (start, stop))
            )
        end_values = tops.reshape(2, -1) + added_values
        rounding_error = 4.0 * HALF_ULP * (np.abs(end_values) + np.abs(added_values)).max(axis=0)
        return np.asarray(end_values.max(axis=0) + (width**2 / 8.0 * curvature + rounding_error) * OUTWARD)

    def cuts(self, more: Sequence[float]) -> Array:
        """Return increasing times, among them ``more``, between which no input jumps. They are at most a step apart."""
        times = [np.asarray(more, dtype=float), self.adjoint.ends]
        times += [self.grid] if self.drives.mid.any() or self.drives.rad.any() else []
        times += [self.changes] if self.disturbance_set is not None else []
        return np.unique(np.concatenate(times))


def _evaluate_support(bound: ConvexSet, rows: Enclosed) -> tuple[Array, Array]:
    """Return approximate support values of a set at rows ``(k, d)``, and how much more the true values may be, ``(k,)``
    each."""
    w, excess = known(bound).bound(rows.mid, rows.rad)
    size = (np.abs(w) * np.abs(rows.mid)).sum(axis=1)
    error = (np.abs(w) * rows.rad).sum(axis=1) + rounding(rows.mid.shape[1]) * size
    return (w * rows.mid).sum(axis=1), (error + np.abs(excess)) * OUTWARD
