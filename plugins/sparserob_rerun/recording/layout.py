"""What is on the screen when a recording is opened: nothing is left to the viewer's guesses."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, final

from sparserob_rerun.drawing import palette as ink
from sparserob_rerun.drawing.canvas import view
from sparserob_rerun.exchange import rounds
from sparserob_rerun.physics import physics
from sparserob_rerun.search import views as search

if TYPE_CHECKING:
    import sparserob_core as sr


@final
@dataclass(frozen=True)
class Shown:
    """What a run has to show: its problem, if it is one of control, how many families, whether tuples are searched, and
    the landscape; of a search what the maximiser has ``told`` of itself, and the coordinates that have ``moved``."""

    problem: sr.OptimalControlProblem | None
    families: int
    searches: bool
    landscape: bool
    told: frozenset[str] = frozenset()
    moved: frozenset[str] = frozenset()


def layout(shown: Shown) -> Any:
    """The blueprint: an overview first, then a tab for each part of the story."""
    import rerun.blueprint as rrb

    shares = ([4, 5, 3] if shown.searches else [5, 4, 3]) if shown.problem is not None else [4, 3]
    overview = rrb.Horizontal(*_columns(rrb, shown), name="Overview", column_shares=shares)
    tabs = [overview, _exchange(rrb, shown)]
    if shown.searches:
        tabs.insert(1, search.tab(rrb, shown.told, shown.moved))
    if shown.landscape:
        tabs.append(search.surface(rrb))
    if shown.problem is not None:
        tabs.append(rrb.TimeSeriesView(origin="/signals", name="Signals (choose the timeline t)"))
    return rrb.Blueprint(
        rrb.Tabs(*tabs, active_tab=0),
        rrb.TimePanel(state="collapsed", timeline="evaluation" if shown.searches else "round", play_state="following"),
        auto_layout=False,
        auto_views=False,
        collapse_panels=True,
    )


def _columns(rrb: Any, shown: Shown) -> list[Any]:
    numbers = (
        [search.climb(), *search.notes(rrb, shown.told)] if shown.searches else [_violation(rrb, shown), _bounds(rrb)]
    )
    middle = (
        rrb.Vertical(search.landscape(), *numbers, row_shares=[5, 4, 2, 2][: 1 + len(numbers)])
        if shown.landscape
        else rrb.Vertical(*numbers)
    )
    words = [rrb.TextDocumentView(origin="/verdict", name="What is known"), _log(rrb, shown)]
    if shown.problem is None:
        return [middle, rrb.Vertical(*words, row_shares=[2, 3])]
    if shown.problem.system.states > 1:
        words.insert(1, _phase(rrb, shown.problem))
    plots = view(
        "/physics/plots",
        "Control and states against the time of the system",
        physics.extent(physics.plots(shown.problem)),
    )
    return [plots, middle, rrb.Vertical(*words, row_shares=[3, 3, 2] if len(words) == 3 else [1, 1])]


def _log(rrb: Any, shown: Shown) -> Any:
    return rrb.TextLogView(
        origin="/log",
        name="Decisions",
        columns=rrb.TextLogColumns(
            timeline_columns=["evaluation" if shown.searches else "round"], text_log_columns=["Body"]
        ),
    )


def _phase(rrb: Any, problem: sr.OptimalControlProblem) -> Any:
    if problem.system.states == 2:
        return view("/physics/phase", "Phase plane", (10.0, 500.0, -30.0, 470.0))
    return rrb.Spatial3DView(origin="/physics/phase", name="State space", background=list(ink.GROUND[:3]))


def _bounds(rrb: Any) -> Any:
    return rrb.TimeSeriesView(origin="/rounds/bounds", name="Bounds on the cost", plot_legend=rrb.Corner2D.RightBottom)


def _decades(rrb: Any) -> Any:
    return rrb.TimeSeriesView(
        origin="/rounds/log10", name="Violation and gap, decimal logarithms", plot_legend=rrb.Corner2D.LeftBottom
    )


def _violation(rrb: Any, shown: Shown) -> Any:
    return view(
        "/violation/plots", "Violation along the indices: orange dots are new cuts", rounds.extent(shown.families)
    )


def _exchange(rrb: Any, shown: Shown) -> Any:
    left = rrb.Vertical(
        _bounds(rrb), _decades(rrb), rrb.TimeSeriesView(origin="/rounds/counts", name="Active indices and new cuts")
    )
    right = [_violation(rrb, shown)]
    if shown.problem is not None and shown.problem.system.parameter_count:
        right.append(
            rrb.Spatial2DView(
                origin="/violation",
                contents=["/violation/maps/**", "/violation/names/**"],
                name="Violation over t and p1 (up): red is forbidden",
            )
        )
    return rrb.Horizontal(left, rrb.Vertical(*right), name="Exchange")
