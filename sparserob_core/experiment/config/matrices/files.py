"""Matrices from files, ``{file: plant.npz, name: A}`` or ``{file: prices.csv}``: data only, whose numbers replace the
entry of the config."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from pathlib import Path as File
from typing import Any

import numpy as np
import numpy.typing as npt

from sparserob_core.encodings import path_of
from sparserob_core.errors import InputError, Path
from sparserob_core.experiment.config.matrices.arrays import read_arrays
from sparserob_core.experiment.config.matrices.packed import Packed, checked, pack, shape_of, spread
from sparserob_core.experiment.config.matrices.text_tables import read_table
from sparserob_core.experiment.plugins.messages import Complaint, shown
from sparserob_core.sip.convex_set import Array

KEYS = {"file", "name"}
PARTS = ("data", "indices", "indptr", "shape")
MAX_MATRIX_FILE_BYTES = 2**28  # bytes of the arrays of a file; a tenth of it would refuse dense matrices of 2000 states
# Characters of all matrices of a config, which is read back as one text of at most four million. Ten times more takes
# a minute to read; a tenth would refuse dense matrices of 200 states.
MAX_PACKED_LETTERS = 3_500_000
SUFFIX, TABLE = ".npz", ".csv"


def resolve(data: dict[str, Any], folder: Callable[[Path], File]) -> Iterator[Complaint]:
    """Replace every ``{file: ..., name: ...}`` and ``{file: ...}`` of the problem by its numbers; yields the faults.

    ``folder`` maps the path of a key to the folder that its file is relative to.
    """
    cache: dict[File, dict[str, Array]] = {}
    size = 0
    for path, holder, key in list(_find_references(data.get("problem"), ("problem",))):
        reference = holder[key]
        try:
            holder[key] = pack(_read_matrix(reference, folder(path), cache).array)
            size += sum(len(text) for text in holder[key].values() if isinstance(text, str))
            if size > MAX_PACKED_LETTERS:
                expected = (
                    f"matrices of at most {MAX_PACKED_LETTERS} characters together, as a run directory holds them"
                )
                raise InputError(expected=expected, got="more")
        except InputError as error:
            yield Complaint(path, str(error))


def _find_references(data: Any, path: Path) -> Iterator[tuple[Path, Any, Any]]:
    """Yield the places of matrices from files: the path, the list or mapping that holds the entry, and its key
    there."""
    entries = data.items() if isinstance(data, dict) else enumerate(data) if isinstance(data, list) else ()
    for key, value in entries:
        if isinstance(value, Mapping) and (set(value) == KEYS or _is_file_alone(value)):
            yield (*path, key), data, key
        else:
            yield from _find_references(value, (*path, key))


def _is_file_alone(value: Mapping[str, object]) -> bool:
    return set(value) == {"file"} and isinstance(value["file"], str)


def _read_matrix(given: Mapping[str, object], folder: File, known: dict[File, dict[str, Array]]) -> Packed:
    name, file_name = given.get("name"), given["file"]
    if not isinstance(file_name, str) or not file_name.endswith((SUFFIX, TABLE)):
        raise InputError(path="file", expected=f"a file whose name ends with {SUFFIX} or {TABLE}", got=shown(file_name))
    file, is_table = folder / path_of(file_name), file_name.endswith(TABLE)
    if is_table and "name" in given:
        raise InputError(path="name", expected=f"no name, since a file {TABLE} holds one matrix", got=shown(name))
    if not is_table and (not isinstance(name, str) or not name):
        raise InputError(path="name", expected="the name of a matrix in the file", got=shown(name))
    if file not in known and not file.is_file():
        raise InputError(path="file", expected=f"a file, relative to {folder}", got=f"{file_name}, which is none")
    if is_table:
        return read_table(file)
    if file not in known:
        known[file] = read_arrays(file, MAX_MATRIX_FILE_BYTES)
    try:
        return matrix_in(known[file], str(name))
    except InputError as error:
        error.path = (file_name, *error.path)
        raise


def matrix_in(arrays: Mapping[str, Array], name: str) -> Packed:
    """Return the matrix of a name among arrays: a dense array, or a sparse matrix in four arrays.

    An array of one axis is a column. Raises `InputError` that begins with the name of the array at fault.
    """
    if name in arrays:
        dense = _require_numbers(arrays, name, "fiu")
        if dense.ndim not in (1, 2) or not dense.size:
            raise InputError(path=name, expected="a matrix, rows by columns", got=f"an array of shape {dense.shape}")
        matrix = dense.reshape(-1, 1) if dense.ndim == 1 else dense
        shape_of(matrix.shape, name)
        return checked(matrix, name)
    missing = [suffix for suffix in PARTS if f"{name}_{suffix}" not in arrays]
    if missing:
        available = ", ".join(sorted(arrays)) or "nothing"
        expected = f"an array {name}, or a sparse matrix as {', '.join(f'{name}_{suffix}' for suffix in PARTS)}"
        raise InputError(path=name, expected=expected, got=available)
    shape = shape_of(_require_numbers(arrays, f"{name}_shape", "iu").tolist(), f"{name}_shape")
    values = _require_numbers(arrays, f"{name}_data", "fiu").astype(float)
    indices, pointers = (_require_numbers(arrays, f"{name}_{suffix}", "iu") for suffix in ("indices", "indptr"))
    return checked(spread(shape, values, indices, pointers, f"{name}_indptr"), f"{name}_data")


def _require_numbers(arrays: Mapping[str, Array], name: str, kinds: str) -> npt.NDArray[Any]:
    if arrays[name].dtype.kind not in kinds:
        expected = "real numbers" if "f" in kinds else "whole numbers"
        raise InputError(path=name, expected=expected, got=f"an array of {arrays[name].dtype}")
    return np.asarray(arrays[name])
