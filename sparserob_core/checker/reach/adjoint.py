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
from math import ceil, comb, factorial, floor, log2
from typing import TYPE_CHECKING, final

import numpy as np

from sparserob_core.checker.arithmetic.balls import ball, balls
from sparserob_core.checker.arithmetic.series import Series, middles, stacked, zeros
from sparserob_core.checker.flow.segment import VerifiedSegment, solve
from sparserob_core.checker.flow.units import balanced
from sparserob_core.checker.outcome import Clock, Unchecked
from sparserob_core.checker.reach.measurable import Side
from sparserob_core.checker.sets.along import CurvedSide
from sparserob_core.checker.sets.known import known, middle
from sparserob_core.checker.sets.polynomials import HALF_ULP, OUTWARD, TINY, Enclosed, rounding
from sparserob_core.sip.convex_set import Array, ConvexSet

if TYPE_CHECKING:
    from flint import arb, arb_mat

ORDER = 13  # degree of the polynomials
REST = 2e-15  # about their truncation error in parts of a row: more widens the bounds, less needs shorter steps
LONGEST = 16.0  # size of a system over a step, at most: the terms of its series are then below 1e6, and cancel little
BENDING = 7  # degree of the polynomials that bound second derivatives
MOST_STEPS = 2**17
BLOCK = 64  # rows in one ball matrix, a power of two: fewer need more calls, more make more rows that are not needed
# Steps between rows that are products of ball matrices, a power of two, where making all rows so would take long. A row
# between needs one more product of floats, whose error is like that of the terms of polynomials. With half of it the
# rows of many states take twice as long, and with twice as much the transitions between take the time of the rows.
APART = 16
# Multiplications of balls for all rows, about six seconds; beyond, only every `APART`-th row is made of balls. With a
# tenth of it bounds for plants whose rows take no time are wider than those that a run reports to the last digit.
DEAR = 2**29
MOST = 2**27  # entries of the rows of all steps, at most
AT_ONCE = 2**22  # entries of rows that are computed at once
# Terms of a product of floats in one partial sum; the partial sums are added up then. With 348 states an entry is
# rounded 43 times instead of 348. With half of it products take a fourth longer, and with twice as much bounds along
# modes that are far from normal are twice as wide.
SUMMED = 32


@final
@dataclass(frozen=True, eq=False)
class AdjointFlow:
    """The flow that the adjoints of all rows of ``x' = A x + F u`` share: that on a ``segment`` of time of the length
    ``step``, and the number ``count`` of such steps. The length is a power of two, so that places within a step are
    exact."""

    A: arb_mat
    F: arb_mat
    segment: VerifiedSegment
    step: float
    count: int
    clock: Clock

    @staticmethod
    def of(A: arb_mat, F: arb_mat, horizon: float, clock: Clock) -> AdjointFlow:
        """Return the flow up to the ``horizon``, with inputs by ``F (d, q)``.

        Raises
        ------
        Unchecked
            If the system is too fast for this horizon.
        """
        plain, speed = middles(A), np.abs(middles(F)).sum(axis=1)
        units = balanced(plain, horizon, speed)
        step = choose_step(plain * units / units[:, None], horizon)
        count = ceil(horizon / step)
        if not (count <= MOST_STEPS and count * A.nrows() <= MOST):
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
    def _powers(self) -> list[arb_mat]:
        """The transitions over 1, 2, 4, ... steps that are made so far."""
        return [self.segment.end.matrix]

    def over(self, place: int) -> arb_mat:
        """Return the transition over ``2^place`` steps."""
        while len(self._powers) <= place:
            self.clock.check()
            self._powers.append(self._powers[-1] * self._powers[-1])
        return self._powers[place]

    @cached_property
    def between(self) -> list[Enclosed]:
        """The transitions over 1, 2, ... steps, fewer than `apart`, ``(1, d, d)`` each."""
        found: list[arb_mat] = []
        shape = (1, self.states, self.states)
        for j in range(1, self.apart):
            self.clock.check()
            place = floor(log2(j))
            power = self.over(place)
            found.append(power if j == 2**place else found[j - 2**place - 1] * power)
        return [Enclosed.all([one], shape) for one in found]

    def _expanded(self, order: int, columns: arb_mat | None = None) -> Enclosed:
        """Return matrices ``(order + 1, d, n)`` that turn an adjoint at the beginning of a step into the terms of ``l``
        on this step, or of ``l`` times ``columns (d, n)``. The remainder is in the radius of the first."""
        self.clock.check()
        terms, off = self.segment.first(order + 1)
        every = [one.matrix for one in terms]
        if columns is not None:
            every, off = [one * columns for one in every], off @ Series.known(columns).size
        every += [every[0] * 0] * (order + 1 - len(every))  # the series of a system may end earlier
        found = Enclosed.all(every, (order + 1, *off.shape))
        found.rad[0] += off * OUTWARD
        return found

    @cached_property
    def rows(self) -> Enclosed:
        """The matrices that turn an adjoint into the terms of ``l`` on a step, ``(p + 1, d, d)``."""
        return self._expanded(ORDER)

    @cached_property
    def inputs(self) -> Enclosed:
        """The matrices that turn an adjoint into the terms of ``l'F`` on a step, ``(p + 1, d, q)``."""
        return self._expanded(ORDER, self.F)

    @cached_property
    def bending(self) -> Enclosed:
        """The matrices that turn an adjoint into the first terms of ``l'[A^2, A F, A^2 F]`` on a step,
        ``(J, d, d + 2 q)``."""
        once, twice = (Series.known(self.A * one) for one in (self.F, self.A))
        return self._expanded(BENDING, twice.beside(once).beside(Series.known(self.A * once.matrix)).matrix)


