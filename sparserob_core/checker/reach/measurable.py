"""A closed loop under measurable disturbances: what they make of the state by the end of every piece, and within one.

On a piece of the grid a disturbance ``w = m + z`` pushes the state by ``e = int e^{A r} E z dr``, ``r`` the time that
is left of the piece; the control of later pieces answers ``e``, and nothing else of the disturbance. So the worst of
``a'e`` is the integral of the support function of ``E'e^{A'r} a``. It is enclosed: on cells the corner of the set that
is best there stands for all, and where another one could be better, by how much is bounded.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import accumulate, pairwise
from typing import TYPE_CHECKING, final

import numpy as np

from sparserob_core.checker.arithmetic.balls import balls
from sparserob_core.checker.arithmetic.remembered import remembered
from sparserob_core.checker.arithmetic.series import identity, stacked
from sparserob_core.checker.flow.flow import VerifiedFlow
from sparserob_core.checker.reach.closed_loop import VerifiedLoop
from sparserob_core.checker.reach.deviations import Deviations, of_block, rounded_radii
from sparserob_core.checker.reach.kernels import above_chord, pushes
from sparserob_core.checker.sets.along import CurvedSide
from sparserob_core.checker.sets.flat import Boxed, Cornered, Segments
from sparserob_core.checker.sets.known import known, middle
from sparserob_core.checker.sets.polynomials import OUTWARD, Enclosed, product, rounding
from sparserob_core.sip.convex_set import Array, ConvexSet

if TYPE_CHECKING:
    from flint import arb, arb_mat

SETTLED = 2.0**-49  # of the heights: what another corner may add on a cell
ROUNDS = 60  # in which cells are cut
CROSSING = 8  # of them always where two corners are equally good, which is beside an end where they touch there
SECANTS = 12  # steps to where two corners are equally good
KEPT = 4096  # ways from the beginning of a piece to a time in it, of which kernels are remembered


@final
@dataclass(frozen=True, eq=False)
class Side:
    """One of the sets that add up to that of the deviations: ``corners (v, mw)``, off by at most ``rad (v, mw)``."""

    corners: Array
    rad: Array

    @staticmethod
    def of(shape: ConvexSet) -> list[Side | CurvedSide]:
        """Those of a set, counted from its middle: of a box one for every channel, of a zonotope one for every segment,
        a curved one as it is."""
        from flint import arb, fmpq

        about, seen = [arb(float(m)) for m in middle(shape)], known(shape)
        if isinstance(seen, Boxed):
            found = []
            for i, m in enumerate(about):
                axis = balls(np.eye(seen.dimension)[i])
                ends = [seen.support(axis) - m, -seen.support([-x for x in axis]) - m]
                found.append([[end if j == i else arb(0) for j in range(seen.dimension)] for end in ends])
        elif isinstance(seen, Segments):
            found = [[[arb(float(c)) - m for c, m in zip(seen.source.centre, about, strict=True)]]]
            for segment in seen.generators:
                end = [arb(fmpq(x.numerator, x.denominator)) for x in segment]
                found.append([end, [-x for x in end]])
        elif isinstance(seen, Cornered):
            exact = [[arb(fmpq(x.numerator, x.denominator)) for x in corner] for corner in seen.corners]
            found = [[[x - m for x, m in zip(corner, about, strict=True)] for corner in exact]]
        else:
            curved = CurvedSide(seen, middle(shape))
            _ = curved.far  # of a set that is not known it is `Unchecked`
            return [curved]
        return [Side(one.mid, one.rad) for one in (Enclosed.of(stacked(rows)) for rows in found)]

    @property
    def dimension(self) -> int:
        """How many coordinates there are."""
        return int(self.corners.shape[1])

    @cached_property
    def far(self) -> Array:
        """How far the set goes from 0 along every coordinate, at most, ``(mw,)``."""
        return np.asarray((np.abs(self.corners) + self.rad).max(axis=0) * OUTWARD)

    def swept(self, plain: Array, off: Array, sizes: Array, ends: Array) -> tuple[Array, Array, Array, Array]:
        """The integral over ``u`` from -1 to ``ends (n,)`` of the support function at polynomials ``plain (n, p + 1,
        mw)``, which are off by at most ``off (n, mw)`` and whose coefficients add up to ``sizes (n, mw)``: values, by
        how much more and less it may be, and the largest heights, ``(n,)`` each."""
        P = np.einsum("npw,vw->npv", plain, self.corners)
        e = (off @ (np.abs(self.corners) + self.rad).T + sizes @ self.rad.T) * OUTWARD
        return *swept(P, e, ends), np.abs(P).sum(axis=1).max(axis=1)


@final
@dataclass(frozen=True, eq=False)
class Together:
    """The sum of several ``sides``, of which there is at least one: its support function is the sum of theirs."""

    sides: Sequence[Side | CurvedSide]

    @property
    def dimension(self) -> int:
        """How many coordinates there are."""
        return self.sides[0].dimension

    @cached_property
    def far(self) -> Array:
        """`Side.far`."""
        return np.asarray(np.sum([side.far for side in self.sides], axis=0) * OUTWARD)

    def swept(self, plain: Array, off: Array, sizes: Array, ends: Array) -> tuple[Array, Array, Array, Array]:
        """`Side.swept`."""
        every = [side.swept(plain, off, sizes, ends) for side in self.sides]
        value, more, less, tops = (np.sum(part, axis=0) for part in zip(*every, strict=True))
        rounded = rounding(len(every)) * 2.0 * tops
        return value, (more + rounded) * OUTWARD, (less + rounded) * OUTWARD, tops


@final
@dataclass(frozen=True, eq=False)
class VerifiedKernel:
    """``Phi(end, s) E(s)`` for the time ``r`` that is left of an interval at ``s``, on parts one after another, as
    polynomials of ``u`` from -1 to 1 across each, times its length: coefficients ``(S, p + 1, d, mw)``, all together
    off by at most ``off (S, d, mw)``."""

    coefficients: Array
    off: Array

    @property
    def count(self) -> int:
        """How many parts there are."""
        return int(self.coefficients.shape[0])

    def along(self, a: Enclosed) -> tuple[Array, Array]:
        """``K(r)'a`` for ``a (N, d)``: polynomials ``(N, S, p + 1, mw)``, off by at most ``(N, S, mw)``."""
        size = np.abs(a.mid)
        plain = np.einsum("nd,spdw->nspw", a.mid, self.coefficients)
        large = np.einsum("nd,spdw->nsw", size, np.abs(self.coefficients))
        off = rounding(size.shape[1] + 1) * large + np.einsum("nd,sdw->nsw", size + a.rad, self.off)
        off = (off + np.einsum("nd,spdw->nsw", a.rad, np.abs(self.coefficients))) * OUTWARD
        return plain, off

    def most(self, a: Enclosed, sides: Sequence[Side | CurvedSide]) -> Enclosed:
        """The integral of the support function of ``K(r)'a`` for ``a (N, d)``: between bounds, as a middle and a radius
        ``(N,)``."""
        size, count = np.abs(a.mid), self.count
        large = np.einsum("nd,spdw->nsw", size, np.abs(self.coefficients))
        plain, off = self.along(a)
        low, high, lost = np.zeros(len(size)), np.zeros(len(size)), np.zeros(len(size))
        begun = [part.reshape(-1, *part.shape[2:]) for part in (plain, off, large)]
        off = begun[1] + rounding(off.shape[2] + 2 * self.coefficients.shape[1] + 6) * begun[2]
        for side in sides:
            every = side.swept(begun[0], off, begun[2], np.ones(len(off)))
            *bounds, tops = (one.reshape(len(size), -1) for one in every)
            value, more, less = (one.sum(axis=1) for one in bounds)
            low, high = low + value - less, high + value + more
            lost += rounding(4 * count + 8) * 2.0 * tops.sum(axis=1)
        low, high = low / 2.0, high / 2.0  # of u from -1 to 1
        rad = (high - low) / 2.0 + (lost / 2.0 + rounding(4) * (np.abs(low) + np.abs(high)))
        return Enclosed((low + high) / 2.0, rad * OUTWARD)


