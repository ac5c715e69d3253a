"""Guards checker: finished runs are verified, and no forged one is: every kind of forgery once crudely, and once so
that only the mathematics can notice."""

from __future__ import annotations

import copy
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

import sparserob_core as sr
from sparserob_core.errors import SparseRobError
from sparserob_core.experiment.check.check import Check, check
from tests.support.tampering import CONFIG, FILES, KINDS, NONSENSICAL, forged

SPRING: dict[str, Any] = {
    "name": "linear",
    "system": {"A": [[0, 1], [-2, -0.5]], "B": [[0], [1]]},
    "horizon": 5.0,
    "initial_state": [-1, 1],
    "control": {"box": 1.0},
    "disturbance": {"box": [0.05, 0.05]},
    "path": [{"box": [0.7, None], "from": 0.3}],
    "terminal": [{"box": [0.3, 0.3]}],
}
DECAY: dict[str, Any] = {
    "name": "linear",
    "system": {"A": [["-p1"]], "B": [[1]], "parameters": {"p1": [0.5, 1.0]}},
    "horizon": 1.0,
    "initial_state": [2],
    "control": {"box": 1.0},
    "terminal": [{"box": [0.5]}],
}


def on(pieces: int, problem: dict[str, Any], **more: Any) -> dict[str, Any]:
    return {
        "problem": problem,
        "dictionaries": {"control": {"name": "piecewise_constant", "pieces": pieces}},
        "observers": [],
        **more,
    }


CONFIGS: dict[str, dict[str, Any]] = {
    "known": on(40, SPRING),
    "one parameter": on(20, DECAY),
    "two parameters": on(
        20,
        {
            **SPRING,
            "system": {
                "A": [[0, 1], ["-2 + p1", "-0.5"]],
                "B": [[0], ["1 + p2"]],
                "parameters": {"p1": [-0.02, 0.02], "p2": [-0.02, 0.02]},
            },
            "horizon": 2.0,
            "disturbance": None,
            "path": [],
            "terminal": [{"box": [0.6, 0.9]}],
        },
    ),
    "infeasible": on(
        20,
        {
            "name": "linear",
            "system": {"A": [[0, 1], [0, 0]], "B": [[0], [1]]},
            "horizon": 2.0,
            "initial_state": [1, 0],
            "control": {"box": 1.0},
            "disturbance": {"box": [0.0, 0.4]},
            "terminal": [{"box": [0.3, 0.3]}],
        },
    ),
    "refuted": on(40, SPRING, method={"name": "nominal"}),
    "refuted parameter": on(20, DECAY, method={"name": "nominal"}),
    "minimum attention": on(
        25,
        {
            **SPRING,
            "name": "minimum_attention",
            "initial_control": 0.0,
            "rate": {"box": 2.0},
            "disturbance": {"box": [0.02, 0.02]},
        },
    ),
    "walsh": {
        "problem": {**SPRING, "disturbance": {"box": [0.03, 0.03]}},
        "observers": [],
        "dictionaries": {
            "control": {"name": "walsh", "pieces": 32, "functions": 16},
            "disturbance": {"name": "piecewise_constant", "pieces": 32},
        },
    },
    "haar": {
        "problem": {**SPRING, "disturbance": {"box": [0.02, 0.02]}},
        "observers": [],
        "dictionaries": {
            "control": {"name": "haar", "pieces": 32, "functions": 16},
            "disturbance": {"name": "piecewise_constant", "pieces": 32},
        },
    },
    "ellipsoidal": on(
        15,
        {
            **SPRING,
            "system": {"A": [[0, 1], [-1, -0.1]], "B": [[0], [1]]},
            "horizon": 3.0,
            "initial_state": [1, 0],
            "control": {"box": 0.5},
            "disturbance": {"ellipsoid": {"centre": [0, 0], "shape": [[0.0004, 0.0001], [0.0001, 0.0004]]}},
            "path": [],
            "terminal": [{"ellipsoid": {"centre": [0, 0], "shape": [[0.36, 0], [0, 0.25]]}}],
        },
    ),
    "equality": on(
        10,
        {
            "name": "linear",
            "system": {
                "A": [[0, 1, 0], ["-2 + p1", -0.5, 0], [0, 0, 0]],
                "B": [[0], [1], [1]],
                "E": [[1], [0], [0]],
                "parameters": {"p1": [-0.5, 0.5]},
            },
            "horizon": 3.0,
            "initial_state": [0.5, 0, 1],
            "control": {"box": 1.0},
            "disturbance": {"box": [0.01]},
            "terminal": [{"equals": [None, None, 0.0]}],
        },
    ),
    "integrator": on(10, {**DECAY, "system": {"A": [[0]], "B": [[1]]}, "control": {"box": 2.0}}),
    "tiny": on(
        10,
        {
            **DECAY,
            "system": {"A": [[0]], "B": [[1]]},
            "initial_state": [2e-6],
            "control": {"box": 1e-5},
            "terminal": [{"box": [5e-7]}],
        },
    ),
    "growth": on(
        4,
        {
            **DECAY,
            "system": {"A": [[1.0]], "B": [[1]], "E": [[1, -1]]},
            "initial_state": [0],
            "disturbance": {"box": {"lower": [-0.01, -0.01], "upper": [0.01, 0.01]}},
            "terminal": [{"box": [1.0]}],
        },
    ),
    "rounded": {
        "problem": {
            **DECAY,
            "system": {"A": [[-1.0]], "B": [[1, 1]]},
            "control": {"norm": {"p": 1.5, "radius": 1.0}},
            "terminal": [{"box": [10.0]}],
        },
        "dictionaries": {"control": {"name": "walsh", "pieces": 4}},
        "observers": [],
    },
}
STATUS = {"infeasible": "infeasible", "refuted": "refuted", "refuted parameter": "refuted"}
Runs = Callable[[str], Path]


