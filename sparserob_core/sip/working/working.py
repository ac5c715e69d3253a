"""Working set of an exchange: the imposed constraints, and the margin by which they are tightened.

Imposed constraints are rows that are linear in the decision (`working.plain`), or rows that must hold for every
deviation (`working.robust`). Their solvers differ too. The rules of margins are the same, and are in this module.
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
from sparserob_core.sip.working.ledger import (
    SEARCH_TOLERANCE,
    CheckedAnswer,
    Found,
    Ledger,
    Prover,
    Violated,
    select_violated,
)

# The least positive margin, and the largest, in units of the decision's bounds where those are below 1. The least is
# the rounding of rows: five times as much costs most of the tolerated gap where multipliers are a million; less has no
# effect. With a tenth of it, the largest is below the residuals of solvers (1e-7 at worst); ten times as much changes
# the sixth digit of a cost.
SMALLEST_MARGIN, LARGEST_MARGIN = 2.0**-52, 1e-6
# Factor of the next margin after one that leaves nothing feasible. With a tenth as factor, a set as thin as 1e-8 takes
# three times as many programs; with a millionth, the margin of such a set is below the residuals of solvers.
SMALLER_MARGIN_FACTOR = 1e-3
# Largest number of margins raised for the rounding of a proof. The first suffices nearly always; ten times as many are
# full proofs of minutes that no margin lets succeed.
ALLOWANCES = 4
# Share of the tolerated gap that is paid for the errors of a proof, such as those of transition matrices over many
# orbits. With all of it, nothing is left for the bounds; with a tenth, gaps stay open that a larger margin closes.
ROUNDING_SHARE_OF_GAP = 0.5
# Number of active rows at which a margin may cost a quarter of the tolerated gap. With ten times as many, a long arc
# along a constraint takes twice as many cells; with a tenth, costs of ordinary problems are a relative 2e-8 too high.
MANY_ACTIVE = 32


class LargestViolation(NamedTuple):
    """Largest violation of a family that was found, or that is not excluded.

    Parameters
    ----------
    size : float
        The violation.
    family : str
        Name of the family.
    at : ndarray, shape (1, d)
        Its index.
    row : ndarray of int, shape (1,)
        Its row.
    """

    size: float
    family: str
    at: Array
    row: np.ndarray

    @staticmethod
    def of(family: ConstraintFamily, separation: Separation) -> LargestViolation:
        """Return the largest violation of a family that its separation has found."""
        largest = float(separation.violations.max(initial=0.0))
        return LargestViolation(largest, family.name, separation.indices[:1], separation.rows[:1])


@dataclass(eq=False)
class Working(ABC):
    """Imposed constraints of a program, and the margin by which their rows are tightened.

    Parameters
    ----------
    program : SemiInfiniteProgram
        The program.
    margin : float
        Margin by which rows are tightened.
    floor : float
        Lower bound of the margin.
    ceiling : float
        Upper bound of the margin.
    slater : bool
        Whether there is a Slater point for the margin.
    allowed : int
        Number of times that the margin was raised to allow for rounding.
    due_count : int
        Number of times that a proven decision was due, by its price or by the share of a limit that has passed.
    """

    program: SemiInfiniteProgram
    margin: float = 0.0
    floor: float = 0.0
    ceiling: float = LARGEST_MARGIN
    slater: bool = True
    allowed: int = 0
    due_count: int = 0

    @property
    @abstractmethod
    def size(self) -> int:
        """Number of imposed rows."""

    @abstractmethod
    def relax(self, ledger: Ledger, prover: Prover, last: bool) -> CheckedAnswer | Result:
        """Return the optimum under the imposed constraints, or the final result where there is no optimum.

        The multipliers of the optimum improve the lower bound.

        Parameters
        ----------
        ledger : Ledger
            Accounts of the method.
        prover : Prover
            Prover of the families.
        last : bool
            Whether this is the last round.

        Returns
        -------
        Answer or Result
            The optimum, or the result.
        """

    @abstractmethod
    def exchange(self, answer: CheckedAnswer, violated: Violated, number: int) -> int:
        """Impose constraints that are violated at an answer, and drop idle ones.

        Parameters
        ----------
        answer : CheckedAnswer
            Answer to the relaxed program.
        violated : Violated
            Constraints that are violated at it.
        number : int
            Number of the round.

        Returns
        -------
        int
            Number of new constraints.
        """

    @abstractmethod
    def impose(self, violated: Violated) -> int:
        """Impose constraints that no answer contains yet; return the number of new constraints."""

    @abstractmethod
    def knows(self, violation: LargestViolation) -> bool:
        """Return whether a constraint is imposed."""

    @abstractmethod
    def sharpen(self, ledger: Ledger, answer: CheckedAnswer) -> bool:
        """Solve the imposed constraints more accurately, where nothing is violated and the gap is open.

        Parameters
        ----------
        ledger : Ledger
            Accounts of the method.
        answer : CheckedAnswer
            Answer to the relaxed program.

        Returns
        -------
        bool
            False where nothing is left to try.
        """

    @abstractmethod
    def proven(self, ledger: Ledger, answer: CheckedAnswer, x: Array) -> Dual:
        """Return the lower bound by the multipliers of an answer, or by none.

        Parameters
        ----------
        ledger : Ledger
            Accounts of the method.
        answer : CheckedAnswer
            Answer with multipliers.
        x : ndarray, shape (n,)
            Decision at which terms of the cost are replaced by tangents.

        Returns
        -------
        Dual
            The bound and its multipliers.
        """

    @abstractmethod
    def choose(
        self, ledger: Ledger, answer: CheckedAnswer, found: Found, number: int, prover: Prover
    ) -> tuple[CheckedAnswer, Found, Violated]:
        """Return the preferred one of the decisions that cost equally little.

        Parameters
        ----------
        ledger : Ledger
            Accounts of the method.
        answer : CheckedAnswer
            Answer to the relaxed program.
        found : Found
            Most violated constraints of each family at the answer.
        number : int
            Number of the round.
        prover : Prover
            Prover of the families.

        Returns
        -------
        answer : CheckedAnswer
            The preferred answer, or the same one.
        found : Found
            Most violated constraints at it.
        violated : Violated
            Constraints that the preferred decision violates, where the same answer is returned.
        """

    @abstractmethod
    def tightened(self, ledger: Ledger, answer: CheckedAnswer, margin: float) -> CheckedAnswer | None:
        """Return the optimum of the imposed rows tightened by a margin.

        Parameters
        ----------
        ledger : Ledger
            Accounts of the method.
        answer : CheckedAnswer
            Optimum with a smaller margin.
        margin : float
            The margin.

        Returns
        -------
        Answer or None
            The optimum; ``None`` where there is none.
        """

    @abstractmethod
    def priced(self, answer: CheckedAnswer) -> float:
        """Return the increase of an answer's cost when all rows are tightened by 1, to first order."""

    @property
    @abstractmethod
    def longest(self) -> float:
        """Largest change of a row's right-hand side by a margin of 1."""

    @property
    @abstractmethod
    def unit(self) -> float:
        """Unit of margins."""

    @abstractmethod
    def distance(self, violation: LargestViolation) -> float:
        """Return the margin that removes a violation."""

    @abstractmethod
    def candidate(self, answer: CheckedAnswer) -> CheckedAnswer | None:
        """Return a decision that may be proven before the gap is closed, where one is known."""

    def rested(self, ledger: Ledger, answer: CheckedAnswer, found: Found, number: int) -> tuple[CheckedAnswer, Found]:
        """Return the answer with every costly entry at 0, where that closes the gap and violates nothing.

        Solvers leave small entries where the optimum of a cost is 0, and the relative gap stays open there.

        Parameters
        ----------
        ledger : Ledger
            Accounts of the method.
        answer : CheckedAnswer
            Answer to the relaxed program.
        found : Found
            Most violated constraints of each family at the answer.
        number : int
            Number of the round.

        Returns
        -------
        answer : CheckedAnswer
            The new answer, or the same one.
        found : Found
            Most violated constraints at it.
        """
        x, decision = answer.solution.x, at_rest(self.program, answer.solution.x)
        cost = self.program.cost(decision)
        if answer.epsilon or not ledger.open(x) or not ledger.lower <= cost < self.program.cost(x):
            return answer, found  # what costs less than the lower bound is proven not to be feasible
        ledger.improve(self.proven(ledger, answer, decision))
        if not fits(ledger, decision):
            return answer, found
        all_separations = separate(self.program, decision, ledger.tools, SEARCH_TOLERANCE, number)
        separations = [pair for pair in all_separations if not pair[0].defines]
        if any(select_violated(*pair)[1].size for pair in separations):
            return answer, found
        solution = replace(answer.solution, x=decision, value=cost, gap=cost - answer.solution.lower_bound)
        return replace(answer, solution=solution, value=cost), separations

    def thin(self) -> bool:
        """Reduce the margin, after it left nothing feasible; return false where there is no margin.

        The program may be feasible without it: its feasible set may be thin, or there may be no Slater point.
        """
        if self.margin <= 0.0:
            return False
        self.ceiling = (
            SMALLER_MARGIN_FACTOR * self.margin if SMALLER_MARGIN_FACTOR * self.margin >= SMALLEST_MARGIN else 0.0
        )
        self.margin, self.slater = self.ceiling, self.ceiling > 0.0
        return True

    def pay(self, ledger: Ledger, answer: CheckedAnswer) -> None:
        """Tighten the rows by as much as a tenth of the tolerated gap pays for.

        Up to four tenths are paid where many rows are active at once. Near a constraint that is active for a long time,
        a proof needs many cells, and fewer of them at a larger distance.
        """
        if not self.slater or not self.size:
            return
        active = int((answer.multipliers > 0.0).sum())
        budget = (0.1 + 0.3 * active / (active + MANY_ACTIVE)) * ledger.tolerance * size_of(self.program, answer)
        price = max(self.priced(answer), np.finfo(float).tiny)
        margin = float(np.clip(budget / price, SMALLEST_MARGIN * self.unit, LARGEST_MARGIN * self.unit))
        if self.margin == 0.0 or margin < 0.5 * self.margin:
            self.margin = min(max(margin, self.floor), self.ceiling)

    def tighten(self, found: Found) -> bool:
        """Tighten the rows where imposed rows are violated because of the solver's accuracy.

        The margin becomes twice the largest of these violations, or twice the present margin. False is returned where
        that does not help.
        """
        violated = [
            violation
            for pair in found
            if (violation := LargestViolation.of(*pair)).size > SEARCH_TOLERANCE and self.knows(violation)
        ]
        if not violated or not self.slater or self.floor >= self.ceiling:
            return False
        distance = max(self.distance(violation) for violation in violated)
        self.floor = float(np.clip(2.0 * max(distance, self.margin), SMALLEST_MARGIN, self.ceiling))
        self.margin = max(self.margin, self.floor)
        return True

    def allow_for(self, ledger: Ledger, answer: CheckedAnswer, proofs: Sequence[Proof]) -> bool:
        """Increase the margin by what a proof leaves open, where nothing is violated.

        A proof has to allow for rounding.

        Parameters
        ----------
        ledger : Ledger
            Accounts of the method.
        answer : CheckedAnswer
            Answer to the relaxed program.
        proofs : sequence of Proof
            Proofs at the answer.

        Returns
        -------
        bool
            False where the amount is more than rounding and more than the tolerated gap pays for, or was tried too
            often.
        """
        if any(proof.verdict == "refuted" for proof in proofs) or not self.slater:
            return False
        violations = collect_open_violations(self.program, proofs)
        if not violations and ledger.is_excuse_dear(answer.solution.x, proofs):
            violations = [_make_excuse(proof) for proof in proofs if proof.bound > 0.0 and proof.index is not None]
        distances = [self.distance(violation) for violation in violations]
        floor = self.margin + 1.25 * max(distances, default=np.inf)
        if (floor > self.ceiling and not self._is_affordable(ledger, answer, floor)) or self.allowed >= ALLOWANCES:
            return False
        self.floor = self.margin = floor
        self.ceiling = max(self.ceiling, floor)
        self.allowed += 1
        return True

    def _is_affordable(self, ledger: Ledger, answer: CheckedAnswer, margin: float) -> bool:
        """Return whether the tolerated gap pays for a margin above the largest, where no such margin left nothing
        feasible.

        A margin without a price from multipliers is refused, for its cost is unknown.
        """
        price = self.priced(answer)
        return (
            self.ceiling >= LARGEST_MARGIN
            and 0.0 < price * margin <= ROUNDING_SHARE_OF_GAP * ledger.tolerance * size_of(self.program, answer)
        )


