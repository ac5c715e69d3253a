"""Guards errors of execution beside parameters that the state is no affine function of: costs by an independent linear
program at many parameters, in any units, each checked, and what is forged refuted."""

from __future__ import annotations

import copy
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.linalg import expm
from scipy.optimize import linprog

import sparserob_core as sr
from sparserob_core.checker.claims.case import Case
from sparserob_core.checker.reach.bounded_inputs import BoundedInputOver
from sparserob_core.control.reach.varying_execution import VaryingExecutionSupport
from sparserob_core.experiment.assemble import ControlExperiment, assemble
from sparserob_core.experiment.check.check import check
from sparserob_core.experiment.config.load import load_config
from tests.known_answers.test_checks import pieces, verified
from tests.known_answers.test_execution_beside import FINE, HORIZON, PIECES, PROBLEM, TIME
from tests.support import tampering
from tests.support.tubes import tube_of

Config = dict[str, Any]
B = [[0.0, 0.4], [1.0, 0.0]]
SPRING = {"A": [[0, 1], ["-4 + p", -0.3]], "B": B, "parameters": {"p": [-0.2, 0.3]}}
MATHIEU = {
    "A": [[0, 1], ["-4 + p + p*cos(2*t)", "-0.3"]],
    "B": [[0, "0.4 + p^2"], [1, 0]],
    "parameters": {"p": [-0.1, 0.15]},
}
TWO = {"A": [[0, 1], ["-4 + p", "-0.3 - q"]], "B": B, "parameters": {"p": [-0.05, 0.1], "q": [-0.03, 0.05]}}
ENDS = {"terminal": [{"box": [0.35, 0.5]}]}
CASES: dict[str, Config] = {
    "stiffness": {"system": SPRING},
    "stiffness that changes": {"system": MATHIEU},
    "stiffness that is no polynomial": {
        "system": {"A": [[0, 1], ["-4 * exp(-p / 4)", -0.3]], "B": B, "parameters": {"p": [-0.2, 0.3]}}
    },
    "stiffness with a pole, in parts": {
        "system": {"A": [[0, 1], ["-4 / (1 + p)", -0.3]], "B": B, "parameters": {"p": [-0.1, 0.1]}}
    },
    "two": {"system": TWO},
    "delay": {"system": {**SPRING, "delay": 0.25}, "initial_control": [0.4, -0.6], "terminal": [{"box": [0.5, 0.7]}]},
    "pieces": {
        "system": {
            "pieces": [
                {"until": 1.5, "A": SPRING["A"], "B": B},
                {"until": 3.0, "A": [[0, 1], ["-1 - p", -0.4]], "B": [[0.3, 0.1], [0, 0.8]]},
            ],
            "parameters": {"p": [-0.2, 0.3]},
        }
    },
}


def flows_at(name: str, p: float, q: float) -> tuple[np.ndarray, np.ndarray]:
    """What every fine step makes of the state and of the control at one parameter, ``(n, 2, 2)`` each."""
    step = HORIZON / (PIECES * FINE)
    known = []
    for time in (np.arange(PIECES * FINE) + 0.5) * step:
        M = np.zeros((4, 4))
        M[:2, :2], M[:2, 2:] = [[0.0, 1.0], [-4.0 + p, -0.3 - q]], B
        if name == "stiffness that changes":
            M[1, 0], M[0, 3] = -4.0 + p + p * np.cos(2.0 * time), 0.4 + p * p
        elif name == "stiffness that is no polynomial":
            M[1, 0] = -4.0 * np.exp(-p / 4.0)
        elif name == "stiffness with a pole, in parts":
            M[1, 0] = -4.0 / (1.0 + p)
        elif name == "pieces" and time > 1.5:
            M[:2, :2], M[:2, 2:] = [[0.0, 1.0], [-1.0 - p, -0.4]], [[0.3, 0.1], [0.0, 0.8]]
        known.append(M * step)
    every = expm(np.array(known))
    return every[:, :2, :2], every[:, :2, 2:]


