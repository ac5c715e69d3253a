"""Guards control/response/sensitivity_system: derivatives of a system in its parameters, and of its motion."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.linalg import expm

from sparserob_core.control.problem.system import LinearSystem, SwitchedSystem
from sparserob_core.control.response.response import Response
from sparserob_core.control.response.sensitivity_system import Derivatives, tangent
from sparserob_core.control.response.time_grid import merge_grids
from sparserob_core.sip.convex_set import Box
from tests.support.plants import random_system, uniform

GRID = uniform(12, 3.0)


@pytest.mark.parametrize("enclosable", [True, False])
def test_the_derivatives_of_the_matrices_are_exact_where_they_can_be_enclosed(enclosable):
    def A(p):
        p = p if enclosable else [float(entry) for entry in p]
        return np.array([[p[0] ** 3, np.sin(p[1])], [p[0] * p[1], 2.0 + 0 * p[0]]])

    system = LinearSystem(A, [[1.0], [2.0]], parameters=Box([-1.0, 0.0], [1.0, 2.0]))
    for p in ([-1.0, 0.0], [1.0, 2.0], [0.3, 0.7], [0.0, 0.0]):
        values, B, E = Derivatives(system.phases[0])(np.array(p))
        truth = [[[3 * p[0] ** 2, 0.0], [p[1], 0.0]], [[0.0, np.cos(p[1])], [p[0], 0.0]]]
        assert np.allclose(values[0], A(np.array(p)))
        assert np.allclose(values[1:], truth, rtol=0, atol=1e-15 if enclosable else 1e-9)
        assert not np.any(B[1:])
        assert not np.any(E[1:])


def test_the_derivative_beside_a_singularity_stays_inside_the_parameters():
    system = LinearSystem(lambda p: np.array([[p[0] ** 1.5]]), [[1.0]], parameters=Box([0.0], [1.0]))
    assert abs(Derivatives(system.phases[0])(np.array([0.0]))[0][1, 0, 0]) <= 1e-2
    assert abs(Derivatives(system.phases[0])(np.array([1.0]))[0][1, 0, 0] - 1.5) <= 1e-9


def test_the_tangent_of_a_known_system_is_the_system_itself():
    rng = np.random.default_rng(13)
    response = Response(random_system(rng), merge_grids(GRID.breakpoints, GRID.breakpoints), np.zeros(2))
    assert tangent(response) is response


@pytest.mark.parametrize("turns", [False, True])
def test_the_adjoint_of_the_larger_system_is_the_derivative_of_the_adjoint(turns):
    """``d/dp_j`` of ``c' e^{A(p) t} B(p)`` by differences of matrix exponentials."""

    def A(p):
        return np.array([[0.0 * p[0], 1.0 + p[1]], [-2.0 + p[0], -0.3 * p[0] * p[1]]])

    def B(p):
        return np.array([[p[0]], [1.0 + p[1] ** 2]])

    one = LinearSystem(A, B, parameters=Box([-0.3, -0.2], [0.5, 0.4]))
    two = LinearSystem(lambda p: A(p).T, B, parameters=Box([-0.3, -0.2], [0.5, 0.4]))
    system = SwitchedSystem([(1.5, one), (3.0, two)]) if turns else one
    grid = merge_grids(np.linspace(0.0, 3.0, 5), np.array([0.0, 3.0]), switches=[1.5] if turns else [])
    larger = tangent(Response(system, grid, np.array([0.7, -0.4])))
    p, c, time = np.array([0.2, 0.1]), np.array([0.6, -1.1]), 2.7

    def flown(p, begin, end, late):
        """``e^{A (end - begin)}`` and the integral of it times ``B``."""
        M = np.zeros((3, 3))
        M[:2, :2], M[:2, 2:] = A(p).T if late and turns else A(p), B(p)
        M = expm(M * (end - begin))
        return M[:2, :2], M[:2, 2]

    def truth(p):
        late, early = flown(p, 1.5, time, True)[0], flown(p, 0.0, 1.5, False)[0]
        return np.concatenate([c @ late @ early, [c @ flown(p, 2.25, time, True)[1]]])

    assert larger.initial_state.tolist() == [0.7, -0.4, 0.0, 0.0, 0.0, 0.0]
    free, gains, inputs, _ = larger.adjoint(np.array([time]), np.concatenate([c, np.zeros(4)])[None], p[None])
    slopes = [(truth(p + 1e-4 * axis) - truth(p - 1e-4 * axis)) / 2e-4 for axis in np.eye(2)]
    assert free[0, :2] == pytest.approx(truth(p)[:2], rel=1e-10)
    assert free[0, 2:].reshape(2, 2) == pytest.approx(np.array(slopes)[:, :2], rel=1e-6)
    rows, (value, *derivatives) = gains[0, -1].reshape(3, 2), inputs[0, :, -1].reshape(3, 2)
    assert rows[0] @ value == pytest.approx(truth(p)[2], rel=1e-10)
    for axis, (row, derivative) in enumerate(zip(rows[1:], derivatives, strict=True)):
        assert row @ value + rows[0] @ derivative == pytest.approx(slopes[axis][2], rel=1e-6)
