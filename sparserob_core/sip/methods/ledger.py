"""The accounts of a method: the best lower bound, the rounds that were told, and what may be claimed at the end.

A proven decision comes first: one that keeps away from the constraints, so that there is an upper bound while a better
one is sought and proven. Any exchange can have one that says how its imposed rows are solved when they are tightened by
more (`Tightening`).
"""

from __future__ import annotations

import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from typing import NamedTuple, Protocol, TypeAlias

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
    SemiInfiniteProgram,
    Separation,
    WorstConstraint,
)
from sparserob_core.sip.proof.branch_and_bound import CELLS, prove
from sparserob_core.sip.proof.verdict import as_bad_as_found, infeasible_subsystem, verdict, witness, worst_of
from sparserob_core.sip.relaxed.relaxed import RelaxedProgram, Rows
from sparserob_core.sip.result import MEANING, Result, Status, relative_gap
from sparserob_core.sip.separation.separation import separate

ROUNDING = 1e-13  # of the terms of a cost, with which it is evaluated
CRUDE = 1e-8  # of bounds, rows and equalities, relative to their scale, at a decision of which nothing is claimed
THINNER = 1e-3  # share of a margin that leaves nothing feasible, which is tried next
ALLOWED = TOLERANCE / 2  # a violation that the search may leave to the proof
# Cells for the first look at a decision. With a tenth of them, decisions of ordinary problems with parameters are
# secured that are proven at once; with ten times as many, who rides a wall waits ten times longer for a first bound.
GLANCE = 4096
DUE = (0.4, 0.65, 0.85)  # shares of a limit after which a decision is secured, where none is proven yet
# Rounds as long as the longest so far that must be left when a decision is secured: one to tighten and separate, one to
# prove, one to try again. With a third of them there is time for no proof; with ten times as many nothing has been
# imposed by then.
RESERVED = 3
# The first round after which a decision is secured though nothing limits the time, and again after twice as many: for
# who interrupts. Ordinary problems end before; with ten times as many a minute's search leaves nothing proven.
PATIENT = 8
# Rounds of that at most, of which each imposes what is violated or is at least twice as far away as the last. With a
# third of them a wall of a hundred pieces is not yet imposed; ten times as many are a search of their own.
SECURED = 10
# Of the cost, what the distance may cost at first. A tenth of it takes three times as many cells along a wall that is
# ridden; ten times as much is a bound that nobody is content with.
SPARED = 1e-3
# Of the cost, up to which a violation that can be imposed is kept away from besides. With a tenth of it a wall between
# two imposed times takes two rounds more; with all of the cost, what is far from feasible leaves nothing to choose.
DEAR = 0.1
PAID = 2.0  # of what is left open, what the rows are tightened by: half of it is for what the new optimum violates

Violated: TypeAlias = Sequence[tuple[Array, np.ndarray, str]]  # indices (k, d), rows (k,) and the name of a family


class Prover(Protocol):
    """What is proven of a decision ``x (n,)`` with at most ``cells`` cells for every family."""

    def __call__(self, x: Array, cells: int = CELLS) -> Sequence[Proof]: ...


Found: TypeAlias = Sequence[tuple[ConstraintFamily, Separation]]


def unproven(x: Array, cells: int = CELLS) -> Sequence[Proof]:
    """The prover of a program of which only the bounds are wanted."""
    return ()


def prover_of(program: SemiInfiniteProgram, tools: Tools) -> Prover:
    """The prover of every family of a program, which tells how it goes on and ends at the deadline of the tools."""

    def prover(x: Array, cells: int = CELLS) -> Sequence[Proof]:
        return prove(program, x, tools.notify, cells, tools.deadline)

    return prover


