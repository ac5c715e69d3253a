"""What may be said of a run: the status that its proofs allow, its worst constraint, and why nothing is feasible."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from sparserob_core.sip.certificate import Proof
from sparserob_core.sip.convex_set import Array
from sparserob_core.sip.duality import dual_bound
from sparserob_core.sip.finite import FiniteProgram
from sparserob_core.sip.program import ConstraintFamily, SemiInfiniteProgram, Separation
from sparserob_core.sip.relaxed import Rows
from sparserob_core.sip.result import MEANING, Status, Witness

NAMED = 4   # constraints of a clash that the sentence names, those with the largest multipliers


def verdict(proofs: Sequence[Proof], gap: float, tolerance: float) -> tuple[Status, str]:
    """The status that the proofs and the gap allow, and a sentence."""
    refuted = [f"{proof.family} is violated by {proof.violation:.4g}" for proof in proofs if proof.verdict == "refuted"]
    if refuted:
        return "refuted", "; ".join(refuted)
    undecided = [proof.reason for proof in proofs if proof.verdict == "undecided"]
    if undecided:
        return "undecided", "; ".join(undecided)
    status: Status = "certified" if gap <= tolerance else "verified"
    return status, f"{MEANING[status]} (gap {max(gap, 0.0):.1e})"


def worst_of(separations: Sequence[tuple[ConstraintFamily, Separation]]) -> Witness:
    """The most violated constraint that the separations of all families have found."""
    found = [Witness(float(s.violations[0]), family.name, s.indices[0], int(s.rows[0])) for family, s in separations if s.violations.size]
    return max(found, key=lambda one: one.violation, default=Witness(-np.inf, "", np.zeros(0)))


def witness(program: SemiInfiniteProgram, searched: Witness, proofs: Sequence[Proof]) -> Witness:
    """The worst constraint that search or proof has met, explained."""
    found = [Witness(proof.violation, proof.family, proof.index, proof.row) for proof in proofs if proof.index is not None]
    return explained(program, max([searched, *found], key=lambda one: one.violation))


def explained(program: SemiInfiniteProgram, bare: Witness) -> Witness:
    """A witness with time, parameter and disturbance filled in, where its family can tell them."""
    explain = program.family(bare.constraint).explain if bare.constraint else None
    if explain is None:
        return bare
    words = explain(bare.index, bare.row)
    return replace(bare, time=words.time, parameter=words.parameter, disturbance=words.disturbance)


def clash(program: SemiInfiniteProgram, rows: Rows, multipliers: Array, amount: float) -> tuple[str, Witness | None]:
    """Why nothing is feasible, from Farkas multipliers ``(r,)`` of ``rows``: one impossible constraint if there is one, else those that clash."""
    active = np.flatnonzero(multipliers > 0)
    alone = [_least_violation(program.finite, rows, int(i)) for i in active]
    if alone and max(alone) > 0:
        worst = int(active[int(np.argmax(alone))])
        text = f"{_words(program, rows, worst)} is violated by at least {max(alone):.4g}, whatever the decision"
        cut = rows.cuts[worst]
        return text, explained(program, Witness(max(alone), cut.family, cut.index, cut.row))
    order = active[np.argsort(-multipliers[active], kind="stable")][:NAMED]
    named = " and ".join(_words(program, rows, int(i)) for i in order)
    others = f" and {active.size - order.size} more" if active.size > order.size else ""
    if not active.size:
        return f"the equalities cannot be met within the bounds, whatever the decision: one is missed by at least {amount:.4g} times its norm", None
    cut = rows.cuts[order[0]]
    text = f"these cannot hold together, whatever the decision (one is violated by at least {amount:.4g} times its norm): {named}{others}"
    return text, explained(program, Witness(amount, cut.family, cut.index, cut.row))


def _least_violation(base: FiniteProgram, rows: Rows, i: int) -> float:
    """A lower bound of ``G_i x - h_i`` over the bounds and fixed rows."""
    single = replace(base, q=rows.G[i], weights=np.zeros_like(base.weights), P=None)
    return dual_bound(single, np.zeros(base.h.size), np.zeros(base.b.size)) - float(rows.h[i])


def _words(program: SemiInfiniteProgram, rows: Rows, i: int) -> str:
    cut = rows.cuts[i]
    explain = program.family(cut.family).explain
    if explain is None:
        return f"row {cut.row} of {cut.family} at {np.array2string(cut.index, precision=6)}"
    return explain(cut.index, cut.row).text
