"""Accounts of a method: the best lower bound, the rounds, and the claims at the end."""

from __future__ import annotations

import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from typing import Protocol, TypeAlias

import numpy as np

from sparserob_core.sip.convex_set import Array
from sparserob_core.sip.events import RoundFinished, frozen
from sparserob_core.sip.evidence import NO_BOUND, Cut, Dual, Proof
from sparserob_core.sip.finite import FiniteProgram, FiniteSolution
from sparserob_core.sip.inner.solve import ADVICE
from sparserob_core.sip.method import Tools
from sparserob_core.sip.program import (
    EQUALITY,
    TOLERANCE,
    ConstraintFamily,
    EqualityErrors,
    SemiInfiniteProgram,
    Separation,
    WorstConstraint,
)
from sparserob_core.sip.proof.branch_and_bound import MAX_PROOF_CELLS, more, prove
from sparserob_core.sip.proof.verdict import include_found_violation, infeasible_subsystem, verdict, witness, worst_of
from sparserob_core.sip.relaxed.relaxed import RelaxedProgram, Rows
from sparserob_core.sip.result import MEANING, Result, Status, relative_gap

COST_ROUNDING = 1e-13  # rounding error of a cost, relative to its terms
UNCLAIMED_RESIDUAL = 1e-8  # relative residual of bounds, rows and equalities at a decision without a claim
# Multiple of the tolerance: a violation above it contradicts a proof. With 1, rounding alone might contradict a proof;
# with ten times as much, a violation of twenty tolerances is claimed to be none.
CONTRADICTS = 2.0
SEARCH_TOLERANCE = TOLERANCE / 2  # violation that the search may leave to the proof

Violated: TypeAlias = Sequence[tuple[Array, np.ndarray, str]]  # indices (k, d), rows (k,) and the name of a family


class Prover(Protocol):
    """Function that proves the families at a decision ``x (n,)``, with at most ``cells`` cells for each family."""

    def __call__(self, x: Array, cells: int = MAX_PROOF_CELLS) -> Sequence[Proof]: ...


class Close(Protocol):
    """Exchange that closes the gap of a program, from constraints that are imposed at the start."""

    def __call__(self, program: SemiInfiniteProgram, tools: Tools, prover: Prover, start: Violated = ()) -> Result: ...


Found: TypeAlias = Sequence[tuple[ConstraintFamily, Separation]]


def prove_nothing(x: Array, cells: int = MAX_PROOF_CELLS) -> Sequence[Proof]:
    """Return no proof: the prover of a program of which only the bounds are needed."""
    return ()


def prover_of(program: SemiInfiniteProgram, tools: Tools) -> Prover:
    """Return the prover of all families of a program, which sends events and ends at the deadline of the tools."""

    def prover(x: Array, cells: int = MAX_PROOF_CELLS) -> Sequence[Proof]:
        return prove(program, x, tools.notify, cells, tools.deadline)

    return prover


@dataclass(frozen=True, eq=False)
class CheckedAnswer:
    """Answer to a relaxed program.

    Parameters
    ----------
    solution : FiniteSolution
        The checked solution.
    rows : Rows
        The imposed rows.
    epsilon : float
        Weight of the regulariser.
    value : float
        Value of the relaxed program; it may differ from that of the solution.
    """

    solution: FiniteSolution
    rows: Rows
    epsilon: float
    value: float

    @property
    def multipliers(self) -> Array:
        """Multipliers ``(r,)`` of the imposed rows; zeros where the solution has none."""
        count, y = self.rows.h.size, self.solution.y
        return y[y.size - count :] if y.size >= count else np.zeros(count)

    @property
    def active(self) -> tuple[Cut, ...]:
        """Imposed constraints with a positive multiplier, which is filled in."""
        pairs = zip(self.rows.cuts, self.multipliers, strict=True)
        return tuple(replace(cut, multiplier=float(m)) for cut, m in pairs if m > 0.0)


