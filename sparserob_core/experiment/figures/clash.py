"""The picture of an infeasible run: for every constraint of the irreducible infeasible subsystems, where the control
can bring its quantity, and what is allowed."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING, Any, final

import numpy as np

from sparserob_core.control.constraints.explanation import in_numbers
from sparserob_core.errors import InputError
from sparserob_core.experiment.figures import style as look
from sparserob_core.experiment.figures.figure_data import plain
from sparserob_core.sip.evidence import Cut
from sparserob_core.sip.program import ConstraintFamily, SemiInfiniteProgram
from sparserob_core.sip.proof.reasons import least_of, reasons
from sparserob_core.sip.relaxed.relaxed import rows_at
from sparserob_core.sip.result import Result

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from sparserob_core.experiment.assemble import Experiment

MAX_QUANTITIES = 8  # quantities at most
BAR = 0.16  # half the height of a bar
SIDE_SHARE = (
    0.3  # of what a picture shows, on either side: of a tenth a wall stands at its edge, of ten times is a line again
)


@final
@dataclass(frozen=True)
class Strip:
    """Quantity ``label`` of a picture, with its allowed interval, its reach and the effect of the disturbance.

    The quantity is allowed in ``[low, high]``. The control brings it to ``[reach_low, reach_high]`` where nothing
    disturbs it. The worst disturbance moves it from there by ``sigma_low`` downwards and ``sigma_high`` upwards. All of
    these are in ``unit``, which is empty where no unit is known.
    """

    label: str
    low: float
    high: float
    reach_low: float
    reach_high: float
    sigma_low: float
    sigma_high: float
    unit: str = ""

    @property
    def view(self) -> tuple[float, float]:
        """Interval that a picture shows: the allowed interval, and the effect of the worst disturbance on the best
        value, with room around them.

        The reach of the control may be a thousand times larger, and a bound would then look like a line.
        """
        ends = [self.low, self.high, self.best - self.sigma_low, self.best + self.sigma_high]
        shown = [value for value in ends if np.isfinite(value)]
        room = SIDE_SHARE * max(max(shown) - min(shown), 1e-9)
        return min(shown) - room, max(shown) + room

    @property
    def short(self) -> float:
        """Distance of the worst case of the best value to the allowed interval; 0 where the constraint can be met."""
        return max(self.low - (self.best - self.sigma_low), self.best + self.sigma_high - self.high, 0.0)

    @property
    def best(self) -> float:
        """Best value of the quantity without disturbance: the middle of the interval that is left once the disturbance
        has its share, as far as the control can reach it."""
        low, high = self.low + self.sigma_low, self.high - self.sigma_high
        target = (low + high) / 2 if np.isfinite(low + high) else low if np.isfinite(low) else high
        target = float(np.clip(self.reach_low, low, high)) if low <= high and np.isinf(high - low) else target
        return float(np.clip(target, self.reach_low, self.reach_high))


def clash_figure(experiment: Experiment, result: Result) -> Figure:
    """The figure of why nothing is feasible.

    One strip for every quantity of the reasons, or else of the rows whose multipliers prove the infeasibility. Raises
    `InputError` when the result is not infeasible, when it is about no quantity that can be drawn (equalities alone,
    another kind of program), and without matplotlib.
    """
    if result.status != "infeasible":
        raise InputError(f"figures: a clash is drawn of infeasible results, got one that is {result.status}")
    strips = clash_strips(experiment.program, result)
    if not strips:
        raise InputError(
            "figures: the constraints that clash are none on a single combination of states; there is nothing to draw"
        )
    look.require_matplotlib()
    from matplotlib.figure import Figure

    with look.style():
        figure = Figure(figsize=(look.FIGURE_WIDTH, 0.95 * len(strips) + 1.15), layout="constrained")
        axes = list(figure.subplots(len(strips), 1, squeeze=False)[:, 0])
        for ax, strip in zip(axes, strips, strict=True):
            _draw_strip(ax, strip)
        alone = any(strip.short > 0.0 for strip in strips)
        suffix = "" if alone else "\neach of them can be met, but not all by one control"
        figure.suptitle(plain(experiment.title) + suffix, x=0.01, ha="left", fontsize=11.5)
        handles = [axes_handles for ax in axes for axes_handles in zip(*ax.get_legend_handles_labels(), strict=True)]
        entries = {label: handle for handle, label in handles}
        figure.legend(
            entries.values(), entries.keys(), loc="outside lower center", ncols=2, columnspacing=1.6, handlelength=1.6
        )
        return figure


def clash_strips(program: SemiInfiniteProgram, result: Result) -> list[Strip]:
    """The strips of a figure: of every separate reason, else of the rows of the certificate."""
    separate_reasons = reasons(program)
    cuts = (
        [cut for reason in separate_reasons for cut in reason.rows.cuts]
        if separate_reasons
        else [cut for cut in result.indices if cut.multiplier > 0]
    )
    strips: dict[str, Strip] = {}
    for cut in cuts:
        family = program.formulated(cut.family, cut.formulation)
        strip = None if family is None else _make_strip(program, family, cut)
        if strip is not None:
            strips.setdefault(strip.label, strip)
    return list(strips.values())[:MAX_QUANTITIES]


def _make_strip(program: SemiInfiniteProgram, family: ConstraintFamily, cut: Cut) -> Strip | None:
    explain_row = partial(in_numbers, program, cut.family, cut.formulation, cut.index)
    description = explain_row(cut.row)
    if description is None or not description.quantity:
        return None
    G, h = family.rows(cut.index[None])
    row = rows_at(_isolate_family(program, family), family.name, cut.index[None], np.array([cut.row])).G[0]
    towards, away = (float(least_of(program.finite, sign * row[None], np.zeros(1))[0]) for sign in (1.0, -1.0))
    reach = sorted([description.free + description.sign * towards, description.free - description.sign * away])
    limits, sigmas = {description.sign: description.limit}, {description.sign: description.sigma}
    opposite = [
        j
        for j in range(h.shape[1])
        if j != cut.row and np.abs(G[0, j] + row).max() <= 1e-12 * np.abs(row).max(initial=1e-300)
    ]
    for opposite_description in map(explain_row, opposite):
        if opposite_description is not None and opposite_description.quantity == description.quantity:
            limits[opposite_description.sign], sigmas[opposite_description.sign] = (
                opposite_description.limit,
                opposite_description.sigma,
            )
    label = f"{description.quantity}\n{family.name}" + (
        f", {description.where}" if description.where and description.time else ""
    )
    return Strip(
        label,
        limits.get(-1.0, -np.inf),
        limits.get(1.0, np.inf),
        reach[0],
        reach[1],
        sigmas.get(-1.0, 0.0),
        sigmas.get(1.0, 0.0),
        description.unit,
    )


def _isolate_family(program: SemiInfiniteProgram, family: ConstraintFamily) -> SemiInfiniteProgram:
    return SemiInfiniteProgram(n=program.n, families=[family])


def _draw_strip(ax: Axes, strip: Strip) -> None:
    view_left, view_right = strip.view
    ax.set_xlim(view_left, view_right)
    _draw_forbidden(ax, strip, 0.0, view_left, view_right)
    worst = "what the worst disturbance makes of its best"
    _draw_bar(ax, strip.best - strip.sigma_low, strip.best + strip.sigma_high, -0.17, look.ORANGE, worst)
    _draw_bar(ax, strip.reach_low, strip.reach_high, 0.17, look.BLUE, "where the control can bring it")
    ax.plot([strip.best], [-0.17], "|", color=look.INK, markersize=9, zorder=4, linewidth=0, label="its best")
    unit = f" {plain(strip.unit)}" if strip.unit else ""
    notes = [f"misses by {strip.short:.3g}{unit}"] if strip.short > 0.0 else []
    if strip.reach_low < view_left or strip.reach_high > view_right:
        notes.append(f"the control reaches {strip.reach_low:.3g} to {strip.reach_high:.3g}{unit}")
    ax.set_title("  ·  ".join(notes), loc="right", fontsize=9, color=look.INK, pad=2)
    ax.set_yticks([0.0], [plain(strip.label)])
    ax.set_ylim(-0.45, 0.45)
    ax.tick_params(axis="y", length=0)
    ax.set_xlabel(plain(strip.unit), labelpad=1)


def _draw_forbidden(ax: Axes, strip: Strip, y: float, left: float, right: float) -> None:
    for edge, end in ((strip.low, left), (strip.high, right)):
        if np.isfinite(edge):
            ax.fill_betweenx([y - 0.42, y + 0.42], edge, end, **look.EXCLUDED, label="forbidden")
            ax.plot([edge, edge], [y - 0.42, y + 0.42], color=look.VERMILLION, linewidth=1.6, zorder=1, label="wall")


def _draw_bar(ax: Axes, low: float, high: float, y: float, colour: str, label: str) -> None:
    """A bar, or a dot where there is nothing to it."""
    look_of: dict[str, Any] = {"color": colour, "zorder": 3}
    if high - low > 0:
        ax.barh([y], [high - low], left=[low], height=BAR, linewidth=0, label=label, **look_of)
    elif colour == look.BLUE:
        ax.plot([low], [y], "o", markersize=5.5, markeredgewidth=0, **look_of)
