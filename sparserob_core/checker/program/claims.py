"""The claims of a stated program's certificate, each derived anew from its text in ball arithmetic."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any, final

import numpy as np
from flint import arb, ctx

from sparserob_core.checker.arithmetic.balls import above, ball, below, largest
from sparserob_core.checker.claims.case import listed, number, shaped
from sparserob_core.checker.claims.claims import PRECISION, SMALL_COST, SMALL_GAP, judged
from sparserob_core.checker.outcome import EQUALITY, FIGURES, TOLERANCE, Broken, Clock, Finding, Unchecked
from sparserob_core.checker.program.bound import Lagrangian, WeightedRow, row_of_term
from sparserob_core.checker.program.cover import require_cover
from sparserob_core.checker.program.rows import bound_violation, coefficients_at, evaluate_row
from sparserob_core.sip.convex_set import Array
from sparserob_core.sip.expressions.index_sets import Region
from sparserob_core.sip.expressions.rows import ExpressionRows
from sparserob_core.sip.expressions.statements import StatedRow
from sparserob_core.sip.stated.statement import StatedProgram
from sparserob_core.sip.stated.terms import AffineFunction

CLAIMS = ("certified", "verified")


@final
@dataclass(frozen=True, eq=False)
class ProgramCase:
    """A stated program and the certificate of a run of it.

    ``excused`` are the largest violations of families that are not excluded, of those that were looked at.
    """

    program: StatedProgram
    certificate: Mapping[str, Any]
    clock: Clock
    excused: dict[object, float] = field(default_factory=dict)

    @property
    def status(self) -> str:
        """Status that the certificate claims."""
        return str(self.certificate.get("status"))

    @cached_property
    def decision(self) -> Array:
        """The decision, of which the entries after the named ones are `StatedProgram.residuals`."""
        return shaped(self.certificate, "decision", (self.program.decisions.n,))

    def family(self, name: object) -> ExpressionRows:
        """Return the rows of a family; raise `Broken` where there is none of that name."""
        for family_name, rows in self.program.parsed:
            if family_name == name:
                return rows
        raise Broken(f"the program has no family {name!r}")

    def locate(self, entry: Mapping[str, Any]) -> tuple[ExpressionRows, StatedRow, Array]:
        """Return the family, the row and the index that an entry of the certificate names; raise `Broken` where there
        are none."""
        family, place = self.family(entry.get("family")), entry.get("row")
        if type(place) is not int or not 0 <= place < len(family.rows):
            raise Broken(f"the family {entry.get('family')!r} has no row {place!r}")
        index = shaped(entry, "index", (family.dimension,))
        if (index < family.lower).any() or (index > family.upper).any():
            raise Broken(f"the index {index.tolist()} is outside of the index set")
        return family, family.rows[place], index


def check_program(case: ProgramCase, gap_tolerance: float | None) -> list[Finding]:
    """Return one verdict per claim of the certificate; nothing that the file says is believed."""
    with ctx.workprec(PRECISION):
        covers = [
            judged(f"polytope of {family.name}", lambda region=region: _verify_cover(region))  # type: ignore[misc]
            for family, regions in zip(case.program.families, case.program.regions, strict=True)
            for region in regions
            if region.coupled
        ]
        if any(cover.verdict != "holds" for cover in covers):
            return covers  # no index is then known to be one, and no part of the set to be all of it
        return [*covers, *_check_claims(case, gap_tolerance)]


def _check_claims(case: ProgramCase, gap_tolerance: float | None) -> list[Finding]:
    """Return one verdict per claim about a program whose index sets are covered by their pieces."""
    if case.status == "infeasible":
        return [judged("infeasibility", lambda: _verify_infeasibility(case))]
    if case.status not in (*CLAIMS, "refuted", "undecided"):
        return [Finding("status", "fails", f"it is {case.status!r}, which claims nothing")]
    lower = judged("lower bound", lambda: _verify_lower_bound(case))
    if case.certificate.get("decision") is None:
        is_claimed = case.status != "undecided" or case.certificate.get("cost") is not None
        return [lower, *([Finding("objective", "fails", "it is told of no decision")] if is_claimed else [])]
    claims = [judged("objective", lambda: _verify_cost(case)), lower]
    if case.status == "refuted":
        return [*claims, judged("violation", lambda: _verify_witness(case))]
    if case.status == "undecided":
        return claims
    claims.append(judged("bounds and rows", lambda: _verify_finite_rows(case)))
    claims += [
        judged(name, lambda name=name, rows=rows: _verify_family(case, name, rows))  # type: ignore[misc]
        for name, rows in case.program.parsed
    ]
    return [*claims, judged("status", lambda: _verify_status(case, gap_tolerance, claims))]


def _verify_cover(region: Region) -> str:
    """Show that the simplices of a polytope are all of it."""
    return f"{require_cover(region)} simplices cover it"


def _evaluate_term(term: AffineFunction, x: Array) -> tuple[arb, float]:
    """Return a ball with the value of an affine function, and the size of its terms."""
    products = [ball(c) * ball(x[j]) for j, c in zip(term.positions.tolist(), term.coefficients.tolist(), strict=True)]
    size = abs(term.constant) + sum(abs(float(product.mid())) for product in products)
    return sum(products, ball(term.constant)), size


def _evaluate_cost(case: ProgramCase) -> tuple[arb, float]:
    """Return a ball with the objective of the named entries of the decision, and the size of its terms."""
    objective, x = case.program.objective, case.decision
    total, size = _evaluate_term(objective.linear, x)
    for weight, left, right in objective.products:
        part = ball(weight) * _evaluate_term(left, x)[0] * _evaluate_term(right, x)[0]
        total, size = total + part, size + above(abs(part))
    for weight, inner in objective.absolutes:
        part = ball(weight) * abs(_evaluate_term(inner, x)[0])
        total, size = total + part, size + above(abs(part))
    return total, size


def _verify_cost(case: ProgramCase) -> str:
    """Show that the decision costs what is written."""
    written = number(case.certificate, "cost")
    cost, size = _evaluate_cost(case)
    if not abs(cost - written) <= FIGURES * max(size, abs(written), np.finfo(float).tiny):
        raise Broken(f"{written!r} is written, the decision costs {float(cost.mid())!r}")
    return f"the decision costs {written:.12g}"


def _list_rows(case: ProgramCase) -> tuple[list[WeightedRow], Array | None]:
    """Return the rows of the certificate's multipliers, and the point of the tangent."""
    data, program = case.certificate.get("multipliers"), case.program
    if not isinstance(data, Mapping):
        raise Unchecked("the certificate has no multipliers")
    n = program.decisions.n
    rows: list[WeightedRow] = []
    for entry in listed(data, "constraints"):
        if not isinstance(entry, Mapping):
            raise Broken("constraints: expected a list of multipliers with their families and indices")
        (family, row, index), multiplier = case.locate(entry), number(entry, "multiplier")
        if multiplier < 0.0:
            raise Broken(f"a multiplier is {multiplier!r}, expected a number that is not negative")
        coefficients, constant = coefficients_at(family, row, index, n)
        rows.append(WeightedRow(coefficients, constant, ball(multiplier)))
    inequalities = [term for term, is_equality in program.finite_terms if not is_equality]
    equalities = [term for term, is_equality in program.finite_terms if is_equality] + program.definitions
    own, free = (
        shaped(data, "rows", (len(inequalities),)),
        shaped(data, "equalities", (len(equalities),)),
    )
    if (own < 0.0).any():
        raise Broken("a multiplier of a row is negative")
    rows += [row_of_term(term, y, n) for term, y in zip(inequalities, own.tolist(), strict=True)]
    rows += [row_of_term(term, mu, n, True) for term, mu in zip(equalities, free.tolist(), strict=True)]
    tangent = None if data.get("tangent") is None else shaped(data, "tangent", (n,))
    return rows, tangent


