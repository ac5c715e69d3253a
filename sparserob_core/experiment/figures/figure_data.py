"""Data of the figures of a run, as one plain record."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np

from sparserob_core.control.problem.names import UNNAMED, Names
from sparserob_core.errors import InputError
from sparserob_core.experiment.figures.active import Active
from sparserob_core.experiment.figures.plane import Plane
from sparserob_core.experiment.terminal.printing import printable
from sparserob_core.sip.convex_set import Array
from sparserob_core.sip.events import RoundFinished

MAX_STATES = 12  # drawn in one figure
NEGLIGIBLE_CONTROL = 1e-7  # of the largest control: less than that is no action but rounding


@dataclass(frozen=True, kw_only=True)
class Wall:
    """Bounds on one component of the state: it must stay in ``[lower, upper]`` for ``start <= t <= end``.

    ``start == end`` is a terminal constraint, or a constraint at an earlier time where it is not ``final``. Where the
    set moves, the bounds go in straight lines to ``lower_end`` and ``upper_end``.
    """

    state: int
    lower: float = -np.inf
    upper: float = np.inf
    start: float
    end: float
    lower_end: float | None = None
    upper_end: float | None = None
    final: bool = True

    @property
    def sides(self) -> tuple[tuple[float, float], tuple[float, float]]:
        """The lower and the upper bound, each at the start and at the end."""
        return (
            (self.lower, self.lower if self.lower_end is None else self.lower_end),
            (self.upper, self.upper if self.upper_end is None else self.upper_end),
        )

    @property
    def edges(self) -> list[float]:
        """Every bound that there is, at the start and at the end."""
        return [edge for side in self.sides for edge in side if np.isfinite(edge)]

    @property
    def moves(self) -> bool:
        """True where a bound at the end differs from the bound at the start."""
        return any(first != last for first, last in self.sides)


@dataclass(frozen=True, eq=False, kw_only=True)
class MeasuredOutputs:
    """Measured outputs ``y = C x`` with ``C (p, d)``: ``nominal (p, T)`` and the worst cases ``lower``,
    ``upper (p, T)``.

    These are at the times of the figure. ``instants (k,)`` are the breakpoints whose readings some piece of the control
    knows. The readings lie between ``read_lower`` and ``read_upper (p, k)``, noise included, and are known ``latency``
    later.
    """

    C: Array
    nominal: Array
    lower: Array
    upper: Array
    instants: Array
    read_lower: Array
    read_upper: Array
    latency: float


@dataclass(frozen=True, eq=False, kw_only=True)
class FigureData:
    """A solved control problem, ready to be drawn.

    ``breakpoints (K+1,)`` with the control ``(m, K)`` on the pieces and its bounds ``(m,)`` (infinite: none);
    ``times (T,)`` with the nominal ``state (d, T)`` and the worst case ``tube_lower``, ``tube_upper`` ``(d, T)`` over
    every disturbance and parameter, rows of NaN for states that nobody asked for; ``walls`` the path and terminal
    constraints on single components; ``active`` the imposed constraints that carry a multiplier;
    ``history`` the rounds of the method. ``tolerance`` is the relative gap that was asked for, and ``cost_scale`` the
    sum of the terms of the cost. ``cost_of`` names these terms where they are not the L1 norm alone, ``cost_unit``
    their unit where it is known, and ``counts`` says whether cost means the time that the control acts. ``names`` are
    those of states, controls and disturbances, and ``plane`` is the plane in which the system moves, if the problem
    names one. ``switching (m, K)`` is the switching function, the effect of the constraints on the control, where
    known.

    Under feedback the control is the nominal one, and ``control_least``, ``control_most (m, K)`` are how far the
    disturbance moves it. ``gains (K, K, m, p)`` answer the measured ``outputs``, or states where these are ``None``.
    ``alone_lower``, ``alone_upper (d, T)`` is the tube of ``alone``, which is the nominal control or an inner loop.
    ``effort (3, m, K)`` are quantiles of ``|u|`` over ``draws`` admissible disturbances (5 %, 50 %, 95 %), and
    ``answers (K, K, m)`` what the control on every piece adds for the innovation of every breakpoint in the
    ``worst_case`` that is named; each where it was asked for.
    """

    title: str
    breakpoints: Array
    control: Array
    control_lower: Array
    control_upper: Array
    times: Array
    state: Array
    tube_lower: Array
    tube_upper: Array
    walls: Sequence[Wall] = ()
    active: Active = field(default_factory=Active)
    history: Sequence[RoundFinished] = ()
    active_fraction: float | None = None
    cost: float | None = None
    tolerance: float | None = None
    cost_scale: float = 0.0
    cost_of: str = ""
    cost_unit: str = ""
    alone: str = "the nominal control"
    alone_lower: Array | None = None
    alone_upper: Array | None = None
    control_least: Array | None = None
    control_most: Array | None = None
    gains: Array | None = None
    outputs: MeasuredOutputs | None = None
    effort: Array | None = None
    draws: int = 0
    answers: Array | None = None
    worst_case: str = ""
    counts: bool = False
    names: Names = UNNAMED
    plane: Plane | None = None
    switching: Array | None = None

    def __post_init__(self) -> None:
        pieces, instants = self.breakpoints.size - 1, self.times.size
        if self.control.ndim != 2 or self.control.shape[1] != pieces:
            raise InputError(f"control: expected (m, {pieces}) for {pieces} pieces, got {self.control.shape}")
        for name in ("state", "tube_lower", "tube_upper"):
            shape = getattr(self, name).shape
            if shape != (self.state.shape[0], instants):
                raise InputError(f"{name}: expected (d, {instants}) for {instants} times, got {shape}")

    @cached_property
    def drawn_states(self) -> tuple[int, ...]:
        """The states that figures show, in their order: all that are known, or `MAX_STATES` of them, `telling`."""
        reach = self.tube_upper.max(axis=1) - self.tube_lower.min(axis=1)
        return tuple(sorted(state for state in telling(reach, self.walls)[:MAX_STATES] if not np.isnan(reach[state])))

    @property
    def path(self) -> Array:
        """Places of a system that moves in a plane at the ``times``, ``(T, 2)``."""
        assert self.plane is not None
        return np.asarray(self.state[list(self.plane.states)].T)

    @property
    def arcs(self) -> list[Array]:
        """The parts of the path on which the control acts, ``(k, 2)`` each, where there are others."""
        size, path = np.abs(self.control), self.path
        acts = (
            size > NEGLIGIBLE_CONTROL * np.maximum(size.max(axis=1, initial=0.0), np.finfo(float).tiny)[:, None]
        ).any(axis=0)
        if acts.all():
            return []
        changes, arcs = np.diff(np.concatenate([[False], acts, [False]]).astype(int)), []
        starts, ends = (self.breakpoints[np.flatnonzero(changes == sign)] for sign in (1, -1))
        for begin, end in zip(starts, ends, strict=True):
            inside = self.times[(self.times > begin) & (self.times < end)]
            times = np.unique(np.concatenate([[begin, end], inside]))
            arcs.append(np.stack([np.interp(times, self.times, coordinate) for coordinate in path.T], axis=1))
        return arcs

    @property
    def of_states(self) -> str:
        """Addition to a title where not every state is shown; empty otherwise."""
        drawn, total = len(self.drawn_states), len(self.names.corners.own(self.state.shape[0]))
        return "" if drawn == total else f", {drawn} of {total} states"

    def control_label(self, channel: int) -> str:
        """The axis label of one control channel."""
        return label(self.names.controls, self.names.control_units, "u", channel, self.control.shape[0])

    def state_label(self, component: int) -> str:
        """The axis label of one state component."""
        return label(self.names.states, self.names.state_units, "x", component, self.state.shape[0])

    def output_label(self, output: int) -> str:
        """The axis label of an output: that of the state which is measured as it is, or else the letter."""
        assert self.outputs is not None
        alone = self._find_measured_state(output)
        return label((), (), "y", output, len(self.outputs.C)) if alone is None else self.state_label(alone)

    def gain_label(self, channel: int, component: int) -> str:
        """The label of a gain: of which control on which state or output, and its unit where both are known."""
        measured_as = component if self.outputs is None else self._find_measured_state(component)
        if measured_as is None:
            return f"gain on $y_{{{component + 1}}}$"
        u, x = self.names.control_units, self.names.state_units
        has_units = u and x and u[channel] and x[measured_as]
        unit = f" [{plain(u[channel])} per {plain(x[measured_as])}]" if has_units else ""
        return f"gain on {label(self.names.states, (), 'x', measured_as, self.state.shape[0])}{unit}"

    def _find_measured_state(self, output: int) -> int | None:
        """The state that is an output as it is; ``None`` where there is none."""
        assert self.outputs is not None
        row = self.outputs.C[output]
        alone = np.flatnonzero(row)
        return int(alone[0]) if alone.size == 1 and row[alone[0]] == 1.0 else None

    def time_label(self) -> str:
        """The label of the time axis."""
        return measured("time $t$", self.names.time)


def telling(reach: Array, walls: Sequence[Wall]) -> list[int]:
    """All states, first those that ``walls`` are about, then those that move the farthest in their units, by ``reach
    (d,)``; last those of which it is not known."""
    walled_states = {wall.state for wall in walls}
    return sorted(
        range(reach.size), key=lambda state: (np.isnan(reach[state]), state not in walled_states, -reach[state])
    )


def label(names: Sequence[str], units: Sequence[str], letter: str, index: int, count: int, at: str = "t") -> str:
    """The label of an axis: the name that was given, or else the letter with its number, and the unit where one is
    known."""
    symbol = f"${letter}_{{{index + 1}}}({at})$" if count > 1 else f"${letter}({at})$"
    shown = plain(names[index]) + ("" if at == "t" else f"$({at})$") if names else symbol
    return measured(shown, units[index] if units else "")


def measured(text: str, unit: str) -> str:
    """The label of an axis, with the unit in brackets where it is known."""
    return f"{text} [{plain(unit)}]" if unit else text


def plain(text: str) -> str:
    """A text of the user's in a figure: no formula, no control character."""
    return printable(text).replace("$", r"\$")
