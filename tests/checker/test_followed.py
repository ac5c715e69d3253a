"""Guards checker/claims/constraints: rows of known systems that are followed by their adjoints, as those of many states
are, are shown where they hold, and nowhere else."""

from __future__ import annotations

import copy
from pathlib import Path
from typing import Any

import pytest

import sparserob_core as sr
from sparserob_core.checker.reach import followed as followed_rows
from tests.checker.test_check import DECAY, SPRING, on
from tests.support.tampering import Forgery, forged

BEGUN = {**SPRING, "initial_state": {"centre": [-1, 1], "box": [0.01, 0.02]}}
HELD = {**DECAY, "system": {"A": [[-1.0]], "B": [[1]]}, "disturbance": {"box": [0.1]}}
KINDS: dict[str, tuple[dict[str, Any], str]] = {
    "initial states": (on(10, {**BEGUN, "disturbance": {"box": [0.02, 0.02]}}), "terminal"),
    "measurable": (on(10, {**SPRING, "disturbance": {"box": [0.03, 0.03]}, "disturbance_class": "measurable"}), "path"),
    "mixed": (on(6, {**HELD, "path": [{"mixed": {"H": [[1.0]], "G": [[0.3]], "h": [1.9]}, "from": 0.2}]}), "path"),
    "integral": (
        on(
            10,
            {
                **BEGUN,
                "disturbance": {"box": [0.02, 0.02]},
                "integral": [{"H": [[1.0, 0.0]], "G": [[0.1]], "from": 0.3, "to": 1.9, "lower": [-1.0], "name": "sum"}],
            },
        ),
        "sum",
    ),
}


@pytest.fixture(autouse=True)
def few_states(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(followed_rows, "FOLLOWED", 1)


@pytest.mark.parametrize("kind", [pytest.param(k, marks=pytest.mark.slow) if k == "integral" else k for k in KINDS])
def test_rows_hold_along_their_adjoints_and_not_for_another_control_or_wall(kind: str, tmp_path: Path) -> None:
    config, active = KINDS[kind]
    sr.run(copy.deepcopy(config), out=tmp_path / "run", quiet=True, figures=False)
    found = sr.check(tmp_path / "run")
    assert [claim for claim in found.claims if claim.verdict != "holds"] == []

    def change(files: Forgery) -> None:
        if kind == "mixed":
            files.problem["path"][0]["mixed"]["h"] = [1.0]
        elif kind == "integral":
            files.problem["integral"][0]["lower"] = [1.0]
        else:
            files.certificate["decision"] = [[0.999 * value for value in row] for row in files.decision]

    tampered = sr.check(forged(tmp_path / "run", tmp_path / "forged", change, consistent=True))
    assert {claim.verdict for claim in tampered.claims if claim.name == active} == {"fails"}
