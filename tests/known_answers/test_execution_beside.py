"""Guards known answers: errors of execution beside pieces of the system, delays, and measurable disturbances,
against an independent linear program, in two systems of units; the worst errors themselves."""

from __future__ import annotations

import copy
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.linalg import expm
from scipy.optimize import Bounds, LinearConstraint, linprog, milp

import sparserob_core as sr
from sparserob_core.experiment.check.check import check
from tests.known_answers.test_checks import pieces, verified

PIECES, HORIZON, FINE = 8, 3.0, 60  # steps of a piece: delays and turns fall on them
A = np.array([[0.0, 1.0], [-4.0, -0.3]])
B = np.array([[0.0, 0.4], [1.0, 0.0]])
PROBLEM: dict[str, Any] = {
    "name": "linear",
    "system": {"A": A.tolist(), "B": B.tolist()},
    "horizon": HORIZON,
    "initial_state": [-1.0, 0.5],
    "control": {"box": [1.0, 1.0]},
    "weights": [1.0, 0.2],
    "execution": [0.1, 0.05],
    "path": [{"box": [0.6, None], "from": 1.5}],
    "terminal": [{"box": [0.25, 0.35]}],
}
TURNS = {
    "pieces": [
        {"until": 1.5, "A": A.tolist(), "B": B.tolist()},
        {"until": 3.0, "A": [[0.0, 1.0], [-1.0, -0.4]], "B": [[0.3, 0.1], [0.0, 0.8]]},
    ]
}
LATE = {"delay": 0.25, **PROBLEM["system"]}
CASES: dict[str, dict[str, Any]] = {
    "pieces": {"system": TURNS},
    "delay": {"system": LATE},
    "delay from another control": {"system": LATE, "initial_control": [0.4, -0.6]},
    "pieces and delay": {"system": {**TURNS, "delay": 0.25}, "initial_control": [0.4, 0.6]},
    "measurable": {"disturbance": {"box": [0.02, 0.03]}, "disturbance_class": "measurable"},
    "measurable and pieces": {
        "system": TURNS,
        "disturbance": {"box": [0.02, 0.03]},
        "disturbance_class": "measurable",
    },
    "measurable in a triangle and pieces": {
        "system": TURNS,
        "disturbance": {"polytope": {"H": [[1.0, 0.0], [0.0, 1.0], [-1.0, -1.0]], "h": [0.03, 0.02, 0.04]}},
        "disturbance_class": "measurable",
    },
    "measurable in a triangle and delay": {
        "system": LATE,
        "initial_control": [0.4, -0.6],
        "disturbance": {"polytope": {"H": [[1.0, 0.0], [0.0, 1.0], [-1.0, -1.0]], "h": [0.03, 0.02, 0.04]}},
        "disturbance_class": "measurable",
    },
}
TRIANGLE = np.array([[0.03, 0.02], [0.03, -0.07], [-0.06, 0.02]])  # its corners
STATES, CONTROLS, TIME = np.array([7.0, 0.003]), np.array([40.0, 0.9]), 1100.0  # one of the other units


def in_other_units(given: dict[str, Any]) -> dict[str, Any]:
    """The same problem with states, controls and times in other units, of which the cost is that in the other time."""
    problem = copy.deepcopy(given)
    for one in problem["system"].get("pieces", [problem["system"]]):
        one["A"] = (np.array(one["A"]) * STATES / STATES[:, None] * TIME).tolist()
        one["E"] = np.diag(TIME / STATES).tolist()
        one["B"] = (np.array(one["B"]) * CONTROLS / STATES[:, None] * TIME).tolist()
        if "until" in one:
            one["until"] /= TIME
    if "delay" in problem["system"]:
        problem["system"]["delay"] /= TIME
    problem["horizon"] /= TIME
    problem["initial_state"] = (np.array(problem["initial_state"]) / STATES).tolist()
    problem["weights"] = (np.array(problem["weights"]) * CONTROLS).tolist()
    problem["control"]["box"] = (np.array(problem["control"]["box"]) / CONTROLS).tolist()
    if "initial_control" in problem:
        problem["initial_control"] = (np.array(problem["initial_control"]) / CONTROLS).tolist()
    for entry in (*problem["path"], *problem["terminal"]):
        entry["box"] = [None if v is None else v / u for v, u in zip(entry["box"], STATES, strict=True)]
    for entry in problem["path"]:
        entry["from"] /= TIME
    return problem


