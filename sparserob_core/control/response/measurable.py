"""Support of the reachable set when the disturbance may be any measurable function with values in a set.

``sigma(t) = int_0^t h_W(E' e^{A' s} c) ds``: the integral and the maximum commute (Aumann 1965). Of systems that take
turns it is that of the one that acts, from where it begins to act, and ``sigma`` at that time of the row ``e^{A' s} c``
that the way from there to ``t`` makes of ``c``: the support function of a set of states in which its turn begins.

Errors of execution are such disturbances: what is delivered of a control differs from the command by at most a share of
it, any function of time. What the worst of them adds to ``c'x(t)`` is ``sum_jk share_j |u_jk| int |c'e^{A(t-s)} B_j|
ds``, the integral over piece ``k`` up to ``t``: convex in the command, and 0 where that is 0.

Of a system that changes with time ``c'Phi(t, s) B_j(s)`` takes the place of ``c'e^{A(t-s)} B_j``. On every piece
between two marks ``Phi(end, s) B(s)`` is a polynomial but for a remainder (`Expansion.kernel`), and what the time after
it makes of its end is a row. In the time ``t`` each integrand obeys the equation of the state, so that the sum is
nowhere further above its chord than that says.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace
from functools import cache, cached_property
from itertools import product as every_choice
from math import comb
from typing import final

import numpy as np

from sparserob_core.control.enclosures.cache import remember
from sparserob_core.control.enclosures.comparison import block_norms, product
from sparserob_core.control.enclosures.flows import Leaps, products
from sparserob_core.control.enclosures.matrix_exponential import rounding
from sparserob_core.control.enclosures.polynomial import distinct_patterns
from sparserob_core.control.enclosures.taylor import Combination, TaylorSpace
from sparserob_core.control.problem.system import LinearSystem
from sparserob_core.control.response.disturbance import DisturbanceModel
from sparserob_core.control.response.disturbance_support import Carried, carried
from sparserob_core.control.response.initial_support import InitialSupport, Support
from sparserob_core.control.response.lifted import LiftedSystem
from sparserob_core.control.response.response import Response, TimeGrid, unique_rows
from sparserob_core.control.response.varying.expansion import Kernel
from sparserob_core.control.response.varying.spread import Parts
from sparserob_core.control.response.varying_motion import (
    OUTWARD,
    SpreadMotion,
    SpreadSupport,
    VaryingMotion,
    VaryingSupport,
)
from sparserob_core.control.sets.integrals import curved_integral, enclosed
from sparserob_core.control.sets.sets import Polytope
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
HALVINGS = 48  # of an interval across a kink of the integrand: what is left of it is below rounding
# numbers of polynomials, or of remembered lengths, that are made at once, or of kernels that are remembered (32 MB)
AT_ONCE = 4_000_000
KEPT = 8  # tables of lengths at sampled times, one for each constraint
UNIT = Box([-1.0], [1.0])
CUTS = 3  # at changes of a sign, before an interval is halved: a polynomial across a piece changes it once or twice
SECANTS = 10  # steps to where a sign changes; with half of them what is left of a part is halved some times
NEAR_END = 1e-9  # of an interval, from its ends: where a sign changes nearer to one, it is halved
STEP = 1e-6  # of the horizon, over which a slope is a difference: a tenth of it shows what integrals are rounded to
# Of the horizon: ages that differ by less are one where nothing is proven. Ten times as much would be seen in a
# violation of 1e-9, a tenth of it is below what the difference of two times rounds to.
ALIKE = 1e-14
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


def integrated(bound: ConvexSet, terms: Array, lengths: Array, accuracy: Array) -> Array:
    """Lower and upper bounds ``(l, 2)`` of the integrals of the support function of ``bound`` over intervals of
    ``lengths (l,)``, on which its argument is a polynomial with ``terms (l, p + 1, w)`` in the share of the
    interval that has passed; intervals across a kink are halved until their bounds are within ``accuracy (l,)``."""
    if bound.halfspaces() is None:
        return curved_integral(bound, terms, lengths, accuracy)
    total, owner = np.zeros((lengths.size, 2)), np.arange(lengths.size)
    order = terms.shape[1] - 1
    points = np.einsum("kj,ljw->lkw", bezier(order), terms)
    for turn in range(HALVINGS + 1):
        best = bound.support_point(points[:, order // 2])
        low = (points @ best[:, :, None])[..., 0].mean(axis=1) * lengths
        high = bound.support(points).mean(axis=1) * lengths
        open_ = (high - low > accuracy[owner]) & (turn < HALVINGS)
        np.add.at(total, owner[~open_], np.stack([low, high], axis=1)[~open_])
        points, owner = _halved(points[open_]), np.tile(owner[open_], 2)
        lengths = np.tile(lengths[open_] / 2, 2)
        if not owner.size:
            break
    return total


def absolute(terms: Array, accuracy: Array) -> Array:
    """Lower and upper bounds ``(l, 2)`` of the integrals over ``[0, 1]`` of absolute values of polynomials with ``terms
    (l, p + 1)``, as those of `integrated`, but cut where they change their signs: what is left of both parts is settled
    at once, where halves would be cut some twenty times. Wherever they are cut, the bounds hold."""
    total, owner = np.zeros((len(terms), 2)), np.arange(len(terms))
    order = terms.shape[1] - 1
    points, lengths = terms @ bezier(order).T, np.ones(len(terms))
    for turn in range(HALVINGS + 1):
        low, high = np.abs(points.mean(axis=1)) * lengths, np.abs(points).mean(axis=1) * lengths
        open_ = (high - low > accuracy[owner]) & (turn < HALVINGS)
        np.add.at(total, owner[~open_], np.stack([low, high], axis=1)[~open_])
        points, owner, lengths = points[open_], np.tile(owner[open_], 2), lengths[open_]
        if not owner.size:
            break
        at = _sign_changes(points) if turn < CUTS else np.full(len(points), 0.5)
        points, lengths = _cut(points, at), np.concatenate([lengths * at, lengths * (1.0 - at)])
    return total


def _sign_changes(points: Array) -> Array:
    """About where polynomials with Bernstein's coefficients ``points (l, p + 1)`` change their signs, ``(l,)``, by
    secants of which the older end counts half (Illinois); the middle where both ends have one sign."""
    order = points.shape[1] - 1
    weights, powers = np.array([comb(order, k) for k in range(order + 1)]) * points, np.arange(order + 1)
    a, b, fa, fb = np.zeros(len(points)), np.ones(len(points)), points[:, 0], points[:, -1]
    crossing, at = fa * fb < 0.0, np.full(len(points), 0.5)
    for _ in range(SECANTS):
        with np.errstate(divide="ignore", invalid="ignore"):
            found = b - fb * (b - a) / (fb - fa)
        at = np.where(crossing & (found > NEAR_END) & (found < 1.0 - NEAR_END), found, 0.5)
        value = (weights * at[:, None] ** powers * (1.0 - at[:, None]) ** powers[::-1]).sum(axis=1)
        turned = value * fb < 0.0
        a, fa = np.where(turned, b, a), np.where(turned, fb, fa / 2.0)
        b, fb = at, value
    return at


def _cut(points: Array, at: Array) -> Array:
    """Bernstein's coefficients ``(l, p + 1)`` on both sides of ``at (l,)``, the first parts first (de Casteljau)."""
    left, right, row, last = np.empty_like(points), np.empty_like(points), points, points.shape[1] - 1
    share, rest = at[:, None], 1.0 - at[:, None]
    for order in range(last + 1):
        left[:, order], right[:, last - order] = row[:, 0], row[:, -1]
        row = rest * row[:, :-1] + share * row[:, 1:]
    return np.concatenate([left, right])


