"""Pictures of the landscape: a heat map with the path of the search on it, and a surface."""

from __future__ import annotations

from typing import Any, final

import numpy as np

import sparserob_core as sr
from sparserob_rerun.drawing import palette as ink
from sparserob_rerun.drawing.canvas import Axes, Drawing, ticks
from sparserob_rerun.drawing.palette import Floats
from sparserob_rerun.search.explorer import VISIBLE, Aim
from sparserob_rerun.search.projection import outlines_on
from sparserob_rerun.search.way import Shadow, Stage, shadow

CELLS = 33
"""Numbers of the map along either side. With a tenth of it a ridge is not seen; with ten times as many a map is a
hundred times as large, of values of which nearly all are straight lines between those that were evaluated."""
WIDTH, HEIGHT = 600.0, 400.0
BAR, STEPS = (640.0, 26.0), 64  # the left side of the colour bar and its width, and its numbers
TRIED, LEG, LAST = 150, 400, 20  # points that stay visible, corners of the walk, and its last ones
ABOUT = (
    "**g of a tuple**: the least cost of a control that meets the constraints at its indices. J\\* is the largest g of"
    " all tuples."
)
"""Introduction for a person who has never seen the map."""
LIFT = 0.015  # points stand this share of the height above the surface
POLE = 0.32
"""Height above the surface at which the value of the best point is written, in heights of the surface, wherever that
point is. Much lower, the bright surface is behind the words, which cannot be read in a light theme; twice as high, they
are outside the panel."""
WORDS = 0.08
"""Distance below the place of these words at which the line from the point to them ends: the viewer writes them below
their place. With 0 the line crosses them, with 0.2 it is too short to lead to them."""
SHOWN = 60  # boxes of a sketch that are drawn


