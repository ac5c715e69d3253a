"""Guards experiment.config.extending: what a config takes from the one that it extends, and whose line errors name."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from ruamel.yaml import YAML

import sparserob_core as sr
from sparserob_core.experiment.config.load import load_config

BASE = """\
title: Base
problem:
  name: linear
  system: {A: [[0, 1], [-2, -0.5]], B: [[0], [1]]}
  horizon: 5.0
  initial_state: [-1, 1]
  control: {box: 1.0}
  disturbance: {box: 0.05}
  path: [{box: [0.7, null], from: 0.3}]
  terminal: [{box: [0.3, 0.3]}]
dictionaries: {control: {pieces: 20}, disturbance: {pieces: 10}}
method: {name: sparserob, indices: 5}
solver: piqp
regulariser: {name: ridge}
limits: {seconds: 60}
"""


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    (tmp_path / "base.yaml").write_text(BASE)
    return tmp_path


def child(folder: Path, text: str, name: str = "child.yaml") -> Path:
    """A config that extends the base."""
    file = folder / name
    file.parent.mkdir(exist_ok=True)
    file.write_text(text)
    return file


def plain(file: Path, *overrides: str) -> dict[str, Any]:
    return load_config(file, overrides).config.plain()


def whole(**changes: Any) -> dict[str, Any]:
    """What the base says with other values at some keys, resolved."""
    return load_config({**YAML(typ="safe").load(BASE), **changes}).config.plain()


def test_without_keys_of_its_own_it_is_the_other_one(folder: Path) -> None:
    assert plain(child(folder, "extends: base.yaml")) == whole()
    assert plain(child(folder, "extends: base.yaml"), "seed=3") == whole(seed=3)


def test_keys_of_sections_and_of_components_are_taken_one_by_one_and_values_whole(folder: Path) -> None:
    found = plain(
        child(
            folder,
            "extends: base.yaml\n"
            "problem: {control: {norm: {p: 2, radius: 1}}, path: []}\n"
            "dictionaries: {control: {pieces: 40}}\n"
            "method: {indices: 7}\n"
            "solver: {max_iterations: 99}\n"
            "regulariser: null\n"
            "limits: {seconds: null}\n",
        )
    )
    problem = YAML(typ="safe").load(BASE)["problem"]
    assert found == whole(
        problem={**problem, "control": {"norm": {"p": 2, "radius": 1}}, "path": []},
        dictionaries={"control": {"pieces": 40}, "disturbance": {"pieces": 10}},
        method={"name": "sparserob", "indices": 7},
        solver={"name": "piqp", "max_iterations": 99},
        regulariser=None,
        limits={"seconds": None},
    )


@pytest.mark.parametrize("method", ["exchange", "{name: exchange, rounds: 7}"])
def test_another_component_leaves_the_options_of_the_first_behind(folder: Path, method: str) -> None:
    found = plain(child(folder, f"extends: base.yaml\nmethod: {method}"))
    assert found["method"] == whole(method=YAML(typ="safe").load(method))["method"]


def test_a_component_without_a_name_is_the_one_that_is_meant_there(folder: Path) -> None:
    child(folder, "extends: base.yaml\nmethod: {name: exchange, rounds: 7}", "middle.yaml")
    child(folder, BASE.replace("{name: sparserob, indices: 5}", "{rounds: 9}"), "plain.yaml")
    assert plain(child(folder, "extends: plain.yaml\nmethod: {name: exchange, tolerance: 1.0e-3}"))["method"] | {
        "exact": None
    } == whole(method={"rounds": 9, "tolerance": 1e-3})["method"] | {"exact": None}


def test_a_chain_and_its_files_are_relative_to_whoever_names_them(folder: Path) -> None:
    np.savez(folder / "plant.npz", A=np.array([[0.0, 1.0], [-3.0, -0.5]]))
    (folder / "own.py").write_text(
        "import sparserob_core\n\n\n@sparserob_core.hookimpl\ndef sparserob_sets():\n    return []\n"
    )
    named = "problem: {system: {A: {file: plant.npz, name: A}, B: [[0], [1]]}}\nplugins: [own.py]\n"
    child(folder, f"extends: base.yaml\n{named}", "middle.yaml")
    found = plain(child(folder, "extends: ../middle.yaml\nseed: 5", "below/child.yaml"))
    assert found["seed"] == 5 and found["title"] == "Base"
    assert found["plugins"] == [str(folder / "own.py")]
    assert found["problem"]["system"] == plain(folder / "middle.yaml")["problem"]["system"]


def test_the_run_is_complete_and_checked_and_a_study_of_it_too(folder: Path) -> None:
    file = child(folder, "extends: base.yaml\nmethod: exchange\nsolver: auto\ntitle: Child")
    outcome = sr.run(file, out=folder / "run", quiet=True, figures=False)
    assert "extends" not in (folder / "run" / "config.yaml").read_text()
    (folder / "base.yaml").unlink()
    assert sr.check(folder / "run").status == "verified"
    assert plain(folder / "run" / "config.yaml") == outcome.experiment.loaded.config.plain()


def test_a_study_may_be_of_one(folder: Path) -> None:
    child(folder, "extends: base.yaml\nmethod: exchange\nsolver: auto")
    study = child(folder, "base: child.yaml\naxes: {problem.horizon: [4.0, 5.0]}", "study.yaml")
    found = sr.sweep(study, out=folder / "study")
    assert [row["status"] for row in found.table] == ["certified", "certified"]


@pytest.mark.parametrize(
    "text, said",
    [
        ("extends: base.yaml\nproblem: {horizont: 1}", "child.yaml:2:11: problem.horizont: unknown key"),
        ("extends: wrong.yaml", "wrong.yaml:2:3: limits.seconds: must be greater than 0"),
        ("extends: base.yaml\nlimits: {seconds: -1}", "child.yaml:2:10: limits.seconds: must be greater than 0"),
        ("extends: matrix.yaml", "matrix.yaml:2:20: problem.system.A: file: "),
        ("extends: 3", "child.yaml:1:1: extends: expected the file of a config .got 3."),
        ("extends: [base.yaml]", "child.yaml:1:1: extends: expected the file of a config"),
        ("seed: 1\nextends: nowhere.yaml", "child.yaml:2:1: extends: .*nowhere.yaml: there is no such file"),
        ("extends: child.yaml", "in a circle: child.yaml -> child.yaml"),
        ("extends: first.yaml", "second.yaml:1:1: extends: .* in a circle: first.yaml -> second.yaml -> first.yaml"),
    ],
)
def test_an_error_names_the_file_and_the_line_that_decide(folder: Path, text: str, said: str) -> None:
    child(folder, "extends: base.yaml\nlimits:\n  seconds: -3", "wrong.yaml").write_text(
        "limits:\n  seconds: -3\n" + BASE.replace("limits: {seconds: 60}\n", "")
    )
    child(folder, "extends: base.yaml\nproblem: {system: {A: {file: none.npz, name: A}}}", "matrix.yaml")
    child(folder, "extends: second.yaml", "first.yaml")
    child(folder, "extends: first.yaml", "second.yaml")
    with pytest.raises(sr.ConfigError, match=said):
        load_config(child(folder, text))


def test_what_somebody_has_left_extends_nothing(folder: Path) -> None:
    file = child(folder, "extends: base.yaml\nmethod: exchange\nsolver: auto")
    sr.run(file, out=folder / "run", quiet=True, figures=False)
    child(folder, "extends: ../base.yaml", "run/config.yaml")
    with pytest.raises(sr.InputError, match="extends"):
        sr.check(folder / "run")
