"""Views of a search on the screen."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from typing import Any, Literal

import numpy as np

from sparserob_rerun.drawing import palette as ink
from sparserob_rerun.drawing.canvas import ticks, view
from sparserob_rerun.search.search import LOGARITHMIC, NOTES
from sparserob_rerun.search.terrain import BAR, HEIGHT

FIRST = ("temperature", "depth", "constant", "radius", "reach", "spread", "slope")  # of what is noted, for the overview
SHARES = ("accepted", "rejected", "local")
TALL = 2
"""Factor by which a panel is higher whose lines have their names in its corner: with 1 the names lie on the lines, with
4 the others are too low for the numbers beside them."""
WHOLE = (-0.1, 1.1)  # of a share; of a narrower range the viewer writes one number only, and none at its ends


def landscape(searches: bool, answers: bool, horizon: float = 1.0) -> Any:
    """Return a view of the landscape of g as a map, of a control that ``answers`` what it measures at the end only;
    with room beside it for the times up to the ``horizon``."""
    name = "Landscape of g around the best tuple" + (", and the way of the search" if searches else "")
    letters = max(len(f"{time:.6g}") for time in ticks(0.0, horizon))
    left = EXTENT[0] - LETTER * max(0, letters - LETTERS)
    return view(
        "/landscape/map",
        f"{name}: when the run is over" if answers else name,
        (left, *EXTENT[1:3], HEIGHT + BELOW[searches]),
    )


BELOW = {True: 82.0, False: 116.0}
"""Units below the map, of a search, whose panel is large, and of the others: words are as high in both."""
EXTENT = (-54.0, BAR[0] + BAR[1] + 100.0, -64.0, HEIGHT + BELOW[False])
LETTER, LETTERS = 18.0, 2  # how much room a letter takes, and how many have it within the `EXTENT`
MOST = 4  # searches whose climbs are beside one another; of more the last ones
CLIMB = ("tried", "refused", "walk", "best", "exact")


def climb(rrb: Any, stages: Sequence[tuple[int, float, float]], budget: int) -> Any:
    """Return the plots of the climb. A search that goes on has its last evaluations, as many as its ``budget`` (0: all
    of them). A search that is over has a plot for each of its ``stages``. Each stage has the evaluations before it, its
    weight epsilon, and the seconds before it."""
    contents = [f"+ /search/g/{entity}" for entity in CLIMB]
    if len(stages) < 2:
        cursor = rrb.TimeRangeBoundary.cursor_relative
        window = rrb.VisibleTimeRange("evaluation", start=cursor(seq=-budget), end=cursor(seq=0))
        return series(rrb, "/search/g", "g over the last evaluations", contents, ranges=[window] if budget else ())
    latest, plots = list(stages)[-MOST:], []
    boundary, unlimited = rrb.TimeRangeBoundary.absolute, rrb.TimeRangeBoundary.infinite()
    ends = [(boundary(seq=base), boundary(seconds=before)) for base, _, before in latest[1:]] + [(unlimited, unlimited)]
    for (base, epsilon, before), (end, over) in zip(latest, ends, strict=True):
        name = f"ε {_short(epsilon)}" if np.isfinite(epsilon) and epsilon > 0.0 else "g over the evaluations"
        ranges = [
            rrb.VisibleTimeRange("evaluation", start=boundary(seq=base + 1), end=end),
            rrb.VisibleTimeRange("time", start=boundary(seconds=before), end=over),
        ]
        plots.append(series(rrb, "/search/g", name, contents, ranges=ranges))
    return rrb.Horizontal(*plots)


def _short(number: float) -> str:
    """Write three digits in as few characters as they need, for the heading of a narrow plot."""
    digits, power = f"{number:.2e}".split("e")
    return min(f"{number:.3g}", f"{float(digits):g}e{int(power)}", key=len)


def series(
    rrb: Any,
    origin: str,
    name: str,
    contents: list[str] | None = None,
    legend: Literal["left", "right", "below"] = "right",
    limits: tuple[float, float] | None = None,
    ranges: Sequence[Any] = (),
) -> Any:
    """Return a plot against the timeline that shows the whole of it, however long it is. ``legend``: the corner in
    which the names of its lines are, an upper one or the lower left one. ``limits``: of the axis upwards, where they
    are known before. ``ranges``: what is shown on some timelines, which decides its height, in the place of the
    whole."""
    from rerun.encodings import TimeRange

    everything = rrb.TimeRangeBoundary.infinite()
    time_axis = None if ranges else rrb.TimeAxis(view_range=TimeRange(start=everything, end=everything))
    return rrb.TimeSeriesView(
        origin=origin,
        contents=contents or ["+ $origin/**"],
        name=name,
        plot_legend=rrb.PlotLegend(
            corner={"right": rrb.Corner2D.RightTop, "left": rrb.Corner2D.LeftTop, "below": rrb.Corner2D.LeftBottom}[
                legend
            ],
            visible=contents is None,
        ),
        axis_x=time_axis,  # a range of evaluations is none of another timeline
        time_ranges=list(ranges) or None,
        axis_y=None if limits is None else rrb.ScalarAxis(range=limits),
    )


def notes(rrb: Any, told: Collection[str]) -> list[Any]:
    """Return plots of the first notes of the maximiser; none where it notes nothing."""
    chosen = [name for name in (*FIRST, *SHARES) if name in told][:2]
    return [_note(rrb, name) for name in chosen]


def _note(rrb: Any, name: str) -> Any:
    words = NOTES.get(name, (name, ink.GREY))[0]
    limits = WHOLE if name in (*SHARES, "move") else None
    if name == "move":  # a line for each kind
        return series(rrb, "/search/notes/move", words[0].upper() + words[1:], limits=limits)
    return series(rrb, "/search/notes", words[0].upper() + words[1:], [f"+ /search/notes/{name}"], limits=limits)


def tab(rrb: Any, told: Collection[str], moved: Collection[str], climbs: Any) -> Any:
    """Return the tab of a search: its ``climbs``, what the maximiser has ``told`` of itself, and the coordinates that
    have ``moved``, each on an axis of its own."""
    order = [name for name in (*LOGARITHMIC, *NOTES) if name in told]
    names = [*dict.fromkeys([*order, *sorted(told)])]
    note_plots = [_note(rrb, name) for name in names]
    move_plots = [
        series(rrb, "/search/moves", f"Where it moves: {name}", [f"+ /search/moves/{name}"]) for name in sorted(moved)
    ]
    left = rrb.Vertical(
        climbs,
        series(rrb, "/search/g", "g, with the share of the regulariser, over the evaluations", legend="below"),
        row_shares=[3, 2],
    )
    rows = [TALL if name == "move" else 1 for name in names]
    columns = [rrb.Vertical(*note_plots, row_shares=rows)] if note_plots else []
    columns += [rrb.Vertical(*move_plots)] if move_plots else []
    return rrb.Horizontal(left, *columns, column_shares=[5, 3, 3][: 1 + len(columns)], name="Search")


def surface(rrb: Any) -> Any:
    """Return a view of the landscape of g in space."""
    return rrb.Spatial3DView(
        origin="/landscape/surface",
        name="Landscape as a surface",
        background=list(ink.GROUND[:3]),
        eye_controls=rrb.EyeControls3D(position=(1.55, -0.95, 1.95), look_target=(0.5, 0.5, 0.35), eye_up=(0, 0, 1)),
    )
