"""The worst case of ``c'x(t)`` over every disturbance, on cells of time and over one box of parameters, as polynomials
with an error."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import TYPE_CHECKING, final

import numpy as np

from sparserob_core.checker.arithmetic.series import Series, norm, upper
from sparserob_core.checker.reach.disturbance_support import DisturbanceSupports, Scene
from sparserob_core.checker.reach.flow import Flow, held, in_time, stacked, up_to
from sparserob_core.checker.sets.polynomials import OUTWARD, ROUNDING, Enclosed
from sparserob_core.checker.sets.shapes import radius
from sparserob_core.sip.convex_set import Array

if TYPE_CHECKING:
    from flint import arb, arb_mat


@final
@dataclass(frozen=True, eq=False)
class Polynomial:
    """``coefficients (J + 1, M)`` in powers of the time within the cell (from 0 to 1) and monomials of the parameters;
    the truth exceeds it by at most ``error``, of which ``expansion`` is due to the size of the box of parameters and
    ``kinks`` to disturbances about to switch.
    """

    coefficients: Array
    error: float
    expansion: float
    kinks: float


@final
@dataclass(eq=False)
class Tube:
    """The reachable states over one box of parameters."""

    flow: Flow
    scene: Scene
    _lengths: dict[int, arb] = field(default_factory=dict)
    _transitions: dict[int, tuple[Series, Series]] = field(default_factory=dict)
    _growths: dict[int, tuple[arb_mat, arb_mat]] = field(default_factory=dict)
    _inside: dict[int, Series] = field(default_factory=dict)

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
    def norms(self) -> list[arb_mat]:
        """The norms of the coefficients left out, at the breakpoints (see `Remainder`)."""
        from flint import arb

        rest = self.flow.remainder
        assert rest is not None
        n = rest.start(upper(norm(rest.inverse * stacked([[arb(v)] for v in self.scene.initial_state]))))
        found = [n]
        for k, u in enumerate(self.scene.control):
            growth, driven = self._growth(self._span(self.scene.grid[k], self.scene.grid[k + 1]))
            n = self._up(growth * n + driven * upper(norm(u)))
            found.append(n)
        return found

    def _up(self, balls: arb_mat) -> arb_mat:
        return stacked([[upper(x)] for x in balls.entries()])

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
            rest = self.flow.remainder
            assert rest is not None
            self._growths[key] = held(rest.growth, stacked([[b] for b in rest.control]), self._lengths[key])
        return self._growths[key]

    def cells(self, piece: int, start: float, stop: float, directions: Sequence[Array]) -> list[Polynomial]:
        """For every direction ``c (d,)`` the polynomial above ``c'x`` on ``[start, stop]``, a part of piece ``piece``
        of the grid."""
        from flint import arb

        ticks = self.scene.ticks(start, stop)  # never shorter than the cell: a bound on a little more is a bound
        offset, length = arb(start) - arb(self.scene.grid[piece]), self.scene.duration(ticks)
        state, sigma = self._state_part(piece, offset, ticks, directions), None
        if self.scene.disturbance is not None and stop > 0.0:
            sigma = [self.sigmas.bound(start, ticks, c) for c in directions]
        rest = self._left_out(piece, offset, length, directions)
        answer = []
        for i in range(len(directions)):
            mid, rad, kinks = state[i].mid, float(state[i].rad.sum()), 0.0
            if sigma is not None:
                moved, off, kinks = sigma[i]
                rad += off + float(ROUNDING * (np.abs(mid) + np.abs(moved)).sum())
                mid = mid + moved
            answer.append(Polynomial(mid, (rad + rest[i] + kinks) * OUTWARD, rest[i], kinks))
        return answer

    def _state_part(self, piece: int, offset: arb, ticks: int, directions: Sequence[Array]) -> list[Enclosed]:
        from flint import arb

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
        M, d = self.flow.monomials.size, len(self.scene.initial_state)
        answer = []
        for c in directions:
            exact = [arb(float(v)) for v in c]
            table = [
                [sum((exact[i] * term.parts[k][i, 0] for i in range(d) if c[i]), arb(0)) for k in range(M)]
                for term in terms
            ]
            answer.append(Enclosed.of(stacked(table)))
        return answer

    @cached_property
    def sigmas(self) -> DisturbanceSupports:
        """What the disturbance may add."""
        return DisturbanceSupports(self.flow, self.scene)

    def _left_out(self, piece: int, offset: arb, length: arb, directions: Sequence[Array]) -> list[float]:
        """Lagrange's remainder of the state and of what the disturbance adds, for every direction."""
        from flint import arb

        rest = self.flow.remainder
        if rest is None:
            return [0.0] * len(directions)
        u = self.scene.control[min(piece, len(self.scene.control) - 1)]
        growth, driven = held(rest.growth, stacked([[b] for b in rest.control]), up_to(offset + length))
        last = upper((growth * self.norms[piece] + driven * upper(norm(u)))[rest.growth.nrows() - 1, 0])
        answer = []
        for c in directions:
            size = upper(
                norm(
                    stacked(
                        [
                            [
                                sum(
                                    (arb(float(c[i])) * arb(float(rest.transform[i, j])) for i in range(c.size)), arb(0)
                                )
                                for j in range(c.size)
                            ]
                        ]
                    )
                )
            )
            answer.append(float((size * last + self._support_out(size)).upper()) * OUTWARD)
        return answer

    def _support_out(self, size: arb) -> arb:
        """The remainder of the disturbance's part up to the horizon, for a direction of that size."""
        from flint import arb

        return arb(0) if self.scene.disturbance is None else size * self._support_per_size

    @cached_property
    def _support_per_size(self) -> arb:
        from flint import arb

        rest = self.flow.remainder
        assert rest is not None and self.scene.disturbance is not None
        total = held(rest.growth, rest.start(arb(1)), arb(self.scene.grid[-1]))[1]
        last = rest.growth.nrows() - 1
        columns = zip(radius(self.scene.disturbance), rest.disturbance, strict=True)
        return sum((arb(w) * total[last - i, 0] * e for w, per in columns for i, e in enumerate(per)), arb(0))
