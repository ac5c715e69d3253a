"""Transitions of systems that change with time, with a proven bound of their error.

The system is enclosed on segments of the horizon as polynomials of the time with a remainder (Taylor models, whose
segments follow the radius of convergence). Over an interval within one segment the solution is the power series of its
own equation; what it leaves out is bounded entry by entry by the series of the absolute values, which majorises it, and
what the remainder may add by the formula of variation of constants.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache, cached_property
from itertools import pairwise
from math import ceil, comb
from typing import NamedTuple
from weakref import WeakKeyDictionary, ref

import numpy as np

from sparserob_core.control.enclosures.dependence import Spread, Superposed
from sparserob_core.control.enclosures.matrix_exponential import EPSILON, rounding
from sparserob_core.control.enclosures.taylor import TaylorSpace
from sparserob_core.control.problem.phase import Phase, PhaseInUnits
from sparserob_core.control.problem.system import System
from sparserob_core.errors import InputError, NotEnclosable
from sparserob_core.shapes import Float, shaped
from sparserob_core.sip.convex_set import Array

DEGREE = 14  # of the system in time; with a tenth segments are a hundred times shorter
TERMS = 64  # of the solution on an interval; 40 of them leave 1e-10 where entries turn once in four segments
FEWER = (8, 12, 16, 24, 40)  # terms that are enough where what they leave out is below `IDLE`, as on short intervals
IDLE = 2.0**-58  # of what is added up, what does not show; ten times more would be a digit, ten times less cost terms
CIRCLES = (1.5, 2.0, 3.0, 4.0, 6.0, 8.0, 12.0, 24.0, 48.0, 96.0)
"""Shares of an interval on which Cauchy's bound is looked at; short intervals need the wide ones."""
LONG = 2.0  # norm of A times the length of a segment; ten times more needs three times the terms
SLOW = 0.25  # norm to which a slow part is brought by units of its own: four times more rounds more, a tenth halves it
SHARPEST = 1e-13  # remainder on a segment, as a share of the numbers: ten times less is below what is rounded
BLUNTEST = 1e-10  # from which on a segment is halved even where that did not help: else what a state misses shows
SHORTEST = 2.0**-30  # of the horizon: a shorter segment without an enclosure holds a pole
_KNOWN: WeakKeyDictionary[Phase, dict[tuple[object, ...], Expansion]] = WeakKeyDictionary()
FIRST = 8  # segments to begin with
MOST = 100_000
"""Segments at most. Ten times as many take an hour and gigabytes; of a tenth systems would be refused that are solved
in a minute."""
LOOKED = 256  # segments after which the rest is estimated: a tenth of a second of work; ten times as many are a second
SAMPLED = 16  # times at which it is; a tenth of them miss where a system is fast, ten times as many take a second
SWEEPS = 20  # of balancing
NUMBERS = np.zeros((3, 1), dtype=int)  # the products of polynomials that are numbers


class Flow(NamedTuple):
    """What ``k`` intervals make of the state at their beginning, ``state (k, d, d)``, and of inputs that stay the same,
    ``control (k, d, m)`` and ``disturbance (k, d, mw)``.

    ``error (k,)``: bound of what they are off by, in the norm of largest row sums in the coordinates of
    `Expansion.units`; of the columns of inputs times ``sizes (k, d, m + mw)``, what drives the states that ``A``
    couples with each one at most.
    """

    state: Array
    control: Array
    disturbance: Array
    error: Array
    sizes: Array


class Kernel(NamedTuple):
    """What inputs at any time ``s`` on ``k`` intervals make of the state at the end: ``Phi(end, s) F(s)`` times the
    length, as polynomials of the share of the interval that is left at ``s``, ``terms (k, p + 1, d, m + mw)``.

    ``error (k,)``: bound of what its entries are off by in the coordinates of `Expansion.units`, times
    ``sizes (k, d, m + mw)``.
    """

    terms: Array
    error: Array
    sizes: Array


class Majorant(NamedTuple):
    """How far the series of a flow is summed, ``terms`` of it with ``degree`` of the system's; what it is off by then,
    ``error (k,)``; and what drives states, ``sizes (k, d, m + mw)``."""

    terms: int
    degree: int
    error: Array
    sizes: Array


