"""Imposed rows that must hold for every deviation: indices are exchanged, deviations are all in the relaxed program.

The relaxed program is the robust counterpart at the imposed indices (`inner.simplex`). The lower bound is that of
cuts: every row with a multiplier, at the deviation that its multipliers determine (weak duality over the bounds of the
program). Nothing is dropped: a row has variables of its own, and the last basis, from which the next solution starts,
contains them.
"""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, field, replace
from typing import final

import numpy as np

from sparserob_core.sip.convex_set import Array
from sparserob_core.sip.events import ignore
from sparserob_core.sip.evidence import Cut, Dual, InfeasibleSubsystem
from sparserob_core.sip.finite import FiniteSolution
from sparserob_core.sip.inner.simplex.counterpart import Counterpart, RobustAnswer
from sparserob_core.sip.inner.simplex.robust_bound import robust_bound
from sparserob_core.sip.method import Tools
from sparserob_core.sip.program import TOLERANCE, ConstraintFamily, SemiInfiniteProgram, WorstConstraint
from sparserob_core.sip.proof.verdict import MAX_NAMED_REASONS, add_facts
from sparserob_core.sip.relaxed.relaxed import Rows
from sparserob_core.sip.result import Result
from sparserob_core.sip.separation.separation import separate
from sparserob_core.sip.solver import AccountedSolver
from sparserob_core.sip.working.ledger import (
    SEARCH_TOLERANCE,
    CheckedAnswer,
    Close,
    Found,
    Ledger,
    Prover,
    Violated,
    prove_nothing,
    select_violated,
)
from sparserob_core.sip.working.tightening import GLANCE, SPARED
from sparserob_core.sip.working.working import LargestViolation, Working, size_of

SHARES = (0.1, 0.5, 1.0)  # points from the best decision known to the relaxed optimum at which rows are sought
ENDED = 0.05  # seconds after the deadline when it has passed for certain
ROWS_PER_POINT = 4  # largest number of rows at each of these points
CHOOSING = 30  # largest number of rounds of a second objective
# Largest number of variables of a second objective. With ten times as many, the simplex method takes minutes where the
# first objective takes seconds (100 pieces, two states: 10 000); a tenth excludes six states on twelve pieces.
MAX_SECOND_VARIABLES = 4000
COARSE, SHARPER = 10.0, 0.1  # accuracy of the first round as a share of the cost, and its factor from round to round
LAST_ACCURACY_SHARE = 0.1  # accuracy of the last rounds as a share of the tolerance
FARKAS = 1e-9  # least violation of a weighted sum of rows that proves infeasibility


