"""Words in a panel before there is anything in it."""

from __future__ import annotations

from typing import Any, final

from sparserob_rerun.drawing import palette as ink
from sparserob_rerun.drawing.canvas import Drawing
from sparserob_rerun.exchange import bounds, clash, rounds
from sparserob_rerun.physics import phase, physics
from sparserob_rerun.physics.pages import pages
from sparserob_rerun.recording.layout import Shown
from sparserob_rerun.search import views

CONTROL, LANDSCAPE = "control and states", "the landscape"
VIOLATIONS, BOUNDS, CLASH = "the violations", "the bounds", "what clashes"


@final
class Waiting:
    """Words in every panel of a run that is still empty, which say what it waits for; they are taken away when the
    panel has a picture (`arrived`)."""

    def __init__(self, rr: Any, stream: Any, shown: Shown) -> None:
        self.rr, self.stream = rr, stream
        self.places = dict[str, list[str]]()
        first = "the first search ends" if shown.searches else "the first round ends"
        if shown.problem is not None:
            event = "the first tuple is evaluated" if shown.searches else first
            for number, page in enumerate(pages(shown.problem)):
                count = len(page.plots)
                plot_height = physics.HEIGHT if number else physics.height(count, shown.searches)
                words = f"the control and the states are drawn when {event}"
                self._write(CONTROL, page.path, physics.extent(count, plot_height), words)
            if phase.pair_of(shown.problem) is not None:
                plane = phase.extent(shown.problem, shown.searches)
                self._write(CONTROL, "physics/phase", plane, f"drawn when {event}")
        if shown.landscape:
            tuples = "the first tuple is evaluated" if shown.searches else "the first constraints are active"
            self._write(LANDSCAPE, "landscape/map", views.EXTENT, f"the landscape of g is drawn when {tuples}")
        self._write(
            VIOLATIONS,
            "violation/plots",
            shown.violations,
            f"drawn when {first}",
        )
        if shown.maps:
            self._write(VIOLATIONS, "violation/names", rounds.extent_of_maps(shown.maps), f"drawn when {first}")
        self._write(CLASH, "clash", clash.extent(()), "drawn when it is known that nothing is feasible")
        self._write(BOUNDS, "rounds/picture/bounds", bounds.ONE, f"no bound yet: {first} with the first one")

    def arrived(self, panel: str) -> None:
        """Take away the words of a panel, which has its first picture."""
        for path in self.places.pop(panel, ()):
            self.stream.log(path, self.rr.Clear(recursive=True))

    def _write(self, panel: str, path: str, extent: tuple[float, float, float, float], words: str) -> None:
        left, right, top, bottom = extent
        drawing, entity = Drawing(), f"{path.strip('/')}/waiting"
        drawing.text((left + right) / 2, (top + bottom) / 2, words, ink.GREY)
        drawing.log(self.rr, self.stream, entity)
        self.places.setdefault(panel, []).append(entity)