@cache
def bezier(order: int) -> Array:
    """From powers on ``[0, 1]`` to the coefficients of Bernstein's form, ``(order + 1, order + 1)``."""
    return np.array([[comb(k, j) / comb(order, j) for j in range(order + 1)] for k in range(order + 1)])


def _halved(points: Array) -> Array:
    """Bernstein's coefficients ``(l, p + 1, w)`` on both halves of an interval, the first halves first: averages of
    neighbours (de Casteljau)."""
    left, right, row, last = np.empty_like(points), np.empty_like(points), points, points.shape[1] - 1
    for order in range(last + 1):
        left[:, order], right[:, last - order] = row[:, 0], row[:, -1]
        row = (row[:, :-1] + row[:, 1:]) / 2
    return np.concatenate([left, right])


def _moved(A: Array, rows: Array, durations: Array) -> Array:
    """``c'e^{A r} (k, q, d)`` of ``rows (k, d)`` over ``durations (k, q)`` of their own."""
    every = np.repeat(rows, durations.shape[1], axis=0)
    return Leaps(A).rows(every, durations.ravel())[0].reshape(*durations.shape, -1)


class KnownCellSupport:
    """A part of the uncertainty on functionals ``rows (r, d)`` of a *known* system, in the form of `Support`."""

    rows: Array

    @shaped
    def steepness(self, times: Float[Array, " k"]) -> Float[Array, "k r 0"]:
        """No parameters, no steepness: ``(k, r, 0)``."""
        return np.zeros((times.size, self.rows.shape[0], 0))

    def repeated(self, times: Array) -> tuple[Array, Array]:
        """Every time with every row: ``(k r,)``, ``(k r, d)``."""
        return np.repeat(times, self.rows.shape[0]), np.tile(self.rows, (times.size, 1))

    def between(self, bounds: Array) -> tuple[Array, Array]:
        """The middle ``(k, r, 1)`` of bounds ``(k r, 2)``, and how far they are from it, ``(k, r)``."""
        bounds = bounds.reshape(-1, self.rows.shape[0], 2)
        return bounds.mean(axis=2)[..., None], (bounds[..., 1] - bounds[..., 0]) / 2 * (1.0 + rounding(4))


@final
@dataclass(frozen=True, eq=False)
class DirectionsCellSupport:
    """A part of the uncertainty of a *known* system on one functional over a cell of directions ``c = rows[0] + sum_j
    eta_j rows[j]``, ``|eta_j| <= 1``, in the form of `Support`; ``made`` is what it is on given ``rows (r, d)``, and
    ``joined`` says which monomials there are.

    It is a support function, or a sum of such with factors that are not negative: sublinear in ``c``. So it is, one
    coordinate after another, at most what is linear in each between the corners. How far it leaves its chord in time is
    a mean of differences ``h(y(s)) - h(y(r))`` with ``y`` linear in ``c``, each at most the sum of those of the rows:
    so bounds of these, and of what is left out, add up.
    """

    made: Callable[[Array], Support]
    rows: Array
    leg: LiftedSystem | VaryingMotion
    joined: Combination

    @shaped
    def steepness(self, times: Float[Array, " k"]) -> Float[Array, "k 1 nu"]:
        """`Support.steepness`: what is added along a row, or against it, at most."""
        axes = self.rows[1:]
        # powers of two of one row are asked for again in every smaller cell
        sizes = np.exp2(np.frexp(np.abs(axes).max(axis=1, initial=0.0))[1])
        axes = axes / sizes[:, None]
        along, off = self._at(times, np.vstack([axes, -axes]))
        most = np.maximum(along + off, 0.0).reshape(times.size, 2, len(axes)).max(axis=1)
        return np.asarray((most * sizes * OUTWARD)[:, None])

    @shaped
    def at(
        self, times: Float[Array, " k"], ends: Float[Array, "k 1 nu"]
    ) -> tuple[Float[Array, "k 1 M"], Float[Array, "k 1"]]:
        """`Support.at`. What is lost in the middle of the cell is a part of the excess, since smaller cells lose
        less."""
        coefficients, excess = np.zeros((times.size, 1, self.joined.space.size)), np.zeros((times.size, 1))
        patterns, which = distinct_patterns(ends)
        for position, pattern in enumerate(patterns):
            here = np.flatnonzero(which[:, 0] == position)
            corners = _corners(pattern)
            along, off = self._at(times[here], self.rows[0] + np.vstack([pattern, corners]) @ self.rows[1:])
            found, beyond = between_corners(self.joined.space, pattern, along[:, 1:])
            lost = np.maximum(along[:, 1:].mean(axis=1) - along[:, 0], 0.0)
            size = rounding(len(corners) + 4) * np.abs(along).max(axis=1)
            found[:, 0] -= lost
            coefficients[here, 0] = found
            excess[here, 0] = (off[:, 1:].max(axis=1) + beyond + lost + size) * OUTWARD
        return coefficients, excess

    @shaped
    def deviation(self, start: Float[Array, " k"], widths: Float[Array, " k"]) -> Float[Array, "k r"]:
        """`Support.deviation` of every row."""
        return self._each.deviation(start, widths)

    @cached_property
    def neglected(self) -> Array:
        """`Support.neglected` of every row, with what rounding makes of the corners, ``(r, L)``."""
        sizes = block_norms(np.abs(self.rows) @ np.abs(self.leg.transform), self.leg.starts)
        return np.asarray(self._each.neglected + rounding(len(self.rows)) * product(sizes, self.reached.T))

    @cached_property
    def reached(self) -> Array:
        """`Support.reached`."""
        return self._each.reached

    @cached_property
    def _each(self) -> Support:
        return self.made(self.rows)

    def _at(self, times: Array, rows: Array) -> tuple[Array, Array]:
        """What is added along ``rows (r, d)``, and how far it may be from that, ``(k, r)`` each."""
        found, off = self.made(rows).at(times, np.zeros((times.size, len(rows), 0)))
        return found[..., 0], off


def over_directions(
    made: Callable[[Array], Support], rows: Array, leg: LiftedSystem | VaryingMotion, joined: Combination | None
) -> Support:
    """What is ``made`` of functionals ``rows (r, d)``, or of the direction that they make where they are ``joined``."""
    return made(rows) if joined is None else DirectionsCellSupport(made, rows, leg, joined)


def _corners(pattern: Array) -> Array:
    """The corners ``(n, nu)`` of the face of ``[-1, 1]^nu`` on which the coordinates with an end in ``pattern (nu,)``
    are at it."""
    free = np.flatnonzero(pattern == 0.0)
    signs = np.array(list(every_choice((-1.0, 1.0), repeat=free.size)))
    corners = np.tile(pattern, (len(signs), 1))
    corners[:, free] = signs
    return corners


