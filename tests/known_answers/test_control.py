"""Guards known answers: optimal control problems whose values are known: closed forms, and independent linear
programs."""

from __future__ import annotations

import math

import numpy as np
import pytest
from scipy.linalg import expm

import sparserob_core as sr
from tests.support.independent import Problem, enclosed_value, random_problem, sample, value
from tests.support.places import CONFIGS

SOLVERS = ["piqp", "proxqp", "clarabel"]
DOUBLE_INTEGRATOR = {"A": [[0, 1], [0, 0]], "B": [[0], [1]]}
OSCILLATOR = {"A": [[0, 1], [-1, 0]], "B": [[0], [1]]}
GAP = 1e-6


@pytest.fixture
def run(tmp_path):
    """Run a config, by file or mapping, quietly."""
    count = iter(range(100))

    def ran(config, overrides=None):
        return sr.run(
            config, {"observers": [], **(overrides or {})}, tmp_path / f"run{next(count)}", quiet=True, figures=False
        )

    return ran


def linear(pieces, **problem):
    return {
        "problem": {"name": "linear", "control": {"box": 1.0}, **problem},
        "dictionaries": {"control": {"name": "piecewise_constant", "pieces": pieces}},
    }


def assert_cost(outcome, truth, accuracy=1e-6, proven=("certified",)):
    result = outcome.result
    assert result.status in proven, result.message
    assert result.gap <= GAP
    assert abs(result.cost - truth) <= accuracy
    assert result.lower_bound <= truth + accuracy
    assert result.upper_bound >= truth - accuracy


# Sparse control without uncertainty, to the origin.


def to_the_origin(system, pieces, horizon, initial_state):
    return linear(pieces, system=system, horizon=horizon, initial_state=initial_state, terminal=[{"equals": [0, 0]}])


def double_integrator_cost(horizon, x, v):
    return horizon - math.sqrt((horizon - v) ** 2 - 4 * x - 2 * v**2)


@pytest.mark.parametrize(("pieces", "value"), [(50, 1.838710), pytest.param(1000, 1.837725, marks=pytest.mark.slow)])
def test_the_double_integrator_approaches_its_closed_form_from_above(run, pieces, value):
    truth = double_integrator_cost(5, 1, 1)
    assert abs(truth - 1.8377223398) <= 1e-10
    outcome = run(to_the_origin(DOUBLE_INTEGRATOR, pieces, 5.0, [1, 1]))
    assert_cost(outcome, value, 2e-6)
    assert outcome.result.cost >= truth - 1e-7


def start_of(system, horizon, signal, pieces):
    """The initial state from which a piecewise constant control leads to the origin."""
    A, B = np.array(system["A"], float), np.array(system["B"], float)
    h = horizon / pieces
    step = expm(h * np.block([[A, B], [np.zeros((1, 3))]]))
    state = np.zeros(2)
    for u in signal[::-1]:
        state = np.linalg.solve(step[:2, :2], state - step[:2, 2] * u)
    return state.tolist()


@pytest.mark.first(2)
@pytest.mark.parametrize(("first", "last"), [(5, 10), (12, 3), (1, 1), (20, 19)])
def test_a_bang_off_bang_control_with_its_switches_on_the_grid_is_exact(run, first, last):
    """The switching function of the double integrator is affine, so -1, 0, +1 is optimal whatever its switches."""
    pieces, horizon = 40, 4.0
    signal = np.concatenate([-np.ones(first), np.zeros(pieces - first - last), np.ones(last)])
    start = start_of(DOUBLE_INTEGRATOR, horizon, signal, pieces)
    outcome = run(to_the_origin(DOUBLE_INTEGRATOR, pieces, horizon, start))
    truth = (first + last) * horizon / pieces
    assert abs(double_integrator_cost(horizon, *start) - truth) <= 1e-9
    assert_cost(outcome, truth)
    np.testing.assert_allclose(outcome.control[0], signal, atol=1e-4)


@pytest.mark.parametrize(("k", "r", "pieces", "value", "accuracy"), [(1, 2.0, 1000, 2.0944053, 2e-7)])
def test_the_oscillator_approaches_its_closed_form_from_above(run, k, r, pieces, value, accuracy):
    truth = 4 * k * math.asin(r / (4 * k))
    outcome = run(to_the_origin(OSCILLATOR, pieces, 2 * math.pi * k, [r, 0]))
    assert_cost(outcome, value, accuracy + 1e-6)
    assert truth - 1e-6 <= outcome.result.cost <= truth + 2e-5


