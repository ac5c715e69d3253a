"""Guards control_step: the change of the control from piece to piece, against known values, an independent linear
program, other units, and forged certificates."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.linalg import expm
from scipy.optimize import linprog

import sparserob_core as sr
from sparserob_core.experiment.check.check import check
from tests.support.problems import spring
from tests.support.tampering import Forgery, forged

SPRING = spring(0.05, control_step={"box": 0.25}, initial_control=[0])
MASSES: dict[str, Any] = {  # two inputs, a round set of steps, an uncertain friction
    "name": "linear",
    "system": {
        "A": [[0, 0, 1, 0], [0, 0, 0, 1], [-2, 1, "-0.1 + p", 0], [1, -2, 0, -0.1]],
        "B": [[0, 0], [0, 0], [1, 0], [0, 1]],
        "E": [[0, 0], [0, 0], [1, 0], [0, 1]],
        "parameters": {"p": [-0.05, 0.05]},
    },
    "horizon": 6.0,
    "initial_state": [0.8, 0.3, 0.4, -0.2],
    "control": {"norm": {"p": 2, "radius": 0.8}},
    "disturbance": {"box": [0.03, 0.03]},
    "terminal": [{"box": [0.3, 0.3, 0.3, 0.3]}],
}


def config(problem: dict[str, Any], pieces: int, **more: Any) -> dict[str, Any]:
    return {
        "problem": problem,
        "dictionaries": {"control": {"name": "piecewise_constant", "pieces": pieces}},
        "observers": [],
        **more,
    }


def run(problem: dict[str, Any], pieces: int, out: Path, **more: Any) -> sr.Outcome:
    return sr.run(config(problem, pieces, **more), out=out, quiet=True, figures=False)


@pytest.mark.first(2)
@pytest.mark.parametrize(
    "step",
    [
        {"box": 0.25},
        pytest.param({"norm": {"p": 2, "radius": 0.25}}, marks=pytest.mark.slow),
        {"ellipsoid": {"shape": [[0.0625]]}},
        {"polytope": {"H": [[3], [-7]], "h": [0.75, 1.75]}},
    ],
)
def test_the_known_cost_is_reached_however_the_interval_of_steps_is_written(step, tmp_path):
    outcome = run({**SPRING, "control_step": step}, 50, tmp_path / "run")
    assert outcome.result.status == "certified", outcome.result.message
    assert outcome.result.cost == pytest.approx(0.552318, rel=2e-6)
    assert check(outcome.directory).status == "verified", check(outcome.directory).claims
    steps = np.diff(outcome.control, axis=1, prepend=0.0)
    assert np.abs(steps).max() == pytest.approx(0.25, abs=1e-6)


def _cheapest(step: float, before: float | None, T: float = 2.0, K: int = 20) -> float:
    """``x'' = u`` from (1, 0) to the origin, ``|u| <= 1``, ``|u_{k+1} - u_k| <= step``, as a linear program."""
    dt = T / K
    A, b = np.array([[0.0, 1.0], [0.0, 0.0]]), np.array([[0.0], [1.0]])
    big = expm(np.block([[A, b], [np.zeros((1, 3))]]) * dt)
    Phi, gamma = big[:2, :2], big[:2, 2]
    reach = np.array([np.linalg.matrix_power(Phi, K - 1 - k) @ gamma for k in range(K)]).T
    free = np.linalg.matrix_power(Phi, K) @ np.array([1.0, 0.0])
    D = np.diff(np.eye(K), axis=0) if before is None else np.vstack([np.eye(1, K), np.diff(np.eye(K), axis=0)])
    offset = np.zeros(len(D))
    offset[0] = 0.0 if before is None else before
    rows = np.vstack([np.hstack([D, -D]), np.hstack([-D, D])])
    found = linprog(
        np.full(2 * K, dt),
        A_ub=rows,
        b_ub=np.concatenate([step + offset, step - offset]),
        A_eq=np.hstack([reach, -reach]),
        b_eq=-free,
        bounds=(0, 1),
    )
    assert found.status in (0, 2)
    return float(found.fun) if found.status == 0 else np.inf


@pytest.mark.first(2)
@pytest.mark.parametrize(("step", "before"), [(0.5, None), (0.4, 0.0), (0.4, -0.7), (0.3, None), (0.3, 0.5)])
def test_the_cost_is_that_of_an_independent_linear_program(step, before, tmp_path):
    problem = {
        "name": "linear",
        "system": {"A": [[0, 1], [0, 0]], "B": [[0], [1]]},
        "horizon": 2.0,
        "initial_state": [1, 0],
        "control": {"box": 1.0},
        "control_step": {"box": step},
        "terminal": [{"equals": [0, 0]}],
        **({} if before is None else {"initial_control": before}),
    }
    outcome, truth = run(problem, 20, tmp_path / "run"), _cheapest(step, before)
    if np.isinf(truth):
        assert outcome.result.status == "infeasible", outcome.result.message
    else:
        assert outcome.result.status == "certified", outcome.result.message
        assert outcome.result.cost == pytest.approx(truth, rel=1e-7)
    assert check(outcome.directory).status == "verified", check(outcome.directory).claims


@pytest.mark.slow
@pytest.mark.parametrize("step", [{"norm": {"p": 2, "radius": 0.3}}, {"box": [0.2, 0.3]}])
@pytest.mark.parametrize(
    "control",
    [
        {"name": "piecewise_constant", "pieces": 16},
        pytest.param({"name": "haar", "pieces": 16}, marks=pytest.mark.slow),
    ],
)
def test_two_inputs_with_an_uncertain_system_are_certified_and_checked(step, control, tmp_path):
    outcome = run({**MASSES, "control_step": step}, 16, tmp_path / "run", dictionaries={"control": control})
    assert outcome.result.status == "certified", outcome.result.message
    assert check(outcome.directory).status == "verified", check(outcome.directory).claims
    steps = np.diff(outcome.control, axis=1)
    size = np.linalg.norm(steps, axis=0).max() / 0.3 if "norm" in step else (np.abs(steps).T / [0.2, 0.3]).max()
    assert size == pytest.approx(1.0, abs=1e-6)


def test_factors_of_two_in_the_units_of_the_control_change_nothing(tmp_path):
    plain = run(SPRING, 50, tmp_path / "one").control
    other = {
        **SPRING,
        "system": {"A": [[0, 1], [-2, -0.5]], "B": [[0], [2.0**-30]]},
        "control": {"box": 2.0**30},
        "control_step": {"box": 0.25 * 2.0**30},
    }
    np.testing.assert_array_equal(run(other, 50, tmp_path / "two").control, plain * 2.0**30)


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"initial_control": 5}, r"problem.control_step: no control that stays in its set and begins at .* \[5.0\]"),
        ({"initial_control": 1.3, "control_step": {"norm": {"p": 2, "radius": 0.25}}}, "no control that stays"),
        ({"control_step": {"box": {"lower": [0.05], "upper": [0.1]}}}, "no control that stays in its set and"),
        ({"control_step": {"box": [1, 2]}}, "problem.control_step.box: expected 1 number, got 2"),
        ({"initial_control": [1, 2]}, "problem.initial_control: expected 1 finite numbers, one per control"),
    ],
)
def test_steps_that_no_control_can_take_are_refused_in_one_sentence(changes, said, tmp_path):
    with pytest.raises(sr.ConfigError, match=said):
        run({**SPRING, **changes}, 50, tmp_path / "run")


def test_too_small_steps_are_infeasible_with_a_certificate(tmp_path):
    outcome = run({**SPRING, "control_step": {"box": 0.02}}, 50, tmp_path / "run")
    assert outcome.result.status == "infeasible"
    assert check(outcome.directory).status == "verified", check(outcome.directory).claims


def _priced(files: Forgery) -> list[dict[str, Any]]:
    return [entry for entry in files.constraints if entry["constraint"] == "control_step"]


def _change(key: str, value: Any):
    def change(files: Forgery) -> None:
        max(_priced(files), key=lambda entry: entry["multiplier"])[key] = value

    return change


def _jump(files: Forgery) -> None:
    files.decision[0][20] += 0.3


@pytest.mark.first(2)
@pytest.mark.parametrize(
    ("claim", "change"),
    [
        ("control_step", lambda files: files.problem.update(control_step={"box": 0.2499})),
        ("control_step", lambda files: files.problem.update(initial_control=[0.5])),
        ("control_step", _jump),
        ("lower bound", lambda files: files.problem.update(control_step={"box": 0.26})),
        ("lower bound", _change("time", 2.05)),
        ("lower bound", _change("direction", [-3.0])),
        ("lower bound", _change("multiplier", 10.0)),
        ("lower bound", lambda files: [files.constraints.remove(entry) for entry in _priced(files)]),
    ],
)
def test_a_forged_step_is_found(claim, change, tmp_path, honest):
    found = check(forged(honest, tmp_path / "forged", change, consistent=True))
    assert any(one.name == claim and one.verdict == "fails" for one in found.claims), found.claims


@pytest.fixture(scope="module")
def honest(tmp_path_factory: pytest.TempPathFactory) -> Path:
    outcome = run(SPRING, 50, tmp_path_factory.mktemp("steps") / "run")
    assert check(outcome.directory).status == "verified"
    return outcome.directory
