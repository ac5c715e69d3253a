"""Fields of results that know what they hold: their unit, their meaning, how they are printed and how checked.

A field declares this once, as its metadata (`quantity`). Conversions of units, ``result.json``, the certificate,
tables, the columns of a sweep and the comparison of a check are traversals of the fields.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, fields, replace
from functools import cache
from types import MappingProxyType
from typing import Any, TypeAlias, TypeVar, final

import numpy as np

KEY = "quantity"
UNITLESS = frozenset({"", "1", "s"})  # text, numbers without a unit, seconds of a clock
R = TypeVar("R")
Seal: TypeAlias = Callable[[np.ndarray], np.ndarray]
Unit: TypeAlias = "float | np.ndarray | Callable[[Any], Any]"


@final
@dataclass(frozen=True)
class Quantity:
    """Description of a field of a result.

    Parameters
    ----------
    unit : str
        Name of the unit, such as ``cost``; ``1`` for a number without one, and empty for text.
    meaning : str, default ""
        Meaning in a few words, for the columns of a table. A field with a meaning is a statistic, which is written.
    label : str, default ""
        Name of the row that shows it to a user; empty where none does.
    form : str, default ".9g"
        Format of its number in that row.
    certified : str, default ""
        Entry of the certificate that it must equal; the certificate has this entry where both have one name.
    recent : bool, default False
        Whether an earlier version did not write it.
    proven : bool, default False
        Whether it is unknown unless the constraints are proven.
    after : str, default ""
        For a derived quantity, the field that it follows.
    """

    unit: str
    meaning: str = ""
    label: str = ""
    form: str = ".9g"
    certified: str = ""
    recent: bool = False
    proven: bool = False
    after: str = ""


def quantity(unit: str, meaning: str = "", label: str = "", **options: Any) -> Mapping[str, Quantity]:
    """Return the metadata of a field that is a `Quantity`, from the parameters of that."""
    return {KEY: Quantity(unit, meaning, label, **options)}


RECORD = "record"
"""The unit of a field that holds records, whose own fields have units."""

RECORDS = quantity(RECORD)


@cache
def quantities(kind: type) -> Mapping[str, Quantity]:
    """Return the quantities of a class of records: its fields in their order, and what its ``DERIVED`` adds to them."""
    described = dict[str, Quantity]()
    derived: Mapping[str, Quantity] = getattr(kind, "DERIVED", {})
    for entry in fields(kind):
        if KEY in entry.metadata:
            described[entry.name] = entry.metadata[KEY]
            described |= {name: quantity for name, quantity in derived.items() if quantity.after == entry.name}
    return MappingProxyType(described)


def statistics(kind: type) -> dict[str, Quantity]:
    """Return the quantities of a class of records that are written, in the order of ``result.json``."""
    return {name: described for name, described in quantities(kind).items() if described.meaning}


def in_units(record: R, units: Mapping[str, Unit], seal: Seal = np.asarray) -> R:
    """Return a record with every quantity in other units.

    Parameters
    ----------
    record : dataclass
        The record.
    units : mapping
        For the name of a unit the factor, or a function of the value.
    seal : callable, optional
        A function that every new array is passed through.

    Returns
    -------
    dataclass
        The record. Fields of one unit that share an array share one afterwards.

    Raises
    ------
    KeyError
        If a field has a unit without an entry.
    """
    converted = dict[tuple[int, str], Any]()
    changes = dict[str, Any]()
    kind: type = type(record)
    for name, described in quantities(kind).items():
        if described.unit in UNITLESS or described.after:
            continue
        value = getattr(record, name)
        key = id(value), described.unit
        if key not in converted:
            converted[key] = _scale(value, units[described.unit], seal)
        changes[name] = converted[key]
    return replace(record, **changes)  # type: ignore[type-var]


def _scale(value: Any, unit: Unit, seal: Seal) -> Any:
    if value is None or (isinstance(value, np.ndarray) and not value.size):
        return value
    if isinstance(value, list | tuple):
        return tuple(_scale(entry, unit, seal) for entry in value)
    result = unit(value) if callable(unit) else value * unit
    return seal(result) if isinstance(result, np.ndarray) else result
