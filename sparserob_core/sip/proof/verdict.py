"""Status that the proofs of a run allow, its worst constraint, and the reasons for infeasibility."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from sparserob_core.sip.convex_set import Array
from sparserob_core.sip.evidence import NO_BOUND, Cut, InfeasibleSubsystem, Proof
from sparserob_core.sip.program import (
    TOLERANCE,
    ConstraintFamily,
    Explanation,
    SemiInfiniteProgram,
    Separation,
    WorstConstraint,
    distinguish_numbers,
)
from sparserob_core.sip.relaxed.relaxed import Rows
from sparserob_core.sip.result import MEANING, Result, Status

# Difference allowed between a row and the same row chosen among others, relative to its largest entry. With ten times
# as much, the error of a bound exceeds a certified gap; with a tenth, sums in another order are refused.
CHOSEN = 1e-9
MAX_NAMED_REASONS = 6  # largest number of reasons, or of members with the largest multipliers, that are named


def verdict(proofs: Sequence[Proof], gap: float, tolerance: float) -> tuple[Status, str]:
    """Return the status that proofs and gap allow, and a sentence.

    Parameters
    ----------
    proofs : sequence of Proof
        One proof for each family.
    gap : float
        Relative gap of the bounds.
    tolerance : float
        Largest gap of a certified result.

    Returns
    -------
    status : Status
        The status.
    message : str
        Sentence for a reader.
    """
    refuted = [
        f"{proof.family} is violated by {proof.violation * proof.unit:.4g} {proof.measured}".rstrip()
        for proof in proofs
        if proof.verdict == "refuted"
    ]
    if refuted:
        return "refuted", "; ".join(refuted)
    undecided = [proof.reason for proof in proofs if proof.verdict == "undecided"]
    if undecided:
        return "undecided", "; ".join(undecided)
    status: Status = "certified" if gap <= tolerance else "verified"
    return status, f"{MEANING[status]} (gap {max(gap, 0.0):.1e})"


def add_warning(program: SemiInfiniteProgram, result: Result) -> Result:
    """Return the result with a warning where its claim rests on unproven answers of the families.

    Enclosures and separations of a program that was stated directly are believed, for only its rows can be evaluated. A
    result without a claim is returned unchanged. Where rows contradict the answers of families, nothing is claimed.

    Parameters
    ----------
    program : SemiInfiniteProgram
        The program.
    result : Result
        The result.

    Returns
    -------
    Result
        The result, with a longer message, or with the status ``failed`` and without bounds.
    """
    if denied := _describe_contradiction(program, result):
        return replace(
            result,
            status="failed",
            message=f"{denied}: one of the two is wrong, and nothing is claimed",
            lower_bound=-np.inf,
            upper_bound=np.inf,
            dual=NO_BOUND,
            infeasible=None,
        )
    provable = [family for family in program.families if family.enclosure is not None or family.worst is not None]
    names: dict[str, list[str]] = {}
    for family in provable:
        names.setdefault(family.believed, []).append(family.name)
    names.pop("", None)
    if not names or result.status not in ("certified", "verified"):
        return result
    warning = "; ".join(
        f"what {', '.join(of[:MAX_NAMED_REASONS])}{', ...' if len(of) > MAX_NAMED_REASONS else ''} {what} is believed"
        for what, of in names.items()
    )
    return replace(result, message=f"{result.message}; {warning}")


def _describe_contradiction(program: SemiInfiniteProgram, result: Result) -> str:
    """Return in words how the rows of a family contradict its answers; empty where they do not.

    A witness may satisfy its row. Or chosen rows, on which multipliers rest, may differ from the rows at the same
    indices.
    """
    worst, x = result.worst, result.decision
    if result.status == "refuted" and worst is not None and worst.constraint and x is not None:
        family = program.formulated(worst.constraint, worst.formulation)
        violation = np.inf if family is None else float(family.violations(x, worst.index[None])[0, worst.row])
        if not violation > TOLERANCE / 2:
            return (
                f"{worst.constraint} is said to be violated by {worst.violation:.4g} at the index"
                f" {worst.index.tolist()}, and its rows are by {violation:.4g}"
            )
    for family in program.families:
        cuts = [cut for cut in result.dual.cuts if cut.family == family.name and cut.formulation == family.formulation]
        if family.chosen is None or not cuts:
            continue
        indices, rows = np.stack([cut.index for cut in cuts]), np.array([cut.row for cut in cuts])
        selected = [table[np.arange(len(cuts)), rows] for table in family.rows(indices)]
        expected, chosen = (np.column_stack(columns) for columns in (selected, family.chosen(indices, rows)))
        difference = np.abs(expected - chosen).max(axis=1)
        if not (difference <= CHOSEN * np.abs(expected).max(axis=1)).all():
            at = int(np.argmax(difference))
            return f"{family.name}: the row chosen at the index {indices[at].tolist()} is another one among its rows"
    return ""


def include_found_violation(
    proofs: Sequence[Proof], separations: Sequence[tuple[ConstraintFamily, Separation]]
) -> list[Proof]:
    """Return the proofs with the worst violation that separation has found, for families that are not proven.

    A refutation ends at the first witness, which need not be the worst.

    Parameters
    ----------
    proofs : sequence of Proof
        Proofs of the families.
    separations : sequence of (ConstraintFamily, Separation)
        Separations at the same decision.

    Returns
    -------
    list of Proof
        The proofs.
    """
    by_name = {family.name: (family, separation) for family, separation in separations}
    return [_choose_worse(proof, *by_name[proof.family]) if proof.family in by_name else proof for proof in proofs]


def _choose_worse(proof: Proof, family: ConstraintFamily, found: Separation) -> Proof:
    """Return the proof, or the refutation by the separation's violation where that is worse."""
    if proof.verdict == "proven" or not found.violations.size or found.violations[0] <= max(proof.violation, TOLERANCE):
        return proof
    return replace(
        proof,
        verdict="refuted",
        violation=float(found.violations[0]),
        index=found.indices[0],
        row=int(found.rows[0]),
        formulation=family.formulation,
        unit=family.row_unit(int(found.rows[0])),
        measured=family.measure(int(found.rows[0])),
    )


