"""Guards control/sets/integrals.py: support functions of curved sets along polynomials, between bounds that hold."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest

from sparserob_core.control.sets.integrals import curved_integral, enclosed
from sparserob_core.control.sets.sets import Box, ConvexSet, Ellipsoid, NormBall, Polytope, Zonotope, product

SETS: dict[str, ConvexSet] = {
    "ellipsoid": Ellipsoid([0.1, -0.3], [[0.04, 0.01], [0.01, 0.09]]),
    "long ellipsoid": Ellipsoid([5.0, 0.0], [[1e-6, 0.0], [0.0, 4.0]]),
    "ball": NormBall(2.0, 0.7, [0.1, 0.0]),
    "3-norm": NormBall(3.0, 0.7, dimension=2),
    "1.3-norm": NormBall(1.3, 0.7, dimension=2),
    "product": product([NormBall(2.0, 0.5, dimension=2), Box([-1.0], [2.0])]),
    "with a triangle": product([Polytope([[-1, 0], [0, -1], [1, 1]], [0.4, -0.1, 1.0]), NormBall(2.0, 0.5, [1, 0])]),
    "in units": NormBall(3.0, 0.7, dimension=2).in_units(np.array([1e3, 0.25])),
}
FINE, SHARES = np.polynomial.legendre.leggauss(40)


def summed(bound: ConvexSet, terms: np.ndarray, ends: np.ndarray) -> float:
    """The integral by Gauss' rule with many nodes between the given ends."""
    total = 0.0
    for a, b in pairwise(ends):
        u = (a + b) / 2 + (b - a) / 2 * FINE
        total += float(bound.support(u[:, None] ** np.arange(len(terms)) @ terms) @ SHARES) * (b - a) / 2
    return total


@pytest.mark.first(2)
@pytest.mark.parametrize("name", SETS)
def test_the_integral_of_a_curved_support_function_is_between_its_bounds_which_are_close(name: str) -> None:
    bound, rng = SETS[name], np.random.default_rng(1)
    terms = rng.normal(size=(6, 13, bound.dimension)) * 0.4 ** np.arange(13)[:, None]
    terms[:, 0] += 3.0 * np.sign(terms[:, 0])  # no entry goes through 0
    terms[3:, 1] *= 2.0
    through = np.zeros((2, 13, bound.dimension))  # a multiple of one vector, through 0 at 0.3 and at 0.7
    vector = rng.normal(size=bound.dimension)
    through[0, 0], through[0, 1], through[1, 0], through[1, 1] = -0.3 * vector, vector, 0.7 * vector, -vector
    every = np.concatenate([terms, through])
    lengths = np.full(8, 0.5)
    found = curved_integral(bound, every, lengths, np.full(8, 1e-14))
    fine = np.linspace(0.0, 1.0, 41)
    true = [0.5 * summed(bound, one, fine) for one in terms]
    ahead, back = bound.support(vector), bound.support(-vector)
    true += [0.5 * (0.245 * ahead + 0.045 * back), 0.5 * (0.245 * ahead + 0.045 * back)]
    sizes = 0.5 * np.abs(every).sum(axis=1) @ bound.reach(np.eye(bound.dimension))
    slack = 1e-15 * sizes  # of the rule beside it
    assert (found[:, 0] - slack <= true).all() and (true <= found[:, 1] + slack).all()
    assert (found[:, 1] - found[:, 0] <= 4e-13 * sizes).all()


@pytest.mark.first(2)
@pytest.mark.parametrize("name", SETS)
def test_what_a_support_function_is_continued_to_is_no_larger_than_is_said(name: str) -> None:
    bound, rng = SETS[name], np.random.default_rng(2)
    centre = rng.normal(size=(400, bound.dimension))
    spread = np.abs(centre) * rng.uniform(0.0, 0.4, size=centre.shape)
    most = bound.continued(centre, spread)
    assert most is not None
    finite = np.isfinite(most)
    assert finite.sum() > 20 and enclosed(bound)
    for turn in np.exp(2j * np.pi * rng.uniform(size=(8, bound.dimension))):
        # by its series about the centre along the way: a mean over a circle of real directions would need it as well
        s = np.cos(np.pi * (np.arange(24) + 0.5) / 24)
        size = np.abs(turn.real)
        inside = bound.support(centre[:, None] + s[:, None] * (size * spread)[:, None])
        assert (np.abs(inside).max(axis=1)[finite] <= most[finite] * (1 + 1e-12)).all()
        series = np.polynomial.chebyshev.chebfit(s, inside.T, 23)
        at = np.polynomial.chebyshev.chebval(1j * 0.9, series)
        assert (np.abs(at)[finite] <= most[finite] * (1 + 1e-9)).all()


def test_where_a_root_or_an_absolute_value_may_be_0_nothing_is_continued() -> None:
    ball, box = NormBall(2.0, 1.0, dimension=2), Box([-1.0], [1.0])
    corners = Polytope([[-1, 0], [0, -1], [1, 1]], [0.0, 0.0, 1.0])

    def analytic(bound: ConvexSet, centre: list[float], spread: list[float]) -> bool:
        found = bound.continued(np.array([centre]), np.array([spread]))
        assert found is not None
        return bool(np.isfinite(found[0]))

    assert not analytic(ball, [1.0, 0.0], [0.0, 1.0])  # 1 + i^2 = 0
    assert not analytic(ball, [1.0, 0.0], [1.0, 0.0])
    assert analytic(ball, [1.0, 0.0], [0.2, 0.2])
    assert not analytic(NormBall(3.0, 1.0, dimension=2), [1.0, 0.1], [0.0, 0.1])  # |z|^1.5 at 0
    assert analytic(NormBall(3.0, 1.0, dimension=2), [1.0, 0.0], [0.1, 0.0])
    assert analytic(box, [1.0], [0.99]) and not analytic(box, [1.0], [1.0])
    assert analytic(corners, [1.0, 0.5], [0.24, 0.24]) and not analytic(corners, [1.0, 0.5], [0.26, 0.26])
    assert not enclosed(product([ball, Zonotope(np.zeros(1), np.ones((1, 1)))]))


def test_of_a_ball_that_is_a_point_nothing_moves() -> None:
    rows = np.array([[1.0, 0.5], [0.0, 0.0]])
    with np.errstate(all="raise"):
        found = NormBall(3.0, 0.0, [2.0, 0.0]).continued(rows, rows + 1.0)
    np.testing.assert_array_equal(found, [6.0, 2.0])
