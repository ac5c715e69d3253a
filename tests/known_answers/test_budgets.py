"""Guards budgets of a disturbance over time, from the config to the checker: closed forms of an integrator, and an
oracle of linear and conic programs."""

from __future__ import annotations

import copy
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import sparserob_core as sr
from sparserob_core.experiment.assemble import control_problem_of
from sparserob_core.experiment.check.check import check
from sparserob_core.experiment.config.load import load_config
from tests.support.oracle import bounds_of, outside

PIECES = {
    "control": {"name": "piecewise_constant", "pieces": 20},
    "disturbance": {"name": "piecewise_constant", "pieces": 10},
}
PLANTS: dict[str, dict[str, Any]] = {
    "varying": {"A": [[0, 1], ["-0.5*t", -0.2]], "B": [[0], [1]], "E": [[0.5, 0], [0, 1]]},
    "delay": {"A": [[0, 1], [-1, -0.2]], "B": [[0], [1]], "E": [[0.5, 0], [0.2, 1]], "delay": 0.12},
    "phases": {
        "pieces": [
            {"until": 0.37, "A": [[0, 1], [-1, -0.2]], "B": [[0], [1]], "E": [[0.5, 0], [0.2, 1]]},
            {"until": 1.0, "A": [[0, 1], [1, -0.2]], "B": [[0], [1]], "E": [[0.5, 0], [0.2, 1]]},
        ]
    },
    "parameters": {
        "A": [[0, 1], ["-0.5*k", -0.2]],
        "B": [[0], [1]],
        "E": [[0.5, 0], [0, 1]],
        "parameters": {"names": ["k"], "box": {"lower": [0.8], "upper": [1.2]}},
    },
}


def config(plant: dict[str, Any], p: int, size: float = 0.2) -> dict[str, Any]:
    problem = {
        "name": "linear",
        "system": copy.deepcopy(plant),
        "horizon": 1.0,
        "initial_state": [1.0, 0.0],
        "control": {"box": 8},
        "disturbance": {"box": [0.6, 0.4], "budget": {"p": p, "size": size}},
        "terminal": [{"box": [0.8, 0.9]}],
    }
    if "delay" in plant:
        problem["initial_control"] = [0]
    return {"problem": problem, "dictionaries": PIECES}


def integrator(p: int, size: float, radius: float = 1.0, bound: float = 2.0) -> sr.OptimalControlProblem:
    """``x1' = x2, x2' = u + w``, ``x1(1) <= bound``: the kernel of a gust at the time s is ``1 - s``."""
    return sr.OptimalControlProblem(
        system=sr.LinearSystem([[0, 1], [0, 0]], [[0], [1]], [[0], [1]]),
        horizon=1.0,
        initial_state=[3.0, 0.0],
        control=sr.Box([-8.0], [8.0]),
        disturbance=sr.BudgetedBox([-radius], [radius], p, size),
        terminal=[sr.Box([-np.inf, -np.inf], [bound, np.inf])],
    )


def cost_of(worst: float, bound: float = 2.0) -> float:
    """The push is on the first of 20 pieces, whose middle is 0.025, at up to 8."""
    missing, cost = 3.0 + worst - bound, 0.0
    for k in range(20):
        share = min(8.0 * 0.05, missing / (0.975 - 0.05 * k))
        missing, cost = missing - share * (0.975 - 0.05 * k), cost + share
    return cost


@pytest.mark.parametrize(
    ("p", "size", "radius", "worst"),
    [
        (1, 0.25, 1.0, 0.1 * 0.95 + 0.1 * 0.85 + 0.05 * 0.75),  # spent where the kernel is largest
        (1, 9.0, 1.0, 0.5),  # a budget that is never spent
        (2, 0.09, 100.0, 0.3 * float(np.sqrt(0.1 * ((0.95 - 0.1 * np.arange(10)) ** 2).sum()))),  # Cauchy and Schwarz
    ],
)
def test_a_double_integrator_costs_what_its_closed_form_says(
    p: int, size: float, radius: float, worst: float, tmp_path: Path
) -> None:
    result = sr.solve(integrator(p, size, radius), **PIECES)
    assert result.status == "certified"
    assert result.upper_bound == pytest.approx(cost_of(worst), rel=1e-7)
    result.save(tmp_path / "run", figures=False)
    assert check(tmp_path / "run").status == "verified"


