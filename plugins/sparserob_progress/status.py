"""Status of a run, gathered from its events, and the lines that report it."""

from __future__ import annotations

import math
import time
from typing import Final

import sparserob_core as sr

LABEL: Final = 9  # characters

UNSAID = ("stands", "cycle", "move")  # what a walk notes for pictures


class Status:
    """The latest events of a run. To receive one costs microseconds; the text is put together when it is shown."""

    def __init__(self, title: str) -> None:
        self.title, self.started = title, time.monotonic()
        self.round: sr.RoundFinished | None = None
        self.searched: sr.EvaluationsFinished | None = None
        self.proving: sr.ProofProgress | None = None
        self.now = ""  # what goes on beside rounds, or after the method
        self.lower, self.upper, self.gap, self.proven = -math.inf, math.inf, math.inf, math.inf
        self.phase = "relax"  # with a relaxed program every method begins
        self.result: sr.Result | None = None

    @property
    def elapsed(self) -> float:
        """Seconds since the run began."""
        return time.monotonic() - self.started

    def receive(self, event: sr.Event) -> None:
        """Take note of an event."""
        match event:
            case sr.RoundFinished():
                self.round, self.proving, self.now, self.phase = event, None, "", "relax"
                self.lower = max(self.lower, event.lower_bound)
                self.upper = min(self.upper, math.inf if event.simplified else event.upper_bound, event.proven)
                self.gap, self.proven = math.inf if event.simplified else event.gap, event.proven
            case sr.EvaluationsFinished():
                self.searched, self.proving, self.phase = event, None, "search"
                self.lower = max(self.lower, event.lower_bound)
            case sr.ProofProgress():
                self.searched, self.proving, self.phase = None, event, "proof"
            case sr.StageProgress():
                self.searched, self.proving, self.now = None, None, event.text
                self.phase = event.text.partition(":")[0]
            case sr.StudyProgress():
                self.searched, self.proving, self.now = None, None, event.text
                self.phase = event.text.partition(":")[0] if event.phase else ""
                if event.result is not None:
                    self._ended(event.result)

    def _ended(self, result: sr.Result) -> None:
        """Take note of what the method has returned: from now on its bounds are those of the run."""
        self.result = result
        self.lower, self.upper, self.gap = result.lower_bound, result.upper_bound, result.gap
        self.proven = result.upper_bound

    def parts(self) -> list[tuple[str, str]]:
        """Return what is known, as labels and texts of less than 70 characters."""
        lines = [("phase", self.phase)] if self.phase else []
        if self.round or self.searched or self.result:
            lines.append(("bounds", _bounds(self.lower, self.upper, self.gap, self.proven)))
        if self.round is not None:
            lines += [("round", _round(self.round)), ("", _work(self.round))]
            if self.result is None and math.isfinite(self.proven):
                lines.append(("proven", f"a control of cost {_number(self.proven)}; a better one is sought"))
        if self.searched is not None:
            lines.append(("search", _search(self.searched)))
            notes = _notes(self.searched)
            lines += [("", notes)] if notes else []
        if self.proving is not None:
            lines.append(("proof", _proof(self.proving)))
            lines += [("stuck", self.proving.hindrance)] if self.proving.hindrance else []
        if self.now:
            lines.append(("now", self.now))
        return lines

    def last(self, event: sr.Event) -> str:
        """Return one event in one line."""
        match event:
            case sr.RoundFinished():
                bounds = _bounds(event.lower_bound, event.upper_bound, event.gap, event.proven)
                proven = f"  proven {_number(event.proven)}" if math.isfinite(event.proven) else ""
                return f"round {_round(event)}  {bounds}{proven}  {_work(event)}"
            case sr.EvaluationsFinished():
                return "  ".join(["search " + _search(event), _notes(event)]).strip()
            case sr.ProofProgress():
                return f"proof {_proof(event)}"
            case sr.StageProgress() | sr.StudyProgress():
                return event.text
            case _:
                return type(event).__name__

    def line(self) -> str:
        """Return the whole status in one line."""
        summary = "; ".join(f"{label} {text}".strip() for label, text in self.parts())
        return f"{duration(self.elapsed)}  {summary}"


