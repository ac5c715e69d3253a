"""Appearance of a status in a study: a colour and a mark for each, and never the colour alone."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from textwrap import shorten
from typing import Any

import numpy as np

from sparserob_rerun.drawing import palette as ink
from sparserob_rerun.drawing.canvas import Drawing
from sparserob_rerun.drawing.palette import Colour, Floats

COLOURS: Mapping[str, Colour] = {
    "certified": ink.GREEN,
    "verified": ink.SKY,
    "undecided": ink.ORANGE,
    "refuted": ink.VERMILLION,
    "infeasible": ink.PURPLE,
    "failed": ink.INK,
    "running": ink.SKY,
    "waiting": ink.FAINT,
}
"""Statuses of a point, with their colours; a status that is not known here has that of a failed one."""
STEP, LETTERS = 112.0, 24
SIZE = 5.0
_TURN = np.linspace(0.0, 2.0 * np.pi, 13)
_SHAPES: Mapping[str, Sequence[Floats]] = {
    "certified": [np.stack([np.cos(_TURN), np.sin(_TURN)], axis=-1) * 0.5],
    "verified": [np.array([[-0.9, -0.9], [0.9, -0.9], [0.9, 0.9], [-0.9, 0.9], [-0.9, -0.9]])],
    "undecided": [np.array([[0, -1.2], [1.2, 0], [0, 1.2], [-1.2, 0], [0, -1.2]])],
    "refuted": [np.array([[-1.1, -0.8], [1.1, -0.8], [0, 1.1], [-1.1, -0.8]])],
    "infeasible": [np.array([[-1.0, -1.0], [1.0, 1.0]]), np.array([[-1.0, 1.0], [1.0, -1.0]])],
    "failed": [np.array([[-1.2, 0.0], [1.2, 0.0]]), np.array([[0.0, -1.2], [0.0, 1.2]])],
    "running": [np.stack([np.cos(_TURN), np.sin(_TURN)], axis=-1) * 1.3],
    "waiting": [np.array([[-0.4, 0.0], [0.4, 0.0]])],
}


def mark(drawing: Drawing, at: Floats, status: str, colour: Colour | None = None) -> None:
    """Draw the mark of a status at a pixel ``(2,)``, in its own colour unless another one is given."""
    width = 5.0 if status == "certified" else 2.0  # a filled dot: a thick, small ring
    for shape in _SHAPES.get(status, _SHAPES["failed"]):
        drawing.line("marks", at + SIZE * shape, colour or COLOURS.get(status, ink.INK), width)


def legend(drawing: Drawing, left: float, top: float, counts: Mapping[str, int]) -> None:
    """Draw what the marks mean, and how many points have each, in rows of four."""
    for position, status in enumerate(name for name in COLOURS if counts.get(name)):
        at = np.array([left + 1.4 * STEP * (position % 4), top + 20.0 * (position // 4)])
        mark(drawing, at, status)
        drawing.text(at[0] + 16.0 + 4.5 * len(f"{counts[status]} {status}"), at[1], f"{counts[status]} {status}")


def said(value: Any) -> str:
    """Write a value of an axis in a few letters."""
    if isinstance(value, Mapping) and "name" in value:
        options = ", ".join(f"{key} {said(entry)}" for key, entry in value.items() if key != "name")
        text = f"{value['name']} ({options})" if options else str(value["name"])
    elif isinstance(value, float):
        text = f"{value:.6g}"
    else:
        text = str(value)
    return shorten(" ".join(text.split()), LETTERS, placeholder="...") if len(text) > LETTERS else text


def named(axes: Sequence[str], values: Sequence[Any]) -> str:
    """Name a point in words: the last step of each key and its value; of a study without axes there is only one."""
    if not axes:
        return "the only point"
    steps = [[step for step in key.split(".") if step != "name"] for key in axes]
    return ", ".join(
        f"{(step or [key])[-1]} {said(value)}" for key, step, value in zip(axes, steps, values, strict=True)
    )


def plainly(text: str) -> str:
    """Return a text that Markdown leaves as it is."""
    return "".join(f"\\{letter}" if letter in "\\`*_{}[]<>#|~" else letter for letter in " ".join(text.split()))
