"""Arrangement of the screen when a recording is opened: nothing is left to the viewer's guesses."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, final
from zlib import crc32

from sparserob_rerun.drawing import palette as ink
from sparserob_rerun.drawing.canvas import view
from sparserob_rerun.exchange import bounds, rounds
from sparserob_rerun.physics import feedback, phase, physics
from sparserob_rerun.physics.pages import heading, pages
from sparserob_rerun.search import views as search

if TYPE_CHECKING:
    import sparserob_core as sr


WIDE = 2.0
"""Width over height of a drawing that has the whole width of the screen. With ten times as much a single strip fills
half of its panel; with a tenth many strips are narrow and high above the words."""


@final
@dataclass(frozen=True)
class Shown:
    """Contents of a recording: the run's problem, if it is one of control, how many families, whether tuples are
    searched, and the landscape. Of a search: what the maximiser has ``told`` of itself, and the coordinates that have
    ``moved``. ``stages``: of every search, once all are over, the evaluations before it, its weight epsilon and the
    seconds before it. ``budget``: the evaluations of one, 0 where that is not known. ``clash``, once a run is
    infeasible: the limits of the drawing of what clashes, empty where it cannot be drawn. ``drawn``: whether there were
    decisions before that. ``maps``: how many families have a map of their violation. ``answers``: whether the control
    answers what it measures. ``verdict``: how the run ended, once it has."""

    problem: sr.OptimalControlProblem | None
    families: int
    searches: bool
    landscape: bool
    told: frozenset[str] = frozenset()
    moved: frozenset[str] = frozenset()
    clash: tuple[float, ...] | None = None
    drawn: bool = True
    maps: int = 0
    answers: bool = False
    stages: tuple[tuple[int, float, float], ...] = ()
    budget: int = 0
    verdict: str = ""

    @property
    def violations(self) -> tuple[float, float, float, float]:
        """Left, right, top and bottom of the plots of the violation."""
        return rounds.extent(self.families, self.problem is not None, self.problem.names.time if self.problem else "")

    @property
    def application(self) -> str:
        """Name of the viewer's application: it keeps one arrangement for each, so that what is arranged otherwise has
        another one."""
        kind = "search" if self.searches else "feedback" if self.answers else "exchange"
        problem = self.problem
        features: list[Any] = [self.families, self.maps, self.landscape]
        if problem is not None:
            features += [problem.system.controls, problem.system.states, heading(problem), problem.names.in_plane]
            features += [pages(problem), problem.names.state_units, problem.names.time]
        return f"sparserob {kind} {crc32(repr(features).encode()):08x}"


def layout(shown: Shown) -> Any:
    """Build the blueprint: an overview first, then a tab for each part of the story."""
    import rerun.blueprint as rrb

    columns, shares = _columns(rrb, shown)
    overview = rrb.Horizontal(*columns, name="Overview", column_shares=shares)
    tabs = [overview, _exchange(rrb, shown)]
    if shown.searches:
        tabs.insert(1, search.tab(rrb, shown.told, shown.moved, search.climb(rrb, shown.stages, shown.budget)))
    if shown.problem is not None and len(pages(shown.problem)) > 1:
        tabs.insert(1, _further(rrb, shown.problem))
    if shown.landscape:
        tabs.append(search.surface(rrb))
    if shown.clash is not None:
        overview.name = "Before it was known that nothing is feasible"
        tabs = [_infeasible(rrb, shown, shown.clash), *(tabs if shown.drawn else [])]
    elif shown.problem is not None:
        tabs += [_feedback(rrb, shown.problem)] if shown.answers else []
        tabs += [_signals(rrb), _timeline(rrb, shown.answers)]
    tabs.append(_log(rrb, shown))
    return rrb.Blueprint(
        rrb.Tabs(*tabs, active_tab=0),
        rrb.TimePanel(state="collapsed", timeline="evaluation" if shown.searches else "round", play_state="following"),
        auto_layout=False,
        auto_views=False,
        collapse_panels=True,
    )


def _columns(rrb: Any, shown: Shown) -> tuple[list[Any], list[int]]:
    """Return the panels of the first screen in columns, and how wide these are."""
    words = [rrb.TextDocumentView(origin="/verdict", name="What is known")]
    problem = shown.problem
    plane = [_phase(rrb, problem, shown.searches)] if problem is not None and problem.system.states > 1 else []
    map_words = [rrb.TextDocumentView(origin="/landscape/words", name="The map")] if shown.landscape else []
    plots = [] if shown.problem is None else [_plots(shown.problem, shown.searches)]
    if shown.searches:  # the search is what is seen first: its map has more than half of the screen
        terrain = [_terrain(shown)] if shown.landscape else []
        below = rrb.Horizontal(search.climb(rrb, shown.stages, shown.budget), _lane(rrb, shown), column_shares=[3, 1])
        left = rrb.Vertical(*terrain, below, row_shares=[5, 1][-1 - len(terrain) :])
        right = [rrb.Horizontal(*words, *map_words), *plots, *plane]
        return [left, rrb.Vertical(*right, row_shares=[11, 12, 9][: len(right)])], [2, 1]
    numbers = [_violation(rrb, shown), _bounds(rrb)]
    middle = (
        rrb.Vertical(_terrain(shown), *numbers, row_shares=[10, _room(shown), 5])
        if shown.landscape
        else rrb.Vertical(*numbers)
    )
    words = [*words, *plane, *map_words, _decisions(rrb)]
    heights = [12, *([9] if plane else []), *([9] if map_words else []), 6]
    return [*plots, middle, rrb.Vertical(*words, row_shares=heights)], ([5, 4, 3] if plots else [4, 3])


def _plots(problem: sr.OptimalControlProblem, searches: bool) -> Any:
    first = pages(problem)[0]
    count = len(first.plots)
    return view(f"/{first.path}", heading(problem, searches), physics.extent(count, physics.height(count, searches)))


def _lane(rrb: Any, shown: Shown) -> Any:
    """Return the lane of states, from the beginning of the run on whatever timeline is shown. The verdict, which comes
    at the end of the run, has no width there, and is in the name of the lane."""
    from rerun.encodings import TimeRange

    everything = rrb.TimeRangeBoundary.infinite()
    time_axis = rrb.TimeAxis(view_range=TimeRange(start=everything, end=everything))
    name = f"State: {shown.verdict}" if shown.verdict else "State"
    return rrb.StateTimelineView(origin="/state", name=name, time_view=time_axis)


def _terrain(shown: Shown) -> Any:
    return search.landscape(shown.searches, shown.answers, shown.problem.horizon if shown.problem else 1.0)


def _room(shown: Shown) -> int:
    """Return the height of the plots of violation, as much for one as for another."""
    return 2 + 3 * max(1, min(shown.families, rounds.FAMILIES))


def _decisions(rrb: Any) -> Any:
    return rrb.TextDocumentView(origin="/decisions", name="Decisions, the newest first")


def _log(rrb: Any, shown: Shown) -> Any:
    return rrb.TextLogView(
        origin="/log",
        name="Log",
        columns=rrb.TextLogColumns(
            timeline_columns=["evaluation" if shown.searches else "round"], text_log_columns=["Body"]
        ),
    )


def _phase(rrb: Any, problem: sr.OptimalControlProblem, searches: bool) -> Any:
    pair = phase.pair_of(problem)
    if pair is not None:
        kind = "Phase plane" if problem.names.in_plane is None else "Plane"
        units = problem.names.state_units or [""] * problem.system.states
        across, up = (f"{problem.names.state(state)} in {units[state]}".removesuffix(" in ") for state in pair)
        return view("/physics/phase", f"{kind}: {up} over {across}", phase.extent(problem, searches))
    states = problem.system.states
    name = (
        "State space"
        if states == 3
        else f"State space: {', '.join(problem.names.state(k) for k in range(3))} of {states} states"
    )
    return rrb.Spatial3DView(origin="/physics/phase", name=name, background=list(ink.GROUND[:3]))


def _further(rrb: Any, problem: sr.OptimalControlProblem) -> Any:
    """Return a tab of the controls and states that the first screen has no room for."""
    views = [
        view(f"/{page.path}", page.name(problem.names), physics.extent(len(page.plots))) for page in pages(problem)[1:]
    ]
    return (
        rrb.Horizontal(*views, name="Further signals") if len(views) < 4 else rrb.Grid(*views, name="Further signals")
    )


def _feedback(rrb: Any, problem: sr.OptimalControlProblem) -> Any:
    limits = feedback.extent(problem.system.controls, problem.system.states)
    pictures = view("/feedback", "How the control answers what is measured: red adds, blue takes away", limits)
    words = rrb.TextDocumentView(origin="/feedback/words", name="Reading the pictures")
    return rrb.Vertical(pictures, words, name="Feedback", row_shares=[3, 1])


def _signals(rrb: Any) -> Any:
    """Return a tab of the last decision as bars, which are there on every timeline."""
    legend = rrb.Corner2D.RightTop
    controls = rrb.BarChartView(
        origin="/signals/bars/controls", name="Controls of the last decision over t", plot_legend=legend
    )
    states = rrb.BarChartView(origin="/signals/bars/states", name="Nominal states over t", plot_legend=legend)
    return rrb.Vertical(controls, states, name="Signals")


def _timeline(rrb: Any, answers: bool) -> Any:
    """Return a tab of the series over the time of the system, with a column that says on which timeline they are."""
    legend = rrb.Corner2D.RightTop
    effort = rrb.TimeSeriesView(origin="/signals/effort", name="Size of the controls under disturbances, over t",
                                plot_legend=legend)  # fmt: skip
    series = [
        rrb.TimeSeriesView(origin="/signals/control", name="Controls over t", plot_legend=legend),
        rrb.TimeSeriesView(origin="/signals/states", name="States over t, with their tube", plot_legend=legend),
        *([effort] if answers else []),
    ]
    words = rrb.TextDocumentView(origin="/howto", name="How to see the series")
    return rrb.Horizontal(words, rrb.Vertical(*series), column_shares=[1, 4], name="Timeline t")


def _infeasible(rrb: Any, shown: Shown, clash: tuple[float, ...]) -> Any:
    """Return the tab that says why there is no control, in the place of one that shows it."""
    words = [rrb.TextDocumentView(origin="/verdict", name="What is known"), _decisions(rrb)]
    if not clash:
        return rrb.Horizontal(rrb.Vertical(*words, row_shares=[3, 2]), name="Overview")
    left, right, top, bottom = clash
    drawing = view(
        "/clash",
        "What clashes: red is forbidden; blue, where the control can bring it; "
        "yellow, what the worst disturbance makes of the best",
        (left, right, top, bottom),
    )
    if right - left > WIDE * (bottom - top):
        return rrb.Vertical(drawing, rrb.Horizontal(*words), name="Overview", row_shares=[3, 2])
    return rrb.Horizontal(drawing, rrb.Vertical(*words, row_shares=[3, 2]), name="Overview", column_shares=[5, 3])


def _bounds(rrb: Any) -> Any:
    return view("/rounds/picture/bounds", "Bounds on the cost J (up), round by round (across)", bounds.ONE)


def _violation(rrb: Any, shown: Shown) -> Any:
    return view(
        "/violation/plots",
        "Violation over the indices; orange: new cuts",
        shown.violations,
    )


def _exchange(rrb: Any, shown: Shown) -> Any:
    counts = search.series(
        rrb,
        "/rounds/counts",
        f"Numbers of active indices and of new cuts, after every {'search' if shown.searches else 'round'}",
        legend="left",
    )
    pictures = view("/rounds/picture", "Bounds on the cost, the gap and the violation, round by round", bounds.BOTH)
    left = rrb.Vertical(pictures, counts, row_shares=[2, 1])
    right = [_violation(rrb, shown)]
    if shown.problem is not None and shown.problem.system.parameter_count and shown.maps:
        name = "Violation over time and the first parameter: red is forbidden"
        extent = rounds.extent_of_maps(shown.maps)
        right.append(view("/violation", name, extent, "/violation/maps/** /violation/names/**"))
    below = [_lane(rrb, shown)] if shown.searches else [_decisions(rrb), _lane(rrb, shown)]
    heights = [5] * len(right) + [2] * len(below)
    return rrb.Horizontal(left, rrb.Vertical(*right, *below, row_shares=heights), name="Exchange")
