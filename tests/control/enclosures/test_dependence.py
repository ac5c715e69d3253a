"""Guards power series in the parameters: coefficients of every function are those of its Taylor series."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import pytest

from sparserob_core.checker.arithmetic.models import Frame, Model
from sparserob_core.checker.arithmetic.monomials import NONE
from sparserob_core.control.enclosures.dependence import Split
from sparserob_core.sip.expressions.expression import parse_matrix

flint = pytest.importorskip("flint")

FUNCTIONS = [
    "exp(-p*t)",
    "log(2 + p*t + p^2)",
    "1 / (1 + p - p^3)",
    "(1.5 + p)^(-0.7)",
    "(1.5 + p)^(-3) * p^2",
    "sqrt(1 + p*cos(t))",
    "sin(p*t + p^2)*cos(p*t)",
    "tan(p + p^2)",
    "tanh(2*p - p^2)",
    "kepler(t + p + p^2, 0.3)",
    "(1 + t)^p",
    "(1 + p)^(2*p)",
    "p^12",
]
TIME, CENTRE, UNIT, DEGREE = 0.7, 0.2, 0.3, 10


HALF = 2.0**-5  # of an interval, so short that the last power that is asked for is kept


@pytest.fixture(autouse=True)
def _to_many_digits() -> Iterator[None]:
    with flint.ctx.workprec(300):
        yield


def around(centre: float, length: int) -> Model:
    """A number about ``centre``, of whose functions so many powers are known."""
    return Frame(NONE, length - 1).time(flint.arb(centre), flint.arb(HALF))


def powers(model: Model, length: int) -> list[flint.arb]:
    """The coefficients of powers of the distance from the centre."""
    (part,) = model.parts
    return [part[n] / flint.arb(HALF) ** n for n in range(length)]


@pytest.mark.parametrize("text", FUNCTIONS)
def test_coefficients_are_those_of_the_taylor_series(text: str) -> None:
    entry = parse_matrix("A", [[text]], ["t", "p"])
    split = Split.of(entry, TIME, np.array([CENTRE]), np.array([UNIT]), DEGREE)
    found = [float(split.parts.get((n,), np.zeros((1, 1)))[0, 0]) for n in range(DEGREE + 1)]
    p = np.array([TIME, around(CENTRE, DEGREE + 1)], dtype=object)
    exact = [float(one.mid()) * UNIT**n for n, one in enumerate(powers(entry(p)[0, 0], DEGREE + 1))]
    assert found == pytest.approx(exact, rel=1e-11, abs=1e-14)
    assert split.beyond == [(0, 0)]


def test_coefficients_in_two_parameters_are_those_of_the_product_of_two_series() -> None:
    entry = parse_matrix("A", [["exp(p + 2*q) / (1 + q)"]], ["t", "p", "q"])
    parts = Split.of(entry, 1.0, np.array([0.5, 0.25]), np.array([0.1, 0.2]), 5).parts
    p, q = (around(one, 6) for one in (0.5, 0.25))
    left, right = powers(p.exp(), 6), powers((q * 2.0).exp() / (1.0 + q), 6)
    for (i, j), table in parts.items():
        exact = float((left[i] * right[j]).mid()) * 0.1**i * 0.2**j
        assert float(table[0, 0]) == pytest.approx(exact, rel=1e-12)
    assert len(parts) == 21


def test_a_polynomial_of_no_more_than_the_degree_is_all_there_is() -> None:
    entry = parse_matrix("A", [["(1 + p*t)^3 - 2*p", "p^4"]], ["t", "p"])
    assert Split.of(entry, TIME, np.array([CENTRE]), np.array([UNIT]), 3).beyond == [(0, 1)]
