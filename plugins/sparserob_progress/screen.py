"""Display of the progress: a block of lines that renews itself on a terminal, a plain line now and then anywhere
else."""

from __future__ import annotations

import os
import threading
from typing import TYPE_CHECKING, Final, TextIO

from sparserob_progress.status import LABEL, Status, duration

if TYPE_CHECKING:
    from rich.live import Live
    from rich.text import Text

DRAWN_EVERY: Final = 0.25
PLAIN_EVERY: Final = 5.0
LONGEST_GOODBYE: Final = 2.0  # a terminal that takes nothing any more shall not hold up the end of a run


class Screen:
    """Thread that shows a `Status` after ``patience`` seconds, and again and again, so that the solver never waits for
    the terminal."""

    def __init__(self, status: Status, patience: float, stream: TextIO) -> None:
        self.status, self.patience, self.stream = status, patience, stream
        self.failure: Exception | None = None
        self._over = threading.Event()
        self._thread = threading.Thread(target=self._watch, name="sparserob progress", daemon=True)
        self._thread.start()

    def close(self) -> None:
        """Leave the terminal as it was."""
        self._over.set()
        self._thread.join(LONGEST_GOODBYE)

    def _watch(self) -> None:
        try:
            if not self._over.wait(self.patience):
                self._draw() if is_terminal(self.stream) else self._write()
        except Exception as error:  # noqa: BLE001  to be raised where it is reported
            self.failure = error

    def _write(self) -> None:
        while True:
            self.stream.write(self.status.line() + "\n")
            self.stream.flush()
            if self._over.wait(PLAIN_EVERY):
                return

    def _draw(self) -> None:
        from rich.console import Console
        from rich.live import Live

        live = Live(console=Console(file=self.stream), auto_refresh=False, transient=True, redirect_stdout=False)
        with live:
            self._renew(live)

    def _renew(self, live: Live) -> None:
        while True:
            live.update(block(self.status), refresh=True)
            if self._over.wait(DRAWN_EVERY):
                return


def is_terminal(stream: TextIO) -> bool:
    """Return whether lines can be written over."""
    return stream.isatty() and os.environ.get("TERM", "") not in ("", "dumb")


def block(status: Status) -> Text:
    """Return the title with the time, and one line for each part."""
    from rich.text import Text

    text = Text(no_wrap=True, overflow="ellipsis")
    text.append(status.title, "bold")
    text.append(f"  {duration(status.elapsed)}")
    for label, content in status.parts():
        text.append(f"\n{label:<{LABEL}}", "dim")
        text.append(content)
    return text