@pytest.mark.first(3)
@pytest.mark.parametrize("on", [2, 5, 10])
@pytest.mark.parametrize("k", [1, 2])
def test_an_oscillator_with_its_switches_on_the_grid_is_exact(run, k, on):
    """``u = -sign sin`` where ``|sin t|`` exceeds a threshold: pulses of ``2 on`` pieces around the extrema of the
    sine."""
    pieces, horizon = 40 * k, 2 * math.pi * k
    middles = (np.arange(pieces) + 0.5) * horizon / pieces
    signal = np.where(np.abs(np.sin(middles)) > math.cos(on * math.pi / 20), -np.sign(np.sin(middles)), 0.0)
    outcome = run(to_the_origin(OSCILLATOR, pieces, horizon, start_of(OSCILLATOR, horizon, signal, pieces)))
    truth = 4 * k * on * math.pi / 20
    assert abs(np.abs(signal).sum() * horizon / pieces - truth) <= 1e-12
    assert_cost(outcome, truth)


def test_the_degenerate_double_integrator_recovers_the_optimiser_of_minimum_norm(run):
    pieces = 100
    outcome = run(to_the_origin(DOUBLE_INTEGRATOR, pieces, 5.0, [10, -3]))
    assert_cost(outcome, 3.0)
    t = (np.arange(pieces) + 0.5) * 5.0 / pieces
    least = np.clip((t - (2 - math.sqrt(3))) / (2 * math.sqrt(3)), 0, 1)
    np.testing.assert_allclose(outcome.control[0], least, atol=5e-3)
    assert abs((outcome.control**2).sum() * 5.0 / pieces - (3 - 1 / math.sqrt(3))) <= 1e-3


@pytest.mark.parametrize(
    ("rate", "horizon", "distance", "pieces"), [(1.0, 4.0, 3.0, 40), (2.0, 5.0, 8.0, 50), (0.5, 4.0, -0.875, 40)]
)
def test_minimum_attention_of_an_integrator_has_its_closed_form(run, rate, horizon, distance, pieces):
    truth = rate * horizon - math.sqrt(rate**2 * horizon**2 - 4 * rate * abs(distance))
    first = truth / (2 * rate) * pieces / horizon
    assert abs(first - round(first)) <= 1e-9, "the switches are meant to lie on the grid"
    config = {
        "problem": {
            "name": "minimum_attention",
            "system": {"A": [[0]], "B": [[1]]},
            "horizon": horizon,
            "initial_state": [distance],
            "initial_control": 0.0,
            "rate": {"box": rate},
            "terminal": [{"equals": [0]}],
        },
        "dictionaries": {"control": {"name": "piecewise_constant", "pieces": pieces}},
    }
    assert_cost(run(config), truth)


# Robust.


def robust_double_integrator(pieces):
    return linear(
        pieces,
        system=DOUBLE_INTEGRATOR,
        horizon=5.0,
        initial_state=[4, 0],
        disturbance={"box": [0.02, 0.02]},
        terminal=[{"box": [0.5, 0.3]}],
    )


@pytest.mark.first(3)
@pytest.mark.parametrize("solver", SOLVERS)
@pytest.mark.parametrize("pieces", [50, 100])
def test_the_robust_double_integrator_costs_exactly_eight_fifths(run, pieces, solver):
    outcome = run(robust_double_integrator(pieces), {"solver.name": solver})
    assert_cost(outcome, 1.6)
    assert outcome.result.lower_bound <= 1.6 + 1e-9
    assert outcome.result.upper_bound >= 1.6 - 1e-9


def test_the_same_problem_in_python_has_the_same_cost():
    problem = sr.OptimalControlProblem(
        system=sr.LinearSystem(np.array([[0.0, 1.0], [0.0, 0.0]]), np.array([[0.0], [1.0]])),
        horizon=5.0,
        initial_state=[4.0, 0.0],
        control=sr.Box([-1.0], [1.0]),
        disturbance=sr.Box([-0.02, -0.02], [0.02, 0.02]),
        terminal=[sr.Box([-0.5, -0.3], [0.5, 0.3])],
    )
    result = sr.solve(
        problem, method="exchange", solver="piqp", control={"name": "piecewise_constant", "pieces": 50}, tolerance=1e-7
    )
    assert abs(result.cost - 1.6) <= 1e-6
    assert result.status == "certified"


