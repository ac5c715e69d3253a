"""Support of the reachable set when the disturbance may be any measurable function with values in a set.

``sigma(t) = int_0^t h_W(E' e^{A' s} c) ds``: the integral and the maximum commute (Aumann 1965). In a switched system
the integral is that of the mode that acts at ``t``, from the beginning of its phase. Added is ``sigma`` at that
beginning, of the row ``e^{A' s} c`` to which the transition from there to ``t`` takes ``c``: the support function of
the set of states in which the phase begins.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np
from scipy.linalg import matrix_balance

from sparserob_core.control.enclosures.cache import remember
from sparserob_core.control.enclosures.comparison import block_norms, product
from sparserob_core.control.enclosures.flows import DoublingExponentials, products
from sparserob_core.control.reach.disturbance_support import PropagatedEffect, propagate_effect
from sparserob_core.control.reach.support import (
    NOT_PROVEN,
    InitialSupport,
    KnownCellSupport,
    Leg,
    Support,
    over_directions,
)
from sparserob_core.control.response.lifted import LiftedSystem
from sparserob_core.control.response.response import Response, unique_rows
from sparserob_core.control.response.time_grid import TimeGrid
from sparserob_core.control.sets.integrals import INTERVAL_HALVINGS, enclose_integrals
from sparserob_core.errors import NotEnclosable
from sparserob_core.shapes import Float, shaped
from sparserob_core.sip.convex_set import Array, Box, ConvexSet
from sparserob_core.sip.expressions.rounding import rounding
from sparserob_core.sip.expressions.taylor import Combination

ACCURACY = 1e-14  # of an integral over one interval, relative to the largest integrand times the horizon
ORDER = 12  # of the expansion that encloses a row; what is left of it on a short interval is 1e-14 of the row
SHORT = 0.5  # time times speed that such an interval takes: twice as much leaves 1e-10, half as much doubles the work
TINY = float(np.finfo(float).tiny)
TABLES_KEPT = 4096  # directions and parameters whose integrals are remembered
MAX_INTERVALS = 4096  # intervals that one is cut into before any is halved
# numbers of polynomials, or of remembered lengths, that are made at once, or of kernels that are remembered (32 MB)
AT_ONCE = 4_000_000
KEPT = 8  # tables of lengths at sampled times, one for each constraint
# Points of a piece at which an integral is guessed where a direction is only to be found (`roughly`): it is missed by
# 2e-5 to 1e-4 of the largest. With a quarter of them by twenty times as much; with twice as many a climb takes twice as
# long.
GUESSED = 8


@dataclass(frozen=True, eq=False)
class _IntegralTable:
    """Integrals along one direction, between the times ``starts (n + 1,)``.

    ``sums (n + 1, 2)`` are lower and upper bounds of the integrals up to each time. For the interval after each time
    there are polynomials with ``terms (n, ORDER + 1, mw)`` and error bounds ``error_bounds (n,)``. ``accuracy`` is the
    goal for the error of an integral, and ``late`` the error from the rounding of a time.
    """

    starts: Array
    sums: Array
    terms: Array
    error_bounds: Array
    accuracy: float
    late: float


@dataclass(frozen=True, eq=False)
class _BalancedMatrix:
    """A matrix ``A (d, d)`` in ``units (d,)`` of the states in which it is small, powers of two.

    The remainder of an expansion is bounded by the norm of ``A`` in these units, the ``speed``.
    """

    A: Array
    units: Array
    speed: float
    exponentials: DoublingExponentials

    @staticmethod
    def of(A: Array) -> _BalancedMatrix:
        balanced, (units, _) = matrix_balance(A, permute=False, separate=True)
        return _BalancedMatrix(balanced, units, float(np.linalg.norm(balanced, 2)), DoublingExponentials(balanced))

    @cached_property
    def fastest(self) -> float:
        """Estimate of how fast rows move: four times the largest absolute eigenvalue, kept between ``speed / 16`` and
        ``speed``.

        The norm alone would not do, since that of a matrix far from normal is much larger than the growth of its flow.
        """
        return min(self.speed, max(4.0 * float(np.abs(np.linalg.eigvals(self.A)).max()), self.speed / 16.0))

    @cached_property
    def products(self):  # type: ignore[no-untyped-def]  # arrays, or sparse ones of scipy
        """The matrix and that of its absolute values."""
        return products(self.A), products(np.abs(self.A))


@dataclass(frozen=True, eq=False)
class MeasurableSupport:
    """The support ``sigma`` for one set ``bound``; integrals up to the grid's breakpoints are remembered per direction
    and parameter, of the system that acts last."""

    response: Response
    bound: ConvexSet
    _tables: dict[bytes, _IntegralTable] = field(default_factory=dict, repr=False)
    _balanced_matrices: dict[bytes, _BalancedMatrix] = field(default_factory=dict, repr=False)

    @shaped
    def __call__(
        self, times: Float[Array, " k"], directions: Float[Array, "k d"], parameters: Float[Array, "k nu"]
    ) -> Float[Array, " k"]:
        """Return ``sigma (k,)`` at ``times (k,)``, ``directions (k, d)``, ``parameters (k, nu)``: the middle of its
        bounds."""
        unique, parameter_indices = np.unique(parameters, axis=0, return_inverse=True)
        result = np.empty(times.size)
        for position, parameter in enumerate(unique):
            members = np.flatnonzero(parameter_indices.reshape(-1) == position)
            result[members] = self._integrate_phases(times[members], directions[members], parameter).mean(axis=1)
        return result

    @shaped
    def roughly(
        self, times: Float[Array, " k"], directions: Float[Array, "k d"], parameters: Float[Array, "k nu"]
    ) -> Float[Array, " k"]:
        """Return an approximation of ``sigma (k,)``, for many directions each of which is asked for once.

        For a known system with one mode the approximation is the midpoint rule, whose nodes all directions share. For
        other systems the result is that of `__call__`.
        """
        if parameters.shape[1] or self.response.grid.mode is not None:
            return self(times, directions, parameters)
        starts, lengths, columns = self._midpoint_nodes
        values, chunk_size = np.empty(times.size), max(1, AT_ONCE // (starts.size * columns.shape[2]))
        for first in range(0, times.size, chunk_size):
            chunk = slice(first, first + chunk_size)
            durations = np.clip(times[chunk, None] - starts, 0.0, lengths)
            values[chunk] = (durations * self.bound.support(np.tensordot(directions[chunk], columns, 1))).sum(axis=1)
        return values

    @cached_property
    def _midpoint_nodes(self) -> tuple[Array, Array, Array]:
        """Beginnings ``(q,)`` and lengths ``(q,)`` of short intervals of ages, and ``e^{As} E`` in the middle of each,
        ``(d, q, mw)``."""
        A, E = (matrix[0] for matrix in self.response.system.modes[0].matrices(np.zeros((1, 0)))[::2])
        ages = self.response.grid.breakpoints
        lengths = np.repeat(np.diff(ages) / GUESSED, GUESSED)
        starts = np.repeat(ages[:-1], GUESSED) + lengths * np.tile(np.arange(GUESSED), ages.size - 1)
        middles = np.broadcast_to(starts + lengths / 2, (A.shape[0], starts.size))
        return starts, lengths, _propagate_rows(A, np.eye(A.shape[0]), middles) @ E

    def over(self, rows: Array, leg: Leg, joined: Combination | None = None) -> list[Support]:
        """Return the parts of the support of measurable disturbances on functionals over cells of time; the parts add
        up.

        Parameters
        ----------
        rows : Array
            Functionals ``(r, d)``.
        leg : LiftedSystem, VaryingMotion or SpreadMotion
            The system, or a phase of a switched system.
        joined : Combination, optional
            How the rows make up one direction that varies over a cell; without it each row is a functional.

        Returns
        -------
        list of Support
            The parts.

        Raises
        ------
        NotEnclosable
            Over a cell of parameters.
        """
        assert isinstance(leg, LiftedSystem)
        if leg.space.nu:
            raise NotEnclosable(NOT_PROVEN)
        return [over_directions(lambda functionals: MeasurableCellSupport(self, functionals, leg), rows, leg, joined)]

    def integrated_sizes(self, times: Array, directions: Array, parameters: Array) -> Array:
        """Return the sum ``(k,)`` of the integrals of absolute values that enter ``sigma`` at each time: 0 for this
        class."""
        return np.zeros(times.size)

    @shaped
    def enclosed(
        self, times: Float[Array, " k"], directions: Float[Array, "k d"], leg: int | None = None
    ) -> Float[Array, "k 2"]:
        """Return lower and upper bounds ``(k, 2)`` of ``sigma`` of a known system.

        With a phase ``leg`` of a switched system, ``times`` are counted from the beginning of that phase.
        """
        bounds = self._integrate_phases(times, directions, np.zeros(0), leg)
        rounding_errors = rounding(self.response.grid.pieces) * np.abs(bounds).max(axis=1, initial=0.0)
        return np.asarray(bounds + rounding_errors[:, None] * [-1.0, 1.0])

    @cached_property
    def _phase_grids(self) -> list[TimeGrid]:
        """The pieces of every phase of a switched system, in times from the beginning of the phase."""
        grid = self.response.grid
        return [grid] if grid.mode is None else [grid.leg(number) for number in range(len(grid.turns))]

    @cached_property
    def _differing_states(self) -> np.ndarray | None:
        """The states ``(k,)`` by whose equations alone the modes of a known switched system differ, if no other states
        depend on them, as with integrals in windows.

        Rows without these states see one system all along. ``None`` elsewhere.
        """
        system = self.response.system
        if self.response.grid.mode is None or system.parameter_count:
            return None
        matrices = [np.concatenate(mode.matrices(np.zeros((1, 0)))[::2], axis=2)[0] for mode in system.modes]
        A, is_different = matrices[0][:, : system.states], np.ptp(matrices, axis=0).any(axis=1)
        return None if A[~is_different][:, is_different].any() else np.flatnonzero(is_different)

    @shaped
    def _integrate_phases(
        self,
        times: Float[Array, " k"],
        directions: Float[Array, "k d"],
        parameter: Float[Array, " nu"],
        leg: int | None = None,
    ) -> Float[Array, "k 2"]:
        """Return lower and upper bounds ``(k, 2)`` of the integrals.

        The mode that acts last contributes from the beginning of its phase. Each phase before it contributes for the
        rows to which the transitions from its end take the directions.
        """
        begins = np.array([grid.elapsed for grid in self._phase_grids])
        total = np.zeros((times.size, 2))
        if self._differing_states is not None and not directions[:, self._differing_states].any():
            A, E = (matrix[0] for matrix in self.response.system.modes[0].matrices(parameter[None])[::2])
            since, key = (0.0 if leg is None else begins[leg]), parameter.tobytes() + b"all"
            return total + self._integrate_until(A, E, self.response.grid.breakpoints, times + since, directions, key)
        if leg is None:
            legs = np.maximum(np.searchsorted(begins, times) - 1, 0)
            times = times - begins[legs]
        else:
            legs = np.full(times.size, leg)
        rows = directions
        for number in range(int(legs.max(initial=0)), -1, -1):
            A, E = (matrix[0] for matrix in self.response.system.modes[number].matrices(parameter[None])[::2])
            ages, length = self._phase_grids[number].breakpoints, float(self._phase_grids[number].breakpoints[-1])
            last, through = np.flatnonzero(legs == number), np.flatnonzero(legs > number)
            key = parameter.tobytes() + number.to_bytes(4)
            total[last] += self._integrate_until(A, E, ages, times[last], rows[last], key)
            if through.size:
                tables = self._make_tables(A, E, np.array([0.0, length]), rows[through])  # different at every time
                total[through] += [table.sums[-1] + table.late * np.array([-1.0, 1.0]) for table in tables]
            if number:
                members = np.flatnonzero(legs >= number)
                durations = np.where(legs[members] == number, times[members], length)
                rows = rows.copy()
                rows[members] = _propagate_rows(A, rows[members], durations[:, None])[:, 0]
        return total

    def _integrate_until(self, A: Array, E: Array, ages: Array, times: Array, directions: Array, key: bytes) -> Array:
        """Return bounds ``(k, 2)`` of the contribution of one mode from the beginning of its phase until
        ``times (k,)``.

        Integrals up to ``ages (L + 1,)`` are remembered for the parameter and the mode that ``key`` names.
        """
        if not times.size:
            return np.zeros((0, 2))
        unique, table_indices = unique_rows(directions)
        tables = self._look_up_tables(A, E, ages, unique, key)
        starts = tables[0].starts
        intervals = np.clip(np.searchsorted(starts, times, side="right") - 1, 0, starts.size - 2)
        within = np.clip(times - starts[intervals], 0.0, None)
        before, terms, errors = (
            np.empty((times.size, *getattr(tables[0], name).shape[1:])) for name in ("sums", "terms", "error_bounds")
        )
        order = np.argsort(table_indices, kind="stable")
        for table, members in zip(tables, np.split(order, np.bincount(table_indices).cumsum()[:-1]), strict=True):
            places = intervals[members]
            before[members], terms[members] = table.sums[places], table.terms[places]
            errors[members] = table.error_bounds[places]
        accuracy, late = np.array([(table.accuracy, table.late) for table in tables])[table_indices].T
        shares = within / np.diff(starts)[intervals]
        terms = terms * (shares[:, None] ** np.arange(ORDER + 1))[..., None]
        errors = shares * errors + np.where(times > 0.0, late, 0.0)
        partial = enclose_integrals(self.bound, terms, within, accuracy) + errors[:, None] * [-1.0, 1.0]
        return np.asarray(before + partial)

    def _look_up_tables(self, A: Array, E: Array, ages: Array, directions: Array, key: bytes) -> list[_IntegralTable]:
        """Return the table of each of ``directions (k, d)``, made where none is remembered."""
        keys = [direction.tobytes() + key for direction in directions]
        tables = {table_key: self._tables[table_key] for table_key in keys if table_key in self._tables}
        missing = np.array([number for number, table_key in enumerate(keys) if table_key not in tables], dtype=int)
        for number, table in zip(missing.tolist(), self._make_tables(A, E, ages, directions[missing]), strict=True):
            tables[keys[number]] = remember(self._tables, keys[number], table, TABLES_KEPT)
        return [tables[table_key] for table_key in keys]

    def _make_tables(self, A: Array, E: Array, ages: Array, directions: Array) -> Iterator[_IntegralTable]:
        """Yield the table of each of ``directions (k, d)``, with lower and upper bounds at the ends of short intervals.

        On short intervals a row is a polynomial ``f`` with a remainder. In Bernstein's form ``f`` is a convex
        combination of its coefficients ``b_k`` with weights of equal integrals, and ``h`` is convex. So the integral is
        at most the length times the mean of ``h(b_k)``, and at least that of ``w'b_k`` for any point ``w`` of the set.
        Both are equal where one corner of the set is best for all; an interval where another takes over is halved.
        """
        starts = self._divide_intervals(A, ages)
        lengths, horizon = np.diff(starts), float(self.response.grid.breakpoints[-1])
        chunk_size = max(1, AT_ONCE // (lengths.size * (ORDER + 1) * max(E.shape)))
        for first in range(0, len(directions), chunk_size):
            terms, errors, tallest = self._expand_rows(A, E, directions[first : first + chunk_size], starts)
            accuracy = ACCURACY * np.maximum(tallest * float(ages[-1]), TINY)
            intervals = np.tile(lengths, len(terms)), np.repeat(accuracy, lengths.size)
            bounds = enclose_integrals(self.bound, terms.reshape(-1, *terms.shape[2:]), *intervals).reshape(
                *errors.shape, 2
            )
            bounds = bounds + errors[..., None] * [-1.0, 1.0]
            late = rounding(8) * horizon * tallest
            for number, interval_bounds in enumerate(bounds):
                sizes = rounding(starts.size) * np.cumsum(np.abs(interval_bounds).max(axis=1))[:, None]
                sums = np.vstack([np.zeros(2), np.cumsum(interval_bounds, axis=0) + sizes * [-1.0, 1.0]])
                own = float(accuracy[number]), float(late[number])
                yield _IntegralTable(starts, sums, terms[number], errors[number], *own)

    def _divide_intervals(self, A: Array, ages: Array) -> Array:
        """The ends ``(n + 1,)`` of short intervals, as many between all neighbours of ``ages (L + 1,)``."""
        pieces = np.diff(ages)
        count = int(np.clip(np.ceil(self._balance_matrix(A).fastest * pieces.max() / SHORT), 1, MAX_INTERVALS))
        return np.append((ages[:-1, None] + np.outer(pieces, np.arange(count) / count)).ravel(), ages[-1])

    def _balance_matrix(self, A: Array) -> _BalancedMatrix:
        """Return the balanced form of the matrix ``A (d, d)`` of a system; the last ones are remembered."""
        key = A.tobytes()
        return self._balanced_matrices.get(key) or remember(self._balanced_matrices, key, _BalancedMatrix.of(A), KEPT)

    def _expand_rows(self, A: Array, E: Array, directions: Array, starts: Array) -> tuple[Array, Array, Array]:
        """Return polynomials of every row on every interval, with error bounds.

        Parameters
        ----------
        A, E : Array
            Matrices ``(d, d)`` and ``(d, mw)`` of the system.
        directions : Array
            Rows ``(k, d)``.
        starts : Array
            Ends ``(n + 1,)`` of the intervals.

        Returns
        -------
        Array, Array, Array
            Polynomials ``(k, n, ORDER + 1, mw)`` in the share of the interval that has passed; bounds ``(k, n)`` of the
            error of the integral over the interval with them; and bounds ``(k,)`` of the integrand of the polynomials.
        """
        balanced = self._balance_matrix(A)
        A, units, speed, E = balanced.A, balanced.units, balanced.speed, E / balanced.units[:, None]
        lengths, radius, count = np.tile(np.diff(starts), len(directions)), self.bound.radius_bound, len(directions)
        matrix, absolute_matrix = balanced.products
        row = balanced.exponentials.orbits(directions * units, starts[:-1])[0].swapaxes(0, 1).reshape(-1, A.shape[0])
        terms, sizes, size = [row @ E], np.abs(row) @ np.abs(E), np.abs(row)
        for order in range(1, ORDER + 1):
            step = (lengths / order)[:, None]
            row, size = step * np.asarray(row @ matrix), step * np.asarray(size @ absolute_matrix)
            terms.append(row @ E)
            sizes = sizes + size @ np.abs(E)
        with np.errstate(over="ignore"):
            growth = np.exp(speed * lengths) * lengths / (ORDER + 1)
        operations = ORDER * (A.shape[0] + 4) + A.shape[0] + 4 * E.shape[1] + INTERVAL_HALVINGS
        errors = radius * (np.linalg.norm(np.asarray(row @ matrix), axis=1) * growth * np.linalg.norm(E, 2))
        errors = (
            lengths * (errors + radius * rounding(operations) * np.linalg.norm(sizes, axis=1)) * (1.0 + rounding(8))
        )
        tallest = radius * np.linalg.norm(sizes, axis=1).reshape(count, -1).max(axis=1, initial=0.0)
        return np.stack(terms, axis=1).reshape(count, -1, ORDER + 1, E.shape[1]), errors.reshape(count, -1), tallest


def _propagate_rows(A: Array, rows: Array, durations: Array) -> Array:
    """``c'e^{A r} (k, q, d)`` of ``rows (k, d)`` over ``durations (k, q)`` of their own."""
    repeated = np.repeat(rows, durations.shape[1], axis=0)
    return DoublingExponentials(A).rows(repeated, durations.ravel())[0].reshape(*durations.shape, -1)