def duration(seconds: float) -> str:
    """Write a time in three figures or so: 12.3 s, 4 min 05 s, 2 h 03 min."""
    if seconds < 60.0:
        return f"{seconds:.1f} s"
    minutes, remainder = divmod(round(seconds), 60)
    return f"{minutes} min {remainder:02d} s" if minutes < 60 else f"{minutes // 60} h {minutes % 60:02d} min"


def _bounds(lower: float, upper: float, gap: float, proven: float) -> str:
    if not (math.isfinite(lower) and math.isfinite(upper)):
        return f"lower {_number(lower)}  upper {_number(upper)}"
    gap_text = f"  gap {gap:.1e}" if math.isfinite(gap) else ""
    standing = "proven" if proven <= upper else "to be proven"
    return f"lower {_number(lower)}  upper {_number(upper)} ({standing}){gap_text}"


def _round(event: sr.RoundFinished) -> str:
    unit = f" {event.measured}" if event.measured else ""
    where = f"{unit} in {event.worst_family}" if event.worst_family else ""
    cost = "" if math.isnan(event.cost) else f"  cost {_number(event.cost)}"
    return f"{event.round}{cost}  violation {event.violation:.1e}{where}  eps {event.epsilon:.1e}"


def _work(event: sr.RoundFinished) -> str:
    of = "  of the simplified program" if event.simplified else ""
    rate = f" at {_rate(event.relaxed_programs, event.seconds)}/s" if event.seconds > 0.0 else ""
    return f"{event.active_indices} cuts  {event.relaxed_programs} relaxed programs{rate}{of}"


def _search(event: sr.EvaluationsFinished) -> str:
    subject = (
        f"of {event.family}  largest violation"
        if event.family
        else f"{event.round}{_stage(event)}  best g"
        if event.round
        else "  best"
    )
    limit = f" of {event.budget}" if event.budget else ""
    text = (
        f"{subject} {_number(event.best_value)}  {event.total}{limit} evaluations  "
        f"{_rate(event.total, event.seconds)}/s"
    )
    if event.budget and event.total and event.seconds > 0.0:
        text += f"  {duration(max(0.0, event.budget / event.total - 1.0) * event.seconds)} left"
    return text.strip()


def _stage(event: sr.EvaluationsFinished) -> str:
    weight = "" if math.isnan(event.epsilon) else f"  eps {event.epsilon:.1e}"
    return weight + ("  polish" if event.phase == "polish" else "")


def _notes(event: sr.EvaluationsFinished) -> str:
    """Return the scalars that the maximiser has noted since the last event; of what a walk accepted, the share of the
    moves that changed the value."""
    notes = []
    for name, rows in event.batch.notes.items():
        if name == "accepted":
            share = event.batch.acceptance
            notes += [] if math.isnan(share) else [f"accepted {share:.0%}"]
        elif name not in UNSAID:
            notes.append(f"{name} {rows[-1][1]:.3g}")
    return "  ".join(notes)


def _proof(event: sr.ProofProgress) -> str:
    rate = f" at {_rate(event.examined, event.seconds)}/s" if event.examined and event.seconds > 0.0 else ""
    examined = f"  {event.examined} examined{rate}" if event.examined else ""
    earlier_bound = "" if math.isnan(event.bound_before) else f", half a minute ago {event.bound_before:.1e}"
    unit = f" {event.measured}" if event.measured else ""
    return (
        f"of {event.family}  cells open {event.cells}{examined}  "
        f"violation not excluded {event.bound:.1e}{unit}{earlier_bound}"
    )


def _rate(count: int, seconds: float) -> str:
    return f"{count / seconds:.3g}" if count < 1000 * seconds else f"{count / seconds:.0f}"


def _number(value: float) -> str:
    return "unknown" if math.isinf(value) else f"{value:.9g}"
