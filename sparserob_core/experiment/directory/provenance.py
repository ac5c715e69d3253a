"""The provenance of a run: what a reader needs, years later, to know what was run, where and when."""

from __future__ import annotations

import os
import platform
import subprocess
from collections.abc import Mapping
from datetime import UTC, datetime
from hashlib import sha256
from pathlib import Path
from typing import Any

from sparserob_core.encodings import path_of
from sparserob_core.experiment.config.plain import identity

GIT_SECONDS = 5.0  # seconds for git


def provenance(plain: Mapping[str, Any], git: Mapping[str, Any] | None) -> dict[str, Any]:
    """Return the entry ``provenance`` of ``result.json``.

    Parameters
    ----------
    plain : mapping
        The resolved config.
    git : mapping or None
        The revision of the config's folder (`git_revision`).

    Returns
    -------
    dict
        The ``hash`` of the config (`identity`), the time when the run ``started`` (UTC), the ``git`` revision, the
        ``host``, and the SHA-256 of every plugin file.
    """
    return {
        "hash": identity(plain),
        "started": f"{datetime.now(UTC):%Y-%m-%dT%H:%M:%SZ}",
        "git": git,
        "host": {
            "system": platform.system(),
            "machine": platform.machine(),
            "cores": cores(),
            "python": f"{platform.python_implementation()} {platform.python_version()}",
        },
        "plugins": {str(file): _compute_digest(path_of(file)) for file in plain.get("plugins") or ()},
    }


def cores() -> int:
    """Return the number of processors that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def git_revision(folder: Path) -> dict[str, Any] | None:
    """Return the revision of a folder's git repository, and whether tracked files were ``changed`` since.

    Returns ``None`` where there is no repository, or no git.
    """
    command = ["git", "-c", "core.fsmonitor=false", "describe", "--always", "--dirty", "--abbrev=40", "--exclude=*"]
    try:
        process = subprocess.run(
            command,
            cwd=folder,
            capture_output=True,
            text=True,
            timeout=GIT_SECONDS,
            check=False,
            stdin=subprocess.DEVNULL,
        )
    except (OSError, subprocess.SubprocessError):
        return None
    description = process.stdout.strip()
    if process.returncode or not description:
        return None
    return {"revision": description.removesuffix("-dirty"), "changed": description.endswith("-dirty")}


def _compute_digest(file: Path) -> str | None:
    try:
        return sha256(file.read_bytes()).hexdigest()
    except OSError:
        return None
