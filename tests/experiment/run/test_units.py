"""Guards that the units of a problem stand behind what is told of it, row by row, and that nothing is said of a unit
that is not known."""

from __future__ import annotations

import json
import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import sparserob_core as sr
from sparserob_core.experiment.comparison.compare import comparison_table
from sparserob_core.experiment.margin.figure import draw_horizons
from sparserob_core.experiment.margin.margin import margin_rows
from sparserob_core.experiment.terminal.table import _format_worst, result_rows

NAMES = {
    "states": ["place", "speed"],
    "units": {"states": ["m", "m/s"], "controls": ["N", "N"], "disturbances": ["m/s", "m/s"], "time": "s"},
}
PROBLEM: dict[str, Any] = {
    "name": "linear",
    "system": {"A": [[0, 1], [0, 0]], "B": [[0, 0], [1, 0.5]]},
    "horizon": 2.0,
    "initial_state": {"centre": [0.5, 0.0], "box": [0.01, 0.01]},
    "control": {"box": 1.0},
    "disturbance": {"box": 0.02},
    "path": [{"box": [1.0, None]}],
    "terminal": [{"box": 0.2}],
}
PIECES = {"control": {"name": "piecewise_constant", "pieces": 4}}


@pytest.fixture(scope="module")
def outcome(tmp_path_factory: pytest.TempPathFactory) -> sr.Outcome:
    place = tmp_path_factory.mktemp("units") / "run"
    config = {"problem": {**PROBLEM, "names": NAMES}, "dictionaries": PIECES}
    return sr.run(config, out=place, quiet=True, figures=False)


def told(outcome: sr.Outcome) -> dict[str, str]:
    return dict(result_rows(outcome.summary))


def test_a_run_tells_units_row_by_row(outcome: sr.Outcome) -> None:
    rows = told(outcome)
    worst, where = outcome.summary["worst"], outcome.summary["units"]
    assert f"{worst['violation']:.2e} {where['worst']} in {worst['constraint']}" in rows["worst violation"]
    assert where["worst"] in {"m", "m/s"} and " s, from (0." in rows["worst violation"]
    assert rows["worst violation"].endswith(" m/s)")
    path, terminal = rows["kept"].split("terminal")
    assert path.startswith("path ") and " m " in path and " m/s" not in path
    assert " m" in terminal and " m/s" in terminal
    assert sorted(where["rows"]["terminal"]) == ["m", "m", "m/s", "m/s"]
    assert where["time"] == "s"
    assert where["cost"] == "N s" and all(rows[key].endswith(" N s") for key in ("cost", "lower bound", "upper bound"))
    said = {claim.name: claim.text for claim in sr.check(outcome).claims}
    assert said["cost"].endswith(" N s")
    assert re.search(r"less than [\d.e-]+ N s\b", said["lower bound"])


@pytest.mark.parametrize(
    ("controls", "time", "more", "expected"),
    [
        (["kW", "kW"], "h", {}, "kW h"),
        (["m/s^2", "m/s^2"], "s", {}, "m/s"),
        (["l/s", "l/s"], "s", {"cost": sr.Cost(l1=2.0, group="all")}, "l"),
        (["N", "A"], "s", {}, ""),
        (["N", ""], "s", {}, ""),
        (["N", "N"], "", {}, ""),
        (["N", "N"], "s", {"weights": 2.0}, ""),
        (["N", "N"], "s", {"weights": [[0.0, 1.0, 1.0], [1.0, 2.0, 1.0]]}, ""),
        (["N", "N"], "s", {"cost": sr.Cost(control={"R": [[1, 0], [0, 1]]})}, ""),
    ],
)
def test_a_cost_is_told_in_the_unit_of_control_and_time_where_nothing_else_is_added_up(
    controls: list[str], time: str, more: dict[str, Any], expected: str
) -> None:
    system = sr.LinearSystem(A=[[0, 1], [0, 0]], B=[[0, 0], [1, 0.5]])
    names = sr.Names(control_units=controls, time=time)
    problem = sr.OptimalControlProblem(
        system=system, horizon=2.0, initial_state=[1, 0], control=sr.Box([-1, -1], [1, 1]), names=names, **more
    )
    assert problem.cost_unit == expected


