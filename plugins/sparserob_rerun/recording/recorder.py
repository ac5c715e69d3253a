"""Recorder of a run, which turns events into a recording, in the process that does all the work."""

from __future__ import annotations

import json
import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, final

import numpy as np

import sparserob_core as sr
from sparserob_rerun.drawing.palette import Floats
from sparserob_rerun.drawing.timelines import Timelines
from sparserob_rerun.exchange.clash import draw_clash, extent
from sparserob_rerun.exchange.rounds import Rounds, mapped, shown_families, told_by_result, told_by_round
from sparserob_rerun.options import LandscapeOptions
from sparserob_rerun.physics.physics import Physics
from sparserob_rerun.recording import words
from sparserob_rerun.recording.layout import Shown, layout
from sparserob_rerun.recording.waiting import BOUNDS, CLASH, CONTROL, LANDSCAPE, VIOLATIONS, Waiting
from sparserob_rerun.search.explorer import VISIBLE, Aim, Explorer
from sparserob_rerun.search.projection import Projector
from sparserob_rerun.search.search import SearchView
from sparserob_rerun.search.terrain import Terrain
from sparserob_rerun.search.way import Stage

SEEN = 10  # evaluations between two pictures of the way
PICTURE_EVERY, SPARE = 1.0, 10.0
"""Seconds between them, and how many times the processor time of one. Ten times as many, and the control stands still
for seconds; a tenth, and pictures take as much of a processor as the search."""
ARRANGED = 100
"""Evaluations of a search after which its panels are arranged: then the maximiser has told all that it tells. With a
tenth they are arranged again for every word of it, in as many kilobytes as a minute of the search takes; with ten times
as many a search of another weight has no panel for seconds."""
PICTURES = 60  # rounds whose physics is drawn; of later ones every tenth
PROOF = "proof of"
LATE = 8.0
"""Seconds behind the run from which on rounds have no pictures. Ten times as many, and what is seen is of a minute ago;
with a tenth a busy machine leaves out rounds."""
CATCHING_UP = 1.0
"""Seconds after the end of the run in which rounds that are still to be drawn have pictures. Ten times as many, and a
run of two seconds takes twelve; a tenth, and the first rounds of a short run are not to be seen."""
COARSE = 0.3
"""Seconds of processor time that a run which is over leaves to a first, coarse landscape on any machine. Ten times as
many, and a busy machine ends seconds later; a tenth, and it shows no landscape of a short run."""
PATIENT = "landscape.patience is too short for the robust programs of a policy"
KEPT = "the directory does not hold the rows that prove the bound of the policy, through which it would go"
LINES = 24  # of the log that are on the first screen
PROOFS = 12  # lines about the proof of one family
SLOTS = 16  # active constraints at most that make the tuple of a method without one


@final
@dataclass(frozen=True, eq=False)
class Opening:
    """Facts about a run that its recording knows at the beginning. Without an ``inspection`` it is read from the
    ``directory``, if there is one. ``waits``: the run is over, and waits for its recording; else it ``began`` at this
    moment of the machine's clock."""

    title: str
    directory: Path | None
    inspection: sr.Inspection | None
    landscape: LandscapeOptions | None
    waits: bool = False
    began: float = field(default_factory=time.monotonic)

    def answers(self) -> sr.Inspection | None:
        """Return the inspection that answers questions about the run."""
        if self.inspection is not None or self.directory is None:
            return self.inspection
        return sr.Inspection.read(self.directory)


