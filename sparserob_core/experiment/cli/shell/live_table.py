"""The table of a study while it fills in."""

from __future__ import annotations

import sys
import time
from collections import deque
from typing import TYPE_CHECKING, Self, final

from sparserob_core.experiment.cli.shell.live_line import SECONDS_PER_LOOK, LiveLine
from sparserob_core.experiment.config.plain import value_text
from sparserob_core.experiment.run.events import StudyProgress, SweepProgress
from sparserob_core.experiment.sweep.study import COLUMNS, short
from sparserob_core.experiment.terminal.printing import printable
from sparserob_core.sip.events import Event

if TYPE_CHECKING:
    from rich.live import Live

SHOWN_ROWS = 12
"""Rows that are shown while a study goes on; the whole table is printed in the end."""


@final
class LiveTable:
    """Shows a sweep (`SweepProgress`) on the standard error stream: on a terminal the last rows of its table and one
    line about the whole, which disappear in the end; anywhere else that line now and then."""

    def __init__(self) -> None:
        self._line = LiveLine()
        self._rows: deque[list[str]] = deque(maxlen=SHOWN_ROWS)
        self._display: Live | None = None
        self._last_time = 0.0

    def __enter__(self) -> Self:
        if sys.stderr.isatty():
            from rich.console import Console
            from rich.live import Live

            self._display = Live(console=Console(stderr=True), transient=True, auto_refresh=False)
            self._display.start()
        return self

    def __exit__(self, *_: object) -> None:
        if self._display is not None:
            self._display.stop()

    def receive(self, event: Event) -> None:
        """Show an event of a sweep, whose ``notify`` this method is: rows and progress in the table, or in a line
        without one."""
        if self._display is None:
            self._line.receive(event)
        elif isinstance(event, SweepProgress):
            if event.row is not None:
                self._rows.append([*(value_text(event.row[key]) for key in event.axes), *short(event.row)])
            if time.monotonic() - self._last_time >= SECONDS_PER_LOOK:
                self._show_rows(self._display, event)
        elif isinstance(event, StudyProgress):
            self._display.update(printable(event.text), refresh=True)

    def _show_rows(self, live: Live, event: SweepProgress) -> None:
        from rich.box import SIMPLE
        from rich.table import Table
        from rich.text import Text

        table = Table(box=SIMPLE, caption=Text(printable(event.text)), caption_justify="left")
        for name in (*event.axes, *COLUMNS):
            table.add_column(Text(printable(name)), overflow="fold")
        for row in self._rows:
            table.add_row(*(Text(printable(cell).replace("\n", " ")) for cell in row))
        live.update(table, refresh=True)
        self._last_time = time.monotonic()
