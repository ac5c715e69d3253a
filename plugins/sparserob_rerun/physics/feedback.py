"""Pictures of a control that answers what it measures: its gains, and what every innovation moved in the worst case.
The size of the control under random disturbances is drawn as series."""

from __future__ import annotations

from collections.abc import Iterator
from typing import TYPE_CHECKING, Any

import numpy as np

from sparserob_rerun.drawing.canvas import Axes, Drawing
from sparserob_rerun.drawing.palette import Floats, diverging

if TYPE_CHECKING:
    import sparserob_core as sr

SIDE, GAP, LEFT, TOP = 190.0, 62.0, 70.0, 80.0  # of the pictures, in the units of the view
PIXELS = 240  # of a picture's side
CHANNELS, STATES = 4, 6  # at most, of which there are pictures
DRAWS = 1000
WORDS = """
**gain**: how much the control of a time changes for a unit of what a measurement of an earlier time has brought as new,
an *innovation*. **What moved it in the worst case**: the gain times the innovation, in the worst case of the constraint
that is nearest to its bound.

Black is what is not measured yet: a control answers what was seen before it. What is pale is not answered.
"""


def extent(channels: int, states: int) -> tuple[float, float, float, float]:
    """Return left, right, top and bottom of the pictures: a row for each channel, one picture for each state and one
    for the answers."""
    across, down = min(states, STATES) + 1, min(channels, CHANNELS)
    return 0.0, LEFT + across * (SIDE + GAP), 0.0, TOP + down * (SIDE + GAP)


def draw_feedback(rr: Any, stream: Any, data: sr.FigureData) -> None:
    """Draw the gains below ``/feedback/gains`` and the answers below ``/feedback/answers``. Both have the time of an
    innovation across and that of the control upwards; blue adds less than nothing, red more."""
    drawing, ends = Drawing(), data.breakpoints
    span = (float(ends[0]), float(ends[-1]))
    for path, cell, title, table in pictures(data):
        left, top = LEFT + cell[1] * (SIDE + GAP), TOP + cell[0] * (SIDE + GAP)
        largest = float(np.abs(table).max())
        drawing.frame(Axes(left, top, SIDE, SIDE, span, span), f"{title}: up to {largest:.3g}")
        shown = diverging(spread_out(table / (largest or 1.0), ends))
        stream.log(
            path,
            rr.Transform3D(translation=(left, top, 0.0), scale=SIDE / PIXELS),
            rr.Image(np.ascontiguousarray(shown)),
        )
    words = f"across: when it was seen; upwards: when it is answered; {data.worst_case}"
    drawing.text(LEFT + 1.5 * SIDE, TOP - 46.0, words)
    drawing.log(rr, stream, "feedback/frames", layers=("frame",))
    stream.log("feedback/words", rr.TextDocument(WORDS, media_type="text/markdown"), static=True)


def pictures(data: sr.FigureData) -> Iterator[tuple[str, tuple[int, int], str, Floats]]:
    """Yield entity, row and column, title and table ``(K, K)`` of every picture."""
    assert data.gains is not None
    _, _, channels, states = data.gains.shape
    for channel in range(min(channels, CHANNELS)):
        u = data.names.control(channel)
        for state in range(min(states, STATES)):
            path = f"feedback/gains/u{channel + 1}_x{state + 1}"
            title = f"gain of {u} on {f'y{state + 1}' if data.outputs is not None else data.names.state(state)}"
            yield path, (channel, state), title, data.gains[:, :, channel, state]
        if data.answers is not None:
            cell = (channel, min(states, STATES))
            path = f"feedback/answers/u{channel + 1}"
            yield path, cell, f"what moved {u} in the worst case", data.answers[:, :, channel]


def spread_out(table: Floats, ends: Floats) -> Floats:
    """Return a table of pieces as a picture over time, the first piece at the bottom; NaN where nothing is measured
    yet."""
    K = table.shape[0]
    shown = np.where(np.tril(np.ones((K, K))) > 0, table, np.nan)
    times = ends[0] + (ends[-1] - ends[0]) * (np.arange(PIXELS) + 0.5) / PIXELS
    pieces = np.clip(np.searchsorted(ends, times, side="right") - 1, 0, K - 1)
    return np.asarray(shown[np.ix_(pieces[::-1], pieces)])


def send_effort(rr: Any, stream: Any, data: sr.FigureData) -> None:
    """Send series on the timeline ``t``: least and most of the control under any disturbance, with the control itself;
    and how large the control is under random disturbances."""
    assert data.control_least is not None and data.control_most is not None
    time_columns = [rr.TimeColumn("t", duration=data.breakpoints[:-1])]
    pieces = data.breakpoints.size - 1
    largest = np.maximum(np.abs(data.control_least), np.abs(data.control_most))
    for channel in range(data.control.shape[0]):
        name = data.names.control(channel)
        series = {f"signals/control/range{channel + 1}": (
            [f"{name} at least", f"{name} at most"],
            np.stack([data.control_least[channel], data.control_most[channel]], axis=1),
        )}  # fmt: skip
        if data.effort is not None:
            names = [f"|{name}|, 5 % of draws", f"|{name}|, median", f"|{name}|, 95 % of draws", f"|{name}| at most"]
            values = np.concatenate([data.effort[:, channel].T, largest[channel][:, None]], axis=1)
            series[f"signals/effort/u{channel + 1}"] = (names, values)
        for path, (names, values) in series.items():
            stream.log(path, rr.SeriesLines(names=names, interpolation_mode="StepAfter"), static=True)
            rows = rr.Scalars.columns(scalars=values.ravel()).partition([values.shape[1]] * pieces)
            stream.send_columns(path, time_columns, rows)
