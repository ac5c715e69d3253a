"""Recording of a run in Rerun while it runs: the search, the landscape of g, the physics and the bounds go to a viewer,
a browser or a file."""

from __future__ import annotations

import logging
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

from pydantic import Field, PrivateAttr, field_validator

import sparserob_core as sr
from sparserob_rerun.options import LandscapeOptions

if TYPE_CHECKING:
    from sparserob_rerun.recording.outlet import Outlet

logger = logging.getLogger("sparserob")


class Rerun(sr.Observer, sr.Options):
    """A recording for the viewer of Rerun (rerun.io), an optional extra: ``pip install rerun-sdk``. Given to a
    sweep, it shows the study: the status of every point, what runs, and the bounds.

    Destinations can be combined; with none of them, ``recording.rrd`` in the run's directory. A missing package, viewer
    or listener is one warning, and the run goes on without. Everything happens in a process of its own, on one core at
    a time and for a share of it; the solver hands over its events and goes on. When too many are waiting, the newest
    are dropped, and their number is shown at the end.
    """

    spawn: bool = False
    """Start a viewer, or use the one that runs already."""

    connect: str | None = None
    """Send to a viewer that listens at this address, such as 127.0.0.1:9876."""

    serve: bool = False
    """Show it in a browser, at port 9090 of this machine or at another one where that is taken, as long as the run
    lasts and ``keep`` seconds more, unless a key ends both."""

    keep: float = Field(default=0.0, ge=0.0)
    """Seconds that a browser is served after the run."""

    save: str | None = None
    """Record into this file; a relative one is in the run's directory."""

    landscape: LandscapeOptions | None = LandscapeOptions()
    """The landscape of g that is evaluated in the background; null: none."""

    waits: bool = False
    """Wait until everything is recorded rather than drop what comes too fast: for a run that is over."""

    _incomplete: str = PrivateAttr(default="")
    _outlet: Outlet | None = PrivateAttr(default=None)
    _pressed: bool = PrivateAttr(default=False)

    @field_validator("connect")
    @classmethod
    def _address(cls, text: str | None) -> str | None:
        from sparserob_rerun.recording.sinks import address_of

        if text is not None:
            address_of(text)
        return text

    def receive(self, event: sr.Event) -> None:
        """Pass an event on to the recording; the first event begins it. See `sparserob_core.Observer`."""
        if isinstance(event, sr.RunStarted | sr.SweepStarted):
            self._begin(event)
        elif (outlet := self._outlet) is not None:  # one look: pydantic takes longer for it than the rest
            outlet.send(event)
            if isinstance(event, sr.RunFinished | sr.SweepFinished):
                self._pressed = event.pressed
                if self.serve and self.keep and not event.pressed:
                    ending = f"run is over: {event.status}" if isinstance(event, sr.RunFinished) else "study is over"
                    logger.warning("rerun: the %s; its page stays until Ctrl-C", ending)
                self.close()

    @property
    def incomplete(self) -> str:
        """Reason why the recording is not complete, empty where it is; see `sparserob_core.Observer`."""
        return self._incomplete

    def close(self) -> None:
        """End the recording, which is complete afterwards; see `sparserob_core.Observer`."""
        outlet, self._outlet = self._outlet, None
        if outlet is not None:
            for line in outlet.close(0.0 if self._pressed else self.keep):  # who ends a run wants no page of it
                logger.warning("rerun: %s", line)
            self._incomplete = outlet.incomplete

    def _begin(self, event: sr.RunStarted | sr.SweepStarted) -> None:
        from sparserob_rerun.recording.sinks import look

        self.close()
        nowhere = not (self.spawn or self.connect or self.serve or self.save)
        file = "recording.rrd" if nowhere and event.directory is not None else self.save
        chosen = look(
            None if file is None else (event.directory or Path()) / file, self.connect, self.spawn, self.serve
        )
        if chosen.missing or not chosen.any:
            logger.warning(
                "rerun: %s",
                "; ".join(chosen.missing) or "there is no directory to record into; give it a place with save",
            )
        if chosen.serve is not None:
            logger.warning("rerun: to watch, open %s", chosen.page)
        if chosen.any:
            from sparserob_rerun.recording.outlet import Outlet
            from sparserob_rerun.recording.recorder import Opening
            from sparserob_rerun.study.recorder import StudyOpening

            if isinstance(event, sr.SweepStarted):
                self._outlet = Outlet(StudyOpening(event), chosen)
                return
            opening = Opening(event.title, event.directory, event.inspection, self.landscape, self.waits)
            self._outlet = Outlet(opening, chosen)


@sr.hookimpl
def sparserob_observers() -> Iterator[sr.ObserverPlugin]:
    """Offer ``rerun``."""
    yield sr.ObserverPlugin(
        name="rerun",
        factory=Rerun,
        summary="Search, landscape, physics and bounds, live in the viewer of Rerun or in a file.",
    )