@final
class Recorder:
    """Recorder of the events of one run in a stream that is already open."""

    def __init__(self, rr: Any, stream: Any, opening: Opening, shown: Shown, inspection: sr.Inspection | None) -> None:
        self.rr, self.stream, self.opening, self.inspection = rr, stream, opening, inspection
        self.timelines = Timelines(rr, stream)
        self.timelines.move()  # what is logged before is on no timeline
        self.rounds = Rounds(rr, stream, inspection)
        problem = None if inspection is None else inspection.problem
        self.physics = (
            Physics(rr, stream, inspection, shown.searches) if inspection is not None and problem is not None else None
        )
        time_unit, cost_unit = ("", "") if problem is None else (problem.names.time, problem.cost_unit)
        self.terrain = Terrain(rr, stream, time_unit, cost_unit)
        self.explorer = Explorer(self._landscape, inspection, opening.landscape, opening.waits)
        self.search, self.projector = SearchView(rr, stream, self.timelines), Projector()
        self.stages = list[Stage]()
        self.shown, self.searches, self.began = shown, shown.searches, 0.0
        self.best_value, self.unseen, self.behind, self.way = -np.inf, 0, False, False
        self.relaxed: tuple[tuple[int, float], sr.RelaxedValue] | None = None
        self.optimal: Aim | None = None  # the tuple whose control is shown
        self.heard = self.next = time.monotonic()
        self.ended = np.inf  # the moment at which the run was over, once it is
        self.patience = 0.0 if opening.landscape is None else opening.landscape.patience
        self.lower, self.upper, self.over = -np.inf, np.inf, -1.0
        self.exact: float | None = None
        self.concluded = False
        self.answerable = True  # whether it is known through which rows the landscape of a policy goes
        self.proofs: dict[str, int] = {}
        self.broken: dict[str, str] = {}
        self.drawn, self.said = False, deque[str](maxlen=LINES)
        self.waiting = Waiting(rr, stream, shown)
        self.state = ""
        names, colours = list(words.STATES), [list(colour) for colour in words.STATES.values()]
        stream.log("state", rr.StateConfiguration(values=names, labels=names, colors=colours), static=True)
        stream.log("howto", rr.TextDocument(words.SIGNALS), static=True)
        self.say(f"run: {opening.title}")
        self._describe(opening.title)
        self._page("solving", [])

    def _describe(self, title: str) -> None:
        """Give the recording its name, and say of what it is. The name begins with what two runs of one problem differ
        in, because a list of recordings shows its first words."""
        properties: dict[str, Any] = {"title": [title]}
        if self.inspection is None:
            self.stream.send_recording_name(title)
        else:
            config = self.inspection.config
            searcher, seed = config["maximiser" if self.searches else "method"]["name"], config.get("seed", 0)
            self.stream.send_recording_name(f"{searcher}, seed {seed}: {title}")
            properties |= {"config": [json.dumps(config, default=str)], "seed": [seed]}
        self.stream.send_property("run", self.rr.AnyValues(**properties))

    def _conclude(self, event: sr.RunFinished) -> None:
        """Say how the run has ended."""
        self.concluded, self.shown = True, replace(self.shown, verdict=event.status)
        result, properties = event.result, dict[str, Any](status=[event.status], seconds=[event.seconds])
        if result is not None:
            properties |= {"lower_bound": [result.lower_bound], "upper_bound": [result.upper_bound]}
            properties |= {"cost": [float(result.cost)]} if result.decision is not None else {}
        self.stream.send_property("result", self.rr.AnyValues(**properties))

    def receive(self, event: sr.Event) -> None:
        """Log one event; one of evaluated tuples is a thin one (`thin`)."""
        self.heard = time.monotonic()
        self._go_on(words.state_of(event, self.state))
        match event:
            case sr.EvaluationsFinished():
                self._evaluations(event)
            case sr.RoundFinished():
                self._round(event)
            case sr.ProofProgress():
                self.timelines.move(seconds=event.seconds)
                self.proofs[event.family] = self.proofs.get(event.family, 0) + 1
                if self.proofs[event.family] <= PROOFS:
                    self.say(
                        f"{PROOF} {event.family}: {event.cells} cells open, violation not excluded {event.bound:.1e}",
                        "DEBUG",
                    )
            case sr.RunFinished():
                self._finished(event)

    def _go_on(self, state: str) -> None:
        """Note on the lane what the run does from now on, where it is another thing than before."""
        if state != self.state:
            self.state = state
            self.stream.log("state", self.rr.StateChange(state=state))

    def draw(self, panel: str, task: Callable[..., object], *arguments: Any) -> None:
        """Draw a panel; one that fails is named in the log, once, and is left out from then on."""
        if panel in self.broken:
            return
        try:
            task(*arguments)
            if panel != LANDSCAPE:  # which has its first picture later
                self.waiting.arrived(panel)
        except Exception as error:  # noqa: BLE001  a panel less is better than no recording
            self.broken[panel] = f"{panel} could not be drawn: {type(error).__name__}: {error}"
            self.say(f"{self.broken[panel]}; the rest goes on", "WARN")
            if panel == LANDSCAPE:
                self.explorer.left = 0

    def say(self, line: str, level: str = "INFO") -> None:
        """Write a line of the log."""
        self.stream.log("log", self.rr.TextLog(line, level=level))
        if level != "TRACE":  # the log cuts off what is longer than its column; this page does not
            if self.said and line.startswith(PROOF) and self.said[0].startswith(PROOF):
                self.said.popleft()  # of a proof that goes on, the last line
            self.said.appendleft(line)
            self.stream.log("decisions", self.rr.TextDocument("\n".join(self.said)))

    def mark(self) -> None:
        """Mark on the last landscape where the maximum is, if it was proven and the landscape goes through it, or
        through a tuple whose value is the same to the eye."""
        landscape = self.terrain.known
        if landscape is None or self.exact is None:
            return
        is_same = abs(landscape.value - self.exact) <= VISIBLE * max(1.0, abs(self.exact))
        if is_same or self.explorer.landscape is landscape:
            share = ", with the regulariser's share" if landscape.epsilon > 0.0 else ""
            self.draw(LANDSCAPE, self.terrain.mark, f"proven to be the highest: {self.exact:.6g}{share}")

    def _evaluations(self, event: sr.EvaluationsFinished) -> None:
        if event.total == event.count:
            self.began = self.timelines.seconds
        if event.family:
            self.draw("the search for violations", self.search.separation, event, self.began)
            return
        stage, projection = self._stage(event), self.projector.of(event)
        stage.add(event, projection)
        self.draw("the search", self.search.show, event, stage, self.began, self._moving(event.block), projection)
        self.timelines.move(stage.base + event.total, event.round, self.began + event.seconds)
        if event.best_value > self.best_value or event.total == event.count:
            self.say(f"evaluation {self.timelines.evaluation}: best g {event.best_value:.8g}", "TRACE")
        self.best_value = event.best_value
        if event.best_point.size:
            self.draw(LANDSCAPE, self.explorer.aim, self._best(stage, max(1, event.round)))
        self.unseen += event.count
        if self.opening.waits or (self.pause == 0.0 and not self.behind):
            self._way()

    def _stage(self, event: sr.EvaluationsFinished) -> Stage:
        """Return the search that an event belongs to; a new one where it is the first of it."""
        if not self.stages or event.total == event.count or self.stages[-1].number != event.round:
            if self.stages:
                self._way()
            base = self.timelines.evaluation
            self.stages.append(Stage(event.round, event.epsilon, base - (event.total - event.count), self.began))
            weight = f": epsilon {event.epsilon:.3g}" if np.isfinite(event.epsilon) else ""
            self.say(f"search {max(1, event.round)} begins{weight}")
        return self.stages[-1]

    def _best(self, stage: Stage, number: int) -> Aim:
        at = f"through the best tuple of evaluation {self.timelines.evaluation}"
        return Aim(stage.best.reshape(-1, stage.block), stage.epsilon, stage.best_value, at, number, stage.pair)

    def _way(self) -> None:
        """Draw how far the search has come: the climb, and its way on the landscape."""
        self.unseen, began = 0, time.thread_time()
        if not self.stages:
            return
        stage, self.way = self.stages[-1], True
        self.draw("the way of the search", self.terrain.visit, stage)
        if self.physics is not None and stage.best.size and not self.shown.answers:
            self.draw(CONTROL, self._control, stage)
        if stage.values.size >= ARRANGED or self.concluded:
            self._arrange(stage)
        weight = f"epsilon = {stage.epsilon:.3g}, " if np.isfinite(stage.epsilon) else ""
        if self.exact is None:
            evaluations = self.timelines.evaluation - stage.base
            limit = f" of {stage.budget}" if stage.budget else ""
            line = (
                f"search {max(1, stage.number)}: {weight}evaluation {evaluations}{limit}; best g {stage.best_value:.8g}"
            )
            self.lower = max(self.lower, stage.lower_bound)
            self._page("solving", [line])
        self.next = time.monotonic() + max(PICTURE_EVERY, SPARE * (time.thread_time() - began))

    def _control(self, stage: Stage) -> None:
        """Draw the control that is optimal for the best tuple so far, where its g is visibly higher."""
        aim = self._best(stage, stage.number)
        if self.inspection is None or self.physics is None:
            return
        if self.optimal is not None and not aim.exceeds(self.optimal):
            return
        slots = aim.slots
        if self.relaxed is None or self.relaxed[0] != (len(slots), stage.epsilon):
            key = (len(slots), stage.epsilon)
            self.relaxed = key, self.inspection.relaxed_value(*key)
        self.optimal, g = aim, self.relaxed[1]
        g.at(slots)
        optimum = g.optimum()
        if optimum is not None:
            self.physics.draw(*optimum, None)

    def _arrange(self, stage: Stage) -> None:
        """Give what the search has told since the last arrangement its panels."""
        notes, coordinates = frozenset(self.search.notes), frozenset(self.search.moved)
        stages = tuple((entry.base, entry.epsilon, entry.began) for entry in self.stages) if self.concluded else ()
        if not (notes <= self.shown.told and coordinates <= self.shown.moved and stages == self.shown.stages):
            notes, coordinates = self.shown.told | notes, self.shown.moved | coordinates
            self.shown = replace(self.shown, told=notes, moved=coordinates, stages=stages, budget=stage.budget)
            self.draw("the arrangement of the search", self.stream.send_blueprint, self.arrangement)

    def _landscape(self, landscape: sr.Landscape, aim: Aim) -> None:
        """Draw a landscape at the moment at which it is there, and the way on it."""
        if not self.opening.waits:
            self.timelines.move(seconds=self.timelines.seconds + time.monotonic() - self.heard)
            self.heard = time.monotonic()
        self.waiting.arrived(LANDSCAPE)
        self.terrain.surface(landscape, aim)
        if self.stages:
            self.terrain.visit(self.stages[-1])

    def _moving(self, width: int) -> dict[int, str]:
        """Return the coordinates of an index whose moves are drawn, with their names: neither disturbance nor
        direction."""
        if self.inspection is None:
            return {}
        named = zip(self.inspection.names(width), self.inspection.kinds(width), strict=True)
        return {k: name for k, (name, kind) in enumerate(named) if kind in ("time", "parameter", "index")}

    def idle(self) -> None:
        """Draw what is due, and work on the landscape for a moment."""
        if self.pause == 0.0:
            self._way()
        self.draw(LANDSCAPE, self.explorer.step)

    @property
    def arrangement(self) -> Any:
        """Present arrangement of all panels."""
        return layout(self.shown)

    @property
    def pause(self) -> float:
        """Seconds until the way of the search is to be drawn; infinite where there is nothing new."""
        due = self.unseen >= SEEN or (self.unseen > 0 and not self.way)
        return max(0.0, self.next - time.monotonic()) if due else np.inf

    @property
    def rest(self) -> float:
        """Seconds until there is work; infinite where there is none."""
        return min(self.pause, self.explorer.rest if self.explorer.busy else np.inf)

    @property
    def urgent(self) -> bool:
        """True where the landscape does not wait for a moment without events."""
        return self.explorer.urgent

    def finish(self) -> None:
        """Work on the landscape of the last tuple, so that it is as fine as there is time for. A run that broke off
        does not wait for it."""
        explorer = self.explorer
        if self.opening.landscape is not None and self.over >= 0.0:
            waits = self.opening.waits
            # of a run that is shown again every landscape may take as long; another one wants to end
            seconds = self.patience if waits else self.patience - max(0.0, time.monotonic() - self.ended)
            self.draw(LANDSCAPE, explorer.finish, seconds)
            if explorer.waiting is not None or explorer.urgent:
                seconds = self.patience if waits else self.patience - max(0.0, time.monotonic() - self.ended)
                self.draw(LANDSCAPE, explorer.finish, seconds, 16, COARSE)  # any level is one
            self.mark()
            is_missing = self.shown.landscape and self.terrain.known is None and self.shown.clash is None
            if is_missing and (self.shown.answers or explorer.wrong):
                if not explorer.wrong:
                    self.say(f"no landscape: {PATIENT if self.answerable else KEPT}")
                self.shown = replace(self.shown, landscape=False)
                self.draw("the arrangement", self.stream.send_blueprint, self.arrangement)
        if explorer.wrong:
            self.say(explorer.wrong, "WARN")

    def _round(self, event: sr.RoundFinished) -> None:
        self.timelines.move(None if self.searches else event.relaxed_programs, event.round, event.seconds)
        self.lower = max(self.lower, event.lower_bound)
        self.upper = min(self.upper, np.inf if event.simplified else event.upper_bound, event.proven)
        self.draw(BOUNDS, self.rounds.bounds, event)
        lines = words.round_lines(event, self.inspection)
        for line in lines:
            self.say(line, "INFO" if line is lines[0] else "DEBUG")
        self._page("solving", lines[:1])
        self.draw(LANDSCAPE, self._aim, event)
        if event.decision is None or (event.round > PICTURES and event.round % 10) or self._late(event.seconds):
            return
        cuts, self.drawn = active(event.imposed, event.multipliers), True
        if self.physics is not None:
            self.draw(CONTROL, self.physics.draw, event.decision, cuts, None)
        worst = told_by_round(event)
        self.draw(VIOLATIONS, self.rounds.violations, event.decision, cuts, event.added, worst)

    def _late(self, seconds: float) -> bool:
        """Return whether the recording is so far behind the run that its pictures have to wait for the last one."""
        now = time.monotonic()
        late = now - self.opening.began - seconds > LATE or now - self.ended > CATCHING_UP
        return late and not self.opening.waits

    def _aim(self, event: sr.RoundFinished) -> None:
        """Aim the landscape after a round at the tuple whose surroundings are worth a look: the best of the search, or
        the constraints that are active. A run that is over waits for the landscape of each search."""
        if self.searches and self.stages and self.stages[-1].best.size:
            self.explorer.aim(self._best(self.stages[-1], event.round))
            if self.opening.waits:
                began = time.monotonic()
                self.explorer.finish(0.5 * self.patience, level=4)
                self.patience -= time.monotonic() - began
        elif not self.searches and not self.shown.answers:
            slots = slots_of(active(event.imposed, event.multipliers), self._formulation)
            if slots.size:
                words = f"others as active in round {event.round}"
                if event.simplified:
                    words = "with all of the uncertainty, of which the method has a part"
                self.explorer.aim(Aim(slots, event.epsilon, np.nan, words, event.round))

    def _finished(self, event: sr.RunFinished) -> None:
        self.timelines.move(seconds=event.seconds)
        result = event.result
        lines = words.verdict_lines(event)
        if result is not None:
            self.lower, self.upper = result.lower_bound, result.upper_bound
            self.exact = result.value if event.status == "certified" else None
        self._conclude(event)
        self._page(event.status, lines)  # before anything that takes time
        if result is not None:
            if event.status != "infeasible":
                self.draw(BOUNDS, self.rounds.picture.end, result.lower_bound, result.upper_bound, result.gap)
            self.draw(CLASH, self._clash, result)
            if result.decision is not None and self.physics is not None:
                optimum = (result.decision, result.indices, result.dual.mu, result.dual.cuts)
                self.draw(CONTROL, self.physics.draw, *optimum)
                self.draw("the signals", self.physics.signals, result.decision)
            if result.decision is not None:
                worst = told_by_result(result)
                self.draw(VIOLATIONS, self.rounds.violations, result.decision, result.indices, (), worst)
            # a run that is shown again
            if self.explorer.landscape is None and self.explorer.waiting is None and result.indices:
                if self.shown.answers:  # the rows that prove the bound of a policy, each at its deviation
                    slots = slots_of(list(result.dual.cuts), "literal", len(result.dual.cuts))
                    self.answerable = slots.size > 0
                else:
                    slots = slots_of(list(result.indices), self._formulation)
                aim = Aim(slots, result.epsilon, np.nan, "others as active at the end", self.timelines.round)
                if self.answerable:
                    self.draw(LANDSCAPE, self.explorer.aim, aim)
        self.say(
            f"{event.status}: {event.message}",
            {"failed": "ERROR", "refuted": "WARN", "undecided": "WARN"}.get(event.status, "INFO"),
        )
        if self.exact is not None and self.stages:
            self.draw(
                "the search",
                self.search.exact,
                self.exact,
                result.epsilon if result is not None else 0.0,
                self.stages[-1].base,
            )
        self._way()
        self._page(event.status, lines)

    def _clash(self, result: sr.Result) -> None:
        """Draw what clashes, for an infeasible run, in the place of a control that there is not."""
        strips = [] if self.inspection is None else self.inspection.clash(result)
        if strips:
            draw_clash(self.rr, self.stream, strips)
        if result.status == "infeasible":
            drawn = self.drawn or bool(self.stages)
            has_landscape = self.shown.landscape and self.terrain.known is not None
            self.shown = replace(
                self.shown, clash=extent(strips) if strips else (), drawn=drawn, landscape=has_landscape
            )
            self.stream.send_blueprint(self.arrangement)

    @property
    def _formulation(self) -> str:
        """Formulation of the indices of the landscape, ``literal`` or ``reduced``."""
        return "literal" if self.inspection is not None and self.inspection.literal else "reduced"

    def _page(self, status: str, lines: list[str]) -> None:
        text = words.page(self.opening.title, status, self.lower, self.upper, lines)
        self.stream.log("verdict", self.rr.TextDocument(text, media_type="text/markdown"))


