"""Guards experiment/initial_states under feedback: the initial states from which an affine policy exists, against
linear programs written without the package, single runs, and closed loops driven by extreme disturbances."""

from __future__ import annotations

import json
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.linalg import expm

import sparserob_core as sr
from sparserob_core.control.studies.initial_states import InitialPlane
from sparserob_core.control.transcription.transcribe import prepare
from tests.support.plants import uniform
from tests.support.policy_programs import PolicyProgram

A, B = np.array([[0.0, 1.0], [-2.0, -0.5]]), np.array([[0.0], [1.0]])
SIDE, WIDE, HORIZON, PIECES = 0.5, 0.1, 3.0, 6
SPRING: dict[str, Any] = {
    "name": "linear",
    "system": {"A": A.tolist(), "B": B.tolist()},
    "horizon": HORIZON,
    "initial_state": [0.5, 0.0],
    "control": {"box": 1.0},
    "disturbance": {"box": [WIDE, WIDE]},
    "terminal": [{"box": [SIDE, SIDE]}],
}
OFF = {"name": "open_loop"}


def config(problem: dict[str, Any], policy: dict[str, Any] | None = None) -> dict[str, Any]:
    return {
        "problem": problem,
        "dictionaries": {"control": {"name": "piecewise_constant", "pieces": PIECES}},
        "policy": policy or {"name": "affine", "causal_signals": 0},
        "observers": [],
    }


def least(x0: np.ndarray) -> float:
    """The cost of the best policy, by a linear program of its own: exact, for only the end is constrained."""
    none = np.zeros(2)
    program = PolicyProgram(A, B, np.eye(2), x0, HORIZON, PIECES, np.array([WIDE, WIDE]), none)
    for row in program.state(HORIZON):
        program.below(row, SIDE)
        program.below(-row, SIDE)
    return program.solve(1.0, "nominal")


def status(problem: dict[str, Any], x0: np.ndarray, out: Path) -> str:
    start = problem["initial_state"]
    begun = {**start, "centre": x0.tolist()} if isinstance(start, dict) else x0.tolist()
    return sr.run(config({**problem, "initial_state": begun}), out=out, quiet=True, figures=False).status


def beyond(found: sr.InitialStates, direction: np.ndarray, far: float) -> np.ndarray:
    """A point outside of the half-plane whose normal is nearest to a direction."""
    at = int((found.directions @ direction).argmax())
    vertex = found.inner[int((found.inner @ found.directions[at]).argmax())]
    short = found.bounds[at] - found.directions[at] @ vertex
    return vertex + (short + far) * found.directions[at]


def within(found: sr.InitialStates, points: np.ndarray) -> bool:
    """Whether no half-plane shuts points out by more than what a proof allows."""
    return bool((points @ found.directions.T <= found.bounds + 1e-8 * np.abs(found.bounds)).all())


@pytest.fixture(scope="module")
def spring() -> sr.InitialStates:
    return sr.initial_states(config(SPRING), directions=16, values=2)


@pytest.mark.slow
def test_linear_programs_of_their_own_say_the_same_on_both_sides_of_the_boundary(spring: sr.InitialStates) -> None:
    assert spring.status in ("certified", "verified")
    assert len(spring.inner) >= 8
    for vertex in spring.inner[::2]:
        assert np.isfinite(least((1 - 1e-5) * vertex))
    for direction in ([1, 0], [0, 1], [-1, 0.5], [0.3, -1]):
        assert least(beyond(spring, np.array(direction), 1e-4)) == np.inf


@pytest.mark.slow
def test_costs_are_those_of_linear_programs_of_their_own(spring: sr.InitialStates) -> None:
    assert len(spring.costs) >= 4
    for point, cost, lower in zip(spring.points[:4], spring.costs, spring.lower_bounds, strict=False):
        assert lower <= cost + 1e-9
        assert cost == pytest.approx(least(point), rel=1e-5, abs=1e-6)


@pytest.mark.slow
def test_a_symmetric_problem_has_a_symmetric_set(spring: sr.InitialStates) -> None:
    assert within(spring, -spring.inner)
    np.testing.assert_allclose(spring.outer.max(axis=0), -spring.outer.min(axis=0), atol=1e-6)


@pytest.mark.slow
def test_whoever_measures_starts_from_more_states_than_one_who_plans(spring: sr.InitialStates) -> None:
    plan = sr.initial_states(config(SPRING, OFF), directions=16, values=0)
    assert within(spring, plan.inner)
    assert spring.inner_area > plan.outer_area
    assert any(plan.where(vertex) == "outside" for vertex in spring.inner)


