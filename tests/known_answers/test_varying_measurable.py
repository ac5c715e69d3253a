"""Guards known answers: measurable disturbances of plants that change with time, against closed forms, the constant
system, errors of execution and an independent linear program; forgeries; what is refused beside them."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.integrate import quad, solve_ivp
from scipy.optimize import linprog

import sparserob_core as sr
from sparserob_core.control.studies.adversary import evaluate_disturbance, worst_signal
from sparserob_core.experiment.assemble import assemble
from sparserob_core.experiment.check.check import check
from sparserob_core.experiment.config.load import load_config
from tests.control.sets.test_sets import ByItsSupport
from tests.known_answers.test_checks import pieces, verified
from tests.known_answers.test_pairs import BASE, in_turns, of_two_classes, with_drift
from tests.known_answers.test_varying_systems import FADING
from tests.support import tampering

Problem = dict[str, Any]
ANY: Problem = {"disturbance": {"box": 0.1}, "disturbance_class": "measurable"}
STRAIGHT: Problem = {
    "name": "linear",
    "horizon": 2.0,
    "initial_state": [2.0],
    "control": {"box": 2.0},
    "terminal": [{"box": 0.5}],
}
HORIZON, PIECES = 2.0, 6
MIDDLE, HALF = np.array([0.02, 0.05]), np.array([0.1, 0.05])
CART: Problem = {  # pushed through (0.1 t, cos(3 t)), from a middle that is not 0
    "name": "linear",
    "system": {"A": [[0, 1], [0, 0]], "B": [[0], [1]], "c": [0, 0.1], "E": [["0.1*t", 0], ["cos(3*t)", 0.5]]},
    "horizon": HORIZON,
    "initial_state": [-1.0, 0.5],
    "control": {"box": 2.0},
    "disturbance": {"box": {"lower": [-0.08, 0.0], "upper": [0.12, 0.1]}},
    "disturbance_class": "measurable",
    "path": [{"box": [0.45, None], "from": 1.0}],
    "terminal": [{"box": [0.3, 0.4]}],
}


@pytest.fixture(scope="module")
def finished(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A finished run of the cart."""
    directory = tmp_path_factory.mktemp("cart") / "run"
    verified(directory, CART, pieces(PIECES))
    return directory


@pytest.mark.first(2)
@pytest.mark.parametrize(
    ("E", "bound", "cost"),
    [
        ("t - 1", {"box": 0.1}, 1.5 + 0.1),  # whose sign changes: one that is constant until 2 does nothing
        ("t", {"box": {"lower": [-0.2], "upper": [0.1]}}, 1.5 + 0.1 * 2.0),
        ("exp(-t)", {"box": 0.1}, 1.5 + 0.1 * (1.0 - np.exp(-2.0))),
        ("t - 1", {"box": {"lower": [0.1], "upper": [0.3]}}, 1.5 + 0.1),
        ("t", {"box": {"lower": [0.1], "upper": [0.1]}}, 1.5 + 0.1 * 2.0),
    ],
)
def test_an_integrator_that_is_pushed_by_a_function_of_time_is_the_closed_form(
    E: str, bound: Problem, cost: float, tmp_path: Path
) -> None:
    problem = {**STRAIGHT, **ANY, "disturbance": bound, "system": {"A": [[0]], "B": [[1]], "E": [[E]]}}
    assert verified(tmp_path / "run", problem, pieces(4))["cost"] == pytest.approx(cost, abs=1e-9)


