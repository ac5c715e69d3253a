"""Terms of a problem: records whose fields say what becomes of them in other units, and from a later time on.

A field of a term has a quantity as its metadata, such as ``field(metadata=TIME)``. What is done to a whole problem is
then one traversal of its fields, whatever terms it is made of, and a new term says all of it where it is declared.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import fields, replace
from typing import Any, Self, TypeAlias

import numpy as np

from sparserob_core.shapes import sealed

Quantity: TypeAlias = Mapping[str, Any]
Unit: TypeAlias = Callable[[Any], Any]  # of the `Units` of a problem, what one of a quantity is in the user's
Remaining: TypeAlias = Callable[[Any, float, float], Any]  # of a value, when, and how long from then on


SAME_TIME = 1e-12
"""Of the horizon, what is rounding. With ten times less, sums of steps leave pieces of no length; with ten times more,
a clock could tell what is taken for one."""


def over(stop: float, begin: float, horizon: float = 0.0) -> bool:
    """Return whether a term that lasts until ``stop`` has ended by the time ``begin``, up to rounding.

    The tolerance is `SAME_TIME` of the latest time, ``begin + horizon``.
    """
    return stop <= begin + SAME_TIME * (begin + horizon)


class Term:
    """A fact about a problem: a frozen dataclass, every field of which has a `Quantity` as its metadata."""

    def __post_init__(self) -> None:
        sealed(self)

    def in_units(self, units: Any) -> Self:
        """Return the term with every number converted to these `Units`."""
        return self._map_fields("in_units", units)

    def remaining(self, begin: float, horizon: float, **given: Any) -> Self | None:
        """Return the term from the time ``begin`` on, over a ``horizon``, with times counted from ``begin``.

        The result is ``None`` where nothing of the term is left. ``given`` holds new values of fields, which are taken
        as they are.
        """
        return self._map_fields("remaining", begin, horizon, **given)

    def _map_fields(self, verb: str, *how: Any, **given: Any) -> Self:
        kept: Any = self
        changes = {
            field.name: _map_values(field.metadata[verb], getattr(self, field.name), *how)
            for field in fields(kept)
            if field.name not in given
        }
        changed: Self = replace(kept, **changes, **given)
        return changed


def _map_values(change: Callable[..., Any], value: Any, *how: Any) -> Any:
    """A value that is changed, or each of a tuple, without those of which nothing is left; of ``None`` nothing is."""
    if isinstance(value, tuple):
        pairs = [(item, _map_values(change, item, *how)) for item in value]
        return tuple(changed for item, changed in pairs if changed is not None or item is None)
    return None if value is None else change(value, *how)


def unchanged(value: Any, *how: Any) -> Any:
    """Return a value as it is, for a field that has no unit or does not depend on time."""
    return value


def measured(unit: Unit, remaining: Remaining = unchanged) -> Quantity:
    """A number, an array, or a set of points, counted in a ``unit``; of a term, the `Units` in which its own fields
    are."""

    def in_units(value: Any, units: Any) -> Any:
        return value.in_units(unit(units)) if hasattr(value, "in_units") else np.asarray(value) / unit(units)

    return {"in_units": in_units, "remaining": remaining}


def timed(unit: Unit, remaining: Remaining) -> Quantity:
    """Rows ``(q, 1 + d)`` of a time and what is counted in a ``unit``; or ``(d,)`` of what is the same at all times."""

    def row(units: Any) -> Any:
        return np.append(units.time, unit(units))

    def in_units(value: Any, units: Any) -> Any:
        return np.asarray(value) / (row if np.ndim(value) == 2 else unit)(units)

    return {"in_units": in_units, "remaining": remaining}


def _clip_time(time: float, begin: float, horizon: float) -> float:
    return min(max(0.0, time - begin), horizon)


def _take_remaining(value: Any, begin: float, horizon: float) -> Any:
    return value.remaining(begin, horizon)


UNITLESS: Quantity = {"in_units": unchanged, "remaining": unchanged}
TIME = measured(lambda of: of.time, _clip_time)
STATES = measured(lambda of: of.states)
CONTROLS = measured(lambda of: of.controls)
TERMS = measured(lambda of: of, _take_remaining)
KIND = "kind"


def each(kind: type[Term]) -> Quantity:
    """A list of terms of one kind."""
    return {**TERMS, KIND: kind}
