"""Guards sip/expressions/cell_models: the error bound of every operation contains what exact arithmetic leaves, and
the bounds of polynomials are above every value."""

from __future__ import annotations

import itertools
from collections.abc import Callable
from fractions import Fraction
from math import comb

import numpy as np
import pytest
from flint import arb, ctx

from sparserob_core.sip.expressions import cell_models
from sparserob_core.sip.expressions.cell_models import CellModels, bound_polynomials
from sparserob_core.sip.expressions.taylor import TaylorSpace, taylor_space

EXACT = 400  # bits in which the truth is computed
FUNCTIONS: dict[str, tuple[Callable[[arb], arb], tuple[float, float]]] = {
    "exp": (lambda y: y.exp(), (-4.0, 4.0)),
    "sin": (lambda y: y.sin(), (-1e3, 1e3)),
    "cos": (lambda y: y.cos(), (-1e3, 1e3)),
    "tan": (lambda y: y.tan(), (-0.9, 0.9)),
    "log": (lambda y: y.log(), (0.6, 9.0)),
    "sqrt": (lambda y: y.sqrt(), (0.6, 9.0)),
    "tanh": (lambda y: y.tanh(), (-12.0, 12.0)),
    "absolute": (abs, (0.6, 9.0)),
}


def random_models(space: TaylorSpace, rng: np.random.Generator, size: float, remainder: float, degree: int = 99):
    """Models on four cells, two functions on each, of random doubles in the monomials of at most a degree."""
    coefficients = rng.normal(size=(4, 2, space.size)) * size * (space.degrees <= degree)
    return CellModels(space, coefficients, np.full((4, 2), remainder))


def value_of(model: CellModels, cell: int, column: int, delta: np.ndarray) -> arb:
    """Value of a polynomial, without its remainder."""
    total = arb(0)
    for exponents, coefficient in zip(
        model.space.exponents.tolist(), model.coefficients[cell, column].tolist(), strict=True
    ):
        term = arb(coefficient)
        for place, power in zip(delta.tolist(), exponents, strict=True):
            term *= arb(place) ** power
        total += term
    return total


def assert_contains(result: CellModels, truth: Callable[..., arb], *models: CellModels) -> None:
    """Compare a model with the truth at corners and other places, for the ends of the remainders of its operands."""
    nu, rng = result.space.nu, np.random.default_rng(0)
    deltas = [np.array(corner, dtype=float) for corner in itertools.product((-1, 1), repeat=nu)][:8]
    deltas += list(rng.uniform(-1, 1, (3, nu)))
    with ctx.workprec(EXACT):
        for cell, column in itertools.product(range(result.shape[0]), range(result.shape[1])):
            for delta in deltas:
                values = [value_of(model, cell, column, delta) for model in models]
                exact = value_of(result, cell, column, delta)
                for signs in itertools.product((-1, 1), repeat=len(models)):
                    ends = [
                        value + sign * arb(float(model.remainder[cell, column]))
                        for value, sign, model in zip(values, signs, models, strict=True)
                    ]
                    miss = abs(truth(*ends) - exact)
                    assert miss <= arb(float(result.remainder[cell, column])), (cell, column, delta, signs)


# remainders of both operands, and their largest degree: each choice leaves one kind of error alone
ERRORS = {
    "rounding": (0.0, 0.0, 1),
    "terms of high degree": (0.0, 0.0, 3),
    "the left remainder": (0.1, 0.0, 1),
    "the right remainder": (0.0, 0.1, 1),
    "both remainders": (0.3, 0.2, 1),
}


