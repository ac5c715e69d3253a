"""Guards sets without an interior: a ball of radius 0 is a point whatever its norm, and no gain answers a segment."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

import sparserob_core as sr
from sparserob_core.experiment.assemble import assemble
from sparserob_core.experiment.config.load import load_config


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


def test_a_segment_of_disturbances_is_answered_as_its_coordinate_is(tmp_path: Path) -> None:
    """Gains along a segment were left out, and what was left was certified at 1.104."""
    end = [{"box": [0.12, 0.1]}]
    segment = solved(tmp_path / "segment", policy="affine", terminal=end, disturbance=SEGMENT)
    span = solved(tmp_path / "span", policy="affine", terminal=end, disturbance={"box": [1.0]}, system=SPAN)
    for outcome in (segment, span):
        assert outcome.status == "certified" and is_verified(outcome)
        assert outcome.summary["cost"] == pytest.approx(1.0233333, rel=1e-6)
        assert outcome.summary["lower_bound"] == pytest.approx(1.0233333, rel=1e-6)


def test_a_flat_set_whose_sides_are_too_many_to_list_is_not_answered(tmp_path: Path) -> None:
    """No gain on it is bounded: its coordinates are answered instead."""
    angles = np.linspace(0.0, np.pi, 502)
    many = 1e-4 * np.stack([np.cos(angles), np.sin(angles), np.cos(angles)], axis=1)
    with pytest.raises(sr.InputError, match="the columns of E"):
        solved(
            tmp_path / "many",
            policy="affine",
            system={"A": np.eye(3, k=1).tolist(), "B": [[0], [0], [1]]},
            initial_state=[1.0, 0.0, 0.0],
            disturbance={"zonotope": {"generators": many.tolist()}},
        )


@pytest.mark.parametrize("ends", [[0, 0], [0, None]])
def test_a_segment_is_refused_beside_fixed_final_states_and_its_box_is_not(ends: list[Any], tmp_path: Path) -> None:
    """What is fixed is so at every deviation, coordinate by coordinate."""
    segment = {"centre": [1.0, 0.0], "zonotope": {"generators": [[0.02, 0.03]]}}
    with pytest.raises(sr.InputError, match="beside fixed final states, which the zonotope has not"):
        solved(tmp_path / "segment", policy="affine", terminal=[{"equals": ends}], initial_state=segment)
    axis = {"centre": [1.0, 0.0], "zonotope": {"generators": [[0.02, 0.0]]}}
    outcome = solved(tmp_path / "axis", policy="affine", terminal=[{"equals": ends}], initial_state=axis)
    assert outcome.status == "certified" and is_verified(outcome)


def test_what_a_thin_set_deviates_by_counts_though_nothing_answers_it(tmp_path: Path) -> None:
    """The terminal box is kept for all of it: the cost is what the thickness adds, 1e-10 times the price of the box."""
    costs = {}
    for thick in (0.0, 1e-10):
        begun = {"centre": [1.0, 0.0], "box": [thick, 0.03]}
        outcome = solved(tmp_path / f"{thick}", policy="affine", initial_state=begun, terminal=[{"box": [0.3, 0.3]}])
        assert outcome.status == "certified" and is_verified(outcome)
        costs[thick] = outcome.summary["cost"]
    assert costs[1e-10] - costs[0.0] == pytest.approx(0.0, abs=1e-8)
    assert costs[1e-10] > costs[0.0] + 1e-11


def test_a_box_with_a_coordinate_that_is_a_point_is_answered(tmp_path: Path) -> None:
    outcome = solved(
        tmp_path / "run", policy="affine", terminal=[{"box": [0.3, 0.3]}], disturbance={"box": [0.0, 0.03]}
    )
    assert outcome.status == "certified" and is_verified(outcome)


@pytest.mark.parametrize("thick", [0.0, 1e-12])
@pytest.mark.parametrize("place", ["disturbance", "initial_state"])
def test_effects_are_those_of_the_gains_on_all_that_is_seen(place: str, thick: float) -> None:
    """Of a thin set too, whose thickness nothing answers: what gains make of it is no less their doing."""
    convex = {"zonotope": {"generators": [[0.02, 0.03], [-0.03 * thick, 0.02 * thick]]}}
    more = {place: convex if place == "disturbance" else {"centre": [1.0, 0.0], **convex}}
    options = {
        "problem": problem(terminal=[{"box": [0.3, 0.3]}], **more),
        "dictionaries": {"control": {"name": "piecewise_constant", "pieces": 4}},
        "policy": {"name": "affine", "cost": "peak"},
    }
    loop = assemble(load_config(options)).model.feedback.loop  # type: ignore[union-attr]
    x = np.random.default_rng(1).normal(size=loop.variables)
    effects = np.einsum("kjid,jdq->kiq", loop.gains(x), loop.innovations)
    assert loop.effects(x) == pytest.approx(effects, abs=1e-12) and effects.any()
    assert loop.spread.support(effects[-1]) == pytest.approx(loop.spread.support(loop.effects(x)[-1]), abs=1e-14)


def test_what_is_still_is_what_no_row_feels() -> None:
    """What moves no row by a billionth of its size, 0.6 here; none beside fixed final states, all of a ball or nothing,
    but every side of a box for itself. A plant that amplifies makes rows feel what states of their own size do not."""
    options: dict[str, Any] = {
        "dictionaries": {"control": {"name": "piecewise_constant", "pieces": 4}},
        "policy": {"name": "affine", "cost": "peak"},
    }

    def still(**more: Any) -> list[bool]:
        model = assemble(load_config({**options, "problem": problem(**more)})).model
        assert model.feedback is not None
        found: list[bool] = model.feedback.loop.spread.still.tolist()  # type: ignore[union-attr]
        return found

    end = [{"box": [0.3, 0.3]}]
    assert still(terminal=end, initial_state={"centre": [1.0, 0.0], "box": [1e-12, 0.03]}) == [True, False]
    assert still(terminal=end, initial_state={"centre": [1.0, 0.0], "box": [1e-8, 0.03]}) == [False, False]
    assert still(terminal=end, initial_state={"centre": [1.0, 0.0], "norm": {"p": 2, "radius": 1e-12}}) == [True] * 2
    assert still(terminal=end, initial_state={"centre": [1.0, 0.0], "norm": {"p": 2, "radius": 1e-8}}) == [False] * 2
    assert still(terminal=end, disturbance={"box": [1e-13, 0.03]}) == [True, False] * 4
    assert still(terminal=end, disturbance={"box": [1e-8, 0.03]}) == [False, False] * 4
    assert still(terminal=[{"box": [30.0, 30.0]}], disturbance={"box": [1e-8, 0.03]}) == [True, False] * 4
    assert still(terminal=end, disturbance={"zonotope": {"generators": [[1e-13, 0], [0, 0.03]]}}) == [False] * 8
    fixed = [{"equals": [0, 0]}]
    assert still(terminal=fixed, initial_state={"centre": [1.0, 0.0], "box": [1e-12, 0.03]}) == [False, False]


@pytest.mark.parametrize(
    "end",
    [
        {"norm": {"p": 2, "radius": 1e-12, "centre": [1.0, 0.0]}},
        {"box": {"lower": [1.0, 0.0], "upper": [1.0 + 1e-12, 1e-12]}},
    ],
)
def test_from_rest_to_a_thin_set_costs_what_its_point_does(end: dict[str, Any], tmp_path: Path) -> None:
    """Nothing begins away from 0, so that the set is thin beside where it is."""
    costs = []
    for name, terminal in (("thin", end), ("point", {"equals": [1.0, 0.0]})):
        outcome = solved(tmp_path / name, terminal=[terminal], initial_state=[0.0, 0.0])
        assert outcome.status == "certified" and is_verified(outcome)
        costs.append(outcome.summary["cost"])
    assert costs[0] == pytest.approx(costs[1], rel=1e-8)


@pytest.mark.parametrize("size", [1e-3, 1e-12])
def test_what_an_unstable_plant_amplifies_is_not_still(size: float) -> None:
    """``x' = 10 x + u + w`` over three units of time: a state of 1 is e^-30 of what it could become; what is small at
    the end is not still where it is felt at the beginning."""
    plant = {"A": [[10.0]], "B": [[1.0]]}
    model = assemble(
        load_config(
            {
                "problem": {
                    "name": "linear",
                    "system": plant,
                    "horizon": 3.0,
                    "initial_state": [0.01],
                    "control": {"box": [1.0]},
                    "disturbance": {"box": [size]},
                    "terminal": [{"box": [0.5]}],
                },
                "dictionaries": {"control": {"name": "piecewise_constant", "pieces": 6}},
                "policy": {"name": "affine", "cost": "peak"},
            }
        )
    ).model
    assert model.feedback is not None
    assert not model.feedback.loop.spread.still.any()  # type: ignore[union-attr]
