"""Weak duality in ball arithmetic: a lower bound of the cost, or the proof that no control is feasible.

Let ``y >= 0`` be multipliers of constraints ``c'x(t) + sigma <= h(c)``, and ``nu`` any multipliers of equalities. Then
no admissible control costs less than ``sum_i y_i (c_i'e^{A t_i} x(0) + sigma_i - h(c_i)) + min_u J(u) + sum_i y_i g_i
u``. The minimum is over the controls' set alone, piece by piece. Without ``J``, a positive number proves that nothing
is feasible (Farkas).
"""

from __future__ import annotations

from bisect import bisect_right
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import final

import numpy as np
from flint import arb, arb_mat

from sparserob_core.checker.arithmetic.balls import ball, largest
from sparserob_core.checker.arithmetic.series import exactly
from sparserob_core.checker.cost.price import Price, Tangent
from sparserob_core.checker.flow.flows import VerifiedFlows
from sparserob_core.checker.outcome import Broken
from sparserob_core.checker.problem.held import HeldComponents, summed
from sparserob_core.checker.problem.timing import before
from sparserob_core.checker.reach.followed import FollowedRows
from sparserob_core.checker.sets.known import known, sum_supports
from sparserob_core.checker.sets.shape import find_range
from sparserob_core.control.problem.dictionary import Dictionary
from sparserob_core.control.problem.problem import OptimalControlProblem
from sparserob_core.sip.convex_set import Array, ConvexSet

EFFORT = "effort"


@final
@dataclass(frozen=True, eq=False)
class ConstraintRow:
    """The inequality ``constant + sum_k slope_k u_k + sizes_k |u_k| <= charged`` of every feasible control.

    ``slope`` is a list of ``m`` balls per piece of the control; ``sizes (K, m)`` are nonnegative numbers, or ``None``.
    Where changes of the control may come late, ``late (K - 1, m)`` are the numbers of ``|u_{k+1} - u_k| / 2``, which
    are added likewise; `bound_changes` replaces them by a row without them.

    A control with feedback is ``u_k = v_k + sum_j M_kj e_j``, with the innovations ``e_j`` of its ``deviations``.
    A certificate names these, block by block; the nominal control has none. A control without feedback has none either,
    and its row is that of the worst deviations.
    ``charged`` is 0, or with ``(k, i)`` the peak of that piece and channel, or with `EFFORT` the effort.
    """

    constant: arb
    slope: list[list[arb]]
    sizes: Array | None = None
    deviations: Sequence[Sequence[arb]] = ()
    charged: tuple[int, int] | str | None = None
    late: Array | None = None


