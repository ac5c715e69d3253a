"""Tells the progress of a run on the terminal: one live line on a terminal, plain lines anywhere else, nothing for a short run."""

from __future__ import annotations

import math
import sys
import time
from collections.abc import Iterator
from typing import TYPE_CHECKING, TextIO

from pydantic import Field, PrivateAttr

import sparserob_core as sr

if TYPE_CHECKING:
    from rich.console import Group
    from rich.live import Live

PLAIN_EVERY = 1.0


class Progress(sr.Observer, sr.Options):
    """Round, bounds, worst violation and active indices, on the standard error stream.

    Nothing is shown for a quiet run, nor before ``patience`` seconds have passed; the line disappears from a terminal when the run is over.
    """

    patience: float = Field(default=2.0, ge=0.0)
    """Seconds of silence; a run that is over by then shows nothing."""

    verbose: bool = False
    """Show every round from the start, in plain lines also where nothing is drawn."""

    _screen: _Screen | None = PrivateAttr(default=None)

    def receive(self, event: sr.Event) -> None:
        """See `sparserob_core.Observer`."""
        if isinstance(event, sr.RunStarted) and not event.quiet:
            self._screen = _Screen(event.title, 0.0 if self.verbose else self.patience, 0.0 if self.verbose else PLAIN_EVERY)
        elif isinstance(event, sr.RunFinished):
            self.stop()
        elif self._screen is not None:
            self._screen.show(event)

    def stop(self) -> None:
        """Leave the terminal as it was."""
        screen, self._screen = self._screen, None
        if screen is not None:
            screen.close()


class _Screen:
    """Where the progress of one run is shown."""

    def __init__(self, title: str, patience: float, pause: float, stream: TextIO | None = None) -> None:
        self.title, self.patience, self.pause = title, patience, pause
        self.stream = stream or sys.stderr
        self.started = time.monotonic()
        self.shown = -math.inf
        self.last: sr.RoundFinished | None = None
        self.live: Live | None = None

    def show(self, event: sr.Event) -> None:
        now = time.monotonic()
        if isinstance(event, sr.RoundFinished):
            self.last = event
        if now - self.started < self.patience:
            return
        if self.stream.isatty():
            self._draw(event)
        elif now - self.shown >= self.pause:
            self.stream.write(line(event) + "\n")
            self.stream.flush()
            self.shown = now

    def close(self) -> None:
        if self.live is not None:
            self.live.stop()
            self.live = None

    def _draw(self, event: sr.Event) -> None:
        if self.live is None:
            from rich.console import Console
            from rich.live import Live

            self.live = Live(console=Console(file=self.stream), refresh_per_second=8, transient=True)
            self.live.start()
        self.live.update(self._table(event))

    def _table(self, event: sr.Event) -> Group:
        from rich.console import Group
        from rich.table import Table
        from rich.text import Text

        parts: list[Table | Text] = [Text(f"{self.title}  {time.monotonic() - self.started:.1f} s", style="bold")]
        if self.last is not None:
            table = Table(box=None, padding=(0, 2, 0, 0), header_style="dim")
            for name in columns(self.last):
                table.add_column(name, justify="right")
            table.add_row(*columns(self.last).values())
            parts.append(table)
        if event is not self.last:
            parts.append(Text(line(event)))
        return Group(*parts)


def columns(event: sr.RoundFinished) -> dict[str, str]:
    """A round, as the cells of a table that fits into 80 characters."""
    return {"round": str(event.round), "eps": f"{event.epsilon:.1e}",
            "lower": f"{event.lower_bound:.9g}", "upper": f"{event.upper_bound:.9g}",
            "violation": f"{event.violation:.1e}", "indices": str(event.active_indices)}


def line(event: sr.Event) -> str:
    """An event in one line of text."""
    match event:
        case sr.RoundFinished():
            return "  ".join(f"{name} {value}" for name, value in columns(event).items()) + f"  {event.seconds:.1f} s"
        case sr.ProofProgress():
            return f"proof of {event.family}: {event.cells} cells open, violation not excluded {event.bound:.1e}"
        case sr.EvaluationsFinished():
            return f"maximiser: {event.total} evaluations, best {event.best_value:.9g}"
        case _:
            return type(event).__name__


@sr.hookimpl
def sparserob_observers() -> Iterator[sr.ObserverPlugin]:
    """Offer ``progress``."""
    yield sr.ObserverPlugin(name="progress", factory=Progress, summary="Bounds and violation of every round, on the terminal.")
