"""What is on the screen of a search."""

from __future__ import annotations

from typing import Any

from sparserob_rerun.drawing import palette as ink
from sparserob_rerun.drawing.canvas import view


def landscape(rrb: Any) -> Any:
    """The landscape of g as a map."""
    return view(
        "/landscape/map",
        "Landscape of g: how much the constraints at two indices cost",
        (-50.0, 420.0, -38.0, 440.0),
    )


def climb(rrb: Any) -> Any:
    """The values over the evaluations."""
    return rrb.TimeSeriesView(
        origin="/search/g",
        name="g over the evaluations; it drops where epsilon is reduced",
        plot_legend=rrb.Corner2D.RightBottom,
    )


def notes(rrb: Any) -> Any:
    """The quiet ones of the maximiser's scalars; all of them are in the tab of the search."""
    hidden = [f"- /search/notes/{name}" for name in ("scale", "openings", "hmax", "step", "slope")]
    return rrb.TimeSeriesView(
        origin="/search/notes",
        contents=["+ $origin/**", *hidden],
        name="What the maximiser says of itself",
        plot_legend=rrb.Corner2D.RightTop,
    )


def tab(rrb: Any) -> Any:
    """The tab of a search."""
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
        climb(rrb),
        notes,
        rrb.TimeSeriesView(origin="/search/moves", name="Where it looks: the coordinates that moved"),
        name="Search",
    )


def surface(rrb: Any) -> Any:
    """The landscape of g in space."""
    return rrb.Spatial3DView(
        origin="/landscape/surface",
        name="Landscape as a surface",
        background=list(ink.GROUND[:3]),
        eye_controls=rrb.EyeControls3D(position=(1.35, -0.95, 1.35), look_target=(0.5, 0.5, 0.3), eye_up=(0, 0, 1)),
    )
