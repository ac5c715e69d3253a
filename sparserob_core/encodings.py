"""Texts and paths in a locale that is narrower than UTF-8, the encoding of configs and nearly always of names of files:
``LC_ALL=C`` leaves lone surrogates (PEP 383) of the bytes that it has no letters for."""

from __future__ import annotations

import os
from pathlib import Path


def as_utf8(text: str, undecodable: str = "backslashreplace") -> str:
    """The text with its lone surrogates read as the bytes of UTF-8 that they stand for. Bytes that are no UTF-8 are
    written out, as in ``\\xe4``, or as ``undecodable`` says, an error handler of `bytes.decode`."""
    if not any("\ud800" <= character <= "\udfff" for character in text):
        return text
    try:
        return text.encode("utf-8", "surrogateescape").decode("utf-8", undecodable)
    except UnicodeError:  # it stands for no bytes, or for no text
        return text


def path_of(name: str | Path) -> Path:
    """The path of a file that a config names: by the bytes of UTF-8 where the locale has no letters for it."""
    try:
        os.fsencode(name)
    except UnicodeEncodeError:
        return Path(os.fsdecode(str(name).encode("utf-8", "surrogateescape")))
    return Path(name)


def name_of(path: Path) -> str:
    """The name of the path that a config can hold, and `path_of` leads back from."""
    return as_utf8(str(path), "surrogateescape")
