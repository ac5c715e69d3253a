"""Guards control/transcription/quadratic: the cost of the nominal trajectory is the integral along it."""

from __future__ import annotations

import itertools
from dataclasses import replace

import numpy as np
import pytest
from scipy.linalg import expm

import sparserob_core as sr
from sparserob_core.control.problem.cost import Cost
from sparserob_core.control.problem.problem import OptimalControlProblem
from sparserob_core.control.problem.system import LinearSystem, SwitchedSystem
from sparserob_core.control.transcription import quadratic
from sparserob_core.control.transcription.quadratic import quadratic_cost
from sparserob_core.sip.convex_set import Array, Box
from tests.support.plants import walsh

HORIZON, BREAKS = 2.0, np.array([0.0, 0.3, 0.9, 1.4, 2.0])
NODES, WEIGHTS = np.polynomial.legendre.leggauss(12)


def problem_of(
    rng: np.random.Generator, switch: float | None, delay: float, terms: str, speed: float
) -> OptimalControlProblem:
    """Two states and two controls, a drift, and sets whose middles are not 0."""

    def system(late: float = 0.0) -> LinearSystem:
        A, B, E, c = (
            speed * rng.normal(size=(2, 2)),
            rng.normal(size=(2, 2)),
            rng.normal(size=(2, 1)),
            rng.normal(size=2),
        )
        return LinearSystem(A, B, E, c=c, delay=late)

    def positive() -> Array:
        half = rng.normal(size=(2, 2))
        return half @ half.T

    made = system(delay) if switch is None else SwitchedSystem([(switch, system()), (HORIZON, system())], delay)
    return OptimalControlProblem(
        system=made,
        horizon=HORIZON,
        initial_state=rng.normal(size=2),
        initial_set=Box([-0.1, -0.2], [0.5, 0.3]),
        control=Box([-1.0, -1.0], [1.0, 1.0]),
        disturbance=Box([-0.2], [0.6]),
        initial_control=rng.normal(size=2),
        cost=Cost(
            state={"Q": positive(), "reference": rng.normal(size=2)} if "state" in terms else None,
            control={"R": positive()} if "control" in terms else None,
            final={"Q": positive(), "reference": rng.normal(size=2)} if "final" in terms else None,
        ),
    )


def by_quadrature(problem: OptimalControlProblem, control: Array) -> float:
    """The quadratic terms along the nominal trajectory, from one event to the next, by Gauss and Legendre."""
    system, (state, effort, final) = problem.system, problem.cost.terms
    pairs = [(phase.until, phase) for phase in system.until(HORIZON)]
    events = [
        0.0,
        HORIZON,
        *BREAKS,
        *(BREAKS + system.delay),
        *(until for until, _ in pairs),
        *np.linspace(0, HORIZON, 11),
    ]
    events = np.unique([time for time in events if 0.0 <= time <= HORIZON])
    x, total = np.asarray(problem.initial_state) + np.array([0.2, 0.05]), 0.0
    for left, right in itertools.pairwise(events):
        middle = (left + right) / 2
        late = middle - system.delay
        u = problem.initial_control if late < 0.0 else control[:, np.searchsorted(BREAKS, late) - 1]
        now = next(one for until, one in pairs if middle < until)
        A, B, E = (matrix[0] for matrix in now.matrices(np.zeros((1, 0))))
        block = np.zeros((3, 3))
        block[:2, :2], block[:2, 2] = A, B @ u + 0.2 * E[:, 0] + np.ravel(now.c)
        for node, weight in zip((NODES + 1) / 2 * (right - left), WEIGHTS / 2 * (right - left), strict=True):
            y = (expm(block * node) @ np.append(x, 1.0))[:2]
            total += 0.0 if state is None else weight * (y - state.reference) @ state.Q @ (y - state.reference)
        if effort is not None:
            now_u = control[:, np.searchsorted(BREAKS, middle) - 1]
            total += (right - left) * now_u @ effort.Q @ now_u
        x = (expm(block * (right - left)) @ np.append(x, 1.0))[:2]
    return total + (0.0 if final is None else (x - final.reference) @ final.Q @ (x - final.reference))


@pytest.mark.parametrize(
    ("seed", "switch", "delay", "terms", "speed"),
    [
        (0, None, 0.0, "state control final", 1.0),
        (1, None, 0.45, "state final", 1.0),
        (2, 0.7, 0.0, "state", 1.0),
        (3, 0.7, 0.2, "state control final", 1.0),
        (4, None, 0.0, "final", 1.0),
        (5, None, 0.0, "control", 1.0),
        (6, None, 0.0, "state", 5.0),
    ],
)
def test_the_cost_is_the_integral_along_the_nominal_trajectory(
    seed: int, switch: float | None, delay: float, terms: str, speed: float
) -> None:
    rng = np.random.default_rng(seed)
    problem = problem_of(rng, switch, delay, terms, speed)
    cost = quadratic_cost(problem, BREAKS)
    P = cost.P.toarray()
    np.testing.assert_allclose(P, P.T, rtol=1e-14)
    for control in (np.zeros((2, 4)), rng.normal(size=(2, 4)), rng.normal(size=(2, 4))):
        u = control.ravel()
        found = u @ P @ u / 2 + cost.q @ u + cost.constant
        assert found == pytest.approx(by_quadrature(problem, control), rel=1e-10)


def test_a_cost_in_the_coefficients_of_functions_is_that_of_what_they_make() -> None:
    rng = np.random.default_rng(7)
    problem, dictionary = problem_of(rng, None, 0.0, "state control", 1.0), walsh(4, HORIZON, 3)
    cost = quadratic_cost(problem, dictionary.breakpoints)
    there = cost.on(dictionary)
    for _ in range(3):
        c = rng.normal(size=(2, 3))
        u, c = (c @ dictionary.values).ravel(), c.ravel()
        assert c @ there.P @ c / 2 + there.q @ c + there.constant == pytest.approx(
            u @ cost.P @ u / 2 + cost.q @ u + cost.constant, rel=1e-12
        )
    assert cost.on(sr.Dictionary(BREAKS, np.eye(4))) is cost


def test_the_largest_cost_is_that_of_one_channel_held_at_its_reach() -> None:
    rng, reach = np.random.default_rng(8), np.array([0.5, 2.0])
    for flip in (1.0, -1.0):
        cost = quadratic_cost(problem_of(rng, None, 0.0, "state", 1.0), BREAKS)
        cost = replace(cost, q=flip * cost.q)
        held = [np.zeros(8), *(sign * np.repeat(row, 4) for row in np.diag(reach) for sign in (1.0, -1.0))]
        values = [u @ cost.P @ u / 2 + cost.q @ u + cost.constant for u in held]
        assert cost.largest(reach) == pytest.approx(max(values), rel=1e-13)


def test_more_values_than_can_be_coupled_are_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    problem = problem_of(np.random.default_rng(0), None, 0.0, "state", 1.0)
    monkeypatch.setattr(quadratic, "COUPLING_LIMIT", 8)
    assert quadratic_cost(problem, BREAKS).q.size == 8
    with pytest.raises(sr.InputError, match=r"cost: .*couples all 10 values"):
        quadratic_cost(problem, np.linspace(0.0, HORIZON, 6))
    alone = replace(problem, cost=Cost(control={"R": np.eye(2)}))
    assert quadratic_cost(alone, np.linspace(0.0, HORIZON, 6)).q.size == 10
