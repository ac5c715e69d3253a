"""Guards experiment/config/programs: programs as text in a config, their faults with their keys, and what every command
makes of their runs."""

from __future__ import annotations

import copy
import json
import math
from pathlib import Path
from typing import Any

import pytest
import yaml

from sparserob_core.experiment.config.load import load_config
from tests.support.stub import Command

PROGRAM: dict[str, Any] = {
    "name": "program",
    "decision": {"a": {"size": 2}, "d": {"lower": 0, "upper": 10}},
    "tables": {"c": [1.0, 2.0]},
    "minimise": "d",
    "families": [
        {"name": "fit", "index": {"t": [0, 1]}, "rows": ["-d <= a[0] + a[1]*t - c[0]*exp(t) <= d"]},
    ],
}
SLOPE = math.e - 1.0
VALUE = (1.0 - SLOPE + SLOPE * math.log(SLOPE)) / 2.0  # of the line nearest to the exponential, by alternation


def write(folder: Path, path: str = "", value: object = None) -> str:
    """Write a config with one key of its problem replaced, and return its name."""
    problem = copy.deepcopy(PROGRAM)
    holder: Any = problem
    *keys, last = [int(key) if key.isdigit() else key for key in path.split(".")]
    for key in keys:
        holder = holder[key]
    if path:
        holder[last] = value
    (folder / "program.yaml").write_text(yaml.safe_dump({"problem": problem}))
    return "program.yaml"


FAULTS: list[tuple[str, object, str]] = [
    ("families.0.index.t", [1, 0], "problem.families.0.index.t: expected an interval"),
    ("families.0.index.t", [0], "problem.families.0.index.t: expected an interval"),
    ("families.0.index", {}, "problem.families.0.index: expected at least one coordinate"),
    ("families.0.index", [], "problem.families.0.index"),
    ("families.0.index", {"a": [0, 1]}, "problem.families.0.index.a: expected a name that stands for one thing"),
    ("families.0.rows", [], "problem.families.0.rows: must have at least 1 entry"),
    ("families.0.rows", ["d"], "problem.families.0: row 'd': expected <= or >= between two expressions"),
    ("families.0.rows", ["d >= u"], "problem.families.0: expression 'd >= u': unknown name 'u'"),
    ("families.0.rows", ["d > t"], "problem.families.0: row 'd > t': expected <= or >="),
    ("families.0.rows", ["d*d <= t"], "problem.families.0: row 'd*d <= t': it is not affine"),
    ("families.0.rows", ["sin(d) <= t"], "problem.families.0: row 'sin(d) <= t'"),
    ("families.0.rows", ["a[2] <= t"], "a[2]: expected a number from 0 to 1, got 2"),
    ("families.0.name", "", "problem.families.0.name"),
    ("families.0.nme", "x", "problem.families.0.nme: unknown key; did you mean 'name'?"),
    ("families", [PROGRAM["families"][0]] * 2, "families: names must differ"),
    ("decision.a.size", 0, "problem.decision.a.size: must be greater than or equal to 1"),
    ("decision.a.lower", [1, 2, 3], "problem.decision.a.lower: expected 2 numbers, got 3"),
    ("decision.d", {"lower": 2, "upper": 1}, "problem.decision.d.lower: expected numbers that are not above"),
    ("decision.sum", {}, "problem.decision.sum: expected a name"),
    ("decision", {}, "problem.decision"),
    ("minimise", "-d**2", "problem.minimise: expected a positive semidefinite matrix"),
    ("minimise", "a[0]*a[1]", "problem.minimise: expected a positive semidefinite matrix"),
    ("minimise", "-abs(d)", "problem.minimise: expected absolute values with weights of at least 0"),
    ("minimise", "d**3", "problem.minimise: objective 'd**3'"),
    ("minimise", "t", "problem.minimise: expression 't': unknown name 't'"),
    ("rows", ["d <= 1", "d < 1"], "problem.rows.1: row 'd < 1': expected <=, >= or =="),
    ("rows", ["a[0] <= t"], "problem.rows.0: expression 'a[0] <= t': unknown name 't'"),
    ("tables.c", [], "problem.tables.c: expected a list of finite numbers"),
    ("tables.d", [1.0], "problem.tables.d: expected a name that stands for one thing"),
    ("tablse", {}, "problem.tablse: unknown key; did you mean 'tables'?"),
]


