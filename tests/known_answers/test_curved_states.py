"""Guards known answers: curved sets of states beside measurable disturbances and errors of execution, between polygons
inside and around them, against an independent linear program; forgeries; what is refused."""

from __future__ import annotations

import copy
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.linalg import expm
from scipy.optimize import linprog

import sparserob_core as sr
from sparserob_core.experiment.check.check import check
from sparserob_core.experiment.config.reading.reader import read_source
from tests.known_answers.test_checks import pieces, verified
from tests.support import tampering
from tests.support.places import CONFIGS

Problem = dict[str, Any]
HORIZON, PIECES, BEGIN, SIDES = 3.0, 6, 1.0, 60
A, B, E = np.array([[0.0, 1.0], [-1.0, -0.4]]), np.array([[0.2, 0.0], [0.0, 1.0]]), np.array([[1.0, 0.3], [0.0, 1.0]])
CONSTANT: Problem = {"A": A.tolist(), "B": B.tolist(), "E": E.tolist()}
IN_TIME: Problem = {
    "A": [[0, 1], ["-1 - 0.3*sin(2*t)", "-0.4 - 0.1*cos(t)"]],
    "B": CONSTANT["B"],
    "E": [["1 + 0.2*t", 0.3], [0, 1]],
}
TURNS: Problem = {
    "pieces": [{"until": 1.3, **CONSTANT}, {"until": HORIZON, **CONSTANT, "B": [[0.3, 0], [0, 0.8]]}],
}
SHAPE = np.array([[0.5, 0.1], [0.1, 0.4]])
ROUND: Problem = {"ellipsoid": {"shape": SHAPE.tolist()}}
BOX: Problem = {"disturbance": {"box": [0.06, 0.05]}, "disturbance_class": "measurable"}
ELLIPSE: Problem = {
    "disturbance": {"ellipsoid": {"shape": [[0.004, 0.001], [0.001, 0.003]]}}, "disturbance_class": "measurable"
}  # fmt: skip
TRIANGLE: Problem = {
    "disturbance": {"polytope": {"H": [[1, 0], [0, 1], [-1, -1]], "h": [0.06, 0.06, 0.06]}},
    "disturbance_class": "measurable",
}
ERRING: Problem = {"execution": [0.05, 0.08]}
CLASSES: Problem = {
    "disturbance": [
        {"set": {"box": 0.05}, "E": [[1], [0]], "class": "measurable"},
        {"set": {"box": 0.05}, "E": [[0.3], [1]]},
    ]
}


def polygon(inside: bool) -> Problem:
    """The ellipse's tangents at equal angles, or their parallels through where neighbours of the points would meet."""
    angles = 2 * np.pi * np.arange(SIDES) / SIDES
    H = np.linalg.solve(np.linalg.cholesky(SHAPE).T, np.stack([np.cos(angles), np.sin(angles)])).T
    return {"polytope": {"H": H.tolist(), "h": [np.cos(np.pi / SIDES) if inside else 1.0] * SIDES}}


def problem(beside: Problem, plant: Problem = CONSTANT, bound: Problem = ROUND) -> Problem:
    return {
        "name": "linear",
        "system": plant,
        "horizon": HORIZON,
        "initial_state": [-1.0, 0.6],
        "control": {"box": 1.5},
        "path": [{**bound, "from": BEGIN}],
        "terminal": [{"box": [0.3, 0.3]}],
        **beside,
    }


@pytest.mark.first(0)
@pytest.mark.parametrize(
    ("beside", "plant"),
    [
        (BOX, CONSTANT),
        (ERRING, CONSTANT),
        (ELLIPSE, CONSTANT),
        (TRIANGLE, CONSTANT),
        (CLASSES, CONSTANT),
        ({**BOX, **ERRING}, CONSTANT),
        (BOX, TURNS),
        ({**BOX, **ERRING}, TURNS),
        (BOX, IN_TIME),
        (ERRING, IN_TIME),
        (ELLIPSE, IN_TIME),
        (TRIANGLE, IN_TIME),
        ({**BOX, **ERRING}, IN_TIME),
    ],
    ids=[
        "box", "erring", "ellipse", "triangle", "classes", "both", "box over turns", "both over turns", "box in t",
        "erring in t", "ellipse in t", "triangle in t", "both in t",
    ],
)  # fmt: skip
def test_the_cost_lies_between_those_of_polygons_inside_and_around(
    beside: Problem, plant: Problem, tmp_path: Path
) -> None:
    curved = verified(tmp_path / "run", problem(beside, plant), pieces(PIECES))
    around, inside = (
        sr.run(
            {"problem": problem(beside, plant, polygon(side)), "dictionaries": {"control": pieces(PIECES)}},
            quiet=True,
            figures=False,
        ).result
        for side in (False, True)
    )
    assert around.status == inside.status == "certified"
    assert around.lower_bound <= curved["cost"] and curved["lower_bound"] <= inside.cost
    assert inside.cost - around.cost <= 1e-3 * curved["cost"]


