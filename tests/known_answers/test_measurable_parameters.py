"""Guards measurable disturbances beside parameters in A: costs by an independent linear program at many parameters, in
any units, each checked, and what is forged refuted; bounds over cells of parameters, of both programs."""

from __future__ import annotations

import copy
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.linalg import expm
from scipy.optimize import linprog

import sparserob_core as sr
from sparserob_core.checker.claims.case import Case
from sparserob_core.checker.reach.bounded_inputs import BoundedInputOver
from sparserob_core.control.reach.varying_measurable import VaryingMeasurable
from sparserob_core.control.studies.adversary import evaluate_disturbance, worst_signal
from sparserob_core.experiment.assemble import ControlExperiment, assemble
from sparserob_core.experiment.check.check import check
from sparserob_core.experiment.config.load import load_config
from tests.known_answers.test_checks import pieces, verified
from tests.support import tampering
from tests.support.tubes import tube_of

Config = dict[str, Any]
Matrix = list[list[float]]
PIECES, HORIZON, FINE, TIME = 6, 3.0, 60, 86400.0  # steps of a piece; seconds of a unit of time
B, E = [[0.2, 0.0], [0.0, 1.0]], [[1.0, 0.3], [0.0, 1.0]]
MIDDLE, HALF = np.array([0.004, 0.0]), np.array([0.016, 0.03])
BOX = {"box": {"lower": (MIDDLE - HALF).tolist(), "upper": (MIDDLE + HALF).tolist()}}
CORNERS = np.array([[0.03, 0.02], [0.03, -0.07], [-0.06, 0.02]])
TRIANGLE = {"polytope": {"H": [[1.0, 0.0], [0.0, 1.0], [-1.0, -1.0]], "h": [0.03, 0.02, 0.04]}}
SPRING = {"A": [[0, 1], ["-4 + p", -0.3]], "B": B, "E": E, "parameters": {"p": [-0.2, 0.3]}}
PROBLEM: Config = {
    "name": "linear",
    "system": SPRING,
    "horizon": HORIZON,
    "initial_state": [-0.5, 0.5],
    "control": {"box": [1.0, 1.0]},
    "disturbance": BOX,
    "disturbance_class": "measurable",
    "path": [{"box": [0.6, None], "from": 1.0}],
    "terminal": [{"box": [0.3, 0.35]}],
}


def of_box(rows: np.ndarray) -> np.ndarray:
    """The support function of `BOX`."""
    return np.asarray(rows @ MIDDLE + np.abs(rows) @ HALF)


def of_triangle(rows: np.ndarray) -> np.ndarray:
    """The support function of `TRIANGLE`."""
    return np.asarray((rows @ CORNERS.T).max(axis=-1))


Law = Callable[[float, float, float], tuple[Any, Any]]
PLANTS: dict[str, tuple[Config, Law, Callable[[np.ndarray], np.ndarray]]] = {
    "stiffness": ({}, lambda t, p, q: ([[0, 1], [-4 + p, -0.3]], B), of_box),
    "stiffness that changes": (
        {
            "system": {
                **SPRING,
                "A": [[0, 1], ["-4 + p + p*cos(2*t)", "-0.3"]],
                "B": [[0.2, 0], [0, "1 + p^2"]],
                "parameters": {"p": [-0.1, 0.15]},
            }
        },
        lambda t, p, q: ([[0, 1], [-4 + p + p * np.cos(2 * t), -0.3]], [[0.2, 0], [0, 1 + p * p]]),
        of_box,
    ),
    "mass": (
        {"system": {**SPRING, "A": [[0, 1], ["-4/(1 + p)", "-0.3/(1 + p)"]], "parameters": {"p": [-0.08, 0.1]}}},
        lambda t, p, q: ([[0, 1], [-4 / (1 + p), -0.3 / (1 + p)]], B),
        of_box,
    ),
    "two": (
        {
            "system": {
                **SPRING,
                "A": [[0, 1], ["-4 + p", "-0.3 - q"]],
                "parameters": {"p": [-0.05, 0.1], "q": [-0.03, 0.05]},
            }
        },
        lambda t, p, q: ([[0, 1], [-4 + p, -0.3 - q]], B),
        of_box,
    ),
    "triangle": ({"disturbance": TRIANGLE}, lambda t, p, q: ([[0, 1], [-4 + p, -0.3]], B), of_triangle),
    "gain": (  # of which the state is an affine function
        {"system": {**SPRING, "A": [[0, 1], [-4, -0.3]], "B": [[0.2, 0], [0, "1 + p"]]}, "disturbance": TRIANGLE},
        lambda t, p, q: ([[0, 1], [-4, -0.3]], [[0.2, 0], [0, 1 + p]]),
        of_triangle,
    ),
    "parts": (
        {
            "system": {**SPRING, "parameters": {"p": [-2.0, 2.5]}},
            "disturbance": {"box": [0.005, 0.005]},
            "terminal": [{"box": [0.4, 0.7]}],
        },
        lambda t, p, q: ([[0, 1], [-4 + p, -0.3]], B),
        lambda rows: 0.005 * np.abs(rows).sum(axis=-1),
    ),
    "execution too": ({"execution": [0.1, 0.05]}, lambda t, p, q: ([[0, 1], [-4 + p, -0.3]], B), of_box),
    "turns and a delay": (
        {
            "system": {
                "pieces": [
                    {"until": 1.5, "A": SPRING["A"], "B": B, "E": E},
                    {"until": 3.0, "A": [[0, 1], ["-1 - p", -0.4]], "B": B, "E": E},
                ],
                "delay": 0.25,
                "parameters": {"p": [-0.2, 0.3]},
            },
            "terminal": [{"box": [0.5, 0.5]}],
        },
        lambda t, p, q: ([[0, 1], [-4 + p, -0.3]] if t < 1.5 else [[0, 1], [-1 - p, -0.4]], B),
        of_box,
    ),
}


