"""What the figures of the page share: columns of panels, forbidden regions, terminal brackets, small files."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

import sparserob_core as sr
from sparserob_core.experiment.figures import style as look

if TYPE_CHECKING:
    from cloud import Cloud
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

FORBIDDEN = "#C4C4C4"


def columns(rows: int, count: int, width: float, height: float) -> tuple[Figure, np.ndarray]:
    """A figure of ``rows x count`` panels, each ``width x height`` inches: one time axis, and one scale per row."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(count * width + 0.6, rows * height + 1.1), layout="constrained")
    axes = figure.subplots(rows, count, sharex=True, sharey="row", squeeze=False)
    figure.get_layout_engine().set(wspace=0.03, hspace=0.03)
    return figure, axes


def forbid(ax: Axes, problem: sr.OptimalControlProblem, state: int, cloud: Cloud) -> None:
    """Hatch what the path constraints forbid to one state, colour what of the worst case is there, and mark the
    terminal set.

    The limits of the axis must be known.
    """
    bottom, top = ax.get_ylim()
    for window in problem.path:
        end = problem.horizon if window.stop is None else window.stop
        for edge, outside in zip(_interval(window.set, state), (bottom, top), strict=True):
            if np.isfinite(edge):
                ax.fill_between(
                    [window.start, end],
                    edge,
                    outside,
                    facecolor=look.MIST,
                    edgecolor=FORBIDDEN,
                    hatch="////",
                    linewidth=0,
                    zorder=0,
                    label="forbidden",
                )
                ax.plot([window.start, end], [edge, edge], color=look.GREY, linewidth=1.0, zorder=1)
                _beyond(ax, cloud, state, (window.start, end), edge, outside > edge)
    for terminal in problem.terminal:
        ends = _interval(terminal, state) if isinstance(terminal, sr.ConvexSet) else (terminal.values[state],) * 2
        if np.isfinite(ends).all():
            ax.plot(
                [problem.horizon] * 2,
                ends,
                color=look.GREEN,
                linewidth=3.0,
                clip_on=False,
                zorder=6,
                label="terminal set",
            )
            ax.plot(
                [problem.horizon] * 2,
                ends,
                linestyle="",
                marker=0,
                markersize=6,
                markeredgewidth=1.8,
                color=look.GREEN,
                clip_on=False,
                zorder=6,
            )


def _beyond(ax: Axes, cloud: Cloud, state: int, window: tuple[float, float], edge: float, above: bool) -> None:
    inside = (cloud.times >= window[0] - 1e-9) & (cloud.times <= window[1] + 1e-9)
    worst = (cloud.upper if above else cloud.lower)[state]
    reached = np.maximum(worst, edge) if above else np.minimum(worst, edge)
    if inside.any() and np.abs(reached[inside] - edge).max() > 1e-6:
        ax.fill_between(
            cloud.times[inside],
            edge,
            reached[inside],
            color=look.ORANGE,
            alpha=0.6,
            linewidth=0,
            zorder=1,
            label="worst case where it is forbidden",
        )


def _interval(bounds: sr.ConvexSet, state: int) -> tuple[float, float]:
    axis = np.eye(bounds.dimension)[state : state + 1]
    return -float(bounds.support(-axis)[0]), float(bounds.support(axis)[0])


def judged(ax: Axes, title: str, outcome: sr.Outcome, cloud: Cloud) -> None:
    """A heading that says how many draws break a constraint, and by how much the worst case does, or that it is proven
    that it does not."""
    share, proven = f"{100 * cloud.broken.mean():.3g} % of draws break it", outcome.status in ("certified", "verified")
    heading(
        ax,
        title,
        f"{share}; proven: none can" if proven else f"{share}; worst by {outcome.result.worst.violation:.3g}",
        look.GREEN if proven else look.VERMILLION,
    )


def heading(ax: Axes, title: str, remark: str, colour: str = look.GREY) -> None:
    """A title, and one smaller line below it."""
    ax.set_title(title, pad=19, fontsize=11)
    ax.text(0.0, 1.04, remark, transform=ax.transAxes, fontsize=9, color=colour, in_layout=False)


def legend(figure: Figure, axes: np.ndarray, per_row: int = 6) -> None:
    """One legend below all panels, every entry once."""
    entries = {label: handle for ax in axes.flat for handle, label in zip(*ax.get_legend_handles_labels(), strict=True)}
    figure.legend(
        entries.values(),
        entries.keys(),
        loc="outside lower center",
        ncols=min(per_row, len(entries)),
        columnspacing=1.6,
        handlelength=1.6,
        handletextpad=0.6,
    )


def write(figure: Figure, directory: Path, name: str) -> None:
    """``name.png`` at print quality (200 dots per inch), in a palette of 256 colours; the same figure gives the same
    bytes."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from PIL import Image

    canvas = FigureCanvasAgg(figure)
    figure.set_dpi(200)
    canvas.draw()
    directory.mkdir(parents=True, exist_ok=True)
    picture = Image.fromarray(np.asarray(canvas.buffer_rgba())).convert("RGB")
    small = picture.quantize(256, method=Image.Quantize.MAXCOVERAGE, kmeans=2, dither=Image.Dither.NONE)
    small.save(directory / f"{name}.png", optimize=True, dpi=(200, 200))
