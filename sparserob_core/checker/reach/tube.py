"""The worst case of ``c'x(t)`` over every disturbance and initial state, on cells of time and over one box of
parameters, as polynomials with an error."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property
from itertools import pairwise
from math import ceil
from typing import TYPE_CHECKING, NamedTuple, final

import numpy as np

from sparserob_core.checker.arithmetic.balls import difference
from sparserob_core.checker.arithmetic.jets import Monomials
from sparserob_core.checker.arithmetic.series import Exponentials, Series, norm, upper
from sparserob_core.checker.reach.disturbance_support import DisturbanceSupports, Scene
from sparserob_core.checker.reach.flow import (
    Flow,
    Remainder,
    beyond,
    exponentials,
    held,
    in_time,
    middles,
    stacked,
    up_to,
)
from sparserob_core.checker.sets.known import known
from sparserob_core.checker.sets.polynomials import OUTWARD, Enclosed, rounding
from sparserob_core.sip.convex_set import Array

if TYPE_CHECKING:
    from flint import arb, arb_mat

STEPS = 16  # of the horizon, after which the norms of the transition's coefficients are looked at anew
STEPS_WITHIN = 16  # of a piece of the grid, to the next of which the norms of what is left out are followed
STATES_KEPT = 20_000  # enclosures of the state, per box of parameters


@final
@dataclass(frozen=True, eq=False)
class Polynomial:
    """``coefficients (J + 1, M)`` in powers of the time within the cell (from 0 to 1) and monomials of the parameters;
    the truth exceeds it by at most ``error``, of which ``expansion`` is due to the size of the box of parameters, or of
    the cell of time where it is a chord; both together exceed the truth by at most twice the ``error`` and ``kinks``,
    which is due to disturbances about to switch, about ``turning`` of it because the box of parameters is so large.
    ``bent``: what of the error each parameter makes beside those, ``None`` where none does.
    """

    coefficients: Array
    error: float
    expansion: float
    kinks: float
    turning: float = 0.0
    bent: Array | None = None


class Known(NamedTuple):
    """There are no parameters that anything depends on: those of `Flow`."""

    monomials: Monomials = Monomials(0, 0)
    centre: tuple[float, ...] = ()
    radius: tuple[float, ...] = ()
    sizes: Array = np.zeros(1)


@final
@dataclass(eq=False)
class Tube:
    """The reachable states over one box of parameters, seen along combinations of the rows of ``basis (b, d)``;
    ``flows`` are those of the systems that take turns."""

    flows: Sequence[Flow]
    scene: Scene
    basis: Array
    _lengths: list[arb] = field(default_factory=list)
    _transitions: dict[tuple[int, int], tuple[Series, Series]] = field(default_factory=dict)
    _growths: dict[tuple[int, int], tuple[arb_mat, arb_mat]] = field(default_factory=dict)
    _ahead: dict[tuple[int, int], tuple[arb_mat, arb_mat, arb_mat]] = field(default_factory=dict)
    _inside: dict[tuple[int, int], Series] = field(default_factory=dict)
    _parts: dict[tuple[int, int], tuple[Series, Series]] = field(default_factory=dict)
    _exponentials: dict[int, Exponentials] = field(default_factory=dict)
    _grown: dict[tuple[int, int, int], tuple[arb_mat, arb_mat]] = field(default_factory=dict)
    _states: dict[tuple[int, float, int], Enclosed] = field(default_factory=dict)

    @property
    def flow(self) -> Flow:
        """The first of the flows; their parameters are the same."""
        return self.flows[0]

    @cached_property
    def nodes(self) -> list[Series]:
        """The undisturbed state at the breakpoints of the grid."""
        from flint import arb

        x = Series.constant(self.flow.monomials, stacked([[arb(v)] for v in self.scene.initial_state]))
        found = [x]
        for k, u in enumerate(self.scene.control):
            Phi, Gamma = self._transition(k)
            x = Phi * x + Gamma.applied(u)
            found.append(x)
        return found

    @cached_property
    def remainders(self) -> list[Remainder]:
        """Bounds of what the expansion leaves out, for every flow; none for a known system."""
        return [self._remainder(flow) for flow in self.flows] if self.flow.centre else []

    def _remainder(self, flow: Flow) -> Remainder:
        horizon, scene, parts = self.scene.grid[-1], self.scene, flow.parts
        control = np.max([_sizes(u) for u in scene.control], axis=0) if scene.control else np.zeros((0, 1))
        begun = np.zeros(len(scene.initial_state))
        if scene.initial_set is not None:
            begun = np.array(known(scene.initial_set).radius)
        speed = (np.abs(scene.initial_state) + begun) / horizon + (_sizes(parts["B"][0]) @ control)[:, 0]
        if scene.disturbance is not None:
            speed += _sizes(parts["E"][0]) @ np.array(known(scene.disturbance).radius)
        return Remainder.of(flow, horizon, speed)

    @cached_property
    def norms(self) -> list[arb_mat]:
        """The norms of the coefficients left out, at the breakpoints, from any initial state (see `Remainder`), in the
        coordinates of the flow that begins there."""
        from flint import arb

        rest, exponents, scene = self.remainders[0], self.flow.monomials.exponents, self.scene
        d, deviations = len(scene.initial_state), scene.initial_set
        n = rest.start(upper(norm(rest.inverse * stacked([[arb(v)] for v in scene.initial_state]))))
        # of any deviation from the centre, whatever its signs
        far = stacked([[arb(v)] for v in (np.zeros(d) if deviations is None else known(deviations).radius)])
        off = rest.start(upper(norm(_sizes_of(rest.inverse) * far)))
        moved = Series.constant(self.flow.monomials, stacked([[arb(int(i == j)) for j in range(d)] for i in range(d)]))
        found = [n + off]
        for k, u in enumerate(scene.control):
            growth, driven = self._growth(k)
            n, off, leg = growth * n + driven * _absolute(u), growth * off, scene.leg(k + 1)
            if scene.leg(k) != leg:
                n, off = n * self._turn(leg), off * self._turn(leg)
            rest = self.remainders[leg]
            n = rest.closer(n, [rest.inverse * part for part in self.nodes[k + 1].parts], exponents)
            if deviations is not None:
                moved = self._transition(k)[0] * moved
                off = rest.closer(off, [_sizes_of(rest.inverse * part) * far for part in moved.parts], exponents)
            found.append(self._up(n + off))
        return found

    def _turn(self, leg: int) -> arb:
        """By how much a norm may be larger in the coordinates of a leg than in those of the leg before it."""
        before, after = self.remainders[leg - 1], self.remainders[leg]
        return upper(norm(after.inverse * stacked([[_exact(v) for v in row] for row in before.transform])))

    def _up(self, balls: arb_mat) -> arb_mat:
        return stacked([[upper(x)] for x in balls.entries()])

    @cached_property
    def _spans(self) -> list[int]:
        """Of every piece of the grid the number of its duration; only equal ones share a number.

        A ball that holds several durations is amplified with the state.
        """
        from flint import arb

        found, numbers = list[int](), dict[tuple[float, float], int]()
        for start, stop in pairwise(self.scene.grid):
            number = numbers.setdefault(difference(stop, start), len(numbers))
            if number == len(self._lengths):
                self._lengths.append(arb(stop) - arb(start))
            found.append(number)
        return found

    def _transition(self, piece: int) -> tuple[Series, Series]:
        """What a whole piece of the grid makes of a state and of an input."""
        span, leg = self._spans[piece], self.scene.leg(piece)
        if (leg, span) not in self._transitions:
            n = self.flows[leg].states.parts[0].nrows()
            self._transitions[leg, span] = self._every(leg).of(self._lengths[span]).apart(n)
        return self._transitions[leg, span]

    def _growth(self, piece: int) -> tuple[arb_mat, arb_mat]:
        span, leg = self._spans[piece], self.scene.leg(piece)
        if (leg, span) not in self._growths:
            rest = self.remainders[leg]
            self._growths[leg, span] = held(rest.growth, rest.control, self._lengths[span])
        return self._growths[leg, span]

    def cells(self, piece: int, start: float, stop: float, z: Array, sharp: bool = False) -> list[Polynomial]:
        """For every ``c = z_i'basis``, ``z (k, b)``, the polynomial above ``c'x`` on ``[start, stop]``, a part
        of piece ``piece`` of the grid; ``sharp``: with less for disturbances about to switch, where that can be."""
        ticks = self.scene.ticks(start, stop)  # never shorter than the cell: a bound on a little more is a bound
        state = self._state_part(piece, start, ticks)
        mid = (state.mid @ z.T).transpose(2, 0, 1)
        lost = state.rad + rounding(z.shape[1]) * np.abs(state.mid)
        rad, kinks = np.abs(z) @ lost.sum(axis=(0, 1)), np.zeros(z.shape[0])
        turning = kinks
        if self.scene.disturbance is not None and stop > 0.0:
            moved, off, kinks, turning = self.sigmas[self.scene.leg(piece)].bounds(start, ticks, z, sharp)
            rad += off + rounding(1) * (np.abs(mid) + np.abs(moved)).sum(axis=(1, 2))
            mid = mid + moved
        if self.scene.initial_set is not None:
            moved, off, switching, of_box = self.sigmas[self.scene.leg(piece)].begun(start, ticks, z, sharp)
            rad += off + rounding(1) * (np.abs(mid) + np.abs(moved)).sum(axis=(1, 2))
            mid, kinks, turning = mid + moved, kinks + switching, turning + of_box
        rest = self._left_out(piece, start, ticks, z)
        return [
            Polynomial(mid[i], float(rad[i] + rest[i]) * OUTWARD, float(rest[i]), float(kinks[i]), float(turning[i]))
            for i in range(z.shape[0])
        ]

    def _state_part(self, piece: int, start: float, ticks: int) -> Enclosed:
        """``basis x`` of the undisturbed state, ``(J + 1, M, b)``."""

        if (piece, start, ticks) in self._states:
            return self._states[piece, start, ticks]
        x, u = self.nodes[piece], self.scene.control[min(piece, len(self.scene.control) - 1)]
        leg = self.scene.leg(piece)
        states, inputs = self.flows[leg].states, self.flows[leg].inputs
        if start != self.scene.grid[piece]:
            Phi, Gamma = self._since(piece, start)
            x = Phi * x + Gamma.applied(u)
        if ticks and self.flow.monomials.size == 1:
            return self._kept(piece, start, ticks, self._of_known(leg, ticks, x.parts[0], u))
        terms = [x]
        if ticks:
            length = self.scene.duration(ticks)
            if (leg, ticks) not in self._inside:
                self._inside[leg, ticks] = self._every(leg).within(length).apart(states.parts[0].nrows())[0]
            terms += in_time(states, states * x + inputs.applied(u), length, self._inside[leg, ticks])
        every = [self._rows * part for term in terms for part in term.parts]
        return self._kept(piece, start, ticks, every)

    def _since(self, piece: int, start: float) -> tuple[Series, Series]:
        """What a part of a piece of the grid, until ``start``, makes of a state and of an input. Over a box of
        parameters parts that are equal but for half a tick are one ball."""
        from flint import arb

        leg, node = self.scene.leg(piece), self.scene.grid[piece]
        states, inputs = self.flows[leg].states, self.flows[leg].inputs
        if self.flow.monomials.size == 1:
            return states.held(inputs, arb(start) - arb(node))
        ticks = round((start - node) / self.scene.tick)
        if (leg, ticks) not in self._parts:
            near = arb(arb(self.scene.tick) * ticks, self.scene.tick)
            self._parts[leg, ticks] = self._every(leg).of(near).apart(states.parts[0].nrows())
        return self._parts[leg, ticks]

    def _every(self, leg: int) -> Exponentials:
        """What becomes of states and of inputs that stay as they are."""
        if leg not in self._exponentials:
            flow = self.flows[leg]
            both = flow.states.beside(flow.inputs)
            self._exponentials[leg] = exponentials(both, self.scene.tick, self.scene.grid[-1])
        return self._exponentials[leg]

    @cached_property
    def _rows(self) -> arb_mat:
        from flint import arb

        return stacked([[arb(float(v)) for v in c] for c in self.basis])

    def _kept(self, piece: int, start: float, ticks: int, every: Sequence[arb_mat]) -> Enclosed:
        if len(self._states) >= STATES_KEPT:
            self._states.clear()
        shape = (-1, self.flow.monomials.size, self.basis.shape[0])
        self._states[piece, start, ticks] = Enclosed.all(every, shape)
        return self._states[piece, start, ticks]

    def _of_known(self, leg: int, ticks: int, x: arb_mat, u: arb_mat) -> list[arb_mat]:
        """The terms of a known system as `in_time` has them, by products with what is the same for every cell of that
        length: all but the last at once; and the last, which must not lose what cancels in its derivative."""
        from flint import arb_mat

        if (leg, ticks) not in self._ahead:
            A, B = self.flows[leg].states.parts[0], self.flows[leg].inputs.parts[0]
            d, m, length = A.nrows(), B.ncols(), self.scene.duration(ticks)
            state, unit = (
                Series.constant(self.flow.monomials, arb_mat(d, n, [int(i == j) for i in range(d) for j in range(n)]))
                for n in (d + m, d)
            )
            rate = arb_mat([[*a, *b] for a, b in zip(A.tolist(), B.tolist(), strict=True)])
            terms = in_time(self.flows[leg].states, Series.constant(self.flow.monomials, rate), length, unit)
            inside = self.flows[leg].states.scaled(up_to(length)).exp().parts[0]
            table = [row for term in (state, *terms[:-1]) for row in (self._rows * term.parts[0]).tolist()]
            self._ahead[leg, ticks] = stacked(table), self._rows * inside, terms[-1].parts[0]
        early, inside, last = self._ahead[leg, ticks]
        both = arb_mat(x.nrows() + u.nrows(), 1, [*x.entries(), *u.entries()])
        return [early * both, inside * (last * both)]

    @cached_property
    def sigmas(self) -> list[DisturbanceSupports]:
        """What the disturbance may add, while each of the flows acts."""
        found, before = [], None
        for leg, flow in enumerate(self.flows):
            found.append(DisturbanceSupports(flow, self.scene, self.basis, leg, before))
            before = DisturbanceSupports(flow, self.scene, np.eye(self.basis.shape[1]), leg, before)
        return found

    def _left_out(self, piece: int, start: float, ticks: int, z: Array) -> Array:
        """Lagrange's remainder ``(k,)`` of the state and of what the disturbance adds, for every direction."""
        from flint import arb

        if not self.remainders:
            return np.zeros(z.shape[0])
        leg = self.scene.leg(piece)
        rest, u = self.remainders[leg], self.scene.control[min(piece, len(self.scene.control) - 1)]
        end = arb(start) - arb(self.scene.grid[piece]) + self.scene.duration(ticks)
        growth, driven = self._grown_by(leg, self._spans[piece], end)
        last = upper((growth * self.norms[piece] + driven * _absolute(u))[rest.growth.nrows() - 1, 0])
        pushed = arb(0) if self.scene.disturbance is None else self._supports_out[leg]
        per_size = float((last + pushed).upper()) * OUTWARD
        table = self.basis @ rest.transform  # rounded, which the second term covers
        terms = rounding(sum(self.basis.shape)) * np.abs(z) @ (np.abs(self.basis) @ np.abs(rest.transform))
        answer: Array = per_size * (np.linalg.norm(z @ table, axis=1) + np.linalg.norm(terms, axis=1)) * OUTWARD
        return answer

    def _grown_by(self, leg: int, span: int, end: arb) -> tuple[arb_mat, arb_mat]:
        """How norms have grown at most at every time up to the ``end`` of a part of a piece, which is looked at in
        `STEPS_WITHIN` of the piece: a little later is a bound too, and many cells end in one of these."""
        from flint import arb

        length = upper(self._lengths[span])
        steps = ceil(float(upper(end / length * STEPS_WITHIN)) * OUTWARD)
        if (leg, span, steps) not in self._grown:
            rest = self.remainders[leg]
            self._grown[leg, span, steps] = held(
                rest.growth, rest.control, up_to(upper(length * arb(steps) / STEPS_WITHIN))
            )
        return self._grown[leg, span, steps]

    @cached_property
    def _supports_out(self) -> list[arb]:
        """The remainder of the disturbance's part up to the end of every leg, for a direction of size 1."""
        return [self._support_per_size] if len(self.flows) == 1 else self._supports_by_leg()

    def _supports_by_leg(self) -> list[arb]:
        """Leg by leg, from what the leg before has left; what decays is taken to stay, so that the bound grows with the
        time. The norms of what the polynomials say at the beginning of a leg are looked at."""
        from flint import arb, arb_mat

        assert self.scene.disturbance is not None
        ends, found, sizes = (
            (*self.scene.switches, self.scene.grid[-1]),
            list[arb](),
            known(self.scene.disturbance).radius,
        )
        n: arb_mat | None = None
        for leg, rest in enumerate(self.remainders):
            length, count = arb(ends[leg]) - (arb(ends[leg - 1]) if leg else arb(0)), rest.growth.nrows()
            pushed = [
                sum((arb(w) * e for w, e in zip(sizes, per, strict=True)), arb(0))
                for per in zip(*rest.disturbance, strict=True)
            ]
            growth = arb_mat([[rest.growth[i, j].max(arb(0)) for j in range(count)] for i in range(count)])
            Phi, Gamma = held(growth, stacked([[upper(e)] for e in pushed]), length)
            if n is not None:
                Gamma = Gamma + Phi * rest.closer(
                    n * self._turn(leg), self._carried(leg), self.flow.monomials.exponents
                )
            n = self._up(Gamma)
            found.append(n[count - 1, 0])
        return found

    def _carried(self, leg: int) -> list[arb_mat]:
        """Columns whose norms bound what any disturbance made of the coefficients before a leg, one per monomial."""
        from flint import arb

        assert self.scene.disturbance is not None
        inverse = np.abs(middles(self.remainders[leg].inverse)) * OUTWARD
        effect, far = self.sigmas[leg].effect, np.array(known(self.scene.disturbance).radius)
        every = (np.abs(effect.mid) + effect.rad) @ far  # (P, M, d)
        size = (inverse @ every.sum(axis=0).T).T * OUTWARD**2
        return [stacked([[arb(float(v))] for v in column]) for column in size]

    @cached_property
    def _support_per_size(self) -> arb:
        """By the norms of the transition's coefficients, which are looked at anew after every step."""
        from flint import arb, arb_mat

        rest = self.remainders[0]
        assert self.scene.disturbance is not None
        length, n = arb(self.scene.grid[-1]) / STEPS, rest.growth.nrows()
        T = arb_mat(rest.transform.tolist())
        step = Series(
            self.flow.monomials, [rest.inverse * part * T for part in self.flow.states.scaled(length).exp().parts]
        )
        growth, driven = held(rest.growth, arb_mat([[int(i == j) for j in range(n)] for i in range(n)]), length)
        norms, transition, total = rest.start(arb(1)), step, rest.start(arb(0))
        for _ in range(STEPS):
            total = total + driven * norms
            norms = rest.closer(growth * norms, transition.parts, self.flow.monomials.exponents)
            transition = step * transition
        return sum(
            (
                arb(w) * e * total[j, 0]
                for w, per in zip(known(self.scene.disturbance).radius, rest.disturbance, strict=True)
                for j, e in enumerate([*beyond(per), per[0]])
            ),
            arb(0),
        )


def _absolute(inputs: arb_mat) -> arb_mat:
    """Upper bounds of the absolute values of inputs ``(m, 1)``."""
    return stacked([[upper(abs(u))] for u in inputs.entries()])


def _exact(value: float) -> arb:
    from flint import arb

    return arb(float(value))


def _sizes_of(matrix: arb_mat) -> arb_mat:
    """The absolute values of balls."""
    return stacked([[abs(x) for x in row] for row in matrix.tolist()])


def _sizes(matrix: arb_mat) -> Array:
    """The absolute values of the middles of balls."""
    return np.array([[abs(float(x.mid())) for x in row] for row in matrix.tolist()])
