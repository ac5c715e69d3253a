"""Guards what else may hold under policy affine, against linear programs that share nothing with the package: sets of
initial states, final states that are fixed, and certificates of them that were forged."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import sparserob_core as sr
from sparserob_core.experiment.check.check import check
from tests.support.policy_programs import PolicyProgram
from tests.support.problems import spring

SPRING = spring(0.15, since=0.5)
PIECES = 10


def config(problem: dict[str, Any], cost: str = "nominal", pieces: int = PIECES) -> dict[str, Any]:
    return {
        "problem": problem,
        "dictionaries": {"control": {"name": "piecewise_constant", "pieces": pieces}},
        "policy": {"name": "affine", "cost": cost},
    }


def run(problem: dict[str, Any], out: Path, cost: str = "nominal", pieces: int = PIECES) -> sr.Outcome:
    return sr.run(config(problem, cost, pieces), out=out, quiet=True, figures=False)


def proven(outcome: sr.Outcome) -> None:
    """The run is certified, its check holds, and no loop that is driven leaves what was proven."""
    assert outcome.status == "certified", outcome.result.message
    found = check(outcome.directory)
    assert found.status == "verified", [claim for claim in found.claims if claim.verdict != "holds"]
    driven = sr.simulate(outcome.directory, law="adversary")
    for one in driven.constraints:
        assert one.largest == pytest.approx(one.worst, abs=1e-9)
    sampled = sr.simulate(outcome.directory, law="vertices", trajectories=200)
    assert sampled.any_violated is None or sampled.any_violated.violated == 0
    assert not any(one.violated for one in sampled.constraints)


def program(problem: dict[str, Any], pieces: int, width: list[float], begun: list[float]) -> PolicyProgram:
    system = problem["system"]
    A, B = np.array(system["A"], dtype=float), np.array(system["B"], dtype=float)
    x0 = problem["initial_state"]
    x0 = np.array(x0["centre"] if isinstance(x0, dict) else x0, dtype=float)
    E = np.array(system.get("E", np.eye(len(A))), dtype=float)
    return PolicyProgram(A, B, E, x0, problem["horizon"], pieces, np.array(width), np.array(begun))


def spring_rows(independent: PolicyProgram, within: int, start: float = 0.5, end: bool = True) -> None:
    """The rows of the spring, ``within`` times a piece."""
    times = np.linspace(0.0, 5.0, independent.K * within + 1)
    for t in np.unique(np.append(times[times > start], start)):
        x = independent.state(float(t))
        for sign in (1.0, -1.0):
            independent.below(sign * x[0], 0.7)
    x = independent.state(5.0)
    for state in (0, 1) if end else ():
        for sign in (1.0, -1.0):
            independent.below(sign * x[state], 0.3)


def bracketed(cost: float, programs: Callable[[int], float], within: float = 2e-3) -> None:
    """The cost is no less than that of programs that see fewer times, and near that of one that sees many."""
    coarse, fine = (programs(times) for times in (2, 8))
    assert coarse <= fine * (1 + 1e-9) + 1e-9, "but for the rounding of two programs"
    assert fine <= cost * (1 + 1e-9) + 1e-9
    assert cost == pytest.approx(fine, rel=within)


@pytest.mark.slow
@pytest.mark.parametrize("cost", [pytest.param("nominal", marks=pytest.mark.slow), "peak"])
@pytest.mark.parametrize(
    "begun",
    [[0.3, 0.0], pytest.param([0.1, 0.1], marks=pytest.mark.slow), pytest.param([0.05, 0.4], marks=pytest.mark.slow)],
)
def test_a_box_of_initial_states_costs_what_a_linear_program_says(
    cost: str, begun: list[float], tmp_path: Path
) -> None:
    problem = {**SPRING, "initial_state": {"centre": [-1, 1], "box": begun}}
    outcome = run(problem, tmp_path / "run", cost)
    proven(outcome)

    def programs(within: int) -> float:
        independent = program(problem, PIECES, [0.15, 0.15], begun)
        spring_rows(independent, within)
        return independent.solve(1.0, cost)

    bracketed(outcome.result.cost, programs)


STATES: dict[str, dict[str, Any]] = {
    "an uneven box": {"box": {"lower": [-0.05, -0.1], "upper": [0.1, 0.0]}},
    "an ellipsoid": {"ellipsoid": {"shape": [[0.01, 0.002], [0.002, 0.02]]}},
    "a ball of the 1-norm": {"norm": {"p": 1, "radius": 0.1}},
    "a triangle": {"polytope": {"H": [[1, 0], [0, 1], [-1, -1]], "h": [0.1, 0.1, 0.1]}},
}


@pytest.mark.first(1)
@pytest.mark.parametrize("disturbed", [pytest.param(True, marks=pytest.mark.slow), False])
@pytest.mark.parametrize(
    "name", [pytest.param(name, marks=pytest.mark.slow if name == "an ellipsoid" else ()) for name in STATES]
)
def test_sets_of_initial_states_keep_every_guarantee(name: str, disturbed: bool, tmp_path: Path) -> None:
    disturbance = SPRING["disturbance"] if disturbed else None
    problem = {**SPRING, "initial_state": {"centre": [-1, 1], **STATES[name]}, "disturbance": disturbance}
    proven(run(problem, tmp_path / "run", "peak"))


@pytest.mark.slow
def test_the_control_answers_the_initial_state_from_the_first_piece_on(tmp_path: Path) -> None:
    """What is seen at time 0 is forgotten at once here, so that only the first piece can answer it; no plan takes such
    initial states."""
    problem = {**SPRING, "initial_state": {"centre": [-1, 1], "box": [0.35, 0.35]}, "disturbance": None}
    assert sr.run({**config(problem), "policy": {"name": "open_loop"}}, quiet=True).status == "infeasible"
    answering = {**config(problem), "policy": {"name": "affine", "memory": 0.0}}
    outcome = sr.run(answering, out=tmp_path / "run", quiet=True, figures=False)
    proven(outcome)
    gains = np.load(outcome.directory / "solution.npz")["gains"]
    assert np.abs(gains[0, 0]).max() > 1e-3
    assert np.count_nonzero(gains.any(axis=(2, 3))) == 1


@pytest.mark.slow
def test_no_causal_policy_is_better_than_one_that_begins_in_the_middle_of_the_initial_states(tmp_path: Path) -> None:
    """The middle of the set is one of the initial states: what is proven from it holds for the set, and only that."""
    lower = {}
    for name, begun in (("one", {}), ("set", {"box": [0.02, 0.02]})):
        problem = {**SPRING, "initial_state": {"centre": [-1, 1], **begun} if begun else [-1, 1]}
        config = {"problem": problem, "policy": {"name": "affine"}, "observers": []}
        config["dictionaries"] = {"control": {"name": "piecewise_constant", "pieces": 10}}
        outcome = sr.run(config, out=tmp_path / name, quiet=True, figures=False)
        found = check(outcome.directory)
        assert found.status == "verified", [claim for claim in found.claims if claim.verdict != "holds"]
        assert "causal" in {claim.name for claim in found.claims}
        lower[name] = outcome.summary["causal_lower_bound"]
        assert 0.97 * outcome.result.lower_bound < lower[name] <= outcome.result.lower_bound + 1e-9
    assert lower["one"] == pytest.approx(lower["set"], rel=1e-6)


@pytest.mark.slow
def test_the_bound_against_every_causal_policy_is_the_same_beside_all_policies_that_cost_as_little() -> None:
    """Beside the second one signals that fear its answers alone lead to 0.4326 or 0.4245."""
    bounds = []
    for among in ("peak", None):
        config = {"problem": {**SPRING, "initial_state": [-1, 1]}, "policy": {"name": "affine", "among": among}}
        config["dictionaries"] = {"control": {"name": "piecewise_constant", "pieces": 10}}
        bounds.append(sr.run(config, quiet=True, figures=False).result.causal.lower)
    assert min(bounds) > 0.4477


@pytest.mark.slow
def test_larger_initial_states_than_any_policy_can_take_are_infeasible_with_their_reason(tmp_path: Path) -> None:
    problem = {**SPRING, "initial_state": {"centre": [-1, 1], "box": [0.6, 0.6]}}
    outcome = run(problem, tmp_path / "run")
    assert outcome.status == "infeasible"
    assert "for every disturbance and initial state" in outcome.result.message
    assert check(outcome.directory).status == "verified"


@pytest.mark.slow
def test_feedback_takes_more_initial_states_than_a_plan(tmp_path: Path) -> None:
    problem = {**SPRING, "initial_state": {"centre": [-1, 1], "box": [0.1, 0.1]}, "disturbance": {"box": [0.03, 0.03]}}
    found = [
        sr.margin(
            {**config(problem), "policy": {"name": name}}, of="initial_state", tolerance=1e-3, out=tmp_path / name
        )
        for name in ("open_loop", "affine")
    ]
    assert [one.status for one in found] == ["certified"] * 2
    assert found[1].amounts[0] > 1.1 * found[0].amounts[1]


@pytest.fixture(scope="module")
def begun(tmp_path_factory: pytest.TempPathFactory) -> Path:
    problem = {**SPRING, "initial_state": {"centre": [-1, 1], "box": [0.1, 0.2]}}
    outcome = run(problem, tmp_path_factory.mktemp("begun") / "run", "peak")
    proven(outcome)
    return outcome.directory


@pytest.mark.first(1)
@pytest.mark.parametrize("cost", ["nominal", "peak"])
@pytest.mark.parametrize("fixed", [pytest.param([0.0, 0.0], marks=pytest.mark.slow), [None, 0.1]])
def test_final_states_are_fixed_from_every_initial_state(cost: str, fixed: list[float | None], tmp_path: Path) -> None:
    start = {"centre": [-1, 1], "box": [0.1, 0.2]}
    problem = {**SPRING, "initial_state": start, "disturbance": None, "terminal": [{"equals": fixed}]}
    outcome = run(problem, tmp_path / "run", cost)
    proven(outcome)

    def programs(within: int) -> float:
        independent = program(problem, PIECES, [0.0, 0.0], [0.1, 0.2])
        spring_rows(independent, within, end=False)
        x = independent.state(5.0)
        for state, value in enumerate(fixed):
            if value is not None:
                independent.equal(x[state], value)
        return independent.solve(1.0, cost)

    bracketed(outcome.result.cost, programs)


@pytest.mark.slow
@pytest.mark.parametrize("name", STATES)
def test_final_states_are_fixed_from_sets_of_every_kind(name: str, tmp_path: Path) -> None:
    start = {"centre": [-1, 1], **STATES[name]}
    problem = {**SPRING, "initial_state": start, "disturbance": None, "terminal": [{"equals": [0.1, 0.0]}]}
    proven(run(problem, tmp_path / "run", "peak"))


def test_what_the_last_piece_of_a_disturbance_reaches_is_fixed_by_nothing(tmp_path: Path) -> None:
    fixed = {**SPRING, "system": {**SPRING["system"], "E": [[0], [1]]}, "disturbance": {"box": 0.1}}
    problem = {**fixed, "path": [], "terminal": [{"equals": [0, 0]}]}
    outcome = run(problem, tmp_path / "late")
    assert outcome.status == "infeasible"
    assert "equals: x" in outcome.result.message
    assert "after the last measurement, at 4.5, reaches it unanswered" in outcome.result.message
    assert check(outcome.directory).status == "verified"


SIDE_BY_SIDE: dict[str, Any] = {
    **SPRING,
    "system": {"A": [[-1, 0], [0, 0]], "B": [[1, 0], [0, 1]], "E": [[1], [0]]},
    "initial_state": [1, 1],
    "control": {"box": [1, 1]},
    "disturbance": {"box": 0.2},
    "path": [],
    "terminal": [{"box": [0.1, None]}, {"equals": [None, 0.25]}],
}


@pytest.mark.slow
def test_what_no_disturbance_reaches_is_fixed_beside_what_it_reaches(tmp_path: Path) -> None:
    """Two integrators side by side: the disturbance acts on the first alone, the second can be fixed."""
    problem = {**SIDE_BY_SIDE, "initial_state": {"centre": [1, 1], "box": [0.1, 0.1]}}
    outcome = run(problem, tmp_path / "run", "peak")
    proven(outcome)
    independent = program(problem, PIECES, [0.2], [0.1, 0.1])
    x = independent.state(5.0)
    for sign in (1.0, -1.0):
        independent.below(sign * x[0], 0.1)
    independent.equal(x[1], 0.25)
    assert outcome.result.cost == pytest.approx(independent.solve(1.0, "peak"), rel=1e-6)


def test_the_margin_of_a_disturbance_beside_a_fixed_state_is_what_its_last_piece_can_do() -> None:
    """``x1' = -x1 + u1 + w`` where ``|x1(5)| <= 0.1``: ``w (1 - e^{-h})`` on the last piece is answered by nothing."""
    found = sr.margin(config(SIDE_BY_SIDE), tolerance=1e-5)
    assert found.status == "certified", found.message
    exact = 0.1 / (1.0 - np.exp(-5.0 / PIECES))
    assert found.amounts[0] <= exact <= found.amounts[1]


