"""Guards plugins/sparserob_progress: the progress observer: silent for short and quiet runs, plain without a terminal,
and gone afterwards."""

from __future__ import annotations

import contextlib
import io
import json
import os
import re
import subprocess
import sys
import threading
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import sparserob_core as sr
from sparserob_core.testing.observers import CONFIG, METHODS
from tests.support.stub import Command

CODES = re.compile(r"\x1b\[[0-9;?]*[a-zA-Z]|\r")


class Terminal(io.StringIO):
    """A stream that says it is a terminal."""

    def isatty(self) -> bool:
        return True


class Broken(io.StringIO):
    """A stream that nobody reads any more."""

    def write(self, text: str) -> int:
        raise BrokenPipeError("nobody reads this")


def started(quiet: bool = False) -> sr.RunStarted:
    program = sr.SemiInfiniteProgram(n=1, q=np.ones(1), lower=-1.0, upper=1.0)
    return sr.RunStarted(title="a title", directory=Path(), problem=None, program=program, quiet=quiet)


def finished_round(number: int, **fields: object) -> sr.RoundFinished:
    return sr.RoundFinished(
        round=number, epsilon=0.5, lower_bound=0.25, upper_bound=np.inf, violation=1e-3, worst_family="path", **fields
    )  # type: ignore[arg-type]


ROUND = finished_round(2, cost=0.75, active_indices=7, relaxed_programs=30, seconds=2.0)
PROOF = sr.ProofProgress(family="path", cells=12, bound=1e-4, examined=100, budget=1000, seconds=0.5)
SEARCH = sr.EvaluationsFinished(
    count=4,
    total=20,
    best_value=-0.5,
    seconds=2.0,
    budget=50,
    round=3,
    lower_bound=0.5,
    batch=sr.Batch(
        points=[np.zeros((5, 1))],
        values=[np.array([1.0, 2.0, 2.0, 1.0, 1.5])],  # the third changes nothing, though it is accepted
        moments=[(5, 2.0)],
        notes={
            "accepted": [(16, 0.0), (17, 1.0), (18, 1.0), (19, 0.0), (20, 0.0)],
            "temperature": [(20, 0.125)],
        },
        first=15,
        stood=0.0,
    ),
)
ENDING = sr.RunFinished(status="certified", message="done", seconds=1.0)


def observer(stream: io.StringIO, monkeypatch: pytest.MonkeyPatch, **options: object) -> sr.Observer:
    monkeypatch.setattr("sys.stderr", stream)
    monkeypatch.setenv("TERM", "xterm")
    made: sr.Observer = sr.load_registry().build("observer", "progress", options)
    return made


def until(said: Callable[[], bool]) -> None:
    deadline = time.monotonic() + 20.0
    while not said():
        assert time.monotonic() < deadline, "waited in vain"
        time.sleep(0.01)


def watch(stream: io.StringIO, monkeypatch: pytest.MonkeyPatch, events: list[sr.Event], **options: object) -> str:
    watching = observer(stream, monkeypatch, **options)
    for event in events:
        watching.receive(event)
    watching.close()
    return stream.getvalue()


def test_a_verbose_run_has_one_plain_line_for_every_event(monkeypatch: pytest.MonkeyPatch) -> None:
    lines = watch(
        io.StringIO(), monkeypatch, [started(), ROUND, PROOF, SEARCH, sr.Event(), ENDING], verbose=True
    ).splitlines()
    assert [line.partition("s  ")[2] for line in lines] == [
        (
            "round 2  cost 0.75  violation 1.0e-03 in path  eps 5.0e-01  lower 0.25  upper unknown  7 cuts  30 relaxed"
            " programs at 15/s"
        ),
        "proof of path  cells open 12  100 examined at 200/s  violation not excluded 1.0e-04",
        "search 3  best g -0.5  20 of 50 evaluations  10/s  3.0 s left  accepted 25%  temperature 0.125",
    ]


def test_the_phase_is_named_and_what_is_proven(monkeypatch: pytest.MonkeyPatch) -> None:
    from sparserob_progress.status import Status

    status, said = Status("a title"), []
    assert status.line().endswith("phase relax")
    figures = sr.StudyProgress(text="figures: the worst cases", phase=True)
    study = sr.StudyProgress(text="3 of 7 loops", done=3, total=7)
    stage = sr.StageProgress(text="weighted program 2 of at most 10: round 3, 7 cuts")
    for event in (ROUND, PROOF, SEARCH, stage, finished_round(3, proven=0.5), figures, study):
        status.receive(event)
        said.append(dict(status.parts()).get("phase"))
    assert said == ["relax", "proof", "search", "weighted program 2 of at most 10", "relax", "figures", None]
    assert "proven a control of cost 0.5" in status.line()
    assert "proven 0.5" in status.last(finished_round(3, proven=0.5))
    assert status.last(figures) == "figures: the worst cases"
    assert status.last(stage) == stage.text
    status.receive(stage)
    assert status.line().endswith(f"now {stage.text}")


