"""Guards experiment/loop and the command ``sparserob loop``: what is written, what is claimed, and what is refused."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import numpy as np
import pytest

import sparserob_core as sr
from sparserob_core.experiment.cli.main import main

BASE = {
    "title": "A spring in closed loop",
    "problem": {
        "name": "linear",
        "system": {"A": [[0, 1], [-2, -0.5]], "B": [[0], [1]]},
        "horizon": 3.0,
        "initial_state": [-1, 1],
        "control": {"box": 1.0},
        "disturbance": {"box": [0.2, 0.2]},
        "path": [{"box": [0.7, None], "from": 0.5}],
        "terminal": [{"box": [0.4, 0.6]}],
    },
    "dictionaries": {"control": {"name": "piecewise_constant", "pieces": 10}},
    "policy": {"name": "affine", "cost": "peak"},
}


@pytest.fixture(scope="module")
def config(tmp_path_factory) -> Path:
    file = tmp_path_factory.mktemp("configs") / "spring.yaml"
    file.write_text(json.dumps(BASE))
    return file


@pytest.fixture(scope="module")
def outcome(config, tmp_path_factory) -> sr.Outcome:
    return sr.run(config, out=tmp_path_factory.mktemp("runs") / "run", quiet=True, figures=False)


def status(*arguments: object) -> int:
    with pytest.raises(SystemExit) as ended:
        main([str(one) for one in arguments])
    return int(ended.value.code)


@pytest.mark.slow
def test_a_study_counts_its_loops_and_pays_no_more_than_the_peaks(outcome) -> None:
    found = sr.loop(outcome, trajectories=3)
    assert found.laws == {"adversary": 2, "iid": 3, "vertices": 3, "slow": 3, "neighbours": 3}
    assert found.steps == 14 * 10
    assert not found.contradicts
    assert found.costs.max() <= outcome.result.cost * (1.0 + 1e-7)  # the cost peak bounds that of every loop
    told = json.loads((outcome.directory / "loop.json").read_text())
    assert told["steps"] == found.steps
    assert told["cost"]["plan"] == pytest.approx(float(np.abs(outcome.control[0]).sum() * 0.3))
    assert set(told["cost"]["laws"]) == set(found.laws)
    assert sum(told["cost"]["laws"][law]["mean"] * n for law, n in found.laws.items()) == pytest.approx(
        sum(found.costs)
    )
    assert {one["name"] for one in told["constraints"]} == {"path", "terminal", "control"}
    assert told["milliseconds"]["median"] <= told["milliseconds"]["99%"] <= told["milliseconds"]["largest"]


def test_the_same_seed_gives_the_same_loops(outcome) -> None:
    first, again, other = (sr.loop(outcome, trajectories=2, seed=seed) for seed in (1, 1, 2))
    assert np.array_equal(first.costs, again.costs)
    assert not np.array_equal(first.costs, other.costs)


def test_the_worst_case_of_every_constraint_is_reached_in_the_loop(outcome) -> None:
    found = sr.loop(outcome, trajectories=1)
    assert found.constraints["path"][0] > -1e-5
    assert found.constraints["terminal"][0] > -1e-5


@pytest.mark.slow
def test_a_loop_that_is_solved_anew_pays_less(config, tmp_path) -> None:
    coarse = {"dictionaries.control.pieces": 6}
    outcome = sr.run(config, coarse, out=tmp_path / "run", quiet=True, figures=False)
    applied, anew = (sr.loop(outcome, resolve, 1) for resolve in (False, True))
    assert anew.resolved > 0
    assert anew.costs.mean() < applied.costs.mean()
    assert not anew.contradicts


def test_re_solves_are_asked_of_the_solver_that_the_config_names(tmp_path, monkeypatch) -> None:
    clarabel = pytest.importorskip("sparserob_clarabel").Clarabel
    asked, solve = [], clarabel.solve
    monkeypatch.setattr(clarabel, "solve", lambda *one: (asked.append(one), solve(*one))[1])
    known = {key: value for key, value in BASE.items() if key != "policy"}
    known["problem"] = {**known["problem"], "disturbance": {"box": [0.02, 0.02]}}
    changes = {"solver.name": "clarabel", "dictionaries.control.pieces": 5}
    outcome = sr.run(known, changes, out=tmp_path / "run", quiet=True, figures=False)
    asked.clear()
    sr.loop(outcome, False, 1)
    assert not asked
    assert sr.loop(outcome, True, 1).resolved > 0
    assert asked


@pytest.mark.slow
def test_the_command_runs_a_config_and_closes_the_loop(config, tmp_path, capsys) -> None:
    out = tmp_path / "run"
    assert status("loop", config, "problem.disturbance.box=[0.1,0.1]", "--out", out, "--trajectories", 1) == 0
    said = capsys.readouterr().out
    assert "no loop violates a constraint" in said
    assert (out / "figures" / "loop.png").stat().st_size > 10_000
    assert json.loads((out / "loop.json").read_text())["loops"]["iid"] == 1
    assert status("loop", out, "--json", "--no-figures", "--trajectories", 1) == 0
    assert json.loads(capsys.readouterr().out)["steps"] == 60


def test_nothing_uncertain_is_one_loop(config, tmp_path) -> None:
    plain = {**BASE, "problem": {**BASE["problem"], "disturbance": None}, "policy": {"name": "open_loop"}}
    found = sr.loop(sr.run(plain, out=tmp_path / "run", quiet=True, figures=False))
    assert found.laws["iid"] == 1
    assert found.costs == pytest.approx(found.cost)


def test_an_infeasible_config_has_no_loop(config, tmp_path, capsys) -> None:
    arguments = ("problem.disturbance.box=[3,3]", "--out", tmp_path / "run", "--no-figures")
    assert status("loop", config, *arguments) == 3
    assert "no loop without a proven control" in capsys.readouterr().err
    assert status("loop", tmp_path / "run") == 2
    assert "there is no" in capsys.readouterr().err
    assert not (tmp_path / "run" / "loop.json").exists()


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (("--trajectories", "0"), "trajectories: expected"),
        (("--seed", "-1"), "seed: expected"),
        (("--seconds", "1"), "seconds: is the time of a re-solve"),
        (("--resolve", "--seconds", "-1"), "seconds"),
        (("solver.name=piqp",), "is a finished run: expected no KEY=VALUE"),
        (("--out", "elsewhere"), "is a finished run: expected no KEY=VALUE and no --out"),
    ],
)
def test_bad_arguments_are_refused_in_one_sentence(outcome, arguments, said, capsys) -> None:
    (outcome.directory / "loop.json").unlink(missing_ok=True)
    assert status("loop", outcome.directory, *arguments) == 2
    error = capsys.readouterr().err
    assert said in error
    assert error.count("\n") == 1
    assert not (outcome.directory / "loop.json").exists()


def test_what_is_no_run_is_refused(tmp_path, capsys) -> None:
    assert status("loop", tmp_path / "nothing.yaml") == 2
    assert status("loop", tmp_path) == 2
    assert "expected the directory of a run" in capsys.readouterr().err


@pytest.mark.first(2)
@pytest.mark.parametrize("name", ["theta", "control", "gains", "decision"])
def test_another_control_than_the_proven_one_is_not_applied(name: str, outcome, tmp_path) -> None:
    """Whoever changes one array of solution.npz is found out by the others and by the certificate."""
    copy = tmp_path / "copy"
    shutil.copytree(outcome.directory, copy)
    arrays = dict(np.load(copy / "solution.npz"))
    sr.controller(copy)
    changed = arrays[name].copy()
    changed.flat[int(np.abs(changed).argmax())] += 1e-3
    np.savez(copy / "solution.npz", **{**arrays, name: changed})
    with pytest.raises(sr.InputError, match="sparserob check says"):
        sr.controller(copy)
    with pytest.raises(sr.InputError, match="sparserob check says"):
        sr.loop(copy, trajectories=1)


def test_a_whole_policy_that_was_exchanged_is_not_applied(outcome, tmp_path) -> None:
    """All arrays of solution.npz agree, with a control without gains, which is not that of the certificate."""
    copy = tmp_path / "copy"
    shutil.copytree(outcome.directory, copy)
    arrays = dict(np.load(copy / "solution.npz"))
    arrays["decision"][arrays["theta"].size :] = 0.0
    arrays["gains"][:] = 0.0
    np.savez(copy / "solution.npz", **arrays)
    with pytest.raises(sr.InputError, match=r"gains: .* hold two different controls"):
        sr.controller(copy)
