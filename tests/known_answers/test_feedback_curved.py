"""Guards curved sets of states and controls under policy affine, against linear programs with many tangents that share
nothing with the package, and against forged certificates."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

import sparserob_core as sr
from sparserob_core.experiment.check.check import check
from tests.known_answers.test_feedback_rows import PIECES, SPRING, config, forged, program, proven, run, spring_rows

TANGENTS = 64
ELLIPSE = [[0.1, 0.02], [0.02, 0.1]]
THRUSTERS: dict[str, Any] = {
    **SPRING,
    "system": {"A": [[0, 1], [-1, -0.2]], "B": [[0.4, 0], [0, 1]], "E": [[0], [1]]},
    "control": {"norm": {"p": 2, "radius": 0.5}},
    "disturbance": {"box": 0.1},
    "path": [],
    "terminal": [{"box": [0.2, 0.2]}],
}


def tangents(shape: np.ndarray) -> list[tuple[np.ndarray, float]]:
    """Directions all around and how far the ellipse ``x'shape^-1 x <= 1`` reaches along them."""
    angles = np.linspace(0.0, 2.0 * np.pi, TANGENTS, endpoint=False)
    every = np.stack([np.cos(angles), np.sin(angles)], axis=1)
    return [(c, float(np.sqrt(c @ shape @ c))) for c in every]


@pytest.mark.slow
@pytest.mark.parametrize("cost", ["nominal", "peak"])
def test_an_elliptic_final_set_costs_what_its_tangents_say(cost: str, tmp_path: Path) -> None:
    problem = {**SPRING, "terminal": [{"ellipsoid": {"centre": [0, 0], "shape": ELLIPSE}}]}
    outcome = run(problem, tmp_path / "run", cost)
    proven(outcome)
    independent = program(problem, PIECES, [0.15, 0.15], [0.0, 0.0])
    spring_rows(independent, 8, end=False)
    x = independent.state(5.0)
    for c, limit in tangents(np.array(ELLIPSE)):
        independent.below(np.tensordot(c, x, 1), limit)
    found = independent.solve(1.0, cost)
    assert found <= outcome.result.cost * (1 + 1e-9)
    assert outcome.result.cost == pytest.approx(found, rel=5e-3)


@pytest.mark.slow
@pytest.mark.parametrize("cost", ["nominal", "peak"])
def test_a_round_set_of_controls_costs_what_its_tangents_say(cost: str, tmp_path: Path) -> None:
    outcome = run(THRUSTERS, tmp_path / "run", cost, pieces=6)
    proven(outcome)
    independent = program(THRUSTERS, 6, [0.1], [0.0, 0.0])
    x = independent.state(5.0)
    for state in (0, 1):
        for sign in (1.0, -1.0):
            independent.below(sign * x[state], 0.2)
    for k in range(6):
        for c, limit in tangents(0.25 * np.eye(2)):
            independent.below(np.tensordot(c, independent.control(k), 1), limit)
    found = independent.solve(0.5, cost)
    assert found <= outcome.result.cost * (1 + 1e-9)
    assert outcome.result.cost == pytest.approx(found, rel=5e-3)


SETS: dict[str, dict[str, Any]] = {
    "an elliptic path": {"path": [{"ellipsoid": {"centre": [0, 0], "shape": [[1.2, 0], [0, 2.0]]}, "from": 0.5}]},
    "a path of the 3-norm": {"path": [{"norm": {"p": 3, "radius": 1.4}, "from": 0.5}]},
    "an elliptic path and an elliptic disturbance": {
        "path": [{"ellipsoid": {"centre": [0, 0], "shape": [[1.2, 0], [0, 2.0]]}, "from": 0.5}],
        "disturbance": {"ellipsoid": {"centre": [0, 0], "shape": [[0.01, 0.005], [0.005, 0.02]]}},
    },
    "a ball at the end, from an elliptic set of initial states": {
        "terminal": [{"norm": {"p": 2, "radius": 0.3}}],
        "initial_state": {"centre": [-1, 1], "ellipsoid": {"shape": [[0.01, 0.0], [0.0, 0.02]]}},
        "disturbance": None,
    },
    "three states": {
        "system": {"A": [[0, 1, 0], [0, 0, 1], [-1, -2, -2]], "B": [[0], [0], [1]], "E": [[0], [1], [0]]},
        "initial_state": [0.5, 0, 0],
        "disturbance": {"box": 0.05},
        "path": [],
        "terminal": [{"norm": {"p": 2, "radius": 0.25}}],
    },
}


