"""Guards the gap: it is that of the bounds, whatever the bounds of the control; where it is open nothing is certified,
and what need not act costs exactly nothing."""

from __future__ import annotations

from dataclasses import replace
from fractions import Fraction
from typing import Any

import numpy as np
import pytest

import sparserob_core as sr
from tests.support.independent import Problem, enclosed_value
from tests.support.instances import config, instance

SPRING = np.array([[0.0, 1.0], [-2.0, -0.5]])
TEN = sr.Dictionary.indicators(np.linspace(0.0, 5.0, 11))


def spring(control: sr.ConvexSet, B: Any = ((0.0,), (1.0,)), **more: Any) -> sr.OptimalControlProblem:
    """A spring that is pushed, from (-1, 1), with a wall from 0.3 on and a box at the end."""
    stated = {
        "system": sr.LinearSystem(SPRING, np.array(B)),
        "horizon": 5.0,
        "initial_state": [-1, 1],
        "control": control,
        "disturbance": sr.Box([-0.05, -0.05], [0.05, 0.05]),
        "path": [sr.PathConstraint(sr.Box([-0.7, -np.inf], [0.7, np.inf]), start=0.3)],
        "terminal": [sr.Box([-0.3, -0.3], [0.3, 0.3])],
    }
    return sr.OptimalControlProblem(**{**stated, **more})


def box(*sizes: float) -> sr.Box:
    return sr.Box([-size for size in sizes], list(sizes))


TWO = ((0.0, 0.3), (1.0, 0.2))
WIDE = {
    "one channel": lambda far: spring(box(far)),
    "two channels": lambda far: spring(box(far, far), TWO),
    "one of two": lambda far: spring(box(1.0, far), TWO),
    "one that is of little use": lambda far: spring(box(4.0, far), ((0.0, 0.0), (1.0, 1e-3))),
    "a ball": lambda far: spring(sr.NormBall(2, far, dimension=2), TWO),
    "steps": lambda far: spring(box(far), control_step=box(1.0)),
    "a quadratic cost": lambda far: spring(box(far), cost=sr.Cost(control={"R": [[0.1]]})),
    "a state that costs": lambda far: spring(box(far), cost=sr.Cost(state={"Q": np.eye(2)})),
}


LIGHT = ("a ball",)  # the others for the second stage


@pytest.mark.parametrize(
    "kind", [kind if kind in LIGHT else pytest.param(kind, marks=pytest.mark.slow) for kind in WIDE]
)
def test_bounds_of_the_control_that_are_far_away_change_nothing(kind):
    near = sr.solve(WIDE[kind](10.0), control=TEN)
    assert near.status == "certified"
    for far in (1e9, 1e12):
        found = sr.solve(WIDE[kind](far), control=TEN)
        assert found.status == "certified", found.message
        assert found.lower_bound <= near.upper_bound and near.lower_bound <= found.upper_bound
        assert found.upper_bound == pytest.approx(near.upper_bound, rel=1e-6)


@pytest.mark.parametrize("far", [1e8, 1e12])
def test_a_wide_control_has_the_value_of_an_independent_linear_program(far):
    fine = Problem(
        A=SPRING,
        B=np.array([[0.0], [1.0]]),
        initial_state=np.array([-1.0, 1.0]),
        horizon=5.0,
        pieces=10,
        control=np.array([1e3]),
        weights=np.ones(1),
        disturbance=np.array([0.05, 0.05]),
        terminal=np.array([0.3, 0.3]),
        path=[(np.array([0.7, np.inf]), 0.3, 5.0)],
    )
    least, most = enclosed_value(fine, per_piece=256)
    found = sr.solve(spring(box(far)), control=TEN)
    assert found.status == "certified"
    assert least <= found.upper_bound * (1 + 1e-8) and found.lower_bound <= most * (1 + 1e-8)
    assert most - least <= 1e-2 * most
    proven = {proof.family: float(proof.units.max()) for proof in found.proofs}
    assert max(proven.values()) <= 0.7  # a wall is judged by itself, not by how far the control may go