@pytest.mark.slow
def test_a_push_that_may_be_anything_is_a_control_at_one_of_which_anything_may_be_delivered(tmp_path: Path) -> None:
    plant, end = {**FADING, "initial_state": {"centre": [2.5], "box": 0.2}}, {"terminal": [{"box": 0.2}]}
    by_hand = {
        **plant,
        **end,
        "system": {"A": [["-1/(1 + t)"]], "B": [[1, "0.1*cos(4*t)"]], "c": ["-0.1*cos(4*t)"]},
        "control": {"box": {"lower": [-1, 1], "upper": [1, 1]}},
        "weights": [[0, 1, 0]],
        "execution": [0, 1],
    }
    built = {**plant, **end, **ANY, "system": {"A": [["-1/(1 + t)"]], "B": [[1]], "E": [["cos(4*t)"]]}}
    costs = [verified(tmp_path / str(k), one, pieces(10))["cost"] for k, one in enumerate((by_hand, built))]
    assert costs[1] == pytest.approx(costs[0], rel=2e-8)  # as far apart as the bounds of either


def independent(
    middle: np.ndarray = MIDDLE,
    spreading: Callable[[np.ndarray], float] = lambda rows: float(HALF @ np.abs(rows).sum(axis=1)),
) -> float:
    """The cost of the cart by a linear program, whose rows are sums over fine steps at many times; ``spreading`` sums
    the support function of the disturbances about their middle."""
    fine = 300
    step, n = HORIZON / PIECES / fine, PIECES * fine
    s = (np.arange(n) + 0.5) * step
    rows, limits = [], []
    windows = [(np.array([1.0, 0.0]), 0.45, np.linspace(1.0, HORIZON, 201))]
    windows += [(np.array([1.0, 0.0]), 0.3, [HORIZON]), (np.array([0.0, 1.0]), 0.4, [HORIZON])]
    for c, wall, times in windows:
        for t in times:
            past = s < t
            row = np.stack([np.full(n, c[0]), c[0] * (t - s) + c[1]])  # c'Phi(t, s)
            gain = np.where(past, row[1], 0.0).reshape(PIECES, fine).sum(axis=1) * step
            entering = np.stack([0.1 * s * row[0] + np.cos(3 * s) * row[1], 0.5 * row[1]])
            moved = float(middle @ np.where(past, entering, 0.0).sum(axis=1)) * step
            spread = spreading(np.where(past, entering, 0.0)) * step
            free = c[0] * (-1.0 + 0.5 * t + 0.05 * t**2) + c[1] * (0.5 + 0.1 * t)
            for sign in (1.0, -1.0):
                rows.append(np.concatenate([sign * gain, -sign * gain]))
                limits.append(wall - spread - sign * (free + moved))
    prices = np.full(2 * PIECES, HORIZON / PIECES)
    return float(linprog(prices, A_ub=rows, b_ub=limits, bounds=(0, 2), method="highs").fun)


@pytest.mark.slow
def test_a_cart_costs_what_an_independent_linear_program_says(finished: Path) -> None:
    assert tampering.copied(finished).certificate["cost"] == pytest.approx(independent(), rel=1e-5)


@pytest.mark.slow
def test_the_worst_signal_attains_what_is_claimed_and_reaches_the_wall(finished: Path) -> None:
    model = assemble(load_config(finished / "config.yaml")).transcription
    functionals, none = model.functionals, np.zeros(0)
    support = functionals.measurable
    assert support is not None
    control = np.array(tampering.copied(finished).decision)
    highest = []
    walls = [(HORIZON, c, wall) for c, wall in zip(np.vstack([np.eye(2), -np.eye(2)]), [0.3, 0.4] * 2, strict=True)]
    for time, direction, wall in (*walls, (1.0, np.array([-1.0, 0.0]), 0.45), (1.37, np.array([-1.0, 0.3]), np.inf)):
        ends, signal = worst_signal(functionals, time, direction, none)
        assert signal is not None
        attained = evaluate_disturbance(functionals, time, direction, none, (ends, signal))
        claimed = float(functionals.offsets(np.array([time]), direction[None], none[None])[0])
        assert claimed - 1e-12 <= attained <= claimed + 1e-12
        state = np.array([-1.0, 0.5])
        for begin, end, w in zip(ends[:-1], ends[1:], signal.T, strict=True):
            u = float(control[0, min(int((begin + end) / 2 / HORIZON * PIECES), PIECES - 1)])

            def slope(t: float, x: np.ndarray, u: float = u, w: np.ndarray = w) -> list[float]:
                return [x[1] + 0.1 * t * w[0], 0.1 + u + np.cos(3 * t) * w[0] + 0.5 * w[1]]

            if begin < time:
                state = solve_ivp(slope, (begin, min(end, time)), state, rtol=1e-11, atol=1e-12).y[:, -1]
        value = functionals.values(control.ravel(), np.array([time]), direction[None], none[None])
        assert float(direction @ state) == pytest.approx(float(value[0]), abs=1e-9)
        highest.append(float(direction @ state) / wall)
    assert max(highest) == pytest.approx(1.0, abs=1e-6)


