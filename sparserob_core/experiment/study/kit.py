"""The parts that all studies share: the directory or the finished run that they write into, their files, their
figure."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, TypeVar

from sparserob_core.experiment.config.load import Loaded
from sparserob_core.experiment.directory.artefacts import RunDirectory, require_room
from sparserob_core.experiment.directory.finished import FinishedRun, read_finished
from sparserob_core.experiment.directory.study import open_directory
from sparserob_core.experiment.run.given import GivenRun, as_run

if TYPE_CHECKING:
    from matplotlib.figure import Figure

S = TypeVar("S", bound=Any)
"""The result of a study: a dataclass with ``summary()``, the contents of its JSON file."""


@contextmanager
def open_study(
    loaded: Loaded, out: str | Path | None, heading: str, kind: str, write: bool
) -> Iterator[RunDirectory | None]:
    """Make the directory of a study as `open_directory` does, or yield ``None`` where nothing is to be written.

    Without ``out`` a directory is made only where ``write`` is true.
    """
    if out is None and not write:
        yield None
        return
    with open_directory(loaded, out, heading, kind) as directory:
        yield directory


def write_study(
    directory: RunDirectory,
    name: str,
    study: S,
    draw: Callable[..., Figure | None] | None,
    *arguments: object,
    arrays: Mapping[str, object] = MappingProxyType({}),
    more: Mapping[str, object] = MappingProxyType({}),
) -> S:
    """Write the files of a study, and return its result with its directory.

    They are ``name.json`` with the entries ``more`` at its end, ``name.png`` drawn of the result and ``arguments``
    (``draw=None``: there is nothing to draw), and the ``arrays`` of each further file. The figure is an extra: where
    it cannot be drawn, the numbers are written all the same, and there is a warning among the ``remarks``.
    """
    from sparserob_core.experiment.figures.style import draw_extra

    for file, columns in arrays.items():
        directory.write_arrays(file, columns)  # type: ignore[arg-type]
    if draw is not None:
        remarks = draw_extra(directory.path / f"{name}.png", draw, study, *arguments)
        study = replace(study, remarks=(*study.remarks, *remarks))
    directory.write_json(f"{name}.json", {**study.summary(), **more})
    return replace(study, directory=directory.path)


def open_run(run: GivenRun, plugins: Iterable[str | Path], out: str | Path | None) -> FinishedRun:
    """Return a finished run that a study writes into; raises `InputError` where this, or the figure ``out``, is
    impossible."""
    from sparserob_core.experiment.figures.style import require_writable

    if out is not None:
        require_writable(Path(out))
    directory, experiment = as_run(run)
    finished = read_finished(directory, plugins, experiment)
    require_room(finished.directory)
    return finished


def write_into_run(
    finished: FinishedRun, name: str, study: S, out: str | Path | None, draw: Callable[..., Figure], drawn: object
) -> S:
    """Write ``name.json`` into the directory of a finished run, and the figure ``out``, which shows ``drawn``.

    Where matplotlib is missing, the result says so (``undrawn``).
    """
    from sparserob_core.experiment.figures.drawing import stored_figure_data
    from sparserob_core.experiment.figures.style import missing_matplotlib, save_figure

    RunDirectory(finished.directory).write_json(f"{name}.json", study.summary())
    if out is None:
        return study
    if missing := missing_matplotlib():
        return replace(study, undrawn=missing)
    save_figure(Path(out), draw, drawn, stored_figure_data(finished))
    return study