def rows_at(name: str, problem: Config, p: float, q: float) -> tuple[np.ndarray, np.ndarray]:
    """``G [a, b] <= h`` of ``u = a - b`` at every third fine step and at the end, at one parameter."""
    _, law, height = PLANTS[name]
    step, steps = HORIZON / (PIECES * FINE), PIECES * FINE
    every = np.zeros((steps, 6, 6))
    for k in range(steps):
        A, inputs = law((k + 0.5) * step, p, q)
        every[k, :2] = np.hstack([A, inputs, E]) * step
    made = expm(every)
    whole = [np.eye(2)]
    for flow in made[:, :2, :2]:
        whole.append(flow @ whole[-1])
    since = np.linalg.solve(np.array(whole[1:]), made[:, :2, 2:])  # c'x(t_k) has c' whole_k since_j of the step j
    late = round(problem["system"].get("delay", 0.0) / step)
    shares = np.array(problem.get("execution", [0.0, 0.0]))
    begin = round(problem["path"][0]["from"] / step)
    ends = [(0, problem["path"][0]["box"][0], range(begin, steps, 3))]
    ends += [(i, problem["terminal"][0]["box"][i], range(steps, steps + 1)) for i in range(2)]
    G, h = [], []
    for axis, bound, times in ends:
        for k in times:
            each = whole[k][axis] @ since[:k]
            acts = (np.arange(k) - late) // FINE
            mine, free = acts >= 0, float(whole[k][axis] @ problem["initial_state"])
            on = np.array([np.bincount(acts[mine], each[mine, i], PIECES) for i in range(2)])
            off = np.array([np.bincount(acts[mine], np.abs(each[mine, i]), PIECES) for i in range(2)])
            off *= shares[:, None]
            for sign in (1.0, -1.0):
                G.append(np.concatenate([(sign * on + off).ravel(), (off - sign * on).ravel()]))
                h.append(bound - sign * free - float(height(sign * each[:, 2:]).sum()))
    return np.array(G), np.array(h)


def least_cost(name: str, problem: Config) -> float:
    """The cost by a linear program at many parameters and times: from below, by little."""
    box = problem["system"]["parameters"]
    values = [np.linspace(low, high, 7 if len(box) > 1 else 31).tolist() for low, high in box.values()]
    grid = np.stack(np.meshgrid(*values), axis=-1).reshape(-1, len(values))
    found = [rows_at(name, problem, *(*one, 0.0)[:2]) for one in grid.tolist()]
    G, h = (np.concatenate(parts) for parts in zip(*found, strict=True))
    best = linprog(np.full(4 * PIECES, HORIZON / PIECES), A_ub=G, b_ub=h, bounds=(0, 1), method="highs")
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
        "E": (np.array(E) / states[:, None] * TIME).tolist(),
        "parameters": {"p": [-50.0, 75.0]},
    }
    problem["horizon"] /= TIME
    problem["initial_state"] = (np.array(problem["initial_state"]) / states).tolist()
    problem["weights"] = controls.tolist()
    problem["control"]["box"] = (np.array(problem["control"]["box"]) / controls).tolist()
    for entry in (*problem["path"], *problem["terminal"]):
        entry["box"] = [None if v is None else v / u for v, u in zip(entry["box"], states, strict=True)]
    problem["path"][0]["from"] /= TIME
    return problem


