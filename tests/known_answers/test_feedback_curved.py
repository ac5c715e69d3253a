"""Guards curved sets of controls under policy affine, against linear programs with many tangents that share
nothing with the package, and against forged certificates."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

import sparserob_core as sr
from tests.known_answers.test_feedback_rows import SPRING, config, forged, program, proven, run

TANGENTS = 64
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
    "a ball at the end": {"terminal": [{"norm": {"p": 2, "radius": 0.3}}]},
}


@pytest.mark.parametrize("name", SETS)
def test_curved_sets_of_states_are_refused_by_name(name: str) -> None:
    with pytest.raises(sr.InputError, match=r"policy\.name: feedback needs a set of states with flat sides"):
        sr.run(config({**SPRING, **SETS[name]}), quiet=True, figures=False)


@pytest.mark.slow
def test_a_curved_set_has_a_margin_between_those_of_its_tangents(tmp_path: Path) -> None:
    found = sr.margin(config(THRUSTERS, pieces=3), of="disturbance", tolerance=1e-2, out=tmp_path / "margin")
    assert found.status == "certified", found.message

    def cost(width: float, within: float) -> float:
        independent = program(THRUSTERS, 3, [width], [0.0, 0.0])
        for state in independent.state(5.0):
            for sign in (1.0, -1.0):
                independent.below(sign * state, 0.2)
        for k in range(3):
            for c, limit in tangents(0.25 * np.eye(2)):
                independent.below(np.tensordot(c, independent.control(k), 1), within * limit)
        return independent.solve(0.5, "nominal")

    assert np.isfinite(cost(found.amounts[0], 1.0))
    assert np.isinf(cost(1.01 * found.amounts[1], float(np.cos(np.pi / TANGENTS))))


@pytest.mark.slow
def test_a_control_that_leaves_its_round_set_is_found(tmp_path: Path) -> None:
    outcome = run(THRUSTERS, tmp_path / "run", pieces=6)
    proven(outcome)

    def further(data: dict[str, Any]) -> None:
        k = int(np.abs(np.array(data["decision"])).sum(axis=0).argmax())
        for row in data["decision"]:
            row[k] *= 1.5

    assert forged(outcome.directory, tmp_path / "copy", further) == "refuted"
