"""Guards checker/sets/along.py: support functions of curved sets along polynomials, beside balls of many digits."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest
from flint import arb, ctx

from sparserob_core.checker.arithmetic.balls import balls
from sparserob_core.checker.outcome import Unchecked
from sparserob_core.checker.sets.along import LEFT, NODES, Norm, NormSummand, _bound_support, _evaluate_support, rule
from sparserob_core.checker.sets.known import known, middle, summands_of
from sparserob_core.control.sets.sets import Box, ConvexSet, Cylinder, Ellipsoid, NormBall, Polytope, Zonotope, product

SEGMENTS = np.array([[0.3, 0.04], [-0.03, 0.4]])
SETS: dict[str, ConvexSet] = {
    "ellipsoid": Ellipsoid([0.1, -0.3], [[0.04, 0.01], [0.01, 0.09]]),
    "long ellipsoid": Ellipsoid([5.0, 0.0], [[1.0, 1.9999], [1.9999, 4.0]]),
    "ball": NormBall(2.0, 0.7, [0.1, 0.0]),
    "3-norm": NormBall(3.0, 0.7, dimension=2),
    "1.3-norm": NormBall(1.3, 0.7, dimension=2),
    "product": product([NormBall(2.0, 0.5, dimension=2), Box([-1.0], [2.0])]),
    "segments": Zonotope(np.array([0.2, 0.1]), SEGMENTS),
    "with segments": product([NormBall(2.0, 0.5, [0.1, 0.0]), Zonotope(np.array([0.2, 0.1]), SEGMENTS)]),
    "with a triangle": product([Polytope([[-1, 0], [0, -1], [1, 1]], [0.4, -0.1, 1.0]), NormBall(2.0, 0.5, [1, 0])]),
}
CURVED = ("ellipsoid", "long ellipsoid", "ball", "3-norm", "1.3-norm")


def curve(bound: ConvexSet) -> NormSummand:
    (summand,) = summands_of(bound)
    assert isinstance(summand, NormSummand)
    return summand


@pytest.mark.first(2)
@pytest.mark.parametrize("name", CURVED)
@pytest.mark.parametrize("size", [1.0, 1e-180, 1e150])
def test_heights_are_those_of_the_set_in_balls(name: str, size: float) -> None:
    bound, rng = SETS[name], np.random.default_rng(1)
    some = curve(bound)
    more = np.array([[1.0, -0.5, 2.0, 0.25][: bound.dimension]])
    values = size * np.vstack([rng.normal(size=(20, bound.dimension)), np.eye(bound.dimension), more])
    heights, off = _evaluate_support(some.norm, some.offset, values)
    with ctx.workprec(300):
        for c, height, wrong in zip(values, heights, off, strict=True):
            moved = sum((a * b for a, b in zip(balls(c), balls(middle(bound)), strict=True)), arb(0))
            assert abs(known(bound).support(balls(c)) - moved - arb(float(height))) < arb(float(wrong))
            assert wrong <= (1e-11 if "long" in name else 1e-13) * size


@pytest.mark.first(2)
@pytest.mark.parametrize("name", SETS)
@pytest.mark.parametrize("end", [1.0, -0.4])
def test_integrals_hold_what_balls_of_many_digits_say_and_are_close(name: str, end: float) -> None:
    bound, rng = SETS[name], np.random.default_rng(3)
    summands, about, count = summands_of(bound), middle(bound), 8
    plain = rng.normal(size=(5, count, bound.dimension)) * 0.4 ** np.arange(count)[:, None]
    plain[:3, 0] += 2.0 * np.sign(plain[:3, 0])  # the other two may go through 0
    plain[:3, 0, 0] += 3.0 * np.sign(plain[:3, 0, 0])  # one corner of the triangle is best
    plain[4], vector = 0.0, rng.normal(size=bound.dimension)
    plain[4, 0], plain[4, 1] = 0.75 * vector, vector  # a multiple of one vector, 0 at -0.75
    zero = np.zeros((5, bound.dimension))
    sizes, ends = np.abs(plain).sum(axis=1), np.full(5, end)

    def swept(off: np.ndarray) -> list[np.ndarray]:
        return [
            np.sum(one, axis=0)
            for one in zip(*(summand.integrate_support(plain, off, sizes, ends) for summand in summands), strict=True)
        ]

    value, more, less = swept(zero + 1e-15 * sizes)
    tops = sizes @ np.sum([summand.radii for summand in summands], axis=0)
    fine, shares = np.polynomial.legendre.leggauss(60)
    for k in range(3):
        total = 0.0
        for a, b in zip(*(np.linspace(-1.0, end, 31)[i : 30 + i] for i in (0, 1)), strict=True):
            u = (a + b) / 2 + (b - a) / 2 * fine
            at = u[:, None] ** np.arange(count) @ plain[k]
            total += float((bound.support(at) - at @ about) @ shares) * (b - a) / 2
        assert -less[k] - 2e-15 * tops[k] <= total - value[k] <= more[k] + 2e-15 * tops[k]
    ahead, back = (float(bound.support(c)) - c @ about for c in (vector, -vector))
    exact = back * 0.25**2 / 2 + ahead * (end + 0.75) ** 2 / 2
    assert -less[4] - 1e-15 <= exact - value[4] <= more[4] + 1e-15
    assert ((more + less) <= (1e-11 if "long" in name else 3e-13) * tops).all()
    moved = swept(zero + 1e-3)
    assert (moved[1] >= more + 1e-3 * (end + 1.0) * sum(summand.radii.sum() for summand in summands) * (1 - 1e-9)).all()
    np.testing.assert_allclose(moved[0], value, rtol=0.0, atol=2e-3 * sum(summand.radii.sum() for summand in summands))


def test_heights_count_from_any_point_and_allow_for_what_the_factor_of_a_long_ellipsoid_misses() -> None:
    long = Ellipsoid([0.0, 0.0], [[1.0, 1.99999999], [1.99999999, 4.0]])
    values = np.array([[-1.99999999, 1.0], [-2.0, 1.0], [0.3, -0.2]])  # the first two along the shorter axis
    away = ((SETS["ball"], np.array([0.3, -0.2])), (SETS["ellipsoid"], np.ones(2)))
    for bound, about in ((long, np.zeros(2)), *away):
        heights, off = _evaluate_support(known(bound).norm, known(bound).centre - about, values)
        with ctx.workprec(300):
            for c, height, wrong in zip(values, heights, off, strict=True):
                moved = sum((a * b for a, b in zip(balls(c), balls(about), strict=True)), arb(0))
                assert abs(known(bound).support(balls(c)) - moved - arb(float(height))) < arb(float(wrong))


def test_the_rule_of_gauss_is_the_one_whose_remainder_is_told() -> None:
    with ctx.workprec(200):
        nodes = [arb.legendre_p_root(NODES, k, weight=True) for k in range(NODES)]
        for (x, w), node, weight in zip(nodes, *rule(), strict=True):
            assert abs(x - arb(float(node))) < 1.2e-16 and abs(w - arb(float(weight))) < 1.2e-16
        # of 1 / (z^2 + a^2), which is at most 1 / (a^2 - 9) where |z| <= 3
        a = arb(3.0) + arb(2.0) ** -20
        true = 2 * (1 / a).atan() / a
        found = sum((w / (x * x + a * a) for x, w in nodes), arb(0))
        assert abs(true - found) * (a * a - 9) < LEFT


def test_where_a_root_or_an_absolute_value_may_be_0_nothing_is_analytic() -> None:
    def analytic(bound: ConvexSet, centre: list[float], spread: list[float]) -> bool:
        return bool(
            np.isfinite(_bound_support(known(bound).norm, np.zeros(2), np.array([centre]), np.array([spread]))[0])
        )

    ball, third = NormBall(2.0, 1.0, dimension=2), NormBall(3.0, 1.0, dimension=2)
    assert not analytic(ball, [1.0, 0.0], [0.0, 1.0])  # 1 + i^2 = 0
    assert not analytic(ball, [1.0, 0.0], [1.0, 0.0]) and analytic(ball, [1.0, 0.0], [0.2, 0.2])
    assert not analytic(third, [1.0, 0.1], [0.0, 0.1]) and analytic(third, [1.0, 0.0], [0.1, 0.0])
    with pytest.raises(Unchecked, match="1-norm in up to 10"):  # whose support function has no curvature to speak of
        summands_of(NormBall(1.0, 1.0, dimension=12))
    with pytest.raises(Unchecked, match="boxes, polytopes, ellipsoids"):
        known(Cylinder(ball, 3)).summands(np.zeros(3))


@pytest.mark.first(1)
@pytest.mark.parametrize("name", CURVED)
def test_what_is_said_of_complex_directions_holds_of_those_that_are_real(name: str) -> None:
    bound, rng = SETS[name], np.random.default_rng(2)
    some, centre = curve(bound), rng.normal(size=(200, bound.dimension))
    spread = np.abs(centre) * rng.uniform(0.0, 0.4, size=centre.shape)
    most = _bound_support(some.norm, some.offset, centre, spread)
    assert np.isfinite(most).sum() > 10
    for sign in rng.uniform(-1.0, 1.0, size=(20, bound.dimension)):
        inside, _ = _evaluate_support(some.norm, some.offset, centre + sign * spread)
        assert (np.abs(inside) <= most).all()


@pytest.mark.parametrize("p", [1.5, 1.01, 1.0 + 1e-5, 1.0 + 1e-12])
def test_a_norm_is_no_larger_at_complex_directions_than_is_said(p: float) -> None:
    """In complex numbers: ``z_1 (1 + sum (z_i / z_1)^q)^(1/q)``, ``z_1`` the largest."""
    some, rng = curve(NormBall(p, 1.0, dimension=2)), np.random.default_rng(4)
    q = p / (p - 1.0)
    centre = np.sort(np.abs(rng.normal(size=(600, 2))), axis=1)
    spread = centre * rng.uniform(0.0, 1.0, size=(600, 1)) ** 3
    most = _bound_support(some.norm, some.offset, centre, spread)
    finite = np.isfinite(most)
    assert finite.sum() > 200
    z, apart = centre[finite], spread[finite]
    for _ in range(40):
        turns = np.exp(2j * np.pi * rng.uniform(size=z.shape))
        small, lead = (z + apart * rng.uniform(0.5, 1.0, size=z.shape) * turns).T
        root = lead * np.exp(np.log1p(np.exp(q * np.log(small / lead))) / q)
        assert (np.abs(root) <= most[finite] * (1 + 1e-12)).all()
    near = z[:, 0] + apart[:, 0] >= z[:, 1] - apart[:, 1]
    assert not (near & (q * apart.max(axis=1) > z[:, 1] + apart[:, 1])).any()


@pytest.mark.parametrize("p", [1.01, 1.0 + 1e-6, 1.0 + 1e-12])
def test_balls_that_are_nearly_those_of_the_1_norm_take_few_cells(p: float, monkeypatch: pytest.MonkeyPatch) -> None:
    """Two entries that change places, of which one goes through 0, against a rule on cells that narrow to where they
    are the same."""
    cells = [0]

    def most(norm: Norm, offset: np.ndarray, c: np.ndarray, spread: np.ndarray) -> np.ndarray:
        cells.append(len(c))
        return _bound_support(norm, offset, c, spread)

    monkeypatch.setattr("sparserob_core.checker.sets.along._bound_support", most)
    zero, plain = np.zeros((1, 2)), np.array([[[0.45, 0.25], [-0.35, 0.55]]])
    value, more, less = curve(NormBall(p, 0.7, dimension=2)).integrate_support(plain, zero, zero, np.ones(1))
    q, edge = p / (p - 1.0), 0.2 / 0.9
    nodes, weights = np.polynomial.legendre.leggauss(40)
    apart = np.concatenate([[0.0], np.geomspace(1e-4 / q, 0.6, 60)])
    cuts = np.unique(np.concatenate([[-1.0, -0.25 / 0.55, 1.0], edge - apart, edge + apart]))
    exact = 0.0
    for low, high in pairwise(cuts):
        s = (low + high) / 2 + (high - low) / 2 * nodes
        a, b = np.abs(0.45 - 0.35 * s), np.abs(0.25 + 0.55 * s)
        power = np.exp(q * np.log(np.minimum(a, b) / np.maximum(a, b)))
        exact += 0.7 * float(np.maximum(a, b) * np.exp(np.log1p(power) / q) @ weights) * (high - low) / 2
    assert -less[0] - 1e-15 <= exact - value[0] <= more[0] + 1e-15
    assert more[0] + less[0] <= 1e-12
    assert sum(cells) < 1500


def test_summands_of_a_product_are_those_of_its_factors_in_their_own_columns() -> None:
    inner = product([NormBall(2.0, 0.5, dimension=2), Box([-1.0], [2.0])])
    ball, box, last = summands_of(product([inner, Box([0.0], [4.0])]))
    assert [summand.dimension for summand in (ball, box, last)] == [4, 4, 4]
    np.testing.assert_allclose([summand.radii for summand in (ball, box, last)],
                               [[0.5, 0.5, 0, 0], [0, 0, 1.5, 0], [0, 0, 0, 2]], rtol=1e-11)  # fmt: skip