@dataclass(frozen=True, eq=False)
class Expansion:
    """A system on segments between ``ends (s + 1,)``: ``coefficients (s, DEGREE + 1, d, d + m + mw)`` of ``[A B E]``
    in powers of the time from -1 to 1 over each segment, and what they may be off by, ``remainder (s, d, d + m + mw)``.

    ``units (d,)``: of states, in which no entry of ``A`` is much larger than the others. ``ratios (s, d)``: of those in
    which a segment is looked at to these, at least 1 (`steadied`). ``turns``: the numbers of the ends at which another
    law takes over. ``spread``: of which polynomials the states are the coefficients.
    """

    ends: Array
    coefficients: Array
    remainder: Array
    units: Array
    ratios: Array
    channels: tuple[int, int]
    turns: tuple[int, ...] = ()
    spread: Spread | None = None

    @staticmethod
    def of(system: System) -> Expansion:
        """The expansion of a system; raises `InputError`, which names a time, where there is none, as at a pole or at
        the root of a negative number."""
        first, stated = system.phases[0], system.stated
        kept = _KNOWN.setdefault(first, {})
        key = system.horizon, *((phase.begin, ref(phase)) for phase in system.phases[1:])
        if key not in kept:
            kept[key] = Expansion._made(system) if stated is system else Expansion.of(stated)._in_units(system)
        return kept[key]

    def _in_units(self, system: System) -> Expansion:
        law = system.phases[0]
        assert isinstance(law, PhaseInUnits)
        factors = np.hstack([law.factors[name] * np.ones(part) for name, part in self._shapes])
        states = np.sqrt(law.factors["A"][:, 0] / law.factors["A"][0, :])  # old units over new ones, but for a factor
        return Expansion(
            self.ends / law.clock,
            self.coefficients * factors,
            self.remainder * factors,
            self.units * states,
            self.ratios,
            (system.controls, system.disturbances),
            self.turns,
            self.spread,
        )

    @property
    def _shapes(self) -> list[tuple[str, tuple[int, int]]]:
        d, (m, mw) = self.units.size, self.channels
        return [("A", (d, d)), ("B", (d, m)), ("E", (d, mw))]

    @staticmethod
    def _made(system: System) -> Expansion:
        space, horizon = TaylorSpace(1, DEGREE), system.horizon
        A = np.max([np.abs(np.asarray(mode.A, dtype=float)) for mode in system.modes], axis=0)
        spread = _spread_of(system)
        units = balanced(A, horizon)
        if spread is not None:  # the same for every coefficient, so that norms are those of a ring
            units = np.tile(balanced(A[: spread.d, : spread.d], horizon), spread.space.size)
        size = float((np.abs(A) / units[:, None] * units).sum(axis=1).max())
        look = Look(space, units, size, spread is None)
        todo = [
            (start, stop, np.inf, law)
            for law in system.phases
            for start, stop in pairwise(_cut(law.begin, law.until, horizon))
        ][::-1]
        ends, found = [0.0], list[Segment]()
        while todo:
            start, stop, before, law = todo.pop()
            segment = look.at(law, start, stop, before)
            centre = (start + stop) / 2
            if segment.sharp:
                ends.append(stop)
                found.append(segment)
                if len(found) in (LOOKED, MOST):
                    _require_few(system, look, ends)
            elif stop - start <= SHORTEST * horizon:
                raise InputError(f"near t = {centre:.9g} the system {segment.why}", path="system")
            else:
                todo += [(centre, stop, segment.off, law), (start, centre, segment.off, law)]
        turns = tuple(ends.index(law.begin) for law in system.phases[1:])
        channels = system.controls, system.disturbances
        every, lost, owns = (np.array(part) for part in zip(*(one.parts for one in found), strict=True))
        return Expansion(np.array(ends), every, lost, units, owns, channels, turns, spread)

    @shaped
    def flow(self, starts: Float[Array, " k"], stops: Float[Array, " k"]) -> Flow:
        """What each of the intervals makes of states and inputs."""
        d, (m, mw) = self.units.size, self.channels
        wide = (starts.size, d, m + mw)
        state, inputs = np.tile(np.eye(d), (starts.size, 1, 1)), np.zeros(wide)
        error, sizes = np.zeros(starts.size), np.zeros(wide)

        def follow(here: np.ndarray, step: Array, driven: Array, off: Array, pushed: Array) -> None:
            before = state[here], inputs[here], error[here], sizes[here]
            state[here], inputs[here] = step @ before[0], step @ before[1] + driven
            error[here], sizes[here] = self._off(before, step, off), before[3] + pushed

        first = self.segment_of(starts)
        last = np.clip(np.searchsorted(self.ends, stops, side="left") - 1, first, self.ends.size - 2)
        moved = np.flatnonzero(stops > starts)
        if moved.size:
            ends = np.where(last > first, self.ends[first + 1], stops)  # the last one holds what is behind the horizon
            begun = self._within(first[moved], starts[moved], ends[moved])
            state[moved], inputs[moved], error[moved], sizes[moved] = begun
        for n in range(1, int((last - first).max(initial=0))):
            here = moved[(first + n < last)[moved]]
            follow(here, *(part[first[here] + n] for part in self._whole))
        here = moved[(last > first)[moved]]
        if here.size:
            follow(here, *self._within(last[here], self.ends[last[here]], stops[here]))
        return Flow(state, inputs[..., :m], inputs[..., m:], error, sizes)

    @shaped
    def at_parameters(
        self, starts: Float[Array, " k"], stops: Float[Array, " k"], powers: Float[Array, "v k1 M"]
    ) -> tuple[Float[Array, "v k d d"], Float[Array, "v k d n"]]:
        """Return what intervals make of the state and of inputs, of a law that is a polynomial in its parameters.

        Parameters
        ----------
        starts, stops : Array
            Times ``(k,)``.
        powers : Array
            Monomials ``(v, k, M)`` at the parameters of every interval, or ``(v, 1, M)`` where these are the same.

        Returns
        -------
        Array, Array
            The transitions ``(v, k, d, d)``; and what inputs that stay the same bring, those of the disturbance after
            the others, ``(v, k, d, n)``.
        """
        own, shape = self.own, (len(powers), starts.size)
        state, inputs = np.tile(np.eye(own), (*shape, 1, 1)), np.zeros((*shape, own, sum(self.channels)))
        first = self.segment_of(starts)
        last = np.clip(np.searchsorted(self.ends, stops, side="left") - 1, first, self.ends.size - 2)
        for n in range(int((last - first).max(initial=-1)) + 1):
            here = np.flatnonzero((first + n <= last) & (stops > starts))
            if not here.size:
                continue
            segments = first[here] + n
            begun = np.maximum(starts[here], self.ends[segments])
            ended = np.where(segments < last[here], self.ends[segments + 1], stops[here])
            step = self._of_values(segments, begun, ended, powers if powers.shape[1] == 1 else powers[:, here])
            state[:, here] = step[..., :own] @ state[:, here]
            inputs[:, here] = step[..., :own] @ inputs[:, here] + step[..., own:]
        return state, inputs

    def _of_values(self, segments: np.ndarray, starts: Array, stops: Array, powers: Array) -> Array:
        """`at_parameters` of intervals within one segment each, side by side, ``(v, k, d, d + n)``."""
        size, own, there, length = powers.shape[2], self.own, self._there, stops - starts
        distinct, which = np.unique(segments, return_inverse=True)
        given = self._first[distinct].reshape(distinct.size, DEGREE + 1, size, own, -1)[:, :, there]
        shape = (len(powers), starts.size, DEGREE + 1, own, given.shape[4])
        if powers.shape[1] == 1:
            values = np.einsum("va,snaij->vsnij", powers[:, 0, there], given)[:, which.reshape(-1)]
        else:
            values = np.einsum("vka,knaij->vknij", powers[:, :, there], given[which.reshape(-1)])
        moved = self._moved(segments, starts, length) * length[:, None, None]
        law = (moved @ values.reshape(*shape[:3], -1)).reshape(-1, *shape[2:])
        units = self.units[:own, None]
        sizes = (np.abs(law[..., :own]) * units[:, 0] / units).sum(axis=3).max(axis=2)
        pushes = np.abs(law[..., own:]) / units
        most = pushes.sum(axis=1).max(axis=1)
        shares = (pushes / np.where(most > 0.0, most, np.inf)[:, None, None]).max(axis=(2, 3), initial=0.0)
        terms, _ = _tail(sizes, shares)
        found = self._summed(law[..., :own], law[..., own:], terms, DEGREE, 1)
        return found.reshape(*shape[:2], own, -1)

    @cached_property
    def _there(self) -> np.ndarray:
        """The coefficients of polynomials that the law has."""
        every = self._first.reshape(*self._first.shape[:2], -1, self.own, self._first.shape[3])
        return np.flatnonzero(every.any(axis=(0, 1, 3, 4)))

    def _off(self, before: tuple[Array, ...], step: Array, off: Array) -> Array:
        """What products ``P S`` are off by, ``P`` a ``step (k, d, d)`` that is off by ``off (k,)``, and ``S`` what was
        ``before``: ``off (|S| + error) + |P| error``, and what is rounded; of inputs as shares of what drives."""
        state, inputs, error, sizes = before
        driven = np.where(sizes > 0.0, sizes, np.inf) * self.units[:, None]
        most = np.maximum(self._norm(state[..., : self.own]), (np.abs(inputs) / driven).max(axis=(1, 2), initial=1.0))
        grown = self._norm(step[..., : self.own])
        found = off * (most + error) + grown * error + rounding(self.units.size + 1) * grown * (most + error)
        return np.asarray(found * (1.0 + 1e-9))

    @cached_property
    def _whole(self) -> tuple[Array, ...]:
        """`_within` of every segment as a whole."""
        return self._within(np.arange(self.ends.size - 1), self.ends[:-1], self.ends[1:])

    def segment_of(self, times: Array) -> np.ndarray:
        """The segment that each time is in, or begins, ``(k,)``."""
        return np.clip(np.searchsorted(self.ends, times, side="right") - 1, 0, self.ends.size - 2)

    @shaped
    def at(self, times: Float[Array, " k"]) -> tuple[Float[Array, "k d own"], Float[Array, "k d n"]]:
        """``A`` and ``[B E]`` at times ``(k,)``, for what asks which way the state goes; nothing is proven by them. Of
        coefficients of polynomials the columns of ``A`` that make the others."""
        segments, d = self.segment_of(times), self.own
        begin, end = self.ends[segments], self.ends[segments + 1]
        powers = ((2.0 * times - begin - end) / (end - begin))[:, None] ** np.arange(DEGREE + 1)
        law = np.einsum("kn,knij->kij", powers, self._first[segments])
        return law[..., :d], law[..., d:]

    @shaped
    def average(self, times: Float[Array, " T"]) -> Float[Array, "k d own"]:
        """About what ``A`` is between ``times (k + 1,)``: at the middles, for what asks how fast the system is."""
        return self.at((times[:-1] + times[1:]) / 2)[0]

    def kernel(self, starts: Array, stops: Array) -> Kernel:
        """The kernel of intervals ``(k,)`` within one segment each. With ``Psi(r) = Phi(end, end - r h)``, ``Psi' = h
        Psi A``: a series majorised by that of ``y' = a y``, times that of ``F``."""
        d, own, segments = self.units.size, self.own, self.segment_of((starts + stops) / 2)
        length = stops - starts
        law, bulk = self._recentred(segments, stops, -length, length)
        rest = self.remainder[segments] * length[:, None, None]
        A, F, scale = law[..., :own], law[..., own:], self.units / self.units[:, None]
        inputs = _totals(self._driven(law[..., own:]), self._driven(rest[..., d:]))[0]
        law, bulk, rest = (self._steady(segments, one) for one in (law, bulk, rest))
        sizes, full = (self._norm(one[..., :own]) for one in (law, bulk))
        pushes, fuller = (self._driven(one[..., own:]) for one in (law, bulk))
        lost = self._driven(rest[..., d:])
        most = _totals(pushes, lost)[1]
        shares = (pushes / most[:, None]).max(axis=(2, 3), initial=0.0)
        r = (rest[..., :d] * scale).sum(axis=2).max(axis=1)
        lost = (lost / most).max(axis=(1, 2), initial=0.0)
        orders, terms, tail = np.arange(DEGREE + 1.0), TERMS, np.zeros(length.size)
        for terms in (*(one for one in FEWER if one < TERMS), TERMS):
            tail = np.full(length.size, np.inf)
            for R in CIRCLES:
                with np.errstate(over="ignore", invalid="ignore"):
                    y = np.exp((sizes * R ** (orders + 1.0) / (orders + 1.0)).sum(axis=1))
                    tail = np.fmin(tail, y * (shares * R**orders).sum(axis=1) * R ** -float(terms) / (R - 1.0))
            if (tail <= IDLE).all():
                break
        found = self._backwards(A, F, terms)
        a, a_full = sizes.sum(axis=1), full.sum(axis=1)
        forced = (fuller.sum(axis=1) / most).max(axis=(1, 2), initial=0.0)
        rounded = rounding((DEGREE + 1) * (d + 4)) * (2.0 + a_full) * np.exp(a_full) * forced
        error = (tail + (r + lost * (1.0 + r)) * np.exp(a + r) + rounded) * self.ratios[segments].max(axis=1)
        return Kernel(found, error * (1.0 + 1e-9), inputs)

    def _backwards(self, A: Array, F: Array, terms: int) -> Array:
        """The terms ``(k, terms + 1, d, m + mw)`` of ``Psi F`` with ``Psi' = Psi A``, ``Psi(0) = I``, from those of ``A
        (k, DEGREE + 1, d, own)`` and ``F``; where the states are coefficients of polynomials, as in `_summed`."""
        count, own = len(A), self.own
        A, F = (one.reshape(count, DEGREE + 1, -1, own, one.shape[3]) for one in (A, F))
        size = A.shape[2]
        left, right, target = NUMBERS if self.spread is None else self.spread.space.products
        # the latest term comes first, so that those that meet one another lie side by side
        every = np.zeros((count, size, own, terms + 2, own))
        every[:, 0, :, terms + 1] = np.eye(own)

        def factors(other: Array) -> list[tuple[np.ndarray, np.ndarray, Array]]:
            there = np.flatnonzero(other.any(axis=(0, 1, 3, 4)))
            table = other.swapaxes(1, 2).reshape(count, size, 1, (DEGREE + 1) * own, -1)
            return [(left[right == b], target[right == b], table[:, b]) for b in there]

        def times(n: int, others: list[tuple[np.ndarray, np.ndarray, Array]], columns: int) -> Array:
            last, found = min(n, DEGREE) + 1, np.zeros((count, size, own, columns))
            earlier = every[:, :, :, terms + 1 - n : terms + 1 - n + last].reshape(count, size, own, last * own)
            for mine, place, other in others:
                found[:, place] += earlier[:, mine] @ other[:, :, : last * own]
            return found

        of_A, of_F, columns, found = factors(A), factors(F), F.shape[4], []
        for n in range(terms + 1):
            found.append(times(n, of_F, columns).reshape(count, size * own, columns))
            every[:, :, :, terms - n] = times(n, of_A, own) / (n + 1)
        return np.stack(found, axis=1)

    def _recentred(self, segments: np.ndarray, times: Array, steps: Array, length: Array) -> tuple[Array, Array]:
        """The coefficients of ``[A F]`` times a ``length (k,)`` in powers of the share of ``steps (k,)`` that are made
        from ``times (k,)``, ``(k, DEGREE + 1, d, d + m + mw)``; and what they are made of, before anything cancels."""
        moved, given = self._moved(segments, times, steps), self._first
        every = given[segments].reshape(times.size, DEGREE + 1, -1)
        shape, factor = (times.size, *given.shape[1:]), length[:, None, None, None]
        return (moved @ every).reshape(shape) * factor, (np.abs(moved) @ np.abs(every)).reshape(shape) * factor

    def _moved(self, segments: np.ndarray, times: Array, steps: Array) -> Array:
        """What makes of coefficients on segments those in powers of the share of ``steps (k,)`` that are made from
        ``times (k,)``, ``(k, DEGREE + 1, DEGREE + 1)``."""
        centre = (self.ends[segments] + self.ends[segments + 1]) / 2
        radius = (self.ends[segments + 1] - self.ends[segments]) / 2
        at, share = (times - centre) / radius, steps / radius
        orders, binomials = _binomials(DEGREE)
        beyond = np.maximum(orders - orders[:, None], 0)
        return np.asarray(binomials * (at[:, None] ** orders)[:, beyond] * (share[:, None] ** orders)[:, :, None])

    @property
    def own(self) -> int:
        """How many states make all the others: of coefficients of polynomials the constant ones."""
        return self.units.size if self.spread is None else self.spread.d

    @cached_property
    def _first(self) -> Array:
        """The ``coefficients`` without the columns that follow from those before them."""
        if self.spread is None:
            return self.coefficients
        return np.concatenate([self.coefficients[..., : self.own], self.coefficients[..., self.units.size :]], axis=3)

    def _norm(self, columns: Array, ratio: float = 1.0) -> Array:
        """At most the norm of largest row sums, in own units, of matrices of which the first columns are these, ``(...,
        d, own)``; of coefficients of polynomials a degree more counts ``ratio`` times as much."""
        sums = (np.abs(columns) * self.units[: self.own] / self.units[:, None]).sum(axis=-1)
        if self.spread is None:
            return np.asarray(sums.max(axis=-1))
        apart = sums.reshape(*sums.shape[:-1], -1, self.own).max(axis=-1)
        return np.asarray((apart * ratio**self.spread.space.degrees).sum(axis=-1))

    def off(self, starts: Array, stops: Array, ratios: Sequence[float]) -> Array:
        """What transitions over intervals within one segment each are off by, in the norms in which a degree more
        counts one of the ``ratios (r,)`` times as much, ``(r, k)``."""
        segments, length = self.segment_of((starts + stops) / 2), stops - starts
        table = segments, *self._recentred(segments, starts, length, length), length
        summed = self._majorant(*table)
        return np.array([self._majorant(*table, ratio, summed).error for ratio in ratios])

    def of_all(self, sizes: Array) -> Array:
        """What all states make at most, ``(..., d)``, from the ``sizes (..., d)`` that the first ones make: of
        coefficients of polynomials the sums over products."""
        if self.spread is None:
            return sizes
        left, _, target = self.spread.space.products
        below = np.zeros((self.spread.space.size, self.spread.space.size))
        below[target, left] = 1.0
        return np.asarray((below @ sizes.reshape(*sizes.shape[:-1], -1, self.own)).reshape(sizes.shape))

    def _summed(self, A: Array, driven: Array, terms: int, degree: int, size: int) -> Array:
        """The sum ``(k, size own, own + n)`` of the series of ``x' = A x + driven`` from those of ``A (k, p, size own,
        own)`` and of what is ``driven (k, p, size own, n)``, as far as ``degree`` of these; of states that are ``size``
        coefficients of polynomials in the `spread`, by products of polynomials."""
        count, own, wide = len(A), A.shape[3], A.shape[3] + driven.shape[3]
        left, right, target = NUMBERS if size == 1 or self.spread is None else self.spread.space.products
        law = A[:, : degree + 1].reshape(count, degree + 1, size, own, own)
        pushes = driven[:, : degree + 1].reshape(count, degree + 1, size, own, driven.shape[3]).swapaxes(2, 3)
        there = [b for b in range(size) if law[:, :, b].any()]
        factors = [(right[left == b], target[left == b]) for b in there]
        over = law[:, :, there].transpose(0, 2, 3, 1, 4).reshape(count, len(there) * own, (degree + 1) * own)
        # the latest term comes first, so that those that meet one another lie side by side
        every = np.zeros((count, terms + 1, own, size, wide))
        every[:, terms, :, 0, :own] = np.eye(own)
        for n in range(terms):
            last = min(n, degree) + 1
            earlier = every[:, terms - n : terms - n + last].reshape(count, last * own, size * wide)
            made = (over[:, :, : last * own] @ earlier).reshape(count, len(there), own, size, wide)
            nexts = every[:, terms - n - 1]
            for b, (mine, place) in enumerate(factors):
                nexts[:, :, place] += made[:, b][:, :, mine]
            if n <= degree:
                nexts[..., own:] += pushes[:, n]
            nexts /= n + 1
        total = every.sum(axis=1)  # smallest terms first
        return np.asarray(total.swapaxes(1, 2).reshape(count, size * own, wide))

    @property
    def expansions(self) -> tuple[Expansion, ...]:
        """This one: there are no parts of parameters."""
        return (self,)

    def over(self, starts: Array, stops: Array, points: Array) -> tuple[Array, Array]:
        """Return what intervals make of states and inputs, in the form of `Parts.over`; it is known, and ``points`` say
        nothing."""
        flow = self.flow(starts, stops)
        return flow.state[None], np.concatenate([flow.control, flow.disturbance], axis=2)[None]

    def along(self, starts: Array, stops: Array, parameters: Array) -> tuple[Array, Array]:
        """Return the same in the form of `Parts.along`."""
        state, inputs = self.over(starts, stops, parameters)
        return state[0], inputs[0]

    def entries(self, times: Array, parameters: Array) -> tuple[Array, Array]:
        """Return ``A`` and ``[B E]`` at times, in the form of `Parts.entries`."""
        return self.at(times)

    def averages(self, breaks: Array, points: Array) -> Array:
        """Return about what ``A`` is, in the form of `Parts.averages`."""
        return np.asarray(self.average(breaks))[None]

    def on_cell(self, law: Spread, low: Array, high: Array) -> Expansion:
        """Return the expansion of the state on a cell of parameters, on the same segments, from that of the law.

        Parameters
        ----------
        law : Spread
            How the law depends on the parameters, in the part of them that this expansion is of.
        low, high : Array
            Ends ``(nu,)`` of the cell, which lies in that part.

        Returns
        -------
        Expansion
            The system of all coefficients of the state, as polynomials that are from -1 to 1 on the cell. What the law
            has beyond their degree is in the `Spread.left` of its ``spread``.
        """
        d, moved, (given, lost) = law.d, law.recentred(low, high), self._law(law)
        sizes = np.abs(given).sum(axis=1)
        rest = np.einsum("ab,sbij->saij", np.abs(moved), lost + rounding(8 * law.space.size) * sizes)
        every = np.einsum("ab,snbij->snaij", moved, given)
        how, kept = law.on_cell(low, high, self.ends, np.abs(every).sum(axis=1) + rest)
        space = how.space
        place = np.array([space.index[tuple(one)] for one in law.space.exponents[kept].tolist()], dtype=int)
        table = np.zeros((*every.shape[:2], space.size, *every.shape[3:]))
        table[:, :, place] = every[:, :, kept]
        beside = np.zeros((len(rest), space.size, *rest.shape[2:]))
        beside[:, place] = rest[:, kept] * (1.0 + 1e-9)

        def filled(law: Array) -> Array:  # (..., M, d, d + n)
            first = law.reshape(*law.shape[:-3], how.states, -1)
            A = how.filled(first[..., :d].reshape(-1, how.states, d)).reshape(*first.shape[:-1], how.states)
            return np.concatenate([A, first[..., d:]], axis=-1)

        return Expansion(
            self.ends,
            filled(table),
            filled(beside),
            np.tile(self.units[:d], space.size),
            np.ones((len(rest), how.states)),
            self.channels,
            self.turns,
            how,
        )

    def at_point(self, law: Spread, parameter: Array) -> Expansion:
        """Return the expansion of the known system at a ``parameter (nu,)``, from that of the law, which depends on the
        parameters as ``law`` says; what is left out of the series in the parameters is not in its remainder."""
        powers = law.space.monomials(law.shares(parameter[None]))[0]
        given, lost = self._law(law)
        every, rest = np.einsum("a,snaij->snij", powers, given), np.einsum("a,saij->sij", np.abs(powers), lost)
        rest = rest + rounding(8 * powers.size) * np.einsum("a,saij->sij", np.abs(powers), np.abs(given).sum(axis=1))
        units, ones = self.units[: law.d], np.ones((len(rest), law.d))
        return Expansion(self.ends, every, rest, units, ones, self.channels, self.turns)

    def largest_inputs(self, law: Spread) -> Array:
        """How large ``[B E]`` is at any parameter and time of every segment, at most, ``(s, d, m + mw)``."""
        given, lost = self._law(law)
        return np.asarray((np.abs(given).sum(axis=(1, 2)) + lost.sum(axis=1))[..., law.d :])

    def _law(self, law: Spread) -> tuple[Array, Array]:
        """The coefficients of the law in time and parameters, ``(s, p + 1, M, d, d + m + mw)``, and what those of every
        parameter leave out, ``(s, M, d, d + m + mw)``."""
        lost = np.concatenate([self.remainder[..., : law.d], self.remainder[..., self.units.size :]], axis=2)
        shape = law.space.size, law.d, lost.shape[2]
        return self._first.reshape(*self._first.shape[:2], *shape), lost.reshape(len(lost), *shape)

    def _within(self, segments: np.ndarray, starts: Array, stops: Array) -> tuple[Array, ...]:
        """`flow` of intervals within one segment each, with control and disturbance side by side."""
        length = stops - starts
        law, bulk = self._recentred(segments, starts, length, length)
        majorant = self._majorant(segments, law, bulk, length)
        A, driven = law[..., : self.own], law[..., self.own :]
        size = 1 if self.spread is None else self.spread.space.size
        total = self._summed(A, driven, majorant.terms, majorant.degree, size)
        flown = total[..., : self.own] if self.spread is None else self.spread.filled(total[..., : self.own])
        return flown, total[..., self.own :], majorant.error, majorant.sizes

    def _majorant(
        self,
        segments: np.ndarray,
        law: Array,
        bulk: Array,
        length: Array,
        ratio: float = 1.0,
        summed: Majorant | None = None,
    ) -> Majorant:
        """Of a series whose coefficients are at most those of ``y' = a(s) y + b(s)`` in the norm of largest row sums in
        own units, with the norms ``a_k`` and ``b_k`` of the coefficients of the system: how many of its terms are
        needed, and of the system's coefficients, which are then left out like the ``remainder``.

        What is missed is Cauchy's tail ``y(R) R^-N / (R - 1)`` for the best ``R``; what is left out of the system, by
        variation of constants ``r e^(a + r)``; and rounding, of the coefficients ``bulk`` before anything cancels in
        them, of every term, and of the sum, whose first term is exact. In the norm of a ``ratio`` (`off`) of a series
        that is ``summed`` as far as in that of another.
        """
        d, own = self.units.size, self.own
        rest = self.remainder[segments] * length[:, None, None]
        inputs = _totals(self._driven(law[..., own:]), self._driven(rest[..., d:]))[0]
        law, bulk, rest = (self._steady(segments, one) for one in (law, bulk, rest))
        sizes = self._norm(law[..., :own], ratio)
        pushes, lost = self._driven(law[..., own:]), self._driven(rest[..., d:])
        most = _totals(pushes, lost)[1]
        shares = (pushes / most[:, None]).max(axis=(2, 3), initial=0.0)
        seen = (np.maximum(sizes, shares) > IDLE * np.maximum(sizes.sum(axis=1), 1e-300)[:, None]).any(axis=0)
        degree = int(np.flatnonzero(seen).max(initial=0)) if summed is None else summed.degree
        a = sizes.sum(axis=1)
        r = self._norm(rest[..., :own], ratio) + sizes[:, degree + 1 :].sum(axis=1)
        share = (lost / most).max(axis=(1, 2), initial=0.0) + shares[:, degree + 1 :].sum(axis=1)
        terms, tail = _tail(sizes, shares, None if summed is None else summed.terms)
        fuller = self._norm(bulk[..., :own].sum(axis=1), ratio)
        fuller += (self._driven(bulk[..., own:]).sum(axis=1) / most).max(axis=(1, 2), initial=0.0)
        growth = np.exp(a + r)
        rounded = rounding((degree + 1) * own * self._there.size + terms) * np.minimum(a, 1.0)
        rounded += rounding(DEGREE) * fuller
        error = tail + (r + share) * growth + (rounded * (1.0 + a) + EPSILON) * growth
        return Majorant(terms, degree, error * self.ratios[segments].max(axis=1) * (1.0 + 1e-9), inputs)

    def _steady(self, segments: np.ndarray, table: Array) -> Array:
        """A ``table (k, ..., d, n)`` of ``[A F]`` on segments as it is where states are counted in `ratios`."""
        ratios = self.ratios[segments]
        if (ratios == 1.0).all():
            return table
        ratios = ratios.reshape(ratios.shape[0], *([1] * (table.ndim - 3)), -1)
        d, found = self.units.size, table / ratios[..., None]
        found[..., :d] *= ratios[..., None, :]
        return np.asarray(found)

    @cached_property
    def together(self) -> list[np.ndarray]:
        """The states of every part that ``A`` couples with nothing else: what is off in one is so in no other."""
        d = self.units.size
        return _coupled(np.abs(self.coefficients[..., :d]).max(axis=(0, 1)) + self.remainder[..., :d].max(axis=0))

    def over_parts(self, entries: Array) -> Array:
        """The largest of the ``entries (..., d, n)`` of states that belong together, for each of them."""
        if len(self.together) == 1:
            return np.broadcast_to(entries.max(axis=-2, keepdims=True), entries.shape)
        found = np.empty(entries.shape)
        for part in self.together:
            found[..., part, :] = entries[..., part, :].max(axis=-2, keepdims=True)
        return found

    def _driven(self, entries: Array) -> Array:
        """What ``entries (..., d, m + mw)`` of ``[B E]`` make of every part at most, in own units, state by state."""
        return self.over_parts(np.abs(entries) / self.units[:, None])

    @cached_property
    def slack(self) -> float:
        """The errors of the flows over all segments, one after another: how much of what is added up to a state at the
        end of the horizon is not resolved."""
        return float(self.flow(self.ends[:-1], self.ends[1:]).error.sum())


