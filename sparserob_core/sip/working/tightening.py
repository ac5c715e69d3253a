"""A proven decision early: a decision with a margin to the constraints, which gives an upper bound.

A better decision is sought and proven meanwhile. The rules are the same for all working sets. A working set defines how
its rows are solved with a larger margin.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from sparserob_core.sip.convex_set import Array
from sparserob_core.sip.evidence import Proof
from sparserob_core.sip.program import SemiInfiniteProgram
from sparserob_core.sip.proof.verdict import worst_of
from sparserob_core.sip.result import Result
from sparserob_core.sip.separation.separation import separate
from sparserob_core.sip.working.ledger import (
    SEARCH_TOLERANCE,
    CheckedAnswer,
    Found,
    Ledger,
    Prover,
    Violated,
    select_violated,
    witnesses,
)
from sparserob_core.sip.working.working import LargestViolation, Working, collect_open_violations

# Number of cells of a short proof. With a tenth, ordinary problems with parameters need a tightened decision although a
# proof is quick; with ten times as many, a first upper bound along a constraint takes ten times longer.
GLANCE = 4096
# Factor of that number, where no decision has the margin that a short proof requires. With a quarter of it, directions
# in four dimensions are left open; with ten times as much, a proof takes a minute where a cell is costly.
CLOSER = 16
DUE = (0.4, 0.65, 0.85)  # shares of a limit after which a tightened decision is due, where none is proven yet
# Number of rounds, each as long as the longest so far, that must be left when a decision is tightened: one to tighten
# and separate, one to prove, one to try again. With a third of them there is no time for a proof; with ten times as
# many, nothing has been imposed by then.
ROUNDS_LEFT = 3
# First round after which a decision is tightened without a limit of time, and again after twice as many rounds, for a
# user who interrupts. Ordinary problems end before; with ten times as many, a search of a minute leaves nothing proven.
FIRST_TIGHTENED_ROUND = 8
# Largest number of rounds of tightening. Each imposes violated constraints, or has at least twice the margin of the one
# before. With a third of them, a constraint that is active on a hundred pieces is not yet imposed; ten times as many
# are a search of their own.
MAX_TIGHTENINGS = 10
# Share of the cost that the first margin may cost. With a tenth of it, a proof along an active constraint takes three
# times as many cells; with ten times as much, the upper bound is of no use.
SPARED = 1e-3
# Share of the cost that the margin for a violation that can be imposed may cost in addition, and that is paid where a
# smaller margin needs too many cells. With a tenth of it, a constraint that is active between two imposed times takes
# two rounds more, and one in four dimensions with a parameter more than twice the cells. With all of the cost, nothing
# remains to choose at decisions far from feasible.
LARGE_CELLS_COST_SHARE = 0.1
# Factor of the share that is tried next where the first margin is infeasible, as long as it is more than the tolerated
# gap. With a tenth of it there is no second share; with ten times as much, four programs are solved in vain where every
# margin is infeasible.
SMALLER_SHARE_FACTOR = 0.01
# Factor of the larger margin that is tried next where it is infeasible. With a tenth of it, a margin is missing that
# takes a tenth of the cells; with nine tenths of it, a program is solved for every tenth.
NEARER = 0.25
PAID = 2.0  # ratio of a margin to what is left open: half of it is for what the new optimum violates


def proofs_of(
    working: Working, ledger: Ledger, prover: Prover, answer: CheckedAnswer, found: Found
) -> tuple[Sequence[Proof], bool]:
    """Return what is proven of an answer, and whether constraints were imposed for that.

    A short proof is tried first. Where it does not suffice, a tightened decision is proven, and then the answer with
    all cells.

    Parameters
    ----------
    working : Working
        The working set.
    ledger : Ledger
        Accounts of the method.
    prover : Prover
        Prover of the families.
    answer : CheckedAnswer
        Answer to the relaxed program.
    found : Found
        Most violated constraints of each family at the answer.

    Returns
    -------
    proofs : sequence of Proof
        Proofs at the answer.
    imposed : bool
        Whether constraints were imposed.
    """
    x = answer.solution.x
    proofs = prover(x, GLANCE // 4 if ledger.tools.deadline.bounded else GLANCE)
    if ledger.prove(answer, found, proofs) or not proofs:
        return proofs, False
    violations, imposed = collect_open_violations(ledger.program, proofs), False
    is_violated = any(
        select_violated(*pair)[1].size for pair in found
    )  # then the rounds are used up, and no more may follow
    if violations and not is_violated and not _is_proven_cheaply(ledger):
        imposed = _tighten(working, ledger, prover, answer, violations, witnesses(ledger.program, proofs))
    # Without cells, another proof would be the same one.
    if any(proof.cells for proof in proofs) and not any(proof.verdict == "refuted" for proof in proofs):
        proofs = prover(x)
        ledger.prove(answer, found, proofs)
    return proofs, imposed


def tighten_in_time(
    working: Working, ledger: Ledger, prover: Prover, answer: CheckedAnswer, found: Found, number: int
) -> bool:
    """Prove a tightened decision when it is due, even if the decision of this round is violated.

    The decision is due as soon as its margin costs little. With a limit, the decision is also due at certain shares of
    the limit, and when the time left is only just enough. Without a limit, the decision is also due after certain
    rounds.

    Parameters
    ----------
    working : Working
        The working set.
    ledger : Ledger
        Accounts of the method.
    prover : Prover
        Prover of the families.
    answer : CheckedAnswer
        Answer to the relaxed program.
    found : Found
        Most violated constraints of each family at the answer.
    number : int
        Number of the round.

    Returns
    -------
    bool
        Whether constraints were imposed.
    """
    if not all(family.provable for family in ledger.program.families):
        return False
    deadline, round_times = ledger.tools.deadline, [event.seconds for event in ledger.history]
    candidate = working.candidate(answer) if number & (number - 1) == 0 else None  # 1, 2, 4, 8, ...
    if candidate is not None and ledger.cheaper(candidate):
        x = candidate.solution.x
        ledger.prove(candidate, separate(ledger.program, x, ledger.tools, SEARCH_TOLERANCE), prover(x, GLANCE))
    violations, violated = [LargestViolation.of(*pair) for pair in found], [select_violated(*pair) for pair in found]
    is_near = working.due_count == 0
    if deadline.left is None:  # with nothing left to impose, the proof of this decision follows at once
        is_near = is_near and (ledger.open(answer.solution.x) or any(rows.size for _, rows, _ in violated))
    is_near = is_near and _is_near(working, ledger.program, answer, violations)
    if deadline.left is None:
        working.due_count += is_near
        is_due = is_near or (number >= FIRST_TIGHTENED_ROUND and number & (number - 1) == 0)
    else:
        is_due = is_near or (working.due_count < len(DUE) and deadline.used >= DUE[working.due_count])
        working.due_count += is_due
        longest = max(np.diff(round_times, prepend=0.0), default=0.0)
        is_due = is_due or (ledger.proven is None and deadline.left <= ROUNDS_LEFT * longest)
    if not is_due or _is_proven_cheaply(ledger):
        return False
    if not any(rows.size for _, rows, _ in violated):  # the answer may be proven as it is, which takes less time
        ledger.prove(answer, found, prover(answer.solution.x, GLANCE // 4))
        if ledger.proven is not None:
            return False
    return _tighten(working, ledger, prover, answer, violations, violated)


def back_off(working: Working, ledger: Ledger, prover: Prover, answer: CheckedAnswer, found: Found) -> None:
    """Prove the answer of a search, or a tightened decision near it.

    The tightened decision is tried where the answer violates the constraints so little that the margin costs no more
    than `SPARED` of the cost. An answer with larger violations is left as it is, since a decision far from it is not
    the result of the search. The lower bound of the ledger stays that of the search: the constraints imposed here do
    not enter it.

    Parameters
    ----------
    working : Working
        The working set.
    ledger : Ledger
        Accounts of the method.
    prover : Prover
        Prover of the families.
    answer : CheckedAnswer
        Answer of the search.
    found : Found
        Most violated constraints of each family at the answer.
    """
    x, program = answer.solution.x, ledger.program
    violations = [LargestViolation.of(*pair) for pair in found if not pair[0].defines]
    violated: Violated = [select_violated(*pair) for pair in found]
    if not ledger.cheaper(answer) or not _is_near(working, program, answer, violations):
        return
    if not any(rows.size for _, rows, _ in violated):
        proofs = prover(x, GLANCE)
        if ledger.prove(answer, found, proofs):
            return
        violations, violated = collect_open_violations(program, proofs), witnesses(program, proofs)
        if not violations or not _is_near(working, program, answer, violations):
            return
    trial_ledger = replace(ledger)
    _tighten(working, trial_ledger, prover, answer, violations, violated, ledger.tolerance)
    if trial_ledger.proven is not None and trial_ledger.proven is not ledger.proven:
        proven_answer, separations, proofs = trial_ledger.proven
        ledger.prove(replace(proven_answer, value=answer.value), separations, proofs)


def prefer_proven(ledger: Ledger, result: Result) -> Result:
    """Return the result, or that of the proven decision where the result is not proven."""
    if result.status not in ("refuted", "undecided") or ledger.proven is None:
        return result
    proven_answer, separations, proofs = ledger.proven
    reason = ledger.tools.deadline.reason or f"of a decision that costs less it is not proven: {result.message}"
    return ledger.judged(proven_answer, worst_of(separations), proofs, reason)


def _tighten(
    working: Working,
    ledger: Ledger,
    prover: Prover,
    answer: CheckedAnswer,
    violations: Sequence[LargestViolation],
    violated: Violated,
    spared: float = SPARED,
) -> bool:
    """Prove a tightened decision, so that there is an upper bound while the proof of a better one continues.

    The decision is the optimum of the imposed and the ``violated`` rows. The first margin is what the share ``spared``
    of the cost pays for, plus twice the largest violation of the answer. Later margins add twice what the proof leaves
    open. An addition is temporary where new constraints were imposed for it, and is omitted where it makes the program
    infeasible. Where even the first margin makes it infeasible, a hundredth of ``spared`` is tried. Where only the
    margin that large cells require makes it infeasible, smaller cells are used, with a margin that costs
    `LARGE_CELLS_COST_SHARE` of the cost or a part of it. Nothing is proven where every margin makes the program
    infeasible.

    Parameters
    ----------
    working : Working
        The working set.
    ledger : Ledger
        Accounts of the method.
    prover : Prover
        Prover of the families.
    answer : CheckedAnswer
        Answer to the relaxed program.
    violations : sequence of LargestViolation
        Largest violations at the answer, found or not excluded.
    violated : Violated
        Constraints to impose.
    spared : float, default SPARED
        Share of the cost that the first margin may cost.

    Returns
    -------
    bool
        Whether constraints were imposed.
    """
    program, margin, imposed = ledger.program, working.margin, 0
    kept: tuple[CheckedAnswer, Found] | None = None  # a short proof left cells open, and no search finds a violation
    cells, dear_margin = GLANCE, _compute_dear_margin(abs(program.cost(answer.solution.x)), working.priced(answer))
    for _ in range(MAX_TIGHTENINGS):
        cost, price = abs(program.cost(answer.solution.x)), working.priced(answer)
        fresh = working.impose(violated)
        imposed += fresh
        addition = PAID * max((working.distance(violation) for violation in violations), default=0.0)
        margin = max(margin, working.margin + (spared * cost / price if price > 0.0 else 0.0))
        margin += 0.0 if fresh else addition
        addition = addition if fresh and addition * price < LARGE_CELLS_COST_SHARE * cost else 0.0
        tighter = _solve_tightened(working, ledger, answer, margin, addition)
        if tighter is None and kept is not None:  # no margin as large cells require: smaller cells, a margin that costs
            if dear_margin * price <= PAID * spared * cost:
                break
            cells, margin, violations, dear_margin = (
                CLOSER * GLANCE,
                working.margin + dear_margin,
                (),
                NEARER * dear_margin,
            )
            continue
        if tighter is None:  # no such margin, for example where two constraints are close to each other
            margin, spared, violations = working.margin, SMALLER_SHARE_FACTOR * spared, ()
            if price > 0.0 and spared >= ledger.tolerance:
                continue
            break
        answer = tighter
        x = tighter.solution.x
        separations, violations, violated = _separate_violations(ledger, x)
        if violations:
            continue
        proofs = prover(x, cells)
        violations, violated = collect_open_violations(program, proofs), witnesses(program, proofs)
        if ledger.prove(tighter, separations, proofs) or not violations:
            return imposed > 0
        if cells == GLANCE:
            kept = None if any(rows.size for _, rows, _ in violated) else (tighter, separations)
    if kept is not None:
        ledger.prove(*kept, prover(kept[0].solution.x, CLOSER * GLANCE))
    return imposed > 0


def _compute_dear_margin(cost: float, price: float) -> float:
    """Return the margin that costs the share `LARGE_CELLS_COST_SHARE` of a ``cost``; finite where the ``price`` is
    almost 0."""
    return float(LARGE_CELLS_COST_SHARE * cost / max(price, max(cost, 1.0) * np.finfo(float).tiny))


def _solve_tightened(
    working: Working, ledger: Ledger, answer: CheckedAnswer, margin: float, more: float
) -> CheckedAnswer | None:
    """Return the optimum of the imposed rows tightened by ``margin + more``, or by ``margin`` where that is infeasible.

    ``None`` where both are infeasible, or where the margin overflows.
    """
    for distance in (margin + more, margin) if more else (margin,):
        if np.isfinite(PAID * float(distance) * working.longest):  # in Python's numbers, which overflow
            tighter = working.tightened(ledger, answer, distance)
            if tighter is not None:
                return tighter
    return None


def _separate_violations(ledger: Ledger, x: Array) -> tuple[Found, Sequence[LargestViolation], Violated]:
    """Return the separations at ``x (n,)``, the largest violations among them, and the constraints to impose."""
    separations = separate(ledger.program, x, ledger.tools, SEARCH_TOLERANCE, max(1, len(ledger.history)))
    violated_pairs = [
        pair for pair in separations if not pair[0].defines and pair[1].violations.max(initial=0.0) > SEARCH_TOLERANCE
    ]
    return (
        separations,
        [LargestViolation.of(*pair) for pair in violated_pairs],
        [select_violated(*pair) for pair in violated_pairs],
    )


def _is_near(
    working: Working, program: SemiInfiniteProgram, answer: CheckedAnswer, violations: Sequence[LargestViolation]
) -> bool:
    """Return whether a margin that covers the violations of an answer costs no more than the first one of `_tighten`.

    A round may take longer than all rounds before it, so the method does not wait for a better answer then.
    """
    distance = max((working.distance(violation) for violation in violations if violation.size > 0.0), default=0.0)
    price = working.priced(answer)
    if distance > 0.0 and not price > 0.0:  # no row has a multiplier, so the price of a margin is unknown
        return False
    return PAID * distance * price <= SPARED * abs(program.cost(answer.solution.x))


def _is_proven_cheaply(ledger: Ledger) -> bool:
    """Return whether a decision is proven that costs little more than a tightened decision must."""
    return ledger.proven is not None and ledger.gap(ledger.proven[0].solution.x) <= PAID * SPARED
