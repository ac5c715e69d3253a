"""Style of the figures: one palette that every eye can tell apart, one typeface, one way to a file."""

from __future__ import annotations

import logging
import os
import re
import warnings
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager
from io import BytesIO
from pathlib import Path
from typing import TYPE_CHECKING, Any, ParamSpec

import numpy as np

from sparserob_core.errors import InputError, SparseRobError, not_installed
from sparserob_core.experiment.directory.artefacts import write_whole
from sparserob_core.sip.convex_set import Array

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

# Okabe and Ito (2008), "Color universal design".
BLUE, SKY, VERMILLION, ORANGE, GREEN, PURPLE = "#0072B2", "#56B4E9", "#D55E00", "#E69F00", "#009E73", "#CC79A7"
INK, GREY, MIST = "#222222", "#7A7A7A", "#E9E9E9"
EXCLUDED: dict[str, Any] = {"facecolor": MIST, "edgecolor": "#C4C4C4", "hatch": "////", "linewidth": 0, "zorder": 0}
"""How an area is drawn in which nothing may be, or nothing is."""

FIGURE_WIDTH = 6.2
"""Width of every figure in inches: a text column at full size."""

VIEW_BELOW_OPTIMUM = 1.5
"""The view of a bound reaches down by this many times the size of the optimum; first bounds of a search may be far
below."""

LETTERS, MARKER_LETTERS = 104, 8
"""Letters that have room beside each other in a legend, and as how many of them a mark with its spaces is as wide: with
more, or with narrower marks, the first and the last entry are cut off."""

KINDS: dict[str, dict[str, Any]] = {
    ".png": {"dpi": 200, "metadata": {"Software": None}},
    ".pdf": {"metadata": {"CreationDate": None, "Creator": None, "Producer": None}},
    ".svg": {"metadata": {"Date": None, "Creator": None}},
}
"""Kinds of files, by their endings, and what is left out of them so that the same figure gives the same bytes."""

P = ParamSpec("P")

logger = logging.getLogger("sparserob")
_reported_letters = set[str]()

_STYLE: dict[str, Any] = {
    "font.family": ["STIXGeneral", "DejaVu Sans"],
    "mathtext.fontset": "stix",
    "font.size": 10.5,
    "axes.titlesize": 11.5,
    "axes.titlelocation": "left",
    "axes.titlepad": 8,
    "axes.labelcolor": INK,
    "axes.edgecolor": GREY,
    "axes.linewidth": 0.7,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "xtick.color": GREY,
    "ytick.color": GREY,
    "xtick.labelcolor": INK,
    "ytick.labelcolor": INK,
    "xtick.major.width": 0.7,
    "ytick.major.width": 0.7,
    "text.color": INK,
    "legend.frameon": False,
    "legend.fontsize": 9.5,
    "lines.solid_capstyle": "butt",
    "hatch.linewidth": 0.4,
    "pdf.fonttype": 42,
}


def style() -> AbstractContextManager[None]:
    """The settings of every figure, for the time of a ``with`` block; the user's own settings stay as they are."""
    from matplotlib.style import context

    return context(_STYLE)


