"""The axes of a study: keys of the config with their values, as they are written in one line."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, final

import numpy as np

from sparserob_core.errors import InputError, Path, dotted
from sparserob_core.experiment.config.plain import IRRELEVANT
from sparserob_core.experiment.config.reading.overrides import parse_overrides, parse_value
from sparserob_core.experiment.config.reading.reader import read_value
from sparserob_core.experiment.config.run_config import SLOTS
from sparserob_core.experiment.plugins.messages import shown

MAX_STUDY_POINTS = 100_000
"""Largest number of values of an axis, and of points of a study."""
FIXED = (*IRRELEVANT, "plugins")
"""Keys that all points of a study have in common, and whose lists are single values."""
NUMBER = r"[-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?"
RANGE = re.compile(rf"(log:)?({NUMBER}):({NUMBER})(?::({NUMBER}))?")
WHOLE = re.compile(r"[-+]?\d+")
OPENING, CLOSING = "([{", ")]}"
AS_WRITTEN = "values such as 1,2,3, start:stop:count such as 0:1:11, or log:start:stop:count such as log:1e-6:1:13"


@final
@dataclass(frozen=True)
class Span:
    """An interval from ``low`` to ``high`` from which values are drawn.

    They are drawn evenly, or evenly in the logarithm (``log``); ``whole`` numbers only where both ends are whole.
    """

    low: float
    high: float
    log: bool = False
    whole: bool = False

    def at(self, share: float) -> float | int:
        """Return the value at a ``share`` of the interval, in [0, 1)."""
        if self.whole:
            return int(self.low) + int(share * (int(self.high) - int(self.low) + 1))
        if self.log:
            return float(self.low * (self.high / self.low) ** share)
        return float(self.low + share * (self.high - self.low))


@final
@dataclass(frozen=True)
class Axis:
    """An axis of a study: a key of the config and its values.

    Parameters
    ----------
    key : str
        The key.
    values : tuple
        Its values.
    written : object
        The axis as it stands in ``sweep.yaml``.
    span : Span, optional
        The interval from which the values are drawn.
    log : bool, default False
        Whether the values are even in the logarithm.
    paired : tuple of str, default ()
        The keys, itself among them, whose values are taken together: the first of each, then the second, and so on.
        Empty for an axis by itself.
    """

    key: str
    values: tuple[Any, ...]
    written: object
    span: Span | None = None
    log: bool = False
    paired: tuple[str, ...] = ()

    @property
    def follows(self) -> bool:
        """True where the axis is paired with an earlier one, which decides its value."""
        return bool(self.paired) and self.paired[0] != self.key

    @property
    def path(self) -> Path:
        """The key, step by step."""
        return path_of(self.key)

    @property
    def single(self) -> bool:
        """True where there is only one value, so that the axis is a change of the config."""
        return self.span is None and len(self.values) == 1

    @property
    def numeric(self) -> bool:
        """True where all values are numbers."""
        return self.span is not None or all(
            isinstance(value, int | float) and not isinstance(value, bool) for value in self.values
        )


def path_of(key: str) -> Path:
    """Return a key, step by step; raises `InputError` where it is none."""
    return parse_overrides({key: None}, read_value)[0].path


def parse_axes(given: Mapping[str, object] | Sequence[str] | None) -> list[Axis]:
    """Return the axes that a user has given.

    Several keys with commas between them are paired: each of their values is a list with one entry for each key.

    Parameters
    ----------
    given : mapping or sequence of str, optional
        Texts ``key=values``, or a mapping of keys to texts, to lists of values, or to single values.

    Returns
    -------
    list of Axis
        The axes.

    Raises
    ------
    InputError
        If a key is at fault or is given twice; the error names it.
    """
    if isinstance(given, str):
        raise InputError(f"axes: expected a list of texts or a mapping, got {shown(given)}")
    pairs: list[tuple[str, object]] = []
    for entry in given.items() if isinstance(given, Mapping) else given or ():
        if isinstance(entry, str):
            key, equals, text = entry.partition("=")
            if not equals:
                raise InputError(f"axis {shown(entry)}: expected key=values, for example seed=0:19:20")
            pairs.append((key.strip(), text))
        else:
            pairs.append((str(entry[0]), entry[1]))
    axes = [axis for key, value in pairs for axis in _make_axes(key, value)]
    for position, axis in enumerate(axes):
        if axis.path in (earlier.path for earlier in axes[:position]):
            raise InputError(path=axis.key, expected="every key once", got="it twice")
    return axes


def _make_axes(key: str, value: Any) -> list[Axis]:
    """Return the axis of a key, or the axes of several keys that are paired."""
    keys = [name.strip() for name in key.split(",")]
    if len(keys) == 1:
        return [_make_axis(key, value)]
    entries = _parse_rows(key, value) if isinstance(value, str) else value
    rows = (
        [_to_plain(row) for row in entries] if isinstance(entries, list | tuple) or hasattr(entries, "tolist") else []
    )
    if not rows or not all(isinstance(row, list) and len(row) == len(keys) for row in rows):
        raise InputError(
            path=key,
            expected=f"lists of {len(keys)} values, one for each key, such as [1, 2], [3, 4]",
            got=shown(value),
        )
    _check_values(key, tuple(rows))
    axes = []
    for name, column in zip(keys, zip(*rows, strict=True), strict=True):
        if path_of(name)[0] in FIXED:
            raise InputError(path=name, expected="a key that decides a result, where keys are paired", got="this one")
        paired = tuple(keys) if len(rows) > 1 else ()
        axes.append(Axis(name, column, list(column), log=_is_geometric(column), paired=paired))
    return axes


def require_whole(axes: Sequence[Axis]) -> None:
    """Raise `InputError` where one of several paired keys was changed, and the others were not."""
    groups = {axis.key: axis.paired for axis in axes}
    for axis in axes:
        for paired_key in axis.paired:
            if groups.get(paired_key) != axis.paired:
                raise InputError(
                    path=paired_key,
                    expected=f"values for {','.join(axis.paired)} together, since these keys are paired",
                    got="values for this one alone",
                )


def _make_axis(key: str, value: object) -> Axis:
    if path_of(key)[0] in FIXED:
        value = _to_plain(_parse_entry(key, value, 1) if isinstance(value, str) else value)
        return Axis(key, (value,), value)
    if hasattr(value, "tolist"):
        value = value.tolist()
    if isinstance(value, str):
        return _parse_axis(key, value)
    if isinstance(value, list | tuple | range):
        values = tuple(_to_plain(entry) for entry in value)
        return Axis(key, _check_values(key, values), list(values), log=_is_geometric(values))
    return Axis(key, (_to_plain(value),), _to_plain(value))


def _parse_rows(key: str, text: str) -> list[Any]:
    """Return the values of paired keys from one line of text."""
    tokens = list(split(text))
    rows = [_parse_entry(key.partition(",")[0], token, len(tokens)) for token in tokens]
    inner_rows = rows[0] if len(rows) == 1 and isinstance(rows[0], list) else []
    return inner_rows if inner_rows and all(isinstance(row, list) for row in inner_rows) else rows


def _parse_axis(key: str, text: str) -> Axis:
    """Return the axis of a key from one line of text."""
    values, logs, span = list[Any](), list[bool](), None
    tokens = list(split(text))
    for token in tokens:
        match = RANGE.fullmatch(token)
        if match is None and token.startswith("log:"):
            raise InputError(path=key, expected=AS_WRITTEN, got=shown(token))
        if match is None:
            values.append(_parse_entry(key, token, len(tokens)))
            continue
        logs.append(bool(match[1]))
        if match[4] is not None:
            values += _expand_range(key, token, match)
        elif len(tokens) == 1:
            span = _make_span(key, token, match)
        else:
            raise InputError(path=key, expected=f"one range, or {AS_WRITTEN}", got=shown(text))
    if len(values) == 1 and span is None and isinstance(values[0], list) and _is_component(key):
        values = values[0]  # a component is never a list, so that the list holds the values
    log = all(logs) if logs else _is_geometric(values)
    return Axis(key, () if span else _check_values(key, tuple(values)), text.strip(), span, log)


def split(text: str) -> Iterator[str]:
    """Yield the parts of a text between commas; commas inside brackets, braces and quotes do not count."""
    depth, quote, start, previous_letter = 0, "", 0, ","
    for position, letter in enumerate(text):
        if quote:
            quote = "" if letter == quote else quote
        elif letter in "'\"" and previous_letter in ",:" + OPENING:
            quote = letter
        elif letter in OPENING:
            depth += 1
        elif letter in CLOSING:
            depth -= 1
        elif letter == "," and depth == 0:
            yield text[start:position].strip()
            start = position + 1
        previous_letter = previous_letter if letter.isspace() else letter
    yield text[start:].strip()


def _parse_entry(key: str, part: str, of: int) -> object:
    if not part and of > 1:
        raise InputError(path=key, expected="a value between commas", got="nothing")
    try:
        return parse_value(f"{key}={part}", read_value)
    except InputError as error:
        raise InputError(f"{key}: {error}") from None


def _expand_range(key: str, part: str, found: re.Match[str]) -> list[float] | list[int]:
    low, high, log = float(found[2]), float(found[3]), bool(found[1])
    if (
        not WHOLE.fullmatch(found[4])
        or not 1 <= int(found[4]) <= MAX_STUDY_POINTS
        or (int(found[4]) == 1 and low != high)
    ):
        raise InputError(
            path=key,
            expected=f"a whole number of values at the end of {shown(part)}, from 2 to {MAX_STUDY_POINTS}",
            got=found[4],
        )
    count = int(found[4])
    _check_ends(key, part, low, high, log)
    if log:
        values = np.geomspace(low, high, count)
    else:
        values = np.linspace(low, high, count)
        steps = max(1, count - 1)
        if WHOLE.fullmatch(found[2]) and WHOLE.fullmatch(found[3]) and (int(found[3]) - int(found[2])) % steps == 0:
            step = (int(found[3]) - int(found[2])) // steps
            return [int(found[2]) + k * step for k in range(count)]
    # rounded to 15 digits, so that the third of ten steps to 1 is 0.3
    return [low, *(float(f"{value:.15g}") for value in values[1:-1]), *([high] if count > 1 else [])]


def _make_span(key: str, part: str, found: re.Match[str]) -> Span:
    low, high, log = float(found[2]), float(found[3]), bool(found[1])
    _check_ends(key, part, low, high, log)
    if not low < high:
        raise InputError(path=key, expected="a range that goes up", got=shown(part))
    return Span(low, high, log, not log and bool(WHOLE.fullmatch(found[2]) and WHOLE.fullmatch(found[3])))


def _check_ends(key: str, part: str, low: float, high: float, log: bool) -> None:
    if not (np.isfinite(low) and np.isfinite(high)):
        raise InputError(path=key, expected="finite numbers", got=shown(part))
    if log and not (low > 0.0 and high > 0.0):
        raise InputError(path=key, expected="positive numbers in a logarithmic range", got=shown(part))


def _check_values(key: str, values: tuple[Any, ...]) -> tuple[Any, ...]:
    if not 1 <= len(values) <= MAX_STUDY_POINTS:
        raise InputError(path=key, expected=f"1 to {MAX_STUDY_POINTS} values", got=str(len(values)))
    reprs = set[str]()
    for value in values:
        if repr(value) in reprs:
            raise InputError(path=key, expected="every value once", got=f"{shown(value)} twice")
        reprs.add(repr(value))
    return values


def _is_geometric(values: Sequence[Any]) -> bool:
    """Return whether listed numbers are meant for a logarithmic axis: at least three, over at least two decades."""
    numbers = [
        float(value) for value in values if isinstance(value, int | float) and not isinstance(value, bool) and value > 0
    ]
    return len(numbers) == len(values) >= 3 and max(numbers) >= 100.0 * min(numbers)


def _is_component(key: str) -> bool:
    return key.strip() in {dotted(path) for path in SLOTS}


def _to_plain(value: Any) -> Any:
    """Return a value from Python as a config has it."""
    if hasattr(value, "tolist"):
        return value.tolist()
    if isinstance(value, Mapping):
        return {str(key): _to_plain(item) for key, item in value.items()}
    return [_to_plain(item) for item in value] if isinstance(value, list | tuple) else value