@pytest.mark.parametrize("errors", ERRORS)
@pytest.mark.parametrize("nu", [1, 2])
def test_sums_and_products_contain_what_exact_arithmetic_gives(errors: str, nu: int) -> None:
    left, right, degree = ERRORS[errors]
    rng, space = np.random.default_rng(1), taylor_space(nu, 3)
    a = random_models(space, rng, 1.0, left, degree)
    b = random_models(space, rng, 1.0, right, degree)
    assert_contains(a + b, lambda x, y: x + y, a, b)
    assert_contains(a - b, lambda x, y: x - y, a, b)
    assert_contains(a * b, lambda x, y: x * y, a, b)
    assert_contains(-a, lambda x: -x, a)
    assert_contains(a**3, lambda x: x**3, a)
    numbers = rng.normal(size=(1, 2))
    for column in range(2):  # every column has its number
        number, part = float(numbers[0, column]), a[:, np.array([column])]
        assert_contains((a * numbers)[:, np.array([column])], lambda x, c=number: x * arb(c), part)
        assert_contains((numbers - a)[:, np.array([column])], lambda x, c=number: arb(c) - x, part)
        assert_contains((a / numbers)[:, np.array([column])], lambda x, c=number: x / arb(c), part)


def test_the_rounding_of_a_sum_of_numbers_of_two_sizes_is_counted() -> None:
    space = taylor_space(1, 2)
    large = CellModels.constant(space, np.array([[1.0]]))
    small = CellModels.constant(space, np.array([[1e-17]]))
    assert (large + small).remainder[0, 0] >= 1e-17
    assert (large + np.array([[1e-17]])).remainder[0, 0] >= 1e-17
    joined = large.join([large, small])
    summed = joined.add_columns(np.zeros(2, dtype=int), 1)
    assert summed.coefficients[0, 0, 0] == 1.0 and summed.remainder[0, 0] >= 1e-17


def test_sums_of_columns_contain_the_sums_of_their_functions() -> None:
    rng, space = np.random.default_rng(2), taylor_space(2, 3)
    for remainder in (0.0, 0.1):
        parts = [random_models(space, rng, 1.0, remainder) for _ in range(3)]
        joined = parts[0].join(parts)
        assert joined.shape == (4, 6)
        summed = joined.add_columns(np.array([0, 1, 0, 1, 0, 1]), 2)
        assert_contains(summed, lambda x, y, z: x + y + z, *parts)


def test_numbers_and_models_of_one_cell_stand_beside_those_of_many() -> None:
    space = taylor_space(1, 2)
    (variable,) = CellModels.variables(space, np.array([[0.0], [1.0]]), np.array([[1.0], [3.0]]))
    joined = variable.join([variable, np.array([[7.0]]), CellModels.constant(space, np.array([[8.0]]))])
    assert joined.coefficients[:, :, 0].tolist() == [[0.5, 7.0, 8.0], [2.0, 7.0, 8.0]]
    assert joined.coefficients[:, :, 1] == pytest.approx(np.array([[0.5, 0.0, 0.0], [1.0, 0.0, 0.0]]))


def test_the_variables_cover_their_cells_to_the_last_bit() -> None:
    rng = np.random.default_rng(3)
    lower = rng.normal(size=(500, 2)) * 10.0 ** rng.integers(-9, 9, (500, 2))
    upper = lower + np.abs(rng.normal(size=(500, 2))) * 10.0 ** rng.integers(-9, 9, (500, 2))
    for i, model in enumerate(CellModels.variables(taylor_space(2, 3), lower, upper)):
        place = 1 + int(np.flatnonzero(model.space.exponents[1:, i] == 1)[0])
        for cell in range(500):
            middle, radius = Fraction(model.coefficients[cell, 0, 0]), Fraction(model.coefficients[cell, 0, place])
            assert middle - radius <= Fraction(lower[cell, i]) and Fraction(upper[cell, i]) <= middle + radius


def test_bounds_hold_every_value_and_the_remainder() -> None:
    rng, space = np.random.default_rng(4), taylor_space(2, 3)
    for remainder in (0.0, 0.5):
        model = random_models(space, rng, 1.0, remainder)
        low, high = model.bounds()
        values = np.einsum("ckm,pm->ckp", model.coefficients, space.monomials(rng.uniform(-1, 1, (4000, 2))))
        assert (values.min(axis=2) - remainder >= low).all() and (values.max(axis=2) + remainder <= high).all()
    for place in range(1, space.size):  # one monomial: the interval is that of its powers, and no wider
        coefficients = np.zeros((1, 1, space.size))
        coefficients[..., place] = 2.0
        low, high = CellModels(space, coefficients, np.zeros((1, 1))).bounds()
        assert float(high[0, 0]) == pytest.approx(2.0, abs=1e-9)
        assert float(low[0, 0]) == pytest.approx(0.0 if space.even[place] else -2.0, abs=1e-9)
    thirds = CellModels(space, rng.normal(size=(200, 1, space.size)), np.zeros((200, 1)))
    low, high = thirds.bounds()
    for cell in range(200):
        parts = [Fraction(c) for c in thirds.coefficients[cell, 0].tolist()]
        pairs = list(zip(parts[1:], space.even[1:].tolist(), strict=True))
        assert Fraction(high[cell, 0]) >= parts[0] + sum(max(c, Fraction(0)) if even else abs(c) for c, even in pairs)
        assert Fraction(low[cell, 0]) <= parts[0] + sum(min(c, Fraction(0)) if even else -abs(c) for c, even in pairs)