@dataclass(frozen=True, eq=False)
class Answer:
    """An answer to a relaxed program: the checked ``solution``, the ``rows`` that were imposed, and the weight
    ``epsilon`` of the regulariser. ``value``: of the relaxed program, where it is not that of the solution."""

    solution: FiniteSolution
    rows: Rows
    epsilon: float
    value: float

    @property
    def multipliers(self) -> Array:
        """The multipliers ``(r,)`` of the imposed rows; zeros where the solution has none."""
        count, y = self.rows.h.size, self.solution.y
        return y[y.size - count :] if y.size >= count else np.zeros(count)

    @property
    def active(self) -> tuple[Cut, ...]:
        """The imposed constraints that carry a multiplier, with it."""
        pairs = zip(self.rows.cuts, self.multipliers, strict=True)
        return tuple(replace(cut, multiplier=float(m)) for cut, m in pairs if m > 0.0)


@dataclass(eq=False)
class Ledger:
    """What a method has learned of ``program``: ``dual``, the multipliers of the best lower bound; ``history``, the
    rounds told; ``best``, the last answer that no search refuted, or else the last one; ``proven``, the cheapest answer
    of which every family is proven, with the proofs, where there is one.

    ``tolerance``: the relative gap at which the bounds have met.
    """

    program: SemiInfiniteProgram
    relaxed: RelaxedProgram
    tools: Tools
    tolerance: float
    started: float = field(default_factory=time.perf_counter)
    dual: Dual = NO_BOUND
    history: list[RoundFinished] = field(default_factory=list)
    best: Answer | None = None
    proven: tuple[Answer, Found, Sequence[Proof]] | None = None
    _found: Found = ()
    _suggested: bool = False

    @property
    def lower(self) -> float:
        """The best lower bound proven so far."""
        return self.dual.bound

    def improve(self, dual: Dual) -> None:
        """Keep the better of two lower bounds."""
        self.dual = max(self.dual, dual, key=lambda one: one.bound)

    def open(self, x: Array) -> bool:
        """Whether the gap between the lower bound and the cost of ``x (n,)`` is open."""
        return self.gap(x) > self.tolerance

    def gap(self, x: Array) -> float:
        """The relative gap of the lower bound to the cost of ``x (n,)``."""
        return relative_gap(self.lower, self.program.cost(x), self.program.added(x))

    def tell(self, number: int, answer: Answer, found: Found, upper: float, kept: int) -> None:
        """Tell of a round: its answer, what was found most violated at it, an upper bound that it suggests, and how
        many rows were kept."""
        worst, x = worst_of(found), answer.solution.x
        added, dropped = _change(self.history[-1].imposed if self.history else (), answer.rows.cuts)
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
            separations={family.name: one for family, one in found},
            imposed=answer.rows.cuts,
            multipliers=frozen(answer.multipliers),
            added=added,
            dropped=dropped,
            gap=self.gap(x) if np.isfinite(upper) else np.inf,
            proven=np.inf if self.proven is None else self.program.cost(self.proven[0].solution.x),
        )
        self.history.append(event)
        if np.isfinite(upper) or not self._suggested:
            self.keep(answer, found)
            self._suggested = bool(np.isfinite(upper))
        self.tools.notify(event)

    def keep(self, answer: Answer, found: Found = ()) -> None:
        """The answer to return should the method be stopped now, with what was found most violated at it."""
        self.best, self._found = answer, found

    def prove(self, answer: Answer, found: Found, proofs: Sequence[Proof]) -> bool:
        """Keep an answer that these proofs show to be feasible, if it is the cheapest so far; ``False`` where they do
        not show that."""
        if len(proofs) != len(self.program.families) or any(proof.verdict != "proven" for proof in proofs):
            return False
        x = answer.solution.x
        if any(missed > most for _, missed, most in self._fixed(x, strictly=True)):
            return False
        if self.proven is None or self.program.cost(x) < self.program.cost(self.proven[0].solution.x):
            self.proven = answer, found, proofs
        return True

    def judged(self, answer: Answer, worst: WorstConstraint, proofs: Sequence[Proof], ending: str = "") -> Result:
        """The result with the decision of ``answer``: what the proofs, the gap and the comparison of the bounds allow.
        ``ending``: why the method came to an end, where it was not by its own rules."""
        x = answer.solution.x
        status, message = verdict(proofs, self.gap(x), self.tolerance)
        for what, missed, most in self._fixed(x, strictly=status in ("certified", "verified")):
            if missed > most:
                status, message = "failed", f"the decision misses {what} by {missed:.1e} of what they compare; {ADVICE}"
        proven = status in ("certified", "verified") and len(proofs) == len(self.program.families)
        wrong = alarm(self.program, self.dual, x) if proven else ""
        if wrong:
            status, message = "failed", wrong
        message = f"{message}; {ending}" if ending and status != "certified" else message
        result = self.result(status, message, answer, witness(self.program, worst, proofs))
        return replace(result, proofs=tuple(proofs), stopped=ending if ending == self.tools.deadline.reason else "")

    def _fixed(self, x: Array, strictly: bool) -> Iterator[tuple[str, float, float]]:
        """What is no family: a name, by how much ``x (n,)`` misses it, and by how much it may. ``strictly``: as much as
        a claim allows, else what a decision may that is worth returning."""
        finite = self.program.finite
        yield "its equalities", finite.missed(x), EQUALITY if strictly else CRUDE
        yield "its bounds or rows", finite.residual(x), TOLERANCE if strictly else CRUDE
        yield "its bounds", _beyond(self.program, x) if strictly else 0.0, TOLERANCE

    def stopped(self, error: KeyboardInterrupt, prover: Prover) -> Result:
        """The result where time is over or a key was pressed: the best decision that was proven, or else the best so
        far, with what one look at it proves (a proof whose deadline has passed looks at every family once)."""
        reason = self.tools.deadline.interrupt(error)
        if self.proven is not None:
            answer, found, proofs = self.proven
            return self.judged(answer, worst_of(found), proofs, reason)
        if self.best is None:
            return Result(
                status="undecided",
                message=f"{reason}, before there was a decision; more seconds (limits.seconds) would help",
                lower_bound=self.lower,
                counts=self._counts(0),
                solved_by=dict(self.relaxed.solved_by),
                dual=self.dual,
                seconds=time.perf_counter() - self.started,
                stopped=reason,
            )
        try:
            with self.tools.deadline.enforced():
                proven = prover(self.best.solution.x)
        except KeyboardInterrupt:
            said = MEANING["undecided"]
            proven = [Proof(family.name, "undecided", np.inf, reason=said) for family in self.program.families]
        proofs = as_bad_as_found(proven, self._found)
        return self.judged(self.best, worst_of(self._found), proofs, reason)

    def without(self, answer: Answer) -> Result:
        """The result where the relaxed program has no usable answer: ``infeasible`` with the reason where that is
        proven, else ``failed``."""
        solution = answer.solution
        if solution.status != "infeasible":
            return self.result("failed", solution.message, answer)
        from sparserob_core.sip.proof.irreducible import irreducible

        rows, solution = irreducible(self.relaxed, answer.rows, solution)
        answer = replace(answer, rows=rows, solution=solution)
        found, worst = infeasible_subsystem(self.relaxed.program, rows, solution.y, solution.infeasibility)
        self.dual = self.relaxed.dual(rows, solution.y, solution.mu, solution.z, solution.infeasibility, priced=False)
        return replace(self.result("infeasible", found.sentence(), answer, worst), infeasible=found)

    def salvaged(self, failed: Result) -> Result:
        """The result of the decision that is proven, with what it ``failed`` for, where a relaxed program was not
        solved after there was one; else the result itself."""
        if failed.status != "failed" or self.proven is None:
            return failed
        answer, found, proofs = self.proven
        return self.judged(answer, worst_of(found), proofs, failed.message)

    def result(self, status: Status, message: str, answer: Answer, worst: WorstConstraint | None = None) -> Result:
        """A result with this answer; the bounds are claimed as far as the status allows."""
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
            missed=self.program.finite.missed(answer.solution.x) if decided and self.program.finite.b.size else None,
            worst=worst,
            indices=cuts,
            counts=self._counts(len(cuts)),
            solved_by=dict(self.relaxed.solved_by),
            history=tuple(self.history),
            dual=self.dual,
            seconds=time.perf_counter() - self.started,
        )

    def _counts(self, active: int) -> dict[str, int]:
        return {
            "relaxed_programs": self.relaxed.solves,
            "rounds": len(self.history),
            "active_indices": active,
            "solver_calls": self.relaxed.counted.calls,
        }