@pytest.mark.parametrize(("path", "value", "message"), FAULTS)
def test_a_fault_of_a_program_is_told_with_its_key_and_status_2(
    path: str, value: object, message: str, command: Command, tmp_path: Path
) -> None:
    done = command("run", write(tmp_path, path, value), "--out", "out", "--no-figures")
    assert done.returncode == 2 and message in done.stderr
    assert "Traceback" not in done.stderr and not (tmp_path / "out").exists()


def test_every_command_takes_the_run_of_a_program_or_refuses_it_in_one_sentence(
    command: Command, tmp_path: Path
) -> None:
    config = write(tmp_path)
    done = command("run", config, "--out", "out")
    assert done.returncode == 0, done.stderr
    result = json.loads((tmp_path / "out" / "result.json").read_text())
    assert result["status"] == "certified" and result["cost"] == pytest.approx(VALUE, abs=1e-7)
    assert command("check", "out").returncode == 0
    compared = command("compare", "out", "out")
    assert compared.returncode == 0, compared.stderr
    drawn = command("figures", "out")
    assert drawn.returncode == 0 and "slacks" in drawn.stdout
    for arguments in (
        ["simulate", "out"],
        ["bound", "out"],
        ["bound", config],
        ["margin", config],
        ["initial-states", config],
        ["loop", "out"],
    ):
        done = command(*arguments)
        assert done.returncode == 2 and done.stderr.startswith("error: ") and done.stderr.count("\n") == 1, arguments
        assert "control" in done.stderr


def test_a_forged_result_of_a_program_is_refuted_by_status_4(command: Command, tmp_path: Path) -> None:
    assert command("run", write(tmp_path), "--out", "out", "--no-figures").returncode == 0
    path = tmp_path / "out" / "certificate.json"
    data = json.loads(path.read_text())
    for change in ({"cost": data["cost"] - 1e-5}, {"lower_bound": data["lower_bound"] + 1e-5}, {"gap_tolerance": 1.0}):
        path.write_text(json.dumps({**data, **change}))
        done = command("check", "out")
        assert done.returncode == 4 and "fails" in done.stdout and "Traceback" not in done.stderr


@pytest.mark.parametrize(("given", "expected"), [(None, None), ("ridge", {"name": "ridge"}), ("", None)])
def test_a_program_has_no_regulariser_but_the_one_that_is_given(given: str | None, expected: object) -> None:
    config = {"problem": PROGRAM} if given == "" else {"problem": PROGRAM, "regulariser": given}
    assert load_config(config).config.plain()["regulariser"] == expected


def test_a_control_problem_keeps_its_regulariser_and_an_override_wins() -> None:
    system = {"A": [[0.0]], "B": [[1.0]]}
    problem = {"name": "linear", "system": system, "horizon": 1.0, "initial_state": [1.0], "control": {"box": 1.0}}
    assert load_config({"problem": problem}).config.plain()["regulariser"] == {"name": "ridge"}
    assert load_config({"problem": PROGRAM}, ["regulariser=ridge"]).config.plain()["regulariser"] == {"name": "ridge"}


def test_a_study_of_programs_runs_over_tables_and_bounds(command: Command, tmp_path: Path) -> None:
    config = write(tmp_path)
    done = command("sweep", config, "problem.decision.d.upper=5,0.01", "--out", "bounds")
    assert done.returncode == 0 and "certified" in done.stdout and "infeasible" in done.stdout
    done = command("sweep", config, "problem.tables.c=[1,2],[2,2]", "--out", "tables")
    assert done.returncode == 0 and done.stdout.count("certified") >= 2


def test_an_impossible_program_is_told_in_the_words_of_its_rows(command: Command, tmp_path: Path) -> None:
    (tmp_path / "impossible.yaml").write_text(
        """
problem:
  name: program
  decision: {a: {size: 2, lower: -1, upper: 1}}
  minimise: a[0]
  families:
    - {name: above, index: {t: [0, 1]}, rows: ["a[0] + a[1]*t >= 1 + t^2"]}
    - {name: below, index: {t: [0, 1]}, rows: ["a[0] + a[1]*t <= 1.2"]}
"""
    )
    done = command("run", "impossible.yaml", "--out", "out")
    assert "infeasible" in done.stdout and done.returncode == 3
    assert "above, a[0] + a[1]*t >= 1 + t^2 at t = 1" in " ".join(done.stdout.split())