def between_corners(space: TaylorSpace, pattern: Array, values: Array) -> tuple[Array, Array]:
    """What is linear in every coordinate between ``values (q, n)`` at the `_corners` of a face: coefficients ``(q,
    M)``, and how far it may be above these, ``(q,)``: of products that the space has not, and by rounding."""
    corners, free = _corners(pattern), np.flatnonzero(pattern == 0.0)
    coefficients = np.zeros((len(values), space.size))
    beyond = len(corners) * rounding(2 * len(corners) + 8) * np.abs(values).max(axis=1)
    for chosen in every_choice((0, 1), repeat=free.size):
        found = values @ corners[:, free[np.flatnonzero(chosen)]].prod(axis=1) / len(corners)
        exponents = np.zeros(space.nu, dtype=int)
        exponents[free] = chosen
        place = space.index.get(tuple(exponents.tolist()))
        if place is None:  # of more coordinates than there are degrees
            beyond = beyond + np.abs(found)
        else:
            coefficients[:, place] = found
    return coefficients, beyond


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


@dataclass(frozen=True, eq=False)
class Execution:
    """The ``shares (m,)`` of the commanded control by which what is delivered may differ; ``breakpoints (K + 1,)`` are
    the command's, ``response`` is that of a known system. ``felt (d,)``: 0 of states that add up what is commanded,
    and do nothing else, 1 of others."""

    response: Response
    breakpoints: Array
    shares: Array
    felt: Array

    def followed(self) -> Execution:
        """The same along what the state is expanded in, where it is: of errors that are stated for the states."""
        return self

    def seen(self, directions: Array, parameters: Array) -> Array:
        """Directions ``(k, d)`` at parameters ``(k, nu)`` as those on the states that errors are followed in."""
        return directions

    def over(
        self,
        control: Array,
        rows: Array,
        leg: LiftedSystem | VaryingMotion | SpreadMotion,
        joined: Combination | None = None,
    ) -> Support:
        """What the worst errors of a ``control (m, K)`` add to functionals ``rows (r, d)`` over cells of time; with
        ``joined`` to that of a direction that is made of them."""
        assert isinstance(leg, LiftedSystem)
        return over_directions(lambda every: ExecutionCellSupport(self, control, every, leg), rows, leg, joined)

    def sampled(self, control: Array, times: Array, directions: Array) -> Array:
        """`added` at times and directions that are asked for again and again."""
        return self.added(control, times, directions)

    def none(self) -> Execution:
        """The same of a control that is delivered as it is commanded."""
        return replace(self, shares=np.zeros(self.shares.size))

    def given(self, times: Array, directions: Array) -> Array:
        """What errors of what was commanded before the first piece add to ``c'x(t)``, ``(k,)``: nothing."""
        return np.zeros(times.size)

    @property
    def size(self) -> int:
        """How many absolute values there are, one for every channel and piece."""
        return int(self.shares.size * (self.breakpoints.size - 1))

    @cached_property
    def matrices(self) -> tuple[Array, Array]:
        """``A (d, d)``, ``B (d, m)``."""
        A, B, _ = self.response.system.modes[0].matrices(np.zeros((1, 0)))
        return A[0], self.felt[:, None] * B[0][:, : self.shares.size]

    @cached_property
    def _supports(self) -> list[MeasurableSupport | None]:
        """``int_0^t |c'e^{A s} B_j| ds`` of every channel, ``None`` where it is delivered as it is commanded."""
        A, B = self.matrices
        unit, grid, start = Box([-1.0], [1.0]), self.response.grid, self.response.initial_state
        made = [Response(LinearSystem(A, B, B[:, [j]]), grid, start) for j in range(self.shares.size)]
        return [MeasurableSupport(one, unit) if s > 0.0 else None for one, s in zip(made, self.shares, strict=True)]

    @shaped
    def lengths(self, times: Float[Array, " k"], directions: Float[Array, "k d"]) -> Float[Array, "k n"]:
        """What a command of size 1 on every piece of every channel adds at most, ``(k, m K)``, channel by channel."""
        ages = np.clip(times[:, None] - self.breakpoints, 0.0, None)
        found = np.zeros((times.size, self.shares.size, self.breakpoints.size - 1))
        for j, integral in enumerate(self._integrals(ages, directions)):
            found[:, j] = self.shares[j] * np.maximum(integral[:, :-1] - integral[:, 1:], 0.0)
        return found.reshape(times.size, -1)

    @shaped
    def added(
        self, control: Float[Array, "m K"], times: Float[Array, " k"], directions: Float[Array, "k d"]
    ) -> Float[Array, " k"]:
        """What the worst errors of a command add to ``c'x(t)``, ``(k,)``."""
        which, jumps = self.jumps(control)
        if not which.size:
            return np.zeros(times.size)
        ages = np.clip(times[:, None] - self.breakpoints[which], 0.0, None)
        every = zip(self._integrals(ages, directions), jumps, strict=True)
        return np.asarray(sum(integral @ change for integral, change in every))

    @shaped
    def slope(
        self, control: Float[Array, "m K"], times: Float[Array, " k"], directions: Float[Array, "k d"]
    ) -> Float[Array, " k"]:
        """The derivative ``(k,)`` of `added` in the time, from the left where that jumps."""
        (A, B), (which, jumps) = self.matrices, self.jumps(control)
        ages = times[:, None] - self.breakpoints[which]
        at = _moved(A, directions, ages) @ B
        return np.asarray(np.einsum("kqm,mq,kq->k", np.abs(at), jumps, ages > 0.0))

    @shaped
    def jumps(self, control: Float[Array, "m K"]) -> tuple[np.ndarray, Float[Array, "m q"]]:
        """The pieces ``(q,)`` with which the size of the largest error changes, and by how much, ``(m, q)``: by parts,
        ``sum_k r_k int_k = sum_k (r_k - r_{k-1}) int_{t_k}^t``, of which a sparse control needs few."""
        jumps = np.diff(self.shares[:, None] * np.abs(control), axis=1, prepend=0.0)
        which = np.flatnonzero(jumps.any(axis=0))
        return which, jumps[:, which]

    def _integrals(self, ages: Array, directions: Array) -> list[Array]:
        """``int_0^age |c'e^{A s} B_j| ds`` for ages ``(k, q)`` of directions ``(k, d)``, of every channel; of ages that
        are alike once."""
        alike = ALIKE * float(self.breakpoints[-1])
        c, owner = unique_rows(directions)
        keys = np.stack([np.repeat(owner.reshape(-1), ages.shape[1]), np.rint(ages.ravel() / alike)])
        (who, _), first, which = np.unique(keys, axis=1, return_index=True, return_inverse=True)
        times, rows = ages.ravel()[first], c[who.astype(int)]
        none = np.zeros((times.size, 0))
        return [
            np.zeros(ages.shape) if one is None else one(times, rows, none)[which.reshape(-1)].reshape(ages.shape)
            for one in self._supports
        ]

    @shaped
    def enclosed(
        self, control: Float[Array, "m K"], times: Float[Array, " k"], directions: Float[Array, "k d"]
    ) -> Float[Array, "k 2"]:
        """What `added` is at least and at most, ``(k, 2)``."""
        which, jumps = self.jumps(control)
        total, size = np.zeros((times.size, 2)), np.zeros(times.size)
        ages = np.clip(times[:, None] - self.breakpoints[which], 0.0, None).ravel()
        # a difference of times is rounded, and an integral grows with its length
        last, rows = float(self.breakpoints[-1]), np.repeat(directions, which.size, axis=0)
        around = np.nextafter(ages, 0.0), np.minimum(np.nextafter(ages, np.inf), last)
        for one, change in zip(self._supports, jumps, strict=True):
            if one is None or not change.any():
                continue
            low, high = (one.enclosed(at, rows)[:, side] for side, at in enumerate(around))
            ends = np.stack([low, high], axis=1).reshape(times.size, which.size, 2)
            total += np.einsum("kqe,q->ke", ends, np.maximum(change, 0.0))
            total += np.einsum("kqe,q->ke", ends[..., ::-1], np.minimum(change, 0.0))
            size += np.abs(ends).max(axis=2) @ np.abs(change)
        return np.asarray(total + (rounding(4 * which.size + 8) * size)[:, None] * [-1.0, 1.0])