def _change(before: Sequence[Cut], now: Sequence[Cut]) -> tuple[tuple[Cut, ...], tuple[Cut, ...]]:
    """The constraints that were added and those that were dropped."""
    old, new = ({(cut.family, cut.index.tobytes(), cut.row): cut for cut in cuts} for cuts in (before, now))
    return tuple(cut for key, cut in new.items() if key not in old), tuple(
        cut for key, cut in old.items() if key not in new
    )


def alarm(program: SemiInfiniteProgram, dual: Dual, x: Array) -> str:
    """Words where the lower bound is above the cost of a proven decision ``x (n,)`` by more than the tolerances of the
    proofs allow: then one of the two is wrong. Empty where all is well.

    A decision that violates its rows by ``v`` may cost ``y'v`` less than the optimum, for the multipliers ``y`` of
    the bound: by weak duality ``lower <= J(x) + y'(G x - h) + mu'(A x - b)``. What is allowed is that sum with the
    tolerance of each proven row in place of its violation, that of each bound (1e-9 of the smallest number that it
    compares) where it is missed, with the real residuals of the fixed rows and equalities, and rounding.
    """
    base, cost = program.finite, program.cost(x)
    allowed = ROUNDING * base.magnitude(x)
    allowed += sum(cut.multiplier * TOLERANCE for cut in dual.cuts)
    if dual.z is not None and base.S is not None:
        missed, rounding = _missed(base, x)
        allowed += float(np.abs(dual.z) @ np.minimum(missed, TOLERANCE * _units(base.lower, base.upper) + rounding))
    if dual.mu.size:
        allowed += float(np.abs(dual.mu) @ np.abs(base.A @ x - base.b))
    if dual.fixed.size:
        allowed += float(dual.fixed @ np.maximum(base.G @ x - base.h, 0.0))
    if dual.bound - cost <= allowed:
        return ""
    unit = program.cost_unit
    return (
        f"the lower bound {dual.bound * unit:.12g} is above the cost {cost * unit:.12g} of a decision that was proven,"
        f" by more than the {allowed * unit:.1e} that the tolerances of the proofs allow: one of the two is wrong, and"
        f" neither is claimed; {ADVICE}"
    )


