"""The integrals of a quadratic cost along the nominal trajectory, and their slopes, in balls: by exponentials of the
flow (Van Loan 1978), none of it shared with what solves."""

from __future__ import annotations

from bisect import bisect_right
from collections.abc import Sequence
from dataclasses import dataclass, field
from fractions import Fraction
from itertools import pairwise
from typing import TYPE_CHECKING, final

import numpy as np

from sparserob_core.checker.arithmetic.balls import balls
from sparserob_core.checker.arithmetic.series import around, norm, stacked
from sparserob_core.checker.flow.flow import Flow
from sparserob_core.checker.flow.still import modes_at
from sparserob_core.checker.outcome import Unchecked
from sparserob_core.control.problem.cost import Quadratic, nominal_point
from sparserob_core.control.problem.dictionary import Dictionary
from sparserob_core.control.problem.problem import OptimalControlProblem

if TYPE_CHECKING:
    from flint import arb, arb_mat

EVERY = 1000  # terms of a series, more than there are


@final
@dataclass(frozen=True, eq=False)
class Walk:
    """The quadratic terms at a control, their derivatives on every piece, the largest radius of them, relative to the
    sizes that are added up, and ``terms``: the absolute values of all products that are added up to the value."""

    value: arb
    slope: list[list[arb]]
    blurred: float
    terms: float


def walked(
    problem: OptimalControlProblem, control: Dictionary, pieces: Sequence[arb_mat], changing: Changing | None
) -> Walk:
    """``z = (x, 1, u)`` along the nominal trajectory, and back with the costates of what it costs; a control acts on
    the state as late as the system says, and costs when it is given."""
    from flint import arb, arb_mat

    modes, d, m = Nominal.of(problem), problem.system.states, problem.system.controls
    still = stacked([[arb(0)] for _ in range(m)])
    x, walked = modes[0].start, []
    for start, stop, k, leg in _acting(problem, control):
        if changing is None:
            flow, weight = modes[leg].over(stop - start, acting=k >= 0)
        else:
            flow, weight = changing.over(float(start), float(stop), modes[0].M, k >= 0)
        z = arb_mat(x.tolist() + (still if k < 0 else pieces[k]).tolist())
        walked.append((k, flow, weight, z))
        x = arb_mat((flow * z).tolist()[: d + 1])
    costate = modes[0].final * x
    value, terms = (x.transpose() * costate)[0, 0], _terms(x, modes[0].final)
    slope: list[list[arb]] = [[arb(0)] * m for _ in pieces]
    for k, flow, weight, z in reversed(walked):
        own = weight * z
        value, terms = value + (z.transpose() * own)[0, 0], terms + _terms(z, weight)
        both = (own + flow.transpose() * arb_mat([*costate.tolist(), *([arb(0)] for _ in range(m))])).tolist()
        costate = arb_mat(both[: d + 1])
        if k >= 0:
            slope[k] = [g + 2 * entry[0] for g, entry in zip(slope[k], both[d + 1 :], strict=True)]
    R = problem.cost.terms[1]
    if R is not None:
        matrix, ends = stacked([balls(row) for row in R.Q]), [Fraction(float(t)) for t in control.breakpoints]
        for k, (start, stop) in enumerate(pairwise(ends)):
            push = matrix * pieces[k] * ball_of(stop - start)
            value = value + (pieces[k].transpose() * push)[0, 0]
            terms += _terms(pieces[k], matrix) * float(stop - start)
            slope[k] = [g + 2 * entry for g, entry in zip(slope[k], push.entries(), strict=True)]
    sizes = [abs(float(value.mid())), *(abs(float(g.mid())) for entry in slope for g in entry)]
    radii = [float(value.rad()), *(float(g.rad()) for entry in slope for g in entry)]
    exact = max(radii) == 0.0
    blurred = 0.0 if exact else float("inf") if not np.isfinite(sum(radii)) else max(radii) / (max(sizes) or 1.0)
    return Walk(value, slope, blurred, terms)


def nominal_states(
    problem: OptimalControlProblem, control: Dictionary, pieces: Sequence[arb_mat], changing: Changing | None
) -> list[arb_mat]:
    """Return the nominal ``(x, 1, u)`` where every piece of the control begins to act, and with ``u = 0`` at the end.

    Every uncertainty is at its nominal point.
    """
    from flint import arb, arb_mat

    modes, d, m = Nominal.of(problem), problem.system.states, problem.system.controls
    still = stacked([[arb(0)] for _ in range(m)])
    x, seen = modes[0].start, []
    for start, stop, k, leg in _acting(problem, control):
        if changing is None:
            flow = modes[leg].over(stop - start, acting=k >= 0)[0]
        else:
            flow = changing.step(float(start), float(stop), k >= 0)
        seen.append(arb_mat(x.tolist() + (still if k < 0 else pieces[k]).tolist()))
        x = arb_mat((flow * seen[-1]).tolist()[: d + 1])
    return [*seen, arb_mat(x.tolist() + still.tolist())]