def test_the_scenario_approach_is_cheaper_and_wrong(run):
    """J = 1.3597 for one draw of 10 000 disturbances, violated by 0.257 in the worst case; another draw differs a
    little."""
    outcome = run(robust_double_integrator(50), {"method": {"name": "scenario", "scenarios": 10_000}})
    assert abs(outcome.result.cost - 1.3597) <= 0.02
    assert outcome.result.status == "refuted"
    assert abs(outcome.result.worst.violation - 0.257) <= 0.03


def scalar_with_uncertain_rate(pieces, radius):
    return linear(
        pieces,
        system={"A": [["-a"]], "B": [[1]], "parameters": {"a": [0.5, 1]}},
        horizon=1.0,
        initial_state=[2],
        terminal=[{"box": radius}],
    )


def test_a_scalar_with_uncertain_rate_approaches_its_closed_form_from_above(run):
    truth = -math.log(1 - 0.5 * (2 * math.exp(-0.5) - 0.5)) / 0.5
    assert abs(truth - 0.8817617966) <= 1e-10
    result = run(scalar_with_uncertain_rate(500, 0.5)).result
    assert result.status == "certified", result.message
    assert result.gap <= GAP
    assert truth - 1e-6 <= result.cost <= truth + 2e-6


@pytest.mark.parametrize("on", [30, *(pytest.param(on, marks=pytest.mark.slow) for on in (35, 40))])
def test_a_scalar_with_uncertain_rate_and_its_switch_on_the_grid_is_exact(run, on):
    duration = on / 50
    radius = 2 * math.exp(-0.5) - (1 - math.exp(-0.5 * duration)) / 0.5
    assert radius > 0
    assert_cost(run(scalar_with_uncertain_rate(50, radius)), duration)


def uncertain_oscillator():
    return linear(
        100,
        system={"A": [[0, 1], ["-omega**2", 0]], "B": [[0], [1]], "parameters": {"omega": [0.9, 1.1]}},
        horizon=2 * math.pi,
        initial_state=[1, 0],
        terminal=[{"box": [0.8, None]}],
    )


def test_the_worst_frequency_of_an_oscillator_lies_in_the_interior(run):
    """Enforcing the two vertices gives 0.009922, enforcing the nominal frequency less still; the truth is 0.200625."""
    assert_cost(run(uncertain_oscillator()), 0.200625, 2e-6)


@pytest.mark.parametrize("kind", ["piecewise_constant", "measurable"])
@pytest.mark.parametrize("pieces", [25, pytest.param(40, marks=pytest.mark.slow)])
def test_a_measurable_disturbance_counts_what_a_piecewise_constant_one_cannot_do(run, pieces, kind):
    """Steer only ``x1`` of an oscillator: ``x1(2 pi) = x1(0) - int sin(s) u(s) ds``. The cheapest control fills the
    pieces on which ``|int sin|`` is largest (a fractional knapsack), until the disturbance's support ``int |sin|``, or
    its piecewise mean, is paid for.
    """
    start, radius, bound = 1.0, 0.5, 0.05
    edges = np.linspace(0, 2 * math.pi, pieces + 1)
    gain = np.abs(np.diff(np.cos(edges)))
    support = bound * (4.0 if kind == "measurable" else gain.sum())
    needed, length, truth = start - radius + support, 2 * math.pi / pieces, 0.0
    for g in np.sort(gain)[::-1]:
        share = min(1.0, needed / g)
        truth, needed = truth + share * length, needed - share * g
        if needed <= 0:
            break
    config = linear(
        pieces,
        system={**OSCILLATOR, "E": [[0], [1]]},
        horizon=2 * math.pi,
        initial_state=[start, 0],
        disturbance={"box": bound},
        disturbance_class=kind,
        terminal=[{"box": [radius, None]}],
    )
    assert_cost(run(config), truth)


# The paper's system.

EXPERIMENT_1, EXPERIMENT_2, EXPERIMENT_3 = (CONFIGS / f"experiment{i}_repaired.yaml" for i in (1, 2, 3))

PAPER = {
    # 0.175769 is the value with the path imposed at the 251 breakpoints only: see
    # test_the_breakpoints_alone_are_not_enough.
    "no disturbance": (EXPERIMENT_1, {"problem.disturbance": None}, 0.1757928, 2e-7),
    "|w| <= 0.06": (EXPERIMENT_1, {}, 0.63212, 2e-5),
    "|w| <= 0.06, N = 100": (
        EXPERIMENT_1,
        {"dictionaries.control.pieces": 100, "dictionaries.disturbance.pieces": 100},
        0.63230,
        2e-5,
    ),
    "experiment 2": (EXPERIMENT_2, {}, 1.02007, 2e-5),
    "experiment 3": (EXPERIMENT_3, {}, 1.11230, 2e-5),
    "experiment 3, no disturbance": (EXPERIMENT_3, {"problem.disturbance": None}, 0.485453, 2e-6),
}


