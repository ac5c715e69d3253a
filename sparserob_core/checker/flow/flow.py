"""The flow of a system over one box of parameters: what any time makes of its states and of inputs that stay the
same."""

from __future__ import annotations

from bisect import bisect_right
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from itertools import pairwise
from math import ceil
from typing import TYPE_CHECKING, final

import numpy as np

from sparserob_core.checker.arithmetic.balls import ball, difference
from sparserob_core.checker.arithmetic.monomials import Monomials
from sparserob_core.checker.arithmetic.remembered import remembered
from sparserob_core.checker.arithmetic.series import OUTWARD, Series, middles, products, zeros
from sparserob_core.checker.flow.law import Law, ParameterBox, Stretch
from sparserob_core.checker.flow.plant import Plant, called
from sparserob_core.checker.flow.segment import LONGER, ROUGH, SHARP, VerifiedSegment, solve
from sparserob_core.checker.flow.still import held_about
from sparserob_core.checker.outcome import Unchecked
from sparserob_core.sip.convex_set import Array

if TYPE_CHECKING:
    from flint import arb, arb_mat

# States from which transitions that no claim rests on are made of floats: of 348 states one in balls takes as long as
# the rest of a check; of few states that is nothing, and what grows by many digits has them right.
COARSE = 16
MOST_MARKS = 2**17  # of the horizon
KEPT = 4096  # parts of the horizon whose flows are remembered
WEIGHTS_KEPT = 64  # times whose states are known as sums: of a thousand pieces each takes megabytes
POINTS_KEPT = 256  # flows at single parameters
ENOUGH = 2.0**-64  # of a kernel, which goes on as numbers of 53 bits, what its last terms may be: 2^-54 would show


@final
@dataclass(frozen=True, eq=False)
class StateWeights:
    """What a state at a time is made of: ``free`` times the state at 0, and ``control`` and ``disturbance`` times the
    inputs on every piece of a grid."""

    free: arb_mat
    control: list[arb_mat]
    disturbance: list[arb_mat]


@final
@dataclass(frozen=True, eq=False)
class FlowPart:
    """A ``share`` of a ``segment``, which takes a time of this ``length``, so many ``doublings`` of it: the flow of two
    times is that of one twice."""

    segment: VerifiedSegment
    share: arb
    length: arb
    doublings: int = 0