@pytest.mark.slow
@pytest.mark.parametrize("name", PLANTS)
def test_the_cost_is_that_of_a_linear_program_at_many_parameters(name: str, tmp_path: Path) -> None:
    problem = {**PROBLEM, **PLANTS[name][0]}
    found, expected = verified(tmp_path / "run", problem, pieces(PIECES))["cost"], least_cost(name, problem)
    assert expected * (1.0 - 1e-5) <= found <= expected * (1.0 + 3e-4)
    if name == "stiffness":
        other = in_other_units(problem)
        assert verified(tmp_path / "other", other, pieces(PIECES))["cost"] * TIME == pytest.approx(found, rel=1e-7)


@pytest.fixture(scope="module")
def spring(tmp_path_factory: pytest.TempPathFactory) -> Path:
    directory = tmp_path_factory.mktemp("spring") / "run"
    verified(directory, PROBLEM, pieces(PIECES))
    return directory


def larger_box(by: float) -> tampering.Change:
    """Disturbances in a box that goes so much further."""
    ends = {"lower": (MIDDLE - HALF - by).tolist(), "upper": (MIDDLE + HALF + by).tolist()}
    return tampering.problem(disturbance={"box": ends})


@pytest.mark.slow
@pytest.mark.parametrize(
    ("change", "claim"),
    [
        (larger_box(1e-6), ""),
        (larger_box(-1e-6), "lower bound"),
        (tampering.times("lower_bound", 1.0 + 1e-7), "lower bound"),
        (tampering.moved(tampering.between, 1e-5), ""),
        (tampering.moved(tampering.between, -1e-5), ""),
    ],
    ids=["a larger box", "a smaller one", "a bound", "a command", "a lower one"],
)
def test_what_is_changed_afterwards_is_refuted(
    change: tampering.Change, claim: str, spring: Path, tmp_path: Path
) -> None:
    found = check(tampering.forged(spring, tmp_path / "copy", change, consistent=True))
    assert found.status == "refuted"
    assert not claim or {one.name: one.verdict for one in found.claims}[claim] == "fails"


@pytest.mark.slow
def test_replayed_and_drawn_disturbances_come_close_to_the_walls_and_stay_inside(spring: Path) -> None:
    for row in sr.simulate(spring, law="adversary").constraints:
        assert row.worst - 1e-4 < row.largest < 1e-9
    assert not any(row.violated for row in sr.simulate(spring, 200, "vertices").constraints)


def of_problem(**more: Any) -> ControlExperiment:
    config = {"problem": {**PROBLEM, **more}, "dictionaries": {"control": pieces(4)}, "observers": []}
    return assemble(load_config(config)).of_control("")


ROWS, TIMES = np.array([[1.0, 0.0], [0.3, -2.0]]), np.array([1.1, 1.5, 2.9, 3.0])


@pytest.mark.parametrize("bound", [TRIANGLE, pytest.param(BOX, marks=pytest.mark.slow)], ids=["triangle", "box"])
def test_what_they_add_at_one_parameter_and_over_cells_is_that_of_the_plant_there(bound: Config) -> None:
    system = {**SPRING, "A": [[0, 1], ["-1 + p", -0.3]], "parameters": {"p": [-0.02, 0.06]}}
    functionals = of_problem(system=system, disturbance=bound).transcription.functionals
    support, rng = functionals.measurable, np.random.default_rng(0)
    assert isinstance(support, VaryingMeasurable)
    every = np.repeat(TIMES, 2), np.tile(ROWS, (4, 1))

    def plain(p: float) -> np.ndarray:
        known = {"A": [[0.0, 1.0], [-1.0 + p, -0.3]], "B": B, "E": E}
        of = of_problem(system=known, disturbance=bound).transcription.functionals.measurable
        assert of is not None
        return of(*every, np.zeros((8, 0))).reshape(4, 2)

    low, high = np.array([-0.02]), np.array([0.05])
    (leg,) = functionals.over_cells.legs(low, high)
    parts = support.over(ROWS, leg)
    for ends, shares, most in ((0.0, rng.uniform(-1.0, 1.0, size=4), 1e-3), (1.0, np.ones(1), 1e-11)):
        excess = []
        for share in shares.tolist():
            truth, bounds = plain(float((low + high)[0] / 2 + share * (high - low)[0] / 2)), np.zeros((4, 2))
            for part in parts:
                coefficients, more = part.at(TIMES, np.full((4, 2, 1), ends))
                bounds += coefficients @ leg.space.monomials(np.array([[share]]))[0] + more
            assert (truth <= bounds + 1e-13).all()
            excess.append((bounds - truth).max())
        assert max(excess) < most  # at a corner no more is left than rounding
    found = support(*every, np.full((8, 1), 0.03)).reshape(4, 2)
    assert found == pytest.approx(plain(0.03), rel=1e-11)


