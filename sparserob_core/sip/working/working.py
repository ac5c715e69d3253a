"""The working set of an exchange: imposed constraints, and the margin by which they are tightened.

What is imposed differs: rows that are linear in the decision (`working.plain`), or rows that must hold for every
deviation (`working.robust`); so does who solves them. The rules of margins do not, and stand here.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from sparserob_core.sip.convex_set import Array
from sparserob_core.sip.evidence import Dual, Proof
from sparserob_core.sip.program import EQUALITY, ConstraintFamily, SemiInfiniteProgram, Separation
from sparserob_core.sip.result import SMALL_COST, Result
from sparserob_core.sip.separation.separation import separate
from sparserob_core.sip.working.ledger import ALLOWED, Answer, Found, Ledger, Prover, Violated, above

# The least margin but 0, and the largest, in units of the decision's bounds where those are below 1. The least one is
# the rounding of rows: one that is five times larger costs most of the tolerated gap where rows are as dear as a
# million, a smaller one is not seen. A largest one that is ten times smaller does not get beyond what solvers leave of
# a row (1e-7 at worst); one that is ten times larger is seen in the sixth digit of a cost.
SMALLEST_MARGIN, LARGEST_MARGIN = 2.0**-52, 1e-6
# Share of a margin that leaves nothing feasible, which is tried next. With a tenth for it a set as thin as 1e-8 takes
# three times as many programs; with a millionth for it the margin of such a set is below what solvers leave.
THINNER = 1e-3
# Times that a proof is helped over rounding. The first helps nearly always; ten times as many are full proofs, of
# minutes, of what no margin will show.
ALLOWANCES = 4
# Of the tolerated gap, what is paid for what a proof must allow for, as what transitions are off by over many orbits.
# With all of it nothing is left for the bounds; with a tenth of it gaps stay open that a larger margin closes.
AFFORDED = 0.5
# Active rows at which a margin may cost a quarter of the tolerated gap. With ten times as many, a day on a wall takes
# twice as many cells; with a tenth of them, costs of ordinary problems are 2e-8 of themselves above the least.
MANY_ACTIVE = 32


class Missed(NamedTuple):
    """The largest violation of a family that was met, or that is not excluded, and its index ``(1, d)`` and row
    ``(1,)``."""

    violation: float
    family: str
    at: Array
    row: np.ndarray

    @staticmethod
    def most(family: ConstraintFamily, separation: Separation) -> Missed:
        """The largest violation that was found of a family."""
        largest = float(separation.violations.max(initial=0.0))
        return Missed(largest, family.name, separation.indices[:1], separation.rows[:1])


@dataclass(eq=False)
class Working(ABC):
    """Constraints of ``program`` that are imposed, with the ``margin`` by which rows are tightened, the ``floor`` that
    it must not fall below and the ``most`` that it may be; whether there is a ``slater`` point for it, how often
    rounding was ``allowed`` for, and how often a share of a limit has asked that a decision be ``secured``."""

    program: SemiInfiniteProgram
    margin: float = 0.0
    floor: float = 0.0
    most: float = LARGEST_MARGIN
    slater: bool = True
    allowed: int = 0
    secured: int = 0

    @property
    @abstractmethod
    def size(self) -> int:
        """How many rows are imposed."""

    @abstractmethod
    def relax(self, ledger: Ledger, prover: Prover, last: bool) -> Answer | Result:
        """The optimum under the imposed constraints, whose multipliers improve the lower bound; the result where there
        is none."""

    @abstractmethod
    def exchange(self, answer: Answer, violated: Violated, number: int) -> int:
        """Impose what is ``violated`` at an ``answer``, and drop what has been idle; how much is new."""

    @abstractmethod
    def impose(self, violated: Violated) -> int:
        """Impose constraints of which no answer speaks yet; how many were new."""

    @abstractmethod
    def knows(self, missed: Missed) -> bool:
        """Whether that constraint is imposed."""

    @abstractmethod
    def sharpen(self, ledger: Ledger, answer: Answer) -> bool:
        """Nothing is violated but the bounds have not met: solve more closely what is imposed; ``False`` when nothing
        is left to try."""

    @abstractmethod
    def proven(self, ledger: Ledger, answer: Answer, x: Array) -> Dual:
        """What is proven with the multipliers of an answer, or none, where the cost is touched at ``x (n,)``."""

    @abstractmethod
    def choose(
        self, ledger: Ledger, answer: Answer, found: Found, number: int, prover: Prover
    ) -> tuple[Answer, Found, Violated]:
        """Of the decisions that cost as little, the one that is preferred, with what was found at it; or the same
        answer and what that one violates."""

    @abstractmethod
    def tightened(self, ledger: Ledger, answer: Answer, margin: float) -> Answer | None:
        """The optimum of the imposed rows, tightened by so much; ``None`` where there is none. ``answer``: where they
        are tightened less."""

    @abstractmethod
    def priced(self, answer: Answer) -> float:
        """What the cost of an answer grows by when all rows are tightened by 1, to first order."""

    @property
    @abstractmethod
    def longest(self) -> float:
        """By how much the row that changes most is moved by a margin of 1."""

    @property
    @abstractmethod
    def unit(self) -> float:
        """The unit of margins."""

    @abstractmethod
    def distance(self, missed: Missed) -> float:
        """The margin that makes good what was missed."""

    @abstractmethod
    def candidate(self, answer: Answer) -> Answer | None:
        """A decision that may be proven as it is while the bounds have not met, where one is known."""

    def rested(self, ledger: Ledger, answer: Answer, found: Found, number: int) -> tuple[Answer, Found]:
        """The answer with nothing left of what costs, where that closes the gap and violates nothing: of a cost whose
        optimum is 0 solvers leave dust, and no relative gap is closed at dust."""
        x, other = answer.solution.x, at_rest(self.program, answer.solution.x)
        cost = self.program.cost(other)
        if answer.epsilon or not ledger.open(x) or not ledger.lower <= cost < self.program.cost(x):
            return answer, found  # what costs less than the lower bound is proven not to be feasible
        ledger.improve(self.proven(ledger, answer, other))
        if not fits(ledger, other):
            return answer, found
        every = separate(self.program, other, ledger.tools, ALLOWED, number)
        looked = [one for one in every if not one[0].defines]
        if any(above(*one)[1].size for one in looked):
            return answer, found
        solution = replace(answer.solution, x=other, value=cost, gap=cost - answer.solution.lower_bound)
        return replace(answer, solution=solution, value=cost), looked

    def thin(self) -> bool:
        """Nothing is feasible: the margin, not the program, may be at fault, as of a thin set or where there is no
        Slater point. Less of it from now on; ``False`` where there is none."""
        if self.margin <= 0.0:
            return False
        self.most = THINNER * self.margin if THINNER * self.margin >= SMALLEST_MARGIN else 0.0
        self.margin, self.slater = self.most, self.most > 0.0
        return True

    def pay(self, ledger: Ledger, answer: Answer) -> None:
        """Tighten the rows as much as a tenth of the tolerated gap pays for, and up to four tenths where many rows are
        active at once: a wall that is ridden takes cells all along it, the fewer the farther the control keeps away."""
        if not self.slater or not self.size:
            return
        active = int((answer.multipliers > 0.0).sum())
        budget = (0.1 + 0.3 * active / (active + MANY_ACTIVE)) * ledger.tolerance * size_of(self.program, answer)
        price = max(self.priced(answer), np.finfo(float).tiny)
        margin = float(np.clip(budget / price, SMALLEST_MARGIN * self.unit, LARGEST_MARGIN * self.unit))
        if self.margin == 0.0 or margin < 0.5 * self.margin:
            self.margin = min(max(margin, self.floor), self.most)

    def tighten(self, found: Found) -> bool:
        """Imposed rows that are violated nonetheless, by the solver's accuracy: tighten by twice as much; ``False``
        when that does not help."""
        violated = [one for each in found if (one := Missed.most(*each)).violation > ALLOWED and self.knows(one)]
        if not violated or not self.slater or self.floor >= self.most:
            return False
        missed = max(self.distance(one) for one in violated)
        self.floor = float(np.clip(2.0 * max(missed, self.margin), SMALLEST_MARGIN, self.most))
        self.margin = max(self.margin, self.floor)
        return True

    def allow_for(self, ledger: Ledger, answer: Answer, proofs: Sequence[Proof]) -> bool:
        """Nothing is violated, but a proof must allow for rounding and cannot show it: tighten by as much; ``False``
        where that is more than rounding, and more than the tolerated gap pays for, or was tried."""
        if any(proof.verdict == "refuted" for proof in proofs) or not self.slater:
            return False
        missed = [self.distance(one) for one in left_open(self.program, proofs)]
        floor = self.margin + 1.25 * max(missed, default=np.inf)
        if (floor > self.most and not self._affords(ledger, answer, floor)) or self.allowed >= ALLOWANCES:
            return False
        self.floor = self.margin = floor
        self.most = max(self.most, floor)
        self.allowed += 1
        return True

    def _affords(self, ledger: Ledger, answer: Answer, margin: float) -> bool:
        """Whether the tolerated gap pays for a margin beyond the largest, where no such margin left nothing feasible.
        What no multiplier prices may cost anything."""
        price = self.priced(answer)
        return self.most >= LARGEST_MARGIN and 0.0 < price * margin <= AFFORDED * ledger.tolerance * size_of(
            self.program, answer
        )


def at_rest(program: SemiInfiniteProgram, x: Array) -> Array:
    """The decision ``x (n,)`` with everything that costs at 0: all of it where images of it do, and else the entries
    with a weight or a square, not those that only answer deviations."""
    base = program.finite
    if base.S is not None:
        return np.zeros_like(x)
    costs = base.weights > 0.0
    if base.P is not None:
        costs = costs | (base.P.diagonal() > 0.0)
    rested: Array = np.where(costs, 0.0, x)
    return rested if program.settle is None else program.settle(rested)


def fits(ledger: Ledger, x: Array) -> bool:
    """Whether a decision closes the gap and keeps everything that is no family."""
    base = ledger.program.finite
    return not ledger.open(x) and base.missed(x) <= EQUALITY and base.residual(x) <= ALLOWED


def size_of(program: SemiInfiniteProgram, answer: Answer) -> float:
    """What a gap at an answer is relative to."""
    x = answer.solution.x
    return max(SMALL_COST * program.added(x), abs(program.cost(x)))


def left_open(program: SemiInfiniteProgram, proofs: Sequence[Proof]) -> list[Missed]:
    """What proofs could not exclude, each with where the largest violation was met; nothing where one of them excludes
    nothing at all, or speaks of another formulation than the imposed rows: then no distance would help it."""
    missed = [
        Missed(
            proof.violation if proof.verdict == "refuted" else proof.bound,
            proof.family,
            proof.index[None],
            np.array([proof.row]),
        )
        for proof in proofs
        if proof.verdict != "proven"
        and proof.index is not None
        and proof.formulation == program.family(proof.family).formulation
    ]
    complete = len(missed) == sum(proof.verdict != "proven" for proof in proofs)
    return missed if complete and all(np.isfinite(one.violation) for one in missed) else []
