"""What may be said of a run: the status that its proofs allow, its worst constraint, and why nothing is feasible."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from sparserob_core.sip.convex_set import Array
from sparserob_core.sip.evidence import Cut, Proof, Witness
from sparserob_core.sip.program import ConstraintFamily, SemiInfiniteProgram, Separation
from sparserob_core.sip.proof.reasons import least_of, reasons, sentence, told_apart
from sparserob_core.sip.relaxed.relaxed import Rows
from sparserob_core.sip.result import MEANING, Status

NAMED = 6  # reasons, or constraints of a clash, that are named; of the latter those with the largest multipliers


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
    found = [
        Witness(float(s.violations[0]), family.name, s.indices[0], int(s.rows[0]), family.formulation)
        for family, s in separations
        if s.violations.size
    ]
    return max(found, key=lambda one: one.violation, default=Witness(-np.inf, "", np.zeros(0)))


def witness(program: SemiInfiniteProgram, searched: Witness, proofs: Sequence[Proof]) -> Witness:
    """The worst constraint that search or proof has met, explained."""
    found = [
        Witness(proof.violation, proof.family, proof.index, proof.row, proof.formulation)
        for proof in proofs
        if proof.index is not None
    ]
    return explained(program, max([searched, *found], key=lambda one: one.violation))


def explained(program: SemiInfiniteProgram, bare: Witness) -> Witness:
    """A witness with time, parameter and disturbance filled in, where its family can tell them."""
    family = program.formulated(bare.constraint, bare.formulation) if bare.constraint else None
    if family is None or family.explain is None:
        return bare
    said = family.explain(bare.index, bare.row)
    return replace(bare, time=said.time, parameter=said.parameter, disturbance=said.disturbance)


def clash(program: SemiInfiniteProgram, rows: Rows, multipliers: Array, amount: float) -> tuple[str, Witness | None]:
    """Why nothing is feasible, from Farkas multipliers ``(r,)`` of ``rows``: every separate reason that needs no
    solver, one sentence each; where there is none, the rows that cannot hold together, and what they ask of the
    decision against what it can give.
    """
    found = reasons(program)
    if found:
        texts = [reason.text for reason in found[:NAMED]]
        more = f"; and {len(found) - NAMED} more" if len(found) > NAMED else ""
        cut, several = found[0].rows.cuts[0], f"{len(found)} separate reasons: "
        return f"{several if len(found) > 1 else ''}{'; '.join(texts)}{more}", _witness_at(
            program, cut, found[0].amount
        )
    active = np.flatnonzero(multipliers > 0)
    if not active.size:
        return (
            (
                "the equalities cannot be met within the bounds, whatever the decision: one is missed by at least"
                f" {amount:.4g} times its norm"
            ),
            None,
        )
    order = active[np.argsort(-multipliers[active], kind="stable")]
    witness = _witness_at(program, rows.cuts[order[0]], amount)
    if active.size == 1 and not program.finite.b.size:
        i = int(order[0])
        family = program.family(rows.cuts[i].family)
        alone = float(least_of(program.finite, rows.G[[i]], rows.h[[i]])[0])
        if alone > 0:
            return sentence("out of reach", family, rows.take(np.array([i])), alone), replace(witness, violation=alone)
    return _together(program, rows, multipliers, order, amount), witness


def _together(program: SemiInfiniteProgram, rows: Rows, multipliers: Array, order: np.ndarray, amount: float) -> str:
    """Several rows that clash: each by name, and the sum of them that proves it."""
    named = "; ".join(_words(program, rows, int(i)) for i in order[:NAMED])
    others = f"; and {order.size - NAMED} more" if order.size > NAMED else ""
    head = (
        "nothing meets this and the equalities"
        if order.size == 1
        else "these cannot hold together, though all but any one of them can"
    )
    y = multipliers / multipliers.max()
    asked = -float(y[order] @ rows.h[order])
    missing = float(least_of(program.finite, (y[order] @ rows.G[order])[None], np.array([-asked]))[0])
    noun = "decision" if program.lengths is None else "control"
    more, less = told_apart(asked, asked - missing)
    sums = (
        f"; weighted by {', '.join(f'{y[i]:.3g}' for i in order[:NAMED])}{', ...' if order.size > NAMED else ''} they"
        f" ask the {noun} for {more}, and it can give at most {less}"
        if missing > 0 and asked > 0
        else ""
    )
    return (
        f"{head} (one is violated by at least {amount:.4g} times its norm, whatever the decision):"
        f" {named}{others}{sums}"
    )


def _witness_at(program: SemiInfiniteProgram, cut: Cut, violation: float) -> Witness:
    return explained(program, Witness(violation, cut.family, cut.index, cut.row, cut.formulation))


def _words(program: SemiInfiniteProgram, rows: Rows, i: int) -> str:
    cut = rows.cuts[i]
    family = program.formulated(cut.family, cut.formulation)
    if family is None or family.explain is None:
        return f"row {cut.row} of {cut.family} at {np.array2string(cut.index, precision=6)}"
    return family.explain(cut.index, cut.row).text
