"""The worst case of ``c'x(t)`` over every disturbance and initial state, on cells of time and over one box of
parameters, as polynomials with an error."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property
from itertools import pairwise
from typing import TYPE_CHECKING, final

import numpy as np

from sparserob_core.checker.arithmetic.series import Series, norm, upper
from sparserob_core.checker.reach.disturbance_support import DisturbanceSupports, Scene
from sparserob_core.checker.reach.flow import Flow, Remainder, beyond, held, in_time, stacked, up_to
from sparserob_core.checker.sets.known import known
from sparserob_core.checker.sets.polynomials import OUTWARD, Enclosed, rounding
from sparserob_core.sip.convex_set import Array

if TYPE_CHECKING:
    from flint import arb, arb_mat

STEPS = 16  # of the horizon, after which the norms of the transition's coefficients are looked at anew
STATES_KEPT = 20_000  # enclosures of the state, per box of parameters


@final
@dataclass(frozen=True, eq=False)
class Polynomial:
    """``coefficients (J + 1, M)`` in powers of the time within the cell (from 0 to 1) and monomials of the parameters;
    the truth exceeds it by at most ``error``, of which ``expansion`` is due to the size of the box of parameters; both
    together exceed the truth by at most twice the ``error`` and ``kinks``, which is due to disturbances about to
    switch.
    """

    coefficients: Array
    error: float
    expansion: float
    kinks: float


@final
@dataclass(eq=False)
class Tube:
    """The reachable states over one box of parameters, seen along combinations of the rows of ``basis (b, d)``."""

    flow: Flow
    scene: Scene
    basis: Array
    _lengths: dict[int, arb] = field(default_factory=dict)
    _transitions: dict[int, tuple[Series, Series]] = field(default_factory=dict)
    _growths: dict[int, tuple[arb_mat, arb_mat]] = field(default_factory=dict)
    _inside: dict[int, Series] = field(default_factory=dict)
    _states: dict[tuple[int, float, int], Enclosed] = field(default_factory=dict)

    @cached_property
    def nodes(self) -> list[Series]:
        """The undisturbed state at the breakpoints of the grid."""
        from flint import arb

        x = Series.constant(self.flow.monomials, stacked([[arb(v)] for v in self.scene.initial_state]))
        found = [x]
        for k, u in enumerate(self.scene.control):
            Phi, Gamma = self._transition(self._span(self.scene.grid[k], self.scene.grid[k + 1]))
            x = Phi * x + Gamma.applied(u)
            found.append(x)
        return found

    @cached_property
    def remainder(self) -> Remainder | None:
        """Bounds of what the expansion leaves out; ``None`` for a known system."""
        if not self.flow.centre:
            return None
        horizon, scene, parts = self.scene.grid[-1], self.scene, self.flow.parts
        control = np.max([_sizes(u) for u in scene.control], axis=0) if scene.control else np.zeros((0, 1))
        begun = np.zeros(len(scene.initial_state))
        if scene.initial_set is not None:
            begun = np.array(known(scene.initial_set).radius)
        speed = (np.abs(scene.initial_state) + begun) / horizon + (_sizes(parts["B"][0]) @ control)[:, 0]
        if scene.disturbance is not None:
            speed += _sizes(parts["E"][0]) @ np.array(known(scene.disturbance).radius)
        return Remainder.of(self.flow, horizon, speed)

    @cached_property
    def norms(self) -> list[arb_mat]:
        """The norms of the coefficients left out, at the breakpoints, from any initial state (see `Remainder`)."""
        from flint import arb

        rest = self.remainder
        assert rest is not None
        n = rest.start(upper(norm(rest.inverse * stacked([[arb(v)] for v in self.scene.initial_state]))))
        found = [n]
        for k, u in enumerate(self.scene.control):
            growth, driven = self._growth(self._span(self.scene.grid[k], self.scene.grid[k + 1]))
            seen = [rest.inverse * part for part in self.nodes[k + 1].parts]
            n = rest.closer(growth * n + driven * _absolute(u), seen, self.flow.monomials.exponents)
            found.append(n)
        return found if self.scene.initial_set is None else [a + b for a, b in zip(found, self._strays, strict=True)]

    @property
    def _strays(self) -> list[arb_mat]:
        """What `norms` has for deviations from the initial state, whatever their signs: those of the transition times
        the largest one."""
        from flint import arb, arb_mat

        rest, shape = self.remainder, self.scene.initial_set
        assert rest is not None and shape is not None
        inverse = stacked([[abs(x) for x in row] for row in rest.inverse.tolist()])
        size = upper(norm(inverse * stacked([[arb(v)] for v in known(shape).radius])))
        T, transition = arb_mat(rest.transform.tolist()), None
        found = [rest.start(size)]
        for start, stop in pairwise(self.scene.grid):
            key = self._span(start, stop)
            step = self._transition(key)[0]
            transition = step if transition is None else step * transition
            seen = [rest.inverse * part * T * size for part in transition.parts]
            found.append(rest.closer(self._growth(key)[0] * found[-1], seen, self.flow.monomials.exponents))
        return found

    def _span(self, start: float, stop: float) -> int:
        """The key of a duration; equal keys share one ball."""
        from flint import arb

        length = arb(stop) - arb(start)
        key = round((stop - start) / self.scene.tick)
        self._lengths[key] = self._lengths[key].union(length) if key in self._lengths else length
        return key

    def _prepare(self) -> None:
        """Every duration of the grid must be known before one is used, since balls may still grow."""
        for start, stop in zip(self.scene.grid[:-1], self.scene.grid[1:], strict=True):
            self._span(start, stop)

    def __post_init__(self) -> None:
        self._prepare()

    def _transition(self, key: int) -> tuple[Series, Series]:
        if key not in self._transitions:
            self._transitions[key] = self.flow.states.held(self.flow.inputs, self._lengths[key])
        return self._transitions[key]

    def _growth(self, key: int) -> tuple[arb_mat, arb_mat]:
        if key not in self._growths:
            rest = self.remainder
            assert rest is not None
            self._growths[key] = held(rest.growth, rest.control, self._lengths[key])
        return self._growths[key]

    def cells(self, piece: int, start: float, stop: float, z: Array, sharp: bool = False) -> list[Polynomial]:
        """For every ``c = z_i'basis``, ``z (k, b)``, the polynomial above ``c'x`` on ``[start, stop]``, a part
        of piece ``piece`` of the grid; ``sharp``: with less for disturbances about to switch, where that can be."""
        from flint import arb

        ticks = self.scene.ticks(start, stop)  # never shorter than the cell: a bound on a little more is a bound
        offset, length = arb(start) - arb(self.scene.grid[piece]), self.scene.duration(ticks)
        state = self._state_part(piece, start, ticks)
        mid = np.einsum("jkb,ib->ijk", state.mid, z)
        lost = state.rad + rounding(z.shape[1]) * np.abs(state.mid)
        rad, kinks = np.einsum("jkb,ib->i", lost, np.abs(z)), np.zeros(z.shape[0])
        if self.scene.disturbance is not None and stop > 0.0:
            moved, off, kinks = self.sigmas.bounds(start, ticks, z, sharp)
            rad += off + rounding(1) * (np.abs(mid) + np.abs(moved)).sum(axis=(1, 2))
            mid = mid + moved
        if self.scene.initial_set is not None:
            moved, off, switching = self.sigmas.begun(start, ticks, z, sharp)
            rad += off + rounding(1) * (np.abs(mid) + np.abs(moved)).sum(axis=(1, 2))
            mid, kinks = mid + moved, kinks + switching
        rest = self._left_out(piece, offset, length, z)
        return [
            Polynomial(mid[i], float(rad[i] + rest[i]) * OUTWARD, float(rest[i]), float(kinks[i]))
            for i in range(z.shape[0])
        ]

    def _state_part(self, piece: int, start: float, ticks: int) -> Enclosed:
        """``basis x`` of the undisturbed state, ``(J + 1, M, b)``."""
        from flint import arb

        if (piece, start, ticks) in self._states:
            return self._states[piece, start, ticks]
        offset = arb(start) - arb(self.scene.grid[piece])
        x, u = self.nodes[piece], self.scene.control[min(piece, len(self.scene.control) - 1)]
        if not offset.is_zero():
            Phi, Gamma = self.flow.states.held(self.flow.inputs, offset)
            x = Phi * x + Gamma.applied(u)
        terms = [x]
        if ticks:
            length = self.scene.duration(ticks)
            if ticks not in self._inside:
                self._inside[ticks] = self.flow.states.scaled(up_to(length)).exp()
            terms += in_time(
                self.flow.states, self.flow.states * x + self.flow.inputs.applied(u), length, self._inside[ticks]
            )
        rows = stacked([[arb(float(v)) for v in c] for c in self.basis])
        every = Enclosed.of(stacked([(rows * part).entries() for term in terms for part in term.parts]))
        shape = (len(terms), self.flow.monomials.size, self.basis.shape[0])
        if len(self._states) >= STATES_KEPT:
            self._states.clear()
        self._states[piece, start, ticks] = Enclosed(every.mid.reshape(shape), every.rad.reshape(shape))
        return self._states[piece, start, ticks]

    @cached_property
    def sigmas(self) -> DisturbanceSupports:
        """What the disturbance may add."""
        return DisturbanceSupports(self.flow, self.scene, self.basis)

    def _left_out(self, piece: int, offset: arb, length: arb, z: Array) -> Array:
        """Lagrange's remainder ``(k,)`` of the state and of what the disturbance adds, for every direction."""
        rest = self.remainder
        if rest is None:
            return np.zeros(z.shape[0])
        u = self.scene.control[min(piece, len(self.scene.control) - 1)]
        growth, driven = held(rest.growth, rest.control, up_to(offset + length))
        last = upper((growth * self.norms[piece] + driven * _absolute(u))[rest.growth.nrows() - 1, 0])
        per_size = float((last + self._support_out).upper()) * OUTWARD
        table = self.basis @ rest.transform  # rounded, which the second term covers
        terms = rounding(sum(self.basis.shape)) * np.abs(z) @ (np.abs(self.basis) @ np.abs(rest.transform))
        answer: Array = per_size * (np.linalg.norm(z @ table, axis=1) + np.linalg.norm(terms, axis=1)) * OUTWARD
        return answer

    @property
    def _support_out(self) -> arb:
        """The remainder of the disturbance's part up to the horizon, for a direction of size 1."""
        from flint import arb

        return arb(0) if self.scene.disturbance is None else self._support_per_size

    @cached_property
    def _support_per_size(self) -> arb:
        """By the norms of the transition's coefficients, which are looked at anew after every step."""
        from flint import arb, arb_mat

        rest = self.remainder
        assert rest is not None and self.scene.disturbance is not None
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


def _sizes(matrix: arb_mat) -> Array:
    """The absolute values of the middles of balls."""
    return np.array([[abs(float(x.mid())) for x in row] for row in matrix.tolist()])
