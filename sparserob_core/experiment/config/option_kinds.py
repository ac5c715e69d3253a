"""Types of values in a config.

The value itself shows which member of a union is meant, so that an error is about that member only.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Annotated, Any, TypeAlias

import numpy as np
from pydantic import Discriminator, SerializerFunctionWrapHandler, Tag, model_serializer

from sparserob_core.errors import InputError
from sparserob_core.options import Options
from sparserob_core.sip.convex_set import Array


def one_of(expected: str, **kinds: type | tuple[type, ...]) -> Discriminator:
    """Return the discriminator that chooses the member of a union by the type of the value.

    ``kinds`` are the types of each member's tag. The error for any other value begins with ``expected``.
    """

    def chosen(value: object) -> str | None:
        return (
            None
            if isinstance(value, bool)
            else next((tag for tag, kind in kinds.items() if isinstance(value, kind)), None)
        )

    return Discriminator(chosen, custom_error_type="kind", custom_error_message=f"expected {expected}")


NUMBER, LIST = (int, float, np.number), (list, tuple)
Number: TypeAlias = Annotated[float, Tag("number")]
Numbers: TypeAlias = Annotated[list[float], Tag("list")]
FreeNumbers: TypeAlias = Annotated[list[float | None], Tag("list")]
OneOrMore: TypeAlias = Annotated[Number | Numbers, one_of("a number or a list of numbers", number=NUMBER, list=LIST)]


def _tag_value(value: object) -> str | None:
    """Return the tag of a value that may be rows of numbers: they are rows where any entry of the list is a list."""
    if isinstance(value, list | tuple):
        return "rows" if any(isinstance(row, list | tuple) for row in value) else "list"
    return "number" if isinstance(value, NUMBER) and not isinstance(value, bool) else None


NumbersInTime: TypeAlias = Annotated[
    Number | Numbers | Annotated[list[list[float]], Tag("rows")],
    Discriminator(
        _tag_value,
        custom_error_type="kind",
        custom_error_message="expected a number, a list of numbers, or rows of a time and the numbers from then on",
    ),
]
OneOrMoreFree: TypeAlias = Annotated[
    Number | FreeNumbers, one_of("a number or a list of numbers, null where free", number=NUMBER, list=LIST)
]


class Sparse(Options):
    """Options that are written back without the keys that were not given."""

    @model_serializer(mode="wrap")
    def _serialise(self, handler: SerializerFunctionWrapHandler) -> dict[str, Any]:
        return {key: value for key, value in handler(self).items() if value is not None}


def count(dimension: int) -> str:
    """Return a number of numbers in words."""
    return f"{dimension} numbers" if dimension > 1 else "1 number"


def free_bound(name: str, value: float | Sequence[float | None] | None, dimension: int, free: float) -> Array:
    """Return a bound ``(dimension,)``, with ``free`` where it is null or not given."""
    return broadcast(name, free if value is None else value, dimension, free)


def broadcast(name: str, value: float | Sequence[float | None], dimension: int, free: float = np.nan) -> Array:
    """Return a vector from a number or a list.

    Parameters
    ----------
    name : str
        The key of the value, for errors.
    value : float or sequence
        A number for all coordinates, or a list with null where a coordinate is free.
    dimension : int
        The number of coordinates.
    free : float, default nan
        The number in place of null.

    Returns
    -------
    array (dimension,)
        The vector.

    Raises
    ------
    InputError
        If the list has another length.
    """
    if not isinstance(value, Sequence):
        return np.full(dimension, float(value))
    if len(value) not in (1, dimension):
        raise InputError(path=name, expected=f"{count(dimension)}", got=f"{len(value)}")
    return np.full(dimension, [free if item is None else float(item) for item in value])