@pytest.mark.parametrize("p", [1, 2])
def test_the_worst_signal_keeps_its_budget_and_one_that_spends_more_is_refuted(p: int, tmp_path: Path) -> None:
    sr.solve(integrator(p, 0.25), **PIECES, method="nominal").save(tmp_path / "run", figures=False)
    assert check(tmp_path / "run").status == "verified"
    path = tmp_path / "run" / "certificate.json"
    certificate = json.loads(path.read_text())
    signal = np.array(certificate["witness"]["disturbance"])
    spent = float((0.05 * np.abs(signal) ** p).sum())
    assert 0.25 * (1 - 1e-11) < spent <= 0.25
    idle = int(np.abs(signal[0]).argmin())
    signal[0, idle - idle % 2 : idle - idle % 2 + 2] += 1e-7
    certificate["witness"]["disturbance"] = signal.tolist()
    path.write_text(json.dumps(certificate))
    assert check(tmp_path / "run").status == "refuted"


def test_a_bound_that_needs_a_little_more_budget_is_not_certified() -> None:
    worst = 0.1 * 0.95 + 0.1 * 0.85 + 0.05 * 0.75
    reach = 8.0 * 0.5  # at full thrust
    for slack, status in ((1e-3, "certified"), (-1e-3, "infeasible")):
        bound = 3.0 + worst - reach + slack
        assert sr.solve(integrator(1, 0.25, 1.0, bound), **PIECES).status == status


def test_a_config_says_the_budget_and_a_run_writes_it_again(tmp_path: Path) -> None:
    result = sr.solve(integrator(2, 0.09), **PIECES)
    result.save(tmp_path / "run", figures=False)
    written = control_problem_of(load_config(tmp_path / "run" / "config.yaml"), "a control problem").disturbance
    assert isinstance(written, sr.BudgetedBox)
    assert written.is_same(integrator(2, 0.09).disturbance)


@pytest.mark.parametrize(
    ("change", "sentence"),
    [
        ({"disturbance_class": "measurable"}, "more pieces in dictionaries.disturbance"),
        ({"disturbance": {"box": {"lower": [-1, -1], "upper": [2, 1]}, "budget": {"p": 1, "size": 1}}}, "symmetric"),
        ({"disturbance": {"norm": {"p": 2, "radius": 1}, "budget": {"p": 1, "size": 1}}}, "a box beside the budget"),
        ({"disturbance": {"box": 1, "budget": {"p": 3, "size": 1}}}, "budget.p"),
        ({"disturbance": {"box": 1, "budget": {"p": 1, "size": -1}}}, "budget.size"),
        ({"disturbance": {"budget": {"p": 2, "size": 1}}}, "disturbance"),
    ],
)
def test_what_a_budget_does_not_stand_beside_is_refused_by_its_key(change: dict[str, Any], sentence: str) -> None:
    wrong = config(PLANTS["phases"], 1)
    wrong["problem"].update(change)
    with pytest.raises(sr.InputError, match=sentence):
        control_problem_of(load_config(wrong), "a control problem")


def test_a_policy_beside_a_budget_is_refused_with_what_to_do_instead() -> None:
    with pytest.raises(sr.InputError, match="leave it out"):
        sr.solve(integrator(1, 0.2), **PIECES, policy="affine")


@pytest.mark.slow
@pytest.mark.parametrize("p", [1, 2])
@pytest.mark.parametrize("plant", list(PLANTS))
def test_every_plant_costs_what_programs_on_samples_say(plant: str, p: int, tmp_path: Path) -> None:
    problem = control_problem_of(load_config(config(PLANTS[plant], p)), "a control problem")
    result = sr.solve(problem, **PIECES)
    result.save(tmp_path / "run", figures=False)
    assert result.status == "certified"
    assert not outside(result, bounds_of(config(PLANTS[plant], p)))
    assert check(tmp_path / "run").status == "verified"
