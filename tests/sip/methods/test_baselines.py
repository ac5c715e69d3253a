"""Guards sip/methods/baselines: the baselines: what the scenario theory promises, and what the worst case says to
it."""

from __future__ import annotations

import json
from fractions import Fraction
from math import comb, log

import numpy as np
import pytest

import sparserob_core as sr
from sparserob_core.sip.scenario_bound import bound_after, bound_before, scenario_bound
from sparserob_core.sip.separation.separation import separate

OSCILLATOR = {
    "name": "linear",
    "system": {"A": [[0, 1], ["-1 - p", 0]], "B": [[0], [1]], "parameters": {"p": [-0.19, 0.21]}},
    "horizon": 6.0,
    "initial_state": [1, 0],
    "control": {"box": 1.0},
    "terminal": [{"box": [0.6, None]}],
}
PUSHED = {
    "name": "linear",
    "system": {"A": [[0, 1], [0, 0]], "B": [[0], [1]]},
    "horizon": 5.0,
    "initial_state": [4, 0],
    "control": {"box": 1.0},
    "disturbance": {"box": [0.02, 0.02]},
    "terminal": [{"box": [0.5, 0.3]}],
}


def solved(problem, method, tmp_path, **more):
    config = {
        "problem": problem,
        "dictionaries": {"control": {"name": "piecewise_constant", "pieces": 50}},
        "method": method,
        **more,
    }
    return sr.run(config, out=tmp_path / "run", figures=False)


@pytest.mark.parametrize(("scenarios", "variables"), [(20, 3), (100, 10), (300, 40), (7, 7)])
@pytest.mark.parametrize("beta", [0.1, 1e-6])
def test_the_bound_before_is_the_root_of_the_printed_sum(scenarios, variables, beta):
    epsilon = Fraction(bound_before(scenarios, variables, beta))
    tail = sum(comb(scenarios, i) * epsilon**i * (1 - epsilon) ** (scenarios - i) for i in range(variables))
    assert float(tail) == pytest.approx(beta, rel=1e-6)


@pytest.mark.first(5)
@pytest.mark.parametrize(("scenarios", "support"), [(20, 0), (20, 3), (100, 10), (300, 40), (7, 6), (500, 2)])
@pytest.mark.parametrize("beta", [0.1, 1e-6])
def test_the_bound_after_is_the_root_of_the_printed_polynomial(scenarios, support, beta):
    def polynomial(t):
        left = (
            Fraction(beta)
            / (scenarios + 1)
            * sum(comb(m, support) * t ** (m - support) for m in range(support, scenarios + 1))
        )
        return left - comb(scenarios, support) * t ** (scenarios - support)

    t = 1 - Fraction(bound_after(scenarios, support, beta))
    step = (1 - t) / 10**6
    assert polynomial(t - step) > 0 > polynomial(t + step)


@pytest.mark.parametrize("beta", [0.3, 1e-3, 1e-9])
def test_one_variable_has_the_closed_form_of_the_largest_of_many_numbers(beta):
    assert bound_before(400, 1, beta) == pytest.approx(1.0 - beta ** (1 / 400), rel=1e-9)


