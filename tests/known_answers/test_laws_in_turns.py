"""Guards known answers: plants that change with time by laws that take turns, disturbances and integrals in windows of
theirs, and plans over a period, against closed forms, independent linear programs and systems in pieces."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from flint import ctx
from scipy.optimize import linprog

import sparserob_core as sr
from sparserob_core.checker.flow.flow import VerifiedFlow
from sparserob_core.checker.flow.plant import Plant
from sparserob_core.control.problem.system import VaryingSystem
from sparserob_core.control.response.response import Propagator
from sparserob_core.control.response.time_grid import merge_grids
from sparserob_core.control.response.varying.expansion import Expansion
from tests.known_answers.test_checks import pieces, verified
from tests.known_answers.test_varying_systems import FADING
from tests.support import tampering

SWITCH = 0.97
"""Between two breakpoints of twenty pieces until 2."""
LAMED: dict[str, Any] = {
    **FADING,
    "system": {
        "pieces": [
            {"until": SWITCH, "A": [["-1/(1 + t)"]], "B": [[1]]},
            {"until": 2.0, "A": [[0]], "B": [["2 - t"]], "E": [["1 + t^2"]]},
        ]
    },
    "initial_state": [2.2],
    "disturbance": {"box": 0.03},
    "terminal": [{"box": 0.2}],
}


def lamed(breaks: np.ndarray, push: float) -> float:
    """The least cost of ``LAMED``: of ``x(2)`` by what every piece adds to it, in closed form."""
    early, late = np.minimum(breaks, SWITCH), np.maximum(breaks, SWITCH)
    faded = ((1 + early) ** 2) / 2 / (1 + SWITCH)
    rows = np.diff(faded) + np.diff(2 * late - late**2 / 2)
    pushed = np.sum(np.diff(faded)) + np.sum(np.diff(late + late**3 / 3))
    limit = 0.2 - push * pushed - 2.2 / (1 + SWITCH)
    sizes = np.diff(breaks)
    program = linprog(np.tile(sizes, 2), np.append(rows, -rows)[None], [limit], bounds=[(0, 1)] * (2 * rows.size))
    return float(program.fun)


@pytest.fixture(scope="module")
def finished(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A finished run of two laws."""
    directory = tmp_path_factory.mktemp("lamed") / "run"
    verified(directory, LAMED, pieces(20), pieces(20))
    return directory


def test_two_laws_cost_what_a_program_in_closed_form_says(finished: Path) -> None:
    cost = json.loads((finished / "result.json").read_text())["cost"]
    assert cost == pytest.approx(lamed(np.linspace(0.0, 2.0, 21), 0.03), rel=1e-6)
    assert not sr.simulate(finished, 50, "vertices").contradicts


def of_piece(number: int, **changes: Any) -> tampering.Change:
    """Another piece in the config of a run."""

    def change(forgery: tampering.Forgery) -> None:
        forgery.system["pieces"][number].update(changes)

    return change


@pytest.mark.first(2)
@pytest.mark.parametrize(
    "change",
    [of_piece(0, until=SWITCH - 1e-4), of_piece(0, A=[["-1.00001/(1 + t)"]]), of_piece(1, B=[["1.99999 - t"]]),
     of_piece(1, E=[["1.00001 + t^2"]])],
    ids=["until", "first law", "second law", "E"],
)  # fmt: skip
def test_a_law_that_is_changed_afterwards_is_found(change: tampering.Change, finished: Path, tmp_path: Path) -> None:
    assert sr.check(tampering.forged(finished, tmp_path / "copy", change, consistent=True)).status == "refuted"


@pytest.mark.slow
def test_a_bound_on_the_path_holds_on_both_sides_of_a_turn(tmp_path: Path) -> None:
    # up at a rate of 2 until 0.97 and down afterwards: the state is highest at the turn, between two breakpoints
    turning = [{"until": SWITCH, "A": [["0*t"]], "B": [[1]], "c": [2]},
               {"until": 2.0, "A": [["0*t"]], "B": [[1]], "c": [-2]}]  # fmt: skip
    problem = {**FADING, "system": {"pieces": turning}, "initial_state": [0], "terminal": [{"box": 9.0}]}
    problem["path"] = [{"polytope": {"H": [[1]], "h": [1.5]}}]
    assert verified(tmp_path / "run", problem, pieces(20))["cost"] == pytest.approx(2 * SWITCH - 1.5, rel=1e-7)
    for k, level in enumerate((1.5 - 1e-5, 1.5 - 1e-7)):
        change = tampering.problem(path=[{"polytope": {"H": [[1]], "h": [level]}}])
        assert sr.check(tampering.forged(tmp_path / "run", tmp_path / str(k), change, True)).status == "refuted"


