"""Guards policy affine for a control that acts later and for systems that take turns: an independent linear program
over every corner of the disturbance, a closed loop integrated by matrix exponentials, and `check`."""

from __future__ import annotations

from itertools import pairwise, product
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.linalg import expm
from scipy.optimize import linprog

import sparserob_core as sr
from sparserob_core.control.feedback.loop_bounds import LoopBounds
from sparserob_core.experiment.check.check import check

HALF, K = 0.5, 4  # the grid of the independent program, in which delays and switches fall, and pieces of length 1
FIRST = {"A": [[0]], "B": [[1]]}
CASES: dict[str, tuple[dict[str, Any], dict[str, Any]]] = {
    "late by half a piece": ({**FIRST, "delay": 0.5}, {}),
    "late by a piece and a half, another control before": ({**FIRST, "delay": 1.5}, {"initial_control": [-0.4]}),
    "two systems": ({"pieces": [{"until": 2.5, **FIRST}, {"until": 4, "A": [[0]], "B": [[2]], "E": [[0.5]]}]}, {}),
    "two systems, late": (
        {"pieces": [{"until": 1.5, **FIRST}, {"until": 4, "A": [[0]], "B": [[-1]], "c": [-0.1]}], "delay": 0.5},
        {},
    ),
}


def config(system: dict[str, Any], more: dict[str, Any], cost: str = "nominal") -> dict[str, Any]:
    problem = {
        "name": "linear",
        "system": system,
        "horizon": 4.0,
        "initial_state": [1.0],
        "control": {"box": 1.0},
        "disturbance": {"box": [0.25]},
        "path": [{"box": [1.4], "from": 0}],
        "terminal": [{"box": [0.5]}],
        **more,
    }
    return {
        "problem": problem,
        "dictionaries": {"control": {"name": "piecewise_constant", "pieces": K}},
        "policy": {"name": "affine", "cost": cost},
        "observers": [],
    }


def modes(system: dict[str, Any]) -> list[tuple[float, float, float, float]]:
    """Until when ``x' = b u + e w + c``, with ``A = 0``."""
    pieces = system.get("pieces", [{**system, "until": 4.0}])
    return [
        (one["until"], one["B"][0][0], one.get("E", [[1]])[0][0], one.get("c", [0])[0]) for one in map(dict, pieces)
    ]


def least(system: dict[str, Any], more: dict[str, Any]) -> float:
    """The least nominal cost over ``v`` and ``M``, at the corners of the disturbance and every half unit of time,
    between which the state is linear in time."""
    delay, before = system.get("delay", 0.0), more.get("initial_control", [0.0])[0]
    pairs = [(k, j) for k in range(K) for j in range(1, k + 1)]
    size = K + len(pairs)
    rows, limits = [], []

    def limited(row: np.ndarray, constant: float, most: float) -> None:
        """``|row x + constant| <= most``."""
        for sign in (1.0, -1.0):
            rows.append(np.concatenate([sign * row, np.zeros(K)]))
            limits.append(most - sign * constant)

    for w in product((-0.25, 0.25), repeat=K):
        controls = np.zeros((K, size))
        seen, x = np.zeros(K + 1), (np.zeros(size), 1.0)
        states: list[tuple[np.ndarray, float]] = []
        for step in range(int(4.0 / HALF)):
            time = step * HALF
            _, b, e, c = next(mode for mode in modes(system) if time < mode[0])
            k = int(time)
            if time == k:
                controls[k, k] = 1.0
                for at, (piece, j) in enumerate(pairs):
                    controls[k, K + at] = seen[j] if piece == k else 0.0
            acting = time - delay
            u = (controls[int(acting)], 0.0) if acting >= 0.0 else (np.zeros(size), before)
            x = (x[0] + HALF * b * u[0], x[1] + HALF * (b * u[1] + e * w[k] + c))
            seen[k + 1] += HALF * e * w[k]
            states.append(x)
        for index, (row, constant) in enumerate(states):
            limited(row, constant, 0.5 if index == len(states) - 1 else 1.4)
        for u in controls:
            limited(u, 0.0, 1.0)
    # |v| <= s, row by row
    absolute = [np.eye(K, size + K) * sign - np.eye(K, size + K, size) for sign in (1.0, -1.0)]
    rows, limits = [*rows, *absolute[0], *absolute[1]], [*limits, *np.zeros(2 * K)]
    found = linprog(np.concatenate([np.zeros(size), np.ones(K)]), np.array(rows), limits, bounds=(None, None))
    assert found.status == 0
    return float(found.fun)


@pytest.mark.first(2)
@pytest.mark.parametrize("name", CASES)
def test_the_cost_is_that_of_a_program_over_every_corner_and_check_derives_it(name: str, tmp_path: Path) -> None:
    system, more = CASES[name]
    result = sr.run(config(system, more), out=tmp_path / "run", quiet=True, figures=False).result
    expected = least(system, more)
    assert result.status == "certified" and expected > 0.0
    assert result.lower_bound == pytest.approx(expected, rel=1e-6) and result.upper_bound >= expected * (1.0 - 1e-9)
    assert check(tmp_path / "run").status == "verified"


