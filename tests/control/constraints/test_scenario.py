"""Guards control/constraints/scenario: the worst of finitely many samples, by hand and sample by sample."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

import sparserob_core as sr
from sparserob_core.control.constraints import scenario
from sparserob_core.control.constraints.flat import FlatConstraint, Samples
from sparserob_core.control.constraints.scenario import ScenarioConstraint
from sparserob_core.control.problem.system import LinearSystem
from sparserob_core.control.response.parameters import ParameterIndex
from sparserob_core.control.sets.sets import Box
from sparserob_core.sip.expressions.expression import parse_matrix
from tests.support.plants import uniform, worst_case

ONE = np.ones((1, 1))
SIDES, LIMITS = np.array([[1.0], [-1.0]]), np.array([2.0, 1.0])


def flat(system, bound=None, start=0.0, stop=2.0):
    functionals = worst_case(system, uniform(2, 2.0), None, bound, initial_state=[1.0])
    return FlatConstraint("wall", functionals, SIDES, LIMITS, start, stop, ParameterIndex(system.parameters))


@pytest.mark.parametrize("block", [1, 3, scenario.MAX_VIOLATIONS_PER_BLOCK])
def test_the_worst_of_sampled_disturbances_is_by_hand(block, monkeypatch):
    """``x' = u + w`` from 1: 1.5 + 0.2 at 1 and 1.25 + 0.5 at 2 under the second;
    the least is 1.25 - 0.6 under the third."""
    monkeypatch.setattr(scenario, "MAX_VIOLATIONS_PER_BLOCK", block)
    base = flat(LinearSystem(np.zeros((1, 1)), ONE, E=ONE), Box([-0.5], [0.5]))
    samples = np.array([[[0.0, 0.0]], [[0.2, 0.3]], [[-0.1, -0.5]]])
    made = ScenarioConstraint(base, SIDES, LIMITS, samples, np.zeros((3, 0)))
    x = np.array([0.5, -0.25])
    found = made.worst(x)
    assert found.violations[0] == pytest.approx(1.75 - 2.0)
    assert found.indices[0].tolist() == [2.0, 1.0]
    assert found.rows[0] == 0
    lowest = found.violations[found.rows == 1].max()
    assert lowest == pytest.approx(-0.65 - 1.0)
    family = made.family()
    assert family.formulation == "sampled"
    assert family.index_set.upper.tolist() == [2.0, 2.0]
    assert family.explanation(np.array([2.0, 1.0]), 0).text == "wall: x1(2) <= 2 (sample 1)"
    for index, values in (((1.0, 1.0), (1.7, -1.7)), ((0.5, 2.0), (1.2, -1.2)), ((2.0, 0.0), (1.25, -1.25))):
        assert family.violations(x, np.array([index]))[0] == pytest.approx(np.array(values) - LIMITS)
    moved = replace(made, deviations=np.array([[0.0], [0.1], [-0.2]]))
    assert moved.worst(x).violations[0] == pytest.approx(1.85 - 2.0)
    assert moved.family().violations(x, np.array([[2.0, 2.0]]))[0] == pytest.approx([0.45 - 2.0, -0.45 - 1.0])
    early = replace(made, base=flat(LinearSystem(np.zeros((1, 1)), ONE, E=ONE), Box([-0.5], [0.5]), 0.0, 1.0))
    assert early.worst(x).violations[0] == pytest.approx(1.7 - 2.0)


@pytest.mark.parametrize("second", [1.0, 1e3])
def test_what_samples_ask_for_is_told_by_names_in_the_units_of_the_problem(second: float) -> None:
    """A plane that 0.1 per second of disturbance moves out of reach, in any unit of time."""
    system = LinearSystem(np.zeros((1, 1)), ONE / second, E=ONE / second)
    names = sr.Names(states=["height"], state_units=["m"], time="s")
    problem = sr.OptimalControlProblem(
        system=system, horizon=second, initial_state=[5.0], control=Box([-1.0], [1.0]), names=names,
        disturbance=Box([-0.1], [0.1]), terminal=[Box([-0.2], [0.2])],
    )  # fmt: skip
    pieces = {"name": "piecewise_constant", "pieces": 2}
    result = sr.solve(problem, {"name": "scenario", "scenarios": 5}, control=pieces, disturbance=pieces)
    assert result.status == "infeasible"
    assert f"terminal: height({second:g}) <= 0.2 m (sample " in result.message


@pytest.mark.parametrize("block", [1, 7, scenario.MAX_VIOLATIONS_PER_BLOCK])
def test_the_worst_of_sampled_parameters_is_by_hand(block, monkeypatch):
    """``x' = p x``: ``e^(2 p)`` at the end."""
    monkeypatch.setattr(scenario, "MAX_VIOLATIONS_PER_BLOCK", block)
    system = LinearSystem(parse_matrix("A", [["p1"]], ("p1",)), ONE, parameters=Box([-0.5], [0.5]))
    made = ScenarioConstraint(flat(system), SIDES, LIMITS, None, np.array([[0.1], [0.3], [-0.2], [0.25]]))
    found = made.worst(np.zeros(2))
    assert found.violations[0] == pytest.approx(np.exp(0.6) - 2.0)
    assert found.indices[0].tolist() == [2.0, 1.0]
    assert (np.diff(found.violations) <= 0.0).all()


def test_tables_serve_the_constraint_that_they_were_made_for_only():
    system = LinearSystem(np.zeros((1, 1)), ONE, E=ONE)
    first = flat(system, Box([-0.5], [0.5]))
    looked_at = Samples(first.functionals, first.H, first.h, (0.0, 2.0), first.parameters)
    assert looked_at.serve(first)
    assert looked_at.proven == 2
    for other in (
        replace(first, H=SIDES.copy()),
        replace(first, h=LIMITS.copy()),
        replace(first, start=0.5),
        replace(first, stop=1.0),
        replace(first, parameters=ParameterIndex(None)),
        flat(system, Box([-0.5], [0.5])),
    ):
        assert not looked_at.serve(other)
