"""Controls above one another: of different designs, and for different weights of the regulariser; and minimum
attention."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from cloud import Cloud
from figure_parts import columns, forbid, judged, legend, write
from figures_states import trajectories

import sparserob_core as sr
from sparserob_core.experiment.figures import style as look

if TYPE_CHECKING:
    from matplotlib.axes import Axes


def draw_controls(directory: Path, name: str, titles: Mapping[str, str], outcomes: Mapping[str, sr.Outcome]) -> None:
    """One panel per control on a common axis, with its cost and the share of time in which it acts."""
    with look.style():
        figure, axes = columns(len(titles), 1, look.FIGURE_WIDTH - 0.6, 1.0)
        for ax, (study, title) in zip(axes[:, 0], titles.items(), strict=True):
            outcome = outcomes[study]
            steps(ax, outcome, outcome.control[0], "control")
            bound = float(outcome.problem.control.support(np.ones((1, 1)))[0])
            for edge in (-bound, bound):
                ax.axhline(
                    edge, color=look.VERMILLION, linewidth=0.8, linestyle=(0, (5, 3)), zorder=1, label="control bound"
                )
            ax.set_ylim(-1.25 * bound, 1.25 * bound)
            ax.set_ylabel("$u(t)$")
            active = 100 * outcome.summary["sparsity"]["active_fraction"]
            ax.set_title(
                f"{title}    $J$ = {outcome.result.cost:.5g},  acts {active:.1f} % of the time", fontsize=9.5, pad=4
            )
        axes[-1, 0].set_xlabel("time $t$")
        axes[-1, 0].set_xlim(0.0, outcome.problem.horizon)
        legend(figure, axes)
        write(figure, directory, name)


def draw_attention(
    directory: Path,
    name: str,
    titles: Mapping[str, str],
    outcomes: Mapping[str, sr.Outcome],
    clouds: Mapping[str, Cloud],
) -> None:
    """Minimum attention: states, control and its rate, one column per design."""
    with look.style():
        figure, axes = columns(4, len(titles), 3.3, 1.35)
        for column, (study, title) in enumerate(titles.items()):
            outcome, cloud = outcomes[study], clouds[study]
            trajectories(axes[:2, column], outcome, cloud, "worst case")
            judged(axes[0, column], title, outcome, cloud)
            axes[2, column].plot(cloud.times, cloud.states[0, :, 2], color=look.BLUE, linewidth=1.5)
            steps(axes[3, column], outcome, outcome.control[0])
            axes[3, column].set_xlabel("time $t$")
        for row, label in enumerate(("$x_1(t)$", "$x_2(t)$", "$u(t)$", "$u'(t)$")):
            axes[row, 0].set_ylabel(label)
        _attention_limits(axes, [clouds[study] for study in titles])
        for column, study in enumerate(titles):
            for state in range(3):
                forbid(axes[state, column], outcomes[study].problem, state, clouds[study])
        legend(figure, axes, 3)
        write(figure, directory, name)


def _attention_limits(axes: np.ndarray, clouds: Sequence[Cloud]) -> None:
    for state in range(2):
        low, high = min(cloud.lower[state].min() for cloud in clouds), max(cloud.upper[state].max() for cloud in clouds)
        axes[state, 0].set_ylim(low - 0.1 * (high - low), high + 0.1 * (high - low))
    axes[2, 0].set_ylim(-1.25, 1.25)
    axes[3, 0].set_ylim(-2.4, 2.4)


def steps(ax: Axes, outcome: sr.Outcome, values: sr.Array, label: str | None = None) -> None:
    """A piecewise constant signal, filled towards zero."""
    breakpoints = outcome.experiment.control.breakpoints
    ax.axhline(0.0, color=look.GREY, linewidth=0.6, zorder=1)
    ax.stairs(values, breakpoints, baseline=0.0, fill=True, color=look.SKY, alpha=0.35, linewidth=0, zorder=2)
    ax.stairs(values, breakpoints, baseline=None, color=look.BLUE, linewidth=1.3, zorder=3, label=label)
