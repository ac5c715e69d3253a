"""Guards the end of a recording: whoever dies, and whatever the disk does, the recorder ends, and the file is whole or
is said not to be."""

from __future__ import annotations

import multiprocessing
import os
import resource
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from contextlib import suppress
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import sparserob_core as sr
from tests.support.places import ROOT
from tests.support.recordings import read, slowness, texts

pytest.importorskip("rerun", reason="a recording needs the extra rerun")
pytest.importorskip("psutil", reason="a process that is gone is told from one that is not with psutil")

from sparserob_rerun.recording import channel
from sparserob_rerun.recording import guard as guards
from sparserob_rerun.recording.guard import Guard, broken
from sparserob_rerun.recording.outlet import Outlet
from sparserob_rerun.recording.recorder import Opening
from sparserob_rerun.recording.sinks import Destinations

pytestmark = pytest.mark.skipif(not sys.platform.startswith("linux"), reason="the run is a fork of the test")

ENDING = 2.0  # seconds that a recorder may take to end after its run was killed
STARTING = 60.0  # seconds until the recorder has begun, on a busy machine
FORK: Any = multiprocessing.get_context("fork")


def opened(file: Path) -> Outlet:
    return Outlet(Opening("a run", None, None, None), Destinations(file, None, False, None))


def running(pid: int) -> bool:
    import psutil

    with suppress(psutil.NoSuchProcess):
        return bool(psutil.Process(pid).status() != psutil.STATUS_ZOMBIE)
    return False


def proof(number: int) -> sr.ProofProgress:
    return sr.ProofProgress(family=f"family{number}", cells=number, bound=0.5)


def counts(file: Path, told: Connection) -> None:
    """A run that sends an event every 50 ms, and tells when."""
    outlet, number = opened(file), 0
    told.send(outlet.process.pid)
    while True:
        outlet.send(proof(number))
        told.send((number, time.monotonic()))
        number += 1
        time.sleep(0.05)


def half(file: Path, told: Connection) -> None:
    """A run that is killed in the middle of a message, and has another child that keeps the pipe open."""
    outlet = opened(file)
    beside = FORK.Process(target=time.sleep, args=(30.0,))
    beside.start()
    told.send(outlet.process.pid)
    outlet.send(proof(0))
    told.send((0, time.monotonic()))
    time.sleep(0.7)
    os.write(outlet.sender.pipe.fileno(), (1 << 20).to_bytes(4, "big") + b"not all of it")
    told.send(beside.pid)
    time.sleep(60.0)


def started(run: Callable[[Path, Connection], None], file: Path) -> tuple[Any, Connection, int]:
    """A run, what it tells, and the process that records it, which has begun to write."""
    ours, theirs = FORK.Pipe(duplex=False)
    process = FORK.Process(target=run, args=(file, theirs))
    process.start()
    recorder = ours.recv()
    end = time.monotonic() + STARTING
    while not (file.exists() and file.stat().st_size):
        assert time.monotonic() < end and running(recorder)
        time.sleep(0.02)
    return process, ours, recorder


def ended(recorder: int) -> float:
    """Seconds until a process is gone."""
    began = time.monotonic()
    while running(recorder):
        assert time.monotonic() - began < STARTING, "the recorder is still there"
        time.sleep(0.02)
    return time.monotonic() - began


@pytest.mark.slow
@pytest.mark.parametrize("after", [0.0, 1.5])
def test_of_a_run_that_is_killed_everything_that_was_sent_a_second_before_is_in_a_whole_file(
    after: float, tmp_path: Path
) -> None:
    file = tmp_path / "x.rrd"
    run, told, recorder = started(counts, file)
    time.sleep(after)
    os.kill(run.pid, signal.SIGKILL)
    killed = time.monotonic()
    run.join()
    assert ended(recorder) < ENDING * slowness()
    sent = []
    with suppress(EOFError):
        while told.poll():
            sent.append(told.recv())
    before = [number for number, moment in sent if moment < killed - 1.0]
    assert broken(file) == ""
    log = "".join(texts(read(file)["/log"], "TextLog:text"))
    assert all(f"family{number}: {number} cells" in log for number in before)
    assert before or not after


@pytest.mark.slow
def test_half_a_message_and_a_pipe_that_others_hold_open_do_not_keep_a_recorder_alive(tmp_path: Path) -> None:
    file = tmp_path / "x.rrd"
    run, told, recorder = started(half, file)
    told.recv()
    beside = told.recv()
    try:
        os.kill(run.pid, signal.SIGKILL)
        run.join()
        assert ended(recorder) < ENDING * slowness()
    finally:
        os.kill(beside, signal.SIGKILL)
    assert broken(file) == ""
    assert any("family0: 0 cells" in line for line in texts(read(file)["/log"], "TextLog:text"))


def test_a_recorder_that_is_killed_leaves_a_file_that_is_said_not_to_be_whole(tmp_path: Path) -> None:
    outlet = opened(tmp_path / "x.rrd")
    assert outlet.process.pid is not None
    os.kill(outlet.process.pid, signal.SIGKILL)
    outlet.process.join()
    outlet.send(proof(0))
    assert any("its process ended early" in line for line in outlet.close())
    assert outlet.incomplete


def begun(file: Path) -> Outlet:
    """An outlet whose recorder has begun to write, and leaves signals to the run."""
    outlet, end = opened(file), time.monotonic() + STARTING
    while not (file.exists() and file.stat().st_size):
        assert time.monotonic() < end
        time.sleep(0.02)
    return outlet