@pytest.mark.parametrize(
    ("epsilon", "beta", "variables"), [(0.1, 1e-10, 1), (0.05, 1e-6, 10), (0.01, 1e-6, 250), (0.2, 1e-3, 5)]
)
def test_the_published_sufficient_numbers_of_scenarios_are_enough(epsilon, beta, variables):
    campi_garatti_prandini_2009 = int(np.ceil(2 / epsilon * (log(1 / beta) + variables)))
    alamo_tempo_luque_2010 = int(np.ceil(np.e / (np.e - 1) / epsilon * (log(1 / beta) + variables - 1)))
    for enough in (campi_garatti_prandini_2009, alamo_tempo_luque_2010):
        assert bound_before(enough, variables, beta) <= epsilon
    assert bound_before(campi_garatti_prandini_2009 // 4, variables, beta) > epsilon


def test_the_bound_before_is_attained_where_every_variable_has_its_support_constraint():
    """The shortest interval that holds S uniform numbers: two variables, two support constraints, and the violation is
    1 - length."""
    drawn, scenarios, beta = np.random.default_rng(0).random((40_000, 30)), 30, 0.1
    violation = 1.0 - (drawn.max(axis=1) - drawn.min(axis=1))
    assert np.mean(violation > bound_before(scenarios, 2, beta)) == pytest.approx(beta, abs=0.006)
    assert np.mean(violation > bound_after(scenarios, 2, beta)) <= beta


def test_the_bound_after_grows_with_the_support_and_shrinks_with_the_scenarios():
    by_support = [bound_after(200, k) for k in range(201)]
    assert all(np.diff(by_support) >= 0.0)
    assert by_support[-1] == 1.0
    assert all(np.diff([bound_after(s, 3) for s in (10, 100, 1000, 10_000, 100_000)]) < 0.0)


def test_too_few_scenarios_promise_nothing_and_the_sentence_says_so():
    bound = scenario_bound(100, 250, 100)
    assert (bound.before, bound.after) == (1.0, 1.0)
    assert "nothing from the 250 decision variables alone, for which these are too few scenarios" in bound.sentence


@pytest.mark.parametrize(
    "arguments", [(0, 1), (10, 0), (10, 1.5), (True, 1), (10, 1, 0.0), (10, 1, 1.0), (10, 1, float("nan"))]
)
def test_counts_and_probabilities_that_make_no_sense_are_named(arguments):
    with pytest.raises(sr.InputError, match=r"scenarios:|variables:|beta:"):
        bound_before(*arguments)


def test_a_scenario_result_tells_the_bound_beside_the_worst_violation(tmp_path):
    outcome = solved(PUSHED, {"name": "scenario", "scenarios": 300}, tmp_path)
    result, bound = outcome.result, outcome.result.scenario_bound
    assert result.status == "refuted"
    assert result.worst.violation == pytest.approx(0.25, abs=0.05)
    assert bound.support == sum(cut.multiplier > 0 for cut in result.indices) < bound.variables == 50
    assert bound.after < bound.before < 1.0
    assert f"terminal is violated by {result.worst.violation:.4g}; " in result.message
    assert "a probability under the sampling law and does not bound the worst case" in result.message
    written = json.loads((outcome.directory / "result.json").read_text())["scenario_bound"]
    assert written == {
        "scenarios": 300,
        "variables": 50,
        "support": bound.support,
        "beta": 1e-6,
        "before": bound.before,
        "after": bound.after,
    }


def test_fresh_draws_break_the_scenario_decision_no_more_often_than_the_bound(tmp_path):
    from sparserob_core.control.constraints.scenario import sample_disturbances

    outcome = solved(PUSHED, {"name": "scenario", "scenarios": 300}, tmp_path)
    model = outcome.experiment.transcription
    drawn = sample_disturbances(model.functionals.disturbance, 5000, np.random.default_rng(5))
    states = model.response.states(model.pieces(outcome.result.decision), np.zeros((5000, 0)), drawn)
    share = np.mean((np.abs(states[:, -1]) > [0.5, 0.3]).any(axis=1))
    assert 0.0 < share < outcome.result.scenario_bound.after


@pytest.mark.first(1)
@pytest.mark.parametrize(
    "method", [{"name": "nominal"}, {"name": "scenario", "scenarios": 5}], ids=lambda method: method["name"]
)
def test_the_worst_parameter_of_a_baseline_is_the_worst_that_can_be_found(method, tmp_path):
    outcome = solved(OSCILLATOR, method, tmp_path)
    result = outcome.result
    assert result.status == "refuted"
    lattice = np.stack([np.full(2001, 6.0), np.linspace(-0.19, 0.21, 2001)], axis=1)
    (family,) = outcome.program.families
    assert result.worst.violation >= family.violations(result.decision, lattice).max() - 1e-9
    assert result.worst.violation == pytest.approx(
        separate(outcome.program, result.decision, sr.Tools(solver=None))[0][1].violations[0]
    )


def test_a_proven_scenario_decision_needs_no_probability(tmp_path):
    certain = {**PUSHED, "disturbance": None}
    result = solved(certain, {"name": "scenario", "scenarios": 10}, tmp_path).result
    assert result.status == "certified"
    assert "probability" not in result.message
