"""Arguments that are plain numbers: whole ones, and shares. A truth value is none, a number of numpy is one."""

from __future__ import annotations

import numpy as np

from sparserob_core.errors import InputError


def is_whole(value: object, least: int) -> bool:
    """Return whether a value is a whole number of at least ``least``; a truth value is no number."""
    return isinstance(value, int | np.integer) and not isinstance(value, bool) and bool(value >= least)


def whole(name: str, value: int, least: int) -> int:
    """The argument ``name``, which must be a whole number of at least ``least``; raises `InputError`."""
    if not is_whole(value, least):
        raise InputError(f"{name}: expected a whole number of at least {least}, got {value!r}")
    return int(value)


def share(name: str, value: float) -> float:
    """The argument ``name``, which must be a share of the budget; raises `InputError`."""
    argument: object = value
    is_number = isinstance(argument, int | float | np.integer | np.floating) and not isinstance(argument, bool)
    if not is_number or not 0.0 <= value < 1.0:
        raise InputError(f"{name}: expected a share of the budget, at least 0 and below 1, got {value!r}")
    return float(value)