@dataclass(eq=False)
class Ledger:
    """Knowledge of a method about its program.

    Parameters
    ----------
    program : SemiInfiniteProgram
        The program.
    relaxed : RelaxedProgram
        Its relaxed program.
    tools : Tools
        Components of the run.
    tolerance : float
        Relative gap at which the bounds have met.
    started : float
        Time of the start, in seconds.
    dual : Dual
        Multipliers of the best lower bound.
    history : list of RoundFinished
        All rounds.
    best : CheckedAnswer, optional
        The last answer that no search refuted, or else the last answer.
    proven : tuple, optional
        The cheapest answer at which every family is proven, with its separations and proofs.
    """

    program: SemiInfiniteProgram
    relaxed: RelaxedProgram
    tools: Tools
    tolerance: float
    started: float = field(default_factory=time.perf_counter)
    dual: Dual = NO_BOUND
    history: list[RoundFinished] = field(default_factory=list)
    best: CheckedAnswer | None = None
    proven: tuple[CheckedAnswer, Found, Sequence[Proof]] | None = None
    _separations: Found = ()
    _has_suggested: bool = False

    @property
    def lower(self) -> float:
        """Best lower bound proven so far."""
        return self.dual.bound

    def improve(self, dual: Dual) -> None:
        """Keep the better of two lower bounds."""
        self.dual = max(self.dual, dual, key=lambda one: one.bound)

    def open(self, x: Array) -> bool:
        """Return whether the gap between the lower bound and the cost of ``x (n,)`` is open."""
        return self.gap(x) > self.tolerance

    def gap(self, x: Array) -> float:
        """Return the relative gap between the lower bound and the cost of ``x (n,)``."""
        return relative_gap(self.lower, self.program.cost(x), self.program.added(x))

    def _compute_resolved_gap(self, x: Array, excused: float = 0.0) -> float:
        """Return the relative gap at ``x (n,)`` with the cost increased by its possible rounding error, and by what the
        ``excused`` violations may be worth.

        Where squares cancel, nearly all of the cost may be rounding. Then the gap is not known to be closed.
        """
        rounded = np.finfo(float).eps * self.program.finite.magnitude(x)
        return relative_gap(
            min(self.lower, self.program.cost(x)), self.program.cost(x) + rounded + excused, self.program.added(x)
        )

    def is_excuse_dear(self, x: Array, proofs: Sequence[Proof]) -> bool:
        """Return whether what proofs at ``x (n,)`` excuse is all that keeps the gap open."""
        excused = self._price_excuses(x, proofs)
        return self._compute_resolved_gap(x) <= self.tolerance < self._compute_resolved_gap(x, excused)

    def _price_excuses(self, x: Array, proofs: Sequence[Proof]) -> float:
        """Return how much the cost would rise, to first order, if nothing were excused, for rows in units of their own.

        The rows of a control have the unit of their set, to which an excuse is relative. Other rows are excused by a
        number, which may be as large as a small cost.
        """
        if self.program.lengths is not None:
            return 0.0
        excused = {proof.family: max(proof.bound, 0.0) for proof in proofs if proof.verdict == "proven"}
        price = sum(cut.multiplier * excused.get(cut.family, 0.0) for cut in self.dual.cuts)
        return price + _price_residuals(self.program.finite, self.dual, x)

    def tell(self, number: int, answer: CheckedAnswer, found: Found, upper: float, kept: int) -> None:
        """Record a round, and send its event.

        Parameters
        ----------
        number : int
            Number of the round.
        answer : CheckedAnswer
            Answer to the relaxed program.
        found : Found
            Most violated constraints of each family at the answer.
        upper : float
            Upper bound that the round suggests.
        kept : int
            Number of rows kept.
        """
        worst, x = worst_of(found), answer.solution.x
        added, dropped = _compare_cuts(self.history[-1].imposed if self.history else (), answer.rows.cuts)
        event = RoundFinished(
            round=number,
            epsilon=answer.epsilon,
            lower_bound=self.lower,
            upper_bound=upper,
            violation=worst.violation,
            worst_family=worst.constraint,
            measured=self.program.family(worst.constraint).measure(worst.row) if worst.constraint else "",
            active_indices=kept,
            cuts_added=len(added),
            cuts_dropped=len(dropped),
            relaxed_programs=self.relaxed.solves,
            seconds=time.perf_counter() - self.started,
            cost=self.program.cost(x),
            decision=frozen(x),
            separations={family.name: separation for family, separation in found},
            imposed=answer.rows.cuts,
            multipliers=frozen(answer.multipliers),
            added=added,
            dropped=dropped,
            gap=self.gap(x) if np.isfinite(upper) else np.inf,
            proven=np.inf if self.proven is None else self.program.cost(self.proven[0].solution.x),
        )
        self.history.append(event)
        if np.isfinite(upper) or not self._has_suggested:
            self.keep(answer, found)
            self._has_suggested = bool(np.isfinite(upper))
        self.tools.notify(event)

    def keep(self, answer: CheckedAnswer, found: Found = ()) -> None:
        """Keep the answer that is returned if the method is stopped now, with its most violated constraints."""
        self.best, self._separations = answer, found

    def prove(self, answer: CheckedAnswer, found: Found, proofs: Sequence[Proof]) -> bool:
        """Keep an answer if these proofs show that it is feasible and it is the cheapest so far.

        Parameters
        ----------
        answer : CheckedAnswer
            The answer.
        found : Found
            Most violated constraints of each family at the answer.
        proofs : sequence of Proof
            Proofs at the answer.

        Returns
        -------
        bool
            False where the proofs do not show that the answer is feasible.
        """
        if len(proofs) != len(self.program.families) or any(proof.verdict != "proven" for proof in proofs):
            return False
        x = answer.solution.x
        if any(excess > limit for _, excess, limit in self._list_residuals(x, strictly=True)):
            return False
        errors = self._bound_equality_errors(x)
        if errors is not None and not errors.kept:
            return False
        if self.cheaper(answer):
            self.proven = answer, found, proofs
        return True

    def cheaper(self, answer: CheckedAnswer) -> bool:
        """Return whether the answer costs less than the cheapest proven answer, or no answer is proven."""
        cost = self.program.cost(answer.solution.x)
        return self.proven is None or cost < self.program.cost(self.proven[0].solution.x)

    def judged(
        self, answer: CheckedAnswer, worst: WorstConstraint, proofs: Sequence[Proof], ending: str = ""
    ) -> Result:
        """Return the result with the decision of an answer, and the status that proofs, gap and bounds allow.

        Parameters
        ----------
        answer : CheckedAnswer
            The answer.
        worst : WorstConstraint
            The most violated constraint that was found.
        proofs : sequence of Proof
            Proofs at the answer.
        ending : str
            Reason for the end of the method, where it was not by its own rules.

        Returns
        -------
        Result
            The result.
        """
        x, deadline = answer.solution.x, self.tools.deadline
        status, message = verdict(proofs, self._compute_resolved_gap(x, self._price_excuses(x, proofs)), self.tolerance)
        for name, excess, limit in self._list_residuals(x, strictly=status in ("certified", "verified")):
            if excess > limit:
                status, message = "failed", f"the decision misses {name} by {excess:.1e} of what they compare; {ADVICE}"
        errors = self._bound_equality_errors(x) if status in ("certified", "verified") else None
        if errors is not None and not errors.kept:
            status, message = "undecided", errors.advice
        proven = status in ("certified", "verified") and len(proofs) == len(self.program.families)
        wrong = contradiction(worst) or alarm(self.program, self.dual, x) if proven else ""
        if wrong:
            status, message = "failed", wrong
        message = f"{message}; {ending}" if ending and status != "certified" else message
        if status == "refuted" and ending and ending == deadline.reason and not deadline.pressed:
            message = f"{message}; {more(deadline)}"
        result = self.result(status, message, answer, witness(self.program, worst, proofs))
        return replace(result, proofs=tuple(proofs), errors=errors, stopped=ending if ending == deadline.reason else "")

    def _bound_equality_errors(self, x: Array) -> EqualityErrors | None:
        """Return the proven errors of the equalities at ``x (n,)``; ``None`` where the program offers none."""
        return None if self.program.errors is None else self.program.errors(x)

    def _list_residuals(self, x: Array, strictly: bool) -> Iterator[tuple[str, float, float]]:
        """Yield the residuals of all constraints that are no family: a name, the residual at ``x (n,)``, and its limit.

        With ``strictly``, the limit is that of a claim; otherwise it is that of a decision worth returning.
        """
        finite = self.program.finite
        yield "its equalities", finite.equality_residual(x), EQUALITY if strictly else UNCLAIMED_RESIDUAL
        yield "its bounds or rows", finite.residual(x), TOLERANCE if strictly else UNCLAIMED_RESIDUAL
        yield "its bounds", _find_largest_violation(self.program, x) if strictly else 0.0, TOLERANCE

    def stopped(self, error: KeyboardInterrupt, prover: Prover) -> Result:
        """Return the result after a deadline or an interrupt: the best proven decision, or else the best so far.

        The latter has the proofs of one look at it, since a proof whose deadline has passed bounds the first cells of
        each family once.

        Parameters
        ----------
        error : KeyboardInterrupt
            The deadline or the interrupt.
        prover : Prover
            Prover of the families.

        Returns
        -------
        Result
            The result.
        """
        reason = self.tools.deadline.interrupt(error)
        if self.proven is not None:
            answer, separations, proofs = self.proven
            return self.judged(answer, worst_of(separations), proofs, reason)
        if self.best is None:
            return Result(
                status="undecided",
                message=f"{reason}, before there was a decision; {more(self.tools.deadline)}",
                lower_bound=self.lower,
                counts=self._count_work(0),
                solved_by=dict(self.relaxed.solved_by),
                dual=self.dual,
                seconds=time.perf_counter() - self.started,
                stopped=reason,
            )
        try:
            with self.tools.deadline.enforced():
                proven = prover(self.best.solution.x)
        except KeyboardInterrupt:
            meaning = MEANING["undecided"]
            proven = [Proof(family.name, "undecided", np.inf, reason=meaning) for family in self.program.families]
        proofs = include_found_violation(proven, self._separations)
        return self.judged(self.best, worst_of(self._separations), proofs, reason)

    def without(self, answer: CheckedAnswer) -> Result:
        """Return the result where the relaxed program has no usable answer.

        The status is ``infeasible`` with its reasons where that is proven, and ``failed`` otherwise.
        """
        solution = answer.solution
        if solution.status != "infeasible":
            return self.result("failed", solution.message, answer)
        from sparserob_core.sip.proof.irreducible import find_irreducible_rows

        rows, solution, shown = find_irreducible_rows(self.relaxed, answer.rows, solution)
        answer = replace(answer, rows=rows, solution=solution)
        amount = solution.infeasibility
        subsystem, worst = infeasible_subsystem(self.relaxed.program, rows, solution.y, amount, shown)
        self.dual = self.relaxed.dual(rows, solution.y, solution.mu, solution.z, amount, priced=False)
        return replace(self.result("infeasible", subsystem.sentence(), answer, worst), infeasible=subsystem)

    def salvaged(self, failed: Result) -> Result:
        """Return the result of the proven decision in place of one that ``failed``, with the reason of the failure.

        Where no decision is proven, or the result has not failed, the result itself is returned.
        """
        if failed.status != "failed" or self.proven is None:
            return failed
        answer, separations, proofs = self.proven
        return self.judged(answer, worst_of(separations), proofs, failed.message)

    def result(
        self, status: Status, message: str, answer: CheckedAnswer, worst: WorstConstraint | None = None
    ) -> Result:
        """Return a result with this answer, whose bounds are claimed as far as the status allows.

        Parameters
        ----------
        status : Status
            The status.
        message : str
            The reason for the status.
        answer : CheckedAnswer
            The answer.
        worst : WorstConstraint, optional
            The most violated constraint.

        Returns
        -------
        Result
            The result.
        """
        cuts, proven = answer.active, status in ("certified", "verified")
        decided = status not in ("infeasible", "failed")
        cost = self.program.cost(answer.solution.x) if decided else np.nan
        lower = np.inf if status == "infeasible" else self.lower
        return Result(
            status=status,
            message=message,
            decision=answer.solution.x if decided else None,
            cost=cost,
            value=answer.value,
            epsilon=answer.epsilon,
            lower_bound=min(lower, cost) if proven else lower,
            upper_bound=cost if proven else np.inf,
            cost_scale=self.program.added(answer.solution.x) if decided else 0.0,
            missed=self.program.finite.equality_residual(answer.solution.x)
            if decided and self.program.finite.b.size
            else None,
            worst=worst,
            indices=cuts,
            counts=self._count_work(len(cuts)),
            solved_by=dict(self.relaxed.solved_by),
            history=tuple(self.history),
            dual=self.dual,
            seconds=time.perf_counter() - self.started,
        )

    def _count_work(self, active: int) -> dict[str, int]:
        return {
            "relaxed_programs": self.relaxed.solves,
            "rounds": len(self.history),
            "active_indices": active,
            "solver_calls": self.relaxed.counted.calls,
        }


