"""The cost of a control, in balls: norms of groups, and quadratic terms of the nominal trajectory. It shares no code
with the solvers."""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass, field
from fractions import Fraction
from functools import cached_property
from itertools import pairwise
from typing import final

import numpy as np
from flint import arb, arb_mat, ctx

from sparserob_core.checker.arithmetic.balls import ball, balls, is_semidefinite, rational, rationals
from sparserob_core.checker.arithmetic.series import norm, stacked
from sparserob_core.checker.cost.nominal import NominalMotion, QuadraticTerms, evaluate_quadratic_terms, nominal_states
from sparserob_core.checker.flow.flow import VerifiedFlow
from sparserob_core.checker.outcome import NO_LIMIT, Broken, Clock, Unchecked
from sparserob_core.control.problem.cost import Quadratic
from sparserob_core.control.problem.dictionary import Dictionary
from sparserob_core.control.problem.problem import OptimalControlProblem

ENOUGH = 1e-20  # the largest relative radius of the quadratic terms and their slopes
MAX_BITS = 512  # the largest working precision: the terms of a guess of the flow determine half of these bits
KEPT = 3  # quadratic terms that are remembered: those of the control, of another control, and of the control 0


@final
@dataclass(frozen=True, eq=False)
class Tangent:
    """The tangent ``constant + sum_k slope_k u_k`` of the quadratic terms of the cost: below them, and equal at one
    control. ``slope`` has ``m`` balls per piece of the control."""

    constant: arb
    slope: list[list[arb]]


