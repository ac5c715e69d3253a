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
from scipy.linalg import matrix_balance

from sparserob_core.control.enclosures.flows import products
from sparserob_core.control.enclosures.matrix_exponential import exponential
from sparserob_core.control.reach.measurable import ORDER
from sparserob_core.control.sets.integrals import enclose_integrals
from sparserob_core.errors import NotEnclosable
from sparserob_core.sip.convex_set import Array, ConvexSet
from sparserob_core.sip.expressions.rounding import rounding

STEP_NORM = 0.5  # norm times length of a step: what is left of the expansion is then 1e-14 of the row
BENDING = 7  # terms of the bounds of derivatives; what is left of them is 1e-6 of the row's size in balanced units
MAX_STORED_NUMBERS = 2**27  # numbers that the rows of all steps take (1 GB)
MAX_ROW_NUMBERS = 2**22  # numbers of rows that are expanded at once (32 MB)
TIME_BITS = 46  # a power of 1/2 of the horizon: a witness loses rounding by it, and 53 bits hold sums of such times
BOUNDARY_ALLOWANCE = 1e-12  # of a set without axes, what corners and boundary points may be off: thousands of roundings
HALVED = 44  # halvings of a step across a switch: what is left of it is rounding
MAX_SWITCHES = 4096  # of a set without corners, whose best value changes all the time
# Roundings of a transition over a step, for each of which the row at the end is off as often as there are steps; a beam
# of 348 states, whose modes are far from normal, was off by 0.7 of them.
ROUNDINGS_PER_STEP = 4
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
        """Compute the adjoint of one row over a horizon.

        Parameters
        ----------
        A : ndarray, shape (d, d)
            Matrix of the system.
        B : ndarray, shape (d, q)
            Matrix of the inputs.
        c : ndarray, shape (d,)
            The row.
        horizon : float
            Length of the horizon.

        Raises
        ------
        NotEnclosable
            If the system is too fast for its horizon.
        """
        balanced, (units, _) = matrix_balance(A, permute=False, separate=True)
        speed = float(np.linalg.norm(balanced, 2)) * horizon
        count = 2 ** max(6, ceil(log2(max(speed, 1e-300) / STEP_NORM)))
        if not count * A.shape[0] <= MAX_STORED_NUMBERS:
            raise NotEnclosable(
                f"its fastest part moves {speed:.2g} times within the horizon, which takes too many steps"
            )
        step, inputs = horizon / count, B / units[:, None]
        power, rows = exponential(balanced * step), (c * units)[None]
        while rows.shape[0] < count:
            rows, power = np.vstack([rows, rows @ power]), power @ power
        rows = np.vstack([rows, rows[:1] @ power])
        adjoint = Adjoint(balanced, inputs, units, rows, np.zeros((1, B.shape[1])), step)
        integrals = step * np.einsum("kjq,j->kq", adjoint.coefficients, 1.0 / np.arange(1, ORDER + 2))
        return replace(adjoint, driven=np.vstack([adjoint.driven, np.cumsum(integrals, axis=0)]))

    def reversed(self) -> Adjoint:
        """Return the adjoint of ``-c``."""
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
        row, terms = self.nodes[:-1], []
        for order in range(ORDER + 1):
            terms.append(row @ self.B)
            row = np.asarray(row @ self._products) * (self.step / (order + 1))
        return np.stack(terms, axis=1)

    @cached_property
    def derivative_bounds(self) -> tuple[Array, Array, Array]:
        """Bounds of ``|l''|`` in the user's units, ``(N, d)``, and of ``|l' A B|`` and ``|l' A^2 B|``, ``(N, q)`` each,
        on every step."""
        d, h = self.A.shape[0], self.step
        bounds = [np.zeros((self.nodes.shape[0] - 1, n)) for n in (d, self.B.shape[1], self.B.shape[1])]
        row = np.asarray(self.nodes[:-1] @ self._products)
        for order in range(BENDING + 1):
            bounds[1] += np.abs(row @ self.B) * h**order / FACTORIALS[order]
            row = np.asarray(row @ self._products)
            bounds[0] += np.abs(row) * h**order / FACTORIALS[order]
            bounds[2] += np.abs(row @ self.B) * h**order / FACTORIALS[order]
        # Lagrange's remainder of all three, by norms in balanced units
        short = self.speed * h
        remainder = (
            np.linalg.norm(row, axis=1, keepdims=True) * h ** (BENDING + 1) * np.exp(short) / FACTORIALS[BENDING + 1]
        )
        sizes = np.linalg.norm(self.B, axis=0)
        return (
            (bounds[0] + remainder * self.speed) / self.units,
            bounds[1] + remainder * sizes,
            bounds[2] + remainder * self.speed * sizes,
        )

    def placed(self, times: Array) -> tuple[np.ndarray, Array]:
        """The step ``(...)`` of every time, and the share of it that has passed."""
        steps = np.clip(np.floor(times / self.step).astype(int), 0, self.nodes.shape[0] - 2)
        return steps, times / self.step - steps

    def rows(self, times: Array) -> Array:
        """``l`` at times ``(k,)``, ``(k, d)``, in the user's units."""
        steps, shares = self.placed(times)
        values, batch_size = np.empty((times.size, self.A.shape[0])), max(1, MAX_ROW_NUMBERS // self.A.shape[0])
        for start in range(0, times.size, batch_size):
            batch = slice(start, start + batch_size)
            row, total = self.nodes[steps[batch]], np.zeros((steps[batch].size, self.A.shape[0]))
            moving = np.flatnonzero(shares[batch])
            total[:] = row
            row = row[moving]
            for order in range(1, ORDER + 1):
                row = np.asarray(row @ self._products) * (self.step * shares[batch][moving] / order)[:, None]
                total[moving] += row
            values[batch] = total
        return values / self.units

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
    return np.asarray(middle + (1.0 - BOUNDARY_ALLOWANCE) * (points - middle))


def tidy(times: Array, horizon: float) -> Array:
    """Times moved by at most ``2^-TIME_BITS`` of the horizon to where their differences are not rounded."""
    unit = 2.0 ** (ceil(log2(horizon)) - TIME_BITS)
    return np.asarray(np.minimum(np.round(times / unit) * unit, horizon))


@dataclass(frozen=True, eq=False)
class DisturbanceInputs:
    """Disturbances ``w(t)`` in a set ``bound``.

    They are constant between the times ``changes (M + 1,)`` or, without these, measurable. They enter by the columns
    ``inputs`` of the adjoint's ``B``.
    """

    bound: ConvexSet
    inputs: slice
    changes: Array | None


@dataclass(frozen=True, eq=False)
class WorstRow:
    """Largest value of ``c'(x(t) - r(t)) + g'u(t)`` over all disturbances and initial states.

    Parameters
    ----------
    adjoint : Adjoint
        Adjoint of ``c``.
    centre : ndarray, shape (d,)
        Centre of the initial states.
    initial_deviations : ConvexSet or None
        Deviations of the initial state from the centre.
    grid : ndarray, shape (L + 1,)
        Ends of the pieces.
    drives : ndarray, shape (q', L)
        Known values of the first inputs on the pieces.
    disturbances : DisturbanceInputs or None
        Disturbances, which are the other inputs.
    control_terms : tuple of ndarray, optional
        Breakpoints of the control, and ``g'u`` on the pieces between them.
    moving : tuple of ndarray, optional
        Times and values of ``c'r``.
    """

    adjoint: Adjoint
    centre: Array
    initial_deviations: ConvexSet | None
    grid: Array
    drives: Array
    disturbances: DisturbanceInputs | None
    control_terms: tuple[Array, Array] | None = None
    moving: tuple[Array, Array] | None = None

    def cuts(self) -> Array:
        """Times between which the row is smooth but for disturbances about to switch, increasing."""
        cuts: list[Array] = [self.grid if self.drives.any() else self.grid[[0, -1]]]
        cuts += [] if self.disturbances is None or self.disturbances.changes is None else [self.disturbances.changes]
        cuts += [] if self.control_terms is None else [self.control_terms[0]]
        cuts += [] if self.moving is None else [self.moving[0]]
        cuts += [np.asarray(np.arange(self.adjoint.nodes.shape[0]) * self.adjoint.step, dtype=float)]
        return np.unique(np.concatenate(cuts))

    def at(self, times: Array, inside: Array | None = None) -> tuple[Array, Array]:
        """Bounds ``(k,)`` of the largest value at ``times (k,)``: one that is reached, and one that is not exceeded but
        for rounding, which `error_bound` bounds; with the control of the pieces that hold the times ``inside``."""
        rows, middle = self.adjoint.rows(times), self._compute_drive_effect(times)
        low = middle + rows @ self.centre
        if self.initial_deviations is not None:
            low = low + self.initial_deviations.support(rows)
        if self.moving is not None:
            low = low - np.interp(times, *self.moving)
        if self.control_terms is not None:
            breaks, values = self.control_terms
            pieces = np.searchsorted(breaks, times if inside is None else inside, side="right") - 1
            low = low + values[np.clip(pieces, 0, values.size - 1)]
        if self.disturbances is None:
            return low, low
        support_values = self._bound_disturbances(times)
        return low + support_values[:, 0], low + support_values[:, 1]

    def _compute_drive_effect(self, times: Array) -> Array:
        if not self.drives.any():
            return np.zeros(times.size)
        used = self.drives.shape[0]
        return np.asarray(
            sum(
                np.einsum("kq,q->k", self._integrate_between(times, a, b)[:, :used], u)
                for a, b, u in zip(self.grid[:-1], self.grid[1:], self.drives.T, strict=True)
                if u.any()
            )
        )

    def _integrate_between(self, times: Array, start: float, stop: float) -> Array:
        """Return the contribution of an input of 1 from ``start`` to ``stop`` to the row at every time, ``(k, q)``."""
        return self.adjoint.integrals(times - start) - self.adjoint.integrals(times - stop)

    def _bound_disturbances(self, times: Array) -> Array:
        assert self.disturbances is not None
        bound, columns = self.disturbances.bound, self.disturbances.inputs
        if self.disturbances.changes is not None:
            total = np.zeros(times.size)
            for a, b in pairwise(self.disturbances.changes):
                total += bound.support(self._integrate_between(times, a, b)[:, columns])
            return np.stack([total, total], axis=1)
        steps, shares = self.adjoint.placed(times)
        inside = self._bound_integrals(steps, shares)
        return np.asarray(self._cumulative_bounds[steps] + inside)

    @cached_property
    def _cumulative_bounds(self) -> Array:
        """Bounds of the integral of the support function of ``E'l``, up to the end of every step, ``(N + 1, 2)``."""
        steps = np.arange(self.adjoint.nodes.shape[0] - 1)
        return np.vstack([np.zeros(2), np.cumsum(self._bound_integrals(steps, np.ones(steps.size)), axis=0)])

    def _bound_integrals(self, steps: np.ndarray, shares: Array) -> Array:
        """Bounds of the integrals over the first shares ``(k,)`` of some steps, ``(k, 2)``."""
        assert self.disturbances is not None
        powers = shares[:, None] ** np.arange(ORDER + 1)
        points = self.adjoint.coefficients[steps][:, :, self.disturbances.inputs] * powers[..., None]
        lengths = shares * self.adjoint.step
        return enclose_integrals(self.disturbances.bound, points, lengths, np.full(lengths.size, self._accuracy))

    @cached_property
    def _accuracy(self) -> float:
        assert self.disturbances is not None
        largest = np.abs(self.adjoint.coefficients[:, 0, self.disturbances.inputs]).sum(axis=1).max(initial=0.0)
        return float(1e-14 * self.disturbances.bound.radius_bound * largest * self.grid[-1])

    @cached_property
    def error_bound(self) -> float:
        """Bound of the rounding error and the truncation error of any value of the row.

        It counts the rounding of rows that are doubled again and again, and that of the transition over a step, which
        every squaring doubles. Both are relative to the largest sum of absolute values that occurs (Higham 2002,
        section 3.1). The bound is an estimate where products grow in between; the checker derives every bound anew in
        ball arithmetic.
        """
        steps = self.adjoint.nodes.shape[0]
        terms = 2 * self.adjoint.A.shape[0] * (ceil(log2(steps)) + 2) + ORDER + 8 + ROUNDINGS_PER_STEP * steps
        size = float((np.abs(self.adjoint.nodes / self.adjoint.units) @ self._state_magnitudes).max())
        size += float((np.abs(self.adjoint.coefficients[:, 0]) @ self._input_magnitudes).sum() * self.adjoint.step)
        size += 0.0 if self.control_terms is None else float(np.abs(self.control_terms[1]).max())
        size += 0.0 if self.moving is None else float(np.abs(self.moving[1]).max())
        norms = np.linalg.norm(self.adjoint.nodes, axis=1)
        inputs = float(np.linalg.norm(self.adjoint.B, axis=0) @ self._input_magnitudes) * self.adjoint.step
        truncation = (STEP_NORM ** (ORDER + 1)) * np.exp(STEP_NORM) / FACTORIALS[ORDER + 1]
        truncation *= float(
            norms.max() * np.linalg.norm(self._state_magnitudes / self.adjoint.units) + norms.sum() * inputs
        )
        return float(rounding(terms) * size + truncation)

    @cached_property
    def _state_magnitudes(self) -> Array:
        """Largest absolute values of the initial states, ``(d,)``."""
        magnitudes = np.abs(self.centre)
        return (
            magnitudes
            if self.initial_deviations is None
            else magnitudes + self.initial_deviations.reach(np.eye(magnitudes.size))
        )

    @cached_property
    def _input_magnitudes(self) -> Array:
        """Largest absolute values of the inputs, ``(q,)``."""
        magnitudes = np.zeros(self.adjoint.B.shape[1])
        magnitudes[: self.drives.shape[0]] = np.abs(self.drives).max(axis=1, initial=0.0)
        if self.disturbances is not None:
            magnitudes[self.disturbances.inputs] = self.disturbances.bound.reach(
                np.eye(self.disturbances.bound.dimension)
            )
        return magnitudes

    @cached_property
    def _curvature_bounds(self) -> Array:
        """Bounds ``(N,)`` of the curvature of the row on every step: times an eighth of the square of a cell's width
        they bound its excess over the chord."""
        state_bounds, first_bounds, second_bounds = self.adjoint.derivative_bounds
        magnitudes = self._input_magnitudes.copy()
        curvature = state_bounds @ self._state_magnitudes
        if self.disturbances is not None and self.disturbances.changes is None:
            # the slope of an integral that is a support
            curvature = curvature + first_bounds[:, self.disturbances.inputs] @ magnitudes[self.disturbances.inputs]
            magnitudes[self.disturbances.inputs] = 0.0
        # of inputs on pieces: the change of l' A B from one end of a piece to the other, summed, and that at the last
        total = self.adjoint.step * (second_bounds @ magnitudes).sum() + (first_bounds @ magnitudes).max(initial=0.0)
        return np.asarray(curvature + total)

    def enclosed(self, lower: Array, upper: Array) -> Array:
        """Upper bounds ``(k,)`` on cells of times ``(k,)``, each between two `cuts`; but for `error_bound` they are
        proven."""
        ends, indices = np.unique(np.concatenate([lower, upper]), return_inverse=True)
        count, middles = lower.size, (lower + upper) / 2
        if self.control_terms is None:
            high = self.at(ends)[1][indices]
        else:
            high = self.at(np.concatenate([lower, upper]), np.tile(middles, 2))[1]
        first, last = (
            np.clip((at / self.adjoint.step).astype(int), 0, self._curvature_bounds.size - 1) for at in (lower, upper)
        )
        curvature = np.maximum(self._curvature_bounds[first], self._curvature_bounds[last])
        curvature = np.maximum(
            curvature,
            self._curvature_bounds[
                np.clip((middles / self.adjoint.step).astype(int), 0, self._curvature_bounds.size - 1)
            ],
        )
        return np.asarray(
            np.maximum(high[:count], high[count:]) + (upper - lower) ** 2 / 8 * curvature + self.error_bound
        )

    def witness(self, time: float) -> tuple[Array, Array, Array | None]:
        """The deviation ``(d,)`` of the initial state that is worst at a time, and a disturbance ``(mw, M)`` between
        times ``(M + 1,)``, ``None`` where there is none."""
        row = self.adjoint.rows(np.array([time]))[0]
        state = (
            np.zeros(row.size)
            if self.initial_deviations is None
            else within(self.initial_deviations, self.initial_deviations.support_point(row))
        )
        if self.disturbances is None:
            return state, self.grid[[0, -1]], None
        bound, columns = self.disturbances.bound, self.disturbances.inputs
        changes = self._find_switches(time) if self.disturbances.changes is None else self.disturbances.changes
        gains = np.stack([self._integrate_between(np.array([time]), a, b)[0, columns] for a, b in pairwise(changes)])
        values = np.where(
            np.abs(gains).max(axis=1)[:, None] > 0.0, within(bound, bound.support_point(gains)), bound.interior_point()
        )
        if self.disturbances.changes is None:
            is_change = np.concatenate([[True], (np.diff(values, axis=0) != 0).any(axis=1)])
            changes, values = np.append(changes[:-1][is_change], changes[-1]), values[is_change]
        return state, changes, values.T

    def evaluate(self, time: float, deviation: Array, changes: Array, disturbance: Array | None) -> float:
        """The value of the row at a time from the centre and one deviation, and under one disturbance, as of `witness`,
        but for rounding, and with the control of the piece that begins last where it jumps."""
        times = np.array([time])
        deterministic = replace(self, centre=self.centre + deviation, initial_deviations=None, disturbances=None)
        value = float(deterministic.at(times)[0][0])
        if self.disturbances is not None and disturbance is not None:
            columns, ends = self.disturbances.inputs, np.minimum(changes, time)
            gains = -np.diff(self.adjoint.integrals(time - ends)[:, columns], axis=0)
            value += float((gains * disturbance.T).sum())
        return value

    def _find_switches(self, time: float) -> Array:
        """Times between which one value of a measurable disturbance is best for the row at ``time``: the ends of the
        steps before it, and where the best value changes within one."""
        assert self.disturbances is not None
        bound, columns = self.disturbances.bound, self.disturbances.inputs
        ends = np.append(np.arange(0.0, time, self.adjoint.step), time)
        start, stop = ends[:-1], ends[1:]

        def best(times: Array) -> Array:
            steps, shares = self.adjoint.placed(times)
            powers = shares[:, None] ** np.arange(ORDER + 1)
            return bound.support_point(np.einsum("kjq,kj->kq", self.adjoint.coefficients[steps][:, :, columns], powers))

        left_values, right_values = best(start), best(stop)
        for _ in range(HALVED):
            is_switch = np.asarray(left_values != right_values).any(axis=1)
            start, stop, left_values, right_values = (
                start[is_switch],
                stop[is_switch],
                left_values[is_switch],
                right_values[is_switch],
            )
            middle = (start + stop) / 2
            centre = best(middle)
            is_lower = (centre != left_values).any(axis=1)
            is_double = is_lower & (centre != right_values).any(axis=1) & (start.size < MAX_SWITCHES)
            start, stop, left_values, right_values = (
                np.concatenate([np.where(is_lower, start, middle), middle[is_double]]),
                np.concatenate([np.where(is_lower, middle, stop), stop[is_double]]),
                np.concatenate([np.where(is_lower[:, None], left_values, centre), centre[is_double]]),
                np.concatenate([np.where(is_lower[:, None], centre, right_values), right_values[is_double]]),
            )
        points = np.unique(np.concatenate([ends, (start + stop) / 2]))
        forward = tidy(np.maximum(time - points[::-1], 0.0), float(self.grid[-1]))
        return np.unique(np.append(forward, self.grid[-1]))
