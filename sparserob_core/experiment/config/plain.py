"""Resolved configs as plain data: their identity, their differences, and short texts of their values."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from typing import Any

IRRELEVANT = ("executor", "observers", "title", "limits")
"""Keys of a config that do not decide the result of a finished run."""


def identity(plain: Mapping[str, Any]) -> str:
    """Return the SHA-256 of a resolved config without the keys that do not decide the result of a finished run.

    These are the executor, the observers, the title and the limits. The hash is that of the JSON text with sorted keys
    and without spaces.
    """
    kept = {key: value for key, value in plain.items() if key not in IRRELEVANT}
    text = json.dumps(kept, sort_keys=True, separators=(",", ":"), allow_nan=False)
    return hashlib.sha256(text.encode()).hexdigest()


def difference(one: Any, two: Any, path: str = "") -> tuple[str, Any, Any] | None:
    """Return the first place at which two parts of a config differ, and both values; ``None`` where they are equal.

    A key that is missing counts as null.
    """
    if isinstance(one, Mapping) and isinstance(two, Mapping):
        steps = [(str(key), one.get(key), two.get(key)) for key in {**one, **two}]
    elif (
        isinstance(one, list)
        and isinstance(two, list)
        and len(one) == len(two)
        and any(isinstance(entry, Mapping) for entry in one)
    ):
        steps = [(str(key), *pair) for key, pair in enumerate(zip(one, two, strict=True))]
    else:
        return None if one == two else (path, one, two)
    below = ((f"{path}.{key}" if path else key, first, second) for key, first, second in steps)
    return next((result for key, first, second in below if (result := difference(first, second, key))), None)


def value_text(value: object) -> str:
    """Return a short text of a value of a config; a component is its name with the options that are not null."""
    if isinstance(value, Mapping):
        options = ", ".join(
            f"{key} {value_text(item)}" for key, item in value.items() if key != "name" and item is not None
        )
        return f"{value.get('name', '')} ({options})".strip() if options else str(value.get("name", "{}"))
    if isinstance(value, list | tuple):
        return "[" + ", ".join(map(value_text, value)) + "]"
    if isinstance(value, bool) or value is None:
        return {True: "on", False: "off", None: "none"}[value]
    return f"{value:g}" if isinstance(value, float) else str(value)
