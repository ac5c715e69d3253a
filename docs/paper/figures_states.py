"""State trajectories of several controls side by side: ten thousand draws, those that break a constraint, and the worst
case."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from cloud import Cloud, reachable_end
from figure_parts import columns, forbid, heading, judged, legend, write

import sparserob_core as sr
from sparserob_core.experiment.figures import style as look

if TYPE_CHECKING:
    from matplotlib.axes import Axes

LINES = 120  # trajectories that are drawn one by one; the band behind them holds them all


def draw_states(
    directory: Path,
    name: str,
    titles: Mapping[str, str],
    outcomes: Mapping[str, sr.Outcome],
    clouds: Mapping[str, Cloud],
    known: bool = True,
) -> None:
    """One column per control, one row per state ``x1, x2``; ``known``: the worst case is exact, not the worst of a
    lattice of parameters."""
    with look.style():
        figure, axes = columns(2, len(titles), 2.45 if len(titles) > 2 else 3.3, 1.9)
        for column, (study, title) in enumerate(titles.items()):
            trajectories(
                axes[:, column],
                outcomes[study],
                clouds[study],
                "worst case" if known else "worst case of a lattice of parameters",
            )
            judged(axes[0, column], title, outcomes[study], clouds[study])
            axes[-1, column].set_xlabel("time $t$")
        for state in range(2):
            axes[state, 0].set_ylabel(f"$x_{{{state + 1}}}(t)$")
        _limit(axes, [clouds[study] for study in titles])
        for column, study in enumerate(titles):
            for state in range(2):
                forbid(axes[state, column], outcomes[study].problem, state, clouds[study])
        legend(figure, axes, 6 if len(titles) > 3 else 3)
        write(figure, directory, name)


def trajectories(axes: Sequence[Axes], outcome: sr.Outcome, cloud: Cloud, worst: str) -> None:
    """The draws of one control, one panel per state: the band of all, some one by one, and the edges of the worst case,
    named ``worst``."""
    chosen = np.flatnonzero(~cloud.broken)[:LINES]
    guilty = np.flatnonzero(cloud.broken)[: LINES // 3]
    for state, ax in enumerate(axes):
        paths = cloud.states[:, :, state]
        ax.fill_between(
            cloud.times,
            paths.min(axis=0),
            paths.max(axis=0),
            color=look.SKY,
            alpha=0.35,
            linewidth=0,
            zorder=2,
            label="10 000 draws",
        )
        ax.plot(cloud.times, paths[chosen].T, color=look.BLUE, linewidth=0.25, alpha=0.35, zorder=3)
        for number, path in enumerate(paths[guilty]):
            ax.plot(
                cloud.times,
                path,
                color=look.VERMILLION,
                linewidth=0.4,
                alpha=0.8,
                zorder=4,
                label=None if number else "draws that break it",
            )
        for number, edge in enumerate((cloud.lower[state], cloud.upper[state])):
            ax.plot(
                cloud.times,
                edge,
                color=look.INK,
                linewidth=1.0,
                linestyle=(0, (4, 2)),
                zorder=5,
                label=None if number else worst,
            )
    axes[0].set_xlim(0.0, 1.02 * outcome.problem.horizon)


def _limit(axes: np.ndarray, clouds: Sequence[Cloud]) -> None:
    for state in range(2):
        low, high = min(cloud.lower[state].min() for cloud in clouds), max(cloud.upper[state].max() for cloud in clouds)
        margin = 0.08 * (high - low)
        axes[state, 0].set_ylim(
            min(low - margin, -0.85 if state == 0 else 0.0), max(high + margin, 0.85 if state == 0 else 0.0)
        )


def draw_ends(
    directory: Path,
    name: str,
    titles: Mapping[str, str],
    outcomes: Mapping[str, sr.Outcome],
    clouds: Mapping[str, Cloud],
) -> None:
    """The plane of ``x(T)``: where ten thousand draws end, where disturbances can lead, and the terminal set."""
    from matplotlib.figure import Figure
    from matplotlib.patches import Polygon, Rectangle

    with look.style():
        figure = Figure(figsize=(look.FIGURE_WIDTH, 3.5), layout="constrained")
        axes = figure.subplots(1, len(titles), squeeze=False)
        for ax, (study, title) in zip(axes[0], titles.items(), strict=True):
            box = next(terminal for terminal in outcomes[study].problem.terminal if isinstance(terminal, sr.Box))
            ends, corners = clouds[study].states[:, -1, :2], reachable_end(outcomes[study])
            ax.add_patch(
                Polygon(
                    corners,
                    facecolor=look.MIST,
                    edgecolor=look.INK,
                    linewidth=1.0,
                    linestyle=(0, (4, 2)),
                    zorder=1,
                    label="all that disturbances can reach",
                )
            )
            ax.add_patch(
                Rectangle(
                    (box.lower[0], box.lower[1]),
                    *(box.upper - box.lower)[:2],
                    facecolor="none",
                    edgecolor=look.GREEN,
                    linewidth=2.0,
                    zorder=4,
                    label="terminal set",
                )
            )
            ax.plot(*ends.T, ".", color=look.BLUE, markersize=1.2, markeredgewidth=0, zorder=3, label="10 000 draws")
            ax.plot(
                *ends[_outside(outcomes[study], clouds[study])].T,
                "o",
                color=look.VERMILLION,
                markersize=2.5,
                markeredgewidth=0,
                zorder=5,
            )
            heading(ax, title, f"$|w_i|$ ≤ {outcomes[study].problem.disturbance.upper[0]:g}")
            ax.set_xlabel("$x_1(5)$")
            ax.set_aspect("equal")
            ax.autoscale_view()
            ax.margins(0.08)
        axes[0, 0].set_ylabel("$x_2(5)$")
        handles = {label: handle for handle, label in zip(*axes[0, 0].get_legend_handles_labels(), strict=True)}
        missed = any(_outside(outcomes[study], clouds[study]).any() for study in titles)
        for label, colour in (("10 000 draws", look.BLUE), *([("draws outside", look.VERMILLION)] if missed else [])):
            handles[label] = axes[0, 0].plot([], [], "o", color=colour, markersize=4, markeredgewidth=0)[0]
        figure.legend(
            handles.values(),
            handles.keys(),
            loc="outside lower center",
            ncols=len(handles),
            columnspacing=1.2,
            handletextpad=0.5,
        )
        write(figure, directory, name)


def _outside(outcome: sr.Outcome, cloud: Cloud) -> np.ndarray:
    terminal = next(terminal for terminal in outcome.problem.terminal if isinstance(terminal, sr.ConvexSet))
    return np.asarray(terminal.violation(cloud.states[:, -1]) > 1e-9)
