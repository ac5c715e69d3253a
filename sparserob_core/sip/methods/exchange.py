"""The exchange method: solve with few constraints, add those that the optimiser violates most, until the bounds meet.

Blankenship and Falk (1976) with three additions: the rows are tightened by a tiny margin, so that the optimiser is
feasible for the whole continuum and its cost is an upper bound; the lower bound comes from multipliers and untightened
rows by weak duality; and where there is a regulariser its weight decreases only until the cost stops changing (exact
regularisation: Friedlander and Tseng 2007).

What is imposed is for the working set to know: a row of the decision, or all rows of an index for every deviation.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar, final

import numpy as np
from pydantic import Field

from sparserob_core.errors import InputError
from sparserob_core.options import Options
from sparserob_core.sip.method import GAP_TOLERANCE, Method, Tools
from sparserob_core.sip.methods.driver import drive
from sparserob_core.sip.program import SemiInfiniteProgram
from sparserob_core.sip.proof.verdict import worst_of
from sparserob_core.sip.relaxed.relaxed import RelaxedProgram
from sparserob_core.sip.result import Result
from sparserob_core.sip.separation.separation import separate
from sparserob_core.sip.working.ledger import (
    SEARCH_TOLERANCE,
    CheckedAnswer,
    Found,
    Ledger,
    Prover,
    Violated,
    list_violated,
    prover_of,
    select_violated,
    witnesses,
)
from sparserob_core.sip.working.plain import PlainRows
from sparserob_core.sip.working.tightening import prefer_proven, proofs_of, tighten_in_time
from sparserob_core.sip.working.working import Working


class Exchange(Method, Options):
    """Exchange of indices until the relative gap is at most ``tolerance``, in at most ``rounds`` rounds."""

    tolerance: float = Field(default=GAP_TOLERANCE, gt=0.0, le=1.0)
    """Relative gap at which the bounds have met."""

    rounds: int = Field(default=200, ge=1)
    """Rounds at most."""

    robust: ClassVar[bool] = True

    exact: bool = True
    """Solve the unregularised problem, with the regulariser only as heavy as that allows; false: solve the regularised
    problem with the last weight of ``continuation``, for studies of that weight."""

    def solve(self, program: SemiInfiniteProgram, tools: Tools) -> Result:
        """`certified` when the gap is closed and every family is proven; infeasible, refuted or undecided otherwise,
        with the reason."""
        return self.close(program, tools, prover_of(program, tools))

    def close(self, program: SemiInfiniteProgram, tools: Tools, prover: Prover, start: Violated = ()) -> Result:
        """Close the gap of ``program``; what is claimed of the decision is what ``prover`` proves of it. ``start``:
        constraints to impose from the beginning."""
        if not self.exact and tools.regulariser is None:
            raise InputError(path="exact", expected="true, for there is no regulariser", got="false")
        rounds = self._start_rounds(program, tools, prover, start)
        return drive(tools.deadline, rounds.step, lambda error: rounds.ledger.stopped(error, prover))

    def _start_rounds(self, program: SemiInfiniteProgram, tools: Tools, prover: Prover, start: Violated) -> Rounds:
        close = self.model_copy(update={"exact": True}).close
        regulariser = tools.regulariser if program.spread is None else None
        relaxed = RelaxedProgram(program, tools.solver, regulariser, deadline=tools.deadline)
        ledger = Ledger(program, relaxed, tools, self.tolerance)
        if program.spread is None:
            working: Working = PlainRows.start(program, tools, self.exact, close)
        else:
            from sparserob_core.sip.working.robust import RobustRows

            working = RobustRows.start(program, ledger, close)
        working.impose(start)
        return Rounds(self, ledger, working, prover)


@final
@dataclass(eq=False)
class Rounds:
    """The rounds of an exchange: its accounts, what is imposed, who proves, and the last ``answer`` that seemed
    feasible, with what was ``found`` at it."""

    method: Exchange
    ledger: Ledger
    working: Working
    prover: Prover
    kept: tuple[CheckedAnswer, Found] | None = None

    def step(self, number: int) -> Result | None:
        """Perform one round; return its result where it is the last round, and ``None`` otherwise."""
        ledger, working, prover = self.ledger, self.working, self.prover
        program, tools, last = ledger.program, ledger.tools, number == self.method.rounds

        # Relax: the optimum under the imposed constraints, whose multipliers are a lower bound.
        answer = working.relax(ledger, prover, last)
        if isinstance(answer, Result):
            return ledger.salvaged(answer)
        ledger.best, x = ledger.best or answer, answer.solution.x

        # Separate: the constraints of the continuum that this decision violates most.
        separations: Found = [
            pair for pair in separate(program, x, tools, SEARCH_TOLERANCE, number) if not pair[0].defines
        ]
        violated: Violated = [select_violated(*pair) for pair in separations]
        feasible = not any(rows.size for _, rows, _ in violated)
        ledger.tell(number, answer, separations, program.cost(x) if feasible else np.inf, kept=working.size)
        self.kept = (answer, separations) if feasible else self.kept

        # Tighten: where time runs out, prove a decision that keeps away from the constraints while there is some.
        imposed = tighten_in_time(working, ledger, prover, answer, separations, number)

        # Exchange: impose them, drop what has been idle; of what is violated though imposed, solve a crude answer more
        # closely, and tighten else.
        crude = answer.solution.status != "optimal" and not feasible
        exchanged = not last and bool(
            working.exchange(answer, violated, number)
            or imposed
            or (crude and working.sharpen(ledger, answer))
            or working.tighten(separations)
        )
        # Rest: what costs is put to 0 where that meets the lower bound and violates nothing.
        if not exchanged:
            answer, separations = working.rested(ledger, answer, separations, number)
            x = answer.solution.x
        # Sharpen: nothing is violated but the bounds have not met, so solve what is imposed more closely.
        if exchanged or (not last and ledger.open(x) and working.sharpen(ledger, answer)):
            return None

        # Choose: of the decisions that cost as little, the one that is preferred; it may ask for more constraints.
        answer, separations, extra = working.choose(ledger, answer, separations, number, prover)
        if not last and working.exchange(answer, extra, number):
            return None

        # Prove: over the whole continuum; a witness that the proof meets is one more index to impose, and what rounding
        # may do, where it alone keeps a proof open, is allowed for like the solver's accuracy.
        proofs, imposed = proofs_of(working, ledger, prover, answer, separations)
        again = imposed or working.exchange(answer, witnesses(program, proofs), number)
        if not again and ledger.is_excuse_dear(answer.solution.x, proofs):
            again = bool(working.exchange(answer, list_violated(separations), number))
        again = again or working.allow_for(ledger, answer, proofs)
        if again and not last and not tools.deadline.passed:
            return None

        # Terminate: with what was proven of this decision, or of an earlier one that is.
        return self._choose_result(
            ledger.judged(answer, worst_of(separations), proofs, self._explain_ending(answer, last)), answer
        )

    def _explain_ending(self, answer: CheckedAnswer, last: bool) -> str:
        """Return the reason why there is no further round, where the rules of the exchange are not the reason."""
        if self.ledger.tools.deadline.passed:
            return self.ledger.tools.deadline.reason
        if last:
            return f"the {self.method.rounds} rounds of the method (method.rounds) are used up"
        if self.method.exact:
            return ""
        return f"the decision is optimal for the regularised problem, epsilon = {answer.epsilon:g}"

    def _choose_result(self, result: Result, answer: CheckedAnswer) -> Result:
        """The result, or that of a decision that is proven, or of the last one that seemed feasible, with an open gap,
        where only that is proven."""
        result = prefer_proven(self.ledger, result)
        if result.status not in ("refuted", "undecided") or self.kept is None or self.kept[0] is answer:
            return result
        kept_answer, separations = self.kept
        earlier = self.ledger.judged(kept_answer, worst_of(separations), self.prover(kept_answer.solution.x))
        return earlier if earlier.status in ("certified", "verified") else result
