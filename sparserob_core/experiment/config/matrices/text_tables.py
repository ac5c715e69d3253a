"""Matrices in files of text, one row a line: numbers between commas, semicolons or blanks."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from sparserob_core.errors import InputError
from sparserob_core.experiment.config.matrices.packed import Packed, checked, shape_of
from sparserob_core.experiment.plugins.messages import shown

# Bytes of a file: a run directory holds four million characters, and ten times more take a minute
MAX_TABLE_BYTES = 2**24
COMMENT = "#"


def read_table(file: Path) -> Packed:
    """Return the numbers of a file ``.csv``, row by row; what stands behind ``#``, and empty lines, are left out.

    Raises `InputError` for a file that cannot be read, an entry that is no finite number, or rows of different lengths;
    the error names the line.
    """
    try:
        if file.stat().st_size > MAX_TABLE_BYTES:
            raise InputError(path=file.name, expected=f"at most {MAX_TABLE_BYTES} bytes", got=f"{file.stat().st_size}")
        text = file.read_text(encoding="utf-8-sig")
    except UnicodeDecodeError:
        raise InputError(path=file.name, expected="text in UTF-8", got="something else") from None
    except OSError as error:
        raise InputError(f"{file}: cannot be read: {error.strerror}") from None
    rows: list[list[float]] = []
    for number, line in enumerate(text.splitlines(), 1):
        content = line.partition(COMMENT)[0].strip()
        if not content:
            continue
        rows.append([_read_number(file.name, number, entry) for entry in _split_line(content)])
        if len(rows[-1]) != len(rows[0]):
            raise InputError(
                path=file.name,
                expected=f"{len(rows[0])} numbers in line {number}, as in the first",
                got=f"{len(rows[-1])}",
            )
    if not rows:
        raise InputError(path=file.name, expected="at least one row of numbers", got="none")
    shape_of((len(rows), len(rows[0])), file.name)
    return checked(np.array(rows), file.name)


def _split_line(content: str) -> list[str]:
    separator = next((mark for mark in (";", ",") if mark in content), None)
    return [entry.strip() for entry in content.split(separator)]


def _read_number(name: str, number: int, entry: str) -> float:
    try:
        return float(entry.replace("_", "?"))  # Python reads 1_000 as a number, tables do not mean it so
    except ValueError:
        hint = f" (a heading begins with {COMMENT})" if number == 1 and entry[:1].isalpha() else ""
        raise InputError(path=name, expected=f"numbers in line {number}{hint}", got=shown(entry)) from None