def at_rest(program: SemiInfiniteProgram, x: Array) -> Array:
    """Return the decision ``x (n,)`` with every costly entry at 0.

    All entries are set to 0 where images of the decision have a cost. Otherwise only the entries with a weight or a
    square, and not those that only answer deviations.
    """
    base = program.finite
    if base.S is not None:
        return np.zeros_like(x)
    costs = base.weights > 0.0
    if base.P is not None:
        costs = costs | (base.P.diagonal() > 0.0)
    rested: Array = np.where(costs, 0.0, x)
    return rested if program.settle is None else program.settle(rested)


def fits(ledger: Ledger, x: Array) -> bool:
    """Return whether a decision closes the gap and satisfies all constraints that are no family."""
    base = ledger.program.finite
    return not ledger.open(x) and base.equality_residual(x) <= EQUALITY and base.residual(x) <= SEARCH_TOLERANCE


def size_of(program: SemiInfiniteProgram, answer: CheckedAnswer) -> float:
    """Return the size to which a gap at an answer is relative."""
    x = answer.solution.x
    return max(SMALL_COST * program.added(x), abs(program.cost(x)))


def _make_excuse(proof: Proof) -> LargestViolation:
    """Return the violation that a proof excuses."""
    assert proof.index is not None
    return LargestViolation(proof.bound, proof.family, proof.index[None], np.array([proof.row]))


def collect_open_violations(program: SemiInfiniteProgram, proofs: Sequence[Proof]) -> list[LargestViolation]:
    """Return the violations that proofs could not exclude, each with the index of the largest violation found.

    Parameters
    ----------
    program : SemiInfiniteProgram
        The program.
    proofs : sequence of Proof
        Proofs of the families.

    Returns
    -------
    list of LargestViolation
        The violations. The list is empty where a proof excludes nothing at all, or is about another formulation than
        the imposed rows, since no margin would help then.
    """
    violations = [
        LargestViolation(
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
    complete = len(violations) == sum(proof.verdict != "proven" for proof in proofs)
    return violations if complete and all(np.isfinite(violation.size) for violation in violations) else []