class Walk:
    """A problem on fine steps: transitions, and what commands and disturbances of each step push by."""

    def __init__(self, problem: dict[str, Any]) -> None:
        system, steps = problem["system"], PIECES * FINE
        self.step, d = HORIZON / steps, 2
        modes = system.get("pieces", [{"until": HORIZON, **system}])
        middles = (np.arange(steps) + 0.5) * self.step
        which = [next(i for i, one in enumerate(modes) if middle < one["until"]) for middle in middles]
        known = []
        for one in modes:
            flow, M = np.array(one["A"]), np.zeros((d + 4, d + 4))
            M[:d, :d], M[:d, d : d + 2], M[:d, d + 2 :] = flow, np.array(one["B"]), np.eye(d)
            known.append(expm(M * self.step)[:d])
        self.flows = np.array([known[i][:, :d] for i in which])
        self.pushed = np.array([known[i][:, d : d + 2] for i in which])
        self.moved = np.array([known[i][:, d + 2 :] for i in which])
        late = round(system.get("delay", 0.0) / self.step)
        self.piece = (np.arange(steps) - late) // FINE  # negative ones: what was commanded before
        self.before = np.array(problem.get("initial_control", [0.0, 0.0]))
        self.start = np.array(problem["initial_state"])
        sizes = np.array(problem.get("disturbance", {"box": [0.0, 0.0]}).get("box", [0.0, 0.0]))
        self.shares, self.corners = (
            np.array(problem["execution"]),
            np.array([[1, 1], [1, -1], [-1, 1], [-1, -1]]) * sizes,
        )
        if "polytope" in problem.get("disturbance", {}):
            self.corners = TRIANGLE

    def row(self, c: np.ndarray, n: int) -> tuple[np.ndarray, np.ndarray, float]:
        """Of ``c'x`` after ``n`` steps: what commands give, what sizes of commands add, and the rest."""
        lines = [c]
        for flow in self.flows[:n][::-1]:
            lines.append(lines[-1] @ flow)
        rows = np.array(lines[:n][::-1]).reshape(n, 2)
        on, off = np.zeros((2, PIECES)), np.zeros((2, PIECES))
        each = np.einsum("nd,ndm->nm", rows, self.pushed[:n])
        early = self.piece[:n] < 0
        for k in range(PIECES):
            on[:, k] = each[self.piece[:n] == k].sum(axis=0)
            off[:, k] = self.shares * np.abs(each[self.piece[:n] == k]).sum(axis=0)
        rest = float(lines[n] @ self.start + each[early].sum(axis=0) @ self.before)
        rest += float(self.shares * np.abs(self.before) @ np.abs(each[early]).sum(axis=0))
        pushed = np.einsum("nd,ndm->nm", rows, self.moved[:n]) @ self.corners.T
        return on, off, rest + float(pushed.max(axis=1, initial=-np.inf).sum())