@pytest.mark.slow
@pytest.mark.parametrize(
    "change",
    [
        tampering.problem(disturbance={"box": {"lower": [-0.080001, 0.0], "upper": [0.120001, 0.1]}}),
        tampering.problem(disturbance={"box": {"lower": [-0.08, 0.0], "upper": [0.12, 0.100001]}}),
        tampering.problem(terminal=[{"box": [0.299999, 0.399999]}], path=[{"box": [0.449999, None], "from": 1.0}]),
        tampering.times("cost", 0.999999),
        tampering.problem(disturbance={"box": {"lower": [-0.0799, 0.0], "upper": [0.1199, 0.1]}}),
        tampering.system(E=[["0.1*t", 0], ["cos(3*t) + 1e-6*t", 0.5001]]),
        tampering.times("lower_bound", 1.00001),
    ],
    ids=["wider", "wider above", "walls", "cost", "narrower", "E", "lower bound"],
)
def test_what_is_changed_afterwards_is_found(change: tampering.Change, finished: Path, tmp_path: Path) -> None:
    assert check(tampering.forged(finished, tmp_path / "copy", change, consistent=True)).status == "refuted"


TRIANGLE: Problem = {"polytope": {"H": [[-1, 0], [0, -1], [1, 1]], "h": [0.04, -0.01, 0.1]}}
LEANING: Problem = {**CART, "disturbance": TRIANGLE}