def worst_of(separations: Sequence[tuple[ConstraintFamily, Separation]]) -> WorstConstraint:
    """Return the most violated constraint that the separations of all families have found; families that define values
    are ignored."""
    candidates = [
        WorstConstraint(float(s.violations[0]), family.name, s.indices[0], int(s.rows[0]), family.formulation)
        for family, s in separations
        if s.violations.size and not family.defines
    ]
    return max(
        candidates, key=lambda constraint: constraint.violation, default=WorstConstraint(-np.inf, "", np.zeros(0))
    )


def witness(program: SemiInfiniteProgram, searched: WorstConstraint, proofs: Sequence[Proof]) -> WorstConstraint:
    """Return the worst constraint that search or proof has found, with the facts that its family adds.

    Parameters
    ----------
    program : SemiInfiniteProgram
        The program.
    searched : WorstConstraint
        The worst constraint that the search has found.
    proofs : sequence of Proof
        Proofs of the families.

    Returns
    -------
    WorstConstraint
        The worst of all.
    """
    candidates = [
        WorstConstraint(proof.violation, proof.family, proof.index, proof.row, proof.formulation)
        for proof in proofs
        if proof.index is not None and not program.family(proof.family).defines
    ]
    return add_facts(program, max([searched, *candidates], key=lambda constraint: constraint.violation))


def add_facts(program: SemiInfiniteProgram, bare: WorstConstraint) -> WorstConstraint:
    """Return the worst constraint with the facts that its family adds.

    Parameters
    ----------
    program : SemiInfiniteProgram
        The program.
    bare : WorstConstraint
        The constraint without these facts.

    Returns
    -------
    WorstConstraint
        The constraint.
    """
    family = program.formulated(bare.constraint, bare.formulation) if bare.constraint else None
    return bare if family is None else family.explanation(bare.index, bare.row).witness(bare)


