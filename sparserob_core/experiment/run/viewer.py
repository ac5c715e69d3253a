"""The recorder of a run: it shows the run in a viewer or in a browser, or writes it into a file for later."""

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
"""Seconds for which a browser is served, unless the user ends it."""


def recorder(save: str | Path | None, serve: bool, connect: str | None, patience: float | None = None) -> Observer:
    """Return the observer that records a run for the viewer of Rerun.

    Parameters
    ----------
    save : str, Path or None
        A file in which the run is recorded.
    serve : bool
        Whether the run is shown in a browser.
    connect : str or None
        The address of a viewer that is open. A new viewer is opened where neither this nor the two above are given.
    patience : float, optional
        For a run that is over, the seconds that its landscapes may take.

    Returns
    -------
    Observer
        The observer.

    Raises
    ------
    InputError
        If Rerun is not installed, if there is no display for a viewer, or if the file cannot be written.
    """
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
        options["save"] = str(_require_writable(Path(save)))
    if patience is not None:
        options.update(landscape={"patience": patience}, waits=True)
    observer: Observer = load_own_registry().build("observer", "rerun", options)
    return observer


def recorded(observer: Observer, save: str | Path | None) -> tuple[str, ...]:
    """Return the sentence that says whether the file ``save`` holds the complete run; nothing where no file was asked
    for."""
    if save is None:
        return ()
    reason = observer.incomplete.partition(" is not a complete recording: ")[2] or observer.incomplete
    return (f"{save} is not complete: {reason}" if reason else f"recorded into {save}",)


def _require_writable(file: Path) -> Path:
    """Return the absolute path of a file that can be written, in a folder that exists.

    A recording that exists is never overwritten: raises `InputError`.
    """
    path = file.absolute()
    if path.is_dir():
        raise InputError(f"save: expected a file, got the directory {file}")
    if path.is_file() and path.stat().st_size:
        raise InputError(path="save", expected="a new file, or an empty one", got=f"{file}, which holds something")
    existed = path.exists()
    try:
        with path.open("ab"):
            pass
        if not existed:  # a command that fails at its config must leave no file behind
            path.unlink()
    except OSError as error:
        raise InputError(f"save: {file} cannot be written to: {error.strerror}") from error
    return path