def _compare_cuts(before: Sequence[Cut], now: Sequence[Cut]) -> tuple[tuple[Cut, ...], tuple[Cut, ...]]:
    """Return the constraints that were added and those that were dropped."""
    cuts_before, cuts_now = (
        {(cut.family, cut.index.tobytes(), cut.row): cut for cut in cuts} for cuts in (before, now)
    )
    return tuple(cut for key, cut in cuts_now.items() if key not in cuts_before), tuple(
        cut for key, cut in cuts_before.items() if key not in cuts_now
    )


def contradiction(worst: WorstConstraint) -> str:
    """Return a message where a search has found a violation of a proven family, beyond rounding; empty otherwise."""
    if not worst.violation > CONTRADICTS * TOLERANCE:
        return ""
    return (
        f"{worst.constraint} is violated by {worst.violation:.4g} at the index {worst.index.tolist()}, though its own"
        " enclosure or separation proves that it is met: one of the two is wrong, and neither is claimed"
    )


def alarm(program: SemiInfiniteProgram, dual: Dual, x: Array) -> str:
    """Return a message where the lower bound exceeds the cost of a proven decision by more than tolerances allow.

    One of the two is then wrong. A decision that violates its rows by ``v`` may cost ``y'v`` less than the optimum, for
    the multipliers ``y`` of the bound. By weak duality, ``lower <= J(x) + y'(G x - h) + mu'(A x - b)``. The allowed
    difference is that sum, with these violations: for each proven row its tolerance; for each violated bound at most
    1e-9 of the smallest number that it compares; for fixed rows and equalities the real residuals. Rounding is added.

    Parameters
    ----------
    program : SemiInfiniteProgram
        The program.
    dual : Dual
        Multipliers of the lower bound.
    x : ndarray, shape (n,)
        The proven decision.

    Returns
    -------
    str
        The message; empty where all is well.
    """
    base, cost = program.finite, program.cost(x)
    allowed = COST_ROUNDING * base.magnitude(x)
    allowed += sum(cut.multiplier * TOLERANCE for cut in dual.cuts)
    if dual.z is not None and base.S is not None:
        violations, rounding = _measure_bound_violations(base, x)
        allowed += float(
            np.abs(dual.z) @ np.minimum(violations, TOLERANCE * _choose_units(base.lower, base.upper) + rounding)
        )
    allowed += _price_residuals(base, dual, x)
    if dual.bound - cost <= allowed:
        return ""
    unit = program.cost_unit
    return (
        f"the lower bound {dual.bound * unit:.12g} is above the cost {cost * unit:.12g} of a decision that was proven,"
        f" by more than the {allowed * unit:.1e} that the tolerances of the proofs allow: one of the two is wrong, and"
        f" neither is claimed; {ADVICE}"
    )