@pytest.fixture(scope="module")
def leaning(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A finished run of the cart under disturbances in a triangle that does not hold 0."""
    directory = tmp_path_factory.mktemp("leaning") / "run"
    verified(directory, LEANING, pieces(PIECES))
    return directory


@pytest.mark.slow
def test_a_diamond_is_a_box_that_is_turned(tmp_path: Path) -> None:
    turned: Problem = {**CART["system"], "E": [["0.1*t", "0.1*t"], ["cos(3*t) + 0.5", "cos(3*t) - 0.5"]]}
    diamond = {"polytope": {"H": [[1, 1], [1, -1], [-1, 1], [-1, -1]], "h": [0.1] * 4}}
    every = [
        {**CART, "disturbance": diamond},
        {**CART, "disturbance": {"box": 0.05}, "system": turned},
        {**CART, "disturbance": {"norm": {"p": 1, "radius": 0.1}}},
    ]
    costs = [verified(tmp_path / str(k), one, pieces(PIECES))["cost"] for k, one in enumerate(every)]
    assert costs[0] == pytest.approx(costs[1], rel=1e-8) and costs[2] == pytest.approx(costs[1], rel=1e-8)


@pytest.mark.slow
def test_a_segment_is_a_box_of_one_channel_and_takes_as_long(tmp_path: Path) -> None:
    turned: Problem = {**CART["system"], "E": [["0.1*t"], ["cos(3*t) - 0.5"]]}
    segment = {"polytope": {"H": [[1, 1], [-1, -1], [1, -1], [-1, 1]], "h": [0.0, 0.0, 0.1, 0.1]}}
    every = [{**CART, "disturbance": segment}, {**CART, "disturbance": {"box": 0.05}, "system": turned}]
    costs = [verified(tmp_path / str(k), one, pieces(PIECES))["cost"] for k, one in enumerate(every)]
    assert costs[0] == pytest.approx(costs[1], rel=1e-8)


@pytest.mark.slow
def test_the_worst_signal_in_a_triangle_attains_what_is_claimed(leaning: Path) -> None:
    functionals, none = assemble(load_config(leaning / "config.yaml")).transcription.functionals, np.zeros(0)
    support = functionals.measurable
    assert support is not None
    corners = np.array([[-0.04, 0.01], [-0.04, 0.14], [0.09, 0.01]])
    s = (np.arange(200_000) + 0.5) * HORIZON / 200_000
    for time, direction in (
        (HORIZON, np.array([1.0, 0.3])),
        (HORIZON, np.array([0.0, -1.0])),
        (1.37, np.array([-1.0, 2.0])),
    ):
        ends, signal = worst_signal(functionals, time, direction, none)
        assert signal is not None
        claimed = float(support(np.array([time]), direction[None], none[None])[0])
        assert evaluate_disturbance(functionals, time, direction, none, (ends, signal)) == pytest.approx(
            claimed, abs=1e-12
        )
        row = np.stack([np.full(s.size, direction[0]), direction[0] * (time - s) + direction[1]])
        gains = np.stack([0.1 * s * row[0] + np.cos(3 * s) * row[1], 0.5 * row[1]])
        beside = float((corners @ gains).max(axis=0)[s < time].sum() * HORIZON / s.size)
        assert claimed == pytest.approx(beside, abs=1e-6)


@pytest.mark.slow
@pytest.mark.parametrize(
    "change",
    [
        tampering.problem(disturbance={"polytope": {"H": TRIANGLE["polytope"]["H"], "h": [0.04, -0.01, 0.1001]}}),
        tampering.problem(disturbance={"polytope": {"H": TRIANGLE["polytope"]["H"], "h": [0.04, -0.01, 0.0999]}}),
        tampering.times("cost", 0.999999),
        tampering.times("lower_bound", 1.00001),
    ],
    ids=["wider", "narrower", "cost", "lower bound"],
)
def test_what_is_changed_of_a_triangle_is_found(change: tampering.Change, leaning: Path, tmp_path: Path) -> None:
    assert check(tampering.forged(leaning, tmp_path / "copy", change, consistent=True)).status == "refuted"


@pytest.mark.slow
@pytest.mark.parametrize("more", ["ellipse, initial set and turns", "3-ball, delay and two classes"])
def test_a_constant_plant_in_a_curved_set_costs_the_same_as_a_function_of_time(more: str, tmp_path: Path) -> None:
    costs = []
    for name in ("plain", "dressed"):
        config: dict[str, Any] = {"problem": {**BASE["problem"], **ANY}}
        config["problem"]["system"] = {"A": [[0, 1], [-1, -0.4]], "B": [[0.2, 0], [0, 1]]}
        problem = config["problem"]
        if more.startswith("ellipse"):
            problem["initial_state"] = {"centre": [-0.5, 0.5], "box": [0.02, 0.02]}
            problem["disturbance"] = {"ellipsoid": {"centre": [0.005, 0], "shape": [[2e-4, 1e-4], [1e-4, 3e-4]]}}
            in_turns(config)
        else:
            of_two_classes(config)
            problem["system"]["delay"] = 0.2
            del problem["disturbance_class"]
            ball = {"E": [[0.2, 0], [0, 1]], "set": {"norm": {"p": 3, "radius": 0.015}}, "class": "measurable"}
            problem["disturbance"][0] = ball
        for one in problem["system"].get("pieces", [problem["system"]]) if name == "dressed" else []:
            one["A"] = [[f"{entry} + 0*t" for entry in row] for row in one["A"]]
        costs.append(verified(tmp_path / name, problem, pieces(6), pieces(6))["cost"])
    assert costs[1] == pytest.approx(costs[0], rel=1e-8)


def test_a_set_of_which_no_integral_is_known_is_refused_by_name() -> None:
    with pytest.raises(sr.InputError, match="disturbance: expected a box, polytope, ellipsoid, ball or zonotope"):
        sr.OptimalControlProblem(
            system=sr.VaryingSystem.of([["-t"]], [[1]], 1.0, E=[[1, "t"]]),
            horizon=1.0,
            initial_state=[1.0],
            control=sr.Box([-1.0], [1.0]),
            disturbance=ByItsSupport(sr.NormBall(2.0, 0.1, dimension=2)),
            disturbance_class="measurable",
        )


@pytest.mark.slow
@pytest.mark.parametrize("dressed", [False, True], ids=["constant", "in time"])
@pytest.mark.parametrize(
    "generators",
    [[[0.05, 0.01], [0.01, 0.03], [-0.02, 0.02]], [[0.05, -0.02]], [[0.0, 0.0]], [[0.03, 0.0], [0.06, 0.0]]],
    ids=["three", "a segment", "a point", "two in line"],
)
def test_a_zonotope_is_a_box_through_its_segments(generators: list[list[float]], dressed: bool, tmp_path: Path) -> None:
    E, G, centre = np.array([[0.5, 0.2], [-0.3, 1.0]]), np.array(generators), [0.01, -0.02]
    A = [["0*t", 1], [-1, "-0.3 + 0*t"]] if dressed else [[0, 1], [-1, -0.3]]
    shared = {**CART, "path": [], "disturbance_class": "measurable"}
    drift = E @ centre
    zonotope = {
        **shared,
        "system": {"A": A, "B": [[0], [1]], "E": E.tolist()},
        "disturbance": {"zonotope": {"centre": centre, "generators": generators}},
    }
    box = {
        **shared,
        "system": {"A": A, "B": [[0], [1]], "E": (E @ G.T).tolist(), "c": drift.tolist()},
        "disturbance": {"box": [1.0] * len(generators)},
    }
    costs = [verified(tmp_path / name, one, pieces(6))["cost"] for name, one in (("a", zonotope), ("b", box))]
    assert costs[0] == pytest.approx(costs[1], rel=1e-7)
    longer = tampering.problem(disturbance={"zonotope": {"centre": centre, "generators": (1.001 * G).tolist()}})
    if G.any():
        assert check(tampering.forged(tmp_path / "a", tmp_path / "copy", longer, consistent=True)).status == "refuted"


@pytest.mark.first(1)
@pytest.mark.parametrize(
    "bound",
    [
        {"norm": {"p": 3, "radius": 1e-12}},
        {"box": 1e-13},
        {"ellipsoid": {"centre": [0, 0], "shape": [[1e-26, 0], [0, 1e-26]]}},
        {"norm": {"p": 2, "radius": 1e-300}},
    ],
)
def test_disturbances_that_are_next_to_nothing_are_followed(bound: Problem, tmp_path: Path) -> None:
    """A state that nothing else pushes directly was given their unit, in which the others are fast."""
    problem = {
        **{key: value for key, value in CART.items() if key != "path"},
        "system": {"A": [[0, 1], [-1, -0.2]], "B": [[0], [1]], "E": [[1, 0], [0, 1]]},
        "disturbance": bound,
    }
    still = {**problem, "disturbance": {"box": [0.0, 0.0]}}
    costs = [verified(tmp_path / name, one, pieces(4))["cost"] for name, one in (("a", problem), ("b", still))]
    assert costs[0] == pytest.approx(costs[1], rel=1e-8)


HONEST: dict[str, Problem] = {
    "errors": {"execution": [0.3], "system": {"A": [[0]], "B": [["1 + t/3"]]}, "terminal": [{"box": 1.0}]},
    "a box": {**ANY, "disturbance": {"box": 0.15}, "system": {"A": [["-0.3 - t/9"]], "B": [[1]]}},
    "a diamond": {
        **ANY,
        "disturbance": {"norm": {"p": 1, "radius": 0.1}},
        "system": {"A": [[0]], "B": [[1]], "E": [["1", "2*t"]]},
    },
    "a ball": {
        **ANY,
        "disturbance": {"norm": {"p": 2, "radius": 0.1}},
        "system": {"A": [[0]], "B": [[1]], "E": [["1", "2*t"]]},
    },
}


@pytest.mark.first(1)
@pytest.mark.parametrize("name", HONEST)
def test_a_bound_that_rests_on_a_large_integral_is_derived_as_closely_as_it_is_written(
    name: str, tmp_path: Path
) -> None:
    """These were refuted: integrals were told 1e-12 of themselves too wide, more than a written bound leaves."""
    verified(tmp_path / "run", {**STRAIGHT, **HONEST[name]}, pieces(4))


def ellipse(square: float = 0.01) -> Problem:
    """The options of an ellipse whose longer half-axis follows from ``square``."""
    return {"centre": [0.02, 0.05], "shape": [[square, 0.002], [0.002, 0.0025]]}


ROUND: Problem = {"ellipsoid": ellipse()}


@pytest.fixture(scope="module")
def rounded(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A finished run of the cart under disturbances in an ellipse."""
    directory = tmp_path_factory.mktemp("round") / "run"
    verified(directory, {**CART, "disturbance": ROUND}, pieces(PIECES))
    return directory


@pytest.mark.slow
@pytest.mark.parametrize(
    ("E", "p", "added"),
    [
        (["1", "t - 1"], 2, float(np.sqrt(2.0) + np.arcsinh(1.0))),  # the length of a parabola
        (["t - 1", "2*t - 2"], 2, float(np.sqrt(5.0))),  # which is 0 at 1
        (["t - 1", "2 - 2*t"], 3, float((1.0 + 2.0**1.5) ** (2.0 / 3.0))),
        (["1", "2*t"], 1.0 + 1e-6, 4.25),  # 1 until 0.5, then 2 t, but for 1e-12
        (["1", "t - 1"], 3, 2.0 * float(quad(lambda s: (1.0 + s**1.5) ** (2.0 / 3.0), 0, 1, epsabs=1e-11)[0])),
    ],
)
def test_a_ball_of_disturbances_adds_the_integral_of_a_norm(
    E: list[str], p: float, added: float, tmp_path: Path
) -> None:
    problem = {**STRAIGHT, **ANY, "system": {"A": [[0]], "B": [[1]], "E": [E]}}
    problem["disturbance"] = {"norm": {"p": p, "radius": 0.1}}
    assert verified(tmp_path / "run", problem, pieces(4))["cost"] == pytest.approx(1.5 + 0.1 * added, abs=1e-9)


@pytest.mark.slow
def test_a_cart_in_an_ellipse_costs_what_an_independent_linear_program_says(rounded: Path) -> None:
    L = np.linalg.cholesky(np.array(ROUND["ellipsoid"]["shape"]))
    beside = independent(
        np.array(ROUND["ellipsoid"]["centre"]), lambda rows: float(np.linalg.norm(L.T @ rows, axis=0).sum())
    )
    assert tampering.copied(rounded).certificate["cost"] == pytest.approx(beside, rel=1e-5)


@pytest.mark.slow
@pytest.mark.parametrize(
    "change",
    [
        tampering.problem(disturbance={"ellipsoid": ellipse(0.01001)}),
        tampering.problem(disturbance={"ellipsoid": ellipse(0.00999)}),
        tampering.times("cost", 0.999999),
        tampering.times("lower_bound", 1.00001),
    ],
    ids=["wider", "narrower", "cost", "lower bound"],
)  # fmt: skip
def test_what_is_changed_of_an_ellipse_is_found(change: tampering.Change, rounded: Path, tmp_path: Path) -> None:
    assert check(tampering.forged(rounded, tmp_path / "copy", change, consistent=True)).status == "refuted"


def test_more_than_can_be_made_up_for_is_proven_to_be_infeasible(tmp_path: Path) -> None:
    problem = {**STRAIGHT, **ANY, "disturbance": {"box": 0.501}, "system": {"A": [[0]], "B": [[1]], "E": [["t - 1"]]}}
    config = {"problem": problem, "dictionaries": {"control": pieces(4)}, "observers": []}
    assert sr.run(config, out=tmp_path / "run", figures=False).status == "infeasible"
    assert {one.name: one.verdict for one in check(tmp_path / "run").claims}["infeasibility"] == "holds"


@pytest.mark.slow
def test_a_control_that_is_refuted_shows_by_how_much(tmp_path: Path) -> None:
    config = {"problem": CART, "dictionaries": {"control": pieces(PIECES)}, "method": {"name": "nominal"}}
    outcome = sr.run({**config, "observers": []}, out=tmp_path / "run", figures=False)
    assert outcome.result.status == "refuted"
    assert {one.name: one.verdict for one in check(tmp_path / "run").claims}["violation"] == "holds"
    calm = tampering.problem(disturbance={"box": {"lower": [0.02, 0.05], "upper": [0.02, 0.05]}})
    assert check(tampering.forged(tmp_path / "run", tmp_path / "copy", calm, consistent=True)).status == "refuted"


@pytest.mark.slow
@pytest.mark.parametrize(
    "more",
    [
        "delay and drift",
        "initial set and turns",
        "two classes",
        "not about 0",
        "triangle and initial set",
        "triangle and two classes",
    ],
)
def test_a_constant_plant_costs_the_same_as_a_function_of_time(more: str, tmp_path: Path) -> None:
    costs = []
    for name in ("plain", "dressed"):
        config: dict[str, Any] = {"problem": {**BASE["problem"], **ANY, "disturbance": {"box": [0.015, 0.015]}}}
        config["problem"]["system"] = {"A": [[0, 1], [-1, -0.4]], "B": [[0.2, 0], [0, 1]]}
        problem = config["problem"]
        if more == "delay and drift":
            problem["system"]["delay"] = 0.2
            with_drift(config)
        if more == "initial set and turns":
            problem["initial_state"] = {"centre": [-0.5, 0.5], "box": [0.02, 0.02]}
            in_turns(config)
        if more == "two classes":
            of_two_classes(config)
            del problem["disturbance_class"]
            problem["disturbance"][0].update(
                {"from": 0.4, "to": 2.2, "set": {"box": {"lower": [0.0], "upper": [0.02]}}}
            )
        if more == "triangle and initial set":
            problem["initial_state"] = {"centre": [-0.5, 0.5], "box": [0.02, 0.02]}
            problem["disturbance"] = {"polytope": {"H": [[-1, 0], [0, -1], [1, 1]], "h": [0.01, -0.005, 0.02]}}
        if more == "triangle and two classes":
            of_two_classes(config)
            del problem["disturbance_class"]
            problem["disturbance"][0] = {
                "E": [[0.2, 0], [0, 1]],
                "set": {"polytope": {"H": [[-1, 0], [0, -1], [1, 1]], "h": [0.01, 0.005, 0.02]}},
                "class": "measurable",
            }
        if more == "not about 0":
            problem["disturbance"] = {"box": {"lower": [0.0, -0.02], "upper": [0.02, 0.01]}}
        for one in problem["system"].get("pieces", [problem["system"]]) if name == "dressed" else []:
            one["A"] = [[f"{entry} + 0*t" for entry in row] for row in one["A"]]
        costs.append(verified(tmp_path / name, problem, pieces(6), pieces(6))["cost"])
    assert costs[1] == pytest.approx(costs[0], rel=1e-8)


def test_two_classes_are_refused_by_name_where_a_control_answers(tmp_path: Path) -> None:
    config: Problem = {"dictionaries": {"control": pieces(4)}, "observers": [], "policy": {"name": "affine"}}
    config["problem"] = {key: value for key, value in CART.items() if key != "disturbance_class"}
    of_two_classes(config)
    with pytest.raises(sr.InputError, match="class piecewise_constant, not measurable and piecewise_constant"):
        sr.run(config, out=tmp_path / "run", figures=False)
