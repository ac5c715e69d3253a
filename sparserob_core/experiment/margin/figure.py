"""The figure of a margin: the cost as a function of the factor, and the infeasible factors."""

from __future__ import annotations

import re
from typing import TYPE_CHECKING

import numpy as np

from sparserob_core.experiment.figures import style as look
from sparserob_core.experiment.figures.figure_data import measured, plain
from sparserob_core.experiment.margin.search import FEASIBLE, Margin
from sparserob_core.sip.convex_set import Array

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from sparserob_core.experiment.margin.scaling import Scaling


def draw_margin(found: Margin, varied: Scaling) -> Figure:
    """Return the figure of a margin.

    It has both bounds of the cost at every point. A chord joins the points where the cost is convex in the factor, a
    band where it is only monotone. The side that is proven infeasible is hatched, and the upper axis is in the unit of
    the problem.
    """
    figure, (ax,) = look.panels(1, 2.9)
    proven = [point for point in found.curve if point.status in FEASIBLE]
    factors = np.array([point.factor for point in proven])
    upper, lower = (np.array([getattr(point, name) for point in proven]) for name in ("upper_bound", "lower_bound"))
    convex = varied.affine  # the value of a convex program is convex in its right-hand sides
    ax.fill_between(
        *_compute_band(factors, lower, upper, found.sense == "largest"),
        color=look.SKY,
        alpha=0.0 if convex else 0.35,
        linewidth=0,
        zorder=1,
        label=None if convex else "cost between points, by monotony",
    )
    ax.plot(
        factors,
        upper,
        color=look.BLUE,
        linewidth=1.4 if convex else 0.0,
        marker="v",
        markersize=4.5,
        zorder=3,
        label="certified upper bound",
    )
    ax.plot(
        factors,
        lower,
        color=look.ORANGE,
        linewidth=0,
        marker="^",
        markersize=4.5,
        zorder=4,
        label="certified lower bound",
    )
    unproven_factors = [point.factor for point in found.curve if point.status not in FEASIBLE]
    ax.set_ylim(*_compute_limits(np.concatenate([upper, lower])))
    if unproven_factors:
        ax.plot(
            unproven_factors,
            np.full(len(unproven_factors), ax.get_ylim()[0]),
            "x",
            color=look.VERMILLION,
            clip_on=False,
            zorder=5,
            label="nothing proven feasible",
        )
    _draw_infeasible(ax, found, np.array([point.factor for point in found.curve]))
    ax.set_ylabel(least_cost(found))
    ax.set_xlabel(varied.label)
    if varied.relative:
        _draw_unit_axis(ax, found)
    ax.set_title(plain(found.title), pad=8)
    figure.legend(
        *ax.get_legend_handles_labels(), loc="outside lower center", ncols=2, columnspacing=1.6, handlelength=1.6
    )
    return figure


def draw_horizons(found: Margin) -> Figure:
    """Return the figure of a margin of the horizon.

    It has both bounds of the cost at every scanned horizon, which are not joined, since nothing is claimed between
    them. Crosses mark horizons that are infeasible or not decided, and a hatched band those that are all excluded.
    """
    figure, (ax,) = look.panels(1, 2.9)
    proven = [point for point in found.curve if point.status in FEASIBLE]
    horizons = np.array([point.factor for point in proven])
    upper, lower = (np.array([getattr(point, name) for point in proven]) for name in ("upper_bound", "lower_bound"))
    ax.plot(horizons, upper, "v", color=look.BLUE, markersize=4.5, zorder=3, label="certified upper bound")
    ax.plot(horizons, lower, "^", color=look.ORANGE, markersize=4.5, zorder=4, label="certified lower bound")
    longest = max((point.factor for point in found.curve), default=1.0)
    highest = float(upper.max(initial=0.0)) or 1.0
    ax.set_xlim(0.0, 1.03 * longest)
    ax.set_ylim(0.0, 1.15 * highest)
    for status, colour, label in (
        ("infeasible", look.VERMILLION, "proven infeasible"),
        ("other", look.GREY, "not decided"),
    ):
        crosses = [
            point.factor
            for point in found.curve
            if point.status not in FEASIBLE and (point.status == "infeasible") == (status == "infeasible")
        ]
        if crosses:
            ax.plot(crosses, np.zeros(len(crosses)), "x", color=colour, clip_on=False, zorder=5, label=label)
    if found.lower > 0.0:
        ax.axvspan(
            0.0,
            found.lower,
            facecolor=look.MIST,
            edgecolor=look.GREY,
            hatch="///",
            linewidth=0,
            alpha=0.6,
            zorder=0,
            label=f"excluded up to {found.lower:.6g}",
        )
    ax.set_ylabel(least_cost(found))
    ax.set_xlabel(plain(found.quantity).replace("horizon", "horizon $T$", 1))
    ax.set_title(plain(found.title), pad=8)
    figure.legend(
        *ax.get_legend_handles_labels(), loc="outside lower center", ncols=2, columnspacing=1.6, handlelength=1.6
    )
    return figure


