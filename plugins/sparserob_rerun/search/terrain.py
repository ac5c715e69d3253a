"""The landscape as it is drawn: a heat map with the way of the search on it, and the same as a surface."""

from __future__ import annotations

from typing import Any, final

import numpy as np

from sparserob_rerun.drawing import palette as ink
from sparserob_rerun.drawing.canvas import Axes, Drawing
from sparserob_rerun.drawing.palette import Floats
from sparserob_rerun.search.landscape import Landscape

SIDE = 384.0
TRAIL, LAST = 300, 60  # evaluated points that stay visible, and how many of the last are joined by a line
SEEN: ink.Colour = (255, 255, 255, 110)
LIFT = 0.015  # points stand this share of the height above the surface


@final
class Terrain:
    """Draws below ``/landscape``."""

    def __init__(self, rr: Any, stream: Any) -> None:
        self.rr, self.stream = rr, stream
        self.known: Landscape | None = None

    def surface(self, landscape: Landscape, words: str) -> None:
        """The values that are known, as an image with axes and as a mesh."""
        self.known = landscape
        shown, (one, other) = landscape.filled, landscape.names()
        low, high = self._scale(landscape)
        colours = ink.sequential((shown - low) / (high - low))
        image = np.flipud(colours.transpose(1, 0, 2))[:, :, :3]
        self.stream.log(
            "landscape/map/g",
            self.rr.Transform3D(scale=float(max(1, int(SIDE) // landscape.grid))),
            self.rr.Image(image),
        )
        drawing, axes = Drawing(), self._axes(landscape)
        drawing.frame(axes, f"across: {one}, up: {other}; {words}")
        _, x, y = landscape.highest
        drawing.line("highest", _square(axes.at(x, y)[0]), ink.INK, 2.0)
        drawing.text(
            axes.width / 2,
            axes.height + 34.0,
            f"g from {low:.5g} (dark) to {high:.5g} (bright); the square is the highest",
            ink.GREY,
        )
        drawing.log(self.rr, self.stream, "landscape/map/axes", layers=("frame", "highest"))
        self._mesh(landscape, shown, colours, (low, high))

    def visit(self, points: Floats, values: Floats, best: tuple[Floats, float]) -> None:
        """The points ``(k, 2)`` that a search has evaluated, the last one last, with their values, and the best so far
        with its value."""
        if self.known is None:
            return
        axes, rr = self._axes(self.known), self.rr
        few = np.unique(
            np.concatenate(
                [np.linspace(0, len(points) - 1, TRAIL).astype(int), np.arange(max(0, len(points) - LAST), len(points))]
            )
        )
        at = axes.at(points[:, 0], points[:, 1])
        self.stream.log(
            "landscape/map/visited",
            rr.Points2D(at[few], colors=[SEEN], radii=rr.Radius.ui_points(1.6), draw_order=40.0),
        )
        self.stream.log(
            "landscape/map/way",
            rr.LineStrips2D([at[-LAST:]], colors=[SEEN], radii=rr.Radius.ui_points(0.5), draw_order=41.0),
        )
        marks = np.concatenate([at[-1:], axes.at(best[0][0], best[0][1])])
        self.stream.log(
            "landscape/map/now",
            rr.Points2D(
                marks,
                colors=[ink.INK, ink.ORANGE],
                labels=["now", f"best {best[1]:.5g}"],
                radii=rr.Radius.ui_points([4.0, 6.0]),
                show_labels=True,
                draw_order=60.0,
            ),
        )
        spots = np.column_stack([_unit(self.known, points), self._heights(values)])
        top = np.append(_unit(self.known, best[0][np.newaxis])[0], self._heights(np.array([best[1]])))
        self.stream.log(
            "landscape/surface/visited", rr.Points3D(spots[few], colors=[ink.INK], radii=rr.Radius.ui_points(1.6))
        )
        self.stream.log(
            "landscape/surface/best",
            rr.Points3D([top], colors=[ink.ORANGE], radii=rr.Radius.ui_points(6.0), labels=["best"]),
        )

    def _heights(self, values: Floats) -> Floats:
        assert self.known is not None
        low, high = self._scale(self.known)
        return np.asarray(np.clip((np.where(np.isfinite(values), values, low) - low) / (high - low), -0.2, 1.3) + LIFT)

    def mark(self, points: Floats, words: str) -> None:
        """Points ``(k, 2)`` of the exact solution."""
        if self.known is not None and points.size:
            axes = self._axes(self.known)
            drawing, at = Drawing(), axes.at(points[:, 0], points[:, 1])
            drawing.dot(at, ink.PURPLE, 7.0)
            beside = 24.0 if at[0, 1] < axes.height / 2 else -16.0
            drawing.text(
                float(np.clip(at[0, 0], 0.24 * axes.width, 0.76 * axes.width)), float(at[0, 1]) + beside, words
            )
            drawing.log(self.rr, self.stream, "landscape/map/exact")

    def _scale(self, landscape: Landscape) -> tuple[float, float]:
        known = landscape.values[np.isfinite(landscape.values)]
        low, high = (float(known.min()), float(known.max())) if known.size else (0.0, 1.0)
        return (low, high) if high - low > 1e-9 * max(1.0, abs(high)) else (low - 0.5, low + 0.5)

    def _axes(self, landscape: Landscape) -> Axes:
        side = float(landscape.grid * max(1, int(SIDE) // landscape.grid))
        ends = [(float(axis[0]), float(axis[-1])) for axis in landscape.axes]
        return Axes(0.0, 0.0, side, side, ends[0], ends[1])

    def _mesh(self, landscape: Landscape, shown: Floats, colours: np.ndarray, scale: tuple[float, float]) -> None:
        n = landscape.grid
        heights = np.where(np.isnan(shown), 0.0, (shown - scale[0]) / (scale[1] - scale[0]))
        i = np.arange(n * n).reshape(n, n)
        quads = [i[:-1, :-1], i[1:, :-1], i[1:, 1:], i[:-1, 1:]]
        triangles = np.concatenate(
            [
                np.stack([quads[0], quads[1], quads[2]], -1).reshape(-1, 3),
                np.stack([quads[0], quads[2], quads[3]], -1).reshape(-1, 3),
            ]
        )
        axis = np.linspace(0.0, 1.0, n)
        X, Y = np.meshgrid(axis, axis, indexing="ij")
        slope_x, slope_y = np.gradient(heights, axis, axis)
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
        one, other = landscape.names()
        (x0, x1), (y0, y1) = ((axis[0], axis[-1]) for axis in landscape.axes)
        corners = {
            (0.5, -0.12, 0.0): f"{one}: {x0:.3g} to {x1:.3g}",
            (-0.12, 0.5, 0.0): f"{other}: {y0:.3g} to {y1:.3g}",
            (0.0, 0.0, 1.05): f"g = {scale[1]:.4g}",
            (0.0, 0.0, -0.03): f"g = {scale[0]:.4g}",
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


def _unit(landscape: Landscape, points: Floats) -> Floats:
    low, high = (np.array([axis[end] for axis in landscape.axes]) for end in (0, -1))
    return np.asarray((points - low) / np.where(high > low, high - low, 1.0))


def _square(centre: Floats) -> Floats:
    return centre + 6.0 * np.array([[-1, -1], [1, -1], [1, 1], [-1, 1], [-1, -1]])
