"""Guards roots, and powers that are no whole numbers, where their argument reaches 0: bounds that hold, that are sharp
at 0, and that nothing has whose argument is negative."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import pytest

import sparserob_core as sr
from sparserob_core.errors import InputError
from sparserob_core.sip.expressions.cell_models import CellModels
from sparserob_core.sip.expressions.rows import ExpressionRows
from sparserob_core.sip.expressions.statements import Decisions
from sparserob_core.sip.expressions.taylor import taylor_space
from tests.support.stated import certify, judge, state

LINE, PLANE = taylor_space(1, 6), taylor_space(2, 6)


@pytest.fixture(autouse=True)
def quiet() -> Iterator[None]:
    """As rows are evaluated."""
    with np.errstate(all="ignore"):
        yield


POWERS = (0.5, 0.3, 0.01, 1.5, 2.7, 11.5)


@pytest.mark.parametrize("power", POWERS)
@pytest.mark.parametrize("end", [1e-9, 0.3, 1.0, 70.0])
def test_a_power_is_within_its_remainder_from_zero_on(power: float, end: float) -> None:
    (x,) = CellModels.variables(LINE, np.zeros((1, 1)), np.full((1, 1), end))
    model, shares = np.power(x, power), np.concatenate([[-1.0], np.geomspace(1e-15, 2.0, 4001) - 1.0])
    values = np.vander(shares, LINE.degree + 1, increasing=True) @ model.coefficients[0, 0]
    distance = np.abs((end * (1.0 + shares) / 2) ** power - values)
    assert distance.max() <= model.remainder[0, 0]
    assert model.remainder[0, 0] <= distance.max() * (1.0 + 1e-6) + 1e-12 * end**power


@pytest.mark.parametrize("power", POWERS)
def test_a_bound_is_sharp_on_one_side_at_zero(power: float) -> None:
    """A root is above its chord, and a higher power below it; both meet at 0."""
    (x,) = CellModels.variables(LINE, np.zeros((1, 1)), np.ones((1, 1)))
    model = np.power(x, power)
    at_zero = (-1.0) ** np.arange(LINE.degree + 1) @ model.coefficients[0, 0]
    remainder = model.remainder[0, 0]
    assert abs(at_zero - remainder if power < 1.0 else at_zero + remainder) <= 1e-10


def test_a_root_of_a_product_reaches_zero_along_two_sides() -> None:
    """The coefficients of the product alone leave a half of it below 0."""
    x, y = CellModels.variables(PLANE, np.zeros((1, 2)), np.ones((1, 2)))
    model = np.sqrt(x * y)
    rng = np.random.default_rng(0)
    shares = np.concatenate([rng.uniform(-1.0, 1.0, (500, 2)), rng.choice([-1.0, 1.0], (9, 2))])
    monomials = np.prod(shares[:, None] ** PLANE.exponents, axis=2)
    distance = np.abs(np.sqrt((1 + shares).prod(axis=1) / 4) - monomials @ model.coefficients[0, 0])
    assert distance.max() <= model.remainder[0, 0] <= 0.13


@pytest.mark.parametrize("low", [-1e-9, -0.5, -1.0])
def test_a_negative_argument_has_no_bound(low: float) -> None:
    (x,) = CellModels.variables(LINE, np.full((1, 1), low), np.ones((1, 1)))
    for power in POWERS:
        assert np.isinf(np.power(x, power).remainder).all()
    assert np.isinf(np.sqrt(x - 3.0).remainder).all()
    assert np.isinf(np.power(x, -0.5).remainder).all()


def test_a_power_of_zero_without_an_exponent_above_zero_has_no_bound() -> None:
    (x,) = CellModels.variables(LINE, np.zeros((1, 1)), np.ones((1, 1)))
    assert np.isinf(np.power(x, -0.5).remainder).all()
    assert np.isinf(np.log(x).remainder).all()


def test_only_cells_that_reach_zero_are_bounded_by_a_chord() -> None:
    (x,) = CellModels.variables(LINE, np.array([[0.0], [0.5], [-0.5]]), np.array([[0.5], [1.0], [0.0]]))
    remainder = np.sqrt(x).remainder[:, 0]
    assert 0.08 <= remainder[0] <= 0.1
    assert remainder[1] <= 1e-4
    assert np.isinf(remainder[2])


UNIT = {"t": (0.0, 1.0)}
PROVEN = {  # closed forms: lines and Chebyshev's polynomial
    "a line for a root": (state({"a": 2, "d": None}, "d", "-d <= a[0] + a[1]*t - sqrt(t) <= d"), 1 / 8),
    "a line for a power": (state({"a": 2, "d": None}, "d", "-d <= a[0] + a[1]*t - t^1.5 <= d"), 2 / 27),
    "an odd cubic in a root": (
        state({"a": 2, "d": None}, "d", "-d <= 4*t^1.5 + a[0]*sqrt(t) <= d"),
        1.0,
    ),
    "a line below a root": (state({"a": 2}, "-a[0] - a[1]/2", "a[0] + a[1]*t <= sqrt(t)"), -0.5),
    "a circle": (
        state({"a": None, "d": None}, "d", "-d <= a - sqrt(1 - t^2) <= d", index={"t": (-1.0, 1.0)}),
        0.5,
    ),
    "a root on a triangle": (
        state(
            {"a": None, "d": None},
            "d",
            "-d <= a - sqrt(x) - y^1.5 <= d",
            index={"names": ["x", "y"], "polytope": {"H": [[-3, 0], [0, -1], [3, 1]], "h": [-1, 0, 4]}},
        ),
        27.0**0.5 / 2,
    ),
}


@pytest.mark.slow
@pytest.mark.parametrize("name", PROVEN)
def test_a_program_with_a_root_is_certified_and_checked(name: str) -> None:
    program, value = PROVEN[name]
    data = certify(program)
    assert data["status"] == "certified"
    assert data["cost"] == pytest.approx(value, abs=2e-7)
    assert {finding.verdict for finding in judge(program, data).values()} == {"holds"}


def test_a_root_that_is_negative_within_the_index_set_is_told() -> None:
    with pytest.raises(InputError, match="no finite value"):
        sr.solve(state({"d": None}, "d", "sqrt(t - 0.25) <= d").build())


def test_rounding_errors_of_a_root_are_bounded_where_it_begins() -> None:
    rows = ExpressionRows.parse({"t": (0.0, 1.0)}, ["x >= sqrt(t) + t^1.5"], Decisions({"x": None}), {})
    bounds = rows.roundings(np.array([0.5]), np.array([[0.0], [1e-12], [1e-3], [1.0]]))
    assert (bounds >= 0.0).all() and bounds[0, 0] <= 1e-15 and bounds.max() <= 1e-14