@pytest.mark.first(1)
@pytest.mark.parametrize("pushed", [{"box": [0.1, 0.0]}, {"box": {"lower": [-0.1, 0.05], "upper": [0.1, 0.05]}}])
def test_a_fixed_state_that_only_a_known_disturbance_reaches_is_met(pushed: dict[str, Any], tmp_path: Path) -> None:
    system = {**SIDE_BY_SIDE["system"], "E": [[1, 0], [0, 1]]}
    proven(run({**SIDE_BY_SIDE, "system": system, "disturbance": pushed}, tmp_path / "run"))


@pytest.mark.slow
def test_a_fixed_state_that_the_last_disturbance_reaches_has_the_margin_zero() -> None:
    system = {**SPRING["system"], "E": [[0], [1]]}
    problem = {**SPRING, "system": system, "disturbance": {"box": 0.1}, "path": [], "terminal": [{"equals": [0, 0]}]}
    found = sr.margin(config(problem), tolerance=1e-3)
    assert found.status == "certified", found.message
    assert found.lower == 0.0 < found.upper <= 1e-3
    assert "reaches it unanswered" in found.message


@pytest.mark.slow
def test_fixed_final_states_have_a_margin(tmp_path: Path) -> None:
    start = {"centre": [-1, 1], "box": [0.1, 0.1]}
    problem = {**SPRING, "initial_state": start, "disturbance": None, "terminal": [{"equals": [0, 0]}]}
    found = sr.margin(config(problem), of="initial_state", tolerance=1e-3, out=tmp_path / "margin")
    assert found.status == "certified", found.message

    def cost(size: float) -> float:
        independent = program(problem, PIECES, [0.0, 0.0], [size, size])
        spring_rows(independent, 2, end=False)
        for state in independent.state(5.0):
            independent.equal(state, 0.0)
        return independent.solve(1.0, "nominal")

    assert np.isfinite(cost(found.amounts[0]))
    assert np.isinf(cost(1.1 * found.amounts[1]))