@pytest.mark.slow
@pytest.mark.parametrize(("name", "places"), [("stiffness", (-0.2, 0.11)), ("parts", (-1.9, 2.4))])
def test_the_worst_signal_at_a_parameter_attains_what_is_claimed(name: str, places: tuple[float, float]) -> None:
    functionals = of_problem(**PLANTS[name][0]).transcription.functionals
    for time, p in zip((1.37, HORIZON), places, strict=True):
        parameter = np.array([p])
        ends, signal = worst_signal(functionals, time, ROWS[1], parameter)
        assert signal is not None
        attained = evaluate_disturbance(functionals, time, ROWS[1], parameter, (ends, signal))
        claimed = functionals.offsets(np.array([time]), ROWS[1:], parameter[None])
        assert attained == pytest.approx(float(claimed[0]), abs=1e-12)


@pytest.mark.slow
@pytest.mark.parametrize("bound", [BOX, TRIANGLE], ids=["box", "triangle"])
def test_the_checker_bounds_them_over_boxes_and_cells_of_time_from_above_and_by_little(bound: Config) -> None:
    weak = {**PLANTS["two"][0]["system"], "B": [[1e-6, 0], [0, 1e-6]]}  # what is not theirs is not in the bounds
    experiment = of_problem(system=weak, disturbance=bound)
    control = np.zeros((2, 4)).tolist()
    case = Case(experiment.problem, experiment.control, experiment.disturbance, {"decision": control})
    strayed, c, box = case.sources.measurable_input, np.array([0.3, -2.0]), ((-0.02, 0.0), (-0.01, 0.01))
    assert isinstance(strayed, BoundedInputOver)
    tube = tube_of(case, box)
    start, stop = 1.52, 1.53
    found = strayed.over(c, [start, stop], (box, tube.flow))
    powers = np.array(tube.flow.monomials.exponents)
    for share in np.random.default_rng(1).uniform(-1.0, 1.0, size=(4, 2)):
        point = np.array(tube.flow.centre) + share * np.array(tube.flow.radius)
        values = found.ends @ np.prod(share**powers, axis=1)
        for part in (0.0, 0.37, 1.0):
            low, high = strayed.at(point.tolist()).added(c, start + part * (stop - start))
            over = values[0] + part * (values[1] - values[0])
            assert high - 1e-15 <= over + found.off
            assert over - low < found.off + found.over + 1e-5
    assert found.off < 2e-3
    whole = ((-0.05, -0.03), (0.1, 0.05))
    flow = tube_of(case, whole).flow
    wide, truth = strayed.over(c, [1.5], (whole, flow)), strayed.at(flow.centre).added(c, 1.5)[0]
    assert wide.ends[0, 0] + 1e-6 < truth < wide.ends[0, 0] + wide.off  # there it is concave
    step, n = 1.5 / 900, 900
    M = np.array([[0.0, 1.0], [-4.0 + flow.centre[0], -0.3 - flow.centre[1]]])
    rows = [c @ expm(M * step * (k + 0.5)) @ E for k in range(n)]
    about = MIDDLE if bound is BOX else np.array([-0.015, -0.025])  # the middle of the box around it, which is in it
    heights = PLANTS["two" if bound is BOX else "triangle"][2](np.array(rows)) - np.array(rows) @ about
    assert truth == pytest.approx(float(heights.sum()) * step, rel=1e-5)
    half = ((-0.0175, 0.0025), (-0.0125, 0.0075))
    smaller = strayed.over(c, [start, start + 0.005], (half, tube_of(case, half).flow))
    assert smaller.off < 0.26 * found.off  # of second order in the widths and in the time
