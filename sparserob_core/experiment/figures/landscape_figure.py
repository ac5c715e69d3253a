"""The figure of the landscape of g: a slice through the best tuple that a search has found, with the walk on it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, final

import numpy as np

from sparserob_core.errors import InputError
from sparserob_core.experiment.figures import style as look
from sparserob_core.sip.convex_set import Array

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

VISIBLE = 1e-6  # of g: what two solvers make of one value differs by less, and what is seen by more
FLAT_VALUE_SHARE = 1e-9  # of the value: what varies by less does not vary
MAX_DRAWN_POINTS = 2000  # visited points that are drawn


@final
@dataclass(frozen=True, eq=False, kw_only=True)
class LandscapeData:
    """A slice of ``g`` at the weight ``epsilon`` through a tuple of indices, along its only coordinate or over two.

    ``axes``: the values of each, ``(k,)`` or ``(k,)`` and ``(l,)``, called ``names``; ``values (k,)`` or ``(k, l)``,
    ``inf`` where no decision meets the constraints. ``best`` is the place of the tuple ``(1 or 2,)``, where g has the
    value ``best_value``; ``own_value`` is what the tuple itself has, whose disturbances need not be the worst.
    ``visited (n, 1 or 2)`` are the points that the search evaluated at this weight, in these
    coordinates only, with their ``visited_values (n,)``; ``accepted (n,)``: which of them the walk accepted, 1 or 0,
    NaN where it says nothing.
    """

    title: str
    epsilon: float
    axes: Sequence[Array]
    names: Sequence[str]
    values: Array
    best: Array
    best_value: float
    own_value: float
    visited: Array
    visited_values: Array
    accepted: Array = field(default_factory=lambda: np.empty(0))

    def __post_init__(self) -> None:
        shape = tuple(axis.size for axis in self.axes)
        if len(shape) not in (1, 2) or self.values.shape != shape:
            raise InputError(f"values: expected one or two axes and one value for each point of them, got {shape}")

    @property
    def flat(self) -> bool:
        """True where ``g`` is constant on the slice, up to rounding, and finite."""
        finite_values = self.values[np.isfinite(self.values)]
        spread = float(finite_values.max() - finite_values.min()) if finite_values.size else 0.0
        return bool(
            finite_values.size == self.values.size
            and spread <= FLAT_VALUE_SHARE * max(1.0, float(np.abs(finite_values).max()))
        )


def draw_landscape(data: LandscapeData) -> Figure:
    """A map of two coordinates, or a curve over one, with the visited points, the accepted walk and the best tuple."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(look.FIGURE_WIDTH, 5.2 if len(data.axes) == 2 else 3.6), layout="constrained")
    ax = figure.subplots()
    if len(data.axes) == 2:
        _draw_map(figure, ax, data)
    else:
        _draw_curve(ax, data)
    ax.set_xlabel(data.names[0])
    ax.set_title(data.title, pad=22)
    ax.text(0.0, 1.02, _write_caption(data), transform=ax.transAxes, fontsize=9.5, color=look.GREY, va="bottom")
    handles, labels = ax.get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=4, columnspacing=1.4, handlelength=1.4)
    return figure


def _write_caption(data: LandscapeData) -> str:
    if data.flat:
        return f"$g$ does not depend on {' and '.join(data.names)} here: it is {data.best_value:.6g}"
    if data.best_value - data.own_value > VISIBLE * max(1.0, abs(data.best_value)):
        on_the_map = (
            f"its own $g$ is {data.own_value:.6g}, on the map, with the worst disturbances, {data.best_value:.6g}"
        )
        return f"all other coordinates as in the best tuple: {on_the_map}"
    return f"all other coordinates as in the best tuple, where $g$ = {data.best_value:.7g}"