def _price_residuals(base: FiniteProgram, dual: Dual, x: Array) -> float:
    """Return what the residuals of fixed rows and equalities at ``x (n,)`` are worth, by their multipliers."""
    price = 0.0
    if dual.mu.size:
        price += float(np.abs(dual.mu) @ np.abs(base.A @ x - base.b))
    if dual.fixed.size:
        price += float(dual.fixed @ np.maximum(base.G @ x - base.h, 0.0))
    return price


def _measure_bound_violations(base: FiniteProgram, x: Array) -> tuple[Array, Array]:
    """Return the amounts ``(k,)`` by which the image of ``x (n,)`` violates its bounds, and their rounding errors
    ``(k,)``."""
    image, terms = base.image(x), np.abs(x) if base.S is None else abs(base.S) @ np.abs(x)
    return np.maximum(np.maximum(base.lower - image, image - base.upper), 0.0), COST_ROUNDING * terms


def _find_largest_violation(program: SemiInfiniteProgram, x: Array) -> float:
    """Return the largest violation of a bound by the image of ``x (n,)``, in the bound's own unit, less rounding."""
    violations, rounding = _measure_bound_violations(program.finite, x)
    units = _choose_units(program.finite.lower, program.finite.upper)
    shares = np.maximum(violations - rounding, 0.0) / np.where(units > 0.0, units, 1.0)
    return float(shares.max(initial=0.0))


