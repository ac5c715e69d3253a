"""Imposed rows that are linear in the decision.

Idle rows are dropped. The relaxed program is solved with a regulariser whose weight is as small as necessary.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import final

import numpy as np

from sparserob_core.sip.convex_set import Array
from sparserob_core.sip.evidence import Dual
from sparserob_core.sip.finite import FiniteSolution
from sparserob_core.sip.inner.vertex import SIFTED_ENTRIES, vertex
from sparserob_core.sip.method import Tools
from sparserob_core.sip.program import SemiInfiniteProgram
from sparserob_core.sip.proof.verdict import worst_of
from sparserob_core.sip.relaxed.relaxed import Rows, rows_at, rows_of
from sparserob_core.sip.result import Result
from sparserob_core.sip.separation.separation import separate
from sparserob_core.sip.working.counting import count, meet_equalities, tidy_decision
from sparserob_core.sip.working.ledger import (
    SEARCH_TOLERANCE,
    CheckedAnswer,
    Close,
    Found,
    Ledger,
    Prover,
    Violated,
    select_violated,
)
from sparserob_core.sip.working.working import LargestViolation, Working, fits

# Number of rounds without a multiplier after which a row is dropped. With 1, rows are dropped and imposed in turn; with
# ten times as many, solving takes longer the more rounds there were.
ROUNDS_WITHOUT_MULTIPLIER = 3
# Number of rounds after which rows are only added, so that nothing can cycle. With a tenth, curved constraints keep
# more rows than they need; ten times as many are more rounds than any run has.
DROPPING_ROUNDS = 40
# Least ratio of two weights when several steps of the continuation are taken at once. With ten times as much, every
# step is taken alone, with three times as many programs; with half, badly scaled programs end verified, not certified.
MIN_WEIGHT_RATIO = 1 / 8
ROUND_ACCURACY = 1e-4  # residual and relative gap of a relaxed solution that is accurate enough for a round
SPARSIFYING = 60  # number of rounds after which no vertex is sought


@final
@dataclass(eq=False)
class PlainRows(Working):
    """Working set of rows that are linear in the decision.

    Parameters
    ----------
    rows : Rows
        The imposed rows.
    epsilon : float
        Weight of the regulariser.
    exact : bool
        Whether the weight decreases until it does not change the unregularised problem. Otherwise the last weight of
        the continuation is used.
    close : Close, optional
        Exchange that closes the gap of another program.
    idle : ndarray of int, shape (r,)
        Number of rounds for which each row has had no multiplier.
    guess : FiniteSolution, optional
        Solution with these rows, from which the next one starts.
    sheds : bool
        Whether idle rows are dropped.
    spent : float
        Margin with which the last answer was found, before the answer lowered it.
    """

    rows: Rows = field(default_factory=lambda: Rows.none(0))
    epsilon: float = 0.0
    exact: bool = True
    close: Close | None = None
    idle: np.ndarray = field(default_factory=lambda: np.zeros(0, dtype=int))
    guess: FiniteSolution | None = None
    sheds: bool = True
    spent: float = 0.0

    @staticmethod
    def start(program: SemiInfiniteProgram, tools: Tools, exact: bool, close: Close) -> PlainRows:
        """Return a working set without rows, with the first weight of the continuation.

        Parameters
        ----------
        program : SemiInfiniteProgram
            The program.
        tools : Tools
            Components of the run.
        exact : bool
            Whether the unregularised problem is solved.
        close : Close
            Exchange that closes the gap of another program.

        Returns
        -------
        PlainRows
            The working set.
        """
        epsilon = 0.0 if tools.regulariser is None else tools.continuation.start
        return PlainRows(program, rows=Rows.none(program.n), epsilon=epsilon, exact=exact, close=close)

    @property
    def size(self) -> int:
        """Number of imposed rows."""
        return int(self.rows.h.size)

    def relax(self, ledger: Ledger, prover: Prover, last: bool) -> CheckedAnswer | Result:
        """Return the optimum under the imposed rows, or the final result where there is none.

        Without enough rows the cost may fall without bound. Then rows that prevent this are imposed, where there are
        any.
        """
        base = self.program.finite
        if not self.size and base.S is None and base.P is None and not base.bounded:
            self._impose_first_rows()
        answer = self._solve_regularised(ledger)
        while answer.solution.status == "failed" and not usable(answer.solution) and not last:
            from sparserob_core.sip.working.unbounded import bounding_rows, falls_for_ever

            self.sheds = self.sheds and not self.size  # a dropped row may be the one that bounds the program
            if self._impose_first_rows():
                answer = self._solve_regularised(ledger)
                continue
            assert self.close is not None
            ray, fresh = bounding_rows(self.program, ledger.tools, self.close, self.rows.cuts)
            if ray is not None:
                return falls_for_ever(ledger, self.close, prover, ray)
            if not self.impose(fresh):
                break
            answer = self._solve_regularised(ledger)
        return answer if usable(answer.solution) else ledger.without(answer)

    def _impose_first_rows(self) -> int:
        """Impose the rows that usually bound a program without bounds; return the number of new rows."""
        from sparserob_core.sip.working.unbounded import first_rows

        return self.impose(first_rows(self.program))

    def _solve_regularised(self, ledger: Ledger) -> CheckedAnswer:
        """Return the optimum of the relaxed program with decreasing weights of the regulariser.

        The weight decreases while the cost still changes and the gap is open, by several steps of the continuation at
        once. For the regularised problem, it decreases step by step to the last weight.
        """
        solution, regu = self._solve(ledger, self.epsilon), ledger.tools.continuation
        steps = max(1, int(np.log(MIN_WEIGHT_RATIO) / np.log(regu.factor))) if self.exact else 1
        while usable(solution) and self.epsilon > regu.stop and (not self.exact or ledger.open(solution.x)):
            ledger.tools.deadline.check()
            lighter = self.epsilon
            for _ in range(steps):
                lighter = regu.lighter(lighter) if lighter > regu.stop else lighter
            candidate = self._solve(ledger, lighter)
            if not usable(candidate):
                break
            cost_before, cost_after = ledger.program.cost(solution.x), ledger.program.cost(candidate.x)
            self.epsilon, solution = lighter, candidate
            has_converged = abs(cost_after - cost_before) <= regu.tolerance * max(1.0, abs(ledger.lower))
            if has_converged and self.exact and ledger.open(solution.x):
                self._solve_unregularised(ledger)
        return CheckedAnswer(solution, self.rows, self.epsilon, solution.value)

    def _solve(self, ledger: Ledger, epsilon: float) -> FiniteSolution:
        """Return the solution of the relaxed program with a given weight; its multipliers improve the lower bound."""
        solution = ledger.relaxed.solve(self.rows, epsilon, self.margin, self.guess)
        while solution.status == "infeasible" and self.thin():
            solution = ledger.relaxed.solve(self.rows, epsilon, self.margin, None)
        if usable(solution):
            self.guess = solution
            ledger.improve(ledger.relaxed.lower_bound(self.rows, solution))
            self.spent = self.margin
            self.pay(ledger, CheckedAnswer(solution, self.rows, epsilon, solution.value))
        return solution

    def _solve_unregularised(self, ledger: Ledger) -> FiniteSolution:
        """Return the solution of the unregularised relaxed program; its multipliers improve the lower bound."""
        guess = (
            self.guess if self.program.n >= SIFTED_ENTRIES else None
        )  # its multipliers are the start of the simplex method
        plain = ledger.relaxed.solve(self.rows, 0.0, self.margin, guess)
        if usable(plain):
            ledger.improve(ledger.relaxed.lower_bound(self.rows, plain))
        return plain

    def sharpen(self, ledger: Ledger, answer: CheckedAnswer) -> bool:
        """Improve the lower bound by the unregularised program, and continue without the regulariser.

        This step is the last one, for a regulariser that is not exact at its smallest weight. Where the answer costs so
        little that its margin had to be lowered, it is solved once more with the new one. False is returned where
        nothing is left to try.
        """
        if self.margin < self.spent:
            return True
        if self.epsilon == 0.0 or not self.exact:
            return False
        plain = self._solve_unregularised(ledger)
        crude = answer.solution.status != "optimal"
        if not (crude or ledger.open(answer.solution.x)) or not usable(plain):
            return False
        self.epsilon, self.guess = 0.0, plain if self.program.n >= SIFTED_ENTRIES else None
        return True

    def exchange(self, answer: CheckedAnswer, violated: Violated, number: int) -> int:
        """Impose violated rows, and drop rows that were idle for some rounds; return the number of new rows."""
        fresh = self._find_new_rows(violated)
        if not fresh.h.size:
            return 0
        multipliers, zeros = answer.multipliers, np.zeros(fresh.h.size)
        y = np.concatenate([multipliers, np.zeros(self.rows.h.size - multipliers.size)])  # zeros for rows imposed since
        idle = np.where(y > 0.0, 0, self.idle + 1)
        keep = (idle < ROUNDS_WITHOUT_MULTIPLIER) | (number > DROPPING_ROUNDS) | (not self.sheds)
        self.rows = self.rows.take(keep).joined(fresh)
        self.idle = np.concatenate([idle[keep], zeros.astype(int)])
        fixed = answer.solution.y[: answer.solution.y.size - multipliers.size]
        self.guess = replace(answer.solution, y=np.concatenate([fixed, y[keep], zeros]))
        return zeros.size

    def impose(self, violated: Violated) -> int:
        """Impose rows that no answer contains yet; return the number of new rows."""
        fresh = self._find_new_rows(violated)
        self.rows = self.rows.joined(fresh)
        self.guess = None if self.guess is None else _pad_multipliers(self.guess, fresh.h.size)
        self.idle = np.concatenate([self.idle, np.zeros(fresh.h.size, dtype=int)])
        return int(fresh.h.size)

    def knows(self, violation: LargestViolation) -> bool:
        """Return whether a constraint is imposed."""
        return not self._find_new_rows([(violation.at, violation.row, violation.family)]).h.size

    def _find_new_rows(self, violated: Violated) -> Rows:
        """Return the rows of violated constraints that are not imposed."""
        keys = {(cut.family, cut.row, cut.index.tobytes()) for cut in self.rows.cuts}
        fresh: list[tuple[Array, np.ndarray, str]] = []
        for indices, rows, family in violated:
            is_new = np.array(
                [(family, int(r), i.tobytes()) not in keys for i, r in zip(indices, rows, strict=True)],
                dtype=bool,
            )
            fresh.append((indices[is_new], rows[is_new], family))
        return rows_of(self.program, fresh)

    def priced(self, answer: CheckedAnswer) -> float:
        """Return the increase of an answer's cost when all rows are moved by 1 along their normals, to first order."""
        return float(answer.multipliers @ answer.rows.norms)

    @property
    def longest(self) -> float:
        """Largest norm of an imposed row."""
        return float(self.rows.norms.max(initial=0.0))

    @property
    def unit(self) -> float:
        """Unit of margins: the largest bound of the decision, and at most 1."""
        radii = np.maximum(np.abs(self.program.finite.lower), np.abs(self.program.finite.upper))
        return min(1.0, float(np.where(np.isfinite(radii), radii, 1.0).max()))

    def distance(self, violation: LargestViolation) -> float:
        """Return the distance by which a violated row has to be moved along its normal."""
        G = rows_at(self.program, violation.family, violation.at, violation.row).G
        return violation.size / max(float(np.linalg.norm(G)), np.finfo(float).tiny)

    def tightened(self, ledger: Ledger, answer: CheckedAnswer, margin: float) -> CheckedAnswer | None:
        """Return the optimum of the imposed rows tightened by ``margin``; ``None`` where there is none."""
        guess = _pad_multipliers(answer.solution, self.rows.h.size - answer.rows.h.size)
        solution = ledger.relaxed.solve(self.rows, self.epsilon, margin, guess)
        if not usable(solution):
            return None
        ledger.improve(ledger.relaxed.lower_bound(self.rows, solution))
        return CheckedAnswer(solution, self.rows, self.epsilon, solution.value)

    def candidate(self, answer: CheckedAnswer) -> CheckedAnswer | None:
        """Return ``None``: no decision other than the answer is known."""
        return None

    def proven(self, ledger: Ledger, answer: CheckedAnswer, x: Array) -> Dual:
        """Return the lower bound by the multipliers of an answer, with tangents of the cost at ``x (n,)``."""
        return ledger.relaxed.lower_bound(answer.rows, replace(answer.solution, x=x))

    def choose(
        self, ledger: Ledger, answer: CheckedAnswer, found: Found, number: int, prover: Prover
    ) -> tuple[CheckedAnswer, Found, Violated]:
        """Return an answer in which fewer entries count, where there is one.

        The new answer is the old one without the small entries that solvers leave, or a vertex of the relaxed program
        where no regulariser selects another optimum.
        """
        answer, found, violated = self._sparsify(ledger, answer, found, number)
        if not self.exact:
            self._solve_unregularised(ledger)
        return answer, found, violated

    def _sparsify(
        self, ledger: Ledger, answer: CheckedAnswer, found: Found, number: int
    ) -> tuple[CheckedAnswer, Found, Violated]:
        """Return an answer with a smaller count, its violations, and the constraints that a rejected candidate
        violates."""
        program, x = self.program, answer.solution.x
        if program.activity is None or (number > SPARSIFYING and answer.epsilon == 0.0):
            return answer, found, ()
        active, closed = answer.rows.G[answer.multipliers > 0.0], not ledger.open(x)
        candidates = [
            meet_equalities(program, tidy_decision(program, x), active, active @ x)
        ]  # small entries may keep the gap open
        if closed and answer.epsilon == 0.0 and program.finite.P is None and program.blocks is None:
            rows = answer.rows
            finite = ledger.relaxed.finite(rows.G, rows.h - self.margin * rows.norms, 0.0)
            corner = vertex(finite, answer.solution.y, answer.solution.mu)
            candidates += (
                []
                if corner is None
                else [meet_equalities(program, tidy_decision(program, corner), active, active @ corner)]
            )
        kept, violated, least = (answer, found), list[tuple[Array, np.ndarray, str]](), count(program, x)
        for candidate in candidates:
            if candidate is x or count(program, candidate) >= least or not fits(ledger, candidate):
                continue
            separations = separate(program, candidate, ledger.tools, SEARCH_TOLERANCE, number)
            violations = [
                constraints
                for family, separation in separations
                if (constraints := select_violated(family, separation))[1].size
            ]
            room = 0.5 * min(0.0, worst_of(found).violation)
            if self.allowed and worst_of(separations).violation > room:
                continue  # a proof needs a margin, which the answer has and this candidate lacks
            if not violations:
                value = program.cost(candidate) if answer.epsilon == 0.0 else answer.value
                kept = replace(answer, solution=replace(answer.solution, x=candidate), value=value), separations
                violated, least = [], count(program, candidate)
            elif answer.epsilon == 0.0:
                violated = violations
        return *kept, violated


def _pad_multipliers(solution: FiniteSolution, rows: int) -> FiniteSolution:
    """Return a solution as a starting point for a program with ``rows`` further rows."""
    return replace(solution, y=np.concatenate([solution.y, np.zeros(rows)]))


def usable(solution: FiniteSolution) -> bool:
    """Return whether a relaxed solution is accurate enough for a round.

    An inaccurate optimiser costs rounds, but no claim depends on its accuracy.
    """
    scale = max(1.0, abs(solution.value))
    return solution.status == "optimal" or (
        solution.status == "failed" and solution.residual <= ROUND_ACCURACY and solution.gap <= ROUND_ACCURACY * scale
    )
