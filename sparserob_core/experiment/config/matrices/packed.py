"""A matrix as one text: ``{shape: [rows, columns], csr: ...}``, or ``dense`` instead of ``csr``.

A resolved config has it in place of the numbers of a file or of a sparse array. A run directory then needs no other
file, and the digest of its config is one of the numbers.

The text is base64 of little-endian numbers. ``csr`` has the row pointers and the column indices, four bytes each, then
the entries, eight bytes each. ``dense`` has the entries row by row. The shorter text of the two is written.
"""

from __future__ import annotations

import base64
import binascii
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Annotated, Any, TypeAlias, final

import numpy as np
import numpy.typing as npt
from pydantic import Field, GetCoreSchemaHandler, GetJsonSchemaHandler, SerializerFunctionWrapHandler
from pydantic_core import core_schema

from sparserob_core.errors import InputError
from sparserob_core.sip.convex_set import Array

# Entries of a matrix, with its zeros, as it becomes a dense one. Ten times more are 320 MB for every copy, and no plant
# of so many states is solved; a tenth would refuse plants of a thousand states.
MAX_PACKED_ENTRIES = 4_000_000
CSR, DENSE = "csr", "dense"
Whole: TypeAlias = npt.NDArray[np.integer[Any]]


@final
class Packed(list[list[float]]):
    """The rows of a matrix that is written back as one text."""

    @property
    def array(self) -> Array:
        """The matrix ``(rows, columns)``."""
        return np.array(self, dtype=float)

    @property
    def column(self) -> list[float]:
        """The numbers of a matrix with one column; raises `InputError` for another matrix."""
        if any(len(row) != 1 for row in self):
            raise InputError(expected="one column", got=f"{len(self[0])}")
        return [row[0] for row in self]


def pack(matrix: Array) -> dict[str, Any]:
    """Return a matrix as data of a config."""
    rows, columns = np.nonzero(matrix)
    pointers = np.searchsorted(rows, np.arange(len(matrix) + 1))
    sparse = [pointers.astype("<i4"), columns.astype("<i4"), matrix[rows, columns].astype("<f8")]
    encodings = {CSR: b"".join(array.tobytes() for array in sparse), DENSE: matrix.astype("<f8").tobytes()}
    kind = min(encodings, key=lambda name: len(encodings[name]))
    return {"shape": list(matrix.shape), kind: base64.b64encode(encodings[kind]).decode()}


def unpack(data: Mapping[str, Any]) -> Packed:
    """Return the matrix of data of a config; raises `InputError` that begins with the key at fault."""
    kinds = [kind for kind in (CSR, DENSE) if kind in data]
    if len(kinds) != 1 or set(data) != {"shape", *kinds}:
        raise InputError(
            expected="rows of numbers, {file: ..., name: ...}, or {shape: ..., csr: ...} as a run writes it",
            got=f"the keys {', '.join(map(str, data))}",
        )
    rows, columns = shape_of(data["shape"], "shape")
    kind, text = kinds[0], data[kinds[0]]
    try:
        raw = base64.b64decode(text, validate=True)
    except (binascii.Error, ValueError, TypeError):
        raise InputError(path=kind, expected="base64", got=f"{str(text)[:20]!r}") from None
    first = 4 * (rows + 1)
    wrong = len(raw) != 8 * rows * columns if kind == DENSE else len(raw) < first or (len(raw) - first) % 12
    if wrong:
        raise InputError(path=kind, expected=f"the bytes of {rows} x {columns} numbers", got=f"{len(raw)} bytes")
    if kind == DENSE:
        return checked(np.frombuffer(raw, "<f8").reshape(rows, columns), kind)
    count = (len(raw) - first) // 12
    pointers, indices = np.frombuffer(raw, "<i4", rows + 1), np.frombuffer(raw, "<i4", count, first)
    values = np.frombuffer(raw, "<f8", count, first + 4 * count)
    return checked(spread((rows, columns), values, indices, pointers, kind), kind)


