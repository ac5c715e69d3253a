"""Guards sip/expressions/expression: expressions: arithmetic as written, and nothing else."""

from __future__ import annotations

import contextlib
import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from sparserob_core.errors import InputError
from sparserob_core.sip.expressions.expression import parse_expression, parse_matrix

NAMES = ("p1", "p2", "mass")


@pytest.mark.parametrize(
    ("text", "value"),
    [
        ("1 + 2*3 - 4/8", 6.5),
        ("-2**2", -4.0),
        ("2**-1", 0.5),
        ("-(1 - 3)", 2.0),
        ("+p1", 2.0),
        ("p1**p2", 8.0),
        ("p2/p1", 1.5),
        ("sin(pi/2)", 1.0),
        ("log(e)", 1.0),
        ("exp(0)*cos(0)", 1.0),
        ("sqrt(mass)", 2.0),
        ("tan(0) + tanh(0)", 0.0),
        (" 1e-3 ", 1e-3),
        ("1/mass", 0.25),
    ],
)
def test_an_expression_has_its_arithmetical_value(text: str, value: float) -> None:
    assert parse_expression(text, NAMES)({"p1": 2.0, "p2": 3.0, "mass": 4.0}) == pytest.approx(value)


def test_an_expression_maps_arrays_entry_by_entry() -> None:
    p = np.linspace(0.5, 2.0, 7)
    np.testing.assert_allclose(parse_expression("2*p1**2 - sin(p1)/p1", NAMES)({"p1": p}), 2 * p**2 - np.sin(p) / p)


def test_an_expression_knows_the_names_that_occur_in_it() -> None:
    assert parse_expression("mass*p1 + pi", NAMES).names == {"mass", "p1"}


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("p1 + q", r"'p1 \+ q': unknown name 'q'; known parameters: p1, p2, mass"),
        ("mas*2", "unknown name 'mas', did you mean 'mass'"),
        ("__import__('os').system('true')", "unknown function"),
        ("(lambda: 1)()", "unknown function"),
        ("p1.real", "is not allowed"),
        ("p1 if p2 else 1", "is not allowed"),
        ("[p1]", "is not allowed"),
        ("p1 < p2", "is not allowed"),
        ("p1 // 2", "is not allowed"),
        ("not p1", "is not allowed"),
        ("'a'", "not a real number"),
        ("1j", "not a real number"),
        ("True", "not a real number"),
        ("sin(p1, p2)", "takes one argument"),
        ("sin()", "takes one argument"),
        ("sin(*p1)", "takes one argument"),
        ("gamma(p1)", "known functions: sin, cos"),
        ("p1 +", "cannot be read as arithmetic"),
        ("", "cannot be read as arithmetic"),
        ("p1 = 3", "cannot be read as arithmetic"),
        ("1" * 400, "too large"),
        ("1" * 5000, "longer than"),
        ("-" * 100 + "p1", "nested more than"),
        ("+".join(["p1"] * 300), "more than"),
        ("(" * 400 + ")" * 400, "cannot be read"),
    ],
)
def test_anything_else_is_refused_with_the_part_at_fault(text: str, message: str) -> None:
    with pytest.raises(InputError, match=message):
        parse_expression(text, NAMES)


def test_a_tower_of_powers_is_infinite_at_once_and_a_complex_power_is_not_a_number() -> None:
    assert parse_expression("9**9**9**9**9", ())({}) == math.inf
    assert math.isnan(parse_expression("(-8)**0.5", ())({}))


@given(st.text(alphabet="p12+-*/() .esin,_[]'\"", max_size=30))
def test_any_text_is_a_number_or_an_input_error(text: str) -> None:
    with contextlib.suppress(InputError):
        float(parse_expression(text, ("p1", "p2"))({"p1": 1.0, "p2": 2.0}))


def test_a_matrix_evaluates_at_many_parameters() -> None:
    matrix = parse_matrix("A", [[0, 1], ["-2 + p1", "p2*p1"]], ("p1", "p2"))
    points = np.array([[0.5, 2.0], [1.0, 3.0], [0.0, 0.0]])
    values = matrix.evaluate(points)
    assert values.shape == (3, 2, 2)
    for value, point in zip(values, points, strict=True):
        np.testing.assert_allclose(value, matrix(point))
    np.testing.assert_allclose(values[0], [[0, 1], [-1.5, 1.0]])


def test_a_ragged_matrix_names_itself() -> None:
    with pytest.raises(InputError, match=r"system\.A: expected a matrix"):
        parse_matrix("system.A", [[1, 2], [3]], ())
    with pytest.raises(InputError, match=r"system\.B\.\d\.\d: expression 'q': unknown name"):
        parse_matrix("system.B", [["q"]], ())
