"""Guards `limits.seconds`: kept whatever takes long, and what is known then is a run that `check` takes."""

from __future__ import annotations

import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import sparserob_core as sr
from sparserob_core.control.problem.phase import Phase
from sparserob_core.control.response.varying.expansion import LOOKED, Look, Segment

LATE = 2.0  # seconds of the processor by which a limit may be missed

IN_TIME = {
    "A": [["-0.2 - p*exp(-t)", "0.1 + q*(1 + q)*sin(t)"], [0.2, "-0.1 + 0.8*exp(-0.4*t)"]],
    "B": [[1], ["-0.2 - 0.8/(1 + 0.3*t)"]],
}
SMALL = {"p": [-0.008, 0.016], "q": [-0.009, 0.007]}
CHAIN = (np.eye(40, k=1) - 1.5 * np.eye(40)).tolist()

HEAVY: dict[str, dict[str, Any]] = {
    "parameters in a plant in time": {
        "system": {**IN_TIME, "parameters": SMALL},
        "initial_state": [-0.1, 0.5],
        "execution": [0.03],
    },
    "measurable disturbances in time": {
        "system": IN_TIME | {"A": [[-0.2, "0.1*sin(t)"], [0.2, -0.1]]},
        "initial_state": [-0.1, 0.5],
        "disturbance": {"box": [0.003, 0.003]},
        "disturbance_class": "measurable",
    },
    "forty states with errors": {
        "system": {"A": CHAIN, "B": [[0]] * 39 + [[1]]},
        "initial_state": [0.1] * 40,
        "execution": [0.05],
    },
    "feedback": {
        "system": {"A": [[0, 1], [-2, -0.5]], "B": [[0], [1]]},
        "initial_state": [-1, 1],
        "disturbance": {"box": [0.2, 0.2]},
    },
    "a ball and parameters": {
        "system": {
            "A": [[0, 1], ["-2 + p", "-0.5 + q"]],
            "B": [[0], [1]],
            "parameters": {"p": [-0.3, 0.3], "q": [-0.2, 0.2]},
        },
        "initial_state": [-1, 1],
        "disturbance": {"ellipsoid": {"shape": [[0.01, 0], [0, 0.01]]}},
    },
}


def options(name: str, seconds: float) -> dict[str, Any]:
    problem, states = HEAVY[name], len(HEAVY[name]["initial_state"])
    wall = (
        {"ellipsoid": {"shape": np.diag([4.0] * states).tolist()}}
        if name.startswith("a ball")
        else {"box": [2.0] * states}
    )
    return {
        "problem": {
            "name": "linear",
            "horizon": 3.0,
            "control": {"box": 1.0},
            "path": [{**wall, "from": 0.5}],
            "terminal": [{"box": [0.4] * states}],
            **problem,
        },
        "dictionaries": {"control": {"name": "piecewise_constant", "pieces": 60}},
        "policy": {"name": "affine", "cost": "peak"} if name == "feedback" else {"name": "open_loop"},
        "limits": {"seconds": seconds},
        "observers": [],
    }


@pytest.mark.parametrize("name", [pytest.param(n, marks=pytest.mark.slow if i else ()) for i, n in enumerate(HEAVY)])
@pytest.mark.parametrize("seconds", [1.0, pytest.param(3.0, marks=pytest.mark.slow)])
def test_a_limit_is_kept_and_leaves_a_run_that_check_takes(name: str, seconds: float, tmp_path: Path) -> None:
    sr.run(
        {
            "problem": {
                "name": "linear",
                "system": {"A": [[0]], "B": [[1]]},
                "horizon": 1,
                "initial_state": [0],
                "control": {"box": 1},
            }
        },
        out=tmp_path / "first",
        quiet=True,
        figures=False,
    )  # what is imported once is no part of it
    began = time.process_time()
    outcome = sr.run(options(name, seconds), out=tmp_path / "run", quiet=True, figures=False)
    assert time.process_time() - began <= seconds + LATE
    if outcome.status != "failed":
        assert "fails" not in {claim.verdict for claim in sr.check(outcome, seconds=60.0).claims}


def test_a_plant_that_changes_too_fast_is_refused_at_once_with_the_segments_that_it_needs(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    fast = {"system": {"A": [["-1 + sin(1000000*t)"]], "B": [[1]]}, "initial_state": [0.5], "horizon": 2.0}
    looks, look = [0.0], Look.at

    def counted(self: Look, law: Phase, start: float, stop: float, before: float) -> Segment:
        looks.append(start)
        return look(self, law, start, stop, before)

    monkeypatch.setattr(Look, "at", counted)
    with pytest.raises(sr.InputError, match=r"some [\d.e+]+ segments of the horizon"):
        sr.run({"problem": {"name": "linear", "control": {"box": 1.0}, **fast}}, out=tmp_path / "run", quiet=True)
    assert len(looks) <= 4 * LOOKED  # a second of work, where all segments would be days


@pytest.mark.parametrize("pieces", [999, 1000, 1001])
def test_a_thousand_pieces_are_as_good_as_one_more_or_less(pieces: int, tmp_path: Path) -> None:
    problem = {
        "name": "linear",
        "system": {"A": [[0, 1], [-2, -0.5]], "B": [[0], [1]]},
        "horizon": 5.0,
        "initial_state": [-1, 1],
        "control": {"box": 1.0},
        "disturbance": {"box": [0.06, 0.06]},
        "path": [{"box": [0.7, None], "from": 0.3}],
        "terminal": [{"box": [0.3, 0.3]}],
    }
    dictionaries = {kind: {"name": "piecewise_constant", "pieces": pieces} for kind in ("control", "disturbance")}
    outcome = sr.run(
        {"problem": problem, "dictionaries": dictionaries}, out=tmp_path / "run", quiet=True, figures=False
    )
    assert outcome.status == "certified"


def test_a_path_without_an_end_follows_the_horizon_of_a_study(tmp_path: Path) -> None:
    problem = sr.OptimalControlProblem(
        system=sr.LinearSystem([[0, 1], [-2, -0.5]], [[0], [1]]),
        horizon=5.0,
        initial_state=[0.5, 0.0],
        control=sr.Box([-1.0], [1.0]),
        path=[sr.PathConstraint(sr.Box([-0.6, -np.inf], [0.6, np.inf]), 0.5)],
        terminal=[sr.Box([-0.3, -0.3], [0.3, 0.3])],
    )
    study = sr.sweep(problem, {"problem.horizon": [4.5, 5.0, 5.5]}, out=tmp_path / "study")
    assert [row["status"] for row in study.table] == ["certified"] * 3