def _choose_units(lower: Array, upper: Array) -> Array:
    """Return the units ``(k,)`` of bounds; 0 where there is none.

    The unit is the smallest number that is not 0 among the sizes of the two bounds and their distance (decision 16).
    """
    with np.errstate(invalid="ignore"):
        sizes = np.abs(np.stack([lower, upper, upper - lower]))
    units = np.where(np.isfinite(sizes) & (sizes > 0.0), sizes, np.inf).min(axis=0)
    return np.where(np.isfinite(units), units, 0.0)


def select_violated(family: ConstraintFamily, found: Separation) -> tuple[Array, np.ndarray, str]:
    """Return the violations of a family that are more than the search may leave to the proof.

    Parameters
    ----------
    family : ConstraintFamily
        The family.
    found : Separation
        Its most violated constraints.

    Returns
    -------
    indices : ndarray, shape (k, d)
        Indices of the violated constraints.
    rows : ndarray of int, shape (k,)
        Their rows.
    name : str
        Name of the family.
    """
    violated = found.violations > SEARCH_TOLERANCE
    return found.indices[violated], found.rows[violated], family.name


def list_violated(found: Found) -> Violated:
    """Return all constraints that a search has found to be violated, by however little."""
    return [
        (separation.indices[separation.violations > 0.0], separation.rows[separation.violations > 0.0], family.name)
        for family, separation in found
    ]


def witnesses(program: SemiInfiniteProgram, proofs: Sequence[Proof]) -> Violated:
    """Return the violated constraints that proofs have found, as constraints to impose."""
    return [
        (proof.index[None], np.array([proof.row]), proof.family)
        for proof in proofs
        if proof.verdict == "refuted"
        and proof.index is not None
        and proof.formulation == program.family(proof.family).formulation
    ]