@pytest.mark.slow
def test_a_push_in_a_window_counts_there_alone(tmp_path: Path) -> None:
    # (1 + t) x gains at most 0.1 * int (1 + t) over [0.53, 1.27]; 2.5 of what is left has to go, which costs 1
    start, stop = 0.53, 1.27
    gained = 0.1 * ((1 + stop) ** 2 - (1 + start) ** 2) / 2
    problem = {
        **FADING,
        "disturbance": [{"set": {"box": 0.1}, "from": start, "to": stop}],
        "terminal": [{"box": gained / 3}],
    }
    assert verified(tmp_path / "run", problem, pieces(20), pieces(20))["cost"] == pytest.approx(1.0, rel=1e-7)
    for k, window in enumerate(((start - 1e-4, stop), (start, stop + 1e-4))):
        change = tampering.problem(disturbance=[{"set": {"box": 0.1}, "from": window[0], "to": window[1]}])
        assert sr.check(tampering.forged(tmp_path / "run", tmp_path / str(k), change, True)).status == "refuted"


def test_an_integral_in_a_window_is_bounded_there_alone(tmp_path: Path) -> None:
    # of the last second half can be used, best at its end: 1.375 of 2.25; 0.875 before it takes half a second
    problem = {**FADING, "initial_state": [2.25], "integral": [{"G": [[1]], "from": 1.0, "lower": -0.5}]}
    assert verified(tmp_path / "run", problem, pieces(20))["cost"] == pytest.approx(1.0, rel=1e-7)
    for k, changed in enumerate(({"from": 0.99999}, {"lower": -0.499999})):
        change = tampering.problem(integral=[{**problem["integral"][0], **changed}])
        forged = tampering.forged(tmp_path / "run", tmp_path / str(k), change, True)
        assert sr.check(forged).status != "verified"


CHANGING = {"name": "linear", "horizon": 2.0, "initial_state": [0.8, 0.0], "control": {"box": 2.0},
            "disturbance": {"box": [0.05, 0.05]}, "terminal": [{"box": [0.3, 0.5]}]}  # fmt: skip
ALIKE: dict[str, dict[str, Any]] = {
    "path": {"path": [{"box": [0.9, 0.6], "from": 0.31}]},
    "late integral": {"integral": [{"H": [[1, 0]], "G": [[0.1]], "from": 0.37, "to": 1.4, "upper": 0.5}]},
    "late and heard late": {"integral": [{"H": [[0.1, 0]], "G": [[1]], "from": 0.37, "to": 1.4, "lower": -0.2}]},
    "window": {"disturbance": [{"set": {"box": 0.05}, "E": [[0], [1]]},
                               {"set": {"box": 0.1}, "E": [[1], [0]], "from": 0.3, "to": 1.1}]},
    "affine": {"policy": {"name": "affine"}},
    "quadratic": {"cost": {"l1": 0.5, "control": {"R": [[0.2]]}, "state": {"Q": [[1, 0], [0, 0.1]]}}},
}  # fmt: skip


@pytest.mark.slow
@pytest.mark.parametrize("more", list(ALIKE))
def test_laws_that_stay_the_same_cost_what_pieces_of_a_system_do(more: str, tmp_path: Path) -> None:
    policy = {key: value for key, value in ALIKE[more].items() if key == "policy"}
    given, costs = {key: value for key, value in ALIKE[more].items() if key != "policy"}, []
    for name, t in (("still", ""), ("changing", " + 0*t")):
        parts = [{"until": 0.77, "A": [[0, f"1{t}"], [-1, -0.2]], "B": [[0], [1]]},
                 {"until": 2.0, "A": [[0, 1], [f"-3{t}", -0.4]], "B": [[0], [f"1.5{t}"]]}]  # fmt: skip
        delay = {"delay": 0.13} if more == "late and heard late" else {}
        problem = {**CHANGING, "system": {"pieces": parts, **delay}, **given}
        config = {"problem": problem, "dictionaries": {"control": pieces(6), "disturbance": pieces(6)}, **policy}
        found = sr.run({**config, "observers": []}, out=tmp_path / name, quiet=True, figures=False)
        assert found.status == "certified"
        assert sr.check(tmp_path / name).status == "verified"
        costs.append(found.result.cost)
    assert costs[1] == pytest.approx(costs[0], rel=2e-6)


