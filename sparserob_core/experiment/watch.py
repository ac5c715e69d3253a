"""A run before one's eyes: with the viewer of Rerun, in a browser, or into a file for later."""

from __future__ import annotations

import os
import sys
from collections.abc import Iterable, Mapping
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Any

from sparserob_core.errors import InputError
from sparserob_core.experiment.registry import load_registry

if TYPE_CHECKING:
    from sparserob_core.experiment.events import Observer
    from sparserob_core.experiment.run import Outcome

KEEP = 24 * 3600.0
"""Seconds that a browser is served, unless somebody ends it."""


def watch(config: str | Path | Mapping[str, Any], overrides: Mapping[str, object] | Iterable[str] | None = None, out: str | Path | None = None, *,
          save: str | Path | None = None, serve: bool = False, connect: str | None = None, quiet: bool = False, figures: bool = True) -> Outcome:
    """Run an experiment as `sparserob_core.run` does, and record it: what ``sparserob watch CONFIG key=value ...`` does.

    A viewer is started, unless it is to be recorded into the file ``save``, shown in a browser of this machine (``serve``), or sent to a viewer
    that listens at ``connect``. Raises `InputError` before anything is solved where that cannot be had.
    """
    from sparserob_core.experiment.run import run

    return run(config, overrides, out, quiet=quiet, figures=figures, observers=[recorder(save, serve, connect)])


def recorder(save: str | Path | None, serve: bool, connect: str | None, patience: float | None = None) -> Observer:
    """The observer that records to a viewer, to a browser, to a listener or into a file; raises `InputError` where that cannot be had."""
    if find_spec("rerun_bindings") is None:
        raise InputError("rerun: rerun-sdk is not installed; `pip install 'sparserob[rerun]'` brings it")
    spawn = save is None and not serve and connect is None
    if spawn and sys.platform.startswith("linux") and not (os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")):
        raise InputError("there is no display for a viewer; --save FILE records for later, --serve shows it in a browser")
    options: dict[str, object] = {"spawn": spawn, "serve": serve, "connect": connect, "keep": KEEP if serve else 0.0}
    if save is not None:
        options["save"] = str(_writable(Path(save)))
    if patience is not None:
        options["landscape"] = {"patience": patience}
    observer: Observer = load_registry().build("observer", "rerun", options)
    return observer


def _writable(file: Path) -> Path:
    """The absolute path of a file that can be written."""
    path = file.absolute()
    if path.is_dir():
        raise InputError(f"save: expected a file, got the directory {file}")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with path.open("ab"):
            return path
    except OSError as error:
        raise InputError(f"save: {file} cannot be written to: {error.strerror}") from error
