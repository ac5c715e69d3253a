"""Guards sip/expressions/taylor: taylor models: the remainder holds what the polynomial leaves out."""

from __future__ import annotations

from fractions import Fraction

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sparserob_core.control.enclosures.algebra import flows_rounding, lifted_matrix, lifted_transitions
from sparserob_core.control.enclosures.matrix_exponential import exponential_rounding, transitions
from sparserob_core.errors import NotEnclosable
from sparserob_core.sip.expressions.expression import parse_expression
from sparserob_core.sip.expressions.taylor import TaylorModel, TaylorSpace

EXPRESSIONS = [
    "p1*p2 - p1**3",
    "p1/p2",
    "1/(p1*p2)",
    "sin(p1)*cos(p2)",
    "exp(-p1*p2)",
    "sqrt(p1 + p2**2)",
    "log(p1)/p2",
    "p1**2.5",
    "p2**-3",
    "tan(p1/4)",
    "tanh(p1 - p2)",
    "p1**p2",
    "2**p1",
    "-1/(-p1)",
    "p1**40",
    "(p1 - p2)**4",
    "3 - p1 + p1/7 - 2/p2",
    "sin(10*p1)",
    "p1**100",
]


@pytest.mark.parametrize("text", EXPRESSIONS)
@pytest.mark.parametrize("degree", [0, 1, 3, 6])
@settings(max_examples=6, deadline=None)
@given(seed=st.integers(0, 2**32 - 1))
def test_a_model_encloses_its_function(text: str, degree: int, seed: int) -> None:
    rng = np.random.default_rng(seed)
    space = TaylorSpace(2, degree)
    centre, radius = rng.uniform(1.0, 2.0, 2), rng.uniform(0.0, 0.3, 2)
    expression = parse_expression(text, ("p1", "p2"))
    model = expression(dict(zip(("p1", "p2"), space.variables(centre, radius), strict=True)))
    assert isinstance(model, TaylorModel)
    delta = np.vstack([rng.uniform(-1, 1, (60, 2)), [[1, 1], [1, -1], [-1, 1], [-1, -1]]])
    p = centre + radius * delta
    truth = expression({"p1": p[:, 0], "p2": p[:, 1]})
    slack = 1e-11 * (1 + np.abs(truth).max())
    assert (np.abs(truth - model.evaluate(delta)) <= model.remainder + slack).all()
    low, high = model.bounds()
    assert low - slack <= truth.min() and truth.max() <= high + slack


def height(model: TaylorModel, delta: list[Fraction]) -> Fraction:
    """The polynomial of a model at a point, without rounding."""
    total = Fraction(0)
    for exponents, coefficient in zip(model.space.exponents.tolist(), model.coefficients.tolist(), strict=True):
        term = Fraction(coefficient)
        for one, power in zip(delta, exponents, strict=True):
            term *= one**power
        total += term
    return total


@pytest.mark.parametrize("radius", [2.0**-30, 2.0**-12])
@pytest.mark.parametrize("text", EXPRESSIONS)
def test_on_a_small_cell_the_remainder_holds_what_is_rounded(text: str, radius: float) -> None:
    """In balls of 300 bits, against the polynomial in rational numbers: nothing is allowed for but the remainder, of
    which rounding is the larger part on the smaller cell."""
    flint = pytest.importorskip("flint")
    space, expression = TaylorSpace(2, 5), parse_expression(text, ("p1", "p2"))
    rng = np.random.default_rng(len(text))
    for _ in range(4):
        centre, radii = rng.uniform(1.0, 2.0, 2), np.array([radius, 0.75 * radius])
        model = expression(dict(zip(("p1", "p2"), space.variables(centre, radii), strict=True)))
        for signs in ([1, 1], [1, -1], [-1, 0]):
            delta = [Fraction(sign) for sign in signs]
            place = [
                Fraction(c) + Fraction(r) * d for c, r, d in zip(centre.tolist(), radii.tolist(), delta, strict=True)
            ]
            with flint.ctx.workprec(300):
                at = [np.array([flint.arb(flint.fmpq(q.numerator, q.denominator))], dtype=object) for q in place]
                truth = expression({"p1": at[0], "p2": at[1]})[0]
                said = height(model, delta)
                off = abs(truth - flint.arb(flint.fmpq(said.numerator, said.denominator)))
                assert off <= flint.arb(float(model.remainder))