@pytest.mark.parametrize(
    ("method", "stages"),
    [
        ("sparsest", ["least cost, to compare with"]),
        ("reweighted", ["weighted program 1 of at most 10"]),
    ],
)
def test_programs_beside_the_one_whose_rounds_are_told_are_told_as_stages(method: str, stages: list[str]) -> None:
    said: list[sr.Event] = []
    A, b = np.array([[3.0, 2.0, 1.0, 1.0], [1.0, 2.0, 3.0, 1.0]]), np.array([2.5, 2.5])
    program = sr.SemiInfiniteProgram(
        n=4, weights=np.array([1.0, 1.1, 1.0, 0.6]), lower=-1.0, upper=1.0, G=-A, h=-b, activity=np.ones(4)
    )
    sr.solve(program, method=method, notify=said.append)
    told = [event.text for event in said if isinstance(event, sr.StageProgress)]
    begun = [text.partition(":")[0] for text in told]
    assert [stage for stage in stages if stage not in begun] == []
    assert any(text.endswith("cuts") for text in told)


def test_the_upper_bound_is_said_to_be_proven_once_it_is() -> None:
    from sparserob_progress.status import Status

    status = Status("a title")
    suggested = replace(finished_round(2, gap=0.5), upper_bound=0.5)
    status.receive(suggested)
    assert "upper 0.5 (to be proven)" in status.line()
    status.receive(replace(suggested, proven=0.75))
    assert "upper 0.5 (to be proven)" in status.line()
    assert "proven a control of cost 0.75; a better one is sought" in status.line()
    status.receive(replace(suggested, proven=0.5))
    assert "upper 0.5 (proven)" in status.line()


@pytest.mark.parametrize(("upper", "said"), [(0.75, "upper 0.75 (proven)"), (np.inf, "upper unknown")])
def test_after_the_method_the_bounds_are_those_of_its_result(upper: float, said: str) -> None:
    from sparserob_progress.status import Status

    status = Status("a title")
    status.receive(replace(finished_round(2, proven=0.8), upper_bound=0.5))
    ended = sr.Result(status="verified", message="", lower_bound=0.25, upper_bound=upper)
    status.receive(sr.StudyProgress(text="certificate: what the multipliers prove", phase=True, result=ended))
    assert said in status.line()
    assert "to be proven" not in status.line()
    assert "is sought" not in status.line()


def test_a_short_run_and_a_quiet_run_show_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    for stream in (io.StringIO(), Terminal()):
        assert watch(stream, monkeypatch, [started(), ROUND, SEARCH, ENDING]) == ""
        assert watch(stream, monkeypatch, [started(quiet=True), ROUND, SEARCH, ENDING], verbose=True) == ""
        assert watch(stream, monkeypatch, [started(quiet=True), ROUND, SEARCH, ENDING], patience=0.0) == ""


def test_without_a_terminal_there_is_one_plain_line_in_five_seconds(monkeypatch: pytest.MonkeyPatch) -> None:
    stream = io.StringIO()
    watching = observer(stream, monkeypatch, patience=0.0)
    watching.receive(started())
    for number in range(100):
        watching.receive(finished_round(number))
        time.sleep(1e-3)
    watching.close()
    assert len(stream.getvalue().splitlines()) <= 1


