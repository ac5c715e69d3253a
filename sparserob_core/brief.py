"""Records in a few lines, for a prompt: long arrays by their shapes, long sequences by their lengths."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import fields, is_dataclass
from typing import Any

import numpy as np

MAX_BRIEF_LINES = 10
"""Lines of a record at most. A hundred would push what was typed before off a terminal, one says nothing."""

MAX_VALUE_LETTERS = 100
"""Letters of a value at most, a line of a terminal. With ten no path is recognised, with a thousand one value fills
half of a terminal."""

ENTRIES = 6
"""Entries of an array that is shown number by number. Of sixty nobody reads the last; with none, a point of the plane
would be told by its shape only."""


def brief(record: Any) -> str:
    """A dataclass in at most `MAX_BRIEF_LINES` lines, for its ``__repr__``: a line for every field that is shown, and
    the names of those for which no line is left."""
    return _format_lines(type(record).__name__, _list_fields(record))


def shortened(lines: Sequence[str]) -> str:
    """Lines for a prompt: long ones cut, and of many the first and how many more there are."""
    kept = (
        lines
        if len(lines) <= MAX_BRIEF_LINES
        else [*lines[: MAX_BRIEF_LINES - 1], f"  and {len(lines) - MAX_BRIEF_LINES + 1} more"]
    )
    return "\n".join(f"{line[: len(line) - len(line.lstrip())]}{_shorten(line)}" for line in kept)


def _format_lines(heading: str, shown: Sequence[tuple[str, object]]) -> str:
    room = len(shown) if len(shown) < MAX_BRIEF_LINES else MAX_BRIEF_LINES - 2
    lines = [heading, *(f"  {name}: {_format_value(value)}" for name, value in shown[:room])]
    if shown[room:]:
        lines.append("  " + _shorten(f"and {', '.join(name for name, _ in shown[room:])}"))
    return "\n".join(lines)


def _list_fields(record: Any) -> list[tuple[str, object]]:
    names = [item.name for item in fields(record) if item.repr and not item.name.startswith("_")]
    return [(name, getattr(record, name)) for name in names]


def _drop_empty(shown: Sequence[tuple[str, object]]) -> list[tuple[str, object]]:
    return [(name, value) for name, value in shown if not (value is None or _is_empty(value))]


def _is_empty(value: object) -> bool:
    return isinstance(value, str | tuple | list | Mapping) and not value


def noun(record: Any) -> str:
    """A dataclass of what a problem is made of, for its ``__repr__``: one line where it fits into `MAX_VALUE_LETTERS`,
    else as `brief` says it. What was left out, ``None`` or nothing, is not said. A record may have a name and fields of
    its own to be shown by, ``noun_of``."""
    heading, shown = getattr(record, "noun_of", None) or (type(record).__name__, _list_fields(record))
    entries = _drop_empty(shown)
    line = f"{heading}({', '.join(f'{name}={_format_value(value)}' for name, value in entries)})"
    return line if len(line) <= MAX_VALUE_LETTERS else _format_lines(heading, entries)


def _format_value(value: object) -> str:
    if isinstance(value, np.ndarray):
        numbers = np.array2string(value, precision=6, separator=", ", max_line_width=MAX_VALUE_LETTERS)
        return " ".join(numbers.split()) if value.size <= ENTRIES else f"array {value.shape}"
    if isinstance(value, float | np.floating):
        return f"{value:.9g}"
    if isinstance(value, Mapping | Sequence) and not isinstance(value, str) and len(value) > ENTRIES:
        return f"{len(value)} entries"
    if is_dataclass(value):
        line = repr(value) if type(value).__repr__ is noun else ""
        return line if line and "\n" not in line else getattr(value, "noun_of", (type(value).__name__,))[0]
    if isinstance(value, Mapping):
        return _shorten("{" + ", ".join(f"{key}: {_format_value(item)}" for key, item in value.items()) + "}")
    if isinstance(value, list | tuple):
        return _shorten("[" + ", ".join(_format_value(item) for item in value) + "]")
    return _shorten(value if isinstance(value, str) else repr(value))


def _shorten(text: str) -> str:
    line = " ".join(text.split())
    return line if len(line) <= MAX_VALUE_LETTERS else f"{line[: MAX_VALUE_LETTERS - 3]}..."
