"""A closed loop under measurable disturbances: their effect on the state at the end of every piece, and within a piece.

On a piece of the grid a disturbance ``w = m + z`` moves the state by ``e = int e^{A r} E z dr``, where ``r`` is the
time that is left of the piece. The control of later pieces answers ``e``, and nothing else of the disturbance. So the
largest ``a'e`` is the integral of the support function of ``E'e^{A'r} a``, which is enclosed.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property
from itertools import accumulate, pairwise
from typing import TYPE_CHECKING, final

import numpy as np

from sparserob_core.checker.arithmetic.remembered import remembered
from sparserob_core.checker.arithmetic.series import identity, stacked
from sparserob_core.checker.flow.flow import VerifiedFlow
from sparserob_core.checker.reach.closed_loop import VerifiedLoop
from sparserob_core.checker.reach.deviations import Deviations, of_block, rounded_radii
from sparserob_core.checker.reach.kernels import above_chord, compute_kernel
from sparserob_core.checker.sets.along import NormSummand
from sparserob_core.checker.sets.known import middle, summands_of
from sparserob_core.checker.sets.polynomials import OUTWARD, Enclosed, product, rounding
from sparserob_core.checker.sets.summands import Summand, integrate
from sparserob_core.sip.convex_set import Array, ConvexSet

if TYPE_CHECKING:
    from flint import arb, arb_mat

KEPT = 4096  # intervals from the beginning of a piece to a time in it, whose kernels are remembered


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

    def integrate_support(self, a: Enclosed, summands: Sequence[Summand | NormSummand]) -> Enclosed:
        """Return the integral of the support function of ``K(r)'a`` over all parts, for ``a (N, d)``, as middles and
        radii ``(N,)``. The set is the sum of ``summands``."""
        polynomials = (values.reshape(-1, *values.shape[2:]) for values in self.along(a))
        ends = np.stack(integrate(summands, *polynomials)).reshape(2, len(a.mid), -1)
        low, high = ends.sum(axis=2)
        rounded = rounding(ends.shape[2] + 4) * np.abs(ends).sum(axis=(0, 2))
        return Enclosed((low + high) / 2.0, ((high - low) / 2.0 + rounded) * OUTWARD)


@final
@dataclass(frozen=True, eq=False)
class MeasurableDeviations(Deviations):
    """The effects of measurable disturbances on the state at the end of every piece of the ``grid``, ``(d,)`` each, by
    a ``flow``; and the initial deviation."""

    flow: VerifiedFlow = field(kw_only=True)
    grid: list[float] = field(kw_only=True)

    @cached_property
    def starts(self) -> list[int]:
        return [0, *accumulate([self.flow.states] * (self.blocks + len(self.sets)))]

    @cached_property
    def sets(self) -> list[tuple[ConvexSet, Array]]:
        return [] if self.initial is None else [(self.initial, middle(self.initial))]

    @cached_property
    def summands(self) -> list[Summand | NormSummand]:
        """The sets whose sum is the set of the disturbances about its middle."""
        assert self.shape is not None
        return summands_of(self.shape)

    def kernel(self, piece: int) -> VerifiedKernel:
        """Return the kernel of a piece of the grid."""
        return self.build_kernel(self.grid[piece], self.grid[piece + 1])

    @remembered(lambda: KEPT, lambda self, start, stop: self.flow.alike(start, stop))
    def build_kernel(self, start: float, stop: float) -> VerifiedKernel:
        """Return the kernel of an interval; its parts are the intervals between marks, each with its own ``u`` from -1
        to 1."""
        kernels, transition = list[Enclosed](), identity(self.flow.states)
        columns = slice(self.flow.driven, self.flow.driven + self.width)
        for first, last in reversed(list(pairwise(self.flow.marks([start, stop])))):
            terms = compute_kernel(self.flow, first, last, columns)
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
                ends = kernel.integrate_support(exact, self.summands)
                cached[id(kernel)] = kernel, (ends.mid + ends.rad).reshape(2, d).max(axis=0)
            radii.append(cached[id(kernel)][1])
        return rounded_radii(radii, self.sets)

    def supports(self, every: Sequence[list[arb]]) -> list[arb]:
        """Return the support values at every ``a (Q,)``: sums of integrals of support functions."""
        from flint import arb

        d, blocks = self.flow.states, self.blocks
        table = Enclosed.of(stacked(every))
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
            integrals = kernel.integrate_support(Enclosed(rows.mid[used], rows.rad[used]), self.summands)
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
        pieces, width = len(self.grid) - 1, self.system.disturbances
        return MeasurableDeviations(self.shape, width, self.initial, pieces, flow=self.flow, grid=self.grid)

    @cached_property
    def innovation_matrices(self) -> list[dict[int, arb_mat]]:
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

    def highest(self, piece: int, time: float, rows: Array | arb_mat, added_terms: arb_mat | None = None) -> list[arb]:
        """Return the `heights` of ``rows (r, d)`` at a time in a piece, with the disturbance up to this time."""
        from flint import arb

        heights = super().highest(piece, time, rows, added_terms)
        if time == self.grid[piece]:
            return heights
        effect = self.compute_partial_effect(piece, time, rows)
        return [
            height + arb(m, r) for height, m, r in zip(heights, effect.mid.tolist(), effect.rad.tolist(), strict=True)
        ]

    def compute_partial_effect(self, piece: int, time: float, rows: Array | arb_mat) -> Enclosed:
        """Return enclosures ``(r,)`` of the largest effect on ``rows (r, d)`` that deviations of the disturbance have
        on a piece, up to a time in it."""
        return self.deviations.build_kernel(self.grid[piece], time).integrate_support(
            as_enclosed(rows), self.deviations.summands
        )

    def bound_chord_error(self, piece: int, start: float, stop: float, rows: Array | arb_mat) -> Array:
        """Return upper bounds ``(r,)`` of how far ``max c'x(t)`` lies above its chord on ``[start, stop]``. The
        disturbance on the piece itself adds a sum of integrals of absolute values, or less."""
        axes = np.vstack([np.eye(self.system.states), -np.eye(self.system.states)])
        start_bounds, size = (
            np.zeros(len(axes)),
            sum((summand.radii for summand in self.deviations.summands), np.zeros(self.deviations.width)),
        )
        if start > self.grid[piece]:
            ends = self.compute_partial_effect(piece, start, axes)
            start_bounds = np.maximum(ends.mid + ends.rad, 0.0) * OUTWARD
        states = start_bounds.reshape(2, -1).max(axis=0)
        chord_error = above_chord(self.flow, rows, start, stop, states, size * OUTWARD, self.flow.driven)
        return np.asarray((super().bound_chord_error(piece, start, stop, rows) + chord_error) * OUTWARD)


def as_enclosed(rows: Array | arb_mat) -> Enclosed:
    """Return rows of floats, or of balls, with their error bounds."""
    return Enclosed(rows, np.zeros_like(rows)) if isinstance(rows, np.ndarray) else Enclosed.of(rows)