class Segment(NamedTuple):
    """A segment of the horizon: whether what a polynomial of the time leaves out of the system there is small enough
    (``sharp``), else ``why`` a pole may be there; what it leaves out as a share, ``off``; and the ``parts`` of an
    `Expansion`: coefficients, remainder, ratios."""

    sharp: bool
    off: float
    why: str
    parts: tuple[Array, ...] = ()


@dataclass(frozen=True, eq=False)
class Look:
    """How a system is looked at on segments: in ``units (d,)``, where its largest matrix has the norm ``size``;
    ``steadies``: in units of a segment's own, where these help."""

    space: TaylorSpace
    units: Array
    size: float
    steadies: bool

    def at(self, law: Phase, start: float, stop: float, before: float) -> Segment:
        """The segment from ``start`` to ``stop``; twice as long a one left ``before`` out."""
        units, centre, own = self.units, (start + stop) / 2, np.ones(self.units.size)
        radius = float(np.nextafter(max(stop - centre, centre - start), np.inf))
        try:
            parts = law.taylor(self.space, np.array([centre]), np.array([radius]))
        except NotEnclosable as error:
            return Segment(False, np.inf, f"has a pole, or is no real number ({error})")
        coefficients, rest = np.concatenate(parts[0::2], axis=2), np.concatenate(parts[1::2], axis=1)
        off, here = _sharpness(coefficients, rest, units, self.size)
        here *= stop - start
        sharp = here <= LONG and (off <= SHARPEST or before / 2 <= off <= BLUNTEST)  # or halving does not help
        if here > LONG and self.steadies:
            largest = (np.abs(coefficients).sum(axis=0) + rest)[:, : units.size] / units[:, None] * units
            if (steady := steadied(largest, stop - start)) is not None:
                missed = _lost(coefficients, rest, units * steady, stop - start) * float(steady.max())
                own, sharp = steady, missed <= SHARPEST
        return Segment(sharp, off, "has a pole, or is too steep to be enclosed", (coefficients, rest, own))

    def length(self, law: Phase, time: float, longest: float, shortest: float) -> float:
        """About how long a segment around a ``time`` may be, halving after halving of the ``longest``; infinite where
        even the ``shortest`` is too long: then there is a pole, and not a number of segments."""
        before = np.inf
        while longest > shortest:
            segment = self.at(law, time - longest / 2, time + longest / 2, before)
            if segment.sharp:
                return longest
            before, longest = segment.off, longest / 2
        return np.inf


