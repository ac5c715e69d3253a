"""Recorder of a study, which turns its events into a recording, in the process that does all the work."""

from __future__ import annotations

import math
import time
from collections import Counter, deque
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from textwrap import shorten
from typing import Any, final
from zlib import crc32

import numpy as np

import sparserob_core as sr
from sparserob_rerun.drawing import palette as ink
from sparserob_rerun.drawing.canvas import Axes, Drawing, view
from sparserob_rerun.study import board
from sparserob_rerun.study.board import Board, number
from sparserob_rerun.study.side_by_side import SideBySide, folder_of_runs
from sparserob_rerun.study.side_by_side import tab as side_by_side
from sparserob_rerun.study.statuses import mark, named, plainly, said

LAYERS = ("hatch", "curve", "frame", "bounds", "marks")
PICTURE_EVERY, SHARE, RAREST, SPARE = 0.5, 0.005, 60.0, 20.0
"""Seconds between two pictures; a share of the study's time, and these seconds at most; and how many times the
processor time of one."""
LARGE = 1000.0  # points from which on pictures are rarer, for they are larger
SHOWN = 8  # points whose bounds are drawn
LETTERS, NAME = 300, 32  # of why a point failed, and of its name beside its bounds
LISTED = 24  # points that are listed as running, or as the newest ones
LEFT, WIDTH, ROW = 250.0, 440.0, 26.0
EXTENT = (0.0, LEFT + WIDTH + 130.0, -50.0, SHOWN * ROW + 60.0)
MAP = "**Reading the map.** Each point has the colour and the mark of its status, as named below the map."
COLOURS = "Green: a proven lower bound of the least cost J\\*; red: an upper bound."


@final
@dataclass(frozen=True, eq=False)
class StudyOpening:
    """Facts about a study that its recording knows at the beginning; it never makes the study wait."""

    event: sr.SweepStarted
    waits: bool = False

    @property
    def application(self) -> str:
        """Name of the viewer's application: it keeps one arrangement for each."""
        kind = "comparison" if self.event.arrangement == "runs" else "study"
        return f"sparserob {kind} {crc32(repr((list(self.event.axes), self.event.arrangement)).encode()):08x}"


