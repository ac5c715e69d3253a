"""Guards the certificates of every method: what a run claims, `check` confirms or leaves alone, and never refutes,
whatever the number of uncertain parameters and the form of the indices."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import sparserob_core as sr

METHODS: dict[str, dict[str, Any]] = {
    "exchange": {"name": "exchange"},
    "sparserob reduced": {"name": "sparserob", "formulation": "reduced", "indices": 6},
    "sparserob literal": {"name": "sparserob", "formulation": "literal", "indices": 6},
    "nominal": {"name": "nominal"},
    "scenario": {"name": "scenario", "scenarios": 30},
}
SYSTEMS = {
    0: {"A": [[0, 1], [0, 0]], "B": [[0], [1]]},
    1: {"A": [[0, 1], [-1, "-0.2 - 3*p1"]], "B": [[0], [1]], "parameters": {"p1": [-0.1, 0.1]}},
    2: {
        "A": [[0, 1], ["-1 + p2", "-0.2 - 3*p1"]],
        "B": [[0], [1]],
        "parameters": {"p1": [-0.1, 0.1], "p2": [0.0, 0.05]},
    },
}
FORMS = {
    "exchange": "reduced",
    "sparserob reduced": "reduced",
    "sparserob literal": "literal",
    "nominal": "nominal",
    "scenario": "sampled",
}


def config(method: str, parameters: int, **changes: object) -> dict[str, Any]:
    searching = METHODS[method]["name"] == "sparserob"
    return {
        "problem": {
            "name": "linear",
            "system": SYSTEMS[parameters],
            "horizon": 2.0,
            "initial_state": [0.6, 0.0],
            "control": {"box": 1.0},
            "disturbance": {"box": [0.0, 0.02]},
            "path": [{"box": [0.7, None]}],
            "terminal": [{"box": [0.3, 0.4]}],
            **changes,
        },
        "dictionaries": {"control": {"name": "piecewise_constant", "pieces": 8}},
        "method": METHODS[method],
        "maximiser": {"name": "random_search", "budget": 60 if searching else 100},
        "observers": [],
    }


def sizes() -> list[Any]:
    """Methods and numbers of parameters; a search over uncertain systems takes seconds."""
    large = {(name, 1) for name in METHODS if name.startswith("sparserob")} | {(name, 2) for name in METHODS}
    every = [(name, count) for name in METHODS for count in SYSTEMS]
    return [pytest.param(*pair, marks=pytest.mark.slow if pair in large else ()) for pair in every]


@pytest.mark.first(2)
@pytest.mark.parametrize(("method", "parameters"), sizes())
def test_no_honest_claim_fails_and_every_cut_says_what_its_index_is(
    method: str, parameters: int, tmp_path: Path
) -> None:
    outcome = sr.run(config(method, parameters), out=tmp_path / "run", figures=False, quiet=True)
    assert outcome.result.status in ("certified", "verified", "refuted")
    found = sr.check(tmp_path / "run")
    assert not [claim for claim in found.claims if claim.verdict == "fails"]
    unchecked = {claim.name for claim in found.claims if claim.verdict == "not checked"}
    assert unchecked <= ({"lower bound", "gap", "status"} if method == "scenario" else set())
    form = FORMS[method]
    assert {cut.formulation for cut in outcome.result.indices} == {form}
    with np.load(tmp_path / "run" / "solution.npz") as stored:
        assert set(stored["formulations"].tolist()) == {form}
    multipliers = json.loads((tmp_path / "run" / "certificate.json").read_text())["multipliers"]
    assert (multipliers is None) == (form == "sampled")


@pytest.mark.first(1)
@pytest.mark.parametrize("method", ["exchange", "scenario", "sparserob literal"])
def test_no_honest_proof_of_infeasibility_fails(method: str, tmp_path: Path) -> None:
    changes = {"terminal": [{"box": [0.001, 0.001]}]}
    outcome = sr.run(config(method, 1, **changes), out=tmp_path / "run", figures=False, quiet=True)
    assert outcome.result.status == "infeasible"
    assert not [claim for claim in sr.check(tmp_path / "run").claims if claim.verdict == "fails"]
