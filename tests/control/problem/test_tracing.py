"""Guards functions of the parameters as expressions: what is written has the values of the function."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

import sparserob_core as sr
from sparserob_core.control.problem.tracing import trace_entries
from sparserob_core.sip.expressions.expression import parse_matrix

NAMES = ("p1", "p2")
PROBES = np.array([[0.3, 0.7], [0.9, 0.2]])


@pytest.mark.parametrize(
    "function",
    [
        lambda p: np.array([[1.0 + p[0], 2 - p[1]], [-p[0], +p[1]]]),
        lambda p: [[p[0] * p[1] / 3, 3 / p[1]], [p[0] ** 2, 2.0 ** p[1]]],
        lambda p: np.array([[np.sin(p[0]) * np.exp(-p[1])], [np.sqrt(p[0]) + np.log(p[1])]]),
        lambda p: np.array([[np.tanh(p[0]), np.cos(p[1] - 0.1), np.tan(p[0])]]),
        lambda p: np.array([[1.0, -2.0], [0.0, 5e-324]]) @ np.diag([1.0, 1.0]) * p[0],
        lambda p: np.float64(-0.25) * p[0] - np.array([[1.0]]) * p[1],
    ],
)
def test_the_expressions_of_a_function_have_its_values(function: Callable[..., object]) -> None:
    written = parse_matrix("A", trace_entries("A", function, NAMES, PROBES), NAMES)
    for point in np.random.default_rng(0).uniform(0.1, 1.0, (50, 2)):
        assert np.allclose(written(point), np.asarray(function(point), dtype=float), rtol=1e-14, atol=0.0)


def remembers() -> Callable[..., object]:
    calls: list[int] = []

    def function(p: np.ndarray) -> object:
        calls.append(0)
        return [[p[0] * len(calls)]]

    return function


@pytest.mark.parametrize(
    ("function", "why"),
    [
        (lambda p: [[p[0] if p[0] > 0 else -p[0]]], "branches"),
        (lambda p: [[np.arctan(p[0])]], "arctan"),
        (lambda p: [[np.interp(p[0], [0, 1], [0, 1])]], "cannot be written"),
        (lambda p: [[str(p[0])]], "str"),
        (lambda p: [[sum([p[0]] * 500)]], "terms|characters"),
        (remembers(), "more than its argument"),
    ],
)
def test_what_is_no_arithmetic_is_refused_with_its_reason(function: Callable[..., object], why: str) -> None:
    with pytest.raises(sr.InputError, match=why):
        trace_entries("A", function, NAMES, PROBES)