def panels(rows: int, height: float, *, extra: float = 0.0) -> tuple[Figure, list[Axes]]:
    """A figure of ``rows`` panels of ``height`` inches above one another on a common axis; ``extra`` inches are for
    legends."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(FIGURE_WIDTH, rows * height + 0.75 + extra), layout="constrained")
    axes = figure.subplots(rows, 1, sharex=True, squeeze=False)[:, 0]
    return figure, list(axes)


def draw_legend(figure: Figure, axes: list[Axes]) -> None:
    """Draw a single legend below all panels."""
    entries = {label: handle for ax in axes for handle, label in zip(*ax.get_legend_handles_labels(), strict=True)}
    letters = len("".join(entries))
    alone = letters <= 64 and letters + MARKER_LETTERS * len(entries) <= LETTERS
    few = 4 if max(map(len, entries), default=0) + MARKER_LETTERS <= LETTERS / 4 else 3
    figure.legend(
        entries.values(),
        entries.keys(),
        loc="outside lower center",
        ncols=len(entries) if alone else few,
        columnspacing=1.6,
        handlelength=1.4,
        handletextpad=0.6,
    )


def save_figure(file: Path, draw: Callable[P, Figure | None], *arguments: P.args, **options: P.kwargs) -> list[Path]:
    """Draw a figure in the style of all figures, and write it as `write_figure` does.

    Returns the files; none where ``draw`` returns ``None``, since there is nothing to draw. Raises `InputError` where
    matplotlib is missing, and where a file cannot be written.
    """
    require_matplotlib()
    with style():
        figure = draw(*arguments, **options)
        return [] if figure is None else write_figure(file, figure)


def draw_extra(
    file: Path, draw: Callable[P, Figure | None], *arguments: P.args, **options: P.kwargs
) -> tuple[str, ...]:
    """Draw a figure as `save_figure` does, and return its error as a remark: numbers do without their figure."""
    try:
        save_figure(file, draw, *arguments, **options)
    except SparseRobError as error:
        return (str(error),)
    return ()


def write_figure(file: Path, figure: Figure) -> list[Path]:
    """Write a figure, each file whole: into ``file`` when its ending is a kind of figure (.png, .pdf, .svg), else into
    ``file.pdf`` (vector) and ``file.png`` (200 dots per inch). Returns the files; the same figure gives the same bytes.

    Raises `InputError` when one cannot be written.
    """
    from matplotlib.backends.backend_agg import FigureCanvasAgg

    FigureCanvasAgg(figure)
    has_suffix = file.suffix.lower() in KINDS
    files = [file] if has_suffix else [file.with_name(f"{file.name}{kind}") for kind in (".pdf", ".png")]
    for path in files:
        stream, kind = BytesIO(), path.suffix.lower()
        with _report_missing_letters():
            figure.savefig(stream, format=kind[1:], **KINDS[kind])
        figure.set_layout_engine("none")  # everything has its place now, in the next file too
        try:
            write_whole(path, stream.getvalue())
        except SparseRobError as error:
            raise InputError(str(error)) from error
    return files


@contextmanager
def _report_missing_letters() -> Iterator[None]:
    """Letters that no font here has, such as those of a title, are told once, in one line; matplotlib says it for every
    letter and file."""
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        yield
    missing = set[str]()
    for warning in caught:
        glyph = re.match(r"Glyph (\d+) .*missing from", str(warning.message))
        if glyph is None:
            warnings.warn_explicit(warning.message, warning.category, warning.filename, warning.lineno)
        else:
            missing.add(chr(int(glyph[1])))
    if new_letters := missing - _reported_letters:
        _reported_letters.update(new_letters)
        logger.warning("figures: no font here has %s: boxes stand there", " ".join(sorted(new_letters)))


def require_writable(file: Path) -> None:
    """Raise `InputError` unless the ending of the file is a kind of figure and its folder can be written to."""
    if file.suffix.lower() not in KINDS:
        raise InputError(f"{file}: expected a file that ends in {', '.join(KINDS)}, got {file.suffix or 'no ending'}")
    folder = next(parent for parent in file.absolute().parents if parent.exists())
    if file.is_dir() or not folder.is_dir() or not os.access(folder, os.W_OK):
        raise InputError(f"{file}: cannot be written there; expected a file in a folder that can be written to")


def missing_matplotlib() -> str:
    """Return a note that matplotlib is missing, with the way to install it; an empty text where it is installed.

    A figure is an extra: a command prints the note with its result, which alone determines the exit status.
    """
    from importlib.util import find_spec

    is_installed = find_spec("matplotlib") is not None
    return "" if is_installed else f"no figure: {not_installed('matplotlib')}"


def require_matplotlib() -> None:
    """Raise `InputError` with the way to install it when matplotlib is missing."""
    if missing := missing_matplotlib():
        raise InputError(missing)


def held(values: Array, breakpoints: Array) -> tuple[Array, Array]:
    """Steps ``values (K,)`` between ``breakpoints (K + 1,)`` with equal neighbours joined: a figure of many pieces has
    as many edges as the signal has."""
    begins = np.append(True, values[1:] != values[:-1])
    return values[begins], breakpoints[np.append(begins, True)]
