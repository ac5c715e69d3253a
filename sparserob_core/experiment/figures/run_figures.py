"""The figures of a run: the control, the worst-case tube of every state, gains and effort, and the bounds that meet."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from typing import TYPE_CHECKING

import numpy as np

from sparserob_core.experiment.figures import style as look
from sparserob_core.experiment.figures.figure_data import MAX_STATES, FigureData, Wall, measured, plain
from sparserob_core.experiment.figures.plane_figure import draw_plane
from sparserob_core.experiment.figures.style import draw_legend, held, panels
from sparserob_core.sip.result import relative_gap

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from sparserob_core.sip.convex_set import Array
    from sparserob_core.sip.program import ConstraintFamily, SemiInfiniteProgram
    from sparserob_core.sip.result import Result

MAX_FAMILIES = 6  # in one figure: with twice as many panels it is longer than a page
SLACK_POINTS = 2001  # of a curve: with a tenth peaks of long filters are corners, ten times as many are a megabyte
MAX_GAINS = 16  # pictures of gains in one figure
# Half the least height of a switching function, in prices: at 15 the band is a line, at 1 it hides its edge
MIN_SWITCHING_HEIGHT = 1.5
HEADROOM = 1.15  # of the largest value, above it: at 1 it is on the frame, at 10 the band is a line
IDLE_SHARE_OF_BOUND = 1e-7  # of the control's bound: less than that is no action but rounding


def run_pictures(data: FigureData) -> dict[str, Callable[[], Figure]]:
    """The figures that there are of a decision, by name."""
    candidates: dict[str, tuple[bool, Callable[[FigureData], Figure]]] = {
        "control": (True, draw_control),
        "switching": (data.switching is not None and bool(data.switching.any()), draw_switching),
        "states": (True, draw_states),
        "plane": (data.plane is not None, draw_plane),
        "outputs": (data.outputs is not None, draw_outputs),
        "gains": (data.gains is not None, draw_gains),
        "effort": (data.effort is not None, draw_effort),
        "answers": (data.answers is not None, draw_answers),
        "convergence": (bool(data.history), draw_convergence),
    }
    return {name: partial(draw, data) for name, (has_data, draw) in candidates.items() if has_data}


def draw_control(data: FigureData) -> Figure:
    """Every channel as steps between its bounds; ticks below the axis mark the times of the active constraints."""
    figure, axes = panels(len(data.control), 1.9, extra=0.5)
    for channel, ax in enumerate(axes):
        steps = data.control[channel]
        edges = held(steps, data.breakpoints)
        ax.axhline(0.0, color=look.GREY, linewidth=0.6, zorder=1)
        if data.control_least is None or data.control_most is None:
            ax.stairs(*edges, baseline=0.0, fill=True, color=look.SKY, alpha=0.35, linewidth=0, zorder=2)
        else:
            ax.stairs(
                data.control_most[channel],
                data.breakpoints,
                baseline=data.control_least[channel],
                fill=True,
                color=look.SKY,
                alpha=0.45,
                linewidth=0,
                zorder=2,
                label="under any disturbance",
            )
        ax.stairs(*edges, baseline=None, color=look.BLUE, linewidth=1.5, zorder=3, label="control")
        _draw_control_bounds(ax, float(data.control_lower[channel]), float(data.control_upper[channel]), steps)
        _draw_rug(ax, data.active.times)
        ax.set_ylabel(data.control_label(channel))
    draw_time_axis(axes[-1], data)
    _set_title(axes[0], data.title, _write_summary(data))
    draw_legend(figure, axes)
    return figure


def draw_switching(data: FigureData) -> Figure:
    """Draw the switching function of every channel, in units of the cost of acting there: the control acts where it
    leaves the band, and nowhere else."""
    assert data.switching is not None
    figure, axes = panels(len(data.switching), 1.9, extra=0.5)
    ends, edge = data.breakpoints, np.ones(data.breakpoints.size - 1)
    for channel, ax in enumerate(axes):
        values = data.switching[channel]
        reach = max(MIN_SWITCHING_HEIGHT, HEADROOM * float(np.abs(values).max()))
        bound = max(abs(float(data.control_lower[channel])), abs(float(data.control_upper[channel])))
        size = np.abs(data.control[channel])
        acts = size > IDLE_SHARE_OF_BOUND * (bound if np.isfinite(bound) else float(size.max()))
        ax.stairs(np.where(acts, 2 * reach, 0.0) - reach, ends, baseline=-reach, fill=True, color=look.SKY, alpha=0.35,
                  linewidth=0, zorder=0, label="acts")  # fmt: skip
        ax.axhspan(-1.0, 1.0, color=look.MIST, alpha=0.6, linewidth=0, zorder=0.5, label="not worth its price")
        for side in (1.0, -1.0):
            ax.stairs(side * edge, ends, baseline=None, color=look.GREY, linewidth=0.8, zorder=1)
        ax.stairs(values, ends, baseline=None, color=look.PURPLE, linewidth=1.5, zorder=3, label="switching function")
        _draw_rug(ax, data.active.times)
        ax.set_ylim(-reach, reach)
        ax.set_ylabel(f"switching of {plain(data.names.control(channel))}")
    draw_time_axis(axes[-1], data)
    _set_title(axes[0], data.title, "1 is what it costs to act: the control acts outside the band")
    draw_legend(figure, axes)
    return figure


def draw_states(data: FigureData) -> Figure:
    """Every state with its worst-case tube; what the constraints forbid is hatched, the terminal set is a bracket."""
    figure, axes = panels(len(data.drawn_states), 1.9, extra=0.2)
    uncertain = bool((data.tube_upper > data.tube_lower).any())
    for component, ax in zip(data.drawn_states, axes, strict=True):
        if uncertain:
            ax.fill_between(
                data.times,
                data.tube_lower[component],
                data.tube_upper[component],
                color=look.SKY,
                alpha=0.45,
                linewidth=0,
                zorder=2,
                label="worst case" if data.gains is None else "worst case, with feedback",
            )
        for outer in (data.alone_lower, data.alone_upper):
            if outer is not None:
                ax.plot(
                    data.times,
                    outer[component],
                    color=look.GREY,
                    linewidth=0.9,
                    linestyle=(0, (4, 2)),
                    zorder=2,
                    label=f"worst case of {data.alone} alone",
                )
        for edge in (data.tube_lower[component], data.tube_upper[component]):
            ax.plot(data.times, edge, color=look.SKY, linewidth=0.8, zorder=2)
        ax.plot(
            data.times,
            data.state[component],
            color=look.BLUE,
            linewidth=1.5,
            zorder=3,
            label="nominal" if uncertain else "state",
        )
        walls = [wall for wall in data.walls if wall.state == component]
        ax.set_ylim(*_compute_limits(data, component, walls))
        draw_walls(ax, walls)
        _draw_rug(ax, data.active.on(component))
        ax.set_ylabel(data.state_label(component))
    draw_time_axis(axes[-1], data)
    axes[0].set_title(data.title + data.of_states)
    draw_legend(figure, axes)
    return figure


def draw_outputs(data: FigureData) -> Figure:
    """Every output in the worst case, and the readings that noise makes of it at the instants of its measurement."""
    outputs = data.outputs
    assert outputs is not None
    count = min(len(outputs.C), MAX_STATES)
    figure, axes = panels(count, 1.9, extra=0.4)
    for output, ax in enumerate(axes):
        lower, upper = outputs.lower[output], outputs.upper[output]
        ax.fill_between(
            data.times,
            lower,
            upper,
            color=look.SKY,
            alpha=0.45,
            linewidth=0,
            zorder=2,
            label="worst case, with feedback",
        )
        ax.plot(data.times, outputs.nominal[output], color=look.BLUE, linewidth=1.5, zorder=3, label="nominal")
        ends = outputs.read_lower[output], outputs.read_upper[output]
        ax.vlines(outputs.instants, *ends, color=look.VERMILLION, linewidth=0.9, zorder=4, label="readings, with noise")
        for end in ends:
            ax.plot(outputs.instants, end, linestyle="", marker="_", markersize=4, color=look.VERMILLION, zorder=4)
        ax.set_ylabel(data.output_label(output))
    draw_time_axis(axes[-1], data)
    unit = f" {plain(data.names.time)}" if data.names.time else ""
    late = f"known {outputs.latency:g}{unit} later" if outputs.latency else "known at once"
    some = f"  ·  {count} of {len(outputs.C)} outputs" if count < len(outputs.C) else ""
    _set_title(axes[0], data.title, f"measured at {outputs.instants.size} instants, {late}{some}")
    draw_legend(figure, axes)
    return figure


def draw_gains(data: FigureData) -> Figure:
    """Every gain as a picture: rows are the pieces of the control, columns the times at which an innovation is seen; of
    many gains the control channels with the most of them."""
    assert data.gains is not None
    K, _, m, d = data.gains.shape
    sizes = np.abs(data.gains).max(axis=(0, 1))
    shown = sorted(np.argsort(-sizes.ravel(), kind="stable")[:MAX_GAINS].tolist())
    across = 1 if len(shown) < 3 else d if d <= 4 and len(shown) == m * d else 4
    figure, axes = _make_grid(len(shown), across)
    is_causal = np.tril(np.ones((K, K))) > 0
    for index, (number, ax) in enumerate(zip(shown, axes, strict=True)):
        channel, state = divmod(number, d)
        table = np.where(is_causal, data.gains[:, :, channel, state], np.nan)
        largest = float(sizes[channel, state]) or 1.0
        mesh = ax.pcolormesh(
            data.breakpoints, data.breakpoints, table, cmap="PuOr", vmin=-largest, vmax=largest, rasterized=True
        )
        if index % across == 0 or len(shown) < m * d:
            ax.set_ylabel(f"{data.control_label(channel)} answers at")
        figure.colorbar(mesh, ax=ax, pad=0.01).set_label(data.gain_label(channel, state))
        ax.set_xlabel(f"innovation seen at {data.time_label()}" if index >= len(shown) - across else "")
    note = f"  ·  the largest {len(shown)} of {m * d}" if len(shown) < m * d else ""
    axes[0].set_title(f"{data.title}: gains{note}")
    return figure


def draw_answers(data: FigureData) -> Figure:
    """Draw the term of every innovation in the control on each piece, in the worst case that the title names."""
    assert data.answers is not None
    K, _, m = data.answers.shape
    figure, axes = panels(m, 2.6, extra=0.3)
    is_causal = np.tril(np.ones((K, K))) > 0
    for channel, ax in enumerate(axes):
        table = np.where(is_causal, data.answers[:, :, channel], np.nan)
        largest = float(np.nanmax(np.abs(table))) or 1.0
        mesh = ax.pcolormesh(
            data.breakpoints, data.breakpoints, table, cmap="PuOr", vmin=-largest, vmax=largest, rasterized=True
        )
        ax.set_ylabel(f"{data.control_label(channel)} answers at")
        figure.colorbar(mesh, ax=ax, pad=0.01).set_label(f"adds to {data.control_label(channel)}")
    _set_title(axes[0], data.title, f"what every innovation adds to the control, in {data.worst_case}")
    axes[-1].set_xlabel(f"innovation seen at {data.time_label()}")
    return figure


def draw_effort(data: FigureData) -> Figure:
    """Draw the size of the control: quantiles over random disturbances, the nominal control, and the largest size that
    any disturbance causes.

    The background is white where the control is off under every disturbance.
    """
    assert data.effort is not None and data.control_least is not None and data.control_most is not None
    figure, axes = panels(len(data.control), 1.9, extra=0.5)
    ends, lengths = data.breakpoints, np.diff(data.breakpoints)
    largest = np.maximum(np.abs(data.control_least), np.abs(data.control_most))
    bound = np.maximum(np.abs(data.control_lower), np.abs(data.control_upper))
    acts = largest > IDLE_SHARE_OF_BOUND * np.where(np.isfinite(bound), bound, largest.max(axis=1))[:, None]
    for channel, ax in enumerate(axes):
        low, middle, high = data.effort[:, channel]
        top = max(float(largest[channel].max()), 1e-9) * 1.12
        ax.stairs(
            np.where(acts[channel], top, 0.0), ends, fill=True, color=look.MIST, linewidth=0, zorder=0, label="may act"
        )
        ax.stairs(high, ends, baseline=low, fill=True, color=look.SKY, alpha=0.6, linewidth=0, zorder=2,
                  label="90 % of the draws")  # fmt: skip
        ax.stairs(middle, ends, baseline=None, color=look.SKY, linewidth=1.2, zorder=3, label="median")
        ax.stairs(largest[channel], ends, baseline=None, color=look.VERMILLION, linewidth=1.2, zorder=4,
                  label="most, under any disturbance")  # fmt: skip
        ax.stairs(np.abs(data.control[channel]), ends, baseline=None, color=look.BLUE, linewidth=1.5, zorder=3,
                  label="nominal")  # fmt: skip
        ax.set_ylim(0.0, top)
        ax.set_ylabel(f"size of {data.control_label(channel)}")
    draw_time_axis(axes[-1], data)
    off_share = float((~acts.any(axis=0) * lengths).sum() / lengths.sum())
    _set_title(
        axes[0],
        data.title,
        f"off whatever happens for {100 * off_share:.1f} % of the time  ·  {data.draws} random draws",
    )
    draw_legend(figure, axes)
    return figure


def _make_grid(count: int, across: int) -> tuple[Figure, list[Axes]]:
    """A figure of ``count`` pictures, so many beside one another."""
    from matplotlib.figure import Figure

    down = -(-count // across)
    width = look.FIGURE_WIDTH if across == 1 else 3.4 * across
    figure = Figure(figsize=(width, 2.6 * down + 1.0), layout="constrained")
    axes = figure.subplots(down, across, squeeze=False).ravel()
    for ax in axes[count:]:
        ax.set_visible(False)
    return figure, list(axes[:count])


def draw_slacks(program: SemiInfiniteProgram, result: Result, title: str) -> Figure | None:
    """Draw the slack of the rows of every family whose index is one number, and the indices with a multiplier.

    ``None`` where no family is of that kind.
    """
    from matplotlib.figure import Figure

    families = [family for family in program.families if int((np.ptp(_corners(family), axis=0) > 0.0).sum()) == 1]
    families = families[:MAX_FAMILIES]
    if not families or result.decision is None:
        return None
    figure = Figure(figsize=(look.FIGURE_WIDTH, 1.7 * len(families) + 0.75), layout="constrained")
    for ax, family in zip(figure.subplots(len(families), 1, squeeze=False)[:, 0], families, strict=True):
        corners = _corners(family)
        axis = int(np.ptp(corners, axis=0).argmax())
        indices = np.linspace(corners[0], corners[1], SLACK_POINTS)
        slack = -family.violations(result.decision, indices)
        for place, row in enumerate(slack.T):
            color = (look.BLUE, look.VERMILLION, look.GREEN, look.PURPLE)[place % 4]
            ax.plot(indices[:, axis], row, color=color, linewidth=1.0, label=f"row {place + 1}")
        places = [cut.index[axis] for cut in result.indices if cut.family == family.name and cut.multiplier > 0.0]
        mark = {"color": look.INK, "markersize": 3.5, "label": "index with a multiplier", "zorder": 3}
        ax.plot(places, [0.0] * len(places), "o", **mark)
        ax.axhline(0.0, color=look.GREY, linewidth=0.7)
        name = family.coordinates[axis] if family.coordinates else f"index {axis + 1}"
        ax.set_xlabel(f"${name}$" if len(name) == 1 else name)
        ax.set_ylabel("slack")
        ax.set_title(family.name, fontsize=10.0)
    pairs = [pair for ax in figure.axes for pair in zip(*ax.get_legend_handles_labels()[::-1], strict=True)]
    distinct = dict(pairs)
    figure.legend(distinct.values(), distinct.keys(), loc="outside lower center", ncols=4)
    figure.suptitle(title, x=0.01, ha="left", fontsize=11.5)
    return figure


def _corners(family: ConstraintFamily) -> Array:
    return np.stack([family.index_set.lower, family.index_set.upper])


def draw_convergence(data: FigureData) -> Figure:
    """Draw both bounds against the rounds, and below them the violation and the gap of each lower bound.

    The gap is to the best upper bound. The lower panel has a logarithmic axis.
    """
    from matplotlib.ticker import MaxNLocator

    figure, (bounds, gaps) = panels(2, 1.9, extra=0.2)
    rounds = np.arange(1.0, len(data.history) + 1)
    lower = np.array([entry.lower_bound for entry in data.history])
    upper = np.array([entry.upper_bound for entry in data.history])
    best = float(upper.min())
    _draw_bounds(bounds, rounds, lower, upper, best)
    bounds.set_ylabel(measured("time of action" if data.counts else "cost $J$", data.cost_unit))
    _draw_gaps(gaps, rounds, np.array([relative_gap(bound, best, data.cost_scale) for bound in lower]), data)
    bounds.set_title(data.title)
    gaps.set_xlim(0.6, len(data.history) + 0.4)
    gaps.xaxis.set_major_locator(MaxNLocator(integer=True))
    _draw_stages(bounds, gaps, [entry.epsilon for entry in data.history])
    for ax in (bounds, gaps):
        ax.legend(loc="center left", bbox_to_anchor=(1.01, 0.5))
    return figure


def _draw_bounds(ax: Axes, rounds: Array, lower: Array, upper: Array, best: float) -> None:
    shown = np.isfinite(lower)
    if np.isfinite(best):
        ax.fill_between(rounds[shown], lower[shown], best, color=look.MIST, linewidth=0, zorder=1)
        ax.axhline(best, color=look.VERMILLION, linewidth=0.9, zorder=2)
    _draw_series(ax, rounds, upper, look.VERMILLION, "v", "upper bound")
    _draw_series(ax, rounds, lower, look.BLUE, "^", "lower bound")


def _draw_gaps(ax: Axes, rounds: Array, gap: Array, data: FigureData) -> None:
    violation = np.array([entry.violation for entry in data.history])
    ax.set_yscale("log")
    ax.set_ylim(*_find_decades(np.concatenate([violation, gap, [data.tolerance or np.nan]])))
    _draw_series(ax, rounds, _mask_nonpositive(violation), look.ORANGE, "s", "worst violation")
    _draw_series(ax, rounds, _mask_nonpositive(gap), look.GREEN, "o", "relative gap")
    if data.tolerance is not None:
        ax.axhline(data.tolerance, color=look.PURPLE, linewidth=0.9, linestyle=(0, (5, 3)), label="tolerance")
    ax.set_xlabel("round")


def _set_title(ax: Axes, title: str, summary: str) -> None:
    ax.set_title(title, pad=20 if summary else 8)
    ax.text(0.0, 1.045, summary, transform=ax.transAxes, fontsize=9.5, color=look.GREY)


def _write_summary(data: FigureData) -> str:
    terms = f" ({data.cost_of})" if data.cost_of else ""
    unit = f" {plain(data.cost_unit)}" if data.cost_unit else ""
    costs = [] if data.cost is None else [f"{data.cost:.6g}{unit}"]
    phrases = [f"acts for {text}" if data.counts else f"$J$ = {text}{terms}" for text in costs]
    if data.active_fraction is not None:
        phrases.append(f"active {100 * data.active_fraction:.1f} % of the time")
    return "  ·  ".join(phrases)


def _draw_control_bounds(ax: Axes, lower: float, upper: float, steps: Array) -> None:
    finite = [bound for bound in (lower, upper) if np.isfinite(bound)]
    for bound in finite:
        ax.axhline(bound, color=look.VERMILLION, linewidth=0.9, linestyle=(0, (5, 3)), zorder=1, label="control bound")
    low, high = min([*finite, float(steps.min()), 0.0]), max([*finite, float(steps.max()), 0.0])
    margin = 0.12 * max(high - low, 1e-9)
    ax.set_ylim(low - margin, high + margin)


def _draw_rug(ax: Axes, times: Array) -> None:
    if len(times):
        ax.plot(
            times,
            np.zeros(len(times)),
            "^",
            color=look.PURPLE,
            markersize=6,
            markeredgewidth=0,
            clip_on=False,
            zorder=5,
            transform=ax.get_xaxis_transform(),
            label="active constraint",
        )


def draw_time_axis(ax: Axes, data: FigureData) -> None:
    """Limits and label of the time axis that the panels share."""
    start, end = float(data.breakpoints[0]), float(data.breakpoints[-1])
    ax.set_xlim(start, end + 0.012 * (end - start))
    ax.set_xlabel(data.time_label())


def _compute_limits(data: FigureData, component: int, walls: list[Wall]) -> tuple[float, float]:
    edges = [edge for wall in walls for edge in wall.edges]
    low = min([*edges, float(data.tube_lower[component].min())])
    high = max([*edges, float(data.tube_upper[component].max())])
    margin = 0.12 * max(high - low, 1e-9)
    return low - margin, high + margin


def draw_walls(ax: Axes, walls: Sequence[Wall]) -> None:
    """Hatch what path constraints forbid within the axis' limits, and bracket terminal sets."""
    for wall in walls:
        _draw_terminal(ax, wall) if wall.start == wall.end else _draw_forbidden(ax, wall)


