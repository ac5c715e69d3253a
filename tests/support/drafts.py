"""Figures as drafts, for tests of what surrounds them: laid out and drawn as they are, but in few dots, and the vector
graphics are left out. Those of `tests/experiment/figures` are written whole."""

from __future__ import annotations

from typing import IO, Any

import pytest

from sparserob_core.experiment.figures.style import KINDS


@pytest.fixture
def drafts(monkeypatch: pytest.MonkeyPatch) -> None:
    """Every figure of this test is a draft."""
    monkeypatch.setitem(KINDS, ".pdf", {"backend": f"module://{__name__}", "dpi": 80})
    monkeypatch.setitem(KINDS, ".png", {**KINDS[".png"], "dpi": 80})


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
