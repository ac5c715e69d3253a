"""Guards plugins/sparserob_dictionaries: the shipped dictionaries."""

from __future__ import annotations

import numpy as np
import pytest

import sparserob_core as sr
from sparserob_dictionaries import Haar, PiecewiseConstant, Walsh


def test_indicators_sum_to_one_and_take_the_values_of_the_control() -> None:
    made = PiecewiseConstant(pieces=7).build(3.0)
    np.testing.assert_array_equal(made.values, np.eye(7))
    np.testing.assert_allclose(made.lengths, 3.0 / 7)


def test_a_step_rounds_the_number_of_pieces_up() -> None:
    assert PiecewiseConstant(step=0.3).build(1.0).pieces == 4
    assert PiecewiseConstant(step=0.1).build(0.3).pieces == 3


def test_given_breakpoints_are_kept() -> None:
    np.testing.assert_array_equal(PiecewiseConstant(breakpoints=[0, 0.5, 2]).build(2.0).breakpoints, [0, 0.5, 2])


def test_fewer_indicators_join_neighbouring_pieces() -> None:
    made = PiecewiseConstant(pieces=5, functions=2).build(1.0)
    np.testing.assert_array_equal(made.values.sum(axis=0), np.ones(5))
    assert made.functions == 2 and made.is_complete


@pytest.mark.parametrize("factory", [Haar, Walsh])
def test_wavelets_are_orthogonal_with_largest_value_one_and_complete(factory) -> None:
    made = factory(pieces=16).build(2.0)
    gram = made.values @ made.values.T
    np.testing.assert_array_equal(gram, np.diag(np.diag(gram)))
    np.testing.assert_array_equal(np.abs(made.values).max(axis=1), np.ones(16))
    assert made.is_complete


@pytest.mark.parametrize("factory", [Haar, Walsh])
def test_the_first_functions_do_not_depend_on_how_many_follow(factory) -> None:
    few, all_of_them = factory(pieces=16, functions=5).build(1.0), factory(pieces=16).build(1.0)
    np.testing.assert_array_equal(few.values, all_of_them.values[:5])


def test_walsh_functions_are_ordered_by_their_sign_changes() -> None:
    values = Walsh(pieces=32).build(1.0).values
    np.testing.assert_array_equal((np.diff(values, axis=1) != 0).sum(axis=1), np.arange(32))


def test_haar_functions_beyond_the_first_have_mean_zero() -> None:
    np.testing.assert_array_equal(Haar(pieces=8).build(1.0).values[1:].sum(axis=1), np.zeros(7))


@pytest.mark.parametrize(
    ("factory", "message"),
    [
        (PiecewiseConstant(pieces=3, functions=4), "functions: expected at most 3, as many as pieces"),
        (Haar(pieces=4, functions=5), "functions: expected at most 4"),
        (Haar(pieces=6), "pieces: expected a power of two, such as 4 or 8, got 6"),
        (Walsh(pieces=6), "pieces: expected a power of two"),
        (PiecewiseConstant(breakpoints=[0, 1]), "breakpoints: expected increasing times from 0 to the horizon 2"),
        (PiecewiseConstant(breakpoints=[0.5, 2]), "breakpoints: expected"),
        (PiecewiseConstant(breakpoints=[0, 1, 1, 2]), "not increasing"),
        (PiecewiseConstant(pieces=3, step=0.1), "expected one of pieces, step and breakpoints, got pieces and step"),
        (PiecewiseConstant(step=1e-9), "step: expected at most"),
    ],
)
def test_options_that_do_not_fit_say_so(factory, message: str) -> None:
    with pytest.raises(sr.InputError, match=message):
        factory.build(2.0)


def test_no_piece_at_all_is_out_of_range() -> None:
    with pytest.raises(sr.InputError, match=r"PiecewiseConstant\.pieces: .* got 0"):
        PiecewiseConstant(pieces=0)
