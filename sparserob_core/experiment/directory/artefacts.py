"""The directory that a run leaves: complete files under their final names, or none."""

from __future__ import annotations

import json
import math
import os
from collections.abc import Mapping, Sequence
from contextlib import suppress
from datetime import UTC, datetime
from io import BytesIO
from pathlib import Path
from typing import Any, final

import numpy as np

from sparserob_core.errors import InputError, SparseRobError
from sparserob_core.sip.events import RoundFinished


@final
class RunDirectory:
    """Writes files whole: each under a temporary name first, then renamed. Raises `SparseRobError` when the disk
    refuses."""

    def __init__(self, path: Path) -> None:
        self.path = path

    def write_text(self, name: str, text: str) -> None:
        """Write a text file in UTF-8."""
        self._write(name, text.encode())

    def write_json(self, name: str, data: Mapping[str, Any]) -> None:
        """Write strict JSON: numbers that are not finite become null."""
        self.write_text(name, json.dumps(finite(data), indent=2, allow_nan=False) + "\n")

    def write_arrays(self, name: str, arrays: Mapping[str, object]) -> None:
        """Write a compressed ``.npz`` file."""
        stream = BytesIO()
        np.savez_compressed(stream, **{key: np.asarray(value) for key, value in arrays.items()})  # type: ignore[arg-type]
        self._write(name, stream.getvalue())

    def _write(self, name: str, content: bytes) -> None:
        temporary = self.path / f".{name}.{os.getpid()}.tmp"
        try:
            temporary.write_bytes(content)
            temporary.replace(self.path / name)
        except OSError as error:
            with suppress(OSError):
                temporary.unlink()
            raise SparseRobError(
                f"{self.path / name}: cannot be written: {error.strerror}; nothing of it was kept"
            ) from error


def create_directory(out: str | Path | None, name: str, digest: str) -> RunDirectory:
    """Make the directory of a run: ``out``, which must be new or empty, else ``runs/<name>/<UTC stamp>-<digest>``.

    Raises `InputError` when it is neither, or cannot be written to.
    """
    path = Path(out) if out is not None else _stamped(name, digest)
    try:
        path.mkdir(parents=True, exist_ok=True)
        if any(path.iterdir()):
            raise InputError(f"{path}: expected a new or an empty directory, got one that holds files")
        probe = path / f".probe.{os.getpid()}.tmp"
        probe.touch()
        probe.unlink()
    except (FileExistsError, NotADirectoryError) as error:
        raise InputError(f"{path}: expected a directory, got a file") from error
    except OSError as error:
        raise InputError(f"{path}: cannot be written to: {error.strerror}") from error
    return RunDirectory(path)


def _stamped(name: str, digest: str) -> Path:
    parent = Path("runs") / name
    stem = f"{datetime.now(UTC):%Y%m%dT%H%M%SZ}-{digest}"
    candidates = (parent / (stem if count == 1 else f"{stem}-{count}") for count in range(1, 10_000))
    return next(path for path in candidates if not path.exists())


def trace_columns(history: Sequence[RoundFinished]) -> dict[str, Any]:
    """One array per field of `RoundFinished` that is a number or a text, one entry per round."""
    plain = [name for name, kind in RoundFinished.__annotations__.items() if kind in ("int", "float", "str", "bool")]
    return {name: np.array([getattr(entry, name) for entry in history]) for name in plain}


def finite(data: Any) -> Any:
    """The same data with null for every number that is not finite, and lists for arrays: what JSON can say."""
    if isinstance(data, Mapping):
        return {str(key): finite(value) for key, value in data.items()}
    if isinstance(data, np.ndarray | np.generic):
        return finite(data.tolist())
    if isinstance(data, list | tuple):
        return [finite(value) for value in data]
    return None if isinstance(data, float) and not math.isfinite(data) else data
