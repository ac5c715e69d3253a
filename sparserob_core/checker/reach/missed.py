"""What enters at any time, errors of execution and measurable disturbances, through the flow of any system.

The worst of them is the sum of ``share_j |u_jk| int |c'Phi(t, s) B_j(s)| ds`` over the pieces of the command, each cut
where a segment of the system ends. What the time after a piece makes of its end is a row; ``Phi(end, s) B(s)`` on the
piece is a polynomial with balls as coefficients.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise
from itertools import product as every_choice
from typing import TYPE_CHECKING, final

import numpy as np

from sparserob_core.checker.arithmetic.remembered import remembered
from sparserob_core.checker.arithmetic.series import Series, exactly, products
from sparserob_core.checker.flow.flow import VerifiedFlow
from sparserob_core.checker.flow.flows import VerifiedFlows
from sparserob_core.checker.flow.law import ParameterBox
from sparserob_core.checker.reach.kernels import Added, BoundedInput, BoundedInputHere, above_chord, pushes
from sparserob_core.checker.reach.measurable import Side, Together, signed, swept
from sparserob_core.checker.reach.states import enclosed, ring
from sparserob_core.checker.reach.tube import Around
from sparserob_core.checker.sets.along import CurvedSide
from sparserob_core.checker.sets.parameters import Corners
from sparserob_core.checker.sets.polynomials import OUTWARD, Enclosed, rounding
from sparserob_core.sip.convex_set import Array

if TYPE_CHECKING:
    from flint import arb_mat

KEPT = 16  # nodes, up to which the transitions from every earlier one are remembered; cells come one after another
PLACES_KEPT = 128  # parameters at which what errors do is remembered
TIMES_KEPT = 4096  # times at which what errors make of the states is remembered
MEANS = 1.0 / np.arange(1.0, 257.0)  # of |u|^p from -1 to 1


@final
@dataclass(frozen=True, eq=False)
class SizedInput:
    """The ``shares (m,)`` of a control that is ``pieces``, ``(m, 1)`` each, between ``breakpoints (K + 1,)``; there are
    none where only rows are asked for. It enters through the columns of ``[B E]`` from the ``first`` one on; the
    errors are known but for ``off (m,)``, and do not reach the ``numb`` states, which add up what is commanded.
    ``side``: what enters by all columns at once, in the place of channels of their own; there is one share of 1 then,
    and integrals are those of its support function."""

    shares: Array
    breakpoints: Array
    pieces: Sequence[arb_mat]
    first: int = 0
    off: Array | None = None
    numb: Sequence[int] = ()
    side: Side | CurvedSide | Together | None = None

    @cached_property
    def sizes(self) -> Enclosed:
        """How large errors may be on every piece of the command, ``(K, m)``."""
        control = Enclosed.all(self.pieces, (len(self.pieces), self.shares.size))
        size, off = self.shares * np.abs(control.mid), np.zeros(self.shares.size) if self.off is None else self.off
        lost = off * (np.abs(control.mid) + control.rad)
        return Enclosed(size, (self.shares * control.rad + lost + rounding(2) * size) * OUTWARD)

    @property
    def columns(self) -> slice:
        """The columns of ``[B E]`` it enters through."""
        return slice(self.first, self.first + (self.shares.size if self.side is None else self.side.dimension))

    @cached_property
    def far(self) -> Array:
        """How far from 0 at most what enters by each column is, ``(m,)``, as a multiple of its size."""
        if self.side is None:
            return np.ones(self.shares.size)
        return self.side.far

    def piece_at(self, time: float) -> int:
        """The piece of the command from a time on."""
        place = int(np.searchsorted(self.breakpoints, time, side="right")) - 1
        return min(max(0, place), len(self.pieces) - 1)

    def largest(self, piece: int) -> Array:
        """How large what enters by each column may be on a piece, ``(m,)``, at most."""
        return np.asarray((self.sizes.mid[piece] + self.sizes.rad[piece]) * self.far)

    def reaching(self, rows: Array) -> Array:
        """Rows ``(n, d)`` without the states that nothing of it reaches."""
        return np.where(np.isin(np.arange(rows.shape[1]), list(self.numb)), 0.0, rows)


@final
@dataclass(eq=False)
class BoundedInputAt(BoundedInputHere):
    """An ``input`` of a known system, which follows a ``law``."""

    law: VerifiedFlow
    input: SizedInput

    @cached_property
    def marks(self) -> list[float]:
        """Where a piece of the command begins or ends, or a segment of the system."""
        return self.law.marks(self.input.breakpoints.tolist())

    @cached_property
    def owner(self) -> np.ndarray:
        """The piece of the command that each piece between marks is in."""
        return np.searchsorted(self.input.breakpoints, np.array(self.marks[:-1]), side="right") - 1

    def least(self, c: Array, time: float) -> Array:
        """`BoundedInputHere.least`."""
        found = np.zeros((self.input.breakpoints.size - 1, self.input.shares.size))
        low, _, which = self._integrals(c[None], time, np.arange(len(self.marks) - 1))
        np.add.at(found, self.owner[which], np.maximum(low[:, 0], 0.0))
        return found * self.input.shares * (1.0 - rounding(which.size))

    def added(self, c: Array, time: float) -> tuple[float, float]:
        """`BoundedInputHere.added`."""
        low, high = self._summed(c[None], time)
        return float(low[0]), float(high[0])

    def bent(self, c: Array, start: float, stop: float) -> float:
        """`BoundedInputHere.bent`."""
        d = c.size
        begun = self._summed(np.eye(d), start)[1]
        if self.input.side is not None:
            begun = np.maximum(begun, self._summed(-np.eye(d), start)[1])
        size = self.input.largest(self.input.piece_at(start))
        return float(above_chord(self.law, c[None], start, stop, begun, size, self.input.first)[0])

    @remembered(lambda: TIMES_KEPT, lambda self, rows, time: (time, rows.tobytes()))
    def _summed(self, rows: Array, time: float) -> tuple[Array, Array]:
        """What errors add along ``rows (n, d)`` at a time, at least and at most, ``(n,)``."""
        used = np.flatnonzero((self.input.sizes.mid + self.input.sizes.rad).any(axis=1))
        low, high, which = self._integrals(rows, time, np.flatnonzero(np.isin(self.owner, used)))
        owner = self.owner[which]
        mid, rad = self.input.sizes.mid[owner, None], self.input.sizes.rad[owner, None]
        if self.input.side is None:  # an absolute value is not negative; the middle of a thin set may be beside it
            low = np.maximum(low, 0.0)
        at_least = np.where(low > 0.0, low * np.maximum(mid - rad, 0.0), low * (mid + rad)).sum(axis=(0, 2))
        at_most = (high * (mid + rad)).sum(axis=(0, 2))
        lost = rounding(2 * which.size * self.input.shares.size + 8) * at_most
        return at_least - lost * OUTWARD, at_most + lost * OUTWARD

    def _integrals(self, rows: Array, time: float, pieces: np.ndarray) -> tuple[Array, Array, np.ndarray]:
        """``int |c'Phi(t, s) B_j(s)| ds`` for ``rows (n, d)`` over those of the ``pieces`` between marks that begin
        before the time: between ``(q, n, m)`` and ``(q, n, m)``; and which pieces these are, ``(q,)``."""
        begins, rows = np.array(self.marks[:-1]), self.input.reaching(rows)
        which = pieces[begins[pieces] < time]
        if not which.size:
            none = np.zeros((0, len(rows), self.input.shares.size))
            return none, none, which
        last = int(np.searchsorted(begins, time, side="left")) - 1
        kernels, lines = [], []
        if (which < last).any():
            onwards = self.law.over(self.marks[last], time)[0].matrix
            begun = Enclosed.of(exactly(rows) * onwards)
            past, onward = which[which < last], self._onward_to(last)
            found = _carried(begun, Enclosed(onward.mid[past], onward.rad[past]))
            kernels += [self._kernel(self.marks[k], self.marks[k + 1]) for k in past]
            lines.append(found)
        if which[-1] == last:
            kernels.append(self._kernel(self.marks[last], time))
            lines.append(Enclosed(rows[None], np.zeros((1, *rows.shape))))
        order = max(one.mid.shape[0] for one in kernels)
        K = Enclosed(*(
            np.array([np.pad(part, ((0, order - len(part)), (0, 0), (0, 0))) for part in parts])
            for parts in zip(*((one.mid, one.rad) for one in kernels), strict=True)
        ))  # fmt: skip
        a, rad = (np.concatenate([getattr(one, name) for one in lines]) for name in ("mid", "rad"))
        plain = np.einsum("qnd,qpdm->qnpm", a, K.mid)
        sizes = np.abs(K.mid).sum(axis=1)
        off = np.einsum("qnd,qdm->qnm", np.abs(a), rounding(a.shape[2] + 1) * sizes + K.rad.sum(axis=1))
        off = (off + np.einsum("qnd,qdm->qnm", rad, sizes + K.rad.sum(axis=1))) * OUTWARD
        off = off + rounding(4 * order + 32) * np.abs(plain).sum(axis=2)  # as they are summed
        if self.input.side is not None:
            return *self._together(self.input.side, plain, off), which
        flat = signed(plain.reshape(-1, *plain.shape[2:]), off.reshape(-1, off.shape[2]))
        value, more, less = (one.reshape(off.shape) / 2.0 for one in swept(*flat, np.ones(off.size)))
        ends = rounding(4) * (np.abs(value) + more)
        return value - less - ends, value + more + ends, which

    @staticmethod
    def _together(side: Side | CurvedSide | Together, plain: Array, off: Array) -> tuple[Array, Array]:
        """Bounds ``(q, n, 1)`` of the integrals of the support function of a set at polynomials ``(q, n, p + 1, m)``
        that are off by ``off (q, n, m)``."""
        q, n, order, m = plain.shape
        sizes = np.abs(plain).sum(axis=2).reshape(q * n, m)
        lost = off.reshape(q * n, m) + rounding(4 * order + 32 + m) * sizes
        found = side.swept(plain.reshape(q * n, order, m), lost, sizes, np.ones(q * n))
        value, more, less, _ = (one.reshape(q, n, 1) / 2.0 for one in found)
        ends = rounding(4) * (np.abs(value) + more)
        return value - less - ends, np.maximum(value + more, 0.0) + ends

    @remembered(lambda: TIMES_KEPT)
    def _kernel(self, start: float, stop: float) -> Enclosed:
        """That of an interval, in powers of ``u`` from -1 to 1 across it, ``(p + 1, d, m)``."""
        found = pushes(self.law, start, stop, self.input.columns)
        return Enclosed(found.mid[:, 0], found.rad[:, 0])

    @remembered(lambda: KEPT)
    def _onward_to(self, node: int) -> Enclosed:
        """The transitions to a mark from the end of every piece before it, ``(node, d, d)``."""
        whole = enclosed(products(self._steps[:node])[1:])
        return Enclosed(whole.mid[:, 0], whole.rad[:, 0])

    @cached_property
    def _steps(self) -> list[Series]:
        return [self.law.over(*ends)[0] for ends in pairwise(self.marks)]


@final
@dataclass(eq=False)
class BoundedInputOver(BoundedInput):
    """`BoundedInputAt` of a control, or of disturbances, in a system with parameters that its state is no affine
    function of.

    At one parameter it is that of the known system there. Over a box: of one parameter alone a function ``f`` is
    nowhere further from its chord than half the largest ``f''`` in shares of half the interval, and the absolute value
    of a chord is not above the chord of the absolute values. So the integrals of ``|f|`` are, one parameter after
    another, at most what is linear in each between those at the corners, and half of those of the second derivatives
    more; what is beyond the degree of the expansion that these are bounded by counts twice. So it is with the
    support function of a ``side`` in the place of the absolute value: of a sum it is not above the sum of both.
    """

    flows: VerifiedFlows
    input: SizedInput

    @remembered(lambda: PLACES_KEPT, lambda self, parameter: tuple(map(float, parameter)))
    def at(self, parameter: Sequence[float]) -> BoundedInputAt:
        """That at one parameter."""
        return BoundedInputAt(self.flows.at(parameter), self.input)

    def over(self, c: Array, times: Sequence[float], within: tuple[Corners, Around] | None) -> Added:
        """`BoundedInput.over`."""
        assert within is not None
        box, flow = within
        low, high, centre, radius = map(np.array, (*box, flow.centre, flow.radius))
        signs = np.array(list(every_choice((-1.0, 1.0), repeat=low.size)))
        corners = np.where(signs > 0.0, high, low).tolist()
        found = np.array([[self.at(point).added(c, time) for time in times] for point in corners])
        middle, off = found.mean(axis=2), float((found[..., 1] - found[..., 0]).max())
        ends, numbers, rest = np.zeros((len(times), flow.monomials.size)), flow.monomials.number, 0.0
        for chosen in every_choice((0, 1), repeat=low.size):
            part = signs[:, np.flatnonzero(chosen)].prod(axis=1) @ middle / len(signs)
            if chosen in numbers:
                ends[:, numbers[chosen]] = part
            else:  # of more parameters than there are degrees
                rest += float(np.abs(part).max())
        # the corners of a box are where its shares are 1 or -1, but for what the middle and the radius round
        inside = np.minimum(high - centre, centre - low) * (1.0 - rounding(2))
        skew = float(((radius - inside) / np.where(radius > 0.0, radius, 1.0)).sum())
        rest += 2.0 * skew * float(np.ptp(middle, axis=0).max()) + rounding(4 * len(signs) + 8) * float(found.max())
        wide, lost, bent = self._curved(c, times, ParameterBox(flow.centre, flow.radius))
        least = np.array([self.at(centre.tolist()).added(c, time)[0] for time in times])
        over = max(0.0, float((middle.mean(axis=0) - least).max()))
        total = float(wide.sum()) * OUTWARD
        return Added(ends, (off + rest + total + 2.0 * lost + bent) * OUTWARD, over * OUTWARD, wide)

    def _curved(self, c: Array, times: Sequence[float], box: ParameterBox) -> tuple[Array, float, float]:
        """How far integrals may be above what is linear between the corners of a box, by each parameter, but for what
        is beyond the degree; how much that is; and in the time above a chord between ``times``."""
        flow = self.flows.holding(box)
        halves = np.array(flow.box.halves)
        shares = np.array(box.halves) / np.where(halves > 0.0, halves, 1.0) * (1.0 + rounding(4))
        exponents = np.array(flow.monomials.exponents, dtype=float)
        reached = self.input.reaching(np.ones((1, c.size)))[0]
        wide, lost, bent = np.zeros(len(shares)), 0.0, 0.0
        for time in times:
            size, off = self._summed(flow, (c * reached)[None], time)
            wide = np.maximum(wide, (size[0] @ (exponents * (exponents - 1.0))) * shares**2 / 2.0)
            lost = max(lost, float(off[0]))
        if times[-1] > times[0]:
            size, off = self._summed(flow, np.diag(reached), times[0])
            entering = self.input.largest(self.input.piece_at(times[0])) * OUTWARD
            begun = (size.sum(axis=1) + off) * OUTWARD
            ends, first = (times[0], times[-1]), self.input.first
            bent = float(above_chord(flow, (c * reached)[None], *ends, begun, entering, first)[0])
        return wide * OUTWARD, lost * OUTWARD, bent * OUTWARD

    def _summed(self, flow: VerifiedFlow, rows: Array, time: float) -> tuple[Array, Array]:
        """What errors add along ``rows (n, d)`` by a time, at most, and in absolute values: every coefficient in the
        parameters ``(n, M)``, and what is beyond these ``(n,)``."""
        onward, kernels, owner = self._reaching(flow, time)
        size, off = np.zeros((len(rows), flow.monomials.size)), np.zeros(len(rows))
        lost = onward.rad + rounding(rows.shape[1]) * np.abs(onward.mid)
        for q, piece in enumerate(owner):
            along = Enclosed(np.swapaxes(rows @ onward.mid[q], 1, 2), np.swapaxes(np.abs(rows) @ lost[q], 1, 2))
            kernel = Enclosed(np.swapaxes(kernels.mid[q], 2, 3), np.swapaxes(kernels.rad[q], 2, 3))
            entering = self.input.largest(piece) * OUTWARD
            found = ring(flow.monomials, kernel, along)  # (p + 1, M, m, n)
            size += np.einsum("pkjn,j,p->nk", np.abs(found.mid), entering, MEANS[: len(found.mid)])
            off += np.einsum("pkjn,j->n", found.rad, entering)
        return size * OUTWARD, off * OUTWARD

    @remembered(lambda: TIMES_KEPT)
    def _kernel(self, flow: VerifiedFlow, start: float, stop: float) -> Enclosed:
        """The kernel of an interval between marks."""
        return pushes(flow, start, stop, self.input.columns)

    @remembered(lambda: KEPT)
    def _reaching(self, flow: VerifiedFlow, time: float) -> tuple[Enclosed, Enclosed, np.ndarray]:
        """The transitions from the end of every interval between marks to a time, ``(q, M, d, d)``; the kernels of
        these intervals, ``(q, p + 1, M, d, m)``; and the piece of the command that each is in."""
        ends = [t for t in self.input.breakpoints.tolist() if t < time]
        marks = flow.marks([*ends, time]) if ends else [time]
        steps = [flow.over(*pair)[0] for pair in pairwise(marks)]
        d, m = flow.states, self.input.far.size
        if not steps:
            none = np.zeros((2, 0, flow.monomials.size, d, d)), np.zeros((2, 0, 1, flow.monomials.size, d, m))
            return Enclosed(*none[0]), Enclosed(*none[1]), np.zeros(0, dtype=int)
        every = [self._kernel(flow, *pair) for pair in pairwise(marks)]
        order = max(len(one.mid) for one in every)
        pad = [[np.pad(part, ((0, order - len(part)), *[(0, 0)] * 3)) for part in (one.mid, one.rad)] for one in every]
        owner = np.searchsorted(self.input.breakpoints, np.array(marks[:-1]), side="right") - 1
        return enclosed(products(steps)[1:]), Enclosed(*(np.array(one) for one in zip(*pad, strict=True))), owner


def _carried(rows: Enclosed, steps: Enclosed) -> Enclosed:
    """``rows (n, d)`` times every one of ``steps (q, d, d)``: ``(q, n, d)``."""
    size, there = np.abs(rows.mid), np.abs(steps.mid)
    rad = np.einsum("nd,qde->qne", size, steps.rad + rounding(size.shape[1]) * there)
    rad = (rad + np.einsum("nd,qde->qne", rows.rad, there + steps.rad)) * OUTWARD
    return Enclosed(np.einsum("nd,qde->qne", rows.mid, steps.mid), rad)
