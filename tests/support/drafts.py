"""Figures as drafts: laid out and drawn as they are, but in few dots, and the vector graphics are left out, since many
tests write figures and few are about what a file holds. Those few write theirs `whole`."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import IO, Any

import pytest

from sparserob_core.experiment.figures.style import KINDS

WHOLE = {kind: dict(options) for kind, options in KINDS.items()}


@pytest.fixture(scope="session", autouse=True)
def drafts() -> Iterator[None]:
    """Every figure is a draft."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setitem(KINDS, ".pdf", {"backend": f"module://{__name__}", "dpi": 80})
        patch.setitem(KINDS, ".png", {**WHOLE[".png"], "dpi": 80})
        yield


@contextmanager
def whole() -> Iterator[None]:
    """Figures that are written in this ``with`` block are as users have them."""
    with pytest.MonkeyPatch.context() as patch:
        for kind, options in WHOLE.items():
            patch.setitem(KINDS, kind, options)
        yield


def __getattr__(name: str) -> Any:
    """What matplotlib asks of a backend, which is not imported before."""
    if name != "FigureCanvas":
        raise AttributeError(name)
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.layout_engine import PlaceHolderLayoutEngine

    class FigureCanvas(FigureCanvasAgg):
        def print_pdf(self, stream: IO[bytes], **_: object) -> None:
            if not isinstance(self.figure.get_layout_engine(), PlaceHolderLayoutEngine):  # not laid out before
                FigureCanvasAgg.draw(self)
            stream.write(b"%PDF, a draft")

    return FigureCanvas