@final
class Terrain:
    """Pictures of the landscape below ``/landscape``.

    ``/landscape/slice`` holds the numbers of what is drawn: ``across (a,)``, ``up (b,)``, ``values (a b)`` row by row,
    the tuple through which it is (``anchor (2,)``), ``value`` there, ``epsilon`` and ``level``, the stride of the grid.
    """

    def __init__(self, rr: Any, stream: Any, unit: str = "", cost: str = "") -> None:
        """Prepare the pictures; ``unit``: of the time, ``cost``: of g; empty where none is known."""
        self.rr, self.stream, self.unit, self.cost = rr, stream, unit, cost
        self.known: sr.Landscape | None = None
        self.words: dict[str, list[str]] = {"about": [], "map": [], "search": [], "exact": []}
        self.scale = (0.0, 1.0)
        self.colours = rr.components.Colormap.Viridis
        self._say("about", [ABOUT])

    def surface(self, landscape: sr.Landscape, aim: Aim) -> None:
        """Draw the values that are known, as numbers with a colour map, with axes and a colour bar, and as a mesh."""
        self.known = landscape
        self.scale = self._scale(landscape, aim)
        self._numbers(landscape.picture(CELLS))
        (across_name, up_name), drawing, axes = landscape.names(self.unit), Drawing(), self._axes(landscape)
        drawing.frame(axes, "", room=1.4)
        drawing.text(axes.width / 2, axes.height + 62.0, f"across: {across_name}", ink.GREY)
        drawing.text(axes.width / 2, -44.0, f"up: {up_name}", ink.GREY)
        drawing.text(BAR[0] + BAR[1] / 2, -44.0, f"g{f' in {self.cost}' if self.cost else ''}", ink.GREY)
        for value, words in _numbers_beside(self.scale):
            drawing.text(BAR[0] + BAR[1] + 48.0, float(self._bar.at(0.0, value)[0, 1]), words, ink.GREY)
        drawing.log(self.rr, self.stream, "landscape/map/axes", layers=("frame",))
        self._anchor(landscape, axes)
        has_two = landscape.first[0] != landscape.second[0]
        weight = [f"epsilon {landscape.epsilon:.3g}"] if landscape.epsilon > 0.0 else []
        phrase = ["over the two indices that decide most"] if has_two else []
        basis = ", ".join([aim.words, *phrase, *weight])
        self._say("map", [_own(landscape, aim), basis, *_said(landscape)])
        across, up, values = landscape.shown
        anchor = [landscape.axes[k][landscape.at[k]] for k in (0, 1)]
        self.stream.log(
            "landscape/slice",
            self.rr.AnyValues(
                across=across,
                up=up,
                values=values.ravel(),
                anchor=np.array(anchor),
                value=[landscape.value],
                sought=[aim.value],
                epsilon=[landscape.epsilon],
                level=[landscape.level],
                names=list(landscape.names()),
            ),
        )
        self._mesh(landscape, self.scale)

    def _numbers(self, shown: Floats) -> None:
        """Draw the values ``(k, k)`` under the cursor, and the colour bar, whose values are those of its colours. Where
        no decision meets the constraints there is no number, but a colour."""
        rr, stream, limits = self.rr, self.stream, self.scale
        size = len(shown)
        transform = rr.Transform3D(scale=(WIDTH / size, HEIGHT / size, 1.0))
        image = np.flipud(np.where(np.isfinite(shown), shown, np.nan).T)
        stream.log("landscape/map/g", transform, self._coloured(image, limits))
        is_infeasible = np.flipud((shown == np.inf).T)
        if is_infeasible.any():
            brown = np.zeros((size, size, 4), dtype=np.uint8)
            brown[is_infeasible] = ink.FORBIDDEN
            stream.log("landscape/map/infeasible", transform, rr.Image(brown, draw_order=1.0))
        else:
            stream.log("landscape/map/infeasible", rr.Clear(recursive=False))
        left, width = BAR
        steps = limits[1] - (limits[1] - limits[0]) * (np.arange(STEPS) + 0.5) / STEPS
        bar = rr.Transform3D(scale=(width, HEIGHT / STEPS, 1.0), translation=(left, 0.0, 0.0))
        stream.log("landscape/map/bar", bar, self._coloured(steps[:, np.newaxis], limits))

    def _coloured(self, image: Floats, limits: tuple[float, float]) -> Any:
        """Return an image of numbers, with colours from the dark to the bright end."""
        return self.rr.DepthImage(
            np.ascontiguousarray(image, dtype=np.float32),
            meter=1.0,
            colormap=self.colours,
            depth_range=limits,
            magnification_filter=self.rr.components.MagnificationFilter.Linear,
            draw_order=0.0,
        )

    @property
    def _bar(self) -> Axes:
        return Axes(BAR[0], 0.0, BAR[1], HEIGHT, (0.0, 1.0), self.scale)

    def _say(self, part: str, lines: list[str]) -> None:
        """Write what the map shows beside it, where a part of that text has changed."""
        if self.words[part] != lines:
            self.words[part] = lines
            text = "\n\n".join(line for block in self.words.values() for line in block if line)
            self.stream.log("landscape/words", self.rr.TextDocument(text, media_type="text/markdown"))

    def _anchor(self, landscape: sr.Landscape, axes: Axes) -> None:
        """Mark the tuple through which the slice goes, with the value that the slice has there."""
        pixel = axes.at(landscape.axes[0][landscape.at[0]], landscape.axes[1][landscape.at[1]])
        self.stream.log(
            "landscape/map/best",
            self.rr.Points2D(
                pixel,
                colors=[ink.ORANGE],
                radii=self.rr.Radius.ui_points(6.0),
                draw_order=60.0,
            ),
        )

    def visit(self, stage: Stage) -> None:
        """Draw the path of a search on the landscape that is shown."""
        landscape = self.known
        if landscape is None:
            return
        assert landscape.seen is not None
        path = shadow(stage, landscape.seen)
        if path is None or landscape.epsilon != _weight(stage.epsilon):
            for name in ("tried", "refused", "walk", "now", "sketch"):
                self.stream.log(f"landscape/map/{name}", self.rr.Clear(recursive=True))
            return
        self._path(path, stage)
        self._sketches(landscape, stage)

    def _path(self, path: Shadow, stage: Stage) -> None:
        assert self.known is not None
        axes, rr = self._axes(self.known), self.rr
        indices = np.unique(np.linspace(max(0, len(path.points) - 4 * TRIED), len(path.points) - 1, TRIED).astype(int))
        values = stage.values[len(stage.values) - len(path.points) :][indices]
        shades = ink.sequential(np.clip((values - self.scale[0]) / (self.scale[1] - self.scale[0]), 0.0, 1.0))
        shades[values == np.inf] = ink.FORBIDDEN
        for name, mask, rim, size in (
            ("tried", ~path.refused[indices], ink.TRIED, 2.6),
            ("refused", path.refused[indices], ink.REFUSED, 1.8),
        ):
            pixels = axes.at(path.points[indices][mask, 0], path.points[indices][mask, 1])
            # a rim, by which dots of the map's colour are seen
            rims = np.tile(np.array(rim, dtype=np.uint8), (len(pixels), 1))
            radii = rr.Radius.ui_points(np.repeat([size + 0.9, size], len(pixels)))
            spots = rr.Points2D(
                np.concatenate([pixels, pixels]),
                colors=np.concatenate([rims, shades[mask]]),
                radii=radii,
                draw_order=40.0,
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
        marks, colours, sizes = [axes.at(path.now[0], path.now[1])], [ink.INK], [4.0]
        for restart in path.restarts[-6:]:
            marks.append(axes.at(restart[0], restart[1]))
            colours.append(ink.PURPLE)
            sizes.append(3.5)
        landscape = self.known
        slots = stage.best.reshape(-1, stage.block) if stage.best.size else np.zeros((0, 1))
        if slots.shape == landscape.anchor.shape and not np.array_equal(slots, landscape.anchor) and stage.pair:
            assert landscape.seen is not None
            pair = (stage.pair[0], stage.pair[-1])
            first, second = landscape.seen.places(pair, slots)
            marks.append(axes.at(slots[first], slots[second]))
            colours.append(ink.HALF)
            sizes.append(4.5)
        self.stream.log(
            "landscape/map/now",
            rr.Points2D(np.concatenate(marks), colors=colours, radii=rr.Radius.ui_points(sizes), draw_order=61.0),
        )

    def _sketches(self, landscape: sr.Landscape, stage: Stage) -> None:
        """Draw what a maximiser shows of itself, over where the indices are that decide in the middle of each."""
        axes, legend = self._axes(landscape), list[str]()
        for role, sketch in stage.sketches.items():
            path = f"landscape/map/sketch/{''.join(c if c.isalnum() else '_' for c in role)}"
            assert landscape.seen is not None
            corners = outlines_on(landscape.seen, stage.coordinates, sketch)
            if corners is None or not sketch.count:
                continue
            lower, upper = corners
            is_cut = not sketch.points and sketch.count > SHOWN
            words = f"white: {role}, {SHOWN} of {sketch.count}" if is_cut else f"white: {role}"
            legend.append(f"blue: {role}" if sketch.points else words)
            if sketch.points:
                pixels = axes.at(lower[:, 0], lower[:, 1])
                self.stream.log(
                    path,
                    self.rr.Points2D(
                        pixels,
                        colors=[ink.SKY],
                        radii=self.rr.Radius.ui_points(2.5),
                        draw_order=47.0,
                    ),
                )
                continue
            outlines = [axes.at(line[:, 0], line[:, 1]) for line in _outlines(lower, upper, sketch.rounded)[-SHOWN:]]
            self.stream.log(
                path,
                self.rr.LineStrips2D(
                    outlines,
                    colors=[ink.SKETCH],
                    radii=self.rr.Radius.ui_points(0.6),
                    draw_order=42.0,
                ),
            )

        if stage.walks:
            legend.append("white line: the walk of the search, and where it is now")
        self._say("search", legend)

    def mark(self, words: str) -> None:
        """Mark the tuple through which the slice goes, with ``words`` of what is proven of it."""
        landscape = self.known
        if landscape is not None:
            pixel = self._axes(landscape).at(*(landscape.axes[k][landscape.at[k]] for k in (0, 1)))
            drawing = Drawing()
            drawing.dot(pixel, ink.PURPLE, 9.0)
            drawing.log(self.rr, self.stream, "landscape/map/exact")
            self._say("exact", [f"pink: {words}"])

    def _scale(self, landscape: sr.Landscape, aim: Aim) -> tuple[float, float]:
        """Return the values of the dark and of the bright end; one colour for a flat slice, which has no range. The
        value that the search has, which may lie below the map, has a colour of its own where half of them are left for
        the map."""
        low, high = landscape.limits
        if not np.isfinite(low):
            return 0.0, 1.0
        if landscape.flat or high <= low:
            return low - 1.0, low + 1.0
        return (max(min(low, aim.value), 2.0 * low - high) if np.isfinite(aim.value) else low), high

    def _axes(self, landscape: sr.Landscape) -> Axes:
        ends = [(float(axis[0]), float(axis[-1])) for axis in landscape.axes]
        return Axes(0.0, 0.0, WIDTH, HEIGHT, ends[0], ends[1])

    def _mesh(self, landscape: sr.Landscape, scale: tuple[float, float]) -> None:
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
        unit_across, unit_up = ((axis - axis[0]) / (axis[-1] - axis[0]) for axis in (across, up))
        X, Y = np.meshgrid(unit_across, unit_up, indexing="ij")
        slope_x, slope_y = np.gradient(heights, unit_across, unit_up)
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
        point_height = float(np.clip((landscape.value - scale[0]) / (scale[1] - scale[0]), 0.0, 1.0)) + LIFT
        label_height = 1.0 + LIFT + POLE
        self.stream.log(
            "landscape/surface/best",
            self.rr.Points3D(
                [[*at, point_height]],
                colors=[ink.ORANGE],
                radii=self.rr.Radius.ui_points(6.0),
            ),
        )
        self.stream.log(
            "landscape/surface/pole",
            self.rr.LineStrips3D(
                [[[*at, point_height], [*at, label_height - WORDS]]],
                colors=[ink.ORANGE],
                radii=self.rr.Radius.ui_points(0.6),
            ),
        )
        names = landscape.names(self.unit)
        flat = landscape.flat
        corners = {  # words are bright, so that each has the dark ground behind it
            (at[0], at[1], label_height): f"best {landscape.value:.6g}",
            (0.5, -0.12, 0.0): f"{names[0]}: {across[0]:.3g} to {across[-1]:.3g}",
            (1.12, 0.5, 0.0): f"{names[1]}: {up[0]:.3g} to {up[-1]:.3g}",
            (0.0, 0.0, 1.05): ", ".join(_said(landscape)) if flat else f"g = {scale[1]:.4g}",
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


def _said(landscape: sr.Landscape) -> list[str]:
    """Say what the colours mean, or that there is nothing to see."""
    low, high = landscape.limits
    has_infeasible = bool((landscape.shown[2] == np.inf).any())
    if not np.isfinite(low):
        return ["no control meets the constraints anywhere", "here: g is infinite"]
    if landscape.flat or high == low:
        if landscape.level > 1:  # what lies between the lines is not known yet
            return [f"g is {low:.6g} on all lines of this coarse grid"]
        return [f"g does not depend on these two here: {low:.6g}"]
    digits = int(np.clip(2 - np.floor(np.log10((high - low) / max(abs(low), abs(high)))), 5, 12))  # that differ
    lines = [f"g from {low:.{digits}g} (dark) to {high:.{digits}g} (bright)"]
    return [*lines, "brown: no control meets the constraints"] if has_infeasible else lines


def _own(landscape: sr.Landscape, aim: Aim) -> str:
    """Describe the value of the best tuple, and how far it is below the map, where the disturbances are the worst."""
    deficit = landscape.value - aim.value
    if not deficit > VISIBLE * max(1.0, abs(landscape.value)):
        return f"orange dot: the best tuple, g = {landscape.value:.6g}"
    return (
        f"orange dot: the best tuple, g = {aim.value:.6g}, {deficit:.2g} below the map, which has the worst"
        " disturbances at these two indices"
    )


def _numbers_beside(limits: tuple[float, float]) -> list[tuple[float, str]]:
    """Return round values beside the colour bar, with as many digits as tell them apart."""
    values = ticks(*limits, 4)
    digits = next(n for n in range(4, 18) if len({f"{value:.{n}g}" for value in values}) == values.size or n == 17)
    return [(float(value), f"{value:.{digits}g}") for value in values]


def _weight(epsilon: float) -> float:
    return epsilon if np.isfinite(epsilon) else 0.0


def _outlines(lower: Floats, upper: Floats, rounded: bool) -> list[Floats]:
    """Return the outlines ``(k, 2)`` of boxes, or of the ellipses within them."""
    turn = np.linspace(0.0, 2.0 * np.pi, 33)
    unit = (
        np.column_stack([np.cos(turn), np.sin(turn)])
        if rounded
        else np.array([[-1.0, -1.0], [1.0, -1.0], [1.0, 1.0], [-1.0, 1.0], [-1.0, -1.0]])
    )
    return [(low + high) / 2 + (high - low) / 2 * unit for low, high in zip(lower, upper, strict=True)]