def infeasible_subsystem(
    program: SemiInfiniteProgram, rows: Rows, y: Array, amount: float, shown: bool
) -> tuple[InfeasibleSubsystem, WorstConstraint | None]:
    """Return the reasons for infeasibility, and the most important constraint.

    A single imposed row that no decision meets is returned alone, where its violation is larger than that of any reason
    that needs no solver. Otherwise the first `MAX_NAMED_REASONS` of these reasons are returned. Where there is none,
    the rows that cannot hold together are returned, with the demand of their weighted sum on the decision.

    Parameters
    ----------
    program : SemiInfiniteProgram
        The program.
    rows : Rows
        Imposed rows.
    y : ndarray
        Farkas multipliers of the fixed rows, then of ``rows``.
    amount : float
        Proven infeasibility, in multiples of the norms of the rows.
    shown : bool
        True where, for each row, a decision was found that meets all the others.

    Returns
    -------
    subsystem : InfeasibleSubsystem
        The reasons.
    worst : WorstConstraint or None
        Constraint of the first reason, or with the largest multiplier.
    """
    from sparserob_core.sip.proof.reasons import least_of, least_within, reasons, sentence

    evident, equalities = reasons(program), bool(program.finite.b.size)
    multipliers = y[y.size - rows.h.size :]
    active = np.flatnonzero(multipliers > 0)
    if active.size == 1 and not equalities and (program.finite.S is not None or not evident) and len(evident) < 2:
        i = int(active[0])
        # Where the decision has more than bounds of its own (a polytope of controls), Farkas' multipliers, or a linear
        # program whose cost is this row alone, give a larger bound.
        norms = np.linalg.norm(np.vstack([program.finite.G, rows.G]), axis=1)
        farkas = amount * float(y @ norms / multipliers[i])
        own_bound = float(least_of(program.finite, rows.G[[i]], rows.h[[i]])[0])
        violation = max(own_bound, farkas, least_within(program.finite, rows.G[i]) - float(rows.h[i]))
        if violation > max((reason.amount for reason in evident), default=0.0):
            family = program.family(rows.cuts[i].family)
            text = sentence("out of reach", family, rows.take(np.array([i])), np.ones(1), violation)
            return InfeasibleSubsystem(reasons=(text,)), _make_worst_constraint(program, rows.cuts[i], violation)
    if evident:
        texts = tuple(reason.text for reason in evident[:MAX_NAMED_REASONS])
        subsystem = InfeasibleSubsystem(reasons=texts, others=max(0, len(evident) - MAX_NAMED_REASONS))
        return subsystem, _make_worst_constraint(program, evident[0].rows.cuts[0], evident[0].amount)
    if not active.size:
        return InfeasibleSubsystem(amount=amount, equalities=equalities), None
    order = active[np.argsort(-multipliers[active], kind="stable")]
    worst = _make_worst_constraint(program, rows.cuts[order[0]], amount)
    subsystem = _describe_subsystem(program, rows, multipliers, order, amount)
    return replace(subsystem, irreducible=shown), worst


def _describe_subsystem(
    program: SemiInfiniteProgram, rows: Rows, multipliers: Array, order: np.ndarray, amount: float
) -> InfeasibleSubsystem:
    """Return several rows that cannot hold together, by their descriptions.

    The demand of their weighted sum is added where this sum alone proves it.
    """
    from sparserob_core.sip.proof.reasons import least_of, least_within

    explanations = [_explain_cut(program, rows.cuts[i]) for i in order[:MAX_NAMED_REASONS]]
    units = np.array([program.family(cut.family).row_unit(cut.row) for cut in rows.cuts])
    y = multipliers / units
    share = 1.0 / y.max()
    y, weights = y * share, multipliers * share  # for rows in the user's units, and in their own
    required = -float(weights[order] @ rows.h[order])
    combined = weights[order] @ rows.G[order]
    own_bound = float(least_of(program.finite, combined[None], np.array([-required]))[0])
    missing = max(own_bound, least_within(program.finite, combined) + required)
    demand, decides = "", explanations[0].decides
    if missing > 0 and required > 0:
        required_text, available_text = distinguish_numbers(required, required - missing)
        named = ", ".join(f"{y[i]:.3g}" for i in order[:MAX_NAMED_REASONS]) + (
            ", ..." if order.size > MAX_NAMED_REASONS else ""
        )
        demand = (
            f"weighted by {named} they ask the {decides} for {required_text}, and it can give at most {available_text}"
        )
    return InfeasibleSubsystem(
        members=tuple(explanation.text for explanation in explanations),
        amount=amount,
        others=max(0, order.size - MAX_NAMED_REASONS),
        equalities=bool(program.finite.b.size),
        demand=demand,
        decides=decides,
    )


def _make_worst_constraint(program: SemiInfiniteProgram, cut: Cut, violation: float) -> WorstConstraint:
    """Return the worst constraint at a cut, with the facts that its family adds."""
    return add_facts(program, WorstConstraint(violation, cut.family, cut.index, cut.row, cut.formulation))


def _explain_cut(program: SemiInfiniteProgram, cut: Cut) -> Explanation:
    """Return the description of a cut's constraint."""
    family = program.formulated(cut.family, cut.formulation) or program.family(cut.family)
    return family.explanation(cut.index, cut.row)
