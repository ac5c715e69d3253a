"""The recorder that a run is shown with: in a viewer, in a browser, or into a file for later."""

from __future__ import annotations

import os
import sys
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING

from sparserob_core.errors import InputError, not_installed
from sparserob_core.experiment.plugins.registry import load_own_registry

if TYPE_CHECKING:
    from sparserob_core.experiment.run.events import Observer

KEEP = 24 * 3600.0
"""Seconds that a browser is served, unless somebody ends it."""


def recorder(save: str | Path | None, serve: bool, connect: str | None, patience: float | None = None) -> Observer:
    """The observer that records to a viewer, to a browser, to a listener or into a file. ``patience``: of a run that is
    over, the seconds that its landscapes may take. Raises `InputError` where that cannot be had."""
    if find_spec("rerun_bindings") is None:
        raise InputError(f"rerun: {not_installed('rerun-sdk')}")
    spawn = save is None and not serve and connect is None
    if (
        spawn
        and sys.platform.startswith("linux")
        and not (os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY"))
    ):
        raise InputError(
            "there is no display for a viewer; --save FILE records for later, --serve shows it in a browser"
        )
    options: dict[str, object] = {"spawn": spawn, "serve": serve, "connect": connect, "keep": KEEP if serve else 0.0}
    if save is not None:
        options["save"] = str(_writable(Path(save)))
    if patience is not None:
        options.update(landscape={"patience": patience}, waits=True)
    observer: Observer = load_own_registry().build("observer", "rerun", options)
    return observer


def recorded(observer: Observer, save: str | Path | None) -> tuple[str, ...]:
    """What the file holds that was to be recorded into, in words; nothing where there was to be none."""
    if save is None:
        return ()
    why = observer.incomplete.partition(" is not a complete recording: ")[2] or observer.incomplete
    return (f"{save} is not complete: {why}" if why else f"recorded into {save}",)


def _writable(file: Path) -> Path:
    """The absolute path of a file that can be written, in a folder that is there; no recording is written over."""
    path = file.absolute()
    if path.is_dir():
        raise InputError(f"save: expected a file, got the directory {file}")
    if path.is_file() and path.stat().st_size:
        raise InputError(path="save", expected="a new file, or an empty one", got=f"{file}, which holds something")
    there = path.exists()
    try:
        with path.open("ab"):
            pass
        if not there:  # a command that ends with an error of its config leaves nothing behind
            path.unlink()
    except OSError as error:
        raise InputError(f"save: {file} cannot be written to: {error.strerror}") from error
    return path