def _verify_lower_bound(case: ProgramCase) -> str:
    """Show that no decision costs less than is written."""
    written = case.certificate.get("lower_bound")
    if written is None or written == -np.inf:
        return "none is claimed"
    written = number(case.certificate, "lower_bound")
    rows, tangent = _list_rows(case)
    derived = Lagrangian(case.program, rows, tangent, True).bound()
    if not derived.is_finite():
        raise Unchecked("the multipliers prove no finite bound")
    if not derived + FIGURES * max(abs(written), np.finfo(float).tiny) >= written:
        raise Broken(f"{written!r} is written, the multipliers prove {below(derived)!r}")
    return f"no decision costs less than {min(written, below(derived)):.12g}"


def _verify_infeasibility(case: ProgramCase) -> str:
    """Show that no decision meets the rows (Farkas)."""
    rows, tangent = _list_rows(case)
    amount = Lagrangian(case.program, rows, tangent, False).bound()
    if not amount > 0:
        raise Broken(f"the multipliers prove {below(amount):.3g}, expected a positive number")
    return f"no decision meets the rows: a weighted sum of them is violated by {below(amount):.3g}, whatever it is"


def _verify_finite_rows(case: ProgramCase) -> str:
    """Show that the named entries of the decision are within their bounds, and meet the rows without an index."""
    x, program = case.decision, case.program
    lower, upper = program.bounds
    names = program.decisions.labels
    worst = 0.0
    for j, name in enumerate(names):
        over = max(float(lower[j]) - float(x[j]), float(x[j]) - float(upper[j]))
        if over > 0.0:
            raise Broken(f"{name} is {x[j]!r}, expected a number from {lower[j]:.9g} to {upper[j]:.9g}")
    for text, (term, is_equality) in zip([row.text for row in program.finite_rows], program.finite_terms, strict=True):
        if term.positions.max(initial=-1) >= len(names):
            raise Broken(f"{text!r} is about entries without a name")
        value, size = _evaluate_term(term, x)
        over = above(abs(value) if is_equality else value)
        if over > (EQUALITY if is_equality else TOLERANCE) * max(size, np.finfo(float).tiny):
            raise Broken(f"{text!r} is violated by {over:.3g}")
        worst = max(worst, over)
    count = len(program.finite_rows)
    return f"{len(names)} entries within their bounds" + (f", {count} rows to {worst:.1e}" if count else "")