@final
@dataclass(frozen=True, eq=False)
class Price:
    """The cost of a problem whose control is constant on the pieces of a dictionary."""

    problem: OptimalControlProblem
    control: Dictionary
    flow: VerifiedFlow
    clock: Clock = NO_LIMIT
    _latest_terms: deque[tuple[Sequence[arb_mat], int, QuadraticTerms]] = field(
        default_factory=lambda: deque(maxlen=KEPT)
    )
    _motions_by_precision: dict[int, NominalMotion] = field(default_factory=dict)

    @property
    def is_quadratic(self) -> bool:
        return any(term is not None for term in self._quadratic_terms)

    @cached_property
    def costs(self) -> list[list[arb]]:
        """The cost of the absolute value of every channel on every piece, ``(K, m)``: the integrals of its weights."""
        l1, ends = ball(self.problem.cost.l1), [Fraction(t) for t in self.control.breakpoints.tolist()]
        times = [Fraction(t) for t in self._weight_changes[0]]
        rows = [balls(row) for row in self._weight_changes[1]]
        costs, first = [], 0
        for begin, end in self.clock.each(pairwise(ends)):
            while first + 1 < len(times) and times[first + 1] <= begin:
                first += 1
            integrals, now, row = [ball(0)] * len(rows[0]), begin, first
            while now < end:
                until = min(end, times[row + 1]) if row + 1 < len(times) else end
                integrals = [
                    integral + w * rational(until - now) for integral, w in zip(integrals, rows[row], strict=True)
                ]
                now, row = until, row + 1
            costs.append([l1 * integral for integral in integrals])
        return costs

    @cached_property
    def counts(self) -> np.ndarray:
        """The weight of every channel in the time of action, ``(m,)``: 1 where weights change with time."""
        return (
            self._weight_changes[1][0]
            if np.asarray(self.problem.weights).ndim == 1
            else np.ones(self._weight_changes[1].shape[1])
        )

    @property
    def highest(self) -> np.ndarray:
        """The largest of all weights of every channel, ``(m,)``."""
        return np.asarray(self._weight_changes[1].max(axis=0))

    @cached_property
    def _weight_changes(self) -> tuple[list[float], np.ndarray]:
        """The times from which weights apply, and the weights ``(r, m)``."""
        rows = np.asarray(self.problem.weights, dtype=float)
        return ([0.0], rows[None]) if rows.ndim == 1 else (rows[:, 0].tolist(), rows[:, 1:])

    @cached_property
    def blocks(self) -> list[list[int]]:
        """The groups of channels; a channel that is in no group is a group of its own."""
        groups: list[list[int]] = []
        if isinstance(self.problem.cost.group, tuple):
            groups = [[int(channel) - 1 for channel in group] for group in self.problem.cost.group]
        grouped = {channel for group in groups for channel in group}
        return groups + [[c] for c in range(self.problem.system.controls) if c not in grouped]

    def of(self, pieces: Sequence[arb_mat]) -> arb:
        """Return the cost ``J`` of a control ``(m, 1)`` on every piece."""
        total = ball(0)
        for costs, piece in self.clock.each(zip(self.costs, pieces, strict=True)):
            total = total + self._sum_norms(costs, piece.entries())
        return total + self.squares(pieces)

    def squares(self, pieces: Sequence[arb_mat]) -> arb:
        """Return the quadratic terms of a control ``(m, 1)`` on every piece."""
        return self._evaluate_quadratic(pieces).value if self.is_quadratic else ball(0)

    def _sum_norms(self, costs: Sequence[arb], u: Sequence[arb]) -> arb:
        total = ball(0)
        for block in self.blocks:
            size = abs(u[block[0]]) if len(block) == 1 else norm(stacked([[u[c]] for c in block]))
            total = total + costs[block[0]] * size
        return total

    def tangent(self, pieces: Sequence[arb_mat]) -> Tangent:
        """Return the tangent of the quadratic terms at a control ``(m, 1)`` on every piece."""
        quadratic = self._evaluate_quadratic(pieces)
        constant = quadratic.value
        for piece, slope in self.clock.each(zip(pieces, quadratic.slope, strict=True)):
            constant = constant - sum((g * u for g, u in zip(slope, piece.entries(), strict=True)), constant * 0)
        return Tangent(constant, quadratic.slope)

    def added(self, pieces: Sequence[arb_mat], lengths: arb | None = None) -> float:
        """Return the sum of the absolute values of what the program adds up to the cost of a control: the norms, or
        ``lengths`` where those are charged, and the linear, the quadratic and the constant part of the quadratic
        terms."""
        pairs = zip(self.costs, pieces, strict=True)
        norms = lengths
        if norms is None:
            norms = sum((self._sum_norms(costs, piece.entries()) for costs, piece in pairs), rational(Fraction(0)))
        if not self.is_quadratic:
            return float(norms)
        quadratic = self._evaluate_quadratic(pieces)
        constant, linear = self._evaluate_quadratic(self._zero_control).value, -quadratic.value
        for piece, slope in zip(pieces, quadratic.slope, strict=True):
            linear = linear + sum((g * u for g, u in zip(slope, piece.entries(), strict=True)), linear * 0)
        curvature = linear + constant  # slope'u - value + constant = u'P u / 2
        linear = quadratic.value - constant - curvature
        return float((norms + abs(linear) + abs(curvature) + abs(constant)).mid())

    def terms(self, pieces: Sequence[arb_mat]) -> float:
        """Return the sum of the absolute values of all products in the quadratic terms of a control, which rounding is
        relative to."""
        return self._evaluate_quadratic(pieces).terms if self.is_quadratic else 0.0

    @property
    def _quadratic_terms(self) -> tuple[Quadratic | None, ...]:
        return self.problem.cost.terms

    @property
    def _nominal_motion(self) -> NominalMotion:
        """The nominal motion, at the present working precision or a higher one."""
        if not any(bits >= ctx.prec for bits in self._motions_by_precision):
            flow = self.flow.sharper(2.0**-ctx.prec) if self._motions_by_precision else self.flow
            self._motions_by_precision[int(ctx.prec)] = NominalMotion(self.problem, flow)
        return next(nominal for bits, nominal in self._motions_by_precision.items() if bits >= ctx.prec)

    def nominal_states(self, pieces: Sequence[arb_mat]) -> list[arb_mat]:
        """Return the nominal ``(x, 1, u)`` of a control where every piece begins to act, and at the end."""
        return nominal_states(self._nominal_motion, self.control, pieces)

    def convex(self) -> None:
        """Raise `Broken` unless every matrix of the cost is positive semidefinite."""
        for name, term in zip(("state", "control", "final"), self._quadratic_terms, strict=True):
            if term is not None and not is_semidefinite(rationals(term.Q.tolist())):
                raise Broken(f"the matrix of the cost's {name} term is not positive semidefinite")

    @cached_property
    def _zero_control(self) -> list[arb_mat]:
        """The control that stays 0."""
        return [stacked([[ball(0)]] * self.problem.system.controls)] * self.control.pieces

    def _evaluate_quadratic(self, pieces: Sequence[arb_mat]) -> QuadraticTerms:
        """Return the quadratic terms and their slopes, at the working precision that they need; the latest are
        remembered."""
        for control, bits, quadratic in self._latest_terms:
            if control is pieces and bits >= ctx.prec:
                return quadratic
        self._latest_terms.append((pieces, int(ctx.prec), self._resolve_quadratic(pieces, int(ctx.prec))))
        return self._latest_terms[-1][2]

    def _resolve_quadratic(self, pieces: Sequence[arb_mat], bits: int) -> QuadraticTerms:
        while True:
            with ctx.workprec(bits):
                quadratic = evaluate_quadratic_terms(self._nominal_motion, self.control, pieces)
            if quadratic.blurred <= ENOUGH:
                return quadratic
            bits *= 2
            if bits > MAX_BITS:
                raise Unchecked("the quadratic cost cannot be resolved: the state grows too far over the horizon")
