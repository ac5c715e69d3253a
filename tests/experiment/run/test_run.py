"""Guards experiment/run/run: the walk from a config to a run directory, around a method that solves nothing."""

from __future__ import annotations

import json
import logging
from pathlib import Path

import numpy as np
import pytest

import sparserob_core as sr
from sparserob_core.control.transcription import provable
from sparserob_core.experiment.directory.artefacts import RunDirectory
from sparserob_core.experiment.run.events import Broadcast, Event

KEYS = {
    "status",
    "message",
    "cost",
    "value",
    "epsilon",
    "lower_bound",
    "upper_bound",
    "gap",
    "worst",
    "sparsity",
    "counts",
    "seconds",
    "seed",
    "versions",
}


def test_a_run_leaves_what_is_documented(config: Path, tmp_path: Path) -> None:
    outcome = sr.run(config, out=tmp_path / "out", figures=False)
    written = json.loads((outcome.directory / "result.json").read_text())
    assert set(written) >= KEYS
    assert set(written["worst"]) >= {"violation", "constraint", "time", "parameter"}
    assert set(written["counts"]) >= {"relaxed_programs", "rounds", "active_indices"}
    assert written["counts"]["relaxed_programs"] == 4
    assert 0.0 <= written["gap"] <= 1e-13  # rounding is subtracted from the lower bound
    with np.load(outcome.directory / "solution.npz") as solution:
        assert solution["breakpoints"].shape == (11,)
        assert solution["control"].shape == solution["theta"].shape == (1, 10)
        assert solution["times"].tolist() == [1.0, 2.0]
        assert solution["indices"].shape == (2, 2)
        # the stub speaks in the problem's own units, as every method does; the file in the user's
        assert solution["multipliers"].tolist() == [2.0 * outcome.program.own_units.cost, 0.0]
    with np.load(outcome.directory / "trace.npz") as trace:
        assert trace["round"].tolist() == [1, 2]


def test_the_outcome_holds_the_result_and_what_was_solved(config: Path, tmp_path: Path) -> None:
    outcome = sr.run(config, out=tmp_path / "out", figures=False)
    assert (outcome.status, outcome.result.cost) == ("certified", outcome.program.own_units.cost)
    assert isinstance(outcome.problem, sr.OptimalControlProblem)
    assert outcome.program.n == 10
    assert outcome.control is not None
    assert np.array_equal(outcome.control.ravel(), np.asarray(outcome.result.decision))


def test_running_the_resolved_config_gives_the_same_result(config: Path, tmp_path: Path) -> None:
    first = sr.run(config, ["seed=3", "method.rounds=4"], out=tmp_path / "first", figures=False)
    again = sr.run(first.directory / "config.yaml", out=tmp_path / "again", figures=False)
    assert np.array_equal(np.asarray(first.result.decision), np.asarray(again.result.decision))
    assert (first.directory / "config.yaml").read_text() == (again.directory / "config.yaml").read_text()
    timeless = [{**outcome.summary, "seconds": 0, "provenance": None} for outcome in (first, again)]
    assert timeless[0] == timeless[1]
    assert first.summary["provenance"]["hash"] == again.summary["provenance"]["hash"]


def test_an_infeasible_run_has_no_control_and_says_why(config: Path, tmp_path: Path) -> None:
    outcome = sr.run(config, {"method.status": "infeasible"}, out=tmp_path / "out")
    assert outcome.control is None
    written = json.loads((outcome.directory / "result.json").read_text())
    assert (written["status"], written["upper_bound"]) == ("infeasible", None)
    assert written["message"] == "the stub says so; what the method 'stub' claims is believed"
    assert not (outcome.directory / "figures").exists()


@pytest.mark.slow
def test_figures_are_drawn_and_can_be_drawn_again(config: Path, tmp_path: Path) -> None:
    pytest.importorskip("matplotlib")
    from sparserob_core.experiment.run.drawing import draw_run

    changes = {"problem.disturbance.box": [0.0, 0.1], "problem.path": [{"box": [2.0, None], "from": 0.5}]}
    outcome = sr.run(config, changes, out=tmp_path / "out")
    assert outcome.remarks == ()
    drawn = {file.name for file in (outcome.directory / "figures").iterdir()}
    assert {"control.pdf", "control.png", "states.pdf", "states.png"} <= drawn
    assert {file.name for file in draw_run(outcome.directory)} == drawn


def test_a_failing_method_leaves_the_rounds_before_it(config: Path, tmp_path: Path) -> None:
    with pytest.raises(sr.PluginError, match="the stub fell over"):
        sr.run(config, {"method.fail": True}, out=tmp_path / "out")
    written = json.loads((tmp_path / "out" / "result.json").read_text())
    assert written["status"] == "failed"
    assert written["message"].endswith("solve raised RuntimeError: the stub fell over")
    with np.load(tmp_path / "out" / "trace.npz") as trace:
        assert trace["round"].tolist() == [1]


