"""The integrals of a quadratic cost along the nominal trajectory, and their slopes, in balls. They are computed from
the polynomials of the flow, and share no code with the solvers."""

from __future__ import annotations

from bisect import bisect_right
from collections.abc import Sequence
from dataclasses import dataclass
from fractions import Fraction
from functools import cached_property
from itertools import pairwise
from typing import final

import numpy as np
from flint import arb, arb_mat

from sparserob_core.checker.arithmetic.balls import ball, balls, rational
from sparserob_core.checker.arithmetic.remembered import remembered
from sparserob_core.checker.arithmetic.series import around, exactly, identity, stacked, zeros
from sparserob_core.checker.flow.flow import FlowPart, VerifiedFlow
from sparserob_core.checker.flow.segment import VerifiedSegment
from sparserob_core.control.problem.cost import nominal_point
from sparserob_core.control.problem.dictionary import Dictionary
from sparserob_core.control.problem.problem import OptimalControlProblem

KEPT = 8  # tables of segments that are remembered, each as large as a hundred matrices


@final
@dataclass(frozen=True, eq=False)
class QuadraticTerms:
    """The quadratic terms of the cost at a control: their ``value``, and their derivatives ``slope``, ``m`` balls per
    piece.

    ``blurred`` is the largest radius of these, relative to the largest absolute value of them. ``terms`` is the sum of
    the absolute values of all products that are added up to the value.
    """

    value: arb
    slope: list[list[arb]]
    blurred: float
    terms: float


def evaluate_quadratic_terms(nominal: NominalMotion, control: Dictionary, pieces: Sequence[arb_mat]) -> QuadraticTerms:
    """Return the quadratic terms of the cost at a control ``(m, 1)`` on every piece, and their derivatives: ``z = (x,
    1, u)`` is propagated along the nominal trajectory, and the costates backwards. A control acts after the delay, and
    costs when it is commanded."""
    problem, x, steps = nominal.problem, nominal.begin, []
    d, m = problem.system.states, problem.system.controls
    for start, stop, k in _list_acting_intervals(problem, control):
        flow, weight = nominal.step(start, stop), nominal.weight(start, stop)
        z = arb_mat(x.tolist() + (nominal.before if k < 0 else pieces[k]).tolist())
        steps.append((k, flow, weight, z))
        x = arb_mat((flow * z).tolist()[: d + 1])
    costate = nominal.final * x
    value, terms = (x.transpose() * costate)[0, 0], _sum_absolute_products(x, nominal.final)
    slope: list[list[arb]] = [[arb(0)] * m for _ in pieces]
    for k, flow, weight, z in reversed(steps):
        weighted = weight * z
        value, terms = value + (z.transpose() * weighted)[0, 0], terms + _sum_absolute_products(z, weight)
        adjoint = (weighted + flow.transpose() * arb_mat([*costate.tolist(), *([arb(0)] for _ in range(m))])).tolist()
        costate = arb_mat(adjoint[: d + 1])
        if k >= 0:
            slope[k] = [g + 2 * entry[0] for g, entry in zip(slope[k], adjoint[d + 1 :], strict=True)]
    R = problem.cost.terms[1]
    if R is not None:
        matrix, ends = exactly(R.Q), [Fraction(float(t)) for t in control.breakpoints]
        for k, (begin, end) in enumerate(pairwise(ends)):
            weighted_control = matrix * pieces[k] * rational(end - begin)
            value = value + (pieces[k].transpose() * weighted_control)[0, 0]
            terms += _sum_absolute_products(pieces[k], matrix) * float(end - begin)
            slope[k] = [g + 2 * entry for g, entry in zip(slope[k], weighted_control.entries(), strict=True)]
    sizes = [abs(float(value)), *(abs(float(g)) for entry in slope for g in entry)]
    radii = [float(value.rad()), *(float(g.rad()) for entry in slope for g in entry)]
    is_exact = max(radii) == 0.0
    blurred = 0.0 if is_exact else float("inf") if not np.isfinite(sum(radii)) else max(radii) / (max(sizes) or 1.0)
    return QuadraticTerms(value, slope, blurred, terms)


