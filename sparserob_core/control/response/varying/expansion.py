"""Transitions of systems that change with time, with a proven bound of their error.

The system is enclosed on segments of the horizon as polynomials in time with a remainder (Taylor models, whose segments
follow the radius of convergence). Over an interval within one segment, the solution is the power series of its own
equation. Its truncation error is bounded entry by entry by the series of the absolute values, which majorises it. The
effect of the remainder is bounded by the formula of variation of constants.
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

from sparserob_core.control.enclosures.cache import remember
from sparserob_core.control.enclosures.dependence import ExpandedSystem, Superposed
from sparserob_core.control.problem.phase import Phase, PhaseInUnits
from sparserob_core.control.problem.system import System
from sparserob_core.errors import InputError, NotEnclosable
from sparserob_core.shapes import Float, shaped
from sparserob_core.sip.convex_set import Array
from sparserob_core.sip.expressions.rounding import EPSILON, rounding
from sparserob_core.sip.expressions.taylor import TaylorSpace

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
_CACHE: WeakKeyDictionary[Phase, dict[tuple[object, ...], Expansion]] = WeakKeyDictionary()
RESPONSES_KEPT = 4  # sets of intervals whose responses are remembered: those of pieces, and of the times of three grids
FIRST = 8  # segments to begin with
MAX_SEGMENTS = 100_000
"""Segments at most. Ten times as many take an hour and gigabytes; of a tenth systems would be refused that are solved
in a minute."""
LOOKED = 256  # segments after which the rest is estimated: a tenth of a second of work; ten times as many are a second
SAMPLED = 16  # times at which it is; a tenth of them miss where a system is fast, ten times as many take a second
SWEEPS = 20  # of balancing
NUMBERS = np.zeros((3, 1), dtype=int)  # the products of polynomials that are numbers


class Flow(NamedTuple):
    """Response over ``k`` intervals to the state at their beginning, ``state (k, d, d)``, and to inputs that are
    constant on them, ``control (k, d, m)`` and ``disturbance (k, d, mw)``.

    ``error (k,)``: error bound in the norm of largest row sums, in the coordinates of `Expansion.units`. For the
    columns of inputs it is multiplied by ``sizes (k, d, m + mw)``, the largest forcing of the states that ``A`` couples
    with each one.
    """

    state: Array
    control: Array
    disturbance: Array
    error: Array
    sizes: Array


class Kernel(NamedTuple):
    """Response at the end of ``k`` intervals to inputs at any time ``s`` on them: ``Phi(end, s) F(s)`` times the length
    of the interval, as polynomials in the share of the interval that remains at ``s``, ``terms (k, p + 1, d, m + mw)``.

    ``error (k,)``, times ``sizes (k, d, m + mw)``: error bound of the entries in the coordinates of `Expansion.units`.
    """

    terms: Array
    error: Array
    sizes: Array


class Majorant(NamedTuple):
    """Truncation of the series of a flow, with its error bound.

    ``terms``: the number of its terms. ``degree``: that of the system's coefficients that are used. ``error (k,)``: the
    error bound. ``sizes (k, d, m + mw)``: the largest forcing of the states.
    """

    terms: int
    degree: int
    error: Array
    sizes: Array


@dataclass(frozen=True, eq=False)
class Expansion:
    """System as polynomials on segments of time between ``ends (s + 1,)``.

    ``coefficients (s, p + 1, d, d + m + mw)``: those of ``[A B E]`` in powers of the time from -1 to 1 over each
    segment, up to the highest one that any entry has. ``remainder (s, d, d + m + mw)``: the bounds of their error.

    ``units (d,)``: units of the states, in which no entry of ``A`` is much larger than the others. ``ratios (s, d)``:
    the units of a segment over these, at least 1 (`steadied`). ``turns``: the indices of the ends at which another law
    begins. ``spread``: the polynomials whose coefficients the states are.
    """

    ends: Array
    coefficients: Array
    remainder: Array
    units: Array
    ratios: Array
    channels: tuple[int, int]
    turns: tuple[int, ...] = ()
    spread: ExpandedSystem | None = None

    @staticmethod
    def of(system: System) -> Expansion:
        """Return the expansion of a system. Raise `InputError`, which names a time, where there is none, as at a pole
        or at the root of a negative number."""
        first, user_system = system.phases[0], system.stated
        kept = _CACHE.setdefault(first, {})
        key = system.horizon, *((phase.begin, ref(phase)) for phase in system.phases[1:])
        if key not in kept:
            kept[key] = (
                Expansion._expand_system(system)
                if user_system is system
                else Expansion.of(user_system)._convert_units(system)
            )
        return kept[key]

    def _convert_units(self, system: System) -> Expansion:
        law = system.phases[0]
        assert isinstance(law, PhaseInUnits)
        factors = np.hstack([law.factors[name] * np.ones(shape) for name, shape in self._shapes])
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
    def _expand_system(system: System) -> Expansion:
        space, horizon = TaylorSpace(1, DEGREE), system.horizon
        A = np.max([np.abs(np.asarray(mode.A, dtype=float)) for mode in system.modes], axis=0)
        spread = _find_parametric_expansion(system)
        units = balanced(A, horizon)
        if spread is not None:  # the same for every coefficient, so that norms are those of a ring
            units = np.tile(balanced(A[: spread.d, : spread.d], horizon), spread.space.size)
        size = float((np.abs(A) / units[:, None] * units).sum(axis=1).max())
        look = Look(space, units, size, spread is None)
        todo = [
            (start, stop, np.inf, law)
            for law in system.phases
            for start, stop in pairwise(_divide_into_segments(law.begin, law.until, horizon))
        ][::-1]
        ends, segments = [0.0], list[Segment]()
        while todo:
            start, stop, before, law = todo.pop()
            segment = look.at(law, start, stop, before)
            centre = (start + stop) / 2
            if segment.sharp:
                ends.append(stop)
                segments.append(segment)
                if len(segments) in (LOOKED, MAX_SEGMENTS):
                    _require_few_segments(system, look, ends)
            elif stop - start <= SHORTEST * horizon:
                raise InputError(f"near t = {centre:.9g} the system {segment.why}", path="system")
            else:
                todo += [(centre, stop, segment.off, law), (start, centre, segment.off, law)]
        turns = tuple(ends.index(law.begin) for law in system.phases[1:])
        channels = system.controls, system.disturbances
        coefficients, remainders, ratios = (
            np.array(arrays) for arrays in zip(*(segment.parts for segment in segments), strict=True)
        )
        highest = int(np.flatnonzero(coefficients.any(axis=(0, 2, 3))).max(initial=0))  # 0 for a constant system
        coefficients = coefficients[:, : highest + 1]
        return Expansion(np.array(ends), coefficients, remainders, units, ratios, channels, turns, spread)

    @shaped
    def flow(self, starts: Float[Array, " k"], stops: Float[Array, " k"]) -> Flow:
        """Return the response over each of the intervals to states and inputs."""
        d, (m, mw) = self.units.size, self.channels
        shape = (starts.size, d, m + mw)
        state, inputs = np.tile(np.eye(d), (starts.size, 1, 1)), np.zeros(shape)
        error, sizes = np.zeros(starts.size), np.zeros(shape)

        def follow(here: np.ndarray, step: Array, driven: Array, off: Array, input_sizes: Array) -> None:
            before = state[here], inputs[here], error[here], sizes[here]
            state[here], inputs[here] = step @ before[0], step @ before[1] + driven
            error[here], sizes[here] = self._bound_product_error(before, step, off), before[3] + input_sizes

        first = self.segment_of(starts)
        last = np.clip(np.searchsorted(self.ends, stops, side="left") - 1, first, self.ends.size - 2)
        nonempty = np.flatnonzero(stops > starts)
        if nonempty.size:
            ends = np.where(last > first, self.ends[first + 1], stops)  # the last one holds what is behind the horizon
            responses = self._compute_segment_responses(first[nonempty], starts[nonempty], ends[nonempty])
            state[nonempty], inputs[nonempty], error[nonempty], sizes[nonempty] = responses
        for n in range(1, int((last - first).max(initial=0))):
            active = nonempty[(first + n < last)[nonempty]]
            follow(active, *(array[first[active] + n] for array in self._segment_responses))
        active = nonempty[(last > first)[nonempty]]
        if active.size:
            follow(active, *self._compute_segment_responses(last[active], self.ends[last[active]], stops[active]))
        return Flow(state, inputs[..., :m], inputs[..., m:], error, sizes)

    @shaped
    def at_parameters(
        self, starts: Float[Array, " k"], stops: Float[Array, " k"], powers: Float[Array, "v k1 M"]
    ) -> tuple[Float[Array, "v k d d"], Float[Array, "v k d n"]]:
        """Return the response over intervals to the state and to inputs, of a law that is a polynomial in its
        parameters, without bounds of its error.

        Parameters
        ----------
        starts, stops : Array
            Times ``(k,)``.
        powers : Array
            Monomials ``(v, k, M)`` at the parameters of every interval, or ``(v, 1, M)`` where these are the same.

        Returns
        -------
        Array, Array
            The transitions ``(v, k, d, d)``; and the responses to constant inputs, those to the disturbance after the
            others, ``(v, k, d, n)``.
        """
        if (by_monomial := self._inputs_by_monomial) is not None:
            state, inputs = by_monomial._respond_once(starts, stops)
            inputs = inputs.reshape(starts.size, self.own, -1, sum(self.channels))
            powers = np.broadcast_to(powers, (len(powers), starts.size, powers.shape[2]))[..., self._nonzero_monomials]
            return np.broadcast_to(state, (len(powers), *state.shape)), np.einsum("vka,kiaj->vkij", powers, inputs)
        own, shape = self.own, (len(powers), starts.size)
        state, inputs = np.tile(np.eye(own), (*shape, 1, 1)), np.zeros((*shape, own, sum(self.channels)))
        first = self.segment_of(starts)
        last = np.clip(np.searchsorted(self.ends, stops, side="left") - 1, first, self.ends.size - 2)
        for n in range(int((last - first).max(initial=-1)) + 1):
            active = np.flatnonzero((first + n <= last) & (stops > starts))
            if not active.size:
                continue
            segments = first[active] + n
            begins = np.maximum(starts[active], self.ends[segments])
            ends = np.where(segments < last[active], self.ends[segments + 1], stops[active])
            step = self._compute_parameter_responses(
                segments, begins, ends, powers if powers.shape[1] == 1 else powers[:, active]
            )
            state[:, active] = step[..., :own] @ state[:, active]
            inputs[:, active] = step[..., :own] @ inputs[:, active] + step[..., own:]
        return state, inputs

    def _compute_parameter_responses(self, segments: np.ndarray, starts: Array, stops: Array, powers: Array) -> Array:
        """Return the responses of `at_parameters` over intervals within one segment each, side by side, ``(v, k, d, d +
        n)``."""
        size, own, orders = powers.shape[2], self.own, self.orders
        nonzero, length = self._nonzero_monomials, stops - starts
        distinct, indices = np.unique(segments, return_inverse=True)
        coefficients = self._own_coefficients[distinct].reshape(distinct.size, orders, size, own, -1)[:, :, nonzero]
        shape = (len(powers), starts.size, orders, own, coefficients.shape[4])
        if powers.shape[1] == 1:
            values = np.einsum("va,snaij->vsnij", powers[:, 0, nonzero], coefficients)[:, indices.reshape(-1)]
        else:
            values = np.einsum("vka,knaij->vknij", powers[:, :, nonzero], coefficients[indices.reshape(-1)])
        recentring = self._build_recentring(segments, starts, length) * length[:, None, None]
        law = (recentring @ values.reshape(*shape[:3], -1)).reshape(-1, *shape[2:])
        units = self.units[:own, None]
        sizes = (np.abs(law[..., :own]) * units[:, 0] / units).sum(axis=3).max(axis=2)
        forcing = np.abs(law[..., own:]) / units
        totals = forcing.sum(axis=1).max(axis=1)
        shares = (forcing / np.where(totals > 0.0, totals, np.inf)[:, None, None]).max(axis=(2, 3), initial=0.0)
        terms, _ = _bound_tail(sizes, shares)
        responses = self._sum_series(law[..., :own], law[..., own:], terms, orders - 1, 1)
        return responses.reshape(*shape[:2], own, -1)

    @cached_property
    def _inputs_by_monomial(self) -> Expansion | None:
        """The known system whose inputs are those of every monomial in the parameters, side by side; ``None`` where
        ``A`` depends on parameters. Its responses are those at any parameters but for sums over monomials."""
        if self.spread is None:
            return None
        own, count = self.own, sum(self.channels)
        law = self._own_coefficients.reshape(*self._own_coefficients.shape[:2], -1, own, own + count)
        if law[:, :, 1:, :, :own].any():
            return None
        inputs = law[:, :, self._nonzero_monomials, :, own:].swapaxes(2, 3).reshape(*law.shape[:2], own, -1)
        coefficients = np.concatenate([law[:, :, 0, :, :own], inputs], axis=3)
        unbounded, ones = np.full(coefficients[:, 0].shape, np.inf), np.ones((len(law), own))
        return Expansion(self.ends, coefficients, unbounded, self.units[:own], ones, (inputs.shape[3], 0), self.turns)

    def _respond_once(self, starts: Array, stops: Array) -> tuple[Array, Array]:
        """Return the responses of a known system over intervals, ``(k, d, d)`` and ``(k, d, n)``, without bounds of
        their error. Equal intervals are followed once, and the last few sets of intervals are remembered."""
        intervals, indices = np.unique(np.stack([starts, stops]), axis=1, return_inverse=True)
        key = intervals.tobytes()
        if key not in self._responses:
            responses = self.at_parameters(intervals[0], intervals[1], np.ones((1, 1, 1)))
            remember(self._responses, key, responses, RESPONSES_KEPT)
        state, inputs = self._responses[key]
        return state[0, indices.reshape(-1)], inputs[0, indices.reshape(-1)]

    @cached_property
    def _responses(self) -> dict[bytes, tuple[Array, Array]]:
        return {}

    @cached_property
    def _nonzero_monomials(self) -> np.ndarray:
        """Indices of the coefficients of polynomials in the parameters that the law has."""
        coefficients = self._own_coefficients.reshape(
            *self._own_coefficients.shape[:2], -1, self.own, self._own_coefficients.shape[3]
        )
        return np.flatnonzero(coefficients.any(axis=(0, 1, 3, 4)))

    def _bound_product_error(self, before: tuple[Array, ...], step: Array, off: Array) -> Array:
        """Return error bounds ``(k,)`` of products ``P S``: ``P`` is a ``step (k, d, d)`` with the error ``off``, and
        ``S`` the response ``before``. The bound is ``off (|S| + error) + |P| error`` and rounding; for inputs it is
        relative to the forcing."""
        state, inputs, error, sizes = before
        forcing = np.where(sizes > 0.0, sizes, np.inf) * self.units[:, None]
        norm = np.maximum(
            self._bound_norm(state[..., : self.own]), (np.abs(inputs) / forcing).max(axis=(1, 2), initial=1.0)
        )
        growth = self._bound_norm(step[..., : self.own])
        bound = off * (norm + error) + growth * error + rounding(self.units.size + 1) * growth * (norm + error)
        return np.asarray(bound * (1.0 + 1e-9))

    @cached_property
    def _segment_responses(self) -> tuple[Array, ...]:
        """Responses (`_compute_segment_responses`) over every segment as a whole."""
        return self._compute_segment_responses(np.arange(self.ends.size - 1), self.ends[:-1], self.ends[1:])

    def segment_of(self, times: Array) -> np.ndarray:
        """Return the segment that contains each time, or begins at it, ``(k,)``."""
        return np.clip(np.searchsorted(self.ends, times, side="right") - 1, 0, self.ends.size - 2)

    @shaped
    def at(self, times: Float[Array, " k"]) -> tuple[Float[Array, "k d own"], Float[Array, "k d n"]]:
        """Return ``A`` and ``[B E]`` at times ``(k,)``, without their remainder; nothing is proven by them.

        Where the states are coefficients of polynomials, only the columns of ``A`` that determine the others are
        returned, ``own`` of them.
        """
        segments, d = self.segment_of(times), self.own
        begin, end = self.ends[segments], self.ends[segments + 1]
        powers = ((2.0 * times - begin - end) / (end - begin))[:, None] ** np.arange(self.orders)
        law = np.einsum("kn,knij->kij", powers, self._own_coefficients[segments])
        return law[..., :d], law[..., d:]

    @shaped
    def average(self, times: Float[Array, " T"]) -> Float[Array, "k d own"]:
        """Return an estimate of ``A`` between ``times (k + 1,)``, by its values at the middles, for callers that need
        the speed of the system."""
        return self.at((times[:-1] + times[1:]) / 2)[0]

    def kernel(self, starts: Array, stops: Array) -> Kernel:
        """Return the kernel of intervals ``(k,)`` within one segment each. With ``Psi(r) = Phi(end, end - r h)``,
        ``Psi' = h Psi A``: a series that is majorised by that of ``y' = a y``, times that of ``F``."""
        d, own, segments = self.units.size, self.own, self.segment_of((starts + stops) / 2)
        length = stops - starts
        law, bulk = self._recentre_coefficients(segments, stops, -length, length)
        remainder = self.remainder[segments] * length[:, None, None]
        A, F, scale = law[..., :own], law[..., own:], self.units / self.units[:, None]
        inputs = _sum_forcing(self._bound_forcing(law[..., own:]), self._bound_forcing(remainder[..., d:]))[0]
        law, bulk, remainder = (self._scale_by_ratios(segments, table) for table in (law, bulk, remainder))
        sizes, bulk_sizes = (self._bound_norm(table[..., :own]) for table in (law, bulk))
        forcing, bulk_forcing = (self._bound_forcing(table[..., own:]) for table in (law, bulk))
        input_errors = self._bound_forcing(remainder[..., d:])
        divisors = _sum_forcing(forcing, input_errors)[1]
        shares = (forcing / divisors[:, None]).max(axis=(2, 3), initial=0.0)
        r = (remainder[..., :d] * scale).sum(axis=2).max(axis=1)
        input_errors = (input_errors / divisors).max(axis=(1, 2), initial=0.0)
        orders, terms, tail = np.arange(float(self.orders)), TERMS, np.zeros(length.size)
        for terms in (*(count for count in FEWER if count < TERMS), TERMS):
            tail = np.full(length.size, np.inf)
            for R in CIRCLES:
                with np.errstate(over="ignore", invalid="ignore"):
                    y = np.exp((sizes * R ** (orders + 1.0) / (orders + 1.0)).sum(axis=1))
                    tail = np.fmin(tail, y * (shares * R**orders).sum(axis=1) * R ** -float(terms) / (R - 1.0))
            if (tail <= IDLE).all():
                break
        kernel_terms = self._compute_kernel_terms(A, F, terms)
        a, a_full = sizes.sum(axis=1), bulk_sizes.sum(axis=1)
        forced = (bulk_forcing.sum(axis=1) / divisors).max(axis=(1, 2), initial=0.0)
        rounded = rounding(self.orders * (d + 4)) * (2.0 + a_full) * np.exp(a_full) * forced
        error = (tail + (r + input_errors * (1.0 + r)) * np.exp(a + r) + rounded) * self.ratios[segments].max(axis=1)
        return Kernel(kernel_terms, error * (1.0 + 1e-9), inputs)

    def _compute_kernel_terms(self, A: Array, F: Array, terms: int) -> Array:
        """Return the terms ``(k, terms + 1, d, m + mw)`` of ``Psi F`` with ``Psi' = Psi A``, ``Psi(0) = I``, from those
        of ``A (k, p + 1, d, own)`` and ``F``. Where the states are coefficients of polynomials, products are as in
        `_sum_series`."""
        (count, orders), own = A.shape[:2], self.own
        A, F = (table.reshape(count, orders, -1, own, table.shape[3]) for table in (A, F))
        size = A.shape[2]
        left_factor, right_factor, target = NUMBERS if self.spread is None else self.spread.space.products
        # the latest term comes first, so that those that meet one another lie side by side
        solution = np.zeros((count, size, own, terms + 2, own))
        solution[:, 0, :, terms + 1] = np.eye(own)

        def factors(other: Array) -> list[tuple[np.ndarray, np.ndarray, Array]]:
            nonzero = np.flatnonzero(other.any(axis=(0, 1, 3, 4)))
            table = other.swapaxes(1, 2).reshape(count, size, 1, orders * own, -1)
            return [(left_factor[right_factor == b], target[right_factor == b], table[:, b]) for b in nonzero]

        def times(n: int, others: list[tuple[np.ndarray, np.ndarray, Array]], columns: int) -> Array:
            last, product = min(n + 1, orders), np.zeros((count, size, own, columns))
            earlier = solution[:, :, :, terms + 1 - n : terms + 1 - n + last].reshape(count, size, own, last * own)
            for sources, targets, table in others:
                product[:, targets] += earlier[:, sources] @ table[:, :, : last * own]
            return product

        of_A, of_F, columns, products = factors(A), factors(F), F.shape[4], []
        for n in range(terms + 1):
            products.append(times(n, of_F, columns).reshape(count, size * own, columns))
            solution[:, :, :, terms - n] = times(n, of_A, own) / (n + 1)
        return np.stack(products, axis=1)

    def _recentre_coefficients(
        self, segments: np.ndarray, times: Array, steps: Array, length: Array
    ) -> tuple[Array, Array]:
        """Return the coefficients of ``[A F]`` times a ``length (k,)`` in powers of the share of ``steps (k,)`` from
        ``times (k,)``, ``(k, p + 1, d, d + m + mw)``; and the sums of absolute numbers from which they are
        computed."""
        recentring, coefficients = self._build_recentring(segments, times, steps), self._own_coefficients
        values = coefficients[segments].reshape(times.size, self.orders, -1)
        shape, factor = (times.size, *coefficients.shape[1:]), length[:, None, None, None]
        return (recentring @ values).reshape(shape) * factor, (np.abs(recentring) @ np.abs(values)).reshape(
            shape
        ) * factor

    def _build_recentring(self, segments: np.ndarray, times: Array, steps: Array) -> Array:
        """Return the matrices ``(k, p + 1, p + 1)`` that turn coefficients on segments into those in powers
        of the share of ``steps (k,)`` from ``times (k,)``."""
        centre = (self.ends[segments] + self.ends[segments + 1]) / 2
        radius = (self.ends[segments + 1] - self.ends[segments]) / 2
        at, share = (times - centre) / radius, steps / radius
        orders, binomials = _compute_binomials(self.orders - 1)
        exponents = np.maximum(orders - orders[:, None], 0)
        return np.asarray(binomials * (at[:, None] ** orders)[:, exponents] * (share[:, None] ** orders)[:, :, None])

    @property
    def orders(self) -> int:
        """Number of powers of the time in the coefficients, 1 for a constant system."""
        return int(self.coefficients.shape[1])

    @property
    def own(self) -> int:
        """Number of states that determine all others. Where the states are coefficients of polynomials, these are the
        constant ones."""
        return self.units.size if self.spread is None else self.spread.d

    @cached_property
    def _own_coefficients(self) -> Array:
        """The ``coefficients`` without the columns that the columns before them determine."""
        if self.spread is None:
            return self.coefficients
        return np.concatenate([self.coefficients[..., : self.own], self.coefficients[..., self.units.size :]], axis=3)

    def _bound_norm(self, columns: Array, ratio: float = 1.0) -> Array:
        """Return an upper bound of the norm of largest row sums, in own units, of matrices whose first columns are
        ``columns (..., d, own)``. For coefficients of polynomials, each further degree counts ``ratio`` times as
        much."""
        sums = (np.abs(columns) * self.units[: self.own] / self.units[:, None]).sum(axis=-1)
        if self.spread is None:
            return np.asarray(sums.max(axis=-1))
        by_monomial = sums.reshape(*sums.shape[:-1], -1, self.own).max(axis=-1)
        return np.asarray((by_monomial * ratio**self.spread.space.degrees).sum(axis=-1))

    def off(self, starts: Array, stops: Array, ratios: Sequence[float]) -> Array:
        """Return error bounds ``(r, k)`` of transitions over intervals within one segment each, in the norms in which
        each further degree counts one of the ``ratios (r,)`` times as much."""
        segments, length = self.segment_of((starts + stops) / 2), stops - starts
        table = segments, *self._recentre_coefficients(segments, starts, length, length), length
        summed = self._compute_majorant(*table)
        return np.array([self._compute_majorant(*table, ratio, summed).error for ratio in ratios])

    def of_all(self, sizes: Array) -> Array:
        """Return bounds ``(..., d)`` for all states from the ``sizes (..., d)`` for the first ones. For coefficients of
        polynomials these are the sums over products."""
        if self.spread is None:
            return sizes
        left_factor, _, target = self.spread.space.products
        below = np.zeros((self.spread.space.size, self.spread.space.size))
        below[target, left_factor] = 1.0
        return np.asarray((below @ sizes.reshape(*sizes.shape[:-1], -1, self.own)).reshape(sizes.shape))

    def _sum_series(self, A: Array, driven: Array, terms: int, degree: int, size: int) -> Array:
        """Return the sum ``(k, size own, own + n)`` of the series of ``x' = A x + driven``.

        The arguments are the series of ``A (k, p, size own, own)`` and of the forcing ``driven (k, p, size own, n)``,
        which are used up to ``degree``. States that are ``size`` coefficients of polynomials in the `spread` use
        products of polynomials.
        """
        count, own, wide = len(A), A.shape[3], A.shape[3] + driven.shape[3]
        left_factor, right_factor, target = NUMBERS if size == 1 or self.spread is None else self.spread.space.products
        law = A[:, : degree + 1].reshape(count, degree + 1, size, own, own)
        forcing = driven[:, : degree + 1].reshape(count, degree + 1, size, own, driven.shape[3]).swapaxes(2, 3)
        nonzero = [b for b in range(size) if law[:, :, b].any()]
        factors = [(right_factor[left_factor == b], target[left_factor == b]) for b in nonzero]
        over = law[:, :, nonzero].transpose(0, 2, 3, 1, 4).reshape(count, len(nonzero) * own, (degree + 1) * own)
        # the latest term comes first, so that those that meet one another lie side by side
        solution = np.zeros((count, terms + 1, own, size, wide))
        solution[:, terms, :, 0, :own] = np.eye(own)
        for n in range(terms):
            last = min(n, degree) + 1
            earlier = solution[:, terms - n : terms - n + last].reshape(count, last * own, size * wide)
            products = (over[:, :, : last * own] @ earlier).reshape(count, len(nonzero), own, size, wide)
            next_terms = solution[:, terms - n - 1]
            for b, (sources, targets) in enumerate(factors):
                next_terms[:, :, targets] += products[:, b][:, :, sources]
            if n <= degree:
                next_terms[..., own:] += forcing[:, n]
            next_terms /= n + 1
        total = solution.sum(axis=1)  # smallest terms first
        return np.asarray(total.swapaxes(1, 2).reshape(count, size * own, wide))

    @property
    def expansions(self) -> tuple[Expansion, ...]:
        """Tuple with this expansion alone: the parameters are not divided into parts."""
        return (self,)

    def over(self, starts: Array, stops: Array, points: Array) -> tuple[Array, Array]:
        """Return the response over intervals to states and inputs, in the form of `ParameterParts.over`. The system is
        known, and ``points`` are not used."""
        flow = self.flow(starts, stops)
        return flow.state[None], np.concatenate([flow.control, flow.disturbance], axis=2)[None]

    def along(self, starts: Array, stops: Array, parameters: Array) -> tuple[Array, Array]:
        """Return the response over intervals to states and inputs, in the form of `ParameterParts.along`."""
        state, inputs = self.over(starts, stops, parameters)
        return state[0], inputs[0]

    def entries(self, times: Array, parameters: Array) -> tuple[Array, Array]:
        """Return ``A`` and ``[B E]`` at times, in the form of `ParameterParts.entries`."""
        return self.at(times)

    def averages(self, breaks: Array, points: Array) -> Array:
        """Return estimates of ``A`` between times, in the form of `ParameterParts.averages`."""
        return np.asarray(self.average(breaks))[None]

    def on_cell(self, law: ExpandedSystem, low: Array, high: Array) -> Expansion:
        """Return the expansion of the state on a cell of parameters, on the same segments, from that of the law.

        Parameters
        ----------
        law : ExpandedSystem
            The parametric expansion of the law, in the part of the parameters that this expansion is of.
        low, high : Array
            Ends ``(nu,)`` of the cell, which lies in that part.

        Returns
        -------
        Expansion
            The system of all coefficients of the state, as polynomials that are from -1 to 1 on the cell. The terms of
            the law beyond their degree are in the `ExpandedSystem.remainder` of its ``spread``.
        """
        d, recentring, (coefficients, remainders) = law.d, law.recentred(low, high), self._reshape_law(law)
        sizes = np.abs(coefficients).sum(axis=1)
        cell_remainder = np.einsum(
            "ab,sbij->saij", np.abs(recentring), remainders + rounding(8 * law.space.size) * sizes
        )
        cell_coefficients = np.einsum("ab,snbij->snaij", recentring, coefficients)
        spread, kept = law.on_cell(low, high, self.ends, np.abs(cell_coefficients).sum(axis=1) + cell_remainder)
        space = spread.space
        positions = np.array(
            [space.index[tuple(exponents)] for exponents in law.space.exponents[kept].tolist()], dtype=int
        )
        table = np.zeros((*cell_coefficients.shape[:2], space.size, *cell_coefficients.shape[3:]))
        table[:, :, positions] = cell_coefficients[:, :, kept]
        remainder_table = np.zeros((len(cell_remainder), space.size, *cell_remainder.shape[2:]))
        remainder_table[:, positions] = cell_remainder[:, kept] * (1.0 + 1e-9)

        def filled(law: Array) -> Array:  # (..., M, d, d + n)
            first = law.reshape(*law.shape[:-3], spread.states, -1)
            A = spread.filled(first[..., :d].reshape(-1, spread.states, d)).reshape(*first.shape[:-1], spread.states)
            return np.concatenate([A, first[..., d:]], axis=-1)

        return Expansion(
            self.ends,
            filled(table),
            filled(remainder_table),
            np.tile(self.units[:d], space.size),
            np.ones((len(cell_remainder), spread.states)),
            self.channels,
            self.turns,
            spread,
        )

    def at_point(self, law: ExpandedSystem, parameter: Array) -> Expansion:
        """Return the expansion of the known system at a ``parameter (nu,)``, from that of the law, whose parametric
        expansion is ``law``. The truncation error of the series in the parameters is not in its remainder."""
        powers = law.space.monomials(law.shares(parameter[None]))[0]
        coefficients, remainders = self._reshape_law(law)
        point_coefficients, point_remainder = (
            np.einsum("a,snaij->snij", powers, coefficients),
            np.einsum("a,saij->sij", np.abs(powers), remainders),
        )
        point_remainder = point_remainder + rounding(8 * powers.size) * np.einsum(
            "a,saij->sij", np.abs(powers), np.abs(coefficients).sum(axis=1)
        )
        units, ones = self.units[: law.d], np.ones((len(point_remainder), law.d))
        return Expansion(self.ends, point_coefficients, point_remainder, units, ones, self.channels, self.turns)

    def largest_inputs(self, law: ExpandedSystem) -> Array:
        """Return upper bounds ``(s, d, m + mw)`` of ``[B E]`` over all parameters and all times of every segment."""
        coefficients, remainders = self._reshape_law(law)
        return np.asarray((np.abs(coefficients).sum(axis=(1, 2)) + remainders.sum(axis=1))[..., law.d :])

    def _reshape_law(self, law: ExpandedSystem) -> tuple[Array, Array]:
        """Return the coefficients of the law in time and parameters, ``(s, p + 1, M, d, d + m + mw)``, and the
        remainders of those of every monomial in the parameters, ``(s, M, d, d + m + mw)``."""
        remainders = np.concatenate([self.remainder[..., : law.d], self.remainder[..., self.units.size :]], axis=2)
        shape = law.space.size, law.d, remainders.shape[2]
        return self._own_coefficients.reshape(*self._own_coefficients.shape[:2], *shape), remainders.reshape(
            len(remainders), *shape
        )

    def _compute_segment_responses(self, segments: np.ndarray, starts: Array, stops: Array) -> tuple[Array, ...]:
        """Return the responses of `flow` over intervals within one segment each, with control and disturbance side by
        side, and their error bounds."""
        length = stops - starts
        law, bulk = self._recentre_coefficients(segments, starts, length, length)
        majorant = self._compute_majorant(segments, law, bulk, length)
        A, forcing = law[..., : self.own], law[..., self.own :]
        size = 1 if self.spread is None else self.spread.space.size
        total = self._sum_series(A, forcing, majorant.terms, majorant.degree, size)
        transition = total[..., : self.own] if self.spread is None else self.spread.filled(total[..., : self.own])
        return transition, total[..., self.own :], majorant.error, majorant.sizes

    def _compute_majorant(
        self,
        segments: np.ndarray,
        law: Array,
        bulk: Array,
        length: Array,
        ratio: float = 1.0,
        summed: Majorant | None = None,
    ) -> Majorant:
        """Return the truncation of a series, and its error bound, by a series that majorises it.

        In the norm of largest row sums in own units, the coefficients are at most those of ``y' = a(s) y + b(s)``,
        where ``a_k`` and ``b_k`` are the norms of the coefficients of the system. The result says how many terms of the
        series are needed, and how many of the system's coefficients; the others count as part of the ``remainder``.

        The error is Cauchy's tail ``y(R) R^-N / (R - 1)`` for the best ``R``; the effect of the remainder of the
        system, by variation of constants ``r e^(a + r)``; and rounding: of the coefficients ``bulk`` before anything
        cancels in them, of every term, and of the sum, whose first term is exact. With a ``ratio``, the norm is that of
        `off`; ``summed`` is then the truncation found in another norm.
        """
        d, own = self.units.size, self.own
        remainder = self.remainder[segments] * length[:, None, None]
        inputs = _sum_forcing(self._bound_forcing(law[..., own:]), self._bound_forcing(remainder[..., d:]))[0]
        law, bulk, remainder = (self._scale_by_ratios(segments, table) for table in (law, bulk, remainder))
        sizes = self._bound_norm(law[..., :own], ratio)
        forcing, input_errors = self._bound_forcing(law[..., own:]), self._bound_forcing(remainder[..., d:])
        divisors = _sum_forcing(forcing, input_errors)[1]
        shares = (forcing / divisors[:, None]).max(axis=(2, 3), initial=0.0)
        is_relevant = (np.maximum(sizes, shares) > IDLE * np.maximum(sizes.sum(axis=1), 1e-300)[:, None]).any(axis=0)
        degree = int(np.flatnonzero(is_relevant).max(initial=0)) if summed is None else summed.degree
        a = sizes.sum(axis=1)
        r = self._bound_norm(remainder[..., :own], ratio) + sizes[:, degree + 1 :].sum(axis=1)
        share = (input_errors / divisors).max(axis=(1, 2), initial=0.0) + shares[:, degree + 1 :].sum(axis=1)
        terms, tail = _bound_tail(sizes, shares, None if summed is None else summed.terms)
        bulk_size = self._bound_norm(bulk[..., :own].sum(axis=1), ratio)
        bulk_size += (self._bound_forcing(bulk[..., own:]).sum(axis=1) / divisors).max(axis=(1, 2), initial=0.0)
        growth = np.exp(a + r)
        rounded = rounding((degree + 1) * own * self._nonzero_monomials.size + terms) * np.minimum(a, 1.0)
        rounded += rounding(self.orders) * bulk_size
        error = tail + (r + share) * growth + (rounded * (1.0 + a) + EPSILON) * growth
        return Majorant(terms, degree, error * self.ratios[segments].max(axis=1) * (1.0 + 1e-9), inputs)

    def _scale_by_ratios(self, segments: np.ndarray, table: Array) -> Array:
        """Return a ``table (k, ..., d, n)`` of ``[A F]`` on segments for states that are measured in `ratios`."""
        ratios = self.ratios[segments]
        if (ratios == 1.0).all():
            return table
        ratios = ratios.reshape(ratios.shape[0], *([1] * (table.ndim - 3)), -1)
        d, scaled = self.units.size, table / ratios[..., None]
        scaled[..., :d] *= ratios[..., None, :]
        return np.asarray(scaled)

    @cached_property
    def together(self) -> list[np.ndarray]:
        """Indices of the states of every part that ``A`` couples with no other state; an error in one part has no
        effect on another."""
        d = self.units.size
        return _find_coupled_states(
            np.abs(self.coefficients[..., :d]).max(axis=(0, 1)) + self.remainder[..., :d].max(axis=0)
        )

    def over_parts(self, entries: Array) -> Array:
        """Return ``(..., d, n)``: for each state, the largest of the ``entries (..., d, n)`` over the states of its
        part."""
        if len(self.together) == 1:
            return np.broadcast_to(entries.max(axis=-2, keepdims=True), entries.shape)
        largest = np.empty(entries.shape)
        for states in self.together:
            largest[..., states, :] = entries[..., states, :].max(axis=-2, keepdims=True)
        return largest

    def _bound_forcing(self, entries: Array) -> Array:
        """Return the largest forcing of every part by ``entries (..., d, m + mw)`` of ``[B E]``, in own units, state by
        state."""
        return self.over_parts(np.abs(entries) / self.units[:, None])

    @cached_property
    def slack(self) -> float:
        """Sum of the error bounds of the flows over all segments, each over its segment alone: a measure of the
        relative error of the numbers that are added up to a state at the end of the horizon."""
        return float(self.flow(self.ends[:-1], self.ends[1:]).error.sum())


class Segment(NamedTuple):
    """Segment of the horizon.

    ``sharp``: true where the remainder of the polynomials in time is small enough. ``why``: otherwise, the reason why a
    pole may be there. ``off``: the remainder relative to the numbers. ``parts``: coefficients, remainder and ratios of
    an `Expansion`.
    """

    sharp: bool
    off: float
    why: str
    parts: tuple[Array, ...] = ()


@dataclass(frozen=True, eq=False)
class Look:
    """Enclosure of a system on segments, in ``units (d,)`` in which its largest matrix has the norm ``size``.
    ``steadies``: true where a segment may use units of its own if these help."""

    space: TaylorSpace
    units: Array
    size: float
    steadies: bool

    def at(self, law: Phase, start: float, stop: float, before: float) -> Segment:
        """Return the segment from ``start`` to ``stop``; a segment of twice the length had the remainder ``before``."""
        units, centre, ratios = self.units, (start + stop) / 2, np.ones(self.units.size)
        radius = float(np.nextafter(max(stop - centre, centre - start), np.inf))
        try:
            tables = law.taylor(self.space, np.array([centre]), np.array([radius]))
        except NotEnclosable as error:
            return Segment(False, np.inf, f"has a pole, or is no real number ({error})")
        coefficients, remainder = np.concatenate(tables[0::2], axis=2), np.concatenate(tables[1::2], axis=1)
        relative_remainder, norm = _measure_remainder(coefficients, remainder, units, self.size)
        norm *= stop - start
        # or halving does not help
        sharp = norm <= LONG and (relative_remainder <= SHARPEST or before / 2 <= relative_remainder <= BLUNTEST)
        if norm > LONG and self.steadies:
            largest = (np.abs(coefficients).sum(axis=0) + remainder)[:, : units.size] / units[:, None] * units
            if (steady := steadied(largest, stop - start)) is not None:
                scaled_remainder = _measure_scaled_remainder(
                    coefficients, remainder, units * steady, stop - start
                ) * float(steady.max())
                ratios, sharp = steady, scaled_remainder <= SHARPEST
        return Segment(
            sharp, relative_remainder, "has a pole, or is too steep to be enclosed", (coefficients, remainder, ratios)
        )

    def length(self, law: Phase, time: float, longest: float, shortest: float) -> float:
        """Return an estimate of the length that a segment around a ``time`` may have, by halving the ``longest``. The
        result is infinite where even the ``shortest`` is too long: then there is a pole, and the number of segments has
        no meaning."""
        before = np.inf
        while longest > shortest:
            segment = self.at(law, time - longest / 2, time + longest / 2, before)
            if segment.sharp:
                return longest
            before, longest = segment.off, longest / 2
        return np.inf


def _divide_into_segments(begin: float, until: float, horizon: float) -> list[float]:
    """Return the ends of the first segments of a law between two times."""
    return list(np.linspace(begin, until, ceil(FIRST * (until - begin) / horizon) + 1).tolist())


def _require_few_segments(system: System, look: Look, ends: Sequence[float]) -> None:
    """Raise `InputError` where there are more segments than can be followed: those between ``ends``, and those that the
    rest of the horizon takes. The latter are estimated from the lengths of some of them."""
    end, horizon = ends[-1], system.horizon
    needed = float(len(ends) - 1)
    for law in system.phases:
        begin = law.begin
        step = (law.until - max(begin, end)) / SAMPLED
        for k in range(SAMPLED if step > 0.0 else 0):
            time = max(begin, end) + (k + 0.5) * step
            needed += step / look.length(law, time, step, SHORTEST * horizon)
    if needed > MAX_SEGMENTS:
        raise InputError(
            f"it changes so fast that it would take some {needed:.1g} segments of the horizon, each a polynomial of the"
            f" time, and {MAX_SEGMENTS} can be followed; a shorter horizon takes fewer, or entries without what is so"
            " fast",
            path="system",
        )


@cache
def _compute_binomials(degree: int) -> tuple[np.ndarray, Array]:
    """Return the orders up to a degree, and the binomial coefficients ``k`` over ``n``, ``(degree + 1, degree +
    1)``."""
    orders = np.arange(degree + 1)
    return orders, np.array([[comb(k, n) for k in orders.tolist()] for n in orders.tolist()], dtype=float)


def _bound_tail(sizes: Array, shares: Array, summed: int | None = None) -> tuple[int, Array]:
    """Return the number of terms that are summed of a series, and a bound of its truncation error, ``(k,)``: Cauchy's
    tail ``y(R) R^-N / (R - 1)`` for the best ``R``.

    The coefficients of the series are at most those of ``y' = a(s) y + b(s)``, with the coefficients ``sizes (k, p)``
    and ``shares (k, p)`` of ``a`` and ``b``. A number of terms that is given as ``summed`` is kept.
    """
    orders, R = np.arange(1.0, sizes.shape[1] + 1), np.array(CIRCLES)[:, None]
    with np.errstate(over="ignore", invalid="ignore"):
        circles = R**orders / orders
        bounds = np.exp(sizes @ circles.T) * np.maximum(1.0, shares @ circles.T) / (R[:, 0] - 1.0)
        for terms in (*(count for count in FEWER if count < TERMS), TERMS) if summed is None else (summed,):
            tail = np.fmin.reduce(bounds * R[:, 0] ** -float(terms), axis=1, initial=np.inf)
            if (tail <= IDLE).all():
                break
    return terms, tail


def _find_parametric_expansion(system: System) -> ExpandedSystem | None:
    """Return the parametric expansion whose coefficients are the states of a system; ``None`` where the states are no
    such coefficients."""
    entry = system.phases[0].entry("A")
    depends = entry.dependence if isinstance(entry, Superposed) else None
    return depends if isinstance(depends, ExpandedSystem) else None


def _find_coupled_states(A: Array) -> list[np.ndarray]:
    """Return the indices of the states that ``A (d, d)`` couples with one another, part by part."""
    from scipy.sparse.csgraph import connected_components

    count, labels = connected_components(A != 0.0, directed=False)
    return [np.flatnonzero(labels == k) for k in range(count)]


def _sum_forcing(forcing: Array, errors: Array) -> tuple[Array, Array]:
    """Return the sums over orders of ``forcing (k, p, d, n)``, and the numbers to divide by, which are infinite where
    the sum is 0. The sums are at least so large that ``errors (k, d, n)`` is at most the share `BLUNTEST` of them, also
    where ``forcing`` are 0."""
    inputs = np.maximum(forcing.sum(axis=1), errors / BLUNTEST)
    return inputs, np.where(inputs > 0.0, inputs, np.inf)


def steadied(A: Array, length: float) -> Array | None:
    """Return units ``(d,)``, powers of two from 1 on, in which a system of at most ``A (d, d)`` is slow; ``None`` where
    none are found. Slow means: the norm of largest row sums, times a length, is at most twice `SLOW`.

    With ``M`` the product and ``g`` that number, ``u = (1 - M / g)^-1 1`` has ``M u = g (u - 1)``; rounded up to powers
    of two the row sums at most double. Such a ``u`` exists where the spectral radius of ``M`` is below ``g``. This is
    so for a motion that is slow here and fast elsewhere, though its norm in units of the fast part is not.
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