@final
@dataclass(eq=False)
class RobustRows(Working):
    """Working set of rows that must hold for every deviation.

    Parameters
    ----------
    counterpart : Counterpart
        Robust counterpart at the imposed indices.
    close : Close, optional
        Exchange of another program.
    cuts : list of Cut
        All rows of every imposed index.
    known : set
        Families and indices that are imposed.
    raw : ndarray, shape (n,)
        Relaxed optimum before it is settled.
    best : ndarray, shape (n,)
        Best decision known, for a program with a guide; empty otherwise.
    tolerance : float
        Relative gap at which the bounds have met.
    accuracy : float
        Share of the cost to which a round is solved, where the solver can choose.
    price : float
        Price of a margin of 1 in the last round.
    calls : Counter of str
        Numbers of answers by their origin.
    asked : AccountedSolver, optional
        Solver of the counterparts, where the user named one.
    guided : bool
        Whether the guide was used.
    """

    counterpart: Counterpart = field(kw_only=True)
    close: Close | None = None
    cuts: list[Cut] = field(default_factory=list)
    known: set[tuple[str, bytes]] = field(default_factory=set)
    raw: Array = field(default_factory=lambda: np.zeros(0))
    best: Array = field(default_factory=lambda: np.zeros(0))
    tolerance: float = 0.0
    accuracy: float = COARSE
    price: float = 0.0
    calls: Counter[str] = field(default_factory=Counter)
    asked: AccountedSolver | None = None
    guided: bool = False

    @staticmethod
    def start(program: SemiInfiniteProgram, ledger: Ledger, close: Close) -> RobustRows:
        """Return a working set with the first indices of every family.

        The bounds of the decision alone give a first lower bound.

        Parameters
        ----------
        program : SemiInfiniteProgram
            Program with deviations.
        ledger : Ledger
            Accounts of the method.
        close : Close
            Exchange of another program.

        Returns
        -------
        RobustRows
            The working set.
        """
        assert program.spread is not None
        solver = None if ledger.relaxed.counted.instead is None else ledger.relaxed.counted
        counterpart = Counterpart(program.finite, program.spread, asked=solver)
        working = RobustRows(program, counterpart=counterpart, close=close, tolerance=ledger.tolerance, asked=solver)
        for family in program.families:
            assert family.start is not None
            working.add(family, family.start)
        ledger.improve(working.at_rest)
        return working

    def solve(self, margin: float, accuracy: float, seconds: float = np.inf) -> RobustAnswer:
        """Return the optimum with the rows tightened by a margin.

        Parameters
        ----------
        margin : float
            The margin.
        accuracy : float
            Approximate accuracy of the cost.
        seconds : float, default inf
            Limit of time, after which the answer is not solved.

        Returns
        -------
        RobustAnswer
            The answer.
        """
        before = Counter(self.counterpart.answered)
        answer = self.counterpart.solve(margin, accuracy, seconds)
        self.calls += self.counterpart.answered - before
        return answer

    def relax(self, ledger: Ledger, prover: Prover, last: bool) -> CheckedAnswer | Result:
        """Return the optimum under the imposed rows, or the final result where there is none.

        Where tightened rows are infeasible, the margin is reduced; in the end infeasibility is proven. For a program
        with a guide, the best decision known is returned once, where it closes the gap.
        """
        self._solve_guide(ledger)
        program = self.program
        size = program.largest_cost if ledger.best is None else size_of(program, ledger.best)
        while not (solution := self.solve(self.margin, self.accuracy * size, left(ledger.tools))).solved:
            self._record_calls(ledger)
            ledger.tools.deadline.check()
            if not self.thin():
                return self._prove_infeasible(ledger, solution.said)
        self._record_calls(ledger)
        answer = self._form_answer(ledger, solution)
        self.price = self.priced(answer)
        self.pay(ledger, answer)
        if self.best.size and ledger.open(answer.solution.x) and (last or not ledger.open(self.best)):
            answer, self.best = self._replace_decision(answer, self.best), np.zeros(0)
        return answer

    def _solve_guide(self, ledger: Ledger) -> None:
        """Solve the program's guide, and impose its indices and the constraints that its optimum defines."""
        program, tools = self.program, ledger.tools
        if program.guide is None or self.guided:
            return
        assert self.close is not None
        self.guided, (guide, shared) = True, program.guide
        result = self.close(guide, replace(tools, notify=ignore), prove_nothing)
        self.calls += Counter(result.solved_by)
        tools.deadline.check()
        if result.decision is None:
            return
        self.raw = np.concatenate([result.decision[:shared], np.zeros(program.n - shared)])
        self.best = self.raw if program.settle is None else program.settle(self.raw)
        imposed = result.history[-1].imposed
        for family in program.families:
            indices = [cut.index for cut in imposed if cut.family == family.name and not cut.row]
            if not family.defines and indices:
                self.add(family, np.array(indices))
        self.impose(self._find_undefined(self.best, False))

    def _find_undefined(self, x: Array, feasible: bool) -> Violated:
        """Return violated constraints of families that define variables.

        The constraints are sought at the relaxed optimum before it is settled, and between it and the best decision
        known (Ben-Ameur and Neto 2007). Where the optimum ``x`` is ``feasible``, a better decision is kept.
        """
        program, raw = self.program, self.raw
        if feasible and not (self.best.size and program.cost(self.best) <= program.cost(x)):
            self.best = x
        best = self.best if self.best.size else x
        violated: list[tuple[Array, np.ndarray, str]] = []
        for family in program.families:
            if not family.defines or family.worst is None:
                continue
            for share in SHARES:
                candidate = share * raw + (1.0 - share) * best
                separation = family.separated(candidate)
                is_violated = family.violations(raw, separation.indices).max(axis=1) > SEARCH_TOLERANCE
                violated.append(
                    (
                        separation.indices[is_violated][:ROWS_PER_POINT],
                        separation.rows[is_violated][:ROWS_PER_POINT],
                        family.name,
                    )
                )
                if feasible and program.settle is not None:
                    candidate = program.settle(candidate)
                    if program.cost(candidate) < program.cost(self.best):
                        self.best = candidate
        return violated

    def candidate(self, answer: CheckedAnswer) -> CheckedAnswer | None:
        """Return the best decision known, for a program with a guide."""
        return self._replace_decision(answer, self.best) if self.best.size else None

    @property
    def size(self) -> int:
        """Number of imposed rows."""
        return len(self.cuts)

    def exchange(self, answer: CheckedAnswer, violated: Violated, number: int) -> int:
        """Impose violated rows; return the number of changes.

        The worst deviations of imposed rows are added too. Where all of them are known, the next solution is more
        accurate.
        """
        x = answer.solution.x
        if not any(rows.size for _, rows, _ in violated):
            return 0
        changes = self.impose(violated)
        if self.program.guide is not None:
            changes += self.impose(self._find_undefined(x, False))
        worst = max(float(self.program.family(name).violations(x, at).max(initial=0.0)) for at, _, name in violated)
        return changes + self._raise_accuracy(answer, worst, bool(changes)) + self.counterpart.sharpen(x)

    def sharpen(self, ledger: Ledger, answer: CheckedAnswer) -> bool:
        """Add constraints that the guide does not contain, more accuracy, or the worst deviations; return false where
        none remain."""
        x, undefined = answer.solution.x, 0
        if self.program.guide is not None:
            undefined = self.impose(self._find_undefined(x, True))
        return bool(undefined + self._raise_accuracy(answer, 0.0, bool(undefined)) + self.counterpart.sharpen(x))

    def _raise_accuracy(self, answer: CheckedAnswer, violation: float, added: bool) -> bool:
        """Return whether the next round can be more accurate; it is where new constraints change little."""
        if not self.counterpart.approximate or self.accuracy <= LAST_ACCURACY_SHARE * self.tolerance:
            return False
        if not added or self.price * violation < self.accuracy * size_of(self.program, answer):
            self.accuracy = max(LAST_ACCURACY_SHARE * self.tolerance, SHARPER * self.accuracy)
        return True

    def impose(self, violated: Violated) -> int:
        """Impose all rows of violated indices; return the number of new indices."""
        return sum(self.add(self.program.family(name), indices) for indices, _, name in violated)

    def add(self, family: ConstraintFamily, indices: Array) -> int:
        """Impose all rows of a family at indices ``(k, d)``; return the number of new indices."""
        assert family.uncertain is not None
        count = 0
        for index in indices:
            key = (family.name, index.tobytes())
            if key in self.known:
                continue
            rows = family.uncertain(index)
            self.known.add(key)
            self.counterpart.add(rows)
            self.cuts += [Cut(family.name, index, row) for row in range(rows.h.size)]
            count += 1
        return count

    def knows(self, violation: LargestViolation) -> bool:
        """Return whether an index is imposed."""
        return (violation.family, violation.at[0].tobytes()) in self.known

    def priced(self, answer: CheckedAnswer) -> float:
        """Return the sum of the multipliers: the price of a margin of 1."""
        return float(answer.multipliers.sum())

    @property
    def longest(self) -> float:
        """1: margins are in the rows' own units."""
        return 1.0

    @property
    def unit(self) -> float:
        """1: margins are in the rows' own units."""
        return 1.0

    def distance(self, violation: LargestViolation) -> float:
        """Return the violation, since margins are in the rows' own units."""
        return violation.size

    def tightened(self, ledger: Ledger, answer: CheckedAnswer, margin: float) -> CheckedAnswer | None:
        """Return the optimum of the imposed rows tightened by ``margin``, accurate to a tenth of what the first margin
        may cost, or as accurate as the rounds."""
        accuracy = min(self.accuracy, SHARPER * SPARED) * size_of(self.program, answer)
        solution = self.solve(margin, accuracy, left(ledger.tools))
        self._record_calls(ledger)
        return self._form_answer(ledger, solution) if solution.solved else None

    def _form_answer(self, ledger: Ledger, found: RobustAnswer) -> CheckedAnswer:
        """Return the decision of a solved counterpart; the bound of its multipliers improves the lower bound."""
        self.raw = np.clip(found.x, self.program.finite.lower, self.program.finite.upper)
        dual, none = self.dual(found, priced=True), np.zeros(0)
        ledger.improve(dual)
        solution = FiniteSolution("optimal", self.raw, np.inf, dual.bound, found.y, found.mu, none, np.inf, np.inf)
        return self._replace_decision(CheckedAnswer(solution, self._imposed_rows, 0.0, np.inf), self._settle(self.raw))

    def _settle(self, x: Array) -> Array:
        """Return a decision within its bounds, with the variables that families define at their values."""
        settled = x if self.program.settle is None else self.program.settle(x)
        if self.program.finite.residual(settled) > TOLERANCE:
            # a settled variable outside of its bounds means that the quantity it bounds is outside too
            settled = np.clip(settled, self.program.finite.lower, self.program.finite.upper)
        return settled

    def _replace_decision(self, answer: CheckedAnswer, x: Array) -> CheckedAnswer:
        """Return an answer with another decision."""
        value, bound = self.program.cost(x), answer.solution.lower_bound
        residual = self.program.finite.residual(x)
        solution = replace(answer.solution, x=x, value=value, residual=residual, gap=value - bound)
        return replace(answer, solution=solution, value=value)

    @property
    def _imposed_rows(self) -> Rows:
        """Imposed rows by name; their coefficients depend on the deviations."""
        return Rows(np.zeros((len(self.cuts), 0)), np.zeros(len(self.cuts)), tuple(self.cuts))

    def dual(self, answer: RobustAnswer, priced: bool) -> Dual:
        """Return the bound that the multipliers of an answer prove, with the cuts that prove it.

        Parameters
        ----------
        answer : RobustAnswer
            Answer with multipliers and deviations.
        priced : bool
            Whether the cost enters the bound; false for a proof of infeasibility.

        Returns
        -------
        Dual
            The bound, reduced by its rounding error.
        """
        blocks = self.counterpart.blocks
        decision = answer.at
        if not priced:
            decision = None
        elif decision is None and (self.program.P is not None or self.program.finite.blocks is not None):
            decision = np.zeros(self.program.n)
        named = self.counterpart.spread.named(answer.deviations)
        bound = robust_bound(self.program.finite, blocks, answer.y, named, answer.mu, priced, decision)
        cuts = tuple(
            replace(cut, index=np.concatenate([cut.index, w]), multiplier=float(y), formulation="literal")
            for cut, y, w in zip(self.cuts, answer.y, named, strict=True)
            if y > 0.0
        )
        share = bound.rounding + self.counterpart.spread.lost
        return Dual(bound.value - share * bound.size, cuts, answer.mu, at=decision)

    @property
    def at_rest(self) -> Dual:
        """Lower bound by the bounds of the decision alone, without a multiplier."""
        rows, size = len(self.cuts), self.counterpart.spread.size
        none = RobustAnswer(
            True, "", np.zeros(0), np.zeros(rows), np.zeros((rows, size)), np.zeros(self.program.finite.b.size)
        )
        return self.dual(none, priced=True)

    def refuted(self, answer: RobustAnswer) -> Dual | None:
        """Return the proof, by the multipliers of an answer, that no decision is feasible; ``None`` where they prove
        nothing."""
        total = float(answer.y.sum() + np.abs(answer.mu).sum())
        if not 0.0 < total < np.inf:
            return None
        dual = self.dual(replace(answer, y=answer.y / total, mu=answer.mu / total), priced=False)
        return dual if dual.bound > FARKAS else None

    def _prove_infeasible(self, ledger: Ledger, said: str) -> Result:
        """Return the result ``infeasible`` where multipliers prove it, and ``failed`` otherwise."""
        none = np.zeros(0)
        relaxing = Counterpart(self.program.finite, self.counterpart.spread, elastic=True, asked=self.asked)
        for block in self.counterpart.blocks:
            relaxing.add(block)
        elastic = relaxing.solve(seconds=left(ledger.tools))
        while elastic.solved and relaxing.sharpen(elastic.x):
            elastic = relaxing.solve(seconds=left(ledger.tools))
        self.calls += relaxing.answered
        self._record_calls(ledger)
        if not elastic.solved:
            ledger.tools.deadline.check()
        dual = self.refuted(elastic) if elastic.solved else None
        if dual is not None:
            return self._report_infeasible(ledger, elastic, dual)
        x = np.zeros(self.program.n)
        solution = FiniteSolution("failed", x, np.nan, -np.inf, none, none, none, np.inf, np.inf, said)
        answer = CheckedAnswer(solution, self._imposed_rows, 0.0, np.nan)
        return ledger.result("failed", f"the relaxed program was not solved: {said}", answer)

    def _report_infeasible(self, ledger: Ledger, answer: RobustAnswer, dual: Dual) -> Result:
        """Return the result ``infeasible`` with the multipliers that prove it."""
        solution = FiniteSolution(
            "infeasible",
            answer.x,
            np.inf,
            np.inf,
            answer.y,
            answer.mu,
            np.zeros(0),
            np.inf,
            0.0,
            answer.said,
            (),
            dual.bound,
        )
        ledger.dual = dual
        reason, worst = _describe_infeasibility(self.program, dual)
        final_answer = CheckedAnswer(solution, self._imposed_rows, 0.0, np.inf)
        return replace(ledger.result("infeasible", reason.sentence(), final_answer, worst), infeasible=reason)

    def _record_calls(self, ledger: Ledger) -> None:
        """Record the number of answers in the accounts."""
        ledger.relaxed.solves = self.calls.total()
        if self.asked is None:
            ledger.relaxed.counted.calls = ledger.relaxed.solves
        ledger.relaxed.solved_by.update(self.calls - ledger.relaxed.solved_by)

    def proven(self, ledger: Ledger, answer: CheckedAnswer, x: Array) -> Dual:
        """Return the lower bound by the bounds of the decision alone."""
        return self.at_rest

    def choose(
        self, ledger: Ledger, answer: CheckedAnswer, found: Found, number: int, prover: Prover
    ) -> tuple[CheckedAnswer, Found, Violated]:
        """Return the best decision by the second objective of the program (``among``), once this decision has been
        proven.

        The choice is among decisions whose cost is at most the lower bound plus half of the tolerance.
        """
        second, x = self.program.among, answer.solution.x
        violated = any(select_violated(*pair)[1].size for pair in found)
        if second is None or second[0].n > MAX_SECOND_VARIABLES or violated or ledger.open(x):
            return answer, found, ()
        if not ledger.prove(answer, found, prover(x, GLANCE)):
            return answer, found, ()
        decision = self._optimise_second(ledger, answer, *second)
        if decision is None or self.program.finite.residual(decision) > TOLERANCE or ledger.open(decision):
            return answer, found, ()
        separations = separate(self.program, decision, ledger.tools, SEARCH_TOLERANCE, number)
        if any(select_violated(*pair)[1].size for pair in separations):
            return answer, found, ()
        return self._replace_decision(answer, decision), separations, ()

    def _optimise_second(
        self, ledger: Ledger, answer: CheckedAnswer, second: SemiInfiniteProgram, shared: int
    ) -> Array | None:
        """Return the optimum of the ``second`` program under the active rows and one more row of the cost.

        ``shared`` is the number of first entries that the two decisions share.
        """
        program, tools, spread = self.program, replace(ledger.tools, notify=ignore), self.counterpart.spread
        weights = np.append(program.finite.weights[:shared], np.zeros(second.n - shared))
        cost_limit = max(ledger.lower, 0.0) * (1.0 + 0.5 * ledger.tolerance)
        counterpart = Counterpart(second.finite, spread, ceiling=(weights, cost_limit), asked=self.asked)
        working = RobustRows(second, margin=self.margin, counterpart=counterpart, asked=self.asked)
        for family in second.families:
            active_indices = {cut.index.tobytes(): cut.index for cut in answer.active if cut.family == family.name}
            start = np.zeros((0, family.index_set.dimension)) if family.start is None else family.start
            working.add(family, np.array(list(active_indices.values())) if active_indices else start)
        for number in range(1, CHOOSING + 1):
            if tools.deadline.passed:
                return None
            solution = working.solve(working.margin, 0.0, left(tools))
            if not solution.solved:
                return None
            x = np.clip(solution.x, second.finite.lower, second.finite.upper)
            x = x if second.settle is None else second.settle(x)
            violated = [select_violated(*pair) for pair in separate(second, x, tools, SEARCH_TOLERANCE, number)]
            violated += self._find_violated(second, x)
            if not (working.impose(violated) or counterpart.sharpen(x)):
                break
        self.calls += working.calls
        self._record_calls(ledger)
        if any(rows.size for _, rows, _ in violated):
            return None
        return x[:shared] if program.settle is None else program.settle(x[:shared])

    def _find_violated(self, second: SemiInfiniteProgram, x: Array) -> list[tuple[Array, np.ndarray, str]]:
        """Return the indices imposed here that a decision of the ``second`` program violates."""
        violated = []
        for family in second.families:
            imposed_indices = {cut.index.tobytes(): cut.index for cut in self.cuts if cut.family == family.name}
            if imposed_indices:
                indices = np.array(list(imposed_indices.values()))
                is_violated = family.violations(x, indices).max(axis=1) > SEARCH_TOLERANCE
                violated.append((indices[is_violated], np.zeros(int(is_violated.sum()), dtype=int), family.name))
        return violated


def left(tools: Tools) -> float:
    """Return the seconds that a solution may take."""
    return np.inf if tools.deadline.left is None else tools.deadline.left + ENDED


def _describe_infeasibility(
    program: SemiInfiniteProgram, dual: Dual
) -> tuple[InfeasibleSubsystem, WorstConstraint | None]:
    """Return the constraints that cannot hold together, those with the largest multipliers first, and the first of
    them."""
    families = {family.name: family for family in program.families}
    order = sorted(dual.cuts, key=lambda cut: -cut.multiplier)
    explanations = [
        families[cut.family].explanation(cut.index[: families[cut.family].index_set.dimension], cut.row)
        for cut in order
    ]
    first = order[0]
    bare = WorstConstraint(
        dual.bound, first.family, first.index[: families[first.family].index_set.dimension], first.row
    )
    members = tuple(explanation.text for explanation in explanations[:MAX_NAMED_REASONS])
    subsystem = InfeasibleSubsystem(
        members=members,
        others=max(0, len(explanations) - MAX_NAMED_REASONS),
        equalities=bool(program.finite.b.size),
        decides="policy",
        irreducible=False,
    )
    return subsystem, add_facts(program, bare)
