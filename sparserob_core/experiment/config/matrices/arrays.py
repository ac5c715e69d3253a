"""The only reader of ``.npz`` files: plain numbers and text, never code."""

from __future__ import annotations

from pathlib import Path
from zipfile import BadZipFile, ZipFile
from zlib import error as ZlibError

import numpy as np

from sparserob_core.errors import InputError
from sparserob_core.sip.convex_set import Array

MAX_ARRAY_BYTES = 2**31
"""Largest number of bytes of the arrays in one file. No run writes as many, and a small file can claim any number."""


def read_arrays(file: Path, largest: int | None = None) -> dict[str, Array]:
    """Return the arrays of an ``.npz`` file by name; none where there is no such file.

    Raises `InputError` where the file cannot be read, or its arrays take more than ``largest`` bytes (`MAX_ARRAY_BYTES`
    unless given).
    """
    if not file.is_file():
        return {}
    try:
        with ZipFile(file) as archive:
            size = sum(entry.file_size for entry in archive.infolist())
        limit = MAX_ARRAY_BYTES if largest is None else largest
        if size > limit:
            raise InputError(f"{file}: cannot be read: expected arrays of at most {limit} bytes in all, got {size}")
        with np.load(file, allow_pickle=False) as stored:
            arrays = {name: stored[name] for name in stored.files}
    except InputError:
        raise
    except (BadZipFile, EOFError):
        raise InputError(
            f"{file}: cannot be read: expected arrays in the format .npz, got something else, or a part of it"
        ) from None
    except OSError as error:
        raise InputError(f"{file}: cannot be read: {error.strerror or 'it is damaged'}") from None
    except (ValueError, KeyError, AttributeError, TypeError, NotImplementedError, MemoryError, ZlibError, RuntimeError):
        raise InputError(
            f"{file}: cannot be read: expected arrays of numbers and text in the format .npz, got others"
        ) from None
    if any(not isinstance(array, np.ndarray) for array in arrays.values()):
        raise InputError(
            f"{file}: cannot be read: expected arrays of numbers and text in the format .npz, got other entries"
        )
    return arrays
