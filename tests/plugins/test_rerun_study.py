"""Guards the recording of a study: what ``sparserob sweep --watch`` shows, read back; and that watching never hurts
it."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import sparserob_core as sr
from tests.plugins.test_rerun import QUICK
from tests.support.places import CONFIGS
from tests.support.recordings import read, rows, texts
from tests.support.stub import Command

pytest.importorskip("rerun", reason="a recording needs the extra rerun")


class Heard(sr.Observer):
    """Keeps what it hears; raises at an event of some kind."""

    def __init__(self, fails_at: type[sr.Event] | None = None) -> None:
        self.events: list[sr.Event] = []
        self.fails_at, self.closed = fails_at, 0

    def receive(self, event: sr.Event) -> None:
        self.events.append(event)
        if self.fails_at is not None and isinstance(event, self.fails_at):
            raise RuntimeError("the observer fell over")

    def close(self) -> None:
        self.closed += 1


def watched(config: Path, axes: Sequence[str], out: Path, *observers: sr.Observer, **options: Any) -> sr.Study:
    return sr.sweep(config, axes, out=out, observers=observers, **options)


@pytest.fixture(autouse=True)
def undrawn(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("sparserob_core.experiment.sweep.figure.draw_study", lambda study: None)


def pages(file: Path, part: str = "state") -> list[str]:
    return texts(read(file)[f"/study/{part}"], "TextDocument:text")


def labels(file: Path, part: str) -> list[str]:
    """What is written on the last picture of a part."""
    return [str(one) for one in rows(read(file)[f"/study/{part}/labels"], "Points2D:labels")[-1]["Points2D:labels"]]


def test_an_observer_of_a_study_hears_its_points_and_the_bounds_of_those_that_run_here(
    config: Path, tmp_path: Path
) -> None:
    heard = Heard()
    study = watched(config, ["seed=0,1,2", "method.status=certified,infeasible"], tmp_path / "study", heard)
    first, last = heard.events[0], heard.events[-1]
    assert isinstance(first, sr.SweepStarted) and isinstance(last, sr.SweepFinished) and heard.closed == 1
    assert first.axes == ["seed", "method.status"] and len(first.points) == 6 and not first.parallel
    assert [tuple(point) for point in first.points] == [(row["seed"], row["method.status"]) for row in study.table]
    assert {type(event) for event in heard.events[1:-1]} == {sr.SweepProgress, sr.PointProgress}
    assert [dict(last.rows[place])["hash"] for place in range(6)] == [row["hash"] for row in study.table]
    told = [event for event in heard.events if isinstance(event, sr.PointProgress)]
    assert {event.point for event in told} == set(range(6))
    for place in range(6):  # first that it runs, then its bounds, which never widen
        mine = [event for event in told if event.point == place]
        assert mine[0].round == 0 and mine[0].lower_bound == -np.inf
        lower = [event.lower_bound for event in mine]
        assert lower == sorted(lower) and lower[-1] > 0.0


def test_bounds_of_a_run_are_in_the_units_of_the_table(tmp_path: Path) -> None:
    heard = Heard()
    changes = ["problem.horizon=4.5,5.0", *(f"{key}={value}" for key, value in QUICK.items())]
    study = watched(CONFIGS / "double_integrator.yaml", changes, tmp_path / "study", heard)
    for place, row in enumerate(study.table):
        last = [one for one in heard.events if isinstance(one, sr.PointProgress) and one.point == place][-1]
        assert last.lower_bound == pytest.approx(row["lower_bound"], rel=1e-6)
        assert last.upper_bound == pytest.approx(row["upper_bound"], rel=1e-6)


def test_of_points_with_equal_configs_all_are_told_of_at_once(config: Path, tmp_path: Path) -> None:
    heard = Heard()
    drawn = watched(config, ["method.rounds=1:2"], tmp_path / "study", heard, points="random", number=6)
    values = [row["method.rounds"] for row in drawn.table]
    assert set(values) == {1, 2}
    for event in heard.events:
        if isinstance(event, sr.SweepProgress) and event.row is not None:
            mine = event.row["method.rounds"]
            assert list(event.places) == [place for place, value in enumerate(values) if value == mine]


@pytest.mark.first(2)
@pytest.mark.parametrize("kind", [sr.SweepStarted, sr.PointProgress, sr.SweepProgress, sr.SweepFinished])
def test_an_observer_that_fails_is_told_of_once_and_the_study_goes_on(
    kind: type[sr.Event], config: Path, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    broken, whole = Heard(kind), Heard()
    study = watched(config, ["seed=0,1,2"], tmp_path / "study", broken, whole)
    assert study.counts == {"certified": 3}
    said = [record.getMessage() for record in caplog.records if record.levelno >= logging.WARNING]
    assert said == ["observer 'Heard' is detached: RuntimeError: the observer fell over"]
    assert broken.closed == 1 and isinstance(whole.events[-1], sr.SweepFinished)


def test_an_observer_hears_the_end_of_a_study_that_is_interrupted_and_what_was_finished_before(
    config: Path, tmp_path: Path
) -> None:
    class Presses(Heard):
        def receive(self, event: sr.Event) -> None:
            super().receive(event)
            if isinstance(event, sr.PointProgress) and event.point == 1:
                raise KeyboardInterrupt

    heard, again = Presses(), Heard()
    study = watched(config, ["seed=0,1,2"], tmp_path / "study", heard)
    last = heard.events[-1]
    assert study.stopped and isinstance(last, sr.SweepFinished)
    assert last.stopped == study.stopped and last.pressed and list(last.rows) == [0]
    watched(config, ["seed=0,1,2"], tmp_path / "study", again)
    first = again.events[0]
    assert isinstance(first, sr.SweepStarted) and list(first.rows) == [0]


@pytest.mark.slow
@pytest.mark.parametrize(
    ("axes", "options", "parts"),
    [
        (["seed=0,1,2"], {}, {"map/marks", "map/frame", "map/labels"}),
        (["method.status=certified,infeasible"], {}, {"map/marks", "map/frame", "map/labels"}),
        (["seed=0,1", "method.rounds=1,2", "method.wait=0.0,0.01"], {}, {"table"}),
        (["seed=0,1", "method.rounds=1,2"], {}, {"map/cells", "map/marks", "map/frame", "map/labels"}),
        (["seed=0,1", "method.rounds=1,2"], {"points": "zip"}, {"map/marks", "map/frame", "map/labels"}),
        (["seed=0:9", "method.wait=0.0:0.01"], {"points": "sobol", "number": 4}, {"map/marks", "map/labels"}),
    ],
)
def test_no_panel_of_a_study_is_empty(
    axes: list[str], options: dict[str, Any], parts: set[str], config: Path, tmp_path: Path
) -> None:
    from sparserob_core.experiment.run.viewer import recorder

    study = watched(config, axes, tmp_path / "study", recorder(tmp_path / "x.rrd", False, None), **options)
    assert not study.failed
    found = read(tmp_path / "x.rrd")
    common = {"state", "newest", "bounds/labels", "bounds/frame", "bounds/marks"}
    assert {f"/study/{part}" for part in common | parts} | {"/log"} <= set(found)
    assert "**the study is over**" in pages(tmp_path / "x.rrd")[-1]
    if "map/labels" in parts:  # the axes are named
        said = " ".join(labels(tmp_path / "x.rrd", "map"))
        shown = study.axes[:1] if "map/cells" not in parts and options.get("points") != "sobol" else study.axes
        assert all(axis.key in said for axis in shown)
        assert "cost J" in said or len(shown) == 2


@pytest.mark.slow
def test_the_map_has_every_status_with_its_colour_and_the_words_count_them(config: Path, tmp_path: Path) -> None:
    from sparserob_core.experiment.run.viewer import recorder
    from sparserob_rerun.study.board import shaded

    file = tmp_path / "x.rrd"
    axes = ["seed=0,1,2", "method.status=certified,infeasible,undecided"]
    study = watched(config, axes, tmp_path / "study", recorder(file, False, None))
    cells = rows(read(file)["/study/map/cells"], "Boxes2D:colors", "Boxes2D:centers")
    colours = [int(one) for one in cells[-1]["Boxes2D:colors"]]
    expected = [int.from_bytes(bytes(shaded(str(row["status"]))), "big") for row in study.table]
    assert colours == expected and len(set(colours)) == 3
    assert len({tuple(one) for one in cells[-1]["Boxes2D:centers"]}) == 9
    assert {"3 certified", "3 infeasible", "3 undecided"} <= set(labels(file, "map"))
    assert "3 certified, 3 infeasible, 3 undecided" in pages(file)[-1]
    assert "9 of 9 points" in pages(file)[-1]


@pytest.mark.slow
def test_the_picture_grows_and_tells_what_runs_with_its_bounds(config: Path, tmp_path: Path) -> None:
    from sparserob_core.experiment.run.viewer import recorder

    file = tmp_path / "x.rrd"
    watched(config, ["seed=0,1", "method.wait=0.4"], tmp_path / "study", recorder(file, False, None))
    shown = pages(file)
    assert "0 of 2 points done" in shown[0] and "the study is over" in shown[-1]
    running = [page for page in shown if "**Running now: 1**" in page]
    assert any("seed 0: round 2, 0.25 ≤ J\\* ≤ ∞" in page for page in running)
    assert any("1 of 2 points done" in page and "left" in page and "seed 1" in page for page in running)


def test_what_a_study_ended_with_is_shown_whatever_was_dropped_on_the_way(tmp_path: Path) -> None:
    from sparserob_rerun.recording.outlet import Outlet
    from sparserob_rerun.recording.sinks import Destinations
    from sparserob_rerun.study.recorder import StudyOpening

    started = sr.SweepStarted(
        title="many", directory=tmp_path, axes=["seed"], logarithmic=[False], points=[[0], [1]], arrangement="grid"
    )
    outlet = Outlet(StudyOpening(started), Destinations(tmp_path / "x.rrd", None, False, None), capacity=2)
    for number in range(1000):
        outlet.send(sr.PointProgress(point=0, round=number))
    done = {"status": "certified", "cost": 1.0, "lower_bound": 1.0, "upper_bound": 1.0}
    outlet.send(sr.SweepFinished(rows={0: done}, seconds=1.0, stopped="interrupted by SIGTERM"))
    assert outlet.dropped > 500
    outlet.close()
    last = pages(tmp_path / "x.rrd")[-1]
    assert "**stopped: interrupted by SIGTERM**" in last and "1 of 2 points" in last and "1 certified" in last


@pytest.mark.slow
def test_points_that_run_elsewhere_are_said_to_tell_their_bounds_at_the_end(config: Path, tmp_path: Path) -> None:
    from sparserob_core.experiment.run.viewer import recorder

    file = tmp_path / "x.rrd"
    two = {"name": "processes", "workers": 2}
    watched(config, ["seed=0,1,2", "method.wait=0.5"], tmp_path / "y", recorder(file, False, None), executor=two)
    pictures = rows(read(file)["/study/bounds/labels"], "Points2D:labels")
    said = [str(one) for row in pictures for one in row["Points2D:labels"]]
    assert any(one.startswith("bounds of points that run are known when they end") for one in said)
    assert any("**Running now: 2**" in page and "seed 0" in page and "seed 1" in page for page in pages(file))


def test_a_point_that_failed_is_on_the_map_and_the_log_says_why(config: Path, tmp_path: Path) -> None:
    from sparserob_core.experiment.run.viewer import recorder

    file = tmp_path / "x.rrd"
    study = watched(config, ["method.fail=true,false"], tmp_path / "s", recorder(file, False, None))
    assert study.counts == {"failed": 1, "certified": 1}
    assert {"1 failed", "1 certified"} <= set(labels(file, "map"))
    log = texts(read(file)["/log"], "TextLog:text")
    assert any("the stub fell over" in line for line in log) and not any("could not be drawn" in line for line in log)


def test_the_command_watches_with_the_options_of_watch(config: Path, tmp_path: Path, command: Command) -> None:
    del config
    done = command("sweep", "small.yaml", "seed=0,1", "--save", "x.rrd", "--out", "study")
    assert done.returncode == 0 and "recorded into x.rrd" in done.stdout
    assert "**the study is over**" in pages(tmp_path / "x.rrd")[-1]
    plain = command("sweep", "small.yaml", "seed=0,1", "--out", "plain")
    assert plain.returncode == 0
    tables = [(tmp_path / name / "table.csv").read_text().splitlines() for name in ("study", "plain")]
    timeless = [[line.rpartition(",")[0] for line in table] for table in tables]
    assert timeless[0] == timeless[1] and len(timeless[0]) == 3  # watching changes nothing but the seconds


def test_a_viewer_without_a_display_is_an_error_before_anything_is_run(
    config: Path, tmp_path: Path, command: Command, monkeypatch: pytest.MonkeyPatch
) -> None:
    del config
    monkeypatch.delenv("DISPLAY", raising=False)
    monkeypatch.delenv("WAYLAND_DISPLAY", raising=False)
    done = command("sweep", "small.yaml", "seed=0,1", "--watch", "--out", "study")
    assert done.returncode == 2 and "there is no display for a viewer" in done.stderr
    assert not (tmp_path / "study").exists()


@pytest.mark.parametrize(("sense", "bracket"), [("largest", (1.5, 2.0)), ("smallest", (2.5, 2.0)), ("", None)])
def test_the_map_of_a_margin_says_between_which_values_the_critical_one_is(
    sense: Any, bracket: tuple[float, float] | None
) -> None:
    from sparserob_rerun.study.board import Board

    signs = {"largest": 1.0, "smallest": -1.0, "": 1.0}
    values = [2.0 + signs[sense] * one for one in (-2.0, -0.5, 0.0, 1.0, -0.1)]
    statuses = ["certified", "verified", "infeasible", "infeasible", "undecided"]
    rows = {
        place: {"status": status, "cost": 1.0 if place < 2 else None, "lower_bound": 1.0}
        for place, status in enumerate(statuses)
    }
    told: dict[str, Any] = {"title": "", "directory": Path(), "axes": ["factor"], "logarithmic": [False]}
    begun = sr.SweepStarted(points=[], arrangement="search", sense=sense, **told)
    assert "hatch" not in Board(begun).draw({}, []).strips  # nothing is known yet
    board = Board(sr.SweepStarted(points=[(one,) for one in values], arrangement="search", sense=sense, **told))
    drawing = board.draw(rows, [])
    words = " ".join(text for _, text, _ in drawing.labels)
    assert ("critical between" in words) == ("hatch" in drawing.strips) == (bracket is not None)
    if bracket is not None:
        assert board.bracket(rows) == bracket
        edge = board._axes((0.0, 1.0)).at(2.0, 0.0)[0, 0]
        beyond = np.concatenate([points[..., 0].ravel() - edge for points, _, _ in drawing.strips["hatch"]])
        assert (signs[sense] * beyond >= -1e-9).all()


def test_an_axis_of_costs_that_are_all_the_same_is_no_axis_of_their_rounding() -> None:
    from sparserob_rerun.study.board import Board, about

    told: dict[str, Any] = {"title": "", "directory": Path(), "axes": ["factor"], "logarithmic": [False]}
    board = Board(sr.SweepStarted(points=[(0.0,), (1.0,)], arrangement="search", sense="largest", **told))
    drawing = board.draw({0: {"status": "certified", "cost": 0.1757928, "lower_bound": 0.1757928 * (1 - 1e-9)}}, [])
    beside = [text for place, text, _ in drawing.labels if 0.0 < place[0] < 150.0 and 0.0 < place[1] < 330.0]
    assert len(beside) > 1 and len(set(beside)) == len(beside)
    low, high = about(1.0, 2.0, 0.1)
    assert (low, high) == (pytest.approx(0.9), pytest.approx(2.1)) and about(0.0, 0.0, 0.1) == (-0.5, 0.5)


@pytest.mark.slow
def test_a_margin_is_recorded_with_its_bracket(tmp_path: Path, command: Command) -> None:
    file = tmp_path / "margin.rrd"
    more = ["dictionaries.control.pieces=20", "--tolerance", "1e-3", "--curve", "3"]
    places = ["--save", str(file), "--out", str(tmp_path / "out")]
    assert command("margin", str(CONFIGS / "double_integrator.yaml"), *more, *places).returncode == 0
    assert any("critical between" in one for one in labels(file, "map"))
    assert "the search is over" in pages(file)[-1]