@pytest.mark.slow
def test_a_measurable_push_is_a_control_at_one_of_which_anything_may_be_delivered(tmp_path: Path) -> None:
    # (1 + t) x gains at most 0.1 * 4 by any w, 0.6 of it by the initial set and the end: 2.5 of it has to go
    problem = {
        **FADING,
        "system": {"A": [["-1/(1 + t)"]], "B": [[1, 0.1]], "c": [-0.1]},
        "initial_state": {"centre": [2.5], "box": 0.2},
        "control": {"box": {"lower": [-1, 1], "upper": [1, 1]}},
        "weights": [[0, 1, 0]],
        "execution": [0, 1],
        "terminal": [{"box": 0.2}],
    }
    assert verified(tmp_path / "run", problem, pieces(20))["cost"] == pytest.approx(1.0, rel=1e-7)
    change = tampering.problem(execution=[0, 0.9999], terminal=[{"box": 0.19995}])
    assert sr.check(tampering.forged(tmp_path / "run", tmp_path / "copy", change, consistent=True)).status == "refuted"


def returning(**more: Any) -> dict[str, Any]:
    """``x' = u + w + 3 sin(2 pi t)`` from ``[-1, 1]`` over a period, in which the drift comes to nothing."""
    dictionary = pieces(1)
    problem = {
        "name": "linear",
        "system": {"A": [[0]], "B": [[1]], "c": ["3*sin(2*pi*t)"]},
        "horizon": 1.0,
        "initial_state": {"centre": [0.0], "box": [1.0]},
        "control": {"box": 1.0},
        "disturbance": {"box": 0.25},
        "repeat": True,
        **more,
    }
    dictionaries = {"control": dictionary, "disturbance": dictionary}
    policy = {"name": "affine", "cost": "peak", "causal_signals": 0}
    return {"problem": problem, "dictionaries": dictionaries, "policy": policy, "observers": []}


@pytest.mark.slow
def test_a_plan_over_a_period_of_the_plant_holds_for_ever(tmp_path: Path) -> None:
    found = sr.run(returning(), out=tmp_path / "run", quiet=True, figures=False)
    assert found.status == "certified"
    assert found.result.cost == pytest.approx(0.25, rel=1e-6)  # what the disturbance adds has to go
    checked = sr.check(tmp_path / "run")
    assert checked.status == "verified"
    assert {one.name: one.verdict for one in checked.claims}["repeat"] == "holds"
    assert not sr.loop(found, periods=5, trajectories=2).contradicts


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"horizon": 1.0 + 1e-8}, r"repeat: expected a horizon that is a period .*c\[1\] = 0 at 0"),
        ({"horizon": 0.5, "system": {"A": [["cos(2*pi*t)"]], "B": [[1]]}}, r"A\[1\]\[1\] = 1 at 0, and -1 at 0.5"),
    ],
)
def test_a_horizon_that_is_no_period_is_refused(changes: dict[str, Any], said: str, tmp_path: Path) -> None:
    with pytest.raises(sr.InputError, match=said):
        sr.run(returning(**changes), out=tmp_path / "run", figures=False)


def test_a_turn_beside_a_breakpoint_stays_a_mark() -> None:
    breaks = np.linspace(0.0, 2.0, 21)
    system = VaryingSystem.taking_turns([(0.3, ([["t"]], [[1]], None, None)), (2.0, ([[0]], [["t"]], None, None))])
    grid = merge_grids(breaks, breaks, varying=True)
    propagator = Propagator(system, grid)
    assert breaks[3] != 0.3  # by rounding
    assert {0.3, breaks[3]} <= set(propagator.marks.tolist())


