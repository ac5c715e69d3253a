"""Guards plugins/sparserob_rerun: the recording of a run, read back; and what is missing on a machine never hurts the
run."""

from __future__ import annotations

import json
import logging
import os
import shutil
import socket
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import sparserob_core as sr
from sparserob_core.experiment.cli.main import main
from tests.support.places import CONFIGS
from tests.support.recordings import line_of, properties, read, scalars, texts, viewer, walk_of
from tests.support.stub import STUB

pytest.importorskip("rerun", reason="a recording needs the extra rerun")

SEARCH = {
    "dictionaries.control.pieces": 20,
    "dictionaries.disturbance.pieces": 20,
    "maximiser.budget": 60,
    "method.indices": 4,
    "continuation": {"start": 0.1, "stop": 0.001},
}
QUICK = {"dictionaries.control.pieces": 50, "dictionaries.disturbance.pieces": 50}
SMALL = {"name": "rerun", "landscape": {"grid": 8, "evaluations": 200}}


def recorded(directory: Path, config: str, changes: dict[str, object], **options: object) -> sr.Outcome:
    return sr.run(
        CONFIGS / config, {**changes, "observers": [{**SMALL, **options}]}, directory, quiet=True, figures=False
    )


@pytest.fixture(scope="module")
def searched(tmp_path_factory: pytest.TempPathFactory) -> sr.Outcome:
    """A recorded search over tuples."""
    changes = {**SEARCH, "maximiser.name": "simulated_annealing"}
    with pytest.MonkeyPatch.context() as patch:  # a busy machine leaves out no picture
        for limit in ("LATE", "CATCHING_UP"):
            patch.setattr(f"sparserob_rerun.recording.recorder.{limit}", np.inf)
        return recorded(tmp_path_factory.mktemp("search") / "run", "experiment1_reduced.yaml", changes)


@pytest.fixture(scope="module")
def exchanged(tmp_path_factory: pytest.TempPathFactory) -> sr.Outcome:
    """A recorded exchange that ends certified."""
    # it waits, so that a busy machine leaves out no picture
    return recorded(tmp_path_factory.mktemp("exchange") / "run", "experiment1_repaired.yaml", QUICK, waits=True)


@pytest.fixture(scope="module")
def answered(tmp_path_factory: pytest.TempPathFactory) -> sr.Outcome:
    """A recorded run whose control answers what it measures."""
    small = {"dictionaries.control.pieces": 10, "problem.disturbance.box": [0.15, 0.15]}
    return recorded(tmp_path_factory.mktemp("answered") / "run", "experiment1_feedback.yaml", small)


FEEDBACK = {"/feedback/gains/u1_x1", "/feedback/gains/u1_x2", "/feedback/answers/u1", "/feedback/frames/frame"}


@pytest.mark.slow
def test_gains_answers_and_effort_of_a_policy_are_in_the_recording(answered: sr.Outcome) -> None:
    found = read(answered.directory / "recording.rrd")
    assert set(found) >= FEEDBACK
    control = scalars(found["/signals/control"], "t")[1][:, 0]
    least, most = scalars(found["/signals/control/range1"], "t")[1].T
    assert (least <= control + 1e-12).all() and (control <= most + 1e-12).all()
    low, middle, high, largest = scalars(found["/signals/effort/u1"], "t")[1].T
    assert (low <= middle).all() and (middle <= high).all() and (high <= largest + 1e-12).all()
    assert largest == pytest.approx(np.maximum(np.abs(least), np.abs(most)))


@pytest.mark.slow
def test_a_policy_that_is_shown_again_has_the_same_pictures(answered: sr.Outcome, tmp_path: Path) -> None:
    again = tmp_path / "again.rrd"
    assert command("replay", str(answered.directory), "--save", str(again)) == 0
    first, second = read(answered.directory / "recording.rrd"), read(again)
    assert set(second) >= {*FEEDBACK, "/landscape/map/g"}
    assert not [line for line in texts(second["/log"], "TextLog:text") if "no landscape" in line]
    one, other = (scalars(part["/signals/effort/u1"], "t")[1] for part in (first, second))
    np.testing.assert_array_equal(one, other)


