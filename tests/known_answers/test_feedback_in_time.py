"""Guards policy affine on plants that change with time: independent linear programs in closed forms, constants written
as functions of time, loops that are integrated elsewhere, forged certificates."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.optimize import linprog
from scipy.sparse import coo_array

import sparserob_core as sr
from sparserob_core.experiment.check.check import check
from tests.known_answers.test_checks import pieces
from tests.known_answers.test_feedback import DOUBLE
from tests.support import tampering
from tests.support.problems import spring

# (1 + t) x is the integral of (1 + t) (u + w)
WALL: dict[str, Any] = {"polytope": {"H": [[1]], "h": [0.9]}, "from": 0.93, "to": 1.91}
FADING: dict[str, Any] = {
    "name": "linear",
    "system": {"A": [["-1/(1 + t)"]], "B": [[1]]},
    "horizon": 2.0,
    "initial_state": [2.2],
    "control": {"box": 1.5},
    "disturbance": {"box": 0.3},
    "path": [WALL],
    "terminal": [{"box": 0.25}],
}
MATHIEU: dict[str, Any] = {
    "name": "linear",
    "system": {"A": [[0, 1], ["-(1.5 - 0.8*cos(2*t))", -0.1]], "B": [[0], [1]], "E": [[0], [1]], "c": [0, "0.1*t"]},
    "horizon": 3.0,
    "initial_state": {"centre": [1.0, 0.0], "box": [0.05, 0.05]},
    "control": {"box": 1.5},
    "disturbance": {"box": 0.1},
    "path": [{"box": [1.2, 2.0]}],
    "terminal": [{"box": [0.4, 0.4]}],
}


def answering(problem: dict[str, Any], count: int, out: Path, cost: str = "nominal") -> sr.Outcome:
    config = {
        "problem": problem,
        "dictionaries": {"control": pieces(count)},
        "policy": {"name": "affine", "cost": cost},
        "observers": [],
    }
    return sr.run(config, out=out, quiet=True, figures=False)


def certified(problem: dict[str, Any], count: int, out: Path, cost: str = "nominal") -> sr.Outcome:
    """The run, which is certified and verified."""
    outcome = answering(problem, count, out, cost)
    assert outcome.status == "certified", outcome.result.message
    found = check(out)
    assert found.status == "verified", [claim for claim in found.claims if claim.verdict != "holds"]
    return outcome


def dense(count: int, samples: int) -> float:
    """The least nominal cost of the fading plant with feedback where its wall is looked at at so many times: control
    ``v_k + sum_{j < k} F_kj w_j``, absolute values of what a disturbance does as variables."""
    breaks, T, radius = np.linspace(0.0, 2.0, count + 1), 2.0, 0.3
    times = np.linspace(0.93, 1.91, samples)
    times = np.unique(np.append(times, breaks[(breaks > 0.93) & (breaks < 1.91)]))[:, None]
    sides = [(1.0, t, 0.9) for t in times[:, 0]] + [(1.0, T, 0.25), (-1.0, T, 0.25)]
    effects = [(k, j) for k in range(count) for j in range(k)]
    n = 2 * count + len(effects)
    entries: list[tuple[int, int, float]] = []
    rhs: list[float] = []
    total, row = n, 0

    def bounded(on_v: np.ndarray, on_F: np.ndarray, on_w: np.ndarray, limit: float) -> None:
        nonlocal total, row
        entries.extend((row, k, g) for k, g in enumerate(on_v))
        entries.extend((row, count + k, -g) for k, g in enumerate(on_v))
        entries.extend((row, total + j, radius) for j in range(count))
        rhs.append(limit)
        row += 1
        for sign in (1.0, -1.0):
            for j in range(count):
                entries.append((row + j, total + j, -1.0))
                rhs.append(-sign * float(on_w[j]))
            for place, (k, j) in enumerate(effects):
                entries.append((row + j, 2 * count + place, sign * float(on_F[k])))
            row += count
        total += count

    for sign, t, height in sides:
        ends = np.minimum(breaks[1:], np.maximum(t, breaks[:-1]))
        g = sign * ((1 + ends) ** 2 - (1 + breaks[:-1]) ** 2) / 2 / (1 + t)
        bounded(g, g, g, height - sign * 2.2 / (1 + t))
    for k in range(count):
        for sign in (1.0, -1.0):
            bounded(sign * np.eye(count)[k], np.eye(count)[k], np.zeros(count), 1.5)
    rows, columns, values = zip(*entries, strict=True)
    A = coo_array((values, (rows, columns)), shape=(row, total))
    cost = np.concatenate([np.full(2 * count, T / count), np.zeros(total - 2 * count)])
    free = [(0.0, None)] * (2 * count) + [(None, None)] * len(effects) + [(0.0, None)] * (total - n)
    found = linprog(cost, A, rhs, bounds=free)
    assert found.status == 0
    return float(found.fun)


@pytest.mark.slow
def test_a_fading_plant_that_answers_costs_what_a_dense_program_says(tmp_path: Path) -> None:
    outcome = certified(FADING, 8, tmp_path / "run")
    seen = dense(8, 241)
    assert seen <= outcome.result.cost * (1.0 + 1e-7)
    assert outcome.result.cost == pytest.approx(seen, rel=2e-5)


@pytest.mark.slow
@pytest.mark.parametrize(("problem", "cost"), [(DOUBLE, "nominal"), (spring(0.1, 0.5), "peak")])
def test_constants_written_as_functions_of_time_cost_the_same(
    problem: dict[str, Any], cost: str, tmp_path: Path
) -> None:
    system = {
        name: [[f"{float(x)!r} + 0*t" for x in row] for row in matrix] if name in "ABE" else matrix
        for name, matrix in problem["system"].items()
    }
    still = certified(problem, 8, tmp_path / "still", cost)
    dressed = certified({**problem, "system": system}, 8, tmp_path / "dressed", cost)
    assert dressed.result.cost == pytest.approx(still.result.cost, rel=2e-7)
    assert dressed.result.lower_bound == pytest.approx(still.result.lower_bound, rel=2e-7)


@pytest.fixture(scope="module")
def finished(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A finished run of Mathieu's equation, driven and disturbed, from a box of states."""
    directory = tmp_path_factory.mktemp("mathieu") / "run"
    certified(MATHIEU, 4, directory)
    return directory


