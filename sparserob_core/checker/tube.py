"""The worst case of ``c'x(t)`` over every disturbance, on cells of time and over one box of parameters, as polynomials with an error."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import TYPE_CHECKING, final

import numpy as np

from sparserob_core.checker.flow import Flow, exponential, held, in_time, norm, stacked, up_to, upper
from sparserob_core.checker.polynomials import OUTWARD, ROUNDING, Enclosed
from sparserob_core.checker.pushes import SAME, Pushes, Scene
from sparserob_core.checker.shapes import radius
from sparserob_core.sip.convex_set import Array

if TYPE_CHECKING:
    from flint import arb, arb_mat

@final
@dataclass(frozen=True, eq=False)
class Polynomial:
    """``coefficients (J + 1, M)`` in powers of the time within the cell (from 0 to 1) and monomials of the parameters; the truth exceeds it by
    at most ``error``, of which ``expansion`` is due to the size of the box of parameters and ``kinks`` to disturbances about to switch."""

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
    _made: dict[object, object] = field(default_factory=dict)

    @cached_property
    def nodes(self) -> list[arb_mat]:
        """The coefficients of the undisturbed state at the breakpoints of the grid."""
        from flint import arb

        M, x0 = self.flow.monomials.size, self.scene.initial_state
        x = stacked([[arb(v if k == 0 else 0.0)] for k in range(M) for v in x0])
        found = [x]
        for k, u in enumerate(self.scene.control):
            Phi, Gamma = self._held("state", self._span(self.scene.grid[k], self.scene.grid[k + 1]))
            x = Phi * x + Gamma * u
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
            growth, driven = self._held("norms", self._span(self.scene.grid[k], self.scene.grid[k + 1]))
            n = self._up(growth * n + driven * upper(norm(u)))
            found.append(n)
        return found

    def _up(self, balls: arb_mat) -> arb_mat:
        return stacked([[upper(x)] for x in balls.entries()])

    def _span(self, start: float, stop: float) -> int:
        """The key of a duration; equal keys share one ball."""
        from flint import arb

        length = arb(stop) - arb(start)
        key = round((stop - start) / (SAME * self.scene.grid[-1]))
        self._lengths[key] = self._lengths[key].union(length) if key in self._lengths else length
        return key

    def _prepare(self) -> None:
        """Every duration of the grid must be known before one is used, since balls may still grow."""
        for start, stop in zip(self.scene.grid[:-1], self.scene.grid[1:], strict=True):
            self._span(start, stop)

    def __post_init__(self) -> None:
        self._prepare()

    def _held(self, what: str, key: int) -> tuple[arb_mat, arb_mat]:
        length = self._lengths[key]
        name = (what, "held", str(length))
        if name not in self._made:
            if what == "state":
                self._made[name] = held(self.flow.states, self.flow.inputs, length)
            else:
                rest = self.flow.remainder
                assert rest is not None
                self._made[name] = held(rest.growth, stacked([[b] for b in rest.control]), length)
        return self._made[name]  # type: ignore[return-value]

    def cells(self, piece: int, start: float, stop: float, directions: Sequence[Array]) -> list[Polynomial]:
        """For every direction ``c (d,)`` the polynomial above ``c'x`` on ``[start, stop]``, a part of piece ``piece`` of the grid."""
        from flint import arb

        offset, length = arb(start) - arb(self.scene.grid[piece]), arb(stop) - arb(start)
        state, push = self._state_part(piece, offset, length, directions), None
        if self.scene.disturbance is not None and stop > 0.0:
            push = [self.pushes.bound(start, length, c) for c in directions]
        rest = self._left_out(piece, offset, length, directions)
        answer = []
        for i in range(len(directions)):
            mid, rad, kinks = state[i].mid, float(state[i].rad.sum()), 0.0
            if push is not None:
                moved, off, kinks = push[i]
                rad += off + float(ROUNDING * (np.abs(mid) + np.abs(moved)).sum())
                mid = mid + moved
            answer.append(Polynomial(mid, (rad + rest[i] + kinks) * OUTWARD, rest[i], kinks))
        return answer

    def _state_part(self, piece: int, offset: arb, length: arb, directions: Sequence[Array]) -> list[Enclosed]:
        from flint import arb

        x, u = self.nodes[piece], self.scene.control[min(piece, len(self.scene.control) - 1)]
        if not offset.is_zero():
            Phi, Gamma = held(self.flow.states, self.flow.inputs, offset)
            x = Phi * x + Gamma * u
        terms = [x]
        if not length.is_zero():
            derivative = self.flow.states * x + self.flow.inputs * u
            terms += in_time(self.flow.states, derivative, length, self._inside(length))
        M, d = self.flow.monomials.size, len(self.scene.initial_state)
        answer = []
        for c in directions:
            exact = [arb(float(v)) for v in c]
            table = [[sum((exact[i] * term[k * d + i, 0] for i in range(d) if c[i]), arb(0)) for k in range(M)] for term in terms]
            answer.append(Enclosed.of(stacked(table)))
        return answer

    def _inside(self, length: arb) -> arb_mat:
        key = ("inside", str(length))
        if key not in self._made:
            self._made[key] = exponential(self.flow.states, up_to(length))
        return self._made[key]  # type: ignore[return-value]

    @cached_property
    def pushes(self) -> Pushes:
        """What the disturbance may add."""
        return Pushes(self.flow, self.scene)

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
            size = upper(norm(stacked([[sum((arb(float(c[i])) * arb(float(rest.transform[i, j])) for i in range(c.size)), arb(0))
                                        for j in range(c.size)]])))
            answer.append(float((size * last + self._pushed_out(size)).upper()) * OUTWARD)
        return answer

    def _pushed_out(self, size: arb) -> arb:
        """The remainder of the disturbance's part up to the horizon, for a direction of that size."""
        from flint import arb

        rest = self.flow.remainder
        if self.scene.disturbance is None or rest is None:
            return arb(0)
        if "pushed" not in self._made:
            total = held(rest.growth, rest.start(arb(1)), arb(self.scene.grid[-1]))[1]
            last = rest.growth.nrows() - 1
            columns = zip(radius(self.scene.disturbance), rest.disturbance, strict=True)
            self._made["pushed"] = sum((arb(w) * total[last - i, 0] * e for w, per in columns for i, e in enumerate(per)), arb(0))
        return size * self._made["pushed"]  # type: ignore[operator]
