"""Guards known answers: minimum attention whose rate lies in a curved set, beside a bound of the control."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

import sparserob_core as sr

PROBLEM: dict[str, Any] = {
    "name": "minimum_attention",
    "system": {"A": [[-0.5]], "B": [[1]]},
    "horizon": 2.0,
    "initial_state": [-1.0],
    "control": {"box": 0.6},
    "disturbance": {"box": 0.05},
    "terminal": [{"box": 0.25}],
}


def cost(rate: dict[str, Any], policy: str, where: Path) -> float:
    control = {"name": "piecewise_constant", "pieces": 4}
    config = {"problem": {**PROBLEM, "rate": rate}, "dictionaries": {"control": control}, "policy": {"name": policy}}
    outcome = sr.run(config, out=where, quiet=True, figures=False)
    assert outcome.status == "certified"
    assert sr.check(where).status == "verified"
    assert {family.name for family in outcome.program.families} >= {"control", "rate"} or rate == {"box": 1.5}
    return float(outcome.result.cost)


@pytest.mark.first(1)
@pytest.mark.parametrize("policy", ["open_loop", "affine"])
def test_a_ball_of_rates_on_a_line_is_the_interval(policy: str, tmp_path: Path) -> None:
    interval = cost({"box": 1.5}, policy, tmp_path / "interval")
    ball = cost({"ellipsoid": {"shape": [[2.25]]}}, policy, tmp_path / "ball")
    assert interval > 0.2
    assert ball == pytest.approx(interval, rel=3e-7)