def shown_of(inspection: sr.Inspection | None, landscape: LandscapeOptions | None) -> Shown:
    """Return the contents of the recording of a run."""
    if inspection is None:
        return Shown(None, 0, True, False)
    program, answers = inspection.program, inspection.problem is not None and inspection.program.spread is not None
    families = len(shown_families(program))
    return Shown(
        inspection.problem,
        families,
        inspection.searches,
        landscape is not None,
        answers=answers,
        maps=mapped(program),
    )


def active(cuts: Any, multipliers: Floats) -> list[sr.Cut]:
    """Return the cuts that carry a multiplier, with it."""
    return [replace(cut, multiplier=float(m)) for cut, m in zip(cuts, multipliers, strict=True) if m > 0.0]


def slots_of(cuts: list[sr.Cut], formulation: str, most: int = SLOTS) -> Floats:
    """Return the distinct indices of cuts as a tuple ``(D, width)``, ``most`` of them, the one with the largest
    multiplier first. An index of another formulation gives its first coordinate only, the time, which all of them
    have."""
    ordered = sorted(cuts, key=lambda cut: -cut.multiplier)
    indices = [cut.index if cut.formulation == formulation else cut.index[:1] for cut in ordered]
    width = max(map(len, indices), default=0)
    slots: dict[bytes, Floats] = {}
    for index in indices:
        slot = np.zeros(width)
        slot[: len(index)] = index
        slots.setdefault(np.round(slot, 9).tobytes(), slot)
    return np.array(list(slots.values())[:most]).reshape(-1, width) if slots else np.zeros((0, 0))