def nominal_states(nominal: NominalMotion, control: Dictionary, pieces: Sequence[arb_mat]) -> list[arb_mat]:
    """Return the nominal ``(x, 1, u)`` where every piece of the control begins to act, and at the end. ``u = 0`` before
    the first piece acts, and at the end."""
    x, zero_control, states = nominal.begin.tolist(), (nominal.before * 0).tolist(), []
    for start, stop, k in _list_acting_intervals(nominal.problem, control):
        u = nominal.before if k < 0 else pieces[k]
        states.append(arb_mat(x + (zero_control if k < 0 else u.tolist())))
        x = (nominal.step(start, stop) * arb_mat(x + u.tolist())).tolist()[: len(x)]
    return [*states, arb_mat(x + zero_control)]


def _sum_absolute_products(z: arb_mat, M: arb_mat) -> float:
    """Return ``|z|' |M| |z|``, the sum of the absolute values of all products in ``z'M z``."""
    size = np.array([abs(float(entry)) for entry in z.entries()])
    weight = np.abs([float(entry) for entry in M.entries()]).reshape(size.size, size.size)
    return float(size @ weight @ size)


def _list_acting_intervals(problem: OptimalControlProblem, control: Dictionary) -> list[tuple[float, float, int]]:
    """Return the intervals of time on which one piece of the control acts in one phase of the system, each with the
    number of the piece; -1 before the first acts."""
    delay, horizon = problem.system.delay, float(control.breakpoints[-1])
    begins = [(float(t) + delay, k) for k, t in enumerate(control.breakpoints[:-1]) if float(t) + delay < horizon]
    begins = begins if delay == 0.0 else [(0.0, -1), *begins]
    times = [t for t, _ in begins]
    points = sorted({*times, *problem.system.switches, horizon})
    return [(start, stop, begins[bisect_right(times, start) - 1][1]) for start, stop in pairwise(points)]