@final
@dataclass(frozen=True, eq=False)
class ExecutionCellSupport(KnownCellSupport):
    """What errors of execution of a ``control (m, K)`` add to functionals ``rows (r, d)`` over cells of time, in the
    form of `MeasurableCellSupport`; ``lifted`` is the known system."""

    execution: Execution
    control: Array
    rows: Array
    lifted: LiftedSystem

    @shaped
    def at(
        self, times: Float[Array, " k"], ends: Float[Array, "k r 0"]
    ) -> tuple[Float[Array, "k r 1"], Float[Array, "k r"]]:
        """What is added ``(k, r, 1)`` and how far it may be from that, ``(k, r)``; ``ends (k, r, 0)``."""
        return self.between(self.execution.enclosed(self.control, *self.repeated(times)))

    @shaped
    def deviation(self, start: Float[Array, " k"], widths: Float[Array, " k"]) -> Float[Array, "k r"]:
        """Bounds ``(k, r)`` of how far it is from its chord on ``[start, start + width]``, each inside one piece: its
        slope is a sum of ``|c'e^{A s} B_j|`` at the ages of the jumps, of which each changes no faster than
        ``|c'e^{A s} A B_j|``."""
        which, jumps = self.execution.jumps(self.control)
        if not which.size:
            return np.zeros((start.size, self.rows.shape[0]))
        comparison, lifted = self.lifted.comparison, self.lifted
        ages = start[:, None] - self.execution.breakpoints[which]
        begun = ages + widths[:, None] > 0.0  # the others begin after the cell
        ages, width = np.where(begun, np.maximum(ages, 0.0), 0.0).ravel(), np.repeat(widths, which.size)
        rows, drive = self.rows @ lifted.transform, lifted.B[0][:, : jumps.shape[0]]
        slopes = lifted.flown(np.broadcast_to(rows, (ages.size, *rows.shape)), ages)[0] @ lifted.A[0]  # (k q, r, d)
        departure = comparison.over(width).departure
        bent = np.abs(slopes @ drive)  # (k q, r, m)
        norms = block_norms(slopes, lifted.starts)
        for j in range(drive.shape[1]):
            pushed = np.broadcast_to(block_norms(np.abs(drive[:, j]), lifted.starts), (width.size, norms.shape[2]))
            bent[..., j] += np.einsum("nrq,nq->nr", norms, departure.on(pushed))
        total = np.einsum("kqrj,jq,kq->kr", bent.reshape(start.size, which.size, *bent.shape[1:]), np.abs(jumps), begun)
        return np.asarray((widths**2 / 8)[:, None] * total * (1.0 + rounding(16 * (lifted.states + which.size))))

    @property
    def neglected(self) -> Array:
        """Nothing beside what `at` says, ``(r, L)``."""
        return np.zeros((self.rows.shape[0], self.lifted.grid.pieces))

    @property
    def reached(self) -> Array:
        """As in `DisturbanceSupport`, ``(L, q)``."""
        far = self.execution.shares * np.abs(self.control).max(axis=1)
        norms = block_norms(np.abs(self.lifted.B[0][:, : far.size]) @ far, self.lifted.starts)
        reach = self.lifted.comparison.over(self.lifted.grid.breakpoints[1:])
        return reach.integral.on(np.broadcast_to(norms, (self.lifted.grid.pieces, norms.size)))