def _terms(z: arb_mat, M: arb_mat) -> float:
    """``|z|' |M| |z|``."""
    size = np.array([abs(float(entry.mid())) for entry in z.entries()])
    weight = np.abs([float(entry.mid()) for entry in M.entries()]).reshape(size.size, size.size)
    return float(size @ weight @ size)


def _acting(problem: OptimalControlProblem, control: Dictionary) -> list[tuple[Fraction, Fraction, int, int]]:
    """The intervals of time on which one piece of the control acts on one of the systems that take turns, with their
    numbers; -1 before the first piece acts."""
    delay, horizon = problem.system.delay, float(control.breakpoints[-1])
    begins = [(float(t) + delay, k) for k, t in enumerate(control.breakpoints[:-1]) if float(t) + delay < horizon]
    begins = begins if delay == 0.0 else [(0.0, -1), *begins]
    times, switches = [t for t, _ in begins], problem.system.switches
    points = sorted({*times, *switches, horizon})
    return [
        (Fraction(start), Fraction(stop), begins[bisect_right(times, start) - 1][1], bisect_right(switches, start))
        for start, stop in pairwise(points)
    ]


@final
@dataclass(frozen=True, eq=False)
class Nominal:
    """``z' = F z`` for ``z = (x, 1, u)``, with every uncertainty at its nominal point; ``waiting``: the same while the
    control before time 0 still acts. The cost ``z'M z`` per time, ``start = (x(0), 1)``, and the final cost of
    ``(x, 1)``."""

    F: arb_mat
    waiting: arb_mat
    M: arb_mat
    start: arb_mat
    final: arb_mat
    _known: dict[tuple[Fraction, bool], tuple[arb_mat, arb_mat]] = field(default_factory=dict)

    @staticmethod
    def of(problem: OptimalControlProblem) -> list[Nominal]:
        """Those of the systems that take turns."""
        parameters = problem.system.parameters
        point = () if parameters is None else tuple(map(float, nominal_point(parameters)))
        return [Nominal._of(problem, mode) for mode in modes_at(problem.system, point)]

    @staticmethod
    def _of(problem: OptimalControlProblem, parts: dict[str, arb_mat]) -> Nominal:
        from flint import arb

        d, m, zero = problem.system.states, problem.system.controls, arb(0)
        A, B, E = (parts[name].tolist() for name in ("A", "B", "E"))
        w = [] if problem.disturbance is None else balls(nominal_point(problem.disturbance))
        pushed = [sum((e * v for e, v in zip(row, w, strict=True)), zero) if w else zero for row in E]
        drift = [sum(row[m:], push) for row, push in zip(B, pushed, strict=True)]  # further inputs are 1
        early = [0.0] * m if problem.initial_control is None else np.asarray(problem.initial_control).tolist()
        waiting = [
            sum((b * u for b, u in zip(row[:m], balls(early), strict=True)), c) for row, c in zip(B, drift, strict=True)
        ]
        below = [[zero] * (d + 1 + m) for _ in range(1 + m)]
        M = [[zero] * (d + 1 + m) for _ in range(d + 1 + m)]
        for i, row in enumerate(_deviation(problem.cost.terms[0], d)):
            M[i][: d + 1] = row
        begin = balls(np.asarray(problem.initial_state))
        if problem.initial_set is not None:
            begin = [x + e for x, e in zip(begin, balls(nominal_point(problem.initial_set)), strict=True)]
        start = [[x] for x in (*begin, arb(1))]
        return Nominal(
            stacked([[*A[i], drift[i], *B[i][:m]] for i in range(d)] + below),
            stacked([[*A[i], waiting[i], *[zero] * m] for i in range(d)] + below),
            stacked(M),
            stacked(start),
            stacked(_deviation(problem.cost.terms[2], d)),
        )

    def over(self, length: Fraction, acting: bool) -> tuple[arb_mat, arb_mat]:
        """What a time does to ``z``, and what it costs."""
        if (length, acting) not in self._known:
            self._known[length, acting] = integrated(self.F if acting else self.waiting, self.M, length)
        return self._known[length, acting]