@pytest.mark.slow
@pytest.mark.parametrize(
    "name", [pytest.param(name, marks=pytest.mark.slow) if " an" in name else name for name in SETS]
)
def test_curved_sets_keep_every_guarantee(name: str, tmp_path: Path) -> None:
    proven(run({**SPRING, **SETS[name]}, tmp_path / "run", "peak", pieces=8))


@pytest.mark.slow
def test_nothing_need_be_flat(tmp_path: Path) -> None:
    """The bound against every causal policy has no rows then, and is 0 or that of the set of the control."""
    round_ = {"terminal": [{"norm": {"p": 2, "radius": 0.3}}], "disturbance": {"norm": {"p": 2, "radius": 0.05}}}
    system = {"A": [[0, 1], [-1, -0.2]], "B": [[0.4, 0], [0, 1]]}
    outcome = run({**THRUSTERS, **round_, "system": system}, tmp_path / "run", pieces=3)
    assert outcome.status == "certified", outcome.result.message
    assert check(outcome.directory).status == "verified"


def test_a_curved_set_that_no_policy_keeps_is_infeasible_with_its_reason(tmp_path: Path) -> None:
    problem = {**SPRING, "terminal": [{"norm": {"p": 2, "radius": 0.05}}]}
    outcome = run(problem, tmp_path / "run")
    assert outcome.status == "infeasible"
    assert "tangent of the normball" in outcome.result.message
    assert check(outcome.directory).status == "verified"


@pytest.mark.slow
def test_a_curved_set_has_a_margin_between_those_of_its_tangents(tmp_path: Path) -> None:
    problem = {**THRUSTERS, "terminal": [{"norm": {"p": 2, "radius": 0.2}}]}
    found = sr.margin(config(problem, pieces=3), of="disturbance", tolerance=1e-2, out=tmp_path / "margin")
    assert found.status == "certified", found.message

    def cost(width: float, within: float) -> float:
        independent = program(problem, 3, [width], [0.0, 0.0])
        for c, limit in tangents(0.04 * np.eye(2)):
            independent.below(np.tensordot(c, independent.state(5.0), 1), within * limit)
        for k in range(3):
            for c, limit in tangents(0.25 * np.eye(2)):
                independent.below(np.tensordot(c, independent.control(k), 1), within * limit)
        return independent.solve(0.5, "nominal")

    assert np.isfinite(cost(found.amounts[0], 1.0))
    assert np.isinf(cost(1.01 * found.amounts[1], float(np.cos(np.pi / TANGENTS))))


FORGERIES: dict[str, Any] = {
    "a gain": lambda data: data["gains"][5][3][0].__setitem__(1, data["gains"][5][3][0][1] + 0.5),
    "a cell that is missing": lambda data: [data["proof"]["terminal"][end].pop() for end in ("lower", "upper")],
    "directions in a plane": lambda data: data["proof"]["terminal"].__setitem__("normals", [[1.0, 0.0], [2.0, 0.0]]),
    "another direction": lambda data: _last(data)["direction"].__setitem__(0, 0.9 * _last(data)["direction"][0]),
    "a larger multiplier": lambda data: _last(data).__setitem__("multiplier", 1.01 * _last(data)["multiplier"]),
}


def _last(data: dict[str, Any]) -> dict[str, Any]:
    every: list[dict[str, Any]] = data["multipliers"]["constraints"]
    return next(one for one in every if one["constraint"] == "terminal")


@pytest.fixture(scope="module")
def curved(tmp_path_factory: pytest.TempPathFactory) -> Path:
    problem = {**SPRING, "terminal": [{"ellipsoid": {"centre": [0, 0], "shape": ELLIPSE}}]}
    outcome = run(problem, tmp_path_factory.mktemp("curved") / "run")
    proven(outcome)
    return outcome.directory


@pytest.mark.slow
@pytest.mark.parametrize("name", FORGERIES)
def test_a_forged_curved_set_is_found(name: str, tmp_path: Path, curved: Path) -> None:
    assert forged(curved, tmp_path / "copy", FORGERIES[name]) == "refuted"


@pytest.mark.slow
def test_a_control_that_leaves_its_round_set_is_found(tmp_path: Path) -> None:
    outcome = run(THRUSTERS, tmp_path / "run", pieces=6)
    proven(outcome)

    def further(data: dict[str, Any]) -> None:
        k = int(np.abs(np.array(data["decision"])).sum(axis=0).argmax())
        for row in data["decision"]:
            row[k] *= 1.5

    assert forged(outcome.directory, tmp_path / "copy", further) == "refuted"
