"""Texts of a recording: the log of decisions, and the page that says what is known and what the colours mean."""

from __future__ import annotations

import math
from typing import Any

import sparserob_core as sr
from sparserob_rerun.drawing import palette as ink
from sparserob_rerun.drawing.palette import Colour

CUTS = 12  # cuts of one round that are listed one by one

SIGNALS = (
    "The controls and states of the final decision are series over the time t of the system. Choose the timeline t at"
    " the lower left, in the place of the one that is chosen there, and they appear."
)
LEGEND = """
**Colours.** Blue: the control and the states; the band: how far disturbance and parameters can move them.
Hatched red: forbidden. Yellow: the worst case. Pink: active constraints, and the switching function that follows from
them: the control acts where it leaves the dashed band, and nowhere else.
"""

CLASHES = """
**Colours.** Hatched red: forbidden. Blue: where the control can bring the quantity.
White line: the best of it. Yellow: what the worst disturbance makes of the best.
"""


STATES: dict[str, Colour] = {
    "search": ink.SKY,
    "polish": ink.ORANGE,
    "rounds": ink.SKY,
    "violations": ink.VERMILLION,
    "proof": ink.PURPLE,
    "certified": ink.GREEN,
    "verified": ink.GREEN,
    "undecided": ink.GREY,
    "infeasible": ink.VERMILLION,
    "refuted": ink.VERMILLION,
    "failed": ink.VERMILLION,
}
"""States of a run and statuses at its end, with the colour of each."""


def state_of(event: sr.Event, before: str) -> str:
    """Return the state of a run when an event of it comes, or the state ``before``, where the event says nothing of
    it."""
    match event:
        case sr.EvaluationsFinished():
            return "violations" if event.family else "polish" if event.phase == "polish" else "search"
        case sr.RoundFinished():
            return "rounds" if before in ("", "rounds", "violations", "proof") else before
        case sr.ProofProgress():
            return "proof"
        case sr.RunFinished():
            return event.status
    return before


def round_lines(event: sr.RoundFinished, inspection: sr.Inspection | None) -> list[str]:
    """Describe one round in words: its bounds, what is violated, and the cuts that come of it."""
    is_known = inspection is not None and any(
        family.name == event.worst_family for family in inspection.program.families
    )
    tolerance = inspection.tolerance(event.worst_family) if inspection is not None and is_known else 0.0
    unit = f" {event.measured}" if event.measured else ""
    if event.violation > tolerance:
        violation = f"{event.worst_family} is violated by {event.violation:.2e}{unit}"
    elif event.violation > 0.0:
        violation = f"every constraint holds, {event.worst_family} to within {event.violation:.1e}{unit}"
    else:
        violation = f"every constraint holds with {-event.violation:.2e}{unit} to spare"
    if event.simplified:
        violation += ", with some of the uncertainty only"
    upper_bound = math.inf if event.simplified else event.upper_bound
    bound = f"lower bound {event.lower_bound:.7g}" + (
        f", upper bound {upper_bound:.7g}" if math.isfinite(upper_bound) else ""
    )
    if event.proven < upper_bound:
        bound += f", proven: a control of cost {event.proven:.7g}"
    lines = [f"round {event.round}: {bound}; {violation}; epsilon {event.epsilon:.1e}"]
    for word, cuts in (("+", event.added), ("-", event.dropped)):
        lines += [f"{word} {cut_words(cut, inspection)}" for cut in cuts[:CUTS]]
        if len(cuts) > CUTS:
            lines.append(f"{word} and {len(cuts) - CUTS} more")
    return lines


def cut_words(cut: sr.Cut, inspection: sr.Inspection | None) -> str:
    """Describe a constraint at an index, as its family reports it: ``path: x1(1.55) <= 0.7``."""
    families = () if inspection is None else inspection.program.families
    family = next(
        (candidate.formulated(cut.formulation) for candidate in families if candidate.name == cut.family), None
    )
    if family is not None and family.explain is not None:
        return family.explanation(cut.index, cut.row).short()
    if cut.formulation == "sampled" and len(cut.index) > 1:
        return f"{cut.family} at t = {cut.index[0]:.5g} in scenario {cut.index[1]:.0f}, row {cut.row + 1}"
    shown = ", ".join(f"{value:.5g}" for value in cut.index[:4]) + (", ..." if len(cut.index) > 4 else "")
    return f"{cut.family} at ({shown}), row {cut.row + 1}"


def page(title: str, status: str, lower: float, upper: float, more: list[str]) -> str:
    """Return the page in Markdown."""
    if status == "infeasible":
        bounds = "no control meets the constraints, so there is no J*"
    elif math.isfinite(lower) or math.isfinite(upper):
        bounds = f"{_number(lower)} ≤ J* ≤ {_number(upper)}"
    else:
        bounds = "no bound yet" if status == "solving" else "no bound is known"
    is_bounded = math.isfinite(lower) and math.isfinite(upper) and status != "infeasible"
    gap = f"; relative gap {(upper - lower) / max(abs(upper), 1e-12):.2g}" if is_bounded and upper > lower else ""
    return "\n\n".join(
        [f"**{status}**: {bounds}{gap}", *more, f"*{title}*", CLASHES if status == "infeasible" else LEGEND]
    )


def _decide(count: int) -> str:
    return "1 constraint decides" if count == 1 else f"{count} constraints decide"


def _number(value: float) -> str:
    return f"{value:.8g}" if math.isfinite(value) else ("∞" if value > 0 else "−∞")


def verdict_lines(event: sr.RunFinished) -> list[str]:
    """Describe in words how the run ended."""
    lines = [event.message] if event.message else []
    result = event.result
    if result is not None and result.decision is not None:
        lines.append(f"cost J = {result.cost:.8g}; {_decide(len(result.indices))}, found in {event.seconds:.2f} s")
    # of an infeasible result the drawing says what is missed; of two sides the worst constraint has the sum
    if result is not None and result.worst is not None and result.worst.constraint and result.status != "infeasible":
        lines.append(_worst_words(result, result.worst))
    return lines


def _worst_words(result: sr.Result, worst: Any) -> str:
    """Describe the worst case, in agreement with what was proven of it."""
    at = f" at t = {worst.time:.5g}" if isinstance(worst, sr.Witness) and worst.time is not None else ""
    proven = any(proof.family == worst.constraint and proof.verdict == "proven" for proof in result.proofs)
    if worst.violation <= 0.0:
        return f"worst case: {worst.constraint} holds with {-worst.violation:.2e} to spare{at}"
    if proven or result.status in ("certified", "verified"):
        return (
            f"worst case: {worst.constraint} holds to within {worst.violation:.1e}{at}; "
            "at most 1e-9 of its own unit counts as none"
        )
    return f"worst case: {worst.constraint} is violated by {worst.violation:.3g}{at}"