@pytest.mark.parametrize("of", ["sin", "cos"])
@pytest.mark.parametrize("centre", [1000.2, -1.5707963, 31.4])
def test_of_a_wave_far_from_0_the_remainder_holds_what_is_rounded(of: str, centre: float) -> None:
    flint = pytest.importorskip("flint")
    (p,) = TaylorSpace(1, 8).variables(np.array([centre]), np.array([0.02]))
    model = getattr(p, of)()
    for delta in (-1.0, 0.37, 1.0):
        with flint.ctx.workprec(300):
            at = flint.arb(centre) + flint.arb(0.02) * flint.arb(delta)
            said = height(model, [Fraction(delta)])
            off = abs(getattr(at, of)() - flint.arb(flint.fmpq(said.numerator, said.denominator)))
            assert off <= flint.arb(float(model.remainder))


@pytest.mark.parametrize("number", [99.0, -3.0, 1e-3, 7.0])
def test_of_a_quotient_by_a_number_the_remainder_holds_what_is_rounded(number: float) -> None:
    rng = np.random.default_rng(1)
    for radius in (204.0, *rng.uniform(0.1, 300.0, 50)):
        (p,) = TaylorSpace(1, 3).variables(np.zeros(1), np.array([radius]))
        model = p / number
        off = abs(height(model, [Fraction(1)]) - Fraction(radius) / Fraction(number))
        assert off <= Fraction(model.remainder)
        assert model.remainder <= 2e-16 * abs(radius / number)


@pytest.mark.parametrize("left", ["constant", "line", "plane", "dense"])
@pytest.mark.parametrize("right", ["constant", "line", "plane", "dense"])
def test_of_a_product_the_remainder_holds_what_is_rounded(left: str, right: str) -> None:
    """Of two that are nothing but constants the product is that of two numbers, which is what it says."""
    space, rng = TaylorSpace(2, 6), np.random.default_rng(0)
    filled = {"constant": 1, "line": 2, "plane": 3, "dense": 10}
    places = np.arange(space.size)
    for _ in range(10):
        a, b = (
            TaylorModel(space, np.where(places < filled[kind], rng.normal(size=space.size), 0.0), 0.0)
            for kind in (left, right)
        )
        product = a * b
        if left == right == "constant":
            assert product.coefficients[0] == a.coefficients[0] * b.coefficients[0]
            continue
        for corner in ([1, 1], [1, -1], [-1, 1]):
            delta = [Fraction(sign) for sign in corner]
            off = abs(height(product, delta) - height(a, delta) * height(b, delta))
            assert off <= Fraction(product.remainder)


def test_the_remainder_shrinks_with_the_degree_and_with_the_cell() -> None:
    def remainder(degree: int, radius: float) -> float:
        (p,) = TaylorSpace(1, degree).variables(np.array([1.0]), np.array([radius]))
        return float((p.exp() / (1.0 + p)).remainder)

    assert remainder(8, 0.1) < 1e-6 * remainder(2, 0.1)
    assert remainder(3, 0.05) < remainder(3, 0.1) / 12  # fourth order in the radius


def test_of_polynomials_within_the_degree_only_rounding_is_left_out() -> None:
    p, q = TaylorSpace(2, 4).variables(np.array([1.0, -2.0]), np.array([0.5, 0.25]))
    assert 0.0 < ((p * q - q * p) + p**2 * q**2 - 3.0).remainder < 1e-12
    assert (p * 0.0 + 3.0).remainder == 0.0