def _price_excuses(case: ProgramCase) -> arb:
    """Return how much the cost would rise, to first order, if no violation were excused."""
    data, program = case.certificate.get("multipliers"), case.program
    if not isinstance(data, Mapping):
        return ball(0.0)
    sums: dict[object, float] = {}
    for entry in listed(data, "constraints"):
        sums[entry.get("family")] = sums.get(entry.get("family"), 0.0) + number(entry, "multiplier")
    price = sum((ball(case.excused.get(name, 0.0)) * ball(total) for name, total in sums.items()), ball(0.0))
    for is_equality, key in ((False, "rows"), (True, "equalities")):
        values = [_evaluate_term(term, case.decision)[0] for term, kind in program.finite_terms if kind == is_equality]
        weights = np.ravel(np.asarray(data.get(key), dtype=float))[: len(values)]
        excess = [abs(value) if is_equality else largest([value, ball(0.0)]) for value in values]
        price = price + sum((over * abs(ball(y)) for over, y in zip(excess, weights, strict=True)), ball(0.0))
    return price


def _verify_family(case: ProgramCase, name: str, rows: ExpressionRows) -> str:
    """Show that the rows of a family hold at every index."""
    x = case.decision
    excused = max(0.0, bound_violation(rows, x, TOLERANCE, case.clock))
    case.excused[name] = excused
    return f"{len(rows.rows)} rows hold at every index" + (f", to {excused:.1e}" if excused else "")


def _verify_witness(case: ProgramCase) -> str:
    """Show that the decision violates the constraint that refutes it."""
    witness = case.certificate.get("witness")
    if not isinstance(witness, Mapping):
        raise Broken("there is no witness")
    family, row, index = case.locate(witness)
    violation = evaluate_row(family, row, case.decision, index)
    if not violation > TOLERANCE:
        raise Broken(f"the witness violates its row by {float(violation):.3g}")
    return f"{row.text!r} is violated by {below(violation):.3g} at {family.piece.describe(index)}"


def _verify_status(case: ProgramCase, gap_tolerance: float | None, claims: list[Finding]) -> str:
    """Show that the status follows from the claims before it. The gap counts what excused violations are worth."""
    needed = [claim for claim in claims if case.status == "certified" or claim.name not in ("objective", "lower bound")]
    for claim in needed:
        if claim.verdict != "holds":
            fault = Broken if claim.verdict == "fails" else Unchecked
            raise fault(f"{case.status} rests on {claim.name}, which {claim.verdict.replace('not', 'is not')}")
    if case.status == "verified":
        return "every row holds at every index"
    cost, size = _evaluate_cost(case)
    lower, written = ball(number(case.certificate, "lower_bound")), case.certificate.get("gap_tolerance")
    if gap_tolerance is None or written != gap_tolerance:
        raise Broken(f"the gap is to be within {written!r}, the config says {gap_tolerance!r}")
    price = _price_excuses(case)
    scale = largest([abs(cost), abs(lower), ball(max(SMALL_COST * size, np.finfo(float).tiny))])
    if not lower - cost <= price + SMALL_GAP * scale:
        raise Broken("it costs less than any decision may that keeps what it excuses")
    gap = (largest([cost - lower, ball(0.0)]) + price) / scale
    if not gap <= gap_tolerance + SMALL_GAP:
        raise Broken(f"it is certified, but the gap is {above(gap):.3g}, more than {gap_tolerance:g}")
    return f"every row holds at every index, and the bounds meet within {max(0.0, above(gap)):.2e}"
