"""The process that records: it takes events from a queue, logs them, and works on the landscape while there are
none."""

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
from typing import Any, final

import sparserob_core as sr
from sparserob_rerun.recording.layout import layout
from sparserob_rerun.recording.recorder import Opening, Recorder, shown_of
from sparserob_rerun.recording.sinks import Destinations, Started, open_sinks, servers, start
from sparserob_rerun.study.recorder import StudyOpening, StudyRecorder
from sparserob_rerun.study.recorder import layout as study_layout

IDLE = 0.5  # seconds between two looks at whether the run is still alive
FLUSHED_EVERY = 1.0  # seconds
FLUSHING = 5.0
NICE = 5


@final
@dataclass(frozen=True)
class Ending:
    """The last message: how many events were dropped before it, and for how many seconds a browser is served from then
    on."""

    dropped: int = 0
    keep: float = 0.0


@final
@dataclass(frozen=True)
class Account:
    """What the process says of itself at the end."""

    wrong: list[str] = field(default_factory=list)
    broke_off: str = ""
    addresses: list[str] = field(default_factory=list)


def record(messages: Any, report: Any, opening: Opening | StudyOpening, chosen: Destinations, name: str) -> None:
    """The whole life of the process. Nothing that it does can reach the run: neither its signals nor its failures."""
    _settle()
    account = Account()
    try:
        account = Account(_record(messages, opening, chosen, name, os.getppid()))
    except Exception as error:  # noqa: BLE001  shown at the end, by the process that has a terminal
        account = Account(broke_off=f"the recording broke off: {type(error).__name__}: {error}")
    with suppress(OSError):
        report.send(account)
        report.close()


def _record(messages: Any, opening: Opening | StudyOpening, chosen: Destinations, name: str, parent: int) -> list[str]:
    started = start(chosen)
    try:
        return _recorded(messages, opening, chosen, name, parent, started)
    finally:
        for server in servers(chosen, started):
            server.terminate()


def _recorded(
    messages: Any,
    opening: Opening | StudyOpening,
    chosen: Destinations,
    name: str,
    parent: int,
    started: Started,
) -> list[str]:
    sys.meta_path.insert(0, _WithoutPandas())
    import rerun as rr

    stream = rr.RecordingStream("sparserob", recording_id=name)
    if isinstance(opening, StudyOpening):
        begin: Callable[[], Recorder | StudyRecorder] = partial(StudyRecorder, rr, stream, opening)
        blueprint = study_layout(opening)
    else:
        inspection = opening.answers()
        shown = shown_of(inspection, opening.landscape)
        begin, blueprint = partial(Recorder, rr, stream, opening, shown, inspection), layout(shown)
    wrong = open_sinks(rr, stream, chosen, blueprint, started)
    ending = Ending()
    try:
        recorder = begin()
        ending = _listen(messages, recorder, parent, wrong)
        if ending.dropped:
            recorder.say(f"{ending.dropped} events came faster than they could be recorded, and were dropped", "WARN")
        recorder.finish()
        wrong += recorder.broken.values()
        stream.flush(timeout_sec=FLUSHING)
    except RuntimeError as error:  # of the flush: a viewer that went away
        wrong.append(f"not everything has arrived: {error}")
    finally:
        stream.disconnect()
        if servers(chosen, started):
            _look_on(ending.keep, parent)
    return wrong


def _look_on(keep: float, parent: int) -> None:
    """Let a browser look on for a while."""
    end = time.monotonic() + keep
    while time.monotonic() < end and os.getppid() == parent:
        time.sleep(IDLE)


def _listen(messages: Any, recorder: Recorder | StudyRecorder, parent: int, wrong: list[str]) -> Ending:
    """Log whatever comes until the run is over, or gone; an event that cannot be drawn is left out, and the first of
    them is shown. What was logged is on the disk a second later."""
    flushed = time.monotonic()
    while True:
        pause = min(IDLE, recorder.rest)
        try:
            message = messages.get(timeout=pause) if pause > 0.0 else messages.get_nowait()
        except queue.Empty:
            message = None
        if isinstance(message, Ending):
            return message
        if message is None and os.getppid() != parent:
            return Ending()
        if message is not None:
            recorder.behind = not messages.empty()
            _receive(message, recorder, wrong)
        if message is None or recorder.urgent:
            recorder.idle()
        if time.monotonic() - flushed > FLUSHED_EVERY:
            with suppress(RuntimeError):  # a viewer that went away is told of at the end
                recorder.stream.flush(timeout_sec=FLUSHING)
            flushed = time.monotonic()


def _receive(message: Any, recorder: Recorder | StudyRecorder, wrong: list[str]) -> None:
    try:
        recorder.receive(*message)
    except Exception as error:  # noqa: BLE001  a picture less is better than no recording
        if not wrong:
            wrong.append(f"a {type(message[0]).__name__} could not be drawn: {type(error).__name__}: {error}")
    if isinstance(message[0], sr.RunFinished) and isinstance(recorder, Recorder):
        recorder.over = message[0].seconds if message[0].result is not None else -1.0


@final
class _WithoutPandas(MetaPathFinder):
    """pyarrow imports pandas where it is installed, for seconds and 50 MB; nothing here needs it."""

    def find_spec(self, fullname: str, path: object = None, target: object = None) -> None:
        """Nothing, but for pandas an error."""
        if fullname == "pandas":
            raise ModuleNotFoundError("pandas is left out", name=fullname)


def _settle() -> None:
    """Ignore the signals of the terminal, take one core only, and step back for everybody else."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    signal.signal(signal.SIGTERM, lambda number, frame: sys.exit(0))  # through `finally`, to the servers
    with suppress(OSError, AttributeError):
        os.nice(NICE)
        os.sched_setaffinity(0, {max(os.sched_getaffinity(0))})
    sys.stdin = None
