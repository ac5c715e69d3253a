"""Main loop of the process that records: it takes events from a queue, logs them, and works on the landscape while
there are none."""

from __future__ import annotations

import os
import queue
import signal
import sys
import time
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, field
from functools import partial
from importlib.abc import MetaPathFinder
from multiprocessing.connection import Connection
from typing import Any, final

import sparserob_core as sr
from sparserob_rerun.recording.channel import Receiver
from sparserob_rerun.recording.guard import ENDING, Guard, broken, within
from sparserob_rerun.recording.layout import layout
from sparserob_rerun.recording.recorder import Opening, Recorder, shown_of
from sparserob_rerun.recording.sinks import Destinations, Started, compact, servers, sinks_of, start
from sparserob_rerun.study.recorder import StudyOpening, StudyRecorder
from sparserob_rerun.study.recorder import layout as study_layout

QUIET = "info,re_perf_telemetry=off,re_log_encoding=off,re_sdk::recording_stream=off"
"""Log levels of the viewer's library: it does not log what happens to a file, which `broken` tells in one line."""
IDLE = 0.5  # seconds between two looks at whether the run is still alive


@final
@dataclass(frozen=True)
class Ending:
    """Last message: how many events were dropped before it, and for how many seconds a browser is served from then
    on."""

    dropped: int = 0
    keep: float = 0.0


@final
@dataclass(frozen=True)
class Account:
    """Report of the process at its end."""

    wrong: list[str] = field(default_factory=list)
    broke_off: str = ""
    addresses: list[str] = field(default_factory=list)


def record(
    pipe: Connection,
    theirs: Connection | None,
    room: Any,
    report: Connection,
    opening: Opening | StudyOpening,
    chosen: Destinations,
    name: str,
) -> None:
    """Run the recording process from its beginning to its end. Nothing that it does can reach the run: neither its
    signals nor its failures. ``theirs``: the run's end of the pipe, where this process has got a copy of it, with which
    it would keep itself alive."""
    if theirs is not None:
        theirs.close()
    messages = Receiver(pipe, room, os.getppid())
    _settle(messages)
    account = Account()
    try:
        account = _record(messages, opening, chosen, name)
    except Exception as error:  # noqa: BLE001  shown at the end, by the process that has a terminal
        account = Account(broke_off=f"the recording broke off: {type(error).__name__}: {error}")
    with suppress(OSError):
        report.send(account)
        report.close()


def _record(messages: Receiver, opening: Opening | StudyOpening, chosen: Destinations, name: str) -> Account:
    started: Started = {}

    def leave() -> None:
        for server in servers(chosen, started):
            server.terminate()

    guard = Guard(chosen.save, lambda: messages.orphaned, leave)
    try:
        started.update(start(chosen))
        return _recorded(messages, opening, chosen, name, started, guard)
    finally:
        leave()
        guard.done()


def _recorded(
    messages: Receiver,
    opening: Opening | StudyOpening,
    chosen: Destinations,
    name: str,
    started: Started,
    guard: Guard,
) -> Account:
    sys.meta_path.insert(0, _WithoutPandas())
    os.environ.setdefault("RUST_LOG", QUIET)
    import rerun as rr

    if isinstance(opening, StudyOpening):
        stream = rr.RecordingStream(opening.application, recording_id=name)
        begin: Callable[[], Recorder | StudyRecorder] = partial(StudyRecorder, rr, stream, opening)
        blueprint = study_layout(opening)
    else:
        inspection = opening.answers()
        shown = shown_of(inspection, opening.landscape)
        stream = rr.RecordingStream(shown.application, recording_id=name)
        begin, blueprint = partial(Recorder, rr, stream, opening, shown, inspection), layout(shown)
    sinks, wrong = sinks_of(rr, chosen, started)
    if sinks and not within(ENDING, partial(stream.set_sinks, *sinks, default_blueprint=blueprint)):
        return Account(wrong, "nothing could be sent" if chosen.save is None else broken(chosen.save))
    guard.open(stream, chosen.connect is None and not started)
    ending, broke_off, recorder = Ending(), "", None
    try:
        recorder = begin()
        ending = _listen(messages, recorder, guard, wrong)
        if ending.dropped:
            recorder.say(f"{ending.dropped} events came faster than they could be recorded, and were dropped", "WARN")
        recorder.finish()
        wrong += recorder.broken.values()
    finally:
        broke_off = guard.close()
        if chosen.save is not None and not broke_off:
            compact(chosen.save, recorder.arrangement if recorder is not None else blueprint)
        if servers(chosen, started):
            _look_on(ending.keep, messages)
    if guard.wrong and not broke_off:  # of the flush: a viewer that went away
        wrong.append(f"not everything has arrived: {guard.wrong}")
    return Account(wrong, broke_off)


def _look_on(keep: float, messages: Receiver) -> None:
    """Let a browser look on for a while."""
    end = time.monotonic() + keep
    while time.monotonic() < end and not messages.orphaned:
        time.sleep(IDLE)


def _listen(messages: Receiver, recorder: Recorder | StudyRecorder, guard: Guard, wrong: list[str]) -> Ending:
    """Log all events until the run is over, or gone, or nothing can be written any more. An event that cannot be drawn
    is left out, and the first such error is shown."""
    while not guard.lost:
        try:
            message = messages.get(min(IDLE, recorder.rest))
        except queue.Empty:
            message = None
        except EOFError:
            return Ending()
        if isinstance(message, Ending):
            recorder.ended = messages.over
            return message
        if message is not None:
            recorder.behind, recorder.ended = not messages.empty, messages.over
            _receive(message, recorder, wrong)
        if message is None or recorder.urgent:
            recorder.idle()
    return Ending()


def _receive(message: Any, recorder: Recorder | StudyRecorder, wrong: list[str]) -> None:
    try:
        recorder.receive(message)
    except Exception as error:  # noqa: BLE001  a picture less is better than no recording
        if not wrong:
            wrong.append(f"a {type(message).__name__} could not be drawn: {type(error).__name__}: {error}")
    if isinstance(message, sr.RunFinished) and isinstance(recorder, Recorder):
        recorder.over = message.seconds if message.result is not None else -1.0


@final
class _WithoutPandas(MetaPathFinder):
    """Finder that hides pandas: pyarrow imports it where it is installed, for seconds and 50 MB; nothing here needs
    it."""

    def find_spec(self, fullname: str, path: object = None, target: object = None) -> None:
        """Raise an error for pandas; find nothing else."""
        if fullname == "pandas":
            raise ModuleNotFoundError("pandas is left out", name=fullname)


def _settle(messages: Receiver) -> None:
    """Leave the signals to the run: those of the terminal, and the one that ends a whole group of processes (`timeout`,
    a queue of jobs), after which the run returns what it has, and says so. And take no more than one core at a time: it
    is whichever is free, for where all recorders take the same one, each waits for the others. Shares of processor
    time, not a low priority, hold the work back: with one, the first picture waits for everybody else's work."""
    from threadpoolctl import threadpool_limits

    signal.signal(signal.SIGINT, signal.SIG_IGN)
    signal.signal(signal.SIGTERM, lambda number, frame: messages.tell())
    threadpool_limits(limits=1)
    sys.stdin = None