def _draw_map(figure: Figure, ax: Axes, data: LandscapeData) -> None:
    from matplotlib.patheffects import Normal, Stroke

    across, up = data.axes
    values = np.where(np.isfinite(data.values), data.values, np.nan)
    if np.isfinite(values).any():
        low, high = float(np.nanmin(values)), float(np.nanmax(values))
        if data.flat:
            low, high = low - max(abs(low), 1.0), high + max(abs(high), 1.0)  # one colour, in the middle of the bar
        image = ax.pcolormesh(
            across, up, values.T, shading="nearest", cmap="viridis", vmin=low, vmax=high, rasterized=True
        )
        if not data.flat:
            ax.contour(across, up, values.T, levels=9, colors="white", linewidths=0.35, alpha=0.6)
            bar = figure.colorbar(image, ax=ax, pad=0.02)
            bar.set_label(rf"$g$ at $\varepsilon$ = {data.epsilon:.3g}")
            bar.ax.ticklabel_format(axis="y", useOffset=False)
            bar.outline.set_visible(False)
    ax.set_facecolor(look.MIST)
    if np.isposinf(data.values).any():
        ax.plot([], [], "s", color=look.MIST, markeredgecolor="#C4C4C4", label="no control meets these constraints")
    accepted_places = np.flatnonzero(data.accepted == 1.0)
    refused, evaluated = data.accepted == 0.0, np.isnan(data.accepted)
    for mask, colour, label in ((refused, "#D9D9D9", "refused"), (evaluated, "white", "evaluated")):
        few = _thin_out(np.flatnonzero(mask))
        if few.size:
            ax.plot(
                *data.visited[few].T,
                ".",
                color=colour,
                markersize=4,
                markeredgecolor=look.GREY,
                markeredgewidth=0.3,
                zorder=3,
                label=label,
                rasterized=few.size > MAX_DRAWN_POINTS // 4,
            )
    if accepted_places.size:
        path = data.visited[accepted_places]
        has_moved = np.append(True, (np.diff(path, axis=0) != 0.0).any(axis=1))
        few = _thin_out(np.flatnonzero(has_moved))
        edge = [Stroke(linewidth=2.6, foreground=look.INK), Normal()]  # white in ink: seen on dark and on bright ground
        ax.plot(*path[few].T, color="white", linewidth=1.1, zorder=4, label="accepted walk", path_effects=edge)
    ax.plot(
        *data.best,
        "*",
        color=look.ORANGE,
        markersize=13,
        markeredgecolor=look.INK,
        markeredgewidth=0.7,
        zorder=6,
        clip_on=False,
        linestyle="none",
        label="best tuple",
    )
    ax.set_xlim(float(across[0]), float(across[-1]))
    ax.set_ylim(float(up[0]), float(up[-1]))
    ax.set_ylabel(data.names[1])


def _draw_curve(ax: Axes, data: LandscapeData) -> None:
    (across,) = data.axes
    ax.plot(across, np.where(np.isfinite(data.values), data.values, np.nan), color=look.BLUE, label="$g$ along it")
    few = _thin_out(np.flatnonzero(np.isfinite(data.visited_values)))
    ax.plot(
        data.visited[few, 0], data.visited_values[few], ".", color=look.GREY, markersize=4, label="evaluated", zorder=1
    )
    ax.plot(
        data.best,
        [data.best_value],
        "*",
        color=look.ORANGE,
        markersize=13,
        markeredgecolor=look.INK,
        markeredgewidth=0.7,
        label="best tuple",
        linestyle="none",
    )
    ax.set_ylabel(rf"$g$ at $\varepsilon$ = {data.epsilon:.3g}")


def _thin_out(places: np.ndarray) -> np.ndarray:
    """Return at most `MAX_DRAWN_POINTS` of the places, evenly chosen, with the first and the last among them."""
    return (
        places[np.unique(np.linspace(0, places.size - 1, MAX_DRAWN_POINTS).astype(int))]
        if places.size > MAX_DRAWN_POINTS
        else places
    )