class Listener(sr.Observer):
    """Keeps what it hears."""

    def __init__(self) -> None:
        self.heard: list[Event] = []

    def receive(self, event: Event) -> None:
        self.heard.append(event)


class Clumsy(sr.Observer):
    """Falls over every time."""

    def receive(self, event: Event) -> None:
        raise ValueError("oh")


def test_a_disk_that_is_full_at_the_end_does_not_take_what_was_found(
    config: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(directory: RunDirectory, name: str, arrays: object) -> None:
        raise sr.SparseRobError(f"{name}: cannot be written: No space left on device")

    monkeypatch.setattr(RunDirectory, "write_arrays", full)
    with pytest.raises(sr.SparseRobError, match=r"solution\.npz: cannot be written") as caught:
        sr.run(config, out=tmp_path / "out", figures=False)
    ended, place = caught.value.__notes__
    assert ended.startswith("the run itself came to its end, certified: ")
    assert place == f"what was done until then is in {tmp_path / 'out'}"


def test_an_observer_that_fails_is_detached_with_one_warning(caplog: pytest.LogCaptureFixture) -> None:
    listener = Listener()
    broadcast = Broadcast([("clumsy", Clumsy()), ("listener", listener)])
    with caplog.at_level(logging.WARNING, logger="sparserob"):
        for _ in range(3):
            broadcast(sr.Event())
    assert len(listener.heard) == 3
    assert [record.getMessage() for record in caplog.records] == ["observer 'clumsy' is detached: ValueError: oh"]


def test_a_directory_at_fault_is_found_before_anything_is_solved(config: Path, tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(sr.InputError, match="expected a directory"):
        sr.run(config, {"method.fail": True}, out=tmp_path / "file")


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        ({"seed": -1}, "seed: expected a whole number of at least 0, got -1"),
        ({"budget": 0.5}, "budget: expected a whole number of at least 1, got 0.5"),
        ({"solver": 3}, "solver: expected a name, a mapping with a name, or a Solver, got 3"),
        ({"solver": "piq"}, "no solver is named 'piq'; did you mean 'piqp'"),
        ({"maximiser": {"name": "direct", "epsilon": 1}}, "maximiser direct: epsilon: unknown key"),
        ({"continuation": {"factor": 2}}, "continuation.factor: "),
        ({"control": "piecewise_constant"}, "control, disturbance, policy: these are for an OptimalControlProblem"),
    ],
)
def test_an_argument_of_solve_at_fault_is_named(arguments: dict[str, object], said: str) -> None:
    program = sr.SemiInfiniteProgram(n=1, q=np.ones(1), lower=-1.0, upper=1.0)
    with pytest.raises(sr.InputError) as caught:
        sr.solve(program, **arguments)  # type: ignore[arg-type]
    assert said in str(caught.value)


def test_maximise_resolves_the_name_and_its_options() -> None:
    report = sr.maximise(
        lambda x: -((x - 0.3) ** 2).sum(axis=1),
        sr.Box([0.0, 0.0], [1.0, 1.0]),
        "direct",
        budget=500,
        seed=0,
        eps=1e-6,
        polish=0.0,
    )
    assert report.best_value == pytest.approx(0.0, abs=1e-4)
    with pytest.raises(sr.InputError, match="maximiser direct: epz: unknown key"):
        sr.maximise(lambda x: x[:, 0], sr.Box([0.0], [1.0]), "direct", epz=3, polish=0.0)


def test_what_can_never_be_certified_is_said_before_anything_is_solved(
    caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    ball = sr.Ellipsoid([0.0, 0.0], [[0.25, 0.0], [0.0, 0.25]])
    problem = sr.OptimalControlProblem(
        system=sr.LinearSystem(lambda p: [[0, 1], [-p[0], 0]], [[0.0], [1.0]], parameters=sr.Box([0.5], [1.5])),
        horizon=2.0,
        initial_state=[0.4, 0.0],
        control=sr.Box([-1.0], [1.0]),
        disturbance=sr.Box([-0.01, -0.01], [0.01, 0.01]),
        disturbance_class="measurable",
        terminal=[ball],
    )
    with caplog.at_level("WARNING", logger="sparserob"):
        result = sr.solve(problem, control={"name": "piecewise_constant", "pieces": 4}, seconds=1e-6)
    assert "before there was a decision" in result.message
    assert len(caplog.records) == 1
    assert "the search for a witness" not in caplog.text
    assert "no control of this problem can be certified" in caplog.text
    assert "piecewise_constant" in caplog.text
    monkeypatch.setattr(provable, "UNPROVABLE_SECONDS", 1e-3)
    result = sr.solve(problem, control={"name": "piecewise_constant", "pieces": 4})
    assert result.stopped == "the limit of 0.001 s is reached"
    assert "the search for a witness ends after 0.001 s" in caplog.text