def swept(P: Array, e: Array, ends: Array) -> tuple[Array, Array, Array]:
    """The integral over ``u`` from -1 to ``ends (M,)`` of the largest of polynomials ``P (M, p + 1, v)``, which are off
    by at most ``e (M, v)``, rounding of what is added up to two values of theirs included: values, and by how much more
    and less it may be, ``(M,)``."""
    orders = np.arange(P.shape[1])
    here, start, stop = np.arange(len(P)), -np.ones(len(P)), ends.copy()
    value, more, less = np.zeros(len(P)), np.zeros(len(P)), np.zeros(len(P))
    allowed = SETTLED * np.abs(P).sum(axis=1).max(axis=1)
    weights = 1.0 / (orders + 1.0)
    for turn in range(ROUNDS + 1):
        Q = P[here]
        left, right = _valued(Q, start), _valued(Q, stop)
        best, rows, width = (left + right).argmax(axis=1), np.arange(here.size), stop - start
        G = Q[rows, :, best][:, :, None] - Q
        g = [one[rows, best][:, None] - one for one in (left, right)]
        below = np.maximum(0.0, -np.minimum(*g))
        bend = (np.abs(G) * (orders * (orders - 1))[:, None]).sum(axis=1)
        near = (np.sqrt(np.maximum(g[0], 0.0)) + np.sqrt(np.maximum(g[1], 0.0))) ** 2
        dips = np.where(near >= bend * (width**2 / 2.0)[:, None], 0.0, bend * (width**2 / 8.0)[:, None])
        wrong = (below + dips) * (1.0 + 1e-13)
        wrong[rows, best] = 0.0
        wrong = wrong.max(axis=1)
        # where all are within what they are off by, no cut tells them apart
        settled = (wrong * width <= allowed[here]) | (wrong <= e[here].max(axis=1)) | (turn == ROUNDS)
        done, at = rows[settled], here[settled]
        chosen = Q[done, :, best[done]] * weights
        area = _valued(chosen, stop[done]) * stop[done] - _valued(chosen, start[done]) * start[done]
        own, others = e[at, best[done]], e[at].max(axis=1)
        np.add.at(value, at, area)
        # of more parts than two both ends are added up as well
        rounded = 2.0 * rounding(orders.size + 4) * np.abs(chosen).sum(axis=1) * (turn > 1)
        np.add.at(more, at, (wrong[done] + own + 2.0 * others) * width[done] + rounded)
        np.add.at(less, at, own * width[done] + rounded)
        if settled.all():
            break
        rest = rows[~settled]
        a, b = left[rest].argmax(axis=1), right[rest].argmax(axis=1)
        cut = (start[rest] + stop[rest]) / 2.0
        if turn < CROSSING or turn % 2:
            cut = _equal(Q[rest, :, a] - Q[rest, :, b], start[rest], stop[rest])
        here = np.tile(here[rest], 2)
        start, stop = np.concatenate([start[rest], cut]), np.concatenate([cut, stop[rest]])
    return value, more * OUTWARD, less * OUTWARD