@pytest.mark.slow
def test_without_a_disturbance_feedback_changes_nothing() -> None:
    still = {key: value for key, value in SPRING.items() if key != "disturbance"}
    answered, planned = (sr.initial_states(config(still, policy), directions=8, values=0) for policy in (None, OFF))
    assert within(answered, planned.inner) and within(planned, answered.inner)


def test_combined_policies_meet_extreme_disturbances(spring: sr.InitialStates) -> None:
    """The closed loop is driven step by step, with the innovations that the definition says."""
    h = HORIZON / PIECES
    both = expm(np.block([[A, np.eye(2)], [np.zeros((2, 4))]]) * h)
    Phi, Gamma = both[:2, :2], both[:2, 2:]
    corners = WIDE * np.array(list(product((-1.0, 1.0), repeat=2)))
    rng = np.random.default_rng(3)
    for share in (0.0, 0.9, 1.0 - 1e-6):
        start = share * spring.inner[0]
        v, gains = spring.policy(start)
        assert gains.shape == (PIECES, PIECES, 1, 2)
        np.testing.assert_array_equal(v, spring.control(start))
        signals = corners[rng.integers(0, 4, size=(500, PIECES))]
        for w in signals:
            x, seen = start.copy(), [np.zeros(2)]
            for k in range(PIECES):
                u = v[:, k] + sum(gains[k, j] @ seen[j] for j in range(k + 1))
                assert np.abs(u).max() <= 1 + 1e-8
                expected = Phi @ x + Gamma @ B @ u
                x = expected + Gamma @ w[k]
                seen.append(x - expected)
            assert np.abs(x).max() <= SIDE + 1e-8


KINDS: dict[str, dict[str, Any]] = {
    "a path": {**SPRING, "path": [{"box": [1.2, None]}]},
    "a round disturbance": {
        **SPRING,
        "disturbance": {"ellipsoid": {"centre": [0, 0], "shape": [[0.01, 0], [0, 0.01]]}},
    },
    "a mixed constraint and steps": {
        **SPRING,
        "path": [{"mixed": {"H": [[0, 0.5], [0, -0.5]], "G": [[1], [-1]], "h": 1.0}}],
        "control_step": {"box": 0.8},
    },
    "a box about every initial state": {**SPRING, "initial_state": {"centre": [0.5, 0.0], "box": [0.1, 0.1]}},
    "fixed final states": {
        **SPRING,
        "system": {"A": A.tolist(), "B": B.tolist(), "E": [[0], [1]]},
        "disturbance": None,
        "terminal": [{"equals": [0, 0]}],
    },
}


@pytest.mark.slow
@pytest.mark.parametrize("name", KINDS)
def test_runs_are_certified_inside_and_infeasible_outside(name: str, tmp_path: Path) -> None:
    problem = {key: value for key, value in KINDS[name].items() if value is not None}
    found = sr.initial_states(config(problem), directions=8, values=0)
    assert found.status in ("certified", "verified")
    assert not found.remarks
    middle = found.inner.mean(axis=0)
    for number, vertex in enumerate(found.inner[::3]):
        assert status(problem, middle + 0.999 * (vertex - middle), tmp_path / f"in{number}") == "certified"
    for number, direction in enumerate(np.array([[1.0, 0.2], [-0.4, 1.0]])):
        assert status(problem, beyond(found, direction, 1e-3), tmp_path / f"out{number}") == "infeasible"


@pytest.mark.slow
def test_a_basis_from_which_the_solver_finds_no_way_is_given_up() -> None:
    """In one of these programs HiGHS ends with "unknown" where it goes on from the last basis, not from none."""
    disturbance = {"ellipsoid": {"centre": [0, 0], "shape": [[0.04, 0], [0, 0.04]]}}
    hard = {"horizon": 5.0, "path": [{"box": [1.5, None]}], "terminal": [{"box": [0.3, 0.3]}]}
    found = sr.initial_states(config({**SPRING, **hard, "disturbance": disturbance}), directions=4, values=0)
    assert not found.remarks
    assert len(found.inner) >= 3