@final
@dataclass(frozen=True, eq=False)
class Duality:
    """The data from which lower bounds are derived.

    ``changes`` are the times at which the disturbance may jump, ``None`` without a disturbance. ``held`` is the set of
    the disturbances that are constant between these times. ``flows`` weigh the rows. ``held_components``
    says which components are held over several intervals. ``range`` is the set of the decided control on every piece,
    where that is not the set of the control.
    """

    problem: OptimalControlProblem
    control: Dictionary
    changes: list[float] | None
    flows: VerifiedFlows | FollowedRows
    held: ConvexSet | None = None
    held_components: HeldComponents | None = None
    range: ConvexSet | None = None

    def control_piece(self, time: float) -> int:
        """Return the index of the piece of the control that is commanded at a time."""
        piece = int(np.searchsorted(self.control.breakpoints, time, side="right")) - 1
        return min(max(piece, 0), self.control.pieces - 1)

    def control_row(self, direction: Array, time: float) -> ConstraintRow:
        """Return the row of ``c'u(t) <= h(c)`` for the set of controls."""
        piece = self.control_piece(time)
        slope = [[ball(0.0)] * direction.size for _ in range(self.control.pieces)]
        slope[piece] = [ball(c) for c in direction]
        return ConstraintRow(-known(self.problem.control).limit(direction), slope)

    def step_row(self, direction: Array, time: float) -> ConstraintRow:
        """Return the row of ``c'(u_k - u_{k-1}) <= h(c)`` for the step at a breakpoint, ``u_{-1}`` the control before
        time 0; raise `Broken` where the problem has no such constraint, or no step at the time."""
        if self.problem.control_step is None:
            raise Broken("the problem has no constraint 'control_step'")
        matches = [k for k in steps(self.problem, self.control) if float(self.control.breakpoints[k]) == time]
        if not matches:
            raise Broken(f"control_step: there is no step at t = {time!r}")
        (k,) = matches
        slope = [[ball(0.0)] * direction.size for _ in range(self.control.pieces)]
        after = k % self.control.pieces  # the first piece follows the last one
        slope[after] = [ball(c) for c in direction]
        constant = -known(self.problem.control_step).limit(direction)
        if k > 0:
            slope[k - 1] = [a - ball(c) for a, c in zip(slope[k - 1], direction, strict=True)]
        else:
            pairs = zip(direction, before(self.problem), strict=True)
            constant -= sum((ball(c) * ball(u) for c, u in pairs), ball(0.0))
        return ConstraintRow(constant, slope)

    def row(
        self, direction: Array, time: float, parameter: Sequence[float], limit: arb, disturbed: bool = True
    ) -> ConstraintRow:
        """Return the row of ``c'x(t) <= limit`` at one parameter: of the worst disturbance and initial state, or of
        none."""
        m, problem = self.problem.system.controls, self.problem
        delay = problem.system.delay
        piece_starts = [float(s) + delay for s in self.control.breakpoints[:-1]]  # times at which a piece begins to act
        settled = [piece_starts[0], *(s + problem.jitter for s in piece_starts[1:])]  # and is no longer late
        starts = sorted({0.0, *(s for s in (*piece_starts, *settled) if s < time)})
        weights = self.flows.weigh(direction, parameter, [*starts, time])
        initial_slope, initial_state = weights.free.entries(), np.asarray(problem.initial_state)
        constant = sum((w * ball(x) for w, x in zip(initial_slope, initial_state, strict=True)), ball(0.0)) - limit
        slope = [[ball(0.0)] * m for _ in range(self.control.pieces)]
        for start, control_weight in zip(starts, weights.control, strict=True):
            coefficients, k = control_weight.entries(), bisect_right(piece_starts, start) - 1
            if k < 0:
                constant = sum((w * ball(u) for w, u in zip(coefficients[:m], before(problem), strict=True)), constant)
            else:
                acting = [k] if start >= settled[k] else [k - 1, k]  # half of the old and half of the new value
                for j in acting:
                    slope[j] = [a + b / len(acting) for a, b in zip(slope[j], coefficients[:m], strict=True)]
            constant = sum(coefficients[m:], constant)  # a drift, whose input is 1
        if disturbed and problem.initial_set is not None:
            constant = constant + known(problem.initial_set).support(initial_slope)
        if disturbed and self.held is not None:
            block_slopes = self.compute_disturbance_weights(direction, time, parameter)
            lengths = np.diff([*(self.changes or ()), problem.horizon])
            slopes = summed(self.held_components, block_slopes)
            constant = constant + sum_supports(self.held, lengths, slopes)
        return ConstraintRow(constant, slope)

    def compute_disturbance_weights(
        self, direction: Array, time: float, parameter: Sequence[float] = ()
    ) -> list[list[arb]]:
        """Return the coefficients ``(mw,)`` of every block of the disturbance in ``c'x(t)``, at one parameter. The
        blocks begin at the `changes` of the problem."""
        jumps = self.changes
        if not jumps:
            return []
        starts = sorted({0.0, *(s for s in jumps if s < time)})
        weights = self.flows.weigh(direction, parameter, [*starts, time])
        slopes = {s: weight.entries() for s, weight in zip(starts, weights.disturbance, strict=True)}
        zero_slope = [ball(0.0)] * self.problem.system.disturbances
        return [slopes[s] if s < time else zero_slope for s in jumps]

    def compute_initial_weights(self, direction: Array, time: float) -> list[arb]:
        """Return the coefficients ``(d,)`` of the initial state in ``c'x(t)``, for a known system."""
        return list(self.flows.weigh(direction, (), [0.0, time]).free.entries())

    def bound(
        self,
        rows: Sequence[tuple[float, ConstraintRow]],
        pieces: Sequence[Sequence[float]] | None,
        price: Price | None,
        touched: Sequence[arb_mat] | None = None,
        lengths: bool = True,
        norms: Array | None = None,
    ) -> arb:
        """Return a ball whose lower end is the bound that multipliers of ``rows`` prove. ``pieces (m, K)`` are the
        negated slopes for a dictionary with fewer functions than pieces; ``price`` is the cost, ``None`` to prove
        infeasibility.

        At ``touched``, controls ``(m, 1)``, quadratic terms and norms are replaced by their tangents; ``norms (m, K)``
        are further vectors for that. ``lengths`` is False where absolute values of another control are charged."""
        tangent = None if price is None or touched is None or not price.is_quadratic else price.tangent(touched)
        constant, slopes = self.summed(rows, pieces, tangent)
        charges = price if lengths else None
        groups = [] if charges is None else [block for block in charges.blocks if len(block) > 1]
        zero_costs = [[ball(0.0)] * self.problem.system.controls] * len(slopes)
        costs = zero_costs if charges is None else charges.costs
        sizes = self.charged(rows, zero_costs)
        for k, (cost, size, slope) in enumerate(zip(costs, sizes, slopes, strict=True)):
            if groups and touched is not None:
                offered = None if norms is None else [ball(v) for v in norms[:, k]]
                constant = constant + self._bound_least_cost(cost, size, slope, groups, touched[k].entries(), offered)
            else:
                weights = [a + b for a, b in zip(cost, size, strict=True)]
                constant = constant + known(self.range or self.problem.control).least(weights, weights, slope)
        return constant

    def _bound_least_cost(
        self,
        weights: list[arb],
        sizes: list[arb],
        slope: list[arb],
        groups: Sequence[Sequence[int]],
        at: Sequence[arb],
        offered: Sequence[arb] | None,
    ) -> arb:
        """Return a lower bound of the least cost with norms of groups: ``weight |s| >= d's`` for any ``|d| <= weight``.

        The vector ``d`` balances the slope, is that of the tangent, or is ``offered``: for a box the best for each
        group, for another set one for all. In a corner of oblique facets the multipliers of these balance a part of the
        slope, and a tangent at a slightly wrong control tilts the corner."""
        balancing = _shrink([ball(-float(s)) for s in slope], sizes)
        optional = [] if offered is None else [(_shorten, _shrink(offered, sizes))]
        candidates = []
        for adjust, target in ((_shorten, balancing), (_scale_to_length, at), *optional):
            tilted_slope, remaining = list(slope), [a + b for a, b in zip(weights, sizes, strict=True)]
            for block in groups:
                d = adjust([target[c] for c in block], weights[block[0]])
                for c, component in zip(block, d, strict=True):
                    tilted_slope[c], remaining[c] = slope[c] + component, sizes[c]
            candidates.append((remaining, tilted_slope))
        shape = known(self.problem.control)
        blocks = [*groups, *([c] for c in range(len(slope)) if not any(c in block for block in groups))]
        parts = [shape.least_by(remaining, remaining, tilted, blocks) for remaining, tilted in candidates]
        return sum(map(largest, zip(*parts, strict=True)), ball(0.0))

    def summed(
        self,
        rows: Sequence[tuple[float, ConstraintRow]],
        pieces: Sequence[Sequence[float]] | None,
        tangent: Tangent | None = None,
    ) -> tuple[arb, list[list[arb]]]:
        """Return the sum of ``rows`` times their multipliers ``y``, plus a ``tangent``: its constant, and its slopes on
        every piece. Where the dictionary has fewer functions than pieces, the slopes are those of ``pieces`` with the
        opposite sign."""
        constant = sum((ball(y) * row.constant for y, row in rows), ball(0.0))
        m, K = self.problem.system.controls, self.control.pieces
        slopes = [
            [
                sum((ball(y) * row.slope[k][c] for y, row in rows if not row.slope[k][c].is_zero()), ball(0.0))
                for c in range(m)
            ]
            for k in range(K)
        ]
        if tangent is not None:
            constant = constant + tangent.constant
            slopes = [
                [a + b for a, b in zip(slope, tangent_slope, strict=True)]
                for slope, tangent_slope in zip(slopes, tangent.slope, strict=True)
            ]
        if pieces is not None and self.control.functions < K:
            slopes, error_bound = self._substitute_slopes(slopes, pieces)
            constant = constant - error_bound
        return constant, slopes

    def charged(self, rows: Sequence[tuple[float, ConstraintRow]], costs: list[list[arb]]) -> list[list[arb]]:
        """Return the cost of absolute values on every piece, ``m`` balls each: ``costs`` plus ``sizes`` of ``rows``
        times their multipliers."""
        totals = costs
        for y, row in rows:
            if row.sizes is not None:
                pairs = zip(totals, row.sizes.tolist(), strict=True)
                totals = [
                    [c + ball(y) * ball(v) for c, v in zip(total, size_row, strict=True)] for total, size_row in pairs
                ]
        return totals

    def bound_changes(self, rows: Sequence[tuple[float, ConstraintRow]], offered: Array) -> ConstraintRow:
        """Return a row that is never more than what changes that come late add to ``rows`` with their multipliers: the
        linear function ``v (u_{k+1} - u_k) / 2`` of every change, with ``v`` as ``offered (m, K - 1)`` as far as its
        size is at most the sum of `ConstraintRow.late`."""
        m, K = self.problem.system.controls, self.control.pieces
        slope = [[ball(0.0)] * m for _ in range(K)]
        for k in range(K - 1):
            for c in range(m):
                pairs = [(y, row.late[k, c]) for y, row in rows if row.late is not None]
                most = max(float(sum((ball(y) * ball(size) for y, size in pairs), ball(0.0)).lower()), 0.0)
                half = ball(min(max(float(offered[c, k]), -most), most)) / 2
                slope[k][c], slope[k + 1][c] = slope[k][c] - half, slope[k + 1][c] + half
        return ConstraintRow(ball(0.0), slope)

    def _substitute_slopes(
        self, slopes: list[list[arb]], pieces: Sequence[Sequence[float]]
    ) -> tuple[list[list[arb]], arb]:
        """Return the slopes of the certificate in place of the derived ones, and an upper bound of the difference that
        this makes: of the effects on every function of the dictionary, times the largest coefficients that a control
        may have."""
        m, K, N = self.problem.system.controls, self.control.pieces, self.control.functions
        certified = [[-ball(pieces[c][k]) for c in range(m)] for k in range(K)]
        error_bound = ball(0.0)
        for c in range(m):
            coefficient_bounds = self._bound_coefficients(c)
            for n in range(N):
                difference = sum(
                    ((certified[k][c] - slopes[k][c]) * ball(v) for k, v in enumerate(self.control.values[n]) if v),
                    ball(0.0),
                )
                error_bound = error_bound + abs(difference) * coefficient_bounds[n]
        return certified, error_bound

    def _bound_coefficients(self, channel: int) -> list[arb]:
        low, high = find_range(known(self.problem.control), channel)
        reach = high.max(-low)
        return [sum((abs(x) for x in row), ball(0.0)) * reach for row in self._pseudoinverse]

    @cached_property
    def _pseudoinverse(self) -> list[list[arb]]:
        """The matrix ``(V V')^-1 V``, which gives the coefficients of a control in the span of the dictionary."""
        V = exactly(self.control.values)
        table: list[list[arb]] = ((V * V.transpose()).inv() * V).tolist()
        return table


