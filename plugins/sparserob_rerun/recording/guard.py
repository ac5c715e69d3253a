"""Guard that keeps a recording whole from outside: what was logged goes to the disk every moment, and the file is ended
properly whatever becomes of the run, and whatever the recorder is at."""

from __future__ import annotations

import math
import os
import shutil
import threading
import time
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any, final

from sparserob_rerun.recording.channel import LOOK

FLUSHING = 1.0
"""Seconds that a flush may take. Ten times as many, and a viewer that hangs keeps the recorder alive after its run."""
STUCK = 10
"""Flushes in a row that do not arrive, each of `FLUSHING` seconds, after which the thread that writes the file is taken
to be dead. A tenth, and a machine or a disk that stands still for a moment ends the recording; ten times as many, and
what is logged meanwhile fills the memory."""
ENDING = 5.0
"""Seconds that the last flush and the end of the files may take, when nobody waits for the process to be gone."""
GRACE = 1.0
"""Seconds after the end of a run that was killed in which the recorder may log what is left and end by itself. Ten
times as many, and it outlives its run; a tenth cuts off what is still to be logged."""
TRAILER, LONGEST = b"RRF2FOOT", 64
"""The mark at the end of a complete file, and how many bytes from its end it is sought."""
SPARE = 1 << 16
"""Bytes: a disk with fewer of them free is full, for the smallest recording needs as many."""


@final
class Guard:
    """Guard of one open ``stream`` into a ``file`` (if any): a thread that flushes, and that ends the process where the
    run is gone and the recorder does not end by itself. ``orphaned`` says whether the run is gone; ``leave`` ends what
    else was started."""

    def __init__(self, file: Path | None, orphaned: Callable[[], bool], leave: Callable[[], None]) -> None:
        self.file, self.orphaned, self.leave = file, orphaned, leave
        self.stream: Any = None
        self.alone = False  # nothing but the file is written
        self.wrong, self.lost, self.missed = "", False, 0
        self.over, self.once, self.closed = threading.Event(), threading.Lock(), False
        threading.Thread(target=self._watch, name="guard", daemon=True).start()

    def open(self, stream: Any, alone: bool) -> None:
        """Look after a stream from now on; ``alone``: it goes to the file only."""
        self.alone, self.stream = alone, stream

    def flush(self, seconds: float) -> bool:
        """Send what was logged; return whether it arrived, with all that was late before."""
        try:
            self.stream.flush(timeout_sec=seconds)
        except RuntimeError as error:
            self.wrong, self.missed = str(error), self.missed + 1
            return False
        if self.alone and not self.lost:  # a viewer that went away takes everything, and stays away
            self.wrong = ""
        self.missed = 0
        return True

    def close(self, seconds: float = ENDING) -> str:
        """End the stream and its files, once; return why the file is not complete, if it is not."""
        with self.once:
            if self.stream is not None and not self.closed:
                self.closed = True
                self.flush(seconds)
                within(seconds, self.stream.disconnect)
        if self.file is None:
            return ""
        halted = f"{self.file} is not a complete recording: nothing could be written any more ({self.wrong})"
        return broken(self.file) or (halted if self.lost else "")

    def done(self) -> None:
        """Note that the recorder has ended by itself."""
        self.over.set()

    def _watch(self) -> None:
        gone = math.inf
        while not self.over.wait(LOOK):
            now = time.monotonic()
            if self.orphaned():
                gone = min(gone, now)
            if now - gone > GRACE:
                self._leave()
            if self.stream is not None and not self.closed and not self.lost:
                # with a file only there is nothing left to do; another destination goes on without it
                late = not self.flush(FLUSHING) and self.alone
                self.lost |= late and (self.missed >= STUCK or self._full)

    @property
    def _full(self) -> bool:
        """True where the disk has no room for more of the file."""
        with suppress(OSError):
            return self.file is not None and shutil.disk_usage(self.file.parent).free < SPARE
        return False

    def _leave(self) -> None:
        with suppress(Exception):
            if self.stream is None and self.file is not None and not self.file.stat().st_size:
                self.file.unlink()  # nothing was recorded: rather no file than one that is none
            self.close(FLUSHING)
            self.leave()
        os._exit(0)


def within(seconds: float, task: Callable[[], None]) -> bool:
    """Run a task that a file that cannot be written may hold up for ever; return whether it was done in some seconds.
    An error of the task is raised."""
    errors = list[Exception]()

    def run() -> None:
        try:
            task()
        except Exception as error:  # noqa: BLE001  raised below, in the thread that waits
            errors.append(error)

    thread = threading.Thread(target=run, daemon=True)
    thread.start()
    thread.join(seconds)
    if errors:
        raise errors[0]
    return not thread.is_alive()


def broken(file: Path) -> str:
    """Say why a file is no complete recording; empty where it is one. A file that is no ordinary one is believed."""
    try:
        if file.exists() and not file.is_file():
            return ""
        with file.open("rb") as opened:
            opened.seek(max(0, file.stat().st_size - LONGEST))
            if TRAILER in opened.read():
                return ""
        free = shutil.disk_usage(file.parent).free
    except OSError as error:
        return f"{file} cannot be read: {error.strerror}"
    why = "the disk is full" if free < SPARE else "it could not be written to its end"
    return f"{file} is not a complete recording: {why}"
