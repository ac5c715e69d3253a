"""Guards sets without an interior: a ball of radius 0 is a point whatever its norm, and no gain answers a segment."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

import sparserob_core as sr


def problem(**more: Any) -> dict[str, Any]:
    return {
        "name": "linear",
        "system": {"A": [[0, 1], [0, 0]], "B": [[0], [1]]},
        "horizon": 2.0,
        "initial_state": [1.0, 0.0],
        "control": {"box": 2.0},
        **more,
    }


def solved(place: Path, pieces: int = 8, policy: str = "open_loop", **more: Any) -> sr.Outcome:
    options = {
        "problem": problem(**more),
        "dictionaries": {"control": {"name": "piecewise_constant", "pieces": pieces}},
        "policy": {"name": policy} if policy == "open_loop" else {"name": policy, "cost": "peak"},
    }
    return sr.run(options, out=place, quiet=True, figures=False)


def is_verified(outcome: sr.Outcome) -> bool:
    return {claim.verdict for claim in sr.check(outcome).claims} == {"holds"}


@pytest.mark.parametrize("p", [1.0, 1.5, 2.0, 4.0, np.inf])
def test_a_ball_of_radius_0_is_a_point_in_every_norm(p: float) -> None:
    ball, directions = sr.NormBall(p, 0.0, [1.0, -2.0]), np.array([[1.0, 0.0], [0.3, -0.4], [0.0, 0.0]])
    assert ball.halfspaces() is not None and ball.support(directions) == pytest.approx(directions @ [1.0, -2.0])
    assert ball.contains(np.array([1.0, -2.0])) and not ball.contains(np.array([1.0, -1.999]))
    assert ball.violation(np.array([1.0, -2.0 + 1e-3])) == pytest.approx(1e-3)


@pytest.mark.parametrize("p", [1.5, 2.0])
def test_a_final_ball_of_radius_0_costs_what_the_point_does(p: float, tmp_path: Path) -> None:
    ball = solved(tmp_path / "ball", terminal=[{"norm": {"p": p, "radius": 0.0}}])
    point = solved(tmp_path / "point", terminal=[{"equals": [0, 0]}])
    assert ball.status == point.status == "certified"
    assert ball.summary["cost"] == pytest.approx(point.summary["cost"], rel=1e-7) == pytest.approx(1.2, rel=1e-7)
    assert is_verified(ball)


def test_a_final_ball_of_radius_0_under_a_disturbance_is_infeasible_for_anybody(tmp_path: Path) -> None:
    """The disturbance alone moves the state by 0.1 and 0.06. Multipliers of directions without a unit said no."""
    noise = {"box": [0.02, 0.03]}
    outcome = solved(tmp_path / "run", terminal=[{"norm": {"p": 2.0, "radius": 0.0}}], disturbance=noise)
    assert outcome.status == "infeasible" and is_verified(outcome)


SPAN = {"A": [[0, 1], [0, 0]], "B": [[0], [1]], "E": [[0.02], [0.03]]}
SEGMENT = {"zonotope": {"generators": [[0.02, 0.03]]}}


def test_a_segment_of_disturbances_costs_what_its_coordinate_does(tmp_path: Path) -> None:
    end = [{"box": [0.12, 0.1]}]
    segment = solved(tmp_path / "segment", terminal=end, disturbance=SEGMENT)
    span = solved(tmp_path / "span", terminal=end, disturbance={"box": [1.0]}, system=SPAN)
    assert segment.status == span.status == "certified"
    assert segment.summary["cost"] == pytest.approx(span.summary["cost"], rel=1e-6)
    assert is_verified(segment)


def test_a_segment_of_disturbances_is_not_answered_but_its_coordinate_is(tmp_path: Path) -> None:
    """Gains along a segment have no bound, were left out, and what was left was certified at 1.104."""
    end = [{"box": [0.12, 0.1]}]
    with pytest.raises(sr.InputError, match="the columns of E"):
        solved(tmp_path / "segment", policy="affine", terminal=end, disturbance=SEGMENT)
    span = solved(tmp_path / "span", policy="affine", terminal=end, disturbance={"box": [1.0]}, system=SPAN)
    assert span.status == "certified" and span.summary["cost"] == pytest.approx(1.0233333, rel=1e-6)
    assert is_verified(span)


def test_a_box_with_a_coordinate_that_is_a_point_is_answered(tmp_path: Path) -> None:
    outcome = solved(
        tmp_path / "run", policy="affine", terminal=[{"box": [0.3, 0.3]}], disturbance={"box": [0.0, 0.03]}
    )
    assert outcome.status == "certified" and is_verified(outcome)