@pytest.mark.parametrize("name", FUNCTIONS)
def test_every_function_contains_its_values(name: str) -> None:
    """On cells of several widths, of one variable alone and of polynomials in two, with a remainder and without."""
    truth, (least, most) = FUNCTIONS[name]
    rng = np.random.default_rng(5)
    for degree, width, remainder in (
        (4, 0.4, 0.0),
        (1, 0.1, 0.0),
        (4, 1e-6, 0.0),
        (6, 1e-3, 0.05),
        (3, 0.8, 0.01),
        (5, 0.0, 0.0),
    ):
        for nu in (1, 2):
            space = taylor_space(nu, degree)
            model = random_models(space, rng, width / (2 * space.size), remainder, 1 if nu == 1 else 2)
            model.coefficients[..., 0] = rng.uniform(least, most, (4, 2))
            result = getattr(np, name)(model)
            assert np.isfinite(result.remainder).all()
            assert_contains(result, truth, model)


@pytest.mark.parametrize("power", [-3.0, -1.0, -0.5, 0.0, 1.0, 2.0, 0.5, 1.7, 3.0, 7.0])
def test_every_power_contains_its_values(power: float) -> None:
    rng = np.random.default_rng(6)
    for width, remainder in ((0.3, 0.0), (1e-3, 0.1)):
        space = taylor_space(1, 4)
        model = random_models(space, rng, width / 10, remainder, 1)
        model.coefficients[..., 0] = rng.uniform(0.6, 2.0, (4, 2)) * (-1.0 if power in (-3.0, -1.0, 3.0, 7.0) else 1.0)
        assert_contains(model ** np.array([[power]]), lambda x: x ** arb(power), model)


def test_quotients_and_powers_of_models_contain_their_values() -> None:
    rng, space = np.random.default_rng(7), taylor_space(2, 4)
    a = random_models(space, rng, 0.02, 0.01, 1)
    b = random_models(space, rng, 0.02, 0.02, 1)
    a.coefficients[..., 0] += 2.0
    b.coefficients[..., 0] += 1.5
    assert_contains(a / b, lambda x, y: x / y, a, b)
    assert_contains(a**b, lambda x, y: (x.log() * y).exp(), a, b)
    assert_contains(np.array([[2.0, 2.0]]) / b, lambda y: 2 / y, b)
    assert_contains(np.array([[2.0, 2.0]]) ** b, lambda y: (arb(2).log() * y).exp(), b)


def test_columns_may_have_powers_of_their_own() -> None:
    (t,) = CellModels.variables(taylor_space(1, 4), np.array([[0.5]]), np.array([[0.6]]))
    wide = t[:, np.zeros(3, dtype=int)]
    for model in (t, wide):
        result = model ** np.array([[3.0, 0.0, 1.0]])
        assert result.shape == (1, 3)
        for column, power in enumerate((3.0, 0.0, 1.0)):
            picked = result[:, np.array([column])]
            assert_contains(picked, lambda x, p=power: x ** arb(p), t)


def test_equal_powers_of_different_columns_are_those_of_each() -> None:
    (t,) = CellModels.variables(taylor_space(1, 4), np.array([[0.9]]), np.array([[1.0]]))
    scaled = t * np.array([[0.0, 1.0, 2.0]])
    for power in (2.0, 0.5):
        result = (scaled + 1.0) ** np.full((1, 3), power)
        for column, factor in enumerate((0.0, 1.0, 2.0)):
            picked = result[:, np.array([column])]
            assert_contains(picked, lambda x, f=factor, p=power: (f * x + 1) ** arb(p), t)


