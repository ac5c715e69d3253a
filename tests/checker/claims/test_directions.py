"""Guards checker/claims: directions of a curved set that are sums of coordinates, and errors of execution: as floats
and by how much these are off, or as balls."""

from __future__ import annotations

from fractions import Fraction
from typing import Any, cast

import numpy as np
import pytest
from flint import arb_mat, ctx

from sparserob_core.checker.claims.window import AddedTerms, ConstraintWindow
from sparserob_core.checker.reach.closed_loop import VerifiedLoop
from sparserob_core.checker.reach.kernels import BoundedInputHere
from sparserob_core.checker.reach.tube import LoopTube, Polynomial
from sparserob_core.control.problem.system import LinearSystem
from sparserob_core.control.sets.sets import Box, Ellipsoid

FAR = np.array([2.0, 0.5, 3.0])


class Erring(BoundedInputHere):
    """What is added is ``FAR'|c|`` and as much again by a time of 1, and a little more for ``c`` below 0."""

    def added_at(self, c: np.ndarray, times: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        sizes = float(FAR @ (np.abs(c) + 0.1 * np.maximum(-c, 0.0))) * (1.0 + times)
        return sizes, sizes

    def least(self, c: np.ndarray, time: float) -> np.ndarray:
        raise NotImplementedError

    def bound_chord_errors(self, c: np.ndarray, start: np.ndarray, stop: np.ndarray) -> np.ndarray:
        return np.full(start.size, 0.01 * float(FAR @ np.abs(c)))


@pytest.fixture(autouse=True)
def precision():
    with ctx.workprec(96):
        yield


def beside(basis: np.ndarray) -> AddedTerms:
    window = ConstraintWindow("path", Ellipsoid(np.zeros(3), np.eye(3)), 0.0, 1.0, 3)
    return AddedTerms(window, basis, np.zeros((len(basis), 0)), [0.0, 1.0], [], cast(Any, [Erring()]))


def test_a_direction_is_the_nearest_float_and_off_by_what_is_left() -> None:
    rng = np.random.default_rng(5)
    basis, z = rng.normal(size=(3, 3)), rng.normal(size=(4, 3))
    c, off = beside(basis).directions(z)
    exact = [[sum(Fraction(a) * Fraction(b) for a, b in zip(row, col, strict=True)) for col in basis.T] for row in z]
    for i, j in np.ndindex(*c.shape):
        assert abs(exact[i][j] - Fraction(c[i, j])) <= Fraction(off[i, j])
        assert off[i, j] <= 1e-15 * (np.abs(z) @ np.abs(basis))[i, j]
    assert off.any()
    few = np.round(basis * 64) / 64
    c, off = beside(few).directions(np.array([[1.0, -0.5, 0.25], [0.0, 1.0, 0.0]]))
    assert not off.any()
    np.testing.assert_array_equal(c[1], few[1])


def test_what_a_direction_is_off_by_is_added_as_along_the_axes() -> None:
    basis = np.full((1, 3), 0.1)
    z, none = np.array([[1.0 / 3.0]]), Polynomial(np.zeros((1, 1)), 0.0, 0.0, 0.0)
    one = beside(basis)
    c, off = one.directions(z)
    for off_by in (off, np.array([[1e-3, 0.0, 2e-3]])):
        one.__dict__["_directions_remembered"] = {z.tobytes(): (c, off_by)}
        for stop in (0.0, 1.0):
            (found,) = one.added([none], 0.0, stop, z)
            top = found.coefficients.sum() + found.error
            bent = 0.01 * float(FAR @ (c[0] + off_by[0])) * stop
            truth = float(FAR @ (c[0] + 1.1 * off_by[0])) * (1.0 + stop) + bent
            assert top >= truth * (1.0 - 1e-12)
            assert top <= truth * (1.0 + 1e-12) + 1e-14


def test_a_loop_is_seen_along_balls_as_along_floats() -> None:
    plant = LinearSystem([[0.0, 1.0], [-1.0, -0.4]], [[0.0], [1.0]], [[1.0, 0.3], [0.0, 1.0]])
    grid, gains = [0.0, 1.0, 2.0], np.full((2, 2, 1, 2), 0.25) * np.tri(2)[:, :, None, None]
    loop = VerifiedLoop(
        plant, [0.0, 0.0], [arb_mat(1, 1)] * 2, gains, grid, grid, grid[:-1], Box([-0.1, -0.2], [0.1, 0.3])
    )
    z, axes, normals = np.array([[0.5, 0.25], [-0.75, 0.5]]), np.eye(2), np.array([[1.0, 0.5], [-0.25, 1.0]])
    summed, alone = (LoopTube(loop, basis, np.zeros((2, 0))) for basis in (normals, z @ normals))
    for piece, start, stop in ((0, 0.0, 0.0), (0, 0.2, 0.5), (1, 1.3, 1.7), (1, 2.0, 2.0)):
        for ball, float_ in zip(
            summed.cells(piece, start, stop, z), alone.cells(piece, start, stop, axes), strict=True
        ):
            np.testing.assert_allclose(ball.coefficients, float_.coefficients, rtol=0.0, atol=1e-12)
            assert ball.error == pytest.approx(float_.error, abs=1e-12)