def test_transitions_across_a_turn_are_products_of_both_laws() -> None:
    # x' = t x until 0.7, x' = -x/(1 + t) from there on; of a push through B = 1 in the first, 0 in the second
    system = VaryingSystem.taking_turns(
        [(0.7, ([["t"]], [[1]], None, None)), (2.0, ([["-1/(1 + t)"]], [[0]], None, None))]
    )
    begun, end = np.array([0.1]), np.array([1.9])
    expected = np.exp((0.7**2 - 0.1**2) / 2) * 1.7 / 2.9
    flow = Expansion.of(system).flow(begun, end)
    assert abs(flow.state[0, 0, 0] - expected) <= flow.error[0] + 1e-15
    with ctx.workprec(192):
        Phi, Gamma, _ = VerifiedFlow(Plant.of(system, 2.0), 2.0).over(0.1, 1.9)
    points, weights = np.polynomial.legendre.leggauss(30)
    times = 0.4 + 0.3 * points
    driven = 0.3 * weights @ np.exp((0.7**2 - times**2) / 2) * 1.7 / 2.9
    moved = Phi.matrix[0, 0]
    assert abs(float(moved.mid()) - expected) <= float(moved.rad()) + 1e-15 < 1e-12
    assert flow.control[0, 0, 0] == pytest.approx(driven, rel=1e-13)
    assert float(Gamma.matrix[0, 0].mid()) == pytest.approx(driven, rel=1e-13)


@pytest.mark.parametrize(
    ("parts", "said"),
    [
        ([{"until": 1.0, "A": [["t"]], "B": [[1]]}, {"until": 1.9, "A": [[0]], "B": [[1]]}], r"pieces\.1\.until: .*2"),
        ([{"until": 1.0, "A": [["t"]], "B": [[1]]}, {"until": 0.5, "A": [[0]], "B": [[1]]}], r"pieces\.1\.until"),
        ([{"until": 1.0, "A": [["t"]], "B": [[1]]}, {"until": 2.0, "A": [[0]], "B": [[1, 1]]}], r"pieces\.1: .*1 con"),
        ([{"until": 1.0, "A": [["1/(t - 0.5)"]], "B": [[1]]}, {"until": 2.0, "A": [[0]], "B": [[1]]}], "t = 0.5"),
    ],
)  # fmt: skip
def test_laws_that_do_not_follow_one_another_are_refused(
    parts: list[dict[str, Any]], said: str, tmp_path: Path
) -> None:
    problem = {**FADING, "system": {"pieces": parts}}
    with pytest.raises(sr.InputError, match=said):
        sr.run({"problem": problem, "dictionaries": {"control": pieces(8)}}, out=tmp_path / "run", figures=False)


@pytest.mark.slow
def test_attention_to_a_plant_that_stays_the_same_costs_the_same_as_a_function_of_time(tmp_path: Path) -> None:
    costs = []
    for name, t in (("still", ""), ("changing", " + 0*t")):
        problem = {
            "name": "minimum_attention",
            "system": {"A": [[0, 1], [f"-1{t}", -0.5]], "B": [[0], [1]], "E": [[0], [1]]},
            "horizon": 3.0,
            "initial_state": [-0.5, 0.5],
            "initial_control": [0],
            "rate": {"box": 3.0},
            "control": {"box": 2.0},
            "disturbance": {"box": 0.02},
            "terminal": [{"box": [0.2, 0.2]}],
        }
        costs.append(verified(tmp_path / name, problem, pieces(12), pieces(12))["cost"])
    assert costs[1] == pytest.approx(costs[0], rel=1e-9)


@pytest.mark.slow
def test_laws_that_take_turns_are_written_and_read_again(tmp_path: Path) -> None:
    law, window = ([["t"]], [[1]], [[1]], ["cos(t)"]), sr.Disturbance(sr.Box([-0.1], [0.1]), start=0.3, stop=0.6)
    problem = sr.OptimalControlProblem(
        system=sr.VaryingSystem.taking_turns([(0.5, law), (1.0, ([["-a"]], [["t"]], [[1]], None))], {"a": "1 + t"}),
        horizon=1.0,
        initial_state=[1.0],
        control=sr.Box([-3.0], [3.0]),
        terminal=[sr.Box([-0.3], [0.3])],
        disturbances=[window],
    )
    result = sr.solve(problem, control=sr.Dictionary.indicators(np.linspace(0.0, 1.0, 9)))
    result.save(tmp_path / "run")
    assert result.status == "certified"
    assert sr.check(tmp_path / "run").status == "verified"