def test_the_matrix_of_bernsteins_form_is_rounded_once() -> None:
    for degree in range(15):
        orders = range(degree + 1)
        for i, row in enumerate(cell_models._conversion(degree).tolist()):
            for j, entry in enumerate(row):
                terms = [Fraction(comb(i, k) * comb(j, k) * 2**k * (-1) ** (j + k), comb(degree, k)) for k in orders]
                assert entry == float(sum(terms))


def test_a_power_of_a_number_counts_its_logarithm() -> None:
    (t,) = CellModels.variables(taylor_space(1, 8), np.array([[300.0]]), np.array([[300.0]]))
    assert_contains(np.power(np.array([[3.0]]), t), lambda x: arb(3) ** x, t)


UNDEFINED = {
    "log": (np.log, -0.5, 1.0),
    "log at 0": (np.log, 0.0, 1.0),
    "sqrt": (np.sqrt, -0.1, 1.0),
    "sqrt of negative numbers": (np.sqrt, -2.0, -1.0),
    "a power": (lambda t: t**1.5, -1.0, 1.0),
    "a power with a model": (lambda t: t**t, -1.0, 1.0),
    "the reciprocal": (lambda t: np.array([[1.0]]) / t, -1.0, 1.0),
    "the reciprocal at 0": (lambda t: t**-2, 0.0, 1.0),
    "the reciprocal at its middle": (lambda t: np.array([[1.0]]) / (t * t), -1.0, 1.0),
    "tan": (np.tan, 1.0, 2.0),
    "exp": (np.exp, 0.0, 1000.0),
    "a division by 0": (lambda t: t / np.array([[0.0]]), 0.0, 1.0),
}


@pytest.mark.parametrize("name", UNDEFINED)
def test_where_a_function_has_no_enclosure_the_bound_is_infinite(name: str) -> None:
    """Whatever is done with it afterwards."""
    function, low, high = UNDEFINED[name]
    space = taylor_space(1, 4)
    (t,) = CellModels.variables(space, np.array([[low]]), np.array([[high]]))
    with np.errstate(all="ignore"):
        model = function(t)
        for later in (
            model,
            -model,
            model * model,
            np.sin(model),
            model + t,
            np.exp(-model),
            np.tanh(model),
            abs(model),
        ):
            bounds, _ = bound_polynomials(space, later.coefficients[:, 0], later.remainder[:, 0], 0.0)
            assert bounds[0] == np.inf


def test_the_modulus_of_values_of_both_signs_is_from_0_to_the_largest() -> None:
    rng, space = np.random.default_rng(10), taylor_space(2, 3)
    for remainder in (0.0, 0.3):
        model = random_models(space, rng, 1.0, remainder)
        assert_contains(abs(model), abs, model)
        assert (abs(model).bounds()[0] >= -1e-8).all()


def test_the_modulus_of_values_up_to_0_is_their_negative() -> None:
    space = taylor_space(1, 2)
    for low in (-1.0, -2.0, -np.pi):
        (t,) = CellModels.variables(space, np.array([[low]]), np.array([[0.0]]))
        result = abs(t - 1e-9)
        assert result.coefficients[0, 0, 0] == pytest.approx(-low / 2)
        exact = CellModels(space, np.array([[[-1.0, 1.0 - 4e-10, 0.0]]]), np.zeros((1, 1)))
        for end in np.linspace(1.0 - 4e-10, 1.0 - 2e-10, 50):  # an upper bound of exactly 0 may be among them
            exact.coefficients[0, 0, 1] = end
            if exact.bounds()[1][0, 0] <= 0.0:
                assert abs(exact).coefficients[0, 0, 0] == 1.0


