"""The archived run directories, and what the checker of the version that made them said of each."""

from __future__ import annotations

import json
import tarfile
from functools import cache
from pathlib import Path
from typing import Any

HERE = Path(__file__).parent
VERDICTS: dict[str, dict[str, Any]] = json.loads((HERE / "verdicts.json").read_text("utf-8"))
"""By the name of a run: the ``status`` of its check, the verdict of each claim (``claims``, in order), the sentences of
those that do not hold (``doubts``), the ``seconds`` of the processor and the ``peak`` of the memory in MB."""


@cache
def _files() -> dict[str, dict[str, bytes]]:
    """The content of every file, by run and name; 2 MB."""
    found: dict[str, dict[str, bytes]] = {}
    with tarfile.open(HERE / "runs.tar.xz") as archive:
        for entry in archive:
            content = archive.extractfile(entry)
            assert content is not None
            run, name = entry.name.split("/")
            found.setdefault(run, {})[name] = content.read()
    return found


def archived() -> list[str]:
    """The names of the runs in the archive."""
    return sorted(_files())


def unpack(name: str, place: Path) -> Path:
    """Write one run directory into a folder, and return it."""
    directory = place / name
    directory.mkdir(parents=True)
    for file, content in _files()[name].items():
        (directory / file).write_bytes(content)
    return directory
