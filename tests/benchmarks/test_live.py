"""Guards speed: what a recording costs the run that it records: the same 10 000 evaluations of g with and without, turn
by turn."""

from __future__ import annotations

import multiprocessing
import resource
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
from threadpoolctl import threadpool_limits

import sparserob_core as sr
from sparserob_core.experiment.run import inspection
from tests.support.places import CONFIGS

psutil = pytest.importorskip(
    "psutil", reason="the memory of another process is read with psutil, which comes with rerun-sdk"
)
pytest.importorskip("rerun", reason="a recording needs the extra rerun")

CONFIG = CONFIGS / "experiment1_reduced.yaml"
EVALUATIONS, TURNS = 10_000, 2
RECORDER = 0.4  # of the solver's processor time, what the process that records may take at most
SEARCH = {
    "maximiser.name": "simulated_annealing",
    "maximiser.budget": EVALUATIONS,
    "method.sc2": None,
    "method.indices": 20,
    "continuation": {"start": 1e-3, "stop": 9e-4, "factor": 0.95},
    "method.regu": None,
    "method.sc1": {"name": "optimisers_settle", "tolerance": 1e9},
    "observers": [],
}


class Timed(sr.Observer):
    """Another observer: its processor time in the solver's thread, and how many seconds the end takes by the clock."""

    def __init__(self, observer: sr.Observer) -> None:
        self.observer, self.seconds, self.events, self.closing = observer, 0.0, 0, 0.0

    def receive(self, event: sr.Event) -> None:
        started, clock = time.thread_time(), time.perf_counter()
        self.observer.receive(event)
        self.seconds += time.thread_time() - started
        self.events += 1
        if isinstance(event, sr.RunFinished):
            self.closing = time.perf_counter() - clock

    def close(self) -> None:
        self.observer.close()


@dataclass(frozen=True)
class Measured:
    """Seconds by the clock, of the processor in the solver's thread, in those beside it and in the process that
    records, and the outcome."""

    wall: float
    own: float
    beside: float
    recorder: float
    outcome: sr.Outcome


@contextmanager
def peak_of_children() -> Iterator[list[float]]:
    """The most memory, in MB, that the processes of this one held of their own at any time; and the processor time that
    the looking took so far."""
    peak, over = [0.0, 0.0], threading.Event()

    def look() -> None:
        while not over.wait(3.0):
            for child in multiprocessing.active_children():
                try:
                    peak[0] = max(peak[0], psutil.Process(child.pid).memory_full_info().uss / 1e6)
                except psutil.Error:
                    continue
            peak[1] = time.thread_time()

    watcher = threading.Thread(target=look, daemon=True)
    watcher.start()
    yield peak
    over.set()
    watcher.join()


def measured(directory: Path, looking: list[float], *observers: sr.Observer) -> Measured:
    wall, work, own, looked = time.perf_counter(), time.process_time(), time.thread_time(), looking[1]
    ended = of_ended_children()
    outcome = sr.run(CONFIG, SEARCH, directory, quiet=True, figures=False, observers=observers)
    own = time.thread_time() - own
    beside = time.process_time() - work - own - (looking[1] - looked)
    return Measured(time.perf_counter() - wall, own, max(0.0, beside), of_ended_children() - ended, outcome)


def of_ended_children() -> float:
    """Seconds of the processor that processes of this one took that have ended, with whatever they started."""
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    return used.ru_utime + used.ru_stime


@pytest.mark.benchmark
def test_a_recording_costs_a_run_of_ten_thousand_evaluations_less_than_two_per_cent_and_200_megabytes(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """The processor time that the recording takes in the process of the run, in the solver's thread and beside it, as a
    share of the solver's own. By the clock the end is added, which takes as long whatever the run; the difference of
    two runs by the clock says as much about the other users of the machine, and no more is asked of it than that it
    hides among theirs.
    """
    plain: list[Measured] = []
    recorded: list[tuple[Measured, Timed]] = []
    with peak_of_children() as peak, threadpool_limits(limits=1):
        for turn in range(TURNS):
            plain.append(measured(tmp_path / f"plain{turn}", peak))
            timed = Timed(sr.load_registry().build("observer", "rerun"))
            recorded.append((measured(tmp_path / f"recorded{turn}", peak, timed), timed))
            traces = [one.outcome.result.trace for one in (plain[-1], recorded[-1][0])]
            assert traces[0] is not None and traces[1] is not None and traces[0].value.size >= EVALUATIONS
            assert (traces[0].value == traces[1].value).all()
    own, fastest = min(one.own for one in plain), min(one.wall for one in plain)
    share = min(timed.seconds + one.beside for one, timed in recorded) / own
    more = min(one.own for one, _ in recorded) / own - 1.0
    recorder = min(one.recorder for one, _ in recorded)
    clock = min(one.wall for one, _ in recorded) / fastest - 1.0
    noise = max(one.wall for one in plain) / fastest - 1.0
    with capsys.disabled():
        print(
            f"\nwithout {[f'{one.wall:.2f}' for one in plain]} s, with {[f'{one.wall:.2f}' for one, _ in recorded]} s: "
            f"{100 * clock:+.2f} % by the clock (runs without differ by {100 * noise:.2f} %)"
        )
        for one, timed in recorded:
            print(
                f"processor time: {timed.seconds:.3f} s of the solver's thread for {timed.events} events,"
                f" {one.beside:.3f} s beside it, of {own:.2f} s; the end takes {timed.closing:.2f} s by the clock"
            )
        print(f"in all {100 * share:.2f} %; the solver's thread takes {100 * more:+.1f} % with the view")
        print(f"the process that records takes {recorder:.1f} s, {100 * recorder / own:.0f} %, and {peak[0]:.0f} MB")
    assert share < 0.02
    assert clock < 0.02 + noise
    assert 0.0 < recorder < RECORDER * own
    assert 0.0 < peak[0] < 200.0


@pytest.mark.benchmark
def test_a_map_of_literal_tuples_builds_the_rows_of_its_lines_once(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The last map of a run is what it waits for at its end; where every value builds its rows again, the map takes
    1.4 times as long."""
    short = {"maximiser.budget": 100, "continuation": {"start": 1.0, "stop": 0.9, "factor": 0.95}}
    run = sr.run(CONFIGS / "experiment1_literal.yaml", short, tmp_path / "run", quiet=True, figures=False)
    view = sr.Inspection.read(run.directory)
    box = view.relaxed_value(1, 1.0).slot
    anchor = np.random.default_rng(0).uniform(box.lower, box.upper, (20, box.dimension))
    seconds = {True: np.inf, False: np.inf}
    for turn in range(6):
        kept = turn % 2 == 0
        with monkeypatch.context() as patch:
            if not kept:
                patch.setattr(inspection, "_remember_rows", lambda family: family)
            g = view.relaxed_value(len(anchor), 1e-3)
            axes = sr.LandscapeAxes.over(g, len(anchor))
            assert axes is not None
            landscape = sr.Landscape(g, anchor, *axes.places(sr.deciding_pair(g, anchor), anchor), 33, 1e-3, axes)
            started = time.process_time()
            list(landscape.evaluate())
            seconds[kept] = min(seconds[kept], time.process_time() - started)
    assert seconds[True] < 0.85 * seconds[False], seconds