def test_a_gain_is_drawn_where_it_is_seen_and_answered() -> None:
    from sparserob_rerun.physics.feedback import PIXELS, spread_out

    table = np.arange(9.0).reshape(3, 3)
    shown = spread_out(table, np.array([0.0, 1.0, 2.0, 4.0]))
    assert shown.shape == (PIXELS, PIXELS)
    assert shown[0, 0] == 6.0 and shown[0, -1] == 8.0 and shown[-1, 0] == 0.0  # the last piece is at the top
    assert np.isnan(shown[-1, -1])  # not measured yet
    assert (shown == 8.0).sum() == (PIXELS // 2) ** 2  # the last piece takes half of the time


@pytest.mark.slow
def test_every_evaluation_is_in_the_recording_with_the_value_that_the_trace_has(searched: sr.Outcome) -> None:
    trace = searched.result.trace
    assert trace is not None and trace.value.size > 60
    found = read(searched.directory / "recording.rrd")
    numbers = np.arange(1, trace.value.size + 1)
    tried, values = scalars(found["/search/g/tried"], "evaluation")
    refused, others = scalars(found["/search/g/refused"], "evaluation")
    assert not set(tried) & set(refused)
    assert (np.union1d(tried, refused) == numbers[np.isfinite(trace.value)]).all()
    assert (values[:, 0] == trace.value[tried - 1]).all() and (others[:, 0] == trace.value[refused - 1]).all()
    assert (refused == numbers[trace.notes["accepted"] == 0.0]).all()
    best = np.concatenate(
        [np.maximum.accumulate(trace.value[trace.outer == outer]) for outer in np.unique(trace.outer)]
    )
    np.testing.assert_allclose(line_of(found["/search/g/best"], trace), best, rtol=1e-7)
    proven = scalars(found["/search/g/bound"], "evaluation")[1][:, 0]
    proven = proven[np.isfinite(proven)]
    assert (np.diff(proven) >= 0).all()
    # of the bound that is written, what rounding may do to it is subtracted once more
    assert proven.max() <= searched.result.lower_bound + 1e-12 * searched.result.cost_scale


@pytest.mark.slow
def test_the_walk_has_the_values_of_the_trace_and_steps_to_what_was_accepted(searched: sr.Outcome) -> None:
    trace = searched.result.trace
    assert trace is not None
    walk = walk_of(trace)
    shown = line_of(read(searched.directory / "recording.rrd")["/search/g/walk"], trace)
    assert np.isfinite(walk).sum() > 100
    np.testing.assert_allclose(shown, walk, rtol=1e-7)
    accepted = trace.notes["accepted"] > 0.0
    assert (walk[accepted] == trace.value[accepted]).all()


@pytest.mark.slow
def test_rounds_have_the_bounds_of_the_history_on_all_three_timelines(exchanged: sr.Outcome) -> None:
    chunks = read(exchanged.directory / "recording.rrd")["/rounds/bounds"]
    assert all({"evaluation", "round", "time"} <= set(chunk.timeline_names) for chunk in chunks)
    rounds, values = scalars(chunks, "round")
    history = exchanged.result.history
    assert rounds.tolist() == [entry.round for entry in history]
    assert (values[:, 0] == [entry.lower_bound for entry in history]).all()
    assert values[-1, 1] == history[-1].upper_bound
    assert np.isnan(values[0, 1])


@pytest.mark.first(1)
@pytest.mark.parametrize("kind", ["searched", "exchanged"])
def test_nothing_that_a_run_has_to_show_is_missing(kind: str, request: pytest.FixtureRequest) -> None:
    outcome = request.getfixturevalue(kind)
    found = read(outcome.directory / "recording.rrd")
    common = {
        "/physics/plots/curve",
        "/physics/plots/tube",
        "/physics/plots/wall",
        "/physics/phase/curve",
        "/landscape/map/g",
        "/landscape/surface/g",
        "/rounds/log10",
        "/violation/plots/curve",
        "/log",
        "/verdict",
        "/signals/control",
        "/signals/states/x1",
    }
    search = {
        "/search/g/walk",
        "/landscape/map/bar",
        "/landscape/words",
        "/search/notes/temperature",
        "/search/notes/accepted",
        "/search/moves/t",
        "/landscape/map/best",
    }
    assert common | (search if kind == "searched" else set()) <= set(found)
    rows = sum(chunk.num_rows for chunk in found["/physics/plots/curve"])
    if kind == "exchanged":  # what is as it was is not sent again
        assert 2 <= rows <= len(outcome.result.history) + 1
    else:  # the control of the best tuple so far is there from the first evaluations on
        first = min(
            np.asarray(chunk.to_record_batch().column("evaluation")).min() for chunk in found["/physics/plots/curve"]
        )
        assert rows > 1 and first < outcome.result.trace.value.size
    assert texts(found["/state"], "StateChange:state")[-1] == outcome.result.status
    for path in ("/landscape/words", "/verdict", "/decisions", "/state"):  # from the beginning on
        records = [chunk.to_record_batch() for chunk in found[path]]
        assert min(np.asarray(one.column("time")).astype(np.int64).min() for one in records) == 0


def test_a_recording_has_a_name_and_says_of_what_it_is_and_how_it_ended(exchanged: sr.Outcome) -> None:
    said = properties(exchanged.directory / "recording.rrd")
    result = exchanged.result
    assert said["title"] == json.loads(said["config"])["title"] and said["name"] == f"exchange, seed 0: {said['title']}"
    assert said["status"] == "certified" and said["cost"] == result.cost and said["lower_bound"] == result.lower_bound
    assert json.loads(said["config"])["problem"]["name"] == "linear" and said["seed"] == 0


def test_two_searches_of_one_problem_are_told_apart_by_the_first_words_of_their_names(searched: sr.Outcome) -> None:
    said = properties(searched.directory / "recording.rrd")
    config = json.loads(said["config"])
    assert said["name"] == f"{config['maximiser']['name']}, seed {said['seed']}: {said['title']}"


def test_what_is_arranged_otherwise_has_another_place_in_the_viewer() -> None:
    from sparserob_rerun.options import LandscapeOptions
    from sparserob_rerun.recording.recorder import shown_of

    configs = ["experiment1_repaired", "experiment1_reduced", "experiment1_feedback", "atv_box", "experiment2_repaired"]
    seen = [shown_of(inspection(f"{config}.yaml", {}), LandscapeOptions()) for config in configs]
    names = [one.application for one in seen]
    assert len(set(names)) == len(names) and all(name.startswith("sparserob ") for name in names)
    assert names[1] == replace(seen[1], told=frozenset({"depth"}), stages=((0, 1.0, 0.0),)).application


def test_the_chunks_of_a_recording_are_as_few_as_the_format_wants_and_nothing_is_lost(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    import rerun as rr
    import rerun.blueprint as rrb
    from rerun.chunk import RrdReader

    from sparserob_rerun.recording import sinks

    def screen(name: str) -> Any:
        return rrb.Blueprint(rrb.TimeSeriesView(origin="/here", name=name), auto_views=False)

    file = tmp_path / "x.rrd"
    stream = rr.RecordingStream("sparserob test", recording_id="one")
    stream.set_sinks(rr.FileSink(str(file)), default_blueprint=screen("first"))
    stream.send_blueprint(screen("second"))
    for number in range(300):
        stream.set_time("evaluation", sequence=number)
        stream.log("here", rr.Scalars(float(number)))
        if number % 10 == 0:
            stream.flush(timeout_sec=5.0)
    stream.disconnect()
    before, size = read(file)["/here"], file.stat().st_size
    monkeypatch.setattr(sinks, "viewer", lambda: Path("nowhere"))
    sinks.compact(file, screen("last"))
    assert file.stat().st_size == size  # what cannot be joined stays as it is
    monkeypatch.undo()
    sinks.compact(file, screen("last"))
    (arrangement,) = (reader := RrdReader(str(file))).blueprints()  # those before it are gone, which take most of it
    shown = [str(chunk.to_record_batch().to_pydict()) for chunk in reader.stream(store=arrangement)]
    assert any("last" in one for one in shown) and not any("second" in one for one in shown)
    after = read(file)["/here"]
    assert len(before) >= 20 and len(after) <= 2 and file.stat().st_size < 0.5 * size
    assert [path.name for path in tmp_path.iterdir()] == ["x.rrd"]
    for one, other in zip(scalars(before, "evaluation"), scalars(after, "evaluation"), strict=True):
        np.testing.assert_array_equal(one, other)


@pytest.mark.first(1)
@pytest.mark.parametrize("before", ["import rerun", ""])
def test_a_recorder_writes_nothing_to_the_terminal(before: str, tmp_path: Path) -> None:
    """Whether or not the run's own process has imported the viewer's library, which then logs as it does by itself."""
    config = str(CONFIGS / "double_integrator.yaml")
    recording = {**QUICK, "observers": [{**SMALL, "save": str(tmp_path / "x.rrd")}]}
    program = (
        f"{before}\nimport sparserob_core as sr\nsr.run({config!r}, {recording!r}, 'run', quiet=True, figures=False)"
    )
    environment = {name: value for name, value in os.environ.items() if name != "RUST_LOG"}
    done = subprocess.run(
        [sys.executable, "-c", program], cwd=tmp_path, env=environment, capture_output=True, text=True, check=True
    )
    assert (done.stdout, done.stderr) == ("", "")
    assert len(read(tmp_path / "x.rrd")["/rounds/bounds"]) == 1  # its chunks were joined


def test_the_last_page_and_the_log_tell_the_verdict(exchanged: sr.Outcome) -> None:
    found = read(exchanged.directory / "recording.rrd")
    assert "**certified**" in texts(found["/verdict"], "TextDocument:text")[-1]
    assert any(line.startswith("certified") for line in texts(found["/log"], "TextLog:text"))
    added = [line for line in texts(found["/log"], "TextLog:text") if line.startswith("+ ")]
    assert len(added) >= len(exchanged.result.indices)


def test_the_signals_are_the_control_and_the_tube_of_the_figures(exchanged: sr.Outcome) -> None:
    found = read(exchanged.directory / "recording.rrd")
    times, control = scalars(found["/signals/control"], "t")
    assert exchanged.control is not None
    assert (control[:, 0] == exchanged.control[0]).all()
    assert (np.diff(times) > 0).all()
    _, state = scalars(found["/signals/states/x1"], "t")
    assert (state[:, 1] <= state[:, 0] + 1e-12).all() and (state[:, 0] <= state[:, 2] + 1e-12).all()


def test_the_control_acts_just_where_the_push_of_the_active_constraints_leaves_the_band(exchanged: sr.Outcome) -> None:
    view = sr.Inspection.read(exchanged.directory)
    assert exchanged.control is not None
    push = sr.Switching(view.program, view.row).evaluate(exchanged.result.indices, None)
    _acts_beyond(push, exchanged.control)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("config", "changes"),
    [
        ("double_integrator_feedback.yaml", {}),
        ("experiment1_scenario.yaml", {"dictionaries.control.pieces": 50, "dictionaries.disturbance.pieces": 50}),
    ],
)
def test_of_policies_and_scenarios_too_the_push_says_why_the_control_switches(
    config: str, changes: dict[str, object]
) -> None:
    outcome = sr.run(CONFIGS / config, changes, None, quiet=True, figures=False)
    view = inspection(config, changes)
    switching = sr.Switching(view.program, view.row)
    cuts = outcome.result.dual.cuts if outcome.program.spread is not None else outcome.result.indices
    assert outcome.result.decision is not None
    _acts_beyond(switching.evaluate(cuts, None), outcome.result.decision[: switching.pieces].reshape(1, -1))


def _acts_beyond(push: np.ndarray | None, control: np.ndarray) -> None:
    assert push is not None
    acts = np.abs(control) > 1e-6
    assert acts.any() and not acts.all()
    assert (np.abs(push[acts]) > 1.0 - 1e-4).all()
    assert (np.abs(push[~acts]) < 1.0 + 1e-4).all()
    assert (np.sign(push[acts]) == np.sign(control[acts])).all()


def inspection(config: str = "experiment1_reduced.yaml", changes: dict[str, object] = SEARCH) -> sr.Inspection:
    from sparserob_core.experiment.config.load import load_config

    return sr.Inspection(load_config(CONFIGS / config, changes))


def landscape_up(landscape: sr.Landscape, cell: int, cells: int) -> float:
    return float(landscape.axes[1][0] + np.ptp(landscape.axes[1]) * (cell + 0.5) / cells)


def test_the_landscape_is_g_and_decided_by_its_anchor_alone() -> None:
    anchor = np.array([[0.5], [0.9], [3.0], [4.9]])
    found = []
    for _ in range(2):
        landscape = sr.Landscape(inspection().relaxed_value(4, 0.01), anchor, (0, 0), (2, 0), 8, 0.01)
        levels = [complete for complete in landscape.evaluate() if complete]
        assert len(levels) == 4 and landscape.spent == 55  # pairs of eight even lines and the two of the anchor
        found.append(landscape.values)
    assert (found[0] == found[1]).all()
    fresh = inspection().relaxed_value(4, 0.01)
    for i, j in ((0, 0), (3, 5), (7, 7), landscape.at):
        slots = anchor.copy()
        slots[0, 0], slots[2, 0] = landscape.axes[0][i], landscape.axes[1][j]
        assert found[0][i, j] == pytest.approx(fresh.at(slots), abs=1e-7)
    assert landscape.value == pytest.approx(fresh.at(anchor), abs=1e-9)
    assert np.ptp(found[0]) > 1e-3
    picture = landscape.picture(50)
    assert picture.min() >= landscape.limits[0] - 1e-12 and picture.max() <= landscape.limits[1] + 1e-12
    even = (landscape.axes[0] - landscape.axes[0][0]) / np.ptp(landscape.axes[0]) * 50 - 0.5
    for i, j in ((12, 30), (24, 3), (49, 49)):  # each the value in the middle of its cell, in straight lines
        one = np.array([np.interp(i, even, column) for column in found[0].T])
        assert picture[i, j] == pytest.approx(np.interp(landscape_up(landscape, j, 50), landscape.axes[1], one))


def test_coordinates_of_the_landscape_are_named_as_in_the_config_or_refused_with_what_there_is() -> None:
    from sparserob_core.experiment.run.landscape import coordinate

    system = {
        "problem.system.A": [[0, 1], ["-2 + spring", "-0.5 + p2"]],
        "problem.system.B": [[0], ["1 + gain"]],
        "problem.system.parameters": {"spring": [-0.1, 0.1], "p2": [-0.1, 0.1], "gain": [-0.1, 0.1]},
    }
    changes = {"dictionaries.control.pieces": 20, **system}
    g = inspection("experiment2_reduced.yaml", changes).relaxed_value(3, 0.1)
    assert g.names == ("t", "spring", "p2", "gain")
    assert g.kinds == ("time", "parameter", "parameter", "parameter")
    assert coordinate("p2", g) == (0, 2)
    assert coordinate("t[2]", g) == (1, 0)
    for wrong in ("p1", "t[3]", "t[0]", "t[x]"):
        with pytest.raises(sr.InputError, match=r"expected one of t, spring, p2, gain, of the index that decides most"):
            coordinate(wrong, g)


class Plain:
    """A function of tuples in the place of ``g``: its values, and which of its indices decide."""

    def __init__(self, value: Any, deciding: list[int], width: int = 1) -> None:
        self.value, self.ranked = value, np.array(deciding)
        self.slot = sr.Box(np.zeros(width), np.ones(width))
        self.names, self.kinds = ("t", "p")[:width], ("time", "parameter")[:width]
        self.coordinates, self.interchangeable = tuple(range(width)), True

    def at(self, slots: np.ndarray) -> float:
        return float(self.value(slots))

    def deciding(self) -> np.ndarray:
        return self.ranked


def mapped(g: Any, anchor: np.ndarray, size: int = 8) -> Any:
    axes = sr.LandscapeAxes.over(g, len(anchor), None)
    assert axes is not None
    landscape = sr.Landscape(g, anchor, *axes.places(sr.deciding_pair(g, anchor), anchor), size, 0.0, axes)
    list(landscape.evaluate())
    return landscape


def test_the_map_is_over_the_times_of_the_two_indices_that_decide_most_the_earlier_one_across() -> None:
    anchor = np.array([[0.2, 0.5], [0.9, 0.5], [0.6, 0.4]])
    both = mapped(Plain(lambda s: s[0, 0] + 10 * s[2, 0], [2, 0, -1, -1], 2), anchor)
    assert (both.first, both.second) == ((0, 0), (2, 0)) and both.names() == (
        "t of the earlier index",
        "t of the later index",
    )
    assert both.names("h") == ("t of the earlier index, in h", "t of the later index, in h")
    mixed = mapped(Plain(lambda s: s[0, 0], [0], 2), anchor[:1])
    assert mixed.names("h") == ("t, in h", "p")  # a unit of time behind a time, and behind nothing else
    assert both.values[0, 0] == 0.0 and both.values[-1, 0] == 1.0 and both.values[0, -1] == 10.0
    # only one index with a time decides: the time of one more index is the second axis
    assert mapped(Plain(lambda s: s[1, 0], [1, -1, -1, -1], 2), anchor).first == (0, 0)
    # two indices beside one another stand for the same constraint: they are one axis, and move together
    twins = Plain(lambda s: -min((s[0, 0] - 0.2) ** 2, (s[2, 0] - 0.2) ** 2), [0, 2, 1, -1])
    map_of_twins = mapped(twins, np.array([[0.2], [0.9], [0.21]]))
    assert (map_of_twins.first, map_of_twins.second) == ((0, 0), (1, 0)) and not map_of_twins.flat
    # at their distance: where the tuple is, the map has the tuple's value
    apart = mapped(Plain(lambda s: s[0, 0] + s[2, 0], [0, 2, -1, -1]), np.array([[0.2], [0.9], [0.21]]))
    assert apart.value == pytest.approx(0.2 + 0.21) and apart.limits == pytest.approx((0.01, 2.0))
    # of an index that is alone, two of its coordinates
    alone = sr.LandscapeAxes.over(Plain(lambda s: 1.0, [0], 2), 1, None)  # type: ignore[arg-type]
    assert alone is not None and alone.coordinates == (0, 1)
    assert sr.LandscapeAxes.over(Plain(lambda s: 1.0, [0]), 1, None) is None  # type: ignore[arg-type]


def test_of_what_moves_on_the_map_the_disturbance_is_at_its_worst_and_the_best_tuple_lies_below() -> None:
    small = {"dictionaries.control.pieces": 20, "dictionaries.disturbance.pieces": 20, "problem.path.0.from": 0.3}
    literal = inspection("experiment1_literal.yaml", small).relaxed_value(3, 0.1)
    reduced = inspection("experiment1_reduced.yaml", small).relaxed_value(3, 0.1)
    anchor = np.random.default_rng(0).uniform(literal.slot.lower, literal.slot.upper, (3, literal.slot.dimension))
    anchor[:, 0] = [1.8, 2.6, 4.0]
    own = literal.at(anchor)
    landscape = mapped(literal, anchor, 5)
    assert literal.kinds[:2] == ("time", "disturbance") and landscape.first[1] == landscape.second[1] == 0
    assert landscape.value > own + 0.1  # the constraints of two indices are harder than before
    # with all three at their worst, it is the reduced form at the same times
    worst = anchor.copy()
    worst[:, 1:] = np.nan
    assert literal.at(worst) == pytest.approx(reduced.at(anchor[:, :1]), abs=1e-9)
    assert landscape.value <= literal.at(worst) + 1e-9


def test_a_flat_slice_says_so_and_has_no_range_of_its_own() -> None:
    from sparserob_rerun.search.terrain import _said

    landscape = mapped(Plain(lambda s: 0.632, [0, -1]), np.array([[0.5], [0.7]]))
    assert landscape.flat and landscape.limits == (0.632, 0.632)
    assert _said(landscape) == ["g does not depend on these two here: 0.632"]
    landscape.level = 2
    assert _said(landscape) == ["g is 0.632 on all lines of this coarse grid"]
    tilted = sr.Landscape(Plain(lambda s: s[0, 0], [0, -1]), np.array([[0.5], [0.7]]), (0, 0), (1, 0), 8)  # type: ignore[arg-type]
    list(tilted.evaluate())
    assert not tilted.flat and _said(tilted) == ["g from 0 (dark) to 1 (bright)"]
    little: Any = Plain(lambda s: 0.67833 + 1e-6 * s[0, 0], [0, -1])
    slight = sr.Landscape(little, np.array([[0.5], [0.7]]), (0, 0), (1, 0), 8)
    list(slight.evaluate())
    assert _said(slight) == ["g from 0.67833 (dark) to 0.678331 (bright)"]


@pytest.mark.parametrize("place", [0.0, 1e-17, 1.0 / 7.0 + 1e-15, 0.5, 1.0])
def test_a_tuple_beside_a_line_of_the_grid_takes_its_place(place: float) -> None:
    tilted: Any = Plain(lambda s: s[0, 0] + s[1, 0], [0, 1])
    landscape = sr.Landscape(tilted, np.array([[place], [0.3]]), (0, 0), (1, 0), 8)
    list(landscape.evaluate())
    assert landscape.axes[0][landscape.at[0]] == place and landscape.value == place + 0.3
    assert np.diff(landscape.axes[0]).min() > 1e-3
    assert 0.3 in landscape.axes[0]  # where the other index is, which is beside no line
    assert landscape.axes[0].size == 1 + (8 if place != 0.5 else 9)


def test_g_has_the_value_that_a_search_has_whatever_the_units(tmp_path: Path) -> None:
    changes = {**SEARCH, "maximiser.budget": 30, "continuation": {"start": 0.1, "stop": 0.1}, "observers": []}
    for extra in ({}, {"problem.control.box": 2.0**-8, "problem.system.B": [[0], [2.0**8]]}):
        outcome = sr.run(
            CONFIGS / "experiment1_reduced.yaml",
            {**changes, **extra},
            tmp_path / str(len(extra)),
            quiet=True,
            figures=False,
        )
        trace = outcome.result.trace
        assert trace is not None and trace.points.size
        g = inspection("experiment1_reduced.yaml", {**changes, **extra}).relaxed_value(4, 0.1)
        for row in (0, 10, int(np.argmax(trace.value))):
            assert g.at(trace.points[row].reshape(4, -1)) == pytest.approx(trace.value[row], abs=1e-9)


@pytest.mark.parametrize(("method", "searches"), [("exchange", False), ("sparserob", True), ("stub", False)])
def test_a_search_is_shown_of_the_methods_that_say_that_they_search(
    method: str, searches: bool, tmp_path: Path
) -> None:
    from sparserob_rerun.recording.recorder import shown_of

    (tmp_path / "stub.py").write_text(STUB)
    changes = {"plugins": [str(tmp_path / "stub.py")], "method": {"name": method}}
    assert shown_of(inspection(changes=changes), None).searches == searches


@pytest.mark.slow
def test_watching_changes_nothing(searched: sr.Outcome, tmp_path: Path) -> None:
    changes = {**SEARCH, "maximiser.name": "simulated_annealing", "observers": []}
    plain = sr.run(CONFIGS / "experiment1_reduced.yaml", changes, tmp_path / "run", quiet=True, figures=False)
    assert plain.result.trace is not None and searched.result.trace is not None
    assert (plain.result.trace.value == searched.result.trace.value).all()
    assert plain.result.cost == searched.result.cost


@pytest.mark.parametrize(
    ("options", "said"),
    [
        ({"connect": "127.0.0.1:1", "save": None}, "no viewer answers at 127.0.0.1:1"),
        pytest.param({"spawn": True}, "there is no display", marks=pytest.mark.slow),
        pytest.param(
            {"save": "/proc/nowhere/x.rrd"}, "/proc/nowhere/x.rrd: cannot be written to", marks=pytest.mark.slow
        ),
    ],
)
def test_what_is_missing_is_one_warning_and_the_run_goes_on(
    options: dict[str, object],
    said: str,
    tmp_path: Path,
    caplog: pytest.LogCaptureFixture,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.delenv("DISPLAY", raising=False)
    monkeypatch.delenv("WAYLAND_DISPLAY", raising=False)
    outcome = recorded(tmp_path / "run", "experiment1_repaired.yaml", QUICK, **options)
    assert outcome.status == "certified"
    assert [record.getMessage().count(said) for record in caplog.records] == [1]


@pytest.mark.slow
def test_a_missing_package_is_one_warning_with_the_way_to_install_it(
    tmp_path: Path, caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    import sparserob_rerun.recording.sinks

    monkeypatch.setattr(sparserob_rerun.recording.sinks, "find_spec", lambda name: None)
    assert recorded(tmp_path / "run", "experiment1_repaired.yaml", QUICK).status == "certified"
    assert [record.getMessage() for record in caplog.records] == [
        "rerun: rerun-sdk is not installed; `pip install 'rerun-sdk>=0.41'` brings it"
    ]
    assert not (tmp_path / "run" / "recording.rrd").exists()


@pytest.mark.slow
def test_of_several_destinations_those_that_exist_are_used(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    recorded(tmp_path / "run", "experiment1_repaired.yaml", QUICK, connect="127.0.0.1:1", save="some/where.rrd")
    assert len(caplog.records) == 1
    assert read(tmp_path / "run" / "some" / "where.rrd")["/verdict"]


@pytest.mark.parametrize("wrong", ["nobody:port", ":9876", "127.0.0.1:99999"])
def test_an_address_that_is_none_is_refused_before_the_run(wrong: str, tmp_path: Path) -> None:
    with pytest.raises(sr.ConfigError, match=r"observers.0.connect.*expected an address such as 127\.0\.0\.1:9876"):
        recorded(tmp_path / "run", "experiment1_repaired.yaml", QUICK, connect=wrong)


@pytest.mark.slow
def test_a_run_that_breaks_off_leaves_a_complete_recording(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    from sparserob_core.experiment.run.journal import Journal

    def broken(*anything: object, **options: object) -> None:
        raise RuntimeError("the disk is gone")

    monkeypatch.setattr(Journal, "finish", broken)
    with pytest.raises(RuntimeError, match="the disk is gone"):
        recorded(tmp_path / "run", "experiment1_repaired.yaml", QUICK)
    file = tmp_path / "run" / "recording.rrd"
    subprocess.run([viewer(), "rrd", "verify", file], check=True, capture_output=True)
    assert "the disk is gone" in "".join(texts(read(file)["/verdict"], "TextDocument:text"))


def test_a_full_queue_drops_at_once_and_says_so(tmp_path: Path) -> None:
    from sparserob_rerun.recording.outlet import Outlet
    from sparserob_rerun.recording.recorder import Opening
    from sparserob_rerun.recording.sinks import Destinations

    outlet = Outlet(Opening("many", None, None, None), Destinations(tmp_path / "x.rrd", None, False, None), capacity=2)
    event = sr.ProofProgress(family="path", cells=1, bound=0.0)
    started = time.perf_counter()
    for _ in range(1000):
        outlet.send(event)
    assert time.perf_counter() - started < 0.5
    assert outlet.dropped > 500
    assert [line for line in outlet.close() if "events came faster than they could be recorded" in line]
    assert any("were dropped" in line for line in texts(read(tmp_path / "x.rrd")["/log"], "TextLog:text"))


def test_a_process_that_dies_is_noticed_and_costs_nothing(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    from sparserob_rerun.recording.outlet import Outlet
    from sparserob_rerun.recording.recorder import Opening
    from sparserob_rerun.recording.sinks import Destinations

    outlet = Outlet(Opening("killed", None, None, None), Destinations(tmp_path / "x.rrd", None, False, None))
    outlet.process.kill()
    outlet.process.join()
    started = time.perf_counter()
    for _ in range(2000):
        outlet.send(sr.ProofProgress(family="path", cells=1, bound=0.0))
    assert any("ended early" in line and "x.rrd holds what was" in line for line in outlet.close())
    assert time.perf_counter() - started < 5.0


@pytest.mark.slow
def test_a_system_without_fork_records_as_well(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    import sparserob_rerun.recording.outlet

    monkeypatch.setattr(sparserob_rerun.recording.outlet, "START", "spawn")
    recorded(tmp_path / "run", "experiment1_repaired.yaml", QUICK)
    found = read(tmp_path / "run" / "recording.rrd")
    assert {"/physics/plots/curve", "/landscape/map/g", "/verdict"} <= set(found)


def command(*arguments: str) -> int:
    with pytest.raises(SystemExit) as end:
        main(arguments)
    return int(end.value.code or 0)


@pytest.mark.slow
def test_watch_records_a_run_and_replay_shows_it_again(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    config, run = str(CONFIGS / "experiment1_repaired.yaml"), str(tmp_path / "run")
    changes = [f"{key}={value}" for key, value in QUICK.items()]
    assert command("watch", config, *changes, "--save", str(tmp_path / "live.rrd"), "--out", run, "--no-figures") == 0
    assert command("replay", run, "--save", str(tmp_path / "again.rrd")) == 0
    assert "recorded into" in capsys.readouterr().out
    live, again = read(tmp_path / "live.rrd"), read(tmp_path / "again.rrd")
    assert (
        scalars(live["/rounds/bounds"], "round")[1][:, 0] == scalars(again["/rounds/bounds"], "round")[1][:, 0]
    ).all()
    assert (scalars(live["/signals/control"], "t")[1] == scalars(again["/signals/control"], "t")[1]).all()
    assert "/landscape/map/g" in again


@pytest.mark.slow
def test_an_outcome_can_be_shown_with_all_that_it_knows(searched: sr.Outcome, tmp_path: Path) -> None:
    searched.show(save=tmp_path / "shown.rrd")
    found = read(tmp_path / "shown.rrd")
    trace = searched.result.trace
    assert trace is not None
    np.testing.assert_allclose(line_of(found["/search/g/walk"], trace), walk_of(trace), rtol=1e-7)
    assert {"/landscape/map/walk", "/search/notes/temperature", "/search/moves/t"} <= set(found)
    # the cursor of every timeline goes over where the search has moved
    assert {"evaluation", "round", "time"} <= set(found["/search/moves/t"][-1].to_record_batch().schema.names)
    assert sum(chunk.num_rows for chunk in found["/physics/plots/curve"]) >= 1


@pytest.mark.slow
def test_replay_and_watch_refuse_what_they_cannot_do(
    answered: sr.Outcome, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delenv("DISPLAY", raising=False)
    monkeypatch.delenv("WAYLAND_DISPLAY", raising=False)
    config, kept = str(CONFIGS / "experiment1_repaired.yaml"), tmp_path / "kept.rrd"
    kept.write_bytes(b"a recording of yesterday")
    faulty, new = tmp_path / "faulty.yaml", str(tmp_path / "new.rrd")
    faulty.write_text("title: one\nproblem: {name: linear, horizon: five}\n")
    for arguments, said in (
        (["watch", str(faulty), "--save", new], f"{faulty}:2:25: problem.horizon: must be a number"),
        (["watch", str(faulty), "problem.horizon=2", "--save", new], f"error: {faulty}:2:"),
        (["watch", str(tmp_path / "none.yaml"), "--save", new], "none.yaml"),
        (["replay", str(tmp_path / "none")], "expected the directory of a run, got nothing"),
        (["replay", str(tmp_path)], "got one without config.yaml"),
        (["watch", config, "--save", str(tmp_path)], "save: expected a file, got the directory"),
        (
            ["watch", config, "--save", str(tmp_path / "no" / "y.rrd")],
            "cannot be written to: No such file or directory",
        ),
        (["watch", config, "--save", str(kept)], f"save: expected a new file, or an empty one, got {kept}"),
        (["replay", str(answered.directory), "--save", str(kept)], f"an empty one, got {kept}, which holds something"),
        (["watch", config], "--save FILE records for later"),
    ):
        assert command(*arguments) == 2
        assert said in capsys.readouterr().err
    assert {one.name for one in tmp_path.iterdir()} == {"kept.rrd", "faulty.yaml"}
    assert kept.read_bytes() == b"a recording of yesterday"


def free_port() -> int:
    with socket.socket() as one:
        one.bind(("127.0.0.1", 0))
        return int(one.getsockname()[1])


def headless(port: int) -> subprocess.Popen[bytes]:
    """A viewer without a screen; skips, loudly, where the machine cannot draw."""
    command_line = [
        str(viewer()),
        "--headless",
        "--window-size",
        "1600x1000",
        "--port",
        str(port),
        "--bind",
        "127.0.0.1",
    ]
    process = subprocess.Popen(command_line, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    end = time.monotonic() + 20.0
    while time.monotonic() < end and process.poll() is None:
        with socket.socket() as one:
            answered = one.connect_ex(("127.0.0.1", port)) == 0
        time.sleep(2.0 if answered else 0.2)  # it answers before it knows that it cannot draw
        if answered and process.poll() is None:
            return process
    process.kill()
    process.wait()
    pytest.skip(
        "SKIPPED LOUDLY: the viewer of Rerun cannot draw here; `apt-get install mesa-vulkan-drivers` lets it draw"
        " without a graphics card"
    )


@pytest.mark.slow
def test_a_viewer_that_is_killed_in_mid_run_changes_nothing(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    port = free_port()
    process = headless(port)
    try:
        changes = {**SEARCH, "maximiser.name": "simulated_annealing", "maximiser.budget": 1500, "method.sc2": None}

        class Killer(sr.Observer):
            def receive(self, event: sr.Event) -> None:
                if isinstance(event, sr.RoundFinished):
                    process.kill()

        options = {**changes, "observers": [{**SMALL, "connect": f"127.0.0.1:{port}", "save": "recording.rrd"}]}
        outcome = sr.run(
            CONFIGS / "experiment1_reduced.yaml",
            options,
            tmp_path / "run",
            quiet=True,
            figures=False,
            observers=[Killer()],
        )
        plain = sr.run(
            CONFIGS / "experiment1_reduced.yaml",
            {**changes, "observers": []},
            tmp_path / "plain",
            quiet=True,
            figures=False,
        )
        assert outcome.result.cost == plain.result.cost
        assert len([record for record in caplog.records if record.levelno >= logging.WARNING]) <= 1
        subprocess.run([viewer(), "rrd", "verify", tmp_path / "run" / "recording.rrd"], check=True, capture_output=True)
    finally:
        process.kill()
        process.wait()


@pytest.mark.slow
@pytest.mark.filterwarnings(
    "ignore::pytest.PytestUnraisableExceptionWarning"
)  # the client of the viewer does not wait for its process
@pytest.mark.parametrize("kind", ["searched", "exchanged"])
def test_the_viewer_draws_every_panel_without_complaint(
    kind: str, request: pytest.FixtureRequest, tmp_path: Path
) -> None:
    from rerun.experimental import ViewerClient

    outcome = request.getfixturevalue(kind)
    probe = headless(free_port())
    probe.kill()
    probe.wait()
    file = tmp_path / "shown.rrd"
    shutil.copy(outcome.directory / "recording.rrd", file)
    with ViewerClient.spawn(
        headless=True, port=free_port(), hide_welcome_screen=True, executable_path=str(viewer())
    ) as shown:
        shown.open(str(file))
        time.sleep(8.0)
        picture = tmp_path / "screen.png"
        shown.save_screenshot(str(picture))
        state = shown.get_state()
    assert len(state.views) >= 8
    assert [view.reports for view in state.views] == [[]] * len(state.views)
    assert picture.stat().st_size > 50_000


def test_a_landscape_takes_only_the_time_of_an_index_of_another_formulation() -> None:
    from sparserob_rerun.recording.recorder import slots_of

    cuts = [
        sr.Cut("path", np.array([1.0, 17.0]), 0, 2.0, "sampled"),
        sr.Cut("path", np.array([0.5, 0.1, 0.2]), 0, 1.0, "reduced"),
    ]
    np.testing.assert_array_equal(slots_of(cuts, "reduced"), [[1.0, 0.0, 0.0], [0.5, 0.1, 0.2]])
    np.testing.assert_array_equal(slots_of(cuts[:1], "literal"), [[1.0]])