FORGERIES: dict[str, Any] = {
    "a gain on the initial state": lambda data: data["gains"][0][0][0].__setitem__(1, data["gains"][0][0][0][1] + 0.5),
    "an initial state outside of its set": lambda data: [
        one["deviation"].__setitem__(0, 0.2) for one in data["multipliers"]["constraints"]
    ],
    "another initial state": lambda data: [
        one["deviation"].__setitem__(1, -one["deviation"][1]) for one in data["multipliers"]["constraints"]
    ],
    "no initial state": lambda data: data["multipliers"]["constraints"][0].pop("deviation"),
}


def forged(directory: Path, copy: Path, forgery: Callable[[dict[str, Any]], object]) -> str:
    """The status of the check of a copy whose certificate was changed."""
    shutil.copytree(directory, copy)
    data = json.loads((copy / "certificate.json").read_text())
    forgery(data)
    (copy / "certificate.json").write_text(json.dumps(data))
    return check(copy).status


FIXED: dict[str, Any] = {
    "another gain": lambda data: data["gains"][3][0][0].__setitem__(1, data["gains"][3][0][0][1] + 1e-9),
    "another nominal control": lambda data: data["decision"][0].__setitem__(2, data["decision"][0][2] + 1e-9),
    "a larger multiplier": lambda data: _equal(data)[0].__setitem__("multiplier", 1.01 * _equal(data)[0]["multiplier"]),
    "a direction that is not fixed": lambda data: _equal(data)[0].__setitem__("direction", [1.0, 1.0]),
    "another time": lambda data: _equal(data)[0].__setitem__("time", 4.9),
}


