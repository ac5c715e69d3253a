"""Guards known answers: every line of the first table of docs/scope.md beside entries in `t`: a constant plant whose
entries are dressed with `0*t` costs what it costs without, and is certified and verified as it is; both lie between the
values of linear programs on samples."""

from __future__ import annotations

import copy
from pathlib import Path
from typing import Any

import pytest

import sparserob_core as sr
from sparserob_core.experiment.check.check import check
from tests.support.oracle import bounds_of, outside

Config = dict[str, Any]
SYSTEM: Config = {"A": [[0, 1], [-1, -0.2]], "B": [[0], [1]], "E": [[0], [1]]}
OTHER: Config = {**SYSTEM, "A": [[0, 1], [-0.5, -0.2]]}
BOTH: Config = {**SYSTEM, "B": [[1, 0], [0, 1]]}
PUSHED: Config = {**SYSTEM, "E": [[1, 0], [0, 1]]}
FREE: Config = {"A": SYSTEM["A"], "B": SYSTEM["B"]}
BASE: Config = {
    "name": "linear",
    "system": SYSTEM,
    "horizon": 2.0,
    "initial_state": [1.0, 0.0],
    "control": {"box": 1.0},
    "disturbance": {"box": 0.05},
    "terminal": [{"box": [0.35, 0.4]}],
}
SETS: Config = {
    "polytope": {"H": [[1, 0], [-1, 0], [0, 1], [0, -1]], "h": [0.05, 0.05, 0.05, 0.02]},
    "ellipsoid": {"centre": [0, 0], "shape": [[0.002, 0], [0, 0.003]]},
    "norm": {"p": 3, "radius": 0.05},
    "zonotope": {"centre": [0, 0], "generators": [[0.03, 0.01], [0.0, 0.04], [0.02, -0.01]]},
}
LIST: list[Config] = [
    {"set": {"box": 0.05}, "E": [[0], [1]], "from": 0.5, "to": 1.5},
    {"set": {"box": 0.02}, "E": [[1], [0]], "pieces": 4},
]
CLASSES: list[Config] = [
    {"set": {"box": 0.05}, "E": [[0], [1]], "class": "measurable"},
    {"set": {"box": 0.02}, "E": [[1], [0]]},
]
ROUND: Config = {"ellipsoid": {"centre": [0, 0], "shape": [[1.3, 0], [0, 1.0]]}}
QUADRATIC: Config = {
    "l1": 1.0,
    "state": {"Q": [[0.2, 0], [0, 0.1]]},
    "control": {"R": [[0.05]]},
    "final": {"Q": [[1, 0], [0, 1]]},
}
INTEGRAL: list[Config] = [{"H": [[1, 0]], "G": [[0.5]], "from": 0.5, "to": 1.8, "upper": 0.9}]
RETURNS: Config = {"initial_state": {"centre": [0, 0], "box": [0.6, 0.6]}, "terminal": [{"box": 0.6}], "repeat": True}
LINES: dict[str, Config] = {
    "drift": {"system": {**SYSTEM, "c": [0, -0.1]}},
    "delay": {"system": {**SYSTEM, "delay": 0.15}, "initial_control": [0.2]},
    "initial box": {"initial_state": {"centre": [1.0, 0.0], "box": [0.05, 0.05]}},
    **{
        f"{kind}, {of}": {"system": PUSHED, "disturbance": {kind: SETS[kind]}, "disturbance_class": of}
        for kind in SETS
        for of in ("piecewise_constant", "measurable")
    },
    "list": {"system": FREE, "disturbance": LIST},
    "two classes": {"system": FREE, "disturbance": CLASSES},
    "window": {"path": [{"box": [None, 0.8], "from": 0.4, "to": 1.6}]},
    "fixed": {"disturbance": None, "terminal": [{"equals": [0, 0]}]},
    "moving": {"path": [{"box": [1.1, None], "relative_to": [[0, 0, 0], [2, -0.2, 0]]}]},
    "mixed": {"path": [{"mixed": {"H": [[0, 1]], "G": [[0.5]], "h": [0.9]}, "from": 0.3}]},
    "integral": {"integral": INTEGRAL},
    "step": {"control_step": {"box": 0.5}},
    "prices": {"weights": [[0, 1], [1, 2]]},
    "quadratic": {"cost": QUADRATIC},
    "group": {"system": BOTH, "control": {"box": [1, 1]}, "cost": {"group": [[1, 2]]}},
    "execution": {"execution": [0.03]},
    "jitter": {"jitter": 0.05},
    "pieces": {"system": {"pieces": [{"until": 1.0, **SYSTEM}, {"until": 2.0, **OTHER}]}},
    "curved path": {"path": [ROUND]},
    "curved control": {"system": BOTH, "control": {"norm": {"p": 2, "radius": 1.0}}},
    "curved step": {
        "system": BOTH,
        "control": {"box": [1, 1]},
        "control_step": {"norm": {"p": 2, "radius": 0.5}},
    },
    "sparsest": {"top": {"method": {"name": "sparsest"}}},
    "alphabet": {"top": {"method": {"name": "sparsest", "alphabet": [-1, 0, 1]}}},
    "haar": {"top": {"dictionaries": {"control": {"name": "haar", "pieces": 8}}}},
    "affine": {"policy": "nominal"},
    "affine, charged its peak": {"policy": "peak"},
    "affine, charged its worst": {"policy": "worst"},
    "affine, for ever": {"policy": "nominal", **RETURNS},
    "affine, outputs": {
        "policy": "nominal",
        "measurements": {"C": [[1, 0]], "noise": {"box": 0.01}, "latency": 0.1},
    },
    "affine, delay": {"policy": "nominal", "system": {**SYSTEM, "delay": 0.15}},
    "affine, integral": {"policy": "nominal", "integral": [{**INTEGRAL[0], "G": [[0]]}]},
}


def dressed(config: Config) -> Config:
    made = copy.deepcopy(config)
    system = made["problem"]["system"]
    for one in system.get("pieces", [system]):
        one["A"] = [[f"{entry} + 0*t" for entry in row] for row in one["A"]]
    return made


def stated(name: str) -> Config:
    """The config of a line, plain."""
    line = dict(LINES[name])
    charge, top = line.pop("policy", None), line.pop("top", {})
    problem = {key: value for key, value in {**BASE, **line}.items() if value is not None}
    return {
        "problem": problem,
        "dictionaries": {"control": {"name": "piecewise_constant", "pieces": 6}},
        "observers": [],
        **top,
        **({} if charge is None else {"policy": {"name": "affine", "cost": charge, "causal_signals": 0}}),
    }


def cost(config: Config, directory: Path) -> float:
    outcome = sr.run(config, out=directory, quiet=True, figures=False)
    found = check(directory)
    assert [f"{claim.name}: {claim.text}" for claim in found.claims if claim.verdict != "holds"] == []
    assert (outcome.status, found.status) == ("certified", "verified")
    assert outcome.result is not None
    assert outside(outcome.result, bounds_of(config)) == []
    return outcome.result.upper_bound


@pytest.mark.slow
@pytest.mark.parametrize("name", LINES)
def test_a_constant_plant_that_is_dressed_costs_what_it_does_plain(name: str, tmp_path: Path) -> None:
    config = stated(name)
    plain, in_time = cost(config, tmp_path / "plain"), cost(dressed(config), tmp_path / "in time")
    assert in_time == pytest.approx(plain, rel=1e-8, abs=1e-9)