def _missed(base: FiniteProgram, x: Array) -> tuple[Array, Array]:
    """By how much the image of ``x (n,)`` misses its bounds ``(k,)``, and what is rounding of that."""
    image, terms = base.image(x), np.abs(x) if base.S is None else abs(base.S) @ np.abs(x)
    return np.maximum(np.maximum(base.lower - image, image - base.upper), 0.0), ROUNDING * terms


def _beyond(program: SemiInfiniteProgram, x: Array) -> float:
    """The largest miss of a bound by the image of ``x (n,)``, in the bound's own unit, less rounding."""
    missed, rounding = _missed(program.finite, x)
    units = _units(program.finite.lower, program.finite.upper)
    shares = np.maximum(missed - rounding, 0.0) / np.where(units > 0.0, units, 1.0)
    return float(shares.max(initial=0.0))


def _units(lower: Array, upper: Array) -> Array:
    """The units ``(k,)`` of bounds: the smallest of their sizes and of the width between them that is not 0 (decision
    16); 0 where there is none."""
    with np.errstate(invalid="ignore"):
        sizes = np.abs(np.stack([lower, upper, upper - lower]))
    units = np.where(np.isfinite(sizes) & (sizes > 0.0), sizes, np.inf).min(axis=0)
    return np.where(np.isfinite(units), units, 0.0)


