"""Guards known answers: systems with a drift, and controls that act with a delay, against closed forms and against
problems that are the same without either."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.linalg import expm

import sparserob_core as sr
from sparserob_core.experiment.check.check import check
from tests.known_answers.test_checks import ROUND, SPRING, pieces, verified
from tests.support import tampering

DRIFT = {**SPRING, "system": {**SPRING["system"], "c": [0, 0.3]}, "disturbance": {"box": [0.05, 0.05]}}
DELAY = {
    **SPRING,
    "system": {**SPRING["system"], "delay": 0.2},
    "disturbance": {"box": [0.05, 0.05]},
    "path": [{"box": [0.7, None], "from": 0.4}],
}


@pytest.mark.first(1)
@pytest.mark.parametrize(("problem", "J"), [(DRIFT, 0.819851), (DELAY, 0.538325)], ids=["drift", "delay"])
def test_a_listed_value_is_found_and_verified(problem: dict[str, Any], J: float, tmp_path: Path) -> None:
    assert verified(tmp_path / "run", problem, pieces(50))["cost"] == pytest.approx(J, abs=6e-7)


def test_a_landing_costs_what_gravity_and_the_fall_take(tmp_path: Path) -> None:
    # upward thrust only: int u = v(T) - v(0) + g T
    config = {
        "name": "linear",
        "system": {"A": [[0, 1], [0, 0]], "B": [[0], [1]], "E": [[0], [1]], "c": [0, -1.5]},
        "horizon": 4.0,
        "initial_state": [10, -2],
        "control": {"box": {"lower": [0], "upper": [4]}},
        "terminal": [{"equals": [0, 0]}],
    }
    found = verified(tmp_path / "run", config, pieces(40))
    assert found["cost"] == pytest.approx(2 + 1.5 * 4, rel=1e-6)


def test_an_uncertain_drift_costs_its_worst_side(tmp_path: Path) -> None:
    # x' = u + c, c in [0.1, 0.3], |x(T)| <= 0.25: the control must take 2 + 0.3 T down to 0.25
    config = {
        "name": "linear",
        "system": {"A": [[0]], "B": [[1]], "c": ["0.2 + p"], "parameters": {"p": [-0.1, 0.1]}},
        "horizon": 2.0,
        "initial_state": [2],
        "control": {"box": 2.0},
        "terminal": [{"box": [0.25]}],
    }
    assert verified(tmp_path / "run", config, pieces(8))["cost"] == pytest.approx(2.35, rel=1e-6)


@pytest.mark.slow
def test_a_drift_is_a_shift_of_the_state(tmp_path: Path) -> None:
    # with z = x + A^-1 c: z' = A z + B u + w
    A, c = np.array([[0.0, 1.0], [-2.0, -0.5]]), np.array([0.3, -0.2])
    shift = np.linalg.solve(A, c)
    grid = {"name": "piecewise_constant", "breakpoints": [0, 0.3, 0.9, 1.0, 2.0, 2.5, 2.9, 4.0, 5.0]}
    end = {"ellipsoid": {"centre": [0.1, 0], "shape": [[0.2, 0.05], [0.05, 0.15]]}}
    moved = {"ellipsoid": {**end["ellipsoid"], "centre": (np.array([0.1, 0]) + shift).tolist()}}
    drifting = {
        **SPRING,
        "system": {**SPRING["system"], "c": c.tolist()},
        "path": [],
        "terminal": [end],
    }
    still = {**SPRING, "path": [], "terminal": [moved], "initial_state": (np.array([-1, 1]) + shift).tolist()}
    found = [verified(tmp_path / name, one, grid) for name, one in (("drifting", drifting), ("still", still))]
    assert found[0]["cost"] > 0.01
    assert found[0]["cost"] == pytest.approx(found[1]["cost"], rel=2e-7)


def test_a_delayed_problem_is_one_that_begins_later(tmp_path: Path) -> None:
    # until 0.5 the control before time 0 acts; from there on the problem has no delay
    A, B, u0 = np.array([[0.0, 1.0], [-2.0, -0.5]]), np.array([[0.0, 0.5], [1.0, 0.0]]), np.array([0.3, -0.2])
    whole = expm(0.5 * np.block([[A, B], [np.zeros((2, 4))]]))
    later = whole[:2, :2] @ [-1, 1] + whole[:2, 2:] @ u0
    common = {"control": ROUND, "disturbance": None, "path": [], "terminal": [{"box": [0.05, 0.05]}]}
    delayed = {**SPRING, **common, "system": {"A": A.tolist(), "B": B.tolist(), "delay": 0.5}}
    found = verified(tmp_path / "delayed", {**delayed, "initial_control": u0.tolist()}, pieces(20))
    plain = {**SPRING, **common, "system": {"A": A.tolist(), "B": B.tolist()}, "horizon": 4.5}
    other = verified(tmp_path / "plain", {**plain, "initial_state": later.tolist()}, pieces(18))
    assert found["cost"] > 0.01
    assert found["cost"] == pytest.approx(other["cost"], rel=2e-7)
    with np.load(tmp_path / "delayed" / "solution.npz") as solution:
        assert not solution["control"][:, 18:].any()  # what is commanded after T - 0.5 does nothing


@pytest.mark.slow
def test_a_delay_that_is_no_multiple_of_a_piece_and_a_haar_dictionary_agree_with_indicators(tmp_path: Path) -> None:
    problem = {**DELAY, "system": {**DELAY["system"], "delay": 0.13, "c": [0, 0.1]}, "initial_control": 0.5}
    problem = {**problem, "disturbance": {"box": 0.02}}
    found = [
        verified(tmp_path / name, problem, {"name": name, "pieces": 32}, pieces(10))
        for name in ("piecewise_constant", "haar")
    ]
    assert found[0]["cost"] == pytest.approx(found[1]["cost"], rel=1e-6)


def test_measurable_disturbances_meet_drift_and_delay(tmp_path: Path) -> None:
    problem = {**DELAY, "system": {**DELAY["system"], "c": [0, 0.1]}, "disturbance": {"box": 0.03}}
    costs = []
    for kind in ("piecewise_constant", "measurable"):
        config = {"problem": {**problem, "disturbance_class": kind}, "dictionaries": {"control": pieces(25)}}
        result = sr.run({**config, "observers": []}, out=tmp_path / kind, figures=False).result
        assert result.status == "certified"
        costs.append(result.cost)
    assert 0.0 < costs[1] - costs[0] < 0.02 * costs[0]  # the larger class costs more, a little


def test_a_drift_that_nothing_withstands_is_infeasible_with_a_proof(tmp_path: Path) -> None:
    problem = {**DRIFT, "system": {**SPRING["system"], "c": [0, 3.0]}}
    found = verified(tmp_path / "run", problem, pieces(10), status="infeasible")
    assert "0.7" in found["message"] or "0.3" in found["message"]


def test_an_uncertain_drift_that_reaches_a_fixed_state_is_refused() -> None:
    system = {"A": [[0]], "B": [[1]], "c": ["p"], "parameters": {"p": [-0.1, 0.1]}}
    problem = {"name": "linear", "system": system, "horizon": 1, "initial_state": 1, "control": {"box": 2}}
    config = {"problem": {**problem, "terminal": [{"equals": [0]}]}, "dictionaries": {"control": pieces(4)}}
    with pytest.raises(sr.InputError, match="depends on the uncertainty"):
        sr.run({**config, "observers": []}, figures=False)


@pytest.mark.first(1)
@pytest.mark.parametrize("factors", [(2.0, 0.5, 4.0), (0.25, 8.0, 2.0)])
def test_other_units_by_powers_of_two_give_the_same_bits(factors: tuple[float, float, float]) -> None:
    time, first, control = factors
    x, decisions = np.array([first, 2.0]), []
    A, c = np.array([[0.0, 1.0], [-2.0, -0.5]]), np.array([0.1, 0.2])
    for s, t, u in ((np.ones(2), 1.0, 1.0), (x, time, control)):  # one unit of ours is so many of theirs
        system = sr.LinearSystem(
            A * s[:, None] / s / t,
            np.array([[0.0], [1.0]]) * s[:, None] / u / t,
            np.eye(2) * s[:, None] / t,
            c=c * s / t,
            delay=0.25 * t,
        )
        problem = sr.OptimalControlProblem(
            system=system,
            horizon=5.0 * t,
            initial_state=np.array([-1.0, 1.0]) * s,
            initial_control=[0.5 * u],
            control=sr.Box([-u], [u]),
            weights=[1.0 / (t * u)],
            disturbance=sr.Box([-0.03] * 2, [0.03] * 2),
            path=[sr.PathConstraint(sr.Box(np.array([-0.7, -np.inf]) * s, np.array([0.7, np.inf]) * s), 0.5 * t)],
            terminal=[sr.Box(-0.3 * s, 0.3 * s)],
        )
        dictionary = sr.Dictionary(np.linspace(0.0, 5.0 * t, 21), np.eye(20))
        result = sr.solve(sr.transcribe(problem, control=dictionary))
        assert result.status == "certified"
        decisions.append((result.decision / u, result.cost, result.lower_bound))
    assert np.array_equal(decisions[0][0], decisions[1][0])
    assert decisions[0][1:] == decisions[1][1:]


@pytest.fixture(scope="module")
def finished(tmp_path_factory: pytest.TempPathFactory) -> Path:
    problem = {**DELAY, "system": {**DELAY["system"], "c": [0, 0.1]}, "initial_control": 0.5}
    directory = tmp_path_factory.mktemp("systems") / "run"
    verified(directory, problem, pieces(20))
    return directory


@pytest.mark.first(2)
@pytest.mark.parametrize(
    "change",
    [
        tampering.system(c=[0, 0.11]),
        tampering.system(c=[0, 0.09]),
        tampering.system(delay=0.21),
        tampering.problem(initial_control=[0.52]),
    ],
    ids=["drift", "less drift", "delay", "control before"],
)
def test_a_system_that_is_changed_afterwards_is_found_by_what_it_does(
    change: tampering.Change, finished: Path, tmp_path: Path
) -> None:
    copy = tampering.forged(finished, tmp_path / "copy", change, consistent=True)
    assert check(copy).status == "refuted"


@pytest.mark.parametrize(
    ("system", "said"),
    [
        ({"c": [0]}, r"system\.c: expected 2 entries, one per state, got 1"),
        ({"c": [0, "q"]}, r"system\.c\.1: .*unknown name 'q'"),
        ({"delay": 5.0}, r"system\.delay: expected less than 5 \(the horizon\)"),
        ({"delay": -0.1}, r"system\.delay: .*0"),
        ({"delay": 1e-15}, r"system\.delay: expected .* more than rounding"),
        ({"c": 0.3}, r"system\.c: "),
    ],
)
def test_a_wrong_drift_or_delay_is_named_with_its_key(system: dict[str, Any], said: str) -> None:
    config = {"problem": {**SPRING, "system": {**SPRING["system"], **system}}, "dictionaries": {"control": pieces(5)}}
    with pytest.raises(sr.InputError, match=said):
        sr.run({**config, "observers": []}, figures=False)


def test_a_drift_may_be_any_function_of_the_parameters() -> None:
    def of(p: Any) -> Any:
        return [0.0 * p[0], p[0] * 2.0 + 1.0]

    parameters = sr.Box([-0.1], [0.1])
    system = sr.LinearSystem(np.zeros((2, 2)), [[0.0], [1.0]], parameters=parameters, c=of)
    matrix = sr.LinearSystem(np.zeros((2, 2)), [[0.0], [1.0]], parameters=parameters, c=lambda p: np.array([0.0, p[0]]))
    assert system.forced.phases[0].matrices(np.array([[0.05]]))[1][0].tolist() == [[0.0, 0.0], [1.0, 1.1]]
    assert matrix.forced.phases[0].matrices(np.array([[0.05]]))[1][0].tolist() == [[0.0, 0.0], [1.0, 0.05]]
    for wrong in ([1.0, 2.0, 3.0], 3.0):
        with pytest.raises(sr.InputError, match=r"system\.c: expected 2 numbers, one per state"):
            sr.LinearSystem(np.zeros((2, 2)), [[0.0], [1.0]], c=wrong)