def independent() -> float:
    """The cost with a box and errors by a linear program in ``u = a - b``, its rows by sums over fine steps, at many
    times and tangents."""
    fine, tangents = 60, 240
    step, n, (half, share) = HORIZON / PIECES / fine, PIECES * fine, (np.array([0.06, 0.05]), ERRING["execution"])
    flow = expm(A * step)
    powers = np.array([np.linalg.matrix_power(flow, k) @ expm(A * step / 2) for k in range(n)])
    angles = 2 * np.pi * np.arange(tangents) / tangents
    round_ = np.stack([np.cos(angles), np.sin(angles)], axis=1)
    windows = [(round_, np.sqrt(np.einsum("ki,ij,kj->k", round_, SHAPE, round_)), range(n // 3, n + 1, 2))]
    windows += [(np.vstack([np.eye(2), -np.eye(2)]), np.full(4, 0.3), [n])]
    G, h = [], []
    for H, heights, times in windows:
        for k in times:
            along = np.zeros((n, len(H), 2))
            along[:k] = H @ powers[:k][::-1]  # c'e^{A (t - s)} in the middle of every step
            pushed = (along @ B * step).reshape(PIECES, fine, len(H), 2)
            gain, lost = pushed.sum(axis=1), np.abs(pushed).sum(axis=1) * share
            rows = np.moveaxis(np.stack([gain + lost, lost - gain], axis=3), 0, 2)  # (r, m, K, 2)
            G.append(rows.reshape(len(H), -1))
            begun = H @ expm(A * step * k) @ [-1.0, 0.6]
            h.append(heights - begun - (np.abs(along @ E) @ half).sum(axis=0) * step)
    cost = np.full(G[0].shape[1], HORIZON / PIECES)
    found = linprog(cost, A_ub=np.vstack(G), b_ub=np.concatenate(h), bounds=(0.0, 1.5))
    assert found.status == 0
    return float(found.fun)


@pytest.fixture(scope="module", params=["constant", pytest.param("in t", marks=pytest.mark.slow)])
def finished(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A finished run with a box and errors, of the plant as it is and as one that changes with time."""
    directory = tmp_path_factory.mktemp("curved") / "run"
    plant = CONSTANT if request.param == "constant" else IN_TIME
    verified(directory, problem({**BOX, **ERRING}, plant), pieces(PIECES))
    return directory


@pytest.mark.slow
def test_the_cost_is_that_of_an_independent_linear_program(tmp_path: Path) -> None:
    dressed = {**CONSTANT, "A": [[f"{entry} + 0*t" for entry in row] for row in A]}
    every = [
        verified(tmp_path / str(k), problem({**BOX, **ERRING}, plant), pieces(PIECES))["cost"]
        for k, plant in enumerate((CONSTANT, dressed))
    ]
    assert every[0] == pytest.approx(independent(), rel=1e-4)
    assert every[1] == pytest.approx(every[0], rel=1e-7)


@pytest.mark.slow
@pytest.mark.parametrize(
    "change",
    [
        tampering.problem(disturbance={"box": [0.06001, 0.05]}),
        tampering.problem(disturbance={"box": [0.06, 0.0499]}),
        tampering.problem(execution=[0.05, 0.0801]),
        tampering.problem(execution=[0.05, 0.0799]),
        tampering.problem(path=[{"ellipsoid": {"shape": (0.9999 * SHAPE).tolist()}, "from": BEGIN}]),
        tampering.problem(path=[{"ellipsoid": {"shape": (1.0001 * SHAPE).tolist()}, "from": BEGIN}]),
        tampering.scaled(0.9999),
        tampering.times("cost", 0.999999),
        tampering.times("lower_bound", 1.00001),
        tampering.heaviest(multiplier=1.0),
    ],
    ids=["wider", "narrower", "more", "less", "smaller", "larger", "control", "cost", "bound", "multiplier"],
)
def test_what_is_changed_afterwards_is_found(change: tampering.Change, finished: Path, tmp_path: Path) -> None:
    assert check(tampering.forged(finished, tmp_path / "copy", change, consistent=True)).status == "refuted"


CUBED: Problem = {"norm": {"p": 3, "radius": 0.3, "centre": [0.0, 0.0]}}
ASTRAY: Problem = {"relative_to": [[0, -0.2, 0], [HORIZON, 0.1, 0.05]]}


def tangents(bound: str, count: int = 96) -> Problem:
    """Those of a ball of the 3-norm, or of the ellipse, at equal angles."""
    angles = 2 * np.pi * np.arange(count) / count
    H = np.stack([np.cos(angles), np.sin(angles)], axis=1)
    heights = np.sqrt(np.einsum("ki,ij,kj->k", H, SHAPE, H))
    if bound == "cubed":
        heights = 0.3 * (np.abs(H) ** 1.5).sum(axis=1) ** (2.0 / 3.0)
    return {"polytope": {"H": H.tolist(), "h": heights.tolist()}}


@pytest.mark.slow
@pytest.mark.parametrize("plant", [CONSTANT, IN_TIME], ids=["constant", "in t"])
def test_a_ball_at_the_end_and_an_ellipse_that_moves_cost_what_their_tangents_do(
    plant: Problem, tmp_path: Path
) -> None:
    def made(path: Problem, end: Problem) -> Problem:
        return {**problem({**BOX, **ERRING}, plant, {**path, **ASTRAY}), "terminal": [end]}

    curved = verified(tmp_path / "run", made(ROUND, CUBED), pieces(PIECES))
    flat = {"problem": made(tangents("ellipse"), tangents("cubed")), "dictionaries": {"control": pieces(PIECES)}}
    around = sr.run(flat, quiet=True, figures=False).result
    assert around.status == "certified"
    assert around.lower_bound <= curved["cost"] <= around.cost * (1.0 + 1e-3)


@pytest.mark.slow
@pytest.mark.parametrize(("time", "length"), [(1e3, 1e-3), (1e-3, 1e3), (1e4, 1e2)])
def test_in_other_units_it_costs_the_same(time: float, length: float, tmp_path: Path) -> None:
    plain = problem({**BOX, **ERRING})
    scaled = {
        **plain,
        "system": {"A": (A / time).tolist(), "B": (B * length / time).tolist(), "E": (E * length / time).tolist()},
        "horizon": HORIZON * time,
        "initial_state": [-1.0 * length, 0.6 * length],
        "path": [{"ellipsoid": {"shape": (SHAPE * length**2).tolist()}, "from": BEGIN * time}],
        "terminal": [{"box": [0.3 * length, 0.3 * length]}],
    }
    costs = [verified(tmp_path / str(k), one, pieces(PIECES))["cost"] for k, one in enumerate((plain, scaled))]
    assert costs[1] / time == pytest.approx(costs[0], rel=1e-7)


@pytest.mark.slow
def test_a_mission_ends_in_an_ellipsoid_of_places_and_speeds_with_an_engine_that_errs(tmp_path: Path) -> None:
    mission = copy.deepcopy(read_source(CONFIGS / "atv_execution.yaml").data["problem"])
    shape = np.diag(np.square([300.0, 60.0, 0.1, 0.1]))
    ends = [{"ellipsoid": {"centre": [-400.0, 0.0, 0.0, 0.0], "shape": shape.tolist()}}]
    costs = []
    for k, end in enumerate((mission["terminal"], ends)):
        costs.append(verified(tmp_path / str(k), {**mission, "terminal": end}, pieces(30))["cost"])
    assert costs[0] < costs[1] < 1.01 * costs[0]  # the ellipsoid is inside the box
