"""Channel of the events from the run to the process that records: a pipe, with a thread at either end that waits for
it, so that neither side ever does."""

from __future__ import annotations

import math
import os
import queue
import threading
import time
from collections import deque
from collections.abc import Callable
from contextlib import suppress
from multiprocessing.connection import Connection
from typing import Any, final

import sparserob_core as sr

COLLECTING = 0.5
"""Seconds for which the events of a search are collected before they are sent as one. Ten times as many, and what a run
did in its last seconds is lost with it; a tenth, and messages take a tenth of the search's processor time."""
LOOK = 0.25
"""Seconds between two looks at whether the run is alive, and between two flushes. Ten times as many, and a recorder
outlives a killed run by more than the two seconds that it has to finish, and what was sent a second ago is not in the
file; a tenth wakes the process up for nothing."""
TOLD = 30.0
"""Seconds that a run which was told to end, with its recorder, has for its end. A tenth, and the recording of a run
that returns what it has is without its verdict; ten times as many, and a recorder that alone was told to end stays for
minutes."""
DRAINING = 0.1
"""Seconds in which nothing more comes out of the pipe of a run that has died: then everything was read."""


@final
class Sender:
    """Run's end of the channel, which takes a message in microseconds; a thread of its own writes it into the pipe.

    At most as many messages wait as there is ``room`` (a semaphore of both processes). Events that ``follow`` one
    another are collected for a moment; ``packed``, of one event or of several, makes a message, and is called by the
    thread.
    """

    def __init__(
        self,
        pipe: Connection,
        room: Any,
        follow: Callable[[Any, Any], bool],
        packed: Callable[[list[Any]], Any],
    ) -> None:
        self.pipe, self.room, self.follow, self.packed = pipe, room, follow, packed
        self.changed = threading.Condition()
        self.waiting: deque[tuple[float, list[Any]]] = deque()
        self.lost, self.broken, self.over = 0, False, False
        self.thread = threading.Thread(target=self._write, name="recording", daemon=True)
        self.thread.start()

    def add(self, event: Any) -> bool:
        """Add an event to those that are being collected, if it follows them."""
        with self.changed:
            if not self.waiting or not self.follow(self.waiting[-1][1][-1], event):
                return False
            self.waiting[-1][1].append(event)
            return True

    def put(self, message: Any, seconds: float = 0.0) -> None:
        """Send a message; raises `queue.Full` where for some ``seconds`` too many have been waiting."""
        if not (self.room.acquire(timeout=seconds) if seconds > 0.0 else self.room.acquire(block=False)):
            raise queue.Full
        with self.changed:
            self.waiting.append((time.monotonic() + COLLECTING, [message]))
            self.changed.notify()

    def close(self) -> None:
        """Write what is waiting, and end; a message that cannot be written within a second is lost, for nobody
        reads."""
        with self.changed:
            self.over = True
            self.changed.notify()
        self.thread.join(1.0)
        if not self.thread.is_alive():
            self.pipe.close()

    def _write(self) -> None:
        while (group := self._next()) is not None:
            try:
                self.pipe.send(self.packed(group))
            except OSError:  # nobody reads any more
                self.broken = True
                return
            except Exception:  # noqa: BLE001  what cannot be written is counted, and the next one is tried
                self.lost += len(group)
                self.room.release()

    def _next(self) -> list[Any] | None:
        """Return the oldest messages, once nothing can be added to them; ``None`` at the end."""
        with self.changed:
            while True:
                if not self.waiting:
                    if self.over:
                        return None
                    self.changed.wait()
                    continue
                due, group = self.waiting[0]
                remaining = due - time.monotonic()
                is_last = len(self.waiting) == 1 and not self.over
                if is_last and remaining > 0.0 and _collects(group[0]):
                    self.changed.wait(remaining)
                    continue
                self.waiting.popleft()
                return group


def _collects(event: Any) -> bool:
    """Return whether it is worth waiting for more events of the search; false at its beginning, when it has no
    landscape yet."""
    return isinstance(event, sr.EvaluationsFinished) and event.total > event.count


@final
class Receiver:
    """Recorder's end of the channel. A thread reads the pipe as soon as something is in it: what the run has sent is
    here when the run dies, however far behind the recording is, and half a message holds up nobody."""

    def __init__(self, pipe: Connection, room: Any, parent: int) -> None:
        self.pipe, self.room, self.parent = pipe, room, parent
        self.inbox: queue.SimpleQueue[Any] = queue.SimpleQueue()
        self.ended = False  # nothing comes out of the pipe any more
        self.over = math.inf  # the moment at which the last event came, whatever is still to be read before it
        self.told = math.inf  # the moment at which this process was told to end
        threading.Thread(target=self._read, name="reading", daemon=True).start()

    @property
    def orphaned(self) -> bool:
        """True where the run is gone, or counts as gone. Another process of the run may hold the pipe open, so its end
        is not enough."""
        return self.ended or os.getppid() != self.parent or time.monotonic() - self.told > TOLD

    def tell(self) -> None:
        """Note that this process was told to end: with the run as a rule, which then has something to say, and ends."""
        self.told = min(self.told, time.monotonic())

    @property
    def empty(self) -> bool:
        """True where no message waits."""
        return self.inbox.empty()

    def get(self, seconds: float) -> Any:
        """Return the next message, or raise `queue.Empty` after some seconds; raise `EOFError` where the run is gone
        and nothing is left."""
        end = time.monotonic() + seconds
        while True:
            gone = self.orphaned
            wait = DRAINING if gone else min(LOOK, max(0.0, end - time.monotonic()))
            with suppress(queue.Empty):
                message = self.inbox.get(timeout=wait) if wait > 0.0 else self.inbox.get_nowait()
                self.room.release()
                return message
            if gone:
                raise EOFError
            if time.monotonic() >= end:
                raise queue.Empty

    def _read(self) -> None:
        while True:
            try:
                message = self.pipe.recv()
                if isinstance(message, sr.RunFinished | sr.SweepFinished):
                    self.over = time.monotonic()
                self.inbox.put(message)
            except (EOFError, OSError):
                break
            except Exception:  # noqa: BLE001  a message that cannot be read is left out
                self.room.release()
        self.ended = True
