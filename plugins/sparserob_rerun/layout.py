"""What is on the screen when a recording is opened: nothing is left to the viewer's guesses."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, final

from sparserob_rerun import palette as ink
from sparserob_rerun import physics, rounds

if TYPE_CHECKING:
    import sparserob_core as sr


@final
@dataclass(frozen=True)
class Shown:
    """What a run has to show: its problem, if it is one of control, how many families, whether tuples are searched, and
    the landscape."""

    problem: sr.OptimalControlProblem | None
    families: int
    searches: bool
    landscape: bool


def layout(shown: Shown) -> Any:
    """The blueprint: an overview first, then a tab for each part of the story."""
    import rerun.blueprint as rrb

    overview = rrb.Horizontal(
        *_columns(rrb, shown), name="Overview", column_shares=[5, 4, 3] if shown.problem is not None else [4, 3]
    )
    tabs = [overview, _exchange(rrb, shown)]
    if shown.searches:
        tabs.insert(1, _search(rrb))
    if shown.landscape:
        tabs.append(_surface(rrb))
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
    numbers = [_progress(rrb), _notes(rrb)] if shown.searches else [_violation(rrb, shown), _bounds(rrb)]
    middle = rrb.Vertical(_map(rrb), *numbers, row_shares=[4, 3, 2]) if shown.landscape else rrb.Vertical(*numbers)
    words = [rrb.TextDocumentView(origin="/verdict", name="What is known"), _log(rrb, shown)]
    if shown.problem is None:
        return [middle, rrb.Vertical(*words, row_shares=[2, 3])]
    if shown.problem.system.states > 1:
        words.insert(1, _phase(rrb, shown.problem))
    plots = _plots(
        rrb,
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


def _plots(rrb: Any, origin: str, name: str, extent: tuple[float, float, float, float]) -> Any:
    left, right, top, bottom = extent
    return rrb.Spatial2DView(
        origin=origin,
        name=name,
        background=list(ink.GROUND[:3]),
        visual_bounds=rrb.VisualBounds2D(x_range=(left, right), y_range=(top, bottom)),
    )


def _map(rrb: Any) -> Any:
    return _plots(
        rrb,
        "/landscape/map",
        "Landscape of g: how much the constraints at two indices cost",
        (-50.0, 420.0, -38.0, 440.0),
    )


def _phase(rrb: Any, problem: sr.OptimalControlProblem) -> Any:
    if problem.system.states == 2:
        return _plots(rrb, "/physics/phase", "Phase plane", (10.0, 500.0, -30.0, 470.0))
    return rrb.Spatial3DView(origin="/physics/phase", name="State space", background=list(ink.GROUND[:3]))


def _progress(rrb: Any) -> Any:
    return rrb.TimeSeriesView(
        origin="/search/g",
        name="g over the evaluations; it drops where epsilon is reduced",
        plot_legend=rrb.Corner2D.RightBottom,
    )


def _bounds(rrb: Any) -> Any:
    return rrb.TimeSeriesView(origin="/rounds/bounds", name="Bounds on the cost", plot_legend=rrb.Corner2D.RightBottom)


def _decades(rrb: Any) -> Any:
    return rrb.TimeSeriesView(
        origin="/rounds/log10", name="Violation and gap, decimal logarithms", plot_legend=rrb.Corner2D.LeftBottom
    )


def _notes(rrb: Any) -> Any:
    """The quiet ones of the maximiser's scalars; all of them are in the tab of the search."""
    hidden = [f"- /search/notes/{name}" for name in ("scale", "openings", "hmax", "step", "slope")]
    return rrb.TimeSeriesView(
        origin="/search/notes",
        contents=["+ $origin/**", *hidden],
        name="What the maximiser says of itself",
        plot_legend=rrb.Corner2D.RightTop,
    )


def _violation(rrb: Any, shown: Shown) -> Any:
    return _plots(
        rrb, "/violation/plots", "Violation along the indices: orange dots are new cuts", rounds.extent(shown.families)
    )


def _search(rrb: Any) -> Any:
    rest = [f"- /search/notes/{name}" for name in ("temperature", "constant")]
    notes = rrb.Horizontal(
        rrb.TimeSeriesView(
            origin="/search/notes",
            contents=["/search/notes/temperature", "/search/notes/constant"],
            name="Temperature; Lipschitz constant",
        ),
        rrb.TimeSeriesView(
            origin="/search/notes", contents=["+ $origin/**", *rest], name="What the maximiser says of itself"
        ),
    )
    return rrb.Vertical(
        _progress(rrb),
        notes,
        rrb.TimeSeriesView(origin="/search/moves", name="Where it looks: the coordinates that moved"),
        name="Search",
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


def _surface(rrb: Any) -> Any:
    return rrb.Spatial3DView(
        origin="/landscape/surface",
        name="Landscape as a surface",
        background=list(ink.GROUND[:3]),
        eye_controls=rrb.EyeControls3D(position=(1.35, -0.95, 1.35), look_target=(0.5, 0.5, 0.3), eye_up=(0, 0, 1)),
    )
