"""The landscape as it is drawn: a heat map with the way of the search on it, and the same as a surface."""

from __future__ import annotations

from typing import Any, final

import numpy as np

import sparserob_core as sr
from sparserob_rerun.drawing import palette as ink
from sparserob_rerun.drawing.canvas import Axes, Drawing
from sparserob_rerun.drawing.palette import Floats
from sparserob_rerun.search.explorer import Aim
from sparserob_rerun.search.landscape import Landscape
from sparserob_rerun.search.way import Shadow, Stage, shadow

PIXELS, SIDE = 128, 384.0
TRIED, LEG, LAST = 300, 400, 20  # points that stay visible, corners of the walk, and its last ones
LIFT = 0.015  # points stand this share of the height above the surface
SHOWN = 60  # boxes of a sketch that are drawn


@final
class Terrain:
    """Draws below ``/landscape``.

    ``/landscape/slice`` holds the numbers of what is drawn: ``across (a,)``, ``up (b,)``, ``values (a b)`` row by row,
    the tuple through which it is (``anchor (2,)``), ``value`` there, ``epsilon`` and ``level``, the stride of the grid.
    """

    def __init__(self, rr: Any, stream: Any) -> None:
        self.rr, self.stream = rr, stream
        self.known: Landscape | None = None

    def surface(self, landscape: Landscape, aim: Aim) -> None:
        """The values that are known, as an image with axes and as a mesh."""
        self.known = landscape
        low, high = self._scale(landscape)
        shown = landscape.picture(PIXELS)
        colours = ink.sequential((np.where(np.isfinite(shown), shown, np.nan) - low) / (high - low))
        colours[shown == np.inf] = ink.FORBIDDEN
        image = np.flipud(colours.transpose(1, 0, 2))[:, :, :3]
        self.stream.log(
            "landscape/map/g", self.rr.Transform3D(scale=SIDE / PIXELS), self.rr.Image(np.ascontiguousarray(image))
        )
        (one, other), drawing, axes = landscape.names(), Drawing(), self._axes(landscape)
        weight = f"epsilon {landscape.epsilon:.3g}: " if landscape.epsilon > 0.0 else ""
        drawing.frame(axes, f"{weight}{aim.words}")
        drawing.text(axes.width / 2, axes.height + 34.0, f"across: {one}, up: {other}", ink.INK)
        drawing.text(axes.width / 2, axes.height + 56.0, _said(landscape), ink.GREY)
        drawing.log(self.rr, self.stream, "landscape/map/axes", layers=("frame",))
        self._anchor(landscape, axes)
        across, up, values = landscape.shown
        place = [landscape.axes[k][landscape.at[k]] for k in (0, 1)]
        self.stream.log(
            "landscape/slice",
            self.rr.AnyValues(
                across=across,
                up=up,
                values=values.ravel(),
                anchor=np.array(place),
                value=[landscape.value],
                sought=[aim.value],
                epsilon=[landscape.epsilon],
                level=[landscape.level],
            ),
        )
        self._mesh(landscape, (low, high))

    def _anchor(self, landscape: Landscape, axes: Axes) -> None:
        """The tuple through which the slice goes, with the value that the slice has there."""
        at = axes.at(landscape.axes[0][landscape.at[0]], landscape.axes[1][landscape.at[1]])
        self.stream.log(
            "landscape/map/best",
            self.rr.Points2D(
                at,
                colors=[ink.ORANGE],
                labels=[f"best {landscape.value:.6g}"],
                radii=self.rr.Radius.ui_points(6.0),
                show_labels=True,
                draw_order=60.0,
            ),
        )

    def visit(self, stage: Stage) -> None:
        """The way of a search on the landscape that is shown."""
        landscape = self.known
        if landscape is None:
            return
        wanted = np.array([slot * stage.block + k for slot, k in (landscape.first, landscape.second)])
        path = shadow(stage, wanted)
        if path is None or landscape.epsilon != _weight(stage.epsilon):
            for name in ("tried", "refused", "walk", "now", "sketch"):
                self.stream.log(f"landscape/map/{name}", self.rr.Clear(recursive=True))
            return
        self._path(path, stage)
        self._sketches(landscape, stage, wanted)

    def _path(self, path: Shadow, stage: Stage) -> None:
        assert self.known is not None
        axes, rr = self._axes(self.known), self.rr
        few = np.unique(np.linspace(max(0, len(path.points) - 4 * TRIED), len(path.points) - 1, TRIED).astype(int))
        for name, which, colour, size in (
            ("tried", ~path.refused[few], ink.TRIED, 1.8),
            ("refused", path.refused[few], ink.REFUSED, 1.3),
        ):
            points = path.points[few][which]
            spots = rr.Points2D(
                axes.at(points[:, 0], points[:, 1]), colors=[colour], radii=rr.Radius.ui_points(size), draw_order=40.0
            )
            self.stream.log(f"landscape/map/{name}", spots)
        legs = [leg[-LEG:] for leg in path.legs]
        last = legs[-1][-LAST:] if legs else np.zeros((0, 2))
        self.stream.log(
            "landscape/map/walk",
            rr.LineStrips2D(
                [axes.at(leg[:, 0], leg[:, 1]) for leg in [*legs, last] if len(leg)],
                colors=[ink.PAST] * len(legs) + [ink.INK] * bool(len(last)),
                radii=rr.Radius.ui_points([0.35] * len(legs) + [0.8] * bool(len(last))),
                draw_order=45.0,
            ),
        )
        marks = [axes.at(path.now[0], path.now[1])]
        labels, colours, sizes = ["now"], [ink.INK], [4.0]
        for place in path.restarts[-6:]:
            marks.append(axes.at(place[0], place[1]))
            labels.append("")
            colours.append(ink.PURPLE)
            sizes.append(3.5)
        landscape = self.known
        slots = stage.best.reshape(-1, stage.block) if stage.best.size else np.zeros((0, 1))
        if slots.shape == landscape.anchor.shape and not np.array_equal(slots, landscape.anchor):
            marks.append(axes.at(slots[landscape.first], slots[landscape.second]))
            labels.append(f"since: {stage.best_value:.6g}, beside the slice")
            colours.append(ink.HALF)
            sizes.append(4.5)
        self.stream.log(
            "landscape/map/now",
            rr.Points2D(
                np.concatenate(marks),
                colors=colours,
                labels=labels,
                radii=rr.Radius.ui_points(sizes),
                show_labels=True,
                draw_order=61.0,
            ),
        )

    def _sketches(self, landscape: Landscape, stage: Stage, wanted: np.ndarray) -> None:
        """What a maximiser shows of itself, where it meets the slice; points fall onto it."""
        axes = self._axes(landscape)
        for role, sketch in stage.sketches.items():
            path = f"landscape/map/sketch/{''.join(c if c.isalnum() else '_' for c in role)}"
            if sketch.lower.shape[1] != landscape.anchor.size:
                continue
            if sketch.points:
                at = axes.at(sketch.lower[:, wanted[0]], sketch.lower[:, wanted[1]])
                words = [role] + [""] * (len(at) - 1)
                self.stream.log(
                    path,
                    self.rr.Points2D(
                        at, colors=[ink.SKY], labels=words, radii=self.rr.Radius.ui_points(2.5), draw_order=47.0
                    ),
                )
                continue
            outlines = _outlines(sketch, landscape.anchor.ravel(), wanted)[:SHOWN]
            words = [f"{role}: {len(outlines)} of {len(sketch.lower)} here"] if outlines else []
            strips = [axes.at(line[:, 0], line[:, 1]) for line in outlines]
            self.stream.log(
                path,
                self.rr.LineStrips2D(
                    strips,
                    colors=[ink.SKETCH],
                    labels=words + [""] * (len(strips) - 1) if words else None,
                    radii=self.rr.Radius.ui_points(0.6),
                    draw_order=42.0,
                ),
            )

    def mark(self, words: str) -> None:
        """What is proven of the tuple through which the slice goes."""
        landscape = self.known
        if landscape is not None:
            axes = self._axes(landscape)
            at = axes.at(landscape.axes[0][landscape.at[0]], landscape.axes[1][landscape.at[1]])
            drawing = Drawing()
            drawing.dot(at, ink.PURPLE, 7.0)
            beside = 30.0 if at[0, 1] < axes.height / 2 else -22.0
            drawing.text(float(np.clip(at[0, 0], 0.3 * axes.width, 0.7 * axes.width)), float(at[0, 1]) + beside, words)
            drawing.log(self.rr, self.stream, "landscape/map/exact")

    def _scale(self, landscape: Landscape) -> tuple[float, float]:
        """What is dark and what is bright; one colour for a flat slice, which has no range."""
        low, high = landscape.limits
        if not np.isfinite(low):
            return 0.0, 1.0
        return (low, high) if not landscape.flat and high > low else (low - 1.0, low + 1.0)

    def _axes(self, landscape: Landscape) -> Axes:
        ends = [(float(axis[0]), float(axis[-1])) for axis in landscape.axes]
        return Axes(0.0, 0.0, SIDE, SIDE, ends[0], ends[1])

    def _mesh(self, landscape: Landscape, scale: tuple[float, float]) -> None:
        across, up, shown = landscape.shown
        finite = np.isfinite(shown)
        heights = np.clip((np.where(finite, shown, scale[1]) - scale[0]) / (scale[1] - scale[0]), 0.0, 1.0)
        colours = ink.sequential(np.where(finite, heights, np.nan))
        colours[~finite] = ink.FORBIDDEN
        rows, columns = shown.shape
        i = np.arange(rows * columns).reshape(rows, columns)
        quads = [i[:-1, :-1], i[1:, :-1], i[1:, 1:], i[:-1, 1:]]
        triangles = np.concatenate(
            [
                np.stack([quads[0], quads[1], quads[2]], -1).reshape(-1, 3),
                np.stack([quads[0], quads[2], quads[3]], -1).reshape(-1, 3),
            ]
        )
        one, other = ((axis - axis[0]) / (axis[-1] - axis[0]) for axis in (across, up))
        X, Y = np.meshgrid(one, other, indexing="ij")
        slope_x, slope_y = np.gradient(heights, one, other)
        normals = np.stack([-slope_x, -slope_y, np.ones_like(heights)], -1)
        self.stream.log(
            "landscape/surface/g",
            self.rr.Mesh3D(
                vertex_positions=np.stack([X, Y, heights], -1).reshape(-1, 3),
                triangle_indices=triangles,
                vertex_normals=normals.reshape(-1, 3),
                vertex_colors=colours.reshape(-1, 4),
            ),
        )
        at = [float((landscape.axes[k][landscape.at[k]] - a[0]) / (a[-1] - a[0])) for k, a in enumerate((across, up))]
        top = float(np.clip((landscape.value - scale[0]) / (scale[1] - scale[0]), 0.0, 1.0)) + LIFT
        self.stream.log(
            "landscape/surface/best",
            self.rr.Points3D(
                [[*at, top]],
                colors=[ink.ORANGE],
                radii=self.rr.Radius.ui_points(6.0),
                labels=[f"best {landscape.value:.6g}"],
            ),
        )
        names = landscape.names()
        flat = landscape.flat
        corners = {
            (0.5, -0.12, 0.0): f"{names[0]}: {across[0]:.3g} to {across[-1]:.3g}",
            (-0.12, 0.5, 0.0): f"{names[1]}: {up[0]:.3g} to {up[-1]:.3g}",
            (0.0, 0.0, 1.05): _said(landscape) if flat else f"g = {scale[1]:.4g}",
            (0.0, 0.0, -0.03): "" if flat else f"g = {scale[0]:.4g}",
        }
        self.stream.log(
            "landscape/surface/labels",
            self.rr.Points3D(
                list(corners),
                labels=list(corners.values()),
                colors=[ink.INK],
                radii=self.rr.Radius.ui_points(0.0),
                show_labels=True,
            ),
        )