def _draw_forbidden(ax: Axes, wall: Wall) -> None:
    low, high = ax.get_ylim()
    for side, outside in zip(wall.sides, (low, high), strict=True):
        if np.isfinite(side).all():
            ax.fill_between([wall.start, wall.end], side, outside, **look.EXCLUDED, label="forbidden")
            ax.plot([wall.start, wall.end], side, color=look.GREY, linewidth=1.0, zorder=1)


def _draw_terminal(ax: Axes, wall: Wall) -> None:
    low, high = ax.get_ylim()
    lower, upper = max(wall.lower, low), min(wall.upper, high)
    ax.plot(
        [wall.end, wall.end],
        [lower, upper],
        color=look.VERMILLION,
        linewidth=3.0,
        solid_capstyle="butt",
        clip_on=False,
        zorder=4,
        label="terminal set" if wall.final else "bound at one time",
    )
    for edge in (wall.lower, wall.upper):
        if np.isfinite(edge):
            ax.plot(
                wall.end,
                edge,
                marker=0,
                markersize=7,
                markeredgewidth=2.0,
                color=look.VERMILLION,
                clip_on=False,
                zorder=4,
            )


def _draw_series(ax: Axes, rounds: Array, values: Array, colour: str, marker: str, label: str) -> None:
    shown = np.isfinite(values)
    ax.plot(
        rounds[shown], values[shown], color=colour, marker=marker, markersize=4.5, linewidth=1.2, label=label, zorder=3
    )


def _mask_nonpositive(values: Array) -> Array:
    return np.where(values > 0, values, np.nan)


def _find_decades(values: Array) -> tuple[float, float]:
    """Whole decades around the positive values, so that a single value still has an axis."""
    shown = values[np.isfinite(values) & (values > 0)]
    if not shown.size:
        return 1e-8, 1.0
    return 10.0 ** np.floor(np.log10(shown.min()) - 0.3), 10.0 ** np.ceil(np.log10(shown.max()) + 0.3)


def _draw_stages(bounds: Axes, gaps: Axes, epsilons: list[float]) -> None:
    changes = [k + 0.5 for k in range(1, len(epsilons)) if epsilons[k] != epsilons[k - 1]]
    for ax in (bounds, gaps):
        for k, change in enumerate(changes):
            label = r"$\varepsilon$ reduced" if k == 0 and ax is gaps else None
            ax.axvline(change, color=look.GREY, linewidth=0.6, linestyle=":", zorder=0, label=label)
