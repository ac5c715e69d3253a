"""Progress in a single line, for commands that take a while."""

from __future__ import annotations

import sys
import time
from typing import Self, final

from sparserob_core.experiment.run.events import StudyProgress
from sparserob_core.experiment.terminal.printing import printable
from sparserob_core.sip.events import Event

SECONDS_TO_FIRST_LINE = 2.0  # seconds before the first line
SECONDS_PER_LOOK = 0.1  # seconds between two looks of the line on a terminal
SECONDS_PER_LINE = 5.0  # seconds between two lines anywhere else


@final
class LiveLine:
    """Shows the progress of a study (`StudyProgress`) on the standard error stream, after some patience: on a terminal
    in one line, which is renewed and disappears in the end; anywhere else in a plain line now and then."""

    def __init__(self) -> None:
        self._start_time = self._last_time = time.monotonic()
        self._is_terminal, self._has_output = sys.stderr.isatty(), False

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        if self._has_output and self._is_terminal:
            sys.stderr.write("\r\x1b[K")
            sys.stderr.flush()

    def receive(self, event: Event) -> None:
        """Show an event of a study, whose ``notify`` this method is; events other than `StudyProgress` are ignored."""
        now = time.monotonic()
        pause = SECONDS_PER_LOOK if self._is_terminal else SECONDS_PER_LINE
        if not isinstance(event, StudyProgress) or now - self._start_time < SECONDS_TO_FIRST_LINE:
            return
        if self._has_output and now - self._last_time < pause:
            return
        text = printable(event.text)
        sys.stderr.write(f"\r\x1b[K{text}" if self._is_terminal else f"{text}\n")
        sys.stderr.flush()
        self._last_time, self._has_output = now, True
