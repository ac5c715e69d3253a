"""The figure of the adversary: the worst disturbances, and what they do to the state."""

from __future__ import annotations

from collections.abc import Mapping
from textwrap import shorten
from typing import TYPE_CHECKING, Any

import numpy as np

from sparserob_core.experiment.figures import style as look
from sparserob_core.experiment.figures.figure_data import FigureData, plain
from sparserob_core.experiment.figures.run_figures import draw_time_axis, draw_walls
from sparserob_core.experiment.figures.style import draw_legend, held, panels
from sparserob_core.sip.convex_set import Array

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

COLOURS = (look.BLUE, look.GREEN, look.PURPLE, look.ORANGE, look.INK)  # vermillion is the terminal set's
DASHES: tuple[Any, ...] = ("solid", (0, (5, 2)), (0, (1.5, 1.5)))


def draw_adversary(arrays: Mapping[str, Array], data: FigureData) -> Figure:
    """Above the states under the worst case of every constraint, with a dot where it is attained, below the
    disturbances that cause them."""
    disturbances = arrays["disturbances"]
    states, channels = len(data.drawn_states), disturbances.shape[1]
    figure, axes = panels(states + channels, 1.7, extra=0.35)
    paths = [_select_corner(*worst, data) for worst in zip(arrays["states"], arrays["directions"], strict=True)]
    for number, name in enumerate(arrays["names"].tolist()):
        pen = {"color": COLOURS[number % len(COLOURS)], "linestyle": DASHES[number // len(COLOURS) % len(DASHES)]}
        index = int(np.abs(arrays["state_times"] - arrays["times"][number]).argmin())
        for component, ax in zip(data.drawn_states, axes[:states], strict=True):
            path = paths[number][component]
            ax.plot(
                arrays["state_times"],
                path,
                linewidth=1.4,
                zorder=3 - 0.01 * number,
                label=f"worst case of {plain(str(name))}",
                **pen,
            )
            if arrays["directions"][number, component]:
                ax.plot(
                    arrays["times"][number],
                    path[index],
                    "o",
                    color=pen["color"],
                    markersize=5,
                    markeredgecolor="white",
                    markeredgewidth=0.7,
                    zorder=6,
                    clip_on=False,
                )
        for channel, ax in enumerate(axes[states:]):
            ax.stairs(
                *held(disturbances[number, channel], arrays["breakpoints"]),
                baseline=None,
                linewidth=1.3,
                zorder=3 - 0.01 * number,
                **pen,
            )
    for component, ax in zip(data.drawn_states, axes[:states], strict=True):
        draw_tube(ax, data, component)
        finish_panel(ax, data, component, tuple(path[component] for path in paths))
    for channel, ax in enumerate(axes[states:]):
        ax.axhline(0.0, color=look.GREY, linewidth=0.6, zorder=1)
        ax.set_ylabel(f"$w_{{{channel + 1}}}(t)$" if channels > 1 else "$w(t)$")
        ax.margins(y=0.15)
    caption(figure, axes, data, f"the worst case of every constraint: {_name_uncertainties(arrays, data)}")
    return figure


def _select_corner(states: Array, direction: Array, data: FigureData) -> Array:
    """Return the states ``(d, T)`` of a worst case, at the corner of the parameters that fits its direction."""
    return data.names.corners.select_corner(direction, states)


def _name_uncertainties(arrays: Mapping[str, Array], data: FigureData) -> str:
    """Name the quantities in which the worst cases differ from the nominal case, such as the disturbance, in words."""
    is_known = ~np.isnan(data.state[:, 0])
    initial_state_varies = not np.allclose(
        arrays["initial_states"][:, is_known], data.state[is_known, 0], rtol=1e-9, atol=0.0
    )
    kinds = {
        "disturbance": arrays["disturbances"].any(),
        "parameter": arrays["parameters"].shape[1] > 0 or bool(data.names.corners),
        "noise": "noises" in arrays,
        "initial state": initial_state_varies,
    }
    words = [kind for kind, differs in kinds.items() if differs]
    is_open = bool((data.tube_upper > data.tube_lower).any())  # then the control is not delivered as it is commanded
    alone = "delivery of the control" if is_open else "nothing is uncertain"
    return " and ".join(filter(None, [", ".join(words[:-1]), *words[-1:]])) or alone


def draw_tube(ax: Axes, data: FigureData, component: int) -> None:
    """The worst-case tube of one state."""
    lower, upper = data.tube_lower[component], data.tube_upper[component]
    ax.fill_between(data.times, lower, upper, color=look.SKY, alpha=0.4, linewidth=0, zorder=2, label="worst-case tube")
    for edge in (lower, upper):
        ax.plot(data.times, edge, color=look.SKY, linewidth=0.8, zorder=2)


def finish_panel(ax: Axes, data: FigureData, component: int, curves: tuple[Array, ...], tube: bool = True) -> None:
    """Limits around everything that is drawn, the ``tube`` or not, then the walls within them."""
    walls = [wall for wall in data.walls if wall.state == component]
    edges = [edge for wall in walls for edge in wall.edges]
    drawn = [*curves, *([data.tube_lower[component], data.tube_upper[component]] if tube else [])]
    low = min([*edges, *(float(curve.min()) for curve in drawn)])
    high = max([*edges, *(float(curve.max()) for curve in drawn)])
    margin = 0.12 * max(high - low, 1e-9)
    ax.set_ylim(low - margin, high + margin)
    draw_walls(ax, walls)
    ax.set_ylabel(data.state_label(component))


def caption(figure: Figure, axes: list[Axes], data: FigureData, text: str) -> None:
    """The time axis, the title, a line of text, and the legend."""
    draw_time_axis(axes[-1], data)
    axes[0].set_title(shorten(data.title, 80, placeholder=" ...") + data.of_states, pad=20)
    axes[0].text(0.0, 1.045, text, transform=axes[0].transAxes, fontsize=9.5, color=look.GREY)
    draw_legend(figure, axes)
    figure.align_ylabels(axes)
