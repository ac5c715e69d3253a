"""Guards the least share of time that any admissible control must act: intervals against closed forms, an independent
linear program, and mixed-integer answers that nobody here tuned."""

from __future__ import annotations

import json
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import sparserob_core as sr
from tests.support.problems import spring

SPRING = spring(0.06)
TWO = {"box": {"lower": [-1.0, -0.5], "upper": [1.0, 0.5]}}


def solved(problem: dict[str, Any], pieces: int, where: Path, **more: Any) -> tuple[sr.Outcome, dict[str, Any]]:
    """A run that its check confirms, and the interval that it reports."""
    config = {
        "problem": problem,
        "dictionaries": {"control": {"name": "piecewise_constant", "pieces": pieces}},
        "observers": [],
        **more,
    }
    outcome = sr.run(config, out=where, figures=False, quiet=True)
    assert sr.check(where).status == "verified"
    return outcome, json.loads((where / "result.json").read_text())["sparsity"]["fewest_active"]


def integrator(start: list[float], control: dict[str, Any], **more: Any) -> dict[str, Any]:
    """``x_i' = u_i`` for 2 units of time, to within 0.1."""
    size = len(start)
    return {
        "name": "linear",
        "system": {"A": np.zeros((size, size)).tolist(), "B": np.eye(size).tolist()},
        "horizon": 2.0,
        "initial_state": start,
        "control": control,
        "terminal": [{"box": [0.1] * size}],
        **more,
    }


def test_fifty_pieces_need_seven_and_the_optimum_of_l1_acts_on_eight(tmp_path: Path) -> None:
    outcome, interval = solved(SPRING, 50, tmp_path / "run")
    assert interval == {"lower": pytest.approx(7 / 50, abs=1e-12), "upper": pytest.approx(8 / 50, abs=1e-12)}
    assert interval["lower"] >= outcome.result.lower_bound / 5.0 - 1e-9


@pytest.mark.first(2)
@pytest.mark.parametrize(
    ("start", "sides", "share"),
    [
        (1.0, (-0.5, 1.0), 0.9),  # 0.9 at a rate of 0.5
        (-1.0, (-0.5, 1.0), 0.45),  # 0.9 at a rate of 1
        (1.0, (-0.9, 0.0), 0.5),  # a sign is forbidden
        (0.05, (-1.0, 1.0), 0.0),
        (-1.0, (0.2, 1.0), 1.0),  # 0 is no value: it acts always
    ],
)
def test_the_sides_of_a_box_decide_how_long_it_takes(
    start: float, sides: tuple[float, float], share: float, tmp_path: Path
) -> None:
    control = {"box": {"lower": [sides[0]], "upper": [sides[1]]}}
    _, interval = solved(integrator([start], control), 20, tmp_path / "run")
    assert interval == {"lower": pytest.approx(share, abs=1e-12), "upper": pytest.approx(share, abs=1e-12)}


def test_channels_count_by_their_weights_and_ranges(tmp_path: Path) -> None:
    """0.9 of 1 and 0.45 at a rate of 0.5, which takes 0.9 each; the weights are 1 and 3."""
    problem = integrator([1.0, -0.55], TWO, weights=[1.0, 3.0])
    _, interval = solved(problem, 20, tmp_path / "run")
    assert interval["lower"] == pytest.approx((1 * 0.9 + 3 * 0.9) / (2 * 4), abs=1e-8)
    assert interval["upper"] == pytest.approx((1 * 0.9 + 3 * 0.9) / (2 * 4), abs=1e-12)


@pytest.mark.first(1)
@pytest.mark.parametrize("control", [{"norm": {"p": 1, "radius": 1.0}}, {"norm": {"p": 2, "radius": 1.0}}])
def test_a_set_of_controls_counts_by_the_range_of_each_channel(control: dict[str, Any], tmp_path: Path) -> None:
    _, interval = solved(integrator([1.0, -0.55], control), 20, tmp_path / "run")
    least = (0.9 + 0.45) / 4
    assert least - 1e-12 <= interval["lower"] <= np.ceil(40 * least) / 40 + 1e-12
    assert interval["lower"] <= interval["upper"] <= interval["lower"] + 3 / 40


def test_pieces_of_unequal_length_are_not_rounded_up(tmp_path: Path) -> None:
    entry = {"name": "piecewise_constant", "breakpoints": [0.0, 0.3, 1.0, 1.25, 2.0]}
    _, interval = solved(integrator([1.0], {"box": 1.0}), 4, tmp_path / "run", dictionaries={"control": entry})
    assert interval["lower"] == pytest.approx(0.45, abs=1e-8)
    assert interval["upper"] >= 0.475 - 1e-12  # 0.95 is the least sum of lengths that is at least 0.9


@pytest.mark.first(1)
@pytest.mark.parametrize("name", ["haar", "walsh"])
def test_other_dictionaries_count_pieces_and_not_coefficients(name: str, tmp_path: Path) -> None:
    dictionary = {"control": {"name": name, "pieces": 16}}
    control = {"box": {"lower": [-0.5], "upper": [1.0]}}
    _, interval = solved(integrator([1.0], control), 16, tmp_path / "run", dictionaries=dictionary)
    assert interval == {"lower": pytest.approx(15 / 16, abs=1e-12), "upper": pytest.approx(15 / 16, abs=1e-12)}