def rows_of(problem: dict[str, Any]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """``G [a, b] <= h`` of ``u = a - b`` at every fine step, and prices of both."""
    walk, G, h = Walk(problem), [], []
    last = PIECES * FINE
    begin = round(problem["path"][0]["from"] / walk.step)
    windows = [(0, problem["path"][0]["box"][0], range(begin, last + 1))]
    windows += [(i, problem["terminal"][0]["box"][i], range(last, last + 1)) for i in range(2)]
    for axis, bound, times in windows:
        for n in times:
            for sign in (1.0, -1.0):
                on, off, rest = walk.row(sign * np.eye(2)[axis], n)
                G.append(np.concatenate([(on + off).ravel(), (off - on).ravel()]))
                h.append(bound - rest)
    prices = np.tile(np.repeat(problem["weights"], PIECES), 2) * HORIZON / PIECES
    return np.array(G), np.array(h), prices


def least_cost(problem: dict[str, Any]) -> float:
    """The cost by a linear program."""
    G, h, prices = rows_of(problem)
    found = linprog(prices, A_ub=G, b_ub=h, bounds=(0, 1), method="highs")
    assert found.success
    return float(found.fun)


def least_count(problem: dict[str, Any], letters: bool) -> float:
    """The weighted time of action by a mixed-integer program; with ``letters`` ``u`` is -1, -0.5, 0, 0.5 or 1."""
    G, h, prices = rows_of(problem)
    n = prices.size  # a, b, twice a whole number with letters, at most 1; and whether a + b is not 0
    either = np.hstack([np.eye(n // 2), np.eye(n // 2), -np.eye(n // 2)])
    rows = np.vstack([np.hstack([G, np.zeros((len(h), n // 2))]), either])
    halves = 0.5 if letters else 1.0
    rows[:, :n] *= halves
    found = milp(
        np.concatenate([np.zeros(n), prices[: n // 2]]),
        constraints=LinearConstraint(rows, -np.inf, np.concatenate([h, np.zeros(n // 2)])),
        integrality=np.repeat([float(letters), 1.0], [n, n // 2]),
        bounds=Bounds(0, np.repeat([1.0 / halves, 1.0], [n, n // 2])),
        options={"mip_rel_gap": 0.0},
    )
    assert found.success
    return float(found.fun)


@pytest.mark.slow
@pytest.mark.parametrize("name", CASES)
def test_the_cost_is_that_of_an_independent_linear_program_in_any_units(name: str, tmp_path: Path) -> None:
    problem = {**PROBLEM, **CASES[name]}
    expected = least_cost(problem)
    assert verified(tmp_path / "run", problem, pieces(PIECES))["cost"] == pytest.approx(expected, rel=1e-4)
    other = verified(tmp_path / "other", in_other_units(problem), pieces(PIECES))["cost"]
    mine = json.loads((tmp_path / "run" / "result.json").read_text())["cost"]
    assert other * TIME == pytest.approx(mine, rel=1e-7)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["pieces", "delay from another control", "measurable and pieces"])
def test_a_plan_that_does_not_know_them_is_refuted_by_what_is_derived_again(name: str, tmp_path: Path) -> None:
    problem = {**PROBLEM, **CASES[name]}
    config = {"problem": problem, "dictionaries": {"control": pieces(PIECES)}, "observers": []}
    sr.run({**config, "method": {"name": "nominal"}}, out=tmp_path / "nominal", figures=False)
    assert {one.name: one.verdict for one in check(tmp_path / "nominal").claims}["violation"] == "holds"
    sr.run(config, out=tmp_path / "run", figures=False)
    for row in sr.simulate(tmp_path / "run", law="adversary").constraints:
        assert row.worst - 1e-4 < row.largest < 1e-9  # errors change their signs where steps of the replay do


@pytest.mark.slow
def test_what_is_commanded_before_a_delay_is_missed_too(tmp_path: Path) -> None:
    # x' = u(t - 0.5) from -1: of 0.4 before and of U by the pieces 0.95 arrive for sure, 0.9 at least must
    problem = {
        "name": "linear",
        "system": {"A": [[0]], "B": [[1]], "delay": 0.5},
        "horizon": 2.0,
        "initial_state": [-1],
        "initial_control": [0.4],
        "control": {"box": 1.0},
        "terminal": [{"box": 0.1}],
        "execution": 0.05,
    }
    assert verified(tmp_path / "run", problem, pieces(4))["cost"] == pytest.approx(0.9 / 0.95 - 0.2, rel=1e-9)


@pytest.mark.slow
def test_errors_of_a_piece_count_through_the_system_that_acts_then(tmp_path: Path) -> None:
    # x' = u, then x' = 2 u: a push of 0.5 U through the second one is the cheapest
    turns = [{"until": 1.0, "A": [[0]], "B": [[1]]}, {"until": 2.0, "A": [[0]], "B": [[2]]}]
    problem = {
        "name": "linear",
        "system": {"pieces": turns},
        "horizon": 2.0,
        "initial_state": [-1],
        "control": {"box": 1.0},
        "terminal": [{"box": 0.1}],
        "execution": 0.05,
    }
    assert verified(tmp_path / "run", problem, pieces(4))["cost"] == pytest.approx(0.45 / 0.95, rel=1e-9)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("integral", "cost"),
    [
        # the first piece of 0.5 gives 0.875 of its height to the integral of x, of which 0.95 for sure
        ({"H": [[1]], "lower": [-1.2]}, 0.5 * 0.8 / (0.95 * 0.875)),
        # and what is commanded is counted as it is
        ({"H": [[1]], "G": [[0.5]], "lower": [-1.2]}, 0.5 * 0.8 / (0.95 * 0.875 + 0.25)),
        ({"H": [[1]], "G": [[0.5]], "lower": [-1.2], "from": 0.5}, 0.5 * 0.3 / (0.95 * 0.625 + 0.25)),
        ({"G": [[-1]], "lower": [-0.3], "from": 0.5}, 0.0),
    ],
)
def test_an_integral_counts_what_is_commanded_and_what_errors_make_of_the_state(
    integral: dict[str, Any], cost: float, tmp_path: Path
) -> None:
    # x' = u from -1, for 2
    problem = {
        "name": "linear",
        "system": {"A": [[0]], "B": [[1]]},
        "horizon": 2.0,
        "initial_state": [-1],
        "control": {"box": 1.0},
        "integral": [integral],
        "execution": 0.05,
    }
    assert verified(tmp_path / "run", problem, pieces(4))["cost"] == pytest.approx(cost, rel=1e-7, abs=1e-9)


@pytest.mark.slow
@pytest.mark.parametrize("delay", [0.0, 0.5])
def test_a_budget_is_one_of_commands(delay: float, tmp_path: Path) -> None:
    # x' = u from -1 to at most 0.1 from 0: 0.9 / 0.95 is commanded, and no less suffices
    problem = {
        "name": "linear",
        "system": {"A": [[0]], "B": [[1]], "delay": delay},
        "horizon": 2.0,
        "initial_state": [-1],
        "control": {"box": 1.0},
        "terminal": [{"box": 0.1}],
        "integral": [{"G": [[1]], "to": 2.0 - delay, "upper": [0.9 / 0.95 + 1e-7]}],
        "execution": 0.05,
    }
    assert verified(tmp_path / "run", problem, pieces(4))["cost"] == pytest.approx(0.9 / 0.95, rel=1e-6)
    problem["integral"][0]["upper"] = [0.9 / 0.95 - 1e-4]
    config = {"problem": problem, "dictionaries": {"control": pieces(4)}, "observers": []}
    assert sr.run(config, out=tmp_path / "none", figures=False).result.status == "infeasible"
    assert check(tmp_path / "none").status == "verified"


@pytest.mark.slow
@pytest.mark.parametrize("letters", [False, True])
@pytest.mark.parametrize("name", ["one system", "pieces and delay"])
def test_the_sparsest_control_is_that_of_a_mixed_integer_program(name: str, letters: bool, tmp_path: Path) -> None:
    problem = {**PROBLEM, **CASES.get(name, {})}
    method = {"name": "sparsest", "nodes": 600, **({"alphabet": [-1.0, -0.5, 0.0, 0.5, 1.0]} if letters else {})}
    config = {"problem": problem, "dictionaries": {"control": pieces(PIECES)}, "observers": [], "method": method}
    result = sr.run(config, out=tmp_path / "run", figures=False).result
    assert result.status == "certified" and result.cost == pytest.approx(least_count(problem, letters), rel=1e-6)
    assert check(tmp_path / "run").status == "verified"


@pytest.mark.slow
@pytest.mark.parametrize("units", [(1.0, 1.0, 1.0), (7.0, 0.03, 1100.0)])
@pytest.mark.parametrize("turns", [1, 2])
def test_the_gain_of_an_engine_is_unknown_and_it_is_missed_too(
    units: tuple[float, float, float], turns: int, tmp_path: Path
) -> None:
    # x' = (1 + p) u from -1 to at most 0.25 from 0, |p| <= 0.1: of U 0.9 * 0.95 arrive for sure, 0.75 must
    state, control, time = units
    one = {"A": [[0]], "B": [[f"(1 + p) * {control * time / state!r}"]]}
    every = [{"until": 2.0 * (k + 1) / turns / time, **one} for k in range(turns)]
    problem = {
        "name": "linear",
        "system": {**(one if turns == 1 else {"pieces": every}), "parameters": {"p": [-0.1, 0.1]}},
        "horizon": 2.0 / time,
        "initial_state": [-1 / state],
        "control": {"box": 1.0 / control},
        "terminal": [{"box": 0.25 / state}],
        "execution": 0.05,
    }
    cost = verified(tmp_path / "run", problem, pieces(4))["cost"] * control * time
    assert cost == pytest.approx(0.75 / (0.9 * 0.95), rel=1e-8)
    found = sr.simulate(tmp_path / "run", 100, "vertices")
    assert not found.constraints[0].violated and found.constraints[0].largest > -0.15 / state


def test_parameters_in_another_set_than_a_box_are_refused() -> None:
    round_one = {"names": ["p"], "ellipsoid": {"centre": [0], "shape": [[0.1]]}}
    system = {"A": [[0]], "B": [["1 + p"]], "parameters": round_one}
    problem = {"name": "linear", "system": system, "horizon": 2.0, "initial_state": [-1], "control": {"box": 1.0}}
    config = {"problem": {**problem, "execution": 0.05}, "dictionaries": {"control": pieces(2)}, "observers": []}
    with pytest.raises(sr.InputError, match=r"execution.*another set than a box"):
        sr.run(config, figures=False)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["pieces", "delay from another control"])
def test_scenarios_have_the_worst_errors_in_them(name: str, tmp_path: Path) -> None:
    problem = {**PROBLEM, **CASES[name]}
    config = {"problem": problem, "dictionaries": {"control": pieces(PIECES)}, "observers": []}
    found = sr.run({**config, "method": {"name": "scenario", "scenarios": 3}}, out=tmp_path / "run", figures=False)
    assert found.result.status == "certified"  # nothing is left to be drawn
    assert found.result.cost == pytest.approx(least_cost(problem), rel=1e-4)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["one system", "delay from another control"])
def test_initial_states_from_which_errors_are_borne_are_those_of_a_linear_program(name: str) -> None:
    problem = {**PROBLEM, **CASES.get(name, {})}
    config = {"problem": problem, "dictionaries": {"control": pieces(PIECES)}, "observers": []}
    found = sr.initial_states(config, directions=8, values=0)
    assert found.status == "verified"
    G, h, _ = rows_of({**problem, "initial_state": [0.0, 0.0]})
    moved = np.stack([h - rows_of({**problem, "initial_state": e})[1] for e in np.eye(2).tolist()], axis=1)
    for direction, bound, reached in zip(found.directions, found.bounds, found.reached, strict=True):
        best = linprog(
            np.concatenate([np.zeros(G.shape[1]), -direction]),
            A_ub=np.hstack([G, moved]),
            b_ub=h,
            bounds=[(0, 1)] * G.shape[1] + [(None, None)] * 2,
            method="highs",
        )
        assert reached <= -best.fun <= bound + 3e-5  # between fine steps a wall is exceeded by a little
        assert bound - reached < 1e-6
    for point, control in zip(found.inner, found.controls, strict=True):
        both = np.concatenate([np.maximum(control, 0.0).ravel(), np.maximum(-control, 0.0).ravel()])
        assert (G @ both + moved @ point <= h + 1e-7).all()