def test_plain_lines_say_everything_that_is_known(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("sparserob_progress.screen.PLAIN_EVERY", 0.01)
    stream = io.StringIO()
    watching = observer(stream, monkeypatch, patience=0.0)
    for event in (started(), ROUND, SEARCH):
        watching.receive(event)
    until(lambda: "best g" in stream.getvalue())
    watching.receive(finished_round(4, simplified=True))
    until(lambda: "simplified" in stream.getvalue())
    watching.receive(ENDING)
    lines = stream.getvalue().splitlines()
    both = next(line for line in lines if "best g" in line)
    for said in (
        "lower 0.5",
        "upper unknown",
        "round 2",
        "cost 0.75",
        "best g -0.5",
        "20 of 50 evaluations",
        "10/s",
        "3.0 s left",
    ):
        assert said in both
    assert "\x1b" not in stream.getvalue()


@pytest.mark.slow
def test_on_a_terminal_the_bounds_are_live_and_disappear(monkeypatch: pytest.MonkeyPatch) -> None:
    stream = Terminal()
    watching = observer(stream, monkeypatch, patience=0.0)
    for event in (started(), finished_round(1, relaxed_programs=3, seconds=1.0), SEARCH):
        watching.receive(event)
    until(lambda: "best g" in stream.getvalue())
    watching.receive(PROOF)
    until(lambda: "cells open" in stream.getvalue())
    watching.receive(ENDING)
    shown = stream.getvalue()
    assert "a title" in shown
    assert shown.count("\x1b[?25l") == shown.count("\x1b[?25h") == 1, "the cursor is shown again"
    before, _, after = shown.rpartition("\x1b[?25h")
    assert "cells open" in before
    assert not CODES.sub("", after).strip()


def test_time_goes_on_while_nothing_is_heard(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("sparserob_progress.screen.DRAWN_EVERY", 0.05)
    stream = Terminal()
    watching = observer(stream, monkeypatch, patience=0.0)
    watching.receive(started())
    until(lambda: len(set(re.findall(r"a title[^0-9]*([0-9.]+) s", CODES.sub("", stream.getvalue())))) >= 3)
    watching.close()


def test_a_stream_that_nobody_reads_is_told_as_the_observers_failure(monkeypatch: pytest.MonkeyPatch) -> None:
    watching = observer(Broken(), monkeypatch, patience=0.0)
    watching.receive(started())
    until(lambda: not any(thread.name == "sparserob progress" for thread in threading.enumerate()))
    with pytest.raises(BrokenPipeError, match="nobody reads this"):
        watching.receive(ROUND)


def test_events_before_a_start_and_after_the_end_are_ignored(monkeypatch: pytest.MonkeyPatch) -> None:
    assert watch(io.StringIO(), monkeypatch, [ROUND, ENDING, SEARCH], verbose=True) == ""


@pytest.mark.parametrize(
    ("seconds", "said"), [(0.04, "0.0 s"), (12.34, "12.3 s"), (245.2, "4 min 05 s"), (7384.0, "2 h 03 min")]
)
def test_a_duration_is_written_in_few_figures(seconds: float, said: str) -> None:
    from sparserob_progress.status import duration

    assert duration(seconds) == said


@pytest.fixture
def small(tmp_path: Path) -> None:
    """A small search that is watched from its first moment on."""
    watched = {**CONFIG, **METHODS["sparserob"], "observers": [{"name": "progress", "patience": 0.0}]}
    (tmp_path / "small.yaml").write_text(json.dumps(watched))


def on_terminal(tmp_path: Path, *arguments: str) -> tuple[subprocess.CompletedProcess[str], str]:
    """``sparserob run`` in a process of its own, and all that its standard error stream showed on a terminal."""
    reading, terminal = os.openpty()
    shown = bytearray()

    def read() -> None:
        # A full terminal lets the writer wait. At its end some systems read nothing, others fail.
        with contextlib.suppress(OSError):
            while part := os.read(reading, 1 << 16):
                shown.extend(part)

    reader = threading.Thread(target=read)
    reader.start()
    try:
        done = subprocess.run(
            [sys.executable, "-m", "sparserob_core", "run", "small.yaml", "--no-figures", *arguments],
            cwd=tmp_path,
            text=True,
            stdout=subprocess.PIPE,
            stderr=terminal,
            timeout=120,
            check=False,
            env={**os.environ, "TERM": "xterm"},
        )
    finally:
        os.close(terminal)
        reader.join()
        os.close(reading)
    return done, shown.decode()


@pytest.mark.slow
@pytest.mark.skipif(sys.platform == "win32", reason="needs a pseudo-terminal")
@pytest.mark.usefixtures("small")
def test_on_a_real_terminal_it_shows_and_clears_its_lines_and_quiet_and_json_silence_it(tmp_path: Path) -> None:
    shown = {}
    for arguments in ((), ("--quiet",), ("--json",)):
        done, shown[arguments] = on_terminal(tmp_path, *arguments)
        assert done.returncode in (0, 4)
        assert (arguments == ("--quiet",)) == (done.stdout == "")
        if arguments == ("--json",):
            assert json.loads(done.stdout)["title"] == "A double integrator"
    assert "A double integrator" in shown[()]
    assert shown[()].count("\x1b[?25l") == shown[()].count("\x1b[?25h") == 1
    assert (shown["--quiet",], shown["--json",]) == ("", "")


@pytest.mark.slow
@pytest.mark.usefixtures("small")
def test_without_a_terminal_quiet_and_json_leave_the_error_stream_empty(command: Command) -> None:
    plain = command("run", "small.yaml", "--no-figures").stderr
    assert plain
    assert "\x1b" not in plain
    for option in ("--quiet", "--json"):
        assert command("run", "small.yaml", "--no-figures", option).stderr == ""


@pytest.mark.parametrize("quiet", [False, True])
def test_what_can_never_be_certified_is_said_at_the_start(quiet: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    stream = io.StringIO()
    watching = observer(stream, monkeypatch)
    watching.receive(replace(started(quiet), unprovable="its sets are curved"))
    watching.close()
    said = "no control of this problem can be certified: its sets are curved" in stream.getvalue()
    assert said is not quiet
