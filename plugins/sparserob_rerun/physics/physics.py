"""Pictures of the control, of its switching function, and of every state between its walls, over the time of the
system."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, final

import numpy as np

import sparserob_core as sr
from sparserob_rerun.drawing import palette as ink
from sparserob_rerun.drawing.canvas import Axes, Drawing
from sparserob_rerun.drawing.palette import Floats
from sparserob_rerun.physics.pages import pages

if TYPE_CHECKING:
    from collections.abc import Mapping

LEFT, WIDTH, HEIGHT, GAP = 60.0, 640.0, 118.0, 46.0
SHADES = (ink.SKY, ink.ORANGE, ink.GREEN, ink.PURPLE, ink.VERMILLION, ink.INK)  # one for each signal
LAYERS = ("hatch", "tube", "frame", "marks", "worst", "curve", "wall")


ASPECT = {True: 1.75, False: 0.78}
"""Width over height of the panel of the first page, in the arrangement of a search and in the others."""
LOWEST = 40.0  # a plot that is lower has no room for two numbers


def height(count: int, searches: bool) -> float:
    """Return how high each of ``count`` plots of the first page is, so that they fill their panel."""
    left, right, top, bottom = extent(0, 0.0)
    return max(LOWEST, ((right - left) / ASPECT[searches] - (bottom - top)) / count - GAP)


def extent(count: int, each: float = HEIGHT) -> tuple[float, float, float, float]:
    """Return left, right, top and bottom of ``count`` plots above one another, each so high."""
    return -32.0, LEFT + WIDTH + 76.0, -36.0, count * (each + GAP) + 8.0


@final
class Physics:
    """Pictures of one decision after the other, below ``/physics``."""

    def __init__(self, rr: Any, stream: Any, view: sr.Inspection, searches: bool = False) -> None:
        """Keep the program and its problem; with ``searches`` the first page is arranged for a search."""
        self.searches, self.each = searches, HEIGHT
        self.rr, self.stream, self.view = rr, stream, view
        self.switching = sr.Switching(view.program, view.row)
        assert view.problem is not None
        self.problem = view.problem

    def draw(self, decision: Floats, cuts: Sequence[sr.Cut], mu: Floats | None, proven: Sequence[sr.Cut] = ()) -> None:
        """Draw one decision with the constraints that carry a multiplier; ``mu`` are the multipliers of the equalities,
        if they are known. ``proven``: the constraints of a lower bound, which under a policy also give the
        deviation."""
        from sparserob_rerun.physics.phase import draw_phase

        active = [cut for cut in cuts if cut.multiplier > 0.0]
        # what only says how large the control is, at every piece, is no constraint that decides
        deciding = [cut for cut in active if not self.view.program.family(cut.family).defines]
        data = self.view.picture(decision, deciding)
        worst = self.view.worst_cases(decision)
        switching = self.switching.evaluate(active, mu)
        if switching is None and proven:
            switching = self.switching.evaluate(proven, mu)
        for number, page in enumerate(pages(self.problem)):
            drawing = Drawing()
            self.each = HEIGHT if number else height(len(page.plots), self.searches)
            for top, (kind, index) in enumerate(page.plots):
                last = top == len(page.plots) - 1
                if kind == "control":
                    self._control(drawing, self._axes(top, data, _control_limits(data, index)), data, index, last)
                elif kind == "switching":
                    self._switching(drawing, self._axes(top, data, (-2.0, 2.0)), data, switching, index, last)
                else:
                    self._state(drawing, self._axes(top, data, _state_limits(data, index)), data, worst, index, last)
            self._marks(drawing, data, page.plots)
            drawing.log(self.rr, self.stream, page.path, layers=LAYERS)
        draw_phase(self.rr, self.stream, data, worst, self.searches)

    def signals(self, decision: Floats) -> None:
        """Send the final control and states as series on a timeline of their own, ``t``: the time of the system in
        seconds; under feedback draw its answers, too."""
        from sparserob_rerun.physics.feedback import DRAWS, draw_feedback, send_effort

        rr, data = self.rr, self.view.picture(decision, draws=DRAWS)
        if data.gains is not None:
            draw_feedback(rr, self.stream, data)
            send_effort(rr, self.stream, data)
        self._bars(data)
        time_columns = [rr.TimeColumn("t", duration=data.breakpoints[:-1])]
        channels = len(data.control)
        names = [data.names.control(channel) for channel in range(channels)]
        colours = [ink.legible(SHADES[channel % len(SHADES)]) for channel in range(channels)]
        self.stream.log(
            "signals/control",
            rr.SeriesLines(names=names, colors=colours, interpolation_mode="StepAfter"),
            static=True,
        )
        rows = rr.Scalars.columns(scalars=data.control.T.ravel()).partition([channels] * data.control.shape[1])
        self.stream.send_columns("signals/control", time_columns, rows)
        time_columns = [rr.TimeColumn("t", duration=data.times)]
        for state in self.problem.names.corners.own(self.problem.system.states):
            name, colour = data.names.state(state), ink.legible(SHADES[state % len(SHADES)])
            pale = (*colour[:3], 110)
            self.stream.log(
                f"signals/states/x{state + 1}",
                rr.SeriesLines(
                    names=[f"{name} nominal", f"{name} at least", f"{name} at most"],
                    colors=[colour, pale, pale],
                    widths=[2.0, 1.0, 1.0],
                ),
                static=True,
            )
            values = np.stack([data.state[state], data.tube_lower[state], data.tube_upper[state]], axis=1)
            rows = rr.Scalars.columns(scalars=values.ravel()).partition([3] * len(values))
            self.stream.send_columns(f"signals/states/x{state + 1}", time_columns, rows)

    def _bars(self, data: sr.FigureData) -> None:
        """Draw the nominal control and states as bars over the time of the system, which are there on every
        timeline."""
        rr, middles = self.rr, (data.breakpoints[:-1] + data.breakpoints[1:]) / 2
        widths = np.diff(data.breakpoints)
        for channel, values in enumerate(data.control):
            colour = ink.legible(SHADES[channel % len(SHADES)])
            bars = rr.BarChart(values, color=colour, abscissa=middles, widths=widths)
            self.stream.log(f"signals/bars/controls/u{channel + 1}", bars, static=True)
        for state in self.problem.names.corners.own(self.problem.system.states):
            colour = ink.legible(SHADES[state % len(SHADES)])
            width = np.gradient(data.times)
            bars = rr.BarChart(data.state[state], color=colour, abscissa=data.times, widths=width)
            self.stream.log(f"signals/bars/states/x{state + 1}", bars, static=True)

    def _control(self, drawing: Drawing, axes: Axes, data: sr.FigureData, channel: int, last: bool) -> None:
        name = data.names.control(channel)
        drawing.frame(
            axes,
            f"control {name}(t){_unit(data.names.control_units, channel)}: dashed, its bounds",
            _time(data),
            ticks_below=last,
        )
        for bound in (data.control_lower[channel], data.control_upper[channel]):
            drawing.dashed("marks", axes.at(np.array(axes.x), np.full(2, bound)), ink.VERMILLION)
        steps, edges = data.control[channel], data.breakpoints
        drawing.band("tube", axes, *_fill(edges, steps), ink.TUBE)
        drawing.line("curve", axes.at(np.repeat(edges, 2)[1:-1], np.repeat(steps, 2)), ink.SKY, 2.0)

    def _switching(
        self, drawing: Drawing, axes: Axes, data: sr.FigureData, switching: Floats | None, channel: int, last: bool
    ) -> None:
        name = data.names.control(channel)
        if switching is None or not switching.any():
            reason = "no constraint is active" if switching is not None else "known once the run is over"
            drawing.frame(axes, f"switching function of {name}: {reason}", _time(data), ticks_below=last)
            return
        values = switching[channel]
        reach = max(1.5, float(np.abs(values).max()) * 1.15)
        axes = Axes(axes.left, axes.top, axes.width, axes.height, axes.x, (-reach, reach))
        drawing.frame(
            axes,
            f"switching function of the nominal {name}; 1 is what its largest size costs"
            if self.switching.peak
            else f"switching function: {name} acts outside the band",
            _time(data),
            ticks_below=last,
        )
        for price in (-1.0, 1.0):
            drawing.dashed("marks", axes.at(np.array(axes.x), np.full(2, price)), ink.GREY)
        edges = data.breakpoints
        middles = (edges[:-1] + edges[1:]) / 2
        for side in (1.0, -1.0):
            outer = np.where(side * values > 1.0, values, side)
            drawing.band("tube", axes, middles, np.full(middles.size, side), outer, ink.TUBE)
        drawing.line("curve", axes.at(middles, values), ink.PURPLE, 2.0)

    def _state(
        self, drawing: Drawing, axes: Axes, data: sr.FigureData, worst: Mapping[str, Any], state: int, last: bool
    ) -> None:
        name = data.names.state(state)
        drawing.frame(
            axes,
            f"state {name}(t){_unit(data.names.state_units, state)}: nominal, worst-case tube, walls",
            _time(data),
            ticks_below=last,
        )
        drawing.band("tube", axes, data.times, data.tube_lower[state], data.tube_upper[state], ink.TUBE)
        for wall in data.walls:
            if wall.state == state:
                _wall(drawing, axes, wall)
        for path in worst.get("states", ()):
            drawing.line("worst", axes.at(worst["state_times"], path[state]), ink.ORANGE, 1.2)
        drawing.line("curve", axes.at(data.times, data.state[state]), ink.SKY, 2.0)

    def _axes(self, position: int, data: sr.FigureData, limits: tuple[float, float]) -> Axes:
        ends = float(data.breakpoints[0]), float(data.breakpoints[-1])
        return Axes(LEFT, position * (self.each + GAP), WIDTH, self.each, ends, limits)

    def _marks(self, drawing: Drawing, data: sr.FigureData, plots: Sequence[tuple[str, int]]) -> None:
        """Mark the times of the active constraints through the plots of the control and of its switching function, and
        as dots on the time axis. In the plot of a state, mark those of the constraints that bound it."""
        for position, (kind, index) in enumerate(plots):
            axes = self._axes(position, data, (0.0, 1.0))
            times = data.active.on(index) if kind == "state" else data.active.times
            for time in times:
                drawing.dashed("marks", axes.at(np.full(2, time), np.array([0.0, 1.0])), ink.PURPLE)
            if times.size:
                drawing.dot(axes.at(times, 0.0), ink.PURPLE, 5.0)


def _wall(drawing: Drawing, axes: Axes, wall: sr.Wall) -> None:
    lower, upper, start, end = wall.lower, wall.upper, wall.start, wall.end
    if start == end:
        right = axes.at(end, axes.y[0])[0, 0]
        top, bottom = axes.at(end, min(upper, axes.y[1]))[0, 1], axes.at(end, max(lower, axes.y[0]))[0, 1]
        drawing.line(
            "wall",
            np.array([[right + 2, top], [right + 7, top], [right + 7, bottom], [right + 2, bottom]]),
            ink.VERMILLION,
            3.0,
        )
        return
    for side, outside, nearest in zip(wall.sides, axes.y, (min, max), strict=True):
        if np.isfinite(side).all():
            edge = nearest(side)  # what is beyond is forbidden all the time
            drawing.hatched("hatch", axes, (start, end), (min(edge, outside), max(edge, outside)), ink.HATCH)
            drawing.line("wall", axes.at(np.array([start, end]), np.array(side)), ink.VERMILLION, 1.5)


def _fill(edges: Floats, steps: Floats) -> tuple[Floats, Floats, Floats]:
    """Return the steps as a curve with all but upright flanks."""
    margin = 1e-9 * (edges[-1] - edges[0])
    times, values = np.stack([edges[:-1] + margin, edges[1:] - margin], axis=1).ravel(), np.repeat(steps, 2)
    return times, np.minimum(values, 0.0), np.maximum(values, 0.0)


def _control_limits(data: sr.FigureData, channel: int) -> tuple[float, float]:
    bounds = [
        float(value) for value in (data.control_lower[channel], data.control_upper[channel]) if np.isfinite(value)
    ]
    return _padded([*bounds, 0.0, float(data.control[channel].min()), float(data.control[channel].max())])


def _state_limits(data: sr.FigureData, state: int) -> tuple[float, float]:
    edges = [edge for wall in data.walls if wall.state == state for edge in wall.edges]
    return _padded([*edges, float(data.tube_lower[state].min()), float(data.tube_upper[state].max())])


def _padded(values: list[float]) -> tuple[float, float]:
    low, high = min(values), max(values)
    margin = 0.12 * max(high - low, 1e-9)
    return low - margin, high + margin


def _unit(units: Sequence[str], index: int) -> str:
    return f" in {units[index]}" if units and units[index] else ""


def _time(data: sr.FigureData) -> str:
    return f"t{_unit([data.names.time], 0)}"