def rows_at(name: str, problem: Config, p: float, q: float) -> tuple[np.ndarray, np.ndarray]:
    """``G [a, b] <= h`` of ``u = a - b`` at every fourth fine step and at the end, at one parameter."""
    flows, pushes = flows_at(name, p, q)
    steps = len(flows)
    whole = [np.eye(2)]
    for flow in flows:
        whole.append(flow @ whole[-1])
    since = np.linalg.solve(np.array(whole[1:]), pushes)  # c'x(t_k) has c' whole_k since_j of the step j
    late = round(problem["system"].get("delay", 0.0) / HORIZON * steps)
    piece = (np.arange(steps) - late) // FINE
    shares, before = np.array(problem["execution"]), np.array(problem.get("initial_control", [0.0, 0.0]))
    begin = round(problem["path"][0]["from"] / HORIZON * steps)
    ends = [(0, problem["path"][0]["box"][0], range(begin, steps, 4))]
    ends += [(i, problem["terminal"][0]["box"][i], [steps]) for i in range(2)]
    G, h = [], []
    for axis, bound, times in ends:
        for k in times:
            each = whole[k][axis] @ since[:k]
            on, off = np.zeros((2, 2, PIECES))
            for i in range(2):
                mine = piece[:k] >= 0
                on[i] = np.bincount(piece[:k][mine], each[mine, i], PIECES)
                off[i] = shares[i] * np.bincount(piece[:k][mine], np.abs(each[mine, i]), PIECES)
            early = each[piece[:k] < 0]
            rest = float((shares * np.abs(before)) @ np.abs(early).sum(axis=0))
            free = float(whole[k][axis] @ problem["initial_state"] + (early @ before).sum())
            for sign in (1.0, -1.0):
                G.append(np.concatenate([(sign * on + off).ravel(), (off - sign * on).ravel()]))
                h.append(bound - rest - sign * free)
    return np.array(G), np.array(h)


def least_cost(name: str, problem: Config) -> float:
    """The cost by a linear program at many parameters and times: from below, by little."""
    box = problem["system"]["parameters"]
    values = [np.linspace(low, high, 9 if len(box) > 1 else 31).tolist() for low, high in box.values()]
    grid = np.stack(np.meshgrid(*values), axis=-1).reshape(-1, len(values))
    found = [rows_at(name, problem, *(*one, 0.0)[:2]) for one in grid.tolist()]
    G, h = (np.concatenate(parts) for parts in zip(*found, strict=True))
    prices = np.tile(np.repeat(problem["weights"], PIECES), 2) * HORIZON / PIECES
    best = linprog(prices, A_ub=G, b_ub=h, bounds=(0, 1), method="highs")
    assert best.success
    return float(best.fun)


def in_other_units(given: Config) -> Config:
    """`SPRING` with states, controls, times and its parameter in other units; costs are those of the other time."""
    problem, states, controls = copy.deepcopy(given), np.array([7.0, 0.003]), np.array([40.0, 0.9])
    shares = states / states[:, None] * TIME
    A = [[0, float(shares[0, 1])], [f"(-4 + p / 250) * {float(shares[1, 0])!r}", -0.3 * TIME]]
    problem["system"] = {
        "A": A,
        "B": (np.array(B) * controls / states[:, None] * TIME).tolist(),
        "parameters": {"p": [-50.0, 75.0]},
    }
    problem["horizon"] /= TIME
    problem["initial_state"] = (np.array(problem["initial_state"]) / states).tolist()
    problem["weights"] = (np.array(problem["weights"]) * controls).tolist()
    problem["control"]["box"] = (np.array(problem["control"]["box"]) / controls).tolist()
    for entry in (*problem["path"], *problem["terminal"]):
        entry["box"] = [None if v is None else v / u for v, u in zip(entry["box"], states, strict=True)]
    problem["path"][0]["from"] /= TIME
    return problem