def _measure_scaled_remainder(coefficients: Array, rest: Array, units: Array, length: float) -> float:
    """Return the size of the remainder on a segment of this length: that of ``A`` times the length, in the norm of
    largest row sums in these ``units``, or that of the inputs relative to the largest, if it is larger."""
    d = units.size
    state_error = float((rest[:, :d] * units / units[:, None]).sum(axis=1).max()) * length
    forcing, input_errors = (
        table / units[:, None] for table in (np.abs(coefficients[:, :, d:]).sum(axis=0), rest[:, d:])
    )
    divisors = np.where(forcing.max(axis=0, initial=0.0) > 0.0, forcing.max(axis=0, initial=0.0), np.inf)
    return max(state_error, float((input_errors / divisors).max(initial=0.0)))


def _measure_remainder(coefficients: Array, rest: Array, units: Array, size: float) -> tuple[float, float]:
    """Return a segment's remainder relative to the numbers themselves, and the norm of ``A`` on it; ``size`` is the
    norm on the whole horizon."""
    d, scale = units.size, units / units[:, None]
    largest = np.abs(coefficients).sum(axis=0)
    norm = float((largest[:, :d] * scale).sum(axis=1).max())
    relative_remainder = float((rest[:, :d] * scale).sum(axis=1).max()) / max(norm, size, np.finfo(float).tiny)
    divisors = np.where(rest[:, d:] > 0.0, largest[:, d:].max(axis=0), np.inf)
    for states in _find_coupled_states(largest[:, :d] + rest[:, :d]):
        largest_inputs = largest[states, d:].max(axis=0)
        divisors[states] = np.where(
            largest_inputs > 0.0, np.minimum(divisors[states], largest_inputs), divisors[states]
        )
    return max(relative_remainder, float((rest[:, d:] / divisors).max(initial=0.0))), norm


def balanced(A: Array, horizon: float) -> Array:
    """Return units ``(d,)`` of the states, powers of two, in which ``A`` has rows and columns of similar size (Osborne
    1960), apart from its diagonal.

    A state that another one does not reach counts as reached by it a little where the reverse holds: ``A_ij = 0``
    counts as ``1 / |A_ji|``, with time in units of the horizon.
    """
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