def test_a_recorder_that_is_told_to_end_with_its_run_records_what_the_run_says_of_its_end(tmp_path: Path) -> None:
    file = tmp_path / "x.rrd"
    outlet = begun(file)
    assert outlet.process.pid is not None
    os.kill(outlet.process.pid, signal.SIGTERM)
    time.sleep(0.3)
    outlet.send(sr.RunFinished(status="undecided", message="interrupted by SIGTERM", seconds=1.0))
    assert outlet.close() == [] and broken(file) == ""
    assert "undecided: interrupted by SIGTERM" in texts(read(file)["/log"], "TextLog:text")


def test_a_recorder_that_is_told_to_end_without_its_run_ends_its_file(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(channel, "TOLD", 0.1)
    file = tmp_path / "x.rrd"
    outlet = begun(file)
    outlet.send(proof(0))
    assert outlet.process.pid is not None
    os.kill(outlet.process.pid, signal.SIGTERM)
    assert ended(outlet.process.pid) < ENDING * slowness()
    assert broken(file) == ""
    outlet.close()


def fills(file: Path, told: Connection) -> None:
    """A run whose recorder may write 80 000 bytes, and has more to write."""
    sys.dont_write_bytecode = True  # it would be cut off like the recording
    resource.setrlimit(resource.RLIMIT_FSIZE, (80_000, resource.RLIM_INFINITY))
    outlet, random = opened(file), np.random.default_rng(0)
    for number in range(40):
        outlet.send(sr.ProofProgress(family=random.bytes(2000).hex(), cells=number, bound=0.5))
        time.sleep(0.02)
    outlet.close()
    told.send(outlet.incomplete)


@pytest.mark.slow
def test_a_disk_that_is_full_in_mid_run_leaves_no_recording_that_anybody_claims(tmp_path: Path) -> None:
    file = tmp_path / "x.rrd"
    ours, theirs = FORK.Pipe(duplex=False)
    run = FORK.Process(target=fills, args=(file, theirs))
    run.start()
    assert ours.poll(STARTING)
    assert f"{file} is not a complete recording" in ours.recv()
    run.join()
    assert broken(file)


class Stalling:
    """A stream whose first flushes are too late, and that has a whole file all the same."""

    def __init__(self, late: float) -> None:
        self.late, self.flushes = late, 0

    def flush(self, timeout_sec: float) -> None:
        self.flushes += 1
        if self.flushes <= self.late:
            raise RuntimeError("Flush timed out")

    def disconnect(self) -> None:
        """Nothing is left."""


@pytest.mark.parametrize(("late", "full", "lost"), [(3, False, False), (np.inf, False, True), (1, True, True)])
def test_a_machine_that_stands_still_for_a_moment_ends_no_recording_and_a_dead_writer_is_told_of(
    late: float, full: bool, lost: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    file, stream = tmp_path / "x.rrd", Stalling(late)
    file.write_bytes(guards.TRAILER)
    monkeypatch.setattr(guards, "LOOK", 1e-3)
    if full:
        monkeypatch.setattr(guards.shutil, "disk_usage", lambda _: type("Usage", (), {"free": 0}))
    guard = Guard(file, lambda: False, lambda: None)
    guard.open(stream, alone=True)
    end = time.monotonic() + STARTING
    while stream.flushes < 3 * guards.STUCK and not guard.lost:
        assert time.monotonic() < end
        time.sleep(1e-3)
    guard.done()
    assert guard.lost == lost
    said = guard.close(0.1)
    assert (said == "") == (not lost)
    assert not lost or "nothing could be written any more (Flush timed out)" in said


@pytest.mark.slow
def test_a_command_tells_of_a_full_disk_in_one_line(tmp_path: Path) -> None:
    """In a process of its own, where the viewer's library was not imported before the recorder began; without bytecode,
    which the limit would cut off in the folders of everybody."""
    limited = (
        "import resource; from sparserob_core.experiment.cli.main import main;"
        "resource.setrlimit(resource.RLIMIT_FSIZE, (80_000, resource.RLIM_INFINITY)); main()"
    )
    config = str(ROOT / "configs" / "double_integrator.yaml")
    arguments = ["watch", config, "--save", "x.rrd", "--out", "run", "--no-figures"]
    done = subprocess.run(
        [sys.executable, "-B", "-c", limited, *arguments], cwd=tmp_path, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    assert "x.rrd is not complete: it could not be written to its end" in done.stdout
    told = done.stderr.splitlines()
    assert [line for line in told if "rrd" in line or "ERROR" in line] == [
        f"rerun: {tmp_path / 'x.rrd'} is not a complete recording: it could not be written to its end"
    ]


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="a device that is always full")
def test_a_disk_that_is_full_from_the_first_byte_is_told_of_in_one_line() -> None:
    outlet = opened(Path("/dev/full"))
    lines = outlet.close()
    assert len(lines) == 1 and "No space left on device" in lines[0]
    assert outlet.incomplete == lines[0]


def test_a_file_without_its_end_is_no_complete_recording(tmp_path: Path) -> None:
    file = tmp_path / "x.rrd"
    outlet = opened(file)
    outlet.send(proof(0))
    assert outlet.close() == [] and outlet.incomplete == "" and broken(file) == ""
    file.write_bytes(file.read_bytes()[:-20])
    assert "is not a complete recording" in broken(file)
    assert "cannot be read" in broken(tmp_path / "none.rrd")