def shape_of(given: object, where: str) -> tuple[int, int]:
    """Return the numbers of rows and columns; raises `InputError` unless they are positive and not too large."""
    sizes = list(given) if isinstance(given, Sequence | np.ndarray) and not isinstance(given, str) else []
    is_count = [isinstance(size, int | np.integer) and not isinstance(size, bool) and size > 0 for size in sizes]
    if len(sizes) != 2 or not all(is_count):
        raise InputError(path=where, expected="two whole numbers, rows and columns", got=f"{given!r}"[:60])
    rows, columns = map(int, sizes)
    if rows * columns > MAX_PACKED_ENTRIES:
        raise InputError(
            path=where, expected=f"at most {MAX_PACKED_ENTRIES} entries, zeros included", got=f"{rows} x {columns}"
        )
    return rows, columns


def spread(shape: tuple[int, int], values: Array, indices: Whole, pointers: Whole, where: str) -> Array:
    """Return a compressed sparse matrix as a dense one.

    Parameters
    ----------
    shape : tuple of int
        The numbers of rows and columns.
    values, indices : array
        The entries and their columns. Entries at the same place are added up.
    pointers : array (rows + 1,)
        The row pointers.
    where : str
        The key of the matrix, for errors.

    Returns
    -------
    array (rows, columns)
        The matrix.

    Raises
    ------
    InputError
        If pointers and indices do not fit.
    """
    rows, columns = shape
    fits = pointers.shape == (rows + 1,) and values.ndim == 1 and values.shape == indices.shape
    if not fits or pointers[0] != 0 or pointers[-1] != values.size or (np.diff(pointers) < 0).any():
        expected = f"{rows + 1} row pointers that do not decrease, from 0 to the number of entries"
        raise InputError(path=where, expected=expected, got=f"{pointers.size}, for {values.size} entries")
    if indices.size and not (indices.min() >= 0 and indices.max() < columns):
        raise InputError(
            path=where, expected=f"column indices from 0 to {columns - 1}", got=f"{indices.min()} to {indices.max()}"
        )
    matrix = np.zeros(shape)
    np.add.at(matrix, (np.repeat(np.arange(rows), np.diff(pointers)), indices), values)
    return matrix


def checked(matrix: Array, where: str) -> Packed:
    """Return the rows of a matrix of finite numbers; raises `InputError` for other numbers."""
    if not np.isfinite(matrix).all():
        position = tuple(int(i) + 1 for i in np.argwhere(~np.isfinite(matrix))[0])
        raise InputError(
            path=where, expected="finite numbers", got=f"{matrix[position[0] - 1, position[1] - 1]} at {position}"
        )
    return Packed(np.asarray(matrix, dtype=float).tolist())


@final
@dataclass(frozen=True)
class OrPacked:
    """The mark of rows of a config that may also be a matrix from a file, or one in one text.

    With ``column`` it marks a list of numbers, which may be a matrix of one column. With ``line`` it marks a list or
    rows, and a matrix of one row or column is a list.
    """

    column: bool = False
    line: bool = False

    def __get_pydantic_core_schema__(self, source: Any, handler: GetCoreSchemaHandler) -> core_schema.CoreSchema:
        return core_schema.no_info_wrap_validator_function(
            self._unpack_value,
            handler(source),
            serialization=core_schema.wrap_serializer_function_ser_schema(_pack_value, schema=core_schema.any_schema()),
        )

    def __get_pydantic_json_schema__(self, schema: core_schema.CoreSchema, handler: GetJsonSchemaHandler) -> Any:
        from_file = {
            "type": "object",
            "properties": {"file": {"type": "string"}, "name": {"type": "string"}},
            "required": ["file"],
            "additionalProperties": False,
        }
        return {"anyOf": [handler(schema), from_file]}

    def _unpack_value(self, value: object, handler: Any) -> object:
        if isinstance(value, Packed):
            return value
        if not isinstance(value, Mapping):
            return handler(value)
        matrix = unpack(value)
        if self.line and 1 in matrix.array.shape:
            return handler(matrix.array.ravel().tolist())
        return handler(matrix.column) if self.column else matrix


def _pack_value(value: object, handler: SerializerFunctionWrapHandler) -> object:
    return pack(value.array) if isinstance(value, Packed) else handler(value)


RowsOfNumbers: TypeAlias = Annotated[list[list[float]], Field(min_length=1), OrPacked()]
