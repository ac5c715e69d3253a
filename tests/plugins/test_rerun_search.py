"""Guards the live view of a search: the landscape follows every weight epsilon at its values, the walk is that of the
trace, and neither a recorder nor its death changes the run."""

from __future__ import annotations

import logging
import os
import signal
import subprocess
import time
from pathlib import Path

import numpy as np
import pytest

import sparserob_core as sr
from tests.support.places import CONFIGS
from tests.support.recordings import line_of, read, rows, scalars, texts, viewer, walk_of

pytest.importorskip("rerun", reason="a recording needs the extra rerun")

FOLLOWING = 3.0  # seconds in which a landscape is to follow a weight, on a machine that has a core for it
COLUMNS = ("across", "up", "values", "anchor", "value", "sought", "epsilon", "level")


def slices(file: Path) -> tuple[np.ndarray, list[dict[str, np.ndarray]]]:
    """The landscapes of a recording, and the seconds of the run at which they were drawn."""
    chunks = read(file)["/landscape/slice"]
    seconds = [
        t for chunk in chunks for t in np.asarray(chunk.to_record_batch().column("time")).astype(np.int64).tolist()
    ]
    return np.array(seconds) / 1e9, rows(chunks, *COLUMNS)


def times_matter(directory: Path, trace: sr.SearchTrace, epsilon: float) -> bool:
    """Whether ``g``, evaluated anew, is another where the times of the best tuple of a weight are."""
    mine, inspection = trace.epsilon == epsilon, sr.Inspection.read(directory)
    width = inspection.relaxed_value(1, epsilon).slot.dimension
    slots = trace.points[mine][trace.value[mine].argmax()].reshape(-1, width)
    g, rng = inspection.relaxed_value(len(slots), epsilon), np.random.default_rng(0)
    here, values = g.at(slots), list[float]()
    for _ in range(10):
        moved = slots.copy()
        moved[:, 0] = rng.uniform(g.slot.lower[0], g.slot.upper[0], len(slots))
        values.append(g.at(moved))
    return bool(np.abs(np.array(values) - here).max() > 1e-6)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("config", "budget"),
    [("experiment1_reduced.yaml", 1500), ("experiment1_literal.yaml", 1500), ("experiment2_reduced.yaml", 1000)],
)
def test_the_landscape_follows_every_weight_and_goes_through_the_best_tuple_with_its_value(
    config: str, budget: int, tmp_path: Path
) -> None:
    changes = {
        "maximiser": {"name": "simulated_annealing", "budget": budget},
        "method.sc2": None,
        "continuation": {"start": 0.1, "stop": 0.01},
        "observers": [{"name": "rerun"}],
    }
    spent, began = time.process_time(), time.perf_counter()
    outcome = sr.run(CONFIGS / config, changes, tmp_path / "run", quiet=True, figures=False)
    # a machine that is busy with other things gives the recorder as little as the run
    slowness = max(1.0, (time.perf_counter() - began) / (time.process_time() - spent))
    trace = outcome.result.trace
    assert trace is not None
    seconds, drawn = slices(tmp_path / "run" / "recording.rrd")
    for outer in np.unique(trace.outer):
        mine = trace.outer == outer
        start, end, epsilon = trace.seconds[mine][0], trace.seconds[mine][-1], trace.epsilon[mine][0]
        inside = (seconds >= start) & (seconds <= end + FOLLOWING * slowness)
        of_it = [one for one, within in zip(drawn, inside, strict=True) if within and one["epsilon"][0] == epsilon]
        assert of_it, f"no landscape of search {outer}, epsilon {epsilon}, from {start:.1f} s to {end:.1f} s"
        first = seconds[inside & np.array([one["epsilon"][0] == epsilon for one in drawn])][0]
        assert first - start < FOLLOWING * slowness
    heights = dict[float, list[float]]()
    for one in drawn:
        values = one["values"].reshape(one["across"].size, one["up"].size)
        i = int(np.flatnonzero(one["across"] == one["anchor"][0])[0])
        j = int(np.flatnonzero(one["up"] == one["anchor"][1])[0])
        # the drawn best point has the value that the drawing shows there, and that the search has found
        assert values[i, j] == one["value"][0]
        if "literal" in config:  # the disturbances of the two that decide are at their worst on the map
            assert one["value"][0] >= one["sought"][0] - 1e-9
        else:
            assert one["value"][0] == pytest.approx(one["sought"][0], abs=1e-9)
        heights.setdefault(float(one["epsilon"][0]), []).append(float(np.ptp(values[np.isfinite(values)])))
        mine = trace.epsilon == one["epsilon"][0]
        assert (np.abs(trace.value[mine] - one["sought"][0]) <= 1e-12 * max(1.0, abs(one["sought"][0]))).any()
    # where another index of the best tuple says the same as that of an axis, moving along it changes nothing; all maps
    # of a weight are flat only where the final constraints decide alone, which no time moves
    for epsilon, found in heights.items():
        assert max(found) > 1e-6 or not times_matter(tmp_path / "run", trace, epsilon)
    walk = walk_of(trace)
    shown = line_of(read(tmp_path / "run" / "recording.rrd")["/search/g/walk"], trace)
    np.testing.assert_allclose(shown, walk, rtol=1e-6)


