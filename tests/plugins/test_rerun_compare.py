"""Guards the recording of runs side by side: ``sparserob compare --save``, and the tab of a study of one problem."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

import sparserob_core as sr
from tests.experiment.comparison.test_compare import EXACT, PROBLEM, Runs
from tests.support.recordings import read, scalars, texts
from tests.support.stub import Command

pytest.importorskip("rerun", reason="a recording needs the extra rerun")


@pytest.fixture
def runs(tmp_path: Path) -> Runs:
    return Runs(tmp_path)


def styles(file: Path) -> dict[str, dict[str, Any]]:
    """What the static chunks say of every entity: name, colour and marker of its line."""
    from rerun.chunk import RrdReader

    found: dict[str, dict[str, Any]] = {}
    for chunk in RrdReader(str(file)).stream():
        if chunk.is_static:
            batch = chunk.to_record_batch()
            for name, column in zip(batch.schema.names, batch.columns, strict=True):
                entries = [entry for entry in column.to_pylist() if entry]
                if entries and not name.startswith("rerun."):
                    found.setdefault(chunk.entity_path, {})[name] = entries[-1][0]
    return found


def test_every_run_is_a_line_of_its_own_with_its_name_over_evaluations_and_over_seconds(
    runs: Runs, tmp_path: Path, command: Command
) -> None:
    runs.search("a")
    runs.search("b", (1.2, 1.9), maximiser={"name": "lipo", "budget": 2000})
    runs.rounds("c")
    done = command("compare", "a", "b", "c", "--save", "x.rrd")
    assert done.returncode == 0 and "recorded into x.rrd" in done.stdout
    found, style = read(tmp_path / "x.rrd"), styles(tmp_path / "x.rrd")
    paths = [f"/study/runs/bound/{place}" for place in range(3)]
    names = [style[path]["SeriesLines:names"] for path in paths]
    assert names == ["sparserob with random_search", "sparserob with lipo", "exchange"]
    assert len({style[path]["SeriesLines:colors"] for path in paths}) == 3
    assert len({style[path]["SeriesPoints:markers"] for path in paths}) == 3
    at, values = scalars(found[paths[0]], "evaluation")
    assert at.tolist() == [1, 3, 5, 5] and values[:, 0].tolist() == [1.0, 1.81, 1.99, 1.99]
    seconds, values = scalars(found[paths[1]], "time")
    assert (seconds / 1e9).tolist() == pytest.approx([0.1, 0.2, 2.5]) and values[:, 0].tolist() == [1.2, 1.9, 1.9]
    exact = scalars(found["/study/runs/bound/target"], "evaluation")[1]
    assert exact[:, 0].tolist() == pytest.approx([EXACT, EXACT])
    gap = scalars(found["/study/runs/gap/1"], "evaluation")[1]
    assert 10.0 ** gap[:, 0] == pytest.approx((EXACT - np.array([1.2, 1.9, 1.9])) / EXACT)
    words = style["/study/runs/words"]["TextDocument:text"]
    assert "**sparserob with lipo**: refuted, 1.9 ≤" in words.replace("\\", "")
    assert "maximiser lipo" in words and "certified by exchange" in words
    assert any("comparison is over" in line for line in texts(found["/log"], "TextLog:text"))


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["a", "other"], "expected a run of the same problem as a"),
        (["a", "nowhere"], "nowhere: expected the directory of a run"),
        (["a", "b", "--connect", "nonsense:port"], "connect"),
        (["a", "b", "--save", "a/result.json"], "expected a new file"),
        (["study", "--save", "x.rrd"], "study: expected runs"),
    ],
)
def test_what_cannot_be_compared_is_one_error_and_leaves_no_recording(
    arguments: list[str], said: str, runs: Runs, tmp_path: Path, command: Command
) -> None:
    runs.search("a")
    runs.rounds("b")
    runs.rounds("other", problem={**PROBLEM, "horizon": 2.0})
    (tmp_path / "study").mkdir()
    (tmp_path / "study" / "sweep.yaml").write_text("base: {}\n")
    done = command("compare", *arguments, *([] if "--save" in arguments else ["--save", "x.rrd"]))
    assert done.returncode == 2 and said in done.stderr and done.stderr.count("error:") == 1
    assert not (tmp_path / "x.rrd").exists()


def test_a_study_of_one_problem_has_its_runs_side_by_side_and_one_of_several_problems_has_not(
    config: Path, tmp_path: Path
) -> None:
    from sparserob_core.experiment.run.viewer import recorder

    for axis, there in (
        ("seed=0,1", {"/study/runs/bound/0", "/study/runs/bound/1"}),
        ("problem.horizon=2.0,3.0", set()),
    ):
        name = axis.partition("=")[0]
        sr.sweep(config, [axis], out=tmp_path / name, observers=[recorder(tmp_path / f"{name}.rrd", False, None)])
        found = {path for path in read(tmp_path / f"{name}.rrd") if path.startswith("/study/runs/bound/")}
        assert found - {"/study/runs/bound/target"} == there


def test_an_observer_of_a_comparison_hears_one_study_of_its_runs(runs: Runs) -> None:
    class Heard(sr.Observer):
        def __init__(self) -> None:
            self.events: list[sr.Event] = []

        def receive(self, event: sr.Event) -> None:
            self.events.append(event)

    heard = Heard()
    places = [runs.search("a"), runs.rounds("b")]
    sr.compare(places, observers=[heard])
    first, last = heard.events
    assert isinstance(first, sr.SweepStarted) and isinstance(last, sr.SweepFinished)
    assert first.arrangement == "runs" and first.runs is not None
    assert [first.runs / last.rows[place]["run"] for place in range(2)] == [place.resolve() for place in places]
    assert [last.rows[place]["status"] for place in range(2)] == ["refuted", "certified"]


def test_configs_differ_in_components_by_name_and_else_in_single_options(runs: Runs) -> None:
    first, second = runs.search("a"), runs.search("b", maximiser={"name": "lipo", "budget": 2000}, seed=1)
    third = runs.search("c", maximiser={"name": "random_search", "budget": 10})
    both = [one for one in (sr.compare([first, second]), sr.compare([first, third])) if isinstance(one, sr.Comparison)]
    assert both[0].differences == [("maximiser", ["random_search", "lipo"]), ("seed", ["0", "1"])]
    assert both[1].differences == [("maximiser.budget", ["2000", "10"])]