@pytest.mark.parametrize(("nu", "degree"), [(1, 10), (2, 6), (3, 4), (5, 2)])
def test_bounds_of_polynomials_are_above_dense_samples_and_close(nu: int, degree: int) -> None:
    rng, space = np.random.default_rng(8), taylor_space(nu, degree)
    coefficients = rng.normal(size=(20, space.size))
    deltas = np.concatenate([rng.uniform(-1, 1, (3000, nu)), rng.choice([-1.0, 0.0, 1.0], (500, nu))])
    top = (coefficients @ space.monomials(deltas).T).max(axis=1)
    for error in (0.0, 0.25):
        bounds, _ = bound_polynomials(space, coefficients, np.full(20, error), np.inf)
        assert (bounds >= top + error).all()  # at once
    shift = coefficients.copy()
    shift[:, 0] -= 1.15 * np.abs(top) + top + 0.5  # far below 0: halving shows it
    bounds, axes = bound_polynomials(space, shift, np.zeros(20), 0.0)
    assert (bounds >= top - 1.15 * np.abs(top) - top - 0.5).all() and (bounds <= 0.0).all()
    assert ((axes >= 0) & (axes < nu)).all()


def test_a_polynomial_that_is_above_the_limit_by_little_is_not_said_to_be_below_it() -> None:
    space = taylor_space(1, 10)
    peak = 0.37
    for height, is_below in ((1e-9, False), (-1e-9, True)):
        coefficients = np.zeros((1, space.size))
        coefficients[0, :3] = height - peak**2, 2.0 * peak, -1.0  # height - (t - peak)^2
        bound = bound_polynomials(space, coefficients, np.zeros(1), 0.0)[0][0]
        assert (bound <= 0.0) == is_below and bound >= height
        assert bound_polynomials(space, coefficients, np.array([2e-9]), 0.0)[0][0] >= height + 2e-9


def test_the_rounding_of_bernsteins_form_is_counted() -> None:
    """A constant that the other coefficients swallow."""
    space = taylor_space(1, 10)
    rng = np.random.default_rng(9)
    coefficients = rng.normal(size=(300, space.size)) * 1e8
    bounds, _ = bound_polynomials(space, coefficients, np.zeros(300), np.inf)
    for row, bound in zip(coefficients, bounds, strict=True):
        ends = [sum(Fraction(c) * sign**k for k, c in enumerate(row.tolist())) for sign in (-1, 1)]
        assert Fraction(float(bound)) >= max(ends)


def test_polynomials_that_overflow_or_are_no_numbers_have_infinite_bounds() -> None:
    space = taylor_space(2, 3)
    coefficients = np.zeros((4, space.size))
    coefficients[0, 1], coefficients[1, 0], coefficients[2, 3] = np.nan, np.inf, 1e308
    coefficients[2, 4] = 1e308
    with np.errstate(all="ignore"):
        bounds, _ = bound_polynomials(space, coefficients, np.array([0.0, 0.0, 0.0, np.nan]), 0.0)
    assert (bounds[[0, 1, 3]] == np.inf).all() and bounds[2] >= 2e308


@pytest.mark.parametrize("coordinate", [0, 1])
def test_the_coordinate_to_halve_is_the_one_along_which_the_polynomial_varies(coordinate: int) -> None:
    space = taylor_space(2, 3)
    coefficients = np.zeros((1, space.size))
    coefficients[0, space.index[tuple(np.eye(2, dtype=int)[coordinate].tolist())]] = 1.0
    assert bound_polynomials(space, coefficients, np.zeros(1), 0.0)[1].tolist() == [coordinate]


@pytest.mark.parametrize("degree", [1, 4, 10])
def test_both_halves_of_a_form_are_the_form_to_the_last_digits(degree: int) -> None:
    """At its ends, of every order: a coefficient that is a little wrong is seen there."""
    low, high = cell_models._halving(degree)
    points = np.array([Fraction(k, degree) if degree else Fraction(0) for k in range(degree + 1)], dtype=object)

    def values(t: np.ndarray) -> np.ndarray:
        """The Bernstein polynomials at exact points."""
        return np.array([[comb(degree, k) * s**k * (1 - s) ** (degree - k) for k in range(degree + 1)] for s in t])

    exact = np.vectorize(Fraction, otypes=[object])
    assert (values(points) @ exact(low) == values(points / 2)).all()
    assert (values(points) @ exact(high) == values((points + 1) / 2)).all()
