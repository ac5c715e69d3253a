"""Guards known answers: runs whose answer is known, verified anew: the limits of the grids and sets that a problem may
have."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import sparserob_core as sr
from sparserob_core.experiment.check.check import check
from tests.support.problems import spring

SPRING = spring(0.04)
TWO: dict[str, Any] = {**SPRING, "system": {"A": [[0, 1], [-2, -0.5]], "B": [[0, 0.5], [1, 0]]}}
DIAMOND = {"polytope": {"H": [[1, 1], [1, -1], [-1, 1], [-1, -1]], "h": [1, 1, 1, 1]}}
ROUND = {"ellipsoid": {"centre": [0, 0], "shape": [[0.5, 0.1], [0.1, 0.4]]}}


def pieces(count: int) -> dict[str, Any]:
    return {"name": "piecewise_constant", "pieces": count}


def verified(
    directory: Path,
    problem: dict[str, Any],
    control: dict[str, Any],
    disturbance: dict[str, Any] | None = None,
    status: str = "certified",
) -> dict[str, Any]:
    """Run, check, and return ``result.json``."""
    dictionaries = {"control": control, **({} if disturbance is None else {"disturbance": disturbance})}
    sr.run({"problem": problem, "dictionaries": dictionaries, "observers": []}, out=directory, figures=False)
    found = check(directory)
    assert [f"{claim.name}: {claim.text}" for claim in found.claims if claim.verdict != "holds"] == []
    assert found.status == "verified"
    summary: dict[str, Any] = json.loads((directory / "result.json").read_text())
    assert summary["status"] == status
    return summary


def test_the_robust_double_integrator_costs_what_is_known(tmp_path: Path) -> None:
    problem = {
        "name": "linear",
        "system": {"A": [[0, 1], [0, 0]], "B": [[0], [1]]},
        "horizon": 5.0,
        "initial_state": [4, 0],
        "control": {"box": 1.0},
        "disturbance": {"box": [0.02, 0.02]},
        "terminal": [{"box": [0.5, 0.3]}],
    }
    summary = verified(tmp_path / "run", problem, pieces(50))
    assert summary["cost"] == pytest.approx(1.6, abs=2e-7)
    assert summary["lower_bound"] <= 1.6 + 1e-12


def test_the_uncertain_rate_costs_what_is_known(tmp_path: Path) -> None:
    problem = {
        "name": "linear",
        "system": {"A": [["-a"]], "B": [[1]], "parameters": {"a": [0.5, 1.0]}},
        "horizon": 1.0,
        "initial_state": [2],
        "control": {"box": 1.0},
        "terminal": [{"box": [0.5]}],
    }
    known = max(-math.log(1 - a * (2 * math.exp(-a) - 0.5)) / a for a in np.linspace(0.5, 1.0, 1001))
    summary = verified(tmp_path / "run", problem, pieces(60))
    assert known - 1e-9 <= summary["cost"] <= known + 1e-4
    assert summary["lower_bound"] >= known - 1e-9


@pytest.mark.slow
def test_the_oscillator_with_an_interior_worst_parameter_costs_what_is_known(tmp_path: Path) -> None:
    problem = {
        "name": "linear",
        "system": {"A": [[0, 1], ["-omega**2", 0]], "B": [[0], [1]], "parameters": {"omega": [0.9, 1.1]}},
        "horizon": 2 * math.pi,
        "initial_state": [1, 0],
        "control": {"box": 1.0},
        "terminal": [{"box": [0.8, None]}],
    }
    assert verified(tmp_path / "run", problem, pieces(100))["cost"] == pytest.approx(0.200625, abs=2e-6)


def test_a_parameter_that_bends_the_cost_tells_the_ends_from_the_inside(tmp_path: Path) -> None:
    problem = {
        "name": "linear",
        "system": {"A": [[0]], "B": [["1 - p**2"]], "parameters": {"p": [-0.5, 0.5]}},
        "horizon": 1.0,
        "initial_state": [2],
        "control": {"box": 3.0},
        "terminal": [{"box": [0.5]}],
    }
    assert verified(tmp_path / "run", problem, pieces(5))["cost"] == pytest.approx(2.0, abs=2e-7)


def test_infeasibility_by_the_disturbance_alone_is_verified(tmp_path: Path) -> None:
    """The printed first experiment, but for its start: the disturbance moves the final state further than its set is
    wide."""
    problem = {**SPRING, "disturbance": {"box": [0.2, 0.2]}}
    assert verified(tmp_path / "run", problem, pieces(50), status="infeasible")["cost"] is None


def test_infeasibility_at_the_start_is_verified(tmp_path: Path) -> None:
    verified(tmp_path / "run", {**SPRING, "path": [{"box": [0.7, None]}]}, pieces(50), status="infeasible")


UNEQUAL = {"name": "piecewise_constant", "breakpoints": [0.0, 0.2, 0.25, 1.0, 1.001, 2.0, 2.7, 3.1, 4.0, 4.9, 5.0]}
CASES: dict[str, tuple[dict[str, Any], dict[str, Any], dict[str, Any] | None]] = {
    "one piece": ({**SPRING, "path": [], "terminal": [{"box": [1.0, 1.0]}], "initial_state": [1, 1]}, pieces(1), None),
    "one piece of control, many of the disturbance": (
        {**SPRING, "path": [], "terminal": [{"box": [1.0, 1.0]}]},
        pieces(1),
        pieces(12),
    ),
    "many pieces of control, one of the disturbance": (SPRING, pieces(30), pieces(1)),
    "unequal pieces": ({**SPRING, "disturbance": {"box": [0.02, 0.02]}}, UNEQUAL, pieces(12)),
    "breakpoints that divide each other": (SPRING, pieces(20), pieces(50)),
    "breakpoints that share the ends only": (SPRING, pieces(23), pieces(10)),
    "breakpoints closer than a tick": (
        SPRING,
        pieces(20),
        {"name": "piecewise_constant", "breakpoints": [0.0, math.nextafter(0.25, 1.0), 0.75 + 1e-9, 1.5, 5.0]},
    ),
    "a window inside a piece": (
        {**SPRING, "path": [{"box": [0.7, None], "from": 0.337, "to": 4.441}]},
        pieces(30),
        None,
    ),
    "a window that is one time": (
        {**SPRING, "path": [{"box": [0.7, None], "from": 2.345, "to": 2.345}]},
        pieces(30),
        None,
    ),
    "two windows": (
        {**SPRING, "path": [{"box": [0.7, None], "from": 0.4, "to": 2.0}, {"box": [0.65, 2.0], "from": 2.0}]},
        pieces(30),
        None,
    ),
    "a polytope of controls": ({**TWO, "control": DIAMOND}, pieces(20), None),
    "an ellipsoid of controls": ({**TWO, "control": ROUND}, pieces(20), None),
    "a round set of controls": ({**TWO, "control": {"norm": {"p": 2, "radius": 0.8}}}, pieces(20), None),
    "a round set of controls and Walsh functions": (
        {**TWO, "control": {"norm": {"p": 2, "radius": 0.8}}},
        {"name": "walsh", "pieces": 16},
        pieces(16),
    ),
    "a polytope of controls and few Walsh functions": (
        {**TWO, "control": DIAMOND},
        {"name": "walsh", "pieces": 32, "functions": 16},
        pieces(16),
    ),
    "a control that cannot rest": (
        {**SPRING, "control": {"box": {"lower": [-1.0], "upper": [-0.01]}}},
        pieces(30),
        None,
    ),
    "a polytope of disturbances": (
        {**SPRING, "disturbance": {"polytope": {"H": [[1, 1], [-1, 0], [0, -1]], "h": [0.03, 0.02, 0.02]}}},
        pieces(20),
        None,
    ),
    "an ellipsoid of disturbances": (
        {**SPRING, "disturbance": {"ellipsoid": {"centre": [0.01, 0], "shape": [[0.0009, 0.0002], [0.0002, 0.0009]]}}},
        pieces(20),
        None,
    ),
    "a 1-norm ball of disturbances": ({**SPRING, "disturbance": {"norm": {"p": 1, "radius": 0.04}}}, pieces(20), None),
    "a polytope at the end": (
        {**SPRING, "terminal": [{"polytope": {"H": [[1, 2], [-1, 0.5], [0, -1]], "h": [0.9, 0.5, 0.4]}}]},
        pieces(20),
        None,
    ),
    "a round set at the end": (
        {**SPRING, "path": [], "terminal": [{"norm": {"p": 2, "radius": 0.35}}]},
        pieces(15),
        None,
    ),
    "parameters in an ellipsoid": (
        {
            **SPRING,
            "system": {
                "A": [[0, 1], ["-2 + p1", -0.5]],
                "B": [[0], ["1 + p2"]],
                "parameters": {
                    "ellipsoid": {"centre": [0, 0], "shape": [[0.0009, 0.0001], [0.0001, 0.0009]]},
                    "names": ["p1", "p2"],
                },
            },
            "disturbance": None,
            "path": [],
            "terminal": [{"box": [0.35, 0.35]}],
            "horizon": 3.0,
        },
        pieces(12),
        None,
    ),
}


LARGE = {"a round set at the end", "parameters in an ellipsoid", "a polytope of controls"}


@pytest.mark.first(1)
@pytest.mark.parametrize(
    "name", [pytest.param(name, marks=pytest.mark.slow if name in LARGE else ()) for name in CASES]
)
def test_every_limit_of_a_problem_is_verified(name: str, tmp_path: Path) -> None:
    problem, control, disturbance = CASES[name]
    summary = verified(tmp_path / "run", problem, control, disturbance)
    assert summary["lower_bound"] <= summary["cost"] + 1e-9
    assert summary["cost"] - summary["lower_bound"] <= 1e-6


@pytest.mark.first(1)
@pytest.mark.parametrize("entry", ["0*t", 0], ids=["in time", "constant"])
def test_thrusters_that_push_against_one_another_are_one_whose_bound_is_derived(
    entry: float | str, tmp_path: Path
) -> None:
    """``u_2 = -u_1``: multipliers of both sides of a set without interior may be as large as they like, and what they
    round raised the bound that was written."""
    system = {"A": [[entry, 1], [-1, -0.2]], "B": [[0, 1], [1, 0]]}
    sides = {"H": [[1, 1], [-1, -1], [1, 0], [-1, 0]], "h": [0, 0, 1, 1]}
    shared = {"name": "linear", "horizon": 2.0, "initial_state": [1.0, 0.0], "terminal": [{"box": [0.5, 0.5]}]}
    both = {**shared, "system": system, "control": {"polytope": sides}}
    alone = {**shared, "system": {**system, "B": [[-1], [1]]}, "control": {"box": 1.0}}
    costs = [verified(tmp_path / name, one, pieces(4))["cost"] for name, one in (("a", both), ("b", alone))]
    assert costs[0] == pytest.approx(2.0 * costs[1], rel=1e-7)
