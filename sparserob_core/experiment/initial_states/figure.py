"""The picture of a set of feasible initial states: between its two polygons the boundary, inside the least cost as
colour."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from sparserob_core.experiment.figures import style as look
from sparserob_core.experiment.figures.figure_data import label, measured, plain

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.cm import ScalarMappable
    from matplotlib.figure import Figure

    from sparserob_core.experiment.initial_states.feasible_set import InitialStates
    from sparserob_core.sip.convex_set import Array

LEVELS = 12  # bands of colour, about
COLOURS = "viridis"  # perceptually uniform, and one for eyes that see fewer colours (Smith and van der Walt 2015)
SET_MARGIN = 0.07  # of the set's extent, around it
HEIGHT = 5.3
PICTURE_DISTANCE = 0.35  # of the set's extent: an initial state that is no further away than this is in the picture
MIN_DRAWN_EXTENT = 1e-6  # of the picture, the least extent of a set that is drawn as one with interior


def draw_initial_states(found: InitialStates) -> Figure:
    """The set with its inner boundary solid and its outer one dashed, the path sets at time 0, and the config's own
    initial state."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(look.FIGURE_WIDTH, HEIGHT), layout="constrained")
    ax = figure.subplots()
    low, high = found.outer.min(axis=0), found.outer.max(axis=0)
    extent = np.maximum(high - low, 0.05 * np.abs(found.outer).max(axis=0) + np.finfo(float).tiny)
    near = (found.start >= low - PICTURE_DISTANCE * extent).all() and (
        found.start <= high + PICTURE_DISTANCE * extent
    ).all()
    if near:
        low, high = np.minimum(low, found.start), np.maximum(high, found.start)
    middle, half = (low + high) / 2, np.maximum(high - low, extent) * (0.5 + SET_MARGIN)
    ax.set_xlim(middle[0] - half[0], middle[0] + half[0])
    ax.set_ylim(middle[1] - half[1], middle[1] + half[1])
    if (np.ptp(found.outer, axis=0) > MIN_DRAWN_EXTENT * extent).all() and found.inner.shape[0] > 2:
        _draw_costs(figure, ax, found)
    elif found.costs.size:
        _draw_colour_bar(
            figure,
            ax,
            ax.scatter(found.points[:, 0], found.points[:, 1], c=found.costs, cmap=COLOURS, s=36, zorder=7),
            found.cost_unit,
        )
    _draw_boundaries(ax, found)
    if near:
        ax.plot(
            *found.start,
            marker="o",
            markersize=6.5,
            markerfacecolor="white",
            markeredgecolor=look.VERMILLION,
            markeredgewidth=1.8,
            linestyle="",
            zorder=7,
            clip_on=False,
            label="the config's initial state",
        )
    ax.set_title(plain(found.title))
    labels = [
        label(found.called.states, found.called.state_units, "x", k, found.origin.size, "0") for k in found.states
    ]
    ax.set_xlabel(labels[0])
    ax.set_ylabel(labels[1])
    figure.legend(
        *ax.get_legend_handles_labels(),
        loc="outside lower left",
        ncols=2,
        columnspacing=1.8,
        handlelength=2.2,
        labelspacing=0.35,
    )
    return figure


def _draw_costs(figure: Figure, ax: Axes, found: InitialStates) -> None:
    """Bands of the largest convex function below the measured costs: between them it lies above the optimal cost, which
    is convex too."""
    from matplotlib.patches import Polygon
    from matplotlib.ticker import MaxNLocator
    from matplotlib.tri import Triangulation

    inside = Polygon(found.inner, closed=True, facecolor=look.MIST, edgecolor="none", zorder=1)
    ax.add_patch(inside)
    if found.costs.size < 4 or np.ptp(found.costs) <= 0.0:
        return
    triangles = envelope(found.points, found.costs)
    top = float(found.costs.max())
    levels = MaxNLocator(LEVELS).tick_values(float(found.costs.min()), top)
    mesh = Triangulation(found.points[:, 0], found.points[:, 1], triangles)
    bands = ax.tricontourf(mesh, found.costs, levels=levels, cmap=COLOURS, zorder=2)
    lines = ax.tricontour(mesh, found.costs, levels=levels[1:-1], colors="white", linewidths=0.5, alpha=0.7, zorder=3)
    for drawn in (bands, lines):
        drawn.set_clip_path(inside)
    _draw_colour_bar(figure, ax, bands, found.cost_unit)


def _draw_colour_bar(figure: Figure, ax: Axes, coloured: ScalarMappable, unit: str) -> None:
    bar = figure.colorbar(coloured, ax=ax, pad=0.02, aspect=28)
    bar.set_label(measured("cost $J$ of a proven control", unit))
    bar.outline.set_linewidth(0.0)
    bar.ax.tick_params(length=0)


def envelope(points: Array, costs: Array) -> np.ndarray:
    """The triangles ``(t, 3)`` of the lower convex envelope of costs ``(v,)`` at points ``(v, 2)``."""
    from scipy.spatial import ConvexHull

    low, extent = points.min(axis=0), np.ptp(points, axis=0)
    lifted = np.hstack([(points - low) / extent, (costs / np.ptp(costs))[:, None]])
    above = [*lifted[:, :2].mean(axis=0), lifted[:, 2].max() + 1.0]
    hull = ConvexHull(np.vstack([lifted, above]), qhull_options="Qt")
    downward = hull.equations[:, 2] < -1e-12
    return np.asarray(hull.simplices[downward & (hull.simplices < points.shape[0]).all(axis=1)])


def _draw_boundaries(ax: Axes, found: InitialStates) -> None:
    (x_min, x_max), (y_min, y_max) = ax.get_xlim(), ax.get_ylim()
    visible_polygons = [
        polygon for polygon in found.path if ((polygon > [x_min, y_min]) & (polygon < [x_max, y_max])).all(axis=1).any()
    ]
    for number, polygon in enumerate(visible_polygons):
        ax.plot(
            *_close_polygon(polygon),
            color=look.GREY,
            linewidth=1.1,
            linestyle=(0, (1, 1.4)),
            zorder=4,
            label="path set at time 0" if not number else None,
        )
    ax.plot(
        *_close_polygon(found.outer),
        color=look.VERMILLION,
        linewidth=1.1,
        linestyle=(0, (5, 2.5)),
        zorder=5,
        label=f"{'no affine policy' if found.gains.size else 'infeasible'} outside, proven",
    )
    if found.inner.shape[0]:
        ax.plot(*_close_polygon(found.inner), color=look.INK, linewidth=1.4, zorder=6, label="feasible inside, proven")


def _close_polygon(vertices: Array) -> Array:
    return np.vstack([vertices, vertices[:1]]).T