class Missed(NamedTuple):
    """The largest violation of a family that was met, or that is not excluded, and its index ``(1, d)`` and row
    ``(1,)``."""

    violation: float
    family: str
    at: Array
    row: np.ndarray


class Tightening(Protocol):
    """Imposed rows that are tightened by a ``margin``; ``secured``: how often a share of a limit has asked that a
    decision be secured."""

    margin: float
    secured: int

    def priced(self, answer: Answer) -> float:
        """What the cost of an answer grows by when all rows are tightened by 1, to first order."""

    @property
    def longest(self) -> float:
        """By how much the row that changes most is moved by a margin of 1."""

    def distance(self, missed: Missed) -> float:
        """The margin that makes good what was missed."""

    def impose(self, violated: Violated) -> int:
        """Impose constraints; how many were new."""

    def tightened(self, ledger: Ledger, answer: Answer, margin: float) -> Answer | None:
        """The optimum of the imposed rows, tightened by so much; ``None`` where there is none. ``answer``: where they
        are tightened less."""


def proofs_of(
    tightening: Tightening, ledger: Ledger, prover: Prover, answer: Answer, found: Found
) -> tuple[Sequence[Proof], bool]:
    """What is proven of an answer: by one glance where that will do, else by a proof in full, before which there is a
    decision that is proven; and whether constraints were imposed for that."""
    x = answer.solution.x
    proofs = prover(x, GLANCE // 4 if ledger.tools.deadline.bounded else GLANCE)
    if ledger.prove(answer, found, proofs) or not proofs:
        return proofs, False
    missed, imposed = _left_open(ledger.program, proofs), False
    searched = any(above(*one)[1].size for one in _rows(found))  # then the rounds are used up, and this would be more
    if missed and not searched and not _is_secured(ledger):
        imposed = _secure(tightening, ledger, prover, answer, missed, witnesses(ledger.program, proofs))
    # Where there are no cells, another look would be the same one.
    if any(proof.cells for proof in proofs) and not any(proof.verdict == "refuted" for proof in proofs):
        proofs = prover(x)
        ledger.prove(answer, found, proofs)
    return proofs, imposed


def secure_in_time(
    tightening: Tightening, ledger: Ledger, prover: Prover, answer: Answer, found: Found, number: int
) -> bool:
    """Secure a decision when time is due, though that of round ``number`` violates what was ``found``: where there is a
    limit, as soon as little would pay for that, at certain shares of it, and when no more is left of it than that may
    take; without a limit after some rounds. Whether constraints were imposed."""
    deadline, began = ledger.tools.deadline, [event.seconds for event in ledger.history]
    missed, violated = [_peak(family, one) for family, one in _rows(found)], [above(*one) for one in _rows(found)]
    if deadline.left is None:
        due = number >= PATIENT and number & (number - 1) == 0
    else:
        near = tightening.secured == 0 and _is_near(tightening, ledger.program, answer, missed)
        due = near or (tightening.secured < len(DUE) and deadline.used >= DUE[tightening.secured])
        tightening.secured += due
        longest = max(np.diff(began, prepend=0.0), default=0.0)
        due = due or (ledger.proven is None and deadline.left <= RESERVED * longest)
    if not due or _is_secured(ledger):
        return False
    if not any(rows.size for _, rows, _ in violated):  # it may be proven as it is, and solving takes longer
        ledger.prove(answer, found, prover(answer.solution.x, GLANCE // 4))
        if ledger.proven is not None:
            return False
    return _secure(tightening, ledger, prover, answer, missed, violated)


def or_proven(ledger: Ledger, result: Result) -> Result:
    """The result, or that of the decision that is proven where the result is not."""
    if result.status not in ("refuted", "undecided") or ledger.proven is None:
        return result
    secured, found, proofs = ledger.proven
    return ledger.judged(secured, worst_of(found), proofs, ledger.tools.deadline.reason)


def above(family: ConstraintFamily, found: Separation) -> tuple[Array, np.ndarray, str]:
    """The indices, rows and family of what is violated by more than the search may leave to the proof."""
    violated = found.violations > ALLOWED
    return found.indices[violated], found.rows[violated], family.name


def witnesses(program: SemiInfiniteProgram, proofs: Sequence[Proof]) -> Violated:
    """What proofs have met that is violated, as constraints to impose."""
    return [
        (proof.index[None], np.array([proof.row]), proof.family)
        for proof in proofs
        if proof.verdict == "refuted"
        and proof.index is not None
        and proof.formulation == program.family(proof.family).formulation
    ]


def _secure(
    tightening: Tightening,
    ledger: Ledger,
    prover: Prover,
    answer: Answer,
    missed: Sequence[Missed],
    violated: Violated,
) -> bool:
    """Prove a decision that keeps away from the constraints, so that there is an upper bound while the proof of a
    better one goes on: the optimum of the imposed rows and of those that are ``violated``, all of them tightened by as
    much as `SPARED` of the cost of ``answer`` pays for and by more than what it ``missed``, and again by what that
    proof leaves open. What it missed is kept away from only as long as something is that far away, and what is imposed
    for it not for ever. Nothing is claimed where nothing keeps away at all. Whether anything was imposed.
    """
    program, margin, imposed = ledger.program, tightening.margin, 0
    for _ in range(SECURED):
        cost, price = abs(program.cost(answer.solution.x)), tightening.priced(answer)
        fresh = tightening.impose(violated)
        imposed += fresh
        more = PAID * max((tightening.distance(one) for one in missed), default=0.0)
        margin = max(margin, tightening.margin + (SPARED * cost / price if price > 0.0 else 0.0))
        margin += 0.0 if fresh else more
        more = more if fresh and more * price < DEAR * cost else 0.0
        if not np.isfinite(PAID * float(margin + more) * tightening.longest):  # in Python's numbers, which overflow
            break
        farther = tightening.tightened(ledger, answer, margin + more)
        if farther is None and more:  # nothing is that far away, but what was imposed may do
            farther = tightening.tightened(ledger, answer, margin)
        if farther is None:
            break
        answer = farther
        x = farther.solution.x
        looked = separate(program, x, ledger.tools, ALLOWED, max(1, len(ledger.history)))
        found = [
            (family, one) for family, one in looked if not family.defines and one.violations.max(initial=0.0) > ALLOWED
        ]
        missed, violated = [_peak(*one) for one in found], [above(*one) for one in found]
        if missed:
            continue
        proofs = prover(x, GLANCE)
        if ledger.prove(farther, looked, proofs) or not proofs:
            break
        missed, violated = _left_open(program, proofs), witnesses(program, proofs)
        if not missed:
            break
    return imposed > 0


def _is_near(tightening: Tightening, program: SemiInfiniteProgram, answer: Answer, missed: Sequence[Missed]) -> bool:
    """Whether to keep away from the constraints by more than an answer ``missed`` costs no more than what a decision is
    secured for in any case. A round may take longer than all before it, so such an answer is not let go."""
    distance, price = max((tightening.distance(one) for one in missed), default=0.0), tightening.priced(answer)
    if distance > 0.0 and not price > 0.0:  # no row has a multiplier, which says nothing of those that are missed
        return False
    return PAID * distance * price <= SPARED * abs(program.cost(answer.solution.x))


def _is_secured(ledger: Ledger) -> bool:
    """Whether a decision is proven that costs little more than what such a one must."""
    return ledger.proven is not None and ledger.gap(ledger.proven[0].solution.x) <= PAID * SPARED


def _rows(found: Found) -> Found:
    """What was found of families that constrain; what others define is settled, not violated."""
    return [(family, separation) for family, separation in found if not family.defines]


def _peak(family: ConstraintFamily, separation: Separation) -> Missed:
    """The largest violation that was found of a family."""
    largest = max(0.0, float(separation.violations[0]))
    return Missed(largest, family.name, separation.indices[:1], separation.rows[:1])


def _left_open(program: SemiInfiniteProgram, proofs: Sequence[Proof]) -> list[Missed]:
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
