"""Guards known answers: answers at the edges: parameters that hide between samples, small units, steep systems,
uncommon norms."""

from __future__ import annotations

import numpy as np
import pytest

import sparserob_core as sr

DOUBLE_INTEGRATOR = sr.LinearSystem([[0, 1], [0, 0]], [[0], [1]])


def solved(problem, pieces, **options):
    dictionary = sr.Dictionary(np.linspace(0, problem.horizon, pieces + 1), np.eye(pieces))
    return sr.solve(sr.transcribe(problem, dictionary, dictionary), regulariser="ridge", **options)


@pytest.mark.parametrize("rate", [lambda p: 0.5 * np.sin(4 * p[0]), lambda p: 0.3 * np.sin(48 * np.pi * p[0])])
def test_an_equality_that_a_parameter_reaches_between_any_samples_is_refused(rate):
    system = sr.LinearSystem(lambda p: np.array([[rate(p)]]), [[1.0]], parameters=sr.Box([0.0], [1.0]))
    problem = sr.OptimalControlProblem(
        system=system, horizon=1.0, initial_state=[1.0], control=sr.Box([-3], [3]), terminal=[sr.Equality([0.0])]
    )
    with pytest.raises(sr.InputError, match="state 1 depends on the uncertainty"):
        solved(problem, 20)


def in_units(unit, **more):
    return sr.OptimalControlProblem(
        system=DOUBLE_INTEGRATOR,
        horizon=5.0,
        initial_state=[4 * unit, 0],
        control=sr.Box([-unit], [unit]),
        terminal=[sr.Box([-0.5 * unit, -0.3 * unit], [0.5 * unit, 0.3 * unit])],
        **more,
    )


@pytest.mark.first(2)
@pytest.mark.parametrize("unit", [1e-6, 1e-4, 1e-2, 1e2, 1e4])
def test_the_cost_scales_with_the_units(unit):
    reference, result = solved(in_units(1.0), 50), solved(in_units(unit), 50)
    assert result.status == "certified", result.message
    assert abs(result.cost / unit - reference.cost) <= 1e-6


def test_the_robust_cost_scales_with_the_units():
    result = solved(in_units(1e-6, disturbance=sr.Box([-2e-8, -2e-8], [2e-8, 2e-8])), 50)
    assert result.status == "certified", result.message
    assert abs(result.cost / 1e-6 - 1.6) <= 1e-6


@pytest.mark.parametrize("unit", [1e-10, 1e-9])
def test_nothing_is_certified_that_misses_a_tiny_set(unit):
    problem = in_units(unit)
    result = solved(problem, 50)
    if result.status in {"certified", "verified"}:
        step = problem.horizon / 50
        ages = problem.horizon - (np.arange(50) + 0.5) * step
        final = np.array([4 * unit + step * ages @ result.decision, step * result.decision.sum()])
        assert (np.abs(final) <= np.array([0.5, 0.3]) * unit * (1 + 1e-5)).all()


@pytest.mark.first(1)
@pytest.mark.parametrize("p", [1.5, 3.0])
def test_a_disturbance_in_any_norm_under_a_curved_set_is_certified(p):
    """For ``x' = u + w`` the worst disturbance moves the state by ``T`` times the ball, whatever its norm: J is what
    brings it back inside."""
    problem = sr.OptimalControlProblem(
        system=sr.LinearSystem(np.zeros((2, 2)), np.eye(2)),
        horizon=2.0,
        initial_state=[1.0, 0.0],
        control=sr.Box([-1, -1], [1, 1]),
        disturbance=sr.NormBall(p=p, radius=0.1, dimension=2),
        terminal=[sr.NormBall(p=p, radius=0.5, dimension=2)],
    )
    result = solved(problem, 8)
    assert result.status == "certified", result.message
    assert abs(result.cost - (1.0 - (0.5 - 0.2))) <= 1e-6


def test_an_unstable_uncertain_system_is_certified():
    system = sr.LinearSystem(lambda p: np.array([[p[0]]]), [[1.0]], parameters=sr.Box([4.999], [5.0]))
    problem = sr.OptimalControlProblem(
        system=system, horizon=3.0, initial_state=[0.1], control=sr.Box([-1], [1]), terminal=[sr.Box([-0.3], [0.3])]
    )
    result = solved(problem, 60)
    assert result.status == "certified", result.message
    assert abs(result.cost - 0.39348437901) <= 1e-7


def test_equalities_out_of_reach_are_infeasible_and_say_so():
    problem = sr.OptimalControlProblem(
        system=DOUBLE_INTEGRATOR,
        horizon=4.0,
        initial_state=[4.001, 0.0],
        control=sr.Box([-1], [1]),
        terminal=[sr.Equality([0.0, 0.0])],
    )
    result = solved(problem, 40)
    assert result.status == "infeasible"
    assert "equalities cannot be met" in result.message


def test_a_curved_set_with_one_coordinate_is_an_interval():
    """x' = -x + u + w, x0 = 2, |u| <= 2, |w| <= 0.1, |x(1)| <= 1/2: as late as possible, J = -2 ln(1 - (2/e + 0.1 (1 -
    1/e) - 1/2) / 2)."""
    problem = sr.OptimalControlProblem(
        system=sr.LinearSystem([[-1.0]], [[1.0]]),
        horizon=1.0,
        initial_state=[2.0],
        control=sr.Box([-2.0], [2.0]),
        disturbance=sr.Ellipsoid([0.0], [[0.01]]),
        terminal=[sr.Ellipsoid([0.0], [[0.25]])],
    )
    result = sr.solve(problem)
    assert result.status == "certified"
    exact = -2 * np.log(1 - (2 / np.e + 0.1 * (1 - 1 / np.e) - 0.5) / 2)
    assert exact <= result.cost <= exact * (1 + 1e-4)