def _cut(begin: float, until: float, horizon: float) -> list[float]:
    """The ends of the segments to begin with of a law between two times."""
    return list(np.linspace(begin, until, ceil(FIRST * (until - begin) / horizon) + 1).tolist())


def _require_few(system: System, look: Look, ends: Sequence[float]) -> None:
    """Raise `InputError` where the segments between ``ends``, and those that the rest of the horizon takes, are more
    than can be followed; these are counted by how long some of them are."""
    done, horizon = ends[-1], system.horizon
    needed = float(len(ends) - 1)
    for law in system.phases:
        begin = law.begin
        each = (law.until - max(begin, done)) / SAMPLED
        for k in range(SAMPLED if each > 0.0 else 0):
            time = max(begin, done) + (k + 0.5) * each
            needed += each / look.length(law, time, each, SHORTEST * horizon)
    if needed > MOST:
        raise InputError(
            f"it changes so fast that it would take some {needed:.1g} segments of the horizon, each a polynomial of the"
            f" time, and {MOST} can be followed; a shorter horizon takes fewer, or entries without what is so fast",
            path="system",
        )


@cache
def _binomials(degree: int) -> tuple[np.ndarray, Array]:
    """The orders up to a degree, and how often each is made of each: ``k`` over ``n``, ``(degree + 1, degree + 1)``."""
    orders = np.arange(degree + 1)
    return orders, np.array([[comb(k, n) for k in orders.tolist()] for n in orders.tolist()], dtype=float)


