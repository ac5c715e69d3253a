"""Every place of a tree of JSON made wrong in every way: numbers, arrays and structures, in an order by a seed."""

from __future__ import annotations

import copy
import math
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np

Place = tuple[str | int, ...]
EACH = 2  # places of one kind, such as the entries of one array: the first, and others by the seed

NOT_FINITE: dict[str, Any] = {"nan": math.nan, "inf": math.inf, "-inf": -math.inf, "beyond floats": 10**400}
OF_NUMBERS: dict[str, Callable[[Any], Any]] = {
    **{name: (lambda _, value=value: value) for name, value in NOT_FINITE.items()},
    "other sign": lambda value: -value,
    "huge": lambda value: 1e300 if value >= 0 else -1e300,
    "tiny": lambda _: 5e-324,
    "a little off": lambda value: value * (1.0 + 1e-9) + 1e-9,
    "halved": lambda value: value / 2,
    "one more": lambda value: value + 1,
    "whole": int,
    "text": repr,
    "truth": bool,
}
OF_LISTS: dict[str, Callable[[Any], Any]] = {
    "empty": lambda _: [],
    "shorter": lambda value: value[:-1],
    "longer": lambda value: [*value, *value[-1:]],
    "ragged": lambda value: [[1.0, *value[:1]], *value],
    "backwards": lambda value: value[::-1],
    "a number": lambda _: 1.0,
}
OF_ALL: dict[str, Callable[[Any], Any]] = {
    "null": lambda _: None,
    "deeper": lambda value: [value],
    "very deep": lambda value: [[[[[[value]]]]]],
    "a mapping": lambda value: {"value": value},
    "words": lambda _: "nonsense",
}


def places(data: Any, rng: np.random.Generator, at: Place = ()) -> Iterator[Place]:
    """Every place of a tree; of a list its first entry and `EACH` less one others."""
    if at:
        yield at
    if isinstance(data, dict):
        for key, value in data.items():
            yield from places(value, rng, (*at, key))
    elif isinstance(data, list) and data:
        others = rng.integers(0, len(data), size=EACH - 1).tolist()
        for number in dict.fromkeys([0, *others]):
            yield from places(data[number], rng, (*at, number))


def value_at(data: Any, place: Place) -> Any:
    for key in place:
        data = data[key]
    return data


def changes(value: Any) -> dict[str, Callable[[Any], Any]]:
    """What may be done to an entry, by its kind."""
    if isinstance(value, list):
        return OF_LISTS | OF_ALL
    return (OF_NUMBERS | OF_ALL) if isinstance(value, int | float) and not isinstance(value, bool) else OF_ALL


def tampered(data: dict[str, Any], seed: int) -> Iterator[tuple[str, Place, dict[str, Any]]]:
    """Copies of a tree, each with one entry changed or missing, with what was done and where; the same by its seed."""
    rng = np.random.default_rng(seed)
    for place in list(places(data, rng)):
        for name, change in changes(value_at(data, place)).items():
            made = copy.deepcopy(data)
            holder = value_at(made, place[:-1])
            holder[place[-1]] = change(holder[place[-1]])
            yield name, place, made
        made = copy.deepcopy(data)
        del value_at(made, place[:-1])[place[-1]]
        yield "missing", place, made