@final
@dataclass(frozen=True, eq=False)
class NominalMotion:
    """The motion of ``z = (x, 1, u)`` with every uncertainty at its nominal point, and the cost of the states.

    ``flow`` is the flow at the nominal parameter. A control is constant on its pieces; before the first piece acts it
    is ``before (m, 1)``.
    """

    problem: OptimalControlProblem
    flow: VerifiedFlow

    @cached_property
    def begin(self) -> arb_mat:
        """The vector ``(x, 1)`` at time 0."""
        x, deviations = balls(np.asarray(self.problem.initial_state)), self.problem.initial_set
        if deviations is not None:
            x = [a + b for a, b in zip(x, balls(nominal_point(deviations)), strict=True)]
        return stacked([[a] for a in [*x, *balls([1.0])]])

    @cached_property
    def before(self) -> arb_mat:
        """The control ``(m, 1)`` that acts before the first piece acts."""
        initial_control = self.problem.initial_control
        u = np.zeros(self.problem.system.controls) if initial_control is None else np.asarray(initial_control)
        return stacked([[x] for x in balls(u)])

    @cached_property
    def running(self) -> arb_mat:
        """The cost of the states per time as a quadratic form of ``z``."""
        corner, d, m = self._build_quadratic_form(0).tolist(), self.problem.system.states, self.problem.system.controls
        return stacked([[*row, *balls(np.zeros(m))] for row in corner] + [balls(np.zeros(d + 1 + m))] * m)

    @cached_property
    def final(self) -> arb_mat:
        """The cost of the final state as a quadratic form of ``(x, 1)``."""
        return self._build_quadratic_form(2)

    def _build_quadratic_form(self, which: int) -> arb_mat:
        """Return a term ``(x - r)'Q (x - r)`` of the cost as a matrix on ``(x, 1)``."""
        term, d = self.problem.cost.terms[which], self.problem.system.states
        if term is None:
            return zeros(d + 1, d + 1)
        Q, r = exactly(term.Q), stacked([[x] for x in balls(term.reference)])
        side, corner = (-(Q * r)).entries(), (r.transpose() * Q * r)[0, 0]
        return stacked([*([*row, b] for row, b in zip(Q.tolist(), side, strict=True)), [*side, corner]])

    @remembered(key=lambda self, start, stop: self.flow.alike(start, stop))
    def step(self, start: float, stop: float) -> arb_mat:
        """Return the square matrix that maps ``z`` at the beginning of an interval to ``z`` at its end."""
        Phi, Gamma, Delta = self.flow.over(start, stop)
        return self._lift(Phi.append_columns(Gamma).append_columns(Delta).matrix, 1)

    @remembered(key=lambda self, start, stop: self.flow.alike(start, stop))
    def weight(self, start: float, stop: float) -> arb_mat:
        """Return the cost of the states on an interval as a quadratic form of the ``z`` at its beginning."""
        size = self.running.nrows()
        total, propagated = zeros(size, size), identity(size)
        for flow_part in self.flow.parts(start, stop) if self.problem.cost.terms[0] is not None else ():
            step, cost = self._integrate(flow_part)
            for _ in range(flow_part.doublings):
                step, cost = step * step, cost + step.transpose() * cost * step
            total, propagated = total + propagated.transpose() * cost * propagated, step * propagated
        return total

    def _integrate(self, part: FlowPart) -> tuple[arb_mat, arb_mat]:
        """Return the square matrix of ``z`` over a share of a segment, and the cost of that time as a quadratic form.
        With ``M`` the cost per time, terms ``X_n x^n`` cost ``sum_ij X_i' M X_j x^(i + j) / (i + j + 1)`` per time."""
        (terms, weighted_terms, error), share, M = self._tabulate(part.segment), part.share, self.running
        size, count = M.nrows(), terms.nrows()
        powers = arb_mat([[x**n for n in range(count)] for x in (share, arb(0).union(share))]) * terms
        step, flow_range = (arb_mat(size, size, row) for row in powers.tolist())
        cost_error = error.transpose() * M * (flow_range + error) + flow_range.transpose() * M * error
        integrals = [share**k * part.length / (k + 1) for k in range(2 * count - 1)]
        integrated = arb_mat([integrals[i : i + count] for i in range(count)]) * weighted_terms
        term_column, integrated = (arb_mat(count * size, size, table.entries()) for table in (terms, integrated))
        return step + error, term_column.transpose() * integrated + cost_error * part.length

    @remembered(lambda: KEPT)
    def _tabulate(self, segment: VerifiedSegment) -> tuple[arb_mat, arb_mat, arb_mat]:
        """Return the terms of a segment's flow on ``z``, their products with the cost per time, one row for each term,
        and the error of the terms."""
        terms = [self._lift(X.matrix, int(not n)) for n, X in enumerate(segment.terms)]
        table, weighted_terms = (
            [X.entries() for X in matrices] for matrices in (terms, [self.running * X for X in terms])
        )
        return arb_mat(table), arb_mat(weighted_terms), self._lift(around(segment.off), 0)

    def _lift(self, term: arb_mat, one: int) -> arb_mat:
        """Return a matrix ``(d, d + w)`` on states, controls, a drift and disturbances as a square matrix on ``z``, in
        which the rows of the 1 and of the control are those of the identity times ``one``."""
        system, bound = self.problem.system, self.problem.disturbance
        d, m, mw = system.states, system.controls, system.disturbances
        w = np.zeros(mw) if bound is None else nominal_point(bound)
        inputs = balls([*np.ones(term.ncols() - d - m - mw), *w])  # the input of a drift is 1
        rows = [[*row[:d], sum((e * v for e, v in zip(row[d + m :], inputs, strict=True)), ball(0)), *row[d : d + m]]
                for row in term.tolist()]  # fmt: skip
        return stacked(rows + (identity(d + 1 + m) * one).tolist()[d:])