@pytest.mark.first(4)
@pytest.mark.parametrize("far", [1.0, 1e12])
@pytest.mark.parametrize("policy", [None, "nominal", "peak", "worst"])
def test_what_need_not_act_costs_exactly_nothing(far, policy):
    still = spring(box(far), initial_state=[0.1, 0.0], path=[])
    found = sr.solve(still, control=TEN, policy=sr.OpenLoop() if policy is None else sr.AffinePolicy(cost=policy))
    assert (found.status, found.lower_bound, found.upper_bound, found.gap) == ("certified", 0.0, 0.0, 0.0)


@pytest.mark.first(2)
@pytest.mark.parametrize("pieces", ["piecewise_constant", "haar", "walsh", "a policy of innovations"])
def test_a_run_in_which_nothing_need_be_done_writes_bounds_of_exactly_zero(pieces, tmp_path):
    """Where an exact bound of 0 is rounded downwards once more, the gap is 1."""
    policy = {"name": "affine", "cost": "peak"} if pieces.startswith("a policy") else None
    name = "piecewise_constant" if policy else pieces
    stated = {
        "problem": {
            "name": "linear",
            "system": {"A": SPRING.tolist(), "B": [[0.0, 0.3], [1.0, 0.2]]},
            "horizon": 3.7,
            "initial_state": [0.1, -0.07],
            "weights": [0.55, 1.82],
            "control": {"box": [2e5, 9.9]},
            "disturbance": {"ellipsoid": {"shape": [[1e-4, 2e-5], [2e-5, 3e-4]]}},
            "terminal": [{"box": [None, 0.5]}],
        },
        "dictionaries": {
            "control": {"name": name, "pieces": 8},
            "disturbance": {"name": "piecewise_constant", "pieces": 8},
        },
        **({"policy": policy} if policy else {}),
    }
    result = sr.run(stated, out=tmp_path / "run", quiet=True, figures=False).result
    assert (result.status, result.lower_bound, result.upper_bound, result.gap) == ("certified", 0.0, 0.0, 0.0)
    assert [claim.verdict for claim in sr.check(tmp_path / "run").claims if claim.verdict != "holds"] == []


@pytest.mark.parametrize("number", [700002, pytest.param(700125, marks=pytest.mark.slow)])
def test_dust_in_coefficients_of_waves_is_put_to_exactly_zero(number):
    """Least squares of images that are all dust left 1e-29, a cost of 1e-34 and so a gap of 1."""
    result = sr.run(config(*instance(number)), quiet=True, figures=False).result
    assert (result.status, result.lower_bound, result.upper_bound, result.gap) == ("certified", 0.0, 0.0, 0.0)
    assert not result.decision.any()


SQUARES = {"control": {"R": [[2.0]]}, "l1": 0.0}, {"state": {"Q": [[1.0, 0.0], [0.0, 0.5]]}, "l1": 0.0}


@pytest.mark.parametrize("policy", [None, pytest.param("nominal", marks=pytest.mark.slow)])
@pytest.mark.parametrize("cost", SQUARES, ids=["of the control", "of the state"])
def test_squares_that_need_not_be_anything_cost_exactly_nothing(policy, cost, tmp_path):
    """Solvers leave dust of a decision whose squares are to be 0, and no relative gap is closed at 1e-10."""
    stated = {
        "problem": {
            "name": "linear",
            "system": {"A": SPRING.tolist(), "B": [[0.0], [1.0]], "E": [[0.0], [1.0]]},
            "horizon": 2.0,
            "initial_state": [0.1, 0.0] if "control" in cost else [0.0, 0.0],
            "control": {"box": [1.0]},
            "disturbance": {"box": [0.01]},
            "terminal": [{"box": [1.0, 1.0]}],
            "cost": cost,
        },
        "dictionaries": {
            "control": {"name": "piecewise_constant", "pieces": 4},
            "disturbance": {"name": "piecewise_constant", "pieces": 4},
        },
        **({"policy": {"name": "affine", "cost": policy}} if policy else {}),
    }
    result = sr.run(stated, out=tmp_path / "run", quiet=True, figures=False).result
    assert (result.status, result.lower_bound, result.upper_bound, result.gap) == ("certified", 0.0, 0.0, 0.0)
    assert [claim.verdict for claim in sr.check(tmp_path / "run").claims if claim.verdict != "holds"] == []