@final
class StudyRecorder:
    """Recorder of the events of one study in a stream that is already open."""

    rest, urgent, behind, ended = math.inf, False, False, math.inf

    def __init__(self, rr: Any, stream: Any, opening: StudyOpening) -> None:
        self.rr, self.stream, self.event, self.opening = rr, stream, opening.event, opening
        self.board, self.broken = Board(self.event), dict[str, str]()
        self.rows: dict[int, Mapping[str, Any]] = dict(self.event.rows)
        self.newest: deque[int] = deque(self.rows, maxlen=board.LINES)
        self.running: dict[int, tuple[int, float, float]] = {}
        searched = self.event.arrangement == "search"
        folder = folder_of_runs(self.event)
        self.beside = None if folder is None else SideBySide(rr, stream, folder)
        self.text = "its points are found on the way" if searched else self._done()
        self.over = ""
        self.seconds, self.next = 0.0, 0.0
        if self.beside is not None:  # what is told is seen on the timeline of their evaluations too
            stream.set_time("evaluation", sequence=0)
        stream.send_recording_name(self.event.title)
        stream.send_property("study", rr.AnyValues(title=[self.event.title], axes=list(self.event.axes)))
        self._tell(f"{self._noun}: {self.event.title}")
        if self.rows:
            self._tell(f"{len(self.rows)} points were finished before")
        self._picture()

    def receive(self, event: sr.Event) -> None:
        """Log one event."""
        match event:
            case sr.SweepProgress():
                self.text = event.text
                if event.found:
                    self.event = replace(self.event, points=[*self.event.points, *event.found])
                    self.board = Board(self.event)
                self.running = {point: self.running.get(point, (0, -np.inf, np.inf)) for point in event.now}
                self._move(event.seconds)
                if event.row is not None:
                    self._row(event.places, event.row)
            case sr.PointProgress():
                self.running[event.point] = (event.round, event.lower_bound, event.upper_bound)
                self._move(event.seconds)
            case sr.SweepFinished():
                self._finished(event)
                return
        if time.monotonic() >= self.next:
            self._picture()
        else:
            self.rest = max(0.0, self.next - time.monotonic())

    @property
    def arrangement(self) -> Any:
        """Present arrangement of all panels."""
        return layout(self.opening, self.beside)

    def idle(self) -> None:
        """Draw what came since the last picture."""
        if math.isfinite(self.rest) and time.monotonic() >= self.next:
            self._picture()

    def say(self, line: str, level: str = "INFO") -> None:
        """Write a line of the log."""
        self.stream.log("log", self.rr.TextLog(line, level=level))

    def finish(self) -> None:
        """Do nothing: nothing is left to be done after the last event."""

    @property
    def _noun(self) -> str:
        return {"search": "search", "runs": "comparison"}.get(self.event.arrangement, "study")

    def _done(self) -> str:
        return f"{len(self.rows)} of {len(self.event.points)} points done"

    def _tell(self, line: str) -> None:
        self._move(self.seconds)
        self.say(line)

    def _move(self, seconds: float) -> None:
        """Move the timelines forward, never back."""
        self.seconds = max(self.seconds, seconds)
        self.stream.set_time("points", sequence=len(self.rows))
        self.stream.set_time("time", duration=self.seconds)

    def _row(self, places: Sequence[int], row: Mapping[str, Any]) -> None:
        for point in places:
            self.rows[point] = row
            self.running.pop(point, None)
            if point in self.newest:
                self.newest.remove(point)
            self.newest.appendleft(point)
        self._move(self.seconds)
        self.say(
            self._line(places[0]),
            {"failed": "ERROR", "refuted": "WARN", "undecided": "WARN"}.get(str(row["status"]), "INFO"),
        )

    def _finished(self, event: sr.SweepFinished) -> None:
        """Take over all rows that the study ended with, whatever was lost before, and draw the last picture."""
        new_points = [point for point in event.rows if point not in self.rows]
        self.rows, self.running = dict(event.rows), {}
        self.newest = deque([*new_points, *(point for point in self.newest if point in self.rows)], maxlen=board.LINES)
        self.over = f"stopped: {event.stopped}" if event.stopped else f"the {self._noun} is over"
        self.text = event.answer or f"{len(self.rows)} of {len(self.event.points)} points have an answer or an error"
        self._move(event.seconds)
        self._picture()
        if self.beside is not None:
            self._draw("the runs side by side", self.beside.finish)
            self._draw("the arrangement", lambda: self.stream.send_blueprint(self.arrangement))
        self.say(f"{self.over}; {self.text}: {self._counts()}", "WARN" if event.stopped else "INFO")

    def _picture(self) -> None:
        """Draw everything anew, and set the moment from which on the next picture may come."""
        spent, self.rest = time.thread_time(), math.inf
        for panel, task in (
            ("the map", self._map),
            ("the bounds", self._bounds),
            ("what is known", self._page),
            ("the newest points", self._lists),
            ("the runs side by side", self._runs),
        ):
            self._draw(panel, task)
        spent = time.thread_time() - spent
        large = max(1.0, len(self.event.points) / LARGE)
        pause = max(PICTURE_EVERY, large * min(SHARE * self.seconds, RAREST), SPARE * spent)
        self.next = time.monotonic() + pause

    def _draw(self, panel: str, task: Callable[[], object]) -> None:
        """Draw a panel; one that fails is named in the log, once, and is left out from then on."""
        if panel in self.broken:
            return
        try:
            task()
        except Exception as error:  # noqa: BLE001  a panel less is better than no recording
            self.broken[panel] = f"{panel} could not be drawn: {type(error).__name__}: {error}"
            self.say(f"{self.broken[panel]}; the rest goes on", "WARN")

    def _runs(self) -> None:
        if self.beside is not None:
            self.beside.draw(self.rows)

    def _map(self) -> None:
        if self.board.kind == "table":
            self._markdown("study/table", self.board.table(self.rows, list(self.newest)))
            return
        self.board.draw(self.rows, list(self.running)).log(self.rr, self.stream, "study/map", layers=LAYERS)
        centres, colours = self.board.boxes
        if centres:
            self.stream.log(
                "study/map/cells",
                self.rr.Boxes2D(
                    centers=np.array(centres),
                    half_sizes=np.tile(self.board.half, (len(centres), 1)),
                    colors=colours,
                    radii=self.board.thick,
                    draw_order=1.0,
                ),
            )

    def _bounds(self) -> None:
        """Draw the ranges of the points that run, and of those that have just finished, on one axis of costs."""
        drawing = Drawing()
        running = list(self.running)[:SHOWN]
        points = [*running, *(point for point in self.newest if point not in self.running)][:SHOWN]
        finite_bounds = [bound for point in points for bound in self._range(point) if math.isfinite(bound)]
        low, high = (min(finite_bounds), max(finite_bounds)) if finite_bounds else (0.0, 1.0)
        axes = Axes(LEFT, 0.0, WIDTH, SHOWN * ROW, board.about(low, high, 0.08), (0.0, 1.0))
        bottom = axes.top + axes.height
        drawing.line("frame", np.array([[LEFT, bottom], [LEFT + WIDTH, bottom]]), ink.GREY, 1.0)
        if finite_bounds:
            for value in (low, high) if high - low > board.NARROW * max(abs(low), abs(high)) else (low,):
                x = float(axes.at(value, 0.0)[0, 0])
                drawing.line("frame", np.array([[x, bottom], [x, bottom + 5]]), ink.GREY, 1.0)
                drawing.text(x, bottom + 15, f"{value:.6g}", ink.GREY)
        drawing.text(LEFT + WIDTH / 2, bottom + board.NAMED, "bounds on the least cost J*", ink.GREY)
        for line, point in enumerate(points):
            self._one(drawing, axes, (line + 0.5) * ROW, point)
        drawing.text((LEFT + WIDTH) / 2, -20.0, self._heading(len(points)))
        drawing.log(self.rr, self.stream, "study/bounds", layers=LAYERS)

    def _heading(self, shown: int) -> str:
        if not shown:
            return "no point has begun yet" if not self.over else "no point was finished"
        if self.over:
            return "the points that were finished last"
        if self.event.parallel:
            return "bounds of points that run are known when they end; those of the newest"
        return "the point that runs, and those that were finished before it"

    def _one(self, drawing: Drawing, axes: Axes, y: float, place: int) -> None:
        """Draw the range of one point: its name at the left, its status at the right."""
        lower, upper = self._range(place)
        status = "running" if place in self.running else str(self.rows[place]["status"])
        name = self._named(place)
        if len(name) > NAME:  # the values tell points apart, the keys do not
            name = ", ".join(map(said, self.event.points[place]))
        drawing.text(LEFT / 2 - 5, y, name if len(name) <= NAME else f"{name[: NAME - 3]}...")
        mark(drawing, np.array([LEFT + WIDTH + 24.0, y]), status)
        drawing.text(LEFT + WIDTH + 44.0 + 4.0 * len(status), y, status)
        ends = [float(axes.at(bound, 0.0)[0, 0]) if math.isfinite(bound) else math.nan for bound in (lower, upper)]
        if not any(map(math.isfinite, ends)):
            words = "no bound" if status != "running" else "no bound yet"
            words = "no control meets the constraints" if status == "infeasible" else words
            drawing.text(LEFT + WIDTH / 2, y, words, ink.GREY)
            return
        left, right = (
            end if math.isfinite(end) else edge for end, edge in zip(ends, (LEFT, LEFT + WIDTH), strict=True)
        )
        line = np.array([[left, y], [right, y]])
        if all(map(math.isfinite, ends)):
            drawing.line("bounds", line, ink.SKY, 2.0)
        else:
            drawing.dashed("bounds", line, ink.SKY)
        for end, colour, reach in zip(ends, (ink.GREEN, ink.VERMILLION), (9.0, -9.0), strict=True):
            if math.isfinite(end):  # one below the line and one above it, for they meet
                drawing.line("marks", np.array([[end, y], [end, y + reach]]), colour, 3.0)

    def _named(self, place: int) -> str:
        """Name a point in words; of a search with all digits, by which values come close to one another."""
        if self.event.arrangement == "search":
            return f"at {float(self.event.points[place][0]):.9g}"
        return named(self.event.axes, self.event.points[place])

    def _range(self, place: int) -> tuple[float, float]:
        """Return the bounds of a point, infinite where there are none."""
        if place in self.running:
            return self.running[place][1:]
        row = self.rows[place]
        if row["status"] == "infeasible":
            return -math.inf, math.inf
        lower, upper = row.get("lower_bound"), row.get("upper_bound")
        return -math.inf if lower is None else lower, math.inf if upper is None else upper

    def _page(self) -> None:
        state = self.over or self.text
        paragraphs = [self.text] if self.over else []
        paragraphs += [self._counts()] if self.rows else []
        if not self.over:
            names = [self._line(point) for point in list(self.running)[:LISTED]]
            running = f"**Running now: {len(self.running)}**"
            paragraphs += [running if names else "No point is known to run at this moment."]
            paragraphs += ["\n".join(f"- {plainly(name)}" for name in names)] if names else []
        title = f"### {plainly(self.event.title)}"
        legend = [COLOURS] if self.board.kind == "table" else [f"{MAP} {COLOURS}"]
        self._markdown("study/state", "\n\n".join([title, f"**{plainly(state)}**", *paragraphs, *legend]))

    def _lists(self) -> None:
        lines = [self._line(point) for point in list(self.newest)[:LISTED]]
        self.stream.log("study/newest", self.rr.TextDocument("\n".join(lines) or "no point is finished yet"))

    def _line(self, place: int) -> str:
        """Describe a point in words."""
        name = self._named(place)
        if place in self.running:
            round_number, lower, upper = self.running[place]
            if self.event.parallel:
                return name
            is_bounded = math.isfinite(lower) or math.isfinite(upper)
            bounds = f"{number(lower, '−∞')} ≤ J* ≤ {number(upper, '∞')}" if is_bounded else "no bound yet"
            return f"{name}: round {round_number}, {bounds}"
        row = self.rows[place]
        cost = f", cost {number(row['cost'])}" if row.get("cost") is not None else ""
        reason = f": {shorten(str(row.get('message')), LETTERS)}" if row["status"] == "failed" else ""
        return f"{name}: {row['status']}{cost}{reason}"

    def _counts(self) -> str:
        counts = Counter(str(row["status"]) for row in self.rows.values())
        return ", ".join(f"{count} {status}" for status, count in sorted(counts.items())) or "none"

    def _markdown(self, path: str, text: str) -> None:
        self.stream.log(path, self.rr.TextDocument(text, media_type="text/markdown"))