LATE: dict[str, Any] = {
    "name": "linear",
    "system": {
        "pieces": [
            {"until": 2.2, "A": [[0, 1], [-2, -0.5]], "B": [[0], [1]]},
            {"until": 5.0, "A": [[0, 1], [-1, -0.1]], "B": [[0], [1.5]], "c": [0, 0.05]},
        ],
        "delay": 0.13,
    },
    "initial_control": [0.1],
    "horizon": 5.0,
    "initial_state": {"centre": [-1, 1], "box": [0.02, 0.02]},
    "control": {"box": 1.0},
    "disturbance": {"box": [0.05, 0.06]},
    "path": [{"box": [0.7, None], "from": 0.4}, {"mixed": {"H": [[0, 1]], "G": [[0.5]], "h": [1.3]}, "from": 0.6}],
    "terminal": [{"box": [0.3, 0.3]}],
}


@pytest.fixture(scope="module")
def late(tmp_path_factory: pytest.TempPathFactory) -> sr.Outcome:
    data = {**config({}, {}), "problem": LATE}
    data["dictionaries"] = {
        "control": {"name": "piecewise_constant", "pieces": 6},
        "disturbance": {"name": "piecewise_constant", "pieces": 8},
    }
    return sr.run(data, out=tmp_path_factory.mktemp("late") / "run", quiet=True, figures=False)


@pytest.mark.slow
def test_a_late_control_of_systems_that_take_turns_keeps_every_wall_in_a_loop_that_others_integrate(
    late: sr.Outcome,
) -> None:
    """The controller sees states that are integrated by exponentials of the whole matrix, over parts of pieces."""
    assert late.result.status == "certified" and check(late.directory).status == "verified"
    controller, rng = sr.controller(late), np.random.default_rng(5)
    ends, pushes = controller.breakpoints, np.linspace(0.0, 5.0, 9)
    times = np.unique(np.concatenate([ends, ends[:-1] + 0.13, pushes, [2.2], np.linspace(0, 5, 41)]))
    times = times[times <= 5.0]
    nearest = np.inf
    for number in range(12):
        w = rng.choice([-1.0, 1.0], (8, 2)) * [0.05, 0.06] if number else np.zeros((8, 2))
        x = np.array([-1.0, 1.0]) + (rng.choice([-1.0, 1.0], 2) * 0.02 if number else 0.0)
        commands: list[np.ndarray] = []
        controller.reset()
        for start, stop in pairwise(times):
            if len(commands) < 6 and start >= ends[len(commands)] - 1e-12:
                commands.append(controller.step(float(ends[len(commands)]), x))
                assert np.abs(commands[-1]).max() <= 1.0 + 1e-9
            middle = (start + stop) / 2
            mode = LATE["system"]["pieces"][int(middle > 2.2)]
            acting = int(np.searchsorted(ends[:-1] + 0.13, middle)) - 1
            u = commands[acting] if acting >= 0 else np.array([0.1])
            push = w[int(np.searchsorted(pushes, middle)) - 1]
            force = np.array(mode["B"]) @ u + push + np.array(mode.get("c", [0, 0]))
            A = np.zeros((3, 3))
            A[:2, :2], A[:2, 2] = mode["A"], force
            x = (expm(A * (stop - start)) @ np.append(x, 1.0))[:2]
            if stop >= 0.4:
                assert abs(x[0]) <= 0.7 + 1e-9
                nearest = min(nearest, 0.7 - abs(x[0]))
            if middle >= 0.6:
                assert x[1] + 0.5 * commands[-1][0] <= 1.3 + 1e-9
        assert np.abs(x).max() <= 0.3 + 1e-9
        nearest = min(nearest, float((0.3 - np.abs(x)).min()))
    assert nearest < 0.1  # the walls are near enough for a wrong control to be seen


@pytest.mark.slow
def test_between_two_times_the_bounds_of_a_late_control_hold_what_is_reached(late: sr.Outcome) -> None:
    model, x = late.experiment.transcription, late.result.decision
    loop, H = model.feedback.loop, np.array([[1.0, 0.0], [-1.0, 0.0], [0.3, 1.0]])
    points = loop.functionals.response.grid.breakpoints
    for parts in (1, 3):
        shares = np.arange(parts + 1) / parts
        lower = (points[:-1, None] + np.diff(points)[:, None] * shares[:-1]).ravel()
        upper = (points[:-1, None] + np.diff(points)[:, None] * shares[1:]).ravel()
        bounds = LoopBounds(loop).over_cells(x, lower, upper, H)[0]
        inside = np.linspace(lower, upper, 23)[1:-1]
        reached = np.stack([loop.values(x, times, H) for times in inside]).max(axis=0)
        assert (reached <= bounds + 1e-12).all()
        assert (bounds - reached <= 0.5 / parts**2).all()


@pytest.mark.slow
def test_simulated_loops_keep_what_is_proven_and_the_adversary_attains_it(late: sr.Outcome) -> None:
    simulation = sr.simulate(late.directory, trajectories=2000)
    assert all(one.violated == 0 for one in simulation.constraints)
