"""Run's end of a recording: a queue that takes an event in microseconds, and never makes the solver wait."""

from __future__ import annotations

import atexit
import multiprocessing
import queue
import sys
import time
import uuid
import warnings
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import replace
from typing import Any, final

import numpy as np

import sparserob_core as sr
from sparserob_rerun.recording.channel import Sender
from sparserob_rerun.recording.desk import Account, Ending, record
from sparserob_rerun.recording.recorder import Opening
from sparserob_rerun.recording.sinks import Destinations
from sparserob_rerun.search.projection import thin
from sparserob_rerun.study.recorder import StudyOpening

CAPACITY = 512  # events that may wait
LASTING = 10  # seconds that the last event may wait for its place in the queue
CLOSING = 60.0  # seconds that the process may take to finish its files, beyond the patience of the landscape
LEAVING = 5.0  # seconds until a process that has lost its pipe, and is given a moment to end its file, is killed
OVER = 600.0  # the same for a run that is over, and has nothing else to wait for
START = "fork" if sys.platform.startswith("linux") else "spawn"


@final
class Outlet:
    """Process that records one run, or one study. Everything about it may fail, and the run does not notice."""

    def __init__(self, opening: Opening | StudyOpening, chosen: Destinations, capacity: int = CAPACITY) -> None:
        context: Any = multiprocessing.get_context(START)
        landscape = opening.landscape if isinstance(opening, Opening) else None
        self.patience = 0.0 if landscape is None else landscape.patience
        self.file, self.incomplete = chosen.save, ""
        self.closing = OVER if opening.waits else CLOSING
        self.dropped, self.dead = 0, False
        self.waits = opening.waits
        room, (reader, writer) = context.BoundedSemaphore(capacity), context.Pipe(duplex=False)
        self.report, report_writer = context.Pipe(duplex=False)
        child_opening = opening
        if START != "fork" and isinstance(opening, Opening):
            child_opening = replace(opening, inspection=None)
        self.process = context.Process(
            target=record,
            args=(
                reader,
                writer if START == "fork" else None,
                room,
                report_writer,
                child_opening,
                chosen,
                uuid.uuid4().hex,
            ),
            daemon=True,
        )
        with warnings.catch_warnings():
            # of a fork beside other threads: the child uses none of them
            warnings.simplefilter("ignore", DeprecationWarning)
            self.process.start()
        for end in (report_writer, reader):
            end.close()
        self.sender = Sender(writer, room, follows, packed)
        atexit.register(self.sender.close)  # before Python waits for processes that end with this pipe

    def send(self, event: sr.Event) -> None:
        """Pass an event on, or drop it where too many are waiting already. Evaluations are collected for a moment."""
        if self.sender.add(event):
            return
        last, tries = isinstance(event, sr.RunFinished | sr.SweepFinished), LASTING
        while not self.dead and not self.sender.broken:
            try:
                self.sender.put(event, 1.0 if self.waits or last else 0.0)
                return
            except queue.Full:
                self.dead, tries = not self.process.is_alive(), tries - 1
                if not self.waits and not (last and tries):
                    break
        self.dropped += 1

    def close(self, keep: float = 0.0) -> list[str]:
        """End the recording; return what there is to complain about, and keep in ``incomplete`` why the recording is
        not whole, if it is not. An interrupt ends the waiting, not more."""
        wrong = []
        try:
            wrong = self._closed(keep)
        except KeyboardInterrupt:
            self.incomplete = "" if keep else "interrupted while the recording was being finished"
        finally:
            atexit.unregister(self.sender.close)
            self.sender.close()  # the end of the pipe ends the process, and its file
            self.process.join(LEAVING)
            if self.process.is_alive():
                self.process.kill()
        self.dropped += self.sender.lost
        if self.dropped and not self.incomplete:
            self.incomplete = f"{self.dropped} events came faster than they could be recorded, and were dropped"
        return [*([self.incomplete] if self.incomplete else []), *wrong]

    def _closed(self, keep: float) -> list[str]:
        end = time.monotonic() + self.patience + self.closing
        while self.process.is_alive() and time.monotonic() < end:
            with suppress(queue.Full):
                self.sender.put(Ending(self.dropped + self.sender.lost, keep), 0.2)
                break
        while time.monotonic() < end + keep:
            ended = not self.process.is_alive()  # before the look: its last word may come in between
            if self.report.poll(0.05):
                with suppress(EOFError, OSError):
                    account = self.report.recv()
                    self.process.join(CLOSING)
                    if isinstance(account, Account):
                        self.incomplete = account.broke_off
                        return list(account.wrong)
            elif not ended:
                continue
            break
        holds = f"; {self.file} holds what was recorded until then" if self.file is not None else ""
        why = "could not be finished in time" if self.process.is_alive() else "broke off: its process ended early"
        self.incomplete = f"the recording {why}{holds}"
        return []


def packed(events: Sequence[Any]) -> Any:
    """Return what is sent of successive events: of evaluated tuples only what may be drawn."""
    return thin(joined(events)) if isinstance(events[0], sr.EvaluationsFinished) else events[0]


def follows(before: Any, event: Any) -> bool:
    """Return whether an event goes on where another one of the same search ended."""
    if not isinstance(before, sr.EvaluationsFinished) or not isinstance(event, sr.EvaluationsFinished):
        return False
    is_same_search = (event.family, event.round, event.phase) == (before.family, before.round, before.phase)
    return is_same_search and event.total - event.count == before.total


def joined(parts: Sequence[sr.EvaluationsFinished]) -> sr.EvaluationsFinished:
    """Join successive events of one search."""
    if len(parts) == 1:
        return parts[0]
    first, batches = parts[0].batch, [event.batch for event in parts]
    notes: dict[str, list[tuple[float, float]]] = {}
    for batch in batches:
        for name, rows in batch.notes.items():
            notes.setdefault(name, []).extend(rows)
    points = [piece for batch in batches for piece in batch.points]
    values = [piece for batch in batches for piece in batch.values]
    moments = [moment for batch in batches for moment in batch.moments]
    joined_batch = replace(first, points=points, values=values, moments=moments, notes=notes)
    sketches = {role: sketch for event in parts for role, sketch in event.sketches.items()}
    deciding = np.concatenate([event.deciding for event in parts])
    count = sum(event.count for event in parts)
    return replace(parts[-1], count=count, batch=joined_batch, sketches=sketches, deciding=deciding)