def _equal(data: dict[str, Any]) -> list[dict[str, Any]]:
    return [one for one in data["multipliers"]["constraints"] if one["constraint"] == "equals"]


@pytest.fixture(scope="module")
def fixed(tmp_path_factory: pytest.TempPathFactory) -> Path:
    start = {"centre": [-1, 1], "box": [0.1, 0.2]}
    problem = {**SPRING, "initial_state": start, "disturbance": None, "terminal": [{"equals": [0, 0]}]}
    outcome = run(problem, tmp_path_factory.mktemp("fixed") / "run", "peak")
    proven(outcome)
    return outcome.directory


@pytest.mark.first(2)
@pytest.mark.parametrize("name", FIXED)
def test_a_forged_final_state_is_found(name: str, tmp_path: Path, fixed: Path) -> None:
    assert forged(fixed, tmp_path / "copy", FIXED[name]) == "refuted"


@pytest.mark.slow
@pytest.mark.parametrize("name", FORGERIES)
def test_a_forged_initial_state_is_found(name: str, tmp_path: Path, begun: Path) -> None:
    assert forged(begun, tmp_path / "copy", FORGERIES[name]) == "refuted"


@pytest.mark.slow
def test_a_simplex_of_disturbances_has_one_middle_in_all_units(tmp_path: Path) -> None:
    """That of its bounding box is outside; solver and checker count deviations from the same point."""
    problem = {
        "name": "linear",
        "system": {"A": [[0, 1, 0], [0, 0, 1], [0, 0, 0]], "B": [[0], [0], [1]]},
        "horizon": 3.0,
        "initial_state": [1000.0, 0.0, 0.0],
        "control": {"box": 4000.0},
        "disturbance": {"polytope": {"H": [[-1, 0, 0], [0, -1, 0], [0, 0, -1], [1, 0.1, 0.01]], "h": [0, 0, 0, 10]}},
        "terminal": [{"box": [4000.0, 4000.0, 4000.0]}],
    }
    proven(run(problem, tmp_path / "run", "nominal", 6))


@pytest.mark.slow
def test_functions_that_span_every_value_are_as_good_as_their_pieces(tmp_path: Path) -> None:
    """What is written of Haar's functions are the values on their pieces; fewer functions are refused by name."""
    found = {}
    for name in ("piecewise_constant", "haar"):
        dictionaries = {"control": {"name": name, "pieces": 4}}
        outcome = sr.run(
            {**config(SPRING, "peak"), "dictionaries": dictionaries}, out=tmp_path / name, quiet=True, figures=False
        )
        assert check(outcome.directory).status == "verified"
        found[name] = json.loads((outcome.directory / "certificate.json").read_text())
    assert found["haar"]["decision"] == found["piecewise_constant"]["decision"]
    assert forged(tmp_path / "haar", tmp_path / "copy", lambda data: data["decision"][0].reverse()) == "refuted"
    few = {"control": {"name": "haar", "pieces": 4, "functions": 2}}
    with pytest.raises(sr.InputError, match="any value on every piece"):
        sr.run({**config(SPRING), "dictionaries": few}, quiet=True)