def _valued(P: Array, u: Array) -> Array:
    """Polynomials ``(M, p + 1, ...)`` at ``u (M,)``."""
    powers = u[:, None] ** np.arange(P.shape[1])
    return np.asarray(np.einsum("mp,mp...->m...", powers, P))


def _equal(P: Array, start: Array, stop: Array) -> Array:
    """Near a root of polynomials ``(M, p + 1)`` whose signs differ at the ends, by secants of which the older end
    counts half (Illinois); the middle elsewhere. Wherever it is, what is claimed holds."""
    a, b, fa, fb = start, stop, _valued(P, start), _valued(P, stop)
    middle_of = (a + b) / 2.0
    crossing, cut = fa * fb < 0.0, middle_of
    for _ in range(SECANTS):
        with np.errstate(divide="ignore", invalid="ignore"):
            cut = np.where(crossing, b - fb * (b - a) / (fb - fa), middle_of)
        cut = np.where(np.isfinite(cut), cut, middle_of)
        f = _valued(P, cut)
        turned = f * fb < 0.0
        a, fa = np.where(turned, b, a), np.where(turned, fb, fa / 2.0)
        b, fb = cut, f
    least = 1e-9 * (stop - start)
    return np.asarray(np.where(crossing & (cut > start + least) & (cut < stop - least), cut, middle_of))


