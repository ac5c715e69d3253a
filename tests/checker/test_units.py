"""Guards checker.claims.units, checker.sets.shape.excess: every component, row and direction is judged in its own
unit: no certificate of an infeasible problem is accepted, and what is honest is, in anyone's units."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from flint import arb

import sparserob_core as sr
from sparserob_core.checker.claims.case import Case
from sparserob_core.checker.claims.claims import check
from sparserob_core.checker.outcome import Clock, Finding
from sparserob_core.checker.sets.known import known
from sparserob_core.checker.sets.shape import excess
from sparserob_core.control.problem.dictionary import Dictionary

INFINITY = np.inf


def indicators(pieces: int, horizon: float) -> Dictionary:
    return Dictionary(np.linspace(0.0, horizon, pieces + 1), np.eye(pieces))


def box(lower: list[float], upper: list[float]) -> sr.Box:
    return sr.Box(np.array(lower), np.array(upper))


def still(x0: list[float], wall: sr.ConvexSet, path: bool = True) -> sr.OptimalControlProblem:
    """The first state stands still, the second one decays; both are to stay within a wall."""
    return sr.OptimalControlProblem(
        system=sr.LinearSystem(np.array([[0.0, 0.0], [0.0, -1.0]]), np.array([[0.0], [1.0]])),
        horizon=2.0,
        initial_state=np.array(x0),
        control=box([-1.0], [1.0]),
        path=[sr.PathConstraint(wall)] if path else [],
        terminal=[wall],
    )


def claims(
    problem: sr.OptimalControlProblem, decision: Any, proof: dict[str, Any], clock: Clock | None = None, **more: Any
) -> dict[str, Finding]:
    """The verdicts on a certificate that a liar wrote."""
    decision = np.array(decision, dtype=float)
    lengths = problem.horizon / decision.shape[1]
    certificate = {
        "format": 1,
        "status": "verified",
        "cost": float((np.abs(decision) * lengths * np.asarray(problem.weights)[:, None]).sum()),
        "lower_bound": 0.0,
        "gap_tolerance": 1e-7,
        "decision": decision.tolist(),
        "multipliers": {"constraints": [], "equalities": [], "pieces": None},
        "proof": proof,
        "witness": None,
        **more,
    }
    grid = indicators(decision.shape[1], problem.horizon)
    found = check(Case(problem, grid, grid, certificate, clock or Clock()), 1e-7)
    return {claim.name: claim for claim in found}


def on(*cells: tuple[list[float], list[float]]) -> dict[str, Any]:
    lower, upper = zip(*cells, strict=True)
    return {"tolerance": 1e-9, "lower": list(lower), "upper": list(upper)}


WALLS: dict[str, tuple[list[float], sr.ConvexSet]] = {
    "a small component of a box": ([9e-10, 1.0], box([-5e-10, -2.0], [5e-10, 2.0])),
    "a row that is multiplied by 1e-9": (
        [1.4, 1.0],
        sr.Polytope(np.array([[1e-9, 0.0], [-1e-9, 0.0], [0, 1.0], [0, -1.0]]), np.array([1e-9, 1e-9, 2.0, 2.0])),
    ),
    "a row that is multiplied by 1e-7, left by four parts in a thousand": (
        [1.004, 1.0],
        sr.Polytope(np.array([[1e-7, 0.0], [-1e-7, 0.0], [0, 1.0], [0, -1.0]]), np.array([1e-7, 1e-7, 2.0, 2.0])),
    ),
    "a small component of a ball of the maximum norm": (
        [3e-9, 0.0],
        sr.NormBall(p=INFINITY, radius=2e-9, centre=np.zeros(2)),
    ),
}


@pytest.mark.parametrize("name", WALLS)
def test_a_state_outside_a_wall_of_its_own_size_is_refused_whatever_stands_beside_it(name: str) -> None:
    start, wall = WALLS[name]
    found = claims(still(start, wall), np.zeros((1, 10)), {"path": on(([0.0], [2.0])), "terminal": on(([2.0], [2.0]))})
    assert found["path"].verdict == found["terminal"].verdict == "fails"
    assert found["status"].verdict == "fails"


@pytest.mark.parametrize("name", WALLS)
def test_a_state_just_inside_such_a_wall_is_accepted(name: str) -> None:
    start, wall = WALLS[name]
    inside = [0.0, start[1]] if wall.support(np.array([1.0, 0.0])) < start[0] else start
    found = claims(still(inside, wall), np.zeros((1, 10)), {"path": on(([0.0], [2.0])), "terminal": on(([2.0], [2.0]))})
    assert found["status"].verdict == "holds"


@pytest.mark.parametrize(("gauge", "verdict"), [(1.8, "fails"), (1.0 + 1e-8, "fails"), (1.0 - 1e-9, "holds")])
def test_a_thin_direction_of_an_ellipsoid_is_judged_along_its_gauge(gauge: float, verdict: str) -> None:
    thin = sr.Ellipsoid(np.zeros(2), np.diag([2.5e-19, 4.0]))
    faces = [
        ([2.0, *low], [2.0, *high])
        for axis in range(2)
        for sign in (-1.0, 1.0)
        for low, high in [np.array([[-1.0, -1.0], [1.0, 1.0]])]
        for low, high in [(np.where(np.arange(2) == axis, sign, low), np.where(np.arange(2) == axis, sign, high))]
    ]
    cells = on(*[(list(map(float, a)), list(map(float, b))) for a, b in faces])
    cells["normals"] = np.diag([2.0e9, 0.5]).tolist()
    found = claims(still([gauge * 5e-10, 0.0], thin, path=False), np.zeros((1, 10)), {"terminal": cells})
    assert found["terminal"].verdict == verdict, found["terminal"].text


def test_a_control_outside_a_small_component_is_refused_with_any_multiplier() -> None:
    """``u1`` may be 1e-9 and moves the state a billion times: 2.5 is out of reach of the set, and of no control that is
    half a range outside."""
    problem = sr.OptimalControlProblem(
        system=sr.LinearSystem(np.array([[0.0]]), np.array([[1e9, 1.0]])),
        horizon=1.0,
        initial_state=np.zeros(1),
        control=box([-1e-9, -1.0], [1e-9, 1.0]),
        terminal=[box([2.5], [INFINITY])],
    )
    decision = np.array([[1.5e-9] * 5, [1.0] * 5])
    row = {"constraint": "terminal", "time": 1.0, "parameter": [], "direction": [-1.0], "multiplier": 1e6}
    for multipliers in ([], [row]):
        found = claims(
            problem,
            decision,
            {"terminal": on(([1.0], [1.0]))},
            multipliers={"constraints": multipliers, "equalities": [], "pieces": None},
        )
        assert found["control"].verdict == found["status"].verdict == "fails"
        assert "u1" in found["control"].text


@pytest.mark.parametrize("factor", [1.0, 1e-4, 1e-8, 1e-12, 1e12])
def test_a_row_of_a_polytope_of_controls_means_the_same_at_any_factor(factor: float) -> None:
    H, h = np.array([[1.0, 0], [-1, 0], [0, 1], [0, -1], [factor, factor]]), np.array([1, 1, 1, 1, 0.5 * factor])
    shape = sr.Polytope(H, h)
    assert known(shape).units[4] == pytest.approx(0.5 * factor, rel=1e-12)
    for point, over in (([0.25, 0.25 + 1e-8], 2e-8), ([0.95, 0.95], 2.8), ([0.25, 0.2], 0.0)):
        found, where = excess(known(shape), [arb(x) for x in point])
        assert found == pytest.approx(over, rel=1e-6)
        assert where == ("row 5" if over else "")


def test_every_component_of_a_control_is_judged_in_its_own_range() -> None:
    shape = box([-1e-9, 0.0, 5.0], [1e-9, 1e6, 5.0])
    assert excess(known(shape), [arb(1.5e-9), arb(3.0), arb(5.0)])[0] == pytest.approx(0.5, rel=1e-6)
    assert excess(known(shape), [arb(0.0), arb(1e6 + 1e-3), arb(5.0)]) == (pytest.approx(1e-9, rel=1e-3), "u2")
    assert excess(known(shape), [arb(0.0), arb(0.0), arb(5.0 + 1e-12)])[0] > 1e-13


def test_states_in_units_of_a_millionth_are_judged_as_before() -> None:
    """The same physics in other units: what is outside by ``2e-9`` of its wall stays outside, what is inside inside."""
    for unit in (2.0**-60, 2.0**-20, 1.0, 2.0**20, 2.0**60):
        for wall, verdict in ((1.0 - 2e-9, "fails"), (1.0, "holds")):
            problem = sr.OptimalControlProblem(
                system=sr.LinearSystem(np.array([[-1.0]]), np.array([[unit]])),
                horizon=1.0,
                initial_state=np.array([unit]),
                control=box([-1.0], [1.0]),
                path=[sr.PathConstraint(box([-INFINITY], [wall * unit]))],
            )
            assert claims(problem, np.zeros((1, 4)), {"path": on(([0.0], [1.0]))})["path"].verdict == verdict


def test_what_is_not_decided_in_time_is_not_checked() -> None:
    found = claims(
        still([0.0, 1.0], box([-1.0, -2.0], [1.0, 2.0])),
        np.zeros((1, 10)),
        {"path": on(([0.0], [2.0])), "terminal": on(([2.0], [2.0]))},
        Clock(0.0),
    )
    assert found["path"].verdict == found["status"].verdict == "not checked"
    assert "the time limit of 0 s" in found["path"].text


def proven(apart: float) -> float:
    """The lower bound that one multiplier of the last state proves, where units differ by the square of ``apart``."""
    A, units = np.array([[0.0, 1.0, 0.3], [-2.0, -0.5, 0.2], [0.4, 0.1, -1.0]]), np.array([1.0, apart, 1.0 / apart])
    problem = sr.OptimalControlProblem(
        system=sr.LinearSystem(units[:, None] * A / units, (units * [0.0, 1.0, 0.5])[:, None]),
        horizon=2.0,
        initial_state=units * [1.0, 0.5, 0.2],
        control=box([-1.0], [1.0]),
        terminal=[sr.Box(np.array([-1.0, -1.0, -0.01]) * units, np.array([1.0, 1.0, 0.01]) * units)],
    )
    row = {"constraint": "terminal", "time": 2.0, "parameter": [], "direction": [0.0, 0.0, 1.0 / units[2]]}
    multipliers = {"constraints": [{**row, "multiplier": 1.3}], "equalities": [], "pieces": None}
    nothing = {"tolerance": 1e-9, "lower": [], "upper": []}
    found = claims(problem, np.zeros((1, 4)), nothing, multipliers=multipliers, lower_bound=1e3)["lower bound"]
    return float(found.text.split("prove ")[1])


@pytest.mark.parametrize("apart", [2.0**20, 2.0**40])
def test_a_lower_bound_is_derived_as_sharply_where_the_units_of_states_are_far_apart(apart):
    """The exponential's entries then differ by the fourth power of ``apart``."""
    assert proven(1.0) > 0.01
    assert proven(apart) == pytest.approx(proven(1.0), rel=1e-15)
