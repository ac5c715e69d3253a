"""Records in a few lines, for a prompt: long arrays by their shapes, long sequences by their lengths."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import fields, is_dataclass
from typing import Any

import numpy as np

LINES = 10
"""Lines of a record at most. A hundred would push what was typed before off a terminal, one says nothing."""

WIDTH = 100
"""Letters of a value at most, a line of a terminal. With ten no path is recognised, with a thousand one value fills
half of a terminal."""

ENTRIES = 6
"""Entries of an array that is shown number by number. Of sixty nobody reads the last; with none, a point of the plane
would be told by its shape only."""


def brief(record: Any) -> str:
    """A dataclass in at most `LINES` lines, for its ``__repr__``: a line for every field that is shown, and the names
    of those for which no line is left."""
    shown = [one.name for one in fields(record) if one.repr and not one.name.startswith("_")]
    room = len(shown) if len(shown) < LINES else LINES - 2
    lines = [type(record).__name__, *(f"  {name}: {_value(getattr(record, name))}" for name in shown[:room])]
    if shown[room:]:
        lines.append("  " + _cut(f"and {', '.join(shown[room:])}"))
    return "\n".join(lines)


def _value(value: object) -> str:
    if isinstance(value, np.ndarray):
        numbers = np.array2string(value, precision=6, separator=", ", max_line_width=WIDTH)
        return " ".join(numbers.split()) if value.size <= ENTRIES else f"array {value.shape}"
    if isinstance(value, float | np.floating):
        return f"{value:.9g}"
    if isinstance(value, Mapping | Sequence) and not isinstance(value, str) and len(value) > ENTRIES:
        return f"{len(value)} entries"
    if is_dataclass(value):
        return type(value).__name__
    if isinstance(value, Mapping):
        return _cut("{" + ", ".join(f"{key}: {_value(one)}" for key, one in value.items()) + "}")
    if isinstance(value, list | tuple):
        return _cut("[" + ", ".join(_value(one) for one in value) + "]")
    return _cut(value if isinstance(value, str) else repr(value))


def _cut(text: str) -> str:
    line = " ".join(text.split())
    return line if len(line) <= WIDTH else f"{line[: WIDTH - 3]}..."
