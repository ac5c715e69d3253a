"""The log of decisions, and the page that says what is known and what the colours mean."""

from __future__ import annotations

import math

import sparserob_core as sr

CUTS = 12  # cuts of one round that are listed one by one

LEGEND = """
**Reading the pictures.** Blue: the control and the states. Blue band: where disturbance and parameters can push them.
Hatched red: forbidden. Yellow: what the worst case does. Pink: the moments at which a constraint is active; they are
why the control is not zero. The pink curve is how hard these constraints push the control: it acts where the push
leaves the dashed band, and switches where it comes back.
"""


def round_lines(event: sr.RoundFinished) -> list[str]:
    """One round in words: its bounds, what is violated, and the cuts that come of it."""
    violated = (
        f"{event.worst_family} is violated by {event.violation:.2e}"
        if event.violation > 0
        else f"margin {-event.violation:.2e}"
    )
    bound = f"lower bound {event.lower_bound:.7g}" + (
        f", upper bound {event.upper_bound:.7g}" if math.isfinite(event.upper_bound) else ""
    )
    lines = [f"round {event.round}: {bound}; {violated}; epsilon {event.epsilon:.1e}"]
    for word, cuts in (("+", event.added), ("-", event.dropped)):
        lines += [f"{word} {cut_words(cut)}" for cut in cuts[:CUTS]]
        if len(cuts) > CUTS:
            lines.append(f"{word} and {len(cuts) - CUTS} more")
    return lines


def cut_words(cut: sr.Cut) -> str:
    """A constraint at an index."""
    shown = ", ".join(f"{value:.5g}" for value in cut.index[:4]) + (", ..." if len(cut.index) > 4 else "")
    return f"{cut.family} at ({shown}), side {cut.row + 1}"


def page(title: str, status: str, lower: float, upper: float, more: list[str]) -> str:
    """The page in Markdown."""
    bounds = (
        f"{_number(lower)} ≤ J* ≤ {_number(upper)}" if math.isfinite(lower) or math.isfinite(upper) else "no bound yet"
    )
    return "\n\n".join([f"### {title}", f"**{status}**: {bounds}", *more, LEGEND])


def _number(value: float) -> str:
    return f"{value:.8g}" if math.isfinite(value) else ("∞" if value > 0 else "−∞")


def verdict_lines(event: sr.RunFinished) -> list[str]:
    """What the run ended with."""
    lines = [event.message] if event.message else []
    result = event.result
    if result is not None and result.decision is not None:
        lines.append(
            f"cost J = {result.cost:.8g}; {len(result.indices)} constraints decide, found in {event.seconds:.2f} s"
        )
    if result is not None and result.worst is not None:
        worst = result.worst
        side = "violated by" if worst.violation > 0 else "kept with a margin of"
        at = f" at t = {worst.time:.5g}" if isinstance(worst, sr.Witness) and worst.time is not None else ""
        lines.append(f"worst case: {worst.constraint} {side} {abs(worst.violation):.2e}{at}")
    return lines
