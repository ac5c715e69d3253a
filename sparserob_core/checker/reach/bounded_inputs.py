"""Errors of execution and measurable disturbances, which enter at any time, in any system with a verified flow.

Their worst case is the sum of ``share_j |u_jk| int |c'Phi(t, s) B_j(s)| ds`` over the pieces of the command, where
every piece is cut at the ends of the segments of the system. A row propagates the effect from the end of a piece to the
time ``t``. On the piece, ``Phi(end, s) B(s)`` is a polynomial with balls as coefficients.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise
from itertools import product as every_choice
from typing import final

import numpy as np
from flint import arb_mat

from sparserob_core.checker.arithmetic.remembered import remembered
from sparserob_core.checker.arithmetic.series import Series, exactly, products
from sparserob_core.checker.flow.flow import VerifiedFlow
from sparserob_core.checker.flow.flows import VerifiedFlows
from sparserob_core.checker.flow.law import ParameterBox
from sparserob_core.checker.reach.kernels import Added, BoundedInput, BoundedInputHere, above_chord, compute_kernel
from sparserob_core.checker.reach.states import enclosed, ring
from sparserob_core.checker.reach.tube import Around
from sparserob_core.checker.sets.along import NormSummand
from sparserob_core.checker.sets.parameters import Corners
from sparserob_core.checker.sets.polynomials import OUTWARD, Enclosed, multiply_rows, rounding
from sparserob_core.checker.sets.summands import Summand, integrate
from sparserob_core.sip.convex_set import Array

KEPT = 16  # marks whose transitions from all earlier marks are remembered; cells come one after another
PLACES_KEPT = 128  # parameters whose inputs are remembered
TIMES_KEPT = 4096  # times at which sums are remembered, and intervals whose kernels are
MEANS = 1.0 / np.arange(1.0, 257.0)  # the means of |u|^p from -1 to 1, p = 0, 1, ...


@final
@dataclass(frozen=True, eq=False)
class SizedInput:
    """An input that is at most a share of a command. There are no pieces where only bounds per unit of command are
    needed.

    Attributes
    ----------
    shares
        The shares, ``(S,)``.
    breakpoints, pieces
        The breakpoints ``(K + 1,)`` of the command, and its values on the pieces, ``(S, 1)`` each.
    summands
        The ``S`` sets whose sum enters by ``m`` columns, each times the size of its own share of the command.
    first
        The first of the columns of ``[B c E]`` by which the input enters.
    numb
        States that no error reaches: integrals of the command.
    """

    shares: Array
    breakpoints: Array
    pieces: Sequence[arb_mat]
    summands: Sequence[Summand | NormSummand]
    first: int = 0
    numb: Sequence[int] = ()

    @cached_property
    def sizes(self) -> Enclosed:
        """The size of the input on every piece of the command, ``(K, S)``, with error bounds."""
        control = Enclosed.all(self.pieces, (len(self.pieces), self.shares.size))
        size = self.shares * np.abs(control.mid)
        return Enclosed(size, (self.shares * control.rad + rounding(2) * size) * OUTWARD)

    @property
    def columns(self) -> slice:
        """The columns of ``[B c E]`` by which the input enters."""
        return slice(self.first, self.first + self.summands[0].dimension)

    @cached_property
    def radii(self) -> Array:
        """The upper bounds ``(S, m)`` of what enters by each of the `columns`, in absolute value, for a size of 1."""
        return np.array([summand.radii for summand in self.summands])

    def piece_at(self, time: float) -> int:
        """Return the index of the piece of the command from a time on; before the first and after the last piece, that
        of these."""
        index = int(np.searchsorted(self.breakpoints, time, side="right")) - 1
        return min(max(0, index), len(self.pieces) - 1)

    def largest(self, piece: int) -> Array:
        """Return upper bounds of the absolute values of what enters by each of the `columns` on a piece, up to
        rounding."""
        return np.asarray((self.sizes.mid[piece] + self.sizes.rad[piece]) @ self.radii)

    def reaching(self, rows: Array) -> Array:
        """Return ``rows (..., d)`` with 0 for the states that the input does not reach."""
        return np.where(np.isin(np.arange(rows.shape[-1]), list(self.numb)), 0.0, rows)

    def sort_direction(self, c: Array) -> bytes:
        """Return a key of a direction ``c (d,)``, the same for the opposite direction where the input does as much."""
        is_symmetric = all(summand.is_symmetric for summand in self.summands)
        same = (c + 0.0, 0.0 - c) if is_symmetric else (c + 0.0,)  # -0 becomes 0, so that equal rows have equal bytes
        return min(row.tobytes() for row in same)


@final
@dataclass(eq=False)
class BoundedInputAt(BoundedInputHere):
    """An ``input`` of a known system with the flow ``law``."""

    law: VerifiedFlow
    input: SizedInput

    @cached_property
    def marks(self) -> list[float]:
        """The times at which a piece of the command or a segment of the system begins or ends."""
        return self.law.marks(self.input.breakpoints.tolist())

    @cached_property
    def owner(self) -> np.ndarray:
        """The index of the piece of the command that holds each interval between marks."""
        return np.searchsorted(self.input.breakpoints, np.array(self.marks[:-1]), side="right") - 1

    def least(self, c: Array, time: float) -> Array:
        """Return lower bounds ``(K, S)`` of what the worst input adds to ``c'x(t)``, for a command of size 1 on one
        piece in one channel."""
        bounds = np.zeros((self.input.breakpoints.size - 1, self.input.shares.size))
        low, _, indices = self._bound_integrals(c[None], time, np.arange(len(self.marks) - 1))
        np.add.at(bounds, self.owner[indices], np.maximum(low[:, 0], 0.0))
        return bounds * self.input.shares * (1.0 - rounding(indices.size))

    def added_at(self, c: Array, times: Array) -> tuple[Array, Array]:
        """Return lower and upper bounds of what the worst input adds to ``c'x`` at ``times (k,)``, ``(k,)`` each."""
        low, high = np.hstack([self._bound_effects(c[None], time) for time in times.tolist()])
        return low, high

    def bound_chord_errors(self, c: Array, start: Array, stop: Array) -> Array:
        """Return upper bounds ``(k,)`` of how far `added` lies above its chord on cells from ``start`` to ``stop``."""
        axes, bounds = np.vstack([np.eye(c.size), -np.eye(c.size)]), np.zeros(start.size)
        for i, (a, b) in enumerate(zip(start.tolist(), stop.tolist(), strict=True)):
            start_bounds = self._bound_effects(axes, a)[1].reshape(2, -1).max(axis=0)
            size = self.input.largest(self.input.piece_at(a))
            bounds[i] = above_chord(self.law, c[None], a, b, start_bounds, size, self.input.first)[0]
        return bounds

    @remembered(lambda: TIMES_KEPT, lambda self, rows, time: (time, rows.tobytes()))
    def _bound_effects(self, rows: Array, time: float) -> tuple[Array, Array]:
        """Return lower and upper bounds ``(n,)`` of what the worst input adds to ``rows (n, d)`` at a time."""
        used = np.flatnonzero((self.input.sizes.mid + self.input.sizes.rad).any(axis=1))
        low, high, indices = self._bound_integrals(rows, time, np.flatnonzero(np.isin(self.owner, used)))
        owner = self.owner[indices]
        mid, rad = self.input.sizes.mid[owner, None], self.input.sizes.rad[owner, None]
        # a support function may be negative, where the middle of a thin set is not in it
        lower = np.where(low > 0.0, low * np.maximum(mid - rad, 0.0), low * (mid + rad)).sum(axis=(0, 2))
        upper = (high * (mid + rad)).sum(axis=(0, 2))
        rounding_error = rounding(2 * indices.size * self.input.shares.size + 8) * upper
        return lower - rounding_error * OUTWARD, upper + rounding_error * OUTWARD

    def _bound_integrals(self, rows: Array, time: float, pieces: np.ndarray) -> tuple[Array, Array, np.ndarray]:
        """Return lower and upper bounds ``(q, n, S)`` of the integrals of the support functions of all summands along
        ``c'Phi(t, s) B(s)`` for ``rows (n, d)``, over the intervals among ``pieces`` that begin before ``time``; and
        their indices ``(q,)``."""
        begins, rows = np.array(self.marks[:-1]), self.input.reaching(rows)
        indices = pieces[begins[pieces] < time]
        if not indices.size:
            none = np.zeros((0, len(rows), self.input.shares.size))
            return none, none, indices
        last = int(np.searchsorted(begins, time, side="left")) - 1
        kernels, lines = [], []
        if (indices < last).any():
            transition = self.law.over(self.marks[last], time)[0].matrix
            last_rows = Enclosed.of(exactly(rows) * transition)
            past, transitions = indices[indices < last], self._compute_transitions(last)
            propagated = multiply_rows(last_rows, transitions[past])
            kernels += [self._compute_kernel(self.marks[k], self.marks[k + 1]) for k in past]
            lines.append(propagated.swapped(0, 1))
        if indices[-1] == last:
            kernels.append(self._compute_kernel(self.marks[last], time))
            lines.append(Enclosed(rows[None], np.zeros((1, *rows.shape))))
        order = max(kernel.mid.shape[0] for kernel in kernels)
        K = Enclosed(*(
            np.array([np.pad(array, ((0, order - len(array)), (0, 0), (0, 0))) for array in arrays])
            for arrays in zip(*((kernel.mid, kernel.rad) for kernel in kernels), strict=True)
        ))  # fmt: skip
        a, rad = (np.concatenate([getattr(line, name) for line in lines]) for name in ("mid", "rad"))
        plain = np.einsum("qnd,qpdm->qnpm", a, K.mid)
        sizes = np.abs(K.mid).sum(axis=1)
        errors = np.einsum("qnd,qdm->qnm", np.abs(a), rounding(a.shape[2] + 1) * sizes + K.rad.sum(axis=1))
        errors = (errors + np.einsum("qnd,qdm->qnm", rad, sizes + K.rad.sum(axis=1))) * OUTWARD
        flat = plain.reshape(-1, order, plain.shape[3]), errors.reshape(-1, plain.shape[3])
        ends = integrate(self.input.summands, *flat)
        low, high = (end.reshape(*plain.shape[:2], -1) for end in ends)
        return low, np.maximum(high, 0.0), indices

    @remembered(lambda: TIMES_KEPT)
    def _compute_kernel(self, start: float, stop: float) -> Enclosed:
        """Return the kernel of an interval in powers of ``u`` from -1 to 1, ``(p + 1, d, m)``, by `compute_kernel`."""
        return compute_kernel(self.law, start, stop, self.input.columns)[:, 0]

    @remembered(lambda: KEPT)
    def _compute_transitions(self, node: int) -> Enclosed:
        """Return the transitions to a mark from the end of every interval before it, ``(node, d, d)``."""
        return enclosed(products(self._interval_transitions[:node])[1:])[:, 0]

    @cached_property
    def _interval_transitions(self) -> list[Series]:
        return [self.law.over(*ends)[0] for ends in pairwise(self.marks)]