def test_monomials_are_graded_and_products_land_where_the_exponents_add() -> None:
    space = TaylorSpace(3, 4)
    assert (np.diff(space.degrees) >= 0).all() and space.size == 35
    left, right, target = space.products
    np.testing.assert_array_equal(space.exponents[left] + space.exponents[right], space.exponents[target])
    assert len(target) == sum(1 for a in space.exponents for b in space.exponents if a.sum() + b.sum() <= 4)
    delta = np.random.default_rng(0).uniform(-1, 1, (5, 3))
    np.testing.assert_allclose(space.monomials(delta)[:, space.index[(1, 0, 2)]], delta[:, 0] * delta[:, 2] ** 2)


def test_models_work_inside_numpy_arrays() -> None:
    space = TaylorSpace(2, 3)
    p = np.array(space.variables(np.array([1.0, 2.0]), np.array([0.1, 0.2])), dtype=object)
    constant = np.array([[1.0, 2.0], [3.0, 4.0]])
    for matrix in (constant + p[0] * constant, p[0] * constant + constant, constant * p[0] + constant):
        assert matrix.shape == (2, 2)
        assert matrix[1, 1].bounds() == pytest.approx((7.6, 8.4))
    assert np.sin(p)[0].bounds() == pytest.approx(p[0].sin().bounds())
    assert (constant @ p)[0].bounds() == pytest.approx((4.5, 5.5))
    assert (np.float64(2.0) * p[0]).bounds() == pytest.approx((1.8, 2.2))
    assert (np.float64(2.0) / p[0]).bounds()[0] <= 2 / 1.1
    assert 0.0 < np.square(p)[0].remainder < 1e-14
    assert abs(-p[0]).bounds() == p[0].bounds()


@pytest.mark.parametrize(
    "broken",
    [
        np.log,
        np.sqrt,
        np.reciprocal,
        lambda p: 1 / p,
        lambda p: p**0.5,
        lambda p: p**-1,
        lambda p: p / 0,
        lambda p: (1000 + p).exp(),
        lambda p: p < 1,
        bool,
        abs,
        lambda p: p == 1.0,
        lambda p: (-2) ** p,
        lambda p: max(p, 0.0),
    ],
)
def test_what_has_no_enclosure_says_so(broken) -> None:
    (p,) = TaylorSpace(1, 3).variables(np.array([0.0]), np.array([1.0]))
    with pytest.raises(NotEnclosable):
        broken(p)


@pytest.mark.parametrize(("nu", "degree"), [(0, 0), (1, 4), (2, 3), (4, 2)])
@pytest.mark.parametrize("rows", [False, True])
def test_the_transitions_of_the_coefficients_are_those_of_the_lifted_matrix(nu, degree, rows):
    space, rng = TaylorSpace(nu, degree), np.random.default_rng(nu)
    A, durations = rng.normal(size=(space.size, 3, 3)), np.array([0.0, 0.3, 2.0])
    matrix = lifted_matrix(space, A, rows)
    for found, expected in zip(
        lifted_transitions(space, A, durations, rows), transitions(matrix, durations), strict=True
    ):
        assert np.allclose(found, expected, rtol=1e-11, atol=1e-11 * np.abs(expected).max())


@pytest.mark.parametrize(("nu", "degree"), [(0, 0), (1, 4), (2, 3), (4, 2)])
def test_rounding_of_flows_counts_the_terms_of_the_fullest_coefficient(nu, degree):
    """Of a product of two polynomials of matrices, and the sum of the norms of all coefficients."""
    space, rng = TaylorSpace(nu, degree), np.random.default_rng(nu)
    terms = max(
        sum(1 for a in space.exponents if (a <= b).all() and a.sum() + (b - a).sum() <= degree) for b in space.exponents
    )
    A, durations = rng.normal(size=(space.size, 3, 3)), np.array([0.0, 0.3, 2.0])
    size = sum(float(np.linalg.norm(part, 1)) for part in A)
    np.testing.assert_allclose(
        flows_rounding(space, A, durations), exponential_rounding(terms * 2 * 3, size * durations), rtol=1e-12
    )