@final
@dataclass(frozen=True, eq=False)
class VaryingExecution(Execution):
    """`Execution` of a system that changes with time; ``disturbing``: what is commanded enters through ``E``, all of
    it on every piece between ``breakpoints``, as the disturbances of a `VaryingMeasurable` do. ``bound``: a set of
    what enters by the columns ``through (m,)`` of ``E`` at once, in the place of channels of their own; there is one
    share of 1 then, and integrals are those of its support function."""

    disturbing: bool = False
    bound: ConvexSet | None = None
    through: np.ndarray | None = None
    _lengths: dict[bytes, Array] = field(default_factory=dict, repr=False)
    _ways: dict[bytes, tuple[Array, Kernel]] = field(default_factory=dict, repr=False)
    _reaching: dict[bytes, VaryingExecutionCellSupport] = field(default_factory=dict, repr=False)

    def none(self) -> VaryingExecution:
        """`Execution.none`; what is remembered is of these shares."""
        return replace(self, shares=np.zeros(self.shares.size), _lengths={}, _reaching={})

    def followed(self) -> VaryingExecution | SpreadExecution:
        """`Execution.followed`: the errors of all coefficients, which are followed as states are, on every part."""
        parts, every = self.response.propagator.parts, []
        if parts is None:
            return self
        for spread, of in self.response.propagator.spread:
            response = Response(of.system, of.grid, np.zeros(spread.states), shared=of)
            felt = np.tile(self.felt, spread.space.size)
            every.append(replace(self, response=response, felt=felt, _lengths={}, _ways={}, _reaching={}))
        return SpreadExecution(self.response, self.breakpoints, self.shares, self.felt, parts, tuple(every))

    def over(
        self,
        control: Array,
        rows: Array,
        leg: LiftedSystem | VaryingMotion | SpreadMotion,
        joined: Combination | None = None,
    ) -> Support:
        """`Execution.over`."""
        assert isinstance(leg, VaryingMotion)
        return over_directions(lambda every: VaryingExecutionCellSupport(self, control, every, leg), rows, leg, joined)

    def reaching(self, control: Array) -> VaryingExecutionCellSupport:
        """What errors of a control can have made of all coefficients, whatever the functional; remembered."""
        key = control.tobytes()
        if key not in self._reaching:
            found = VaryingExecutionCellSupport(self, control, np.zeros((0, self.motion.states)), self.motion)
            remember(self._reaching, key, found, KEPT)
        return self._reaching[key]

    @cached_property
    def motion(self) -> VaryingMotion:
        """That of the response."""
        return VaryingMotion(self.response.propagator, self.response.initial_state)

    @cached_property
    def columns(self) -> np.ndarray:
        """The columns of ``[B E]`` through which errors enter."""
        first = self.motion.expansion.channels[0] if self.disturbing else 0
        return first + (np.arange(self.far.size) if self.through is None else self.through)

    @cached_property
    def far(self) -> Array:
        """How far from 0 at most what enters by each column is, ``(m,)``, where the command is 1."""
        if self.bound is None:
            return self.shares
        box = self.bound.bounding_box()
        return np.asarray(np.maximum(np.abs(box.lower), np.abs(box.upper)) * OUTWARD)

    @cached_property
    def around(self) -> VaryingExecution:
        """The errors of the box around the set, where there is one."""
        if self.bound is None:
            return self
        return replace(self, shares=self.far, bound=None, _lengths={}, _reaching={})

    @cached_property
    def acting(self) -> np.ndarray:
        """What acts between marks, ``(L,)``: a piece of the command, after what did before the first of them where
        they act late (`acts`)."""
        grid = self.motion.grid
        if not self.disturbing:
            return np.asarray(grid.control_piece + self.late)
        middles = (grid.breakpoints[:-1] + grid.breakpoints[1:]) / 2
        return np.clip(np.searchsorted(self.breakpoints, middles) - 1, 0, self.breakpoints.size - 2)

    @property
    def late(self) -> int:
        """How much acts before the first piece of the command: 1, or 0 where that acts at once."""
        return int(self.motion.grid.before is not None and not self.disturbing)

    def acts(self, control: Array) -> Array:
        """The size of all that acts, ``(m, late + K)``, from a command ``(m, K)``."""
        size, before = np.abs(control), self.motion.grid.before
        return size if before is None or not self.late else np.column_stack([np.abs(before), size])

    @cached_property
    def kernel(self) -> Kernel:
        """Of the pieces between all marks."""
        marks = self.motion.grid.breakpoints
        return self.motion.expansion.kernel(marks[:-1], marks[1:])

    @shaped
    def lengths(self, times: Float[Array, " k"], directions: Float[Array, "k d"]) -> Float[Array, "k n"]:
        """`Execution.lengths`."""
        return np.asarray(self._of_each(times, directions)[:, :, self.late :].reshape(times.size, -1))

    @shaped
    def given(self, times: Float[Array, " k"], directions: Float[Array, "k d"]) -> Float[Array, " k"]:
        """`Execution.given`, where commands act late."""
        if not self.late:
            return np.zeros(times.size)
        return self.added(np.zeros((self.shares.size, self.breakpoints.size - 1)), times, directions)

    def _of_each(self, times: Array, directions: Array) -> Array:
        """What each size of 1 of all that acts adds, ``(k, m, late + K)``."""
        every = np.ones((self.shares.size, self.late + self.breakpoints.size - 1), dtype=bool)
        return np.asarray(self._over_pieces(times, directions, every).mean(axis=3))

    @shaped
    def added(
        self, control: Float[Array, "m K"], times: Float[Array, " k"], directions: Float[Array, "k d"]
    ) -> Float[Array, " k"]:
        """`Execution.added`."""
        return np.asarray(self._summed(control, times, directions).mean(axis=1))

    def sampled(self, control: Array, times: Array, directions: Array) -> Array:
        """`Execution.sampled`: where that is not too much, from the lengths, which are the same for every control."""
        if times.size * self.size > AT_ONCE:
            return self.added(control, times, directions)
        key = times.tobytes() + directions.tobytes()
        if key not in self._lengths:
            remember(self._lengths, key, self._of_each(times, directions).reshape(times.size, -1), KEPT)
        return np.asarray(self._lengths[key] @ self.acts(control).ravel())

    @shaped
    def slope(
        self, control: Float[Array, "m K"], times: Float[Array, " k"], directions: Float[Array, "k d"]
    ) -> Float[Array, " k"]:
        """`Execution.slope`, as a difference over a little time before; nothing is proven by it."""
        before = np.maximum(times - STEP * float(self.breakpoints[-1]), 0.0)
        now, then = (self.added(control, at, directions) for at in (times, before))
        return np.asarray((now - then) / np.where(times > before, times - before, 1.0))

    @shaped
    def enclosed(
        self, control: Float[Array, "m K"], times: Float[Array, " k"], directions: Float[Array, "k d"]
    ) -> Float[Array, "k 2"]:
        """`Execution.enclosed`, but for what transitions are off by."""
        bounds = self._summed(control, times, directions)
        lost = rounding(self.size + 8) * np.abs(bounds).max(axis=1)
        return np.asarray(bounds + lost[:, None] * [-1.0, 1.0])

    def _summed(self, control: Array, times: Array, directions: Array) -> Array:
        """What errors of a control add, between two bounds, ``(k, 2)``."""
        size = self.acts(control)
        bounds: Array = self._over_pieces(times, directions, np.asarray(size > 0.0))
        return np.asarray(np.einsum("kjpe,jp->ke", bounds, size))

    def _over_pieces(self, times: Array, directions: Array, wanted: np.ndarray) -> Array:
        """Bounds of ``share_j int |c'Phi(t, s) B_j(s)| ds`` over all that acts, ``(k, m, late + K, 2)``; 0 for what is
        not ``wanted (m, late + K)``."""
        found = np.zeros((times.size, *wanted.shape, 2))
        asked = np.logical_and(wanted, self.shares[:, None] > 0.0)
        acting = self.acting
        pieces = np.flatnonzero(asked[:, acting].any(axis=0))
        if not pieces.size or not times.size:
            return found
        directions = directions * self.felt
        each = max(1, AT_ONCE // (pieces.size * self.kernel.terms[0].size + acting.size * directions.shape[1]))
        for begin in range(0, times.size, each):
            part = slice(begin, begin + each)
            for who, piece, bounds in self._bounds(times[part], directions[part], pieces, asked):
                np.add.at(found.swapaxes(1, 2), (begin + who, acting[piece]), bounds)
        return found

    def _bounds(
        self, times: Array, directions: Array, pieces: np.ndarray, asked: np.ndarray
    ) -> Iterator[tuple[np.ndarray, np.ndarray, Array]]:
        """Of ``times (k,)`` and ``pieces`` between marks that begin before them: the numbers of both, ``(q,)``, and the
        bounds ``(q, m, 2)``; of pieces that are over by then, and of those that are not."""
        motion, grid = self.motion, self.motion.grid
        steps = motion.flow.state
        place = np.clip(np.searchsorted(grid.breakpoints, times, side="left") - 1, 0, grid.pieces - 1)
        distinct, where = np.unique(np.stack([times, grid.breakpoints[place]]), axis=1, return_inverse=True)
        where = where.reshape(-1)
        begun, kernel = self._begun(distinct)
        row, rows = np.zeros(directions.shape), np.empty((times.size, *directions.shape[1:], grid.pieces))
        first = np.einsum("ki,kij->kj", directions, begun[where])
        for k in range(int(place.max()) - 1, int(pieces[0]) - 1, -1):  # rows on the end of every piece
            row = np.where((place == k + 1)[:, None], first, row)
            rows[:, :, k] = row
            row = row @ steps[k]
        who, which = np.nonzero(pieces < place[:, None])
        piece = pieces[which]
        yield who, piece, self._along(self.kernel, piece, rows[who, :, piece], asked[:, self.acting[piece]])
        here = np.flatnonzero(np.isin(place, pieces) & np.greater(times, grid.breakpoints[place]))
        piece = place[here]
        yield here, piece, self._along(kernel, where[here], directions[here], asked[:, self.acting[piece]])

    def _begun(self, distinct: Array) -> tuple[Array, Kernel]:
        """Of times, and the breakpoints before them, ``(2, k)``: the transitions from these, ``(k, d, d)``, and the
        kernel on the way; remembered, since the same times are asked for in many directions."""
        key = distinct.tobytes()
        if key not in self._ways:
            until, expansion = np.maximum(*distinct), self.motion.expansion
            found = expansion.flow(distinct[1], until).state, expansion.kernel(distinct[1], until)
            remember(self._ways, key, found, max(1, AT_ONCE // (found[0].size + found[1].terms.size)))
        return self._ways[key]

    def _along(self, kernel: Kernel, which: np.ndarray, rows: Array, asked: np.ndarray) -> Array:
        """Bounds ``(q, m, 2)`` of what intervals ``which (q,)`` of a kernel make of ``rows (q, d)`` on their ends, of
        channels that are ``asked (m, q)``."""
        m, units, columns = self.shares.size, self.motion.expansion.units, self.columns
        if self.bound is not None:
            return self._together(self.bound, kernel, which, rows)
        sizes = np.einsum("qd,qdm->qm", np.abs(rows), np.abs(kernel.terms[..., columns]).sum(axis=1)[which])
        lost = np.einsum("qd,qdm->qm", np.abs(rows) * units, kernel.sizes[which][..., columns])
        lost = lost * kernel.error[which, None]
        # a cut rounds every coefficient four times for every order; halves, of half the length each, twice in all
        lost = lost + rounding(rows.shape[1] + (2 + 4 * CUTS) * kernel.terms.shape[1] + HALVINGS) * sizes
        bounds = np.zeros((which.size, m, 2))
        for j, share in enumerate(self.shares):
            mine = np.flatnonzero(asked[j])
            terms = np.einsum("qd,qpd->qp", rows[mine], kernel.terms[which[mine], :, :, columns[j]])
            accuracy = np.maximum(ACCURACY * self.motion.grid.pieces * sizes[mine, j], TINY)
            found = absolute(terms, accuracy)
            found = found + lost[mine, j, None] * [-1.0, 1.0]
            bounds[mine, j] = share * np.maximum(found, 0.0) * [1.0 / OUTWARD, OUTWARD]
        return bounds

    def _together(self, bound: ConvexSet, kernel: Kernel, which: np.ndarray, rows: Array) -> Array:
        """`_along` of a set of what enters by all columns, ``(q, 1, 2)``."""
        columns, far = self.columns, self.far
        sizes = np.einsum("qd,qdm->qm", np.abs(rows), np.abs(kernel.terms[..., columns]).sum(axis=1)[which]) @ far
        units = np.abs(rows) * self.motion.expansion.units
        lost = np.einsum("qd,qdm->qm", units, kernel.sizes[which][..., columns]) @ far * kernel.error[which]
        lost = lost + rounding(rows.shape[1] + 2 * kernel.terms.shape[1] + HALVINGS + 2 * far.size) * sizes
        terms = np.einsum("qd,qpdm->qpm", rows, kernel.terms[which][..., columns])
        accuracy = np.maximum(ACCURACY * self.motion.grid.pieces * sizes, TINY)
        found = integrated(bound, terms, np.ones(which.size), accuracy)
        return np.asarray(found + OUTWARD * lost[:, None] * [-1.0, 1.0])[:, None]


@final
@dataclass(frozen=True, eq=False)
class SpreadExecution(Execution):
    """`Execution` of a system whose state is a polynomial in its parameters: on each of the ``parts`` of their box that
    of all coefficients, ``every`` of them. Directions are those on the coefficients, followed by the number of their
    part (`seen`)."""

    parts: Parts
    every: tuple[VaryingExecution, ...]

    def none(self) -> SpreadExecution:
        """`Execution.none`."""
        return replace(self, shares=np.zeros(self.shares.size), every=tuple(one.none() for one in self.every))

    @property
    def around(self) -> SpreadExecution:
        """`VaryingExecution.around`."""
        every = tuple(one.around for one in self.every)
        return replace(self, shares=every[0].shares, every=every)

    def seen(self, directions: Array, parameters: Array) -> Array:
        """`Execution.seen`: those on all coefficients, and the number of the part."""
        found = np.zeros((len(directions), self.parts.every[0][0].states + 1))
        if self.shares.any():  # else there may be no parameters
            found[:, -1] = self.parts.of(parameters)
            for part, here in self._apart(found):
                found[here, :-1] = self.parts.every[part][0].directions(directions[here], parameters[here])
        return found

    @staticmethod
    def _apart(directions: Array) -> list[tuple[int, np.ndarray]]:
        """The parts that directions are on, and the numbers of those in each."""
        which = directions[:, -1]
        return [(int(part), np.flatnonzero(which == part)) for part in np.unique(which).tolist()]

    def over(
        self,
        control: Array,
        rows: Array,
        leg: LiftedSystem | VaryingMotion | SpreadMotion,
        joined: Combination | None = None,
    ) -> Support:
        """`Execution.over`."""
        assert isinstance(leg, SpreadMotion)
        assert joined is None  # refused beside curved sets
        part = self.parts.holding(leg.low, leg.high)
        assert part is not None  # the motion is one within a part
        return SpreadExecutionSupport(self.every[part].reaching(control), rows, leg)

    @shaped
    def lengths(self, times: Float[Array, " k"], directions: Float[Array, "k d"]) -> Float[Array, "k n"]:
        """`Execution.lengths`."""
        found = np.empty((times.size, self.size))
        for part, here in self._apart(directions):
            found[here] = self.every[part].lengths(times[here], directions[here, :-1])
        return found

    def given(self, times: Array, directions: Array) -> Array:
        """`Execution.given`."""
        found = np.empty(times.size)
        for part, here in self._apart(directions):
            found[here] = self.every[part].given(times[here], directions[here, :-1])
        return found

    @shaped
    def added(
        self, control: Float[Array, "m K"], times: Float[Array, " k"], directions: Float[Array, "k d"]
    ) -> Float[Array, " k"]:
        """`Execution.added`."""
        found = np.empty(times.size)
        for part, here in self._apart(directions):
            found[here] = self.every[part].added(control, times[here], directions[here, :-1])
        return found

    def sampled(self, control: Array, times: Array, directions: Array) -> Array:
        """`Execution.sampled`."""
        found = np.empty(times.size)
        for part, here in self._apart(directions):
            found[here] = self.every[part].sampled(control, times[here], directions[here, :-1])
        return found

    @shaped
    def slope(
        self, control: Float[Array, "m K"], times: Float[Array, " k"], directions: Float[Array, "k d"]
    ) -> Float[Array, " k"]:
        """`Execution.slope`."""
        found = np.empty(times.size)
        for part, here in self._apart(directions):
            found[here] = self.every[part].slope(control, times[here], directions[here, :-1])
        return found

    @shaped
    def enclosed(
        self, control: Float[Array, "m K"], times: Float[Array, " k"], directions: Float[Array, "k d"]
    ) -> Float[Array, "k 2"]:
        """`Execution.enclosed`."""
        found = np.empty((times.size, 2))
        for part, here in self._apart(directions):
            found[here] = self.every[part].enclosed(control, times[here], directions[here, :-1])
        return found


@final
@dataclass(frozen=True, eq=False)
class VaryingExecutionCellSupport(KnownCellSupport):
    """`ExecutionCellSupport` of a system that changes with time; ``motion`` is its."""

    execution: VaryingExecution
    control: Array
    rows: Array
    motion: VaryingMotion

    @shaped
    def at(
        self, times: Float[Array, " k"], ends: Float[Array, "k r 0"]
    ) -> tuple[Float[Array, "k r 1"], Float[Array, "k r"]]:
        """What is added ``(k, r, 1)`` and how far it may be from that, ``(k, r)``; ``ends (k, r, 0)``."""
        return self.between(self.execution.enclosed(self.control, *self.repeated(times)))

    @shaped
    def deviation(self, start: Float[Array, " k"], widths: Float[Array, " k"]) -> Float[Array, "k r"]:
        """Bounds ``(k, r)`` of how far it is above its chord on ``[start, start + width]``, each inside one piece.

        With ``g(t, s) = c'Phi(t, s) B(s)`` the second derivative of the integral of ``|g|`` up to ``t`` is at least
        ``-|c'B'| - |c'A B| - int |g_tt| ds``, and ``g_tt = c'(A' + A^2) Phi B``: where ``g`` changes its sign the slope
        jumps upwards only. All of it is bounded at the start, and how much it changes within the cell.
        """
        motion, d, columns = self.motion, self.motion.states, self.execution.columns
        pieces = np.minimum(motion.place(start), motion.origin.size - 1)
        (law, slope), width = motion.law(start, pieces), widths[:, None]
        entering = np.append(np.arange(d), d + columns)
        law, slope = law[:, :, entering], slope[:, :, entering]
        most, second, third = (one[pieces][:, :, entering] for one in (motion.most, motion.second, motion.third))
        begun, pushed = self._sizes(start), self.sizing[pieces]
        exact = np.abs(self.rows @ (slope[:, :, :d] + law[:, :, :d] @ law[:, :, :d]))
        now = np.abs(self.rows @ slope[:, :, d:]) + np.abs(self.rows @ law[:, :, :d] @ law[:, :, d:])
        entered = width * np.einsum("kim,km->ki", most[:, :, d:], pushed)
        grown = motion.grown(pieces, widths, begun + entered)
        turned = np.einsum("kij,kj->ki", third[:, :, :d], grown) + np.einsum("kim,km->ki", third[:, :, d:], pushed)
        turned = width * turned + np.einsum("kij,kj->ki", second[:, :, :d], entered)
        rounded = np.einsum("kij,kj->ki", second[:, :, :d], begun) + np.einsum("kim,km->ki", second[:, :, d:], pushed)
        turned = turned + rounding(2 * motion.terms) * rounded
        along = np.einsum("krj,kj->kr", exact, begun) + np.einsum("krm,km->kr", now, pushed)
        return np.asarray(width**2 / 8 * (along + turned @ np.abs(self.rows).T) * OUTWARD)

    @cached_property
    def neglected(self) -> Array:
        """What is off in the transitions, on every piece: ``(r, K)``."""
        return product(np.abs(self.rows), self.missed.T)

    @cached_property
    def missed(self) -> Array:
        """What states are off by, on every piece, ``(K, d)``."""
        pushed = self.motion.flow.sizes[..., self.execution.columns] * self.sizing[:, None]
        return self.motion.left_out(self.at_marks[:-1], pushed)

    @cached_property
    def reached(self) -> Array:
        """As in `VaryingSupport`, ``(K, d)``."""
        motion, lengths = self.motion, self.motion.grid.lengths
        columns = motion.states + self.execution.columns
        entered = np.einsum("kim,km->ki", motion.most[:, :, columns], self.sizing)
        return motion.grown(motion.every, lengths, self.at_marks[:-1] + lengths[:, None] * entered)

    @cached_property
    def sizing(self) -> Array:
        """How large errors may be on every piece between marks, ``(K, m)``."""
        size = self.execution.far[:, None] * self.execution.acts(self.control)
        return np.asarray(size[:, self.execution.acting].T * OUTWARD)

    @cached_property
    def at_marks(self) -> Array:
        """What errors can have made of every state at the marks, ``(K + 1, d)``, at most."""
        return self._sizes(self.motion.grid.breakpoints)

    def _sizes(self, times: Array) -> Array:
        """What errors can have made of every state, ``(k, d)``, at most."""
        d = self.motion.states
        ways = [np.eye(d)] if self.execution.bound is None else [np.eye(d), -np.eye(d)]
        every = (self.execution.enclosed(self.control, *self._each(times, way))[:, 1] for way in ways)
        return np.asarray(np.max([np.maximum(one, 0.0) for one in every], axis=0).reshape(-1, d) * OUTWARD)

    @staticmethod
    def _each(times: Array, rows: Array) -> tuple[Array, Array]:
        """Every time with every row."""
        return np.repeat(times, len(rows)), np.tile(rows, (times.size, 1))


@final
@dataclass(frozen=True, eq=False)
class SpreadExecutionSupport:
    """What errors of execution add to functionals ``rows (r, d)`` over a cell of parameters, in the form of `Support`;
    ``every`` is what they make of all coefficients.

    Of one parameter alone a polynomial ``f`` is nowhere further from its chord than half the largest ``f''`` on
    ``[-1, 1]``, and the absolute value of the chord is not above the chord of the absolute values. So the integrals
    of ``|f|`` are, one parameter after another, at most what is linear in each between those at the corners, and half
    of those of the second derivatives more.
    """

    every: VaryingExecutionCellSupport
    rows: Array
    motion: SpreadMotion

    @shaped
    def steepness(self, times: Float[Array, " k"]) -> Float[Array, "k r nu"]:
        """`Support.steepness`."""
        return np.asarray(self._sizes(times) @ self.motion.space.exponents)

    @shaped
    def at(
        self, times: Float[Array, " k"], ends: Float[Array, "k r nu"]
    ) -> tuple[Float[Array, "k r M"], Float[Array, "k r"]]:
        """`Support.at`."""
        space, sizes, of = self.motion.space, self._sizes(times), self.every
        coefficients, excess = np.zeros((*ends.shape[:2], space.size)), np.zeros(ends.shape[:2])
        patterns, which = distinct_patterns(ends)
        for position, pattern in enumerate(patterns):
            here, row = np.nonzero(which == position)
            free, corners = np.flatnonzero(pattern == 0.0), _corners(pattern)
            powers = space.monomials(corners) @ self.motion.recentred  # of the coefficients in all parameters
            directions = (powers[:, :, None] * self.rows[row][:, None, None, :]).reshape(len(row) * len(corners), -1)
            bounds = of.execution.enclosed(of.control, np.repeat(times[here], len(corners)), directions)
            bounds = bounds.reshape(len(row), len(corners), 2)
            off = (bounds[..., 1] - bounds[..., 0]).max(axis=1) / 2
            bent = sizes[here, row] @ (space.exponents[:, free] * (space.exponents[:, free] - 1)).sum(axis=1)
            coefficients[here, row], beyond = between_corners(space, pattern, bounds.mean(axis=2))
            excess[here, row] = (off + bent / 2 + beyond) * OUTWARD
        return coefficients, excess

    @shaped
    def deviation(self, start: Float[Array, " k"], widths: Float[Array, " k"]) -> Float[Array, "k r"]:
        """`VaryingExecutionCellSupport.deviation`, by the largest numbers on every piece."""
        bent = self._bent[self._pieces(start)] @ self.motion.sizes(np.abs(self.rows)).T
        return np.asarray((widths**2 / 8)[:, None] * bent * OUTWARD)

    @cached_property
    def neglected(self) -> Array:
        """What is off in the transitions, with what is beyond the degree, on every piece: ``(r, K)``."""
        of, motion, rows = self.every, self.motion, np.abs(self.rows)
        inputs = np.zeros((len(of.sizing), of.motion.most.shape[2] - of.motion.states))
        inputs[:, of.execution.columns] = of.sizing
        lost = motion.truncation.lost(of.at_marks[:-1] + of.missed, inputs)
        return np.asarray((motion.sizes(rows) @ of.missed.T + rows @ lost.T) * OUTWARD)

    @cached_property
    def reached(self) -> Array:
        """`Support.reached`, with what rounding there is more of them."""
        return np.asarray((1.0 + self.motion.space.size) * self.motion.folded(self.every.reached))

    @cached_property
    def _bent(self) -> Array:
        """The second derivative in time of every coefficient, at most, on every piece, ``(K, states)``."""
        of, d = self.every, self.every.motion.states
        second = of.motion.second
        pushed = second[:, :, d + of.execution.columns]
        found = np.einsum("kij,kj->ki", second[:, :, :d], of.reached) + np.einsum("kim,km->ki", pushed, of.sizing)
        return np.asarray(found * OUTWARD)

    def _sizes(self, times: Array) -> Array:
        """What errors add along every coefficient on the cell, at most, ``(k, r, M)``."""
        reached = self.every.reached[self._pieces(times)].reshape(times.size, self.motion.space.size, -1)
        along = np.einsum("rd,kad->kra", np.abs(self.rows), reached)
        return np.asarray(along @ np.abs(self.motion.recentred).T * OUTWARD)

    def _pieces(self, times: Array) -> np.ndarray:
        return np.asarray(np.minimum(self.every.motion.place(times), self.every.motion.origin.size - 1))


@final
@dataclass(frozen=True, eq=False)
class VaryingMeasurable:
    """`MeasurableSupport` of a system that changes with time. Of a box: what stays in the middle of the box, and the
    errors, through the columns of ``E``, of a command that is 1 and may be missed by half the widths. Of another set
    what all of it does at once takes the place of such errors, and the middle is 0. Where the state is expanded in
    parameters, the errors are those of all coefficients, on each of the parts of their box."""

    response: Response
    bound: ConvexSet

    @shaped
    def __call__(
        self, times: Float[Array, " k"], directions: Float[Array, "k d"], parameters: Float[Array, "k nu"]
    ) -> Float[Array, " k"]:
        """``sigma (k,)`` at ``times (k,)``, ``directions (k, d)``, ``parameters (k, nu)``."""
        along = self.errors.seen(directions, parameters)
        found = np.array(self.errors.sampled(self.command, times, along))
        resting = self.resting
        if resting is None:
            return found
        several = max(1, AT_ONCE // self.response.numbers(0))
        for first in range(0, times.size, several):
            part = slice(first, first + several)
            weights = self.response.weights(times[part], directions[part], parameters[part])
            found[part] += resting.support(weights.disturbance)
        return found

    def roughly(self, times: Array, directions: Array, parameters: Array) -> Array:
        """The same, in no other way."""
        return self(times, directions, parameters)

    @cached_property
    def middle(self) -> Array:
        """That of the box, ``(mw,)``; 0 of another set."""
        if not self.bound.is_box:
            return np.zeros(self.bound.dimension)
        box = self.bound.bounding_box()
        return np.asarray((box.lower + box.upper) / 2)

    @cached_property
    def errors(self) -> VaryingExecution | SpreadExecution:
        """How far disturbances may be from the middle: rounded outwards where that is not 0."""
        shares, bound, through = np.ones(1), None, None
        if self.bound.is_box:
            box = self.bound.bounding_box()
            far = np.maximum(box.upper - self.middle, self.middle - box.lower)
            shares = np.where(self.middle == 0.0, far, np.where(box.upper > box.lower, np.nextafter(far, np.inf), 0.0))
        else:
            bound, through = _moving(self.bound)
        ends, felt = self.response.grid.breakpoints[[0, -1]], np.ones(self.response.system.states)
        one = VaryingExecution(self.response, ends, shares, felt, disturbing=True, bound=bound, through=through)
        return one.followed()

    @property
    def command(self) -> Array:
        """The 1 that is missed, ``(mw, 1)``, of sets of all channels at once ``(1, 1)``."""
        return np.ones((self.errors.shares.size, 1))

    @cached_property
    def resting(self) -> DisturbanceModel | None:
        """The disturbance that stays in the middle, ``None`` where that is 0."""
        if not self.middle.any():
            return None
        point, pieces = Box(self.middle, self.middle), np.arange(self.response.grid.pieces)
        return DisturbanceModel("piecewise_constant", point, point, self.response.grid, starts=pieces)

    def over(
        self, rows: Array, leg: LiftedSystem | VaryingMotion | SpreadMotion, joined: Combination | None = None
    ) -> list[Support]:
        """`MeasurableSupport.over`, over a cell of parameters too."""
        assert not isinstance(leg, LiftedSystem)
        found = [self.errors.over(self.command, rows, leg, joined)]
        if self.resting is not None and isinstance(leg, SpreadMotion):
            found.append(SpreadSupport.of_disturbance(leg, self.resting, rows, joined))
        elif self.resting is not None and isinstance(leg, VaryingMotion):
            found.append(VaryingSupport.of_disturbance(leg, self.resting, rows, joined))
        return found

    def integrated_sizes(self, times: Array, directions: Array, parameters: Array) -> Array:
        """`MeasurableSupport.integrated_sizes`: integrals of absolute values."""
        along = self.errors.seen(directions, parameters)
        return np.asarray(self.errors.around.lengths(times, along).sum(axis=1))


def _moving(bound: ConvexSet) -> tuple[ConvexSet, np.ndarray]:
    """A flat set without the entries that are 0 in all of it, as those of another class are, and which the others
    are."""
    box, flat = bound.bounding_box(), bound.halfspaces()
    moving = np.flatnonzero((box.lower != 0.0) | (box.upper != 0.0))
    if moving.size in (0, bound.dimension) or flat is None:
        return bound, np.arange(bound.dimension)
    rows = flat[0][:, moving].any(axis=1)
    return Polytope(flat[0][rows][:, moving], flat[1][rows]), moving


def measurable_support(response: Response, bound: ConvexSet) -> MeasurableSupport | VaryingMeasurable:
    """The support of measurable disturbances in a set."""
    return (VaryingMeasurable if response.grid.varying else MeasurableSupport)(response, bound)
