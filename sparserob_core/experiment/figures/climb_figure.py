"""The figure of a search: the climb of g in every stage of epsilon, the bound that its multipliers prove, and what the
maximiser noted."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from sparserob_core.experiment.figures import style as look
from sparserob_core.experiment.figures.figure_data import measured
from sparserob_core.sip.result import SearchTrace

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from sparserob_core.sip.convex_set import Array

NOTES = 3  # of the maximiser, at most, each in a panel of its own
MEAN = 50  # evaluations over which the share of accepted ones is taken
MIN_LABELLED_SHARE = 0.11  # share of the evaluations from which on a stage has room for words
NEAREST_TO_HIGHEST = 1e-10  # of the highest value: what is nearer to it is drawn there
MAX_VECTOR_DOTS = 3000  # dots beyond which a figure for print holds them as a picture
FIRST = ("temperature", "accepted", "scale", "depth", "constant")


def draw_climb(trace: SearchTrace, title: str, upper: float = np.inf, *, exact: bool = False, unit: str = "") -> Figure:
    """Against the evaluations: how far g is below the highest value of its stage of epsilon, for every proposal, for
    the accepted walk where the maximiser walks, and for the best so far; the proven lower bound, also as a share of the
    exact value, or of the upper bound, where that is known; and up to three of the maximiser's notes, the temperature
    first."""
    from matplotlib.figure import Figure

    note_names = _choose_notes(trace)
    heights = [2.6, 1.35, *[0.95] * len(note_names)]
    figure = Figure(figsize=(look.FIGURE_WIDTH, sum(heights) + 1.25), layout="constrained")
    axes: list[Axes] = list(
        figure.subplots(len(heights), 1, sharex=True, squeeze=False, height_ratios=heights)[:, 0],
    )
    stages = list(_list_stages(trace))
    _draw_climb(axes[0], trace, stages, unit)
    _draw_bound(axes[1], trace, upper, exact, unit)
    for ax, name in zip(axes[2:], note_names, strict=True):
        changing = np.nan_to_num(trace.gains) != 0.0 if name == "accepted" else True
        _draw_note(ax, name, np.where(changing, trace.notes[name], np.nan), stages)
    for ax in axes:
        for _, first, _ in stages[1:]:
            ax.axvline(first + 0.5, color=look.GREY, linewidth=0.6, linestyle=":", zorder=0)
        for evaluation in _find_restarts(trace):
            ax.axvline(evaluation + 0.5, color=look.PURPLE, linewidth=0.7, zorder=0, label="walk heated again")
    axes[-1].set_xlabel("evaluations of $g$")
    axes[-1].set_xlim(0.0, trace.value.size + 1.0)
    axes[0].set_title(title, pad=36)
    entries = {label: handle for ax in axes for handle, label in zip(*ax.get_legend_handles_labels(), strict=True)}
    figure.legend(entries.values(), entries.keys(), loc="outside lower center", ncols=3, columnspacing=1.6)
    figure.align_ylabels(axes)
    return figure


def _list_stages(trace: SearchTrace) -> Iterator[tuple[float, int, int]]:
    """Every search: its epsilon, and its evaluations as ``first:last``."""
    starts = np.flatnonzero(np.diff(trace.outer, prepend=-1.0))
    for first, last in zip(starts, [*starts[1:], trace.outer.size], strict=True):
        yield float(trace.epsilon[first]), int(first), int(last)


def _draw_climb(ax: Axes, trace: SearchTrace, stages: list[tuple[float, int, int]], unit: str) -> None:
    distances, best_distances, tops = _compute_distances(trace, stages)
    floor = _compute_floor(np.concatenate([distances, best_distances]), tops)
    distances, best_distances = np.maximum(distances, floor), np.maximum(best_distances, floor)
    _draw_dots(ax, trace, distances)
    is_accepted = _find_accepted(trace)
    evaluations = np.arange(1, distances.size + 1)
    for k, (_, first, last) in enumerate(stages):
        accepted = np.flatnonzero(is_accepted[first:last]) + first
        line_style: dict[str, Any] = {"drawstyle": "steps-post"}
        ax.plot(
            evaluations[first:last],
            best_distances[first:last],
            color=look.ORANGE,
            linewidth=2.4,
            label="best so far",
            **line_style,
        )
        if accepted.size:  # the walk stays where it was until the end
            places = np.append(evaluations[accepted], last)
            ax.plot(
                places,
                distances[np.append(accepted, accepted[-1])],
                color=look.BLUE,
                linewidth=0.9,
                label="accepted walk",
                **line_style,
            )
        _label_stage(ax, k, stages, tops[k])
    ax.set_yscale("log")
    ax.set_ylim(_find_largest([*distances, *best_distances]) * 2.0, floor / 2.0)  # the highest value is at the top
    ticks = [10.0**power for power in range(-15, 16) if 3.0 * floor <= 10.0**power <= ax.get_ylim()[0]]
    ax.set_yticks([floor, *ticks], ["highest", *(f"$10^{{{round(np.log10(tick))}}}$" for tick in ticks)], minor=False)
    ax.minorticks_off()
    ax.set_ylabel(measured("$g$ below the highest\nof its stage", unit))


def _compute_distances(trace: SearchTrace, stages: list[tuple[float, int, int]]) -> tuple[Array, Array, list[float]]:
    """Return the distance of every value, and of the best value so far, to the highest value of its stage, ``(n,)``
    each.

    The distance is NaN where a value is not finite. Also returns the highest value of every stage.
    """
    distances, best_distances, tops = np.full(trace.value.size, np.nan), np.full(trace.value.size, np.nan), []
    for _, first, last in stages:
        values = np.where(np.isfinite(trace.value[first:last]), trace.value[first:last], np.nan)
        tops.append(float(np.nanmax(values)) if np.isfinite(values).any() else np.nan)
        distances[first:last], best_distances[first:last] = tops[-1] - values, tops[-1] - np.fmax.accumulate(values)
    return distances, best_distances, tops


def _compute_floor(below: Array, tops: list[float]) -> float:
    """The place of the highest values themselves, which a logarithmic axis does not have: under everything else."""
    finest = NEAREST_TO_HIGHEST * max([abs(top) for top in tops if np.isfinite(top)], default=1.0)
    positive = below[below > finest]
    return float(positive.min()) / 4.0 if positive.size else max(finest, 1e-12)


def _find_largest(below: Sequence[float]) -> float:
    return max((value for value in below if np.isfinite(value)), default=1.0)


def _label_stage(ax: Axes, k: int, stages: list[tuple[float, int, int]], top: float) -> None:
    """The weight and the highest value above a stage, where there is room for them."""
    epsilon, first, last = stages[k]
    share = (last - first) / stages[-1][2]
    if share >= MIN_LABELLED_SHARE:
        ax.text(
            (first + last + 1) / 2,
            1.02,
            rf"$\varepsilon$ = {epsilon:.3g}"
            "\n"
            rf"$g$ = {top:.{6 if share >= 1.4 * MIN_LABELLED_SHARE else 4}g}",
            transform=ax.get_xaxis_transform(),
            fontsize=8.5,
            color=look.GREY,
            ha="center",
            va="bottom",
        )


def _draw_dots(ax: Axes, trace: SearchTrace, short: Array) -> None:
    accepted = trace.notes.get("accepted", np.full(short.size, np.nan))
    evaluations = np.arange(1, short.size + 1)
    refused = accepted == 0.0
    for mask, colour, label in (
        (refused, look.MIST, "proposal, refused"),
        (~refused & ~_find_accepted(trace), "#A9CDE3", "evaluated"),
    ):
        if np.isfinite(short[mask]).any():
            ax.plot(
                evaluations[mask],
                short[mask],
                ".",
                markersize=4.0,
                markeredgewidth=0,
                color=colour if colour != look.MIST else "#BDBDBD",
                zorder=1,
                label=label,
                rasterized=short.size > MAX_VECTOR_DOTS,
            )


def _find_accepted(trace: SearchTrace) -> np.ndarray:
    return np.asarray(trace.notes.get("accepted", np.full(trace.value.size, np.nan)) == 1.0)


def _find_restarts(trace: SearchTrace) -> list[int]:
    """Return the evaluations at which a walk was heated again within a search: its temperature rises more than tenfold
    from one note to the next."""
    temperatures = trace.notes.get("temperature", np.zeros(0))
    indices = np.flatnonzero(np.isfinite(temperatures))
    earlier, later = indices[:-1], indices[1:]
    is_restart = (temperatures[later] > 10.0 * temperatures[earlier]) & (trace.outer[earlier] == trace.outer[later])
    return [int(evaluation) for evaluation in later[is_restart]]


def _draw_bound(ax: Axes, trace: SearchTrace, upper: float, exact: bool, unit: str) -> None:
    evaluations = np.arange(1, trace.bound.size + 1)
    is_known = np.isfinite(trace.bound)
    ax.plot(
        evaluations[is_known],
        trace.bound[is_known],
        drawstyle="steps-post",
        color=look.GREEN,
        linewidth=1.5,
        label="proven lower bound of $J$",
        zorder=3,
    )
    ax.set_ylabel(measured("cost $J$", unit))
    if not is_known.any():
        ax.text(0.5, 0.5, "no bound was proven", transform=ax.transAxes, ha="center", color=look.GREY)
        return
    top = float(max(upper if np.isfinite(upper) else -np.inf, trace.bound[is_known].max()))
    low = (
        max(float(trace.bound[is_known].min()), top - look.VIEW_BELOW_OPTIMUM * abs(top))
        if top
        else float(trace.bound[is_known].min())
    )
    margin = 0.08 * max(top - low, 1e-9 * max(1.0, abs(top)))
    ax.set_ylim(low - margin, top + margin)
    if np.isfinite(upper):
        label = f"exact value of $J$: {upper:.7g}" if exact else f"proven upper bound of $J$: {upper:.7g}"
        ax.axhline(
            upper, color=look.INK if exact else look.VERMILLION, linewidth=0.9, linestyle=(0, (6, 4)), label=label
        )
        if upper > 0.0:
            share = ax.secondary_yaxis(
                "right", functions=(lambda J: 100.0 * np.asarray(J) / upper, lambda s: np.asarray(s) * upper / 100.0)
            )
            share.set_ylabel("% of exact" if exact else "% of upper", fontsize=9)


def _choose_notes(trace: SearchTrace) -> list[str]:
    """The notes that are drawn."""
    names = [name for name, column in trace.notes.items() if np.isfinite(column).any()]
    return sorted(names, key=lambda name: FIRST.index(name) if name in FIRST else len(FIRST))[:NOTES]


def _draw_note(ax: Axes, name: str, column: Array, stages: list[tuple[float, int, int]]) -> None:
    finite_values = column[np.isfinite(column)]
    if name == "accepted":
        ax.set_ylim(-0.05, 1.05)
    elif (finite_values > 0).all() and finite_values.max() > 100.0 * finite_values.min():
        ax.set_yscale("log")
    for _, first, last in stages:
        indices = np.flatnonzero(np.isfinite(column[first:last])) + first
        values = _average_recent(column[indices]) if name == "accepted" else column[indices]
        ax.plot(indices + 1, values, color=look.VERMILLION, linewidth=1.0)
    ax.set_ylabel(f"accepted, of the\nlast {MEAN} changes" if name == "accepted" else name.replace("_", " "))


def _average_recent(values: Array) -> Array:
    """The mean of the last `MEAN` values at every place."""
    sums, positions = np.concatenate([[0.0], np.cumsum(values)]), np.arange(1, values.size + 1)
    first = np.maximum(positions - MEAN, 0)
    return np.asarray((sums[positions] - sums[first]) / (positions - first))