@final
@dataclass(eq=False)
class VerifiedFlow:
    """The system ``x' = A x + B u + E w`` from 0 to ``until``, at every parameter of a ``box``; a drift is one more
    column of ``B``, whose input is always 1. To a ``degree`` in the parameters, of which there may be none; between
    the marks of a ``timing`` where there is one. ``sharp``: of the states, what a guess may leave out."""

    plant: Plant
    until: float
    box: ParameterBox = ParameterBox()  # noqa: RUF009  immutable
    degree: int = 0
    timing: Law | None = None
    sharp: float = SHARP
    _segments: dict[tuple[float, float], VerifiedSegment] = field(default_factory=dict, repr=False)
    _longest: dict[float, float] = field(default_factory=dict, repr=False)
    _about: dict[tuple[int, float], tuple[Array, Array]] = field(default_factory=dict, repr=False)

    @remembered(lambda: POINTS_KEPT, lambda self, parameter: tuple(map(float, parameter)))
    def at(self, parameter: Sequence[float]) -> VerifiedFlow:
        """The flow at one parameter."""
        point = tuple(map(float, parameter))
        if point == self.box.middle and not self.degree:
            return self
        return VerifiedFlow(self.plant, self.until, ParameterBox(point, (0.0,) * len(point)))

    def sharper(self, sharp: float) -> VerifiedFlow:
        """The flow anew, of whose states a guess leaves out less."""
        return VerifiedFlow(self.plant, self.until, self.box, self.degree, self.timing, min(self.sharp, sharp))

    @cached_property
    def law(self) -> Law:
        """The law of the system on the box."""
        return Law(self.plant, self.until, self.box, self.degree, self.timing)

    @property
    def monomials(self) -> Monomials:
        """Those of the parameters."""
        return self.law.monomials

    @property
    def states(self) -> int:
        """How many states there are."""
        return self.plant.states

    @property
    def driven(self) -> int:
        """How many inputs there are before the disturbances: controls, and a drift."""
        return self.plant.driven

    @cached_property
    def _begins(self) -> list[float]:
        return [one.start for one in self.law.stretches]

    def _place(self, start: float, stop: float) -> int:
        """The stretch that holds an interval; raises `Unchecked` where none does."""
        if not 0.0 <= start <= stop <= self.until:
            raise Unchecked(f"the system is not known from {start:g} to {stop:g}")
        place = max(0, bisect_right(self._begins, start) - 1)
        if stop > self.law.stretches[place].stop:
            raise Unchecked(f"the system is no polynomial from {start!r} to {stop!r}")
        return place

    def marks(self, times: Sequence[float]) -> list[float]:
        """Increasing times with others between them, such that the flow is a polynomial from each to the next."""
        found = [times[0]]
        for start, stop in pairwise(times):
            ends = [one for one in self._begins if start < one < stop]
            for a, b in pairwise([start, *ends, stop]):
                stretch = self.law.stretches[self._place(a, b)]
                count = (b - a) / stretch.stride * (1.0 - 1e-14) if stretch.is_still else 1.0
                if not len(found) + count <= MOST_MARKS:
                    raise Unchecked("the system is too fast for its horizon to be followed")
                found += [float(t) for t in np.linspace(a, b, max(1, ceil(count)) + 1)[1:-1]] + [b]
        return found

    def segment(self, start: float, stop: float) -> tuple[VerifiedSegment, arb]:
        """The flow from ``start`` on, and which share of it has passed at ``stop``."""
        stretch = self.law.stretches[self._place(start, stop)]
        if stretch.is_still:
            share = (ball(stop) - ball(start)) / stretch.stride
            if not share <= LONGER:
                raise Unchecked(f"the system is no polynomial from {start!r} to {stop!r}")
            return self._still(stretch), share
        longest = self._longest.get(start, -1.0)
        if stop > longest:
            if len(self._segments) >= KEPT:
                self._segments.clear()
                self._longest.clear()
            self._segments[start, stop] = solve(*stretch.between(start, stop), stretch.units, self.sharp)
            longest = self._longest[start] = stop
        if longest == start:
            return self._segments[start, longest], ball(1)
        return self._segments[start, longest], (ball(stop) - ball(start)) / (ball(longest) - ball(start))

    def kind(self, start: float, stop: float) -> tuple[int, tuple[float, float]]:
        """Intervals of one kind have one flow."""
        place = self._place(start, stop)
        still = self.law.stretches[place].is_still
        return (place, difference(stop, start)) if still else (-1 - place, (start, stop))

    @remembered(lambda: KEPT, lambda self, start, stop: self.kind(start, stop))
    def step(self, start: float, stop: float) -> Series:
        """``[Phi Gamma]``, what an interval from one mark to the next makes of states and of inputs."""
        segment, share = self.segment(start, stop)
        return segment.at(share)

    @remembered(lambda: KEPT, lambda self, start, stop: self.alike(start, stop))
    def over(self, start: float, stop: float) -> tuple[Series, Series, Series]:
        """What an interval makes of a state, of controls that stay the same (a drift among them), and of such
        disturbances."""
        whole: tuple[Series, Series] | None = None
        for part in self.parts(start, stop):
            both = part.segment.at(part.share)
            Phi, pushed = both.columns(0, self.states), both.columns(self.states, None)
            for _ in range(part.doublings):
                Phi, pushed = Phi * Phi, Phi * pushed + pushed
            whole = (Phi, pushed) if whole is None else (Phi * whole[0], Phi * whole[1] + pushed)
        assert whole is not None
        return whole[0], whole[1].columns(0, self.driven), whole[1].columns(self.driven, None)

    def about(self, start: float, stop: float) -> tuple[Array, Array, Array]:
        """`over` in floats, off by their rounding, of which units of rows are made, and no claim."""
        phases, d = self.plant.phases, self.states
        if d < COARSE or self.plant.is_timed:
            of_states, of_controls, of_disturbances = (middles(one.matrix) for one in self.over(start, stop))
            return of_states, of_controls, of_disturbances
        found = np.hstack([np.eye(d), np.zeros((d, self.plant.inputs))])
        for number, phase in enumerate(phases):
            length = min(stop, phase.until) - max(start, phase.begin)
            if length > 0.0:
                key = number, length
                if key not in self._about:
                    table = called(phase, np.array([phase.begin, *self.box.middle])).astype(float)
                    self._about[key] = held_about(table[:, :d], table[:, d:], length)
                onward, pushed = self._about[key]
                found = onward @ found
                found[:, d:] += pushed
        return found[:, :d], found[:, d : d + self.driven], found[:, d + self.driven :]

    def parts(self, start: float, stop: float) -> Iterator[FlowPart]:
        """Yield the parts of an interval, one after another."""
        for a, b in pairwise([start, *(one for one in self._begins if start < one < stop), stop]):
            stretch, doublings, length = self.law.stretches[self._place(a, b)], 0, ball(b) - ball(a)
            if not stretch.is_still:
                yield FlowPart(*self.segment(a, b), length)
                continue
            share = length / stretch.stride
            while not share <= 1:
                share, length, doublings = share / 2, length / 2, doublings + 1
            yield FlowPart(self._still(stretch), share, length, doublings)

    def _still(self, stretch: Stretch) -> VerifiedSegment:
        """The flow of a stretch on which nothing changes with time."""
        key = (-1.0, stretch.start)
        if key not in self._segments:
            self._segments[key] = solve(*stretch.between(0.0, stretch.stride), stretch.units, self.sharp)
        return self._segments[key]

    def within(self, begin: float, end: float, start: float, stop: float, order: int) -> tuple[list[Series], Array]:
        """What the time from ``begin`` on makes of states and of inputs that stay the same, on ``[start, stop]`` within
        ``[begin, end]``, on which the flow is a polynomial: so many terms in the share of the interval, ``(d, d + w)``
        each, and by how much they are off at most."""
        segment, share = self.segment(begin, end)
        if begin == end:
            return segment.within(ball(0), ball(0), order)
        length = ball(end) - ball(begin)
        first, width = ((ball(b) - ball(a)) / length * share for a, b in ((begin, start), (start, stop)))
        return segment.within(first, width, order)

    def kernel(self, start: float, stop: float) -> tuple[list[Series], Array]:
        """What inputs at any time ``s`` on an interval without marks make of the state at its end: ``h Phi(stop, s) [B
        E](s)`` as terms ``(d, w)`` in the share of the interval that is left at ``s``, and by how much they are off at
        most. The rows of ``Phi(stop, s)`` are the flow of the transposed system, backwards."""
        stretch = self.law.stretches[self._place(start, stop)]
        A, F = stretch.between(start, stop, backwards=True)
        back, lost = self._back(stretch, A, start, stop)
        w = F[0].shape[1]
        wanted = max(float((one.size / stretch.units[:, None]).max(initial=0.0)) for one in F) * ENOUGH
        inputs, found, off = [one.size for one in F], list[Series](), np.zeros((self.states, w))
        off += lost @ np.sum(inputs, axis=0)
        sizes = [one.size for one in back]
        for n in range(len(back) + len(F) - 1):
            pairs = [(n - k, k) for k in range(len(F)) if 0 <= n - k < len(back)]
            bound = sum((sizes[i] @ inputs[k] for i, k in pairs), np.zeros((self.states, w)))
            if n and float((bound / stretch.units[:, None]).max(initial=0.0)) * 2.0 <= wanted:
                off += bound
                continue
            term = back[pairs[0][0]] * F[pairs[0][1]]
            for i, k in pairs[1:]:
                term = term + back[i] * F[k]
            while len(found) < n:
                found.append(Series.constant(self.monomials, zeros(self.states, w)))
            found.append(term)
        return found, off * OUTWARD

    def _back(self, stretch: Stretch, A: Sequence[Series], start: float, stop: float) -> tuple[list[Series], Array]:
        """``Phi(stop, s)`` as terms in the share of an interval that is left at ``s``, and by how much they are off at
        most; of what does not change with time it is the flow of what is left."""
        if stretch.is_still:
            segment, share = self.segment(start, stop)
            terms = [one.columns(0, self.states).scaled(share**n) for n, one in enumerate(segment.terms)]
            return terms, segment.off[:, : self.states]
        none = Series.constant(self.monomials, zeros(self.states, 0))
        rows = solve([one.transpose() for one in A], [none], 1.0 / stretch.units, ROUGH)
        return [one.transpose() for one in rows.terms], rows.off.T

    def alike(self, start: float, stop: float) -> tuple[object, ...]:
        """What intervals share of which the flow is the same."""
        inside = not any(start < one < stop for one in self._begins)
        return self.kind(start, stop) if inside else (start, stop)

    def sizes(self, start: float, stop: float) -> tuple[Array, Array, Array]:
        """The largest absolute values of ``[A B E]`` and of its derivative on the stretch that an interval is in, ``(d,
        d + w)`` each, and the units of the states in which it is small there."""
        stretch = self.law.stretches[self._place(start, stop)]
        return *stretch.sizes, stretch.units

    @remembered(lambda: WEIGHTS_KEPT, lambda self, grid: tuple(grid))
    def weights(self, grid: Sequence[float]) -> StateWeights:
        """What the state at the end of a grid, which begins at 0, is made of, where the parameters are known."""
        parts = [self.over(*ends) for ends in pairwise(grid)]
        after = products([part[0] for part in parts])
        control, disturbance = (
            [(Z * part[i]).matrix for Z, part in zip(after[1:], parts, strict=True)] for i in (1, 2)
        )
        return StateWeights(after[0].matrix, control, disturbance)
