"""Progress of a run: a live block on a terminal, plain lines anywhere else, nothing for a short run."""

from __future__ import annotations

import sys
from collections.abc import Iterator

from pydantic import Field, PrivateAttr

import sparserob_core as sr
from sparserob_progress.screen import Screen
from sparserob_progress.status import Status, duration

SHOWN = (sr.RoundFinished, sr.EvaluationsFinished, sr.ProofProgress, sr.StageProgress, sr.StudyProgress)


class ProgressObserver(sr.Observer, sr.Options):
    """Observer that shows a run on the standard error stream: the phase, bounds, round, worst violation, what is
    proven, the search with its best value, rate and time left, and the proof.

    Nothing is shown for a quiet run, nor before ``patience`` seconds have passed. On a terminal the lines are renewed
    in place and disappear when the run is over; anywhere else one line is written every five seconds.
    """

    patience: float = Field(default=2.0, ge=0.0)
    """Seconds before anything is shown; a run that is over by then shows nothing."""

    verbose: bool = False
    """Write a plain line for every event from the start instead."""

    _status: Status | None = PrivateAttr(default=None)
    _screen: Screen | None = PrivateAttr(default=None)

    def receive(self, event: sr.Event) -> None:
        """Take note of an event and show the progress; see `sparserob_core.Observer`."""
        if isinstance(event, sr.RunStarted) and not event.quiet:
            self._status = Status(event.title)
            if event.unprovable:
                sys.stderr.write(f"no control of this problem can be certified: {event.unprovable}\n")
            self._screen = None if self.verbose else Screen(self._status, self.patience, sys.stderr)
        elif self._status is not None:
            self._show(self._status, event)

    def close(self) -> None:
        """Leave the terminal as it was."""
        screen, self._screen, self._status = self._screen, None, None
        if screen is not None:
            screen.close()
            self._require(screen)

    def _require(self, screen: Screen) -> None:
        if screen.failure is not None:
            raise screen.failure

    def _show(self, status: Status, event: sr.Event) -> None:
        status.receive(event)
        if isinstance(event, sr.RunFinished):
            self.close()
        elif self._screen is None and isinstance(event, SHOWN):
            sys.stderr.write(f"{duration(status.elapsed)}  {status.last(event)}\n")
        elif self._screen is not None:
            self._require(self._screen)


@sr.hookimpl
def sparserob_observers() -> Iterator[sr.ObserverPlugin]:
    """Offer ``progress``."""
    yield sr.ObserverPlugin(
        name="progress", factory=ProgressObserver, summary="Bounds, search and proof as they go on, on the terminal."
    )
