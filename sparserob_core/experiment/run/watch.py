"""A run that is shown while it goes on: in the viewer of Rerun, in a browser, or in a file for later."""

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
    """Run an experiment and record it, as ``sparserob watch CONFIG key=value ...`` does.

    A viewer is opened unless one of ``save``, ``serve`` and ``connect`` is given.

    Parameters
    ----------
    config, overrides, out, quiet, figures
        As for `run`.
    save : str or Path, optional
        A file in which the run is recorded, to be shown later.
    serve : bool, default False
        Whether the run is shown in a browser of this machine.
    connect : str, optional
        The address of a viewer that is open.

    Returns
    -------
    Outcome
        The finished run; its ``remarks`` say whether the recording is complete.

    Raises
    ------
    InputError
        If the viewer, the browser or the file cannot be had; it is raised before anything is solved.
    """
    watching = recorder(save, serve, connect)
    outcome = run(config, overrides, out, quiet=quiet, figures=figures, observers=[watching])
    return replace(outcome, remarks=(*outcome.remarks, *recorded(watching, save)))