def test_without_a_regulariser_the_control_is_a_vertex_of_the_optimal_face(tmp_path: Path) -> None:
    """Degenerate: every control of one sign with the right moments costs 3; a vertex has two pieces in between."""
    problem = {
        "name": "linear",
        "system": {"A": [[0, 1], [0, 0]], "B": [[0], [1]]},
        "horizon": 5.0,
        "initial_state": [10, -3],
        "control": {"box": 1.0},
        "terminal": [{"equals": [0, 0]}],
    }
    outcome, interval = solved(problem, 50, tmp_path / "run", regulariser=None)
    assert outcome.result.cost == pytest.approx(3.0, rel=1e-7)
    assert interval["lower"] == pytest.approx(0.6, abs=1e-12)
    assert interval["upper"] <= 0.6 + 2 / 50 + 1e-12
    spread, beside = solved(problem, 50, tmp_path / "regularised")
    assert spread.control is not None
    assert np.count_nonzero(spread.control) > 40  # what a regulariser chooses acts nearly always
    assert beside == interval


def test_a_refuted_control_is_no_upper_bound_and_an_infeasible_problem_has_no_interval(tmp_path: Path) -> None:
    _, refuted = solved(SPRING, 50, tmp_path / "nominal", method={"name": "nominal"})
    assert refuted["upper"] is None
    assert 0.0 < refuted["lower"] <= 7 / 50
    impossible = {**SPRING, "disturbance": {"box": [0.3, 0.3]}}
    assert solved(impossible, 50, tmp_path / "infeasible")[1] is None


def test_units_do_not_change_it(tmp_path: Path) -> None:
    control = {"box": {"lower": [-0.5], "upper": [1.0]}}
    _, one = solved(integrator([1.0], control), 20, tmp_path / "one")
    scaled = integrator([1024.0], {"box": {"lower": [-512.0], "upper": [1024.0]}}, terminal=[{"box": [102.4]}])
    _, other = solved(scaled, 20, tmp_path / "other")
    assert one == other


def test_channels_that_are_one_vector_act_together(tmp_path: Path) -> None:
    """A way of 1 at a speed of at most 1 along (0.6, 0.8): a vector of thrust acts for 1 of 2, whatever its axes."""
    problem = integrator([0.6, 0.8], {"norm": {"p": 2, "radius": 1.0}}, terminal=[{"equals": [0, 0]}])
    outcome, interval = solved({**problem, "cost": {"group": "all"}}, 20, tmp_path / "run")
    assert outcome.result.cost == pytest.approx(1.0, rel=1e-7)
    assert interval["lower"] == pytest.approx(0.5, abs=1e-12)
    assert interval["upper"] >= 0.5
    boxed = integrator([0.6, 0.8], {"box": 1.0}, terminal=[{"equals": [0, 0]}], cost={"group": "all"})
    _, interval = solved(boxed, 20, tmp_path / "boxed")
    assert 1.0 / np.sqrt(8.0) <= interval["lower"] <= 0.4 + 1e-12 <= interval["upper"] + 2e-12
    spelt = {"name": "sparsest", "alphabet": [-1.0, 0.0, 1.0]}
    with pytest.raises(sr.InputError, match="without groups"):
        solved(boxed, 20, tmp_path / "refused", method=spelt)


@pytest.mark.slow
def test_the_fewest_pieces_of_a_vector_are_divided_and_counted_together(tmp_path: Path) -> None:
    """A way of 0.05 and 0.7 at a speed of at most 1 each, on pieces of 0.4: the second channel needs two of five, where
    the first may act too. A third channel that counts alone needs one."""
    boxed = integrator([0.05, 0.7], {"box": 1.0}, terminal=[{"equals": [0, 0]}], cost={"group": "all"})
    outcome, interval = solved(boxed, 5, tmp_path / "run", method={"name": "sparsest"})
    assert outcome.status == "certified"
    assert (interval["lower"], interval["upper"]) == pytest.approx((0.4, 0.4), abs=1e-12)
    acts = np.load(outcome.directory / "solution.npz")["control"] != 0.0
    assert acts.any(axis=0).sum() == 2
    copy = tmp_path / "copy"
    shutil.copytree(outcome.directory, copy)
    data = json.loads((copy / "certificate.json").read_text())
    branches = [node for node in data["tree"]["nodes"] if "first" in node]
    assert branches, "the bound of the root alone is too low"
    branches[0]["first"] = branches[0]["second"]
    (copy / "certificate.json").write_text(json.dumps(data))
    assert sr.check(copy).status == "refuted"
    apart = {**boxed, "system": {"A": np.zeros((3, 3)).tolist(), "B": np.eye(3).tolist()}}
    apart |= {"initial_state": [0.05, 0.7, 0.3], "terminal": [{"equals": [0, 0, 0]}], "cost": {"group": [[1, 2]]}}
    _, interval = solved(apart, 5, tmp_path / "apart", method={"name": "sparsest"})
    assert interval["lower"] == pytest.approx((2 * 2 + 1) / 15, abs=1e-9)
