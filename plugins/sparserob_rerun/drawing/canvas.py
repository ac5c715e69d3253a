"""A plot as plain geometry: axes, ticks, curves and hatching in the pixels of a 2-D view.

The viewer plots against its timelines only; the physics is a plot against the time of the system, which is another
axis.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from hashlib import blake2b
from typing import Any, final
from weakref import WeakKeyDictionary

import numpy as np

from sparserob_rerun.drawing.palette import FAINT, GREY, GROUND, INK, Colour, Floats, worded

HATCHES = 60
STROKES = 160
"""Upright strokes of a band. With a tenth of them its edges are steps; with ten times as many a picture of the control
is a megabyte."""
LINE = 34.0  # units between two numbers on an axis upwards: a line of words is 26 high, and the lowest is lifted
LEAST = 5e-4
"""Least height of a panel that shows values, as a share of the best value. With a tenth of it the numbers beside it are
wider than their room; with ten times as much, the last tenths of a search look flat."""
LIFTED, BELOW = 8.0, 17.0  # how far above the lower edge the lowest number upwards is, and how far below those across
ASIDE = 13.0
"""Distance by which the lowest number upwards is further left where there are numbers across. With 0 it lies on the
first of them, with much more it is outside the panel."""
LETTER = 5.0  # half the width of a letter, in units of a drawing that is a little smaller than its panel
SHOWN: WeakKeyDictionary[Any, dict[str, dict[str, bytes]]] = WeakKeyDictionary()
"""Entities of the last drawing below each path, of every stream: the viewer keeps an entity until it hears of it again,
so one that has not changed is not sent."""
LIFT = 9.0  # the viewer writes labels this far below their points


@final
@dataclass(frozen=True, eq=False)
class Axes:
    """A plot ``width`` by ``height`` pixels with its upper left corner at ``(left, top)``; ``x`` and ``y`` are the
    limits of its axes."""

    left: float
    top: float
    width: float
    height: float
    x: tuple[float, float]
    y: tuple[float, float]

    def at(self, x: Floats | float, y: Floats | float) -> Floats:
        """Return the pixels ``(k, 2)`` of points; what lies outside the limits is drawn to the edge."""
        across = self.left + self.width * (np.asarray(x, dtype=float) - self.x[0]) / (self.x[1] - self.x[0])
        down = self.top + self.height * (self.y[1] - np.asarray(y, dtype=float)) / (self.y[1] - self.y[0])
        points = np.stack(np.broadcast_arrays(across, down), axis=-1).reshape(-1, 2)
        return np.asarray(np.clip(points, (self.left, self.top), (self.left + self.width, self.top + self.height)))


@final
class Drawing:
    """Lines and labels in layers: collected first, then logged as few entities, because many of them slow the viewer
    down."""

    def __init__(self) -> None:
        self.strips: dict[str, list[tuple[Floats, Colour, float]]] = {}  # pixels of a line, or of many of them
        self.labels: list[tuple[Floats, str, Colour]] = []
        self.dots: list[tuple[Floats, Colour, float]] = []

    def line(self, layer: str, points: Floats, colour: Colour, width: float = 1.5) -> None:
        """Draw a curve through pixels ``(k, 2)``."""
        self.strips.setdefault(layer, []).append((points, colour, width))

    def strokes(self, layer: str, ends: Floats, colour: Colour, width: float = 1.5) -> None:
        """Draw straight lines between pixels ``(m, 2, 2)``."""
        self.strips.setdefault(layer, []).append((ends, colour, width))

    def dashed(self, layer: str, points: Floats, colour: Colour, dash: float = 6.0) -> None:
        """Draw a dashed straight line between two pixels ``(2, 2)``."""
        length = float(np.linalg.norm(points[1] - points[0]))
        starts = np.arange(0.0, length, 2.0 * dash)
        ends = np.stack([starts, np.minimum(starts + dash, length)], axis=1) / max(length, 1e-9)
        self.strokes(layer, points[0] + ends[:, :, np.newaxis] * (points[1] - points[0]), colour, 1.0)

    def dot(self, points: Floats, colour: Colour, size: float = 4.0) -> None:
        """Draw dots at pixels ``(k, 2)``."""
        self.dots.append((points, colour, size))

    def text(self, x: float, y: float, words: str, colour: Colour = INK) -> None:
        """Write words centred at a pixel."""
        self.labels.append((np.array([x, y - LIFT]), words, colour))

    def frame(
        self,
        axes: Axes,
        title: str,
        x_label: str = "",
        ticks_below: bool = True,
        decades: bool = False,
        room: float = 1.0,
    ) -> None:
        """Draw the box, ticks at round numbers, the name of what is plotted above it, and that of the axis at its end.
        ``decades``: the values upwards are decimal logarithms. ``room``: how large words are in units of the drawing,
        which is more in a panel that is small."""
        left, top, right, bottom = axes.left, axes.top, axes.left + axes.width, axes.top + axes.height
        self.line("frame", np.array([[left, top], [left, bottom], [right, bottom]]), GREY, 1.0)
        tick_values = _apart(axes, room * LINE, decades, room * LIFTED)
        digits = next(
            n for n in range(6, 18) if len({f"{value:.{n}g}" for value in tick_values}) == tick_values.size or n == 17
        )
        for value in tick_values:
            y = float(axes.at(axes.x[0], value)[0, 1])
            self.line("frame", np.array([[left - 5, y], [left, y]]), GREY, 1.0)
            words = f"1e{value:g}" if decades else f"{value:.{digits}g}"
            y = min(y, bottom - room * LIFTED)  # above the corner, where the first number across has its place
            aside = ASIDE if ticks_below and y > bottom + room * (BELOW - LINE) else 0.0
            self.text(left - room * (10 + aside + LETTER * len(words)), y, words, GREY)
        for value in ticks(*axes.x):
            x = float(axes.at(value, axes.y[0])[0, 0])
            self.line("frame", np.array([[x, bottom], [x, bottom + 5]]), GREY, 1.0)
            if ticks_below:
                self.text(x, bottom + BELOW * room, f"{value:g}", GREY)
        if axes.y[0] < 0.0 < axes.y[1]:
            self.line("frame", axes.at(np.array(axes.x), np.zeros(2)), FAINT, 0.7)
        if title:
            self.text((left + right) / 2, top - 16 * room, title)
        if x_label:
            self.text(right + room * (22 + LETTER * len(x_label)), bottom - 12 * room, x_label, GREY)

    def band(self, layer: str, axes: Axes, x: Floats, lower: Floats, upper: Floats, colour: Colour) -> None:
        """Fill the area between two curves with upright strokes."""
        grid = np.linspace(x[0], x[-1], STROKES)
        low, high = axes.at(grid, np.interp(grid, x, lower)), axes.at(grid, np.interp(grid, x, upper))
        width = axes.width * (x[-1] - x[0]) / (axes.x[1] - axes.x[0]) / grid.size
        self.strokes(layer, np.stack([low, high], axis=1), colour, width)

    def hatched(self, layer: str, axes: Axes, x: tuple[float, float], y: tuple[float, float], colour: Colour) -> None:
        """Hatch a forbidden box."""
        self.forbidden(layer, axes, axes.at(np.array([x[0], x[1], x[1], x[0]]), np.repeat(y, 2)), colour)

    def forbidden(self, layer: str, axes: Axes, corners: Floats, colour: Colour) -> None:
        """Hatch a forbidden convex polygon, of pixels ``(k, 2)`` in their order, with strokes from lower left to upper
        right."""
        if np.ptp(corners, axis=0).min() < 1.0:
            return
        levels = corners.sum(axis=1)  # downwards is positive: a stroke is where this is the same
        next_corners, next_levels = np.roll(corners, -1, axis=0), np.roll(levels, -1)
        stroke_levels = np.arange(levels.min(), levels.max(), axes.width / HATCHES)[1:, np.newaxis]
        # two sides by each stroke, as the polygon is convex
        is_crossed = (levels > stroke_levels) != (next_levels > stroke_levels)
        strokes, sides = np.nonzero(is_crossed)
        share = ((stroke_levels[strokes, 0] - levels[sides]) / (next_levels[sides] - levels[sides]))[:, np.newaxis]
        points = corners[sides] + share * (next_corners[sides] - corners[sides])
        self.strokes(layer, points.reshape(-1, 2, 2), colour, 1.0)

    def log(self, rr: Any, stream: Any, path: str, static: bool = False, layers: Sequence[str] = ()) -> None:
        """Log what has changed below ``path`` since the drawing before, later ``layers`` above earlier ones; clear the
        entities of that drawing which this one has not."""
        order = {layer: 10.0 * (index + 1) for index, layer in enumerate(layers)}
        entities: dict[str, tuple[list[Any], Callable[[], Any]]] = {
            layer: (strips, partial(_strips, rr, layer, strips, order.get(layer, 5.0)))
            for layer, strips in self.strips.items()
        }
        if self.labels:
            entities["labels"] = self.labels, partial(_labels, rr, self.labels)
        if self.dots:
            entities["dots"] = self.dots, partial(_dots, rr, self.dots)
        previous, current = SHOWN.setdefault(stream, {}).get(path, {}), dict[str, bytes]()
        for name in sorted(set(previous) - set(entities)) if not static else ():
            stream.log(f"{path}/{name}", rr.Clear(recursive=False))
        for name, (content, archetype) in entities.items():
            current[name] = _digest(content)
            if previous.get(name) != current[name]:
                stream.log(f"{path}/{name}", archetype(), static=static)
        SHOWN[stream][path] = current


def _digest(parts: list[Any]) -> bytes:
    """Return a digest that changes when the lines, dots or words change."""
    digest = blake2b(digest_size=16)
    for entry in parts:
        for piece in entry:
            digest.update(
                np.ascontiguousarray(piece).tobytes() if isinstance(piece, np.ndarray) else repr(piece).encode()
            )
    return digest.digest()


def _strips(rr: Any, layer: str, strips: list[tuple[Floats, Colour, float]], order: float) -> Any:
    blocks = [points if points.ndim == 3 else points[np.newaxis] for points, _, _ in strips]
    counts = [len(block) for block in blocks]
    widths = np.repeat([width / 2 for _, _, width in strips], counts)
    return rr.LineStrips2D(
        _joined(rr, blocks),
        colors=np.repeat(np.array([colour for _, colour, _ in strips], dtype=np.uint8), counts, axis=0),
        radii=rr.Radius.ui_points(widths) if layer != "tube" else widths,
        draw_order=order,
    )


def _joined(rr: Any, blocks: Sequence[Floats]) -> Any:
    """Return lines ``(m, k, 2)`` as the column of all lines that the library makes of them, which converts every line
    by itself: a hundred times as slow, and half of what a picture of the control takes."""
    import pyarrow as pa

    lengths = np.concatenate([[0], *(np.full(len(block), block.shape[1]) for block in blocks)])
    points = rr.encodings.Vec2DBatch(np.concatenate([block.reshape(-1, 2) for block in blocks])).as_arrow_array()
    lines = pa.list_(pa.field("item", points.type, nullable=False))
    return pa.ListArray.from_arrays(pa.array(np.cumsum(lengths), pa.int32()), points, type=lines)


def _labels(rr: Any, labels: list[tuple[Floats, str, Colour]]) -> Any:
    return rr.Points2D(
        np.array([pixel for pixel, _, _ in labels]),
        labels=[words for _, words, _ in labels],
        colors=[worded(colour) for _, _, colour in labels],
        radii=rr.Radius.ui_points(0.0),
        show_labels=True,
        draw_order=90.0,
    )


def _dots(rr: Any, dots: list[tuple[Floats, Colour, float]]) -> Any:
    points = np.concatenate([pixels for pixels, _, _ in dots])
    sizes = np.concatenate([np.full(len(pixels), size) for pixels, _, size in dots])
    colours = np.concatenate([np.tile(colour, (len(pixels), 1)) for pixels, colour, _ in dots]).astype(np.uint8)
    return rr.Points2D(points, colors=colours, radii=rr.Radius.ui_points(sizes), draw_order=80.0)


def _apart(axes: Axes, line: float, whole: bool, lifted: float = 0.0) -> Floats:
    """Return round numbers on the axis upwards, as many as there is room for, with a ``line`` from one to the next; at
    least two, where there are as many. ``whole``: whole numbers only. ``lifted``: how far above the lower edge the
    lowest one is written at least."""
    choices = [values for values in (ticks(*axes.y, count) for count in (5, 4, 3, 2, 1)) if values.size > 1]
    choices = [values for values in choices if not whole or (values == np.rint(values)).all()] or [ticks(*axes.y)]
    unit = axes.height / (axes.y[1] - axes.y[0])
    heights = [np.maximum(unit * (values - axes.y[0]), lifted) for values in choices]
    fit = (v for v, h in zip(choices, heights, strict=True) if v.size > 1 and float(np.diff(h).min()) >= line)
    ends = [values[[0, -1]] for values in choices]  # where there is no room for one between, the two furthest apart
    return next(fit, max(ends, key=lambda pair: float(pair[1] - pair[0])))


def ticks(low: float, high: float, most: int = 5) -> Floats:
    """Return round numbers within limits."""
    span = high - low
    raw = span / most
    power = 10.0 ** np.floor(np.log10(raw))
    step = next(power * factor for factor in (1.0, 2.0, 2.5, 5.0, 10.0) if power * factor >= raw * (1 - 1e-12))
    first = np.ceil(low / step - 1e-9)
    values = step * np.arange(first, np.floor(high / step + 1e-9) + 1)
    return np.where(np.abs(values) < 1e-12 * span, 0.0, values)


def view(origin: str, name: str, extent: tuple[float, float, float, float], contents: str = "$origin/**") -> Any:
    """Return a view of the ``contents``, by default of all that is drawn below ``origin``. Its left, right, top and
    bottom are the ``extent``."""
    import rerun.blueprint as rrb

    left, right, top, bottom = extent
    return rrb.Spatial2DView(
        origin=origin,
        contents=contents.split(),
        name=name,
        background=list(GROUND[:3]),
        visual_bounds=rrb.VisualBounds2D(x_range=(left, right), y_range=(top, bottom)),
    )
