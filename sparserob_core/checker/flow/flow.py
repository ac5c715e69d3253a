"""The verified flow of a system over one box of parameters: its states at any time, from earlier states and constant
inputs."""

from __future__ import annotations

from bisect import bisect_right
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from itertools import pairwise
from math import ceil
from typing import final

import numpy as np
from flint import arb, arb_mat

from sparserob_core.checker.arithmetic.balls import ball, difference
from sparserob_core.checker.arithmetic.monomials import Monomials
from sparserob_core.checker.arithmetic.remembered import remembered
from sparserob_core.checker.arithmetic.series import OUTWARD, Series, middles, products, zeros
from sparserob_core.checker.flow.law import Law, ParameterBox, Stretch
from sparserob_core.checker.flow.plant import Plant, called, held_about
from sparserob_core.checker.flow.segment import LONGER, ROUGH, SHARP, VerifiedSegment, solve
from sparserob_core.checker.outcome import Unchecked
from sparserob_core.sip.convex_set import Array

# From this number of states on, transitions that no claim rests on are computed in floats, unless the law may change
# with time. With 348 states a transition in balls takes as long as the rest of a check. With few states balls cost
# nothing, and are right to many digits even where the system grows fast.
COARSE = 16
MAX_MARKS = 2**17  # the largest number of marks on the horizon
KEPT = 4096  # parts of the horizon whose flows are remembered
WEIGHTS_KEPT = 64  # times whose `StateWeights` are remembered: with a thousand pieces each takes megabytes
POINTS_KEPT = 256  # flows at single parameters that are remembered
# The relative size of the terms that a kernel may drop. The kernel is later rounded to 53 bits, where an error of 2^-54
# would be visible.
ENOUGH = 2.0**-64


@final
@dataclass(frozen=True, eq=False)
class StateWeights:
    """The matrices that make up the state at a time, or a row of it: it is ``free`` times the state at 0, plus
    ``control`` and ``disturbance`` times the inputs on every piece of a grid."""

    free: arb_mat
    control: list[arb_mat]
    disturbance: list[arb_mat]


@final
@dataclass(frozen=True, eq=False)
class FlowPart:
    """A part of an interval of time: the first ``share`` of a ``segment``, and a number of ``doublings``.

    ``length`` is the time of the share, before any doubling. Each doubling applies the flow twice, for twice the time.
    """

    segment: VerifiedSegment
    share: arb
    length: arb
    doublings: int = 0