@pytest.mark.slow
@pytest.mark.parametrize("name", CASES)
def test_the_cost_is_that_of_a_linear_program_at_many_parameters(name: str, tmp_path: Path) -> None:
    problem = {**PROBLEM, **ENDS, **CASES[name]}
    found = verified(tmp_path / "run", problem, pieces(PIECES))["cost"]
    expected = least_cost(name, problem)
    assert expected * (1.0 - 1e-5) <= found <= expected * (1.0 + 3e-4)
    if name == "stiffness":
        other = in_other_units(problem)
        assert verified(tmp_path / "other", other, pieces(PIECES))["cost"] * TIME == pytest.approx(found, rel=1e-7)


@pytest.fixture(scope="module")
def spring(tmp_path_factory: pytest.TempPathFactory) -> Path:
    directory = tmp_path_factory.mktemp("spring") / "run"
    verified(directory, {**PROBLEM, **ENDS, **CASES["stiffness"]}, pieces(PIECES))
    return directory


@pytest.mark.slow
@pytest.mark.parametrize(
    ("change", "claim"),
    [
        (tampering.problem(execution=[0.1, 0.05 + 2e-6]), ""),  # the other channel is not used
        (tampering.problem(execution=[0.1, 0.05 - 2e-6]), "lower bound"),
        (tampering.times("lower_bound", 1.0 + 1e-7), "lower bound"),
        (tampering.moved(tampering.between, 1e-5), ""),
        (tampering.moved(tampering.between, -1e-5), ""),
    ],
    ids=["a larger share", "a smaller one", "a bound", "a command", "a lower one"],
)
def test_what_is_changed_afterwards_is_refuted(
    change: tampering.Change, claim: str, spring: Path, tmp_path: Path
) -> None:
    found = check(tampering.forged(spring, tmp_path / "copy", change, consistent=True))
    assert found.status == "refuted"
    assert not claim or {one.name: one.verdict for one in found.claims}[claim] == "fails"


@pytest.mark.slow
def test_replayed_and_drawn_errors_come_close_to_the_walls_and_stay_inside(spring: Path) -> None:
    for row in sr.simulate(spring, law="adversary").constraints:
        assert row.worst - 1e-4 < row.largest < 1e-9  # errors change their signs where steps of the replay do
    assert not any(row.violated for row in sr.simulate(spring, 200, "vertices").constraints)


CONTROL = [[0.5, -1.0, 0.0, 0.7], [0.0, 1.0, -0.3, 0.2]]


def of_system(system: Config) -> ControlExperiment:
    config = {"problem": {**PROBLEM, **ENDS, "system": system}, "dictionaries": {"control": pieces(4)}, "observers": []}
    return assemble(load_config(config)).of_control("")


@pytest.mark.slow
def test_errors_at_one_parameter_and_over_cells_are_those_of_the_plant_there() -> None:
    functionals = of_system(TWO).transcription.functionals
    execution, control, rng = functionals.execution, np.array(CONTROL), np.random.default_rng(0)
    assert execution is not None
    rows, times = np.array([[1.0, 0.0], [0.3, -2.0]]), np.array([1.1, 1.5, 2.9, 3.0])

    def plain(p: np.ndarray) -> np.ndarray:
        known = {"A": [[0.0, 1.0], [-4.0 + p[0], -0.3 - p[1]]], "B": B}
        of = of_system(known).transcription.functionals.execution
        assert of is not None
        return of.added(control, np.repeat(times, 2), np.tile(rows, (4, 1))).reshape(4, 2)

    low, high = np.array([-0.02, 0.0]), np.array([0.06, 0.05])
    (leg,) = functionals.over_cells.legs(low, high)
    support = execution.over(control, rows, leg)
    assert isinstance(support, VaryingExecutionSupport)
    excess, most = [], []
    for ends in ([0.0, 0.0], [1.0, 0.0], [1.0, -1.0]):
        coefficients, more = support.at(times, np.tile(ends, (4, 2, 1)))
        for share in rng.uniform(-1.0, 1.0, size=(6, 2)):
            share = np.where(ends, ends, share)
            truth = plain((low + high) / 2 + share * (high - low) / 2)
            bound = coefficients @ leg.space.monomials(share[None])[0] + more
            assert (truth <= bound + 1e-13).all()
            excess.append((bound - truth).max())
        most.append(max(excess))
        excess.clear()
    # at a corner only what polynomials in the time are off by is left, in each second of a row, once for each
    # coefficient on the cell
    per_second = np.abs(rows).sum(axis=1).max() * support.errors.execution.kernel.errors.max()
    left = float(per_second * times.max()) * leg.space.size
    assert most[0] < 1e-3 and most[2] < left < 1e-10
    seen = execution.extend_directions(np.tile(rows, (4, 1)), np.tile([0.03, 0.01], (8, 1)))
    found = execution.added(control, np.repeat(times, 2), seen).reshape(4, 2)
    assert found == pytest.approx(plain(np.array([0.03, 0.01])), rel=1e-11)


