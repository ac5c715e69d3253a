"""The worst of ``c'x(t)`` for a known system that does not change with time, by its adjoint ``l(s) = e^{A's} c``.

A row is followed backwards, one vector a time, never a transition: of 270 states and 4096 times these are 9 MB. What
acts on ``[a, b]`` moves ``c'x(t)`` by an integral of ``l`` from ``t - b`` to ``t - a``, and what initial states do is
their support function of ``l(t)``. On a short cell of times all of it lies below its chord, plus a term that falls with
the square of the cell's width: support functions are convex, and bend by what their arguments bend.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from itertools import pairwise
from math import ceil, factorial, log2

import numpy as np

from sparserob_core.control.enclosures.flows import products
from sparserob_core.control.enclosures.matrix_exponential import exponential, rounding
from sparserob_core.control.reach.measurable import ORDER
from sparserob_core.control.sets.integrals import integrated
from sparserob_core.errors import NotEnclosable
from sparserob_core.sip.convex_set import Array, ConvexSet

SHORT = 0.5  # norm times length of a step: what is left of the expansion is then 1e-14 of the row
BENDING = 7  # terms of the bounds of derivatives; what is left of them is 1e-6 of the row's size in balanced units
MOST = 2**27  # numbers that the rows of all steps take (1 GB)
ROWS = 2**22  # numbers of rows that are expanded at once (32 MB)
MOVED = 46  # a power of 1/2 of the horizon: what a witness loses by it is rounding, and 53 bits hold sums of such times
INWARDS = 1e-12  # of a set without axes, what corners and boundary points may be off: thousands of roundings
HALVED = 44  # halvings of a step across a switch: what is left of it is rounding
MOST_SWITCHES = 4096  # of a set without corners, whose best value changes all the time
# Roundings of a transition over a step, for each of which the row at the end is off as often as there are steps; a beam
# of 348 states, whose modes are far from normal, was off by 0.7 of them.
ROUNDED = 4
FACTORIALS = np.array([float(factorial(j)) for j in range(ORDER + 2)])


@dataclass(frozen=True, eq=False)
class Adjoint:
    """``l(s)`` at the ends of equal steps, ``nodes (N + 1, d)``, and ``int_0^s l(r)'B dr``, ``driven (N + 1, q)``, in
    the units ``(d,)`` in which ``A (d, d)`` is balanced, ``B (d, q)`` too."""

    A: Array
    B: Array
    units: Array
    nodes: Array
    driven: Array
    step: float

    @staticmethod
    def of(A: Array, B: Array, c: Array, horizon: float) -> Adjoint:
        """That of one row ``c (d,)``. Raises `NotEnclosable` for a system that is too fast for its horizon."""
        from scipy.linalg import matrix_balance

        balanced, (units, _) = matrix_balance(A, permute=False, separate=True)
        speed = float(np.linalg.norm(balanced, 2)) * horizon
        count = 2 ** max(6, ceil(log2(max(speed, 1e-300) / SHORT)))
        if not count * A.shape[0] <= MOST:
            raise NotEnclosable(
                f"its fastest part moves {speed:.2g} times within the horizon, which takes too many steps"
            )
        step, inputs = horizon / count, B / units[:, None]
        power, rows = exponential(balanced * step), (c * units)[None]
        while rows.shape[0] < count:
            rows, power = np.vstack([rows, rows @ power]), power @ power
        rows = np.vstack([rows, rows[:1] @ power])
        found = Adjoint(balanced, inputs, units, rows, np.zeros((1, B.shape[1])), step)
        moved = step * np.einsum("kjq,j->kq", found.coefficients, 1.0 / np.arange(1, ORDER + 2))
        return replace(found, driven=np.vstack([found.driven, np.cumsum(moved, axis=0)]))

    def reversed(self) -> Adjoint:
        """That of ``-c``."""
        return replace(self, nodes=-self.nodes, driven=-self.driven)

    @cached_property
    def speed(self) -> float:
        """The norm of ``A`` in balanced units."""
        return float(np.linalg.norm(self.A, 2))

    @cached_property
    def _products(self):  # type: ignore[no-untyped-def]  # an array, or one of scipy's sparse arrays
        return products(self.A)

    @cached_property
    def coefficients(self) -> Array:
        """``l' B`` on every step in powers of the share of it that has passed, ``(N, p + 1, q)``."""
        row, found = self.nodes[:-1], []
        for order in range(ORDER + 1):
            found.append(row @ self.B)
            row = np.asarray(row @ self._products) * (self.step / (order + 1))
        return np.stack(found, axis=1)

    @cached_property
    def bends(self) -> tuple[Array, Array, Array]:
        """On every step bounds of ``|l''|`` in the user's units, ``(N, d)``, of ``|l' A B|`` and ``|l' A^2 B|``,
        ``(N, q)``."""
        d, h = self.A.shape[0], self.step
        found = [np.zeros((self.nodes.shape[0] - 1, n)) for n in (d, self.B.shape[1], self.B.shape[1])]
        row = np.asarray(self.nodes[:-1] @ self._products)
        for order in range(BENDING + 1):
            found[1] += np.abs(row @ self.B) * h**order / FACTORIALS[order]
            row = np.asarray(row @ self._products)
            found[0] += np.abs(row) * h**order / FACTORIALS[order]
            found[2] += np.abs(row @ self.B) * h**order / FACTORIALS[order]
        # Lagrange's remainder of all three, by norms in balanced units
        short = self.speed * h
        left = np.linalg.norm(row, axis=1, keepdims=True) * h ** (BENDING + 1) * np.exp(short) / FACTORIALS[BENDING + 1]
        sizes = np.linalg.norm(self.B, axis=0)
        return (
            (found[0] + left * self.speed) / self.units,
            found[1] + left * sizes,
            found[2] + left * self.speed * sizes,
        )

    def placed(self, times: Array) -> tuple[np.ndarray, Array]:
        """The step ``(...)`` of every time, and the share of it that has passed."""
        steps = np.clip(np.floor(times / self.step).astype(int), 0, self.nodes.shape[0] - 2)
        return steps, times / self.step - steps

    def rows(self, times: Array) -> Array:
        """``l`` at times ``(k,)``, ``(k, d)``, in the user's units."""
        steps, shares = self.placed(times)
        found, several = np.empty((times.size, self.A.shape[0])), max(1, ROWS // self.A.shape[0])
        for start in range(0, times.size, several):
            part = slice(start, start + several)
            row, total = self.nodes[steps[part]], np.zeros((steps[part].size, self.A.shape[0]))
            moving = np.flatnonzero(shares[part])
            total[:] = row
            row = row[moving]
            for order in range(1, ORDER + 1):
                row = np.asarray(row @ self._products) * (self.step * shares[part][moving] / order)[:, None]
                total[moving] += row
            found[part] = total
        return found / self.units

    def integrals(self, times: Array) -> Array:
        """``int_0^s l'B dr`` at times ``(...)``, ``(..., q)``; 0 before time 0."""
        steps, shares = self.placed(np.maximum(times, 0.0))
        total = np.zeros((*times.shape, self.B.shape[1]))
        for order in range(ORDER, -1, -1):
            total = total * shares[..., None] + self.coefficients[steps, order] / (order + 1)
        return np.asarray(self.driven[steps] + self.step * shares[..., None] * total)


def within(bound: ConvexSet, points: Array) -> Array:
    """Points ``(..., d)`` of the boundary moved inwards by what rounding may have put them outside; those of a box are
    exact."""
    if bound.is_box:
        return points
    middle = bound.interior_point()
    return np.asarray(middle + (1.0 - INWARDS) * (points - middle))


def tidy(times: Array, horizon: float) -> Array:
    """Times moved by a share of at most `MOVED` of the horizon to where their differences are not rounded."""
    unit = 2.0 ** (ceil(log2(horizon)) - MOVED)
    return np.asarray(np.minimum(np.round(times / unit) * unit, horizon))


@dataclass(frozen=True, eq=False)
class Pushes:
    """What disturbances ``w(t)`` in ``bound`` add: constant between the times ``changes (M + 1,)``, or, without these,
    measurable. ``inputs``: which of the adjoint's they enter by."""

    bound: ConvexSet
    inputs: slice
    changes: Array | None


@dataclass(frozen=True, eq=False)
class WorstRow:
    """The largest ``c'(x(t) - r(t)) + g'u(t)`` over all disturbances and initial states.

    ``centre (d,)`` and the deviations from it ``begun``; ``drives (q', L)`` on pieces of ``grid (L + 1,)``: what is
    known of the first inputs; ``pushes`` of the others. ``beside``: ``g'u`` on the pieces of the control, between its
    own breakpoints; ``moving``: times and values of ``c'r``.
    """

    adjoint: Adjoint
    centre: Array
    begun: ConvexSet | None
    grid: Array
    drives: Array
    pushes: Pushes | None
    beside: tuple[Array, Array] | None = None
    moving: tuple[Array, Array] | None = None

    def cuts(self) -> Array:
        """Times between which the row is smooth but for disturbances about to switch, increasing."""
        parts: list[Array] = [self.grid if self.drives.any() else self.grid[[0, -1]]]
        parts += [] if self.pushes is None or self.pushes.changes is None else [self.pushes.changes]
        parts += [] if self.beside is None else [self.beside[0]]
        parts += [] if self.moving is None else [self.moving[0]]
        parts += [np.asarray(np.arange(self.adjoint.nodes.shape[0]) * self.adjoint.step, dtype=float)]
        return np.unique(np.concatenate(parts))

    def at(self, times: Array, inside: Array | None = None) -> tuple[Array, Array]:
        """Bounds ``(k,)`` of the largest value at ``times (k,)``: one that is reached, and one that is not exceeded but
        for rounding, which `lost` bounds; with the control of the pieces that hold the times ``inside``."""
        rows, middle = self.adjoint.rows(times), self._driven(times)
        low = middle + rows @ self.centre
        if self.begun is not None:
            low = low + self.begun.support(rows)
        if self.moving is not None:
            low = low - np.interp(times, *self.moving)
        if self.beside is not None:
            breaks, values = self.beside
            held = np.searchsorted(breaks, times if inside is None else inside, side="right") - 1
            low = low + values[np.clip(held, 0, values.size - 1)]
        if self.pushes is None:
            return low, low
        pushed = self._pushed(times)
        return low + pushed[:, 0], low + pushed[:, 1]

    def _driven(self, times: Array) -> Array:
        if not self.drives.any():
            return np.zeros(times.size)
        used = self.drives.shape[0]
        return np.asarray(
            sum(
                np.einsum("kq,q->k", self._between(times, a, b)[:, :used], u)
                for a, b, u in zip(self.grid[:-1], self.grid[1:], self.drives.T, strict=True)
                if u.any()
            )
        )

    def _between(self, times: Array, start: float, stop: float) -> Array:
        """What an input of 1 from ``start`` to ``stop`` adds to the row at every time, ``(k, q)``."""
        return self.adjoint.integrals(times - start) - self.adjoint.integrals(times - stop)

    def _pushed(self, times: Array) -> Array:
        assert self.pushes is not None
        bound, mine = self.pushes.bound, self.pushes.inputs
        if self.pushes.changes is not None:
            total = np.zeros(times.size)
            for a, b in pairwise(self.pushes.changes):
                total += bound.support(self._between(times, a, b)[:, mine])
            return np.stack([total, total], axis=1)
        steps, shares = self.adjoint.placed(times)
        inside = self._integrated(steps, shares)
        return np.asarray(self._sums[steps] + inside)

    @cached_property
    def _sums(self) -> Array:
        """Bounds of the integral of the support function of ``E'l``, up to the end of every step, ``(N + 1, 2)``."""
        steps = np.arange(self.adjoint.nodes.shape[0] - 1)
        return np.vstack([np.zeros(2), np.cumsum(self._integrated(steps, np.ones(steps.size)), axis=0)])

    def _integrated(self, steps: np.ndarray, shares: Array) -> Array:
        """Bounds of the integrals over the first shares ``(k,)`` of some steps, ``(k, 2)``."""
        assert self.pushes is not None
        powers = shares[:, None] ** np.arange(ORDER + 1)
        points = self.adjoint.coefficients[steps][:, :, self.pushes.inputs] * powers[..., None]
        lengths = shares * self.adjoint.step
        return integrated(self.pushes.bound, points, lengths, np.full(lengths.size, self._accuracy))

    @cached_property
    def _accuracy(self) -> float:
        assert self.pushes is not None
        largest = np.abs(self.adjoint.coefficients[:, 0, self.pushes.inputs]).sum(axis=1).max(initial=0.0)
        return float(1e-14 * self.pushes.bound.radius_bound * largest * self.grid[-1])

    @cached_property
    def lost(self) -> float:
        """What rounding, and the rest of the expansions, may change of any value, at most: the roundings of rows that
        are doubled again and again, and of the transition over a step, which every squaring doubles, in the largest sum
        of absolute values that is met (Higham 2002, section 3.1). An estimate where products grow in between; the
        checker derives every bound anew in ball arithmetic."""
        steps = self.adjoint.nodes.shape[0]
        terms = 2 * self.adjoint.A.shape[0] * (ceil(log2(steps)) + 2) + ORDER + 8 + ROUNDED * steps
        size = float((np.abs(self.adjoint.nodes / self.adjoint.units) @ self._far).max())
        size += float((np.abs(self.adjoint.coefficients[:, 0]) @ self._inputs_far).sum() * self.adjoint.step)
        size += 0.0 if self.beside is None else float(np.abs(self.beside[1]).max())
        size += 0.0 if self.moving is None else float(np.abs(self.moving[1]).max())
        norms = np.linalg.norm(self.adjoint.nodes, axis=1)
        inputs = float(np.linalg.norm(self.adjoint.B, axis=0) @ self._inputs_far) * self.adjoint.step
        rest = (SHORT ** (ORDER + 1)) * np.exp(SHORT) / FACTORIALS[ORDER + 1]
        rest *= float(norms.max() * np.linalg.norm(self._far / self.adjoint.units) + norms.sum() * inputs)
        return float(rounding(terms) * size + rest)

    @cached_property
    def _far(self) -> Array:
        """How far initial states are from 0, ``(d,)``."""
        far = np.abs(self.centre)
        return far if self.begun is None else far + self.begun.reach(np.eye(far.size))

    @cached_property
    def _inputs_far(self) -> Array:
        """The same of the inputs, ``(q,)``."""
        far = np.zeros(self.adjoint.B.shape[1])
        far[: self.drives.shape[0]] = np.abs(self.drives).max(axis=1, initial=0.0)
        if self.pushes is not None:
            far[self.pushes.inputs] = self.pushes.bound.reach(np.eye(self.pushes.bound.dimension))
        return far

    @cached_property
    def _bent(self) -> Array:
        """On every step a bound of what, times an eighth of the square of a cell's width, the row is above its chord by
        there, ``(N,)``."""
        states, once, twice = self.adjoint.bends
        far = self._inputs_far.copy()
        bent = states @ self._far
        if self.pushes is not None and self.pushes.changes is None:  # the slope of an integral that is a support
            bent = bent + once[:, self.pushes.inputs] @ far[self.pushes.inputs]
            far[self.pushes.inputs] = 0.0
        # of inputs on pieces: the change of l' A B from one end of a piece to the other, summed, and that at the last
        total = self.adjoint.step * (twice @ far).sum() + (once @ far).max(initial=0.0)
        return np.asarray(bent + total)

    def enclosed(self, lower: Array, upper: Array) -> Array:
        """Proven upper bounds ``(k,)`` on cells of times ``(k,)``, each between two `cuts`."""
        ends, which = np.unique(np.concatenate([lower, upper]), return_inverse=True)
        count, middles = lower.size, (lower + upper) / 2
        if self.beside is None:
            high = self.at(ends)[1][which]
        else:
            high = self.at(np.concatenate([lower, upper]), np.tile(middles, 2))[1]
        first, last = (np.clip((at / self.adjoint.step).astype(int), 0, self._bent.size - 1) for at in (lower, upper))
        bent = np.maximum(self._bent[first], self._bent[last])
        bent = np.maximum(bent, self._bent[np.clip((middles / self.adjoint.step).astype(int), 0, self._bent.size - 1)])
        return np.asarray(np.maximum(high[:count], high[count:]) + (upper - lower) ** 2 / 8 * bent + self.lost)

    def witness(self, time: float) -> tuple[Array, Array, Array | None]:
        """The deviation ``(d,)`` of the initial state that is worst at a time, and a disturbance ``(mw, M)`` between
        times ``(M + 1,)``, ``None`` where there is none."""
        row = self.adjoint.rows(np.array([time]))[0]
        state = np.zeros(row.size) if self.begun is None else within(self.begun, self.begun.support_point(row))
        if self.pushes is None:
            return state, self.grid[[0, -1]], None
        bound, mine = self.pushes.bound, self.pushes.inputs
        changes = self._switches(time) if self.pushes.changes is None else self.pushes.changes
        gains = np.stack([self._between(np.array([time]), a, b)[0, mine] for a, b in pairwise(changes)])
        values = np.where(
            np.abs(gains).max(axis=1)[:, None] > 0.0, within(bound, bound.support_point(gains)), bound.interior_point()
        )
        if self.pushes.changes is None:
            new = np.concatenate([[True], (np.diff(values, axis=0) != 0).any(axis=1)])
            changes, values = np.append(changes[:-1][new], changes[-1]), values[new]
        return state, changes, values.T

    def reached(self, time: float, deviation: Array, changes: Array, disturbance: Array | None) -> float:
        """The value of the row at a time from the centre and one deviation, and under one disturbance, as of `witness`,
        but for rounding, and with the control of the piece that begins last where it jumps."""
        times = np.array([time])
        calm = replace(self, centre=self.centre + deviation, begun=None, pushes=None)
        value = float(calm.at(times)[0][0])
        if self.pushes is not None and disturbance is not None:
            mine, ends = self.pushes.inputs, np.minimum(changes, time)
            moved = -np.diff(self.adjoint.integrals(time - ends)[:, mine], axis=0)
            value += float((moved * disturbance.T).sum())
        return value

    def _switches(self, time: float) -> Array:
        """Times between which one value of a measurable disturbance is best for the row at ``time``: the ends of the
        steps before it, and where the best value changes within one."""
        assert self.pushes is not None
        bound, mine = self.pushes.bound, self.pushes.inputs
        ends = np.append(np.arange(0.0, time, self.adjoint.step), time)
        start, stop = ends[:-1], ends[1:]

        def best(times: Array) -> Array:
            steps, shares = self.adjoint.placed(times)
            powers = shares[:, None] ** np.arange(ORDER + 1)
            return bound.support_point(np.einsum("kjq,kj->kq", self.adjoint.coefficients[steps][:, :, mine], powers))

        left, right = best(start), best(stop)
        for _ in range(HALVED):
            apart = np.asarray(left != right).any(axis=1)
            start, stop, left, right = start[apart], stop[apart], left[apart], right[apart]
            middle = (start + stop) / 2
            centre = best(middle)
            lower = (centre != left).any(axis=1)
            both = lower & (centre != right).any(axis=1) & (start.size < MOST_SWITCHES)
            start, stop, left, right = (
                np.concatenate([np.where(lower, start, middle), middle[both]]),
                np.concatenate([np.where(lower, middle, stop), stop[both]]),
                np.concatenate([np.where(lower[:, None], left, centre), centre[both]]),
                np.concatenate([np.where(lower[:, None], centre, right), right[both]]),
            )
        points = np.unique(np.concatenate([ends, (start + stop) / 2]))
        forward = tidy(np.maximum(time - points[::-1], 0.0), float(self.grid[-1]))
        return np.unique(np.append(forward, self.grid[-1]))