def _said(landscape: Landscape) -> str:
    """What the colours mean, or that there is nothing to see."""
    low, high = landscape.limits
    nowhere = bool((landscape.shown[2] == np.inf).any())
    if not np.isfinite(low):
        return "no control meets the constraints anywhere here: g is infinite"
    if landscape.flat or high == low:
        return f"g does not depend on these two here: it is {low:.6g}"
    digits = int(np.clip(2 - np.floor(np.log10((high - low) / max(abs(low), abs(high)))), 5, 12))  # that differ
    said = f"g from {low:.{digits}g} (dark) to {high:.{digits}g} (bright)"
    return said + ("; brown: no control meets the constraints" if nowhere else "")


def _weight(epsilon: float) -> float:
    return epsilon if np.isfinite(epsilon) else 0.0


def _outlines(sketch: sr.Sketch, anchor: Floats, wanted: np.ndarray) -> list[Floats]:
    """The outlines ``(k, 2)`` of the boxes or ellipsoids of a sketch where a slice through ``anchor (d,)`` meets
    them."""
    others = np.setdiff1d(np.arange(anchor.size), wanted)
    middle, half = (sketch.lower + sketch.upper) / 2, (sketch.upper - sketch.lower) / 2
    with np.errstate(divide="ignore", invalid="ignore"):
        away = np.abs(anchor[others] - middle[:, others]) / half[:, others]
    away = np.where(np.isnan(away), 0.0, away)  # a coordinate of one value
    sizes = np.ones(len(middle))
    if sketch.rounded:
        sizes = np.sqrt(np.maximum(0.0, 1.0 - (away**2).sum(axis=1)))
    meets = (sizes > 0.0) & (away <= 1.0 + 1e-9).all(axis=1)
    turn = np.linspace(0.0, 2.0 * np.pi, 33)
    unit = (
        np.column_stack([np.cos(turn), np.sin(turn)])
        if sketch.rounded
        else np.array([[-1.0, -1.0], [1.0, -1.0], [1.0, 1.0], [-1.0, 1.0], [-1.0, -1.0]])
    )
    return [middle[k, wanted] + sizes[k] * half[k, wanted] * unit for k in np.flatnonzero(meets)]
