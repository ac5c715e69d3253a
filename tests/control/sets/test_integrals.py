"""Guards control/sets/integrals.py: support functions of curved sets along polynomials, between bounds that hold."""

from __future__ import annotations

from collections.abc import Callable
from itertools import pairwise
from math import comb

import numpy as np
import pytest

from sparserob_core.control.sets.integrals import _split_polynomials, can_enclose_integrals, curved_integral
from sparserob_core.control.sets.sets import Box, ConvexSet, Ellipsoid, NormBall, Polytope, Zonotope, product
from sparserob_core.sip.convex_set import ScaledSet
from tests.control.sets.test_sets import ByItsSupport

SEGMENTS = np.array([[0.3, 0.04], [-0.03, 0.4]])
SETS: dict[str, ConvexSet] = {
    "ellipsoid": Ellipsoid([0.1, -0.3], [[0.04, 0.01], [0.01, 0.09]]),
    "long ellipsoid": Ellipsoid([5.0, 0.0], [[1e-6, 0.0], [0.0, 4.0]]),
    "ball": NormBall(2.0, 0.7, [0.1, 0.0]),
    "3-norm": NormBall(3.0, 0.7, dimension=2),
    "1.3-norm": NormBall(1.3, 0.7, dimension=2),
    "product": product([NormBall(2.0, 0.5, dimension=2), Box([-1.0], [2.0])]),
    "with segments": product([NormBall(2.0, 0.5, [0.1, 0.0]), Zonotope(np.array([0.2, 0.1]), SEGMENTS)]),
    "with a triangle": product([Polytope([[-1, 0], [0, -1], [1, 1]], [0.4, -0.1, 1.0]), NormBall(2.0, 0.5, [1, 0])]),
    "scaled": ScaledSet(NormBall(2.0, 0.7, [0.1, 0.0]), np.array([0.2, 0.1]), 0.5),
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
    assert finite.sum() > 20 and can_enclose_integrals(bound)
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
    segments = Zonotope(np.zeros(2), np.array([[1.0, 0.0], [1.0, 1.0]]))
    assert analytic(segments, [1.0, 0.5], [0.2, 0.2]) and not analytic(segments, [1.0, -0.5], [0.3, 0.3])
    assert can_enclose_integrals(product([ball, segments])) and not can_enclose_integrals(ByItsSupport(ball))
    assert not can_enclose_integrals(ScaledSet(ByItsSupport(ball), np.zeros(2), 0.5))


def test_of_a_ball_that_is_a_point_nothing_moves() -> None:
    rows = np.array([[1.0, 0.5], [0.0, 0.0]])
    with np.errstate(all="raise"):
        found = NormBall(3.0, 0.0, [2.0, 0.0]).continued(rows, rows + 1.0)
    np.testing.assert_array_equal(found, [6.0, 2.0])


@pytest.mark.parametrize("p", [1.5, 1.01, 1.0 + 1e-5, 1.0 + 1e-12])
def test_a_norm_is_continued_to_complex_directions_as_far_as_one_entry_leads(p: float) -> None:
    """In complex numbers: ``z_1 (1 + sum (z_i / z_1)^q)^(1/q)`` at directions anywhere within the spread."""
    bound, rng = NormBall(p, 1.0, dimension=3), np.random.default_rng(4)
    q = p / (p - 1.0)
    centre = rng.normal(size=(600, 3))
    spread = np.abs(centre) * rng.uniform(0.0, 1.0, size=(600, 1)) ** 3
    most = bound.continued(centre, spread)
    assert most is not None
    finite = np.isfinite(most)
    assert finite.sum() > 200
    order = np.abs(centre).argsort(axis=1)[finite]
    z, apart = (np.take_along_axis(one[finite], order, axis=1) for one in (np.abs(centre), spread))
    for _ in range(40):
        at = z + apart * rng.uniform(0.5, 1.0, size=z.shape) * np.exp(2j * np.pi * rng.uniform(size=z.shape))
        others = np.exp(q * np.log(at[:, :-1] / at[:, -1:])).sum(axis=1)
        root = at[:, -1] * np.exp(np.log1p(others) / q)
        assert (np.abs(root) <= most[finite] * (1 + 1e-12)).all()
    # where two may come so near to one another that their powers are opposite, the sum may be 0
    near = z[:, 1] + apart[:, 1] >= z[:, 2] - apart[:, 2]
    assert not (near & (q * apart.max(axis=1) > z[:, 2] + apart[:, 2])).any()


@pytest.mark.parametrize("p", [1.01, 1.0 + 1e-6, 1.0 + 1e-12])
def test_balls_that_are_nearly_those_of_the_1_norm_take_few_intervals(p: float) -> None:
    """Two entries that change places, of which one goes through 0: the integral is that of the larger one and what
    both together are above it, ``|(1, r)|_q - 1``, beside where they are the same."""
    bound, calls = NormBall(p, 0.7, dimension=2), [0]

    def support(directions: np.ndarray, plain: Callable[[np.ndarray], np.ndarray] = bound.support) -> np.ndarray:
        calls.append(directions.size)
        return plain(directions)

    object.__setattr__(bound, "support", support)
    terms = np.array([[[0.8, -0.3], [-0.7, 1.1]]])
    found = curved_integral(bound, terms, np.ones(1), np.full(1, 1e-12))
    q, edge = p / (p - 1.0), (0.8 + 0.3) / (0.7 + 1.1)
    nodes, weights = np.polynomial.legendre.leggauss(40)
    exact = 0.0
    apart = np.concatenate([[0.0], np.geomspace(1e-4 / q, 0.3, 60)])
    cuts = np.unique(np.concatenate([[0.0, 0.3 / 1.1, 1.0], edge - apart, edge + apart]))
    for low, high in pairwise(cuts):
        s = (low + high) / 2 + (high - low) / 2 * nodes
        a, b = np.abs(0.8 - 0.7 * s), np.abs(-0.3 + 1.1 * s)
        more = np.exp(q * np.log(np.minimum(a, b) / np.maximum(a, b)))
        exact += 0.7 * float(np.maximum(a, b) * np.exp(np.log1p(more) / q) @ weights) * (high - low) / 2
    assert found[0, 0] - 1e-14 <= exact <= found[0, 1] + 1e-14
    assert found[0, 1] - found[0, 0] <= 1e-11
    assert sum(calls) < 20_000  # and a power of 10 of more for each of the exponent, without an entry that leads


def test_the_halves_of_a_polynomial_are_itself() -> None:
    points = np.random.default_rng(1).normal(size=(2, 5, 3))

    def at(coefficients: np.ndarray, u: float) -> np.ndarray:
        return sum(comb(4, k) * u**k * (1 - u) ** (4 - k) * coefficients[:, k] for k in range(5))

    halves = _split_polynomials(points, np.full(len(points), 0.5))
    for u in (0.0, 0.3, 1.0):
        np.testing.assert_allclose(at(halves[:2], u), at(points, u / 2), atol=1e-14)
        np.testing.assert_allclose(at(halves[2:], u), at(points, 0.5 + u / 2), atol=1e-14)