def layout(opening: StudyOpening, beside: SideBySide | None = None) -> Any:
    """Build the blueprint. A study has its map and its bounds, with words of what is known; runs of one problem have
    what is known of them side by side; both have the log."""
    import rerun.blueprint as rrb

    compared = opening.event.arrangement == "runs"
    tabs = [] if compared else [_study(rrb, opening.event)]
    tabs += [side_by_side(beside)] if folder_of_runs(opening.event) is not None else []
    log = rrb.TextLogView(
        origin="/log",
        name="Log",
        columns=rrb.TextLogColumns(timeline_columns=["points"], text_log_columns=["Body"]),
    )
    return rrb.Blueprint(
        rrb.Tabs(*tabs, log, active_tab=0),
        rrb.TimePanel(state="collapsed", timeline="evaluation" if compared else "time", play_state="following"),
        auto_layout=False,
        auto_views=False,
        collapse_panels=True,
    )


def _study(rrb: Any, event: sr.SweepStarted) -> Any:
    if Board(event).kind == "table":
        first = rrb.TextDocumentView(origin="/study/table", name="The newest points of the study")
    else:
        first = view("/study/map", "Status, cost J and relative gap of every point", board.EXTENT)
    words = rrb.Vertical(
        rrb.TextDocumentView(origin="/study/state", name="What is known"),
        rrb.TextDocumentView(origin="/study/newest", name="Finished points, the newest first"),
        row_shares=[1, 1],
    )
    pictures = rrb.Vertical(first, view("/study/bounds", "Bounds on the cost", EXTENT), row_shares=[3, 2])
    return rrb.Horizontal(pictures, words, name="Study", column_shares=[5, 3])