def test_horizons_and_comparisons_have_units(outcome: sr.Outcome) -> None:
    problem = PROBLEM | {"names": NAMES, "initial_state": [0.5, 0.0], "disturbance": None, "terminal": [{"box": 0.45}]}
    found = sr.margin({"problem": problem, "dictionaries": PIECES}, of="horizon", tolerance=0.05, write=False)
    assert found.quantity == "horizon [s]" and " s is feasible, proven on " in found.message
    assert found.cost_unit == "N s" and dict(margin_rows(found))["proven feasible"].endswith(" N s")
    axes = draw_horizons(replace(found, curve=(found.feasible,))).axes[0]
    assert axes.get_ylabel().endswith("[N s]") and axes.get_xlabel().endswith("[s]")
    columns, rows = comparison_table(sr.compare([outcome.directory, outcome.directory]))
    worst = outcome.summary["units"]["worst"]
    assert all(dict(zip(columns, row, strict=True))["worst violation"].endswith(f" {worst}") for row in rows)
    assert {"lower bound [N s]", "cost [N s]"} <= set(columns)


def test_a_parameter_is_told_by_its_name(tmp_path: Path) -> None:
    system = {"A": [[0, 1], [0, 0]], "B": [[0], ["1 / mass"]], "parameters": {"mass": [1.1, 1.3]}}
    problem = PROBLEM | {"system": system, "disturbance": None, "names": {"states": ["place", "speed"]}}
    outcome = sr.run({"problem": problem, "dictionaries": PIECES}, out=tmp_path / "run", quiet=True, figures=False)
    assert outcome.summary["parameters"] == ["mass"]
    assert ", mass = 1." in told(outcome)["worst violation"]
    said = {claim.name: (claim.verdict, claim.text) for claim in sr.check(outcome).claims}
    assert said["result.json"][0] == "holds"
    file = tmp_path / "run" / "result.json"
    file.write_text(file.read_text("utf-8").replace('"mass"', '"length"'), "utf-8")
    said = {claim.name: (claim.verdict, claim.text) for claim in sr.check(tmp_path / "run").claims}
    assert said["result.json"] == ("fails", "parameters are ['length'], not ['mass']")


def test_of_many_numbers_a_row_of_the_table_has_the_first() -> None:
    worst = {"violation": 0.5, "constraint": "path", "time": 1.0, "parameter": None, "initial_state": [0.0, 0.5] * 135}
    said = _format_worst(worst, {"states": [], "time": "s"}, ())
    assert said == "5.00e-01 in path at t = 1 s, from (0, 0.5, 0, 0.5, 0, 0.5, and 264 more)"
    few = {**worst, "initial_state": None, "parameter": [0.25] * 6}
    assert _format_worst(few, {}, ()).endswith("p = (0.25, 0.25, 0.25, 0.25, 0.25, 0.25)")
    many = {**few, "parameter": [0.25] * 8}
    assert _format_worst(many, {}, [f"k{i}" for i in range(8)]).endswith("k4 = 0.25, k5 = 0.25, and 2 more")


def test_shares_of_several_channels_say_of_what_they_are(outcome: sr.Outcome) -> None:
    rows = told(outcome)
    assert rows["share of time active"].endswith("%, in at least one channel")
    assert "of the time, the mean over its channels" in rows["fewest active"]
    assert outcome.summary["sparsity"]["channels"] == 2
    said = {claim.name: claim.text for claim in sr.check(outcome).claims}
    assert "the mean over its channels" in said["fewest active"]
    assert said["result.json"].endswith("of the time, in at least one channel")


def test_margins_of_a_check_have_the_units_of_their_rows(outcome: sr.Outcome) -> None:
    said = {claim.name: claim.text for claim in sr.check(outcome).claims}
    assert " m (" in said["path"]
    assert " m or m/s (" in said["terminal"]


class Heard(sr.Observer):
    def __init__(self) -> None:
        self.rounds: list[sr.RoundFinished] = []

    def receive(self, event: sr.Event) -> None:
        if isinstance(event, sr.RoundFinished):
            self.rounds.append(event)


@pytest.mark.first(1)
@pytest.mark.parametrize("policy", ["open_loop", "affine"])
def test_what_refutes_a_control_has_the_unit_of_its_row(tmp_path: Path, policy: str) -> None:
    moved = {"terminal": [{"box": 0.12}], "control_step": {"box": 0.9}}
    names = NAMES | {"units": NAMES["units"] | {"controls": ["kN", "kN"]}}
    config: dict[str, Any] = {
        "problem": {**PROBLEM, **moved, "names": names},
        "dictionaries": PIECES,
        "policy": {"name": policy},
        "method": {"name": "exchange" if policy == "affine" else "nominal"},
    }
    heard = Heard()
    outcome = sr.run(config, out=tmp_path / "run", quiet=True, figures=False, observers=[heard])
    said = {claim.name: claim.text for claim in sr.check(outcome).claims}
    rows = outcome.summary["units"]["rows"]
    for event in heard.rounds:
        family = event.separations[event.worst_family]
        mine = rows[event.worst_family]
        assert event.measured == mine[0 if len(mine) == 1 else int(family.rows[0])]
    if policy == "affine":
        assert {event.measured for event in heard.rounds} <= {"m", "m/s", "kN"}
        assert "pieces in their set" in said["control"]
    else:
        worst = outcome.summary["units"]["worst"]
        assert f" {worst}" in outcome.result.message.partition("terminal is violated by ")[2]
        assert said["violation"].endswith(f" {worst} at t = 2 s")