def _tail(sizes: Array, shares: Array, summed: int | None = None) -> tuple[int, Array]:
    """How many terms of a series are summed whose coefficients are at most those of ``y' = a(s) y + b(s)``, with the
    coefficients ``sizes (k, p)`` and ``shares (k, p)`` of these, unless so many are ``summed`` anyway; and what is left
    out, ``(k,)``: Cauchy's tail ``y(R) R^-N / (R - 1)`` for the best ``R``."""
    orders, R = np.arange(1.0, sizes.shape[1] + 1), np.array(CIRCLES)[:, None]
    with np.errstate(over="ignore", invalid="ignore"):
        circles = R**orders / orders
        grown = np.exp(sizes @ circles.T) * np.maximum(1.0, shares @ circles.T) / (R[:, 0] - 1.0)
        for terms in (*(one for one in FEWER if one < TERMS), TERMS) if summed is None else (summed,):
            tail = np.fmin.reduce(grown * R[:, 0] ** -float(terms), axis=1, initial=np.inf)
            if (tail <= IDLE).all():
                break
    return terms, tail


def _spread_of(system: System) -> Spread | None:
    """The polynomials of which the states of a system are the coefficients, where they are."""
    entry = system.phases[0].entry("A")
    depends = entry.dependence if isinstance(entry, Superposed) else None
    return depends if isinstance(depends, Spread) else None