@final
@dataclass(frozen=True, eq=False)
class Changing:
    """`Nominal` of a system that changes with time, of which ``law`` is the flow."""

    problem: OptimalControlProblem
    law: Flow
    _known: dict[tuple[float, float], tuple[arb_mat, arb_mat]] = field(default_factory=dict)

    def step(self, start: float, stop: float, acting: bool) -> arb_mat:
        """What the time from ``start`` to ``stop`` does to ``z``."""
        Phi, Gamma, Delta = self.law.over(start, stop)
        return self._of(Phi.beside(Gamma).beside(Delta).matrix, True, acting)

    def over(self, start: float, stop: float, M: arb_mat, acting: bool) -> tuple[arb_mat, arb_mat]:
        """What the time from ``start`` to ``stop`` does to ``z``, and what it costs, segment by segment of the law;
        ``acting``: a control of the decision acts, not the one before time 0."""
        if (start, stop) not in self._known:
            parts = [self._within(*ends, M, acting) for ends in pairwise(self.law.marks([start, stop]))]
            flow, weight = parts[0]
            for onward, cost in parts[1:]:
                weight = weight + flow.transpose() * cost * flow
                flow = onward * flow
            self._known[start, stop] = flow, weight
        return self._known[start, stop]

    def _within(self, start: float, stop: float, M: arb_mat, acting: bool) -> tuple[arb_mat, arb_mat]:
        """`over` within one segment, by the integrals of the products of all terms of the flow's series; what this
        leaves out is in a ball at every time."""
        from flint import arb

        terms, off = self.law.within(start, stop, start, stop, EVERY)
        every = [self._of(term.matrix, n == 0, acting) for n, term in enumerate(terms)]
        left = self._of(around(off), False, acting)
        flow = every[0]
        for term in every[1:]:
            flow = flow + term
        if M == M * 0:
            return flow + left, M
        seen, share, pushed = every[0], arb(0).union(arb(1)), [M * term for term in every]
        for term in every[1:]:
            seen = seen + term * share
        weight = left.transpose() * M * (seen + left) + seen.transpose() * M * left
        for i, term in enumerate(every):
            along = term.transpose()
            for j, other in enumerate(pushed):
                weight = weight + along * other / (i + j + 1)
        return flow + left, weight * (arb(stop) - arb(start))

    def _of(self, term: arb_mat, first: bool, acting: bool) -> arb_mat:
        """A term on states, controls and disturbances as one on ``z``."""
        from flint import arb

        problem, d, m = self.problem, self.problem.system.states, self.problem.system.controls
        w = balls(np.ones(term.ncols() - d - m))  # a drift, whose input is 1
        mw = problem.system.disturbances
        point = np.zeros(mw) if problem.disturbance is None else nominal_point(problem.disturbance)
        w[len(w) - mw :] = balls(point)
        early = balls(np.zeros(m) if acting or problem.initial_control is None else np.asarray(problem.initial_control))
        given = [*early, *w]  # the columns of a control that does not act yet meet zeros
        rows = [
            [*row[:d], sum((e * v for e, v in zip(row[d:], given, strict=True)), arb(0)), *row[d : d + m]]
            for row in term.tolist()
        ]
        below = [[arb(int(first and i == j)) for j in range(d + 1 + m)] for i in range(d, d + 1 + m)]
        return stacked([*rows, *below])


def _deviation(term: Quadratic | None, size: int) -> list[list[arb]]:
    """``(x - r)'Q (x - r)`` as a matrix on ``(x, 1)``."""
    from flint import arb

    if term is None:
        return [[arb(0)] * (size + 1) for _ in range(size + 1)]
    Q, r = stacked([balls(row) for row in term.Q]), stacked([[x] for x in balls(term.reference)])
    beside = -(Q * r)
    corner = (r.transpose() * Q * r)[0, 0]
    rows = [[*row, side] for row, (side,) in zip(Q.tolist(), beside.tolist(), strict=True)]
    return [*rows, [*(side for (side,) in beside.tolist()), corner]]


def integrated(F: arb_mat, M: arb_mat, length: Fraction) -> tuple[arb_mat, arb_mat]:
    """``e^{F h}`` and ``int_0^h e^{F't} M e^{Ft} dt``: one exponential for a short time, then doubled."""
    from flint import arb, arb_mat

    n, zero = F.nrows(), arb(0)
    doublings, size = 0, norm(F) * ball_of(length)
    while not size <= 1:
        doublings, size = doublings + 1, size / 2
        if doublings > 200:
            raise Unchecked("the system is too fast for its horizon")
    turned = (-F.transpose()).tolist()
    rows = [[*a, *b] for a, b in zip(turned, M.tolist(), strict=True)]
    rows += [[zero] * n + row for row in F.tolist()]
    whole = (stacked(rows) * ball_of(length / 2**doublings)).exp().tolist()
    flow = arb_mat([row[n:] for row in whole[n:]])
    weight = flow.transpose() * arb_mat([row[n:] for row in whole[:n]])
    for _ in range(doublings):
        weight = weight + flow.transpose() * weight * flow
        flow = flow * flow
    return flow, weight


def ball_of(value: Fraction) -> arb:
    """The ball of a rational number."""
    from flint import arb, fmpq

    return arb(fmpq(value.numerator, value.denominator))
