"""The directory of an experiment that is solved or studied: its config comes first, its result last."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from sparserob_core.experiment.assemble import name_of
from sparserob_core.experiment.config.load import Loaded
from sparserob_core.experiment.config.reading.reader import write_yaml
from sparserob_core.experiment.directory.artefacts import RunDirectory, create_directory


@contextmanager
def open_directory(loaded: Loaded, out: str | Path | None, heading: str, kind: str = "") -> Iterator[RunDirectory]:
    """Make the directory of an experiment, with its complete config; it is locked until the context ends.

    Parameters
    ----------
    loaded : Loaded
        The checked config.
    out : str, Path or None
        The directory, new or empty. Unless given it is ``runs/<name><kind>/<UTC stamp>-<digest>``.
    heading : str
        The first line of ``config.yaml``.
    kind : str, default ""
        The kind of the study, such as ``-margin``.

    Yields
    ------
    RunDirectory
        The writer of the directory.
    """
    with create_directory(out, f"{name_of(loaded)}{kind}", loaded.config.digest()) as directory:
        directory.write_text("config.yaml", write_yaml(loaded.config.plain(), heading))
        yield directory
