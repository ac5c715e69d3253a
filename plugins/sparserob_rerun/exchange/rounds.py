"""The exchange: two bounds that close, the violation of every family along its indices, and the cuts."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import product
from typing import Any, final

import numpy as np

import sparserob_core as sr
from sparserob_rerun.drawing import palette as ink
from sparserob_rerun.drawing.canvas import Axes, Drawing
from sparserob_rerun.drawing.palette import Floats

INSTANTS, PARAMETERS = 97, 15
FAMILIES = 4
LATTICE = 27  # points at most for the coordinates that are not drawn
LEFT, WIDTH, HEIGHT, GAP = 60.0, 640.0, 118.0, 46.0
SMALLEST = 1e-12
SERIES = {
    "rounds/bounds": {"lower bound (proven)": ink.GREEN, "upper bound": ink.VERMILLION},
    "rounds/log10": {"log10 of the violation": ink.VERMILLION, "log10 of the relative gap": ink.SKY},
    "rounds/counts": {"active indices": ink.PURPLE, "cuts added": ink.ORANGE},
}


def extent(families: int) -> tuple[float, float, float, float]:
    """Left, right, top and bottom of the violation plots."""
    return 0.0, LEFT + WIDTH + 30.0, -30.0, min(FAMILIES, families) * (HEIGHT + GAP) + 8.0


@final
class Rounds:
    """Logs rounds below ``/rounds`` and ``/violation``."""

    def __init__(self, rr: Any, stream: Any, inspection: sr.Inspection | None) -> None:
        self.rr, self.stream, self.inspection = rr, stream, inspection
        for path, series in SERIES.items():
            names, colours = list(series), list(series.values())
            stream.log(
                path,
                rr.SeriesLines(names=names, colors=colours, widths=[2.0] * len(names)),
                rr.SeriesPoints(names=names, colors=colours, marker_sizes=[4.0] * len(names)),
                static=True,
            )

    def bounds(self, event: sr.RoundFinished) -> None:
        """The numbers of one round."""
        rr, shown = (
            self.rr,
            [value if np.isfinite(value) else np.nan for value in (event.lower_bound, event.upper_bound)],
        )
        self.stream.log("rounds/bounds", rr.Scalars(shown))
        gap = event.gap if np.isfinite(event.gap) else np.nan
        self.stream.log("rounds/log10", rr.Scalars([_decades(event.violation), _decades(gap)]))
        self.stream.log("rounds/counts", rr.Scalars([float(event.active_indices), float(event.cuts_added)]))

    def violations(self, decision: Floats, cuts: Sequence[sr.Cut], added: Sequence[sr.Cut]) -> None:
        """The violation of every family at a decision over its first index, and over the second as a map."""
        if self.inspection is None:
            return
        drawing, families, maps = Drawing(), self.inspection.program.families[:FAMILIES], 0
        for place, family in enumerate(families):
            across, along, field = violation_field(family, decision)
            self._plot(drawing, place, family, (across, along, field), (cuts, added))
            if along.size > 1 and across.size > 1:
                self._map(maps, family.name, field)
                maps += 1
        drawing.log(self.rr, self.stream, "violation/plots", layers=("hatch", "frame", "marks", "curve"))

    def _plot(
        self,
        drawing: Drawing,
        place: int,
        family: sr.ConstraintFamily,
        found: tuple[Floats, Floats, Floats],
        marked: tuple[Sequence[sr.Cut], Sequence[sr.Cut]],
    ) -> None:
        across, _, field = found
        worst, box = field.max(axis=1), family.index_set
        ends = (float(box.lower[0]), float(box.upper[0]))
        if across.size == 1:
            ends = (ends[0] - 1.0, ends[1] + 1.0)
        low = float(np.quantile(worst, 0.02))
        reach = max(abs(low), abs(float(worst.max())), 1e-9)
        axes = Axes(
            LEFT, place * (HEIGHT + GAP), WIDTH, HEIGHT, ends, (-reach, max(0.35 * reach, 1.15 * float(worst.max())))
        )
        drawing.frame(
            axes,
            f"{family.name}: worst violation {worst.max():.2e} at {across[worst.argmax()]:.4g}; above 0 is forbidden",
        )
        drawing.hatched("hatch", axes, axes.x, (0.0, axes.y[1]), ink.HATCH)
        if across.size > 1:
            drawing.line("curve", axes.at(across, worst), ink.SKY, 2.0)
        else:
            drawing.dot(axes.at(across, worst), ink.SKY, 6.0)
        for cuts, colour, size in zip(marked, (ink.PURPLE, ink.ORANGE), (5.0, 7.0), strict=True):
            times = np.array([cut.index[0] for cut in cuts if cut.family == family.name])
            if times.size:
                drawing.dot(axes.at(times, 0.0), colour, size)

    def _map(self, place: int, name: str, field: Floats) -> None:
        """Time from left to right, the first parameter upwards; red is violated."""
        rr, reach, top = self.rr, max(float(np.abs(field).max()), SMALLEST), place * (16.0 * PARAMETERS + 50.0)
        image = np.ascontiguousarray(ink.diverging(np.flipud(field.T) / reach)[:, :, :3])
        path = f"violation/maps/{name.replace('[', '_').replace(']', '')}"
        self.stream.log(path, rr.Transform3D(translation=(0.0, top, 0.0), scale=(4.0, 16.0, 1.0)), rr.Image(image))
        self.stream.log(
            f"violation/names/{place}",
            rr.Points2D(
                [(2.0 * INSTANTS, top - 20.0)],
                labels=[name],
                colors=[ink.INK],
                radii=rr.Radius.ui_points(0.0),
                show_labels=True,
            ),
        )


def violation_field(family: sr.ConstraintFamily, decision: Floats) -> tuple[Floats, Floats, Floats]:
    """Values of the first index coordinate ``(k,)`` and of the second ``(l,)``, and the largest violation ``(k, l)`` of
    all rows there, over a coarse lattice of the other coordinates: a picture, not a proof."""
    box = family.index_set
    across = np.linspace(box.lower[0], box.upper[0], INSTANTS if box.upper[0] > box.lower[0] else 1)
    wide = box.dimension > 1 and box.upper[1] > box.lower[1]
    along = (
        np.linspace(box.lower[1], box.upper[1], PARAMETERS)
        if wide
        else np.array(box.lower[1:2] if box.dimension > 1 else [0.0])
    )
    others = _lattice(box.lower[2:], box.upper[2:])
    field = np.full((across.size, along.size), -np.inf)
    for rest in others:
        grid = np.array([[a, *([b] if box.dimension > 1 else []), *rest] for a, b in product(across, along)])
        field = np.maximum(field, family.violations(decision, grid).max(axis=1).reshape(field.shape))
    return across, along, field


def _lattice(lower: Floats, upper: Floats) -> list[Floats]:
    """The corners and the middle of a box, or its middle alone where the corners are too many."""
    middle = (lower + upper) / 2
    if 2**lower.size > LATTICE:
        return [middle]
    corners = [np.array(corner) for corner in product(*zip(lower, upper, strict=True))]
    return [middle, *corners] if lower.size else [middle]


def _decades(value: float) -> float:
    return float(np.log10(max(value, SMALLEST))) if np.isfinite(value) else np.nan