@pytest.fixture(scope="module")
def runs(tmp_path_factory: pytest.TempPathFactory) -> Runs:
    """The directory of an honest run, by its name; each is run once."""
    made: dict[str, Path] = {}

    def directory(name: str) -> Path:
        if name not in made:
            made[name] = tmp_path_factory.mktemp("honest") / "run"
            sr.run(copy.deepcopy(CONFIGS[name]), out=made[name], figures=False)
        return made[name]

    return directory


def failing(found: Check) -> list[str]:
    return [f"{claim.name}: {claim.text}" for claim in found.claims if claim.verdict != "holds"]


@pytest.mark.parametrize("name", CONFIGS)
def test_every_claim_of_an_honest_run_holds(name: str, runs: Runs) -> None:
    found = check(runs(name))
    assert failing(found) == []
    assert found.status == "verified"
    assert json.loads((runs(name) / "result.json").read_text())["status"] == STATUS.get(name, "certified")
    assert {"config", "result.json", "solution.npz"} < {claim.name for claim in found.claims}


def refused(directory: Path) -> bool:
    """Whether a run is not accepted: a claim is not shown, or the input is at fault. Anything but these is an error of
    the test."""
    try:
        return check(directory).status != "verified"
    except SparseRobError:
        return True


@pytest.mark.parametrize("kind", {**KINDS, **NONSENSICAL})
def test_a_forgery_is_refused_by_its_mathematics_alone(kind: str, runs: Runs, tmp_path: Path) -> None:
    name, change = {**KINDS, **NONSENSICAL}[kind]
    assert refused(forged(runs(name), tmp_path / "forged", change, consistent=True))


@pytest.mark.parametrize("kind", [*KINDS, *FILES])
def test_a_crude_forgery_is_refused(kind: str, runs: Runs, tmp_path: Path) -> None:
    name, change = {**KINDS, **FILES}[kind]
    assert refused(forged(runs(name), tmp_path / "forged", change, consistent=False))


def test_there_are_many_kinds_of_forgery() -> None:
    assert len(KINDS) + len(FILES) >= 45


@pytest.mark.parametrize("kind", CONFIG)
def test_a_changed_config_no_longer_has_the_recorded_digest(kind: str, runs: Runs, tmp_path: Path) -> None:
    name, change = CONFIG[kind]
    directory = forged(runs(name), tmp_path / "forged", change, consistent=False)
    try:
        found = check(directory)
    except SparseRobError:
        return
    if kind != "the gap may be larger, in the certificate":
        assert found.claims[0].name == "config"
        assert found.claims[0].verdict == "fails"


def test_a_copy_that_was_only_rewritten_is_verified(runs: Runs, tmp_path: Path) -> None:
    for name in CONFIGS:
        assert check(forged(runs(name), tmp_path / name, lambda files: None, consistent=True)).status == "verified"


def test_a_truncated_certificate_is_an_input_error(runs: Runs, tmp_path: Path) -> None:
    directory = forged(runs("known"), tmp_path / "forged", lambda files: None, consistent=True)
    file = directory / "certificate.json"
    whole = file.read_text()
    for text in (whole[:-10], "", "[]", "1", "null", "[" * 100_000):
        file.write_text(text)
        with pytest.raises(sr.InputError, match=r"certificate\.json"):
            check(directory)
    file.write_bytes(b"\xff\xfe\x00")
    with pytest.raises(sr.InputError, match=r"certificate\.json"):
        check(directory)


def test_the_command_ends_with_a_status_for_scripts(runs: Runs, tmp_path: Path, command: Callable[..., Any]) -> None:
    honest = command("check", runs("known"))
    assert (honest.returncode, honest.stderr) == (0, "")
    assert "verified" in honest.stdout
    name, change = KINDS["the lower bound is as high as the cost"]
    false = command("check", forged(runs(name), tmp_path / "forged", change, consistent=True), "--json")
    assert (false.returncode, json.loads(false.stdout)["status"]) == (4, "refuted")
    nothing = command("check", tmp_path)
    assert nothing.returncode == 2
    assert "expected the directory of a run" in nothing.stderr
    assert "Traceback" not in nothing.stderr
