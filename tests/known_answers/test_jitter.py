"""Guards known answers: changes of the control that come late, against a closed form, an independent linear program and
delays themselves; what is refused beside them; forgeries."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.linalg import expm
from scipy.optimize import linprog

import sparserob_core as sr
from sparserob_core.control.studies.answer import ControlResult
from sparserob_core.experiment.check.check import check
from sparserob_core.experiment.config.writing.problem import problem_keys
from tests.known_answers.test_checks import pieces, verified
from tests.support import tampering

JITTER, PIECES, HORIZON, FINE = 0.1, 12, 3.0, 120
A, B = np.array([[0.0, 1.0], [-4.0, -0.3]]), np.array([[0.0, 0.4], [1.0, 0.0]])
WALL, START = 0.35, np.array([-1.0, 0.5])
PROBLEM: dict[str, Any] = {
    "name": "linear",
    "system": {"A": A.tolist(), "B": B.tolist()},
    "horizon": HORIZON,
    "initial_state": START.tolist(),
    "control": {"box": 1.0},
    "weights": [1.0, 0.2],
    "jitter": JITTER,
    "path": [{"box": [WALL, None], "from": 1.0}],
    "terminal": [{"box": [0.1, 0.15]}],
}
STEP = HORIZON / PIECES / FINE
LATE = round(JITTER / STEP)  # fine steps during which a change may be late
FLOW = expm(A * STEP)
PUSHED = np.linalg.solve(A, FLOW - np.eye(2)) @ B


def in_time(matrix: np.ndarray) -> list[list[str]]:
    return [[f"{entry} + 0*t" for entry in row] for row in matrix]


PLANTS: dict[str, dict[str, Any]] = {
    "constant": PROBLEM["system"],
    "in t": {"A": in_time(A), "B": in_time(B)},
    "pieces": {"pieces": [{"until": end, "A": A.tolist(), "B": B.tolist()} for end in (1.31, HORIZON)]},
}


@pytest.fixture(
    scope="module", params=["constant", *(pytest.param(name, marks=pytest.mark.slow) for name in ("in t", "pieces"))]
)
def finished(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A finished run, of the plant as it is, as one that might change with time, and in two modes that are the same."""
    directory = tmp_path_factory.mktemp("jitter") / "run"
    verified(directory, {**PROBLEM, "system": PLANTS[request.param]}, pieces(PIECES))
    return directory


