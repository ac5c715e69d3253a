"""The figure of profiles: which share of the problems each contender solves, against the best one and against what it
may spend."""

from __future__ import annotations

from math import ceil
from textwrap import fill
from typing import TYPE_CHECKING, Any

import numpy as np

from sparserob_core.experiment.comparison.figure import COLOURS, DASHES, LINE, MARKERS
from sparserob_core.experiment.comparison.profiles import LOWER, MIDDLE, UPPER, Profiles
from sparserob_core.experiment.figures import style as look

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from sparserob_core.sip.convex_set import Array


def draw_profiles(profiles: Profiles) -> Figure:
    """Two panels: performance profiles on the left, data profiles on the right. A band lies between the profiles of the
    quartiles over seeds where there are several seeds."""
    from matplotlib.figure import Figure

    texts = [fill(name, LINE) for name in profiles.contenders]
    columns = 2 if max(map(len, texts)) <= LINE // 2 else 1
    lines = ceil(sum(text.count("\n") + 1 for text in texts) / columns)
    figure = Figure(figsize=(look.FIGURE_WIDTH, 3.2 + 0.165 * lines), layout="constrained")
    left_ax, right_ax = figure.subplots(1, 2, sharey=True)
    has_band = max(len(seeds) for seeds in profiles.seeds) > 1
    for s, text in enumerate(texts):
        pen = {
            "color": COLOURS[s % len(COLOURS)],
            "linestyle": DASHES[s // len(COLOURS) % len(DASHES)],
            "marker": MARKERS[s % len(MARKERS)],
            "linewidth": 1.2 + 1.2 * (len(texts) - 1 - s) / max(len(texts) - 1, 1),
        }
        for ax, values in ((left_ax, profiles.ratios), (right_ax, profiles.costs)):
            contender_values = [values(share)[:, s] for share in (MIDDLE, LOWER, UPPER)]
            _draw_contender(
                ax,
                contender_values,
                has_band,
                _compute_ends(values(MIDDLE)),
                {**pen, "label": text} if ax is left_ax else pen,
            )
    _draw_axes(left_ax, right_ax, profiles)
    figure.legend(*left_ax.get_legend_handles_labels(), loc="outside lower left", ncols=columns, fontsize=9)
    figure.suptitle(profiles.title, x=0.012, ha="left", fontsize=11.5)
    return figure


def _compute_ends(values: Array) -> tuple[float, float]:
    """Return the ends of the axis: a little before the first step of any contender, and after the last one."""
    finite_values = values[np.isfinite(values)]
    return (float(finite_values.min()) / 1.05, 1.3 * float(finite_values.max())) if finite_values.size else (1.0, 2.0)


def _draw_contender(ax: Axes, values: list[Array], band: bool, ends: tuple[float, float], pen: dict[str, Any]) -> None:
    """The steps of one contender, and the band between its quartiles."""
    step_positions, share = _compute_profile(values[0], ends)
    ax.plot(
        step_positions,
        share,
        drawstyle="steps-post",
        markersize=4,
        markevery=slice(1, len(step_positions) - 1),
        zorder=3,
        **pen,
    )
    if band:
        steps = np.concatenate([quartile[(quartile > ends[0]) & (quartile < ends[1])] for quartile in values[1:]])
        positions = np.unique([*ends, *steps])
        early, late = (np.array([np.mean(quartile <= position) for position in positions]) for quartile in values[1:])
        ax.fill_between(positions, late, early, step="post", color=pen["color"], alpha=0.15, linewidth=0, zorder=2)


def _compute_profile(values: Array, ends: tuple[float, float]) -> tuple[Array, Array]:
    positions, counts = np.unique(values[np.isfinite(values)], return_counts=True)
    share = np.cumsum(counts) / values.size
    return np.array([ends[0], *positions, ends[1]]), np.array([0.0, *share, share[-1] if positions.size else 0.0])


def _draw_axes(left: Axes, right: Axes, profiles: Profiles) -> None:
    from matplotlib.ticker import LogLocator, NullFormatter, PercentFormatter, StrMethodFormatter

    for ax, values in ((left, profiles.ratios()), (right, profiles.costs())):
        first, last = _compute_ends(values)
        ax.set_xscale("log")
        ax.set_xlim(first, last)
        ax.xaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0) if last < 100.0 * first else (1.0,)))
        ax.xaxis.set_major_formatter(StrMethodFormatter("{x:g}"))
        ax.xaxis.set_minor_formatter(NullFormatter())
        ax.grid(axis="y", color=look.MIST, linewidth=0.6)
        ax.set_axisbelow(True)
    left.set_ylim(-0.03, 1.05)
    left.yaxis.set_major_formatter(PercentFormatter(1.0, decimals=0))
    left.set_ylabel(f"problems solved within {profiles.accuracy:.3g}")
    left.set_title("performance profile")
    right.set_title("data profile")
    left.set_xlabel(f"{profiles.measure}, relative to the best")
    right.set_xlabel("evaluations / $(n + 1)$" if profiles.measure == "evaluations" else "seconds")
