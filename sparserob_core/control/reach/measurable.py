"""Support of the reachable set when the disturbance may be any measurable function with values in a set.

``sigma(t) = int_0^t h_W(E' e^{A' s} c) ds``: the integral and the maximum commute (Aumann 1965). Of systems that take
turns it is that of the one that acts, from where it begins to act, and ``sigma`` at that time of the row ``e^{A' s} c``
that the way from there to ``t`` makes of ``c``: the support function of a set of states in which its turn begins.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np

from sparserob_core.control.enclosures.cache import remember
from sparserob_core.control.enclosures.comparison import block_norms, product
from sparserob_core.control.enclosures.flows import Leaps, products
from sparserob_core.control.enclosures.matrix_exponential import rounding
from sparserob_core.control.enclosures.taylor import Combination
from sparserob_core.control.reach.disturbance_support import Carried, carried
from sparserob_core.control.reach.support import InitialSupport, KnownCellSupport, Support, over_directions
from sparserob_core.control.reach.varying_motion import (
    SpreadMotion,
    VaryingMotion,
)
from sparserob_core.control.response.lifted import LiftedSystem
from sparserob_core.control.response.response import Response, TimeGrid, unique_rows
from sparserob_core.control.sets.integrals import HALVINGS, enclosed, integrated
from sparserob_core.shapes import Float, Int, shaped
from sparserob_core.sip.convex_set import Array, Box, ConvexSet

LEGENDRE = np.polynomial.legendre.Legendre.basis(5)
# Gauss-Lobatto: the ends are nodes, so that no kink hides beside them
NODES = np.concatenate([[-1.0], LEGENDRE.deriv().roots().real, [1.0]])
WEIGHTS = 1.0 / (15.0 * LEGENDRE(NODES) ** 2)
ACCURACY = 1e-14  # of an integral over one interval, relative to the largest integrand times the horizon
MISSED = 1e-12  # of a support function of a curved set, the error of its quadrature that a proof allows for: estimated
ORDER = 12  # of the expansion that encloses a row; what is left of it on a short interval is 1e-14 of the row
SHORT = 0.5  # time times speed that such an interval takes: twice as much leaves 1e-10, half as much doubles the work
TINY = float(np.finfo(float).tiny)
TABLES_KEPT = 4096  # directions and parameters whose integrals are remembered
MOST_SHORT = 4096  # intervals that one is cut into before any is halved
# numbers of polynomials, or of remembered lengths, that are made at once, or of kernels that are remembered (32 MB)
AT_ONCE = 4_000_000
KEPT = 8  # tables of lengths at sampled times, one for each constraint
# Points of a piece at which an integral is guessed where a direction is only to be found (`roughly`): it is missed by
# 2e-5 to 1e-4 of the largest. With a quarter of them by twenty times as much; with twice as many a climb takes twice as
# long.
GUESSED = 8


@dataclass(frozen=True, eq=False)
class _Table:
    """What is known of one direction between the times ``starts (n + 1,)``: the integral up to each of them, or its
    lower and upper bound, ``sums (n + 1, c)``, and of what follows it ``rows (n + 1, d)``, or polynomials with ``terms
    (n, ORDER + 1, mw)``, what is ``lost (n,)`` by them, and what an integral may be off by, as a goal (``accuracy``)
    and by the rounding of a time (``late``)."""

    starts: Array
    sums: Array
    rows: Array = field(default_factory=lambda: np.zeros((0, 0)))
    terms: Array = field(default_factory=lambda: np.zeros((0, 0, 0)))
    lost: Array = field(default_factory=lambda: np.zeros(0))
    accuracy: float = 0.0
    late: float = 0.0


@dataclass(frozen=True, eq=False)
class _Balanced:
    """``A (d, d)`` in ``units (d,)`` of the states in which it is small, powers of two: what is left of an expansion is
    bounded by its norm there, the ``speed``."""

    A: Array
    units: Array
    speed: float
    leaps: Leaps

    @staticmethod
    def of(A: Array) -> _Balanced:
        from scipy.linalg import matrix_balance

        balanced, (units, _) = matrix_balance(A, permute=False, separate=True)
        return _Balanced(balanced, units, float(np.linalg.norm(balanced, 2)), Leaps(balanced))

    @cached_property
    def fastest(self) -> float:
        """How fast rows move: not by the norm alone, which of a matrix far from normal is much larger than what its
        flow does."""
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
    _tables: dict[bytes, _Table] = field(default_factory=dict, repr=False)
    _balanced: dict[bytes, _Balanced] = field(default_factory=dict, repr=False)

    @shaped
    def __call__(
        self, times: Float[Array, " k"], directions: Float[Array, "k d"], parameters: Float[Array, "k nu"]
    ) -> Float[Array, " k"]:
        """``sigma (k,)`` at ``times (k,)``, ``directions (k, d)``, ``parameters (k, nu)``."""
        unique, which = np.unique(parameters, axis=0, return_inverse=True)
        result = np.empty(times.size)
        for position, parameter in enumerate(unique):
            here = np.flatnonzero(which.reshape(-1) == position)
            result[here] = self._at(times[here], directions[here], parameter, self.is_enclosed).mean(axis=1)
        return result

    @shaped
    def roughly(
        self, times: Float[Array, " k"], directions: Float[Array, "k d"], parameters: Float[Array, "k nu"]
    ) -> Float[Array, " k"]:
        """About ``sigma (k,)``, where directions are many and each is asked for once: of a known system that stays as
        it is by the midpoint rule, whose nodes all of them share."""
        if parameters.shape[1] or self.response.grid.mode is not None:
            return self(times, directions, parameters)
        starts, lengths, columns = self._nodes
        found, several = np.empty(times.size), max(1, AT_ONCE // (starts.size * columns.shape[2]))
        for first in range(0, times.size, several):
            part = slice(first, first + several)
            spent = np.clip(times[part, None] - starts, 0.0, lengths)
            found[part] = (spent * self.bound.support(np.tensordot(directions[part], columns, 1))).sum(axis=1)
        return found

    @cached_property
    def _nodes(self) -> tuple[Array, Array, Array]:
        """Where short intervals of ages begin ``(q,)``, their lengths ``(q,)``, and ``e^{As} E`` in the middle of each,
        ``(d, q, mw)``."""
        A, E = (part[0] for part in self.response.system.modes[0].matrices(np.zeros((1, 0)))[::2])
        ages = self.response.grid.breakpoints
        lengths = np.repeat(np.diff(ages) / GUESSED, GUESSED)
        starts = np.repeat(ages[:-1], GUESSED) + lengths * np.tile(np.arange(GUESSED), ages.size - 1)
        middles = np.broadcast_to(starts + lengths / 2, (A.shape[0], starts.size))
        return starts, lengths, _moved(A, np.eye(A.shape[0]), middles) @ E

    def over(
        self, rows: Array, leg: LiftedSystem | VaryingMotion | SpreadMotion, joined: Combination | None = None
    ) -> list[Support]:
        """What it adds to functionals ``rows (r, d)`` over cells of time, in parts that add up; with ``joined`` to that
        of a direction that is made of them."""
        assert isinstance(leg, LiftedSystem)
        return [over_directions(lambda every: MeasurableCellSupport(self, every, leg), rows, leg, joined)]

    def integrated_sizes(self, times: Array, directions: Array, parameters: Array) -> Array:
        """The numbers ``(k,)`` that are added up to integrals beside what enters by pieces: none."""
        return np.zeros(times.size)

    @property
    def is_enclosed(self) -> bool:
        """Whether `enclosed` is close: the set is flat, or its support function is known to be analytic."""
        return enclosed(self.bound)

    @shaped
    def enclosed(
        self, times: Float[Array, " k"], directions: Float[Array, "k d"], leg: int | None = None
    ) -> Float[Array, "k 2"]:
        """What ``sigma`` of a known system is at least and at most, ``(k, 2)``; ``times`` in a ``leg`` of systems that
        take turns, where one is given, are counted from where it begins."""
        bounds = self._at(times, directions, np.zeros(0), enclosed=True, leg=leg)
        lost = rounding(self.response.grid.pieces) * np.abs(bounds).max(axis=1, initial=0.0)
        return np.asarray(bounds + lost[:, None] * [-1.0, 1.0])

    @cached_property
    def _legs(self) -> list[TimeGrid]:
        """The pieces of every system that takes its turn, in times from where it begins."""
        grid = self.response.grid
        return [grid] if grid.mode is None else [grid.leg(number) for number in range(len(grid.turns))]

    @cached_property
    def _differing(self) -> np.ndarray | None:
        """The states ``(k,)`` by whose equations alone known systems that take turns differ, if no others depend on
        them, as of integrals in windows: rows without these see one system all along. ``None`` elsewhere."""
        system = self.response.system
        if self.response.grid.mode is None or system.parameter_count:
            return None
        every = [np.concatenate(one.matrices(np.zeros((1, 0)))[::2], axis=2)[0] for one in system.modes]
        A, differ = every[0][:, : system.states], np.ptp(every, axis=0).any(axis=1)
        return None if A[~differ][:, differ].any() else np.flatnonzero(differ)

    @shaped
    def _at(
        self,
        times: Float[Array, " k"],
        directions: Float[Array, "k d"],
        parameter: Float[Array, " nu"],
        enclosed: bool = False,
        leg: int | None = None,
    ) -> Float[Array, "k n"]:
        """The integrals, or with ``enclosed`` their lower and upper bounds, as columns: those of the last system from
        where it begins, and what each before it adds for the rows that the way from its end makes of the directions."""
        begins = np.array([one.elapsed for one in self._legs])
        total = np.zeros((times.size, 2 if enclosed else 1))
        if self._differing is not None and not directions[:, self._differing].any():
            A, E = (part[0] for part in self.response.system.modes[0].matrices(parameter[None])[::2])
            since, key = (0.0 if leg is None else begins[leg]), parameter.tobytes() + b"all" + bytes([enclosed])
            return total + self._until(A, E, self.response.grid.breakpoints, times + since, directions, key)
        if leg is None:
            legs = np.maximum(np.searchsorted(begins, times) - 1, 0)
            times = times - begins[legs]
        else:
            legs = np.full(times.size, leg)
        rows = directions
        for number in range(int(legs.max(initial=0)), -1, -1):
            A, E = (part[0] for part in self.response.system.modes[number].matrices(parameter[None])[::2])
            ages, length = self._legs[number].breakpoints, float(self._legs[number].breakpoints[-1])
            last, through = np.flatnonzero(legs == number), np.flatnonzero(legs > number)
            key = parameter.tobytes() + number.to_bytes(4) + bytes([enclosed])
            total[last] += self._until(A, E, ages, times[last], rows[last], key)
            if through.size:
                total[through] += self._through(A, E, length, rows[through], enclosed)
            if number:
                mine = np.flatnonzero(legs >= number)
                spent = np.where(legs[mine] == number, times[mine], length)
                rows = rows.copy()
                rows[mine] = _moved(A, rows[mine], spent[:, None])[:, 0]
        return total

    def _until(self, A: Array, E: Array, ages: Array, times: Array, directions: Array, key: bytes) -> Array:
        """What one system adds until ``times (k,)`` from where it begins, ``(k, 1)`` or ``(k, 2)``; integrals up to
        ``ages (L + 1,)`` are remembered, of the parameter and the system that the ``key`` names, which ends with
        whether they are enclosed."""
        if not times.size:
            return np.zeros((0, 1))
        unique, which = unique_rows(directions)
        tables = self._known(A, E, ages, unique, key)
        starts = tables[0].starts
        parts = np.clip(np.searchsorted(starts, times, side="right") - 1, 0, starts.size - 2)
        within = np.clip(times - starts[parts], 0.0, None)
        before, found = np.array([tables[one].sums[part] for one, part in zip(which, parts, strict=True)]), None
        if key[-1]:
            terms = np.array([tables[one].terms[part] for one, part in zip(which, parts, strict=True)])
            lost = np.array([tables[one].lost[part] for one, part in zip(which, parts, strict=True)])
            accuracy = np.array([table.accuracy for table in tables])[which]
            shares = within / np.diff(starts)[parts]
            terms = terms * (shares[:, None] ** np.arange(ORDER + 1))[..., None]
            late = np.where(times > 0.0, np.array([table.late for table in tables])[which], 0.0)
            found = integrated(self.bound, terms, within, accuracy) + (shares * lost + late)[:, None] * [-1.0, 1.0]
        else:
            rows = np.stack([tables[one].rows[part] for one, part in zip(which, parts, strict=True)])
            found = self._integrals(A, E, rows, within, which)[:, None]
        return np.asarray(before + found)

    def _through(self, A: Array, E: Array, length: float, directions: Array, enclosed: bool) -> Array:
        """What one system adds over all of its turn of this ``length`` for rows ``directions (k, d)`` at its end, which
        are others at every time: nothing is remembered of them."""
        if not enclosed:
            lengths, alone = np.full(len(directions), length), np.arange(len(directions))
            return self._integrals(A, E, directions, lengths, alone)[:, None]
        starts = self._short(A, np.array([0.0, length]))
        lengths, found = np.diff(starts), np.empty((len(directions), 2))
        several = max(1, AT_ONCE // (lengths.size * (ORDER + 1) * max(E.shape)))
        for first in range(0, len(directions), several):
            part = slice(first, first + several)
            terms, lost, tallest = self._expanded(A, E, directions[part], starts)
            accuracy = ACCURACY * np.maximum(tallest * length, TINY)
            every = np.tile(lengths, len(terms)), np.repeat(accuracy, lengths.size)
            bounds = integrated(self.bound, terms.reshape(-1, *terms.shape[2:]), *every)
            size = rounding(lengths.size) * np.abs(bounds).max(axis=1).reshape(lost.shape).sum(axis=1)
            lost = lost.sum(axis=1) * (1.0 + rounding(lengths.size)) + size
            late = rounding(8) * float(self.response.grid.breakpoints[-1]) * tallest
            found[part] = bounds.reshape(*lost.shape, -1, 2).sum(axis=1) + (lost + late)[:, None] * [-1.0, 1.0]
        return found

    def _known(self, A: Array, E: Array, ages: Array, directions: Array, key: bytes) -> list[_Table]:
        """What is remembered of each of ``directions (k, d)``."""
        keys = [direction.tobytes() + key for direction in directions]
        found = {one: self._tables[one] for one in keys if one in self._tables}
        new = np.array([number for number, one in enumerate(keys) if one not in found], dtype=int)
        make = self._enclosing if key[-1] else self._measuring
        for number, table in zip(new.tolist(), make(A, E, ages, directions[new]), strict=True):
            found[keys[number]] = remember(self._tables, keys[number], table, TABLES_KEPT)
        return [found[one] for one in keys]

    def _measuring(self, A: Array, E: Array, ages: Array, directions: Array) -> Iterator[_Table]:
        """By quadrature, from one of ``ages (L + 1,)`` to the next, of each of ``directions (k, d)``."""
        for direction in directions:
            rows = _moved(A, direction[None], ages[None])[0]
            lengths, alike = np.diff(ages), np.zeros(ages.size - 1, dtype=int)
            sums = np.append(0.0, np.cumsum(self._integrals(A, E, rows[:-1], lengths, alike)))
            yield _Table(ages, sums[:, None], rows=rows)

    def _enclosing(self, A: Array, E: Array, ages: Array, directions: Array) -> Iterator[_Table]:
        """Lower and upper bounds, from the end of one short interval to that of the next, of each of ``directions (k,
        d)``.

        On short intervals a row is a polynomial ``f`` with a rest. In Bernstein's form ``f`` is a convex combination of
        its coefficients ``b_k`` with weights of equal integrals, and ``h`` is convex; so the integral is at most the
        length times the mean of ``h(b_k)``, and at least that of ``w'b_k`` for any point ``w`` of the set. Both are
        equal where one corner of the set is best for all; an interval where another takes over is halved.
        """
        starts = self._short(A, ages)
        lengths, horizon = np.diff(starts), float(self.response.grid.breakpoints[-1])
        several = max(1, AT_ONCE // (lengths.size * (ORDER + 1) * max(E.shape)))
        for first in range(0, len(directions), several):
            terms, lost, tallest = self._expanded(A, E, directions[first : first + several], starts)
            accuracy = ACCURACY * np.maximum(tallest * horizon, TINY)
            every = np.tile(lengths, len(terms)), np.repeat(accuracy, lengths.size)
            bounds = integrated(self.bound, terms.reshape(-1, *terms.shape[2:]), *every).reshape(*lost.shape, 2)
            bounds = bounds + lost[..., None] * [-1.0, 1.0]
            late = rounding(8) * horizon * tallest
            for number, found in enumerate(bounds):
                sums = np.vstack([np.zeros(2), np.cumsum(found, axis=0)])
                own = float(accuracy[number]), float(late[number])
                yield _Table(starts, sums, terms=terms[number], lost=lost[number], accuracy=own[0], late=own[1])

    def _short(self, A: Array, ages: Array) -> Array:
        """The ends ``(n + 1,)`` of short intervals, as many between all neighbours of ``ages (L + 1,)``."""
        pieces = np.diff(ages)
        count = int(np.clip(np.ceil(self._in_balance(A).fastest * pieces.max() / SHORT), 1, MOST_SHORT))
        return np.append((ages[:-1, None] + np.outer(pieces, np.arange(count) / count)).ravel(), ages[-1])

    def _in_balance(self, A: Array) -> _Balanced:
        """What is remembered of the matrix of a system."""
        key = A.tobytes()
        return self._balanced.get(key) or remember(self._balanced, key, _Balanced.of(A), KEPT)

    def _expanded(self, A: Array, E: Array, directions: Array, starts: Array) -> tuple[Array, Array, Array]:
        """Of every row ``directions (k, d)`` on every interval between ``starts (n + 1,)``: polynomials ``(k, n,
        ORDER + 1, mw)`` in the share of it that has passed, what the integral over it may be off by with them, ``(k,
        n)``, and the largest integrand, ``(k,)``."""
        known = self._in_balance(A)
        A, units, speed, E = known.A, known.units, known.speed, E / known.units[:, None]
        lengths, far, count = np.tile(np.diff(starts), len(directions)), self.bound.radius_bound, len(directions)
        once, sized = known.products
        row = known.leaps.orbits(directions * units, starts[:-1])[0].swapaxes(0, 1).reshape(-1, A.shape[0])
        terms, sizes, size = [row @ E], np.abs(row) @ np.abs(E), np.abs(row)
        for order in range(1, ORDER + 1):
            step = (lengths / order)[:, None]
            row, size = step * np.asarray(row @ once), step * np.asarray(size @ sized)
            terms.append(row @ E)
            sizes = sizes + size @ np.abs(E)
        with np.errstate(over="ignore"):
            growth = np.exp(speed * lengths) * lengths / (ORDER + 1)
        operations = ORDER * (A.shape[0] + 4) + A.shape[0] + 4 * E.shape[1] + HALVINGS
        lost = far * (np.linalg.norm(np.asarray(row @ once), axis=1) * growth * np.linalg.norm(E, 2))
        lost = lengths * (lost + far * rounding(operations) * np.linalg.norm(sizes, axis=1)) * (1.0 + rounding(8))
        tallest = far * np.linalg.norm(sizes, axis=1).reshape(count, -1).max(axis=1, initial=0.0)
        return np.stack(terms, axis=1).reshape(count, -1, ORDER + 1, E.shape[1]), lost.reshape(count, -1), tallest

    @shaped
    def _integrals(
        self,
        A: Float[Array, "d d"],
        E: Float[Array, "d mw"],
        starts: Float[Array, "l d"],
        lengths: Float[Array, " l"],
        member: Int[np.ndarray, " l"],
    ) -> Float[Array, " l"]:
        """``int_0^length h(E' y(s)) ds`` from rows ``y(0) = starts (l, d)``: Gauss-Lobatto, halving what has not
        converged (kinks). ``member (l,)``: of which functional each is part, whose largest integrand sets the
        accuracy."""
        total = np.zeros(lengths.size)
        fastest = min(float(np.linalg.norm(A, 2)), 4.0 * float(np.abs(np.linalg.eigvals(A)).max()))
        count = int(np.clip(np.ceil(fastest * lengths.max(initial=0.0)), 1, MOST_SHORT))
        owner = np.repeat(np.arange(lengths.size), count)  # short intervals, on which the quadrature is at home
        offsets = np.outer(lengths, np.arange(count) / count)
        starts = _moved(A, starts, offsets).reshape(-1, A.shape[0])
        lengths = lengths[owner] / count
        whole, size = self._quadrature(A, E, starts, lengths)
        largest = np.zeros(int(member.max(initial=0)) + 1)
        np.maximum.at(largest, member[owner], size)
        accuracy = ACCURACY * np.maximum(largest[member] * float(self.response.grid.breakpoints[-1]), TINY)
        for _ in range(HALVINGS):
            middles = _moved(A, starts, lengths[:, None] / 2)[:, 0]
            left, right = (
                self._quadrature(A, E, starts, lengths / 2)[0],
                self._quadrature(A, E, middles, lengths / 2)[0],
            )
            open_ = np.abs(left + right - whole) > accuracy[owner]
            np.add.at(total, owner[~open_], (left + right)[~open_])
            starts, lengths = np.vstack([starts[open_], middles[open_]]), np.tile(lengths[open_] / 2, 2)
            whole, owner = np.concatenate([left[open_], right[open_]]), np.tile(owner[open_], 2)
            if not owner.size:
                return total
        np.add.at(total, owner, whole)
        return total

    @shaped
    def _quadrature(
        self, A: Float[Array, "d d"], W: Float[Array, "d mw"], starts: Float[Array, "l d"], lengths: Float[Array, " l"]
    ) -> tuple[Float[Array, " l"], Float[Array, " l"]]:
        values = self.bound.support(_moved(A, starts, lengths[:, None] * (NODES + 1) / 2) @ W)
        return (values * WEIGHTS).sum(axis=1) * lengths / 2, np.abs(values).max(axis=1, initial=0.0)


def _moved(A: Array, rows: Array, durations: Array) -> Array:
    """``c'e^{A r} (k, q, d)`` of ``rows (k, d)`` over ``durations (k, q)`` of their own."""
    every = np.repeat(rows, durations.shape[1], axis=0)
    return Leaps(A).rows(every, durations.ravel())[0].reshape(*durations.shape, -1)


@dataclass(frozen=True, eq=False)
class MeasurableCellSupport(KnownCellSupport):
    """The support function of measurable disturbances on functionals ``rows (r, d)`` of a *known* system, in the form
    of `DisturbanceSupport`; ``lifted`` is that system, or one of those that take turns.

    ``sigma`` is an integral with a Lipschitz integrand, so its second derivative is bounded by that of the integrand's
    argument. What earlier systems did is the support function of a set in which the turn of this one begins: it bends,
    and is rounded, no more than that of a box around this set.
    """

    support: MeasurableSupport
    rows: Array
    lifted: LiftedSystem

    @shaped
    def at(
        self, times: Float[Array, " k"], ends: Float[Array, "k r 0"]
    ) -> tuple[Float[Array, "k r 1"], Float[Array, "k r"]]:
        """The support function ``(k, r, 1)`` and how far it may be from that, ``(k, r)``; ``ends (k, r, 0)``."""
        every = self.repeated(times)
        if self.support.is_enclosed:
            return self.between(self.support.enclosed(*every, leg=self.lifted.turn))
        k, r = times.size, self.rows.shape[0]
        sigma = self.support(every[0] + self.lifted.grid.elapsed, every[1], np.zeros((k * r, 0))).reshape(k, r)
        return sigma[..., None], MISSED * np.abs(sigma)

    @shaped
    def deviation(self, start: Float[Array, " k"], widths: Float[Array, " k"]) -> Float[Array, "k r"]:
        """Bounds ``(k, r)`` of how far ``sigma`` is from its chord on ``[start, start + width]``: by the slope of
        ``h(E' e^{A' s} c)``, or by twice its integral, mode by mode."""
        bound, lifted, comparison = self.support.bound, self.lifted, self.lifted.comparison
        rows, W = self.rows @ lifted.transform, lifted.W[0]
        slopes = lifted.flown(np.broadcast_to(rows, (start.size, *rows.shape)), start)[0] @ lifted.A[0]  # (k, r, d)
        reach = comparison.over(widths)
        drive = np.broadcast_to(self._drive, (start.size, self._drive.size))
        square = (widths**2 / 8)[:, None]
        moved = product(block_norms(slopes, lifted.starts), reach.departure.on(drive)[..., None])[..., 0]
        exact = square * (bound.reach(slopes @ W) + moved)
        now = comparison.over(start).flow.on(drive)
        by_mode = np.minimum(
            square * product(reach.peak.on(now), comparison.sizes.T),
            2.0 * reach.integral.on(now),
        )
        found = np.minimum(exact, product(block_norms(rows, lifted.starts), by_mode.T).T)
        return np.asarray(found if self._earlier is None else found + self._earlier.deviation(start, widths))

    @cached_property
    def neglected(self) -> Array:
        """What rounding may change of ``e^{A' s} c``, times the disturbance, at most, ``(r, L)``."""
        found = self._rounded(self.rows @ self.lifted.transform)
        return found if self._earlier is None else found + self._earlier.neglected

    def _rounded(self, rows: Array) -> Array:
        """The same of ``rows (r, d)`` in the coordinates of the lifted system, without what was before its turn."""
        lifted = self.lifted
        _, remainder = lifted.row_bounds(rows)
        pushed = np.cumsum((remainder @ self._drive)[:, lifted.span] * lifted.fine.lengths, axis=1)
        return np.asarray(pushed[:, lifted.ends[1:] - 1])

    @cached_property
    def reached(self) -> Array:
        """As in `DisturbanceSupport`, ``(L, q)``."""
        reach = self.lifted.comparison.over(self.lifted.grid.breakpoints[1:])
        found = reach.integral.on(np.broadcast_to(self._drive, (self.lifted.grid.pieces, self._drive.size)))
        return found if self._earlier is None else found + self._earlier.reached

    @cached_property
    def _earlier(self) -> InitialSupport | None:
        """What disturbances made of the state before the turn of this system begins, as a box of states around it; of
        the first ``None``."""
        past = self.lifted.past
        if past is None:
            return None
        known = past.carried.get(id(self.support))
        if not isinstance(known, Carried):
            axes = np.eye(past.lifted.states)
            ended = MeasurableCellSupport(self.support, self.rows, past.lifted)
            left_out = ended._rounded(axes)[:, -1]
            if ended._earlier is not None:
                left_out = left_out + replace(ended._earlier, rows=axes).neglected[:, -1]
            far = np.repeat(ended.reached[-1], np.diff(past.lifted.starts, append=past.lifted.states))
            around = Box(-far, far)
            known = carried(past, (self.support, around), axes[:, None], far[:, None], ended.reached[-1], left_out)
            past.carried.update({id(self.support): known, id(around): known})
        assert isinstance(known.of, tuple)
        _, around = known.of
        return InitialSupport(self.lifted, around, self.rows @ self.lifted.transform)

    @property
    def _drive(self) -> Array:
        norms = block_norms(np.linalg.norm(self.lifted.W[0], axis=1), self.lifted.starts)
        return np.asarray(self.support.bound.radius_bound * norms)