@pytest.mark.slow
def test_a_controller_keeps_an_integrated_plant_in_its_sets(finished: Path) -> None:
    """The worst cases are near what some corners of the sets do, and no corner that is drawn does more."""
    rng, ends, highest = np.random.default_rng(1), [], -np.inf
    controller = sr.controller(finished)
    breaks = controller.breakpoints
    for _ in range(6):
        controller.reset()
        x = np.array([1.0, 0.0]) + 0.05 * rng.choice([-1.0, 1.0], size=2)
        for start, stop in zip(breaks[:-1].tolist(), breaks[1:].tolist(), strict=True):
            u, w = controller.step(start, x)[0], 0.1 * rng.choice([-1.0, 1.0])

            def rate(t: float, y: np.ndarray, push: float = float(u + w)) -> list[float]:
                return [y[1], -(1.5 - 0.8 * np.cos(2 * t)) * y[0] - 0.1 * y[1] + push + 0.1 * t]

            found = solve_ivp(rate, (start, stop), x, rtol=1e-10, atol=1e-12, max_step=(stop - start) / 20)
            highest, x = max(highest, float(np.abs(found.y[0]).max())), found.y[:, -1]
        ends.append(np.abs(x).max())
        assert controller.covered
    assert highest <= 1.2 and max(ends) <= 0.4 + 1e-7


@pytest.mark.slow
@pytest.mark.parametrize(
    "change",
    [
        tampering.system(A=[[0, 1], ["-(1.5 - 0.80001*cos(2*t))", -0.1]]),
        tampering.system(B=[[0], ["1 + 1e-5*t"]]),
        tampering.system(E=[[0], ["1 + 1e-5*t"]]),
        tampering.system(c=[0, "0.10001*t"]),
        tampering.problem(terminal=[{"box": [0.39999, 0.4]}]),
        tampering.problem(disturbance={"box": 0.10001}),
        lambda files: files.certificate["gains"][3][1][0].__setitem__(0, files.certificate["gains"][3][1][0][0] + 1e-4),
        lambda files: files.certificate["gains"][1][2][0].__setitem__(0, 1e-4),
    ],
    ids=["A", "B", "E", "c", "terminal", "disturbance", "gains", "gains that foresee"],
)
def test_a_loop_that_is_changed_afterwards_is_found(change: tampering.Change, finished: Path, tmp_path: Path) -> None:
    assert check(tampering.forged(finished, tmp_path / "copy", change, consistent=True)).status == "refuted"


@pytest.mark.slow
def test_no_drawn_trajectory_contradicts_a_loop_in_time(finished: Path) -> None:
    found = sr.simulate(finished, 300, seed=2)
    assert not found.contradicts


@pytest.mark.slow
def test_outputs_of_a_plant_in_time_are_answered(tmp_path: Path) -> None:
    """With noise of one output no more than without it, and with the whole state no more than with that."""
    noisy = {**MATHIEU, "terminal": [{"box": [0.55, 0.8]}], "measurements": {"C": [[1, 0]], "noise": {"box": 0.02}}}
    exact = {**noisy, "measurements": {"C": [[1, 0]]}}
    whole = {key: value for key, value in noisy.items() if key != "measurements"}
    costs = [certified(one, 5, tmp_path / str(k)).result.cost for k, one in enumerate((noisy, exact, whole))]
    assert costs[0] >= costs[1] * (1 - 1e-6) and costs[1] >= costs[2] * (1 - 1e-6)
    copy = tampering.forged(
        tmp_path / "0",
        tmp_path / "copy",
        lambda files: files.certificate["observer"][1][0].__setitem__(0, files.certificate["observer"][1][0][0] + 0.01),
        consistent=True,
    )
    assert check(copy).status == "refuted"


@pytest.mark.slow
def test_a_fixed_state_is_met_for_every_beginning_of_a_plant_in_time(tmp_path: Path) -> None:
    certain = {key: value for key, value in MATHIEU.items() if key != "disturbance"}
    certified({**certain, "terminal": [{"equals": [0, None]}]}, 5, tmp_path / "run")
