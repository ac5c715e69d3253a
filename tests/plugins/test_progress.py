"""The progress observer: silent for short and quiet runs, plain without a terminal, and gone afterwards."""

from __future__ import annotations

import io
from pathlib import Path

import numpy as np
import pytest

import sparserob_core as sr


class Terminal(io.StringIO):
    """A stream that says it is a terminal."""

    def isatty(self) -> bool:
        return True


def started(quiet: bool = False) -> sr.RunStarted:
    program = sr.SemiInfiniteProgram(n=1, q=np.ones(1), lower=-1.0, upper=1.0)
    return sr.RunStarted(title="a title", directory=Path(), problem=None, program=program, quiet=quiet)


def finished_round(number: int) -> sr.RoundFinished:
    return sr.RoundFinished(round=number, epsilon=0.5, lower_bound=0.25, upper_bound=np.inf, violation=1e-3, worst_family="path")


def watch(stream: io.StringIO, monkeypatch: pytest.MonkeyPatch, events: list[sr.Event], **options: object) -> str:
    monkeypatch.setattr("sys.stderr", stream)
    observer = sr.load_registry().build("observer", "progress", options)
    for event in events:
        observer.receive(event)
    return stream.getvalue()


EVENTS: list[sr.Event] = [finished_round(1), sr.ProofProgress(family="path", cells=12, bound=1e-4), finished_round(2),
                          sr.EvaluationsFinished(count=10, total=20, best_value=-0.5),
                          sr.RunFinished(status="certified", message="done", seconds=1.0)]


def test_a_verbose_run_has_one_plain_line_for_every_round(monkeypatch: pytest.MonkeyPatch) -> None:
    lines = watch(io.StringIO(), monkeypatch, [started(), *EVENTS], verbose=True).splitlines()
    assert len(lines) == 4
    assert lines[0].startswith("round 1  eps 5.0e-01  lower 0.25  upper inf  violation 1.0e-03")
    assert "12 cells open" in lines[1]
    assert "20 evaluations, best -0.5" in lines[3]


def test_a_short_run_and_a_quiet_run_show_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    assert watch(io.StringIO(), monkeypatch, [started(), *EVENTS]) == ""
    assert watch(io.StringIO(), monkeypatch, [started(quiet=True), *EVENTS], verbose=True) == ""


def test_plain_lines_come_at_most_once_a_second(monkeypatch: pytest.MonkeyPatch) -> None:
    lines = watch(io.StringIO(), monkeypatch, [started(), *(finished_round(k) for k in range(100))], patience=0.0).splitlines()
    assert len(lines) == 1


def test_on_a_terminal_the_bounds_are_live_and_disappear(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("TERM", "xterm")
    shown = watch(Terminal(), monkeypatch, [started(), *EVENTS], patience=0.0)
    assert "a title" in shown
    assert "0.25" in shown
    assert shown.count("\x1b[?25l") == shown.count("\x1b[?25h") == 1


def test_events_before_a_start_and_after_the_end_are_ignored(monkeypatch: pytest.MonkeyPatch) -> None:
    assert watch(io.StringIO(), monkeypatch, [finished_round(1), EVENTS[-1], finished_round(2)], verbose=True) == ""