def _coupled(A: Array) -> list[np.ndarray]:
    """The numbers of the states that ``A (d, d)`` couples with one another, part by part."""
    from scipy.sparse.csgraph import connected_components

    count, part = connected_components(A != 0.0, directed=False)
    return [np.flatnonzero(part == k) for k in range(count)]


def _totals(pushes: Array, lost: Array) -> tuple[Array, Array]:
    """The sums over orders of ``pushes (k, p, d, n)``, and at least so much that what is ``lost (k, d, n)`` is a share
    of `BLUNTEST` of it, also where they cancel; and what to divide by."""
    inputs = np.maximum(pushes.sum(axis=1), lost / BLUNTEST)
    return inputs, np.where(inputs > 0.0, inputs, np.inf)


def steadied(A: Array, length: float) -> Array | None:
    """Units ``(d,)``, powers of two from 1 on, in which the norm of largest row sums of a system of at most ``A (d,
    d)``, times a length, is at most twice `SLOW`; ``None`` where none are found.

    With ``M`` the product and ``g`` that number, ``u = (1 - M / g)^-1 1`` has ``M u = g (u - 1)``; rounded up to powers
    of two the row sums at most double. There is such a ``u`` where the spectral radius of ``M`` is below ``g``:
    of a motion that is slow here and fast elsewhere it is, though its norm in units of the fast part is not.
    """
    M = A * (length / SLOW)
    try:
        units = np.linalg.solve(np.eye(len(M)) - M, np.ones(len(M)))
    except np.linalg.LinAlgError:
        return None
    if not (np.isfinite(units).all() and units.min() > 0.0):
        return None
    units = np.exp2(np.ceil(np.log2(np.maximum(units, 1.0))))
    return units if ((A * length) @ units <= 2.0 * SLOW * units).all() else None


