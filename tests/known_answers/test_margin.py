"""Guards known answers: the margins of the paper's experiments, against bisections over programs that share nothing
with the package."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

import sparserob_core as sr
from tests.support.independent import Problem, sample, value
from tests.support.places import CONFIGS


def experiment_1(bound: float) -> Problem:
    return Problem(
        A=np.array([[0.0, 1.0], [-2.0, -0.5]]),
        B=np.array([[0.0], [1.0]]),
        initial_state=np.array([-1.0, 1.0]),
        horizon=5.0,
        pieces=250,
        control=np.ones(1),
        weights=np.ones(1),
        disturbance=np.full(2, bound),
        terminal=np.full(2, 0.3),
        path=[(np.array([0.7, np.inf]), 0.3, 5.0)],
    )


def bisected(problem: Problem, low: float, high: float, width: float) -> tuple[float, float]:
    """The largest bound of the disturbance for which linear programs on the nodes are feasible."""
    while high - low > width:
        middle = (low + high) / 2
        one = replace(problem, disturbance=np.full(2, middle))
        low, high = (middle, high) if np.isfinite(value(one, sample(one, 1))) else (low, middle)
    return low, high


@pytest.mark.slow
def test_experiment_1_bears_what_an_independent_bisection_says():
    low, high = bisected(experiment_1(0.06), 0.06, 0.08, 1e-7)
    found = sr.margin(CONFIGS / "experiment1_repaired.yaml", of="disturbance")
    assert found.status == "certified"
    assert found.upper - found.lower <= 2e-6
    assert low - 2e-7 <= found.amounts[1]
    assert found.amounts[0] <= high + 2e-7
    assert abs(found.amounts[0] - 0.06841) < 5e-6
    assert abs(found.amounts[0] - 0.06 * found.lower) < 1e-12


@pytest.mark.slow
def test_experiment_1_starts_its_window_no_earlier_than_the_state_can_be_there(tmp_path):
    found = sr.margin(CONFIGS / "experiment1_repaired.yaml", of="path.0.from")
    assert found.status == "certified"
    assert found.upper - found.lower <= 2e-5
    for start, status in ((found.upper, "certified"), (found.lower, "infeasible")):
        overrides = {"problem.path.0.from": start, "observers": []}
        assert (
            sr.run(CONFIGS / "experiment1_repaired.yaml", overrides, out=tmp_path / status, figures=False).status
            == status
        )


@pytest.mark.slow
def test_an_oscillator_needs_the_control_that_its_interior_worst_parameter_asks_for():
    """x'' + omega^2 x = u, omega in [0.9, 1.1], x0 = (1, 0), |x1(2 pi)| <= f 0.8: the smallest set against the runs on
    both sides."""
    config = {
        "problem": {
            "name": "linear",
            "system": {"A": [[0, 1], ["-(1 + d)**2", 0]], "B": [[0], [1]], "parameters": {"d": [-0.1, 0.1]}},
            "horizon": 6.283185307179586,
            "initial_state": [1, 0],
            "control": {"box": 1.0},
            "terminal": [{"box": [0.8, None]}],
        },
        "dictionaries": {"control": {"name": "piecewise_constant", "pieces": 50}},
        "observers": [],
    }
    found = sr.margin(config, of="control")
    assert found.status == "certified"
    assert "at d = 0.01" in found.message
    gains = []
    # where the control, whatever its sign, can push x1(T) most, it needs least of it
    for d in np.linspace(-0.1, 0.1, 401):
        omega, pieces = 1 + d, np.linspace(0, 2 * np.pi, 51)
        response = np.diff(np.cos(omega * (2 * np.pi - pieces))) / omega**2
        gains.append((np.cos(2 * np.pi * omega) - 0.8) / np.abs(response).sum())
    assert abs(max(gains) - found.lower) <= 2e-4


@pytest.mark.slow
def test_the_parameters_of_experiment_2_may_be_two_thirds_wider():
    found = sr.margin(CONFIGS / "experiment2_repaired.yaml", of="parameters", tolerance=1e-4)
    assert found.status == "certified"
    assert abs(found.lower - 1.67849) < 3e-4
