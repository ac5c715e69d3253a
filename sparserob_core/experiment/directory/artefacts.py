"""The only writer of a run directory: a file is complete under its final name, or does not exist."""

from __future__ import annotations

import json
import math
import os
import platform
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import fields, is_dataclass
from datetime import UTC, datetime
from io import BytesIO
from pathlib import Path
from typing import Any, Self, final

import numpy as np

from sparserob_core.errors import InputError, SparseRobError
from sparserob_core.experiment.directory.lock import NAME as LOCK
from sparserob_core.experiment.directory.lock import Lock
from sparserob_core.sip.events import RoundFinished


def write_whole(file: Path, content: bytes) -> None:
    """Write a file under a temporary name, and then give it its own.

    Raises `SparseRobError` where the disk refuses; the error says whether the file has its former content or does not
    exist.
    """
    temporary = file.with_name(f".{file.name}.{os.getpid()}.tmp")
    try:
        file.parent.mkdir(parents=True, exist_ok=True)
        temporary.write_bytes(content)
        temporary.replace(file)
    except OSError as error:
        with suppress(OSError):
            temporary.unlink()
        note = "the one that is there is what was written before" if _is_present(file) else "nothing of it was kept"
        raise SparseRobError(f"{file}: cannot be written: {error.strerror}; {note}") from error


def _is_present(file: Path) -> bool:
    try:
        return file.exists()
    except OSError:  # the disk refuses everything
        return False


def require_room(directory: Path) -> None:
    """Raise `InputError` unless files can be written into a run directory; this is asked before their content is
    computed."""
    if not os.access(directory, os.W_OK | os.X_OK):
        raise InputError(f"{directory}: cannot be written to; expected a directory that takes the result, or a copy")


@final
class RunDirectory:
    """The writer of the files of a directory; each file is written completely or not at all.

    As a context manager it releases the lock of the directory, which `create_directory` takes.
    """

    def __init__(self, path: Path, lock: Lock | None = None) -> None:
        self.path, self._lock = path, lock

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        if self._lock is not None:
            self._lock.release()

    def write_text(self, name: str, text: str) -> None:
        """Write a text file in UTF-8."""
        write_whole(self.path / name, text.encode())

    def write_json(self, name: str, data: Mapping[str, Any]) -> None:
        """Write strict JSON: numbers that are not finite become null."""
        self.write_text(name, json.dumps(finite(data), indent=2, allow_nan=False) + "\n")

    def write_arrays(self, name: str, arrays: Mapping[str, object]) -> None:
        """Write a compressed ``.npz`` file."""
        stream = BytesIO()
        np.savez_compressed(stream, **{key: np.asarray(value) for key, value in arrays.items()})  # type: ignore[arg-type]
        write_whole(self.path / name, stream.getvalue())


def create_directory(out: str | Path | None, name: str, digest: str, again: str = "") -> RunDirectory:
    """Make the directory of a run and lock it.

    Parameters
    ----------
    out : str, Path or None
        The directory, new or empty. Unless given it is ``runs/<name>/<UTC stamp>-<digest>``.
    name, digest : str
        The parts of the default name.
    again : str, default ""
        The name of a file. A directory that holds it need not be empty.

    Returns
    -------
    RunDirectory
        The writer of the directory, which is locked until the context ends.

    Raises
    ------
    InputError
        If the directory is not empty, if another run writes into it, or if it cannot be written to.
    """
    path = Path(out) if out is not None else _make_stamped_path(name, digest)
    lock = Lock(path)
    with _convert_errors(path):
        path.mkdir(parents=True, exist_ok=True)
        _require_empty(path, unless=(lock.file.name, again))
        lock.acquire()
        try:
            _require_empty(path, unless=(again,))
        except InputError:
            lock.release()
            raise
    return RunDirectory(path, lock)


def share_directory(out: str | Path, first: str, text: str) -> RunDirectory:
    """Make or join a directory that several processes fill at once, each with files of its own.

    The first process writes the ``text`` into the file ``first`` completely; a file of another process is left as it
    is. The directory is not locked.

    Parameters
    ----------
    out : str or Path
        The directory, which is new or empty, or holds the file ``first``.
    first, text : str
        The name of the first file, and its content.

    Returns
    -------
    RunDirectory
        The writer of the directory.

    Raises
    ------
    InputError
        If the directory holds other files only, or cannot be written to.
    """
    path = Path(out)
    with _convert_errors(path):
        path.mkdir(parents=True, exist_ok=True)
        _require_empty(path, unless=(first,))
        temporary = path / f".{first}.{platform.node()}.{os.getpid()}.tmp"
        try:
            temporary.write_text(text, encoding="utf-8", newline="")
            with suppress(FileExistsError):
                (path / first).hardlink_to(temporary)  # complete, and it never replaces a file, as a rename would
        finally:
            temporary.unlink(missing_ok=True)
    return RunDirectory(path)


@contextmanager
def _convert_errors(path: Path) -> Iterator[None]:
    """Raise errors of the system about a directory as `InputError`."""
    try:
        yield
    except (FileExistsError, NotADirectoryError) as error:
        raise InputError(f"{path}: expected a directory, got a file") from error
    except OSError as error:
        raise InputError(f"{path}: cannot be written to: {error.strerror}") from error


def _require_empty(path: Path, unless: Sequence[str] = ()) -> None:
    """Raise `InputError` where a directory holds files, unless a file among ``unless`` is one of them.

    A lock does not count, as its owner is named elsewhere. A directory that is continued may hold anything. Temporary
    files of the names ``unless`` do not count either.
    """
    passing = (LOCK, *(f".{name}." for name in unless if name))
    # the files are listed first: a process that fills the directory at the same moment begins with a file of `unless`
    has_others = any(not file.name.startswith(passing) for file in path.iterdir())
    if has_others and not any(name and (path / name).exists() for name in unless):
        raise InputError(f"{path}: expected a new or an empty directory, got one that holds files")


def _make_stamped_path(name: str, digest: str) -> Path:
    parent = Path("runs") / name
    stem = f"{datetime.now(UTC):%Y%m%dT%H%M%SZ}-{digest}"
    candidates = (parent / (stem if count == 1 else f"{stem}-{count}") for count in range(1, 10_000))
    return next(path for path in candidates if not path.exists())


def trace_columns(history: Sequence[RoundFinished]) -> dict[str, Any]:
    """Return one array per field of `RoundFinished` that is a number or a text, with one entry per round."""
    plain = [name for name, kind in RoundFinished.__annotations__.items() if kind in ("int", "float", "str", "bool")]
    return {name: np.array([getattr(entry, name) for entry in history]) for name in plain}


UNWRITTEN: Mapping[str, object] = {"written": False}
"""The metadata of a field of a record that no JSON file has."""


def finite(data: Any) -> Any:
    """Return data in a form that JSON can hold: null for numbers that are not finite, and lists for arrays.

    A record has every field but those that are `UNWRITTEN`.
    """
    if isinstance(data, Mapping):
        return {str(key): finite(value) for key, value in data.items()}
    if is_dataclass(data):
        return {entry.name: finite(getattr(data, entry.name)) for entry in fields(data) if entry.metadata != UNWRITTEN}
    if isinstance(data, np.ndarray | np.generic):
        return finite(data.tolist())
    if isinstance(data, list | tuple):
        return [finite(value) for value in data]
    return None if isinstance(data, float) and not math.isfinite(data) else data
