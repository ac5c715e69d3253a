"""Guards known answers: errors of execution, against independent linear programs and the worst errors themselves; what
is refused beside them; forgeries."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.linalg import expm
from scipy.optimize import linprog

import sparserob_core as sr
from sparserob_core.experiment.check.check import check
from tests.known_answers.test_checks import pieces, verified
from tests.support import tampering

SHARE, PIECES, HORIZON = np.array([0.1, 0.05]), 12, 3.0
A, B = np.array([[0.0, 1.0], [-4.0, -0.3]]), np.array([[0.0, 0.4], [1.0, 0.0]])
PROBLEM: dict[str, Any] = {
    "name": "linear",
    "system": {"A": A.tolist(), "B": B.tolist()},
    "horizon": HORIZON,
    "initial_state": [-1.0, 0.5],
    "control": {"box": 1.0},
    "weights": [1.0, 0.2],
    "execution": SHARE.tolist(),
    "path": [{"box": [0.5, None], "from": 1.0}],
    "terminal": [{"box": [0.2, 0.3]}],
}


DRESSED = {key: [[f"{entry} + 0*t" for entry in row] for row in part] for key, part in (("A", A), ("B", B))}


@pytest.fixture(scope="module", params=["constant", pytest.param("in t", marks=pytest.mark.slow)])
def finished(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A finished run, of the plant as it is and as one that might change with time."""
    directory = tmp_path_factory.mktemp("execution") / "run"
    plant = PROBLEM["system"] if request.param == "constant" else DRESSED
    verified(directory, {**PROBLEM, "system": plant}, pieces(PIECES))
    return directory


