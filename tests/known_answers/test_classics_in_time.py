"""Guards known answers: classic plants that change with time, a rocket that becomes lighter and a magnetic
torquer, against closed forms and programs of another hand. Mathieu's equation stands beside the loops in time."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.optimize import linprog

from tests.known_answers.test_checks import pieces, verified
from tests.known_answers.test_feedback_in_time import certified


def test_a_rocket_brakes_when_it_is_light(tmp_path: Path) -> None:
    # v' = u / (4 - t) - 1 from v = 2 - 6 log(2.5 / 2) to 0 in 2: 6 for the last 0.5, when a push does most
    problem: dict[str, Any] = {
        "name": "linear",
        "system": {"A": [[0]], "B": [["1/m"]], "c": [-1], "define": {"m": "4 - t"}},
        "horizon": 2.0,
        "initial_state": [2.0 - 6.0 * float(np.log(1.25))],
        "control": {"box": 6.0},
        "terminal": [{"equals": [0]}],
    }
    found = verified(tmp_path / "run", problem, pieces(8))
    assert found["cost"] == pytest.approx(3.0, rel=1e-9)


TORQUER: dict[str, Any] = {
    "name": "linear",
    "system": {"A": [[0, 0], [0, 0]], "B": [["-sin(2*t)"], ["cos(2*t)"]], "E": [[1, 0], [0, 1]]},
    "horizon": 4.0,
    "initial_state": [0.7, -0.4],
    "control": {"box": 1.0},
}


def pushes(breaks: np.ndarray) -> np.ndarray:
    """What a coil that is on between two times does to both rates, ``(2, K)``: across a field that turns."""
    return np.array([np.diff(np.cos(2 * breaks)), np.diff(np.sin(2 * breaks))]) / 2.0


def test_a_coil_in_a_field_that_turns_stops_a_satellite(tmp_path: Path) -> None:
    rows = pushes(np.linspace(0.0, 4.0, 17))
    least = linprog(np.full(32, 0.25), A_eq=np.hstack([rows, -rows]), b_eq=[-0.7, 0.4], bounds=[(0.0, 1.0)] * 32).fun
    problem = {**TORQUER, "terminal": [{"equals": [0, 0]}]}
    assert verified(tmp_path / "run", problem, pieces(16))["cost"] == pytest.approx(least, rel=1e-8)


@pytest.mark.slow
def test_a_coil_that_answers_leaves_what_the_last_measurements_cannot_answer(tmp_path: Path) -> None:
    """A push is answered only while the coil still can, in the direction that the field leaves it: a program of another
    hand, with one number for what every piece answers of every earlier push."""
    count, w = 6, 0.02
    rows, h = pushes(np.linspace(0.0, 4.0, count + 1)), 4.0 / count
    effects = [(k, j, i) for k in range(count) for j in range(k) for i in range(2)]
    n = 2 * count + len(effects)
    blocks = [*((side, sign) for side in range(2) for sign in (1.0, -1.0)), *((None, k, s) for k in range(count)
              for s in (1.0, -1.0))]  # fmt: skip
    total = n + len(blocks) * 2 * count
    A, b = [], []
    for number, block in enumerate(blocks):
        on = block[1] * rows[block[0]] if block[0] is not None else block[2] * np.eye(count)[block[1]]
        first = n + number * 2 * count
        line = np.zeros(total)
        line[:count], line[count : 2 * count], line[first : first + 2 * count] = on, -on, w
        A.append(line)
        b.append(0.15 - block[1] * TORQUER["initial_state"][block[0]] if block[0] is not None else 1.0)
        for j in range(count):
            for i in range(2):
                for sign in (1.0, -1.0):
                    line = np.zeros(total)
                    line[first + 2 * j + i] = -1.0
                    for place, (k, earlier, axis) in enumerate(effects):
                        if (earlier, axis) == (j, i):
                            line[2 * count + place] = sign * on[k]
                    direct = block[1] * h * (i == block[0]) if block[0] is not None else 0.0
                    A.append(line)
                    b.append(-sign * direct)
    cost = np.concatenate([np.full(2 * count, h), np.zeros(total - 2 * count)])
    free = [(0.0, None)] * (2 * count) + [(None, None)] * len(effects) + [(0.0, None)] * (total - n)
    least = linprog(cost, np.array(A), b, bounds=free).fun
    problem = {**TORQUER, "disturbance": {"box": [w, w]}, "terminal": [{"box": [0.15, 0.15]}]}
    assert certified(problem, count, tmp_path / "run").result.cost == pytest.approx(least, rel=2e-7)