def test_a_row_of_the_control_under_feedback_is_told_by_name_and_unit() -> None:
    names = sr.Names(controls=["pull", "push"], control_units=["N", "N"], time="s")
    problem = sr.OptimalControlProblem(
        system=sr.LinearSystem(A=[[0.0]], B=[[1.0, 1.0]]),
        horizon=2.0,
        initial_state=[0.0],
        control=sr.Box([-1, -2], [1, 2]),
        control_step=sr.Box([-0.5, -0.5], [0.5, 0.5]),
        disturbance=sr.Box([-0.1], [0.1]),
        names=names,
    )
    pieces = sr.Dictionary([0.0, 0.5, 1.0, 1.5, 2.0], np.eye(4))
    program = sr.transcribe(problem, pieces, policy=sr.AffinePolicy())
    control, step = (program.family(name) for name in ("control", "control_step"))
    index = control.index_set.lower
    texts = [control.explanation(index, row).short() for row in range(4)]
    assert sorted(texts)[0].startswith("control: -pull(0") and any("push(0) <= 2 N" in text for text in texts)
    assert "the change of pull at 0.5 s <= 0.5 N" in step.explanation(step.index_set.lower, 0).short()
    assert {*control.measured, *step.measured} == {"N"}


def test_tables_of_samples_and_loops_have_units(outcome: sr.Outcome) -> None:
    columns, rows = sr.simulate(outcome, 5).table()
    path = dict(zip(columns, rows[0], strict=True))
    assert " m at t = " in path["largest violation seen"] and path["largest violation seen"].endswith(" s")
    assert path["worst case"].endswith(" m") and path["at"].endswith(" s")
    loops = dict(sr.loop(outcome, trajectories=1).table()[1])
    assert all(" N s" in text for row, text in loops.items() if row.startswith("cost "))
    assert loops["largest violation of path"].endswith(" m")
    assert loops["largest violation of control"].endswith(" N")


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"worst": "km"}, "units: 'km' is none of the config's"),
        ({"time": "h"}, "units: time is 'h', not 's'"),
        ({"cost": "kN s"}, "units: cost is 'kN s', not 'N s'"),
        ({"J": "s"}, "units: J is 's', not 'N s'"),
        ({"rows": 3}, "units is no mapping with rows"),
        ({"rows": {"path": 3}}, "units: 3 is none of the config's"),
    ],
)
def test_other_units_than_those_of_the_config_fail_the_check(
    outcome: sr.Outcome, tmp_path: Path, change: dict[str, Any], words: str
) -> None:
    for file in outcome.directory.iterdir():
        if file.is_file():
            (tmp_path / file.name).write_bytes(file.read_bytes())
    summary = json.loads((tmp_path / "result.json").read_text("utf-8"))
    summary["units"] |= change
    (tmp_path / "result.json").write_text(json.dumps(summary), "utf-8")
    said = {claim.name: (claim.verdict, claim.text) for claim in sr.check(tmp_path).claims}
    assert said["result.json"] == ("fails", words)


def test_nothing_is_said_of_units_that_nobody_has_named(tmp_path: Path) -> None:
    outcome = sr.run({"problem": PROBLEM, "dictionaries": PIECES}, out=tmp_path / "run", quiet=True, figures=False)
    assert "units" not in outcome.summary
    assert told(outcome)["kept"].startswith("path ") and " m" not in told(outcome)["kept"]


def test_the_table_says_who_answered_how_many_programs_each_under_the_name_it_is_known_by() -> None:
    from sparserob_core.experiment.terminal.table import _name_solvers

    counts = {"closed_form": 1, "osqp": 6, "dual_newton": 2, "highs": 3, "nobody": 1}
    said = _name_solvers(counts).split(", ")
    assert [int(part.split()[0]) for part in said if part[0].isdigit()] == list(counts.values())
    assert (
        "6 by osqp" in said
        and "2 by the dual Newton method" in said
        and "3 by HiGHS" in said
        and "1 not solved" in said
    )
    assert _name_solvers(None) == _name_solvers({}) == "unknown"