@pytest.mark.first(1)
@pytest.mark.parametrize("cost", ["nominal", "peak"])
def test_a_plane_under_feedback_agrees_with_the_problem_transcribed_afresh(cost: str) -> None:
    def problem(x0: np.ndarray) -> sr.OptimalControlProblem:
        return sr.OptimalControlProblem(
            system=sr.LinearSystem(A=A, B=B),
            horizon=2.0,
            initial_state=x0,
            control=sr.Box([-1], [1]),
            disturbance=sr.Box([-0.05, -0.02], [0.05, 0.08]),
            path=[sr.PathConstraint(sr.Box([-1, -9], [1, 9]), 0.0)],
            terminal=[sr.Box([-0.5, -0.5], [0.5, 0.5])],
        )

    control, policy = uniform(4, 2.0), sr.AffinePolicy(cost=cost)  # type: ignore[arg-type]
    begun = prepare(problem(np.zeros(2)), control, control, policy=policy)
    plane = InitialPlane(begun, (0, 1), np.array([0.2, -0.1]), np.array([2.0, 3.0]))
    joined = plane.support(np.array([1.0, 0.0]))
    rng = np.random.default_rng(5)
    for z in rng.uniform(-1, 1, (3, 2)):
        fresh = prepare(problem(plane.point(z)), control, control, policy=policy).program
        x = rng.normal(size=fresh.n)
        for known, moved in zip(fresh.families, plane.at(z).families, strict=True):
            assert known.start is not None
            np.testing.assert_allclose(moved.violations(x, known.start), known.violations(x, known.start), atol=1e-12)
        y = np.append(x[: joined.n - 2], z)
        for family in joined.families:
            known = fresh.family(family.name)
            assert known.start is not None and family.uncertain is not None and joined.spread is not None
            expected = known.violations(x, known.start)
            for index, violations in zip(known.start, expected, strict=True):
                rows = family.uncertain(index)
                np.testing.assert_allclose(rows.excess(y, joined.spread), violations, atol=1e-12)
            lower, upper = known.cells or (np.zeros((0, 1)), np.zeros((0, 1)))
            assert known.enclosure is not None and family.enclosure is not None
            proven = family.enclosure(y, lower, upper).bounds
            np.testing.assert_allclose(proven, known.enclosure(x, lower, upper).bounds, atol=1e-9)


def test_too_much_disturbance_leaves_no_initial_state_with_its_reason() -> None:
    found = sr.initial_states(config({**SPRING, "disturbance": {"box": [2.0, 2.0]}}), directions=8, values=0)
    assert found.status == "infeasible"
    assert "for affine policies" in found.message and "for every disturbance" in found.message
    assert found.where([0.0, 0.0]) == "outside"


def test_units_of_the_states_change_nothing_but_the_units(spring: sr.InitialStates) -> None:
    size = np.array([1000.0, 0.01])
    scaled = {
        **SPRING,
        "system": {
            "A": (A * size[:, None] / size).tolist(),
            "B": (B * size[:, None]).tolist(),
            "E": np.diag(size).tolist(),
        },
        "initial_state": (size * [0.5, 0.0]).tolist(),
        "terminal": [{"box": (SIDE * size).tolist()}],
    }
    found = sr.initial_states(config(scaled), directions=8, values=0)
    assert within(spring, found.inner / size) and within(found, spring.inner * size)
    v, gains = found.policy(np.zeros(2))
    assert np.isfinite(gains).all() and np.abs(v).max() <= 1 + 1e-9


@pytest.mark.slow
def test_the_files_hold_the_policies_of_the_vertices(tmp_path: Path) -> None:
    found = sr.initial_states(config(SPRING), directions=6, values=2, out=tmp_path / "set")
    with np.load(tmp_path / "set" / "initial_states.npz") as arrays:
        np.testing.assert_array_equal(arrays["gains"], found.gains)
    assert found.gains.shape == (len(found.inner), PIECES, PIECES, 1, 2)
    summary = json.loads((tmp_path / "set" / "initial_states.json").read_text())
    assert summary["initial_state_is"] == "inside"
    assert (tmp_path / "set" / "initial_states.png").exists()


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"problem.terminal": [{"box": [SIDE, None]}]}, "within"),
        ({"problem.system.A": [["-a", 1], [-2, -0.5]], "problem.system.parameters": {"a": [0.0, 0.1]}}, "parameters"),
    ],
)
def test_what_cannot_be_answered_is_refused_by_name(changes: dict[str, Any], said: str) -> None:
    with pytest.raises(sr.InputError, match=said):
        sr.initial_states(config(SPRING), changes, directions=8, values=0)


def test_a_policy_is_told_only_where_there_is_one(spring: sr.InitialStates) -> None:
    with pytest.raises(sr.InputError, match="inner polygon"):
        spring.policy(2.0 * spring.outer[0])
    planned = sr.initial_states(config(SPRING, OFF), directions=4, values=0)
    with pytest.raises(sr.InputError, match="affine"):
        planned.policy([0.0, 0.0])