@final
@dataclass(eq=False)
class VerifiedFlow:
    """The flow of ``x' = A x + B u + E w`` from 0 to ``until``, at every parameter of a ``box``.

    A drift is one more column of ``B``, whose input is always 1. ``degree`` is that of the expansion in the parameters,
    of which there may be none. With a ``timing`` the flow has the marks of that law. ``sharp`` is the relative
    truncation error of the states at which a guess ends, and at least `ROUGH` with a ``degree``. No claim rests on it.
    """

    plant: Plant
    until: float
    box: ParameterBox = ParameterBox()  # noqa: RUF009  immutable
    degree: int = 0
    timing: Law | None = None
    sharp: float = SHARP
    _segments: dict[tuple[float, float], VerifiedSegment] = field(default_factory=dict, repr=False)
    _segment_stops: dict[float, float] = field(default_factory=dict, repr=False)

    @remembered(lambda: POINTS_KEPT, lambda self, parameter: tuple(map(float, parameter)))
    def at(self, parameter: Sequence[float]) -> VerifiedFlow:
        """Return the flow at one parameter."""
        point = tuple(map(float, parameter))
        if point == self.box.middle and not self.degree:
            return self
        return VerifiedFlow(self.plant, self.until, ParameterBox(point, (0.0,) * len(point)))

    def sharper(self, sharp: float) -> VerifiedFlow:
        """Return a new flow whose guesses aim at a relative truncation error of at most ``sharp`` in the states."""
        return VerifiedFlow(self.plant, self.until, self.box, self.degree, self.timing, min(self.sharp, sharp))

    @cached_property
    def law(self) -> Law:
        """The law of the system on the box."""
        return Law(self.plant, self.until, self.box, self.degree, self.timing)

    @property
    def monomials(self) -> Monomials:
        """The monomials of the parameters."""
        return self.law.monomials

    @property
    def states(self) -> int:
        """The number of states."""
        return self.plant.states

    @property
    def driven(self) -> int:
        """The number of inputs before the disturbances: the controls, and a drift."""
        return self.plant.driven

    @cached_property
    def _stretch_starts(self) -> list[float]:
        return [stretch.start for stretch in self.law.stretches]

    def _find_stretch(self, start: float, stop: float) -> int:
        """Return the index of the stretch that holds an interval; raise `Unchecked` where none does."""
        if not 0.0 <= start <= stop <= self.until:
            raise Unchecked(f"the system is not known from {start:g} to {stop:g}")
        index = max(0, bisect_right(self._stretch_starts, start) - 1)
        if stop > self.law.stretches[index].stop:
            raise Unchecked(f"the system is no polynomial from {start!r} to {stop!r}")
        return index

    def marks(self, times: Sequence[float]) -> list[float]:
        """Return the increasing times with marks between them, such that the flow is a polynomial from each to the
        next."""
        marks = [times[0]]
        for start, stop in pairwise(times):
            cuts = [begin for begin in self._stretch_starts if start < begin < stop]
            for a, b in pairwise([start, *cuts, stop]):
                stretch = self.law.stretches[self._find_stretch(a, b)]
                count = (b - a) / stretch.stride * (1.0 - 1e-14) if stretch.is_still else 1.0
                if not len(marks) + count <= MAX_MARKS:
                    raise Unchecked("the system is too fast for its horizon to be followed")
                marks += [float(t) for t in np.linspace(a, b, max(1, ceil(count)) + 1)[1:-1]] + [b]
        return marks

    def segment(self, start: float, stop: float) -> tuple[VerifiedSegment, arb]:
        """Return the verified segment of the flow from ``start`` on, and the share of its time that has passed at
        ``stop``; raise `Unchecked` where no segment is as long."""
        stretch = self.law.stretches[self._find_stretch(start, stop)]
        if stretch.is_still:
            share = (ball(stop) - ball(start)) / stretch.stride
            if not share <= LONGER:
                raise Unchecked(f"the system is no polynomial from {start!r} to {stop!r}")
            return self._solve_constant_stretch(stretch), share
        longest = self._segment_stops.get(start, -1.0)
        if stop > longest:
            if len(self._segments) >= KEPT:
                self._segments.clear()
                self._segment_stops.clear()
            self._segments[start, stop] = solve(*stretch.between(start, stop), stretch.units, self.sharp)
            longest = self._segment_stops[start] = stop
        if longest == start:
            return self._segments[start, longest], ball(1)
        return self._segments[start, longest], (ball(stop) - ball(start)) / (ball(longest) - ball(start))

    def kind(self, start: float, stop: float) -> tuple[int, tuple[float, float]]:
        """Return the kind of an interval: intervals of one kind have one flow."""
        index = self._find_stretch(start, stop)
        is_still = self.law.stretches[index].is_still
        return (index, difference(stop, start)) if is_still else (-1 - index, (start, stop))

    @remembered(lambda: KEPT, lambda self, start, stop: self.kind(start, stop))
    def step(self, start: float, stop: float) -> Series:
        """Return ``[Phi Gamma]`` of an interval from one mark to the next: the factors of the states and of constant
        inputs."""
        segment, share = self.segment(start, stop)
        return segment.at(share)

    @remembered(lambda: KEPT, lambda self, start, stop: self.alike(start, stop))
    def over(self, start: float, stop: float) -> tuple[Series, Series, Series]:
        """Return the three factors that make up the state at the end of an interval: of the state at its beginning
        ``(d, d)``, of constant controls with a drift ``(d, driven)``, of constant disturbances ``(d, w - driven)``."""
        total: tuple[Series, Series] | None = None
        for flow_part in self.parts(start, stop):
            flow = flow_part.segment.at(flow_part.share)
            Phi, Gamma = flow.columns(0, self.states), flow.columns(self.states, None)
            for _ in range(flow_part.doublings):
                Phi, Gamma = Phi * Phi, Phi * Gamma + Gamma
            total = (Phi, Gamma) if total is None else (Phi * total[0], Phi * total[1] + Gamma)
        assert total is not None
        return total[0], total[1].columns(0, self.driven), total[1].columns(self.driven, None)

    def about(self, start: float, stop: float) -> tuple[Array, Array, Array]:
        """Return the three factors of `over` as floats with rounding errors. Units of rows are made of them; no claim
        rests on them."""
        d = self.states
        if d < COARSE or self.plant.is_timed:
            of_states, of_controls, of_disturbances = (middles(factor.matrix) for factor in self.over(start, stop))
            return of_states, of_controls, of_disturbances
        flow = np.hstack([np.eye(d), np.zeros((d, self.plant.inputs))])
        for number, phase in enumerate(self.plant.phases):
            length = min(stop, phase.until) - max(start, phase.begin)
            if length > 0.0:
                Phi, Gamma = self._estimate_flow(number, length)
                flow = Phi @ flow
                flow[:, d:] += Gamma
        return flow[:, :d], flow[:, d : d + self.driven], flow[:, d + self.driven :]

    @remembered()
    def _estimate_flow(self, number: int, length: float) -> tuple[Array, Array]:
        """Return the flow of a phase over a length of time, in floats."""
        phase, d = self.plant.phases[number], self.states
        table = called(phase, np.array([phase.begin, *self.box.middle])).astype(float)
        return held_about(table[:, :d], table[:, d:], length)

    def parts(self, start: float, stop: float) -> Iterator[FlowPart]:
        """Yield the parts of an interval, one after another."""
        for a, b in pairwise([start, *(begin for begin in self._stretch_starts if start < begin < stop), stop]):
            stretch, doublings, length = self.law.stretches[self._find_stretch(a, b)], 0, ball(b) - ball(a)
            if not stretch.is_still:
                yield FlowPart(*self.segment(a, b), length)
                continue
            share = length / stretch.stride
            while not share <= 1:
                share, length, doublings = share / 2, length / 2, doublings + 1
            yield FlowPart(self._solve_constant_stretch(stretch), share, length, doublings)

    @remembered(key=lambda self, stretch: stretch.start)
    def _solve_constant_stretch(self, stretch: Stretch) -> VerifiedSegment:
        """Return the verified segment of a stretch on which nothing changes with time."""
        return solve(*stretch.between(0.0, stretch.stride), stretch.units, self.sharp)

    def within(self, begin: float, end: float, start: float, stop: float, order: int) -> tuple[list[Series], Array]:
        """Return the flow ``[Phi Gamma]``, ``(d, d + w)``, from ``begin`` to the times in ``[start, stop]``: at most
        ``order`` coefficients in powers of the share of ``[start, stop]``, and the error bound of this polynomial. The
        flow must be a polynomial on ``[begin, end]``, which contains ``[start, stop]``."""
        segment, share = self.segment(begin, end)
        if begin == end:
            return segment.within(ball(0), ball(0), order)
        length = ball(end) - ball(begin)
        first, width = ((ball(b) - ball(a)) / length * share for a, b in ((begin, start), (start, stop)))
        return segment.within(first, width, order)

    def kernel(self, start: float, stop: float) -> tuple[list[Series], Array]:
        """Return the kernel ``h Phi(stop, s) [B c E](s)`` of inputs at any time ``s`` of an interval without marks, of
        length ``h``. It has coefficients ``(d, w)`` in powers of the share of the interval that is left at ``s``, and
        an error bound. The rows of ``Phi(stop, s)`` are the flow of the transposed system, backwards."""
        stretch = self.law.stretches[self._find_stretch(start, stop)]
        A, F = stretch.between(start, stop, backwards=True)
        Phi, Phi_error = self._solve_backwards(stretch, A, start, stop)
        w = F[0].shape[1]
        negligible = max(float((series.size / stretch.units[:, None]).max(initial=0.0)) for series in F) * ENOUGH
        input_sizes, terms, remainder = [series.size for series in F], list[Series](), np.zeros((self.states, w))
        remainder += Phi_error @ np.sum(input_sizes, axis=0)
        Phi_sizes = [series.size for series in Phi]
        for n in range(len(Phi) + len(F) - 1):
            pairs = [(n - k, k) for k in range(len(F)) if 0 <= n - k < len(Phi)]
            bound = sum((Phi_sizes[i] @ input_sizes[k] for i, k in pairs), np.zeros((self.states, w)))
            if n and float((bound / stretch.units[:, None]).max(initial=0.0)) * 2.0 <= negligible:
                remainder += bound
                continue
            term = Phi[pairs[0][0]] * F[pairs[0][1]]
            for i, k in pairs[1:]:
                term = term + Phi[i] * F[k]
            while len(terms) < n:
                terms.append(Series.constant(self.monomials, zeros(self.states, w)))
            terms.append(term)
        return terms, remainder * OUTWARD

    def _solve_backwards(
        self, stretch: Stretch, A: Sequence[Series], start: float, stop: float
    ) -> tuple[list[Series], Array]:
        """Return ``Phi(stop, s)`` as coefficients in powers of the share of an interval that is left at ``s``, with an
        error bound ``(d, d)``. Where nothing changes with time, it is the flow over the time that is left."""
        if stretch.is_still:
            segment, share = self.segment(start, stop)
            terms = [term.columns(0, self.states).scaled(share**n) for n, term in enumerate(segment.terms)]
            return terms, segment.off[:, : self.states]
        no_inputs = Series.constant(self.monomials, zeros(self.states, 0))
        rows = solve([series.transpose() for series in A], [no_inputs], 1.0 / stretch.units, ROUGH)
        return [term.transpose() for term in rows.terms], rows.off.T

    def alike(self, start: float, stop: float) -> tuple[object, ...]:
        """Return a key that is equal for intervals with the same flow."""
        inside = not any(start < begin < stop for begin in self._stretch_starts)
        return self.kind(start, stop) if inside else (start, stop)

    def sizes(self, start: float, stop: float) -> tuple[Array, Array, Array]:
        """Return upper bounds of the absolute values of ``[A B c E]`` and of its derivative in time, ``(d, d + w)``
        each. The third value is the units ``(d,)`` of the states, in which the law is small on the stretch of the
        interval."""
        stretch = self.law.stretches[self._find_stretch(start, stop)]
        return *stretch.sizes, stretch.units

    @remembered(lambda: WEIGHTS_KEPT, lambda self, grid: tuple(grid))
    def weights(self, grid: Sequence[float]) -> StateWeights:
        """Return the matrices that make up the state at the end of a grid, which begins at 0, at known parameters."""
        steps = [self.over(*ends) for ends in pairwise(grid)]
        after = products([step[0] for step in steps])
        control, disturbance = (
            [(Z * step[i]).matrix for Z, step in zip(after[1:], steps, strict=True)] for i in (1, 2)
        )
        return StateWeights(after[0].matrix, control, disturbance)
