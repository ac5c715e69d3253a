"""The figure of a search: the climb of g in every stage of epsilon, the bound that its multipliers prove, and what the
maximiser noted."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from sparserob_core.experiment.figures import style as look
from sparserob_core.experiment.figures.figure_data import measured
from sparserob_core.experiment.figures.style import require_matplotlib, style, write_figure
from sparserob_core.sip.result import SearchTrace

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from sparserob_core.sip.convex_set import Array

NOTES = 3  # of the maximiser, at most, each in a panel of its own
MEAN = 50  # evaluations over which the share of accepted ones is taken
ROOM = 0.11  # share of the evaluations from which on a stage has room for words
FINEST = 1e-10  # of the highest value: what is nearer to it is drawn there
VIEW = 1.5  # the view of the bound reaches down by this many times the size of the optimum
MANY = 3000  # dots beyond which a figure for print holds them as a picture
FIRST = ("temperature", "accepted", "scale", "depth", "constant")


def write_climb(
    directory: Path, trace: SearchTrace, title: str, upper: float = np.inf, *, exact: bool = False, unit: str = ""
) -> list[Path]:
    """Draw ``climb`` into ``directory``, as PDF and PNG. ``upper``: the proven upper bound of the unregularised
    program, ``inf`` where there is none; ``exact``: the two bounds have met, so that it is its value; ``unit``: that of
    the cost, where it is known. Returns the files; raises `InputError` where they cannot be written, and without
    matplotlib."""
    require_matplotlib()
    with style():
        return write_figure(directory / "climb", draw_climb(trace, title, upper, exact=exact, unit=unit))


def draw_climb(trace: SearchTrace, title: str, upper: float = np.inf, *, exact: bool = False, unit: str = "") -> Figure:
    """Against the evaluations: how far g is below the highest value of its stage of epsilon, for every proposal, for
    the accepted walk where the maximiser walks, and for the best so far; the proven lower bound, also as a share of the
    exact value, or of the upper bound, where that is known; and up to three of the maximiser's notes, the temperature
    first."""
    from matplotlib.figure import Figure

    noted = _noted(trace)
    heights = [2.6, 1.35, *[0.95] * len(noted)]
    figure = Figure(figsize=(look.WIDTH, sum(heights) + 1.25), layout="constrained")
    axes: list[Axes] = list(
        figure.subplots(len(heights), 1, sharex=True, squeeze=False, height_ratios=heights)[:, 0],
    )
    stages = list(_stages(trace))
    _draw_climb(axes[0], trace, stages, unit)
    _draw_bound(axes[1], trace, upper, exact, unit)
    for ax, name in zip(axes[2:], noted, strict=True):
        changing = np.nan_to_num(trace.gains) != 0.0 if name == "accepted" else True
        _draw_note(ax, name, np.where(changing, trace.notes[name], np.nan), stages)
    for ax in axes:
        for _, first, _ in stages[1:]:
            ax.axvline(first + 0.5, color=look.GREY, linewidth=0.6, linestyle=":", zorder=0)
        for place in _restarts(trace):
            ax.axvline(place + 0.5, color=look.PURPLE, linewidth=0.7, zorder=0, label="walk heated again")
    axes[-1].set_xlabel("evaluations of $g$")
    axes[-1].set_xlim(0.0, trace.value.size + 1.0)
    axes[0].set_title(title, pad=36)
    entries = {label: handle for ax in axes for handle, label in zip(*ax.get_legend_handles_labels(), strict=True)}
    figure.legend(entries.values(), entries.keys(), loc="outside lower center", ncols=3, columnspacing=1.6)
    figure.align_ylabels(axes)
    return figure


def _stages(trace: SearchTrace) -> Iterator[tuple[float, int, int]]:
    """Every search: its epsilon, and its evaluations as ``first:last``."""
    starts = np.flatnonzero(np.diff(trace.outer, prepend=-1.0))
    for first, last in zip(starts, [*starts[1:], trace.outer.size], strict=True):
        yield float(trace.epsilon[first]), int(first), int(last)


def _draw_climb(ax: Axes, trace: SearchTrace, stages: list[tuple[float, int, int]], unit: str) -> None:
    short, lead, tops = _below(trace, stages)
    floor = _floor(np.concatenate([short, lead]), tops)
    short, lead = np.maximum(short, floor), np.maximum(lead, floor)
    _dots(ax, trace, short)
    walked = _accepted(trace)
    number = np.arange(1, short.size + 1)
    for k, (_, first, last) in enumerate(stages):
        mine = np.flatnonzero(walked[first:last]) + first
        one: dict[str, Any] = {"drawstyle": "steps-post"}
        ax.plot(number[first:last], lead[first:last], color=look.ORANGE, linewidth=2.4, label="best so far", **one)
        if mine.size:  # the walk stays where it was until the end
            places = np.append(number[mine], last)
            ax.plot(
                places, short[np.append(mine, mine[-1])], color=look.BLUE, linewidth=0.9, label="accepted walk", **one
            )
        _stage_words(ax, k, stages, tops[k])
    ax.set_yscale("log")
    ax.set_ylim(_deepest([*short, *lead]) * 2.0, floor / 2.0)  # the highest value is at the top
    ticks = [10.0**power for power in range(-15, 16) if 3.0 * floor <= 10.0**power <= ax.get_ylim()[0]]
    ax.set_yticks([floor, *ticks], ["highest", *(f"$10^{{{round(np.log10(tick))}}}$" for tick in ticks)], minor=False)
    ax.minorticks_off()
    ax.set_ylabel(measured("$g$ below the highest\nof its stage", unit))


def _below(trace: SearchTrace, stages: list[tuple[float, int, int]]) -> tuple[Array, Array, list[float]]:
    """How far every value, and the best so far, is below the highest of its stage, nan where it is not finite; and the
    highest of every stage."""
    short, lead, tops = np.full(trace.value.size, np.nan), np.full(trace.value.size, np.nan), []
    for _, first, last in stages:
        mine = np.where(np.isfinite(trace.value[first:last]), trace.value[first:last], np.nan)
        tops.append(float(np.nanmax(mine)) if np.isfinite(mine).any() else np.nan)
        short[first:last], lead[first:last] = tops[-1] - mine, tops[-1] - np.fmax.accumulate(mine)
    return short, lead, tops


def _floor(below: Array, tops: list[float]) -> float:
    """The place of the highest values themselves, which a logarithmic axis does not have: under everything else."""
    finest = FINEST * max([abs(top) for top in tops if np.isfinite(top)], default=1.0)
    positive = below[below > finest]
    return float(positive.min()) / 4.0 if positive.size else max(finest, 1e-12)


def _deepest(below: Sequence[float]) -> float:
    return max((value for value in below if np.isfinite(value)), default=1.0)


def _stage_words(ax: Axes, k: int, stages: list[tuple[float, int, int]], top: float) -> None:
    """The weight and the highest value above a stage, where there is room for them."""
    epsilon, first, last = stages[k]
    share = (last - first) / stages[-1][2]
    if share >= ROOM:
        ax.text(
            (first + last + 1) / 2,
            1.02,
            rf"$\varepsilon$ = {epsilon:.3g}" + "\n" + rf"$g$ = {top:.{6 if share >= 1.4 * ROOM else 4}g}",
            transform=ax.get_xaxis_transform(),
            fontsize=8.5,
            color=look.GREY,
            ha="center",
            va="bottom",
        )


def _dots(ax: Axes, trace: SearchTrace, short: Array) -> None:
    noted = trace.notes.get("accepted", np.full(short.size, np.nan))
    number = np.arange(1, short.size + 1)
    refused = noted == 0.0
    for mine, colour, label in (
        (refused, look.MIST, "proposal, refused"),
        (~refused & ~_accepted(trace), "#A9CDE3", "evaluated"),
    ):
        if np.isfinite(short[mine]).any():
            ax.plot(
                number[mine],
                short[mine],
                ".",
                markersize=4.0,
                markeredgewidth=0,
                color=colour if colour != look.MIST else "#BDBDBD",
                zorder=1,
                label=label,
                rasterized=short.size > MANY,
            )


def _accepted(trace: SearchTrace) -> np.ndarray:
    return np.asarray(trace.notes.get("accepted", np.full(trace.value.size, np.nan)) == 1.0)


def _restarts(trace: SearchTrace) -> list[int]:
    """Where a walk was heated again within a search: its temperature rises tenfold from one note to the next."""
    heat = trace.notes.get("temperature", np.zeros(0))
    where = np.flatnonzero(np.isfinite(heat))
    one, other = where[:-1], where[1:]
    risen = (heat[other] > 10.0 * heat[one]) & (trace.outer[one] == trace.outer[other])
    return [int(place) for place in other[risen]]


def _draw_bound(ax: Axes, trace: SearchTrace, upper: float, exact: bool, unit: str) -> None:
    number = np.arange(1, trace.bound.size + 1)
    known = np.isfinite(trace.bound)
    ax.plot(
        number[known],
        trace.bound[known],
        drawstyle="steps-post",
        color=look.GREEN,
        linewidth=1.5,
        label="proven lower bound of $J$",
        zorder=3,
    )
    ax.set_ylabel(measured("cost $J$", unit))
    if not known.any():
        ax.text(0.5, 0.5, "no bound was proven", transform=ax.transAxes, ha="center", color=look.GREY)
        return
    top = float(max(upper if np.isfinite(upper) else -np.inf, trace.bound[known].max()))
    low = max(float(trace.bound[known].min()), top - VIEW * abs(top)) if top else float(trace.bound[known].min())
    margin = 0.08 * max(top - low, 1e-9 * max(1.0, abs(top)))
    ax.set_ylim(low - margin, top + margin)
    if np.isfinite(upper):
        said = f"exact value of $J$: {upper:.7g}" if exact else f"proven upper bound of $J$: {upper:.7g}"
        ax.axhline(
            upper, color=look.INK if exact else look.VERMILLION, linewidth=0.9, linestyle=(0, (6, 4)), label=said
        )
        if upper > 0.0:
            share = ax.secondary_yaxis(
                "right", functions=(lambda J: 100.0 * np.asarray(J) / upper, lambda s: np.asarray(s) * upper / 100.0)
            )
            share.set_ylabel("% of exact" if exact else "% of upper", fontsize=9)


def _noted(trace: SearchTrace) -> list[str]:
    """The notes that are drawn."""
    known = [name for name, column in trace.notes.items() if np.isfinite(column).any()]
    return sorted(known, key=lambda name: FIRST.index(name) if name in FIRST else len(FIRST))[:NOTES]


def _draw_note(ax: Axes, name: str, column: Array, stages: list[tuple[float, int, int]]) -> None:
    noted = column[np.isfinite(column)]
    if name == "accepted":
        ax.set_ylim(-0.05, 1.05)
    elif (noted > 0).all() and noted.max() > 100.0 * noted.min():
        ax.set_yscale("log")
    for _, first, last in stages:
        where = np.flatnonzero(np.isfinite(column[first:last])) + first
        values = _mean(column[where]) if name == "accepted" else column[where]
        ax.plot(where + 1, values, color=look.VERMILLION, linewidth=1.0)
    ax.set_ylabel(f"accepted, of the\nlast {MEAN} changes" if name == "accepted" else name.replace("_", " "))


def _mean(values: Array) -> Array:
    """The mean of the last `MEAN` values at every place."""
    sums, place = np.concatenate([[0.0], np.cumsum(values)]), np.arange(1, values.size + 1)
    first = np.maximum(place - MEAN, 0)
    return np.asarray((sums[place] - sums[first]) / (place - first))
