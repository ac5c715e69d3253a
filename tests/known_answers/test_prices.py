"""Guards known answers: weights that change with time, against values that are worked out by hand."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml

import sparserob_core as sr
from sparserob_core.control.loop.remaining import remaining_problem
from sparserob_core.control.studies.answer import ControlResult
from sparserob_core.control.studies.horizons import shorten_horizon
from sparserob_core.experiment.check.check import check

# x' = u over four pieces of length 1: from 3 to 0 it takes three of them
SCALAR: dict[str, Any] = {
    "name": "linear",
    "system": {"A": [[0]], "B": [[1]]},
    "horizon": 4.0,
    "initial_state": [3],
    "control": {"box": 1},
    "terminal": [{"equals": [0]}],
}
DOUBLED = [[0, 1], [2, 2]]
DISTURBED = {**SCALAR, "disturbance": {"box": 0.1}, "terminal": [{"box": 0.1}], "weights": DOUBLED}


def solved(directory: Path, problem: dict[str, Any], pieces: int = 4, **more: Any) -> sr.Outcome:
    """A run that is proven, and every claim of which the checker confirms."""
    config = {"dictionaries": {"control": {"name": "piecewise_constant", "pieces": pieces}}, "observers": []}
    outcome = sr.run({"problem": problem, **config, **more}, out=directory, quiet=True, figures=False)
    found = check(directory)
    assert [f"{claim.name}: {claim.text}" for claim in found.claims if claim.verdict != "holds"] == []
    assert (found.status, outcome.result.status) == ("verified", "certified")
    return outcome


@pytest.mark.first(3)
@pytest.mark.parametrize(
    ("weights", "cost"),
    [
        (DOUBLED, 2.0 + 2.0),  # two units at the low price, the third at the high one
        ([[0, 2], [2, 1]], 2.0 + 2.0),
        ([[0, 1], [1.5, 2]], 1.0 + 1.5 + 2.0),  # the price changes within the second piece
        ([[0, 0], [2, 2]], 2.0),
        ([[0, 0]], 0.0),
        ([[0, 5], [0.5, 1], [0.75, 0], [1, 7], [3, 1]], (5 / 2 + 1 / 4) + 7.0 + 1.0),
        ([[0, 3]], 9.0),
    ],
)
def test_a_control_acts_where_it_is_cheap(weights: list[list[float]], cost: float, tmp_path: Path) -> None:
    result = solved(tmp_path / "run", {**SCALAR, "weights": weights}).result
    assert result.cost == pytest.approx(cost, abs=1e-9)
    assert cost - 1e-9 <= result.lower_bound <= cost


def test_activity_counts_time_and_not_what_it_costs(tmp_path: Path) -> None:
    solved(tmp_path / "run", {**SCALAR, "weights": [[0, 1], [3, 0]]})
    sparsity = json.loads((tmp_path / "run" / "result.json").read_text())["sparsity"]
    assert sparsity["fewest_active"] == {"lower": 0.75, "upper": 0.75}


def test_the_sparsest_control_counts_time_and_tells_what_it_costs(tmp_path: Path) -> None:
    outcome = solved(tmp_path / "run", {**SCALAR, "weights": DOUBLED}, method={"name": "sparsest"})
    certificate = json.loads((tmp_path / "run" / "certificate.json").read_text())
    assert outcome.result.cost == pytest.approx(3.0, abs=1e-12)
    u = outcome.result.decision
    assert u is not None and certificate["J"] == pytest.approx(np.abs(u) @ [1, 1, 2, 2], abs=1e-9)


@pytest.mark.first(1)
@pytest.mark.parametrize(("cost", "value"), [("nominal", 4.0), ("peak", 4.6), ("worst", 4.6)])
def test_a_policy_pays_the_price_of_the_time_at_which_it_answers(cost: str, value: float, tmp_path: Path) -> None:
    """The last disturbance, 0.1, is never answered, so the nominal control brings 3 to 0: 2 at the price 1. The other
    three take up to 0.3 more, at the price 2, since the cheap pieces are full."""
    policy = {"name": "affine", "cost": cost, "causal_signals": 0}
    result = solved(tmp_path / "run", DISTURBED, policy=policy).result
    assert result.cost == pytest.approx(value, abs=1e-6)
    assert value - 1e-5 <= result.lower_bound <= value + 1e-9


def test_a_group_costs_its_norm_at_the_price_of_the_time(tmp_path: Path) -> None:
    """Two channels as one thrust of length at most 1, from (3, 4) / 5 * 3 to 0: as one channel from 3."""
    problem = {
        **SCALAR,
        "system": {"A": [[0, 0], [0, 0]], "B": [[1, 0], [0, 1]]},
        "initial_state": [1.8, 2.4],
        "control": {"norm": {"p": 2, "radius": 1.0}},
        "terminal": [{"equals": [0, 0]}],
        "cost": {"group": "all"},
        "weights": [[0, 1, 1], [2, 2, 2]],
    }
    result = solved(tmp_path / "run", problem).result
    assert result.cost == pytest.approx(4.0, abs=1e-6)
    sparsity = json.loads((tmp_path / "run" / "result.json").read_text())["sparsity"]
    assert sparsity["fewest_active"]["lower"] <= 0.75 <= sparsity["fewest_active"]["upper"]
    # the cost of 4 proves 2 of 4 pieces at the highest price; 3 is true, and not proven
    assert sparsity["fewest_active"]["lower"] == 0.5
    for name, part in (("result.json", "sparsity"), ("certificate.json", None)):
        file = tmp_path / "run" / name
        data = json.loads(file.read_text())
        (data if part is None else data[part])["fewest_active"]["lower"] = 0.75
        file.write_text(json.dumps(data))
    assert check(tmp_path / "run").status == "refuted"


def test_minimum_attention_pays_the_price_of_the_time_of_a_change(tmp_path: Path) -> None:
    """From 0 to 1 with u(0) = u(T) = 0 and a free horizon between: whatever the control, it goes up and down."""
    problem = {**SCALAR, "name": "minimum_attention", "rate": {"box": 4.0}, "weights": [[0, 1], [3, 3]]}
    flat = solved(tmp_path / "flat", {**problem, "weights": [1]}, 8).result
    priced = solved(tmp_path / "priced", problem, 8).result
    assert flat.cost <= priced.cost + 1e-9 <= 3.0 * flat.cost + 1e-6
    assert priced.lower_bound > flat.cost * (1.0 - 1e-6)


def test_a_cheaper_price_in_the_config_is_refused_by_the_checker(tmp_path: Path) -> None:
    solved(tmp_path / "run", {**SCALAR, "weights": DOUBLED})
    file = tmp_path / "run" / "config.yaml"
    config = yaml.safe_load(file.read_text())
    for changed in ([[0, 1], [2, 1.999]], [[0, 1], [2.001, 2]], [[0, 1], [1.999, 2]]):
        config["problem"]["weights"] = changed
        file.write_text(yaml.safe_dump(config))
        assert check(tmp_path / "run").status == "refuted"


def model_of(directory: Path, weights: object) -> Any:
    result = solved(directory, {**SCALAR, "weights": weights}).result
    assert isinstance(result, ControlResult)
    return result.model


def test_what_is_left_of_a_plan_pays_the_later_prices(tmp_path: Path) -> None:
    model = model_of(tmp_path / "run", [[0, 5], [0.5, 1], [1, 7], [2.5, 1], [3, 2]])
    whole = model.problem.prices(model.control.breakpoints)
    np.testing.assert_allclose(whole, [[3.0, 7.0, 4.0, 2.0]])
    for piece in range(4):
        left = remaining_problem(model, piece, np.zeros(1), None)
        np.testing.assert_allclose(left.problem.prices(left.control.breakpoints), whole[:, piece:])
        np.testing.assert_allclose(left.program.finite.weights, whole[0, piece:])


def test_units_change_no_price(tmp_path: Path) -> None:
    """Hours for seconds, and control in thousandths: the same cost."""
    here = solved(tmp_path / "here", {**SCALAR, "weights": [[0, 1], [1.5, 2]]}).result.cost
    far = {
        **SCALAR,
        "system": {"A": [[0]], "B": [[1e-3 / 3600]]},
        "horizon": 4.0 * 3600,
        "control": {"box": 1e3},
        "weights": [[0, 1e-3 / 3600], [1.5 * 3600, 2e-3 / 3600]],
    }
    assert solved(tmp_path / "far", far).result.cost == pytest.approx(here, rel=1e-8)


@pytest.mark.parametrize(
    ("weights", "expected"),
    [
        ([[0, 1, 2]], "rows of 2 numbers"),
        ([[0, 1], [2]], "rows of 2 numbers"),
        ([[0], [2, 1]], "rows of 2 numbers"),
        ([[1, 1], [2, 1]], "begin at 0"),
        ([[0, 1], [2, 1], [2, 3]], "increase"),
        ([[0, 1], [4, 1]], "before 4"),
        ([[0, 1], [2, -1]], "not negative"),
        ([[0, 1], [2, float("inf")]], "finite"),
        ([1, [2, 1]], "rows|list"),
        ("cheap", "rows of a time"),
        ([0], "positive"),
    ],
)
def test_rows_that_are_no_prices_are_refused_by_their_key(weights: object, expected: str, tmp_path: Path) -> None:
    dictionaries = {"control": {"name": "piecewise_constant", "pieces": 4}}
    with pytest.raises(sr.ConfigError, match=expected) as error:
        sr.run({"problem": {**SCALAR, "weights": weights}, "dictionaries": dictionaries}, out=tmp_path / "run")
    assert "problem.weights" in str(error.value)
    assert not (tmp_path / "run").exists()


def test_a_shorter_horizon_keeps_the_prices_until_then(tmp_path: Path) -> None:
    problem = model_of(tmp_path / "run", [[0, 1], [1.5, 2], [3, 4]]).problem
    assert shorten_horizon(problem, 3.0).weights.tolist() == [[0, 1], [1.5, 2]]  # type: ignore[union-attr]
    assert shorten_horizon(problem, 1.0).weights.tolist() == [1]  # type: ignore[union-attr]


def test_a_loop_pays_for_groups_and_for_the_channels_beside_them(tmp_path: Path) -> None:
    problem = {
        **SCALAR,
        "system": {"A": np.zeros((3, 3)).tolist(), "B": np.eye(3).tolist()},
        "initial_state": [0.6, 0.8, 2],
        "terminal": [{"equals": [0, 0, 0]}],
        "cost": {"group": [[1, 2]]},
        "weights": [[0, 1, 1, 3], [2, 2, 2, 1]],
    }
    cost = solved(tmp_path / "run", problem).result.cost
    assert cost == pytest.approx(1.0 + 2.0, abs=1e-6)
    assert sr.loop(tmp_path / "run", trajectories=1).planned == pytest.approx(cost, abs=1e-9)


def test_weights_of_a_group_are_equal_at_all_times() -> None:
    system = sr.LinearSystem(np.zeros((2, 2)), np.eye(2))
    make: Callable[[object], sr.OptimalControlProblem] = lambda weights: sr.OptimalControlProblem(  # noqa: E731
        system=system,
        horizon=2.0,
        initial_state=[1.0, 1.0],
        control=sr.Box(-np.ones(2), np.ones(2)),
        weights=weights,  # type: ignore[arg-type]
        cost=sr.Cost(group="all"),
    )
    assert make([[0, 1, 1], [1, 2, 2]]).prices(np.array([0.0, 1.5, 2.0])).tolist() == [[2.0, 1.0], [2.0, 1.0]]
    with pytest.raises(sr.InputError, match="equal weights within a group"):
        make([[0, 1, 1], [1, 2, 3]])
