"""Guards control/problem/dictionary: dictionaries as records."""

from __future__ import annotations

import numpy as np
import pytest

from sparserob_core.control.problem.dictionary import Dictionary
from sparserob_core.errors import InputError


def test_a_dictionary_knows_its_sizes() -> None:
    made = Dictionary([0.0, 1.0, 3.0], [[1.0, -1.0]])
    assert (made.pieces, made.functions, made.horizon, made.is_complete) == (2, 1, 3.0, False)
    np.testing.assert_array_equal(made.lengths, [1.0, 2.0])


def test_merging_keeps_every_function_and_joins_equal_pieces() -> None:
    fine = Dictionary(np.linspace(0, 4, 5), [[1, 1, 0, 0], [0, 0, 0, 2]])
    coarse = fine.merged()
    np.testing.assert_array_equal(coarse.breakpoints, [0, 2, 3, 4])
    np.testing.assert_array_equal(coarse.values, [[1, 0, 0], [0, 0, 2]])
    assert not fine.is_complete


def test_indicators_of_merged_pieces_are_complete() -> None:
    assert Dictionary(np.linspace(0, 4, 5), [[1, 1, 0, 0], [0, 0, 1, 1]]).is_complete


@pytest.mark.parametrize(
    ("breakpoints", "values", "message"),
    [
        ([0, 1, 1], [[1, 1]], "breakpoints must increase from 0"),
        ([1, 2], [[1]], "breakpoints must increase from 0"),
        ([0, 1], [[1, 2]], r"values must have shape \(functions, 1\)"),
        ([0, 1], [[1], [2]], "2 functions on 1 pieces; there can be at most as many functions as pieces"),
        ([0, 1, 2], [[1, 2], [2, 4]], "linearly independent"),
        ([0, 1, 2], [[0, 0]], "linearly independent"),
        ([0, 1], [[np.nan]], "finite"),
        ([0, 1], [["a"]], "array of numbers"),
    ],
)
def test_a_dictionary_at_fault_says_what_was_expected(breakpoints, values, message: str) -> None:
    with pytest.raises(InputError, match=message):
        Dictionary(breakpoints, values)