def bound_chords(
    lifted: LiftedSystem, rows: Array, start: Array, widths: Array, drives: Array, reach: Callable[[Array], Array]
) -> Array:
    """Return bounds of the distance of ``int_0^t h(E' e^{A' s} c) ds`` from its chord on ``[start, start + width]``.

    They are the smaller of two: from the slope of ``h(E' e^{A' s} c)`` in ``s``, and mode by mode from that slope or
    twice the integral of ``h``.

    Parameters
    ----------
    lifted : LiftedSystem
        The known system.
    rows : Array
        Functionals ``c``, ``(r, d)``, in its coordinates.
    start, widths : Array
        Cells ``(k,)`` of time.
    drives : Array
        Norm bounds ``(k, q)`` of the rate at which ``E w`` drives every block of the coordinates.
    reach : Callable
        Bounds ``(k, r)`` of ``|v'E w|`` over all ``w``, from directions ``v (k, r, d)``.

    Returns
    -------
    Array
        The bounds ``(k, r)``.
    """
    comparison = lifted.comparison
    slopes = lifted.flown(np.broadcast_to(rows, (start.size, *rows.shape)), start)[0] @ lifted.A[0]  # (k, r, d)
    effect = comparison.over(widths)
    square = (widths**2 / 8)[:, None]
    change = product(block_norms(slopes, lifted.starts), effect.departure.on(drives)[..., None])[..., 0]
    exact = square * (reach(slopes) + change)
    current_drive = comparison.over(start).flow.on(drives)
    by_mode = np.minimum(
        square * product(effect.peak.on(current_drive), comparison.sizes.T),
        2.0 * effect.integral.on(current_drive),
    )
    return np.minimum(exact, product(block_norms(rows, lifted.starts), by_mode.T).T)