@pytest.mark.first(1)
@pytest.mark.parametrize(("spare", "status"), [(0.0, "verified"), (1e-6, "certified"), (1e-9, None)])
def test_squares_that_cancel_are_certified_where_what_is_left_is_no_rounding(spare, status, tmp_path):
    """Along ``u_1 = 7/3 u_2`` the cost ``R`` is 0 but for rounding, and the control has to go there: -7e-19 was written
    of what costs 8e-19 and certified, and `check` refused costs that are off by the rounding of their products."""
    R = [[0.09 + spare, -0.21], [-0.21, 0.49]]
    stated = {
        "problem": {
            "name": "linear",
            "system": {"A": [[0.0, 0.0], [0.0, 0.0]], "B": [[1.0, 0.0], [0.0, 1.0]]},
            "horizon": 1.0,
            "initial_state": [0.7, 0.3],
            "control": {"box": [5.0, 5.0]},
            "terminal": [{"box": [1e-3, 1e-3]}],
            "cost": {"l1": 0.0, "control": {"R": R}},
        },
        "dictionaries": {"control": {"name": "piecewise_constant", "pieces": 4}},
    }
    result = sr.run(stated, out=tmp_path / "run", quiet=True, figures=False).result
    u, exact = result.decision.reshape(2, 4).tolist(), [[Fraction(entry) for entry in row] for row in R]
    cost = sum(
        exact[i][j] * Fraction(u[i][k]) * Fraction(u[j][k]) / 4 for i in range(2) for j in range(2) for k in range(4)
    )
    assert 0.0 <= result.lower_bound <= result.cost <= cost + Fraction(1e-15)
    assert result.status in ((status,) if status else ("certified", "verified"))
    if result.status == "certified":
        assert cost - Fraction(result.lower_bound) <= Fraction(1e-6) * cost
    assert [claim.verdict for claim in sr.check(tmp_path / "run").claims if claim.verdict != "holds"] == []


@pytest.mark.slow
def test_squares_of_a_random_instance_that_solvers_leave_at_1e_90_are_exactly_zero():
    result = sr.run(config(*instance(3400141)), {"solver.name": "clarabel"}, quiet=True, figures=False).result
    assert (result.status, result.lower_bound, result.upper_bound, result.gap) == ("certified", 0.0, 0.0, 0.0)


@pytest.mark.first(11)
@pytest.mark.parametrize("seed", range(8))
@pytest.mark.parametrize("tolerance", [1e-7, 1e-9])
def test_a_policy_of_one_state_is_certified_at_the_tolerance_that_is_asked_for(seed, tolerance):
    rng = np.random.default_rng(seed)
    edges = np.concatenate([[0.0], np.sort(rng.uniform(0.1, 1.1, 4)), [1.2]])
    problem = sr.OptimalControlProblem(
        system=sr.LinearSystem([[rng.uniform(-0.6, 0.6)]], [rng.uniform(0.8, 1.6, 2)], [[rng.uniform(0.8, 1.6)]]),
        horizon=1.2,
        initial_state=[1.1],
        control=sr.Box([-0.5, -1.1], [0.9, 0.3]),
        disturbance=sr.Box([-0.02], [0.04]),
        terminal=[sr.Box([1.5], [1.6])],
    )
    cost = ("peak", "nominal")[seed % 2]
    found = sr.solve(
        problem, control=sr.Dictionary.indicators(edges), policy=sr.AffinePolicy(cost=cost), tolerance=tolerance
    )
    assert found.status == "certified", found.message
    assert found.upper_bound - found.lower_bound <= tolerance * found.upper_bound


@pytest.mark.parametrize("unit", [1e-6, 1.0, 1e6])
def test_a_cost_far_below_the_largest_is_not_certified_by_the_largest(unit):
    small = replace(spring(box(unit)), system=sr.LinearSystem(SPRING, [[0.0], [1.0 / unit]]))
    barely = replace(small, initial_state=[0.7 / 0.9, 0.0], path=[], disturbance=None)
    found = sr.solve(barely, control=TEN)
    apart = found.upper_bound - found.lower_bound
    assert (found.status == "certified") == (apart <= 1e-7 * found.upper_bound)