def choose_step(A: Array, horizon: float) -> float:
    """Return the length of a step, a power of two, such that a polynomial has about `REST` of a row as truncation
    error.

    ``A`` is in units in which it is small. Floats suffice, since the truncation error is bounded wherever the step
    ends. The choice uses a power of ``A``, which is often far smaller than the power of its norm.
    """
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
        return AdjointRow.of_balls(motion, [ball(v) for v in c])

    @staticmethod
    def of_balls(motion: AdjointFlow, c: list[arb]) -> AdjointRow:
        """Return the adjoint of a row ``c (d,)`` of balls."""
        found, place, count = [c], floor(log2(motion.apart)), motion.count // motion.apart + 1
        while len(found) < BLOCK:
            found += (stacked(found) * motion.over(place)).tolist()
            place += 1
        blocks = [stacked(found)]
        while len(blocks) * BLOCK < count:
            motion.clock.check()
            power, place = motion.over(place), place + 1
            blocks += [block * power for block in blocks[: -(-count // BLOCK) - len(blocks)]]
        parts = [Enclosed.of(block) for block in blocks]
        mid, rad = (np.concatenate(one)[:count] for one in zip(*((p.mid, p.rad) for p in parts), strict=True))
        nodes = [np.empty((count, motion.apart, len(c))) for _ in range(2)]
        nodes[0][:, 0], nodes[1][:, 0] = mid, rad
        for j in range(1, motion.apart):
            motion.clock.check()
            for node, product in zip(nodes, _product(Enclosed(mid, rad), motion.between[j - 1]), strict=True):
                node[:, j] = product[:, 0]
        return AdjointRow(motion, Enclosed(*(node.reshape(-1, len(c))[: motion.count + 1] for node in nodes)))

    @property
    def step(self) -> float:
        """The length of a step."""
        return self.motion.step

    def reversed(self) -> AdjointRow:
        """Return the adjoint of the row ``-c``."""
        return replace(self, nodes=Enclosed(-self.nodes.mid, self.nodes.rad), opposite=self)

    @property
    def count(self) -> int:
        """The number of steps, ``N``."""
        return int(self.nodes.mid.shape[0]) - 1

    @cached_property
    def driven(self) -> Enclosed:
        """The terms of ``l'F`` on every step, ``(N, p + 1, q)``; the remainder is in the radius of the first."""
        return Enclosed(*_product(Enclosed(self.nodes.mid[:-1], self.nodes.rad[:-1]), self.motion.inputs))

    @cached_property
    def _weights(self) -> Array:
        return 1.0 / np.arange(1.0, ORDER + 2.0)

    @cached_property
    def sums(self) -> Enclosed:
        """The integrals of ``l'F`` from 0 to the end of every step, ``(N + 1, q)``. The radius grows from step to step
        by the error bound of this step, so that the error of a difference of two is bounded by the difference of their
        radii."""
        moved, size = (
            self.step * np.einsum("kjq,j->kq", part, self._weights)
            for part in (self.driven.mid, np.abs(self.driven.mid))
        )
        rad = self.step * np.einsum("kjq,j->kq", self.driven.rad, self._weights) + rounding(ORDER + 2) * size
        return Enclosed(accumulate_exactly(moved), _accumulated(rad) * OUTWARD)

    def placed(self, times: Array) -> tuple[np.ndarray, Array]:
        """Return the step that holds each time, and the share of the step that has passed, both exact."""
        steps = np.clip(np.floor(times / self.step).astype(int), 0, self.count - 1)
        return steps, (times - steps * self.step) / self.step

    def at(self, times: Array) -> Enclosed:
        """Return ``l`` at exact ``times (k,)``, ``(k, d)``."""
        steps, shares = self.placed(times)
        mid, rad = np.empty((2, times.size, self.motion.states))
        whole = shares == 0.0
        mid[whole], rad[whole] = self.nodes.mid[steps[whole]], self.nodes.rad[steps[whole]]
        others = np.flatnonzero(~whole)
        others = others[np.argsort(steps[others], kind="stable")]
        several = max(1, AT_ONCE // self.motion.rows.mid[:, 0].size)
        for start in range(0, others.size, several):
            here = others[start : start + several]
            used, which = np.unique(steps[here], return_inverse=True)
            terms, off = _product(Enclosed(self.nodes.mid[used], self.nodes.rad[used]), self.motion.rows)
            powers = shares[here][:, None] ** np.arange(ORDER + 1)
            chosen = terms[which]
            mid[here] = np.einsum("kjd,kj->kd", chosen, powers)
            lost = np.einsum("kjd,kj->kd", off[which] + rounding(3 * ORDER) * np.abs(chosen), powers)
            rad[here] = lost * OUTWARD
        return Enclosed(mid, rad)

    def integrals(self, times: Array) -> tuple[Enclosed, Array]:
        """Return the integrals of ``l'F`` from 0 to exact times ``(...)``, and 0 for negative times.

        Returns
        -------
        tuple
            The integrals ``(..., q)`` with radii as in `sums`, and bounds of the rounding errors made here,
            ``(..., q)``.
        """
        steps, shares = self.placed(np.maximum(times, 0.0))
        powers = self.step * shares[..., None] ** np.arange(1, ORDER + 2) * self._weights
        mid = np.einsum("...jq,...j->...q", self.driven.mid[steps], powers)
        rad = np.einsum("...jq,...j->...q", self.driven.rad[steps], powers)
        size = np.einsum("...jq,...j->...q", np.abs(self.driven.mid[steps]), powers)
        total = self.sums.mid[steps] + mid
        rounded = rounding(3 * ORDER) * size + 2.0 * HALF_ULP * (np.abs(self.sums.mid[steps]) + np.abs(total))
        return Enclosed(total, (self.sums.rad[steps] + rad) * OUTWARD), rounded * OUTWARD

    def between(self, times: Array, start: Array | float, stop: Array | float) -> Enclosed:
        """Return what an input of 1 from ``start`` to ``stop`` adds to the row at exact times, ``(..., q)``. The radius
        allows for the rounding of differences of times."""
        (since, one), (until, other) = subtract_times(times, start), subtract_times(times, stop)
        (late, first), (early, second) = self.integrals(since), self.integrals(until)
        mid = late.mid - early.mid
        rad = np.abs(late.rad - early.rad) + (OUTWARD - 1.0) * (late.rad + early.rad) + first + second
        rad = rad + HALF_ULP * np.abs(mid) + (one + other)[..., None] * self.fastest
        return Enclosed(mid, rad * OUTWARD)

    @cached_property
    def fastest(self) -> Array:
        """The upper bound of ``|l'F|`` at all times, ``(q,)``."""
        return np.asarray((np.abs(self.driven.mid) + self.driven.rad).sum(axis=1).max(axis=0) * OUTWARD)

    @cached_property
    def bends(self) -> tuple[Array, Array, Array]:
        """The upper bounds on every step of ``|l''|``, ``(N, d)``, of ``|l'AF|`` and of ``|l'A^2 F|``, ``(N, q)``
        each."""
        if self.opposite is not None:
            return self.opposite.bends
        d, q, terms = self.motion.states, self.motion.F.ncols(), self.motion.bending
        found = np.zeros((self.count, d + 2 * q))
        several = max(1, AT_ONCE // (d + 2 * q))
        for start in range(0, self.count, several):
            steps = slice(start, min(start + several, self.count))
            for one in zip(terms.mid[:, None], terms.rad[:, None], strict=True):
                mid, rad = _product(Enclosed(self.nodes.mid[steps], self.nodes.rad[steps]), Enclosed(*one))
                found[steps] += np.abs(mid[:, 0]) + rad[:, 0]
        found *= OUTWARD
        return found[:, :d], found[:, d : d + q], found[:, d + q :]


@final
@dataclass(frozen=True, eq=False)
class SupportIntegrals:
    """The integrals, from 0 on, of the support functions of ``sides`` at some ``columns`` of ``l'F`` for one ``row``:
    one integral for every side."""

    row: AdjointRow
    columns: slice
    sides: Sequence[Side | CurvedSide]

    @cached_property
    def _polynomials(self) -> tuple[Array, Array, Array]:
        """The columns of ``l'F`` on every step in powers of ``u`` from -1 to 1, ``(N, p + 1, w)``; their error bounds,
        which allow for rounding errors in the sum of two of their values; and bounds of their absolute values,
        ``(N, w)`` each."""
        mid, rad = (part[:, :, self.columns] for part in (self.row.driven.mid, self.row.driven.rad))
        size = np.abs(mid).sum(axis=1) * OUTWARD  # no larger in powers of ``u``, since ``|v| <= (1 + |u|) / 2``
        off = rad.sum(axis=1) + (rounding(2 * ORDER) + rounding(size.shape[1] + 2 * ORDER)) * size
        return np.einsum("ij,kjw->kiw", CENTRED, mid), off * OUTWARD, size

    @cached_property
    def _heights(self) -> Array:
        """The upper bounds of the support functions on every step and its neighbours, ``(N, S)``."""
        _, off, size = self._polynomials
        found = (size + off) @ np.array([side.far for side in self.sides]).T * OUTWARD
        around = np.pad(found, ((1, 1), (0, 0)), mode="edge")
        return np.asarray(np.maximum(found, np.maximum(around[:-2], around[2:])))

    def _parts(self, steps: np.ndarray, shares: Array) -> tuple[Array, Array, Array]:
        """Return the integrals over the first ``shares (k,)`` of ``steps (k,)``, and how much more and how much less
        they may be, ``(k, S)`` each."""
        P, off, size = (part[steps] for part in self._polynomials)
        found = []
        for side in self.sides:
            value, more, less, tops = side.swept(P, off, size, 2.0 * shares - 1.0)
            rounded = rounding(4 * ORDER) * 2.0 * tops
            found.append((value, (more + rounded) * OUTWARD, (less + rounded) * OUTWARD))
        value, more, less = (np.stack(part, axis=1) * (self.row.step / 2.0) for part in zip(*found, strict=True))
        return value, more, less

    @cached_property
    def _ends(self) -> tuple[Array, Array, Array]:
        """The integrals from 0 to the end of every step, and how much more and how much less they may be,
        ``(N + 1, S)`` each."""
        value, more, less = self._parts(np.arange(self.row.count), np.ones(self.row.count))
        outward = OUTWARD * (1.0 + rounding(self.row.count))
        return accumulate_exactly(value), _accumulated(more) * outward, _accumulated(less) * outward

    def at(self, times: Array, rounded: Array | float = 0.0) -> tuple[Array, Array]:
        """Return lower and upper bounds ``(k, S)`` of the integrals from 0 to ``times (k,)``, whose rounding errors are
        at most ``rounded``."""
        steps, shares = self.row.placed(times)
        (value, more, less), inside = (part[steps] for part in self._ends), self._parts(steps, shares)
        found = value + inside[0]
        lost = np.asarray(rounded)[..., None] * self._heights[steps] + 4.0 * HALF_ULP * (np.abs(value) + np.abs(found))
        return found - (less + inside[2] + lost) * OUTWARD, found + (more + inside[1] + lost) * OUTWARD


@final
@dataclass(frozen=True, eq=False)
class Stopped:
    """A sum of adjoints, each of which stays constant from a time of its own on. It replaces an `AdjointRow` at single
    times.

    Attributes
    ----------
    parts
        The adjoints, and the time from which each is constant.
    ways
        For an integral of a row from ``a`` to ``b``, the adjoints that a measurable disturbance meets, backwards in
        time: that of the row over the length ``b - a``, then over the length ``a`` that of ``r(b - a) - r(0)``, where
        ``r(s)`` is the adjoint of the row after ``s``. With each, its length and the rounding error of this length.
    """

    parts: Sequence[tuple[AdjointRow, float]]
    ways: Sequence[tuple[AdjointRow, float, float]] = ()

    @staticmethod
    def integral(parts: Sequence[tuple[AdjointRow, float]], row: Array, begin: float, end: float) -> Stopped:
        """Return the sum for the integral of a ``row (d,)`` from ``begin`` to ``end``, whose ``parts`` are given."""
        from flint import arb, arb_mat

        (first, _), motion = parts[0], parts[0][0].motion
        exact = arb_mat([[arb(float(v)) for v in row]])
        turned = exact * (motion.A * (arb(end) - arb(begin))).exp() - exact
        length, rounded = (part.item() for part in subtract_times(np.array([end]), begin))
        return Stopped(parts, [(first, length, rounded), (AdjointRow.of_balls(motion, turned.tolist()[0]), begin, 0.0)])

    @property
    def motion(self) -> AdjointFlow:
        """The adjoint flow that all parts share."""
        return self.parts[0][0].motion

    def at(self, times: Array) -> Enclosed:
        """Return the sum of the adjoints at exact ``times (k,)``, ``(k, d)``."""
        return _sum([row.at(np.minimum(times, until)) for row, until in self.parts])

    def between(self, times: Array, start: Array | float, stop: Array | float) -> Enclosed:
        """Return what an input of 1 from ``start`` to ``stop`` adds to the sum at exact times, ``(..., q)``."""
        return _sum([row.between(np.minimum(times, until), start, stop) for row, until in self.parts])


def _sum(parts: Sequence[Enclosed]) -> Enclosed:
    mid, rad = parts[0].mid, parts[0].rad
    for part in parts[1:]:
        mid = mid + part.mid
        rad = rad + part.rad + HALF_ULP * np.abs(mid)
    return Enclosed(mid, rad * OUTWARD)


def accumulate_exactly(values: Array) -> Array:
    """Return the sums of the first ``0, 1, ..., N`` of ``values (N, q)``, each rounded once."""
    sums = [accumulate(balls(column), initial=ball(0.0)) for column in values.T]
    return np.array([[float(x) for x in column] for column in sums]).reshape(-1, len(values) + 1).T


def _accumulated(values: Array) -> Array:
    return np.vstack([np.zeros((1, values.shape[1])), np.cumsum(values, axis=0)])


def subtract_times(times: Array, others: Array | float) -> tuple[Array, Array]:
    """Return the differences of times as floats, and the absolute values of their rounding errors (Knuth 1997, section
    4.2.2, theorem B)."""
    nearest = times - np.asarray(others, dtype=float)
    part = nearest - times
    return nearest, np.abs((times - (nearest - part)) - (others + part))


def _product(left: Enclosed, right: Enclosed) -> tuple[Array, Array]:
    """Return the products ``(k, j, n)`` of rows ``(k, d)`` with matrices ``(j, d, n)``, and their error bounds. The
    rounding error grows with the number of terms of one partial sum plus the number of these sums (Higham 2002, section
    4.2)."""
    j, d, n = right.mid.shape
    flat, off = (part.transpose(1, 0, 2).reshape(d, j * n) for part in (right.mid, right.rad))
    size = np.abs(left.mid)
    mid = left.mid[:, :SUMMED] @ flat[:SUMMED]
    for start in range(SUMMED, d, SUMMED):
        mid += left.mid[:, start : start + SUMMED] @ flat[start : start + SUMMED]
    met = min(d, SUMMED) + (d - 1) // SUMMED
    rad = size @ (off + rounding(met) * np.abs(flat)) + left.rad @ (np.abs(flat) + off)
    return mid.reshape(-1, j, n), rad.reshape(-1, j, n) * OUTWARD


@final
@dataclass(frozen=True, eq=False)
class Worst:
    """The largest ``c'x(t)`` over all initial states and disturbances.

    Attributes
    ----------
    adjoint
        The adjoint of the row ``c``.
    centre, begun
        The centre of the initial states, ``(d,)``, and the set of deviations from it.
    grid, drives
        Times ``(L + 1,)``, and the known inputs between them, ``(q', L)``, which enter by the first inputs of the
        adjoint.
    pushed
        The set of the disturbance, which enters by the last inputs.
    changes
        The times ``(M + 1,)`` between which the disturbance is constant; ``None`` where it is measurable.
    """

    adjoint: AdjointRow | Stopped
    centre: Array
    begun: ConvexSet | None
    grid: Array
    drives: Enclosed
    pushed: ConvexSet | None
    changes: Array | None

    @property
    def _row(self) -> AdjointRow:
        """The one adjoint of the row, where it is known at all times."""
        if isinstance(self.adjoint, Stopped):
            raise Unchecked("a sum of rows that stop is known at single times alone")
        return self.adjoint

    @property
    def _mine(self) -> slice:
        """The inputs of the adjoint by which the disturbance enters."""
        return slice(self.drives.mid.shape[0], None)

    def along(self, time: float, deviation: Array, changes: Array, signal: Array | None) -> tuple[float, float]:
        """Return a lower and an upper bound of the row at a time along one trajectory.

        Parameters
        ----------
        time
            The time.
        deviation
            The initial deviation from the centre, ``(d,)``.
        changes, signal
            Times ``(M + 1,)``, and the disturbance between them, ``(mw, M)``; the signal is ``None`` without a
            disturbance.
        """
        times = np.array([time])
        row = self.adjoint.at(times)
        value, rad = self._driven(times)
        for state in (self.centre, deviation):
            value = value + row.mid @ state
            rad = rad + row.rad @ np.abs(state) + rounding(state.size) * (np.abs(row.mid) @ np.abs(state))
            rad = rad + 2.0 * HALF_ULP * np.abs(value)
        if signal is not None:
            late, early = np.append(changes[:-1], time)[:-1], np.minimum(changes[1:], time)
            part = self.adjoint.between(np.full(late.size, time), late, early)
            gains, off = part.mid[:, self._mine] * signal.T, part.rad[:, self._mine] * np.abs(signal.T)
            value = value + gains.sum()
            rad = rad + off.sum() + rounding(gains.size) * np.abs(gains).sum()
        lost = float(rad[0] + 4.0 * HALF_ULP * abs(value[0])) * OUTWARD
        return float(value[0]) - lost, float(value[0]) + lost

    def _driven(self, times: Array) -> tuple[Array, Array]:
        """Return what the known inputs add to the row at ``times (k,)``, and the error bounds, ``(k,)`` each."""
        mid, rad, size = np.zeros(times.size), np.zeros(times.size), np.zeros(times.size)
        used = self.drives.mid.shape[0]
        for k, (start, stop) in enumerate(zip(self.grid[:-1], self.grid[1:], strict=True)):
            u, off = self.drives.mid[:, k], self.drives.rad[:, k]
            if u.any():
                part = self.adjoint.between(times, float(start), float(stop))
                mid += part.mid[:, :used] @ u
                rad += part.rad[:, :used] @ (np.abs(u) + off) + np.abs(part.mid[:, :used]) @ off
                size += np.abs(part.mid[:, :used]) @ np.abs(u)
        return mid, rad + rounding(used + self.grid.size) * size

    def most(self, times: Array) -> tuple[Array, Array]:
        """Return upper bounds ``(k,)`` of the largest value at exact ``times (k,)``, and how far these bounds may be
        above it, ``(k,)``. The second result is proven for flat sets only."""
        rows = self.adjoint.at(times)
        top, rad = self._driven(times)
        size = np.abs(rows.mid) @ np.abs(self.centre)
        top = top + rows.mid @ self.centre
        rad = rad + rows.rad @ np.abs(self.centre) + rounding(self.centre.size) * size
        parts = [] if self.begun is None else [_supported(self.begun, rows)]
        if self.pushed is not None:
            parts.append(self._constant(times) if self.changes is not None else self._measurable(times))
        for high, more in parts:
            top, rad, size = top + high, rad + more, size + np.abs(high)
        rad = (rad + 8.0 * HALF_ULP * (np.abs(top) + size)) * OUTWARD
        return top + rad, 3.0 * rad

    def carried(self, time: float) -> list[arb]:
        """Return the weights ``(d,)`` of the initial state in the row at a time."""
        from flint import arb

        row = self.adjoint.at(np.array([time]))
        return [arb(m, r) for m, r in zip(row.mid[0].tolist(), row.rad[0].tolist(), strict=True)]

    def weights(self, time: float, starts: Array, stops: Array) -> list[list[arb]]:
        """Return the weights of inputs between ``starts (K,)`` and ``stops (K,)`` in the row at a time, ``(q,)`` for
        each."""
        from flint import arb

        begun, columns = starts < time, self.adjoint.motion.F.ncols()
        found = [[arb(0)] * columns for _ in range(starts.size)]
        part = self.adjoint.between(np.full(begun.sum(), time), starts[begun], np.minimum(stops[begun], time))
        for k, mid, rad in zip(np.flatnonzero(begun).tolist(), part.mid.tolist(), part.rad.tolist(), strict=True):
            found[k] = [arb(m, r) for m, r in zip(mid, rad, strict=True)]
        return found

    def pushed_by(self, time: float) -> arb:
        """Return what the worst disturbance adds to the row at a time."""
        from flint import arb

        assert self.pushed is not None
        if self.changes is None:
            (value,), (rad,) = self._measurable(np.array([time]))
            return arb(float(value), float(2.0 * rad))
        every = self.weights(time, self.changes[:-1], self.changes[1:])
        return sum((known(self.pushed).support(one[self._mine]) for one in every), arb(0))

    def _constant(self, times: Array) -> tuple[Array, Array]:
        """Return what the worst disturbance that is constant between ``changes`` adds to the row at ``times (k,)``, and
        error bounds, ``(k,)`` each."""
        assert self.pushed is not None and self.changes is not None
        top, rad = np.zeros(times.size), np.zeros(times.size)
        for start, stop in zip(self.changes[:-1], self.changes[1:], strict=True):
            part = self.adjoint.between(times, float(start), float(stop))
            high, more = _supported(self.pushed, Enclosed(part.mid[:, self._mine], part.rad[:, self._mine]))
            top, rad = top + high, rad + more + HALF_ULP * np.abs(top)
        return top, rad

    @cached_property
    def _about(self) -> Array:
        """The middle of the set of a measurable disturbance, ``(mw,)``."""
        assert self.pushed is not None
        return middle(self.pushed)

    @cached_property
    def _swept(self) -> SupportIntegrals:
        """The integrals of the support functions of a measurable disturbance about the middle of its set."""
        assert self.pushed is not None
        return SupportIntegrals(self._row, self._mine, Side.of(self.pushed))

    def _measurable(self, times: Array) -> tuple[Array, Array]:
        """Return what the worst measurable disturbance adds to the row at ``times (k,)``, and error bounds, ``(k,)``
        each."""
        if isinstance(self.adjoint, Stopped):
            return self._over_ways(self.adjoint, times)
        low, high = (part.sum(axis=1) for part in self._swept.at(times))
        linear, rounded = self._row.integrals(times)
        mid, off = linear.mid[:, self._mine], (linear.rad + rounded)[:, self._mine]
        top = (low + high) / 2.0 + mid @ self._about
        size = np.abs(mid) @ np.abs(self._about) + np.abs(low) + np.abs(high)
        lost = rounding(len(self._swept.sides) + self._about.size + 2) * size
        return top, (high - low) / 2.0 + off @ np.abs(self._about) + lost

    def _over_ways(self, stopped: Stopped, times: Array) -> tuple[Array, Array]:
        """Return what the worst measurable disturbance adds to an integral that has ended at all ``times (k,)``, and
        error bounds, ``(k,)`` each."""
        assert self.pushed is not None
        if not stopped.ways or (times < stopped.parts[0][1]).any():
            raise Unchecked("of measurable disturbances one integral at a time is followed")
        top, rad = np.zeros(times.size), np.zeros(times.size)
        far: Array = np.abs(self._about) + np.array(known(self.pushed).radius)
        for row, length, rounded in stopped.ways:
            value, more = replace(self, adjoint=row)._measurable(np.full(times.size, length))
            top = top + value
            rad = rad + more + HALF_ULP * np.abs(top) + rounded * float(row.fastest[self._mine] @ far)
        return top, rad * OUTWARD

    @cached_property
    def _bent(self) -> Array:
        """The bounds ``(N,)`` of the curvature of the largest value on every step. Times an eighth of the square of the
        width of a cell, they bound how far the largest value lies above its chord."""
        states, once, twice = self._row.bends
        far = np.abs(self.centre) + (0.0 if self.begun is None else np.array(known(self.begun).radius))
        found = states @ far
        inputs = np.zeros(once.shape[1])
        used = self.drives.mid.shape[0]
        inputs[:used] = (np.abs(self.drives.mid) + self.drives.rad).max(axis=1, initial=0.0)
        if self.pushed is not None:
            radius = np.array(known(self.pushed).radius)
            if self.changes is None:  # an integral of a support function, whose argument changes at the rate l'AE
                found = found + once[:, self._mine] @ radius
            else:
                inputs[self._mine] = radius
        # an input on a piece has a difference of l'AF as second derivative: all together the total variation of l'AF,
        # and one value for the piece that acts
        total = self._row.step * float((twice @ inputs).sum()) + float((once @ inputs).max(initial=0.0))
        return np.asarray((found + total) * OUTWARD)

    def over(self, start: Array, stop: Array, beside: Array | float = 0.0) -> Array:
        """Return upper bounds ``(k,)`` of the largest value on cells from ``start (k,)`` to ``stop (k,)``, each between
        two `cuts`.

        The values ``beside (2, k)`` are added at both ends of every cell, and linearly in between.
        """
        ends, which = np.unique(np.concatenate([start, stop]), return_inverse=True)
        several = max(1, AT_ONCE // self.adjoint.motion.states)  # the adjoints at all ends take much memory
        parts = [self.most(ends[k : k + several])[0] for k in range(0, ends.size, several)]
        tops = np.concatenate(parts)[which]
        width, bent = (stop - start) * OUTWARD, np.zeros(start.size)
        if width.any():
            step, last = self._row.step, self._row.count - 1
            bent = np.maximum(*(self._bent[np.clip((t / step).astype(int), 0, last)] for t in (start, stop)))
        both = tops.reshape(2, -1) + beside
        lost = 4.0 * HALF_ULP * (np.abs(both) + np.abs(beside)).max(axis=0)
        return np.asarray(both.max(axis=0) + (width**2 / 8.0 * bent + lost) * OUTWARD)

    def cuts(self, more: Sequence[float]) -> Array:
        """Return times, among them ``more``, between which no input jumps and which are at most a step apart."""
        parts = [np.asarray(more, dtype=float)]
        if isinstance(self.adjoint, AdjointRow):
            parts.append(np.arange(self.adjoint.count + 1) * self.adjoint.step)
        parts += [self.grid] if self.drives.mid.any() else []
        parts += [self.changes] if self.pushed is not None and self.changes is not None else []
        return np.unique(np.concatenate(parts))


def _supported(bound: ConvexSet, rows: Enclosed) -> tuple[Array, Array]:
    """Return the support values of a set at rows ``(k, d)``, and how much more they may be, ``(k,)`` each."""
    w, excess = known(bound).bound(rows.mid, rows.rad)
    size = (np.abs(w) * np.abs(rows.mid)).sum(axis=1)
    more = (np.abs(w) * rows.rad).sum(axis=1) + rounding(rows.mid.shape[1]) * size
    return (w * rows.mid).sum(axis=1), (more + np.abs(excess)) * OUTWARD


# from powers of the share ``v`` of a step to powers of ``u = 2 v - 1``: ``v^j = (1 + u)^j / 2^j``
CENTRED = np.array([[comb(j, i) / 2.0**j for j in range(ORDER + 1)] for i in range(ORDER + 1)])
