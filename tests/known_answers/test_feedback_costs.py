"""Guards quadratic costs and costs of groups under policy affine: those of the nominal control and trajectory, against
programs at nodes that share nothing with the package, and against forged certificates."""

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
from tests.known_answers.test_feedback_rows import program, proven, run, spring_rows
from tests.support.policy_programs import PolicyProgram
from tests.support.problems import spring

K, NODES = 4, 5
TWO = {"A": [[0, 1], [-2, -0.5]], "B": [[0.3, 0], [0.1, 1]]}
PUSHED = spring(0.1, since=0.9, system=TWO, control={"box": [1.0, 1.0]})
SQUARES = {
    "l1": 0.5,
    "state": {"Q": [[1.0, 0.2], [0.2, 0.5]], "reference": [0.2, 0]},
    "control": {"R": [[0.4, 0.1], [0.1, 0.2]]},
    "final": {"Q": [[4.0, 0], [0, 1.0]], "reference": [0.6, 0]},
}
COSTS: dict[str, dict[str, Any]] = {
    "squares": SQUARES,
    "groups": {"group": "all"},
}


def solved(independent: PolicyProgram, cost: dict[str, Any]) -> float:
    """The least cost of the nominal control, the integrals by Gauss' rule on every piece."""
    cvxpy = pytest.importorskip("cvxpy")
    independent.within(1.0)
    table, limits = independent.table
    x, h = cvxpy.Variable(table.shape[1]), independent.horizon / K
    v = cvxpy.reshape(x[: 2 * K], (2, K), order="C")
    norms = cvxpy.norm(v, axis=0) if "group" in cost else cvxpy.sum(cvxpy.abs(v), axis=0)
    total = cost.get("l1", 1.0) * h * cvxpy.sum(norms)

    def squared(t: float, Q: list[list[float]], about: list[float], weight: float) -> Any:
        known = independent.state(t)[:, 0]
        root = np.sqrt(weight) * np.linalg.cholesky(np.array(Q)).T
        coefficients = np.pad(root @ known[:, 1:], ((0, 0), (0, independent.more)))
        return cvxpy.sum_squares(coefficients @ x + root @ (known[:, 0] - np.array(about)))

    if "control" in cost:
        root = np.linalg.cholesky(np.array(cost["control"]["R"])).T
        total = total + h * cvxpy.sum_squares(root @ v)
    if "state" in cost:
        points, weights = np.polynomial.legendre.leggauss(NODES)
        for k in range(K):
            for p, w in zip(points, weights, strict=True):
                total = total + squared((k + (p + 1) / 2) * h, *cost["state"].values(), w * h / 2)
    if "final" in cost:
        total = total + squared(independent.horizon, *cost["final"].values(), 1.0)
    posed = cvxpy.Problem(cvxpy.Minimize(total), [table @ x <= limits])
    return float(posed.solve(solver="CLARABEL", tol_gap_abs=1e-10, tol_gap_rel=1e-10, tol_feas=1e-10))


@pytest.mark.slow
@pytest.mark.parametrize("name", COSTS)
def test_the_cost_is_what_a_program_on_nodes_says(name: str, tmp_path: Path) -> None:
    cost = COSTS[name]
    outcome = run({**PUSHED, "cost": cost}, tmp_path / "run", pieces=K)
    proven(outcome)

    independent = program(PUSHED, K, [0.1, 0.1], [0.0, 0.0])
    spring_rows(independent, 4, start=0.9)  # fewer times than there are: it costs no more, and nearly as much
    least = solved(independent, cost)
    assert least * (1 - 1e-7) <= outcome.result.cost <= least * (1 + 5e-3)


@pytest.mark.slow
@pytest.mark.parametrize("charged", ["peak", "worst"])
def test_squares_of_the_nominal_trajectory_are_added_to_peaks_and_efforts(charged: str, tmp_path: Path) -> None:
    """With a large factor of the squares the cost is nearly theirs alone, whatever else is charged."""
    cost = {**SQUARES, "l1": 1e-6}
    alone = run({**PUSHED, "cost": {**cost, "l1": 0.0}}, tmp_path / "alone", pieces=3)
    outcome = run({**PUSHED, "cost": cost}, tmp_path / "run", charged, pieces=3)
    proven(outcome)
    assert 0.0 < outcome.result.cost - alone.result.lower_bound < 1e-4


def test_a_square_of_one_control_is_in_closed_form(tmp_path: Path) -> None:
    """``x' = u + w`` from 1 to at most 0.5 + 0.1 with ``|w| <= 0.1``, which the last of two pieces cannot answer: the
    nominal state must come to 0.55, by -0.225 on each piece, which costs twice its square and nothing for answers."""
    problem = {
        "name": "linear",
        "system": {"A": [[0.0]], "B": [[1.0]]},
        "horizon": 2.0,
        "initial_state": [1.0],
        "control": {"box": 1.0},
        "disturbance": {"box": 0.1},
        "terminal": [{"box": {"lower": [-1.0], "upper": [0.65]}}],
        "cost": {"l1": 0.0, "control": {"R": [[1.0]]}},
    }
    outcome = run(problem, tmp_path / "run", pieces=2)
    proven(outcome)
    assert outcome.result.cost == pytest.approx(2 * 0.225**2, rel=1e-7)


def test_peaks_of_groups_are_refused_by_name(tmp_path: Path) -> None:
    with pytest.raises(sr.InputError, match="without group"):
        run({**PUSHED, "cost": {"group": "all"}}, tmp_path / "run", "peak", pieces=K)


FORGED: dict[str, Callable[[dict[str, Any]], object]] = {
    "a larger bound": lambda data: data.update(lower_bound=data["lower_bound"] * (1 + 1e-5)),
    "a smaller cost": lambda data: data.update(cost=data["cost"] * (1 - 1e-5)),
    "another tangent": lambda data: data["multipliers"]["tangent"][0].__setitem__(0, 0.9),
    "no tangent": lambda data: data["multipliers"].pop("tangent"),
    "a larger multiplier": lambda data: data["multipliers"]["constraints"][0].__setitem__("multiplier", 9.0),
}


@pytest.fixture(scope="module", params=["squares", "groups"])
def finished(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Path:
    directory = tmp_path_factory.mktemp(request.param) / "run"
    run({**PUSHED, "cost": COSTS[request.param]}, directory, pieces=4)
    return directory


@pytest.mark.slow
@pytest.mark.parametrize("name", FORGED)
def test_a_forged_cost_or_bound_is_refuted(finished: Path, name: str, tmp_path: Path) -> None:
    copy = tmp_path / "copy"
    shutil.copytree(finished, copy)
    data = json.loads((copy / "certificate.json").read_text())
    FORGED[name](data)
    (copy / "certificate.json").write_text(json.dumps(data))
    # of norms another tangent may prove as much: theirs are offered beside those that the multipliers ask for
    unseen = name == "another tangent" and "group" in finished.parent.name
    assert check(copy).status == ("verified" if unseen else "refuted")