def least_cost(found: Margin) -> str:
    """Return the label of an axis of costs, with their unit where it is known."""
    return measured("least cost $J$", found.cost_unit)


def _compute_band(factors: Array, lower: Array, upper: Array, rising: bool) -> tuple[Array, Array, Array]:
    """Return the band in which the cost lies: between two points it is monotone.

    It is therefore between the lower bound at one point and the upper bound at the other.
    """
    x = np.repeat(factors, 2)[1:-1]
    below, above = (lower[:-1], upper[1:]) if rising else (lower[1:], upper[:-1])
    return x, np.repeat(below, 2), np.repeat(above, 2)


def _draw_infeasible(ax: Axes, found: Margin, factors: Array) -> None:
    """Draw the side that is proven infeasible, as a hatched band beyond its edge."""
    low, high = float(factors.min()), float(factors.max())
    room = 0.12 * max(high - low, 1e-9)
    left, right = low - 0.03 * (high - low), high + 0.03 * (high - low)
    if found.infeasible is not None:
        edge, critical = found.infeasible.factor, (found.lower + found.upper) / 2
        left, right = (left, edge + room) if found.sense == "largest" else (max(edge - room, 0.0), right)
        band = (edge, right) if found.sense == "largest" else (left, edge)
        ax.axvspan(*band, **look.EXCLUDED, label="proven infeasible")
        ax.axvline(critical, color=look.VERMILLION, linewidth=1.1, zorder=1, label=f"critical factor {critical:.7g}")
    ax.set_xlim(left, right)


def _draw_unit_axis(ax: Axes, found: Margin) -> None:
    """Draw a second axis in the unit of the problem, where its quantity is a multiple of the factor."""
    share = found.amounts[0] / found.lower if np.isfinite(found.lower) and found.lower > 0 else np.nan
    is_linear = (
        found.curve
        and np.isfinite(share)
        and all(abs(point.amount - share * point.factor) <= 1e-9 * (1 + abs(point.amount)) for point in found.curve)
    )
    if not is_linear:
        return
    unit_axis = ax.secondary_xaxis(
        "top", functions=(lambda x: share * np.asarray(x, dtype=float), lambda y: np.asarray(y, dtype=float) / share)
    )
    unit_axis.set_xlabel(_format_mathematics(plain(found.quantity)))
    unit_axis.spines["top"].set_visible(True)


def _format_mathematics(quantity: str) -> str:
    return re.sub(r"\|?[wux]_i(\(0\))?\|?", lambda written: f"${written.group()}$", quantity)


def _compute_limits(values: Array) -> tuple[float, float]:
    finite = values[np.isfinite(values)]
    low, high = (float(finite.min()), float(finite.max())) if finite.size else (0.0, 1.0)
    extent = max(high - low, 0.05 * abs(high), 1e-9)
    return low - 0.08 * extent, high + 0.1 * extent
