"""A closed loop under measurable disturbances: their effect on the state at the end of every piece, and within a piece.

On a piece of the grid a disturbance ``w = m + z`` moves the state by ``e = int e^{A r} E z dr``, where ``r`` is the
time that is left of the piece. The control of later pieces answers ``e``, and nothing else of the disturbance. So the
largest ``a'e`` is the integral of the support function of ``E'e^{A'r} a``. This integral is enclosed. On every cell the
corner of the set that is best there stands for all corners, and the error bound says how much better another corner
could be.
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

SETTLED = 2.0**-49  # relative to the support values: how much another corner may add on a cell that is cut no further
ROUNDS = 60  # in which cells are cut
# Rounds that always cut where two corners are equally good. Later every second one halves the cell: where two corners
# touch at an end, that point lies next to this end, and such cuts gain little.
CROSSING = 8
SECANTS = 12  # steps of the search for the point where two corners are equally good
KEPT = 4096  # intervals from the beginning of a piece to a time in it, whose kernels are remembered


@final
@dataclass(frozen=True, eq=False)
class Side:
    """A summand of the set of the deviations, by its ``corners (v, mw)`` with error bounds ``rad (v, mw)``."""

    corners: Array
    rad: Array

    @staticmethod
    def of(shape: ConvexSet) -> list[Side | CurvedSide]:
        """Return sets whose sum is a given set minus its middle: for a box one for every channel, for a zonotope one
        for every segment and one for its centre, for another set with corners, and for a curved set, one."""
        from flint import arb, fmpq

        about, known_shape = [arb(float(m)) for m in middle(shape)], known(shape)
        if isinstance(known_shape, Boxed):
            sides = []
            for i, m in enumerate(about):
                axis = balls(np.eye(known_shape.dimension)[i])
                ends = [known_shape.support(axis) - m, -known_shape.support([-x for x in axis]) - m]
                sides.append([[end if j == i else arb(0) for j in range(known_shape.dimension)] for end in ends])
        elif isinstance(known_shape, Segments):
            sides = [[[arb(float(c)) - m for c, m in zip(known_shape.source.centre, about, strict=True)]]]
            for segment in known_shape.generators:
                end = [arb(fmpq(x.numerator, x.denominator)) for x in segment]
                sides.append([end, [-x for x in end]])
        elif isinstance(known_shape, Cornered):
            exact = [[arb(fmpq(x.numerator, x.denominator)) for x in corner] for corner in known_shape.corners]
            sides = [[[x - m for x, m in zip(corner, about, strict=True)] for corner in exact]]
        else:
            curved = CurvedSide(known_shape, middle(shape))
            _ = curved.far  # raises `Unchecked` for a set that the checker does not know
            return [curved]
        return [Side(enclosure.mid, enclosure.rad) for enclosure in (Enclosed.of(stacked(rows)) for rows in sides)]

    @property
    def dimension(self) -> int:
        """The number of coordinates, ``mw``."""
        return int(self.corners.shape[1])

    @cached_property
    def far(self) -> Array:
        """The upper bound of the absolute value of every coordinate on the set, ``(mw,)``."""
        return np.asarray((np.abs(self.corners) + self.rad).max(axis=0) * OUTWARD)

    def swept(self, plain: Array, off: Array, sizes: Array, ends: Array) -> tuple[Array, Array, Array, Array]:
        """Return the integrals of the support function of the set along polynomials, over ``u`` from -1 to
        ``ends (n,)``.

        Parameters
        ----------
        plain, off, sizes
            The coefficients of the polynomials, ``(n, p + 1, mw)``; their error bounds, ``(n, mw)``; the sums of the
            absolute values of the coefficients, ``(n, mw)``.
        ends
            The upper limits of the integrals, ``(n,)``.

        Returns
        -------
        tuple
            Values, how much more and how much less the true integral may be, and bounds of the absolute support values
            without their errors, ``(n,)`` each.
        """
        P = np.einsum("npw,vw->npv", plain, self.corners)
        e = (off @ (np.abs(self.corners) + self.rad).T + sizes @ self.rad.T) * OUTWARD
        return *swept(P, e, ends), np.abs(P).sum(axis=1).max(axis=1)


@final
@dataclass(frozen=True, eq=False)
class Together:
    """The Minkowski sum of several ``sides``, at least one: its support function is the sum of theirs."""

    sides: Sequence[Side | CurvedSide]

    @property
    def dimension(self) -> int:
        """The number of coordinates, ``mw``."""
        return self.sides[0].dimension

    @cached_property
    def far(self) -> Array:
        """The upper bound of the absolute value of every coordinate on the sum, ``(mw,)``."""
        return np.asarray(np.sum([side.far for side in self.sides], axis=0) * OUTWARD)

    def swept(self, plain: Array, off: Array, sizes: Array, ends: Array) -> tuple[Array, Array, Array, Array]:
        """Return the sums over all sides of what `Side.swept` returns, with the rounding errors of these sums."""
        integrals = [side.swept(plain, off, sizes, ends) for side in self.sides]
        value, excess, deficit, tops = (np.sum(values, axis=0) for values in zip(*integrals, strict=True))
        rounded = rounding(len(integrals)) * 2.0 * tops
        return value, (excess + rounded) * OUTWARD, (deficit + rounded) * OUTWARD, tops


@final
@dataclass(frozen=True, eq=False)
class VerifiedKernel:
    """The kernel ``Phi(end, s) E(s)`` of an interval, by the time ``r`` that is left of the interval at ``s``.

    The interval consists of ``S`` parts, from its end backwards. On each the kernel, times the length of the part, is a
    polynomial in ``u`` from -1 to 1: ``coefficients (S, p + 1, d, mw)``. ``off (S, d, mw)`` bounds the error of the
    polynomial.
    """

    coefficients: Array
    off: Array

    @property
    def count(self) -> int:
        """The number of parts, ``S``."""
        return int(self.coefficients.shape[0])

    def along(self, a: Enclosed) -> tuple[Array, Array]:
        """Return ``K(r)'a`` for ``a (N, d)``: polynomials ``(N, S, p + 1, mw)`` and their error bounds
        ``(N, S, mw)``."""
        size = np.abs(a.mid)
        plain = np.einsum("nd,spdw->nspw", a.mid, self.coefficients)
        large = np.einsum("nd,spdw->nsw", size, np.abs(self.coefficients))
        errors = rounding(size.shape[1] + 1) * large + np.einsum("nd,sdw->nsw", size + a.rad, self.off)
        errors = (errors + np.einsum("nd,spdw->nsw", a.rad, np.abs(self.coefficients))) * OUTWARD
        return plain, errors

    def most(self, a: Enclosed, sides: Sequence[Side | CurvedSide]) -> Enclosed:
        """Return the integral of the support function of ``K(r)'a`` over all parts, for ``a (N, d)``, as middles and
        radii ``(N,)``. The set is the sum of ``sides``."""
        size, count = np.abs(a.mid), self.count
        large = np.einsum("nd,spdw->nsw", size, np.abs(self.coefficients))
        plain, errors = self.along(a)
        low, high, rounding_error = np.zeros(len(size)), np.zeros(len(size)), np.zeros(len(size))
        flat = [arrays.reshape(-1, *arrays.shape[2:]) for arrays in (plain, errors, large)]
        errors = flat[1] + rounding(errors.shape[2] + 2 * self.coefficients.shape[1] + 6) * flat[2]
        for side in sides:
            integrals = side.swept(flat[0], errors, flat[2], np.ones(len(errors)))
            *bounds, tops = (values.reshape(len(size), -1) for values in integrals)
            value, excess, deficit = (values.sum(axis=1) for values in bounds)
            low, high = low + value - deficit, high + value + excess
            rounding_error += rounding(4 * count + 8) * 2.0 * tops.sum(axis=1)
        low, high = low / 2.0, high / 2.0  # u runs from -1 to 1, an interval of length 2
        rad = (high - low) / 2.0 + (rounding_error / 2.0 + rounding(4) * (np.abs(low) + np.abs(high)))
        return Enclosed((low + high) / 2.0, rad * OUTWARD)


def swept(P: Array, e: Array, ends: Array) -> tuple[Array, Array, Array]:
    """Return the integral of the largest of several polynomials, over ``u`` from -1 to ``ends (M,)``.

    Parameters
    ----------
    P
        The coefficients of ``v`` polynomials for each of ``M`` integrals, ``(M, p + 1, v)``.
    e
        The error bounds of the polynomials, ``(M, v)``. They allow for the rounding errors in the sum of two of their
        values.
    ends
        The upper limits of the integrals, ``(M,)``.

    Returns
    -------
    tuple
        Values, and how much more and how much less the true integral may be, ``(M,)`` each.
    """
    orders = np.arange(P.shape[1])
    owners, start, stop = np.arange(len(P)), -np.ones(len(P)), ends.copy()
    value, excess, deficit = np.zeros(len(P)), np.zeros(len(P)), np.zeros(len(P))
    allowed = SETTLED * np.abs(P).sum(axis=1).max(axis=1)
    weights = 1.0 / (orders + 1.0)
    for iteration in range(ROUNDS + 1):
        Q = P[owners]
        start_values, stop_values = _evaluate_polynomials(Q, start), _evaluate_polynomials(Q, stop)
        best, rows, width = (start_values + stop_values).argmax(axis=1), np.arange(owners.size), stop - start
        G = Q[rows, :, best][:, :, None] - Q
        g = [values[rows, best][:, None] - values for values in (start_values, stop_values)]
        below = np.maximum(0.0, -np.minimum(*g))
        bend = (np.abs(G) * (orders * (orders - 1))[:, None]).sum(axis=1)
        # a function with |f''| <= bend that is not negative at the ends is nowhere negative where this holds
        near = (np.sqrt(np.maximum(g[0], 0.0)) + np.sqrt(np.maximum(g[1], 0.0))) ** 2
        dips = np.where(near >= bend * (width**2 / 2.0)[:, None], 0.0, bend * (width**2 / 8.0)[:, None])
        shortfall = (below + dips) * (1.0 + 1e-13)
        shortfall[rows, best] = 0.0
        shortfall = shortfall.max(axis=1)
        # where the corners differ by less than their error bounds, no further cut helps
        is_settled = (
            (shortfall * width <= allowed[owners]) | (shortfall <= e[owners].max(axis=1)) | (iteration == ROUNDS)
        )
        settled, targets = rows[is_settled], owners[is_settled]
        chosen = Q[settled, :, best[settled]] * weights
        area = (
            _evaluate_polynomials(chosen, stop[settled]) * stop[settled]
            - _evaluate_polynomials(chosen, start[settled]) * start[settled]
        )
        own_errors, largest_errors = e[targets, best[settled]], e[targets].max(axis=1)
        np.add.at(value, targets, area)
        # ``e`` allows for the rounding errors of two parts; with more parts, those at both ends of each are added
        rounded = 2.0 * rounding(orders.size + 4) * np.abs(chosen).sum(axis=1) * (iteration > 1)
        np.add.at(excess, targets, (shortfall[settled] + own_errors + 2.0 * largest_errors) * width[settled] + rounded)
        np.add.at(deficit, targets, own_errors * width[settled] + rounded)
        if is_settled.all():
            break
        open_cells = rows[~is_settled]
        a, b = start_values[open_cells].argmax(axis=1), stop_values[open_cells].argmax(axis=1)
        cut = (start[open_cells] + stop[open_cells]) / 2.0
        if iteration < CROSSING or iteration % 2:
            cut = _find_crossings(Q[open_cells, :, a] - Q[open_cells, :, b], start[open_cells], stop[open_cells])
        owners = np.tile(owners[open_cells], 2)
        start, stop = np.concatenate([start[open_cells], cut]), np.concatenate([cut, stop[open_cells]])
    return value, excess * OUTWARD, deficit * OUTWARD


def _evaluate_polynomials(P: Array, u: Array) -> Array:
    """Return the values of polynomials ``(M, p + 1, ...)`` at ``u (M,)``."""
    powers = u[:, None] ** np.arange(P.shape[1])
    return np.asarray(np.einsum("mp,mp...->m...", powers, P))


def _find_crossings(P: Array, start: Array, stop: Array) -> Array:
    """Return points near a root of polynomials ``(M, p + 1)`` that differ in sign at the ends, by the Illinois method:
    secants in which the value at the older end is halved. Elsewhere return the middle. All bounds hold wherever the
    points are."""
    a, b, fa, fb = start, stop, _evaluate_polynomials(P, start), _evaluate_polynomials(P, stop)
    middle_of = (a + b) / 2.0
    crossing, cut = fa * fb < 0.0, middle_of
    for _ in range(SECANTS):
        with np.errstate(divide="ignore", invalid="ignore"):
            cut = np.where(crossing, b - fb * (b - a) / (fb - fa), middle_of)
        cut = np.where(np.isfinite(cut), cut, middle_of)
        f = _evaluate_polynomials(P, cut)
        has_changed = f * fb < 0.0
        a, fa = np.where(has_changed, b, a), np.where(has_changed, fb, fa / 2.0)
        b, fb = cut, f
    margin = 1e-9 * (stop - start)
    return np.asarray(np.where(crossing & (cut > start + margin) & (cut < stop - margin), cut, middle_of))


@final
@dataclass(frozen=True, eq=False)
class MeasurableDeviations(Deviations):
    """The effects of measurable disturbances on the state at the end of every piece of the ``grid``, ``(d,)`` each, by
    a ``flow``; and the initial deviation."""

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
        """The sets whose sum is the set of the disturbances about its middle."""
        assert self.shape is not None
        return Side.of(self.shape)

    def kernel(self, piece: int) -> VerifiedKernel:
        """Return the kernel of a piece of the grid."""
        return self.way(self.grid[piece], self.grid[piece + 1])

    @remembered(lambda: KEPT, lambda self, start, stop: self.flow.alike(start, stop))
    def way(self, start: float, stop: float) -> VerifiedKernel:
        """Return the kernel of an interval; its parts are the intervals between marks, each with its own ``u`` from -1
        to 1."""
        kernels, transition = list[Enclosed](), identity(self.flow.states)
        columns = slice(self.flow.driven, self.flow.driven + self.width)
        for first, last in reversed(list(pairwise(self.flow.marks([start, stop])))):
            terms = pushes(self.flow, first, last, columns)
            kernels.append(product(Enclosed.of(transition), Enclosed(terms.mid[:, 0], terms.rad[:, 0])))
            transition = transition * self.flow.over(first, last)[0].matrix
        order = max(len(kernel.mid) for kernel in kernels)
        mid, rad = (
            np.array([np.pad(array, ((0, order - len(array)), (0, 0), (0, 0))) for array in arrays])
            for arrays in zip(*((kernel.mid, kernel.rad) for kernel in kernels), strict=True)
        )
        return VerifiedKernel(mid, rad.sum(axis=1) * OUTWARD)

    @cached_property
    def radii(self) -> Array:
        d = self.flow.states
        axes = np.vstack([np.eye(d), -np.eye(d)])
        exact = Enclosed(axes, np.zeros_like(axes))
        cached: dict[int, tuple[VerifiedKernel, Array]] = {}  # the kernels are kept, so that their ids stay unique
        radii = list[Array]()
        for piece in range(self.blocks):
            kernel = self.kernel(piece)
            if id(kernel) not in cached:
                ends = kernel.most(exact, self.sides)
                cached[id(kernel)] = kernel, (ends.mid + ends.rad).reshape(2, d).max(axis=0)
            radii.append(cached[id(kernel)][1])
        return rounded_radii(radii, self.sets)

    def supports(self, every: Sequence[list[arb]]) -> list[arb]:
        """Return the support values at every ``a (Q,)``: sums of integrals of support functions."""
        from flint import arb

        d, blocks = self.flow.states, self.blocks
        table = Enclosed.of(stacked(every)).with_exact_zeros
        mid, rad = (values[:, : blocks * d].reshape(len(every), blocks, d) for values in (table.mid, table.rad))
        groups: dict[int, tuple[VerifiedKernel, list[int]]] = {}
        for piece in range(blocks):
            kernel = self.kernel(piece)
            groups.setdefault(id(kernel), (kernel, []))[1].append(piece)
        total = [arb(0)] * len(every)
        for kernel, pieces in groups.values():
            rows = Enclosed(mid[:, pieces].reshape(-1, d), rad[:, pieces].reshape(-1, d))
            used = np.flatnonzero((np.abs(rows.mid) + rows.rad).any(axis=1))
            if not used.size:
                continue
            integrals = kernel.most(Enclosed(rows.mid[used], rows.rad[used]), self.sides)
            for index, m, r in zip(
                (used // len(pieces)).tolist(), integrals.mid.tolist(), integrals.rad.tolist(), strict=True
            ):
                total[index] = total[index] + arb(m, r)
        for shape, about in self.sets:
            total = [value + of_block(shape, about, a[blocks * d :]) for value, a in zip(total, every, strict=True)]
        return total


@final
@dataclass(frozen=True, eq=False)
class MeasurableLoop(VerifiedLoop):
    """A `VerifiedLoop` under measurable disturbances. Its deviations are their effects on the state at the end of every
    piece of the grid, ``(d,)`` each, and the initial deviation."""

    @cached_property
    def deviations(self) -> MeasurableDeviations:
        return MeasurableDeviations(self.shape, self.system.disturbances, self.initial, self.flow, self.grid)

    @cached_property
    def seen(self) -> list[dict[int, arb_mat]]:
        """The transitions ``D_jl`` from the end of every piece ``l`` to the next breakpoint ``j`` of the control,
        ``(d, d)``."""
        K = len(self.breakpoints) - 1
        transitions: list[dict[int, arb_mat]] = [{} for _ in range(K)]
        if self.initial is not None:
            transitions[0][self.deviations.blocks] = identity(self.system.states)
        later: tuple[int, arb_mat] = (
            K,
            identity(self.system.states),
        )  # the piece of the control, and the transition to its end
        for piece in reversed(range(self.deviations.blocks)):
            k = self.on(piece)
            transition = later[1] if later[0] == k else identity(self.system.states)
            if k + 1 < K:
                transitions[k + 1][piece] = transition
            later = k, transition * self._compute_piece_flow(piece)[0]
        return transitions

    def _add_block_response(self, rows: list[list[arb]], block: int) -> None:
        """Leave the rows as they are: a disturbance within a piece counts at the end of the piece."""

    def _add_piece_effect(self, piece: int, state: arb_mat) -> arb_mat:
        """Return the state and the responses after a piece of the grid, with the effect of the disturbance on it."""
        rows, unit = state.tolist(), identity(self.system.states)
        for i, row in enumerate(rows):
            for j in range(len(rows)):
                row[1 + self.deviations.starts[piece] + j] = row[1 + self.deviations.starts[piece] + j] + unit[i, j]
        return stacked(rows)

    def state(self, piece: int, time: float) -> arb_mat:
        """Return the nominal state and the responses at a time in a piece of the grid, ``(d, 1 + Q)``. The disturbance
        on this piece is at the middle of its set; its deviation is left out."""
        if time == self.grid[piece]:
            return self.nodes[piece]
        Phi, effect = self._compute_part_flow(piece, self.grid[piece], time)
        return Phi * self.nodes[piece] + effect

    def highest(self, piece: int, time: float, rows: Array | arb_mat, beside: arb_mat | None = None) -> list[arb]:
        """Return the `heights` of ``rows (r, d)`` at a time in a piece, with the disturbance up to this time."""
        from flint import arb

        heights = super().highest(piece, time, rows, beside)
        if time == self.grid[piece]:
            return heights
        effect = self.under_way(piece, time, rows)
        return [
            height + arb(m, r) for height, m, r in zip(heights, effect.mid.tolist(), effect.rad.tolist(), strict=True)
        ]

    def under_way(self, piece: int, time: float, rows: Array | arb_mat) -> Enclosed:
        """Return the most that deviations of the disturbance on a piece add to ``rows (r, d)`` up to a time in this
        piece, ``(r,)``."""
        return self.deviations.way(self.grid[piece], time).most(as_enclosed(rows), self.deviations.sides)

    def bent(self, piece: int, start: float, stop: float, rows: Array | arb_mat) -> Array:
        """Return upper bounds ``(r,)`` of how far ``max c'x(t)`` lies above its chord on ``[start, stop]``. The
        disturbance on the piece itself adds a sum of integrals of absolute values, or less."""
        axes = np.vstack([np.eye(self.system.states), -np.eye(self.system.states)])
        start_bounds, size = (
            np.zeros(len(axes)),
            sum((side.far for side in self.deviations.sides), np.zeros(self.deviations.width)),
        )
        if start > self.grid[piece]:
            ends = self.under_way(piece, start, axes)
            start_bounds = np.maximum(ends.mid + ends.rad, 0.0) * OUTWARD
        states = start_bounds.reshape(2, -1).max(axis=0)
        chord_error = above_chord(self.flow, rows, start, stop, states, size * OUTWARD, self.flow.driven)
        return np.asarray((super().bent(piece, start, stop, rows) + chord_error) * OUTWARD)


def as_enclosed(rows: Array | arb_mat) -> Enclosed:
    """Return rows of floats, or of balls, with their error bounds."""
    return Enclosed(rows, np.zeros_like(rows)) if isinstance(rows, np.ndarray) else Enclosed.of(rows)


def signed(P: Array, off: Array) -> tuple[Array, Array]:
    """Return polynomials ``(n, p + 1, m)`` one after another with their opposites, ``(n m, p + 1, 2)``, and the error
    bounds of both, ``(n m, 2)``, from ``off (n, m)``."""
    flat = np.moveaxis(P, 2, 1).reshape(-1, P.shape[1])
    return np.stack([flat, -flat], axis=2), np.repeat(off.reshape(-1, 1), 2, axis=1)