def independent() -> float:
    """The cost by a linear program in ``u = a - b`` and bounds ``s`` of the changes, its rows by sums over fine steps
    and at many times."""
    K, back = PIECES, [np.eye(2)]
    for _ in range(K * FINE):
        back.append(back[-1] @ FLOW)
    powers, G, h = np.array(back), [], []
    every = list(range(K * FINE // 3, K * FINE + 1))
    walls = [(np.array([1.0, 0.0]), WALL, every)]
    walls += [(np.array([1.0, 0.0]), 0.1, [K * FINE]), (np.array([0.0, 1.0]), 0.15, [K * FINE])]
    for c, bound, times in walls:
        for n in times:
            each = np.zeros((2, K * FINE))
            each[:, :n] = (c @ powers[:n] @ PUSHED)[::-1].T
            parts = each.reshape(2, K, FINE)
            late = parts[:, 1:, :LATE]
            on = parts.sum(axis=2)
            on[:, 1:] -= late.sum(axis=2) / 2
            on[:, :-1] += late.sum(axis=2) / 2
            size = np.abs(late).sum(axis=2) / 2
            for sign in (1.0, -1.0):
                G.append(np.concatenate([sign * on.ravel(), -sign * on.ravel(), size.ravel()]))
                h.append(bound - sign * float(c @ powers[n] @ START))
    for i, k in np.ndindex(2, K - 1):
        change = np.zeros((2, K))
        change[i, k : k + 2] = [-1.0, 1.0]
        own = np.zeros((2, K - 1))
        own[i, k] = -1.0
        for sign in (1.0, -1.0):
            G.append(np.concatenate([sign * change.ravel(), -sign * change.ravel(), own.ravel()]))
            h.append(0.0)
    prices = np.append(np.tile(np.repeat([1.0, 0.2], K), 2) * HORIZON / K, np.zeros(2 * (K - 1)))
    bounds = [(0, 1)] * (4 * K) + [(0, None)] * (2 * (K - 1))
    return float(linprog(prices, A_ub=G, b_ub=h, bounds=bounds, method="highs").fun)


@pytest.mark.slow
def test_the_cost_is_that_of_an_independent_linear_program(finished: Path) -> None:
    cost = json.loads((finished / "result.json").read_text())["cost"]
    assert cost == pytest.approx(independent(), rel=3e-5)


STRAIGHT: dict[str, Any] = {  # x' = u, dear until 1: from -1 to at least -0.8 at 1, and to at least -0.1 at the end
    "name": "linear",
    "system": {"A": [[0]], "B": [[1]]},
    "horizon": 2.0,
    "initial_state": [-1],
    "control": {"box": 1.0},
    "weights": [[0, 2], [1, 1]],
    "path": [{"box": {"lower": [-0.8], "upper": [0.5]}, "from": 1.0}],
    "terminal": [{"box": 0.1}],
}


@pytest.mark.parametrize("jitter", [0.2, pytest.param(0.0, marks=pytest.mark.slow)])
def test_a_push_that_may_begin_late_is_stronger(jitter: float, tmp_path: Path) -> None:
    # u_1 = 0.2, since more of it would spare only (1 + jitter) / (1 - jitter) < 2 of u_2; of u_2 - u_1 the share
    # `jitter` is missing at the end
    pushed = (0.7 - jitter * 0.2) / (1.0 - jitter)
    found = verified(tmp_path / "run", {**STRAIGHT, "jitter": jitter}, pieces(2))
    assert found["cost"] == pytest.approx(2.0 * 0.2 + pushed, rel=1e-8)


@pytest.mark.slow
def test_an_energy_is_that_of_the_plan(tmp_path: Path) -> None:
    problem = {**STRAIGHT, "jitter": 0.2, "cost": {"l1": 1.0, "control": {"R": [[0.1]]}}}
    pushed = 0.66 / 0.8
    cost = verified(tmp_path / "run", problem, pieces(2))["cost"]
    assert cost == pytest.approx(0.4 + pushed + 0.1 * (0.04 + pushed**2), rel=1e-7)


def highest(control: np.ndarray, shares: np.ndarray) -> np.ndarray:
    """How far the walls are used up, ``(3,)``, where a share ``(2, K - 1, LATE)`` of a change has not come yet."""
    delivered = np.repeat(control, FINE, axis=1).reshape(2, PIECES, FINE)
    delivered[:, 1:, :LATE] -= shares * np.diff(control, axis=1)[:, :, None]
    state, seen = START, []
    for value in delivered.reshape(2, -1).T:
        state = FLOW @ state + PUSHED @ value
        seen.append(state)
    states = np.array(seen)
    return np.array([np.abs(states[PIECES * FINE // 3 - 1 :, 0]).max() / WALL, *np.abs(states[-1]) / [0.1, 0.15]])


@pytest.mark.slow
def test_no_delays_and_no_slopes_pass_a_wall_and_the_worst_of_them_reach_one(finished: Path) -> None:
    control, rng = np.load(finished / "solution.npz")["control"], np.random.default_rng(5)
    steps = np.arange(LATE)
    for _ in range(30):
        delays = rng.integers(0, LATE + 1, (2, PIECES - 1, 1))
        assert (highest(control, (steps < delays).astype(float)) <= 1.0 + 1e-9).all()
        slopes = np.clip(1.0 - steps / np.maximum(delays, 1), 0.0, 1.0)
        assert (highest(control, slopes) <= 1.0 + 1e-9).all()
    reached = []
    for axis in (0, 1):
        c, sides = np.eye(2)[axis], []
        for _ in range(PIECES * FINE):
            sides.append(c @ PUSHED)
            c = c @ FLOW
        kernel = np.array(sides)[::-1].T.reshape(2, PIECES, FINE)[:, 1:, :LATE]
        change = np.diff(control, axis=1)[:, :, None]
        reached += [highest(control, (sign * kernel * change < 0.0).astype(float))[1 + axis] for sign in (1.0, -1.0)]
    assert max(reached) == pytest.approx(1.0, abs=1e-6)


@pytest.mark.slow
def test_more_than_can_be_made_up_for_is_proven_to_be_infeasible(tmp_path: Path) -> None:
    # the push has to grow at 1 from at most 0.2 to more than 1
    problem = {
        **STRAIGHT,
        "jitter": 0.4,
        "path": [{"box": {"lower": [-0.8], "upper": [-0.75]}, "from": 1.0, "to": 1.0001}],
    }
    problem["control"], problem["terminal"] = {"box": 0.95}, [{"box": 0.05}]
    verified(tmp_path / "run", problem, pieces(2), status="infeasible")


@pytest.mark.slow
@pytest.mark.parametrize(
    "change",
    [
        tampering.problem(jitter=0.1001),
        tampering.problem(jitter=0.0999),
        tampering.problem(jitter=0.0),
        tampering.scaled(0.9999),
        tampering.heaviest(multiplier=1.0),
    ],
    ids=["more", "less", "none", "control", "multiplier"],
)
def test_what_is_changed_afterwards_is_found(change: tampering.Change, finished: Path, tmp_path: Path) -> None:
    assert check(tampering.forged(finished, tmp_path / "copy", change, consistent=True)).status == "refuted"


@pytest.mark.slow
@pytest.mark.parametrize("factor", [-1.0, 0.0, 1e3])
def test_a_bound_does_not_rest_on_what_is_said_of_changes(factor: float, finished: Path, tmp_path: Path) -> None:
    def change(forgery: tampering.Forgery) -> None:
        forgery.multipliers["late"] = (factor * np.array(forgery.multipliers["late"])).tolist()

    found = check(tampering.forged(finished, tmp_path / "copy", change, consistent=False))
    assert {claim.name: claim.verdict for claim in found.claims}["lower bound"] == "fails"


@pytest.mark.first(4)
@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"jitter": -0.1}, "a time below 3"),
        ({"jitter": 3.5}, "a time below 3"),
        ({"jitter": 0.25}, "less than 0.25, the shortest piece"),
        ({"execution": 0.1}, "execution"),
        ({"system": {**PROBLEM["system"], "delay": 0.1}}, "delay"),
        ({"path": [], "terminal": [{"equals": [0, 0]}]}, "fixed final values"),
        ({"path": [{"mixed": {"H": [[1, 0]], "G": [[1, 0]], "h": [2]}}]}, "mixed"),
        ({"integral": [{"G": [[1, 0]], "upper": [2]}]}, "integrals with G"),
        ({"initial_state": {"centre": [0, 0], "box": 0.1}, "repeat": True}, "repeat"),
        (
            {
                "system": {"A": [[0, 1], ["-4 - p", -0.3]], "B": B.tolist(), "parameters": {"p": [-0.1, 0.1]}},
                "terminal": [{"norm": {"p": 2, "radius": 0.3}}],
            },
            "curved sets of states with parameters",
        ),
    ],
)
def test_what_is_not_proven_beside_it_is_refused_by_name(changes: dict[str, Any], said: str, tmp_path: Path) -> None:
    config = {"problem": {**PROBLEM, **changes}, "dictionaries": {"control": pieces(PIECES)}, "observers": []}
    with pytest.raises(sr.InputError, match=rf"problem\.jitter.*{said}"):
        sr.run(config, out=tmp_path / "run", figures=False)


def test_feedback_does_not_know_it_and_refuses(tmp_path: Path) -> None:
    config = {"problem": PROBLEM, "dictionaries": {"control": pieces(4)}, "observers": [], "policy": {"name": "affine"}}
    with pytest.raises(sr.InputError, match="jitter"):
        sr.run(config, out=tmp_path / "run", figures=False)


LATE_PUSH = {"problem": {**STRAIGHT, "jitter": 0.2}, "dictionaries": {"control": pieces(2)}, "observers": []}


def test_the_tube_of_a_result_holds_every_delay_and_no_more(tmp_path: Path) -> None:
    result = sr.run(LATE_PUSH, out=tmp_path / "run", figures=False).result
    assert isinstance(result, ControlResult)
    first, second = result.control.values[0]
    tube = result.tube([0.5, 1.0, 1.1, 1.2, 2.0])
    late = (second - first) * np.array([0.0, 0.0, 0.1, 0.2, 0.2])
    plan = -1.0 + first * np.array([0.5, 1, 1, 1, 1]) + second * np.array([0, 0, 0.1, 0.2, 1.0])
    assert tube.upper[0] == pytest.approx(plan, abs=1e-9)
    assert tube.lower[0] == pytest.approx(plan - late, abs=1e-9)


@pytest.mark.parametrize(
    "law", ["vertices", *(pytest.param(n, marks=pytest.mark.slow) for n in ("iid", "slow", "neighbours"))]
)
def test_draws_come_late_and_never_by_more(law: str, tmp_path: Path) -> None:
    outcome = sr.run(LATE_PUSH, out=tmp_path / "run", figures=False)
    assert isinstance(outcome.result, ControlResult)
    first, second = outcome.result.control.values[0]
    found = sr.simulate(tmp_path / "run", 200, law)
    ends = np.array([found.lower[0, -1], found.upper[0, -1]]) - (-1.0 + first + second)
    assert (ends <= 1e-12).all() and (ends >= -0.2 * (second - first) - 1e-12).all() and np.ptp(ends) > 0.0
    assert not found.constraints[0].violated


@pytest.mark.slow
def test_the_worst_case_is_replayed_and_a_plan_that_does_not_know_it_fails(tmp_path: Path) -> None:
    sr.run(LATE_PUSH, out=tmp_path / "run", figures=False)
    for row in sr.simulate(tmp_path / "run", law="adversary").constraints:
        assert row.largest == pytest.approx(row.worst, abs=1e-12)
    sr.run({**LATE_PUSH, "method": {"name": "nominal"}}, out=tmp_path / "plain", figures=False)
    assert sr.simulate(tmp_path / "plain", 100, "vertices").constraints[-1].violated > 20


def test_the_problem_is_written_as_the_config_that_says_the_same() -> None:
    problem = sr.OptimalControlProblem(
        system=sr.LinearSystem(A, B), horizon=HORIZON, initial_state=START, control=sr.Box([-1, -1], [1, 1]), jitter=0.1
    )
    assert problem_keys(problem)["jitter"] == 0.1