@final
@dataclass(eq=False)
class BoundedInputOver(BoundedInput):
    """An ``input`` of a system of which the state is not an affine function of the parameters.

    At one parameter it is the `BoundedInputAt` of the known system there. Over a box, take one parameter after another,
    in shares of half its interval. A function ``f`` differs from its chord by at most half of the largest ``|f''|``,
    and the absolute value of a chord is not above the chord of the absolute values. So the integrals of ``|f|`` are at
    most the interpolation of their values at the corners, linear in each parameter, plus half of the integrals of the
    largest ``|f''|``. The second derivatives are bounded by an expansion, whose remainder counts twice. The same holds
    of support functions: they are convex, and that of a sum of directions is at most the sum of both values.
    """

    flows: VerifiedFlows
    input: SizedInput

    @remembered(lambda: PLACES_KEPT, lambda self, parameter: tuple(map(float, parameter)))
    def at(self, parameter: Sequence[float]) -> BoundedInputAt:
        """Return the input at one parameter."""
        return BoundedInputAt(self.flows.at(parameter), self.input)

    def over(self, c: Array, times: Sequence[float], within: tuple[Corners, Around] | None) -> Added:
        """Return bounds of what the worst input adds to ``c'x`` at one or two ``times`` over the box ``within``: the
        interpolation of the values at its corners, and how far the true value may lie above it."""
        assert within is not None
        box, flow = within
        low, high, centre, radius = map(np.array, (*box, flow.centre, flow.radius))
        signs = np.array(list(every_choice((-1.0, 1.0), repeat=low.size)))
        corners = np.where(signs > 0.0, high, low).tolist()
        sums = np.array([[self.at(point).added(c, time) for time in times] for point in corners])
        middle, gap = sums.mean(axis=2), float((sums[..., 1] - sums[..., 0]).max())
        ends, numbers, fit_error = np.zeros((len(times), flow.monomials.size)), flow.monomials.number, 0.0
        for chosen in every_choice((0, 1), repeat=low.size):
            coefficient = signs[:, np.flatnonzero(chosen)].prod(axis=1) @ middle / len(signs)
            if chosen in numbers:
                ends[:, numbers[chosen]] = coefficient
            else:  # a monomial that the expansion does not have
                fit_error += float(np.abs(coefficient).max())
        # rounding of the middle and the radius moves the corners of the box away from shares of exactly 1 and -1
        inside = np.minimum(high - centre, centre - low) * (1.0 - rounding(2))
        skew = float(((radius - inside) / np.where(radius > 0.0, radius, 1.0)).sum())
        fit_error += 2.0 * skew * float(np.ptp(middle, axis=0).max()) + rounding(4 * len(signs) + 8) * float(sums.max())
        wide, remainder, chord_error = self._bound_curvature(c, times, ParameterBox(flow.centre, flow.radius))
        least = np.array([self.at(centre.tolist()).added(c, time)[0] for time in times])
        over = max(0.0, float((middle.mean(axis=0) - least).max()))
        total = float(wide.sum()) * OUTWARD
        return Added(ends, (gap + fit_error + total + 2.0 * remainder + chord_error) * OUTWARD, over * OUTWARD, wide)

    def _bound_curvature(self, c: Array, times: Sequence[float], box: ParameterBox) -> tuple[Array, float, float]:
        """Return bounds of what the curvature adds on a box. The first says how far the integrals may lie above the
        interpolation between corners, due to each parameter, ``(nu,)``. The others are what the remainder of the
        expansion adds, and how far they may lie above their chord between two ``times``."""
        flow = self.flows.holding(box)
        halves = np.array(flow.box.halves)
        shares = np.array(box.halves) / np.where(halves > 0.0, halves, 1.0) * (1.0 + rounding(4))
        exponents = np.array(flow.monomials.exponents, dtype=float)
        mask = self.input.reaching(np.ones((1, c.size)))[0]
        wide, remainder, chord_error = np.zeros(len(shares)), 0.0, 0.0
        for time in times:
            size, remainders = self._bound_effects(flow, (c * mask)[None], time)
            wide = np.maximum(wide, (size[0] @ (exponents * (exponents - 1.0))) * shares**2 / 2.0)
            remainder = max(remainder, float(remainders[0]))
        if times[-1] > times[0]:
            size, remainders = self._bound_effects(flow, np.diag(mask), times[0])
            entering = self.input.largest(self.input.piece_at(times[0])) * OUTWARD
            start_bounds = (size.sum(axis=1) + remainders) * OUTWARD
            ends, first = (times[0], times[-1]), self.input.first
            chord_error = float(above_chord(flow, (c * mask)[None], *ends, start_bounds, entering, first)[0])
        return wide * OUTWARD, remainder * OUTWARD, chord_error * OUTWARD

    def _bound_effects(self, flow: VerifiedFlow, rows: Array, time: float) -> tuple[Array, Array]:
        """Return upper bounds of what the input adds to ``rows (n, d)`` by a time, in absolute values: for every
        coefficient in the parameters, ``(n, M)``, and for the remainder, ``(n,)``."""
        transitions, kernels, owner = self._collect_transitions(flow, time)
        size, remainders = np.zeros((len(rows), flow.monomials.size)), np.zeros(len(rows))
        transition_errors = transitions.rad + rounding(rows.shape[1]) * np.abs(transitions.mid)
        for q, piece in enumerate(owner):
            along = Enclosed(
                np.swapaxes(rows @ transitions.mid[q], 1, 2), np.swapaxes(np.abs(rows) @ transition_errors[q], 1, 2)
            )
            kernel = kernels[q].swapped(2, 3)
            entering = self.input.largest(piece) * OUTWARD
            product = ring(flow.monomials, kernel, along)  # (p + 1, M, m, n)
            size += np.einsum("pkjn,j,p->nk", np.abs(product.mid), entering, MEANS[: len(product.mid)])
            remainders += np.einsum("pkjn,j->n", product.rad, entering)
        return size * OUTWARD, remainders * OUTWARD

    @remembered(lambda: TIMES_KEPT)
    def _compute_kernel(self, flow: VerifiedFlow, start: float, stop: float) -> Enclosed:
        """Return the kernel of an interval between marks, ``(p + 1, M, d, m)``."""
        return compute_kernel(flow, start, stop, self.input.columns)

    @remembered(lambda: KEPT)
    def _collect_transitions(self, flow: VerifiedFlow, time: float) -> tuple[Enclosed, Enclosed, np.ndarray]:
        """Return the transitions to a time from the end of every interval between marks before it, ``(q, M, d, d)``;
        the kernels of these intervals, ``(q, p + 1, M, d, m)``; and the indices ``(q,)`` of the pieces of the command
        that hold them."""
        ends = [t for t in self.input.breakpoints.tolist() if t < time]
        marks = flow.marks([*ends, time]) if ends else [time]
        steps = [flow.over(*pair)[0] for pair in pairwise(marks)]
        d, m = flow.states, self.input.radii.shape[1]
        if not steps:
            none = np.zeros((2, 0, flow.monomials.size, d, d)), np.zeros((2, 0, 1, flow.monomials.size, d, m))
            return Enclosed(*none[0]), Enclosed(*none[1]), np.zeros(0, dtype=int)
        kernels = [self._compute_kernel(flow, *pair) for pair in pairwise(marks)]
        order = max(len(kernel.mid) for kernel in kernels)
        pad = [
            [np.pad(array, ((0, order - len(array)), *[(0, 0)] * 3)) for array in (kernel.mid, kernel.rad)]
            for kernel in kernels
        ]
        owner = np.searchsorted(self.input.breakpoints, np.array(marks[:-1]), side="right") - 1
        return enclosed(products(steps)[1:]), Enclosed(*(np.array(arrays) for arrays in zip(*pad, strict=True))), owner