def independent() -> float:
    """The cost by a linear program in ``u = a - b``, its rows by sums over fine steps and at many times."""
    fine = 240
    step, K = HORIZON / PIECES / fine, PIECES
    flow = expm(A * step)
    pushed = np.linalg.solve(A, expm(A * step) - np.eye(2)) @ B
    back = [np.eye(2)]
    for _ in range(K * fine):
        back.append(back[-1] @ flow)
    powers = np.array(back)
    G, h = [], []
    windows = [(np.array([1.0, 0.0]), 0.5, range(K * fine // 3, K * fine + 1))]
    windows += [(np.array([1.0, 0.0]), 0.2, [K * fine]), (np.array([0.0, 1.0]), 0.3, [K * fine])]
    for c, bound, times in windows:
        for n in times:
            each = np.zeros((2, K * fine))
            each[:, :n] = (c @ powers[:n] @ pushed)[::-1].T
            on, off = each.reshape(2, K, fine).sum(axis=2), np.abs(each).reshape(2, K, fine).sum(axis=2)
            size = SHARE[:, None] * off
            for sign in (1.0, -1.0):
                G.append(np.concatenate([(sign * on + size).ravel(), (-sign * on + size).ravel()]))
                h.append(bound - sign * float(c @ powers[n] @ [-1.0, 0.5]))
    prices = np.tile(np.repeat([1.0, 0.2], K), 2) * HORIZON / K
    return float(linprog(prices, A_ub=G, b_ub=h, bounds=(0, 1), method="highs").fun)


@pytest.mark.slow
def test_the_cost_is_that_of_an_independent_linear_program(finished: Path) -> None:
    assert json.loads((finished / "result.json").read_text())["cost"] == pytest.approx(independent(), rel=2e-6)


STRAIGHT: dict[str, Any] = {  # x' = u: what is delivered must be from 0.9 to 1.1, so that a share of 0.1 is the largest
    "name": "linear",
    "system": {"A": [[0]], "B": [[1]]},
    "horizon": 2.0,
    "initial_state": [-1],
    "control": {"box": 1.0},
    "terminal": [{"box": 0.1}],
    "execution": 0.05,
}


CORNERS = [[1, 1], [1, -1], [-1, 1], [-1, -1], [1, 0], [-1, 0], [0, 1], [0, -1]]


def test_a_push_that_may_fall_short_is_stronger(tmp_path: Path) -> None:
    # x' = u, from -1 to at most 0.1 away from 0: the mean of u is at least 0.9 / (1 - 0.05)
    assert verified(tmp_path / "run", STRAIGHT, pieces(4))["cost"] == pytest.approx(0.9 / 0.95, rel=1e-9)


BOTH: dict[str, Any] = {  # x' = u in two axes, of which one is pushed by 0.9 / 0.95, the other by 1.2 / 0.96
    **STRAIGHT,
    "system": {"A": [[0, 0], [0, 0]], "B": [[1, 0], [0, 1]]},
    "initial_state": [-1, 1.3],
    "terminal": [{"box": [0.1, 0.1]}],
    "execution": [0.05, 0.04],
}


@pytest.mark.slow
@pytest.mark.parametrize("control", [{"box": [1.0, 1.0]}, {"polytope": {"H": CORNERS, "h": [1.2] * 4 + [1.0] * 4}}])
def test_a_push_as_one_vector_has_errors_channel_by_channel(control: dict[str, Any], tmp_path: Path) -> None:
    problem = {**BOTH, "control": control, "cost": {"group": "all"}}
    assert verified(tmp_path / "run", problem, pieces(4))["cost"] == pytest.approx(
        np.hypot(0.9 / 0.95, 1.2 / 0.96), rel=1e-8
    )


@pytest.mark.slow
def test_an_energy_is_that_of_the_command(tmp_path: Path) -> None:
    # the mean is the same on all pieces: 2 |u|^2 of it over the horizon of 2, and the norm beside it
    problem = {**BOTH, "cost": {"l1": 1.0, "control": {"R": [[1, 0], [0, 1]]}}}
    pushed = np.array([0.9 / 0.95, 1.2 / 0.96])
    cost = verified(tmp_path / "run", problem, pieces(4))["cost"]
    assert cost == pytest.approx(pushed.sum() + pushed @ pushed / 2.0, rel=1e-8)


@pytest.mark.slow
def test_the_worst_errors_reach_the_walls_and_no_others_pass_them(finished: Path) -> None:
    control = np.load(finished / "solution.npz")["control"]
    fine, rng = 200, np.random.default_rng(5)
    step = HORIZON / PIECES / fine
    flow, pushed = expm(A * step), np.linalg.solve(A, expm(A * step) - np.eye(2)) @ B
    command = np.repeat(control, fine, axis=1)

    def highest(errors: np.ndarray) -> np.ndarray:
        state, seen = np.array([-1.0, 0.5]), []
        for k in range(command.shape[1]):
            state = flow @ state + pushed @ (command[:, k] * (1.0 + SHARE * errors[:, k]))
            seen.append(state)
        found = np.array(seen)
        late = np.abs(found[command.shape[1] // 3 :, 0]).max() / 0.5
        return np.array([late, *np.abs(found[-1]) / [0.2, 0.3]])

    for _ in range(40):
        errors = np.repeat(rng.uniform(-1, 1, (2, PIECES * 8)), fine // 8, axis=1)
        assert (highest(np.sign(errors)) <= 1.0 + 1e-9).all()
    reached = []
    for axis, worst in ((0, 1), (1, 2)):
        c = np.eye(2)[axis]
        rows = np.array([c @ np.linalg.matrix_power(flow, k) @ pushed for k in range(command.shape[1])])
        reached += [highest(sign * np.sign(rows[::-1].T * command))[worst] for sign in (1.0, -1.0)]
    assert max(reached) == pytest.approx(1.0, abs=1e-6)


def test_more_than_can_be_made_up_for_is_proven_to_be_infeasible(tmp_path: Path) -> None:
    problem = {**PROBLEM, "execution": 0.9, "initial_state": [-2.0, 0.5], "terminal": [{"box": 0.05}]}
    out = tmp_path / "run"
    sr.run({"problem": problem, "dictionaries": {"control": pieces(PIECES)}, "observers": []}, out=out, figures=False)
    found = check(out)
    assert found.status == "verified" and "infeasibility" in {claim.name for claim in found.claims}


@pytest.mark.first(1)
@pytest.mark.parametrize(
    "change",
    [
        tampering.problem(execution=[0.10001, 0.05]),
        tampering.problem(execution=[0.0999, 0.05]),
        tampering.problem(execution=[0.1, 0.0501]),
        tampering.problem(execution=[0.0, 0.0]),
        tampering.scaled(0.9999),
        tampering.heaviest(multiplier=1.0),
    ],
    ids=["more", "less", "more of another", "none", "control", "multiplier"],
)
def test_what_is_changed_afterwards_is_found(change: tampering.Change, finished: Path, tmp_path: Path) -> None:
    assert check(tampering.forged(finished, tmp_path / "copy", change, consistent=True)).status == "refuted"


def test_a_control_that_is_refuted_shows_by_how_much(tmp_path: Path) -> None:
    config = {
        "problem": PROBLEM,
        "dictionaries": {"control": pieces(PIECES)},
        "observers": [],
        "method": {"name": "nominal"},
    }
    outcome = sr.run(config, out=tmp_path / "run", figures=False)
    assert outcome.result.status == "refuted"
    assert {one.name: one.verdict for one in check(tmp_path / "run").claims}["violation"] == "holds"


@pytest.mark.first(4)
@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"execution": 1.5}, "numbers from 0 to 1"),
        ({"execution": [-0.1, 0.1]}, "numbers from 0 to 1"),
        ({"execution": [0.1, 0.1, 0.1]}, "2"),
        ({"terminal": [{"equals": [0, 0]}]}, "fixed final values"),
        (
            {
                "system": {"A": [[0, 1], ["-4 - p", -0.3]], "B": B.tolist(), "parameters": {"p": [-0.1, 0.1]}},
                "disturbance": {"norm": {"p": 2, "radius": 0.01}},
                "disturbance_class": "measurable",
            },
            "measurable disturbances in a curved set",
        ),
        (
            {
                "system": {"A": [[0, 1], ["-4 - p", -0.3]], "B": B.tolist(), "parameters": {"p": [-0.1, 0.1]}},
                "terminal": [{"norm": {"p": 2, "radius": 0.3}}],
            },
            "curved sets of states with parameters",
        ),
        (
            {
                "system": {"A": [[0, 1], ["-4 - p*t", -0.3]], "B": B.tolist(), "parameters": {"p": [-0.1, 0.1]}},
                "terminal": [{"norm": {"p": 2, "radius": 0.3}}],
            },
            "curved sets of states with parameters",
        ),
    ],
)
def test_what_is_not_proven_beside_them_is_refused_by_name(changes: dict[str, Any], said: str, tmp_path: Path) -> None:
    config = {"problem": {**PROBLEM, **changes}, "dictionaries": {"control": pieces(4)}, "observers": []}
    with pytest.raises(sr.InputError, match=rf"problem\.execution.*{said}"):
        sr.run(config, out=tmp_path / "run", figures=False)


def test_feedback_does_not_know_them_and_refuses(tmp_path: Path) -> None:
    config = {"problem": PROBLEM, "dictionaries": {"control": pieces(4)}, "observers": [], "policy": {"name": "affine"}}
    with pytest.raises(sr.InputError, match="execution"):
        sr.run(config, out=tmp_path / "run", figures=False)


def test_the_tube_of_a_result_holds_every_error_and_no_more() -> None:
    plant = sr.LinearSystem([[0.0, 1.0], [0.0, 0.0]], [[0.0], [1.0]])
    problem = sr.OptimalControlProblem(
        system=plant,
        horizon=2.0,
        initial_state=[0.3, 0.0],
        control=sr.Box([-2.0], [2.0]),
        terminal=[sr.Box([-0.2, -0.2], [0.2, 0.2])],
        execution=[0.1],
    )
    result = sr.solve(problem, control={"name": "piecewise_constant", "pieces": 4})
    assert result.status == "certified"
    tube, ends = result.tube([1.0, 2.0]), 0.5 * np.arange(5)
    size = 0.1 * np.abs(result.control.values[0])
    assert size.any()
    left = np.clip(np.array([1.0, 2.0])[:, None] - ends, 0.0, None)  # what is left of the time at every breakpoint
    moved = np.stack([-np.diff(left**2 / 2, axis=1) @ size, -np.diff(left, axis=1) @ size])
    assert tube.upper - tube.nominal == pytest.approx(moved, abs=1e-12)
    assert tube.nominal - tube.lower == pytest.approx(moved, abs=1e-12)


@pytest.mark.slow
def test_the_largest_share_that_a_plan_survives_is_found() -> None:
    config = {"problem": STRAIGHT, "dictionaries": {"control": pieces(4)}, "observers": []}
    found = sr.margin(config, "execution", tolerance=1e-4)
    assert found.status == "certified"
    assert found.lower <= 2.0 <= found.upper <= found.lower + 2e-4
    assert found.amounts == pytest.approx((0.1, 0.1), rel=1e-4)


@pytest.mark.parametrize("none", [0.0, None])
def test_a_share_that_is_not_there_cannot_be_varied(none: float | None) -> None:
    config = {"problem": {**STRAIGHT, "execution": none}, "dictionaries": {"control": pieces(4)}, "observers": []}
    with pytest.raises(sr.InputError, match="the problem has no execution"):
        sr.margin(config, "execution")


@pytest.mark.parametrize(
    "law", ["vertices", *(pytest.param(n, marks=pytest.mark.slow) for n in ("iid", "slow", "neighbours"))]
)
def test_draws_deliver_something_else_than_the_command_and_never_more_than_the_share(law: str, tmp_path: Path) -> None:
    config = {"problem": STRAIGHT, "dictionaries": {"control": pieces(4)}, "observers": []}
    sr.run(config, out=tmp_path / "run", figures=False)
    effort = 0.5 * np.abs(np.load(tmp_path / "run" / "solution.npz")["control"]).sum()
    found = sr.simulate(tmp_path / "run", 200, law)
    ends = np.array([found.lower[0, -1], found.upper[0, -1]])
    assert ends[0] < effort - 1.0 < ends[1] or law == "neighbours"
    assert np.ptp(ends) > 0.0 and (np.abs(ends - (effort - 1.0)) <= 0.05 * effort + 1e-12).all()
    assert not found.constraints[0].violated


@pytest.mark.slow
def test_the_worst_errors_are_replayed_and_a_plan_that_does_not_know_them_fails(tmp_path: Path) -> None:
    config = {"problem": STRAIGHT, "dictionaries": {"control": pieces(4)}, "observers": []}
    sr.run(config, out=tmp_path / "run", figures=False)
    (row,) = sr.simulate(tmp_path / "run", law="adversary").constraints
    assert row.largest == pytest.approx(row.worst, abs=1e-12)
    plain = {**config, "method": {"name": "nominal"}}
    sr.run(plain, out=tmp_path / "plain", figures=False)
    assert sr.simulate(tmp_path / "plain", 100, "vertices").constraints[0].violated > 20


def test_the_push_counts_what_errors_do_in_the_rows_as_a_price(tmp_path: Path) -> None:
    config = {"problem": STRAIGHT, "dictionaries": {"control": pieces(4)}, "observers": []}
    outcome = sr.run(config, out=tmp_path / "run", figures=False)
    view = sr.Inspection.read(tmp_path / "run")
    push = sr.Switching(view.program, view.row).evaluate(outcome.result.dual.cuts, outcome.result.dual.mu)
    # of a command 0.95 arrive for sure, at the multiplier 1 / 0.95: what pushes is 1 / 0.95, the price 1 + 0.05 / 0.95
    assert push is not None and push == pytest.approx(np.ones((1, 4)), abs=1e-6)