def steps(problem: OptimalControlProblem, control: Dictionary) -> range:
    """Return the indices of the breakpoints at which a control steps: where its pieces begin, and for a plan that
    repeats where the last piece ends. Index 0 counts only where an initial control is given."""
    return range(0 if problem.initial_control is not None else 1, control.pieces + bool(problem.repeat))


def _shrink(vector: Sequence[arb], sizes: Sequence[arb]) -> list[arb]:
    """Return exact numbers, each moved towards 0 by a size, but not across 0."""
    pairs = [(float(v), float(size)) for v, size in zip(vector, sizes, strict=True)]
    return [ball(np.sign(v) * max(abs(v) - size, 0.0)) for v, size in pairs]


def _shorten(vector: Sequence[arb], length: arb) -> Sequence[arb]:
    """Return a vector of exact numbers, shortened to a length where it is longer."""
    return vector if _sum_squares(vector) <= length * length else _scale_to_length(vector, length)


def _scale_to_length(vector: Sequence[arb], length: arb) -> list[arb]:
    """Return the vector of a length in the direction of the middle of another one; 0 where that is 0."""
    vector = [ball(float(v)) for v in vector]
    size = _sum_squares(vector)
    return [length * v / size.sqrt() for v in vector] if size > 0 else [ball(0.0) for _ in vector]


def _sum_squares(vector: Sequence[arb]) -> arb:
    return sum((v * v for v in vector), ball(0.0))
