"""A run before one's eyes: with the viewer of Rerun, in a browser, or into a file for later."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

from sparserob_core.experiment.run.outcome import Outcome
from sparserob_core.experiment.run.run import run
from sparserob_core.experiment.run.viewer import recorded, recorder


def watch(
    config: str | Path | Mapping[str, Any],
    overrides: Mapping[str, object] | Iterable[str] | None = None,
    out: str | Path | None = None,
    *,
    save: str | Path | None = None,
    serve: bool = False,
    connect: str | None = None,
    quiet: bool = False,
    figures: bool = True,
) -> Outcome:
    """Run an experiment as `sparserob_core.run` does, and record it: what ``sparserob watch CONFIG key=value ...``
    does.

    A viewer is started, unless it is to be recorded into the file ``save``, shown in a browser of this machine
    (``serve``), or sent to a viewer that listens at ``connect``. Raises `InputError` before anything is solved where
    that cannot be had. The outcome's ``remarks`` say whether all of it was recorded.
    """
    watching = recorder(save, serve, connect)
    outcome = run(config, overrides, out, quiet=quiet, figures=figures, observers=[watching])
    return replace(outcome, remarks=(*outcome.remarks, *recorded(watching, save)))