class Killer(sr.Observer):
    """Kills the recorder of another observer in the middle of a search."""

    def __init__(self, file: Path) -> None:
        self.file, self.killed, self.sizes = file, False, list[int]()

    def receive(self, event: sr.Event) -> None:
        import multiprocessing

        if isinstance(event, sr.EvaluationsFinished) and not self.killed and self.file.exists():
            self.sizes.append(self.file.stat().st_size)
            if event.round > 1 and event.total > 100:
                self.killed = True
                for child in multiprocessing.active_children():
                    os.kill(int(child.pid or 0), signal.SIGKILL)


@pytest.mark.slow
def test_a_recorder_that_is_killed_changes_no_bit_and_leaves_a_file_that_opens(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    changes: dict[str, object] = {"maximiser": {"name": "simulated_annealing", "budget": 800}, "method.sc2": None}
    changes |= {"continuation": {"start": 0.1, "stop": 0.01}}
    file = tmp_path / "run" / "recording.rrd"
    killer = Killer(file)
    outcome = sr.run(
        CONFIGS / "experiment1_reduced.yaml",
        {**changes, "observers": [{"name": "rerun"}]},
        tmp_path / "run",
        quiet=True,
        figures=False,
        observers=[killer],
    )
    assert killer.killed
    plain = sr.run(
        CONFIGS / "experiment1_reduced.yaml",
        {**changes, "observers": []},
        tmp_path / "plain",
        quiet=True,
        figures=False,
    )
    watched = sr.run(
        CONFIGS / "experiment1_reduced.yaml",
        {**changes, "observers": [{"name": "rerun"}]},
        tmp_path / "watched",
        quiet=True,
        figures=False,
    )
    for other in (outcome, watched):
        assert other.result.decision is not None and plain.result.decision is not None
        assert other.result.decision.tobytes() == plain.result.decision.tobytes()
        assert other.result.trace is not None and plain.result.trace is not None
        assert (other.result.trace.points == plain.result.trace.points).all()
    said = [record.getMessage() for record in caplog.records if record.levelno >= logging.WARNING]
    assert len(said) >= 1 and "its process ended early" in said[0] and "recording.rrd" in said[0]
    found = read(file)
    assert len(found["/search/g/best"]) and texts(found["/log"], "TextLog:text")
    evaluations, best = scalars(found["/search/g/best"], "evaluation")
    assert evaluations[-1] > 300
    assert (best[np.isfinite(best[:, 0]), 0] <= plain.result.trace.value.max() + 1e-12).all()
    subprocess.run([viewer(), "rrd", "stats", file], check=True, capture_output=True)


@pytest.mark.slow
def test_what_was_recorded_is_in_the_file_two_seconds_later(tmp_path: Path) -> None:
    from sparserob_rerun.recording.outlet import Outlet
    from sparserob_rerun.recording.recorder import Opening
    from sparserob_rerun.recording.sinks import Destinations

    file = tmp_path / "x.rrd"
    outlet = Outlet(Opening("kept", None, None, None), Destinations(file, None, False, None))
    try:
        outlet.send(sr.ProofProgress(family="path", cells=7, bound=0.5))
        end = time.monotonic() + 30.0  # the process has to start, on a busy machine
        lines: list[str] = []
        while time.monotonic() < end and not any("7 cells" in line for line in lines):
            time.sleep(0.5)
            if file.exists() and file.stat().st_size:
                lines = texts(read(file).get("/log", []), "TextLog:text")
        assert any("proof of path: 7 cells" in line for line in lines)
        sent = time.monotonic()
        outlet.send(sr.ProofProgress(family="path", cells=8, bound=0.5))
        while not any("8 cells" in line for line in lines) and time.monotonic() < sent + 10.0:
            time.sleep(0.1)
            lines = texts(read(file)["/log"], "TextLog:text")
        assert any("8 cells" in line for line in lines)
    finally:
        outlet.process.kill()
        outlet.close()


@pytest.mark.slow
def test_a_panel_that_fails_is_named_in_the_log_and_costs_nothing_else(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    def broken(self: sr.Landscape) -> object:
        raise ValueError("cannot reshape array of size 4 into shape (2,1)")

    monkeypatch.setattr(sr.Landscape, "evaluate", broken)  # the process that records is a copy of this one
    changes = {
        "dictionaries.control.pieces": 20,
        "dictionaries.disturbance.pieces": 20,
        "maximiser": {"name": "simulated_annealing", "budget": 60},
        "method.indices": 4,
        "continuation": {"start": 0.1, "stop": 0.1},
        "observers": [{"name": "rerun"}],
    }
    outcome = sr.run(CONFIGS / "experiment1_reduced.yaml", changes, tmp_path / "run", quiet=True, figures=False)
    found = read(tmp_path / "run" / "recording.rrd")
    log = texts(found["/log"], "TextLog:text")
    assert len([line for line in log if "the landscape could not be drawn: ValueError: cannot reshape" in line]) == 1
    assert f"**{outcome.status}**" in texts(found["/verdict"], "TextDocument:text")[-1]
    assert {"/search/g/walk", "/physics/plots/curve"} <= set(found)
    assert ["the landscape could not be drawn" in record.getMessage() for record in caplog.records] == [True]