@pytest.mark.first(1)
@pytest.mark.parametrize(
    "row", [pytest.param(row, marks=pytest.mark.slow if row.startswith("experiment") else ()) for row in PAPER]
)
def test_the_papers_system_has_the_value_of_its_linear_program(run, row):
    config, overrides, value, accuracy = PAPER[row]
    assert_cost(run(config, overrides), value, accuracy)


@pytest.mark.first(1)
@pytest.mark.parametrize(
    "solver", [pytest.param(name, marks=pytest.mark.slow if name == "proxqp" else ()) for name in SOLVERS]
)
def test_all_solvers_agree_on_the_papers_first_experiment(run, solver):
    outcome = run(EXPERIMENT_1, {"solver.name": solver})
    assert_cost(outcome, run(EXPERIMENT_1).result.cost, 1e-6)


def test_the_first_experiment_without_disturbance_is_the_nominal_method(run):
    outcome = run(EXPERIMENT_1, {"method": {"name": "nominal"}})
    assert abs(outcome.result.cost - 0.1757928) <= 2e-7
    assert outcome.result.status == "refuted"


def test_the_breakpoints_alone_are_not_enough():
    """Independent linear programs: 0.175769 with the path imposed at the breakpoints, 0.1757928 with it imposed between
    them as well."""
    problem = Problem(
        A=np.array([[0.0, 1.0], [-2.0, -0.5]]),
        B=np.array([[0.0], [1.0]]),
        initial_state=np.array([-1.0, 1.0]),
        horizon=5.0,
        pieces=250,
        control=np.ones(1),
        weights=np.ones(1),
        disturbance=np.zeros(2),
        terminal=np.array([0.3, 0.3]),
        path=[(np.array([0.7, np.inf]), 0.3, 5.0)],
    )
    assert abs(value(problem, sample(problem, 1)) - 0.175769) <= 1e-6
    lower, upper = enclosed_value(problem, 16)
    assert upper - lower < 2e-6
    assert lower - 1e-9 <= 0.1757928 <= upper + 1e-9


@pytest.mark.first(1)
@pytest.mark.parametrize("number", [1, 2, 3])
def test_the_experiments_as_printed_are_infeasible(run, number):
    outcome = run(CONFIGS / f"experiment{number}_printed.yaml")
    assert outcome.result.status == "infeasible", outcome.result.message


def test_experiment_1_as_printed_is_infeasible_even_without_its_path_constraint(run):
    """The disturbance moves the final state by (1.2800, 1.7541) against a half-width of 0.3."""
    outcome = run(CONFIGS / "experiment1_printed.yaml", {"problem.path": []})
    assert outcome.result.status == "infeasible", outcome.result.message


@pytest.mark.first(1)
@pytest.mark.parametrize(("bound", "feasible"), [(0.06838, True), (0.06844, False)])
def test_the_largest_disturbance_that_experiment_1_survives(run, bound, feasible):
    outcome = run(EXPERIMENT_1, {"problem.disturbance": {"box": [bound, bound]}})
    assert outcome.result.status == ("certified" if feasible else "infeasible"), outcome.result.message


# Random instances against linear programs that enclose the value.


@pytest.mark.first(3)
@pytest.mark.parametrize("seed", [*range(6), *(pytest.param(seed, marks=pytest.mark.slow) for seed in range(6, 24))])
def test_a_random_instance_lies_between_two_independent_linear_programs(run, seed):
    problem = random_problem(seed)
    lower, upper = enclosed_value(problem)
    result = run(problem.config(), {"solver.name": SOLVERS[seed % 3]}).result
    if np.isinf(lower):
        assert result.status == "infeasible", result.message
        return
    if np.isinf(upper):
        pytest.skip("the fine grid cannot decide whether this instance is feasible")
    assert result.status == "certified", result.message
    assert result.gap <= GAP
    assert lower - 1e-6 <= result.cost <= upper + 1e-6
    assert result.lower_bound <= upper + 1e-9
    assert result.upper_bound >= lower - 1e-9