@dataclass(frozen=True, eq=False)
class MeasurableCellSupport(KnownCellSupport):
    """The support function of measurable disturbances on functionals ``rows (r, d)`` of a *known* system, in the form
    of `DisturbanceSupport`; ``lifted`` is that system, or a phase of a switched system.

    ``sigma`` is an integral with a Lipschitz integrand, so its second derivative is bounded by the slope of the
    integrand's argument. The effect of earlier phases is the support function of a set in which this phase begins. The
    bounds of its curvature and its rounding are those for a box around this set.
    """

    support: MeasurableSupport
    rows: Array
    lifted: LiftedSystem

    @shaped
    def at(
        self, times: Float[Array, " k"], ends: Float[Array, "k r 0"]
    ) -> tuple[Float[Array, "k r 1"], Float[Array, "k r"]]:
        """Return support values ``(k, r, 1)`` and their error bounds ``(k, r)``; ``ends (k, r, 0)`` is empty."""
        return self.between(self.support.enclosed(*self.repeated(times), leg=self.lifted.turn))

    @shaped
    def deviation(self, start: Float[Array, " k"], widths: Float[Array, " k"]) -> Float[Array, "k r"]:
        """Return bounds ``(k, r)`` of the height of ``sigma`` above its chord on ``[start, start + width]``."""
        lifted, W = self.lifted, self.lifted.W[0]
        bounds = bound_chords(
            lifted,
            self.rows @ lifted.transform,
            start,
            widths,
            np.broadcast_to(self._drive, (start.size, self._drive.size)),
            lambda slopes: self.support.bound.reach(slopes @ W),
        )
        return np.asarray(
            bounds if self._earlier_support is None else bounds + self._earlier_support.deviation(start, widths)
        )

    @cached_property
    def neglected(self) -> Array:
        """Bounds ``(r, L)`` of the rounding error of ``e^{A' s} c``, times the disturbance."""
        error_bounds = self._bound_rounding(self.rows @ self.lifted.transform)
        return error_bounds if self._earlier_support is None else error_bounds + self._earlier_support.neglected

    def _bound_rounding(self, rows: Array) -> Array:
        """Return `neglected` for ``rows (r, d)`` in the coordinates of the lifted system, without the effect of earlier
        phases."""
        lifted = self.lifted
        _, remainder = lifted.row_bounds(rows)
        errors = np.cumsum((remainder @ self._drive)[:, lifted.span] * lifted.fine.lengths, axis=1)
        return np.asarray(errors[:, lifted.ends[1:] - 1])

    @cached_property
    def effect_bounds(self) -> Array:
        """Norm bounds ``(L, q)`` of the effect of any disturbance on every block of the coordinates until the end of
        every piece."""
        reach = self.lifted.comparison.over(self.lifted.grid.breakpoints[1:])
        bounds = reach.integral.on(np.broadcast_to(self._drive, (self.lifted.grid.pieces, self._drive.size)))
        return bounds if self._earlier_support is None else bounds + self._earlier_support.effect_bounds

    @cached_property
    def _earlier_support(self) -> InitialSupport | None:
        """The effect of disturbances before this phase on the state, as the support of a box of states at its
        beginning; ``None`` in the first phase."""
        past = self.lifted.past
        if past is None:
            return None
        earlier_effect = past.effects.get(id(self.support))
        if not isinstance(earlier_effect, PropagatedEffect):
            axes = np.eye(past.lifted.states)
            earlier_support = MeasurableCellSupport(self.support, self.rows, past.lifted)
            rounding_errors = earlier_support._bound_rounding(axes)[:, -1]
            if earlier_support._earlier_support is not None:
                rounding_errors = (
                    rounding_errors + replace(earlier_support._earlier_support, rows=axes).neglected[:, -1]
                )
            radii = np.repeat(earlier_support.effect_bounds[-1], np.diff(past.lifted.starts, append=past.lifted.states))
            box = Box(-radii, radii)
            earlier_effect = propagate_effect(
                past,
                (self.support, box),
                axes[:, None],
                radii[:, None],
                earlier_support.effect_bounds[-1],
                rounding_errors,
            )
            past.effects.update({id(self.support): earlier_effect, id(box): earlier_effect})
        assert isinstance(earlier_effect.of, tuple)
        _, box = earlier_effect.of
        return InitialSupport(self.lifted, box, self.rows @ self.lifted.transform)

    @property
    def _drive(self) -> Array:
        norms = block_norms(np.linalg.norm(self.lifted.W[0], axis=1), self.lifted.starts)
        return np.asarray(self.support.bound.radius_bound * norms)