@final
@dataclass(frozen=True, eq=False)
class MeasurableDeviations(Deviations):
    """What measurable disturbances make of the state by the end of every piece of the ``grid``, ``(d,)`` each, through
    a ``flow``; and the deviation of the initial state."""

    flow: VerifiedFlow
    grid: list[float]

    @property
    def blocks(self) -> int:
        return len(self.grid) - 1

    @property
    def begun(self) -> int:
        return self.blocks

    @cached_property
    def starts(self) -> list[int]:
        return [0, *accumulate([self.flow.states] * (self.blocks + len(self.sets)))]

    @cached_property
    def sets(self) -> list[tuple[ConvexSet, Array]]:
        return [] if self.initial is None else [(self.initial, middle(self.initial))]

    @cached_property
    def sides(self) -> list[Side | CurvedSide]:
        """The sets of the disturbances, which add up."""
        assert self.shape is not None
        return Side.of(self.shape)

    def kernel(self, piece: int) -> VerifiedKernel:
        """That of a piece."""
        return self.way(self.grid[piece], self.grid[piece + 1])

    @remembered(lambda: KEPT, lambda self, start, stop: self.flow.alike(start, stop))
    def way(self, start: float, stop: float) -> VerifiedKernel:
        """The kernel of an interval, whose parts are those between marks, in shares of each."""
        every, onward = list[Enclosed](), identity(self.flow.states)
        columns = slice(self.flow.driven, self.flow.driven + self.width)
        for first, last in reversed(list(pairwise(self.flow.marks([start, stop])))):
            terms = pushes(self.flow, first, last, columns)
            every.append(product(Enclosed.of(onward), Enclosed(terms.mid[:, 0], terms.rad[:, 0])))
            onward = onward * self.flow.over(first, last)[0].matrix
        most = max(len(one.mid) for one in every)
        mid, rad = (
            np.array([np.pad(part, ((0, most - len(part)), (0, 0), (0, 0))) for part in parts])
            for parts in zip(*((one.mid, one.rad) for one in every), strict=True)
        )
        return VerifiedKernel(mid, rad.sum(axis=1) * OUTWARD)

    @cached_property
    def radii(self) -> Array:
        d = self.flow.states
        axes = np.vstack([np.eye(d), -np.eye(d)])
        exact = Enclosed(axes, np.zeros_like(axes))
        alike: dict[int, tuple[VerifiedKernel, Array]] = {}  # kernels are kept with their numbers
        found = list[Array]()
        for piece in range(self.blocks):
            kernel = self.kernel(piece)
            if id(kernel) not in alike:
                ends = kernel.most(exact, self.sides)
                alike[id(kernel)] = kernel, (ends.mid + ends.rad).reshape(2, d).max(axis=0)
            found.append(alike[id(kernel)][1])
        return rounded_radii(found, self.sets)

    def supports(self, every: Sequence[list[arb]]) -> list[arb]:
        from flint import arb

        d, blocks = self.flow.states, self.blocks
        table = Enclosed.of(stacked(every))
        mid, rad = (part[:, : blocks * d].reshape(len(every), blocks, d) for part in (table.mid, table.rad))
        rad = np.where(rad > 1e-290, rad, 0.0)  # of exact zeros
        alike: dict[int, tuple[VerifiedKernel, list[int]]] = {}
        for piece in range(blocks):
            kernel = self.kernel(piece)
            alike.setdefault(id(kernel), (kernel, []))[1].append(piece)
        total = [arb(0)] * len(every)
        for kernel, pieces in alike.values():
            parts = Enclosed(mid[:, pieces].reshape(-1, d), rad[:, pieces].reshape(-1, d))
            used = np.flatnonzero((np.abs(parts.mid) + parts.rad).any(axis=1))
            if not used.size:
                continue
            found = kernel.most(Enclosed(parts.mid[used], parts.rad[used]), self.sides)
            for place, m, r in zip((used // len(pieces)).tolist(), found.mid.tolist(), found.rad.tolist(), strict=True):
                total[place] = total[place] + arb(m, r)
        for shape, about in self.sets:
            total = [one + of_block(shape, about, a[blocks * d :]) for one, a in zip(total, every, strict=True)]
        return total


@final
@dataclass(frozen=True, eq=False)
class MeasurableLoop(VerifiedLoop):
    """`VerifiedLoop` under measurable disturbances."""

    @cached_property
    def deviations(self) -> MeasurableDeviations:
        return MeasurableDeviations(self.shape, self.system.disturbances, self.initial, self.flow, self.grid)

    @cached_property
    def seen(self) -> list[dict[int, arb_mat]]:
        K = len(self.breakpoints) - 1
        found: list[dict[int, arb_mat]] = [{} for _ in range(K)]
        if self.initial is not None:
            found[0][self.deviations.blocks] = identity(self.system.states)
        later: tuple[int, arb_mat] = (
            K,
            identity(self.system.states),
        )  # the piece of the control, and what is left of it
        for piece in reversed(range(self.deviations.blocks)):
            k = self.on(piece)
            left = later[1] if later[0] == k else identity(self.system.states)
            if k + 1 < K:
                found[k + 1][piece] = left
            later = k, left * self._passed(piece)[0]
        return found

    def _entered(self, rows: list[list[arb]], block: int) -> None:
        """Nothing: what happens within a piece counts at its end."""

    def _ended(self, piece: int, state: arb_mat) -> arb_mat:
        rows, unit = state.tolist(), identity(self.system.states)
        for i, row in enumerate(rows):
            for j in range(len(rows)):
                row[1 + self.deviations.starts[piece] + j] = row[1 + self.deviations.starts[piece] + j] + unit[i, j]
        return stacked(rows)

    def state(self, piece: int, time: float) -> arb_mat:
        """The nominal state and every response at a time in a piece of the grid, before what happens in it counts."""
        if time == self.grid[piece]:
            return self.nodes[piece]
        Phi, added = self._moved(piece, self.grid[piece], time)
        return Phi * self.nodes[piece] + added

    def highest(self, piece: int, time: float, rows: Array | arb_mat, beside: arb_mat | None = None) -> list[arb]:
        from flint import arb

        found = super().highest(piece, time, rows, beside)
        if time == self.grid[piece]:
            return found
        added = self.under_way(piece, time, rows)
        return [one + arb(m, r) for one, m, r in zip(found, added.mid.tolist(), added.rad.tolist(), strict=True)]

    def under_way(self, piece: int, time: float, rows: Array | arb_mat) -> Enclosed:
        """What disturbances on a piece make of ``rows (r, d)`` at most until a time in it."""
        return self.deviations.way(self.grid[piece], time).most(as_enclosed(rows), self.deviations.sides)

    def bent(self, piece: int, start: float, stop: float, rows: Array | arb_mat) -> Array:
        """As of `VerifiedLoop`; what the piece itself adds is a sum of integrals of absolute values, or less."""
        axes = np.vstack([np.eye(self.system.states), -np.eye(self.system.states)])
        begun, size = (
            np.zeros(len(axes)),
            sum((side.far for side in self.deviations.sides), np.zeros(self.deviations.width)),
        )
        if start > self.grid[piece]:
            ends = self.under_way(piece, start, axes)
            begun = np.maximum(ends.mid + ends.rad, 0.0) * OUTWARD
        states = begun.reshape(2, -1).max(axis=0)
        more = above_chord(self.flow, rows, start, stop, states, size * OUTWARD, self.flow.driven)
        return np.asarray((super().bent(piece, start, stop, rows) + more) * OUTWARD)


def as_enclosed(rows: Array | arb_mat) -> Enclosed:
    """Rows of floats, or of balls."""
    return Enclosed(rows, np.zeros_like(rows)) if isinstance(rows, np.ndarray) else Enclosed.of(rows)


def signed(P: Array, off: Array) -> tuple[Array, Array]:
    """Polynomials ``(n, p + 1, m)`` with their opposites, one after another, ``(n m, p + 1, 2)``, and how far both are
    off."""
    each = np.moveaxis(P, 2, 1).reshape(-1, P.shape[1])
    return np.stack([each, -each], axis=2), np.repeat(off.reshape(-1, 1), 2, axis=1)