@pytest.mark.slow
def test_the_checker_bounds_errors_over_boxes_and_cells_of_time_from_above_and_by_little() -> None:
    experiment = of_system(TWO)
    case = Case(experiment.problem, experiment.control, experiment.disturbance, {"decision": CONTROL})
    delivered, c, box = case.sources.execution, np.array([0.3, -2.0]), ((-0.02, 0.0), (-0.01, 0.01))
    assert isinstance(delivered, BoundedInputOver)
    tube = tube_of(case, box)
    start, stop = 1.52, 1.53
    found = delivered.over(c, [start, stop], (box, tube.flow))
    powers = np.array(tube.flow.monomials.exponents)
    for share in np.random.default_rng(1).uniform(-1.0, 1.0, size=(4, 2)):
        point = np.array(tube.flow.centre) + share * np.array(tube.flow.radius)
        values = found.ends @ np.prod(share**powers, axis=1)
        for part in (0.0, 0.37, 1.0):
            low, high = delivered.at(point.tolist()).added(c, start + part * (stop - start))
            over = values[0] + part * (values[1] - values[0])
            assert high - 1e-15 <= over + found.off
            assert over - low < found.off + found.over + 1e-5
    assert found.off < 2e-3
    half = ((-0.0175, 0.0025), (-0.0125, 0.0075))
    smaller = delivered.over(c, [start, start + 0.005], (half, tube_of(case, half).flow))
    assert smaller.off < 0.26 * found.off  # of second order in the widths and in the time
    middle = delivered.at(tube.flow.centre).added(c, start)[0]
    assert found.ends[0, 0] - found.off - found.over <= middle


@pytest.mark.slow
def test_a_function_may_multiply_whole_matrices_by_a_parameter() -> None:
    known, uncertain = np.array([[0.0, 1.0], [-4.0, -0.3]]), np.array([[0.0, 0.0], [1.0, 0.0]])

    def cost(A: object) -> float | None:
        problem = sr.OptimalControlProblem(
            system=sr.LinearSystem(A, [[0.0], [1.0]], parameters=sr.Box([-0.1], [0.1])),  # type: ignore[arg-type]
            horizon=2.0,
            initial_state=[-0.9, 0.5],
            control=sr.Box([-1.0], [1.0]),
            path=[sr.PathConstraint(sr.Box([-0.7, -5.0], [0.7, 5.0]), start=0.4)],
            execution=[0.02],
        )
        result = sr.solve(problem, control={"name": "piecewise_constant", "pieces": 4})
        assert result.status == "certified"
        return result.cost

    whole = cost(lambda p: known + uncertain * p[0])
    assert whole is not None and whole > 0.05
    assert whole == cost(lambda p: known + p[0] * uncertain) == cost(lambda p: [[0.0, 1.0], [-4.0 + p[0], -0.3]])