def _lost(coefficients: Array, rest: Array, units: Array, length: float) -> float:
    """What a segment of this length misses: of states in these ``units``, in the norm of largest row sums, and of what
    drives them as a share."""
    d = units.size
    off = float((rest[:, :d] * units / units[:, None]).sum(axis=1).max()) * length
    driven, lost = (one / units[:, None] for one in (np.abs(coefficients[:, :, d:]).sum(axis=0), rest[:, d:]))
    most = np.where(driven.max(axis=0, initial=0.0) > 0.0, driven.max(axis=0, initial=0.0), np.inf)
    return max(off, float((lost / most).max(initial=0.0)))


def _sharpness(coefficients: Array, rest: Array, units: Array, size: float) -> tuple[float, float]:
    """What a segment's remainder is of the numbers themselves, and the norm of ``A`` on it; ``size`` is that on the
    whole horizon."""
    d, scale = units.size, units / units[:, None]
    largest = np.abs(coefficients).sum(axis=0)
    here = float((largest[:, :d] * scale).sum(axis=1).max())
    off = float((rest[:, :d] * scale).sum(axis=1).max()) / max(here, size, np.finfo(float).tiny)
    most = np.where(rest[:, d:] > 0.0, largest[:, d:].max(axis=0), np.inf)
    for part in _coupled(largest[:, :d] + rest[:, :d]):
        mine = largest[part, d:].max(axis=0)
        most[part] = np.where(mine > 0.0, np.minimum(most[part], mine), most[part])
    return max(off, float((rest[:, d:] / most).max(initial=0.0))), here


def balanced(A: Array, horizon: float) -> Array:
    """Units ``(d,)`` of the states, powers of two, in which ``A`` has rows and columns of like size (Osborne 1960); a
    state that another one does not reach counts as reached by a little."""
    rates = np.abs(A) * horizon
    np.fill_diagonal(rates, 0.0)
    weak = np.where(rates > 0.0, 1.0 / np.where(rates > 0.0, rates, 1.0), 0.0).T
    rates = np.where(rates > 0.0, rates, weak)
    exponents = np.zeros(A.shape[0])
    for _ in range(SWEEPS):
        for i in range(exponents.size):
            scaled = np.exp2(exponents)
            row, column = (rates[i] * scaled).max() / scaled[i], (rates[:, i] / scaled).max() * scaled[i]
            if row > 0.0 and column > 0.0:
                exponents[i] += (np.log2(row) - np.log2(column)) / 2
    return np.asarray(np.exp2(np.clip(np.round(exponents - exponents.mean()), -500, 500)))
