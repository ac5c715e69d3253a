"""Guards control/problem/system: systems: matrices at parameters, and their enclosures over cells."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sparserob_core.control.enclosures.taylor import TaylorSpace
from sparserob_core.control.problem.expression import parse_matrix
from sparserob_core.control.problem.system import LinearSystem
from sparserob_core.control.sets.sets import Box, Polytope
from sparserob_core.errors import InputError, NotEnclosable

BOX = Box(np.array([0.5, -0.2]), np.array([1.5, 0.2]))


def oscillator(p):
    return np.array([[0, 1], [-(p[0] ** 2), -np.exp(p[1])]])


def by_callables() -> LinearSystem:
    return LinearSystem(
        oscillator, lambda p: np.array([[0.0], [1.0]]) / p[0], E=np.array([[0.0], [1.0]]), parameters=BOX
    )


def by_expressions() -> LinearSystem:
    names = ("omega", "zeta")
    A = parse_matrix("A", [[0, 1], ["-omega**2", "-exp(zeta)"]], names)
    B = parse_matrix("B", [[0], ["1/omega"]], names)
    return LinearSystem(A, B, E=parse_matrix("E", [[0], [1]], names), parameters=BOX, names=names)


def test_a_known_system_has_one_parameter_vector_of_length_zero() -> None:
    system = LinearSystem([[0, 1], [0, 0]], [[0], [1]])
    assert (system.states, system.controls, system.disturbances, system.parameter_count) == (2, 1, 2, 0)
    A, B, E = system.phases[0].matrices(np.zeros((3, 0)))
    assert A.shape == (3, 2, 2) and B.shape == (3, 2, 1)
    np.testing.assert_array_equal(E[2], np.eye(2))


def test_callables_and_expressions_give_the_same_matrices() -> None:
    points = np.random.default_rng(0).uniform(BOX.lower, BOX.upper, (20, 2))
    for left, right in zip(
        by_callables().phases[0].matrices(points), by_expressions().phases[0].matrices(points), strict=True
    ):
        np.testing.assert_allclose(left, right)
    assert by_callables().names == ("p1", "p2")
    assert by_expressions().describe(np.array([1.0, 0.1])) == "omega = 1, zeta = 0.1"


@pytest.mark.parametrize("make", [by_callables, by_expressions])
@settings(max_examples=15, deadline=None)
@given(seed=st.integers(0, 2**32 - 1))
def test_taylor_models_enclose_every_entry_over_the_cell(make, seed: int) -> None:
    rng = np.random.default_rng(seed)
    system, space = make(), TaylorSpace(2, 3)
    centre, radius = rng.uniform([0.8, -0.1], [1.2, 0.1]), rng.uniform(0, 0.1, 2)
    models = system.phases[0].taylor(space, centre, radius)
    delta = rng.uniform(-1, 1, (30, 2))
    for truth, coefficients, remainder in zip(
        system.phases[0].matrices(centre + radius * delta), models[::2], models[1::2], strict=True
    ):
        value = np.einsum("km,mij->kij", space.monomials(delta), coefficients)
        assert (np.abs(value - truth) <= remainder + 1e-13).all()


def test_constant_plus_parameter_times_array_is_enclosed() -> None:
    base, change = np.array([[0.0, 1.0], [-1.0, 0.0]]), np.diag([1.0, 2.0])
    system = LinearSystem(lambda p: base + p[0] * change, [[0], [1]], parameters=Box([-1.0], [1.0]))
    coefficients, remainder, *_ = system.phases[0].taylor(TaylorSpace(1, 2), np.array([0.0]), np.array([0.5]))
    np.testing.assert_array_equal(coefficients[:2], [base, 0.5 * change])
    assert remainder[base != 0].max() == 0.0  # numbers are what they are
    assert 0.0 < remainder[change != 0].max() < 1e-14  # and a product is rounded


@pytest.mark.parametrize(
    "function",
    [
        lambda p: np.array([[math.sin(p[0])]]),
        lambda p: np.array([[1.0 if p[0] > 0 else 0.0]]),
        lambda p: np.array([[p[0]]], dtype=float),
        lambda p: np.linalg.inv(np.array([[p[0] + 3.0]])),
        lambda p: np.array([[np.floor(p[0])]]),
        lambda p: np.array([[1 / (p[0] + 2.0)]]) if isinstance(p[0], float) else np.array([[1 / p[0]]]),
    ],
)
def test_a_function_that_cannot_be_enclosed_says_so_only_when_asked(function) -> None:
    system = LinearSystem(function, [[1.0]], parameters=Box([-1.0], [1.0]))
    assert system.phases[0].matrices(np.array([[0.5]]))[0].shape == (1, 1, 1)
    with pytest.raises(NotEnclosable, match="A"):
        system.phases[0].taylor(TaylorSpace(1, 2), np.array([0.0]), np.array([1.0]))


@pytest.mark.parametrize(
    ("build", "message"),
    [
        (lambda: LinearSystem([[0, 1]], [[1]]), "A must be square"),
        (lambda: LinearSystem([[0.0]], [[1], [2]]), "B must have 1 rows"),
        (lambda: LinearSystem([[0.0]], [1.0]), "B must be a matrix"),
        (lambda: LinearSystem([[np.nan]], [[1.0]]), "A must be a matrix of finite numbers"),
        (lambda: LinearSystem([["a"]], [[1.0]]), "A must be a matrix of numbers or a function"),
        (lambda: LinearSystem(lambda p: p, [[1.0]]), "no set of parameters is given"),
        (
            lambda: LinearSystem(lambda p: p, [[1.0]], parameters=Box([0.0], [1.0])),
            "the function A must return a matrix",
        ),
        (
            lambda: LinearSystem(lambda p: [[p[3]]], [[1.0]], parameters=Box([0.0], [1.0])),
            "the function A failed at p1 = 0.5",
        ),
        (
            lambda: LinearSystem(lambda p: [[np.log(p[0])]], [[1.0]], parameters=Box([0.0], [1.0])),
            "A is not finite at p1 = 0",
        ),
        (lambda: LinearSystem([[0.0]], [[1.0]], parameters=Box([0.0], [np.inf])), "must be bounded"),
        (
            lambda: LinearSystem([[0.0]], [[1.0]], parameters=Box([0.0], [1.0]), names=("a", "b")),
            "expected 1 parameter names",
        ),
        (lambda: LinearSystem(parse_matrix("A", [["q"]], ("q",)), [[1.0]]), "the system has none"),
    ],
)
def test_a_system_at_fault_names_the_matrix_and_what_was_expected(build, message: str) -> None:
    with pytest.raises(InputError, match=message):
        build()


def test_parameters_may_fill_a_polytope() -> None:
    triangle = Polytope(np.array([[-1.0, 0.0], [0.0, -1.0], [1.0, 1.0]]), np.array([0.0, 0.0, 1.0]))
    system = LinearSystem(lambda p: [[np.sqrt(1.0 - p[0] - p[1] + 1e-9)]], [[1.0]], parameters=triangle)
    assert system.parameter_count == 2


def other_for_numbers(p):
    return [[(-1.0 if isinstance(p[0], float) else -9.0) + 0.0 * p[0]]]


def drawn(p):
    return [[np.random.default_rng().normal() + 0.0 * p[0]]]


@pytest.mark.parametrize("function", [other_for_numbers, drawn])
def test_a_function_that_is_another_one_for_taylor_models_is_refused(function):
    """Rows would be those of one system, and proofs those of another."""
    system = LinearSystem(function, [[1.0]], parameters=Box([-0.5], [0.5]))
    space = TaylorSpace(1, 2)
    with pytest.raises(InputError, match=r"system\.A: expected a function that depends on its argument alone, .*p1 = "):
        system.phases[0].taylor(space, np.zeros(1), np.full(1, 0.5))


def test_a_function_that_cancels_is_the_same_for_taylor_models():
    def A(p):
        return [[1.0, np.sin(p[0]) - p[0]], [(1.0 + p[0]) ** 2 - 1.0 - 2.0 * p[0] - p[0] ** 2, np.exp(-p[0])]]

    system = LinearSystem(A, [[1.0], [0.0]], parameters=Box([-0.5], [0.5]))
    for centre in np.linspace(-0.5, 0.5, 7):
        system.phases[0].taylor(TaylorSpace(1, 3), np.array([centre]), np.full(1, 1e-3))
