"""A proven decision first: one that keeps away from the constraints, so that there is an upper bound while a better one
is sought and proven; for every working set alike, which says how its rows are solved when they are tightened by more.
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
from sparserob_core.sip.working.ledger import ALLOWED, Answer, Found, Ledger, Prover, Violated, above, witnesses
from sparserob_core.sip.working.working import Missed, Working, left_open

# Cells for the first look at a decision. With a tenth of them, decisions of ordinary problems with parameters are
# secured that are proven at once; with ten times as many, who rides a wall waits ten times longer for a first bound.
GLANCE = 4096
# Times that in cells, where nothing is as far away as what a glance leaves open. With a quarter of it directions in
# four dimensions are left open; with ten times as much a minute goes by where a cell is dear.
CLOSER = 16
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
# Of the cost, up to which a violation that can be imposed is kept away from besides, and what is paid where cells are
# too many nearer by. With a tenth of it a wall between two imposed times takes two rounds more, and one in four
# dimensions with a parameter more than twice the cells; with all of the cost, what is far from feasible leaves nothing
# to choose.
DEAR = 0.1
# Share of what is spared that is tried next where nothing is that far away, as long as it is more than the tolerated
# gap. With a tenth of it there is no second one; with ten times as much four programs are solved in vain where nothing
# keeps away at all.
THINNER = 0.01
# Of what is dear, what is tried next where nothing is that far away. With a tenth of it a distance is passed over that
# takes a tenth of the cells; with nine tenths of it a program is solved for every tenth.
NEARER = 0.25
PAID = 2.0  # of what is left open, what the rows are tightened by: half of it is for what the new optimum violates


def proofs_of(
    working: Working, ledger: Ledger, prover: Prover, answer: Answer, found: Found
) -> tuple[Sequence[Proof], bool]:
    """What is proven of an answer: by one glance where that will do, else by a proof in full, before which there is a
    decision that is proven; and whether constraints were imposed for that."""
    x = answer.solution.x
    proofs = prover(x, GLANCE // 4 if ledger.tools.deadline.bounded else GLANCE)
    if ledger.prove(answer, found, proofs) or not proofs:
        return proofs, False
    missed, imposed = left_open(ledger.program, proofs), False
    searched = any(above(*one)[1].size for one in found)  # then the rounds are used up, and this would be more
    if missed and not searched and not _is_secured(ledger):
        imposed = _secure(working, ledger, prover, answer, missed, witnesses(ledger.program, proofs))
    # Where there are no cells, another look would be the same one.
    if any(proof.cells for proof in proofs) and not any(proof.verdict == "refuted" for proof in proofs):
        proofs = prover(x)
        ledger.prove(answer, found, proofs)
    return proofs, imposed


def secure_in_time(working: Working, ledger: Ledger, prover: Prover, answer: Answer, found: Found, number: int) -> bool:
    """Secure a decision when time is due, though that of round ``number`` violates what was ``found``: as soon as
    little would pay for that; where there is a limit, at certain shares of it, and when no more is left of it than that
    may take; without a limit after some rounds. Whether constraints were imposed."""
    if not all(family.provable for family in ledger.program.families):
        return False
    deadline, began = ledger.tools.deadline, [event.seconds for event in ledger.history]
    candidate = working.candidate(answer) if number & (number - 1) == 0 else None  # 1, 2, 4, 8, ...
    if candidate is not None and ledger.cheaper(candidate):
        x = candidate.solution.x
        ledger.prove(candidate, separate(ledger.program, x, ledger.tools, ALLOWED), prover(x, GLANCE))
    missed, violated = [Missed.most(*one) for one in found], [above(*one) for one in found]
    near = working.secured == 0
    if deadline.left is None:  # where nothing is left to impose, the proof of this decision comes at once
        near = near and (ledger.open(answer.solution.x) or any(rows.size for _, rows, _ in violated))
    near = near and _is_near(working, ledger.program, answer, missed)
    if deadline.left is None:
        working.secured += near
        due = near or (number >= PATIENT and number & (number - 1) == 0)
    else:
        due = near or (working.secured < len(DUE) and deadline.used >= DUE[working.secured])
        working.secured += due
        longest = max(np.diff(began, prepend=0.0), default=0.0)
        due = due or (ledger.proven is None and deadline.left <= RESERVED * longest)
    if not due or _is_secured(ledger):
        return False
    if not any(rows.size for _, rows, _ in violated):  # it may be proven as it is, and solving takes longer
        ledger.prove(answer, found, prover(answer.solution.x, GLANCE // 4))
        if ledger.proven is not None:
            return False
    return _secure(working, ledger, prover, answer, missed, violated)


def back_off(working: Working, ledger: Ledger, prover: Prover, answer: Answer, found: Found) -> None:
    """Prove the answer of a search, or, where it misses the constraints by so little that keeping away from them costs
    no more than securing does, a decision that keeps away by that much. What misses more is left as it is, for it is
    not what the search has found. The lower bound of the ledger stays that of the search: what is imposed to back off
    is not."""
    x, program = answer.solution.x, ledger.program
    missed = [Missed.most(*one) for one in found if not one[0].defines]
    violated: Violated = [above(*one) for one in found]
    if not ledger.cheaper(answer) or not _is_near(working, program, answer, missed):
        return
    if not any(rows.size for _, rows, _ in violated):
        proofs = prover(x, GLANCE)
        if ledger.prove(answer, found, proofs):
            return
        missed, violated = left_open(program, proofs), witnesses(program, proofs)
        if not missed or not _is_near(working, program, answer, missed):
            return
    aside = replace(ledger)
    _secure(working, aside, prover, answer, missed, violated, ledger.tolerance)
    if aside.proven is not None and aside.proven is not ledger.proven:
        secured, looked, proofs = aside.proven
        ledger.prove(replace(secured, value=answer.value), looked, proofs)


def or_proven(ledger: Ledger, result: Result) -> Result:
    """The result, or that of the decision that is proven where the result is not."""
    if result.status not in ("refuted", "undecided") or ledger.proven is None:
        return result
    secured, found, proofs = ledger.proven
    why = ledger.tools.deadline.reason or f"of a decision that costs less it is not proven: {result.message}"
    return ledger.judged(secured, worst_of(found), proofs, why)


def _secure(
    working: Working,
    ledger: Ledger,
    prover: Prover,
    answer: Answer,
    missed: Sequence[Missed],
    violated: Violated,
    spared: float = SPARED,
) -> bool:
    """Prove a decision that keeps away from the constraints, so that there is an upper bound while the proof of a
    better one goes on: the optimum of the imposed rows and of those that are ``violated``, all of them tightened by as
    much as the share ``spared`` of the cost of ``answer`` pays for and by more than what it ``missed``, and again by
    what that proof leaves open. What it missed is kept away from only as long as something is that far away, and what
    is imposed for it not for ever; where nothing is as far away as is spared, a hundredth of that is tried, and where
    nothing is as far away as large cells ask for, smaller cells at what is `DEAR` or a part of it. Nothing is claimed
    where nothing keeps away at all. Whether anything was imposed.
    """
    program, margin, imposed = ledger.program, working.margin, 0
    near: tuple[Answer, Found] | None = None  # of which a glance left cells open, and no search finds a violation
    cells, dear = GLANCE, _dear(abs(program.cost(answer.solution.x)), working.priced(answer))
    for _ in range(SECURED):
        cost, price = abs(program.cost(answer.solution.x)), working.priced(answer)
        fresh = working.impose(violated)
        imposed += fresh
        more = PAID * max((working.distance(one) for one in missed), default=0.0)
        margin = max(margin, working.margin + (spared * cost / price if price > 0.0 else 0.0))
        margin += 0.0 if fresh else more
        more = more if fresh and more * price < DEAR * cost else 0.0
        farther = _farther(working, ledger, answer, margin, more)
        if farther is None and near is not None:  # nor as far as large cells ask for: smaller ones, as far as is borne
            if dear * price <= PAID * spared * cost:
                break
            cells, margin, missed, dear = CLOSER * GLANCE, working.margin + dear, (), NEARER * dear
            continue
        if farther is None:  # nor that far, as where two walls are close to each other
            margin, spared, missed = working.margin, THINNER * spared, ()
            if price > 0.0 and spared >= ledger.tolerance:
                continue
            break
        answer = farther
        x = farther.solution.x
        looked, missed, violated = _looked(ledger, x)
        if missed:
            continue
        proofs = prover(x, cells)
        missed, violated = left_open(program, proofs), witnesses(program, proofs)
        if ledger.prove(farther, looked, proofs) or not missed:
            return imposed > 0
        if cells == GLANCE:
            near = None if any(rows.size for _, rows, _ in violated) else (farther, looked)
    if near is not None:
        ledger.prove(*near, prover(near[0].solution.x, CLOSER * GLANCE))
    return imposed > 0


def _dear(cost: float, price: float) -> float:
    """The distance that is paid for with the share `DEAR` of a ``cost``; finite where a ``price`` is almost 0."""
    return float(DEAR * cost / max(price, max(cost, 1.0) * np.finfo(float).tiny))


def _farther(working: Working, ledger: Ledger, answer: Answer, margin: float, more: float) -> Answer | None:
    """The optimum of the imposed rows, tightened by a margin and by ``more``, or by the margin alone where nothing is
    that far away: what was imposed may do. ``None`` where nothing keeps away, or by more than numbers can say."""
    for distance in (margin + more, margin) if more else (margin,):
        if np.isfinite(PAID * float(distance) * working.longest):  # in Python's numbers, which overflow
            farther = working.tightened(ledger, answer, distance)
            if farther is not None:
                return farther
    return None


def _looked(ledger: Ledger, x: Array) -> tuple[Found, Sequence[Missed], Violated]:
    """What a search finds at ``x (n,)``, and what of it is violated and can be imposed."""
    looked = separate(ledger.program, x, ledger.tools, ALLOWED, max(1, len(ledger.history)))
    found = [one for one in looked if not one[0].defines and one[1].violations.max(initial=0.0) > ALLOWED]
    return looked, [Missed.most(*one) for one in found], [above(*one) for one in found]


def _is_near(working: Working, program: SemiInfiniteProgram, answer: Answer, missed: Sequence[Missed]) -> bool:
    """Whether to keep away from the constraints by more than an answer ``missed`` costs no more than what a decision is
    secured for in any case. A round may take longer than all before it, so such an answer is not let go."""
    distance = max((working.distance(one) for one in missed if one.violation > 0.0), default=0.0)
    price = working.priced(answer)
    if distance > 0.0 and not price > 0.0:  # no row has a multiplier, which says nothing of those that are missed
        return False
    return PAID * distance * price <= SPARED * abs(program.cost(answer.solution.x))


def _is_secured(ledger: Ledger) -> bool:
    """Whether a decision is proven that costs little more than what such a one must."""
    return ledger.proven is not None and ledger.gap(ledger.proven[0].solution.x) <= PAID * SPARED
